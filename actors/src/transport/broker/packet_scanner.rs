//! Boundaries of MQTT packets in a stream of bytes.

/// Finds where packets begin and end.
#[derive(Debug, Default)]
pub(super) struct PacketScanner {
    /// The part of the fixed header that has arrived.
    header: Vec<u8>,
    /// Bytes of the current packet that are still to come.
    rest: usize,
}

/// A part of the stream.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Piece<'a> {
    /// The fixed header of a packet, and the number of bytes after it.
    Head(Vec<u8>, usize),
    /// Bytes after the header.
    Body(&'a [u8]),
}

/// Longest fixed header in bytes.
const MAX_HEADER_BYTES: usize = 5;

impl PacketScanner {
    /// Takes the next piece off the bytes; `None` when all are taken. A header without an end
    /// counts as an empty packet, which ends the connection at its receiver.
    pub(super) fn next<'a>(&mut self, bytes: &mut &'a [u8]) -> Option<Piece<'a>> {
        if self.rest > 0 && !bytes.is_empty() {
            let (body, after) = bytes.split_at(self.rest.min(bytes.len()));
            *bytes = after;
            self.rest -= body.len();
            return Some(Piece::Body(body));
        }
        while let Some((byte, after)) = bytes.split_first() {
            *bytes = after;
            self.header.push(*byte);
            let is_last = self.header.len() == MAX_HEADER_BYTES || byte & 0x80 == 0;
            if self.header.len() > 1 && is_last {
                let header = std::mem::take(&mut self.header);
                let digits = header.iter().skip(1).zip([0, 7, 14, 21]);
                self.rest = digits
                    .map(|(byte, shift)| usize::from(byte & 0x7f) << shift)
                    .sum();
                return Some(Piece::Head(header, self.rest));
            }
        }
        None
    }

    /// True if the bytes so far end with a packet.
    pub(super) fn is_between_packets(&self) -> bool {
        self.rest == 0 && self.header.is_empty()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn split_bytes_give_whole_packets() {
        let long = [&[0x30, 0xc8, 0x01][..], &[7; 200]].concat();
        let stream = [&[0xd0, 0][..], &long, &[0x40, 2, 0, 1]].concat();
        for size in 1..=stream.len() {
            let mut scanner = PacketScanner::default();
            let mut heads = Vec::new();
            let mut bodies = 0;
            for mut chunk in stream.chunks(size) {
                while let Some(piece) = scanner.next(&mut chunk) {
                    match piece {
                        Piece::Head(header, length) => heads.push((header[0], length)),
                        Piece::Body(body) => bodies += body.len(),
                    }
                }
            }
            assert_eq!(
                (heads, bodies),
                (vec![(0xd0, 0), (0x30, 200), (0x40, 2)], 202)
            );
            assert!(scanner.is_between_packets());
        }
    }
}
