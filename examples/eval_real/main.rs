//! Accuracy on real recordings, measured with the programs: detections are replayed as reports, and judged by `eval`.
//! Positions from ranging by the ground are compared with annotated positions.
//!
//! `make eval-real DIR=…`, or `cargo run --example eval_real -- --program target/release/ecod-node --data DIR [--work DIR]
//! [--write-table FILE]`
//!
//! DIR contains copies of public repositories under their original names; `docs/evaluation.md` has the list. The
//! program names each missing copy, judges all others, and then fails.

mod foot_points;
mod ground_camera;
mod kitti;
mod wildtrack;

use std::fs;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use anyhow::{Context, bail};
use ecod::wire::ObjectReport;
use ecod_lab::document::write_table;
use serde_json::Value;
use wildtrack::Wildtrack;

/// Labels are judged by the example `eval_labels`, which reads these files.
const LABEL_SETS: [&str; 4] = ["CF", "CF_amt", "SP", "SP_amt"];

/// Paths below DIR and the repository that contains them.
const LABELS: (&str, &str) = (
    "truth-inference-at-scale/data/active-crowd-toolkit",
    "yuan-li/truth-inference-at-scale",
);

const COLUMNS: [&str; 17] = [
    "set",
    "method",
    "AP@0.5",
    "AP@1",
    "AP@2",
    "AP@4",
    "MODA@0.5",
    "MODA@1",
    "MODA@2",
    "best F1",
    "mean error",
    "best threshold",
    "confidence off",
    "existence off",
    "HOTA",
    "IDF1",
    "switches, fragments",
];

/// Columns of the table of `--write-table` and their headings there. It has the rows of the default configuration only.
const WRITTEN: [(&str, &str); 12] = [
    ("set", "set"),
    ("method", "method"),
    ("AP@0.5", "AP@0.5"),
    ("AP@1", "AP@1"),
    ("AP@2", "AP@2"),
    ("AP@4", "AP@4"),
    ("MODA@1", "MODA@1"),
    ("best F1", "best F1"),
    ("mean error", "mean error, m"),
    ("confidence off", "calibration error, %"),
    ("HOTA", "HOTA"),
    ("IDF1", "IDF1"),
];

/// Configuration without correction of poses.
const UNALIGNED: &str = "[fusion.tracks]\nalign = false\n";

/// A recording: its truth, the results of other methods in the same file format, and its reports.
struct Recording {
    name: &'static str,
    format: &'static str,
    frame_rate: &'static str,
    truth: PathBuf,
    /// By name of the method.
    others: Vec<(String, PathBuf)>,
    reports: PathBuf,
    /// True if several observers report.
    is_fused: bool,
}

fn main() -> anyhow::Result<()> {
    let mut program = PathBuf::from("target/release/ecod-node");
    let mut data = PathBuf::new();
    let mut work = PathBuf::from("target/eval-real");
    let mut document = None;
    let mut args = std::env::args().skip(1);
    while let Some(key) = args.next() {
        let value = args
            .next()
            .with_context(|| format!("{key} needs a value"))?;
        match key.as_str() {
            "--program" => program = value.into(),
            "--data" => data = value.into(),
            "--work" => work = value.into(),
            "--write-table" => document = Some(PathBuf::from(value)),
            _ => bail!("unknown option {key}"),
        }
    }
    let mut missing = Vec::new();
    let mut find = |(path, repository): (&str, &str)| {
        let path = data.join(path);
        if path.exists() {
            return Some(path);
        }
        missing.push(format!(
            "{} is missing: it is in the repository {repository} on GitHub",
            path.display()
        ));
        None
    };
    let kitti = find(kitti::DETECTIONS).zip(find(kitti::TRUTH));
    let wildtrack_files = find(wildtrack::BOXES)
        .zip(find(wildtrack::CAMERAS))
        .zip(find(wildtrack::TRUTH));
    for set in LABEL_SETS {
        let path = format!("{}/{set}", LABELS.0);
        find((path.as_str(), LABELS.1));
    }
    missing.iter().for_each(|what| eprintln!("{what}"));
    let wildtrack = wildtrack_files
        .map(|((boxes, cameras), truth)| Wildtrack::read(&boxes, &cameras, &truth))
        .transpose()?;
    if let Some(wildtrack) = &wildtrack {
        foot_points::print(wildtrack);
    }
    print!("{}", head(&COLUMNS));
    let mut written = head(&WRITTEN.map(|(_, heading)| heading));
    if let Some((detections, truth)) = kitti {
        let last = &kitti::SEQUENCES[kitti::FITTED..];
        for (name, sequences) in [("KITTI", &kitti::SEQUENCES[..]), ("KITTI, last five", last)] {
            let folder = folder(&work, name)?;
            let recording = kitti::convert(name, sequences, &detections, &truth, &folder)?;
            written += &judge(&program, &recording)?;
        }
    }
    if let Some(wildtrack) = wildtrack {
        let recording = wildtrack.convert(&folder(&work, "wildtrack")?)?;
        written += &judge(&program, &recording)?;
    }
    if !missing.is_empty() {
        bail!("{} of the data are missing", missing.len());
    }
    if let Some(document) = document {
        write_table(&document, "real", &written)?;
    }
    Ok(())
}

/// The head of a table in Markdown.
fn head(columns: &[&str]) -> String {
    format!(
        "| {} |\n|{}\n",
        columns.join(" | "),
        "---|".repeat(columns.len())
    )
}

/// Creates an empty folder, in place of an existing one.
fn folder(work: &Path, name: &str) -> anyhow::Result<PathBuf> {
    let folder = work.join(name);
    if folder.exists() {
        fs::remove_dir_all(&folder)?;
    }
    fs::create_dir_all(&folder)?;
    Ok(folder)
}

/// Prints the rows of a recording; returns those for `--write-table`: of single cameras only the best, and the
/// detections of all cameras together only if a single observer reports.
fn judge(program: &Path, recording: &Recording) -> anyhow::Result<String> {
    let Recording {
        name,
        others,
        reports,
        is_fused,
        ..
    } = recording;
    let mut best_camera: Option<Vec<String>> = None;
    let mut written = String::new();
    for (method, maps) in others {
        let mut cells = row(name, method, false, &eval(program, recording, maps)?);
        if let Some(number) = method.strip_prefix("camera ") {
            cells[1] = format!("best camera ({number})");
            let is_better = |best: &Vec<String>| moda(&cells) > moda(best);
            if best_camera.as_ref().is_none_or(is_better) {
                best_camera = Some(cells);
            }
        } else if !is_fused || method != "detections" {
            written += &written_row(&cells);
        }
    }
    if let Some(cells) = best_camera {
        written.insert_str(0, &written_row(&cells));
    }
    let maps = reports.with_file_name("maps.jsonl");
    let replay = || {
        let mut replay = Command::new(program);
        replay
            .arg("replay")
            .arg("--input")
            .arg(reports)
            .arg("--output")
            .arg(&maps);
        replay
    };
    run(&mut replay())?;
    let cells = row(name, "ecod", true, &eval(program, recording, &maps)?);
    written += &written_row(&cells);
    if *is_fused {
        let config = reports.with_file_name("unaligned.toml");
        fs::write(&config, UNALIGNED)?;
        run(replay().arg("--config").arg(&config))?;
        row(
            name,
            "ecod, `align = false`",
            true,
            &eval(program, recording, &maps)?,
        );
    }
    Ok(written)
}

fn eval(program: &Path, recording: &Recording, input: &Path) -> anyhow::Result<Value> {
    let Recording {
        format,
        frame_rate,
        truth,
        reports,
        ..
    } = recording;
    let result = reports.with_file_name("result.json");
    let mut eval = Command::new(program.with_file_name("ecod-lab"));
    eval.args(["eval", "--format", format, "--frame-rate", frame_rate])
        .arg("--truth")
        .arg(truth);
    run(eval.arg("--input").arg(input).arg("--output").arg(&result))?;
    let result: Value = serde_json::from_slice(&fs::read(&result)?)?;
    Ok(result["tracks"].clone())
}

fn run(command: &mut Command) -> anyhow::Result<()> {
    let output = command
        .stdin(Stdio::null())
        .output()
        .with_context(|| format!("cannot run {command:?}"))?;
    let said = String::from_utf8_lossy(&output.stderr);
    if !output.status.success() {
        bail!("{command:?}: {said}");
    }
    said.lines()
        .filter(|line| line.contains("rejected") || line.contains("no map"))
        .for_each(|line| eprintln!("{line}"));
    Ok(())
}

/// Prints a row of the table and returns its cells. Only tracks have identities.
fn row(set: &str, method: &str, is_tracked: bool, tracks: &Value) -> Vec<String> {
    let figure =
        |value: &Value, digits: usize| value.as_f64().map(|figure| format!("{figure:.digits$}"));
    let share = |value: &Value| figure(value, 1);
    let at = &tracks["at_best_f1"];
    let calibration = &tracks["calibration"];
    let mut shares: Vec<Option<String>> = (0..4)
        .map(|place| share(&tracks["ap_pct"][place]))
        .collect();
    shares.extend((0..3).map(|place| share(&tracks["best_moda_pct"][place])));
    shares.push(share(&tracks["best_f1_pct"]));
    shares.extend([&at["motp_m"], &at["threshold"]].map(|value| figure(value, 2)));
    shares.extend(["confidence", "existence"].map(|kind| share(&calibration[kind]["ece_pct"])));
    let counts = format!("{}, {}", at["id_switches"], at["fragments"]);
    let identities = [share(&at["hota_pct"]), share(&at["idf1_pct"]), Some(counts)];
    let is_judged = is_tracked && !at["idf1_pct"].is_null();
    shares.extend(identities.map(|figure| figure.filter(|_| is_judged)));
    let figures = shares
        .into_iter()
        .map(|cell| cell.unwrap_or_else(|| "-".to_owned()));
    let names = [set, method].map(str::to_owned);
    let cells: Vec<String> = names.into_iter().chain(figures).collect();
    println!("| {} |", cells.join(" | "));
    cells
}

/// The column `MODA@1` of a row; 0 without it.
fn moda(cells: &[String]) -> f64 {
    let figure = COLUMNS
        .iter()
        .zip(cells)
        .find(|(column, _)| **column == "MODA@1");
    figure
        .and_then(|(_, cell)| cell.parse().ok())
        .unwrap_or_default()
}

/// The cells of the columns [`WRITTEN`] as a row.
fn written_row(cells: &[String]) -> String {
    let columns = COLUMNS.iter().zip(cells);
    let written: Vec<&str> = columns
        .filter(|(column, _)| WRITTEN.iter().any(|(written, _)| written == *column))
        .map(|(_, cell)| cell.as_str())
        .collect();
    format!("| {} |\n", written.join(" | "))
}

/// Writes reports as lines.
fn write_reports(
    path: &Path,
    reports: impl IntoIterator<Item = ObjectReport>,
) -> anyhow::Result<()> {
    let mut file = std::io::BufWriter::new(fs::File::create(path)?);
    for report in reports {
        writeln!(file, "{}", serde_json::to_string(&report)?)?;
    }
    Ok(file.flush()?)
}
