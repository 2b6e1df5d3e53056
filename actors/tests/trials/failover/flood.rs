//! Programs that misbehave at a node's door: they flood it, claim others' names, and do not read.

use std::fs;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use anyhow::Context;
use ecod::model::names::NodeName;
use ecod::wire::{Encoding, ObjectReport, ReportKind, Topics, encode};
use ecod_actors::platform::clock;
use rumqttc::Outgoing;
use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::{AsyncClient, Event, EventLoop, MqttOptions};
use tokio::runtime::{Builder, Runtime};
use tokio::time::sleep;

use crate::failover::settings::CELL;

/// Programs of each kind; the parts of a vehicle are 16 at most.
const EACH: usize = 8;

/// Messages that a program has sent and the door has not answered.
const IN_FLIGHT: usize = 16;

/// More than any report or map may have.
const LARGE_BYTES: usize = 1 << 20;

/// Time after which a program that was cut off comes back.
const RETURN: Duration = Duration::from_millis(20);

/// Running programs; all end with it.
#[derive(Debug)]
pub(crate) struct Flood {
    runtime: Option<Runtime>,
    messages: Arc<AtomicU64>,
    /// The node's process, and its memory before.
    process: u32,
    resident_kib: u64,
}

/// Outcome of a flood.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct FloodCost {
    /// Messages that the door's broker took off the programs' hands.
    pub(crate) messages: u64,
    /// Most memory that the node took more than before.
    pub(crate) grown_kib: u64,
    /// Maps of others, since the flood began, without the flooded node's own report.
    pub(crate) unheard: u64,
}

/// Packets that a program sends, again and again.
#[derive(Debug, Clone)]
enum Misuse {
    /// Reports of a part of the node, without anything in view, far beyond the rate.
    Reports(NodeName),
    /// Reports of the node's own, too large.
    Large(NodeName),
    /// Reports and maps in the names of others.
    Foreign(NodeName),
    /// A connection and its end.
    Connections,
    /// Subscribes to everything, then sends no messages and does not read.
    NeverReads,
}

impl Flood {
    /// Starts the programs at the door of a node with this process; some claim another's name.
    pub(crate) fn start(
        door: SocketAddr,
        node: &NodeName,
        process: u32,
        other: &NodeName,
    ) -> anyhow::Result<Self> {
        let messages = Arc::<AtomicU64>::default();
        let resident_kib = memory_kib(process, "VmRSS:")?;
        let runtime = Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()
            .context("no thread")?;
        for index in 0..EACH {
            let part = NodeName::new(format!("{node}--flood{index}"))?;
            let misuses = [
                Misuse::Reports(part.clone()),
                Misuse::Large(part),
                Misuse::Foreign(other.clone()),
                Misuse::Connections,
                Misuse::NeverReads,
            ];
            for (kind, misuse) in misuses.into_iter().enumerate() {
                let id = format!("flood-{kind}-{index}");
                let messages = Arc::clone(&messages);
                runtime.spawn(async move {
                    loop {
                        misuse.perform(&id, door, &messages).await;
                        sleep(RETURN).await;
                    }
                });
            }
        }
        Ok(Self {
            runtime: Some(runtime),
            messages,
            process,
            resident_kib,
        })
    }

    /// Messages so far, and by how much the node has grown at most.
    pub(crate) fn cost(&self) -> anyhow::Result<(u64, u64)> {
        let grown_kib = memory_kib(self.process, "VmHWM:")?.saturating_sub(self.resident_kib);
        Ok((self.messages.load(Ordering::Relaxed), grown_kib))
    }
}

fn memory_kib(process: u32, key: &str) -> anyhow::Result<u64> {
    let status = fs::read_to_string(format!("/proc/{process}/status"))?;
    let line = status.lines().find_map(|line| line.strip_prefix(key));
    line.and_then(|rest| rest.split_whitespace().next()?.parse().ok())
        .with_context(|| format!("no {key}"))
}

impl Drop for Flood {
    fn drop(&mut self) {
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_background();
        }
    }
}

impl Misuse {
    /// One connection, as long as the door lets it live.
    async fn perform(&self, id: &str, door: SocketAddr, messages: &AtomicU64) {
        let mut options = MqttOptions::new(id, door.ip().to_string(), door.port());
        options.set_max_packet_size(Some(4 * LARGE_BYTES as u32));
        let (client, mut events) = AsyncClient::new(options, IN_FLIGHT);
        let topics = Topics::new(&NodeName::from_static(CELL));
        let path = |name: &NodeName| topics.path(&ReportKind::Detections.topic(name.clone()));
        match self {
            Self::Reports(part) => {
                let report = ObjectReport {
                    seen: Some(Vec::new()),
                    ..ObjectReport::new(part.clone(), 0, clock::now())
                };
                let report = |seq| {
                    let report = ObjectReport {
                        seq,
                        captured_at_us: clock::now(),
                        ..report.clone()
                    };
                    (path(part), encode(&report, Encoding::Json))
                };
                send(&client, &mut events, messages, report).await;
            }
            Self::Large(part) => {
                send(&client, &mut events, messages, |_| {
                    (path(part), vec![b' '; LARGE_BYTES])
                })
                .await;
            }
            Self::Foreign(other) => {
                let map = format!("ecod/v1/{CELL}/global_detections");
                let message = |seq| {
                    (
                        if seq % 2 == 0 {
                            path(other)
                        } else {
                            map.clone()
                        },
                        b"{}".to_vec(),
                    )
                };
                send(&client, &mut events, messages, message).await;
            }
            Self::Connections => drop(events.poll().await),
            Self::NeverReads => {
                if client.subscribe("#", QoS::AtMostOnce).await.is_ok() {
                    // The connection, the subscription, and the first of its messages.
                    for _ in 0..4 {
                        drop(events.poll().await);
                    }
                    std::future::pending::<()>().await;
                }
            }
        }
    }
}

/// Sends as fast as the door takes it, with and without acknowledgement in turn, until the connection ends.
async fn send(
    client: &AsyncClient,
    events: &mut EventLoop,
    messages: &AtomicU64,
    message: impl Fn(u64) -> (String, Vec<u8>),
) {
    let publish = async {
        for seq in 0.. {
            let (topic, payload) = message(seq);
            let qos = if seq % 2 == 0 {
                QoS::AtMostOnce
            } else {
                QoS::AtLeastOnce
            };
            if client.publish(topic, qos, false, payload).await.is_err() {
                return;
            }
        }
    };
    let poll = async {
        while let Ok(event) = events.poll().await {
            if matches!(event, Event::Outgoing(Outgoing::Publish(_))) {
                messages.fetch_add(1, Ordering::Relaxed);
            }
        }
    };
    tokio::select! {
        () = publish => {}
        () = poll => {}
    }
}
