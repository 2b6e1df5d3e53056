//! Reliability of stated probabilities: how often a statement of a given probability is right.
//!
//! The expected calibration error is the mean difference of both over bins of equal width, weighted
//! by the statements in each (Naeini, Cooper, Hauskrecht, AAAI 2015). Zero is perfect; the error
//! does not measure how well probabilities separate right statements from wrong ones.

use serde::Serialize;

/// Bins of equal width.
const BINS: usize = 10;

/// A statement that has been judged.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct JudgedStatement {
    /// Its probability according to its author, 0 to 1.
    pub(super) stated: f64,
    pub(super) is_right: bool,
}

/// The reliability diagram of a probability, and its expected calibration error.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Reliability {
    /// Expected calibration error; `None` without statements.
    pub ece_pct: Option<f64>,
    /// Bins that are not empty, in ascending order.
    pub bins: Vec<ReliabilityBin>,
}

/// Objects of which nearly the same probability was stated.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ReliabilityBin {
    /// Mean of the stated probabilities in percent.
    pub stated_pct: f64,
    /// The share of them that is right.
    pub right_pct: f64,
    /// Number of objects in the bin.
    pub objects: u64,
}

/// Sums over the statements in one bin.
#[derive(Debug, Clone, Copy, Default)]
struct BinSums {
    objects: u64,
    right: f64,
    stated: f64,
}

impl Reliability {
    /// The diagram of `statements`.
    pub(super) fn of(statements: impl IntoIterator<Item = JudgedStatement>) -> Self {
        let mut sums = [BinSums::default(); BINS];
        for statement in statements {
            let bin = ((statement.stated * BINS as f64) as usize).min(BINS - 1);
            sums[bin].objects += 1;
            sums[bin].right += f64::from(u8::from(statement.is_right));
            sums[bin].stated += statement.stated;
        }
        let all: u64 = sums.iter().map(|bin| bin.objects).sum();
        let error: f64 = sums.iter().map(|bin| (bin.right - bin.stated).abs()).sum();
        let filled = sums.iter().filter(|bin| bin.objects > 0);
        let bins = filled.map(|bin| ReliabilityBin {
            stated_pct: 100.0 * bin.stated / bin.objects as f64,
            right_pct: 100.0 * bin.right / bin.objects as f64,
            objects: bin.objects,
        });
        Self {
            ece_pct: (all > 0).then(|| 100.0 * error / all as f64),
            bins: bins.collect(),
        }
    }
}
