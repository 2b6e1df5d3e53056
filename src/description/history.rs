//! The descriptions that a node had, and who stated them: the way back when a certificate is revoked.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use crate::wire::CellDescription;

/// A description and the nodes that it may have come from.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct AttributedDescription {
    /// The description.
    #[serde(flatten)]
    pub description: Arc<CellDescription>,
    /// Certificates in base64 of the candidates that stated it when it was adopted. Empty for one that was set here, in a
    /// cell without certificates, and where more than eight candidates stated it.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub authors: Vec<String>,
}

/// Maximum number of candidates of which one is taken for the author of a description.
pub(super) const MAX_AUTHORS: usize = 8;

impl AttributedDescription {
    /// True if it is of no other than revoked nodes. One that has it from many hears who passes it on, too: it goes back
    /// when a node that had it from its author does.
    pub fn is_of_revoked(&self, is_revoked: impl Fn(&str) -> bool) -> bool {
        !self.authors.is_empty()
            && self
                .authors
                .iter()
                .all(|certificate| is_revoked(certificate))
    }
}

/// The present description, and the latest earlier one of each node that it came from. This is what a node saves.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct DescriptionHistory {
    /// The present one.
    #[serde(flatten)]
    pub current: Option<AttributedDescription>,
    /// Those before, oldest first.
    #[serde(default)]
    pub earlier: Vec<AttributedDescription>,
}

/// Maximum number of earlier descriptions; the oldest gives way. One certificate displaces one at most.
const MAX_EARLIER: usize = 4;

impl DescriptionHistory {
    /// A history that begins with this description.
    pub fn of(current: Option<Arc<CellDescription>>) -> Self {
        let current = current.map(|description| AttributedDescription {
            description,
            authors: Vec::new(),
        });
        Self {
            current,
            earlier: Vec::new(),
        }
    }

    /// Puts a description in the place of the present one.
    pub(super) fn replace(&mut self, next: AttributedDescription) {
        let Some(before) = self.current.replace(next) else {
            return;
        };
        self.earlier.retain(|held| held.authors != before.authors);
        self.earlier.push(before);
        if self.earlier.len() > MAX_EARLIER {
            self.earlier.remove(0);
        }
    }

    /// Drops all descriptions of revoked certificates. True if the present one was one of them; the latest other one, if
    /// there is any, takes its place.
    pub(super) fn drop_revoked(&mut self, is_revoked: impl Fn(&str) -> bool) -> bool {
        let is_dropped = |held: &AttributedDescription| held.is_of_revoked(&is_revoked);
        self.earlier.retain(|held| !is_dropped(held));
        let was_dropped = self.current.take_if(|held| is_dropped(held)).is_some();
        if was_dropped {
            self.current = self.earlier.pop();
        }
        was_dropped
    }
}
