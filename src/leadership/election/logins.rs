//! Logins at the candidates' brokers: replaces a leader that most followers cannot reach, and
//! ensures that the new leader's broker is reachable before a handover.
//!
//! Election messages can arrive where a broker is not reachable, for example because of a firewall
//! or a refused certificate. Each node therefore reports at which brokers of leader and standby it
//! cannot log in. Only the leader acts on these reports: followers need not agree, and one node's
//! report is never enough to move leadership.

use crate::leadership::election::message::MAX_SUCCESSORS;
use crate::leadership::election::{Election, State};
use crate::model::names::NodeName;
use crate::model::time::Timestamp;

impl Election {
    /// Number of followers that report that they cannot log in at this leader's broker, and number
    /// of all followers.
    pub fn followers_without_login(&self) -> (usize, usize) {
        self.peers
            .without_login(&self.id, &self.id, self.clock.now())
    }

    /// Records at which brokers this node cannot log in, and reports them to its leader.
    pub(super) fn set_no_login(&mut self, at: Vec<NodeName>, now: Timestamp) {
        self.no_login = at;
        match &self.state {
            State::Following(following) => {
                let leader = following.epoch.leader.clone();
                self.send_status(&leader, now);
            }
            State::Leading(_) => self.name_successors(now),
            State::Seeking(_) => {}
        }
    }

    /// True if more than half of the nodes (this leader and its followers) cannot log in at a
    /// candidate's broker.
    pub(super) fn is_out_of_reach(&self, candidate: &NodeName, now: Timestamp) -> bool {
        if !self.peers.lacks_logins() && self.no_login.is_empty() {
            return false;
        }
        let (without, followers) = self.peers.without_login(&self.id, candidate, now);
        let without = without + usize::from(self.no_login.contains(candidate));
        2 * without > followers + 1
    }

    /// The best candidates to lead next. Candidates that most nodes cannot reach come last.
    pub(super) fn successors(&self, now: Timestamp) -> Vec<NodeName> {
        self.peers
            .successors(MAX_SUCCESSORS, |name| self.is_out_of_reach(name, now), now)
    }

    /// The successor to which this leader hands over because most of its followers cannot log in at
    /// its broker.
    pub(super) fn relief(&self, now: Timestamp) -> Option<NodeName> {
        let State::Leading(leading) = &self.state else {
            return None;
        };
        let next = leading
            .successors
            .first()
            .filter(|_| self.peers.lacks_logins())?;
        let is_ready = self.peers.is_stable(next, self.config.stable(), now)
            && !self.is_out_of_reach(next, now);
        (is_ready && self.is_deserted(next, now)).then(|| next.clone())
    }

    /// True if more than half of the followers, and at least two, cannot log in at this leader's
    /// broker: a single report may be false. A cell of two nodes is the exception: there each node
    /// is served by its own broker, and the other node leads if its rank is not lower.
    fn is_deserted(&self, next: &NodeName, now: Timestamp) -> bool {
        let (without, followers) = self.peers.without_login(&self.id, &self.id, now);
        let is_equal = || {
            let candidacy = self.peers.get(next).and_then(|peer| peer.candidacy);
            candidacy.is_some_and(|other| other.rank() <= self.candidacy().rank())
        };
        2 * without > followers
            && (without > 1 || self.peers.has_no_login(next, &self.id) && is_equal())
    }
}
