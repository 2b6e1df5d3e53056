//! Waiting for a condition, with a deadline.

use std::time::Duration;

use tokio::time::{Instant, sleep, timeout};

/// Time for any step, on a machine that runs other tests at once.
pub const PATIENCE: Duration = Duration::from_secs(60);

/// Waits until the condition holds. The result is the time that it took.
///
/// # Panics
/// Panics if the condition does not hold within [`PATIENCE`].
pub async fn until(what: &str, mut holds: impl FnMut() -> bool) -> Duration {
    let started = Instant::now();
    while !holds() {
        assert!(
            started.elapsed() < PATIENCE,
            "not within the time limit: {what}"
        );
        sleep(Duration::from_millis(10)).await;
    }
    started.elapsed()
}

/// Like [`until`], for a condition that itself waits, such as a request.
///
/// # Panics
/// Panics if the condition does not hold within [`PATIENCE`].
pub async fn until_async(what: &str, mut holds: impl AsyncFnMut() -> bool) {
    let reached = async {
        while !holds().await {
            sleep(Duration::from_millis(20)).await;
        }
    };
    timeout(PATIENCE, reached)
        .await
        .unwrap_or_else(|_| panic!("not within the time limit: {what}"));
}

/// Like [`until`], for a test without a runtime.
///
/// # Panics
/// Panics if the condition does not hold within [`PATIENCE`].
pub fn until_blocking(what: &str, mut holds: impl FnMut() -> bool) {
    let started = Instant::now();
    while !holds() {
        assert!(
            started.elapsed() < PATIENCE,
            "not within the time limit: {what}"
        );
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// Repeats an action every 20 ms until the condition holds.
///
/// # Panics
/// Panics if the condition does not hold within [`PATIENCE`].
pub async fn until_by(what: &str, mut act: impl FnMut(), mut holds: impl FnMut() -> bool) {
    let started = Instant::now();
    while !holds() {
        assert!(
            started.elapsed() < PATIENCE,
            "not within the time limit: {what}"
        );
        act();
        sleep(Duration::from_millis(20)).await;
    }
}
