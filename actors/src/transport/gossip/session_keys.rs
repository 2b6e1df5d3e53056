//! Keys of one session with another node, old and new ones, each with its replay window.

use super::counters::FrameEvent;
use super::frame::{FrameHeader, HEADER_BYTES};
use super::key::FrameCipher;
use super::replay_window::ReplayWindow;

/// Keys resulting from one handshake, for both directions.
pub(crate) struct KeySet {
    pub(crate) to: FrameCipher,
    pub(crate) from: FrameCipher,
    pub(crate) window: ReplayWindow,
    /// True if the other side has proven that it has these keys: it has used them, or it created
    /// them.
    pub(crate) is_confirmed: bool,
}

/// The keys in use with a node. Both sides may start a handshake at once, and the last message of
/// one may be lost. Therefore the keys of the last handshakes all open frames, and the latest keys
/// that the other side certainly has seal them.
pub(crate) struct KeyRing {
    /// Latest first.
    sets: Vec<KeySet>,
}

/// Number of handshakes whose keys are kept: two simultaneous ones, and the previous one.
const MAX_SETS: usize = 3;

impl KeyRing {
    pub(crate) fn new(first: KeySet) -> Self {
        Self { sets: vec![first] }
    }

    /// Adds the keys of another handshake; the oldest keys are dropped.
    pub(crate) fn add(&mut self, keys: KeySet) {
        self.sets.insert(0, keys);
        self.sets.truncate(MAX_SETS);
    }

    /// The cipher for the next frame.
    pub(crate) fn to(&self) -> Option<&FrameCipher> {
        let latest = self
            .sets
            .iter()
            .find(|keys| keys.is_confirmed)
            .or_else(|| self.sets.first());
        latest.map(|keys| &keys.to)
    }

    /// The body of a frame, if one of the keys opens it, and whether its counter is accepted.
    pub(crate) fn open(
        &mut self,
        head: &FrameHeader,
        frame: &[u8],
    ) -> Option<(Vec<u8>, Result<(), FrameEvent>)> {
        let (open, sealed) = frame.split_at_checked(HEADER_BYTES)?;
        self.sets.iter_mut().find_map(|keys| {
            let body = keys.from.open(head.counter, open, sealed)?;
            keys.is_confirmed = true;
            Some((body, keys.window.accept(head.counter)))
        })
    }

    /// Records the counter of a frame that was opened by other means.
    pub(crate) fn accept(&mut self, counter: u64) -> Result<(), FrameEvent> {
        self.sets
            .first_mut()
            .map_or(Ok(()), |keys| keys.window.accept(counter))
    }

    /// Continues after a counter that a handshake has proven.
    pub(crate) fn skip_to(&mut self, counter: u64) {
        self.sets
            .iter_mut()
            .for_each(|keys| keys.window.skip_to(counter));
    }
}
