//! Throttle of answers to nodes without a session.

use std::net::IpAddr;
use std::time::Duration;

use ecod::model::time::Timestamp;

use super::key::SessionId;
use crate::platform::throttle::{KeyedThrottle, TokenBucket, host_network};

/// Limits answers to all unknown nodes together and to each session. One recorded greeting, sent over and over, does
/// not use up the share of others.
#[derive(Debug)]
pub(crate) struct ReplyThrottle {
    all: TokenBucket,
    by_session: KeyedThrottle<SessionId>,
}

impl ReplyThrottle {
    pub(crate) fn new(now: Timestamp) -> Self {
        Self {
            all: TokenBucket::new(REPLY_BURST, REPLY_INTERVAL, now),
            by_session: KeyedThrottle::new(1, MIN_SESSION_INTERVAL),
        }
    }

    /// Whether this session may be answered now.
    pub(crate) fn allow(&mut self, session: &SessionId, now: Timestamp) -> bool {
        self.by_session.allow(session, now) && self.all.allow(now)
    }
}

/// Limits verifications of certificates, which are dear, for each host and in all.
#[derive(Debug)]
pub(crate) struct VerificationThrottle {
    all: TokenBucket,
    by_host: KeyedThrottle<IpAddr>,
}

impl VerificationThrottle {
    pub(crate) fn new(now: Timestamp) -> Self {
        Self {
            all: TokenBucket::new(REPLY_BURST, REPLY_INTERVAL, now),
            by_host: KeyedThrottle::new(HOST_BURST, HOST_INTERVAL),
        }
    }

    /// Whether a certificate from this address may be verified now.
    pub(crate) fn allow(&mut self, host: IpAddr, now: Timestamp) -> bool {
        self.by_host.allow(&host_network(host), now) && self.all.allow(now)
    }
}

/// Burst of verifications for one host, and time until one more. Several nodes may run on one machine.
const HOST_BURST: u32 = 128;
const HOST_INTERVAL: Duration = Duration::from_millis(50);

/// Burst of answers, and time until one more. A cell of 64 nodes that start together stays below it.
const REPLY_BURST: u32 = 256;
const REPLY_INTERVAL: Duration = Duration::from_millis(10);

/// Minimum time between two answers to one session.
const MIN_SESSION_INTERVAL: Duration = Duration::from_millis(50);
