//! Throttle of log lines: a bounded number from each place in the code, independent of the peers'
//! messages.

use std::collections::HashMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use ecod::model::time::Timestamp;
use tracing::field::{Field, Visit};
use tracing::{Event, Level, Metadata, Subscriber};
use tracing_subscriber::layer::{Context, Filter};

use crate::platform::clock;
use crate::platform::throttle::TokenBucket;

/// Lines that one place in this project may write at once, and the time after which it may write
/// one more.
const OWN_BURST: u32 = 200;
const OWN_INTERVAL: Duration = Duration::from_millis(100);

/// Burst and interval for one place in a library: libraries log single packets of peers.
const LIBRARY_BURST: u32 = 10;
const LIBRARY_INTERVAL: Duration = Duration::from_secs(10);

/// Prefix of the targets of this project's crates.
const OWN_TARGETS: &str = "ecod";

/// Lines of this process that were left out so far.
static LEFT_OUT: AtomicU64 = AtomicU64::new(0);

/// Number of log lines of this process that the throttle left out so far.
pub(crate) fn lines_left_out() -> u64 {
    LEFT_OUT.load(Ordering::Relaxed)
}

/// Filter of events that allows each place in the code a burst of lines, then one per interval.
/// Lines below the level `info` pass, because they were requested explicitly.
#[derive(Debug, Default)]
pub(crate) struct LineThrottle {
    places: Mutex<HashMap<CodePlace, TokenBucket>>,
}

/// A place in the code: target and line. The code of a program is finite, and so is the number of
/// places.
type CodePlace = (String, u64);

impl LineThrottle {
    fn allows(&self, target: &str, line: u64, now: Timestamp) -> bool {
        let (burst, interval) = if target.starts_with(OWN_TARGETS) {
            (OWN_BURST, OWN_INTERVAL)
        } else {
            (LIBRARY_BURST, LIBRARY_INTERVAL)
        };
        let mut places = self.places.lock().unwrap_or_else(PoisonError::into_inner);
        let bucket = places
            .entry((target.to_owned(), line))
            .or_insert_with(|| TokenBucket::new(burst, interval, now));
        let is_allowed = bucket.allow(now);
        if !is_allowed {
            LEFT_OUT.fetch_add(1, Ordering::Relaxed);
        }
        is_allowed
    }
}

impl<S: Subscriber> Filter<S> for LineThrottle {
    fn enabled(&self, _: &Metadata<'_>, _: &Context<'_, S>) -> bool {
        true
    }

    fn event_enabled(&self, event: &Event<'_>, _: &Context<'_, S>) -> bool {
        let metadata = event.metadata();
        if *metadata.level() > Level::INFO {
            return true;
        }
        let mut origin = LogRecordOrigin::default();
        event.record(&mut origin);
        let target = origin.target.as_deref().unwrap_or(metadata.target());
        let line = origin
            .line
            .or(metadata.line().map(u64::from))
            .unwrap_or_default();
        self.allows(target, line, clock::now())
    }
}

/// Target and line of a record of the crate `log`, which are fields of its event.
#[derive(Debug, Default)]
struct LogRecordOrigin {
    target: Option<String>,
    line: Option<u64>,
}

impl Visit for LogRecordOrigin {
    fn record_debug(&mut self, _: &Field, _: &dyn std::fmt::Debug) {}

    fn record_str(&mut self, field: &Field, value: &str) {
        if field.name() == "log.target" {
            self.target = Some(value.to_owned());
        }
    }

    fn record_u64(&mut self, field: &Field, value: u64) {
        if field.name() == "log.line" {
            self.line = Some(value);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use tracing_subscriber::layer::SubscriberExt;
    use tracing_subscriber::{Layer, Registry};

    use super::*;

    /// Counts the lines that get through.
    #[derive(Clone, Default)]
    struct Counter(Arc<AtomicU64>);

    impl<S: Subscriber> Layer<S> for Counter {
        fn on_event(&self, _: &Event<'_>, _: Context<'_, S>) {
            self.0.fetch_add(1, Ordering::Relaxed);
        }
    }

    #[test]
    fn repeated_library_lines_are_limited() {
        let lines = Counter::default();
        let subscriber =
            Registry::default().with(lines.clone().with_filter(LineThrottle::default()));
        tracing::subscriber::with_default(subscriber, || {
            for _ in 0..10_000 {
                tracing::warn!(target: "rmqtt::session", "Subscribe failed");
            }
            let of_library = lines.0.swap(0, Ordering::Relaxed);
            assert_eq!(of_library, u64::from(LIBRARY_BURST));
            tracing::warn!(target: "rmqtt::session", "another place");
            assert_eq!(lines.0.swap(0, Ordering::Relaxed), 1);
            for _ in 0..10_000 {
                tracing::info!(target: "ecod_actors::node", "once for each message");
            }
            let own = lines.0.swap(0, Ordering::Relaxed);
            assert!((u64::from(OWN_BURST)..10_000).contains(&own), "{own}");
            assert!(lines_left_out() >= 9_990);
        });
    }

    #[test]
    fn limited_line_returns_later() {
        let throttle = LineThrottle::default();
        let written = |second: u64| {
            let at = Timestamp(second * 1_000_000);
            (0..100)
                .filter(|_| throttle.allows("rmqtt::session", 1, at))
                .count()
        };
        assert_eq!([written(1), written(2), written(31)], [10, 0, 3]);
    }
}
