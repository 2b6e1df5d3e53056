//! Every constant of VOTE in one table. Settings that a cell may change are in [`WeightedConfig`](super::WeightedConfig).
//!
//! *Source*: M is measured on label sets or generated cells, T is a textbook value, C bounds cost. The last column says
//! what half and double the value do.
//!
//! | constant | unit | meaning | source | half, double |
//! |---|---|---|---|---|
//! | [`FLEET_PRIOR_SHARE`] | share | weight of one accuracy for all classes against the fleet's record of a class, as a share of all votes | M | a rare class learns from fewer votes; from more |
//! | [`MIN_SAVING`] | nats a vote | log loss that accuracies by class must save over one accuracy | M | more sets use classes; fewer do |
//! | [`SAVING_PRIOR_VOTES`] | votes | weight of a saving of 0 against the measured saving | M | small cells use classes sooner; later |
//! | [`CONVICTION`] | ratio of odds | odds of another label from which a vote settles as wrong, against those that one newcomer alone gives it: just more | T, two witnesses that agree | one witness is enough; two are not |
//! | [`MIN_PROVEN`] | vehicles | proven vehicles at a landmark from which their records count as witnesses': each has two others | T, two witnesses that agree | one proven vehicle judges another; newcomers count like proven vehicles for longer |
//! | [`NEGLIGIBLE`] | probability | labels of less probability add no evidence | C | slower; coarser |
//! | [`SHORTFALL_SLACK`] | share | drop in the rate of right votes that Page's test tolerates | T | more false alarms; smaller drops pass |
//! | [`SHORTFALL_ALARM`] | votes | cumulative drop that is a change | T | alarm after 4 wrong votes; after 13 |
//! | [`KEPT_AFTER_ALARM`] | share | part of a vehicle's past that counts after a change | M | the past is gone; it delays the new record |
//! | [`FIT_GROWTH`] | share | new votes, as a share of the stored ones, after which all are fitted again | C | twice the cost; old verdicts improve later |
//! | [`MIN_FIT_VOTES`] | votes | least number of new votes before a fit | C | small cells fit more often; less often |
//! | [`FIT_PASSES`] | passes | passes of an online fit | C | fits may stop early; no change |
//! | [`CONVERGED`] | probability | mean change of a landmark's probabilities that ends a fit | C | more passes; fewer |
//! | [`MANY_VOTES`] | votes | stored votes beyond which one pass replaces a fit, and of which so many are predicted | C | structure is chosen from fewer votes; cost |
//! | [`CORRELATIONS`] | correlation | candidates for the correlation of votes on one item | T, Kish | |
//! | [`DEVIATIONS`] | standard deviations | agreement beyond the explained one that makes a pair dependent | T, 1 in 3 million | good vehicles pass for copies; copies pass longer |
//! | [`MAX_COMPARED`] | votes | votes with which one vote is compared online | C | copies are found later; cost grows |
//! | [`MAX_COMPARED_STORED`] | votes | votes with which one vote is compared in passes | C | as above |
//! | [`SAME_GROUP`] | kappa | agreement that surely makes one group | M | loose groups count; close ones count more |
//! | [`PRIOR_COMPARISONS`] | comparisons | weight of "no agreement" for a pair | M | copies are found sooner; later |
//! | [`TENURE_VOTES`] | votes | votes that give half of the influence on the main group | M | newcomers decide sooner; later |
//! | [`FACTOR_STEPS`] | steps | iterations of the main group and of the factor model | C | coarser; no change |
//! | [`SHARES_MEMORY`] | comparisons | after these the counts of stated labels are halved | C | follows the labels faster; slower |
//! | [`BANDS`] | | bands of a confidence's rank | T, deciles | coarser weights; noisier ones |
//! | [`BINS`] | | bins of a vehicle's confidences | C | coarser ranks; finer ones |
//! | [`RANK_PRIOR_VOTES`] | votes | weight of the middle rank | M | first ranks are noisier; slower |
//! | [`BAND_PRIOR_VOTES`] | votes | weight of the overall agreement against a band's own | M | noisier weights; slower ones |
//! | [`NOISE`] | variances of a vote | spread of pooled bands that is taken for chance | T, Barlow | chance passes for information; the reverse |
//! | [`CONFIDENCE_MEMORY`] | votes | votes over which a band's agreement fades to 1/e | M | follows a new detector faster; slower |
//! | [`WEIGHT_RANGE`] | | least and greatest weight of a confidence | M | |
//! | [`INDEPENDENT_FRAMES`] | share | independent part of a vehicle's statements | M | wavering vehicles weigh less; more |
//! | [`NORMAL_TO_LOGISTIC`] | | tanh(0.8 z) is the two-sided normal probability of z within 0.02 | T | |
//! | [`MIN_WEIGHT`] | | least weight of a statement among the vehicle's own | C | |
//! | [`SUPPORTED_VOTES`] | votes | right votes from which a label is evicted last | M | |
//! | [`EVICTION_DIVISOR`] | | inverse share of vehicles or labels that is evicted at once | C | larger steps; smaller ones |
//! | [`MAX_OVERTAKEN`] | 3 s | step back of a report's time that is an overtaken report; more is a clock set back | C | |
//! | [`RETENTION`] | 10 s, 600 s | silence after which an unproven or a proven vehicle may be evicted | C | |

use std::time::Duration;

pub(super) const FLEET_PRIOR_SHARE: f64 = 0.05;
pub(super) const MIN_SAVING: f64 = 0.02;
pub(super) const SAVING_PRIOR_VOTES: f64 = 500.0;
pub(super) const CONVICTION: f64 = 1.025;
pub(super) const MIN_PROVEN: usize = 3;
pub(super) const NEGLIGIBLE: f64 = 1e-4;
pub(super) const SHORTFALL_SLACK: f64 = 0.2;
pub(super) const SHORTFALL_ALARM: f64 = 4.0;
pub(super) const KEPT_AFTER_ALARM: f64 = 0.1;
pub(super) const FIT_GROWTH: f64 = 0.25;
pub(super) const MIN_FIT_VOTES: usize = 8;
pub(super) const FIT_PASSES: u32 = 16;
pub(super) const CONVERGED: f64 = 1e-3;
pub(super) const MANY_VOTES: usize = 20_000;
pub(super) const CORRELATIONS: [f64; 6] = [0.0, 0.02, 0.05, 0.1, 0.2, 0.4];
pub(super) const DEVIATIONS: f64 = 5.0;
pub(super) const MAX_COMPARED: usize = 8;
pub(super) const MAX_COMPARED_STORED: usize = 32;
pub(super) const SAME_GROUP: f64 = 0.3;
pub(super) const PRIOR_COMPARISONS: f64 = 10.0;
pub(super) const TENURE_VOTES: f64 = 50.0;
pub(super) const FACTOR_STEPS: u32 = 15;
pub(super) const SHARES_MEMORY: f64 = 10_000.0;
pub(super) const BANDS: usize = 10;
pub(super) const BINS: usize = 20;
pub(super) const RANK_PRIOR_VOTES: f64 = 5.0;
pub(super) const BAND_PRIOR_VOTES: f64 = 100.0;
pub(super) const NOISE: f64 = 6.0;
pub(super) const CONFIDENCE_MEMORY: f64 = 20_000.0;
pub(super) const WEIGHT_RANGE: (f64, f64) = (0.1, 3.0);
pub(super) const INDEPENDENT_FRAMES: f64 = 1.0 / 3.0;
pub(super) const NORMAL_TO_LOGISTIC: f64 = 0.8;
pub(super) const MIN_WEIGHT: f32 = 0.01;
pub(super) const SUPPORTED_VOTES: f64 = 1.0;
pub(super) const EVICTION_DIVISOR: usize = 8;
pub(super) const MAX_OVERTAKEN: Duration = Duration::from_secs(3);
pub(super) const RETENTION: [Duration; 2] = [Duration::from_secs(10), Duration::from_secs(600)];
