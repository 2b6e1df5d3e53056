//! Bytes for a client that reads more slowly than they arrive.

use std::collections::VecDeque;

use super::packet_scanner::{PacketScanner, Piece};

/// Packets for one client, in order. If there are too many, the oldest message is dropped: a late
/// map is worthless. Each packet has a buffer of its own, so that a drop moves no byte of others.
#[derive(Debug)]
pub(super) struct OutboundQueue {
    packets: VecDeque<QueuedPacket>,
    /// Bytes of the first packet that were sent.
    sent: usize,
    bytes: usize,
    scanner: PacketScanner,
    max_packets: usize,
}

#[derive(Debug)]
struct QueuedPacket {
    /// The bytes so far; of a packet that was being sent, those that came later.
    bytes: Vec<u8>,
    /// True if the packet is a message of QoS 0 of which no byte was sent yet.
    is_droppable: bool,
}

/// Maximum bytes of messages of one client; beyond it the oldest messages are dropped, but the
/// newest one is kept.
const MAX_BYTES: usize = 2 * 1024 * 1024;

/// Maximum number of packets that must not be dropped and may be queued in addition to the
/// messages.
const MAX_ANSWERS: usize = 64;

/// Length from which a packet's buffer grows slowly, and sent bytes are freed before its end.
const LONG_BYTES: usize = 16 * 1024;

/// First byte of a PUBLISH without its retain flag, if its QoS is 0.
const PUBLISH: u8 = 0x30;
const RETAIN: u8 = 0x01;

/// A queue that is full of packets that must not be dropped.
#[derive(Debug)]
pub(super) struct QueueFull;

impl OutboundQueue {
    /// An empty queue for at most `max_packets` messages.
    pub(super) fn new(max_packets: usize) -> Self {
        Self {
            packets: VecDeque::new(),
            sent: 0,
            bytes: 0,
            scanner: PacketScanner::default(),
            max_packets,
        }
    }

    /// Adds bytes; the result is the number of messages dropped for them.
    pub(super) fn push(&mut self, mut bytes: &[u8]) -> Result<usize, QueueFull> {
        let mut dropped = 0;
        while let Some(piece) = self.scanner.next(&mut bytes) {
            match piece {
                Piece::Head(header, _) => {
                    let is_droppable = header
                        .first()
                        .is_some_and(|first| first & !RETAIN == PUBLISH);
                    self.bytes += header.len();
                    self.packets.push_back(QueuedPacket {
                        bytes: header,
                        is_droppable,
                    });
                }
                Piece::Body(body) => {
                    self.bytes += body.len();
                    // The packet may have been sent as far as it had come.
                    match self.packets.back_mut() {
                        Some(last) => last.append(body),
                        None => self.packets.push_back(QueuedPacket {
                            bytes: body.to_vec(),
                            is_droppable: false,
                        }),
                    }
                }
            }
            while self.packets.len() > self.max_packets || self.bytes > MAX_BYTES {
                if self.drop_oldest() {
                    dropped += 1;
                } else if self.packets.len() > self.max_packets + MAX_ANSWERS {
                    return Err(QueueFull);
                } else {
                    break;
                }
            }
        }
        Ok(dropped)
    }

    /// Drops the oldest message that may be dropped. The newest packet is kept, because its end may
    /// be still to come.
    fn drop_oldest(&mut self) -> bool {
        let older = self.packets.len().saturating_sub(1);
        let oldest = self
            .packets
            .iter()
            .take(older)
            .position(|packet| packet.is_droppable);
        let dropped = oldest.and_then(|index| self.packets.remove(index));
        self.bytes -= dropped.as_ref().map_or(0, |packet| packet.bytes.len());
        dropped.is_some()
    }

    pub(super) fn is_empty(&self) -> bool {
        self.bytes == 0
    }

    /// Number of waiting bytes.
    pub(super) fn len(&self) -> usize {
        self.bytes
    }

    /// The next bytes to be sent; empty only if the queue is.
    pub(super) fn next(&self) -> &[u8] {
        let first = self.packets.front();
        first
            .and_then(|packet| packet.bytes.get(self.sent..))
            .unwrap_or(&[])
    }

    /// Takes sent bytes off.
    pub(super) fn advance(&mut self, sent: usize) {
        self.bytes -= sent;
        self.sent += sent;
        while let Some(first) = self.packets.front_mut() {
            if self.sent < first.bytes.len() {
                first.is_droppable &= self.sent == 0;
                if self.sent >= LONG_BYTES && 2 * self.sent >= first.bytes.len() {
                    first.bytes.drain(..self.sent);
                    self.sent = 0;
                }
                break;
            }
            self.sent -= first.bytes.len();
            self.packets.pop_front();
        }
    }
}

impl QueuedPacket {
    /// A long packet's buffer grows by an eighth: doubled, queues of clients that do not read would
    /// hold twice their bytes.
    fn append(&mut self, more: &[u8]) {
        let length = self.bytes.len() + more.len();
        if length > self.bytes.capacity() && length > LONG_BYTES {
            self.bytes.reserve_exact(more.len() + length / 8);
        }
        self.bytes.extend_from_slice(more);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn packet(first: u8, mark: u8, length: usize) -> Vec<u8> {
        let digits = [0, 7, 14, 21].map(|shift| (length >> shift & 0x7f) as u8);
        [
            &[
                first,
                digits[0] | 0x80,
                digits[1] | 0x80,
                digits[2] | 0x80,
                digits[3],
            ][..],
            &vec![mark; length],
        ]
        .concat()
    }

    fn message(mark: u8, length: usize) -> Vec<u8> {
        packet(PUBLISH, mark, length)
    }

    fn all(queue: &mut OutboundQueue) -> Vec<u8> {
        let mut sent = Vec::new();
        while !queue.is_empty() {
            let next = queue.next().to_vec();
            queue.advance(next.len());
            sent.extend(next);
        }
        sent
    }

    #[test]
    fn oldest_messages_drop_whole() {
        let mut queue = OutboundQueue::new(3);
        assert_eq!(queue.push(&message(1, 100)).unwrap(), 0);
        queue.advance(10);
        let answer = packet(0x90, 2, 3);
        assert_eq!(queue.push(&answer).unwrap(), 0);
        for mark in 3..6 {
            for bytes in message(mark, 100).chunks(7) {
                queue.push(bytes).unwrap();
            }
        }
        let expected = [&message(1, 100)[10..], &answer, &message(5, 100)].concat();
        assert_eq!(
            all(&mut queue),
            expected,
            "a begun packet, an answer, and the newest message"
        );
    }

    #[test]
    fn streamed_map_stays_whole() {
        let mut queue = OutboundQueue::new(3);
        let map = message(1, 9_000_000);
        let mut sent = Vec::new();
        for bytes in map.chunks(8192) {
            assert_eq!(queue.push(bytes).unwrap(), 0);
            sent.extend(all(&mut queue));
        }
        queue.push(&message(2, 5)).unwrap();
        sent.extend(all(&mut queue));
        assert!(sent == [map, message(2, 5)].concat());
    }

    #[test]
    fn queue_keeps_newest_within_limit() {
        let mut queue = OutboundQueue::new(100);
        queue.push(&message(0, 10)).unwrap();
        queue.advance(1);
        let dropped: usize = (1..60)
            .map(|mark| queue.push(&message(mark, 255_000)).unwrap())
            .sum();
        assert!(
            queue.len() <= MAX_BYTES + 255_010 && dropped >= 40,
            "{} {dropped}",
            queue.len()
        );
        let buffers = queue.packets.iter().map(|packet| packet.bytes.capacity());
        let held = buffers.sum::<usize>();
        assert!(held <= (MAX_BYTES + 255_010) * 9 / 8, "{held}");
        queue.push(&message(60, 8_000_000)).unwrap();
        assert_eq!(queue.packets.len(), 2, "what is begun and what is newest");
    }

    #[test]
    fn drop_moves_no_begun_packet() {
        let mut queue = OutboundQueue::new(100);
        queue.push(&message(0, 900_000)).unwrap();
        queue.advance(1);
        let begun = queue.next().as_ptr();
        let dropped: usize = (1..100)
            .map(|mark| queue.push(&message(mark, 50_000)).unwrap())
            .sum();
        assert!(dropped > 70);
        assert_eq!(queue.next().as_ptr(), begun);
    }

    #[test]
    fn unread_answers_fill_queue() {
        let mut queue = OutboundQueue::new(10);
        let pushed = (0..100)
            .take_while(|_| queue.push(&[0xd0, 0]).is_ok())
            .count();
        assert_eq!(pushed, 10 + MAX_ANSWERS);
    }

    #[test]
    fn queue_of_one_keeps_newest() {
        let mut queue = OutboundQueue::new(1);
        queue.push(&message(1, 100)).unwrap();
        queue.advance(1);
        assert_eq!(
            (2..5)
                .map(|mark| queue.push(&message(mark, 100)).unwrap())
                .sum::<usize>(),
            2
        );
        assert_eq!(
            all(&mut queue),
            [&message(1, 100)[1..], &message(4, 100)].concat()
        );
    }
}
