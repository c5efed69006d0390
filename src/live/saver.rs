//! Saving of results in a thread of its own: a slow or full disk never delays the live view.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use parking_lot::{Condvar, Mutex};
use serde_json::json;

use super::events::Events;
use super::frame::PublishedFrame;
use super::statistics::Statistics;
use super::stop::Stop;
use crate::output::{self, OutputError};

/// Pause between two writings of the newest result.
const EVERY: Duration = Duration::from_secs(2);
/// Pace of the checks for work.
const PACE: Duration = Duration::from_millis(200);

#[derive(Debug, Default)]
struct Waiting {
    /// Result to be written into a folder of its own.
    kept: Option<Arc<PublishedFrame>>,
    /// Newest result, to be written into the output folder.
    newest: Option<Arc<PublishedFrame>>,
    closed: bool,
}

/// A result to be written.
enum Job {
    /// Into a folder of its own.
    Keep(Arc<PublishedFrame>),
    /// Into the output folder, replacing the one before.
    Newest(Arc<PublishedFrame>),
}

/// Queue from the solver to the thread that saves results.
#[derive(Debug)]
pub(super) struct Saver {
    waiting: Mutex<Waiting>,
    bell: Condvar,
    out: PathBuf,
    stop: Arc<Stop>,
    statistics: Arc<Mutex<Statistics>>,
    events: Arc<Events>,
}

impl Saver {
    /// Saves into the folder `out`.
    pub(super) fn new(out: PathBuf, stop: Arc<Stop>, statistics: Arc<Mutex<Statistics>>, events: Arc<Events>) -> Self {
        Self { waiting: Mutex::default(), bell: Condvar::new(), out, stop, statistics, events }
    }

    /// Hands a result over. With `keep` it gets a folder of its own, and this waits until the one before is being written.
    pub(super) fn offer(&self, frame: &Arc<PublishedFrame>, keep: bool) {
        let mut waiting = self.waiting.lock();
        waiting.newest = Some(Arc::clone(frame));
        while keep && waiting.kept.is_some() && !self.stop.is_set() {
            self.bell.wait_for(&mut waiting, PACE);
        }
        if keep {
            waiting.kept = Some(Arc::clone(frame));
        }
        drop(waiting);
        self.bell.notify_all();
    }

    /// Takes back the newest result, unless it is being written: a newer one will be offered.
    pub(super) fn withdraw(&self) {
        self.waiting.lock().newest = None;
    }

    /// Lets [`Self::run`] write the waiting results and end.
    pub(super) fn close(&self) {
        self.waiting.lock().closed = true;
        self.bell.notify_all();
    }

    /// Writes until closed: the first result at once, later ones at a bounded rate, the last one before it ends.
    ///
    /// # Errors
    /// Failure of the last attempt. Earlier failures were reported, and the results replaced once the disk took files again.
    pub(super) fn run(&self) -> Result<(), OutputError> {
        let mut last: Result<(), OutputError> = Ok(());
        let mut due = Instant::now();
        let mut written = None;
        while let Some(job) = self.next(due, written) {
            last = match &job {
                Job::Keep(frame) => write(&self.out.join(format!("frame-{:06}", frame.index)), frame),
                Job::Newest(frame) => write(&self.out, frame),
            };
            if let Job::Newest(frame) = job {
                due = Instant::now() + EVERY;
                if last.is_ok() {
                    written = Some(frame.index);
                }
            }
            self.report(&last);
        }
        last
    }

    /// Waits for the next result to write: a kept one at once, the newest one when it is `due` and was not `written` yet. None
    /// once closed and everything is written.
    fn next(&self, due: Instant, written: Option<u64>) -> Option<Job> {
        let mut waiting = self.waiting.lock();
        let job = loop {
            if let Some(kept) = waiting.kept.take() {
                break Some(Job::Keep(kept));
            }
            if waiting.closed || Instant::now() >= due {
                let fresh = waiting.newest.take().filter(|frame| written != Some(frame.index));
                if fresh.is_some() || waiting.closed {
                    break fresh.map(Job::Newest);
                }
            }
            self.bell.wait_for(&mut waiting, PACE);
        };
        drop(waiting);
        self.bell.notify_all();
        job
    }

    /// Counts an attempt. Reports when saving stops and when it goes on.
    fn report(&self, outcome: &Result<(), OutputError>) {
        let mut statistics = self.statistics.lock();
        let saving = &mut statistics.saving;
        let fault = outcome.as_ref().err().map(ToString::to_string);
        saving.written += u64::from(fault.is_none());
        saving.failed += u64::from(fault.is_some());
        let before = std::mem::replace(&mut saving.fault, fault.clone());
        drop(statistics);
        match fault {
            Some(reason) if before.is_none() => {
                tracing::error!("results are not saved, the live view goes on: {reason}");
                self.events.emit("saving-stopped", json!({ "reason": reason }));
            }
            None if before.is_some() => {
                tracing::info!("{}: results are saved again", self.out.display());
                self.events.emit("saving-resumed", json!({}));
            }
            _ => {}
        }
    }
}

fn write(folder: &Path, frame: &PublishedFrame) -> Result<(), OutputError> {
    output::write_all(folder, &frame.images(), &frame.report)
}
