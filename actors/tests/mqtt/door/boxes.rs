//! Boxes of programs: the node whose broker receives them places them on the map.

use std::time::Duration;

use ecod::wire::{ClientRefusals, RejectReason};
use ecod_actors::platform::clock;
use serde_json::{Value, json};

use super::cell::{Cell, PATIENCE, Program};

/// The image of a camera 5 m south of the place `east`, 1.3 m above the ground and level, with a
/// person who stands there: 1.7 m high and 0.5 m wide.
fn boxes(name: &str, seq: u64) -> Value {
    json!({
        "schema": 1, "node": name, "seq": seq, "captured_at_us": clock::now(),
        "pose": {"x_m": 3, "y_m": -5, "heading_rad": 1.57, "height_m": 1.3},
        "camera": {"width_px": 1000, "height_px": 1000, "fx": 1000, "fy": 1000, "cx": 500, "cy": 400,
            "tilt_sigma_rad": 0.005},
        "boxes": [{"label": "person", "confidence": 0.9, "x_min": 450, "y_min": 320, "x_max": 550, "y_max": 670}],
    })
}

/// Sends boxes until a node's map shows the person near `east`.
async fn shown(cell: &Cell, program: &Program, name: &str, viewer: &str, contributor: &str) {
    let shown = async {
        for seq in 0.. {
            let payload = boxes(name, seq).to_string().into_bytes();
            let answer = program.ask(&format!("boxes/{name}"), payload).await;
            assert_eq!(answer.0, "Success", "{}", answer.1);
            tokio::time::sleep(Duration::from_millis(50)).await;
            let map = cell.node(viewer).newest_map();
            let map = map.borrow();
            let east = map.as_ref().map(|received| &received.map.landmarks[1]);
            if east.is_some_and(|east| {
                east.label.as_deref() == Some("person")
                    && (east.x_m - 3.0).abs() < 0.6
                    && east
                        .contributors
                        .iter()
                        .any(|by| by.as_str() == contributor)
            }) {
                return;
            }
        }
    };
    tokio::time::timeout(PATIENCE, shown)
        .await
        .unwrap_or_else(|_| panic!("the boxes of {name} are not on the map"));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn boxes_reach_all_maps() {
    let cell = Cell::of_four().await;
    let beside = Program::connect("yolo", cell.door("euclid"), &[]).await;
    shown(&cell, &beside, "euclid--yolo", "noether", "euclid").await;
    let nodeless = Program::connect("yolo", cell.door("edge"), &[]).await;
    shown(&cell, &nodeless, "watson", "euclid", "watson").await;
    cell.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn certified_vehicle_reports_without_node() {
    let mut cell = Cell::with_certificates();
    cell.start("edge", ecod::wire::Role::Edge, |_| ()).await;
    cell.start("euclid", ecod::wire::Role::Cav, |_| ()).await;
    cell.served_by("edge").await;
    let vehicle = cell.program_with("yolo", "edge", "euclid", &[]).await;
    shown(&cell, &vehicle, "euclid--yolo", "edge", "euclid").await;
    let payload = boxes("edge", 1).to_string().into_bytes();
    let (reason, text) = vehicle.ask("boxes/edge", payload).await;
    assert_eq!(reason, "NotAuthorized", "{text}");
    cell.stop().await;
}

/// Messages with a thousand boxes count as many small ones, because each takes milliseconds of the
/// broker's thread; small messages are accepted again right after them.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn many_boxes_count_as_several() {
    let cell = Cell::of_four().await;
    let program = Program::connect("yolo", cell.door("euclid"), &[]).await;
    let name = "euclid--yolo";
    let topic = "boxes/euclid--yolo";
    let began = std::time::Instant::now();
    let mut accepted = 0;
    for seq in 0..40 {
        let mut payload = boxes(name, seq);
        payload["boxes"] = vec![payload["boxes"][0].clone(); 1000].into();
        let (reason, text) = program.ask(topic, payload.to_string().into_bytes()).await;
        if reason == "Success" {
            accepted += 1;
        } else {
            assert!(text.contains("count as several"), "{reason} {text}");
        }
    }
    let most = 5.0 + 5.0 * began.elapsed().as_secs_f64();
    assert!(
        (1.0..=most).contains(&f64::from(accepted)),
        "{accepted} of {most}"
    );
    tokio::time::sleep(Duration::from_millis(100)).await;
    let (reason, text) = program
        .ask(topic, boxes(name, 40).to_string().into_bytes())
        .await;
    assert_eq!(reason, "Success", "{text}");
    cell.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn unusable_boxes_name_reason() {
    let cell = Cell::of_four().await;
    let program = Program::connect("yolo", cell.door("euclid"), &["nodes/euclid/clients"]).await;
    let name = "euclid--yolo";
    for (place, value, expected) in [
        (
            "/pose/heading_rad",
            json!(90),
            "pose.heading_rad: is beyond 2π: 90",
        ),
        (
            "/camera",
            json!({"width_px": 640, "height_px": 480}),
            "camera: needs either horizontal_fov_deg",
        ),
        (
            "/camera/width_px",
            json!(520),
            "boxes[0]: is outside the image of 520x1000",
        ),
    ] {
        let mut report = boxes(name, 1);
        *report.pointer_mut(place).unwrap() = value;
        let payload = report.to_string().into_bytes();
        let (reason, text) = program.ask(&format!("boxes/{name}"), payload).await;
        assert_eq!(reason, "PayloadFormatInvalid");
        assert!(text.contains(expected), "{text}");
    }
    let payload = boxes("gauss", 1).to_string().into_bytes();
    let (reason, text) = program.ask("boxes/gauss", payload).await;
    assert_eq!(reason, "NotAuthorized", "{text}");

    let mut report = boxes(name, 2);
    report["boxes"][0] = json!({"label": "gadget", "confidence": 0.9,
        "x_min": 450, "y_min": 20, "x_max": 550, "y_max": 60});
    let payload = report.to_string().into_bytes();
    let (reason, text) = program.ask(&format!("boxes/{name}"), payload).await;
    assert_eq!(reason, "Success", "{text}");
    cell.until(
        "the box above the horizon is counted by its sender",
        |cell| {
            let counts = cell.node("euclid").counters().rejects_by_source();
            counts
                .iter()
                .any(|count| count.source == name && count.reason == RejectReason::NotPlaced)
        },
    )
    .await;
    cell.until("the program can read why", |_| {
        let published = program.received_on("nodes/euclid/clients");
        let last = published
            .last()
            .map(|heard| serde_json::from_slice::<ClientRefusals>(&heard.payload).unwrap());
        last.is_some_and(|last| {
            last.refused.iter().any(|refusal| {
                refusal.reason == "not_placed" && refusal.text.contains("boxes[0]: ")
            })
        })
    })
    .await;
    cell.stop().await;
}
