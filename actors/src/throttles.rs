//! A steady rate for each of many sources.

use std::collections::BTreeMap;
use std::net::IpAddr;
use std::time::Duration;

use ecod::time::Timestamp;

use crate::membership::Throttle;

/// Allows every source as many messages a second, and as many at once after a second of silence.
#[derive(Debug)]
pub(crate) struct Throttles<K> {
    per_second: u32,
    sources: BTreeMap<K, Throttle>,
}

/// Most sources that are remembered. While as many are busy at a time, further ones are not allowed anything.
const MAX_SOURCES: usize = 8192;

impl<K: Ord + Clone> Throttles<K> {
    pub(crate) fn new(per_second: u32) -> Self {
        Self { per_second: per_second.max(1), sources: BTreeMap::new() }
    }

    /// Whether the source is allowed one more message now.
    pub(crate) fn allow(&mut self, source: &K, now: Timestamp) -> bool {
        if let Some(throttle) = self.sources.get_mut(source) {
            return throttle.allow(now);
        }
        if self.sources.len() >= MAX_SOURCES {
            self.sources.retain(|_, throttle| !throttle.is_rested(now));
        }
        if self.sources.len() >= MAX_SOURCES {
            return false;
        }
        let mut throttle = Throttle::new(self.per_second, Duration::from_secs(1) / self.per_second, now);
        let allowed = throttle.allow(now);
        self.sources.insert(source.clone(), throttle);
        allowed
    }
}

/// What counts as one source: an IPv4 address, or the network of an IPv6 host, which has 2⁶⁴ addresses to choose from.
pub(crate) fn source(address: IpAddr) -> IpAddr {
    match address.to_canonical() {
        IpAddr::V4(v4) => IpAddr::V4(v4),
        IpAddr::V6(v6) => IpAddr::V6((u128::from(v6) >> 64 << 64).into()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_source_does_not_use_up_what_another_has() {
        let mut throttles = Throttles::new(10);
        let mut allowed =
            |source, ms: u64| (0..1000).filter(|_| throttles.allow(&source, Timestamp(ms * 1000))).count();
        assert_eq!([allowed("a", 0), allowed("b", 0), allowed("a", 500), allowed("b", 5000)], [10, 10, 5, 10]);
    }

    #[test]
    fn sources_that_rest_make_room() {
        let mut throttles = Throttles::new(10);
        assert!((0..MAX_SOURCES).all(|source| throttles.allow(&source, Timestamp(0))));
        assert!(!throttles.allow(&MAX_SOURCES, Timestamp(0)));
        assert!(throttles.allow(&MAX_SOURCES, Timestamp(1_000_000)));
    }
}
