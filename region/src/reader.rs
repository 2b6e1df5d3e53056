//! The connection to a region's broker: reads the tiles in view, and the status of every cell.

use std::collections::{BTreeSet, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use ecod::model::quadkey::Quadkey;
use ecod::model::time::Timestamp;
use ecod::wire::{RegionTopic, RegionTopicKind};
use ecod_actors::platform::clock;
use rumqttc::{
    AsyncClient, Event, EventLoop, NetworkOptions, Outgoing, Packet, QoS, SubscribeFilter,
    SubscribeReasonCode,
};
use tokio::sync::watch;

use crate::broker::BrokerLogin;
use crate::town::{Accepted, CellRefusal, ReadTiles, RegionTown};

/// Town and connection, for page, metrics and exports.
#[derive(Debug, Default)]
pub struct RegionState {
    town: Mutex<RegionTown>,
    link: Mutex<BrokerLink>,
    tiles: watch::Sender<BTreeSet<Quadkey>>,
    read: Mutex<ReadTiles>,
}

/// The connection, as an operator sees it.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct BrokerLink {
    /// True while the reader is logged in at the broker.
    pub is_up: bool,
    /// Number of logins so far.
    pub logins: u64,
    /// The reason why it is not logged in, or the filters that the broker refuses.
    pub trouble: Option<String>,
}

/// A message and its outcome.
#[derive(Debug)]
pub struct Reading<'a> {
    /// Topic of the message.
    pub topic: &'a str,
    /// Payload of the message as received.
    pub payload: &'a [u8],
    /// When it was read.
    pub at: Timestamp,
    /// Its content if it counts, otherwise the reason.
    pub outcome: Result<Accepted, CellRefusal>,
}

/// Requests that wait for the network at most.
const SEND_QUEUE: usize = 64;

/// First and longest wait before the next attempt to connect.
const RETRY_MIN: Duration = Duration::from_millis(100);
const RETRY_MAX: Duration = Duration::from_secs(5);

/// Maximum time for a login in seconds. Servers that elect a JetStream leader take up to 4 s.
const CONNECT_TIMEOUT_S: u64 = 10;

impl RegionState {
    /// Locks the town until the guard is dropped.
    pub fn town(&self) -> MutexGuard<'_, RegionTown> {
        self.town.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// State of the connection to the broker.
    pub fn link(&self) -> BrokerLink {
        lock(&self.link).clone()
    }

    /// The tiles whose maps are read; empty while there is no connection.
    pub fn tiles(&self) -> ReadTiles {
        lock(&self.read).clone()
    }

    /// Sets the tiles whose maps are read. They must not contain each other.
    pub fn ask(&self, tiles: BTreeSet<Quadkey>) {
        self.tiles.send_if_modified(|asked| {
            let is_news = *asked != tiles;
            *asked = tiles;
            is_news
        });
    }
}

/// Reads without end; `seen` is called for every message. A lost connection is re-established.
pub async fn read(
    login: &BrokerLogin,
    state: &Arc<RegionState>,
    mut seen: impl FnMut(&Reading<'_>),
) {
    let (client, mut events) = AsyncClient::new(login.options(), SEND_QUEUE);
    let mut network = NetworkOptions::new();
    network.set_connection_timeout(CONNECT_TIMEOUT_S);
    network.set_tcp_nodelay(true);
    events.set_network_options(network);
    let (logins, logged_in) = watch::channel(0_u64);
    let asked = Arc::new(Mutex::new(VecDeque::new()));
    let subscribing = subscribe(client, state, logged_in, &asked);
    let polling = poll(login, &mut events, state, &logins, &asked, &mut seen);
    tokio::join!(subscribing, polling);
}

/// Filters of each subscription that waits for its answer, in order.
type Asked = Mutex<VecDeque<Vec<String>>>;

/// Keeps the subscriptions equal to the requested tiles.
async fn subscribe(
    client: AsyncClient,
    state: &RegionState,
    mut logged_in: watch::Receiver<u64>,
    asked: &Asked,
) {
    let mut tiles = state.tiles.subscribe();
    let mut present = BTreeSet::new();
    loop {
        let is_new = tokio::select! {
            changed = logged_in.changed() => match changed {
                Ok(()) => true,
                Err(_) => return,
            },
            changed = tiles.changed() => match changed {
                Ok(()) => false,
                Err(_) => return,
            },
        };
        if is_new {
            present = BTreeSet::new();
            lock(asked).clear();
        }
        if *logged_in.borrow() == 0 {
            continue;
        }
        let asked_tiles = tiles.borrow_and_update().clone();
        let of_tiles = asked_tiles
            .iter()
            .map(|tile| RegionTopic::filter_within(*tile));
        let wanted: BTreeSet<_> = of_tiles
            .chain([RegionTopic::filter_everywhere(RegionTopicKind::Status)])
            .collect();
        let new = &wanted - &present;
        let old = &present - &wanted;
        for filter in old {
            // The next login subscribes anew if the connection has ended.
            let _ = client.unsubscribe(filter).await;
        }
        if !new.is_empty() {
            let filters: Vec<_> = new.into_iter().collect();
            let subscriptions: Vec<_> = filters
                .iter()
                .map(|filter| SubscribeFilter::new(filter.clone(), QoS::AtMostOnce))
                .collect();
            lock(asked).push_back(filters);
            // The next login subscribes anew if the connection has ended.
            let _ = client.subscribe_many(subscriptions).await;
        }
        present = wanted;
        // A connection that ended in the meantime reads no more messages.
        let link = lock(&state.link);
        if link.is_up {
            lock(&state.read).replace(asked_tiles.into_iter(), clock::now());
        }
    }
}

async fn poll(
    login: &BrokerLogin,
    events: &mut EventLoop,
    state: &RegionState,
    logins: &watch::Sender<u64>,
    asked: &Asked,
    seen: &mut impl FnMut(&Reading<'_>),
) {
    let mut wait = RETRY_MIN;
    loop {
        match events.poll().await {
            Ok(Event::Incoming(Packet::ConnAck(_))) => {
                wait = RETRY_MIN;
                let mut link = lock(&state.link);
                lock(&state.read).clear();
                *link = BrokerLink {
                    is_up: true,
                    logins: link.logins + 1,
                    trouble: None,
                };
                logins.send_replace(link.logins);
            }
            Ok(Event::Incoming(Packet::Publish(message))) => {
                let at = clock::now();
                let outcome = state.town().accept(&message.topic, &message.payload, at);
                seen(&Reading {
                    topic: &message.topic,
                    payload: &message.payload,
                    at,
                    outcome,
                });
            }
            Ok(Event::Incoming(Packet::SubAck(answer))) => {
                let filters = lock(asked).pop_front().unwrap_or_default();
                let answers = filters.into_iter().zip(answer.return_codes);
                let refused: Vec<_> = answers
                    .filter(|(_, code)| *code == SubscribeReasonCode::Failure)
                    .map(|(filter, _)| filter)
                    .collect();
                if !refused.is_empty() {
                    let trouble =
                        format!("the broker lets this user not read {}", refused.join(", "));
                    tracing::warn!(broker = %login.address(), trouble);
                    lock(&state.link).trouble = Some(trouble);
                }
            }
            Ok(Event::Outgoing(Outgoing::Disconnect)) => return,
            Ok(_) => {}
            Err(error) => {
                let trouble = format!("no connection to {}: {error}", login.address());
                {
                    let mut link = lock(&state.link);
                    lock(&state.read).clear();
                    if link.is_up || link.trouble.is_none() {
                        tracing::warn!(broker = %login.address(), %error, "no connection to the region's broker");
                    }
                    *link = BrokerLink {
                        is_up: false,
                        logins: link.logins,
                        trouble: Some(trouble),
                    };
                }
                tokio::time::sleep(wait).await;
                wait = (2 * wait).min(RETRY_MAX);
            }
        }
    }
}

fn lock<T>(shared: &Mutex<T>) -> MutexGuard<'_, T> {
    shared.lock().unwrap_or_else(PoisonError::into_inner)
}
