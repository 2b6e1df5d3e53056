//! An intruder on the cell's network: it floods the cell with reports and malformed messages.

use std::net::{Ipv4Addr, SocketAddr};
use std::time::Duration;

use anyhow::Context;
use ecod::model::names::NodeName;
use ecod::wire::{Encoding, ObjectReport, PerceivedObject, encode};
use ecod_actors::platform::clock;
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rumqttc::{AsyncClient, MqttOptions, QoS};
use tokio::io::AsyncWriteExt;
use tokio::net::{TcpStream, UdpSocket};
use tokio::task::JoinSet;
use tokio::time::{Instant, interval, timeout};

use crate::failover::settings::CELL;

/// The name it goes by.
pub(super) const NAME: &str = "mallory";

/// Time between two bursts of reports, and their size: 5000 a second.
const FLOOD_TICK: Duration = Duration::from_millis(10);
const FLOOD_BURST: u64 = 50;

const JUNK_TICK: Duration = Duration::from_millis(20);

/// Longest payload of junk, in bytes: above the limit of a report.
const LONGEST_JUNK: usize = 400_000;

/// A client of every broker; its connections end with it.
pub(super) struct Intruder {
    brokers: Vec<SocketAddr>,
    gossips: Vec<SocketAddr>,
    rng: ChaCha8Rng,
    seq: u64,
}

impl Intruder {
    pub(super) fn new(brokers: Vec<SocketAddr>, gossips: Vec<SocketAddr>, seed: u64) -> Self {
        Self {
            brokers,
            gossips,
            rng: ChaCha8Rng::seed_from_u64(seed),
            seq: 0,
        }
    }

    /// Sends many more reports than anyone may, to all brokers in turn.
    pub(super) async fn flood(&mut self, lasts: Duration) -> anyhow::Result<()> {
        let mut tasks = JoinSet::new();
        let clients: Vec<_> = self
            .brokers
            .iter()
            .map(|broker| connect(*broker, &mut tasks))
            .collect();
        let until = Instant::now() + lasts;
        let mut ticks = interval(FLOOD_TICK);
        while Instant::now() < until {
            ticks.tick().await;
            for _ in 0..FLOOD_BURST {
                self.seq += 1;
                let payload = encode(&report(self.seq)?, Encoding::Json);
                // The first node is the edge, which all the rest of a flood is for.
                let to = if self.seq.is_multiple_of(8) {
                    self.rng.random_range(0..clients.len())
                } else {
                    0
                };
                // A broker that is slow to take them has a full queue before it.
                let _ =
                    clients[to].try_publish(topic("detections"), QoS::AtMostOnce, false, payload);
            }
        }
        Ok(())
    }

    /// Sends malformed messages to brokers, sockets and gossip.
    pub(super) async fn send_junk(&mut self, lasts: Duration) -> anyhow::Result<()> {
        let udp = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0))
            .await
            .context("cannot bind a UDP socket")?;
        let mut tasks = JoinSet::new();
        let clients: Vec<_> = self
            .brokers
            .iter()
            .map(|broker| connect(*broker, &mut tasks))
            .collect();
        let until = Instant::now() + lasts;
        let mut ticks = interval(JUNK_TICK);
        while Instant::now() < until {
            ticks.tick().await;
            let payload = self.junk()?;
            let bytes = self.bytes(1200);
            let node = self.rng.random_range(0..clients.len());
            let kind =
                ["detections", "vote_detections", "nodes", "ledger"][self.rng.random_range(0..4)];
            let topic = match self.rng.random_range(0..4) {
                0 => format!("ecod/v1/{CELL}/global_detections"),
                1 => format!("ecod/v1/{CELL}/{kind}/edge"),
                _ => topic(kind),
            };
            // A refused message is as good as sent.
            let _ = clients[node].try_publish(
                topic,
                QoS::AtMostOnce,
                self.rng.random_ratio(1, 4),
                payload,
            );
            let _ = udp.send_to(&bytes, self.gossips[node]).await;
            if let Ok(Ok(mut stream)) =
                timeout(JUNK_TICK, TcpStream::connect(self.brokers[node])).await
            {
                let _ = stream.write_all(&bytes).await;
            }
        }
        Ok(())
    }

    /// Noise, a truncated report, a report with impossible values, or a map of a leader that was not elected.
    fn junk(&mut self) -> anyhow::Result<Vec<u8>> {
        self.seq += 1;
        let mut whole = encode(&report(self.seq)?, Encoding::Json);
        Ok(match self.rng.random_range(0..5) {
            0 => self.bytes(2000),
            1 => self.bytes(LONGEST_JUNK),
            2 => {
                whole.truncate(self.rng.random_range(0..whole.len()));
                whole
            }
            3 => String::from_utf8(whole)?
                .replace("0.9", "-1e999")
                .into_bytes(),
            _ => {
                let term = self.rng.next_u64() >> 12;
                let now = clock::now().micros();
                let map = format!(
                    r#"{{"schema":1,"aggregator":"{NAME}","epoch":{term},"round":1,"fused_at_us":{now},"landmarks":[],"objects":[]}}"#
                );
                map.into_bytes()
            }
        })
    }

    fn bytes(&mut self, most: usize) -> Vec<u8> {
        let mut bytes = vec![0; self.rng.random_range(1..most)];
        self.rng.fill_bytes(&mut bytes);
        bytes
    }
}

/// A client whose connection is served, and tried again, by `tasks`.
fn connect(broker: SocketAddr, tasks: &mut JoinSet<()>) -> AsyncClient {
    let mut options = MqttOptions::new(NAME, broker.ip().to_string(), broker.port());
    options.set_max_packet_size(2 * LONGEST_JUNK, 2 * LONGEST_JUNK);
    let (client, mut events) = AsyncClient::new(options, 64);
    tasks.spawn(async move {
        loop {
            if events.poll().await.is_err() {
                tokio::time::sleep(Duration::from_millis(200)).await;
            }
        }
    });
    client
}

fn report(seq: u64) -> anyhow::Result<ObjectReport> {
    let objects = vec![PerceivedObject::new("car", 0.9, 6.0, 0.0); 10];
    Ok(ObjectReport {
        objects,
        ..ObjectReport::new(NodeName::new(NAME)?, seq, clock::now())
    })
}

fn topic(kind: &str) -> String {
    format!("ecod/v1/{CELL}/{kind}/{NAME}")
}
