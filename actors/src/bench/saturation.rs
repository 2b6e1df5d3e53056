//! How many vehicles a cell carries.

use std::time::Duration;

use serde::Serialize;

use super::latency::Quantiles;
use super::load::Load;
use super::measurement::{Measurement, Target, measure};

/// A load is carried while 99 of 100 answers take less, and none is missing.
pub const LIMIT: Duration = Duration::from_millis(100);

/// One load of the search.
#[derive(Debug, Clone, Serialize)]
pub struct Step {
    /// Vehicles, each with ten reports a second.
    pub vehicles: usize,
    /// Whether the load was carried.
    pub carried: bool,
    /// From a round's last report to its map, at every vehicle.
    #[serde(flatten)]
    pub latency: Quantiles,
    /// Bytes of the map, which goes to every vehicle.
    pub map_bytes: usize,
    /// Who used how much.
    pub shares: Shares,
}

/// Processor time in percent of one core.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Shares {
    /// The aggregator's embedded broker: one thread.
    pub broker: f64,
    /// The rest of the aggregator: gateway, fuser, dashboard.
    pub fusion: f64,
    /// The simulated vehicles.
    pub vehicles: f64,
}

/// What a search came to.
#[derive(Debug, Clone, Serialize)]
pub struct Saturation {
    /// The most vehicles that were carried; none if not even the first load was.
    pub most_vehicles: Option<usize>,
    /// What was at its end at the least load that was not carried, in words; none if all were carried.
    pub first_saturated: Option<String>,
    /// All loads, as they were tried.
    pub steps: Vec<Step>,
}

/// Doubles the load from `least` to `most` until it is not carried any more, then halves the distance to the last that
/// was, down to an eighth.
///
/// # Errors
/// As [`measure`], and what `tell` returns.
pub async fn search(
    target: &Target,
    [least, most]: [usize; 2],
    duration: Duration,
    tell: impl Fn(&Step) -> anyhow::Result<()>,
) -> anyhow::Result<Saturation> {
    let mut steps: Vec<Step> = Vec::new();
    let mut vehicles = least;
    loop {
        let measured = measure(target, Load { bare: false, ..Load::new(vehicles, duration) }).await?;
        let step = Step::new(vehicles, &measured);
        tell(&step)?;
        steps.push(step);
        let carried = steps.iter().filter(|step| step.carried).map(|step| step.vehicles).max();
        let failed = steps.iter().filter(|step| !step.carried).map(|step| step.vehicles).min();
        vehicles = match (carried, failed) {
            (Some(carried), None) if carried < most => (2 * carried).min(most),
            (Some(carried), Some(failed)) if failed - carried > (carried / 8).max(1) => carried.midpoint(failed),
            (most_vehicles, _) => {
                let first_failed = steps.iter().filter(|step| !step.carried).min_by_key(|step| step.vehicles);
                let first_saturated = first_failed.map(|step| step.shares.busiest());
                return Ok(Saturation { most_vehicles, first_saturated, steps });
            }
        };
    }
}

impl Step {
    fn new(vehicles: usize, measured: &Measurement) -> Self {
        let latency = measured.cell.quantiles();
        let carried = latency.missing == 0 && latency.p99_us < LIMIT.as_micros() as f64;
        Self { vehicles, carried, latency, map_bytes: measured.map_bytes, shares: Shares::of(measured) }
    }
}

impl Shares {
    /// What a load cost; of a cell that is not this program's own, only the vehicles are known.
    pub fn of(measured: &Measurement) -> Self {
        let aggregator = measured.aggregator.clone().unwrap_or_default();
        let broker = aggregator.percent_of(BROKER_THREAD);
        Self { broker, fusion: aggregator.percent() - broker, vehicles: measured.vehicles.percent() }
    }

    /// What has nothing left: a single thread with a core of its own, or all cores, and who takes most of them.
    fn busiest(self) -> String {
        let Self { broker, fusion, vehicles } = self;
        if broker > BUSY_PERCENT {
            return format!("broker, {broker:.0} % of a core with its one thread");
        }
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let parts = [("broker", broker), ("aggregator", fusion), ("simulated vehicles", vehicles)];
        let (most, percent) = parts.into_iter().max_by(|a, b| a.1.total_cmp(&b.1)).unwrap_or(("nothing", 0.0));
        if broker + fusion + vehicles > BUSY_PERCENT * cores as f64 {
            format!("all {cores} cores of this machine, most of it by {most}, {percent:.0} % of a core")
        } else {
            format!("no processor: {most} is busiest with {percent:.0} % of a core")
        }
    }
}

const BROKER_THREAD: &str = "mqtt-broker";

/// From here on a core counts as used up: the scheduler and the kernel's own work on packets take the rest.
const BUSY_PERCENT: f64 = 80.0;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn whoever_is_at_its_end_is_named() {
        let shares = |broker, fusion, vehicles| Shares { broker, fusion, vehicles }.busiest();
        assert!(shares(95.0, 10.0, 20.0).starts_with("broker"));
        assert!(shares(60.0, 10.0, 1e4).contains("simulated vehicles"));
        assert!(shares(5.0, 10.0, 2.0).starts_with("no processor: aggregator"));
    }
}
