//! HTTP routes of a region.

use std::sync::{Arc, Mutex, PoisonError};

use axum::body::Body;
use axum::extract::State;
use axum::http::{StatusCode, Uri, header};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use axum::{Json, Router};
use ecod::model::time::Timestamp;
use ecod_actors::observe::http::{HttpRefusal, PageAccess, PageGuard, with_headers};
use ecod_actors::platform::clock;
use serde::Serialize;

use super::assets;
use super::metrics::{self, PageCounts};
use super::viewers::Viewers;
use crate::reader::RegionState;
use crate::town::{GeographicBounds, TownView};

/// State of all routes.
#[derive(Debug)]
pub(super) struct RegionApi {
    pub(super) state: Arc<RegionState>,
    pub(super) counts: PageCounts,
    viewers: Mutex<Viewers>,
    started_at: Timestamp,
}

/// Answer to `/api/view`.
#[derive(Debug, Serialize)]
struct ViewAnswer {
    /// True while the broker lets the reader in.
    broker_up: bool,
    /// The reason why it does not, or filters that it refuses.
    trouble: Option<String>,
    /// Number of cells in a view above which their maps are not read.
    max_cells_read: usize,
    #[serde(flatten)]
    town: TownView,
}

/// Maximum number of tiles that a view asks for.
const MAX_TILES_OF_VIEW: usize = 16;

/// Number of cells in a view above which their maps are not read: at 2 Hz and 2 kB, 8 MB/s.
const MAX_CELLS_READ: usize = 2000;

/// The whole map.
const EARTH: GeographicBounds = GeographicBounds { west: -180.0, south: -85.06, east: 180.0, north: 85.06 };

impl RegionApi {
    pub(super) fn new(state: Arc<RegionState>, viewers: Viewers) -> Self {
        Self { state, counts: PageCounts::default(), viewers: Mutex::new(viewers), started_at: clock::now() }
    }

    /// Asks for the tiles of all viewers, of whom one looks at `bounds` now.
    pub(super) fn ask(&self, bounds: Option<&GeographicBounds>, now: Timestamp) {
        let tiles = bounds.map(|bounds| bounds.tiles(MAX_TILES_OF_VIEW)).unwrap_or_default();
        let is_read = self.state.town().count_within(&tiles) <= MAX_CELLS_READ;
        let mut viewers = self.viewers.lock().unwrap_or_else(PoisonError::into_inner);
        if is_read {
            viewers.look(&tiles, now);
        } else {
            viewers.forget(&tiles);
        }
        self.state.ask(viewers.tiles(now));
    }
}

type RegionRequest = State<Arc<RegionApi>>;

/// All routes. Health needs no token, as the machines that ask hold no secrets.
pub(super) fn router(api: &Arc<RegionApi>, access: PageAccess) -> Router {
    let counted = Arc::clone(api);
    let guard = PageGuard::new(access, move |refusal| {
        PageCounts::count(match refusal {
            HttpRefusal::Refused => &counted.counts.refused,
            HttpRefusal::Throttled => &counted.counts.throttled,
        });
    });
    let guarded =
        Router::new().route("/metrics", get(show_metrics)).route("/api/view", get(show_view)).fallback(show_asset);
    let routes = Router::new().route("/healthz", get(show_health)).merge(guard.protect(guarded));
    with_headers(routes).with_state(Arc::clone(api))
}

/// Health: the broker lets the reader in.
async fn show_health(State(api): RegionRequest) -> Response {
    match api.state.link().is_up {
        true => (StatusCode::OK, "ok\n").into_response(),
        false => (StatusCode::SERVICE_UNAVAILABLE, "no connection to the region's broker\n").into_response(),
    }
}

async fn show_metrics(State(api): RegionRequest) -> Response {
    match metrics::metrics(&api.state, &api.counts, api.started_at) {
        Ok(text) => typed(metrics::CONTENT_TYPE, text),
        Err(error) => {
            tracing::warn!(%error, "cannot write metrics");
            StatusCode::INTERNAL_SERVER_ERROR.into_response()
        }
    }
}

/// The town within `?bounds=WEST,SOUTH,EAST,NORTH`, whose maps are read from now on; without bounds, all of it.
async fn show_view(State(api): RegionRequest, uri: Uri) -> Response {
    let query = uri.query().unwrap_or_default();
    let bounds = match query.split('&').find_map(|pair| pair.strip_prefix("bounds=")) {
        None => EARTH,
        Some(text) => match text.replace("%2C", ",").parse() {
            Ok(bounds) => bounds,
            Err(error) => return (StatusCode::BAD_REQUEST, format!("{error}\n")).into_response(),
        },
    };
    let now = clock::now();
    api.ask(Some(&bounds), now);
    let (link, asked) = (api.state.link(), api.state.tiles());
    let town = api.state.town().view(&bounds, &asked, now);
    let answer = ViewAnswer { broker_up: link.is_up, trouble: link.trouble, max_cells_read: MAX_CELLS_READ, town };
    Json(answer).into_response()
}

async fn show_asset(uri: Uri) -> Response {
    match assets::find(uri.path()) {
        Some((content_type, content)) => typed(content_type, content),
        None => (StatusCode::NOT_FOUND, "nothing here\n").into_response(),
    }
}

fn typed(content_type: &'static str, content: impl Into<Body>) -> Response {
    ([(header::CONTENT_TYPE, content_type)], content.into()).into_response()
}
