//! The service: makes its parts, wires them, and starts and ends the threads.

use std::net::{SocketAddr, TcpListener};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::mpsc::Receiver;
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use axum::body::Bytes;
use parking_lot::Mutex;
use tokio::sync::Semaphore;

use super::cameras::Capture;
use super::controls::Controls;
use super::events::{self, Events};
use super::http::{Context, Server, Watchers};
use super::limits;
use super::machine::MachineStatus;
use super::memory::Uses;
use super::options::{MAX_KEPT, Options, ServiceError, Target};
use super::pairing::Pairing;
use super::preview::{Broadcast, View};
use super::quality::{Governor, QualityStatus};
use super::recorder::Recorder;
use super::saver::Saver;
use super::solver::{Links, Solver, Task};
use super::startup::{OpenCamera, Resources, guard};
use super::statistics::{Statistics, Timings};
use super::stop::Stop;
use super::summary::{Dropped, Latency, Progress, Recorded, Summary, Written};
use super::threads::{join, spawn};
use crate::Error;
use crate::output::{self, OutputError};
use crate::session::{FolderLock, SampleKind, SessionWriter};
use stokescope_core::pipeline::Settings;
use stokescope_core::readings::Unit;

/// Time that the threads have to end before the process ends without them.
const FAREWELL: Duration = Duration::from_secs(4);
/// Pace of [`Service::wait`].
const PACE: Duration = Duration::from_millis(50);

/// A running service, until [`Service::wait`] ends it.
#[derive(Debug)]
pub struct Service {
    parts: Parts,
    threads: Threads,
    address: Option<SocketAddr>,
    _out_lock: FolderLock,
}

impl Service {
    /// Opens the cameras, plans the pipeline, listens, and starts. Refuses whatever cannot work.
    ///
    /// # Errors
    /// [`ServiceError`], a camera that cannot be opened, a bundle that cannot be used, or a plan that exceeds the board's memory
    /// limit.
    pub fn start(options: &Options) -> Result<Self, Error> {
        Self::start_on(options, None)
    }

    /// Starts like [`Service::start`]; serves the preview on `listener` where there is one, in place of a new one.
    ///
    /// # Errors
    /// Those of [`Service::start`].
    pub fn start_on(options: &Options, listener: Option<TcpListener>) -> Result<Self, Error> {
        let started = Instant::now();
        let mut resources = Resources::acquire(options, listener)?;
        let iterations = options.iterations.unwrap_or(options.board.iterations);
        let session = resources.session(options, iterations);
        let target_fps = match options.target {
            Target::Off => None,
            Target::Camera => resources.raw.info().frame_rate,
            Target::Rate(fps) => Some(fps),
        };
        let governor = Governor::new(target_fps, iterations);
        let (events, event_queue) = Events::new(started, options.on_event.is_some());
        let Resources { listener, raw, guide, bundle, budget, out_lock, .. } = resources;
        let settings = Settings {
            guided: guide.is_some(),
            iterations: Some(iterations),
            memory_limit_bytes: budget.pipeline_bytes(),
            ..options.board.settings()
        };
        let unit = if raw.samples() == SampleKind::Counts { Unit::Counts } else { Unit::FullScale };
        let results = limits::results(options.preview.is_some(), session.is_some());
        let uses = Uses { preview: options.preview.is_some(), record: session.is_some() };
        let allowed = settings.memory_limit_bytes.saturating_sub(uses.fusion_bytes(&bundle));
        let solver = Solver::new(bundle, unit, settings, (&options.board, allowed), results);
        let solver = solver.map_err(|e| match e {
            Error::Plan(e) => budget.explain(e).into(),
            other => other,
        })?;
        let parts = Parts::new(options, (&raw, guide.as_ref()), &solver, started, events, &governor);
        let address = listener.as_ref().and_then(|listener| listener.local_addr().ok());
        let threads = Start { parts: &parts, options, others: Vec::new() };
        let cameras = std::iter::once(raw).chain(guide);
        let threads = threads.run(cameras, event_queue, listener, session, solver, governor)?;
        parts.events.emit("started", serde_json::json!({ "board": parts.board }));
        Ok(Self { parts, threads, address, _out_lock: out_lock })
    }

    /// Address of the preview, with its real port.
    pub fn address(&self) -> Option<SocketAddr> {
        self.address
    }

    /// Release for pairs that are processed only when they are asked for.
    pub fn shutter(&self) -> Shutter {
        Shutter(Arc::clone(&self.parts.pairing))
    }

    /// Waits until all frames are processed or `stop` says so; it is asked some twenty times a second. Then ends every thread,
    /// within four seconds, and writes the newest result.
    ///
    /// # Errors
    /// The failure that ended the solver, or the failure to write the newest result.
    pub fn wait(self, mut stop: impl FnMut(&Progress) -> bool) -> Result<Summary, Error> {
        while !self.threads.solver.is_finished() && !stop(&self.parts.progress()) {
            thread::sleep(PACE);
        }
        let Self { parts, threads, address, _out_lock } = self;
        let deadline = Instant::now() + FAREWELL;
        parts.close();
        // the result in work still counts
        let solved = join(threads.solver, deadline, "solver");
        parts.saver.close();
        if let (Some(recorder), Some(thread)) = (&parts.recorder, threads.recording) {
            recorder.close();
            join(thread, deadline, "record")?;
        }
        let saved = join(threads.saving, deadline, "save");
        let others = threads.others.into_iter().map(|thread| join(thread, deadline, "capture or preview"));
        let others: Vec<_> = others.collect();
        solved?.transpose()?;
        saved?.transpose()?;
        others.into_iter().collect::<Result<Vec<_>, _>>()?;
        Ok(parts.summary(address))
    }
}

/// Release for single pairs of frames.
#[derive(Clone, Debug)]
pub struct Shutter(Arc<Pairing>);

impl Shutter {
    /// Asks for a pair of frames that arrive from now on; false where the board takes every pair.
    pub fn release(&self) -> bool {
        self.0.shoot()
    }
}

/// Parts of the service. Threads get handles of those they need.
#[derive(Debug)]
struct Parts {
    board: String,
    out: PathBuf,
    started: Instant,
    stop: Arc<Stop>,
    pairing: Arc<Pairing>,
    broadcast: Arc<Broadcast>,
    controls: Arc<Controls>,
    machine: Arc<MachineStatus>,
    quality: Arc<QualityStatus>,
    statistics: Arc<Mutex<Statistics>>,
    timings: Arc<Timings>,
    events: Arc<Events>,
    saver: Arc<Saver>,
    recorder: Option<Arc<Recorder>>,
    /// Folder of the sessions, where frames can be recorded.
    sessions: Option<PathBuf>,
}

impl Parts {
    fn new(
        options: &Options,
        (raw, guide): (&OpenCamera, Option<&OpenCamera>),
        solver: &Solver,
        started: Instant,
        events: Events,
        governor: &Governor,
    ) -> Self {
        let Options { board, out, preview, record, control, every, sysfs, .. } = options;
        let bundle = solver.bundle();
        let (stop, statistics, events) = (Arc::<Stop>::default(), Arc::default(), Arc::new(events));
        let name = |camera: &OpenCamera| camera.info().name.clone();
        let max_skew = Duration::from_micros(board.max_skew_us);
        let pairing = Pairing::new(name(raw), guide.map(name), board.queue_frames, max_skew, *every);
        let pairing = Arc::new(if board.single_shots && !every { pairing.single_shots() } else { pairing });
        let views = preview.as_ref().map(|_| View::all(bundle.response.angles(), guide.is_some()));
        let (size, jpeg_quality) = (bundle.sensor.size, board.preview.jpeg_quality);
        let controllable = *control || preview.as_ref().is_some_and(|preview| preview.token.is_some());
        let quality = governor.quality().clone();
        let controls = Controls::new(controllable, quality.asked_iterations, solver.selection().clone());
        let saver = Saver::new(out.clone(), Arc::clone(&stop), Arc::clone(&statistics), Arc::clone(&events));
        let recorder = record.as_ref().map(|_| {
            let handles = (Arc::clone(&stop), Arc::clone(&pairing), Arc::clone(&statistics), Arc::clone(&events));
            Arc::new(Recorder::new(started, options.record_at_once, handles.0, handles.1, handles.2, handles.3))
        });
        Self {
            board: board.name.clone(),
            out: out.clone(),
            started,
            broadcast: Arc::new(Broadcast::new(&views.unwrap_or_default(), size, jpeg_quality)),
            controls: Arc::new(controls),
            machine: Arc::new(MachineStatus::new(sysfs.clone(), board.thermal, Arc::clone(&events))),
            quality: Arc::new(QualityStatus::new(quality)),
            timings: Arc::default(),
            saver: Arc::new(saver),
            recorder,
            sessions: record.as_ref().map(|record| record.dir.clone()),
            stop,
            pairing,
            statistics,
            events,
        }
    }

    /// Ends all threads but those that still have results to write.
    fn close(&self) {
        self.stop.set();
        self.pairing.close();
        self.broadcast.close();
    }

    fn links(&self) -> Links {
        Links {
            pairing: Arc::clone(&self.pairing),
            controls: Arc::clone(&self.controls),
            machine: Arc::clone(&self.machine),
            quality: Arc::clone(&self.quality),
            statistics: Arc::clone(&self.statistics),
            timings: Arc::clone(&self.timings),
            events: Arc::clone(&self.events),
            broadcast: Arc::clone(&self.broadcast),
            saver: Arc::clone(&self.saver),
            recorder: self.recorder.clone(),
        }
    }

    fn context(&self) -> Context {
        Context {
            board: self.board.clone(),
            out: self.out.clone(),
            started: self.started,
            recorder: self.recorder.clone().zip(self.sessions.clone()),
            pairing: Arc::clone(&self.pairing),
            broadcast: Arc::clone(&self.broadcast),
            controls: Arc::clone(&self.controls),
            quality: Arc::clone(&self.quality),
            machine: Arc::clone(&self.machine),
            statistics: Arc::clone(&self.statistics),
            timings: Arc::clone(&self.timings),
            events: Arc::clone(&self.events),
            clients: Arc::default(),
            watchers: Watchers::default(),
            download: Arc::new(Semaphore::new(1)),
            still: Arc::new(Semaphore::new(1)),
        }
    }

    fn progress(&self) -> Progress {
        let (raw, _) = self.pairing.cameras();
        let statistics = self.statistics.lock();
        Progress {
            frames: statistics.frames,
            fps: statistics.fps(),
            target_fps: self.quality.get().target_fps,
            latency_ms: statistics.latency_ms(0.5),
            dropped: raw.dropped + raw.unpaired,
            idle: self.pairing.is_idle(),
        }
    }

    fn summary(&self, address: Option<SocketAddr>) -> Summary {
        let (raw, guide) = self.pairing.cameras();
        let statistics = self.statistics.lock();
        let span =
            statistics.first.zip(statistics.last()).map(|(first, last)| last.duration_since(first).as_secs_f64());
        Summary {
            board: self.board.clone(),
            frames: statistics.frames,
            failed: statistics.failed,
            fps: span.filter(|s| *s > 0.0).map(|s| (statistics.frames - 1) as f64 / s),
            target_fps: self.quality.get().target_fps,
            first_result_seconds: statistics.first.map(|first| first.duration_since(self.started).as_secs_f64()),
            latency_ms: Latency { p50: statistics.latency_ms(0.5), p95: statistics.latency_ms(0.95) },
            dropped: Dropped {
                raw: raw.dropped,
                guide: guide.map_or(0, |guide| guide.dropped),
                unpaired: raw.unpaired,
            },
            peak_rss_bytes: output::peak_rss_bytes(),
            out: self.out.clone(),
            preview: address.map(|address| format!("http://{address}/")),
            results: Written { written: statistics.saving.written, failed: statistics.saving.failed },
            recording: self.recorder.as_ref().map(|_| {
                let r = &statistics.recording;
                let session = r.session.clone();
                Recorded { session, written: r.written, failed: r.failed, dropped: r.dropped, removed: r.removed }
            }),
        }
    }
}

/// Threads of a running service.
#[derive(Debug)]
struct Threads {
    solver: JoinHandle<Result<(), Error>>,
    saving: JoinHandle<Result<(), OutputError>>,
    recording: Option<JoinHandle<()>>,
    /// Threads that have no result.
    others: Vec<JoinHandle<()>>,
}

/// Start of the threads. When one cannot be started, dropping this ends those that run already.
struct Start<'a> {
    parts: &'a Parts,
    options: &'a Options,
    others: Vec<JoinHandle<()>>,
}

impl Drop for Start<'_> {
    fn drop(&mut self) {
        self.parts.close();
    }
}

impl Start<'_> {
    fn run(
        mut self,
        cameras: impl Iterator<Item = OpenCamera>,
        event_queue: Option<Receiver<Bytes>>,
        listener: Option<TcpListener>,
        session: Option<SessionWriter>,
        solver: Solver,
        governor: Governor,
    ) -> Result<Threads, ServiceError> {
        for camera in cameras {
            self.capture(camera)?;
        }
        let (machine, stop) = (Arc::clone(&self.parts.machine), Arc::clone(&self.parts.stop));
        self.others.push(spawn("machine", move || machine.run(&stop))?);
        if let (Some(text), Some(queue)) = (self.options.on_event.clone(), event_queue) {
            let stop = Arc::clone(&self.parts.stop);
            self.others.push(spawn("events", move || events::run_command(&text, &queue, || stop.is_set()))?);
        }
        if let Some(listener) = listener {
            self.preview(listener)?;
        }
        let saver = Arc::clone(&self.parts.saver);
        let saving = spawn("save", move || saver.run())?;
        let recording = self.parts.recorder.clone().zip(session);
        let recording =
            recording.map(|(recorder, session)| spawn("record", move || recorder.run(session))).transpose()?;
        let frames = self.options.frames;
        let task = Task { frames, keep: frames.is_some_and(|n| n <= MAX_KEPT), every: self.options.every };
        let links = self.parts.links();
        let solver = spawn("solver", move || solver.run(&links, governor, &task))?;
        let others = std::mem::take(&mut self.others);
        // all threads run: they end with the service
        std::mem::forget(self);
        Ok(Threads { solver, saving, recording, others })
    }

    fn capture(&mut self, opened: OpenCamera) -> Result<(), ServiceError> {
        let OpenCamera { source, camera, binning } = opened;
        let capture = Capture {
            source,
            stop: Arc::clone(&self.parts.stop),
            pairing: Arc::clone(&self.parts.pairing),
            broadcast: Arc::clone(&self.parts.broadcast),
            events: Arc::clone(&self.parts.events),
            every: self.options.every,
        };
        self.others.push(spawn("capture", move || capture.run(camera, binning))?);
        Ok(())
    }

    /// Starts the encoder and the HTTP server.
    fn preview(&mut self, listener: TcpListener) -> Result<(), ServiceError> {
        let (broadcast, timings) = (Arc::clone(&self.parts.broadcast), Arc::clone(&self.parts.timings));
        self.others.push(spawn("encoder", move || broadcast.encode(&timings))?);
        let guard = guard(self.options, self.parts.controls.allowed);
        let clients = self.options.board.preview.max_clients;
        let server = Server::of_service(self.parts.context(), guard, clients, Arc::clone(&self.parts.stop));
        let serve = move || {
            if let Err(e) = server.run(listener) {
                tracing::error!("preview: {e}");
            }
        };
        self.others.push(spawn("preview", serve)?);
        Ok(())
    }
}
