//! Export of spans to a collector, by OTLP over HTTP.
//!
//! The ids of a named span are derived from its name: trace id = UUIDv5 of `ecod:<name>` in the
//! namespace of URLs, span id = its last eight bytes. A node that can derive the name can link to
//! the span, and traces that are sampled by their id are sampled consistently on all nodes.

use std::cell::Cell;
use std::time::{Duration, SystemTime};

use ecod::model::time::Timestamp;
use opentelemetry::trace::{
    Link, SpanBuilder, SpanContext, SpanId, TraceContextExt, TraceFlags, TraceId, TraceState,
    Tracer, TracerProvider,
};
use opentelemetry::{Context, KeyValue};
use opentelemetry_otlp::SpanExporter;
use opentelemetry_sdk::Resource;
use opentelemetry_sdk::trace::{IdGenerator, RandomIdGenerator, SdkTracer, SdkTracerProvider};
use tracing::level_filters::LevelFilter;
use tracing_subscriber::filter::Targets;
use tracing_subscriber::{Layer, Registry};
use uuid::Uuid;

use crate::platform::clock;

/// Sends the remaining spans when it is dropped.
#[derive(Debug)]
pub struct Export(SdkTracerProvider);

/// Time for sending the last spans, in case the collector hangs.
const FLUSH_TIMEOUT: Duration = Duration::from_secs(1);

impl Export {
    /// Exports this program's spans, and the events within them, as configured by the standard
    /// environment variables: `OTEL_EXPORTER_OTLP_…`, `OTEL_TRACES_SAMPLER`, `OTEL_SERVICE_NAME`.
    ///
    /// # Errors
    /// Returns an error if a variable cannot be used.
    pub fn start() -> anyhow::Result<(Self, impl Layer<Registry> + Send + Sync)> {
        let mut resource = Resource::builder();
        if std::env::var_os("OTEL_SERVICE_NAME").is_none() {
            resource = resource.with_service_name("ecod-node");
        }
        let provider = SdkTracerProvider::builder()
            .with_resource(resource.build())
            .with_id_generator(NamedIds::default())
            .with_batch_exporter(SpanExporter::builder().with_http().build()?)
            .build();
        let layer = tracing_opentelemetry::layer()
            .with_location(false)
            .with_threads(false)
            .with_target(false)
            .with_tracked_inactivity(false)
            .with_tracer(NamingTracer(provider.tracer(env!("CARGO_PKG_NAME"))))
            .with_filter(Targets::new().with_target(env!("CARGO_CRATE_NAME"), LevelFilter::INFO));
        Ok((Self(provider), layer))
    }
}

impl Drop for Export {
    fn drop(&mut self) {
        if let Err(error) = self.0.shutdown_with_timeout(FLUSH_TIMEOUT) {
            tracing::warn!(%error, "the last spans were not exported");
        }
    }
}

/// Applies the fields `ecod.*` of spans: ids, parent, links and start.
#[derive(Debug)]
struct NamingTracer(SdkTracer);

impl Tracer for NamingTracer {
    type Span = <SdkTracer as Tracer>::Span;

    fn build_with_context(&self, mut builder: SpanBuilder, parent: &Context) -> Self::Span {
        let mut name = None;
        let mut remote = None;
        let mut attributes = builder.attributes.take().unwrap_or_default();
        attributes.retain(|KeyValue { key, value, .. }| {
            let value = value.as_str();
            match key.as_str() {
                "ecod.id" => {
                    name = Some(id(&value));
                    return true;
                }
                "ecod.parent" => remote = Some(context(&value)),
                "ecod.links" => {
                    builder.links = Some(
                        value
                            .split_whitespace()
                            .map(|name| Link::with_context(context(name)))
                            .collect(),
                    );
                }
                "ecod.since_us" => {
                    builder.start_time = value
                        .parse()
                        .ok()
                        .and_then(|since| on_this_clock(Timestamp(since)));
                }
                _ => return true,
            }
            false
        });
        builder.attributes = Some(attributes);
        let parent = remote.map_or_else(
            || parent.clone(),
            |remote| parent.with_remote_span_context(remote),
        );
        NAMED.set(name);
        let span = self.0.build_with_context(builder, &parent);
        NAMED.set(None);
        span
    }
}

thread_local! {
    /// The ids of the span that is being built.
    static NAMED: Cell<Option<Uuid>> = const { Cell::new(None) };
}

/// Ids of named spans, and random ids of other spans.
#[derive(Debug, Default)]
struct NamedIds(RandomIdGenerator);

impl IdGenerator for NamedIds {
    fn new_trace_id(&self) -> TraceId {
        NAMED.get().map_or_else(|| self.0.new_trace_id(), trace_id)
    }

    fn new_span_id(&self) -> SpanId {
        NAMED.get().map_or_else(|| self.0.new_span_id(), span_id)
    }
}

fn context(name: &str) -> SpanContext {
    let id = id(name);
    SpanContext::new(
        trace_id(id),
        span_id(id),
        TraceFlags::SAMPLED,
        true,
        TraceState::default(),
    )
}

fn id(name: &str) -> Uuid {
    Uuid::new_v5(&Uuid::NAMESPACE_URL, format!("ecod:{name}").as_bytes())
}

fn trace_id(id: Uuid) -> TraceId {
    id.as_u128().into()
}

fn span_id(id: Uuid) -> SpanId {
    id.as_u64_pair().1.into()
}

/// A time of the node by the system's clock, which dates the end of spans and may have been set
/// since the node started.
fn on_this_clock(at: Timestamp) -> Option<SystemTime> {
    SystemTime::now().checked_sub(clock::now().since(at))
}
