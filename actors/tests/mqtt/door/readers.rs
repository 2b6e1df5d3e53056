//! Programs that subscribe to everything without reading.

use std::time::Duration;

use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::{AsyncClient, MqttOptions};
use tokio::time::{Instant, sleep};

use crate::door::cell::{PATIENCE, Program};
use crate::door::process::Node;

/// Number of programs that do not read, and megabytes that each is sent.
const READERS: usize = 8;
const MEGABYTES: usize = 40;

/// Most memory that these programs may cost the node: 2 MiB each, and the messages in transit.
const MAX_GROWN_KIB: u64 = 28 * 1024;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn slow_programs_cost_bounded_memory() {
    let node = Node::start();
    let door = node.door().await;
    let planner = Program::connect("planner", door, &["global_detections"]).await;
    let sender = Program::connect("sender", door, &[]).await;
    let mut readers = Vec::new();
    for index in 0..READERS {
        let options = MqttOptions::new(
            format!("sleeper-{index}"),
            door.ip().to_string(),
            door.port(),
        );
        let (client, mut events) = AsyncClient::new(options, 4);
        client.subscribe("#", QoS::AtMostOnce).await.unwrap();
        // Login and subscription without further polling.
        for _ in 0..4 {
            events.poll().await.unwrap();
        }
        readers.push((client, events));
    }
    let before = node.memory_kib("VmRSS:");
    let first = planner.rounds().len();
    for _ in 0..MEGABYTES * 10 {
        sender
            .publish("pictures", vec![b'x'; 100_000], QoS::AtLeastOnce)
            .await;
        sleep(Duration::from_millis(5)).await;
    }
    let sent = Instant::now();
    let count = || planner.rounds().len();
    let so_far = count();
    while count() < so_far + 10 {
        assert!(sent.elapsed() < PATIENCE, "the maps go on:\n{}", node.log());
        sleep(Duration::from_millis(20)).await;
    }
    let rounds: Vec<u64> = planner
        .rounds()
        .into_iter()
        .skip(first)
        .map(|((.., round), _)| round)
        .collect();
    assert!(
        rounds.windows(2).all(|pair| pair[1] == pair[0] + 1),
        "each map: {rounds:?}"
    );
    let grown = node.memory_kib("VmHWM:").saturating_sub(before);
    println!(
        "{READERS} programs that do not read, {MEGABYTES} MB for each: {grown} KiB more at most"
    );
    assert!(grown < MAX_GROWN_KIB, "{grown} KiB");
    drop(readers);
}
