//! Identity of a log: the recording node and its configuration, a metadata record of every file.

use std::collections::BTreeMap;

use ecod::aggregator::FusionConfig;
use ecod::model::names::NodeName;
use ecod::perception::landmark::LandmarkConfig;
use uuid::Uuid;

/// The recording node and the configuration of its aggregator.
#[derive(Debug, Clone, PartialEq)]
pub struct LogIdentity {
    /// Version of the log format, [`LogIdentity::VERSION`].
    pub log: u64,
    /// Name of the recording node.
    pub node: NodeName,
    /// Name of the cell of that node.
    pub cell: NodeName,
    /// The run of the node.
    pub run: Uuid,
    /// Version of the program.
    pub version: String,
    /// Configuration of the fusion.
    pub fusion: FusionConfig,
    /// Landmarks of the cell.
    pub landmarks: Vec<LandmarkConfig>,
}

/// A log whose metadata cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum LogIdentityError {
    /// A key is missing or has an unusable value.
    #[error("metadata `{key}` of the log cannot be used: {reason}")]
    Key {
        /// Key of the metadata record.
        key: &'static str,
        /// Description of the problem.
        reason: String,
    },
}

impl LogIdentity {
    /// Version of the log format that this program writes; it also reads earlier ones.
    pub const VERSION: u64 = 1;

    /// Name of the metadata record.
    pub const RECORD: &'static str = "ecod.log";

    /// Identity of a log that this program writes for `node`.
    pub fn new(
        node: NodeName,
        run: Uuid,
        cell: NodeName,
        fusion: FusionConfig,
        landmarks: Vec<LandmarkConfig>,
    ) -> Self {
        let version = env!("CARGO_PKG_VERSION").into();
        Self {
            log: Self::VERSION,
            node,
            cell,
            run,
            version,
            fusion,
            landmarks,
        }
    }

    /// Content of the metadata record, by its keys.
    pub(crate) fn to_map(&self) -> BTreeMap<String, String> {
        let json = |value: serde_json::Result<String>| value.unwrap_or_default();
        [
            ("log", self.log.to_string()),
            ("node", self.node.to_string()),
            ("cell", self.cell.to_string()),
            ("run", self.run.to_string()),
            ("version", self.version.clone()),
            ("fusion", json(serde_json::to_string(&self.fusion))),
            ("landmarks", json(serde_json::to_string(&self.landmarks))),
        ]
        .map(|(key, value)| (key.to_owned(), value))
        .into()
    }

    /// Version in a record, if it has one.
    pub(crate) fn version_in(map: &BTreeMap<String, String>) -> Option<u64> {
        map.get("log")?.parse().ok()
    }

    /// Node in a record, even if the rest is unusable.
    pub(crate) fn node_in(map: &BTreeMap<String, String>) -> Option<NodeName> {
        NodeName::new(map.get("node")?).ok()
    }

    /// Reads the record's content.
    ///
    /// # Errors
    /// Returns a [`LogIdentityError`] that names the first key that cannot be used.
    pub(crate) fn from_map(map: &BTreeMap<String, String>) -> Result<Self, LogIdentityError> {
        let fusion: FusionConfig = json(map, "fusion")?;
        fusion
            .validate()
            .map_err(|error| unusable("fusion", &error))?;
        let landmarks: Vec<LandmarkConfig> = json(map, "landmarks")?;
        LandmarkConfig::validate_all(&landmarks).map_err(|error| unusable("landmarks", &error))?;
        Ok(Self {
            log: Self::version_in(map).ok_or_else(|| unusable("log", &"not a number"))?,
            node: NodeName::new(text(map, "node")?).map_err(|error| unusable("node", &error))?,
            cell: NodeName::new(text(map, "cell")?).map_err(|error| unusable("cell", &error))?,
            run: text(map, "run")?
                .parse()
                .map_err(|error| unusable("run", &error))?,
            version: text(map, "version")?.to_owned(),
            fusion,
            landmarks,
        })
    }
}

fn text<'a>(
    map: &'a BTreeMap<String, String>,
    key: &'static str,
) -> Result<&'a str, LogIdentityError> {
    map.get(key)
        .map(String::as_str)
        .ok_or_else(|| unusable(key, &"missing"))
}

fn json<T: serde::de::DeserializeOwned>(
    map: &BTreeMap<String, String>,
    key: &'static str,
) -> Result<T, LogIdentityError> {
    serde_json::from_str(text(map, key)?).map_err(|error| unusable(key, &error))
}

fn unusable(key: &'static str, reason: &dyn std::fmt::Display) -> LogIdentityError {
    LogIdentityError::Key {
        key,
        reason: reason.to_string(),
    }
}
