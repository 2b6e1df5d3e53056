//! How many strangers may knock, and how often.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::net::{IpAddr, Ipv4Addr};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use ecod::time::Timestamp;
use tokio::sync::oneshot;

use crate::platform::clock;
use crate::platform::throttle::{TokenBucket, host_network};

/// Limits connections that have not logged in yet, by source address and in all. Where too many wait, the oldest gives
/// way: whoever means to log in does so at once.
#[derive(Debug, Clone)]
pub(super) struct ConnectionThrottle(Arc<Mutex<AddressTable>>);

#[derive(Debug)]
struct AddressTable {
    by_address: HashMap<IpAddr, AddressEntry>,
    /// For addresses beyond those that are remembered.
    overflow: TokenBucket,
    pending: BTreeMap<Number, Pending>,
    next: Number,
    pruned: Timestamp,
    rate: Rate,
}

/// Counts connections in the order in which they came.
type Number = u64;

#[derive(Debug)]
struct Pending {
    source: IpAddr,
    /// Dropped with it, which tells the connection.
    _place: oneshot::Sender<()>,
}

#[derive(Debug)]
struct AddressEntry {
    throttle: TokenBucket,
    pending: BTreeSet<Number>,
    seen: Timestamp,
    /// Until when it is remembered that a client of this address was logged in.
    privileged_until: Timestamp,
}

/// A burst, then one for every interval.
#[derive(Debug, Clone, Copy)]
pub(super) struct Rate {
    pub(super) burst: u32,
    pub(super) interval: Duration,
}

/// Where a connection comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Origin {
    /// From an address that has its share.
    Remote(IpAddr),
    /// From this machine, where a whole cell may run, and nothing tells its nodes apart: only those that wait are
    /// limited.
    Local,
}

/// Most connections of one address, of this machine, and of all, that have not logged in.
const MAX_PENDING_PER_ADDRESS: usize = 32;
const MAX_PENDING_LOCAL: usize = 256;
const MAX_PENDING: usize = 1024;

/// How many times the rate of a stranger an address has from which a client has logged in, and for how long after: a
/// flood from a node's own address, such as behind address translation, is to leave something for the node.
const PRIVILEGED_FACTOR: u32 = 10;
const PRIVILEGED_FOR: Duration = Duration::from_secs(3600);

/// Most addresses that are remembered.
const MAX_SOURCES: usize = 4096;

/// Least time between two looks for addresses to forget: looking at all for every connection would be an attack's aim.
const PRUNE_INTERVAL: Duration = Duration::from_secs(1);

/// A connection that was let in to log in; its place is free when dropped.
#[derive(Debug)]
pub(super) struct LoginSlot {
    throttle: ConnectionThrottle,
    source: IpAddr,
    number: Number,
    evicted: oneshot::Receiver<()>,
}

/// A connection that has logged in.
#[derive(Debug)]
pub(super) struct LoggedInConnection {
    throttle: ConnectionThrottle,
    source: IpAddr,
}

impl ConnectionThrottle {
    pub(super) fn new(rate: Rate, now: Timestamp) -> Self {
        let (by_address, pending) = (HashMap::new(), BTreeMap::new());
        let overflow = TokenBucket::new(rate.burst, rate.interval, now);
        Self(Arc::new(Mutex::new(AddressTable { by_address, overflow, pending, next: 0, pruned: now, rate })))
    }

    /// Lets a connection in, or not.
    pub(super) fn admit(&self, from: Origin, now: Timestamp) -> Option<LoginSlot> {
        let (source, most) = match from {
            Origin::Remote(address) => (host_network(address), MAX_PENDING_PER_ADDRESS),
            Origin::Local => (IpAddr::V4(Ipv4Addr::LOCALHOST), MAX_PENDING_LOCAL),
        };
        let (number, evicted) = self.table().admit(source, from == Origin::Local, most, now)?;
        Some(LoginSlot { throttle: self.clone(), source, number, evicted })
    }

    fn table(&self) -> MutexGuard<'_, AddressTable> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl AddressTable {
    fn admit(
        &mut self,
        source: IpAddr,
        is_unthrottled: bool,
        most: usize,
        now: Timestamp,
    ) -> Option<(Number, oneshot::Receiver<()>)> {
        let number = self.next;
        let allowed = match self.entry(source, now) {
            Some(entry) => {
                let allowed = is_unthrottled || entry.throttle.allow(now);
                let oldest = entry.pending.first().copied().filter(|_| allowed && entry.pending.len() >= most);
                if allowed {
                    entry.pending.insert(number);
                }
                oldest.inspect(|oldest| self.remove(*oldest));
                allowed
            }
            None => self.overflow.allow(now),
        };
        if !allowed {
            return None;
        }
        if self.pending.len() >= MAX_PENDING
            && let Some(oldest) = self.pending.keys().next().copied()
        {
            self.remove(oldest);
        }
        self.next += 1;
        let (place, evicted) = oneshot::channel();
        self.pending.insert(number, Pending { source, _place: place });
        Some((number, evicted))
    }

    /// What is remembered of an address; nothing when there is no room for one more.
    fn entry(&mut self, source: IpAddr, now: Timestamp) -> Option<&mut AddressEntry> {
        let Rate { burst, interval } = self.rate;
        if self.by_address.len() >= MAX_SOURCES && !self.by_address.contains_key(&source) {
            // Whose burst is whole again need not be remembered.
            if now.since(self.pruned) >= PRUNE_INTERVAL {
                self.pruned = now;
                let is_rested =
                    |entry: &AddressEntry| entry.pending.is_empty() && now.since(entry.seen) >= interval * burst;
                self.by_address.retain(|_, entry| now < entry.privileged_until || !is_rested(entry));
            }
            if self.by_address.len() >= MAX_SOURCES {
                return None;
            }
        }
        let throttle = || TokenBucket::new(burst, interval, now);
        let fresh = || AddressEntry {
            throttle: throttle(),
            pending: BTreeSet::new(),
            seen: now,
            privileged_until: Timestamp::default(),
        };
        let entry = self.by_address.entry(source).or_insert_with(fresh);
        entry.seen = now;
        Some(entry)
    }

    /// Notes that a client of the address is, or was until now, logged in.
    fn note_login(&mut self, source: IpAddr, now: Timestamp) {
        let Rate { burst, interval } = self.rate;
        let Some(entry) = self.entry(source, now) else { return };
        if now >= entry.privileged_until {
            entry.throttle =
                TokenBucket::new(burst.saturating_mul(PRIVILEGED_FACTOR), interval / PRIVILEGED_FACTOR, now);
        }
        entry.privileged_until = now + PRIVILEGED_FOR;
    }

    fn remove(&mut self, number: Number) {
        let Some(pending) = self.pending.remove(&number) else { return };
        if let Some(entry) = self.by_address.get_mut(&pending.source) {
            entry.pending.remove(&number);
        }
    }
}

impl LoginSlot {
    /// Waits until a newer connection has taken the place of this one.
    pub(super) async fn evicted(&mut self) {
        // It ends by the sender's end.
        (&mut self.evicted).await.unwrap_or_default();
    }

    /// Gives the place back: the client has logged in.
    pub(super) fn log_in(self) -> LoggedInConnection {
        self.throttle.table().note_login(self.source, clock::now());
        LoggedInConnection { throttle: self.throttle.clone(), source: self.source }
    }
}

impl Drop for LoginSlot {
    fn drop(&mut self) {
        self.throttle.table().remove(self.number);
    }
}

impl Drop for LoggedInConnection {
    fn drop(&mut self) {
        self.throttle.table().note_login(self.source, clock::now());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RATE: Rate = Rate { burst: 100, interval: Duration::from_millis(100) };

    fn at(ms: u64) -> Timestamp {
        Timestamp(ms * 1000)
    }

    fn from(text: &str) -> Origin {
        Origin::Remote(text.parse().unwrap())
    }

    fn evicted(tickets: &mut [LoginSlot]) -> Vec<usize> {
        let is_displaced = |slot: &mut LoginSlot| slot.evicted.try_recv() == Err(oneshot::error::TryRecvError::Closed);
        tickets.iter_mut().enumerate().filter_map(|(n, slot)| is_displaced(slot).then_some(n)).collect()
    }

    #[test]
    fn one_address_uses_up_its_own_share_only() {
        let throttle = ConnectionThrottle::new(Rate { burst: 3, ..RATE }, at(0));
        let admitted = |address, ms| (0..9).filter(|_| throttle.admit(from(address), at(ms)).is_some()).count();
        assert_eq!([admitted("10.0.0.1", 0), admitted("10.0.0.2", 0), admitted("10.0.0.1", 100)], [3, 3, 1]);
        assert_eq!([admitted("fd00::1:1", 0), admitted("fd00::2:2", 0)], [3, 0], "one network");
        assert_eq!(admitted("::ffff:10.0.0.2", 0), 0, "the same host by the other protocol");
    }

    #[test]
    fn where_too_many_wait_the_oldest_gives_way_to_the_newest() {
        let throttle = ConnectionThrottle::new(RATE, at(0));
        let other = throttle.admit(from("10.0.0.2"), at(0)).unwrap();
        let mut held: Vec<_> = (0..40).filter_map(|_| throttle.admit(from("10.0.0.1"), at(0))).collect();
        assert_eq!(evicted(&mut held), (0..40 - MAX_PENDING_PER_ADDRESS).collect::<Vec<_>>());
        assert!(evicted(&mut [other]).is_empty(), "of its own address only");
        drop(held.pop());
        held.extend(throttle.admit(from("10.0.0.1"), at(0)));
        assert_eq!(evicted(&mut held).len(), 40 - MAX_PENDING_PER_ADDRESS, "an end makes room");
        drop(held);
        assert!(throttle.table().pending.is_empty());
    }

    #[test]
    fn however_many_addresses_wait_the_oldest_gives_way() {
        let throttle = ConnectionThrottle::new(RATE, at(0));
        let mut held: Vec<_> = (0..MAX_PENDING as u32 + 10)
            .filter_map(|n| throttle.admit(Origin::Remote(IpAddr::V4(n.into())), at(0)))
            .collect();
        assert_eq!(evicted(&mut held), (0..10).collect::<Vec<_>>());
    }

    #[test]
    fn an_address_from_which_a_client_has_logged_in_has_more() {
        let throttle = ConnectionThrottle::new(RATE, clock::now());
        let flood = |ms: u64| {
            let now = clock::now() + Duration::from_millis(ms);
            (0..10_000).filter(|_| throttle.admit(from("10.0.0.1"), now).is_some()).count()
        };
        assert_eq!(flood(0), 100);
        let visit = throttle.admit(from("10.0.0.1"), clock::now() + Duration::from_secs(1)).unwrap().log_in();
        assert!((1000..1100).contains(&flood(1000)), "at once");
        assert!((95..=105).contains(&flood(2000)), "and each second after");
        drop(visit);
        assert!(throttle.table().by_address.values().all(|entry| entry.privileged_until > clock::now()));
    }

    #[test]
    fn this_machines_are_not_throttled_but_few_wait() {
        let throttle = ConnectionThrottle::new(RATE, at(0));
        let mut held: Vec<_> = (0..MAX_PENDING).filter_map(|_| throttle.admit(Origin::Local, at(0))).collect();
        assert_eq!(held.len(), MAX_PENDING);
        assert_eq!(evicted(&mut held).len(), MAX_PENDING - MAX_PENDING_LOCAL);
    }

    #[test]
    fn any_number_of_addresses_costs_bounded_memory() {
        let throttle = ConnectionThrottle::new(RATE, at(0));
        for n in 0..2 * MAX_SOURCES as u32 {
            drop(throttle.admit(Origin::Remote(IpAddr::V4(n.into())), at(0)));
        }
        assert_eq!(throttle.table().by_address.len(), MAX_SOURCES);
        let latest = Origin::Remote(IpAddr::V4(u32::MAX.into()));
        assert!(throttle.admit(latest, at(60_000)).is_some(), "the old are forgotten");
        let sources = throttle.table();
        assert_eq!((sources.by_address.len(), sources.pending.len()), (1, 0));
    }
}
