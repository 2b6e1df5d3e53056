//! One-to-one assignment with the greatest total benefit: the global nearest neighbour (Blackman,
//! Popoli, "Design and Analysis of Modern Tracking Systems", 1999, chapter 6.4), by the algorithm
//! of Kuhn and Munkres.
//!
//! PACE assigns objects to places, the tracker detections to tracks, the evaluation reported
//! objects to true ones. Candidates that share a row or a column, directly or through others, form
//! a cluster. Each cluster is solved alone; most have one candidate.

use hashbrown::HashMap;
use pathfinding::kuhn_munkres::kuhn_munkres;
use pathfinding::matrix::Matrix;

/// A row and a column that may be assigned to each other.
pub trait Candidate: Copy {
    /// True if the matrix of a cluster has a spare column for each row. Only the choice between
    /// assignments of equal benefit depends on it.
    const SPARE_COLUMNS: bool = false;

    /// Number of the row; a table has a place for each up to the highest.
    fn row(&self) -> u32;
    /// Number of the column.
    fn column(&self) -> u32;
    /// Benefit of the assignment in fixed-point units of the caller, greater than 0. Integers add
    /// up exactly.
    fn benefit(&self) -> i64;
}

/// Rows and columns of a cluster.
#[derive(Debug, Clone, Copy)]
pub struct ClusterSize {
    /// Rows that occur in it.
    pub rows: usize,
    /// Columns that occur in it.
    pub columns: usize,
}

/// The best assignments, at most one for each row and each column, cluster by cluster. A row may
/// remain without a column at no cost.
///
/// `limit` may assign a large cluster by other means, because the time to solve a cluster grows
/// with the cube of its size.
pub fn assign<C: Candidate>(
    candidates: Vec<C>,
    limit: impl Fn(ClusterSize, &[C]) -> Option<Vec<C>>,
) -> Vec<C> {
    let mut by_cluster = by_cluster(candidates);
    by_cluster.sort_by_key(|(cluster, _)| *cluster);
    let mut assigned = Vec::with_capacity(by_cluster.len());
    for cluster in by_cluster.chunk_by(|a, b| a.0 == b.0) {
        match cluster {
            [(_, only)] => assigned.push(*only),
            _ => {
                let cluster: Vec<C> = cluster.iter().map(|(_, candidate)| *candidate).collect();
                solve(&cluster, &limit, &mut assigned);
            }
        }
    }
    assigned
}

/// The candidates, each with the number of its cluster: disjoint sets (Tarjan 1975).
fn by_cluster<C: Candidate>(candidates: Vec<C>) -> Vec<(u32, C)> {
    let mut parents: Vec<u32> = (0..candidates.len() as u32).collect();
    let rows = candidates
        .iter()
        .map(|candidate| candidate.row() as usize + 1)
        .max()
        .unwrap_or(0);
    let mut of_row: Vec<u32> = vec![u32::MAX; rows];
    let mut of_column: HashMap<u32, u32> = HashMap::with_capacity(candidates.len());
    for (number, candidate) in candidates.iter().enumerate() {
        let of_row = &mut of_row[candidate.row() as usize];
        *of_row = (*of_row).min(number as u32);
        let cluster = root(&mut parents, *of_row);
        parents[number] = cluster;
        let of_column = *of_column.entry(candidate.column()).or_insert(cluster);
        parents[cluster as usize] = root(&mut parents, of_column);
    }
    let numbered = (0..).zip(candidates);
    numbered
        .map(|(number, candidate)| (root(&mut parents, number), candidate))
        .collect()
}

/// The set that a member belongs to, by path halving.
fn root(parents: &mut [u32], mut member: u32) -> u32 {
    while parents[member as usize] != member {
        let grandparent = parents[parents[member as usize] as usize];
        parents[member as usize] = grandparent;
        member = grandparent;
    }
    member
}

fn solve<C: Candidate>(
    cluster: &[C],
    limit: impl Fn(ClusterSize, &[C]) -> Option<Vec<C>>,
    assigned: &mut Vec<C>,
) {
    let mut row_of = HashMap::with_capacity(cluster.len());
    let mut column_of = HashMap::with_capacity(cluster.len());
    let mut cells: Vec<(usize, usize)> = Vec::with_capacity(cluster.len());
    for candidate in cluster {
        let next_row = row_of.len();
        let next_column = column_of.len();
        let row = *row_of.entry(candidate.row()).or_insert(next_row);
        cells.push((
            row,
            *column_of.entry(candidate.column()).or_insert(next_column),
        ));
    }
    let rows = row_of.len();
    let real_columns = column_of.len();
    if let Some(settled) = limit(
        ClusterSize {
            rows,
            columns: real_columns,
        },
        cluster,
    ) {
        assigned.extend(settled);
        return;
    }
    let columns = if C::SPARE_COLUMNS {
        real_columns + rows
    } else {
        real_columns
    };
    // The algorithm requires at least as many columns as rows.
    if rows > columns {
        cells.iter_mut().for_each(|cell| *cell = (cell.1, cell.0));
    }
    let mut benefits = Matrix::new(rows.min(columns), rows.max(columns), 0);
    for (cell, candidate) in cells.iter().zip(cluster) {
        benefits[*cell] = candidate.benefit();
    }
    let (_, best) = kuhn_munkres(&benefits);
    let chosen = cells
        .iter()
        .zip(cluster)
        .filter(|((row, column), _)| best[*row] == *column);
    assigned.extend(chosen.map(|(_, candidate)| *candidate));
}
