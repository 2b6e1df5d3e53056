//! Receives every report of the cell on all brokers, and records the leaders.

use std::collections::BTreeSet;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::wire::{NodeStatus, ObjectReport, Role};
use ecod_actors::actors::gateway::{Gateway, GatewayArguments};
use ecod_actors::messages::gateway::GatewayMessage;
use ecod_actors::transport::mqtt::{
    BrokerAddress, Delivery, Incoming, MqttConfig, Security, SubscriptionRole,
};
use ractor::{Actor, ActorRef};
use tokio::task::JoinHandle;
use uuid::Uuid;

/// A report and its time of receipt.
#[derive(Debug, Clone)]
pub struct ObservedReport {
    /// The report as it was received.
    pub report: Arc<ObjectReport>,
    /// Time of receipt by this process's clock.
    pub received_at: Timestamp,
}

/// A gateway that keeps every report.
pub(super) struct ReportCollector {
    gateway: ActorRef<GatewayMessage>,
    ended: JoinHandle<()>,
    seen: Arc<Mutex<Seen>>,
}

#[derive(Default)]
struct Seen {
    reports: Vec<ObservedReport>,
    known: BTreeSet<(NodeName, u64)>,
    leader: Option<NodeName>,
}

impl ReportCollector {
    pub(super) async fn start(
        cell: NodeName,
        brokers: Vec<BrokerAddress>,
        name: NodeName,
    ) -> anyhow::Result<Self> {
        let seen: Arc<Mutex<Seen>> = Arc::default();
        let kept = Arc::clone(&seen);
        let status =
            NodeStatus::starting(name, Uuid::now_v7(), Role::Cav, env!("CARGO_PKG_VERSION"));
        let arguments = GatewayArguments {
            cell,
            role: SubscriptionRole::Candidate,
            status,
            mqtt: MqttConfig {
                retry_max_ms: 200,
                ..MqttConfig::default()
            },
            security: Security::default(),
            clock: Default::default(),
            counters: Arc::default(),
            subscriber: Arc::new(move |delivery| lock(&kept).add(delivery)),
            seed: 1,
            only_observes: false,
        };
        let (gateway, ended) = Actor::spawn(None, Gateway, arguments).await?;
        gateway.cast(GatewayMessage::SetBrokers { addresses: brokers })?;
        Ok(Self {
            gateway,
            ended,
            seen,
        })
    }

    /// Number of vehicles that have reported.
    pub(super) fn reporters(&self) -> usize {
        lock(&self.seen)
            .reports
            .iter()
            .map(|observed| observed.report.node.clone())
            .collect::<BTreeSet<_>>()
            .len()
    }

    /// The node whose map arrived last.
    pub(super) fn leader(&self) -> Option<NodeName> {
        lock(&self.seen).leader.clone()
    }

    /// Number of reports received.
    pub(super) fn reports(&self) -> usize {
        lock(&self.seen).reports.len()
    }

    /// Stops and returns all reports in the order of receipt.
    pub(super) async fn stop(self) -> Vec<ObservedReport> {
        self.gateway.stop(None);
        if self.ended.await.is_err() {
            tracing::warn!("the collector of reports did not end well");
        }
        std::mem::take(&mut lock(&self.seen).reports)
    }
}

impl Seen {
    /// A vehicle sends each report to leader and standby; one is kept.
    fn add(
        &mut self,
        Delivery {
            message,
            received_at,
            ..
        }: Delivery,
    ) {
        match message {
            Incoming::Report { report, .. }
                if self.known.insert((report.node.clone(), report.seq)) =>
            {
                self.reports.push(ObservedReport {
                    report,
                    received_at,
                });
            }
            Incoming::Map(map) => self.leader = Some(map.aggregator.clone()),
            _ => {}
        }
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
