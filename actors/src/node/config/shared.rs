//! Settings that all nodes of a cell share: the settings in the cell's description, and their place
//! in a node's configuration.

use ecod::aggregator::FusionConfig;
use ecod::config::ConfigError;
use ecod::model::epoch::Epoch;
use ecod::model::names::{Label, NodeName};
use ecod::model::origin::GeographicOrigin;
use ecod::model::time::Timestamp;
use ecod::perception::landmark::LandmarkConfig;
use ecod::perception::projection::ObjectSizes;
use ecod::wire::{Encoding, GlobalMap, LandmarkState, encode};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use super::NodeConfig;

/// The settings of a description. The keys are keys of a node's configuration.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SharedConfig {
    /// Settings of fusion, used by every aggregator.
    pub fusion: FusionConfig,
    /// All landmarks of the cell.
    pub landmarks: Vec<LandmarkConfig>,
    /// The place of the cell's frame on Earth. Default: not set.
    pub origin: Option<GeographicOrigin>,
    /// Settings of all cameras.
    pub camera: SharedCamera,
}

/// Settings of all cameras of a cell.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SharedCamera {
    /// Settings of projection, used for every camera.
    pub projection: SharedProjection,
}

/// Settings of projection of all cameras of a cell.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SharedProjection {
    /// True sizes of objects by label.
    pub sizes: ObjectSizes,
}

/// Cost of a description for each link of the cell.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DescriptionCost {
    /// Size of a map in JSON, in bytes, with a label and three vehicles at each landmark.
    pub map_bytes: usize,
    /// Bytes of maps a second.
    pub bytes_per_s: f64,
}

/// Largest map that a description may lead to, in bytes: a link of 20 Mbit/s carries it in 0.1 s.
const MAX_DESCRIBED_MAP_BYTES: usize = 256 * 1024;

/// Most bytes of maps a second that a description may lead to.
const MAX_DESCRIBED_BYTES_PER_S: f64 = 4e6;

/// Round periods in seconds that a description may set.
const DESCRIBED_PERIODS_S: std::ops::RangeInclusive<f64> = 0.02..=2.0;

/// Names of ordinary length, and the number of vehicles at each location, by which the cost is
/// computed.
const COST_NODE: NodeName = NodeName::from_static("vehicle1");
const COST_LABEL: Label = Label::new_static("ABCD1234");
const COST_CONTRIBUTORS: usize = 3;

/// A description that a node cannot use.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum DescriptionError {
    /// It is not TOML, or has unknown keys or values of the wrong kind.
    #[error("the description cannot be read: {0}")]
    Malformed(String),
    /// A value is out of its range.
    #[error("in the description, {0}")]
    OutOfRange(ConfigError),
    /// The node's own configuration has a different value.
    #[error(
        "configuration key `{key}`: this node's own configuration has {own}, the description of the cell has \
         {described}; remove the key from the node's configuration, or change the description by `ecod-node cell set`"
    )]
    Contradicts {
        /// Full key of the configuration, such as `fusion.pace.gate_m`.
        key: String,
        /// The node's own value.
        own: String,
        /// The value of the description.
        described: String,
    },
}

// Implemented by hand because thiserror would also make it the source, and it would be printed
// twice.
impl From<ConfigError> for DescriptionError {
    fn from(error: ConfigError) -> Self {
        Self::OutOfRange(error)
    }
}

/// Shared keys that a node's own configuration states, by file, environment or flags. They are not
/// part of a configuration's value: two configurations may be equal and state their values in
/// different places.
#[derive(Debug, Clone, Default)]
pub struct StatedKeys(Value);

impl PartialEq for StatedKeys {
    fn eq(&self, _: &Self) -> bool {
        true
    }
}

impl StatedKeys {
    /// The shared keys among all stated keys.
    pub(super) fn of(stated: &Value) -> Self {
        let mut shared = Map::new();
        for key in ["fusion", "landmarks", "origin"] {
            shared.extend(stated.get(key).map(|value| (key.to_owned(), value.clone())));
        }
        if let Some(sizes) = stated.pointer("/camera/projection/sizes") {
            shared.insert(
                "camera".into(),
                serde_json::json!({ "projection": { "sizes": sizes } }),
            );
        }
        Self(Value::Object(shared))
    }
}

impl SharedConfig {
    /// Reads the text of a description and checks every value.
    ///
    /// # Errors
    /// Returns a [`DescriptionError`] that names the line, or the key, the value and the allowed
    /// range.
    pub fn parse(text: &str) -> Result<Self, DescriptionError> {
        let shared: Self =
            toml::from_str(text).map_err(|error| DescriptionError::Malformed(error.to_string()))?;
        shared
            .fusion
            .validate()
            .map_err(|error| error.within("fusion"))?;
        LandmarkConfig::validate_all(&shared.landmarks)?;
        if let Some(origin) = &shared.origin {
            origin.validate().map_err(|error| error.within("origin"))?;
        }
        shared
            .camera
            .projection
            .sizes
            .validate()
            .map_err(|error| error.within("camera.projection.sizes"))?;
        shared.check_cost()?;
        Ok(shared)
    }

    /// The cost of maps of the landmarks for each link, once vehicles report there.
    pub fn cost(&self) -> DescriptionCost {
        let epoch = Epoch::new(1, COST_NODE);
        let occupied = |location: &LandmarkConfig| LandmarkState {
            id: location.id.clone(),
            label: Some(COST_LABEL),
            confidence: 0.931,
            x_m: location.x_m,
            y_m: location.y_m,
            contributors: vec![COST_NODE; COST_CONTRIBUTORS],
            observers: vec![COST_NODE; COST_CONTRIBUTORS],
            readings: Vec::new(),
        };
        let landmarks = self.landmarks.iter().map(occupied).collect();
        let map = GlobalMap {
            landmarks,
            ..GlobalMap::new(&epoch, 1, Timestamp(0))
        };
        let map_bytes = encode(&map, Encoding::Json).len();
        DescriptionCost {
            map_bytes,
            bytes_per_s: map_bytes as f64 / self.fusion.round.period_s,
        }
    }

    /// Checks that every link carries a map in the time of a round, and that rounds come often
    /// enough for followers to notice a silent leader.
    fn check_cost(&self) -> Result<(), DescriptionError> {
        let period_s = self.fusion.round.period_s;
        if !DESCRIBED_PERIODS_S.contains(&period_s) {
            let allowed = format!(
                "{} to {} in a description",
                DESCRIBED_PERIODS_S.start(),
                DESCRIBED_PERIODS_S.end()
            );
            return Err(ConfigError::new("fusion.round.period_s", period_s, allowed).into());
        }
        let DescriptionCost {
            map_bytes,
            bytes_per_s,
        } = self.cost();
        if map_bytes > MAX_DESCRIBED_MAP_BYTES || bytes_per_s > MAX_DESCRIBED_BYTES_PER_S {
            let found = format!(
                "{} entries, maps of {map_bytes} bytes, {bytes_per_s:.0} bytes/s",
                self.landmarks.len()
            );
            let allowed = format!(
                "maps of {MAX_DESCRIBED_MAP_BYTES} bytes, and {MAX_DESCRIBED_BYTES_PER_S:.0} bytes/s at most"
            );
            return Err(ConfigError::new("landmarks", found, allowed).into());
        }
        Ok(())
    }

    /// The shared settings of a node's configuration.
    fn of(config: &NodeConfig) -> Self {
        let sizes = config.object_sizes(None);
        Self {
            fusion: config.fusion.clone(),
            landmarks: config.landmarks.clone(),
            origin: config.origin,
            camera: SharedCamera {
                projection: SharedProjection { sizes },
            },
        }
    }

    pub(super) fn put_into(self, config: &mut NodeConfig) {
        let Self {
            fusion,
            landmarks,
            origin,
            camera:
                SharedCamera {
                    projection: SharedProjection { sizes },
                },
        } = self;
        config.fusion = fusion;
        config.landmarks = landmarks;
        config.origin = origin;
        #[cfg(feature = "camera")]
        if config
            .all_cameras()
            .next()
            .is_some_and(|camera| camera.projection.sizes != sizes)
        {
            for camera in config.camera.iter_mut().chain(&mut config.cameras) {
                camera.projection.sizes = sizes.clone();
            }
        }
        #[cfg(not(feature = "camera"))]
        drop(sizes);
    }
}

impl NodeConfig {
    /// True sizes of objects: the sizes of the first camera, which a description has overlaid, or
    /// without a camera the sizes in the text of a description.
    pub(in crate::node) fn object_sizes(&self, description: Option<&str>) -> ObjectSizes {
        #[cfg(feature = "camera")]
        if let Some(camera) = self.all_cameras().next() {
            return camera.projection.sizes.clone();
        }
        let described = description.and_then(|text| SharedConfig::parse(text).ok());
        described.map_or_else(ObjectSizes::default, |shared| {
            shared.camera.projection.sizes
        })
    }

    /// The configuration with the values of a cell's description.
    ///
    /// # Errors
    /// Returns a [`DescriptionError`], also if the node's own configuration states another value.
    pub fn described(&self, text: &str) -> Result<Self, DescriptionError> {
        let malformed =
            |error: &dyn std::fmt::Display| DescriptionError::Malformed(error.to_string());
        let described =
            serde_json::to_value(SharedConfig::parse(text)?).map_err(|error| malformed(&error))?;
        let table = toml::from_str::<toml::Table>(text).map_err(|error| malformed(&error))?;
        let keys = serde_json::to_value(table).map_err(|error| malformed(&error))?;
        let mut shared =
            serde_json::to_value(SharedConfig::of(self)).map_err(|error| malformed(&error))?;
        for path in leaves(&keys) {
            let Some(value) = at(&described, &path) else {
                continue;
            };
            if at(&self.stated.0, &path).is_some()
                && let Some((within, own, described)) =
                    at(&shared, &path).and_then(|own| difference(own, value))
            {
                return Err(DescriptionError::Contradicts {
                    key: path.join(".") + &within,
                    own,
                    described,
                });
            }
            put(&mut shared, &path, value.clone());
        }
        let shared: SharedConfig =
            serde_json::from_value(shared).map_err(|error| malformed(&error))?;
        let mut config = self.clone();
        shared.put_into(&mut config);
        config.validate()?;
        Ok(config)
    }
}

/// Paths of all values that are not tables.
fn leaves(value: &Value) -> Vec<Vec<String>> {
    let Value::Object(table) = value else {
        return vec![Vec::new()];
    };
    let below = |(key, value): (&String, &Value)| {
        leaves(value)
            .into_iter()
            .map(|path| [vec![key.clone()], path].concat())
            .collect::<Vec<_>>()
    };
    table.iter().flat_map(below).collect()
}

fn at<'a>(value: &'a Value, path: &[String]) -> Option<&'a Value> {
    path.iter().try_fold(value, |value, key| value.get(key))
}

fn put(value: &mut Value, path: &[String], leaf: Value) {
    let Some((key, rest)) = path.split_first() else {
        return *value = leaf;
    };
    if !value.is_object() {
        *value = Value::Object(Map::new());
    }
    if let Value::Object(table) = value {
        put(table.entry(key.clone()).or_insert(Value::Null), rest, leaf);
    }
}

/// The first difference between two values, with both as text: a place in a list, or the whole
/// value.
fn difference(own: &Value, described: &Value) -> Option<(String, String, String)> {
    match (own, described) {
        _ if own == described => None,
        (Value::Array(own), Value::Array(described)) if own.len() == described.len() => {
            let mut pairs = own.iter().zip(described).enumerate();
            pairs.find_map(|(index, (own, described))| {
                difference(own, described)
                    .map(|(within, own, described)| (format!("[{index}]{within}"), own, described))
            })
        }
        (Value::Array(own), Value::Array(described)) => Some((
            String::new(),
            format!("{} entries", own.len()),
            format!("{} entries", described.len()),
        )),
        (Value::Object(own_table), Value::Object(table)) => own_table
            .iter()
            .find_map(|(key, own)| {
                let (within, own, described) =
                    difference(own, table.get(key).unwrap_or(&Value::Null))?;
                Some((format!(".{key}{within}"), own, described))
            })
            .or_else(|| Some((String::new(), own.to_string(), described.to_string()))),
        _ => Some((String::new(), own.to_string(), described.to_string())),
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use serde_json::json;

    use super::*;

    fn own(toml: &str) -> NodeConfig {
        let mut file = tempfile::NamedTempFile::new().unwrap();
        write!(file, "# The node's own.\n{toml}").unwrap();
        NodeConfig::load(Some(file.path()), &json!({ "name": "euclid" })).unwrap()
    }

    const CELL: &str = r#"
        [origin]
        latitude_deg = 52.2
        longitude_deg = 21.0
        rotation_deg = 12
        [fusion.pace]
        gate_m = 1
        [fusion.vote.synonyms]
        vase = "sports ball"
        [[landmarks]]
        id = "slot-0"
        x_m = 0
        y_m = 0.5
        [[landmarks]]
        id = "slot-1"
        x_m = 2.5
        y_m = 0
    "#;

    #[test]
    fn description_fills_missing_keys() {
        let config = own("[fusion.round]\nperiod_s = 0.2\n[fusion.vote.synonyms]\nmug = \"cup\"")
            .described(CELL)
            .unwrap();
        assert_eq!(
            (config.fusion.pace.gate_m, config.fusion.round.period_s),
            (1.0, 0.2)
        );
        assert_eq!(
            config.landmarks.iter().map(|l| &*l.id).collect::<Vec<_>>(),
            ["slot-0", "slot-1"]
        );
        assert_eq!(config.fusion.vote.synonyms.len(), 2, "labels of both");
        let origin = config.origin.unwrap();
        assert_eq!(
            (origin.latitude_deg, origin.height_m, origin.rotation_deg),
            (52.2, 0.0, 12.0)
        );
    }

    #[test]
    fn equal_values_are_no_contradiction() {
        let same = own(
            "[fusion.pace]\ngate_m = 1.0\n[[landmarks]]\nid = \"slot-0\"\nx_m = 0.0\ny_m = 0.5\n\
                        [[landmarks]]\nid = \"slot-1\"\nx_m = 2.5\ny_m = 0.0",
        );
        assert_eq!(same.described(CELL).unwrap().landmarks, same.landmarks);
    }

    #[test]
    fn contradiction_names_both_values() {
        for (toml, parts) in [
            // Equal to the default, but explicitly stated.
            (
                "[fusion.pace]\ngate_m = 0.5",
                ["`fusion.pace.gate_m`", "0.5", "1.0"],
            ),
            (
                "[[landmarks]]\nid = \"slot-0\"\nx_m = 0\ny_m = 0",
                ["`landmarks`", "1 entries", "2 entries"],
            ),
            (
                "[[landmarks]]\nid = \"slot-0\"\nx_m = 0\ny_m = 0.5\n[[landmarks]]\nid = \"slot-1\"\nx_m = 2.6\ny_m = 0",
                ["`landmarks[1].x_m`", "2.6", "2.5"],
            ),
            (
                "[fusion.vote.synonyms]\nvase = \"cup\"",
                ["`fusion.vote.synonyms.vase`", "\"cup\"", "\"sports ball\""],
            ),
            (
                "[origin]\nlatitude_deg = 1\nlongitude_deg = 2",
                ["`origin.latitude_deg`", "1.0", "52.2"],
            ),
        ] {
            let error = own(toml).described(CELL).unwrap_err().to_string();
            assert!(parts.iter().all(|part| error.contains(part)), "{error}");
        }
    }

    #[test]
    fn only_valid_shared_keys_pass() {
        for (toml, parts) in [
            ("name = \"edge\"", ["line 1", "unknown field", "name"]),
            (
                "[fusion.pace]\ngate = 1",
                ["line 2", "unknown field", "gate_m"],
            ),
            (
                "[fusion.pace]\ngate_m = -1",
                ["`fusion.pace.gate_m`", "-1", "0.001"],
            ),
            (
                "[origin]\nlatitude_deg = 91\nlongitude_deg = 0",
                ["`origin.latitude_deg`", "91", "-90 to 90"],
            ),
            (
                "[camera.projection]\npixel_sigma_px = 3",
                ["line 2", "unknown field", "sizes"],
            ),
            (
                "[camera.projection.sizes.labels]\ncar = { width_m = 0, height_m = 1 }",
                ["sizes.labels.car", "0", "0.0001"],
            ),
        ] {
            let error = own("").described(toml).unwrap_err().to_string();
            assert!(parts.iter().all(|part| error.contains(part)), "{error}");
        }
    }

    #[test]
    fn oversized_description_names_cost() {
        let locations = |count: usize| -> String {
            (0..count)
                .map(|n| format!("[[landmarks]]\nid = \"slot-{n}\"\nx_m = {n}\ny_m = 0\n"))
                .collect()
        };
        let error = SharedConfig::parse(&locations(5200))
            .unwrap_err()
            .to_string();
        assert!(
            error.contains("5200 entries") && error.contains("bytes/s") && error.contains("262144"),
            "{error}"
        );
        let cost = SharedConfig::parse(&locations(500)).unwrap().cost();
        assert!((50_000..150_000).contains(&cost.map_bytes), "{cost:?}");
        for period_s in ["0.005", "60"] {
            let error = SharedConfig::parse(&format!("[fusion.round]\nperiod_s = {period_s}"))
                .unwrap_err()
                .to_string();
            assert!(
                error.contains("`fusion.round.period_s`") && error.contains("0.02 to 2"),
                "{error}"
            );
        }
        SharedConfig::parse("[fusion.round]\nperiod_s = 2").unwrap();
    }

    #[cfg(feature = "camera")]
    #[test]
    fn cell_label_sizes_need_camera() {
        let sizes = "[camera.projection.sizes.labels]\ncar = { width_m = 1.8, height_m = 1.5 }";
        let camera = "[camera.source]\nkind = \"v4l2\"\nwidth = 640\nheight = 480\n[camera.detector]\nkind = \"placard\"\n";
        let described = own(camera).described(sizes).unwrap();
        assert_eq!(
            described
                .camera
                .unwrap()
                .projection
                .sizes
                .of("car")
                .unwrap()
                .width_m,
            1.8
        );
        assert_eq!(
            own("").described(sizes).unwrap(),
            own(""),
            "an edge has no camera"
        );
        let other = own(&format!(
            "{camera}[camera.projection.sizes.labels]\ncar = {{ width_m = 2, height_m = 1.5 }}"
        ));
        let error = other.described(sizes).unwrap_err().to_string();
        assert!(
            error.contains("`camera.projection.sizes.labels.car.width_m`"),
            "{error}"
        );
    }
}
