//! HTTP listener on a thread of its own, so that browsers cannot delay the cell.

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

use axum::Router;
use hyper::Request;
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper::service::{Service, service_fn};
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{oneshot, watch};
use tokio_io_timeout::TimeoutStream;

use super::access::PageAccess;
use super::config::{DEFAULT_ADDRESS, DashboardConfig};
use super::connection_limit::{AdmittedConnection, ConnectionLimit, ConnectionSlot};
use super::node_monitor::NodeMonitor;
use super::routes::HttpApi;
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

/// Wait after a connection could not be accepted, most likely for want of file descriptors.
const ACCEPT_RETRY: Duration = Duration::from_millis(100);

/// Maximum time for the head of a request.
const HEAD_TIMEOUT: Duration = Duration::from_secs(5);

/// Maximum time in which a browser reads nothing of an answer.
const WRITE_TIMEOUT: Duration = Duration::from_secs(10);

/// Maximum bytes that wait for one browser, beside its socket's buffer.
const MAX_BUFFER_BYTES: usize = 64 * 1024;

impl Server {
    /// Starts the thread; `bound` receives the address once the server listens.
    ///
    /// # Errors
    /// When the operating system gives no thread.
    pub(crate) fn start(
        config: DashboardConfig,
        monitor: Arc<NodeMonitor>,
        bound: watch::Sender<Option<SocketAddr>>,
    ) -> io::Result<Self> {
        let (stop, stopped) = oneshot::channel();
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
        let thread = std::thread::Builder::new().name("dashboard".into()).spawn(move || {
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
        Ok(Self { stop: Some(stop), thread: Some(thread) })
    }

    /// True if the thread ended by itself.
    pub(crate) fn has_ended(&self) -> bool {
        self.thread.as_ref().is_none_or(JoinHandle::is_finished)
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        drop(self.stop.take());
        if self.thread.take().is_some_and(|thread| thread.join().is_err()) {
            tracing::warn!("dashboard thread panicked");
        }
    }
}

async fn serve(config: &DashboardConfig, monitor: &Arc<NodeMonitor>, bound: &watch::Sender<Option<SocketAddr>>) {
    // Browsers may know the port of an earlier run.
    let wanted = bound.borrow().or(config.listen);
    let listener = match wanted {
        Some(address) => listen(address, monitor).await,
        None => listen_anywhere(monitor).await,
    };
    let Ok(address) = listener.local_addr() else { return };
    let access = PageAccess::new(config.token.as_ref(), address, &monitor.sources.node.name);
    tracing::info!(url = %format_args!("http://{address}/"), token = config.token.is_some(), "dashboard serves");
    bound.send_replace(Some(address));
    let router = HttpApi::new(Arc::clone(monitor), access, config.max_connections).router();
    let limit = ConnectionLimit::new(config.max_connections);
    loop {
        let (stream, from) = match listener.accept().await {
            Ok(accepted) => accepted,
            Err(error) => {
                tracing::debug!(%error, "no connection accepted");
                tokio::time::sleep(ACCEPT_RETRY).await;
                continue;
            }
        };
        let admitted = limit.admit(from.ip());
        if admitted.as_ref().is_none_or(|admitted| admitted.displaces) {
            monitor.sources.counters.count(Event::BrowserRefused);
        }
        let Some(AdmittedConnection { slot, displaced, .. }) = admitted else { continue };
        let router = router.clone();
        tokio::spawn(async move {
            tokio::select! {
                answered = answer(stream, Arc::new(slot), router) => if let Err(error) = answered {
                    tracing::debug!(%error, "connection of a browser failed");
                },
                _ = displaced => tracing::debug!(%from, "connection of a browser displaced by another"),
            }
        });
    }
}

/// Answers one request and closes the connection: an idle one would occupy a slot.
async fn answer(stream: TcpStream, slot: Arc<ConnectionSlot>, router: Router) -> hyper::Result<()> {
    if let Err(error) = stream.set_nodelay(true) {
        tracing::debug!(%error, "cannot set TCP_NODELAY, small packets may be delayed");
    }
    let mut stream = TimeoutStream::new(stream);
    stream.set_write_timeout(Some(WRITE_TIMEOUT));
    let routed = TowerToHyperService::new(router);
    let service = service_fn(|mut request: Request<Incoming>| {
        request.extensions_mut().insert(Arc::clone(&slot));
        routed.call(request)
    });
    http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(HEAD_TIMEOUT)
        .keep_alive(false)
        .max_buf_size(MAX_BUFFER_BYTES)
        .serve_connection(TokioIo::new(Box::pin(stream)), service)
        .await
}

/// Listens at the default address or, if another node of the machine does, on a free port of loopback.
async fn listen_anywhere(monitor: &NodeMonitor) -> TcpListener {
    match TcpListener::bind(DEFAULT_ADDRESS).await {
        Ok(listener) => listener,
        Err(error) => {
            tracing::info!(address = %DEFAULT_ADDRESS, %error, "dashboard takes a free port, key `dashboard.listen` is not set");
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
                    tracing::warn!(%address, %error, "dashboard cannot listen, key `dashboard.listen`; trying again");
                }
                monitor.sources.counters.count(Event::DashboardNotBound);
            }
        }
        tokio::time::sleep(wait).await;
        wait = (2 * wait).min(RETRY_MAX);
    }
}
