//! Subscriptions of each principal: their number and rate, and how many of a client's filters match
//! one topic. Each new subscription is answered with all retained messages.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use async_trait::async_trait;
use rmqtt::codec::v5::SubscribeAckReason;
use rmqtt::context::ServerContext;
use rmqtt::hook::{Handler, HookResult, Parameter, ReturnType, Type};
use rmqtt::types::SubscribeAclResult;

use super::principal::{PrincipalRegistry, QuotaKey};
use crate::platform::clock;
use crate::platform::throttle::KeyedThrottle;
use crate::telemetry::counters::Counters;

/// Maximum subscriptions of one client, and of all clients of one certificate or address.
pub(super) const MAX_SUBSCRIPTIONS: usize = 256;

/// Maximum number of a client's filters with wildcards that overlap the same filter. The broker sends
/// a client each message once per matching filter, so this limits the copies of one message.
const MAX_OVERLAPS: usize = 8;

/// Time after which one more subscription is allowed once a burst is used up.
const INTERVAL: Duration = Duration::from_millis(50);

/// Hook of rmqtt that refuses subscriptions of a principal that has too many, or makes too many.
pub(super) struct SubscriptionQuota {
    rate: Mutex<KeyedThrottle<QuotaKey>>,
    principals: PrincipalRegistry,
    counters: Arc<Counters>,
}

impl SubscriptionQuota {
    pub(super) fn new(principals: PrincipalRegistry, counters: Arc<Counters>) -> Self {
        let rate = KeyedThrottle::new(MAX_SUBSCRIPTIONS as u32, INTERVAL);
        Self {
            rate: Mutex::new(rate),
            principals,
            counters,
        }
    }

    /// Registers the hooks, before the permissions.
    pub(super) async fn install(self, context: &ServerContext) {
        let register = context.extends.hook_mgr().register();
        let hook = Arc::new(self);
        for event in [
            Type::ClientSubscribeCheckAcl,
            Type::SessionSubscribed,
            Type::SessionUnsubscribed,
        ] {
            register
                .add_priority(event, 1, Box::new(SharedQuota(Arc::clone(&hook))))
                .await;
        }
        register.start().await;
    }
}

struct SharedQuota(Arc<SubscriptionQuota>);

#[async_trait]
impl Handler for SharedQuota {
    async fn hook(&self, parameter: &Parameter, before: Option<HookResult>) -> ReturnType {
        let SubscriptionQuota {
            rate,
            principals,
            counters,
        } = &*self.0;
        match parameter {
            Parameter::SessionSubscribed(session, subscribe) => {
                principals.record_subscription(
                    session.id.remote_addr,
                    &subscribe.topic_filter,
                    true,
                );
            }
            Parameter::SessionUnsubscribed(session, unsubscribe) => {
                principals.record_subscription(
                    session.id.remote_addr,
                    &unsubscribe.topic_filter,
                    false,
                );
            }
            Parameter::ClientSubscribeCheckAcl(session, subscribe) => {
                let address = session.id.remote_addr;
                let source = principals.quota_key(address, &session.id.client_id);
                let filter = &subscribe.topic_filter;
                let is_copy =
                    |other: &str| other != &**filter && overlap_by_wildcards(other, filter);
                let is_allowed = principals.subscriptions(address) < MAX_SUBSCRIPTIONS
                    && principals.count_filters(address, is_copy) < MAX_OVERLAPS
                    && rate
                        .lock()
                        .unwrap_or_else(PoisonError::into_inner)
                        .allow(&source, clock::now());
                if !is_allowed {
                    principals.count_denied(address, counters);
                    tracing::debug!(source = source.as_str(), "subscription refused");
                    let refused =
                        SubscribeAclResult::new_failure(SubscribeAckReason::QuotaExceeded);
                    return (false, Some(HookResult::SubscribeAclResult(refused)));
                }
            }
            _ => {}
        }
        (true, before)
    }
}

/// True if both filters have wildcards and some topic matches both. A filter without wildcards
/// matches one topic, so it adds at most one copy to a message.
fn overlap_by_wildcards(one: &str, other: &str) -> bool {
    let has_wildcards = |filter: &str| filter.split('/').any(is_wildcard);
    if !has_wildcards(one) || !has_wildcards(other) {
        return false;
    }
    let mut ones = one.split('/');
    let mut others = other.split('/');
    loop {
        match (ones.next(), others.next()) {
            (None, None) | (Some("#"), _) | (_, Some("#")) => return true,
            (None, Some(_)) | (Some(_), None) => return false,
            (Some(one), Some(other)) => {
                if one != other && one != "+" && other != "+" {
                    return false;
                }
            }
        }
    }
}

fn is_wildcard(level: &str) -> bool {
    matches!(level, "+" | "#")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn filters_overlap_if_topic_matches_both() {
        for (one, other, expected) in [
            ("a/+", "+/b", true),
            ("a/+", "b/+", false),
            ("a/+", "a/+/c", false),
            ("a/#", "a/+/c", true),
            ("a/#", "a", false),
            ("a/#", "+", true),
            ("#", "a/+", true),
            ("a/+", "a/b", false),
        ] {
            assert_eq!(overlap_by_wildcards(one, other), expected, "{one} {other}");
            assert_eq!(overlap_by_wildcards(other, one), expected, "{other} {one}");
        }
    }
}
