//! `ecod-lab convert`: detections in files of benchmarks as reports, for `ecod-node replay`.

use std::collections::BTreeSet;
use std::io::Write as _;
use std::path::PathBuf;

use anyhow::{Context, anyhow};
use clap::Args;
use ecod::model::names::NodeName;
use ecod_actors::cli::{Failure, lines};

use super::files::{camera, frame_rate, read};
use crate::eval::formats::{FileContext, FileFormat, check_lengths};

/// Flags of `convert`.
#[derive(Debug, Args)]
pub(super) struct ConvertArguments {
    /// Form of the files
    #[arg(long, value_enum, value_name = "FORM")]
    format: FileFormat,
    /// A vehicle, and the file of its detections or a directory with one for each sequence; may be
    /// given several times
    #[arg(long, value_name = "NAME=FILE", required = true, value_parser = of_vehicle)]
    vehicle: Vec<(NodeName, PathBuf)>,
    /// A vehicle, and its configuration (TOML) with the camera whose boxes are in its file; may be
    /// given several times
    #[arg(long, value_name = "NAME=FILE", value_parser = of_vehicle)]
    config: Vec<(NodeName, PathBuf)>,
    /// Frames a second
    #[arg(long, value_name = "HZ", default_value_t = 10.0, value_parser = frame_rate)]
    frame_rate: f64,
    /// File for the reports, one JSON object per line in order of time; `-` for standard output
    #[arg(long, value_name = "FILE")]
    output: PathBuf,
}

fn of_vehicle(text: &str) -> Result<(NodeName, PathBuf), String> {
    let (name, file) = text
        .split_once('=')
        .ok_or("is not NAME=FILE, such as euclid=det.txt")?;
    Ok((
        NodeName::new(name).map_err(|error| error.to_string())?,
        file.into(),
    ))
}

pub(super) fn run(arguments: &ConvertArguments) -> Result<(), Failure> {
    let ConvertArguments {
        format,
        vehicle,
        config,
        frame_rate,
        output,
    } = arguments;
    if let Some((other, _)) = config
        .iter()
        .find(|(name, _)| vehicle.iter().all(|(vehicle, _)| vehicle != name))
    {
        return Err(Failure::usage(anyhow!(
            "--config is of {other}, of which no --vehicle is given"
        )));
    }
    let mut names = BTreeSet::new();
    if let Some((name, _)) = vehicle.iter().find(|(name, _)| !names.insert(name)) {
        return Err(Failure::usage(anyhow!(
            "--vehicle names {name} twice: a vehicle has one file or directory"
        )));
    }
    let mut inputs = Vec::new();
    for (_, path) in vehicle {
        inputs.extend(format.files(path).map_err(Failure::usage)?);
    }
    let mut of_vehicles = Vec::new();
    for (name, path) in vehicle {
        let config = config
            .iter()
            .find(|(of, _)| of == name)
            .map(|(_, path)| path.as_path());
        let camera = camera(config)?;
        let context = FileContext {
            camera: camera.as_ref(),
            categories: None,
        };
        of_vehicles.push((name, read(*format, path, context)?));
    }
    // A vehicle's only file is the first sequence, whatever its name, if no vehicle has several.
    let all = || of_vehicles.iter().flat_map(|(_, sequences)| sequences);
    let mut names = BTreeSet::new();
    if of_vehicles.iter().any(|(_, sequences)| sequences.len() > 1) {
        check_lengths(all(), *frame_rate).map_err(Failure::usage)?;
        names.extend(all().map(|sequence| sequence.name.as_str()));
    }
    let mut reports = Vec::new();
    for (name, sequences) in &of_vehicles {
        for sequence in sequences {
            let number = names.range(..sequence.name.as_str()).count();
            reports.extend(sequence.reports(number, *frame_rate, name, sequence.last()));
        }
    }
    if reports.is_empty() {
        return Err(anyhow!("no file has a frame").into());
    }
    if reports.iter().all(|report| report.objects.is_empty()) {
        eprintln!(
            "no report has an object: classes count by the exact names of the form, and boxes need a place"
        );
    }
    reports.sort_by_key(|report| report.captured_at_us);
    let mut sink = lines::create(output, &inputs).map_err(Failure::usage)?;
    let mut write = || -> std::io::Result<()> {
        for report in &reports {
            serde_json::to_writer(&mut sink, report)?;
            sink.write_all(b"\n")?;
        }
        sink.flush()
    };
    Ok(write().with_context(|| format!("cannot write {}", output.display()))?)
}
