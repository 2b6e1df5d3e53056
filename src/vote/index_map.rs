//! Maps by index.

/// Index of a label in the cell's [`LabelTable`](super::label_table::LabelTable).
pub(super) type LabelIndex = u16;

/// Values by label.
pub(super) type LabelMap<V> = IndexMap<LabelIndex, V>;

/// Values by index in two sorted vectors: up to 32 labels are in one cache line, whereas each level
/// of a tree would be elsewhere in memory.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct IndexMap<I, V> {
    indices: Vec<I>,
    values: Vec<V>,
}

impl<I, V> Default for IndexMap<I, V> {
    fn default() -> Self {
        Self {
            indices: Vec::new(),
            values: Vec::new(),
        }
    }
}

impl<I: Copy + Ord, V: Default> FromIterator<(I, V)> for IndexMap<I, V> {
    fn from_iter<P: IntoIterator<Item = (I, V)>>(pairs: P) -> Self {
        let mut map = Self::default();
        for (index, value) in pairs {
            *map.entry(index) = value;
        }
        map
    }
}

impl<I: Copy + Ord, V> IndexMap<I, V> {
    /// Number of indices that have a value.
    pub(super) fn len(&self) -> usize {
        self.indices.len()
    }

    pub(super) fn get(&self, index: I) -> Option<&V> {
        let place = self.indices.binary_search(&index).ok()?;
        Some(&self.values[place])
    }

    /// The value of an index; a missing one is added.
    pub(super) fn entry(&mut self, index: I) -> &mut V
    where
        V: Default,
    {
        let place = self.indices.binary_search(&index).unwrap_or_else(|place| {
            if self.indices.len() == self.indices.capacity() {
                // A vector that doubles holds a third more than it needs, on average.
                let more = 4 + self.indices.len() / 8;
                self.indices.reserve_exact(more);
                self.values.reserve_exact(more);
            }
            self.indices.insert(place, index);
            self.values.insert(place, V::default());
            place
        });
        &mut self.values[place]
    }

    /// Indices and values, in order of the index.
    pub(super) fn iter(&self) -> impl Iterator<Item = (I, &V)> {
        self.indices.iter().copied().zip(&self.values)
    }

    /// Values, in order of their indices.
    pub(super) fn values_mut(&mut self) -> impl Iterator<Item = &mut V> {
        self.values.iter_mut()
    }

    /// Removes the indices that `is_kept` does not select.
    pub(super) fn retain(&mut self, is_kept: impl Fn(I, &V) -> bool) {
        if self.iter().all(|(index, value)| is_kept(index, value)) {
            return;
        }
        let values = std::mem::take(&mut self.values);
        let all = std::mem::take(&mut self.indices).into_iter().zip(values);
        (self.indices, self.values) = all.filter(|(index, value)| is_kept(*index, value)).unzip();
    }
}
