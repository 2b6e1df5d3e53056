//! Publishes a cell's maps and reports as collective perception messages, and other stations'
//! messages as reports.
//!
//! ```text
//! global_detections   -> cpm/global  the map, by the station of the node that fused it
//! detections/<node>   -> cpm/<node>  a vehicle's own report
//! cpm/received/<name> -> detections/<node>--cpm-<station>
//! ```

mod sightings;
mod stations;

use std::collections::btree_map::Entry;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant, SystemTime};

use ecod_client::{
    Cell, CpmMessage, Error, Frame, GlobalMap, Label, NodeName, ObjectReport, Settings,
};

use self::sightings::Sightings;
use self::stations::StationPlaces;
use crate::carrying::{Carry, Failures, RefusalCounts, is_within, lock, until_one_ends};
use crate::cpm::{
    self, CpmCell, CpmError, ObjectIds, RECEIVED_PART, ReceivedCpm, Segments, StationIds,
};

/// Level of the map's topic below `cpm`.
const MAP_LEVEL: &str = "global";

/// Maximum difference between a message's time and this machine's. A station uses the time of GNSS,
/// so a larger offset is not an error of its clock.
const MAX_REFERENCE_TIME_DIFFERENCE: Duration = Duration::from_secs(2);

/// Name under which refusals of further receivers are counted when too many are counted separately.
const OTHER_RECEIVERS: &str = "others";

/// Age of the cell's description from which it is requested again.
const DESCRIPTION_AGE: Duration = Duration::from_secs(1);

/// A bridge that runs in addition to a node.
pub struct CpmBridge {
    cell: Cell,
    settings: Settings,
    described: Mutex<(Instant, Arc<CpmCell>)>,
    numbers: Mutex<StationIds>,
    sightings: Mutex<Sightings>,
    refusals: RefusalCounts<(NodeName, CpmRefusal)>,
    failures: Failures,
}

/// The reason why a received message is not reported.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, thiserror::Error)]
pub enum CpmRefusal {
    /// The message is not usable.
    #[error(transparent)]
    Cpm(#[from] CpmError),
    /// It has the station number of a node of this cell: an echo.
    #[error("a station number of this cell")]
    Own,
    /// Its time is wrong: it may be recorded, its time may lack leap seconds, or this machine's
    /// clock may be wrong.
    #[error("a time more than 2 s from this machine's, which 5 s of missing leap seconds are, too")]
    Time,
    /// The station sends more often than other stations and the node itself leave room for.
    #[error("more often than can be reported")]
    TooOften,
    /// Another receiver already delivers this station's messages.
    #[error("a station that another receiver brings")]
    OtherReceiver,
    /// The maximum number of stations was active recently.
    #[error("too many stations")]
    TooManyStations,
    /// The node's broker does not admit the station's part.
    #[error("the part for the station cannot connect")]
    NotConnected,
    /// Its values are not allowed in a report, or the node's broker refuses it.
    #[error("refused as a report")]
    Report,
}

impl CpmBridge {
    /// Connects to a cell.
    ///
    /// # Errors
    /// Returns the errors of [`Cell::connect`], and [`Error::Invalid`] if the cell's description
    /// has no `[origin]`.
    pub fn connect(settings: Settings) -> Result<Self, Error> {
        let invalid = |error: &dyn std::fmt::Display| Error::Invalid(error.to_string());
        let name = NodeName::new(&settings.cell).map_err(|error| invalid(&error))?;
        let cell = Cell::connect(Settings {
            part: "cpm".to_owned(),
            ..settings.clone()
        })?;
        let description = described(&cell)?.ok_or_else(|| {
            Error::Invalid(format!(
                "the description of the cell {name} has no [origin], and a CPM needs a reference position on Earth: add \
                 latitude_deg and longitude_deg (docs/configuration.md#origin) and set it with `ecod-node cell set`"
            ))
        })?;
        let described = Mutex::new((Instant::now(), Arc::new(description)));
        let numbers = Mutex::new(StationIds::new(name));
        let sightings = Mutex::default();
        let refusals = RefusalCounts::default();
        let failures = Failures::default();
        Ok(Self {
            cell,
            settings,
            described,
            numbers,
            sightings,
            refusals,
            failures,
        })
    }

    /// Transfers messages until the connection is closed.
    ///
    /// # Errors
    /// Returns [`Error::Refused`] if the node's broker refuses the bridge.
    ///
    /// # Panics
    /// Panics if one of its threads panicked.
    pub fn run(&self) -> Result<(), Error> {
        let carry: Vec<Carry<'_, Error>> = vec![
            Box::new(|| self.send_maps()),
            Box::new(|| self.send_reports()),
            Box::new(|| self.process_received()),
        ];
        until_one_ends(carry, || self.cell.close())
    }

    /// Ends the connection, and thereby [`CpmBridge::run`].
    pub fn close(&self) {
        self.cell.close();
    }

    /// Number of messages that were not reported, by receiver and reason; beyond 256 such pairs,
    /// the receiver is `others`.
    pub fn refusals(&self) -> BTreeMap<(NodeName, CpmRefusal), u64> {
        self.refusals.counts()
    }

    fn send_maps(&self) -> Result<(), Error> {
        let mut ids = ObjectIds::default();
        for map in self.cell.maps() {
            let map: &GlobalMap = &*map?;
            let number = lock(&self.numbers).of(&map.aggregator, Instant::now());
            let Some(number) = number else { continue };
            let described = self.described();
            let now = Instant::now();
            let sightings = lock(&self.sightings);
            let encoded = cpm::encode_map(map, &described, number, &mut ids, |at| {
                sightings.is_sighted(at, now)
            });
            drop(sightings);
            self.send(MAP_LEVEL, encoded)?;
        }
        Ok(())
    }

    fn send_reports(&self) -> Result<(), Error> {
        for report in self.cell.reports() {
            let report: &ObjectReport = &*report?;
            lock(&self.sightings).observe(report, Instant::now());
            if report.node.as_str() == MAP_LEVEL {
                if self.failures.begins("reports of global") {
                    log::warn!(
                        "no reports of the node {MAP_LEVEL} are sent: cpm/{MAP_LEVEL} is the map's topic"
                    );
                }
                continue;
            }
            let number = (!cpm::is_received(&report.node))
                .then(|| lock(&self.numbers).of(&report.node, Instant::now()))
                .flatten();
            let Some(number) = number else { continue };
            let encoded = cpm::encode_report(report, &self.described(), number);
            self.send(report.node.as_str(), encoded)?;
        }
        Ok(())
    }

    fn send(&self, level: &str, encoded: Result<cpm::EncodedCpm, CpmError>) -> Result<(), Error> {
        match encoded {
            Ok(message) => {
                if message.left_out > 0 {
                    log::debug!("cpm/{level}: no room for {} objects", message.left_out);
                }
                self.failures.ends(level);
                self.cell.publish_cpm(level, message.bytes).map(drop)
            }
            Err(error) => {
                if self.failures.begins(level) {
                    log::warn!("nothing sent on cpm/{level} until it is possible again: {error}");
                }
                Ok(())
            }
        }
    }

    fn process_received(&self) -> Result<(), Error> {
        let mut stations = Stations {
            settings: &self.settings,
            places: StationPlaces::default(),
            connected: BTreeMap::new(),
        };
        for message in self.cell.received_cpms() {
            let message: &CpmMessage = &*message?;
            if let Err(refusal) = self.on_message(&mut stations, message) {
                self.record(&message.receiver, refusal);
            }
        }
        Ok(())
    }

    /// Handles a CPM of a receiver: decodes the message into the cell's frame and reports its objects to
    /// the cell under the station's place. The bridge's own messages are refused, and so are messages
    /// with a reference time too far from the present.
    fn on_message(
        &self,
        stations: &mut Stations<'_>,
        message: &CpmMessage,
    ) -> Result<(), CpmRefusal> {
        let received = cpm::decode(&message.payload, &self.described().origin)?;
        if received.left_out > 0 {
            log::debug!(
                "cpm/received/{}: {} objects without a usable place",
                message.receiver,
                received.left_out
            );
        }
        if lock(&self.numbers).contains(received.station_id, Instant::now()) {
            return Err(CpmRefusal::Own);
        }
        if !is_within(capture_time(&received), MAX_REFERENCE_TIME_DIFFERENCE) {
            return Err(CpmRefusal::Time);
        }
        stations.report(&message.receiver, received)
    }

    /// The cell according to a description that is at most a second old, or the last available one.
    fn described(&self) -> Arc<CpmCell> {
        let mut last = lock(&self.described);
        if last.0.elapsed() > DESCRIPTION_AGE {
            last.0 = Instant::now();
            match described(&self.cell) {
                Ok(Some(present)) => {
                    self.failures.ends("[origin]");
                    last.1 = Arc::new(present);
                }
                Ok(None) if self.failures.begins("[origin]") => {
                    log::warn!("the cell has no [origin] any more; the last one is used");
                }
                Ok(None) => {}
                Err(error) => log::debug!("description: {error}"),
            }
        }
        Arc::clone(&last.1)
    }

    /// Counts a message that was not reported.
    fn record(&self, receiver: &NodeName, refusal: CpmRefusal) {
        let rest = (NodeName::from_static(OTHER_RECEIVERS), refusal);
        if let Some(((receiver, _), count)) =
            self.refusals.record((receiver.clone(), refusal), rest)
        {
            log::warn!("no report from cpm/received/{receiver}: {refusal}; {count} so far");
        }
    }
}

/// The cell by its description; `None` without an origin.
fn described(cell: &Cell) -> Result<Option<CpmCell>, Error> {
    let Some(origin) = cell.origin()? else {
        return Ok(None);
    };
    Ok(Some(CpmCell {
        origin,
        vacancy_signs: vacancy_signs(&cell.description()?.text)?,
    }))
}

/// Labels of the vacancy signs at the landmarks of a description.
fn vacancy_signs(description: &str) -> Result<BTreeSet<Label>, Error> {
    let settings: toml::Table = description.parse().map_err(|error| {
        Error::Invalid(format!("the description of the cell is no TOML: {error}"))
    })?;
    let landmarks = settings
        .get("landmarks")
        .and_then(toml::Value::as_array)
        .into_iter()
        .flatten();
    Ok(landmarks
        .filter_map(|place| place.get("vacancy")?.get("label")?.as_str())
        .map(Label::new)
        .collect())
}

/// Connections in which stations report.
struct Stations<'a> {
    settings: &'a Settings,
    places: StationPlaces,
    connected: BTreeMap<u32, Station>,
}

struct Station {
    cell: Cell,
    segments: Segments,
}

impl Stations<'_> {
    fn report(&mut self, receiver: &NodeName, received: ReceivedCpm) -> Result<(), CpmRefusal> {
        let number = received.station_id;
        let now = Instant::now();
        // Only a station with objects gets a place.
        if received.objects.is_empty() && !self.places.has(number) {
            return Ok(());
        }
        self.places.enter(number, receiver, now)?;
        self.connected.retain(|other, _| self.places.has(*other));
        let station = match self.connected.entry(number) {
            Entry::Occupied(station) => station.into_mut(),
            Entry::Vacant(place) => {
                let settings = Settings {
                    part: format!("{RECEIVED_PART}{number}"),
                    ..self.settings.clone()
                };
                let cell = Cell::connect(settings).map_err(|error| {
                    log::debug!("{RECEIVED_PART}{number}: {error}");
                    CpmRefusal::NotConnected
                })?;
                place.insert(Station {
                    cell,
                    segments: Segments::default(),
                })
            }
        };
        let Some(whole) = station.segments.join(received)? else {
            return Ok(());
        };
        if !self.places.reserve_room(number, now) {
            return Err(CpmRefusal::TooOften);
        }
        let frame = Frame {
            captured_at: capture_time(&whole),
            ..Frame::new(whole.objects)
        };
        station
            .cell
            .report(frame)
            .map(drop)
            .map_err(|_| CpmRefusal::Report)
    }
}

fn capture_time(received: &ReceivedCpm) -> SystemTime {
    SystemTime::UNIX_EPOCH + Duration::from_micros(received.captured_at.micros())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn vacancy_signs_come_from_description() {
        let description = "[[landmarks]]\nid = \"a\"\nx_m = 0\ny_m = 0\nvacancy = { label = \"EMPTY\", x_m = 0, y_m = 1 }\n\
                           [[landmarks]]\nid = \"b\"\nx_m = 5\ny_m = 0\n";
        assert_eq!(
            vacancy_signs(description),
            Ok(BTreeSet::from(["EMPTY".into()]))
        );
        assert_eq!(vacancy_signs("[origin]"), Ok(BTreeSet::new()));
        assert!(matches!(vacancy_signs("[origin"), Err(Error::Invalid(_))));
    }
}
