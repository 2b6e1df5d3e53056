//! A state file that is written concurrently with its owner's work.

use std::io;
use std::time::Duration;

use ecod::leadership::timers::DISK_TIMEOUT;
use serde::Serialize;
use tokio::task::JoinHandle;

use super::state_file::StateFile;

/// Writer of one state file, one write at a time. A disk that hangs delays one save by
/// [`DISK_TIMEOUT`], but not the following ones.
#[derive(Debug)]
pub struct StateWriter {
    file: Option<StateFile>,
    /// The state's name in the log.
    what: &'static str,
    is_unsaved: bool,
    writing: Option<JoinHandle<io::Result<()>>>,
    has_failed: bool,
}

/// Result of a save.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SaveOutcome {
    /// The state had not changed, or there is no file.
    Unchanged,
    /// The state is on the disk.
    Written,
    /// The disk refused it or did not answer; the next save tries again.
    Failed,
}

impl StateWriter {
    /// A writer of `file`, if there is one.
    pub fn new(file: Option<StateFile>, what: &'static str) -> Self {
        Self {
            file,
            what,
            is_unsaved: false,
            writing: None,
            has_failed: false,
        }
    }

    /// Makes the next save write the file.
    pub fn record_change(&mut self) {
        self.is_unsaved = true;
    }

    /// Writes `state()` if it has changed. A failure is logged when it begins.
    pub async fn save<T: Serialize + Send + 'static>(
        &mut self,
        state: impl FnOnce() -> T,
    ) -> SaveOutcome {
        let Some(file) = &self.file else {
            return SaveOutcome::Unchanged;
        };
        // A write that is still in progress was already waited for in an earlier call.
        let patience = if self.writing.is_some() {
            Duration::ZERO
        } else {
            DISK_TIMEOUT
        };
        if self.writing.is_none() {
            if !std::mem::take(&mut self.is_unsaved) {
                return SaveOutcome::Unchanged;
            }
            let file = file.clone();
            let state = state();
            self.writing = Some(tokio::task::spawn_blocking(move || file.save(&state)));
        }
        let Some(writing) = &mut self.writing else {
            return SaveOutcome::Unchanged;
        };
        let written = match tokio::time::timeout(patience, writing).await {
            Ok(written) => {
                self.writing = None;
                written.map_err(io::Error::other).flatten()
            }
            Err(elapsed) => Err(elapsed.into()),
        };
        // Also after a late answer: the state may have changed in the meantime.
        self.is_unsaved |= written.is_err();
        let had_failed = std::mem::replace(&mut self.has_failed, written.is_err());
        let Err(error) = written else {
            return SaveOutcome::Written;
        };
        if !had_failed {
            tracing::warn!(path = %file.path().display(), %error, "{} not saved, tried again", self.what);
        }
        SaveOutcome::Failed
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Mutex;
    use std::sync::mpsc::{Receiver, Sender, channel};

    use ecod::model::names::NodeName;
    use serde::Serializer;
    use tokio::time::Instant;

    use super::*;

    /// A state whose write hangs until the other end of its channel is dropped.
    struct Hanging(Mutex<Receiver<()>>);

    impl Serialize for Hanging {
        fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
            _ = self.0.lock().unwrap().recv();
            serializer.serialize_u8(7)
        }
    }

    #[tokio::test]
    async fn hanging_disk_is_awaited_once() {
        let directory = tempfile::tempdir().unwrap();
        let lot = NodeName::from_static("lot-1");
        let euclid = NodeName::from_static("euclid");
        let file = StateFile::new(directory.path(), &lot, &euclid, "counts");
        let mut writer = StateWriter::new(Some(file.clone()), "counts");
        assert_eq!(writer.save(|| 1).await, SaveOutcome::Unchanged);

        let (release, hang) = channel();
        writer.record_change();
        let begun = Instant::now();
        assert_eq!(
            writer.save(|| Hanging(Mutex::new(hang))).await,
            SaveOutcome::Failed
        );
        assert!(begun.elapsed() >= DISK_TIMEOUT);
        let again = tokio::time::timeout(DISK_TIMEOUT / 2, writer.save(|| 8)).await;
        assert_eq!(again, Ok(SaveOutcome::Failed));

        drop::<Sender<()>>(release);
        while file.load(|_| true) != Some(8) {
            tokio::time::timeout(10 * DISK_TIMEOUT, writer.save(|| 8))
                .await
                .unwrap();
            tokio::task::yield_now().await;
        }
        assert_eq!(writer.save(|| 9).await, SaveOutcome::Unchanged);
    }
}
