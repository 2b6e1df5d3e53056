//! Retained messages of the embedded broker, in memory; rmqtt's own default drops them.

use std::time::Duration;

use async_trait::async_trait;
use rmqtt::retain::{DefaultRetainStorage, RetainStorage};
use rmqtt::types::{Retain, TopicFilter, TopicName};

/// A bounded number of retained messages.
pub(super) struct RetainedMessages {
    storage: DefaultRetainStorage,
    max_topics: usize,
}

impl RetainedMessages {
    pub(super) fn new(max_topics: usize) -> Self {
        Self { storage: DefaultRetainStorage::new(), max_topics }
    }
}

#[async_trait]
impl RetainStorage for RetainedMessages {
    fn enable(&self) -> bool {
        true
    }

    fn need_sync(&self) -> bool {
        false
    }

    // `_listener_expiry` is the listener's bound on queued messages; a retained status holds until it is replaced,
    // unless its publisher says otherwise (MQTT 5).
    async fn set(&self, topic: &TopicName, message: Retain, _listener_expiry: Option<Duration>) -> rmqtt::Result<()> {
        let full = usize::try_from(self.storage.count().await).is_ok_and(|topics| topics >= self.max_topics);
        if full && !message.publish.payload.is_empty() && self.storage.get_message(topic).await?.is_empty() {
            tracing::warn!(%topic, max_topics = self.max_topics, "retained message refused");
            return Ok(());
        }
        let properties = message.publish.properties.as_ref();
        let expiry = properties.and_then(|p| p.message_expiry_interval).map(|s| Duration::from_secs(s.get().into()));
        self.storage.set_with_timeout(topic, message, expiry).await
    }

    async fn get(&self, filter: &TopicFilter) -> rmqtt::Result<Vec<(TopicName, Retain)>> {
        self.storage.get_message(filter).await
    }

    async fn count(&self) -> isize {
        self.storage.count().await
    }

    async fn max(&self) -> isize {
        self.storage.max().await
    }
}
