//! Bytes that the broker holds for its clients, bounded for each principal and in total.
//!
//! Two kinds of bytes are held for a client: bytes that it has not read, and incomplete packets
//! that it has sent.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use ecod::model::time::Timestamp;
use tokio::sync::oneshot;

/// Held bytes by connection. If a bound is exceeded, the connection that has held bytes for the
/// longest time is cut.
#[derive(Debug, Clone)]
pub(super) struct Backlog {
    table: Arc<Mutex<BacklogTable>>,
    /// Maximum bytes held for one principal, and in total.
    max_bytes_each: usize,
    max_bytes: usize,
}

#[derive(Debug, Default)]
struct BacklogTable {
    connections: BTreeMap<u64, Holding>,
    /// Bytes of all connections.
    bytes: usize,
    next_number: u64,
}

#[derive(Debug)]
struct Holding {
    /// Absent for connections that count alone.
    principal: Option<Arc<str>>,
    unread: usize,
    unfinished: usize,
    /// Time since which bytes are held.
    since: Option<Timestamp>,
    /// Dropped to cut the connection.
    cut: Option<oneshot::Sender<()>>,
}

/// Maximum bytes held for one principal, and in total, where packets are not larger than maps by
/// default.
const MAX_BYTES_EACH: usize = 10 * 1024 * 1024;
const MAX_BYTES: usize = 32 * 1024 * 1024;

/// Room in addition to the largest packet of a principal, and number of largest packets in total,
/// if packets are larger.
const SPARE_BYTES: usize = 2 * 1024 * 1024;
const MAX_PACKETS: usize = 4;

/// A connection's part of the backlog; ends when dropped.
#[derive(Debug)]
pub(super) struct BacklogSlot {
    backlog: Backlog,
    number: u64,
}

impl Backlog {
    /// A backlog that has room for packets of this size.
    pub(super) fn new(max_packet_bytes: usize) -> Self {
        Self {
            table: Arc::default(),
            max_bytes_each: MAX_BYTES_EACH.max(max_packet_bytes + SPARE_BYTES),
            max_bytes: MAX_BYTES.max(MAX_PACKETS * max_packet_bytes),
        }
    }

    /// An entry for one more connection, and a receiver that ends when the connection must be cut.
    pub(super) fn open(&self, principal: Option<Arc<str>>) -> (BacklogSlot, oneshot::Receiver<()>) {
        let mut table = self.table();
        let number = table.next_number;
        table.next_number += 1;
        let (cut, is_cut) = oneshot::channel();
        let holding = Holding {
            principal,
            unread: 0,
            unfinished: 0,
            since: None,
            cut: Some(cut),
        };
        table.connections.insert(number, holding);
        (
            BacklogSlot {
                backlog: self.clone(),
                number,
            },
            is_cut,
        )
    }

    fn table(&self) -> MutexGuard<'_, BacklogTable> {
        self.table.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl BacklogSlot {
    /// Records the bytes that the client has not read.
    pub(super) fn set_unread(&self, bytes: usize, now: Timestamp) {
        self.set(|holding| holding.unread = bytes, now);
    }

    /// Records the bytes of an incomplete packet of the client.
    pub(super) fn set_unfinished(&self, bytes: usize, now: Timestamp) {
        self.set(|holding| holding.unfinished = bytes, now);
    }

    /// Changes the bytes that the connection holds. If its party or all parties together exceed
    /// their limit, the connections that hold bytes for longest are cut.
    fn set(&self, change: impl FnOnce(&mut Holding), now: Timestamp) {
        let mut table = self.backlog.table();
        let Some(holding) = table.connections.get_mut(&self.number) else {
            return;
        };
        let before = holding.bytes();
        change(holding);
        let bytes = holding.bytes();
        let principal = holding.principal.clone();
        holding.since = holding.since.or(Some(now)).filter(|_| bytes > 0);
        table.bytes = (table.bytes + bytes).saturating_sub(before);
        let Backlog {
            max_bytes_each,
            max_bytes,
            ..
        } = self.backlog;
        if bytes <= before || table.bytes <= max_bytes_each {
            return;
        }
        match principal {
            Some(principal) => {
                table.cut_oldest(
                    |holding| holding.principal.as_ref() == Some(&principal),
                    max_bytes_each,
                );
            }
            None if bytes > max_bytes_each => table.cut(self.number),
            None => {}
        }
        table.cut_oldest(|_| true, max_bytes);
    }
}

impl Drop for BacklogSlot {
    fn drop(&mut self) {
        let mut table = self.backlog.table();
        table.cut(self.number);
        table.connections.remove(&self.number);
    }
}

impl BacklogTable {
    /// Cuts connections, the oldest holding first, until the rest of a group holds at most the
    /// bound.
    fn cut_oldest(&mut self, is_member: impl Fn(&Holding) -> bool, bound: usize) {
        loop {
            let members = || {
                self.connections
                    .iter()
                    .filter(|(_, holding)| holding.bytes() > 0 && is_member(holding))
            };
            let oldest = members()
                .min_by_key(|(_, holding)| holding.since)
                .map(|(number, _)| *number);
            match oldest {
                Some(oldest)
                    if members().map(|(_, holding)| holding.bytes()).sum::<usize>() > bound =>
                {
                    self.cut(oldest);
                }
                _ => break,
            }
        }
    }

    fn cut(&mut self, number: u64) {
        if let Some(holding) = self.connections.get_mut(&number) {
            self.bytes -= holding.bytes();
            holding.cut = None;
        }
    }
}

impl Holding {
    /// Held bytes; connections that are being cut don't count.
    fn bytes(&self) -> usize {
        if self.cut.is_some() {
            self.unread + self.unfinished
        } else {
            0
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MIB: usize = 1024 * 1024;

    fn is_cut(receiver: &mut oneshot::Receiver<()>) -> bool {
        receiver.try_recv() == Err(oneshot::error::TryRecvError::Closed)
    }

    #[test]
    fn principals_oldest_is_cut_first() {
        let backlog = Backlog::new(0);
        let (honest, mut honest_cut) = backlog.open(Some("euclid".into()));
        honest.set_unread(MIB, Timestamp(1));
        let mut flood: Vec<_> = (0..10)
            .map(|_| backlog.open(Some("gauss".into())))
            .collect();
        for (n, (slot, _)) in flood.iter().enumerate() {
            slot.set_unread(MIB, Timestamp(10 + n as u64));
            slot.set_unfinished(MIB, Timestamp(50));
        }
        let cut: Vec<_> = flood
            .iter_mut()
            .map(|(_, receiver)| is_cut(receiver))
            .collect();
        assert_eq!(cut, [vec![true; 5], vec![false; 5]].concat());
        assert!(!is_cut(&mut honest_cut));
        flood.clear();
        assert_eq!(backlog.table().connections.len(), 1);
    }

    #[test]
    fn ceiling_cuts_oldest_of_all() {
        let backlog = Backlog::new(0);
        let mut slots: Vec<_> = (0..20)
            .map(|n| backlog.open(Some(format!("v{n}").into())))
            .collect();
        let (empty, mut empty_cut) = backlog.open(None);
        empty.set_unread(1, Timestamp(0));
        empty.set_unread(0, Timestamp(0));
        for (n, (slot, _)) in slots.iter().enumerate() {
            slot.set_unread(4 * MIB, Timestamp(100 - n as u64));
        }
        let cut = slots
            .iter_mut()
            .filter_map(|(_, receiver)| is_cut(receiver).then_some(()))
            .count();
        assert_eq!(cut, 12);
        assert!(!is_cut(&mut slots[0].1), "it came last");
        assert!(!is_cut(&mut empty_cut), "the backlog is empty");
    }

    #[test]
    fn largest_packet_always_fits() {
        let backlog = Backlog::new(64 * MIB);
        let (leader, mut cut) = backlog.open(Some("edge".into()));
        leader.set_unfinished(64 * MIB, Timestamp(0));
        assert!(!is_cut(&mut cut));
        leader.set_unread(3 * MIB, Timestamp(0));
        assert!(is_cut(&mut cut));
    }

    #[test]
    fn finished_packets_reset_sender_age() {
        let backlog = Backlog::new(0);
        let [(sender, mut sender_cut), (reader, mut reader_cut)] =
            [0, 1].map(|_| backlog.open(Some("gauss".into())));
        sender.set_unfinished(MIB, Timestamp(1));
        reader.set_unread(MIB, Timestamp(2));
        sender.set_unfinished(0, Timestamp(3));
        sender.set_unfinished(MIB, Timestamp(3));
        reader.set_unread(MAX_BYTES_EACH, Timestamp(4));
        assert!(is_cut(&mut reader_cut) && !is_cut(&mut sender_cut));
    }

    #[test]
    fn connection_without_principal_is_bounded() {
        let backlog = Backlog::new(0);
        let (slot, mut cut) = backlog.open(None);
        slot.set_unread(MAX_BYTES_EACH, Timestamp(0));
        assert!(!is_cut(&mut cut));
        slot.set_unread(MAX_BYTES_EACH + 1, Timestamp(0));
        assert!(is_cut(&mut cut));
    }
}
