//! A leader whose certificate is revoked while it leads, without its knowledge: its own list remains unchanged.

use std::time::Duration;

use ecod_actors::node::NodeHandle;
use ecod_actors::platform::clock;
use ecod_testkit::until;
use tokio::time::{Instant, sleep};

use crate::fixture::{GONE_WITHIN, Pki, node as name};
use crate::nodes::{aggregator, start_cell};

/// Time in which nodes go on without the leader, from when the first of them has read the list.
const REPLACED_WITHIN: Duration = Duration::from_secs(1);

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn revoked_leader_is_replaced() {
    let mut pki = Pki::new();
    let [mut edge_files, euclid_files, gauss_files] = pki.issue_three();
    let own_list = tempfile::NamedTempFile::new().unwrap();
    std::fs::copy(pki.authority.revocation_list(), own_list.path()).unwrap();
    edge_files.revocation_list = Some(own_list.path().into());

    let [edge, euclid, gauss] = start_cell([edge_files, euclid_files, gauss_files]).await;

    pki.authority.revoke(&name("edge"), clock::now()).unwrap();
    let revoked = Instant::now();
    let read_in = until("the list is read", || {
        let knows_edge = |node: &NodeHandle| {
            node.members()
                .borrow()
                .iter()
                .any(|member| member.name == name("edge"))
        };
        !knows_edge(&euclid) || !knows_edge(&gauss)
    })
    .await;
    let replaced_in = until("maps of another leader", || {
        aggregator(&gauss).as_deref() == Some("euclid")
    })
    .await;
    println!(
        "the next leader's first map came {replaced_in:?} after the list was read, which took {read_in:?}"
    );
    assert!(
        read_in < GONE_WITHIN && replaced_in < REPLACED_WITHIN,
        "{read_in:?}, {replaced_in:?}"
    );
    let reputations_of = |node: &NodeHandle| {
        let newest = node.newest_reputations().borrow().clone();
        newest.and_then(|newest| newest.message.aggregator.clone())
    };
    until("all is of another leader", || {
        [&euclid, &gauss].into_iter().all(|node| {
            aggregator(node).as_deref() == Some("euclid")
                && reputations_of(node) == Some(name("euclid"))
        })
    })
    .await;
    let gone_in = revoked.elapsed();
    println!("on each node all was gone {gone_in:?} after the revocation, reputations included");
    assert!(gone_in < GONE_WITHIN, "{gone_in:?}");
    let end = Instant::now() + Duration::from_secs(3);
    while Instant::now() < end {
        for node in [&euclid, &gauss] {
            assert_eq!(
                aggregator(node).as_deref(),
                Some("euclid"),
                "a message of the revoked leader was accepted again"
            );
        }
        sleep(Duration::from_millis(5)).await;
    }
    assert!(euclid.leadership().borrow().is_leading());
    for node in [edge, euclid, gauss] {
        node.stop().await;
    }
}
