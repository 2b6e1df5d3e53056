//! A cell without landmarks, on real sockets: objects, and the vehicles' statements about them.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use ecod::aggregator::Algorithms;
use ecod::model::names::NodeName;
use ecod::wire::{GlobalMap, ObjectReport, PerceivedObject, ReportKind, Role};
use ecod_actors::messages::gateway::GatewayMessage;
use ecod_actors::node::config::NodeConfig;
use ecod_actors::node::{self, NodeHandle};
use ecod_actors::platform::clock;
use ecod_actors::telemetry::counters::Event;
use ecod_testkit::{node_config, until_by as until};
use uuid::Uuid;

fn config(node: &'static str, role: Role) -> NodeConfig {
    let mut config = node_config(node, "road", role);
    config.fusion.algorithms = Algorithms::Pace;
    config.reputations.publish_period_s = 0.1;
    config
}

/// Has two vehicles see the same two cars, or rather have seen them some time ago.
fn see(reporter: &NodeHandle, ago: Duration) {
    static SEQ: AtomicU64 = AtomicU64::new(0);
    for node in ["euclid", "gauss"] {
        let seq = SEQ.fetch_add(1, Ordering::Relaxed);
        let objects = [0.0, 20.0]
            .map(|x_m| PerceivedObject::new("car", 0.9, x_m, 0.0))
            .to_vec();
        let report = ObjectReport {
            objects,
            ..ObjectReport::new(NodeName::from_static(node), seq, clock::now() - ago)
        };
        let message = GatewayMessage::PublishReport {
            kind: ReportKind::Detections,
            report: Arc::new(report),
        };
        reporter.slots().gateway.send(message);
    }
}

fn map(node: &NodeHandle) -> Option<Arc<GlobalMap>> {
    node.newest_map()
        .borrow()
        .as_ref()
        .map(|newest| Arc::clone(&newest.map))
}

/// The identities of the certain objects.
fn ids(map: &GlobalMap) -> Vec<Uuid> {
    map.objects
        .iter()
        .filter(|object| object.confidence > 0.5)
        .map(|object| object.id)
        .collect()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn tracking_cell_keeps_identities() {
    let edge = node::start(config("edge", Role::Edge)).await.unwrap();
    let mut config = config("euclid", Role::Cav);
    config.mqtt.broker = edge.broker_address().map(Into::into);
    config.mqtt.retry_max_ms = 100;
    let euclid = node::start(config).await.unwrap();
    let look = || see(&euclid, Duration::ZERO);

    let rated = || {
        let newest = euclid
            .newest_reputations()
            .borrow()
            .as_ref()
            .map(|newest| Arc::clone(&newest.message));
        newest.is_some_and(|newest| {
            newest
                .reputations
                .values()
                .filter(|vehicle| vehicle.correct > 0)
                .count()
                == 2
        })
    };
    until("both vehicles rated", look, rated).await;
    until("both objects there", look, || {
        map(&euclid).is_some_and(|map| ids(&map).len() == 2)
    })
    .await;
    let before = ids(&map(&euclid).unwrap());

    let fuser = edge.slots().fuser.get().unwrap();
    fuser.kill();
    let restarted = || {
        edge.slots()
            .fuser
            .get()
            .is_some_and(|holder| holder.get_id() != fuser.get_id())
    };
    until("a new fuser", look, restarted).await;
    let since = clock::now();
    until("a map of the new fuser", look, || {
        map(&euclid).is_some_and(|map| map.fused_at_us > since)
    })
    .await;
    assert_eq!(ids(&map(&euclid).unwrap()), before);

    let overtaken = || {
        look();
        std::thread::sleep(Duration::from_millis(5));
        see(&euclid, Duration::from_millis(100));
    };
    until("a report out of order", overtaken, || {
        edge.counters().events(Event::ReportOvertaken) > 0
    })
    .await;
    let late = || see(&euclid, Duration::from_millis(700));
    until("a late report", late, || {
        edge.counters().events(Event::ReportLate) > 0
    })
    .await;
    euclid.stop().await;
    edge.stop().await;
}
