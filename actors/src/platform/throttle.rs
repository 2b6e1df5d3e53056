//! Rate limits: of one source, or of each of many.

use std::collections::BTreeMap;
use std::net::IpAddr;
use std::time::Duration;

use ecod::model::time::Timestamp;

/// Allows a burst, then one per interval.
#[derive(Debug, Clone)]
pub(crate) struct TokenBucket {
    tokens: u32,
    burst: u32,
    interval: Duration,
    refilled_at: Timestamp,
}

impl TokenBucket {
    pub(crate) fn new(burst: u32, interval: Duration, now: Timestamp) -> Self {
        Self {
            tokens: burst,
            burst,
            interval,
            refilled_at: now,
        }
    }

    /// True if a whole burst is allowed now.
    pub(crate) fn is_full(&self, now: Timestamp) -> bool {
        now.since(self.refilled_at) >= self.interval * self.burst.saturating_sub(self.tokens)
    }

    /// Takes a token; returns false if there are no tokens left.
    pub(crate) fn allow(&mut self, now: Timestamp) -> bool {
        self.allow_many(1, now)
    }

    /// Takes `count` tokens at once; returns false, without taking any, if there are fewer.
    pub(crate) fn allow_many(&mut self, count: u32, now: Timestamp) -> bool {
        let intervals = now.since(self.refilled_at).as_micros() / self.interval.as_micros().max(1);
        let earned = u32::try_from(intervals).unwrap_or(u32::MAX);
        self.refilled_at = if self.tokens.saturating_add(earned) >= self.burst {
            now
        } else {
            self.refilled_at + self.interval * earned
        };
        self.tokens = self.tokens.saturating_add(earned).min(self.burst);
        let allowed = self.tokens >= count;
        if allowed {
            self.tokens -= count;
        }
        allowed
    }
}

/// Token buckets by source, all with the same rate.
#[derive(Debug)]
pub struct KeyedThrottle<K> {
    burst: u32,
    interval: Duration,
    max_sources: usize,
    sources: BTreeMap<K, TokenBucket>,
}

/// Default maximum of sources with a bucket. While all buckets are busy, further sources are
/// denied.
const MAX_SOURCES: usize = 8192;

impl<K: Ord + Clone> KeyedThrottle<K> {
    pub(crate) fn new(burst: u32, interval: Duration) -> Self {
        Self {
            burst,
            interval,
            max_sources: MAX_SOURCES,
            sources: BTreeMap::new(),
        }
    }

    /// A throttle whose burst equals its rate per second.
    pub fn per_second(count: u32) -> Self {
        Self::new(count.max(1), Duration::from_secs(1) / count.max(1))
    }

    /// The same throttle with buckets for at most `max_sources` sources.
    #[must_use]
    pub fn with_max_sources(self, max_sources: usize) -> Self {
        Self {
            max_sources,
            ..self
        }
    }

    /// Takes a token of a source; returns false if there are no tokens left.
    pub fn allow(&mut self, source: &K, now: Timestamp) -> bool {
        self.allow_many(source, 1, now)
    }

    /// Takes `count` tokens of a source at once; returns false, without taking any, if there are
    /// fewer.
    pub(crate) fn allow_many(&mut self, source: &K, count: u32, now: Timestamp) -> bool {
        if let Some(throttle) = self.sources.get_mut(source) {
            return throttle.allow_many(count, now);
        }
        if self.sources.len() >= self.max_sources {
            self.sources.retain(|_, throttle| !throttle.is_full(now));
        }
        if self.sources.len() >= self.max_sources {
            return false;
        }
        let mut throttle = TokenBucket::new(self.burst, self.interval, now);
        let allowed = throttle.allow_many(count, now);
        self.sources.insert(source.clone(), throttle);
        allowed
    }
}

/// Tokens of the largest report among the reports of a vehicle: decoding it costs as much processor
/// time as that many small ones, whether or not it is fused.
const LARGEST_REPORT: u32 = 12;

/// Size in bytes of boxes that take a token, about 90 in JSON: they are decoded, projected, and
/// encoded as reports.
const BOX_BYTES_EACH: usize = 6 * 1024;

/// Tokens of a report of `bytes`, if the largest has `max_bytes`; at least 1.
pub(crate) fn tokens_of_report(bytes: usize, max_bytes: usize) -> u32 {
    let share = bytes.min(max_bytes) as f64 / max_bytes.max(1) as f64;
    ((share * f64::from(LARGEST_REPORT)) as u32).max(1)
}

/// Tokens of a message with boxes; at least 1.
pub(crate) fn tokens_of_boxes(bytes: usize) -> u32 {
    u32::try_from(bytes / BOX_BYTES_EACH).map_or(u32::MAX, |tokens| tokens.max(1))
}

/// Address under which a host is counted: its IPv4 address, or its IPv6 /64 network, which has 2⁶⁴
/// addresses to choose from.
pub(crate) fn host_network(address: IpAddr) -> IpAddr {
    match address.to_canonical() {
        IpAddr::V4(v4) => IpAddr::V4(v4),
        IpAddr::V6(v6) => IpAddr::V6((u128::from(v6) >> 64 << 64).into()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sources_have_separate_rates() {
        let mut throttles = KeyedThrottle::per_second(10);
        let mut allowed = |source, ms: u64| {
            (0..1000)
                .filter(|_| throttles.allow(&source, Timestamp(ms * 1000)))
                .count()
        };
        assert_eq!(
            [
                allowed("a", 0),
                allowed("b", 0),
                allowed("a", 500),
                allowed("b", 5000)
            ],
            [10, 10, 5, 10]
        );
    }

    #[test]
    fn sources_that_rest_make_room() {
        let mut throttles = KeyedThrottle::per_second(10).with_max_sources(100);
        assert!((0..100).all(|source| throttles.allow(&source, Timestamp(0))));
        assert!(!throttles.allow(&100, Timestamp(0)));
        assert!(throttles.allow(&100, Timestamp(1_000_000)));
    }

    #[test]
    fn burst_is_allowed_then_limited() {
        let mut throttle = TokenBucket::new(3, Duration::from_millis(10), Timestamp(0));
        let mut allowed = |ms: u64| {
            (0..100)
                .filter(|_| throttle.allow(Timestamp(ms * 1000)))
                .count()
        };
        assert_eq!(
            [
                allowed(0),
                allowed(5),
                allowed(10),
                allowed(35),
                allowed(10_000)
            ],
            [3, 0, 1, 2, 3]
        );
    }
}
