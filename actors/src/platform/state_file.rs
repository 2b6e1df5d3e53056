//! State files that survive crashes: they hold the last complete state or the one before, never a mixture.

use std::fs::{self, File, OpenOptions};
use std::io::{self, Read, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

use ecod::model::names::NodeName;
use serde::Serialize;
use serde::de::DeserializeOwned;

/// File of one kind of state of a node.
#[derive(Debug, Clone)]
pub struct StateFile {
    path: PathBuf,
}

/// Maximum length of a state file in bytes.
const MAX_BYTES: u64 = 64 * 1024 * 1024;

impl StateFile {
    /// The file `<cell>.<node>.<what>.json` in `directory`, so that the nodes of a machine can share a directory.
    pub fn new(directory: &Path, cell: &NodeName, node: &NodeName, what: &str) -> Self {
        Self { path: directory.join(format!("{cell}.{node}.{what}.json")) }
    }

    /// The file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The state written last, if it is complete and `is_ours`. Any other content is set aside with a warning.
    pub fn load<T: DeserializeOwned>(&self, is_ours: impl FnOnce(&T) -> bool) -> Option<T> {
        let mut bytes = Vec::new();
        let read = File::open(&self.path).and_then(|file| file.take(MAX_BYTES + 1).read_to_end(&mut bytes));
        match read {
            Ok(_) => {}
            Err(error) if error.kind() == io::ErrorKind::NotFound => return None,
            Err(error) => {
                tracing::warn!(path = %self.path.display(), %error, "state not read");
                return None;
            }
        }
        let why = match serde_json::from_slice(&bytes) {
            Ok(state) if is_ours(&state) => return Some(state),
            Ok(_) => "it belongs to another node or version".into(),
            Err(error) => error.to_string(),
        };
        let aside = self.path.with_extension("set-aside");
        let moved = fs::rename(&self.path, &aside).err();
        tracing::warn!(path = %self.path.display(), aside = %aside.display(), why, ?moved, "state set aside");
        None
    }

    /// Replaces the state. After `Ok` it survives a loss of power.
    ///
    /// # Errors
    /// When the directory or disk refuses it; the state before is then still there.
    pub fn save<T: Serialize>(&self, state: &T) -> io::Result<()> {
        fs::create_dir_all(self.path.parent().unwrap_or(Path::new(".")))?;
        replace_file(&self.path, &serde_json::to_vec(state)?, 0o666)
    }
}

/// Replaces a file atomically, with permissions `mode` less the process's umask. After `Ok` it survives a loss of power.
///
/// # Errors
/// When the directory or disk refuses it; the file before is then still there.
pub(crate) fn replace_file(path: &Path, bytes: &[u8], mode: u32) -> io::Result<()> {
    let temporary = path.with_extension("tmp");
    let mut file = OpenOptions::new().write(true).create(true).truncate(true).mode(mode).open(&temporary)?;
    file.write_all(bytes)?;
    file.sync_all()?;
    fs::rename(&temporary, path)?;
    File::open(path.parent().unwrap_or(Path::new(".")))?.sync_all()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file(directory: &Path) -> StateFile {
        StateFile::new(directory, &NodeName::from_static("lot-1"), &NodeName::from_static("edge"), "numbers")
    }

    #[test]
    fn what_was_saved_comes_back_and_half_a_write_does_no_harm() {
        let directory = tempfile::tempdir().unwrap();
        let file = file(&directory.path().join("made/on/demand"));
        assert_eq!(file.load::<Vec<u32>>(|_| true), None);
        file.save(&[1, 2]).unwrap();
        file.save(&[1, 2, 3]).unwrap();
        fs::write(file.path().with_extension("tmp"), b"[1,2,3,").unwrap();
        assert_eq!(file.load(|_| true), Some(vec![1, 2, 3]));
    }

    #[test]
    fn truncated_and_alien_files_are_set_aside() {
        let directory = tempfile::tempdir().unwrap();
        let file = file(directory.path());
        for content in [&b"[1,2"[..], b"", b"\xff\xfe", b"{\"other\":1}"] {
            fs::write(file.path(), content).unwrap();
            assert_eq!(file.load::<Vec<u32>>(|_| true), None);
            assert!(!file.path().exists());
            assert_eq!(fs::read(file.path().with_extension("set-aside")).unwrap(), content);
        }
        file.save(&[7]).unwrap();
        assert_eq!(file.load::<Vec<u32>>(|_| false), None, "not ours");
        assert!(!file.path().exists());
    }

    #[test]
    fn a_directory_that_cannot_be_written_is_an_error() {
        let directory = tempfile::tempdir().unwrap();
        fs::write(directory.path().join("occupied"), b"").unwrap();
        assert!(file(&directory.path().join("occupied")).save(&[1]).is_err());
    }
}
