//! Whether the clock is set by somebody.

use std::path::Path;
use std::process::Command;

use super::Finding;

const CHECK: &str = "clock";

/// A service that keeps the clock writes one of these when it has set it.
const MARKS: [&str; 2] = ["/run/systemd/timesync/synchronized", "/run/chrony/chronyd.pid"];

/// Maps say nothing that needs clocks to agree, and aggregators estimate offsets; but the larger they are the less is
/// certain, and beyond `fusion.window.max_clock_offset_s` reports are rejected.
pub(super) fn synchronised() -> Finding {
    let fix = "run a time service, such as `apt install chrony` or `timedatectl set-ntp true`";
    match kernel_says() {
        Some(true) => Finding::fine(CHECK, "synchronised"),
        Some(false) => Finding::doubtful(CHECK, "not synchronised", fix),
        None if MARKS.iter().any(|mark| Path::new(mark).exists()) => Finding::fine(CHECK, "a time service runs"),
        None => Finding::doubtful(CHECK, "no time service was found", fix),
    }
}

/// What systemd reads from the kernel; `None` where there is no systemd.
fn kernel_says() -> Option<bool> {
    let arguments = ["show", "--property=NTPSynchronized", "--value"];
    let answer = Command::new("timedatectl").args(arguments).output().ok().filter(|answer| answer.status.success())?;
    match answer.stdout.trim_ascii() {
        b"yes" => Some(true),
        b"no" => Some(false),
        _ => None,
    }
}
