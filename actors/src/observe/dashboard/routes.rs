//! What is answered to which request.

use std::convert::Infallible;
use std::fmt;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use axum::body::{Body, Bytes};
use axum::extract::{Request, State};
use axum::http::{HeaderValue, StatusCode, Uri, header};
use axum::middleware::{self, Next};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use axum::{Json, Router};
use ecod::time::Timestamp;
use futures_util::stream;

use super::access::{AccessDecision, AccessPolicy, HEADERS};
use super::assets::Asset;
use super::connection_limit::ConnectionSlot;
use super::metrics;
use super::node_monitor::NodeMonitor;
use super::response_cache::ResponseCache;
use super::snapshot::json;
use crate::platform::clock;
use crate::platform::throttle::Throttle;
use crate::telemetry::counters::Event;

/// What requests are answered with.
#[derive(Debug, Clone)]
pub(crate) struct HttpApi {
    monitor: Arc<NodeMonitor>,
    access: Arc<AccessPolicy>,
    answers: Arc<Mutex<Throttle>>,
    /// Apart, so that whoever may not look takes nothing from those who may.
    refusals: Arc<Mutex<Throttle>>,
    metrics: Arc<ResponseCache<Result<Bytes, fmt::Error>>>,
    landmarks: Bytes,
    max_viewers: usize,
}

/// Most requests at once, and time until one more: some tabs open together unhindered, a loop of requests is stopped.
const BURST: u32 = 512;
const STEADY: Duration = Duration::from_millis(5);

/// Least time between two readings of all metrics.
const METRICS_PAUSE: Duration = Duration::from_millis(100);

const JSON: &str = "application/json";

impl HttpApi {
    /// Half of the connections at most are for live pictures.
    pub(crate) fn new(monitor: Arc<NodeMonitor>, access: AccessPolicy, max_connections: usize) -> Self {
        let throttle = || Arc::new(Mutex::new(Throttle::new(BURST, STEADY, clock::now())));
        Self {
            access: Arc::new(access),
            answers: throttle(),
            refusals: throttle(),
            metrics: Arc::new(ResponseCache::new(METRICS_PAUSE)),
            landmarks: json(&monitor.sources().landmarks).into(),
            max_viewers: max_connections / 2,
            monitor,
        }
    }

    /// All paths. Health is answered to everybody, as it is asked for by machines that hold no secrets.
    pub(crate) fn router(self) -> Router {
        let guarded = Router::new()
            .route("/metrics", get(show_metrics))
            .route("/api/picture", get(show_picture))
            .route("/api/history", get(show_history))
            .route("/api/landmarks", get(show_landmarks))
            .route("/api/events", get(show_events))
            .fallback(show_asset)
            .layer(middleware::from_fn_with_state(self.clone(), guard));
        Router::new()
            .route("/healthz", get(|| async { "ok\n" }))
            .route("/readyz", get(show_readiness))
            .merge(guarded)
            .layer(middleware::map_response(with_headers))
            .with_state(self)
    }

    fn count(&self, event: Event) {
        self.monitor.sources().counters.count(event);
    }
}

/// Lets through what may pass, and as much of it as may.
async fn guard(State(site): State<HttpApi>, request: Request, next: Next) -> Response {
    let verdict = site.access.judge(request.uri(), request.headers());
    let is_allowed = matches!(verdict, AccessDecision::Allowed | AccessDecision::SignIn);
    let throttle = if is_allowed { &site.answers } else { &site.refusals };
    if !throttle.lock().unwrap_or_else(PoisonError::into_inner).allow(clock::now()) {
        site.count(Event::BrowserThrottled);
        return (StatusCode::TOO_MANY_REQUESTS, [(header::RETRY_AFTER, "1")], "too many requests\n").into_response();
    }
    if is_allowed && let Some(slot) = request.extensions().get::<Arc<ConnectionSlot>>() {
        slot.keep();
    }
    match verdict {
        AccessDecision::Allowed => next.run(request).await,
        AccessDecision::SignIn => {
            let location = HeaderValue::from_str(request.uri().path()).unwrap_or(HeaderValue::from_static("/"));
            let mut answer = (StatusCode::SEE_OTHER, [(header::LOCATION, location)]).into_response();
            if let Some(cookie) = site.access.cookie() {
                answer.headers_mut().insert(header::SET_COOKIE, cookie);
            }
            answer
        }
        AccessDecision::Unauthorized => {
            site.count(Event::BrowserRefused);
            let ask = [(header::WWW_AUTHENTICATE, "Bearer")];
            (StatusCode::UNAUTHORIZED, ask, "open this page with ?token=… or send Authorization: Bearer …\n")
                .into_response()
        }
        AccessDecision::ForeignHost => {
            site.count(Event::BrowserRefused);
            (StatusCode::MISDIRECTED_REQUEST, "this page is served on loopback only\n").into_response()
        }
    }
}

async fn with_headers(mut answer: Response) -> Response {
    for (name, value) in HEADERS {
        answer.headers_mut().entry(name).or_insert(value);
    }
    answer
}

async fn show_readiness(State(site): State<HttpApi>) -> Response {
    let readiness = site.monitor.readiness();
    let status = if readiness.ready { StatusCode::OK } else { StatusCode::SERVICE_UNAVAILABLE };
    (status, Json(readiness)).into_response()
}

async fn show_metrics(State(site): State<HttpApi>) -> Response {
    match site.metrics.get(|| metrics::metrics(&site.monitor).map(Bytes::from)).value {
        Ok(text) => ([(header::CONTENT_TYPE, metrics::CONTENT_TYPE)], text).into_response(),
        Err(error) => {
            tracing::warn!(%error, "metrics not written");
            StatusCode::INTERNAL_SERVER_ERROR.into_response()
        }
    }
}

async fn show_picture(State(site): State<HttpApi>) -> Response {
    ([(header::CONTENT_TYPE, JSON)], site.monitor.json()).into_response()
}

/// All of the history, or with `?since=` only later samples.
async fn show_history(State(site): State<HttpApi>, uri: Uri) -> Response {
    let since = uri.query().and_then(|query| query.strip_prefix("since=")).and_then(|time| time.parse().ok());
    let history = site.monitor.history_since(Timestamp(since.unwrap_or(0)));
    ([(header::CONTENT_TYPE, JSON)], history).into_response()
}

async fn show_landmarks(State(site): State<HttpApi>) -> Response {
    ([(header::CONTENT_TYPE, JSON)], site.landmarks).into_response()
}

/// Pictures as they are made. Each browser has the latest and what fits into its socket; what it is too slow for, it
/// never gets.
async fn show_events(State(site): State<HttpApi>) -> Response {
    if site.monitor.viewers() >= site.max_viewers {
        site.count(Event::BrowserRefused);
        return (StatusCode::SERVICE_UNAVAILABLE, "too many browsers\n").into_response();
    }
    let mut pictures = site.monitor.pictures();
    pictures.mark_unchanged();
    let first = Some(site.monitor.event());
    let events = stream::unfold((pictures, first), |(mut pictures, mut first)| async move {
        let event = match first.take() {
            Some(event) => event,
            None => {
                pictures.changed().await.ok()?;
                pictures.borrow_and_update().clone()
            }
        };
        Some((Ok::<Bytes, Infallible>(event), (pictures, first)))
    });
    ([(header::CONTENT_TYPE, "text/event-stream")], Body::from_stream(events)).into_response()
}

async fn show_asset(request: Request) -> Response {
    match Asset::find(request.uri().path()) {
        Some(Asset { content_type, content, .. }) => ([(header::CONTENT_TYPE, content_type)], content).into_response(),
        None => (StatusCode::NOT_FOUND, "nothing here\n").into_response(),
    }
}
