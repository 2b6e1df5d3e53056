//! How many strangers may knock, and how often.

use std::collections::HashMap;
use std::net::IpAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use ecod::time::Timestamp;

use crate::membership::Throttle;

/// Limits connections that have not logged in yet, by source address and in all.
#[derive(Debug, Clone)]
pub(super) struct Admission(Arc<Mutex<Sources>>);

#[derive(Debug)]
struct Sources {
    by_address: HashMap<IpAddr, Source>,
    /// For addresses beyond those that are remembered.
    others: Throttle,
    pending: usize,
    pruned: Timestamp,
    rate: Rate,
}

#[derive(Debug)]
struct Source {
    throttle: Throttle,
    pending: usize,
    seen: Timestamp,
}

/// A burst, then one for every interval.
#[derive(Debug, Clone, Copy)]
pub(super) struct Rate {
    pub(super) burst: u32,
    pub(super) interval: Duration,
}

/// Most connections of one address, and of all, that have not logged in.
const MAX_PENDING_EACH: usize = 32;
const MAX_PENDING: usize = 1024;

/// Most addresses that are remembered.
const MAX_SOURCES: usize = 4096;

/// Least time between two looks for addresses to forget: looking at all for every connection would be an attack's aim.
const PRUNE: Duration = Duration::from_secs(1);

/// A connection that was let in to log in; its place is free when dropped.
#[derive(Debug)]
pub(super) struct Ticket {
    admission: Admission,
    source: IpAddr,
}

impl Admission {
    pub(super) fn new(rate: Rate, now: Timestamp) -> Self {
        let others = Throttle::new(rate.burst, rate.interval, now);
        Self(Arc::new(Mutex::new(Sources { by_address: HashMap::new(), others, pending: 0, pruned: now, rate })))
    }

    /// Lets a connection in, or not.
    pub(super) fn admit(&self, address: IpAddr, now: Timestamp) -> Option<Ticket> {
        let source = source(address);
        let admitted = self.sources().admit(source, now);
        admitted.then(|| Ticket { admission: self.clone(), source })
    }

    fn sources(&self) -> MutexGuard<'_, Sources> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Sources {
    fn admit(&mut self, source: IpAddr, now: Timestamp) -> bool {
        if self.pending >= MAX_PENDING {
            return false;
        }
        let Rate { burst, interval } = self.rate;
        if self.by_address.len() >= MAX_SOURCES && !self.by_address.contains_key(&source) {
            // Whose burst is whole again need not be remembered.
            if now.since(self.pruned) >= PRUNE {
                self.pruned = now;
                self.by_address.retain(|_, known| known.pending > 0 || now.since(known.seen) < interval * burst);
            }
            if self.by_address.len() >= MAX_SOURCES {
                let admitted = self.others.allow(now);
                self.pending += usize::from(admitted);
                return admitted;
            }
        }
        let fresh = || Source { throttle: Throttle::new(burst, interval, now), pending: 0, seen: now };
        let known = self.by_address.entry(source).or_insert_with(fresh);
        known.seen = now;
        let admitted = known.throttle.allow(now) && known.pending < MAX_PENDING_EACH;
        known.pending += usize::from(admitted);
        self.pending += usize::from(admitted);
        admitted
    }
}

impl Drop for Ticket {
    fn drop(&mut self) {
        let mut sources = self.admission.sources();
        sources.pending = sources.pending.saturating_sub(1);
        if let Some(known) = sources.by_address.get_mut(&self.source) {
            known.pending = known.pending.saturating_sub(1);
        }
    }
}

/// What counts as one source: an IPv4 address, or the network of an IPv6 host, which has 2⁶⁴ addresses to choose from.
pub(super) fn source(address: IpAddr) -> IpAddr {
    match address.to_canonical() {
        IpAddr::V4(v4) => IpAddr::V4(v4),
        IpAddr::V6(v6) => IpAddr::V6((u128::from(v6) >> 64 << 64).into()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RATE: Rate = Rate { burst: 100, interval: Duration::from_millis(100) };

    fn at(ms: u64) -> Timestamp {
        Timestamp(ms * 1000)
    }

    fn ip(text: &str) -> IpAddr {
        text.parse().unwrap()
    }

    #[test]
    fn one_address_uses_up_its_own_share_only() {
        let admission = Admission::new(Rate { burst: 3, ..RATE }, at(0));
        let admitted = |address, ms| (0..9).filter(|_| admission.admit(ip(address), at(ms)).is_some()).count();
        assert_eq!([admitted("10.0.0.1", 0), admitted("10.0.0.2", 0), admitted("10.0.0.1", 100)], [3, 3, 1]);
        assert_eq!([admitted("fd00::1:1", 0), admitted("fd00::2:2", 0)], [3, 0], "one network");
        assert_eq!(admitted("::ffff:10.0.0.2", 0), 0, "the same host by the other protocol");
    }

    #[test]
    fn connections_that_do_not_log_in_are_few_and_end_makes_room() {
        let admission = Admission::new(RATE, at(0));
        let mut held: Vec<_> = (0..40).filter_map(|_| admission.admit(ip("10.0.0.1"), at(0))).collect();
        assert_eq!(held.len(), MAX_PENDING_EACH);
        held.pop();
        assert!(admission.admit(ip("10.0.0.1"), at(0)).is_some());
    }

    #[test]
    fn any_number_of_addresses_costs_bounded_memory() {
        let admission = Admission::new(RATE, at(0));
        for n in 0..2 * MAX_SOURCES as u32 {
            drop(admission.admit(IpAddr::V4(n.into()), at(0)));
        }
        assert_eq!(admission.sources().by_address.len(), MAX_SOURCES);
        assert!(admission.admit(IpAddr::V4(u32::MAX.into()), at(60_000)).is_some(), "the old are forgotten");
        let sources = admission.sources();
        assert_eq!((sources.by_address.len(), sources.pending), (1, 0));
    }
}
