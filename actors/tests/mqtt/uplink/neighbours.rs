//! Two neighbouring cells.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use ecod::model::names::NodeName;
use ecod::model::origin::GeographicOrigin;
use ecod::model::quadkey::Quadkey;
use ecod::wire::{
    NeighbourObject, ObjectReport, PerceivedObject, RegionTopic, RegionTopicKind, RejectReason,
    ReportKind,
};
use ecod_actors::messages::gateway::GatewayMessage;
use ecod_actors::node::NodeHandle;
use ecod_actors::platform::clock;
use ecod_actors::telemetry::counters::Event;
use ecod_testkit::until_async as until;

use crate::uplink::cell::{ORIGIN, config, round, start};
use crate::uplink::region::{Broker, Subscriber};

/// The origin so many metres north of the first cell's.
fn north_of(y_m: f64) -> GeographicOrigin {
    let place = ORIGIN.to_wgs84(0.0, y_m, 0.0);
    GeographicOrigin {
        latitude_deg: place.latitude_deg,
        longitude_deg: place.longitude_deg,
        ..ORIGIN
    }
}

/// Has two vehicles of a cell see a car.
fn see(node: &NodeHandle, x_m: f64, y_m: f64) {
    static SEQ: AtomicU64 = AtomicU64::new(0);
    for vehicle in ["euclid", "gauss"] {
        let seq = SEQ.fetch_add(1, Ordering::Relaxed);
        let objects = vec![PerceivedObject::new("car", 0.9, x_m, y_m)];
        let report = ObjectReport {
            objects,
            ..ObjectReport::new(NodeName::from_static(vehicle), seq, clock::now())
        };
        let message = GatewayMessage::PublishReport {
            kind: ReportKind::Detections,
            report: Arc::new(report),
        };
        node.slots().gateway.send(message);
    }
}

fn neighbour_objects(node: &NodeHandle) -> Vec<NeighbourObject> {
    node.newest_map()
        .borrow()
        .as_ref()
        .map_or_else(Vec::new, |newest| newest.map.neighbour_objects.clone())
}

/// An object of one cell is in the other's map, in the other's frame, with cell and age. Maps come faster, and the
/// region's own maps have it once.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn neighbours_nearby_objects_are_mapped() {
    for broker in Broker::both() {
        let subscriber = Subscriber::new(&broker.address());
        let mut north_config = config("north", broker.address());
        north_config.origin = Some(north_of(60.0));
        let south = start(config("south", broker.address())).await;
        let north = start(north_config).await;
        let look = || {
            see(&south, 3.0, 40.0);
            see(&north, 0.0, 25.0);
        };
        let has_neighbour = || {
            neighbour_objects(&north)
                .iter()
                .any(|near| near.object.confidence > 0.5)
        };
        let shown = async || {
            look();
            has_neighbour()
        };
        until("an object of the neighbour", shown).await;
        let near = neighbour_objects(&north).pop().unwrap();
        assert_eq!(near.cell.as_str(), "south");
        // 20 m south of the northern cell's origin.
        let x_m = near.object.x_m;
        let y_m = near.object.y_m;
        assert!(
            (x_m - 3.0).abs() < 0.5 && (y_m + 20.0).abs() < 0.5,
            "{x_m} {y_m}"
        );
        assert!(near.age_s < 1.5, "{}", near.age_s);

        let begun = subscriber.maps("south").len();
        let first_round = round(&south);
        let since = clock::now();
        while clock::now().since(since) < Duration::from_secs(3) {
            look();
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
        let hz = (subscriber.maps("south").len() - begun) as f64
            / clock::now().since(since).as_secs_f64();
        eprintln!(
            "{}: {hz:.1} maps a second with a neighbour, age there {:.0} ms",
            broker.name(),
            1e3 * near.age_s
        );
        let rounds = round(&south) - first_round;
        let rounds_hz = rounds as f64 / clock::now().since(since).as_secs_f64();
        // Two of ten without a neighbour. Rounds close with each pair of reports, twenty a second on a machine that keeps up.
        assert!(
            hz > 0.5 * rounds_hz.min(10.0),
            "{hz} maps a second of {rounds_hz} rounds"
        );
        let maps = subscriber.maps("north");
        assert!(
            maps.iter()
                .all(|(message, _)| message.map.neighbour_objects.is_empty())
        );
        assert!(north.counters().events(Event::CellMapAccepted) > 10);

        // Unknown cells are counted by cell, without an effect.
        let tile = Quadkey::of_cell(&ORIGIN);
        let kind = RegionTopicKind::Map;
        let of = |cell| RegionTopic {
            tile,
            cell: NodeName::from_static(cell),
            kind,
        };
        let stolen = ecod::wire::encode(&maps.last().unwrap().0, ecod::wire::Encoding::Json);
        subscriber.publish(&of("liar"), "no map").await;
        subscriber.publish(&of("thief"), stolen).await;
        let rejected = |reason, cell: &str| {
            let counts = south.counters().rejects_by_source();
            counts
                .iter()
                .any(|count| count.reason == reason && count.source == format!("cell {cell}"))
        };
        until("both rejected", async || {
            rejected(RejectReason::Malformed, "liar")
                && rejected(RejectReason::NodeMismatch, "thief")
        })
        .await;
        north.stop().await;
        south.stop().await;
    }
}
