//! Objects that only one vehicle reports, in places that other vehicles observe as empty or do not observe.

use super::*;

/// Objects that an honest vehicle reports in addition to the common objects.
type Seen = fn(frame: u64, vehicle: usize) -> bool;

/// A scene: honest vehicles detect four cars on both sides of a place, and one vehicle reports a car at the place.
struct Scene {
    honest: usize,
    is_view_stated: bool,
    /// True if other cars, behind the place, show that the vehicles observe it.
    is_behind: bool,
    /// Distance of all honest vehicles but the first, metres.
    apart_m: f64,
    is_seen: Seen,
    claims: bool,
}

const PLACE: [f64; 2] = [20.0, 0.0];

impl Scene {
    fn of(honest: usize) -> Self {
        Self {
            honest,
            is_view_stated: true,
            is_behind: false,
            apart_m: 0.0,
            is_seen: |_, _| false,
            claims: true,
        }
    }

    /// Share of the maps of 20 s in which a car at the place has a probability above 0.5, and the correct and incorrect
    /// statements of each vehicle.
    fn published(&self) -> (f64, BTreeMap<NodeName, (u32, u32)>) {
        let mut tracker = tracker();
        let mut published = 0.0;
        let mut counts = BTreeMap::<_, (u32, u32)>::new();
        let frames = 200;
        for frame in 0..frames {
            for vehicle in 0..self.honest {
                let east_m = if vehicle == 0 { 0.0 } else { self.apart_m };
                let view = FieldOfView {
                    range_m: 60.0,
                    angle_rad: 2.0,
                };
                let mut objects: Vec<_> =
                    [(29.0, 12.0), (26.0, 14.0), (29.0, -12.0), (24.0, -13.0)]
                        .map(|(x_m, y_m)| car(x_m + east_m, y_m))
                        .into();
                if self.is_behind {
                    objects.extend([2.0, -2.0].map(|y_m| car(36.0 + east_m, y_m)));
                }
                if (self.is_seen)(frame, vehicle) {
                    objects.push(car(PLACE[0], PLACE[1]));
                }
                let honest = ObjectReport {
                    pose: Some(WirePose::new(east_m, vehicle as f64 - 1.5, 0.0)),
                    view: self.is_view_stated.then_some(view),
                    ..report(&format!("honest-{vehicle}"), frame, objects)
                };
                tracker.observe(honest, at(frame));
            }
            if self.claims {
                let claim = PerceivedObject::new("car", 0.99, PLACE[0], PLACE[1]);
                tracker.observe(report("claimant", frame, vec![claim]), at(frame));
            }
            let round = tracker.close(at(frame));
            let is_published = round.objects.iter().any(|object| {
                near(object, PLACE[0], PLACE[1], 3.0) && object.existence.unwrap() > 0.5
            });
            published += f64::from(u8::from(is_published)) / frames as f64;
            for evidence in round.evidence {
                let (right, wrong) = counts.entry(evidence.node).or_default();
                *(if evidence.correct { right } else { wrong }) += 1;
            }
        }
        (published, counts)
    }
}

#[test]
fn sole_claim_is_denied() {
    for honest in [2, 3, 4, 8] {
        for is_view_stated in [true, false] {
            let scene = Scene {
                is_view_stated,
                is_behind: !is_view_stated,
                ..Scene::of(honest)
            };
            let (published, counts) = scene.published();
            let bound = if honest == 2 { 0.15 } else { 0.05 };
            println!("{honest} look, view stated {is_view_stated}: {published:.3}, {counts:?}");
            assert!(
                published < bound,
                "{published} with {honest} honest vehicles, view stated {is_view_stated}"
            );
            let (right, wrong) = counts[&name("claimant")];
            // Observations of two vehicles are rarely enough for a judgement.
            let least = if honest == 2 { 1 } else { 5 };
            assert!(right == 0 && wrong >= least, "{right} right, {wrong} wrong");
            let honest_ones = counts.iter().filter(|(node, _)| **node != name("claimant"));
            assert!(honest_ones.clone().count() == honest);
            assert!(
                honest_ones
                    .map(|(_, (_, wrong))| wrong)
                    .all(|wrong| *wrong == 0)
            );
        }
    }
}

#[test]
fn unobserved_sole_claim_is_published() {
    let elsewhere = Scene {
        apart_m: 500.0,
        is_seen: |_, vehicle| vehicle == 0,
        claims: false,
        ..Scene::of(4)
    };
    let unknown = Scene {
        is_view_stated: false,
        ..Scene::of(4)
    };
    for scene in [elsewhere, unknown] {
        let (published, counts) = scene.published();
        assert!(published > 0.95, "{published}, {counts:?}");
        assert!(counts.values().all(|(_, wrong)| *wrong == 0), "{counts:?}");
    }
}

#[test]
fn rare_detections_are_no_denial() {
    let scene = Scene {
        is_seen: |frame, vehicle| vehicle == 0 && frame % 3 == 0,
        ..Scene::of(3)
    };
    let (published, counts) = scene.published();
    assert!(published > 0.95, "{published}, {counts:?}");
}

#[test]
fn frame_rate_adds_no_sole_evidence() {
    let existence = |interval_us: u64| {
        let mut tracker = tracker();
        let object = PerceivedObject::new("car", 0.3, 20.0, 0.0);
        let frames = 5_000_000 / interval_us;
        for frame in 0..frames {
            let captured_at = Timestamp(START.0 + frame * interval_us);
            let report = ObjectReport {
                captured_at_us: captured_at,
                ..report("euclid", frame, vec![object.clone()])
            };
            tracker.observe(report, captured_at);
            tracker.close(captured_at);
        }
        let end = Timestamp(START.0 + frames * interval_us);
        tracker.close(end).objects[0].existence.unwrap()
    };
    let [slow, fast] = [100_000, 20_000].map(existence);
    assert!(slow > 0.9 && fast < slow + 0.015, "{slow} {fast}");
}

/// Another aggregator had more evidence than the first detections of one vehicle.
#[test]
fn detection_keeps_inherited_existence() {
    let mut newcomer = tracker();
    let known = FusedObject {
        existence: Some(0.95),
        ..FusedObject::new(
            Uuid::from_u128(7),
            "car",
            0.9,
            20.0,
            0.0,
            Covariance::isotropic(0.2),
        )
    };
    let map = GlobalMap {
        objects: vec![known],
        ..GlobalMap::new(&Epoch::new(1, name("edge")), 30, at(0))
    };
    newcomer.adopt_map(&map, at(0));
    for frame in 1..4 {
        newcomer.observe(report("euclid", frame, vec![car(20.0, 0.0)]), at(frame));
        let round = newcomer.close(at(frame));
        let object = &round.objects[0];
        assert_eq!(object.id, Uuid::from_u128(7));
        assert!(object.existence.unwrap() > 0.94, "{object:?}");
    }
}
