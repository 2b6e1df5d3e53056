//! A leader whose certificate ends soon, and gets a new one.

use std::time::Duration;

use ecod::wire::Role;
use ecod_actors::node::NodeHandle;
use tokio::time::{Instant, sleep};

use crate::fixture::{DAY, Pki, SOON};
use crate::nodes::{aggregator, start_cell};

/// Longest time without a map: far less than connections take that end with the certificate.
const LONGEST_GAP: Duration = Duration::from_millis(600);

/// Validity of which hardly more is left than the margin in which another candidate leads.
const ENDS_SOON: Duration = Duration::from_secs(61);

/// Waits for maps of this leader; the longest time without any map meanwhile.
async fn longest_gap_until(leader: &str, node: &NodeHandle) -> Duration {
    let (start, mut newest) = (Instant::now(), node.newest_map());
    let (mut last, mut longest) = (Instant::now(), Duration::ZERO);
    while aggregator(node).as_deref() != Some(leader) {
        assert!(start.elapsed() < SOON, "{leader} does not lead");
        if tokio::time::timeout(Duration::from_secs(5), newest.changed())
            .await
            .is_ok()
        {
            longest = longest.max(last.elapsed());
            last = Instant::now();
        }
    }
    longest
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_leader_hands_over_before_its_certificate_ends_and_leads_again_with_a_new_one() {
    let mut pki = Pki::new();
    let files = pki.issue_three();
    let nodes = start_cell(files).await;
    let gauss = &nodes[2];
    for (valid, leader) in [(ENDS_SOON, "euclid"), (DAY, "edge")] {
        pki.issue("edge", Role::Edge, valid);
        let gap = longest_gap_until(leader, gauss).await;
        println!("{leader} leads, longest time without a map {gap:?}");
        assert!(gap < LONGEST_GAP, "{leader}: {gap:?}");
    }
    sleep(Duration::from_secs(1)).await;
    assert_eq!(aggregator(gauss).as_deref(), Some("edge"));
    for node in nodes {
        node.stop().await;
    }
}
