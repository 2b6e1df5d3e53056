//! Cells whose nodes prove certificates.

use rustls::pki_types::UnixTime;

use super::*;
use crate::transport::gossip::test_authority::TestAuthority;

/// A cell with certificates, and its CA.
struct CertifiedCell {
    cell: Cell,
    authority: TestAuthority,
}

impl CertifiedCell {
    fn new(multicast: bool) -> Self {
        Self {
            cell: Cell::new(multicast),
            authority: TestAuthority::new(),
        }
    }

    fn of(nodes: usize) -> Self {
        let mut certified = Self::new(true);
        (1..=nodes).for_each(|node| certified.start(node));
        certified.cell.run(3000);
        certified
    }

    fn start(&mut self, node: usize) {
        let identity = self.authority.identity(&name(node), Role::Auto);
        let run = self.cell.now.micros();
        self.cell
            .start_as(node, &name(node), KEY, Some(identity), run);
    }

    fn machine(&mut self, node: usize) -> &mut GossipMachine {
        &mut self.cell.nodes.get_mut(&node).unwrap().machine
    }

    /// Gives a node changed files.
    fn set_identity(&mut self, node: usize, identity: Identity) {
        let now = self.cell.now;
        self.machine(node).set_identity(identity, now);
        self.cell.deliver();
    }

    fn events(&self, node: usize) -> &[MembershipEvent] {
        &self.cell.nodes[&node].events
    }
}

#[test]
fn nodes_with_certificates_join() {
    let mut certified = CertifiedCell::of(6);
    certified.cell.assert_complete();
    certified.cell.nodes.remove(&3);
    certified.cell.run(1500);
    certified.cell.assert_complete();
    certified.start(3);
    certified.cell.run(3000);
    certified.cell.assert_complete();
}

#[test]
fn certified_node_is_reached_after_move() {
    a_node_moves(CertifiedCell::of(3).cell);
}

#[test]
fn certified_namesake_of_seed_gives_up() {
    let mut certified = CertifiedCell::new(false);
    certified.start(1);
    certified.cell.run(8000);
    let identity = certified.authority.identity(&name(1), Role::Auto);
    let run = certified.cell.now.micros();
    certified
        .cell
        .start_as(9, &name(1), KEY, Some(identity), run);
    certified.machine(9).set_seeds(vec![address(1)]);
    certified.cell.run(8000);
    assert_second_gave_up(&certified.cell);
}

#[test]
fn certified_nodes_join_by_seed() {
    let mut certified = CertifiedCell::new(false);
    for node in 1..=5 {
        certified.start(node);
        certified.machine(node).set_seeds(vec![address(1)]);
    }
    certified.cell.run(3000);
    certified.cell.assert_complete();
}

#[test]
fn certified_cell_forms_despite_loss() {
    let mut certified = CertifiedCell::new(true);
    certified.cell.loss_percent = 20;
    (1..=4).for_each(|node| certified.start(node));
    certified.cell.run(6000);
    certified.cell.loss_percent = 0;
    certified.cell.run(3000);
    certified.cell.assert_complete();
}

#[test]
fn key_alone_admits_no_node() {
    let mut certified = CertifiedCell::of(3);
    let now = certified.cell.now.micros();
    certified.cell.clear_events();
    certified.cell.start(4, "node-4");
    let strange = TestAuthority::new().identity("node-5", Role::Auto);
    certified
        .cell
        .start_as(5, "node-5", KEY, Some(strange), now);
    certified.cell.run(5000);
    for node in 1..=3 {
        assert_eq!(certified.events(node), [], "{node}");
        let refused = ["node-4", "node-5"].map(|name| (name.to_owned(), TroubleKind::NotAdmitted));
        assert_eq!(
            certified.cell.nodes[&node].troubles,
            refused.into(),
            "{node}"
        );
        let machine = certified.machine(node);
        assert_eq!(machine.members().len(), 2);
        assert!(
            machine.counters.get(FrameEvent::Uncertified) > 0
                && machine.counters.get(FrameEvent::Untrusted) > 0
        );
    }
    assert!(certified.cell.sees(4).is_empty() && certified.cell.sees(5).is_empty());
}

#[test]
fn revoked_node_needs_new_certificate() {
    let mut certified = CertifiedCell::of(4);
    certified.cell.clear_events();
    certified.authority.revoke(&node_name(4));
    for node in 1..=3 {
        let files = certified.authority.files(&node_name(node));
        certified.set_identity(node, TestAuthority::read(&files, &name(node)));
        let gone = [
            MembershipEvent::Expelled { name: node_name(4) },
            MembershipEvent::Down { name: node_name(4) },
        ];
        assert_eq!(certified.events(node), gone, "{node}");
    }
    certified.cell.clear_events();
    certified.cell.run(5000);
    for node in 1..=3 {
        assert_eq!(certified.events(node), [], "{node}");
        assert!(!certified.cell.sees(node).contains("node-4"));
    }
    let renewed = certified.authority.identity("node-4", Role::Auto);
    certified.set_identity(4, renewed);
    certified.cell.run(5000);
    certified.cell.assert_complete();
}

#[test]
fn renewed_certificate_reaches_all() {
    let mut certified = CertifiedCell::of(3);
    certified.cell.clear_events();
    let renewed = certified.authority.identity("node-1", Role::Auto);
    certified.set_identity(1, renewed);
    certified.cell.run(3000);
    assert_eq!(certified.cell.events(), 0);
}

/// A machine that starts in 1970 rejects all certificates, and joins once its clock is set.
#[test]
fn node_with_wrong_clock_waits() {
    let mut certified = CertifiedCell::of(2);
    let right = certified.authority.identity("node-3", Role::Auto);
    let wrong = Identity {
        wall: UnixTime::since_unix_epoch(Duration::from_secs(8)),
        ..right.clone()
    };
    let run = certified.cell.now.micros();
    certified.cell.start_as(3, "node-3", KEY, Some(wrong), run);
    certified.cell.run(3000);
    assert!(certified.cell.sees(3).is_empty());
    certified.set_identity(3, right);
    certified.cell.run(2000);
    certified.cell.assert_complete();
}

#[test]
fn lost_sessions_recover_within_second() {
    let mut certified = CertifiedCell::of(2);
    certified.machine(1).sessions.drop_all();
    for _ in 0..20 {
        for (from, to) in [(1, 2), (2, 1)] {
            let now = certified.cell.now;
            certified.machine(from).send(&node_name(to), b"beat", now);
        }
        certified.cell.run(50);
    }
    certified.cell.clear_events();
    for (from, to) in [(1, 2), (2, 1)] {
        let now = certified.cell.now;
        certified.machine(from).send(&node_name(to), b"beat", now);
    }
    certified.cell.run(10);
    for node in [1, 2] {
        let received = |event: &MembershipEvent| matches!(event, MembershipEvent::Received { .. });
        assert!(
            certified.events(node).iter().any(received),
            "{node}: {:?}",
            certified.events(node)
        );
    }
}

/// A member makes false statements about another: a later life, another address, another role.
#[test]
fn false_statement_overrides_no_node() {
    let mut certified = CertifiedCell::of(3);
    certified.cell.clear_events();
    let before = certified.machine(1).members();
    for life in [u64::MAX, 1 << 53, certified.cell.now.micros() + 1000] {
        let gossip = address(9);
        let broker = Some(address(9));
        let lie = NodeId {
            name: node_name(3),
            run: 7,
            life,
            role: Role::Edge,
            gossip,
            broker,
        };
        let now = certified.cell.now;
        certified.machine(2).spread(foca::Member::alive(lie), now);
        certified.cell.run(2000);
    }
    assert_eq!(certified.machine(1).members(), before);
    let is_news = |event: &MembershipEvent| {
        matches!(
            event,
            MembershipEvent::Alive { .. } | MembershipEvent::Down { .. }
        )
    };
    assert!(
        !certified.events(1).iter().any(is_news),
        "{:?}",
        certified.events(1)
    );
}

/// A member reports repeatedly that another node is down, while that node keeps sending.
#[test]
fn sending_node_stays_alive() {
    let mut certified = CertifiedCell::of(3);
    certified.cell.clear_events();
    for round in 0..60 {
        let own = certified.machine(3).gossip.own().clone();
        let now = certified.cell.now;
        if round % 4 == 0 {
            certified.machine(2).spread(foca::Member::down(own), now);
        }
        certified.machine(3).send(&node_name(1), b"beat", now);
        certified.cell.run(50);
    }
    let is_down = |event: &MembershipEvent| matches!(event, MembershipEvent::Down { .. });
    assert!(
        !certified.events(1).iter().any(is_down),
        "{:?}",
        certified.events(1)
    );
    certified.cell.nodes.remove(&3);
    certified.cell.run(2000);
    assert!(
        !certified.cell.sees(1).contains("node-3"),
        "one that is silent is"
    );
}
