//! `stokescope run`: runs the live service on a board.

use std::io::IsTerminal;
use std::net::{SocketAddr, TcpListener};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};
use sd_notify::NotifyState;
use signal_hook::consts::{SIGINT, SIGTERM, SIGUSR1};

use crate::Error;
use crate::board::{Board, host_name};
use crate::live::{
    Options, Preview, Progress, Service, Setup, SetupProgress, SetupSummary, Summary, TOKEN_VARIABLE, Target,
};
use crate::model;
use crate::output::export::Format;
use crate::session::RecordOptions;

/// Time between two lines of progress without a terminal.
const LINE_INTERVAL: Duration = Duration::from_secs(5);

/// Capture, reconstruct and show live polarization images.
#[derive(Clone, Debug, clap::Args)]
pub struct Args {
    /// Shipped board, or a board file.
    #[arg(long, value_name = "NAME|FILE", default_value = "x86-sim")]
    pub board: String,
    /// End after N frames [default: run until interrupted].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    pub frames: Option<u64>,
    /// Folder for the results; created if needed.
    #[arg(long, value_name = "DIR", default_value = "out")]
    pub out: PathBuf,
    /// Address of the preview; port 0 takes a free port. Addresses other than loopback need --token.
    #[arg(long, value_name = "ADDR", default_value = "127.0.0.1:8080")]
    pub listen: SocketAddr,
    /// Token that clients of the preview must send [default: the variable STOKESCOPE_TOKEN, if set].
    #[arg(long, value_name = "TOKEN")]
    pub token: Option<String>,
    /// Name under which a proxy or a name server presents this machine; can be repeated; added to its own names and those of the board file.
    #[arg(long, value_name = "NAME", value_parser = host_name)]
    pub allow_host: Vec<String>,
    /// Do not start the preview; no port is opened.
    #[arg(long)]
    pub no_preview: bool,
    /// Begin with the setup of the bundle, though there is one; without one `run` does so by itself.
    #[arg(long, conflicts_with_all = ["no_preview", "frames"])]
    pub setup: bool,
    /// Solver iterations [default: the board's].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    pub iterations: Option<u32>,
    /// Frame rate to hold by reducing iterations and picture size, which is reported: auto is the rate of the raw camera, off never
    /// reduces quality [default: auto; off with --frames].
    #[arg(long, value_name = "auto|off|N", value_parser = parse_target)]
    pub fps: Option<Target>,
    /// Allow viewers to change iterations, quality and background; viewers with the token always may.
    #[arg(long)]
    pub control: bool,
    /// Record every frame to a session in DIR: raw, guide, result and metadata. A slow or full disk does not stop the live view.
    #[arg(long, value_name = "DIR", group = "recording")]
    pub record: Option<PathBuf>,
    /// Let viewers record sessions to DIR: recording begins and ends when they ask for it, as far as they may change anything.
    #[arg(long, value_name = "DIR", group = "recording")]
    pub sessions: Option<PathBuf>,
    /// File format of recorded images.
    #[arg(long, value_name = "FORMAT", value_enum, default_value = "npy", requires = "recording")]
    pub record_format: Format,
    /// Number of recorded frames to keep over all sessions in DIR; the oldest are removed first [default: all].
    #[arg(long, value_name = "N", requires = "recording", value_parser = clap::value_parser!(u64).range(1..))]
    pub record_max_frames: Option<u64>,
    /// Bytes of recordings to keep over all sessions in DIR; the oldest are removed first [default: all].
    #[arg(long, value_name = "BYTES", requires = "recording", value_parser = clap::value_parser!(u64).range(1..))]
    pub record_max_bytes: Option<u64>,
    /// Free bytes on the disk below which recording pauses.
    #[arg(long, value_name = "BYTES", requires = "recording", default_value_t = 256 << 20)]
    pub record_reserve_bytes: u64,
    /// Shell command that receives events (cameras, saving, quality, machine) on its standard input, one JSON object per line.
    #[arg(long, value_name = "COMMAND")]
    pub on_event: Option<String>,
    /// Folder of sysfs, for temperature and throttling.
    #[arg(long, value_name = "DIR", default_value = "/sys", hide = true)]
    pub sysfs: PathBuf,
    /// Fusion model: a name, its folder or its manifest; auto is the best shipped one that the board's time and memory allow [default: the board's].
    #[arg(long, value_name = "auto|off|NAME|FILE", value_parser = super::parse_fusion)]
    pub fusion: Option<model::Choice>,
}

/// Runs the service on a board.
///
/// # Errors
/// A board that is not usable, or an error of the service.
pub fn run(args: &Args, json: bool) -> Result<(), Error> {
    let mut board = Board::load(&args.board)?;
    if let Some(model) = &args.fusion {
        board.fusion.model = model.clone();
    }
    // a variable that is empty is one that is not set
    let token = args.token.clone().or_else(|| std::env::var(TOKEN_VARIABLE).ok().filter(|token| !token.is_empty()));
    let record = args.record.as_ref().or(args.sessions.as_ref()).map(|dir| RecordOptions {
        dir: dir.clone(),
        format: args.record_format,
        max_frames: args.record_max_frames,
        max_bytes: args.record_max_bytes,
        reserve_bytes: args.record_reserve_bytes,
    });
    let options = Options {
        frames: args.frames,
        iterations: args.iterations.map(|n| n as usize),
        preview: (!args.no_preview).then_some(Preview { listen: args.listen, token, hosts: args.allow_host.clone() }),
        record,
        record_at_once: args.record.is_some(),
        control: args.control,
        target: args.fps.unwrap_or(if args.frames.is_some() { Target::Off } else { Target::Camera }),
        on_event: args.on_event.clone(),
        sysfs: args.sysfs.clone(),
        ..Options::new(board, args.out.clone())
    };
    let interrupted = interrupts()?;
    let watched = options.preview.is_some() && options.frames.is_none();
    let listener = if args.setup || (watched && Setup::is_needed(&options.board)) {
        match set_up(&options, &interrupted, json)? {
            Some(listener) => Some(listener),
            None => return Ok(()),
        }
    } else {
        None
    };
    serve(&options, listener, &interrupted, json).map(drop)
}

/// Serves the setup until the bundle is in place, or until a signal, which is reported. Gives the socket that goes on listening.
///
/// # Errors
/// Those of [`Setup::start`].
#[allow(clippy::print_stdout, reason = "output of the command")]
fn set_up(options: &Options, interrupted: &AtomicBool, json: bool) -> Result<Option<TcpListener>, Error> {
    let setup = Setup::start(options)?;
    tracing::info!("preview: http://{}/", setup.address());
    tracing::info!("the page leads through the setup of the bundle");
    let mut manager = SetupManager::default();
    let SetupSummary { mode, bundle, missing, listener } = setup.wait(|progress| {
        manager.notify(progress);
        interrupted.load(Ordering::Relaxed)
    })?;
    if listener.is_some() {
        tracing::info!("{}: the bundle is in place; the live service begins", bundle.display());
        return Ok(listener);
    }
    let summary = SetupSummary { mode, bundle, missing, listener: None };
    if json {
        println!("{}", serde_json::to_string(&summary).map_err(|e| Error::Internal(e.to_string()))?);
    } else {
        let missing: Vec<_> = summary.missing.iter().map(|step| step.name()).collect();
        let left = if missing.is_empty() { "nothing but to start it".to_owned() } else { missing.join(", ") };
        println!("Setup of {} interrupted; left to do: {left}.", summary.bundle.display());
    }
    Ok(None)
}

/// Notifications to the service manager during setup: ready with the first frame, alive with every further one.
#[derive(Default)]
struct SetupManager {
    frames: u64,
    said: Option<Instant>,
}

impl SetupManager {
    fn notify(&mut self, progress: &SetupProgress) {
        if progress.frames == self.frames || self.said.is_some_and(|said| said.elapsed() < Duration::from_secs(1)) {
            return;
        }
        self.frames = progress.frames;
        let text = format!("setup, left to do: {}", progress.missing.join(", "));
        let mut state = vec![NotifyState::Watchdog, NotifyState::Status(&text)];
        if self.said.replace(Instant::now()).is_none() {
            state.push(NotifyState::Ready);
        }
        // fails without a service manager
        let _ = sd_notify::notify(&state);
    }
}

/// Runs the service until its last frame or a signal, which `interrupted` tells, at the socket `listener` where one listens already. Notifies
/// the service manager (systemd), and prints the summary.
///
/// # Errors
/// The service cannot start, or ends with an error.
#[allow(clippy::print_stdout, reason = "output of the command")]
pub(super) fn serve(
    options: &Options,
    listener: Option<TcpListener>,
    interrupted: &AtomicBool,
    json: bool,
) -> Result<Summary, Error> {
    let frames = options.frames;
    let shot = Arc::new(AtomicBool::new(false));
    signal_hook::flag::register(SIGUSR1, Arc::clone(&shot)).map_err(|e| Error::Internal(format!("signals: {e}")))?;
    let service = Service::start_on(options, listener)?;
    let shutter = service.shutter();
    if let Some(address) = service.address() {
        tracing::info!("preview: http://{address}/");
    }
    let mut reporter = Reporter::new(frames);
    let mut manager = Manager::new();
    let ended = service.wait(|progress| {
        reporter.show(progress);
        manager.notify(progress);
        if shot.swap(false, Ordering::Relaxed) && !shutter.release() {
            tracing::warn!(
                "SIGUSR1: every pair is processed; single pairs need single_shots = true in [cameras] of the board"
            );
        }
        interrupted.load(Ordering::Relaxed)
    });
    reporter.finish();
    let summary = ended?;
    if json {
        println!("{}", serde_json::to_string(&summary).map_err(|e| Error::Internal(e.to_string()))?);
    } else {
        println!("{}", sentence(&summary));
    }
    Ok(summary)
}

/// Parses `--fps`.
fn parse_target(text: &str) -> Result<Target, String> {
    match text {
        "auto" => Ok(Target::Camera),
        "off" => Ok(Target::Off),
        _ => match text.parse() {
            Ok(fps) if (0.01..=1000.0).contains(&fps) => Ok(Target::Rate(fps)),
            _ => Err("allowed: auto, off, or 0.01 to 1000 frames per second".to_owned()),
        },
    }
}

/// Notifications to the service manager (`sd_notify`), if one started this program: ready with the first result, alive with every
/// further one. Nothing else resets the watchdog, so a service without results is restarted; one that waits for a trigger is alive too.
struct Manager {
    frames: u64,
    /// Whether the service manager knows that the service is ready.
    ready: bool,
    status: Instant,
}

impl Manager {
    fn new() -> Self {
        Self { frames: 0, ready: false, status: Instant::now() }
    }

    fn notify(&mut self, progress: &Progress) {
        if progress.frames == self.frames && !(progress.idle && self.status.elapsed() >= LINE_INTERVAL) {
            return;
        }
        let first = !std::mem::replace(&mut self.ready, true);
        self.frames = progress.frames;
        let mut state = vec![NotifyState::Watchdog];
        if first {
            state.push(NotifyState::Ready);
        }
        let rate = rate(Some(progress.fps), progress.target_fps);
        let text = format!("{} frames, {rate}, {} dropped", progress.frames, progress.dropped);
        if first || self.status.elapsed() >= LINE_INTERVAL {
            self.status = Instant::now();
            state.push(NotifyState::Status(&text));
        }
        // fails without a service manager
        let _ = sd_notify::notify(&state);
    }
}

impl Drop for Manager {
    fn drop(&mut self) {
        let _ = sd_notify::notify(&[NotifyState::Stopping]);
    }
}

/// Returns a flag that SIGINT and SIGTERM set; a second signal ends the program at once. It is asked for once: a signal between two flags
/// would be lost.
pub(super) fn interrupts() -> Result<Arc<AtomicBool>, Error> {
    let flag = Arc::new(AtomicBool::new(false));
    let failed = |e| Error::Internal(format!("signals: {e}"));
    for signal in [SIGINT, SIGTERM] {
        signal_hook::flag::register_conditional_shutdown(signal, 128 + signal, Arc::clone(&flag)).map_err(failed)?;
        signal_hook::flag::register(signal, Arc::clone(&flag)).map_err(failed)?;
    }
    Ok(flag)
}

/// The frame rate reached, and of it the one asked for.
fn rate(reached: Option<f64>, target: Option<f64>) -> String {
    let asked = target.map(|fps| format!(" of {fps:.1}")).unwrap_or_default();
    format!("{}{asked} per second", number(reached))
}

fn number(value: Option<f64>) -> String {
    value.map_or("–".to_owned(), |v| format!("{v:.1}"))
}

/// One line that sums up a run.
fn sentence(s: &Summary) -> String {
    format!(
        "{}: {} frames, {}, delay {} ms (95 %: {} ms), {} dropped, {} unpaired, {} without a result",
        s.out.display(),
        s.frames,
        rate(s.fps, s.target_fps),
        number(s.latency_ms.p50.map(f64::from)),
        number(s.latency_ms.p95.map(f64::from)),
        s.dropped.raw,
        s.dropped.unpaired,
        s.failed,
    )
}

/// Progress display: a bar on a terminal, otherwise a line from time to time.
struct Reporter {
    bar: Option<ProgressBar>,
    last_line: Instant,
}

impl Reporter {
    fn new(frames: Option<u64>) -> Self {
        let bar = std::io::stderr().is_terminal().then(|| {
            let (bar, template) = match frames {
                Some(n) => (ProgressBar::new(n), "{bar:30} {pos}/{len} frames{msg}"),
                None => (ProgressBar::new_spinner(), "{spinner} {pos} frames{msg}"),
            };
            // the templates are valid constants; the library's default is never used
            bar.with_style(ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar()))
        });
        Self { bar, last_line: Instant::now() }
    }

    fn show(&mut self, progress: &Progress) {
        let delay = progress.latency_ms.map(|ms| format!(", delay {ms:.0} ms")).unwrap_or_default();
        let rate = rate(Some(progress.fps), progress.target_fps);
        let text = format!(", {rate}{delay}, {} dropped", progress.dropped);
        match &self.bar {
            Some(bar) => {
                bar.set_message(text);
                bar.set_position(progress.frames);
            }
            None if self.last_line.elapsed() >= LINE_INTERVAL => {
                self.last_line = Instant::now();
                tracing::info!("{} frames{text}", progress.frames);
            }
            None => {}
        }
    }

    fn finish(&self) {
        self.bar.iter().for_each(ProgressBar::finish_and_clear);
    }
}
