//! Throttle of answers to nodes without a session.

use std::net::{IpAddr, SocketAddr};
use std::time::Duration;

use ecod::model::time::Timestamp;

use super::key::SessionId;
use crate::platform::throttle::{KeyedThrottle, TokenBucket, host_network};

/// Limits answers to all unknown nodes together, to each host, and to each session at its address. One recorded
/// greeting, sent over and over, does not use up the share of others; nor does one host that makes up sessions.
#[derive(Debug)]
pub(crate) struct ReplyThrottle {
    all: TokenBucket,
    by_host: KeyedThrottle<IpAddr>,
    by_session: KeyedThrottle<(SessionId, SocketAddr)>,
}

impl ReplyThrottle {
    pub(crate) fn new(now: Timestamp) -> Self {
        Self {
            all: TokenBucket::new(REPLY_BURST, REPLY_INTERVAL, now),
            by_host: KeyedThrottle::new(REPLY_BURST, HOST_INTERVAL),
            by_session: KeyedThrottle::new(1, MIN_SESSION_INTERVAL),
        }
    }

    /// Whether this session may be answered now.
    pub(crate) fn allow(&mut self, session: &SessionId, from: SocketAddr, now: Timestamp) -> bool {
        self.by_session.allow(&(*session, from), now) && self.allow_host(from, now)
    }

    /// Whether a proof from this address may be verified now, whatever session it claims: forged proofs must not use up
    /// the share of an honest one.
    pub(crate) fn allow_host(&mut self, from: SocketAddr, now: Timestamp) -> bool {
        self.by_host.allow(&host_network(from.ip()), now) && self.all.allow(now)
    }
}

/// Burst of answers, and time until one more, in all and for one host. A cell of 64 nodes that start together, perhaps on
/// one machine, stays below it.
const REPLY_BURST: u32 = 256;
const REPLY_INTERVAL: Duration = Duration::from_millis(10);
const HOST_INTERVAL: Duration = Duration::from_millis(20);

/// Minimum time between two answers to one session.
const MIN_SESSION_INTERVAL: Duration = Duration::from_millis(50);
