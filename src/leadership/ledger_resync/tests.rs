//! Evidence of other nodes: which evidence is accepted, what it costs, and how it outlives leaders.

mod probation;

use super::growth::MAX_FIRST_VOTES;
use super::*;
use crate::leadership::view::Position;
use crate::reputation::{MAX_LANES, ReputationConfig};
use crate::wire::LedgerSignature;

fn name(name: &str) -> NodeName {
    NodeName::new(name).unwrap()
}

/// A candidate and its ledger.
struct Candidate {
    resync: LedgerResync,
    ledger: ReputationLedger,
    leadership: Leadership,
    /// Time up to which it has waited, in ms.
    now_ms: u64,
}

/// Publication periods between two snapshots.
const PERIOD: u32 = 10;

impl Candidate {
    fn new(node: &str) -> Self {
        let leadership = Leadership {
            term: u64::MAX,
            ..Leadership::default()
        };
        Self {
            resync: LedgerResync::new(name(node), PERIOD),
            ledger: ReputationLedger::default(),
            leadership,
            now_ms: 0,
        }
    }

    fn lead(&mut self, term: u64) {
        self.resync.lead(Epoch::new(term, self.resync.name.clone()));
    }

    fn record(&mut self, term: u64, vehicle: &str) -> Vec<LedgerShare> {
        let evidence = Evidence {
            node: name(vehicle),
            label: "ABC123".into(),
            correct: true,
        };
        self.resync.record(
            &Epoch::new(term, self.resync.name.clone()),
            &[evidence],
            &mut self.ledger,
        )
    }

    fn merge(&mut self, share: &LedgerShare, at_ms: u64) -> Result<Merged, RejectReason> {
        let candidates = ["a", "b1", "b2", "edge", "gauss", "leader", "other"].map(name);
        let now = Timestamp(at_ms * 1000);
        self.resync.merge(
            share,
            &mut self.ledger,
            &candidates,
            &self.leadership,
            now,
            now,
        )
    }

    /// Lets snapshot periods pass; returns the shares.
    fn wait(&mut self, periods: u32) -> Vec<LedgerShare> {
        let now = Timestamp(self.now_ms * 1000);
        let tick = |_| {
            self.resync
                .tick(&mut self.ledger, &self.leadership, now)
                .shares
        };
        (0..periods * PERIOD).flat_map(tick).collect()
    }

    /// Lets time pass, one publication period per second; returns the shares.
    fn wait_until(&mut self, at_ms: u64) -> Vec<LedgerShare> {
        let mut shares = Vec::new();
        while self.now_ms < at_ms {
            self.now_ms = (self.now_ms + 1000).min(at_ms);
            let now = Timestamp(self.now_ms * 1000);
            shares.extend(
                self.resync
                    .tick(&mut self.ledger, &self.leadership, now)
                    .shares,
            );
        }
        shares
    }

    /// Merges shares; returns the answers.
    fn receive(&mut self, shares: &[LedgerShare]) -> Vec<LedgerShare> {
        let now_ms = self.now_ms;
        shares
            .iter()
            .flat_map(|share| self.merge(share, now_ms).unwrap().shares)
            .collect()
    }

    fn vehicles(&self) -> Vec<String> {
        self.ledger
            .entries()
            .map(|entry| entry.node.to_string())
            .collect()
    }

    fn incorrect(&self, vehicle: &str) -> u64 {
        self.ledger
            .totals()
            .get(&name(vehicle))
            .map_or(0, |(_, incorrect)| *incorrect)
    }
}

/// A leadership that is followed.
fn following(term: u64, leader: &str) -> Leadership {
    let epoch = Some(Epoch::new(term, name(leader)));
    Leadership {
        position: Position::Following,
        epoch,
        standby: None,
        term,
        is_deserted: false,
        is_yielding: false,
    }
}

/// The candidate `euclid`, which follows `edge` in term 7 and has led before.
fn euclid() -> Candidate {
    let mut euclid = Candidate::new("euclid");
    euclid.leadership = following(7, "edge");
    let own = Evidence {
        node: name("gauss"),
        label: "cup".into(),
        correct: true,
    };
    euclid.ledger.record(3, &name("euclid"), &own);
    euclid
}

fn share(from: &str, leads: Option<u64>, entries: Vec<LedgerEntry>) -> LedgerShare {
    LedgerShare {
        schema: SCHEMA_VERSION,
        node: name(from),
        epoch: leads,
        entries,
        marks: Vec::new(),
        signed: None,
        reset_at_us: None,
    }
}

fn slander(epoch: u64, aggregator: &str, incorrect: u64) -> LedgerEntry {
    let aggregator = name(aggregator);
    let node = name("gauss");
    let label = "cup".into();
    LedgerEntry {
        epoch,
        aggregator,
        node,
        label,
        correct: 0,
        incorrect,
    }
}

#[test]
fn unauthorised_evidence_is_refused() {
    let mut euclid = euclid();
    for stranger in ["mallory", "stranger"] {
        let refused = euclid.merge(&share(stranger, None, vec![slander(7, stranger, 1000)]), 0);
        assert_eq!(refused, Err(RejectReason::NotCandidate));
    }
    assert_eq!(euclid.incorrect("gauss"), 0);

    let merged = euclid.merge(
        &share(
            "edge",
            Some(7),
            vec![slander(7, "edge", 1), slander(8, "edge", 1000)],
        ),
        0,
    );
    let merged = merged.unwrap();
    assert!(merged.is_news && merged.refused == [RejectReason::UnknownTerm]);
    assert_eq!(euclid.incorrect("gauss"), 1);
}

#[test]
fn only_leader_shares_current_counts() {
    let mut euclid = euclid();
    euclid
        .merge(&share("edge", Some(7), vec![slander(7, "edge", 3)]), 0)
        .unwrap();
    let merged = euclid
        .merge(
            &share("other", None, vec![slander(7, "edge", 1_000_000_000)]),
            0,
        )
        .unwrap();
    assert_eq!(
        (merged.is_news, &merged.refused[..]),
        (false, &[RejectReason::Unattested][..])
    );
    euclid
        .merge(&share("edge", Some(7), vec![slander(7, "edge", 4)]), 100)
        .unwrap();
    assert_eq!(euclid.incorrect("gauss"), 4);
}

#[test]
fn current_counts_cannot_jump() {
    let mut euclid = euclid();
    euclid
        .merge(&share("edge", Some(7), vec![slander(7, "edge", 3)]), 0)
        .unwrap();
    euclid.leadership = following(8, "leader");
    for (forged, at_ms) in [(1_000_000_000, 1000), (1_000_000, 2000)] {
        let merged = euclid
            .merge(
                &share("other", None, vec![slander(7, "edge", forged)]),
                at_ms,
            )
            .unwrap();
        assert_eq!(
            (merged.is_news, &merged.refused[..]),
            (false, &[RejectReason::Implausible][..])
        );
    }
    let first = slander(8, "leader", MAX_FIRST_VOTES + 1);
    assert!(
        !euclid
            .merge(&share("leader", Some(8), vec![first]), 2000)
            .unwrap()
            .is_news
    );
    assert_eq!(euclid.incorrect("gauss"), 3);
    // Shares that were lost meanwhile.
    euclid
        .merge(&share("other", None, vec![slander(7, "edge", 900)]), 3000)
        .unwrap();
    assert_eq!(euclid.incorrect("gauss"), 900);
}

#[test]
fn leading_nodes_lane_is_protected() {
    let mut euclid = euclid();
    euclid.lead(7);
    euclid
        .merge(&share("edge", None, vec![slander(7, "euclid", 1000)]), 0)
        .unwrap();
    assert_eq!(euclid.incorrect("gauss"), 0);
}

#[test]
fn invented_lanes_displace_no_leader() {
    let mut euclid = euclid();
    let forged = (0..2 * MAX_LANES)
        .map(|n| slander(7, &format!("forger{n:03}"), 0))
        .collect();
    euclid.merge(&share("gauss", None, forged), 0).unwrap();
    euclid
        .merge(&share("edge", Some(7), vec![slander(7, "edge", 1)]), 0)
        .unwrap();
    assert_eq!(euclid.incorrect("gauss"), 1);
}

#[test]
fn alternating_leaders_get_few_answers() {
    let mut euclid = euclid();
    let mut sent = Vec::new();
    for at_ms in 0..1000 {
        euclid.leadership = Leadership {
            term: 7,
            ..following(1 + at_ms % 7, "gauss")
        };
        sent.extend(
            euclid
                .merge(&share("gauss", Some(1 + at_ms % 7), Vec::new()), at_ms)
                .unwrap()
                .shares,
        );
    }
    for (from, term, at_ms) in [
        ("gauss", u64::MAX, 1000),
        ("edge", 7, 6000),
        ("edge", 7, 20_000),
    ] {
        euclid.leadership = following(7, from);
        sent.extend(
            euclid
                .merge(&share(from, Some(term), Vec::new()), at_ms)
                .unwrap()
                .shares,
        );
    }
    assert_eq!(sent.len(), 2, "at once, and when some time has passed");
    assert!(
        sent.iter()
            .flat_map(|share| &share.entries)
            .all(|entry| entry.aggregator == name("euclid"))
    );
}

#[test]
fn claimed_lead_triggers_no_transfer() {
    let mut euclid = euclid();
    assert_eq!(
        euclid
            .merge(&share("edge", Some(7), Vec::new()), 0)
            .unwrap()
            .shares
            .len(),
        1,
        "it has led"
    );
    for at_s in 1..600 {
        for (from, term) in [("gauss", at_s % 8), ("edge", 7)] {
            let merged = euclid
                .merge(&share(from, Some(term), Vec::new()), at_s * 1000)
                .unwrap();
            assert_eq!(merged.shares, [], "{from} after {at_s} s");
        }
    }
    euclid.leadership = following(8, "gauss");
    assert_eq!(
        euclid
            .merge(&share("gauss", Some(8), Vec::new()), 600_000)
            .unwrap()
            .shares
            .len(),
        1,
        "it leads now"
    );
}

#[test]
fn dead_leaders_evidence_survives_split() {
    let mut a = Candidate::new("a");
    let mut b1 = Candidate::new("b1");
    let mut b2 = Candidate::new("b2");
    a.lead(1);
    b1.lead(2);
    b1.record(2, "euclid");
    b2.receive(&b1.wait(1));
    drop(b1);
    b2.lead(3);
    // The loser's messages when the sides heal are lost: it is not yet linked to the winner's
    // broker.
    b2.resync.step_down();
    drop(b2.resync.snapshot(&b2.ledger));
    a.lead(4);
    assert_eq!(a.vehicles(), [""; 0]);
    let answer = b2.receive(&a.wait(1));
    a.receive(&answer);
    assert_eq!(a.vehicles(), ["euclid"]);
}

#[test]
fn followers_evidence_reaches_next_leader() {
    let mut a = Candidate::new("a");
    let mut b1 = Candidate::new("b1");
    let mut b2 = Candidate::new("b2");
    b1.lead(2);
    b1.record(2, "euclid");
    b2.receive(&b1.wait(1));
    drop(b1);
    a.lead(3);
    a.record(3, "gauss");
    assert_eq!(b2.receive(&a.wait(1)), []);
    a.receive(&b2.wait(2));
    assert_eq!(a.vehicles(), ["euclid", "gauss"]);
    b2.receive(&a.wait(1));
    assert_eq!(
        b2.wait(2),
        [],
        "once the leader has it, no more requests are sent"
    );
}

#[test]
fn candidate_without_counts_stays_silent() {
    let mut leader = Candidate::new("leader");
    let mut other = Candidate::new("other");
    leader.lead(1);
    leader.record(1, "euclid");
    assert_eq!(other.receive(&leader.wait(1)), []);
    assert_eq!(other.vehicles(), ["euclid"]);
    assert_eq!(other.wait(2), []);
}

#[test]
fn round_counts_are_shared_at_once() {
    let mut leader = Candidate::new("leader");
    leader.lead(1);
    let [empty] = &leader.resync.snapshot(&leader.ledger)[..] else {
        panic!("one share")
    };
    assert_eq!((empty.epoch, empty.entries.len()), (Some(1), 0));
    let [share] = &leader.record(1, "euclid")[..] else {
        panic!("one share")
    };
    assert_eq!((share.entries.len(), share.entries[0].correct), (1, 1));
}

#[test]
fn many_counts_stay_acceptable() {
    let mut edge = signing("edge", 7, "edge");
    let mut euclid = signing("euclid", 7, "edge");
    edge.lead(7);
    (0..100_000).for_each(|_| drop(edge.record(7, "gauss")));
    euclid.receive(&sign(edge.resync.snapshot(&edge.ledger)));
    let later = (0..32).flat_map(|_| sign(edge.record(7, "gauss")));
    let refused: Vec<_> = later
        .flat_map(|share| euclid.merge(&share, 3000).unwrap().refused)
        .collect();
    assert_eq!(
        (refused, euclid.ledger.totals()),
        (Vec::new(), edge.ledger.totals())
    );
}

/// A candidate of a cell with certificates that follows.
fn signing(node: &str, term: u64, leader: &str) -> Candidate {
    let leadership = following(term, leader);
    Candidate {
        resync: LedgerResync::signed(name(node), PERIOD),
        leadership,
        ..Candidate::new(node)
    }
}

/// Shares as others get them: signed by those whose lane they are.
fn sign(shares: Vec<LedgerShare>) -> Vec<LedgerShare> {
    let sign = |share: LedgerShare| {
        let aggregator = share.lane().map(|lane| lane.leader.to_string());
        let signature = |certificate| LedgerSignature {
            certificate,
            signature: "signature".into(),
        };
        LedgerShare {
            signed: share.signed.clone().or(aggregator.map(signature)),
            ..share
        }
    };
    shares.into_iter().map(sign).collect()
}

#[test]
fn unsigned_evidence_is_refused() {
    let mut euclid = signing("euclid", 7, "edge");
    let honest = share("edge", Some(7), vec![slander(7, "edge", 1)]);
    assert_eq!(euclid.merge(&honest, 0), Err(RejectReason::BadSignature));
    let mixed = share(
        "edge",
        Some(7),
        vec![slander(7, "edge", 1), slander(6, "gauss", 1)],
    );
    let signed = LedgerSignature {
        certificate: "edge".into(),
        signature: "signature".into(),
    };
    assert_eq!(
        euclid.merge(
            &LedgerShare {
                signed: Some(signed),
                ..mixed
            },
            0
        ),
        Err(RejectReason::BadSignature)
    );
    let empty = euclid
        .merge(&share("edge", Some(7), Vec::new()), 0)
        .unwrap();
    assert_eq!(
        (empty.is_news, empty.refused),
        (false, Vec::new()),
        "no entry is to be signed"
    );
    euclid.receive(&sign(vec![honest]));
    assert_eq!(euclid.incorrect("gauss"), 1);
}

#[test]
fn signed_entries_are_accepted_together() {
    let mut euclid = signing("euclid", 7, "edge");
    let slanders = vec![
        slander(7, "edge", 1),
        LedgerEntry {
            label: "vase".into(),
            ..slander(7, "edge", u64::MAX >> 11)
        },
    ];
    let merged = euclid
        .merge(&sign(vec![share("edge", Some(7), slanders)])[0], 0)
        .unwrap();
    assert_eq!(
        (merged.is_news, &merged.refused[..]),
        (false, &[RejectReason::Implausible][..])
    );
    assert_eq!(
        (
            euclid.incorrect("gauss"),
            euclid.ledger.statements().count()
        ),
        (0, 0)
    );
}

#[test]
fn invented_lane_has_no_effect() {
    let mut edge = signing("edge", 7, "edge");
    let mut euclid = signing("euclid", 7, "edge");
    edge.lead(7);
    edge.leadership.position = Position::Leading;
    let forged = sign(vec![share("gauss", None, vec![slander(6, "gauss", 1000)])]);
    for node in [&mut edge, &mut euclid] {
        let merged = node.merge(&forged[0], 0).unwrap();
        assert_eq!(
            (merged.is_news, &merged.refused[..]),
            (false, &[RejectReason::Unattested][..])
        );
        let sent = [node.wait(3), node.resync.snapshot(&node.ledger)].concat();
        assert!(
            sent.iter().all(LedgerShare::is_empty),
            "nor is it passed on"
        );
    }
    euclid.leadership = following(8, "gauss");
    euclid.receive(&sign(vec![share(
        "gauss",
        Some(8),
        vec![slander(8, "gauss", 3)],
    )]));
    assert_eq!(
        euclid.incorrect("gauss"),
        3,
        "a leader's evidence is accepted while it leads"
    );
    let over = EVIDENCE_PROBATION.as_millis() as u64;
    euclid.wait_until(over);
    euclid.leadership = following(9, "edge");
    let late = sign(vec![share("gauss", None, vec![slander(8, "gauss", 4)])]);
    euclid.merge(&late[0], over + 1000).unwrap();
    assert_eq!(euclid.incorrect("gauss"), 4, "and in its last message");
    let later = sign(vec![share("gauss", None, vec![slander(8, "gauss", 5)])]);
    let merged = euclid
        .merge(&later[0], over + 1000 + LAST_WORD_TIME.as_millis() as u64)
        .unwrap();
    assert_eq!(
        (merged.is_news, &merged.refused[..]),
        (false, &[RejectReason::Unattested][..])
    );
}

#[test]
fn dead_leaders_signature_is_relayed() {
    let mut euclid = signing("other", 7, "edge");
    let mut gauss = signing("gauss", 8, "leader");
    let mut edge = signing("edge", 7, "edge");
    edge.lead(7);
    let mut said = Vec::new();
    for vehicle in ["euclid", "gauss", "euclid"] {
        said.extend(sign(edge.record(7, vehicle)));
    }
    assert_eq!(said.len(), 3, "one signature for each round");
    euclid.receive(&said);
    euclid.wait_until(EVIDENCE_PROBATION.as_millis() as u64);
    let news = share("leader", Some(8), Vec::new());
    euclid.leadership = following(8, "leader");
    edge.leadership = following(8, "leader");
    euclid.receive(std::slice::from_ref(&news));
    let passed_on = euclid.wait(4);
    assert!(
        passed_on
            .iter()
            .all(|share| share.signed == said[0].signed && share.node == name("other"))
    );
    gauss.receive(&passed_on);
    assert_eq!(gauss.ledger.totals(), edge.ledger.totals());
    let statements = gauss.ledger.statements().count();
    assert!(
        (2..=3 * REPEATS as usize).contains(&statements),
        "{statements}"
    );

    assert!(!gauss.ledger.retain_statements(|_| true));
    assert!(
        gauss
            .ledger
            .retain_statements(|share| share.signed != said[0].signed)
    );
    assert_eq!((gauss.ledger.totals().len(), gauss.ledger.lanes()), (0, 0));
}

#[test]
fn lost_counts_are_recovered() {
    let mut edge = signing("edge", 8, "leader");
    let mut before = signing("edge", 7, "edge");
    before.lead(7);
    before.record(7, "gauss");
    edge.ledger = before.ledger.clone();
    let lost = sign(before.record(7, "gauss"));
    edge.receive(&[LedgerShare {
        node: name("other"),
        ..lost[0].clone()
    }]);
    assert_eq!(edge.ledger.totals(), before.ledger.totals());
    edge.lead(9);
    let [share] = &edge.resync.snapshot(&edge.ledger)[..] else {
        panic!("one lane")
    };
    assert_eq!(
        (share.entries[0].correct, &share.signed),
        (2, &None),
        "to be signed"
    );
}

#[test]
fn superseded_statements_are_dropped() {
    let mut edge = signing("edge", 7, "edge");
    let mut euclid = signing("euclid", 7, "edge");
    edge.lead(7);
    for round in 0..2000 {
        let said = sign(edge.record(7, ["euclid", "gauss", "other"][round % 3]));
        said.iter()
            .for_each(|share| drop(euclid.merge(share, round as u64 * 100).unwrap()));
    }
    assert_eq!(euclid.ledger.totals(), edge.ledger.totals());
    assert!(
        euclid.ledger.statements().count() < 128,
        "{}",
        euclid.ledger.statements().count()
    );
    let mut copy = ReputationLedger::default();
    for share in euclid.ledger.statements() {
        copy.merge_statement(share, None);
    }
    assert_eq!(
        (copy.totals(), copy.marks().collect::<Vec<_>>()),
        (edge.ledger.totals(), edge.ledger.marks().collect())
    );
}

#[test]
fn reset_empties_all_ledgers() {
    let mut leader = Candidate::new("leader");
    let mut euclid = Candidate::new("other");
    leader.lead(7);
    leader.leadership = Leadership {
        position: Position::Leading,
        ..following(7, "leader")
    };
    (0..900).for_each(|_| drop(leader.record(7, "liar")));
    euclid.leadership = following(7, "leader");
    euclid.ledger = ReputationLedger::reset(Timestamp(5_000_000));
    let poisoned = leader.resync.snapshot(&leader.ledger);
    let mut answers = Vec::new();
    for (share, at_ms) in poisoned.iter().zip(6000..) {
        answers.extend(euclid.merge(share, at_ms).unwrap().shares);
    }
    assert_eq!(
        (answers.len(), euclid.vehicles().len()),
        (1, 0),
        "a follower sends its evidence to its leader"
    );
    assert!(leader.merge(&answers[0], 6010).unwrap().is_news);
    assert_eq!(leader.vehicles(), [""; 0]);
    leader.receive(&poisoned);
    assert_eq!(leader.vehicles(), [""; 0]);
    euclid.receive(&leader.record(7, "gauss"));
    assert_eq!(euclid.vehicles(), ["gauss"]);
    let far = Timestamp(0) + 2 * MAX_RESET_AHEAD;
    let forged = LedgerShare {
        reset_at_us: Some(far),
        ..share("other", None, Vec::new())
    };
    assert!(
        !leader.merge(&forged, 7000).unwrap().is_news,
        "a reset from a far future would be the last"
    );
    assert_eq!(leader.vehicles(), ["gauss"]);
}

/// Two sides of a split have counted votes. The side that continues to lead must not place its
/// counts before the other side's votes.
#[test]
fn votes_after_merge_are_latest() {
    let config = ReputationConfig::default();
    let mut edge = Candidate::new("edge");
    let vote = |correct| Evidence {
        node: name("euclid"),
        label: "cup".into(),
        correct,
    };
    edge.lead(2);
    let vote_of = |edge: &mut Candidate, term, correct| {
        edge.resync.record(
            &Epoch::new(term, name("edge")),
            &[vote(correct)],
            &mut edge.ledger,
        );
    };
    (0..10).for_each(|_| vote_of(&mut edge, 2, true));
    (0..600).for_each(|_| edge.ledger.record(3, &name("gauss"), &vote(true)));
    edge.lead(4);
    let before = edge.ledger.reputations(&config)[&name("euclid")].score;
    (0..600).for_each(|_| vote_of(&mut edge, 4, false));
    assert!(edge.ledger.reputations(&config)[&name("euclid")].score < before);
}

/// A follower that claims a higher term makes the leader renew its own: that costs no older
/// evidence.
#[test]
fn renewed_term_keeps_one_lane() {
    let mut edge = Candidate::new("edge");
    let mut gauss = Candidate::new("gauss");
    for candidate in [&mut edge, &mut gauss] {
        candidate.ledger.record(
            1,
            &name("a"),
            &Evidence {
                node: name("hopper"),
                label: "cup".into(),
                correct: true,
            },
        );
    }
    for term in 2..2 + 2 * MAX_LANES as u64 {
        edge.lead(term);
        gauss.leadership = Leadership {
            position: Position::Following,
            epoch: Some(Epoch::new(term, name("edge"))),
            ..gauss.leadership
        };
        gauss.receive(&edge.record(term, "euclid"));
    }
    let merged = gauss
        .merge(&share("other", None, vec![slander(2, "edge", 1)]), 100_000)
        .unwrap();
    assert_eq!(
        merged.refused,
        [RejectReason::Unattested],
        "only its leader sends it"
    );
    for candidate in [&edge, &gauss] {
        assert!(
            candidate.vehicles().contains(&"hopper".to_owned()),
            "evidence of an earlier leader is dropped"
        );
        assert_eq!(
            candidate.ledger.totals()[&name("euclid")].0,
            2 * MAX_LANES as u64
        );
    }
}
