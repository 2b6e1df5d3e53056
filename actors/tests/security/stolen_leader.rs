//! A leader whose certificate is revoked while it leads, and which does not know it: its own list stays as it was.

use std::net::SocketAddr;
use std::time::Duration;

use ecod::leadership::Position;
use ecod::wire::Role;
use ecod_actors::node::config::NodeConfig;
use ecod_actors::node::{self, NodeHandle};
use ecod_actors::platform::clock;
use ecod_actors::transport::pki::TlsConfig;
use tokio::time::{Instant, sleep};

use crate::fixture::{DAY, Pki, SOON, node as name};

/// Time in which nodes read a changed list and go on without the leader, with room for a busy machine. Measured alone:
/// 1.1 to 1.5 s, of which up to 1 s passes until the list is read.
const REPLACED_WITHIN: Duration = Duration::from_secs(5);

async fn start(node: &str, role: Role, tls: TlsConfig, seed: Option<SocketAddr>) -> NodeHandle {
    let mut config = NodeConfig {
        name: Some(name(node)),
        cell: name("lot"),
        role,
        listen: Some("127.0.0.1:0".parse().unwrap()),
        tls: Some(tls),
        ..NodeConfig::default()
    };
    config.membership.bind = Some("127.0.0.1:0".parse().unwrap());
    config.membership.multicast.enabled = false;
    config.membership.seeds = seed.iter().map(ToString::to_string).collect();
    config.dashboard.enabled = false;
    node::start(config).await.unwrap()
}

/// Leader of the newest map of a node.
fn aggregator(node: &NodeHandle) -> Option<String> {
    node.newest_map().borrow().as_ref().map(|newest| newest.map.aggregator.to_string())
}

async fn until(what: &str, is_reached: impl Fn() -> bool) -> Duration {
    let start = Instant::now();
    while !is_reached() {
        assert!(start.elapsed() < SOON, "never: {what}");
        sleep(Duration::from_millis(5)).await;
    }
    start.elapsed()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_revoked_leader_is_replaced_as_soon_as_the_list_is_read_and_does_not_come_back() {
    let mut pki = Pki::new();
    let [mut edge_files, euclid_files, gauss_files] =
        [("edge", Role::Edge), ("euclid", Role::Auto), ("gauss", Role::Cav)]
            .map(|(node, role)| pki.issue(node, role, DAY));
    let own_list = tempfile::NamedTempFile::new().unwrap();
    std::fs::copy(pki.authority.revocation_list(), own_list.path()).unwrap();
    edge_files.revocation_list = Some(own_list.path().into());

    let edge = start("edge", Role::Edge, edge_files, None).await;
    let seed = edge.gossip_address();
    let euclid = start("euclid", Role::Auto, euclid_files, seed).await;
    let gauss = start("gauss", Role::Cav, gauss_files, euclid.gossip_address()).await;
    until("edge leads all, with a standby", || {
        let stands_by = euclid.leadership().borrow().position == Position::StandingBy;
        stands_by && [&euclid, &gauss].iter().all(|node| aggregator(node).as_deref() == Some("edge"))
    })
    .await;

    pki.authority.revoke(&name("edge"), clock::now()).unwrap();
    let replaced_in = until("maps of another leader", || aggregator(&gauss).as_deref() == Some("euclid")).await;
    println!("the next leader's first map came {replaced_in:?} after the list was written");
    assert!(replaced_in < REPLACED_WITHIN, "{replaced_in:?}");
    let end = Instant::now() + Duration::from_secs(3);
    while Instant::now() < end {
        for node in [&euclid, &gauss] {
            assert_eq!(aggregator(node).as_deref(), Some("euclid"), "the revoked leader is heard again");
        }
        sleep(Duration::from_millis(5)).await;
    }
    assert!(euclid.leadership().borrow().is_leading());
    for node in [edge, euclid, gauss] {
        node.stop().await;
    }
}
