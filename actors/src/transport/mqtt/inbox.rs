//! Incoming packets: signature, decoding, checks, throttles and delivery to the subscriber.
//!
//! A payload that cannot be used ends here as a count.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, RwLock};

use bytes::Bytes;
use ecod::leadership::links::LinkState;
use ecod::leadership::round_filter::Origin;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::wire::{
    Flaw, GlobalMap, InvalidEntry, Limits, NodeState, NodeStatus, Payload, RejectReason,
    ReportKind, Reputations, Topic, Topics, Verdicts, check_fused_at, decode, decode_entries,
    decode_report, decode_share,
};
use tokio::sync::Semaphore;
use uuid::Uuid;

use super::config::MqttConfig;
use super::delivery::{Delivery, Incoming, Subscriber};
use super::packet_sink::{PacketOutcome, PacketSink, Via};
use super::security::Security;
use crate::platform::cell_clock::CellClock;
use crate::platform::clock;
use crate::platform::throttle::{KeyedThrottle, tokens_of_report};
use crate::telemetry::counters::{Counters, Event, ShedReason};

/// Decodes, checks and delivers packets; shared by the links of a gateway.
pub(crate) struct Inbox {
    node: NodeName,
    run: Uuid,
    topics: Topics,
    limits: Limits,
    security: Security,
    clock: CellClock,
    counters: Arc<Counters>,
    subscriber: RwLock<Subscriber>,
    /// Deliveries that receivers may still hold.
    capacity: Arc<Semaphore>,
    max_report_hz: u32,
    report_throttles: [NodeThrottle; ReportKind::COUNT],
    ledger_throttle: NodeThrottle,
    status_throttle: NodeThrottle,
    /// The latest rounds that this node published.
    published: Mutex<VecDeque<Bytes>>,
}

/// Number of own rounds whose echoes are recognised without decoding: map and verdicts of two
/// rounds, each of which comes back from up to two brokers.
const MAX_PUBLISHED: usize = 4;

type NodeThrottle = Mutex<KeyedThrottle<NodeName>>;

impl Inbox {
    pub(crate) fn new(
        own: &NodeStatus,
        topics: Topics,
        config: &MqttConfig,
        security: Security,
        clock: CellClock,
        counters: Arc<Counters>,
        subscriber: Subscriber,
    ) -> Self {
        let throttle = || Mutex::new(KeyedThrottle::per_second(config.max_report_hz));
        Self {
            node: own.node.clone(),
            run: own.id,
            topics,
            limits: config.limits(),
            security,
            clock,
            counters,
            subscriber: RwLock::new(subscriber),
            capacity: Arc::new(Semaphore::new(config.inbox)),
            max_report_hz: config.max_report_hz,
            report_throttles: std::array::from_fn(|_| throttle()),
            ledger_throttle: throttle(),
            status_throttle: throttle(),
            published: Mutex::default(),
        }
    }

    pub(crate) fn set_subscriber(&self, subscriber: Subscriber) {
        *self
            .subscriber
            .write()
            .unwrap_or_else(PoisonError::into_inner) = subscriber;
    }

    /// Delivers a message that this node itself publishes or observes.
    pub(crate) fn deliver_local(&self, message: Incoming) {
        self.hand_over(Delivery::local(message, clock::now()));
    }

    /// Records a round that this node publishes, as sent. Its echoes are then not decoded, which would
    /// cost as much time as a round of another node.
    pub(crate) fn record_published(&self, round: &Bytes) {
        let mut published = self.published();
        if published.len() >= MAX_PUBLISHED {
            published.pop_front();
        }
        published.push_back(round.clone());
    }

    /// True if these bytes, as received, are one of the latest rounds that this node published.
    fn is_own_round(&self, sealed: &[u8]) -> bool {
        self.published().iter().any(|round| round == sealed)
    }

    fn published(&self) -> MutexGuard<'_, VecDeque<Bytes>> {
        self.published
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
    }

    /// Delivers the state of a link to a broker.
    pub(crate) fn deliver_link(&self, via: Via<'_>, state: LinkState) {
        let message = Incoming::Link {
            broker: via.address.clone(),
            state,
        };
        self.hand_over(Delivery {
            broker: via.node.cloned(),
            ..Delivery::local(message, clock::now())
        });
    }

    /// Delivers a message of a broker. Dropped and counted when receivers are too far behind.
    fn deliver(
        &self,
        via: Via<'_>,
        message: Incoming,
        origin: Origin,
        received_at: Timestamp,
    ) -> PacketOutcome {
        let broker = via.node.cloned();
        match Arc::clone(&self.capacity).try_acquire_owned() {
            Ok(place) => self.hand_over(Delivery {
                message,
                received_at,
                origin,
                broker,
                _place: Some(place),
            }),
            Err(_) => self.counters.count(Event::InboxFull),
        }
        PacketOutcome::Done
    }

    /// Passes a message to the current subscriber.
    fn hand_over(&self, delivery: Delivery) {
        let subscriber = Arc::clone(
            &self
                .subscriber
                .read()
                .unwrap_or_else(PoisonError::into_inner),
        );
        subscriber(delivery);
    }

    /// Handles one packet of the cell by its topic: verifies the envelope, drops echoes of this
    /// node and messages above their rate, decodes and checks the payload, and delivers it.
    ///
    /// # Errors
    /// Returns the reason under which the packet is counted as rejected.
    ///
    /// # Example
    /// A map of `edge` arrives over the link to the standby's broker. Its signature proves `edge`,
    /// so that it is delivered as a proven round. The same map arrives over the link to `edge`'s
    /// own broker: it is delivered again, and the follower's filter refuses it as repeated.
    fn read(
        &self,
        via: Via<'_>,
        topic: &[u8],
        payload: &[u8],
        received_at: Timestamp,
    ) -> Result<PacketOutcome, RejectReason> {
        let path = std::str::from_utf8(topic).map_err(|_| RejectReason::UnknownTopic)?;
        let sealed = payload;
        let payload = match &self.security.signing {
            // An empty payload deletes a retained message. It has no content to sign.
            Some(key) if !payload.is_empty() => key
                .verify(topic, payload)
                .ok_or(RejectReason::BadSignature)?,
            _ => payload,
        };
        let origin = |aggregator| self.origin(via, aggregator, topic, payload);
        let (message, origin) = match self.topics.parse(path).ok_or(RejectReason::UnknownTopic)? {
            Topic::GlobalDetections | Topic::GlobalVerdicts if self.is_own_round(sealed) => {
                return Ok(self.echo());
            }
            Topic::Detections(node) => {
                return self.read_report(via, ReportKind::Detections, &node, payload, received_at);
            }
            Topic::VoteDetections(node) => {
                return self.read_report(
                    via,
                    ReportKind::VoteDetections,
                    &node,
                    payload,
                    received_at,
                );
            }
            // Brokers project boxes and publish the resulting report.
            Topic::Boxes(_) => return Err(RejectReason::UnknownTopic),
            Topic::Nodes(node) => return self.read_status(via, &node, payload, received_at),
            Topic::Ledger(node) if node == self.node => return Ok(self.echo()),
            Topic::Ledger(node) => {
                if self.is_shed(
                    &self.ledger_throttle,
                    ShedReason::LedgerThrottled,
                    &node,
                    1,
                    received_at,
                ) {
                    return Ok(PacketOutcome::Done);
                }
                (
                    Incoming::Ledger(Arc::new(decode_share(payload, &node, &self.limits)?)),
                    Origin::Claimed,
                )
            }
            Topic::GlobalDetections => {
                let map: GlobalMap =
                    self.decode_entries(payload, |map: &GlobalMap| Some(&map.aggregator))?;
                if map.aggregator == self.node {
                    return Ok(self.echo());
                }
                self.check_date(map.fused_at_us, received_at)?;
                let Some(origin) = origin(Some(&map.aggregator)) else {
                    return Ok(self.refuse_unproven(via, topic));
                };
                (Incoming::Map(Arc::new(map)), origin)
            }
            Topic::GlobalVerdicts => {
                let verdicts: Verdicts =
                    self.decode_entries(payload, |verdicts: &Verdicts| Some(&verdicts.aggregator))?;
                if verdicts.aggregator == self.node {
                    return Ok(self.echo());
                }
                self.check_date(verdicts.fused_at_us, received_at)?;
                let Some(origin) = origin(Some(&verdicts.aggregator)) else {
                    return Ok(self.refuse_unproven(via, topic));
                };
                (Incoming::Verdicts(Arc::new(verdicts)), origin)
            }
            Topic::Cell | Topic::Reputations if payload.is_empty() => {
                return Ok(PacketOutcome::Done);
            }
            Topic::Cell => (
                Incoming::Description(Arc::new(decode(payload, &self.limits)?)),
                Origin::Claimed,
            ),
            Topic::Reputations => {
                let reputations: Reputations = self
                    .decode_entries(payload, |reputations: &Reputations| {
                        reputations.aggregator.as_ref()
                    })?;
                if reputations.aggregator.as_ref() == Some(&self.node) {
                    return Ok(self.echo());
                }
                let Some(origin) = origin(reputations.aggregator.as_ref()) else {
                    return Ok(self.refuse_unproven(via, topic));
                };
                (Incoming::Reputations(Arc::new(reputations)), origin)
            }
        };
        Ok(self.deliver(via, message, origin, received_at))
    }

    /// Decodes a map, verdicts or reputations. Entries out of bounds are left out and counted; the
    /// rest is used.
    fn decode_entries<T: Payload>(
        &self,
        payload: &[u8],
        aggregator: impl FnOnce(&T) -> Option<&NodeName>,
    ) -> Result<T, RejectReason> {
        let (message, invalid) = decode_entries::<T>(payload, &self.limits)?;
        let aggregator = aggregator(&message).filter(|aggregator| **aggregator != self.node);
        if let Some(aggregator) = aggregator {
            for InvalidEntry { reason, .. } in invalid {
                self.counters.count(Event::EntryLeftOut);
                self.counters
                    .reject_message(reason, aggregator.as_str(), || {
                        format!(
                            "an entry that it publishes is not used: {}",
                            reason.in_words()
                        )
                    });
            }
        }
        Ok(message)
    }

    /// Proof of a round's aggregator; `None` if the round must be refused from this broker.
    fn origin(
        &self,
        via: Via<'_>,
        aggregator: Option<&NodeName>,
        topic: &[u8],
        payload: &[u8],
    ) -> Option<Origin> {
        Origin::of(aggregator, via.node, || {
            self.security.check_round(aggregator, topic, payload)
        })
    }

    /// Counts a round that its aggregator has not proven. A leader that restarts, or has a new
    /// certificate, may publish before this node has received that certificate.
    fn refuse_unproven(&self, via: Via<'_>, topic: &[u8]) -> PacketOutcome {
        self.counters
            .reject_if_lasting(RejectReason::BadSignature, &self.source(via, topic));
        tracing::debug!(topic = %topic.escape_ascii(), "round not proven");
        PacketOutcome::Done
    }

    /// Checks that a round is not from the far future, as far as this node has a time estimate.
    fn check_date(&self, fused_at: Timestamp, received_at: Timestamp) -> Result<(), RejectReason> {
        self.clock
            .date_if_set(received_at)
            .map_or(Ok(()), |date| check_fused_at(fused_at, date))
    }

    /// Handles a vehicle's report. Parts share the rate of their vehicle, and a large report counts
    /// as several.
    ///
    /// # Errors
    /// Returns the reason why the report is unusable.
    fn read_report(
        &self,
        via: Via<'_>,
        kind: ReportKind,
        node: &NodeName,
        payload: &[u8],
        received_at: Timestamp,
    ) -> Result<PacketOutcome, RejectReason> {
        // Parts share the rate of their vehicle.
        let vehicle = node.vehicle();
        if vehicle == self.node {
            return Ok(self.echo());
        }
        let throttle = &self.report_throttles[kind as usize];
        let count =
            tokens_of_report(payload.len(), self.limits.payload_bytes).min(self.max_report_hz);
        let is_shed = self.is_shed(
            throttle,
            ShedReason::ReportThrottled,
            &vehicle,
            count,
            received_at,
        );
        if is_shed {
            return Ok(PacketOutcome::Done);
        }
        let report = Arc::new(decode_report(payload, node, &self.limits)?);
        Ok(self.deliver(
            via,
            Incoming::Report { kind, report },
            Origin::Claimed,
            received_at,
        ))
    }

    /// Handles the status of a node, or its withdrawal by an empty payload. This node's own status
    /// is not delivered: its outcome shows whether the broker declared this node offline, returned
    /// the status, or forwarded it from another run of the same name.
    ///
    /// # Errors
    /// Returns the reason why the status is unusable.
    fn read_status(
        &self,
        via: Via<'_>,
        node: &NodeName,
        payload: &[u8],
        received_at: Timestamp,
    ) -> Result<PacketOutcome, RejectReason> {
        let is_shed = |vehicle| {
            self.is_shed(
                &self.status_throttle,
                ShedReason::StatusThrottled,
                vehicle,
                1,
                received_at,
            )
        };
        if is_shed(&node.vehicle()) {
            return Ok(PacketOutcome::Done);
        }
        if payload.is_empty() {
            let message = Incoming::StatusWithdrawn {
                node: node.clone(),
                via: via.address.clone(),
            };
            return Ok(self.deliver(via, message, Origin::Claimed, received_at));
        }
        let status: NodeStatus = decode(payload, &self.limits)?;
        if status.node != *node {
            return Err(RejectReason::NodeMismatch);
        }
        if status.node != self.node {
            let status = Arc::new(status);
            let message = Incoming::Status {
                status,
                via: via.address.clone(),
            };
            return Ok(self.deliver(via, message, Origin::Claimed, received_at));
        }
        Ok(if status.state == NodeState::Offline {
            PacketOutcome::DeclaredOffline
        } else if status.id == self.run {
            self.counters.count(Event::Echo);
            PacketOutcome::OwnStatus
        } else {
            self.counters.count(Event::NameConflict);
            PacketOutcome::Namesake(status.id)
        })
    }

    /// Name of the node that a topic belongs to; if there is none, the address of the broker.
    fn source(&self, via: Via<'_>, topic: &[u8]) -> String {
        let topic = std::str::from_utf8(topic)
            .ok()
            .and_then(|path| self.topics.parse(path));
        match topic {
            Some(
                Topic::Detections(node)
                | Topic::VoteDetections(node)
                | Topic::Boxes(node)
                | Topic::Ledger(node)
                | Topic::Nodes(node),
            ) => node.to_string(),
            _ => via.address.to_string(),
        }
    }

    /// The fault of a rejected report, with the field.
    fn fault(&self, topic: &[u8], payload: &[u8], reason: RejectReason) -> String {
        let signed = self
            .security
            .signing
            .as_ref()
            .map(|key| key.verify(topic, payload));
        match signed.unwrap_or(Some(payload)) {
            Some(report) => format!(
                "report rejected: {}",
                Flaw::of_report(report, reason, &self.limits)
            ),
            None => format!("report rejected: {}", reason.in_words()),
        }
    }

    /// Counts a message that this node published itself.
    fn echo(&self) -> PacketOutcome {
        self.counters.count(Event::Echo);
        PacketOutcome::Done
    }

    /// Charges `count` messages to the rate of a node. Returns true, and counts the message as shed, if
    /// the node sends more than its rate allows.
    fn is_shed(
        &self,
        throttle: &NodeThrottle,
        reason: ShedReason,
        node: &NodeName,
        count: u32,
        at: Timestamp,
    ) -> bool {
        let is_shed = !throttle
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .allow_many(node, count, at);
        if is_shed {
            self.counters.shed(reason, node.as_str());
        }
        is_shed
    }
}

impl PacketSink for Inbox {
    /// Processes one packet of a broker. A payload that cannot be used is counted by its reason.
    fn accept(
        &self,
        via: Via<'_>,
        topic: &[u8],
        payload: &[u8],
        received_at: Timestamp,
    ) -> PacketOutcome {
        self.counters.count(Event::Received);
        self.read(via, topic, payload, received_at).unwrap_or_else(|reason| {
            let source = self.source(via, topic);
            match std::str::from_utf8(topic).ok().and_then(|path| self.topics.parse(path)) {
                Some(Topic::Detections(_) | Topic::VoteDetections(_)) => {
                    self.counters.reject_report(reason, &source, || self.fault(topic, payload, reason));
                }
                _ => self.counters.reject_message(reason, &source, || {
                    format!("message on {} rejected: {}", String::from_utf8_lossy(topic), reason.in_words())
                }),
            }
            tracing::debug!(topic = %topic.escape_ascii(), bytes = payload.len(), %reason, "payload rejected");
            PacketOutcome::Done
        })
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use ecod::wire::{Encoding, ObjectReport, PerceivedObject, Role, encode};

    use super::*;
    use crate::telemetry::counters::Shed;

    /// The inbox of the edge, with limits for undelivered messages and for reports per second.
    fn inbox(
        capacity: usize,
        max_report_hz: u32,
        counters: &Arc<Counters>,
        receiver: impl Fn(Delivery) + Send + Sync + 'static,
    ) -> Inbox {
        let own = NodeStatus::starting(
            NodeName::from_static("edge"),
            Uuid::nil(),
            Role::Edge,
            "0.1.0",
        );
        let config = MqttConfig {
            inbox: capacity,
            max_report_hz,
            ..MqttConfig::default()
        };
        let topics = Topics::new(&NodeName::from_static("lot"));
        Inbox::new(
            &own,
            topics,
            &config,
            Security::default(),
            CellClock::default(),
            Arc::clone(counters),
            Arc::new(receiver),
        )
    }

    fn accept(inbox: &Inbox, topic: &[u8], payload: &[u8], at: Timestamp) -> PacketOutcome {
        let address = "10.0.0.2:1883".parse().unwrap();
        inbox.accept(
            Via {
                address: &address,
                node: None,
            },
            topic,
            payload,
            at,
        )
    }

    /// An inbox for 30 reports per second that counts its deliveries by the node that `node_of`
    /// returns.
    fn counting(
        counters: &Arc<Counters>,
        node_of: impl Fn(&Incoming) -> &NodeName + Send + Sync + 'static,
    ) -> (Inbox, impl Fn(&'static str) -> u64) {
        let taken = Arc::new(Mutex::new(BTreeMap::<NodeName, u64>::new()));
        let receiver = Arc::clone(&taken);
        let inbox = inbox(16, 30, counters, move |delivery| {
            *receiver
                .lock()
                .unwrap()
                .entry(node_of(&delivery.message).clone())
                .or_default() += 1;
        });
        (inbox, move |node| {
            taken.lock().unwrap()[&NodeName::from_static(node)]
        })
    }

    #[test]
    fn full_inbox_drops_and_counts() {
        let counters = Arc::new(Counters::default());
        let held = Arc::new(Mutex::new(Vec::new()));
        let receiver = Arc::clone(&held);
        let inbox = inbox(2, 100, &counters, move |delivery| {
            receiver.lock().unwrap().push(delivery);
        });
        let payload = |aggregator: &str| {
            let aggregator = NodeName::new(aggregator).ok();
            let reputations = Reputations {
                schema: 1,
                aggregator,
                epoch: 1,
                round: 1,
                reputations: Default::default(),
            };
            encode(&reputations, Encoding::Json)
        };
        let accept_from = |aggregator: &str, at| {
            accept(
                &inbox,
                b"ecod/v1/lot/reputations",
                &payload(aggregator),
                Timestamp(at),
            )
        };
        let accept = |at| accept_from("gauss", at);
        for at in 1..=5 {
            assert_eq!(accept(at), PacketOutcome::Done);
        }
        assert_eq!(counters.events(Event::InboxFull), 3);
        assert_eq!(held.lock().unwrap().remove(0).received_at, Timestamp(1));
        accept(6);
        assert_eq!(counters.events(Event::InboxFull), 3);
        let kept: Vec<_> = held
            .lock()
            .unwrap()
            .iter()
            .map(|delivery| delivery.received_at)
            .collect();
        assert_eq!(kept, [Timestamp(2), Timestamp(6)]);

        accept_from("edge", 7);
        assert_eq!(
            (
                counters.events(Event::Echo),
                counters.events(Event::InboxFull)
            ),
            (1, 3)
        );
    }

    #[test]
    fn only_flooding_vehicle_is_limited() {
        let counters = Arc::new(Counters::default());
        let (inbox, taken) = counting(&counters, |message| match message {
            Incoming::Report { report, .. } => &report.node,
            other => panic!("{other:?}"),
        });
        for ms in 0..1000 {
            let accept = |node: &str| {
                let report = ObjectReport::new(NodeName::new(node).unwrap(), ms, Timestamp(ms));
                let topic = format!("ecod/v1/lot/detections/{node}");
                accept(
                    &inbox,
                    topic.as_bytes(),
                    &encode(&report, Encoding::Json),
                    Timestamp(ms * 1000),
                )
            };
            for _ in 0..10 {
                accept("mallory");
            }
            if ms % 100 == 0 {
                accept("euclid");
            }
        }
        assert_eq!(
            ["mallory", "euclid"].map(taken),
            [59, 10],
            "a second's worth at once, then 30 a second"
        );
        let shed = Shed {
            reason: ShedReason::ReportThrottled,
            source: "mallory".into(),
            times: 10_000 - 59,
        };
        assert_eq!(counters.all_shed(), [shed]);
    }

    #[test]
    fn large_reports_are_decoded_less_often() {
        let counters = Arc::new(Counters::default());
        let (inbox, taken) = counting(&counters, |message| match message {
            Incoming::Report { report, .. } => &report.node,
            other => panic!("{other:?}"),
        });
        let topic = b"ecod/v1/lot/detections/mallory";
        let node = "mallory";
        for ms in 0..1000 {
            let object = PerceivedObject {
                velocity_mps: Some([1.25, -1.25]),
                heading_rad: Some(1.25),
                size_m: Some([0.25, 0.25]),
                covariance_m2: Some([0.25, 0.0, 0.25]),
                ..PerceivedObject::new("person", 0.5, 1.0, 2.0)
            };
            let report = ObjectReport {
                objects: vec![object; 1000],
                ..ObjectReport::new(NodeName::from_static(node), ms, Timestamp(ms))
            };
            let payload = encode(&report, Encoding::Json);
            let share = tokens_of_report(payload.len(), inbox.limits.payload_bytes);
            assert_eq!(share, 7);
            accept(&inbox, topic, &payload, Timestamp(ms * 1000));
        }
        assert_eq!(taken(node), 8, "seven of the reports per second each");
    }

    #[test]
    fn own_round_is_not_decoded() {
        let counters = Arc::new(Counters::default());
        let inbox = inbox(2, 100, &counters, |_| panic!("delivered"));
        let topic = b"ecod/v1/lot/global_detections";
        let accept = |payload| accept(&inbox, topic, payload, Timestamp(1));
        let rounds: Vec<_> = (0..5_u8)
            .map(|round| Bytes::from(vec![round; 64]))
            .collect();
        rounds
            .iter()
            .for_each(|round| inbox.record_published(round));
        for round in &rounds[1..] {
            accept(round);
        }
        assert_eq!(counters.events(Event::Echo), 4);
        assert_eq!(accept(&rounds[0]), PacketOutcome::Done);
        assert_eq!(counters.events(Event::Echo), 4, "the oldest is decoded");
        let other = b"ecod/v1/lot/detections/mallory";
        self::accept(&inbox, other, &rounds[4], Timestamp(1));
        assert_eq!(
            counters.events(Event::Echo),
            4,
            "a copy under another topic"
        );
    }

    #[test]
    fn excess_statuses_are_dropped() {
        let counters = Arc::new(Counters::default());
        let (inbox, taken) = counting(&counters, |message| match message {
            Incoming::Status { status, .. } => &status.node,
            other => panic!("{other:?}"),
        });
        let accept = |node: &'static str, ms: u64| {
            let status = NodeStatus::starting(
                NodeName::from_static(node),
                Uuid::max(),
                Role::Auto,
                "0.1.0",
            );
            let topic = format!("ecod/v1/lot/nodes/{node}");
            accept(
                &inbox,
                topic.as_bytes(),
                &encode(&status, Encoding::Json),
                Timestamp(ms * 1000),
            )
        };
        for ms in 0..1000 {
            accept("mallory", ms);
            if ms % 250 == 0 {
                accept("euclid", ms);
            }
        }
        assert_eq!(
            ["mallory", "euclid"].map(taken),
            [59, 4],
            "a second's worth at once, then 30 a second"
        );
        let shed = Shed {
            reason: ShedReason::StatusThrottled,
            source: "mallory".into(),
            times: 1000 - 59,
        };
        assert_eq!(counters.all_shed(), [shed]);
    }
}
