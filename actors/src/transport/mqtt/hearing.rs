//! Incoming packets of a link, counted for the gateway: shows whether a broker forwards messages.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

/// Counter of the packets read by a link's task, for the gateway.
#[derive(Debug, Default)]
pub(crate) struct Hearing {
    packets: AtomicU64,
    is_missed: AtomicBool,
}

impl Hearing {
    /// Records a received packet; returns true if the broker counted as stalled.
    pub(crate) fn record(&self) -> bool {
        self.packets.fetch_add(1, Ordering::AcqRel);
        self.is_missed.load(Ordering::Acquire) && self.is_missed.swap(false, Ordering::AcqRel)
    }

    /// Requests a notification when the next packet is received.
    pub(crate) fn miss(&self) {
        self.is_missed.store(true, Ordering::Release);
    }

    pub(crate) fn packets(&self) -> u64 {
        self.packets.load(Ordering::Acquire)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stall_end_is_reported_once() {
        let hearing = Hearing::default();
        assert!(!hearing.record());
        hearing.miss();
        assert!(hearing.record() && !hearing.record());
        assert_eq!(hearing.packets(), 3);
    }
}
