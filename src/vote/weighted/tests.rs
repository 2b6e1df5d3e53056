use super::*;

const START: Timestamp = Timestamp(1_700_000_000_000_000);

fn tally(freshness_s: f64) -> WeightedTally {
    WeightedTally::new(WeightedConfig { freshness_s, ..WeightedConfig::default() })
}

fn cast(tally: &mut WeightedTally, landmark: &str, node: &str, ms: u64) {
    let at = START + Duration::from_millis(ms);
    tally.cast(&landmark.into(), &NodeName::new(node).unwrap(), (&"cup".into(), 0.9, 1.0), at);
}

#[test]
fn votes_that_never_go_stale_leave_one_due_time_a_landmark() {
    let mut tally = tally(1e9);
    for n in 0..300 {
        cast(&mut tally, ["x", "y", "z"][n % 3], ["a", "b"][n % 2], 10 * n as u64);
    }
    assert_eq!(tally.expiries.len(), 3);
    tally.forget(&"x".into());
    assert_eq!(tally.expiries.len(), 2);
}

#[test]
fn every_vote_goes_stale_in_its_time() {
    let mut tally = tally(2.0);
    for (node, ms) in [("a", 0), ("b", 1500), ("a", 1000), ("c", 400)] {
        cast(&mut tally, "x", node, ms);
    }
    for (ms, voters) in
        [(2399, &["a", "b", "c"][..]), (2400, &["a", "b"]), (2999, &["a", "b"]), (3000, &["b"]), (3500, &[])]
    {
        tally.close(START + Duration::from_millis(ms));
        let contributors = tally.verdict(&"x".into()).unwrap().contributors;
        assert!(contributors.iter().map(NodeName::as_str).eq(voters.iter().copied()), "{ms} ms: {contributors:?}");
    }
    assert!(tally.expiries.is_empty());
}
