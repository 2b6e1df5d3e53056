//! A standby whose broker lets others publish in the leader's name, because its node trusts a second CA.

use std::fs;
use std::time::Duration;

use ecod::leadership::Position;
use ecod::model::time::Timestamp;
use ecod::wire::{
    Encoding, GlobalMap, PoseCorrection, RejectReason, Reputation, Reputations, Role,
    SCHEMA_VERSION, encode,
};
use ecod_actors::node::NodeHandle;
use ecod_actors::telemetry::counters::{Counters, Event};
use ecod_actors::transport::pki::TlsConfig;
use ecod_testkit::until;
use tokio::time::{Instant, sleep};

use crate::fixture::{Client, DAY, Pki, client_config, node as name};
use crate::nodes::start_cell;

/// Duration of the attack.
const ATTACK: Duration = Duration::from_secs(3);

/// A vehicle that no honest map names.
const FALSE: &str = "zeno";

/// The map that an honest leader would publish next, plus an invented vehicle.
fn false_map(after: &GlobalMap, ahead: u64) -> GlobalMap {
    let fused_at_us = Timestamp(after.fused_at_us.micros() + 100_000 * ahead);
    let correction = PoseCorrection {
        about_m: [0.0; 2],
        dx_m: 0.0,
        dy_m: 0.0,
        dheading_rad: 0.0,
        pairs: 1.0,
    };
    let pose_corrections = [(name(FALSE), correction)].into();
    GlobalMap {
        round: after.round + ahead,
        fused_at_us,
        pose_corrections,
        ..after.clone()
    }
}

fn false_reputations(after: &GlobalMap, ahead: u64) -> Reputations {
    let reputations = [(
        name(FALSE),
        Reputation {
            score: 1.0,
            correct: 9,
            incorrect: 0,
        },
    )]
    .into();
    let epoch = after.epoch;
    let round = after.round + ahead;
    Reputations {
        schema: SCHEMA_VERSION,
        aggregator: Some(name("edge")),
        epoch,
        round,
        reputations,
    }
}

fn is_deceived(node: &NodeHandle) -> bool {
    let map = node
        .newest_map()
        .borrow()
        .as_ref()
        .is_some_and(|newest| newest.map.pose_corrections.contains_key(&name(FALSE)));
    let reputations = node.newest_reputations();
    let reputations = reputations.borrow();
    map || reputations
        .as_ref()
        .is_some_and(|newest| newest.message.reputations.contains_key(&name(FALSE)))
}

fn unproven(counters: &Counters) -> u64 {
    counters.rejects(RejectReason::BadSignature)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn forged_standby_rounds_are_refused() {
    let mut pki = Pki::new();
    let files = [
        ("edge", Role::Edge),
        ("euclid", Role::Auto),
        ("gauss", Role::Cav),
    ];
    let [edge, euclid, gauss] = files.map(|(node, role)| pki.issue(node, role, DAY));
    let mut elsewhere = Pki::new();
    let both = tempfile::NamedTempFile::new().unwrap();
    let authorities =
        [pki.authority.ca(), elsewhere.authority.ca()].map(|ca| fs::read_to_string(ca).unwrap());
    fs::write(both.path(), authorities.concat()).unwrap();
    let euclid = TlsConfig {
        ca: both.path().into(),
        revocation_list: None,
        ..euclid
    };
    let [edge, euclid, gauss] = start_cell([edge, euclid, gauss]).await;

    let before = gauss.counters().events(Event::Repeated);
    until("maps come twice", || {
        gauss.counters().events(Event::Repeated) > before + 5
    })
    .await;
    assert_eq!(
        unproven(gauss.counters()),
        0,
        "rounds from the standby's broker carry valid signatures"
    );

    let forged = elsewhere.issue("edge", Role::Edge, DAY);
    let forged = TlsConfig {
        ca: pki.authority.ca(),
        revocation_list: None,
        ..forged
    };
    let mut attacker = Client::new(
        euclid.broker_address().unwrap(),
        "edge",
        &client_config("edge", &forged),
    );
    attacker
        .log_in()
        .await
        .expect("the standby's broker trusts the other CA, too");
    let end = Instant::now() + ATTACK;
    let mut ahead = 0;
    let maps = || [&gauss, &edge].map(|node| node.counters().events(Event::MapAccepted));
    let [taken_before, made_before] = maps();
    while Instant::now() < end {
        let map = gauss
            .newest_map()
            .borrow()
            .as_ref()
            .map(|newest| newest.map.as_ref().clone())
            .unwrap();
        ahead = ahead % 5 + 1;
        let reputations = false_reputations(&map, ahead);
        let map = false_map(&map, ahead);
        for (topic, payload) in [
            ("global_detections", encode(&map, Encoding::Json)),
            ("reputations", encode(&reputations, Encoding::Json)),
        ] {
            attacker
                .publish_all_and_wait(&format!("ecod/v1/lot/{topic}"), false, &payload)
                .await
                .unwrap();
        }
        for (node, which) in [(&gauss, "the vehicle"), (&euclid, "the standby")] {
            assert!(
                !is_deceived(node),
                "{which} accepts a stranger's message in the leader's name"
            );
        }
        sleep(Duration::from_millis(20)).await;
    }
    let [taken, made] = maps();
    let taken = taken - taken_before;
    let made = made - made_before;
    assert!(
        made > 0 && 3 * taken >= 2 * made,
        "{taken} of {made} honest maps in {ATTACK:?}"
    );
    assert!(
        unproven(gauss.counters()) > 20 && unproven(euclid.counters()) > 20,
        "counted"
    );
    assert_eq!(gauss.leadership().borrow().position, Position::Following);
    for node in [edge, euclid, gauss] {
        node.stop().await;
    }
}
