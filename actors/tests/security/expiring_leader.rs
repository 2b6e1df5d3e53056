//! A leader whose certificate ends soon, and gets a new one.

use std::time::Duration;

use ecod::leadership::Position;
use ecod::wire::Role;
use ecod_actors::node::NodeHandle;
use ecod_actors::platform::clock;
use ecod_testkit::until;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::time::{Instant, sleep};

use crate::fixture::{DAY, Pki, SOON, node as name};
use crate::nodes::{aggregator, start_cell, start_with};

/// Longest time without a map on a machine that does much else: rounds follow each other in 0.1 s.
const LONGEST_GAP: Duration = Duration::from_millis(350);

/// Validity of which hardly more is left than the margin in which another candidate leads.
const ENDS_SOON: Duration = Duration::from_secs(61);

/// Waits for maps of this leader; the longest time without any map meanwhile.
async fn longest_gap_until(leader: &str, node: &NodeHandle) -> Duration {
    let start = Instant::now();
    let mut newest = node.newest_map();
    let mut last = Instant::now();
    let mut longest = Duration::ZERO;
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
async fn expiring_leader_hands_over() {
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

/// The trouble of a node about the end of its own certificate.
fn ending(node: &NodeHandle) -> Option<String> {
    let troubles = node.counters().troubles().present().into_iter();
    let mut of_kind = troubles.filter(|it| it.kind == "certificate_ends" && it.about.is_none());
    of_kind.next().map(|trouble| trouble.cause)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn distant_expiry_moves_no_lead() {
    let mut pki = Pki::new();
    // Issued long ago, each with a part of its validity left.
    let mut issue = |node: &str, role, days: u32, age_days: u32| {
        let issued_at = clock::now() - age_days * DAY;
        pki.authority
            .issue(&name(node), role, days * DAY, issued_at)
            .unwrap();
        pki.files(&pki.authority, node)
    };
    let files = [
        issue("edge", Role::Edge, 90, 60),
        issue("euclid", Role::Auto, 90, 88),
        issue("gauss", Role::Cav, 90, 50),
    ];
    let nodes = start_cell(files).await;
    let [edge, euclid, gauss] = &nodes;
    until("both name the end", || {
        ending(edge).is_some() && ending(euclid).is_some()
    })
    .await;
    let ends = [edge, euclid, gauss].map(ending);
    let ends = ends.each_ref().map(Option::as_deref);
    let expected = ["29 days", "1 day"].map(|left| {
        format!(
            "this node's certificate ends in {left}: no node that has the key of the cell's CA answers"
        )
    });
    assert_eq!(ends, [Some(&*expected[0]), Some(&*expected[1]), None]);
    assert!(edge.leadership().borrow().is_leading());
    assert_eq!(euclid.leadership().borrow().position, Position::StandingBy);
    pki.issue("euclid", Role::Auto, 90 * DAY);
    until("the new certificate is used", || ending(euclid).is_none()).await;
    assert_eq!(aggregator(gauss).as_deref(), Some("edge"));
    for node in nodes {
        node.stop().await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn prometheus_shows_certificate_validity() {
    let mut pki = Pki::new();
    let files = pki.issue("edge", Role::Edge, DAY);
    let edge = start_with("edge", Role::Edge, files, None, |config| {
        config.dashboard.enabled = true;
        config.dashboard.listen = Some("127.0.0.1:0".parse().unwrap());
    })
    .await;
    let mut page = edge.dashboard_address();
    let page = page.wait_for(Option::is_some).await.unwrap().unwrap();
    let mut stream = TcpStream::connect(page).await.unwrap();
    let request = format!("GET /metrics HTTP/1.1\r\nHost: {page}\r\nConnection: close\r\n\r\n");
    stream.write_all(request.as_bytes()).await.unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).await.unwrap();
    let line = answer
        .lines()
        .find_map(|line| line.strip_prefix("ecod_certificate_remaining_seconds "));
    let left_s: f64 = line.unwrap_or_else(|| panic!("{answer}")).parse().unwrap();
    assert!(
        (DAY.as_secs_f64() - 60.0..=DAY.as_secs_f64()).contains(&left_s),
        "{left_s}"
    );
    edge.stop().await;
}
