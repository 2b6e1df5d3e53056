//! Metrics of the region for Prometheus, in the OpenMetrics text format.

use std::fmt;
use std::sync::atomic::{AtomicU64, Ordering};

use ecod::model::time::Timestamp;
use ecod_actors::observe::dashboard::process_metrics;
use ecod_actors::platform::clock;
use prometheus_client::encoding::text::encode;
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::registry::{Registry, Unit};

use crate::reader::RegionState;

/// Content type of [`metrics`].
pub(super) const CONTENT_TYPE: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

/// Requests and connections that were not served.
#[derive(Debug, Default)]
pub(super) struct PageCounts {
    pub(super) refused: AtomicU64,
    pub(super) throttled: AtomicU64,
}

impl PageCounts {
    pub(super) fn count(counter: &AtomicU64) {
        counter.fetch_add(1, Ordering::Relaxed);
    }
}

type RegionLabels = Vec<(&'static str, String)>;

/// All metrics as text.
///
/// # Errors
/// Does not fail for text; the encoder's writer may fail.
pub(super) fn metrics(
    state: &RegionState,
    page: &PageCounts,
    started_at: Timestamp,
) -> Result<String, fmt::Error> {
    let mut registry = Registry::with_prefix("ecod_region");
    let link = state.link();
    let tiles = state.tiles();
    let (cells, counts) = {
        let town = state.town();
        (town.states(&tiles, clock::now()), town.counts().clone())
    };
    gauge(
        &mut registry,
        "broker_up",
        "Whether the region's broker lets the reader in",
        i64::from(link.is_up),
    );
    counter(
        &mut registry,
        "broker_logins",
        "Logins at the region's broker",
        link.logins,
    );
    let states = Family::<RegionLabels, Gauge>::default();
    for (state, number) in cells {
        states
            .get_or_create(&vec![("state", state.as_str().to_owned())])
            .set(count(number));
    }
    let help = "Cells by state; live and silent apply to cells whose maps are read; for other cells leads and offline follow the leader's status";
    registry.register("cells", help, states);
    gauge(
        &mut registry,
        "tiles_read",
        "Tiles whose maps are read",
        count(tiles.count()),
    );
    counter(
        &mut registry,
        "messages",
        "Messages received",
        counts.messages,
    );
    let bytes = Counter::<u64>::default();
    bytes.inc_by(counts.bytes);
    registry.register_with_unit("received", "Payloads received", Unit::Bytes, bytes);
    counter(&mut registry, "maps", "Maps that count", counts.maps);
    let rejected = Family::<RegionLabels, Counter>::default();
    for (reason, number) in counts.rejected {
        rejected
            .get_or_create(&vec![("reason", reason.as_str().to_owned())])
            .inc_by(number);
    }
    rejected
        .get_or_create(&vec![("reason", "cell_throttled".to_owned())])
        .inc_by(counts.losses.throttled);
    let help = "Messages that do not count; stale are maps that came too late, cell_throttled those beyond 20/s of a cell";
    registry.register("rejected", help, rejected);
    let objects = Family::<RegionLabels, Counter>::default();
    for (reason, number) in [
        ("outside", counts.losses.outside),
        ("too_many", counts.losses.too_many),
    ] {
        objects
            .get_or_create(&vec![("reason", reason.to_owned())])
            .inc_by(number);
    }
    registry.register(
        "objects_refused",
        "Objects outside of their cell's area, or beyond 2048 of a cell",
        objects,
    );
    let [refused, throttled] =
        [&page.refused, &page.throttled].map(|counter| counter.load(Ordering::Relaxed));
    counter(
        &mut registry,
        "browsers_refused",
        "Requests without access, and connections beyond the limit",
        refused,
    );
    counter(
        &mut registry,
        "browsers_throttled",
        "Requests beyond the rate",
        throttled,
    );
    let mut process = Registry::default();
    process_metrics::register(&mut process, started_at);
    let mut text = String::new();
    encode(&mut text, &registry)?;
    // A text has one end mark only.
    text.truncate(text.trim_end_matches("# EOF\n").len());
    encode(&mut text, &process)?;
    Ok(text)
}

fn gauge(registry: &mut Registry, name: &str, help: &str, value: i64) {
    let gauge = Gauge::<i64>::default();
    gauge.set(value);
    registry.register(name, help, gauge);
}

fn counter(registry: &mut Registry, name: &str, help: &str, value: u64) {
    let counter = Counter::<u64>::default();
    counter.inc_by(value);
    registry.register(name, help, counter);
}

fn count(number: usize) -> i64 {
    i64::try_from(number).unwrap_or(i64::MAX)
}
