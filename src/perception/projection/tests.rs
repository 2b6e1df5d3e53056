use nalgebra::{Point2, Point3, Vector2};
use proptest::prelude::*;

mod ground;

use super::*;

const SIDE_M: f64 = 0.05;

fn camera() -> Intrinsics {
    Intrinsics::from_field_of_view(640, 480, 62.2f64.to_radians(), 48.8f64.to_radians())
}

fn projection(ranging: Ranging) -> Projection {
    let sizes = ObjectSizes {
        default: Some(ObjectSize::square(SIDE_M)),
        ..ObjectSizes::default()
    };
    Projection::new(
        ProjectionConfig {
            ranging,
            sizes,
            ..ProjectionConfig::default()
        },
        camera(),
        Mount::default(),
    )
}

fn detection(bounding_box: BoundingBox) -> Detection {
    Detection {
        label: "QR1".into(),
        confidence: 0.9,
        bounding_box,
        corners: None,
    }
}

/// The box of an upright board of side `SIDE_M` whose middle is at `range_m` and `bearing_rad` and
/// whose normal is turned by `yaw_rad` from the camera's axis.
fn board(range_m: f64, bearing_rad: f64, yaw_rad: f64) -> BoundingBox {
    let forward = range_m * bearing_rad.cos();
    let left = range_m * bearing_rad.sin();
    let half = SIDE_M / 2.0;
    let corners =
        [(-half, -half), (half, -half), (half, half), (-half, half)].map(|(along, down)| {
            let point = Point3::new(
                along * yaw_rad.cos() - left,
                down,
                forward + along * yaw_rad.sin(),
            );
            camera().project(&point).expect("before the camera")
        });
    BoundingBox::around(&corners)
}

fn poses() -> impl Strategy<Value = Pose> {
    (-5.0..5.0, -5.0..5.0, -7.0..7.0).prop_map(|(x, y, heading)| Pose::new(x, y, heading))
}

fn offset_m(object: &PerceivedObject, expected: Point2<f64>) -> f64 {
    (Point2::new(object.x_m, object.y_m) - expected).norm()
}

proptest! {
    #[test]
    fn pinhole_ranging_inverts_projection(
        pose in poses(), range_m in 0.2..3.0, bearing_rad in -0.4..0.4f64,
    ) {
        let expected = pose.transform(range_m * bearing_rad.cos(), range_m * bearing_rad.sin());
        // Parallel to the image for the height, square to the sight for the width.
        for (ranging, yaw_rad) in [(Ranging::BoxHeight, 0.0), (Ranging::BoxWidth, bearing_rad)] {
            let placed = projection(ranging).place(&detection(board(range_m, bearing_rad, yaw_rad)), Cut::default(), None, &pose).unwrap();
            prop_assert!(offset_m(&placed, expected) <= 1e-9, "{ranging:?}");
        }
        let target = Point3::new(-range_m * bearing_rad.sin(), 0.1, range_m * bearing_rad.cos());
        let seen = detection(board(range_m, bearing_rad, 0.7));
        let placed = projection(Ranging::Corners).place(&seen, Cut::default(), Some(&target), &pose).unwrap();
        prop_assert!(offset_m(&placed, expected) <= 1e-9);
    }

    #[test]
    fn paper_ranging_matches_publication(pose in poses(), x_min in 0.0..500.0f64, w in 1.0..130.0f64) {
        let seen = detection(BoundingBox { x_min, y_min: 100.0, x_max: x_min + w, y_max: 150.0 });
        let placed = projection(Ranging::Paper).place(&seen, Cut::default(), None, &pose).unwrap();

        // Algorithm 1 of the paper, line by line, in its own units.
        let gamma_deg = 62.2 / 640.0;
        let w_omega = seen.bounding_box.x_max - seen.bounding_box.x_min;
        let alpha_deg = gamma_deg * w_omega;
        let d_omega = SIDE_M / alpha_deg.to_radians().tan();
        let x_center = seen.bounding_box.x_min + w_omega / 2.0;
        let theta_deg = pose.heading_rad.to_degrees() - gamma_deg * x_center;
        let x = pose.position.x + d_omega * theta_deg.to_radians().cos();
        let y = pose.position.y + d_omega * theta_deg.to_radians().sin();

        prop_assert!(offset_m(&placed, Point2::new(x, y)) <= 1e-9 * d_omega.max(1.0));
    }

    #[test]
    fn positions_and_covariances_follow_camera(
        pose in poses(), range_m in 0.2..3.0, bearing_rad in -0.4..0.4f64, turn_rad in -4.0..4.0f64, shift in -9.0..9.0f64,
    ) {
        let seen = detection(board(range_m, bearing_rad, 0.3));
        for ranging in [Ranging::Corners, Ranging::BoxHeight, Ranging::BoxWidth, Ranging::Paper] {
            let here = projection(ranging).place(&seen, Cut::default(), None, &pose).unwrap();
            let moved = Pose::new(pose.position.x + shift, pose.position.y - shift, pose.heading_rad + turn_rad);
            let there = projection(ranging).place(&seen, Cut::default(), None, &moved).unwrap();

            let turn = nalgebra::Rotation2::new(turn_rad);
            let offset = Vector2::new(here.x_m, here.y_m) - pose.position.coords;
            prop_assert!(offset_m(&there, moved.position + turn * offset) <= 1e-9);
            let turned = turn.matrix() * here.covariance().unwrap().matrix() * turn.matrix().transpose();
            prop_assert!((turned - there.covariance().unwrap().matrix()).norm() <= 1e-9);
        }
    }

    #[test]
    fn any_box_gives_error_or_position(
        edges in proptest::array::uniform4(prop_oneof![
            -1e3..1e3f64, Just(f64::NAN), Just(f64::INFINITY), Just(0.0), Just(1e-320), Just(1e300),
        ]),
    ) {
        let [x_min, y_min, x_max, y_max] = edges;
        let seen = detection(BoundingBox { x_min, y_min, x_max, y_max });
        for ranging in [Ranging::Corners, Ranging::BoxHeight, Ranging::BoxWidth, Ranging::Paper] {
            if let Ok(placed) = projection(ranging).place(&seen, Cut::default(), None, &Pose::new(0.0, 0.0, 1.0)) {
                let covariance = placed.covariance().unwrap();
                prop_assert!(placed.x_m.is_finite() && placed.y_m.is_finite());
                prop_assert!(covariance.is_valid() && covariance.xx > 0.0 && covariance.yy > 0.0);
            }
        }
    }
}

#[test]
fn yaw_stretches_width_range_only() {
    let seen = detection(board(0.5, 0.0, 60f64.to_radians()));
    let range = |ranging| {
        projection(ranging)
            .place(&seen, Cut::default(), None, &Pose::new(0.0, 0.0, 0.0))
            .unwrap()
            .x_m
    };
    assert!(
        (range(Ranging::BoxHeight) - 0.5).abs() < 0.03,
        "{}",
        range(Ranging::BoxHeight)
    );
    assert!(
        range(Ranging::BoxWidth) > 0.95,
        "{}",
        range(Ranging::BoxWidth)
    );
}

#[test]
fn paper_ranging_offset_is_half_view() {
    let placed = projection(Ranging::Paper).place(
        &detection(board(0.5, 0.0, 0.0)),
        Cut::default(),
        None,
        &Pose::new(0.0, 0.0, 0.0),
    );
    let placed = placed.unwrap();
    assert!((placed.y_m.atan2(placed.x_m) + 31.1f64.to_radians()).abs() < 1e-9);
}

#[test]
fn uncertainty_grows_with_distance() {
    let at = |range_m| {
        let placed = projection(Ranging::BoxHeight).place(
            &detection(board(range_m, 0.0, 0.0)),
            Cut::default(),
            None,
            &Pose::new(0.0, 0.0, 0.0),
        );
        placed.unwrap().covariance().unwrap()
    };
    assert!(
        at(2.0).xx > 4.0 * at(1.0).xx,
        "range error grows faster than the distance"
    );
    assert!(at(2.0).xx > at(2.0).yy);
    let exact = ProjectionConfig {
        pixel_sigma_px: 0.0,
        heading_sigma_rad: 0.0,
        position_sigma_m: 0.0,
        sizes: ObjectSizes {
            default: Some(ObjectSize {
                relative_sigma: 0.0,
                ..ObjectSize::square(SIDE_M)
            }),
            ..ObjectSizes::default()
        },
        ..ProjectionConfig::default()
    };
    let floor = exact.floor_m;
    let placed = Projection::new(exact, camera(), Mount::default()).place(
        &detection(board(1.0, 0.0, 0.0)),
        Cut::default(),
        None,
        &Pose::new(0.0, 0.0, 0.0),
    );
    assert!((placed.unwrap().covariance().unwrap().yy - floor * floor).abs() < 1e-12);
}

#[test]
fn unusable_detections_have_reasons() {
    let origin = Pose::new(0.0, 0.0, 0.0);
    let reason = |projection: &Projection, seen: &Detection, target: Option<Point3<f64>>| {
        projection
            .place(seen, projection.cut(seen), target.as_ref(), &origin)
            .expect_err("unusable")
            .as_str()
    };
    let whole = detection(board(0.5, 0.0, 0.0));
    let sizeless = Projection::new(ProjectionConfig::default(), camera(), Mount::default());
    assert_eq!(reason(&sizeless, &whole, None), "unknown_size");

    let flat = detection(BoundingBox {
        x_max: whole.bounding_box.x_min,
        ..whole.bounding_box
    });
    assert_eq!(
        reason(&projection(Ranging::BoxWidth), &flat, None),
        "degenerate_box"
    );

    let clipped = |ranging, seen: &Detection| {
        let projection = projection(ranging);
        let placed = projection.place(seen, projection.cut(seen), None, &origin);
        placed.is_err_and(|error| error.as_str() == "clipped")
    };
    let cut_below = detection(BoundingBox {
        y_max: 480.0,
        ..whole.bounding_box
    });
    assert!(clipped(Ranging::BoxHeight, &cut_below) && !clipped(Ranging::BoxWidth, &cut_below));
    let cut_left = detection(BoundingBox {
        x_min: 0.0,
        ..whole.bounding_box
    });
    assert!(clipped(Ranging::BoxWidth, &cut_left) && !clipped(Ranging::BoxHeight, &cut_left));
    let masked = |beyond: BoundingBox| {
        let BoundingBox {
            x_min,
            y_min,
            x_max,
            y_max,
        } = beyond;
        let corners = [
            [x_min, y_min],
            [x_max, y_min],
            [x_max, y_max],
            [x_min, y_max],
        ];
        let mask = Polygon::new(&corners.map(Point2::from)).unwrap();
        projection(Ranging::Auto).with_masks(vec![mask]).cut(&whole)
    };
    let bounds = whole.bounding_box;
    let below = BoundingBox {
        y_min: bounds.y_max,
        y_max: 480.0,
        x_min: bounds.x_min + 10.0,
        x_max: bounds.x_max - 10.0,
    };
    let lower = Cut {
        lower: true,
        ..Cut::default()
    };
    assert_eq!(masked(below), lower);
    let further = BoundingBox {
        y_min: bounds.y_max + 10.0,
        ..below
    };
    assert_eq!(masked(further), Cut::default());
    let inside = BoundingBox {
        x_min: bounds.x_min + 10.0,
        y_min: bounds.y_min + 10.0,
        x_max: bounds.x_min + 20.0,
        y_max: bounds.y_min + 20.0,
    };
    assert_eq!(masked(inside), Cut::default(), "all sides are visible");

    for target in [Point3::new(0.0, 0.0, -1.0), Point3::new(f64::NAN, 0.0, 1.0)] {
        assert_eq!(
            reason(&projection(Ranging::Corners), &whole, Some(target)),
            "invalid_corners"
        );
    }
}

#[test]
fn coco_labels_have_default_sizes() {
    let usual = ObjectSizes::default();
    let person = usual.of("person").unwrap();
    assert!(
        (1.5..1.9).contains(&person.height_m) && person.relative_sigma > 0.05,
        "{person:?}"
    );
    assert_eq!(usual.of("QR1"), None);
    let own = ObjectSizes {
        default: Some(ObjectSize::square(SIDE_M)),
        ..ObjectSizes::default()
    };
    assert_eq!(own.of("person"), Some(&ObjectSize::square(SIDE_M)));
}

#[test]
fn listed_sizes_override_checked_default() {
    let text = r#"{"default": {"width_m": 0.05, "height_m": 0.05}, "labels": {"cup": {"width_m": 0.08, "height_m": 0.1}}}"#;
    let mut sizes: ObjectSizes = serde_json::from_str(text).unwrap();
    assert_eq!(sizes.of("cup").map(|s| s.height_m), Some(0.1));
    assert_eq!(sizes.of("ABCD123").map(|s| s.height_m), Some(0.05));
    sizes.labels.get_mut("cup").unwrap().height_m = 0.0;
    let config = ProjectionConfig {
        sizes,
        ..ProjectionConfig::default()
    };
    assert_eq!(
        config.validate().expect_err("zero height").key,
        "sizes.labels.cup.height_m"
    );
}
