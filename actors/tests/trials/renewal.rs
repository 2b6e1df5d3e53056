//! Cells of real processes whose certificates end and are renewed by the node with the CA.

use std::collections::BTreeMap;
use std::path::Path;
use std::time::Duration;

use ecod::model::time::Timestamp;
use ecod_actors::messages::newest::ReceivedMap;
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

const DAY: Duration = Duration::from_secs(86_400);

/// Validity in the simulated year: certificates of the start are renewed after 150 and 300 days.
const VALID_IN_YEAR: Duration = Duration::from_secs(180 * 86_400);

/// Days by which the wall clocks of all machines step together.
const STEP_DAYS: u32 = 5;

/// Real time between two steps.
const STEP_TIME: Duration = Duration::from_secs(2);

fn expires(certificate: &Path) -> Option<Timestamp> {
    let certificate = CertificateDer::from_pem_file(certificate).ok()?;
    Some(CertificateSubject::of(&certificate).ok()?.expires())
}

/// The ends of all certificates that each node has had, in their order.
#[derive(Default)]
struct Ends(BTreeMap<&'static str, Vec<Timestamp>>);

impl Ends {
    /// Reads the present certificates.
    fn read(&mut self, cell: &Cell) {
        for node in NODES {
            let ends = self.0.entry(node).or_default();
            match expires(&cell.certificate(node)) {
                Some(end) if ends.last() != Some(&end) => ends.push(end),
                _ => {}
            }
        }
    }

    fn renewals(&self, node: &str) -> usize {
        self.0[node].len() - 1
    }
}

/// A cell whose edge leads both vehicles.
fn started(valid: Duration, clock: Fake) -> Cell {
    let mut cell = Cell::with_renewals(valid);
    for node in NODES {
        cell.start(node, clock);
    }
    until_edge_leads(&mut cell);
    cell
}

fn until_edge_leads(cell: &mut Cell) {
    cell.until("both vehicles are in the edge's map", |record| {
        record.source() == Some("edge") && record.has_lately(["euclid", "gauss"])
    });
}

/// Maps of the edge's one term that a node has not accepted between its first and its last. A map
/// at a step of the clocks is left out: followers refuse a map that is dated days ahead.
fn missed(maps: &[ReceivedMap]) -> u64 {
    let missed = |pair: &[ReceivedMap]| {
        let [before, after] = [&pair[0], &pair[1]];
        let [from, to] = [&before.map, &after.map];
        assert_eq!(
            (&from.aggregator, from.epoch),
            (&to.aggregator, to.epoch),
            "another term"
        );
        let is_step = after.received_at.since(before.received_at) >= DAY;
        if is_step {
            0
        } else {
            to.round - from.round - 1
        }
    };
    maps.windows(2).map(missed).sum()
}

/// Longest time between two maps.
fn longest_gap(maps: &[ReceivedMap]) -> Duration {
    let gaps = maps
        .windows(2)
        .map(|pair| pair[1].received_at.since(pair[0].received_at));
    gaps.max().unwrap_or(Duration::MAX)
}

/// Each node of a cell of three is renewed twice, and all live past the end of their first two certificates.
#[test]
#[ignore = "takes six minutes: make renewal"]
fn every_node_is_renewed_twice() {
    let mut cell = started(VALID, Fake::Off);
    let began = true_time();
    let mut ends = Ends::default();
    let is_over = |ends: &Ends| {
        let noticed =
            |ends: &Vec<Timestamp>| ends.len() > 2 && true_time() >= ends[1] + NOTICED_WITHIN;
        ends.0.len() == NODES.len() && ends.0.values().all(noticed)
    };
    while !is_over(&ends) {
        let Ends(seen) = &ends;
        assert!(
            true_time().since(began) < 4 * VALID,
            "not renewed: {seen:?}"
        );
        ends.read(&cell);
        std::thread::sleep(Duration::from_millis(100));
    }
    until_edge_leads(&mut cell);
    let mut gaps = Vec::new();
    for node in NODES {
        let maps: Vec<_> = cell
            .maps(node)
            .into_iter()
            .filter(|map| map.received_at >= began)
            .collect();
        let gap = longest_gap(&maps);
        println!(
            "{node}: {} renewals in {} s, {} of {} maps missed, longest time without a map {} ms",
            ends.renewals(node),
            true_time().since(began).as_secs(),
            missed(&maps),
            maps.len(),
            gap.as_millis()
        );
        gaps.push(gap);
        assert_eq!(missed(&maps), 0, "{node}");
        assert!(!cell.log(node).contains("certificate_ends"), "{node} warns");
    }
    assert!(gaps.iter().all(|gap| *gap <= LONGEST_GAP), "{gaps:?}");
}

/// The wall clocks of a cell of three pass a year, in steps, while its steady clocks pass minutes.
#[test]
#[ignore = "takes three minutes: make renewal"]
fn year_passes_without_missed_map() {
    let mut cell = started(VALID_IN_YEAR, Fake::Seconds(0));
    let before = NODES.map(|node| cell.maps(node).len());
    let mut ends = Ends::default();
    ends.read(&cell);
    let began = cell.now();
    for day in (STEP_DAYS..=365).step_by(STEP_DAYS as usize) {
        cell.set_all(Fake::Seconds(i64::try_from((day * DAY).as_secs()).unwrap()));
        let next = cell.now() + STEP_TIME;
        cell.until("time passes", |record| {
            record.last_at().is_some_and(|at| at >= next)
        });
        ends.read(&cell);
    }
    until_edge_leads(&mut cell);
    let record = cell.record();
    let gap = record
        .times(began, |_| true)
        .windows(2)
        .map(|pair| pair[1].since(pair[0]))
        .max();
    println!("longest time without a map at gauss: {gap:?}");
    for (node, before) in NODES.into_iter().zip(before) {
        let maps = &cell.maps(node)[before..];
        println!(
            "{node}: {} renewals in a year, {} of {} maps missed",
            ends.renewals(node),
            missed(maps),
            maps.len()
        );
    }
    for (node, before) in NODES.into_iter().zip(before) {
        assert_eq!(ends.renewals(node), 2, "{node}");
        assert_eq!(missed(&cell.maps(node)[before..]), 0, "{node}");
        // At a step a node finds its clock wrong, until it has the clocks of the others.
        let log = cell.log(node);
        let mut warnings = log
            .lines()
            .filter(|line| line.contains("certificate_ends") && !line.contains("clock is wrong"));
        assert_eq!(warnings.next(), None, "{node} warns");
    }
}
