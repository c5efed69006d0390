//! Recording of frames in a thread of its own: a slow or full disk never delays the live view.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use parking_lot::{Condvar, Mutex};
use serde_json::json;

use super::events::Events;
use super::frame::PublishedFrame;
use super::limits::RECORDER_QUEUE;
use super::pairing::{Captured, Pair, Pairing};
use super::statistics::Statistics;
use super::stop::Stop;
use crate::session::{CapturedImage, FrameData, Label, RecordError, SessionWriter, Storage};

/// Pause after a failure, so that a full disk is not tried with every frame.
const BACK_OFF: Duration = Duration::from_secs(1);

/// One frame to be recorded: what the cameras delivered and its result.
#[derive(Debug)]
pub(super) struct Job {
    pub(super) pair: Pair,
    pub(super) frame: Arc<PublishedFrame>,
}

#[derive(Debug, Default)]
struct Waiting {
    jobs: heapless::Deque<Job, RECORDER_QUEUE>,
    /// Whether frames are recorded.
    on: bool,
    /// Label of the session that the next frame begins; none goes on with the current one.
    label: Option<Label>,
    /// Whether a frame is being recorded.
    busy: bool,
    closed: bool,
}

/// Queue from the solver to the thread that records.
#[derive(Debug)]
pub(super) struct Recorder {
    waiting: Mutex<Waiting>,
    bell: Condvar,
    /// Whether sessions were removed by somebody else.
    changed: AtomicBool,
    started: Instant,
    stop: Arc<Stop>,
    /// Gets the frames' buffers back.
    pairing: Arc<Pairing>,
    statistics: Arc<Mutex<Statistics>>,
    events: Arc<Events>,
}

impl Recorder {
    /// A queue whose frames tell their time since `started`. Frames are recorded at once if it is `on`.
    pub(super) fn new(
        started: Instant,
        on: bool,
        stop: Arc<Stop>,
        pairing: Arc<Pairing>,
        statistics: Arc<Mutex<Statistics>>,
        events: Arc<Events>,
    ) -> Self {
        let waiting = Mutex::new(Waiting { on, ..Waiting::default() });
        let changed = AtomicBool::new(false);
        Self { waiting, bell: Condvar::new(), changed, started, stop, pairing, statistics, events }
    }

    /// Whether frames are recorded.
    pub(super) fn is_on(&self) -> bool {
        self.waiting.lock().on
    }

    /// Begins a new session with the next frame; false when one is being recorded already.
    pub(super) fn begin(&self, label: Label) -> bool {
        let mut waiting = self.waiting.lock();
        if waiting.on {
            return false;
        }
        self.events.emit("recording-begun", json!({ "name": label.name }));
        (waiting.on, waiting.label) = (true, Some(label));
        drop(waiting);
        let mut statistics = self.statistics.lock();
        (statistics.recording.session, statistics.recording.frames) = (None, 0);
        true
    }

    /// Ends the session. Frames that wait are still recorded.
    pub(super) fn end(&self) {
        if std::mem::take(&mut self.waiting.lock().on) {
            let session = self.statistics.lock().recording.session.clone();
            self.events.emit("recording-ended", json!({ "session": session }));
        }
    }

    /// Whether frames may still be written into `session`.
    pub(super) fn uses(&self, session: &Path) -> bool {
        let waiting = self.waiting.lock();
        let open = waiting.on || waiting.busy || !waiting.jobs.is_empty();
        open && self.statistics.lock().recording.session.as_deref() == Some(session)
    }

    /// Notes that sessions were removed: the limits are counted anew.
    pub(super) fn recount(&self) {
        self.changed.store(true, Ordering::Release);
    }

    /// Hands a frame over, while frames are recorded. When the disk is behind the oldest waiting one goes, or this waits if `every` frame counts.
    pub(super) fn offer(&self, job: Job, every: bool) {
        let mut waiting = self.waiting.lock();
        if !waiting.on {
            drop(waiting);
            return self.pairing.recycle(job.pair);
        }
        while every && waiting.jobs.is_full() && !self.stop.is_set() {
            self.bell.wait_for(&mut waiting, BACK_OFF);
        }
        let dropped = if waiting.jobs.is_full() { waiting.jobs.pop_front() } else { None };
        let fits = waiting.jobs.push_back(job).is_ok();
        debug_assert!(fits, "there is room");
        drop(waiting);
        self.bell.notify_all();
        if let Some(job) = dropped {
            self.pairing.recycle(job.pair);
            self.statistics.lock().recording.dropped += 1;
        }
    }

    /// Lets [`Self::run`] record the waiting frames and end.
    pub(super) fn close(&self) {
        self.waiting.lock().closed = true;
        self.bell.notify_all();
    }

    /// Records until closed. A failure is reported once; recording goes on as soon as the disk takes files.
    pub(super) fn run<S: Storage>(&self, mut session: SessionWriter<S>) {
        let mut not_before = None::<Instant>;
        while let Some((job, label)) = self.next() {
            if let Some(label) = label {
                session.begin(label);
                not_before = None;
            }
            if self.changed.swap(false, Ordering::AcqRel) {
                session.recount();
            }
            if not_before.is_none_or(|time| Instant::now() >= time) {
                let outcome = session.record(&self.frame_data(&job));
                not_before = outcome.is_err().then(|| Instant::now() + BACK_OFF);
                self.report(&session, outcome);
            } else {
                self.statistics.lock().recording.failed += 1;
            }
            self.pairing.recycle(job.pair);
        }
    }

    /// Waits for the next frame; gives it with the label of the session that it begins. None once closed and everything is recorded.
    fn next(&self) -> Option<(Job, Option<Label>)> {
        let mut waiting = self.waiting.lock();
        waiting.busy = false;
        let job = loop {
            if let Some(job) = waiting.jobs.pop_front() {
                break job;
            }
            if waiting.closed {
                return None;
            }
            self.bell.wait_for(&mut waiting, BACK_OFF);
        };
        waiting.busy = true;
        let label = waiting.label.take();
        drop(waiting);
        self.bell.notify_all();
        Some((job, label))
    }

    fn frame_data<'a>(&self, job: &'a Job) -> FrameData<'a> {
        let image = |captured: &'a Captured| CapturedImage { planes: &captured.planes, timestamp: captured.timestamp };
        FrameData {
            number: job.frame.index,
            uptime: self.started.elapsed(),
            raw: image(&job.pair.raw),
            guide: job.pair.guide.as_ref().map(image),
            result: job.frame.images(),
            report: &job.frame.report,
        }
    }

    /// Counts an attempt. Reports when recording stops and when it goes on.
    fn report<S: Storage>(&self, session: &SessionWriter<S>, outcome: Result<(), RecordError>) {
        let mut statistics = self.statistics.lock();
        let recording = &mut statistics.recording;
        (recording.session, recording.removed) = (session.folder().map(Into::into), session.removed());
        let fault = outcome.err().map(|e| e.to_string());
        recording.written += u64::from(fault.is_none());
        recording.frames += u64::from(fault.is_none());
        recording.failed += u64::from(fault.is_some());
        let before = std::mem::replace(&mut recording.fault, fault.clone());
        drop(statistics);
        match fault {
            Some(reason) if before.is_none() => {
                tracing::error!("not recording, the live view goes on: {reason}");
                self.events.emit("recording-stopped", json!({ "reason": reason }));
            }
            None if before.is_some() => {
                tracing::info!("{}: recording again", session.dir().display());
                self.events.emit("recording-resumed", json!({ "dir": session.dir() }));
            }
            _ => {}
        }
    }
}
