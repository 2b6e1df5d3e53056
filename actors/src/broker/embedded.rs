//! The embedded broker: rmqtt on a thread of its own.

use std::net::SocketAddr;
use std::sync::mpsc;
use std::thread::{self, JoinHandle};
use std::time::Duration;
use std::{fmt, io};

use ecod::config::{ConfigError, check_range};
use rmqtt::context::ServerContext;
use rmqtt::net::{Builder, Listener};
use rmqtt::server::MqttServer;
use serde::{Deserialize, Serialize};
use tokio::runtime;
use tokio::sync::oneshot;

use super::BrokerHealth;
use super::retained::RetainedMessages;

/// An MQTT broker that lives inside the process.
pub trait Mqtt: Send + fmt::Debug {
    /// Listens on `address`, port 0 for a free one, and returns the bound address; clients may connect at once.
    ///
    /// # Errors
    /// [`BrokerError`] names the address; nothing is left running.
    fn start(&mut self, address: SocketAddr) -> Result<SocketAddr, BrokerError>;

    /// Disconnects all clients and frees the port before it returns; nothing happens when not started. Retained
    /// messages are lost.
    fn stop(&mut self);

    /// Whether it serves.
    fn health(&self) -> BrokerHealth;

    /// Stops and starts again at the address it is bound to, empty; `fallback` is for a broker that does not run.
    ///
    /// # Errors
    /// As [`Mqtt::start`]; the broker is then stopped.
    fn restart(&mut self, fallback: SocketAddr) -> Result<SocketAddr, BrokerError> {
        let address = match self.health() {
            BrokerHealth::Serving(address) => address,
            BrokerHealth::Stopped | BrokerHealth::Dead => fallback,
        };
        self.stop();
        self.start(address)
    }
}

/// Why the embedded broker does not run; nothing was left behind.
#[derive(Debug, thiserror::Error)]
pub enum BrokerError {
    /// It is already running.
    #[error("broker already serves at {0}")]
    Running(SocketAddr),
    /// The address cannot be listened on: busy, not this machine's, or not permitted.
    #[error("broker cannot listen on {address}: {reason}")]
    Bind {
        /// The address asked for.
        address: SocketAddr,
        /// What the operating system said.
        reason: String,
    },
    /// The operating system gave no thread or event queue.
    #[error("broker for {address} cannot get a thread: {source}")]
    Thread {
        /// The address asked for.
        address: SocketAddr,
        /// What the operating system said.
        source: io::Error,
    },
}

/// Limits of the embedded broker.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct BrokerConfig {
    /// Largest MQTT packet in bytes; default what `mqtt.max_map_bytes` and `mqtt.max_payload_bytes` need. A client that
    /// sends more is cut off. Larger admits the packets of others, smaller bounds the memory that a stranger can take.
    pub max_packet_bytes: Option<u32>,
    /// Most clients at a time; default 2048. Every client costs some kilobytes and a file descriptor.
    pub max_clients: usize,
    /// Most messages waiting for one slow client; default 256. More carries a client over longer pauses, but what it
    /// then gets is old. Each of them may be as large as the largest packet.
    pub max_waiting: usize,
    /// Most topics with a retained message; default 8192: one for each node's status and one for the reputations.
    pub max_retained: usize,
}

impl Default for BrokerConfig {
    fn default() -> Self {
        Self { max_packet_bytes: None, max_clients: 2048, max_waiting: 256, max_retained: 8192 }
    }
}

impl BrokerConfig {
    /// Checks every value.
    ///
    /// # Errors
    /// [`ConfigError`] with the key, the value and what is allowed.
    pub fn validate(&self) -> Result<(), ConfigError> {
        if let Some(bytes) = self.max_packet_bytes {
            check_range("max_packet_bytes", f64::from(bytes), 1024.0, 268_435_455.0)?;
        }
        check_range("max_clients", self.max_clients as f64, 1.0, 1e6)?;
        check_range("max_waiting", self.max_waiting as f64, 1.0, 1e6)?;
        check_range("max_retained", self.max_retained as f64, 1.0, 1e6)
    }
}

/// rmqtt as a library, on one thread, with retained messages in memory.
#[derive(Debug, Default)]
pub struct EmbeddedBroker {
    config: BrokerConfig,
    running: Option<Running>,
}

#[derive(Debug)]
struct Running {
    address: SocketAddr,
    stop: oneshot::Sender<()>,
    thread: JoinHandle<()>,
}

/// Largest packet of a broker that was not told of a cell's limits: the default maps and their topics.
const DEFAULT_PACKET_BYTES: u32 = 8 * 1024 * 1024 + 4096;

/// How long connections may take to end when the broker stops; beyond it their thread is left to end by itself.
const STOP_TIMEOUT: Duration = Duration::from_secs(1);

impl EmbeddedBroker {
    /// A broker that is not started.
    pub fn new(config: BrokerConfig) -> Self {
        Self { config, running: None }
    }

    fn listener(&self, address: SocketAddr) -> Builder {
        Builder::new()
            .name("ecod")
            .laddr(address)
            // Without it a restart would wait for the last connections' TIME_WAIT; a live listener still wins.
            .reuseaddr(Some(true))
            .nodelay(true)
            .max_packet_size(self.config.max_packet_bytes.unwrap_or(DEFAULT_PACKET_BYTES))
            .max_connections(self.config.max_clients)
            .max_mqueue_len(self.config.max_waiting)
            .handshake_timeout(Duration::from_secs(5))
    }
}

impl Mqtt for EmbeddedBroker {
    fn start(&mut self, address: SocketAddr) -> Result<SocketAddr, BrokerError> {
        if let Some(running) = &self.running {
            return Err(BrokerError::Running(running.address));
        }
        let thread_error = |source| BrokerError::Thread { address, source };
        let (stop, stopped) = oneshot::channel();
        let (ready, started) = mpsc::channel();
        let (listener, max_retained) = (self.listener(address), self.config.max_retained);
        let thread = thread::Builder::new()
            .name("mqtt-broker".to_owned())
            .spawn(move || serve(address, listener, max_retained, &ready, stopped))
            .map_err(thread_error)?;
        let outcome = started.recv().unwrap_or_else(|_| Err(thread_error(io::Error::other("it ended at once"))));
        let bound = match outcome {
            Ok(bound) => bound,
            Err(error) => {
                // Its last act was to send the error; nothing is left to wait for but its end.
                if thread.join().is_err() {
                    tracing::error!(%address, "broker's thread panicked");
                }
                return Err(error);
            }
        };
        self.running = Some(Running { address: bound, stop, thread });
        Ok(bound)
    }

    fn stop(&mut self) {
        let Some(Running { address, stop, thread }) = self.running.take() else { return };
        if stop.send(()).is_err() || thread.join().is_err() {
            tracing::warn!(%address, "broker had ended by itself");
        }
    }

    fn health(&self) -> BrokerHealth {
        match &self.running {
            None => BrokerHealth::Stopped,
            Some(running) if running.thread.is_finished() => BrokerHealth::Dead,
            Some(running) => BrokerHealth::Serving(running.address),
        }
    }
}

impl Drop for EmbeddedBroker {
    fn drop(&mut self) {
        self.stop();
    }
}

/// The broker's thread. A tokio runtime must not be dropped where the caller's async code runs, so that it is made here.
fn serve(
    address: SocketAddr,
    listener: Builder,
    max_retained: usize,
    ready: &mpsc::Sender<Result<SocketAddr, BrokerError>>,
    stopped: oneshot::Receiver<()>,
) {
    let runtime = match runtime::Builder::new_current_thread().enable_all().build() {
        Ok(runtime) => runtime,
        Err(source) => {
            // The caller waits for nothing else and cannot be gone.
            ready.send(Err(BrokerError::Thread { address, source })).unwrap_or_default();
            return;
        }
    };
    runtime.block_on(async {
        let bound = listener.bind().and_then(Listener::tcp).and_then(|l| l.local_addr().map(|bound| (l, bound)));
        let (listener, bound) = match bound {
            Ok(bound) => bound,
            Err(error) => {
                let reason = error.root_cause().to_string();
                return ready.send(Err(BrokerError::Bind { address, reason })).unwrap_or_default();
            }
        };
        // rmqtt's own overload check refuses clients by the whole machine's load; a vehicle's camera would trip it.
        let context = ServerContext::new().busy_check_enable(false).build().await;
        *context.extends.retain_mut().await = Box::new(RetainedMessages::new(max_retained));
        let server = MqttServer::new(context).listener_by_id(listener, 1).build();
        ready.send(Ok(bound)).unwrap_or_default();
        tokio::select! {
            ended = server.run() => tracing::error!(?ended, "broker ended by itself"),
            _ = stopped => {}
        }
    });
    runtime.shutdown_timeout(STOP_TIMEOUT);
}
