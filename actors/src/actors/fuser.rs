//! The actor that closes the rounds: reports in, maps and verdicts out while the node leads.
//!
//! ```text
//! Gateway ── reports ──> LatestReportQueue ──> Fuser ── PublishMap, PublishVerdicts ──> Gateway
//! Gateway ── HandleReports ────────> │ ▲
//! Follower ── HandleMap ───────────> │ │
//! Uplink ── HandleNeighbours ──────> │ │
//! LeaderElection ── Lead, … ───────> │ │ └── Record ──> ReputationKeeper
//! ReputationKeeper ── Adopt, … ──> └─┘ CloseRound, at the aggregator's deadline
//! ```

use crate::messages::fuser::FuserMessage;

mod report_queue;
#[cfg(test)]
mod tests;

use std::sync::Arc;
use std::time::Duration;

use ecod::aggregator::round::FirstRound;
use ecod::aggregator::{Aggregator, Command, Fused, ReportDoubt};
use ecod::diagnostics::TroubleKind;
use ecod::leadership::timers::MAX_ADOPTED_MAP_AGE;
use ecod::model::epoch::Epoch;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::replay::{JournalEvent, TimeUnit};
use ecod::tracking::TracksLosses;
use ecod::wire::{FusedObject, GlobalMap, InvalidEntry, ObjectReport, RejectReason, ReportKind};
use ractor::{Actor, ActorProcessingErr, ActorRef};
use tokio::task::AbortHandle;

pub use report_queue::{LatestReportQueue, PushOutcome, QueuedReport};

use crate::messages::actor_slot::ActorSlot;
use crate::messages::gateway::GatewayMessage;
use crate::messages::reputation_keeper::ReputationKeeperMessage;
use crate::observe::recorder::{LogItem, LogSender};
use crate::platform::cell_clock::CellClock;
use crate::platform::clock;
use crate::telemetry::counters::{Counters, Event};
use crate::telemetry::spans::{RoundReports, Spans};
use crate::transport::mqtt::Delivery;

/// Arguments of a fuser's start.
pub struct FuserArguments {
    /// The aggregator it drives.
    pub aggregator: Aggregator,
    /// Where vehicles' reports wait.
    pub report_queue: LatestReportQueue,
    /// The newest map of the cell and its time of receipt. It may be this node's own map, made by
    /// an earlier run of the actor.
    pub newest: Option<(Arc<GlobalMap>, Timestamp)>,
    /// Records the aggregator's inputs.
    pub recording: LogSender,
    /// The cell's time, in which rounds are dated.
    pub clock: CellClock,
    /// Where maps and verdicts are published.
    pub gateway: ActorSlot<GatewayMessage>,
    /// Receives the evidence of rounds about vehicles.
    pub keeper: ActorSlot<ReputationKeeperMessage>,
    /// Counters of the node, shared by its actors.
    pub counters: Arc<Counters>,
    /// Tracing spans of the node, shared by its actors.
    pub spans: Spans,
}

/// Drives an [`Aggregator`] with the clock and the gateway.
#[derive(Debug, Default)]
pub struct Fuser;

/// The aggregator and its alarm.
pub struct FuserState {
    aggregator: Aggregator,
    report_queue: LatestReportQueue,
    recording: LogSender,
    clock: CellClock,
    /// The cell's time as last set in the aggregator.
    cell_offset_us: i64,
    gateway: ActorSlot<GatewayMessage>,
    keeper: ActorSlot<ReputationKeeperMessage>,
    counters: Arc<Counters>,
    /// The newest map of another aggregator or an earlier run, and its time of receipt.
    last_map: Option<(Arc<GlobalMap>, Timestamp)>,
    alarm: Timestamp,
    timer: Option<AbortHandle>,
    /// Losses of the aggregator that have been counted already.
    losses: [u64; 4],
    spans: Spans,
    /// Reports of the current round, while their spans are recorded.
    reports: RoundReports,
}

impl Actor for Fuser {
    type Msg = FuserMessage;
    type State = FuserState;
    type Arguments = FuserArguments;

    async fn pre_start(
        &self,
        myself: ActorRef<Self::Msg>,
        arguments: Self::Arguments,
    ) -> Result<Self::State, ActorProcessingErr> {
        let mut state = FuserState::new(arguments);
        state.set_alarm(&myself);
        Ok(state)
    }

    async fn handle(
        &self,
        myself: ActorRef<Self::Msg>,
        message: Self::Msg,
        state: &mut Self::State,
    ) -> Result<(), ActorProcessingErr> {
        state.follow_clock();
        match message {
            FuserMessage::HandleReports => state.drain_reports(),
            FuserMessage::HandleMap { map, received_at } => state.on_map(map, received_at),
            FuserMessage::Expel { node } => state.expel(&node),
            FuserMessage::CloseRound => {
                state.counters.count(Event::RoundDue);
                state.alarm = Timestamp(u64::MAX);
                // Drains the queue: after a restart it may contain reports whose notification the
                // former run consumed.
                state.drain_reports();
                state.tick();
            }
            FuserMessage::Lead {
                epoch,
                first_round,
                first,
            } => state.lead(epoch, first_round, first),
            FuserMessage::HoldRound => {
                state.command(Command::Hold);
                state.alarm = Timestamp(u64::MAX);
            }
            FuserMessage::StopPublishing => {
                state.command(Command::StepDown);
                state.keeper.send(ReputationKeeperMessage::StepDown);
            }
            FuserMessage::Configure { fusion, landmarks } => {
                state.command(Command::Configure { fusion, landmarks });
            }
            FuserMessage::HandleNeighbours { objects, stated_at } => {
                state.command(Command::OnNeighbours { objects, stated_at });
            }
            FuserMessage::Adopt { ledger } => state.command(Command::Adopt { ledger }),
            FuserMessage::Resume { reputations } => state.command(Command::Resume { reputations }),
            FuserMessage::Timeliness { reply } => {
                if reply
                    .send(state.aggregator.timeliness(clock::now()))
                    .is_err()
                {
                    tracing::debug!("caller did not wait for the timeliness of reports");
                }
            }
        }
        state.count_losses();
        state.set_alarm(&myself);
        Ok(())
    }
}

/// A trouble is shown if reports are refused as untimely for this long; a stalled link only affects
/// one or two reports.
const MIN_UNTIMELY: Duration = Duration::from_millis(500);

/// Lead or delay of an accepted report, in microseconds, from which its sender's clock must be
/// wrong: far more than the transit time of reports.
const MAX_UNNOTED_LEAD_US: i64 = 1_500_000;

/// Remedy for late reports of a node that dates them in the cell's time: its clock is not the cause.
const LATE_REMEDY: &str = "its detector or the link to it is slow: see that node's own troubles, or raise `fusion.window.max_age_s`";

/// Remedy where times seem to be in another unit.
const OTHER_UNIT_REMEDY: &str = "correct the program that sends them, or set its clock: `captured_at_us` counts microseconds since 1970";

/// The lead of a report's time as text.
fn lead_in_words(report: &ObjectReport, lead_us: i64) -> String {
    if let Some(unit) = TimeUnit::of(report.captured_at_us) {
        return format!(
            "its `captured_at_us` looks like {unit} instead of microseconds, or its clock was never set"
        );
    }
    let seconds = lead_us.unsigned_abs() as f64 / 1e6;
    let lead = if seconds < DAY_S {
        format!("{seconds:.1} s")
    } else {
        format!("{:.0} days", seconds / DAY_S)
    };
    match lead_us {
        0.. => format!("its clock is {lead} ahead"),
        _ if report.clock_error_us.is_some() => {
            format!("its reports arrive {lead} after the capture")
        }
        _ => format!("its clock is {lead} behind, or its reports take that long"),
    }
}

/// A day in seconds.
const DAY_S: f64 = 86_400.0;

impl FuserState {
    fn new(arguments: FuserArguments) -> Self {
        let FuserArguments {
            aggregator,
            report_queue,
            newest,
            recording,
            clock,
            gateway,
            keeper,
            counters,
            spans,
        } = arguments;
        Self {
            aggregator,
            report_queue,
            recording,
            clock,
            cell_offset_us: 0,
            gateway,
            keeper,
            counters,
            last_map: newest,
            alarm: Timestamp(u64::MAX),
            timer: None,
            losses: [0; 4],
            spans,
            reports: RoundReports::default(),
        }
    }

    /// Updates the aggregator when the cell's time has moved.
    fn follow_clock(&mut self) {
        let offset_us = self.clock.reading().offset_us;
        if std::mem::replace(&mut self.cell_offset_us, offset_us) != offset_us {
            self.command(Command::SetCellOffset { offset_us });
        }
    }

    /// Passes all waiting reports to the aggregator, in the order of the queue.
    fn drain_reports(&mut self) {
        for delivery in self.report_queue.drain() {
            self.on_delivery(&delivery);
        }
    }

    /// Handles one report: records it, passes it to the aggregator, and publishes the round if the
    /// report closes it. A used report is checked for doubts and for its sender's clock; another
    /// report is counted by its reason.
    ///
    /// # Example
    /// The leader waits for `euclid` and `gauss`. The report of `gauss` arrives last: the
    /// aggregator closes round 89 at once, and the map goes to the gateway before the round's
    /// deadline.
    fn on_delivery(&mut self, delivery: &Delivery<QueuedReport>) {
        let QueuedReport { kind, report } = &delivery.message;
        self.recording.send(
            delivery.received_at,
            LogItem::Report(*kind, Arc::clone(report)),
        );
        self.compare_locations(*kind, report);
        let taken = self.aggregator.report(*kind, report, delivery.received_at);
        match taken {
            Ok(fused) => {
                self.check_clock(report, delivery.received_at);
                self.report_doubts(*kind, report, delivery.received_at);
                if self.aggregator.leads().is_some() {
                    self.spans
                        .record(report, delivery.received_at, &mut self.reports);
                }
                self.publish(fused, delivery.received_at);
            }
            Err(reason) => {
                tracing::debug!(node = %report.node, seq = report.seq, ?kind, %reason, "report not used");
                self.record_rejection(reason, *kind, report, delivery.received_at);
            }
        }
    }

    /// Counts a report that was not used. Reports that are repeatedly refused because of their time
    /// are a trouble.
    fn record_rejection(
        &self,
        reason: RejectReason,
        kind: ReportKind,
        report: &ObjectReport,
        received_at: Timestamp,
    ) {
        let node = report.node.as_str();
        match reason {
            RejectReason::FromTheFuture | RejectReason::Stale => {
                self.counters.count_reject(reason, node);
                if self
                    .aggregator
                    .untimely_for(kind, &report.node, received_at)
                    >= MIN_UNTIMELY
                {
                    let cause = format!(
                        "refused, {}",
                        lead_in_words(report, self.lead_us(report, received_at))
                    );
                    self.counters
                        .troubles()
                        .settle(TroubleKind::ClockOff, Some(node));
                    let is_in_microseconds = TimeUnit::of(report.captured_at_us).is_none();
                    let remedy = if !is_in_microseconds {
                        OTHER_UNIT_REMEDY
                    } else if reason == RejectReason::Stale && report.clock_error_us.is_some() {
                        LATE_REMEDY
                    } else {
                        TroubleKind::Untimely.remedy()
                    };
                    self.counters.troubles().record_with_remedy(
                        Some(node),
                        TroubleKind::Untimely,
                        &cause,
                        remedy,
                    );
                }
            }
            RejectReason::NotFused => self.counters.reject_report(reason, node, || {
                "its reports are for an algorithm that the cell does not run".into()
            }),
            _ => self.counters.reject_report(reason, node, || {
                format!("reports rejected: {}", reason.in_words())
            }),
        }
    }

    /// Records a trouble if a sender's clock is wrong although its reports are corrected.
    fn check_clock(&self, report: &ObjectReport, received_at: Timestamp) {
        let lead_us = self.lead_us(report, received_at);
        if report.clock_error_us.is_none() && lead_us.saturating_abs() > MAX_UNNOTED_LEAD_US {
            let cause = format!(
                "{}; its reports are corrected for this",
                lead_in_words(report, lead_us)
            );
            let node = report.node.as_str();
            self.counters
                .troubles()
                .settle(TroubleKind::Untimely, Some(node));
            self.counters
                .troubles()
                .record_about(node, TroubleKind::ClockOff, &cause);
        }
    }

    /// Records doubts about a report that was used.
    fn report_doubts(&self, kind: ReportKind, report: &ObjectReport, received_at: Timestamp) {
        for doubt in self.aggregator.doubts(kind, report, received_at) {
            let trouble = match doubt {
                ReportDoubt::FarObject { .. }
                | ReportDoubt::NoObjectAtLocation
                | ReportDoubt::Moves => TroubleKind::Misplaced,
                ReportDoubt::Misread(_) => TroubleKind::Orientation,
                ReportDoubt::SharedName => TroubleKind::NameTaken,
            };
            self.counters.troubles().record_about(
                report.node.as_str(),
                trouble,
                &doubt.to_string(),
            );
        }
    }

    /// Lead of a report's time of capture over the cell's time of its receipt, in microseconds.
    fn lead_us(&self, report: &ObjectReport, received_at: Timestamp) -> i64 {
        report
            .captured_at_us
            .micros_from(self.clock.date(received_at))
    }

    /// Compares a location that a report names with the configured landmarks; each call checks
    /// another location of the report.
    fn compare_locations(&self, kind: ReportKind, report: &ObjectReport) {
        let objects = report
            .objects
            .iter()
            .filter_map(|object| object.landmark.as_ref());
        let mut named = objects.chain(report.seen.iter().flatten());
        let next = (report.seq as usize).checked_rem(named.clone().count());
        let Some(id) = next.and_then(|place| named.nth(place)) else {
            return;
        };
        let node = report.node.as_str();
        let troubles = self.counters.troubles();
        match self.aggregator.has_location(id) {
            Some(true) => {}
            Some(false) => {
                let cause = format!("names the location “{id}”, which this node does not have");
                troubles.record_about(node, TroubleKind::UnknownLocation, &cause);
            }
            // Votes name locations themselves where no list is configured.
            None if kind == ReportKind::VoteDetections => {}
            None => {
                let cause =
                    format!("{node} names known locations, such as “{id}”, and this node has none");
                troubles.record(TroubleKind::NoLocations, &cause);
            }
        }
    }

    /// Stores the map that was accepted last, to continue from it when this node leads.
    fn on_map(&mut self, map: Arc<GlobalMap>, received_at: Timestamp) {
        if self.aggregator.leads().is_none() {
            self.last_map = Some((map, received_at));
        }
    }

    /// Removes what only an expelled node has reported, as itself or as a part.
    fn expel(&mut self, node: &NodeName) {
        let vehicle = node.vehicle();
        self.last_map = self
            .last_map
            .take()
            .filter(|(map, _)| map.aggregator != *node);
        if let Some((map, _)) = &mut self.last_map {
            let is_void =
                |object: &FusedObject| object.contributors == std::slice::from_ref(&vehicle);
            Arc::make_mut(map).objects.retain(|object| !is_void(object));
        }
        self.command(Command::Expel { vehicle });
    }

    /// Starts the leadership: the keeper gets the epoch and the last round, the aggregator takes
    /// over the identities of a recent map of the previous leader, and a round that is already due
    /// is closed.
    fn lead(&mut self, epoch: Epoch, first_round: u64, first: FirstRound) {
        self.reports = RoundReports::default();
        self.keeper.send(ReputationKeeperMessage::Lead {
            epoch: epoch.clone(),
            last_round: first_round.saturating_sub(1),
        });
        if let Some((map, received_at)) = self.last_map.take()
            && clock::now().since(received_at) < MAX_ADOPTED_MAP_AGE
        {
            self.command(Command::AdoptMap { map, received_at });
        }
        self.command(Command::Lead {
            epoch,
            first_round,
            first,
        });
        self.tick();
    }

    /// Handles the alarm and a new leadership: closes the round if its deadline has passed, publishes
    /// the results while leading, and records the tick. Before the deadline it has no effect.
    fn tick(&mut self) {
        self.command(Command::Tick);
    }

    /// Passes a command to the aggregator and records it. A tick that is not due is not recorded.
    fn command(&mut self, command: Command) {
        let now = clock::now();
        if command != Command::Tick || now >= self.aggregator.deadline() {
            let fused = self.aggregator.command(&command, now);
            self.recording
                .send(now, LogItem::Journal(JournalEvent::Command(command)));
            self.publish(fused, now);
        }
    }

    /// Counts the aggregator's losses since the last call.
    fn count_losses(&mut self) {
        let TracksLosses { late, refused } = self.aggregator.tracks_losses();
        let now = [
            (Event::VoteIgnored, self.aggregator.ignored_votes()),
            (Event::ReportOvertaken, self.aggregator.overtaken()),
            (Event::ReportLate, late),
            (Event::ObjectRefused, refused),
        ];
        for ((event, total), counted) in now.into_iter().zip(&mut self.losses) {
            self.counters.add(event, total.saturating_sub(*counted));
            *counted = total;
        }
    }

    /// Publishes a closed round: the map and the verdicts go to the gateway, the evidence and the
    /// reputations to the keeper. Entries that were left out are counted first. `None` has no
    /// effect.
    fn publish(&mut self, fused: Option<Fused>, now: Timestamp) {
        let Some(fused) = fused else { return };
        let _round = self
            .spans
            .round(&fused, &std::mem::take(&mut self.reports))
            .entered();
        let Fused {
            epoch,
            round,
            map,
            verdicts,
            evidence,
            reputations,
            left_out,
        } = fused;
        self.report_left_out(&left_out);
        self.recording.send(now, LogItem::Round(round));
        let has_verdicts = verdicts.is_some();
        if let Some(map) = map {
            self.gateway
                .send(GatewayMessage::PublishMap { map: Arc::new(map) });
        }
        if let Some(verdicts) = verdicts {
            self.gateway.send(GatewayMessage::PublishVerdicts {
                verdicts: Arc::new(verdicts),
            });
        }
        if has_verdicts || !evidence.is_empty() {
            self.keeper.send(ReputationKeeperMessage::Record {
                epoch,
                round,
                evidence,
                reputations,
            });
        }
    }

    /// Counts entries that this node left out of its map or verdicts, by the vehicles whose
    /// statements are in them.
    fn report_left_out(&self, left_out: &[InvalidEntry]) {
        for InvalidEntry {
            reason,
            contributors,
        } in left_out
        {
            self.counters.count(Event::EntryLeftOut);
            let kind = if *reason == RejectReason::TooManyObjects {
                TroubleKind::Overload
            } else {
                TroubleKind::Misplaced
            };
            for vehicle in contributors {
                let troubles = self.counters.troubles();
                troubles.record_about_with(vehicle.as_str(), kind, || match kind {
                    TroubleKind::Overload => {
                        "the map leaves out objects that only it reports: it has more than its share"
                            .to_owned()
                    }
                    _ => format!(
                        "the map leaves out an object of its reports, which would be out of bounds: {}",
                        reason.in_words()
                    ),
                });
            }
        }
    }

    /// Sets the alarm for the deadline. An existing alarm is replaced only if the deadline has
    /// become earlier; an early alarm closes no round and is set again.
    fn set_alarm(&mut self, myself: &ActorRef<FuserMessage>) {
        let deadline = self.aggregator.deadline();
        if deadline < self.alarm {
            self.alarm = deadline;
            let timer =
                myself.send_after(deadline.since(clock::now()), || FuserMessage::CloseRound);
            if let Some(superseded) = self.timer.replace(timer.abort_handle()) {
                superseded.abort();
            }
        }
    }
}
