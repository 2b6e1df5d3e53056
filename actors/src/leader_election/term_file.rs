//! The highest term, kept over restarts.

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use ecod::names::NodeName;

/// A file with one number, whole at any time: it is written anew beside the old one and takes its name.
#[derive(Debug, Clone)]
pub struct TermFile {
    path: Option<PathBuf>,
}

/// A term that is not on disk.
#[derive(Debug, thiserror::Error)]
#[error("cannot write term to {path}: {source}")]
pub struct TermNotWritten {
    path: PathBuf,
    source: io::Error,
}

impl TermFile {
    /// The file of a node in a directory, which need not exist; without one nothing is kept.
    pub fn new(directory: Option<&Path>, cell: &NodeName, node: &NodeName) -> Self {
        Self { path: directory.map(|directory| directory.join(format!("{cell}.{node}.term"))) }
    }

    /// The term written last; 0 without any, and for a file that cannot be read, which is logged.
    pub fn read(&self) -> u64 {
        let Some(path) = &self.path else { return 0 };
        let text = match fs::read_to_string(path) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => return 0,
            text => text.map_err(|error| error.to_string()),
        };
        let term = text.and_then(|text| text.trim().parse().map_err(|_| format!("no number: {text:?}")));
        term.unwrap_or_else(|error| {
            tracing::warn!(path = %path.display(), error, "term of earlier runs is lost");
            0
        })
    }

    /// Replaces the term; when this returns it survives a crash of the machine.
    ///
    /// # Errors
    /// [`TermNotWritten`]; the file is then as before.
    pub fn write(&self, term: u64) -> Result<(), TermNotWritten> {
        let Some(path) = &self.path else { return Ok(()) };
        replace(path, &format!("{term}\n")).map_err(|source| TermNotWritten { path: path.clone(), source })
    }
}

fn replace(path: &Path, text: &str) -> io::Result<()> {
    let directory = path.parent().unwrap_or(Path::new("."));
    fs::create_dir_all(directory)?;
    let beside = path.with_extension("term.new");
    let mut file = File::create(&beside)?;
    file.write_all(text.as_bytes())?;
    file.sync_all()?;
    fs::rename(&beside, path)?;
    File::open(directory)?.sync_all()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file(directory: &Path) -> TermFile {
        TermFile::new(Some(directory), &NodeName::from_static("lot"), &NodeName::from_static("euclid"))
    }

    #[test]
    fn the_last_term_written_is_found_again() {
        let directory = tempfile::tempdir().unwrap();
        let state = directory.path().join("not/yet/there");
        assert_eq!(file(&state).read(), 0);
        file(&state).write(7).unwrap();
        file(&state).write(8).unwrap();
        assert_eq!(file(&state).read(), 8);
    }

    #[test]
    fn a_write_cut_short_leaves_the_old_term_and_junk_counts_as_none() {
        let directory = tempfile::tempdir().unwrap();
        file(directory.path()).write(7).unwrap();
        fs::write(directory.path().join("lot.euclid.term.new"), "8").unwrap();
        assert_eq!(file(directory.path()).read(), 7);
        fs::write(directory.path().join("lot.euclid.term"), [0xff, 0]).unwrap();
        assert_eq!(file(directory.path()).read(), 0);
    }

    #[test]
    fn a_term_that_cannot_be_written_is_an_error_that_names_the_file() {
        let directory = tempfile::tempdir().unwrap();
        let blocked = directory.path().join("file");
        fs::write(&blocked, "").unwrap();
        let error = file(&blocked).write(1).unwrap_err().to_string();
        assert!(error.contains("lot.euclid.term"), "{error}");
    }
}
