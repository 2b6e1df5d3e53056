//! The present troubles of a node, noted by its parts and read by whoever shows them.

#[cfg(feature = "camera")]
use std::sync::Arc;
use std::sync::{Mutex, MutexGuard, PoisonError};

use ecod::diagnostics::{TroubleKind, TroubleRegister};
#[cfg(feature = "camera")]
use ecod::model::names::NodeName;
use ecod::wire::Trouble;

use crate::platform::clock;
#[cfg(feature = "camera")]
use crate::telemetry::counters::Counters;

/// A register that all parts of a node share. News of it are in the log: at first, and hourly while they last.
#[derive(Debug, Default)]
pub struct Troubles(Mutex<TroubleRegister>);

impl Troubles {
    /// Notes a trouble of this node itself.
    pub fn note(&self, kind: TroubleKind, cause: &str) {
        let news = self.register().note(kind, None, cause, clock::now());
        log(news);
    }

    /// Notes a trouble of a vehicle, address or host.
    pub fn note_about(&self, about: &str, kind: TroubleKind, cause: &str) {
        let news = self.register().note(kind, Some(about), cause, clock::now());
        log(news);
    }

    /// The same with a cause that is put into words only if they are needed.
    pub fn note_about_with(&self, about: &str, kind: TroubleKind, cause: impl FnOnce() -> String) {
        let news = self.register().note_with(kind, Some(about), cause, kind.remedy(), clock::now());
        log(news);
    }

    /// Notes what another node says of this one.
    pub fn relay(&self, kind: TroubleKind, cause: &str, remedy: &str) {
        let news = self.register().note_with(kind, None, || cause.to_owned(), remedy, clock::now());
        log(news);
    }

    /// Notes that a trouble of this node itself, or about another, is over.
    pub fn settle(&self, kind: TroubleKind, about: Option<&str>) {
        self.register().settle(kind, about);
    }

    /// The present troubles, the node's own first.
    pub fn present(&self) -> Vec<Trouble> {
        self.register().present(clock::now())
    }

    fn register(&self) -> MutexGuard<'_, TroubleRegister> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The troubles of one camera: a vehicle's only one is the node itself, others are parts of it.
#[cfg(feature = "camera")]
#[derive(Debug, Clone)]
pub struct CameraTroubles {
    counters: Arc<Counters>,
    part: Option<NodeName>,
}

#[cfg(feature = "camera")]
impl CameraTroubles {
    /// The troubles of a camera that reports as a part, or as the node itself.
    pub fn new(counters: Arc<Counters>, part: Option<NodeName>) -> Self {
        Self { counters, part }
    }

    /// Notes a trouble.
    pub fn note(&self, kind: TroubleKind, cause: &str) {
        match &self.part {
            Some(part) => self.counters.troubles().note_about(part.as_str(), kind, cause),
            None => self.counters.troubles().note(kind, cause),
        }
    }

    /// Notes that a trouble is over.
    pub fn settle(&self, kind: TroubleKind) {
        self.counters.troubles().settle(kind, self.part.as_ref().map(NodeName::as_str));
    }
}

fn log(news: Option<Trouble>) {
    let Some(Trouble { kind, about, cause, remedy }) = news else { return };
    match about {
        Some(about) => tracing::warn!(kind, about, remedy, "{cause}"),
        None => tracing::warn!(kind, remedy, "{cause}"),
    }
}
