//! Shares of the ledger: none can be forged, and accepted ones stay within bounds.

#![no_main]

use std::sync::{Arc, LazyLock, Mutex, PoisonError};
use std::time::Duration;

use ecod::leadership::ledger_resync::LedgerResync;
use ecod::leadership::{Leadership, Position};
use ecod::model::epoch::Epoch;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::reputation::{MAX_ENTRIES, MAX_LANES, ReputationConfig, ReputationLedger};
use ecod::wire::{LedgerShare, Limits, Role, decode};
use ecod_actors::platform::clock;
use ecod_actors::transport::pki::{Authority, Credentials, EvidenceSigner, TlsConfig};
use libfuzzer_sys::fuzz_target;

const HONEST: &[u8] = br#"{"schema":1,"node":"edge","epoch":7,"entries":[
    {"epoch":7,"aggregator":"edge","node":"euclid","label":"cup","correct":410,"incorrect":22}]}"#;

/// The signer of `edge`, and a share that it signed.
static EDGE: LazyLock<(Mutex<EvidenceSigner>, LedgerShare)> = LazyLock::new(|| {
    let cell = NodeName::from_static("lot");
    let edge = NodeName::from_static("edge");
    let directory = std::env::temp_dir().join(format!("fuzz-share-{}", std::process::id()));
    let mut authority = Authority::init(&directory, &cell, clock::now()).expect("a new directory");
    authority
        .issue(&edge, Role::Edge, Duration::from_secs(86_400), clock::now())
        .expect("a certificate");
    let (certificate, key) = authority.files_of(&edge);
    let files = TlsConfig {
        ca: authority.ca(),
        certificate,
        key,
        revocation_list: Some(authority.revocation_list()),
        city: None,
    };
    let signer = EvidenceSigner::new(
        cell,
        Arc::new(Credentials::load(&files, &edge).expect("just made")),
    );
    let honest = decode(HONEST, &Limits::default()).expect("a share");
    let honest = signer.sign(honest).expect("a key of the right kind");
    (Mutex::new(signer), honest)
});

/// The share with all counts and marks in one lane of `edge`, under its signature: `edge` may be the attacker.
fn signed_by_edge(signer: &EvidenceSigner, share: &LedgerShare) -> LedgerShare {
    let mut share = LedgerShare {
        signed: None,
        ..share.clone()
    };
    let edge = NodeName::from_static("edge");
    let terms = share
        .entries
        .iter()
        .map(|entry| entry.epoch)
        .chain(share.marks.iter().map(|mark| mark.epoch));
    let term = terms.min().unwrap_or_default();
    for entry in &mut share.entries {
        entry.epoch = term;
        entry.aggregator = edge.clone();
    }
    for mark in &mut share.marks {
        mark.epoch = term;
        mark.aggregator = edge.clone();
    }
    signer.sign(share).expect("a key of the right kind")
}

/// Leaders that `gauss` follows, by the second: the one that counted, through the trial of its evidence or replaced
/// before its end, and back afterwards.
const STEADY: &[(u64, &str)] = &[(1, "edge"), (2, "edge"), (3, "edge"), (30, "edge")];
const REPLACED: &[(u64, &str)] = &[
    (1, "edge"),
    (2, "edge"),
    (3, "edge"),
    (12, "euclid"),
    (30, "euclid"),
    (60, "edge"),
];

/// `gauss` takes the share again and again, also after restarts, while it follows these leaders.
fn take(
    mut resync: LedgerResync,
    share: &LedgerShare,
    leaders: &[(u64, &'static str)],
) -> ReputationLedger {
    let candidates = [share.node.clone()];
    let mut ledger = ReputationLedger::default();
    let mut epoch: Option<Epoch> = None;
    for (term, (second, leader)) in (7..).zip(leaders) {
        let at = Timestamp(second * 1_000_000);
        let is_another = epoch
            .as_ref()
            .is_none_or(|epoch| epoch.leader.as_str() != *leader);
        if is_another {
            epoch = Some(Epoch::new(term, NodeName::from_static(leader)));
        }
        let leadership = Leadership {
            position: Position::Following,
            epoch: epoch.clone(),
            standby: None,
            term: 1 << 40,
            is_deserted: false,
            is_yielding: false,
        };
        // Ends trials.
        let _shares = resync.tick(&mut ledger, &leadership, at);
        let before = ledger.clone();
        let merged = resync.merge(share, &mut ledger, &candidates, &leadership, at, at);
        let is_unchanged = before.totals().is_empty() || before.totals() == ledger.totals();
        assert!(is_another || is_unchanged, "a repetition has no effect");
        assert!(
            merged.is_ok() || before == ledger,
            "what is refused changes nothing"
        );
        let _shares = resync.tick(&mut ledger, &leadership, at);
        resync.resume(&ledger, at);
        assert!(ledger.lanes() <= MAX_LANES && ledger.entries().count() <= MAX_ENTRIES);
        let reputations = ledger.reputations(&ReputationConfig::default());
        assert!(
            reputations
                .values()
                .all(|reputation| (0.3..=1.0).contains(&reputation.score))
        );
    }
    ledger
}

fuzz_target!(|input: &[u8]| {
    let Ok(share) = decode::<LedgerShare>(input, &Limits::default()) else {
        return;
    };
    let (signer, honest) = &*EDGE;
    let mut signer = signer.lock().unwrap_or_else(PoisonError::into_inner);
    assert!(signer.verify(&share).is_err(), "no fuzzer has the key");
    let transplanted = LedgerShare {
        signed: honest.signed.clone(),
        ..share
    };
    let is_honest = transplanted.entries == honest.entries && transplanted.marks == honest.marks;
    assert_eq!(signer.verify(&transplanted).is_ok(), is_honest);
    let unsigned = || LedgerResync::new(NodeName::from_static("gauss"), 10);
    take(unsigned(), &transplanted, STEADY);
    take(unsigned(), &transplanted, REPLACED);

    let signed = signed_by_edge(&signer, &transplanted);
    assert_eq!(
        signer.verify(&signed).is_ok(),
        !signed.is_empty(),
        "whatever edge says, it is the one who said it"
    );
    let resync = || LedgerResync::signed(NodeName::from_static("gauss"), 10);
    for leaders in [STEADY, REPLACED] {
        let mut ledger = take(resync(), &signed, leaders);
        assert!(
            ledger
                .statements()
                .all(|statement| signer.is_trusted(statement))
        );
        ledger.retain_statements(|_| false);
        assert_eq!(
            ledger.totals().len(),
            0,
            "all that came by a certificate goes with it"
        );
    }
    let is_said_by_itself = signed.node.as_str() == "edge";
    let others = take(resync(), &signed, &REPLACED[..REPLACED.len() - 1]);
    assert!(
        !is_said_by_itself || others.totals().is_empty(),
        "what was on trial when another followed is gone"
    );
});
