//! Bytes per second that each principal may send.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use ecod::model::time::Timestamp;

/// Limits the rate of bytes that principals send, for all connections of a principal together.
/// Excess bytes are not lost; the sender waits.
#[derive(Debug, Default)]
pub(super) struct ByteThrottle(Mutex<HashMap<Arc<str>, Timestamp>>);

/// Bytes per second of one principal. A vehicle sends some tens of kilobytes.
const BYTES_PER_S: u64 = 2 * 1024 * 1024;

/// Bytes that are added for each packet, because small packets cost time as well.
const PACKET_BYTES: usize = 1024;

/// Factor on the rate for the leader, which sends maps, and for this machine without certificates,
/// where a cell may run.
const LARGE_SHARE: u64 = 16;

/// Time of silence after which as much may be sent at once: two of the leader's largest maps, or
/// four of a vehicle's largest reports. More would occupy the leader's processor for several
/// rounds.
const BURST: Duration = Duration::from_millis(500);

/// Number of principals from which inactive principals are removed.
const MAX_PRINCIPALS: usize = 4096;

impl ByteThrottle {
    /// Counts received bytes; the result is the time until the principal may send more.
    pub(super) fn charge(
        &self,
        principal: &Arc<str>,
        has_large_share: bool,
        bytes: usize,
        packets: usize,
        now: Timestamp,
    ) -> Duration {
        let mut paid_until = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if paid_until.len() >= MAX_PRINCIPALS {
            paid_until.retain(|_, until| *until > now);
        }
        let rate = BYTES_PER_S * if has_large_share { LARGE_SHARE } else { 1 };
        let cost = (bytes + packets * PACKET_BYTES) as u64 * 1_000_000 / rate;
        let until = paid_until.entry(Arc::clone(principal)).or_insert(now);
        *until = (*until).max(now) + Duration::from_micros(cost);
        until.since(now + BURST)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Bytes sent in a time by two connections that wait as required.
    fn sent(large: bool, packet: usize, seconds: u64) -> usize {
        let throttle = ByteThrottle::default();
        let principal = "gauss".into();
        let mut waits = [Timestamp(0); 2];
        let mut sent = 0;
        loop {
            waits.sort();
            let [now, _] = waits;
            if now > Timestamp(seconds * 1_000_000) {
                return sent;
            }
            sent += packet;
            waits[0] =
                now + throttle.charge(&principal, large, packet, 1, now) + Duration::from_micros(1);
        }
    }

    #[test]
    fn connections_of_principal_share_rate() {
        let mib = |bytes: usize| bytes as f64 / f64::from(1 << 20);
        let long = mib(sent(false, 64 * 1024, 20));
        let short = mib(sent(false, 64 * 1024, 10));
        assert!(
            (19.0..21.0).contains(&(long - short)),
            "2 MiB a second: {long} {short}"
        );
        assert!((20.5..21.5).contains(&short), "and a burst: {short}");
        assert!((320.0..345.0).contains(&mib(sent(true, 64 * 1024, 10))));
        assert!(sent(false, 2, 10) < 2 * 30_000, "empty packets are few");
    }
}
