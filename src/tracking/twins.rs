//! Twins: two tracks of one object.
//!
//! Two tracks that are near each other are two objects if a vehicle detects both in one frame. They are one object if
//! some vehicles detect only the first track and others only the second, because a vehicle would detect both of two
//! objects. The log-likelihood ratio is summed over observations: a sequential probability ratio test (Wald, 1945).

use std::time::Duration;

use smallvec::SmallVec;
use uuid::Uuid;

use super::detection_history::DetectionHistory;
use super::existence::SensorHistory;
use crate::model::time::Timestamp;

/// Two tracks are merged from these log-odds on. The sum is bounded below at -2 times this value.
const TWIN_NATS: f64 = 5.0;

/// Probability that a detector reports one object twice in a frame.
const DUPLICATE: f64 = 0.05;

/// Time for which a pair is kept after its tracks were near each other.
const REMEMBERED: Duration = Duration::from_secs(3);

/// Tracks near one track, with the log-odds that they are duplicates.
#[derive(Debug, Clone, Default)]
pub(super) struct Twins(SmallVec<[Twin; 1]>);

#[derive(Debug, Clone)]
struct Twin {
    id: Uuid,
    /// Log-odds that both are one object.
    nats: f64,
    /// Time of the latest observations that were added.
    at: Timestamp,
}

impl Twins {
    /// Adds the observations of both tracks since the last call. `rate` is the probability that a vehicle detects a
    /// track in a frame.
    pub(super) fn weigh(
        &mut self,
        own: &DetectionHistory,
        other: &DetectionHistory,
        other_id: Uuid,
        now: Timestamp,
        rate: impl Fn(&SensorHistory) -> f64,
    ) {
        self.0.retain(|twin| now.since(twin.at) <= REMEMBERED);
        let known = self.0.iter().position(|twin| twin.id == other_id);
        let since = known.map_or(Timestamp::default(), |known| self.0[known].at);
        let mut nats = 0.0;
        let mut is_own_alone = false;
        let mut is_other_alone = false;
        let mut at = since;
        for own_history in own.iter() {
            let Some(theirs) = other.get(own_history.sensor) else {
                continue;
            };
            let is_new =
                own_history.observed_at > since && own_history.observed_at == theirs.observed_at;
            let [is_own, is_other] =
                [own_history, theirs].map(|history| history.last_hit == Some(history.observed_at));
            if !is_new || !(is_own || is_other) {
                continue;
            }
            at = at.max(own_history.observed_at);
            let rate = rate(own_history);
            if is_own && is_other {
                nats -= (rate / DUPLICATE).ln().max(0.0);
            } else {
                nats += (-(2.0 * (1.0 - rate)).ln()).max(0.0);
                is_own_alone |= is_own;
                is_other_alone |= is_other;
            }
        }
        if nats > 0.0 && !(is_own_alone && is_other_alone) {
            nats = 0.0;
        }
        match known {
            Some(known) => {
                let twin = &mut self.0[known];
                twin.nats = (twin.nats + nats).max(-2.0 * TWIN_NATS);
                twin.at = at;
            }
            None if nats != 0.0 => self.0.push(Twin {
                id: other_id,
                nats,
                at,
            }),
            None => {}
        }
    }

    /// True if the track with this identity is a duplicate.
    pub(super) fn is_twin(&self, id: Uuid) -> bool {
        self.0
            .iter()
            .any(|twin| twin.id == id && twin.nats > TWIN_NATS)
    }
}
