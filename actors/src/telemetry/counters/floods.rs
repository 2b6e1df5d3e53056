//! Distinction between a flood and a burst: after a change of link or leader, messages that have
//! waited arrive in a moment.

use std::collections::BTreeMap;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use ecod::model::time::Timestamp;

/// Sources that exceed a limit.
#[derive(Debug)]
pub(super) struct Floods<K>(Mutex<BTreeMap<K, BTreeMap<String, Excess>>>);

/// The time in which a source has exceeded a limit again and again.
#[derive(Debug, Clone, Copy)]
struct Excess {
    since: Timestamp,
    last: Timestamp,
}

/// Time from which an excess is a flood. What waits for a link or leader arrives within a second.
const FLOOD_TIME: Duration = Duration::from_secs(3);

/// Pause after which an excess is over.
const PAUSE: Duration = Duration::from_secs(1);

/// Most sources per limit; while there are as many, further sources are floods at once.
const MAX_SOURCES: usize = 64;

impl<K> Default for Floods<K> {
    fn default() -> Self {
        Self(Mutex::default())
    }
}

impl<K: Copy + Ord> Floods<K> {
    /// Records that a source exceeds a limit; true if it has done so for long.
    pub(super) fn is_flood(&self, limit: K, source: &str, now: Timestamp) -> bool {
        let mut all = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let sources = all.entry(limit).or_default();
        if let Some(excess) = sources.get_mut(source) {
            if now.since(excess.last) > PAUSE {
                excess.since = now;
            }
            excess.last = now;
            return now.since(excess.since) >= FLOOD_TIME;
        }
        if sources.len() >= MAX_SOURCES {
            sources.retain(|_, excess| now.since(excess.last) <= PAUSE);
        }
        if sources.len() >= MAX_SOURCES {
            return true;
        }
        let excess = Excess {
            since: now,
            last: now,
        };
        sources.insert(source.to_owned(), excess);
        false
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn flood_lasts_until_pause() {
        let floods = Floods::default();
        let at = |ms: u64| Timestamp(1_000_000_000 + ms * 1000);
        let burst = (0..1000).any(|ms| floods.is_flood("reports", "euclid", at(ms)));
        assert!(!burst, "one second");
        assert!(
            !floods.is_flood("reports", "euclid", at(3500)),
            "another burst"
        );
        let flood = |ms| floods.is_flood("reports", "mallory", at(ms));
        assert!(!(0..29).any(|step| flood(step * 100)));
        assert!((30..50).all(|step| flood(step * 100)));
        assert!(!flood(7000), "after a pause");
    }

    #[test]
    fn many_sources_use_bounded_memory() {
        let floods = Floods::default();
        let name = |number: usize| format!("node-{number}");
        let first = (0..MAX_SOURCES).any(|n| floods.is_flood(1, &name(n), Timestamp(0)));
        assert!(!first);
        assert!(floods.is_flood(1, "one more", Timestamp(1)));
        assert!(
            !floods.is_flood(1, "one more", Timestamp(2_000_000)),
            "there is room again"
        );
    }
}
