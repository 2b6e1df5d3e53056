//! Vehicles that pass through cells, what the cells say of them, and how much of it is lost.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use anyhow::ensure;
use ecod::leadership::BrokerAddress;
use ecod::model::names::NodeName;
use ecod::neighbours::{ExchangeStep, ReputationExchange};
use ecod::reputation::{CellCounts, Counts};
use ecod::wire::{CellReputation, Encoding, Limits, ReputationTopic, decode, encode};
use ecod_actors::platform::clock;
use ecod_region::broker::BrokerLogin;
use rumqttc::{AsyncClient, Event, NetworkOptions, Packet, QoS, SubscribeFilter};
use tokio::runtime::Runtime;
use tokio::time::{Instant, interval, sleep, timeout};

use crate::cluster::{Cluster, PASSWORD};
use crate::places::Place;

/// Cells that tell of vehicles, each on a connection of its own beside that of its maps; ended when dropped.
pub(crate) struct PassingVehicles {
    /// Votes of each vehicle that has left, by topic.
    left: Arc<Mutex<BTreeMap<String, u64>>>,
    is_over: Arc<AtomicBool>,
    runtime: Runtime,
}

/// Time for which a vehicle stays in a cell.
const STAY: Duration = Duration::from_secs(2);

/// Time in which the region is to have all that was said.
const PATIENCE: Duration = Duration::from_secs(90);

impl PassingVehicles {
    pub(crate) fn start(places: &[Place], cluster: &Cluster) -> anyhow::Result<Self> {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()?;
        let (left, is_over) = (Arc::<Mutex<_>>::default(), Arc::<AtomicBool>::default());
        for (number, place) in places.iter().enumerate() {
            let teller = Teller {
                exchange: ReputationExchange::new(place.cell.clone()),
                cell: place.cell.clone(),
                servers: cluster.addresses(),
                next: number,
                vehicle: None,
                passed: 0,
                left: Arc::clone(&left),
                is_over: Arc::clone(&is_over),
            };
            runtime.spawn(teller.run());
        }
        Ok(Self {
            left,
            is_over,
            runtime,
        })
    }

    /// Lets the last vehicles leave, and waits until a new reader has what was said of all; the number of vehicles, and the topics
    /// on which the region has less than was said.
    pub(crate) fn end(&self, login: &BrokerLogin) -> anyhow::Result<(usize, Vec<String>)> {
        self.is_over.store(true, Ordering::Relaxed);
        self.runtime.block_on(async {
            sleep(2 * STAY).await;
            let left = self
                .left
                .lock()
                .unwrap_or_else(PoisonError::into_inner)
                .clone();
            ensure!(!left.is_empty(), "no vehicle has left");
            let (client, mut events) = AsyncClient::new(login.options(), 64);
            let mut missing = left.clone();
            let reading = async {
                while !missing.is_empty() {
                    match events.poll().await {
                        Ok(Event::Incoming(Packet::ConnAck(_))) => {
                            let _ = client.try_subscribe(
                                ReputationTopic::filter_everywhere(),
                                QoS::AtMostOnce,
                            );
                        }
                        Ok(Event::Incoming(Packet::Publish(message))) => {
                            let said =
                                decode::<CellReputation>(&message.payload, &Limits::default());
                            let votes = said.map_or(0, |said| said.correct);
                            if missing
                                .get(&message.topic)
                                .is_some_and(|wanted| votes >= *wanted)
                            {
                                missing.remove(&message.topic);
                            }
                        }
                        Ok(_) => {}
                        Err(_) => sleep(Duration::from_millis(200)).await,
                    }
                }
            };
            let _ = timeout(PATIENCE, reading).await;
            Ok((left.len(), missing.into_keys().collect()))
        })
    }
}

struct Teller {
    exchange: ReputationExchange,
    cell: NodeName,
    servers: Vec<SocketAddr>,
    /// Number of the next server to try.
    next: usize,
    /// The vehicle that is present, and since when.
    vehicle: Option<(NodeName, Instant)>,
    passed: u64,
    left: Arc<Mutex<BTreeMap<String, u64>>>,
    is_over: Arc<AtomicBool>,
}

impl Teller {
    async fn run(mut self) {
        loop {
            let address = self.servers[self.next % self.servers.len()];
            self.next += 1;
            self.connection(address).await;
            // Vehicles come and go meanwhile.
            self.pass();
            sleep(Duration::from_millis(500)).await;
        }
    }

    async fn connection(&mut self, address: SocketAddr) {
        let mut options =
            BrokerLogin::plain(BrokerAddress::from(address), self.cell.as_str(), PASSWORD)
                .options();
        options.set_keep_alive(Duration::from_secs(5));
        let (client, mut events) = AsyncClient::new(options, 32);
        let mut network = NetworkOptions::new();
        network.set_connection_timeout(10);
        events.set_network_options(network);
        let (mut ticks, mut is_up) = (interval(Duration::from_millis(250)), false);
        loop {
            tokio::select! {
                event = events.poll() => match event {
                    Ok(Event::Incoming(Packet::ConnAck(_))) => {
                        self.exchange.connect();
                        is_up = true;
                    }
                    Ok(Event::Incoming(Packet::Publish(message))) => {
                        if let Ok(said) = decode(&message.payload, &Limits::default()) {
                            self.exchange.hear(&said, clock::now());
                        }
                    }
                    Ok(_) => {}
                    Err(_) => return,
                },
                _ = ticks.tick() => {
                    self.pass();
                    if is_up {
                        self.tell(&client);
                    }
                }
            }
        }
    }

    /// Lets a vehicle leave and the next one come when it is time.
    fn pass(&mut self) {
        if self
            .vehicle
            .as_ref()
            .is_some_and(|(_, since)| since.elapsed() < STAY)
        {
            return;
        }
        if let Some((vehicle, _)) = self.vehicle.take() {
            let votes = 10 + self.passed;
            let all = Counts {
                correct: votes,
                incorrect: 1,
            };
            self.exchange.count(
                &vehicle,
                CellCounts {
                    all,
                    ..CellCounts::default()
                },
                clock::now(),
            );
            let topic = ReputationTopic {
                vehicle,
                cell: self.cell.clone(),
            }
            .path();
            self.left
                .lock()
                .unwrap_or_else(PoisonError::into_inner)
                .insert(topic, votes);
            self.passed += 1;
        }
        if !self.is_over.load(Ordering::Relaxed) {
            self.vehicle = NodeName::new(format!("v{}", self.passed))
                .ok()
                .map(|vehicle| (vehicle, Instant::now()));
        }
        self.exchange.set_present(
            &self
                .vehicle
                .iter()
                .map(|(vehicle, _)| vehicle.clone())
                .collect(),
        );
    }

    fn tell(&mut self, client: &AsyncClient) {
        for step in self.exchange.next(clock::now(), 6) {
            match step {
                ExchangeStep::Subscribe(filters) => {
                    let filters = filters
                        .into_iter()
                        .map(|filter| SubscribeFilter::new(filter, QoS::AtMostOnce));
                    if client.try_subscribe_many(filters).is_err() {
                        self.exchange.connect();
                    }
                }
                ExchangeStep::Unsubscribe(filters) => {
                    filters
                        .into_iter()
                        .for_each(|filter| _ = client.try_unsubscribe(filter));
                }
                ExchangeStep::Publish(said) => {
                    let topic = ReputationTopic {
                        vehicle: said.vehicle.clone(),
                        cell: said.cell.clone(),
                    }
                    .path();
                    let payload = encode(&said, Encoding::Compact);
                    if client
                        .try_publish(topic, QoS::AtLeastOnce, true, payload)
                        .is_err()
                    {
                        self.exchange.not_sent(&said.vehicle);
                    }
                }
            }
        }
    }
}
