//! Where the program's log goes, and in which form; and whether its spans are exported.

use std::io::{IsTerminal, stderr};
use std::os::unix::fs::MetadataExt;

use clap::ValueEnum;
use tracing::level_filters::LevelFilter;
use tracing_subscriber::filter::{FilterExt, filter_fn};
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{EnvFilter, Layer, Registry};

#[cfg(feature = "otel")]
use crate::telemetry::otlp::Export;

/// The form of the log.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, ValueEnum)]
pub enum LogFormat {
    /// To the journal if it is connected; else text on a terminal and for tools, and JSON for nodes
    #[default]
    Auto,
    /// Lines for people, to standard error
    Text,
    /// A JSON object a line, to standard error
    Json,
    /// To systemd's journal, each field by its name
    Journal,
}

/// Collector of spans, the standard variable; without it nothing is exported.
const ENDPOINT: &str = "OTEL_EXPORTER_OTLP_ENDPOINT";

/// What fields of events are called in the journal: `ECOD_` and their name.
const JOURNAL_PREFIX: &str = "ECOD";

/// Starts the log. `runs_on` tells programs that work until they are told to stop, whose logs machines read, from tools.
/// `RUST_LOG` goes before `level`. Spans are not logged: a line has the fields of its event alone, without those of the
/// actor that wrote it, and a span that nothing else records costs nothing. The result is kept until the program ends.
pub fn start(format: LogFormat, runs_on: bool, level: &str) -> Option<Export> {
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(level));
    let (layer, problem) = match resolved(format, runs_on) {
        LogFormat::Journal => match journal() {
            Ok(layer) => (layer, None),
            Err(error) => (json(), Some(error)),
        },
        LogFormat::Json => (json(), None),
        LogFormat::Text | LogFormat::Auto => (text(), None),
    };
    let events = filter_fn(|metadata| metadata.is_event()).with_max_level_hint(LevelFilter::TRACE);
    let mut layers = vec![layer.with_filter(filter.and(events)).boxed()];
    let exported = if runs_on { export(&mut layers) } else { Ok(None) };
    tracing_subscriber::registry().with(layers).init();
    if let Some(error) = problem {
        tracing::warn!(%error, "the journal does not answer, logging to standard error");
    }
    exported.unwrap_or_else(|error| {
        tracing::warn!(%error, "spans are not exported");
        None
    })
}

/// Adds what exports spans, where the environment names a collector.
fn export(layers: &mut Vec<AnyLayer>) -> anyhow::Result<Option<Export>> {
    if std::env::var_os(ENDPOINT).is_none_or(|endpoint| endpoint.is_empty()) {
        return Ok(None);
    }
    let (export, layer) = Export::start()?;
    layers.push(layer.boxed());
    Ok(Some(export))
}

fn resolved(format: LogFormat, runs_on: bool) -> LogFormat {
    match format {
        LogFormat::Auto if stderr_is_journal() => LogFormat::Journal,
        LogFormat::Auto if runs_on && !stderr().is_terminal() => LogFormat::Json,
        LogFormat::Auto => LogFormat::Text,
        chosen => chosen,
    }
}

/// Whether standard error is the stream that the service manager connected to the journal, and not something that an
/// inherited variable speaks of.
fn stderr_is_journal() -> bool {
    let Some(stream) = std::env::var("JOURNAL_STREAM").ok() else { return false };
    std::fs::metadata("/proc/self/fd/2").is_ok_and(|file| stream == format!("{}:{}", file.dev(), file.ino()))
}

/// An export that this program was built without.
#[cfg(not(feature = "otel"))]
pub enum Export {}

#[cfg(not(feature = "otel"))]
impl Export {
    fn start() -> anyhow::Result<(Self, AnyLayer)> {
        anyhow::bail!("{ENDPOINT} is set, but the program was built without the feature `otel`")
    }
}

type AnyLayer = Box<dyn Layer<Registry> + Send + Sync>;

fn text() -> AnyLayer {
    tracing_subscriber::fmt::layer().with_writer(stderr).with_ansi(stderr().is_terminal()).boxed()
}

fn json() -> AnyLayer {
    tracing_subscriber::fmt::layer().json().flatten_event(true).with_writer(stderr).boxed()
}

fn journal() -> std::io::Result<AnyLayer> {
    let layer = tracing_journald::layer()?.with_field_prefix(Some(JOURNAL_PREFIX.into()));
    Ok(layer.with_syslog_identifier("ecod-node".into()).boxed())
}
