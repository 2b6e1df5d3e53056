//! `ecod-lab testbed` with recorded detections: the recording, and scenes generated from its
//! detectors' confusions.

use std::fs;

use anyhow::Context;
use ecod::model::names::Label;
use ecod::wire::ReportKind;
use ecod_actors::cli::{Failure, print};
use tracing::subscriber::NoSubscriber;

use super::{Results, TestbedArguments, check_writable};
use crate::cli::columns::columns;
use crate::cli::write_json;
use crate::report::tracks::percent;
use crate::testbed::IntersectionRecording;
use crate::testbed::intersection::generate::ConfusionModel;
use crate::testbed::intersection::{self, IntersectionResult};

const RECORDING: &str = "recording";
const GENERATED: &str = "generated";

pub(super) fn run(arguments: &TestbedArguments, text: &str) -> Result<(), Failure> {
    let path = arguments.scenes.display();
    let recording = IntersectionRecording::from_json(text)
        .with_context(|| format!("scenes {path}"))
        .map_err(Failure::usage)?;
    if recording.objects.is_empty() || recording.frame_count() == 0 {
        return Err(Failure::usage(anyhow::anyhow!(
            "scenes {path}: nothing was recorded"
        )));
    }
    let is_chosen = |name| {
        arguments
            .scene
            .as_deref()
            .is_none_or(|chosen| chosen == name)
    };
    if !is_chosen(RECORDING) && !is_chosen(GENERATED) {
        let chosen = arguments.scene.as_deref().unwrap_or_default();
        return Err(Failure::usage(anyhow::anyhow!(
            "no scene {chosen:?}; there are {RECORDING}, {GENERATED}"
        )));
    }
    if let Some(out) = &arguments.out {
        check_writable(out)?;
    }
    let mut results = Vec::new();
    if is_chosen(RECORDING) {
        results.push(intersection::run(RECORDING, &recording)?);
    }
    if is_chosen(GENERATED) {
        // Losses of the recording are reported, losses of its copies are not.
        let generate = || generated(arguments, &recording);
        results.extend(tracing::subscriber::with_default(
            NoSubscriber::new(),
            generate,
        )?);
    }
    print(&table(&results))?;
    if let Some(file) = &arguments.reports {
        let reports = intersection::reports(&recording);
        let of_votes = |report| intersection::line(report, ReportKind::VoteDetections);
        let lines = reports.iter().map(of_votes).collect::<Result<Vec<_>, _>>();
        let text = lines.context("reports are plain json")?.join("\n") + "\n";
        fs::write(file, text).with_context(|| format!("cannot write {}", file.display()))?;
    }
    if let Some(out) = &arguments.out {
        write_json(out, &Results { scenes: &results })?;
    }
    // Generated scenes are harder than the recording: the limit applies to them only if they are
    // run alone.
    let least = arguments.at_least.unwrap_or(0.0);
    match results.first() {
        Some(scene) if scene.vote_accuracy_pct < least => Err(anyhow::anyhow!(
            "scene {}: fewer than {least} % of the verdicts are right",
            scene.name
        )
        .into()),
        _ => Ok(()),
    }
}

fn generated(
    arguments: &TestbedArguments,
    recording: &IntersectionRecording,
) -> anyhow::Result<Option<IntersectionResult>> {
    let confusion = ConfusionModel::of(recording);
    let mut scenes = Vec::new();
    for number in 0..arguments.generated {
        let scene = confusion.scene(arguments.seed.wrapping_add(number), arguments.frames.into());
        scenes.push(
            intersection::run(GENERATED, &scene)
                .with_context(|| format!("generated scene {number}"))?,
        );
    }
    Ok(IntersectionResult::mean(GENERATED, &scenes))
}

fn table(results: &[IntersectionResult]) -> String {
    let header = [
        "",
        "scenes",
        "verdicts",
        "VOTE %",
        "PACE %",
        "one answer %",
        "paper %",
        "majority %",
        "best alone %",
    ];
    let mut rows = vec![header.map(str::to_owned).to_vec()];
    for result in results {
        let best = result
            .single_cav_accuracy_pct
            .values()
            .copied()
            .max_by(f64::total_cmp);
        let alone = [
            result.vote_accuracy_pct,
            result.pace_accuracy_pct,
            result.answer_accuracy_pct,
        ];
        let others = [result.vote_paper_accuracy_pct, result.majority_accuracy_pct];
        let shares = alone
            .into_iter()
            .chain(others)
            .map(Some)
            .chain([best])
            .map(percent);
        let counts = [
            result.name.clone(),
            result.scenes.to_string(),
            result.verdicts.to_string(),
        ];
        rows.push(counts.into_iter().chain(shares).collect());
    }
    let mut text = columns(&rows);
    for result in results {
        let alone = result
            .single_cav_accuracy_pct
            .iter()
            .map(|(name, pct)| format!("{name} {pct:.1}"));
        text += &format!(
            "\n{} alone %: {}",
            result.name,
            alone.collect::<Vec<_>>().join(", ")
        );
    }
    text.push('\n');
    for result in results {
        for verdict in &result.labels {
            let label = verdict.label.as_ref().map_or("-", Label::as_str);
            let mark = if verdict.right { "right" } else { "WRONG" };
            text += &format!(
                "frame {}  {}: {label}, {mark}\n",
                verdict.frame, verdict.landmark
            );
        }
    }
    text
}
