mod neighbours;

use nalgebra::Point2;

use super::*;
use crate::model::geometry::Pose;
use crate::perception::landmark::VacancySign;
use crate::vote::VoteMode;
use crate::wire::{Encoding, PerceivedObject, WirePose, encode};

const START: u64 = 1_700_000_000_000_000;

fn report(node: &str, at_ms: u64, votes: &[(&str, &str)]) -> ObjectReport {
    let object = |(n, &(landmark, label)): (usize, &(&str, &str))| PerceivedObject {
        landmark: Some(landmark.into()),
        ..PerceivedObject::new(label, 0.9, 5.0 * n as f64, 0.0)
    };
    ObjectReport {
        objects: votes.iter().enumerate().map(object).collect(),
        ..ObjectReport::new(
            NodeName::new(node).unwrap(),
            at_ms,
            Timestamp(START + at_ms * 1000),
        )
    }
}

fn line(report: &ObjectReport, more: &[(&str, serde_json::Value)]) -> String {
    let mut line = serde_json::to_value(report).unwrap();
    for (key, value) in more {
        line[*key] = value.clone();
    }
    line.to_string()
}

fn vote_line(report: &ObjectReport) -> String {
    line(report, &[("topic", "vote_detections".into())])
}

fn replay(
    config: ReplayConfig,
    lines: impl IntoIterator<Item = impl AsRef<[u8]>>,
) -> (Vec<FusedLine>, Summary) {
    let mut replay = Replay::new(config);
    let mut output: Vec<_> = lines
        .into_iter()
        .flat_map(|line| replay.line(line.as_ref()))
        .collect();
    let (mut rest, summary) = replay.finish();
    output.append(&mut rest);
    (output, summary)
}

fn rejected(summary: &Summary) -> Vec<(RejectReason, u64)> {
    summary
        .rejected
        .iter()
        .map(|(reason, rejections)| (*reason, rejections.lines))
        .collect()
}

fn map_labels(output: &[FusedLine]) -> Vec<(String, Option<String>)> {
    let last = output.iter().rev().find_map(|line| {
        if let FusedLine::Map(map) = line {
            Some(map)
        } else {
            None
        }
    });
    let state = |s: &crate::wire::LandmarkState| {
        (s.id.to_string(), s.label.as_ref().map(ToString::to_string))
    };
    last.map(|map| map.landmarks.iter().map(state).collect())
        .unwrap_or_default()
}

fn verdict_labels(output: &[FusedLine]) -> BTreeMap<String, Option<String>> {
    let verdicts = |line: &FusedLine| {
        if let FusedLine::Verdicts(v) = line {
            v.verdicts.clone()
        } else {
            Vec::new()
        }
    };
    let pair = |v: crate::wire::Verdict| {
        (
            v.landmark.to_string(),
            v.label.map(|label| label.to_string()),
        )
    };
    output.iter().flat_map(verdicts).map(pair).collect()
}

#[test]
fn open_cell_learns_landmarks() {
    let both = [("slot-0", "car"), ("slot-1", "truck")];
    let mut lines = Vec::new();
    for step in 0..5 {
        lines.push(line(
            &report("euclid", step * 100, &both[..1 + usize::from(step > 2)]),
            &[],
        ));
        lines.push(vote_line(&report(
            "euclid",
            step * 100,
            &[("ball", "vase")],
        )));
    }
    let (output, summary) = replay(ReplayConfig::default(), &lines);
    let label = |text: &str| Some(text.to_owned());
    assert_eq!(
        map_labels(&output),
        [
            ("slot-0".into(), label("car")),
            ("slot-1".into(), label("truck"))
        ]
    );
    assert_eq!(
        verdict_labels(&output),
        BTreeMap::from([("ball".into(), label("vase"))])
    );
    assert_eq!(
        (summary.lines, summary.used(), summary.written),
        (10, 10, output.len() as u64)
    );
}

/// One report that names more places than fit in a round's verdicts.
#[test]
fn last_report_loses_no_verdict() {
    let label = "\"".repeat(64);
    let places: Vec<_> = (0..1000).map(|place| format!("place-{place}")).collect();
    let votes: Vec<_> = places
        .iter()
        .map(|place| (place.as_str(), label.as_str()))
        .collect();
    let (output, _) = replay(
        ReplayConfig::default(),
        [vote_line(&report("a", 0, &votes))],
    );
    assert_eq!(verdict_labels(&output).len(), 1000);
}

#[test]
fn output_covers_reported_kind_only() {
    let lines: Vec<_> = (0..5)
        .map(|step| vote_line(&report("a", step * 100, &[("x", "cup")])))
        .collect();
    let (output, _) = replay(ReplayConfig::default(), &lines);
    assert!(
        !output.is_empty()
            && output
                .iter()
                .all(|line| matches!(line, FusedLine::Verdicts(_)))
    );
}

#[test]
fn every_bad_line_has_reason() {
    use RejectReason::{Malformed, NodeMismatch, TooLarge, UnknownSchema, UnknownTopic};
    let good = report("a", 0, &[("x", "cup")]);
    let cbor = encode(&good, Encoding::Cbor);
    let lines: [(Vec<u8>, Option<RejectReason>); 12] = [
        (line(&good, &[]).into(), None),
        (b"  \t".to_vec(), None),
        (b"not json".to_vec(), Some(Malformed)),
        (
            line(&good, &[]).into_bytes()[..80].to_vec(),
            Some(Malformed),
        ),
        (
            b"{\"schema\":1,\"node\":\"\xff\"}".to_vec(),
            Some(Malformed),
        ),
        (cbor, Some(Malformed)),
        (
            line(&good, &[("schema", 2.into())]).into(),
            Some(UnknownSchema),
        ),
        (
            line(&good, &[("topic", "reputations".into())]).into(),
            Some(UnknownTopic),
        ),
        (
            line(&good, &[("topic", "detections/b".into())]).into(),
            Some(NodeMismatch),
        ),
        (
            line(&good, &[("received_at_us", "noon".into())]).into(),
            Some(Malformed),
        ),
        (vec![b' '; 1 << 20], None),
        (
            [line(&good, &[]).into_bytes(), vec![b'x'; 1 << 20]].concat(),
            Some(TooLarge),
        ),
    ];
    let (output, summary) = replay(ReplayConfig::default(), lines.iter().map(|(line, _)| line));
    let mut expected: BTreeMap<RejectReason, u64> = BTreeMap::new();
    for reason in lines.iter().filter_map(|(_, reason)| *reason) {
        *expected.entry(reason).or_default() += 1;
    }
    assert_eq!(rejected(&summary), expected.into_iter().collect::<Vec<_>>());
    assert_eq!((summary.lines, summary.used(), output.len()), (10, 1, 1));
}

#[test]
fn nothing_in_is_nothing_out() {
    let (output, summary) = replay(ReplayConfig::default(), [""; 0]);
    assert!(output.is_empty() && summary == Summary::default());
    let (output, _) = replay(
        ReplayConfig {
            passes: Some(3),
            ..ReplayConfig::default()
        },
        ["", "junk"],
    );
    assert!(output.is_empty());
}

#[test]
fn full_topics_and_receipt_times_work() {
    let late = report("a", 0, &[("x", "cup")]);
    let topic = (
        "topic",
        serde_json::Value::from("ecod/v1/lot-1/vote_detections/a"),
    );
    let received = |ms: u64| ("received_at_us", serde_json::Value::from(START + ms * 1000));
    let (output, _) = replay(
        ReplayConfig::default(),
        [line(&late, &[topic.clone(), received(700)])],
    );
    let FusedLine::Verdicts(verdicts) = &output[0] else {
        panic!("{output:?}")
    };
    assert!(verdicts.fused_at_us >= Timestamp(START + 700_000));
    let first = line(&report("b", 0, &[("x", "cup")]), &[]);
    let (_, summary) = replay(
        ReplayConfig::default(),
        [first, line(&late, &[topic, received(9000)])],
    );
    assert_eq!(rejected(&summary), [(RejectReason::Stale, 1)]);
}

#[test]
fn wrong_clock_moves_no_time() {
    let hour = 3_600_000;
    let mut lines = Vec::new();
    for step in 0..20 {
        lines.push(line(
            &report("wrong", step * 100 + hour, &[("x", "truck")]),
            &[],
        ));
        lines.push(line(&report("a", step * 100 + 20, &[("x", "car")]), &[]));
        lines.push(line(&report("b", step * 100, &[("x", "car")]), &[]));
    }
    let (output, summary) = replay(ReplayConfig::default(), &lines);
    assert_eq!(rejected(&summary), [(RejectReason::FromTheFuture, 20)]);
    assert_eq!((summary.used(), summary.late), (40, 20));
    assert_eq!(map_labels(&output), [("x".into(), Some("car".into()))]);
    let times: Vec<_> = output
        .iter()
        .map(|line| {
            if let FusedLine::Map(map) = line {
                map.fused_at_us
            } else {
                Timestamp(0)
            }
        })
        .collect();
    assert!(
        times.is_sorted() && times[0] < Timestamp(START + 200_000),
        "{times:?}"
    );
}

#[test]
fn first_frame_gives_complete_map() {
    for (start, period) in [(0, 100), (0, 20), (START, 100), (START, 500)] {
        let report = |node: &str, frame: u64, x: &str| {
            let at = Timestamp(start + frame * period * 1000);
            line(
                &ObjectReport {
                    captured_at_us: at,
                    ..report(node, frame, &[(x, "car")])
                },
                &[],
            )
        };
        for frames in [1, 5] {
            let lines =
                (0..frames).flat_map(|frame| [report("a", frame, "x"), report("b", frame, "y")]);
            let (output, _) = replay(ReplayConfig::default(), lines);
            let FusedLine::Map(first) = &output[0] else {
                panic!("{output:?}")
            };
            assert_eq!(first.fused_at_us, Timestamp(start), "every {period} ms");
            assert_eq!(map_labels(&output[..1]).len(), 2);
        }
    }
}

#[test]
fn long_silence_is_skipped() {
    let day = 86_400_000;
    let lines = [0, 100, day, day + 100].map(|at| line(&report("a", at, &[("x", "car")]), &[]));
    let (output, summary) = replay(ReplayConfig::default(), &lines);
    assert_eq!(summary.used(), 4);
    assert!((90..120).contains(&output.len()), "{} maps", output.len());
}

#[test]
fn passes_cover_all_votes() {
    let mut lines = Vec::new();
    for item in 0..30u64 {
        let place = format!("item-{item}");
        for (node, label) in [("good", "cup"), ("also-good", "cup"), ("bad", "mouse")] {
            lines.push(vote_line(&report(node, item * 5000, &[(&place, label)])));
        }
        if item % 2 == 0 {
            lines.push(vote_line(&report(
                "lonely",
                item * 5000,
                &[(&format!("only-{item}"), "vase")],
            )));
        }
    }
    let (output, summary) = replay(
        ReplayConfig {
            passes: Some(5),
            ..ReplayConfig::default()
        },
        &lines,
    );
    assert_eq!((output.len(), summary.written), (1, 1));
    let labels = verdict_labels(&output);
    assert_eq!(labels.len(), 45);
    assert!((0..30).all(|item| labels[&format!("item-{item}")].as_deref() == Some("cup")));
    let pace = line(&report("a", 0, &[("x", "car")]), &[]);
    let (output, summary) = replay(
        ReplayConfig {
            passes: Some(5),
            ..ReplayConfig::default()
        },
        [pace],
    );
    assert_eq!(
        (output.len(), rejected(&summary)),
        (1, vec![(RejectReason::NotFused, 1)])
    );
}

#[test]
fn passes_ignore_time_and_vehicle_limits() {
    let config = ReplayConfig {
        passes: Some(5),
        ..ReplayConfig::default()
    };
    let votes = |vehicle: u64, step: u64| {
        let label = if vehicle.is_multiple_of(3) {
            "mouse"
        } else {
            "cup"
        };
        vote_line(&report(
            &format!("v{vehicle}"),
            step * 1000,
            &[(&format!("item-{step}"), label)],
        ))
    };
    let by_step: Vec<_> = (0..10)
        .flat_map(|step| (0..300).map(move |vehicle| votes(vehicle, step)))
        .collect();
    let by_vehicle = (0..300).flat_map(|vehicle| (0..10).map(move |step| votes(vehicle, step)));
    let backwards = by_vehicle.collect::<Vec<_>>().into_iter().rev();
    let (output, summary) = replay(config.clone(), backwards);
    assert_eq!((rejected(&summary), output.len()), (vec![], 1));
    assert_eq!(
        verdict_labels(&output),
        verdict_labels(&replay(config, &by_step).0)
    );
    assert_eq!(verdict_labels(&output).len(), 10);
}

#[test]
fn timeless_recording_judges_every_item() {
    let items = (0..3000u64).map(|item| {
        vote_line(&report(
            &format!("v{item}"),
            0,
            &[(&format!("item-{item}"), "cup")],
        ))
    });
    let (output, summary) = replay(ReplayConfig::default(), items);
    assert_eq!(
        (rejected(&summary), verdict_labels(&output).len()),
        (vec![], 3000)
    );
}

#[test]
fn first_junk_lines_are_quoted() {
    let (_, summary) = replay(ReplayConfig::default(), ["", "junk", "{}", "[]", "more"]);
    let Rejections { lines, examples } = &summary.rejected[&RejectReason::Malformed];
    let said: Vec<_> = examples
        .iter()
        .map(|(line, flaw)| format!("line {line}: {flaw}"))
        .collect();
    assert_eq!(*lines, 4);
    assert_eq!(
        said,
        [
            "line 2: is no JSON object",
            "line 3: missing field `schema`, at column 2",
            "line 4: is no JSON object"
        ]
    );
}

/// Reports of four vehicles around a lot of eight spots, of both kinds, with disagreement.
fn drive() -> (Vec<Landmark>, Vec<(ReportKind, ObjectReport, Timestamp)>) {
    let spots: [(f64, f64, Option<&str>); 8] = [
        (0.25, 0.48, Some("EFGH456")),
        (0.25, 0.71, Some("ABCD123")),
        (0.25, 0.84, None),
        (0.25, 0.97, Some("IJKL789")),
        (0.64, 0.48, Some("MNOP012")),
        (0.64, 0.61, None),
        (0.64, 0.84, Some("QRST345")),
        (0.64, 0.97, Some("UVWX678")),
    ];
    let vacancy = |x: f64, y: f64| VacancySign {
        label: "EMPTY".into(),
        position: Point2::new(x - 0.09, y),
    };
    let landmarks = spots.iter().enumerate().map(|(n, &(x, y, _))| Landmark {
        id: LandmarkId::new(format!("slot-{n}")),
        position: Point2::new(x, y),
        facing_rad: Some(0.0),
        vacancy: Some(vacancy(x, y)),
        synonyms: Vec::new(),
    });
    let poses = [
        ("euclid", 0.5, 0.3),
        ("fermat", 0.6, 0.5),
        ("gauss", 0.5, 1.1),
        ("watson", 0.9, 0.7),
    ];
    let mut reports = Vec::new();
    for step in 0..60u64 {
        for (number, (name, x, y)) in poses.into_iter().enumerate() {
            let captured_at = Timestamp(START + step * 90_000 + number as u64 * 7_000);
            let object = |(n, &(x, y, truth)): (usize, &(f64, f64, Option<&str>))| {
                let is_wrong = (step as usize + 3 * n + 5 * number).is_multiple_of(7);
                let label = truth.filter(|_| !is_wrong).unwrap_or("EMPTY");
                let off = 0.002 * ((n + number) % 5) as f64;
                PerceivedObject {
                    covariance_m2: Some([1e-4, 0.0, 1e-4]),
                    landmark: Some(LandmarkId::new(format!("slot-{n}"))),
                    ..PerceivedObject::new(label, 0.6 + 0.05 * number as f64, x + off, y - off)
                }
            };
            let report = ObjectReport {
                pose: Some(WirePose::from(Pose::new(x, y, 2.8))),
                objects: spots.iter().enumerate().map(object).collect(),
                ..ObjectReport::new(NodeName::from_static(name), step + 1, captured_at)
            };
            let received_at = captured_at + Duration::from_millis(5);
            reports.push((ReportKind::Detections, report.clone(), received_at));
            reports.push((ReportKind::VoteDetections, report, received_at));
        }
    }
    reports.sort_by_key(|(_, _, received_at)| *received_at);
    (landmarks.collect(), reports)
}

/// Output of a live node until the round of the last report: reports as they come, timers at their
/// deadlines. It closes its first round when all reports of the first time have come.
fn live(
    config: &ReplayConfig,
    reports: &[(ReportKind, ObjectReport, Timestamp)],
) -> Vec<FusedLine> {
    let ReplayConfig {
        aggregator,
        fusion,
        landmarks,
        ..
    } = config.clone();
    let mut cell = Aggregator::new(aggregator, 1, fusion, landmarks, reports[0].2);
    let mut output = Vec::new();
    let mut publish = |fused: Option<Fused>| {
        let Some(Fused { map, verdicts, .. }) = fused else {
            return;
        };
        output.extend(map.map(FusedLine::Map));
        output.extend(verdicts.map(FusedLine::Verdicts));
    };
    let mut pending = false;
    let mut first = Some(reports[0].2);
    for (kind, report, received_at) in reports {
        if let Some(first) = first.take_if(|first| *first < *received_at) {
            publish(cell.close_early(first));
        }
        while cell.deadline() <= *received_at {
            let deadline = cell.deadline();
            publish(cell.tick(deadline));
        }
        let fused = cell
            .report(*kind, &std::sync::Arc::new(report.clone()), *received_at)
            .unwrap();
        pending = fused.is_none();
        publish(fused);
    }
    if pending {
        publish(cell.tick(cell.deadline()));
    }
    output
}

#[test]
fn replay_matches_live_aggregator() {
    let (landmarks, reports) = drive();
    let config = ReplayConfig {
        landmarks,
        ..ReplayConfig::default()
    };
    let lines = reports.iter().map(|(kind, report, received_at)| {
        let topic = if *kind == ReportKind::Detections {
            "detections"
        } else {
            "vote_detections"
        };
        line(
            report,
            &[
                ("topic", topic.into()),
                ("received_at_us", received_at.micros().into()),
            ],
        )
    });
    let (output, summary) = replay(config.clone(), lines);
    assert!(summary.rejected.is_empty() && output.len() > 100);
    assert_eq!(output, live(&config, &reports));
}

#[test]
fn passes_count_last_answer_once() {
    let config = ReplayConfig {
        passes: Some(10),
        ..ReplayConfig::default()
    };
    let answers = |labels: &[&str]| {
        let others = vote_line(&report("b", 0, &[("y", "cup"), ("z", "mouse")]));
        let lines = labels
            .iter()
            .map(|label| vote_line(&report("a", 0, &[("x", label)])));
        let (output, _) = replay(config.clone(), [others].into_iter().chain(lines));
        let FusedLine::Verdicts(verdicts) = &output[0] else {
            panic!("{output:?}")
        };
        let verdict = &verdicts.verdicts[0];
        assert_eq!(
            (verdict.landmark.as_str(), verdict.label.as_deref()),
            ("x", Some("mouse")),
            "{labels:?}"
        );
        verdict.score
    };
    let once = answers(&["mouse"]);
    for labels in [
        &["cup", "mouse"][..],
        &["cup", "cup", "mouse"],
        &["mouse", "mouse"],
    ] {
        let score = answers(labels);
        assert!(
            (score - once).abs() < 1e-9,
            "{labels:?}: {score} instead of {once}"
        );
    }
}

#[test]
fn named_votes_need_no_position() {
    let pose = WirePose::from(Pose::new(500.0, 0.0, 1.0));
    let placeless = |topic: &str, key: &str| {
        let text = line(
            &ObjectReport {
                pose: Some(pose),
                ..report("a", 0, &[("x", "cup")])
            },
            &[("topic", topic.into())],
        );
        text.replace(",\"x_m\":0.0,\"y_m\":0.0", key)
    };
    let vote = placeless("vote_detections", "");
    assert!(!vote.contains("\"x_m\":0"), "{vote}");
    let null = placeless("cell/vote_detections/a", ",\"x_m\":null,\"y_m\":null");
    for text in [vote.clone(), null] {
        let (output, summary) = replay(ReplayConfig::default(), [&text]);
        assert!(rejected(&summary).is_empty(), "{text}: {summary:?}");
        assert_eq!(
            verdict_labels(&output)["x"].as_deref(),
            Some("cup"),
            "the distance of x from the pose is unknown"
        );
    }
    for (text, flaw) in [
        (
            placeless("detections", ""),
            "objects[0]: missing field `x_m`",
        ),
        (
            placeless("vote_detections", ",\"x_m\":1"),
            "objects[0]: missing field `y_m`",
        ),
        (
            vote.replace("\"landmark\":\"x\"", "\"landmark\":null"),
            "objects[0]: missing field `x_m`",
        ),
        (
            vote.replace("\"confidence\":0.9", "\"confidence\":9"),
            "objects[0].confidence: is not within 0 to 1: 9",
        ),
    ] {
        let said = read_report(text.as_bytes(), &Limits::default())
            .unwrap_err()
            .to_string();
        assert!(said.starts_with(flaw), "{text}: {said}");
    }
}

#[test]
fn paper_mode_judges_cut_packet() {
    let mut config = ReplayConfig::default();
    config.fusion.vote.mode = VoteMode::Paper;
    for frames in [3, 5, 7] {
        let lines = (1..=frames).map(|frame| vote_line(&report("a", frame * 100, &[("x", "cup")])));
        let (output, summary) = replay(config.clone(), lines);
        let verdicts = |line: &FusedLine| {
            if let FusedLine::Verdicts(v) = line {
                Some(v.clone())
            } else {
                None
            }
        };
        let verdicts: Vec<_> = output.iter().filter_map(verdicts).collect();
        assert_eq!(
            (verdicts.len() as u64, summary.written),
            (frames.div_ceil(5), frames.div_ceil(5)),
            "{frames} frames"
        );
        let sums: Vec<_> = verdicts
            .iter()
            .map(|v| v.verdicts[0].votes["cup"])
            .collect();
        let all: f64 = (0..frames)
            .map(|frame| 0.9 * if frame < 5 { 0.5 } else { 0.51 })
            .sum();
        assert!(
            (sums[sums.len() - 1] - all).abs() < 1e-9,
            "{sums:?} instead of {all}"
        );
        assert!(verdicts.is_sorted_by_key(|v| (v.round, v.fused_at_us)));
    }
}

#[test]
fn recording_accepts_many_labels_and_objects() {
    let names: Vec<_> = (0..1500)
        .map(|n| (format!("item-{n}"), format!("label-{n}")))
        .collect();
    let votes: Vec<_> = names
        .iter()
        .map(|(item, label)| (item.as_str(), label.as_str()))
        .collect();
    for passes in [None, Some(2)] {
        let config = ReplayConfig {
            passes,
            ..ReplayConfig::default()
        };
        let (output, summary) = replay(config, [vote_line(&report("a", 0, &votes))]);
        assert_eq!((rejected(&summary), summary.ignored_votes), (vec![], 0));
        let labels = verdict_labels(&output);
        assert!(
            names
                .iter()
                .all(|(item, label)| labels[item].as_ref() == Some(label))
        );
    }
}

#[test]
fn settings_change_replays_exactly() {
    use crate::aggregator::{Aggregator, Command};
    use crate::reputation::ReputationLedger;
    let (_, reports) = drive();
    let places = |ids: &[&str]| -> Vec<LandmarkConfig> {
        ids.iter()
            .enumerate()
            .map(|(n, id)| LandmarkConfig::at(*id, 5.0 * n as f64, 0.0))
            .collect()
    };
    let before = places(&["slot-0"]);
    let after = places(&["slot-1", "slot-0", "slot-2"]);
    let known = |places: &[LandmarkConfig]| places.iter().map(Landmark::from).collect::<Vec<_>>();
    let fusion = FusionConfig::default();
    let mut changed = fusion.clone();
    changed.round.period_s = 0.2;
    let start = reports[0].2;
    let mut live = Aggregator::new_standby(fusion.clone(), known(&before), start);
    let mut journal = JournalReplay::new(fusion, known(&before));
    let mut made = Vec::new();
    let mut again = Vec::new();
    let begin = |at_us| JournalEntry {
        at_us,
        event: JournalEvent::Start {
            ledger: Arc::new(ReputationLedger::default()),
        },
    };
    journal.entry(&begin(start));
    let epoch = crate::model::epoch::Epoch::new(1, NodeName::from_static("edge"));
    let first = crate::aggregator::round::FirstRound::OnTime;
    let lead = Command::Lead {
        epoch,
        first_round: 1,
        first,
    };
    let change = Command::Configure {
        fusion: Box::new(changed.clone()),
        landmarks: after.clone(),
    };
    for (index, (kind, report, at)) in reports.iter().enumerate() {
        let report = Arc::new(report.clone());
        let at = *at;
        if index == reports.len() * 3 / 4 {
            // The aggregator is restarted under the settings valid at that time.
            live = Aggregator::new_standby(changed.clone(), known(&after), at);
            journal.entry(&begin(at));
        }
        let mut commands = vec![Command::Tick];
        commands.extend((index % (reports.len() / 4) == 0).then(|| lead.clone()));
        commands.extend((index == reports.len() / 2).then(|| change.clone()));
        for command in commands {
            made.extend(live.command(&command, at));
            let json = serde_json::to_vec(&JournalEntry {
                at_us: at,
                event: JournalEvent::Command(command),
            })
            .unwrap();
            again.extend(journal.entry(&serde_json::from_slice(&json).unwrap()));
        }
        made.extend(live.report(*kind, &report, at).ok().flatten());
        again.extend(journal.report(*kind, &report, at));
    }
    let made: Vec<_> = made
        .into_iter()
        .flat_map(|fused| {
            fused
                .map
                .map(FusedLine::Map)
                .into_iter()
                .chain(fused.verdicts.map(FusedLine::Verdicts))
                .collect::<Vec<_>>()
        })
        .collect();
    assert!(
        made.len() > 20
            && matches!(
                &made[made.len() - 1],
                FusedLine::Map(_) | FusedLine::Verdicts(_)
            )
    );
    let locations = |line: &FusedLine| {
        if let FusedLine::Map(map) = line {
            map.landmarks.len()
        } else {
            0
        }
    };
    assert_eq!(
        made.iter().map(locations).max(),
        Some(3),
        "the change is in it"
    );
    assert_eq!(again, made);
}
