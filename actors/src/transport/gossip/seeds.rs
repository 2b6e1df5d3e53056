//! Resolution of the seeds' host names.

use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::net::SocketAddr;
use std::time::Duration;

use tokio::net::lookup_host;

/// Resolves the seeds repeatedly, sooner while one has failed, until `deliver` returns false.
/// `trouble` is called for each failure.
///
/// A seed whose resolution fails keeps its addresses: the name server may be unreachable together
/// with the network.
pub(crate) async fn resolve(
    seeds: Vec<String>,
    ipv4: bool,
    trouble: impl Fn(&str, &io::Error),
    deliver: impl Fn(Vec<SocketAddr>) -> bool,
) {
    let mut retry = RETRY_MIN;
    let mut unresolved = BTreeSet::new();
    let mut known = BTreeMap::new();
    loop {
        resolve_once(&seeds, ipv4, &mut known, &mut unresolved, &trouble).await;
        let addresses = known.values().flatten().copied().collect();
        let complete = unresolved.is_empty();
        if !deliver(addresses) {
            return;
        }
        let wait = if complete { REFRESH } else { retry };
        retry = if complete {
            RETRY_MIN
        } else {
            (retry * 2).min(REFRESH)
        };
        tokio::time::sleep(wait).await;
    }
}

const RETRY_MIN: Duration = Duration::from_millis(500);
const REFRESH: Duration = Duration::from_secs(30);

/// Looks up every seed once. Found addresses replace earlier ones, which are kept for a seed that
/// is not found now.
async fn resolve_once(
    seeds: &[String],
    ipv4: bool,
    known: &mut BTreeMap<String, Vec<SocketAddr>>,
    unresolved: &mut BTreeSet<String>,
    trouble: &impl Fn(&str, &io::Error),
) {
    for seed in seeds {
        match look_up(seed, ipv4).await {
            Ok(found) => {
                known.insert(seed.clone(), found);
                if unresolved.remove(seed) {
                    tracing::info!(%seed, "seed resolved");
                }
            }
            Err(error) => {
                trouble(seed, &error);
                unresolved.insert(seed.clone());
            }
        }
    }
}

/// The addresses of a seed that a socket of its family reaches.
pub(crate) async fn look_up(seed: &str, ipv4: bool) -> io::Result<Vec<SocketAddr>> {
    let found: Vec<_> = lookup_host(seed)
        .await?
        .filter(|address| address.is_ipv4() == ipv4)
        .collect();
    let family = if ipv4 { "IPv4" } else { "IPv6" };
    if found.is_empty() {
        Err(io::Error::other(format!("no {family} address")))
    } else {
        Ok(found)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn unusable_seed_is_retried() {
        let seeds = ["127.0.0.1:9", "[::1]:9", "no port"].map(str::to_owned);
        let mut unresolved = BTreeSet::from(["127.0.0.1:9".to_owned()]);
        let usual: SocketAddr = "127.0.0.1:9".parse().unwrap();
        let before: SocketAddr = "192.0.2.1:9".parse().unwrap();
        let mut known = BTreeMap::from([("no port".to_owned(), vec![before])]);
        let failed = std::cell::RefCell::new(Vec::new());
        let trouble = |seed: &str, _: &io::Error| failed.borrow_mut().push(seed.to_owned());
        resolve_once(&seeds, true, &mut known, &mut unresolved, &trouble).await;
        assert_eq!(failed.into_inner(), ["[::1]:9", "no port"]);
        assert_eq!(
            known.into_values().flatten().collect::<Vec<_>>(),
            [usual, before],
            "resolved addresses stay"
        );
        assert_eq!(
            unresolved,
            BTreeSet::from(["[::1]:9", "no port"].map(str::to_owned))
        );
    }
}
