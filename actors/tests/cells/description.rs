//! One description for all nodes of a cell: set at one, used by all, kept across restarts.

use std::net::SocketAddr;
use std::path::Path;
use std::process::{Command, Output};
use std::sync::Arc;
use std::time::Duration;

use ecod::model::names::NodeName;
use ecod::wire::{GlobalMap, ObjectReport, PerceivedObject, ReportKind, Role};
use ecod_actors::messages::gateway::GatewayMessage;
use ecod_actors::node::config::NodeConfig;
use ecod_actors::node::{self, NodeHandle};
use ecod_actors::platform::clock;
use tempfile::TempDir;
use tokio::time::{sleep, timeout};

const PATIENCE: Duration = Duration::from_secs(20);

/// A node of a cell whose other nodes gossip at `seeds`. Its configuration file contains `toml`.
fn config(
    name: &str,
    role: Role,
    seeds: &[&NodeHandle],
    toml: &str,
    state: Option<&Path>,
) -> NodeConfig {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("node.toml");
    std::fs::write(&file, format!("# The node's own.\n{toml}")).unwrap();
    let mut config = NodeConfig::load(
        Some(&file),
        &serde_json::json!({ "name": name, "cell": "lot-1" }),
    )
    .unwrap();
    config.role = role;
    config.listen = Some("127.0.0.1:0".parse().unwrap());
    config.state_dir = state.map(Into::into);
    // Cells of other tests are not met.
    config.membership.bind = Some("127.0.0.1:0".parse().unwrap());
    config.membership.multicast.enabled = false;
    config.membership.seeds = seeds
        .iter()
        .map(|node| node.gossip_address().unwrap().to_string())
        .collect();
    config.dashboard.enabled = false;
    config
}

async fn start(name: &str, role: Role, seeds: &[&NodeHandle]) -> NodeHandle {
    node::start(config(name, role, seeds, "", None))
        .await
        .unwrap()
}

async fn start_kept(name: &str, role: Role, seeds: &[&NodeHandle], state: &TempDir) -> NodeHandle {
    node::start(config(name, role, seeds, "", Some(state.path())))
        .await
        .unwrap()
}

/// The text of a description with these places along the x axis.
fn described(places: &[&str], more: &str) -> String {
    let place = |(n, id): (usize, &&str)| {
        format!("[[landmarks]]\nid = \"{id}\"\nx_m = {}\ny_m = 0\n", 3 * n)
    };
    more.to_owned() + &places.iter().enumerate().map(place).collect::<String>()
}

/// `ecod-node cell …` at a node.
async fn cell(command: &str, text: Option<String>, node: &NodeHandle) -> Output {
    at_door(command, text, node.listens_at().unwrap()).await
}

async fn at_door(command: &str, text: Option<String>, door: SocketAddr) -> Output {
    let command = command.to_owned();
    let run = move || {
        let directory = tempfile::tempdir().unwrap();
        let mut program = Command::new(env!("CARGO_BIN_EXE_ecod-node"));
        program.args([
            "cell",
            &command,
            "--cell",
            "lot-1",
            "--door",
            &door.to_string(),
        ]);
        if let Some(text) = text {
            let file = directory.path().join("cell.toml");
            std::fs::write(&file, text).unwrap();
            program.arg(file);
        }
        program.output().unwrap()
    };
    tokio::task::spawn_blocking(run).await.unwrap()
}

async fn set(text: String, node: &NodeHandle) -> String {
    let output = cell("set", Some(text), node).await;
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    String::from_utf8(output.stdout).unwrap()
}

async fn show(node: &NodeHandle) -> String {
    let output = cell("show", None, node).await;
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    String::from_utf8(output.stdout).unwrap()
}

/// Waits until a node shows all of these texts.
async fn shows(node: &NodeHandle, parts: &[&str]) -> String {
    let mut shown = String::new();
    let wanted = async {
        while !parts.iter().all(|part| shown.contains(part)) {
            shown = show(node).await;
        }
    };
    let outcome = timeout(PATIENCE, wanted).await;
    assert!(outcome.is_ok(), "not {parts:?}:\n{shown}");
    shown
}

fn places(map: &GlobalMap) -> Vec<&str> {
    map.landmarks.iter().map(|state| &*state.id).collect()
}

async fn map_where(
    node: &NodeHandle,
    what: &str,
    wanted: impl Fn(&GlobalMap) -> bool,
) -> Arc<GlobalMap> {
    let mut newest = node.newest_map();
    let found = timeout(
        PATIENCE,
        newest.wait_for(|map| map.as_ref().is_some_and(|map| wanted(&map.map))),
    )
    .await;
    let map = found
        .unwrap_or_else(|_| panic!("no map {what}"))
        .unwrap()
        .clone();
    map.unwrap().map
}

/// The newest round that any of these nodes has.
fn newest_round(nodes: &[&NodeHandle]) -> u64 {
    let round = |node: &&NodeHandle| node.newest_map().borrow().as_ref().map(|map| map.map.round);
    nodes.iter().filter_map(round).max().unwrap_or_default()
}

async fn all_follow(nodes: &[&NodeHandle]) {
    for node in nodes {
        map_where(node, "at all", |_| true).await;
    }
    for node in nodes {
        let mut members = node.members();
        let all = members.wait_for(|members| members.len() + 1 >= nodes.len());
        timeout(PATIENCE, all)
            .await
            .expect("all nodes are members")
            .unwrap();
    }
}

/// Has a node report a label at `slot-1`, vote for it, and report a car elsewhere, ten times a second.
fn reporting(name: &'static str, node: &NodeHandle) -> tokio::task::JoinHandle<()> {
    let gateway = node.slots().gateway.clone();
    tokio::spawn(async move {
        for seq in 1.. {
            let seen = |label: &str, x_m, y_m| PerceivedObject::new(label, 0.9, x_m, y_m);
            let sign = PerceivedObject {
                landmark: Some("slot-1".into()),
                ..seen("ABC123", 3.1, 0.0)
            };
            let kinds = [
                (
                    ReportKind::Detections,
                    vec![sign.clone(), seen("car", 40.0, 7.0)],
                ),
                (ReportKind::VoteDetections, vec![sign]),
            ];
            for (kind, objects) in kinds {
                let name = NodeName::from_static(name);
                let report = Arc::new(ObjectReport {
                    objects,
                    ..ObjectReport::new(name, seq, clock::now())
                });
                gateway.send(GatewayMessage::PublishReport { kind, report });
            }
            sleep(Duration::from_millis(100)).await;
        }
    })
}

/// Votes of a vehicle that count as correct in the ledger of a node.
fn right_votes(node: &NodeHandle, voter: &str) -> u64 {
    let newest = node.newest_reputations();
    let newest = newest.borrow();
    let reputations = newest.as_ref().map(|newest| &newest.message.reputations);
    reputations
        .and_then(|all| all.get(&NodeName::new(voter).unwrap()))
        .map_or(0, |reputation| reputation.correct)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn configuration_spreads_within_two_rounds() {
    let edge = start("edge", Role::Edge, &[]).await;
    let euclid = start("euclid", Role::Auto, &[&edge]).await;
    let gauss = start("gauss", Role::Cav, &[&edge]).await;
    all_follow(&[&edge, &euclid, &gauss]).await;
    assert!(
        show(&gauss)
            .await
            .starts_with("# cell lot-1: no description\n")
    );
    let nothing = cell("diff", Some(String::new()), &gauss).await;
    let error_text = String::from_utf8(nothing.stderr).unwrap();
    assert!(
        nothing.status.code() == Some(1) && error_text.contains("the cell has no description yet"),
        "{error_text}"
    );

    let tracked = "[fusion.tracks]\nmode = \"on\"\n";
    let first = set(described(&["slot-0", "slot-1"], tracked), &euclid).await;
    assert!(
        first.starts_with("version 1, hash ")
            && first.contains(", known locations: 2 (maps of up to ")
            && first.ends_with(", set by euclid\n"),
        "{first}"
    );
    let reports = [reporting("gauss", &gauss), reporting("euclid", &euclid)];
    let is_seen = |map: &GlobalMap| {
        map.landmarks
            .iter()
            .any(|state| state.label.as_deref() == Some("ABC123"))
            && !map.objects.is_empty()
    };
    let before = map_where(&gauss, "with what it sees", is_seen).await;
    let car = before.objects[0].id;
    let voted = async {
        while right_votes(&gauss, "gauss") < 5 {
            sleep(Duration::from_millis(20)).await;
        }
    };
    timeout(PATIENCE, voted).await.expect("votes count");

    let all = [&gauss, &euclid, &edge];
    let mut taken = Vec::new();
    for change in 2..=6 {
        let name = format!("new-{change}");
        let text = described(&["other", "slot-1", &name], tracked);
        let set = set(text, if change % 2 == 0 { &euclid } else { &edge }).await;
        assert!(set.starts_with(&format!("version {change}, ")), "{set}");
        let at = newest_round(&all);
        let votes = right_votes(&gauss, "gauss");
        let has_new = |map: &GlobalMap| places(map).contains(&name.as_str());
        let [at_gauss, at_euclid, at_edge] =
            all.map(|node| map_where(node, "of the new places", has_new));
        let (now, at_euclid, at_edge) = tokio::join!(at_gauss, at_euclid, at_edge);
        taken.push([&now, &at_euclid, &at_edge].map(|map| map.round.saturating_sub(at)));
        assert_eq!(places(&now), ["other", "slot-1", name.as_str()]);
        assert_eq!(
            now.landmarks[1].label.as_deref(),
            Some("ABC123"),
            "kept without a gap"
        );
        assert!(
            now.objects.iter().any(|object| object.id == car),
            "the same track"
        );
        assert_eq!(now.epoch, before.epoch, "no restart");
        let mut verdicts = gauss.newest_verdicts();
        let after = verdicts.wait_for(|newest| {
            newest
                .as_ref()
                .is_some_and(|newest| newest.message.round >= now.round)
        });
        let after = timeout(PATIENCE, after)
            .await
            .expect("verdicts")
            .unwrap()
            .clone()
            .unwrap()
            .message;
        let verdict = after
            .verdicts
            .iter()
            .find(|verdict| &*verdict.landmark == "slot-1")
            .unwrap();
        assert_eq!(
            verdict.label.as_deref(),
            Some("ABC123"),
            "the votes are kept: {verdict:?}"
        );
        let more = async {
            while right_votes(&gauss, "gauss") <= votes {
                assert!(
                    right_votes(&gauss, "gauss") >= votes,
                    "reputations are kept"
                );
                sleep(Duration::from_millis(20)).await;
            }
        };
        timeout(PATIENCE, more).await.expect("votes count on");
    }
    println!("rounds from each answer to the change at gauss, euclid and the edge: {taken:?}");
    assert!(
        taken.iter().flatten().all(|rounds| *rounds <= 2),
        "{taken:?}"
    );

    let shown = shows(
        &gauss,
        &[
            "# edge: version 6",
            "# euclid: version 6",
            "# gauss: version 6",
        ],
    )
    .await;
    assert!(
        shown.contains("version 6, hash")
            && shown.contains("set by euclid")
            && shown.contains("id = \"new-6\"")
    );
    let same = cell(
        "diff",
        Some(described(&["other", "slot-1", "new-6"], tracked)),
        &gauss,
    )
    .await;
    assert!(same.status.success());
    let other = cell(
        "diff",
        Some(described(&["other", "slot-1"], tracked)),
        &edge,
    )
    .await;
    let lines = String::from_utf8(other.stdout).unwrap();
    assert!(
        other.status.code() == Some(1) && lines.contains("landmarks.new-6: cell {"),
        "{lines}"
    );

    reports.iter().for_each(tokio::task::JoinHandle::abort);
    for node in [gauss, euclid, edge] {
        node.stop().await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn late_joiners_get_latest_version() {
    let states = [(); 3].map(|()| tempfile::tempdir().unwrap());
    let [of_edge, of_euclid, of_gauss] = &states;
    let text = |place: &str| described(&[place], "");
    {
        let edge = start_kept("edge", Role::Edge, &[], of_edge).await;
        let euclid = start_kept("euclid", Role::Auto, &[&edge], of_euclid).await;
        all_follow(&[&edge, &euclid]).await;
        set(text("first"), &edge).await;
        shows(&euclid, &["# edge: version 1", "# euclid: version 1"]).await;
        let late = start("late", Role::Cav, &[&euclid]).await;
        shows(&late, &["# late: version 1", "id = \"first\""]).await;
        late.stop().await;
        // The edge misses the next version.
        edge.stop().await;
        set(text("second"), &euclid).await;
        euclid.stop().await;
    }
    for edge_first in [true, false] {
        let order = if edge_first {
            ["edge", "euclid"]
        } else {
            ["euclid", "edge"]
        };
        let mut nodes: Vec<NodeHandle> = Vec::new();
        for name in order {
            let (role, state) = if name == "edge" {
                (Role::Edge, of_edge)
            } else {
                (Role::Auto, of_euclid)
            };
            let seeds: Vec<_> = nodes.iter().collect();
            nodes.push(start_kept(name, role, &seeds, state).await);
            map_where(nodes.last().unwrap(), "of a cell that runs", |_| true).await;
        }
        let gauss = start_kept("gauss", Role::Cav, &[&nodes[0]], of_gauss).await;
        shows(
            &gauss,
            &[
                "# edge: version 2",
                "# euclid: version 2",
                "# gauss: version 2",
                "id = \"second\"",
            ],
        )
        .await;
        map_where(&gauss, "of the second version", |map| {
            places(map) == ["second"]
        })
        .await;
        for node in nodes.into_iter().chain([gauss]) {
            node.stop().await;
        }
        if edge_first {
            // Once more from an older state, as of a copied disk.
            let euclid = start_kept("euclid", Role::Auto, &[], of_euclid).await;
            map_where(&euclid, "alone", |map| places(map) == ["second"]).await;
            euclid.stop().await;
            std::fs::remove_file(of_edge.path().join("lot-1.edge.description.json")).unwrap();
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn merged_cell_uses_later_description() {
    for of_euclid in [&["b"][..], &["b", "c"]] {
        let edge = start("edge", Role::Edge, &[]).await;
        let euclid = start("euclid", Role::Auto, &[]).await;
        for node in [&edge, &euclid] {
            map_where(node, "alone", |_| true).await;
        }
        let stamp = |error_text: &str| error_text.split_once(", known").unwrap().0.to_owned();
        let mut stamps = [
            stamp(&set(described(&["a"], ""), &edge).await),
            String::new(),
        ];
        for place in of_euclid {
            stamps[1] = stamp(&set(described(&[place], ""), &euclid).await);
        }
        let of_edge = stamps[0] > stamps[1];
        let winner = if of_edge { &stamps[0] } else { &stamps[1] };
        let place = if of_edge {
            "a"
        } else {
            of_euclid[of_euclid.len() - 1]
        };
        assert!(
            winner.starts_with(&format!("version {}, hash ", of_euclid.len())),
            "{stamps:?}"
        );
        let gauss = start("gauss", Role::Cav, &[&edge, &euclid]).await;
        let all = ["edge", "euclid", "gauss"].map(|node| format!("# {node}: {winner}"));
        for node in [&edge, &euclid, &gauss] {
            shows(node, &all.each_ref().map(String::as_str)).await;
            map_where(node, "of the winner", |map| places(map) == [place]).await;
        }
        for node in [gauss, euclid, edge] {
            node.stop().await;
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn contradicting_file_is_reported() {
    let state = tempfile::tempdir().unwrap();
    let edge = start("edge", Role::Edge, &[]).await;
    let own = described(&["mine", "slot-1"], "");
    let gauss_config = config("gauss", Role::Cav, &[&edge], &own, Some(state.path()));
    let gauss = node::start(gauss_config.clone()).await.unwrap();
    all_follow(&[&edge, &gauss]).await;
    set(described(&["slot-0", "slot-1"], ""), &edge).await;
    let tells_of_both = |shown: &str| {
        let line = shown
            .lines()
            .find(|line| line.starts_with("# gauss"))
            .unwrap();
        for part in ["`landmarks[0].id`", "\"mine\"", "\"slot-0\""] {
            assert!(line.contains(part), "{line}");
        }
    };
    tells_of_both(
        &shows(
            &edge,
            &[
                "# edge: version 1, hash",
                "# gauss: version 1, hash",
                "not used",
            ],
        )
        .await,
    );
    let troubles = gauss.troubles();
    assert!(
        troubles
            .iter()
            .any(|(_, it)| it.kind == "description" && it.cause.contains("slot-0")),
        "{troubles:?}"
    );
    map_where(&gauss, "of the cell", |map| {
        places(map) == ["slot-0", "slot-1"]
    })
    .await;
    gauss.stop().await;
    // A description of others stops no node: it has it saved, and goes on without it.
    shows(&edge, &["# cell"]).await;
    let gauss = node::start(gauss_config).await.unwrap();
    tells_of_both(&shows(&edge, &["# gauss: version 1, hash", "not used"]).await);
    gauss.stop().await;

    let euclid = node::start(config(
        "euclid",
        Role::Auto,
        &[&edge],
        "[fusion.pace]\ngate_m = 0.7",
        None,
    ))
    .await
    .unwrap();
    let refused = cell("set", Some("[fusion.pace]\ngate_m = 0.9".into()), &euclid).await;
    let error_text = String::from_utf8(refused.stderr).unwrap();
    assert!(
        !refused.status.success()
            && ["`fusion.pace.gate_m`", "0.7", "0.9"]
                .iter()
                .all(|p| error_text.contains(p)),
        "{error_text}"
    );
    let vehicle = start("vehicle", Role::Cav, &[&edge]).await;
    let refused = cell("set", Some(described(&["x"], "")), &vehicle).await;
    let error_text = String::from_utf8(refused.stderr).unwrap();
    assert!(
        error_text.contains("never leads") && error_text.lines().count() == 1,
        "{error_text}"
    );
    let unusable = cell("set", Some("[fusion.pace]\ngate_m = -1".into()), &edge).await;
    let error_text = String::from_utf8(unusable.stderr).unwrap();
    assert!(
        unusable.status.code() == Some(2)
            && error_text.matches("`fusion.pace.gate_m`").count() == 1,
        "{error_text}"
    );
    let huge = cell("set", Some("#".repeat(256 * 1024 + 1)), &edge).await;
    let error_text = String::from_utf8(huge.stderr).unwrap();
    assert!(
        huge.status.code() == Some(2) && error_text.contains("at most 262144 bytes"),
        "{error_text}"
    );
    for node in [vehicle, euclid, edge] {
        node.stop().await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn contradicting_candidate_leads_last() {
    let edge = start("edge", Role::Edge, &[]).await;
    let mut of_its_own = config(
        "noether",
        Role::Auto,
        &[&edge],
        &described(&["mine"], ""),
        None,
    );
    of_its_own.election.priority = 200;
    let noether = node::start(of_its_own).await.unwrap();
    let euclid = start("euclid", Role::Auto, &[&edge, &noether]).await;
    all_follow(&[&edge, &noether, &euclid]).await;
    set(described(&["slot-0"], ""), &edge).await;
    shows(
        &edge,
        &[
            "# noether: version 1, hash",
            "not used",
            "# euclid: version 1, hash",
        ],
    )
    .await;
    // Longer than the time until the node checks its parts again and reports to the leader.
    sleep(Duration::from_secs(2)).await;
    edge.stop().await;
    map_where(&noether, "of euclid", |map| {
        map.aggregator.as_str() == "euclid" && places(map) == ["slot-0"]
    })
    .await;
    euclid.stop().await;
    map_where(&noether, "of its own", |map| {
        map.aggregator.as_str() == "noether"
    })
    .await;
    noether.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn starting_description_replaces_no_later() {
    let state = tempfile::tempdir().unwrap();
    let file = state.path().join("cell.toml");
    std::fs::write(&file, described(&["slot-0"], "")).unwrap();
    let with_file = || NodeConfig {
        description: Some(file.clone()),
        ..config("edge", Role::Edge, &[], "", Some(state.path()))
    };
    let edge = node::start(with_file()).await.unwrap();
    map_where(&edge, "of the file", |map| places(map) == ["slot-0"]).await;
    set(described(&["slot-9"], ""), &edge).await;
    edge.stop().await;
    let edge = node::start(with_file()).await.unwrap();
    map_where(&edge, "of what was set", |map| places(map) == ["slot-9"]).await;
    edge.stop().await;
}
