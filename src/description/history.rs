//! The descriptions that a node had, and the nodes that stated them, for going back when a
//! certificate is revoked.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use crate::wire::CellDescription;

/// A description and the nodes that it may have come from.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct AttributedDescription {
    /// The description as it was stated or set.
    #[serde(flatten)]
    pub description: Arc<CellDescription>,
    /// Certificates in base64 of the candidates that stated the description when it was adopted.
    /// Empty for a description that was set here, in a cell without certificates, and if more than
    /// eight candidates stated it.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub authors: Vec<String>,
}

/// Maximum number of candidates among which the author of a description is searched.
pub(super) const MAX_AUTHORS: usize = 8;

impl AttributedDescription {
    /// True if only revoked nodes stated the description. A node that has it from many candidates
    /// also receives the statements of nodes that passed it on; it goes back when a node that had
    /// the description from its author goes back.
    pub fn is_of_revoked(&self, is_revoked: impl Fn(&str) -> bool) -> bool {
        !self.authors.is_empty()
            && self
                .authors
                .iter()
                .all(|certificate| is_revoked(certificate))
    }
}

/// The current description, and the latest earlier description from each node. This is the state
/// that a node saves.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct DescriptionHistory {
    /// The description in use; `None` before the node has one.
    #[serde(flatten)]
    pub current: Option<AttributedDescription>,
    /// Those before, oldest first.
    #[serde(default)]
    pub earlier: Vec<AttributedDescription>,
}

/// Maximum number of earlier descriptions; the oldest is dropped first. One certificate displaces
/// at most one description.
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

    /// Replaces the current description.
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

    /// Drops all descriptions of revoked certificates. Returns true if the current description was
    /// among them; the latest remaining one, if any, then becomes current.
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
