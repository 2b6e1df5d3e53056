//! Logs of live cells: their content, their state after a kill, and replays that reproduce the original run.

pub(crate) mod cell;
mod disk;
mod files;
#[cfg(feature = "foxglove")]
mod live;
#[cfg(feature = "camera")]
mod pictures;
mod python;

use std::collections::BTreeMap;
use std::process::Command;
use std::time::Duration;

use ecod::perception::landmark::LandmarkConfig;
use ecod::replay::FusedLine;
use ecod::wire::Role;
use ecod_actors::observe::recorder::{SchemaName, files};
use ecod_testkit::{Cell, name};

use cell::{Log, config, drive};

/// The lines and the messages of a replay of a node's log.
fn replay(log: &std::path::Path) -> (Vec<FusedLine>, String) {
    let arguments = ["replay", "--input", log.to_str().unwrap(), "--output", "-"];
    let run = Command::new(env!("CARGO_BIN_EXE_ecod-node"))
        .args(arguments)
        .output()
        .unwrap();
    let said = String::from_utf8(run.stderr).unwrap();
    assert!(run.status.success(), "{said}");
    let lines = run
        .stdout
        .split(|byte| *byte == b'\n')
        .filter(|line| !line.is_empty());
    (
        lines
            .map(|line| serde_json::from_slice(line).unwrap())
            .collect(),
        said,
    )
}

/// Whose line it is, of which term and round, and whether it is a map.
fn key(line: &FusedLine) -> (String, u64, u64, bool) {
    match line {
        FusedLine::Map(map) => (map.aggregator.to_string(), map.epoch, map.round, true),
        FusedLine::Verdicts(verdicts) => (
            verdicts.aggregator.to_string(),
            verdicts.epoch,
            verdicts.round,
            false,
        ),
    }
}

fn by_key(lines: &[FusedLine]) -> BTreeMap<(String, u64, u64, bool), String> {
    lines
        .iter()
        .map(|line| (key(line), serde_json::to_string(line).unwrap()))
        .collect()
}

/// Every map and verdict of every leader comes out of its log again, to the last bit, across a failover and back.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn replayed_log_reproduces_every_leader() {
    let mut cell = Cell::new(config);
    for (node, role) in [
        ("edge", Role::Edge),
        ("euclid", Role::Auto),
        ("gauss", Role::Auto),
    ] {
        cell.start(node, role).await;
    }
    cell.served_by("edge").await;
    drive(&cell, Duration::from_secs(3)).await;
    cell.kill("edge");
    let substitute = cell.served_by_another_than("edge").await;
    drive(&cell, Duration::from_secs(2)).await;
    cell.start("edge", Role::Edge).await;
    cell.served_by("edge").await;
    drive(&cell, Duration::from_secs(2)).await;
    let directory = cell.stop().await;

    let mut leaders = Vec::new();
    for node in ["edge", "euclid", "gauss"] {
        let dir = directory.path().join(node);
        let recorded = Log::read(&dir);
        let own: Vec<_> = recorded
            .fused()
            .into_iter()
            .filter(|line| key(line).0 == node)
            .collect();
        let (again, said) = replay(&dir);
        let own = by_key(&own);
        let again = by_key(&again);
        for (key, line) in &own {
            assert_eq!(again.get(key), Some(line), "{node}: {key:?}\n{said}");
        }
        // A killed node has made rounds that it had no time to write down, and the other way round.
        let more = again.keys().filter(|key| !own.contains_key(*key)).count();
        assert!(
            more <= 20,
            "{node}: {more} rounds of {} were not recorded",
            again.len()
        );
        assert!(
            !said.contains("missing") && !said.contains("middle"),
            "{said}"
        );
        // A node that leads only while the others stop has no reports to fuse.
        if node == "edge" || node == substitute {
            assert!(
                own.values().any(|line| line.contains("\"euclid\"")),
                "{node} fused reports"
            );
        }
        leaders.extend((!own.is_empty()).then_some(node));
        eprintln!("{node}: {} recorded, {} made again", own.len(), again.len());
    }
    assert!(
        leaders.contains(&"edge") && leaders.contains(&&*substitute),
        "{leaders:?}"
    );
}

/// An edit between two runs of a node holds for the second alone, also when both are made again.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn each_run_keeps_its_configuration() {
    let mut cell = Cell::new(config);
    cell.start("edge", Role::Edge).await;
    cell.start("euclid", Role::Cav).await;
    cell.served_by("edge").await;
    drive(&cell, Duration::from_secs(1)).await;
    cell.kill("edge");
    let mut config = cell.config("edge", Role::Edge);
    config
        .landmarks
        .push(LandmarkConfig::at("slot-2", 6.0, 1.0));
    cell.start_with(config).await;
    cell.served_by("edge").await;
    drive(&cell, Duration::from_secs(2)).await;
    let directory = cell.stop().await;

    let dir = directory.path().join("edge");
    let own = by_key(&Log::read(&dir).fused());
    let (again, said) = replay(&dir);
    let again = by_key(&again);
    for (key, line) in &own {
        assert_eq!(again.get(key), Some(line), "{key:?}\n{said}");
    }
    let of_second_run = own.values().filter(|line| line.contains("slot-2")).count();
    assert!(
        of_second_run > 5 && of_second_run < own.len(),
        "{of_second_run} of {}",
        own.len()
    );
    assert!(
        !said.contains("missing") && !said.contains("middle"),
        "{said}"
    );
}

/// An observer's log has the messages of the whole cell, and its reports can be fused, also across several runs.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn observer_records_all_messages() {
    let mut cell = Cell::new(config);
    cell.start("edge", Role::Edge).await;
    cell.start("euclid", Role::Auto).await;
    cell.served_by("edge").await;
    let dir = cell.directory().join("observer");
    let seed = cell.node("edge").gossip_address().unwrap().to_string();
    let config = cell.directory().join("edge.toml");
    std::fs::write(
        &config,
        toml::to_string(&cell.config("edge", Role::Edge)).unwrap(),
    )
    .unwrap();
    let arguments = [
        "record",
        "--config",
        config.to_str().unwrap(),
        "--dir",
        dir.to_str().unwrap(),
        "--seed",
        &seed,
    ];
    for time in [Duration::from_secs(4), Duration::from_secs(2)] {
        let observer = Command::new(env!("CARGO_BIN_EXE_ecod-node"))
            .args(arguments)
            .spawn()
            .unwrap();
        let name = format!("edge--recorder-{}", observer.id());
        let mut observer = disk::Process(observer);
        cell.until("the observer is a member", |cell| {
            cell.node("edge")
                .members()
                .borrow()
                .iter()
                .any(|member| member.name.as_str() == name)
                .then_some(())
        })
        .await;
        drive(&cell, time).await;
        observer.terminate();
    }
    let _directory = cell.stop().await;

    let log = Log::read(&dir);
    for schema in [
        SchemaName::ObjectReport,
        SchemaName::GlobalMap,
        SchemaName::Verdicts,
        SchemaName::Reputations,
        SchemaName::NodeStatus,
        SchemaName::Leadership,
        SchemaName::Counters,
        SchemaName::SceneUpdate,
        SchemaName::FrameTransform,
        SchemaName::Log,
    ] {
        assert!(log.count(schema) > 0, "{schema:?}");
    }
    assert_eq!(log.count(SchemaName::JournalEntry), 0);
    assert!(log.problems.is_empty(), "{:?}", log.problems);
    let (lines, said) = replay(&dir);
    let labels = |line: &FusedLine| match line {
        FusedLine::Map(map) => map.landmarks[0].label.clone(),
        FusedLine::Verdicts(verdicts) => verdicts.verdicts[0].label.clone(),
    };
    assert!(
        lines.len() > 20
            && lines
                .iter()
                .filter(|line| labels(line).as_deref() == Some("car"))
                .count()
                > 20,
        "{said}"
    );
    assert!(lines.iter().all(|line| key(line).0 == "recorder"));
    let identity = log.identity.unwrap();
    assert_eq!(
        (identity.cell, identity.node),
        (name("cell"), name("recorder"))
    );
    let files = files(&dir).unwrap();
    let is_named = |file: &std::path::PathBuf| {
        file.file_name()
            .unwrap()
            .to_str()
            .unwrap()
            .starts_with("recorder-2")
    };
    assert!(
        files.len() == 2 && files.iter().all(is_named),
        "a limit holds for all runs: {files:?}"
    );
    let (alone, _) = replay(&files[0]);
    assert!(alone.len() < lines.len(), "the second run is replayed too");
}
