//! An attacker's connection: TLS, a login, and then any bytes.

use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, bail};
use ecod_actors::transport::pki::BROKER_NAME;
use rustls::ClientConfig;
use rustls::pki_types::ServerName;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpSocket, TcpStream};
use tokio::time::sleep;
use tokio_rustls::TlsConnector;
use tokio_rustls::client::TlsStream;
use uuid::Uuid;

use crate::attacks::cell::Target;
use crate::packets::{packet, text};

/// Bytes that count as sent together: large packets take long where the broker makes senders wait.
const PART_BYTES: usize = 64 * 1024;

/// A connection without a login.
pub(crate) async fn knock(target: &Target) -> anyhow::Result<TcpStream> {
    let socket = TcpSocket::new_v4()?;
    socket.bind((target.from, 0).into())?;
    Ok(socket.connect(target.broker).await?)
}

/// A connection with a certificate and without a login.
pub(crate) async fn secure(
    target: &Target,
    tls: &Arc<ClientConfig>,
) -> anyhow::Result<TlsStream<TcpStream>> {
    let stream = knock(target).await?;
    let server = ServerName::try_from(BROKER_NAME)?;
    Ok(TlsConnector::from(Arc::clone(tls))
        .connect(server, stream)
        .await?)
}

/// A connection that has logged in under a node's name.
pub(crate) async fn log_in(
    target: &Target,
    tls: &Arc<ClientConfig>,
    name: &str,
) -> anyhow::Result<TlsStream<TcpStream>> {
    let client_id = format!("{name}-{}", Uuid::now_v7().simple());
    log_in_as(target, tls, &client_id).await
}

/// A connection with any client id. The keep-alive is off.
pub(crate) async fn log_in_as(
    target: &Target,
    tls: &Arc<ClientConfig>,
    client_id: &str,
) -> anyhow::Result<TlsStream<TcpStream>> {
    let mut stream = secure(target, tls).await?;
    stream
        .write_all(&packet(
            0x10,
            &[b"\0\x04MQTT\x04\x02\0\0", &text(client_id)],
        ))
        .await?;
    let mut answer = [0; 4];
    stream
        .read_exact(&mut answer)
        .await
        .context("no answer to the login")?;
    if answer != [0x20, 2, 0, 0] {
        bail!("the login was refused: {answer:?}");
    }
    Ok(stream)
}

/// Sends the opening once and the packet for ever, over a new connection whenever one ends.
pub(crate) async fn send_for_ever(
    target: &Target,
    tls: &Arc<ClientConfig>,
    name: &str,
    opening: &[u8],
    packet: &[u8],
) {
    loop {
        if let Ok(mut stream) = log_in(target, tls, name).await
            && stream.write_all(opening).await.is_ok()
        {
            let mut parts = packet.chunks(PART_BYTES).cycle();
            while let Some(part) = parts.next()
                && stream.write_all(part).await.is_ok()
            {
                target.did(part.len());
            }
        }
        sleep(Duration::from_millis(100)).await;
    }
}

/// A SUBSCRIBE of one filter, QoS 0.
pub(crate) fn subscribe(filter: &str) -> Vec<u8> {
    packet(0x82, &[&[0, 1], &text(filter), &[0]])
}

/// A PUBLISH with QoS 0.
pub(crate) fn publish(topic: &str, payload: &[u8]) -> Vec<u8> {
    packet(0x30, &[&text(topic), payload])
}
