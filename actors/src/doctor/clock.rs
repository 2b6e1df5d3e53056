//! Check of clock synchronisation.

use std::path::Path;
use std::process::Command;

use super::Finding;

const CHECK: &str = "clock";

/// Files that time services write when they run or have set the clock.
const MARKS: [&str; 2] = [
    "/run/systemd/timesync/synchronized",
    "/run/chrony/chronyd.pid",
];

/// State of the service that keeps the clock. Aggregators estimate clock offsets, but larger ones
/// cost accuracy, and they reject reports beyond `fusion.window.max_clock_offset_s`.
pub(super) fn synchronised() -> Finding {
    let fix = "run a time service, such as `apt install chrony` or `timedatectl set-ntp true`";
    match kernel_state() {
        Some(true) => Finding::fine(CHECK, "synchronised"),
        Some(false) => Finding::doubtful(CHECK, "not synchronised", fix),
        None if MARKS.iter().any(|mark| Path::new(mark).exists()) => {
            Finding::fine(CHECK, "a time service runs")
        }
        None => Finding::doubtful(CHECK, "no time service was found", fix),
    }
}

/// The kernel's state as systemd reports it; `None` without systemd.
fn kernel_state() -> Option<bool> {
    let arguments = ["show", "--property=NTPSynchronized", "--value"];
    let answer = Command::new("timedatectl")
        .args(arguments)
        .output()
        .ok()
        .filter(|answer| answer.status.success())?;
    match answer.stdout.trim_ascii() {
        b"yes" => Some(true),
        b"no" => Some(false),
        _ => None,
    }
}
