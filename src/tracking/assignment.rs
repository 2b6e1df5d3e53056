//! Which detection of a report is which object: one for each, the best for all together.
//!
//! Detections and objects that are within gates of each other, directly or by way of others, form a cluster; most are
//! of one detection and one object. Within a cluster the sum of the benefits is the greatest possible (global nearest
//! neighbour; Blackman, Popoli, "Design and Analysis of Modern Tracking Systems", 1999, chapter 6.4), by the algorithm
//! of Kuhn and Munkres; to leave a detection without an object has no benefit and no cost.

use hashbrown::HashMap;
use pathfinding::kuhn_munkres::kuhn_munkres;
use pathfinding::matrix::Matrix;

/// A detection and an object within the gate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Pairing {
    pub(super) detection: u32,
    pub(super) track: u32,
    /// More than zero.
    pub(super) benefit: f64,
}

/// Detections in one cluster beyond which the best pairs are taken one after the other: the time to settle a cluster
/// grows with the cube of this.
const LARGEST_CLUSTER: usize = 48;

/// The best pairings of `detections` detections, at most one for each detection and each track, by detection.
pub(super) fn assign(detections: usize, pairings: &[Pairing]) -> Vec<Pairing> {
    let mut clusters = Clusters::new(detections);
    let mut first_of: HashMap<u32, u32> = HashMap::with_capacity(pairings.len());
    for Pairing { detection, track, .. } in pairings {
        clusters.join(*first_of.entry(*track).or_insert(*detection), *detection);
    }
    let mut by_cluster: Vec<(u32, Pairing)> =
        pairings.iter().map(|pairing| (clusters.root(pairing.detection), *pairing)).collect();
    by_cluster.sort_by_key(|(cluster, pairing)| (*cluster, pairing.detection, pairing.track));
    let mut settled = Vec::with_capacity(detections);
    for cluster in by_cluster.chunk_by(|a, b| a.0 == b.0) {
        settle(cluster, &mut settled);
    }
    settled.sort_by_key(|pairing| pairing.detection);
    settled
}

fn settle(cluster: &[(u32, Pairing)], settled: &mut Vec<Pairing>) {
    if let [(_, only)] = cluster {
        settled.push(*only);
        return;
    }
    let mut rows: HashMap<u32, usize> = HashMap::new();
    let mut columns: HashMap<u32, usize> = HashMap::new();
    for (_, pairing) in cluster {
        let next = rows.len();
        rows.entry(pairing.detection).or_insert(next);
        let next = columns.len();
        columns.entry(pairing.track).or_insert(next);
    }
    if rows.len() > LARGEST_CLUSTER {
        one_after_the_other(cluster, settled);
        return;
    }
    // A column for each track, and one for each detection to stay alone in.
    let mut benefits = Matrix::new(rows.len(), columns.len() + rows.len(), 0);
    let cell = |pairing: &Pairing| (rows[&pairing.detection], columns[&pairing.track]);
    for (_, pairing) in cluster {
        benefits[cell(pairing)] = fixed(pairing.benefit);
    }
    let (_, column_of) = kuhn_munkres(&benefits);
    let chosen = cluster.iter().map(|(_, pairing)| pairing);
    settled.extend(chosen.filter(|pairing| column_of[cell(pairing).0] == cell(pairing).1));
}

fn one_after_the_other(cluster: &[(u32, Pairing)], settled: &mut Vec<Pairing>) {
    let mut by_benefit: Vec<&Pairing> = cluster.iter().map(|(_, pairing)| pairing).collect();
    by_benefit.sort_by(|a, b| b.benefit.total_cmp(&a.benefit));
    let mut taken: (Vec<u32>, Vec<u32>) = (Vec::new(), Vec::new());
    for pairing in by_benefit {
        if !taken.0.contains(&pairing.detection) && !taken.1.contains(&pairing.track) {
            taken.0.push(pairing.detection);
            taken.1.push(pairing.track);
            settled.push(*pairing);
        }
    }
}

/// A benefit in units of 2⁻³⁰.
fn fixed(benefit: f64) -> i64 {
    (benefit.min(1e6) * f64::from(1u32 << 30)) as i64 + 1
}

/// Disjoint sets of detections (Tarjan 1975), by path halving.
struct Clusters {
    parents: Vec<u32>,
}

impl Clusters {
    fn new(count: usize) -> Self {
        Self { parents: (0..count as u32).collect() }
    }

    fn root(&mut self, mut member: u32) -> u32 {
        while self.parents[member as usize] != member {
            let grandparent = self.parents[self.parents[member as usize] as usize];
            self.parents[member as usize] = grandparent;
            member = grandparent;
        }
        member
    }

    fn join(&mut self, a: u32, b: u32) {
        let (a, b) = (self.root(a), self.root(b));
        self.parents[a.max(b) as usize] = a.min(b);
    }
}
