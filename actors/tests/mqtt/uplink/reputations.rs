//! Reputations that go along when a vehicle changes cells.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use ecod::aggregator::Algorithms;
use ecod::model::names::NodeName;
use ecod::model::origin::GeographicOrigin;
use ecod::wire::{
    ObjectReport, PerceivedObject, RejectReason, ReportKind, Reputation, ReputationTopic,
};
use ecod_actors::messages::gateway::GatewayMessage;
use ecod_actors::node::NodeHandle;
use ecod_actors::node::config::NodeConfig;
use ecod_actors::platform::clock;
use ecod_actors::telemetry::counters::Event;

use crate::uplink::cell::{ORIGIN, config, start, until};
use crate::uplink::region::{Broker, Subscriber};

const LANDMARKS: usize = 12;

/// The reputation of a vehicle of which nothing is published.
const UNKNOWN: Reputation = Reputation {
    score: 0.5,
    correct: 0,
    incorrect: 0,
    foreign: None,
};

/// A cell that votes; the second is some kilometres off.
fn voting(cell: &'static str, broker: &Broker, state: &std::path::Path) -> NodeConfig {
    let mut config = config(cell, broker.address());
    config.fusion.algorithms = Algorithms::Vote;
    config.fusion.vote.weighted.freshness_s = 0.2;
    config.reputations.publish_period_s = 0.1;
    config.state_dir = Some(state.join(cell));
    if cell == "south" {
        config.origin = Some(GeographicOrigin {
            latitude_deg: 52.1,
            ..ORIGIN
        });
    }
    config
}

/// Has vehicles vote on all landmarks; the names of liars begin with `liar`.
fn vote(node: &NodeHandle, vehicles: &[&str]) {
    static SEQ: AtomicU64 = AtomicU64::new(0);
    for vehicle in vehicles {
        let seq = SEQ.fetch_add(1, Ordering::Relaxed);
        let label = if vehicle.starts_with("liar") {
            "mouse"
        } else {
            "cup"
        };
        let object = |number: usize| PerceivedObject {
            landmark: Some(format!("place-{number}").into()),
            ..PerceivedObject::new(label, 0.9, number as f64, 0.0)
        };
        let objects = (0..LANDMARKS).map(object).collect();
        let report = ObjectReport {
            objects,
            ..ObjectReport::new(NodeName::new(vehicle).unwrap(), seq, clock::now())
        };
        let message = GatewayMessage::PublishReport {
            kind: ReportKind::VoteDetections,
            report: Arc::new(report),
        };
        node.slots().gateway.send(message);
    }
}

fn reputation(node: &NodeHandle, vehicle: &str) -> Option<Reputation> {
    let newest = node.newest_reputations().borrow().clone()?;
    newest
        .message
        .reputations
        .get(&vehicle_name(vehicle))
        .copied()
}

fn vehicle_name(vehicle: &str) -> NodeName {
    NodeName::new(vehicle).unwrap()
}

/// Wrong votes that the region has of a cell about a vehicle.
fn told_wrong(subscriber: &Subscriber, vehicle: &str, cell: &str) -> u64 {
    subscriber
        .reputation(vehicle, cell)
        .map_or(0, |told| told.incorrect)
}

/// A liar in one cell starts low in the next, in the first round after its counts have come, where a newcomer starts in the
/// middle. What the next cell counts while the region is away is told when it is back. A node that has lost its disk makes no
/// count less.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_liar_that_changes_cells_is_no_newcomer() {
    for mut broker in Broker::both() {
        let (directory, subscriber) = (
            tempfile::tempdir().unwrap(),
            Subscriber::new(&broker.address()),
        );
        let north = start(voting("north", &broker, directory.path())).await;
        let residents = ["a", "b", "c", "liar"];
        until("the liar's counts in the region", async || {
            vote(&north, &residents);
            told_wrong(&subscriber, "liar", "north") > 30
        })
        .await;
        let told = subscriber.reputation("liar", "north").unwrap();
        let own = reputation(&north, "liar").unwrap();
        eprintln!("{}: north says {told:?}, and itself {own:?}", broker.name());
        assert!(own.score < 0.4 && own.foreign.is_none());

        let south = start(voting("south", &broker, directory.path())).await;
        let is_proven = |node: &NodeHandle, vehicle| {
            reputation(node, vehicle).is_some_and(|known| known.correct > 20)
        };
        until("residents are known in south", async || {
            vote(&south, &residents[..3]);
            is_proven(&south, "a")
        })
        .await;
        let begun = clock::now();
        until("what north says counts in south", async || {
            vote(&south, &["a", "b", "c", "liar", "newcomer"]);
            reputation(&south, "liar").is_some_and(|liar| liar.foreign.is_some())
        })
        .await;
        let (liar, newcomer) = (
            reputation(&south, "liar").unwrap(),
            reputation(&south, "newcomer").unwrap_or(UNKNOWN),
        );
        eprintln!(
            "{}: in south after {:?} {liar:?}, a newcomer {newcomer:?}",
            broker.name(),
            clock::now().since(begun)
        );
        assert!(liar.score < 0.4 && newcomer.score > 0.45 && newcomer.foreign.is_none());
        assert!(south.counters().events(Event::CellReputationAccepted) > 0);

        // A cell tells its own evidence only, under its own name.
        let topic = ReputationTopic {
            vehicle: vehicle_name("liar"),
            cell: NodeName::from_static("thief"),
        };
        let stolen = ecod::wire::encode(&told, ecod::wire::Encoding::Json);
        subscriber.publish_at(&topic.path(), stolen).await;
        until("a stolen word rejected", async || {
            let counts = south.counters().rejects_by_source();
            counts.iter().any(|count| {
                count.reason == RejectReason::NodeMismatch && count.source == "cell thief"
            })
        })
        .await;

        broker.kill();
        let cut_at = clock::now();
        while clock::now().since(cut_at) < Duration::from_secs(4) {
            vote(&south, &["a", "b", "c", "liar"]);
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
        let counted = reputation(&south, "liar").unwrap().incorrect;
        let before = told_wrong(&subscriber, "liar", "south");
        broker.revive();
        let revived_at = clock::now();
        until("what was counted meanwhile", async || {
            told_wrong(&subscriber, "liar", "south") >= counted
        })
        .await;
        eprintln!(
            "{}: {counted} wrong votes in south, {before} told before the region was cut off, all told {:?} after it is back",
            broker.name(),
            clock::now().since(revived_at)
        );
        assert!(counted > before + 30);

        // Without its disk the cell begins to count anew, and the region does not.
        south.stop().await;
        let last = told_wrong(&subscriber, "liar", "south");
        let mut bare = voting("south", &broker, directory.path());
        bare.state_dir = None;
        let south = start(bare).await;
        let late = Subscriber::new(&broker.address());
        until("a new leader counts", async || {
            vote(&south, &["a", "b", "c", "liar"]);
            reputation(&south, "liar").is_some_and(|liar| liar.incorrect > 20)
        })
        .await;
        // It listens for two seconds before it says anything.
        tokio::time::sleep(Duration::from_secs(3)).await;
        assert!(
            told_wrong(&late, "liar", "south") >= last,
            "{} {last}",
            told_wrong(&late, "liar", "south")
        );
        assert!(reputation(&south, "liar").unwrap().incorrect < last);
        south.stop().await;
        north.stop().await;
    }
}
