//! Bytes for a client that reads more slowly than they arrive.

use std::collections::VecDeque;

use super::packet_scanner::{PacketScanner, Piece};

/// Packets for one client, in order. If there are too many, the oldest message is dropped: a late
/// map is worthless.
#[derive(Debug)]
pub(super) struct OutboundQueue {
    bytes: VecDeque<u8>,
    packets: VecDeque<QueuedPacket>,
    scanner: PacketScanner,
    max_packets: usize,
}

#[derive(Debug)]
struct QueuedPacket {
    /// Bytes in the queue.
    bytes: usize,
    /// True if the packet is a message of QoS 0 of which no byte was sent yet.
    is_droppable: bool,
}

/// Maximum bytes of messages of one client; beyond it the oldest messages are dropped, but the
/// newest one is kept.
const MAX_BYTES: usize = 2 * 1024 * 1024;

/// Maximum number of packets that must not be dropped and may be queued in addition to the
/// messages.
const MAX_ANSWERS: usize = 64;

/// Memory that an empty queue keeps.
const KEPT_BYTES: usize = 16 * 1024;

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
            bytes: VecDeque::new(),
            packets: VecDeque::new(),
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
                    self.packets.push_back(QueuedPacket {
                        bytes: header.len(),
                        is_droppable,
                    });
                    self.append(&header);
                }
                Piece::Body(body) => {
                    // The packet may have been sent as far as it had come.
                    match self.packets.back_mut() {
                        Some(last) => last.bytes += body.len(),
                        None => self.packets.push_back(QueuedPacket {
                            bytes: body.len(),
                            is_droppable: false,
                        }),
                    }
                    self.append(body);
                }
            }
            while self.packets.len() > self.max_packets || self.bytes.len() > MAX_BYTES {
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

    /// A long queue grows by an eighth: doubled, queues of clients that do not read would hold
    /// twice their bytes.
    fn append(&mut self, more: &[u8]) {
        let length = self.bytes.len() + more.len();
        if length > self.bytes.capacity() && length > KEPT_BYTES {
            self.bytes.reserve_exact(more.len() + length / 8);
        }
        self.bytes.extend(more);
    }

    /// Drops the oldest message that may be dropped. The newest packet is kept, because its end may
    /// be still to come.
    fn drop_oldest(&mut self) -> bool {
        let mut before = 0;
        let older = self
            .packets
            .iter()
            .take(self.packets.len().saturating_sub(1));
        for (index, packet) in older.enumerate() {
            if packet.is_droppable {
                self.bytes.drain(before..before + packet.bytes);
                self.packets.remove(index);
                return true;
            }
            before += packet.bytes;
        }
        false
    }

    pub(super) fn is_empty(&self) -> bool {
        self.bytes.is_empty()
    }

    /// Number of waiting bytes.
    pub(super) fn len(&self) -> usize {
        self.bytes.len()
    }

    /// The next bytes to be sent; empty only if the queue is.
    pub(super) fn next(&self) -> &[u8] {
        self.bytes.as_slices().0
    }

    /// Takes sent bytes off.
    pub(super) fn advance(&mut self, mut sent: usize) {
        self.bytes.drain(..sent);
        while let Some(first) = self.packets.front_mut() {
            if sent < first.bytes {
                first.bytes -= sent;
                first.is_droppable &= sent == 0;
                break;
            }
            sent -= first.bytes;
            self.packets.pop_front();
        }
        if self.bytes.is_empty() && self.bytes.capacity() > KEPT_BYTES {
            self.bytes = VecDeque::new();
        }
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
        assert!(
            queue.bytes.capacity() <= (MAX_BYTES + 255_010) * 9 / 8,
            "{}",
            queue.bytes.capacity()
        );
        queue.push(&message(60, 8_000_000)).unwrap();
        assert_eq!(queue.packets.len(), 2, "what is begun and what is newest");
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
