//! Keeps the addresses of the seeds.

use std::collections::BTreeSet;
use std::io;
use std::net::SocketAddr;
use std::time::Duration;

use ractor::ActorRef;
use tokio::net::lookup_host;

use super::MembershipMessage;

/// Resolves the seeds anew for ever, sooner if one could not be resolved, and tells the membership. A seed that cannot
/// be resolved is logged once, until it can.
pub(super) async fn resolve(seeds: Vec<String>, ipv4: bool, membership: ActorRef<MembershipMessage>) {
    let mut retry = RETRY_MIN;
    let mut unresolved = BTreeSet::new();
    loop {
        let addresses = resolve_once(&seeds, ipv4, &mut unresolved).await;
        let complete = unresolved.is_empty();
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

async fn resolve_once(seeds: &[String], ipv4: bool, unresolved: &mut BTreeSet<String>) -> Vec<SocketAddr> {
    let mut addresses = Vec::new();
    for seed in seeds {
        let family = if ipv4 { "IPv4" } else { "IPv6" };
        let found = lookup_host(seed).await.and_then(|found| {
            let found: Vec<_> = found.filter(|address| address.is_ipv4() == ipv4).collect();
            if found.is_empty() { Err(io::Error::other(format!("no {family} address"))) } else { Ok(found) }
        });
        match found {
            Ok(found) => {
                addresses.extend(found);
                if unresolved.remove(seed) {
                    tracing::info!(%seed, "seed resolved");
                }
            }
            Err(error) if unresolved.insert(seed.clone()) => {
                tracing::warn!(%error, %seed, "seed cannot be resolved, trying on");
            }
            Err(_) => {}
        }
    }
    addresses
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_seed_of_the_wrong_family_or_without_an_address_is_tried_on() {
        let seeds = ["127.0.0.1:9", "[::1]:9", "no port"].map(str::to_owned);
        let mut unresolved = BTreeSet::from(["127.0.0.1:9".to_owned()]);
        let addresses = resolve_once(&seeds, true, &mut unresolved).await;
        assert_eq!(addresses, ["127.0.0.1:9".parse().unwrap()]);
        assert_eq!(unresolved, BTreeSet::from(["[::1]:9", "no port"].map(str::to_owned)));
    }
}
