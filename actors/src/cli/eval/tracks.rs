//! Objects that move, judged by where they were.

use anyhow::{Context, anyhow};
use ecod::eval::tracks::{AP_DISTANCES_M, ThresholdScores, TrackEvaluation, TrackScores, TrackTruth};
use ecod::replay::FusedLine;
use serde::Serialize;

use super::{EvalArguments, Failure, columns, header, percent, read_output, write_json};

/// What is written beside what came of locations.
#[derive(Serialize)]
struct Judged {
    tracks: TrackScores,
}

pub(super) fn run(arguments: &EvalArguments, text: &str) -> Result<(), Failure> {
    if arguments.reports.is_some() || arguments.config.is_some() {
        return Err(Failure::usage(anyhow!("--reports and --config are for a truth of locations")));
    }
    let path = &arguments.truth;
    let truth = TrackTruth::parse(text).with_context(|| format!("truth {}", path.display())).map_err(Failure::usage)?;
    let mut evaluation = TrackEvaluation::new(truth);
    let mut maps = 0u64;
    read_output(&arguments.input, |line| {
        if let FusedLine::Map(map) = line {
            evaluation.map(&map);
            maps += 1;
        }
    })?;
    if maps == 0 {
        return Err(anyhow!("there is no map in {}", arguments.input.display()).into());
    }
    let scores = evaluation.result();
    if scores.frames_with_map < scores.frames {
        eprintln!(
            "{} of {} frames have no map: their objects are missed",
            scores.frames - scores.frames_with_map,
            scores.frames
        );
    }
    print!("{}", table(&scores));
    if let Some(out) = &arguments.out {
        write_json(out, &Judged { tracks: scores })?;
    }
    Ok(())
}

fn table(scores: &TrackScores) -> String {
    let distances = AP_DISTANCES_M.map(|distance| format!("AP@{distance} %"));
    let mut rows = vec![["", "objects", "said"].map(str::to_owned).into_iter().chain(distances).collect::<Vec<_>>()];
    let all = ["all".to_owned(), scores.objects.to_string(), scores.said.to_string()];
    rows.push(all.into_iter().chain(scores.ap_pct.map(percent)).collect());
    if scores.class_ap_pct.len() > 1 {
        let of_class = scores.class_ap_pct.iter().map(|(label, ap)| {
            [label.to_string(), String::new(), String::new()].into_iter().chain(ap.map(percent)).collect()
        });
        rows.extend(of_class);
    }
    let text = columns(&rows);
    let rows = [
        header(&[
            "at confidence",
            "",
            "F1 %",
            "MODA %",
            "MODP %",
            "MOTA %",
            "IDF1 %",
            "HOTA %",
            "DetA %",
            "AssA %",
            "LocA %",
            "switches",
        ]),
        at("best F1", scores.best_f1_pct, &scores.at_best_f1),
        at("default", None, &scores.at_default),
    ];
    format!("{text}\n{}", columns(&rows))
}

fn at(name: &str, best_f1_pct: Option<f64>, scores: &ThresholdScores) -> Vec<String> {
    let ThresholdScores { matches, false_alarms, misses, .. } = scores;
    let f1 = best_f1_pct.or_else(|| {
        let all = 2 * matches + false_alarms + misses;
        (all > 0).then(|| 200.0 * *matches as f64 / all as f64)
    });
    let shares = [
        f1,
        scores.moda_pct,
        scores.modp_pct,
        scores.mota_pct,
        scores.idf1_pct,
        scores.hota_pct,
        scores.deta_pct,
        scores.assa_pct,
        scores.loca_pct,
    ];
    let named = [name.to_owned(), format!("{:.3}", scores.threshold)];
    named.into_iter().chain(shares.map(percent)).chain([scores.id_switches.to_string()]).collect()
}
