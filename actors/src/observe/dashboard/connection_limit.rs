//! Who may be connected: whoever has not shown that he may look gives way to those who come.

use std::collections::{BTreeMap, HashMap};
use std::net::IpAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tokio::sync::oneshot;

use crate::platform::throttle::source;

/// Limits connections. While a request that may be answered is being answered its connection is kept; the others give
/// way when there is no room, first the oldest of the address that has most of them.
#[derive(Debug, Clone)]
pub(crate) struct ConnectionLimit {
    most: usize,
    taken: Arc<Mutex<OpenConnections>>,
}

#[derive(Debug, Default)]
struct OpenConnections {
    /// In the order in which they came.
    connections: BTreeMap<Number, Connection>,
    next: Number,
}

type Number = u64;

#[derive(Debug)]
struct Connection {
    source: IpAddr,
    kept: bool,
    /// Dropped with it, which tells the connection.
    _leave: oneshot::Sender<()>,
}

/// A connection's slot; free when dropped.
#[derive(Debug)]
pub(crate) struct ConnectionSlot {
    taken: Arc<Mutex<OpenConnections>>,
    number: Number,
}

/// What became of a new connection.
#[derive(Debug)]
pub(crate) struct Admitted {
    pub(crate) slot: ConnectionSlot,
    /// Ends when the connection has to give way.
    pub(crate) displaced: oneshot::Receiver<()>,
    /// Whether another had to give way.
    pub(crate) displaces: bool,
}

impl ConnectionLimit {
    pub(crate) fn new(most: usize) -> Self {
        Self { most, taken: Arc::default() }
    }

    /// A slot for a connection from an address; none while all are kept.
    pub(crate) fn admit(&self, from: IpAddr) -> Option<Admitted> {
        let mut taken = lock(&self.taken);
        let displaces = taken.connections.len() >= self.most;
        if displaces {
            let leaves = taken.next_to_leave()?;
            taken.connections.remove(&leaves);
        }
        let number = taken.next;
        taken.next += 1;
        let (leave, displaced) = oneshot::channel();
        taken.connections.insert(number, Connection { source: source(from), kept: false, _leave: leave });
        Some(Admitted { slot: ConnectionSlot { taken: Arc::clone(&self.taken), number }, displaced, displaces })
    }
}

impl OpenConnections {
    fn next_to_leave(&self) -> Option<Number> {
        let waiting = || self.connections.iter().filter(|(_, connection)| !connection.kept);
        let mut held = HashMap::<IpAddr, usize>::new();
        for (_, connection) in waiting() {
            *held.entry(connection.source).or_default() += 1;
        }
        // Of equals the last counts, which is the oldest this way round.
        waiting().rev().max_by_key(|(_, connection)| held[&connection.source]).map(|(number, _)| *number)
    }
}

impl ConnectionSlot {
    /// Its connection no longer gives way.
    pub(crate) fn keep(&self) {
        if let Some(connection) = lock(&self.taken).connections.get_mut(&self.number) {
            connection.kept = true;
        }
    }
}

impl Drop for ConnectionSlot {
    fn drop(&mut self) {
        lock(&self.taken).connections.remove(&self.number);
    }
}

fn lock(taken: &Mutex<OpenConnections>) -> MutexGuard<'_, OpenConnections> {
    taken.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn admit(connection_limit: &ConnectionLimit, from: &str) -> Option<Admitted> {
        connection_limit.admit(from.parse().unwrap())
    }

    fn is_displaced(admitted: &mut Admitted) -> bool {
        admitted.displaced.try_recv() == Err(oneshot::error::TryRecvError::Closed)
    }

    #[test]
    fn an_address_that_takes_all_places_makes_room_for_another() {
        let connection_limit = ConnectionLimit::new(4);
        let [mut first, mut second, mut third, mut other] =
            ["10.0.0.9", "10.0.0.9", "10.0.0.9", "10.0.0.2"].map(|from| admit(&connection_limit, from).unwrap());
        assert!(!other.displaces);
        let mut flood: Vec<_> = (0..100).map(|_| admit(&connection_limit, "10.0.0.9").unwrap()).collect();
        assert!(flood.iter().all(|admitted| admitted.displaces));
        assert!([&mut first, &mut second, &mut third].into_iter().all(is_displaced));
        assert!(!is_displaced(&mut other), "it is not the one that has most");
        assert_eq!(flood.iter_mut().map(is_displaced).filter(|displaced| !displaced).count(), 3);
    }

    #[test]
    fn an_ipv6_network_counts_as_one_address_and_of_equals_the_oldest_leaves() {
        let connection_limit = ConnectionLimit::new(3);
        let [mut a, mut b, mut c] =
            ["2001:db8::1", "2001:db8:0:1::1", "2001:db8:0:1::2"].map(|from| admit(&connection_limit, from).unwrap());
        let _d = admit(&connection_limit, "2001:db8:0:2::1").unwrap();
        assert_eq!([&mut a, &mut b, &mut c].map(is_displaced), [false, true, false]);
        let _e = admit(&connection_limit, "2001:db8:0:3::1").unwrap();
        assert_eq!([&mut a, &mut c].map(is_displaced), [true, false]);
    }

    #[test]
    fn whoever_is_answered_stays_and_leaves_its_place() {
        let connection_limit = ConnectionLimit::new(2);
        let mut kept = ["10.0.0.2", "10.0.0.2"].map(|from| admit(&connection_limit, from).unwrap());
        kept.iter().for_each(|admitted| admitted.slot.keep());
        assert!(admit(&connection_limit, "10.0.0.3").is_none());
        assert_eq!(kept.each_mut().map(is_displaced), [false, false]);
        let [gone, _kept] = kept;
        drop(gone);
        assert!(!admit(&connection_limit, "10.0.0.3").unwrap().displaces);
    }
}
