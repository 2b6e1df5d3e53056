//! A minute of people walking in front of cameras of any height and tilt, with boxes as from a
//! detector.

use std::f64::consts::TAU;

use nalgebra::{Point2, Point3, Rotation2, Vector2};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;
use crate::perception::projection::ObjectSizes;

fn camera() -> Intrinsics {
    Intrinsics::from_field_of_view(1280, 720, 70f64.to_radians(), 43f64.to_radians())
}

fn mounted(height_m: f64, pitch_deg: f64, roll_deg: f64) -> Mount {
    let pitch_rad = pitch_deg.to_radians();
    let roll_rad = roll_deg.to_radians();
    Mount {
        height_m: Some(height_m),
        pitch_rad,
        roll_rad,
        forward_m: 0.5,
        ..Mount::default()
    }
}

struct Dice(ChaCha8Rng);

impl Dice {
    fn between(&mut self, low: f64, high: f64) -> f64 {
        self.0.random_range(low..high)
    }

    fn normal(&mut self, mean: f64, sigma: f64) -> f64 {
        let u: f64 = self.0.random();
        let v: f64 = self.0.random();
        mean + sigma * (-2.0 * (1.0 - u).ln()).sqrt() * (TAU * v).cos()
    }

    /// A body height in metres with shoes: women and men in equal parts, and a child in twenty
    /// (NCD-RisC, Lancet 2020).
    fn body_height(&mut self) -> f64 {
        match self.between(0.0, 1.0) {
            share if share < 0.05 => self.normal(1.25, 0.12),
            share if share < 0.52 => self.normal(1.64, 0.065),
            _ => self.normal(1.77, 0.07),
        }
    }
}

/// Points on a walking body: head, shoulders, and feet a step apart.
fn body(height_m: f64, at: Point2<f64>, heading_rad: f64, step_m: f64) -> Vec<Point3<f64>> {
    let turn = Rotation2::new(heading_rad);
    let point = |ahead_m: f64, aside_m: f64, up_m: f64| {
        let on_ground = at + turn * Vector2::new(ahead_m, aside_m);
        Point3::new(on_ground.x, on_ground.y, up_m)
    };
    let around = (0..12)
        .map(|n| f64::from(n) / 12.0 * TAU)
        .flat_map(|angle| {
            let (sin, cos) = angle.sin_cos();
            let head = [-0.5f64, 0.0, 0.5].map(|tilt| {
                point(
                    0.1 * cos * tilt.cos(),
                    0.08 * sin * tilt.cos(),
                    height_m - 0.12 + 0.12 * tilt.sin(),
                )
            });
            head.into_iter()
                .chain([point(0.12 * cos, 0.23 * sin, 0.82 * height_m)])
        });
    let foot = |ahead_m: f64, aside_m: f64| {
        [
            point(ahead_m - 0.08, aside_m, 0.0),
            point(ahead_m + 0.18, aside_m, 0.0),
        ]
    };
    let feet = [foot(step_m / 2.0, 0.1), foot(-step_m / 2.0, -0.1)];
    around
        .chain(feet.into_iter().flatten())
        .chain([point(0.0, 0.0, height_m)])
        .collect()
}

/// Boxes of a minute, five frames a second: people cross the place before the camera, one every
/// three seconds. A detector's edges are off by 1.5 px and 2 % of the height. Of every tenth box
/// the legs are hidden.
fn minute(mount: &Mount, reach_m: f64, seed: u64) -> Vec<Vec<BoundingBox>> {
    let mut dice = Dice(ChaCha8Rng::seed_from_u64(seed));
    let to_camera = mount.to_level().transpose();
    let mut frames = vec![Vec::new(); 300];
    for person in 0..15 {
        let height_m = dice.body_height();
        let heading_rad = dice.between(0.0, TAU);
        let middle = Point2::new(
            dice.between(0.25, 0.8) * reach_m,
            dice.between(-0.3, 0.3) * reach_m,
        );
        for frame in 0..60 {
            let ahead_m = f64::from(frame - 30) * 0.26;
            let step_m = 0.7 * f64::sin(f64::from(frame) * 1.3).abs();
            let at = middle + Rotation2::new(heading_rad) * Vector2::new(ahead_m, 0.0);
            let to_pixel = |point: Point3<f64>| {
                camera().project(&Point3::from(
                    to_camera * (point.coords - Vector3::z() * mount.height_m?),
                ))
            };
            let pixels: Option<Vec<_>> = body(height_m, at, heading_rad, step_m)
                .into_iter()
                .map(to_pixel)
                .collect();
            let Some(mut bounds) = pixels.map(|pixels| BoundingBox::around(&pixels)) else {
                continue;
            };
            let sigma_px = 1.5 + 0.02 * bounds.height();
            if dice.between(0.0, 1.0) < 0.1 {
                bounds.y_max -= dice.between(0.2, 0.5) * bounds.height();
            }
            for edge in [
                &mut bounds.x_min,
                &mut bounds.y_min,
                &mut bounds.x_max,
                &mut bounds.y_max,
            ] {
                *edge = dice.normal(*edge, sigma_px);
            }
            let is_whole = bounds.x_min > 2.0
                && bounds.y_min > 2.0
                && bounds.x_max < 1278.0
                && bounds.y_max < 718.0;
            if is_whole && bounds.height() > 30.0 {
                frames[(person * 16 + frame as usize) % 300].push(bounds);
            }
        }
    }
    frames
}

#[test]
fn walking_people_give_pitch_and_height() {
    let mut failures = Vec::new();
    for (height_m, pitch_deg, roll_deg, reach_m) in [
        (1.2, 0.0, 0.0, 15.0),
        (1.5, 4.0, -3.0, 18.0),
        (2.5, 10.0, 2.0, 18.0),
        (3.5, 20.0, 6.0, 14.0),
        (4.0, 15.0, -8.0, 20.0),
        (6.0, 25.0, 0.0, 20.0),
        (6.0, 45.0, 3.0, 10.0),
    ] {
        let real = mounted(height_m, pitch_deg, roll_deg);
        for seed in 0..4 {
            let frames = minute(&real, reach_m, seed);
            let boxes: usize = frames.iter().map(Vec::len).sum();
            let size = ObjectSizes::default();
            let found = fit_mount(
                &frames,
                size.of("person").unwrap(),
                3.0,
                &camera(),
                &Mount {
                    forward_m: 0.5,
                    ..Mount::default()
                },
            );
            let Ok(MountEstimate {
                mount,
                pitch_sigma_rad,
                roll_sigma_rad,
                height_sigma_m,
            }) = found
            else {
                failures.push(format!("{real:?}: {found:?}"));
                continue;
            };
            let pitch_off_deg = (mount.pitch_rad - real.pitch_rad).to_degrees();
            let roll_off_deg = (mount.roll_rad - real.roll_rad).to_degrees();
            let height_off = mount.height_m.unwrap() / height_m - 1.0;
            println!(
                "{height_m} m, {pitch_deg}°, {roll_deg}°, {boxes} boxes: pitch {pitch_off_deg:+.2}° ± {:.2}°, roll {roll_off_deg:+.2}° \
                 ± {:.2}°, height {:+.1} % ± {:.1} %",
                pitch_sigma_rad.to_degrees(),
                roll_sigma_rad.to_degrees(),
                100.0 * height_off,
                100.0 * height_sigma_m / height_m
            );
            assert_eq!(mount.forward_m, 0.5);
            if pitch_off_deg.abs() > 1.0 || roll_off_deg.abs() > 1.5 || height_off.abs() > 0.08 {
                failures.push(format!("{real:?}: {mount:?}"));
            }
        }
    }
    assert!(failures.is_empty(), "{failures:#?}");
}

#[test]
fn equal_distances_give_no_pitch() {
    let mut dice = Dice(ChaCha8Rng::seed_from_u64(3));
    let standing = |dice: &mut Dice| {
        let [x_min, y_min, x_max, y_max] =
            [600.0, 300.0, 650.0, 460.0].map(|edge| dice.normal(edge, 3.0));
        vec![BoundingBox {
            x_min,
            y_min,
            x_max,
            y_max,
        }]
    };
    let mut frames: Vec<_> = (0..60).map(|_| standing(&mut dice)).collect();
    let fit = |frames: &[Vec<BoundingBox>]| {
        let size = ObjectSizes::default();
        fit_mount(
            frames,
            size.of("person").unwrap(),
            3.0,
            &camera(),
            &Mount::default(),
        )
    };
    let open = fit(&frames);
    assert!(
        matches!(open, Err(MountFitError::OneDistance(ratio)) if ratio > 1.0),
        "{open:?}"
    );
    frames.truncate(30);
    assert_eq!(fit(&frames), Err(MountFitError::TooFewBoxes(30)));
}
