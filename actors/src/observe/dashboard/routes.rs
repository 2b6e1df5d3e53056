//! HTTP routes of the page, the API, metrics and health.

use std::convert::Infallible;
use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use axum::body::{Body, Bytes};
use axum::extract::State;
#[cfg(feature = "camera")]
use axum::extract::{DefaultBodyLimit, FromRequest, Request};
use axum::http::{StatusCode, Uri, header};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
#[cfg(feature = "camera")]
use axum::routing::post;
use axum::{Json, Router};
use ecod::leadership::readiness::Readiness;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use futures_util::{Stream, StreamExt, stream};
use serde::Serialize;
use tokio::sync::{Semaphore, watch};
#[cfg(feature = "camera")]
use tokio::task::spawn_blocking;
#[cfg(feature = "camera")]
use tokio::time::timeout;

use super::assets::Asset;
use super::floor_plan;
use super::metrics;
#[cfg(feature = "camera")]
use super::mount_answer::MountQuestion;
use super::node_monitor::NodeMonitor;
use super::node_sources::ShownCamera;
use super::response_cache::ResponseCache;
use super::snapshot::json;
use crate::observe::http::{HttpRefusal, PageAccess, PageGuard, with_headers};
use crate::platform::clock;
use crate::telemetry::counters::Event;

/// State of all routes.
#[derive(Debug)]
pub(crate) struct HttpApi {
    monitor: Arc<NodeMonitor>,
    metrics: ResponseCache<Result<Bytes, fmt::Error>>,
    /// One permit for each connection that stays open.
    streams: Arc<Semaphore>,
    /// One mount is fitted at a time.
    #[cfg(feature = "camera")]
    mounts: Arc<Semaphore>,
}

/// Minimum age of the metrics before they are read again.
const METRICS_MIN_AGE: Duration = Duration::from_millis(100);

/// Maximum size of the points of a mount: more than a user would click.
#[cfg(feature = "camera")]
const MAX_POINTS_BYTES: usize = 16 * 1024;

/// Maximum time for receiving the points of a mount.
#[cfg(feature = "camera")]
const BODY_TIMEOUT: Duration = Duration::from_secs(5);

/// Maximum age of the pose from which a mount is calculated.
#[cfg(feature = "camera")]
const MAX_POSE_AGE: Duration = Duration::from_secs(5);

impl HttpApi {
    /// At most half of the connections carry live snapshots.
    pub(crate) fn new(monitor: Arc<NodeMonitor>, max_connections: usize) -> Self {
        Self {
            metrics: ResponseCache::new(METRICS_MIN_AGE),
            streams: Arc::new(Semaphore::new(max_connections / 2)),
            #[cfg(feature = "camera")]
            mounts: Arc::new(Semaphore::new(1)),
            monitor,
        }
    }

    /// All routes. Health needs no token, because the monitoring systems that query it have no
    /// secrets.
    pub(crate) fn router(self, access: PageAccess) -> Router {
        let api = Arc::new(self);
        let guarded = Router::new()
            .route("/metrics", get(show_metrics))
            .route("/api/picture", get(show_snapshot))
            .route("/api/history", get(show_history))
            .route("/api/frame", get(show_frame))
            .route("/api/landmarks", get(show_landmarks))
            .route("/api/events", get(show_events))
            .route("/api/camera", get(show_camera))
            .route("/api/cameras", get(show_cameras))
            .route(floor_plan::PATH, get(show_floor_plan))
            .fallback(show_asset);
        #[cfg(feature = "camera")]
        let guarded = guarded.route(
            "/api/camera/mount",
            post(answer_mount).layer(DefaultBodyLimit::max(MAX_POINTS_BYTES)),
        );
        let counted = Arc::clone(&api);
        let guard = PageGuard::new(access, move |refusal| {
            counted.count(match refusal {
                HttpRefusal::Refused => Event::BrowserRefused,
                HttpRefusal::Throttled => Event::BrowserThrottled,
            });
        });
        let routes = Router::new()
            .route("/healthz", get(|| async { "ok\n" }))
            .route("/readyz", get(show_readiness))
            .merge(guard.protect(guarded));
        with_headers(routes).with_state(api)
    }

    fn count(&self, event: Event) {
        self.monitor.sources.counters.count(event);
    }

    /// The camera of `?name=`, or the first; else an answer with the names.
    fn camera(&self, uri: &Uri) -> Result<&ShownCamera, (StatusCode, String)> {
        let sources = &self.monitor.sources;
        let name = value_in(uri, "name=");
        sources.camera(name).ok_or_else(|| {
            let names: Vec<_> = sources
                .cameras
                .iter()
                .filter_map(|camera| camera.name.as_deref())
                .collect();
            let reason = match name.filter(|_| !sources.cameras.is_empty()) {
                None => "this node shows no camera\n".to_owned(),
                Some(name) if names.is_empty() => {
                    format!("no camera {name:?}: the only one has no name\n")
                }
                Some(name) => format!("no camera {name:?}: there are {}\n", names.join(", ")),
            };
            (StatusCode::NOT_FOUND, reason)
        })
    }

    /// Server-sent events on a connection that stays open, unless there are too many of these.
    fn stream(&self, events: impl Stream<Item = Bytes> + Send + 'static) -> Response {
        let Ok(permit) = Arc::clone(&self.streams).try_acquire_owned() else {
            self.count(Event::BrowserRefused);
            return (StatusCode::SERVICE_UNAVAILABLE, "too many browsers\n").into_response();
        };
        let events = events.map(move |event| {
            let _held = &permit;
            Ok::<Bytes, Infallible>(event)
        });
        typed("text/event-stream", Body::from_stream(events))
    }
}

type Api = State<Arc<HttpApi>>;

/// Answer of `/readyz`.
#[derive(Debug, Serialize)]
struct ReadinessAnswer {
    #[serde(flatten)]
    readiness: Readiness,
    /// Expected nodes that do not answer.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    missing: Vec<MissingAnswer>,
}

/// An expected node that does not answer.
#[derive(Debug, Serialize)]
struct MissingAnswer {
    node: NodeName,
    /// Time at which it last answered, by this node's clock.
    last_seen_us: Timestamp,
    missing_s: u64,
}

async fn show_readiness(State(api): Api) -> Response {
    let readiness = api.monitor.readiness();
    let now = clock::now();
    let missing = api
        .monitor
        .sources
        .live_state
        .expected()
        .missing()
        .into_iter()
        .map(|node| MissingAnswer {
            missing_s: now.since(node.last_seen).as_secs(),
            last_seen_us: node.last_seen,
            node: node.name,
        });
    let status = if readiness.ready {
        StatusCode::OK
    } else {
        StatusCode::SERVICE_UNAVAILABLE
    };
    let answer = ReadinessAnswer {
        readiness,
        missing: missing.collect(),
    };
    (status, Json(answer)).into_response()
}

async fn show_metrics(State(api): Api) -> Response {
    match api
        .metrics
        .get(|| metrics::metrics(&api.monitor).map(Bytes::from))
        .value
    {
        Ok(text) => typed(metrics::CONTENT_TYPE, text),
        Err(error) => {
            tracing::warn!(%error, "cannot write metrics");
            StatusCode::INTERNAL_SERVER_ERROR.into_response()
        }
    }
}

async fn show_snapshot(State(api): Api) -> Response {
    typed(JSON, api.monitor.json())
}

/// The history, with the samples and events after `?since=` only.
async fn show_history(State(api): Api, uri: Uri) -> Response {
    typed(
        JSON,
        api.monitor
            .observed()
            .history
            .json_since(time_in(&uri, "since=").unwrap_or_default()),
    )
}

/// The map that was the newest at `?at=`.
async fn show_frame(State(api): Api, uri: Uri) -> Response {
    let frame = time_in(&uri, "at=").and_then(|at| {
        api.monitor
            .observed()
            .history
            .timeline
            .frames
            .at(at)
            .map(Vec::from)
    });
    frame.map_or_else(
        || StatusCode::NOT_FOUND.into_response(),
        |frame| typed(JSON, frame),
    )
}

fn time_in(uri: &Uri, key: &str) -> Option<Timestamp> {
    value_in(uri, key)?.parse().ok().map(Timestamp)
}

fn value_in<'a>(uri: &'a Uri, key: &str) -> Option<&'a str> {
    uri.query()?
        .split('&')
        .find_map(|pair| pair.strip_prefix(key))
}

async fn show_landmarks(State(api): Api) -> Response {
    typed(JSON, json(&api.monitor.sources.landmarks()))
}

/// Snapshots as they are taken. A browser that is too slow for one gets the next.
async fn show_events(State(api): Api) -> Response {
    let monitor = &api.monitor;
    api.stream(latest(monitor.snapshots(), Some(monitor.event())))
}

/// Pictures of a camera of the node as they are taken.
async fn show_camera(State(api): Api, uri: Uri) -> Response {
    match api.camera(&uri) {
        Ok(camera) => api.stream(latest(camera.feed.pictures(), None)),
        Err(refusal) => refusal.into_response(),
    }
}

/// Pictures of all cameras on one connection, because a browser opens only a few to a host;
/// `?of=` selects one camera. The `id` of each event is the name under which the camera reports.
/// The stream ends when the cameras of other nodes change, and a browser connects again.
async fn show_cameras(State(api): Api, uri: Uri) -> Response {
    let sources = &api.monitor.sources;
    let mut further = sources.further_cameras.clone();
    further.mark_unchanged();
    let wanted = value_in(&uri, "of=");
    let mut cameras = sources.pictured_cameras();
    cameras.retain(|camera| wanted.is_none_or(|name| camera.reporter.as_str() == name));
    if cameras.is_empty() {
        return (StatusCode::NOT_FOUND, "no such camera\n").into_response();
    }
    let pictures = cameras.into_iter().map(|camera| {
        let id = format!("id: {}\n", camera.reporter);
        latest(camera.feed.pictures(), None)
            .map(move |picture| Bytes::from([id.as_bytes(), &picture].concat()))
            .boxed()
    });
    api.stream(stream::select_all(pictures).take_until(async move { further.changed().await }))
}

/// The mount of a camera, from points that were clicked. Other sites' pages cannot send this
/// request, because the content type must be JSON.
#[cfg(feature = "camera")]
async fn answer_mount(State(api): Api, request: Request) -> Response {
    let camera = match api.camera(request.uri()) {
        Ok(camera) => camera.clone(),
        Err(refusal) => return refusal.into_response(),
    };
    let question = match timeout(
        BODY_TIMEOUT,
        Json::<MountQuestion>::from_request(request, &()),
    )
    .await
    {
        Ok(Ok(Json(question))) => question,
        Ok(Err(refusal)) => return refusal.into_response(),
        Err(_) => {
            return (StatusCode::REQUEST_TIMEOUT, "the points did not come\n").into_response();
        }
    };
    let pose = api
        .monitor
        .sources
        .live_state
        .pose_since(&camera.reporter, clock::now() - MAX_POSE_AGE);
    let Some(pose) = pose else {
        let reason = format!(
            "{} reports no pose at present: wait for it, or see its troubles\n",
            camera.reporter
        );
        return (StatusCode::CONFLICT, reason).into_response();
    };
    let Ok(permit) = Arc::clone(&api.mounts).acquire_owned().await else {
        return StatusCode::SERVICE_UNAVAILABLE.into_response();
    };
    let answered = spawn_blocking(move || {
        let _permit = permit;
        question.answer(&camera.setup, &pose.into())
    });
    match answered.await {
        Ok(Ok(mount)) => typed(JSON, json(&mount)),
        Ok(Err(reason)) => {
            (StatusCode::UNPROCESSABLE_ENTITY, format!("{reason}\n")).into_response()
        }
        Err(error) => {
            tracing::warn!(%error, "cannot fit a mount for a browser");
            StatusCode::INTERNAL_SERVER_ERROR.into_response()
        }
    }
}

/// The image under the map.
async fn show_floor_plan(State(api): Api) -> Response {
    match &api.monitor.sources.floor_plan {
        Some(plan) => typed(plan.content_type, plan.content.clone()),
        None => (StatusCode::NOT_FOUND, "this node shows no floor plan\n").into_response(),
    }
}

/// The first event, and then the latest whenever there is room.
fn latest(
    mut events: watch::Receiver<Bytes>,
    first: Option<Bytes>,
) -> impl Stream<Item = Bytes> + Send + 'static {
    events.mark_unchanged();
    stream::unfold((events, first), |(mut events, mut first)| async move {
        let event = match first.take() {
            Some(event) => event,
            None => {
                events.changed().await.ok()?;
                events.borrow_and_update().clone()
            }
        };
        Some((event, (events, first)))
    })
}

async fn show_asset(uri: Uri) -> Response {
    match Asset::find(uri.path()) {
        Some(asset) => typed(asset.content_type, asset.content),
        None => (StatusCode::NOT_FOUND, "nothing here\n").into_response(),
    }
}

const JSON: &str = "application/json";

fn typed(content_type: &'static str, content: impl Into<Body>) -> Response {
    ([(header::CONTENT_TYPE, content_type)], content.into()).into_response()
}
