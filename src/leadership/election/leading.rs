//! Leading: sending beats, choosing successors, and finding a better candidate.

use std::time::Duration;

use crate::leadership::election::message::{Body, Candidacy, LifeSign, MAX_SUCCESSORS};
use crate::leadership::election::{Election, State};
use crate::leadership::timers::{LIFE_SIGN_STEP_MS, RENEWAL_PAUSE};
use crate::model::epoch::Epoch;
use crate::model::names::NodeName;
use crate::model::time::Timestamp;
use crate::wire::Role;

/// State of a handover at the old leader.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(super) struct Handover {
    pub(super) to: NodeName,
    pub(super) retry_at: Timestamp,
    pub(super) started_at: Timestamp,
    /// Start of the wait for the next round; `None` until the challenger is ready.
    pub(super) round_awaited_since: Option<Timestamp>,
    /// True if a round has ended since the challenger became ready, so that the next one is held
    /// from its start.
    pub(super) is_round_held: bool,
    pub(super) yielded: bool,
}

/// State of a node that leads.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(super) struct Leading {
    pub(super) epoch: Epoch,
    pub(super) since: Timestamp,
    /// The epoch that this one succeeded.
    pub(super) after: Option<Epoch>,
    /// The next leaders, the standby first.
    pub(super) successors: Vec<NodeName>,
    /// The handover in progress.
    pub(super) handover: Option<Handover>,
    /// Minimum time in this epoch before its renewal.
    pause: Duration,
    /// Time at which this node continues in a higher epoch because some nodes refuse the current
    /// one.
    renew_at: Option<Timestamp>,
    beat_at: Timestamp,
    beats: u64,
}

impl Leading {
    pub(super) fn new(
        epoch: Epoch,
        after: Option<Epoch>,
        successors: Vec<NodeName>,
        now: Timestamp,
    ) -> Self {
        Self {
            epoch,
            since: now,
            after,
            successors,
            handover: None,
            pause: Duration::ZERO,
            renew_at: None,
            beat_at: now,
            beats: 0,
        }
    }

    /// Sets the pause of an epoch that renews another: each pause is twice as long as the previous
    /// one, up to [`RENEWAL_PAUSE`].
    pub(super) fn renewed(&mut self, before: &Self, least: Duration) {
        let is_calm = self.since.since(before.since) > RENEWAL_PAUSE * 6;
        self.pause = if is_calm {
            least
        } else {
            (before.pause * 2).clamp(least, RENEWAL_PAUSE)
        };
    }

    /// The sign of life of this leader, unsigned. Beats sent at about the same time contain the
    /// same sign of life.
    fn life_sign(&self, now: Timestamp) -> LifeSign {
        let led_ms = u64::try_from(now.since(self.since).as_millis()).unwrap_or(u64::MAX);
        LifeSign {
            led_ms: led_ms / LIFE_SIGN_STEP_MS * LIFE_SIGN_STEP_MS,
            signature: None,
        }
    }

    /// True if this leader has yielded the next round to another node.
    pub(super) fn is_yielding(&self) -> bool {
        self.handover
            .as_ref()
            .is_some_and(|handover| handover.yielded)
    }

    /// True if this leader has yielded the next round to the node `name`.
    pub(super) fn has_yielded_to(&self, name: &NodeName) -> bool {
        self.handover
            .as_ref()
            .is_some_and(|handover| handover.yielded && handover.to == *name)
    }

    pub(super) fn deadline(&self) -> Timestamp {
        self.handover
            .as_ref()
            .map_or(self.beat_at, |handover| handover.retry_at.min(self.beat_at))
    }
}

impl Election {
    /// Runs the timers of a leader: drives a handover; when beats are due, renews the term if a
    /// peer still refuses it, or updates the successors, looks for a better candidate and sends the
    /// beats of this turn. The standby gets every beat, other peers get theirs in different turns.
    pub(super) fn lead_timers(&mut self, now: Timestamp) {
        self.drive_handover(now);
        let next = now + self.config.beat();
        let State::Leading(leading) = &mut self.state else {
            return;
        };
        if now < leading.beat_at {
            return;
        }
        if leading.handover.is_none() && leading.renew_at.is_some_and(|at| now >= at) {
            leading.renew_at = None;
            if self.peers.any_refuses(now) {
                let after = leading.epoch.clone();
                self.lead(Some(after), now);
                return;
            }
        }
        leading.beat_at = next;
        leading.beats += 1;
        let beats = leading.beats;
        self.name_successors(now);
        self.start_handover(now);
        let State::Leading(leading) = &self.state else {
            return;
        };
        let due: Vec<_> = (beats..)
            .zip(self.peers.names())
            .filter(|(turn, name)| {
                turn % (self.beat_for(leading, name).as_millis() as u64 / self.config.beat_ms) == 0
            })
            .map(|(_, name)| name.clone())
            .collect();
        for peer in due {
            self.send_beat(&peer, now);
        }
    }

    /// Schedules a renewal in a term that the peer cannot refuse, because the peer has seen a later
    /// term or regards this epoch as over. A newer leader that is just taking over has time to
    /// announce itself first.
    pub(super) fn renew_later(&mut self, refused_by: &NodeName, now: Timestamp) {
        self.peers.record_refusal(refused_by, true);
        let at = now + self.config.given_up_timeout();
        if let State::Leading(leading) = &mut self.state {
            leading
                .renew_at
                .get_or_insert(at.max(leading.since + leading.pause));
        }
    }

    /// Schedules a term above the rival's, and asks all nodes which leader they follow: this node
    /// may have been stalled, and its followers may have left it.
    pub(super) fn contest(&mut self, rival: &NodeName, now: Timestamp) {
        let soon = now + self.config.given_up_timeout();
        let is_followed = self.peers.followers(rival, now) > 0;
        let State::Leading(leading) = &mut self.state else {
            return;
        };
        // The pause applies to single nodes that refuse the epoch. A rival with followers is a
        // different case.
        if leading.renew_at.is_none_or(|at| is_followed && at > soon) {
            leading.renew_at = is_followed.then_some(soon);
            self.renew_later(rival, now);
            self.beat_all(now);
        }
    }

    /// Sends a beat to every peer, because epoch or successors changed.
    pub(super) fn beat_all(&mut self, now: Timestamp) {
        for peer in self.peers.names().cloned().collect::<Vec<_>>() {
            self.send_beat(&peer, now);
        }
    }

    /// Sends one beat to a peer, with the interval that applies to it; without effect while this
    /// node does not lead.
    pub(super) fn send_beat(&mut self, to: &NodeName, now: Timestamp) {
        let State::Leading(leading) = &self.state else {
            return;
        };
        let body = Body::Beat {
            every_ms: self.beat_for(leading, to).as_millis() as u64,
            round: self.round,
            followers: u8::try_from(self.peers.followers(&self.id, now)).unwrap_or(u8::MAX),
            after: leading.after.clone(),
            successors: leading.successors.clone(),
            life: leading.life_sign(now),
        };
        self.send(to, body, now);
    }

    /// Time between two beats to a peer. A better candidate that is not yet fit gets beats more
    /// often, so that the leader notices soon when it becomes fit.
    fn beat_for(&self, leading: &Leading, to: &NodeName) -> Duration {
        let outranks = |candidacy: Candidacy| {
            candidacy.role != Role::Cav && candidacy.rank() < self.candidacy().rank()
        };
        match leading.successors.iter().position(|name| name == to) {
            Some(0) => self.config.beat(),
            Some(_) => self.config.near_beat(),
            None if self
                .peers
                .get(to)
                .and_then(|peer| peer.candidacy)
                .is_some_and(outranks)
                && self.peers.receives_from(to, self.clock.now()) =>
            {
                self.config.near_beat()
            }
            None => self.config.idle_beat(),
        }
    }

    /// Chooses the successors and sends a beat to all nodes if they changed.
    pub(super) fn name_successors(&mut self, now: Timestamp) {
        if !self.is_leading() {
            return;
        }
        let mut next = self.successors(now);
        let State::Leading(leading) = &mut self.state else {
            return;
        };
        if let Some(handover) = &leading.handover {
            next.retain(|name| *name != handover.to);
            next.insert(0, handover.to.clone());
            next.truncate(MAX_SUCCESSORS);
        }
        if next == leading.successors {
            return;
        }
        leading.successors = next;
        self.beat_all(now);
    }
}
