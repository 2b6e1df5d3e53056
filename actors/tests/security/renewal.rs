//! Certificates that end soon are renewed by the node that has the CA.

use std::path::Path;
use std::time::Duration;

use ecod::model::names::NodeName;
use ecod::wire::Role;
use ecod_actors::node::NodeHandle;
use ecod_actors::platform::clock;
use ecod_actors::telemetry::counters::Event;
use ecod_actors::transport::gossip::FrameEvent;
use ecod_actors::transport::pki::{Authority, Credentials, TlsConfig};
use ecod_testkit::until;
use tempfile::TempDir;
use tokio::time::timeout;

use crate::fixture::{DAY, node as name};
use crate::nodes::{aggregator, start, start_cell};

/// Three machines; the edge's has the CA, where `ecod-node init` makes it.
struct Machines {
    directory: TempDir,
    authority: Authority,
}

const NODES: [(&str, Role); 3] = [
    ("edge", Role::Edge),
    ("euclid", Role::Auto),
    ("gauss", Role::Cav),
];

impl Machines {
    fn new() -> Self {
        let directory = tempfile::tempdir().unwrap();
        let pki = directory.path().join("edge/pki");
        let authority = Authority::init(&pki, &name("lot"), clock::now()).unwrap();
        Self {
            directory,
            authority,
        }
    }

    /// Files of a certificate of 90 days, of which some have passed.
    fn files(&mut self, node: &str, role: Role, age_days: u32) -> TlsConfig {
        let issued_at = clock::now() - age_days * DAY;
        self.authority
            .issue(&name(node), role, 90 * DAY, issued_at)
            .unwrap();
        let machine = self.directory.path().join(node);
        std::fs::create_dir_all(&machine).unwrap();
        let (certificate, key) = self.authority.files_of(&name(node));
        let ca = self.authority.ca();
        let list = self.authority.revocation_list();
        let copy = |from: &Path, to: &str| {
            let to = machine.join(to);
            std::fs::copy(from, &to).unwrap();
            to
        };
        TlsConfig {
            ca: copy(&ca, "ca.pem"),
            certificate: copy(&certificate, "node.pem"),
            key: copy(&key, "node.key"),
            revocation_list: Some(copy(&list, "revoked.pem")),
            city: None,
        }
    }
}

/// Days that the certificate in a node's files is still valid.
fn days_left(files: &TlsConfig, node: &'static str) -> u64 {
    let credentials = Credentials::load(files, &NodeName::from_static(node)).unwrap();
    let expires = credentials.current().identity.expires();
    expires.since(clock::wall()).as_secs() / DAY.as_secs()
}

/// The trouble of a node about its own certificate.
fn ending(node: &NodeHandle) -> Option<String> {
    let troubles = node.counters().troubles().present().into_iter();
    let mut of_kind = troubles.filter(|trouble| trouble.kind == "certificate_ends");
    of_kind.next().map(|trouble| trouble.cause)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn cell_renews_certificates_at_ca() {
    let mut machines = Machines::new();
    let files = NODES.map(|(node, role)| machines.files(node, role, 65));
    let keys = files
        .each_ref()
        .map(|files| std::fs::read(&files.key).unwrap());
    let nodes = start_cell(files.clone()).await;
    for ((files, (node, role)), former) in files.iter().zip(NODES).zip(&keys) {
        until("renewed", || days_left(files, node) >= 89).await;
        assert_ne!(
            std::fs::read(&files.key).unwrap(),
            *former,
            "{node} has another key"
        );
        let credentials = Credentials::load(files, &name(node)).unwrap();
        let rights = credentials.current().identity.rights();
        assert_eq!(rights.role, role, "{node}");
    }
    assert_eq!(nodes.each_ref().map(ending), [None, None, None]);
    assert_eq!(aggregator(&nodes[2]).as_deref(), Some("edge"));
    for node in nodes {
        node.stop().await;
    }
}

/// Links of each node: to the brokers of the edge and of the standby.
const LINKS: u64 = 2;

/// The old certificates are still valid for months: a link doesn't wait for their end, at which all
/// links would break together.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn renewed_links_lose_no_map() {
    let mut machines = Machines::new();
    let files = NODES.map(|(node, role)| machines.files(node, role, 1));
    let nodes = start_cell(files).await;
    let count = |event| nodes.each_ref().map(|node| node.counters().events(event));
    until("all links are up", || {
        count(Event::Connected).iter().all(|count| *count >= LINKS)
    })
    .await;
    let before = count(Event::Connected);
    let mut newest = nodes[2].newest_map();
    for (node, role) in NODES {
        machines.files(node, role, 0);
    }
    let mut rounds = Vec::new();
    let all_log_in_again = async {
        let is_over = |now: [u64; 3]| now.iter().zip(before).all(|(now, old)| *now >= old + LINKS);
        while !is_over(count(Event::Connected)) {
            newest.changed().await.unwrap();
            let newest = newest.borrow_and_update();
            let map = &newest.as_ref().unwrap().map;
            rounds.push((map.epoch, map.round));
        }
    };
    timeout(Duration::from_secs(30), all_log_in_again)
        .await
        .expect("all links log in by the new certificates");
    let missed = |pair: &[(u64, u64)]| pair[1] != (pair[0].0, pair[0].1 + 1);
    let gap = rounds.windows(2).find(|pair| missed(pair));
    assert_eq!(gap, None, "a missed map or another term");
    assert_eq!(count(Event::Disconnected), [0; 3]);
    for node in nodes {
        node.stop().await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn revoked_certificate_is_not_renewed() {
    let mut machines = Machines::new();
    let edge_files = machines.files("edge", Role::Edge, 0);
    let files = machines.files("gauss", Role::Cav, 65);
    // Nodes still have the former list: only the CA has the revocation.
    machines
        .authority
        .revoke(&name("gauss"), clock::now())
        .unwrap();
    let edge = start("edge", Role::Edge, edge_files, None).await;
    let gauss = start("gauss", Role::Cav, files.clone(), edge.gossip_address()).await;
    until("gauss reports the reason", || ending(&gauss).is_some()).await;
    assert_eq!(
        ending(&gauss).unwrap(),
        "this node's certificate ends in 24 days: edge does not renew it: “its certificate was revoked”"
    );
    assert!(edge.frames().get(FrameEvent::RenewalRefused) > 0);
    assert_eq!(days_left(&files, "gauss"), 24);
    gauss.stop().await;
    edge.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn expiring_ca_warns_every_node() {
    let directory = tempfile::tempdir().unwrap();
    let long_ago = clock::now() - 3300 * DAY;
    let mut authority = Authority::init(directory.path(), &name("lot"), long_ago).unwrap();
    authority
        .issue(&name("edge"), Role::Edge, 90 * DAY, clock::now())
        .unwrap();
    let files = authority.tls_of(&name("edge"));
    let edge = start("edge", Role::Edge, files, None).await;
    let warns = || {
        let troubles = edge.counters().troubles().present();
        troubles.into_iter().any(|trouble| {
            trouble.kind == "ca_ends" && trouble.cause == "the cell's CA ends in 349 days"
        })
    };
    until("the end of the CA is a trouble", warns).await;
    edge.stop().await;
}
