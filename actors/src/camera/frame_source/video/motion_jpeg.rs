//! Motion JPEG over HTTP, the protocol of many network cameras: a response that does not end, with
//! one part for each picture (`multipart/x-mixed-replace`).
//!
//! FFmpeg reads such streams, too, but hides the time of capture in a part's header, `X-Timestamp`.
//! Whatever this reader does not support is left to FFmpeg ([`Unsupported`]): `https://`, redirects,
//! other authentication than Basic, other content, parts without a length. FFmpeg would fail at other
//! errors as well, and name no reason.

use std::time::Duration;

use anyhow::{Context, anyhow, bail, ensure};
use axum::body::{Body, BodyDataStream};
use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use bytes::BytesMut;
use ecod::model::time::Timestamp;
use futures_util::StreamExt;
use hyper::header::{AUTHORIZATION, CONTENT_TYPE, HOST, HeaderValue, USER_AGENT, WWW_AUTHENTICATE};
use hyper::{Request, Response, StatusCode, Uri};
use hyper_util::rt::TokioIo;
use percent_encoding::percent_decode_str;
use tokio::net::TcpStream;
use tokio::runtime::{self, Runtime};

use crate::camera::frame::CameraFrame;
use crate::camera::frame_source::capture_clock::{CaptureClock, FrameStamp};
use crate::camera::frame_source::{FrameError, FrameSource, SourceConfig, TimeSource};
use crate::camera::image_codec;
use crate::platform::clock;

/// Maximum length of a part's header in bytes.
const MAX_HEADER: usize = 16 << 10;

/// Maximum length of a picture in bytes.
const MAX_PICTURE: usize = 32 << 20;

/// Name of this program in requests: some cameras refuse requests without one.
const AGENT: &str = concat!("ecod/", env!("CARGO_PKG_VERSION"));

/// An answer in a form that this reader does not support.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
struct Unsupported(String);

/// An open stream.
pub(super) struct MotionJpeg {
    origin: String,
    runtime: Runtime,
    parts: PartReader,
    /// The first part, which [`MotionJpeg::open`] has read.
    first: Option<Part>,
    timeout: Duration,
    clock: CaptureClock,
    seq: u64,
}

impl MotionJpeg {
    /// Opens a source; `None` if it is not a stream that this reader supports.
    pub(super) fn open(
        source: &SourceConfig,
        timeout: Duration,
    ) -> Result<Option<Self>, FrameError> {
        let SourceConfig::Url { url, latency_s } = source else {
            return Ok(None);
        };
        let Some(address) = Address::of(url) else {
            return Ok(None);
        };
        let failed = |reason: String| FrameError::Open {
            origin: source.origin(),
            reason,
        };
        let runtime = runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .map_err(|error| failed(error.to_string()))?;
        let opened = runtime.block_on(async {
            tokio::time::timeout(timeout, async {
                let mut parts = address.open().await?;
                let first = parts.next().await?;
                anyhow::Ok((parts, first))
            })
            .await
        });
        let (parts, first) = match opened {
            Ok(Ok(opened)) => opened,
            Ok(Err(error)) if error.is::<Unsupported>() => {
                eprintln!("left to FFmpeg: {error:#}");
                return Ok(None);
            }
            Ok(Err(error)) => return Err(failed(format!("{error:#}"))),
            Err(_) => {
                // Does not wait for a name that is still being resolved.
                runtime.shutdown_background();
                return Err(failed(format!("no picture within {timeout:?}")));
            }
        };
        Ok(Some(Self {
            origin: source.origin(),
            runtime,
            parts,
            first: Some(first),
            timeout,
            clock: CaptureClock::new(*latency_s),
            seq: 0,
        }))
    }

    fn next_part(&mut self) -> Result<Part, FrameError> {
        if let Some(first) = self.first.take() {
            return Ok(first);
        }
        let parts = &mut self.parts;
        let timeout = self.timeout;
        let next = async { tokio::time::timeout(timeout, parts.next()).await };
        match self.runtime.block_on(next) {
            Ok(Ok(part)) => Ok(part),
            Ok(Err(error)) => Err(FrameError::Lost {
                origin: self.origin.clone(),
                reason: format!("{error:#}"),
            }),
            Err(_) => Err(FrameError::Stalled(self.timeout)),
        }
    }
}

impl FrameSource for MotionJpeg {
    fn next_frame(&mut self) -> Result<CameraFrame, FrameError> {
        let part = self.next_part()?;
        let image =
            image_codec::decode_motion_jpeg(&part.jpeg).map_err(|damage| FrameError::Unusable {
                origin: self.origin.clone(),
                reason: damage.to_string(),
            })?;
        let frame = CameraFrame {
            image,
            captured_at: self.clock.time(part.stamp, part.arrived_at),
            seq: self.seq,
        };
        self.seq += 1;
        Ok(frame)
    }

    fn time_source(&self) -> TimeSource {
        self.clock.source()
    }
}

/// Address of a stream and the login for it.
struct Address {
    uri: Uri,
    /// User and password, joined by a colon.
    login: Option<String>,
}

impl Address {
    /// `None` if the address has another scheme than `http://`.
    fn of(url: &str) -> Option<Self> {
        let uri: Uri = url.parse().ok()?;
        if uri.scheme_str()? != "http" {
            return None;
        }
        let authority = uri.authority()?.as_str();
        let login = match authority.rsplit_once('@') {
            Some((login, _)) => Some(percent_decode_str(login).decode_utf8().ok()?.into_owned()),
            None => None,
        };
        Some(Self { uri, login })
    }

    /// Requests the stream, with the login only if the camera requires it.
    async fn open(&self) -> anyhow::Result<PartReader> {
        let mut response = self.request(None).await?;
        if response.status() == StatusCode::UNAUTHORIZED {
            let login = self.login.as_deref().with_context(|| {
                format!(
                    "{}: the address has no user and password",
                    response.status()
                )
            })?;
            let challenge = response.headers().get(WWW_AUTHENTICATE);
            ensure!(
                challenge.is_none_or(is_basic),
                Unsupported(format!("authentication by {challenge:?}"))
            );
            response = self.request(Some(login)).await?;
        }
        let status = response.status();
        ensure!(
            status != StatusCode::UNAUTHORIZED,
            "{status}: the camera refuses user or password"
        );
        ensure!(!status.is_redirection(), Unsupported(status.to_string()));
        ensure!(status == StatusCode::OK, "{status}");
        let content = response.headers().get(CONTENT_TYPE);
        let content = content.and_then(|content| content.to_str().ok());
        ensure!(
            content.is_some_and(|content| {
                content
                    .to_ascii_lowercase()
                    .starts_with("multipart/x-mixed-replace")
            }),
            Unsupported(format!("content {content:?}"))
        );
        Ok(PartReader {
            body: response.into_body().into_data_stream(),
            buffer: BytesMut::new(),
        })
    }

    async fn request(&self, login: Option<&str>) -> anyhow::Result<Response<Body>> {
        let host = self.uri.host().context("no host")?;
        let port = self.uri.port_u16().unwrap_or(80);
        let stream = TcpStream::connect((host.trim_matches(['[', ']']), port)).await?;
        let (mut sender, connection) =
            hyper::client::conn::http1::handshake(TokioIo::new(stream)).await?;
        // An error of the connection ends the body of the response.
        tokio::spawn(async {
            let _ = connection.await;
        });
        let path = self.uri.path_and_query().map_or("/", |path| path.as_str());
        let mut request = Request::get(path)
            .header(HOST, format!("{host}:{port}"))
            .header(USER_AGENT, AGENT);
        if let Some(login) = login {
            let encoded = BASE64_STANDARD.encode(login);
            request = request.header(AUTHORIZATION, format!("Basic {encoded}"));
        }
        let sent = sender.send_request(request.body(Body::empty())?).await;
        let response = sent.map_err(|error| {
            if error.is_parse() {
                anyhow!(Unsupported(error.to_string()))
            } else {
                error.into()
            }
        })?;
        Ok(response.map(Body::new))
    }
}

/// True if a challenge is for Basic authentication.
fn is_basic(challenge: &HeaderValue) -> bool {
    let scheme = challenge.as_bytes().get(..5);
    scheme.is_some_and(|scheme| scheme.eq_ignore_ascii_case(b"basic"))
}

/// One picture of the stream.
struct Part {
    jpeg: BytesMut,
    stamp: Option<FrameStamp>,
    /// Time when the end of the header arrived.
    arrived_at: Timestamp,
}

/// The parts of a response.
struct PartReader {
    body: BodyDataStream,
    /// Bytes of the response that have been received and not yet used.
    buffer: BytesMut,
}

impl PartReader {
    async fn next(&mut self) -> anyhow::Result<Part> {
        let mut room = MAX_HEADER;
        while !self.line(&mut room).await?.starts_with("--") {}
        let mut length = None;
        let mut stamp = None;
        loop {
            let line = self.line(&mut room).await?;
            if line.is_empty() {
                break;
            }
            let header = line.split_once(':');
            let (name, value) = header.ok_or_else(|| Unsupported("no header of a part".into()))?;
            match name.to_ascii_lowercase().as_str() {
                "content-length" => length = value.trim().parse().ok(),
                "x-timestamp" => stamp = time_of_camera(value.trim()),
                _ => {}
            }
        }
        let arrived_at = clock::now();
        let length = length.ok_or_else(|| Unsupported("no length of a part".into()))?;
        ensure!(
            length <= MAX_PICTURE,
            Unsupported(format!("a picture of {length} bytes"))
        );
        while self.buffer.len() < length {
            self.receive().await?;
        }
        Ok(Part {
            jpeg: self.buffer.split_to(length),
            stamp,
            arrived_at,
        })
    }

    /// The next line without its end; `room` is the number of bytes that the header may still have.
    async fn line(&mut self, room: &mut usize) -> anyhow::Result<String> {
        loop {
            let end = self.buffer.iter().position(|byte| *byte == b'\n');
            let bytes = end.map_or(self.buffer.len(), |end| end + 1);
            ensure!(
                bytes <= *room,
                Unsupported("the header of a part is too long".into())
            );
            if end.is_some() {
                *room -= bytes;
                let line = self.buffer.split_to(bytes);
                return Ok(String::from_utf8_lossy(&line).trim_end().to_owned());
            }
            self.receive().await?;
        }
    }

    async fn receive(&mut self) -> anyhow::Result<()> {
        match self.body.next().await {
            Some(bytes) => self.buffer.extend_from_slice(&bytes?),
            None => bail!("no further frame"),
        }
        Ok(())
    }
}

/// The time in a header `X-Timestamp`, seconds since 1970 with a fraction, on the node's clock.
fn time_of_camera(seconds: &str) -> Option<FrameStamp> {
    let since_1970 = Duration::try_from_secs_f64(seconds.parse().ok()?).ok()?;
    let wall = Timestamp::default() + since_1970;
    Some(FrameStamp::Time(wall.shifted(-clock::wall_offset_us())))
}

#[cfg(test)]
mod tests;
