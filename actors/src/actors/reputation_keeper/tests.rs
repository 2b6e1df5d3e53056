//! Evidence of other nodes: its cost, and where it is used.

use std::net::{Ipv4Addr, SocketAddr};
use std::time::Duration;

use ecod::leadership::Position;
use ecod::leadership::cell_time::ClockReading;
use ecod::leadership::timers::EVIDENCE_PROBATION;
use ecod::model::time::Timestamp;
use ecod::wire::LedgerEntry;
use tempfile::TempDir;

use super::*;
use crate::messages::actor_slot::listening;
use crate::transport::pki::{Authority, TlsConfig};

fn name(name: &str) -> NodeName {
    NodeName::new(name).unwrap()
}

fn member(node: &str, role: Role) -> Member {
    Member {
        name: name(node),
        run: 1,
        gossip: SocketAddr::from((Ipv4Addr::LOCALHOST, 1)),
        broker: None,
        role,
        certificate: None,
    }
}

fn counted(epoch: u64, aggregator: &str) -> LedgerEntry {
    let aggregator = name(aggregator);
    let node = name("gauss");
    let label = "cup".into();
    LedgerEntry {
        epoch,
        aggregator,
        node,
        label,
        correct: 0,
        incorrect: 1,
    }
}

fn share(from: &str, leads: Option<u64>, entries: Vec<LedgerEntry>) -> Delivery<Arc<LedgerShare>> {
    let share = LedgerShare {
        schema: SCHEMA_VERSION,
        node: name(from),
        epoch: leads,
        entries,
        marks: Vec::new(),
        signed: None,
        reset_at_us: None,
    };
    Delivery::local(Arc::new(share), Timestamp(0))
}

/// Arguments of the keeper of `euclid`, which follows `edge` in term 7.
fn arguments(
    gateway: &ActorSlot<GatewayMessage>,
    counters: &Arc<Counters>,
) -> ReputationKeeperArguments {
    let roles = [
        ("edge", Role::Edge),
        ("gauss", Role::Auto),
        ("mallory", Role::Cav),
    ];
    let members = roles.map(|(node, role)| member(node, role)).to_vec();
    let epoch = Some(Epoch::new(7, name("edge")));
    let leadership = Leadership {
        position: Position::Following,
        epoch,
        standby: None,
        term: 7,
        is_deserted: false,
        is_yielding: false,
    };
    ReputationKeeperArguments {
        name: name("euclid"),
        cell: name("lot"),
        reputation: ReputationConfig::default(),
        config: ReputationKeeperConfig::default(),
        reputations: SharedReputations::new(true),
        file: None,
        credentials: None,
        newest: watch::channel(None).1,
        members: watch::channel(members).1,
        leadership: watch::channel(leadership).1,
        gateway: gateway.clone(),
        fuser: ActorSlot::default(),
        election: ActorSlot::default(),
        clock: CellClock::default(),
        counters: Arc::clone(counters),
    }
}

#[tokio::test]
async fn foreign_evidence_is_judged() {
    let (gateway, mut published) = listening::slot().await;
    let counters = Arc::<Counters>::default();
    let directory = tempfile::tempdir().unwrap();
    let file = StateFile::new(
        directory.path(),
        &name("lot"),
        &name("euclid"),
        "reputations",
    );
    let mut keeper = ReputationKeeperState::new(ReputationKeeperArguments {
        file: Some(file),
        ..arguments(&gateway, &counters)
    });
    let own = Evidence {
        node: name("gauss"),
        label: "cup".into(),
        correct: true,
    };
    keeper
        .arguments
        .reputations
        .open()
        .ledger
        .record(3, &name("euclid"), &own);
    keeper.save().await;

    keeper.merge(&share("mallory", None, vec![counted(7, "mallory")]));
    keeper.merge(&share(
        "edge",
        Some(7),
        vec![counted(7, "edge"), counted(8, "edge")],
    ));
    assert_eq!(counters.rejects(RejectReason::NotCandidate), 1);
    assert_eq!(counters.rejects(RejectReason::UnknownTerm), 1);
    assert_eq!(counters.events(Event::LedgerMerged), 1);
    assert_eq!(
        keeper.arguments.reputations.open().ledger.totals()[&name("gauss")],
        (1, 1)
    );
    assert!(keeper.unadopted);
    keeper.save().await;
    keeper.save().await;
    assert_eq!(
        counters.events(Event::ReputationsSaved),
        2,
        "saved when there is news, and not again"
    );

    gateway.get().unwrap().drain_and_wait(None).await.unwrap();
    let Ok(GatewayMessage::PublishShare { share }) = published.try_recv() else {
        panic!("no share was published")
    };
    assert_eq!(
        share.entries.len(),
        1,
        "a former leader sends its earlier counts to the new leader"
    );
}

/// A cell's CA, and the credentials that it issues.
struct Certificates {
    directory: TempDir,
    authority: Authority,
}

impl Certificates {
    fn new() -> Self {
        let directory = tempfile::tempdir().unwrap();
        let authority = Authority::init(directory.path(), &name("lot"), clock::now()).unwrap();
        Self {
            directory,
            authority,
        }
    }

    fn of(&mut self, node: &str) -> Arc<Credentials> {
        let day = Duration::from_secs(86_400);
        self.authority
            .issue(&name(node), Role::Auto, day, clock::now())
            .unwrap();
        let (certificate, key) = self.authority.files_of(&name(node));
        let ca = self.authority.ca();
        let list = self.authority.revocation_list();
        let files = TlsConfig {
            ca,
            certificate,
            key,
            revocation_list: Some(list),
            city: None,
        };
        Arc::new(Credentials::load(&files, &name(node)).unwrap())
    }

    fn signed(
        &mut self,
        by: &str,
        share: &Delivery<Arc<LedgerShare>>,
    ) -> Delivery<Arc<LedgerShare>> {
        let signed = EvidenceSigner::new(name("lot"), self.of(by))
            .sign(LedgerShare::clone(&share.message))
            .unwrap();
        Delivery::local(Arc::new(signed), share.received_at)
    }
}

#[tokio::test]
async fn revoked_signer_loses_saved_evidence() {
    let (gateway, mut published) = listening::slot().await;
    let counters = Arc::<Counters>::default();
    let mut certificates = Certificates::new();
    let file = StateFile::new(
        certificates.directory.path(),
        &name("lot"),
        &name("euclid"),
        "reputations",
    );
    let credentials = Some(certificates.of("euclid"));
    let with = || ReputationKeeperArguments {
        credentials: credentials.clone(),
        file: Some(file.clone()),
        ..arguments(&gateway, &counters)
    };
    let mut keeper = ReputationKeeperState::new(with());
    let votes = |keeper: &ReputationKeeperState| {
        keeper
            .arguments
            .reputations
            .open()
            .ledger
            .totals()
            .get(&name("gauss"))
            .copied()
            .unwrap_or_default()
    };
    let own = Evidence {
        node: name("gauss"),
        label: "cup".into(),
        correct: true,
    };
    keeper.record(&Epoch::new(3, name("euclid")), 1, &[own], None);
    keeper.resync.step_down();

    let said = share("edge", Some(7), vec![counted(7, "edge")]);
    keeper.merge(&said);
    let forged = certificates.signed("gauss", &said);
    keeper.merge(&forged);
    assert_eq!(
        (counters.rejects(RejectReason::BadSignature), votes(&keeper)),
        (2, (1, 0))
    );
    let own_word = certificates.signed("gauss", &share("gauss", None, vec![counted(6, "gauss")]));
    keeper.merge(&own_word);
    assert_eq!(
        (counters.rejects(RejectReason::Unattested), votes(&keeper)),
        (1, (1, 0))
    );
    let said = certificates.signed("edge", &said);
    keeper.merge(&said);
    assert_eq!(votes(&keeper), (1, 1));
    keeper.save().await;
    let mut early = ReputationKeeperState::new(with());
    store::restore(&early.arguments, early.signer.as_mut());
    assert_eq!(votes(&early), (1, 0), "its leader is on trial");
    keeper.merge(&Delivery::local(
        Arc::clone(&said.message),
        said.received_at + EVIDENCE_PROBATION,
    ));
    keeper.save().await;

    let mut again = ReputationKeeperState::new(with());
    store::restore(&again.arguments, again.signer.as_mut());
    assert_eq!(votes(&again), (1, 1), "after a restart");
    gateway.get().unwrap().drain_and_wait(None).await.unwrap();
    let Ok(GatewayMessage::PublishShare { share }) = published.try_recv() else {
        panic!("a round's evidence")
    };
    assert_eq!(
        EvidenceSigner::new(name("lot"), certificates.of("edge")).verify(&share),
        Ok(())
    );

    certificates
        .authority
        .revoke(&name("edge"), clock::now())
        .unwrap();
    tokio::time::sleep(Duration::from_millis(1100)).await;
    assert!(again.signer.as_mut().unwrap().reload() && again.drop_revoked());
    assert_eq!(votes(&again), (1, 0), "and only that");
    again.merge(&said);
    assert_eq!(votes(&again), (1, 0), "nor does it come back");
    again.save().await;
    let text = std::fs::read_to_string(file.path()).unwrap();
    assert!(
        text.contains("euclid") && !text.contains("edge"),
        "it is gone from the disk: {text}"
    );
    let mut last = ReputationKeeperState::new(with());
    store::restore(&last.arguments, last.signer.as_mut());
    assert_eq!(votes(&last), (1, 0));
}

#[tokio::test]
async fn new_certificate_restores_no_counts() {
    let (gateway, _published) = listening::slot().await;
    let counters = Arc::<Counters>::default();
    let mut certificates = Certificates::new();
    let file = StateFile::new(
        certificates.directory.path(),
        &name("lot"),
        &name("euclid"),
        "reputations",
    );
    let with = |credentials: &Arc<Credentials>| ReputationKeeperArguments {
        credentials: Some(Arc::clone(credentials)),
        file: Some(file.clone()),
        ..arguments(&gateway, &counters)
    };
    let votes = |keeper: &ReputationKeeperState| {
        keeper
            .arguments
            .reputations
            .open()
            .ledger
            .totals()
            .get(&name("gauss"))
            .copied()
            .unwrap_or_default()
    };
    let stolen = certificates.of("euclid");
    let mut running = ReputationKeeperState::new(with(&stolen));
    let vote = Evidence {
        node: name("gauss"),
        label: "cup".into(),
        correct: true,
    };
    running.record(&Epoch::new(3, name("euclid")), 1, &[vote], None);
    running.save().await;

    let renewed = certificates.of("euclid");
    let mut restarted = ReputationKeeperState::new(with(&renewed));
    restarted.restore();
    assert_eq!(
        votes(&restarted),
        (1, 0),
        "a renewed certificate keeps the evidence"
    );

    certificates
        .authority
        .revoke(&name("euclid"), clock::now())
        .unwrap();
    let new = certificates.of("euclid");
    tokio::time::sleep(Duration::from_millis(1100)).await;
    let mut restarted = ReputationKeeperState::new(with(&new));
    restarted.restore();
    assert_eq!(votes(&restarted), (0, 0), "after a restart");
    assert!(running.signer.as_mut().unwrap().reload() && running.drop_revoked());
    assert_eq!(votes(&running), (0, 0), "while it runs");
}

#[tokio::test]
async fn candidates_broker_relays_no_vouching() {
    let (gateway, _published) = listening::slot().await;
    let counters = Arc::<Counters>::default();
    let mut certificates = Certificates::new();
    let credentials = Some(certificates.of("euclid"));
    let mut keeper = ReputationKeeperState::new(ReputationKeeperArguments {
        credentials,
        ..arguments(&gateway, &counters)
    });
    // `turing` signs counts of an invented leadership, and its own broker lets every client publish
    // any message.
    let invented = share("gauss", None, vec![counted(6, "turing")]);
    let over = |broker: &str, mut share: Delivery<Arc<LedgerShare>>| {
        share.broker = Some(name(broker));
        share
    };
    keeper.merge(&over("turing", certificates.signed("turing", &invented)));
    assert!(
        keeper
            .arguments
            .reputations
            .open()
            .ledger
            .totals()
            .is_empty(),
        "gauss did not send this evidence"
    );
    assert_eq!(counters.rejects(RejectReason::Unattested), 1);
    assert_eq!(
        counters.rejects_by_source()[0].source,
        "turing",
        "the broker's node is to blame"
    );

    let honest = share("edge", Some(7), vec![counted(7, "edge")]);
    keeper.merge(&over("turing", certificates.signed("edge", &honest)));
    assert_eq!(
        keeper.arguments.reputations.open().ledger.totals()[&name("gauss")],
        (0, 1),
        "signed by its sender"
    );
    for broker in ["edge", "gauss", "euclid"] {
        let term = 3 + u64::from(broker == "gauss") + 2 * u64::from(broker == "euclid");
        let passed_on = share("gauss", None, vec![counted(term, "old")]);
        keeper.merge(&over(broker, certificates.signed("old", &passed_on)));
    }
    assert_eq!(
        keeper.arguments.reputations.open().ledger.totals()[&name("gauss")],
        (0, 4)
    );
    assert_eq!(counters.rejects(RejectReason::Unattested), 1);
}

#[tokio::test]
async fn poisoned_ledger_is_refused() {
    let (gateway, _published) = listening::slot().await;
    let counters = Arc::<Counters>::default();
    let mut certificates = Certificates::new();
    let file = StateFile::new(
        certificates.directory.path(),
        &name("lot"),
        &name("euclid"),
        "reputations",
    );
    let entry = |node: &str, incorrect: u64| {
        format!(
            r#"{{"epoch":1,"aggregator":"edge","node":"{node}","label":"cup","correct":0,"incorrect":{incorrect}}}"#
        )
    };
    let saved = |entries: &str| {
        format!(
            r#"{{"schema":1,"cell":"lot","node":"euclid","entries":[{entries}],"standing":{{}}}}"#
        )
    };
    let text = saved(&[entry("honest", 1_000_000_000), entry("other", 7)].join(","));
    let vehicles = |credentials: Option<Arc<Credentials>>| {
        std::fs::write(file.path(), &text).unwrap();
        let arguments = ReputationKeeperArguments {
            credentials,
            file: Some(file.clone()),
            ..arguments(&gateway, &counters)
        };
        let mut keeper = ReputationKeeperState::new(arguments);
        store::restore(&keeper.arguments, keeper.signer.as_mut());
        keeper.arguments.reputations.open().ledger.totals().len()
    };
    assert_eq!(vehicles(None), 1, "what can be is read");
    assert_eq!(
        vehicles(Some(certificates.of("euclid"))),
        0,
        "the evidence has no signature"
    );

    reset_saved(&file, &name("lot"), &name("euclid"), Timestamp(5)).unwrap();
    let mut keeper = ReputationKeeperState::new(ReputationKeeperArguments {
        file: Some(file),
        ..arguments(&gateway, &counters)
    });
    store::restore(&keeper.arguments, keeper.signer.as_mut());
    assert_eq!(
        keeper.arguments.reputations.open().ledger.reset_at(),
        Timestamp(5)
    );
}

#[tokio::test]
async fn saved_ledger_obeys_wire_bounds() {
    let (gateway, _published) = listening::slot().await;
    let counters = Arc::<Counters>::default();
    let directory = tempfile::tempdir().unwrap();
    let file = StateFile::new(
        directory.path(),
        &name("lot"),
        &name("euclid"),
        "reputations",
    );
    let restored = |fields: &str| {
        let text = format!(r#"{{"schema":1,"cell":"lot","node":"euclid",{fields}}}"#);
        std::fs::write(file.path(), text).unwrap();
        let arguments = ReputationKeeperArguments {
            file: Some(file.clone()),
            ..arguments(&gateway, &counters)
        };
        store::restore(&arguments, None);
        let store = arguments.reputations.open();
        (
            store.ledger.totals().len(),
            store.standing.len(),
            store.ledger.reset_at(),
        )
    };
    let none = Timestamp::default();
    let entry = |term: u64, label: &str, incorrect: u64| {
        let counts = format!(r#""label":"{label}","correct":0,"incorrect":{incorrect}"#);
        format!(r#"{{"epoch":{term},"aggregator":"edge","node":"gauss",{counts}}}"#)
    };
    for (term, label, incorrect, expected) in [
        (1, "cup", 7, 1),
        (1, "cup", 1_000_000_000, 0),
        (1 << 52, "cup", 7, 0),
        (1, "c\\u202eup", 7, 0),
    ] {
        let entry = entry(term, label, incorrect);
        let own = format!(r#""entries":[{entry}],"standing":{{}}"#);
        assert_eq!(restored(&own), (expected, 0, none), "{own}");
        let stated = format!(r#"{{"schema":1,"node":"edge","entries":[{entry}]}}"#);
        let stated = format!(r#""entries":[],"standing":{{}},"statements":[{stated}]"#);
        assert_eq!(restored(&stated), (expected, 0, none), "{stated}");
    }
    let mark = |correct| {
        let mark = format!(
            r#"{{"epoch":1,"aggregator":"edge","node":"gauss","number":2,"correct":{correct},"incorrect":0}}"#
        );
        restored(&format!(r#""entries":[],"marks":[{mark}],"standing":{{}}"#)).0
    };
    assert_eq!((mark(64), mark(65)), (1, 0));
    for (score, correct, expected) in [
        ("0.9", 7, 1),
        ("1e300", 7, 0),
        ("-1.0", 7, 0),
        ("0.9", u64::MAX, 0),
    ] {
        let standing =
            format!(r#"{{"gauss":{{"score":{score},"correct":{correct},"incorrect":0}}}}"#);
        assert_eq!(
            restored(&format!(r#""entries":[],"standing":{standing}"#)).1,
            expected,
            "{standing}"
        );
    }
    let hours = |hours: u64| clock::now() + Duration::from_secs(hours * 3600);
    for (at, expected) in [(hours(23), hours(23)), (hours(25), none)] {
        let reset_at = restored(&format!(
            r#""entries":[],"standing":{{}},"reset_at_us":{at}"#,
            at = at.micros()
        ))
        .2;
        assert!(
            reset_at.micros().abs_diff(expected.micros()) < 60_000_000,
            "{reset_at:?}"
        );
    }
}

#[tokio::test]
async fn node_from_1970_uses_cell_time() {
    let (gateway, _published) = listening::slot().await;
    let mut keeper = ReputationKeeperState::new(arguments(&gateway, &Arc::default()));
    let now = clock::now();
    let reset = LedgerShare {
        reset_at_us: Some(now),
        ..LedgerShare::clone(&share("edge", Some(7), Vec::new()).message)
    };
    let reset = Delivery::local(Arc::new(reset), Timestamp(60_000_000));
    let reset_at =
        |keeper: &ReputationKeeperState| keeper.arguments.reputations.open().ledger.reset_at();
    keeper.merge(&reset);
    assert_eq!(
        reset_at(&keeper),
        Timestamp(0),
        "decades ahead of the node's clock"
    );
    keeper.arguments.clock.show(ClockReading {
        offset_us: now.micros() as i64,
        error_us: Some(1000),
    });
    keeper.merge(&reset);
    assert_eq!(reset_at(&keeper), now);
}

#[tokio::test]
async fn altered_ledger_is_set_aside() {
    let (gateway, _published) = listening::slot().await;
    let counters = Arc::<Counters>::default();
    let directory = tempfile::tempdir().unwrap();
    let file = StateFile::new(
        directory.path(),
        &name("lot"),
        &name("euclid"),
        "reputations",
    );
    let with = || ReputationKeeperArguments {
        file: Some(file.clone()),
        ..arguments(&gateway, &counters)
    };
    let mut keeper = ReputationKeeperState::new(with());
    keeper.merge(&share("edge", Some(7), vec![counted(7, "edge")]));
    keeper.save().await;
    let saved = std::fs::read(file.path()).unwrap();
    let vehicles = || {
        let keeper = ReputationKeeperState::new(with());
        store::restore(&keeper.arguments, None);
        keeper.arguments.reputations.open().ledger.totals().len()
    };
    assert_eq!(vehicles(), 1);
    for place in 0..saved.len() {
        for change in [0x01, 0x10, 0x20, 0x80] {
            let mut damaged = saved.clone();
            damaged[place] ^= change;
            std::fs::write(file.path(), damaged).unwrap();
            assert_eq!(vehicles(), 0, "byte {place} ^ {change:#x}");
            assert!(!file.path().exists() && file.path().with_extension("set-aside").exists());
        }
    }
}

/// A signer of evidence may make counts leap, and wait for its receivers to restart.
#[tokio::test]
async fn restart_widens_no_count_jump() {
    let (gateway, _published) = listening::slot().await;
    let counters = Arc::<Counters>::default();
    let directory = tempfile::tempdir().unwrap();
    let file = StateFile::new(
        directory.path(),
        &name("lot"),
        &name("euclid"),
        "reputations",
    );
    let with = || ReputationKeeperArguments {
        file: Some(file.clone()),
        ..arguments(&gateway, &counters)
    };
    let said = |incorrect| {
        let entries = vec![LedgerEntry {
            incorrect,
            ..counted(7, "edge")
        }];
        let mut share = share("edge", Some(7), entries);
        share.received_at = clock::now();
        share
    };
    let mut keeper = ReputationKeeperState::new(with());
    keeper.merge(&said(10));
    keeper.save().await;

    let mut again = ReputationKeeperState::new(with());
    again.restore();
    let votes = |keeper: &ReputationKeeperState| {
        keeper.arguments.reputations.open().ledger.totals()[&name("gauss")]
    };
    again.merge(&said(90_000_000));
    assert_eq!(
        (votes(&again), counters.rejects(RejectReason::Implausible)),
        ((0, 10), 1)
    );
    again.merge(&said(1000));
    assert_eq!(
        (votes(&again), counters.rejects(RejectReason::Implausible)),
        ((0, 1000), 1),
        "it was down for a while"
    );
}

/// A standby that takes over waits for the leader's evidence, and ignores messages of other nodes
/// in the leader's name.
#[tokio::test]
async fn election_receives_only_verified_evidence() {
    let (gateway, _published) = listening::slot().await;
    let (election, mut messages) = listening::slot().await;
    let counters = Arc::<Counters>::default();
    let mut certificates = Certificates::new();
    let credentials = Some(certificates.of("euclid"));
    let mut keeper = ReputationKeeperState::new(ReputationKeeperArguments {
        credentials,
        election: election.clone(),
        ..arguments(&gateway, &counters)
    });
    let over = |broker: &str, mut share: Delivery<Arc<LedgerShare>>| {
        share.broker = Some(name(broker));
        share
    };
    let said = share("edge", Some(7), vec![counted(7, "edge")]);
    keeper.merge(&said);
    keeper.merge(&certificates.signed("gauss", &said));
    keeper.merge(&share("mallory", None, Vec::new()));
    keeper.merge(&over("gauss", share("edge", Some(7), Vec::new())));
    keeper.merge(&over("gauss", certificates.signed("edge", &said)));
    keeper.merge(&over("gauss", share("gauss", None, Vec::new())));
    keeper.merge(&over("edge", share("edge", Some(7), Vec::new())));
    election.get().unwrap().drain_and_wait(None).await.unwrap();
    let mut senders = Vec::new();
    while let Ok(LeaderElectionMessage::Record {
        input: Input::EvidenceReceived { from },
    }) = messages.try_recv()
    {
        senders.push(from.to_string());
    }
    assert_eq!(
        senders,
        ["gauss", "edge"],
        "a signature alone may be an old one"
    );
}
