//! HTML of the report.

use std::fmt::Display;

use chrono::DateTime;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;

use super::plot::{Axis, Curve, Plot, bars, class};
use super::series::{Samples, distribution, quantile};
use super::{Report, RoundTimes};
use crate::observe::dashboard::assets::VIEW_STYLE;

/// Number of time slices in a plot.
const SLICES: usize = 700;

/// Maximum number of curves in a plot; a table has all.
const MAX_CURVES: usize = 12;

pub(super) fn write(report: &Report) -> String {
    let added: String = report
        .sections
        .iter()
        .map(|section| section.html())
        .collect();
    let sections = [
        report.timeline.html(&report.leaders),
        added,
        leadership(report),
        latency(report),
        gaps(report),
        reputations(report),
        coverage(report),
        drops(report),
    ];
    let node = report
        .identity
        .as_ref()
        .map_or("a node", |identity| identity.node.as_str());
    let title = escape(&format!("Log of {node}"));
    let head = format!("<h1>{title}</h1>\n{}{}", summary(report), problems(report));
    format!(
        "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
         <meta name=\"color-scheme\" content=\"light dark\">\n<meta http-equiv=\"Content-Security-Policy\" \
         content=\"default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:\">\n<title>{title}</title>\n<style>{VIEW_STYLE}{STYLE}</style>\n</head>\n\
         <body>\n<main>\n{head}{}</main>\n</body>\n</html>\n",
        sections.concat()
    )
}

fn summary(report: &Report) -> String {
    let first = report.start();
    let mut rows = vec![
        (
            "recorded".to_owned(),
            format!(
                "{} to {} UTC, {}",
                clock(first),
                clock(report.last),
                span(report)
            ),
        ),
        ("messages".into(), report.messages.to_string()),
        (
            "maps, verdicts".into(),
            format!("{}, {}", report.maps.count, report.verdicts.count),
        ),
    ];
    if let Some(identity) = &report.identity {
        rows.insert(0, ("cell".into(), identity.cell.to_string()));
        rows.push((
            "written by".into(),
            format!("ecod-node {}, run {}", identity.version, identity.run),
        ));
    }
    let row = |(name, value): (String, String)| {
        format!("<dt>{}</dt><dd>{}</dd>\n", escape(&name), escape(&value))
    };
    format!(
        "<dl>\n{}</dl>\n",
        rows.into_iter().map(row).collect::<String>()
    )
}

fn problems(report: &Report) -> String {
    if report.problems.is_empty() {
        return String::new();
    }
    let items: String = report
        .problems
        .iter()
        .map(|problem| format!("<li>{}</li>\n", escape(problem)))
        .collect();
    format!(
        "<section class=\"warning\">\n<h2>Unusable parts of the log</h2>\n<ul>\n{items}</ul>\n</section>\n"
    )
}

fn leadership(report: &Report) -> String {
    let rows: Vec<_> = report
        .leaders
        .iter()
        .map(|run| {
            let lasted = format!("{:.1}", run.last_at.since(run.first_at).as_secs_f64());
            let leader = run.epoch.leader.to_string();
            let term = run.epoch.term.to_string();
            vec![
                leader,
                term,
                clock(run.first_at),
                lasted,
                run.rounds.to_string(),
            ]
        })
        .collect();
    let changes: Vec<_> = report
        .changes
        .iter()
        .map(|change| {
            let [leader, standby] = [
                change.epoch.as_ref().map(ToString::to_string),
                change.standby.as_ref().map(ToString::to_string),
            ]
            .map(|name| name.unwrap_or("-".into()));
            vec![
                clock(change.at_us),
                change.position.replace('_', " "),
                leader,
                standby,
            ]
        })
        .collect();
    let mut text = table(
        &[
            "leader",
            "term",
            "from, UTC",
            "duration s",
            "maps or verdicts",
        ],
        &rows,
    );
    if !changes.is_empty() {
        let all = table(&["UTC", "this node is", "leader@term", "standby"], &changes);
        text += &format!(
            "<details><summary>Changes as this node saw them</summary>\n{all}</details>\n"
        );
    }
    section(
        "Leadership",
        "Nodes that led, one after the other, as far as this node got their maps. Each time of office is a term.",
        &text,
    )
}

fn latency(report: &Report) -> String {
    let RoundTimes {
        capture_to_fused,
        fused_to_received,
        ..
    } = &report.maps;
    let kinds = [
        (
            "maps: from the oldest frame in a map to the map",
            capture_to_fused,
        ),
        ("maps: from the leader to this node", fused_to_received),
        (
            "verdicts: from the leader to this node",
            &report.verdicts.fused_to_received,
        ),
    ];
    let measured: Vec<_> = kinds
        .into_iter()
        .filter(|(_, values)| !values.is_empty())
        .collect();
    let rows: Vec<_> = measured
        .iter()
        .map(|(name, values)| quantiles(name, values))
        .collect();
    let curves = |&(name, values): &(&str, &Vec<f64>)| {
        let points = distribution(values, SLICES)
            .into_iter()
            .map(|(value, share)| (value * 1000.0, share));
        Curve {
            name: name.to_owned(),
            points: points.collect(),
        }
    };
    let plot = Plot {
        title: "latency distribution",
        x_label: "ms",
        y_label: "% within that time",
        curves: measured.iter().map(curves).collect(),
        marks: Vec::new(),
        x: Axis::Logarithmic,
    };
    let text = shown(&plot) + &table(&QUANTILES, &rows);
    section(
        "Latency",
        "By the clocks of leader and recording node: their difference is included.",
        &text,
    )
}

fn gaps(report: &Report) -> String {
    let start = report.start();
    let kinds = [
        ("maps", &report.maps.gaps),
        ("verdicts", &report.verdicts.gaps),
    ];
    let measured: Vec<_> = kinds
        .into_iter()
        .filter(|(_, gaps)| gaps.newest().is_some())
        .collect();
    let rows: Vec<_> = measured
        .iter()
        .map(|(name, gaps)| quantiles(name, &gaps.values()))
        .collect();
    let curve = |&(name, gaps): &(&str, &Samples)| {
        // A gap extends from the round before to the round that ends it.
        let points = gaps
            .points(start, seconds(report), SLICES)
            .into_iter()
            .flat_map(|(x, gap)| [(x - gap, gap * 1000.0), (x, gap * 1000.0)]);
        Curve {
            name: name.to_owned(),
            points: points.collect(),
        }
    };
    let plot = over_time(
        report,
        "time between rounds",
        "ms since the one before",
        measured.iter().map(curve).collect(),
    );
    let text = shown(&plot) + &table(&QUANTILES, &rows);
    section(
        "Gaps",
        "Time from one map, or set of verdicts, to the next at this node; dotted lines mark changes of leader.",
        &text,
    )
}

fn reputations(report: &Report) -> String {
    if report.reputations.is_empty() {
        return section(
            "Reputations",
            "None were published: the cell rates no vehicles, or has no evidence yet.",
            "",
        );
    }
    let start = report.start();
    let curve = |(node, samples): (&NodeName, &Samples)| Curve {
        name: node.to_string(),
        points: samples.points(start, seconds(report), SLICES),
    };
    let curves: Vec<_> = report
        .reputations
        .iter()
        .take(MAX_CURVES)
        .map(curve)
        .collect();
    let newest = |(node, samples): (&NodeName, &Samples)| {
        Some(vec![node.to_string(), format!("{:.3}", samples.newest()?)])
    };
    let rows: Vec<_> = report.reputations.iter().filter_map(newest).collect();
    let text = shown(&over_time(report, "reputations", "weight of votes", curves))
        + &table(&["vehicle", "last"], &rows);
    section(
        "Reputations",
        "How much each vehicle's reports count, from 0 to 1: this follows from how often the others agreed with the vehicle.",
        &text,
    )
}

fn coverage(report: &Report) -> String {
    let share = |contributed: u64| 100.0 * contributed as f64 / report.entries.max(1) as f64;
    let shares: Vec<_> = report
        .vehicles
        .iter()
        .map(|(node, vehicle)| (node.to_string(), share(vehicle.contributed)))
        .collect();
    let rows: Vec<_> = report
        .vehicles
        .iter()
        .map(|(node, vehicle)| {
            let lasted = vehicle
                .last_at
                .since(vehicle.first_at.unwrap_or(vehicle.last_at))
                .as_secs_f64();
            let rate = if lasted > 0.0 {
                format!("{:.1}", (vehicle.reports as f64 - 1.0) / lasted)
            } else {
                "-".into()
            };
            let objects = vehicle.objects as f64 / vehicle.reports.max(1) as f64;
            let counts = [
                vehicle.reports.to_string(),
                rate,
                format!("{objects:.1}"),
                vehicle.contributed.to_string(),
            ];
            [node.to_string()].into_iter().chain(counts).collect()
        })
        .collect();
    let head = [
        "vehicle",
        "reports",
        "per second",
        "objects each",
        "places and objects on maps",
    ];
    let text = if report.entries == 0 {
        String::new()
    } else {
        drawing(&bars("coverage per vehicle", &shares))
    };
    let about = "Share of the objects and labelled locations of all maps that a vehicle contributed to, and its reports \
                 of all kinds.";
    section("Coverage", about, &(text + &table(&head, &rows)))
}

fn drops(report: &Report) -> String {
    let losses = &report.losses;
    if !losses.are_known() {
        return String::new();
    }
    let row = |(name, times): (&String, &u64)| vec![name.replace('_', " "), times.to_string()];
    let rows: Vec<_> = losses.by_reason().iter().map(row).collect();
    if rows.is_empty() {
        return section(
            "Lost or rejected",
            "Nothing was lost or rejected while this log was recorded.",
            "",
        );
    }
    let points = losses
        .over_time()
        .points(report.start(), seconds(report), SLICES);
    let curve = Curve {
        name: "lost or rejected so far".into(),
        points,
    };
    let text = shown(&over_time(report, "drops", "lost or rejected", vec![curve]))
        + &table(&["reason", "times"], &rows);
    section(
        "Lost or rejected",
        "Messages lost or rejected by this node while this log was recorded, by reason.",
        &text,
    )
}

fn over_time<'a>(
    report: &Report,
    title: &'a str,
    y_label: &'a str,
    curves: Vec<Curve>,
) -> Plot<'a> {
    let start = report.start();
    let marks = report
        .leaders
        .iter()
        .skip(1)
        .map(|run| {
            (
                run.first_at.since(start).as_secs_f64(),
                run.epoch.to_string(),
            )
        })
        .collect();
    Plot {
        title,
        x_label: "s",
        y_label,
        curves,
        marks,
        x: Axis::Linear(seconds(report)),
    }
}

/// A plot with its legend; empty without points.
fn shown(plot: &Plot<'_>) -> String {
    if plot.curves.iter().all(|curve| curve.points.is_empty()) {
        return String::new();
    }
    let key = |(index, curve): (usize, &Curve)| {
        format!(
            "<li><i class=\"{}\"></i>{}</li>\n",
            class(index),
            escape(&curve.name)
        )
    };
    let keys: String = plot.curves.iter().enumerate().map(key).collect();
    format!(
        "<figure>\n{}<ul class=\"legend\">\n{keys}</ul>\n</figure>\n",
        drawing(&plot.draw())
    )
}

/// A picture, as wide as the page allows.
pub fn drawing(picture: &str) -> String {
    format!("<div class=\"drawing\">{picture}</div>\n")
}

const QUANTILES: [&str; 6] = ["ms", "number", "p50", "p95", "p99", "max"];

fn quantiles(name: &str, values: &[f64]) -> Vec<String> {
    let shares = [0.5, 0.95, 0.99, 1.0];
    let ms = |share| {
        quantile(values, share).map_or("-".to_owned(), |value| format!("{:.1}", value * 1000.0))
    };
    [name.to_owned(), values.len().to_string()]
        .into_iter()
        .chain(shares.map(ms))
        .collect()
}

/// A section under its title and a sentence about it.
pub fn section(title: &str, about: &str, content: &str) -> String {
    format!("<section>\n<h2>{title}</h2>\n<p>{about}</p>\n{content}</section>\n")
}

/// Rows under a header.
pub fn table(head: &[&str], rows: &[Vec<String>]) -> String {
    let cells = |tag: &str, cells: &mut dyn Iterator<Item = &str>| -> String {
        let cells: String = cells
            .map(|content| format!("<{tag}>{}</{tag}>", escape(content)))
            .collect();
        format!("<tr>{cells}</tr>")
    };
    let head = cells("th", &mut head.iter().copied());
    let rows: String = rows
        .iter()
        .map(|row| cells("td", &mut row.iter().map(String::as_str)) + "\n")
        .collect();
    format!(
        "<div class=\"scroll\"><table>\n<thead>{head}</thead>\n<tbody>\n{rows}</tbody>\n</table></div>\n"
    )
}

fn seconds(report: &Report) -> f64 {
    report
        .last
        .since(report.first.unwrap_or(report.last))
        .as_secs_f64()
        .max(1e-3)
}

fn span(report: &Report) -> String {
    format!("{:.1} s", seconds(report))
}

fn clock(at: Timestamp) -> String {
    let time = i64::try_from(at.micros())
        .ok()
        .and_then(DateTime::from_timestamp_micros)
        .unwrap_or_default();
    time.format("%Y-%m-%d %H:%M:%S%.3f").to_string()
}

/// Text escaped for HTML.
fn escape(text: &(impl Display + ?Sized)) -> String {
    text.to_string()
        .replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
        .replace('"', "&quot;")
}

const STYLE: &str = include_str!("page.css");
