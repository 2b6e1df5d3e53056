//! Terms of leadership, map latencies and reputations over time.

use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use ecod::leadership::{Leadership, Position};
use ecod::model::epoch::Epoch;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::wire::Reputations;
use serde::Serialize;

use super::snapshot::json;
use super::timeline::Timeline;

/// One leader's time in the lead, as observed by this node.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(crate) struct LeaderTerm {
    pub leader: NodeName,
    pub epoch: u64,
    /// Time at which this node began to follow it.
    pub from_us: Timestamp,
    /// Time at which this node stopped; absent while it follows.
    pub until_us: Option<Timestamp>,
    /// Milliseconds between the last accepted round before this term and this leader's first round;
    /// absent until both have arrived.
    pub gap_ms: Option<u64>,
}

/// Statistics of one [`SAMPLE_PERIOD`].
#[derive(Debug, Serialize)]
struct VitalsSample<'a> {
    /// End of the period.
    at_us: Timestamp,
    rounds: u32,
    /// Median milliseconds from the oldest capture in a map to its receipt; absent without such a
    /// map.
    latency_p50_ms: Option<f64>,
    /// Maximum of the same.
    latency_max_ms: Option<f64>,
    /// Reputation of each vehicle shown.
    reputations: BTreeMap<&'a NodeName, f64>,
}

/// Leader terms, events, maps and samples, oldest first.
#[derive(Debug)]
pub(crate) struct History {
    pub terms: VecDeque<LeaderTerm>,
    /// Events and maps of the latest [`SPAN`].
    pub timeline: Timeline,
    /// End of each period and its sample as JSON, which is encoded once for all browsers.
    samples: VecDeque<(Timestamp, Vec<u8>)>,
    /// Changes of the leader since the node started.
    pub failovers: u64,
    last_round: Option<(Epoch, Timestamp)>,
    /// Gap before the last epoch's first round. The round may arrive before the election names the
    /// leader.
    last_gap: Option<(Epoch, u64)>,
    latencies_ms: Vec<f64>,
    rounds: u32,
}

/// Time between two samples.
pub(crate) const SAMPLE_PERIOD: Duration = Duration::from_secs(2);

/// Time over which events, maps and samples are held.
pub(crate) const SPAN: Duration = Duration::from_secs(600);

/// Minimum time between two maps that are held.
const MAP_PERIOD: Duration = Duration::from_millis(500);

/// Maximum number of samples.
pub(crate) const MAX_SAMPLES: usize = (SPAN.as_secs() / SAMPLE_PERIOD.as_secs()) as usize;

/// Maximum number of terms.
pub(crate) const MAX_TERMS: usize = 32;

/// Maximum number of vehicles in a sample.
pub(crate) const MAX_VEHICLES: usize = 64;

/// Maximum number of latencies per sample.
const MAX_LATENCIES: usize = 256;

impl Default for History {
    fn default() -> Self {
        Self {
            terms: VecDeque::new(),
            timeline: Timeline::new(SPAN, MAP_PERIOD),
            samples: VecDeque::new(),
            failovers: 0,
            last_round: None,
            last_gap: None,
            latencies_ms: Vec::new(),
            rounds: 0,
        }
    }
}

impl History {
    /// The whole history as JSON, with the samples and events after `time` only.
    pub(crate) fn json_since(&self, time: Timestamp) -> Vec<u8> {
        let newer: Vec<_> = self
            .samples
            .iter()
            .filter(|(at, _)| *at > time)
            .map(|(_, sample)| &**sample)
            .collect();
        let terms = json(&self.terms);
        let samples = newer.join(&b',');
        let failovers = json(&self.failovers);
        let head = &b"{\"reigns\":"[..];
        let timeline = self.timeline.json_since(time);
        [
            head,
            &terms,
            b",\"samples\":[",
            &samples,
            b"],\"failovers\":",
            &failovers,
            b",",
            &timeline,
            b"}",
        ]
        .concat()
    }

    /// Processes the current leadership.
    pub(crate) fn add_leadership(&mut self, leadership: &Leadership, now: Timestamp) {
        let present = leadership
            .epoch
            .as_ref()
            .filter(|_| leadership.position != Position::Seeking);
        if let Some(open) = self.terms.back_mut().filter(|term| term.until_us.is_none()) {
            if present.is_some_and(|epoch| *epoch == Epoch::new(open.epoch, open.leader.clone())) {
                return;
            }
            open.until_us = Some(now);
        }
        let Some(epoch) = present else { return };
        self.failovers += u64::from(
            self.terms
                .back()
                .is_some_and(|last| last.leader != epoch.leader),
        );
        let gap_ms = self
            .last_gap
            .as_ref()
            .filter(|(of, _)| of == epoch)
            .map(|(_, gap)| *gap);
        let leader = epoch.leader.clone();
        let epoch = epoch.term;
        push(
            &mut self.terms,
            LeaderTerm {
                leader,
                epoch,
                from_us: now,
                until_us: None,
                gap_ms,
            },
            MAX_TERMS,
        );
    }

    /// Processes an accepted round; `captured_at` is the oldest capture in it, on the aggregator's
    /// clock.
    pub(crate) fn add_round(
        &mut self,
        epoch: &Epoch,
        captured_at: Option<Timestamp>,
        received_at: Timestamp,
    ) {
        self.rounds = self.rounds.saturating_add(1);
        if self.latencies_ms.len() < MAX_LATENCIES {
            self.latencies_ms.extend(
                captured_at.map(|captured_at| received_at.since(captured_at).as_secs_f64() * 1e3),
            );
        }
        let before = self.last_round.replace((epoch.clone(), received_at));
        let Some((last, last_at)) = before.filter(|(last, _)| last != epoch) else {
            return;
        };
        let gap_ms = u64::try_from(received_at.since(last_at).as_millis()).unwrap_or(u64::MAX);
        let of_epoch =
            |term: &&mut LeaderTerm| term.leader == epoch.leader && term.epoch == epoch.term;
        if let Some(term) = self.terms.iter_mut().rev().find(of_epoch) {
            term.gap_ms.get_or_insert(gap_ms);
        }
        self.last_gap = Some((epoch.clone(), gap_ms));
        tracing::debug!(%last, %epoch, gap_ms, "first round of another leader");
    }

    /// Ends a sample period.
    pub(crate) fn sample(&mut self, reputations: Option<&Reputations>, now: Timestamp) {
        let mut latencies = std::mem::take(&mut self.latencies_ms);
        latencies.sort_by(f64::total_cmp);
        let reputations = reputations
            .into_iter()
            .flat_map(|r| &r.reputations)
            .take(MAX_VEHICLES);
        let sample = VitalsSample {
            at_us: now,
            rounds: std::mem::take(&mut self.rounds),
            latency_p50_ms: latencies.get(latencies.len() / 2).copied(),
            latency_max_ms: latencies.last().copied(),
            reputations: reputations
                .map(|(name, reputation)| (name, reputation.score))
                .collect(),
        };
        push(&mut self.samples, (now, json(&sample)), MAX_SAMPLES);
    }
}

/// Appends an item, and drops the oldest beyond `max`.
fn push<T>(items: &mut VecDeque<T>, item: T, max: usize) {
    if items.len() >= max {
        items.pop_front();
    }
    items.push_back(item);
}

#[cfg(test)]
mod tests {
    use super::*;

    fn led_by(leader: &'static str, term: u64) -> Leadership {
        let epoch = Some(Epoch::new(term, NodeName::from_static(leader)));
        Leadership {
            position: Position::Following,
            epoch,
            standby: None,
            term,
            is_deserted: false,
            is_yielding: false,
        }
    }

    fn seconds(n: u64) -> Timestamp {
        Timestamp(n * 1_000_000)
    }

    #[test]
    fn failover_starts_new_term() {
        let mut history = History::default();
        let epoch = |leader, term| Epoch::new(term, NodeName::from_static(leader));
        history.add_leadership(&led_by("edge", 3), seconds(1));
        history.add_round(&epoch("edge", 3), None, seconds(9));
        history.add_leadership(&led_by("edge", 3), seconds(9));
        let seeking = Leadership {
            position: Position::Seeking,
            ..led_by("edge", 3)
        };
        history.add_leadership(&seeking, seconds(10));
        history.add_leadership(&led_by("euclid", 4), seconds(11));
        history.add_round(&epoch("euclid", 4), None, seconds(12));
        history.add_round(&epoch("euclid", 4), None, seconds(14));
        history.add_round(&epoch("gauss", 5), None, seconds(15));
        history.add_leadership(&led_by("gauss", 5), seconds(16));
        let term = |leader, epoch, from, until: Option<u64>, gap_ms| {
            let leader = NodeName::from_static(leader);
            LeaderTerm {
                leader,
                epoch,
                from_us: seconds(from),
                until_us: until.map(seconds),
                gap_ms,
            }
        };
        let first = term("edge", 3, 1, Some(10), None);
        let second = term("euclid", 4, 11, Some(16), Some(3000));
        assert_eq!(
            history.terms,
            [first, second, term("gauss", 5, 16, None, Some(1000))]
        );
        assert_eq!(history.failovers, 2);
    }

    #[test]
    fn rediscovered_leader_is_no_failover() {
        let mut history = History::default();
        history.add_leadership(&led_by("edge", 3), seconds(1));
        history.add_leadership(&Leadership::default(), seconds(2));
        history.add_leadership(&led_by("edge", 4), seconds(3));
        assert_eq!((history.terms.len(), history.failovers), (2, 0));
    }

    #[test]
    fn long_run_is_bounded() {
        let mut history = History::default();
        for n in 0..1000 {
            history.add_leadership(
                &led_by(if n % 2 == 0 { "edge" } else { "euclid" }, n),
                seconds(n),
            );
            let epoch = Epoch::new(n, NodeName::from_static("edge"));
            (0..1000).for_each(|_| history.add_round(&epoch, Some(seconds(n)), seconds(n)));
            assert!(history.latencies_ms.len() <= MAX_LATENCIES);
            history.sample(None, seconds(n));
        }
        assert_eq!(
            (history.terms.len(), history.samples.len()),
            (MAX_TERMS, MAX_SAMPLES)
        );
        let samples: serde_json::Value =
            serde_json::from_slice(&history.json_since(seconds(997))).unwrap();
        let samples = samples["samples"].as_array().unwrap();
        assert_eq!(
            samples.len(),
            2,
            "samples that the browser has are not sent again"
        );
        assert_eq!(
            (&samples[1]["at_us"], &samples[1]["rounds"]),
            (&999_000_000.into(), &1000.into())
        );
    }
}
