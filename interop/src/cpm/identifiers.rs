//! Numbers of stations and objects, which have names and UUIDs in a cell.

use std::collections::{HashMap, HashSet};
use std::time::{Duration, Instant};

use ecod::admission::report_window::MAX_PARTS;
use ecod::model::names::{NodeName, PART_MARK};
use uuid::Uuid;

/// Prefix of the part of a node's name under which another station's objects are reported, before
/// the station's number.
pub const RECEIVED_PART: &str = "cpm-";

/// True if a node's name belongs to a part that reports the objects of received messages.
pub fn is_received(node: &NodeName) -> bool {
    node.as_str()
        .split_once(PART_MARK)
        .is_some_and(|(_, part)| part.starts_with(RECEIVED_PART))
}

/// Station numbers of the nodes of a cell. Each part of a node, such as its second camera, is a
/// station of its own.
///
/// A number is the first four bytes of the name-based UUID (version 5) of `<cell>/<node>` in the
/// namespace of URLs. It is constant over all runs. If the numbers of two nodes collide, the later
/// node gets the next free number. A node that is silent for a minute loses its number.
#[derive(Debug)]
pub struct StationIds {
    cell: NodeName,
    by_name: HashMap<NodeName, NumberedStation>,
    is_full: bool,
}

#[derive(Debug)]
struct NumberedStation {
    number: u32,
    heard_at: Instant,
}

/// Maximum number of nodes with a number.
const MAX_NUMBERED_NODES: usize = 4096;

/// Silence after which a node has no number.
const NUMBER_RETENTION: Duration = Duration::from_secs(60);

impl StationIds {
    /// Numbers for a cell of this name.
    pub fn new(cell: NodeName) -> Self {
        Self {
            cell,
            by_name: HashMap::new(),
            is_full: false,
        }
    }

    /// The number of an active node; `None` if its vehicle has [`MAX_PARTS`] other parts, or the
    /// cell 4096 other nodes, which is logged once.
    pub fn of(&mut self, node: &NodeName, now: Instant) -> Option<u32> {
        if let Some(known) = self.by_name.get_mut(node) {
            known.heard_at = now;
            return Some(known.number);
        }
        self.by_name.retain(|_, known| is_fresh(known, now));
        let of_vehicle = self
            .by_name
            .keys()
            .filter(|other| other.vehicle() == node.vehicle())
            .count();
        if of_vehicle > MAX_PARTS || self.by_name.len() >= MAX_NUMBERED_NODES {
            if !std::mem::replace(&mut self.is_full, true) {
                log::warn!(
                    "nothing sent of {node}, nor of others like it: {MAX_NUMBERED_NODES} nodes, or {MAX_PARTS} parts of one, have \
                     station numbers"
                );
            }
            return None;
        }
        let name = Uuid::new_v5(
            &Uuid::NAMESPACE_URL,
            format!("{}/{node}", self.cell).as_bytes(),
        );
        let used: HashSet<_> = self.by_name.values().map(|known| known.number).collect();
        let mut number = name.as_fields().0;
        while used.contains(&number) {
            number = number.wrapping_add(1);
        }
        self.by_name.insert(
            node.clone(),
            NumberedStation {
                number,
                heard_at: now,
            },
        );
        Some(number)
    }

    /// True if a recently active node has the number.
    pub fn contains(&self, number: u32, now: Instant) -> bool {
        self.by_name
            .values()
            .any(|known| known.number == number && is_fresh(known, now))
    }
}

fn is_fresh(known: &NumberedStation, now: Instant) -> bool {
    now.saturating_duration_since(known.heard_at) < NUMBER_RETENTION
}

/// Object numbers of a map. An object keeps its number as long as it is on the map.
#[derive(Debug, Default)]
pub struct ObjectIds {
    by_id: HashMap<Uuid, u16>,
}

impl ObjectIds {
    /// Numbers of all objects of a map: the first two bytes of the UUID, or the next free number.
    /// Objects that have left the map lose their numbers.
    pub(super) fn assign(&mut self, objects: &[Uuid]) -> HashMap<Uuid, u16> {
        let present: HashSet<_> = objects.iter().collect();
        self.by_id.retain(|id, _| present.contains(id));
        let mut used: HashSet<_> = self.by_id.values().copied().collect();
        for id in objects.iter().take(usize::from(u16::MAX)) {
            self.by_id.entry(*id).or_insert_with(|| {
                let [first, second, ..] = *id.as_bytes();
                let mut number = u16::from_be_bytes([first, second]);
                while !used.insert(number) {
                    number = number.wrapping_add(1);
                }
                number
            });
        }
        self.by_id.clone()
    }
}
