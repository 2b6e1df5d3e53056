//! The current troubles of a node, recorded by its parts and read by its displays.

use std::sync::{Mutex, MutexGuard, PoisonError};

use ecod::diagnostics::{TroubleKind, TroubleRegister};
use ecod::model::names::plain_text;
use ecod::wire::Trouble;

use crate::platform::clock;

/// A register that all parts of a node share. Troubles are logged when they begin, and hourly while
/// they last.
#[derive(Debug, Default)]
pub struct Troubles(Mutex<TroubleRegister>);

impl Troubles {
    /// Records a trouble of this node itself.
    pub fn record(&self, kind: TroubleKind, cause: &str) {
        let news = self.register().record(kind, None, cause, clock::now());
        log(news);
    }

    /// Records a trouble of a vehicle, address or host.
    pub fn record_about(&self, about: &str, kind: TroubleKind, cause: &str) {
        let news = self
            .register()
            .record(kind, Some(about), cause, clock::now());
        log(news);
    }

    /// As `record_about`, with a text of the cause that is created only if it is needed.
    pub fn record_about_with(
        &self,
        about: &str,
        kind: TroubleKind,
        cause: impl FnOnce() -> String,
    ) {
        let news =
            self.register()
                .record_with(kind, Some(about), cause, kind.remedy(), clock::now());
        log(news);
    }

    /// Records a trouble of this node itself, or about another, with a remedy of its own.
    pub fn record_with_remedy(
        &self,
        about: Option<&str>,
        kind: TroubleKind,
        cause: &str,
        remedy: &str,
    ) {
        let news =
            self.register()
                .record_with(kind, about, || cause.to_owned(), remedy, clock::now());
        log(news);
    }

    /// Records that a trouble of this node itself, or about another, is over.
    pub fn settle(&self, kind: TroubleKind, about: Option<&str>) {
        self.register().settle(kind, about);
    }

    /// Records that troubles that belong to a cell are over, because the vehicle has left it.
    pub fn leave_cell(&self) {
        use TroubleKind::{BrokerRefuses, Description, NoOrigin};
        let mut register = self.register();
        [BrokerRefuses, Description, NoOrigin]
            .into_iter()
            .for_each(|kind| register.settle_all(kind));
    }

    /// The current troubles, the node's own first.
    pub fn present(&self) -> Vec<Trouble> {
        self.register().present(clock::now())
    }

    fn register(&self) -> MutexGuard<'_, TroubleRegister> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Maximum number of characters of a member's text in a trouble.
const MAX_QUOTED_CHARACTERS: usize = 120;

/// Another member's text as a quotation.
pub(crate) fn quoted(text: &str) -> String {
    let words: String = text.chars().take(MAX_QUOTED_CHARACTERS).collect();
    let end = if words.len() < text.len() { "…" } else { "" };
    format!("“{}{end}”", plain_text(&words, words.len()))
}

fn log(news: Option<Trouble>) {
    let Some(Trouble {
        kind,
        about,
        cause,
        remedy,
    }) = news
    else {
        return;
    };
    match about {
        Some(about) => tracing::warn!(kind, about, remedy, "{cause}"),
        None => tracing::warn!(kind, remedy, "{cause}"),
    }
}
