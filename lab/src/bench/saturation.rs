//! Search for the number of vehicles that a cell can serve.

use std::time::Duration;

use serde::Serialize;

use super::latency::Quantiles;
use super::load::Load;
use super::measurement::{BenchFigure, measure};
use super::target::Target;

/// The cell can serve a load if 99 of 100 answers take less than this, and all answers arrive.
pub const LIMIT: Duration = Duration::from_millis(100);

/// One load of the search.
#[derive(Debug, Clone, Serialize)]
pub struct Step {
    /// Vehicles, each with ten reports and ten votes a second.
    pub vehicles: usize,
    /// True if the load was carried.
    pub carried: bool,
    /// From a round's last report to its map, at every vehicle.
    pub map: Quantiles,
    /// From a round's last report to its verdicts; `None` in a cell without verdicts.
    pub verdict: Option<Quantiles>,
    /// Bytes of the map, which goes to every vehicle.
    pub map_bytes: usize,
    /// Bytes of the verdicts, which also go to every vehicle.
    pub verdict_bytes: usize,
    /// Reports that this process could not send.
    pub refused: u64,
    /// Most time in milliseconds by which sending began late.
    pub sent_late_ms: f64,
    /// Use of processors by aggregator and vehicles.
    pub shares: Shares,
}

/// Processor time in percent of one core.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Shares {
    /// Of an aggregator that is watched.
    pub aggregator: Option<AggregatorShares>,
    /// Processor time of the simulated vehicles, all together.
    pub vehicles: f64,
}

/// The parts of an aggregator, in percent of one core.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct AggregatorShares {
    /// The embedded broker: one thread.
    pub broker: f64,
    /// The rest: gateway, fuser, dashboard.
    pub fusion: f64,
}

/// Result of a search.
#[derive(Debug, Clone, Serialize)]
pub struct Saturation {
    /// The largest number of vehicles that the cell could serve; `None` if even the first load was
    /// too high.
    pub most_vehicles: Option<usize>,
    /// Bottleneck at the lowest load that was too high, as text; `None` if the cell could serve all
    /// loads.
    pub first_saturated: Option<String>,
    /// All loads in the order of their tries; if a load was tried twice, the second try.
    pub steps: Vec<Step>,
}

/// Doubles the load from `least` to `most` until the cell cannot serve it any more, then halves the
/// distance to the last load that it could serve, down to an eighth. A failed load is tried again,
/// and the second try counts, because the machine may have hiccups.
///
/// # Errors
/// Returns the errors of [`measure`] and of `on_step`.
pub async fn search(
    target: &Target,
    [least, most]: [usize; 2],
    duration: Duration,
    on_step: impl Fn(&Step) -> anyhow::Result<()>,
) -> anyhow::Result<Saturation> {
    let mut steps: Vec<Step> = Vec::new();
    let mut vehicles = least;
    loop {
        let load = Load {
            bare: false,
            ..Load::new(vehicles, duration)
        };
        let mut step = Step::new(vehicles, target, &measure(target, load).await?);
        on_step(&step)?;
        if !step.carried {
            step = Step::new(vehicles, target, &measure(target, load).await?);
            on_step(&step)?;
        }
        steps.push(step);
        let carried = steps
            .iter()
            .filter(|step| step.carried)
            .map(|step| step.vehicles)
            .max();
        let failed = steps
            .iter()
            .filter(|step| !step.carried)
            .map(|step| step.vehicles)
            .min();
        vehicles = match (carried, failed) {
            (Some(carried), None) if carried < most => (2 * carried).min(most),
            (Some(carried), Some(failed)) if failed - carried > (carried / 8).max(1) => {
                carried.midpoint(failed)
            }
            (most_vehicles, _) => {
                let first_failed = steps
                    .iter()
                    .filter(|step| !step.carried)
                    .min_by_key(|step| step.vehicles);
                let first_saturated = first_failed.map(Step::blame);
                return Ok(Saturation {
                    most_vehicles,
                    first_saturated,
                    steps,
                });
            }
        };
    }
}

impl Step {
    fn new(vehicles: usize, target: &Target, measured: &BenchFigure) -> Self {
        let map = measured.cell.map.quantiles();
        let verdict = target.votes.then(|| measured.cell.verdict.quantiles());
        let is_carried =
            |latency: &Quantiles| latency.missing == 0 && latency.p99_us < LIMIT.as_micros() as f64;
        Self {
            vehicles,
            carried: is_carried(&map) && verdict.iter().all(is_carried),
            map,
            verdict,
            map_bytes: measured.map_bytes,
            verdict_bytes: measured.verdict_bytes,
            refused: measured.refused,
            sent_late_ms: measured.latest.as_secs_f64() * 1000.0,
            shares: Shares::of(measured),
        }
    }

    /// Bottleneck: the load itself, if it was not sent as scheduled, otherwise a processor.
    fn blame(&self) -> String {
        let Self {
            refused,
            sent_late_ms,
            shares,
            ..
        } = self;
        let busiest = shares.busiest();
        if *refused == 0 && *sent_late_ms <= MAX_LATE_MS {
            return busiest;
        }
        format!(
            "the simulated vehicles themselves, the cell may carry more: sending began up to {sent_late_ms:.0} ms late and \
             {refused} reports could not be sent; {busiest}"
        )
    }
}

impl Shares {
    /// Costs of a load.
    pub fn of(measured: &BenchFigure) -> Self {
        let aggregator = measured.aggregator.as_ref().map(|aggregator| {
            let broker = aggregator.percent_of(BROKER_THREAD);
            AggregatorShares {
                broker,
                fusion: aggregator.percent() - broker,
            }
        });
        Self {
            aggregator,
            vehicles: measured.vehicles.percent(),
        }
    }

    /// Exhausted processor: a single thread that uses a whole core, or all cores, and the process
    /// that uses most of them.
    fn busiest(self) -> String {
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let all_cores = BUSY_PERCENT * cores as f64;
        let Self {
            aggregator,
            vehicles,
        } = self;
        let Some(AggregatorShares { broker, fusion }) = aggregator else {
            return if vehicles > all_cores {
                format!(
                    "all {cores} cores of this machine, by the simulated vehicles, {vehicles:.0} % of a core"
                )
            } else {
                format!(
                    "unknown, not this machine: its vehicles took {vehicles:.0} % of a core, of {cores} cores"
                )
            };
        };
        if broker > BUSY_PERCENT {
            return format!("broker, {broker:.0} % of a core with its one thread");
        }
        let parts = [
            ("broker", broker),
            ("aggregator", fusion),
            ("simulated vehicles", vehicles),
        ];
        let (most, percent) = parts
            .into_iter()
            .max_by(|a, b| a.1.total_cmp(&b.1))
            .unwrap_or(("nothing", 0.0));
        if broker + fusion + vehicles > all_cores {
            format!(
                "all {cores} cores of this machine, most of it by {most}, {percent:.0} % of a core"
            )
        } else {
            format!("no processor: {most} is busiest with {percent:.0} % of a core")
        }
    }
}

const BROKER_THREAD: &str = "mqtt-broker";

/// From here on a core counts as used up: the scheduler and the kernel's own work on packets take
/// the rest.
const BUSY_PERCENT: f64 = 80.0;

/// Lateness of sending in milliseconds from which the sender itself is overloaded.
const MAX_LATE_MS: f64 = 10.0;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bench::latency::Latencies;

    fn shares(broker: f64, fusion: f64, vehicles: f64) -> Shares {
        Shares {
            aggregator: Some(AggregatorShares { broker, fusion }),
            vehicles,
        }
    }

    fn step(refused: u64, sent_late_ms: f64, shares: Shares) -> Step {
        let map = Latencies::default().quantiles();
        let map_bytes = 0;
        let verdict_bytes = 0;
        Step {
            vehicles: 4,
            carried: false,
            map,
            verdict: None,
            map_bytes,
            verdict_bytes,
            refused,
            sent_late_ms,
            shares,
        }
    }

    #[test]
    fn busiest_process_is_named() {
        assert!(shares(95.0, 10.0, 20.0).busiest().starts_with("broker"));
        assert!(
            shares(60.0, 10.0, 1e4)
                .busiest()
                .contains("simulated vehicles")
        );
        assert!(
            shares(5.0, 10.0, 2.0)
                .busiest()
                .starts_with("no processor: aggregator")
        );
    }

    #[test]
    fn unsent_load_blames_vehicles() {
        let blame = |refused, late| step(refused, late, shares(95.0, 1.0, 1.0)).blame();
        assert!(blame(0, 9.0).starts_with("broker"));
        for (refused, late) in [(1, 0.0), (0, 11.0)] {
            let words = blame(refused, late);
            assert!(
                words.starts_with("the simulated vehicles themselves")
                    && words.contains("broker, 95 %"),
                "{words}"
            );
        }
    }

    #[test]
    fn remote_cell_is_not_blamed() {
        let elsewhere = |vehicles| {
            step(
                0,
                0.0,
                Shares {
                    aggregator: None,
                    vehicles,
                },
            )
            .blame()
        };
        assert!(elsewhere(30.0).starts_with("unknown, not this machine"));
        assert!(elsewhere(1e5).starts_with("all "));
    }
}
