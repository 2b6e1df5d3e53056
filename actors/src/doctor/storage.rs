//! The cell's key and the directories that are written.

use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::{fs, io};

use super::Finding;
use crate::node::config::NodeConfig;
use crate::observe::recorder::free_bytes;
use crate::transport::gossip::{KeyError, check_key};

/// Free space in bytes below which a directory of state is doubtful.
const LITTLE: u64 = 100_000_000;

/// Where the packaged service has its configuration, and the only directory that its unit as it comes lets it write.
const SERVICE_CONFIGURATION: &str = "/etc/ecod";
const SERVICE_STATE: &str = "/var/lib/ecod";

/// Whether there is a key, and whether others can read it.
pub(super) fn key(config: &NodeConfig) -> Finding {
    let check = "cell key";
    let membership = &config.membership;
    if !membership.has_key() {
        let fix = "set `membership.key_file`, the same on all nodes, for a cell of more than one machine";
        return Finding::doubtful(check, "none: the cell is on this machine only, and anyone here can take part", fix);
    }
    match check_key(membership, &config.cell) {
        Ok(()) => {}
        Err(error @ KeyError::TooShort { .. }) => {
            return Finding::broken(check, error.to_string(), "`openssl rand -hex 32` makes one");
        }
        Err(error) => {
            return Finding::broken(check, error.to_string(), "set `membership.key_file` to a file it can read");
        }
    }
    let Some(path) = &membership.key_file else { return Finding::fine(check, "set") };
    match fs::metadata(path) {
        Ok(facts) if facts.permissions().mode() & 0o077 != 0 => {
            let seen = format!("{} can be read by others", path.display());
            Finding::doubtful(check, seen, format!("chmod 600 {}", path.display()))
        }
        _ => Finding::fine(check, path.display().to_string()),
    }
}

/// Whether the directories can be written and have room.
pub(super) fn directories(config: &NodeConfig) -> Vec<Finding> {
    let mut findings = Vec::new();
    match &config.state_dir {
        Some(dir) => findings.push(directory("state directory", dir, LITTLE, "state_dir")),
        None if config.may_lead() => findings.push(Finding::doubtful(
            "state directory",
            "none: reputations, and the terms in which this node has led, end with it",
            "set `state_dir`",
        )),
        None => {}
    }
    if let Some(record) = &config.record {
        findings.push(directory("log directory", &record.dir, record.min_free_mb * 1_000_000, "record.dir"));
    }
    if let Some(log) = &config.map_log {
        let dir = log.parent().filter(|dir| !dir.as_os_str().is_empty()).unwrap_or(Path::new("."));
        findings.push(if dir.is_dir() {
            directory("map log", dir, LITTLE, "map_log")
        } else {
            // Directories of state and logs are made by the node, this one is not.
            let seen = format!("{} is no directory", dir.display());
            Finding::broken("map log", seen, "make it, or set `map_log` to another")
        });
    }
    findings
}

/// What a configuration of the packaged service has it write elsewhere than its unit allows: whoever runs this may be
/// able to, where the service is not.
pub(super) fn service(config: &NodeConfig, file: &Path) -> Vec<Finding> {
    if !absolute(file).starts_with(SERVICE_CONFIGURATION) {
        return Vec::new();
    }
    let writable = [vec![PathBuf::from(SERVICE_STATE)], added_to_unit()].concat();
    let record = config.record.as_ref().map(|record| &record.dir);
    let written =
        [("state_dir", config.state_dir.as_ref()), ("record.dir", record), ("map_log", config.map_log.as_ref())];
    let written = written.into_iter().filter_map(|(key, path)| Some((key, absolute(path?))));
    let outside = written.filter(|(_, path)| !writable.iter().any(|writable| path.starts_with(writable)));
    let finding = |(key, path): (&str, PathBuf)| {
        let path = path.display();
        let seen = format!("its unit does not let the service write {path}");
        let fix = format!(
            "set `{key}` to what is below {SERVICE_STATE}, or add ReadWritePaths= by `systemctl edit ecod-node`"
        );
        Finding::doubtful("service", seen, fix)
    };
    outside.map(finding).collect()
}

/// What the operator added to the unit, as far as systemd tells.
fn added_to_unit() -> Vec<PathBuf> {
    let arguments = ["show", "--property=ReadWritePaths", "--value", "ecod-node"];
    let answer = Command::new("systemctl").args(arguments).output().map(|answer| answer.stdout).unwrap_or_default();
    // A sign before a path says what to do when it is missing.
    let paths = String::from_utf8_lossy(&answer);
    paths.split_whitespace().map(|path| path.trim_start_matches(['-', '+']).into()).collect()
}

fn absolute(path: &Path) -> PathBuf {
    std::path::absolute(path).unwrap_or_else(|_| path.into())
}

fn directory(check: &'static str, dir: &Path, needed: u64, key: &str) -> Finding {
    let existing = dir.ancestors().find(|ancestor| ancestor.is_dir() || ancestor.as_os_str().is_empty());
    let existing = existing.filter(|ancestor| !ancestor.as_os_str().is_empty()).unwrap_or(Path::new("."));
    // What is between is no directory: it cannot be made.
    let blocked = dir.ancestors().find(|ancestor| ancestor.exists() && !ancestor.is_dir());
    let written = match blocked {
        Some(path) => Err(io::Error::new(io::ErrorKind::NotADirectory, format!("{} is a file", path.display()))),
        None => write_beside(existing),
    };
    let shown = dir.display();
    match written.and_then(|()| free_bytes(existing)) {
        Err(error) => {
            let fix = format!("make it writable for the user of the node, or set `{key}` to another");
            Finding::broken(check, format!("{shown}: {error}"), fix)
        }
        Ok(free) if free < needed => {
            let seen = format!("{shown} has {} MB left of {} that are needed", free / 1_000_000, needed / 1_000_000);
            let fix = if key == "record.dir" { "make room, or lower `record.min_free_mb`" } else { "make room" };
            Finding::broken(check, seen, fix)
        }
        Ok(free) => Finding::fine(check, format!("{shown}, {} MB free", free / 1_000_000)),
    }
}

fn write_beside(dir: &Path) -> io::Result<()> {
    let file: PathBuf = dir.join(format!(".ecod-doctor-{}", std::process::id()));
    fs::write(&file, b"ecod")?;
    fs::remove_file(&file)
}
