use super::message::MAX_ROUND_STEP;
use super::*;
use crate::wire::Role;

const NOW: Timestamp = Timestamp(1_000_000);

fn euclid() -> Election {
    let mut election = Election::new(ElectionConfig::default(), NodeName::from_static("euclid"), 7, NOW);
    let health = Health { broker: true, fuser: true, gateway: true, load_percent: 0 };
    election.handle(ElectionInput::Health { health }, NOW);
    election
}

/// The `seq`-th message of edge, the leader of term 8.
fn of_edge(seq: u64, term: u64, body: Body) -> ElectionInput {
    let message = ElectionMessage {
        schema: SCHEMA_VERSION,
        from: NodeName::from_static("edge"),
        run: 1,
        seq,
        candidacy: Candidacy { role: Role::Edge, priority: 0, load: 0, fit: true },
        term,
        epoch: Some(epoch_of_edge()),
        hears_you: true,
        body,
    };
    ElectionInput::Receive { message }
}

fn epoch_of_edge() -> Epoch {
    Epoch::new(8, NodeName::from_static("edge"))
}

fn beat(round: u64) -> Body {
    let successors = vec![NodeName::from_static("euclid")];
    Body::Beat { every_ms: 50, round, followers: 1, after: None, successors }
}

fn is_counted(effects: &[ElectionEffect]) -> bool {
    effects.contains(&ElectionEffect::CountImplausible { from: NodeName::from_static("edge") })
}

#[test]
fn a_forged_term_neither_ends_elections_nor_hides_those_of_the_cell() {
    let mut election = euclid();
    let mut hear = |seq, term| {
        let effects = election.handle(of_edge(seq, term, Body::Status { over: None }), NOW);
        let forged = Epoch::new(term, NodeName::from_static("edge"));
        election.handle(ElectionInput::Round { epoch: forged, round: 1 }, NOW);
        (election.term(), is_counted(&effects))
    };
    let cell = 5000;
    assert_eq!(hear(1, cell), (cell, false), "a node that joins learns the cell's term");
    assert_eq!(hear(2, MAX_TERM), (cell, true));
    assert_eq!(hear(3, cell + MAX_TERM_STEP + 1), (cell, true));
    assert_eq!(hear(4, cell + 1), (cell + 1, false));
}

/// First round of euclid's own leadership after the leader's beats with these rounds, and the beats that were counted.
fn succeeded_after(rounds: &[u64]) -> (u64, usize) {
    let mut election = euclid();
    let beats = (1..).zip(rounds).map(|(seq, round)| of_edge(seq, 8, beat(*round)));
    let counted = beats.filter(|beat| is_counted(&election.handle(beat.clone(), NOW))).count();
    let gone = ElectionInput::PeerGone { peer: NodeName::from_static("edge") };
    let first_round = election.handle(gone, NOW).into_iter().find_map(|effect| match effect {
        ElectionEffect::Lead { first_round, .. } => Some(first_round),
        _ => None,
    });
    (first_round.unwrap(), counted)
}

#[test]
fn a_forged_round_does_not_move_the_first_round_of_the_next_leader() {
    assert_eq!(succeeded_after(&[88]), (89, 0));
    assert_eq!(succeeded_after(&[88, 88 + MAX_ROUND_STEP + 1]), (89, 1));
    assert_eq!(succeeded_after(&[3 * MAX_ROUND_STEP]), (3 * MAX_ROUND_STEP + 1, 0), "a node that joins an old cell");
    assert_eq!(succeeded_after(&[MAX_ROUND]), (1, 0), "rounds begin anew rather than beyond what receivers take");
}
