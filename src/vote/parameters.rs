//! Parameters of the default mode that are not settings of
//! [`WeightedConfig`](super::config::WeightedConfig). Bounds of memory and of numerical errors are
//! beside their uses.
//!
//! The table shows what happens when a constant is halved or doubled: the change of the mean accuracy
//! on 13 public label sets, online or with passes, and the largest change on a set; and the
//! change for the worst seed where 1 to 7 of 3 to 15 vehicles are faulty in six ways. All other
//! constants change both means by at most 0.1 points. The label sets have no confidences and cannot
//! show the effect of the constants about them.
//!
//! | parameter | halved | doubled |
//! |---|---|---|
//! | [`TOLERATED_PHI`] | +0.1 points, at worst −0.5 on a set | −1.7 points, at worst −12 on a set |
//! | [`SIGNIFICANCE`] | −0.2 points, at worst −1.9 on a set | no change above 0.1 |
//! | [`ITERATIONS`] | −0.1 points, at worst −0.9 on a set | no change above 0.1 |
//! | [`SHORTFALL_SLACK`] | −0.8 points with faulty vehicles | −0.4 points with faulty vehicles |
//!
//! Of the settings, `class_prior_votes` (−1.0 to +0.6 points on a set when halved, −0.4 to +0.5 when
//! doubled), `class_share_verdicts` (−0.3 to +0.2, and −0.9 to +0.2) and `revisit_votes` (−0.4 to
//! +0.2, and −0.2 to +0.1) have an effect above 0.3 points.

/// φ₀: the contingency of vehicles and labels up to which one accuracy per vehicle describes them
/// better than a confusion matrix that is estimated from votes.
pub(super) const TOLERATED_PHI: f64 = 0.22;

/// Standard deviations by which agreement must exceed the expected agreement before two vehicles
/// count as dependent. The limit is high because many pairs are tested at once.
pub(super) const SIGNIFICANCE: f64 = 5.0;

/// Maximum distance in the order of a landmark's votes at which two are compared; bounds the cost of
/// a vote.
pub(super) const MAX_COMPARED: usize = 8;

/// Agreement κ of two vehicles that surely belong to one group; closer agreement earns no more
/// influence.
pub(super) const SAME_GROUP: f64 = 0.3;

/// Weight, in comparisons, of the priors: no agreement between two vehicles, and a vehicle as
/// reliable as others.
pub(super) const PRIOR_COMPARISONS: f64 = 10.0;

/// Votes after which a vehicle has half of its final influence on the choice of the main group;
/// bounds the gain of attackers who rejoin under new names.
pub(super) const TENURE_VOTES: f64 = 50.0;

/// Support of a vehicle for itself; without it, the supports of two vehicles that agree against a
/// third would be 0.
pub(super) const SELF_SUPPORT: f64 = 0.01;

/// Number of iterations for the main group, and for the vehicles' factors.
pub(super) const ITERATIONS: u32 = 30;

/// Share of dependent vehicles among the present ones from which they may have decided verdicts.
pub(super) const MANY_DEPENDENT: f64 = 0.2;

/// Memory of slow evidence: number of compared labels after which the cell's shares of labels are
/// halved, and of settled votes over which agreement by confidence fades to 1/e.
pub(super) const LONG_MEMORY: f64 = 10_000.0;

/// Weight, in votes, of the assumed accuracy against the fleet's record.
pub(super) const FLEET_PRIOR_VOTES: f64 = 1.0;

/// Drop in the rate of right votes that is tolerated.
pub(super) const SHORTFALL_SLACK: f64 = 0.2;

/// Cumulative drop beyond it, in votes, that is a change: about seven wrong votes of a vehicle with
/// 80 % right ones.
pub(super) const SHORTFALL_ALARM: f64 = 4.0;

/// Part of a vehicle's past that still counts after a change.
pub(super) const KEPT_AFTER_ALARM: f64 = 0.1;

/// Independent part of a vehicle's statements, because consecutive frames are similar.
pub(super) const INDEPENDENT_FRAMES: f64 = 1.0 / 3.0;

/// Minimum weight of a statement among the vehicle's own statements.
pub(super) const MIN_STATEMENT_WEIGHT: f64 = 0.01;

/// Number of rank bands of a vehicle's confidences.
pub(super) const BANDS: usize = 10;

/// Weight, in votes, of the middle rank against a vehicle's own confidences.
pub(super) const RANK_PRIOR_VOTES: f64 = 5.0;

/// Weight, in votes, of the overall rate of agreement against a band's own.
pub(super) const BAND_PRIOR_VOTES: f64 = 100.0;

/// Spread of pooled bands, in variances of one vote, that is taken for noise: three times the chance
/// spread of ten equal bands, 1/2 + … + 1/10 (Barlow et al. 1972).
pub(super) const BAND_NOISE: f64 = 6.0;

/// Least weight of a vote for its confidence.
pub(super) const MIN_CONFIDENCE_WEIGHT: f64 = 0.1;

/// Greatest weight of a vote for its confidence.
pub(super) const MAX_CONFIDENCE_WEIGHT: f64 = 3.0;
