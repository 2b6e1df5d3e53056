//! Reads the page of a node on this machine, for commands.

use std::io::{self, Read, Write};
use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr, TcpStream};
use std::time::Duration;

use serde::de::DeserializeOwned;

use crate::platform::secret::Secret;

/// Maximum time for the connection, and for each part of the answer.
const PATIENCE: Duration = Duration::from_secs(3);

/// Maximum size of an answer in bytes; the largest contain a map.
const MAX_BYTES: u64 = 64 * 1024 * 1024;

/// Reason why a page cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum PageError {
    /// The node does not answer at this address.
    #[error("{0}")]
    Silent(#[from] io::Error),
    /// The node refuses the request.
    #[error("the answer is {0}: `dashboard.token` of the configuration is not that of the node")]
    Refused(String),
    /// The answer is of another program.
    #[error("the answer is not of a node: {0}")]
    Unreadable(String),
}

/// The JSON at a path of the page that listens at `address`.
///
/// # Errors
/// Returns a [`PageError`] if a node does not answer there, or refuses the request.
pub fn read_page<T: DeserializeOwned>(
    mut address: SocketAddr,
    path: &str,
    token: Option<&Secret>,
) -> Result<T, PageError> {
    match address {
        SocketAddr::V4(v4) if v4.ip().is_unspecified() => {
            address.set_ip(Ipv4Addr::LOCALHOST.into());
        }
        SocketAddr::V6(v6) if v6.ip().is_unspecified() => {
            address.set_ip(Ipv6Addr::LOCALHOST.into());
        }
        _ => {}
    }
    let mut stream = TcpStream::connect_timeout(&address, PATIENCE)?;
    stream.set_read_timeout(Some(PATIENCE))?;
    stream.set_write_timeout(Some(PATIENCE))?;
    let authorization = token.map_or_else(String::new, |token| {
        format!("Authorization: Bearer {}\r\n", token.reveal())
    });
    // The server ends the connection of version 1.0 after its answer.
    let request = format!("GET {path} HTTP/1.0\r\nHost: {address}\r\n{authorization}\r\n");
    stream.write_all(request.as_bytes())?;
    let mut answer = String::new();
    stream.take(MAX_BYTES).read_to_string(&mut answer)?;
    let unreadable = |text: &str| PageError::Unreadable(text.chars().take(80).collect());
    let (head, body) = answer
        .split_once("\r\n\r\n")
        .ok_or_else(|| unreadable(&answer))?;
    let status = head.lines().next().unwrap_or_default();
    match status.split(' ').nth(1) {
        Some("200") => serde_json::from_str(body).map_err(|error| unreadable(&error.to_string())),
        Some("401" | "421") => Err(PageError::Refused(status.to_owned())),
        _ => Err(unreadable(status)),
    }
}
