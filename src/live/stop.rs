//! End of the service, told to all threads.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use parking_lot::{Condvar, Mutex};

/// A flag that ends the service. Setting it also ends pauses.
#[derive(Debug, Default)]
pub(super) struct Stop {
    set: AtomicBool,
    lock: Mutex<()>,
    bell: Condvar,
}

impl Stop {
    pub(super) fn is_set(&self) -> bool {
        self.set.load(Ordering::Acquire)
    }

    pub(super) fn set(&self) {
        self.set.store(true, Ordering::Release);
        // a thread between its look at the flag and its pause holds the lock
        drop(self.lock.lock());
        self.bell.notify_all();
    }

    /// Pauses, at most until the flag is set.
    pub(super) fn wait(&self, pause: Duration) {
        let mut guard = self.lock.lock();
        self.bell.wait_while_for(&mut guard, |()| !self.is_set(), pause);
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::time::Instant;

    use super::*;

    #[test]
    fn a_pause_ends_with_the_stop() {
        let stop = Arc::new(Stop::default());
        let other = Arc::clone(&stop);
        let begin = Instant::now();
        let waiting = std::thread::spawn(move || other.wait(Duration::from_secs(60)));
        stop.set();
        waiting.join().unwrap();
        assert!(begin.elapsed() < Duration::from_secs(30));
        stop.wait(Duration::from_secs(60));
    }
}
