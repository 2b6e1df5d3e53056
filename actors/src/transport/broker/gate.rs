//! What stands between the network and rmqtt: TLS, limits on strangers, and who is who.
//!
//! ```text
//! client ── TCP ──> admission ── TLS ──> CONNECT within time and size ──> loopback ──> rmqtt
//!                    by source     certificate of the cell                with a pass that says whose it is
//! ```
//!
//! rmqtt accepts connections from nobody but a socket of its own, and knows no revocation lists; so it listens on
//! loopback, on a port that the system draws, and takes only connections for which there is a pass.

use std::io;
use std::net::{Ipv4Addr, SocketAddr};
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use ecod::wire::{Limits, Topics};
use rustls::pki_types::{CertificateDer, UnixTime};
use tokio::io::{AsyncRead, AsyncWrite, AsyncWriteExt};
use tokio::net::{TcpListener, TcpSocket, TcpStream};
use tokio::sync::{Semaphore, watch};
use tokio::time::{Instant, MissedTickBehavior, interval, sleep, timeout, timeout_at};
use tokio_io_timeout::TimeoutStream;
use tokio_rustls::TlsAcceptor;

use super::admission::{Admission, Origin, Rate, Ticket};
use super::holder::{Holder, Passes, Shares};
use super::permissions::{Elected, Permissions};
use super::{BrokerConfig, login};
use crate::platform::clock;
use crate::telemetry::counters::{Counters, Event};
use crate::transport::pki::{Credentials, Current, Identity};

/// What an embedded broker needs to keep strangers out.
#[derive(Clone)]
pub struct Guard {
    /// The node's certificates; without any, everybody is let in, within limits, and may say anything.
    pub credentials: Option<Arc<Credentials>>,
    /// The cell's topics.
    pub topics: Topics,
    /// The largest payloads that the cell's nodes take.
    pub limits: Limits,
    /// Tells who may speak for all.
    pub elected: Elected,
    /// The node's counters.
    pub counters: Arc<Counters>,
}

/// The public side of a broker.
pub(super) struct Gate {
    listener: TcpListener,
    shared: Arc<Shared>,
    current: Option<watch::Sender<Arc<Current>>>,
    admission: Admission,
}

struct Shared {
    credentials: Option<Arc<Credentials>>,
    passes: Passes,
    behind: SocketAddr,
    places: Arc<Semaphore>,
    shares: Shares,
    patience: Duration,
    counters: Arc<Counters>,
}

/// Time between two looks at whether certificates have changed.
const LOOK: Duration = Duration::from_secs(1);

/// Time between two checks of those who are connected, for certificates that have expired.
const RECHECK: Duration = Duration::from_secs(30);

/// Pause after the system gave no connection, such as for lack of file descriptors.
const ACCEPT_PAUSE: Duration = Duration::from_millis(50);

/// How long a client may not read at all before it is cut off.
const WRITE_PATIENCE: Duration = Duration::from_secs(15);

/// How long what is under way to a client that said farewell may take.
const LINGER: Duration = Duration::from_secs(1);

impl Gate {
    /// A gate at the listener, for a broker that listens `behind` it.
    pub(super) fn new(listener: TcpListener, behind: SocketAddr, guard: &Guard, config: &BrokerConfig) -> Self {
        let rate = Rate { burst: config.connect_burst, interval: Duration::from_secs(1) / config.connects_per_s };
        let current = guard.credentials.as_ref().map(|credentials| watch::Sender::new(credentials.current()));
        let shared = Shared {
            credentials: guard.credentials.clone(),
            passes: Passes::default(),
            behind,
            places: Arc::new(Semaphore::new(config.max_clients)),
            shares: Shares::new(config.max_clients_each),
            patience: Duration::from_millis(config.handshake_timeout_ms),
            counters: Arc::clone(&guard.counters),
        };
        Self { listener, shared: Arc::new(shared), current, admission: Admission::new(rate, clock::now()) }
    }

    /// What rmqtt has to ask about those who come through this gate.
    pub(super) fn permissions(&self, guard: &Guard) -> Permissions {
        Permissions {
            passes: self.passes(),
            topics: guard.topics.clone(),
            limits: guard.limits,
            elected: Arc::clone(&guard.elected),
            counters: Arc::clone(&guard.counters),
        }
    }

    /// Whose the connections are that come through this gate.
    pub(super) fn passes(&self) -> Passes {
        self.shared.passes.clone()
    }

    /// Lets clients in; never ends.
    pub(super) async fn run(self) {
        let mut looks = interval(LOOK);
        looks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut checked = Instant::now();
        loop {
            tokio::select! {
                accepted = self.listener.accept() => match accepted {
                    Ok((stream, from)) => self.admit(stream, from),
                    Err(error) => {
                        tracing::debug!(%error, "connection not accepted");
                        sleep(ACCEPT_PAUSE).await;
                    }
                },
                _ = looks.tick() => self.look(&mut checked),
            }
        }
    }

    fn admit(&self, stream: TcpStream, from: SocketAddr) {
        // Certificates tell even this machine's clients apart.
        let is_here = self.current.is_none() && from.ip().to_canonical().is_loopback();
        let origin = if is_here { Origin::Here } else { Origin::Address(from.ip()) };
        let Some(ticket) = self.admission.admit(origin, clock::now()) else {
            self.shared.counters.count(Event::ClientThrottled);
            return;
        };
        let (shared, current) = (Arc::clone(&self.shared), self.current.as_ref().map(watch::Sender::subscribe));
        tokio::spawn(async move {
            if let Err(turned_away) = shared.serve(stream, from, current, ticket).await {
                turned_away.event().into_iter().for_each(|event| shared.counters.count(event));
                tracing::debug!(%from, %turned_away, "client turned away");
            }
        });
    }

    /// Has all connections checked again when certificates or the list changed, and from time to time.
    fn look(&self, checked: &mut Instant) {
        let (Some(sender), Some(credentials)) = (&self.current, &self.shared.credentials) else { return };
        let current = credentials.current();
        if checked.elapsed() >= RECHECK || !Arc::ptr_eq(&current, &sender.borrow()) {
            *checked = Instant::now();
            sender.send_replace(current);
        }
    }
}

/// Why a client was not let in, or not any longer.
#[derive(Debug, thiserror::Error)]
pub(super) enum TurnedAway {
    #[error("left without a word, as nodes do that only look whether a broker is there")]
    Left,
    #[error("no login in time")]
    TimedOut,
    #[error("no login before many others of its address wanted one")]
    Displaced,
    #[error("not trusted: {0}")]
    Untrusted(String),
    #[error("no MQTT")]
    Malformed,
    #[error("most clients are connected")]
    Full,
    #[error("as many clients of this certificate or address are connected as may be")]
    Crowded,
    #[error("connection lost: {0}")]
    Lost(#[from] io::Error),
    #[error("certificate no longer valid: {0}")]
    Expelled(rustls::Error),
}

impl TurnedAway {
    fn event(&self) -> Option<Event> {
        match self {
            Self::Left => None,
            Self::TimedOut => Some(Event::ClientTimedOut),
            Self::Displaced => Some(Event::ClientThrottled),
            Self::Untrusted(_) => Some(Event::ClientUntrusted),
            Self::Malformed | Self::Lost(_) => Some(Event::ClientMalformed),
            Self::Full | Self::Crowded => Some(Event::ClientsFull),
            Self::Expelled(_) => Some(Event::ClientExpelled),
        }
    }
}

type Stream = Pin<Box<dyn Duplex>>;

trait Duplex: AsyncRead + AsyncWrite + Send {}

impl<T: AsyncRead + AsyncWrite + Send> Duplex for T {}

impl Shared {
    /// One client from its first byte to its last.
    async fn serve(
        &self,
        stream: TcpStream,
        from: SocketAddr,
        current: Option<watch::Receiver<Arc<Current>>>,
        mut ticket: Ticket,
    ) -> Result<(), TurnedAway> {
        stream.set_nodelay(true)?;
        let mut stream = Box::pin(TimeoutStream::new(stream));
        stream.as_mut().set_write_timeout_pinned(Some(WRITE_PATIENCE));
        let login = async {
            if !matches!(stream.get_ref().peek(&mut [0]).await, Ok(1)) {
                return Err(TurnedAway::Left);
            }
            let (mut stream, certificates) = match &current {
                Some(current) => {
                    let server = Arc::clone(&current.borrow().server);
                    secure(stream, server).await?
                }
                None => (stream as Stream, Vec::new()),
            };
            let connect = login::read(&mut stream).await?;
            Ok((stream, certificates, connect))
        };
        let login = tokio::select! {
            login = timeout_at(Instant::now() + self.patience, login) => login.unwrap_or(Err(TurnedAway::TimedOut)),
            () = ticket.displaced() => Err(TurnedAway::Displaced),
        };
        let (stream, certificates, connect) = login?;
        let identity = certificates.first().map(|certificate| Identity::of(certificate)).transpose();
        let identity = identity.map_err(|error| TurnedAway::Untrusted(error.to_string()))?;
        let holder = Holder::new(identity, from.ip(), connect.is_nameless);
        let _part = self.shares.take(&holder).ok_or(TurnedAway::Crowded)?;
        let _place = Arc::clone(&self.places).try_acquire_owned().map_err(|_| TurnedAway::Full)?;

        let socket = TcpSocket::new_v4()?;
        socket.bind((Ipv4Addr::LOCALHOST, 0).into())?;
        // Before rmqtt can ask for it, and until the port may be somebody else's.
        let _pass = self.passes.issue(socket.local_addr()?, holder);
        let mut behind = socket.connect(self.behind).await?;
        behind.set_nodelay(true)?;
        behind.write_all(&connect.packet).await?;
        let _visit = ticket.log_in();
        tokio::select! {
            () = relay(stream, behind) => Ok(()),
            error = expulsion(current, &certificates) => Err(TurnedAway::Expelled(error)),
        }
    }
}

/// The TLS handshake and the client's certificates.
async fn secure(
    stream: Pin<Box<TimeoutStream<TcpStream>>>,
    server: Arc<rustls::ServerConfig>,
) -> Result<(Stream, Vec<CertificateDer<'static>>), TurnedAway> {
    let accepted = TlsAcceptor::from(server).accept(stream).await;
    let stream = accepted.map_err(|error| TurnedAway::Untrusted(error.to_string()))?;
    let certificates = stream.get_ref().1.peer_certificates().map(|chain| chain.to_vec());
    let certificates = certificates.ok_or_else(|| TurnedAway::Untrusted("no certificate".into()))?;
    Ok((Box::pin(stream), certificates))
}

/// Passes bytes on until either side ends; what was under way to a client that left is given a moment.
async fn relay(client: Stream, broker: TcpStream) {
    let (mut from_client, mut to_client) = tokio::io::split(client);
    let (mut from_broker, mut to_broker) = broker.into_split();
    let up = async {
        let copied = tokio::io::copy(&mut from_client, &mut to_broker).await;
        // The broker has to see the end; if it is gone, it has.
        (copied.is_ok(), to_broker.shutdown().await.is_ok())
    };
    let down = async {
        let copied = tokio::io::copy(&mut from_broker, &mut to_client).await;
        (copied.is_ok(), to_client.shutdown().await.is_ok())
    };
    tokio::pin!(up, down);
    tokio::select! {
        ended = &mut down => tracing::trace!(?ended, "the broker ended the connection"),
        ended = &mut up => {
            let rest = timeout(LINGER, down).await;
            tracing::trace!(?ended, ?rest, "the client ended the connection");
        }
    }
}

/// Waits until the client's certificate is not valid any more, and says why.
async fn expulsion(
    current: Option<watch::Receiver<Arc<Current>>>,
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
