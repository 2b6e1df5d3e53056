//! Rights of programs at their node's local broker, as hooks of rmqtt.
//!
//! | topic | a program of the node `euclid` |
//! |---|---|
//! | `detections/euclid`, `detections/euclid--…`, `vote_detections/…` | is forwarded to the cell |
//! | `boxes/euclid`, `boxes/euclid--…` | is projected to a report, which is forwarded to the cell |
//! | `cell` | is the cell's new description, if `euclid` may lead |
//! | `nodes/euclid--…` | reaches the programs at this broker |
//! | `nodes/<node>`, empty | dismisses that node, if it is missing and `euclid` may lead |
//! | other topics of the cell | is refused |
//! | `cpm/…` | reaches the programs at this broker |
//! | anything else | without certificates reaches the programs at this broker |
//!
//! Without certificates, the brokers of the leader and its standby also accept reports of vehicles
//! that have no node, and so does the broker of a node without a leader.

use std::net::Ipv4Addr;
use std::sync::Arc;

use async_trait::async_trait;
use bytes::Bytes;
use ecod::admission::report_window::MAX_PARTS;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::perception::box_projection::ProjectedBoxes;
use ecod::wire::{
    CellDescription, Flaw, ObjectReport, RejectReason, ReportKind, Topic, decode, decode_boxes,
    decode_report,
};
use rmqtt::context::ServerContext;
use rmqtt::hook::{Handler, HookResult, Parameter, ReturnType, Type};
use rmqtt::session::Session;
use rmqtt::types::{FromType, Publish};

use super::refusals::RefusalReason;
use super::{
    DESCRIPTION_INTERVAL, Door, DoorRefusal, DoorSetup, DoorState, MAX_NODELESS, PART_RETENTION,
    Publication, lock,
};
use crate::platform::clock;
use crate::platform::throttle::{tokens_of_boxes, tokens_of_report};
use crate::telemetry::counters::{Event, ShedReason};
use crate::transport::broker::principal::{Principal, PrincipalRegistry, is_run};

/// The place of a message inside the broker.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::transport::broker) enum TopicPlace {
    /// Among nodes, and vehicles without a node.
    Cell,
    /// Among programs.
    Door,
    /// From a program to the node; subscriptions don't match this place.
    Inbound,
}

/// The route by which a program's boxes, once they are projected, reach the cell.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::transport::broker) enum BoxRoute {
    /// The node publishes them as reports of its own part.
    Node,
    /// They are reports of a vehicle without a node, and go to the clients of this broker.
    Broker,
}

/// Prefixes of places. Filters with a leading wildcard do not match them.
const DOOR: &str = "$door/";
const INBOUND: &str = "$inbound/";

impl TopicPlace {
    /// The topic or filter inside the broker.
    pub(in crate::transport::broker) fn topic(self, topic: &str) -> String {
        let prefix = match self {
            Self::Cell => "",
            Self::Door => DOOR,
            Self::Inbound => INBOUND,
        };
        format!("{prefix}{topic}")
    }

    /// The place of a topic inside the broker, and the topic that clients see.
    pub(in crate::transport::broker) fn of(topic: &str) -> (Self, &str) {
        match (topic.strip_prefix(DOOR), topic.strip_prefix(INBOUND)) {
            (Some(topic), _) => (Self::Door, topic),
            (_, Some(topic)) => (Self::Inbound, topic),
            _ => (Self::Cell, topic),
        }
    }
}

impl Door {
    /// True if a client is a local program and not a node's link.
    pub(in crate::transport::broker) fn is_program(
        &self,
        principal: &Principal,
        client_id: &str,
    ) -> bool {
        let Some(DoorState { setup, .. }) = self.0.as_deref() else {
            return false;
        };
        if client_id == setup.gateway_id {
            return false;
        }
        if !setup.serves_nodes {
            return true;
        }
        let named = client_id
            .rsplit_once('-')
            .filter(|(_, run)| is_run(run))
            .and_then(|(name, _)| NodeName::new(name).ok());
        let is_own = |name: &NodeName| name.vehicle() == setup.node && !(setup.is_member)(name);
        match &principal.identity {
            Some(identity) if identity.name() != &setup.node => false,
            _ => named.is_none_or(|name| is_own(&name)),
        }
    }

    /// True if a program may leave a last will on this topic.
    pub(in crate::transport::broker) fn allows_will(
        &self,
        principal: &Principal,
        topic: &str,
    ) -> bool {
        let is_of_nodeless = |door: &DoorState| match door.setup.topics.parse(topic) {
            Some(Topic::Nodes(name)) => door.is_nodeless_name(principal, &name),
            _ => false,
        };
        self.0
            .as_deref()
            .is_some_and(|door| is_of_nodeless(door) || door.may_publish(principal, topic).is_ok())
    }

    /// Processes a program's message.
    pub(in crate::transport::broker) fn on_publish(
        &self,
        principal: &Principal,
        place: TopicPlace,
        topic: &str,
        publish: &Publish,
    ) -> Result<(), DoorRefusal> {
        let Some(door) = self.0.as_deref() else {
            return Ok(());
        };
        match place {
            TopicPlace::Cell if publish.retain => door.on_nodeless_message(topic, &publish.payload),
            TopicPlace::Cell => Ok(()),
            TopicPlace::Door => {
                door.may_publish(principal, topic)?;
                door.check_readers(topic)
            }
            TopicPlace::Inbound => match door.setup.topics.parse(topic) {
                Some(Topic::Cell) => door.on_description(principal, &publish.payload),
                Some(Topic::Nodes(name)) => door.on_dismissal(principal, name),
                Some(Topic::Boxes(name)) => {
                    let route = door.route(principal, &name)?;
                    self.on_boxes(&name, route, &publish.payload)
                }
                _ => door.on_report(principal, topic, &publish.payload),
            },
        }
    }

    /// Projects a program's boxes, and passes the resulting reports to the cell. Boxes without a
    /// position are left out and counted.
    pub(in crate::transport::broker) fn on_boxes(
        &self,
        name: &NodeName,
        route: BoxRoute,
        payload: &Bytes,
    ) -> Result<(), DoorRefusal> {
        let Some(door) = self.0.as_deref() else {
            let text = "this node places no boxes, because its `broker.door` is false";
            return Err(DoorRefusal::not_permitted(text));
        };
        let setup = &door.setup;
        let topic = Topic::Boxes(name.clone());
        let now = clock::now();
        let tokens = tokens_of_boxes(payload.len());
        match route {
            BoxRoute::Node => door.check_rate(ReportKind::Detections, tokens, now)?,
            BoxRoute::Broker => door.check_nodeless_rate(&name.vehicle(), tokens, now)?,
        }
        let boxes = decode_boxes(payload, name, &setup.limits).map_err(|flaw| {
            let text =
                format!("the report on {topic} is not usable: {flaw}; see docs/protocol.md#boxes");
            DoorRefusal::new(RefusalReason::Rejected(flaw.reason), text)
        })?;
        if route == BoxRoute::Node {
            door.check_part(name, now)?;
        }
        let ProjectedBoxes { report, unplaced } = (setup.project)(&boxes);
        for unplaced in unplaced {
            let text = format!("not on the map, {unplaced}");
            let refusal = DoorRefusal::new(RefusalReason::Rejected(RejectReason::NotPlaced), text);
            self.record_refusal(name.as_str(), &setup.topics.path(&topic), &refusal);
        }
        if (setup.fuses)(ReportKind::VoteDetections) {
            let votes = report.votes();
            if !votes.objects.is_empty() {
                door.pass_on(ReportKind::VoteDetections, votes, route);
            }
        }
        if (setup.fuses)(ReportKind::Detections) {
            door.pass_on(ReportKind::Detections, report, route);
        }
        Ok(())
    }

    /// Counts and shows a refusal.
    pub(in crate::transport::broker) fn record_refusal(
        &self,
        client_id: &str,
        topic: &str,
        refusal: &DoorRefusal,
    ) {
        let Some(door) = self.0.as_deref() else {
            return;
        };
        let setup = &door.setup;
        // A client that reconnects keeps its name.
        let named = client_id.rsplit_once('-').filter(|(_, run)| is_run(run));
        let client = named.map_or(client_id, |(name, _)| name);
        match refusal.reason {
            RefusalReason::Throttled => setup.counters.shed(ShedReason::ReportThrottled, client),
            RefusalReason::Rejected(reason) => setup
                .counters
                .reject_report(reason, client, || refusal.text.clone()),
        }
        if refusal.reason == RefusalReason::Rejected(RejectReason::NotPermitted) {
            setup.counters.count(Event::ClientDenied);
        }
        tracing::debug!(
            client,
            topic,
            text = refusal.text,
            "program's message refused"
        );
        let status = lock(&door.refusals).record(&setup.node, client, topic, refusal, clock::now());
        if let Some(status) = status {
            let topic = setup.topics.clients(&setup.node);
            door.retain(Publication {
                place: TopicPlace::Door,
                topic,
                payload: status.into(),
                retain: true,
            });
        }
    }

    /// The place for a program's message.
    fn place_of(&self, principal: &Principal, publish: &Publish) -> TopicPlace {
        let Some(door) = self.0.as_deref() else {
            return TopicPlace::Cell;
        };
        match door.setup.topics.parse(&publish.topic) {
            Some(Topic::Detections(name) | Topic::VoteDetections(name))
                if door.is_nodeless(principal, &name) =>
            {
                TopicPlace::Cell
            }
            Some(Topic::Nodes(name)) if is_dismissal(&name, publish) => TopicPlace::Inbound,
            Some(Topic::Nodes(name)) if door.is_nodeless_name(principal, &name) => TopicPlace::Cell,
            Some(
                Topic::Detections(_) | Topic::VoteDetections(_) | Topic::Boxes(_) | Topic::Cell,
            ) => TopicPlace::Inbound,
            _ => TopicPlace::Door,
        }
    }
}

impl DoorState {
    /// True if a name belongs to a vehicle without a node whose reports this broker forwards to the
    /// cell.
    fn is_nodeless(&self, principal: &Principal, name: &NodeName) -> bool {
        !(self.setup.follows)() && self.is_nodeless_name(principal, name)
    }

    /// True if the name is free for a vehicle without a node: not this node's and not a member's,
    /// at a broker without certificates that serves nodes.
    fn is_nodeless_name(&self, principal: &Principal, name: &NodeName) -> bool {
        let setup = &self.setup;
        let vehicle = name.vehicle();
        principal.identity.is_none()
            && vehicle != setup.node
            && setup.serves_nodes
            && !(setup.is_member)(&vehicle)
    }

    /// Checks that a program may publish on a topic for other messages than reports and requests:
    /// its own parts' status, its CPMs and, without certificates, topics of other applications.
    fn may_publish(&self, principal: &Principal, topic: &str) -> Result<(), DoorRefusal> {
        let node = &self.setup.node;
        match self.setup.topics.parse(topic) {
            Some(Topic::Nodes(name))
                if name.vehicle() == *node && name != *node && self.is_own(principal) =>
            {
                Ok(())
            }
            None if principal.identity.is_none() => Ok(()),
            None if self.is_own(principal) && topic.starts_with(&self.setup.topics.cpm("")) => {
                Ok(())
            }
            _ => Err(DoorRefusal::not_permitted(format!(
                "programs do not publish {topic}; reports go to detections/{node}--<part>, vote_detections/{node}--<part> and boxes/{node}--<part>"
            ))),
        }
    }

    /// Checks that a program reads an unknown topic below the cell's root, such as a misspelt one.
    fn check_readers(&self, topic: &str) -> Result<(), DoorRefusal> {
        let DoorSetup { topics, node, .. } = &self.setup;
        let is_of_others = !topic.starts_with(&topics.filter(""))
            || topic.starts_with(&topics.cpm(""))
            || topics.parse(topic).is_some();
        let is_read = || {
            let filters = lock(&self.filters);
            filters
                .keys()
                .any(|(_, filter)| rumqttc::matches(topic, TopicPlace::of(filter).1))
        };
        if is_of_others || is_read() {
            return Ok(());
        }
        Err(DoorRefusal::new(
            RefusalReason::Rejected(RejectReason::UnknownTopic),
            format!(
                "no program reads {topic}; reports go to detections/{node}--<part>, vote_detections/{node}--<part> and boxes/{node}--<part>"
            ),
        ))
    }

    /// Handles a program's report: checks name, rate, content and use in the cell, then passes it
    /// to the node, which publishes it.
    ///
    /// # Errors
    /// Returns the refusal with the text that the program gets.
    fn on_report(
        &self,
        principal: &Principal,
        topic: &str,
        payload: &Bytes,
    ) -> Result<(), DoorRefusal> {
        let setup = &self.setup;
        let (kind, name) = match setup.topics.parse(topic) {
            Some(Topic::Detections(name)) => (ReportKind::Detections, name),
            Some(Topic::VoteDetections(name)) => (ReportKind::VoteDetections, name),
            _ => {
                return Err(DoorRefusal::not_permitted(format!(
                    "{topic} is no topic for reports"
                )));
            }
        };
        self.check_name(principal, &name)?;
        let now = clock::now();
        let tokens = tokens_of_report(payload.len(), setup.limits.payload_bytes);
        self.check_rate(kind, tokens, now)?;
        let report = decode_report(payload, &name, &setup.limits).map_err(|reason| {
            let flaw = Flaw::of_report(payload, reason, &setup.limits);
            let detail = if flaw.fault.is_empty() { String::new() } else { format!(" ({flaw})") };
            let text = format!("the report on {topic} is not usable: {reason}{detail}; see docs/protocol.md#rejections");
            DoorRefusal::new(RefusalReason::Rejected(reason), text)
        })?;
        if !(setup.fuses)(kind) {
            let text = format!("the cell does not use {topic}: `fusion.algorithms` leaves it out");
            return Err(DoorRefusal::new(
                RefusalReason::Rejected(RejectReason::NotFused),
                text,
            ));
        }
        self.check_part(&name, now)?;
        (setup.report)(kind, Arc::new(report));
        Ok(())
    }

    /// Checks that a program may report under a name.
    fn check_name(&self, principal: &Principal, name: &NodeName) -> Result<(), DoorRefusal> {
        let node = &self.setup.node;
        let is_allowed = name.vehicle() == *node
            && self.is_own(principal)
            && (name == node || !(self.setup.is_member)(name));
        if is_allowed {
            return Ok(());
        }
        Err(DoorRefusal::not_permitted(format!(
            "this is the door of {node}: its programs report as {node} or {node}--<part>, not as {name}"
        )))
    }

    /// Checks the rate of the reports of all programs of the node together; a large report counts as
    /// several, its `tokens`.
    fn check_rate(&self, kind: ReportKind, tokens: u32, now: Timestamp) -> Result<(), DoorRefusal> {
        let most = (self.setup.max_report_hz / 2).max(1);
        let throttle = self.throttles.get(kind as usize);
        if throttle.is_none_or(|throttle| lock(throttle).allow_many(tokens.min(most), now)) {
            return Ok(());
        }
        let node = &self.setup.node;
        let text = format!(
            "the programs of {node} report more than {most} times a second, half of mqtt.max_report_hz; large reports count as several"
        );
        Err(DoorRefusal::new(RefusalReason::Throttled, text))
    }

    /// Checks the rate of the boxes of a vehicle without a node; a large message counts as several,
    /// its `tokens`.
    fn check_nodeless_rate(
        &self,
        vehicle: &NodeName,
        tokens: u32,
        now: Timestamp,
    ) -> Result<(), DoorRefusal> {
        let most = self.setup.max_report_hz;
        if lock(&self.nodeless_boxes).allow_many(vehicle, tokens.min(most), now) {
            return Ok(());
        }
        let text = format!(
            "{vehicle} reports boxes more than {most} times a second, as mqtt.max_report_hz allows; large messages count as several"
        );
        Err(DoorRefusal::new(RefusalReason::Throttled, text))
    }

    /// Checks that the aggregator has room for this part of the node, too.
    fn check_part(&self, name: &NodeName, now: Timestamp) -> Result<(), DoorRefusal> {
        if self.admits_part(name, now) {
            return Ok(());
        }
        let node = &self.setup.node;
        let text =
            format!("{node} has {MAX_PARTS} parts that report, and {name} would be one more");
        Err(DoorRefusal::new(
            RefusalReason::Rejected(RejectReason::TooManyVehicles),
            text,
        ))
    }

    /// The route of the reports that a program's boxes become.
    fn route(&self, principal: &Principal, name: &NodeName) -> Result<BoxRoute, DoorRefusal> {
        if self.is_nodeless(principal, name) {
            return Ok(BoxRoute::Broker);
        }
        self.check_name(principal, name).map(|()| BoxRoute::Node)
    }

    /// Passes a report of projected boxes to the cell.
    fn pass_on(&self, kind: ReportKind, report: ObjectReport, route: BoxRoute) {
        match route {
            BoxRoute::Node => (self.setup.report)(kind, Arc::new(report)),
            BoxRoute::Broker => {
                let topic = kind.topic(report.node.clone());
                self.send(Publication {
                    place: TopicPlace::Cell,
                    ..self.publication(&topic, &report, false)
                });
            }
        }
    }

    /// True if the certificate belongs to the node, or there are no certificates.
    fn is_own(&self, principal: &Principal) -> bool {
        principal
            .identity
            .as_ref()
            .is_none_or(|identity| *identity.name() == self.setup.node)
    }

    /// True if the aggregator has room for this part of the node, too.
    fn admits_part(&self, name: &NodeName, now: Timestamp) -> bool {
        let mut parts = lock(&self.parts);
        if *name == self.setup.node {
            return true;
        }
        if parts.len() >= MAX_PARTS && !parts.contains_key(name) {
            parts.retain(|_, at| now.since(*at) < PART_RETENTION);
        }
        let has_room = parts.len() < MAX_PARTS || parts.contains_key(name);
        if has_room {
            parts.insert(name.clone(), now);
        }
        has_room
    }

    /// Limits the number of vehicles without a node whose statuses are retained; an empty status
    /// removes a vehicle.
    fn on_nodeless_message(&self, topic: &str, payload: &Bytes) -> Result<(), DoorRefusal> {
        let Some(Topic::Nodes(name)) = self.setup.topics.parse(topic) else {
            return Ok(());
        };
        let mut names = lock(&self.nodeless);
        if payload.is_empty() {
            names.remove(&name);
        } else if names.len() < MAX_NODELESS {
            names.insert(name);
        } else if !names.contains(&name) {
            let text = format!(
                "{MAX_NODELESS} vehicles without a node have a retained status here, and {name} has no room"
            );
            return Err(DoorRefusal::not_permitted(text));
        }
        Ok(())
    }

    /// Processes the cell's description from a program that may act as the node.
    fn on_description(&self, principal: &Principal, payload: &Bytes) -> Result<(), DoorRefusal> {
        let DoorSetup { node, limits, .. } = &self.setup;
        if !principal.is_of(node) {
            let text = format!(
                "only programs on the machine of {node}, or with its certificate, set the description"
            );
            return Err(DoorRefusal::not_permitted(text));
        }
        if !lock(&self.descriptions).allow(clock::now()) {
            let text = format!(
                "{node} takes no more than one description in {} s",
                DESCRIPTION_INTERVAL.as_secs()
            );
            return Err(DoorRefusal::new(RefusalReason::Throttled, text));
        }
        let malformed =
            |text: String| DoorRefusal::new(RefusalReason::Rejected(RejectReason::Malformed), text);
        let request: CellDescription =
            decode(payload, limits).map_err(|reason| malformed(reason.to_string()))?;
        (self.setup.describe)(request.text).map_err(malformed)
    }

    /// Dismisses a missing node at the request of a program that may act as the node.
    fn on_dismissal(&self, principal: &Principal, name: NodeName) -> Result<(), DoorRefusal> {
        let DoorSetup { node, dismiss, .. } = &self.setup;
        if !principal.is_of(node) {
            let text = format!(
                "only programs on the machine of {node}, or with its certificate, dismiss a node"
            );
            return Err(DoorRefusal::not_permitted(text));
        }
        dismiss(name).map_err(DoorRefusal::not_permitted)
    }

    /// True if a filter of a program matches reports.
    fn is_of_reports(&self, filter: &str) -> bool {
        let (_, filter) = TopicPlace::of(filter);
        let node = &self.setup.node;
        ReportKind::ALL.into_iter().any(|kind| {
            let topic = self.setup.topics.path(&kind.topic(node.clone()));
            let mut levels = filter.split('/');
            let last = topic.split('/').count();
            for (index, level) in topic.split('/').enumerate() {
                match levels.next() {
                    Some("#") => return true,
                    Some("+") => {}
                    // Whatever vehicle it names.
                    Some(_) if index + 1 == last => {}
                    Some(wanted) if wanted == level => {}
                    _ => return false,
                }
            }
            levels.next().is_none_or(|level| level == "#")
        })
    }
}

/// True if a program's message on the topic of a node's status requests to dismiss the node: it is
/// empty and, unlike the withdrawal of a status, not retained.
fn is_dismissal(name: &NodeName, publish: &Publish) -> bool {
    publish.payload.is_empty() && !publish.retain && !name.is_part()
}

/// Hooks of rmqtt that separate programs from nodes.
#[derive(Clone)]
pub(in crate::transport::broker) struct DoorHooks {
    pub(in crate::transport::broker) door: Door,
    pub(in crate::transport::broker) principals: PrincipalRegistry,
}

impl DoorHooks {
    /// Registers the hooks, after the hooks that charge messages.
    pub(in crate::transport::broker) async fn install(self, context: &ServerContext) {
        use Type::{
            ClientSubscribe, MessageDelivered, MessagePublish, SessionSubscribed,
            SessionTerminated, SessionUnsubscribed,
        };
        if self.door.0.is_none() {
            return;
        }
        let register = context.extends.hook_mgr().register();
        for hook in [
            ClientSubscribe,
            MessagePublish,
            MessageDelivered,
            SessionSubscribed,
            SessionUnsubscribed,
            SessionTerminated,
        ] {
            register.add(hook, Box::new(self.clone())).await;
        }
        register.start().await;
    }

    /// The principal of a session, if the session belongs to a program. A program that has just
    /// left is identified by the client id with which it had logged in, because its last will is
    /// still to come.
    fn program(&self, session: &Session) -> Option<Principal> {
        let principal = self
            .principals
            .principal(session.id.remote_addr)
            .unwrap_or_else(|| Principal::new(None, Ipv4Addr::LOCALHOST.into(), false));
        self.door
            .is_program(&principal, &session.id.client_id)
            .then_some(principal)
    }
}

#[async_trait]
impl Handler for DoorHooks {
    async fn hook(&self, parameter: &Parameter, before: Option<HookResult>) -> ReturnType {
        let Some(door) = self.door.0.as_deref() else {
            return (true, before);
        };
        match parameter {
            Parameter::ClientSubscribe(session, subscribe) if self.program(session).is_some() => (
                true,
                Some(HookResult::TopicFilter(Some(
                    TopicPlace::Door.topic(&subscribe.topic_filter).into(),
                ))),
            ),
            Parameter::MessagePublish(Some(session), from, publish) => {
                let Some(principal) = self.program(session) else {
                    return (true, before);
                };
                let mut moved = match before {
                    Some(HookResult::Publish(charged)) => charged,
                    _ => (*publish).clone(),
                };
                let place = self.door.place_of(&principal, publish);
                moved.topic = place.topic(&publish.topic).into();
                // rmqtt calls `Permissions` for a published message, but not for a last will.
                if let FromType::LastWill = from.typ()
                    && let Err(refusal) =
                        self.door
                            .on_publish(&principal, place, &publish.topic, publish)
                {
                    let client = &session.id.client_id;
                    self.door.record_refusal(client, &publish.topic, &refusal);
                    moved.topic = TopicPlace::Inbound.topic(&publish.topic).into();
                    moved.retain = false;
                }
                (true, Some(HookResult::Publish(moved)))
            }
            Parameter::MessageDelivered(_, _, publish) => {
                let (TopicPlace::Door, topic) = TopicPlace::of(&publish.topic) else {
                    return (true, before);
                };
                let mut shown = (*publish).clone();
                shown.topic = topic.to_owned().into();
                (true, Some(HookResult::Publish(shown)))
            }
            Parameter::SessionSubscribed(session, subscribe)
                if TopicPlace::of(&subscribe.topic_filter).0 == TopicPlace::Door =>
            {
                let filter = subscribe.topic_filter.clone();
                let of_reports = door.is_of_reports(&filter);
                door.change_filters(|filters| {
                    filters.insert((session.id.client_id.clone(), filter), of_reports);
                });
                (true, before)
            }
            Parameter::SessionUnsubscribed(session, unsubscribe) => {
                door.change_filters(|filters| {
                    filters.remove(&(
                        session.id.client_id.clone(),
                        unsubscribe.topic_filter.clone(),
                    ));
                });
                (true, before)
            }
            Parameter::SessionTerminated(session, _) => {
                door.change_filters(|filters| {
                    filters.retain(|(client, _), _| *client != session.id.client_id);
                });
                (true, before)
            }
            _ => (true, before),
        }
    }
}
