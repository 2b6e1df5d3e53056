//! Messages in transit through rmqtt, whose queues between a publisher and its subscribers are
//! unbounded.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use async_trait::async_trait;
use bytes::Bytes;
use rmqtt::context::ServerContext;
use rmqtt::hook::{Handler, HookResult, Parameter, ReturnType, Type};

use super::principal::PrincipalRegistry;

/// Bytes in transit through rmqtt, by principal of the publisher. Each payload carries its charge
/// until the last queue has released it. While there are too many bytes, the frontend reads no more
/// from the publisher.
#[derive(Debug, Clone, Default)]
pub(super) struct InFlight(Arc<Mutex<Charges>>);

#[derive(Debug, Default)]
struct Charges {
    by_principal: HashMap<Arc<str>, usize>,
    total: usize,
}

/// Bytes in transit beyond which a principal, a principal with a large share, or all principals
/// have to wait.
const MAX_BYTES_EACH: usize = 1024 * 1024;
const MAX_BYTES_LARGE: usize = 8 * 1024 * 1024;
const MAX_BYTES: usize = 32 * 1024 * 1024;

/// Estimated memory of a message in the queue of one client, without its payload.
const COPY_BYTES: usize = 512;

impl InFlight {
    /// True if a principal has to wait.
    pub(super) fn is_full(&self, principal: &Arc<str>, has_large_share: bool) -> bool {
        let charges = self.charges();
        let bound = if has_large_share {
            MAX_BYTES_LARGE
        } else {
            MAX_BYTES_EACH
        };
        charges.total >= MAX_BYTES
            || charges
                .by_principal
                .get(principal)
                .is_some_and(|bytes| *bytes >= bound)
    }

    /// A payload that is charged to a principal while any part of it lives.
    fn charge(&self, principal: Arc<str>, payload: Bytes, clients: usize) -> Bytes {
        let bytes = payload.len() + clients * COPY_BYTES;
        let mut charges = self.charges();
        charges.total += bytes;
        *charges
            .by_principal
            .entry(Arc::clone(&principal))
            .or_default() += bytes;
        drop(charges);
        Bytes::from_owner(ChargedPayload {
            payload,
            principal,
            bytes,
            in_flight: self.clone(),
        })
    }

    fn charges(&self) -> MutexGuard<'_, Charges> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

struct ChargedPayload {
    payload: Bytes,
    principal: Arc<str>,
    bytes: usize,
    in_flight: InFlight,
}

impl AsRef<[u8]> for ChargedPayload {
    fn as_ref(&self) -> &[u8] {
        &self.payload
    }
}

impl Drop for ChargedPayload {
    fn drop(&mut self) {
        let mut charges = self.in_flight.charges();
        charges.total -= self.bytes;
        if let Some(bytes) = charges.by_principal.get_mut(&self.principal) {
            *bytes -= self.bytes;
            if *bytes == 0 {
                charges.by_principal.remove(&self.principal);
            }
        }
    }
}

/// Hook of rmqtt that charges messages to their publishers.
pub(super) struct InFlightMeter {
    pub(super) in_flight: InFlight,
    pub(super) principals: PrincipalRegistry,
}

impl InFlightMeter {
    /// Registers the hook for every message, before the hooks of the local broker.
    pub(super) async fn install(self, context: &ServerContext) {
        let register = context.extends.hook_mgr().register();
        register
            .add_priority(Type::MessagePublish, 1, Box::new(self))
            .await;
        register.start().await;
    }
}

#[async_trait]
impl Handler for InFlightMeter {
    async fn hook(&self, parameter: &Parameter, before: Option<HookResult>) -> ReturnType {
        let Parameter::MessagePublish(Some(session), _, publish) = parameter else {
            return (true, before);
        };
        let Some(principal) = self.principals.source(session.id.remote_addr) else {
            return (true, before);
        };
        let mut charged = (*publish).clone();
        // Only with properties does rmqtt give subscribers the identifiers of their subscriptions.
        charged.properties.get_or_insert_default();
        charged.payload =
            self.in_flight
                .charge(principal, publish.payload.clone(), self.principals.len());
        (true, Some(HookResult::Publish(charged)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn payload_counts_until_last_drop() {
        let in_flight = InFlight::default();
        let gauss = Arc::<str>::from("gauss");
        let euclid = Arc::<str>::from("euclid");
        let held: Vec<_> = (0..3)
            .map(|_| {
                in_flight.charge(
                    Arc::clone(&gauss),
                    Bytes::from(vec![0; MAX_BYTES_EACH / 2]),
                    10,
                )
            })
            .collect();
        assert!(in_flight.is_full(&gauss, false) && !in_flight.is_full(&gauss, true));
        assert!(
            !in_flight.is_full(&euclid, false),
            "another's room is its own"
        );
        let part = held[0].slice(5..6);
        drop(held);
        assert!(!in_flight.is_full(&gauss, false) && in_flight.charges().total > 0);
        drop(part);
        let charges = in_flight.charges();
        assert_eq!((charges.total, charges.by_principal.len()), (0, 0));
    }

    #[test]
    fn all_wait_above_total_limit() {
        let in_flight = InFlight::default();
        let names = (0..40).map(|n| Arc::<str>::from(format!("v{n}")));
        let _held: Vec<_> = names
            .map(|name| in_flight.charge(name, Bytes::from(vec![0; MAX_BYTES_EACH]), 0))
            .collect();
        assert!(in_flight.is_full(&"euclid".into(), true));
    }
}
