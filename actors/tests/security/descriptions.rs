//! A candidate that describes the cell falsely.

use std::time::Duration;

use ecod::leadership::Rights;
use ecod::wire::Role;
use ecod_actors::messages::description_keeper::DescriptionKeeperMessage;
use ecod_actors::node::NodeHandle;
use ecod_actors::platform::clock;
use ecod_testkit::until;
use tokio::time::Instant;

use crate::fixture::{DAY, GONE_WITHIN, Pki, node as name};
use crate::nodes::start_cell;

/// Has a node describe the cell by one place.
fn describe(node: &NodeHandle, place: &str) {
    let text = format!("[[landmarks]]\nid = \"{place}\"\nx_m = 1\ny_m = 0\n");
    assert!(
        node.slots()
            .description
            .send(DescriptionKeeperMessage::Set { text })
    );
}

/// True if the newest map of a node has this place and no other.
fn has_place(node: &NodeHandle, place: &str) -> bool {
    let newest = node.newest_map();
    let newest = newest.borrow();
    newest
        .as_ref()
        .is_some_and(|newest| matches!(&newest.map.landmarks[..], [state] if &*state.id == place))
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn revoked_operator_loses_its_description() {
    let mut pki = Pki::new();
    let operators = [("edge", Role::Edge), ("euclid", Role::Auto)];
    let [edge, euclid] =
        operators.map(|(node, role)| pki.issue(node, Rights::from(role).of_operator(), DAY));
    let files = [edge, euclid, pki.issue("gauss", Role::Cav, DAY)];
    let [edge, euclid, gauss] = start_cell(files).await;
    let all_have = |place: &'static str| {
        [&edge, &gauss]
            .into_iter()
            .all(|node| has_place(node, place))
    };
    describe(&edge, "right");
    until("the right description", || {
        all_have("right") && has_place(&euclid, "right")
    })
    .await;
    for place in ["false", "worse"] {
        describe(&euclid, place);
        until("a false description", || all_have(place)).await;
    }

    pki.authority.revoke(&name("euclid"), clock::now()).unwrap();
    let written = Instant::now();
    until("the right description again", || all_have("right")).await;
    assert!(written.elapsed() < GONE_WITHIN, "{:?}", written.elapsed());
    for node in [edge, euclid, gauss] {
        node.stop().await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn candidate_changes_no_description() {
    let mut pki = Pki::new();
    let edge = pki.issue("edge", Rights::from(Role::Edge).of_operator(), DAY);
    let files = [
        edge,
        pki.issue("euclid", Role::Auto, DAY),
        pki.issue("gauss", Role::Cav, DAY),
    ];
    let [edge, euclid, gauss] = start_cell(files).await;
    describe(&edge, "right");
    until("the right description", || {
        [&edge, &euclid, &gauss]
            .iter()
            .all(|node| has_place(node, "right"))
    })
    .await;
    // Its own door refuses this; a program that was changed does not.
    describe(&euclid, "false");
    tokio::time::sleep(Duration::from_secs(2)).await;
    assert!([&edge, &gauss].iter().all(|node| has_place(node, "right")));
    for node in [edge, euclid, gauss] {
        node.stop().await;
    }
}
