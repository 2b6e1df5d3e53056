//! The vehicles' evidence about one place, added up.

use std::collections::BTreeMap;

use nalgebra::{Matrix2, Point2, Vector2};
use smallvec::SmallVec;

use super::evidence::{Look, Place, Vehicle};
use crate::geometry::Covariance;
use crate::names::{Label, NodeName};

/// One vehicle's look at a place.
pub(super) type NamedLook<'a> = (&'a NodeName, &'a Look);

/// Buffers that group looks by place in time linear in looks and places; kept from round to round.
#[derive(Debug, Clone, Default)]
pub(super) struct Grouping {
    /// (vehicle, look) by place.
    entries: Vec<(u32, u32)>,
    /// Where the entries of each place end.
    ends: Vec<u32>,
}

/// Looks grouped by place.
pub(super) struct ByPlace<'a> {
    vehicles: Vec<(&'a NodeName, &'a Vehicle)>,
    grouping: &'a Grouping,
}

impl Grouping {
    /// Groups the vehicles' looks for `places` places, keeping the order of vehicles within a place.
    pub(super) fn group<'a>(&'a mut self, vehicles: &'a BTreeMap<NodeName, Vehicle>, places: usize) -> ByPlace<'a> {
        let vehicles: Vec<_> = vehicles.iter().collect();
        self.ends.clear();
        self.ends.resize(places + 1, 0);
        for look in vehicles.iter().flat_map(|(_, vehicle)| vehicle.looks()) {
            self.ends[look.place.index() + 1] += 1;
        }
        for place in 1..self.ends.len() {
            self.ends[place] += self.ends[place - 1];
        }
        self.entries.resize(self.ends[places] as usize, (0, 0));
        // The start of each place serves as its cursor and so becomes its end.
        for (v, (_, vehicle)) in vehicles.iter().enumerate() {
            for (l, look) in vehicle.looks().iter().enumerate() {
                let cursor = &mut self.ends[look.place.index()];
                self.entries[*cursor as usize] = (v as u32, l as u32);
                *cursor += 1;
            }
        }
        ByPlace { vehicles, grouping: self }
    }
}

impl<'a> ByPlace<'a> {
    pub(super) fn at(&self, place: Place) -> impl Iterator<Item = NamedLook<'a>> + Clone + '_ {
        let Grouping { entries, ends } = self.grouping;
        let start = if place.index() == 0 { 0 } else { ends[place.index() - 1] };
        entries[start as usize..ends[place.index()] as usize].iter().map(|&(vehicle, look)| {
            let (node, vehicle) = self.vehicles[vehicle as usize];
            (node, &vehicle.looks()[look as usize])
        })
    }
}

/// Log-odds of the labels at one place.
pub(super) struct Tally<'a> {
    labels: SmallVec<[(&'a Label, f64); 4]>,
}

/// The agreed label.
pub(super) struct Winner<'a> {
    pub(super) label: &'a Label,
    pub(super) posterior: f64,
}

impl<'a> Tally<'a> {
    pub(super) fn of(looks: impl Iterator<Item = NamedLook<'a>>) -> Self {
        let mut labels: SmallVec<[(&'a Label, f64); 4]> = SmallVec::new();
        let mut absence = 0.0;
        for (_, look) in looks {
            absence += look.anything.min(0.0);
            for evidence in &look.labels {
                match labels.iter_mut().find(|(label, _)| **label == evidence.label) {
                    Some((_, nats)) => *nats += evidence.nats,
                    None => labels.push((&evidence.label, evidence.nats)),
                }
            }
        }
        for (_, nats) in &mut labels {
            *nats += absence;
        }
        Self { labels }
    }

    /// The label with the most evidence, or the published one unless it is behind by the lead.
    pub(super) fn winner(&self, published: Option<&Label>, switch_lead: f64) -> Option<Winner<'a>> {
        let best = self.labels.iter().max_by(|a, b| a.1.total_cmp(&b.1).then_with(|| b.0.cmp(a.0)))?;
        let kept = self.labels.iter().find(|(label, nats)| Some(*label) == published && *nats > best.1 - switch_lead);
        let (label, nats) = kept.unwrap_or(best);
        let total: f64 = self.labels.iter().map(|(_, nats)| (nats - best.1).exp()).sum();
        let posterior = (nats - best.1).exp() / (total + (-best.1).exp());
        (*nats > 0.0).then_some(Winner { label, posterior })
    }
}

/// Mean weighted by the inverse covariances, each with the floor added; `None` without positions.
pub(super) fn weighted_mean(
    positions: impl Iterator<Item = (Point2<f64>, Covariance)>,
    floor_m: f64,
) -> Option<Point2<f64>> {
    let floor = Covariance::isotropic(floor_m);
    let (mut information, mut sum) = (Matrix2::zeros(), Vector2::zeros());
    for (position, covariance) in positions {
        let weight = (covariance + floor).matrix().try_inverse()?;
        information += weight;
        sum += weight * position.coords;
    }
    information.try_inverse().map(|covariance| Point2::from(covariance * sum))
}
