//! Keeps the addresses of the seeds.

use std::net::SocketAddr;
use std::time::Duration;

use ractor::ActorRef;
use tokio::net::lookup_host;

use super::MembershipMessage;

/// Resolves the seeds anew for ever, sooner if one could not be resolved, and tells the membership.
pub(super) async fn resolve(seeds: Vec<String>, ipv4: bool, membership: ActorRef<MembershipMessage>) {
    let mut retry = RETRY_MIN;
    loop {
        let (addresses, complete) = resolve_once(&seeds, ipv4).await;
        if membership.cast(MembershipMessage::SetSeeds { addresses }).is_err() {
            return;
        }
        let wait = if complete { REFRESH } else { retry };
        retry = if complete { RETRY_MIN } else { (retry * 2).min(REFRESH) };
        tokio::time::sleep(wait).await;
    }
}

const RETRY_MIN: Duration = Duration::from_millis(500);
const REFRESH: Duration = Duration::from_secs(30);

async fn resolve_once(seeds: &[String], ipv4: bool) -> (Vec<SocketAddr>, bool) {
    let mut addresses = Vec::new();
    let mut complete = true;
    for seed in seeds {
        match lookup_host(seed).await {
            Ok(found) => addresses.extend(found.filter(|address| address.is_ipv4() == ipv4)),
            Err(error) => {
                complete = false;
                tracing::debug!(%error, %seed, "seed cannot be resolved");
            }
        }
    }
    (addresses, complete)
}
