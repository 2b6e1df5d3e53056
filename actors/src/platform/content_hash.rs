//! Hash of a cell's description.

use ecod::model::names::NodeName;
use ecod::wire::{CellDescription, ContentHash};
use ring::digest::{SHA256, digest};

/// SHA-256 of a description's content.
pub fn content_hash(set_by: &NodeName, text: &str) -> ContentHash {
    let mut hash = ContentHash::default();
    let digest = digest(&SHA256, &CellDescription::content(set_by, text));
    hash.0
        .iter_mut()
        .zip(digest.as_ref())
        .for_each(|(byte, digest)| *byte = *digest);
    hash
}

/// True if a description's hash matches its content.
pub fn is_intact(description: &CellDescription) -> bool {
    description.hash == content_hash(&description.set_by, &description.text)
}
