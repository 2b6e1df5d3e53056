//! Accuracy of maps and verdicts, compared to majority vote and to every vehicle alone.
//!
//! An item is one location for as long as its truth stays constant. It is evaluated by the last
//! label given for it in that time (`null` without a label), or, if no object stands there, by the
//! last entry. In addition, every entry of every line counts in [`Scores::rounds`]. Baselines need
//! the reports: all votes on an item have equal weight, a vehicle alone is the majority of its own
//! votes, and ties count as the chance of drawing the right label among the most frequent ones.
//!
//! Call [`Evaluation::fused`] with every line of a replay's output and, for the baselines,
//! [`Evaluation::report`] with every report, in any order; then [`Evaluation::result`].

pub mod baselines;
pub mod formats;
pub mod label_set;
mod reliability;
pub mod tracks;
mod truth;
mod votes;

use std::collections::BTreeMap;

use ecod::model::names::{Label, LandmarkId, NodeName};
use ecod::model::time::Timestamp;
use ecod::perception::landmark::{LandmarkGate, LandmarkIndex};
use ecod::replay::FusedLine;
use ecod::wire::{ObjectReport, ReportKind};
use serde::Serialize;

pub use reliability::{Reliability, ReliabilityBin};
pub use truth::{Truth, TruthError};
pub use votes::VehicleScores;

use truth::LabelSpan;
use votes::Votes;

/// A location and the position of a span among its truths.
type Item = (LandmarkId, usize);

/// Result of an evaluation.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct EvalResult {
    /// Of maps; absent without any map or PACE report.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pace: Option<Scores>,
    /// Of verdicts; absent without any verdict or VOTE report.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub vote: Option<Scores>,
}

/// Accuracy of one algorithm. Shares are percentages; `None` without evaluated items.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Scores {
    /// Maps, or sets of verdicts, that were read.
    pub lines: u64,
    /// Evaluated items: all items in the truth to which a line could refer.
    pub items: u64,
    /// Share of right items; an item without a label is right only if no object stands there.
    pub accuracy_pct: Option<f64>,
    /// Share of items with a label among the items with an object.
    pub coverage_pct: Option<f64>,
    /// Share of right items among the items with a label.
    pub labelled_accuracy_pct: Option<f64>,
    /// Every entry of every line.
    pub rounds: RoundScores,
    /// Expected accuracy of the majority of all votes; with reports only.
    pub majority_accuracy_pct: Option<f64>,
    /// Every vehicle alone; with reports only.
    pub vehicles: BTreeMap<NodeName, VehicleScores>,
    /// Right items of every class.
    pub recall: Vec<ClassRecall>,
    /// Mean of the classes' recalls, each class alike however frequent.
    pub mean_recall_pct: Option<f64>,
    /// Confusion matrix by item, correct labels included.
    pub confusion: Vec<ConfusionCell>,
}

/// Items of one class.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ClassRecall {
    /// The first accepted label; null if no object stands there.
    pub truth: Option<Label>,
    /// Number of items of this class.
    pub items: u64,
    /// Share of right items in percent.
    pub recall_pct: Option<f64>,
}

/// Entries of all lines.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct RoundScores {
    /// Entries with a truth.
    pub entries: u64,
    /// Number of entries that agree with their truth.
    pub right: u64,
    /// Share of right entries in percent.
    pub accuracy_pct: Option<f64>,
}

/// One cell of a confusion matrix.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct ConfusionCell {
    /// The first accepted label; null if no object stands there.
    pub truth: Option<Label>,
    /// The given label; null without a label.
    pub said: Option<Label>,
    /// Number of items in this cell.
    pub count: u64,
}

/// Evaluates a replay's output and its reports; see the module.
#[derive(Debug, Clone)]
pub struct Evaluation {
    truth: Truth,
    cell: Option<(LandmarkIndex, LandmarkGate)>,
    synonyms: BTreeMap<Label, Label>,
    pace: Tally,
    vote: Tally,
}

#[derive(Debug, Clone, Default)]
struct Tally {
    lines: u64,
    rounds: RoundScores,
    /// By item the last label given, and the last entry.
    last: BTreeMap<Item, Last>,
    votes: Votes,
}

#[derive(Debug, Clone, Default)]
struct Last {
    labelled: Option<Label>,
    entry: Option<Label>,
}

impl Scores {
    /// The shares of a summary's row in percent: accuracy, coverage, accuracy of labelled items,
    /// accuracy of all lines, and accuracy of the majority.
    pub fn shares_pct(&self) -> [Option<f64>; 5] {
        let Self {
            accuracy_pct,
            coverage_pct,
            labelled_accuracy_pct,
            rounds,
            majority_accuracy_pct,
            ..
        } = self;
        [
            *accuracy_pct,
            *coverage_pct,
            *labelled_accuracy_pct,
            rounds.accuracy_pct,
            *majority_accuracy_pct,
        ]
    }
}

impl Evaluation {
    /// An evaluation without any input yet.
    pub fn new(truth: Truth) -> Self {
        Self {
            truth,
            cell: None,
            synonyms: BTreeMap::new(),
            pace: Tally::default(),
            vote: Tally::default(),
        }
    }

    /// Names the location of objects whose report does not, and translates synonyms, as a node of
    /// the cell would.
    #[must_use]
    pub fn with_landmarks(mut self, landmarks: LandmarkIndex, gate: LandmarkGate) -> Self {
        self.cell = Some((landmarks, gate));
        self
    }

    /// Translates votes by the cell's synonyms, like VOTE at a location without synonyms of its
    /// own.
    #[must_use]
    pub fn with_synonyms(mut self, synonyms: BTreeMap<Label, Label>) -> Self {
        self.synonyms = synonyms;
        self
    }

    /// Evaluates one line of output.
    pub fn fused(&mut self, line: &FusedLine) {
        match line {
            FusedLine::Map(map) => {
                let entries = map
                    .landmarks
                    .iter()
                    .map(|state| (&state.id, state.label.as_ref()));
                self.pace.judge(&self.truth, map.fused_at_us, entries);
            }
            FusedLine::Verdicts(verdicts) => {
                let entries = verdicts
                    .verdicts
                    .iter()
                    .map(|verdict| (&verdict.landmark, verdict.label.as_ref()));
                self.vote.judge(&self.truth, verdicts.fused_at_us, entries);
            }
        }
    }

    /// True if a line so far is on a location of the truth at its time.
    pub fn matches_truth(&self) -> bool {
        self.pace.rounds.entries + self.vote.rounds.entries > 0
    }

    /// Counts one report's votes, at the time of its capture.
    pub fn report(&mut self, kind: ReportKind, report: &ObjectReport) {
        let (votes, synonyms) = match kind {
            ReportKind::Detections => (&mut self.pace.votes, None),
            ReportKind::VoteDetections => (&mut self.vote.votes, Some(&self.synonyms)),
        };
        for object in &report.objects {
            let place = self
                .cell
                .as_ref()
                .and_then(|(landmarks, gate)| votes::place(object, landmarks, gate));
            let Some(id) = object
                .landmark
                .as_ref()
                .or(place.map(|landmark| &landmark.id))
            else {
                continue;
            };
            let synonym = place.and_then(|place| place.synonym(&object.label));
            let label = synonym
                .or_else(|| synonyms?.get(&object.label))
                .unwrap_or(&object.label);
            if let Some((span, truth)) = self.truth.at(id, report.captured_at_us) {
                votes.count(
                    &report.node,
                    (id.clone(), span),
                    label,
                    self.truth.accepts(truth, Some(label)),
                );
            }
        }
    }

    /// The figures so far.
    pub fn result(&self) -> EvalResult {
        EvalResult {
            pace: self.pace.scores(&self.truth),
            vote: self.vote.scores(&self.truth),
        }
    }
}

impl Tally {
    fn judge<'a>(
        &mut self,
        truth: &Truth,
        at: Timestamp,
        entries: impl Iterator<Item = (&'a LandmarkId, Option<&'a Label>)>,
    ) {
        self.lines += 1;
        for (id, label) in entries {
            let Some((number, span)) = truth.at(id, at) else {
                continue;
            };
            self.rounds.entries += 1;
            self.rounds.right += u64::from(truth.accepts(span, label));
            let last = self.last.entry((id.clone(), number)).or_default();
            last.entry = label.cloned();
            if label.is_some() {
                last.labelled = label.cloned();
            }
        }
    }

    fn scores(&self, truth: &Truth) -> Option<Scores> {
        if self.lines == 0 && self.votes.is_empty() {
            return None;
        }
        let mut items = 0;
        let mut right = 0;
        let mut labelled = 0;
        let mut labelled_right = 0;
        let mut standing = 0;
        let mut covered = 0;
        let mut classes: BTreeMap<Option<Label>, (u64, u64)> = BTreeMap::new();
        let mut confusion: BTreeMap<(Option<Label>, Option<Label>), u64> = BTreeMap::new();
        for (id, number, span) in truth.spans() {
            let said = self
                .last
                .get(&(id.clone(), number))
                .and_then(|last| last.label_in(truth, span));
            let is_right = u64::from(truth.accepts(span, said));
            items += 1;
            right += is_right;
            if said.is_some() {
                labelled += 1;
                labelled_right += is_right;
            }
            if !truth.accepts(span, None) {
                standing += 1;
                covered += u64::from(said.is_some());
            }
            let of_class = classes.entry(span.name().cloned()).or_default();
            *of_class = (of_class.0 + 1, of_class.1 + is_right);
            *confusion
                .entry((span.name().cloned(), said.cloned()))
                .or_default() += 1;
        }
        let entry = |((truth, said), count)| ConfusionCell { truth, said, count };
        let recalls = classes
            .values()
            .map(|&(items, right)| right as f64 / items as f64);
        let mean_recall_pct = percent(recalls.sum(), classes.len() as u64);
        let of_class = |(truth, (items, right))| ClassRecall {
            truth,
            items,
            recall_pct: percent(right as f64, items),
        };
        Some(Scores {
            lines: self.lines,
            items,
            accuracy_pct: percent(right as f64, items),
            coverage_pct: percent(covered as f64, standing),
            labelled_accuracy_pct: percent(labelled_right as f64, labelled),
            rounds: RoundScores {
                accuracy_pct: percent(self.rounds.right as f64, self.rounds.entries),
                ..self.rounds
            },
            majority_accuracy_pct: self.votes.majority_accuracy_pct(truth),
            vehicles: self.votes.vehicles(truth),
            mean_recall_pct,
            recall: classes.into_iter().map(of_class).collect(),
            confusion: confusion.into_iter().map(entry).collect(),
        })
    }
}

impl Last {
    fn label_in(&self, truth: &Truth, span: &LabelSpan) -> Option<&Label> {
        if truth.accepts(span, None) {
            self.entry.as_ref()
        } else {
            self.labelled.as_ref()
        }
    }
}

fn percent(part: f64, whole: u64) -> Option<f64> {
    (whole > 0).then(|| 100.0 * part / whole as f64)
}

#[cfg(test)]
mod tests;
