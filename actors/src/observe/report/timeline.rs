//! Timeline of a log: the same view that the dashboard's page has of a live cell, in the cell's
//! time.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::wire::{
    GlobalMap, NodeState, NodeStatus, ObjectReport, ReportKind, Reputations, Verdicts,
};
use serde::de::Error;
use serde::{Deserialize, Deserializer, Serialize};

use super::LeaderRounds;
use crate::messages::newest::Received;
use crate::observe::dashboard::history::LeaderTerm;
use crate::observe::dashboard::node_monitor::MAX_REPORT_AGE;
use crate::observe::dashboard::snapshot::json;
use crate::observe::dashboard::timeline::{EventKind, ThinnedSeries, Timeline, TimelineFrame};
use crate::observe::dashboard::{LandmarkFacts, LiveState, assets};
use crate::observe::recorder::foxglove::OPTICAL_FRAME;
use crate::observe::recorder::{LogError, LogEvent, LogIdentity, LogReader, SchemaName};
use crate::transport::mqtt::Incoming;

/// Events, maps and pictures of a log; maps and pictures are thinned to bounded size.
#[derive(Debug)]
pub(super) struct LogTimeline {
    timeline: Timeline,
    pictures: ThinnedSeries,
    landmarks: Vec<LandmarkFacts>,
    vehicles: LiveState,
    statuses: BTreeMap<NodeName, NodeStatus>,
    verdicts: Option<Received<Verdicts>>,
    last_at: Option<Timestamp>,
}

/// A recorded camera image; `data` is a JPEG file in base64.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct RecordedPicture {
    #[serde(default)]
    at_us: Timestamp,
    #[serde(alias = "frame_id", deserialize_with = "reporter")]
    node: NodeName,
    data: String,
}

/// Name under which a camera reports, of the frame of its pictures; earlier versions wrote the name
/// alone.
fn reporter<'de, D: Deserializer<'de>>(frame: D) -> Result<NodeName, D::Error> {
    let frame = String::deserialize(frame)?;
    NodeName::new(frame.strip_suffix(OPTICAL_FRAME).unwrap_or(&frame)).map_err(D::Error::custom)
}

/// The part of maps and verdicts that has the cell's time.
#[derive(Debug, Deserialize)]
struct Round {
    fused_at_us: Timestamp,
}

/// Silence of a log, or of a leader, over which no band is drawn.
pub(super) const GAP: Duration = Duration::from_secs(10);

/// Difference of a clock to the cell's time below which it is the latency of rounds.
const MIN_OFFSET_US: u64 = 1_000_000;

impl Default for LogTimeline {
    fn default() -> Self {
        Self {
            timeline: Timeline::new(Duration::MAX, Duration::ZERO),
            pictures: ThinnedSeries::new(Duration::MAX, Duration::ZERO),
            landmarks: Vec::new(),
            vehicles: LiveState::default(),
            statuses: BTreeMap::new(),
            verdicts: None,
            last_at: None,
        }
    }
}

/// Microseconds from the recording node's clock to the cell's time, by the first round in a file.
///
/// # Errors
/// Returns [`LogError::Unreadable`].
pub(super) fn cell_offset_us(path: &Path) -> Result<i64, LogError> {
    let mut offsets = LogReader::open(path)?.filter_map(|event| match event {
        Ok(LogEvent::Message(it))
            if matches!(it.schema, SchemaName::GlobalMap | SchemaName::Verdicts) =>
        {
            serde_json::from_slice::<Round>(&it.json)
                .ok()
                .map(|round| round.fused_at_us.micros_from(it.at))
        }
        _ => None,
    });
    Ok(offsets
        .next()
        .filter(|offset| offset.unsigned_abs() >= MIN_OFFSET_US)
        .unwrap_or_default())
}

impl LogTimeline {
    /// Processes the identity at the beginning of a file.
    pub(super) fn identity(&mut self, identity: &LogIdentity) {
        self.landmarks = identity.landmarks.iter().map(LandmarkFacts::from).collect();
    }

    /// Processes the time of the next message.
    pub(super) fn advance(&mut self, now: Timestamp) {
        let before = self.last_at.replace(now);
        if let Some(silence) = before
            .map(|before| now.since(before))
            .filter(|silence| *silence >= GAP)
        {
            let text = format!("the log has nothing of the {} s before", silence.as_secs());
            self.timeline.event(EventKind::Gap, text, now);
        }
    }

    /// Processes a vehicle's report.
    pub(super) fn report(&mut self, kind: ReportKind, report: &ObjectReport, now: Timestamp) {
        self.vehicles.update(
            &Incoming::Report {
                kind,
                report: Arc::new(report.clone()),
            },
            now,
        );
    }

    /// Processes a node's status.
    pub(super) fn status(&mut self, status: NodeStatus, now: Timestamp) {
        self.statuses.insert(status.node.clone(), status);
        let alive = || {
            self.statuses
                .values()
                .filter(|status| status.state != NodeState::Offline)
        };
        self.timeline
            .nodes(alive().map(|status| status.node.clone()).collect(), now);
        let troubles = alive().flat_map(|status| {
            status
                .troubles
                .iter()
                .map(|trouble| (&status.node, trouble))
        });
        self.timeline.troubles(troubles, now);
    }

    pub(super) fn reputations(&mut self, reputations: &Reputations, now: Timestamp) {
        self.timeline.reputations(reputations, now);
    }

    pub(super) fn map(&mut self, map: &GlobalMap, now: Timestamp) {
        self.frame(Some(map), now);
    }

    /// Takes verdicts; in a log without maps they are shown alone.
    pub(super) fn verdicts(&mut self, verdicts: &Verdicts, has_maps: bool, now: Timestamp) {
        self.verdicts = Some(Received {
            received_at: now,
            message: Arc::new(verdicts.clone()),
        });
        if !has_maps {
            self.frame(None, now);
        }
    }

    pub(super) fn picture(&mut self, picture: RecordedPicture, at_us: Timestamp) {
        self.pictures
            .push(at_us, || json(&RecordedPicture { at_us, ..picture }));
    }

    fn frame(&mut self, map: Option<&GlobalMap>, now_us: Timestamp) {
        let Self {
            timeline,
            vehicles,
            verdicts,
            ..
        } = self;
        timeline.frames.push(now_us, || {
            let map = map.map(|map| Received {
                received_at: now_us,
                message: Arc::new(map.clone()),
            });
            let vehicles = vehicles.reports_since(now_us - MAX_REPORT_AGE);
            json(&TimelineFrame {
                now_us,
                map,
                verdicts: verdicts.clone(),
                vehicles,
            })
        });
    }

    /// Map, timeline and pictures as HTML, with the scripts that draw them; empty if the log has no
    /// leader.
    pub(super) fn html(&self, leaders: &[LeaderRounds]) -> String {
        if leaders.is_empty() {
            return String::new();
        }
        let mut leaders: Vec<_> = leaders.iter().collect();
        leaders.sort_by_key(|run| run.first_at);
        let mut terms: Vec<LeaderTerm> = Vec::new();
        for run in leaders {
            let gap = terms
                .last()
                .and_then(|before| Some(run.first_at.since(before.until_us?)));
            terms.push(LeaderTerm {
                leader: run.epoch.leader.clone(),
                epoch: run.epoch.term,
                from_us: run.first_at,
                until_us: Some(run.last_at),
                gap_ms: gap.and_then(|gap| u64::try_from(gap.as_millis()).ok()),
            });
        }
        let fields = [
            [&b"{\"reigns\":"[..], &json(&terms)],
            [b",", &self.timeline.json_since(Timestamp::default())],
            [b",\"scenes\":", &self.timeline.frames.json()],
            [b",\"pictures\":", &self.pictures.json()],
            [b",\"landmarks\":", &json(&self.landmarks)],
        ];
        let bytes = fields.map(|field| field.concat()).concat();
        // Names in the log must not end the element.
        let data = String::from_utf8_lossy(&bytes).replace('<', "\\u003c");
        let view = assets::view();
        let script = assets::view_script() + include_str!("report.js");
        format!(
            "<section class=\"map-card\">\n{view}<figure id=\"picture-frame\" hidden><img id=\"picture\" alt=\"Image of the camera\">\
             <figcaption id=\"picture-at\"></figcaption></figure>\n\
             <script type=\"application/json\" id=\"log-data\">{data}}}</script>\n</section>\n\
             <script type=\"module\">\n{script}</script>\n"
        )
    }
}
