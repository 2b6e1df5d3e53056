//! Leaders at whose broker their followers cannot log in, while their messages pass.

use std::time::Duration;

use ecod::wire::Role;
use ecod_actors::node::NodeHandle;
use tokio::time::sleep;

use crate::fixture::{DAY, Pki};
use crate::nodes::{aggregator, start, start_with, until};

/// An edge whose broker has room for its own node only.
async fn full_edge(pki: &mut Pki) -> NodeHandle {
    let tls = pki.issue("edge", Role::Edge, DAY);
    let edge = start_with("edge", Role::Edge, tls, None, |config| config.broker.max_clients = 1).await;
    until("edge leads alone", || aggregator(&edge).as_deref() == Some("edge")).await;
    edge
}

#[tokio::test]
async fn followers_of_a_leader_that_lets_nobody_in_go_on_to_the_next() {
    let mut pki = Pki::new();
    let edge = full_edge(&mut pki).await;
    let euclid = pki.issue("euclid", Role::Auto, DAY);
    let euclid = start("euclid", Role::Auto, euclid, edge.gossip_address()).await;
    let gauss = pki.issue("gauss", Role::Cav, DAY);
    let gauss = start("gauss", Role::Cav, gauss, edge.gossip_address()).await;
    let follows_euclid = |node: &NodeHandle| aggregator(node).as_deref() == Some("euclid");
    let nodes = [&edge, &euclid, &gauss];
    until("euclid leads all", || nodes.into_iter().all(follows_euclid)).await;
    let term = euclid.leadership().borrow().term;
    // Longer than an edge is on trial before it is handed the lead.
    sleep(Duration::from_secs(7)).await;
    assert!(nodes.into_iter().all(follows_euclid), "{:?}", nodes.map(aggregator));
    assert_eq!(euclid.leadership().borrow().term, term, "the lead moved again");
    for node in [gauss, euclid, edge] {
        node.stop().await;
    }
}

#[tokio::test]
async fn a_leader_that_lets_nobody_in_says_so_where_nobody_else_can_lead() {
    let mut pki = Pki::new();
    let edge = full_edge(&mut pki).await;
    let gauss = pki.issue("gauss", Role::Cav, DAY);
    let gauss = start("gauss", Role::Cav, gauss, edge.gossip_address()).await;
    until("edge knows it", || edge.leadership().borrow().is_deserted).await;
    gauss.stop().await;
    until("nobody is left to complain", || !edge.leadership().borrow().is_deserted).await;
    edge.stop().await;
}
