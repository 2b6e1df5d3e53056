//! A channel of one value: a new value replaces a value that was not taken.

use std::sync::{Mutex, MutexGuard, PoisonError};

use tokio::sync::Notify;

/// Hands the latest value from a producing thread to one consumer, and counts replaced values.
#[derive(Debug)]
pub struct LatestSlot<T> {
    state: Mutex<State<T>>,
    changed: Notify,
}

#[derive(Debug)]
struct State<T> {
    value: Option<T>,
    skipped: u64,
    closed: bool,
}

impl<T> Default for LatestSlot<T> {
    fn default() -> Self {
        Self {
            state: Mutex::new(State {
                value: None,
                skipped: 0,
                closed: false,
            }),
            changed: Notify::new(),
        }
    }
}

impl<T> LatestSlot<T> {
    /// Stores a value. A previous value that was not taken is dropped and counted as skipped.
    pub fn put(&self, value: T) {
        let mut state = self.lock();
        state.skipped += u64::from(state.value.replace(value).is_some());
        drop(state);
        self.changed.notify_one();
    }

    /// Ends the channel. A value that was not taken can still be taken.
    pub fn close(&self) {
        self.lock().closed = true;
        self.changed.notify_one();
    }

    /// Waits for the latest value and takes it; `None` once the channel is closed and empty.
    /// Cancelling the wait does not lose a value.
    pub async fn take(&self) -> Option<T> {
        loop {
            if let Some(value) = self.try_take() {
                return Some(value);
            }
            if self.lock().closed {
                return self.try_take();
            }
            self.changed.notified().await;
        }
    }

    /// Takes the latest value, if there is one.
    pub fn try_take(&self) -> Option<T> {
        self.lock().value.take()
    }

    /// Number of replaced values.
    pub fn skipped(&self) -> u64 {
        self.lock().skipped
    }

    fn lock(&self) -> MutexGuard<'_, State<T>> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;

    #[tokio::test]
    async fn latest_value_replaces_counted_others() {
        let slot = LatestSlot::default();
        (1..=4).for_each(|value| slot.put(value));
        assert_eq!(slot.take().await, Some(4));
        assert_eq!(slot.skipped(), 3);
        slot.put(5);
        slot.close();
        assert_eq!((slot.take().await, slot.take().await), (Some(5), None));
        assert_eq!(slot.skipped(), 3);
    }

    #[tokio::test]
    async fn waiting_consumer_is_woken() {
        let slot = Arc::new(LatestSlot::default());
        let waiting = tokio::spawn({
            let slot = Arc::clone(&slot);
            async move { slot.take().await }
        });
        tokio::task::yield_now().await;
        std::thread::spawn(move || slot.put("frame"))
            .join()
            .unwrap();
        assert_eq!(waiting.await.unwrap(), Some("frame"));
    }
}
