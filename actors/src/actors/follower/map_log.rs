//! The file to which accepted maps are appended.

use std::fs::{self, File};
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::time::Duration;

use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use serde::Serialize;
use tokio::sync::watch;

use crate::messages::newest::ReceivedMap;

/// Time after a failure until the file is opened again.
const RETRY_PAUSE: Duration = Duration::from_secs(10);

/// Size from which a log is renamed to `….1`, replacing the previous one, and a new log is started.
/// The disk therefore holds two of them at most.
const MAX_BYTES: u64 = 512 * 1024 * 1024;

/// Maximum length of half a line that is removed: the largest map by default.
const MAX_TORN_BYTES: u64 = 16 * 1024 * 1024;

/// Beginning of each line of the log.
const LINE_BEGIN: &[u8] = b"{\"cell\":";

/// A file of maps with their times of receipt, one JSON object per line. If the disk fails, only
/// the log's lines are lost.
pub(super) struct MapLog {
    path: PathBuf,
    cell: NodeName,
    present_cell: watch::Receiver<NodeName>,
    /// The file and its size in bytes.
    file: Option<(File, u64)>,
    retry_at: Timestamp,
}

impl MapLog {
    /// A log of a cell's maps while its vehicle is present there.
    pub(super) fn new(
        path: PathBuf,
        cell: NodeName,
        present_cell: watch::Receiver<NodeName>,
    ) -> Self {
        Self {
            path,
            cell,
            present_cell,
            file: None,
            retry_at: Timestamp::default(),
        }
    }

    /// Appends a map. A failure is logged, and suspends attempts for [`RETRY_PAUSE`].
    pub(super) fn append(&mut self, map: &ReceivedMap) {
        let is_present = *self.present_cell.borrow() == self.cell;
        if !is_present || self.file.is_none() && map.received_at < self.retry_at {
            return;
        }
        if let Err(error) = self.write(map) {
            self.file = None;
            self.retry_at = map.received_at + RETRY_PAUSE;
            let path = self.path.display();
            let retry_in = RETRY_PAUSE.as_secs();
            tracing::warn!(%path, %error, retry_in_s = retry_in, "maps are not logged; make room, or change `map_log`");
        }
    }

    /// Appends one line. A log that has become too large is renamed first; a file that is opened
    /// anew loses an incomplete last line.
    ///
    /// # Errors
    /// Returns the error of the operating system.
    fn write(&mut self, map: &ReceivedMap) -> io::Result<()> {
        let mut line = serde_json::to_vec(&LogLine {
            cell: &self.cell,
            map,
        })?;
        line.push(b'\n');
        if self
            .file
            .as_ref()
            .is_some_and(|(_, bytes)| *bytes >= MAX_BYTES)
        {
            self.file = None;
            fs::rename(&self.path, with_suffix(&self.path, ".1"))?;
        }
        let (file, bytes) = match &mut self.file {
            Some(file) => file,
            None => {
                let mut file = File::options()
                    .create(true)
                    .read(true)
                    .append(true)
                    .open(&self.path)?;
                let bytes = remove_torn_line(&mut file)?;
                self.file.insert((file, bytes))
            }
        };
        *bytes += line.len() as u64;
        file.write_all(&line)
    }
}

/// The path with a suffix after the whole name of the file.
fn with_suffix(path: &Path, suffix: &str) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(suffix);
    name.into()
}

/// Removes half a line at the end, as a crash or a full disk leaves it, and returns the size of the
/// file. Other text at the end stays, followed by a line break.
fn remove_torn_line(file: &mut File) -> io::Result<u64> {
    let bytes = file.seek(SeekFrom::End(0))?;
    let tail_bytes = bytes.min(MAX_TORN_BYTES);
    file.seek(SeekFrom::Start(bytes - tail_bytes))?;
    let mut tail = vec![0; tail_bytes as usize];
    file.read_exact(&mut tail)?;
    let ends = tail.iter().rposition(|byte| *byte == b'\n');
    let torn = &tail[ends.map_or(0, |end| end + 1)..];
    if torn.is_empty() {
        return Ok(bytes);
    }
    let is_ours = ends.is_some() || tail_bytes == bytes;
    if is_ours && (torn.starts_with(LINE_BEGIN) || LINE_BEGIN.starts_with(torn)) {
        let whole = bytes - torn.len() as u64;
        file.set_len(whole)?;
        return Ok(whole);
    }
    file.write_all(b"\n")?;
    Ok(bytes + 1)
}

/// A line of the log, in the format of [`ReceivedMap`].
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
        ReceivedMap {
            received_at,
            map: Arc::new(map),
        }
    }

    #[test]
    fn partial_line_is_removed() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("maps.jsonl");
        let cell = NodeName::from_static("lot-1");
        let (_present, present_cell) = watch::channel(cell.clone());
        let new_log = || MapLog::new(path.clone(), cell.clone(), present_cell.clone());
        let torn = "{\"cell\":\"lot-1\",\"received_at_us\":17,\"sch";
        for cut in 1..torn.len() {
            std::fs::write(&path, "").unwrap();
            new_log().append(&map(Timestamp(1)));
            let before = std::fs::read_to_string(&path).unwrap();
            std::fs::write(&path, before + &torn[..cut]).unwrap();
            new_log().append(&map(Timestamp(2)));
            let lines = std::fs::read_to_string(&path).unwrap();
            let whole: Vec<ReceivedMap> = lines
                .lines()
                .map(|line| serde_json::from_str(line).unwrap())
                .collect();
            assert_eq!(whole, [map(Timestamp(1)), map(Timestamp(2))], "{cut}");
        }
    }

    #[test]
    fn foreign_text_is_kept() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("notes.txt");
        std::fs::write(&path, "a note").unwrap();
        let cell = NodeName::from_static("lot-1");
        let (_present, present_cell) = watch::channel(cell.clone());
        MapLog::new(path.clone(), cell, present_cell).append(&map(Timestamp(1)));
        let lines = std::fs::read_to_string(&path).unwrap();
        assert!(lines.starts_with("a note\n{") && lines.lines().count() == 2);
    }

    #[test]
    fn large_log_is_rotated() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("maps.jsonl");
        File::create(&path).unwrap().set_len(MAX_BYTES).unwrap();
        let cell = NodeName::from_static("lot-1");
        let (_present, present_cell) = watch::channel(cell.clone());
        let mut log = MapLog::new(path.clone(), cell, present_cell);
        log.append(&map(Timestamp(1)));
        log.append(&map(Timestamp(2)));
        let size = |name: &str| {
            std::fs::metadata(directory.path().join(name))
                .unwrap()
                .len()
        };
        assert!(size("maps.jsonl.1") > MAX_BYTES && size("maps.jsonl") < 1000);
    }

    #[test]
    fn unwritable_log_is_retried() {
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
        let logged: Vec<ReceivedMap> = lines
            .lines()
            .map(|line| serde_json::from_str(line).unwrap())
            .collect();
        assert_eq!(
            logged,
            [
                map(Timestamp(0) + RETRY_PAUSE),
                map(Timestamp(0) + RETRY_PAUSE)
            ]
        );
        assert!(
            lines
                .lines()
                .all(|line| line.starts_with(r#"{"cell":"lot-1","received_at_us":"#)),
            "{lines}"
        );
    }
}
