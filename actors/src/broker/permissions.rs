//! Who may say what through the embedded broker: hooks of rmqtt that look at the certificate behind a connection.
//!
//! | topic | who |
//! |---|---|
//! | `detections/N`, `vote_detections/N`, `ledger/N`, `nodes/N` | whoever has the certificate of `N` |
//! | `global_detections`, `global_verdicts`, `reputations` | who is elected; while nobody is, who may lead |
//! | anything else | nobody |
//!
//! Everyone with a certificate of the cell may read everything.

use std::collections::HashMap;
use std::fmt;
use std::net::SocketAddr;
use std::sync::{Arc, PoisonError, RwLock};

use async_trait::async_trait;
use ecod::names::NodeName;
use ecod::wire::{Topic, Topics};
use rmqtt::context::ServerContext;
use rmqtt::hook::{Handler, HookResult, Parameter, ReturnType, Type};
use rmqtt::types::{AuthResult, ConnectInfo, LastWill, PublishAclResult};

use crate::counters::{Counters, Event};
use crate::pki::Identity;

/// Tells whether a node may speak for all: whether it is the elected one.
pub type Elected = Arc<dyn Fn(&NodeName) -> bool + Send + Sync>;

/// The connections that the gate has let in, by the address from which it passes them on, and whose they are. Without
/// certificates they are nobody's.
#[derive(Debug, Clone, Default)]
pub(super) struct Passes(Arc<RwLock<HashMap<SocketAddr, Option<Arc<Identity>>>>>);

/// A connection that may talk to rmqtt; not any more when dropped.
pub(super) struct Pass {
    passes: Passes,
    address: SocketAddr,
}

impl Passes {
    pub(super) fn issue(&self, address: SocketAddr, holder: Option<Arc<Identity>>) -> Pass {
        self.0.write().unwrap_or_else(PoisonError::into_inner).insert(address, holder);
        Pass { passes: self.clone(), address }
    }

    fn holder(&self, address: Option<SocketAddr>) -> Option<Option<Arc<Identity>>> {
        self.0.read().unwrap_or_else(PoisonError::into_inner).get(&address?).cloned()
    }
}

impl Drop for Pass {
    fn drop(&mut self) {
        self.passes.0.write().unwrap_or_else(PoisonError::into_inner).remove(&self.address);
    }
}

/// What the hooks need to know.
#[derive(Clone)]
pub(super) struct Permissions {
    pub(super) passes: Passes,
    pub(super) topics: Topics,
    pub(super) elected: Elected,
    pub(super) counters: Arc<Counters>,
}

impl fmt::Debug for Permissions {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Permissions").finish_non_exhaustive()
    }
}

impl Permissions {
    /// Has rmqtt ask before it lets anybody log in or publish.
    pub(super) async fn install(self, context: &ServerContext) {
        let register = context.extends.hook_mgr().register();
        register.add(Type::ClientAuthenticate, Box::new(self.clone())).await;
        register.add(Type::MessagePublishCheckAcl, Box::new(self)).await;
        register.start().await;
    }

    /// Whether the connection may log in under this client id with this last will.
    fn admits(&self, info: &ConnectInfo) -> bool {
        match self.passes.holder(info.id().remote_addr) {
            // Past the gate: another process of this machine found the port behind it.
            None => false,
            Some(None) => true,
            Some(Some(identity)) => {
                let will = info.last_will().map(|will| match will {
                    LastWill::V3(will) => will.topic.clone(),
                    LastWill::V5(will) => will.topic.clone(),
                });
                may_be_called(&identity, info.client_id())
                    && will.is_none_or(|topic| may_publish(&identity, &self.topics, &topic, &self.elected))
            }
        }
    }

    fn permits(&self, address: Option<SocketAddr>, topic: &str) -> bool {
        match self.passes.holder(address) {
            None => false,
            Some(None) => true,
            Some(Some(identity)) => may_publish(&identity, &self.topics, topic, &self.elected),
        }
    }
}

#[async_trait]
impl Handler for Permissions {
    async fn hook(&self, parameter: &Parameter, _earlier: Option<HookResult>) -> ReturnType {
        let answer = match parameter {
            Parameter::ClientAuthenticate(info) => HookResult::AuthResult(if self.admits(info) {
                AuthResult::Allow(false, None)
            } else {
                self.counters.count(Event::ClientDenied);
                tracing::debug!(client = %info.client_id(), "login in another's name refused");
                AuthResult::NotAuthorized
            }),
            Parameter::MessagePublishCheckAcl(session, publish) => {
                HookResult::PublishAclResult(if self.permits(session.id.remote_addr, &publish.topic) {
                    PublishAclResult::allow()
                } else {
                    self.counters.count(Event::ClientDenied);
                    tracing::debug!(client = %session.id.client_id, topic = %publish.topic, "message refused");
                    PublishAclResult::rejected(false, None)
                })
            }
            _ => return (true, None),
        };
        (false, Some(answer))
    }
}

fn may_publish(identity: &Identity, topics: &Topics, topic: &str, elected: &Elected) -> bool {
    match topics.parse(topic) {
        Some(Topic::Detections(node) | Topic::VoteDetections(node) | Topic::Ledger(node) | Topic::Nodes(node)) => {
            identity.speaks_for(node.as_str())
        }
        Some(Topic::GlobalDetections | Topic::GlobalVerdicts | Topic::Reputations) => {
            identity.serves() && elected(identity.name())
        }
        None => false,
    }
}

/// A second connection of one client id ends the first: nobody may take another's. A node's is its name and its run; one
/// that the broker drew is 32 hexadecimal digits.
fn may_be_called(identity: &Identity, client_id: &str) -> bool {
    let is_run = |text: &str| text.len() == 32 && text.bytes().all(|byte| byte.is_ascii_hexdigit());
    let named = client_id.rsplit_once('-').is_some_and(|(name, run)| is_run(run) && identity.speaks_for(name));
    named || is_run(client_id)
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use ecod::wire::Role;

    use super::*;
    use crate::clock;
    use crate::pki::Authority;

    fn identity(name: &'static str, role: Role) -> Identity {
        let (directory, name) = (tempfile::tempdir().unwrap(), NodeName::from_static(name));
        let mut authority = Authority::init(directory.path(), &NodeName::from_static("lot"), clock::now()).unwrap();
        authority.issue(&name, role, Duration::from_secs(60), clock::now()).unwrap();
        let pem = std::fs::read(authority.files_of(&name).0).unwrap();
        Identity::of(&x509_parser::pem::parse_x509_pem(&pem).unwrap().1.contents).unwrap()
    }

    #[test]
    fn everyone_speaks_for_itself_and_the_elected_for_all() {
        let topics = Topics::new(&NodeName::from_static("lot"));
        let elected: Elected = Arc::new(|name| name.as_str() == "edge");
        let allows = |identity: &Identity, topic: &str| {
            may_publish(identity, &topics, &format!("ecod/v1/lot/{topic}"), &elected)
        };
        let (edge, euclid) = (identity("edge", Role::Edge), identity("euclid", Role::Auto));
        for topic in
            ["detections/euclid", "vote_detections/euclid", "ledger/euclid", "nodes/euclid", "nodes/euclid--top"]
        {
            assert!(allows(&euclid, topic) && !allows(&edge, topic), "{topic}");
        }
        for topic in ["global_detections", "global_verdicts", "reputations"] {
            assert!(allows(&edge, topic) && !allows(&euclid, topic), "{topic}");
            assert!(!allows(&identity("edge", Role::Cav), topic), "a vehicle that cannot lead");
        }
        assert!(!allows(&euclid, "nodes/euclid-2") && !allows(&euclid, "nodes/euclid/x"));
        assert!(!may_publish(&euclid, &topics, "ecod/v1/lot-2/detections/euclid", &elected));
        assert!(!may_publish(&euclid, &topics, "$SYS/x", &elected));
    }

    #[test]
    fn nobody_takes_the_client_id_of_another() {
        let euclid = identity("euclid", Role::Auto);
        let run = "0123456789abcdef0123456789abcdef";
        for good in [run.to_owned(), format!("euclid-{run}"), format!("euclid--top-7-{run}")] {
            assert!(may_be_called(&euclid, &good), "{good}");
        }
        for bad in [format!("edge-{run}"), format!("euclid-2-{run}"), "euclid".into(), "edge".into(), String::new()] {
            assert!(!may_be_called(&euclid, &bad), "{bad}");
        }
    }
}
