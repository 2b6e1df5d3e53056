//! MQTT over WebSocket (MQTT 5, section 6) on the same port; the first byte of a client
//! distinguishes the protocols.

use std::io::{self, Cursor, ErrorKind};
use std::net::IpAddr;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::task::{Context, Poll, ready};

use bytes::Bytes;
use futures_util::{Sink, Stream};
use tokio::io::{
    AsyncBufReadExt, AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt, BufReader, ReadBuf,
};
use tokio_tungstenite::tungstenite::handshake::server::{ErrorResponse, Request, Response};
use tokio_tungstenite::tungstenite::http::header::{HOST, ORIGIN, SEC_WEBSOCKET_PROTOCOL};
use tokio_tungstenite::tungstenite::http::{HeaderMap, HeaderName, HeaderValue, StatusCode, Uri};
use tokio_tungstenite::tungstenite::protocol::WebSocketConfig;
use tokio_tungstenite::tungstenite::{Error, Message};
use tokio_tungstenite::{WebSocketStream, accept_hdr_async_with_config};
use tokio_util::io::InspectReader;

use super::client_rejection::ClientRejection;

/// First byte of an HTTP request. MQTT clients start with a different byte.
pub(super) const FIRST_BYTE: u8 = b'G';

/// Maximum bytes of an HTTP request, and of the buffer that reads it.
const MAX_REQUEST_BYTES: u64 = 16 * 1024;
const REQUEST_BUFFER_BYTES: usize = 1024;

/// Answer to a browser that requests a page (RFC 9110, section 15.5.22).
const NO_PAGE: &str = "no page is here: programs speak MQTT at this port, and pages MQTT over WebSocket. The node's own page is at \
                       `dashboard.listen`, http://127.0.0.1:8080/ by default\n";

/// Maximum bytes of one WebSocket message: it is held until it is complete. An MQTT packet may be
/// spread over several.
const MAX_MESSAGE_BYTES: usize = 64 * 1024;

/// Maximum bytes of a message to the client, and of the buffers in each direction.
const CHUNK_BYTES: usize = 8 * 1024;

/// Maximum bytes of consecutive frames without content, which include the pings of a client that is
/// otherwise silent for days.
const MAX_EMPTY_BYTES: usize = 2 * MAX_MESSAGE_BYTES;

/// The bytes of MQTT within a WebSocket.
pub(super) struct WebSocketBytes<S> {
    socket: WebSocketStream<S>,
    received: Bytes,
    /// A client's fault that is reported once the preceding bytes have been read.
    fault: Option<io::Error>,
    /// All bytes from the client.
    wire_bytes: Arc<AtomicUsize>,
    /// Of these, those up to the last content.
    content_at: usize,
}

/// Answers the handshake of a client whose first byte was taken. All bytes that it sends are added
/// to `wire_bytes`.
pub(super) async fn accept<S: AsyncRead + AsyncWrite + Send + 'static>(
    stream: S,
    wire_bytes: Arc<AtomicUsize>,
) -> Result<WebSocketBytes<impl AsyncRead + AsyncWrite + Unpin>, ClientRejection> {
    let (reader, mut writer) = tokio::io::split(stream);
    let counter = Arc::clone(&wire_bytes);
    let counting = InspectReader::new(reader, move |bytes| {
        counter.fetch_add(bytes.len(), Ordering::Relaxed);
    });
    let mut reader =
        BufReader::with_capacity(REQUEST_BUFFER_BYTES, counting.take(MAX_REQUEST_BYTES));
    let mut request = vec![FIRST_BYTE];
    while !request.ends_with(b"\r\n\r\n") {
        if reader.read_until(b'\n', &mut request).await? == 0 {
            return Err(ClientRejection::Malformed);
        }
    }
    reader.get_mut().set_limit(u64::MAX);
    if !asks_for_upgrade(&request) {
        let head =
            "HTTP/1.1 426 Upgrade Required\r\nUpgrade: websocket\r\nConnection: Upgrade, close\r\n";
        let length = NO_PAGE.len();
        let answer =
            format!("{head}Content-Type: text/plain\r\nContent-Length: {length}\r\n\r\n{NO_PAGE}");
        writer.write_all(answer.as_bytes()).await?;
        writer.shutdown().await?;
        return Err(ClientRejection::Malformed);
    }
    let stream = tokio::io::join(Cursor::new(request).chain(reader), writer);
    let config = WebSocketConfig::default()
        .read_buffer_size(CHUNK_BYTES)
        .write_buffer_size(0)
        .max_write_buffer_size(16 * CHUNK_BYTES)
        .max_message_size(Some(MAX_MESSAGE_BYTES))
        .max_frame_size(Some(MAX_MESSAGE_BYTES));
    match accept_hdr_async_with_config(stream, answer, Some(config)).await {
        Ok(socket) => Ok(WebSocketBytes {
            socket,
            received: Bytes::new(),
            fault: None,
            wire_bytes,
            content_at: 0,
        }),
        Err(Error::Http(refusal)) => {
            let text = refusal
                .body()
                .as_deref()
                .map(String::from_utf8_lossy)
                .unwrap_or_default();
            Err(ClientRejection::Untrusted(text.into_owned()))
        }
        Err(Error::Io(error)) => Err(error.into()),
        Err(_) => Err(ClientRejection::Malformed),
    }
}

/// True if an HTTP request requests another protocol than HTTP.
fn asks_for_upgrade(request: &[u8]) -> bool {
    let name = b"upgrade:";
    request
        .split(|byte| *byte == b'\n')
        .filter_map(|line| line.get(..name.len()))
        .any(|line| line.eq_ignore_ascii_case(name))
}

/// Decides about a handshake.
#[expect(
    clippy::result_large_err,
    reason = "the type of the library's callback"
)]
fn answer(request: &Request, mut response: Response) -> Result<Response, ErrorResponse> {
    let refuse = |status, reason: String| {
        let mut refusal = ErrorResponse::new(Some(reason));
        *refusal.status_mut() = status;
        Err(refusal)
    };
    if let Err(reason) = check_page(request.headers()) {
        return refuse(StatusCode::FORBIDDEN, reason);
    }
    let mut offered = request
        .headers()
        .get_all(SEC_WEBSOCKET_PROTOCOL)
        .into_iter()
        .filter_map(|value| value.to_str().ok())
        .flat_map(|value| value.split(','))
        .map(str::trim);
    if !offered.any(|protocol| protocol == "mqtt") {
        return refuse(
            StatusCode::BAD_REQUEST,
            "the client must ask for the WebSocket protocol `mqtt`".to_owned(),
        );
    }
    response
        .headers_mut()
        .insert(SEC_WEBSOCKET_PROTOCOL, HeaderValue::from_static("mqtt"));
    Ok(response)
}

/// Checks the origin of the connecting page. A browser lets the page of any site connect to any
/// address, including loopback, and sends the site's name. Programs don't send one.
fn check_page(headers: &HeaderMap) -> Result<(), String> {
    let Some(origin) = headers.get(ORIGIN) else {
        return Ok(());
    };
    let origin = origin.to_str().unwrap_or("?");
    let page = host(
        origin
            .split_once("://")
            .map_or("", |(_, authority)| authority),
    );
    let text = |name: HeaderName| {
        headers
            .get(name)
            .and_then(|value| value.to_str().ok())
            .and_then(host)
    };
    // The name of another site can be made to resolve to this address (DNS rebinding); an address
    // or this machine's name cannot.
    let is_own = page.is_some() && page == text(HOST) && page.as_deref().is_some_and(is_safe_name);
    if is_own {
        return Ok(());
    }
    Err(format!(
        "a page of {origin:?} may not connect: serve it from this node's host, and open it by IP address, as localhost, \
         or by the machine's name"
    ))
}

/// Host of an authority, without port.
fn host(authority: &str) -> Option<String> {
    let uri: Uri = authority.parse().ok()?;
    uri.authority()
        .map(|authority| authority.host().to_ascii_lowercase())
}

fn is_safe_name(host: &str) -> bool {
    let bare = host
        .strip_prefix('[')
        .and_then(|host| host.strip_suffix(']'))
        .unwrap_or(host);
    let system = rustix::system::uname();
    let own = system.nodename().to_string_lossy().to_ascii_lowercase();
    // Of `euclid.lan`, the first label is the machine's name with `.local`.
    let local = format!("{}.local", own.split('.').next().unwrap_or(&own));
    host == "localhost" || bare.parse::<IpAddr>().is_ok() || host == own || host == local
}

impl<S: AsyncRead + AsyncWrite + Unpin> WebSocketBytes<S> {
    /// Processes the next message with content. The end of the socket is `None`.
    fn poll_message(&mut self, cx: &mut Context<'_>) -> Poll<io::Result<Option<Bytes>>> {
        loop {
            let next = Pin::new(&mut self.socket).poll_next(cx);
            let wire_bytes = self.wire_bytes.load(Ordering::Relaxed);
            match next {
                Poll::Ready(Some(Ok(Message::Binary(bytes)))) if !bytes.is_empty() => {
                    self.content_at = wire_bytes;
                    return Poll::Ready(Ok(Some(bytes)));
                }
                Poll::Ready(Some(Ok(Message::Close(_))) | None) => return Poll::Ready(Ok(None)),
                Poll::Ready(Some(Err(error))) => return Poll::Ready(Err(io_error(error))),
                Poll::Ready(Some(Ok(Message::Text(_)))) => {
                    return Poll::Ready(Err(ErrorKind::InvalidData.into()));
                }
                _ if wire_bytes - self.content_at > MAX_EMPTY_BYTES => {
                    return Poll::Ready(Err(ErrorKind::InvalidData.into()));
                }
                Poll::Ready(Some(Ok(_))) => {}
                Poll::Pending => return Poll::Pending,
            }
        }
    }
}

impl<S: AsyncRead + AsyncWrite + Unpin> AsyncRead for WebSocketBytes<S> {
    /// Fills the buffer from all messages that have arrived, so that small ones cost no more than
    /// on TCP.
    fn poll_read(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let began = buffer.filled().len();
        while buffer.remaining() > 0 {
            if self.received.is_empty() {
                let next = match self.fault.take() {
                    Some(fault) => Poll::Ready(Err(fault)),
                    None => self.poll_message(cx),
                };
                match next {
                    Poll::Ready(Ok(Some(bytes))) => self.received = bytes,
                    Poll::Ready(Ok(None)) => break,
                    Poll::Ready(Err(fault)) if buffer.filled().len() > began => {
                        self.fault = Some(fault);
                        break;
                    }
                    Poll::Ready(Err(fault)) => return Poll::Ready(Err(fault)),
                    Poll::Pending if buffer.filled().len() > began => break,
                    Poll::Pending => return Poll::Pending,
                }
            }
            let taken = buffer.remaining().min(self.received.len());
            buffer.put_slice(&self.received.split_to(taken));
        }
        Poll::Ready(Ok(()))
    }
}

impl<S: AsyncRead + AsyncWrite + Unpin> AsyncWrite for WebSocketBytes<S> {
    fn poll_write(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        // Bytes that a client has not read wait in the outer queue, where they are limited.
        ready!(Pin::new(&mut self.socket).poll_ready(cx)).map_err(io_error)?;
        let chunk = Bytes::copy_from_slice(bytes.get(..CHUNK_BYTES).unwrap_or(bytes));
        let written = chunk.len();
        Pin::new(&mut self.socket)
            .start_send(Message::Binary(chunk))
            .map_err(io_error)?;
        Poll::Ready(Ok(written))
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.socket).poll_flush(cx).map_err(io_error)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.socket).poll_close(cx).map_err(io_error)
    }
}

fn io_error(error: Error) -> io::Error {
    match error {
        Error::Io(error) => error,
        error => io::Error::new(ErrorKind::InvalidData, error),
    }
}

/// The content that a client sends after its first byte, if its handshake is accepted. Only built
/// for the fuzz targets.
#[cfg(fuzzing)]
pub fn read_websocket(sent: Vec<u8>) -> Option<Vec<u8>> {
    use futures_util::FutureExt;

    let read = async {
        let stream = tokio::io::join(io::Cursor::new(sent), tokio::io::sink());
        let mut client = accept(stream, Arc::default()).await.ok()?;
        let mut content = Vec::new();
        // Content before a client's fault was passed on.
        let _ = client.read_to_end(&mut content).await;
        Some(content)
    };
    read.now_or_never()
        .expect("bytes that are there are not waited for")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn page_connects_to_serving_host() {
        let check = |origin: &str, host: &str| {
            let headers = [(ORIGIN, origin), (HOST, host)];
            let headers =
                headers.map(|(name, value)| (name, HeaderValue::from_str(value).unwrap()));
            check_page(&headers.into_iter().collect())
        };
        let own = rustix::system::uname()
            .nodename()
            .to_string_lossy()
            .to_ascii_lowercase();
        let own_local = format!("http://{own}.local:8000");
        let own = format!("http://{own}:8000");
        for (origin, host) in [
            (&*own, own.trim_start_matches("http://")),
            (&*own_local, own_local.trim_start_matches("http://")),
            ("http://localhost:8000", "localhost:1883"),
            ("http://127.0.0.1:8000", "127.0.0.1:1883"),
            ("http://10.0.0.7", "10.0.0.7:1883"),
            ("https://[fd00::1]:8000", "[fd00::1]:8883"),
        ] {
            assert_eq!(check(origin, host), Ok(()), "{origin}");
        }
        for (origin, host) in [
            ("https://evil.example", "127.0.0.1:1883"),
            ("http://evil.example", "evil.example:1883"),
            ("http://127.0.0.1.evil.example", "127.0.0.1:1883"),
            ("http://10.0.0.8:8000", "10.0.0.7:1883"),
            ("null", "localhost:1883"),
            ("http://localhost@evil.example", "localhost:1883"),
            ("", ""),
        ] {
            assert!(check(origin, host).is_err(), "{origin}");
        }
        assert_eq!(
            check_page(&HeaderMap::new()),
            Ok(()),
            "programs name no page"
        );
    }
}
