//! Other cells' counts about vehicles, and the trust in their maps.

use uuid::Uuid;

use super::*;
use crate::model::geometry::{Covariance, Pose};
use crate::reputation::{CellCounts, Counts, ForeignReputations};
use crate::wire::{FieldOfView, FusedObject, NeighbourObject};

/// A report of two cars, with a view all around.
fn watching(node: &str, ms: u64) -> Arc<ObjectReport> {
    Arc::new(ObjectReport {
        objects: [0.0, 8.0]
            .map(|y_m| PerceivedObject::new("car", 0.9, 5.0, y_m))
            .into(),
        pose: Some(Pose::new(0.0, -8.0, 0.0).into()),
        moving: Some(false),
        view: Some(FieldOfView {
            range_m: 60.0,
            angle_rad: std::f64::consts::TAU,
        }),
        ..ObjectReport::new(NodeName::new(node).unwrap(), ms, at(ms))
    })
}

fn ghosts() -> Vec<NeighbourObject> {
    let ghost = |number: u128| {
        let x_m = 4.0 * number as f64 - 20.0;
        FusedObject {
            existence: Some(0.97),
            ..FusedObject::new(
                Uuid::from_u128(number),
                "car",
                0.95,
                x_m,
                -20.0,
                Covariance::isotropic(0.3),
            )
        }
    };
    (0..8)
        .map(|number| NeighbourObject {
            cell: NodeName::from_static("liar"),
            age_s: 0.1,
            object: ghost(number),
        })
        .collect()
}

#[test]
fn the_word_of_a_cell_weighs_as_little_as_its_map() {
    let config = FusionConfig {
        algorithms: Algorithms::Pace,
        ..FusionConfig::default()
    };
    let mut cell = Aggregator::new(NodeName::from_static("edge"), 7, config, Vec::new(), at(0));
    let mut reputations = ForeignReputations::default();
    let slander = CellCounts {
        all: Counts {
            correct: 0,
            incorrect: 90,
        },
        ..CellCounts::default()
    };
    let noether = NodeName::from_static("noether");
    reputations.merge(&NodeName::from_static("liar"), &noether, slander);
    cell.take_foreign(&reputations.into());
    let mut weights = Vec::new();
    for ms in (100..12_000).step_by(100) {
        if ms % 200 == 0 {
            cell.take_neighbours(&ghosts().into(), at(ms));
        }
        for node in ["euclid", "gauss", "noether"] {
            cell.report(Detections, &watching(node, ms), at(ms))
                .unwrap();
        }
        cell.tick(at(ms + 50));
        weights.extend(
            cell.take_foreign_news()
                .map(|votes| votes.get(&noether).map_or(0.0, |votes| votes.incorrect)),
        );
    }
    println!("weight of a slander while its cell's map is judged: {weights:.2?}");
    assert!(weights[0] > 1.0 && weights.is_sorted_by(|before, after| before >= after));
    assert_eq!(weights.last(), Some(&0.0));
}
