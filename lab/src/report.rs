//! The page about a log, with sections on the accuracy of maps and verdicts, by the given truth.

pub(crate) mod tracks;

use ecod::perception::landmark::{Landmark, LandmarkIndex};
use ecod::replay::FusedLine;
use ecod::wire::{ObjectReport, ReportKind};
use ecod_actors::observe::recorder::LogIdentity;
use ecod_actors::observe::report::{Report, Section, bars, drawing, section, table};

use crate::eval::tracks::{TrackEvaluation, TrackTruth};
use crate::eval::{Evaluation, Scores, Truth};
use tracks::{tables, without_map};

/// A report that evaluates maps and verdicts by the true object at each location.
pub fn judged_by(truth: Truth) -> Report {
    Report::with_section(Locations(Evaluation::new(truth)))
}

/// A report that evaluates the objects of maps by their true positions.
pub fn judged_by_tracks(truth: TrackTruth) -> Report {
    Report::with_section(Objects(TrackEvaluation::new(truth)))
}

/// Accuracy at landmarks.
#[derive(Debug)]
struct Locations(Evaluation);

impl Section for Locations {
    fn identity(&mut self, identity: &LogIdentity) {
        // Each file may have been written under another configuration.
        let landmarks: Vec<_> = identity.landmarks.iter().map(Landmark::from).collect();
        let gate = identity.fusion.pace.gate();
        let evaluation = self
            .0
            .clone()
            .with_landmarks(LandmarkIndex::new(landmarks, gate.radius_m), gate);
        self.0 = evaluation.with_synonyms(identity.fusion.vote.synonyms.clone());
    }

    fn report(&mut self, kind: ReportKind, report: &ObjectReport) {
        self.0.report(kind, report);
    }

    fn round(&mut self, round: &FusedLine) {
        self.0.fused(round);
    }

    fn html(&self) -> String {
        let result = self.0.result();
        let percent =
            |share: Option<f64>| share.map_or("-".to_owned(), |share| format!("{share:.1}"));
        let row = |name: &str, scores: &Scores| {
            let cells = [
                name.to_owned(),
                scores.lines.to_string(),
                scores.items.to_string(),
            ];
            cells
                .into_iter()
                .chain(scores.shares_pct().map(percent))
                .collect::<Vec<_>>()
        };
        let judged = [("PACE", &result.pace), ("VOTE", &result.vote)];
        let rows: Vec<_> = judged
            .iter()
            .filter_map(|(name, scores)| Some(row(name, scores.as_ref()?)))
            .collect();
        let head = [
            "",
            "rounds",
            "items",
            "accuracy %",
            "coverage %",
            "labelled %",
            "all rounds %",
            "majority %",
        ];
        let mut text = table(&head, &rows);
        for (name, scores) in judged
            .iter()
            .filter_map(|(name, scores)| Some((name, scores.as_ref()?)))
        {
            let alone: Vec<_> = scores.vehicles.iter().collect();
            let shares: Vec<_> = alone
                .iter()
                .filter_map(|(node, alone)| Some((node.to_string(), alone.accuracy_pct?)))
                .collect();
            if !shares.is_empty() {
                let title = format!("{name}: accuracy of every vehicle alone");
                text += &format!("<h3>{title}</h3>\n{}", drawing(&bars(&title, &shares)));
            }
        }
        section(
            "Accuracy",
            "Judged by the truth that was given; an item is a location while its truth stays.",
            &text,
        )
    }
}

/// Accuracy of objects that move.
#[derive(Debug)]
struct Objects(TrackEvaluation);

impl Section for Objects {
    fn identity(&mut self, _identity: &LogIdentity) {}

    fn report(&mut self, _kind: ReportKind, _report: &ObjectReport) {}

    fn round(&mut self, round: &FusedLine) {
        if let FusedLine::Map(map) = round {
            self.0.map(map);
        }
    }

    fn html(&self) -> String {
        let scores = self.0.clone().result();
        let tables: String = tables(&scores)
            .iter()
            .filter_map(|rows| rows.split_first())
            .map(|(head, rows)| table(&head.iter().map(String::as_str).collect::<Vec<_>>(), rows))
            .collect();
        let warning =
            without_map(&scores).map_or_else(String::new, |warning| format!(" {warning}."));
        let about = format!(
            "Objects of maps judged by where the true ones were, in {} frames.{warning}",
            scores.frames
        );
        section("Accuracy of objects", &about, &tables)
    }
}
