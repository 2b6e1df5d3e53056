//! Evidence about vehicles: recorded by leaders, replicated by shares, kept on every candidate's disk.

use std::collections::BTreeMap;

use ecod::leadership::node::Input;
use ecod::model::epoch::Epoch;
use ecod::model::names::{Label, NodeName};
use ecod::model::time::Timestamp;
use ecod::reputation::{Counts, EntryKey, Evidence, ReputationLedger};
use ecod::wire::{LedgerEntry, LedgerMark, LedgerShare, Role};

use crate::sim::node::Arrival;
use crate::sim::world::{MS, World};

/// Time between two publications of reputations, in µs.
pub(crate) const PUBLISH_PERIOD: u64 = 1000 * MS;

/// Vehicles about which there is evidence: so few that they reach marks.
const VEHICLES: usize = 2;

/// Labels that every vehicle states in turn.
const LABELS: [&str; 2] = ["car", "van"];

/// Every vote that was settled, as leaders recorded it.
#[derive(Default)]
pub(crate) struct Votes {
    counts: BTreeMap<EntryKey, Counts>,
    /// The counts of each vehicle in each lane after every vote.
    courses: BTreeMap<(Epoch, NodeName), Vec<Counts>>,
}

impl Votes {
    /// Settles one more vote of a vehicle; returns it as evidence.
    fn settle(&mut self, lane: &Epoch, node: NodeName, correct: bool) -> Evidence {
        let add = |counts: &mut Counts| {
            if correct {
                counts.correct += 1;
            } else {
                counts.incorrect += 1;
            }
        };
        let course = self
            .courses
            .entry((lane.clone(), node.clone()))
            .or_default();
        let label = Label::from(LABELS[course.len() % LABELS.len()]);
        let mut sum = course.last().copied().unwrap_or_default();
        add(&mut sum);
        course.push(sum);
        add(self
            .counts
            .entry(EntryKey {
                lane: lane.clone(),
                node: node.clone(),
                label: label.clone(),
            })
            .or_default());
        Evidence {
            node,
            label,
            correct,
        }
    }

    /// True if an entry counts no more votes than were settled.
    fn hold(&self, entry: &LedgerEntry) -> bool {
        let LedgerEntry {
            epoch,
            aggregator,
            node,
            label,
            correct,
            incorrect,
        } = entry.clone();
        let settled = self.counts.get(&EntryKey {
            lane: Epoch::new(epoch, aggregator),
            node,
            label,
        });
        settled.is_some_and(|settled| correct <= settled.correct && incorrect <= settled.incorrect)
    }

    /// True if a mark holds the counts that a vehicle once had.
    fn passed(&self, mark: &LedgerMark) -> bool {
        let LedgerMark {
            epoch,
            aggregator,
            node,
            correct,
            incorrect,
            ..
        } = mark.clone();
        let course = self.courses.get(&(Epoch::new(epoch, aggregator), node));
        let votes = (correct + incorrect) as usize;
        let counts = course.and_then(|course| course.get(votes.checked_sub(1)?));
        counts == Some(&Counts { correct, incorrect })
    }
}

impl World {
    /// Records the evidence about vehicles from a round of a node's own leadership.
    pub(crate) fn judge_vehicles(&mut self, index: usize, epoch: &Epoch) {
        if self.random.chance(80) {
            return;
        }
        let vehicle = self.random.index(VEHICLES);
        let node = self.nodes[vehicle].name.clone();
        let correct = self.random.chance(90);
        let leader = &mut self.nodes[index];
        let lane = leader.resync.lane_in(epoch, &leader.ledger);
        leader.lane = Some(lane.clone());
        let evidence = self.votes.settle(&lane, node, correct);
        let node = &mut self.nodes[index];
        let shares = node.resync.record(epoch, &[evidence], &mut node.ledger);
        self.share(index, shares);
    }

    /// Shares all evidence of a node.
    pub(crate) fn share_all(&mut self, index: usize) {
        let shares = self.nodes[index].resync.snapshot(&self.nodes[index].ledger);
        self.share(index, shares);
    }

    pub(crate) fn take_share(&mut self, to: usize, share: &LedgerShare) {
        if self.nodes[to].config.role == Role::Cav {
            return;
        }
        let candidates = self.candidates(to);
        let now = Timestamp(self.now).shifted(self.nodes[to].steady_clock);
        let node = &mut self.nodes[to];
        if let Ok(merged) = node.resync.merge(
            share,
            &mut node.ledger,
            &candidates,
            &node.leadership,
            now,
            now,
        ) {
            if !self.nodes[to].signs {
                self.judge_merge(to, share);
            }
            self.share(to, merged.shares);
            self.handle(
                to,
                Input::EvidenceReceived {
                    from: share.node.clone(),
                },
            );
        }
    }

    /// Checks that a node has kept all evidence that it received for terms of its election. Evidence of the present
    /// leadership comes only from its leader.
    fn judge_merge(&self, to: usize, share: &LedgerShare) {
        let node = &self.nodes[to];
        let mut received = ReputationLedger::default();
        let counts = |term: u64, aggregator: &NodeName| {
            let lane = Epoch::new(term, aggregator.clone());
            let is_of_leader = |now: &Epoch| now.leader == lane.leader && lane <= *now;
            let is_told_by_another = share.node != lane.leader
                && node.leadership.present_epoch().is_some_and(is_of_leader);
            node.leadership.has_term(term) && !is_told_by_another
        };
        let entries = share
            .entries
            .iter()
            .filter(|entry| counts(entry.epoch, &entry.aggregator));
        received.merge_entries(entries.cloned(), None);
        received.merge_marks(
            share
                .marks
                .iter()
                .filter(|mark| counts(mark.epoch, &mark.aggregator))
                .cloned(),
            None,
        );
        let lacks = received.beyond(&node.ledger);
        assert!(
            lacks.0.is_empty() && lacks.1.is_empty(),
            "{} received {lacks:?} and does not have it",
            node.name
        );
    }

    /// A publication period has passed.
    pub(crate) fn keep(&mut self, index: usize) {
        let now = Timestamp(self.now).shifted(self.nodes[index].steady_clock);
        let node = &mut self.nodes[index];
        let lost = node.saved.beyond(&node.ledger);
        assert!(
            lost.0.is_empty() && lost.1.is_empty(),
            "{} forgot {lost:?}",
            node.name
        );
        node.saved.clone_from(&node.ledger);
        node.saved.end_probations(now, |_| true);
        let shares = node
            .resync
            .tick(&mut node.ledger, &node.leadership, now)
            .shares;
        self.share(index, shares);
        self.push_to(index, PUBLISH_PERIOD, Arrival::Keep);
    }

    /// The other nodes that may lead, by the node's membership.
    fn candidates(&self, of: usize) -> Vec<NodeName> {
        let members = self.nodes[of]
            .members
            .keys()
            .map(|member| &self.nodes[*member]);
        members
            .filter(|node| node.config.role != Role::Cav)
            .map(|node| node.name.clone())
            .collect()
    }

    /// All evidence of the running candidates. Signed evidence counts if a candidate other than its aggregator forwards
    /// it.
    pub(crate) fn known_evidence(&self) -> ReputationLedger {
        let mut all = ReputationLedger::default();
        for (_, node) in self
            .alive()
            .filter(|(_, node)| node.config.role != Role::Cav)
        {
            if node.signs {
                node.ledger
                    .statements()
                    .for_each(|share| _ = all.merge_share(share, None));
            } else {
                all.merge(&node.ledger);
            }
        }
        all
    }

    /// Checks that every running candidate has all evidence in `known`.
    pub(crate) fn everyone_knows(&self, known: &ReputationLedger) -> Result<(), String> {
        for (_, node) in self
            .alive()
            .filter(|(_, node)| node.config.role != Role::Cav)
        {
            let (entries, marks) = known.beyond(&node.ledger);
            if !entries.is_empty() || !marks.is_empty() {
                return Err(format!("{} lacks {entries:?} {marks:?}", node.name));
            }
        }
        Ok(())
    }

    /// Checks that every count, mark and total of a living node is made of votes that a leader settled, each once.
    pub(crate) fn nothing_is_counted_twice(&self) -> Result<(), String> {
        for (_, node) in self.alive() {
            if let Some(entry) = node.ledger.entries().find(|entry| !self.votes.hold(entry)) {
                return Err(format!(
                    "{} counts votes that were not settled: {entry:?}",
                    node.name
                ));
            }
            if let Some(mark) = node.ledger.marks().find(|mark| !self.votes.passed(mark)) {
                return Err(format!(
                    "{} has a mark that was not reached: {mark:?}",
                    node.name
                ));
            }
            let mut sums: BTreeMap<NodeName, (u64, u64)> = BTreeMap::new();
            for LedgerEntry {
                node,
                correct,
                incorrect,
                ..
            } in node.ledger.entries()
            {
                let sum = sums.entry(node).or_default();
                *sum = (sum.0 + correct, sum.1 + incorrect);
            }
            let totals = node.ledger.totals();
            if totals != sums {
                return Err(format!(
                    "{} has totals {totals:?} of counts {sums:?}",
                    node.name
                ));
            }
        }
        Ok(())
    }
}
