//! The messages of a recording node to a viewer of Foxglove's protocol.

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::time::Duration;

use ecod::wire::Role;
use ecod_actors::node;
use ecod_actors::telemetry::counters::Event;

use crate::recording::cell::config;

/// Opens the websocket and reads until all of these texts have arrived.
fn view(port: u16, wanted: &[&str]) {
    let mut stream = TcpStream::connect(("127.0.0.1", port)).unwrap();
    stream
        .set_read_timeout(Some(Duration::from_secs(30)))
        .unwrap();
    let request = "GET / HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n\
        Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\
        Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n";
    stream.write_all(request.as_bytes()).unwrap();
    let mut said = String::new();
    let mut buffer = [0; 4096];
    while !wanted.iter().all(|part| said.contains(part)) {
        let length = stream
            .read(&mut buffer)
            .unwrap_or_else(|error| panic!("{error}, after: {said}"));
        assert_ne!(length, 0, "closed after: {said}");
        said.push_str(&String::from_utf8_lossy(&buffer[..length]));
    }
}

/// A viewer receives the channels. If another program uses the viewer port, the node still records.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn viewers_receive_recorded_channels() {
    let directory = tempfile::tempdir().unwrap();
    let taken = TcpListener::bind(SocketAddr::from(([127, 0, 0, 1], 0))).unwrap();
    let port = taken.local_addr().unwrap().port();
    let mut config = config("edge", Role::Edge, directory.path());
    config.record.as_mut().unwrap().live_port = Some(port);
    let node = node::start(config).await.unwrap();
    let counters = node.counters().clone();
    let until = async |more: u64| {
        let goal = counters.events(Event::Recorded) + more;
        let reached = async {
            while counters.events(Event::Recorded) < goal {
                tokio::time::sleep(Duration::from_millis(20)).await;
            }
        };
        tokio::time::timeout(Duration::from_secs(30), reached)
            .await
            .expect("recording goes on");
    };
    until(20).await;
    drop(taken);
    let viewer = tokio::task::spawn_blocking(move || {
        let served = || TcpStream::connect(("127.0.0.1", port)).is_ok();
        let deadline = std::time::Instant::now() + Duration::from_secs(30);
        while !served() {
            assert!(
                std::time::Instant::now() < deadline,
                "the port is free without a server"
            );
            std::thread::sleep(Duration::from_millis(100));
        }
        view(
            port,
            &[
                "101 Switching Protocols",
                "advertise",
                "ecod.GlobalMap",
                "foxglove.SceneUpdate",
                "scene/map",
            ],
        );
    });
    viewer.await.unwrap();
    until(20).await;
    node.stop().await;
}
