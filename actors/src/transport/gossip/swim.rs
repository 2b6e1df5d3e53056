//! Failure detection by the SWIM protocol of `foca`, with foca's timers. No clock, no socket.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap, VecDeque};
use std::num::{NonZeroU8, NonZeroUsize};
use std::time::Duration;

use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use foca::{
    AccumulatingRuntime, Codec, Foca, NoCustomBroadcast, OwnedNotification, PostcardCodec, State,
    Timer,
};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::MAX_PAYLOAD_BYTES;
use super::config::MembershipConfig;
use super::counters::FrameEvent;
use super::node_id::NodeId;
use super::sessions::KnownMember;

/// An action or event of the gossip.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum SwimOutput {
    /// Send a message to a node.
    Send { to: NodeId, body: Vec<u8> },
    /// A node is alive, or a new run of it.
    Alive(NodeId),
    /// A node does not answer.
    Suspected(NodeName),
    /// A node is down.
    Down(NodeName),
    /// A living node's identity changed.
    Changed(NodeId),
    /// Other nodes mention a node that this node has not admitted, in a cell where only admitted
    /// nodes count.
    Unproven(NodeId),
}

/// This node's SWIM instance.
pub(crate) struct Swim {
    foca: Foca<NodeId, PostcardCodec, ChaCha8Rng, NoCustomBroadcast>,
    runtime: AccumulatingRuntime<NodeId>,
    timers: BinaryHeap<Reverse<ScheduledTimer>>,
    scheduled: u64,
    alive: BTreeMap<NodeName, NodeId>,
    /// Lives of the admitted nodes according to themselves, in a cell with certificates: other
    /// nodes' statements cannot exceed them.
    lives: Option<BTreeMap<NodeName, u64>>,
    /// Time of this node's last renewal after it was declared down, and of the next.
    renewed_at: Option<Timestamp>,
    renew_at: Option<Timestamp>,
    left: bool,
    outputs: VecDeque<SwimOutput>,
}

#[derive(Debug, PartialEq, Eq, PartialOrd, Ord)]
struct ScheduledTimer {
    at: Timestamp,
    timer: Timer<NodeId>,
    order: u64,
}

impl Swim {
    pub(crate) fn new(own: NodeId, config: &MembershipConfig, proves: bool, seed: u64) -> Self {
        Self {
            foca: Foca::new(
                own,
                settings(config),
                ChaCha8Rng::seed_from_u64(seed),
                PostcardCodec,
            ),
            runtime: AccumulatingRuntime::new(),
            timers: BinaryHeap::new(),
            scheduled: 0,
            alive: BTreeMap::new(),
            lives: proves.then(BTreeMap::new),
            renewed_at: None,
            renew_at: None,
            left: false,
            outputs: VecDeque::new(),
        }
    }

    /// The next action or event.
    pub(crate) fn poll(&mut self) -> Option<SwimOutput> {
        self.outputs.pop_front()
    }

    pub(crate) fn own(&self) -> &NodeId {
        self.foca.identity()
    }

    /// All living nodes except this one, by name.
    pub(crate) fn alive(&self) -> &BTreeMap<NodeName, NodeId> {
        &self.alive
    }

    /// The state of another node.
    pub(crate) fn known(&self, name: &NodeName) -> Option<KnownMember> {
        let member = self
            .foca
            .iter_membership_state()
            .find(|member| member.id().name == *name)?;
        let NodeId { run, life, .. } = *member.id();
        Some(KnownMember {
            run,
            life,
            alive: member.state() != State::Down,
        })
    }

    /// Time at which [`Self::tick`] is next needed.
    pub(crate) fn next_due(&self) -> Option<Timestamp> {
        let timer = self.timers.peek().map(|Reverse(due)| due.at);
        [timer, self.renew_at].into_iter().flatten().min()
    }

    /// Processes a message that `from` has authenticated.
    ///
    /// In a cell with certificates, frames received directly from a node (`has_received`) outweigh
    /// other nodes' statements about it.
    pub(crate) fn receive(
        &mut self,
        from: &NodeName,
        body: &[u8],
        has_received: &dyn Fn(&NodeName) -> bool,
        now: Timestamp,
    ) -> Result<(), FrameEvent> {
        let mut updates = body;
        let header = Codec::<NodeId>::decode_header(&mut PostcardCodec, &mut updates)
            .map_err(|_| FrameEvent::Malformed)?;
        if header.src.name != *from {
            return Err(FrameEvent::NameMismatch);
        }
        if !header.src.has_plausible_life() {
            return Err(FrameEvent::Malformed);
        }
        let result = if self.lives.is_some() {
            let body = self
                .without_secondhand(&header.src, body, updates, has_received)
                .map_err(|_| FrameEvent::Malformed)?;
            self.foca.handle_data(&body, &mut self.runtime)
        } else {
            self.foca.handle_data(body, &mut self.runtime)
        };
        self.collect(now);
        result.map_err(|_| FrameEvent::Malformed)
    }

    /// Removes second-hand statements from a message: news of nodes that this node has not
    /// admitted, lives that a node has not claimed itself, and suspicions of nodes that this node
    /// receives directly. `updates` is the part of `body` behind its header.
    fn without_secondhand(
        &mut self,
        from: &NodeId,
        body: &[u8],
        updates: &[u8],
        has_received: &dyn Fn(&NodeName) -> bool,
    ) -> Result<Vec<u8>, postcard::Error> {
        let Some((count, mut rest)) = updates.split_first_chunk::<2>() else {
            return Ok(body.to_vec());
        };
        self.record_member(from);
        let mut kept = body
            .get(..body.len() - updates.len())
            .unwrap_or_default()
            .to_vec();
        let mut codec = PostcardCodec;
        let mut kept_updates = Vec::new();
        for _ in 0..u16::from_be_bytes(*count) {
            let update: foca::Member<NodeId> = codec.decode_member(&mut rest)?;
            let id = update.id();
            match self.lives.as_ref().and_then(|lives| lives.get(&id.name)) {
                _ if id.name == self.foca.identity().name => kept_updates.push(update),
                Some(life) if id.life <= *life => {
                    let is_doubt = update.state() != State::Alive && id.name != from.name;
                    if !is_doubt || !has_received(&id.name) {
                        kept_updates.push(update);
                    }
                }
                Some(_) => {}
                None if update.state() != State::Down => {
                    self.outputs.push_back(SwimOutput::Unproven(id.clone()));
                }
                None => {}
            }
        }
        kept.extend(
            u16::try_from(kept_updates.len())
                .unwrap_or(u16::MAX)
                .to_be_bytes(),
        );
        kept_updates
            .iter()
            .try_for_each(|update| codec.encode_member(update, &mut kept))?;
        kept.extend_from_slice(rest);
        Ok(kept)
    }

    /// Runs the timers that are due.
    pub(crate) fn tick(&mut self, now: Timestamp) {
        while let Some(Reverse(due)) = self.timers.peek()
            && due.at <= now
            && let Some(Reverse(due)) = self.timers.pop()
        {
            let handled = self.foca.handle_timer(due.timer, &mut self.runtime);
            self.finish("timer", handled, now);
        }
        if self.renew_at.is_some_and(|at| at <= now) {
            self.renew(now);
        }
    }

    /// Announces this node to a node that was just admitted.
    pub(crate) fn member_up(&mut self, peer: NodeId, now: Timestamp) {
        self.record_member(&peer);
        let announced = self.foca.announce(peer, &mut self.runtime);
        self.finish("announce", announced, now);
    }

    /// Records an admitted node's statement about itself.
    pub(crate) fn record_member(&mut self, peer: &NodeId) {
        if let Some(lives) = &mut self.lives {
            let life = lives.entry(peer.name.clone()).or_default();
            *life = peer.life.max(*life);
        }
    }

    /// Declares a node down that may not be a member any more.
    pub(crate) fn remove(&mut self, name: &NodeName, now: Timestamp) {
        if let Some(lives) = &mut self.lives {
            lives.remove(name);
        }
        let known = self
            .foca
            .iter_membership_state()
            .find(|member| member.id().name == *name);
        if let Some(id) = known.map(|member| member.id().clone()) {
            let down = foca::Member::down(id);
            let removed = self
                .foca
                .apply_many(std::iter::once(down), true, &mut self.runtime);
            self.finish("removal", removed, now);
        }
    }

    #[cfg(test)]
    pub(crate) fn spread(&mut self, about: foca::Member<NodeId>, now: Timestamp) {
        let spread = self
            .foca
            .apply_many(std::iter::once(about), true, &mut self.runtime);
        self.finish("lie", spread, now);
    }

    /// Takes a `life` after the life of the node that had this name before.
    pub(crate) fn start_life_after(&mut self, life: u64, now: Timestamp) {
        if life >= self.own().life {
            self.change(now, |own| own.life = life);
        }
    }

    /// Changes this node's identity and spreads the change.
    pub(crate) fn change(&mut self, now: Timestamp, change: impl FnOnce(&mut NodeId)) {
        let mut own = self.own().clone();
        change(&mut own);
        own.life = own.life.saturating_add(1);
        let changed = self.foca.change_identity(own, &mut self.runtime);
        self.finish("change of identity", changed, now);
    }

    /// Announces to the other nodes that this node leaves.
    pub(crate) fn leave(&mut self, now: Timestamp) {
        self.left = true;
        let left = self.foca.leave_cluster(&mut self.runtime);
        self.finish("leave", left, now);
        self.timers.clear();
        self.renew_at = None;
    }

    fn renew(&mut self, now: Timestamp) {
        self.renew_at = None;
        self.renewed_at = Some(now);
        self.change(now, |_| ());
    }

    fn finish(&mut self, operation: &str, result: Result<(), foca::Error>, now: Timestamp) {
        if let Err(error) = result {
            tracing::debug!(%error, operation, "gossip operation failed");
        }
        self.collect(now);
    }

    /// Moves the outputs of foca to this machine: datagrams, timers in order of their time, and
    /// notifications. The timer that will declare a node down also yields the suspicion of that
    /// node.
    fn collect(&mut self, now: Timestamp) {
        while let Some((to, body)) = self.runtime.to_send() {
            self.outputs.push_back(SwimOutput::Send {
                to,
                body: body.into(),
            });
        }
        while let Some((after, timer)) = self.runtime.to_schedule() {
            if let Timer::ChangeSuspectToDown { member_id, .. } = &timer
                && self.alive.contains_key(&member_id.name)
            {
                self.outputs
                    .push_back(SwimOutput::Suspected(member_id.name.clone()));
            }
            self.scheduled += 1;
            self.timers.push(Reverse(ScheduledTimer {
                at: now + after,
                timer,
                order: self.scheduled,
            }));
        }
        while let Some(notification) = self.runtime.to_notify() {
            self.on_notification(notification, now);
        }
    }

    /// Handles a notification of foca: members that came up, went down or changed become outputs.
    /// If the other nodes have declared this node down, it renews its identity, at most once per
    /// [`MIN_RENEW_INTERVAL`].
    fn on_notification(&mut self, notification: OwnedNotification<NodeId>, now: Timestamp) {
        match notification {
            OwnedNotification::MemberUp(id) => {
                self.alive.insert(id.name.clone(), id.clone());
                self.outputs.push_back(SwimOutput::Alive(id));
            }
            OwnedNotification::MemberDown(id) => {
                if self.alive.remove(&id.name).is_some() {
                    self.outputs.push_back(SwimOutput::Down(id.name));
                }
            }
            OwnedNotification::Rename(_, id) => {
                if let Some(before) = self.alive.get_mut(&id.name) {
                    let before = std::mem::replace(before, id.clone());
                    let same = (before.run, before.role) == (id.run, id.role);
                    self.outputs.push_back(if same {
                        SwimOutput::Changed(id)
                    } else {
                        SwimOutput::Alive(id)
                    });
                }
            }
            OwnedNotification::Defunct if !self.left => {
                // Others declared this node down, such as while its process was stopped.
                let earliest = self
                    .renewed_at
                    .map_or(now, |renewed_at| renewed_at + MIN_RENEW_INTERVAL);
                if earliest <= now {
                    self.renew(now);
                } else {
                    self.renew_at = Some(earliest);
                }
            }
            OwnedNotification::Active
            | OwnedNotification::Idle
            | OwnedNotification::Defunct
            | OwnedNotification::Rejoin(_) => (),
        }
    }
}

/// Minimum time between two renewals.
const MIN_RENEW_INTERVAL: Duration = Duration::from_secs(1);

fn settings(config: &MembershipConfig) -> foca::Config {
    let ms = Duration::from_millis;
    let periodic = |frequency, nodes| {
        Some(foca::PeriodicParams {
            frequency,
            num_members: NonZeroUsize::new(nodes).unwrap_or(NonZeroUsize::MIN),
        })
    };
    foca::Config {
        probe_period: ms(config.probe_ms),
        probe_rtt: ms(config.reply_ms),
        suspect_to_down_after: ms(config.suspect_ms),
        max_transmissions: NonZeroU8::new(8).unwrap_or(NonZeroU8::MIN),
        remove_down_after: Some(Duration::from_secs(600)),
        max_packet_size: NonZeroUsize::new(MAX_PAYLOAD_BYTES).unwrap_or(NonZeroUsize::MIN),
        notify_down_members: true,
        periodic_announce: periodic(Duration::from_secs(10), 1),
        periodic_announce_to_down_members: periodic(Duration::from_secs(2), 1),
        periodic_gossip: periodic(ms(config.gossip_ms), 3),
        ..foca::Config::simple()
    }
}
