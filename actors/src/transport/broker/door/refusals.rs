//! Refusals of what programs publish, told to the program, to whoever asks, and to the operator.

use std::collections::BTreeMap;
use std::time::Duration;

use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::wire::{ClientRefusal, ClientRefusals, RejectReason, SCHEMA_VERSION};
use rmqtt::codec::v5::PublishAckReason;
use rmqtt::types::{PublishAclResult, PublishResult};

use crate::telemetry::counters::ShedReason;

/// The refusal of one message.
#[derive(Debug)]
pub(in crate::transport::broker) struct Refusal {
    pub(super) reason: RefusalReason,
    /// The fault and its remedy.
    pub(super) text: String,
}

/// Kind of a refusal, by which it is counted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum RefusalReason {
    Rejected(RejectReason),
    Throttled,
}

impl Refusal {
    pub(in crate::transport::broker) fn not_permitted(text: impl Into<String>) -> Self {
        Self { reason: RefusalReason::Rejected(RejectReason::NotPermitted), text: text.into() }
    }

    /// The answer to the program; MQTT 3.1.1 has none but an acknowledgement.
    pub(in crate::transport::broker) fn answer(&self) -> PublishAclResult {
        let code = match self.reason {
            RefusalReason::Throttled => PublishAckReason::QuotaExceeded,
            RefusalReason::Rejected(RejectReason::NotPermitted) => PublishAckReason::NotAuthorized,
            RefusalReason::Rejected(_) => PublishAckReason::PayloadFormatInvalid,
        };
        PublishAclResult(PublishResult::reason_code(code, Some(self.text.as_str().into()), false))
    }
}

impl RefusalReason {
    fn as_str(self) -> &'static str {
        match self {
            Self::Rejected(reason) => reason.as_str(),
            Self::Throttled => ShedReason::ReportThrottled.as_str(),
        }
    }
}

/// Refusals so far, by client and reason.
#[derive(Debug, Default)]
pub(super) struct Refusals {
    known: BTreeMap<(String, RefusalReason), ClientRefusal>,
    shown_at: Option<Timestamp>,
}

/// Clients and reasons that are shown; the first ones stay.
const MAX_SHOWN: usize = 32;

/// Minimum time between two statuses for more of the same.
const SHOW_INTERVAL: Duration = Duration::from_secs(1);

impl Refusals {
    /// Notes a refusal; the status if it is to be published now.
    pub(super) fn note(
        &mut self,
        node: &NodeName,
        (client, topic): (&str, &str),
        refusal: &Refusal,
        now: Timestamp,
    ) -> Option<Vec<u8>> {
        let key = (client.to_owned(), refusal.reason);
        let is_first = !self.known.contains_key(&key);
        if is_first && self.known.len() >= MAX_SHOWN {
            return None;
        }
        let (client, reason) = (client.to_owned(), refusal.reason.as_str().to_owned());
        let empty = || ClientRefusal { client, reason, topic: String::new(), text: String::new(), times: 0 };
        let refused = self.known.entry(key).or_insert_with(empty);
        refused.times += 1;
        (refused.topic, refused.text) = (topic.to_owned(), refusal.text.clone());
        if !is_first && self.shown_at.is_some_and(|shown_at| now.since(shown_at) < SHOW_INTERVAL) {
            return None;
        }
        self.shown_at = Some(now);
        let refused = self.known.values().cloned().collect();
        serde_json::to_vec(&ClientRefusals { schema: SCHEMA_VERSION, node: node.clone(), refused }).ok()
    }
}
