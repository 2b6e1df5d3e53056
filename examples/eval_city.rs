//! A town of 3 × 3 cells in generated traffic, compared with a single aggregator for the whole town.
//!
//! `make eval-city`, or `cargo run --release --example eval_city -- [--seeds N] [--seconds S] [--roads N] [--write-table FILE]`

use std::fmt::Write as _;
use std::path::PathBuf;
use std::str::FromStr;

use anyhow::{Context, bail};
use ecod_lab::document::write_table;
use ecod_lab::eval::tracks::TrackScores;
use ecod_lab::town::{LinkConfig, TownResult, TownScores, run, town_traffic};
use ecod_lab::traffic::generate;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

const FIRST_SEED: u64 = 3001;

struct Options {
    seeds: u64,
    seconds: f64,
    roads: usize,
    table: Option<PathBuf>,
}

fn options() -> anyhow::Result<Options> {
    let mut options = Options {
        seeds: 4,
        seconds: 60.0,
        roads: 2,
        table: None,
    };
    let mut args = std::env::args().skip(1);
    while let Some(key) = args.next() {
        let value = args
            .next()
            .with_context(|| format!("{key} needs a value"))?;
        match key.as_str() {
            "--seeds" => options.seeds = number(&key, &value)?,
            "--seconds" => options.seconds = number(&key, &value)?,
            "--roads" => options.roads = number(&key, &value)?,
            "--write-table" => options.table = Some(value.into()),
            _ => bail!("unknown option {key}"),
        }
    }
    Ok(options)
}

fn number<T: FromStr<Err: Into<anyhow::Error>>>(key: &str, value: &str) -> anyhow::Result<T> {
    value
        .parse()
        .map_err(|error: T::Err| error.into().context(format!("{key} {value}")))
}

fn main() -> anyhow::Result<()> {
    let options = options()?;
    let traffic = town_traffic(options.roads, options.seconds);
    traffic.validate()?;
    eprintln!(
        "{} roads each way, {} vehicles, {} observers",
        traffic.roads, traffic.vehicles, traffic.observers
    );
    let links = [
        (
            "no links",
            LinkConfig {
                is_up: false,
                ..LinkConfig::default()
            },
        ),
        (
            "2 Hz",
            LinkConfig {
                map_hz: 2.0,
                ..LinkConfig::default()
            },
        ),
        ("10 Hz", LinkConfig::default()),
    ];
    let mut rows: Vec<(String, Vec<Figures>)> = vec![("one aggregator".into(), Vec::new())];
    rows.extend(
        links
            .iter()
            .map(|(name, _)| (format!("nine cells, {name}"), Vec::new())),
    );
    for seed in FIRST_SEED..FIRST_SEED + options.seeds {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let recording = generate(&traffic, &mut || rng.random());
        for (row, (name, link)) in links.iter().enumerate() {
            let result = run(&traffic, &recording, *link, &mut || rng.random())?;
            let TownResult {
                identities,
                hand_overs,
                received,
                refused,
                ..
            } = &result;
            eprintln!(
                "seed {seed}, {name}: {identities} identities, {hand_overs:?}, {received} maps received, \
                 {refused} refused"
            );
            if row == 0 {
                rows[0].1.push(figures(&result.single));
            }
            rows[row + 1].1.push(figures(&result.cells));
        }
    }
    let table = table(&rows);
    print!("{table}");
    match options.table {
        Some(path) => write_table(&path, "city", &table),
        None => Ok(()),
    }
}

type Figures = [f64; 7];

fn figures(scores: &TownScores) -> Figures {
    let of = |scores: &TrackScores| scores.at_best_f1;
    let get = |value: Option<f64>| value.unwrap_or(f64::NAN);
    [
        get(of(&scores.all).idf1_pct),
        get(of(&scores.all).hota_pct),
        get(of(&scores.all).moda_pct),
        get(of(&scores.border).idf1_pct),
        get(of(&scores.border).hota_pct),
        get(of(&scores.middle).idf1_pct),
        get(of(&scores.middle).hota_pct),
    ]
}

fn table(rows: &[(String, Vec<Figures>)]) -> String {
    let mut text = String::from(
        "| | IDF1 | HOTA | MODA | IDF1, border | HOTA, border | IDF1, middle | HOTA, middle |\n|---|--:|--:|--:|--:|--:|--:|--:|\n",
    );
    for (name, of_seeds) in rows {
        let mean = |figure: usize| {
            of_seeds.iter().map(|figures| figures[figure]).sum::<f64>() / of_seeds.len() as f64
        };
        let cells: Vec<String> = (0..7)
            .map(|figure| format!("{:.1}", mean(figure)))
            .collect();
        // Writing to a text does not fail.
        let _ = writeln!(text, "| {name} | {} |", cells.join(" | "));
    }
    text
}
