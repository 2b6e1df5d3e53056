//! The trigger of rounds: a round closes every period, or as soon as every live vehicle has
//! reported.
//!
//! - The first rounds of a leadership without handover follow each other more quickly.
//! - A round waits for both reports of a vehicle that sends both kinds.
//! - A vehicle that reports less often than rounds close is waited for in the rounds in which its
//!   next report is expected.
//! - Vehicles often report once a period, all at about the same time, and just as a round ends. If
//!   the round ended between their reports, the later reports would wait for another period, in
//!   every round. The end is therefore delayed a little while reports arrive. If a round still ends
//!   between them, the remaining vehicles get a round as soon as the last of them has reported;
//!   later rounds then end after all reports.
//! - Where several vehicles report, a vehicle with all its parts closes rounds early at most every
//!   four fifths of a period. A vehicle that reports more often than the others thus hardly raises
//!   the rate of maps.
//!
//! Call [`RoundTrigger::report`] for every admitted report and [`RoundTrigger::tick`] at
//! [`RoundTrigger::deadline`]; either returns true when the round closes.

use std::collections::BTreeMap;
use std::time::Duration;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::config::config_section;
use crate::model::names::NodeName;
use crate::model::time::Timestamp;
use crate::wire::ReportKind;

config_section! {
    /// The interval of rounds.
    pub struct RoundConfig {
        /// Longest time between rounds in seconds, the paper's τ. Default 0.1.
        pub period_s: f64 = 0.1, in 0.005 to 60.0;
        /// The condition that closes a round before the period is over.
        pub close: RoundClose = RoundClose::WhenComplete;
    }
}

/// The condition that closes a round.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum RoundClose {
    /// Only the time, as in the paper. Adds up to a period of latency.
    Periodic,
    /// Every live vehicle has reported since the last round; at the latest after the period, or a
    /// tenth more while reports arrive. The default.
    WhenComplete,
}

impl RoundConfig {
    fn period(&self) -> Duration {
        Duration::from_secs_f64(self.period_s)
    }
}

/// The state of the current round.
#[derive(Debug, Clone)]
pub struct RoundTrigger {
    config: RoundConfig,
    last_close: Timestamp,
    /// Time of the first report of the current round.
    first_report: Option<Timestamp>,
    /// Time from which on the reports of the current round may close it early.
    round_early_from: Option<Timestamp>,
    /// Each vehicle's last report in the current round.
    reported: BTreeMap<NodeName, PacedReport>,
    /// Time from which each vehicle's pace runs: of its last report in earlier rounds, or later.
    paced_from: BTreeMap<NodeName, Timestamp>,
    live: [BTreeMap<NodeName, Reporter>; ReportKind::COUNT],
    /// Number of live vehicles that have not reported in the current round.
    missing: usize,
    /// Number of vehicles whose report was due when the last round closed and that have not
    /// reported since.
    due: usize,
    /// Length of the current round.
    length: Duration,
    /// True if it lasts that long even if all have reported.
    held: bool,
    /// Number of [`EARLY`] rounds that have begun.
    early: usize,
}

/// A vehicle's report in the current round.
#[derive(Debug, Clone, Copy)]
struct PacedReport {
    at: Timestamp,
    /// Time from which on it may close the round early.
    early_from: Timestamp,
}

#[derive(Debug, Clone)]
struct Reporter {
    last_report: Timestamp,
    /// Times between its last three reports; [`Duration::ZERO`] where it has sent fewer.
    gaps: [Duration; 2],
    /// True if the current round waits for it: its next report is expected, and has not come.
    is_awaited: bool,
    /// True if its report was due when the last round closed.
    due: bool,
}

impl Reporter {
    fn new(now: Timestamp) -> Self {
        Self {
            last_report: now,
            gaps: [Duration::ZERO; 2],
            is_awaited: false,
            due: false,
        }
    }

    fn record(&mut self, now: Timestamp) {
        self.gaps = [self.gaps[1], now.since(self.last_report)];
        self.last_report = now;
    }

    /// Time between its reports, at least a round's. A single lost report does not change it.
    fn interval(&self, period: Duration) -> Duration {
        self.gaps[0].min(self.gaps[1]).max(period)
    }

    /// Begins a round at `now`; true if the round waits for it.
    fn begin_round(&mut self, now: Timestamp, period: Duration) -> bool {
        let silent = now.since(self.last_report);
        let interval = self.interval(period);
        let expected_within = interval.saturating_sub(silent);
        self.is_awaited = silent < interval * LIVE_INTERVALS
            && expected_within <= period + period / DELAY_DIVISOR;
        self.is_awaited
    }
}

/// The due time of the first round of a leadership. After [`Self::Overdue`] and
/// [`Self::AfterConnects`] a few more follow quickly.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum FirstRound {
    /// Unchanged: the node continues to lead.
    InStep,
    /// A period from now: the node that handed over has just closed a round.
    OnTime,
    /// At once: the other nodes are connected to this node's broker and wait.
    Overdue,
    /// [`CONNECT_TIME`] from now: the other nodes wait, but are not connected to this node's broker
    /// yet.
    AfterConnects,
}

/// Time for a vehicle to connect to a new broker, with a margin. The vehicle misses maps that are
/// sent earlier.
pub const CONNECT_TIME: Duration = Duration::from_millis(25);

/// Lengths of the rounds after the first round of an unplanned leadership: a vehicle that connects
/// late waits for one of these rounds, not for a whole period.
const EARLY: [Duration; 2] = [CONNECT_TIME, Duration::from_millis(50)];

/// Number of shortened rounds after the first of an unplanned leadership.
pub const EARLY_ROUNDS: usize = EARLY.len();

/// Number of report intervals after which a silent vehicle stops counting as live.
const LIVE_INTERVALS: u32 = 3;

/// Time for which a silent vehicle is remembered. Reports that come less often do not hold up
/// rounds.
const REMEMBERED: Duration = Duration::from_secs(3);

/// Maximum number of rounds in a period. The first rounds of a leadership are exempt, and so are the
/// rounds that immediately follow with the reports of vehicles that were due. They are few, because
/// a vehicle is not due again for half a period.
const MAX_RATE: u32 = 5;

/// Least part of a period between two rounds that one vehicle closes early. It is less than a period,
/// so that reports come in time despite jitter, and at slightly more than one per period.
const VEHICLE_PACE: f64 = 0.8;

/// Inverse share of a period by which the end of a round is delayed after its first report.
const DELAY_DIVISOR: u32 = 10;

/// Inverse share of its interval after which the next report of a vehicle is due.
const DUE_DIVISOR: u32 = 2;

impl RoundTrigger {
    /// Starts counting at `now`.
    pub fn new(config: RoundConfig, now: Timestamp) -> Self {
        Self {
            last_close: now,
            first_report: None,
            round_early_from: None,
            reported: BTreeMap::new(),
            paced_from: BTreeMap::new(),
            live: Default::default(),
            missing: 0,
            due: 0,
            length: config.period(),
            held: false,
            early: EARLY.len(),
            config,
        }
    }

    /// Applies another interval; the current round lasts no longer than the old and the new
    /// interval.
    pub(super) fn configure(&mut self, config: RoundConfig) {
        self.length = self.length.min(config.period());
        self.config = config;
    }

    /// Processes a report; returns true if it closes the round as the last missing one. Only
    /// [`Self::tick`] closes a round whose period is over, so that the round includes all reports
    /// that arrive at its end.
    pub fn report(&mut self, kind: ReportKind, node: &NodeName, now: Timestamp) -> bool {
        self.first_report.get_or_insert(now);
        let early_from = self.record_pace(node.vehicle(), now);
        let live = &mut self.live[kind as usize];
        let mut was_last_due = false;
        if let Some(vehicle) = live.get_mut(node) {
            vehicle.record(now);
            self.missing -= usize::from(std::mem::take(&mut vehicle.is_awaited));
            if std::mem::take(&mut vehicle.due) {
                self.due -= 1;
                was_last_due = self.due == 0;
            }
        } else {
            live.insert(node.clone(), Reporter::new(now));
        }
        if was_last_due
            && !self.held
            && now.since(self.last_close) < self.config.period() / MAX_RATE
            && now >= early_from
        {
            self.close(now);
            return true;
        }
        self.missing == 0 && self.tick(now)
    }

    /// Records a report of a vehicle or its part; returns the time from which on the report may close
    /// the round early. A vehicle that reports alone has no pace.
    fn record_pace(&mut self, vehicle: NodeName, now: Timestamp) -> Timestamp {
        let pace = self.config.period().mul_f64(VEHICLE_PACE);
        let mut reporters = self.live.iter().flat_map(BTreeMap::keys);
        let has_others = reporters.any(|other| other.vehicle() != vehicle);
        let paced_from = self.paced_from.get(&vehicle).filter(|_| has_others);
        let early_from = paced_from.map_or(now, |paced_from| *paced_from + pace);
        let of_round = self.round_early_from.get_or_insert(early_from);
        *of_round = early_from.min(*of_round);
        let report = PacedReport {
            at: now,
            early_from,
        };
        self.reported.insert(vehicle, report);
        early_from
    }

    /// True when the round closes now; call it at the latest at [`Self::deadline`].
    pub fn tick(&mut self, now: Timestamp) -> bool {
        let is_due = now >= self.deadline();
        if is_due {
            self.close(now);
        }
        is_due
    }

    /// Begins the next round, whether or not the current one is due.
    pub(super) fn close(&mut self, now: Timestamp) {
        let period = self.config.period();
        // After a round that was held, another node may take over, or vehicles are still
        // connecting.
        let by_reports = self.config.close == RoundClose::WhenComplete && !self.held;
        self.missing = 0;
        self.due = 0;
        for live in &mut self.live {
            live.retain(|_, vehicle| {
                now.since(vehicle.last_report) < REMEMBERED.max(period * LIVE_INTERVALS)
            });
            for vehicle in live.values_mut() {
                self.missing += usize::from(vehicle.begin_round(now, period));
                vehicle.due = by_reports
                    && now.since(vehicle.last_report) > vehicle.interval(period) / DUE_DIVISOR;
                self.due += usize::from(vehicle.due);
            }
        }
        for (vehicle, report) in std::mem::take(&mut self.reported) {
            let has_closed = report.early_from <= now;
            let paced_from = if has_closed {
                report.at.max(report.early_from)
            } else {
                report.at
            };
            self.paced_from.insert(vehicle, paced_from);
        }
        self.paced_from
            .retain(|_, paced_from| now.since(*paced_from) < period);
        self.last_close = now;
        self.first_report = None;
        self.round_early_from = None;
        self.held = self.early < EARLY.len();
        self.length = EARLY
            .get(self.early)
            .map_or(period, |&length| length.min(period));
        self.early += usize::from(self.held);
    }

    /// Starts the rounds of a leadership.
    pub fn start(&mut self, first: FirstRound, now: Timestamp) {
        let period = self.config.period();
        self.length = match first {
            FirstRound::InStep => return,
            FirstRound::OnTime => period,
            FirstRound::Overdue => Duration::ZERO,
            FirstRound::AfterConnects => CONNECT_TIME.min(period),
        };
        self.last_close = now;
        self.held = first != FirstRound::OnTime;
        self.early = if self.held { 0 } else { EARLY.len() };
    }

    /// Lets the current round last its whole length, even if all have reported.
    pub fn hold(&mut self) {
        self.held = true;
    }

    /// When the round closes without a further report.
    pub fn deadline(&self) -> Timestamp {
        let period = self.config.period();
        let end = self.last_close + self.length;
        if self.config.close == RoundClose::Periodic || self.held {
            return end;
        }
        match (self.round_early_from, self.first_report) {
            (Some(early_from), _) if self.missing == 0 => {
                early_from.max(self.last_close + period / MAX_RATE).min(end)
            }
            (_, Some(first)) => end
                .max(first + period / DELAY_DIVISOR)
                .min(end + period / DELAY_DIVISOR),
            (_, None) => end,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::ReportKind::{Detections, VoteDetections};

    const MS: u64 = 1_000;

    fn at(ms: u64) -> Timestamp {
        Timestamp(1_000_000_000 + ms * MS)
    }

    fn node(name: &str) -> NodeName {
        NodeName::new(name).unwrap()
    }

    fn trigger(close: RoundClose) -> RoundTrigger {
        RoundTrigger::new(
            RoundConfig {
                close,
                ..RoundConfig::default()
            },
            at(0),
        )
    }

    #[test]
    fn closes_with_last_live_vehicle() {
        let mut rounds = trigger(RoundClose::WhenComplete);
        assert!(!rounds.report(Detections, &node("a"), at(10)));
        assert!(
            rounds.report(Detections, &node("b"), at(20)),
            "both expected vehicles have reported, a fifth of the period is over"
        );
        assert!(!rounds.report(Detections, &node("a"), at(110)));
        assert!(rounds.report(Detections, &node("b"), at(115)));
    }

    #[test]
    fn both_report_kinds_are_awaited() {
        let mut rounds = trigger(RoundClose::WhenComplete);
        rounds.report(Detections, &node("a"), at(10));
        rounds.report(VoteDetections, &node("a"), at(11));
        assert!(rounds.tick(at(20)));
        assert!(
            !rounds.report(Detections, &node("a"), at(110)),
            "its vote is on the way"
        );
        assert!(rounds.report(VoteDetections, &node("a"), at(111)));
    }

    #[test]
    fn first_round_follows_mode() {
        let mut rounds = trigger(RoundClose::WhenComplete);
        rounds.start(FirstRound::InStep, at(50));
        assert_eq!(rounds.deadline(), at(100));
        rounds.start(FirstRound::OnTime, at(50));
        assert_eq!(rounds.deadline(), at(150));
        rounds.start(FirstRound::Overdue, at(50));
        assert!(rounds.tick(at(50)));
    }

    #[test]
    fn late_connection_waits_no_period() {
        for (first, expected) in [
            (FirstRound::Overdue, [50, 75, 125, 225, 325]),
            (FirstRound::AfterConnects, [75, 100, 150, 250, 350]),
        ] {
            for close in [RoundClose::WhenComplete, RoundClose::Periodic] {
                let mut rounds = trigger(close);
                rounds.start(first, at(50));
                let closes = expected.map(|_| {
                    let deadline = rounds.deadline();
                    assert!(
                        !rounds.tick(deadline - Duration::from_millis(1)) && rounds.tick(deadline)
                    );
                    deadline
                });
                assert_eq!(closes, expected.map(at), "{first:?}, {close:?}");
            }
        }
    }

    #[test]
    fn period_bounds_wait() {
        let mut rounds = trigger(RoundClose::WhenComplete);
        rounds.report(Detections, &node("a"), at(1));
        rounds.report(Detections, &node("b"), at(2));
        assert!(rounds.tick(at(20)));
        assert!(!rounds.report(Detections, &node("a"), at(100)));
        assert_eq!(rounds.deadline(), at(120));
        assert!(rounds.tick(at(120)));
    }

    #[test]
    fn departed_vehicle_is_not_awaited() {
        let mut rounds = trigger(RoundClose::WhenComplete);
        rounds.report(Detections, &node("gone"), at(0));
        for round in 1..=4 {
            rounds.report(Detections, &node("a"), at(round * 100));
            rounds.tick(at(round * 100 + 99));
        }
        assert!(
            rounds.report(Detections, &node("a"), at(600)),
            "closes without the vehicle that left"
        );
    }

    /// Two reports a second of each of seven cameras, which capture together.
    #[test]
    fn slow_cameras_share_round() {
        let mut rounds = trigger(RoundClose::WhenComplete);
        for frame in 1..8 {
            let capture = at(frame * 500);
            let mut between = 0;
            while rounds.deadline() < capture {
                assert!(rounds.tick(rounds.deadline()));
                between += 1;
            }
            assert!(between < 5, "{between} rounds before frame {frame}");
            let names = ["a", "b", "c", "d", "e", "f", "g"];
            let closed: Vec<_> = names
                .iter()
                .filter(|name| rounds.report(Detections, &node(name), capture))
                .collect();
            assert!(
                frame < 4 || closed == [&"g"],
                "frame {frame}: a round after {closed:?}"
            );
        }
    }

    #[test]
    fn slow_vehicle_delays_few_rounds() {
        let mut rounds = trigger(RoundClose::WhenComplete);
        let mut slow = 0;
        for ms in (1..5000).step_by(100) {
            while rounds.deadline() < at(ms) {
                assert!(rounds.tick(rounds.deadline()));
            }
            if ms % 1000 == 1 {
                rounds.report(Detections, &node("slow"), at(ms));
                slow = ms;
            }
            rounds.report(Detections, &node("a"), at(ms));
            let closed = rounds.report(Detections, &node("b"), at(ms + 1));
            assert!(
                ms < 2000 || closed || ms - slow >= 900,
                "open at {ms}, {} after the slow one",
                ms - slow
            );
        }
    }

    #[test]
    fn periodic_reports_are_awaited() {
        let mut rounds = trigger(RoundClose::WhenComplete);
        for name in ["a", "b"] {
            rounds.report(Detections, &node(name), at(1));
        }
        assert!(rounds.tick(at(20)));
        assert!(!rounds.report(Detections, &node("a"), at(118)));
        assert!(!rounds.tick(at(120)), "b is on its way");
        assert!(rounds.report(Detections, &node("b"), at(123)));
        assert!(!rounds.report(Detections, &node("a"), at(220)));
        assert!(rounds.tick(at(230)), "but not for long");
    }

    #[test]
    fn vehicles_left_out_get_extra_round() {
        let mut rounds = trigger(RoundClose::WhenComplete);
        for name in ["a", "b", "c"] {
            rounds.report(Detections, &node(name), at(1));
        }
        assert!(rounds.tick(at(20)));
        rounds.report(Detections, &node("a"), at(100));
        assert!(rounds.tick(at(120)), "without b and c");
        assert!(!rounds.report(Detections, &node("b"), at(125)));
        assert!(
            rounds.report(Detections, &node("c"), at(126)),
            "as soon as both are there"
        );
        for name in ["a", "b"] {
            assert!(
                !rounds.report(Detections, &node(name), at(200)),
                "all are waited for again"
            );
        }
        assert!(rounds.tick(at(226)), "without c");
        assert!(
            !rounds.report(Detections, &node("c"), at(290)),
            "too late: it counts for the next"
        );
    }

    #[test]
    fn round_end_moves_after_reports() {
        let mut rounds = trigger(RoundClose::WhenComplete);
        // The first vehicle is alone when it reports, and completes its round at once.
        assert!(rounds.report(Detections, &node("a"), at(50)));
        for (name, ms) in [("b", 51), ("c", 52)] {
            assert!(!rounds.report(Detections, &node(name), at(ms)));
        }
        let mut closed = Vec::new();
        for begin in [150, 250, 350] {
            for (name, ms) in [("a", begin), ("b", begin + 1), ("c", begin + 2)] {
                if rounds.report(Detections, &node(name), at(ms)) {
                    closed.push(ms);
                }
            }
        }
        assert_eq!(closed, [150, 152, 252, 352]);
    }

    #[test]
    fn periodic_rounds_ignore_completeness() {
        let mut rounds = trigger(RoundClose::Periodic);
        assert!(!rounds.report(Detections, &node("a"), at(50)));
        assert!(!rounds.tick(at(99)));
        assert!(rounds.tick(at(100)));
    }

    #[test]
    fn fast_vehicle_sets_no_rate() {
        let mut rounds = trigger(RoundClose::WhenComplete);
        let closed = (0..1000)
            .filter(|ms| rounds.report(Detections, &node("a"), at(*ms)))
            .count();
        assert!(
            (45..=50).contains(&closed),
            "{closed} rounds in a second at a period of 100 ms"
        );
    }

    /// Rounds in five seconds in a cell whose three cameras report twice a second, while the parts
    /// of another vehicle report in turn every `every_ms`.
    fn rounds_beside(parts: u64, every_ms: u64) -> usize {
        let mut rounds = trigger(RoundClose::WhenComplete);
        let mut closed = 0;
        for ms in 0..5000 {
            closed += usize::from(rounds.tick(at(ms)));
            for (camera, phase) in [("a", 7), ("b", 9), ("c", 12)] {
                if ms % 500 == phase {
                    closed += usize::from(rounds.report(Detections, &node(camera), at(ms)));
                }
            }
            if ms.is_multiple_of(every_ms) {
                let part = node(&format!("m--{}", ms / every_ms % parts));
                closed += usize::from(rounds.report(Detections, &part, at(ms)));
            }
        }
        closed
    }

    #[test]
    fn fast_vehicle_adds_few_rounds() {
        for parts in [1, 2, 16] {
            for every_ms in 1..100 {
                let closed = rounds_beside(parts, every_ms);
                assert!(
                    closed <= 5000 / 80 + 3 * 5000 / 500,
                    "{closed} rounds with {parts} parts that report every {every_ms} ms"
                );
            }
        }
    }

    /// Reports that come up to 11 times a second, also at jittered times, are fused at once.
    #[test]
    fn jittered_reports_are_not_delayed() {
        for jitter_ms in [[0, 0, 0, 0], [9, 0, 5, 1], [0, 10, 0, 10]] {
            for every_ms in [92, 95, 100, 105] {
                let mut rounds = trigger(RoundClose::WhenComplete);
                let mut open = 0;
                for frame in 3..60 {
                    let begin = frame * every_ms + jitter_ms[frame as usize % 4];
                    while rounds.deadline() < at(begin) {
                        assert!(rounds.tick(rounds.deadline()));
                    }
                    rounds.report(Detections, &node("a"), at(begin));
                    let closed = rounds.report(Detections, &node("b"), at(begin + 1));
                    open += u64::from(frame > 10 && !closed);
                }
                assert!(open <= 1, "{open} at {every_ms} ms, {jitter_ms:?}");
            }
        }
    }

    #[test]
    fn held_round_lasts_full_period() {
        let start = Timestamp(1_000_000);
        let mut rounds = RoundTrigger::new(RoundConfig::default(), start);
        let euclid = NodeName::from_static("euclid");
        let at = |ms: u64| Timestamp(1_000_000 + ms * 1000);
        assert!(!rounds.report(ReportKind::Detections, &euclid, at(5)));
        rounds.hold();
        assert!(!rounds.tick(at(99)));
        assert!(rounds.tick(at(100)));
        assert!(!rounds.report(ReportKind::Detections, &euclid, at(105)));
        assert!(rounds.tick(at(120)), "only that one was held");
    }
}
