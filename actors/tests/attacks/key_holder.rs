//! A holder of the cell's key without a certificate, who can take part in the membership in any name.

use std::net::{Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use ecod::leadership::election::{Body, Candidacy, ElectionMessage, MAX_TERM};
use ecod::model::names::NodeName;
use ecod::wire::{Encoding, Role, SCHEMA_VERSION};
use ecod_actors::actors::membership::{Membership, MembershipArguments};
use ecod_actors::messages::membership::MembershipMessage;
use ecod_actors::platform::clock;
use ecod_actors::platform::secret::Secret;
use ecod_actors::transport::gossip::MembershipConfig;
use ractor::Actor;
use tokio::sync::watch;
use tokio::time::{sleep, timeout};

use crate::cell::{CELL, Target};
use crate::row::{Means, Row, UNHARMED};

pub(crate) const ROWS: &[Row] = &[Row {
    attack: "a status with the largest term",
    means: Means::CellKey,
    bar: UNHARMED,
    quick: true,
    run: |target| Box::pin(largest_term(target)),
}];

/// The name under which the attacker takes part.
const NAME: NodeName = NodeName::from_static("mallory");

async fn largest_term(target: Target) -> anyhow::Result<()> {
    let mut config = MembershipConfig {
        key: Some(Secret::new(target.key)),
        bind: Some(SocketAddr::from((Ipv4Addr::LOCALHOST, 0))),
        seeds: target.gossip.iter().map(ToString::to_string).collect(),
        ..MembershipConfig::default()
    };
    config.multicast.enabled = false;
    let (run, (sender, mut members)) = (clock::now().micros(), watch::channel(Vec::new()));
    let arguments = MembershipArguments {
        name: NAME,
        cell: NodeName::from_static(CELL),
        run,
        role: Role::Cav,
        broker: None,
        credentials: None,
        config,
        events: Arc::new(drop),
        members: sender,
        counters: Arc::default(),
    };
    let (membership, _) = Actor::spawn(None, Membership, arguments).await?;
    let met = members.wait_for(|members| members.len() >= target.gossip.len());
    // A cell with certificates admits nobody without one.
    let Ok(met) = timeout(Duration::from_secs(10), met).await else { return Ok(()) };
    met?;
    for seq in 1.. {
        let message = ElectionMessage {
            schema: SCHEMA_VERSION,
            from: NAME,
            run,
            seq,
            candidacy: Candidacy { role: Role::Cav, priority: 0, load: 0, fit: false },
            term: MAX_TERM,
            epoch: None,
            hears_you: true,
            clock: None,
            body: Body::Status { over: None },
        };
        let payload = Bytes::from(message.encode(Encoding::Cbor));
        let names: Vec<_> = members.borrow().iter().map(|member| member.name.clone()).collect();
        for to in names {
            membership.cast(MembershipMessage::Send { to, payload: payload.clone() })?;
        }
        sleep(Duration::from_millis(100)).await;
    }
    Ok(())
}
