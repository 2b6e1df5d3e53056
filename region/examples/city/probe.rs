//! Processor time and memory of a process.

use std::fs;
use std::time::Instant;

/// Counts from its start.
pub(crate) struct Meter {
    pid: u32,
    begun: Instant,
    before_s: f64,
}

impl Meter {
    pub(crate) fn start(pid: u32) -> Self {
        Self {
            pid,
            begun: Instant::now(),
            before_s: cpu_s(pid),
        }
    }

    /// Percent of a core since the start, and resident memory in megabytes.
    pub(crate) fn read(&self) -> (f64, f64) {
        let percent =
            100.0 * (cpu_s(self.pid) - self.before_s) / self.begun.elapsed().as_secs_f64();
        let status = fs::read_to_string(format!("/proc/{}/status", self.pid)).unwrap_or_default();
        let line = status
            .lines()
            .find_map(|line| line.strip_prefix("VmRSS:"))
            .unwrap_or_default();
        let kilobytes: f64 = line.trim().trim_end_matches(" kB").parse().unwrap_or(0.0);
        (percent.max(0.0), kilobytes / 1024.0)
    }
}

/// User and system time of all threads in seconds; clock ticks are 10 ms.
fn cpu_s(pid: u32) -> f64 {
    let stat = fs::read_to_string(format!("/proc/{pid}/stat")).unwrap_or_default();
    let fields: Vec<_> = stat
        .rsplit(')')
        .next()
        .unwrap_or_default()
        .split_whitespace()
        .collect();
    let ticks = |index: usize| {
        fields
            .get(index)
            .and_then(|field| field.parse::<f64>().ok())
            .unwrap_or(0.0)
    };
    (ticks(11) + ticks(12)) / 100.0
}
