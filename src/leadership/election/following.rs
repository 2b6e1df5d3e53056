//! Following a leader: processing its beats and other nodes' evidence, and detecting its loss.

use std::time::Duration;

use crate::leadership::election::interface::ElectionEffect;
use crate::leadership::election::leader_clock::LeaderClock;
use crate::leadership::election::liveness::Following;
use crate::leadership::election::message::{Body, ElectionMessage};
use crate::leadership::election::{Beat, Election, State};
use crate::model::epoch::Epoch;
use crate::model::names::NodeName;
use crate::model::time::Timestamp;
use crate::wire::Role;

impl Election {
    pub(super) fn following_deadline(&self, following: &Following) -> Timestamp {
        following.lost_at(&self.config).min(self.ask_at(following))
    }

    /// Checks the deadlines of a follower: asks about a silent leader, and gives the leader up when
    /// it counts as lost.
    pub(super) fn follow_timers(&mut self, now: Timestamp) {
        let State::Following(following) = &self.state else {
            return;
        };
        if now >= following.lost_at(&self.config) {
            let leader = following.epoch.leader.clone();
            self.peers.gone(&leader, now);
            self.lose_leader(now);
        } else if now >= self.ask_at(following) {
            self.doubt(now);
        }
    }

    /// Asks other nodes about the leader. If only one round is late, which may affect all
    /// followers, this node first asks the leader itself and its successors.
    fn doubt(&mut self, now: Timestamp) {
        let State::Following(following) = &mut self.state else {
            return;
        };
        let first = following.asked_at.is_none();
        following.asked_at.get_or_insert(now);
        if first && following.claim.is_none() && now < following.silent_at(&self.config) {
            self.ask_near(now);
        } else {
            self.ask_all(now);
        }
    }

    /// Time of the next question about the leader, counted from its suspicion: after each beat,
    /// after each half beat once the leader is silent, and after each `ask_period` once the direct
    /// timeout has passed.
    fn ask_at(&self, following: &Following) -> Timestamp {
        let now = self.clock.now();
        let pause = if now >= following.direct_timeout_at(&self.config) {
            self.config.ask_period()
        } else if now < following.silent_at(&self.config) {
            self.config.beat()
        } else {
            self.config.beat() / 2
        };
        following
            .suspect_at(&self.config)
            .max(self.questions.own_at() + pause)
    }

    /// Processes a leader's beat or claim.
    ///
    /// A beat of the followed epoch refreshes the leader. A seeking node follows the sender unless
    /// it has followed a later epoch. A leader decides in `on_other_leader` which of the two continues.
    /// A follower that receives another node's claim follows it only if that node is better by rank
    /// or number of followers; otherwise it keeps the claim and sends its status. A beat of a lower
    /// epoch is answered by a status, so that its sender renews its term.
    ///
    /// # Example
    /// `euclid` follows `edge` in term 4. `gauss` has lost contact with `edge` and claims term 5.
    /// `euclid` keeps the claim, queries `edge`, and sends `gauss` its status, which states term
    /// 4 of `edge`. The next beat of `edge` drops the claim. If `edge` is lost instead,
    /// `lose_leader` follows the claim at once.
    pub(super) fn on_beat(&mut self, beat: Beat, now: Timestamp) {
        if self.is_over(&beat.epoch) {
            self.send_status(&beat.epoch.leader, now);
            return;
        }
        match &mut self.state {
            State::Following(following) if following.epoch == beat.epoch => self.refresh(beat, now),
            State::Leading(_) => self.on_other_leader(beat, now),
            State::Seeking(_) if Some(&beat.epoch) >= self.epoch.as_ref() => self.follow(beat, now),
            State::Following(following) if beat.epoch > following.epoch => {
                let leader = following.epoch.leader.clone();
                let claimant = beat.epoch.leader.clone();
                let content = now < following.suspect_at(&self.config);
                let rightful = beat.followers > 0 || beat.after.as_ref() >= Some(&following.epoch);
                let gives_way = if self.outranks(&claimant, &leader) {
                    !content || beat.hears_us && rightful
                } else {
                    beat.hears_us
                        && self.peers.followers(&claimant, now) > self.peers.followers(&leader, now)
                };
                if leader == claimant || gives_way {
                    self.follow(beat, now);
                } else {
                    if let State::Following(following) = &mut self.state {
                        let since = following.claim.take().map_or(now, |claim| claim.0);
                        following.claim = Some((since, beat).into());
                    }
                    self.send_status(&claimant, now);
                }
            }
            State::Following(_) => self.send_status(&beat.epoch.leader, now),
            // The epoch is lower than the last followed epoch: the leader of that epoch is lost,
            // and this claim has to be outbid.
            State::Seeking(_) => {
                let over = self.epoch.clone().max(self.over.clone());
                let no_login = self.no_login.clone();
                self.send(&beat.epoch.leader, Body::Status { over, no_login }, now);
            }
        }
    }

    /// Decides whether this node stops leading because of another leader's higher epoch. The node
    /// stops for the node to which it has yielded, and for a leader of higher rank unless only this
    /// node has followers. It stops for a leader of the same rank unless that leader has fewer
    /// followers, and for a leader of lower rank only if that leader has more followers. The
    /// follower count of each leader is the count that it states in its beats. If this node does
    /// not stop, it continues in a term above both.
    ///
    /// # Example
    /// A split heals between `edge` (term 4, three followers) and `gauss` (term 5, two followers),
    /// both of the same rank. `edge` receives the beat of term 5, has more followers, and schedules
    /// term 6 (`contest`). `gauss` answers beats of term 4 by its own beat. When `edge` leads in
    /// term 6, `gauss` has fewer followers: it stops publishing, sends `edge` its evidence and
    /// follows.
    fn on_other_leader(&mut self, beat: Beat, now: Timestamp) {
        let State::Leading(leading) = &self.state else {
            return;
        };
        let own = leading.epoch.clone();
        let other = beat.epoch.leader.clone();
        if beat.epoch < own {
            self.send_beat(&other, now);
            return;
        }
        let followers = self.peers.followers(&self.id, now);
        let stays = if leading.has_yielded_to(&other) && beat.after.as_ref() == Some(&own) {
            false
        } else if !beat.hears_us {
            // The other leader does not receive this node's messages. An edge without followers is
            // of no use; a vehicle at least serves itself.
            followers > 0 || self.config.role != Role::Edge
        } else if self.outranks(&other, &self.id) {
            followers > 0 && beat.followers == 0 && beat.after.as_ref() < Some(&own)
        } else {
            let theirs = self.peers.followers(&other, now);
            theirs < followers || theirs == followers && self.outranks(&self.id, &other)
        };
        if !stays {
            self.stop_leading(&other);
            self.follow(beat, now);
        } else if beat.hears_us {
            self.contest(&other, now);
        }
    }

    /// True if `name` has a higher rank (role, priority) than `other` and the ranks of both are
    /// available. Certificates limit ranks.
    fn outranks(&self, name: &NodeName, other: &NodeName) -> bool {
        let rank = |name: &NodeName| {
            let own = (*name == self.id).then(|| self.candidacy());
            Some(own.or_else(|| self.peers.get(name)?.candidacy)?.rank())
        };
        rank(name)
            .zip(rank(other))
            .is_some_and(|(name, other)| name < other)
    }

    /// Pushes the effects with which a leadership ends in favour of `next`: the fuser stops, and
    /// `next` gets this node's evidence. The caller sets the new state.
    fn stop_leading(&mut self, next: &NodeName) {
        if let State::Leading(leading) = &self.state {
            self.effects.push(ElectionEffect::StopPublishing {
                epoch: leading.epoch.clone(),
            });
            self.effects
                .push(ElectionEffect::SendSnapshot { to: next.clone() });
        }
    }

    /// Follows the leader that sent `beat`: records epoch, round and clock, drops questions that
    /// wait for the previous leader, and answers by a status.
    fn follow(&mut self, beat: Beat, now: Timestamp) {
        let beat_interval = self.beat_interval_of(&beat);
        self.epoch = Some(beat.epoch.clone());
        self.observe_round(&beat.epoch.leader, beat.round);
        self.leader_clock = Some(LeaderClock::of_beat(beat.epoch.clone(), beat.life, now));
        self.waiting_questions.clear();
        let leader = beat.epoch.leader.clone();
        self.state = State::Following(Following::new(
            beat.epoch,
            beat.successors,
            beat_interval,
            now,
            Timestamp::default(),
        ));
        self.send_status(&leader, now);
    }

    /// Follows a leader that only other nodes have reported; the leader's first beat completes the
    /// state.
    pub(super) fn adopt(&mut self, epoch: Epoch, heard_at: Timestamp, now: Timestamp) {
        let leader = epoch.leader.clone();
        self.epoch = Some(epoch.clone());
        let unheard = Timestamp::default();
        self.state = State::Following(Following::new(
            epoch,
            Vec::new(),
            self.config.beat(),
            unheard,
            heard_at,
        ));
        self.peers.add(&leader);
        self.send_status(&leader, now);
    }

    /// The leader's interval of beats to this node, at most this node's own `idle_beat_ms`: a leader
    /// cannot postpone the time at which its silence ends its leadership.
    fn beat_interval_of(&self, beat: &Beat) -> Duration {
        Duration::from_millis(beat.every_ms).min(self.config.idle_beat())
    }

    /// Handles a beat of the followed leader: restarts its deadlines, replaces the list of
    /// successors and the interval of beats, answers questions that waited for a sign of life, and
    /// answers by a status.
    fn refresh(&mut self, beat: Beat, now: Timestamp) {
        let beat_interval = self.beat_interval_of(&beat);
        self.observe_round(&beat.epoch.leader, beat.round);
        match &mut self.leader_clock {
            Some(clock) if clock.is_of(&beat.epoch) => clock.beat(beat.life, now),
            clock => *clock = Some(LeaderClock::of_beat(beat.epoch.clone(), beat.life, now)),
        }
        if !self.waiting_questions.is_empty() {
            self.answer_waiting(now);
        }
        let State::Following(following) = &mut self.state else {
            return;
        };
        following.beat_interval = beat_interval;
        following.receive(now);
        following.has_beaten = true;
        following.drop_round_interval(now);
        if beat.hears_us {
            following.bidirectional_at = now;
        }
        following.successors = beat.successors;
        self.send_status(&beat.epoch.leader, now);
    }

    /// Derives changes of leadership from the sender's epoch, which every message contains.
    ///
    /// A follower whose leader states another epoch, in a message other than a beat, closes its
    /// own. A leader stops if more nodes follow the stated leader than this one; otherwise it
    /// schedules a renewed term.
    ///
    /// # Example
    /// `euclid` follows `edge` in term 4. `edge` has handed over to `gauss`, and its status states
    /// term 5 of `gauss`. `euclid` closes term 4 and follows `gauss`, before the first beat of
    /// `gauss` has arrived.
    pub(super) fn on_other_leadership(&mut self, message: &ElectionMessage, now: Timestamp) {
        match &self.state {
            State::Following(following) if following.epoch.leader == message.from => {
                let leads = message.epoch.as_ref() == Some(&following.epoch);
                let is_earlier = !following.has_beaten && message.term < following.epoch.term;
                if !leads && !is_earlier && !matches!(message.body, Body::Beat { .. }) {
                    let ended = following.epoch.clone();
                    let follows = message.epoch.clone().filter(|next| {
                        *next > ended
                            && next.leader != message.from
                            && next.leader != self.id
                            && !self.is_over(next)
                    });
                    self.close(ended);
                    // Followers of the old leader follow the leader that it now follows, so that no
                    // follower has to claim leadership.
                    match follows {
                        Some(next) => self.adopt(next, now, now),
                        None => self.lose_leader(now),
                    }
                }
            }
            State::Leading(leading) if message.hears_you => {
                let own = leading.epoch.clone();
                match &message.epoch {
                    Some(other)
                        if *other > own
                            && other.leader != message.from
                            && other.leader != self.id =>
                    {
                        // A leadership ends only if more nodes report another leader than follow
                        // this one, and if the other leader is a known candidate. The node's own
                        // followers get time to answer; until then only the other leader's own beat
                        // counts.
                        let is_answered = now.since(leading.since) > self.config.response_timeout();
                        let has_more_followers = self.peers.followers(&other.leader, now)
                            > self.peers.followers(&self.id, now);
                        if is_answered
                            && has_more_followers
                            && self.peers.may_lead(&other.leader, now)
                        {
                            let other = other.clone();
                            self.stop_leading(&other.leader);
                            self.adopt(other, now, now);
                        } else if self.peers.followers(&self.id, now) > 0 {
                            self.renew_later(&message.from, now);
                        }
                        // A leader without followers does not raise its term against the other
                        // leader; it waits for that leader's own beat.
                    }
                    Some(other) if *other != own => {}
                    _ if message.term > own.term => self.renew_later(&message.from, now),
                    Some(_) => self.peers.record_refusal(&message.from, false),
                    None => {}
                }
            }
            State::Seeking(_) | State::Following(_) | State::Leading(_) => {}
        }
    }

    /// Processes another node's status: whether it refuses this node's leadership, which epoch it
    /// reports as over, and at which brokers it cannot log in.
    pub(super) fn on_status(
        &mut self,
        from: &NodeName,
        over: Option<&Epoch>,
        no_login: Vec<NodeName>,
        now: Timestamp,
    ) {
        self.peers.record_no_login(from, no_login);
        if let State::Leading(leading) = &self.state
            && over.is_some_and(|over| *over >= leading.epoch)
        {
            self.renew_later(from, now);
        }
        // If two nodes began to lead at the same time, one of them stops at once. It may have
        // followers that do not receive the other leader's next beat for a while.
        let current = self.current_epoch().cloned();
        let is_corrected = self.peers.correct(from, &self.id, current.as_ref());
        if !is_corrected && self.peers.get(from).is_none_or(|peer| peer.is_confirmed) {
            return;
        }
        if self.is_leading() {
            self.send_beat(from, now);
        } else {
            self.send_status(from, now);
        }
    }

    /// Closes the epoch that a leader has resigned from. A follower of that leader starts seeking
    /// at once instead of waiting for the leader's timeout.
    pub(super) fn on_resign(&mut self, epoch: &Epoch, last_round: u64, now: Timestamp) {
        if self.epoch.as_ref() == Some(epoch) {
            self.observe_round(&epoch.leader, last_round);
        }
        if let State::Following(following) = &mut self.state {
            following.claim.take_if(|claim| claim.1.epoch == *epoch);
        }
        if self.epoch.as_ref() == Some(epoch) {
            self.close(epoch.clone());
            self.lose_leader(now);
        }
    }

    /// Handles the membership's doubt: queries all nodes if the doubt concerns the leader.
    pub(super) fn peer_suspected(&mut self, peer: &NodeName, now: Timestamp) {
        if matches!(&self.state, State::Following(following) if following.epoch.leader == *peer) {
            self.ask_all(now);
        }
    }

    /// Checks a leader that the membership gave up. The membership may have less information than
    /// the leader's beats and other nodes' reports provide.
    pub(super) fn peer_down(&mut self, peer: &NodeName, now: Timestamp) {
        if let State::Following(following) = &mut self.state
            && following.epoch.leader == *peer
        {
            following.given_up = true;
            following.asked_at.get_or_insert(now);
            self.ask_all(now);
        }
        self.peers.down(peer, now);
        self.name_successors(now);
    }

    /// Handles the proven end of a process: the peer is not a candidate for the response timeout.
    /// If it was the leader, its epoch is closed, and this node follows a recent claim or seeks at
    /// once, without waiting for a timeout.
    pub(super) fn peer_gone(&mut self, peer: &NodeName, now: Timestamp) {
        self.peers.gone(peer, now);
        match &self.state {
            State::Following(following) if following.epoch.leader == *peer => {
                self.close(following.epoch.clone());
                self.lose_leader(now);
            }
            State::Seeking(_) | State::Following(_) | State::Leading(_) => {
                self.name_successors(now);
            }
        }
    }

    /// Called when the leader is lost. Follows the node that claims leadership if its claim is
    /// recent and this node does not outrank it; otherwise starts seeking.
    ///
    /// # Example
    /// `edge` is lost and had named the successors `gauss`, `euclid`. If `gauss` has claimed within
    /// the response timeout, this node follows it. Otherwise the node seeks: `gauss` may claim at
    /// once, and `euclid` one claim step later if no beat of `gauss` arrives.
    fn lose_leader(&mut self, now: Timestamp) {
        let State::Following(following) = &mut self.state else {
            return;
        };
        let order = std::mem::take(&mut following.successors);
        let claim = following.claim.take().map(|claim| *claim);
        let is_good = |(at, beat): &(Timestamp, Beat)| {
            let is_recent = now.since(*at) <= self.config.response_timeout();
            let is_outranked =
                self.candidacy().may_lead() && self.outranks(&self.id, &beat.epoch.leader);
            is_recent && !is_outranked && !self.is_over(&beat.epoch)
        };
        match claim.filter(is_good) {
            Some((_, beat)) => self.follow(beat, now),
            None => self.seek(order, now, now),
        }
    }
}
