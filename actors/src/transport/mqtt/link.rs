//! A link to one broker: its task connects, reads packets, and reconnects.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use bytes::Bytes;
use ecod::diagnostics::TroubleKind;
use ecod::leadership::BrokerAddress;
use ecod::leadership::echo::EchoMonitor;
use ecod::leadership::links::LinkState;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::wire::RejectReason;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rustls::ClientConfig;
use tokio::task::{AbortHandle, JoinHandle};
use uuid::Uuid;

use super::config::MqttConfig;
use super::connection::{self, Client, ConnectionError, LastWill, Packet, Retention};
use super::packet_counter::PacketCounter;
use super::packet_sink::{PacketOutcome, PacketSink, Via};
use super::security::Security;
use crate::platform::clock;
use crate::telemetry::counters::{Counters, Event};
use crate::transport::pki::BrokerIdentity;

/// Id of a link; a new link to the same broker has another.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(crate) struct LinkId(pub(crate) u64);

/// A message of a link's task to the gateway.
#[derive(Debug)]
pub struct LinkEvent {
    pub(crate) link: LinkId,
    pub(crate) change: LinkChange,
}

#[derive(Debug)]
pub(crate) enum LinkChange {
    /// The broker accepted the connection; there are no subscriptions yet. `node` is the node whose
    /// certificate the broker has, if any.
    Accepted {
        client: Client,
        node: Option<NodeName>,
    },
    /// The broker published this node's last will, although it is alive.
    DeclaredOffline,
    /// Another run with this node's name is alive.
    Namesake(Uuid),
    /// A stalled broker has sent a packet.
    Answered,
    /// Not connected; attempts continue.
    Lost(LinkState),
}

/// Callback for the events of links; false once the gateway has ended.
pub(crate) type LinkSink = Arc<dyn Fn(LinkEvent) -> bool + Send + Sync>;

/// Settings and receiver that all links of an actor share.
pub(crate) struct LinkSetup {
    pub(crate) client_id: String,
    pub(crate) filters: Vec<String>,
    /// Last will of the next connection.
    pub(crate) will: Mutex<LastWill>,
    pub(crate) config: MqttConfig,
    pub(crate) security: Security,
    pub(crate) sink: Arc<dyn PacketSink>,
    /// The trouble to record if the configured broker is unreachable.
    pub(crate) unreachable: TroubleKind,
    pub(crate) counters: Arc<Counters>,
    pub(crate) seed: u64,
}

/// A running link. Dropping it cuts the connection, and the broker publishes the last will.
#[derive(Debug)]
pub(crate) struct Link {
    pub(crate) broker: BrokerAddress,
    pub(crate) state: LinkState,
    pub(crate) client: Option<Client>,
    /// The node whose certificate the broker has proven in the last handshake.
    pub(crate) node: Option<NodeName>,
    packets: Arc<PacketCounter>,
    /// True once the gateway leaves the broker.
    is_leaving: Arc<AtomicBool>,
    echo: EchoMonitor,
    task: Option<JoinHandle<()>>,
    abort: AbortHandle,
}

impl Link {
    /// Starts a link in its own task. `report` gets its events, and the link is [`LinkState::Down`]
    /// until the first of them.
    pub(crate) fn spawn(
        id: LinkId,
        broker: BrokerAddress,
        setup: Arc<LinkSetup>,
        report: LinkSink,
    ) -> Self {
        let backoff = Backoff::new(&setup.config, setup.seed.wrapping_add(id.0));
        let packets = Arc::<PacketCounter>::default();
        let at = broker.clone();
        let task = LinkTask {
            id,
            broker: at,
            setup,
            report,
            packets,
            is_leaving: Arc::default(),
            reported_refusal: None,
            has_reported_oversized: false,
            has_reported_clock: false,
        };
        let packets = Arc::clone(&task.packets);
        let is_leaving = Arc::clone(&task.is_leaving);
        let task = tokio::spawn(task.run(backoff));
        let abort = task.abort_handle();
        let echo = EchoMonitor::default();
        Self {
            broker,
            state: LinkState::Down,
            client: None,
            node: None,
            packets,
            is_leaving,
            echo,
            abort,
            task: Some(task),
        }
    }

    /// Queues a message; false if there is no connection or no room.
    pub(crate) fn publish(&self, topic: &str, payload: &Bytes, retention: Retention) -> bool {
        self.client
            .as_ref()
            .is_some_and(|client| client.publish(topic, payload, retention))
    }

    /// Records a message whose echo is expected, even if there was no room to send it; true if the
    /// broker is stalled.
    pub(crate) fn misses_echo(&mut self, now: Timestamp) -> bool {
        let is_stalled = self.echo.record_sent(self.packets.count(), now);
        if is_stalled {
            self.packets.notify_next();
        }
        is_stalled
    }

    /// Sends the queued messages and DISCONNECT, so that there is no last will, within `patience`.
    pub(crate) async fn leave(mut self, patience: Duration) {
        self.is_leaving.store(true, Ordering::Relaxed);
        let is_sent = self.client.as_ref().is_some_and(Client::disconnect);
        if is_sent
            && let Some(task) = self.task.take()
            && tokio::time::timeout(patience, task).await.is_err()
        {
            tracing::debug!(broker = %self.broker, "broker did not accept the leave messages");
        }
    }
}

impl Drop for Link {
    fn drop(&mut self) {
        self.abort.abort();
    }
}

/// Waits before the first attempts after a broken session. These attempts soon show whether the
/// broker's process is gone: it may hold the port for a moment after its connections broke.
const FIRST_RETRIES: [Duration; 3] = [
    Duration::ZERO,
    Duration::from_millis(5),
    Duration::from_millis(10),
];

/// Minimum length of a session that is followed by [`FIRST_RETRIES`]. Without it, a broker that
/// ends every session would be tried without pause.
const MIN_SESSION: Duration = Duration::from_millis(200);

struct LinkTask {
    id: LinkId,
    broker: BrokerAddress,
    setup: Arc<LinkSetup>,
    report: LinkSink,
    packets: Arc<PacketCounter>,
    is_leaving: Arc<AtomicBool>,
    /// The refusal that was logged last.
    reported_refusal: Option<String>,
    has_reported_oversized: bool,
    /// True if the wrong clock of this machine was reported.
    has_reported_clock: bool,
}

impl LinkTask {
    /// Connects again and again until DISCONNECT was sent or the gateway has ended. After a session
    /// that was in use the waits start from the shortest.
    ///
    /// # Example
    /// The broker's process is killed after minutes: the session ends, and `Lost(Down)` is
    /// reported. The first retry follows at once and finds the port closed: `Lost(Refused)`.
    /// Further retries follow after 5 ms and 10 ms, then after increasing waits.
    async fn run(mut self, mut backoff: Backoff) {
        // A session that lasted longer was in use. A session that ends sooner, for example because
        // of an oversized retained packet, must not be repeated at full speed.
        let in_use = 2 * self.setup.config.connect_timeout();
        let mut checks = FIRST_RETRIES.iter();
        loop {
            let begun = Instant::now();
            let error = match self.attempt().await {
                Ok(()) => return,
                Err(error) => error,
            };
            let state = match error {
                ConnectionError::NotListening(_) => LinkState::Refused,
                _ => LinkState::Down,
            };
            tracing::debug!(broker = %self.broker, %error, "link lost");
            match self.setup.security.clock_fault() {
                Some(fault) if !std::mem::replace(&mut self.has_reported_clock, true) => {
                    tracing::warn!(broker = %self.broker, "{fault}; the node keeps trying and connects once this is corrected");
                }
                Some(_) => {}
                None => self.has_reported_clock = false,
            }
            self.record_unreachable(&error);
            if let Some(reason) = error.rejection() {
                self.report_refusal(format!("{NOT_ADMITTED}: {reason}"));
            }
            if matches!(error, ConnectionError::Oversized(_)) {
                self.setup
                    .counters
                    .reject(RejectReason::TooLarge, &self.broker.to_string());
                if !std::mem::replace(&mut self.has_reported_oversized, true) {
                    let limit = self.setup.config.max_packet_bytes();
                    tracing::warn!(broker = %self.broker, limit, "link lost to a packet that is too large; if it is \
                        retained it comes again and again: remove it, and have the broker limit its messages");
                }
            }
            if !self.report_change(LinkChange::Lost(state)) {
                return;
            }
            if begun.elapsed() > in_use {
                backoff.reset();
            }
            if begun.elapsed() > MIN_SESSION {
                checks = FIRST_RETRIES.iter();
            }
            let wait = checks
                .next()
                .copied()
                .unwrap_or_else(|| backoff.next_wait());
            tokio::time::sleep(wait).await;
        }
    }

    /// One connection, for as long as the broker's certificate is valid. After a renewal of either
    /// side's certificate another connection replaces it at once, and the gateway's link stays up.
    async fn attempt(&mut self) -> Result<(), ConnectionError> {
        loop {
            let Some(trust) = self.setup.security.tls(&self.broker).map_err(Box::new)? else {
                return self.session(None).await.map(drop);
            };
            let tls = (trust.client(), trust.identity());
            let end = tokio::select! {
                ended = self.session(Some(tls)) => ended?,
                error = trust.invalidated() => {
                    self.setup.counters.count(Event::Disconnected);
                    return Err(ConnectionError::BrokerInvalidated(error));
                }
            };
            match end {
                SessionEnd::Left => return Ok(()),
                SessionEnd::Renewed if self.is_leaving.load(Ordering::Relaxed) => return Ok(()),
                SessionEnd::Renewed => {
                    tracing::debug!(broker = %self.broker, "logging in with renewed certificates");
                }
            }
        }
    }

    /// One connection from CONNECT to its end; `Ok` after DISCONNECT.
    async fn session(
        &mut self,
        tls: Option<(Arc<ClientConfig>, BrokerIdentity)>,
    ) -> Result<SessionEnd, ConnectionError> {
        let setup = Arc::clone(&self.setup);
        let LinkSetup {
            client_id,
            will,
            config,
            sink,
            counters,
            ..
        } = &*setup;
        let will = will.lock().unwrap_or_else(PoisonError::into_inner).clone();
        let (tls, identity) = tls.unzip();
        let (client, mut connection) =
            connection::open(&self.broker, client_id, Some(&will), config, tls);
        // The protocol's own timeouts are whole seconds.
        connection
            .next(config.connect_timeout())
            .await
            .inspect_err(|_| counters.count(Event::ConnectFailed))?;
        counters.count(Event::Connected);
        let node = identity.as_ref().and_then(BrokerIdentity::node);
        let mut renewal = identity.map(|identity| {
            let seed = setup.seed.wrapping_add(self.id.0);
            LoginRenewal::new(client.clone(), identity, seed)
        });
        // A broker that still has its former certificate would end in an endless row of logins.
        renewal.take_if(|renewal| setup.security.has_renewed(&renewal.identity));
        self.packets.record();
        self.end_refusal(|refusal| refusal.starts_with(NOT_ADMITTED));
        counters
            .troubles()
            .settle(setup.unreachable, Some(&self.broker.to_string()));
        if !self.report_change(LinkChange::Accepted {
            client,
            node: node.clone(),
        }) {
            return Ok(SessionEnd::Left);
        }
        // A working connection receives at least the answers to pings. Sent packets are not a sign
        // of life. A poll that takes longer than a keep-alive was stalled on this side.
        let patience = 2 * config.keep_alive();
        let mut silent = Duration::ZERO;
        // Time spent waiting for this node's own status. A single wait may be a stall and is not
        // enough for a verdict.
        let mut listened = Duration::ZERO;
        let mut received_itself = false;
        loop {
            let polled = Instant::now();
            let packet = connection
                .next(patience.saturating_sub(silent))
                .await
                .inspect_err(|_| counters.count(Event::Disconnected))?;
            listened += polled.elapsed().min(3 * config.connect_timeout() / 4);
            if matches!(packet, Packet::Sent) {
                silent += polled.elapsed().min(config.keep_alive());
                continue;
            }
            silent = Duration::ZERO;
            if self.packets.record() {
                self.report_change(LinkChange::Answered);
            }
            if let Some(renewal) = &mut renewal {
                let topic = match &packet {
                    Packet::Message { topic, .. } => &**topic,
                    _ => &[],
                };
                renewal.on_packet(&setup.security, topic);
            }
            match packet {
                Packet::Message { topic, payload } => {
                    let via = Via {
                        address: &self.broker,
                        node: node.as_ref(),
                    };
                    match sink.accept(via, &topic, &payload, clock::now()) {
                        PacketOutcome::DeclaredOffline => {
                            self.report_change(LinkChange::DeclaredOffline);
                        }
                        PacketOutcome::Namesake(run) => {
                            self.report_change(LinkChange::Namesake(run));
                        }
                        PacketOutcome::OwnStatus => {
                            received_itself = true;
                            self.end_refusal(|refusal| refusal == NOT_HEARD);
                        }
                        PacketOutcome::Done => {}
                    }
                }
                Packet::SubscriptionRefused(refused) => {
                    let name = |(index, reason): (usize, String)| {
                        format!(
                            "{} ({reason})",
                            setup.filters.get(index).map_or("?", String::as_str)
                        )
                    };
                    let refused: Vec<_> = refused.into_iter().map(name).collect();
                    self.report_refusal(format!("subscription refused: {}", refused.join(", ")));
                }
                Packet::Disconnected => {
                    let is_renewed = renewal.is_some_and(|renewal| renewal.has_left);
                    return Ok(if is_renewed {
                        SessionEnd::Renewed
                    } else {
                        SessionEnd::Left
                    });
                }
                // Only the return of the node's own status is decisive.
                Packet::Accepted | Packet::Sent | Packet::PublishRefused(_) | Packet::Other => {}
            }
            if !received_itself
                && listened > config.connect_timeout()
                && self.reported_refusal.is_none()
            {
                self.report_refusal(NOT_HEARD.to_owned());
            }
        }
    }

    /// Records that the configured broker is unreachable. Other brokers come and go with their
    /// nodes, which the election tracks.
    fn record_unreachable(&self, error: &ConnectionError) {
        let is_expected = self.setup.config.broker.as_ref() == Some(&self.broker);
        if is_expected
            && error.rejection().is_none()
            && !matches!(error, ConnectionError::Oversized(_))
        {
            let broker = self.broker.to_string();
            let troubles = self.setup.counters.troubles();
            troubles.record_about(
                &broker,
                self.setup.unreachable,
                &format!("broker not reached: {error}"),
            );
        }
    }

    /// Records a refusal of the broker.
    fn report_refusal(&mut self, refusal: String) {
        let broker = self.broker.to_string();
        let cause = format!("broker refuses this node: {refusal}");
        self.setup
            .counters
            .troubles()
            .record_about(&broker, TroubleKind::BrokerRefuses, &cause);
        if self.reported_refusal.as_ref() != Some(&refusal) {
            self.setup.counters.count(Event::BrokerRefused);
            self.reported_refusal = Some(refusal);
        }
    }

    /// Records the end of a refusal for which `is_over` is true.
    fn end_refusal(&mut self, is_over: impl Fn(&str) -> bool) {
        if self
            .reported_refusal
            .take_if(|refusal| is_over(refusal))
            .is_some()
        {
            let troubles = self.setup.counters.troubles();
            troubles.settle(TroubleKind::BrokerRefuses, Some(&self.broker.to_string()));
        }
    }

    /// Sends to the gateway; returns false if it has ended.
    fn report_change(&self, change: LinkChange) -> bool {
        (self.report)(LinkEvent {
            link: self.id,
            change,
        })
    }
}

impl Drop for LinkTask {
    fn drop(&mut self) {
        self.end_refusal(|_| true);
        // A link that is not wanted any more does not report its broker.
        self.setup
            .counters
            .troubles()
            .settle(self.setup.unreachable, Some(&self.broker.to_string()));
    }
}

/// The end of a session after DISCONNECT.
enum SessionEnd {
    /// The gateway leaves the broker.
    Left,
    /// A certificate of the session was renewed: another session follows.
    Renewed,
}

/// Replaces a session before the end of its certificates. The replacement takes some milliseconds,
/// so it begins after a round's last message, and the links of a cell do not begin together: each
/// round still arrives, at the latest over another broker.
///
/// # Example
/// The node's certificate is renewed at 0 s. `on_packet` notices it within 1 s and waits for up to
/// 5 s. The next map follows, and 1 ms later verdicts: after them the session ends by DISCONNECT.
struct LoginRenewal {
    client: Client,
    identity: BrokerIdentity,
    rng: ChaCha8Rng,
    checked: Instant,
    due: Option<Instant>,
    last_round: Option<Instant>,
    /// True after DISCONNECT was queued.
    has_left: bool,
}

/// Time between two comparisons of a session's certificates with the present ones.
const RENEWAL_CHECK: Duration = Duration::from_secs(1);

/// Time over which the links of a cell replace their sessions.
const RENEWAL_SPREAD: Duration = Duration::from_secs(5);

/// Longest time between the map and the verdicts of one round.
const ROUND_MESSAGES: Duration = Duration::from_millis(20);

/// Time after which a session is replaced although no map is followed by verdicts.
const PAIR_PATIENCE: Duration = Duration::from_secs(1);

/// Time after which a session is replaced although no round arrives.
const ROUND_PATIENCE: Duration = Duration::from_secs(3);

impl LoginRenewal {
    fn new(client: Client, identity: BrokerIdentity, seed: u64) -> Self {
        Self {
            client,
            identity,
            rng: ChaCha8Rng::seed_from_u64(seed),
            checked: Instant::now(),
            due: None,
            last_round: None,
            has_left: false,
        }
    }

    /// Ends the session after this packet, whose topic may be empty, if it is due.
    fn on_packet(&mut self, security: &Security, topic: &[u8]) {
        let now = Instant::now();
        if self.due.is_none() && now.duration_since(self.checked) >= RENEWAL_CHECK {
            self.checked = now;
            if security.has_renewed(&self.identity) {
                let wait = RENEWAL_SPREAD.mul_f64(self.rng.random_range(0.0..=1.0));
                self.due = Some(now + wait);
            }
        }
        let is_round = ROUND_TOPICS.iter().any(|name| topic.ends_with(name));
        let ends_pair = is_round
            && self
                .last_round
                .is_some_and(|last| now.duration_since(last) < ROUND_MESSAGES);
        if is_round {
            self.last_round = Some(now);
        }
        let Some(due) = self.due.filter(|_| !self.has_left) else {
            return;
        };
        let is_pause = (ends_pair && now >= due)
            || (is_round && now >= due + PAIR_PATIENCE)
            || now >= due + ROUND_PATIENCE;
        if is_pause {
            self.has_left = self.client.disconnect();
        }
    }
}

/// Ends of the topics of a round's messages.
const ROUND_TOPICS: [&[u8]; 2] = [b"/global_detections", b"/global_verdicts"];

/// Prefix of refused logins.
const NOT_ADMITTED: &str = "connection refused";

/// Refusal that is only visible as a missing echo: brokers acknowledge messages that they do not
/// permit.
const NOT_HEARD: &str =
    "this node's own status does not come back: publishing or subscribing to it is not permitted";

/// Waits that double with every failure, each shortened by a random part of up to half.
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
        Self {
            least,
            most,
            next: least,
            rng: ChaCha8Rng::seed_from_u64(seed),
        }
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
    fn reconnect_wait_grows_until_success() {
        let config = MqttConfig {
            retry_min_ms: 50,
            retry_max_ms: 400,
            ..MqttConfig::default()
        };
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
