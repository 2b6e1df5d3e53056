use std::time::Duration;

use super::message::{MAX_FIRST_TERM, MAX_ROUND_STEP};
use super::peers::MAX_SEQ_STEP;
use super::*;
use crate::wire::Role;

const NOW: Timestamp = Timestamp(1_000_000);

fn euclid() -> Election {
    euclid_after(7)
}

/// A fit node that finds this term on its disk.
fn euclid_after(saved_term: u64) -> Election {
    let mut election = Election::new(
        ElectionConfig::default(),
        NodeName::from_static("euclid"),
        saved_term,
        NOW,
    );
    let health = Health {
        broker: true,
        fuser: true,
        gateway: true,
        reports: true,
        settings: true,
        load_percent: 0,
    };
    election.handle(ElectionInput::Health { health }, NOW);
    election
}

/// A message of a node that follows or leads `epoch` and receives this node's messages.
fn message(from: &NodeName, seq: u64, epoch: Option<&Epoch>, body: Body) -> ElectionMessage {
    ElectionMessage {
        schema: SCHEMA_VERSION,
        from: from.clone(),
        run: 1,
        seq,
        candidacy: Candidacy {
            role: Role::Auto,
            priority: 100,
            load: 0,
            fit: true,
        },
        term: epoch.map_or(0, |epoch| epoch.term),
        epoch: epoch.cloned(),
        hears_you: true,
        body,
        clock: None,
        description: None,
    }
}

fn received(from: &NodeName, seq: u64, epoch: Option<&Epoch>, body: Body) -> ElectionInput {
    ElectionInput::Receive {
        message: message(from, seq, epoch, body),
    }
}

fn beat_after(after: Option<&Epoch>) -> Body {
    Body::Beat {
        every_ms: 50,
        round: 1,
        followers: 1,
        after: after.cloned(),
        successors: Vec::new(),
        life: LifeSign::default(),
    }
}

/// A message of edge, the leader of term 8, stating `term`.
fn of_edge(seq: u64, term: u64, body: Body) -> ElectionInput {
    let message = message(
        &NodeName::from_static("edge"),
        seq,
        Some(&epoch_of_edge()),
        body,
    );
    ElectionInput::Receive {
        message: ElectionMessage { term, ..message },
    }
}

fn epoch_of_edge() -> Epoch {
    Epoch::new(8, NodeName::from_static("edge"))
}

fn beat(round: u64) -> Body {
    let successors = vec![NodeName::from_static("euclid")];
    Body::Beat {
        every_ms: 50,
        round,
        followers: 1,
        after: None,
        successors,
        life: LifeSign::default(),
    }
}

fn is_counted(effects: &[ElectionEffect]) -> bool {
    effects.contains(&ElectionEffect::CountImplausible {
        from: NodeName::from_static("edge"),
    })
}

#[test]
fn forged_term_blocks_no_election() {
    let mut election = euclid();
    let mut receive = |seq, term| {
        let effects = election.handle(
            of_edge(
                seq,
                term,
                Body::Status {
                    over: None,
                    no_login: Vec::new(),
                },
            ),
            NOW,
        );
        let forged = Epoch::new(term, NodeName::from_static("edge"));
        election.handle(
            ElectionInput::Round {
                epoch: forged,
                round: 1,
            },
            NOW,
        );
        (election.term(), is_counted(&effects))
    };
    let cell = 5000;
    assert_eq!(
        receive(1, cell),
        (cell, false),
        "a node that joins receives the cell's term"
    );
    assert_eq!(receive(2, MAX_TERM), (cell, true));
    assert_eq!(receive(3, cell + MAX_TERM_STEP + 1), (cell, true));
    assert_eq!(receive(4, cell + 1), (cell + 1, false));
}

#[test]
fn forged_sequence_mutes_no_node() {
    let mut election = euclid();
    let receive = |election: &mut Election, seq, term, now| {
        let status = Body::Status {
            over: None,
            no_login: Vec::new(),
        };
        let effects = election.handle(of_edge(seq, term, status), now);
        (election.term(), is_counted(&effects))
    };
    assert_eq!(receive(&mut election, 1, 9, NOW), (9, false));
    for forged in [2 + MAX_SEQ_STEP, (1 << 53) - 1, u64::MAX] {
        assert_eq!(receive(&mut election, forged, 10, NOW), (9, true));
    }
    assert_eq!(
        receive(&mut election, 2, 11, NOW),
        (11, false),
        "the node itself answers"
    );
    let mut now = NOW;
    while now < NOW + Duration::from_secs(10) {
        now = now + Duration::from_millis(50);
        election.tick(now);
    }
    let (_, is_counted) = receive(&mut election, 10 * MAX_SEQ_STEP, 12, now);
    assert!(!is_counted, "a node that was out of reach is far ahead");
}

#[test]
fn node_without_term_joins_any_cell() {
    let mut election = euclid_after(0);
    let old = 1_800_000_000;
    assert!(!is_counted(&election.handle(
        of_edge(
            1,
            old,
            Body::Status {
                over: None,
                no_login: Vec::new()
            }
        ),
        NOW
    )));
    assert!(is_counted(&election.handle(
        of_edge(
            2,
            MAX_FIRST_TERM,
            Body::Status {
                over: None,
                no_login: Vec::new()
            }
        ),
        NOW
    )));
    assert_eq!(election.term(), old);
    assert!(is_counted(&euclid_after(0).handle(
        of_edge(
            1,
            MAX_FIRST_TERM + 1,
            Body::Status {
                over: None,
                no_login: Vec::new()
            }
        ),
        NOW
    )));
}

/// First round of euclid's own leadership after the leader's beats with these rounds, and the
/// number of counted beats.
fn succeeded_after(rounds: &[u64]) -> (u64, usize) {
    let mut election = euclid();
    let beats = (1..)
        .zip(rounds)
        .map(|(seq, round)| of_edge(seq, 8, beat(*round)));
    let counted = beats
        .filter(|beat| is_counted(&election.handle(beat.clone(), NOW)))
        .count();
    let gone = ElectionInput::PeerGone {
        peer: NodeName::from_static("edge"),
    };
    let first_round = election
        .handle(gone, NOW)
        .into_iter()
        .find_map(|effect| match effect {
            ElectionEffect::Lead { first_round, .. } => Some(first_round),
            _ => None,
        });
    (first_round.unwrap(), counted)
}

#[test]
fn forged_round_moves_no_first_round() {
    assert_eq!(succeeded_after(&[88]), (89, 0));
    assert_eq!(succeeded_after(&[88, 88 + MAX_ROUND_STEP + 1]), (89, 1));
    assert_eq!(
        succeeded_after(&[3 * MAX_ROUND_STEP]),
        (3 * MAX_ROUND_STEP + 1, 0),
        "a node that joins an old cell"
    );
    for late in [MAX_ROUND - 1, MAX_ROUND] {
        assert_eq!(
            succeeded_after(&[late]),
            (1, 0),
            "rounds begin anew before receivers take no more"
        );
    }
}

#[test]
fn follower_of_ended_leadership_is_corrected() {
    let [euclid, gauss, hopper] = ["euclid", "gauss", "hopper"].map(NodeName::from_static);
    let mut now = Timestamp(1_000_000);
    let mut election = Election::new(ElectionConfig::default(), euclid, 0, now);
    let health = Health {
        broker: true,
        fuser: true,
        gateway: true,
        reports: true,
        settings: true,
        load_percent: 0,
    };
    election.handle(ElectionInput::Health { health }, now);
    let status = || Body::Status {
        over: None,
        no_login: Vec::new(),
    };
    for seq in 1.. {
        election.handle(received(&hopper, seq, None, status()), now);
        now = election.next_deadline();
        election.tick(now);
        if election.is_leading() {
            break;
        }
    }
    let own = election.epoch().cloned();
    let next = Epoch::new(2, gauss.clone());
    let ElectionInput::Receive { message } =
        received(&gauss, 1, Some(&next), beat_after(own.as_ref()))
    else {
        panic!("no message")
    };
    let candidacy = Candidacy {
        role: Role::Edge,
        ..message.candidacy
    };
    election.handle(
        ElectionInput::Receive {
            message: ElectionMessage {
                candidacy,
                ..message
            },
        },
        now,
    );
    assert_eq!(election.leader(), Some(&gauss));
    let effects = election.handle(received(&hopper, 1000, own.as_ref(), status()), now);
    let is_answer = |effect: &ElectionEffect| matches!(effect, ElectionEffect::Send { to, message } if *to == hopper && message.epoch.as_ref() == Some(&next));
    assert!(effects.iter().any(is_answer), "{effects:?}");
}

#[test]
fn earlier_message_ends_no_leadership() {
    let [edge, gauss] = ["edge", "gauss"].map(NodeName::from_static);
    let before = Epoch::new(1, edge.clone());
    let next = Epoch::new(2, gauss.clone());
    let now = Timestamp(1_000_000);
    let mut election = Election::new(
        ElectionConfig::default(),
        NodeName::from_static("euclid"),
        0,
        now,
    );
    election.handle(received(&edge, 1, Some(&before), beat_after(None)), now);
    election.handle(
        received(
            &edge,
            2,
            Some(&next),
            Body::Status {
                over: None,
                no_login: Vec::new(),
            },
        ),
        now,
    );
    assert_eq!(election.leader(), Some(&gauss));
    election.handle(
        ElectionInput::Round {
            epoch: next,
            round: 2,
        },
        now,
    );
    election.handle(
        received(
            &gauss,
            1,
            Some(&before),
            Body::Status {
                over: None,
                no_login: Vec::new(),
            },
        ),
        now,
    );
    assert_eq!(election.leader(), Some(&gauss));
}

/// A leader stays when another node follows a leader that has not been received.
#[test]
fn unknown_leader_ends_no_leadership() {
    let mut election = euclid();
    let mut now = NOW;
    let hopper = NodeName::from_static("hopper");
    let of_hopper = |seq, epoch: Option<&Epoch>| {
        let message = message(
            &hopper,
            seq,
            epoch,
            Body::Status {
                over: None,
                no_login: Vec::new(),
            },
        );
        let candidacy = Candidacy {
            role: Role::Cav,
            ..message.candidacy
        };
        ElectionInput::Receive {
            message: ElectionMessage {
                candidacy,
                ..message
            },
        }
    };
    for seq in 1.. {
        election.handle(of_hopper(seq, None), now);
        now = election.next_deadline();
        election.tick(now);
        if election.is_leading() {
            break;
        }
    }
    let ghost = Epoch::new(election.term() + 1, NodeName::from_static("ghost"));
    election.handle(of_hopper(1000, Some(&ghost)), now);
    assert!(election.is_leading());
}

/// After a split: the follower now follows the edge, which this leader has not received yet.
/// Leading in a later term would create one more leader to outbid.
#[test]
fn deserted_leader_waits_for_successor() {
    let [edge, gauss] = ["edge", "gauss"].map(NodeName::from_static);
    let mut election = euclid();
    let mut now = NOW;
    while !election.is_leading() {
        now = election.next_deadline();
        election.tick(now);
    }
    let own = election.epoch().cloned().unwrap();
    let status = || Body::Status {
        over: None,
        no_login: Vec::new(),
    };
    election.handle(received(&gauss, 1, Some(&own), status()), now);
    let later = Epoch::new(own.term + 1, edge);
    let end = now + Duration::from_secs(2);
    let mut seq = 1;
    while now < end {
        seq += 1;
        now = now + Duration::from_millis(50);
        election.handle(received(&gauss, seq, Some(&later), status()), now);
        assert_eq!(election.epoch(), Some(&own));
    }
}

/// A leader has no followers yet when it begins. A vehicle that reports another leader at that time
/// does not end the leadership.
#[test]
fn early_contradiction_ends_no_leadership() {
    let [edge, hopper] = ["edge", "hopper"].map(NodeName::from_static);
    let mut election = euclid();
    // A fit candidate that does not lead.
    election.handle(of_edge(1, 8, beat(1)), NOW);
    let resigned = Body::Resign {
        epoch: epoch_of_edge(),
        last_round: 1,
    };
    election.handle(of_edge(2, 8, resigned), NOW);
    let mut now = NOW;
    while !election.is_leading() {
        now = election.next_deadline();
        election.tick(now);
    }
    let false_epoch = Epoch::new(election.term() + 1, edge.clone());
    let send_false_round = |election: &mut Election, seq, now| {
        let message = message(
            &hopper,
            seq,
            Some(&false_epoch),
            Body::Status {
                over: None,
                no_login: Vec::new(),
            },
        );
        let candidacy = Candidacy {
            role: Role::Cav,
            ..message.candidacy
        };
        election.handle(
            ElectionInput::Receive {
                message: ElectionMessage {
                    candidacy,
                    ..message
                },
            },
            now,
        );
    };
    send_false_round(&mut election, 1, now);
    assert!(election.is_leading());
    // A true change of leader is announced by the other leader itself.
    let mut informed = election.clone();
    informed.handle(
        received(
            &edge,
            3,
            Some(&false_epoch),
            beat_after(election.epoch().cloned().as_ref()),
        ),
        now,
    );
    assert_eq!(informed.leader(), Some(&edge));
    let began = now;
    let mut seq = 1;
    while election.is_leading() {
        now = now + Duration::from_millis(50);
        seq += 1;
        assert!(now.since(began) < Duration::from_secs(2), "no node follows");
        election.tick(now);
        send_false_round(&mut election, seq, now);
    }
    assert!(
        now.since(began) > Duration::from_millis(800),
        "{:?}",
        now.since(began)
    );
}

/// Times at which euclid began another term after gauss had refused its first one.
fn renewals(gauss_follows: bool, time: Duration) -> Vec<Timestamp> {
    let gauss = NodeName::from_static("gauss");
    let mut election = euclid();
    let mut now = NOW;
    let mut seq = 0;
    let mut status = |election: &mut Election, epoch: Option<&Epoch>, over: Option<Epoch>, now| {
        seq += 1;
        election.handle(
            received(
                &gauss,
                seq,
                epoch,
                Body::Status {
                    over,
                    no_login: Vec::new(),
                },
            ),
            now,
        );
    };
    while !election.is_leading() {
        status(&mut election, None, None, now);
        now = election.next_deadline();
        election.tick(now);
    }
    let first = election.epoch().cloned();
    status(&mut election, None, first.clone(), now);
    let end = now + time;
    let mut led = Vec::new();
    while now < end {
        now = election.next_deadline();
        for effect in election.tick(now) {
            if let ElectionEffect::Lead { epoch, .. } = effect {
                led.push(now);
                // Gauss sent this before it received the new epoch.
                status(&mut election, None, Some(epoch), now);
            }
        }
        let epoch = election.epoch().cloned();
        let (epoch, over) = if gauss_follows && !led.is_empty() {
            (epoch, None)
        } else {
            (None, epoch)
        };
        status(&mut election, epoch.as_ref(), over, now);
    }
    led
}

#[test]
fn followed_leader_renews_no_term() {
    let time = Duration::from_secs(20);
    assert_eq!(renewals(true, time).len(), 1);
    assert!(renewals(false, time).len() > 1, "no node follows");
}

#[test]
fn refused_terms_renew_every_ten_seconds() {
    let began = renewals(false, Duration::from_secs(120));
    let pauses: Vec<_> = began
        .windows(2)
        .map(|pair| pair[1].since(pair[0]))
        .collect();
    let frequent = pauses
        .iter()
        .filter(|pause| **pause < Duration::from_secs(10))
        .count();
    assert!(frequent <= 6 && pauses.len() - frequent >= 9, "{pauses:?}");
}

#[test]
fn hourly_term_growth_is_bounded() {
    let mut election = euclid();
    let status = || Body::Status {
        over: None,
        no_login: Vec::new(),
    };
    for seq in 1..100 {
        election.handle(of_edge(seq, 8 + seq * (MAX_TERM_STEP / 2), status()), NOW);
    }
    assert!(election.term() <= 8 + MAX_TERM_STEP, "{}", election.term());
    let beat = election.handle(of_edge(100, MAX_TERM, beat(88)), NOW);
    assert!(
        is_counted(&beat) && election.leader() == Some(&NodeName::from_static("edge")),
        "received nevertheless"
    );
}

/// A message of gauss that claims that it has taken over from edge and that all nodes follow it.
fn claim_of_gauss(seq: u64) -> ElectionInput {
    let gauss = NodeName::from_static("gauss");
    let epoch = Epoch::new(9, gauss.clone());
    let after = Some(epoch_of_edge());
    let body = Body::Beat {
        every_ms: 50,
        round: 1,
        followers: 200,
        after,
        successors: Vec::new(),
        life: LifeSign::default(),
    };
    received(&gauss, seq, Some(&epoch), body)
}

#[test]
fn follower_keeps_live_higher_rank_leader() {
    let mut election = euclid();
    election.handle(of_edge(1, 8, beat(1)), NOW);
    for ms in 1..1000 {
        let now = NOW + std::time::Duration::from_millis(ms);
        election.handle(claim_of_gauss(ms), now);
        if ms % 100 == 0 {
            election.handle(of_edge(ms, 8, beat(ms)), now);
        }
        assert_eq!(
            election.leader(),
            Some(&NodeName::from_static("edge")),
            "after {ms} ms"
        );
    }
    let mut now = NOW + std::time::Duration::from_millis(1000);
    election.handle(claim_of_gauss(1000), now);
    while election.leader() == Some(&NodeName::from_static("edge")) {
        now = election.next_deadline();
        election.tick(now);
    }
    assert_eq!(
        election.leader(),
        Some(&NodeName::from_static("gauss")),
        "the leader is gone, and it has claimed the lead"
    );
    assert!(now.since(NOW) < std::time::Duration::from_millis(1500));
}

#[test]
fn foreign_resignation_changes_no_state() {
    let gauss = NodeName::from_static("gauss");
    let mut election = euclid();
    election.handle(of_edge(1, 8, beat(1)), NOW);
    for (seq, term) in [(1, MAX_TERM), (2, 8 + MAX_TERM_STEP / 2)] {
        let epoch = Epoch::new(8 + MAX_TERM_STEP / 2, gauss.clone());
        let false_message = message(
            &gauss,
            seq,
            None,
            Body::Resign {
                epoch,
                last_round: 0,
            },
        );
        election.handle(
            ElectionInput::Receive {
                message: ElectionMessage {
                    term,
                    ..false_message
                },
            },
            NOW,
        );
    }
    for ms in (50..3000).step_by(50) {
        for effect in election.handle(of_edge(ms, 8, beat(ms)), NOW + Duration::from_millis(ms)) {
            if let ElectionEffect::Send { message, .. } = effect {
                assert!(
                    ElectionMessage::decode(&message.encode(crate::wire::Encoding::Cbor)).is_ok()
                );
            }
        }
        assert_eq!(election.leader(), Some(&NodeName::from_static("edge")));
    }
}

#[test]
fn standby_precedes_false_claimant() {
    let config = ElectionConfig {
        priority: 120,
        ..ElectionConfig::default()
    };
    let mut election = Election::new(config, NodeName::from_static("euclid"), 7, NOW);
    let health = Health {
        broker: true,
        fuser: true,
        gateway: true,
        reports: true,
        settings: true,
        load_percent: 0,
    };
    election.handle(ElectionInput::Health { health }, NOW);
    election.handle(of_edge(1, 8, beat(1)), NOW);
    let ElectionInput::Receive { message } = claim_of_gauss(1) else {
        panic!("no message")
    };
    let candidacy = Candidacy {
        priority: 50,
        ..message.candidacy
    };
    election.handle(
        ElectionInput::Receive {
            message: ElectionMessage {
                candidacy,
                ..message
            },
        },
        NOW,
    );
    let mut now = NOW + Duration::from_millis(10);
    election.handle(
        ElectionInput::PeerGone {
            peer: NodeName::from_static("edge"),
        },
        now,
    );
    while election.next_deadline() < NOW + Duration::from_millis(20) {
        now = election.next_deadline();
        election.tick(now);
    }
    assert!(
        election.is_leading(),
        "{:?} {:?}",
        election.state,
        election.next_deadline()
    );
}

#[test]
fn node_leaves_false_first_leader() {
    let [hopper, noether, leader] = ["hopper", "noether", "v02"].map(NodeName::from_static);
    let mut election = euclid();
    election.handle(claim_of_gauss(1), NOW);
    assert_eq!(election.leader(), Some(&NodeName::from_static("gauss")));
    let epoch = Epoch::new(10, leader.clone());
    for from in [&hopper, &noether] {
        election.handle(
            received(
                from,
                1,
                Some(&epoch),
                Body::Status {
                    over: None,
                    no_login: Vec::new(),
                },
            ),
            NOW,
        );
    }
    election.handle(received(&leader, 1, Some(&epoch), beat(1)), NOW);
    assert_eq!(election.leader(), Some(&leader));
}

#[test]
fn repeated_claim_is_not_delayed() {
    let mut election = euclid();
    let mut now = NOW;
    let idle = Body::Beat {
        every_ms: 2500,
        round: 1,
        followers: 1,
        after: None,
        successors: Vec::new(),
        life: LifeSign::default(),
    };
    election.handle(of_edge(1, 8, idle), now);
    for seq in 1..25 {
        now = NOW + Duration::from_millis(20 * seq);
        while election.next_deadline() <= now {
            election.tick(election.next_deadline());
        }
        election.handle(claim_of_gauss(seq), now);
    }
    assert_eq!(election.leader(), Some(&NodeName::from_static("gauss")));
}

/// A leader that states an interval of a minute between its beats, and then stops, is replaced as
/// soon as a leader with the cell's slowest beats.
#[test]
fn long_beat_interval_delays_no_takeover() {
    let mut election = euclid();
    let mut now = NOW;
    let rare = Body::Beat {
        every_ms: 60_000,
        round: 1,
        followers: 255,
        after: None,
        successors: Vec::new(),
        life: LifeSign::default(),
    };
    election.handle(of_edge(1, 8, rare), now);
    assert_eq!(election.leader(), Some(&NodeName::from_static("edge")));
    while !election.is_leading() {
        now = election.next_deadline();
        election.tick(now);
    }
    let silence = now.since(NOW);
    assert!(silence < Duration::from_secs(12), "{silence:?}");
}

/// One certificate is valid for several names: the node's name and the names of its parts.
#[test]
fn node_parts_depose_no_leader() {
    let mut election = euclid();
    let mut now = NOW;
    let gauss = NodeName::from_static("gauss");
    let hopper = NodeName::from_static("hopper");
    let mut seq = 0;
    let mut status = |election: &mut Election, from: &NodeName, epoch: Option<&Epoch>, now| {
        seq += 1;
        election.handle(
            received(
                from,
                seq,
                epoch,
                Body::Status {
                    over: None,
                    no_login: Vec::new(),
                },
            ),
            now,
        );
    };
    while !election.is_leading() {
        status(&mut election, &gauss, None, now);
        now = election.next_deadline();
        election.tick(now);
    }
    let own = election.epoch().cloned();
    status(&mut election, &gauss, own.as_ref(), now);
    status(&mut election, &hopper, own.as_ref(), now);
    let false_epoch = Epoch::new(election.term() + 1, gauss);
    for part in 0..15 {
        let part = NodeName::new(format!("mallory--{part}")).unwrap();
        status(&mut election, &part, Some(&false_epoch), now);
    }
    assert!(election.is_leading());
}

#[test]
fn first_boot_joins_existing_cell() {
    let gauss = NodeName::from_static("gauss");
    let false_epoch = Epoch::new(MAX_FIRST_TERM - 1, gauss.clone());
    let mut election = euclid_after(1);
    election.handle(
        received(&gauss, 1, Some(&false_epoch), beat_after(None)),
        NOW,
    );
    assert_eq!(election.leader(), Some(&gauss), "no other node is present");
    let effects = election.handle(of_edge(1, 8, beat(1)), NOW);
    assert!(
        effects.contains(&ElectionEffect::PersistTerm { term: 9 }),
        "{effects:?}"
    );
    assert_eq!(election.leader(), Some(&NodeName::from_static("edge")));
    election.handle(
        received(&gauss, 2, Some(&false_epoch), beat_after(None)),
        NOW,
    );
    let gone = ElectionInput::PeerGone {
        peer: NodeName::from_static("edge"),
    };
    election.handle(gone, NOW);
    assert_eq!(
        (election.leader(), election.term()),
        (Some(&NodeName::from_static("euclid")), 9)
    );
}

#[test]
fn long_follower_refuses_lower_term() {
    let gauss = NodeName::from_static("gauss");
    let edge = NodeName::from_static("edge");
    let old = Epoch::new(1_800_000_000, edge.clone());
    let mut election = euclid_after(0);
    let mut now = NOW;
    for seq in 1..80 {
        election.handle(received(&edge, seq, Some(&old), beat(seq)), now);
        now = now + Duration::from_millis(100);
    }
    election.handle(
        received(
            &gauss,
            1,
            Some(&Epoch::new(1, gauss.clone())),
            beat_after(None),
        ),
        now,
    );
    assert_eq!(
        (election.leader(), election.term()),
        (Some(&edge), old.term)
    );
}

/// Nodes that one split cuts off from their leader suspect it at about the same time, and ask each
/// other. Whoever passes another node's question on must still ask for itself: without a question
/// of its own it would wait for the claims of nodes on the other side.
#[test]
fn relayed_question_replaces_no_local() {
    let edge = NodeName::from_static("edge");
    let gauss = NodeName::from_static("gauss");
    let epoch = epoch_of_edge();
    let at = |ms: u64| NOW + Duration::from_millis(ms);
    let mut euclid = euclid();
    let near_beat = Body::Beat {
        every_ms: 400,
        round: 1,
        followers: 1,
        after: None,
        successors: vec![gauss.clone()],
        life: LifeSign::default(),
    };
    euclid.handle(of_edge(1, 8, near_beat), at(0));
    for round in 1..=4 {
        let accepted = ElectionInput::Round {
            epoch: epoch.clone(),
            round,
        };
        euclid.handle(accepted, at(100 * (round - 1)));
    }
    let asked = |effects: Vec<ElectionEffect>| {
        let question = |effect: &ElectionEffect| match effect {
            ElectionEffect::Send { to, message } if *to == edge => match message.body {
                Body::Ask { ask } => Some(ask),
                _ => None,
            },
            _ => None,
        };
        effects.iter().find_map(question)
    };
    let question = |seq| received(&gauss, seq, Some(&epoch), Body::Ask { ask: seq });
    let passed_on = asked(euclid.handle(question(1), at(440)));
    assert!(passed_on.is_some());
    let ask = asked(euclid.tick(at(451))).expect("its own question");
    // However many more it passes on, the answer to its own counts.
    for seq in 2..20 {
        euclid.handle(question(seq), at(460));
    }
    let evidence = Body::LeaderEvidence {
        ask,
        age_ms: 0,
        life: LifeSign {
            led_ms: 460,
            ..LifeSign::default()
        },
    };
    euclid.handle(received(&gauss, 20, Some(&epoch), evidence), at(470));
    euclid.tick(at(560));
    assert_eq!(euclid.leader(), Some(&edge));
}
