//! Limit on connections: connections without an allowed request make room for new ones.

use std::collections::{BTreeMap, HashMap};
use std::net::IpAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tokio::sync::oneshot;

use crate::platform::throttle::host_network;

/// Limits connections. A connection with an allowed request is kept until it is answered. If the
/// limit is reached, a new connection displaces the oldest other connection of the address with
/// most connections.
#[derive(Debug, Clone)]
pub struct ConnectionLimit {
    max: usize,
    open: Arc<Mutex<OpenConnections>>,
}

#[derive(Debug, Default)]
struct OpenConnections {
    /// By number, which is the order of arrival.
    by_number: BTreeMap<u64, TrackedConnection>,
    next: u64,
}

#[derive(Debug)]
struct TrackedConnection {
    source: IpAddr,
    kept: bool,
    /// Closes [`AdmittedConnection::displaced`] when dropped.
    _displace: oneshot::Sender<()>,
}

/// A connection's slot; freed when dropped.
#[derive(Debug)]
pub(crate) struct ConnectionSlot {
    open: Arc<Mutex<OpenConnections>>,
    number: u64,
}

#[derive(Debug)]
pub(crate) struct AdmittedConnection {
    pub(crate) slot: ConnectionSlot,
    /// Ends when the connection is displaced.
    pub(crate) displaced: oneshot::Receiver<()>,
    /// True if it displaced another.
    pub(crate) displaces: bool,
}

impl ConnectionLimit {
    /// A limit of `max` connections.
    pub fn new(max: usize) -> Self {
        Self {
            max,
            open: Arc::default(),
        }
    }

    /// A slot for a connection from an address; `None` while all connections must be kept.
    pub(crate) fn admit(&self, from: IpAddr) -> Option<AdmittedConnection> {
        let mut open = lock(&self.open);
        let displaces = open.by_number.len() >= self.max;
        if displaces {
            let number = open.next_displaced()?;
            open.by_number.remove(&number);
        }
        let number = open.next;
        open.next += 1;
        let (displace, displaced) = oneshot::channel();
        open.by_number.insert(
            number,
            TrackedConnection {
                source: host_network(from),
                kept: false,
                _displace: displace,
            },
        );
        Some(AdmittedConnection {
            slot: ConnectionSlot {
                open: Arc::clone(&self.open),
                number,
            },
            displaced,
            displaces,
        })
    }
}

impl OpenConnections {
    fn next_displaced(&self) -> Option<u64> {
        let candidates = || {
            self.by_number
                .iter()
                .filter(|(_, connection)| !connection.kept)
        };
        let mut per_source = HashMap::<IpAddr, usize>::new();
        for (_, connection) in candidates() {
            *per_source.entry(connection.source).or_default() += 1;
        }
        // `max_by_key` returns the last of equals; reversed, this is the oldest.
        candidates()
            .rev()
            .max_by_key(|(_, connection)| per_source[&connection.source])
            .map(|(number, _)| *number)
    }
}

impl ConnectionSlot {
    /// Protects the connection from being displaced.
    pub(crate) fn keep(&self) {
        if let Some(connection) = lock(&self.open).by_number.get_mut(&self.number) {
            connection.kept = true;
        }
    }
}

impl Drop for ConnectionSlot {
    fn drop(&mut self) {
        lock(&self.open).by_number.remove(&self.number);
    }
}

fn lock(open: &Mutex<OpenConnections>) -> MutexGuard<'_, OpenConnections> {
    open.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn admit(connection_limit: &ConnectionLimit, from: &str) -> Option<AdmittedConnection> {
        connection_limit.admit(from.parse().unwrap())
    }

    fn is_displaced(admitted: &mut AdmittedConnection) -> bool {
        admitted.displaced.try_recv() == Err(oneshot::error::TryRecvError::Closed)
    }

    #[test]
    fn address_holding_all_places_yields() {
        let connection_limit = ConnectionLimit::new(4);
        let [mut first, mut second, mut third, mut other] =
            ["10.0.0.9", "10.0.0.9", "10.0.0.9", "10.0.0.2"]
                .map(|from| admit(&connection_limit, from).unwrap());
        assert!(!other.displaces);
        let mut flood: Vec<_> = (0..100)
            .map(|_| admit(&connection_limit, "10.0.0.9").unwrap())
            .collect();
        assert!(flood.iter().all(|admitted| admitted.displaces));
        assert!(
            [&mut first, &mut second, &mut third]
                .into_iter()
                .all(is_displaced)
        );
        assert!(!is_displaced(&mut other), "it is not the one that has most");
        assert_eq!(
            flood
                .iter_mut()
                .map(is_displaced)
                .filter(|displaced| !displaced)
                .count(),
            3
        );
    }

    #[test]
    fn ipv6_network_is_one_address() {
        let connection_limit = ConnectionLimit::new(3);
        let [mut a, mut b, mut c] = ["2001:db8::1", "2001:db8:0:1::1", "2001:db8:0:1::2"]
            .map(|from| admit(&connection_limit, from).unwrap());
        let _d = admit(&connection_limit, "2001:db8:0:2::1").unwrap();
        assert_eq!(
            [&mut a, &mut b, &mut c].map(is_displaced),
            [false, true, false]
        );
        let _e = admit(&connection_limit, "2001:db8:0:3::1").unwrap();
        assert_eq!([&mut a, &mut c].map(is_displaced), [true, false]);
    }

    #[test]
    fn answered_connection_is_kept() {
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
