//! Spans along a detection's path from a frame to the maps that vehicles accept.
//!
//! ```text
//! vehicle     frame ─┬─ detect      from capture to published report
//!                    ├─ project
//!                    └─ publish
//! aggregator         └─ report      from receipt to the round that has it; linked to the round
//!             round ─┬─ fuse        from the first report's receipt to the published map; linked to its frames
//!                    └─ publish
//! every node         └─ accept      from receipt of a map or verdicts to its acceptance
//! ```
//!
//! `ractor` passes the sender's span with each message, so that an actor's spans become children of
//! the span that caused them. A span ends when the last message that it caused has been handled.
//!
//! Nodes exchange only payloads, without trace contexts: both sides derive the name of a frame or
//! round from the fields of its report or map. The fields `ecod.*` pass these names to the recorder
//! of spans; see `telemetry::otlp`.

use std::collections::BTreeMap;
use std::fmt;

use ecod::aggregator::Fused;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::wire::{GlobalMap, ObjectReport, Verdicts};
use tracing::{Level, Span, info_span, span_enabled};

use crate::platform::cell_clock::CellClock;

/// The spans of one node.
#[derive(Debug, Clone)]
pub struct Spans {
    cell: NodeName,
    node: NodeName,
    clock: CellClock,
}

/// Reports that a round has used so far: node, time of capture and time of receipt.
#[derive(Debug, Default)]
pub struct RoundReports(BTreeMap<(NodeName, Timestamp), Timestamp>);

/// The round of a map or verdicts.
#[derive(Debug, Clone, Copy)]
pub struct RoundId<'a> {
    aggregator: &'a NodeName,
    epoch: u64,
    round: u64,
    fused_at: Timestamp,
}

impl Spans {
    /// Spans of a node of a cell.
    pub fn new(cell: NodeName, node: NodeName) -> Self {
        Self {
            cell,
            node,
            clock: CellClock::default(),
        }
    }

    /// The same spans for a node that dates its messages by this clock.
    pub fn dated_by(self, clock: CellClock) -> Self {
        Self { clock, ..self }
    }

    /// The path of a frame from its capture on; the root of its trace.
    pub fn frame(&self, captured_at: Timestamp) -> Span {
        info_span!(
            parent: None,
            "frame",
            node = %self.node,
            ecod.id = %self.frame_name(&self.node, self.clock.date(captured_at)),
            ecod.since_us = captured_at.micros(),
        )
    }

    /// Records a report that the current round has used.
    pub fn record(
        &self,
        report: &ObjectReport,
        received_at: Timestamp,
        reports: &mut RoundReports,
    ) {
        if span_enabled!(Level::INFO) {
            reports
                .0
                .entry((report.node.clone(), report.captured_at_us))
                .or_insert(received_at);
        }
    }

    /// A round that has just been closed, from its first report on; the root of its trace. Each of
    /// its reports gets a span in the trace of its frame.
    pub fn round(&self, fused: &Fused, reports: &RoundReports) -> Span {
        let of_map = fused.map.as_ref().map(RoundId::from);
        let Some(round) = of_map.or_else(|| fused.verdicts.as_ref().map(RoundId::from)) else {
            return Span::none();
        };
        if !span_enabled!(Level::INFO) {
            return Span::none();
        }
        let mut frames = String::new();
        let mut since = self.clock.undate(round.fused_at);
        for ((node, captured_at), received_at) in &reports.0 {
            let frame = self.frame_name(node, *captured_at).to_string();
            drop(info_span!(
                parent: None,
                "report",
                node = %self.node,
                from = %node,
                ecod.parent = frame.as_str(),
                ecod.links = %self.round_name(round),
                ecod.since_us = received_at.micros(),
            ));
            frames.extend([&*frame, " "]);
            since = since.min(*received_at);
        }
        let span = info_span!(
            parent: None,
            "round",
            node = %self.node,
            epoch = round.epoch as i64,
            round = round.round as i64,
            reports = reports.0.len() as i64,
            ecod.id = %self.round_name(round),
            ecod.links = frames.trim_end(),
            ecod.since_us = since.micros(),
        );
        let fused_at = self.clock.undate(round.fused_at);
        drop(info_span!(parent: &span, "fuse", ecod.since_us = fused_at.micros()));
        span
    }

    /// Acceptance of a map or verdicts, in the trace of the round.
    pub fn accept<'a>(
        &self,
        payload: &'static str,
        round: impl Into<RoundId<'a>>,
        received_at: Timestamp,
    ) -> Span {
        let round = round.into();
        info_span!(
            parent: None,
            "accept",
            node = %self.node,
            payload,
            epoch = round.epoch as i64,
            round = round.round as i64,
            ecod.parent = %self.round_name(round),
            ecod.since_us = received_at.micros(),
        )
    }

    fn frame_name(&self, node: &NodeName, captured_at: Timestamp) -> impl fmt::Display {
        fmt::from_fn(move |f| write!(f, "{}/{node}/{}", self.cell, captured_at.micros()))
    }

    fn round_name(&self, round: RoundId<'_>) -> impl fmt::Display {
        let RoundId {
            aggregator,
            epoch,
            round,
            fused_at,
        } = round;
        fmt::from_fn(move |f| {
            write!(
                f,
                "{}/{aggregator}/{epoch}/{round}/{}",
                self.cell,
                fused_at.micros()
            )
        })
    }
}

impl<'a> From<&'a GlobalMap> for RoundId<'a> {
    fn from(map: &'a GlobalMap) -> Self {
        Self {
            aggregator: &map.aggregator,
            epoch: map.epoch,
            round: map.round,
            fused_at: map.fused_at_us,
        }
    }
}

impl<'a> From<&'a Verdicts> for RoundId<'a> {
    fn from(verdicts: &'a Verdicts) -> Self {
        let Verdicts {
            aggregator,
            epoch,
            round,
            fused_at_us,
            ..
        } = verdicts;
        Self {
            aggregator,
            epoch: *epoch,
            round: *round,
            fused_at: *fused_at_us,
        }
    }
}
