//! Incoming packets of a link, counted for the gateway: whether a broker passes anything on.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

/// Counter of what a link's task reads, for the gateway to see.
#[derive(Debug, Default)]
pub(crate) struct Hearing {
    packets: AtomicU64,
    is_missed: AtomicBool,
}

impl Hearing {
    /// Notes that something came in; true when the broker was taken for stalled.
    pub(crate) fn note(&self) -> bool {
        self.packets.fetch_add(1, Ordering::AcqRel);
        self.is_missed.load(Ordering::Acquire) && self.is_missed.swap(false, Ordering::AcqRel)
    }

    /// Asks to be told when something comes in.
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
    fn the_end_of_a_stall_is_told_once() {
        let hearing = Hearing::default();
        assert!(!hearing.note());
        hearing.miss();
        assert!(hearing.note() && !hearing.note());
        assert_eq!(hearing.packets(), 3);
    }
}
