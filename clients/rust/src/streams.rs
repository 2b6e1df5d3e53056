//! The newest payloads of each topic, for any number of readers, which do not hold up each other or
//! the network.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Instant;

use ecod::leadership::round_filter::EpochGate;
use ecod::leadership::timers::EPOCH_MEMORY;
use ecod::model::epoch::Epoch;
use ecod::model::names::NodeName;
use ecod::wire::{
    CellDescription, GlobalMap, Limits, NodeStatus, ObjectReport, Payload, RejectReason,
    Reputations, Topic, Verdicts, decode, decode_report,
};

/// All payloads of one connection.
#[derive(Debug, Default)]
pub(crate) struct Streams {
    pub(crate) maps: MessageStream<GlobalMap>,
    pub(crate) verdicts: MessageStream<Verdicts>,
    pub(crate) reputations: MessageStream<Reputations>,
    pub(crate) statuses: MessageStream<NodeStatus>,
    pub(crate) descriptions: MessageStream<CellDescription>,
    pub(crate) reports: MessageStream<ObjectReport>,
    pub(crate) foreign: MessageStream<CpmMessage>,
}

/// A message of another station that is not a node, in its own format.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CpmMessage {
    /// Name of the receiver that brought it: the last level of its topic.
    pub receiver: NodeName,
    /// The message as it is.
    pub payload: Vec<u8>,
}

/// One kind of payload: the newest, or for statuses the newest of each node.
#[derive(Debug)]
pub(crate) struct MessageStream<M> {
    newest: BTreeMap<Option<NodeName>, (u64, Arc<M>)>,
    number: u64,
    gate: EpochGate,
    admitted_at: Option<Instant>,
}

/// Maximum number of nodes whose statuses are kept; the node whose status is oldest is replaced
/// first.
const MAX_NODES: usize = 1024;

/// Placeholder aggregator of reputations without one.
const UNNAMED: NodeName = NodeName::from_static("-");

impl Streams {
    /// Processes a payload. A rejected payload has no effect.
    pub(crate) fn on_message(
        &mut self,
        topic: Option<Topic>,
        payload: &[u8],
        now: Instant,
    ) -> Result<(), RejectReason> {
        match topic {
            Some(Topic::GlobalDetections) => self.maps.on_message(payload, now, |map| {
                (map.epoch, Some(&map.aggregator), map.round)
            }),
            Some(Topic::GlobalVerdicts) => self.verdicts.on_message(payload, now, |it| {
                (it.epoch, Some(&it.aggregator), it.round)
            }),
            Some(Topic::Reputations) => self.reputations.on_message(payload, now, |it| {
                (it.epoch, it.aggregator.as_ref(), it.round)
            }),
            Some(Topic::Cell) if payload.is_empty() => {
                self.descriptions.newest.clear();
                Ok(())
            }
            Some(Topic::Cell) => {
                self.descriptions
                    .put(None, decode(payload, &Limits::default())?);
                Ok(())
            }
            Some(Topic::Nodes(node)) if payload.is_empty() => {
                self.statuses.newest.remove(&Some(node));
                Ok(())
            }
            Some(Topic::Nodes(node)) => {
                let status = decode::<NodeStatus>(payload, &Limits::default())?;
                if status.node != node {
                    return Err(RejectReason::NodeMismatch);
                }
                self.statuses.put(Some(node), status);
                Ok(())
            }
            Some(Topic::Detections(node)) => {
                let report = decode_report(payload, &node, &Limits::default())?;
                self.reports.put(Some(node), report);
                Ok(())
            }
            _ => Err(RejectReason::UnknownTopic),
        }
    }

    /// Processes a message of a station that is not a node.
    pub(crate) fn on_cpm(
        &mut self,
        receiver: NodeName,
        payload: &[u8],
    ) -> Result<(), RejectReason> {
        if payload.len() > Limits::default().payload_bytes {
            return Err(RejectReason::TooLarge);
        }
        self.foreign.put(
            Some(receiver.clone()),
            CpmMessage {
                receiver,
                payload: payload.to_vec(),
            },
        );
        Ok(())
    }
}

impl<M> Default for MessageStream<M> {
    fn default() -> Self {
        Self {
            newest: BTreeMap::new(),
            number: 0,
            gate: EpochGate::default(),
            admitted_at: None,
        }
    }
}

impl<M> MessageStream<M> {
    /// Stores a round, unless it is earlier than the last one by epoch, aggregator and number.
    fn on_message(
        &mut self,
        payload: &[u8],
        now: Instant,
        order: impl Fn(&M) -> (u64, Option<&NodeName>, u64),
    ) -> Result<(), RejectReason>
    where
        M: Payload,
    {
        let message: M = decode(payload, &Limits::default())?;
        let (term, aggregator, round) = order(&message);
        if self
            .admitted_at
            .is_some_and(|at| now.duration_since(at) >= EPOCH_MEMORY)
        {
            // The cell may have restarted.
            self.gate = EpochGate::default();
        }
        self.gate.admit(
            &Epoch::new(term, aggregator.cloned().unwrap_or(UNNAMED)),
            round,
        )?;
        self.admitted_at = Some(now);
        self.put(None, message);
        Ok(())
    }

    fn put(&mut self, node: Option<NodeName>, message: M) {
        self.number += 1;
        self.newest.insert(node, (self.number, Arc::new(message)));
        if self.newest.len() > MAX_NODES {
            let oldest = self
                .newest
                .iter()
                .min_by_key(|(_, (number, _))| *number)
                .map(|(node, _)| node.clone());
            oldest.and_then(|node| self.newest.remove(&node));
        }
    }

    /// Number of the newest payload.
    pub(crate) fn number(&self) -> u64 {
        self.number
    }

    /// The earliest of the newest payloads that arrived after the numbered one.
    pub(crate) fn after(&self, number: u64) -> Option<(u64, Arc<M>)> {
        self.newest
            .values()
            .filter(|(at, _)| *at > number)
            .min_by_key(|(at, _)| *at)
            .cloned()
    }
}
