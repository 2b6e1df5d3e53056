//! The vehicles' evidence about one place, added up.

use nalgebra::{Point2, Vector2};
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
        let holds = |nats: f64| nats > best.1 - switch_lead && nats > 0.0;
        let kept = self.labels.iter().find(|(label, nats)| Some(*label) == published && holds(*nats));
        let (label, nats) = kept.unwrap_or(best);
        let total: f64 = self.labels.iter().map(|(_, nats)| (nats - best.1).exp()).sum();
        let posterior = (nats - best.1).exp() / (total + (-best.1).exp());
        (*nats > 0.0).then_some(Winner { label, posterior })
    }
}

/// Mean of positions weighted by the inverse of their covariances.
#[derive(Default)]
pub(super) struct WeightedMean {
    /// Sum of the inverse covariances.
    xx: f64,
    xy: f64,
    yy: f64,
    /// Sum of the weighted positions.
    sum: Vector2<f64>,
}

impl WeightedMean {
    /// Takes a position whose errors have the covariance and, beside it, the floor as standard deviation.
    pub(super) fn add(&mut self, position: &Point2<f64>, covariance: &Covariance, floor_m: f64) {
        let Covariance { xx, xy, yy } = *covariance + Covariance::isotropic(floor_m);
        let per_determinant = 1.0 / (xx * yy - xy * xy);
        let (xx, xy, yy) = (yy * per_determinant, -xy * per_determinant, xx * per_determinant);
        self.xx += xx;
        self.xy += xy;
        self.yy += yy;
        self.sum += Vector2::new(xx * position.x + xy * position.y, xy * position.x + yy * position.y);
    }

    /// The mean; `None` without positions, or when their covariances are so large that nothing is known.
    pub(super) fn position(&self) -> Option<Point2<f64>> {
        let Self { xx, xy, yy, sum } = self;
        let determinant = xx * yy - xy * xy;
        let position = Point2::new(yy * sum.x - xy * sum.y, xx * sum.y - xy * sum.x) / determinant;
        (position.x.is_finite() && position.y.is_finite()).then_some(position)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_label_that_is_no_longer_believed_gives_way_to_one_that_is() {
        let (car, van) = (Label::from("car"), Label::from("van"));
        let winner = |nats_of_car: f64| {
            let tally = Tally { labels: [(&car, nats_of_car), (&van, 0.3)].into_iter().collect() };
            tally.winner(Some(&car), 0.5).map(|winner| winner.label.clone())
        };
        assert_eq!(winner(0.1), Some(car.clone()), "van does not lead by 0.5 nats");
        assert_eq!(winner(-0.1), Some(van.clone()));
    }
}
