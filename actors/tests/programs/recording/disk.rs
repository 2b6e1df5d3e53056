//! Processes that are killed, and disks that refuse writes.

use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use ecod::wire::Role;
use ecod_actors::node;
use ecod_actors::observe::recorder::{RecordConfig, SchemaName, files};
use ecod_actors::telemetry::counters::Event;
use ecod_testkit::until;
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

use crate::recording::cell::{Log, config};

/// A node as a process; killed when dropped.
pub(crate) struct Process(pub(crate) Child);

impl Process {
    /// Sends the process a termination signal, and waits for its end.
    pub(crate) fn terminate(&mut self) {
        kill(Pid::from_raw(self.0.id() as i32), Signal::SIGTERM).unwrap();
        assert!(self.0.wait().unwrap().success());
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        self.0.kill().ok();
        self.0.wait().unwrap();
    }
}

/// An edge that records, started by a shell after `prelude`.
pub(crate) fn edge(directory: &Path, prelude: &str) -> Process {
    node_of(Role::Edge, directory, prelude)
}

/// The same node in another role; its name is still `edge`.
pub(crate) fn node_of(role: Role, directory: &Path, prelude: &str) -> Process {
    let file = directory.join("edge.toml");
    let config = config("edge", role, directory);
    std::fs::write(&file, toml::to_string(&config).unwrap()).unwrap();
    let script = format!(
        "{prelude} exec {} --config {}",
        env!("CARGO_BIN_EXE_ecod-node"),
        file.display()
    );
    let log = std::fs::File::create(directory.join("edge.log")).unwrap();
    Process(
        Command::new("sh")
            .args(["-c", &script])
            .stdout(Stdio::null())
            .stderr(log)
            .spawn()
            .unwrap(),
    )
}

pub(crate) fn wait_until(what: &str, directory: &Path, holds: impl Fn() -> bool) {
    let deadline = Instant::now() + Duration::from_secs(30);
    while !holds() {
        let log = || std::fs::read_to_string(directory.join("edge.log")).unwrap_or_default();
        assert!(Instant::now() < deadline, "never: {what}\n{}", log());
        std::thread::sleep(Duration::from_millis(50));
    }
}

pub(crate) fn maps(directory: &Path) -> usize {
    if directory.exists() {
        Log::read(directory).count(SchemaName::GlobalMap)
    } else {
        0
    }
}

/// SIGKILL costs the unflushed entries, at most a second; the remaining entries are read.
#[test]
fn log_survives_process_kill() {
    let directory = tempfile::tempdir().unwrap();
    let dir = directory.path().join("edge");
    let mut process = edge(directory.path(), "");
    wait_until("maps are on the disk", directory.path(), || {
        maps(&dir) >= 20
    });
    process.0.kill().unwrap();
    let killed_at = ecod_actors::platform::clock::now();
    process.0.wait().unwrap();
    let log = Log::read(&dir);
    assert!(log.count(SchemaName::GlobalMap) >= 20 && log.identity.is_some());
    assert!(
        log.problems
            .iter()
            .all(|problem| problem.contains("not finished")),
        "{:?}",
        log.problems
    );
    let lost = killed_at.since(log.messages.last().unwrap().at);
    eprintln!("lost to SIGKILL: {lost:?}");
    assert!(lost < Duration::from_secs(4), "{lost:?} were lost");
}

/// A file that takes no more, as on a full disk, is given up for the next; the node goes on all the while.
#[test]
fn full_disk_costs_entries_only() {
    let directory = tempfile::tempdir().unwrap();
    let dir = directory.path().join("edge");
    let mut process = edge(directory.path(), "trap '' XFSZ; ulimit -f 24;");
    wait_until("a second file", directory.path(), || {
        files(&dir).is_ok_and(|files| files.len() >= 2)
    });
    wait_until("maps in the second file", directory.path(), || {
        let log = Log::read(&dir);
        log.problems
            .iter()
            .any(|problem| problem.contains("not finished"))
            && log.count(SchemaName::GlobalMap) > 0
    });
    assert_eq!(process.0.try_wait().unwrap(), None, "the node goes on");
    let said = std::fs::read_to_string(directory.path().join("edge.log")).unwrap();
    assert!(said.contains("not recording, the node goes on"), "{said}");
    process.terminate();
    let log = Log::read(&dir);
    let is = |message: &&ecod_actors::observe::recorder::LogMessage, text: &str| {
        message.schema == SchemaName::JournalEntry
            && String::from_utf8_lossy(&message.json).contains(text)
    };
    assert!(
        log.messages
            .iter()
            .any(|message| is(&message, "\"continue\"")),
        "the second file states its beginning"
    );
    assert!(
        log.messages
            .iter()
            .any(|message| is(&message, "\"missing\"")),
        "and that something is lost"
    );
}

/// A follower accepts reports of others only if configured to do so. The test checks the node's log, in addition to
/// missing results afterwards.
#[test]
fn follower_notes_missing_reports() {
    for (role, says_so) in [(Role::Cav, true), (Role::Auto, false)] {
        let directory = tempfile::tempdir().unwrap();
        let _process = node_of(role, directory.path(), "");
        let said =
            || std::fs::read_to_string(directory.path().join("edge.log")).unwrap_or_default();
        wait_until("it records", directory.path(), || {
            said().contains("edge/edge-")
        });
        assert_eq!(
            said().contains("key `record.reports` is false"),
            says_so,
            "{}",
            said()
        );
    }
}

/// A map log on a full or unwritable disk does not prevent maps or the start.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn unwritable_log_delays_no_map() {
    for path in ["/dev/full", "/proc/maps.jsonl"] {
        let directory = tempfile::tempdir().unwrap();
        let mut config = config("edge", Role::Edge, directory.path());
        config.map_log = Some(path.into());
        config.record = None;
        let node = node::start(config).await.unwrap();
        let mut maps = node.newest_map();
        let reached =
            maps.wait_for(|newest| newest.as_ref().is_some_and(|newest| newest.map.round > 5));
        tokio::time::timeout(Duration::from_secs(30), reached)
            .await
            .expect("maps go on")
            .unwrap();
        node.stop().await;
    }
}

/// A directory that cannot be made is counted and tried again.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn failed_directory_is_retried() {
    let directory = tempfile::tempdir().unwrap();
    let mut config = config("edge", Role::Edge, directory.path());
    let dir = directory.path().join("blocked/log");
    std::fs::write(directory.path().join("blocked"), "a file").unwrap();
    config.record = Some(RecordConfig {
        min_free_mb: 0,
        ..RecordConfig::new(&dir)
    });
    let node = node::start(config).await.unwrap();
    let counters = node.counters().clone();
    until("failures are counted", || {
        counters.events(Event::RecordFailed) > 0
    })
    .await;
    until("the node leads", || node.newest_map().borrow().is_some()).await;
    assert_eq!(counters.events(Event::Recorded), 0);
    assert!(counters.events(Event::RecordDropped) > 0);
    std::fs::remove_file(directory.path().join("blocked")).unwrap();
    until("entries are written", || {
        counters.events(Event::Recorded) > 20
    })
    .await;
    node.stop().await;
    assert!(Log::read(&dir).count(SchemaName::GlobalMap) > 0);
}
