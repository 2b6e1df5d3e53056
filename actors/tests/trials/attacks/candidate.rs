//! The owner of a candidate's certificate, which may lead and does not.

use std::sync::Arc;
use std::time::Duration;

use ecod::leadership::election::{Body, LifeSign, MAX_TERM};
use ecod::model::epoch::Epoch;
use ecod::model::names::NodeName;
use ecod::wire::{Encoding, GlobalMap, MAX_INTEGER, Role, encode};
use ecod_actors::platform::clock;
use ecod_actors::transport::pki::EvidenceSigner;
use futures_util::future::join_all;
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use tokio::io::AsyncWriteExt;
use tokio::time::sleep;

use crate::attacks::cell::{CANDIDATE, CELL, LEADER, Target};
use crate::attacks::client::{log_in, publish, send_for_ever};
use crate::attacks::description::set_without_right;
use crate::attacks::insider::Insider;
use crate::attacks::row::{Bar, Means, Row, UNHARMED};
use crate::shares::inverted;

pub(crate) const ROWS: &[Row] = &[
    Row {
        attack: "30 connections flood with maps of 8 MB",
        means: Means::Candidate,
        on_brokers: true,
        deeds: (20_000_000, "bytes"),
        bar: UNHARMED,
        quick: false,
        run: |target| Box::pin(flood(target)),
    },
    Row {
        attack: "a member's status with the largest term",
        means: Means::Candidate,
        on_brokers: false,
        deeds: (30, "messages"),
        bar: UNHARMED,
        quick: false,
        run: |target| Box::pin(largest_term(target)),
    },
    Row {
        attack: "a member's beats as an edge that nine nodes follow",
        means: Means::Candidate,
        on_brokers: false,
        deeds: (30, "messages"),
        bar: UNHARMED,
        quick: false,
        run: |target| Box::pin(beats(target, 1)),
    },
    Row {
        attack: "the same with the largest round",
        means: Means::Candidate,
        on_brokers: false,
        deeds: (30, "messages"),
        bar: UNHARMED,
        quick: false,
        run: |target| Box::pin(beats(target, MAX_INTEGER)),
    },
    Row {
        attack: "unsigned vouches for the leader, which hangs",
        means: Means::Candidate,
        on_brokers: false,
        deeds: (30, "messages"),
        bar: Bar {
            longest_gap_ms: Some(1000),
            is_replaced: Some(true),
            ..UNHARMED
        },
        quick: true,
        run: |target| Box::pin(vouch(target)),
    },
    Row {
        attack: "maps with the largest round, in the leader's name",
        means: Means::Candidate,
        on_brokers: true,
        deeds: (30, "maps"),
        bar: UNHARMED,
        quick: true,
        run: |target| Box::pin(largest_round(target)),
    },
    Row {
        attack: "a member's forged evidence",
        means: Means::Candidate,
        on_brokers: true,
        deeds: (30, "shares"),
        bar: UNHARMED,
        quick: true,
        run: |target| Box::pin(forged_evidence(target)),
    },
    Row {
        attack: "a description that is set again and again without the right",
        means: Means::Candidate,
        on_brokers: false,
        deeds: (5, "looks"),
        bar: UNHARMED,
        quick: false,
        run: |target| Box::pin(set_without_right(target)),
    },
];

/// Time between two forged messages.
const PAUSE: Duration = Duration::from_millis(20);

/// Terms that a cell has reached soon after its start.
pub(crate) const TERMS: [u64; 3] = [1, 2, 3];

async fn flood(target: Target) -> anyhow::Result<()> {
    let map = publish(
        &format!("ecod/v1/{CELL}/global_detections"),
        &vec![b'x'; 8_000_000],
    );
    join_all((0..30).map(|_| send_for_ever(&target, &target.candidate, CANDIDATE, &[], &map)))
        .await;
    Ok(())
}

pub(crate) async fn join(target: &Target, role: Role) -> anyhow::Result<Insider> {
    Insider::join(
        target,
        CANDIDATE,
        role,
        Some(Arc::clone(&target.credentials)),
    )
    .await?
    .admitted()
    .await
}

/// Claims a lead that its certificate does not allow.
async fn beats(target: Target, round: u64) -> anyhow::Result<()> {
    let insider = join(&target, Role::Edge).await?;
    let beat = Body::Beat {
        every_ms: 50,
        round,
        followers: 9,
        after: None,
        successors: Vec::new(),
        life: LifeSign::default(),
    };
    insider.repeat(9, Some(insider.epoch(9)), beat).await
}

/// Stops the leader's process, and answers every question about it with "it is alive".
async fn vouch(target: Target) -> anyhow::Result<()> {
    let insider = join(&target, Role::Auto).await?;
    let leader = Pid::from_raw(target.leader_process.try_into()?);
    kill(leader, Signal::SIGSTOP)?;
    let answer = |(ask, minutes)| Body::LeaderEvidence {
        ask,
        age_ms: 0,
        life: LifeSign {
            led_ms: 600_000 * minutes,
            signature: None,
        },
    };
    let answers: Vec<_> = (1..=32)
        .zip([1_u64, 2, 3].into_iter().cycle())
        .map(answer)
        .collect();
    let leader = Epoch::new(1, NodeName::from_static(LEADER));
    insider.repeat_all(1, Some(leader), &answers).await
}

async fn largest_term(target: Target) -> anyhow::Result<()> {
    join(&target, Role::Auto)
        .await?
        .repeat(
            MAX_TERM,
            None,
            Body::Status {
                over: None,
                no_login: Vec::new(),
            },
        )
        .await
}

async fn largest_round(target: Target) -> anyhow::Result<()> {
    let epoch = |term| Epoch::new(term, NodeName::from_static(LEADER));
    let map = |term| GlobalMap::new(&epoch(term), MAX_INTEGER, clock::now());
    let maps = TERMS.map(|term| {
        publish(
            &format!("ecod/v1/{CELL}/global_detections"),
            &encode(&map(term), Encoding::Json),
        )
    });
    publish_for_ever(&target, &maps).await
}

/// Publishes the same again and again, over a new connection whenever one ends.
pub(crate) async fn publish_for_ever(target: &Target, packets: &[Vec<u8>]) -> anyhow::Result<()> {
    loop {
        if let Ok(mut stream) = log_in(target, &target.candidate, CANDIDATE).await {
            while stream.write_all(&packets.concat()).await.is_ok() {
                target.did(packets.len());
                sleep(PAUSE).await;
            }
        }
        sleep(PAUSE).await;
    }
}

/// Shares in the names of others, with the attacker's signature or without a signature, and shares of invented
/// leaderships.
async fn forged_evidence(target: Target) -> anyhow::Result<()> {
    let _member = join(&target, Role::Auto).await?;
    let signer = EvidenceSigner::new(NodeName::from_static(CELL), Arc::clone(&target.credentials));
    let shares = TERMS
        .into_iter()
        .flat_map(|term| [(term, LEADER), (term, CANDIDATE)])
        .flat_map(|(term, aggregator)| {
            let share = inverted(CANDIDATE, term, aggregator);
            [Some(share.clone()), signer.sign(share)]
        });
    let packet = |share| {
        publish(
            &format!("ecod/v1/{CELL}/ledger/{CANDIDATE}"),
            &encode(&share, Encoding::Json),
        )
    };
    publish_for_ever(&target, &shares.flatten().map(packet).collect::<Vec<_>>()).await
}
