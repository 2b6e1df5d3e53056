//! Who has looked at an object, each in a seat of its own.

use std::time::Duration;

use smallvec::SmallVec;

use super::existence::Witness;
use crate::time::Timestamp;

/// Vehicles that an object can be known from at once; whoever has not looked for [`SEAT_KEPT`] makes room.
const MOST: usize = 32;

/// Were the others to make room for newcomers, none of more than 32 would stay for long enough to be judged.
const SEAT_KEPT: Duration = Duration::from_secs(1);

/// What each of the vehicles has seen of one object.
#[derive(Debug, Clone, Default)]
pub(super) struct Witnesses {
    /// The vehicles' numbers by seat: to find a vehicle among them is done at every look, and what they have seen is
    /// some twenty times as large.
    sources: SmallVec<[u32; 12]>,
    seen: Vec<Witness>,
}

impl Witnesses {
    /// All of them.
    pub(super) fn iter(&self) -> impl Iterator<Item = &Witness> {
        self.seen.iter()
    }

    /// How many they are.
    pub(super) fn len(&self) -> usize {
        self.seen.len()
    }

    /// The vehicle's part, if it has any.
    pub(super) fn get(&self, source: u32) -> Option<&Witness> {
        self.held(source).map(|seat| &self.seen[seat])
    }

    /// Whether the vehicle's word is kept.
    pub(super) fn hears(&self, source: u32, at: Timestamp) -> bool {
        self.seat(source, at).is_some()
    }

    /// The vehicle's part, made if there is none and room for one.
    pub(super) fn looking(&mut self, source: u32, at: Timestamp) -> Option<&mut Witness> {
        let seat = self.seat(source, at)?;
        Some(self.sit(seat, source, at))
    }

    /// The same for a vehicle that detects the object: one that never did makes room.
    pub(super) fn detecting(&mut self, source: u32, at: Timestamp) -> Option<&mut Witness> {
        let blind = || self.seen.iter().position(|witness| witness.last_hit.is_none());
        let seat = self.seat(source, at).or_else(blind)?;
        Some(self.sit(seat, source, at))
    }

    /// Forgets all of them.
    pub(super) fn clear(&mut self) {
        self.sources.clear();
        self.seen.clear();
    }

    /// Forgets those of other vehicles.
    pub(super) fn keep(&mut self, is_known: impl Fn(u32) -> bool) {
        self.seen.retain(|witness| is_known(witness.source));
        self.sources.retain(|source| is_known(*source));
    }

    /// Takes in those of the same object under another name: of two of one vehicle, the one that detected it last.
    pub(super) fn absorb(&mut self, others: Self) {
        for theirs in others.seen {
            match self.held(theirs.source) {
                Some(seat) if self.seen[seat].last_hit < theirs.last_hit => self.seen[seat] = theirs,
                None if self.seen.len() < MOST => {
                    self.sources.push(theirs.source);
                    self.seen.push(theirs);
                }
                _ => {}
            }
        }
    }

    fn held(&self, source: u32) -> Option<usize> {
        self.sources.iter().position(|sitting| *sitting == source)
    }

    /// Where the vehicle sits or could sit; `None` while there are enough others.
    fn seat(&self, source: u32, at: Timestamp) -> Option<usize> {
        let free = || Some(self.seen.len()).filter(|count| *count < MOST);
        let left = || {
            let looks = self.seen.iter().map(|witness| witness.last_look).enumerate();
            let (oldest, look) = looks.min_by_key(|(_, look)| *look)?;
            (at.since(look) > SEAT_KEPT).then_some(oldest)
        };
        self.held(source).or_else(free).or_else(left)
    }

    fn sit(&mut self, seat: usize, source: u32, at: Timestamp) -> &mut Witness {
        if seat == self.seen.len() {
            self.sources.push(source);
            self.seen.push(Witness::new(source, at));
        } else if self.sources[seat] != source {
            self.sources[seat] = source;
            self.seen[seat] = Witness::new(source, at);
        }
        &mut self.seen[seat]
    }
}
