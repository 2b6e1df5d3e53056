//! Permissions at the embedded broker: hooks of rmqtt that check the principal of a connection.
//!
//! | topic | may publish |
//! |---|---|
//! | `detections/N`, `vote_detections/N`, `boxes/N`, and each of a part `N--…` | the certificate of `N` |
//! | `ledger/N` | the certificate of `N`, if `N` may lead |
//! | `nodes/N`, `nodes/N--…` | the certificate of `N`, which its observers share |
//! | `cell` | nodes that may lead; receivers check which node set it |
//! | `global_detections`, `global_verdicts`, `reputations` | the leader; without a leader, nodes that may lead |
//! | anything else | no client |
//!
//! Only statuses, reputations and the cell's description may be retained: other messages are
//! worthless when late. Every client with a certificate of the cell may read all topics. Topics and
//! filters are bounded in length and in levels.

use std::net::SocketAddr;
use std::sync::Arc;

use async_trait::async_trait;
use ecod::wire::{Limits, MAX_DESCRIPTION_BYTES, Topic, Topics};
use rmqtt::codec::v5::SubscribeAckReason;
use rmqtt::context::ServerContext;
use rmqtt::hook::{Handler, HookResult, Parameter, ReturnType, Type};
use rmqtt::session::Session;
use rmqtt::types::{
    AuthResult, ConnectInfo, LastWill, Publish, PublishAclResult, QoS, SubscribeAclResult,
    TopicFilter,
};

use super::door::{BoxRoute, Door, DoorRefusal, TopicPlace};
use super::principal::{LeaderCheck, Principal, PrincipalRegistry, is_run};
use crate::telemetry::counters::{Counters, Event};
use crate::transport::mqtt::ENVELOPE_BYTES;
use crate::transport::pki::{CertificateSubject, Credentials};

/// Rules of access to an embedded broker.
#[derive(Clone)]
pub struct AccessPolicy {
    /// The node's certificates. Without them every client may log in and publish anything, within
    /// limits.
    pub credentials: Option<Arc<Credentials>>,
    /// Topics of the cell, to which the rules apply.
    pub topics: Topics,
    /// Largest payloads that the cell's nodes accept.
    pub limits: Limits,
    /// Decides which node may publish maps, verdicts and reputations.
    pub elected: LeaderCheck,
    /// Counters of the node, shared by its actors.
    pub counters: Arc<Counters>,
}

/// Hooks of rmqtt that check logins, messages and filters.
#[derive(Clone)]
pub(super) struct Permissions {
    pub(super) principals: PrincipalRegistry,
    pub(super) policy: AccessPolicy,
    pub(super) door: Door,
}

impl Permissions {
    pub(super) async fn install(self, context: &ServerContext) {
        let register = context.extends.hook_mgr().register();
        use Type::{
            ClientAuthenticate, ClientSubscribeCheckAcl, ClientUnsubscribe, MessagePublishCheckAcl,
        };
        for hook in [
            ClientAuthenticate,
            MessagePublishCheckAcl,
            ClientSubscribeCheckAcl,
            ClientUnsubscribe,
        ] {
            register.add(hook, Box::new(self.clone())).await;
        }
        register.start().await;
    }

    /// True if the connection may log in under this client id with this last will.
    fn allows_login(&self, info: &ConnectInfo) -> bool {
        // Unregistered: a local process that connected past the frontend.
        let Some(principal) = self.principals.principal(info.id().remote_addr) else {
            return false;
        };
        let may_publish_will = |will: LastWill<'_>| {
            let (topic, retain, bytes) = match will {
                LastWill::V3(will) => (&will.topic, will.retain, will.message.len()),
                LastWill::V5(will) => (&will.topic, will.retain, will.message.len()),
            };
            if self.door.is_program(&principal, info.client_id()) {
                self.is_within_limits(topic, retain, bytes)
                    && self.door.allows_will(&principal, topic)
            } else {
                self.allows(&principal, topic, retain, bytes)
            }
        };
        let is_own = |identity: &Arc<CertificateSubject>| {
            principal.has_generated_id || may_use_client_id(identity, info.client_id())
        };
        principal.identity.as_ref().is_none_or(is_own)
            && info.last_will().is_none_or(may_publish_will)
    }

    /// Accepts a message, or returns the reason for refusing it.
    fn check_publish(&self, session: &Session, publish: &Publish) -> Result<(), DoorRefusal> {
        let (place, topic) = TopicPlace::of(&publish.topic);
        let refused =
            || DoorRefusal::not_permitted(format!("no permission to publish {topic} here"));
        let principal = self
            .principals
            .principal(session.id.remote_addr)
            .ok_or_else(refused)?;
        let retain = publish.retain;
        let bytes = publish.payload.len();
        if self.door.is_program(&principal, &session.id.client_id) {
            self.check_limits(topic, retain, bytes)
                .map_err(DoorRefusal::not_permitted)?;
            return self.door.on_publish(&principal, place, topic, publish);
        }
        if place != TopicPlace::Cell || !self.allows(&principal, topic, retain, bytes) {
            return Err(refused());
        }
        match self.policy.topics.parse(topic) {
            // A vehicle without a node, by its certificate.
            Some(Topic::Boxes(name)) => {
                self.door
                    .on_boxes(&name, BoxRoute::Broker, &publish.payload)
            }
            _ => Ok(()),
        }
    }

    /// True if a principal may publish on a topic. Without certificates every topic is allowed,
    /// within its limits of size and retention.
    fn allows(&self, principal: &Principal, topic: &str, retain: bool, bytes: usize) -> bool {
        let may_publish = |identity: &Arc<CertificateSubject>| {
            let topic = self.policy.topics.parse(topic);
            topic.is_some_and(|topic| may_publish(identity, &topic, &self.policy.elected))
        };
        self.is_within_limits(topic, retain, bytes)
            && principal.identity.as_ref().is_none_or(may_publish)
    }

    /// True if a message is within its topic's limits of size and retention.
    fn is_within_limits(&self, topic: &str, retain: bool, bytes: usize) -> bool {
        self.check_limits(topic, retain, bytes).is_ok()
    }

    /// The limit that a message exceeds, if any.
    fn check_limits(&self, topic: &str, retain: bool, bytes: usize) -> Result<(), String> {
        if !is_topic_bounded(topic) {
            let length = topic.len();
            let levels = topic.split('/').count();
            let most = format!("at most {MAX_TOPIC_BYTES} and {MAX_TOPIC_LEVELS}");
            return Err(format!(
                "the topic has {length} bytes and {levels} levels, {most}"
            ));
        }
        let parsed = self.policy.topics.parse(topic);
        let limits = &self.policy.limits;
        let limit = parsed
            .as_ref()
            .map_or(limits.payload_bytes, |topic| max_bytes(topic, limits));
        if bytes > limit + ENVELOPE_BYTES {
            return Err(format!("{bytes} bytes on {topic}, at most {limit}"));
        }
        if retain && !parsed.as_ref().is_some_and(is_state) {
            return Err(format!("{topic} may not be retained"));
        }
        Ok(())
    }

    /// Counts a refused message by its sender: a program's at the door, a round of a candidate that
    /// does not lead separately, any other message as denied.
    fn record_refusal(&self, session: &Session, publish: &Publish, refusal: &DoorRefusal) {
        let client = &session.id.client_id;
        let topic = TopicPlace::of(&publish.topic).1;
        let Some(principal) = self.principals.principal(session.id.remote_addr) else {
            // The connection has ended, so the refusal is counted without its source.
            self.policy.counters.count(Event::ClientDenied);
            tracing::debug!(%client, topic, "message of an ended connection refused");
            return;
        };
        if self.door.is_program(&principal, client) {
            return self.door.record_refusal(client, topic, refusal);
        }
        let may_lead = principal
            .identity
            .is_some_and(|identity| identity.may_serve());
        let topic_of_leader = self.policy.topics.parse(topic).is_some_and(|topic| {
            matches!(
                topic,
                Topic::GlobalDetections | Topic::GlobalVerdicts | Topic::Reputations
            )
        });
        if may_lead && topic_of_leader {
            self.principals
                .count_not_leading(session.id.remote_addr, &self.policy.counters);
        } else {
            self.count_denied(session.id.remote_addr);
        }
        tracing::debug!(%client, topic, "message refused");
    }

    fn count_denied(&self, address: Option<SocketAddr>) {
        self.principals.count_denied(address, &self.policy.counters);
    }

    /// The filter as it is inside the broker.
    fn inner_filter(&self, session: &Session, filter: &TopicFilter) -> Option<TopicFilter> {
        let principal = self.principals.principal(session.id.remote_addr)?;
        self.door
            .is_program(&principal, &session.id.client_id)
            .then(|| TopicPlace::Door.topic(filter).into())
    }
}

/// Maximum levels of a topic or filter. rmqtt recurses once for each level and would overflow its
/// stack.
pub(super) const MAX_TOPIC_LEVELS: usize = 32;

/// Maximum payload of a status in bytes. A typical status has some hundred; statuses are retained,
/// and sent to each new subscriber.
const MAX_STATUS_BYTES: usize = 16 * 1024;

/// Maximum payload of a description in bytes. Line feeds and quotes of its text take two bytes each
/// in JSON; its other fields take a few hundred.
const MAX_CELL_BYTES: usize = 2 * MAX_DESCRIPTION_BYTES + 1024;

/// Maximum length of a topic or filter in bytes.
const MAX_TOPIC_BYTES: usize = 512;

/// True if rmqtt can hold a topic or filter.
pub(super) fn is_topic_bounded(topic: &str) -> bool {
    topic.len() <= MAX_TOPIC_BYTES && topic.split('/').count() <= MAX_TOPIC_LEVELS
}

#[async_trait]
impl Handler for Permissions {
    async fn hook(&self, parameter: &Parameter, _earlier: Option<HookResult>) -> ReturnType {
        let answer = match parameter {
            Parameter::ClientAuthenticate(info) => {
                HookResult::AuthResult(if self.allows_login(info) {
                    AuthResult::Allow(false, None)
                } else {
                    self.count_denied(info.id().remote_addr);
                    tracing::debug!(client = %info.client_id(), "login refused");
                    AuthResult::NotAuthorized
                })
            }
            Parameter::MessagePublishCheckAcl(session, publish) => {
                HookResult::PublishAclResult(match self.check_publish(session, publish) {
                    Ok(()) => PublishAclResult::allow(),
                    Err(refusal) => {
                        self.record_refusal(session, publish, &refusal);
                        refusal.answer()
                    }
                })
            }
            Parameter::ClientSubscribeCheckAcl(session, subscribe)
                if !is_topic_bounded(&subscribe.topic_filter) =>
            {
                self.count_denied(session.id.remote_addr);
                HookResult::SubscribeAclResult(SubscribeAclResult::new_failure(
                    SubscribeAckReason::TopicFilterInvalid,
                ))
            }
            // QoS 0: a missing acknowledgement would hold messages in memory.
            Parameter::ClientSubscribeCheckAcl(..) => HookResult::SubscribeAclResult(
                SubscribeAclResult::new_success(QoS::AtMostOnce, None),
            ),
            // An UNSUBACK cannot refuse. Such a filter is not subscribed in the first place, so
            // there is no subscription to end.
            Parameter::ClientUnsubscribe(session, unsubscribe)
                if !is_topic_bounded(&unsubscribe.topic_filter) =>
            {
                self.count_denied(session.id.remote_addr);
                HookResult::TopicFilter(Some(TopicFilter::default()))
            }
            Parameter::ClientUnsubscribe(session, unsubscribe) => {
                HookResult::TopicFilter(self.inner_filter(session, &unsubscribe.topic_filter))
            }
            _ => return (true, None),
        };
        (false, Some(answer))
    }
}

/// Largest payload that receivers of the topic accept, in bytes.
fn max_bytes(topic: &Topic, limits: &Limits) -> usize {
    match topic {
        Topic::Detections(_) | Topic::VoteDetections(_) | Topic::Boxes(_) | Topic::Ledger(_) => {
            limits.payload_bytes
        }
        Topic::Nodes(_) => limits.payload_bytes.min(MAX_STATUS_BYTES),
        Topic::GlobalDetections | Topic::GlobalVerdicts | Topic::Reputations => limits.map_bytes,
        Topic::Cell => limits.map_bytes.min(MAX_CELL_BYTES),
    }
}

/// True if the topic's last message may be retained.
fn is_state(topic: &Topic) -> bool {
    matches!(topic, Topic::Nodes(_) | Topic::Reputations | Topic::Cell)
}

fn may_publish(identity: &CertificateSubject, topic: &Topic, elected: &LeaderCheck) -> bool {
    match topic {
        Topic::Detections(node) | Topic::VoteDetections(node) | Topic::Boxes(node) => {
            identity.may_act_as(node.as_str())
        }
        Topic::Ledger(node) => identity.may_serve() && identity.name() == node,
        Topic::Nodes(node) => identity.may_act_as(node.as_str()),
        Topic::Cell => identity.may_serve(),
        Topic::GlobalDetections | Topic::GlobalVerdicts | Topic::Reputations => {
            identity.may_serve() && elected(identity.name())
        }
    }
}

/// True if a client id is the name and run of this node or of its observer. A connection ends an
/// earlier one with the same client id, so client ids of other nodes are refused.
fn may_use_client_id(identity: &CertificateSubject, client_id: &str) -> bool {
    client_id
        .rsplit_once('-')
        .is_some_and(|(name, run)| is_run(run) && identity.may_act_as(name))
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use ecod::model::names::NodeName;
    use ecod::wire::{
        CellDescription, ContentHash, Encoding, MAX_INTEGER, Role, SCHEMA_VERSION, encode,
    };

    use super::*;
    use crate::platform::clock;
    use crate::transport::pki::Authority;

    fn identity(name: &'static str, role: Role) -> CertificateSubject {
        let directory = tempfile::tempdir().unwrap();
        let name = NodeName::from_static(name);
        let mut authority = Authority::init(
            directory.path(),
            &NodeName::from_static("lot"),
            clock::now(),
        )
        .unwrap();
        authority
            .issue(&name, role, Duration::from_secs(60), clock::now())
            .unwrap();
        let pem = std::fs::read(authority.files_of(&name).0).unwrap();
        CertificateSubject::of(&x509_parser::pem::parse_x509_pem(&pem).unwrap().1.contents).unwrap()
    }

    fn anyone() -> Principal {
        Principal::new(None, [10, 0, 0, 1].into(), false)
    }

    fn with(identity: &CertificateSubject) -> Principal {
        Principal::new(Some(identity.clone()), [10, 0, 0, 1].into(), false)
    }

    fn permissions() -> Permissions {
        let policy = AccessPolicy {
            credentials: None,
            topics: Topics::new(&NodeName::from_static("lot")),
            limits: Limits {
                payload_bytes: 1000,
                map_bytes: 5000,
                ..Limits::default()
            },
            elected: Arc::new(|name| name.as_str() == "edge"),
            counters: Arc::default(),
        };
        Permissions {
            principals: PrincipalRegistry::default(),
            policy,
            door: Door::default(),
        }
    }

    #[test]
    fn only_elected_publishes_for_others() {
        let permissions = permissions();
        let allows = |identity: &CertificateSubject, topic: &str| {
            permissions.allows(&with(identity), &format!("ecod/v1/lot/{topic}"), false, 0)
        };
        let edge = identity("edge", Role::Edge);
        let euclid = identity("euclid", Role::Auto);
        for topic in [
            "detections/euclid",
            "vote_detections/euclid",
            "detections/euclid--lidar",
            "vote_detections/euclid--lidar",
            "ledger/euclid",
            "nodes/euclid",
            "nodes/euclid--top",
        ] {
            assert!(allows(&euclid, topic) && !allows(&edge, topic), "{topic}");
        }
        assert!(
            !allows(&euclid, "ledger/euclid--2"),
            "parts read and do not lead"
        );
        let vehicle = identity("euclid", Role::Cav);
        assert!(
            allows(&vehicle, "vote_detections/euclid") && !allows(&vehicle, "ledger/euclid"),
            "it does not count votes"
        );
        for topic in ["global_detections", "global_verdicts", "reputations"] {
            assert!(allows(&edge, topic) && !allows(&euclid, topic), "{topic}");
            assert!(
                !allows(&identity("edge", Role::Cav), topic),
                "a vehicle that cannot lead"
            );
        }
        assert!(allows(&edge, "cell") && allows(&euclid, "cell") && !allows(&vehicle, "cell"));
        assert!(!allows(&euclid, "nodes/euclid-2") && !allows(&euclid, "nodes/euclid/x"));
        assert!(!permissions.allows(&with(&euclid), "ecod/v1/lot-2/detections/euclid", false, 0));
        assert!(!permissions.allows(&with(&euclid), "$SYS/x", false, 0));
    }

    #[test]
    fn only_status_and_reputations_retained() {
        let permissions = permissions();
        let edge = with(&identity("edge", Role::Edge));
        let streams = [
            "detections/edge",
            "vote_detections/edge",
            "ledger/edge",
            "global_detections",
            "global_verdicts",
        ];
        for principal in [edge, anyone()] {
            let allows = |topic: &str, retain| {
                permissions.allows(&principal, &format!("ecod/v1/lot/{topic}"), retain, 0)
            };
            for topic in streams {
                assert!(allows(topic, false) && !allows(topic, true), "{topic}");
            }
            assert!(allows("nodes/edge", true) && allows("reputations", true));
            assert!(!permissions.allows(&principal, "elsewhere", true, 0));
        }
        assert!(
            permissions.allows(&anyone(), "elsewhere", false, 0),
            "without certificates every client may publish everything"
        );
    }

    #[test]
    fn report_limit_is_below_map() {
        let permissions = permissions();
        for principal in [with(&identity("edge", Role::Edge)), anyone()] {
            let allows = |topic: &str, bytes| {
                permissions.allows(
                    &principal,
                    &format!("ecod/v1/lot/{topic}"),
                    false,
                    bytes + ENVELOPE_BYTES,
                )
            };
            for topic in [
                "detections/edge",
                "vote_detections/edge",
                "ledger/edge",
                "nodes/edge",
            ] {
                assert!(allows(topic, 1000) && !allows(topic, 1001), "{topic}");
            }
            for topic in ["global_detections", "global_verdicts", "reputations"] {
                assert!(allows(topic, 5000) && !allows(topic, 5001), "{topic}");
            }
        }
        assert!(!permissions.allows(&anyone(), "elsewhere", false, 5000));
    }

    #[test]
    fn status_limit_is_below_report() {
        let mut permissions = permissions();
        permissions.policy.limits = Limits::default();
        let allows = |topic: &str, bytes| {
            permissions.allows(
                &anyone(),
                &format!("ecod/v1/lot/{topic}"),
                true,
                bytes + ENVELOPE_BYTES,
            )
        };
        assert!(
            allows("nodes/edge", MAX_STATUS_BYTES) && !allows("nodes/edge", MAX_STATUS_BYTES + 1)
        );
        assert!(allows("reputations", MAX_STATUS_BYTES + 1));
    }

    #[test]
    fn line_feed_description_is_publishable() {
        let mut permissions = permissions();
        permissions.policy.limits = Limits::default();
        let description = CellDescription {
            schema: SCHEMA_VERSION,
            version: MAX_INTEGER,
            hash: ContentHash::default(),
            set_by: NodeName::new("x".repeat(64)).unwrap(),
            text: "\n".repeat(MAX_DESCRIPTION_BYTES),
        };
        for encoding in [Encoding::Json, Encoding::Cbor, Encoding::Compact] {
            let bytes = encode(&description, encoding).len() + ENVELOPE_BYTES;
            let edge = with(&identity("edge", Role::Edge));
            assert!(
                permissions.allows(&edge, "ecod/v1/lot/cell", true, bytes),
                "{bytes} bytes in {encoding:?}"
            );
        }
    }

    #[test]
    fn foreign_client_id_is_refused() {
        let euclid = identity("euclid", Role::Auto);
        let run = "0123456789abcdef0123456789abcdef";
        for good in [format!("euclid-{run}"), format!("euclid--top-7-{run}")] {
            assert!(may_use_client_id(&euclid, &good), "{good}");
        }
        let others = [
            format!("edge-{run}"),
            format!("euclid-2-{run}"),
            "euclid".into(),
            "edge".into(),
            String::new(),
        ];
        for bad in others.into_iter().chain([run.to_owned()]) {
            assert!(!may_use_client_id(&euclid, &bad), "{bad}");
        }
    }
}
