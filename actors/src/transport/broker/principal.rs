//! Whose a connection is, and what it has in common with others.

use std::collections::HashMap;
use std::net::{IpAddr, SocketAddr};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, RwLock};

use rmqtt::types::ClientId;

use crate::platform::throttle::host_network;
use crate::transport::pki::CertificateSubject;

/// Who is at the other end: a node by its certificate, or somebody by an address.
#[derive(Debug, Clone)]
pub(super) struct Principal {
    /// Absent without certificates.
    pub(super) identity: Option<Arc<CertificateSubject>>,
    /// By what its connections count together; absent for this machine's without certificates, where a whole cell may
    /// run.
    quota_key: Option<Arc<str>>,
    /// Whether it left it to the broker to draw its client id.
    pub(super) has_generated_id: bool,
}

impl Principal {
    pub(super) fn new(identity: Option<CertificateSubject>, from: IpAddr, has_generated_id: bool) -> Self {
        let quota_key = match &identity {
            Some(identity) => Some(identity.name().as_str().into()),
            None if from.to_canonical().is_loopback() => None,
            None => Some(host_network(from).to_string().into()),
        };
        Self { identity: identity.map(Arc::new), quota_key, has_generated_id }
    }
}

/// What a message's share is counted by.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum QuotaKey {
    /// The node, or the address.
    Principal(Arc<str>),
    /// Where neither is told apart, the client.
    Anonymous(ClientId),
}

impl QuotaKey {
    pub(super) fn as_str(&self) -> &str {
        match self {
            Self::Principal(principal) => principal,
            Self::Anonymous(client) => client,
        }
    }
}

/// The connections that the gate has let in, by the address from which it passes them on, and whose they are.
#[derive(Debug, Clone, Default)]
pub(super) struct PrincipalRegistry(Arc<RwLock<HashMap<SocketAddr, Principal>>>);

/// A connection that may talk to rmqtt; not any more when dropped.
pub(super) struct Registration {
    principals: PrincipalRegistry,
    address: SocketAddr,
}

impl PrincipalRegistry {
    pub(super) fn register(&self, address: SocketAddr, principal: Principal) -> Registration {
        self.0.write().unwrap_or_else(PoisonError::into_inner).insert(address, principal);
        Registration { principals: self.clone(), address }
    }

    pub(super) fn principal(&self, address: Option<SocketAddr>) -> Option<Principal> {
        self.0.read().unwrap_or_else(PoisonError::into_inner).get(&address?).cloned()
    }

    /// By what the messages of a client count.
    pub(super) fn quota_key(&self, address: Option<SocketAddr>, client: &ClientId) -> QuotaKey {
        let principals = self.0.read().unwrap_or_else(PoisonError::into_inner);
        let quota_key = address.and_then(|address| principals.get(&address)?.quota_key.clone());
        quota_key.map_or_else(|| QuotaKey::Anonymous(client.clone()), QuotaKey::Principal)
    }
}

impl Drop for Registration {
    fn drop(&mut self) {
        self.principals.0.write().unwrap_or_else(PoisonError::into_inner).remove(&self.address);
    }
}

/// How many connections each has.
#[derive(Debug, Clone)]
pub(super) struct ConnectionQuota {
    limit: usize,
    connections: Arc<Mutex<HashMap<Arc<str>, usize>>>,
}

/// One connection's part of its holder's share; free when dropped.
#[derive(Debug)]
pub(super) struct ConnectionPermit(Option<(ConnectionQuota, Arc<str>)>);

impl ConnectionQuota {
    pub(super) fn new(limit: usize) -> Self {
        Self { limit, connections: Arc::default() }
    }

    /// A part of the holder's share, if there is one left.
    pub(super) fn take(&self, principal: &Principal) -> Option<ConnectionPermit> {
        let Some(quota_key) = &principal.quota_key else { return Some(ConnectionPermit(None)) };
        let mut connections = self.connections();
        let count = connections.entry(Arc::clone(quota_key)).or_default();
        if *count >= self.limit {
            return None;
        }
        *count += 1;
        Some(ConnectionPermit(Some((self.clone(), Arc::clone(quota_key)))))
    }

    fn connections(&self) -> MutexGuard<'_, HashMap<Arc<str>, usize>> {
        self.connections.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for ConnectionPermit {
    fn drop(&mut self) {
        let Some((quota, quota_key)) = self.0.take() else { return };
        let mut connections = quota.connections();
        let left = connections.get_mut(&quota_key).map(|count| {
            *count = count.saturating_sub(1);
            *count
        });
        if left == Some(0) {
            connections.remove(&quota_key);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(address: &str) -> Principal {
        Principal::new(None, address.parse().unwrap(), false)
    }

    #[test]
    fn connections_of_one_address_are_few_and_this_machines_are_not() {
        let quota = ConnectionQuota::new(2);
        let take = |address: &str| quota.take(&at(address));
        let held = [take("10.0.0.1"), take("::ffff:10.0.0.1")];
        assert!(held.iter().all(Option::is_some) && take("10.0.0.1").is_none());
        assert!(take("10.0.0.2").is_some(), "another's share is its own");
        let here: Vec<_> = (0..100).map_while(|_| take("127.0.0.1")).collect();
        assert_eq!(here.len(), 100);
        drop(held);
        assert!(take("10.0.0.1").is_some() && quota.connections().is_empty());
    }

    #[test]
    fn messages_count_by_principal_whatever_the_client_calls_itself() {
        let principals = PrincipalRegistry::default();
        let port = |port| SocketAddr::from(([127, 0, 0, 1], port));
        let holders = ["10.0.0.1", "10.0.0.1", "10.0.0.2", "127.0.0.1", "127.0.0.1"].map(at);
        let _issued: Vec<_> =
            (1..).zip(holders).map(|(n, principal)| principals.register(port(n), principal)).collect();
        let quota_key = |n: u16| principals.quota_key(Some(port(n)), &ClientId::from(format!("client-{n}")));
        assert_eq!(quota_key(1), quota_key(2));
        assert_ne!(quota_key(1), quota_key(3));
        assert_ne!(quota_key(4), quota_key(5), "this machine's are told apart by their names");
        assert_eq!(quota_key(6), QuotaKey::Anonymous("client-6".into()), "and those behind no frontend");
    }
}
