//! The principal behind each connection, and the quotas of principals.

use std::collections::{HashMap, HashSet};
use std::net::{IpAddr, SocketAddr};
use std::sync::{Arc, Mutex, PoisonError, RwLock, RwLockReadGuard, RwLockWriteGuard};

use ecod::model::names::NodeName;
use ecod::wire::RejectReason;
use rmqtt::types::{ClientId, TopicFilter};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use crate::platform::throttle::host_network;
use crate::telemetry::counters::{Counters, Event, OTHERS};
use crate::transport::pki::CertificateSubject;

/// Decides whether a node may publish maps, verdicts and reputations.
pub type LeaderCheck = Arc<dyn Fn(&NodeName) -> bool + Send + Sync>;

/// Authenticated party of a connection: a node by its certificate, or a host by its address. Local
/// programs share their node's certificate or address, and are a separate party: their use of a
/// quota does not reduce the node's quota.
#[derive(Debug, Clone)]
pub(super) struct Principal {
    /// Absent without certificates.
    pub(super) identity: Option<Arc<CertificateSubject>>,
    /// Key under which its connections and messages count together. Absent for local clients
    /// without certificates: a whole cell may run on this machine.
    quota_key: Option<Arc<str>>,
    /// Name under which its bytes count together, also for local clients.
    source: Arc<str>,
    /// True if the broker generates the client id.
    pub(super) has_generated_id: bool,
    /// True if the party is the local programs of the broker's node.
    are_programs: bool,
}

impl Principal {
    pub(super) fn new(
        identity: Option<CertificateSubject>,
        from: IpAddr,
        has_generated_id: bool,
    ) -> Self {
        let quota_key: Option<Arc<str>> = match &identity {
            Some(identity) => Some(identity.name().as_str().into()),
            None if from.to_canonical().is_loopback() => None,
            None => Some(host_network(from).to_string().into()),
        };
        let source = quota_key.clone().unwrap_or_else(|| THIS_MACHINE.into());
        Self {
            identity: identity.map(Arc::new),
            quota_key,
            source,
            has_generated_id,
            are_programs: false,
        }
    }

    /// The programs of this party, whose connections, messages and bytes count separately.
    pub(super) fn programs(self) -> Self {
        let apart = |key: &Arc<str>| Arc::from(format!("{key}, programs"));
        let quota_key = self.quota_key.as_ref().map(apart);
        let source = apart(&self.source);
        Self {
            quota_key,
            source,
            are_programs: true,
            ..self
        }
    }

    /// True if it is the node itself by its certificate; without certificates, a client of this
    /// machine.
    pub(super) fn is_of(&self, node: &NodeName) -> bool {
        self.identity
            .as_ref()
            .map_or(self.quota_key.is_none(), |identity| identity.name() == node)
    }

    /// Name under which its bytes count together.
    pub(super) fn source(&self) -> &Arc<str> {
        &self.source
    }

    /// Name under which held bytes count together; `None` if each connection counts separately.
    pub(super) fn quota_key(&self) -> Option<Arc<str>> {
        self.quota_key.clone()
    }

    /// True if it sends maps, or may be a whole cell.
    pub(super) fn has_large_share(&self, elected: &LeaderCheck) -> bool {
        match &self.identity {
            Some(identity) => {
                !self.are_programs && identity.may_serve() && elected(identity.name())
            }
            None => self.quota_key.is_none(),
        }
    }
}

/// True if the end of a client id has the form of a node's run.
pub(super) fn is_run(text: &str) -> bool {
    text.len() == 32 && text.bytes().all(|byte| byte.is_ascii_hexdigit())
}

/// Source of local clients without certificates.
const THIS_MACHINE: &str = "this machine";

/// Key under which messages are counted.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum QuotaKey {
    /// The node, or the address.
    Principal(Arc<str>),
    /// The client id, for clients without a quota key.
    Client(ClientId),
}

impl QuotaKey {
    pub(super) fn as_str(&self) -> &str {
        match self {
            Self::Principal(principal) => principal,
            Self::Client(client) => client,
        }
    }
}

/// Principals of the connections that the frontend forwards, by the frontend's local address.
#[derive(Debug, Clone, Default)]
pub(super) struct PrincipalRegistry(Arc<RwLock<HashMap<SocketAddr, Registered>>>);

#[derive(Debug)]
struct Registered {
    principal: Principal,
    subscriptions: HashSet<TopicFilter>,
}

/// Entry of one connection in the registry; removed when dropped.
pub(super) struct ClientRegistration {
    principals: PrincipalRegistry,
    address: SocketAddr,
}

impl PrincipalRegistry {
    pub(super) fn register(&self, address: SocketAddr, principal: Principal) -> ClientRegistration {
        self.connections_mut().insert(
            address,
            Registered {
                principal,
                subscriptions: HashSet::new(),
            },
        );
        ClientRegistration {
            principals: self.clone(),
            address,
        }
    }

    pub(super) fn principal(&self, address: Option<SocketAddr>) -> Option<Principal> {
        Some(self.connections().get(&address?)?.principal.clone())
    }

    pub(super) fn len(&self) -> usize {
        self.connections().len()
    }

    /// Name under which the bytes of a connection count.
    pub(super) fn source(&self, address: Option<SocketAddr>) -> Option<Arc<str>> {
        Some(Arc::clone(
            &self.connections().get(&address?)?.principal.source,
        ))
    }

    /// Counts a refusal, also by the principal of the connection.
    pub(super) fn count_denied(&self, address: Option<SocketAddr>, counters: &Counters) {
        counters.count(Event::ClientDenied);
        counters.reject(
            RejectReason::NotPermitted,
            self.source(address).as_deref().unwrap_or(OTHERS),
        );
    }

    /// Counts the refusal of a message that only the leader may publish. At a hand-over, the new
    /// leader may publish before this node has received that it leads.
    pub(super) fn count_not_leading(&self, address: Option<SocketAddr>, counters: &Counters) {
        counters.count(Event::ClientDenied);
        counters.reject_if_lasting(
            RejectReason::NotPermitted,
            self.source(address).as_deref().unwrap_or(OTHERS),
        );
    }

    /// Records that a connection has started or ended a subscription. A repeated subscription
    /// counts once.
    pub(super) fn record_subscription(
        &self,
        address: Option<SocketAddr>,
        filter: &TopicFilter,
        is_begun: bool,
    ) {
        let mut connections = self.connections_mut();
        let Some(connection) = address.and_then(|address| connections.get_mut(&address)) else {
            return;
        };
        if !is_begun {
            connection.subscriptions.remove(filter);
        } else if !connection.subscriptions.contains(filter) {
            connection.subscriptions.insert(filter.clone());
        }
    }

    /// Number of subscriptions of all connections of the same principal, or of this connection if
    /// each counts separately.
    pub(super) fn subscriptions(&self, address: Option<SocketAddr>) -> usize {
        let connections = self.connections();
        let Some(connection) = address.and_then(|address| connections.get(&address)) else {
            return 0;
        };
        let Some(key) = &connection.principal.quota_key else {
            return connection.subscriptions.len();
        };
        let own = connections
            .values()
            .filter(|other| other.principal.quota_key.as_ref() == Some(key));
        own.map(|connection| connection.subscriptions.len()).sum()
    }

    /// Number of filters of one connection for which `is_counted` holds.
    pub(super) fn count_filters(
        &self,
        address: Option<SocketAddr>,
        is_counted: impl Fn(&str) -> bool,
    ) -> usize {
        let connections = self.connections();
        let connection = address.and_then(|address| connections.get(&address));
        connection.map_or(0, |connection| {
            let filters = connection.subscriptions.iter();
            filters.filter(|filter| is_counted(filter)).count()
        })
    }

    fn connections(&self) -> RwLockReadGuard<'_, HashMap<SocketAddr, Registered>> {
        self.0.read().unwrap_or_else(PoisonError::into_inner)
    }

    fn connections_mut(&self) -> RwLockWriteGuard<'_, HashMap<SocketAddr, Registered>> {
        self.0.write().unwrap_or_else(PoisonError::into_inner)
    }

    /// Key under which the messages of a client count.
    pub(super) fn quota_key(&self, address: Option<SocketAddr>, client: &ClientId) -> QuotaKey {
        let connections = self.connections();
        let quota_key =
            address.and_then(|address| connections.get(&address)?.principal.quota_key.clone());
        quota_key.map_or_else(|| QuotaKey::Client(client.clone()), QuotaKey::Principal)
    }
}

impl Drop for ClientRegistration {
    fn drop(&mut self) {
        self.principals.connections_mut().remove(&self.address);
    }
}

/// Limit of simultaneous connections of each principal.
#[derive(Debug)]
pub(super) struct ConnectionQuota {
    limit: usize,
    connections: Mutex<HashMap<Arc<str>, Arc<Semaphore>>>,
}

/// The place of one connection, free when dropped; `None` for connections that don't count.
pub(super) type ConnectionPermit = Option<OwnedSemaphorePermit>;

impl ConnectionQuota {
    pub(super) fn new(limit: usize) -> Self {
        Self {
            limit,
            connections: Mutex::default(),
        }
    }

    /// A place for one more connection of the principal, if there is one left.
    pub(super) fn acquire(&self, principal: &Principal) -> Option<ConnectionPermit> {
        let Some(quota_key) = &principal.quota_key else {
            return Some(None);
        };
        let mut connections = self
            .connections
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        connections.retain(|_, places| places.available_permits() < self.limit);
        let places = connections
            .entry(Arc::clone(quota_key))
            .or_insert_with(|| Arc::new(Semaphore::new(self.limit)));
        Arc::clone(places).try_acquire_owned().ok().map(Some)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(address: &str) -> Principal {
        Principal::new(None, address.parse().unwrap(), false)
    }

    #[test]
    fn remote_address_connections_are_limited() {
        let quota = ConnectionQuota::new(2);
        let acquire = |address: &str| quota.acquire(&at(address));
        let held = [acquire("10.0.0.1"), acquire("::ffff:10.0.0.1")];
        assert!(held.iter().all(Option::is_some) && acquire("10.0.0.1").is_none());
        assert!(acquire("10.0.0.2").is_some(), "another's share is its own");
        let here: Vec<_> = (0..100).map_while(|_| acquire("127.0.0.1")).collect();
        assert_eq!(here.len(), 100);
        drop(held);
        assert!(acquire("10.0.0.1").is_some() && acquire("10.0.0.3").is_some());
        assert_eq!(
            quota.connections.lock().unwrap().len(),
            1,
            "a client that left is removed"
        );
    }

    #[test]
    fn programs_use_no_node_quota() {
        let quota = ConnectionQuota::new(1);
        let node = at("10.0.0.1");
        let programs = at("10.0.0.1").programs();
        let held = quota.acquire(&programs);
        assert!(held.is_some() && quota.acquire(&programs).is_none());
        assert!(quota.acquire(&node).is_some());
        assert_ne!(node.source(), programs.source());
        assert!(
            at("127.0.0.1").programs().quota_key().is_none(),
            "this machine's connections each count alone"
        );
    }

    #[test]
    fn quota_follows_principal() {
        let principals = PrincipalRegistry::default();
        let port = |port| SocketAddr::from(([127, 0, 0, 1], port));
        let holders = ["10.0.0.1", "10.0.0.1", "10.0.0.2", "127.0.0.1", "127.0.0.1"].map(at);
        let _issued: Vec<_> = (1..)
            .zip(holders)
            .map(|(n, principal)| principals.register(port(n), principal))
            .collect();
        let quota_key =
            |n: u16| principals.quota_key(Some(port(n)), &ClientId::from(format!("client-{n}")));
        assert_eq!(quota_key(1), quota_key(2));
        assert_ne!(quota_key(1), quota_key(3));
        assert_ne!(
            quota_key(4),
            quota_key(5),
            "clients of this machine are distinguished by name"
        );
        assert_eq!(
            quota_key(6),
            QuotaKey::Client("client-6".into()),
            "and those behind no frontend"
        );
    }
}
