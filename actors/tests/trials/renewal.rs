//! Cells of real processes whose certificates are valid for minutes and renewed by the node with the CA.

use std::collections::BTreeMap;
use std::path::Path;
use std::time::Duration;

use ecod::model::time::Timestamp;
use ecod_actors::transport::pki::CertificateSubject;
use rustls::pki_types::CertificateDer;
use rustls::pki_types::pem::PemObject;

use crate::clocks::cell::{Cell, Fake, true_time};

/// Validity of each certificate. Its last third begins before a leader hands over, in the last minute.
const VALID: Duration = Duration::from_secs(180);

/// Longest time without a map at a vehicle: rounds follow each other in 0.1 s.
const LONGEST_GAP: Duration = Duration::from_millis(400);

const NODES: [&str; 3] = ["edge", "euclid", "gauss"];

/// Time after the end of a certificate in which brokers and clients notice it.
const NOTICED_WITHIN: Duration = Duration::from_secs(40);

fn expires(certificate: &Path) -> Option<Timestamp> {
    let certificate = CertificateDer::from_pem_file(certificate).ok()?;
    Some(CertificateSubject::of(&certificate).ok()?.expires())
}

/// Longest time between two maps at a node since a time.
fn longest_gap(cell: &Cell, node: &str, since: Timestamp) -> Duration {
    let arrivals: Vec<_> = cell
        .arrivals(node)
        .into_iter()
        .filter(|at| *at >= since)
        .collect();
    let gaps = arrivals.windows(2).map(|pair| pair[1].since(pair[0]));
    gaps.max().unwrap_or(Duration::MAX)
}

/// Each node of a cell of three is renewed twice, and all live past the end of their first two certificates.
#[test]
#[ignore = "takes six minutes: make renewal"]
fn every_node_is_renewed_twice() {
    let mut cell = Cell::with_renewals(VALID);
    for node in NODES {
        cell.start(node, Fake::Off);
    }
    cell.until("the edge leads both vehicles", |record| {
        record.source() == Some("edge") && record.has_lately(["euclid", "gauss"])
    });
    let began = true_time();
    let mut ends: BTreeMap<_, Vec<_>> = BTreeMap::new();
    let is_over = |ends: &BTreeMap<&str, Vec<Timestamp>>| {
        let noticed =
            |ends: &Vec<Timestamp>| ends.len() > 2 && true_time() >= ends[1] + NOTICED_WITHIN;
        ends.len() == NODES.len() && ends.values().all(noticed)
    };
    while !is_over(&ends) {
        assert!(
            true_time().since(began) < 4 * VALID,
            "not renewed: {ends:?}"
        );
        for node in NODES {
            let ends = ends.entry(node).or_default();
            match expires(&cell.certificate(node)) {
                Some(end) if ends.last() != Some(&end) => ends.push(end),
                _ => {}
            }
        }
        std::thread::sleep(Duration::from_millis(100));
    }
    cell.until("both vehicles are in the map", |record| {
        record.source() == Some("edge") && record.has_lately(["euclid", "gauss"])
    });
    let mut gaps = Vec::new();
    for node in NODES {
        let gap = longest_gap(&cell, node, began);
        println!(
            "{node}: {} renewals in {} s, longest time without a map {} ms",
            ends[node].len() - 1,
            true_time().since(began).as_secs(),
            gap.as_millis()
        );
        gaps.push(gap);
        assert!(!cell.log(node).contains("certificate_ends"), "{node} warns");
    }
    assert!(gaps.iter().all(|gap| *gap <= LONGEST_GAP), "{gaps:?}");
}
