//! Validation of payloads: every value from outside is checked before it is used.

use std::collections::BTreeMap;
use std::net::SocketAddr;

use minicbor::{Decode, Encode};
use serde::Serialize;
use serde::de::DeserializeOwned;

use super::codec;
use super::{
    CellDescription, CellMap, Encoding, FieldOfView, FusedObject, GlobalMap, LandmarkState,
    LedgerShare, MAX_DISMISSED, MAX_TROUBLE_TEXT, MAX_TROUBLES, NodeStatus, ObjectReport,
    PerceivedObject, PoseCorrection, RejectReason, Reputation, Reputations, SCHEMA_VERSION,
    Trouble, Verdict, Verdicts, WirePose,
};
use crate::model::geometry::{Covariance, TURN_BOUND_RAD};
use crate::model::names::{Label, NodeName, is_label, is_plain_text};
use crate::model::origin::GeographicOrigin;
use crate::model::time::Timestamp;

/// Maximum length of the text of a cell's description in bytes; all vehicles get it with each
/// connection to a broker.
pub const MAX_DESCRIPTION_BYTES: usize = 256 * 1024;

/// Bounds of a payload; one beyond them is not decoded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// Maximum size of a report, status or share in bytes.
    pub payload_bytes: usize,
    /// Maximum size of a map, verdicts or reputations in bytes; they grow with the cell.
    pub map_bytes: usize,
    /// Maximum number of objects, and of seen landmarks, in one report.
    pub objects: usize,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            payload_bytes: 256 * 1024,
            map_bytes: 8 * 1024 * 1024,
            objects: 1024,
        }
    }
}

/// Largest epoch, round, count or time: every JSON reader keeps integers up to 2⁵³ − 1 exact (RFC
/// 8259, section 6).
pub const MAX_INTEGER: u64 = (1 << 53) - 1;

/// Maximum lead in seconds of a round's time of fusion over the receiver's clock. Maps do not need
/// synchronised clocks; this only rejects rounds that would look fresh for hours.
pub const MAX_FUSED_AHEAD_S: u64 = 3600;

/// Maximum length of a certificate or signature in base64, in bytes.
const MAX_TEXT: usize = 4096;

/// Maximum number of counts, and of marks, in one share: it stays below the default of
/// [`Limits::payload_bytes`].
pub const MAX_SHARE_ENTRIES: usize = 512;

/// Largest coordinate of a position on Earth in metres.
const WORLD_BOUND_M: f64 = 1e8;

/// Fastest object in metres per second.
const SPEED_BOUND_MPS: f64 = 1e4;

/// Largest size of an object and largest range of a sensor in metres. A number of 11 significant
/// bits: the compact encoding rounds no smaller size beyond it.
const SIZE_BOUND_M: f64 = 102_400.0;

/// Largest variance of a position in m²: far more than the square of [`WORLD_BOUND_M`], and little
/// enough for sums and products of covariances to stay finite. A power of two, 7.4e19, which no
/// encoding rounds up.
const VARIANCE_BOUND_M2: f64 = (1u128 << 66) as f64;

/// Largest age in seconds and largest number of pairs of detections; a power of two, which no
/// encoding rounds up.
const COUNT_BOUND: f64 = (1u64 << 52) as f64;

/// Maximum yaw rate of a frame, far above any vehicle's yaw rate.
const YAW_RATE_BOUND_RADPS: f64 = 100.0;

/// Maximum number of classes with scores of one object.
const MAX_SCORES: usize = 256;

/// Largest score of a label: far more than the votes of all vehicles of a cell.
const SCORE_BOUND: f64 = 1e9;

/// A message on a topic, with a version of its schema.
pub trait Payload: Serialize + DeserializeOwned + Encode<()> + for<'b> Decode<'b, ()> {
    /// Major version that the payload states.
    fn schema(&self) -> u32;

    /// The payload in an encoding. Unlike generic code, this is compiled as a part of this crate,
    /// which is optimised for speed, whichever crate calls it; so is [`Self::from_bytes`].
    fn to_bytes(&self, encoding: Encoding) -> Vec<u8>;

    /// Reads the payload in any encoding, without checks of its values.
    ///
    /// # Errors
    /// The reason for which it cannot be read.
    fn from_bytes(bytes: &[u8]) -> Result<Self, RejectReason>;

    /// Maximum size in bytes.
    fn max_bytes(limits: &Limits) -> usize {
        limits.payload_bytes
    }

    /// Removes the entries with invalid values, and returns the removed entries. One bad entry of a
    /// map, of verdicts or of reputations does not affect the other entries.
    fn remove_invalid(&mut self) -> Vec<InvalidEntry> {
        Vec::new()
    }

    /// Checks every value outside of the entries that [`Self::remove_invalid`] checks.
    ///
    /// # Errors
    /// The first reason found.
    fn check(&self, _limits: &Limits) -> Result<(), RejectReason> {
        Ok(())
    }
}

/// An entry of a map, of verdicts or of reputations that is not valid.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct InvalidEntry {
    /// The reason for which receivers do not use it.
    pub reason: RejectReason,
    /// The nodes whose statements are in the entry.
    pub contributors: Vec<NodeName>,
}

macro_rules! payloads {
    ($($type:ty: at most $max_bytes:ident, checked by $check:path $(, entries by $remove_invalid:path)?;)*) => {
        $(impl Payload for $type {
            fn schema(&self) -> u32 {
                self.schema
            }

            fn to_bytes(&self, encoding: Encoding) -> Vec<u8> {
                codec::write(self, encoding)
            }

            fn from_bytes(bytes: &[u8]) -> Result<Self, RejectReason> {
                codec::read(bytes)
            }

            fn max_bytes(limits: &Limits) -> usize {
                limits.$max_bytes
            }

            $(fn remove_invalid(&mut self) -> Vec<InvalidEntry> {
                $remove_invalid(self)
            })?

            fn check(&self, limits: &Limits) -> Result<(), RejectReason> {
                $check(self, limits)
            }
        })*
    };
}

payloads! {
    ObjectReport: at most payload_bytes, checked by ObjectReport::validate;
    GlobalMap: at most map_bytes, checked by check_map, entries by invalid_of_map;
    CellMap: at most map_bytes, checked by check_cell_map, entries by invalid_of_cell_map;
    Verdicts: at most map_bytes, checked by check_verdicts, entries by invalid_verdicts;
    Reputations: at most map_bytes, checked by check_reputations, entries by invalid_reputations;
    CellDescription: at most map_bytes, checked by check_description;
    LedgerShare: at most payload_bytes, checked by check_share;
    NodeStatus: at most payload_bytes, checked by check_status;
}

/// A value that is not valid.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct InvalidValue {
    /// Path of the value in its payload, as `objects[3].x_m`.
    pub field: String,
    /// The reason for which the payload is rejected.
    pub reason: RejectReason,
}

impl ObjectReport {
    /// Checks version, counts, numbers and labels.
    ///
    /// # Errors
    /// The first reason found.
    pub fn validate(&self, limits: &Limits) -> Result<(), RejectReason> {
        self.check_values(limits).map_err(|invalid| invalid.reason)
    }

    /// Checks as [`Self::validate`] does.
    ///
    /// # Errors
    /// The first value that is not valid.
    pub fn check_values(&self, limits: &Limits) -> Result<(), InvalidValue> {
        let of = |field: &'static str| {
            move |reason| InvalidValue {
                field: field.to_owned(),
                reason,
            }
        };
        if self.schema != SCHEMA_VERSION {
            return Err(of("schema")(RejectReason::UnknownSchema));
        }
        let seen = self.seen.as_deref().unwrap_or_default();
        for (field, count) in [("objects", self.objects.len()), ("seen", seen.len())] {
            if count > limits.objects {
                return Err(of(field)(RejectReason::TooManyObjects));
            }
        }
        self.pose.as_ref().map_or(Ok(()), check_pose)?;
        if let Some(FieldOfView { range_m, angle_rad }) = self.view {
            check_between(range_m, 0.0, SIZE_BOUND_M).map_err(of("view.range_m"))?;
            check_between(angle_rad, 0.0, TURN_BOUND_RAD).map_err(of("view.angle_rad"))?;
        }
        let check_yaw_rate =
            |rate| check_between(rate, -YAW_RATE_BOUND_RADPS, YAW_RATE_BOUND_RADPS);
        self.frame_yaw_rate_radps
            .map_or(Ok(()), check_yaw_rate)
            .map_err(of("frame_yaw_rate_radps"))?;
        for (index, id) in seen.iter().enumerate() {
            check_labels([&**id]).map_err(|reason| InvalidValue {
                field: format!("seen[{index}]"),
                reason,
            })?;
        }
        for (index, object) in self.objects.iter().enumerate() {
            let in_object = |(field, reason)| InvalidValue {
                field: format!("objects[{index}].{field}"),
                reason,
            };
            object.check_fields().map_err(in_object)?;
        }
        Ok(())
    }
}

/// Checks the pose of a report.
pub(super) fn check_pose(pose: &WirePose) -> Result<(), InvalidValue> {
    let of = |field: &'static str| {
        move |reason| InvalidValue {
            field: field.to_owned(),
            reason,
        }
    };
    check_coordinate(pose.x_m).map_err(of("pose.x_m"))?;
    check_coordinate(pose.y_m).map_err(of("pose.y_m"))?;
    check_between(pose.heading_rad, -TURN_BOUND_RAD, TURN_BOUND_RAD)
        .map_err(of("pose.heading_rad"))?;
    let check = |value: Option<f64>, low, high| {
        value.map_or(Ok(()), |value| check_between(value, low, high))
    };
    check(pose.height_m, 0.0, SIZE_BOUND_M).map_err(of("pose.height_m"))?;
    check(pose.pitch_rad, -TURN_BOUND_RAD, TURN_BOUND_RAD).map_err(of("pose.pitch_rad"))?;
    check(pose.roll_rad, -TURN_BOUND_RAD, TURN_BOUND_RAD).map_err(of("pose.roll_rad"))
}

impl PerceivedObject {
    /// Checks numbers and labels.
    ///
    /// # Errors
    /// The first reason found.
    pub fn validate(&self) -> Result<(), RejectReason> {
        self.check_fields().map_err(|(_, reason)| reason)
    }

    /// Checks as [`Self::validate`] does.
    ///
    /// # Errors
    /// The first field that is not valid.
    pub fn check_fields(&self) -> Result<(), (&'static str, RejectReason)> {
        let of = |field| move |reason| (field, reason);
        check_coordinate(self.x_m).map_err(of("x_m"))?;
        check_coordinate(self.y_m).map_err(of("y_m"))?;
        self.covariance()
            .map_or(Ok(()), check_covariance)
            .map_err(of("covariance_m2"))?;
        check_confidence(self.confidence).map_err(of("confidence"))?;
        check_motion(self.velocity_mps, None, None).map_err(of("velocity_mps"))?;
        check_motion(None, self.heading_rad, None).map_err(of("heading_rad"))?;
        check_motion(None, None, self.size_m).map_err(of("size_m"))?;
        check_scores(&self.scores).map_err(of("scores"))?;
        check_labels([&*self.label]).map_err(of("label"))?;
        check_labels(self.landmark.as_deref()).map_err(of("landmark"))
    }
}

/// Checks that a time of fusion is less than [`MAX_FUSED_AHEAD_S`] ahead.
///
/// # Errors
/// Returns [`RejectReason::FromTheFuture`].
pub fn check_fused_at(fused_at: Timestamp, received_at: Timestamp) -> Result<(), RejectReason> {
    let ahead = fused_at.since(received_at);
    if ahead.as_secs() < MAX_FUSED_AHEAD_S {
        Ok(())
    } else {
        Err(RejectReason::FromTheFuture)
    }
}

fn check_map(map: &GlobalMap, _: &Limits) -> Result<(), RejectReason> {
    let times = [Some(map.fused_at_us), map.oldest_capture_us];
    check_integers(
        [map.epoch, map.round]
            .into_iter()
            .chain(times.into_iter().flatten().map(Timestamp::micros)),
    )
}

fn invalid_of_map(map: &mut GlobalMap) -> Vec<InvalidEntry> {
    let mut invalid = Vec::new();
    remove_entries(
        &mut map.landmarks,
        check_landmark,
        |place| &place.contributors,
        &mut invalid,
    );
    remove_entries(
        &mut map.objects,
        FusedObject::validate,
        |object| &object.contributors,
        &mut invalid,
    );
    remove_entries(
        &mut map.neighbour_objects,
        |neighbour| {
            check_between(neighbour.age_s, 0.0, COUNT_BOUND)?;
            neighbour.object.validate()
        },
        |neighbour| std::slice::from_ref(&neighbour.cell),
        &mut invalid,
    );
    remove_named(&mut map.pose_corrections, check_correction, &mut invalid);
    invalid
}

fn invalid_of_cell_map(message: &mut CellMap) -> Vec<InvalidEntry> {
    invalid_of_map(&mut message.map)
}

fn invalid_verdicts(verdicts: &mut Verdicts) -> Vec<InvalidEntry> {
    let mut invalid = Vec::new();
    remove_entries(
        &mut verdicts.verdicts,
        check_verdict,
        |verdict| &verdict.contributors,
        &mut invalid,
    );
    invalid
}

fn invalid_reputations(reputations: &mut Reputations) -> Vec<InvalidEntry> {
    let mut invalid = Vec::new();
    remove_named(&mut reputations.reputations, check_reputation, &mut invalid);
    invalid
}

/// Removes the entries of a list that `check` refuses, and adds them to `invalid`.
fn remove_entries<T>(
    entries: &mut Vec<T>,
    check: impl Fn(&T) -> Result<(), RejectReason>,
    contributors: impl Fn(&T) -> &[NodeName],
    invalid: &mut Vec<InvalidEntry>,
) {
    entries.retain(|entry| match check(entry) {
        Ok(()) => true,
        Err(reason) => {
            invalid.push(InvalidEntry {
                reason,
                contributors: contributors(entry).to_vec(),
            });
            false
        }
    });
}

/// Removes the entries by node that `check` refuses, and adds them to `invalid`.
fn remove_named<T>(
    entries: &mut BTreeMap<NodeName, T>,
    check: impl Fn(&T) -> Result<(), RejectReason>,
    invalid: &mut Vec<InvalidEntry>,
) {
    entries.retain(|node, entry| match check(entry) {
        Ok(()) => true,
        Err(reason) => {
            invalid.push(InvalidEntry {
                reason,
                contributors: vec![node.clone()],
            });
            false
        }
    });
}

fn check_cell_map(message: &CellMap, limits: &Limits) -> Result<(), RejectReason> {
    if message.map.schema != SCHEMA_VERSION {
        return Err(RejectReason::UnknownSchema);
    }
    check_integers([message.sent_at_us.micros()])?;
    let GeographicOrigin {
        latitude_deg,
        longitude_deg,
        height_m,
        rotation_deg,
    } = message.origin;
    for number in [latitude_deg, longitude_deg, height_m, rotation_deg] {
        check_between(number, f64::MIN, f64::MAX)?;
    }
    message
        .origin
        .validate()
        .map_err(|_| RejectReason::OutOfRange)?;
    check_map(&message.map, limits)
}

fn check_verdicts(verdicts: &Verdicts, _: &Limits) -> Result<(), RejectReason> {
    check_integers([
        verdicts.epoch,
        verdicts.round,
        verdicts.fused_at_us.micros(),
    ])
}

fn check_reputations(reputations: &Reputations, _: &Limits) -> Result<(), RejectReason> {
    check_integers([reputations.epoch, reputations.round])
}

fn check_reputation(reputation: &Reputation) -> Result<(), RejectReason> {
    check_integers([reputation.correct, reputation.incorrect])?;
    check_between(reputation.score, 0.0, 1.0)
}

fn check_share(share: &LedgerShare, _: &Limits) -> Result<(), RejectReason> {
    if share.entries.len() > MAX_SHARE_ENTRIES || share.marks.len() > MAX_SHARE_ENTRIES {
        return Err(RejectReason::TooManyObjects);
    }
    if share
        .signed
        .as_ref()
        .is_some_and(|signed| signed.certificate.len().max(signed.signature.len()) > MAX_TEXT)
    {
        return Err(RejectReason::TooLarge);
    }
    check_integers(
        share
            .epoch
            .into_iter()
            .chain(share.reset_at_us.map(Timestamp::micros)),
    )?;
    let mut marks = share.marks.iter();
    marks.try_for_each(|mark| {
        check_integers([mark.epoch, mark.number, mark.correct, mark.incorrect])
    })?;
    share.entries.iter().try_for_each(|entry| {
        check_integers([entry.epoch, entry.correct, entry.incorrect])?;
        check_labels([&*entry.label])
    })
}

fn check_status(status: &NodeStatus, _: &Limits) -> Result<(), RejectReason> {
    check_integers([status.epoch])?;
    let described = status.description.as_ref();
    check_integers(described.map(|described| described.version))?;
    if let Some(problem) = described.and_then(|described| described.problem.as_ref()) {
        if problem.len() > MAX_TEXT {
            return Err(RejectReason::TooLarge);
        }
        if problem.contains(char::is_control) {
            return Err(RejectReason::InvalidLabel);
        }
    }
    if status.troubles.len() > MAX_TROUBLES || status.dismissed.len() > MAX_DISMISSED {
        return Err(RejectReason::TooManyObjects);
    }
    status.troubles.iter().try_for_each(check_trouble)?;
    if status
        .page
        .as_ref()
        .is_some_and(|page| page.parse::<SocketAddr>().is_err())
    {
        return Err(RejectReason::InvalidLabel);
    }
    check_labels([&*status.version])
}

fn check_trouble(trouble: &Trouble) -> Result<(), RejectReason> {
    let texts = [&trouble.cause, &trouble.remedy];
    if texts.iter().any(|text| text.len() > MAX_TROUBLE_TEXT) {
        return Err(RejectReason::TooLarge);
    }
    if !texts.iter().all(|text| is_plain_text(text)) {
        return Err(RejectReason::InvalidLabel);
    }
    check_labels([&*trouble.kind].into_iter().chain(trouble.about.as_deref()))
}

fn check_description(description: &CellDescription, _: &Limits) -> Result<(), RejectReason> {
    if description.text.len() > MAX_DESCRIPTION_BYTES {
        return Err(RejectReason::TooLarge);
    }
    check_integers([description.version])
}

fn check_landmark(state: &LandmarkState) -> Result<(), RejectReason> {
    check_place(state.x_m, state.y_m)?;
    check_confidence(state.confidence)?;
    let read = state.readings.iter().map(|reading| &*reading.label);
    check_labels(
        [&*state.id]
            .into_iter()
            .chain(state.label.as_deref())
            .chain(read),
    )
}

impl FusedObject {
    /// Checks numbers and labels.
    ///
    /// # Errors
    /// The first reason found.
    pub fn validate(&self) -> Result<(), RejectReason> {
        check_place(self.x_m, self.y_m)?;
        check_covariance(self.covariance())?;
        check_confidence(self.confidence)?;
        self.existence.map_or(Ok(()), check_confidence)?;
        check_motion(self.velocity_mps, self.heading_rad, self.size_m)?;
        check_scores(&self.scores)?;
        self.age_s
            .map_or(Ok(()), |age_s| check_between(age_s, 0.0, COUNT_BOUND))?;
        check_integers(self.first_seen_us.map(Timestamp::micros))?;
        check_labels([&*self.label])
    }
}

fn check_correction(correction: &PoseCorrection) -> Result<(), RejectReason> {
    let [x_m, y_m] = correction.about_m;
    check_place(x_m, y_m)?;
    check_place(correction.dx_m, correction.dy_m)?;
    check_between(correction.dheading_rad, -TURN_BOUND_RAD, TURN_BOUND_RAD)?;
    check_between(correction.pairs, 0.0, COUNT_BOUND)
}

fn check_motion(
    velocity_mps: Option<[f64; 2]>,
    heading_rad: Option<f64>,
    size_m: Option<[f64; 2]>,
) -> Result<(), RejectReason> {
    let mut speeds = velocity_mps.into_iter().flatten();
    speeds.try_for_each(|speed| check_between(speed, -SPEED_BOUND_MPS, SPEED_BOUND_MPS))?;
    heading_rad.map_or(Ok(()), |heading| {
        check_between(heading, -TURN_BOUND_RAD, TURN_BOUND_RAD)
    })?;
    size_m
        .into_iter()
        .flatten()
        .try_for_each(|size| check_between(size, 0.0, SIZE_BOUND_M))
}

fn check_scores(scores: &BTreeMap<Label, f64>) -> Result<(), RejectReason> {
    if scores.len() > MAX_SCORES {
        return Err(RejectReason::TooManyObjects);
    }
    scores.values().copied().try_for_each(check_confidence)?;
    check_labels(scores.keys().map(|label| &**label))
}

pub(super) fn check_between(value: f64, low: f64, high: f64) -> Result<(), RejectReason> {
    match value {
        _ if (low..=high).contains(&value) => Ok(()),
        _ if value.is_finite() => Err(RejectReason::OutOfRange),
        _ => Err(RejectReason::NotFinite),
    }
}

fn check_verdict(verdict: &Verdict) -> Result<(), RejectReason> {
    let mut scores = [verdict.score]
        .into_iter()
        .chain(verdict.votes.values().copied());
    scores.try_for_each(|score| check_between(score, -SCORE_BOUND, SCORE_BOUND))?;
    check_between(verdict.margin, 0.0, SCORE_BOUND)?;
    let labels = verdict.votes.keys().chain(&verdict.label);
    check_labels(
        [&*verdict.landmark]
            .into_iter()
            .chain(labels.map(|label| &**label)),
    )
}

fn check_place(x_m: f64, y_m: f64) -> Result<(), RejectReason> {
    check_coordinate(x_m)?;
    check_coordinate(y_m)
}

fn check_coordinate(coordinate_m: f64) -> Result<(), RejectReason> {
    if coordinate_m.abs() <= WORLD_BOUND_M {
        Ok(())
    } else {
        Err(RejectReason::NotFinite)
    }
}

fn check_covariance(covariance: Covariance) -> Result<(), RejectReason> {
    if covariance.is_valid() && covariance.xx.max(covariance.yy) <= VARIANCE_BOUND_M2 {
        Ok(())
    } else {
        Err(RejectReason::NotFinite)
    }
}

pub(super) fn check_confidence(confidence: f64) -> Result<(), RejectReason> {
    match confidence {
        0.0..=1.0 => Ok(()),
        _ if confidence.is_finite() => Err(RejectReason::ConfidenceOutOfRange),
        _ => Err(RejectReason::NotFinite),
    }
}

pub(super) fn check_labels<'a>(
    labels: impl IntoIterator<Item = &'a str>,
) -> Result<(), RejectReason> {
    if labels.into_iter().all(is_label) {
        Ok(())
    } else {
        Err(RejectReason::InvalidLabel)
    }
}

fn check_integers(values: impl IntoIterator<Item = u64>) -> Result<(), RejectReason> {
    if values.into_iter().all(|value| value <= MAX_INTEGER) {
        Ok(())
    } else {
        Err(RejectReason::OutOfRange)
    }
}

#[cfg(test)]
mod tests;
