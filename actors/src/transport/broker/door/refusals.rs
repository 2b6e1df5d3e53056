//! Refusals of programs' messages, reported to the program, to subscribers, and to the operator.

use std::collections::BTreeMap;
use std::time::Duration;

use ecod::model::names::{NodeName, plain_text};
use ecod::model::time::Timestamp;
use ecod::wire::{ClientRefusal, ClientRefusals, RejectReason, SCHEMA_VERSION};
use rmqtt::codec::v5::PublishAckReason;
use rmqtt::types::{PublishAclResult, PublishResult};

use crate::telemetry::counters::ShedReason;

/// The refusal of one message.
#[derive(Debug)]
pub(in crate::transport::broker) struct DoorRefusal {
    pub(super) reason: RefusalReason,
    /// The fault and its remedy.
    pub(super) text: String,
}

/// Kind of a refusal, for counting.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum RefusalReason {
    Rejected(RejectReason),
    Throttled,
}

/// Maximum length of a refusal's text in bytes: it may quote the program's message, and all
/// subscribers see it.
const MAX_TEXT: usize = 500;

impl DoorRefusal {
    pub(super) fn new(reason: RefusalReason, text: impl AsRef<str>) -> Self {
        Self {
            reason,
            text: plain_text(text.as_ref(), MAX_TEXT),
        }
    }

    pub(in crate::transport::broker) fn not_permitted(text: impl AsRef<str>) -> Self {
        Self::new(RefusalReason::Rejected(RejectReason::NotPermitted), text)
    }

    /// The answer to the program; MQTT 3.1.1 only has an acknowledgement.
    pub(in crate::transport::broker) fn answer(&self) -> PublishAclResult {
        let code = match self.reason {
            RefusalReason::Throttled => PublishAckReason::QuotaExceeded,
            RefusalReason::Rejected(RejectReason::NotPermitted) => PublishAckReason::NotAuthorized,
            RefusalReason::Rejected(RejectReason::UnknownTopic) => {
                PublishAckReason::TopicNameInvalid
            }
            RefusalReason::Rejected(_) => PublishAckReason::PayloadFormatInvalid,
        };
        PublishAclResult(PublishResult::reason_code(
            code,
            Some(self.text.as_str().into()),
            false,
        ))
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
    known: BTreeMap<(String, RefusalReason), (ClientRefusal, Timestamp)>,
    shown_at: Option<Timestamp>,
}

/// Maximum number of clients and reasons that are shown: the latest ones.
const MAX_SHOWN: usize = 32;

/// Maximum length of a client's name in characters, as it is shown.
const MAX_CLIENT: usize = 128;

/// Minimum time between two statuses for repeated refusals.
const SHOW_INTERVAL: Duration = Duration::from_secs(1);

impl Refusals {
    /// Records a refusal; returns the status if it must be published now.
    pub(super) fn record(
        &mut self,
        node: &NodeName,
        client: &str,
        topic: &str,
        refusal: &DoorRefusal,
        now: Timestamp,
    ) -> Option<Vec<u8>> {
        let client: String = client.chars().take(MAX_CLIENT).collect();
        let key = (client.clone(), refusal.reason);
        // Programs that use a new name for each connection may be many: their refusals wait for the
        // next status.
        let has_room = self.known.len() < MAX_SHOWN;
        let is_first = !self.known.contains_key(&key);
        if is_first && !has_room {
            let oldest = self
                .known
                .iter()
                .min_by_key(|(_, (_, at))| *at)
                .map(|(key, _)| key.clone());
            oldest.and_then(|oldest| self.known.remove(&oldest));
        }
        let reason = refusal.reason.as_str().to_owned();
        let empty = || ClientRefusal {
            client,
            reason,
            topic: String::new(),
            text: String::new(),
            times: 0,
        };
        let (refused, at) = self.known.entry(key).or_insert_with(|| (empty(), now));
        refused.times += 1;
        refused.topic = topic.to_owned();
        refused.text = refusal.text.clone();
        *at = now;
        if !(is_first && has_room)
            && self
                .shown_at
                .is_some_and(|shown_at| now.since(shown_at) < SHOW_INTERVAL)
        {
            return None;
        }
        self.shown_at = Some(now);
        let refused = self
            .known
            .values()
            .map(|(refusal, _)| refusal.clone())
            .collect();
        serde_json::to_vec(&ClientRefusals {
            schema: SCHEMA_VERSION,
            node: node.clone(),
            refused,
        })
        .ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shown(refusals: &mut Refusals, client: &str, at_s: u64) -> Option<Vec<String>> {
        let node = NodeName::from_static("euclid");
        let refusal = DoorRefusal::not_permitted("no");
        let status = refusals.record(
            &node,
            client,
            "detections/gauss",
            &refusal,
            Timestamp(at_s * 1_000_000),
        )?;
        let status: ClientRefusals = serde_json::from_slice(&status).unwrap();
        Some(
            status
                .refused
                .into_iter()
                .map(|refusal| refusal.client)
                .collect(),
        )
    }

    #[test]
    fn current_offender_is_always_shown() {
        let mut refusals = Refusals::default();
        for n in 0..MAX_SHOWN {
            assert!(
                shown(&mut refusals, &format!("cron-{n:02}"), n as u64).is_some(),
                "the first of each at once"
            );
        }
        assert_eq!(
            shown(&mut refusals, "cron-00", 31),
            None,
            "more of the same wait"
        );
        let clients = shown(&mut refusals, "planner", 33).unwrap();
        assert_eq!(clients.len(), MAX_SHOWN);
        assert!(
            clients.iter().any(|client| client == "planner")
                && clients.iter().any(|client| client == "cron-00")
        );
        assert!(
            !clients.iter().any(|client| client == "cron-01"),
            "the oldest refusal is evicted"
        );
        let quick = (0..100)
            .filter(|n| shown(&mut refusals, &format!("flood-{n}"), 34).is_some())
            .count();
        assert!(quick <= 1, "names without number: {quick} statuses at once");
    }

    #[test]
    fn long_client_text_is_shortened() {
        let refusal = DoorRefusal::not_permitted("é".repeat(100_000));
        assert_eq!(refusal.text.len(), MAX_TEXT);
        assert_eq!(
            DoorRefusal::not_permitted("named\0\n").text,
            "named  ",
            "MQTT forbids the first"
        );
        let mut refusals = Refusals::default();
        let clients = shown(&mut refusals, &"x".repeat(60_000), 0).unwrap();
        assert_eq!(clients[0].len(), MAX_CLIENT);
    }
}
