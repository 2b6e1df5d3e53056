//! Configuration of the log: directory, contents and limits.

use std::fmt;
use std::path::PathBuf;
use std::time::Duration;

use ecod::config::{ConfigError, check_range};
use ecod::model::names::NodeName;
use schemars::JsonSchema;
use serde::de::value::MapAccessDeserializer;
use serde::de::{MapAccess, Visitor};
use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// The log of a node; `record = "DIR"` is short for a table with `dir` alone.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(remote = "Self", default, deny_unknown_fields)]
pub struct RecordConfig {
    /// Directory of the log, created if missing. Required.
    pub dir: PathBuf,
    /// Name under which the log is kept. Default: the node's name. An observer's own name would
    /// differ in every process.
    #[serde(skip)]
    pub name: Option<NodeName>,
    /// Maximum size of a file in megabytes. Default 256. Trade-off: smaller files lose less to a
    /// broken disk and copy faster; larger ones are fewer.
    pub max_file_mb: u64,
    /// Maximum age of a file in seconds. Default 3600.
    pub max_file_s: u64,
    /// Maximum megabytes of this node's files in the directory; the oldest are deleted first.
    /// Default 4096.
    pub max_total_mb: u64,
    /// Free megabytes below which recording pauses. Default 256. Losses are counted; the disk is
    /// checked every second.
    pub min_free_mb: u64,
    /// Maximum entries queued for the disk. Default 4096. Further entries are dropped and counted.
    pub queue: usize,
    /// Whether to write drawings for Foxglove and Lichtblick, which double the log. Default true.
    pub drawable: bool,
    /// Whether a node that cannot lead records all reports of its cell. Default false. A node that
    /// may lead always records them.
    pub reports: bool,
    /// Camera images per second, as JPEG. Default 0, which disables them. Each takes 50 to 100 kB
    /// at 640x480.
    pub camera_hz: f64,
    /// Port on 127.0.0.1 that serves the log live to Foxglove and Lichtblick. Default: not set. The
    /// viewers expect 8765; 0 takes a free port.
    #[cfg(feature = "foxglove")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub live_port: Option<u16>,
}

impl Default for RecordConfig {
    fn default() -> Self {
        Self {
            dir: PathBuf::new(),
            name: None,
            max_file_mb: 256,
            max_file_s: 3600,
            max_total_mb: 4096,
            min_free_mb: 256,
            queue: 4096,
            drawable: true,
            reports: false,
            camera_hz: 0.0,
            #[cfg(feature = "foxglove")]
            live_port: None,
        }
    }
}

impl RecordConfig {
    /// The defaults, in `dir`.
    pub fn new(dir: impl Into<PathBuf>) -> Self {
        Self {
            dir: dir.into(),
            ..Self::default()
        }
    }

    /// Checks every value, but not whether the directory can be written.
    ///
    /// # Errors
    /// Returns a [`ConfigError`] with the key, the value and the allowed range.
    pub fn validate(&self) -> Result<(), ConfigError> {
        if self.dir.as_os_str().is_empty() {
            return Err(ConfigError::missing("dir", "the directory of the log"));
        }
        check_range("max_file_mb", self.max_file_mb as f64, 1.0, 1e6)?;
        check_range("max_file_s", self.max_file_s as f64, 1.0, 1e7)?;
        check_range(
            "max_total_mb",
            self.max_total_mb as f64,
            self.max_file_mb as f64,
            1e9,
        )?;
        check_range("min_free_mb", self.min_free_mb as f64, 0.0, 1e9)?;
        check_range("queue", self.queue as f64, 16.0, 1e6)?;
        check_range("camera_hz", self.camera_hz, 0.0, 60.0)
    }

    pub(crate) fn max_file_bytes(&self) -> u64 {
        self.max_file_mb * MEGABYTE
    }

    pub(crate) fn max_file_age(&self) -> Duration {
        Duration::from_secs(self.max_file_s)
    }

    /// Maximum bytes of all files except the one being written.
    pub(crate) fn max_old_bytes(&self) -> u64 {
        (self.max_total_mb - self.max_file_mb) * MEGABYTE
    }

    pub(crate) fn min_free_bytes(&self) -> u64 {
        self.min_free_mb * MEGABYTE
    }
}

const MEGABYTE: u64 = 1_000_000;

impl Serialize for RecordConfig {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        Self::serialize(self, serializer)
    }
}

impl<'de> Deserialize<'de> for RecordConfig {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(DirectoryOrTable)
    }
}

struct DirectoryOrTable;

impl<'de> Visitor<'de> for DirectoryOrTable {
    type Value = RecordConfig;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a directory or a table with `dir`")
    }

    fn visit_str<E>(self, dir: &str) -> Result<RecordConfig, E> {
        Ok(RecordConfig::new(dir))
    }

    fn visit_map<M: MapAccess<'de>>(self, map: M) -> Result<RecordConfig, M::Error> {
        // The derived function, which takes a table only.
        RecordConfig::deserialize(MapAccessDeserializer::new(map))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, Deserialize)]
    struct Node {
        record: RecordConfig,
    }

    fn read(toml: &str) -> Result<RecordConfig, String> {
        let node: Node = toml::from_str(toml).map_err(|error| error.to_string())?;
        node.record.validate().map_err(|error| error.to_string())?;
        Ok(node.record)
    }

    #[test]
    fn directory_or_table_is_accepted() {
        let defaults = RecordConfig::new("/log");
        assert_eq!(read("record = \"/log\""), Ok(defaults.clone()));
        let expected = RecordConfig {
            max_file_mb: 5,
            camera_hz: 2.0,
            ..defaults
        };
        assert_eq!(
            read("[record]\ndir = \"/log\"\nmax_file_mb = 5\ncamera_hz = 2.0"),
            Ok(expected.clone())
        );
        let shown = toml::to_string(&expected).unwrap();
        assert_eq!(toml::from_str::<RecordConfig>(&shown).unwrap(), expected);
    }

    #[test]
    fn errors_name_the_key() {
        for (toml, part) in [
            ("record = \"\"", "dir"),
            ("record = 3", "a directory or a table"),
            ("[record]\nmax_file_mb = 1", "dir"),
            ("[record]\ndir = \"x\"\nmax_mb = 1", "max_mb"),
            ("[record]\ndir = \"x\"\nmax_total_mb = 1", "max_total_mb"),
            ("[record]\ndir = \"x\"\ncamera_hz = nan", "camera_hz"),
        ] {
            let error = read(toml).unwrap_err();
            assert!(error.contains(part), "{toml}: {error}");
        }
    }
}
