//! Metrics of the node for Prometheus, in the OpenMetrics text format.
//!
//! All values are read on request; only counters that the node has anyway are kept. The number of
//! label values is bounded: reasons and states are fixed sets, vehicles and nodes are the first
//! [`MAX_VEHICLES`] by name.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::atomic::AtomicU64;

use ecod::diagnostics::MissingNode;
use ecod::leadership::Position;
use ecod::wire::{ReportKind, Trouble};
use prometheus_client::encoding::text::encode;
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::registry::{Registry, Unit};

use super::history::MAX_VEHICLES;
use super::live_state::kind_label;
use super::node_monitor::NodeMonitor;
use super::process_metrics;
use crate::platform::clock;
use crate::telemetry::counters::{Event, OTHERS, Shed, ShedReason, SourceCount};
use crate::transport::mqtt::LinkState;

/// Content type of [`metrics`].
pub(crate) const CONTENT_TYPE: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

type Labels = Vec<(&'static str, String)>;
type FloatGauge = Gauge<f64, AtomicU64>;

/// All metrics as text.
///
/// # Errors
/// Does not fail for text; the encoder's writer may fail.
pub(crate) fn metrics(monitor: &NodeMonitor) -> Result<String, fmt::Error> {
    let mut registry = Registry::with_prefix("ecod");
    node(&mut registry, monitor);
    troubles(&mut registry, monitor);
    certificate(&mut registry, monitor);
    election(&mut registry, monitor);
    rounds(&mut registry, monitor);
    traffic(&mut registry, monitor);
    reputations(&mut registry, monitor);
    let mut process = Registry::default();
    process_metrics::register(&mut process, monitor.sources.node.started_at_us);
    let mut text = String::new();
    encode(&mut text, &registry)?;
    // A text has one end mark only.
    text.truncate(text.trim_end_matches("# EOF\n").len());
    encode(&mut text, &process)?;
    Ok(text)
}

fn node(registry: &mut Registry, monitor: &NodeMonitor) {
    let sources = &monitor.sources;
    let probe = monitor.observed().probe.clone();
    let facts = &sources.node;
    let labels = vec![
        ("node", facts.name.to_string()),
        ("cell", facts.cell.to_string()),
        ("role", facts.role.to_string()),
        ("version", facts.version.to_owned()),
    ];
    gauges(
        registry,
        "node_info",
        "Name, cell, role and version of the node; always 1",
        [(labels, 1)],
    );
    let ready = "Whether the node follows a live aggregator, or leads with a working broker";
    gauge(
        registry,
        "ready",
        ready,
        i64::from(monitor.readiness().ready),
    );
    let others = sources
        .members
        .borrow()
        .iter()
        .filter(|member| !member.name.is_part())
        .count();
    let members = count(others + 1);
    gauge(
        registry,
        "members",
        "Nodes of the cell that answer, this one included",
        members,
    );
    missing(registry, monitor);
    let serves = "Whether the node's embedded broker serves; 0 also on a node without one";
    gauge(
        registry,
        "broker_up",
        serves,
        i64::from(probe.broker_serves),
    );
    let links = [("up", true), ("down", false)].map(|(label, wanted)| {
        let states = probe.links.iter().flat_map(|links| links.values());
        (
            state(label),
            count(
                states
                    .filter(|state| (**state == LinkState::Up) == wanted)
                    .count(),
            ),
        )
    });
    gauges(registry, "mqtt_links", "Links to brokers by state", links);
    gauge(
        registry,
        "dashboard_viewers",
        "Browsers that receive live snapshots",
        count(monitor.viewers()),
    );
}

/// The series of a node exists only while the node is missing.
fn missing(registry: &mut Registry, monitor: &NodeMonitor) {
    let absences = Family::<Labels, FloatGauge>::default();
    let help =
        "Time since an expected node that does not answer last did; the first nodes by name only";
    registry.register_with_unit("member_missing", help, Unit::Seconds, absences.clone());
    let now = clock::now();
    let nodes = monitor.sources.live_state.expected().missing();
    for MissingNode {
        name, last_seen, ..
    } in nodes.into_iter().take(MAX_VEHICLES)
    {
        absences
            .get_or_create(&vec![("member", name.to_string())])
            .set(now.since(last_seen).as_secs_f64());
    }
}

fn troubles(registry: &mut Registry, monitor: &NodeMonitor) {
    let present = monitor.sources.counters.troubles().present().into_iter();
    // Not by name: names come from outside and are unbounded in number.
    let mut by_kind: BTreeMap<(String, &str), i64> = BTreeMap::new();
    for Trouble { kind, about, .. } in present {
        *by_kind
            .entry((kind, if about.is_none() { "node" } else { "other" }))
            .or_default() += 1;
    }
    let labels = by_kind
        .into_iter()
        .map(|((kind, of), times)| (vec![("trouble", kind), ("of", of.to_owned())], times));
    gauges(
        registry,
        "troubles",
        "Present troubles of the node itself and of others as it sees them, by kind",
        labels,
    );
    let reading = monitor.sources.vitals.clock.reading();
    if reading.error_us.is_some() {
        let ahead_us = clock::wall_offset_us().saturating_sub(reading.offset_us);
        let ahead = FloatGauge::default();
        ahead.set(ahead_us as f64 / 1e6);
        registry.register_with_unit(
            "clock_ahead",
            "Machine's clock less the cell's time",
            Unit::Seconds,
            ahead,
        );
    }
}

fn certificate(registry: &mut Registry, monitor: &NodeMonitor) {
    if let Some(credentials) = &monitor.sources.vitals.security.credentials {
        let expires = credentials.current().identity.expires();
        let left = FloatGauge::default();
        left.set(expires.since(clock::wall()).as_secs_f64());
        registry.register_with_unit(
            "certificate_remaining",
            "Validity of the node's certificate that remains",
            Unit::Seconds,
            left,
        );
    }
}

fn election(registry: &mut Registry, monitor: &NodeMonitor) {
    let leadership = monitor.sources.vitals.leadership.borrow().clone();
    let positions = [
        ("seeking", Position::Seeking),
        ("following", Position::Following),
        ("standing_by", Position::StandingBy),
        ("leading", Position::Leading),
    ];
    let states = positions
        .map(|(label, position)| (state(label), i64::from(leadership.position == position)));
    gauges(
        registry,
        "election_state",
        "Position of the node in its cell; 1 for the present one",
        states,
    );
    let term = leadership
        .epoch
        .as_ref()
        .map_or(0, |epoch| i64::try_from(epoch.term).unwrap_or(i64::MAX));
    gauge(
        registry,
        "election_epoch",
        "Highest term of leadership that the node has received or used",
        term,
    );
    let failovers = Counter::<u64>::default();
    failovers.inc_by(monitor.observed().history.failovers);
    registry.register(
        "election_failovers",
        "Changes of the leader seen since the node started",
        failovers,
    );
}

fn rounds(registry: &mut Registry, monitor: &NodeMonitor) {
    let newest = &monitor.sources.vitals.newest;
    let latency = &monitor.map_latency;
    for (name, help, histogram) in [
        (
            "map_capture_to_fused",
            "From the oldest capture in a map to its fusion",
            &latency.capture_to_fused,
        ),
        (
            "map_fused_to_received",
            "From a map's fusion to its receipt",
            &latency.fused_to_received,
        ),
        (
            "map_capture_to_received",
            "From the oldest capture in a map to its receipt",
            &latency.capture_to_received,
        ),
    ] {
        registry.register_with_unit(name, help, Unit::Seconds, histogram.clone());
    }
    let map = newest.map.borrow().clone();
    if let Some(newest) = &map {
        gauge(
            registry,
            "map_landmarks",
            "Known locations in the newest map",
            count(newest.map.landmarks.len()),
        );
        let objects = "Objects in the newest map that are not at a known location";
        gauge(
            registry,
            "map_objects",
            objects,
            count(newest.map.objects.len()),
        );
    }
    let ages = Family::<Labels, FloatGauge>::default();
    let help = "Time since the newest map or verdicts";
    registry.register_with_unit("newest_round_age", help, Unit::Seconds, ages.clone());
    let verdicts_at = newest
        .verdicts
        .borrow()
        .as_ref()
        .map(|newest| newest.received_at);
    for (label, received_at) in [
        ("map", map.map(|newest| newest.received_at)),
        ("verdicts", verdicts_at),
    ] {
        if let Some(received_at) = received_at {
            ages.get_or_create(&kind(label))
                .set(clock::now().since(received_at).as_secs_f64());
        }
    }
}

fn traffic(registry: &mut Registry, monitor: &NodeMonitor) {
    let sources = &monitor.sources;
    let snapshot = sources.counters.snapshot();
    let accepted = [
        ("map", Event::MapAccepted),
        ("verdicts", Event::VerdictsAccepted),
        ("reputations", Event::ReputationsAccepted),
    ]
    .map(|(label, event)| (kind(label), sources.counters.events(event)));
    counters(
        registry,
        "rounds_accepted",
        "Maps, verdicts and reputations newer than all before",
        accepted,
    );
    let reports = [ReportKind::Detections, ReportKind::VoteDetections]
        .map(|report| (kind(kind_label(report)), sources.live_state.reports(report)));
    counters(
        registry,
        "reports_received",
        "Vehicles' reports, used or not",
        reports,
    );
    let rejected = snapshot
        .rejects
        .iter()
        .map(|(reason, times)| (vec![("reason", (*reason).to_owned())], *times));
    counters(
        registry,
        "payloads_rejected",
        "Payloads that were not used, by reason",
        rejected,
    );
    let rejected_of = sources.counters.rejects_by_source().into_iter().map(
        |SourceCount {
             reason,
             source,
             times,
         }| {
            (
                vec![("reason", reason.as_str().to_owned()), ("source", source)],
                times,
            )
        },
    );
    let help = "Payloads that were not used, by reason and sender; bounded";
    counters(registry, "payloads_rejected_by_source", help, rejected_of);
    // Rates need a series that exists before its first increase.
    let zeros = ShedReason::ALL.iter().map(|&reason| Shed {
        reason,
        source: OTHERS.to_owned(),
        times: 0,
    });
    let shed = zeros.chain(sources.counters.all_shed()).map(
        |Shed {
             reason,
             source,
             times,
         }| {
            (
                vec![("reason", reason.as_str().to_owned()), ("source", source)],
                times,
            )
        },
    );
    counters(
        registry,
        "shed",
        "Messages discarded under overload, by reason and source; bounded",
        shed,
    );
    let event = |(event, times): (&&str, &u64)| (vec![("event", (*event).to_owned())], *times);
    counters(
        registry,
        "events",
        "Counted events by kind",
        snapshot.events.iter().map(event),
    );
    let frames = sources.frames.snapshot();
    counters(
        registry,
        "gossip_frames",
        "Datagrams between nodes, by outcome",
        frames.iter().map(event),
    );
}

fn reputations(registry: &mut Registry, monitor: &NodeMonitor) {
    let Some(newest) = monitor.sources.vitals.newest.reputations.borrow().clone() else {
        return;
    };
    let vehicles = &newest.message.reputations;
    gauge(
        registry,
        "reputation_vehicles",
        "Vehicles that have a reputation",
        count(vehicles.len()),
    );
    let scores = Family::<Labels, FloatGauge>::default();
    let help = "Weight of a vehicle's votes; the first vehicles by name only";
    registry.register("reputation_score_ratio", help, scores.clone());
    for (vehicle, reputation) in vehicles.iter().take(MAX_VEHICLES) {
        scores
            .get_or_create(&vec![("vehicle", vehicle.to_string())])
            .set(reputation.score);
    }
}

fn gauge(registry: &mut Registry, name: &str, help: &str, value: i64) {
    let gauge = Gauge::<i64>::default();
    gauge.set(value);
    registry.register(name, help, gauge);
}

fn gauges(
    registry: &mut Registry,
    name: &str,
    help: &str,
    values: impl IntoIterator<Item = (Labels, i64)>,
) {
    let family = Family::<Labels, Gauge>::default();
    for (labels, value) in values {
        family.get_or_create(&labels).set(value);
    }
    registry.register(name, help, family);
}

fn counters(
    registry: &mut Registry,
    name: &str,
    help: &str,
    values: impl IntoIterator<Item = (Labels, u64)>,
) {
    let family = Family::<Labels, Counter>::default();
    for (labels, times) in values {
        family.get_or_create(&labels).inc_by(times);
    }
    registry.register(name, help, family);
}

fn state(label: &str) -> Labels {
    vec![("state", label.to_owned())]
}

fn kind(label: &str) -> Labels {
    vec![("kind", label.to_owned())]
}

fn count(number: usize) -> i64 {
    i64::try_from(number).unwrap_or(i64::MAX)
}
