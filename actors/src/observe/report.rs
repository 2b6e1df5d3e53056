//! Report about a log as one HTML page, in the cell's time: map and timeline, leadership, latency
//! and gaps of rounds, reputations, coverage, losses.
//!
//! Call [`Report::file`] with every file of a node's log in order, then [`Report::page`]. A
//! [`Section`] adds to the page.

mod losses;
mod page;
mod plot;
mod series;
mod timeline;

use std::collections::BTreeMap;
use std::fmt::Debug;
use std::path::Path;

use ecod::model::epoch::Epoch;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::replay::FusedLine;
use ecod::wire::{GlobalMap, ObjectReport, ReportKind, Reputations, Verdicts};

pub use page::{drawing, section, table};
pub use plot::bars;

use crate::observe::recorder::{
    CounterReading, LeadershipChange, LogError, LogEvent, LogIdentity, LogMessage, LogReader,
    SchemaName,
};
use losses::Losses;
use series::Samples;
use timeline::{GAP, LogTimeline, RecordedPicture, cell_offset_us};

/// Additional section of the page, made from the messages of the log in their order.
pub trait Section: Debug {
    /// Processes the identity at the beginning of a file.
    fn identity(&mut self, identity: &LogIdentity);

    /// Processes a vehicle's report.
    fn report(&mut self, kind: ReportKind, report: &ObjectReport);

    /// Processes a map or verdicts.
    fn round(&mut self, round: &FusedLine);

    /// The section as HTML, made with [`section`], [`table`], [`drawing`] and [`bars`] like the
    /// others.
    fn html(&self) -> String;
}

/// Statistics of a log; empty by default.
#[derive(Debug, Default)]
pub struct Report {
    identity: Option<LogIdentity>,
    first: Option<Timestamp>,
    last: Timestamp,
    messages: u64,
    problems: Vec<String>,
    /// Topic of the camera whose pictures are shown.
    camera: Option<String>,
    maps: RoundTimes,
    verdicts: RoundTimes,
    leaders: Vec<LeaderRounds>,
    changes: Vec<LeadershipChange>,
    vehicles: BTreeMap<NodeName, VehicleStatistics>,
    entries: u64,
    reputations: BTreeMap<NodeName, Samples>,
    losses: Losses,
    timeline: LogTimeline,
    /// From the clock of the recording node to the cell's time in the current file.
    offset_us: i64,
    sections: Vec<Box<dyn Section>>,
}

/// Times of the maps or of the verdicts that the recording node accepted.
#[derive(Debug, Default)]
struct RoundTimes {
    count: u64,
    last_at: Option<Timestamp>,
    /// Seconds since the round before, over time.
    gaps: Samples,
    /// Seconds from the oldest capture to the end of the round; empty for verdicts.
    capture_to_fused: Vec<f64>,
    /// Seconds from the end of the round to its receipt.
    fused_to_received: Vec<f64>,
}

/// Consecutive rounds of one leader in one term, each less than [`GAP`] after the one before.
#[derive(Debug, Clone, PartialEq)]
struct LeaderRounds {
    epoch: Epoch,
    first_at: Timestamp,
    last_at: Timestamp,
    rounds: u64,
}

/// Reports and contributions of one vehicle.
#[derive(Debug, Default)]
struct VehicleStatistics {
    reports: u64,
    objects: u64,
    first_at: Option<Timestamp>,
    last_at: Timestamp,
    /// Map entries that its detections contributed to.
    contributed: u64,
}

impl Report {
    /// A report that begins with this section.
    #[must_use]
    pub fn with_section(section: impl Section + 'static) -> Self {
        Self {
            sections: vec![Box::new(section)],
            ..Self::default()
        }
    }

    /// Reads a file. The page lists its unusable parts.
    ///
    /// # Errors
    /// Returns [`LogError::Unreadable`] if the file cannot be read.
    pub fn file(&mut self, path: &Path) -> Result<(), LogError> {
        self.offset_us = cell_offset_us(path)?;
        let mut log = LogReader::open(path)?;
        for event in log.by_ref() {
            match event {
                Ok(LogEvent::Identity(identity)) => self.begin_file(&identity),
                Ok(LogEvent::Message(message)) => self.message(&message),
                Err(error @ LogError::Unreadable { .. }) => return Err(error),
                Err(error) => self.problems.push(error.to_string()),
            }
        }
        for (schema, messages) in log.unknown() {
            self.problems.push(format!(
                "{messages} messages are of the unknown kind {schema}"
            ));
        }
        Ok(())
    }

    /// True if the log has no message.
    pub fn is_empty(&self) -> bool {
        self.messages == 0
    }

    /// Unusable parts of the log.
    pub fn problems(&self) -> &[String] {
        &self.problems
    }

    /// The page as self-contained HTML.
    pub fn page(&self) -> String {
        page::write(self)
    }

    /// Time of the first message.
    fn start(&self) -> Timestamp {
        self.first.unwrap_or_default()
    }

    fn begin_file(&mut self, identity: &LogIdentity) {
        if let Some(known) = self.identity.replace(identity.clone())
            && known.node != identity.node
        {
            self.problems.push(format!(
                "logs of {} and {} are mixed",
                known.node, identity.node
            ));
        }
        self.timeline.identity(identity);
        self.sections
            .iter_mut()
            .for_each(|section| section.identity(identity));
    }

    fn message(&mut self, message: &LogMessage) {
        self.messages += 1;
        let at = message.at.shifted(self.offset_us);
        self.first = Some(self.first.map_or(at, |first| first.min(at)));
        self.last = self.last.max(at);
        self.timeline.advance(at);
        let is_valid = match message.schema {
            SchemaName::ObjectReport => {
                self.with(message, |report, it| report.report(&message.topic, at, &it))
            }
            SchemaName::GlobalMap => self.with(message, |report, it| report.map(at, it)),
            SchemaName::Verdicts => self.with(message, |report, it| report.verdicts(at, it)),
            SchemaName::Reputations => self.with(message, |report, it| report.reputations(at, &it)),
            SchemaName::Leadership => self.with(message, |report, it| {
                report.changes.push(LeadershipChange { at_us: at, ..it });
            }),
            SchemaName::Counters => self.with(message, |report, it| {
                report.counters(CounterReading { at_us: at, ..it });
            }),
            SchemaName::NodeStatus => {
                self.with(message, |report, it| report.timeline.status(it, at))
            }
            // Of several cameras, one is shown.
            SchemaName::CompressedImage
                if *self.camera.get_or_insert_with(|| message.topic.clone()) == message.topic =>
            {
                self.with(message, |report, it: RecordedPicture| {
                    report.timeline.picture(it, at);
                })
            }
            _ => true,
        };
        if !is_valid && self.problems.len() < MAX_PROBLEMS {
            self.problems.push(format!(
                "a message of {} cannot be read",
                message.schema.as_str()
            ));
        }
    }

    /// False if the message does not match its schema.
    fn with<T: serde::de::DeserializeOwned>(
        &mut self,
        message: &LogMessage,
        take: impl FnOnce(&mut Self, T),
    ) -> bool {
        serde_json::from_slice(&message.json)
            .map(|it| take(self, it))
            .is_ok()
    }

    fn report(&mut self, topic: &str, at: Timestamp, report: &ObjectReport) {
        let kind = if topic.starts_with("vote_") {
            ReportKind::VoteDetections
        } else {
            ReportKind::Detections
        };
        self.timeline.report(kind, report, at);
        self.sections
            .iter_mut()
            .for_each(|section| section.report(kind, report));
        let vehicle = self.vehicles.entry(report.node.clone()).or_default();
        vehicle.reports += 1;
        vehicle.objects += report.objects.len() as u64;
        vehicle.first_at = vehicle.first_at.or(Some(at));
        vehicle.last_at = at;
    }

    fn map(&mut self, at: Timestamp, map: GlobalMap) {
        self.maps
            .add(at, map.oldest_capture_us, map.fused_at_us, self.offset_us);
        self.timeline.map(&map, at);
        self.leader(at, Epoch::new(map.epoch, map.aggregator.clone()));
        let labelled = map
            .landmarks
            .iter()
            .filter(|entry| entry.label.is_some())
            .map(|entry| &entry.contributors);
        for contributors in labelled.chain(map.objects.iter().map(|object| &object.contributors)) {
            self.entries += 1;
            for node in contributors {
                self.vehicles.entry(node.clone()).or_default().contributed += 1;
            }
        }
        self.round(&FusedLine::Map(map));
    }

    fn verdicts(&mut self, at: Timestamp, verdicts: Verdicts) {
        self.verdicts
            .add(at, None, verdicts.fused_at_us, self.offset_us);
        self.timeline.verdicts(&verdicts, self.maps.count > 0, at);
        if self.maps.count == 0 {
            self.leader(at, Epoch::new(verdicts.epoch, verdicts.aggregator.clone()));
        }
        self.round(&FusedLine::Verdicts(verdicts));
    }

    fn round(&mut self, round: &FusedLine) {
        self.sections
            .iter_mut()
            .for_each(|section| section.round(round));
    }

    fn reputations(&mut self, at: Timestamp, reputations: &Reputations) {
        self.timeline.reputations(reputations, at);
        for (node, reputation) in &reputations.reputations {
            self.reputations
                .entry(node.clone())
                .or_default()
                .push(at, reputation.score);
        }
    }

    fn counters(&mut self, reading: CounterReading) {
        self.losses
            .add(self.identity.as_ref().map(|identity| identity.run), reading);
    }

    fn leader(&mut self, at: Timestamp, epoch: Epoch) {
        match self.leaders.last_mut() {
            Some(leader) if leader.epoch == epoch && at.since(leader.last_at) < GAP => {
                leader.last_at = at;
                leader.rounds += 1;
            }
            _ => self.leaders.push(LeaderRounds {
                epoch,
                first_at: at,
                last_at: at,
                rounds: 1,
            }),
        }
    }
}

/// Maximum number of unreadable messages that are listed.
const MAX_PROBLEMS: usize = 20;

impl RoundTimes {
    /// Adds a round; `offset_us` is from the recording node's clock to the cell's time, in which
    /// `at` is.
    fn add(
        &mut self,
        at: Timestamp,
        oldest_capture: Option<Timestamp>,
        fused_at: Timestamp,
        offset_us: i64,
    ) {
        self.count += 1;
        if let Some(last) = self.last_at.replace(at) {
            self.gaps.push(at, at.since(last).as_secs_f64());
        }
        self.capture_to_fused
            .extend(oldest_capture.map(|capture| fused_at.since(capture).as_secs_f64()));
        self.fused_to_received.push(
            at.shifted(offset_us.saturating_neg())
                .since(fused_at)
                .as_secs_f64(),
        );
    }
}
