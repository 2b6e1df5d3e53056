//! Resources used by the process, under the names common to Prometheus clients.

use std::sync::atomic::AtomicU64;

use ecod::model::time::Timestamp;
use nix::sys::resource::{UsageWho, getrusage};
use nix::sys::time::TimeVal;
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::registry::{Registry, Unit};

use crate::telemetry::line_throttle::lines_left_out;

/// Registers CPU time, memory and start time, as far as the operating system provides them, and the
/// number of skipped log lines.
pub fn register(registry: &mut Registry, started_at: Timestamp) {
    let started = Gauge::<f64, AtomicU64>::default();
    started.set(started_at.micros() as f64 / 1e6);
    registry.register_with_unit(
        "process_start_time",
        "Unix time at which the node started",
        Unit::Seconds,
        started,
    );
    let left_out = Counter::<u64>::default();
    left_out.inc_by(lines_left_out());
    registry.register(
        "ecod_log_lines_left_out",
        "Log lines that the throttle of log lines left out",
        left_out,
    );
    if let Ok(usage) = getrusage(UsageWho::RUSAGE_SELF) {
        let cpu = Counter::<f64, AtomicU64>::default();
        cpu.inc_by(seconds(usage.user_time()) + seconds(usage.system_time()));
        registry.register_with_unit(
            "process_cpu",
            "User and system time used",
            Unit::Seconds,
            cpu,
        );
    }
    if let Some(bytes) = resident_bytes() {
        let memory = Gauge::<i64>::default();
        memory.set(bytes);
        registry.register_with_unit(
            "process_resident_memory",
            "Memory in use",
            Unit::Bytes,
            memory,
        );
    }
}

fn seconds(time: TimeVal) -> f64 {
    time.tv_sec() as f64 + time.tv_usec() as f64 / 1e6
}

fn resident_bytes() -> Option<i64> {
    let text = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = text.lines().find_map(|line| line.strip_prefix("VmRSS:"))?;
    let kilobytes: i64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(kilobytes * 1024)
}
