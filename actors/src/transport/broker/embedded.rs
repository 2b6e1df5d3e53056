//! The embedded broker: rmqtt on a thread of its own, behind a [`BrokerFrontend`] in a node.

use std::io;
use std::net::{Ipv4Addr, SocketAddr};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError, mpsc};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use ecod::config::{ConfigError, check_range};
use rmqtt::context::ServerContext;
use rmqtt::net::{Builder, Listener};
use rmqtt::server::MqttServer;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use tokio::net::TcpListener;
use tokio::runtime;
use tokio::sync::oneshot;
use tracing::field::display;

use super::BrokerHealth;
use super::departures::ExpulsionSink;
use super::door::{Door, DoorHooks};
use super::frontend::BrokerFrontend;
use super::heartbeat::{HEARTBEAT_INTERVAL, ThreadHeartbeat};
use super::in_flight::InFlightMeter;
use super::permissions::{AccessPolicy, MAX_TOPIC_LEVELS, Permissions};
use super::publish_throttle::PublishThrottle;
use super::retained::RetainedMessages;
use super::subscriptions::{MAX_SUBSCRIPTIONS, SubscriptionQuota};
use crate::platform::clock;

/// An MQTT broker that lives inside the process.
pub trait MqttBroker: Send {
    /// Listens on `address`, port 0 for a free one, and returns the bound address; clients may
    /// connect at once.
    ///
    /// # Errors
    /// Returns a [`BrokerError`] that names the address; the broker is then fully stopped.
    fn start(&mut self, address: SocketAddr) -> Result<SocketAddr, BrokerError>;

    /// Disconnects all clients and frees the port before it returns; has no effect on a broker that
    /// is not started. Retained messages are lost. A broker that hangs is abandoned after a moment
    /// and may keep its port.
    fn stop(&mut self);

    /// State of the broker.
    fn health(&self) -> BrokerHealth;

    /// Stops the broker and starts it at its current address, or at `fallback` if it has none.
    /// Retained messages are lost.
    ///
    /// # Errors
    /// Returns the errors of [`MqttBroker::start`]; the broker is then stopped.
    fn restart(&mut self, fallback: SocketAddr) -> Result<SocketAddr, BrokerError> {
        let address = match self.health() {
            BrokerHealth::Serving(address) => address,
            BrokerHealth::Stopped | BrokerHealth::Dead => fallback,
        };
        self.stop();
        self.start(address)
    }
}

/// An error at the start of the embedded broker, which is then fully stopped.
#[derive(Debug, thiserror::Error)]
pub enum BrokerError {
    /// It is already running.
    #[error("broker already serves at {0}")]
    Running(SocketAddr),
    /// The address is busy, not this machine's, or not permitted.
    #[error("broker cannot listen on {address}: {reason}")]
    Bind {
        /// Address at which the broker was to listen.
        address: SocketAddr,
        /// The operating system's error.
        reason: String,
    },
    /// The operating system refused a thread or event queue.
    #[error("broker for {address} cannot get a thread: {source}")]
    Thread {
        /// Address at which the broker was to listen.
        address: SocketAddr,
        /// The operating system's error.
        source: io::Error,
    },
}

/// Limits of the embedded broker.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct BrokerConfig {
    /// Whether the node runs a broker for programs beside it, also while another node leads.
    /// Default true. Without it only candidates run a broker, for nodes.
    pub door: bool,
    /// Largest MQTT packet in bytes; default: derived from `mqtt.max_map_bytes` and
    /// `mqtt.max_payload_bytes`. A client that sends a larger one is cut off. Trade-off: a larger
    /// value admits other programs' packets, a smaller one saves memory in attacks.
    pub max_packet_bytes: Option<u32>,
    /// Maximum number of simultaneous clients; default 2048. Every client costs some kilobytes and
    /// a file descriptor.
    pub max_clients: usize,
    /// Maximum number of simultaneous clients with one certificate or, without certificates, with
    /// one remote address; default 32. A node has one or two, and one for each observer. A cell
    /// behind address translation needs as many for each node.
    pub max_clients_each: usize,
    /// Maximum messages waiting for one slow client, at most 2 MiB; the oldest is dropped. Default
    /// 256.
    pub max_waiting: usize,
    /// Maximum topics with a retained message; default 8192: one for each node's status and one for
    /// the reputations.
    pub max_retained: usize,
    /// Maximum bytes of all retained messages together; default 67108864. A status has some hundred
    /// bytes, reputations some hundred for each vehicle. Messages beyond it are forwarded and not
    /// retained.
    pub max_retained_bytes: usize,
    /// Whether the broker may listen beyond loopback without `[tls]`: anyone who reaches it may
    /// publish under any name. Default false.
    pub allow_plaintext: bool,
    /// Time limit of the TLS handshake and login in ms; default 5000. Trade-off: shorter frees
    /// places sooner, longer admits slow boards and lossy networks.
    pub handshake_timeout_ms: u64,
    /// Burst of connections of one address; default 64. A cell behind address translation needs two
    /// or more for each node.
    pub connect_burst: u32,
    /// Connections per second of one address after the burst, tenfold after a login within the
    /// hour. Default 10.
    pub connects_per_s: u32,
    /// Maximum per second, and burst, of messages of one certificate, or without certificates of
    /// one address or local client; more are dropped. Default 1000.
    pub max_messages_hz: u32,
}

impl Default for BrokerConfig {
    fn default() -> Self {
        Self {
            door: true,
            max_packet_bytes: None,
            max_clients: 2048,
            max_clients_each: 32,
            max_waiting: 256,
            max_retained: 8192,
            max_retained_bytes: 64 * 1024 * 1024,
            allow_plaintext: false,
            handshake_timeout_ms: 5000,
            connect_burst: 64,
            connects_per_s: 10,
            max_messages_hz: 1000,
        }
    }
}

impl BrokerConfig {
    /// Largest packet in bytes.
    pub(super) fn packet_bytes(&self) -> u32 {
        self.max_packet_bytes.unwrap_or(DEFAULT_PACKET_BYTES)
    }

    /// Checks every value.
    ///
    /// # Errors
    /// Returns a [`ConfigError`] with the key, the value and the allowed range.
    pub fn validate(&self) -> Result<(), ConfigError> {
        if let Some(bytes) = self.max_packet_bytes {
            check_range("max_packet_bytes", f64::from(bytes), 1024.0, 268_435_455.0)?;
        }
        check_range("max_clients", self.max_clients as f64, 1.0, 1e6)?;
        check_range("max_clients_each", self.max_clients_each as f64, 1.0, 1e6)?;
        check_range("max_waiting", self.max_waiting as f64, 1.0, 1e6)?;
        check_range("max_retained", self.max_retained as f64, 1.0, 1e6)?;
        check_range(
            "max_retained_bytes",
            self.max_retained_bytes as f64,
            1024.0,
            1e12,
        )?;
        check_range(
            "handshake_timeout_ms",
            self.handshake_timeout_ms as f64,
            100.0,
            60_000.0,
        )?;
        check_range("connect_burst", f64::from(self.connect_burst), 1.0, 1e6)?;
        check_range("connects_per_s", f64::from(self.connects_per_s), 1.0, 1e4)?;
        check_range("max_messages_hz", f64::from(self.max_messages_hz), 1.0, 1e6)
    }
}

/// rmqtt as a library, on one thread, with retained messages in memory.
pub struct EmbeddedBroker {
    config: BrokerConfig,
    policy: Option<AccessPolicy>,
    door: Door,
    expelled: ExpulsionSink,
    running: Option<RunningBroker>,
}

#[derive(Debug)]
struct RunningBroker {
    address: SocketAddr,
    stop: oneshot::Sender<()>,
    thread: JoinHandle<()>,
    /// Closed when the thread has ended.
    ended: mpsc::Receiver<()>,
    heartbeat: Mutex<ThreadHeartbeat>,
}

/// Largest packet in bytes without a configured limit: the default maps and their topics.
const DEFAULT_PACKET_BYTES: u32 = 8 * 1024 * 1024 + 4096;

/// Time for which a session outlives its connection; zero would mean no limit. A reconnecting
/// client starts with an empty queue, because queues of absent clients would hold memory.
const MAX_SESSION_EXPIRY: Duration = Duration::from_millis(1);

/// Time for connections to end when the broker stops. Afterwards their tasks are abandoned.
const STOP_TIMEOUT: Duration = Duration::from_secs(1);

/// Time for the broker's thread to end.
const END_TIMEOUT: Duration = Duration::from_millis(1500);

impl EmbeddedBroker {
    /// A broker without a frontend, not started: every client may log in.
    pub fn new(config: BrokerConfig) -> Self {
        Self {
            config,
            policy: None,
            door: Door::default(),
            expelled: Arc::new(drop),
            running: None,
        }
    }

    /// A broker behind a frontend with an access policy, not started.
    pub fn protected(config: BrokerConfig, policy: AccessPolicy) -> Self {
        let mut broker = Self::new(config);
        broker.policy = Some(policy);
        broker
    }

    /// The same broker, with a connection for the node's local programs.
    #[must_use]
    pub fn with_door(mut self, door: Door) -> Self {
        self.door = door;
        self
    }

    /// The same broker, which reports clients whose certificates are not trusted any more.
    #[must_use]
    pub fn with_expulsions(mut self, expelled: ExpulsionSink) -> Self {
        self.expelled = expelled;
        self
    }
}

impl MqttBroker for EmbeddedBroker {
    fn start(&mut self, address: SocketAddr) -> Result<SocketAddr, BrokerError> {
        if let Some(running) = &self.running {
            return Err(BrokerError::Running(running.address));
        }
        let thread_error = |source| BrokerError::Thread { address, source };
        let (stop, stopped) = oneshot::channel();
        let (ready, started) = mpsc::channel();
        let (ending, ended) = mpsc::channel();
        let heartbeat = ThreadHeartbeat::default();
        let config = self.config.clone();
        let policy = self.policy.clone();
        let callbacks = Callbacks {
            door: self.door.clone(),
            expelled: Arc::clone(&self.expelled),
        };
        let beats = heartbeat.beats();
        let thread = thread::Builder::new()
            .name("mqtt-broker".to_owned())
            .spawn(move || {
                serve(address, &config, policy, callbacks, &beats, &ready, stopped);
                drop::<mpsc::Sender<()>>(ending);
            })
            .map_err(thread_error)?;
        let outcome = started
            .recv()
            .unwrap_or_else(|_| Err(thread_error(io::Error::other("it ended at once"))));
        let bound = match outcome {
            Ok(bound) => bound,
            Err(error) => {
                if thread.join().is_err() {
                    tracing::error!(%address, "broker's thread panicked");
                }
                return Err(error);
            }
        };
        self.running = Some(RunningBroker {
            address: bound,
            stop,
            thread,
            ended,
            heartbeat: Mutex::new(heartbeat),
        });
        Ok(bound)
    }

    fn stop(&mut self) {
        let Some(RunningBroker {
            address,
            stop,
            thread,
            ended,
            ..
        }) = self.running.take()
        else {
            return;
        };
        let is_sent = stop.send(()).is_ok();
        if ended.recv_timeout(END_TIMEOUT) == Err(mpsc::RecvTimeoutError::Timeout) {
            tracing::error!(%address, "embedded broker does not answer; its thread is abandoned");
        } else if thread.join().is_err() || !is_sent {
            tracing::warn!(%address, "broker had ended by itself");
        }
    }

    fn health(&self) -> BrokerHealth {
        match &self.running {
            None => BrokerHealth::Stopped,
            Some(running) if running.thread.is_finished() || running.has_stopped() => {
                BrokerHealth::Dead
            }
            Some(running) => BrokerHealth::Serving(running.address),
        }
    }
}

impl RunningBroker {
    fn has_stopped(&self) -> bool {
        self.heartbeat
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .has_stopped(clock::now())
    }
}

impl Drop for EmbeddedBroker {
    fn drop(&mut self) {
        self.stop();
    }
}

/// The parts of the node that the broker's thread calls.
#[derive(Clone)]
struct Callbacks {
    door: Door,
    expelled: ExpulsionSink,
}

/// Body of the broker's thread. It owns the tokio runtime, which must not be dropped within the
/// caller's async code.
fn serve(
    address: SocketAddr,
    config: &BrokerConfig,
    policy: Option<AccessPolicy>,
    callbacks: Callbacks,
    beats: &AtomicU64,
    ready: &mpsc::Sender<Result<SocketAddr, BrokerError>>,
    stopped: oneshot::Receiver<()>,
) {
    let runtime = match runtime::Builder::new_current_thread().enable_all().build() {
        Ok(runtime) => runtime,
        Err(source) => {
            // The caller waits for the answer.
            let _ = ready.send(Err(BrokerError::Thread { address, source }));
            return;
        }
    };
    runtime.block_on(async {
        let (server, frontend, bound, context) =
            match prepare(address, config, policy, callbacks.clone()).await {
                Ok(prepared) => prepared,
                Err(error) => {
                    let reason = error.root_cause().to_string();
                    // The caller waits for the answer.
                    let _ = ready.send(Err(BrokerError::Bind { address, reason }));
                    return;
                }
            };
        // The caller waits for the answer.
        let _ = ready.send(Ok(bound));
        let admitting = async {
            match frontend {
                Some(frontend) => frontend.run().await,
                None => std::future::pending().await,
            }
        };
        let beating = async {
            let mut ticks = tokio::time::interval(HEARTBEAT_INTERVAL);
            loop {
                ticks.tick().await;
                beats.fetch_add(1, Ordering::Relaxed);
            }
        };
        tokio::select! {
            () = beating => {}
            ended = server.run() => {
                let failure = ended.err().map(display);
                tracing::error!(failure, "broker ended by itself");
            }
            () = callbacks.door.run(context) => {}
            () = admitting => tracing::error!("frontend ended by itself"),
            _ = stopped => {}
        }
    });
    runtime.shutdown_timeout(STOP_TIMEOUT);
}

/// Opens the sockets. rmqtt's own socket is public without a frontend, otherwise on loopback.
async fn prepare(
    address: SocketAddr,
    config: &BrokerConfig,
    policy: Option<AccessPolicy>,
    Callbacks { door, expelled }: Callbacks,
) -> rmqtt::Result<(
    MqttServer,
    Option<BrokerFrontend>,
    SocketAddr,
    ServerContext,
)> {
    let builder = Builder::new()
        .name("ecod")
        // Without it a restart would wait for the last connections' TIME_WAIT; a live listener
        // still wins.
        .reuseaddr(Some(true))
        .nodelay(true)
        .max_packet_size(config.packet_bytes())
        .max_connections(config.max_clients)
        .max_mqueue_len(config.max_waiting)
        .session_expiry_interval(MAX_SESSION_EXPIRY)
        .max_session_expiry_interval(MAX_SESSION_EXPIRY)
        .handshake_timeout(Duration::from_secs(5));
    let limited = match &policy {
        // With anonymous clients disabled, rmqtt calls the hooks for each login. Subscriptions are
        // limited by `SubscriptionQuota`, because rmqtt would write a line of the log for each one
        // that it refuses.
        Some(_) => builder
            .laddr((Ipv4Addr::LOCALHOST, 0).into())
            .allow_anonymous(false)
            .max_subscriptions(0),
        None => builder
            .laddr(address)
            .max_topic_levels(MAX_TOPIC_LEVELS)
            .max_subscriptions(MAX_SUBSCRIPTIONS),
    };
    let listener = limited.bind().and_then(Listener::tcp)?;
    let own = listener.local_addr()?;
    // rmqtt's own overload check uses the load of the whole machine, which a vehicle's camera would
    // exceed.
    let context = ServerContext::new().busy_check_enable(false).build().await;
    *context.extends.retain_mut().await = Box::new(RetainedMessages::new(config));
    let (frontend, bound) = match &policy {
        Some(policy) => {
            let public = TcpListener::bind(address).await?;
            let bound = public.local_addr()?;
            let frontend = BrokerFrontend::new(public, own, policy, door.clone(), expelled, config);
            let principals = frontend.principals();
            SubscriptionQuota::new(principals.clone(), Arc::clone(&policy.counters))
                .install(&context)
                .await;
            InFlightMeter {
                in_flight: frontend.in_flight(),
                principals: principals.clone(),
            }
            .install(&context)
            .await;
            DoorHooks {
                principals: principals.clone(),
                door: door.clone(),
            }
            .install(&context)
            .await;
            Permissions {
                principals,
                policy: policy.clone(),
                door,
            }
            .install(&context)
            .await;
            (Some(frontend), bound)
        }
        None => (None, own),
    };
    let principals = frontend
        .as_ref()
        .map(BrokerFrontend::principals)
        .unwrap_or_default();
    let counters = policy.map(|policy| policy.counters).unwrap_or_default();
    PublishThrottle::new(config.max_messages_hz, principals, counters)
        .install(&context)
        .await;
    let server = MqttServer::new(context.clone())
        .listener_by_id(listener, 1)
        .build();
    Ok((server, frontend, bound, context))
}
