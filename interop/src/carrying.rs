//! Bridges carry each kind of message on a thread of its own, and take messages only of their own time.

use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::thread;
use std::time::{Duration, SystemTime};

/// Carries messages of one kind until the bridge is closed.
pub(crate) type Carry<'a, E> = Box<dyn Fn() -> Result<(), E> + Send + 'a>;

/// Runs all at a time until one ends, which closes the others. A panic goes on here, so that the program does not end as if
/// all were well.
pub(crate) fn until_one_ends<E: Send>(carry: Vec<Carry<'_, E>>, close: impl Fn() + Sync) -> Result<(), E> {
    let close = &close;
    thread::scope(|scope| {
        let begin = |carry: Carry<'_, E>| {
            let ended = catch_unwind(AssertUnwindSafe(carry));
            close();
            ended.unwrap_or_else(|panic| resume_unwind(panic))
        };
        let threads: Vec<_> = carry.into_iter().map(|carry| scope.spawn(move || begin(carry))).collect();
        let ended = threads.into_iter().map(|thread| thread.join().unwrap_or_else(|panic| resume_unwind(panic)));
        ended.fold(Ok(()), Result::and)
    })
}

/// True if a time differs by this much from this machine's at most.
pub(crate) fn is_within(time: SystemTime, difference: Duration) -> bool {
    let earlier = SystemTime::now().duration_since(time);
    earlier.unwrap_or_else(|later| later.duration()) <= difference
}

#[cfg(test)]
mod tests {
    #![allow(clippy::panic)]

    use std::sync::atomic::{AtomicBool, Ordering};

    use super::*;

    #[test]
    fn a_panic_ends_all_threads_and_is_no_orderly_end() {
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
        assert_eq!(until_one_ends(vec![Box::new(wait), Box::new(wait), Box::new(refuse)], close), Err("refused"));
    }
}
