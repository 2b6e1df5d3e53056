//! What liars achieve: up to ⌊(n−1)/2⌋ of n vehicles lie, in four ways, and by rejoining under new names.
//!
//! `cargo run --release --example liars -- [--svg FILE] [--seed S]`

use std::collections::BTreeMap;
use std::error::Error;
use std::time::Duration;

use ecod::names::{Label, NodeName};
use ecod::time::Timestamp;
use ecod::vote::{Vote, VoteConfig};
use ecod::wire::{ObjectReport, PerceivedObject, SCHEMA_VERSION};
use plotters::prelude::*;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

const LABELS: [&str; 5] = ["car", "cup", "mouse", "sports ball", "vase"];
const LANDMARKS: usize = 6;
const ROUNDS: u64 = 600;
const SETTLED: u64 = 300;
const HONEST_ACCURACY: f64 = 0.8;
const PERIOD: Duration = Duration::from_millis(500);

#[derive(Debug, Clone, Copy, PartialEq)]
enum Lie {
    /// A wrong label at random.
    Random,
    /// Always the same label.
    Constant,
    /// All liars the same wrong label.
    Copying,
    /// Honest for a third of the time, then copying.
    Turning,
    /// Copying, under a new name every ten rounds.
    Rejoining,
}

struct Course {
    /// Share of right verdicts of each ten rounds.
    accuracy: Vec<f64>,
    /// Mean reputation of the honest and of the liars at the end of each ten rounds.
    reputation: Vec<(f64, f64)>,
    settled: f64,
    majority: f64,
}

fn other(rng: &mut ChaCha8Rng, truth: usize) -> usize {
    (truth + rng.random_range(1..LABELS.len())) % LABELS.len()
}

fn run(vehicles: usize, lie: Lie, seed: u64) -> Result<Course, Box<dyn Error>> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let liars = (vehicles - 1) / 2;
    let mut vote = Vote::new(VoteConfig { max_vehicles: 4096, ..VoteConfig::default() }, Vec::new());
    let mut course = Course { accuracy: Vec::new(), reputation: Vec::new(), settled: 0.0, majority: 0.0 };
    let (mut right, mut settled, mut majority) = (0, 0, 0);
    let mut now = Timestamp(1_700_000_000_000_000);
    let mut truths = [0; LANDMARKS];
    for round in 0..ROUNDS {
        now = now + PERIOD;
        // The objects are exchanged when the votes of the last ones are no longer fresh.
        if round % 6 == 0 {
            now = now + Duration::from_secs(3);
            truths.iter_mut().for_each(|t| *t = rng.random_range(0..LABELS.len()));
        }
        let common: Vec<usize> = truths.iter().map(|&t| other(&mut rng, t)).collect();
        let mut said = vec![[0usize; LABELS.len()]; LANDMARKS];
        for vehicle in 0..vehicles {
            let lies = vehicle < liars && !(lie == Lie::Turning && round < ROUNDS / 3);
            let name = match lie {
                Lie::Rejoining if lies => format!("liar-{vehicle}-{}", round / 10),
                _ => format!("{}-{vehicle}", if vehicle < liars { "liar" } else { "honest" }),
            };
            let mut objects = Vec::new();
            for (place, &truth) in truths.iter().enumerate() {
                let label = match lie {
                    _ if !lies => {
                        if rng.random_bool(HONEST_ACCURACY) {
                            truth
                        } else {
                            other(&mut rng, truth)
                        }
                    }
                    Lie::Random => other(&mut rng, truth),
                    Lie::Constant => 0,
                    Lie::Copying | Lie::Turning | Lie::Rejoining => common[place],
                };
                said[place][label] += 1;
                objects.push(PerceivedObject {
                    label: LABELS[label].into(),
                    confidence: 0.8,
                    x_m: 0.0,
                    y_m: 0.0,
                    covariance_m2: None,
                    landmark: Some(format!("place-{place}").into()),
                });
            }
            let node = NodeName::new(name)?;
            let report = ObjectReport {
                schema: SCHEMA_VERSION,
                node,
                seq: round,
                captured_at_us: now,
                pose: None,
                objects,
                seen: None,
            };
            vote.observe(&report, now)?;
        }
        let verdicts: BTreeMap<_, Option<Label>> =
            vote.close(now).verdicts.into_iter().map(|v| (v.landmark, v.label)).collect();
        for (place, &truth) in truths.iter().enumerate() {
            let label = verdicts.get(format!("place-{place}").as_str()).cloned().flatten();
            let good = usize::from(label.as_deref() == Some(LABELS[truth]));
            right += good;
            if round >= SETTLED {
                settled += good;
                let most = said[place].iter().max().copied().unwrap_or(0);
                majority += usize::from(said[place].iter().position(|&n| n == most) == Some(truth));
            }
        }
        if round % 10 == 9 {
            course.accuracy.push(right as f64 / (10 * LANDMARKS) as f64);
            right = 0;
            let reputations = vote.reputations();
            let mean = |prefix: &str| {
                let scores: Vec<f64> =
                    reputations.iter().filter(|(n, _)| n.as_str().starts_with(prefix)).map(|(_, r)| r.score).collect();
                scores.iter().sum::<f64>() / scores.len().max(1) as f64
            };
            course.reputation.push((mean("honest"), mean("liar")));
        }
    }
    let judged = (ROUNDS - SETTLED) as f64 * LANDMARKS as f64;
    course.settled = 100.0 * settled as f64 / judged;
    course.majority = 100.0 * majority as f64 / judged;
    Ok(course)
}

fn draw(path: &str, courses: &[(Lie, Course)]) -> Result<(), Box<dyn Error>> {
    let area = SVGBackend::new(path, (960, 1200)).into_drawing_area();
    area.fill(&WHITE)?;
    for (area, (lie, course)) in area.split_evenly((courses.len(), 1)).iter().zip(courses) {
        let mut chart = ChartBuilder::on(area)
            .margin(8)
            .caption(format!("{lie:?}"), ("sans-serif", 16))
            .x_label_area_size(24)
            .y_label_area_size(40)
            .build_cartesian_2d(0.0..ROUNDS as f64, 0.0..1.0)?;
        chart.configure_mesh().x_desc("round").draw()?;
        let x = |n: usize| (n as f64 + 1.0) * 10.0;
        let series: [(&str, RGBColor, Vec<f64>); 3] = [
            ("accuracy", BLACK, course.accuracy.clone()),
            ("reputation of the honest", BLUE, course.reputation.iter().map(|r| r.0).collect()),
            ("reputation of liars", RED, course.reputation.iter().map(|r| r.1).collect()),
        ];
        for (name, color, values) in series {
            let points = values.into_iter().enumerate().map(|(n, y)| (x(n), y));
            chart
                .draw_series(LineSeries::new(points, color))?
                .label(name)
                .legend(move |(x, y)| PathElement::new([(x, y), (x + 16, y)], color));
        }
        chart.configure_series_labels().position(SeriesLabelPosition::LowerRight).border_style(BLACK).draw()?;
    }
    area.present()?;
    Ok(())
}

fn main() -> Result<(), Box<dyn Error>> {
    let (mut svg, mut seed) = (None, 1);
    let mut args = std::env::args().skip(1);
    while let Some(key) = args.next() {
        let value = args.next().ok_or_else(|| format!("{key} needs a value"))?;
        match key.as_str() {
            "--svg" => svg = Some(value),
            "--seed" => seed = value.parse()?,
            _ => return Err(format!("unknown option {key}").into()),
        }
    }
    println!("| vehicles | liars | lie | majority % | verdicts % | honest | liars |\n|---|---|---|---|---|---|---|");
    let mut drawn = Vec::new();
    for vehicles in [3, 5, 7, 9, 15] {
        for lie in [Lie::Random, Lie::Constant, Lie::Copying, Lie::Turning, Lie::Rejoining] {
            let course = run(vehicles, lie, seed)?;
            let (honest, liars) = course.reputation.last().copied().unwrap_or_default();
            println!(
                "| {vehicles} | {} | {lie:?} | {:.1} | {:.1} | {honest:.2} | {liars:.2} |",
                (vehicles - 1) / 2,
                course.majority,
                course.settled
            );
            if vehicles == 7 {
                drawn.push((lie, course));
            }
        }
    }
    if let Some(path) = svg {
        draw(&path, &drawn)?;
    }
    Ok(())
}
