//! How right maps and verdicts were, by the truth that was given.

use ecod::eval::{Evaluation, Scores};

use super::Report;
use super::page::{drawing, section, table};
use super::plot::bars;
use super::tracks::{tables, without_map};

/// What was judged by what stands at each location; nothing without such a truth.
pub(super) fn of_locations(report: &Report) -> String {
    let Some(result) = report.evaluation.as_ref().map(Evaluation::result) else { return String::new() };
    let percent = |share: Option<f64>| share.map_or("-".to_owned(), |share| format!("{share:.1}"));
    let row = |name: &str, scores: &Scores| {
        let cells = [name.to_owned(), scores.lines.to_string(), scores.items.to_string()];
        cells.into_iter().chain(scores.shares_pct().map(percent)).collect::<Vec<_>>()
    };
    let judged = [("PACE", &result.pace), ("VOTE", &result.vote)];
    let rows: Vec<_> = judged.iter().filter_map(|(name, scores)| Some(row(name, scores.as_ref()?))).collect();
    let head = ["", "rounds", "items", "accuracy %", "coverage %", "labelled %", "all rounds %", "majority %"];
    let mut text = table(&head, &rows);
    for (name, scores) in judged.iter().filter_map(|(name, scores)| Some((name, scores.as_ref()?))) {
        let alone: Vec<_> = scores.vehicles.iter().collect();
        let shares: Vec<_> =
            alone.iter().filter_map(|(node, alone)| Some((node.to_string(), alone.accuracy_pct?))).collect();
        if !shares.is_empty() {
            let title = format!("{name}: accuracy of every vehicle alone");
            text += &format!("<h3>{title}</h3>\n{}", drawing(&bars(&title, &shares)));
        }
    }
    section("Accuracy", "Judged by the truth that was given; an item is a location while its truth stays.", &text)
}

/// What was judged by where all objects were; nothing without such a truth.
pub(super) fn of_tracks(report: &Report) -> String {
    let Some(scores) = report.tracks.clone().map(ecod::eval::tracks::TrackEvaluation::result) else {
        return String::new();
    };
    let tables = tables(&scores).map(|rows| match rows.split_first() {
        Some((head, rows)) => table(&head.iter().map(String::as_str).collect::<Vec<_>>(), rows),
        None => String::new(),
    });
    let warning = without_map(&scores).map_or_else(String::new, |warning| format!(" {warning}."));
    let about = format!("Objects of maps judged by where the true ones were, in {} frames.{warning}", scores.frames);
    section("Accuracy of objects", &about, &tables.concat())
}
