use opencv::prelude::*;

use super::*;
use crate::testbed::Sighting;

const SETUP: &str = include_str!("../../../../examples/testbed/pace_setup1.json");

fn gray(image: &Mat, x: usize, y: usize) -> f64 {
    let columns = image.cols() as usize;
    f64::from(image.data_bytes().unwrap()[3 * (y * columns + x)])
}

/// A camera at the origin that looks along +x at one placard, `x_in` ahead and facing `yaw_deg`,
/// with the objects `before` in front of it.
fn lot(x_in: f64, yaw_deg: f64, before: &str) -> Testbed {
    let (sin, cos) = yaw_deg.to_radians().sin_cos();
    let x = x_in - 3.5 * cos;
    let y = 1.0 - 3.5 * sin;
    Testbed::from_json(&format!(
        r#"{{"camera": {{"image_width": 640, "image_height": 480, "horizontal_fov_deg": 62.2, "vertical_fov_deg": 48.8}},
        "placard": {{"qr_width": 1.9375, "qr_with_quiet_zone": 2.5, "card_width": 2.75, "card_height": 5.5, "empty_text": "EMPTY"}},
        "scenes": [{{"name": "lot", "cavs": [{{"id": "euclid", "position": [0, 0], "camera_heading_deg": 0}}],
        "spots": [{{"id": 0, "occupied_placard": [{x_in}, 1], "empty_placard": [{x}, {y}], "truth": "ABCD123"}}{before}]}}]}}"#
    ))
    .unwrap()
}

fn still(testbed: &Testbed) -> Mat {
    let scene = &testbed.scenes[0];
    TestbedCamera::new(testbed, scene, &scene.cavs[0], 1)
        .unwrap()
        .still()
        .clone()
}

/// The position where the values cross the middle between both ends.
fn edge(values: &[f64]) -> f64 {
    let half = (values[0] + values[values.len() - 1]) / 2.0;
    let at = values
        .windows(2)
        .position(|pair| (pair[0] > half) != (pair[1] > half))
        .unwrap();
    at as f64 + (half - values[at]) / (values[at + 1] - values[at]) + 0.5
}

#[test]
fn code_corners_match_pinhole_camera() {
    for yaw_deg in [0.0, 30.0, -40.0] {
        let testbed = lot(7.0, yaw_deg + 180.0, "");
        let image = still(&testbed);
        let camera = &testbed.camera.intrinsics;
        let card = &testbed.cards(&testbed.scenes[0])[1];
        let half_m = testbed.placard.qr_width_m / 2.0;
        // Finder patterns are dark at the upper corners and lower left; each edge is met in the
        // middle of the outer ring.
        for (right, up) in [(-1.0, 1.0), (1.0, 1.0), (-1.0, -1.0)] {
            let project = |right_m: f64, up_m: f64| {
                let (sin, cos) = card.facing_rad.sin_cos();
                let x = card.position.x - sin * right_m;
                let y = card.position.y + cos * right_m;
                camera
                    .project(&nalgebra::Point3::new(-y, -up_m, x))
                    .unwrap()
            };
            let module_m = half_m * 2.0 / 21.0;
            let side = project(right * half_m, up * (half_m - 3.5 * module_m));
            let first = side.x as usize - 2;
            let values: Vec<_> = (first..first + 5)
                .map(|x| gray(&image, x, side.y as usize))
                .collect();
            let error = first as f64 + edge(&values) - side.x;
            assert!(
                error.abs() < 0.3,
                "side at {side} with yaw {yaw_deg}: off by {error}"
            );
            let end = project(right * (half_m - 3.5 * module_m), up * half_m);
            let first = end.y as usize - 2;
            let values: Vec<_> = (first..first + 5)
                .map(|y| gray(&image, end.x as usize, y))
                .collect();
            let error = first as f64 + edge(&values) - end.y;
            assert!(
                error.abs() < 0.3,
                "end at {end} with yaw {yaw_deg}: off by {error}"
            );
        }
    }
}

#[test]
fn nearer_placard_hides_farther() {
    let before =
        r#", {"id": 1, "occupied_placard": [8, 0.5], "empty_placard": null, "truth": "NEAR"}"#;
    let one = lot(16.0, 180.0, "");
    let two = lot(16.0, 180.0, before);
    let scene = &two.scenes[0];
    assert!(
        two.sighting(scene, &scene.cavs[0], &scene.spots[0])
            .is_none()
    );
    let alone = r#", {"id": 1, "occupied_placard": [8, 0.5], "empty_placard": [11.5, 0.5], "truth": "NEAR"}"#;
    assert!(
        one.sighting(
            &one.scenes[0],
            &one.scenes[0].cavs[0],
            &one.scenes[0].spots[0]
        )
        .is_some()
    );
    let first = still(&two);
    let second = still(&lot(16.0, 210.0, alone));
    // The nearer card covers the card behind it and that card's rotation.
    let near = &two.cards(scene)[2];
    let seen = Sighting::of(near, &[], &scene.cavs[0].pose, &two).unwrap();
    assert_eq!(seen.shown, 1.0);
    for x in 270..350 {
        assert_eq!(gray(&first, x, 240), gray(&second, x, 240));
    }
}

#[test]
fn placard_back_shows_no_code() {
    let image = still(&lot(16.0, 0.0, ""));
    let values: Vec<_> = (262..312).map(|x| gray(&image, x, 240)).collect();
    assert!(
        values.windows(2).all(|pair| pair[0] == pair[1]),
        "plain cardboard: {values:?}"
    );
}

#[test]
fn frames_repeat_from_seed() {
    let small = SETUP.replace(": 640", ": 160").replace(": 480", ": 120");
    let testbed = Testbed::from_json(&small).unwrap();
    let scene = &testbed.scenes[0];
    let take = |cav: usize, seed: u64, index: u64| {
        let camera = TestbedCamera::new(&testbed, scene, &scene.cavs[cav], seed).unwrap();
        camera.frame(index).unwrap().data_bytes().unwrap().to_vec()
    };
    let frame = take(0, 7, 3);
    assert_eq!(frame.len(), 160 * 120 * 3);
    assert_eq!(frame, take(0, 7, 3));
    assert_ne!(frame, take(0, 7, 4), "another frame");
    assert_ne!(frame, take(0, 8, 3), "another seed");
    assert_ne!(frame, take(1, 7, 3), "another vehicle");
}

#[test]
fn odd_scenes_are_rendered_nevertheless() {
    for (width, height) in [(1, 1), (3, 200), (1280, 64)] {
        let text = format!(
            r#"{{"camera": {{"image_width": {width}, "image_height": {height}, "horizontal_fov_deg": 62.2, "vertical_fov_deg": 48.8}},
            "placard": {{"qr_width": 2, "qr_with_quiet_zone": 2, "card_width": 2, "card_height": 2, "empty_text": "E"}},
            "scenes": [{{"name": "odd", "cavs": [{{"id": "a", "position": [0, 0], "camera_heading_deg": 0}}], "spots": [
            {{"id": 0, "occupied_placard": [0, 0], "empty_placard": [0, 0], "truth": "ON THE CAMERA"}},
            {{"id": 1, "occupied_placard": [-5, 0], "truth": "behind it"}},
            {{"id": 2, "occupied_placard": [9, 0], "empty_placard": [9, 9], "truth": "edge on"}}]}}]}}"#
        );
        let testbed = Testbed::from_json(&text).unwrap();
        let scene = &testbed.scenes[0];
        let frame = TestbedCamera::new(&testbed, scene, &scene.cavs[0], 0)
            .unwrap()
            .frame(u64::MAX)
            .unwrap();
        assert_eq!((frame.cols(), frame.rows()), (width, height));
    }
}
