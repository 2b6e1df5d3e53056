//! Throttle of answers to nodes without a session.

use std::collections::HashMap;
use std::time::Duration;

use ecod::time::Timestamp;

use super::key::SessionId;
use crate::platform::throttle::TokenBucket;

/// Limits answers to all unknown nodes together and to each session. One recorded greeting, sent over and over, does
/// not use up the share of others.
#[derive(Debug, Clone)]
pub(crate) struct ReplyThrottle {
    all: TokenBucket,
    answered: HashMap<SessionId, Timestamp>,
}

impl ReplyThrottle {
    pub(crate) fn new(now: Timestamp) -> Self {
        Self { all: TokenBucket::new(REPLY_BURST, REPLY_INTERVAL, now), answered: HashMap::new() }
    }

    /// Whether this session may be answered now.
    pub(crate) fn allow(&mut self, session: &SessionId, now: Timestamp) -> bool {
        if self.answered.get(session).is_some_and(|at| now.since(*at) < MIN_SESSION_INTERVAL) {
            return false;
        }
        let allowed = self.all.allow(now);
        if allowed {
            if self.answered.len() >= MAX_ANSWERED {
                self.answered.retain(|_, at| now.since(*at) < MIN_SESSION_INTERVAL);
            }
            self.answered.insert(*session, now);
        }
        allowed
    }
}

/// Burst of answers, and time until one more. A cell of 64 nodes that start together stays below it.
const REPLY_BURST: u32 = 256;
const REPLY_INTERVAL: Duration = Duration::from_millis(10);

/// Minimum time between two answers to one session.
const MIN_SESSION_INTERVAL: Duration = Duration::from_millis(50);

/// From so many sessions on, those that may be answered again are forgotten; at most [`BURST`] more are not.
const MAX_ANSWERED: usize = 256;
