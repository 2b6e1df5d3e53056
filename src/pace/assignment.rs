//! At most one object of a report for each place, and one place for each object.
//!
//! Every object prefers the place it is nearest to. Where no two prefer the same, that is the
//! assignment. Objects that contest a place are assigned together with all that they could
//! displace, with the greatest sum of the benefits 1 − d²/g²; d is the distance and g the gate in
//! standard deviations. An object that gets no place is left out.

use hashbrown::HashSet;

use super::grouping::Place;
use crate::association::{Candidate, ClusterSize, assign};
use crate::wire::PerceivedObject;

/// An object at a place within its gate.
#[derive(Debug, Clone, Copy)]
pub(super) struct Pairing<'a> {
    pub(super) place: Place,
    pub(super) object: &'a PerceivedObject,
    /// Squared distance in standard deviations.
    pub(super) distance_squared: f64,
}

/// Objects or places in one contest, whichever are fewer, beyond which the nearest object keeps
/// each place. Larger contests occur in fabricated reports only and would take too long to solve.
const MAX_CONTEST: usize = 64;

/// Assigns the objects of one report to places.
///
/// `wishes` has each object at its nearest place, ascending by place and distance; `pairings` lists
/// all places that an object can take, within a gate of `gate_sigmas` standard deviations. The
/// result is ascending by place.
pub(super) fn one_to_one<'a, I>(
    wishes: Vec<Pairing<'a>>,
    pairings: impl Fn(&'a PerceivedObject) -> I,
    gate_sigmas: f64,
) -> Vec<Pairing<'a>>
where
    I: Iterator<Item = Pairing<'a>>,
{
    let mut contested: Vec<_> = wishes
        .windows(2)
        .filter(|pair| pair[0].place == pair[1].place)
        .map(|pair| pair[0].place)
        .collect();
    if contested.is_empty() {
        return wishes;
    }
    contested.dedup();
    // Collects all that could be displaced: the objects at a contested place, the other places that
    // these could take, the objects there, and so on. Every other object keeps its nearest place.
    let mut reached: HashSet<Place> = contested.iter().copied().collect();
    let mut contestants = Vec::new();
    let mut objects = 0;
    while let Some(place) = contested.pop() {
        let first = wishes.partition_point(|wish| wish.place < place);
        for wish in wishes[first..]
            .iter()
            .take_while(|wish| wish.place == place)
        {
            for pairing in pairings(wish.object) {
                if reached.insert(pairing.place) {
                    contested.push(pairing.place);
                }
                contestants.push(Contestant {
                    pairing,
                    object: objects,
                    is_wish: pairing.place == place,
                    gate_sigmas,
                });
            }
            objects += 1;
        }
    }
    let mut settled: Vec<_> = wishes
        .into_iter()
        .filter(|wish| !reached.contains(&wish.place))
        .collect();
    settled.extend(
        assign(contestants, nearest_if_crowded)
            .iter()
            .map(|contestant| contestant.pairing),
    );
    settled.sort_by_key(|pairing| pairing.place);
    settled
}

/// A pairing in a contest.
#[derive(Debug, Clone, Copy)]
struct Contestant<'a> {
    pairing: Pairing<'a>,
    /// Number of the object in the contests of the report.
    object: u32,
    /// True if the place is the object's nearest.
    is_wish: bool,
    gate_sigmas: f64,
}

impl Candidate for Contestant<'_> {
    fn row(&self) -> u32 {
        self.object
    }

    fn column(&self) -> u32 {
        self.pairing.place.0
    }

    /// 1 − d²/g² in units of 2⁻⁴⁰, at least one unit.
    fn benefit(&self) -> i64 {
        const UNIT: f64 = (1i64 << 40) as f64;
        ((1.0 - self.pairing.distance_squared / (self.gate_sigmas * self.gate_sigmas)) * UNIT)
            as i64
            + 1
    }
}

/// Of a contest that is too large, the nearest object at each place.
fn nearest_if_crowded<'a>(
    size: ClusterSize,
    contest: &[Contestant<'a>],
) -> Option<Vec<Contestant<'a>>> {
    (size.rows.min(size.columns) > MAX_CONTEST).then(|| {
        // They come place by place, the nearest first.
        let mut nearest: Vec<_> = contest
            .iter()
            .filter(|contestant| contestant.is_wish)
            .copied()
            .collect();
        nearest.dedup_by_key(|contestant| contestant.pairing.place);
        nearest
    })
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const GATE_SIGMAS: f64 = 4.0;

    /// The distances of an object, in whole standard deviations squared, by place; 16 is the gate.
    type Distances = Vec<(u32, u32)>;

    fn objects(count: usize) -> Vec<PerceivedObject> {
        let object = |label: usize| PerceivedObject::new(label.to_string(), 0.9, 0.0, 0.0);
        (0..count).map(object).collect()
    }

    /// (object, place) of the assignment, by object.
    fn assigned(distances: &[Distances]) -> Vec<(usize, u32)> {
        let objects = objects(distances.len());
        let index = |object: &PerceivedObject| object.label.parse::<usize>().unwrap();
        let pairings = |object| {
            distances[index(object)]
                .iter()
                .map(move |(place, squared)| Pairing {
                    place: Place(*place),
                    object,
                    distance_squared: f64::from(*squared),
                })
        };
        let key = |pairing: &Pairing<'_>| (pairing.distance_squared as u32, pairing.place);
        let mut wishes: Vec<_> = objects
            .iter()
            .filter_map(|object| pairings(object).min_by_key(key))
            .collect();
        wishes.sort_by_key(|wish| (wish.place, wish.distance_squared as u32));
        let settled = one_to_one(wishes, pairings, GATE_SIGMAS);
        assert!(
            settled.is_sorted_by(|a, b| a.place < b.place),
            "ascending, and one object for a place"
        );
        let mut assigned: Vec<_> = settled
            .iter()
            .map(|pairing| (index(pairing.object), pairing.place.0))
            .collect();
        assigned.sort_unstable();
        assigned
    }

    fn total(distances: &[Distances], assigned: &[(usize, u32)]) -> u32 {
        assigned
            .iter()
            .map(|(object, place)| 16 - distance(&distances[*object], *place))
            .sum()
    }

    fn distance(distances: &Distances, place: u32) -> u32 {
        distances.iter().find(|(at, _)| *at == place).unwrap().1
    }

    /// The greatest benefit of any assignment of the objects to places that are free.
    fn brute_force(distances: &[Distances], taken: &mut Vec<u32>) -> u32 {
        let Some((first, others)) = distances.split_first() else {
            return 0;
        };
        let mut best = brute_force(others, taken);
        for (place, squared) in first {
            if !taken.contains(place) {
                taken.push(*place);
                best = best.max(16 - squared + brute_force(others, taken));
                taken.pop();
            }
        }
        best
    }

    fn any_distances() -> impl Strategy<Value = Vec<Distances>> {
        let object = prop::collection::btree_map(0..7u32, 0..=16u32, 0..5)
            .prop_map(|map| map.into_iter().collect());
        prop::collection::vec(object, 0..8)
    }

    proptest! {
        #[test]
        fn no_other_assignment_is_better(distances in any_distances()) {
            let assigned = assigned(&distances);
            prop_assert!(assigned.is_sorted_by(|a, b| a.0 < b.0), "one place for an object");
            prop_assert_eq!(total(&distances, &assigned), brute_force(&distances, &mut Vec::new()));
        }
    }

    #[test]
    fn contest_loser_takes_second_choice() {
        assert_eq!(
            assigned(&[vec![(0, 1), (1, 9)], vec![(0, 4), (1, 5)]]),
            [(0, 0), (1, 1)]
        );
    }

    #[test]
    fn contest_minimises_total_cost() {
        let row = [vec![(0, 4)], vec![(0, 3), (1, 4)], vec![(1, 2), (2, 4)]];
        assert_eq!(
            assigned(&row),
            [(0, 0), (1, 1), (2, 2)],
            "the nearest is reassigned, or one has no place"
        );
    }

    #[test]
    fn surplus_detection_stays_unassigned() {
        assert_eq!(
            assigned(&[vec![(3, 5)], vec![(3, 1)], vec![(3, 2)]]),
            [(1, 3)]
        );
    }

    #[test]
    fn nearest_win_in_enormous_contest() {
        let count = 2 * MAX_CONTEST as u32;
        let crowd: Vec<_> = (0..count)
            .flat_map(|n| [vec![(n, 1), (n + 1, 3)], vec![(n, 2), (n + 1, 4)]])
            .collect();
        let nearest: Vec<_> = (0..count).map(|n| (2 * n as usize, n)).collect();
        assert_eq!(assigned(&crowd), nearest);
    }
}
