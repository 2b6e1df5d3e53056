//! The share of one vehicle in the map: objects that no other vehicle sees take a bounded part of
//! it.

use std::collections::BTreeMap;

use crate::model::names::{Label, NodeName};
use crate::wire::{FusedObject, InvalidEntry, RejectReason};

/// Maximum size in JSON of the objects in a map that only one vehicle has reported, including its
/// parts: about 330 objects with short labels. It is also the maximum size of a round's verdicts on
/// which only one vehicle voted. Ten maps per second then take about 11 Mbit/s of a link. Without
/// this bound, one member's reports could make the map too large for the links to carry once per
/// round.
pub(super) const MAX_SOLE_BYTES: usize = 128 * 1024;

/// Size in JSON of an object without its texts.
const NUMBERS_BYTES: usize = 352;

/// Size in JSON of one score without its label.
pub(super) const SCORE_BYTES: usize = 25;

/// Removes the objects beyond each vehicle's share, the least certain first and of equally certain
/// ones the last, and returns the removed entries.
pub(super) fn limit_shares(objects: &mut Vec<FusedObject>) -> Vec<InvalidEntry> {
    let mut sole: BTreeMap<&NodeName, Vec<usize>> = BTreeMap::new();
    for (place, object) in objects.iter().enumerate() {
        if let [vehicle] = &object.contributors[..] {
            sole.entry(vehicle).or_default().push(place);
        }
    }
    let mut is_kept = vec![true; objects.len()];
    for places in sole.values_mut() {
        let confidence = |place: usize| objects[place].confidence;
        places.sort_by(|one, other| confidence(*other).total_cmp(&confidence(*one)));
        let mut bytes = 0;
        for place in places {
            bytes += bytes_of(&objects[*place]);
            is_kept[*place] = bytes <= MAX_SOLE_BYTES;
        }
    }
    let mut is_kept = is_kept.into_iter();
    let removed = objects.extract_if(.., |_| is_kept.next() == Some(false));
    removed
        .map(|object| InvalidEntry {
            reason: RejectReason::TooManyObjects,
            contributors: object.contributors,
        })
        .collect()
}

/// About the size of an object in JSON.
fn bytes_of(object: &FusedObject) -> usize {
    let scores = object
        .scores
        .keys()
        .map(|label| escaped(label) + SCORE_BYTES);
    let names = object
        .contributors
        .iter()
        .chain(&object.vehicle)
        .map(|name| name.as_str().len());
    NUMBERS_BYTES + escaped(&object.label) + scores.sum::<usize>() + names.sum::<usize>()
}

/// Size in JSON of a label without its quotation marks.
pub(super) fn escaped(label: &Label) -> usize {
    label.len() + label.matches(['"', '\\']).count()
}

#[cfg(test)]
mod tests {
    use uuid::Uuid;

    use super::*;
    use crate::model::geometry::Covariance;
    use crate::model::time::Timestamp;

    /// Number of objects of the tests in a share.
    const KEPT: usize = MAX_SOLE_BYTES / (NUMBERS_BYTES + "car".len() + "mallory".len());

    fn object(number: usize, confidence: f64, contributors: &[&'static str]) -> FusedObject {
        let covariance = Covariance::isotropic(0.3);
        let contributors = contributors
            .iter()
            .map(|name| NodeName::from_static(name))
            .collect();
        FusedObject {
            contributors,
            ..FusedObject::new(
                Uuid::from_u128(number as u128),
                "car",
                confidence,
                number as f64,
                0.0,
                covariance,
            )
        }
    }

    #[test]
    fn vehicle_fills_only_its_share() {
        let invented =
            (0..5000).map(|number| object(number, 0.2 + 0.0001 * number as f64, &["mallory"]));
        let honest = (5000..5100).map(|number| object(number, 0.01, &["euclid"]));
        let shared = (5100..9000).map(|number| object(number, 0.01, &["euclid", "mallory"]));
        let mut objects: Vec<_> = invented.chain(honest).chain(shared).collect();
        let removed = limit_shares(&mut objects);
        assert_eq!(removed.len(), 5000 - KEPT);
        assert!(
            removed
                .iter()
                .all(|entry| entry.contributors == [NodeName::from_static("mallory")])
        );
        let of = |names: &[&'static str]| {
            let names: Vec<_> = names
                .iter()
                .map(|name| NodeName::from_static(name))
                .collect();
            objects
                .iter()
                .filter(|object| object.contributors == names)
                .count()
        };
        assert_eq!(
            [
                of(&["mallory"]),
                of(&["euclid"]),
                of(&["euclid", "mallory"])
            ],
            [KEPT, 100, 3900]
        );
        let least_certain = objects
            .iter()
            .filter(|object| object.contributors.len() == 1);
        let least_certain =
            least_certain.filter(|object| object.contributors[0].as_str() == "mallory");
        assert!(
            least_certain
                .map(|object| object.confidence)
                .fold(1.0, f64::min)
                > 0.59
        );
    }

    #[test]
    fn first_of_equals_stays() {
        let mut objects: Vec<_> = (0..2000)
            .map(|number| object(number, 0.5, &["mallory"]))
            .collect();
        assert_eq!(limit_shares(&mut objects).len(), 2000 - KEPT);
        assert_eq!(objects.last().unwrap().x_m, (KEPT - 1) as f64);
    }

    #[test]
    fn long_texts_reduce_object_count() {
        let long = "x".repeat(64);
        let wordy = |number| FusedObject {
            label: long.clone().into(),
            scores: (0..8)
                .map(|class| (format!("{class}{long}").into(), 0.123_456_789))
                .collect(),
            covariance_m2: [0.123_456_789_012; 3],
            existence: Some(0.123_456_789_012),
            velocity_mps: Some([12.345_678_901_234; 2]),
            heading_rad: Some(1.234_567_890_123),
            size_m: Some([4.567_890_123_456; 2]),
            age_s: Some(0.123_456_789_012),
            first_seen_us: Some(Timestamp(1_795_000_000_000_000)),
            ..object(number, 0.5, &["mallory"])
        };
        let mut objects: Vec<_> = (0..1024).map(wordy).collect();
        assert!(!limit_shares(&mut objects).is_empty());
        let json = objects
            .iter()
            .map(|object| serde_json::to_vec(object).unwrap().len());
        let bytes: usize = json.sum();
        assert!(
            (MAX_SOLE_BYTES * 3 / 4..MAX_SOLE_BYTES * 5 / 4).contains(&bytes),
            "{bytes}"
        );
    }
}
