//! Every follower accepts the publications of a leader, independently of the valid messages that the leader has
//! received: verdicts, reputations, evidence and counts for other cells, statuses with troubles, and descriptions. For
//! maps see `src/aggregator/tests/accepted_by_receivers.rs`.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use ecod::aggregator::{Aggregator, FusionConfig};
use ecod::diagnostics::{TroubleKind, TroubleRegister};
use ecod::leadership::ledger_resync::LedgerResync;
use ecod::model::epoch::Epoch;
use ecod::model::geometry::TURN_BOUND_RAD;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::perception::landmark::Landmark;
use ecod::reputation::{Evidence, ReputationConfig, ReputationLedger};
use ecod::vote::VoteMode;
use ecod::wire::{
    CellDescription, ContentHash, DescriptionStatus, Encoding, LedgerEntry, LedgerMark,
    LedgerShare, Limits, MAX_DESCRIPTION_BYTES, MAX_INTEGER, NodeStatus, ObjectReport, Payload,
    PerceivedObject, ReportKind, Reputations, Role, SCHEMA_VERSION, Verdict, WirePose,
    decode_entries, encode,
};
use nalgebra::Point2;
use proptest::collection::vec;
use proptest::option;
use proptest::prelude::*;
use uuid::Uuid;

const START: u64 = 1_732_154_400_000_000;

fn at(ms: u64) -> Timestamp {
    Timestamp(START + ms * 1000)
}

/// Fails if a receiver refuses the message or leaves out a part of it, in any encoding.
fn check_accepted<T: Payload>(message: &T) -> Result<(), TestCaseError> {
    for encoding in [Encoding::Json, Encoding::Cbor, Encoding::Compact] {
        let received = decode_entries::<T>(&encode(message, encoding), &Limits::default());
        let left_out = received.map(|(_, invalid)| invalid);
        prop_assert_eq!(left_out, Ok(Vec::new()), "{:?}", encoding);
    }
    Ok(())
}

/// Numbers of a count: ordinary ones, and the largest that receivers accept.
fn count() -> impl Strategy<Value = u64> {
    prop_oneof![
        0..100u64,
        Just(MAX_INTEGER),
        Just(MAX_INTEGER - 1),
        Just(MAX_INTEGER / 2),
        0..=MAX_INTEGER
    ]
}

/// Short labels, of which some repeat, and the longest with letters that JSON escapes.
fn label() -> impl Strategy<Value = String> {
    prop_oneof![
        Just("cup".to_owned()),
        Just("vase".to_owned()),
        Just("\"\\".repeat(32)),
        "[a-z\"]{1,64}",
    ]
}

/// Texts of other nodes, with any letters, and texts that grow most in JSON.
fn words(most: usize) -> impl Strategy<Value = String> {
    prop_oneof!["\\PC{0,80}", "[\\x00-\\x1f\"\\\\]{0,400}", quotes(most),]
}

/// Texts that differ and double in JSON.
fn quotes(bytes: usize) -> impl Strategy<Value = String> {
    (1000..9999u32).prop_map(move |number| number.to_string() + &"\"".repeat(bytes - 4))
}

fn name() -> impl Strategy<Value = NodeName> {
    let name = |text: &str| NodeName::new(text).unwrap();
    prop_oneof![
        Just(name("euclid")),
        Just(name("gauss")),
        Just(name(&"x".repeat(64)))
    ]
}

fn number(bound: f64) -> impl Strategy<Value = f64> {
    prop_oneof![
        -bound..=bound,
        -10.0..=10.0f64,
        Just(bound),
        Just(-bound),
        Just(0.0),
        Just(f64::MIN_POSITIVE),
    ]
}

prop_compose! {
    fn vote()(
        (x_m, y_m) in (number(1e8), number(1e8)),
        confidence in prop_oneof![0.0..=1.0f64, Just(0.0), Just(1.0), Just(f64::MIN_POSITIVE)],
        place in 0..4usize,
        label in label(),
    ) -> PerceivedObject {
        PerceivedObject {
            landmark: Some(["ball", "box", "bin", "nowhere"][place].into()),
            ..PerceivedObject::new(label, confidence, x_m, y_m)
        }
    }
}

prop_compose! {
    fn votes()(
        voter in prop_oneof![Just("mallory"), Just("mallory--left"), Just("watson"), Just("zeno")],
        objects in vec(vote(), 1..12),
        pose in option::of((number(1e8), number(1e8), -TURN_BOUND_RAD..=TURN_BOUND_RAD)),
    ) -> ObjectReport {
        ObjectReport {
            pose: pose.map(|(x_m, y_m, heading_rad)| WirePose::new(x_m, y_m, heading_rad)),
            objects,
            ..ObjectReport::new(NodeName::from_static(voter), 0, at(0))
        }
    }
}

/// A vote for the label of one place.
fn honest_vote(seq: u64) -> Arc<ObjectReport> {
    Arc::new(ObjectReport {
        objects: vec![PerceivedObject {
            landmark: Some("ball".into()),
            ..PerceivedObject::new("cup", 0.9, 1.0, 0.0)
        }],
        ..ObjectReport::new(NodeName::from_static("euclid"), seq, at(seq * 100 - 20))
    })
}

fn places() -> Vec<Landmark> {
    let place = |(index, id): (usize, &str)| Landmark {
        id: id.into(),
        position: Point2::new(1.0 + index as f64, 0.0),
        facing_rad: None,
        vacancy: None,
        synonyms: vec![],
    };
    ["ball", "box", "bin"]
        .iter()
        .copied()
        .enumerate()
        .map(place)
        .collect()
}

prop_compose! {
    fn entry()(
        epoch in prop_oneof![1..4u64, Just(MAX_INTEGER)],
        (aggregator, node) in (name(), name()),
        label in label(),
        (correct, incorrect) in (count(), count()),
    ) -> LedgerEntry {
        LedgerEntry { epoch, aggregator, node, label: label.into(), correct, incorrect }
    }
}

prop_compose! {
    fn mark()(
        epoch in prop_oneof![1..4u64, Just(MAX_INTEGER)],
        (aggregator, node) in (name(), name()),
        (number, correct, incorrect) in (count(), count(), count()),
    ) -> LedgerMark {
        LedgerMark { epoch, aggregator, node, number, correct, incorrect }
    }
}

fn share(entries: Vec<LedgerEntry>, marks: Vec<LedgerMark>) -> LedgerShare {
    LedgerShare {
        schema: SCHEMA_VERSION,
        node: NodeName::from_static("gauss"),
        epoch: None,
        entries,
        marks,
        signed: None,
        reset_at_us: None,
    }
}

proptest! {
    #[test]
    fn valid_votes_make_acceptable_verdicts(
        reports in vec(votes(), 1..8),
        mode in prop_oneof![Just(VoteMode::Weighted), Just(VoteMode::Paper)],
        is_open in any::<bool>(),
    ) {
        let mut fusion = FusionConfig::default();
        fusion.vote.mode = mode;
        let listed = if is_open { Vec::new() } else { places() };
        let mut cell = Aggregator::new(NodeName::from_static("edge"), 7, fusion, listed, at(0));
        let mut rounds = 0;
        let mut has_honest = false;
        for round in 1..=20 {
            let now = at(round * 100);
            let mut closed = Vec::new();
            closed.extend(cell.report(ReportKind::VoteDetections, &honest_vote(round), now - Duration::from_millis(10)).ok().flatten());
            let extreme = &reports[round as usize % reports.len()];
            prop_assert_eq!(extreme.validate(&Limits::default()), Ok(()));
            let extreme = ObjectReport { seq: round, captured_at_us: at(round * 100 - 15), ..extreme.clone() };
            closed.extend(cell.report(ReportKind::VoteDetections, &Arc::new(extreme), now - Duration::from_millis(5)).ok().flatten());
            closed.extend(cell.tick(now));
            for fused in closed {
                prop_assert_eq!(&fused.left_out, &Vec::new());
                if let Some(map) = &fused.map {
                    check_accepted(map)?;
                }
                if let Some(verdicts) = &fused.verdicts {
                    rounds += 1;
                    check_accepted(verdicts)?;
                    let is_honest = |verdict: &Verdict| &*verdict.landmark == "ball" && verdict.votes.contains_key("cup");
                    has_honest |= verdicts.verdicts.iter().any(is_honest);
                }
                if let Some(reputations) = fused.reputations {
                    check_accepted(&published(&fused.epoch, reputations))?;
                }
            }
        }
        prop_assert!(rounds > 0 && has_honest, "{} rounds with verdicts", rounds);
        check_accepted(&published(&Epoch::new(7, NodeName::from_static("edge")), cell.reputations()))?;
    }

    #[test]
    fn valid_evidence_makes_acceptable_shares(
        entries in vec(entry(), 1..20),
        marks in vec(mark(), 0..10),
        votes in vec((name(), label(), any::<bool>()), 0..40),
    ) {
        check_accepted(&share(entries.clone(), marks.clone()))?;
        let mut ledger = ReputationLedger::default();
        ledger.merge_share(&share(entries.clone(), marks), None);
        let edge = NodeName::from_static("euclid");
        for (node, label, correct) in votes {
            ledger.record(1, &edge, &Evidence { node, label: label.into(), correct });
        }
        let config = ReputationConfig::default();
        let reputations = ledger.reputations(&config);
        for entry in entries {
            prop_assert!(reputations.contains_key(&entry.node), "{} has no reputation", entry.node);
        }
        check_accepted(&published(&Epoch::new(7, edge.clone()), reputations))?;
        for share in LedgerResync::new(edge, 10).snapshot(&ledger) {
            check_accepted(&share)?;
        }
    }

    #[test]
    fn any_trouble_makes_acceptable_status(
        words in prop_oneof![
            vec((words(64), words(400)), 1..80),
            vec((quotes(64), quotes(400)), 80),
        ],
    ) {
        let mut register = TroubleRegister::default();
        for (index, (about, cause)) in words.iter().enumerate() {
            let kind = TroubleKind::ALL[index % TroubleKind::ALL.len()];
            let about = (index % 5 > 0).then_some(about.as_str());
            // One remedy is another node's text.
            let remedy = if kind == TroubleKind::ReportsRefused { cause } else { kind.remedy() };
            register.record_with(kind, about, || cause.clone(), remedy, at(1));
        }
        let node = NodeName::new("x".repeat(64)).unwrap();
        let mut status = NodeStatus::starting(node.clone(), Uuid::nil(), Role::Edge, "0.1.0");
        status.troubles = register.present(at(1));
        status.epoch = MAX_INTEGER;
        status.aggregator = Some(node);
        status.page = Some("[2001:db8::ffff:ffff]:65535".into());
        status.description = Some(DescriptionStatus {
            version: MAX_INTEGER,
            hash: ContentHash::default(),
            problem: Some("\"".repeat(500)),
        });
        prop_assert!(!status.troubles.is_empty());
        check_accepted(&status)?;
        for encoding in [Encoding::Json, Encoding::Cbor, Encoding::Compact] {
            let bytes = encode(&status, encoding).len();
            prop_assert!(bytes <= MAX_STATUS_BYTES, "{} bytes in {:?}", bytes, encoding);
        }
    }

    #[test]
    fn any_text_makes_acceptable_description(
        text in "\\PC{0,400}|[\\x00-\\x1f\"\\\\]{0,400}",
        letter in prop_oneof![Just('a'), Just('\n'), Just('"'), Just('\u{1}')],
        is_long in any::<bool>(),
    ) {
        let text = if is_long { letter.to_string().repeat(MAX_DESCRIPTION_BYTES) } else { text };
        let description = CellDescription {
            schema: SCHEMA_VERSION,
            version: MAX_INTEGER,
            hash: ContentHash::default(),
            set_by: NodeName::new("x".repeat(64)).unwrap(),
            text,
        };
        check_accepted(&description)?;
    }
}

/// Largest status that brokers of a cell accept.
const MAX_STATUS_BYTES: usize = 16 * 1024;

fn published(
    epoch: &Epoch,
    reputations: BTreeMap<NodeName, ecod::wire::Reputation>,
) -> Reputations {
    Reputations {
        schema: SCHEMA_VERSION,
        aggregator: Some(epoch.leader.clone()),
        epoch: epoch.term,
        round: 1,
        reputations,
    }
}
