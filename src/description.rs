//! The description of a cell at one node: selects the newest description, distributes it, and
//! decides which descriptions to accept.
//!
//! ```text
//! candidate set  -> all         stamp      in election messages, authenticated
//! candidate set  -> brokers     description, retained on `cell`
//! ```
//!
//! A node accepts a description if other nodes state its stamp as their own: an operator's node, or
//! two nodes that may lead, or the leader if the node has no description yet. The body therefore
//! needs no signature, and other members cannot change the cell alone. Nodes that cannot lead only
//! follow.
//!
//! Call [`DescriptionExchange::receive`] for every authenticated stamp, [`DescriptionExchange::on_description`]
//! for every body, [`DescriptionExchange::lead`] and [`DescriptionExchange::retain`] as leadership
//! and membership change, [`DescriptionExchange::revoke`] when certificates are revoked, and
//! [`DescriptionExchange::tick`] about twice in [`PUBLISH_INTERVAL`]. Equal inputs give equal
//! effects.
//!
//! # Merge
//!
//! The greater [`DescriptionStamp`] wins: the later version or, between equal versions, the greater
//! hash. After a split heals, all sides therefore agree, independent of the order of messages. A
//! version that is implausibly far ahead is ignored and counted.
//!
//! # Revocation
//!
//! The node at which a description was set states it first, so at least one other candidate has it
//! from that node. When the certificate of that node is revoked, such a candidate publishes the
//! previous description under a new version, which all nodes accept.

mod history;

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use crate::model::names::NodeName;
use crate::model::time::Timestamp;
use crate::wire::{CellDescription, ContentHash, DescriptionStamp, MAX_INTEGER, SCHEMA_VERSION};
use history::MAX_AUTHORS;
pub use history::{AttributedDescription, DescriptionHistory};

/// Largest rise of the version that one message may state. A cell uses one version for each change
/// by a person.
pub const MAX_VERSION_STEP: u64 = 1 << 20;

/// Largest version that a node without a description accepts from nodes other than its leader.
pub const MAX_FIRST_VERSION: u64 = 1 << 40;

/// Minimum time between the first two publications of one description; it doubles with each further
/// one.
pub const PUBLISH_INTERVAL: Duration = Duration::from_secs(1);

/// Maximum number of doublings: a node that fails to get the description causes little traffic.
const MAX_DOUBLINGS: u32 = 5;

/// Number of nodes that may lead whose equal statements are sufficient if no operator's node is
/// available. A single one of them cannot change the cell.
const MIN_WITNESSES: usize = 2;

/// Maximum number of bodies that wait for a candidate's statement; the oldest is dropped first.
const MAX_UNPROVEN: usize = 4;

/// Maximum number of other nodes' descriptions that are adopted at once; each further one waits
/// [`ADOPTION_INTERVAL`]. Each is written to disk and logged.
const MAX_ADOPTIONS: usize = 8;

/// Average time between two adoptions at a node that keeps receiving new descriptions.
const ADOPTION_INTERVAL: Duration = Duration::from_secs(1);

/// Maximum number of nodes whose stamps are kept.
const MAX_NODES: usize = 4096;

/// Something that the actors of a node must do, in the order given.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum DescriptionEffect {
    /// Save a description, apply it, and announce to other nodes that this node has it.
    Adopt {
        /// The description to use from now on.
        description: Arc<CellDescription>,
        /// The candidate that stated it.
        stated_by: NodeName,
    },
    /// Publish the description, retained.
    Publish {
        /// The complete description, as this node has it.
        description: Arc<CellDescription>,
    },
    /// Count a version that is too far ahead, by its sender.
    CountImplausible {
        /// Node that stated the version.
        from: NodeName,
    },
}

/// The leader, as far as it is relevant here.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
enum Leader {
    #[default]
    Unknown,
    Myself,
    Other(NodeName),
}

/// A node's statement about its description.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DescriptionStatement {
    /// Version and hash of the description that the node has; version 0 without one.
    pub stamp: DescriptionStamp,
    /// True if the node may lead.
    pub may_lead: bool,
    /// True if the node is an operator's, which may set descriptions.
    pub may_describe: bool,
    /// The node's certificate in base64; `None` in a cell without certificates.
    pub certificate: Option<String>,
}

/// The exchange of descriptions on one node; see the module.
#[derive(Debug, Clone)]
pub struct DescriptionExchange {
    name: NodeName,
    may_lead: bool,
    history: DescriptionHistory,
    /// Last statement of each node.
    statements: BTreeMap<NodeName, DescriptionStatement>,
    /// Bodies that no candidate has stated yet, oldest first.
    unproven: VecDeque<Arc<CellDescription>>,
    /// Times of the latest adoptions from others.
    adopted: VecDeque<Timestamp>,
    leader: Leader,
    /// True if brokers may lack the description.
    is_due: bool,
    /// Time of the last publication, and number of publications since the description or the leader
    /// changed.
    published: Option<(Timestamp, u32)>,
    effects: Vec<DescriptionEffect>,
}

impl DescriptionExchange {
    /// Creates the exchange of a node that starts with its saved descriptions.
    pub fn new(name: NodeName, may_lead: bool, saved: DescriptionHistory) -> Self {
        Self {
            name,
            may_lead,
            history: saved,
            statements: BTreeMap::new(),
            unproven: VecDeque::new(),
            adopted: VecDeque::new(),
            leader: Leader::Unknown,
            is_due: false,
            published: None,
            effects: Vec::new(),
        }
    }

    /// The description that this node uses.
    pub fn current(&self) -> Option<&Arc<CellDescription>> {
        self.history
            .current
            .as_ref()
            .map(|current| &current.description)
    }

    /// The current and earlier descriptions, in the form to be saved.
    pub fn history(&self) -> &DescriptionHistory {
        &self.history
    }

    /// Its stamp; version 0 without one.
    pub fn stamp(&self) -> DescriptionStamp {
        self.current()
            .map(|current| current.stamp())
            .unwrap_or_default()
    }

    /// Processes a node's authenticated statement about its description.
    pub fn receive(
        &mut self,
        from: &NodeName,
        statement: DescriptionStatement,
        now: Timestamp,
    ) -> Vec<DescriptionEffect> {
        let DescriptionStatement {
            stamp, may_lead, ..
        } = statement;
        let is_leader = self.leader == Leader::Other(from.clone());
        if stamp.version > self.highest_plausible() && !is_leader {
            return vec![DescriptionEffect::CountImplausible { from: from.clone() }];
        }
        if self.statements.len() < MAX_NODES || self.statements.contains_key(from) {
            self.statements.insert(from.clone(), statement);
        }
        if may_lead && stamp > self.stamp() {
            self.adopt_proven(now);
        }
        self.finish(now)
    }

    /// Processes a body received from a broker; `description.hash` must be the hash of its content.
    pub fn on_description(
        &mut self,
        description: Arc<CellDescription>,
        now: Timestamp,
    ) -> Vec<DescriptionEffect> {
        let stamp = description.stamp();
        if stamp < self.stamp() {
            // This body may have replaced the right one at the broker.
            self.is_due = true;
        } else if stamp > self.stamp() {
            self.is_due = true;
            self.unproven.retain(|body| body.stamp() != stamp);
            self.unproven.push_back(description);
            while self.unproven.len() > MAX_UNPROVEN {
                self.unproven.pop_front();
            }
            self.adopt_proven(now);
        }
        self.finish(now)
    }

    /// Sets the cell's description at this node, which may lead. Does not change the state if the
    /// content equals the current description.
    pub fn set(
        &mut self,
        text: String,
        hash: ContentHash,
        now: Timestamp,
    ) -> Vec<DescriptionEffect> {
        if !self.may_lead || self.current().is_some_and(|current| current.text == text) {
            return Vec::new();
        }
        let description = self.described(self.next_version(), hash, text);
        self.adopt(
            AttributedDescription {
                description: Arc::clone(&description),
                authors: Vec::new(),
            },
            self.name.clone(),
        );
        self.publish(description, now);
        self.finish(now)
    }

    /// Drops the descriptions and statements of nodes whose certificates were revoked. A node that
    /// may lead goes back to the latest other description, or to an empty text whose hash is
    /// `empty`. The description gets a new version, so that nodes that have not read the revocation
    /// list accept it too.
    pub fn revoke(
        &mut self,
        is_revoked: impl Fn(&str) -> bool,
        empty: ContentHash,
        now: Timestamp,
    ) -> Vec<DescriptionEffect> {
        let version = self.next_version();
        self.statements
            .retain(|_, statement| !statement.certificate.as_deref().is_some_and(&is_revoked));
        // Descriptions of revoked nodes must not delay the right one.
        self.adopted.clear();
        if self.may_lead && self.history.drop_revoked(is_revoked) {
            let before = self.history.current.take().map_or_else(
                || AttributedDescription {
                    description: self.described(version, empty, String::new()),
                    authors: Vec::new(),
                },
                |AttributedDescription {
                     description,
                     authors,
                 }| {
                    let description = CellDescription {
                        version,
                        ..CellDescription::clone(&description)
                    }
                    .into();
                    AttributedDescription {
                        description,
                        authors,
                    }
                },
            );
            self.is_due = true;
            self.adopt(before, self.name.clone());
        }
        self.finish(now)
    }

    fn described(&self, version: u64, hash: ContentHash, text: String) -> Arc<CellDescription> {
        CellDescription {
            schema: SCHEMA_VERSION,
            version,
            hash,
            set_by: self.name.clone(),
            text,
        }
        .into()
    }

    /// The version of a change made at this node. Nodes that have this node's description must be
    /// able to accept it, independent of statements of other nodes.
    fn next_version(&self) -> u64 {
        let of_candidates = self
            .statements
            .values()
            .filter(|statement| statement.may_lead);
        let known = of_candidates
            .map(|statement| statement.stamp.version)
            .max()
            .unwrap_or(0);
        known
            .max(self.stamp().version)
            .saturating_add(1)
            .min(self.highest_plausible())
    }

    /// Sets the current leader.
    pub fn lead(&mut self, leader: Option<&NodeName>, now: Timestamp) -> Vec<DescriptionEffect> {
        let leader = match leader {
            None => Leader::Unknown,
            Some(leader) if *leader == self.name => Leader::Myself,
            Some(leader) => Leader::Other(leader.clone()),
        };
        if leader != self.leader {
            self.leader = leader;
            self.is_due = true;
            self.published = None;
        }
        self.finish(now)
    }

    /// Records a new connection to a broker, which may lack the description.
    pub fn connect(&mut self, now: Timestamp) -> Vec<DescriptionEffect> {
        self.is_due = true;
        self.finish(now)
    }

    /// Drops the statements of nodes that have left.
    pub fn retain(&mut self, is_member: impl Fn(&NodeName) -> bool) {
        self.statements.retain(|node, _| is_member(node));
    }

    /// Repeats publications for nodes that still lack the description, and adopts descriptions that
    /// had to wait.
    pub fn tick(&mut self, now: Timestamp) -> Vec<DescriptionEffect> {
        self.adopt_proven(now);
        self.finish(now)
    }

    /// Highest version that may plausibly follow the current one. The leader's own statement is
    /// accepted beyond it, so that a node that starts late or was away gets the cell's description.
    fn highest_plausible(&self) -> u64 {
        let known = self.stamp().version;
        let highest = if known == 0 {
            MAX_FIRST_VERSION
        } else {
            known.saturating_add(MAX_VERSION_STEP)
        };
        highest.min(MAX_INTEGER)
    }

    /// Adopts the greatest body that enough candidates state, unless too many were adopted
    /// recently.
    fn adopt_proven(&mut self, now: Timestamp) {
        let authors = |stamp: DescriptionStamp| {
            self.statements
                .iter()
                .filter(move |(_, statement)| statement.may_lead && statement.stamp == stamp)
        };
        let newer = self
            .unproven
            .iter()
            .filter(|body| body.stamp() > self.stamp());
        let proven = newer.filter_map(|body| {
            Some((
                Arc::clone(body),
                self.witness(&authors(body.stamp()))?.clone(),
            ))
        });
        let Some((description, node)) = proven.max_by_key(|(body, _)| body.stamp()) else {
            return;
        };
        let certificates =
            authors(description.stamp()).filter_map(|(_, statement)| statement.certificate.clone());
        let mut authors: Vec<_> = certificates.take(MAX_AUTHORS + 1).collect();
        if authors.len() > MAX_AUTHORS {
            authors.clear();
        }
        let is_throttled =
            |first: &Timestamp| now.since(*first) < ADOPTION_INTERVAL * MAX_ADOPTIONS as u32;
        if self.adopted.len() == MAX_ADOPTIONS {
            if self.adopted.front().is_some_and(is_throttled) {
                return;
            }
            self.adopted.pop_front();
        }
        self.adopted.push_back(now);
        self.adopt(
            AttributedDescription {
                description,
                authors,
            },
            node,
        );
    }

    /// The node whose statement justifies adopting a description: an operator's node that states
    /// it, or the leader if this node has no description yet, or any node if at least
    /// [`MIN_WITNESSES`] state it.
    fn witness<'a>(
        &self,
        authors: &(impl Iterator<Item = (&'a NodeName, &'a DescriptionStatement)> + Clone),
    ) -> Option<&'a NodeName> {
        let is_leader = |author: &NodeName| self.leader == Leader::Other(author.clone());
        let has_none = self.current().is_none();
        let entitled = authors
            .clone()
            .find(|(author, statement)| statement.may_describe || has_none && is_leader(author));
        let many = || {
            authors
                .clone()
                .nth(MIN_WITNESSES - 1)
                .and_then(|_| authors.clone().next())
        };
        entitled.or_else(many).map(|(author, _)| author)
    }

    /// Replaces the current description, drops bodies that it supersedes, and pushes the effect
    /// that saves and applies it. `stated_by` is this node for a description that was set here.
    fn adopt(&mut self, next: AttributedDescription, stated_by: NodeName) {
        let description = Arc::clone(&next.description);
        let stamp = next.description.stamp();
        self.history.replace(next);
        self.unproven.retain(|body| body.stamp() > stamp);
        self.published = None;
        self.effects.push(DescriptionEffect::Adopt {
            description,
            stated_by,
        });
    }

    /// Publishes a description and records the time, so that the next repetition waits longer.
    fn publish(&mut self, description: Arc<CellDescription>, now: Timestamp) {
        self.is_due = false;
        self.published = Some((now, self.published.map_or(0, |(_, times)| times) + 1));
        self.effects
            .push(DescriptionEffect::Publish { description });
    }

    /// Publishes a description that other nodes lack: the leader publishes to all, another
    /// candidate to a leader that is behind.
    fn finish(&mut self, now: Timestamp) -> Vec<DescriptionEffect> {
        if let Some(description) = self.current().cloned()
            && self.may_lead
            && self.is_lacking(description.stamp())
            && self
                .published
                .is_none_or(|(at, times)| now.since(at) >= interval_after(times))
        {
            self.publish(description, now);
        }
        std::mem::take(&mut self.effects)
    }

    /// True if a node that this node serves lacks the description: for a leader any node, for
    /// another candidate the leader.
    fn is_lacking(&self, stamp: DescriptionStamp) -> bool {
        let is_behind = |statement: &DescriptionStatement| statement.stamp < stamp;
        match &self.leader {
            Leader::Unknown => false,
            Leader::Myself => self.is_due || self.statements.values().any(is_behind),
            Leader::Other(leader) => self.statements.get(leader).is_some_and(is_behind),
        }
    }
}

/// Time from a publication to the next, by its number.
fn interval_after(times: u32) -> Duration {
    PUBLISH_INTERVAL * (1 << times.saturating_sub(1).min(MAX_DOUBLINGS))
}

#[cfg(test)]
mod tests;
