//! The task that keeps one link to one broker: connects, reads, and connects anew.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use bytes::Bytes;
use ecod::time::Timestamp;
use ecod::wire::RejectReason;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rustls::ClientConfig;
use tokio::task::{AbortHandle, JoinHandle};
use uuid::Uuid;

use super::address::BrokerAddress;
use super::config::MqttConfig;
use super::connection::{self, Client, ConnectionError, LastWill, Packet, Retention};
use super::inbox::{Inbox, LinkState, PacketOutcome};
use super::security::Security;
use super::silence::{Hearing, Silence};
use crate::platform::clock;
use crate::telemetry::counters::{Counters, Event};

/// Tells links apart, also an old and a new one to the same broker.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(crate) struct LinkId(pub(crate) u64);

/// What a link's task tells the gateway.
#[derive(Debug)]
pub struct LinkEvent {
    pub(crate) link: LinkId,
    pub(crate) change: LinkChange,
}

#[derive(Debug)]
pub(crate) enum LinkChange {
    /// The broker accepted the connection; nothing is subscribed yet.
    Accepted(Client),
    /// The broker published the last will of this living node.
    DeclaredOffline,
    /// Another living run has this node's name.
    Namesake(Uuid),
    /// A broker that seemed stalled has sent something.
    Answered,
    /// Not connected; attempts go on.
    Lost(LinkState),
}

/// Takes the events of links; false once nobody takes them any more.
pub(crate) type LinkSink = Arc<dyn Fn(LinkEvent) -> bool + Send + Sync>;

/// Settings and inbox that all links of a gateway share.
pub(crate) struct LinkSetup {
    pub(crate) client_id: String,
    pub(crate) filters: Vec<String>,
    /// The will of the next connection.
    pub(crate) will: Mutex<LastWill>,
    pub(crate) config: MqttConfig,
    pub(crate) security: Security,
    pub(crate) inbox: Arc<Inbox>,
    pub(crate) counters: Arc<Counters>,
    pub(crate) seed: u64,
}

/// A running link; dropping it cuts the connection, upon which the broker publishes the last will.
#[derive(Debug)]
pub(crate) struct Link {
    pub(crate) broker: BrokerAddress,
    pub(crate) state: LinkState,
    pub(crate) client: Option<Client>,
    hearing: Arc<Hearing>,
    silence: Silence,
    task: Option<JoinHandle<()>>,
    abort: AbortHandle,
}

impl Link {
    pub(crate) fn spawn(id: LinkId, broker: BrokerAddress, setup: Arc<LinkSetup>, report: LinkSink) -> Self {
        let backoff = Backoff::new(&setup.config, setup.seed.wrapping_add(id.0));
        let (hearing, at) = (Arc::<Hearing>::default(), broker.clone());
        let task =
            Task { id, broker: at, setup, report, hearing, reported_refusal: None, has_reported_oversized: false };
        let hearing = Arc::clone(&task.hearing);
        let task = tokio::spawn(task.run(backoff));
        let (abort, silence) = (task.abort_handle(), Silence::default());
        Self { broker, state: LinkState::Down, client: None, hearing, silence, abort, task: Some(task) }
    }

    /// Queues a message; false when there is no connection or no room.
    pub(crate) fn publish(&self, topic: &str, payload: &Bytes, retention: Retention) -> bool {
        self.client.as_ref().is_some_and(|client| client.publish(topic, payload, retention))
    }

    /// Notes a message that the broker should pass back to this node, whether or not there was room for it; true when
    /// the broker seems stalled.
    pub(crate) fn misses_echo(&mut self, now: Timestamp) -> bool {
        let is_stalled = self.silence.note_sent(self.hearing.packets(), now);
        if is_stalled {
            self.hearing.miss();
        }
        is_stalled
    }

    /// Takes leave of the broker without a last will; what was queued before goes out first, within `patience`.
    pub(crate) async fn leave(mut self, patience: Duration) {
        let said = self.client.as_ref().is_some_and(Client::disconnect);
        if said
            && let Some(task) = self.task.take()
            && tokio::time::timeout(patience, task).await.is_err()
        {
            tracing::debug!(broker = %self.broker, "broker did not take the farewell");
        }
    }
}

impl Drop for Link {
    fn drop(&mut self) {
        self.abort.abort();
    }
}

/// Waits before the first attempts after a session broke, for the quickest word of whether the broker's process is
/// gone: a process that ends may still have the port for a moment when its connections break.
const FIRST_RETRIES: [Duration; 3] = [Duration::ZERO, Duration::from_millis(5), Duration::from_millis(10)];

/// A session shorter than this earns no such attempts, or a broker that ends every session would be tried without
/// pause.
const MIN_SESSION: Duration = Duration::from_millis(200);

struct Task {
    id: LinkId,
    broker: BrokerAddress,
    setup: Arc<LinkSetup>,
    report: LinkSink,
    hearing: Arc<Hearing>,
    /// What the broker refused, as last told of.
    reported_refusal: Option<String>,
    has_reported_oversized: bool,
}

impl Task {
    async fn run(mut self, mut backoff: Backoff) {
        // The first answer is waited for half as long: a session that outlived this was in use. One that ends sooner,
        // such as by a retained packet beyond all bounds, must not be tried again at full speed.
        let in_use = 2 * self.setup.config.connect_timeout();
        let mut checks = FIRST_RETRIES.iter();
        loop {
            let begun = Instant::now();
            let error = match self.attempt().await {
                Ok(()) => return,
                Err(error) => error,
            };
            let state = if error.is_refused() { LinkState::Refused } else { LinkState::Down };
            tracing::debug!(broker = %self.broker, %error, "link lost");
            if let Some(reason) = error.refusal() {
                self.report_refusal(format!("{NOT_ADMITTED}: {reason}"));
            }
            if error.is_oversized() {
                self.setup.counters.reject(RejectReason::TooLarge);
                if !std::mem::replace(&mut self.has_reported_oversized, true) {
                    let limit = self.setup.config.max_packet_bytes();
                    tracing::warn!(broker = %self.broker, limit, "link lost to a packet that is too large; if it is \
                        retained it comes again and again: remove it, and have the broker limit its messages");
                }
            }
            if !self.tell(LinkChange::Lost(state)) {
                return;
            }
            if begun.elapsed() > in_use {
                backoff.reset();
            }
            if begun.elapsed() > MIN_SESSION {
                checks = FIRST_RETRIES.iter();
            }
            let wait = checks.next().copied().unwrap_or_else(|| backoff.next_wait());
            tokio::time::sleep(wait).await;
        }
    }

    /// One connection for as long as the broker's certificate is good.
    async fn attempt(&mut self) -> Result<(), ConnectionError> {
        let Some(trust) = self.setup.security.tls(&self.broker).map_err(Box::new)? else {
            return self.session(None).await;
        };
        tokio::select! {
            ended = self.session(Some(trust.client())) => ended,
            error = trust.invalidated() => {
                self.setup.counters.count(Event::Disconnected);
                Err(ConnectionError::BrokerInvalidated(error))
            }
        }
    }

    /// One connection from beginning to end; `Ok` after a farewell.
    async fn session(&mut self, tls: Option<Arc<ClientConfig>>) -> Result<(), ConnectionError> {
        let setup = Arc::clone(&self.setup);
        let LinkSetup { client_id, will, config, inbox, counters, .. } = &*setup;
        let will = will.lock().unwrap_or_else(PoisonError::into_inner).clone();
        let (client, mut connection) = connection::open(&self.broker, client_id, Some(&will), config, tls);
        // The protocol's own timeouts are whole seconds.
        connection.next(config.connect_timeout()).await.inspect_err(|_| counters.count(Event::ConnectFailed))?;
        counters.count(Event::Connected);
        self.hearing.note();
        self.reported_refusal.take_if(|reported_refusal| reported_refusal.starts_with(NOT_ADMITTED));
        if !self.tell(LinkChange::Accepted(client)) {
            return Ok(());
        }
        // Pings alone make something come in every keep-alive; longer silence is a connection that hangs. What is sent
        // is no sign of life, and a poll that takes longer was held up on this side.
        let patience = 2 * config.keep_alive();
        let mut silent = Duration::ZERO;
        let accepted = Instant::now();
        let mut heard_itself = false;
        loop {
            let polled = Instant::now();
            let packet = connection.next(patience.saturating_sub(silent)).await;
            let packet = packet.inspect_err(|_| counters.count(Event::Disconnected))?;
            if matches!(packet, Packet::Sent) {
                silent += polled.elapsed().min(config.keep_alive());
                continue;
            }
            silent = Duration::ZERO;
            if self.hearing.note() {
                self.tell(LinkChange::Answered);
            }
            match packet {
                Packet::Message { topic, payload } => {
                    match inbox.accept(&self.broker, &topic, &payload, clock::now()) {
                        PacketOutcome::DeclaredOffline => {
                            self.tell(LinkChange::DeclaredOffline);
                        }
                        PacketOutcome::Namesake(run) => {
                            self.tell(LinkChange::Namesake(run));
                        }
                        PacketOutcome::OwnStatus => {
                            heard_itself = true;
                            self.reported_refusal.take_if(|reported_refusal| reported_refusal == NOT_HEARD);
                        }
                        PacketOutcome::Done => {}
                    }
                }
                Packet::SubscriptionRefused(refused) => {
                    let name = |(index, reason): (usize, String)| {
                        format!("{} ({reason})", setup.filters.get(index).map_or("?", String::as_str))
                    };
                    let refused: Vec<_> = refused.into_iter().map(name).collect();
                    self.report_refusal(format!("subscription refused: {}", refused.join(", ")));
                }
                Packet::Disconnected => return Ok(()),
                Packet::Accepted | Packet::Sent | Packet::Other => {}
            }
            if !heard_itself && accepted.elapsed() > config.connect_timeout() && self.reported_refusal.is_none() {
                self.report_refusal(NOT_HEARD.to_owned());
            }
        }
    }

    /// Warns of what the broker refuses, once per change.
    fn report_refusal(&mut self, refusal: String) {
        if self.reported_refusal.as_ref() != Some(&refusal) {
            tracing::warn!(broker = %self.broker, refusal, "broker refuses this node, check its password, certificate and permissions");
            self.setup.counters.count(Event::BrokerRefused);
            self.reported_refusal = Some(refusal);
        }
    }

    /// False when the gateway is gone.
    fn tell(&self, change: LinkChange) -> bool {
        (self.report)(LinkEvent { link: self.id, change })
    }
}

/// A broker that wants other credentials.
const NOT_ADMITTED: &str = "connection refused";

/// A broker acknowledges what it does not permit; only the missing echo tells.
const NOT_HEARD: &str = "this node's own status does not come back: publishing or subscribing to it is not permitted";

/// Waits that double with every failure, shortened by up to half at random.
struct Backoff {
    least: Duration,
    most: Duration,
    next: Duration,
    rng: ChaCha8Rng,
}

impl Backoff {
    fn new(config: &MqttConfig, seed: u64) -> Self {
        let least = Duration::from_millis(config.retry_min_ms);
        let most = Duration::from_millis(config.retry_max_ms);
        Self { least, most, next: least, rng: ChaCha8Rng::seed_from_u64(seed) }
    }

    fn reset(&mut self) {
        self.next = self.least;
    }

    fn next_wait(&mut self) -> Duration {
        let wait = self.next.mul_f64(self.rng.random_range(0.5..=1.0));
        self.next = (2 * self.next).min(self.most);
        wait
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn waits_grow_to_the_bound_with_jitter_and_start_over_after_success() {
        let config = MqttConfig { retry_min_ms: 50, retry_max_ms: 400, ..MqttConfig::default() };
        let waits = |seed| {
            let mut backoff = Backoff::new(&config, seed);
            let waits: Vec<_> = (0..6).map(|_| backoff.next_wait()).collect();
            backoff.reset();
            (waits, backoff.next_wait())
        };
        let (first, restarted) = waits(1);
        for (wait, bound_ms) in first.iter().zip([50, 100, 200, 400, 400, 400]) {
            let bound = Duration::from_millis(bound_ms);
            assert!(*wait <= bound && *wait >= bound / 2, "{wait:?} {bound:?}");
        }
        assert!(restarted <= Duration::from_millis(50));
        assert_eq!(waits(1).0, first);
        assert_ne!(waits(2).0, first);
    }
}
