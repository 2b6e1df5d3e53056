//! Throttle of answers to nodes without a session.

use std::collections::BTreeMap;
use std::net::{IpAddr, SocketAddr};
use std::time::Duration;

use ecod::model::time::Timestamp;

use super::key::SessionId;
use crate::platform::throttle::{KeyedThrottle, TokenBucket, host_network};

/// Limits answers to all unknown hosts together, to each host, and to each session at its address.
/// Therefore one recorded greeting that is sent repeatedly, or one host that invents sessions,
/// cannot use up the share of other hosts. A host from which a node was admitted has room of its
/// own: its restarted node is answered regardless of traffic from unknown hosts.
#[derive(Debug)]
pub(crate) struct ReplyThrottle {
    all: TokenBucket,
    /// Hosts with room of their own, and when a node was last admitted from there.
    known: BTreeMap<IpAddr, (TokenBucket, Timestamp)>,
    by_host: KeyedThrottle<IpAddr>,
    by_session: KeyedThrottle<(SessionId, SocketAddr)>,
}

impl ReplyThrottle {
    pub(crate) fn new(now: Timestamp) -> Self {
        Self {
            all: TokenBucket::new(REPLY_BURST, REPLY_INTERVAL, now),
            known: BTreeMap::new(),
            by_host: KeyedThrottle::new(REPLY_BURST, HOST_INTERVAL),
            by_session: KeyedThrottle::new(1, MIN_SESSION_INTERVAL),
        }
    }

    /// True if this session may be answered now.
    pub(crate) fn allow(&mut self, session: &SessionId, from: SocketAddr, now: Timestamp) -> bool {
        self.by_session.allow(&(*session, from), now) && self.allow_host(from, now)
    }

    /// True if a proof from this address may be verified now, independent of the claimed session:
    /// forged proofs must not use up the share of an honest one.
    pub(crate) fn allow_host(&mut self, from: SocketAddr, now: Timestamp) -> bool {
        let host = host_network(from.ip());
        match self.known.get_mut(&host) {
            Some((own, _)) => own.allow(now),
            None => self.by_host.allow(&host, now) && self.all.allow(now),
        }
    }

    /// Gives a host room of its own, because a node was admitted from there. The host whose last
    /// admission is oldest is dropped if there is no room.
    pub(crate) fn admit(&mut self, from: SocketAddr, now: Timestamp) {
        let host = host_network(from.ip());
        if !self.known.contains_key(&host) && self.known.len() >= MAX_KNOWN {
            let oldest = self
                .known
                .iter()
                .min_by_key(|(_, (_, at))| *at)
                .map(|(host, _)| *host);
            oldest.and_then(|host| self.known.remove(&host));
        }
        let new = || (TokenBucket::new(REPLY_BURST, HOST_INTERVAL, now), now);
        self.known.entry(host).or_insert_with(new).1 = now;
    }
}

/// Burst of answers, and time until one more, in total and for one host. A cell of 64 nodes that
/// start together, perhaps on one machine, stays below it.
const REPLY_BURST: u32 = 256;
const REPLY_INTERVAL: Duration = Duration::from_millis(10);
const HOST_INTERVAL: Duration = Duration::from_millis(20);

/// Minimum time between two answers to one session.
const MIN_SESSION_INTERVAL: Duration = Duration::from_millis(50);

/// Maximum hosts with room of their own.
const MAX_KNOWN: usize = 1024;

#[cfg(test)]
mod tests {
    use std::net::Ipv4Addr;

    use super::*;

    fn address(host: u32) -> SocketAddr {
        SocketAddr::from((Ipv4Addr::from(host), 1))
    }

    /// Number of verified proofs among those that a host sends in a second, while 500 invented
    /// hosts send too.
    fn verified_beside_a_flood(throttle: &mut ReplyThrottle, host: u32) -> usize {
        let verified = (0..1000u32).filter(|ms| {
            let now = Timestamp(u64::from(*ms) * 1000);
            for stranger in 0..5 {
                throttle.allow_host(address(1_000_000 + (5 * ms + stranger) % 500), now);
            }
            ms % 50 == 0 && throttle.allow_host(address(host), now)
        });
        verified.count()
    }

    #[test]
    fn flood_leaves_verified_host_share() {
        let mut throttle = ReplyThrottle::new(Timestamp(0));
        throttle.admit(address(7), Timestamp(0));
        assert_eq!(verified_beside_a_flood(&mut throttle, 7), 20);
        let mut throttle = ReplyThrottle::new(Timestamp(0));
        assert!(
            verified_beside_a_flood(&mut throttle, 7) < 20,
            "a stranger shares"
        );
    }

    #[test]
    fn verified_hosts_are_bounded() {
        let mut throttle = ReplyThrottle::new(Timestamp(0));
        (0..2 * MAX_KNOWN as u32)
            .for_each(|host| throttle.admit(address(host), Timestamp(host.into())));
        assert_eq!(throttle.known.len(), MAX_KNOWN);
        assert!(
            !throttle.known.contains_key(&address(0).ip()),
            "the oldest gave way"
        );
        let latest = address(2 * MAX_KNOWN as u32 - 1);
        let allowed = (0..1000)
            .filter(|_| throttle.allow_host(latest, Timestamp(5000)))
            .count();
        assert_eq!(allowed, REPLY_BURST as usize);
    }
}
