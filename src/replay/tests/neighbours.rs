//! Objects of neighbouring cells in a recorded run.

use uuid::Uuid;

use super::*;
use crate::aggregator::Command;
use crate::model::geometry::Covariance;
use crate::reputation::ReputationLedger;
use crate::wire::{FusedObject, GlobalMap, NeighbourObject};

fn at(ms: u64) -> Timestamp {
    Timestamp(START + ms * 1000)
}

/// A car that goes east at 10 m/s and is at 0 m after a second.
fn car_at(ms: u64) -> f64 {
    ms as f64 / 100.0 - 10.0
}

fn neighbours(ms: u64) -> Arc<[NeighbourObject]> {
    let of = |number, x_m, y_m| FusedObject {
        velocity_mps: Some([10.0, 0.0]),
        first_seen_us: Some(at(0) - Duration::from_secs(5)),
        existence: Some(0.9),
        ..FusedObject::new(
            Uuid::from_u128(number),
            "car",
            0.9,
            x_m,
            y_m,
            Covariance::isotropic(0.3),
        )
    };
    let cell = NodeName::from_static("west");
    let objects = [of(7, car_at(ms - 100), 0.0), of(8, -40.0, 0.0)];
    objects
        .map(|object| NeighbourObject {
            cell: cell.clone(),
            age_s: 0.1,
            object,
        })
        .into()
}

#[test]
fn neighbour_objects_replay_exactly() {
    let fusion = FusionConfig {
        algorithms: Algorithms::Pace,
        ..FusionConfig::default()
    };
    let mut live = Aggregator::new_standby(fusion.clone(), Vec::new(), at(0));
    let mut journal = JournalReplay::new(fusion, Vec::new());
    let ledger = Arc::new(ReputationLedger::default());
    journal.entry(&JournalEntry {
        at_us: at(0),
        event: JournalEvent::Start { ledger },
    });
    let (mut maps, mut replayed): (Vec<GlobalMap>, Vec<GlobalMap>) = Default::default();
    let map = |line| {
        if let FusedLine::Map(map) = line {
            Some(map)
        } else {
            None
        }
    };
    let lead = Command::Lead {
        epoch: crate::model::epoch::Epoch::new(3, NodeName::from_static("edge")),
        first_round: 1,
        first: crate::aggregator::round::FirstRound::OnTime,
    };
    for ms in (50..4000).step_by(50) {
        let mut commands = Vec::new();
        commands.extend((ms == 50).then(|| lead.clone()));
        commands.extend((ms == 150).then_some(Command::SetCellOffset {
            offset_us: 1_000_000,
        }));
        if ms % 500 == 0 && ms <= 2000 {
            commands.push(Command::OnNeighbours {
                objects: neighbours(ms),
                stated_at: at(ms),
            });
        }
        commands.push(Command::Tick);
        for command in commands {
            maps.extend(live.command(&command, at(ms)).and_then(|fused| fused.map));
            let json = serde_json::to_vec(&JournalEntry {
                at_us: at(ms),
                event: JournalEvent::Command(command),
            });
            let entry: JournalEntry = serde_json::from_slice(&json.unwrap()).unwrap();
            replayed.extend(journal.entry(&entry).into_iter().filter_map(map));
        }
        if ms >= 1000 && ms % 100 == 50 {
            let car = PerceivedObject::new("car", 0.9, car_at(ms - 10), 0.0);
            let stamp = at(ms - 10).shifted(if ms < 150 { 0 } else { 1_000_000 });
            let seen = ObjectReport {
                objects: vec![car],
                ..ObjectReport::new(NodeName::from_static("euclid"), ms, stamp)
            };
            let seen = Arc::new(seen);
            maps.extend(
                live.report(ReportKind::Detections, &seen, at(ms))
                    .unwrap()
                    .and_then(|fused| fused.map),
            );
            replayed.extend(
                journal
                    .report(ReportKind::Detections, &seen, at(ms))
                    .into_iter()
                    .filter_map(map),
            );
        }
    }
    assert_eq!(
        serde_json::to_string(&maps).unwrap(),
        serde_json::to_string(&replayed).unwrap()
    );
    let ids = |map: &GlobalMap| -> Vec<u128> {
        map.neighbour_objects
            .iter()
            .map(|o| o.object.id.as_u128())
            .collect()
    };
    let at_time = |ms: u64| {
        maps.iter()
            .rfind(|map| map.fused_at_us <= at(ms + 1000))
            .unwrap()
    };
    assert_eq!(ids(at_time(900)), [7, 8]);
    assert_eq!(ids(at_time(1600)), [8], "it has come over");
    let came = at_time(1600)
        .objects
        .iter()
        .find(|object| object.id.as_u128() == 7)
        .unwrap();
    assert_eq!(
        came.first_seen_us,
        Some(at(1000) - Duration::from_secs(5)),
        "in the cell's time"
    );
    assert!(
        at_time(3300)
            .neighbour_objects
            .iter()
            .all(|near| near.age_s <= 1.5)
    );
    assert_eq!(ids(at_time(3300)), [8]);
    assert_eq!(ids(at_time(3700)), [], "too old");
}
