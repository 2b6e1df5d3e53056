//! HTTP listener on a thread of its own, so that browsers cannot delay the cell.

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

use tokio::net::TcpListener;
use tokio::sync::{oneshot, watch};

use super::config::{DEFAULT_ADDRESS, DashboardConfig};
use super::node_monitor::NodeMonitor;
use super::routes::HttpApi;
use crate::observe::http::{ConnectionLimit, PageAccess, accept};
use crate::telemetry::counters::Event;

/// A running HTTP server; stops when dropped.
#[derive(Debug)]
pub struct Server {
    stop: Option<oneshot::Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

/// First and longest wait before an address in use is tried again.
const RETRY_MIN: Duration = Duration::from_millis(500);
const RETRY_MAX: Duration = Duration::from_secs(10);

impl Server {
    /// Starts the thread; `bound` receives the address once the server listens.
    ///
    /// # Errors
    /// Returns an error if the operating system gives no thread.
    pub(crate) fn start(
        config: DashboardConfig,
        monitor: Arc<NodeMonitor>,
        bound: watch::Sender<Option<SocketAddr>>,
    ) -> io::Result<Self> {
        let (stop, stopped) = oneshot::channel();
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()?;
        let thread = std::thread::Builder::new()
            .name("dashboard".into())
            .spawn(move || {
                runtime.block_on(async {
                    tokio::select! {
                        () = monitor.run() => {}
                        () = serve(&config, &monitor, &bound) => {}
                        // Ends when the sender is dropped, too.
                        _ = stopped => {}
                    }
                });
                runtime.shutdown_background();
            })?;
        Ok(Self {
            stop: Some(stop),
            thread: Some(thread),
        })
    }

    /// True if the thread ended by itself.
    pub(crate) fn has_ended(&self) -> bool {
        self.thread.as_ref().is_none_or(JoinHandle::is_finished)
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        drop(self.stop.take());
        if self
            .thread
            .take()
            .is_some_and(|thread| thread.join().is_err())
        {
            tracing::warn!("dashboard thread panicked");
        }
    }
}

async fn serve(
    config: &DashboardConfig,
    monitor: &Arc<NodeMonitor>,
    bound: &watch::Sender<Option<SocketAddr>>,
) {
    // Browsers may use the port of an earlier run.
    let wanted = bound.borrow().or(config.listen);
    let listener = match wanted {
        Some(address) => listen(address, monitor).await,
        None => listen_anywhere(monitor).await,
    };
    let Ok(address) = listener.local_addr() else {
        return;
    };
    let access = PageAccess::new(config.token.as_ref(), address, &monitor.sources.node.name);
    tracing::info!(url = %format_args!("http://{address}/"), token = config.token.is_some(), "dashboard serves");
    bound.send_replace(Some(address));
    let router = HttpApi::new(Arc::clone(monitor), config.max_connections).router(access);
    let limit = ConnectionLimit::new(config.max_connections);
    accept(&listener, &limit, &router, || {
        monitor.sources.counters.count(Event::BrowserRefused);
    })
    .await;
}

/// Listens at the default address or, if another node of the machine uses it, on a free port of
/// loopback.
async fn listen_anywhere(monitor: &NodeMonitor) -> TcpListener {
    match TcpListener::bind(DEFAULT_ADDRESS).await {
        Ok(listener) => listener,
        Err(error) => {
            tracing::warn!(
                address = %DEFAULT_ADDRESS, %error,
                "another program uses this port: the page takes a free one; set `dashboard.listen` if it needs a fixed port"
            );
            listen(SocketAddr::new(DEFAULT_ADDRESS.ip(), 0), monitor).await
        }
    }
}

/// Listens as soon as the address is free.
async fn listen(address: SocketAddr, monitor: &NodeMonitor) -> TcpListener {
    let mut wait = RETRY_MIN;
    loop {
        match TcpListener::bind(address).await {
            Ok(listener) => return listener,
            Err(error) => {
                if wait == RETRY_MIN {
                    tracing::warn!(%address, %error, "dashboard cannot listen, key `dashboard.listen`: trying again; set another address, or stop the program that uses this one");
                }
                monitor.sources.counters.count(Event::DashboardNotBound);
            }
        }
        tokio::time::sleep(wait).await;
        wait = (2 * wait).min(RETRY_MAX);
    }
}
