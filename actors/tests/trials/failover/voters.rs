//! Vehicles that vote, played by the harness, and the reputations that the cell publishes of them.

use std::net::SocketAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use anyhow::ensure;
use ecod::model::names::NodeName;
use ecod::wire::{
    NodeStatus, ObjectReport, PerceivedObject, ReportKind, Reputations, Role, SCHEMA_VERSION,
};
use ecod_actors::actors::gateway::{Gateway, GatewayArguments};
use ecod_actors::messages::gateway::GatewayMessage;
use ecod_actors::platform::clock;
use ecod_actors::transport::mqtt::{Delivery, Incoming, MqttConfig, Security, SubscriptionRole};
use ractor::{Actor, ActorRef};
use uuid::Uuid;

use crate::failover::settings::{CELL, LANDMARK};

/// Two agree, one does not.
const VOTES: [(&str, &str); 3] = [("euclid", "cup"), ("gauss", "cup"), ("liar", "dog")];

const VOTING: Duration = Duration::from_secs(4);
const VOTE_PERIOD: Duration = Duration::from_millis(100);

/// Longer than the time to settle the last votes, publish their evidence, and send it to the other candidates.
const SETTLING: Duration = Duration::from_secs(4);

/// Longest time for the votes to settle on a busy machine.
const PATIENCE: Duration = Duration::from_secs(60);

/// A connection to every broker of the cell.
pub(crate) struct Voters {
    gateway: ActorRef<GatewayMessage>,
    newest: Arc<Mutex<Option<Arc<Reputations>>>>,
    seq: u64,
}

impl Voters {
    pub(crate) async fn connect(brokers: Vec<SocketAddr>) -> anyhow::Result<Self> {
        let newest: Arc<Mutex<Option<Arc<Reputations>>>> = Arc::default();
        let kept = Arc::clone(&newest);
        let status = NodeStatus::starting(
            NodeName::from_static("voters"),
            Uuid::now_v7(),
            Role::Cav,
            env!("CARGO_PKG_VERSION"),
        );
        let arguments = GatewayArguments {
            cell: NodeName::from_static(CELL),
            role: SubscriptionRole::Follower,
            status,
            mqtt: MqttConfig::default(),
            security: Security::default(),
            clock: Default::default(),
            counters: Arc::default(),
            subscriber: Arc::new(move |Delivery { message, .. }| {
                if let Incoming::Reputations(reputations) = message {
                    keep(&mut lock(&kept), reputations);
                }
            }),
            seed: 1,
            only_observes: false,
        };
        let (gateway, _) = Actor::spawn(None, Gateway, arguments).await?;
        gateway.cast(GatewayMessage::SetBrokers {
            addresses: brokers.into_iter().map(Into::into).collect(),
        })?;
        Ok(Self {
            gateway,
            newest,
            seq: 0,
        })
    }

    /// Votes for a while, lets the votes settle, and gives the reputations that came of them.
    pub(crate) async fn vote(&mut self) -> anyhow::Result<Reputations> {
        let started = Instant::now();
        while started.elapsed() < VOTING {
            self.seq += 1;
            for (node, label) in VOTES {
                let report = Arc::new(vote(NodeName::from_static(node), label, self.seq));
                self.gateway.cast(GatewayMessage::PublishReport {
                    kind: ReportKind::VoteDetections,
                    report,
                })?;
            }
            tokio::time::sleep(VOTE_PERIOD).await;
        }
        let ended = Instant::now();
        let mut before = self.newest();
        loop {
            tokio::time::sleep(SETTLING).await;
            let after = self.newest();
            let has_settled = before
                .zip(after.as_ref())
                .is_some_and(|(b, a)| b.reputations == a.reputations);
            if let Some(reputations) = after
                .as_ref()
                .filter(|after| has_settled && is_unmasked(after))
            {
                return Ok(reputations.clone());
            }
            ensure!(
                ended.elapsed() < PATIENCE,
                "the votes did not become reputations: {after:?}"
            );
            before = after;
        }
    }

    /// The reputations of the latest leadership that has published any.
    pub(crate) fn newest(&self) -> Option<Reputations> {
        lock(&self.newest).as_deref().cloned()
    }
}

impl Drop for Voters {
    fn drop(&mut self) {
        self.gateway.stop(None);
    }
}

fn is_unmasked(reputations: &Reputations) -> bool {
    let reputation_of = |node| reputations.reputations.get(&NodeName::from_static(node));
    reputation_of("liar").is_some_and(|liar| liar.incorrect > 0)
        && reputation_of("euclid").is_some_and(|euclid| euclid.correct > 0)
}

fn keep(newest: &mut Option<Arc<Reputations>>, reputations: Arc<Reputations>) {
    let order = |r: &Reputations| (r.epoch, r.round);
    if newest
        .as_ref()
        .is_none_or(|known| order(known) <= order(&reputations))
    {
        *newest = Some(reputations);
    }
}

fn vote(node: NodeName, label: &str, seq: u64) -> ObjectReport {
    let object = PerceivedObject {
        landmark: Some(LANDMARK.into()),
        ..PerceivedObject::new(label, 0.9, 6.0, 0.0)
    };
    let _schema = SCHEMA_VERSION;
    let captured_at_us = clock::now();
    ObjectReport {
        objects: vec![object],
        ..ObjectReport::new(node, seq, captured_at_us)
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
