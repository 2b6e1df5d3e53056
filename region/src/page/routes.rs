//! HTTP routes of a region.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use axum::body::Body;
use axum::extract::State;
use axum::http::{StatusCode, Uri, header};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use axum::{Extension, Json, Router};
use ecod::model::time::Timestamp;
use ecod_actors::observe::http::{BrowserHost, HttpRefusal, PageAccess, PageGuard, with_headers};
use ecod_actors::platform::clock;
use serde::Serialize;

use super::assets;
use super::metrics::{self, PageCounts};
use super::viewers::{MapsWithheld, ViewerId, Viewers};
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
    /// True while the reader is logged in at the broker.
    broker_up: bool,
    /// Why the reader is not logged in, or the filters that the broker refuses.
    trouble: Option<String>,
    /// Why the region does not subscribe to the maps in this view.
    maps_withheld: Option<String>,
    #[serde(flatten)]
    town: TownView,
}

/// Maximum number of tiles that a view requests.
const MAX_TILES_OF_VIEW: usize = 16;

/// Maximum length of a viewer's name.
const MAX_NAME_BYTES: usize = 64;

/// Bounds of the map's projection in degrees.
const EARTH: GeographicBounds = GeographicBounds {
    west: -180.0,
    south: -85.06,
    east: 180.0,
    north: 85.06,
};

impl RegionApi {
    pub(super) fn new(state: Arc<RegionState>, viewers: Viewers) -> Self {
        Self {
            state,
            counts: PageCounts::default(),
            viewers: Mutex::new(viewers),
            started_at: clock::now(),
        }
    }

    /// Requests the tiles of all viewers, one of which now shows `bounds`.
    ///
    /// # Errors
    /// Returns the reason why its maps are not read.
    pub(super) fn set_view(
        &self,
        viewer: &ViewerId,
        bounds: &GeographicBounds,
        now: Timestamp,
    ) -> Result<(), MapsWithheld> {
        self.viewers()
            .set_view(viewer.clone(), bounds.tiles(MAX_TILES_OF_VIEW), now)?;
        self.ask(now).remove(viewer).map_or(Ok(()), Err)
    }

    /// Requests the tiles of all viewers; returns the viewers whose maps are not read.
    pub(super) fn ask(&self, now: Timestamp) -> BTreeMap<ViewerId, MapsWithheld> {
        let mut viewers = self.viewers();
        let town = self.state.town();
        let (tiles, withheld) = viewers.tiles(|tiles| town.count_within(tiles), now);
        self.state.ask(tiles);
        withheld
    }

    fn viewers(&self) -> MutexGuard<'_, Viewers> {
        self.viewers.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

type RegionRequest = State<Arc<RegionApi>>;

/// All routes. Health needs no token, because the monitoring systems that query it have no secrets.
pub(super) fn router(api: &Arc<RegionApi>, access: PageAccess) -> Router {
    let counted = Arc::clone(api);
    let guard = PageGuard::new(access, move |refusal| {
        PageCounts::count(match refusal {
            HttpRefusal::Refused => &counted.counts.refused,
            HttpRefusal::Throttled => &counted.counts.throttled,
        });
    });
    let guarded = Router::new()
        .route("/metrics", get(show_metrics))
        .route("/api/view", get(show_view))
        .fallback(show_asset);
    let routes = Router::new()
        .route("/healthz", get(show_health))
        .merge(guard.protect(guarded));
    with_headers(routes).with_state(Arc::clone(api))
}

/// Health: the reader is logged in at the broker and may read.
async fn show_health(State(api): RegionRequest) -> Response {
    let link = api.state.link();
    match link.trouble {
        None if link.is_up => (StatusCode::OK, "ok\n").into_response(),
        trouble => {
            let trouble = trouble.unwrap_or_else(|| "no connection to the region's broker".into());
            (StatusCode::SERVICE_UNAVAILABLE, format!("{trouble}\n")).into_response()
        }
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

/// The town within `?bounds=WEST,SOUTH,EAST,NORTH`, whose maps are read from now on; without
/// bounds, the whole town. `viewer=NAME` distinguishes viewers of one host: each viewer has one
/// view.
async fn show_view(
    State(api): RegionRequest,
    Extension(host): Extension<BrowserHost>,
    uri: Uri,
) -> Response {
    let query = uri.query().unwrap_or_default();
    let parameter = |name: &str| {
        query
            .split('&')
            .find_map(|pair| pair.strip_prefix(name)?.strip_prefix('='))
    };
    let bounds = match parameter("bounds") {
        None => EARTH,
        Some(text) => match text.replace("%2C", ",").parse() {
            Ok(bounds) => bounds,
            Err(error) => return (StatusCode::BAD_REQUEST, format!("{error}\n")).into_response(),
        },
    };
    let name = parameter("viewer")
        .filter(|name| name.len() <= MAX_NAME_BYTES)
        .unwrap_or_default();
    let now = clock::now();
    let viewed = api.set_view(
        &ViewerId {
            host: host.0,
            name: name.to_owned(),
        },
        &bounds,
        now,
    );
    let link = api.state.link();
    let read = api.state.tiles();
    let town = api.state.town().view(&bounds, &read, now);
    let maps_withheld = viewed.err().map(MapsWithheld::in_words);
    Json(ViewAnswer {
        broker_up: link.is_up,
        trouble: link.trouble,
        maps_withheld,
        town,
    })
    .into_response()
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
