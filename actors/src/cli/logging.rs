//! Format and destination of the program's log.

use std::io::{IsTerminal, stderr};
use std::os::unix::fs::MetadataExt;

use clap::ValueEnum;
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{EnvFilter, Layer, Registry};

/// Help on log formats, printed once by `ecod-node --help`.
pub(super) const HELP: &str = "\
Log formats (--log-format):
  auto     systemd's journal if standard error is connected to it; else JSON for nodes outside a terminal, text otherwise
  text     lines on standard error
  json     one JSON object per line on standard error
  journal  systemd's journal, with fields named ECOD_*

RUST_LOG sets the log level, such as RUST_LOG=debug.";

/// Format of the log.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, ValueEnum)]
pub(super) enum LogFormat {
    /// The journal if connected; else JSON for nodes outside a terminal, text otherwise
    #[default]
    Auto,
    /// Lines on standard error
    Text,
    /// One JSON object per line on standard error
    Json,
    /// systemd's journal, with named fields
    Journal,
}

/// Prefix of event fields in the journal, followed by `_`.
const JOURNAL_PREFIX: &str = "ECOD";

/// Starts the log. A service's log is read by machines, a tool's by people. `RUST_LOG` overrides `level`.
pub(super) fn start(format: LogFormat, is_service: bool, level: &str) {
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(level));
    let (layer, problem) = match resolved(format, is_service) {
        LogFormat::Journal => match journal() {
            Ok(layer) => (layer, None),
            Err(error) => (json(), Some(error)),
        },
        LogFormat::Json => (json(), None),
        LogFormat::Text | LogFormat::Auto => (text(), None),
    };
    tracing_subscriber::registry().with(layer.with_filter(filter)).init();
    if let Some(error) = problem {
        tracing::warn!(%error, "cannot reach the journal, logging to standard error");
    }
}

fn resolved(format: LogFormat, is_service: bool) -> LogFormat {
    match format {
        LogFormat::Auto if stderr_is_journal() => LogFormat::Journal,
        LogFormat::Auto if is_service && !stderr().is_terminal() => LogFormat::Json,
        LogFormat::Auto => LogFormat::Text,
        chosen => chosen,
    }
}

/// Whether standard error is connected to the journal. The variable alone may be inherited from another process.
fn stderr_is_journal() -> bool {
    let Some(stream) = std::env::var("JOURNAL_STREAM").ok() else { return false };
    std::fs::metadata("/proc/self/fd/2").is_ok_and(|file| stream == format!("{}:{}", file.dev(), file.ino()))
}

type AnyLayer = Box<dyn Layer<Registry> + Send + Sync>;

fn text() -> AnyLayer {
    tracing_subscriber::fmt::layer().with_writer(stderr).with_ansi(stderr().is_terminal()).boxed()
}

fn json() -> AnyLayer {
    tracing_subscriber::fmt::layer()
        .json()
        .flatten_event(true)
        .with_current_span(false)
        .with_span_list(false)
        .with_writer(stderr)
        .boxed()
}

fn journal() -> std::io::Result<AnyLayer> {
    let layer = tracing_journald::layer()?.with_field_prefix(Some(JOURNAL_PREFIX.into()));
    Ok(layer.with_syslog_identifier("ecod-node".into()).boxed())
}
