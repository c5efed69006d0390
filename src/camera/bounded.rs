//! Time limits for driver calls that take no time-out of their own: opening and closing a camera.
//!
//! Such a call runs in a thread of its own, which is abandoned when it takes too long. The same camera is not touched again until
//! that thread ends, so at most one thread per camera can be lost.

use std::{
    collections::BTreeSet,
    sync::{Mutex, PoisonError, mpsc},
    thread,
    time::Duration,
};

/// Cameras with a driver call in progress.
static BUSY: Mutex<BTreeSet<String>> = Mutex::new(BTreeSet::new());

/// Reason why a driver call has no result.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum CallError {
    /// The call exceeds its time limit.
    TimedOut,
    /// An earlier call on the same camera has not ended.
    Busy,
    /// The call panicked, or no thread could be started.
    Failed,
}

/// Removes a camera from [`BUSY`] when dropped, also after a panic.
struct BusyGuard(String);

impl Drop for BusyGuard {
    fn drop(&mut self) {
        BUSY.lock().unwrap_or_else(PoisonError::into_inner).remove(&self.0);
    }
}

/// Runs `call` on the camera `name` in another thread and waits at most `limit` for its result. A later result is dropped.
pub(super) fn within<T: Send + 'static>(
    name: &str,
    limit: Duration,
    call: impl FnOnce() -> T + Send + 'static,
) -> Result<T, CallError> {
    if !BUSY.lock().unwrap_or_else(PoisonError::into_inner).insert(name.to_owned()) {
        return Err(CallError::Busy);
    }
    let guard = BusyGuard(name.to_owned());
    let (sender, result) = mpsc::sync_channel(1);
    let worker = move || {
        let done = call();
        // the receiver may touch the camera at once
        drop(guard);
        drop(sender.send(done));
    };
    thread::Builder::new().name("driver".to_owned()).spawn(worker).map_err(|_| CallError::Failed)?;
    result.recv_timeout(limit).map_err(|e| match e {
        mpsc::RecvTimeoutError::Timeout => CallError::TimedOut,
        mpsc::RecvTimeoutError::Disconnected => CallError::Failed,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const LONG: Duration = Duration::from_secs(20);
    const SHORT: Duration = Duration::from_millis(10);

    #[test]
    fn a_call_that_hangs_is_abandoned_only_once() {
        let (go, wait) = mpsc::channel::<()>();
        let hang = move || wait.recv().unwrap_or_default();
        assert_eq!(within("hangs", SHORT, hang), Err(CallError::TimedOut));
        assert_eq!(within("hangs", LONG, || ()), Err(CallError::Busy));
        assert_eq!(within("another", LONG, || 7), Ok(7));
        go.send(()).unwrap();
        while within("hangs", LONG, || ()) == Err(CallError::Busy) {
            thread::sleep(SHORT);
        }
    }

    #[test]
    fn a_panic_is_an_error() {
        assert_eq!(within("panics", LONG, || panic!("driver")), Err::<(), _>(CallError::Failed));
        while within("panics", LONG, || ()) == Err(CallError::Busy) {
            thread::sleep(SHORT);
        }
    }
}
