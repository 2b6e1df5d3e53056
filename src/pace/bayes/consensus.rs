//! Consensus about one place: the vehicles' log-odds added up, and the weighted mean of their
//! positions.

use nalgebra::{Point2, Vector2};
use smallvec::SmallVec;

use super::belief::Belief;
use crate::model::geometry::Covariance;
use crate::model::names::{Label, NodeName};

/// A vehicle and its belief about one place.
pub(super) type NamedBelief<'a> = (&'a NodeName, &'a Belief);

/// Summed log-odds of the labels at one place.
pub(super) struct LabelScores<'a> {
    labels: SmallVec<[(&'a Label, f64); 4]>,
}

pub(super) struct AgreedLabel<'a> {
    pub(super) label: &'a Label,
    pub(super) posterior: f64,
}

impl<'a> LabelScores<'a> {
    /// Adds the vehicles' evidence about one place: for each label, and against any object.
    pub(super) fn of(beliefs: &[NamedBelief<'a>]) -> Self {
        // A separate pass: its loads, which take most of the time, do not wait for each other.
        let absence: f64 = beliefs
            .iter()
            .map(|(_, belief)| belief.anything.min(0.0))
            .sum();
        let mut labels: SmallVec<[(&'a Label, f64); 4]> = SmallVec::new();
        for (_, belief) in beliefs {
            for evidence in &belief.labels {
                match labels
                    .iter_mut()
                    .find(|(label, _)| **label == evidence.label)
                {
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

    /// The label with the most evidence, or the published one unless it is `switch_lead` behind.
    pub(super) fn winner(
        &self,
        published: Option<&Label>,
        switch_lead: f64,
    ) -> Option<AgreedLabel<'a>> {
        let best = self
            .labels
            .iter()
            .max_by(|a, b| a.1.total_cmp(&b.1).then_with(|| b.0.cmp(a.0)))?;
        let holds = |nats: f64| nats > best.1 - switch_lead && nats > 0.0;
        let kept = self
            .labels
            .iter()
            .find(|(label, nats)| Some(*label) == published && holds(*nats));
        let (label, nats) = kept.unwrap_or(best);
        let total: f64 = self
            .labels
            .iter()
            .map(|(_, nats)| (nats - best.1).exp())
            .sum();
        let posterior = (nats - best.1).exp() / (total + (-best.1).exp());
        (*nats > 0.0).then_some(AgreedLabel { label, posterior })
    }
}

/// Mean of positions weighted by the inverses of their covariances.
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
    /// Adds a position; its errors have the covariance plus an independent standard deviation of
    /// `floor_m`.
    pub(super) fn add(&mut self, position: &Point2<f64>, covariance: &Covariance, floor_m: f64) {
        let Covariance { xx, xy, yy } = *covariance + Covariance::isotropic(floor_m);
        let per_determinant = 1.0 / (xx * yy - xy * xy);
        // The inverse of the covariance.
        let weight_xx = yy * per_determinant;
        let weight_xy = -xy * per_determinant;
        let weight_yy = xx * per_determinant;
        self.xx += weight_xx;
        self.xy += weight_xy;
        self.yy += weight_yy;
        self.sum += Vector2::new(
            weight_xx * position.x + weight_xy * position.y,
            weight_xy * position.x + weight_yy * position.y,
        );
    }

    /// The mean; `None` without positions, or where their covariances are too large for a result.
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
    fn outweighed_label_is_replaced() {
        let car = Label::from("car");
        let van = Label::from("van");
        let winner = |nats_of_car: f64| {
            let scores = LabelScores {
                labels: [(&car, nats_of_car), (&van, 0.3)].into_iter().collect(),
            };
            scores
                .winner(Some(&car), 0.5)
                .map(|winner| winner.label.clone())
        };
        assert_eq!(
            winner(0.1),
            Some(car.clone()),
            "van does not lead by 0.5 nats"
        );
        assert_eq!(winner(-0.1), Some(van.clone()));
    }
}
