//! Processor time that a hypervisor withholds: failures of a cell in this time are not failures of the cell.
//!
//! If the host of a virtual machine is busy, runnable processes stall, all at once and for longer than a leader may be
//! silent. Linux counts this time as steal (proc_stat(5)) if the host reports it. Otherwise a thread that only sleeps
//! wakes too late; other busy processes of the machine delay a sleeper only by milliseconds.

use std::fs;
use std::num::NonZero;
use std::time::Duration;

use anyhow::Context;
use tokio::time::{Instant, sleep_until};

/// Least time over which withheld time is added up.
const WINDOW: Duration = Duration::from_millis(500);

/// Time between readings.
const PERIOD: Duration = Duration::from_millis(50);

/// Largest part of the processors' time that may be withheld in half a second: on two processors as much as the closest
/// bar of a trial leaves beyond the time between two rounds.
const MOST_WITHHELD: f64 = 0.1;

/// By how much a sleeper may wake too late: a round.
const LONGEST_DELAY: Duration = Duration::from_millis(100);

/// Ticks of /proc/stat per second, on all common architectures.
const TICKS_PER_S: u64 = 100;

/// Waits, and records meanwhile the processor time that is withheld from the machine.
#[derive(Debug, Default)]
pub(crate) struct Machine {
    /// When, and time withheld from all processors since the machine was started.
    readings: Vec<(Instant, Duration)>,
    /// By how much it woke too late at most.
    longest_delay: Duration,
}

impl Machine {
    /// Waits for so long.
    pub(crate) async fn sleep(&mut self, time: Duration) -> anyhow::Result<()> {
        let deadline = Instant::now() + time;
        loop {
            let now = Instant::now();
            self.readings.push((now, withheld()?));
            if now >= deadline {
                return Ok(());
            }
            let wake = deadline.min(now + PERIOD);
            sleep_until(wake).await;
            self.longest_delay = self.longest_delay.max(wake.elapsed());
        }
    }

    /// True if an event may be late because of withheld processor time.
    pub(crate) fn is_starved(&self) -> bool {
        self.most_withheld() > MOST_WITHHELD || self.longest_delay > LONGEST_DELAY
    }

    /// The findings in words.
    pub(crate) fn account(&self) -> String {
        let withheld = 100.0 * self.most_withheld();
        let delay = self.longest_delay;
        format!(
            "{withheld:.0} % of the processors' time withheld, a sleeper late by {} ms",
            delay.as_millis()
        )
    }

    /// The largest part of the processors' time that was withheld over half a second, 0 to 1.
    fn most_withheld(&self) -> f64 {
        let processors = std::thread::available_parallelism().map_or(1, NonZero::get);
        let part = |(index, (from, before)): (usize, &(Instant, Duration))| {
            let later = &self.readings[index..];
            let end = later.partition_point(|(at, _)| *at < *from + WINDOW);
            let (until, after) = later.get(end).or(later.last())?;
            let span = until.saturating_duration_since(*from).max(WINDOW);
            Some(after.saturating_sub(*before).as_secs_f64() / span.as_secs_f64())
        };
        self.readings
            .iter()
            .enumerate()
            .filter_map(part)
            .fold(0.0, f64::max)
            / processors as f64
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
        let reading = |(at, withheld)| {
            (
                start + Duration::from_millis(at),
                Duration::from_millis(withheld),
            )
        };
        Machine {
            readings: readings.into_iter().map(reading).collect(),
            ..Machine::default()
        }
    }

    #[test]
    fn withheld_share_uses_half_seconds() {
        let all = std::thread::available_parallelism().unwrap().get() as u64;
        let part = |readings: &[(u64, u64)]| {
            (100.0
                * machine(readings.iter().map(|(at, withheld)| (*at, withheld * all)))
                    .most_withheld())
            .round()
        };
        let now_and_then: Vec<_> = (0..100).map(|n| (50 * n, 1000 + 10 * (n / 2))).collect();
        assert_eq!(part(&now_and_then), 10.0);
        assert_eq!(
            part(&[
                (0, 7),
                (50, 7),
                (100, 107),
                (150, 107),
                (500, 107),
                (1000, 110)
            ]),
            20.0
        );
        assert_eq!(
            part(&[(0, 0), (50, 0), (2050, 400)]),
            20.0,
            "the reader stood still as well"
        );
        assert_eq!(part(&[(0, 0), (100, 50)]), 10.0);
        assert_eq!(part(&[]), 0.0);
    }

    #[tokio::test]
    async fn standing_machine_counts_as_starved() {
        let mut machine = Machine::default();
        let (watch, _) = tokio::join!(machine.sleep(3 * PERIOD), async {
            std::thread::sleep(PERIOD + 2 * LONGEST_DELAY);
        });
        watch.unwrap();
        assert!(machine.is_starved(), "{machine:?}");
    }

    #[test]
    fn kernel_reports_stolen_time() {
        let stat = "cpu  4369460 138814 225846 1134129 11171 0 7106 391122 0 0\ncpu0 1 2 3 4 5 6 7 8 9 10\n";
        assert_eq!(stolen(stat), Some(Duration::from_millis(3_911_220)));
        assert_eq!(stolen("cpu  1 2 3 4\n"), None);
        withheld().unwrap();
    }
}
