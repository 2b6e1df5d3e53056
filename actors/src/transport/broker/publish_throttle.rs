//! Throttle of published messages, by principal rather than by client id.

use std::sync::{Arc, Mutex, PoisonError};

use async_trait::async_trait;
use rmqtt::codec::v5::PublishAckReason;
use rmqtt::context::ServerContext;
use rmqtt::hook::{Handler, HookResult, Parameter, ReturnType, Type};
use rmqtt::types::{PublishAclResult, PublishResult};

use super::principal::{PrincipalRegistry, QuotaKey};
use crate::platform::clock;
use crate::platform::throttle::KeyedThrottle;
use crate::telemetry::counters::{Counters, ShedReason};

/// Hook of rmqtt that drops messages of a node, address or local client above a rate.
pub(super) struct PublishThrottle {
    sources: Mutex<KeyedThrottle<QuotaKey>>,
    principals: PrincipalRegistry,
    counters: Arc<Counters>,
}

impl PublishThrottle {
    pub(super) fn new(
        per_second: u32,
        principals: PrincipalRegistry,
        counters: Arc<Counters>,
    ) -> Self {
        Self {
            sources: Mutex::new(KeyedThrottle::per_second(per_second)),
            principals,
            counters,
        }
    }

    /// Registers the hook for every message, before the permissions.
    pub(super) async fn install(self, context: &ServerContext) {
        let register = context.extends.hook_mgr().register();
        register
            .add_priority(Type::MessagePublishCheckAcl, 1, Box::new(self))
            .await;
        register.start().await;
    }
}

#[async_trait]
impl Handler for PublishThrottle {
    async fn hook(&self, parameter: &Parameter, before: Option<HookResult>) -> ReturnType {
        let Parameter::MessagePublishCheckAcl(session, _) = parameter else {
            return (true, before);
        };
        let source = self
            .principals
            .quota_key(session.id.remote_addr, &session.id.client_id);
        if self
            .sources
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .allow(&source, clock::now())
        {
            return (true, before);
        }
        self.counters
            .shed(ShedReason::BrokerThrottled, source.as_str());
        let text = Some("more than broker.max_messages_hz messages a second".into());
        let refused = PublishResult::reason_code(PublishAckReason::QuotaExceeded, text, false);
        (
            false,
            Some(HookResult::PublishAclResult(PublishAclResult(refused))),
        )
    }
}
