//! Incoming packets of a link, counted for the gateway: shows whether a broker forwards messages.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

/// Counter of the packets read by a link's task, for the gateway.
#[derive(Debug, Default)]
pub(crate) struct PacketCounter {
    packets: AtomicU64,
    is_awaited: AtomicBool,
}

impl PacketCounter {
    /// Records a received packet; returns true if the broker counted as stalled.
    pub(crate) fn record(&self) -> bool {
        self.packets.fetch_add(1, Ordering::AcqRel);
        self.is_awaited.load(Ordering::Acquire) && self.is_awaited.swap(false, Ordering::AcqRel)
    }

    /// Requests a notification when the next packet is received.
    pub(crate) fn notify_next(&self) {
        self.is_awaited.store(true, Ordering::Release);
    }

    pub(crate) fn count(&self) -> u64 {
        self.packets.load(Ordering::Acquire)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stall_end_is_reported_once() {
        let counter = PacketCounter::default();
        assert!(!counter.record());
        counter.notify_next();
        assert!(counter.record() && !counter.record());
        assert_eq!(counter.count(), 3);
    }
}
