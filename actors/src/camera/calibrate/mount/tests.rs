use super::*;

fn camera() -> Intrinsics {
    Intrinsics::from_field_of_view(1280, 720, 70f64.to_radians(), 43f64.to_radians())
}

fn mount(height_m: f64, pitch_deg: f64, roll_deg: f64) -> Mount {
    let pitch_rad = pitch_deg.to_radians();
    let roll_rad = roll_deg.to_radians();
    Mount {
        height_m: Some(height_m),
        pitch_rad,
        roll_rad,
        ..Mount::default()
    }
}

/// Points on the ground, with pixels `off_px` from their true pixels in a camera.
fn seen(
    places: &[(f64, f64)],
    off_px: &[(f64, f64)],
    pose: &Pose,
    mount: &Mount,
) -> Vec<GroundPoint> {
    let posed = PosedCamera::new(*pose, mount, camera());
    let point = |(&(x_m, y_m), &(right_px, down_px)): (&(f64, f64), &(f64, f64))| {
        let place = Point2::new(x_m, y_m);
        let pixel = posed.pixel(&place).unwrap();
        assert!(
            (0.0..1280.0).contains(&pixel.x) && (0.0..720.0).contains(&pixel.y),
            "{pixel} is outside"
        );
        GroundPoint {
            pixel: Point2::new(pixel.x + right_px, pixel.y + down_px),
            place,
        }
    };
    places.iter().zip(off_px).map(point).collect()
}

const PLACES: [(f64, f64); 7] = [
    (5.0, 0.3),
    (6.0, -1.5),
    (7.5, 2.0),
    (8.5, -2.0),
    (9.0, 1.0),
    (12.0, 4.0),
    (14.0, -3.0),
];
const EXACT: [(f64, f64); 7] = [(0.0, 0.0); 7];

#[track_caller]
fn is_near(fit: &GroundFit, pose: &Pose, real: &Mount, tilt_deg: f64, metres: f64) {
    let found = &fit.estimate.mount;
    let off = (fit.pose.position - pose.position)
        .norm()
        .max((found.height_m.unwrap() - real.height_m.unwrap()).abs());
    let turns = [
        found.pitch_rad - real.pitch_rad,
        found.roll_rad - real.roll_rad,
        fit.pose.heading_rad - pose.heading_rad,
    ];
    let turn_deg = turns
        .into_iter()
        .map(|turn| turn.to_degrees().abs())
        .fold(0.0, f64::max);
    assert!(
        off < metres && turn_deg < tilt_deg,
        "{off:.3} m, {turn_deg:.2}°: {fit:?}"
    );
}

#[test]
fn four_points_recover_any_mount() {
    for (height_m, pitch_deg, roll_deg, heading) in [
        (1.2, 5.0, 0.0, 0.0),
        (2.5, 12.0, -4.0, 0.1),
        (6.0, 30.0, 6.0, -0.1),
        (1.0, -3.0, 2.0, 0.05),
    ] {
        let pose = Pose::new(0.4, -0.2, heading);
        let real = mount(height_m, pitch_deg, roll_deg);
        let fit = fit_ground_points(&seen(&PLACES[2..6], &EXACT, &pose, &real), &camera()).unwrap();
        is_near(&fit, &pose, &real, 0.01, 0.01);
    }
}

#[test]
fn wrong_point_is_named() {
    let pose = Pose::new(0.4, -0.2, 0.1);
    let real = mount(2.5, 12.0, -4.0);
    let mut off_px = [
        (1.0, -0.5),
        (-0.7, 0.4),
        (0.3, 0.9),
        (-1.1, -0.2),
        (0.4, 0.6),
        (-0.5, 0.2),
        (0.8, -0.9),
    ];
    off_px[3] = (60.0, 25.0);
    let fit = fit_ground_points(&seen(&PLACES, &off_px, &pose, &real), &camera()).unwrap();
    is_near(&fit, &pose, &real, 0.8, 0.3);
    let outliers: Vec<_> = fit.points.iter().map(|point| point.is_outlier).collect();
    assert_eq!(outliers, [false, false, false, true, false, false, false]);
    assert!(
        fit.points[3].error_px > 50.0 && fit.points[3].error_m.unwrap() > 0.4,
        "{:?}",
        fit.points[3]
    );
    assert!(
        fit.points
            .iter()
            .enumerate()
            .all(|(index, point)| index == 3 || point.error_px < 2.0),
        "{fit:?}"
    );
    let MountEstimate {
        mount: found,
        pitch_sigma_rad,
        height_sigma_m,
        ..
    } = fit.estimate;
    assert!(
        (found.pitch_rad - real.pitch_rad).abs() < 3.0 * pitch_sigma_rad,
        "{fit:?}"
    );
    assert!(
        (found.height_m.unwrap() - 2.5).abs() < 3.0 * height_sigma_m,
        "{fit:?}"
    );
}

#[test]
fn unsolvable_input_names_remedy() {
    let pose = Pose::new(0.0, 0.0, 0.0);
    let real = mount(2.5, 12.0, 0.0);
    let points = seen(&PLACES, &EXACT, &pose, &real);
    let error = |points: &[GroundPoint]| {
        fit_ground_points(points, &camera())
            .unwrap_err()
            .to_string()
    };
    assert!(
        error(&points[..3]).contains("3 points, need 4"),
        "{}",
        error(&points[..3])
    );
    let mirrored: Vec<_> = points
        .iter()
        .map(|p| GroundPoint {
            place: Point2::new(p.place.x, -p.place.y),
            ..*p
        })
        .collect();
    assert!(error(&mirrored).contains("left"), "{}", error(&mirrored));
    let line: Vec<_> = seen(
        &[(5.0, 0.0), (6.0, 0.0), (9.0, 0.0), (14.0, 0.0)],
        &EXACT,
        &pose,
        &real,
    );
    let message = error(&line);
    assert!(
        message.contains("not on one line") || message.contains("no camera"),
        "{message}"
    );
}
