//! A response that is computed once for all clients.

use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use tokio::time::Instant;

/// Keeps a response until it expires. Computing it takes at most a small share of a core,
/// independent of the number of clients.
#[derive(Debug)]
pub(crate) struct ResponseCache<T> {
    min_age: Duration,
    cached: Mutex<Option<CachedResponse<T>>>,
}

#[derive(Debug, Clone)]
pub(crate) struct CachedResponse<T> {
    pub(crate) value: T,
    pub(crate) expires_at: Instant,
}

/// Minimum age at which a response is replaced, as a multiple of the time that it took to compute.
const AGE_PER_COST: u32 = 20;

impl<T: Clone> ResponseCache<T> {
    pub(crate) fn new(min_age: Duration) -> Self {
        Self {
            min_age,
            cached: Mutex::default(),
        }
    }

    /// The cached response, or a new one if it has expired.
    pub(crate) fn get(&self, compute: impl FnOnce() -> T) -> CachedResponse<T> {
        let mut cached = self.cached.lock().unwrap_or_else(PoisonError::into_inner);
        let begun = Instant::now();
        if let Some(response) = cached
            .as_ref()
            .filter(|response| begun < response.expires_at)
        {
            return response.clone();
        }
        let value = compute();
        let expires_at = Instant::now() + self.min_age.max(begun.elapsed() * AGE_PER_COST);
        cached.insert(CachedResponse { value, expires_at }).clone()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fresh_or_costly_response_reused() {
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
        assert_eq!(
            [ask(&fresh, Duration::ZERO), ask(&fresh, Duration::ZERO)],
            [1, 1]
        );
        let costly = ResponseCache::new(Duration::ZERO);
        assert_eq!(
            [
                ask(&costly, Duration::from_millis(200)),
                ask(&costly, Duration::ZERO)
            ],
            [2, 2]
        );
    }
}
