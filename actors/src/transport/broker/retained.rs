//! Retained messages of the embedded broker, in memory; rmqtt's own default drops them.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use async_trait::async_trait;
use bytes::Bytes;
use rmqtt::retain::{DefaultRetainStorage, RetainStorage};
use rmqtt::types::{Retain, TopicFilter, TopicName};
use tokio::sync::Mutex;

use super::BrokerConfig;
use super::permissions::is_topic_bounded;
use crate::transport::pki::OBSERVER_MARK;

/// Retained messages, bounded in number and in bytes.
pub(super) struct RetainedMessages {
    storage: DefaultRetainStorage,
    index: Mutex<RetainedIndex>,
}

impl RetainedMessages {
    pub(super) fn new(config: &BrokerConfig) -> Self {
        let index = RetainedIndex {
            entries: BTreeMap::new(),
            bytes: 0,
            max_topics: config.max_retained,
            max_bytes: config.max_retained_bytes,
            pruned_at: None,
        };
        Self {
            storage: DefaultRetainStorage::new(),
            index: Mutex::new(index),
        }
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

    // `_listener_expiry` is for queued messages. A retained status is valid until it is replaced,
    // or until the expiry that its publisher set (MQTT 5).
    async fn set(
        &self,
        topic: &TopicName,
        mut message: Retain,
        _listener_expiry: Option<Duration>,
    ) -> rmqtt::Result<()> {
        // A copy: the received bytes are part of a larger buffer, and count as in flight.
        message.publish.payload = Bytes::copy_from_slice(&message.publish.payload);
        let properties = message.publish.properties.as_ref();
        let expiry = properties
            .and_then(|p| p.message_expiry_interval)
            .map(|s| Duration::from_secs(s.get().into()));
        let now = Instant::now();
        let bytes = message.publish.payload.len();
        let mut index = self.index.lock().await;
        let has_room = is_topic_bounded(topic)
            && (bytes == 0 || index.insert(topic, bytes, expiry.map(|expiry| now + expiry), now));
        let has_pruned = index.pruned_at == Some(now);
        if has_pruned {
            self.storage.remove_expired_messages().await;
        }
        if !has_room {
            // Not for each message: a flood must not fill the log.
            if has_pruned {
                tracing::warn!(%topic, bytes, "retained messages refused");
            }
            return Ok(());
        }
        if bytes == 0 {
            index.remove(topic);
        }
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

/// Maximum observers of one certificate whose statuses are retained.
const MAX_OBSERVERS: usize = 64;

/// Minimum time between two searches for expired messages.
const PRUNE_INTERVAL: Duration = Duration::from_secs(1);

/// Bytes and expiry of each retained topic.
#[derive(Debug)]
struct RetainedIndex {
    entries: BTreeMap<String, (usize, Option<Instant>)>,
    bytes: usize,
    max_topics: usize,
    max_bytes: usize,
    pruned_at: Option<Instant>,
}

impl RetainedIndex {
    /// Records a message in place of its topic's last; false if there is no room.
    fn insert(&mut self, topic: &str, bytes: usize, until: Option<Instant>, now: Instant) -> bool {
        if !self.has_room(topic, bytes)
            && self
                .pruned_at
                .is_none_or(|pruned_at| now.duration_since(pruned_at) >= PRUNE_INTERVAL)
        {
            self.pruned_at = Some(now);
            self.entries
                .retain(|_, (_, until)| until.is_none_or(|until| until > now));
            self.bytes = self.entries.values().map(|(bytes, _)| bytes).sum();
        }
        let has_room = self.has_room(topic, bytes);
        if has_room {
            self.remove(topic);
            self.entries.insert(topic.to_owned(), (bytes, until));
            self.bytes += bytes;
        }
        has_room
    }

    fn remove(&mut self, topic: &str) {
        self.bytes -= self.entries.remove(topic).map_or(0, |(bytes, _)| bytes);
    }

    fn has_room(&self, topic: &str, bytes: usize) -> bool {
        let before = self.entries.get(topic).map(|(bytes, _)| bytes);
        let is_crowded = || {
            self.entries.len() >= self.max_topics || self.observers_beside(topic) >= MAX_OBSERVERS
        };
        self.bytes - before.unwrap_or(&0) + bytes <= self.max_bytes
            && (before.is_some() || !is_crowded())
    }

    /// Number of topics of observers that share a certificate with this topic's observer.
    fn observers_beside(&self, topic: &str) -> usize {
        let name = topic.rfind('/').map_or(0, |slash| slash + 1);
        let mark = topic.get(name..).and_then(|name| name.find(OBSERVER_MARK));
        let Some(principal) = mark.and_then(|mark| topic.get(..name + mark + OBSERVER_MARK.len()))
        else {
            return 0;
        };
        self.entries
            .range(principal.to_owned()..)
            .take_while(|(topic, _)| topic.starts_with(principal))
            .count()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn index(max_topics: usize, max_bytes: usize) -> RetainedIndex {
        RetainedIndex {
            entries: BTreeMap::new(),
            bytes: 0,
            max_topics,
            max_bytes,
            pruned_at: None,
        }
    }

    #[test]
    fn retained_topics_are_bounded() {
        let mut index = index(2, 100);
        let now = Instant::now();
        assert!(
            index.insert("a", 60, None, now) && !index.insert("b", 50, None, now),
            "bytes"
        );
        assert!(
            index.insert("a", 100, None, now) && index.insert("a", 50, None, now),
            "in its own place"
        );
        assert!(
            index.insert("b", 50, None, now) && !index.insert("c", 0, None, now),
            "topics"
        );
        index.remove("a");
        assert!(index.insert("c", 50, None, now));
        assert_eq!(index.bytes, 100);
    }

    #[test]
    fn what_has_expired_makes_room() {
        let mut index = index(1, 100);
        let now = Instant::now();
        let second = Duration::from_secs(1);
        assert!(
            index.insert("a", 100, Some(now + second), now) && !index.insert("b", 1, None, now)
        );
        assert!(index.insert("b", 1, None, now + 2 * second));
    }

    #[test]
    fn one_certificate_cannot_fill_topics() {
        let mut index = index(1000, 1000);
        let now = Instant::now();
        let entries = (0..200)
            .filter(|n| index.insert(&format!("c--1/nodes/gauss--{n}"), 1, None, now))
            .count();
        assert_eq!(entries, MAX_OBSERVERS);
        for other in [
            "c--1/nodes/gauss",
            "c--1/nodes/euclid",
            "c--1/nodes/euclid--top",
        ] {
            assert!(index.insert(other, 1, None, now), "{other}");
        }
    }
}
