//! Junk, and frames that an attacker recorded and sends again.

use super::*;

/// All frames that were ever sent, again: to their addressee, to all other nodes, and to nodes that
/// have restarted.
#[test]
fn recorded_frames_change_nothing() {
    let mut cell = Cell::of(4);
    let now = cell.now;
    cell.nodes
        .get_mut(&1)
        .unwrap()
        .machine
        .send(&node_name(2), b"payload", now);
    cell.run(100);
    cell.nodes.remove(&4);
    cell.run(2000);
    cell.start(4, "node-4");
    cell.run(3000);
    cell.assert_complete();
    cell.clear_events();
    let recorded = std::mem::take(&mut cell.recorded);
    for (from, _, frame) in &recorded {
        for to in 1..=4 {
            cell.under_way
                .push((cell.now, *from, address(to), frame.clone()));
        }
        if cell.under_way.len() > 40 {
            cell.run(1);
        }
    }
    cell.run(3000);
    cell.assert_complete();
    assert_eq!(
        cell.events(),
        0,
        "{:?}",
        cell.nodes
            .values()
            .map(|node| &node.events)
            .collect::<Vec<_>>()
    );
    for node in cell.nodes.values() {
        assert!(node.machine.counters.get(FrameEvent::Replayed) > 0);
        assert!(node.machine.counters.get(FrameEvent::BadSeal) > 0);
    }
}

/// A recorded cell, replayed to a lone restarted node with the same name and key: no member
/// appears.
#[test]
fn recorded_frames_conjure_up_nobody() {
    let mut old = Cell::of(4);
    old.run(1000);
    let mut cell = Cell::seeded(true, 4);
    cell.now = old.now;
    cell.start(1, "node-1");
    for (from, _, frame) in &old.recorded {
        cell.under_way
            .push((cell.now, *from, address(1), frame.clone()));
        if cell.under_way.len() > 20 {
            cell.run(1);
        }
    }
    cell.run(1000);
    assert_eq!(cell.events(), 0);
    let counters = &cell.nodes[&1].machine.counters;
    let answers = old.recorded.len() as u64;
    assert!(
        counters.get(FrameEvent::BadSeal) > answers / 2,
        "{:?}",
        counters.snapshot()
    );
    assert!(
        (cell.sent as u64) < 256 + answers / 4,
        "{} answers",
        cell.sent
    );
}

#[test]
fn recorded_greetings_are_rate_limited() {
    let mut old = Cell::of(2);
    let (_, _, hello) = old.recorded.remove(0);
    let mut cell = Cell::seeded(true, 4);
    cell.start(1, "node-1");
    for _ in 0..1000 {
        (0..20).for_each(|_| {
            cell.under_way
                .push((cell.now, address(77), address(1), hello.clone()));
        });
        cell.run(1);
    }
    assert!(
        cell.sent < 20 + 10,
        "{} answers to 20,000 greetings",
        cell.sent
    );
    assert!(cell.nodes[&1].machine.counters.get(FrameEvent::Throttled) > 10_000);
    cell.start(2, "node-2");
    cell.run(200);
    assert_eq!(
        cell.sees(1),
        ["node-2".to_owned()].into(),
        "newcomers are met all the same"
    );
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn junk_is_counted_only(
        junk in prop::collection::vec(prop::collection::vec(any::<u8>(), 0..1400), 1..40),
        bent in prop::collection::vec((any::<prop::sample::Index>(), any::<prop::sample::Index>(), 1u8..), 1..40),
    ) {
        let mut cell = Cell::new(true);
        (1..=3).for_each(|node| cell.start(node, &name(node)));
        cell.run(1000);
        cell.clear_events();
        let now = cell.now;
        let node = cell.nodes.get_mut(&1).unwrap();
        let members = node.machine.members();
        for (frame, at, bits) in bent {
            let (from, _, mut frame) = frame.get(&cell.recorded).clone();
            let at = at.index(frame.len());
            frame[at] ^= bits;
            node.machine.receive(&frame, from, now);
        }
        for bytes in &junk {
            node.machine.receive(bytes, address(2), now);
            let headed = [&cell.recorded[0].2[..32], bytes].concat();
            node.machine.receive(&headed, address(2), now);
        }
        node.machine.tick(now);
        prop_assert_eq!(node.machine.members(), members);
        while let Some(output) = node.machine.poll() {
            // A greeting with a wrong seal may come from a node with another key.
            let is_notice = matches!(output, GossipOutput::Event(MembershipEvent::Troubled { .. }));
            prop_assert!(is_notice || !matches!(output, GossipOutput::Event(_)), "{:?}", output);
        }
    }
}
