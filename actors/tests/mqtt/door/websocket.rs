//! Pages next to nodes: MQTT over WebSocket at the node's door.

use std::net::SocketAddr;
use std::time::Duration;

use ecod::wire::Role;
use ecod_actors::telemetry::counters::Event;
use futures_util::{SinkExt, StreamExt};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::time::timeout;
use tokio_tungstenite::tungstenite::client::IntoClientRequest;
use tokio_tungstenite::tungstenite::protocol::frame::Frame;
use tokio_tungstenite::tungstenite::protocol::frame::coding::{Data, OpCode};
use tokio_tungstenite::tungstenite::{Error, Message};
use tokio_tungstenite::{WebSocketStream, client_async};

use crate::door::cell::{Cell, PATIENCE};
use crate::door::is_at_east;

type Socket = WebSocketStream<TcpStream>;

/// A WebSocket with these headers; else status and reason of the refusal.
async fn open(door: SocketAddr, headers: &[(&'static str, &str)]) -> Result<Socket, (u16, String)> {
    let mut request = format!("ws://{door}/").into_client_request().unwrap();
    for (name, value) in headers {
        request.headers_mut().insert(*name, value.parse().unwrap());
    }
    match client_async(request, TcpStream::connect(door).await.unwrap()).await {
        Ok((socket, answer)) => {
            assert_eq!(answer.headers()["sec-websocket-protocol"], "mqtt");
            Ok(socket)
        }
        Err(Error::Http(answer)) => {
            let text = answer
                .body()
                .as_deref()
                .map(String::from_utf8_lossy)
                .unwrap_or_default();
            Err((answer.status().as_u16(), text.into_owned()))
        }
        Err(error) => panic!("{error}"),
    }
}

/// A page of the node's own host.
async fn page(door: SocketAddr) -> Socket {
    let origin = format!("http://{}:8000", door.ip());
    open(
        door,
        &[
            ("origin", &origin),
            ("sec-websocket-protocol", "mqttv3.1, mqtt"),
        ],
    )
    .await
    .unwrap()
}

/// A packet of MQTT 3.1.1 of less than 128 bytes.
fn packet(kind: u8, head: &[u8], text: &str, rest: &[u8]) -> Vec<u8> {
    let body = [
        head,
        &(text.len() as u16).to_be_bytes(),
        text.as_bytes(),
        rest,
    ]
    .concat();
    [&[kind, u8::try_from(body.len()).unwrap()], &body[..]].concat()
}

fn login() -> Vec<u8> {
    packet(0x10, b"\0\x04MQTT\x04\x02\0\x3c", "", b"")
}

/// Receives until the bytes have this text.
async fn receive(socket: &mut Socket, wanted: &[u8]) -> Vec<u8> {
    let mut heard = Vec::new();
    let hearing = async {
        while !heard.windows(wanted.len()).any(|part| part == wanted) {
            heard.extend(
                socket
                    .next()
                    .await
                    .expect("still open")
                    .unwrap()
                    .into_data(),
            );
        }
    };
    timeout(PATIENCE, hearing)
        .await
        .expect("no message arrived");
    heard
}

async fn edge() -> (Cell, SocketAddr) {
    let mut cell = Cell::new();
    cell.start("edge", Role::Edge, |_| ()).await;
    let door = cell.door("edge");
    (cell, door)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn page_works_like_any_program() {
    let (cell, door) = edge().await;
    let mut page = page(door).await;
    // Packets need not end where messages do.
    for part in login().chunks(5) {
        page.send(Message::binary(part.to_vec())).await.unwrap();
    }
    receive(&mut page, &[0x20, 2, 0, 0]).await;
    let subscription = packet(0x82, &[0, 1], "ecod/v1/lot/global_detections", &[0]);
    page.send(Message::binary(subscription)).await.unwrap();
    receive(&mut page, b"ecod/v1/lot/global_detections").await;
    let report = br#"{"schema":1,"node":"edge--page","seq":1,"captured_at_us":NOW,"objects":[{"label":"car","confidence":0.9,"x_m":3.1,"y_m":0}]}"#;
    let topic = "ecod/v1/lot/detections/edge--page";
    for seq in 1.. {
        let now = ecod_actors::platform::clock::now().micros().to_string();
        let text = String::from_utf8_lossy(report)
            .replace("NOW", &now)
            .replace("\"seq\":1", &format!("\"seq\":{seq}"));
        let body = [
            &(topic.len() as u16).to_be_bytes(),
            topic.as_bytes(),
            text.as_bytes(),
        ]
        .concat();
        let length = [0x80 | (body.len() % 128) as u8, (body.len() / 128) as u8];
        page.send(Message::binary([&[0x30], &length[..], &body].concat()))
            .await
            .unwrap();
        tokio::time::sleep(Duration::from_millis(50)).await;
        if is_at_east(cell.node("edge"), 3.1, "edge") {
            break;
        }
        assert!(seq < 400, "the report is not on the map");
    }
    receive(&mut page, br#""contributors":["edge"]"#).await;
    // The rights are equal, too.
    page.send(Message::binary(packet(
        0x30,
        b"",
        "ecod/v1/lot/global_detections",
        b"{}",
    )))
    .await
    .unwrap();
    cell.until("the claim is counted", |cell| {
        let rejects = cell.node("edge").counters().rejects_by_source();
        rejects
            .iter()
            .any(|count| count.reason.as_str() == "not_permitted")
    })
    .await;
    cell.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn foreign_page_is_refused() {
    let (cell, door) = edge().await;
    for origin in ["https://evil.example", "null"] {
        let (status, text) = open(
            door,
            &[("origin", origin), ("sec-websocket-protocol", "mqtt")],
        )
        .await
        .err()
        .unwrap();
        assert!(
            status == 403 && text.contains(origin) && text.contains("this node's host"),
            "{status} {text}"
        );
    }
    let (status, text) = open(door, &[]).await.err().unwrap();
    assert!(status == 400 && text.contains("`mqtt`"), "{status} {text}");
    cell.until("all are counted", |cell| {
        cell.node("edge").counters().events(Event::ClientUntrusted) == 3
    })
    .await;
    cell.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn browser_gets_explanation() {
    let (cell, door) = edge().await;
    let mut browser = TcpStream::connect(door).await.unwrap();
    browser
        .write_all(b"GET / HTTP/1.1\r\nHost: localhost:1883\r\nConnection: keep-alive\r\n\r\n")
        .await
        .unwrap();
    let mut answer = String::new();
    timeout(Duration::from_secs(3), browser.read_to_string(&mut answer))
        .await
        .expect("answered")
        .unwrap();
    let (head, text) = answer.split_once("\r\n\r\n").unwrap();
    assert!(
        head.starts_with("HTTP/1.1 426 ")
            && head.ends_with(&format!("Content-Length: {}", text.len())),
        "{head}"
    );
    assert!(
        text.contains("MQTT") && text.contains("http://127.0.0.1:8080/"),
        "{text}"
    );
    let mut endless = TcpStream::connect(door).await.unwrap();
    endless.write_all(b"GET /").await.unwrap();
    let sending = async { while endless.write_all(&[b'x'; 1024]).await.is_ok() {} };
    timeout(Duration::from_secs(3), sending)
        .await
        .expect("a request without end is cut off");
    cell.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn non_mqtt_messages_end_connection() {
    let (cell, door) = edge().await;
    let ends = |messages: Vec<Message>| async move {
        let mut page = page(door).await;
        page.send(Message::binary(login())).await.unwrap();
        receive(&mut page, &[0x20, 2, 0, 0]).await;
        for message in messages {
            if page.send(message).await.is_err() {
                return;
            }
        }
        let rest = async { while let Some(Ok(_)) = page.next().await {} };
        timeout(PATIENCE, rest).await.expect("still open");
    };
    ends(vec![Message::text("hello")]).await;
    ends(vec![Message::binary(vec![0x30; 1024 * 1024])]).await;
    ends(vec![Message::Ping(vec![0; 125].into()); 2000]).await;
    // An empty message without end.
    let part = |kind| Message::Frame(Frame::message(Vec::new(), OpCode::Data(kind), false));
    ends([vec![part(Data::Binary)], vec![part(Data::Continue); 30_000]].concat()).await;
    let mut honest = page(door).await;
    honest.send(Message::binary(login())).await.unwrap();
    receive(&mut honest, &[0x20, 2, 0, 0]).await;
    cell.stop().await;
}
