//! Checks of the cell key, of the floor plan, and of the directories that the node writes.

use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::{fs, io};

use super::Finding;
use crate::node::config::NodeConfig;
use crate::observe::recorder::free_bytes;
use crate::transport::gossip::{KeyError, check_key};

/// Minimum free bytes for state and map log.
const MIN_FREE_BYTES: u64 = 100_000_000;

/// Configuration directory of the packaged service, and the only directory that its unit lets it
/// write by default.
const SERVICE_CONFIGURATION: &str = "/etc/ecod";
const SERVICE_STATE: &str = "/var/lib/ecod";

/// Checks that a key is set and that only its user can read it.
pub(super) fn key(config: &NodeConfig) -> Finding {
    let check = "cell key";
    let membership = &config.membership;
    if !membership.has_key() {
        let fix = "for a cell of several machines, set `membership.key_file` to the same key on all nodes";
        return Finding::doubtful(
            check,
            "none: the cell is limited to this machine, where any program can join",
            fix,
        );
    }
    match check_key(membership, &config.cell) {
        Ok(()) => {}
        Err(error @ KeyError::TooShort { .. }) => {
            return Finding::broken(
                check,
                error.to_string(),
                "create one with `openssl rand -hex 32`",
            );
        }
        Err(error) => {
            return Finding::broken(
                check,
                error.to_string(),
                "set `membership.key_file` to a readable file",
            );
        }
    }
    let Some(path) = &membership.key_file else {
        return Finding::fine(check, "set");
    };
    match fs::metadata(path) {
        Ok(metadata) if metadata.permissions().mode() & 0o077 != 0 => {
            let seen = format!("{} is readable by other users", path.display());
            Finding::doubtful(check, seen, format!("chmod 600 {}", path.display()))
        }
        _ => Finding::fine(check, path.display().to_string()),
    }
}

/// Checks that the image under the page's map can be shown.
pub(super) fn floor_plan(config: &NodeConfig) -> Option<Finding> {
    let check = "floor plan";
    let plan = config.dashboard.floor_plan.as_ref()?;
    Some(match config.dashboard.load_floor_plan() {
        Ok(_) => Finding::fine(check, plan.image.display().to_string()),
        Err(error) => Finding::broken(
            check,
            error.to_string(),
            "correct `dashboard.floor_plan`, or leave it out",
        ),
    })
}

/// Checks that directories are writable and have space.
pub(super) fn directories(config: &NodeConfig) -> Vec<Finding> {
    let mut findings = Vec::new();
    match &config.state_dir {
        Some(dir) => findings.push(directory(
            "state directory",
            dir,
            MIN_FREE_BYTES,
            "state_dir",
        )),
        None if config.may_lead() => findings.push(Finding::doubtful(
            "state directory",
            "none: a restart loses reputations and the terms in which this node led",
            "set `state_dir`",
        )),
        None => {}
    }
    if let Some(record) = &config.record {
        findings.push(directory(
            "log directory",
            &record.dir,
            record.min_free_mb * 1_000_000,
            "record.dir",
        ));
    }
    if let Some(log) = &config.map_log {
        let dir = log
            .parent()
            .filter(|dir| !dir.as_os_str().is_empty())
            .unwrap_or(Path::new("."));
        findings.push(if dir.is_dir() {
            directory("map log", dir, MIN_FREE_BYTES, "map_log")
        } else {
            // The node creates directories for state and logs, but not this one.
            let seen = format!("{} is not a directory", dir.display());
            Finding::broken("map log", seen, "create it, or change `map_log`")
        });
    }
    findings
}

/// Checks that the packaged service writes only to paths that its unit allows. The user who runs
/// this check may have more rights.
pub(super) fn service(config: &NodeConfig, file: &Path) -> Vec<Finding> {
    if !absolute(file).starts_with(SERVICE_CONFIGURATION) {
        return Vec::new();
    }
    let mut writable = vec![PathBuf::from(SERVICE_STATE)];
    let unknown = match unit_paths() {
        Ok(paths) => {
            writable.extend(paths);
            None
        }
        Err(error) => Some(error),
    };
    let record = config.record.as_ref().map(|record| &record.dir);
    let paths = [
        ("state_dir", config.state_dir.as_ref()),
        ("record.dir", record),
        ("map_log", config.map_log.as_ref()),
    ];
    let written = paths
        .into_iter()
        .filter_map(|(key, path)| Some((key, absolute(path?))));
    let outside =
        written.filter(|(_, path)| !writable.iter().any(|writable| path.starts_with(writable)));
    let finding = |(key, path): (&str, PathBuf)| {
        let path = path.display();
        let seen = match &unknown {
            None => format!("the unit does not let the service write {path}"),
            Some(error) => format!(
                "the unit may not let the service write {path}; its ReadWritePaths= are unknown: {error}"
            ),
        };
        let fix = format!(
            "set `{key}` to a path below {SERVICE_STATE}, or add ReadWritePaths= with `systemctl edit ecod-node`"
        );
        Finding::doubtful("service", seen, fix)
    };
    outside.map(finding).collect()
}

/// Writable paths that the operator added to the unit, according to systemd.
fn unit_paths() -> io::Result<Vec<PathBuf>> {
    let arguments = ["show", "--property=ReadWritePaths", "--value", "ecod-node"];
    let answer = Command::new("systemctl")
        .args(arguments)
        .output()
        .map_err(|error| io::Error::new(error.kind(), format!("systemctl: {error}")))?;
    if !answer.status.success() {
        let reason = String::from_utf8_lossy(&answer.stderr);
        return Err(io::Error::other(format!("systemctl: {}", reason.trim())));
    }
    // A prefix sets how systemd treats a missing path.
    let paths = String::from_utf8_lossy(&answer.stdout);
    Ok(paths
        .split_whitespace()
        .map(|path| path.trim_start_matches(['-', '+']).into())
        .collect())
}

fn absolute(path: &Path) -> PathBuf {
    std::path::absolute(path).unwrap_or_else(|_| path.into())
}

fn directory(check: &'static str, dir: &Path, needed: u64, key: &str) -> Finding {
    let existing = dir
        .ancestors()
        .find(|ancestor| ancestor.is_dir() || ancestor.as_os_str().is_empty())
        .filter(|ancestor| !ancestor.as_os_str().is_empty())
        .unwrap_or(Path::new("."));
    // A file in the path prevents the directory.
    let blocked = dir
        .ancestors()
        .find(|ancestor| ancestor.exists() && !ancestor.is_dir());
    let written = match blocked {
        Some(path) => Err(io::Error::new(
            io::ErrorKind::NotADirectory,
            format!("{} is a file", path.display()),
        )),
        None => write_test_file(existing),
    };
    let shown = dir.display();
    match written.and_then(|()| free_bytes(existing)) {
        Err(error) => {
            let fix = format!("make it writable for the node's user, or change `{key}`");
            Finding::broken(check, format!("{shown}: {error}"), fix)
        }
        Ok(free) if free < needed => {
            let seen = format!(
                "{shown} has {} MB free of {} MB needed",
                free / 1_000_000,
                needed / 1_000_000
            );
            let fix = if key == "record.dir" {
                "free space, or lower `record.min_free_mb`"
            } else {
                "free space"
            };
            Finding::broken(check, seen, fix)
        }
        Ok(free) => Finding::fine(check, format!("{shown}, {} MB free", free / 1_000_000)),
    }
}

fn write_test_file(dir: &Path) -> io::Result<()> {
    let file: PathBuf = dir.join(format!(".ecod-doctor-{}", std::process::id()));
    fs::write(&file, b"ecod")?;
    fs::remove_file(&file)
}
