//! Limits of connections that have not logged in yet.

use std::collections::{BTreeMap, HashMap};
use std::net::{IpAddr, Ipv4Addr};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use ecod::model::time::Timestamp;
use tokio::sync::oneshot;

use crate::platform::clock;
use crate::platform::throttle::{TokenBucket, host_network};

/// Limits connections without a login, by source address and in total. If too many are waiting, the
/// oldest is evicted: an honest client logs in at once.
#[derive(Debug, Clone)]
pub(super) struct ConnectionThrottle(Arc<Mutex<AddressTable>>);

#[derive(Debug)]
struct AddressTable {
    by_address: HashMap<IpAddr, AddressEntry>,
    /// Throttle shared by all addresses beyond [`MAX_ADDRESSES`].
    overflow: TokenBucket,
    /// Connections without a login by order of arrival: the source, and a sender whose drop evicts
    /// the connection.
    pending: BTreeMap<u64, (IpAddr, oneshot::Sender<()>)>,
    next_number: u64,
    pruned_at: Timestamp,
    /// Connections that an address may make at once, and the time until one more.
    burst: u32,
    interval: Duration,
}

#[derive(Debug)]
struct AddressEntry {
    bucket: TokenBucket,
    /// End of the time for which a login raises the address's rate.
    privileged_until: Timestamp,
}

/// Source of a connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ClientOrigin {
    /// Another machine, whose connections are throttled.
    Remote(IpAddr),
    /// This machine, where a whole cell may run and nodes cannot be distinguished. Only waiting
    /// connections are limited.
    Local,
}

/// Maximum connections without a login: of one address, of this machine, and in total.
const MAX_PENDING_PER_ADDRESS: usize = 32;
const MAX_PENDING_LOCAL: usize = 256;
const MAX_PENDING: usize = 1024;

/// Factor on the rate of an address from which a client has logged in, and how long it lasts after
/// the last login. A flood from a node's own address, for example behind address translation, must
/// leave some rate for the node.
const PRIVILEGED_FACTOR: u32 = 10;
const PRIVILEGED_FOR: Duration = Duration::from_secs(3600);

/// Maximum addresses with a throttle of their own.
const MAX_ADDRESSES: usize = 4096;

/// Minimum time between two searches for outdated addresses. A search for every connection would
/// help an attacker.
const PRUNE_INTERVAL: Duration = Duration::from_secs(1);

/// The place of a connection that may log in; free when dropped.
#[derive(Debug)]
pub(super) struct LoginSlot {
    throttle: ConnectionThrottle,
    source: IpAddr,
    number: u64,
    evicted: oneshot::Receiver<()>,
}

/// A connection that has logged in. Until its end it keeps its address privileged.
#[derive(Debug)]
pub(super) struct LoggedInConnection {
    throttle: ConnectionThrottle,
    source: IpAddr,
}

impl ConnectionThrottle {
    /// Allows each address `burst` connections at once, then one per `interval`.
    pub(super) fn new(burst: u32, interval: Duration, now: Timestamp) -> Self {
        Self(Arc::new(Mutex::new(AddressTable {
            by_address: HashMap::new(),
            overflow: TokenBucket::new(burst, interval, now),
            pending: BTreeMap::new(),
            next_number: 0,
            pruned_at: now,
            burst,
            interval,
        })))
    }

    /// A place to log in, unless the origin connects too often.
    pub(super) fn admit(&self, from: ClientOrigin, now: Timestamp) -> Option<LoginSlot> {
        let (source, limit) = match from {
            ClientOrigin::Remote(address) => (host_network(address), MAX_PENDING_PER_ADDRESS),
            ClientOrigin::Local => (IpAddr::V4(Ipv4Addr::LOCALHOST), MAX_PENDING_LOCAL),
        };
        let mut table = self.table();
        let is_allowed = match table.entry(source, now) {
            Some(entry) => from == ClientOrigin::Local || entry.bucket.allow(now),
            None => table.overflow.allow(now),
        };
        is_allowed.then(|| {
            let (number, evicted) = table.insert(source, limit);
            LoginSlot {
                throttle: self.clone(),
                source,
                number,
                evicted,
            }
        })
    }

    fn table(&self) -> MutexGuard<'_, AddressTable> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl AddressTable {
    /// Adds a waiting connection and evicts the oldest if there are too many, of its source or in
    /// total.
    fn insert(&mut self, source: IpAddr, limit: usize) -> (u64, oneshot::Receiver<()>) {
        let mut of_source = self
            .pending
            .iter()
            .filter(|(_, (other, _))| *other == source)
            .map(|(number, _)| *number);
        let oldest = match of_source.clone().count() {
            count if count >= limit => of_source.next(),
            _ => self
                .pending
                .keys()
                .next()
                .copied()
                .filter(|_| self.pending.len() >= MAX_PENDING),
        };
        oldest.map(|oldest| self.pending.remove(&oldest));
        let number = self.next_number;
        self.next_number += 1;
        let (place, evicted) = oneshot::channel();
        self.pending.insert(number, (source, place));
        (number, evicted)
    }

    /// The entry of an address; `None` if there is no room for one more.
    fn entry(&mut self, source: IpAddr, now: Timestamp) -> Option<&mut AddressEntry> {
        if self.by_address.len() >= MAX_ADDRESSES && !self.by_address.contains_key(&source) {
            if now.since(self.pruned_at) >= PRUNE_INTERVAL {
                self.pruned_at = now;
                self.by_address
                    .retain(|_, entry| now < entry.privileged_until || !entry.bucket.is_full(now));
            }
            if self.by_address.len() >= MAX_ADDRESSES {
                return None;
            }
        }
        let bucket = || TokenBucket::new(self.burst, self.interval, now);
        let fresh = || AddressEntry {
            bucket: bucket(),
            privileged_until: Timestamp::default(),
        };
        Some(self.by_address.entry(source).or_insert_with(fresh))
    }

    /// Raises the rate of an address from which a client is, or was until now, logged in.
    fn record_login(&mut self, source: IpAddr, now: Timestamp) {
        let burst = self.burst.saturating_mul(PRIVILEGED_FACTOR);
        let interval = self.interval / PRIVILEGED_FACTOR;
        let Some(entry) = self.entry(source, now) else {
            return;
        };
        if now >= entry.privileged_until {
            entry.bucket = TokenBucket::new(burst, interval, now);
        }
        entry.privileged_until = now + PRIVILEGED_FOR;
    }
}

impl LoginSlot {
    /// Waits until a newer connection has evicted this one.
    pub(super) async fn evicted(&mut self) {
        // The drop of the sender is the signal, so that the result is always an error.
        let _ = (&mut self.evicted).await;
    }

    /// Frees the place: the client has logged in.
    pub(super) fn log_in(self) -> LoggedInConnection {
        self.throttle
            .table()
            .record_login(self.source, clock::now());
        LoggedInConnection {
            throttle: self.throttle.clone(),
            source: self.source,
        }
    }
}

impl Drop for LoginSlot {
    fn drop(&mut self) {
        self.throttle.table().pending.remove(&self.number);
    }
}

impl Drop for LoggedInConnection {
    fn drop(&mut self) {
        self.throttle
            .table()
            .record_login(self.source, clock::now());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn throttle(burst: u32, now: Timestamp) -> ConnectionThrottle {
        ConnectionThrottle::new(burst, Duration::from_millis(100), now)
    }

    fn at(ms: u64) -> Timestamp {
        Timestamp(ms * 1000)
    }

    fn from(text: &str) -> ClientOrigin {
        ClientOrigin::Remote(text.parse().unwrap())
    }

    fn evicted(tickets: &mut [LoginSlot]) -> Vec<usize> {
        let is_displaced = |slot: &mut LoginSlot| {
            slot.evicted.try_recv() == Err(oneshot::error::TryRecvError::Closed)
        };
        tickets
            .iter_mut()
            .enumerate()
            .filter_map(|(n, slot)| is_displaced(slot).then_some(n))
            .collect()
    }

    #[test]
    fn address_uses_only_its_share() {
        let throttle = throttle(3, at(0));
        let admitted = |address, ms| {
            (0..9)
                .filter(|_| throttle.admit(from(address), at(ms)).is_some())
                .count()
        };
        assert_eq!(
            [
                admitted("10.0.0.1", 0),
                admitted("10.0.0.2", 0),
                admitted("10.0.0.1", 100)
            ],
            [3, 3, 1]
        );
        assert_eq!(
            [admitted("fd00::1:1", 0), admitted("fd00::2:2", 0)],
            [3, 0],
            "one network"
        );
        assert_eq!(
            admitted("::ffff:10.0.0.2", 0),
            0,
            "the same host by the other protocol"
        );
    }

    #[test]
    fn newest_displaces_oldest_waiting() {
        let throttle = throttle(100, at(0));
        let other = throttle.admit(from("10.0.0.2"), at(0)).unwrap();
        let mut held: Vec<_> = (0..40)
            .filter_map(|_| throttle.admit(from("10.0.0.1"), at(0)))
            .collect();
        assert_eq!(
            evicted(&mut held),
            (0..40 - MAX_PENDING_PER_ADDRESS).collect::<Vec<_>>()
        );
        assert!(evicted(&mut [other]).is_empty(), "of its own address only");
        drop(held.pop());
        held.extend(throttle.admit(from("10.0.0.1"), at(0)));
        assert_eq!(
            evicted(&mut held).len(),
            40 - MAX_PENDING_PER_ADDRESS,
            "an end makes room"
        );
        drop(held);
        assert!(throttle.table().pending.is_empty());
    }

    #[test]
    fn many_waiting_addresses_displace_oldest() {
        let throttle = throttle(100, at(0));
        let mut held: Vec<_> = (0..MAX_PENDING as u32 + 10)
            .filter_map(|n| throttle.admit(ClientOrigin::Remote(IpAddr::V4(n.into())), at(0)))
            .collect();
        assert_eq!(evicted(&mut held), (0..10).collect::<Vec<_>>());
    }

    #[test]
    fn address_with_login_has_more() {
        let throttle = throttle(100, clock::now());
        let flood = |ms: u64| {
            let now = clock::now() + Duration::from_millis(ms);
            (0..10_000)
                .filter(|_| throttle.admit(from("10.0.0.1"), now).is_some())
                .count()
        };
        assert_eq!(flood(0), 100);
        let visit = throttle
            .admit(from("10.0.0.1"), clock::now() + Duration::from_secs(1))
            .unwrap()
            .log_in();
        assert!((1000..1100).contains(&flood(1000)), "at once");
        assert!((95..=105).contains(&flood(2000)), "and each second after");
        drop(visit);
        assert!(
            throttle
                .table()
                .by_address
                .values()
                .all(|entry| entry.privileged_until > clock::now())
        );
    }

    #[test]
    fn waiting_local_connections_are_few() {
        let throttle = throttle(100, at(0));
        let mut held: Vec<_> = (0..MAX_PENDING)
            .filter_map(|_| throttle.admit(ClientOrigin::Local, at(0)))
            .collect();
        assert_eq!(held.len(), MAX_PENDING);
        assert_eq!(evicted(&mut held).len(), MAX_PENDING - MAX_PENDING_LOCAL);
    }

    #[test]
    fn many_addresses_use_bounded_memory() {
        let throttle = throttle(100, at(0));
        for n in 0..2 * MAX_ADDRESSES as u32 {
            drop(throttle.admit(ClientOrigin::Remote(IpAddr::V4(n.into())), at(0)));
        }
        assert_eq!(throttle.table().by_address.len(), MAX_ADDRESSES);
        let latest = ClientOrigin::Remote(IpAddr::V4(u32::MAX.into()));
        assert!(
            throttle.admit(latest, at(60_000)).is_some(),
            "old addresses are removed"
        );
        let sources = throttle.table();
        assert_eq!((sources.by_address.len(), sources.pending.len()), (1, 0));
    }
}
