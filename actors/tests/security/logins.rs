//! Leaders at whose broker their followers cannot log in, while their messages pass.

use std::fs;
use std::io::{self, Write};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use ecod::wire::Role;
use ecod_actors::node::NodeHandle;
use ecod_actors::transport::pki::TlsConfig;
use ecod_testkit::until;
use tokio::time::{Instant, sleep};

use crate::fixture::{Client, DAY, Pki, SOON, client_config};
use crate::nodes::{aggregator, start, start_cell, start_with};

/// An edge whose broker has room for its own node only.
async fn full_edge(pki: &mut Pki) -> NodeHandle {
    let tls = pki.issue("edge", Role::Edge, DAY);
    let edge = start_with("edge", Role::Edge, tls, None, |config| {
        config.broker.max_clients = 1;
    })
    .await;
    until("edge leads alone", || {
        aggregator(&edge).as_deref() == Some("edge")
    })
    .await;
    edge
}

#[tokio::test]
async fn followers_skip_leader_refusing_logins() {
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
    assert!(
        nodes.into_iter().all(follows_euclid),
        "{:?}",
        nodes.map(aggregator)
    );
    assert_eq!(
        euclid.leadership().borrow().term,
        term,
        "the lead moved again"
    );
    for node in [gauss, euclid, edge] {
        node.stop().await;
    }
}

/// Lines of the log of this thread.
#[derive(Clone, Default)]
struct Log(Arc<Mutex<Vec<u8>>>);

impl Log {
    fn has(&self, text: &str) -> bool {
        String::from_utf8_lossy(&self.0.lock().unwrap()).contains(text)
    }
}

impl Write for Log {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.lock().unwrap().write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// Sessions of the membership continue with the former certificate. New connections use the other certificate.
#[tokio::test]
async fn followers_skip_distrusted_leader() {
    let mut pki = Pki::new();
    let mut elsewhere = Pki::new();
    let files = pki.issue_three();
    let foreign = elsewhere.issue("edge", Role::Edge, DAY);
    let tls = client_config("gauss", &files[2]);
    // Only the edge trusts the other CA.
    let own = TlsConfig {
        ca: files[0].ca.with_file_name("both.pem"),
        revocation_list: None,
        ..files[0].clone()
    };
    let both = [&files[0].ca, &foreign.ca].map(|ca| fs::read_to_string(ca).unwrap());
    fs::write(&own.ca, both.concat()).unwrap();
    let [_, euclid, gauss] = files;
    let [edge, euclid, gauss] = start_cell([own.clone(), euclid, gauss]).await;
    let broker = edge.broker_address().unwrap();
    for (from, to) in [
        (&foreign.certificate, &own.certificate),
        (&foreign.key, &own.key),
    ] {
        fs::copy(from, to).unwrap();
    }
    let refused = Instant::now() + SOON;
    while Client::new(broker, "gauss", &tls).log_in().await.is_ok() {
        assert!(Instant::now() < refused, "the edge keeps its certificate");
    }
    let log = Log::default();
    let writer = log.clone();
    let lines = tracing_subscriber::fmt()
        .with_ansi(false)
        .with_writer(move || writer.clone())
        .finish();
    let _logging = tracing::subscriber::set_default(lines);
    for node in [&euclid, &gauss] {
        node.slots().gateway.get().unwrap().kill();
    }
    let follows_euclid = |node: &NodeHandle| aggregator(node).as_deref() == Some("euclid");
    until("euclid leads all", || {
        [&edge, &euclid, &gauss].into_iter().all(follows_euclid)
    })
    .await;
    assert!(
        log.has("logins at its broker fail") && log.has(r#"about="edge""#),
        "no warning"
    );
    for node in [gauss, euclid, edge] {
        node.stop().await;
    }
}

/// Its own files are in order, so that it starts, and leads where it is alone.
#[tokio::test]
async fn foreign_edge_disturbs_no_cell() {
    let mut pki = Pki::new();
    let mut elsewhere = Pki::new();
    let files = pki.issue_three();
    let [edge, euclid, gauss] = start_cell(files).await;
    edge.stop().await;
    until("euclid leads", || {
        aggregator(&gauss).as_deref() == Some("euclid")
    })
    .await;
    let term = euclid.leadership().borrow().term;
    let foreign = TlsConfig {
        ca: pki.authority.ca(),
        ..elsewhere.issue("edge", Role::Edge, DAY)
    };
    let edge = start("edge", Role::Edge, foreign, euclid.gossip_address()).await;
    let round = || {
        gauss
            .newest_map()
            .borrow()
            .as_ref()
            .map_or(0, |newest| newest.map.round)
    };
    // Longer than an edge is on trial before it is handed the lead.
    let first = round();
    let began = Instant::now();
    sleep(Duration::from_secs(8)).await;
    let rounds = round() - first;
    let expected = began.elapsed().as_millis() as u64 / 100;
    assert_eq!(aggregator(&gauss).as_deref(), Some("euclid"));
    assert_eq!(euclid.leadership().borrow().term, term, "the lead moved");
    assert!(
        rounds * 20 >= expected * 19,
        "{rounds} of {expected} rounds"
    );
    assert!(edge.members().borrow().is_empty(), "admitted");
    for node in [gauss, euclid, edge] {
        node.stop().await;
    }
}

#[tokio::test]
async fn sole_leader_reports_refused_logins() {
    let mut pki = Pki::new();
    let edge = full_edge(&mut pki).await;
    let gauss = pki.issue("gauss", Role::Cav, DAY);
    let gauss = start("gauss", Role::Cav, gauss, edge.gossip_address()).await;
    until("the edge has the report", || {
        edge.leadership().borrow().is_deserted
    })
    .await;
    gauss.stop().await;
    until("no node reports a trouble", || {
        !edge.leadership().borrow().is_deserted
    })
    .await;
    edge.stop().await;
}
