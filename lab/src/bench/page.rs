//! Size of a node's page as a browser gets it, and the time to its first picture.

use std::net::SocketAddr;
use std::time::{Duration, Instant};

use anyhow::{Context, ensure};
use ecod_actors::observe::dashboard;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

/// Size and time of a page.
#[derive(Debug, Clone, Copy)]
pub struct PageFigures {
    /// Bytes of all its files as they are sent, uncompressed.
    pub bytes: usize,
    /// From the first request to the first picture of the cell, the files one after another,
    /// without drawing.
    pub first_picture: Duration,
}

/// Where the first picture of a stream ends.
const EVENT_END: &[u8] = b"\n\n";

/// Time that any part may take.
const PATIENCE: Duration = Duration::from_secs(10);

/// Requests all files that a browser requests until it can draw a picture.
///
/// # Errors
/// Returns an error if the page is unreachable or sends no picture.
pub async fn fetch(page: SocketAddr) -> anyhow::Result<PageFigures> {
    let begun = Instant::now();
    let mut bytes = 0;
    for path in dashboard::page_paths() {
        bytes += body(page, path, None)
            .await
            .with_context(|| format!("http://{page}{path}"))?;
    }
    let picture = body(page, "/api/events", Some(EVENT_END))
        .await
        .context("the first picture")?;
    ensure!(picture > EVENT_END.len(), "the first picture is empty");
    Ok(PageFigures {
        bytes,
        first_picture: begun.elapsed(),
    })
}

/// The length of an answer's body, up to and with `end` if it has one.
async fn body(page: SocketAddr, path: &str, end: Option<&[u8]>) -> anyhow::Result<usize> {
    let read = async {
        let mut stream = TcpStream::connect(page).await?;
        let request =
            format!("GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n");
        stream.write_all(request.as_bytes()).await?;
        let mut answer = Vec::new();
        let mut head = None;
        while stream.read_buf(&mut answer).await? > 0 {
            head = head.or_else(|| place(&answer, b"\r\n\r\n"));
            let ended = |head: usize| end.is_some_and(|end| place(&answer[head..], end).is_some());
            if head.is_some_and(ended) {
                break;
            }
        }
        ensure!(
            answer.starts_with(b"HTTP/1.1 200 "),
            "{}",
            String::from_utf8_lossy(&answer[..answer.len().min(40)])
        );
        Ok(answer.len() - head.unwrap_or(answer.len()))
    };
    tokio::time::timeout(PATIENCE, read)
        .await
        .context("no answer")?
}

/// The end of the first of these bytes.
fn place(text: &[u8], wanted: &[u8]) -> Option<usize> {
    Some(
        text.windows(wanted.len())
            .position(|bytes| bytes == wanted)?
            + wanted.len(),
    )
}
