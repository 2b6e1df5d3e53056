//! How many answers strangers get.

use std::collections::HashMap;
use std::time::Duration;

use ecod::time::Timestamp;

use super::key::SessionId;
use crate::platform::throttle::Throttle;

/// Limits answers to all strangers together and to each session, so that one recorded greeting, sent over and over,
/// does not use up what is meant for others.
#[derive(Debug, Clone)]
pub(crate) struct Answers {
    all: Throttle,
    answered: HashMap<SessionId, Timestamp>,
}

impl Answers {
    pub(crate) fn new(now: Timestamp) -> Self {
        Self { all: Throttle::new(BURST, STEADY, now), answered: HashMap::new() }
    }

    /// Whether this session may get an answer now.
    pub(crate) fn allow(&mut self, session: &SessionId, now: Timestamp) -> bool {
        if self.answered.get(session).is_some_and(|at| now.since(*at) < EACH) {
            return false;
        }
        let allowed = self.all.allow(now);
        if allowed {
            if self.answered.len() >= MAX_ANSWERED {
                self.answered.retain(|_, at| now.since(*at) < EACH);
            }
            self.answered.insert(*session, now);
        }
        allowed
    }
}

/// Most answers to strangers at once, and time until one more: a cell of 64 that starts together meets unhindered.
const BURST: u32 = 256;
const STEADY: Duration = Duration::from_millis(10);

/// Least time between two answers to one session.
const EACH: Duration = Duration::from_millis(50);

/// From so many sessions on, those that may be answered again are forgotten; at most [`BURST`] more are not.
const MAX_ANSWERED: usize = 256;
