//! WebSockets behind TLS: certificates and limits are equal to those for other clients.

use std::time::{Duration, Instant};

use ecod_actors::telemetry::counters::Event;
use futures_util::{SinkExt, StreamExt};
use tokio::io::AsyncWriteExt;
use tokio::net::TcpStream;
use tokio::task::JoinSet;
use tokio::time::timeout;
use tokio_rustls::client::TlsStream;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::tungstenite::client::IntoClientRequest;
use tokio_tungstenite::{WebSocketStream, client_async};

use crate::fixture::{Cell, MAX_EACH, SOON, secure};

/// A WebSocket with a certificate that requests a login with this client id; returns the answer, or no answer if the
/// connection is cut.
async fn log_in(cell: &mut Cell, id: &str) -> (WebSocketStream<TlsStream<TcpStream>>, Vec<u8>) {
    let mut request = "wss://broker.ecod.internal/".into_client_request().unwrap();
    request
        .headers_mut()
        .insert("sec-websocket-protocol", "mqtt".parse().unwrap());
    let (mut socket, _) = client_async(request, secure(cell).await).await.unwrap();
    let body = [
        &b"\0\x04MQTT\x04\x02\0\x3c\0"[..],
        &[id.len() as u8],
        id.as_bytes(),
    ]
    .concat();
    socket
        .send(Message::binary(
            [&[0x10, body.len() as u8], &body[..]].concat(),
        ))
        .await
        .unwrap();
    let answer = timeout(SOON, socket.next())
        .await
        .expect("the connection stays open without an answer");
    let answer = answer
        .and_then(Result::ok)
        .map(|message| message.into_data().to_vec());
    (socket, answer.unwrap_or_default())
}

#[tokio::test]
async fn websocket_has_rights_of_certificate() {
    let mut cell = Cell::start().await;
    let run = |number: usize| format!("{number:032x}");
    let (_, answer) = log_in(&mut cell, &format!("euclid-{}", run(0))).await;
    assert_ne!(answer, [0x20, 2, 0, 0], "the name of another");
    let mut held = Vec::new();
    for number in 0..MAX_EACH {
        let (socket, answer) = log_in(&mut cell, &format!("gauss-{}", run(number))).await;
        assert_eq!(answer, [0x20, 2, 0, 0]);
        held.push(socket);
    }
    let (_, answer) = log_in(&mut cell, &format!("gauss-{}", run(MAX_EACH))).await;
    assert!(answer.is_empty(), "{answer:?}");
    cell.counted(Event::ClientsFull, 1).await;
    cell.honest_traffic_goes_on().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn empty_frames_count_their_size() {
    // First the burst is used up, and the buffers of the sockets.
    const BEGIN: Duration = Duration::from_secs(5);
    const END: Duration = Duration::from_secs(9);
    let mut cell = Cell::start_with(|config| config.max_clients_each = 32).await;
    // Sixty pings of the greatest length, then a ping of MQTT; no bit is changed by a mask of zeros.
    let ping = [&[0x89, 0x80 | 125, 0, 0, 0, 0][..], &[b'x'; 125]].concat();
    let frames = [ping.repeat(60), vec![0x82, 0x82, 0, 0, 0, 0, 0xc0, 0]].concat();
    let mut floods = JoinSet::new();
    for number in 0..8 {
        let (mut socket, answer) = log_in(&mut cell, &format!("gauss-{number:032x}")).await;
        assert_eq!(answer, [0x20, 2, 0, 0]);
        let frames = frames.clone();
        floods.spawn(async move {
            let started = Instant::now();
            let mut bytes = 0;
            while let Some(left) = END.checked_sub(started.elapsed())
                && let Ok(Ok(())) = timeout(left, socket.get_mut().write_all(&frames)).await
            {
                bytes += if started.elapsed() < BEGIN {
                    0
                } else {
                    frames.len()
                };
            }
            bytes
        });
    }
    let mib = floods.join_all().await.into_iter().sum::<usize>() >> 20;
    // 2 MiB a second.
    assert!((1..=10).contains(&mib), "{mib} MiB in {:?}", END - BEGIN);
    cell.honest_traffic_goes_on().await;
}
