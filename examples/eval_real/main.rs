//! Accuracy on real recordings, measured on the programs: detections are replayed as reports, and judged by `eval`. Ranging
//! by the ground is held against annotated places.
//!
//! `make eval-real DIR=…`, or `cargo run --example eval_real -- --program target/release/ecod-node --data DIR [--work DIR]`
//!
//! DIR holds copies of public repositories, named as they are there; `docs/measurements.md` has the list. What is missing
//! is named, and makes the program fail after all others were judged.

mod foot_points;
mod kitti;
mod wildtrack;

use std::fs;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use anyhow::{Context, bail};
use ecod::wire::ObjectReport;
use serde_json::Value;
use wildtrack::Wildtrack;

/// Labels are judged by the example `eval_labels`, which needs these.
const LABEL_SETS: [&str; 4] = ["CF", "CF_amt", "SP", "SP_amt"];

/// Paths below DIR and the repository that has them.
const LABELS: (&str, &str) = ("truth-inference-at-scale/data/active-crowd-toolkit", "yuan-li/truth-inference-at-scale");

const HEADER: &str = "| set | method | AP@0.5 | AP@1 | AP@2 | AP@4 | best F1 | MODA | HOTA | IDF1 | switches | fragments | \
                      calibration error |\n|---|---|---|---|---|---|---|---|---|---|---|---|---|";

/// A recording: its truth, its detections and its reports, all judged in one form of file.
struct Recording {
    name: &'static str,
    format: &'static str,
    frame_rate: &'static str,
    truth: PathBuf,
    detections: PathBuf,
    reports: PathBuf,
}

fn main() -> anyhow::Result<()> {
    let (mut program, mut data, mut work) =
        (PathBuf::from("target/release/ecod-node"), PathBuf::new(), PathBuf::from("target/eval-real"));
    let mut args = std::env::args().skip(1);
    while let Some(key) = args.next() {
        let value = args.next().with_context(|| format!("{key} needs a value"))?;
        match key.as_str() {
            "--program" => program = value.into(),
            "--data" => data = value.into(),
            "--work" => work = value.into(),
            _ => bail!("unknown option {key}"),
        }
    }
    let mut missing = Vec::new();
    let mut find = |(path, repository): (&str, &str)| {
        let path = data.join(path);
        if path.exists() {
            return Some(path);
        }
        missing.push(format!("{} is missing: it is in the repository {repository} on GitHub", path.display()));
        None
    };
    let kitti = find(kitti::DETECTIONS).zip(find(kitti::TRUTH));
    let wildtrack = find(wildtrack::BOXES).zip(find(wildtrack::CAMERAS)).zip(find(wildtrack::TRUTH));
    for set in LABEL_SETS {
        let path = format!("{}/{set}", LABELS.0);
        find((path.as_str(), LABELS.1));
    }
    missing.iter().for_each(|what| eprintln!("{what}"));
    let wildtrack = wildtrack.map(|((boxes, cameras), truth)| Wildtrack::read(&boxes, &cameras, &truth)).transpose()?;
    if let Some(wildtrack) = &wildtrack {
        foot_points::print(wildtrack)?;
    }
    println!("{HEADER}");
    if let Some((detections, truth)) = kitti {
        judge(&program, &kitti::convert(&detections, &truth, &folder(&work, "kitti")?)?)?;
    }
    if let Some(wildtrack) = wildtrack {
        judge(&program, &wildtrack.convert(&folder(&work, "wildtrack")?)?)?;
    }
    if missing.is_empty() { Ok(()) } else { bail!("{} of the data are missing", missing.len()) }
}

/// An empty folder.
fn folder(work: &Path, name: &str) -> anyhow::Result<PathBuf> {
    let folder = work.join(name);
    if folder.exists() {
        fs::remove_dir_all(&folder)?;
    }
    fs::create_dir_all(&folder)?;
    Ok(folder)
}

fn judge(program: &Path, recording: &Recording) -> anyhow::Result<()> {
    let Recording { name, detections, reports, .. } = recording;
    row(name, "detections", &eval(program, recording, detections)?);
    let maps = reports.with_file_name("maps.jsonl");
    let mut replay = Command::new(program);
    run(replay.arg("replay").arg("--input").arg(reports).arg("--output").arg(&maps))?;
    row(name, "ecod", &eval(program, recording, &maps)?);
    Ok(())
}

fn eval(program: &Path, recording: &Recording, input: &Path) -> anyhow::Result<Value> {
    let Recording { format, frame_rate, truth, reports, .. } = recording;
    let result = reports.with_file_name("result.json");
    let mut eval = Command::new(program.with_file_name("ecod-lab"));
    eval.args(["eval", "--format", format, "--frame-rate", frame_rate]).arg("--truth").arg(truth);
    run(eval.arg("--input").arg(input).arg("--out").arg(&result))?;
    let result: Value = serde_json::from_slice(&fs::read(&result)?)?;
    Ok(result["tracks"].clone())
}

fn run(command: &mut Command) -> anyhow::Result<()> {
    let output = command.stdin(Stdio::null()).output().with_context(|| format!("cannot run {command:?}"))?;
    let said = String::from_utf8_lossy(&output.stderr);
    if !output.status.success() {
        bail!("{command:?}: {said}");
    }
    said.lines()
        .filter(|line| line.contains("rejected") || line.contains("no map"))
        .for_each(|line| eprintln!("{line}"));
    Ok(())
}

/// Prints a row of the table. Detections go on in no frame, so their identities are not judged.
fn row(set: &str, method: &str, tracks: &Value) {
    let share = |value: &Value| value.as_f64().map_or("-".to_owned(), |share| format!("{share:.1}"));
    let at = &tracks["at_best_f1"];
    let mut cells: Vec<String> = tracks["ap_pct"].as_array().into_iter().flatten().map(share).collect();
    cells.extend([&tracks["best_f1_pct"], &at["moda_pct"]].map(share));
    let is_tracked = method == "ecod" && !at["idf1_pct"].is_null();
    let identities = [&at["hota_pct"], &at["idf1_pct"]].map(share).into_iter();
    let counts = [&at["id_switches"], &at["fragments"]].map(Value::to_string).into_iter();
    cells.extend(identities.chain(counts).map(|figure| if is_tracked { figure } else { "-".to_owned() }));
    cells.push(share(&tracks["calibration"]["confidence"]["ece_pct"]));
    println!("| {set} | {method} | {} |", cells.join(" | "));
}

/// Writes reports as lines.
fn write_reports(path: &Path, reports: impl IntoIterator<Item = ObjectReport>) -> anyhow::Result<()> {
    let mut file = std::io::BufWriter::new(fs::File::create(path)?);
    for report in reports {
        writeln!(file, "{}", serde_json::to_string(&report)?)?;
    }
    Ok(file.flush()?)
}
