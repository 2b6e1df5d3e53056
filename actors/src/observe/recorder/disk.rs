//! Files of a log on disk: names, free space and deletion.

use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};

use chrono::DateTime;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use rustix::fs::statvfs;

/// Extension of log files.
pub const EXTENSION: &str = "mcap";

/// Maximum number of files that begin in the same second.
const MAX_FILES_PER_SECOND: u32 = 1000;

/// Creates a log file that begins `at`, such as `euclid-20261121T100500Z-000.mcap`. Names sort by
/// time.
///
/// # Errors
/// Returns the operating system's error, or an error if fewer than `min_free` bytes are free.
pub(crate) fn create(
    dir: &Path,
    node: &NodeName,
    at: Timestamp,
    min_free: u64,
) -> io::Result<(PathBuf, File)> {
    check_room(dir, min_free)?;
    let seconds = i64::try_from(at.micros() / 1_000_000).unwrap_or_default();
    let time = DateTime::from_timestamp(seconds, 0)
        .unwrap_or_default()
        .format("%Y%m%dT%H%M%SZ");
    for number in 0..MAX_FILES_PER_SECOND {
        let path = dir.join(format!("{node}-{time}-{number:03}.{EXTENSION}"));
        match File::create_new(&path) {
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
            created => return created.map(|file| (path, file)),
        }
    }
    Err(io::Error::new(
        io::ErrorKind::AlreadyExists,
        format!("{MAX_FILES_PER_SECOND} files began in the same second"),
    ))
}

/// Checks that the disk has room for a log.
///
/// # Errors
/// Returns the operating system's error, or an error if fewer than `min_free` bytes are free.
pub(crate) fn check_room(dir: &Path, min_free: u64) -> io::Result<()> {
    let free = free_bytes(dir)?;
    if free < min_free {
        let message = format!(
            "{} MB are free and `record.min_free_mb` is {}",
            free / 1_000_000,
            min_free / 1_000_000
        );
        return Err(io::Error::new(io::ErrorKind::StorageFull, message));
    }
    Ok(())
}

/// Bytes on the disk of `dir` that an unprivileged program may still write.
///
/// # Errors
/// Returns the operating system's error.
pub fn free_bytes(dir: &Path) -> io::Result<u64> {
    let disk = statvfs(dir)?;
    Ok(disk.f_bavail.saturating_mul(disk.f_frsize))
}

/// The log files of a directory in the order of their names.
///
/// # Errors
/// Returns the operating system's error about the directory.
pub fn files(dir: &Path) -> io::Result<Vec<PathBuf>> {
    let is_log = |path: &PathBuf| {
        path.extension()
            .is_some_and(|extension| extension == EXTENSION)
    };
    let mut files: Vec<_> = fs::read_dir(dir)?
        .filter_map(|entry| Some(entry.ok()?.path()))
        .filter(is_log)
        .collect();
    files.sort();
    Ok(files)
}

/// Deletes this node's oldest files until the rest has at most `max_bytes`; returns the number
/// deleted.
///
/// # Errors
/// Returns the operating system's error.
pub(crate) fn prune(dir: &Path, node: &NodeName, max_bytes: u64) -> io::Result<usize> {
    let mut kept = 0;
    let mut deleted = 0;
    for path in files(dir)?
        .into_iter()
        .rev()
        .filter(|path| is_of(path, node))
    {
        kept += path.metadata()?.len();
        if kept > max_bytes {
            fs::remove_file(&path)?;
            deleted += 1;
        }
    }
    Ok(deleted)
}

/// True if a file belongs to the node: exactly a time and a number follow, as one name may begin
/// with another.
fn is_of(path: &Path, node: &NodeName) -> bool {
    let name = path.file_stem().and_then(|stem| stem.to_str());
    let rest = name.and_then(|name| name.strip_prefix(node.as_str())?.strip_prefix('-'));
    rest.and_then(|rest| rest.split_once('-'))
        .is_some_and(|(time, number)| {
            time.len() == "20261121T100500Z".len()
                && number.bytes().all(|byte| byte.is_ascii_digit())
        })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn name(text: &str) -> NodeName {
        NodeName::new(text).unwrap()
    }

    #[test]
    fn only_oldest_node_files_removed() {
        let dir = tempfile::tempdir().unwrap();
        let at = |s: u64| Timestamp(1_732_154_400_000_000 + s * 1_000_000);
        for (node, second) in [
            ("cav", 0),
            ("cav", 0),
            ("cav", 7),
            ("cav-2", 0),
            ("cav", 4000),
        ] {
            let (path, _) = create(dir.path(), &name(node), at(second), 0).unwrap();
            fs::write(path, [0; 100]).unwrap();
        }
        fs::write(dir.path().join("cav-notes.txt"), "mine").unwrap();
        assert_eq!(prune(dir.path(), &name("cav"), 250).unwrap(), 2);
        let left: Vec<_> = files(dir.path()).unwrap();
        let left: Vec<_> = left
            .iter()
            .map(|path| path.file_name().unwrap().to_str().unwrap())
            .collect();
        assert_eq!(
            left,
            [
                "cav-2-20241121T020000Z-000.mcap",
                "cav-20241121T020007Z-000.mcap",
                "cav-20241121T030640Z-000.mcap"
            ]
        );
        assert!(dir.path().join("cav-notes.txt").exists());
    }

    #[test]
    fn nearly_full_disk_stays_untouched() {
        let dir = tempfile::tempdir().unwrap();
        let error = create(dir.path(), &name("cav"), Timestamp(0), u64::MAX).unwrap_err();
        assert_eq!(error.kind(), io::ErrorKind::StorageFull);
        assert!(error.to_string().contains("record.min_free_mb"), "{error}");
    }
}
