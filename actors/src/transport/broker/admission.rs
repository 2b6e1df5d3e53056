//! How many strangers may knock, and how often.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::net::{IpAddr, Ipv4Addr};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use ecod::time::Timestamp;
use tokio::sync::oneshot;

use crate::platform::clock;
use crate::platform::throttle::{Throttle, source};

/// Limits connections that have not logged in yet, by source address and in all. Where too many wait, the oldest gives
/// way: whoever means to log in does so at once.
#[derive(Debug, Clone)]
pub(super) struct Admission(Arc<Mutex<Sources>>);

#[derive(Debug)]
struct Sources {
    by_address: HashMap<IpAddr, Source>,
    /// For addresses beyond those that are remembered.
    others: Throttle,
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
struct Source {
    throttle: Throttle,
    pending: BTreeSet<Number>,
    seen: Timestamp,
    /// Until when it is remembered that a client of this address was logged in.
    known_until: Timestamp,
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
    Address(IpAddr),
    /// From this machine, where a whole cell may run, and nothing tells its nodes apart: only those that wait are
    /// limited.
    Here,
}

/// Most connections of one address, of this machine, and of all, that have not logged in.
const MAX_PENDING_EACH: usize = 32;
const MAX_PENDING_HERE: usize = 256;
const MAX_PENDING: usize = 1024;

/// How many times the rate of a stranger an address has from which a client has logged in, and for how long after: a
/// flood from a node's own address, such as behind address translation, is to leave something for the node.
const KNOWN_SHARE: u32 = 10;
const KNOWN_FOR: Duration = Duration::from_secs(3600);

/// Most addresses that are remembered.
const MAX_SOURCES: usize = 4096;

/// Least time between two looks for addresses to forget: looking at all for every connection would be an attack's aim.
const PRUNE: Duration = Duration::from_secs(1);

/// A connection that was let in to log in; its place is free when dropped.
#[derive(Debug)]
pub(super) struct Ticket {
    admission: Admission,
    source: IpAddr,
    number: Number,
    displaced: oneshot::Receiver<()>,
}

/// A connection that has logged in.
#[derive(Debug)]
pub(super) struct Visit {
    admission: Admission,
    source: IpAddr,
}

impl Admission {
    pub(super) fn new(rate: Rate, now: Timestamp) -> Self {
        let (by_address, pending) = (HashMap::new(), BTreeMap::new());
        let others = Throttle::new(rate.burst, rate.interval, now);
        Self(Arc::new(Mutex::new(Sources { by_address, others, pending, next: 0, pruned: now, rate })))
    }

    /// Lets a connection in, or not.
    pub(super) fn admit(&self, from: Origin, now: Timestamp) -> Option<Ticket> {
        let (source, most) = match from {
            Origin::Address(address) => (source(address), MAX_PENDING_EACH),
            Origin::Here => (IpAddr::V4(Ipv4Addr::LOCALHOST), MAX_PENDING_HERE),
        };
        let (number, displaced) = self.sources().admit(source, from == Origin::Here, most, now)?;
        Some(Ticket { admission: self.clone(), source, number, displaced })
    }

    fn sources(&self) -> MutexGuard<'_, Sources> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Sources {
    fn admit(
        &mut self,
        source: IpAddr,
        is_unthrottled: bool,
        most: usize,
        now: Timestamp,
    ) -> Option<(Number, oneshot::Receiver<()>)> {
        let number = self.next;
        let allowed = match self.known(source, now) {
            Some(known) => {
                let allowed = is_unthrottled || known.throttle.allow(now);
                let oldest = known.pending.first().copied().filter(|_| allowed && known.pending.len() >= most);
                if allowed {
                    known.pending.insert(number);
                }
                oldest.inspect(|oldest| self.remove(*oldest));
                allowed
            }
            None => self.others.allow(now),
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
        let (place, displaced) = oneshot::channel();
        self.pending.insert(number, Pending { source, _place: place });
        Some((number, displaced))
    }

    /// What is remembered of an address; nothing when there is no room for one more.
    fn known(&mut self, source: IpAddr, now: Timestamp) -> Option<&mut Source> {
        let Rate { burst, interval } = self.rate;
        if self.by_address.len() >= MAX_SOURCES && !self.by_address.contains_key(&source) {
            // Whose burst is whole again need not be remembered.
            if now.since(self.pruned) >= PRUNE {
                self.pruned = now;
                let is_rested = |known: &Source| known.pending.is_empty() && now.since(known.seen) >= interval * burst;
                self.by_address.retain(|_, known| now < known.known_until || !is_rested(known));
            }
            if self.by_address.len() >= MAX_SOURCES {
                return None;
            }
        }
        let throttle = || Throttle::new(burst, interval, now);
        let fresh =
            || Source { throttle: throttle(), pending: BTreeSet::new(), seen: now, known_until: Timestamp::default() };
        let known = self.by_address.entry(source).or_insert_with(fresh);
        known.seen = now;
        Some(known)
    }

    /// Notes that a client of the address is, or was until now, logged in.
    fn welcome(&mut self, source: IpAddr, now: Timestamp) {
        let Rate { burst, interval } = self.rate;
        let Some(known) = self.known(source, now) else { return };
        if now >= known.known_until {
            known.throttle = Throttle::new(burst.saturating_mul(KNOWN_SHARE), interval / KNOWN_SHARE, now);
        }
        known.known_until = now + KNOWN_FOR;
    }

    fn remove(&mut self, number: Number) {
        let Some(pending) = self.pending.remove(&number) else { return };
        if let Some(known) = self.by_address.get_mut(&pending.source) {
            known.pending.remove(&number);
        }
    }
}

impl Ticket {
    /// Waits until a newer connection has taken the place of this one.
    pub(super) async fn displaced(&mut self) {
        // It ends by the sender's end.
        (&mut self.displaced).await.unwrap_or_default();
    }

    /// Gives the place back: the client has logged in.
    pub(super) fn log_in(self) -> Visit {
        self.admission.sources().welcome(self.source, clock::now());
        Visit { admission: self.admission.clone(), source: self.source }
    }
}

impl Drop for Ticket {
    fn drop(&mut self) {
        self.admission.sources().remove(self.number);
    }
}

impl Drop for Visit {
    fn drop(&mut self) {
        self.admission.sources().welcome(self.source, clock::now());
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
        Origin::Address(text.parse().unwrap())
    }

    fn displaced(tickets: &mut [Ticket]) -> Vec<usize> {
        let is_displaced =
            |ticket: &mut Ticket| ticket.displaced.try_recv() == Err(oneshot::error::TryRecvError::Closed);
        tickets.iter_mut().enumerate().filter_map(|(n, ticket)| is_displaced(ticket).then_some(n)).collect()
    }

    #[test]
    fn one_address_uses_up_its_own_share_only() {
        let admission = Admission::new(Rate { burst: 3, ..RATE }, at(0));
        let admitted = |address, ms| (0..9).filter(|_| admission.admit(from(address), at(ms)).is_some()).count();
        assert_eq!([admitted("10.0.0.1", 0), admitted("10.0.0.2", 0), admitted("10.0.0.1", 100)], [3, 3, 1]);
        assert_eq!([admitted("fd00::1:1", 0), admitted("fd00::2:2", 0)], [3, 0], "one network");
        assert_eq!(admitted("::ffff:10.0.0.2", 0), 0, "the same host by the other protocol");
    }

    #[test]
    fn where_too_many_wait_the_oldest_gives_way_to_the_newest() {
        let admission = Admission::new(RATE, at(0));
        let other = admission.admit(from("10.0.0.2"), at(0)).unwrap();
        let mut held: Vec<_> = (0..40).filter_map(|_| admission.admit(from("10.0.0.1"), at(0))).collect();
        assert_eq!(displaced(&mut held), (0..40 - MAX_PENDING_EACH).collect::<Vec<_>>());
        assert!(displaced(&mut [other]).is_empty(), "of its own address only");
        drop(held.pop());
        held.extend(admission.admit(from("10.0.0.1"), at(0)));
        assert_eq!(displaced(&mut held).len(), 40 - MAX_PENDING_EACH, "an end makes room");
        drop(held);
        assert!(admission.sources().pending.is_empty());
    }

    #[test]
    fn however_many_addresses_wait_the_oldest_gives_way() {
        let admission = Admission::new(RATE, at(0));
        let mut held: Vec<_> = (0..MAX_PENDING as u32 + 10)
            .filter_map(|n| admission.admit(Origin::Address(IpAddr::V4(n.into())), at(0)))
            .collect();
        assert_eq!(displaced(&mut held), (0..10).collect::<Vec<_>>());
    }

    #[test]
    fn an_address_from_which_a_client_has_logged_in_has_more() {
        let admission = Admission::new(RATE, clock::now());
        let flood = |ms: u64| {
            let now = clock::now() + Duration::from_millis(ms);
            (0..10_000).filter(|_| admission.admit(from("10.0.0.1"), now).is_some()).count()
        };
        assert_eq!(flood(0), 100);
        let visit = admission.admit(from("10.0.0.1"), clock::now() + Duration::from_secs(1)).unwrap().log_in();
        assert!((1000..1100).contains(&flood(1000)), "at once");
        assert!((95..=105).contains(&flood(2000)), "and each second after");
        drop(visit);
        assert!(admission.sources().by_address.values().all(|known| known.known_until > clock::now()));
    }

    #[test]
    fn this_machines_are_not_throttled_but_few_wait() {
        let admission = Admission::new(RATE, at(0));
        let mut held: Vec<_> = (0..MAX_PENDING).filter_map(|_| admission.admit(Origin::Here, at(0))).collect();
        assert_eq!(held.len(), MAX_PENDING);
        assert_eq!(displaced(&mut held).len(), MAX_PENDING - MAX_PENDING_HERE);
    }

    #[test]
    fn any_number_of_addresses_costs_bounded_memory() {
        let admission = Admission::new(RATE, at(0));
        for n in 0..2 * MAX_SOURCES as u32 {
            drop(admission.admit(Origin::Address(IpAddr::V4(n.into())), at(0)));
        }
        assert_eq!(admission.sources().by_address.len(), MAX_SOURCES);
        let latest = Origin::Address(IpAddr::V4(u32::MAX.into()));
        assert!(admission.admit(latest, at(60_000)).is_some(), "the old are forgotten");
        let sources = admission.sources();
        assert_eq!((sources.by_address.len(), sources.pending.len()), (1, 0));
    }
}
