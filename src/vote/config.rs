//! Settings of VOTE.

use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::config::{ConfigError, check_range, config_section};
use crate::model::names::Label;
use crate::perception::landmark::check_synonyms;

/// Maximum number of labels of a cell.
pub const MAX_LABELS: usize = 65_535;

/// The method by which votes decide the label of a landmark.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum VoteMode {
    /// Estimated reputation × calibrated confidence × visibility; the default.
    #[default]
    Weighted,
    /// The paper's formulas without changes.
    Paper,
}

/// Settings of VOTE; an absent key has its default.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct VoteConfig {
    /// The voting method; default `weighted`.
    pub mode: VoteMode,
    /// Settings of `paper` mode.
    pub paper: PaperConfig,
    /// Settings of `weighted` mode.
    pub weighted: WeightedConfig,
    /// Maximum number of landmarks. Default 1024. Beyond it an open cell drops the oldest landmark
    /// of the vehicle that named most. Bounds memory.
    pub max_landmarks: usize,
    /// Maximum number of vehicles. Beyond it vehicles that have been silent for long are dropped;
    /// if there are none, reports of new vehicles are rejected. Default 256. Bounds memory.
    pub max_vehicles: usize,
    /// Maximum number of distinct labels in the cell or, in `paper` mode, of a landmark.
    /// Default 256. Bounds memory. Beyond it the least useful labels are dropped, beginning with
    /// labels of the vehicle that introduced most. In `paper` mode, whose sums are permanent, votes
    /// for new labels are ignored.
    pub max_labels: usize,
    /// Labels that count as another one everywhere, such as `vase = "sports ball"`. Default: no
    /// synonyms. A landmark's own synonyms have precedence.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub synonyms: BTreeMap<Label, Label>,
}

impl Default for VoteConfig {
    fn default() -> Self {
        Self {
            mode: VoteMode::Weighted,
            paper: PaperConfig::default(),
            weighted: WeightedConfig::default(),
            max_landmarks: 1024,
            max_vehicles: 256,
            max_labels: 256,
            synonyms: BTreeMap::new(),
        }
    }
}

impl VoteConfig {
    /// Checks every value.
    ///
    /// # Errors
    /// Returns a [`ConfigError`] that names the first value out of range.
    pub fn validate(&self) -> Result<(), ConfigError> {
        check_range("max_landmarks", self.max_landmarks as f64, 1.0, 1e6)?;
        check_range("max_vehicles", self.max_vehicles as f64, 1.0, 1e5)?;
        check_range("max_labels", self.max_labels as f64, 1.0, MAX_LABELS as f64)?;
        check_synonyms(&self.synonyms)?;
        self.paper.validate().map_err(|e| e.within("paper"))?;
        self.weighted.validate().map_err(|e| e.within("weighted"))
    }
}

config_section! {
    /// Settings of `paper` mode.
    pub struct PaperConfig {
        /// Distance d_max in metres beyond which a vote is ignored; default 2.54, the 100 in of the
        /// paper's testbed.
        pub max_range_m: f64 = 2.54, in 1e-3 to 1e6;
        /// Weight p_d of distance against angle, 0 to 1; default 0.7.
        pub distance_weight: f64 = 0.7, in 0.0 to 1.0;
        /// Reputation r_v at the start; default 0.5.
        pub initial_reputation: f64 = 0.5, in 0.3 to 1.0;
        /// Change of r_v after a verdict in which every vote was right; default 0.01.
        pub step: f64 = 0.01, in 0.0 to 1.0;
        /// Frames of a vehicle between verdicts; default 5. A round closes when any vehicle has
        /// sent this many.
        pub frames_per_verdict: u32 = 5, in 1.0 to 1e6;
    }
}

config_section! {
    /// Settings of `weighted` mode. Weights in votes are pseudo-counts: the number of votes that
    /// outweighs an assumption.
    pub struct WeightedConfig {
        /// Time in seconds for which a vote counts; default 2. A longer time bridges gaps, a
        /// shorter time follows changes. A vehicle adds to the evidence about a landmark once in
        /// this time, independent of its publishing rate.
        pub freshness_s: f64 = 2.0, in 1e-3 to 1e12;
        /// Part of `freshness_s` in which a vehicle's statement on a landmark fades to 1/e in its
        /// current vote; default 0.5. A higher value suppresses more single frames with a wrong
        /// label, but notices a new object later. With 0 only the last statement counts, for inputs
        /// in which a new statement corrects the earlier one.
        pub smoothing_share: f64 = 0.5, in 0.0 to 10.0;
        /// Weight, in votes, of a vehicle's accuracy on all classes against its own record of one
        /// class; default 5. A lower value adapts to classes faster, but also to noise.
        pub class_prior_votes: f64 = 5.0, in 1e-3 to 1e6;
        /// Weight, in votes, of the fleet's reliability against the vehicle's own; default 8.
        pub vehicle_prior_votes: f64 = 8.0, in 1e-3 to 1e6;
        /// Assumed rate of right votes of a vehicle without evidence, 0.5 to 1; default 0.7.
        pub assumed_accuracy: f64 = 0.7, in 0.5 to 0.999;
        /// Maximum weight of the shares of the classes, in verdicts; default 50. A higher value
        /// favours frequent labels.
        pub class_share_verdicts: f64 = 50.0, in 2.0 to 1e9;
        /// Votes over which the memory of a vehicle fades to 1/e; default 500. A lower value
        /// notices a change of behaviour sooner.
        pub memory_votes: f64 = 500.0, in 1.0 to 1e9;
        /// Comparisons over which the memory of two vehicles' agreement fades to 1/e; default 100.
        /// A lower value notices sooner that vehicles begin to copy each other, a higher one finds
        /// weaker dependence.
        pub pair_memory_votes: f64 = 100.0, in 2.0 to 1e9;
        /// Votes until a vehicle counts as proven; default 10.
        pub probation_votes: f64 = 10.0, in 0.0 to 1e6;
        /// Maximum weight of all newcomers at a landmark, as a multiple of the proven vehicles';
        /// default 0.5. Bounds the gain of an attacker who rejoins under new names; a higher value
        /// lets newcomers have influence sooner.
        pub newcomer_share: f64 = 0.5, in 0.0 to 1e9;
        /// Probability by which a label must lead the published label to replace it; default 0.1. A
        /// higher value flickers less and reacts later.
        pub hysteresis: f64 = 0.1, in 0.0 to 0.99;
        /// Distance in metres beyond which a vote is ignored; default 50. Set it to the reliable
        /// range of the detector.
        pub max_range_m: f64 = 50.0, in 1e-3 to 1e6;
        /// Angle off the camera's axis in radians at which visibility has halved; default 0.8.
        pub half_visibility_rad: f64 = 0.8, in 1e-3 to 10.0;
        /// Visibility at the maximum range, 0 to 1; default 0.3. In between it falls with the
        /// square of the distance.
        pub visibility_at_max_range: f64 = 0.3, in 1e-3 to 1.0;
        /// Votes on older landmarks that are re-evaluated per fresh vote; default 8. A higher value
        /// settles sooner and costs more.
        pub revisit_votes: f64 = 8.0, in 0.0 to 1e6;
        /// Weight, in votes, of stated confidences against calibrated ones; default 10. A higher
        /// value uses stated confidences for longer.
        pub calibration_votes: f64 = 10.0, in 1e-3 to 1e9;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn synonyms_round_trip_and_need_labels() {
        let config: VoteConfig = toml::from_str("synonyms = { vase = \"sports ball\" }").unwrap();
        assert_eq!(config.synonyms["vase"], "sports ball");
        assert_eq!(config.validate(), Ok(()));
        assert_eq!(
            toml::from_str::<VoteConfig>(&toml::to_string(&config).unwrap()),
            Ok(config)
        );
        let nameless = VoteConfig {
            synonyms: [("vase".into(), "".into())].into(),
            ..VoteConfig::default()
        };
        assert!(
            nameless
                .validate()
                .unwrap_err()
                .to_string()
                .contains("synonyms")
        );
    }
}
