//! A map by label.

/// Index of a label in the cell's [`LabelTable`](super::label_table::LabelTable).
pub(super) type LabelIndex = u16;

/// Values by label in two sorted vectors: up to 32 labels are in one cache line, whereas each level
/// of a tree would be elsewhere in memory.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct LabelMap<V> {
    labels: Vec<LabelIndex>,
    values: Vec<V>,
}

impl<V> Default for LabelMap<V> {
    fn default() -> Self {
        Self {
            labels: Vec::new(),
            values: Vec::new(),
        }
    }
}

impl<V> FromIterator<(LabelIndex, V)> for LabelMap<V>
where
    V: Default,
{
    fn from_iter<I: IntoIterator<Item = (LabelIndex, V)>>(pairs: I) -> Self {
        let mut map = Self::default();
        for (label, value) in pairs {
            *map.entry(label) = value;
        }
        map
    }
}

impl<V> LabelMap<V> {
    /// Number of labels that have a value.
    pub(super) fn len(&self) -> usize {
        self.labels.len()
    }

    pub(super) fn get(&self, label: LabelIndex) -> Option<&V> {
        let place = self.labels.binary_search(&label).ok()?;
        Some(&self.values[place])
    }

    /// The value of a label, which is added if the label has none.
    pub(super) fn entry(&mut self, label: LabelIndex) -> &mut V
    where
        V: Default,
    {
        let place = self.labels.binary_search(&label).unwrap_or_else(|place| {
            self.labels.insert(place, label);
            self.values.insert(place, V::default());
            place
        });
        &mut self.values[place]
    }

    /// Labels and values, in order of the label.
    pub(super) fn iter(&self) -> impl Iterator<Item = (LabelIndex, &V)> {
        self.labels.iter().copied().zip(&self.values)
    }

    /// Values, in order of their labels.
    pub(super) fn values_mut(&mut self) -> impl Iterator<Item = &mut V> {
        self.values.iter_mut()
    }

    /// Removes the labels that `is_kept` does not select.
    pub(super) fn retain(&mut self, is_kept: impl Fn(LabelIndex, &V) -> bool) {
        let kept: Vec<bool> = self.iter().map(|(label, v)| is_kept(label, v)).collect();
        if kept.contains(&false) {
            let mut of_label = kept.iter();
            self.labels
                .retain(|_| of_label.next().copied().unwrap_or_default());
            let mut of_value = kept.iter();
            self.values
                .retain(|_| of_value.next().copied().unwrap_or_default());
        }
    }
}
