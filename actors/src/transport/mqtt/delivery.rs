//! Checked messages on their way from a link to their receivers.

use std::sync::Arc;

use ecod::leadership::BrokerAddress;
use ecod::leadership::links::LinkState;
use ecod::leadership::round_filter::Origin;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::wire::{
    CellDescription, GlobalMap, LedgerShare, NodeStatus, ObjectReport, ReportKind, Reputations,
    Verdicts,
};
use tokio::sync::OwnedSemaphorePermit;

/// A checked message of the cell, or news about a link.
///
/// The same message may arrive over several links. The report window drops the second report by
/// node and capture time. Receivers of maps, verdicts and reputations drop it by epoch and round. A
/// repeated status does no harm.
#[derive(Debug, Clone, PartialEq)]
pub enum Incoming {
    /// A vehicle's report; for candidates and observers only.
    Report {
        /// The kind of evidence.
        kind: ReportKind,
        /// The report, within the limits.
        report: Arc<ObjectReport>,
    },
    /// The fused map of a round.
    Map(Arc<GlobalMap>),
    /// The verdicts of a round.
    Verdicts(Arc<Verdicts>),
    /// Reputations, right after connecting if the broker retains some.
    Reputations(Arc<Reputations>),
    /// A description of the cell, right after connecting if the broker retains one.
    Description(Arc<CellDescription>),
    /// A share of another candidate's evidence; for candidates only.
    Ledger(Arc<LedgerShare>),
    /// The status of another node, from itself or from its last will.
    Status {
        /// The status as the node published it.
        status: Arc<NodeStatus>,
        /// The broker that forwarded it.
        via: BrokerAddress,
    },
    /// A node has stopped, or has stopped using this broker, and withdrew its status.
    StatusWithdrawn {
        /// Name of the node.
        node: NodeName,
        /// The broker that forwarded it.
        via: BrokerAddress,
    },
    /// The state of a link changed.
    Link {
        /// The broker at its other end.
        broker: BrokerAddress,
        /// State of the link from now on.
        state: LinkState,
    },
}

/// A message on its way to a receiver. It occupies a place in the inbox until it is dropped, so
/// keep it until it is processed.
#[derive(Debug)]
pub struct Delivery<T = Incoming> {
    /// The message, decoded and within the limits.
    pub message: T,
    /// Time when its packet was read from the socket, or when it was delivered in-process.
    pub received_at: Timestamp,
    /// Proof of a round's aggregator; other messages need no such proof.
    pub origin: Origin,
    /// The node whose certificate the broker has proven, of a link in its last handshake; `None`
    /// without certificates, and for messages of this node.
    pub broker: Option<NodeName>,
    pub(super) _place: Option<OwnedSemaphorePermit>,
}

impl<T> Delivery<T> {
    /// A message of this node itself. It occupies no place, because the node's own pace limits it.
    pub(crate) fn local(message: T, at: Timestamp) -> Self {
        Self {
            message,
            received_at: at,
            origin: Origin::Proven,
            broker: None,
            _place: None,
        }
    }

    /// The same delivery for a part of its message; the other fields are unchanged.
    pub(crate) fn map<U>(self, part: impl FnOnce(T) -> U) -> Delivery<U> {
        let Self {
            message,
            received_at,
            origin,
            broker,
            _place,
        } = self;
        Delivery {
            message: part(message),
            received_at,
            origin,
            broker,
            _place,
        }
    }
}

/// Callback that passes messages to their receivers. It runs on the link's task and must not block.
pub type Subscriber = Arc<dyn Fn(Delivery) + Send + Sync>;
