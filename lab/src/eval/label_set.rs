//! Label sets: answers of many voters about many items, judged by VOTE and by the majority.
//!
//! Each item is a landmark and each voter a vehicle. Votes do not become stale, and a voter's last answer
//! about an item replaces earlier ones.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use ecod::model::names::{Label, NodeName};
use ecod::model::time::Timestamp;
use ecod::vote::{MAX_LABELS, Vote, VoteConfig, WeightedConfig};
use ecod::wire::{ObjectReport, PerceivedObject, Verdict};
use hashbrown::HashMap;
use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;

use super::reliability::{JudgedStatement, Reliability};

const START: Timestamp = Timestamp(1_700_000_000_000_000);
const ROUND: Duration = Duration::from_millis(100);

/// One voter's answer about an item.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VoterAnswer {
    /// Index of the voter.
    pub voter: u32,
    /// Index of the label.
    pub label: u32,
    /// Stated confidence, above 0 and up to 1.
    pub confidence: f64,
}

/// The answers about one item.
#[derive(Debug, Clone, PartialEq)]
pub struct LabelledItem {
    /// Name in the file.
    pub name: Label,
    /// At most one answer of each voter.
    pub answers: Vec<VoterAnswer>,
    /// Index of the true label, if the file has one.
    pub truth: Option<u32>,
}

/// A label set that cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum LabelSetError {
    /// The table cannot be read.
    #[error("{0}")]
    Table(String),
    /// A required column is missing.
    #[error(
        "there is no column {0}; the columns are item, voter, label and perhaps confidence and truth"
    )]
    NoColumn(&'static str),
    /// A confidence is no number from 0 to 1, or 0, with which an answer is no vote.
    #[error("line {line}: confidence {text:?} is no number above 0 and up to 1")]
    Confidence {
        /// Line of the file, from 1.
        line: u64,
        /// Content of the cell.
        text: String,
    },
    /// A required cell is empty.
    #[error("line {line}: {column} is empty")]
    Empty {
        /// Line of the file, from 1.
        line: u64,
        /// Name of the column.
        column: &'static str,
    },
    /// Two truths of one item differ.
    #[error("line {line}: item {item:?} has another truth before")]
    TwoTruths {
        /// Line of the file, from 1.
        line: u64,
        /// Name of the item.
        item: String,
    },
    /// There are more labels than VOTE takes.
    #[error("there are {0} labels; at most {MAX_LABELS} are possible")]
    TooManyLabels(usize),
    /// The file has no answers.
    #[error("there is no answer")]
    NoAnswer,
}

/// Answers of many voters about many items.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct LabelSet {
    /// In the order of the file.
    pub items: Vec<LabelledItem>,
    /// Names of the labels in alphabetical order.
    pub labels: Vec<Label>,
    /// Names of the voters in the order of the file.
    pub voters: Vec<Label>,
    /// Answers that a later answer of the same voter about the same item replaced.
    pub replaced: usize,
}

/// The verdict about one item.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ItemVerdict {
    /// Index of the label.
    pub label: u32,
    /// Probability of the label according to the method.
    pub probability: f64,
}

/// How right the decisions of a method are.
#[derive(Debug, Clone, PartialEq)]
pub struct VerdictScores {
    /// Share of right decisions in percent of the items that have a truth.
    pub accuracy_pct: f64,
    /// How often decisions are right, by their stated probability.
    pub reliability: Reliability,
}

fn position(names: &mut HashMap<Label, u32>, name: &str) -> u32 {
    let next = names.len() as u32;
    *names.entry(name.into()).or_insert(next)
}

impl LabelSet {
    /// Reads a table with the columns `item`, `voter` (or `worker`) and `label`, and perhaps
    /// `confidence` and `truth`. Commas, semicolons and tabs separate columns, quotes enclose cells
    /// (RFC 4180). A truth may be on any line of its item. `truths` is the text of a second table
    /// with the columns `item` and `truth`.
    ///
    /// # Errors
    /// Returns a [`LabelSetError`] that names the first line or column that is wrong.
    pub fn parse(text: &str, truths: Option<&str>) -> Result<Self, LabelSetError> {
        let mut reading = LabelSetReader::default();
        reading.read_answers(text)?;
        if let Some(truths) = truths {
            reading.read_truths(truths)?;
        }
        reading.finish()
    }

    /// Number of items that have a truth.
    pub fn judged_items(&self) -> usize {
        self.items
            .iter()
            .filter(|item| item.truth.is_some())
            .count()
    }

    /// Number of answers about all items.
    pub fn answers(&self) -> usize {
        self.items.iter().map(|item| item.answers.len()).sum()
    }

    /// Expected accuracy in percent of the most frequent label, of which one is drawn on a tie.
    pub fn majority_accuracy_pct(&self) -> f64 {
        let chance = |item: &LabelledItem| {
            let mut votes: BTreeMap<u32, usize> = BTreeMap::new();
            for answer in &item.answers {
                *votes.entry(answer.label).or_default() += 1;
            }
            let most = votes.values().max().copied()?;
            let first = votes.values().filter(|count| **count == most).count();
            let is_right = votes.get(&item.truth?) == Some(&most);
            Some(if is_right { 1.0 / first as f64 } else { 0.0 })
        };
        let right: f64 = self.items.iter().filter_map(chance).sum();
        100.0 * right / self.judged_items().max(1) as f64
    }

    /// Decisions of VOTE about all items: `online` item after item in the random order of `seed`,
    /// and after `passes` over all answers.
    pub fn vote(&self, config: &WeightedConfig, seed: u64, passes: u32) -> [Vec<ItemVerdict>; 2] {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut order: Vec<usize> = (0..self.items.len()).collect();
        order.shuffle(&mut rng);
        let mut vote = Vote::new(self.vote_config(config), Vec::new());
        let voters: Vec<NodeName> = (0..self.voters.len()).map(voter_name).collect();
        let labels: Vec<Label> = (0..self.labels.len()).map(label_name).collect();
        let mut sequence = vec![0; voters.len()];
        let mut online = vec![
            ItemVerdict {
                label: 0,
                probability: 0.0
            };
            self.items.len()
        ];
        for (round, item) in (0..).zip(order) {
            let now = START + ROUND * round;
            let mut answers = self.items[item].answers.clone();
            answers.shuffle(&mut rng);
            let landmark = Label::from(item.to_string());
            for answer in answers {
                let voter = answer.voter as usize;
                sequence[voter] += 1;
                let label = labels[answer.label as usize].clone();
                let object = PerceivedObject {
                    landmark: Some(landmark.clone()),
                    ..PerceivedObject::new(label, answer.confidence, 0.0, 0.0)
                };
                let report = ObjectReport {
                    objects: vec![object],
                    ..ObjectReport::new(voters[voter].clone(), sequence[voter], now)
                };
                // The names and numbers are valid, and there is room for all of them.
                let observed = vote.observe(&report, now);
                debug_assert_eq!(observed, Ok(()));
            }
            take(vote.close(now).verdicts, &mut online);
        }
        let mut refined = online.clone();
        if passes > 0 {
            take(vote.refine(passes), &mut refined);
        }
        [online, refined]
    }

    fn vote_config(&self, weighted: &WeightedConfig) -> VoteConfig {
        VoteConfig {
            max_landmarks: self.items.len().max(1),
            max_vehicles: self.voters.len().max(1),
            max_labels: self.labels.len().max(1),
            weighted: WeightedConfig {
                freshness_s: 1e9,
                smoothing_share: 0.0,
                hysteresis: 0.0,
                ..weighted.clone()
            },
            ..VoteConfig::default()
        }
    }

    /// Accuracy and calibration of decisions about all items.
    pub fn judge(&self, decisions: &[ItemVerdict]) -> VerdictScores {
        let judged: Vec<JudgedStatement> = self
            .items
            .iter()
            .zip(decisions)
            .filter_map(|(item, decision)| {
                Some(JudgedStatement {
                    stated: decision.probability,
                    is_right: decision.label == item.truth?,
                })
            })
            .collect();
        let right = judged.iter().filter(|statement| statement.is_right).count();
        VerdictScores {
            accuracy_pct: 100.0 * right as f64 / judged.len().max(1) as f64,
            reliability: Reliability::of(judged),
        }
    }
}

/// The name of a voter in reports: a number, so that any text in a file is valid.
#[expect(clippy::expect_used, reason = "the name is valid for every number")]
fn voter_name(voter: usize) -> NodeName {
    NodeName::new(format!("voter-{voter}")).expect("letters and digits")
}

/// The name of a label in reports: names sort as numbers.
fn label_name(label: usize) -> Label {
    format!("{label:05}").into()
}

/// Stores verdicts as decisions, by the numbers in the names of reports.
fn take(verdicts: impl IntoIterator<Item = Verdict>, decisions: &mut [ItemVerdict]) {
    for verdict in verdicts {
        let item = verdict.landmark.as_str().parse::<usize>();
        let label = verdict.label.as_deref().map(str::parse::<u32>);
        if let (Ok(item), Some(Ok(label))) = (item, label) {
            let all: f64 = verdict.votes.values().sum();
            decisions[item] = ItemVerdict {
                label,
                probability: verdict.score / all.max(f64::MIN_POSITIVE),
            };
        }
    }
}

/// A label set while it is read: names have numbers in the order of the file.
#[derive(Default)]
struct LabelSetReader {
    items: HashMap<Label, u32>,
    voters: HashMap<Label, u32>,
    labels: HashMap<Label, u32>,
    /// By item, in the order of the file.
    answers: Vec<Vec<VoterAnswer>>,
    /// By item.
    truths: HashMap<u32, u32>,
}

impl LabelSetReader {
    fn read_answers(&mut self, text: &str) -> Result<(), LabelSetError> {
        let mut table = Table::new(text)?;
        let item_column = table.column("item")?;
        let voter_column = table
            .column("voter")
            .or_else(|error| table.column("worker").map_err(|_| error))?;
        let label_column = table.column("label")?;
        let confidence_column = table.column("confidence").ok();
        let truth_column = table.column("truth").ok();
        let mut is_empty = true;
        while let Some((line, row)) = table.next_row()? {
            is_empty = false;
            let cell = |column: usize, name: &'static str| match row.get(column) {
                Some(text) if !text.is_empty() => Ok(text),
                _ => Err(LabelSetError::Empty { line, column: name }),
            };
            let item_name = cell(item_column, "item")?;
            let item = position(&mut self.items, item_name);
            let voter = position(&mut self.voters, cell(voter_column, "voter")?);
            let label = position(&mut self.labels, cell(label_column, "label")?);
            let stated = confidence_column.and_then(|column| row.get(column));
            let confidence = match stated {
                None | Some("") => 1.0,
                Some(text) => text
                    .parse()
                    .ok()
                    .filter(|confidence| (0.0..=1.0).contains(confidence) && *confidence > 0.0)
                    .ok_or_else(|| LabelSetError::Confidence {
                        line,
                        text: text.to_owned(),
                    })?,
            };
            self.answers.resize_with(self.items.len(), Vec::new);
            let answer = VoterAnswer {
                voter,
                label,
                confidence,
            };
            self.answers[item as usize].push(answer);
            let truth = truth_column.and_then(|column| row.get(column));
            if let Some(truth) = truth.filter(|truth| !truth.is_empty()) {
                self.add_truth(line, item, item_name, truth)?;
            }
        }
        if is_empty {
            return Err(LabelSetError::NoAnswer);
        }
        Ok(())
    }

    /// Truths of items without answers are left out.
    fn read_truths(&mut self, text: &str) -> Result<(), LabelSetError> {
        let mut table = Table::new(text)?;
        let item_column = table.column("item")?;
        let truth_column = table.column("truth")?;
        while let Some((line, row)) = table.next_row()? {
            let name = row.get(item_column).unwrap_or_default();
            let truth = row.get(truth_column).unwrap_or_default();
            if let Some(&item) = self.items.get(&Label::from(name))
                && !truth.is_empty()
            {
                self.add_truth(line, item, name, truth)?;
            }
        }
        Ok(())
    }

    fn add_truth(
        &mut self,
        line: u64,
        item: u32,
        name: &str,
        truth: &str,
    ) -> Result<(), LabelSetError> {
        let label = position(&mut self.labels, truth);
        match self.truths.insert(item, label) {
            Some(before) if before != label => Err(LabelSetError::TwoTruths {
                line,
                item: name.to_owned(),
            }),
            _ => Ok(()),
        }
    }

    /// Numbers labels in alphabetical order, which decides ties.
    fn finish(self) -> Result<LabelSet, LabelSetError> {
        if self.labels.len() > MAX_LABELS {
            return Err(LabelSetError::TooManyLabels(self.labels.len()));
        }
        let labels: BTreeSet<&Label> = self.labels.keys().collect();
        let mut number = vec![0; labels.len()];
        for (place, name) in (0..).zip(&labels) {
            number[self.labels[*name] as usize] = place;
        }
        let labels = labels.into_iter().cloned().collect();
        let mut replaced = 0;
        let mut items = Vec::with_capacity(self.answers.len());
        for (index, (name, all)) in (0..).zip(in_order(self.items).into_iter().zip(self.answers)) {
            let before = all.len();
            let mut answers = last_answers(all);
            replaced += before - answers.len();
            for answer in &mut answers {
                answer.label = number[answer.label as usize];
            }
            let truth = self.truths.get(&index);
            items.push(LabelledItem {
                name,
                answers,
                truth: truth.map(|label| number[*label as usize]),
            });
        }
        Ok(LabelSet {
            items,
            labels,
            voters: in_order(self.voters),
            replaced,
        })
    }
}

/// Names in the order of their numbers.
fn in_order(names: HashMap<Label, u32>) -> Vec<Label> {
    let mut sorted: Vec<_> = names.into_iter().collect();
    sorted.sort_unstable_by_key(|(_, number)| *number);
    sorted.into_iter().map(|(name, _)| name).collect()
}

#[expect(
    clippy::needless_pass_by_value,
    reason = "as `Result::map_err` passes it"
)]
fn unreadable(error: csv::Error) -> LabelSetError {
    LabelSetError::Table(error.to_string())
}

/// The last answer of each voter, by voter.
fn last_answers(mut answers: Vec<VoterAnswer>) -> Vec<VoterAnswer> {
    answers.reverse();
    answers.sort_by_key(|answer| answer.voter);
    answers.dedup_by_key(|answer| answer.voter);
    answers.shrink_to_fit();
    answers
}

/// A table with a header, which is read row after row.
struct Table<'a> {
    header: Vec<String>,
    reader: csv::Reader<&'a [u8]>,
    row: csv::StringRecord,
}

impl<'a> Table<'a> {
    /// The separator is the most frequent of comma, semicolon and tab in the first line.
    fn new(text: &'a str) -> Result<Self, LabelSetError> {
        let text = text.trim_start_matches('\u{feff}');
        let first = text.lines().next().unwrap_or_default();
        let count = |separator: u8| first.bytes().filter(|byte| *byte == separator).count();
        let separator = [b'\t', b';', b','].into_iter().max_by_key(|s| count(*s));
        let mut reader = csv::ReaderBuilder::new()
            .delimiter(separator.unwrap_or(b','))
            .trim(csv::Trim::All)
            .flexible(true)
            .from_reader(text.as_bytes());
        let header = reader
            .headers()
            .map_err(unreadable)?
            .iter()
            .map(str::to_lowercase)
            .collect();
        Ok(Self {
            header,
            reader,
            row: csv::StringRecord::new(),
        })
    }

    /// The next row and its line in the file, from 1.
    fn next_row(&mut self) -> Result<Option<(u64, &csv::StringRecord)>, LabelSetError> {
        if !self.reader.read_record(&mut self.row).map_err(unreadable)? {
            return Ok(None);
        }
        let line = self.row.position().map_or(0, csv::Position::line);
        Ok(Some((line, &self.row)))
    }

    fn column(&self, name: &'static str) -> Result<usize, LabelSetError> {
        let place = self.header.iter().position(|column| column == name);
        place.ok_or(LabelSetError::NoColumn(name))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PLAIN: &str = "item,voter,label,truth\nx,a,cup,cup\nx,b,mouse,\ny,a,cup,mouse\n";

    #[test]
    fn table_layouts_give_equal_sets() {
        let plain = LabelSet::parse(PLAIN, None).unwrap();
        assert_eq!(plain.labels, ["cup", "mouse"]);
        assert_eq!((plain.items.len(), plain.judged_items()), (2, 2));
        let semicolons = format!("\u{feff}{}", PLAIN.replace(',', ";").replace('\n', "\r\n"));
        assert_eq!(LabelSet::parse(&semicolons, None).unwrap(), plain);
        let quoted = PLAIN.replace("cup", "\"cup\"").replace("voter", "Worker");
        assert_eq!(LabelSet::parse(&quoted, None).unwrap(), plain);
        let accented = PLAIN.replace("cup", "caf\u{e9}");
        let decomposed = PLAIN
            .replacen("cup", "cafe\u{301}", 1)
            .replace("cup", "caf\u{e9}");
        assert_eq!(
            LabelSet::parse(&decomposed, None).unwrap(),
            LabelSet::parse(&accented, None).unwrap(),
            "forms of Unicode"
        );
        let answers = "item,voter,label\nx,a,cup\nx,b,mouse\ny,a,cup\n";
        let truths = "item,truth\nx,cup\ny,mouse\nz,cup\n";
        assert_eq!(LabelSet::parse(answers, Some(truths)).unwrap(), plain);
    }

    #[test]
    fn later_answer_replaces_earlier() {
        let set = LabelSet::parse("item,voter,label\nx,a,cup\nx,a,mouse\n", None).unwrap();
        assert_eq!(set.replaced, 1);
        let label = set.items[0].answers[0].label;
        assert_eq!((set.answers(), &*set.labels[label as usize]), (1, "mouse"));
    }

    #[test]
    fn errors_name_line_and_column() {
        let error = |text: &str| LabelSet::parse(text, None).unwrap_err().to_string();
        assert!(error("item,label\nx,cup\n").contains("column voter"));
        assert_eq!(
            error("item,voter,label\nx,,cup\n"),
            "line 2: voter is empty"
        );
        assert_eq!(
            error("item,voter,label,confidence\nx,a,cup,1\nx,b,cup,2\n"),
            "line 3: confidence \"2\" is no number above 0 and up to 1"
        );
        assert_eq!(
            error("item,voter,label,truth\nx,a,cup,cup\nx,b,cup,mouse\n"),
            "line 3: item \"x\" has another truth before"
        );
        assert_eq!(error("item,voter,label\n"), "there is no answer");
    }

    #[test]
    fn vote_detects_mostly_wrong_voter() {
        let mut text = "item,voter,label,truth\n".to_owned();
        for item in 0..60 {
            let truth = ["cup", "mouse"][item % 2];
            let wrong = ["mouse", "cup"][item % 2];
            text += &format!("{item},a,{truth},{truth}\n{item},b,{truth},\n");
            let third = if item % 5 == 0 { truth } else { wrong };
            text += &format!("{item},c,{third},\n");
        }
        let set = LabelSet::parse(&text, None).unwrap();
        assert_eq!(set.majority_accuracy_pct(), 100.0);
        let [online, refined] = set.vote(&WeightedConfig::default(), 1, 10);
        for decisions in [online, refined] {
            assert_eq!(set.judge(&decisions).accuracy_pct, 100.0);
        }
    }
}
