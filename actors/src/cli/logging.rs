//! Format and destination of the program's log, and the export of its spans.

use std::fmt;
use std::io::{IsTerminal, stderr};
use std::os::unix::fs::MetadataExt;

use clap::ValueEnum;
use serde_json::{Map, Value};
use tracing::level_filters::LevelFilter;
use tracing::{Event, Subscriber};
use tracing_subscriber::filter::{FilterExt, filter_fn};
use tracing_subscriber::fmt::format::{JsonFields, Writer};
use tracing_subscriber::fmt::{FmtContext, FormatEvent, FormatFields, MakeWriter, format};
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::registry::LookupSpan;
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{EnvFilter, Layer, Registry};

use crate::node::health_log;
use crate::telemetry::line_throttle::LineThrottle;
#[cfg(feature = "otel")]
use crate::telemetry::otlp::Export;

/// Help on log formats, printed once by `ecod-node --help`.
pub(super) const HELP: &str = "\
Log formats (--log-format):
  auto     systemd's journal if standard error is connected to it; else JSON for nodes outside a terminal, text otherwise
  text     lines on standard error
  json     one JSON object per line on standard error
  journal  systemd's journal, with fields named ECOD_*

RUST_LOG sets the log level, such as RUST_LOG=debug.";

/// Arguments about the log, of every program.
#[derive(Debug, clap::Args)]
pub struct LogArguments {
    /// Format of log lines: auto, text, json or journal; `ecod-node --help` explains them
    #[arg(
        long,
        global = true,
        value_enum,
        value_name = "FORM",
        default_value_t,
        help_heading = "Logging",
        hide_short_help = true,
        hide_possible_values = true
    )]
    pub log_format: LogFormat,
}

/// Format of the log.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, ValueEnum)]
pub enum LogFormat {
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

/// Standard variable with the address of the collector of spans; spans are exported only if it is
/// set.
const ENDPOINT: &str = "OTEL_EXPORTER_OTLP_ENDPOINT";

/// Prefix of event fields in the journal, followed by `_`.
const JOURNAL_PREFIX: &str = "ECOD";

/// Starts the log. A service's log is read by machines, a tool's by people. `RUST_LOG` overrides
/// `level`. Spans are not logged: a line has the fields of its event only. Keep the result until
/// the program ends.
pub fn start(format: LogFormat, is_service: bool, level: &str) -> Option<Export> {
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(level));
    let (layer, problem) = match resolved(format, is_service) {
        LogFormat::Journal => match journal() {
            Ok(layer) => (layer, None),
            Err(error) => (json(), Some(error)),
        },
        LogFormat::Json => (json(), None),
        LogFormat::Text | LogFormat::Auto => (text(), None),
    };
    let events = filter_fn(|metadata| metadata.is_event()).with_max_level_hint(LevelFilter::TRACE);
    let mut layers = vec![
        layer
            .with_filter(filter.and(events).and(LineThrottle::default()))
            .boxed(),
    ];
    let exported = if is_service {
        export(&mut layers)
    } else {
        Ok(None)
    };
    tracing_subscriber::registry().with(layers).init();
    if let Some(error) = problem {
        tracing::warn!(%error, "cannot reach the journal, logging to standard error");
    }
    exported.unwrap_or_else(|error| {
        tracing::warn!(%error, "cannot export spans");
        None
    })
}

/// Adds the export of spans if the environment names a collector.
fn export(layers: &mut Vec<AnyLayer>) -> anyhow::Result<Option<Export>> {
    if std::env::var_os(ENDPOINT).is_none_or(|endpoint| endpoint.is_empty()) {
        return Ok(None);
    }
    let (export, layer) = Export::start()?;
    layers.push(layer.boxed());
    Ok(Some(export))
}

fn resolved(format: LogFormat, is_service: bool) -> LogFormat {
    match format {
        LogFormat::Auto if stderr_is_journal() => LogFormat::Journal,
        LogFormat::Auto if is_service && !stderr().is_terminal() => LogFormat::Json,
        LogFormat::Auto => LogFormat::Text,
        chosen => chosen,
    }
}

/// True if standard error is connected to the journal. The variable alone may be inherited from
/// another process.
fn stderr_is_journal() -> bool {
    let Some(stream) = std::env::var("JOURNAL_STREAM").ok() else {
        return false;
    };
    std::fs::metadata("/proc/self/fd/2")
        .is_ok_and(|file| stream == format!("{}:{}", file.dev(), file.ino()))
}

/// An export in a program that was built without it.
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
    tracing_subscriber::fmt::layer()
        .with_writer(stderr)
        .with_ansi(stderr().is_terminal())
        .boxed()
}

fn json() -> AnyLayer {
    json_to(stderr)
}

fn json_to(output: impl for<'a> MakeWriter<'a> + Send + Sync + 'static) -> AnyLayer {
    tracing_subscriber::fmt::layer()
        .event_format(NestedHealth(format().json().flatten_event(true)))
        .fmt_fields(JsonFields::new())
        .with_writer(output)
        .boxed()
}

/// A format of JSON lines whose counters are objects in the line about a node's health.
struct NestedHealth<F>(F);

impl<S, N, F> FormatEvent<S, N> for NestedHealth<F>
where
    S: Subscriber + for<'a> LookupSpan<'a>,
    N: for<'a> FormatFields<'a> + 'static,
    F: FormatEvent<S, N>,
{
    fn format_event(
        &self,
        context: &FmtContext<'_, S, N>,
        mut writer: Writer<'_>,
        event: &Event<'_>,
    ) -> fmt::Result {
        if event.metadata().target() != health_log::TARGET {
            return self.0.format_event(context, writer, event);
        }
        let mut line = String::new();
        self.0
            .format_event(context, Writer::new(&mut line), event)?;
        let Ok(mut fields) = serde_json::from_str::<Map<String, Value>>(&line) else {
            return writer.write_str(&line);
        };
        for field in fields.values_mut() {
            if let Some(counts) = field
                .as_str()
                .and_then(|text| serde_json::from_str::<Map<String, Value>>(text).ok())
            {
                *field = Value::Object(counts);
            }
        }
        writeln!(writer, "{}", Value::Object(fields))
    }
}

fn journal() -> std::io::Result<AnyLayer> {
    let layer = tracing_journald::layer()?.with_field_prefix(Some(JOURNAL_PREFIX.into()));
    Ok(layer.with_syslog_identifier("ecod-node".into()).boxed())
}

#[cfg(test)]
mod tests {
    use std::io::{Read, Seek};
    use std::sync::Arc;

    use super::*;

    #[test]
    fn health_counters_are_json_objects() {
        let mut output = tempfile::tempfile().unwrap();
        let written = Arc::new(output.try_clone().unwrap());
        let subscriber = tracing_subscriber::registry().with(json_to(written));
        tracing::subscriber::with_default(subscriber, || {
            let counts = r#"{"published":3}"#;
            tracing::info!(target: health_log::TARGET, events = %counts, "health");
            tracing::info!(text = %counts, "other");
        });
        let mut text = String::new();
        output.rewind().unwrap();
        output.read_to_string(&mut text).unwrap();
        let lines: Vec<Value> = text
            .lines()
            .map(|line| serde_json::from_str(line).unwrap())
            .collect();
        assert_eq!(
            (&lines[0]["message"], &lines[0]["events"]["published"]),
            (&"health".into(), &3.into())
        );
        assert_eq!(lines[1]["text"], r#"{"published":3}"#, "only that line");
    }
}
