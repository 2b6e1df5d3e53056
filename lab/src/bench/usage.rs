//! Costs of processes, by Linux's own count.

use std::collections::BTreeMap;
use std::fs;
use std::time::{Duration, Instant};

use anyhow::Context;

/// Processor time of one process between two moments.
#[derive(Debug)]
pub struct UsageMeter {
    pid: u32,
    begun: Instant,
    before: BTreeMap<u32, (String, Duration)>,
}

/// Processor time and memory of a process.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Usage {
    /// Percent of one core, by the names of its threads.
    pub threads: BTreeMap<String, f64>,
    /// Resident memory at the end, in bytes.
    pub resident_bytes: u64,
    /// Resident memory that is not backed by files: heap and stacks, not code and libraries.
    pub anonymous_bytes: u64,
}

impl UsageMeter {
    /// Starts to measure the process with this id.
    pub fn start(pid: u32) -> Self {
        Self {
            pid,
            begun: Instant::now(),
            before: threads(pid),
        }
    }

    /// Usage until now; threads that ended in between are not counted.
    ///
    /// # Errors
    /// Returns an error if the process has ended.
    pub fn stop(self) -> anyhow::Result<Usage> {
        let span = self.begun.elapsed().as_secs_f64();
        let mut usage = Usage {
            resident_bytes: memory_bytes(self.pid, "VmRSS:")?,
            anonymous_bytes: memory_bytes(self.pid, "RssAnon:")?,
            ..Usage::default()
        };
        for (thread, (name, time)) in threads(self.pid) {
            let before = self
                .before
                .get(&thread)
                .map_or(Duration::ZERO, |(_, time)| *time);
            let percent = 100.0 * time.saturating_sub(before).as_secs_f64() / span;
            *usage.threads.entry(name).or_default() += percent;
        }
        Ok(usage)
    }
}

impl Usage {
    /// All threads together, in percent of one core.
    pub fn percent(&self) -> f64 {
        self.threads.values().sum()
    }

    /// The threads of a name, in percent of one core.
    pub fn percent_of(&self, name: &str) -> f64 {
        self.threads.get(name).copied().unwrap_or(0.0)
    }
}

/// Names and processor times of the threads; empty if the process has ended.
fn threads(pid: u32) -> BTreeMap<u32, (String, Duration)> {
    let Ok(tasks) = fs::read_dir(format!("/proc/{pid}/task")) else {
        return BTreeMap::new();
    };
    let thread = |entry: fs::DirEntry| {
        let number = entry.file_name().to_str()?.parse().ok()?;
        let name = fs::read_to_string(entry.path().join("comm"))
            .ok()?
            .trim_end()
            .to_owned();
        // Nanoseconds on a processor, nanoseconds of waiting for one, time slices.
        let times = fs::read_to_string(entry.path().join("schedstat")).ok()?;
        let nanos = times.split_whitespace().next()?.parse().ok()?;
        Some((number, (name, Duration::from_nanos(nanos))))
    };
    tasks.flatten().filter_map(thread).collect()
}

fn memory_bytes(pid: u32, key: &str) -> anyhow::Result<u64> {
    let path = format!("/proc/{pid}/status");
    let text = fs::read_to_string(&path).with_context(|| format!("cannot read {path}"))?;
    // A process that has ended and was not waited for has no memory.
    let line = text
        .lines()
        .find_map(|line| line.strip_prefix(key))
        .with_context(|| format!("no {key} in {path}: the process has ended"))?;
    let kilobytes: u64 = line
        .trim()
        .trim_end_matches("kB")
        .trim_end()
        .parse()
        .with_context(|| format!("{key} in {path}"))?;
    Ok(kilobytes * 1024)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn busy_thread_is_named() {
        let (stop, stopped) = std::sync::mpsc::channel::<()>();
        let work = move || while stopped.try_recv() == Err(std::sync::mpsc::TryRecvError::Empty) {};
        let worker = std::thread::Builder::new()
            .name("busy-bee".into())
            .spawn(work)
            .unwrap();
        let meter = UsageMeter::start(std::process::id());
        std::thread::sleep(Duration::from_millis(200));
        let usage = meter.stop().unwrap();
        drop(stop);
        worker.join().unwrap();
        assert!(usage.percent_of("busy-bee") > 1.0, "{usage:?}");
        assert!(usage.percent() >= usage.percent_of("busy-bee"));
        assert!(usage.resident_bytes > 1_000_000);
    }

    #[test]
    fn ended_process_has_no_usage() {
        let mut ended = std::process::Command::new("true").spawn().unwrap();
        let meter = UsageMeter::start(ended.id());
        ended.wait().unwrap();
        assert!(meter.stop().is_err());
    }
}
