//! Requests to the actor `Gateway`, from all actors that publish.

use std::collections::BTreeMap;
use std::sync::Arc;

use ecod::wire::{
    CellDescription, GlobalMap, LedgerShare, NodeStatus, ObjectReport, ReportKind, Reputations,
    Verdicts,
};
use ractor::RpcReplyPort;

use crate::transport::mqtt::{BrokerAddress, LinkEvent, LinkState, Subscriber};

/// Requests to the gateway.
pub enum GatewayMessage {
    /// Keep links to exactly these brokers; links that stay are not touched.
    SetBrokers {
        /// The brokers, in no particular order.
        addresses: Vec<BrokerAddress>,
    },
    /// Replace all connections to other machines: they are from an address that this machine no
    /// longer has.
    Reconnect,
    /// Subscribe to reports only on these brokers, for new connections. Before this message, a
    /// candidate subscribes on all brokers.
    SetReportBrokers {
        /// Brokers to which all vehicles publish.
        addresses: Vec<BrokerAddress>,
    },
    /// Start or stop subscribing to reports on every broker for display. The message is repeated
    /// from time to time, because a restarted gateway has lost it.
    WatchReports {
        /// True if they are wanted.
        wanted: bool,
    },
    /// Replace the subscriber, such as after a receiver's restart.
    SetSubscriber {
        /// Callback for every later message.
        subscriber: Subscriber,
    },
    /// Publish this vehicle's report, also in-process.
    PublishReport {
        /// The kind of evidence.
        kind: ReportKind,
        /// The report, with its capture in the cell's time.
        report: Arc<ObjectReport>,
    },
    /// Publish the map of a round, also in-process.
    PublishMap {
        /// The map that the node's fuser made.
        map: Arc<GlobalMap>,
    },
    /// Publish the verdicts of a round, also in-process.
    PublishVerdicts {
        /// The verdicts that the node's fuser made.
        verdicts: Arc<Verdicts>,
    },
    /// Publish reputations, retained, also in-process.
    PublishReputations {
        /// The reputations of all vehicles.
        reputations: Arc<Reputations>,
    },
    /// Publish the cell's description, retained.
    PublishDescription {
        /// The description that the node uses.
        description: Arc<CellDescription>,
    },
    /// Publish evidence to the other candidates.
    PublishShare {
        /// The share, signed in a cell with certificates.
        share: LedgerShare,
    },
    /// Replace this node's status, now and on every later connection.
    PublishStatus {
        /// The complete status of this node.
        status: NodeStatus,
    },
    /// Query the state of every link.
    Links {
        /// Gets the state by broker.
        reply: RpcReplyPort<BTreeMap<BrokerAddress, LinkState>>,
    },
    /// An event of a link's own task.
    LinkChanged {
        /// The event, with the link that reports it.
        event: LinkEvent,
    },
}
