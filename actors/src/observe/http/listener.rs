//! Connections of browsers: accepted, limited, answered once each.

use std::net::IpAddr;
use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use hyper::Request;
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper::service::{Service, service_fn};
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::net::{TcpListener, TcpStream};
use tokio_io_timeout::TimeoutStream;

use super::connection_limit::{AdmittedConnection, ConnectionLimit, ConnectionSlot};
use crate::platform::throttle::host_network;

/// The host of a browser, as hosts are counted: an IPv4 address or an IPv6 /64 network. Every
/// request has it as an extension.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BrowserHost(pub IpAddr);

/// Wait after a connection could not be accepted, most likely because file descriptors ran out.
const ACCEPT_RETRY: Duration = Duration::from_millis(100);

/// Maximum time for the head of a request.
const HEAD_TIMEOUT: Duration = Duration::from_secs(5);

/// Maximum time in which a browser reads no byte of an answer.
const WRITE_TIMEOUT: Duration = Duration::from_secs(10);

/// Maximum number of bytes queued for one browser, in addition to its socket's buffer.
const MAX_BUFFER_BYTES: usize = 64 * 1024;

/// Accepts connections within a limit and does not return; `count_refused` is called for each
/// connection that gets no slot or loses it.
pub async fn accept(
    listener: &TcpListener,
    limit: &ConnectionLimit,
    router: &Router,
    count_refused: impl Fn(),
) {
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
            count_refused();
        }
        let Some(AdmittedConnection {
            slot, displaced, ..
        }) = admitted
        else {
            continue;
        };
        let router = router.clone();
        tokio::spawn(async move {
            tokio::select! {
                answered = answer(stream, BrowserHost(host_network(from.ip())), Arc::new(slot), router) => if let Err(error) = answered {
                    tracing::debug!(%error, "connection of a browser failed");
                },
                _ = displaced => tracing::debug!(%from, "connection of a browser displaced by another"),
            }
        });
    }
}

/// Answers one request and closes the connection, because an idle connection would occupy a slot.
async fn answer(
    stream: TcpStream,
    host: BrowserHost,
    slot: Arc<ConnectionSlot>,
    router: Router,
) -> hyper::Result<()> {
    if let Err(error) = stream.set_nodelay(true) {
        tracing::debug!(%error, "cannot set TCP_NODELAY, small packets may be delayed");
    }
    let mut stream = TimeoutStream::new(stream);
    stream.set_write_timeout(Some(WRITE_TIMEOUT));
    let routed = TowerToHyperService::new(router);
    let service = service_fn(|mut request: Request<Incoming>| {
        request.extensions_mut().insert(Arc::clone(&slot));
        request.extensions_mut().insert(host);
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
