mod accepted_by_receivers;
mod configure;
mod one_answer;

use std::collections::BTreeSet;

use ReportKind::{Detections, VoteDetections};
use nalgebra::Point2;

use super::*;
use crate::aggregator::round::{RoundClose, RoundConfig};
use crate::tracking::TracksConfig;
use crate::vote::VoteConfig;
use crate::wire::PerceivedObject;

const START: u64 = 1_732_154_400_000_000;

fn at(ms: u64) -> Timestamp {
    Timestamp(START + ms * 1000)
}

fn landmarks() -> Vec<Landmark> {
    let ball = Point2::new(1.0, 0.0);
    vec![Landmark {
        id: "ball".into(),
        position: ball,
        facing_rad: None,
        vacancy: None,
        synonyms: vec![],
    }]
}

fn report(node: &str, label: &str, captured_ms: u64) -> Arc<ObjectReport> {
    Arc::new(ObjectReport {
        objects: vec![PerceivedObject {
            landmark: Some("ball".into()),
            ..PerceivedObject::new(label, 0.9, 1.0, 0.0)
        }],
        ..ObjectReport::new(NodeName::new(node).unwrap(), captured_ms, at(captured_ms))
    })
}

fn leader(config: FusionConfig) -> Aggregator {
    Aggregator::new(NodeName::from_static("edge"), 7, config, landmarks(), at(0))
}

fn shown(fused: &Fused) -> (Option<&str>, Option<&str>) {
    let map = fused
        .map
        .as_ref()
        .and_then(|map| map.landmarks[0].label.as_deref());
    (
        map,
        fused
            .verdicts
            .as_ref()
            .and_then(|verdicts| verdicts.verdicts[0].label.as_deref()),
    )
}

#[test]
fn busy_observer_fits_its_share() {
    let config = FusionConfig {
        round: RoundConfig {
            close: RoundClose::Periodic,
            ..RoundConfig::default()
        },
        ..FusionConfig::default()
    };
    let mut cell = Aggregator::new(NodeName::from_static("edge"), 7, config, vec![], at(0));
    let mut last = None;
    for round in 0..30 {
        let now = at(round * 100 + 50);
        let objects = (0..300_u32).map(|number| {
            let x_m = f64::from(number % 20) * 4.0;
            PerceivedObject::new("person", 0.9, x_m, f64::from(number / 20) * 4.0)
        });
        let report = ObjectReport {
            objects: objects.collect(),
            ..ObjectReport::new(NodeName::from_static("observer"), round, now)
        };
        cell.report(Detections, &Arc::new(report), now).unwrap();
        last = cell.tick(at(round * 100 + 100));
    }
    let fused = last.expect("rounds were closed");
    assert_eq!(fused.map.unwrap().objects.len(), 300);
    assert!(fused.left_out.is_empty(), "{:?}", fused.left_out);
}

#[test]
fn expelled_vehicles_objects_leave_map() {
    let tracks = TracksConfig {
        mode: TracksMode::On,
        ..TracksConfig::default()
    };
    let round = RoundConfig {
        close: RoundClose::Periodic,
        ..RoundConfig::default()
    };
    let mut cell = leader(FusionConfig {
        tracks,
        round,
        ..FusionConfig::default()
    });
    let mallory = NodeName::from_static("mallory");
    let euclid = NodeName::from_static("euclid");
    let reporters = |cell: &mut Aggregator, rounds: std::ops::Range<u64>| {
        let mut last = BTreeSet::new();
        for round in rounds {
            let now = at(round * 100);
            // The vehicle is silent for a second when its certificate is revoked.
            let silent = (21..31).contains(&round);
            for (node, y_m) in [(&mallory, 30.0), (&euclid, -30.0)] {
                if silent && *node == mallory {
                    continue;
                }
                let report = ObjectReport {
                    objects: vec![PerceivedObject::new("car", 0.9, 20.0, y_m)],
                    ..ObjectReport::new(node.clone(), round, at(round * 100 - 20))
                };
                cell.report(
                    Detections,
                    &Arc::new(report),
                    now - Duration::from_millis(10),
                )
                .unwrap();
            }
            let map = cell.tick(now).unwrap().map.unwrap();
            last = map
                .objects
                .into_iter()
                .flat_map(|object| object.contributors)
                .collect();
        }
        last
    };
    let both = BTreeSet::from([mallory.clone(), euclid.clone()]);
    assert_eq!(reporters(&mut cell, 1..21), both);
    assert_eq!(
        reporters(&mut cell, 21..22),
        both,
        "it outlives a detection"
    );
    cell.expel(mallory.clone(), at(2150));
    assert_eq!(
        reporters(&mut cell, 22..31),
        BTreeSet::from([euclid.clone()])
    );
    assert_eq!(
        reporters(&mut cell, 31..41),
        both,
        "it has a new certificate"
    );
}

#[test]
fn expelled_vehicles_votes_stop_counting() {
    let round = RoundConfig {
        close: RoundClose::Periodic,
        ..RoundConfig::default()
    };
    let mut cell = leader(FusionConfig {
        round,
        ..FusionConfig::default()
    });
    let vote = |cell: &mut Aggregator, node: &str, label: &str, closes_ms| {
        let report = report(node, label, closes_ms - 20);
        cell.report(VoteDetections, &report, at(closes_ms - 10))
            .unwrap();
    };
    let verdict = |cell: &mut Aggregator, closes_ms| {
        let fused = cell.tick(at(closes_ms)).unwrap();
        let verdict = fused.verdicts.unwrap().verdicts.remove(0);
        (verdict.label, verdict.contributors)
    };
    for round in 1..=10 {
        vote(&mut cell, "mallory", "red", round * 100);
        vote(&mut cell, "mallory--2", "red", round * 100);
        verdict(&mut cell, round * 100);
    }
    vote(&mut cell, "euclid", "green", 1100);
    verdict(&mut cell, 1100);
    cell.expel(NodeName::from_static("mallory"), at(1150));
    let euclid = NodeName::from_static("euclid");
    assert_eq!(
        verdict(&mut cell, 1200),
        (Some("green".into()), vec![euclid]),
        "long before its votes are stale"
    );
}

#[test]
fn successive_expulsions_remove_shared_object() {
    let mut cell = leader(FusionConfig {
        tracks: TracksConfig {
            mode: TracksMode::On,
            ..TracksConfig::default()
        },
        round: RoundConfig {
            close: RoundClose::Periodic,
            ..RoundConfig::default()
        },
        ..FusionConfig::default()
    });
    let mallory = NodeName::from_static("mallory");
    let watson = NodeName::from_static("watson");
    let contributors = |cell: &mut Aggregator, rounds: std::ops::Range<u64>| {
        let mut last = Vec::new();
        for round in rounds {
            let now = at(round * 100);
            for (node, until) in [(&mallory, 20), (&watson, 30)] {
                if round < until {
                    let report = ObjectReport {
                        objects: vec![PerceivedObject::new("car", 0.9, 20.0, 30.0)],
                        ..ObjectReport::new(node.clone(), round, at(round * 100 - 20))
                    };
                    let report = Arc::new(report);
                    cell.report(Detections, &report, now - Duration::from_millis(10))
                        .unwrap();
                }
            }
            let map = cell.tick(now).and_then(|fused| fused.map);
            last = map.map_or(last, |map| {
                let objects = map.objects.into_iter();
                objects.map(|object| object.contributors).collect()
            });
        }
        last
    };
    assert_eq!(
        contributors(&mut cell, 1..20),
        [vec![mallory.clone(), watson.clone()]]
    );
    cell.expel(mallory.clone(), at(1950));
    assert_eq!(contributors(&mut cell, 20..30), [vec![watson.clone()]]);
    cell.expel(watson.clone(), at(2950));
    assert_eq!(contributors(&mut cell, 30..32), Vec::<Vec<NodeName>>::new());
}

/// Bytes in JSON of the verdicts of a round, and their landmarks.
fn size_of(fused: Option<Fused>) -> (usize, Vec<LandmarkId>) {
    let verdicts = fused.and_then(|fused| fused.verdicts).unwrap();
    let bytes = serde_json::to_vec(&verdicts).unwrap().len();
    let landmarks = verdicts.verdicts.into_iter();
    (bytes, landmarks.map(|verdict| verdict.landmark).collect())
}

/// A vehicle alone names 1000 places in each round, with labels that take much room.
#[test]
fn sole_verdicts_are_spread_over_rounds() {
    let round = RoundConfig {
        close: RoundClose::Periodic,
        ..RoundConfig::default()
    };
    let config = FusionConfig {
        algorithms: Algorithms::Vote,
        round,
        ..FusionConfig::default()
    };
    let mut cell = Aggregator::new(NodeName::from_static("edge"), 7, config, vec![], at(0));
    let mut rounds_of: BTreeMap<LandmarkId, usize> = BTreeMap::new();
    for round in 1..=20 {
        let now = at(round * 100);
        for node in ["euclid", "gauss"] {
            let report = report(node, "cup", round * 100 - 20);
            cell.report(VoteDetections, &report, at(round * 100 - 10))
                .unwrap();
        }
        let place = |number: u32| PerceivedObject {
            landmark: Some(format!("nowhere-{number}").into()),
            ..PerceivedObject::new("\"".repeat(64).as_str(), 0.9, 1.0, 0.0)
        };
        let invented = ObjectReport {
            objects: (0..1000).map(place).collect(),
            ..ObjectReport::new(
                NodeName::from_static("mallory"),
                round,
                at(round * 100 - 20),
            )
        };
        cell.report(VoteDetections, &Arc::new(invented), at(round * 100 - 10))
            .unwrap();
        let (bytes, landmarks) = size_of(cell.tick(now));
        assert!(bytes < 160 * 1024, "{bytes} bytes in round {round}");
        assert!(landmarks.contains(&"ball".into()), "round {round}");
        for landmark in landmarks {
            *rounds_of.entry(landmark).or_default() += 1;
        }
    }
    assert_eq!(rounds_of.len(), 1001, "no place is left out for good");
    assert!(rounds_of.values().all(|rounds| *rounds >= 4), "all in turn");
}

#[test]
fn map_and_verdicts_close_together() {
    let round = RoundConfig {
        close: RoundClose::Periodic,
        ..RoundConfig::default()
    };
    let mut cell = leader(FusionConfig {
        round,
        ..FusionConfig::default()
    });
    for round in 1..=3 {
        let now = at(round * 100);
        for kind in [Detections, VoteDetections] {
            cell.report(
                kind,
                &report("euclid", "cup", round * 100 - 10),
                now - std::time::Duration::from_millis(5),
            )
            .unwrap();
        }
        let fused = cell.tick(now).unwrap();
        let map = fused.map.clone().unwrap();
        let verdicts = fused.verdicts.clone().unwrap();
        assert_eq!((map.epoch, map.round, map.fused_at_us), (7, round, now));
        assert_eq!(
            (verdicts.epoch, verdicts.round, verdicts.fused_at_us),
            (7, round, now)
        );
        assert_eq!(
            (verdicts.aggregator.as_str(), shown(&fused).1),
            ("edge", Some("cup"))
        );
        assert_eq!(
            verdicts.verdicts[0].contributors,
            [NodeName::from_static("euclid")]
        );
    }
}

#[test]
fn frame_counts_once_per_kind() {
    let mut cell = leader(FusionConfig::default());
    let frame = report("euclid", "cup", 10);
    assert_eq!(cell.report(Detections, &frame, at(12)), Ok(None));
    assert_eq!(cell.report(VoteDetections, &frame, at(12)), Ok(None));
    for kind in [Detections, VoteDetections] {
        assert_eq!(
            cell.report(kind, &frame, at(13)),
            Err(RejectReason::OutOfOrder)
        );
    }
    let old = report("gauss", "cup", 10);
    assert_eq!(
        cell.report(VoteDetections, &old, at(9000)),
        Err(RejectReason::Stale)
    );
}

#[test]
fn reports_for_disabled_algorithm_refused() {
    for (algorithms, kind, other) in [
        (Algorithms::Pace, Detections, VoteDetections),
        (Algorithms::Vote, VoteDetections, Detections),
    ] {
        let mut cell = leader(FusionConfig {
            algorithms,
            ..FusionConfig::default()
        });
        assert_eq!(
            cell.report(kind, &report("euclid", "cup", 10), at(11)),
            Ok(None)
        );
        assert_eq!(
            cell.report(other, &report("euclid", "cup", 10), at(11)),
            Err(RejectReason::NotFused)
        );
        let fused = cell.tick(at(100)).unwrap();
        assert_eq!(fused.map.is_some(), algorithms.pace());
        assert_eq!(fused.verdicts.is_some(), algorithms.vote());
    }
}

#[test]
fn verdicts_start_with_first_vote() {
    let mut cell = leader(FusionConfig::default());
    cell.report(Detections, &report("euclid", "cup", 10), at(12))
        .unwrap();
    let silent = cell.tick(at(100)).unwrap();
    assert!(silent.map.is_some() && silent.verdicts.is_none());
    cell.report(VoteDetections, &report("euclid", "cup", 110), at(112))
        .unwrap();
    assert!(cell.tick(at(200)).unwrap().verdicts.is_some());
    assert!(
        cell.tick(at(20_000)).unwrap().verdicts.is_some(),
        "silence is a verdict once there were votes"
    );
}

#[test]
fn standby_leads_with_its_state() {
    let mut cell = Aggregator::new_standby(FusionConfig::default(), landmarks(), at(0));
    for step in 1..=20 {
        for kind in [Detections, VoteDetections] {
            assert_eq!(
                cell.report(kind, &report("euclid", "cup", step * 50), at(step * 50)),
                Ok(None)
            );
        }
        assert_eq!(cell.tick(at(step * 50 + 20)), None);
    }
    let epoch = Epoch::new(3, NodeName::from_static("gauss"));
    cell.lead(epoch.clone(), 88, FirstRound::Overdue, at(1030));
    let first = cell.tick(at(1030)).expect("due at once");
    assert_eq!(
        (first.epoch.clone(), first.round, shown(&first)),
        (epoch.clone(), 88, (Some("cup"), Some("cup")))
    );
    cell.lead(epoch, 89, FirstRound::OnTime, at(1040));
    assert_eq!(cell.tick(at(1139)), None);
    assert_eq!(cell.tick(at(1140)).map(|fused| fused.round), Some(89));
    cell.lead(
        Epoch::new(4, NodeName::from_static("gauss")),
        90,
        FirstRound::AfterConnects,
        at(1140),
    );
    assert_eq!(
        cell.report(
            ReportKind::Detections,
            &report("euclid", "cup", 1150),
            at(1150)
        ),
        Ok(None)
    );
    assert_eq!(cell.tick(at(1164)), None, "the others are still connecting");
    assert_eq!(cell.tick(at(1165)).map(|fused| fused.round), Some(90));
    cell.step_down();
    assert_eq!(cell.tick(at(1300)), None);
}

#[test]
fn paper_verdicts_follow_packets() {
    let vote = VoteConfig {
        mode: VoteMode::Paper,
        ..VoteConfig::default()
    };
    let config = FusionConfig {
        algorithms: Algorithms::Vote,
        vote,
        ..FusionConfig::default()
    };
    let mut cell = leader(config);
    let rounds: Vec<_> = (1..=10)
        .filter_map(|frame| {
            let now = at(frame * 100);
            cell.report(VoteDetections, &report("euclid", "cup", frame * 100), now)
                .unwrap()
                .or_else(|| cell.tick(now))
        })
        .map(|fused| {
            (
                fused.round,
                fused.verdicts.unwrap().verdicts[0].votes["cup"],
            )
        })
        .collect();
    assert_eq!(
        rounds.iter().map(|(round, _)| *round).collect::<Vec<_>>(),
        [1, 2]
    );
    assert!(rounds[1].1 > rounds[0].1, "the paper's scores are sums");
}

#[test]
fn settled_votes_become_adopted_evidence() {
    let config = FusionConfig {
        round: RoundConfig {
            period_s: 0.5,
            ..RoundConfig::default()
        },
        ..Default::default()
    };
    let mut cell = leader(config.clone());
    let mut ledger = ReputationLedger::default();
    for step in 1..=60u64 {
        for (node, label) in [("euclid", "cup"), ("gauss", "cup"), ("liar", "dog")] {
            let fused = cell
                .report(
                    VoteDetections,
                    &report(node, label, step * 500),
                    at(step * 500),
                )
                .unwrap();
            for (fused, evidence) in fused
                .iter()
                .flat_map(|f| f.evidence.iter().map(move |e| (f, e)))
            {
                ledger.record(fused.epoch.term, &fused.epoch.leader, evidence);
            }
        }
    }
    assert!(ledger.totals()[&NodeName::from_static("liar")].1 > 5);
    let mut other = leader(config);
    other.adopt(&ledger);
    let reputations = other.reputations();
    assert!(
        reputations[&NodeName::from_static("euclid")].score
            > reputations[&NodeName::from_static("liar")].score
    );
}

/// All that the cell settles of votes from `from_ms` to `until_ms` and of silence for three
/// seconds, by vehicle.
fn settled(
    cell: &mut Aggregator,
    nodes: &[&str],
    from_ms: u64,
    until_ms: u64,
) -> BTreeMap<NodeName, usize> {
    let mut settled = BTreeMap::new();
    for step in (from_ms / 100)..(until_ms / 100 + 30) {
        let mut closed = Vec::new();
        if step < until_ms / 100 {
            for node in nodes {
                closed.extend(
                    cell.report(
                        VoteDetections,
                        &report(node, "cup", step * 100),
                        at(step * 100),
                    )
                    .unwrap(),
                );
            }
        }
        closed.extend(cell.tick(at(step * 100 + 50)));
        for evidence in closed.into_iter().flat_map(|fused| fused.evidence) {
            *settled.entry(evidence.node).or_default() += 1;
        }
    }
    settled
}

#[test]
fn open_votes_settle_on_one_side() {
    let mut edge = leader(FusionConfig::default());
    let mut standby = Aggregator::new_standby(FusionConfig::default(), landmarks(), at(0));
    for step in 1..10u64 {
        for node in ["euclid", "gauss"] {
            let vote = report(node, "cup", step * 100);
            edge.report(VoteDetections, &vote, at(step * 100)).unwrap();
            standby
                .report(VoteDetections, &vote, at(step * 100))
                .unwrap();
        }
    }
    standby.lead(
        Epoch::new(4, NodeName::from_static("standby")),
        10,
        FirstRound::Overdue,
        at(950),
    );
    // Both vehicles lose the standby, and one of them also the edge: each has voted for less than
    // two seconds.
    let at_the_edge = settled(&mut edge, &["euclid"], 1000, 1500);
    let at_the_standby = settled(&mut standby, &[], 1000, 1500);
    assert_eq!(
        at_the_edge.values().copied().collect::<Vec<_>>(),
        [1, 1],
        "{at_the_edge:?}"
    );
    assert!(at_the_standby.is_empty(), "{at_the_standby:?}");
}

#[test]
fn new_leader_counts_later_votes() {
    let mut standby = Aggregator::new_standby(FusionConfig::default(), landmarks(), at(0));
    let before = settled(&mut standby, &["euclid", "gauss"], 100, 1000);
    assert!(before.is_empty());
    standby.lead(
        Epoch::new(4, NodeName::from_static("standby")),
        10,
        FirstRound::Overdue,
        at(5000),
    );
    let after = settled(&mut standby, &["euclid", "gauss"], 5000, 6000);
    assert_eq!(
        after.values().copied().collect::<Vec<_>>(),
        [1, 1],
        "{after:?}"
    );
}

#[test]
fn untimely_vehicle_deposes_no_leader() {
    let mut cell = leader(FusionConfig::default());
    let mut last = Timeliness::default();
    for n in 0..100 {
        for kind in [Detections, VoteDetections] {
            // A clock that jumps too much to be estimated.
            let _rejected = cell.report(kind, &report("bad", "cup", n * 10_000), at(n * 100 + 2));
        }
        last = cell.timeliness(at(n * 100 + 2));
    }
    assert_eq!(
        (last, last.is_usable()),
        (
            Timeliness {
                timely: 0,
                untimely: 1
            },
            true
        )
    );
}

#[test]
fn vehicle_parts_are_one_witness() {
    let mut cell = leader(FusionConfig::default());
    for (n, part) in (0..).zip(["euclid", "euclid--lidar", "euclid--radar", "gauss"]) {
        let label = if part == "gauss" { "car" } else { "cup" };
        for kind in [Detections, VoteDetections] {
            cell.report(kind, &report(part, label, 10 + n), at(15 + n))
                .unwrap();
        }
    }
    let fused = cell.tick(at(100)).unwrap();
    let map = fused.map.unwrap();
    let verdicts = fused.verdicts.unwrap();
    let verdict = &verdicts.verdicts[0];
    assert_eq!(
        verdict.contributors,
        ["euclid", "gauss"].map(NodeName::from_static)
    );
    let votes: Vec<_> = verdict.votes.values().collect();
    assert!(
        (votes[0] - votes[1]).abs() < 1e-9,
        "three parts against one vehicle: {:?}",
        verdict.votes
    );
    assert!(
        map.landmarks[0]
            .observers
            .iter()
            .all(|node| !node.as_str().contains("--")),
        "{:?}",
        map.landmarks
    );
}

/// Frames of a slower camera are older than frames of a faster camera that arrived earlier, and the
/// slower camera has sent fewer.
#[test]
fn cameras_of_vehicle_may_overtake() {
    let mut cell = leader(FusionConfig::default());
    for n in 1..=5 {
        for (camera, captured_ms) in [("euclid", n * 100), ("euclid--rear", n * 100 - 40)] {
            for kind in [Detections, VoteDetections] {
                let taken =
                    cell.report(kind, &report(camera, "cup", captured_ms), at(n * 100 + 20));
                assert!(taken.is_ok(), "{camera} {n}: {taken:?}");
            }
        }
    }
}
