//! Handover of leadership, make before break: to a better candidate, or to the standby of a leader
//! that most followers cannot reach.
//!
//! The old leader publishes until it receives the new leader's beat. It yields right after a round,
//! so that almost a whole period remains for the few packets of the handover. From the challenger's
//! `Ready` on, the fuser holds rounds: each ends at its time, because a round that directly
//! follows the yielded one would be published by both leaders. The round in progress may have ended
//! before that order arrived, so the leader yields after the second round. The new leader publishes
//! the next round. If all of these packets are lost for a period, the old leader publishes that
//! round too, and yields again after it.

use crate::leadership::election::interface::ElectionEffect;
use crate::leadership::election::leading::{Handover, Leading};
use crate::leadership::election::message::Body;
use crate::leadership::election::{Election, State};
use crate::model::epoch::Epoch;
use crate::model::names::NodeName;
use crate::model::time::Timestamp;
use crate::wire::Role;

impl Election {
    /// Starts a handover when a better candidate has been reachable and fit for `stable_ms`.
    pub(super) fn start_handover(&mut self, now: Timestamp) {
        let ours = self.candidacy().rank();
        if !matches!(&self.state, State::Leading(leading) if leading.handover.is_none()) {
            return;
        }
        let out_of_reach = |name: &NodeName| self.is_out_of_reach(name, now);
        let challenger = self
            .peers
            .challenger(ours, self.config.stable(), out_of_reach, now)
            .filter(|(_, from)| now >= *from)
            .map(|(to, _)| to);
        let Some(to) = challenger.or_else(|| self.relief(now)) else {
            return;
        };
        let State::Leading(leading) = &mut self.state else {
            return;
        };
        leading.handover = Some(Handover {
            to: to.clone(),
            retry_at: now,
            started_at: now,
            round_awaited_since: None,
            is_round_held: false,
            yielded: false,
        });
        self.name_successors(now);
        self.effects.push(ElectionEffect::SendSnapshot { to });
        self.drive_handover(now);
    }

    /// Repeats offers and yields, or aborts the handover.
    pub(super) fn drive_handover(&mut self, now: Timestamp) {
        let limit = self.config.handover();
        let State::Leading(Leading {
            handover: Some(handover),
            ..
        }) = &self.state
        else {
            return;
        };
        let to = handover.to.clone();
        let fit = self.peers.receives_from(&to, now)
            && self.peers.may_lead(&to, now)
            && !self.is_out_of_reach(&to, now);
        let State::Leading(leading) = &mut self.state else {
            return;
        };
        let Some(handover) = &mut leading.handover else {
            return;
        };
        if !fit || now.since(handover.started_at) > limit {
            leading.handover = None;
            self.peers.restart_stability(&to, now);
            return;
        }
        if now < handover.retry_at {
            return;
        }
        // A cell that publishes no rounds cannot miss one.
        handover.yielded |= handover
            .round_awaited_since
            .is_some_and(|at| now.since(at) > self.config.roundless_yield());
        handover.retry_at = now + self.config.handover_retry(handover.yielded);
        let last_round = self.round;
        if handover.yielded {
            self.effects.push(ElectionEffect::HoldRound);
            self.send(&to, Body::Yield { last_round }, now);
        } else if handover.round_awaited_since.is_none() {
            self.send(&to, Body::Offer, now);
        }
    }

    /// Processes a challenger's answer that it is ready to lead. From now on rounds are held, and
    /// the leader yields to the challenger right after the second of them.
    pub(super) fn on_ready(&mut self, from: &NodeName, now: Timestamp) {
        if let State::Leading(leading) = &mut self.state
            && let Some(handover) = leading
                .handover
                .as_mut()
                .filter(|handover| handover.to == *from && handover.round_awaited_since.is_none())
        {
            handover.round_awaited_since = Some(now);
            self.effects.push(ElectionEffect::HoldRound);
        }
    }

    /// Records a round that this node published or accepted. A follower takes it as a sign of life
    /// of the leader. A leader with a ready challenger holds the next round; if this one was held
    /// already, it yields now, because almost a whole period remains.
    ///
    /// # Example
    /// `gauss` hands over to `edge`, whose `Ready` arrived in round 88. Round 88 ends: round 89 is
    /// held to its full length. Round 89 ends: `gauss` sends `Yield { last_round: 89 }`, and `edge`
    /// publishes round 90.
    pub(super) fn record_round(&mut self, epoch: &Epoch, round: u64, now: Timestamp) {
        if epoch.term <= self.term_limit(Role::Auto, now) {
            self.observe_term(epoch.term);
        }
        self.observe_round(&epoch.leader, round);
        let least = self.config.beat();
        match &mut self.state {
            State::Following(following) if following.epoch == *epoch => {
                following.on_round(least, now);
            }
            State::Leading(leading) => {
                if let Some(handover) = leading
                    .handover
                    .as_mut()
                    .filter(|handover| handover.round_awaited_since.is_some())
                {
                    handover.round_awaited_since = Some(now);
                    if std::mem::replace(&mut handover.is_round_held, true) {
                        handover.yielded = true;
                        handover.retry_at = now;
                        self.drive_handover(now);
                    } else {
                        self.effects.push(ElectionEffect::HoldRound);
                    }
                }
            }
            State::Following(_) | State::Seeking(_) => {}
        }
    }

    /// Processes the leader's offer to hand over. The first offer starts the preparation
    /// ([`ElectionEffect::Prepare`]); when the preparation is complete, every further offer is
    /// answered with `Ready`, because an earlier answer may have been lost. Offers of a node that
    /// is not the followed leader are ignored.
    ///
    /// # Example
    /// `gauss` offers, and this node prepares. An offer during the preparation is left unanswered.
    /// The preparation completes, and `prepared` sends `Ready`. That message is lost: the next
    /// offer is answered with `Ready` again.
    pub(super) fn on_offer(&mut self, from: &NodeName, epoch: Option<&Epoch>, now: Timestamp) {
        let may_lead = self.candidacy().may_lead();
        let State::Following(following) = &mut self.state else {
            return;
        };
        if following.epoch.leader != *from || epoch != Some(&following.epoch) || !may_lead {
            return;
        }
        let fresh = following
            .offered_at
            .is_some_and(|at| now.since(at) <= self.config.response_timeout());
        following.offered_at = Some(now);
        if !fresh {
            following.prepared = false;
            self.effects.push(ElectionEffect::Prepare {
                leader: from.clone(),
            });
        } else if following.prepared {
            self.send(from, Body::Ready, now);
        }
    }

    /// Handles the caller's report that the preparation is complete: sends `Ready` to the leader.
    /// Without an offer of the current leader the report has no effect.
    pub(super) fn prepared(&mut self, now: Timestamp) {
        if let State::Following(following) = &mut self.state
            && following.offered_at.is_some()
        {
            following.prepared = true;
            let leader = following.epoch.leader.clone();
            self.send(&leader, Body::Ready, now);
        }
    }

    /// Takes over leadership after the old leader has yielded: the first own round is
    /// `last_round + 1`.
    pub(super) fn on_yield(
        &mut self,
        from: &NodeName,
        epoch: Option<&Epoch>,
        last_round: u64,
        now: Timestamp,
    ) {
        let State::Following(following) = &self.state else {
            return;
        };
        let ours = following.epoch.leader == *from
            && epoch == Some(&following.epoch)
            && following.prepared;
        if ours && self.candidacy().may_lead() {
            let after = following.epoch.clone();
            self.observe_round(from, last_round);
            self.lead(Some(after), now);
        }
    }
}
