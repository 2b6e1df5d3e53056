//! The vehicles' evidence about one place, added up.

use nalgebra::{Matrix2, Point2, Vector2};
use smallvec::SmallVec;

use super::evidence::Look;
use crate::geometry::Covariance;
use crate::names::{Label, NodeName};

/// One vehicle's look at a place.
pub(super) type NamedLook<'a> = (&'a NodeName, &'a Look);

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
    pub(super) fn of(looks: &[NamedLook<'a>]) -> Self {
        // A pass of its own: its loads do not wait for each other, and most of the time goes into them.
        let absence: f64 = looks.iter().map(|(_, look)| look.anything.min(0.0)).sum();
        let mut labels: SmallVec<[(&'a Label, f64); 4]> = SmallVec::new();
        for (_, look) in looks {
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
