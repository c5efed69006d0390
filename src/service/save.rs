//! Results go to disk in a thread of their own: a slow or full disk never holds the live view up.

use std::path::PathBuf;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use serde_json::json;

use super::hub::{Hub, Shown};
use crate::output::{self, OutputError};

/// Pause between two writings of the newest result.
const EVERY: Duration = Duration::from_secs(2);

#[derive(Debug, Default)]
struct Waiting {
    /// To be written into a folder of its own.
    kept: Option<Arc<Shown>>,
    /// The newest result, to be written into the output folder.
    newest: Option<Arc<Shown>>,
    closed: bool,
}

/// The way from the solver to the disk.
#[derive(Debug, Default)]
pub(super) struct Saver {
    waiting: Mutex<Waiting>,
    bell: Condvar,
}

impl Saver {
    fn lock(&self) -> MutexGuard<'_, Waiting> {
        // each field is replaced as a whole
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Hands a result over. With `keep` it gets a folder of its own, and this waits until the one before is written.
    pub(super) fn offer(&self, hub: &Hub, shown: &Arc<Shown>, keep: bool) {
        let mut waiting = self.lock();
        waiting.newest = Some(Arc::clone(shown));
        while keep && waiting.kept.is_some() && !hub.stop.is_set() {
            waiting = self.bell.wait_timeout(waiting, EVERY / 10).unwrap_or_else(PoisonError::into_inner).0;
        }
        if keep {
            waiting.kept = Some(Arc::clone(shown));
        }
        drop(waiting);
        self.bell.notify_all();
    }

    /// Takes back the newest result, if it is not being written yet: one that is newer will be offered.
    pub(super) fn withdraw(&self) {
        self.lock().newest = None;
    }

    /// Lets [`Self::run`] write what waits and end.
    pub(super) fn close(&self) {
        self.lock().closed = true;
        self.bell.notify_all();
    }

    /// Writes until closed: the first result at once, later ones at a bounded rate, the last one before it ends.
    ///
    /// # Errors
    /// What the last attempt failed with. Those before were reported and, once the disk takes files again, made good.
    pub(super) fn run(&self, hub: &Hub) -> Result<(), OutputError> {
        let mut last: Result<(), OutputError> = Ok(());
        let mut due = Instant::now();
        let mut written = None;
        loop {
            let mut waiting = self.lock();
            let job = loop {
                if let Some(kept) = waiting.kept.take() {
                    break Some((kept, true));
                }
                if waiting.closed || Instant::now() >= due {
                    let fresh = waiting.newest.take().filter(|shown| written != Some(shown.index));
                    if let Some(shown) = fresh {
                        break Some((shown, false));
                    }
                    if waiting.closed {
                        break None;
                    }
                }
                waiting = self.bell.wait_timeout(waiting, EVERY / 10).unwrap_or_else(PoisonError::into_inner).0;
            };
            drop(waiting);
            self.bell.notify_all();
            let Some((shown, keep)) = job else { return last };
            let folder = if keep { frame_folder(hub, shown.index) } else { hub.out.clone() };
            if !keep {
                due = Instant::now() + EVERY;
            }
            last = output::write_all(&folder, &shown.images(), &shown.report);
            if !keep && last.is_ok() {
                written = Some(shown.index);
            }
            report(hub, &last);
        }
    }
}

/// Where frame `index` is kept.
fn frame_folder(hub: &Hub, index: u64) -> PathBuf {
    hub.out.join(format!("frame-{index:06}"))
}

/// One alarm when saving stops, one line when it goes on.
fn report(hub: &Hub, outcome: &Result<(), OutputError>) {
    let mut figures = hub.figures();
    let saving = &mut figures.saving;
    let (turned, reason) = match outcome {
        Ok(()) => {
            saving.written += 1;
            (saving.fault.take().is_some(), None)
        }
        Err(e) => {
            saving.failed += 1;
            (saving.fault.replace(e.to_string()).is_none(), Some(e.to_string()))
        }
    };
    drop(figures);
    match reason {
        _ if !turned => {}
        Some(reason) => {
            tracing::error!("results are not saved, the live view goes on: {reason}");
            hub.events.emit("saving-stopped", json!({ "reason": reason }));
        }
        None => {
            tracing::info!("{}: results are saved again", hub.out.display());
            hub.events.emit("saving-resumed", json!({}));
        }
    }
}
