//! The mount of a camera from people in rendered pictures of the street.

use ecod::model::detection::BoundingBox;
use ecod::model::names::NodeName;
use ecod::perception::projection::{MountEstimate, ObjectSize, ObjectSizes, fit_mount};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;

use super::*;
use crate::street::StreetBody;

/// Height in metres of all people of the street, with the placard.
const PERSON_M: f64 = 1.88;
const SECONDS: u32 = 60;
const FRAMES_PER_SECOND: u32 = 2;
/// Smallest box in pixels.
const MIN_BOX_PX: f64 = 25.0;

/// The street without the parked car at whose place a camera stands.
fn street() -> Street {
    let mut street = Street::default();
    street.bodies.remove(2);
    street.cameras.clear();
    street
}

fn optics() -> Intrinsics {
    Intrinsics::with_square_pixels(640, 480, 80f64.to_radians())
}

fn camera(
    [x_m, y_m, heading_deg]: [f64; 3],
    [height_m, pitch_deg, roll_deg]: [f64; 3],
) -> StreetCamera {
    let pitch_rad = pitch_deg.to_radians();
    let roll_rad = roll_deg.to_radians();
    StreetCamera {
        name: NodeName::from_static("camera"),
        carrier: Carrier::Mast(Pose::new(x_m, y_m, heading_deg.to_radians())),
        mount: Mount {
            height_m: Some(height_m),
            pitch_rad,
            roll_rad,
            ..Mount::default()
        },
    }
}

/// Boxes of a minute, around the pixels that change with one body alone. Bodies that are hidden,
/// even in part, or cut by the image's edge are left out.
fn minute(street: &Street, camera: &StreetCamera, bodies: &[StreetBody]) -> Vec<Vec<BoundingBox>> {
    let view = StreetView {
        optics: optics(),
        ..StreetView::new(street).unwrap()
    };
    let only = |bodies| Street {
        bodies,
        cameras: Vec::new(),
    };
    let bare = view.render(&only(Vec::new()), camera, 0.0).unwrap();
    let sight = StreetSight::new(street.pose(camera, 0.0), &camera.mount);
    let frame = |frame: u32| {
        let at_s = f64::from(frame) / f64::from(FRAMES_PER_SECOND);
        let full = view.render(street, camera, at_s).unwrap();
        let seen = bodies.iter().filter_map(|body| {
            let foot = optics().project(&sight.point(&body.route.at(at_s).position, 0.0))?;
            (0.0..640.0).contains(&foot.x).then_some(())?;
            let alone = view
                .render(&only(vec![body.clone()]), camera, at_s)
                .unwrap();
            whole_box(&alone, &bare, &full)
        });
        seen.collect()
    };
    (0..SECONDS * FRAMES_PER_SECOND).map(frame).collect()
}

/// The box as a detector finds it: edges are off by 1.5 px and 2 % of the height.
fn noisy(bounds: &BoundingBox, dice: &mut ChaCha8Rng) -> BoundingBox {
    let sigma_px = 1.5 + 0.02 * bounds.height();
    let [x_min, y_min, x_max, y_max] = [bounds.x_min, bounds.y_min, bounds.x_max, bounds.y_max]
        .map(|edge| edge + sigma_px * dice.sample::<f64, _>(StandardNormal));
    BoundingBox {
        x_min,
        y_min,
        x_max,
        y_max,
    }
}

/// The box of the pixels in which `alone` differs from `bare`. `None` if `full` hides some of them,
/// or a pixel is at the edge.
fn whole_box(alone: &Mat, bare: &Mat, full: &Mat) -> Option<BoundingBox> {
    let [alone_px, bare_px, full_px] =
        [alone, bare, full].map(|image| image.data_bytes().unwrap().chunks_exact(3));
    let mut pixels = Vec::new();
    for (number, ((alone_px, bare_px), full_px)) in alone_px.zip(bare_px).zip(full_px).enumerate() {
        if alone_px != bare_px {
            if alone_px != full_px {
                return None;
            }
            let row = number / alone.cols() as usize;
            let column = number % alone.cols() as usize;
            pixels.push(Point2::new(column as f64, row as f64));
        }
    }
    let bounds = BoundingBox::around(&pixels);
    let width = f64::from(alone.cols());
    let height = f64::from(alone.rows());
    let x_max = bounds.x_max + 1.0;
    let y_max = bounds.y_max + 1.0;
    let is_whole = bounds.x_min > 0.0 && bounds.y_min > 0.0 && x_max < width && y_max < height;
    (is_whole && bounds.height() >= MIN_BOX_PX).then_some(BoundingBox {
        x_max,
        y_max,
        ..bounds
    })
}

/// Places and mounts of cameras: masts, and cars that are parked.
const CAMERAS: [([f64; 3], [f64; 3]); 6] = [
    ([-7.0, -8.2, 34.0], [4.5, 14.0, 0.0]),
    ([5.0, 4.9, 180.0], [1.6, 0.0, 0.0]),
    ([-6.0, -6.4, 0.0], [1.2, 3.0, 2.0]),
    ([12.0, -8.0, 150.0], [2.5, 8.0, -3.0]),
    ([-9.0, 8.5, -10.0], [3.5, 12.0, 4.0]),
    ([15.0, -8.5, 95.0], [6.0, 25.0, -5.0]),
];

#[test]
fn people_give_pitch_and_height() {
    let street = street();
    let of_people = |body: &&StreetBody| body.label.as_deref() == Some("person");
    let people: Vec<_> = street.bodies.iter().filter(of_people).cloned().collect();
    let sizes = ObjectSizes::default();
    let size = ObjectSize {
        height_m: PERSON_M,
        relative_sigma: 0.02,
        ..*sizes.of("person").unwrap()
    };
    let mut failures = Vec::new();
    for (place, [height_m, pitch_deg, roll_deg]) in CAMERAS {
        let frames = minute(
            &street,
            &camera(place, [height_m, pitch_deg, roll_deg]),
            &people,
        );
        let boxes: usize = frames.iter().map(Vec::len).sum();
        for seed in 0..3 {
            let mut dice = ChaCha8Rng::seed_from_u64(seed);
            let frames: Vec<Vec<_>> = frames
                .iter()
                .map(|frame| {
                    frame
                        .iter()
                        .map(|bounds| noisy(bounds, &mut dice))
                        .collect()
                })
                .collect();
            let case = format!("{height_m} m, {pitch_deg}°, {roll_deg}°, {boxes} boxes");
            let found = fit_mount(&frames, &size, 3.0, &optics(), &Mount::default());
            let MountEstimate { mount, .. } =
                found.unwrap_or_else(|error| panic!("{case}: {error}"));
            let pitch_off_deg = mount.pitch_rad.to_degrees() - pitch_deg;
            let height_off = mount.height_m.unwrap() / height_m - 1.0;
            let case = format!(
                "{case}: pitch {pitch_off_deg:+.2}°, height {:+.1} %",
                100.0 * height_off
            );
            println!("{case}");
            if pitch_off_deg.abs() > 1.0 || height_off.abs() > 0.08 {
                failures.push(case);
            }
        }
    }
    assert!(failures.is_empty(), "{failures:#?}");
}
