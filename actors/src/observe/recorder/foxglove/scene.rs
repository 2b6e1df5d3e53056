//! 3D drawings of maps and reports.

use std::collections::BTreeMap;
use std::f64::consts::TAU;

use ecod::model::geometry::Covariance;
use ecod::model::names::{LandmarkId, NodeName};
use ecod::model::time::Timestamp;
use ecod::perception::landmark::LandmarkConfig;
use ecod::wire::{FieldOfView, GlobalMap, ObjectReport, WirePose};
use nalgebra::SymmetricEigen;
use schemars::JsonSchema;
use serde::Serialize;

use super::{Color, FoxglovePose, MAP, Time, Vector3, camera_pose, plane_pose};

/// `foxglove.SceneUpdate`.
#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
#[schemars(title = "foxglove.SceneUpdate")]
pub(crate) struct SceneUpdate {
    deletions: [SceneDeletion; 1],
    entities: Vec<SceneEntity>,
}

/// `foxglove.SceneEntityDeletion`.
#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
struct SceneDeletion {
    timestamp: Time,
    #[serde(rename = "type")]
    kind: u8,
    id: String,
}

#[derive(Debug, Clone, Default, PartialEq, Serialize, JsonSchema)]
pub(crate) struct SceneEntity {
    timestamp: Time,
    frame_id: &'static str,
    id: String,
    #[schemars(title = "duration")]
    lifetime: Time,
    frame_locked: bool,
    metadata: Vec<KeyValue>,
    arrows: Vec<Arrow>,
    cubes: Vec<SceneSolid>,
    spheres: Vec<SceneSolid>,
    cylinders: Vec<Cylinder>,
    lines: Vec<Line>,
    triangles: [(); 0],
    texts: Vec<FoxgloveText>,
    models: [(); 0],
}

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
struct KeyValue {
    key: &'static str,
    value: String,
}

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
struct Arrow {
    pose: FoxglovePose,
    shaft_length: f64,
    shaft_diameter: f64,
    head_length: f64,
    head_diameter: f64,
    color: Color,
}

/// A box or a ball.
#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
struct SceneSolid {
    pose: FoxglovePose,
    size: Vector3,
    color: Color,
}

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
struct Cylinder {
    pose: FoxglovePose,
    size: Vector3,
    bottom_scale: f64,
    top_scale: f64,
    color: Color,
}

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
struct Line {
    #[serde(rename = "type")]
    kind: u8,
    pose: FoxglovePose,
    thickness: f64,
    scale_invariant: bool,
    points: Vec<Vector3>,
    color: Color,
    colors: [(); 0],
    indices: [(); 0],
}

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
struct FoxgloveText {
    pose: FoxglovePose,
    billboard: bool,
    font_size: f64,
    scale_invariant: bool,
    color: Color,
    text: String,
}

/// Time for which an entity is drawn after its last update.
const LIFETIME: Time = Time { sec: 1, nsec: 0 };

/// `SceneEntityDeletionType` of all entities of a topic.
const DELETE_ALL: u8 = 1;

/// Diameter in metres of an object without a size, in a cell with fewer than two landmarks.
const OBJECT_M: f64 = 0.6;

/// Diameter in other cells: share of the usual distance between neighbouring landmarks, and bounds
/// in metres.
const SPACING_SHARE: f64 = 0.4;
const OBJECT_BOUNDS_M: [f64; 2] = [0.02, 1.0];

/// Diameter of a detection, length of a vehicle and of a facing, and height of a text above its
/// object, in diameters of an object.
const DETECTED: f64 = 0.4;
const VEHICLE: f64 = 2.0;
const FACING: f64 = 1.5;
const TEXT: f64 = 1.2;

/// Confidence below which no ellipse is drawn: the ellipse of a nearly lost track would cover the
/// map.
const LIKELY: f64 = 0.5;

/// Least opacity of a text, at which it can still be read.
const MIN_TEXT_OPACITY: f64 = 0.25;

/// Maximum height in metres of an object with a size.
const MAX_HEIGHT_M: f64 = 1.5;

/// Half axes of the ellipse that has 95 % of a normal distribution, in standard deviations.
const SIGMAS_95: f64 = 2.4477;

/// Maximum angle in radians from a point of a circle to the next.
const ARC_STEP_RAD: f64 = TAU / 48.0;

/// `LineType` of a closed line.
const LINE_LOOP: u8 = 1;

const TEXT_PX: f64 = 14.0;
const LINE_PX: f64 = 2.0;

const FUSED_COLOR: Color = Color {
    r: 0.10,
    g: 0.55,
    b: 0.35,
    a: 0.9,
};
const EMPTY_COLOR: Color = Color {
    r: 0.55,
    g: 0.55,
    b: 0.55,
    a: 0.35,
};
const DETECTED_COLOR: Color = Color {
    r: 0.90,
    g: 0.55,
    b: 0.10,
    a: 0.6,
};
const VEHICLE_COLOR: Color = Color {
    r: 0.15,
    g: 0.40,
    b: 0.80,
    a: 1.0,
};
const VIEW_COLOR: Color = Color {
    a: 0.5,
    ..VEHICLE_COLOR
};
const TEXT_COLOR: Color = Color {
    r: 1.0,
    g: 1.0,
    b: 1.0,
    a: 1.0,
};

/// Sizes of a cell's drawings and the facing of its landmarks.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct SceneStyle {
    object_m: f64,
    facing_rad: BTreeMap<LandmarkId, f64>,
}

impl SceneStyle {
    /// The style of a cell with these landmarks.
    pub(crate) fn of(landmarks: &[LandmarkConfig]) -> Self {
        let distance_m =
            |a: &LandmarkConfig, b: &LandmarkConfig| (a.x_m - b.x_m).hypot(a.y_m - b.y_m);
        let nearest_m = |at: &LandmarkConfig| {
            let others = landmarks
                .iter()
                .filter(|other| other.id != at.id)
                .map(|other| distance_m(at, other));
            others.min_by(f64::total_cmp)
        };
        let mut spacings: Vec<_> = landmarks
            .iter()
            .take(MAX_SPACINGS)
            .filter_map(nearest_m)
            .collect();
        spacings.sort_by(f64::total_cmp);
        let [least_m, most_m] = OBJECT_BOUNDS_M;
        let usual_m = spacings.get(spacings.len() / 2);
        let object_m = usual_m.map_or(OBJECT_M, |spacing_m| {
            (SPACING_SHARE * spacing_m).clamp(least_m, most_m)
        });
        let facing = |at: &LandmarkConfig| Some((at.id.clone(), at.facing_deg?.to_radians()));
        Self {
            object_m,
            facing_rad: landmarks.iter().filter_map(facing).collect(),
        }
    }

    /// Landmarks with their labels and facing, and tracked objects with the ellipses of their
    /// positions.
    pub(crate) fn map(&self, map: &GlobalMap) -> SceneUpdate {
        let landmarks = map.landmarks.iter().map(|landmark| {
            let pose = plane_pose(landmark.x_m, landmark.y_m, 0.0);
            let color = if landmark.label.is_some() {
                FUSED_COLOR
            } else {
                EMPTY_COLOR
            };
            let text = match &landmark.label {
                Some(label) => format!("{} {label}", landmark.id),
                None => landmark.id.to_string(),
            };
            let entity = SceneEntity::new(map.fused_at_us, format!("landmark/{}", landmark.id))
                .ball(pose, self.object_m, color)
                .text(pose, TEXT * self.object_m, text, 1.0)
                .metadata("confidence", landmark.confidence.to_string())
                .metadata("contributors", listed(&landmark.contributors));
            match self.facing_rad.get(&landmark.id) {
                Some(facing) => entity.arrow(
                    plane_pose(landmark.x_m, landmark.y_m, *facing),
                    FACING * self.object_m,
                    color,
                ),
                None => entity,
            }
        });
        let objects = map.objects.iter().map(|object| {
            let pose = plane_pose(object.x_m, object.y_m, object.heading_rad.unwrap_or(0.0));
            let existence = object.existence.unwrap_or(1.0);
            let color = Color {
                a: FUSED_COLOR.a * existence,
                ..FUSED_COLOR
            };
            let bare = SceneEntity::new(map.fused_at_us, format!("object/{}", object.id));
            let (shaped, height_m) = match object.size_m {
                Some(size_m) => (bare.block(pose, size_m, color), MAX_HEIGHT_M),
                None => (bare.ball(pose, self.object_m, color), 0.0),
            };
            let is_likely = object.confidence >= LIKELY;
            let position = [object.x_m, object.y_m];
            let entity = if is_likely {
                shaped.ellipse(position, &object.covariance(), color)
            } else {
                shaped
            };
            entity
                .text(
                    pose,
                    height_m + TEXT * self.object_m,
                    object.label.to_string(),
                    existence.max(MIN_TEXT_OPACITY),
                )
                .metadata("confidence", object.confidence.to_string())
                .metadata("contributors", listed(&object.contributors))
        });
        SceneUpdate::new(map.fused_at_us, landmarks.chain(objects))
    }

    /// A vehicle and its detections.
    pub(crate) fn report(&self, report: &ObjectReport) -> SceneUpdate {
        let at = report.captured_at_us;
        let node = &report.node;
        let vehicle = report.pose.map(|pose| self.vehicle_entity(node, &pose, at));
        let objects = report.objects.iter().enumerate().map(|(number, object)| {
            let entity = SceneEntity::new(at, format!("detection/{node}/{number}"))
                .ball(
                    plane_pose(object.x_m, object.y_m, 0.0),
                    DETECTED * self.object_m,
                    DETECTED_COLOR,
                )
                .metadata("label", object.label.to_string());
            match object.covariance() {
                Some(covariance) => {
                    entity.ellipse([object.x_m, object.y_m], &covariance, DETECTED_COLOR)
                }
                None => entity,
            }
        });
        SceneUpdate::new(at, vehicle.into_iter().chain(objects))
    }

    /// A vehicle with the field of view that it states.
    pub(crate) fn vehicle(
        &self,
        node: &NodeName,
        pose: &WirePose,
        report: &ObjectReport,
    ) -> SceneEntity {
        let entity = self.vehicle_entity(node, pose, report.captured_at_us);
        match report.view {
            Some(view) => entity.view(pose, view),
            None => entity,
        }
    }

    fn vehicle_entity(&self, node: &NodeName, pose: &WirePose, at: Timestamp) -> SceneEntity {
        let pose = camera_pose(pose);
        let entity = SceneEntity::new(at, format!("vehicle/{node}"));
        let length_m = VEHICLE * self.object_m;
        entity.arrow(pose, length_m, VEHICLE_COLOR).text(
            pose,
            TEXT * self.object_m,
            node.to_string(),
            1.0,
        )
    }
}

/// Maximum number of landmarks for which the distance to the next one is computed.
const MAX_SPACINGS: usize = 256;

impl SceneUpdate {
    /// Replaces all entities of a topic; earlier entities are deleted, so that outdated ones
    /// disappear.
    pub(crate) fn new(at: Timestamp, entities: impl Iterator<Item = SceneEntity>) -> Self {
        let all = SceneDeletion {
            timestamp: at.into(),
            kind: DELETE_ALL,
            id: String::new(),
        };
        Self {
            deletions: [all],
            entities: entities.collect(),
        }
    }
}

impl SceneEntity {
    fn new(at: Timestamp, id: String) -> Self {
        Self {
            timestamp: at.into(),
            frame_id: MAP,
            id,
            lifetime: LIFETIME,
            ..Self::default()
        }
    }

    fn arrow(mut self, pose: FoxglovePose, length_m: f64, color: Color) -> Self {
        self.arrows.push(Arrow {
            pose,
            shaft_length: length_m * 0.7,
            shaft_diameter: length_m * 0.2,
            head_length: length_m * 0.3,
            head_diameter: length_m * 0.4,
            color,
        });
        self
    }

    fn ball(mut self, pose: FoxglovePose, diameter_m: f64, color: Color) -> Self {
        self.spheres.push(SceneSolid {
            pose,
            size: Vector3 {
                x: diameter_m,
                y: diameter_m,
                z: diameter_m,
            },
            color,
        });
        self
    }

    /// A box of this length and width that stands on the ground.
    fn block(mut self, pose: FoxglovePose, [length_m, width_m]: [f64; 2], color: Color) -> Self {
        let size = Vector3 {
            x: length_m,
            y: width_m,
            z: width_m.min(MAX_HEIGHT_M),
        };
        let position = Vector3 {
            z: size.z / 2.0,
            ..pose.position
        };
        self.cubes.push(SceneSolid {
            pose: FoxglovePose { position, ..pose },
            size,
            color,
        });
        self
    }

    /// The area on the ground that has the position with a probability of 95 %.
    fn ellipse(mut self, [x_m, y_m]: [f64; 2], covariance: &Covariance, color: Color) -> Self {
        let SymmetricEigen {
            eigenvalues,
            eigenvectors,
        } = covariance.matrix().symmetric_eigen();
        let axis = eigenvectors.column(0);
        let [x, y] = [eigenvalues[0], eigenvalues[1]]
            .map(|variance| 2.0 * SIGMAS_95 * variance.max(0.0).sqrt());
        let pose = plane_pose(x_m, y_m, axis.y.atan2(axis.x));
        let size = Vector3 { x, y, z: 0.01 };
        let color = Color { a: 0.2, ..color };
        self.cylinders.push(Cylinder {
            pose,
            size,
            bottom_scale: 1.0,
            top_scale: 1.0,
            color,
        });
        self
    }

    /// The edges of a field of view on the ground.
    fn view(mut self, pose: &WirePose, view: FieldOfView) -> Self {
        let half_rad = view.angle_rad.min(TAU) / 2.0;
        let steps = (view.angle_rad.min(TAU) / ARC_STEP_RAD).ceil().max(1.0);
        let on_arc = |step: f64| {
            let (sin, cos) = (-half_rad + 2.0 * half_rad * step / steps).sin_cos();
            Vector3 {
                x: view.range_m * cos,
                y: view.range_m * sin,
                z: 0.0,
            }
        };
        let is_all_around = view.angle_rad > TAU - ARC_STEP_RAD;
        let apex = (!is_all_around).then(Vector3::default);
        let points = apex
            .into_iter()
            .chain((0..=steps as u32).map(|step| on_arc(f64::from(step))))
            .collect();
        self.lines.push(Line {
            kind: LINE_LOOP,
            pose: plane_pose(pose.x_m, pose.y_m, pose.heading_rad),
            thickness: LINE_PX,
            scale_invariant: true,
            points,
            color: VIEW_COLOR,
            colors: [],
            indices: [],
        });
        self
    }

    /// A text above a place, of this opacity; it is drawn on black.
    fn text(mut self, pose: FoxglovePose, above_m: f64, text: String, opacity: f64) -> Self {
        let position = Vector3 {
            z: pose.position.z + above_m,
            ..pose.position
        };
        let pose = FoxglovePose { position, ..pose };
        let font_size = TEXT_PX;
        let color = Color {
            a: opacity,
            ..TEXT_COLOR
        };
        self.texts.push(FoxgloveText {
            pose,
            billboard: true,
            font_size,
            scale_invariant: true,
            color,
            text,
        });
        self
    }

    fn metadata(mut self, key: &'static str, value: String) -> Self {
        self.metadata.push(KeyValue { key, value });
        self
    }
}

fn listed(nodes: &[NodeName]) -> String {
    nodes
        .iter()
        .map(NodeName::as_str)
        .collect::<Vec<_>>()
        .join(" ")
}

#[cfg(test)]
mod tests {
    use std::f64::consts::FRAC_PI_2;

    use ecod::model::epoch::Epoch;
    use ecod::wire::{FusedObject, LandmarkState};
    use uuid::Uuid;

    use super::*;

    fn places(spacing_m: f64) -> Vec<LandmarkConfig> {
        let place = |number: u8| {
            LandmarkConfig::at(format!("p{number}"), f64::from(number) * spacing_m, 0.0)
        };
        (0..4).map(place).collect()
    }

    #[test]
    fn drawings_fill_allowed_scene_size() {
        let diameters =
            [0.05, 0.2, 2.5, 300.0].map(|spacing_m| SceneStyle::of(&places(spacing_m)).object_m);
        for (is, expected) in diameters.iter().zip([0.02, 0.08, 1.0, 1.0]) {
            assert!((is - expected).abs() < 1e-12, "{diameters:?}");
        }
        assert_eq!(SceneStyle::of(&places(1.0)[..1]).object_m, OBJECT_M);
    }

    #[test]
    fn ellipse_follows_largest_uncertainty() {
        let covariance = Covariance::along_bearing(0.5, 2.0, 0.5);
        let entity = SceneEntity::new(Timestamp(1), String::new()).ellipse(
            [3.0, 4.0],
            &covariance,
            FUSED_COLOR,
        );
        let Cylinder { pose, size, .. } = &entity.cylinders[0];
        assert_eq!((pose.position.x, pose.position.y), (3.0, 4.0));
        let long = size.x.max(size.y);
        let short = size.x.min(size.y);
        assert!(
            (long - 4.0 * SIGMAS_95).abs() < 1e-9 && (short - SIGMAS_95).abs() < 1e-9,
            "{size:?}"
        );
        let heading_rad = 2.0 * pose.orientation.z.atan2(pose.orientation.w);
        let long_rad = if size.x > size.y {
            heading_rad
        } else {
            heading_rad + FRAC_PI_2
        };
        assert!((long_rad - 0.5).sin().abs() < 1e-9, "{long_rad}");
    }

    #[test]
    fn field_of_view_is_sector() {
        let pose = WirePose::new(1.0, 2.0, 0.3);
        let line = |angle_rad| {
            let entity = SceneEntity::new(Timestamp(1), String::new());
            entity
                .view(
                    &pose,
                    FieldOfView {
                        range_m: 10.0,
                        angle_rad,
                    },
                )
                .lines
                .remove(0)
        };
        let sector = line(1.0);
        assert_eq!((sector.points[0].x, sector.points[0].y), (0.0, 0.0));
        let bearings: Vec<_> = sector.points[1..]
            .iter()
            .map(|point| point.y.atan2(point.x))
            .collect();
        assert!(
            (bearings[0] + 0.5).abs() < 1e-9 && (bearings[bearings.len() - 1] - 0.5).abs() < 1e-9,
            "{bearings:?}"
        );
        let circle = line(f64::from(TAU as f32));
        assert!(
            circle
                .points
                .iter()
                .all(|point| (point.x.hypot(point.y) - 10.0).abs() < 1e-9)
        );
    }

    #[test]
    fn objects_have_size_and_heading() {
        let mut landmarks = places(1.0);
        landmarks[1].facing_deg = Some(90.0);
        let style = SceneStyle::of(&landmarks);
        let car = FusedObject::new(
            Uuid::nil(),
            "car",
            0.9,
            5.0,
            6.0,
            Covariance::isotropic(0.3),
        );
        let car = FusedObject {
            size_m: Some([4.0, 1.8]),
            heading_rad: Some(1.0),
            ..car
        };
        let state = |id: &str| LandmarkState {
            id: id.into(),
            label: None,
            confidence: 0.0,
            x_m: 0.0,
            y_m: 0.0,
            contributors: Vec::new(),
            observers: Vec::new(),
            readings: Vec::new(),
        };
        let epoch = Epoch::new(1, NodeName::from_static("edge"));
        let landmarks = vec![state("p0"), state("p1")];
        let map = GlobalMap {
            landmarks,
            ..GlobalMap::new(&epoch, 1, Timestamp(1))
        };
        let mut lost = FusedObject::new(
            Uuid::max(),
            "car",
            0.06,
            9.0,
            9.0,
            Covariance::isotropic(20.0),
        );
        lost.existence = Some(0.06);
        let unplaced = FusedObject {
            confidence: 0.41,
            existence: Some(0.78),
            ..lost.clone()
        };
        let map = GlobalMap {
            objects: vec![car, lost, unplaced],
            ..map
        };
        let SceneUpdate {
            deletions,
            entities,
        } = style.map(&map);
        assert_eq!(
            deletions[0].kind, DELETE_ALL,
            "an object that left the map is not shown"
        );
        assert_eq!(
            entities
                .iter()
                .map(|entity| entity.cylinders.len())
                .collect::<Vec<_>>(),
            [0, 0, 1, 0, 0]
        );
        assert!(
            entities[3].spheres[0].color.a < 0.1
                && entities[3].texts[0].color.a == MIN_TEXT_OPACITY
        );
        assert!(
            entities[2].texts[0].pose.position.z > 1.5,
            "above the block"
        );
        assert_eq!(
            entities
                .iter()
                .map(|entity| entity.arrows.len())
                .collect::<Vec<_>>(),
            [0, 1, 0, 0, 0]
        );
        let facing = entities[1].arrows[0].pose.orientation;
        assert!((2.0 * facing.z.atan2(facing.w) - FRAC_PI_2).abs() < 1e-9);
        let block = &entities[2].cubes[0];
        assert_eq!(
            (block.size.x, block.size.y, block.pose.position.z),
            (4.0, 1.8, 0.75)
        );
    }
}
