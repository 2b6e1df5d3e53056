//! Assignment of the detections of a report to tracks: at most one for each, with the greatest total benefit.

use crate::association::{Candidate, ClusterSize, assign as assign_all};

/// A detection and a track within the gate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Pairing {
    pub(super) detection: u32,
    pub(super) track: u32,
    /// More than zero.
    pub(super) benefit: f64,
}

/// Detections in one cluster beyond which the best pairs are taken one after the other.
const MAX_CLUSTER: usize = 48;

impl Candidate for Pairing {
    const SPARE_COLUMNS: bool = true;

    fn row(&self) -> u32 {
        self.detection
    }

    fn column(&self) -> u32 {
        self.track
    }

    /// The benefit in units of 2⁻³⁰, at least one unit.
    fn benefit(&self) -> i64 {
        (self.benefit.min(1e6) * f64::from(1u32 << 30)) as i64 + 1
    }
}

/// The best pairings, by detection.
pub(super) fn assign(mut pairings: Vec<Pairing>) -> Vec<Pairing> {
    pairings.sort_by_key(|pairing| (pairing.detection, pairing.track));
    let mut assigned = assign_all(pairings, greedy_if_large);
    assigned.sort_by_key(|pairing| pairing.detection);
    assigned
}

/// Of a cluster that is too large, the pairings taken one after the other, the best first.
fn greedy_if_large(size: ClusterSize, cluster: &[Pairing]) -> Option<Vec<Pairing>> {
    (size.rows > MAX_CLUSTER).then(|| {
        let mut by_benefit = cluster.to_vec();
        by_benefit.sort_by(|a, b| b.benefit.total_cmp(&a.benefit));
        let mut chosen: Vec<Pairing> = Vec::new();
        for pairing in by_benefit {
            if chosen.iter().all(|other| other.detection != pairing.detection && other.track != pairing.track) {
                chosen.push(pairing);
            }
        }
        chosen
    })
}
