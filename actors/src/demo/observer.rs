//! Listens to every report of the cell.

use std::collections::BTreeSet;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use ecod::names::NodeName;
use ecod::time::Timestamp;
use ecod::wire::{NodeState, NodeStatus, ObjectReport, Role, SCHEMA_VERSION};
use ractor::{Actor, ActorRef};
use tokio::task::JoinHandle;
use uuid::Uuid;

use crate::gateway::{Delivery, Gateway, GatewayArguments, GatewayMessage, Incoming, MqttConfig, Part};

/// A report and when it came.
#[derive(Debug, Clone)]
pub struct ObservedReport {
    /// The report.
    pub report: Arc<ObjectReport>,
    /// When it came, by this process's clock.
    pub received_at: Timestamp,
}

/// A gateway that keeps every report.
pub(super) struct Observer {
    gateway: ActorRef<GatewayMessage>,
    ended: JoinHandle<()>,
    reports: Arc<Mutex<Vec<ObservedReport>>>,
}

impl Observer {
    pub(super) async fn start(broker: SocketAddr, name: NodeName) -> anyhow::Result<Self> {
        let reports: Arc<Mutex<Vec<ObservedReport>>> = Arc::default();
        let kept = Arc::clone(&reports);
        let status = NodeStatus {
            schema: SCHEMA_VERSION,
            node: name,
            id: Uuid::now_v7(),
            role: Role::Cav,
            state: NodeState::Following,
            epoch: 0,
            aggregator: None,
            version: env!("CARGO_PKG_VERSION").into(),
        };
        let arguments = GatewayArguments {
            cell: NodeName::from_static("testbed"),
            part: Part::Candidate,
            status,
            mqtt: MqttConfig { retry_max_ms: 200, ..MqttConfig::default() },
            counters: Arc::default(),
            subscriber: Arc::new(move |Delivery { message, received_at, .. }| {
                if let Incoming::Report { report, .. } = message {
                    lock(&kept).push(ObservedReport { report, received_at });
                }
            }),
            seed: 1,
        };
        let (gateway, ended) = Actor::spawn(None, Gateway, arguments).await?;
        gateway.cast(GatewayMessage::SetBrokers { addresses: vec![broker.into()] })?;
        Ok(Self { gateway, ended, reports })
    }

    /// How many vehicles have reported.
    pub(super) fn reporters(&self) -> usize {
        lock(&self.reports).iter().map(|observed| observed.report.node.clone()).collect::<BTreeSet<_>>().len()
    }

    /// How many reports have come.
    pub(super) fn reports(&self) -> usize {
        lock(&self.reports).len()
    }

    /// Ends listening and gives all reports in the order of receipt.
    pub(super) async fn stop(self) -> Vec<ObservedReport> {
        self.gateway.stop(None);
        if self.ended.await.is_err() {
            tracing::warn!("the observer did not end well");
        }
        std::mem::take(&mut lock(&self.reports))
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
