//! Drivers can hang where no time-out can be given: while a camera is opened or closed. Both happen in a thread of their
//! own, which is left behind when it takes too long; until it ends, the same camera is not touched again, so that no
//! more than one thread per camera can ever be lost.

use std::{
    collections::BTreeSet,
    sync::{Mutex, PoisonError, mpsc},
    thread,
    time::Duration,
};

/// Cameras that a thread is at work on.
static AT_WORK: Mutex<BTreeSet<String>> = Mutex::new(BTreeSet::new());

/// Why there is no answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Stalled {
    /// It takes longer than the patience.
    Late,
    /// An earlier piece of work on the same camera has not ended.
    Still,
    /// It panicked, or no thread is to be had.
    Failed,
}

/// Takes a name off the list, also when the work panics.
struct Mark(String);

impl Drop for Mark {
    fn drop(&mut self) {
        AT_WORK.lock().unwrap_or_else(PoisonError::into_inner).remove(&self.0);
    }
}

/// Does `work` on the camera `name` in another thread and waits at most `patience` for its answer. What comes later is dropped.
pub(super) fn within<T: Send + 'static>(
    name: &str,
    patience: Duration,
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<T, Stalled> {
    if !AT_WORK.lock().unwrap_or_else(PoisonError::into_inner).insert(name.to_owned()) {
        return Err(Stalled::Still);
    }
    let mark = Mark(name.to_owned());
    let (sender, answer) = mpsc::sync_channel(1);
    let worker = move || {
        let done = work();
        // whoever gets the answer may touch the camera at once
        drop(mark);
        drop(sender.send(done));
    };
    thread::Builder::new().name("driver".to_owned()).spawn(worker).map_err(|_| Stalled::Failed)?;
    answer.recv_timeout(patience).map_err(|e| match e {
        mpsc::RecvTimeoutError::Timeout => Stalled::Late,
        mpsc::RecvTimeoutError::Disconnected => Stalled::Failed,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const LONG: Duration = Duration::from_secs(20);
    const SHORT: Duration = Duration::from_millis(10);

    #[test]
    fn what_hangs_is_left_behind_once_and_only_once() {
        let (go, wait) = mpsc::channel::<()>();
        let hang = move || wait.recv().unwrap_or_default();
        assert_eq!(within("hangs", SHORT, hang), Err(Stalled::Late));
        assert_eq!(within("hangs", LONG, || ()), Err(Stalled::Still));
        assert_eq!(within("another", LONG, || 7), Ok(7));
        go.send(()).unwrap();
        while within("hangs", LONG, || ()) == Err(Stalled::Still) {
            thread::sleep(SHORT);
        }
    }

    #[test]
    fn a_panic_is_an_answer() {
        assert_eq!(within("panics", LONG, || panic!("driver")), Err::<(), _>(Stalled::Failed));
        while within("panics", LONG, || ()) == Err(Stalled::Still) {
            thread::sleep(SHORT);
        }
    }
}
