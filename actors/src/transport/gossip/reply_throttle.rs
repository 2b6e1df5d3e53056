//! Throttle of answers to nodes without a session.

use std::time::Duration;

use ecod::model::time::Timestamp;

use super::key::SessionId;
use crate::platform::throttle::{KeyedThrottle, TokenBucket};

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

/// Burst of answers, and time until one more. A cell of 64 nodes that start together stays below it.
const REPLY_BURST: u32 = 256;
const REPLY_INTERVAL: Duration = Duration::from_millis(10);

/// Minimum time between two answers to one session.
const MIN_SESSION_INTERVAL: Duration = Duration::from_millis(50);
