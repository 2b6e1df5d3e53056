//! Tracks in generated traffic, compared with the best single vehicle, with all reports together, and with late fusion.
//!
//! `make eval-tracks`, or `cargo run --release --example eval_tracks -- [--seeds tuning|report] [--count N] [--seconds S]
//! [--observers 2,4,8] [--write-table FILE] [--svg FILE] [--reliability FILE] [--recordings DIR]`
//!
//! Parameters are chosen on the seeds `tuning`, and figures are reported on the seeds `report`; `--count` uses the
//! first seeds only. `--reliability` draws how often ECOD's objects are right over the probability that they state.
//! `--recordings` writes reports and truth of every scene, and the maps of late fusion, for `ecod-node replay` and
//! `ecod-lab eval`.

mod plot;
mod reliability;

use std::collections::BTreeSet;
use std::fs::{self, File};
use std::io::{BufWriter, Write as _};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, bail};
use ecod::aggregator::{Aggregator, Algorithms, Fused, FusionConfig};
use ecod::model::epoch::Epoch;
use ecod::model::geometry::Covariance;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::wire::{FusedObject, GlobalMap, ObjectReport, ReportKind};
use ecod_lab::document::write_table;
use ecod_lab::eval::baselines::{LatestReports, NearestTracker, found, suppressed};
use ecod_lab::eval::tracks::{
    AP_DISTANCES_M, ReliabilityBins, ReportedObject, TrackEvaluation, TrackScores, TrackTruth,
};
use ecod_lab::traffic::{TrafficConfig, TrafficRecording, generate, observer_name};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use uuid::Uuid;

const TUNING: Range<u64> = 1..5;
const REPORT: Range<u64> = 1001..1005;
const OBSERVERS: [usize; 7] = [1, 2, 4, 8, 16, 32, 50];
/// Towns in the printed table and in the drawing; the table of `--write-table` omits them.
const ONLY_DRAWN: [&str; 4] = ["2", "8", "16", "32"];

/// Methods that make a map from the same reports.
pub(crate) const METHODS: [&str; 4] = ["best vehicle", "union", "late fusion", "ecod"];

/// Columns of the table.
pub(crate) const FIGURES: [&str; 12] = [
    "AP@0.5",
    "AP@1",
    "AP@2",
    "AP@4",
    "best F1",
    "MODA",
    "HOTA",
    "IDF1",
    "calibration error",
    "of existence",
    "best threshold",
    "switches per object",
];

/// Number of figures that are percentages; they come first.
const PERCENTAGES: usize = 10;

/// The figures of one method, in the order of [`FIGURES`]; NaN for a figure that the method does not have.
pub(crate) type Figures = [f64; FIGURES.len()];

const USAGE: &str = "eval_tracks [--seeds tuning|report] [--count N] [--seconds S] [--observers 2,4,8] [--write-table FILE] \
                     [--svg FILE] [--reliability FILE] [--recordings DIR]";

struct Options {
    seeds: Range<u64>,
    count: usize,
    seconds: f64,
    observers: Vec<usize>,
    table: Option<PathBuf>,
    svg: Option<PathBuf>,
    reliability: Option<PathBuf>,
    recordings: Option<PathBuf>,
}

fn options() -> anyhow::Result<Options> {
    let mut options = Options {
        seeds: REPORT,
        count: usize::MAX,
        seconds: 30.0,
        observers: OBSERVERS.to_vec(),
        table: None,
        svg: None,
        reliability: None,
        recordings: None,
    };
    let mut args = std::env::args().skip(1);
    while let Some(key) = args.next() {
        if key == "--help" || key == "-h" {
            println!("{USAGE}");
            std::process::exit(0);
        }
        let value = args
            .next()
            .with_context(|| format!("{key} needs a value"))?;
        match key.as_str() {
            "--seeds" if value == "tuning" => options.seeds = TUNING,
            "--seeds" if value == "report" => options.seeds = REPORT,
            "--seeds" => bail!("--seeds is tuning or report, not {value}"),
            "--count" => options.count = number(&key, &value)?,
            "--seconds" => options.seconds = number(&key, &value)?,
            "--observers" => {
                options.observers = value
                    .split(',')
                    .map(|count| number(&key, count))
                    .collect::<Result<_, _>>()?;
            }
            "--write-table" => options.table = Some(value.into()),
            "--svg" => options.svg = Some(value.into()),
            "--reliability" => options.reliability = Some(value.into()),
            "--recordings" => options.recordings = Some(value.into()),
            _ => bail!("unknown option {key}"),
        }
    }
    if options.count == 0 || options.observers.contains(&0) {
        bail!("--count and --observers are 1 or more");
    }
    Ok(options)
}

fn number<T: FromStr<Err: Into<anyhow::Error>>>(key: &str, value: &str) -> anyhow::Result<T> {
    value
        .parse()
        .map_err(|error: T::Err| error.into().context(format!("{key} {value}")))
}

/// A kind of traffic and the name of its rows.
struct Scene {
    name: String,
    config: TrafficConfig,
}

impl Scene {
    /// A town with every number of observers, a recording of two vehicles, and parked cars that many vehicles pass.
    fn all(options: &Options) -> Vec<Self> {
        let town = |&observers: &usize| Self {
            name: observers.to_string(),
            config: TrafficConfig {
                observers,
                duration_s: options.seconds,
                ..TrafficConfig::default()
            },
        };
        let recorded = Self {
            name: "recorded".into(),
            config: TrafficConfig {
                duration_s: options.seconds,
                ..TrafficConfig::two_vehicle_recording()
            },
        };
        let passed = Self {
            name: "passed".into(),
            config: TrafficConfig {
                duration_s: 4.0 * options.seconds,
                ..TrafficConfig::much_passed()
            },
        };
        options
            .observers
            .iter()
            .map(town)
            .chain([recorded, passed])
            .collect()
    }
}

/// All methods on one recording; `write` receives every map of late fusion.
fn run(
    recording: &TrafficRecording,
    observers: usize,
    write: &mut dyn FnMut(Timestamp, &[ReportedObject]),
) -> anyhow::Result<[TrackScores; METHODS.len()]> {
    let truth = TrackTruth::parse(&serde_json::to_string(&recording.truth)?)?;
    let judge = || TrackEvaluation::new(truth.clone());
    let mut union = judge();
    let mut late = judge();
    let mut ours = judge();
    let mut union_tracker = NearestTracker::default();
    let mut late_tracker = NearestTracker::default();
    let mut latest = LatestReports::default();
    for map in maps(recording, &mut |event| match event {
        Event::Report(report) => latest.report(report),
        Event::Due(at) => {
            let all = latest.union(at);
            union.add_objects(at, &union_tracker.track(at, &all));
            let suppressed = late_tracker.track(at, &suppressed(all));
            write(at, &suppressed);
            late.add_objects(at, &suppressed);
        }
    }) {
        ours.map(&map);
    }
    let alone = (0..observers).map(|number| alone(recording, &observer_name(number), judge()));
    let best = alone.max_by(|a, b| {
        a.ap_pct[2]
            .unwrap_or_default()
            .total_cmp(&b.ap_pct[2].unwrap_or_default())
    });
    Ok([
        best.context("no observer")?,
        union.result(),
        late.result(),
        ours.result(),
    ])
}

enum Event<'a> {
    Report(&'a ObjectReport),
    /// The other methods are due to output a map of the reports so far.
    Due(Timestamp),
}

/// Time between two outputs of the other methods.
const PERIOD: Duration = Duration::from_millis(100);

/// Maps that an aggregator makes of a recording; `watch` receives every report and the times at which maps are due.
fn maps(recording: &TrafficRecording, watch: &mut dyn FnMut(Event<'_>)) -> Vec<GlobalMap> {
    let config = FusionConfig {
        algorithms: Algorithms::Pace,
        ..FusionConfig::default()
    };
    let mut aggregator: Option<Aggregator> = None;
    let mut maps = Vec::new();
    let mut take = |fused: Option<Fused>| maps.extend(fused.and_then(|fused| fused.map));
    let mut due: Option<Timestamp> = None;
    for arrived in &recording.reports {
        let now = arrived
            .received_at_us
            .unwrap_or(arrived.report.captured_at_us);
        let aggregator = aggregator.get_or_insert_with(|| {
            Aggregator::new(
                NodeName::from_static("edge"),
                1,
                config.clone(),
                Vec::new(),
                now,
            )
        });
        while aggregator.deadline() <= now {
            take(aggregator.tick(aggregator.deadline()));
        }
        let due = due.get_or_insert(now);
        while *due < now {
            watch(Event::Due(*due));
            *due = *due + PERIOD;
        }
        watch(Event::Report(&arrived.report));
        // The only reason for a rejection is a late report.
        take(
            aggregator
                .report(
                    ReportKind::Detections,
                    &Arc::new(arrived.report.clone()),
                    now,
                )
                .unwrap_or_default(),
        );
    }
    due.into_iter().for_each(|due| watch(Event::Due(due)));
    if let Some(aggregator) = &mut aggregator {
        take(aggregator.tick(aggregator.deadline()));
    }
    maps
}

/// A single vehicle, at the times of its captures, without any delay.
fn alone(recording: &TrafficRecording, name: &NodeName, mut judge: TrackEvaluation) -> TrackScores {
    let mut tracker = NearestTracker::default();
    let mut own: Vec<_> = recording
        .reports
        .iter()
        .map(|arrived| &arrived.report)
        .filter(|r| r.node == *name)
        .collect();
    own.sort_by_key(|report| report.captured_at_us);
    for report in own {
        judge.add_objects(
            report.captured_at_us,
            &tracker.track(report.captured_at_us, &found(report)),
        );
    }
    judge.result()
}

fn figures(scores: &TrackScores, truth_ids: usize) -> Figures {
    let at = &scores.at_best_f1;
    let [a, b, c, d] = scores.ap_pct.map(Option::unwrap_or_default);
    let rest = [
        scores.best_f1_pct,
        at.moda_pct,
        at.hota_pct,
        at.idf1_pct,
        scores.calibration.confidence.ece_pct,
    ];
    let [f1, moda, hota, idf1, error] = rest.map(Option::unwrap_or_default);
    let of_existence = scores
        .calibration
        .existence
        .as_ref()
        .and_then(|existence| existence.ece_pct)
        .unwrap_or(f64::NAN);
    let switches = at.id_switches as f64 / truth_ids.max(1) as f64;
    [
        a,
        b,
        c,
        d,
        f1,
        moda,
        hota,
        idf1,
        error,
        of_existence,
        at.threshold,
        switches,
    ]
}

/// Destination of a recording, written line by line.
struct Files {
    maps: BufWriter<File>,
}

impl Files {
    fn new(folder: &Path, name: &str, recording: &TrafficRecording) -> anyhow::Result<Self> {
        fs::create_dir_all(folder)?;
        let file = |kind: &str| folder.join(format!("{name}.{kind}"));
        let mut reports = BufWriter::new(File::create(file("reports.jsonl"))?);
        for arrived in &recording.reports {
            writeln!(reports, "{}", serde_json::to_string(arrived)?)?;
        }
        reports.flush()?;
        fs::write(file("truth.json"), serde_json::to_vec(&recording.truth)?)?;
        Ok(Self {
            maps: BufWriter::new(File::create(file("late.jsonl"))?),
        })
    }

    fn map(&mut self, at: Timestamp, said: &[ReportedObject]) -> anyhow::Result<()> {
        let objects = said.iter().map(|said| {
            let id = Uuid::from_u128(u128::from(said.id));
            let covariance = Covariance::isotropic(1.0);
            FusedObject::new(
                id,
                said.label.clone(),
                said.score,
                said.position.x,
                said.position.y,
                covariance,
            )
        });
        let epoch = Epoch::new(1, NodeName::from_static("late-fusion"));
        let map = GlobalMap {
            objects: objects.collect(),
            ..GlobalMap::new(&epoch, 1, at)
        };
        Ok(writeln!(self.maps, "{}", serde_json::to_string(&map)?)?)
    }
}

fn header() -> String {
    let line = |cells: &mut dyn Iterator<Item = String>| {
        format!("| {} |\n", cells.collect::<Vec<_>>().join(" | "))
    };
    let names = ["vehicles", "method"]
        .into_iter()
        .chain(FIGURES)
        .map(str::to_owned);
    line(&mut names.clone()) + &line(&mut names.map(|_| "---".to_owned()))
}

fn main() -> anyhow::Result<()> {
    const { assert!(AP_DISTANCES_M.len() == 4) };
    let options = options()?;
    let mut table = header();
    print!("{table}");
    let mut courses: Vec<(usize, [Figures; METHODS.len()])> = Vec::new();
    let mut stated: Vec<(String, Vec<ReliabilityBins>)> = Vec::new();
    for Scene { name, config } in Scene::all(&options) {
        config.validate()?;
        let seeds: Vec<u64> = options.seeds.clone().take(options.count).collect();
        let mut mean = [[0.0; FIGURES.len()]; METHODS.len()];
        let mut calibrations = Vec::new();
        for seed in &seeds {
            let mut rng = ChaCha8Rng::seed_from_u64(*seed);
            let recording = generate(&config, &mut || rng.random());
            let folder = options.recordings.as_ref();
            let mut files = folder
                .map(|folder| Files::new(folder, &format!("{name}-{seed}"), &recording))
                .transpose()?;
            let mut written = Ok(());
            let mut write = |at, said: &[ReportedObject]| {
                if let (Some(files), Ok(())) = (&mut files, &written) {
                    written = files.map(at, said);
                }
            };
            let ids: BTreeSet<usize> = recording
                .truth
                .frames
                .iter()
                .flat_map(|frame| frame.objects.iter().map(|object| object.id))
                .collect();
            let scores = run(&recording, config.observers + config.standing, &mut write)?;
            written?;
            calibrations.extend(scores.last().map(|ecod| ecod.calibration.clone()));
            for (method, scores) in scores.iter().enumerate() {
                for (sum, figure) in mean[method].iter_mut().zip(figures(scores, ids.len())) {
                    *sum += figure / seeds.len() as f64;
                }
            }
        }
        for (method, figures) in METHODS.iter().zip(&mean) {
            let (shares, others) = figures.split_at(PERCENTAGES);
            let shares = shares.iter().map(|figure| {
                if figure.is_nan() {
                    "–".to_owned()
                } else {
                    format!("{figure:.1}")
                }
            });
            let cells: Vec<String> = shares
                .chain(others.iter().map(|figure| format!("{figure:.2}")))
                .collect();
            let row = format!("| {name} | {method} | {} |\n", cells.join(" | "));
            print!("{row}");
            if !ONLY_DRAWN.contains(&name.as_str()) {
                table.push_str(&row);
            }
        }
        stated.push((name.clone(), calibrations));
        if name == config.observers.to_string() {
            courses.push((config.observers, mean));
        }
    }
    if let Some(path) = &options.table {
        write_table(path, "track", &table)?;
    }
    if let Some(path) = &options.svg {
        plot::draw(path, &courses)?;
    }
    if let Some(path) = &options.reliability {
        reliability::draw(path, &stated)?;
    }
    Ok(())
}
