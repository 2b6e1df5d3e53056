//! A vehicle that sees for real: rendered frames, decoded placards, a fused map, and parts that are killed on the way.

use std::path::PathBuf;
use std::time::Duration;

use ecod_actors::node::{self, NodeHandle};
use ecod_actors::telemetry::counters::Event;
use ecod_lab::testbed::{Testbed, frames, setup};
use tokio::time::timeout;

const PATIENCE: Duration = Duration::from_secs(60);
const SCENE: &str = "setup1-lot1";

/// Waits until the vehicle has got a newer map that holds the plate.
async fn plate_on_a_new_map(vehicle: &NodeHandle, plate: &str) {
    let mut newest = vehicle.newest_map();
    let last = newest
        .borrow_and_update()
        .as_ref()
        .map(|received| received.map.round);
    let seen = newest.wait_for(|received| {
        received.as_ref().is_some_and(|received| {
            Some(received.map.round) != last
                && received
                    .map
                    .landmarks
                    .iter()
                    .any(|state| state.label.as_deref() == Some(plate))
        })
    });
    timeout(PATIENCE, seen)
        .await
        .expect("the plate did not come back")
        .expect("the follower lives on");
}

/// Waits until the vehicle has looked at more frames.
async fn more_frames(vehicle: &NodeHandle) {
    let wanted = vehicle.counters().events(Event::FrameDetected) + 3;
    let looked = async {
        while vehicle.counters().events(Event::FrameDetected) < wanted {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    timeout(PATIENCE, looked).await.expect("the camera stopped");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn plate_survives_killed_parts() {
    let file =
        PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../examples/testbed/pace_setup1.json");
    let testbed = Testbed::from_json(&std::fs::read_to_string(&file).unwrap()).unwrap();
    let scene = testbed.scene(SCENE).unwrap();
    let mut edge = setup::edge(&testbed, scene);
    edge.listen = Some("127.0.0.1:0".parse().unwrap());
    let edge = node::start(edge).await.unwrap();

    let euclid = scene
        .cavs
        .iter()
        .find(|cav| cav.name.as_str() == "euclid")
        .unwrap();
    let directory = tempfile::tempdir().unwrap();
    let source = frames::render(&testbed, scene, euclid, 7, directory.path()).unwrap();
    let mut config = setup::cav(&testbed, scene, euclid, source);
    config.mqtt.broker = edge.broker_address().map(Into::into);
    config.validate().unwrap();
    let vehicle = node::start(config).await.unwrap();

    let plate = scene.spots[0].truth.as_deref().unwrap();
    plate_on_a_new_map(&vehicle, plate).await;
    let detector = vehicle.slots().detectors[0].get().unwrap().get_cell();
    let projector = vehicle.slots().projectors[0].get().unwrap().get_cell();
    for part in [detector, projector] {
        part.kill();
        more_frames(&vehicle).await;
        plate_on_a_new_map(&vehicle, plate).await;
    }
    vehicle.stop().await;
    edge.stop().await;
}
