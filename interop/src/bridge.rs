//! A cell's maps and reports as collective perception messages, and those of other stations as reports.
//!
//! ```text
//! global_detections   -> cpm/map              the map, by the station of the node that fused it
//! detections/<node>   -> cpm/vehicles/<node>  a vehicle's own report
//! cpm/received/<name> -> detections/<node>--cpm-<station>
//! ```

use std::collections::BTreeMap;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::{Duration, Instant, SystemTime};

use ecod_client::{Cell, Error, ForeignMessage, Frame, GeographicOrigin, GlobalMap, NodeName, ObjectReport, Settings};

use crate::cpm::{self, CpmError, ObjectIds, ReceivedCpm, StationIds};

/// Part of the node's name in which a station's objects are reported, before the station's number.
const PART: &str = "cpm-";

/// Maximum number of stations at a time. A node has room for 16 parts.
const MAX_STATIONS: usize = 12;

/// Silence after which a station gives its place to another.
const STATION_RETENTION: Duration = Duration::from_secs(60);

/// Maximum number of receivers whose unusable messages are counted apart.
const MAX_RECEIVERS: usize = 256;

/// Age of the origin at which it is asked for anew.
const ORIGIN_AGE: Duration = Duration::from_secs(1);

/// A bridge beside a node.
pub struct CpmBridge {
    cell: Cell,
    settings: Settings,
    origin: Mutex<(Instant, GeographicOrigin)>,
    numbers: Mutex<StationIds>,
    refusals: Mutex<BTreeMap<(NodeName, CpmRefusal), u64>>,
}

/// Reason why a received message is no report.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, thiserror::Error)]
pub enum CpmRefusal {
    /// The message is not usable.
    #[error(transparent)]
    Cpm(#[from] CpmError),
    /// It has the station number of a node of this cell: an echo.
    #[error("a station number of this cell")]
    Own,
    /// As many stations as there is room for were heard lately.
    #[error("too many stations")]
    TooManyStations,
    /// Its values are no report, or the node's broker refuses it.
    #[error("refused as a report")]
    Report,
}

impl CpmBridge {
    /// Connects to a cell.
    ///
    /// # Errors
    /// As [`Cell::connect`], and [`Error::Invalid`] if the cell's description has no `[origin]`.
    pub fn connect(settings: Settings) -> Result<Self, Error> {
        let invalid = |error: &dyn std::fmt::Display| Error::Invalid(error.to_string());
        let name = NodeName::new(&settings.cell).map_err(|error| invalid(&error))?;
        let cell = Cell::connect(Settings { part: "cpm".to_owned(), ..settings.clone() })?;
        let origin = cell.origin()?.ok_or_else(|| {
            Error::Invalid(format!(
                "the description of the cell {name} has no [origin], and a CPM needs a reference position on Earth: add \
                 latitude_deg and longitude_deg (docs/configuration.md#origin) and set it with `ecod-node cell set`"
            ))
        })?;
        let (origin, numbers) = (Mutex::new((Instant::now(), origin)), Mutex::new(StationIds::new(name)));
        Ok(Self { cell, settings, origin, numbers, refusals: Mutex::default() })
    }

    /// Carries messages until the connection is closed.
    ///
    /// # Errors
    /// [`Error::Refused`] when the node's broker refuses the bridge.
    pub fn run(&self) -> Result<(), Error> {
        thread::scope(|scope| {
            let maps = scope.spawn(|| self.until_closed(|| self.send_maps()));
            let reports = scope.spawn(|| self.until_closed(|| self.send_reports()));
            let received = self.until_closed(|| self.take_received());
            let sent = [maps.join(), reports.join()].into_iter().flatten();
            sent.fold(received, Result::and)
        })
    }

    /// Ends the connection, and with it [`CpmBridge::run`].
    pub fn close(&self) {
        self.cell.close();
    }

    /// Messages that became no report, by receiver and reason.
    pub fn refusals(&self) -> BTreeMap<(NodeName, CpmRefusal), u64> {
        lock(&self.refusals).clone()
    }

    fn until_closed(&self, carry: impl Fn() -> Result<(), Error>) -> Result<(), Error> {
        let ended = carry();
        self.cell.close();
        ended
    }

    fn send_maps(&self) -> Result<(), Error> {
        let mut ids = ObjectIds::default();
        for map in self.cell.maps() {
            let map: &GlobalMap = &*map?;
            let number = lock(&self.numbers).of(&map.aggregator);
            let Some(number) = number else { continue };
            let encoded = cpm::encode_map(map, &self.origin(), number, &mut ids);
            self.send("map", encoded)?;
        }
        Ok(())
    }

    fn send_reports(&self) -> Result<(), Error> {
        let is_foreign =
            |node: &NodeName| node.as_str().split_once("--").is_some_and(|(_, part)| part.starts_with(PART));
        for report in self.cell.reports() {
            let report: &ObjectReport = &*report?;
            let number = (!is_foreign(&report.node)).then(|| lock(&self.numbers).of(&report.node)).flatten();
            let Some(number) = number else { continue };
            let encoded = cpm::encode_report(report, &self.origin(), number);
            self.send(&format!("vehicles/{}", report.node), encoded)?;
        }
        Ok(())
    }

    fn send(&self, level: &str, encoded: Result<cpm::EncodedCpm, CpmError>) -> Result<(), Error> {
        match encoded {
            Ok(message) => {
                if message.left_out > 0 {
                    log::debug!("cpm/{level}: no room for {} objects", message.left_out);
                }
                self.cell.publish_cpm(level, message.bytes).map(drop)
            }
            Err(error) => {
                log::warn!("nothing sent on cpm/{level}: {error}");
                Ok(())
            }
        }
    }

    fn take_received(&self) -> Result<(), Error> {
        let mut stations = Stations { settings: &self.settings, connected: BTreeMap::new() };
        for message in self.cell.received_cpms() {
            let message: &ForeignMessage = &*message?;
            if let Err(refusal) = self.take(&mut stations, message) {
                self.note(&message.receiver, refusal);
            }
        }
        Ok(())
    }

    fn take(&self, stations: &mut Stations<'_>, message: &ForeignMessage) -> Result<(), CpmRefusal> {
        let received = cpm::decode(&message.payload, &self.origin())?;
        if lock(&self.numbers).is_own(received.station_id) {
            return Err(CpmRefusal::Own);
        }
        stations.report(received)
    }

    /// The cell's origin, as it was a second ago at most; the last known one while it cannot be had.
    fn origin(&self) -> GeographicOrigin {
        let mut origin = lock(&self.origin);
        if origin.0.elapsed() > ORIGIN_AGE {
            origin.0 = Instant::now();
            match self.cell.origin() {
                Ok(Some(present)) => origin.1 = present,
                Ok(None) => log::warn!("the cell has no [origin] any more; the last one is used"),
                Err(error) => log::debug!("origin: {error}"),
            }
        }
        origin.1
    }

    /// Counts a message that became no report, and tells of the first of each kind.
    fn note(&self, receiver: &NodeName, refusal: CpmRefusal) {
        let mut refusals = lock(&self.refusals);
        let key = (receiver.clone(), refusal);
        if refusals.len() >= MAX_RECEIVERS && !refusals.contains_key(&key) {
            return;
        }
        let count = refusals.entry(key).or_default();
        *count += 1;
        if *count == 1 {
            log::warn!("no report from cpm/received/{receiver}: {refusal}; others like it are only counted");
        }
    }
}

/// Connections in which stations report.
struct Stations<'a> {
    settings: &'a Settings,
    connected: BTreeMap<u32, Station>,
}

struct Station {
    cell: Cell,
    heard_at: Instant,
    /// Segments of the latest time so far.
    segments: BTreeMap<u8, ReceivedCpm>,
}

impl Stations<'_> {
    fn report(&mut self, received: ReceivedCpm) -> Result<(), CpmRefusal> {
        let number = received.station_id;
        self.connected.retain(|other, station| *other == number || station.heard_at.elapsed() < STATION_RETENTION);
        if !self.connected.contains_key(&number) {
            if self.connected.len() >= MAX_STATIONS {
                return Err(CpmRefusal::TooManyStations);
            }
            let settings = Settings { part: format!("{PART}{number}"), ..self.settings.clone() };
            let cell = Cell::connect(settings).map_err(|_| CpmRefusal::Report)?;
            self.connected.insert(number, Station { cell, heard_at: Instant::now(), segments: BTreeMap::new() });
        }
        let Some(station) = self.connected.get_mut(&number) else { return Ok(()) };
        station.heard_at = Instant::now();
        let Some(whole) = station.join(received) else { return Ok(()) };
        let since_epoch = Duration::from_micros(whole.captured_at.micros());
        let frame = Frame { captured_at: SystemTime::UNIX_EPOCH + since_epoch, ..Frame::new(whole.objects) };
        station.cell.report(frame).map(drop).map_err(|_| CpmRefusal::Report)
    }
}

impl Station {
    /// A whole message; `None` while segments of it are missing. Objects that a report omits would count as gone.
    fn join(&mut self, received: ReceivedCpm) -> Option<ReceivedCpm> {
        let Some((number, total)) = received.segment else { return Some(received) };
        self.segments.retain(|_, segment| segment.captured_at == received.captured_at);
        self.segments.insert(number, received);
        if self.segments.len() < usize::from(total) {
            return None;
        }
        let mut segments = std::mem::take(&mut self.segments).into_values();
        let mut whole = segments.next()?;
        whole.objects.extend(segments.flat_map(|segment| segment.objects));
        Some(whole)
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
