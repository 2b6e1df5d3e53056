//! Evidence of others: whose is accepted, what it costs, and how it survives the end of leaders.

use super::*;
use crate::leadership::view::Position;
use crate::reputation::MAX_LANES;

fn name(name: &str) -> NodeName {
    NodeName::new(name).unwrap()
}

/// A candidate and its ledger.
struct Candidate {
    resync: LedgerResync,
    ledger: ReputationLedger,
    leadership: Leadership,
}

/// Publication periods between two snapshots.
const PERIOD: u32 = 10;

impl Candidate {
    fn new(node: &str) -> Self {
        let leadership = Leadership { term: u64::MAX, ..Leadership::default() };
        Self { resync: LedgerResync::new(name(node), PERIOD), ledger: ReputationLedger::default(), leadership }
    }

    fn lead(&mut self, term: u64) {
        self.resync.lead(Epoch::new(term, self.resync.name.clone()));
    }

    fn record(&mut self, term: u64, vehicle: &str) -> Vec<LedgerShare> {
        let evidence = Evidence { node: name(vehicle), label: "ABC123".into(), correct: true };
        self.resync.record(&Epoch::new(term, self.resync.name.clone()), &[evidence], &mut self.ledger)
    }

    fn merge(&mut self, share: &LedgerShare, at_ms: u64) -> Result<Merged, RejectReason> {
        let candidates = ["a", "b1", "b2", "edge", "gauss", "leader", "other"].map(name);
        self.resync.merge(share, &mut self.ledger, &candidates, &self.leadership, Timestamp(at_ms * 1000))
    }

    /// Lets snapshot periods pass; returns what is shared.
    fn wait(&mut self, periods: u32) -> Vec<LedgerShare> {
        let tick = |_| self.resync.tick(&self.ledger, &self.leadership, Timestamp(0));
        (0..periods * PERIOD).flat_map(tick).collect()
    }

    /// Takes in shares; returns what comes back.
    fn hear(&mut self, shares: &[LedgerShare]) -> Vec<LedgerShare> {
        shares.iter().flat_map(|share| self.merge(share, 0).unwrap().shares).collect()
    }

    fn vehicles(&self) -> Vec<String> {
        self.ledger.entries().map(|entry| entry.node.to_string()).collect()
    }

    fn incorrect(&self, vehicle: &str) -> u64 {
        self.ledger.totals().get(&name(vehicle)).map_or(0, |(_, incorrect)| *incorrect)
    }
}

/// The candidate `euclid`, which follows `edge` in term 7 and has led before.
fn euclid() -> Candidate {
    let mut euclid = Candidate::new("euclid");
    let epoch = Some(Epoch::new(7, name("edge")));
    euclid.leadership = Leadership { position: Position::Following, epoch, standby: None, term: 7 };
    let own = Evidence { node: name("gauss"), label: "cup".into(), correct: true };
    euclid.ledger.record(3, &name("euclid"), &own);
    euclid
}

fn share(from: &str, leads: Option<u64>, entries: Vec<LedgerEntry>) -> LedgerShare {
    LedgerShare { schema: SCHEMA_VERSION, node: name(from), epoch: leads, entries, marks: Vec::new() }
}

fn slander(epoch: u64, aggregator: &str, incorrect: u64) -> LedgerEntry {
    let (aggregator, node, label) = (name(aggregator), name("gauss"), "cup".into());
    LedgerEntry { epoch, aggregator, node, label, correct: 0, incorrect }
}

#[test]
fn evidence_of_vehicles_strangers_and_later_terms_is_refused() {
    let mut euclid = euclid();
    for stranger in ["mallory", "stranger"] {
        let refused = euclid.merge(&share(stranger, None, vec![slander(7, stranger, 1000)]), 0);
        assert_eq!(refused, Err(RejectReason::NotCandidate));
    }
    assert_eq!(euclid.incorrect("gauss"), 0);

    let merged = euclid.merge(&share("edge", Some(7), vec![slander(7, "edge", 1), slander(8, "edge", 1000)]), 0);
    let merged = merged.unwrap();
    assert!(merged.is_news && merged.has_unknown_terms);
    assert_eq!(euclid.incorrect("gauss"), 1);
}

#[test]
fn nobody_writes_in_the_lane_of_a_node_that_leads() {
    let mut euclid = euclid();
    euclid.lead(7);
    euclid.merge(&share("edge", None, vec![slander(7, "euclid", 1000)]), 0).unwrap();
    assert_eq!(euclid.incorrect("gauss"), 0);
}

#[test]
fn a_candidate_that_invents_lanes_does_not_displace_the_leaders() {
    let mut euclid = euclid();
    let forged = (0..2 * MAX_LANES).map(|n| slander(7, &format!("forger{n:03}"), 0)).collect();
    euclid.merge(&share("gauss", None, forged), 0).unwrap();
    euclid.merge(&share("edge", Some(7), vec![slander(7, "edge", 1)]), 0).unwrap();
    assert_eq!(euclid.incorrect("gauss"), 1);
}

#[test]
fn leaders_that_change_with_every_share_are_not_answered_each_time() {
    let mut euclid = euclid();
    let mut sent = Vec::new();
    for at_ms in 0..1000 {
        sent.extend(euclid.merge(&share("gauss", Some(1 + at_ms % 7), Vec::new()), at_ms).unwrap().shares);
    }
    for (from, term, at_ms) in [("gauss", u64::MAX, 1000), ("edge", 7, 6000), ("edge", 7, 20_000)] {
        sent.extend(euclid.merge(&share(from, Some(term), Vec::new()), at_ms).unwrap().shares);
    }
    assert_eq!(sent.len(), 2, "at once, and when some time has passed");
    assert!(sent.iter().flat_map(|share| &share.entries).all(|entry| entry.aggregator == name("euclid")));
}

#[test]
fn what_a_leader_learnt_that_died_during_a_split_reaches_the_leader_that_remains() {
    let (mut a, mut b1, mut b2) = (Candidate::new("a"), Candidate::new("b1"), Candidate::new("b2"));
    a.lead(1);
    b1.lead(2);
    b1.record(2, "euclid");
    b2.hear(&b1.wait(1));
    drop(b1);
    b2.lead(3);
    // What the loser sends when the sides heal is lost: it is not yet linked to the winner's broker.
    b2.resync.step_down();
    drop(b2.resync.snapshot(&b2.ledger));
    a.lead(4);
    assert_eq!(a.vehicles(), [""; 0]);
    let answer = b2.hear(&a.wait(1));
    a.hear(&answer);
    assert_eq!(a.vehicles(), ["euclid"]);
}

#[test]
fn what_only_followers_know_of_a_leader_that_is_gone_reaches_the_next() {
    let (mut a, mut b1, mut b2) = (Candidate::new("a"), Candidate::new("b1"), Candidate::new("b2"));
    b1.lead(2);
    b1.record(2, "euclid");
    b2.hear(&b1.wait(1));
    drop(b1);
    a.lead(3);
    a.record(3, "gauss");
    assert_eq!(b2.hear(&a.wait(1)), []);
    a.hear(&b2.wait(2));
    assert_eq!(a.vehicles(), ["euclid", "gauss"]);
    b2.hear(&a.wait(1));
    assert_eq!(b2.wait(2), [], "once the leader has it, nothing more comes");
}

#[test]
fn a_candidate_that_never_led_is_silent_when_it_hears_a_leader() {
    let (mut leader, mut other) = (Candidate::new("leader"), Candidate::new("other"));
    leader.lead(1);
    leader.record(1, "euclid");
    assert_eq!(other.hear(&leader.wait(1)), []);
    assert_eq!(other.vehicles(), ["euclid"]);
    assert_eq!(other.wait(2), []);
}

#[test]
fn what_a_round_says_is_shared_at_once_and_that_there_is_nothing_too() {
    let mut leader = Candidate::new("leader");
    leader.lead(1);
    let [empty] = &leader.resync.snapshot(&leader.ledger)[..] else { panic!("one share") };
    assert_eq!((empty.epoch, empty.entries.len()), (Some(1), 0));
    let [share] = &leader.record(1, "euclid")[..] else { panic!("one share") };
    assert_eq!((share.entries.len(), share.entries[0].correct), (1, 1));
}
