//! Several methods in one table: the mean of each method's runs, with their standard deviation.

use std::fs;
use std::path::Path;

use anyhow::Context;
use ecod_actors::cli::Failure;
use serde::Serialize;

use super::{Evaluated, MethodFile, columns, write_json};
use crate::eval::Scores;
use crate::eval::tracks::{AP_DISTANCES_M, TrackScores};

/// One file of a method, and its figures in the order of the table's columns.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(super) struct Run {
    method: String,
    file: String,
    figures: Vec<Figure>,
}

/// A figure of a run; `None` if the input does not have it.
#[derive(Debug, Clone, PartialEq, Serialize)]
struct Figure {
    name: String,
    value: Option<f64>,
}

/// The figures of a file; PACE and VOTE of locations are methods of their own.
pub(super) fn runs(input: &MethodFile, evaluated: &Evaluated) -> Vec<Run> {
    let run = |method: String, figures| Run {
        method,
        file: input.path.display().to_string(),
        figures,
    };
    match evaluated {
        Evaluated::Tracks(scores) => vec![run(input.method(), of_tracks(scores))],
        Evaluated::Locations(result) => [("PACE", &result.pace), ("VOTE", &result.vote)]
            .into_iter()
            .filter_map(|(algorithm, scores)| {
                let method = format!("{}, {algorithm}", input.method());
                Some(run(method, of_locations(scores.as_ref()?)))
            })
            .collect(),
    }
}

fn figure(name: impl Into<String>, value: Option<f64>) -> Figure {
    Figure {
        name: name.into(),
        value,
    }
}

fn of_locations(scores: &Scores) -> Vec<Figure> {
    vec![
        figure("accuracy %", scores.accuracy_pct),
        figure("coverage %", scores.coverage_pct),
        figure("labelled %", scores.labelled_accuracy_pct),
        figure("all lines %", scores.rounds.accuracy_pct),
        figure("mean recall %", scores.mean_recall_pct),
    ]
}

fn of_tracks(scores: &TrackScores) -> Vec<Figure> {
    let at_default = &scores.at_default;
    let precision = AP_DISTANCES_M.iter().zip(scores.ap_pct);
    precision
        .map(|(distance, ap_pct)| figure(format!("AP@{distance} %"), ap_pct))
        .chain([
            figure("best F1 %", scores.best_f1_pct),
            figure("MODA %", at_default.moda_pct),
            figure("MOTA %", at_default.mota_pct),
            figure("IDF1 %", at_default.idf1_pct),
            figure("HOTA %", at_default.hota_pct),
            figure("switches", Some(at_default.id_switches as f64)),
            figure("calibration error %", scores.calibration.confidence.ece_pct),
        ])
        .collect()
}

/// Prints the table, and writes it to `out`: CSV with a row for each run, LaTeX with a row for each
/// method, or JSON.
pub(super) fn print(runs: &[Run], out: Option<&Path>) -> Result<(), Failure> {
    let rows = table(runs);
    print!("{}", columns(&rows));
    let Some(out) = out else {
        return Ok(());
    };
    match out.extension().and_then(|extension| extension.to_str()) {
        Some("csv") => write_csv(out, runs)?,
        Some("tex") => {
            fs::write(out, latex(&rows))
                .with_context(|| format!("cannot write {}", out.display()))?;
        }
        _ => write_json(out, &runs)?,
    }
    Ok(())
}

/// A row for each method under a header, in the order in which the methods were given.
fn table(runs: &[Run]) -> Vec<Vec<String>> {
    let Some(first) = runs.first() else {
        return Vec::new();
    };
    let names = first.figures.iter().map(|figure| figure.name.clone());
    let mut rows = vec![
        ["".to_owned(), "runs".to_owned()]
            .into_iter()
            .chain(names)
            .collect(),
    ];
    let mut methods: Vec<&str> = Vec::new();
    for run in runs {
        if !methods.contains(&run.method.as_str()) {
            methods.push(&run.method);
        }
    }
    for method in methods {
        let of_method: Vec<_> = runs.iter().filter(|run| run.method == method).collect();
        let mut row: Vec<String> = vec![method.to_owned(), of_method.len().to_string()];
        for place in 0..first.figures.len() {
            let values = of_method.iter().map(|run| run.figures.get(place)?.value);
            row.push(spread(
                &values.collect::<Option<Vec<_>>>().unwrap_or_default(),
            ));
        }
        rows.push(row);
    }
    rows
}

/// Mean and sample standard deviation; a dash without values.
fn spread(values: &[f64]) -> String {
    let runs = values.len() as f64;
    let mean = values.iter().sum::<f64>() / runs;
    match values.len() {
        0 => "-".to_owned(),
        1 => format!("{mean:.2}"),
        _ => {
            let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
            format!("{mean:.2} ± {:.2}", (squares / (runs - 1.0)).sqrt())
        }
    }
}

fn write_csv(out: &Path, runs: &[Run]) -> anyhow::Result<()> {
    let cannot_write = || format!("cannot write {}", out.display());
    let mut writer = csv::Writer::from_path(out).with_context(cannot_write)?;
    if let Some(first) = runs.first() {
        let names = first.figures.iter().map(|figure| figure.name.as_str());
        writer.write_record(["method", "file"].into_iter().chain(names))?;
    }
    for run in runs {
        let values = run.figures.iter().map(|figure| {
            figure
                .value
                .map_or_else(String::new, |value| value.to_string())
        });
        writer.write_record(
            [run.method.clone(), run.file.clone()]
                .into_iter()
                .chain(values),
        )?;
    }
    writer.flush().with_context(cannot_write)
}

/// The table as a `tabular` of the package `booktabs`.
fn latex(rows: &[Vec<String>]) -> String {
    let escaped = |cell: &String| {
        ['\\', '%', '_', '&', '#', '$', '{', '}']
            .into_iter()
            .fold(cell.clone(), |text, special| {
                let escape = match special {
                    '\\' => r"\textbackslash ".to_owned(),
                    special => format!("\\{special}"),
                };
                text.replace(special, &escape)
            })
            .replace('±', r"$\pm$")
    };
    let line = |row: &Vec<String>| {
        let cells: Vec<_> = row.iter().map(escaped).collect();
        format!("{} \\\\\n", cells.join(" & "))
    };
    let mut text = format!(
        "\\begin{{tabular}}{{l{}}}\n\\toprule\n",
        "r".repeat(rows.first().map_or(0, Vec::len).saturating_sub(1))
    );
    for (number, row) in rows.iter().enumerate() {
        text += &line(row);
        if number == 0 {
            text += "\\midrule\n";
        }
    }
    text + "\\bottomrule\n\\end{tabular}\n"
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run(method: &str, value: Option<f64>) -> Run {
        Run {
            method: method.to_owned(),
            file: "out.jsonl".to_owned(),
            figures: vec![figure("AP@1 %", value)],
        }
    }

    #[test]
    fn runs_of_one_method_share_row() {
        let runs = [
            run("own", Some(80.0)),
            run("ecod", Some(91.5)),
            run("own", Some(84.0)),
            run("none", None),
        ];
        assert_eq!(
            columns(&table(&runs)),
            "      runs        AP@1 %\nown      2  82.00 ± 2.83\necod     1         91.50\nnone     1             -\n"
        );
    }

    #[test]
    fn names_are_text_in_latex() {
        let text = latex(&table(&[run("a_b & 100 %", Some(1.0))]));
        assert!(
            text.contains("a\\_b \\& 100 \\% & 1 & 1.00 \\\\\n"),
            "{text}"
        );
        assert!(text.contains("\\begin{tabular}{lrr}"), "{text}");
    }
}
