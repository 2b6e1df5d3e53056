//! State files that survive crashes: they contain the last complete state or its predecessor, but
//! not a mixture.
//!
//! ```text
//! ecod-state 1 <SHA-256 of the rest, 64 hexadecimal digits>
//! <the state as JSON>
//! ```
//!
//! A file that was damaged, or edited by hand, does not have its checksum. It is set aside, and the
//! node starts without it. Files of early versions are JSON alone; they are read as they are, and
//! get a checksum when they are next written.

use std::fs::{self, File, OpenOptions};
use std::io::{self, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

use ecod::model::names::NodeName;
use ring::digest::{SHA256, digest};
use rustix::fs::OFlags;
use serde::Serialize;
use serde::de::DeserializeOwned;
use tracing::field::display;

use crate::platform::bounded_file;

/// File of one kind of state of a node.
#[derive(Debug, Clone)]
pub struct StateFile {
    path: PathBuf,
}

/// Maximum length of a state file in bytes.
const MAX_BYTES: u64 = 64 * 1024 * 1024;

/// Beginning of a file with a checksum: kind and version.
const HEADER: &str = "ecod-state 1 ";

impl StateFile {
    /// The file `<cell>.<node>.<what>.json` in `directory`, so that the nodes of a machine can
    /// share a directory.
    pub fn new(directory: &Path, cell: &NodeName, node: &NodeName, what: &str) -> Self {
        Self {
            path: directory.join(format!("{cell}.{node}.{what}.json")),
        }
    }

    /// Lock on the state of a node, which its process holds as long as it runs.
    ///
    /// # Errors
    /// Returns an error if another process holds it, or the directory cannot be written.
    pub fn lock(directory: &Path, cell: &NodeName, node: &NodeName) -> io::Result<File> {
        fs::create_dir_all(directory)?;
        let file = OpenOptions::new()
            .write(true)
            .create(true)
            .truncate(false)
            // Opening a pipe would wait for a reader.
            .custom_flags(OFlags::NONBLOCK.bits() as i32)
            .open(directory.join(format!("{cell}.{node}.lock")))?;
        file.try_lock()?;
        Ok(file)
    }

    /// Path of the file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The last written state, if it is undamaged and `is_ours` accepts it. Any other content is
    /// set aside with a warning.
    pub fn load<T: DeserializeOwned>(&self, is_ours: impl FnOnce(&T) -> bool) -> Option<T> {
        let bytes = match bounded_file::read(&self.path, MAX_BYTES) {
            Ok(bytes) => bytes,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return None,
            Err(error) => {
                tracing::warn!(path = %self.path.display(), %error, "state not read");
                return None;
            }
        };
        let why = match parse(&bytes) {
            Ok(state) if is_ours(&state) => return Some(state),
            Ok(_) => "it belongs to another node or version".into(),
            Err(why) => why,
        };
        self.set_aside(&why);
        None
    }

    /// The state that another process keeps in this file. The file is not changed.
    ///
    /// # Errors
    /// Returns an error if the file is missing or damaged.
    pub fn peek<T: DeserializeOwned>(&self) -> io::Result<T> {
        parse(&bounded_file::read(&self.path, MAX_BYTES)?).map_err(io::Error::other)
    }

    /// Renames the file to `….set-aside`, with a warning that contains the reason.
    pub fn set_aside(&self, why: &str) {
        let aside_path = self.path.with_extension("set-aside");
        let failure = fs::rename(&self.path, &aside_path).err().map(display);
        let path = self.path.display();
        let aside = aside_path.display();
        tracing::warn!(
            %path, %aside, why, failure,
            "state set aside, the node goes on without it; to use a copy of yours, put it there while the node is stopped"
        );
    }

    /// Deletes the file; true if there was one.
    ///
    /// # Errors
    /// Returns an error if the directory refuses it.
    pub fn delete(&self) -> io::Result<bool> {
        match fs::remove_file(&self.path) {
            Ok(()) => Ok(true),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(false),
            Err(error) => Err(error),
        }
    }

    /// Replaces the state. After `Ok` it survives a loss of power.
    ///
    /// # Errors
    /// Returns an error if the directory or disk refuses it; the state before is then still there.
    pub fn save<T: Serialize>(&self, state: &T) -> io::Result<()> {
        fs::create_dir_all(self.path.parent().unwrap_or(Path::new(".")))?;
        replace_file(
            &self.path,
            &with_checksum(&serde_json::to_vec(state)?),
            0o666,
        )
    }
}

/// The state in the bytes of a file.
fn parse<T: DeserializeOwned>(bytes: &[u8]) -> Result<T, String> {
    serde_json::from_slice(content(bytes)?).map_err(|error| error.to_string())
}

/// The bytes of a file with this state.
pub(crate) fn with_checksum(state: &[u8]) -> Vec<u8> {
    [HEADER.as_bytes(), checksum(state).as_bytes(), b"\n", state].concat()
}

/// The bytes of the state in a file with a correct checksum; without a header, the whole file.
///
/// # Errors
/// Returns the flaw if the checksum is wrong.
pub(crate) fn content(bytes: &[u8]) -> Result<&[u8], String> {
    let Some(rest) = bytes.strip_prefix(HEADER.as_bytes()) else {
        return Ok(bytes);
    };
    let (found, rest) = rest.split_at(rest.len().min(2 * SHA256.output_len()));
    let state = rest
        .strip_prefix(b"\n")
        .filter(|state| found == checksum(state).as_bytes());
    state.ok_or_else(|| "it is damaged: its checksum differs".into())
}

fn checksum(state: &[u8]) -> String {
    hex::encode(digest(&SHA256, state))
}

/// Replaces a file atomically, with permissions `mode` minus the process's umask. After `Ok` it
/// survives a loss of power.
///
/// # Errors
/// Returns an error if the directory or disk refuses it; the file before is then still there.
pub(crate) fn replace_file(path: &Path, bytes: &[u8], mode: u32) -> io::Result<()> {
    let temporary = path.with_extension("tmp");
    // A temporary file that was left over would keep its own permissions.
    match fs::remove_file(&temporary) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
        _ => {}
    }
    let mut file = OpenOptions::new()
        .write(true)
        .create_new(true)
        .mode(mode)
        .open(&temporary)?;
    file.write_all(bytes)?;
    file.sync_all()?;
    fs::rename(&temporary, path)?;
    File::open(path.parent().unwrap_or(Path::new(".")))?.sync_all()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file(directory: &Path) -> StateFile {
        StateFile::new(
            directory,
            &NodeName::from_static("lot-1"),
            &NodeName::from_static("edge"),
            "numbers",
        )
    }

    #[test]
    fn half_write_keeps_saved_state() {
        let directory = tempfile::tempdir().unwrap();
        let file = file(&directory.path().join("made/on/demand"));
        assert_eq!(file.load::<Vec<u32>>(|_| true), None);
        file.save(&[1, 2]).unwrap();
        file.save(&[1, 2, 3]).unwrap();
        fs::write(file.path().with_extension("tmp"), b"[1,2,3,").unwrap();
        assert_eq!(file.load(|_| true), Some(vec![1, 2, 3]));
    }

    #[test]
    fn alien_files_are_set_aside() {
        let directory = tempfile::tempdir().unwrap();
        let file = file(directory.path());
        for content in [&b"[1,2"[..], b"", b"\xff\xfe", b"{\"other\":1}"] {
            fs::write(file.path(), content).unwrap();
            assert_eq!(file.load::<Vec<u32>>(|_| true), None);
            assert!(!file.path().exists());
            assert_eq!(
                fs::read(file.path().with_extension("set-aside")).unwrap(),
                content
            );
        }
        file.save(&[7]).unwrap();
        assert_eq!(file.load::<Vec<u32>>(|_| false), None, "not ours");
        assert!(!file.path().exists());
    }

    #[test]
    fn old_file_version_gains_checksum() {
        let directory = tempfile::tempdir().unwrap();
        let file = file(directory.path());
        fs::write(file.path(), b"[1,2,3]").unwrap();
        let read: Vec<u32> = file.load(|_| true).unwrap();
        file.save(&read).unwrap();
        assert!(fs::read_to_string(file.path()).unwrap().starts_with(HEADER));
        assert_eq!(file.load(|_| true), Some(vec![1, 2, 3]));
    }

    #[test]
    fn no_byte_changes_unnoticed() {
        let directory = tempfile::tempdir().unwrap();
        let file = file(directory.path());
        for state in [1_795_239_882_u64, 0, 7] {
            file.save(&state).unwrap();
            let bytes = fs::read(file.path()).unwrap();
            for place in 0..bytes.len() {
                for change in 1..=u8::MAX {
                    let mut damaged = bytes.clone();
                    damaged[place] ^= change;
                    assert_eq!(
                        parse::<u64>(&damaged).ok(),
                        None,
                        "byte {place} ^ {change:#x}"
                    );
                }
            }
            (0..bytes.len())
                .for_each(|end| assert_eq!(parse::<u64>(&bytes[..end]).ok(), None, "{end} bytes"));
            fs::write(file.path(), &bytes[..bytes.len() - 1]).unwrap();
            assert_eq!(file.load::<u64>(|_| true), None);
            assert!(!file.path().exists(), "set aside");
        }
    }

    #[test]
    fn pipes_do_not_delay_start() {
        let directory = tempfile::tempdir().unwrap();
        let [cell, node] = ["lot-1", "edge"].map(NodeName::from_static);
        let file = file(directory.path());
        let lock = directory.path().join("lot-1.edge.lock");
        for path in [file.path(), &lock] {
            rustix::fs::mknodat(
                rustix::fs::CWD,
                path,
                rustix::fs::FileType::Fifo,
                rustix::fs::Mode::RUSR | rustix::fs::Mode::WUSR,
                0,
            )
            .unwrap();
        }
        assert!(StateFile::lock(directory.path(), &cell, &node).is_err());
        assert_eq!(file.load::<Vec<u32>>(|_| true), None);
        file.save(&[1]).unwrap();
        assert_eq!(file.load(|_| true), Some(vec![1]));
    }

    #[test]
    fn unwritable_directory_is_error() {
        let directory = tempfile::tempdir().unwrap();
        fs::write(directory.path().join("occupied"), b"").unwrap();
        assert!(file(&directory.path().join("occupied")).save(&[1]).is_err());
    }

    #[test]
    fn leftover_file_widens_no_permissions() {
        use std::os::unix::fs::PermissionsExt;

        let directory = tempfile::tempdir().unwrap();
        let key = directory.path().join("edge.key");
        let left_over = directory.path().join("edge.tmp");
        fs::write(&left_over, "half a certificate").unwrap();
        fs::set_permissions(&left_over, PermissionsExt::from_mode(0o644)).unwrap();
        replace_file(&key, b"secret", 0o600).unwrap();
        assert_eq!(
            fs::metadata(&key).unwrap().permissions().mode() & 0o777,
            0o600
        );
    }
}
