//! Evidence of one's own making: who was first in a cell is not the master of its votes.

use std::time::Duration;

use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::vote::{Vote, VoteConfig};
use ecod::wire::{ObjectReport, PerceivedObject, Verdict};

const START: Timestamp = Timestamp(1_700_000_000_000_000);
const PERIOD: Duration = Duration::from_millis(500);
/// Rounds in which the first vehicle is alone and states the truth: 20 s.
const HONEST_ROUNDS: u32 = 40;
/// Rounds between the arrivals of two vehicles: 15 s.
const ARRIVAL: u32 = 30;

/// The true label: nearly all places bear the same one.
fn truth(place: usize, places: usize) -> &'static str {
    if place == places - 1 { "truck" } else { "car" }
}

fn report<'a>(node: &str, round: u32, votes: impl Iterator<Item = (String, &'a str)>) -> (ObjectReport, Timestamp) {
    let at = START + PERIOD * round;
    let object = |(place, label): (String, &str)| PerceivedObject {
        landmark: Some(place.as_str().into()),
        ..PerceivedObject::new(label, 0.8, 0.0, 0.0)
    };
    let node = NodeName::new(node).unwrap();
    (ObjectReport { objects: votes.map(object).collect(), ..ObjectReport::new(node, u64::from(round), at) }, at)
}

/// Percent of right verdicts by number of honest vehicles, from 5 s after the arrival of the last of them; and the vote.
fn run(honest: u32, places: usize) -> (Vec<f64>, Vote) {
    let mut vote = Vote::new(VoteConfig::default(), Vec::new());
    let by_place = |label: fn(usize, usize) -> &'static str| {
        (0..places).map(move |place| (format!("place-{place}"), label(place, places)))
    };
    let mut right = vec![(0, 0); honest as usize + 1];
    for round in 0..HONEST_ROUNDS + ARRIVAL * (honest + 1) {
        let label = if round < HONEST_ROUNDS { truth } else { |_, _| "bus" };
        let (first, at) = report("first", round, by_place(label));
        vote.observe(&first, at).unwrap();
        let since = round.saturating_sub(HONEST_ROUNDS);
        let present = since / ARRIVAL;
        for vehicle in 0..present {
            let (honest, at) = report(&format!("honest-{vehicle}"), round, by_place(truth));
            vote.observe(&honest, at).unwrap();
        }
        vote.close(at);
        if since % ARRIVAL >= 10 {
            let is_right = |verdict: &Verdict| {
                let place: usize = verdict.landmark["place-".len()..].parse().unwrap();
                verdict.label.as_deref() == Some(truth(place, places))
            };
            let (sum, all) = &mut right[present as usize];
            *sum += vote.verdicts().iter().filter(|verdict| is_right(verdict)).count();
            *all += places;
        }
    }
    (right.into_iter().map(|(right, all)| 100.0 * right as f64 / all as f64).collect(), vote)
}

#[test]
fn who_was_first_in_the_cell_is_outvoted_by_newcomers_who_agree() {
    for places in [1, 3, 6, 20] {
        let (right, vote) = run(7, places);
        println!("{places} places: {right:?}");
        assert!(right[2..].iter().all(|percent| *percent == 100.0), "{places} places: {right:?}");
        let reputations = vote.reputations();
        let score = |node: &str| reputations[&NodeName::new(node).unwrap()].score;
        assert!(score("first") < 0.5, "{reputations:?}");
        assert!((0..7).all(|vehicle| score(&format!("honest-{vehicle}")) > 0.7), "{reputations:?}");
    }
}

#[test]
fn invented_places_make_no_vote_settle_earlier() {
    let settled = |invented: u32| {
        let config = VoteConfig { max_landmarks: 8, ..VoteConfig::default() };
        let mut vote = Vote::new(config, Vec::new());
        let mut settled = 0;
        for round in 0..40 {
            for node in ["a", "b", "c"] {
                let (report, at) = report(node, round, ["x", "y"].map(|place| (place.to_owned(), "car")).into_iter());
                vote.observe(&report, at).unwrap();
            }
            let places = (0..invented).map(|n| (format!("invented-{round}-{n}"), "car"));
            let (inventor, at) = report("d", round, places);
            vote.observe(&inventor, at).unwrap();
            settled += vote.close(at).evidence.iter().filter(|vote| vote.node.as_str() != "d").count();
        }
        settled
    };
    let (with, without) = (settled(100), settled(0));
    assert!(without > 0 && with <= without, "{with} {without}");
}
