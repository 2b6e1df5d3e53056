//! Cells that vote, on real sockets: verdicts, reputations, and what survives of them.

use std::cell::OnceCell;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use ecod::aggregator::Algorithms;
use ecod::perception::landmark::LandmarkConfig;
use ecod::vote::VoteMode;
use ecod::wire::{
    ObjectReport, PerceivedObject, RejectReason, ReportKind, Reputation, Reputations, Role,
    Verdict, decode,
};
use ecod_actors::messages::gateway::GatewayMessage;
use ecod_actors::messages::reputation_keeper::ReputationKeeperMessage;
use ecod_actors::node::config::NodeConfig;
use ecod_actors::node::{self, NodeHandle};
use ecod_actors::platform::clock;
use ecod_actors::telemetry::counters::Event;
use ecod_testkit::{name, node_config, until_by as until};
use tokio::time::timeout;

const PATIENCE: Duration = Duration::from_secs(20);

fn config(node: &str, role: Role) -> NodeConfig {
    let mut config = node_config(node, "crossing", role);
    config.landmarks = vec![LandmarkConfig::at("ball", 1.0, 0.0)];
    config.fusion.vote.weighted.freshness_s = 0.2;
    config.reputations.publish_period_s = 0.1;
    config
}

async fn edge(configure: impl FnOnce(&mut NodeConfig)) -> NodeHandle {
    let mut config = config("edge", Role::Edge);
    configure(&mut config);
    config.validate().unwrap();
    node::start(config).await.unwrap()
}

async fn attached(
    node: &str,
    role: Role,
    edge: &NodeHandle,
    configure: impl FnOnce(&mut NodeConfig),
) -> NodeHandle {
    let mut config = config(node, role);
    config.mqtt.broker = edge.broker_address().map(Into::into);
    config.mqtt.retry_max_ms = 100;
    configure(&mut config);
    node::start(config).await.unwrap()
}

async fn cav(node: &str, edge: &NodeHandle) -> NodeHandle {
    attached(node, Role::Cav, edge, |_| ()).await
}

/// A node that finds the cell by its gossip and uses the brokers of the leader.
async fn member(
    node: &str,
    role: Role,
    other: &NodeHandle,
    configure: impl FnOnce(&mut NodeConfig),
) -> NodeHandle {
    let mut config = config(node, role);
    config.membership.seeds = vec![other.gossip_address().unwrap().to_string()];
    configure(&mut config);
    node::start(config).await.unwrap()
}

fn report(node: &str, label: &str, landmark: &str) -> Arc<ObjectReport> {
    static SEQ: AtomicU64 = AtomicU64::new(0);
    Arc::new(ObjectReport {
        objects: vec![PerceivedObject {
            landmark: Some(landmark.into()),
            ..PerceivedObject::new(label, 0.9, 1.0, 0.0)
        }],
        ..ObjectReport::new(
            name(node),
            SEQ.fetch_add(1, Ordering::Relaxed),
            clock::now(),
        )
    })
}

/// Makes two vehicles vote cup and a third vote dog, all over the third vehicle's connection to the broker.
fn disagree(reporter: &NodeHandle) {
    for (node, label) in [("euclid", "cup"), ("gauss", "cup"), ("liar", "dog")] {
        let message = GatewayMessage::PublishReport {
            kind: ReportKind::VoteDetections,
            report: report(node, label, "ball"),
        };
        reporter.slots().gateway.send(message);
    }
}

fn verdict(node: &NodeHandle) -> Option<Verdict> {
    node.newest_verdicts()
        .borrow()
        .as_ref()
        .and_then(|newest| newest.message.verdicts.first().cloned())
}

fn reputations(node: &NodeHandle) -> Option<Arc<Reputations>> {
    node.newest_reputations()
        .borrow()
        .as_ref()
        .map(|newest| Arc::clone(&newest.message))
}

fn reputation(node: &NodeHandle, vehicle: &str) -> Option<Reputation> {
    reputations(node)?.reputations.get(&name(vehicle)).copied()
}

/// Has the vehicles disagree until it shows in the published reputations.
async fn unmasked(reporter: &NodeHandle, receiver: &NodeHandle) {
    let settled = || {
        reputation(receiver, "liar").is_some_and(|liar| liar.incorrect >= 5)
            && reputation(receiver, "euclid").is_some_and(|euclid| euclid.correct >= 5)
    };
    until(
        "the malicious vehicle is detected",
        || disagree(reporter),
        settled,
    )
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn disagreeing_vehicles_get_verdict() {
    let edge = edge(|_| ()).await;
    let euclid = cav("euclid", &edge).await;
    let agreed = OnceCell::new();
    let by_three = || verdict(&euclid).filter(|v| v.margin > 0.0 && v.contributors.len() == 3);
    let is_agreed = || by_three().is_some_and(|verdict| agreed.set(verdict).is_ok());
    until("a verdict by three", || disagree(&euclid), is_agreed).await;
    let verdict = agreed.into_inner().unwrap();
    assert_eq!(verdict.landmark, "ball");
    assert!(
        verdict.score > verdict.votes["dog"] && verdict.score == verdict.votes["cup"],
        "{verdict:?}"
    );
    assert!(
        (verdict.margin - (verdict.score - verdict.votes["dog"])).abs() < 1e-9,
        "{verdict:?}"
    );

    unmasked(&euclid, &euclid).await;
    let newest = reputations(&euclid).unwrap();
    assert_eq!(newest.aggregator, Some(name("edge")));
    assert!(newest.reputations[&name("euclid")].score > newest.reputations[&name("liar")].score);
    assert!(euclid.counters().events(Event::VerdictsAccepted) > 0);

    let retained = retained_reputations(&edge).await;
    assert!(
        retained.reputations[&name("liar")].incorrect >= 5,
        "a latecomer gets them at once"
    );
    for node in [euclid, edge] {
        node.stop().await;
    }
}

/// Reputations that the broker retains.
async fn retained_reputations(edge: &NodeHandle) -> Reputations {
    let broker = edge.broker_address().unwrap();
    let options = rumqttc::MqttOptions::new("latecomer", broker.ip().to_string(), broker.port());
    let (client, mut events) = rumqttc::AsyncClient::new(options, 8);
    client
        .subscribe("ecod/v1/crossing/reputations", rumqttc::QoS::AtLeastOnce)
        .await
        .unwrap();
    let first = async {
        loop {
            // A live message may come before the retained one.
            match events.poll().await.unwrap() {
                rumqttc::Event::Incoming(rumqttc::Packet::Publish(publish)) if publish.retain => {
                    return publish;
                }
                _ => {}
            }
        }
    };
    let publish = timeout(PATIENCE, first)
        .await
        .expect("no message is retained");
    assert_eq!(
        publish.qos,
        rumqttc::QoS::AtMostOnce,
        "an embedded broker keeps no messages for acknowledgement"
    );
    decode(&publish.payload, &Default::default()).unwrap()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn restarted_node_keeps_reputations() {
    for mode in [VoteMode::Weighted, VoteMode::Paper] {
        let directory = tempfile::tempdir().unwrap();
        let keep = |config: &mut NodeConfig| {
            config.fusion.vote.mode = mode;
            config.state_dir = Some(directory.path().join("state"));
        };
        let before = edge(keep).await;
        let euclid = cav("euclid", &before).await;
        unmasked(&euclid, &euclid).await;
        let known = reputation(&euclid, "liar").unwrap();
        for node in [euclid, before] {
            node.stop().await;
        }

        let after = edge(keep).await;
        until("reputations", || (), || reputations(&after).is_some()).await;
        let restored = reputation(&after, "liar").expect("the reputation was not restored");
        assert!(
            restored.incorrect >= known.incorrect,
            "{mode:?}: {restored:?} after {known:?}"
        );
        assert!(
            restored.score <= known.score + 1e-9,
            "{mode:?}: {restored:?} after {known:?}"
        );
        after.stop().await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn corrupt_state_stops_no_node() {
    let spoil_file = |directory: &Path| {
        std::fs::write(directory.join("crossing.edge.reputations.json"), b"{\"sch")
    };
    let spoil_directory = |directory: &Path| std::fs::write(directory.join("occupied"), b"");
    for (state_dir, saved) in [("", true), ("occupied", false)] {
        let directory = tempfile::tempdir().unwrap();
        spoil_file(directory.path()).unwrap();
        spoil_directory(directory.path()).unwrap();
        let edge = edge(|config| config.state_dir = Some(directory.path().join(state_dir))).await;
        let euclid = cav("euclid", &edge).await;
        unmasked(&euclid, &euclid).await;
        let event = if saved {
            Event::ReputationsSaved
        } else {
            Event::ReputationsNotSaved
        };
        assert!(edge.counters().events(event) > 0);
        let troubles = edge.troubles();
        assert_eq!(
            troubles
                .iter()
                .any(|(_, trouble)| trouble.kind == "not_saved"),
            !saved,
            "{troubles:?}"
        );
        assert_eq!(
            directory
                .path()
                .join("crossing.edge.reputations.set-aside")
                .exists(),
            saved
        );
        euclid.stop().await;
        edge.stop().await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn restarted_parts_keep_reputations() {
    let edge = edge(|_| ()).await;
    let euclid = cav("euclid", &edge).await;
    unmasked(&euclid, &euclid).await;
    let kills: [&dyn Fn(); 2] = [&|| edge.slots().keeper.get().unwrap().kill(), &|| {
        edge.slots().fuser.get().unwrap().kill();
    }];
    for kill in kills {
        let before = reputations(&euclid).unwrap();
        let known = before.reputations[&name("liar")];
        kill();
        let more =
            || reputation(&euclid, "liar").is_some_and(|liar| liar.incorrect > known.incorrect);
        until(
            "more evidence",
            || disagree(&euclid),
            || reputations(&euclid).unwrap() != before && more(),
        )
        .await;
        let now = reputation(&euclid, "liar").unwrap();
        assert!(
            now.correct >= known.correct && now.score <= known.score + 1e-9,
            "{now:?} after {known:?}"
        );
    }
    euclid.stop().await;
    edge.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn next_leader_keeps_reputations() {
    let edge = edge(|_| ()).await;
    // This node does not settle votes itself: all its evidence was received.
    let standby = member("standby", Role::Auto, &edge, |config| {
        config.fusion.vote.weighted.freshness_s = 1e9;
    })
    .await;
    let euclid = member("euclid", Role::Cav, &edge, |_| ()).await;
    let from_edge = || reputations(&edge).filter(|r| r.aggregator == Some(name("edge")));
    let settled = || {
        from_edge().is_some_and(|r| {
            r.reputations
                .get(&name("liar"))
                .is_some_and(|l| l.incorrect >= 5)
        })
    };
    until(
        "the malicious vehicle is detected",
        || disagree(&euclid),
        settled,
    )
    .await;
    until(
        "evidence replicated",
        || disagree(&euclid),
        || standby.counters().events(Event::LedgerMerged) > 2,
    )
    .await;
    // The last votes are settled and published after a second without new votes, and the standby has equal evidence.
    let mut last = from_edge().unwrap();
    let mut since = Instant::now();
    let known = |node: &NodeHandle| reputations(node).map(|newest| newest.reputations.clone());
    while since.elapsed() < Duration::from_secs(1)
        || known(&standby).as_ref() != Some(&last.reputations)
    {
        tokio::time::sleep(Duration::from_millis(20)).await;
        let newest = from_edge().unwrap();
        if newest.reputations != last.reputations {
            since = Instant::now();
        }
        last = newest;
    }
    edge.stop().await;
    let took_over = || {
        reputations(&euclid)
            .filter(|r| r.aggregator == Some(name("standby")) && r.epoch > last.epoch)
    };
    until("the standby's reputations", || (), || took_over().is_some()).await;
    assert_eq!(took_over().unwrap().reputations, last.reputations);
    let verdicts = || {
        euclid
            .newest_verdicts()
            .borrow()
            .as_ref()
            .map(|newest| newest.message.aggregator.clone())
    };
    until(
        "the standby's verdicts",
        || disagree(&euclid),
        || verdicts() == Some(name("standby")),
    )
    .await;

    // A candidate that joins later receives all evidence.
    let late = member("late", Role::Auto, &standby, |_| ()).await;
    let send_snapshot = || {
        standby
            .slots()
            .keeper
            .send(ReputationKeeperMessage::SendSnapshot { to: name("late") });
    };
    until("a snapshot", send_snapshot, || {
        late.counters().events(Event::LedgerMerged) > 0
    })
    .await;
    for node in [late, standby, euclid] {
        node.stop().await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn only_configured_algorithms_accept_reports() {
    for (algorithms, kind, other) in [
        (
            Algorithms::Pace,
            ReportKind::Detections,
            ReportKind::VoteDetections,
        ),
        (
            Algorithms::Vote,
            ReportKind::VoteDetections,
            ReportKind::Detections,
        ),
    ] {
        let edge = edge(|config| config.fusion.algorithms = algorithms).await;
        let euclid = cav("euclid", &edge).await;
        let send = |kind, label: &str, landmark: &str| {
            let report = report("euclid", label, landmark);
            euclid
                .slots()
                .gateway
                .send(GatewayMessage::PublishReport { kind, report });
        };
        let both = || {
            send(kind, "cup", "ball");
            send(other, "cup", "ball");
        };
        let maps = || euclid.newest_map().borrow().is_some();
        let verdicts = || euclid.newest_verdicts().borrow().is_some();
        let refused = || edge.counters().rejects(RejectReason::NotFused) > 0;
        until("rounds", both, || (maps() || verdicts()) && refused()).await;
        assert_eq!((maps(), verdicts()), (algorithms.pace(), algorithms.vote()));
        if algorithms.vote() {
            until("reputations", both, || reputations(&euclid).is_some()).await;
        } else {
            assert_eq!(reputations(&euclid), None);
        }
        euclid.stop().await;
        edge.stop().await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn unusable_votes_are_counted() {
    let edge = edge(|_| ()).await;
    let euclid = cav("euclid", &edge).await;
    let send = |report: &Arc<ObjectReport>| {
        let kind = ReportKind::VoteDetections;
        let report = Arc::clone(report);
        euclid
            .slots()
            .gateway
            .send(GatewayMessage::PublishReport { kind, report });
    };
    let events = |event| edge.counters().events(event);
    let rejects = |reason| edge.counters().rejects(reason);
    until(
        "unknown landmark",
        || send(&report("euclid", "cup", "moon")),
        || events(Event::VoteIgnored) > 0,
    )
    .await;
    let twice = report("euclid", "cup", "ball");
    until(
        "duplicate",
        || send(&twice),
        || rejects(RejectReason::OutOfOrder) > 0,
    )
    .await;
    let spoilt = |spoil: fn(&mut ObjectReport)| {
        let mut report = (*report("euclid", "cup", "ball")).clone();
        spoil(&mut report);
        Arc::new(report)
    };
    let unsure = || spoilt(|r| r.objects[0].confidence = -0.5);
    until(
        "confidence",
        || send(&unsure()),
        || rejects(RejectReason::ConfidenceOutOfRange) > 0,
    )
    .await;
    let far = || spoilt(|r| r.pose = Some(ecod::wire::WirePose::new(900.0, 0.0, 0.0)));
    let before = events(Event::VoteIgnored);
    until(
        "beyond range",
        || send(&far()),
        || events(Event::VoteIgnored) > before,
    )
    .await;
    let right = || verdict(&euclid).is_some_and(|v| v.label.as_deref() == Some("cup"));
    until(
        "the cell goes on",
        || send(&report("euclid", "cup", "ball")),
        right,
    )
    .await;
    euclid.stop().await;
    edge.stop().await;
}
