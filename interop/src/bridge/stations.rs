//! Places for other stations, shared fairly among their receivers.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use ecod_client::NodeName;

use super::CpmRefusal;

/// Maximum number of other stations at a time. A node has room for 16 parts.
pub(super) const MAX_OTHER_STATIONS: usize = 12;

/// Silence after which a station's place may go to another station.
const STATION_RETENTION: Duration = Duration::from_secs(10);

/// Time between two reports of all stations together. The node's local broker accepts 50 reports a
/// second from all its programs, and a vehicle's own detector needs most of them.
const REPORT_INTERVAL: Duration = Duration::from_millis(50);

/// The active stations, by number.
#[derive(Debug, Default)]
pub(super) struct StationPlaces(BTreeMap<u32, StationPlace>);

#[derive(Debug)]
struct StationPlace {
    /// The receiver that first delivered the station, as long as it continues to do so.
    receiver: NodeName,
    heard_at: Instant,
    /// When its next report is due.
    due_at: Instant,
}

impl StationPlaces {
    /// Gives a station a place. If there is none left, a station of the receiver with most stations
    /// is removed.
    pub(super) fn enter(
        &mut self,
        number: u32,
        receiver: &NodeName,
        now: Instant,
    ) -> Result<(), CpmRefusal> {
        self.0
            .retain(|_, place| now.saturating_duration_since(place.heard_at) < STATION_RETENTION);
        if let Some(place) = self.0.get_mut(&number) {
            if place.receiver != *receiver {
                return Err(CpmRefusal::OtherReceiver);
            }
            place.heard_at = now;
            return Ok(());
        }
        if self.0.len() >= MAX_OTHER_STATIONS {
            let counts = self.counts();
            let own = counts.get(receiver).copied().unwrap_or_default();
            let most = counts
                .into_iter()
                .max_by_key(|(_, count)| *count)
                .filter(|(_, count)| *count > own + 1);
            let of_most = most.and_then(|(most, _)| {
                let places = self.0.iter().filter(|(_, place)| place.receiver == *most);
                places
                    .min_by_key(|(_, place)| place.heard_at)
                    .map(|(number, _)| *number)
            });
            self.0.remove(&of_most.ok_or(CpmRefusal::TooManyStations)?);
        }
        self.0.insert(
            number,
            StationPlace {
                receiver: receiver.clone(),
                heard_at: now,
                due_at: now,
            },
        );
        Ok(())
    }

    /// Returns false if there is no room for a report of the station now. If a report comes
    /// slightly early, the station's next report is due later.
    pub(super) fn reserve_room(&mut self, number: u32, now: Instant) -> bool {
        let counts = self.counts();
        let receivers = counts.len();
        let of_receiver = self
            .0
            .get(&number)
            .and_then(|place| counts.get(&place.receiver))
            .copied()
            .unwrap_or(1);
        let Some(place) = self.0.get_mut(&number) else {
            return false;
        };
        let interval = REPORT_INTERVAL * (receivers * of_receiver) as u32;
        let has_room = place.due_at.saturating_duration_since(now) <= interval / 2;
        if has_room {
            place.due_at = place.due_at.max(now) + interval;
        }
        has_room
    }

    pub(super) fn has(&self, number: u32) -> bool {
        self.0.contains_key(&number)
    }

    /// Number of stations of each receiver.
    fn counts(&self) -> BTreeMap<&NodeName, usize> {
        let mut counts = BTreeMap::new();
        for place in self.0.values() {
            *counts.entry(&place.receiver).or_default() += 1;
        }
        counts
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;

    const EVIL: NodeName = NodeName::from_static("evil");
    const HONEST: NodeName = NodeName::from_static("honest");

    #[test]
    fn receiver_leaves_share_for_others() {
        let mut places = StationPlaces::default();
        let start = Instant::now();
        for number in 0..12 {
            places.enter(number, &EVIL, start).unwrap();
        }
        assert_eq!(
            places.enter(12, &EVIL, start),
            Err(CpmRefusal::TooManyStations)
        );
        for number in 20..26 {
            places.enter(number, &HONEST, start).unwrap();
        }
        assert_eq!(
            places.enter(26, &HONEST, start),
            Err(CpmRefusal::TooManyStations),
            "half of the places are its share"
        );
        let later = start + STATION_RETENTION;
        assert_eq!(
            places.enter(12, &EVIL, later),
            Ok(()),
            "silent stations are evicted"
        );
    }

    #[test]
    fn station_belongs_to_its_receiver() {
        let mut places = StationPlaces::default();
        let start = Instant::now();
        places.enter(7, &HONEST, start).unwrap();
        assert_eq!(
            places.enter(7, &EVIL, start),
            Err(CpmRefusal::OtherReceiver)
        );
        assert_eq!(places.enter(7, &EVIL, start + STATION_RETENTION), Ok(()));
    }

    #[test]
    fn uneven_times_keep_station_share() {
        let start = Instant::now();
        let taken = |period_ms: u64, others: u32, of: &NodeName| {
            let mut places = StationPlaces::default();
            places.enter(7, &HONEST, start).unwrap();
            for number in 100..100 + others {
                places.enter(number, of, start).unwrap();
            }
            let times =
                (0..100).map(|n| start + Duration::from_millis(n * period_ms + 30 * (n % 2)));
            times.filter(|time| places.reserve_room(7, *time)).count()
        };
        assert_eq!(taken(100, 1, &HONEST), 100);
        assert!(
            (50..=52).contains(&taken(50, 1, &HONEST)),
            "{}",
            taken(50, 1, &HONEST)
        );
        assert_eq!(
            taken(100, 11, &EVIL),
            100,
            "whatever another receiver brings"
        );
    }
}
