//! The highest term on disk.

use std::time::Duration;

use tokio::sync::watch;

use crate::platform::state_file::StateFile;

/// Writes terms to disk without holding up whoever hands them in: a leader whose disk takes long must go on beating.
/// Only who is about to lead in a term waits for it, and the election hands terms in before they are needed.
#[derive(Debug)]
pub(super) struct TermWriter {
    wanted: watch::Sender<u64>,
    /// The highest term that is on disk, or that the disk refused.
    settled: watch::Receiver<u64>,
    /// Whether there is a disk.
    has_disk: bool,
    /// What was settled when the disk was last found to hang.
    hung_at: Option<u64>,
}

/// How long a disk may take before the node goes on as one without.
const DISK_PATIENCE: Duration = Duration::from_secs(1);

/// The highest term that an earlier run of the node knew; 0 without any.
pub fn saved_term(file: Option<&StateFile>) -> u64 {
    file.and_then(|file| file.load(|_| true)).unwrap_or(0)
}

impl TermWriter {
    /// A writer that ends, with what it was handed last on disk, after it is dropped; without a file it does nothing.
    pub(super) fn new(file: Option<StateFile>) -> Self {
        let (wanted, terms) = watch::channel(0);
        let (done, settled) = watch::channel(0);
        let has_disk = file.is_some();
        if let Some(file) = file {
            tokio::spawn(write_all(file, terms, done));
        }
        Self { wanted, settled, has_disk, hung_at: None }
    }

    /// Has a term written some time soon.
    pub(super) fn save(&self, term: u64) {
        self.wanted.send_replace(term);
    }

    /// Waits until the last term handed in is on disk, or `term` is; a disk that fails or hangs is logged.
    pub(super) async fn settle(&mut self, term: u64) {
        let term = term.min(*self.wanted.borrow());
        let settled = *self.settled.borrow();
        if !self.has_disk || settled >= term || self.hung_at == Some(settled) {
            return;
        }
        let waiting = self.settled.wait_for(|settled| *settled >= term);
        if tokio::time::timeout(DISK_PATIENCE, waiting).await.is_err() {
            tracing::warn!(term, "term not saved, the disk does not answer");
            self.hung_at = Some(settled);
        }
    }
}

async fn write_all(file: StateFile, mut terms: watch::Receiver<u64>, settled: watch::Sender<u64>) {
    let mut failing = false;
    while terms.changed().await.is_ok() {
        let term = *terms.borrow_and_update();
        let writer = file.clone();
        let written = tokio::task::spawn_blocking(move || writer.save(&term)).await;
        match written.map_err(std::io::Error::other).flatten() {
            Ok(()) if std::mem::take(&mut failing) => tracing::info!(path = %file.path().display(), "term saved again"),
            Ok(()) => {}
            Err(error) if !std::mem::replace(&mut failing, true) => {
                tracing::warn!(path = %file.path().display(), %error, "term not saved");
            }
            Err(_) => {}
        }
        settled.send_replace(term);
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use ecod::names::NodeName;

    use super::*;

    fn file(directory: &Path) -> StateFile {
        StateFile::new(directory, &NodeName::from_static("lot-1"), &NodeName::from_static("edge"), "term")
    }

    #[tokio::test]
    async fn a_term_that_was_waited_for_is_on_disk() {
        let directory = tempfile::tempdir().unwrap();
        let mut writer = TermWriter::new(Some(file(directory.path())));
        for term in 1..20 {
            writer.save(term);
            writer.settle(term).await;
            assert_eq!(saved_term(Some(&file(directory.path()))), term);
        }
    }

    #[tokio::test]
    async fn a_disk_that_fails_holds_nobody_up() {
        let directory = tempfile::tempdir().unwrap();
        let occupied = directory.path().join("occupied");
        std::fs::write(&occupied, b"").unwrap();
        let mut writer = TermWriter::new(Some(file(&occupied)));
        writer.save(3);
        writer.settle(3).await;
        let mut without = TermWriter::new(None);
        without.save(3);
        without.settle(3).await;
    }
}
