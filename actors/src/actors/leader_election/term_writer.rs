//! The term on disk.

use ecod::leadership::timers::DISK_TIMEOUT;
use tokio::sync::watch;

use crate::platform::state_file::StateFile;

/// Writer of terms that does not block its caller: a leader with a slow disk must continue to send
/// beats.
///
/// The election hands terms to the writer before they are needed. Only a node that is about to lead
/// in a term waits for the disk's answer, for [`DISK_TIMEOUT`] at most. A disk that fails or hangs
/// does not stop a leader.
#[derive(Debug)]
pub(super) struct TermWriter {
    wanted: watch::Sender<u64>,
    answer: watch::Receiver<DiskAnswer>,
    has_disk: bool,
    /// The disk's last answer when it was found to hang.
    hung_at: Option<DiskAnswer>,
}

/// The disk's answer to the last term that was handed to it.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
struct DiskAnswer {
    term: u64,
    is_saved: bool,
}

/// Whether a term survives a restart.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum TermState {
    /// It is on disk.
    Saved,
    /// The disk refused it.
    Refused,
    /// The disk has not answered.
    Unanswered,
    /// The node has no disk for its state.
    NoDisk,
}

/// Maximum term that is accepted from a disk. Larger terms are ignored as forged: a cell would need
/// over 1000 years to reach this value.
const MAX_SAVED_TERM: u64 = 1 << 40;

/// The term that the last run of the node saved; 0 without any.
pub fn saved_term(file: Option<&StateFile>) -> u64 {
    let Some(file) = file else { return 0 };
    match file.load(|_| true).unwrap_or(0) {
        term if term <= MAX_SAVED_TERM => term,
        _ => {
            file.set_aside("the term exceeds the plausible maximum: it was forged");
            0
        }
    }
}

impl TermWriter {
    /// Creates a writer. After it is dropped, it ends once the last term is on disk. Without a file
    /// its calls have no effect.
    pub(super) fn new(file: Option<StateFile>) -> Self {
        let (wanted, terms) = watch::channel(0);
        let (answers, answer) = watch::channel(DiskAnswer::default());
        let has_disk = file.is_some();
        if let Some(file) = file {
            tokio::spawn(write_all(file, terms, answers));
        }
        Self {
            wanted,
            answer,
            has_disk,
            hung_at: None,
        }
    }

    /// Schedules the writing of a term.
    pub(super) fn save(&self, term: u64) {
        self.wanted.send_replace(term);
    }

    /// Waits for the disk's answer to `term`, or to the last scheduled term if that is lower. A
    /// disk that was found to hang is not waited for again until it gives an answer.
    pub(super) async fn wait_for(&mut self, term: u64) -> TermState {
        // A node may drop a term and then schedule a lower one; earlier answers do not apply to it.
        let wanted = *self.wanted.borrow();
        let term = term.min(wanted);
        let is_about = |answer: &DiskAnswer| (term..=wanted).contains(&answer.term);
        if !self.has_disk {
            return TermState::NoDisk;
        }
        let before = *self.answer.borrow();
        if !is_about(&before) && self.hung_at == Some(before) {
            return TermState::Unanswered;
        }
        let answered = tokio::time::timeout(DISK_TIMEOUT, self.answer.wait_for(is_about))
            .await
            .ok()
            .and_then(Result::ok);
        match answered.map(|answer| answer.is_saved) {
            Some(true) => TermState::Saved,
            Some(false) => TermState::Refused,
            None => {
                tracing::warn!(term, "term not saved, the disk does not answer");
                self.hung_at = Some(before);
                TermState::Unanswered
            }
        }
    }
}

/// Writes the newest term whenever it changes, and answers with the result. A term that a newer one
/// replaces during a write is skipped.
async fn write_all(
    file: StateFile,
    mut terms: watch::Receiver<u64>,
    answers: watch::Sender<DiskAnswer>,
) {
    let mut is_failing = false;
    while terms.changed().await.is_ok() {
        let term = *terms.borrow_and_update();
        let writer = file.clone();
        let written = tokio::task::spawn_blocking(move || writer.save(&term))
            .await
            .map_err(std::io::Error::other)
            .flatten();
        match &written {
            Ok(()) if is_failing => {
                tracing::info!(path = %file.path().display(), "term saved again");
            }
            Err(error) if !is_failing => {
                tracing::warn!(path = %file.path().display(), %error, "term not saved");
            }
            Ok(()) | Err(_) => {}
        }
        is_failing = written.is_err();
        answers.send_replace(DiskAnswer {
            term,
            is_saved: !is_failing,
        });
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use ecod::model::names::NodeName;

    use super::*;

    fn file(directory: &Path) -> StateFile {
        StateFile::new(
            directory,
            &NodeName::from_static("lot-1"),
            &NodeName::from_static("edge"),
            "term",
        )
    }

    #[tokio::test]
    async fn awaited_term_is_on_disk() {
        let directory = tempfile::tempdir().unwrap();
        let mut writer = TermWriter::new(Some(file(directory.path())));
        for term in (1..20).chain([5]) {
            writer.save(term);
            assert_eq!(writer.wait_for(term).await, TermState::Saved);
            assert_eq!(saved_term(Some(&file(directory.path()))), term);
        }
    }

    #[test]
    fn forged_term_is_set_aside() {
        let directory = tempfile::tempdir().unwrap();
        let file = file(directory.path());
        for (saved, read) in [
            (7, 7),
            (1_795_239_882, 1_795_239_882),
            ((1 << 53) - 1, 0),
            (u64::MAX, 0),
        ] {
            file.save(&saved).unwrap();
            assert_eq!(saved_term(Some(&file)), read);
            assert_eq!(file.path().exists(), read > 0);
        }
    }

    #[tokio::test]
    async fn failing_disk_delays_no_vote() {
        let directory = tempfile::tempdir().unwrap();
        let occupied = directory.path().join("occupied");
        std::fs::write(&occupied, b"").unwrap();
        let mut writer = TermWriter::new(Some(file(&occupied)));
        writer.save(3);
        assert_eq!(writer.wait_for(3).await, TermState::Refused);
        let mut without = TermWriter::new(None);
        without.save(3);
        assert_eq!(without.wait_for(3).await, TermState::NoDisk);
    }

    #[tokio::test]
    async fn hanging_disk_is_awaited_once() {
        let (wanted, _terms) = watch::channel(3);
        let (_answers, answer) = watch::channel(DiskAnswer::default());
        let mut writer = TermWriter {
            wanted,
            answer,
            has_disk: true,
            hung_at: None,
        };
        let begun = tokio::time::Instant::now();
        assert_eq!(writer.wait_for(3).await, TermState::Unanswered);
        assert!(begun.elapsed() >= DISK_TIMEOUT);
        let again = tokio::time::timeout(DISK_TIMEOUT / 2, writer.wait_for(3)).await;
        assert_eq!(again, Ok(TermState::Unanswered));
    }
}
