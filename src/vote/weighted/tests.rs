use super::*;

const START: Timestamp = Timestamp(1_700_000_000_000_000);

fn voting(freshness_s: f64) -> WeightedVoting {
    WeightedVoting::new(WeightedConfig {
        freshness_s,
        ..WeightedConfig::default()
    })
}

fn add_vote(voting: &mut WeightedVoting, landmark: &str, node: &str, ms: u64) {
    voting.add_vote(&NewVote {
        landmark: &landmark.into(),
        node: &NodeName::new(node).unwrap(),
        label: &"cup".into(),
        confidence: 0.9,
        range_bearing: None,
        at: START + Duration::from_millis(ms),
    });
}

#[test]
fn lasting_votes_share_due_time() {
    let mut voting = voting(1e9);
    for n in 0..300 {
        add_vote(
            &mut voting,
            ["x", "y", "z"][n % 3],
            ["a", "b"][n % 2],
            10 * n as u64,
        );
    }
    assert_eq!(voting.expiries.len(), 3);
    voting.remove_landmark(&"x".into());
    assert_eq!(voting.expiries.len(), 2);
}

#[test]
fn votes_expire_on_time() {
    let mut voting = voting(2.0);
    for (node, ms) in [("a", 0), ("b", 1500), ("a", 1000), ("c", 400)] {
        add_vote(&mut voting, "x", node, ms);
    }
    for (ms, voters) in [
        (2399, &["a", "b", "c"][..]),
        (2400, &["a", "b"]),
        (2999, &["a", "b"]),
        (3000, &["b"]),
        (3500, &[]),
    ] {
        voting.close(START + Duration::from_millis(ms));
        let contributors = voting.verdict(&"x".into()).unwrap().contributors;
        assert!(
            contributors
                .iter()
                .map(NodeName::as_str)
                .eq(voters.iter().copied()),
            "{ms} ms: {contributors:?}"
        );
    }
    assert!(voting.expiries.is_empty());
}

#[test]
fn stored_votes_are_counted_by_vehicle() {
    let mut voting = voting(2.0);
    let assert_counted = |voting: &WeightedVoting| {
        let mut stored = vec![0; voting.names.len()];
        for landmark in voting.landmarks.following(None) {
            for vote in &voting.landmarks.votes(landmark).votes {
                stored[vote.vehicle] += 1;
            }
        }
        assert_eq!(voting.stored, stored);
        stored.iter().sum::<usize>()
    };
    for (landmark, node, ms) in [
        ("x", "a", 0),
        ("x", "b", 100),
        ("x", "a", 200),
        ("y", "a", 1000),
        ("z", "c", 1500),
        ("z", "b", 1600),
    ] {
        add_vote(&mut voting, landmark, node, ms);
    }
    assert_eq!(assert_counted(&voting), 5);
    voting.close(START + Duration::from_millis(2150));
    assert_eq!(assert_counted(&voting), 4, "an expired vote");
    voting.remove_landmark(&"y".into());
    assert_eq!(assert_counted(&voting), 3);
    voting.remove_vehicles(&[NodeName::new("c").unwrap()].into());
    assert_eq!(assert_counted(&voting), 2);
    assert_eq!(voting.evict_labels_for(&"mouse".into(), 1), 2);
    assert_eq!(assert_counted(&voting), 0);
}
