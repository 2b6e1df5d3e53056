//! Values that are allowed but look as if they were in another unit.

use std::borrow::Cow;
use std::f64::consts::{FRAC_PI_4, TAU};

use ecod::diagnostics::TroubleKind;
use ecod::perception::projection::ObjectSizes;
use toml::Value;

use super::NodeConfig;

/// Table of the sizes of labels.
const SIZES: &str = "camera.projection.sizes.";

/// Greatest length in metres of an object, a mount or a gate; road trains have 25 m.
const MAX_LENGTH_M: f64 = 30.0;

/// Greatest ratio of a label's size to the usual one, either way.
const MAX_RATIO: f64 = 20.0;

/// Greatest time in seconds between two rounds, and greatest other time of fusion.
const MAX_PERIOD_S: f64 = 10.0;
const MAX_TIME_S: f64 = 100.0;

/// Smallest field of view in degrees; radians are below.
const MIN_FIELD_OF_VIEW_DEG: f64 = 4.0;

/// Greatest standard deviation of an angle in radians; degrees are above.
const MAX_ANGLE_SIGMA_RAD: f64 = 0.5;

/// Distance from a multiple of 45° in radians within which a value looks like a rounded one.
const ROUNDING_RAD: f64 = 0.003;

impl NodeConfig {
    /// The kinds of trouble about units; for a doubtful value, its cause with key, value and unit.
    pub fn doubtful_units(&self) -> [(TroubleKind, Option<String>); 2] {
        let mut found = Vec::new();
        if let Ok(keys) = Value::try_from(self) {
            collect(&keys, "", &mut found);
        }
        let (sizes, others): (Vec<_>, Vec<_>) = found
            .into_iter()
            .partition(|(path, _)| as_only_camera(path).starts_with(SIZES));
        let cause = |found: Vec<(String, String)>| {
            let texts: Vec<String> = found
                .into_iter()
                .map(|(path, text)| format!("`{path}` is {text}"))
                .collect();
            (!texts.is_empty()).then(|| texts.join("; "))
        };
        [
            (TroubleKind::ImplausibleSize, cause(sizes)),
            (TroubleKind::ImplausibleUnit, cause(others)),
        ]
    }
}

/// Adds the paths of doubtful numbers, each with its value and unit as text.
fn collect(value: &Value, path: &str, found: &mut Vec<(String, String)>) {
    let number = match value {
        Value::Table(table) => {
            let dot = if path.is_empty() { "" } else { "." };
            return table
                .iter()
                .for_each(|(key, value)| collect(value, &format!("{path}{dot}{key}"), found));
        }
        Value::Array(list) => {
            return list
                .iter()
                .enumerate()
                .for_each(|(n, value)| collect(value, &format!("{path}[{n}]"), found));
        }
        Value::Float(number) => *number,
        Value::Integer(number) => *number as f64,
        _ => return,
    };
    if let Some(unit) = missed_unit(&as_only_camera(path), number) {
        found.push((path.into(), format!("{number}, and should be in {unit}")));
    }
}

/// The path of a key in `[[cameras]]` as it would be in `[camera]`.
fn as_only_camera(path: &str) -> Cow<'_, str> {
    let key = path
        .strip_prefix("cameras[")
        .and_then(|rest| rest.split_once("]."))
        .map(|(_, key)| key);
    key.map_or(path.into(), |key| format!("camera.{key}").into())
}

/// The unit that a value should have, if it looks like a value in another unit.
fn missed_unit(path: &str, value: f64) -> Option<&'static str> {
    let (table, key) = path.rsplit_once('.').unwrap_or(("", path));
    let size = value.abs();
    let is_place = ["pose", "origin", "landmarks"]
        .iter()
        .any(|place| table.starts_with(place));
    let (is_doubtful, unit) = match key.rsplit_once('_')? {
        ("max_range", "m") => return None,
        (_, "m") => (
            !is_place && (size > MAX_LENGTH_M || is_unusual(table, key, value)),
            "metres",
        ),
        ("period", "s") if table == "fusion.round" => (value > MAX_PERIOD_S, "seconds"),
        ("stall_timeout", "s") => (value > MAX_TIME_S, "seconds"),
        ("align_memory", "s") => return None,
        (_, "s") => (table.starts_with("fusion") && value > MAX_TIME_S, "seconds"),
        ("latitude" | "longitude", _) => return None,
        ("horizontal_fov" | "vertical_fov", "deg") => (value < MIN_FIELD_OF_VIEW_DEG, "degrees"),
        (_, "deg") => (is_multiple_of_45_deg_in_radians(value), "degrees"),
        (name, "rad") => (
            size > if name.ends_with("sigma") {
                MAX_ANGLE_SIGMA_RAD
            } else {
                TAU
            },
            "radians",
        ),
        _ => return None,
    };
    is_doubtful.then_some(unit)
}

fn is_multiple_of_45_deg_in_radians(value: f64) -> bool {
    let eighths = (value / FRAC_PI_4).round();
    (1.0..=8.0).contains(&eighths.abs()) && (value - eighths * FRAC_PI_4).abs() < ROUNDING_RAD
}

/// True if a listed size is far from the usual size of its label.
fn is_unusual(table: &str, key: &str, value: f64) -> bool {
    let Some(label) = table
        .strip_prefix(SIZES)
        .and_then(|rest| rest.strip_prefix("labels."))
    else {
        return false;
    };
    let unlisted = ObjectSizes::default();
    let usual_m = unlisted.of(label).and_then(|usual| match key {
        "width_m" => Some(usual.width_m),
        "height_m" => Some(usual.height_m),
        _ => None,
    });
    usual_m.is_some_and(|usual_m| !(1.0 / MAX_RATIO..=MAX_RATIO).contains(&(value / usual_m)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[cfg(feature = "camera")]
    const CAMERA: &str = "source = { kind = \"v4l2\" }\ndetector = { kind = \"coco\" }";

    #[cfg(feature = "camera")]
    #[test]
    fn sizes_in_centimetres_are_noticed() {
        let of = |sizes: &str| {
            let text = format!("[camera]\n{CAMERA}\n[camera.projection.sizes]\n{sizes}");
            toml::from_str::<NodeConfig>(&text)
                .unwrap()
                .doubtful_units()
        };
        let usual = "labels.cup = { width_m = 0.09, height_m = 0.1 }\nlabels.lorry = { width_m = 2.5, height_m = 4 }";
        assert_eq!(of(usual).map(|(_, cause)| cause), [None, None]);
        let [(kind, cause), _] = of(
            "default = { width_m = 180, height_m = 1 }\nlabels.cup = { width_m = 8, height_m = 0.1 }",
        );
        assert_eq!(kind, TroubleKind::ImplausibleSize);
        let expected = "`camera.projection.sizes.default.width_m` is 180, and should be in metres; \
                        `camera.projection.sizes.labels.cup.width_m` is 8, and should be in metres";
        assert_eq!(cause.as_deref(), Some(expected));
        let second = format!(
            "[[cameras]]\nname = \"rear\"\n{CAMERA}\nprojection.sizes.labels.cup = {{ width_m = 8, height_m = 0.1 }}"
        );
        let [(_, cause), _] = toml::from_str::<NodeConfig>(&second)
            .unwrap()
            .doubtful_units();
        assert!(cause.is_some_and(|cause| {
            cause.starts_with("`cameras[0].projection.sizes.labels.cup.width_m` is 8")
        }));
    }

    #[test]
    fn unit_slips_are_noticed() {
        for (key, value, unit) in [
            ("camera.mount.height_m", 150.0, "metres"),
            ("fusion.pace.gate_m", 50.0, "metres"),
            ("fusion.round.period_s", 50.0, "seconds"),
            ("fusion.window.max_age_s", 1000.0, "seconds"),
            ("camera.capture.stall_timeout_s", 500.0, "seconds"),
            ("pose.heading_deg", -1.57, "degrees"),
            ("landmarks[2].facing_deg", 2.356, "degrees"),
            ("camera.optics.horizontal_fov_deg", 1.0856, "degrees"),
            ("camera.projection.tilt_sigma_rad", 1.0, "radians"),
        ] {
            assert_eq!(missed_unit(key, value), Some(unit), "{key}");
        }
        for (key, value) in [
            ("pose.x_m", 1500.0),
            ("landmarks[0].x_m", -80.0),
            ("camera.view.max_range_m", 80.0),
            ("pose.heading_deg", 90.0),
            ("camera.mount.pitch_deg", 0.0),
            ("camera.mount.pitch_deg", 3.0),
            ("origin.longitude_deg", 2.356),
            ("camera.capture.retry_max_s", 600.0),
            ("broker.connects_per_s", 500.0),
        ] {
            assert_eq!(missed_unit(key, value), None, "{key}");
        }
        assert_eq!(
            NodeConfig::default()
                .doubtful_units()
                .map(|(_, cause)| cause),
            [None, None]
        );
    }
}
