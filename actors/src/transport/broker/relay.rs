//! The bytes of one client, both ways, within its principal's limits.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::time::Duration;

use ecod::model::time::Timestamp;
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::sync::oneshot;
use tokio::time::{sleep, timeout};

use super::backlog::{Backlog, BacklogSlot};
use super::byte_throttle::ByteThrottle;
use super::client_rejection::ClientRejection;
use super::in_flight::InFlight;
use super::outbound_queue::OutboundQueue;
use super::packet_scanner::{PacketScanner, Piece};
use super::principal::{LeaderCheck, Principal};
use super::subscriptions::MAX_SUBSCRIPTIONS;
use crate::platform::clock;
use crate::telemetry::counters::{Counters, ShedReason};

/// Limits of the traffic between clients and rmqtt.
pub(super) struct RelayLimits {
    pub(super) backlog: Backlog,
    pub(super) throttle: ByteThrottle,
    pub(super) in_flight: InFlight,
    pub(super) elected: LeaderCheck,
    /// Maximum messages that wait for one client.
    pub(super) max_waiting: usize,
    pub(super) counters: Arc<Counters>,
}

/// Time to deliver the rest to a client that has ended its side.
const FAREWELL_TIMEOUT: Duration = Duration::from_secs(1);

/// Time between two checks whether rmqtt has forwarded enough to accept more.
const IN_FLIGHT_PAUSE: Duration = Duration::from_millis(2);

/// When bytes last passed between a client and its relay.
struct Activity {
    received_us: AtomicU64,
    sent_us: AtomicU64,
}

/// Time after which a client whose connection stands still in both directions is cut off rather than slow.
const CUT_OFF_AFTER: Duration = Duration::from_secs(5);

const BUFFER_BYTES: usize = 8 * 1024;

/// Maximum length of a SUBSCRIBE or UNSUBSCRIBE. rmqtt holds some hundred bytes for each of its
/// filters at once.
const MAX_FILTERS_BYTES: usize = MAX_SUBSCRIPTIONS * 256;

/// Packet types, in the upper half of the first byte.
const SUBSCRIBE: u8 = 8;
const UNSUBSCRIBE: u8 = 10;

/// What both directions of a relay use.
#[derive(Clone, Copy)]
struct ClientSide<'a> {
    principal: &'a Principal,
    slot: &'a BacklogSlot,
    activity: &'a Activity,
}

impl RelayLimits {
    /// Forwards bytes until either side ends or the client exceeds its limits. `wire_bytes` counts
    /// the bytes that the client has sent, if they are more than its stream returns.
    ///
    /// # Errors
    /// Returns [`ClientRejection::Stalled`] or [`ClientRejection::Malformed`]; a connection that is
    /// lost otherwise counts as ended.
    pub(super) async fn relay(
        &self,
        client: impl AsyncRead + AsyncWrite,
        wire_bytes: &AtomicUsize,
        broker: TcpStream,
        principal: &Principal,
    ) -> Result<(), ClientRejection> {
        let (slot, cut) = self.backlog.open(principal.quota_key());
        let (from_client, to_client) = tokio::io::split(client);
        let (from_broker, mut to_broker) = broker.into_split();
        let activity = Activity::new(clock::now());
        let client = ClientSide {
            principal,
            slot: &slot,
            activity: &activity,
        };
        let up = async {
            let forwarded = self
                .forward_up(from_client, wire_bytes, &mut to_broker, client)
                .await;
            (forwarded, to_broker.shutdown().await)
        };
        let down = self.forward_down(from_broker, to_client, client, cut);
        tokio::pin!(up, down);
        tokio::select! {
            ended = &mut down => match ended {
                Err(error) if error.kind() == io::ErrorKind::TimedOut => {
                    // The rest of its queue is dropped.
                    self.shed(principal, &activity);
                    Err(ClientRejection::Stalled)
                }
                _ => Ok(()),
            },
            ended = &mut up => {
                if matches!(&ended, (Err(error), _) if error.kind() == io::ErrorKind::InvalidData) {
                    return Err(ClientRejection::Malformed);
                }
                let rest = timeout(FAREWELL_TIMEOUT, down).await;
                tracing::trace!(?ended, ?rest, "the client ended the connection");
                Ok(())
            }
        }
    }

    /// Counts a message that waits too long for a client. If the connection has stood still in both
    /// directions for [`CUT_OFF_AFTER`], the client is cut off; otherwise it reads too slowly.
    fn shed(&self, principal: &Principal, activity: &Activity) {
        if clock::now().since(activity.last()) >= CUT_OFF_AFTER {
            self.counters.shed_cut_off(principal.source());
        } else {
            self.counters
                .shed(ShedReason::ReaderSlow, principal.source());
        }
    }

    /// Passes bytes to rmqtt at the principal's rate, and only while rmqtt keeps up.
    async fn forward_up(
        &self,
        mut from_client: impl AsyncRead + Unpin,
        wire_bytes: &AtomicUsize,
        broker: &mut (impl AsyncWrite + Unpin),
        client: ClientSide<'_>,
    ) -> io::Result<()> {
        let ClientSide {
            principal,
            slot,
            activity,
        } = client;
        let mut buffer = vec![0; BUFFER_BYTES];
        let mut scanner = PacketScanner::default();
        let mut unfinished = 0;
        let mut content = 0;
        let mut charged = 0;
        loop {
            let read = from_client.read(&mut buffer).await?;
            store(&activity.received_us, clock::now());
            let received = buffer.get(..read).unwrap_or_default();
            if received.is_empty() {
                return Ok(());
            }
            let mut pieces = received;
            let mut packets = 0;
            while let Some(piece) = scanner.next(&mut pieces) {
                match piece {
                    Piece::Head(header, length) if has_too_many_filters(&header, length) => {
                        return Err(io::ErrorKind::InvalidData.into());
                    }
                    Piece::Head(..) => (packets, unfinished) = (packets + 1, 0),
                    Piece::Body(body) => unfinished += body.len(),
                }
            }
            if scanner.is_between_packets() {
                unfinished = 0;
            }
            if packets > 0 {
                // A new packet has begun, so the one before has ended.
                slot.set_unfinished(0, clock::now());
            }
            slot.set_unfinished(unfinished, clock::now());
            let has_large_share = principal.has_large_share(&self.elected);
            let source = principal.source();
            content += read;
            let due = content.max(wire_bytes.load(Ordering::Relaxed));
            let wait = self.throttle.charge(
                source,
                has_large_share,
                due - charged,
                packets,
                clock::now(),
            );
            charged = due;
            if !wait.is_zero() {
                sleep(wait).await;
            }
            while self.in_flight.is_full(source, has_large_share) {
                sleep(IN_FLIGHT_PAUSE).await;
            }
            broker.write_all(received).await?;
        }
    }

    /// Reads all that rmqtt sends, so that bytes are not queued there, and forwards it at the
    /// client's reading speed.
    async fn forward_down(
        &self,
        mut broker: impl AsyncRead + Unpin,
        mut to_client: impl AsyncWrite + Unpin,
        client: ClientSide<'_>,
        cut: oneshot::Receiver<()>,
    ) -> io::Result<()> {
        let ClientSide {
            principal,
            slot,
            activity,
        } = client;
        let mut buffer = vec![0; BUFFER_BYTES];
        let mut queue = OutboundQueue::new(self.max_waiting);
        let mut is_flushed = true;
        let mut has_ended = false;
        tokio::pin!(cut);
        loop {
            if has_ended && queue.is_empty() && is_flushed {
                return to_client.shutdown().await;
            }
            tokio::select! {
                biased;
                _ = &mut cut => return Err(stalled()),
                sent = send(&mut to_client, queue.next()), if !queue.is_empty() || !is_flushed => {
                    is_flushed = queue.is_empty();
                    let sent = sent?;
                    if sent > 0 {
                        store(&activity.sent_us, clock::now());
                    }
                    queue.advance(sent);
                    slot.set_unread(queue.len(), clock::now());
                }
                read = broker.read(&mut buffer), if !has_ended => {
                    let read = read?;
                    has_ended = read == 0;
                    let pushed = queue.push(buffer.get(..read).unwrap_or_default());
                    let Ok(dropped) = pushed else { return Err(stalled()) };
                    for _ in 0..dropped {
                        self.shed(principal, activity);
                    }
                    slot.set_unread(queue.len(), clock::now());
                }
            }
        }
    }
}

impl Activity {
    fn new(now: Timestamp) -> Self {
        Self {
            received_us: AtomicU64::new(now.micros()),
            sent_us: AtomicU64::new(now.micros()),
        }
    }

    /// Time of the last byte from or to the client.
    fn last(&self) -> Timestamp {
        let [received, sent] =
            [&self.received_us, &self.sent_us].map(|time| Timestamp(time.load(Ordering::Relaxed)));
        received.max(sent)
    }
}

fn store(time: &AtomicU64, now: Timestamp) {
    time.store(now.micros(), Ordering::Relaxed);
}

fn has_too_many_filters(header: &[u8], length: usize) -> bool {
    header
        .first()
        .is_some_and(|first| matches!(first >> 4, SUBSCRIBE | UNSUBSCRIBE))
        && length > MAX_FILTERS_BYTES
}

/// Sends some bytes or, if there are none, the bytes that TLS still holds.
async fn send(client: &mut (impl AsyncWrite + Unpin), bytes: &[u8]) -> io::Result<usize> {
    if bytes.is_empty() {
        client.flush().await.map(|()| 0)
    } else {
        client.write(bytes).await
    }
}

/// The error for a client that does not read its messages, or does not complete its packets.
fn stalled() -> io::Error {
    io::ErrorKind::TimedOut.into()
}

#[cfg(test)]
mod tests {
    use std::net::Ipv4Addr;

    use super::*;

    /// In a cut network both directions stand still; a slow client still reads or sends.
    #[test]
    fn silent_and_slow_clients_differ() {
        let principal = Principal::new(None, Ipv4Addr::new(10, 0, 0, 7).into(), false);
        for (received, sent, kind) in [
            (0, 0, "overload"),
            (6, 0, "overload"),
            (0, 6, "overload"),
            (6, 6, "network_cut"),
        ] {
            let limits = RelayLimits {
                backlog: Backlog::new(1 << 20),
                throttle: ByteThrottle::default(),
                in_flight: InFlight::default(),
                elected: Arc::new(|_| false),
                max_waiting: 4,
                counters: Arc::default(),
            };
            let ago =
                |seconds| AtomicU64::new((clock::now() - Duration::from_secs(seconds)).micros());
            let activity = Activity {
                received_us: ago(received),
                sent_us: ago(sent),
            };
            limits.shed(&principal, &activity);
            let troubles = limits.counters.troubles().present();
            let shown: Vec<_> = troubles.iter().map(|trouble| &*trouble.kind).collect();
            assert_eq!(shown, [kind], "{received} s, {sent} s");
        }
    }
}
