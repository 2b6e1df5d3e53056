//! From a packet to a decoded message in a receiver's hands; junk ends here as a count.

use std::fmt;
use std::sync::{Arc, Mutex, PoisonError, RwLock};

use ecod::leadership::BrokerAddress;
use ecod::leadership::links::LinkState;
use ecod::names::NodeName;
use ecod::time::Timestamp;
use ecod::wire::{
    GlobalMap, LedgerShare, Limits, NodeState, NodeStatus, ObjectReport, RejectReason, ReportKind, Reputations, Topic,
    Topics, Verdicts, check_fused_at, decode, decode_report, decode_share,
};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use uuid::Uuid;

use super::security::SigningKey;
use crate::platform::clock;
use crate::platform::throttle::KeyedThrottle;
use crate::telemetry::counters::{Counters, Event, ShedReason};

/// A checked message of the cell, or news about a link.
///
/// The same message may arrive over several links. Who drops the second: the report window, by node and capture time;
/// receivers of maps, verdicts and reputations, by epoch and round; a status says the same twice.
#[derive(Debug, Clone, PartialEq)]
pub enum Incoming {
    /// A vehicle's report; only candidates for aggregation get these, and nodes that watch.
    Report {
        /// What it is for.
        kind: ReportKind,
        /// The report, within the limits.
        report: Arc<ObjectReport>,
    },
    /// The fused map of a round.
    Map(Arc<GlobalMap>),
    /// The verdicts of a round.
    Verdicts(Arc<Verdicts>),
    /// Reputations, at once after connecting if the broker has some.
    Reputations(Arc<Reputations>),
    /// A part of another candidate's evidence; only candidates get these.
    Ledger(Arc<LedgerShare>),
    /// What another node says about itself, or its broker about it.
    Status {
        /// The status.
        status: Arc<NodeStatus>,
        /// The broker that passed it on.
        via: BrokerAddress,
    },
    /// A link changed.
    Link {
        /// The broker at its other end.
        broker: BrokerAddress,
        /// How it is now.
        state: LinkState,
    },
}

/// A message on its way to a receiver. Dropping it makes room for another: keep it until it has been dealt with.
#[derive(Debug)]
pub struct Delivery {
    /// The message.
    pub message: Incoming,
    /// When its packet was read from the socket, or when it was handed over in-process.
    pub received_at: Timestamp,
    _place: Option<OwnedSemaphorePermit>,
}

impl Delivery {
    /// What the node itself publishes or observes; its own pace bounds it.
    pub(crate) fn local(message: Incoming, at: Timestamp) -> Self {
        Self { message, received_at: at, _place: None }
    }
}

/// Takes messages to their receivers, typically by sending to actors; runs on the link's task and must not block.
pub type Subscriber = Arc<dyn Fn(Delivery) + Send + Sync>;

/// Decodes, counts and hands over; shared by the links of a gateway.
pub(crate) struct Inbox {
    node: NodeName,
    run: Uuid,
    topics: Topics,
    limits: Limits,
    signing: Option<SigningKey>,
    counters: Arc<Counters>,
    subscriber: RwLock<Subscriber>,
    capacity: Arc<Semaphore>,
    report_throttles: [Mutex<KeyedThrottle<NodeName>>; ReportKind::COUNT],
    ledger_throttle: Mutex<KeyedThrottle<NodeName>>,
    status_throttle: Mutex<KeyedThrottle<NodeName>>,
}

/// What became of a packet, as far as the link has to act on it.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum PacketOutcome {
    Done,
    /// The broker took this node for dead; it has to be told otherwise.
    DeclaredOffline,
    /// The broker passed on this run's own status: it may publish there.
    OwnStatus,
    /// Another living run has this node's name.
    Namesake(Uuid),
}

impl Inbox {
    pub(crate) fn new(
        (node, run): (NodeName, Uuid),
        topics: Topics,
        (limits, signing): (Limits, Option<SigningKey>),
        (capacity, max_report_hz): (usize, u32),
        counters: Arc<Counters>,
        subscriber: Subscriber,
    ) -> Self {
        Self {
            node,
            run,
            topics,
            limits,
            signing,
            counters,
            subscriber: RwLock::new(subscriber),
            capacity: Arc::new(Semaphore::new(capacity)),
            report_throttles: std::array::from_fn(|_| Mutex::new(KeyedThrottle::new(max_report_hz))),
            ledger_throttle: Mutex::new(KeyedThrottle::new(max_report_hz)),
            status_throttle: Mutex::new(KeyedThrottle::new(max_report_hz)),
        }
    }

    pub(crate) fn set_subscriber(&self, subscriber: Subscriber) {
        *self.subscriber.write().unwrap_or_else(PoisonError::into_inner) = subscriber;
    }

    /// Deals with one packet of a broker; a payload that cannot be used is counted by its reason.
    pub(crate) fn accept(
        &self,
        via: &BrokerAddress,
        topic: &[u8],
        payload: &[u8],
        received_at: Timestamp,
    ) -> PacketOutcome {
        self.counters.count(Event::Received);
        match self.read(via, topic, payload, received_at) {
            Ok(Read::Message(message)) => {
                self.deliver(message, received_at);
                PacketOutcome::Done
            }
            Ok(Read::Echo) => {
                self.counters.count(Event::Echo);
                PacketOutcome::Done
            }
            Ok(Read::Cleared | Read::Shed) => PacketOutcome::Done,
            Ok(Read::OwnDeath) => PacketOutcome::DeclaredOffline,
            Ok(Read::OwnStatus) => {
                self.counters.count(Event::Echo);
                PacketOutcome::OwnStatus
            }
            Ok(Read::Namesake(run)) => {
                self.counters.count(Event::NameConflict);
                PacketOutcome::Namesake(run)
            }
            Err(reason) => {
                self.counters.reject(reason);
                tracing::debug!(topic = %topic.escape_ascii(), bytes = payload.len(), %reason, "payload rejected");
                PacketOutcome::Done
            }
        }
    }

    /// Hands over a message that came from outside; dropped and counted when receivers are too far behind.
    fn deliver(&self, message: Incoming, received_at: Timestamp) {
        match Arc::clone(&self.capacity).try_acquire_owned() {
            Ok(place) => self.hand_over(Delivery { message, received_at, _place: Some(place) }),
            Err(_) => self.counters.count(Event::InboxFull),
        }
    }

    /// Hands over what this node itself publishes or observes.
    pub(crate) fn deliver_local(&self, message: Incoming) {
        self.hand_over(Delivery::local(message, clock::now()));
    }

    fn hand_over(&self, delivery: Delivery) {
        let subscriber = Arc::clone(&self.subscriber.read().unwrap_or_else(PoisonError::into_inner));
        subscriber(delivery);
    }

    fn read(
        &self,
        via: &BrokerAddress,
        topic: &[u8],
        payload: &[u8],
        received_at: Timestamp,
    ) -> Result<Read, RejectReason> {
        let path = std::str::from_utf8(topic).map_err(|_| RejectReason::UnknownTopic)?;
        let payload = match &self.signing {
            // Nothing is what takes a retained message back; it says nothing that could be signed.
            Some(key) if !payload.is_empty() => key.open(topic, payload).ok_or(RejectReason::BadSignature)?,
            _ => payload,
        };
        let message = match self.topics.parse(path).ok_or(RejectReason::UnknownTopic)? {
            Topic::Detections(node) => return self.read_report(ReportKind::Detections, &node, payload, received_at),
            Topic::VoteDetections(node) => {
                return self.read_report(ReportKind::VoteDetections, &node, payload, received_at);
            }
            Topic::Ledger(node) if node == self.node => return Ok(Read::Echo),
            Topic::Ledger(node) => {
                if !self.ledger_throttle.lock().unwrap_or_else(PoisonError::into_inner).allow(&node, received_at) {
                    self.counters.shed(ShedReason::LedgerThrottled, node.as_str());
                    return Ok(Read::Shed);
                }
                Incoming::Ledger(Arc::new(decode_share(payload, &node, &self.limits)?))
            }
            Topic::Nodes(node) => return self.read_status(via, &node, payload, received_at),
            Topic::GlobalDetections => {
                let map: GlobalMap = decode(payload, &self.limits)?;
                if map.aggregator == self.node {
                    return Ok(Read::Echo);
                }
                check_fused_at(map.fused_at_us, received_at)?;
                Incoming::Map(Arc::new(map))
            }
            Topic::GlobalVerdicts => {
                let verdicts: Verdicts = decode(payload, &self.limits)?;
                if verdicts.aggregator == self.node {
                    return Ok(Read::Echo);
                }
                check_fused_at(verdicts.fused_at_us, received_at)?;
                Incoming::Verdicts(Arc::new(verdicts))
            }
            Topic::Reputations if payload.is_empty() => return Ok(Read::Cleared),
            Topic::Reputations => {
                let reputations: Reputations = decode(payload, &self.limits)?;
                if reputations.aggregator.as_ref() == Some(&self.node) {
                    return Ok(Read::Echo);
                }
                Incoming::Reputations(Arc::new(reputations))
            }
        };
        Ok(Read::Message(message))
    }

    fn read_report(
        &self,
        kind: ReportKind,
        node: &NodeName,
        payload: &[u8],
        received_at: Timestamp,
    ) -> Result<Read, RejectReason> {
        if *node == self.node {
            return Ok(Read::Echo);
        }
        let mut report_throttles = self.report_throttles[kind as usize].lock().unwrap_or_else(PoisonError::into_inner);
        if !report_throttles.allow(node, received_at) {
            self.counters.shed(ShedReason::ReportThrottled, node.as_str());
            return Ok(Read::Shed);
        }
        drop(report_throttles);
        let report = Arc::new(decode_report(payload, node, &self.limits)?);
        Ok(Read::Message(Incoming::Report { kind, report }))
    }

    fn read_status(
        &self,
        via: &BrokerAddress,
        node: &NodeName,
        payload: &[u8],
        received_at: Timestamp,
    ) -> Result<Read, RejectReason> {
        if payload.is_empty() {
            return Ok(Read::Cleared);
        }
        if !self.status_throttle.lock().unwrap_or_else(PoisonError::into_inner).allow(node, received_at) {
            self.counters.shed(ShedReason::StatusThrottled, node.as_str());
            return Ok(Read::Shed);
        }
        let status: NodeStatus = decode(payload, &self.limits)?;
        if status.node != *node {
            return Err(RejectReason::NodeMismatch);
        }
        Ok(match (status.node == self.node, status.state) {
            (true, NodeState::Offline) => Read::OwnDeath,
            (true, NodeState::Following | NodeState::Aggregating) if status.id == self.run => Read::OwnStatus,
            (true, NodeState::Following | NodeState::Aggregating) => Read::Namesake(status.id),
            (false, _) => Read::Message(Incoming::Status { status: Arc::new(status), via: via.clone() }),
        })
    }
}

/// What a usable packet turned out to be.
enum Read {
    Message(Incoming),
    /// More of a node than is taken.
    Shed,
    /// Published by this node.
    Echo,
    /// A retained message was removed.
    Cleared,
    /// This node's last will.
    OwnDeath,
    /// This run's status.
    OwnStatus,
    /// The status of another run of this name.
    Namesake(Uuid),
}

impl fmt::Debug for Inbox {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Inbox").field("node", &self.node).finish_non_exhaustive()
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use ecod::wire::{Encoding, Role, encode};

    use super::*;
    use crate::telemetry::counters::Shed;

    /// The edge's, for so many undelivered messages and reports a second.
    fn inbox(
        (capacity, max_report_hz): (usize, u32),
        counters: &Arc<Counters>,
        receiver: impl Fn(Delivery) + Send + Sync + 'static,
    ) -> Inbox {
        Inbox::new(
            (NodeName::from_static("edge"), Uuid::nil()),
            Topics::new(&NodeName::from_static("lot")),
            (Limits::default(), None),
            (capacity, max_report_hz),
            Arc::clone(counters),
            Arc::new(receiver),
        )
    }

    fn broker() -> BrokerAddress {
        "10.0.0.2:1883".parse().unwrap()
    }

    /// One of 30 reports a second that counts what it delivers by the node that `node_of` names.
    fn counting(
        counters: &Arc<Counters>,
        node_of: impl Fn(&Incoming) -> &NodeName + Send + Sync + 'static,
    ) -> (Inbox, impl Fn(&'static str) -> u64) {
        let taken = Arc::new(Mutex::new(BTreeMap::<NodeName, u64>::new()));
        let receiver = Arc::clone(&taken);
        let inbox = inbox((16, 30), counters, move |delivery| {
            *receiver.lock().unwrap().entry(node_of(&delivery.message).clone()).or_default() += 1;
        });
        (inbox, move |node| taken.lock().unwrap()[&NodeName::from_static(node)])
    }

    #[test]
    fn a_full_inbox_drops_and_counts_until_a_receiver_catches_up() {
        let counters = Arc::new(Counters::default());
        let held = Arc::new(Mutex::new(Vec::new()));
        let receiver = Arc::clone(&held);
        let inbox = inbox((2, 100), &counters, move |delivery| receiver.lock().unwrap().push(delivery));
        let payload = |aggregator: &str| {
            let aggregator = NodeName::new(aggregator).ok();
            let reputations =
                Reputations { schema: 1, aggregator, epoch: 1, round: 1, reputations: Default::default() };
            encode(&reputations, Encoding::Json)
        };
        let accept_from = |aggregator: &str, at| {
            inbox.accept(&broker(), b"ecod/v1/lot/reputations", &payload(aggregator), Timestamp(at))
        };
        let accept = |at| accept_from("gauss", at);
        for at in 1..=5 {
            assert_eq!(accept(at), PacketOutcome::Done);
        }
        assert_eq!(counters.events(Event::InboxFull), 3);
        assert_eq!(held.lock().unwrap().remove(0).received_at, Timestamp(1));
        accept(6);
        assert_eq!(counters.events(Event::InboxFull), 3);
        let kept: Vec<_> = held.lock().unwrap().iter().map(|delivery| delivery.received_at).collect();
        assert_eq!(kept, [Timestamp(2), Timestamp(6)]);

        accept_from("edge", 7);
        assert_eq!((counters.events(Event::Echo), counters.events(Event::InboxFull)), (1, 3));
    }

    #[test]
    fn one_vehicle_that_floods_is_cut_down_and_counted_and_others_are_not() {
        let counters = Arc::new(Counters::default());
        let (inbox, taken) = counting(&counters, |message| match message {
            Incoming::Report { report, .. } => &report.node,
            other => panic!("{other:?}"),
        });
        for ms in 0..1000 {
            let accept = |node: &str| {
                let report = ObjectReport::new(NodeName::new(node).unwrap(), ms, Timestamp(ms));
                let topic = format!("ecod/v1/lot/detections/{node}");
                inbox.accept(&broker(), topic.as_bytes(), &encode(&report, Encoding::Json), Timestamp(ms * 1000))
            };
            for _ in 0..10 {
                accept("mallory");
            }
            if ms % 100 == 0 {
                accept("euclid");
            }
        }
        assert_eq!(["mallory", "euclid"].map(taken), [59, 10], "a second's worth at once, then 30 a second");
        let shed = Shed { reason: ShedReason::ReportThrottled, source: "mallory".into(), times: 10_000 - 59 };
        assert_eq!(counters.all_shed(), [shed]);
    }

    #[test]
    fn statuses_of_one_node_beyond_measure_reach_nobody() {
        let counters = Arc::new(Counters::default());
        let (inbox, taken) = counting(&counters, |message| match message {
            Incoming::Status { status, .. } => &status.node,
            other => panic!("{other:?}"),
        });
        let accept = |node: &'static str, ms: u64| {
            let status = NodeStatus::starting(NodeName::from_static(node), Uuid::max(), Role::Auto, "0.1.0");
            let topic = format!("ecod/v1/lot/nodes/{node}");
            inbox.accept(&broker(), topic.as_bytes(), &encode(&status, Encoding::Json), Timestamp(ms * 1000))
        };
        for ms in 0..1000 {
            accept("mallory", ms);
            if ms % 250 == 0 {
                accept("euclid", ms);
            }
        }
        assert_eq!(["mallory", "euclid"].map(taken), [59, 4], "a second's worth at once, then 30 a second");
        let shed = Shed { reason: ShedReason::StatusThrottled, source: "mallory".into(), times: 1000 - 59 };
        assert_eq!(counters.all_shed(), [shed]);
    }
}
