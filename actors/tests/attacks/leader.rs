//! The owner of the leader's machine and certificate.

use ecod::model::names::NodeName;
use ecod_actors::platform::clock;
use ecod_actors::transport::pki::Authority;

use crate::cell::{LEADER, Target};
use crate::row::{Bar, Means, Row, UNHARMED};

pub(crate) const ROWS: &[Row] = &[Row {
    attack: "it goes on leading after it is revoked",
    means: Means::Leader,
    on_brokers: false,
    deeds: (1, "revocation"),
    // Half a second passes until the list is read, and a second until the next leader's first map.
    bar: Bar { longest_gap_ms: Some(1500), is_replaced: true, ..UNHARMED },
    quick: true,
    run: |target| Box::pin(revoked(target)),
}];

/// Its own list stays as it was.
async fn revoked(target: Target) -> anyhow::Result<()> {
    Authority::open(&target.home.join("pki"))?.revoke(&NodeName::from_static(LEADER), clock::now())?;
    target.did(1);
    Ok(())
}
