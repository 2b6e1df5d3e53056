//! Replay protection by frame counters.

/// Accepts every frame counter once, and none that is 128 or more behind the highest.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct ReplayWindow {
    highest: u64,
    /// Bit n: the frame n before the highest was accepted.
    taken: u128,
}

impl ReplayWindow {
    /// A window that accepts only counters above `floor`.
    pub(crate) fn after(floor: u64) -> Self {
        Self { highest: floor, taken: u128::MAX }
    }

    /// Accepts a counter; false when it was accepted before or is too old.
    pub(crate) fn take(&mut self, counter: u64) -> bool {
        if let Some(ahead) = counter.checked_sub(self.highest).filter(|ahead| *ahead > 0) {
            self.taken = u32::try_from(ahead).ok().and_then(|ahead| self.taken.checked_shl(ahead)).unwrap_or(0) | 1;
            self.highest = counter;
            return true;
        }
        let behind = self.highest - counter;
        let new = behind < u64::from(u128::BITS) && self.taken >> behind & 1 == 0;
        if new {
            self.taken |= 1 << behind;
        }
        new
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use proptest::prelude::*;

    use super::*;

    #[test]
    fn late_frames_are_taken_once_and_very_late_ones_not() {
        let mut window = ReplayWindow::after(100);
        assert!(!window.take(100) && !window.take(99) && !window.take(0), "before the session began");
        assert!(window.take(102) && window.take(101) && !window.take(101) && !window.take(102));
        assert!(window.take(102 + 127) && !window.take(101), "fell out of the window");
        assert!(window.take(103) && window.take(u64::MAX) && !window.take(u64::MAX));
    }

    proptest! {
        #[test]
        fn no_frame_is_taken_twice(floor in 0u64..200, counters in prop::collection::vec(0u64..400, 0..400)) {
            let mut window = ReplayWindow::after(floor);
            let mut taken = BTreeSet::new();
            for counter in counters {
                let recent = taken.last().is_none_or(|highest| counter + 128 > *highest) && counter + 128 > floor;
                let new = window.take(counter);
                prop_assert_eq!(new, counter > floor && recent && !taken.contains(&counter));
                if new {
                    taken.insert(counter);
                }
            }
        }
    }
}
