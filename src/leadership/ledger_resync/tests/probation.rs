//! Evidence of leaders that were followed for a moment only.

use super::*;

/// A candidate that starts first receives the claim of `gauss`, and follows it until the leader
/// renews its term.
#[test]
fn claimants_counts_are_dropped() {
    for has_led in [false, true] {
        let mut edge = signing("edge", 7, "edge");
        let mut euclid = signing("other", 8, "gauss");
        edge.lead(7);
        edge.leadership.position = Position::Leading;
        if has_led {
            euclid.lead(3);
            euclid.resync.step_down();
        }
        let forged = sign(vec![share(
            "gauss",
            Some(8),
            vec![slander(8, "gauss", MAX_FIRST_VOTES)],
        )]);
        let mut sent = euclid.merge(&forged[0], 0).unwrap().shares;
        sent.extend(euclid.wait_until(11_000));
        edge.lead(9);
        edge.leadership = Leadership {
            position: Position::Leading,
            ..following(9, "edge")
        };
        euclid.leadership = following(9, "edge");
        let honest = sign(edge.record(9, "euclid"));
        sent.extend(
            honest
                .iter()
                .flat_map(|share| euclid.merge(share, 11_000).unwrap().shares),
        );
        sent.extend(euclid.wait_until(60_000));
        sent.extend(euclid.resync.snapshot(&euclid.ledger));
        edge.receive(&sent);
        assert_eq!(
            (edge.incorrect("gauss"), euclid.incorrect("gauss")),
            (0, 0),
            "has led: {has_led}"
        );
        assert_eq!(euclid.ledger.totals(), edge.ledger.totals());
    }
}

/// The claimant also adds nothing to an earlier leadership of its own that has ended.
#[test]
fn claimant_extends_no_earlier_leadership() {
    let mut euclid = signing("euclid", 5, "gauss");
    euclid.receive(&sign(vec![share(
        "gauss",
        Some(5),
        vec![slander(5, "gauss", 3)],
    )]));
    euclid.wait_until(30_000);
    euclid.leadership = following(7, "edge");
    euclid.wait_until(60_000);
    euclid.leadership = following(8, "gauss");
    euclid
        .merge(
            &sign(vec![share(
                "gauss",
                Some(8),
                vec![slander(5, "gauss", 1000)],
            )])[0],
            60_000,
        )
        .unwrap();
    euclid.leadership = following(9, "edge");
    euclid.wait_until(90_000);
    assert_eq!(
        euclid.incorrect("gauss"),
        3,
        "what it counted when it led stays"
    );
}

/// The edge box returns after some seconds: the evidence counted in the meantime is kept, including
/// on nodes that had dropped it.
#[test]
fn short_leadership_counts_after_handover() {
    let mut edge = signing("edge", 8, "gauss");
    let mut hopper = signing("other", 8, "gauss");
    let mut gauss = signing("gauss", 8, "gauss");
    gauss.lead(8);
    let said = sign(gauss.record(8, "euclid"));
    edge.receive(&said);
    hopper.receive(&said);
    edge.wait_until(4000);
    hopper.wait_until(4000);
    gauss.resync.step_down();
    edge.lead(9);
    edge.leadership = Leadership {
        position: Position::Leading,
        ..following(9, "edge")
    };
    hopper.leadership = following(9, "edge");
    gauss.leadership = following(9, "edge");
    assert_eq!(edge.vehicles(), ["euclid"], "it goes on from there");
    assert_eq!(hopper.vehicles(), ["euclid"]);
    for at_s in (5..=40).step_by(5) {
        let shares = sign(edge.wait_until(at_s * 1000));
        shares
            .iter()
            .for_each(|share| drop(hopper.merge(share, at_s * 1000).unwrap()));
    }
    assert_eq!(hopper.ledger.totals(), gauss.ledger.totals());
}
