//! The file to which accepted maps are appended.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::PathBuf;
use std::time::Duration;

use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use serde::Serialize;
use tokio::sync::watch;

use crate::messages::newest::ReceivedMap;

/// Time after a failure until the file is opened again.
const RETRY_PAUSE: Duration = Duration::from_secs(60);

/// A file of maps with their times of receipt, one JSON object a line. A disk that refuses it costs its lines only.
pub(super) struct MapLog {
    path: PathBuf,
    cell: NodeName,
    present_cell: watch::Receiver<NodeName>,
    file: Option<BufWriter<File>>,
    retry_at: Timestamp,
}

impl MapLog {
    /// A log of a cell's maps while its vehicle is present there.
    pub(super) fn new(path: PathBuf, cell: NodeName, present_cell: watch::Receiver<NodeName>) -> Self {
        Self { path, cell, present_cell, file: None, retry_at: Timestamp::default() }
    }

    /// Appends a map. A failure is logged, and ends attempts for [`RETRY_PAUSE`].
    pub(super) fn append(&mut self, map: &ReceivedMap) {
        let is_present = *self.present_cell.borrow() == self.cell;
        if !is_present || self.file.is_none() && map.received_at < self.retry_at {
            return;
        }
        if let Err(error) = self.write(map) {
            self.file = None;
            self.retry_at = map.received_at + RETRY_PAUSE;
            let (path, retry_in) = (self.path.display(), RETRY_PAUSE.as_secs());
            tracing::warn!(%path, %error, retry_in_s = retry_in, "maps are not logged; make room, or change `map_log`");
        }
    }

    fn write(&mut self, map: &ReceivedMap) -> io::Result<()> {
        let file = match &mut self.file {
            Some(file) => file,
            None => {
                let file = File::options().create(true).append(true).open(&self.path)?;
                self.file.insert(BufWriter::new(file))
            }
        };
        serde_json::to_writer(&mut *file, &LogLine { cell: &self.cell, map })?;
        file.write_all(b"\n")?;
        file.flush()
    }
}

/// A line of the log; readers take it for a [`ReceivedMap`].
#[derive(Serialize)]
struct LogLine<'a> {
    cell: &'a NodeName,
    #[serde(flatten)]
    map: &'a ReceivedMap,
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use ecod::wire::{GlobalMap, SCHEMA_VERSION};

    use super::*;

    fn map(received_at: Timestamp) -> ReceivedMap {
        let map: GlobalMap = serde_json::from_value(serde_json::json!({
            "schema": SCHEMA_VERSION, "aggregator": "edge", "epoch": 1, "round": 1, "fused_at_us": 0,
            "landmarks": [], "objects": []
        }))
        .unwrap();
        ReceivedMap { received_at, map: Arc::new(map) }
    }

    #[test]
    fn a_log_that_cannot_be_written_is_tried_again_later() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("absent").join("maps.jsonl");
        let cell = NodeName::from_static("lot-1");
        let (present, present_cell) = watch::channel(cell.clone());
        let mut log = MapLog::new(path.clone(), cell, present_cell);
        log.append(&map(Timestamp(0)));
        std::fs::create_dir(path.parent().unwrap()).unwrap();
        log.append(&map(Timestamp(0) + RETRY_PAUSE / 2));
        assert!(!path.exists());
        log.append(&map(Timestamp(0) + RETRY_PAUSE));
        log.append(&map(Timestamp(0) + RETRY_PAUSE));
        present.send_replace(NodeName::from_static("lot-2"));
        log.append(&map(Timestamp(0) + RETRY_PAUSE));
        let lines = std::fs::read_to_string(&path).unwrap();
        let logged: Vec<ReceivedMap> = lines.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
        assert_eq!(logged, [map(Timestamp(0) + RETRY_PAUSE), map(Timestamp(0) + RETRY_PAUSE)]);
        assert!(lines.lines().all(|line| line.starts_with(r#"{"cell":"lot-1","received_at_us":"#)), "{lines}");
    }
}
