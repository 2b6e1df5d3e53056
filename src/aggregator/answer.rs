//! One answer for each place where PACE and VOTE both run.
//!
//! PACE decides whether there is an object, because only PACE counts misses. VOTE decides which
//! label it has, because only VOTE weighs vehicles by reputation. VOTE's label is used even after a
//! narrow vote, unless PACE has determined that the place is empty. Both use the same frames, so
//! they don't add certainty to each other: the confidence of the answer is the lower of the two.

use crate::model::names::Label;
use crate::wire::{LabelReading, LandmarkState, Verdict};

/// Combines the state of a place by PACE with its verdict and with each vehicle's reading there.
/// `sign` is the label of the place's vacancy sign.
pub(super) fn agree(
    mut state: LandmarkState,
    verdict: Option<&Verdict>,
    readings: Vec<LabelReading>,
    sign: Option<&Label>,
) -> LandmarkState {
    let is_known_empty = match &state.label {
        Some(label) => Some(label) == sign,
        None => !state.observers.is_empty(),
    };
    if let Some(Decision { label, share, mass }) =
        verdict.and_then(decision).filter(|_| !is_known_empty)
    {
        match &state.label {
            Some(known) if known == label => state.confidence = state.confidence.min(share),
            known => {
                // Without PACE, a few voters don't give certainty: Laplace's rule of succession for
                // votes that all agree.
                let sure = if known.is_some() {
                    state.confidence
                } else {
                    mass / (mass + 1.0)
                };
                state.confidence = share.min(sure);
                let by = readings.iter().find(|reading| reading.label == *label);
                state.contributors = by.map(|reading| reading.nodes.clone()).unwrap_or_default();
                state.label = Some(label.clone());
            }
        }
    }
    // If all vehicles read the place's label, the list of contributors has the same information.
    let is_unanimous =
        matches!(&readings[..], [reading] if Some(&reading.label) == state.label.as_ref());
    state.readings = if is_unanimous { Vec::new() } else { readings };
    state
}

/// The outcome of a vote.
struct Decision<'a> {
    label: &'a Label,
    /// The label's share of all votes.
    share: f64,
    /// Weight of all votes.
    mass: f64,
}

fn decision(verdict: &Verdict) -> Option<Decision<'_>> {
    let mass: f64 = verdict.votes.values().sum();
    let label = verdict.label.as_ref().filter(|_| mass > 0.0)?;
    let share = (verdict.score / mass).clamp(0.0, 1.0);
    Some(Decision { label, share, mass })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::names::NodeName;

    fn name(name: &'static str) -> NodeName {
        NodeName::from_static(name)
    }

    fn state(label: Option<&str>, confidence: f64, observers: &[&'static str]) -> LandmarkState {
        LandmarkState {
            id: "slot-0".into(),
            label: label.map(Label::new),
            confidence,
            x_m: 0.0,
            y_m: 0.0,
            contributors: Vec::new(),
            observers: observers.iter().map(|node| name(node)).collect(),
            readings: Vec::new(),
        }
    }

    fn verdict(votes: &[(&str, f64)]) -> Verdict {
        let score = votes[0].1;
        let next = votes.get(1).map_or(0.0, |(_, score)| *score);
        Verdict {
            landmark: "slot-0".into(),
            label: Some(votes[0].0.into()),
            score,
            margin: score - next,
            votes: votes
                .iter()
                .map(|(label, score)| (Label::new(label), *score))
                .collect(),
            contributors: Vec::new(),
        }
    }

    fn answer(state: LandmarkState, votes: &[(&str, f64)]) -> (Option<String>, f64) {
        let readings = vec![LabelReading {
            label: "car".into(),
            nodes: vec![name("euclid")],
        }];
        let empty = Label::new("EMPTY");
        let state = agree(state, Some(&verdict(votes)), readings, Some(&empty));
        (
            state.label.map(|label| label.to_string()),
            (state.confidence * 100.0).round() / 100.0,
        )
    }

    #[test]
    fn trust_decides_label_pace_decides_presence() {
        let seen: &[&str] = &["euclid"];
        assert_eq!(
            answer(state(Some("car"), 0.9, seen), &[("car", 1.8), ("van", 0.2)]),
            (Some("car".into()), 0.9)
        );
        assert_eq!(
            answer(state(Some("van"), 0.7, seen), &[("car", 1.9), ("van", 0.1)]).0,
            Some("car".into())
        );
        assert_eq!(
            answer(
                state(Some("van"), 0.7, seen),
                &[("car", 1.05), ("van", 0.95)]
            ),
            (Some("car".into()), 0.53)
        );
        assert_eq!(
            answer(state(None, 0.0, &[]), &[("car", 1.8), ("van", 0.2)]),
            (Some("car".into()), 0.67)
        );
        assert_eq!(
            answer(state(None, 0.0, seen), &[("car", 2.0)]),
            (None, 0.0),
            "seen empty"
        );
        assert_eq!(
            answer(state(Some("EMPTY"), 0.8, seen), &[("car", 2.0)]),
            (Some("EMPTY".into()), 0.8)
        );
    }

    #[test]
    fn confidence_is_lower_of_both() {
        let seen: &[&str] = &["euclid"];
        assert_eq!(
            answer(state(Some("car"), 0.8, seen), &[("car", 1.0)]).1,
            0.8
        );
        assert_eq!(
            answer(
                state(Some("car"), 0.99, seen),
                &[("car", 1.5), ("van", 0.5)]
            )
            .1,
            0.75
        );
        assert_eq!(
            answer(state(Some("van"), 0.6, seen), &[("car", 1.9), ("van", 0.1)]).1,
            0.6
        );
        assert_eq!(
            answer(state(None, 0.0, &[]), &[("car", 1.0)]).1,
            0.5,
            "one voter alone"
        );
    }
}
