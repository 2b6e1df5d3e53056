//! Messages to the actor of this name.

use std::collections::BTreeMap;
use std::sync::Arc;

use ecod::wire::{GlobalMap, LedgerShare, NodeStatus, ObjectReport, ReportKind, Reputations, Verdicts};
use ractor::RpcReplyPort;

use crate::transport::mqtt::{BrokerAddress, LinkEvent, LinkState, Subscriber};

/// What the gateway is asked to do.
pub enum GatewayMessage {
    /// Keep links to exactly these brokers; links that stay are not touched.
    SetBrokers {
        /// The brokers, in no particular order.
        addresses: Vec<BrokerAddress>,
    },
    /// Take reports from these brokers only, on links made from now on; until told, a candidate takes them from all.
    SetReportBrokers {
        /// Brokers to which all vehicles send.
        addresses: Vec<BrokerAddress>,
    },
    /// Take reports from every broker, to be looked at, or no longer so; whoever wants them asks again from time to
    /// time, as a gateway that is started anew has forgotten it.
    WatchReports {
        /// Whether they are wanted.
        wanted: bool,
    },
    /// Hand messages to another subscriber from now on, such as after a receiver's restart.
    SetSubscriber {
        /// The new subscriber.
        subscriber: Subscriber,
    },
    /// Send this vehicle's report; the node also takes it in-process.
    PublishReport {
        /// What it is for.
        kind: ReportKind,
        /// The report.
        report: Arc<ObjectReport>,
    },
    /// Send the map of a round to all, this node included.
    PublishMap {
        /// The map.
        map: Arc<GlobalMap>,
    },
    /// Send the verdicts of a round to all, this node included.
    PublishVerdicts {
        /// The verdicts.
        verdicts: Arc<Verdicts>,
    },
    /// Send reputations to all, this node included; brokers keep them for latecomers.
    PublishReputations {
        /// The reputations.
        reputations: Arc<Reputations>,
    },
    /// Send evidence to the other candidates.
    PublishShare {
        /// The evidence.
        share: LedgerShare,
    },
    /// Replace what this node says about itself, now and on every later connection.
    PublishStatus {
        /// The status.
        status: NodeStatus,
    },
    /// Tell how every link is.
    Links {
        /// Gets the state by broker.
        reply: RpcReplyPort<BTreeMap<BrokerAddress, LinkState>>,
    },
    /// News from a link's own task.
    LinkChanged {
        /// The news.
        event: LinkEvent,
    },
}
