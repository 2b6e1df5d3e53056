//! The owner of the leader's machine and certificate.

use std::sync::Arc;
use std::time::Duration;

use ecod::model::names::NodeName;
use ecod::wire::{Encoding, Role, encode};
use ecod_actors::platform::clock;
use ecod_actors::transport::pki::{Authority, Credentials, EvidenceSigner, TlsConfig};

use tokio::time::sleep;

use crate::attacks::candidate::{TERMS, join, publish_for_ever};
use crate::attacks::cell::{CANDIDATE, CELL, LEADER, Target};
use crate::attacks::client::publish;
use crate::attacks::row::{Bar, Means, Row, UNHARMED};
use crate::shares::inverted;

/// Half a second passes until the list is read, and a second until the next leader's first map.
const REVOKED: Bar = Bar {
    longest_gap_ms: Some(1500),
    is_replaced: Some(true),
    ..UNHARMED
};

pub(crate) const ROWS: &[Row] = &[
    Row {
        attack: "it goes on leading after it is revoked",
        means: Means::Leader,
        on_brokers: false,
        deeds: (1, "revocation"),
        bar: REVOKED,
        quick: true,
        run: |target| Box::pin(revoked(target)),
    },
    Row {
        attack: "its forged evidence, before and after it is revoked, passed on by a candidate",
        means: Means::Leader,
        on_brokers: false,
        deeds: (30, "shares"),
        bar: REVOKED,
        quick: false,
        run: |target| Box::pin(evidence_of_the_revoked(target)),
    },
];

/// Time for which the leader's evidence is passed on before it is revoked.
const BEFORE: Duration = Duration::from_secs(1);

/// Its own list stays as it was.
async fn revoked(target: Target) -> anyhow::Result<()> {
    Authority::open(&target.home.join("pki"))?
        .revoke(&NodeName::from_static(LEADER), clock::now())?;
    target.did(1);
    Ok(())
}

/// A candidate that colludes vouches for the evidence: it counts until the list is read.
async fn evidence_of_the_revoked(target: Target) -> anyhow::Result<()> {
    let pki = target.home.join("pki");
    let leader = NodeName::from_static(LEADER);
    let mut authority = Authority::open(&pki)?;
    let files = TlsConfig {
        revocation_list: None,
        ..authority.tls_of(&leader)
    };
    let signer = EvidenceSigner::new(
        NodeName::from_static(CELL),
        Arc::new(Credentials::load(&files, &leader)?),
    );
    let _member = join(&target, Role::Auto).await?;
    let shares = TERMS
        .into_iter()
        .filter_map(|term| signer.sign(inverted(CANDIDATE, term, LEADER)));
    let packet = |share| {
        publish(
            &format!("ecod/v1/{CELL}/ledger/{CANDIDATE}"),
            &encode(&share, Encoding::Json),
        )
    };
    let packets: Vec<_> = shares.map(packet).collect();
    // The leader's machine belongs to the attacker, so the standby's broker is queried.
    let standby = Target {
        broker: target.standby,
        ..target.clone()
    };
    let revoke = async {
        sleep(BEFORE).await;
        authority.revoke(&leader, clock::now())?;
        anyhow::Ok(())
    };
    tokio::try_join!(publish_for_ever(&standby, &packets), revoke).map(drop)
}
