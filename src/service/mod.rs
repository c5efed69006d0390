//! L4: the run loop. Two cameras → pairs of frames → the pipeline → preview and disk, until told to stop.
//!
//! ```text
//! raw camera ──thread──┐                         ┌─ Saver ──thread──▶ OUT
//!                      ├▶ Pairing ▶ Solver thread ┼─ Recorder ─thread─▶ sessions
//! guide camera ─thread─┘  (bounded)              └─ Broadcast ▶ encoder thread ▶ HTTP thread ▶ watchers
//! ```
//!
//! Every queue is bounded and the newest frame wins: what is slow (solver, disk, a watcher) skips frames and holds nobody
//! else up. A raw frame is processed with the guide frame of its own instant or, while the guide camera is offline, without
//! one and marked; never with an earlier one. Results are fractions of the sensor's full scale, as in [`crate::pipeline`].
//!
//! Allocation: [`Service::start`] plans and allocates; frames and results circulate in buffers that are used again, pictures
//! are allocated once per encoding. Imports: everything below.
//!
//! ```
//! use stokescope::board::Board;
//! use stokescope::service::{Options, Service};
//! # let dir = tempfile::tempdir()?;
//! let mut board = Board::load("x86-sim")?;
//! board.raw.source = "wedges,size=32,stripes=8".into();
//! board.guide.as_mut().unwrap().source = board.raw.source.clone();
//! let options = Options { frames: Some(2), preview: None, ..Options::new(board, dir.path().into()) };
//! let summary = Service::start(options)?.wait(|_| false)?;
//! assert_eq!(summary.frames, 2);
//! assert!(dir.path().join("frame-000001/stokes.npy").exists());
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod broadcast;
mod capture;
mod control;
mod events;
mod govern;
mod host;
mod http;
mod hub;
mod pair;
mod record;
mod request;
mod save;
mod session;
mod solve;
mod state;
mod view;

use std::net::{SocketAddr, TcpListener};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use broadcast::Broadcast;
use capture::Source;
use control::Controls;
use events::Events;
use govern::Governor;
use host::Host;
use hub::{Hub, Parts};
use pair::Pairing;
pub use record::RecordOptions;
use record::{Description, Disk, Recorder, Session};
use request::Guard;
use save::Saver;
use serde::Serialize;
pub use session::Playback;
use solve::{Solver, Task};
use view::{Painter, View};

use crate::Error;
use crate::array::WriteError;
use crate::board::{Board, BundleSource as Bundle, CameraSpec, SystemLimit};
use crate::calibration::Calibration;
use crate::camera::sim::SimSpec;
use crate::camera::{Camera, CameraInfo, Clock, Role};
use crate::optics::Coarse;
use crate::output;
use crate::pipeline::{PlanError, Settings};
use crate::plane::Size;
use crate::prepare::Unit;

/// Most frames that are each kept in a folder of their own.
pub const MAX_KEPT: u64 = 100;
/// Pause between two looks at the machine.
const LOOK: Duration = Duration::from_secs(2);
/// How long the threads have to end before the process ends without them.
const FAREWELL: Duration = Duration::from_secs(4);
/// Pace of [`Service::wait`].
const PACE: Duration = Duration::from_millis(50);
/// Bytes of a thread's stack, and of all that a service may have: capture, machine, events, encoder, preview, save, record,
/// solver and its team.
const STACK: usize = 512 << 10;
const STACKS: usize = 16 * STACK;
/// Bytes of the process itself: the program's pages, what its libraries and threads hold, and small things. Measured
/// (`tests/memory.rs`): the network's library alone is more code than all the rest, and its pages count where they are touched.
pub const PROCESS_BYTES: usize = if cfg!(feature = "fusion") { 14 << 20 } else { 10 << 20 };
/// Frames that a driver fills in turn.
const DRIVER_BUFFERS: usize = 4;
/// Shortest token that is accepted: shorter ones can be guessed.
const MIN_TOKEN: usize = 8;

/// What to run.
#[derive(Clone, Debug)]
pub struct Options {
    /// The machine and its cameras.
    pub board: Board,
    /// Folder of the results.
    pub out: PathBuf,
    /// Frames to process; none runs until told to stop. Up to [`MAX_KEPT`], each is kept in a folder of its own.
    pub frames: Option<u64>,
    /// Iterations; none takes the board's.
    pub iterations: Option<usize>,
    /// The preview, if there is to be one.
    pub preview: Option<Preview>,
    /// What to record, if anything.
    pub record: Option<RecordOptions>,
    /// Whether watchers may change settings; those with a token always may.
    pub control: bool,
    /// The frame rate that is held by lowering the quality.
    pub target: Target,
    /// A shell command that reads what happens, one JSON object a line.
    pub on_event: Option<String>,
    /// Whether every frame is processed, in its order and however long it takes; else the newest wins.
    pub every: bool,
    /// Where the kernel tells how the machine fares.
    pub sysfs: PathBuf,
}

/// The frame rate that is held by lowering the quality.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Target {
    /// None: what is asked for is done, however long it takes.
    Off,
    /// That of the raw camera.
    Camera,
    /// So many frames per second.
    Rate(f64),
}

/// Where the preview is served.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Preview {
    /// Address and port; port 0 takes a free one.
    pub listen: SocketAddr,
    /// What clients must know; needed unless the address is a loopback one.
    pub token: Option<String>,
}

impl Options {
    /// Runs `board` until told to stop, with a preview on a free loopback port.
    pub fn new(board: Board, out: PathBuf) -> Self {
        let listen = SocketAddr::from(([127, 0, 0, 1], 0));
        Self {
            board,
            out,
            frames: None,
            iterations: None,
            preview: Some(Preview { listen, token: None }),
            record: None,
            control: false,
            target: Target::Off,
            on_event: None,
            every: false,
            sysfs: PathBuf::from("/sys"),
        }
    }
}

/// Why the service does not start.
#[derive(Debug, thiserror::Error)]
pub enum ServiceError {
    /// The address cannot be listened on.
    #[error(
        "preview: cannot listen on {listen}: {source}; is it in use by another instance? choose another with --listen, or --no-preview"
    )]
    Listen {
        /// The address.
        listen: SocketAddr,
        /// Why.
        source: std::io::Error,
    },
    /// Others could reach the preview without proof.
    #[error(
        "preview: {listen} can be reached from other machines, so it needs --token TOKEN of at least {MIN_TOKEN} letters, digits, `-`, `_`, `.` or `~`"
    )]
    Token {
        /// The address.
        listen: SocketAddr,
    },
    /// The bundle belongs to another camera.
    #[error("{}: is for {channels} channel(s) of {size} pixels, {camera} gives {found_channels} of {found}", bundle.display())]
    Bundle {
        /// Folder of the bundle.
        bundle: PathBuf,
        /// Channels of the bundle.
        channels: usize,
        /// Its size.
        size: Size,
        /// The camera.
        camera: String,
        /// Its channels.
        found_channels: usize,
        /// Its size.
        found: Size,
    },
    /// A board whose camera describes itself, and whose camera cannot.
    #[error(
        "board {board}: calibration = \"simulated\" is for cameras of the backend sim, the raw camera is of {backend}"
    )]
    NotSimulated {
        /// The board.
        board: String,
        /// The raw camera's backend.
        backend: String,
    },
    /// The folder of the sessions cannot be used.
    #[error("{}: cannot record: {source}", dir.display())]
    Record {
        /// The folder.
        dir: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// A session cannot be replayed.
    #[error("{}: {what}", path.display())]
    Session {
        /// File or folder.
        path: PathBuf,
        /// What is wrong with it.
        what: String,
    },
    /// The system gives no thread.
    #[error("cannot start the {name} thread: {source}")]
    Thread {
        /// Which.
        name: &'static str,
        /// Why.
        source: std::io::Error,
    },
}

/// Where the run stands.
#[derive(Clone, Debug, PartialEq)]
pub struct Progress {
    /// Frames processed.
    pub frames: u64,
    /// Frames per second of late.
    pub fps: f64,
    /// Median time from a frame's arrival to its result, in milliseconds.
    pub latency_ms: Option<f32>,
    /// Frames that arrived and were not processed.
    pub dropped: u64,
}

/// How the run went.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Summary {
    /// Name of the board.
    pub board: String,
    /// Frames processed.
    pub frames: u64,
    /// Frames that no result could be made of.
    pub failed: u64,
    /// Frames per second, from the first result to the last.
    pub fps: Option<f64>,
    /// Time from the start to the first result, in seconds.
    pub first_result_seconds: Option<f64>,
    /// Time from a frame's arrival to its result, in milliseconds.
    pub latency_ms: Latency,
    /// Frames that were not processed.
    pub dropped: Dropped,
    /// Most memory the process ever held.
    pub peak_rss_bytes: Option<u64>,
    /// Folder of the newest result.
    pub out: PathBuf,
    /// Address of the preview.
    pub preview: Option<String>,
    /// Results written to disk, and those that could not be.
    pub results: Written,
    /// Frames recorded, when there was something to record into.
    pub recording: Option<Recorded>,
}

/// A recording.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Recorded {
    /// Folder of the session; none before its first frame.
    pub session: Option<PathBuf>,
    /// Frames recorded.
    pub written: u64,
    /// Frames that could not be.
    pub failed: u64,
    /// Frames left out because the disk was behind.
    pub dropped: u64,
    /// Recorded frames removed to make room.
    pub removed: u64,
}

/// Quantiles of a time over the recent frames, in milliseconds.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Latency {
    /// Median.
    pub p50: Option<f32>,
    /// What 95 % do not exceed.
    pub p95: Option<f32>,
}

/// Frames that arrived and were not processed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct Dropped {
    /// Raw frames that made room for newer ones.
    pub raw: u64,
    /// Guide frames that did.
    pub guide: u64,
    /// Raw frames without a guide frame of their instant.
    pub unpaired: u64,
}

/// Results on disk.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct Written {
    /// Written, each replacing the one before or in a folder of its own.
    pub written: u64,
    /// Not written: disk full, read-only.
    pub failed: u64,
}

/// A running service, until [`Service::wait`] ends it.
#[derive(Debug)]
pub struct Service {
    hub: Arc<Hub>,
    saver: Arc<Saver>,
    recorder: Option<(Arc<Recorder>, JoinHandle<()>)>,
    solver: JoinHandle<Result<(), Error>>,
    saving: JoinHandle<Result<(), output::OutputError>>,
    /// Threads that only have to end.
    others: Vec<JoinHandle<()>>,
    address: Option<SocketAddr>,
}

impl Service {
    /// Opens the cameras, plans the pipeline, listens, and starts. Whatever cannot work is refused here.
    ///
    /// # Errors
    /// [`ServiceError`], a camera that cannot be opened, a bundle that cannot be used, or a plan that exceeds the board's memory limit.
    pub fn start(options: Options) -> Result<Self, Error> {
        let started = Instant::now();
        let Options { board, out, frames, iterations, preview, record, control, target, on_event, every, sysfs } =
            options;
        let system = SystemLimit::of_this_process(STACKS);
        if let Some(limit) = system.map(|system| system.bytes).filter(|bytes| *bytes < PROCESS_BYTES) {
            let (stages, total) = (vec![("process", PROCESS_BYTES)], PROCESS_BYTES);
            return Err(PlanError::Memory { stages, total, limit }.into());
        }
        let listener = preview.as_ref().map(listen).transpose()?;
        let fusion = crate::model::choose(&board.fusion.model, board.fusion.precision)?;
        let learned = fusion.is_some();
        std::fs::create_dir_all(&out).map_err(|source| WriteError::Create { path: out.clone(), source })?;
        let lock = record.as_ref().map(|options| {
            let refuse = |source| ServiceError::Record { dir: options.dir.clone(), source };
            record::take(&options.dir).map_err(refuse)
        });
        let lock = lock.transpose()?;
        let clock = Clock::default();
        let raw = Source::new(Role::Raw, &board.raw, &clock, !every);
        let guide = board.guide.as_ref().map(|spec| Source::new(Role::Guide, spec, &clock, !every));
        // opening cameras takes its time; they and the bundle do not need one another
        let (opened, calibration) = thread::scope(|scope| {
            let opening = scope.spawn(|| raw.open());
            let second = guide.as_ref().map(|guide| scope.spawn(|| guide.open()));
            let calibration = bundle(&board, &out);
            ((opening.join(), second.map(thread::ScopedJoinHandle::join)), calibration)
        });
        let panicked = |_| Error::Internal("a camera's driver panicked".to_owned());
        let raw_camera = opened.0.map_err(panicked)??;
        let guide_camera = opened.1.transpose().map_err(panicked)?.transpose()?;
        let calibration = calibration?;
        check_bundle(&calibration, raw_camera.info())?;

        let size = calibration.sensor.size;
        let infos = [Some(raw_camera.info()), guide_camera.as_ref().map(|camera| camera.info())];
        let bytes =
            |info: &CameraInfo| info.format.planes() * info.format.plane_size(info.size).pixels() * size_of::<f32>();
        let unpacked = infos.map(|info| info.map_or(0, bytes));
        let mut reserve =
            reserve(&board, &calibration, unpacked, preview.is_some(), record.is_some(), fusion.is_some());
        let mut limit = board.memory_limit_bytes;
        if let Some(system) = system
            && system.bytes < limit.saturating_add(PROCESS_BYTES)
        {
            tracing::info!("memory: {} allows less than the board: {} bytes", system.source, system.bytes);
            limit = system.bytes;
            reserve.push(("process", PROCESS_BYTES));
        }
        // made before the workspaces and freed before them
        let planning = ("planning", if guide.is_some() { Coarse::planning_bytes(size) } else { 0 });
        let first: usize = reserve.iter().filter(|(stage, _)| *stage == "process").map(|(_, bytes)| bytes).sum();
        if first + planning.1 > limit {
            let stages = vec![planning, ("process", first)];
            return Err(PlanError::Memory { stages, total: first + planning.1, limit }.into());
        }
        let iterations = iterations.unwrap_or(board.iterations);
        let settings = Settings {
            iterations: Some(iterations),
            memory_limit_bytes: limit.saturating_sub(total(&reserve)),
            fusion,
            ..board.settings()
        };
        let unit = if raw_camera.info().format.bits().is_some() { Unit::Counts } else { Unit::FullScale };
        let views = preview.as_ref().map(|_| View::all(calibration.response.angles(), guide.is_some()));
        let counts = infos.map(|info| info.is_some_and(|info| info.format.bits().is_some()));
        let target_fps = match target {
            Target::Off => None,
            Target::Camera => raw_camera.info().frame_rate,
            Target::Rate(fps) => Some(fps),
        };
        let session = record.map(|options| {
            let description = describe(&board, &calibration, options.format, iterations);
            Session::new(options, description, calibration.dir.clone(), counts, Disk, lock)
        });
        let results = solve::results(preview.is_some(), session.is_some());
        let solver = Solver::new(calibration, guide.is_some(), unit, settings, results)
            .map_err(|e| with_reserve(e, &reserve, limit))?;

        let name = |camera: &dyn Camera| camera.info().name.clone();
        let pairing = Pairing::new(
            name(raw_camera.as_ref()),
            guide_camera.as_deref().map(name),
            board.queue_frames,
            Duration::from_micros(board.max_skew_us),
            every,
        );
        let broadcast = Broadcast::new(&views.unwrap_or_default(), size, board.preview.jpeg_quality);
        let (events, event_queue) = Events::new(started, on_event.is_some());
        let control = control || preview.as_ref().is_some_and(|preview| preview.token.is_some());
        let hub = Arc::new(Hub::new(Parts {
            board: board.name.clone(),
            out,
            started,
            pairing,
            broadcast,
            events,
            controls: Controls::new(control, iterations, learned),
            quality: Governor::new(target_fps, iterations).quality().clone(),
            records: session.is_some(),
        }));
        let thermal = board.thermal;
        hub.set_host(&Host::read(&sysfs, thermal));
        let saver = Arc::new(Saver::default());
        // whatever fails from here on, the threads that run already end
        let guard = StopOnDrop(&hub);

        let cameras = [Some((raw, raw_camera)), guide.zip(guide_camera)];
        let mut others = Vec::new();
        for (source, camera) in cameras.into_iter().flatten() {
            let hub = Arc::clone(&hub);
            others.push(spawn("capture", move || capture::run(&hub, &source, camera))?);
        }
        let machine = Arc::clone(&hub);
        others.push(spawn("machine", move || {
            while !machine.stop.is_set() {
                machine.stop.wait(LOOK);
                machine.set_host(&Host::read(&sysfs, thermal));
            }
        })?);
        if let (Some(text), Some(queue)) = (on_event, event_queue) {
            let told = Arc::clone(&hub);
            others.push(spawn("events", move || events::run_command(&text, &queue, || told.stop.is_set()))?);
        }
        let address = listener.as_ref().map(TcpListener::local_addr).transpose().ok().flatten();
        if let (Some(listener), Some(preview)) = (listener, preview) {
            let encoder = Arc::clone(&hub);
            others.push(spawn("encoder", move || encoder.broadcast.encode(&encoder.timings))?);
            let (server, clients) = (Arc::clone(&hub), board.preview.max_clients);
            let guard = Guard { names: host_names(), token: preview.token, control };
            others.push(spawn("preview", move || {
                if let Err(e) = http::serve(&server, listener, guard, clients) {
                    tracing::error!("preview: {e}");
                }
            })?);
        }
        let (writer, disk) = (Arc::clone(&saver), Arc::clone(&hub));
        let saving = spawn("save", move || writer.run(&disk))?;
        let recorder = session.map(|session| {
            let recorder = Arc::new(Recorder::default());
            let (writer, disk) = (Arc::clone(&recorder), Arc::clone(&hub));
            spawn("record", move || writer.run(&disk, session)).map(|thread| (recorder, thread))
        });
        let recorder = recorder.transpose()?;
        let (results, solving) = (Arc::clone(&saver), Arc::clone(&hub));
        let recording = recorder.as_ref().map(|(recorder, _)| Arc::clone(recorder));
        let task = Task { frames, keep: frames.is_some_and(|n| n <= MAX_KEPT), every, target_fps };
        let solver = spawn("solver", move || solver.run(&solving, &results, recording.as_deref(), &task))?;
        std::mem::forget(guard);
        hub.events.emit("started", serde_json::json!({ "board": hub.board }));
        Ok(Self { hub, saver, recorder, solver, saving, others, address })
    }

    /// Address of the preview, with its real port.
    pub fn address(&self) -> Option<SocketAddr> {
        self.address
    }

    /// Waits until all frames are processed or `stop`, which is asked some twenty times a second, says so; then ends every
    /// thread, within four seconds, and writes the newest result.
    ///
    /// # Errors
    /// What ended the solver, or why the newest result could not be written.
    pub fn wait(self, mut stop: impl FnMut(&Progress) -> bool) -> Result<Summary, Error> {
        while !self.solver.is_finished() && !stop(&self.progress()) {
            thread::sleep(PACE);
        }
        let Self { hub, saver, recorder, solver, saving, others, address } = self;
        let deadline = Instant::now() + FAREWELL;
        // the result in work still counts
        hub.close();
        let solved = join(solver, deadline, "solver");
        saver.close();
        if let Some((recorder, thread)) = recorder {
            recorder.close();
            join(thread, deadline, "record")?;
        }
        let saved = join(saving, deadline, "save");
        let others = others.into_iter().map(|thread| join(thread, deadline, "capture or preview"));
        let others: Vec<_> = others.collect();
        solved?.transpose()?;
        saved?.transpose()?;
        others.into_iter().collect::<Result<Vec<_>, _>>()?;
        Ok(summary(&hub, address))
    }

    fn progress(&self) -> Progress {
        let (raw, _) = self.hub.pairing.lenses();
        let figures = self.hub.figures();
        Progress {
            frames: figures.frames,
            fps: figures.fps(),
            latency_ms: figures.latency_ms(0.5),
            dropped: raw.dropped + raw.unpaired,
        }
    }
}

/// Ends the threads of a service that does not come to be.
struct StopOnDrop<'a>(&'a Hub);

impl Drop for StopOnDrop<'_> {
    fn drop(&mut self) {
        self.0.close();
    }
}

fn spawn<T: Send + 'static>(
    name: &'static str,
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<JoinHandle<T>, ServiceError> {
    thread::Builder::new()
        .name(name.to_owned())
        .stack_size(STACK)
        .spawn(work)
        .map_err(|source| ServiceError::Thread { name, source })
}

/// Waits for a thread's end; none when it does not end in time: a driver that hangs must not hang the program.
fn join<T>(thread: JoinHandle<T>, deadline: Instant, name: &str) -> Result<Option<T>, Error> {
    while !thread.is_finished() {
        if Instant::now() > deadline {
            tracing::warn!("the {name} thread does not end and is left behind");
            return Ok(None);
        }
        thread::sleep(PACE / 10);
    }
    thread.join().map(Some).map_err(|_| Error::Internal(format!("the {name} thread panicked")))
}

fn summary(hub: &Hub, address: Option<SocketAddr>) -> Summary {
    let (raw, guide) = hub.pairing.lenses();
    let figures = hub.figures();
    let span = figures.first.zip(figures.last()).map(|(first, last)| last.duration_since(first).as_secs_f64());
    Summary {
        board: hub.board.clone(),
        frames: figures.frames,
        failed: figures.failed,
        fps: span.filter(|s| *s > 0.0).map(|s| (figures.frames - 1) as f64 / s),
        first_result_seconds: figures.first.map(|first| first.duration_since(hub.started).as_secs_f64()),
        latency_ms: Latency { p50: figures.latency_ms(0.5), p95: figures.latency_ms(0.95) },
        dropped: Dropped { raw: raw.dropped, guide: guide.map_or(0, |guide| guide.dropped), unpaired: raw.unpaired },
        peak_rss_bytes: output::peak_rss_bytes(),
        out: hub.out.clone(),
        preview: address.map(|address| format!("http://{address}/")),
        results: Written { written: figures.saving.written, failed: figures.saving.failed },
        recording: hub.records.then(|| {
            let r = &figures.recording;
            let session = r.session.clone();
            Recorded { session, written: r.written, failed: r.failed, dropped: r.dropped, removed: r.removed }
        }),
    }
}

fn listen(preview: &Preview) -> Result<TcpListener, ServiceError> {
    let listen = preview.listen;
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_.~".contains(c);
    let proof = match &preview.token {
        Some(token) => token.len() >= MIN_TOKEN && token.chars().all(plain),
        None => listen.ip().is_loopback(),
    };
    if !proof {
        return Err(ServiceError::Token { listen });
    }
    TcpListener::bind(listen).map_err(|source| ServiceError::Listen { listen, source })
}

/// What others may call this machine: its name, by itself and on the local link.
fn host_names() -> Vec<String> {
    let name = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default().trim().to_owned();
    if name.is_empty() { Vec::new() } else { vec![format!("{name}.local"), name] }
}

/// The board's bundle. Simulated cameras describe themselves: what they write is read like any other.
fn bundle(board: &Board, out: &Path) -> Result<Calibration, Error> {
    let dir = match &board.calibration {
        Bundle::Folder(dir) => dir.clone(),
        Bundle::Simulated if board.raw.backend == "sim" => {
            let dir = out.join("calibration");
            crate::bundle::write_simulated(&board.raw.source.parse::<SimSpec>()?, &dir)?;
            dir
        }
        Bundle::Simulated => {
            let (board, backend) = (board.name.clone(), board.raw.backend.clone());
            return Err(ServiceError::NotSimulated { board, backend }.into());
        }
    };
    Ok(Calibration::load(&dir)?)
}

fn check_bundle(calibration: &Calibration, camera: &CameraInfo) -> Result<(), Error> {
    if let Some(own) = &calibration.camera {
        own.check(&camera.id(), &calibration.dir)?;
    }
    let (found, found_channels) = (camera.format.plane_size(camera.size), camera.format.planes());
    let (size, channels) = (calibration.sensor.size, calibration.sensor.channels);
    if (found, found_channels) == (size, channels) {
        return Ok(());
    }
    let (bundle, camera) = (calibration.dir.clone(), camera.name.clone());
    Err(ServiceError::Bundle { bundle, channels, size, camera, found_channels, found }.into())
}

/// What the description of a session says.
fn describe(
    board: &Board,
    calibration: &Calibration,
    format: output::export::Format,
    iterations: usize,
) -> Description {
    let (size, channels) = (calibration.sensor.size, calibration.sensor.channels);
    let angles = calibration.response.angles();
    let components: &[&str] = if angles.is_empty() { &["S0"] } else { &["S0", "S1", "S2"] };
    let channel = |c: usize| if channels == 3 { ["red ", "green ", "blue "][c] } else { "" };
    Description {
        version: 1,
        program: format!("stokescope {}", env!("CARGO_PKG_VERSION")),
        started: events::wall_clock(),
        board: board.name.clone(),
        format,
        size: [size.width, size.height],
        channels,
        angles_deg: angles.iter().map(|a| a.degrees()).collect(),
        guide: board.guide.is_some(),
        iterations,
        register: board.register,
        planes: (0..channels).flat_map(|c| components.iter().map(move |s| format!("{}{s}", channel(c)))).collect(),
    }
}

/// Bytes that the service itself may hold beside the pipeline: of unpacked frames (`frames`: of one of the raw and of the guide
/// camera), results, the preview's pictures and clients, the newest result on its way to disk, and the cameras.
pub fn reserve(
    board: &Board,
    calibration: &Calibration,
    frames: [usize; 2],
    preview: bool,
    records: bool,
    fusion: bool,
) -> Vec<(&'static str, usize)> {
    // those that wait, the one that arrives and the one in work
    let recorded = if records { solve::RECORDED } else { 0 };
    let queues = (board.queue_frames + 2 + recorded) * frames.iter().sum::<usize>();
    let results = solve::results(preview, records) * solve::result_bytes(calibration, preview, fusion);
    let size = calibration.sensor.size;
    // one picture of every view is drawn at a time, encoded as JPEG or PNG, and held for its watchers
    let drawing = if preview { Painter::bytes(size) + 2 * 3 * size.pixels() } else { 0 };
    let clients = if preview { board.preview.max_clients * http::CLIENT_BYTES } else { 0 };
    // one picture at a time, drawn and encoded
    let saving = 4 * 3 * size.pixels();
    let camera = |spec: &CameraSpec, role, frame: usize| match spec.source.parse::<SimSpec>() {
        Ok(sim) if spec.backend == "sim" => match role {
            Role::Raw => sim.raw_camera_bytes(),
            Role::Guide => sim.guide_camera_bytes(),
        },
        // two bytes a sample at most
        _ => DRIVER_BUFFERS * frame / 2,
    };
    let guide = board.guide.as_ref().map_or(0, |spec| camera(spec, Role::Guide, frames[1]));
    let cameras = camera(&board.raw, Role::Raw, frames[0]) + guide;
    vec![
        ("cameras", cameras),
        ("queues", queues),
        ("results", results),
        ("saving", saving),
        ("preview", drawing),
        ("clients", clients),
    ]
}

fn total(stages: &[(&'static str, usize)]) -> usize {
    stages.iter().map(|(_, bytes)| bytes).sum()
}

/// The refusal of a plan, with the service's own needs beside the pipeline's.
fn with_reserve(error: PlanError, reserve: &[(&'static str, usize)], limit: usize) -> PlanError {
    match error {
        PlanError::Memory { mut stages, total: pipeline, .. } => {
            stages.extend(reserve);
            PlanError::Memory { stages, total: pipeline + total(reserve), limit }
        }
        other => other,
    }
}
