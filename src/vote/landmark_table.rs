//! The landmarks of a cell by index, each with its votes.

use std::collections::BTreeMap;
use std::ops::Bound;

use super::landmark_votes::LandmarkVotes;
use crate::model::names::LandmarkId;

/// Landmarks, numbered in order of first appearance; a landmark that leaves makes its index free for
/// another.
#[derive(Debug, Clone, Default)]
pub(super) struct LandmarkTable {
    /// By index; a free index has no votes.
    entries: Vec<LandmarkEntry>,
    indices: BTreeMap<LandmarkId, usize>,
    free: Vec<usize>,
}

#[derive(Debug, Clone, Default)]
struct LandmarkEntry {
    id: LandmarkId,
    votes: LandmarkVotes,
}

impl LandmarkTable {
    pub(super) fn len(&self) -> usize {
        self.indices.len()
    }

    /// The indices of the landmarks that follow in the order of names; of all, after `None`.
    pub(super) fn following(&self, after: Option<&LandmarkId>) -> impl Iterator<Item = usize> {
        let after = after.map_or(Bound::Unbounded, Bound::Excluded);
        self.indices
            .range::<LandmarkId, _>((after, Bound::Unbounded))
            .map(|(_, index)| *index)
    }

    /// The index of a landmark.
    pub(super) fn index(&self, id: &LandmarkId) -> Option<usize> {
        self.indices.get(id).copied()
    }

    /// The landmarks, by name.
    pub(super) fn names(&self) -> impl Iterator<Item = &LandmarkId> {
        self.indices.keys()
    }

    /// The landmark of an index in use.
    pub(super) fn id(&self, index: usize) -> &LandmarkId {
        &self.entries[index].id
    }

    /// The index of a landmark; a new or reused index if the landmark has none.
    pub(super) fn intern(&mut self, id: &LandmarkId) -> usize {
        *self.indices.entry(id.clone()).or_insert_with(|| {
            let index = self.free.pop().unwrap_or_else(|| {
                self.entries.push(LandmarkEntry::default());
                self.entries.len() - 1
            });
            self.entries[index].id = id.clone();
            index
        })
    }

    /// Removes a landmark and its votes; another one may reuse its index.
    pub(super) fn remove(&mut self, id: &LandmarkId) {
        if let Some(index) = self.indices.remove(id) {
            self.entries[index] = LandmarkEntry::default();
            self.free.push(index);
        }
    }

    pub(super) fn votes(&self, index: usize) -> &LandmarkVotes {
        &self.entries[index].votes
    }

    pub(super) fn votes_mut(&mut self, index: usize) -> &mut LandmarkVotes {
        &mut self.entries[index].votes
    }

    /// The votes of all landmarks, by index.
    pub(super) fn iter_mut(&mut self) -> impl Iterator<Item = &mut LandmarkVotes> {
        self.entries.iter_mut().map(|entry| &mut entry.votes)
    }

    /// The indices in the order of the landmarks' names, which does not depend on their arrival.
    pub(super) fn by_name(&self) -> Vec<usize> {
        self.indices.values().copied().collect()
    }
}
