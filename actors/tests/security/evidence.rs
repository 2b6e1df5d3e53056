//! A candidate that does not lead, and forges evidence about vehicles.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use ecod::model::names::NodeName;
use ecod::perception::landmark::LandmarkConfig;
use ecod::reputation::Evidence;
use ecod::wire::{Encoding, RejectReason, Reputation, Role, encode};
use ecod_actors::messages::reputation_keeper::ReputationKeeperMessage;
use ecod_actors::node::config::NodeConfig;
use ecod_actors::node::{self, NodeHandle};
use ecod_actors::platform::clock;
use ecod_actors::telemetry::counters::Event;
use ecod_actors::transport::pki::{Credentials, EvidenceSigner, TlsConfig};
use ecod_testkit::{node_config, until};
use tokio::time::{Instant, sleep};

use crate::fixture::{Client, DAY, GONE_WITHIN, Pki, client_config, node as name};
use crate::nodes::aggregator;
use crate::shares::inverted;

fn config(node: &str, role: Role, tls: &TlsConfig, state: &Path) -> NodeConfig {
    let mut config = NodeConfig {
        landmarks: vec![LandmarkConfig::at("ball", 1.0, 0.0)],
        tls: Some(tls.clone()),
        state_dir: Some(state.to_owned()),
        ..node_config(node, "lot", role)
    };
    config.reputations.publish_period_s = 0.1;
    config
}

fn reputations(node: &NodeHandle) -> BTreeMap<NodeName, Reputation> {
    node.newest_reputations()
        .borrow()
        .as_ref()
        .map(|newest| newest.message.reputations.clone())
        .unwrap_or_default()
}

/// Has a leader count forty votes of each vehicle; returns its term.
fn record(leader: &NodeHandle, vehicles: [(&str, bool); 2]) -> u64 {
    let epoch = leader.leadership().borrow().epoch.clone().unwrap();
    let votes = |(node, correct)| {
        let evidence = Evidence {
            node: name(node),
            label: "cup".into(),
            correct,
        };
        std::iter::repeat_n(evidence, 40)
    };
    let evidence = vehicles.into_iter().flat_map(votes).collect();
    let map = leader
        .newest_map()
        .borrow()
        .clone()
        .map_or(0, |map| map.map.round);
    let published = leader
        .newest_reputations()
        .borrow()
        .as_ref()
        .map_or(0, |newest| newest.message.round);
    // Followers refuse reputations of rounds that cannot have been published yet, and of repeated rounds.
    let round = map.max(published) + 1;
    let record = ReputationKeeperMessage::Record {
        epoch: epoch.clone(),
        round,
        evidence,
        reputations: None,
    };
    assert!(leader.slots().keeper.send(record));
    epoch.term
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn revoked_leader_loses_its_counts() {
    let mut pki = Pki::new();
    let state = tempfile::tempdir().unwrap();
    let [edge_files, gauss_files, euclid_files] = [
        ("edge", Role::Edge),
        ("gauss", Role::Auto),
        ("euclid", Role::Cav),
    ]
    .map(|(node, role)| pki.issue(node, role, DAY));
    let gauss = node::start(config("gauss", Role::Auto, &gauss_files, state.path()))
        .await
        .unwrap();
    until("a false leader", || {
        gauss.leadership().borrow().is_leading()
    })
    .await;
    record(&gauss, [("honest", false), ("liar", true)]);
    let mut better = config("edge", Role::Edge, &edge_files, state.path());
    better.membership.seeds = vec![gauss.gossip_address().unwrap().to_string()];
    let edge = node::start(better).await.unwrap();
    let leads = || edge.leadership().borrow().is_leading();
    until("the lead handed over", || {
        leads() && reputations(&edge).contains_key(&name("liar"))
    })
    .await;
    let mut follower = config("euclid", Role::Cav, &euclid_files, state.path());
    follower.membership.seeds = vec![edge.gossip_address().unwrap().to_string()];
    let euclid = node::start(follower).await.unwrap();
    until("a follower", || {
        aggregator(&euclid).as_deref() == Some("edge")
    })
    .await;
    record(&edge, [("honest", true), ("other", true)]);
    until("both leaders' evidence", || {
        reputations(&edge).len() == 3 && reputations(&euclid).len() == 3
    })
    .await;
    let before = reputations(&edge);
    assert!(
        before[&name("liar")].score > 0.8 && before[&name("honest")].incorrect == 40,
        "{before:?}"
    );

    pki.authority.revoke(&name("gauss"), clock::now()).unwrap();
    let written = Instant::now();
    until("evidence gone", || {
        [&edge, &euclid]
            .iter()
            .all(|node| !reputations(node).contains_key(&name("liar")))
    })
    .await;
    let after = reputations(&edge);
    assert_eq!(
        (
            after[&name("honest")].correct,
            after[&name("honest")].incorrect
        ),
        (40, 0)
    );
    let saved = state.path().join("lot.edge.reputations.json");
    let lane = "\"aggregator\":\"gauss\"";
    let is_saved = |text| std::fs::read_to_string(&saved).unwrap().contains(text);
    until("gone from the disk", || {
        !is_saved(lane) && !is_saved("\"liar\"")
    })
    .await;
    assert!(written.elapsed() < GONE_WITHIN, "{:?}", written.elapsed());
    for node in [gauss, edge, euclid] {
        node.stop().await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn forged_evidence_is_ignored() {
    let mut pki = Pki::new();
    let state = tempfile::tempdir().unwrap();
    let [edge_files, gauss_files] = [("edge", Role::Edge), ("gauss", Role::Auto)]
        .map(|(node, role)| pki.issue(node, role, DAY));
    let start_edge = || node::start(config("edge", Role::Edge, &edge_files, state.path()));
    let edge = start_edge().await.unwrap();
    let mut candidate = config("gauss", Role::Auto, &gauss_files, state.path());
    candidate.membership.seeds = vec![edge.gossip_address().unwrap().to_string()];
    let gauss = node::start(candidate).await.unwrap();
    // The edge begins another term if it has to convince the candidate; the votes below are of its last one.
    let leads = || edge.leadership().borrow().is_leading();
    until("a leader and a candidate", || {
        leads() && aggregator(&gauss).as_deref() == Some("edge")
    })
    .await;

    let term = record(&edge, [("honest", true), ("liar", false)]);
    until("reputations", || reputations(&edge).len() == 2).await;
    let honest = reputations(&edge);
    assert!(
        honest[&name("honest")].score > 0.8 && honest[&name("liar")].score < 0.35,
        "{honest:?}"
    );
    until("evidence at the candidate", || {
        gauss.counters().events(Event::LedgerMerged) > 0
    })
    .await;

    let mut attacker = Client::new(
        edge.broker_address().unwrap(),
        "gauss",
        &client_config("gauss", &gauss_files),
    );
    attacker.log_in().await.unwrap();
    let credentials = Arc::new(Credentials::load(&gauss_files, &name("gauss")).unwrap());
    let signer = EvidenceSigner::new(NodeName::from_static("lot"), credentials);
    let others = [(1, "edge"), (term, "edge"), (term, "long-gone")]
        .map(|(term, node)| inverted("gauss", term, node));
    let own = [1, term].map(|term| signer.sign(inverted("gauss", term, "gauss")).unwrap());
    let posing = others.clone().map(|share| signer.sign(share).unwrap());
    for share in others.iter().chain(&posing).chain(&own) {
        let payload = encode(share, Encoding::Json);
        attacker
            .publish_all_and_wait("ecod/v1/lot/ledger/gauss", false, &payload)
            .await
            .unwrap();
    }
    let refused = |reason| edge.counters().rejects(reason);
    until("all refused", || {
        refused(RejectReason::BadSignature) >= 6 && refused(RejectReason::Unattested) >= 2
    })
    .await;

    sleep(Duration::from_millis(300)).await;
    assert_eq!(reputations(&edge), honest);
    edge.stop().await;
    let edge = start_edge().await.unwrap();
    until("reputations after a restart", || {
        edge.leadership().borrow().is_leading() && !reputations(&edge).is_empty()
    })
    .await;
    assert_eq!(reputations(&edge), honest);
    for node in [gauss, edge] {
        node.stop().await;
    }
}
