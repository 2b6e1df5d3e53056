//! Logins at the brokers of candidates: a leader that most cannot reach makes way, and nobody is handed a lead in vain.
//!
//! Messages of the election pass where a broker may not be reached: by a firewall, or as its certificate is refused. Each
//! node tells at which brokers of leader and standby it cannot log in. The leader draws the conclusions: followers need not
//! agree, and a node alone moves no lead.

use crate::leadership::election::message::MAX_SUCCESSORS;
use crate::leadership::election::{Election, State};
use crate::model::names::NodeName;
use crate::model::time::Timestamp;

impl Election {
    /// Followers that cannot log in at this leader's broker, and all followers, by their own word.
    pub fn followers_without_login(&self) -> (usize, usize) {
        self.peers
            .without_login(&self.id, &self.id, self.clock.now())
    }

    /// Notes at which brokers this node cannot log in, and tells its leader.
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

    /// True if more than half of this leader and its followers cannot log in at a candidate's broker.
    pub(super) fn is_out_of_reach(&self, candidate: &NodeName, now: Timestamp) -> bool {
        if !self.peers.lacks_logins() && self.no_login.is_empty() {
            return false;
        }
        let (without, followers) = self.peers.without_login(&self.id, candidate, now);
        let without = without + usize::from(self.no_login.contains(candidate));
        2 * without > followers + 1
    }

    /// The best candidates to lead next. Those that most cannot reach come last.
    pub(super) fn successors(&self, now: Timestamp) -> Vec<NodeName> {
        self.peers
            .successors(MAX_SUCCESSORS, |name| self.is_out_of_reach(name, now), now)
    }

    /// The successor that this leader hands the lead to, as most of its followers cannot log in at its broker.
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

    /// True if more than half of the followers cannot log in at this leader's broker, and two at least: one node alone may
    /// lie. A cell of two is the exception. There each is served by its own broker, and the other leads if it is no worse.
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
