//! Whose a connection is, and what it has in common with others.

use std::collections::HashMap;
use std::net::{IpAddr, SocketAddr};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, RwLock};

use rmqtt::types::ClientId;

use crate::platform::throttle::source;
use crate::transport::pki::Identity;

/// Who is at the other end: a node by its certificate, or somebody by an address.
#[derive(Debug, Clone)]
pub(super) struct Holder {
    /// Absent without certificates.
    pub(super) identity: Option<Arc<Identity>>,
    /// By what its connections count together; absent for this machine's without certificates, where a whole cell may
    /// run.
    share: Option<Arc<str>>,
    /// Whether it left it to the broker to draw its client id.
    pub(super) is_nameless: bool,
}

impl Holder {
    pub(super) fn new(identity: Option<Identity>, from: IpAddr, is_nameless: bool) -> Self {
        let share = match &identity {
            Some(identity) => Some(identity.name().as_str().into()),
            None if from.to_canonical().is_loopback() => None,
            None => Some(source(from).to_string().into()),
        };
        Self { identity: identity.map(Arc::new), share, is_nameless }
    }
}

/// What a message's share is counted by.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Source {
    /// The node, or the address.
    Holder(Arc<str>),
    /// Where neither is told apart, the client.
    Client(ClientId),
}

impl Source {
    pub(super) fn as_str(&self) -> &str {
        match self {
            Self::Holder(holder) => holder,
            Self::Client(client) => client,
        }
    }
}

/// The connections that the gate has let in, by the address from which it passes them on, and whose they are.
#[derive(Debug, Clone, Default)]
pub(super) struct Passes(Arc<RwLock<HashMap<SocketAddr, Holder>>>);

/// A connection that may talk to rmqtt; not any more when dropped.
pub(super) struct Pass {
    passes: Passes,
    address: SocketAddr,
}

impl Passes {
    pub(super) fn issue(&self, address: SocketAddr, holder: Holder) -> Pass {
        self.0.write().unwrap_or_else(PoisonError::into_inner).insert(address, holder);
        Pass { passes: self.clone(), address }
    }

    pub(super) fn holder(&self, address: Option<SocketAddr>) -> Option<Holder> {
        self.0.read().unwrap_or_else(PoisonError::into_inner).get(&address?).cloned()
    }

    /// By what the messages of a client count.
    pub(super) fn source(&self, address: Option<SocketAddr>, client: &ClientId) -> Source {
        let passes = self.0.read().unwrap_or_else(PoisonError::into_inner);
        let share = address.and_then(|address| passes.get(&address)?.share.clone());
        share.map_or_else(|| Source::Client(client.clone()), Source::Holder)
    }
}

impl Drop for Pass {
    fn drop(&mut self) {
        self.passes.0.write().unwrap_or_else(PoisonError::into_inner).remove(&self.address);
    }
}

/// How many connections each has.
#[derive(Debug, Clone)]
pub(super) struct Shares {
    most: usize,
    taken: Arc<Mutex<HashMap<Arc<str>, usize>>>,
}

/// One connection's part of its holder's share; free when dropped.
#[derive(Debug)]
pub(super) struct Part(Option<(Shares, Arc<str>)>);

impl Shares {
    pub(super) fn new(most: usize) -> Self {
        Self { most, taken: Arc::default() }
    }

    /// A part of the holder's share, if there is one left.
    pub(super) fn take(&self, holder: &Holder) -> Option<Part> {
        let Some(share) = &holder.share else { return Some(Part(None)) };
        let mut taken = self.taken();
        let count = taken.entry(Arc::clone(share)).or_default();
        if *count >= self.most {
            return None;
        }
        *count += 1;
        Some(Part(Some((self.clone(), Arc::clone(share)))))
    }

    fn taken(&self) -> MutexGuard<'_, HashMap<Arc<str>, usize>> {
        self.taken.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for Part {
    fn drop(&mut self) {
        let Some((shares, share)) = self.0.take() else { return };
        let mut taken = shares.taken();
        let left = taken.get_mut(&share).map(|count| {
            *count = count.saturating_sub(1);
            *count
        });
        if left == Some(0) {
            taken.remove(&share);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(address: &str) -> Holder {
        Holder::new(None, address.parse().unwrap(), false)
    }

    #[test]
    fn connections_of_one_address_are_few_and_this_machines_are_not() {
        let shares = Shares::new(2);
        let take = |address: &str| shares.take(&at(address));
        let held = [take("10.0.0.1"), take("::ffff:10.0.0.1")];
        assert!(held.iter().all(Option::is_some) && take("10.0.0.1").is_none());
        assert!(take("10.0.0.2").is_some(), "another's share is its own");
        let here: Vec<_> = (0..100).map_while(|_| take("127.0.0.1")).collect();
        assert_eq!(here.len(), 100);
        drop(held);
        assert!(take("10.0.0.1").is_some() && shares.taken().is_empty());
    }

    #[test]
    fn messages_count_by_holder_whatever_the_client_calls_itself() {
        let passes = Passes::default();
        let port = |port| SocketAddr::from(([127, 0, 0, 1], port));
        let holders = ["10.0.0.1", "10.0.0.1", "10.0.0.2", "127.0.0.1", "127.0.0.1"].map(at);
        let _issued: Vec<_> = (1..).zip(holders).map(|(n, holder)| passes.issue(port(n), holder)).collect();
        let source = |n: u16| passes.source(Some(port(n)), &ClientId::from(format!("client-{n}")));
        assert_eq!(source(1), source(2));
        assert_ne!(source(1), source(3));
        assert_ne!(source(4), source(5), "this machine's are told apart by their names");
        assert_eq!(source(6), Source::Client("client-6".into()), "and those behind no gate");
    }
}
