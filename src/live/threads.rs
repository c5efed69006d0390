//! Threads of the service: how they are started and how they end.

use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use super::options::ServiceError;
use crate::Error;

/// Bytes of a thread's stack.
pub(super) const STACK: usize = 512 << 10;
/// Bytes of all stacks that a service may have: two of capture, two of simulated cameras, machine, events, encoder, preview and its
/// waits for the disk, save, record, solver and its team.
pub(super) const STACKS: usize = 19 * STACK;
/// Pause between two looks whether a thread has ended.
const PACE: Duration = Duration::from_millis(5);

/// Starts a thread.
///
/// # Errors
/// [`ServiceError::Thread`].
pub(super) fn spawn<T: Send + 'static>(
    name: &'static str,
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<JoinHandle<T>, ServiceError> {
    let builder = thread::Builder::new().name(name.to_owned()).stack_size(STACK);
    builder.spawn(work).map_err(|source| ServiceError::Thread { name, source })
}

/// Waits for a thread's end, at most until `deadline`; none when it does not end: a driver that hangs must not hang the program.
///
/// # Errors
/// [`Error::Internal`] when the thread panicked.
pub(super) fn join<T>(thread: JoinHandle<T>, deadline: Instant, name: &str) -> Result<Option<T>, Error> {
    while !thread.is_finished() {
        if Instant::now() > deadline {
            tracing::warn!("the {name} thread does not end and is left behind");
            return Ok(None);
        }
        thread::sleep(PACE);
    }
    thread.join().map(Some).map_err(|_| Error::Internal(format!("the {name} thread panicked")))
}
