//! Fast roads, and moving frames.

use super::*;

/// Two vehicles with a pose each, one behind the other at 27 m/s, between cars in the same direction and oncoming cars.
/// The clock of the second vehicle is 30 ms ahead. Returns the mean error of the cars in the last round.
fn highway(stamped_late_us: u64) -> Vector2<f64> {
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    let mut tracker = tracker();
    let mut off = Vec::new();
    let lanes = [
        (27.0, -2.0, 0.0),
        (31.0, -6.0, 7.0),
        (-26.0, 2.0, 11.0),
        (-30.0, 6.0, 3.0),
    ];
    for frame in 0..250 {
        let t_s = frame as f64 * 0.1;
        for (n, node) in ["euclid", "gauss"].into_iter().enumerate() {
            let x_m = 27.0 * t_s - 30.0 * n as f64;
            let mut objects = Vec::new();
            for (speed_mps, y_m, first_m) in lanes {
                let from = ((x_m - 60.0 - first_m - speed_mps * t_s) / 25.0).ceil() as i64;
                let cars =
                    (from..from + 5).map(|car| first_m + 25.0 * car as f64 + speed_mps * t_s);
                objects.extend(cars.filter(|car_m| (car_m - x_m).abs() > 4.0).map(|x_m| {
                    let x_m = x_m + noise(&mut rng, 0.2);
                    let y_m = y_m + noise(&mut rng, 0.2);
                    car(x_m, y_m)
                }));
            }
            let captured = at(frame) + std::time::Duration::from_micros(n as u64 * stamped_late_us);
            let pose = Some(WirePose::new(x_m, -2.0, 0.0));
            tracker.observe(
                ObjectReport {
                    pose,
                    ..report(node, frame, objects)
                },
                captured,
            );
        }
        let round = tracker.close(at(frame));
        if frame == 249 {
            for object in sure(&round)
                .iter()
                .filter(|object| object.vehicle.is_none())
            {
                let nearest = lanes.into_iter().map(|(speed_mps, y_m, first_m)| {
                    let along = (object.x_m - first_m - speed_mps * t_s).rem_euclid(25.0);
                    Vector2::new(
                        if along > 12.5 { along - 25.0 } else { along },
                        object.y_m - y_m,
                    )
                });
                off.extend(nearest.min_by(|a, b| a.norm().total_cmp(&b.norm())));
            }
        }
    }
    assert!(off.len() >= 15, "{}", off.len());
    off.iter().sum::<Vector2<f64>>() / off.len() as f64
}

#[test]
fn pose_correction_shifts_no_map() {
    for late_us in [0, 30_000] {
        let off = highway(late_us);
        assert!(
            off.norm() < 0.4,
            "off by {off:?} with stamps {late_us} µs late"
        );
    }
}

#[test]
fn oncoming_object_has_one_velocity() {
    let mut tracker = tracker();
    let mut round = TracksRound::default();
    for frame in 0..10 {
        let objects = vec![
            car(100.0 - 6.0 * frame as f64, 3.0),
            car(50.0 - 3.0 * frame as f64, -3.0),
        ];
        tracker.observe(report("euclid", frame, objects), at(frame));
        round = tracker.close(at(frame));
    }
    let cars = sure(&round);
    let speeds: Vec<_> = cars
        .iter()
        .map(|car| car.velocity_mps.unwrap()[0].round())
        .collect();
    assert_eq!(speeds, [-60.0, -30.0], "{cars:?}");
}

#[test]
fn established_car_survives_short_gap() {
    let mut tracker = tracker();
    two_cars(&mut tracker, 0..30, |_| true);
    for (after, least) in [(30, 0.9), (31, 0.85), (34, 0.7)] {
        let round = tracker.clone().close(at(after));
        assert!(
            round
                .objects
                .iter()
                .all(|object| object.existence.unwrap() > least),
            "{after} {:?}",
            round.objects
        );
    }
}

#[test]
fn distant_glimpse_widens_no_view() {
    let mut coverage = Coverage::default();
    let mut objects: Vec<_> = (0..20).map(|n| car(f64::from(n), 0.0)).collect();
    assert!(!coverage.observe(&report("euclid", 0, objects.clone())));
    objects.push(car(1e6, 0.0));
    assert!(
        !coverage.observe(&report("euclid", 1, objects)),
        "the vehicle is where it was"
    );
    assert!(coverage.range_m() < 30.0, "{}", coverage.range_m());
    let stated = ObjectReport {
        view: Some(FieldOfView {
            range_m: 100.0,
            angle_rad: 1.0,
        }),
        ..report(
            "euclid",
            2,
            (0..20).map(|n| car(f64::from(n), 0.0)).collect(),
        )
    };
    coverage.observe(&stated);
    assert!(
        coverage.range_m() < 30.0,
        "a view without a pose has no position"
    );
}

/// Mean error of the map in the frame of a vehicle that drives at 8 m/s and turns, among parked cars 20 m apart and
/// moving cars; another vehicle reports in the same frame.
fn error_in_a_frame_that_turns(yaw_rate_radps: f64) -> f64 {
    let mut rng = ChaCha8Rng::seed_from_u64(8);
    let mut tracker = tracker();
    let mut place = Vector2::new(3.0, 5.0);
    let mut errors = Vec::new();
    for frame in 0..150 {
        let t_s = frame as f64 * 0.1;
        let heading = nalgebra::Rotation2::new(yaw_rate_radps * t_s);
        let lattice = (0..441)
            .map(|n| Vector2::new(f64::from(n / 21 - 10) * 20.0, f64::from(n % 21 - 10) * 20.0));
        let driving = lattice
            .clone()
            .step_by(5)
            .map(|at| at + Vector2::new(6.0 * t_s, 10.0));
        let seen = lattice
            .chain(driving)
            .map(|at| heading.inverse() * (at - place));
        let seen: Vec<Vector2<f64>> = seen
            .filter(|at| at.norm() < 45.0 && at.norm() > 3.0)
            .collect();
        for node in ["euclid", "gauss"] {
            let object =
                |at: &Vector2<f64>| car(at.x + noise(&mut rng, 0.3), at.y + noise(&mut rng, 0.3));
            let objects = seen.iter().map(object).collect();
            let frame_yaw_rate_radps = (yaw_rate_radps != 0.0).then_some(yaw_rate_radps);
            tracker.observe(
                ObjectReport {
                    frame_yaw_rate_radps,
                    ..report(node, frame, objects)
                },
                at(frame),
            );
        }
        let round = tracker.close(at(frame));
        for object in sure(&round).into_iter().filter(|_| frame > 50) {
            let error = |at: &Vector2<f64>| (at.x - object.x_m).hypot(at.y - object.y_m);
            errors.extend(
                seen.iter()
                    .map(error)
                    .min_by(f64::total_cmp)
                    .filter(|error| *error < 4.0),
            );
        }
        place += nalgebra::Rotation2::new(yaw_rate_radps * (t_s + 0.05)) * Vector2::new(0.8, 0.0);
    }
    assert!(errors.len() > 1000, "{}", errors.len());
    errors.iter().sum::<f64>() / errors.len() as f64
}

#[test]
fn frame_may_rotate_with_vehicle() {
    let straight_m = error_in_a_frame_that_turns(0.0);
    for yaw_rate_radps in [0.15, -0.3, 0.6] {
        let error_m = error_in_a_frame_that_turns(yaw_rate_radps);
        assert!(
            error_m < straight_m + 0.11,
            "{error_m} m at {yaw_rate_radps} rad/s, {straight_m} m straight on"
        );
    }
}

#[test]
fn frequent_reporter_rotates_no_frame() {
    let mut tracker = tracker();
    let mut round = TracksRound::default();
    for frame in 0..30 {
        let reports = [
            ("euclid", None),
            ("gauss", None),
            ("liar", Some(2.0)),
            ("liar", Some(2.1)),
            ("liar", Some(2.2)),
        ];
        // The other vehicles report at a third of the rate.
        for (node, frame_yaw_rate_radps) in
            reports.into_iter().skip(if frame % 3 == 0 { 0 } else { 2 })
        {
            let objects = vec![car(0.0, 40.0), car(30.0, 0.0)];
            tracker.observe(
                ObjectReport {
                    frame_yaw_rate_radps,
                    ..report(node, frame, objects)
                },
                at(frame),
            );
        }
        round = tracker.close(at(frame));
    }
    let cars = sure(&round);
    assert!(
        cars.len() == 2 && near(cars[0], 0.0, 40.0, 0.1) && near(cars[1], 30.0, 0.0, 0.1),
        "{cars:?}"
    );
}
