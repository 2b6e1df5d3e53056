//! A subscriber of a half of the town, and its figures.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::neighbours::MAX_AGE;
use ecod::wire::RejectReason;
use ecod_region::broker::BrokerLogin;
use ecod_region::reader::{self, RegionState};
use ecod_region::town::{Accepted, CellRefusal};
use hdrhistogram::Histogram;

use crate::places::Half;
use crate::spawn_thread;

/// A subscriber on a thread of its own, until the process ends.
pub(crate) struct Watch {
    state: Arc<RegionState>,
    figures: Arc<Mutex<Figures>>,
}

struct Figures {
    /// True ages in microseconds of the maps that count: this machine has one clock.
    ages: Histogram<u64>,
    bytes: u64,
    /// Maps that count, and maps that never came by the numbers of those around them.
    maps: u64,
    missing: u64,
    stale: u64,
    other: u64,
    /// Newest map of each cell that counts: round and time of sending.
    newest: HashMap<NodeName, (u64, Timestamp)>,
    /// Cells and ages of maps that counted though they were too old.
    too_old: Vec<(NodeName, Duration)>,
}

/// How far the estimate of the least delay may be off on one machine.
const TOLERANCE: Duration = Duration::from_millis(200);

impl Watch {
    pub(crate) fn start(login: BrokerLogin, half: &Half) -> Self {
        let watch = Self::start_overview(login);
        watch.state.ask(half.tiles.clone());
        watch
    }

    /// A reader that looks at no tile: it has the status of every cell.
    pub(crate) fn start_overview(login: BrokerLogin) -> Self {
        let state = Arc::new(RegionState::default());
        let figures = Arc::new(Mutex::new(Figures::default()));
        let read = Arc::clone(&state);
        let noted = Arc::clone(&figures);
        let reading = async move {
            reader::read(&login, &read, |reading| {
                let mut figures = lock(&noted);
                figures.bytes += reading.payload.len() as u64;
                match &reading.outcome {
                    Ok(Accepted::Map(topic, _)) => {
                        let town = read.town();
                        let cell = town.cells().get(&(topic.tile, topic.cell.clone()));
                        let map = cell.and_then(|cell| cell.map.as_ref());
                        // Simulated cells send a map as it is fused, real ones a moment later.
                        let taken = map.map(|map| (map.round, map.fused_at));
                        drop(town);
                        if let Some((round, sent_at)) = taken {
                            figures.record_map(&topic.cell, round, sent_at, reading.at);
                        }
                    }
                    Ok(Accepted::Other(_)) => {}
                    Err(CellRefusal::Rejected(RejectReason::Stale)) => figures.stale += 1,
                    Err(_) => figures.other += 1,
                }
            })
            .await;
        };
        if let Err(error) = spawn_thread("subscriber", reading) {
            eprintln!("{error:#}");
        }
        Self { state, figures }
    }

    /// Begins a new measurement.
    pub(crate) fn reset(&self) {
        let mut figures = lock(&self.figures);
        let newest = std::mem::take(&mut figures.newest);
        let too_old = std::mem::take(&mut figures.too_old);
        *figures = Figures {
            newest,
            too_old,
            ..Figures::default()
        };
    }

    /// Number of cells of which a map counts that was sent later.
    pub(crate) fn sent_after(&self, since: Timestamp) -> usize {
        lock(&self.figures)
            .newest
            .values()
            .filter(|(_, sent_at)| *sent_at > since)
            .count()
    }

    /// Number of cells of which anything is known.
    pub(crate) fn cells(&self) -> usize {
        self.state.town().cells().len()
    }

    /// Cells and ages of maps that counted since the last call though they were too old.
    pub(crate) fn take_too_old(&self) -> Vec<(NodeName, Duration)> {
        std::mem::take(&mut lock(&self.figures).too_old)
    }

    /// The trouble of the connection, and the messages so far.
    pub(crate) fn trouble(&self) -> String {
        format!("{:?}, {:?}", self.state.link(), self.state.town().counts())
    }

    /// The figures of a time in seconds, in a line.
    pub(crate) fn figures(&self, span: f64) -> String {
        let Figures {
            ages,
            bytes,
            maps,
            missing,
            stale,
            other,
            ..
        } = &*lock(&self.figures);
        let milliseconds = |quantile| ages.value_at_quantile(quantile) as f64 / 1000.0;
        // Those that came too late are not among the maps that count either.
        let lost = missing.saturating_sub(*stale);
        let percent = 100.0 * lost as f64 / (maps + missing).max(1) as f64;
        format!(
            "{:.0} maps/s, {:.1} MB/s, age p50 {:.1} ms, p99 {:.1} ms, most {:.0} ms; {lost} lost ({percent:.3} %), \
             {stale} too late and not taken, {other} not taken for other reasons",
            *maps as f64 / span,
            *bytes as f64 / span / 1e6,
            milliseconds(0.5),
            milliseconds(0.99),
            milliseconds(1.0),
        )
    }
}

impl Default for Figures {
    fn default() -> Self {
        // Ages up to ten minutes, to three digits.
        let ages = Histogram::new_with_bounds(1, 600_000_000, 3).expect("these bounds are valid");
        Self {
            ages,
            bytes: 0,
            maps: 0,
            missing: 0,
            stale: 0,
            other: 0,
            newest: HashMap::new(),
            too_old: Vec::new(),
        }
    }
}

impl Figures {
    fn record_map(&mut self, cell: &NodeName, round: u64, sent_at: Timestamp, at: Timestamp) {
        let age = at.since(sent_at);
        self.maps += 1;
        self.ages
            .saturating_record(u64::try_from(age.as_micros()).unwrap_or(u64::MAX));
        if age > MAX_AGE + TOLERANCE {
            self.too_old.push((cell.clone(), age));
        }
        let newest = self
            .newest
            .entry(cell.clone())
            .or_insert((round - 1, sent_at));
        // Real cells leave rounds out.
        if cell.as_str().starts_with("cell-") {
            self.missing += round.saturating_sub(newest.0 + 1);
        }
        *newest = (round, sent_at);
    }
}

fn lock<T>(shared: &Mutex<T>) -> MutexGuard<'_, T> {
    shared.lock().unwrap_or_else(PoisonError::into_inner)
}
