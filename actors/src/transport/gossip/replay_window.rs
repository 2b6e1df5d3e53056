//! Replay protection by frame counters.

use super::counters::FrameEvent;

/// Largest step by which one frame moves a window. The counter counts all frames of a sender, so it
/// may be far ahead for a node that was unreachable. A forged counter near the end would mute the
/// sender.
const MAX_JUMP: u64 = 1 << 20;

/// Accepts every frame counter once; refuses counters that are 128 or more behind the highest, or
/// far ahead of it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct ReplayWindow {
    highest: u64,
    /// Bit n: the frame n before the highest was accepted.
    taken: u128,
}

impl ReplayWindow {
    /// A window that accepts only counters above `floor`.
    pub(crate) fn after(floor: u64) -> Self {
        Self {
            highest: floor,
            taken: u128::MAX,
        }
    }

    /// Accepts a counter.
    ///
    /// # Errors
    /// Returns [`FrameEvent::Replayed`] if it was accepted before or is too old,
    /// [`FrameEvent::CounterJump`] when it is too far ahead. The window is then as before.
    pub(crate) fn accept(&mut self, counter: u64) -> Result<(), FrameEvent> {
        if let Some(ahead) = counter.checked_sub(self.highest).filter(|ahead| *ahead > 0) {
            if ahead > MAX_JUMP {
                return Err(FrameEvent::CounterJump);
            }
            self.taken = u32::try_from(ahead)
                .ok()
                .and_then(|ahead| self.taken.checked_shl(ahead))
                .unwrap_or(0)
                | 1;
            self.highest = counter;
            return Ok(());
        }
        let behind = self.highest - counter;
        if behind >= u64::from(u128::BITS) || self.taken >> behind & 1 == 1 {
            return Err(FrameEvent::Replayed);
        }
        self.taken |= 1 << behind;
        Ok(())
    }

    /// Continues after a counter that a fresh handshake has proven, however far ahead. The window
    /// does not go back.
    pub(crate) fn skip_to(&mut self, counter: u64) {
        if counter > self.highest {
            *self = Self::after(counter);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use proptest::prelude::*;

    use super::*;

    #[test]
    fn late_frames_are_accepted_once() {
        let mut window = ReplayWindow::after(100);
        let mut accept = |counter| window.accept(counter).is_ok();
        assert!(
            !accept(100) && !accept(99) && !accept(0),
            "before the session began"
        );
        assert!(accept(102) && accept(101) && !accept(101) && !accept(102));
        assert!(accept(102 + 127) && !accept(101), "fell out of the window");
        assert!(accept(103) && accept(229 + MAX_JUMP) && !accept(229 + MAX_JUMP));
    }

    #[test]
    fn counter_jump_needs_handshake() {
        let mut window = ReplayWindow::after(100);
        for counter in [u64::MAX, 101 + MAX_JUMP] {
            assert_eq!(window.accept(counter), Err(FrameEvent::CounterJump));
        }
        assert_eq!(window.accept(101), Ok(()));
        window.skip_to(u64::MAX - 1);
        assert_eq!(window.accept(102), Err(FrameEvent::Replayed));
        assert_eq!(window.accept(u64::MAX), Ok(()));
        window.skip_to(5);
        assert_eq!(
            window.accept(u64::MAX),
            Err(FrameEvent::Replayed),
            "the window does not move back"
        );
    }

    proptest! {
        #[test]
        fn no_frame_is_taken_twice(floor in 0u64..200, counters in prop::collection::vec(0u64..400, 0..400)) {
            let mut window = ReplayWindow::after(floor);
            let mut taken = BTreeSet::new();
            for counter in counters {
                let recent = taken.last().is_none_or(|highest| counter + 128 > *highest) && counter + 128 > floor;
                let new = window.accept(counter).is_ok();
                prop_assert_eq!(new, counter > floor && recent && !taken.contains(&counter));
                if new {
                    taken.insert(counter);
                }
            }
        }
    }
}
