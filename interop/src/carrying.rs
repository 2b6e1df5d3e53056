//! Common parts of bridges. A bridge transfers each kind of message on its own thread, and accepts
//! only messages with a current time. Refused messages are counted; the first of each kind is
//! logged, then increasingly fewer.

use std::collections::{BTreeMap, BTreeSet};
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::{Duration, SystemTime};

/// Transfers messages of one kind until the bridge is closed.
pub(crate) type Carry<'a, E> = Box<dyn Fn() -> Result<(), E> + Send + 'a>;

/// Runs all functions in parallel until one ends, which closes the others. A panic is propagated,
/// so that the program does not end successfully.
pub(crate) fn until_one_ends<E: Send>(
    carry: Vec<Carry<'_, E>>,
    close: impl Fn() + Sync,
) -> Result<(), E> {
    let close = &close;
    thread::scope(|scope| {
        let begin = |carry: Carry<'_, E>| {
            let ended = catch_unwind(AssertUnwindSafe(carry));
            close();
            ended.unwrap_or_else(|panic| resume_unwind(panic))
        };
        let threads: Vec<_> = carry
            .into_iter()
            .map(|carry| scope.spawn(move || begin(carry)))
            .collect();
        let ended = threads
            .into_iter()
            .map(|thread| thread.join().unwrap_or_else(|panic| resume_unwind(panic)));
        ended.fold(Ok(()), Result::and)
    })
}

/// True if a time differs from this machine's by at most `difference`.
pub(crate) fn is_within(time: SystemTime, difference: Duration) -> bool {
    let earlier = SystemTime::now().duration_since(time);
    earlier.unwrap_or_else(|later| later.duration()) <= difference
}

/// The value guarded by a mutex, even after a panic in another thread.
pub(crate) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Numbers of refused messages, by kind.
pub(crate) struct RefusalCounts<K>(Mutex<BTreeMap<K, u64>>);

impl<K> Default for RefusalCounts<K> {
    fn default() -> Self {
        Self(Mutex::default())
    }
}

impl<K: Clone + Ord> RefusalCounts<K> {
    /// Maximum number of kinds that are counted separately.
    const MAX_KINDS: usize = 256;

    /// Counts one message; beyond [`Self::MAX_KINDS`], as one of `rest`. Returns kind and count for
    /// the log if the count is a power of ten.
    pub(crate) fn record(&self, kind: K, rest: K) -> Option<(K, u64)> {
        let mut counts = lock(&self.0);
        let has_room = counts.len() < Self::MAX_KINDS || counts.contains_key(&kind);
        let kind = if has_room { kind } else { rest };
        let count = counts.entry(kind.clone()).or_default();
        *count += 1;
        let is_reported = 10u64.pow(count.ilog10()) == *count;
        is_reported.then_some((kind, *count))
    }

    pub(crate) fn counts(&self) -> BTreeMap<K, u64> {
        lock(&self.0).clone()
    }
}

/// Names of current failures: each is logged once, until it is over.
#[derive(Default)]
pub(crate) struct Failures(Mutex<BTreeSet<String>>);

impl Failures {
    /// True if this failure is new.
    pub(crate) fn begins(&self, name: &str) -> bool {
        lock(&self.0).insert(name.to_owned())
    }

    pub(crate) fn ends(&self, name: &str) {
        lock(&self.0).remove(name);
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::panic)]

    use std::sync::atomic::{AtomicBool, Ordering};

    use super::*;

    #[test]
    fn panic_ends_all_threads() {
        let is_closed = AtomicBool::new(false);
        let wait = || {
            while !is_closed.load(Ordering::Relaxed) {
                thread::yield_now();
            }
            Ok(())
        };
        let close = || is_closed.store(true, Ordering::Relaxed);
        let fall = || -> Result<(), &str> { panic!("a thread fell") };
        let begin = || until_one_ends(vec![Box::new(wait), Box::new(fall), Box::new(wait)], close);
        assert!(catch_unwind(AssertUnwindSafe(begin)).is_err());
        is_closed.store(false, Ordering::Relaxed);
        let refuse = || Err("refused");
        assert_eq!(
            until_one_ends(
                vec![Box::new(wait), Box::new(wait), Box::new(refuse)],
                close
            ),
            Err("refused")
        );
    }

    #[test]
    fn refusals_log_powers_of_ten() {
        let refusals = RefusalCounts::default();
        let logged: Vec<_> = (0..1000)
            .chain(0..1000)
            .filter_map(|kind| refusals.record(kind, 9999))
            .collect();
        let first = (0..256).map(|kind| (kind, 1));
        assert_eq!(
            logged,
            first
                .chain([1, 10, 100, 1000].map(|count| (9999, count)))
                .collect::<Vec<_>>()
        );
        let counts = refusals.counts();
        assert_eq!(
            (counts.values().sum::<u64>(), counts.len(), counts[&9999]),
            (2000, 257, 1488)
        );
    }

    #[test]
    fn failure_is_reported_once() {
        let failures = Failures::default();
        let begins = |name| [failures.begins(name), failures.begins(name)];
        assert_eq!((begins("a"), begins("b")), ([true, false], [true, false]));
        failures.ends("a");
        assert_eq!((begins("a"), begins("b")), ([true, false], [false, false]));
    }
}
