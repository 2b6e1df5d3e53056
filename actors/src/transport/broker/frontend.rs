//! Public side of the embedded broker: TLS, connection limits, and the principal of each client.
//!
//! ```text
//! client ── TCP ──> admission ── TLS ── or WebSocket in it ──> CONNECT within time and size ── relay ── loopback ──> rmqtt
//!                    by source     certificate of the cell                within its principal's limits
//! ```
//!
//! rmqtt accepts connections only on a socket of its own, and has no revocation lists. It therefore
//! listens on a free loopback port, and accepts only connections that the frontend has registered.

use std::net::{Ipv4Addr, SocketAddr};
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::AtomicUsize;
use std::time::Duration;

use ecod::model::names::NodeName;
use rustls::pki_types::{CertificateDer, UnixTime};
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::net::{TcpListener, TcpSocket, TcpStream};
use tokio::sync::{Semaphore, watch};
use tokio::time::{Instant, interval, sleep, timeout_at};
use tokio_io_timeout::TimeoutStream;
use tokio_rustls::TlsAcceptor;

use super::backlog::Backlog;
use super::byte_throttle::ByteThrottle;
use super::client_rejection::ClientRejection;
use super::connection_throttle::{ClientOrigin, ConnectionThrottle, LoginSlot};
use super::departures::{Departures, ExpulsionSink, is_distrust};
use super::door::Door;
use super::in_flight::InFlight;
use super::permissions::AccessPolicy;
use super::principal::{ConnectionQuota, Principal, PrincipalRegistry};
use super::relay::RelayLimits;
use super::{BrokerConfig, connect_packet, websocket};
use crate::platform::clock;
use crate::telemetry::counters::{Counters, Event};
use crate::transport::pki::{Credentials, LoadedCredentials};

/// Public side of a broker.
pub(super) struct BrokerFrontend {
    listener: TcpListener,
    shared: Arc<FrontendState>,
    current: Option<watch::Sender<Arc<LoadedCredentials>>>,
    throttle: ConnectionThrottle,
}

struct FrontendState {
    credentials: Option<Arc<Credentials>>,
    door: Door,
    expelled: ExpulsionSink,
    departures: Departures,
    principals: PrincipalRegistry,
    /// Address of rmqtt's own listener.
    backend: SocketAddr,
    places: Arc<Semaphore>,
    quota: ConnectionQuota,
    limits: RelayLimits,
    handshake_timeout: Duration,
    counters: Arc<Counters>,
}

/// Time between two checks of connected clients for expired certificates.
const RECHECK_INTERVAL: Duration = Duration::from_secs(30);

/// Pause after `accept` failed, such as for lack of file descriptors.
const ACCEPT_PAUSE: Duration = Duration::from_millis(50);

/// Time after which a client that reads no bytes is cut off.
const WRITE_TIMEOUT: Duration = Duration::from_secs(15);

impl BrokerFrontend {
    /// A frontend on a listener, for a broker that listens at `backend`.
    pub(super) fn new(
        listener: TcpListener,
        backend: SocketAddr,
        policy: &AccessPolicy,
        door: Door,
        expelled: ExpulsionSink,
        config: &BrokerConfig,
    ) -> Self {
        let interval = Duration::from_secs(1) / config.connects_per_s;
        let current = policy
            .credentials
            .as_ref()
            .map(|credentials| watch::Sender::new(credentials.current()));
        let shared = FrontendState {
            credentials: policy.credentials.clone(),
            door,
            expelled,
            departures: Departures::default(),
            principals: PrincipalRegistry::default(),
            backend,
            places: Arc::new(Semaphore::new(config.max_clients)),
            quota: ConnectionQuota::new(config.max_clients_each),
            limits: RelayLimits {
                backlog: Backlog::new(config.packet_bytes() as usize),
                throttle: ByteThrottle::default(),
                in_flight: InFlight::default(),
                elected: Arc::clone(&policy.elected),
                max_waiting: config.max_waiting,
                counters: Arc::clone(&policy.counters),
            },
            handshake_timeout: Duration::from_millis(config.handshake_timeout_ms),
            counters: Arc::clone(&policy.counters),
        };
        Self {
            listener,
            shared: Arc::new(shared),
            current,
            throttle: ConnectionThrottle::new(config.connect_burst, interval, clock::now()),
        }
    }

    /// Principals of the forwarded connections.
    pub(super) fn principals(&self) -> PrincipalRegistry {
        self.shared.principals.clone()
    }

    /// Messages on their way through rmqtt.
    pub(super) fn in_flight(&self) -> InFlight {
        self.shared.limits.in_flight.clone()
    }

    /// Accepts clients; does not return.
    pub(super) async fn run(self) {
        let mut rechecks = interval(RECHECK_INTERVAL);
        loop {
            tokio::select! {
                accepted = self.listener.accept() => match accepted {
                    Ok((stream, from)) => self.admit(stream, from),
                    Err(error) => {
                        tracing::debug!(%error, "connection not accepted");
                        sleep(ACCEPT_PAUSE).await;
                    }
                },
                () = self.reloaded() => {
                    self.recheck();
                    self.recheck_departed();
                }
                _ = rechecks.tick() => self.recheck(),
            }
        }
    }

    /// Handles a new connection: counts and drops it above its rate, otherwise serves it in a
    /// separate task.
    fn admit(&self, stream: TcpStream, from: SocketAddr) {
        // With certificates even local clients can be distinguished.
        let is_local = self.current.is_none() && from.ip().to_canonical().is_loopback();
        let origin = if is_local {
            ClientOrigin::Local
        } else {
            ClientOrigin::Remote(from.ip())
        };
        let Some(slot) = self.throttle.admit(origin, clock::now()) else {
            self.shared.counters.count(Event::ClientThrottled);
            return;
        };
        let shared = Arc::clone(&self.shared);
        let current = self.current.as_ref().map(watch::Sender::subscribe);
        tokio::spawn(async move {
            if let Err(turned_away) = shared.serve(stream, from, current, slot).await {
                turned_away
                    .event()
                    .into_iter()
                    .for_each(|event| shared.counters.count(event));
                tracing::debug!(%from, %turned_away, "client turned away");
            }
        });
    }

    /// Waits until certificates or the revocation list changed.
    async fn reloaded(&self) {
        let (Some(sender), Some(credentials)) = (&self.current, &self.shared.credentials) else {
            return std::future::pending().await;
        };
        let known = Arc::clone(&sender.borrow());
        credentials.changed(&known).await;
    }

    /// Makes all connections be checked again: when certificates or the revocation list changed,
    /// and periodically.
    fn recheck(&self) {
        if let (Some(sender), Some(credentials)) = (&self.current, &self.shared.credentials) {
            sender.send_replace(credentials.current());
        }
    }

    /// Reports clients that have left and whose certificates are not trusted any more.
    fn recheck_departed(&self) {
        let shared = &self.shared;
        if let Some(credentials) = &shared.credentials {
            let verifier = Arc::clone(&credentials.current().clients);
            let distrusted = shared.departures.take_distrusted(&*verifier, clock::now());
            distrusted
                .into_iter()
                .for_each(|name| (shared.expelled)(name));
        }
    }
}

type DuplexStream = Pin<Box<dyn Duplex>>;

trait Duplex: AsyncRead + AsyncWrite + Send {}

impl<T: AsyncRead + AsyncWrite + Send> Duplex for T {}

impl FrontendState {
    /// Serves one client from its first byte to its last.
    async fn serve(
        &self,
        stream: TcpStream,
        from: SocketAddr,
        current: Option<watch::Receiver<Arc<LoadedCredentials>>>,
        mut slot: LoginSlot,
    ) -> Result<(), ClientRejection> {
        stream.set_nodelay(true)?;
        let mut stream = Box::pin(TimeoutStream::new(stream));
        stream
            .as_mut()
            .set_write_timeout_pinned(Some(WRITE_TIMEOUT));
        let wire_bytes = Arc::<AtomicUsize>::default();
        let read = async {
            if !matches!(stream.get_ref().peek(&mut [0]).await, Ok(1)) {
                return Err(ClientRejection::Left);
            }
            let (mut stream, certificates) = match &current {
                Some(current) => {
                    let server = Arc::clone(&current.borrow().server);
                    secure(stream, server).await?
                }
                None => (stream as DuplexStream, Vec::new()),
            };
            let mut first = stream.read_u8().await?;
            if first == websocket::FIRST_BYTE {
                stream = Box::pin(websocket::accept(stream, Arc::clone(&wire_bytes)).await?);
                first = stream.read_u8().await?;
            }
            let connect = connect_packet::read(first, &mut stream).await;
            if let Err(ClientRejection::UnknownVersion(_)) = connect {
                stream.write_all(&connect_packet::UNKNOWN_VERSION).await?;
                stream.shutdown().await?;
            }
            Ok((stream, certificates, connect?))
        };
        let login = tokio::select! {
            login = timeout_at(Instant::now() + self.handshake_timeout, read) => login.unwrap_or(Err(ClientRejection::TimedOut)),
            () = slot.evicted() => Err(ClientRejection::Evicted),
        };
        let (stream, certificates, connect) = login?;
        let own = current.as_ref().zip(certificates.first());
        let identity = own
            .map(|(current, own)| current.borrow().subject_of(own))
            .transpose()
            .map_err(|error| ClientRejection::Untrusted(error.to_string()))?;
        let client = Principal::new(identity, from.ip(), connect.has_generated_id);
        let is_program = self.door.is_program(&client, &connect.client_id);
        let principal = if is_program {
            client.programs()
        } else {
            client
        };
        let _part = self
            .quota
            .acquire(&principal)
            .ok_or(ClientRejection::Crowded)?;
        let _place = Arc::clone(&self.places)
            .try_acquire_owned()
            .map_err(|_| ClientRejection::Full)?;

        let socket = TcpSocket::new_v4()?;
        socket.bind((Ipv4Addr::LOCALHOST, 0).into())?;
        // Registered before rmqtt queries it, and until the port may be reused.
        let _pass = self
            .principals
            .register(socket.local_addr()?, principal.clone());
        let mut backend = socket.connect(self.backend).await?;
        backend.set_nodelay(true)?;
        backend.write_all(&connect.packet).await?;
        let _visit = slot.log_in();
        let ended = tokio::select! {
            ended = self.limits.relay(stream, &wire_bytes, backend, &principal) => ended,
            error = certificate_invalidated(current, &certificates) => Err(ClientRejection::CertificateInvalidated(error)),
        };
        if let (Some(identity), Some(own)) = (&principal.identity, certificates.into_iter().next())
        {
            self.record_end(identity.name(), own, &ended);
        }
        ended
    }

    /// Reports a client that was disconnected because its certificate is not trusted any more, and
    /// records any other client that has left.
    fn record_end(
        &self,
        name: &NodeName,
        certificate: CertificateDer<'static>,
        ended: &Result<(), ClientRejection>,
    ) {
        match ended {
            Err(ClientRejection::CertificateInvalidated(error)) if is_distrust(error) => {
                (self.expelled)(name.clone());
            }
            Err(ClientRejection::CertificateInvalidated(_)) => {}
            _ => self
                .departures
                .record(name.clone(), certificate, clock::now()),
        }
    }
}

/// The TLS handshake and the client's certificates.
async fn secure(
    stream: Pin<Box<TimeoutStream<TcpStream>>>,
    server: Arc<rustls::ServerConfig>,
) -> Result<(DuplexStream, Vec<CertificateDer<'static>>), ClientRejection> {
    let accepted = TlsAcceptor::from(server).accept(stream).await;
    let stream = accepted.map_err(|error| ClientRejection::Untrusted(error.to_string()))?;
    let certificates = stream
        .get_ref()
        .1
        .peer_certificates()
        .map(|chain| chain.to_vec())
        .ok_or_else(|| ClientRejection::Untrusted("no certificate".into()))?;
    Ok((Box::pin(stream), certificates))
}

/// Waits until the client's certificate becomes invalid; returns the reason.
async fn certificate_invalidated(
    current: Option<watch::Receiver<Arc<LoadedCredentials>>>,
    certificates: &[CertificateDer<'static>],
) -> rustls::Error {
    if let (Some(mut current), Some((own, chain))) = (current, certificates.split_first()) {
        while current.changed().await.is_ok() {
            let verifier = Arc::clone(&current.borrow_and_update().clients);
            if let Err(error) = verifier.verify_client_cert(own, chain, UnixTime::now()) {
                return error;
            }
        }
    }
    std::future::pending().await
}
