//! Links between the cells of a town, which delay maps.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use ecod::model::time::Timestamp;
use ecod::wire::{CellMap, RegionTopic};

use super::LinkConfig;
use super::cell::TownCell;

pub(super) struct TownLinks<'a> {
    config: LinkConfig,
    uniform: &'a mut dyn FnMut() -> f64,
    /// By time and number.
    under_way: BTreeMap<(Timestamp, u64), MapUnderWay>,
    number: u64,
}

/// A map and the number of the receiving cell.
struct MapUnderWay {
    to: usize,
    message: Arc<(RegionTopic, CellMap)>,
}

impl<'a> TownLinks<'a> {
    pub(super) fn new(config: LinkConfig, uniform: &'a mut dyn FnMut() -> f64) -> Self {
        Self {
            config,
            uniform,
            under_way: BTreeMap::new(),
            number: 0,
        }
    }

    /// Sends the newest map of a cell to all others, if it is due.
    pub(super) fn send_from(&mut self, cells: &mut [TownCell], from: usize, now: Timestamp) {
        let period = Duration::from_secs_f64(1.0 / self.config.map_hz);
        let Some(message) = cells[from]
            .due_map(now, period)
            .filter(|_| self.config.is_up)
        else {
            return;
        };
        let message = Arc::new(message);
        for to in (0..cells.len()).filter(|to| *to != from) {
            if (self.uniform)() < self.config.lost {
                continue;
            }
            let copies = if (self.uniform)() < self.config.lost {
                2
            } else {
                1
            };
            for _ in 0..copies {
                let late_s = if (self.uniform)() < self.config.lost {
                    0.5
                } else {
                    0.0
                };
                let queued_s = -self.config.delay_s * (1.0 - (self.uniform)()).ln();
                let takes = Duration::from_secs_f64(self.config.min_delay_s + late_s + queued_s);
                self.number += 1;
                self.under_way.insert(
                    (now + takes, self.number),
                    MapUnderWay {
                        to,
                        message: Arc::clone(&message),
                    },
                );
            }
        }
    }

    /// When the next map arrives.
    pub(super) fn next_at(&self) -> Option<Timestamp> {
        self.under_way.keys().next().map(|(at, _)| *at)
    }

    /// Delivers the next map.
    pub(super) fn deliver(&mut self, cells: &mut [TownCell]) {
        let Some(((at, _), MapUnderWay { to, message })) = self.under_way.pop_first() else {
            return;
        };
        cells[to].receive(&message.0, message.1.clone(), at);
    }
}
