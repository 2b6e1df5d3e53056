use super::DescriptionEffect::{Adopt, CountImplausible, Publish};
use super::*;

fn name(name: &str) -> NodeName {
    NodeName::new(name).unwrap()
}

fn at(ms: u64) -> Timestamp {
    Timestamp(1_000_000_000 + ms * 1000)
}

fn described(version: u64, text: &str) -> Arc<CellDescription> {
    let mut hash = [0; 32];
    hash.iter_mut()
        .zip(text.bytes())
        .for_each(|(hash, byte)| *hash = byte);
    let hash = ContentHash(hash);
    let set_by = name("edge");
    Arc::new(CellDescription {
        schema: SCHEMA_VERSION,
        version,
        hash,
        set_by,
        text: text.into(),
    })
}

fn node(own: &str) -> DescriptionExchange {
    DescriptionExchange::new(name(own), true, DescriptionHistory::default())
}

fn statement(may_lead: bool, stamp: DescriptionStamp) -> DescriptionStatement {
    DescriptionStatement {
        stamp,
        may_lead,
        may_describe: may_lead,
        certificate: None,
    }
}

fn adopts(effects: &[DescriptionEffect]) -> bool {
    effects.iter().any(|effect| matches!(effect, Adopt { .. }))
}

fn publishes(effects: &[DescriptionEffect]) -> bool {
    effects
        .iter()
        .any(|effect| matches!(effect, Publish { .. }))
}

#[test]
fn body_needs_statement_of_candidate() {
    let new = described(1, "new");
    for is_body_first in [true, false] {
        let mut euclid = node("euclid");
        let taken: Vec<_> = if is_body_first {
            assert_eq!(euclid.on_description(Arc::clone(&new), at(0)), []);
            assert_eq!(
                euclid.receive(&name("gauss"), statement(false, new.stamp()), at(1)),
                [],
                "a vehicle that may not lead"
            );
            euclid.receive(&name("edge"), statement(true, new.stamp()), at(2))
        } else {
            assert_eq!(
                euclid.receive(&name("edge"), statement(true, new.stamp()), at(0)),
                []
            );
            assert!(
                !adopts(&euclid.on_description(described(1, "forged"), at(1))),
                "no node stated it"
            );
            euclid.on_description(Arc::clone(&new), at(2))
        };
        assert_eq!(
            taken,
            [Adopt {
                description: Arc::clone(&new),
                stated_by: name("edge")
            }]
        );
        assert_eq!(euclid.stamp(), new.stamp());
    }
}

/// Statement of a node that may lead and is not an operator's.
fn candidates(stamp: DescriptionStamp) -> DescriptionStatement {
    DescriptionStatement {
        may_describe: false,
        ..statement(true, stamp)
    }
}

#[test]
fn one_candidate_changes_no_description() {
    let saved = DescriptionHistory::of(Some(described(1, "right")));
    let mut euclid = DescriptionExchange::new(name("euclid"), true, saved);
    let new = described(2, "new");
    euclid.on_description(Arc::clone(&new), at(0));
    euclid.lead(Some(&name("gauss")), at(1));
    assert!(
        !adopts(&euclid.receive(&name("gauss"), candidates(new.stamp()), at(2))),
        "the leader alone"
    );
    assert!(
        !adopts(&euclid.receive(&name("gauss"), candidates(new.stamp()), at(3))),
        "the same again"
    );
    assert!(
        adopts(&euclid.receive(&name("turing"), candidates(new.stamp()), at(4))),
        "two who have it from its author"
    );
}

#[test]
fn leader_supplies_missing_description() {
    let mut euclid = node("euclid");
    let right = described(6, "right");
    euclid.on_description(Arc::clone(&right), at(0));
    assert!(!adopts(&euclid.receive(
        &name("turing"),
        candidates(right.stamp()),
        at(1)
    )));
    euclid.lead(Some(&name("turing")), at(2));
    assert!(adopts(&euclid.tick(at(3))));
}

#[test]
fn merge_order_does_not_matter() {
    let sides = [
        described(3, "a"),
        described(4, "b"),
        described(4, "c"),
        described(2, "z"),
    ];
    let winner = described(4, "c").stamp();
    for turn in 0..sides.len() {
        let mut euclid = node("euclid");
        for index in 0..sides.len() {
            let side = &sides[(index + turn) % sides.len()];
            euclid.receive(
                &name(&format!("n{index}")),
                statement(true, side.stamp()),
                at(0),
            );
            euclid.on_description(Arc::clone(side), at(0));
        }
        assert_eq!(euclid.stamp(), winner, "turn {turn}");
    }
}

#[test]
fn local_change_is_published() {
    let mut euclid = DescriptionExchange::new(
        name("euclid"),
        true,
        DescriptionHistory::of(Some(described(6, "old"))),
    );
    euclid.receive(
        &name("edge"),
        statement(true, described(8, "unseen").stamp()),
        at(0),
    );
    let effects = euclid.set("new".into(), ContentHash([7; 32]), at(1));
    assert!(
        matches!(&effects[..], [Adopt { .. }, Publish { description }] if description.version == 9)
    );
    assert_eq!(
        euclid.set("new".into(), ContentHash([7; 32]), at(2)),
        [],
        "it is that already"
    );
    let effects = euclid.set("new".into(), ContentHash([8; 32]), at(3));
    assert_eq!(
        effects,
        [],
        "whoever set it: the hash is also of its setter"
    );
    let mut gauss = DescriptionExchange::new(name("gauss"), false, DescriptionHistory::of(None));
    assert_eq!(
        gauss.set("new".into(), ContentHash([7; 32]), at(1)),
        [],
        "it only follows"
    );
}

#[test]
fn version_far_ahead_is_ignored() {
    let mut euclid = DescriptionExchange::new(
        name("euclid"),
        true,
        DescriptionHistory::of(Some(described(6, "old"))),
    );
    let far = described(6 + MAX_VERSION_STEP + 1, "far");
    assert_eq!(
        euclid.receive(&name("edge"), statement(true, far.stamp()), at(0)),
        [CountImplausible { from: name("edge") }]
    );
    assert!(!adopts(&euclid.on_description(far, at(0))));
    euclid.set("new".into(), ContentHash([7; 32]), at(1));
    assert_eq!(euclid.stamp().version, 7);
    let first = DescriptionStamp {
        version: MAX_FIRST_VERSION + 1,
        ..Default::default()
    };
    assert_eq!(
        node("gauss").receive(&name("edge"), statement(true, first), at(0)),
        [CountImplausible { from: name("edge") }]
    );
}

#[test]
fn settable_version_suits_all() {
    let held = described(6, "old");
    let [mut euclid, mut gauss] = ["euclid", "gauss"].map(|own| {
        DescriptionExchange::new(
            name(own),
            true,
            DescriptionHistory::of(Some(Arc::clone(&held))),
        )
    });
    let boast = DescriptionStamp {
        version: 6 + MAX_VERSION_STEP,
        hash: ContentHash::default(),
    };
    euclid.receive(&name("liar"), statement(true, boast), at(0));
    euclid.set("new".into(), ContentHash([7; 32]), at(1));
    let set = Arc::clone(euclid.current().unwrap());
    gauss.receive(&name("euclid"), statement(true, set.stamp()), at(2));
    assert!(adopts(&gauss.on_description(set, at(3))));
}

#[test]
fn absent_node_adopts_leaders_version() {
    let far = described(6 + 3 * MAX_VERSION_STEP, "far");
    let mut euclid = DescriptionExchange::new(
        name("euclid"),
        true,
        DescriptionHistory::of(Some(described(6, "old"))),
    );
    euclid.lead(Some(&name("edge")), at(0));
    assert!(!adopts(&euclid.receive(
        &name("gauss"),
        statement(true, far.stamp()),
        at(1)
    )));
    euclid.receive(&name("edge"), statement(true, far.stamp()), at(2));
    assert!(adopts(&euclid.on_description(far, at(3))));
}

#[test]
fn adoptions_are_limited_per_second() {
    let mut euclid = node("euclid");
    let mut adopted = 0;
    for version in 1..=100 {
        let new = described(version, "new");
        let now = at(version * 10);
        euclid.receive(&name("liar"), statement(true, new.stamp()), now);
        adopted += u32::from(adopts(&euclid.on_description(new, now)));
    }
    assert_eq!(adopted, 8, "in a second");
    assert!(adopts(&euclid.tick(at(20_000))));
    assert_eq!(euclid.stamp().version, 100);
}

#[test]
fn leader_repeats_only_while_needed() {
    let held = described(3, "held");
    let mut edge = DescriptionExchange::new(
        name("edge"),
        true,
        DescriptionHistory::of(Some(Arc::clone(&held))),
    );
    assert!(
        publishes(&edge.lead(Some(&name("edge")), at(0))),
        "its brokers may not have it"
    );
    assert!(!publishes(&edge.tick(at(1500))));
    assert!(publishes(&edge.receive(
        &name("euclid"),
        statement(false, DescriptionStamp::default()),
        at(1600)
    )));
    assert!(!publishes(&edge.tick(at(3500))), "not that often");
    assert!(publishes(&edge.tick(at(3600))));
    edge.receive(&name("euclid"), statement(false, held.stamp()), at(3700));
    assert!(!publishes(&edge.tick(at(9000))));
    assert!(
        publishes(&edge.on_description(described(2, "displaced"), at(9100))),
        "an earlier one took its place"
    );
}

#[test]
fn outdated_node_costs_little() {
    let mut edge = DescriptionExchange::new(
        name("edge"),
        true,
        DescriptionHistory::of(Some(described(3, "held"))),
    );
    edge.lead(Some(&name("edge")), at(0));
    let is_repeated = |ms: &u64| {
        publishes(&edge.receive(
            &name("liar"),
            statement(false, DescriptionStamp::default()),
            at(*ms),
        ))
    };
    let times = (0..600_000).step_by(500).filter(is_repeated).count();
    assert!((15..=25).contains(&times), "{times} in ten minutes");
    edge.set("new".into(), ContentHash([7; 32]), at(600_000));
    assert!(
        publishes(&edge.tick(at(601_000))),
        "a new one is repeated soon"
    );
}

#[test]
fn candidate_informs_outdated_leader() {
    let held = described(3, "held");
    let mut euclid = DescriptionExchange::new(
        name("euclid"),
        true,
        DescriptionHistory::of(Some(Arc::clone(&held))),
    );
    assert!(
        !publishes(&euclid.lead(Some(&name("edge")), at(0))),
        "the leader has not stated its version"
    );
    assert!(publishes(&euclid.receive(
        &name("edge"),
        statement(true, DescriptionStamp::default()),
        at(100)
    )));
    euclid.receive(&name("edge"), statement(true, held.stamp()), at(200));
    euclid.receive(
        &name("gauss"),
        statement(false, DescriptionStamp::default()),
        at(300),
    );
    assert!(
        !publishes(&euclid.tick(at(5000))),
        "the rest is the leader's"
    );
    let mut gauss =
        DescriptionExchange::new(name("gauss"), false, DescriptionHistory::of(Some(held)));
    gauss.lead(Some(&name("edge")), at(0));
    assert!(
        !publishes(&gauss.receive(
            &name("edge"),
            statement(true, DescriptionStamp::default()),
            at(100)
        )),
        "it does not publish"
    );
}

#[test]
fn unstated_bodies_are_bounded() {
    let mut euclid = node("euclid");
    let stated = described(1, "stated");
    euclid.on_description(Arc::clone(&stated), at(0));
    (2..100).for_each(|version| drop(euclid.on_description(described(version, "junk"), at(0))));
    assert_eq!(euclid.unproven.len(), MAX_UNPROVEN);
    euclid.receive(&name("edge"), statement(true, stated.stamp()), at(1));
    assert!(
        adopts(&euclid.on_description(stated, at(2))),
        "the leader repeats it"
    );
}

/// Statement of a node with this certificate.
fn certified(certificate: &str, stamp: DescriptionStamp) -> DescriptionStatement {
    DescriptionStatement {
        certificate: Some(certificate.into()),
        ..statement(true, stamp)
    }
}

const EMPTY: ContentHash = ContentHash([0xee; 32]);

#[test]
fn revoked_certificate_removes_its_description() {
    let right = described(6, "right");
    let mut edge = DescriptionExchange::new(
        name("edge"),
        true,
        DescriptionHistory::of(Some(Arc::clone(&right))),
    );
    let mut gauss =
        DescriptionExchange::new(name("gauss"), false, DescriptionHistory::of(Some(right)));
    edge.lead(Some(&name("edge")), at(0));
    // It sets one after the other, in the name of the edge. A vehicle has them from the edge.
    for (version, text) in [(7, "false"), (8, "worse")] {
        let forged = described(version, text);
        edge.receive(
            &name("turing"),
            certified("turing's", forged.stamp()),
            at(version),
        );
        assert!(adopts(
            &edge.on_description(Arc::clone(&forged), at(version))
        ));
        gauss.receive(
            &name("edge"),
            certified("edge's", forged.stamp()),
            at(version),
        );
        assert!(adopts(&gauss.on_description(forged, at(version))));
    }
    assert_eq!(
        edge.revoke(|certificate| certificate == "euclid's", EMPTY, at(100)),
        [],
        "another's"
    );
    // Saved descriptions count after a restart.
    let saved = serde_json::to_string(edge.history()).unwrap();
    assert_eq!(
        serde_json::from_str::<CellDescription>(&saved).unwrap(),
        **edge.current().unwrap()
    );
    edge = DescriptionExchange::new(name("edge"), true, serde_json::from_str(&saved).unwrap());
    edge.lead(Some(&name("edge")), at(200));
    let effects = edge.revoke(|certificate| certificate == "turing's", EMPTY, at(300));
    assert!(adopts(&effects) && publishes(&effects), "{effects:?}");
    let restored = Arc::clone(edge.current().unwrap());
    assert_eq!((restored.version, &*restored.text), (9, "right"));
    gauss.receive(
        &name("edge"),
        certified("edge's", restored.stamp()),
        at(300),
    );
    assert!(
        adopts(&gauss.on_description(restored, at(300))),
        "also by nodes that have not read the list"
    );
    assert_eq!(
        edge.revoke(|certificate| certificate == "turing's", EMPTY, at(400)),
        [],
        "once"
    );
}

#[test]
fn burst_does_not_delay_recovery() {
    let mut gauss = DescriptionExchange::new(name("gauss"), false, DescriptionHistory::of(None));
    for version in 1..=MAX_ADOPTIONS as u64 {
        let forged = described(version, "false");
        gauss.receive(
            &name("edge"),
            certified("edge's", forged.stamp()),
            at(version),
        );
        assert!(adopts(&gauss.on_description(forged, at(version))));
    }
    gauss.revoke(|certificate| certificate == "turing's", EMPTY, at(100));
    let right = described(MAX_ADOPTIONS as u64 + 1, "right");
    gauss.receive(&name("edge"), certified("edge's", right.stamp()), at(101));
    assert!(adopts(&gauss.on_description(right, at(101))));
}

#[test]
fn node_settings_are_restored() {
    let mut edge = node("edge");
    let forged = described(7, "false");
    edge.receive(
        &name("turing"),
        certified("turing's", forged.stamp()),
        at(0),
    );
    edge.on_description(Arc::clone(&forged), at(0));
    // A statement that was in transit.
    let late = described(8, "late");
    edge.receive(&name("turing"), certified("turing's", late.stamp()), at(1));
    assert!(adopts(&edge.revoke(
        |certificate| certificate == "turing's",
        EMPTY,
        at(2)
    )));
    assert!(
        !adopts(&edge.on_description(late, at(3))),
        "no node states it now"
    );
    let empty = edge.current().unwrap();
    assert_eq!(
        (
            empty.version,
            &*empty.text,
            empty.hash,
            empty.set_by.as_str()
        ),
        (9, "", EMPTY, "edge")
    );
}

#[test]
fn one_certificate_displaces_no_predecessor() {
    let mut edge = DescriptionExchange::new(
        name("edge"),
        true,
        DescriptionHistory::of(Some(described(1, "right"))),
    );
    for version in 2..40 {
        let liar = if version % 2 == 0 { "turing" } else { "euclid" };
        let forged = described(version, "false");
        edge.receive(
            &name(liar),
            certified(liar, forged.stamp()),
            at(version * 10_000),
        );
        assert!(adopts(&edge.on_description(forged, at(version * 10_000))));
    }
    assert!(adopts(&edge.revoke(|_| true, EMPTY, at(500_000))));
    assert_eq!(edge.current().unwrap().text, "right");
}

/// A node that starts late receives statements of all candidates, so a single revoked candidate
/// does not make it go back.
#[test]
fn revoking_one_relay_keeps_description() {
    let right = described(6, "right");
    let mut late = node("gauss");
    for candidate in ["alpha", "edge", "turing"] {
        late.receive(&name(candidate), certified(candidate, right.stamp()), at(0));
    }
    assert!(adopts(&late.on_description(Arc::clone(&right), at(1))));
    assert_eq!(
        late.revoke(|certificate| certificate == "alpha", EMPTY, at(100)),
        []
    );
    assert_eq!(late.current(), Some(&right));
    assert!(
        adopts(&late.revoke(|_| true, EMPTY, at(200))),
        "all who may have made it"
    );
}
