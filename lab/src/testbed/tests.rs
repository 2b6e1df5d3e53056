use std::f64::consts::{FRAC_PI_2, PI};

use serde_json::{Value, json};

use super::*;

const SETUPS: [&str; 2] = [
    include_str!("../../../examples/testbed/pace_setup1.json"),
    include_str!("../../../examples/testbed/pace_setup2.json"),
];

/// A camera at the origin that looks along +x at cards that face it; one inch is one unit of the
/// file.
fn lot(spots: &Value) -> Value {
    json!({
        "camera": {"image_width": 640, "image_height": 480, "horizontal_fov_deg": 62.2, "vertical_fov_deg": 48.8},
        "placard": {"qr_width": 1.9375, "qr_with_quiet_zone": 2.5, "card_width": 2.75, "card_height": 5.5, "empty_text": "EMPTY"},
        "scenes": [{
            "name": "lot", "spots": spots,
            "cavs": [{"id": "euclid", "position": [0, 0], "camera_heading_deg": 0}],
        }],
    })
}

fn read(value: &Value) -> Result<Testbed, TestbedError> {
    Testbed::from_json(&value.to_string())
}

fn spot(id: u32, x: f64, y: f64, truth: Option<&str>) -> Value {
    json!({"id": id, "occupied_placard": [x, y], "empty_placard": [x + 3.5, y], "truth": truth})
}

fn seen(spots: &Value) -> Vec<bool> {
    let testbed = read(&lot(spots)).unwrap();
    let scene = &testbed.scenes[0];
    scene
        .spots
        .iter()
        .map(|spot| testbed.sighting(scene, &scene.cavs[0], spot).is_some())
        .collect()
}

#[test]
fn recorded_setups_use_metres_and_radians() {
    let [first, second] = SETUPS.map(|text| Testbed::from_json(text).unwrap());
    assert_eq!((first.scenes.len(), second.scenes.len()), (5, 6));
    assert_eq!(first.camera.capture_interval, Duration::from_millis(100));
    assert_eq!(first.camera.submission_interval, Duration::from_millis(500));
    assert!(
        (first
            .camera
            .intrinsics
            .horizontal_field_of_view()
            .to_degrees()
            - 62.2)
            .abs()
            < 1e-9
    );
    let scene = first.scene("setup1-lot1").unwrap();
    let landmarks = scene.landmarks(&first.placard);
    assert_eq!(landmarks[5].id, "slot-5");
    assert!((landmarks[5].position - Point2::new(0.254, 0.9652)).norm() < 1e-12);
    assert!((landmarks[5].facing_rad.unwrap() - 0.5f64.atan2(3.5)).abs() < 1e-12);
    assert_eq!(landmarks[5].vacancy.as_ref().unwrap().label, "EMPTY");
    assert_eq!(scene.spots[0].truth.as_deref(), Some("EFGH456"));
    assert_eq!(scene.spots[2].truth, None);
    assert_eq!(
        first.cards(scene).len(),
        8 + 6,
        "every spot has its sign, six have a vehicle"
    );
    assert_eq!(scene.cavs[3].name.as_str(), "watson");
    assert!((scene.cavs[3].pose.heading_rad - (-127f64).to_radians()).abs() < 1e-12);
    assert_eq!(scene.recorded[0].single_cav_accuracy_pct[0].1, 27.62);
}

#[test]
fn tiny_placard_is_unreadable() {
    let at = |x: f64| seen(&json!([spot(1, x, 0.0, Some("A"))]))[0];
    assert!(at(40.0), "26 px wide");
    assert!(!at(44.0), "23 px wide");
}

#[test]
fn recorded_runs_may_be_partial() {
    let mut file = lot(&json!([spot(1, 10.0, 0.0, None)]));
    file["scenes"][0]["recorded"] = json!([{"run": "14a"}, {"pace_accuracy_pct": 87.5}]);
    let recorded = read(&file).unwrap().scenes[0].recorded.clone();
    assert_eq!(
        recorded
            .iter()
            .filter_map(|run| run.pace_accuracy_pct)
            .collect::<Vec<_>>(),
        [87.5]
    );
}

#[test]
fn optional_keys_may_be_missing() {
    let mut file = lot(&json!([
        {"id": "north", "occupied_placard": [10, 0], "empty_placard": [10, 3]},
        {"id": 1, "occupied_placard": [10, 5], "empty_placard": null, "truth": null, "colour": "red"},
        {"id": 2, "occupied_placard": [10, 9], "empty_placard": [10, 9], "truth": "A"},
    ]));
    file["camera"]["image_width"] = json!(1);
    file["notes"] = json!(["unknown"]);
    file["scenes"][0]["recorded"] = Value::Null;
    let testbed = read(&file).unwrap();
    let spots = &testbed.scenes[0].spots;
    assert_eq!(spots[0].id, "slot-north");
    assert!(
        spots
            .iter()
            .all(|spot| (spot.facing_rad + FRAC_PI_2).abs() < 1e-12),
        "all face as the only one that can"
    );
    assert_eq!(testbed.cards(&testbed.scenes[0]).len(), 3);
    assert_eq!(
        read(&lot(&json!([{"id": 0, "occupied_placard": [1, 1]}])))
            .unwrap()
            .scenes[0]
            .spots[0]
            .facing_rad,
        0.0
    );
    let mut none = lot(&json!([]));
    none["scenes"][0]["cavs"] = json!([]);
    assert!(read(&none).unwrap().scenes[0].cavs.is_empty());
}

#[test]
fn errors_name_scene_and_key() {
    let broken = |change: &dyn Fn(&mut Value)| {
        let mut file = lot(&json!([spot(0, 10.0, 0.0, None), spot(1, 10.0, 5.0, None)]));
        change(&mut file);
        read(&file).unwrap_err().to_string()
    };
    let scene = |change: &dyn Fn(&mut Value)| broken(&|file| change(&mut file["scenes"][0]));
    assert_eq!(
        scene(&|scene| scene["spots"][1]["truth"] = json!(7)),
        "scene lot: `spots[1].truth` cannot be read: invalid type: integer `7`, expected a string"
    );
    assert_eq!(
        scene(&|scene| scene["cavs"][0]["id"] = json!("a/b")),
        "scene lot: `cavs[0].id` is a name \"a/b\" must be 1 to 64 characters of A-Z, a-z, 0-9, _ and -"
    );
    assert_eq!(
        scene(&|scene| scene["spots"][1]["id"] = json!(0)),
        "scene lot: `spots[1].id` gives \"slot-0\", used before"
    );
    assert_eq!(
        scene(&|scene| scene["spots"][0]["occupied_placard"] = json!([1e9, 0])),
        "scene lot: `spots[0].occupied_placard` is [1000000000.0, 0.0], must be within ±1000000 inches"
    );
    assert!(
        scene(&|scene| scene["cavs"][0] = json!({"id": "a"})).contains("missing field `position`")
    );
    assert!(scene(&|scene| *scene = json!({"spots": []})).starts_with("scene 0: "));
    assert_eq!(
        broken(&|file| file["camera"]["vertical_fov_deg"] = json!(180)),
        "scene file: `camera.vertical_fov_deg` is 180, must be above 0 and at most 170"
    );
    assert_eq!(
        broken(&|file| file["units"] = json!({"length": "metre"})),
        "scene file: `units.length` is \"metre\", must be \"inch\""
    );
    for interval_s in [1e-9, 0.0, -1.0, 7200.0] {
        let error = broken(&|file| file["camera"]["capture_interval_s"] = json!(interval_s));
        assert!(
            error.starts_with("scene file: `camera.capture_interval_s` is ")
                && error.contains("0.0001"),
            "{error}"
        );
    }
    let hours = broken(&|file| {
        file["camera"]["capture_interval_s"] = json!(0.001);
        file["camera"]["submission_interval_s"] = json!(60);
    });
    assert_eq!(
        hours,
        "scene file: `camera.submission_interval_s` is 60, must be above 0.0001 and at most 1"
    );
    assert_eq!(
        broken(&|file| file["scenes"] = json!([])),
        "scene file: `scenes` is empty, must have at least one scene"
    );
    assert!(matches!(
        Testbed::from_json("{"),
        Err(TestbedError::NotJson(_))
    ));
}

#[test]
fn spot_is_visible_frontally_and_whole() {
    assert_eq!(seen(&json!([spot(0, 15.0, 0.0, Some("A"))])), [true]);
    let edge = 15.0 * 31.1f64.to_radians().tan() - 1.9375 / 2.0;
    assert_eq!(
        seen(&json!([spot(0, 15.0, edge - 0.01, Some("A"))])),
        [true]
    );
    assert_eq!(
        seen(&json!([spot(0, 15.0, edge + 0.01, Some("A"))])),
        [false],
        "cut by the left edge of the image"
    );
    assert_eq!(
        seen(&json!([spot(0, -15.0, 0.0, Some("A"))])),
        [false],
        "behind the camera"
    );
    let from_behind =
        json!({"id": 0, "occupied_placard": [15, 0], "empty_placard": [11, 0], "truth": "A"});
    assert_eq!(seen(&json!([from_behind])), [false]);
    assert_eq!(
        seen(&json!([spot(0, 2.0, 0.0, Some("A"))])),
        [false],
        "taller than the image"
    );
    assert_eq!(
        seen(&json!([spot(0, 0.0, 0.0, Some("A"))])),
        [false],
        "on the camera itself"
    );
}

#[test]
fn parked_vehicle_hides_objects_behind() {
    let cover = |y: f64| {
        seen(&json!([
            spot(0, 16.0, 0.0, None),
            spot(1, 8.0, y, Some("A"))
        ]))[0]
    };
    assert!(!cover(0.0));
    // Seen from the origin, the code of the sign ends at a slope of 0.0497, the plate before it
    // begins at (y - 1.375) / 8.
    assert!(!cover(1.6), "covers a quarter of the code");
    assert!(cover(2.1), "does not cover the code");
    let camera = Pose::new(0.0, 0.0, 0.0);
    let testbed = read(&lot(&json!([spot(0, 15.0, 0.0, Some("A"))]))).unwrap();
    let [sign, plate] = testbed.cards(&testbed.scenes[0]).try_into().unwrap();
    let cards = [sign.clone(), plate.clone()];
    assert_eq!(
        Sighting::of(&sign, &cards, &camera, &testbed)
            .unwrap()
            .shown,
        0.0
    );
    let sighting = Sighting::of(&plate, &cards, &camera, &testbed).unwrap();
    assert_eq!((sighting.shown, sighting.yaw_rad), (1.0, 0.0));
    assert!((sighting.range_m - 0.381).abs() < 1e-12);
    let fx = testbed.camera.intrinsics.fx;
    assert!((sighting.width_px - fx * 1.9375 / 15.0).abs() < 1e-9);
    assert_eq!(
        plate.hit(&camera, 0.0).unwrap(),
        Hit {
            depth_m: 0.381,
            right_m: 0.0,
            front: true
        }
    );
    assert!(wrap(plate.facing_rad - PI) < 1e-12);
}

fn wrap(angle_rad: f64) -> f64 {
    ecod::model::geometry::wrap_angle(angle_rad).abs()
}
