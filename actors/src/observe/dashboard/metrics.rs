//! The node for Prometheus, in the OpenMetrics text format.
//!
//! Everything is read when it is asked for; nothing is kept for it but counters that the node has anyway. Labels have
//! few values: reasons and states are fixed sets, vehicles are the first [`MAX_VEHICLES`] by name.

use std::fmt;

use ecod::wire::ReportKind;
use prometheus_client::encoding::text::encode;
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::registry::{Registry, Unit};

use super::history::MAX_VEHICLES;
use super::live_state::kind_label;
use super::node_monitor::{NodeMonitor, age_s};
use super::process_metrics;
use crate::messages::leadership::Position;
use crate::telemetry::counters::{Event, OTHERS, Shed, ShedReason};
use crate::transport::mqtt::LinkState;

/// The content type of [`metrics`].
pub(crate) const CONTENT_TYPE: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

type Labels = Vec<(&'static str, String)>;
type Float = Gauge<f64, std::sync::atomic::AtomicU64>;

/// All metrics as text.
///
/// # Errors
/// Never with text; the encoder writes to what may refuse.
pub(crate) fn metrics(monitor: &NodeMonitor) -> Result<String, fmt::Error> {
    let mut registry = Registry::with_prefix("ecod");
    node(&mut registry, monitor);
    election(&mut registry, monitor);
    rounds(&mut registry, monitor);
    traffic(&mut registry, monitor);
    reputations(&mut registry, monitor);
    let mut own = Registry::default();
    process_metrics::register(&mut own, monitor.sources().node.started_at_us);
    let mut text = String::new();
    encode(&mut text, &registry)?;
    // One text has one end.
    text.truncate(text.trim_end_matches("# EOF\n").len());
    encode(&mut text, &own)?;
    Ok(text)
}

fn node(registry: &mut Registry, monitor: &NodeMonitor) {
    let facts = &monitor.sources().node;
    let role = format!("{:?}", facts.role).to_lowercase();
    let labels = [("node", facts.name.to_string()), ("cell", facts.cell.to_string()), ("role", role)];
    let info = family(registry, "node_info", "Name, cell, role and version of the node; always 1.");
    set(&info, [labels.as_slice(), &[("version", facts.version.to_owned())]].concat(), 1);
    let ready = "Whether the node follows a live aggregator, or leads with a working broker.";
    gauge(registry, "ready", ready, i64::from(monitor.readiness().ready));
    gauge(registry, "members", "Nodes of the cell that answer, this one included.", {
        count(monitor.sources().members.borrow().len() + 1)
    });
    let (probe, viewers) = (monitor.probe(), monitor.viewers());
    let serves = "Whether the node's embedded broker serves; 0 too on a node without one.";
    gauge(registry, "broker_up", serves, i64::from(probe.broker_serves));
    let up = |state: LinkState| state == LinkState::Up;
    let links = family(registry, "mqtt_links", "Links to brokers by state.");
    for (label, wanted) in [("up", true), ("down", false)] {
        let number = probe.links.iter().flatten().filter(|(_, state)| up(**state) == wanted).count();
        set(&links, [("state", label.to_owned())], count(number));
    }
    gauge(registry, "dashboard_viewers", "Browsers that get live pictures.", count(viewers));
}

fn election(registry: &mut Registry, monitor: &NodeMonitor) {
    let leadership = monitor.sources().vitals.leadership.borrow().clone();
    let states = family(registry, "election_state", "What the node has to do with the lead; 1 for the present state.");
    for (label, position) in [
        ("seeking", Position::Seeking),
        ("following", Position::Following),
        ("standing_by", Position::StandingBy),
        ("leading", Position::Leading),
    ] {
        set(&states, [("state", label.to_owned())], i64::from(leadership.position == position));
    }
    let term = leadership.epoch.as_ref().map_or(0, |epoch| i64::try_from(epoch.term).unwrap_or(i64::MAX));
    gauge(registry, "election_epoch", "Highest term of leadership known.", term);
    let failovers = Counter::<u64>::default();
    failovers.inc_by(monitor.failovers());
    registry.register("election_failovers", "Changes of the leader seen since the node started", failovers);
}

fn rounds(registry: &mut Registry, monitor: &NodeMonitor) {
    let (sources, latencies) = (monitor.sources(), monitor.latencies());
    for (name, help, histogram) in [
        ("map_capture_to_fused", "From the oldest capture in a map to its fusion", &latencies.capture_to_fused),
        ("map_fused_to_received", "From a map's fusion to its receipt", &latencies.fused_to_received),
        ("map_capture_to_received", "From the oldest capture in a map to its receipt", &latencies.capture_to_received),
    ] {
        registry.register_with_unit(name, help, Unit::Seconds, histogram.clone());
    }
    let newest = sources.vitals.newest.map.borrow().clone();
    let verdicts = sources.vitals.newest.verdicts.borrow().clone();
    if let Some(newest) = &newest {
        gauge(registry, "map_landmarks", "Known locations in the newest map.", count(newest.map.landmarks.len()));
        gauge(registry, "map_objects", "Objects in the newest map beside known locations.", {
            count(newest.map.objects.len())
        });
    }
    let ages = Family::<Labels, Float>::default();
    registry.register_with_unit(
        "newest_round_age",
        "Time since the newest map or verdicts",
        Unit::Seconds,
        ages.clone(),
    );
    let came = [("map", newest.map(|map| map.received_at)), ("verdicts", verdicts.map(|newest| newest.received_at))];
    for (label, received_at) in came {
        if let Some(received_at) = received_at {
            ages.get_or_create(&vec![("kind", label.to_owned())]).set(age_s(received_at));
        }
    }
}

fn traffic(registry: &mut Registry, monitor: &NodeMonitor) {
    let sources = monitor.sources();
    let snapshot = sources.counters.snapshot();
    let accepted = counters(registry, "rounds_accepted", "Maps, verdicts and reputations newer than all before");
    for (kind, event) in [
        ("map", Event::MapAccepted),
        ("verdicts", Event::VerdictsAccepted),
        ("reputations", Event::ReputationsAccepted),
    ] {
        add(&accepted, [("kind", kind.to_owned())], sources.counters.events(event));
    }
    let reports = counters(registry, "reports_received", "Vehicles' reports, also those that were not used");
    for kind in [ReportKind::Detections, ReportKind::VoteDetections] {
        add(&reports, [("kind", kind_label(kind).to_owned())], sources.live_state.reports(kind));
    }
    let rejected = counters(registry, "payloads_rejected", "Payloads that were not used, by reason");
    for (reason, number) in snapshot.rejects {
        add(&rejected, [("reason", reason.to_owned())], number);
    }
    let shed = counters(registry, "shed", "Messages left out under overload, by reason and source; bounded");
    // A rate needs a series that is there before it matters.
    for reason in ShedReason::ALL {
        add(&shed, [("reason", reason.as_str().to_owned()), ("source", OTHERS.to_owned())], 0);
    }
    for Shed { reason, source, times } in sources.counters.all_shed() {
        add(&shed, [("reason", reason.as_str().to_owned()), ("source", source)], times);
    }
    let events = counters(registry, "events", "What the node counts, by kind");
    for (event, number) in snapshot.events {
        add(&events, [("event", event.to_owned())], number);
    }
    let frames = counters(registry, "gossip_frames", "Datagrams between nodes, by what became of them");
    for (event, number) in sources.frames.snapshot() {
        add(&frames, [("event", event.to_owned())], number);
    }
}

fn reputations(registry: &mut Registry, monitor: &NodeMonitor) {
    let Some(newest) = monitor.sources().vitals.newest.reputations.borrow().clone() else { return };
    let vehicles = &newest.message.reputations;
    gauge(registry, "reputation_vehicles", "Vehicles that have a reputation.", count(vehicles.len()));
    let scores = Family::<Labels, Float>::default();
    let help = "Weight of a vehicle's votes; the first vehicles by name only";
    registry.register("reputation_score_ratio", help, scores.clone());
    for (vehicle, reputation) in vehicles.iter().take(MAX_VEHICLES) {
        scores.get_or_create(&vec![("vehicle", vehicle.to_string())]).set(reputation.score);
    }
}

fn gauge(registry: &mut Registry, name: &str, help: &str, value: i64) {
    let gauge = Gauge::<i64>::default();
    gauge.set(value);
    registry.register(name, help.trim_end_matches('.'), gauge);
}

fn family(registry: &mut Registry, name: &str, help: &str) -> Family<Labels, Gauge> {
    let family = Family::default();
    registry.register(name, help.trim_end_matches('.'), Family::clone(&family));
    family
}

fn set(family: &Family<Labels, Gauge>, labels: impl Into<Labels>, value: i64) {
    family.get_or_create(&labels.into()).set(value);
}

fn counters(registry: &mut Registry, name: &str, help: &str) -> Family<Labels, Counter> {
    let family = Family::default();
    registry.register(name, help, Family::clone(&family));
    family
}

fn add(family: &Family<Labels, Counter>, labels: impl Into<Labels>, number: u64) {
    family.get_or_create(&labels.into()).inc_by(number);
}

fn count(number: usize) -> i64 {
    i64::try_from(number).unwrap_or(i64::MAX)
}
