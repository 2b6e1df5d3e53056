use ecod::model::epoch::Epoch;
use ecod::model::time::Timestamp;

use super::*;

const SETUP1: &str = include_str!("../../../../examples/testbed/pace_setup1.json");
const SETUP2: &str = include_str!("../../../../examples/testbed/pace_setup2.json");

/// A map with the true labels, except at the given spots.
fn map(testbed: &Testbed, scene: &Scene, otherwise: &[(&str, Option<&str>)]) -> GlobalMap {
    let state = |spot: &Spot| {
        let label = spot
            .truth
            .clone()
            .unwrap_or_else(|| testbed.placard.empty_text.clone());
        let changed = otherwise.iter().find(|(id, _)| *id == spot.id);
        LandmarkState {
            id: spot.id.clone(),
            label: changed.map_or(Some(label), |(_, label)| label.map(Label::from)),
            confidence: 0.9,
            x_m: spot.occupied.x + 0.002,
            y_m: spot.occupied.y - 0.003,
            contributors: Vec::new(),
            observers: Vec::new(),
            readings: Vec::new(),
        }
    };
    let epoch = Epoch::new(1, NodeName::from_static("edge"));
    let landmarks = scene.spots.iter().map(state).collect();
    GlobalMap {
        landmarks,
        ..GlobalMap::new(&epoch, 1, Timestamp(0))
    }
}

fn texts(svg: &str) -> Vec<String> {
    let document = roxmltree::Document::parse(svg).unwrap();
    let texts = document
        .descendants()
        .filter(|node| node.has_tag_name(("http://www.w3.org/2000/svg", "text")));
    texts
        .filter_map(|node| Some(node.text()?.trim().to_owned()))
        .collect()
}

#[test]
fn picture_shows_truth_and_agreement() {
    for (setup, count) in [(SETUP1, 5), (SETUP2, 6)] {
        let testbed = Testbed::from_json(setup).unwrap();
        assert_eq!(testbed.scenes.len(), count);
        for scene in &testbed.scenes {
            let map = map(
                &testbed,
                scene,
                &[("slot-1", Some("WRONG")), ("slot-2", None)],
            );
            let svg = birdseye(&testbed, scene, &[], Some(&map)).unwrap();
            let texts = texts(&svg);
            assert!(
                texts.contains(&scene.name) && texts.contains(&"WRONG".to_owned()),
                "{texts:?}"
            );
            assert!(
                texts.contains(&"6 of 8 spots right (75.0 %)".to_owned()),
                "{texts:?}"
            );
            for spot in &scene.spots {
                let truth = spot.truth.as_ref().map_or("EMPTY", |label| label.as_str());
                assert!(
                    texts.iter().any(|text| text == truth),
                    "{truth} in {texts:?}"
                );
            }
            for cav in &scene.cavs {
                assert!(
                    texts.iter().any(|text| text == cav.name.as_str()),
                    "{}",
                    cav.name
                );
            }
        }
    }
}

#[test]
fn network_labels_stay_text() {
    let testbed = Testbed::from_json(SETUP1).unwrap();
    let scene = &testbed.scenes[0];
    let nasty = [
        ("slot-0", Some("<script>")),
        ("slot-1", Some("a&\"'\u{0}\u{1b}\u{ffff}")),
        ("slot-3", Some("</text><")),
    ];
    let svg = birdseye(&testbed, scene, &[], Some(&map(&testbed, scene, &nasty))).unwrap();
    assert!(!svg.contains("<script"));
    let texts = texts(&svg);
    for expected in ["<script>", "a&\"'\u{fffd}\u{fffd}\u{fffd}", "</text><"] {
        assert!(
            texts.iter().any(|text| text == expected),
            "{expected} in {texts:?}"
        );
    }
}

#[test]
fn long_labels_are_cut() {
    let testbed = Testbed::from_json(SETUP1).unwrap();
    let scene = &testbed.scenes[0];
    let map = map(&testbed, scene, &[("slot-0", Some(&"Ü".repeat(32)))]);
    let texts = texts(&birdseye(&testbed, scene, &[], Some(&map)).unwrap());
    assert!(texts.contains(&format!("{}…", "Ü".repeat(11))), "{texts:?}");
}

#[test]
fn bare_scenes_are_drawn() {
    let mut testbed = Testbed::from_json(SETUP1).unwrap();
    let map = map(&testbed, &testbed.scenes[0], &[]);
    let mut scene = testbed.scenes.remove(0);
    scene.spots.clear();
    let without_spots = birdseye(&testbed, &scene, &[], Some(&map)).unwrap();
    assert!(texts(&without_spots).contains(&"no spots".to_owned()));
    scene.cavs.clear();
    let without_anything = birdseye(&testbed, &scene, &[], None).unwrap();
    assert!(texts(&without_anything).contains(&"no map".to_owned()));
}

#[test]
fn detections_are_drawn_or_counted() {
    let testbed = Testbed::from_json(SETUP1).unwrap();
    let scene = &testbed.scenes[0];
    let cav = &scene.cavs[0];
    let bare = birdseye(&testbed, scene, &[], None).unwrap();
    let seen = |place| (cav.name.clone(), place);
    let detections = [
        seen(scene.spots[0].occupied),
        seen(scene.spots[1].occupied),
        seen(Point2::new(100.0, 0.0)),
    ];
    let svg = birdseye(&testbed, scene, &detections, None).unwrap();
    assert_eq!(
        svg.matches("<circle").count() - bare.matches("<circle").count(),
        2
    );
    assert!(texts(&svg).contains(&"1 seen outside the frame".to_owned()));
}

#[test]
fn undrawable_detections_are_refused() {
    let testbed = Testbed::from_json(SETUP1).unwrap();
    let scene = &testbed.scenes[0];
    let stranger = NodeName::from_static("stranger");
    let error = birdseye(&testbed, scene, &[(stranger, Point2::origin())], None).unwrap_err();
    assert_eq!(
        error.to_string(),
        "scene setup1-lot1 has no vehicle stranger, which a detection names"
    );
    let nowhere = (scene.cavs[0].name.clone(), Point2::new(0.0, f64::NAN));
    assert!(matches!(
        birdseye(&testbed, scene, &[nowhere], None),
        Err(BirdseyeError::Detection { .. })
    ));
    let mut map = map(&testbed, scene, &[]);
    map.landmarks[2].x_m = f64::INFINITY;
    let landmark = scene.spots[2].id.clone();
    assert_eq!(
        birdseye(&testbed, scene, &[], Some(&map)),
        Err(BirdseyeError::Landmark { landmark })
    );
}

#[test]
fn crowded_rows_do_not_overlap() {
    let rows = spread(&[100.0, 103.0, 103.0, 180.0], 0.0);
    assert_eq!(rows, [100.0, 118.0, 136.0, 180.0]);
}
