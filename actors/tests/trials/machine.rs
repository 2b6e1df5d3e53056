//! Processor time that a hypervisor withholds: what a cell misses for want of it tells nothing of the cell.
//!
//! Where the host of a virtual machine is busy, processes that could run stand still, all at once and for longer than a
//! leader may be silent. Linux counts that time (steal, proc_stat(5)); no load within the machine adds to it.

use std::fs;
use std::time::Duration;

use anyhow::Context;
use tokio::time::{Instant, sleep};

/// Time over which withheld time is added up.
const WINDOW: Duration = Duration::from_millis(500);

/// Time between readings.
const PERIOD: Duration = Duration::from_millis(50);

/// Ticks of /proc/stat per second, on all common architectures.
const TICKS_PER_S: u64 = 100;

/// Waits, and notes meanwhile what the machine does not get.
#[derive(Debug, Default)]
pub(crate) struct Machine {
    /// When, and time withheld from all processors since the machine was started.
    readings: Vec<(Instant, Duration)>,
}

impl Machine {
    /// Waits for so long.
    pub(crate) async fn sleep(&mut self, time: Duration) -> anyhow::Result<()> {
        self.sleep_until(Instant::now() + time).await
    }

    /// Waits until then.
    pub(crate) async fn sleep_until(&mut self, deadline: Instant) -> anyhow::Result<()> {
        loop {
            let now = Instant::now();
            self.readings.push((now, withheld()?));
            if now >= deadline {
                return Ok(());
            }
            sleep(PERIOD.min(deadline - now)).await;
        }
    }

    /// The most processor time that was withheld within half a second.
    pub(crate) fn most_withheld(&self) -> Duration {
        let within = |(index, (from, before)): (usize, &(Instant, Duration))| {
            let later = &self.readings[index..];
            let end = later.partition_point(|(at, _)| *at < *from + WINDOW);
            let (_, after) = later.get(end).or(later.last())?;
            Some(after.saturating_sub(*before))
        };
        self.readings.iter().enumerate().filter_map(within).max().unwrap_or_default()
    }
}

/// Time withheld from all processors since the machine was started.
fn withheld() -> anyhow::Result<Duration> {
    const FILE: &str = "/proc/stat";
    let text = fs::read_to_string(FILE).context(FILE)?;
    stolen(&text).with_context(|| format!("{FILE} has no time of steal"))
}

/// The eighth number of the line for all processors.
fn stolen(stat: &str) -> Option<Duration> {
    let all = stat.lines().find_map(|line| line.strip_prefix("cpu "))?;
    let ticks: u64 = all.split_whitespace().nth(7)?.parse().ok()?;
    Some(Duration::from_millis(ticks * 1000 / TICKS_PER_S))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn machine(readings: impl IntoIterator<Item = (u64, u64)>) -> Machine {
        let start = Instant::now();
        let reading = |(at, withheld)| (start + Duration::from_millis(at), Duration::from_millis(withheld));
        Machine { readings: readings.into_iter().map(reading).collect() }
    }

    #[test]
    fn what_is_withheld_adds_up_over_half_a_second() {
        let now_and_then = machine((0..100).map(|n| (50 * n, 1000 + 10 * (n / 2))));
        assert_eq!(now_and_then.most_withheld(), Duration::from_millis(50));
        let once = machine([(0, 7), (50, 7), (100, 130), (150, 130), (2000, 140)]);
        assert_eq!(once.most_withheld(), Duration::from_millis(133));
        assert_eq!(machine([]).most_withheld(), Duration::ZERO);
    }

    #[test]
    fn the_kernel_says_how_much_it_is() {
        let stat = "cpu  4369460 138814 225846 1134129 11171 0 7106 391122 0 0\ncpu0 1 2 3 4 5 6 7 8 9 10\n";
        assert_eq!(stolen(stat), Some(Duration::from_millis(3_911_220)));
        assert_eq!(stolen("cpu  1 2 3 4\n"), None);
        withheld().unwrap();
    }
}
