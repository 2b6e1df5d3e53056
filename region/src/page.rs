//! Page, API, metrics and health of a region over HTTP.

mod assets;
mod metrics;
mod routes;
mod viewers;

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context;
use ecod::model::names::NodeName;
use ecod::model::quadkey::Quadkey;
use ecod::model::time::Timestamp;
use ecod_actors::observe::http::{ConnectionLimit, PageAccess, accept};
use ecod_actors::platform::clock;
use ecod_actors::platform::secret::Secret;
use tokio::net::TcpListener;

use crate::reader::RegionState;
use metrics::PageCounts;
use routes::RegionApi;
use viewers::Viewers;

/// The page of a region, with its listening socket.
#[derive(Debug)]
pub struct RegionPage {
    listener: TcpListener,
    address: SocketAddr,
    api: Arc<RegionApi>,
    access: PageAccess,
}

/// Default address and port of the page.
pub const DEFAULT_ADDRESS: &str = "127.0.0.1:8090";

/// Maximum number of connections. A browser opens one a second, briefly.
const MAX_CONNECTIONS: usize = 64;

/// Time between two removals of outdated state.
const UPKEEP_PERIOD: Duration = Duration::from_secs(1);

impl RegionPage {
    /// Starts to listen; the maps of the tiles of `watched` are always read.
    ///
    /// # Errors
    /// Returns an error if the address cannot be bound.
    pub async fn listen(
        address: SocketAddr,
        token: Option<&Secret>,
        watched: Vec<Quadkey>,
        state: Arc<RegionState>,
    ) -> anyhow::Result<Self> {
        let listener = TcpListener::bind(address)
            .await
            .with_context(|| format!("cannot listen at {address}"))?;
        let address = listener.local_addr()?;
        let access = PageAccess::new(token, address, &NodeName::from_static("region"));
        let api = Arc::new(RegionApi::new(state, Viewers::new(watched)));
        Ok(Self {
            listener,
            address,
            api,
            access,
        })
    }

    /// The address, with the port that was given.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Serves the page; the future does not end.
    pub async fn serve(self) {
        let router = routes::router(&self.api, self.access);
        let limit = ConnectionLimit::new(MAX_CONNECTIONS);
        tokio::join!(
            accept(&self.listener, &limit, &router, || PageCounts::count(
                &self.api.counts.refused
            )),
            upkeep(&self.api)
        );
    }
}

/// Stops reading tiles that are out of view, and drops their maps.
async fn upkeep(api: &RegionApi) {
    loop {
        let now: Timestamp = clock::now();
        api.ask(now);
        api.state.town().drop_old_maps(now);
        tokio::time::sleep(UPKEEP_PERIOD).await;
    }
}
