//! Links to brokers, and the rounds and evidence that brokers pass on.
//!
//! A node publishes on every link that it keeps. Each broker forwards the messages that its rule allows, to all linked
//! nodes: so rounds come twice, late, or from two leaders at once.

use std::collections::btree_map::Entry;

use ecod::aggregator::round::FirstRound;
use ecod::leadership::links::{LinkState, WantedLinks};
use ecod::leadership::node::Input;
use ecod::leadership::round_filter::Origin;
use ecod::leadership::timers::{ELECTED_SILENCE, EPOCH_MEMORY, MAX_ROUND_AGE};
use ecod::model::epoch::Epoch;
use ecod::model::time::Timestamp;
use ecod::wire::{GlobalMap, LedgerShare, LedgerSignature};

use crate::sim::node::{Accepted, Arrival, Map, address_of};
use crate::sim::world::{MS, World};

/// Shares that a full queue or a link that is just made loses, in percent.
const LOST_SHARES_PERCENT: u64 = 10;

impl World {
    /// Sets the links as the machine requires.
    pub(crate) fn set_links(&mut self, index: usize, wanted: &WantedLinks) {
        let is_wanted = |broker: &usize| wanted.brokers.contains(&address_of(*broker));
        self.nodes[index]
            .links
            .retain(|broker, _| is_wanted(broker));
        for broker in (0..self.nodes.len()).filter(is_wanted) {
            if let Entry::Vacant(link) = self.nodes[index].links.entry(broker) {
                link.insert(LinkState::Down);
                self.plan_connect(index, broker, 0);
            }
        }
    }

    pub(crate) fn plan_connect(&mut self, to: usize, broker: usize, pause: u64) {
        let after = pause + self.random.between(MS, 20 * MS);
        self.push_to(to, after, Arrival::Connect { broker });
    }

    /// Tries to connect, and goes on trying.
    pub(crate) fn connect(&mut self, to: usize, broker: usize) {
        let Some(state) = self.nodes[to].links.get(&broker) else {
            return;
        };
        if self.reaches(to, broker) {
            self.set_link(to, broker, LinkState::Up);
        } else if *state != LinkState::Up {
            self.plan_connect(to, broker, 80 * MS);
        }
    }

    pub(crate) fn set_link(&mut self, to: usize, broker: usize, state: LinkState) {
        self.nodes[to].links.insert(broker, state);
        self.handle(
            to,
            Input::LinkChanged {
                broker: address_of(broker),
                state,
            },
        );
    }

    /// True if a node gets an answer of another's broker now.
    fn reaches(&self, node: usize, broker: usize) -> bool {
        let there = &self.nodes[broker];
        let serves =
            there.machine.is_some() && there.broker_works && there.paused_until <= self.now;
        serves && self.linked(node, broker) && !self.refusals.contains(&(node, broker))
    }

    /// Brokers that a node publishes to.
    fn brokers_of(&self, index: usize) -> Vec<usize> {
        let links = self.nodes[index]
            .links
            .iter()
            .filter(|(_, state)| **state == LinkState::Up);
        links
            .map(|(broker, _)| *broker)
            .filter(|broker| self.reaches(index, *broker))
            .collect()
    }

    /// Nodes to which a broker passes things on.
    fn clients_of(&self, broker: usize) -> Vec<usize> {
        let is_client = |node: &usize| {
            self.nodes[*node].links.get(&broker) == Some(&LinkState::Up)
                && self.linked(*node, broker)
        };
        (0..self.nodes.len()).filter(is_client).collect()
    }

    /// Time that a message takes over one connection, in µs.
    fn hop(&mut self) -> u64 {
        let retry = if self.random.chance(self.loss_percent) {
            30 * MS
        } else {
            0
        };
        retry + self.random.between(300, 2 * MS)
    }

    pub(crate) fn begin_to_publish(
        &mut self,
        index: usize,
        epoch: Epoch,
        first_round: u64,
        first: FirstRound,
    ) {
        let node = &mut self.nodes[index];
        let term = epoch.term;
        node.publishing = Some((epoch, first_round));
        node.rounds.start(first, Timestamp(self.now));
        self.plan_round(index, term);
    }

    fn plan_round(&mut self, index: usize, term: u64) {
        let node = &self.nodes[index];
        let after = node.rounds.deadline().since(Timestamp(self.now));
        self.push_to(index, after.as_micros() as u64, Arrival::Publish { term });
    }

    pub(crate) fn publish(&mut self, index: usize, term: u64) {
        let node = &mut self.nodes[index];
        let Some((epoch, next)) = node
            .publishing
            .as_mut()
            .filter(|(epoch, _)| epoch.term == term)
        else {
            return;
        };
        let fused_at = Timestamp(self.now).shifted(node.steady_clock);
        let map = Map {
            epoch: epoch.clone(),
            round: *next,
            fused_at,
            made_at: self.now,
        };
        *next += 1;
        node.rounds.tick(Timestamp(self.now));
        self.plan_round(index, term);
        if !self.nodes[index].fuser_works {
            return;
        }
        for broker in self.brokers_of(index) {
            let after = self.hop();
            self.push_to(
                broker,
                after,
                Arrival::Relay {
                    from: index,
                    map: map.clone(),
                },
            );
        }
        self.accept(index, &map);
        self.judge_vehicles(index, &map.epoch);
    }

    /// A map arrives at a broker, which forwards it if the publisher has the right to publish there.
    pub(crate) fn relay(&mut self, broker: usize, from: usize, map: &Map) {
        let publisher = self.nodes[from].name.clone();
        let now = Timestamp(self.now).shifted(self.nodes[broker].steady_clock);
        let node = &mut self.nodes[broker];
        if !node.broker_works
            || !node
                .publishers
                .may_publish(&publisher, &node.leadership, now)
        {
            return;
        }
        for to in self.clients_of(broker).into_iter().filter(|to| *to != from) {
            let after = self.hop();
            self.push_to(to, after, Arrival::Map { map: map.clone() });
        }
    }

    /// Sends shares to all candidates that have a link to one of the brokers to which the node publishes; some are
    /// lost.
    pub(crate) fn share(&mut self, index: usize, shares: Vec<LedgerShare>) {
        let leads = self.nodes[index].lane.as_ref().map(|lane| lane.term);
        for mut share in shares {
            if self.nodes[index].signs && !share.is_empty() {
                let signature = LedgerSignature {
                    certificate: String::new(),
                    signature: String::new(),
                };
                share.signed.get_or_insert(signature);
            }
            assert_eq!(
                share.epoch, leads,
                "{} shares what another leadership recorded as its own",
                share.node
            );
            for broker in self.brokers_of(index) {
                for to in self
                    .clients_of(broker)
                    .into_iter()
                    .filter(|to| *to != index)
                {
                    if self.random.chance(LOST_SHARES_PERCENT) {
                        continue;
                    }
                    let after = self.hop() + self.hop();
                    self.push_to(
                        to,
                        after,
                        Arrival::Share {
                            share: Box::new(share.clone()),
                        },
                    );
                }
            }
        }
    }

    pub(crate) fn accept(&mut self, to: usize, map: &Map) {
        let node = &mut self.nodes[to];
        let received_at = Timestamp(self.now).shifted(node.steady_clock);
        let Map { epoch, round, .. } = map.clone();
        let global = GlobalMap::new(&epoch, round, map.fused_at);
        let Ok(accepted) =
            node.filter
                .accept_map(&global, Origin::Claimed, received_at, &node.leadership)
        else {
            node.refused += 1;
            return;
        };
        self.judge(to, map);
        self.nodes[to].accepted.push(Accepted {
            at: self.now,
            epoch,
            round,
        });
        if accepted.is_sign_of_life {
            self.handle(
                to,
                Input::RoundAccepted {
                    epoch: accepted.epoch,
                    round,
                },
            );
        }
    }

    /// Checks that an accepted map may be shown to a driver: it is not repeated, superseded or old.
    fn judge(&self, to: usize, map: &Map) {
        let node = &self.nodes[to];
        let age = self.now - map.made_at;
        let of_this_run = || {
            node.accepted
                .iter()
                .rev()
                .take_while(|accepted| accepted.at >= node.started_at)
        };
        let fail = |what: &str| {
            let last = of_this_run().next();
            let leadership = &node.leadership;
            panic!(
                "{} accepts #{} of {}, {age} µs old: {what}; {leadership:?}, before {last:?}\n{}",
                node.name,
                map.round,
                map.epoch,
                self.history.join("\n")
            )
        };
        if u128::from(age) > MAX_ROUND_AGE.as_micros() {
            fail("it is too old");
        }
        if of_this_run().any(|accepted| accepted.epoch == map.epoch && accepted.round >= map.round)
        {
            fail("it or a later one of its leadership was accepted before");
        }
        let of_earlier_runs = || {
            node.accepted
                .iter()
                .filter(|accepted| accepted.at < node.started_at)
        };
        let is_starting = u128::from(self.now - node.started_at) < EPOCH_MEMORY.as_micros();
        if is_starting && of_earlier_runs().any(|accepted| accepted.epoch.term > map.epoch.term) {
            fail("a later leadership's was accepted before the start");
        }
        if let Some(elected) = node.leadership.present_epoch() {
            let is_received = |accepted: &Accepted| {
                accepted.epoch == *elected
                    && u128::from(self.now - accepted.at) < ELECTED_SILENCE.as_micros()
            };
            let may_lead = [Some(&elected.leader), node.leadership.standby.as_ref()]
                .contains(&Some(&map.epoch.leader));
            if map.epoch > *elected && !may_lead && of_this_run().next().is_some_and(is_received) {
                fail("the elected leader's are there, and it is no successor of it");
            }
        }
        // The last rounds of a leadership that was gone back to may arrive when the next one has begun.
        if of_this_run()
            .next()
            .is_some_and(|last| last.epoch == map.epoch)
        {
            return;
        }
        let Some(later) = of_this_run().find(|accepted| accepted.epoch > map.epoch) else {
            return;
        };
        // A round that a node published itself is not a forgery.
        if later.epoch.leader == node.name {
            fail("it led itself in a later term");
        }
        let is_elected = node.leadership.present_epoch() == Some(&map.epoch);
        let is_alone = node.leadership.leader().is_none()
            && u128::from(self.now - later.at) >= EPOCH_MEMORY.as_micros() - 1000;
        if !is_elected && !is_alone {
            fail("a later leadership's was accepted before");
        }
    }
}
