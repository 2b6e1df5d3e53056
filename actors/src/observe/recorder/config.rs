//! What is recorded, where, and how much of it is kept.

use std::fmt;
use std::path::PathBuf;
use std::time::Duration;

use ecod::config::{ConfigError, check_range};
use ecod::names::NodeName;
use serde::de::value::MapAccessDeserializer;
use serde::de::{MapAccess, Visitor};
use serde::{Deserialize, Deserializer, Serialize};

/// The log of a node; `record = "DIR"` stands for a table with `dir` alone.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RecordConfig {
    /// Directory of the log; it is made when it is not there. Required.
    pub dir: PathBuf,
    /// Whose log it is said to be; default the node's. Observers are named for their process, their logs are not.
    #[serde(skip)]
    pub name: Option<NodeName>,
    /// A file is closed and the next begun when it has as many megabytes; default 256. Smaller files lose less to a
    /// broken disk and copy sooner, larger ones are fewer.
    pub max_file_mb: u64,
    /// A file is closed and the next begun after so many seconds; default 3600.
    pub max_file_s: u64,
    /// Most megabytes of this node's files in the directory; default 4096. The oldest are deleted first.
    pub max_total_mb: u64,
    /// Megabytes that must stay free on the disk; default 256. With less, recording pauses, which is counted.
    pub min_free_mb: u64,
    /// Entries that may wait for the disk; default 4096. When full, new ones are dropped and counted.
    pub queue: usize,
    /// Whether scenes and transforms are written that Foxglove and Lichtblick draw; default true. They double the log.
    pub drawable: bool,
    /// Whether a node that never leads takes all reports of its cell to record them; default false. A node that may
    /// lead takes them anyway.
    pub reports: bool,
    /// ImageRecorder of the camera a second, as JPEG; default 0, none. Each has some 50 to 100 kB at 640x480.
    pub camera_hz: f64,
    /// Port on 127.0.0.1 where Foxglove and Lichtblick see live what is recorded; default none. 8765 is what they ask
    /// for, 0 a free one.
    #[cfg(feature = "foxglove")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub live_port: Option<u16>,
}

impl RecordConfig {
    /// The defaults, in `dir`.
    pub fn new(dir: impl Into<PathBuf>) -> Self {
        Self {
            dir: dir.into(),
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

    /// Checks every value; whether the directory can be written shows when it is.
    ///
    /// # Errors
    /// [`ConfigError`] with the key, the value and what is allowed.
    pub fn validate(&self) -> Result<(), ConfigError> {
        if self.dir.as_os_str().is_empty() {
            return Err(ConfigError::new("dir", "\"\"", "a directory"));
        }
        check_range("max_file_mb", self.max_file_mb as f64, 1.0, 1e6)?;
        check_range("max_file_s", self.max_file_s as f64, 1.0, 1e7)?;
        check_range("max_total_mb", self.max_total_mb as f64, self.max_file_mb as f64, 1e9)?;
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

    /// What older files may use beside the one being written.
    pub(crate) fn max_old_bytes(&self) -> u64 {
        (self.max_total_mb - self.max_file_mb) * MEGABYTE
    }

    pub(crate) fn min_free_bytes(&self) -> u64 {
        self.min_free_mb * MEGABYTE
    }
}

const MEGABYTE: u64 = 1_000_000;

/// The table; every key but `dir` may be left out.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Table {
    dir: PathBuf,
    max_file_mb: Option<u64>,
    max_file_s: Option<u64>,
    max_total_mb: Option<u64>,
    min_free_mb: Option<u64>,
    queue: Option<usize>,
    drawable: Option<bool>,
    reports: Option<bool>,
    camera_hz: Option<f64>,
    #[cfg(feature = "foxglove")]
    live_port: Option<u16>,
}

impl From<Table> for RecordConfig {
    fn from(table: Table) -> Self {
        let default = Self::new(table.dir);
        Self {
            max_file_mb: table.max_file_mb.unwrap_or(default.max_file_mb),
            max_file_s: table.max_file_s.unwrap_or(default.max_file_s),
            max_total_mb: table.max_total_mb.unwrap_or(default.max_total_mb),
            min_free_mb: table.min_free_mb.unwrap_or(default.min_free_mb),
            queue: table.queue.unwrap_or(default.queue),
            drawable: table.drawable.unwrap_or(default.drawable),
            reports: table.reports.unwrap_or(default.reports),
            camera_hz: table.camera_hz.unwrap_or(default.camera_hz),
            #[cfg(feature = "foxglove")]
            live_port: table.live_port,
            dir: default.dir,
            name: None,
        }
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
        Table::deserialize(MapAccessDeserializer::new(map)).map(RecordConfig::from)
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
    fn a_directory_alone_or_a_table_will_do() {
        let defaults = RecordConfig::new("/log");
        assert_eq!(read("record = \"/log\""), Ok(defaults.clone()));
        let expected = RecordConfig { max_file_mb: 5, camera_hz: 2.0, ..defaults };
        assert_eq!(read("[record]\ndir = \"/log\"\nmax_file_mb = 5\ncamera_hz = 2.0"), Ok(expected.clone()));
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
