//! `ecod-lab eval-labels`: VOTE on a label set beside the majority.

use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::Args;
use ecod_actors::cli::lines::check_apart;
use ecod_actors::cli::{Failure, cell};
use ecod_actors::platform::bounded_file;

use super::columns::columns;
use crate::eval::label_set::{ItemVerdict, LabelSet, VerdictScores};
use crate::report::tracks::reliability;

/// Flags of `eval-labels`.
#[derive(Debug, Args)]
pub(super) struct EvalLabelsArguments {
    /// Table of answers (CSV) with the columns item, voter, label and perhaps confidence (0 to 1)
    /// and truth; the separator is a comma, a semicolon or a tab
    #[arg(value_name = "FILE")]
    answers: PathBuf,
    /// Table of truths (CSV) with the columns item and truth
    #[arg(long, value_name = "FILE")]
    truth: Option<PathBuf>,
    /// Configuration of the cell (TOML), of which `fusion.vote.weighted` is used
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Passes over all answers
    #[arg(long, value_name = "N", default_value_t = 50)]
    passes: u32,
    /// Random orders of the items, of which the table shows mean and range
    #[arg(long, value_name = "N", default_value_t = 3, value_parser = clap::value_parser!(u64).range(1..=1000))]
    orders: u64,
    /// Write the labels after all passes to this file (CSV), with their probabilities
    #[arg(short, long = "output", alias = "out", value_name = "FILE")]
    out: Option<PathBuf>,
}

pub(super) fn run(arguments: &EvalLabelsArguments) -> Result<(), Failure> {
    let inputs: Vec<&PathBuf> = [Some(&arguments.answers), arguments.truth.as_ref()]
        .into_iter()
        .flatten()
        .collect();
    if let Some(out) = &arguments.out {
        check_apart(out, &inputs).map_err(Failure::usage)?;
    }
    let config = cell(arguments.config.as_deref())?.fusion.vote.weighted;
    let set = read_set(arguments)?;
    println!(
        "{} items ({} with a truth), {} answers of {} voters, {} labels",
        set.items.len(),
        set.judged_items(),
        set.answers(),
        set.voters.len(),
        set.labels.len(),
    );
    if set.replaced > 0 {
        println!(
            "{} answers were replaced by a later answer of the same voter about the same item",
            set.replaced
        );
    }
    let mut online = Vec::new();
    let mut refined = Vec::new();
    let mut decisions = Vec::new();
    for seed in 1..=arguments.orders {
        let [in_order, after_passes] = set.vote(&config, seed, arguments.passes);
        online.push(set.judge(&in_order));
        refined.push(set.judge(&after_passes));
        decisions = after_passes;
    }
    if set.judged_items() > 0 {
        print!("\n{}", accuracy(&set, &online, &refined));
        if let Some(of_last) = refined.last() {
            let rows = reliability("after passes", &of_last.reliability);
            print!("\n{}", columns(&rows));
        }
    }
    if let Some(out) = &arguments.out {
        write(out, &set, &decisions)?;
    }
    Ok(())
}

fn read_set(arguments: &EvalLabelsArguments) -> Result<LabelSet, Failure> {
    let answers = read(&arguments.answers)?;
    let truths = arguments.truth.as_deref().map(read).transpose()?;
    LabelSet::parse(&answers, truths.as_deref())
        .with_context(|| arguments.answers.display().to_string())
        .map_err(Failure::usage)
}

/// Tables may be large, but are read whole; a byte order mark is left to the parser.
fn read(path: &Path) -> Result<String, Failure> {
    bounded_file::read_text(path)
        .with_context(|| format!("cannot read {}", path.display()))
        .map_err(Failure::usage)
}

/// Accuracy and calibration of the majority and of VOTE.
fn accuracy(set: &LabelSet, online: &[VerdictScores], refined: &[VerdictScores]) -> String {
    let header = [
        "method",
        "accuracy %",
        "lowest",
        "highest",
        "calibration error %",
    ];
    let majority = format!("{:.2}", set.majority_accuracy_pct());
    let mut rows = vec![
        header.map(str::to_owned).to_vec(),
        vec!["majority".to_owned(), majority],
    ];
    for (name, judged) in [("VOTE, one pass", online), ("VOTE, with passes", refined)] {
        let orders = judged.len() as f64;
        let accuracies = judged.iter().map(|scores| scores.accuracy_pct);
        let errors: f64 = judged
            .iter()
            .filter_map(|scores| scores.reliability.ece_pct)
            .sum();
        rows.push(vec![
            name.to_owned(),
            format!("{:.2}", accuracies.clone().sum::<f64>() / orders),
            format!("{:.2}", accuracies.clone().fold(f64::INFINITY, f64::min)),
            format!("{:.2}", accuracies.fold(0.0, f64::max)),
            format!("{:.1}", errors / orders),
        ]);
    }
    columns(&rows)
}

fn write(path: &Path, set: &LabelSet, decisions: &[ItemVerdict]) -> anyhow::Result<()> {
    let cannot_write = || format!("cannot write {}", path.display());
    let mut writer = csv::Writer::from_path(path).with_context(cannot_write)?;
    writer.write_record(["item", "label", "probability", "truth"])?;
    for (item, decision) in set.items.iter().zip(decisions) {
        let label = |index: u32| set.labels[index as usize].as_str();
        let probability = format!("{:.4}", decision.probability);
        writer.write_record([
            item.name.as_str(),
            label(decision.label),
            &probability,
            item.truth.map_or("", label),
        ])?;
    }
    writer.flush().with_context(cannot_write)
}
