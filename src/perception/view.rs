//! The landmarks in view of a camera: near enough to be read, inside the image, not turned away,
//! not hidden, not masked. If the camera's height is configured, image rows are checked by the
//! ground; otherwise only columns are checked.
//!
//! A report lists these landmarks as `seen`, so that a landmark in view without a detection counts
//! as empty. A false claim does more harm than a missing one, so a landmark must meet every
//! condition.

use nalgebra::{Matrix3, Point2, Point3, Vector2};

use crate::config::{check_optional, config_section};
use crate::model::detection::BoundingBox;
use crate::model::geometry::{Pose, wrap_angle};
use crate::model::names::LandmarkId;
use crate::perception::camera::{Intrinsics, Mount};
use crate::perception::landmark::Landmark;
use crate::perception::polygon::Polygon;
use crate::perception::projection::ObjectSizes;
use crate::wire::PerceivedObject;

config_section! {
    /// Conditions for a location to be in view.
    pub struct ViewConfig {
        /// Width in metres of the target to recognise at a location. Default: the smallest
        /// configured size, or 0.05.
        pub target_width_m: Option<f64> = None, checked by check_optional(1e-4, 1e3);
        /// Minimum width in pixels of the target at its actual angle; default 36: a placard code of
        /// 21 modules at 1.7 pixels each. A lower value claims more locations, some of which the
        /// detector cannot read.
        pub min_target_px: f64 = 36.0, in 0.0 to 1e5;
        /// Minimum distance in pixels of the target from the left and right edges of the image;
        /// default 8.
        pub margin_px: f64 = 8.0, in 0.0 to 1e5;
        /// Maximum distance of a location in metres; default 20.
        pub max_range_m: f64 = 20.0, in 1e-3 to 1e6;
        /// Maximum angle in radians between the facing of the location and the direction to the
        /// camera; default 0.87 (50°).
        pub max_yaw_rad: f64 = 0.87, in 0.0 to std::f64::consts::PI;
        /// Width in metres of an occluding object whose label has no listed size; default the
        /// target's, at least 0.07.
        pub occluder_width_m: Option<f64> = None, checked by check_optional(0.0, 1e3);
        /// Distance in metres by which an object must be nearer than a location to hide it; default
        /// 0.05. It must exceed the error of a position, or an object hides its own location.
        pub clearance_m: f64 = 0.05, in 0.0 to 1e3;
    }
}

/// Widths of target and occluder of placards, used without configured sizes.
const PLACARD_TARGET_M: f64 = 0.05;
const PLACARD_OCCLUDER_M: f64 = 0.07;

/// Settings with the defaults that rest on sizes.
struct Widths<'a> {
    config: &'a ViewConfig,
    sizes: &'a ObjectSizes,
    target_m: f64,
    unlisted_m: f64,
}

impl<'a> Widths<'a> {
    fn new(config: &'a ViewConfig, sizes: &'a ObjectSizes) -> Self {
        let listed = sizes
            .labels
            .values()
            .chain(&sizes.default)
            .map(|size| size.width_m);
        let target_m = config
            .target_width_m
            .or(listed.reduce(f64::min))
            .unwrap_or(PLACARD_TARGET_M);
        let unlisted_m = config
            .occluder_width_m
            .unwrap_or(target_m.max(PLACARD_OCCLUDER_M));
        Self {
            config,
            sizes,
            target_m,
            unlisted_m,
        }
    }
}

/// A camera where it stands.
#[derive(Debug, Clone, Copy)]
pub struct PosedCamera<'a> {
    pose: Pose,
    intrinsics: Intrinsics,
    from_level: Matrix3<f64>,
    height_m: Option<f64>,
    masks: &'a [Polygon],
}

impl<'a> PosedCamera<'a> {
    /// The camera of a vehicle, with the pose of the camera itself.
    pub fn new(pose: Pose, mount: &Mount, intrinsics: Intrinsics) -> Self {
        Self {
            pose,
            intrinsics,
            from_level: mount.to_level().transpose(),
            height_m: mount.height_m,
            masks: &[],
        }
    }

    /// The camera with these parts of its image masked, in pixels without distortion.
    #[must_use]
    pub fn with_masks(self, masks: &'a [Polygon]) -> Self {
        Self { masks, ..self }
    }

    /// The pixel of a point on the ground or, if the camera's height is not configured, at the
    /// camera's height; `None` behind the camera.
    pub fn pixel(&self, point: &Point2<f64>) -> Option<Point2<f64>> {
        let level = self
            .pose
            .ahead_left(point)
            .push(-self.height_m.unwrap_or(0.0));
        self.intrinsics
            .project(&Point3::from(self.from_level * level))
    }
}

/// The landmarks in view of `camera`, in their order. The perceived `objects` hide landmarks behind
/// them, with the widths in `sizes` for listed labels.
pub fn landmarks_in_view(
    landmarks: &[Landmark],
    camera: &PosedCamera,
    objects: &[PerceivedObject],
    sizes: &ObjectSizes,
    config: &ViewConfig,
) -> Vec<LandmarkId> {
    let widths = Widths::new(config, sizes);
    let occluder = |object: &PerceivedObject| {
        let landmark = object
            .landmark
            .as_ref()
            .and_then(|id| landmarks.iter().find(|landmark| landmark.id == *id));
        Occluder::new(
            object,
            landmark.and_then(|landmark| landmark.facing_rad),
            &camera.pose,
            &widths,
        )
    };
    let occluders: Vec<Occluder> = objects.iter().map(occluder).collect();
    let in_view = |landmark: &&Landmark| {
        let (range_m, bearing_rad) = camera.pose.range_bearing(&landmark.position);
        range_m <= config.max_range_m
            && is_readable(landmark, camera, &widths)
            && !occluders.iter().any(|occluder| {
                occluder.hides(
                    range_m,
                    bearing_rad,
                    visible_width_share(landmark.facing_rad, &camera.pose, &landmark.position),
                    &widths,
                )
            })
    };
    landmarks
        .iter()
        .filter(in_view)
        .map(|landmark| landmark.id.clone())
        .collect()
}

/// True if a target that faces as the landmark does is inside the image and large enough.
fn is_readable(landmark: &Landmark, camera: &PosedCamera, widths: &Widths) -> bool {
    let config = widths.config;
    let to_camera = camera.pose.position - landmark.position;
    let towards_camera_rad = to_camera.y.atan2(to_camera.x);
    let facing_rad = landmark.facing_rad.unwrap_or(towards_camera_rad);
    if wrap_angle(towards_camera_rad - facing_rad).abs() > config.max_yaw_rad {
        return false;
    }
    // The left end as seen from the side that the target faces.
    let half_width = Vector2::new(facing_rad.sin(), -facing_rad.cos()) * (widths.target_m / 2.0);
    let ends = [
        landmark.position + half_width,
        landmark.position - half_width,
    ]
    .map(|end| camera.pixel(&end));
    let [Some(left), Some(right)] = ends else {
        return false;
    };
    let width = f64::from(camera.intrinsics.width);
    let height = f64::from(camera.intrinsics.height);
    let is_on_rows = |end: &Point2<f64>| (0.0..=height).contains(&end.y);
    right.x - left.x >= config.min_target_px
        && left.x >= config.margin_px
        && right.x <= width - config.margin_px
        && (camera.height_m.is_none() || [left, right].iter().all(is_on_rows))
        && !is_masked(&left, &right, camera)
}

/// True if a mask hides a part of a target with these ends, which is taken to be as high as wide.
/// Without the camera's height, the target may be in any row.
fn is_masked(left: &Point2<f64>, right: &Point2<f64>, camera: &PosedCamera) -> bool {
    let ends = BoundingBox::around(&[*left, *right]);
    let height = f64::from(camera.intrinsics.height);
    let target = match camera.height_m {
        Some(_) => BoundingBox {
            y_min: ends.y_min - ends.width(),
            ..ends
        },
        None => BoundingBox {
            y_min: -height,
            y_max: 2.0 * height,
            ..ends
        },
    };
    camera.masks.iter().any(|mask| mask.overlaps(&target))
}

/// A perceived object that hides landmarks behind it.
struct Occluder {
    range_m: f64,
    bearing_rad: f64,
    half_angle_rad: f64,
}

impl Occluder {
    /// An object that faces `facing_rad`, or has the same width from all sides.
    fn new(
        object: &PerceivedObject,
        facing_rad: Option<f64>,
        camera: &Pose,
        widths: &Widths,
    ) -> Self {
        let position = Point2::new(object.x_m, object.y_m);
        let (range_m, bearing_rad) = camera.range_bearing(&position);
        let width_m = widths
            .sizes
            .labels
            .get(&object.label)
            .map_or(widths.unlisted_m, |size| size.width_m);
        let half_angle_rad = half_angle(
            width_m * visible_width_share(facing_rad, camera, &position),
            range_m,
        );
        Self {
            range_m,
            bearing_rad,
            half_angle_rad,
        }
    }

    /// True if any part of a target at the given range and bearing is behind this object;
    /// `width_share` is the visible share of its width.
    fn hides(&self, range_m: f64, bearing_rad: f64, width_share: f64, widths: &Widths) -> bool {
        self.range_m + widths.config.clearance_m < range_m
            && wrap_angle(self.bearing_rad - bearing_rad).abs()
                < self.half_angle_rad + half_angle(widths.target_m * width_share, range_m)
    }
}

/// The visible share of a flat target's width, 0 to 1; 1 if it has no facing.
fn visible_width_share(facing_rad: Option<f64>, camera: &Pose, position: &Point2<f64>) -> f64 {
    let to_camera = camera.position - position;
    facing_rad.map_or(1.0, |facing_rad| {
        (to_camera.y.atan2(to_camera.x) - facing_rad).cos().abs()
    })
}

fn half_angle(width_m: f64, range_m: f64) -> f64 {
    (width_m / 2.0).atan2(range_m)
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{FRAC_PI_2, PI};

    use super::*;
    use crate::perception::projection::ObjectSize;

    fn landmark(id: &str, x_m: f64, y_m: f64, facing_rad: Option<f64>) -> Landmark {
        Landmark {
            id: id.into(),
            position: Point2::new(x_m, y_m),
            facing_rad,
            vacancy: None,
            synonyms: vec![],
        }
    }

    fn object(label: &str, x_m: f64, y_m: f64) -> PerceivedObject {
        PerceivedObject::new(label, 0.9, x_m, y_m)
    }

    /// Seen from the origin, looking east with a field of view of 62.2°.
    fn seen(
        landmarks: &[Landmark],
        objects: &[PerceivedObject],
        sizes: &ObjectSizes,
    ) -> Vec<LandmarkId> {
        let camera =
            Intrinsics::from_field_of_view(640, 480, 62.2f64.to_radians(), 48.8f64.to_radians());
        let camera = PosedCamera::new(Pose::new(0.0, 0.0, 0.0), &Mount::default(), camera);
        landmarks_in_view(landmarks, &camera, objects, sizes, &ViewConfig::default())
    }

    #[test]
    fn ground_positions_inside_rows_are_visible() {
        let intrinsics =
            Intrinsics::from_field_of_view(640, 480, 62.2f64.to_radians(), 48.8f64.to_radians());
        let config = ViewConfig {
            min_target_px: 0.0,
            ..ViewConfig::default()
        };
        let ahead = [1.0, 3.0, 9.0].map(|x_m| landmark(&format!("{x_m} m"), x_m, 0.0, None));
        let seen = |height_m, pitch_deg: f64| {
            let mount = Mount {
                height_m,
                pitch_rad: pitch_deg.to_radians(),
                ..Mount::default()
            };
            let camera = PosedCamera::new(Pose::new(0.0, 0.0, 0.0), &mount, intrinsics);
            landmarks_in_view(&ahead, &camera, &[], &ObjectSizes::default(), &config)
        };
        assert_eq!(seen(None, 0.0), ["1 m", "3 m", "9 m"]);
        assert_eq!(
            seen(Some(1.2), 0.0),
            ["3 m", "9 m"],
            "the ground below the image is not in view"
        );
        assert_eq!(
            seen(Some(1.2), 40.0),
            ["1 m", "3 m"],
            "nor is what is above it"
        );
    }

    #[test]
    fn masked_landmarks_are_invisible() {
        let intrinsics =
            Intrinsics::from_field_of_view(640, 480, 62.2f64.to_radians(), 48.8f64.to_radians());
        let config = ViewConfig {
            min_target_px: 0.0,
            ..ViewConfig::default()
        };
        let landmarks = [
            landmark("left", 3.0, 1.0, None),
            landmark("ahead", 3.0, 0.0, None),
        ];
        let seen = |height_m, rows: [f64; 2]| {
            let mount = Mount {
                height_m,
                ..Mount::default()
            };
            let [top, bottom] = rows;
            let corners = [[0.0, top], [290.0, top], [290.0, bottom], [0.0, bottom]];
            let masks = [Polygon::new(&corners.map(Point2::from)).unwrap()];
            let camera =
                PosedCamera::new(Pose::new(0.0, 0.0, 0.0), &mount, intrinsics).with_masks(&masks);
            landmarks_in_view(&landmarks, &camera, &[], &ObjectSizes::default(), &config)
        };
        // 1 m below the camera, the ground 3 m ahead is in row 416.
        assert_eq!(seen(Some(1.0), [400.0, 480.0]), ["ahead"]);
        assert_eq!(seen(Some(1.0), [0.0, 200.0]), ["left", "ahead"]);
        assert_eq!(
            seen(None, [0.0, 200.0]),
            ["ahead"],
            "without a height, the row is unknown"
        );
    }

    fn sees(x_m: f64, y_m: f64, facing_rad: Option<f64>, objects: &[PerceivedObject]) -> bool {
        !seen(
            &[landmark("a", x_m, y_m, facing_rad)],
            objects,
            &ObjectSizes::default(),
        )
        .is_empty()
    }

    #[test]
    fn turned_target_hides_less() {
        let behind = landmark("behind", 0.40, 0.062, None);
        let before = landmark("before", 0.25, 0.0, Some(PI - 1.0));
        let hiding = PerceivedObject {
            landmark: Some("before".into()),
            ..object("ABC", 0.25, 0.0)
        };
        let all_around = landmark("before", 0.25, 0.0, None);
        assert!(
            seen(
                &[behind.clone(), before],
                std::slice::from_ref(&hiding),
                &ObjectSizes::default()
            )
            .contains(&"behind".into())
        );
        assert!(
            !seen(&[behind, all_around], &[hiding], &ObjectSizes::default())
                .contains(&"behind".into())
        );
    }

    #[test]
    fn visibility_uses_listed_sizes() {
        let slot = landmark("slot", 8.0, 0.0, None);
        let car = ObjectSize::square(1.8);
        let sizes = ObjectSizes {
            labels: [("car".into(), car)].into(),
            ..ObjectSizes::default()
        };
        let slot = std::slice::from_ref(&slot);
        assert!(
            seen(slot, &[], &ObjectSizes::default()).is_empty(),
            "too far for a placard"
        );
        assert_eq!(seen(slot, &[], &sizes), ["slot"]);
        assert!(
            seen(slot, &[object("dragon", 4.0, 0.8)], &sizes).is_empty(),
            "what is not listed hides as a car does"
        );
    }

    #[test]
    fn facing_landmark_ahead_is_visible() {
        assert!(sees(0.5, 0.0, Some(PI), &[]));
        assert!(
            sees(0.5, 0.0, Some(-PI), &[]),
            "the same direction, written otherwise"
        );
        assert!(sees(0.5, 0.0, None, &[]), "readable from all around");
    }

    #[test]
    fn whole_target_must_be_visible() {
        let edge_m = 0.5 * 31.1f64.to_radians().tan();
        assert!(sees(0.5, edge_m - 0.04, Some(PI), &[]));
        assert!(
            !sees(0.5, edge_m - 0.02, Some(PI), &[]),
            "its left end is outside"
        );
        assert!(
            !sees(0.5, -edge_m + 0.02, Some(PI), &[]),
            "its right end is outside"
        );
        assert!(!sees(-0.5, 0.0, None, &[]), "behind the camera");
    }

    #[test]
    fn turned_or_tiny_target_is_invisible() {
        assert!(sees(0.4, 0.0, Some(PI - 0.8), &[]));
        assert!(
            !sees(0.4, 0.0, Some(PI - 0.9), &[]),
            "beyond the largest yaw"
        );
        assert!(!sees(0.4, 0.0, Some(0.0), &[]), "from behind");
        assert!(!sees(0.4, 0.0, Some(FRAC_PI_2), &[]), "edge on");
        // 0.05 m at 530 px focal length take 36 px at 0.736 m, and less when turned.
        assert!(sees(0.73, 0.0, Some(PI), &[]));
        assert!(!sees(0.75, 0.0, Some(PI), &[]));
        assert!(!sees(0.73, 0.0, Some(PI - 0.5), &[]));
    }

    #[test]
    fn range_limit_bounds_view() {
        let camera = Intrinsics::from_field_of_view(640, 480, 1.0, 0.8);
        let config = ViewConfig {
            max_range_m: 2.0,
            min_target_px: 0.0,
            ..ViewConfig::default()
        };
        let landmarks = [
            landmark("near", 1.9, 0.0, None),
            landmark("far", 2.1, 0.0, None),
        ];
        let camera = PosedCamera::new(Pose::new(0.0, 0.0, 0.0), &Mount::default(), camera);
        assert_eq!(
            landmarks_in_view(&landmarks, &camera, &[], &ObjectSizes::default(), &config),
            ["near"]
        );
    }

    #[test]
    fn nearer_object_hides_objects_behind() {
        assert!(!sees(0.6, 0.0, Some(PI), &[object("QR", 0.3, 0.0)]));
        assert!(
            !sees(0.6, 0.0, Some(PI), &[object("QR", 0.3, 0.045)]),
            "covers its left end"
        );
        assert!(
            sees(0.6, 0.0, Some(PI), &[object("QR", 0.3, 0.06)]),
            "does not cover the target"
        );
        assert!(
            sees(0.6, 0.0, Some(PI), &[object("QR", 0.58, 0.0)]),
            "stands there itself"
        );
        assert!(
            sees(0.6, 0.0, Some(PI), &[object("QR", 0.9, 0.0)]),
            "stands behind"
        );
    }

    #[test]
    fn listed_width_sets_occlusion() {
        let sizes: ObjectSizes = serde_json::from_str(
            r#"{"labels": {"truck": {"width_m": 0.3, "height_m": 0.3},
            "QR": {"width_m": 0.05, "height_m": 0.05}}}"#,
        )
        .unwrap();
        let landmarks = [
            landmark("a", 0.6, 0.0, Some(PI)),
            landmark("b", 0.6, -0.2, Some(PI)),
        ];
        assert_eq!(
            seen(&landmarks, &[object("truck", 0.3, 0.1)], &sizes),
            ["b"]
        );
        assert_eq!(
            seen(&landmarks, &[object("van", 0.3, 0.1)], &sizes),
            ["a", "b"]
        );
    }
}
