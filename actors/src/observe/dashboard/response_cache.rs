//! What is made once for all who ask for it.

use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use tokio::time::Instant;

/// Keeps what was made until it is old enough for the next, so that making it takes a small share of a core at most,
/// however many ask and however large it is.
#[derive(Debug)]
pub(crate) struct ResponseCache<T> {
    least_pause: Duration,
    made: Mutex<Option<CachedResponse<T>>>,
}

/// What was made.
#[derive(Debug, Clone)]
pub(crate) struct CachedResponse<T> {
    pub(crate) value: T,
    /// When it is old enough for the next.
    pub(crate) next: Instant,
}

/// Pauses are at least so many times as long as making took.
const PAUSE_FACTOR: u32 = 20;

impl<T: Clone> ResponseCache<T> {
    pub(crate) fn new(least_pause: Duration) -> Self {
        Self { least_pause, made: Mutex::default() }
    }

    /// What was made last, or anew when that is old enough.
    pub(crate) fn get(&self, make: impl FnOnce() -> T) -> CachedResponse<T> {
        let mut kept = self.made.lock().unwrap_or_else(PoisonError::into_inner);
        let begun = Instant::now();
        if let Some(made) = kept.as_ref().filter(|made| begun < made.next) {
            return made.clone();
        }
        let value = make();
        let next = Instant::now() + self.least_pause.max(begun.elapsed() * PAUSE_FACTOR);
        kept.insert(CachedResponse { value, next }).clone()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_fresh_or_was_costly_is_not_made_again() {
        let mut made = 0;
        let mut ask = |response_cache: &ResponseCache<u32>, cost: Duration| {
            let make = || {
                std::thread::sleep(cost);
                made += 1;
                made
            };
            response_cache.get(make).value
        };
        let fresh = ResponseCache::new(Duration::from_secs(3600));
        assert_eq!([ask(&fresh, Duration::ZERO), ask(&fresh, Duration::ZERO)], [1, 1]);
        let costly = ResponseCache::new(Duration::ZERO);
        assert_eq!([ask(&costly, Duration::from_millis(200)), ask(&costly, Duration::ZERO)], [2, 2]);
    }
}
