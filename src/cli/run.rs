//! `stokescope run`: the main job, live.

use std::io::IsTerminal;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};
use sd_notify::NotifyState;
use signal_hook::consts::{SIGINT, SIGTERM};

use crate::Error;
use crate::board::Board;
use crate::model;
use crate::output::export::Format;
use crate::service::{Options, Preview, Progress, RecordOptions, Service, Summary, Target};

/// Pause between two lines of progress where there is no terminal.
const LINE_EVERY: Duration = Duration::from_secs(5);
/// Where the token may stand instead, out of sight of other users.
const TOKEN_VARIABLE: &str = "STOKESCOPE_TOKEN";

/// What to run, and where its results go.
#[derive(Clone, Debug, clap::Args)]
pub struct Args {
    /// Shipped board, or the file of one.
    #[arg(long, value_name = "NAME|FILE", default_value = "x86-sim")]
    pub board: String,
    /// Process N frames, then end [default: run until interrupted].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    pub frames: Option<u64>,
    /// Folder of the results; made if need be.
    #[arg(long, value_name = "DIR", default_value = "out")]
    pub out: PathBuf,
    /// Address of the preview. Port 0 takes a free one. Any but a loopback address needs --token.
    #[arg(long, value_name = "ADDR", default_value = "127.0.0.1:8080")]
    pub listen: SocketAddr,
    /// What clients of the preview must know [default: the variable STOKESCOPE_TOKEN, if set].
    #[arg(long, value_name = "TOKEN")]
    pub token: Option<String>,
    /// No preview: no port is opened.
    #[arg(long)]
    pub no_preview: bool,
    /// Iterations of the solver [default: the board's].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    pub iterations: Option<u32>,
    /// Hold so many frames per second with fewer iterations and smaller pictures, and say so; auto is the raw camera's rate, off
    /// does what was asked for however long it takes [default: auto; off with --frames].
    #[arg(long, value_name = "auto|off|N", value_parser = parse_target)]
    pub fps: Option<Target>,
    /// Let watchers change iterations, quality and background; those with a token always may.
    #[arg(long)]
    pub control: bool,
    /// Record every frame into a session in DIR: raw, guide, result and a sidecar. The live view goes on when the disk is slow or full.
    #[arg(long, value_name = "DIR")]
    pub record: Option<PathBuf>,
    /// Format of what is recorded.
    #[arg(long, value_name = "FORMAT", value_enum, default_value = "npy", requires = "record")]
    pub record_format: Format,
    /// Keep so many recorded frames, over all sessions in DIR; the oldest go first [default: all].
    #[arg(long, value_name = "N", requires = "record", value_parser = clap::value_parser!(u64).range(1..))]
    pub record_max_frames: Option<u64>,
    /// Keep so many bytes, over all sessions in DIR; the oldest go first [default: all].
    #[arg(long, value_name = "BYTES", requires = "record", value_parser = clap::value_parser!(u64).range(1..))]
    pub record_max_bytes: Option<u64>,
    /// Bytes of the disk that stay free: recording pauses below.
    #[arg(long, value_name = "BYTES", requires = "record", default_value_t = 256 << 20)]
    pub record_reserve_bytes: u64,
    /// Shell command that reads what happens (cameras, saving, quality, machine) from its input, one JSON object a line.
    #[arg(long, value_name = "COMMAND")]
    pub on_event: Option<String>,
    /// Where the kernel tells how the machine fares.
    #[arg(long, value_name = "DIR", default_value = "/sys", hide = true)]
    pub sysfs: PathBuf,
    /// Fusion model: auto is physics only so far; or a name, the folder of a model or its manifest [default: the
    /// board's].
    #[arg(long, value_name = "auto|off|NAME|FILE", value_parser = super::parse_fusion)]
    pub fusion: Option<model::Choice>,
}

/// Runs the service on a board.
///
/// # Errors
/// What keeps the service from starting, or ended it.
pub fn run(args: &Args, json: bool) -> Result<(), Error> {
    let mut board = Board::load(&args.board)?;
    if let Some(model) = &args.fusion {
        board.fusion.model = model.clone();
    }
    let token = args.token.clone().or_else(|| std::env::var(TOKEN_VARIABLE).ok());
    let record = args.record.as_ref().map(|dir| RecordOptions {
        dir: dir.clone(),
        format: args.record_format,
        max_frames: args.record_max_frames,
        max_bytes: args.record_max_bytes,
        reserve_bytes: args.record_reserve_bytes,
    });
    serve(
        Options {
            frames: args.frames,
            iterations: args.iterations.map(|n| n as usize),
            preview: (!args.no_preview).then_some(Preview { listen: args.listen, token }),
            record,
            control: args.control,
            target: args.fps.unwrap_or(if args.frames.is_some() { Target::Off } else { Target::Camera }),
            on_event: args.on_event.clone(),
            sysfs: args.sysfs.clone(),
            ..Options::new(board, args.out.clone())
        },
        json,
    )
}

/// Runs a service until it has its frames or a signal ends it; tells the service manager how it goes and prints the summary.
///
/// # Errors
/// What keeps the service from starting, or ended it.
#[allow(clippy::print_stdout, reason = "the command's answer")]
pub(super) fn serve(options: Options, json: bool) -> Result<(), Error> {
    let interrupted = interrupts().map_err(|e| Error::Internal(format!("signals: {e}")))?;
    let frames = options.frames;
    let service = Service::start(options)?;
    if let Some(address) = service.address() {
        tracing::info!("preview: http://{address}/");
    }
    let mut reporter = Reporter::new(frames);
    let mut manager = Manager::new();
    let ended = service.wait(|progress| {
        reporter.show(progress);
        manager.tell(progress);
        interrupted.load(Ordering::Relaxed)
    });
    reporter.finish();
    let summary = ended?;
    if json {
        println!("{}", serde_json::to_string(&summary).map_err(|e| Error::Internal(e.to_string()))?);
    } else {
        println!("{}", sentence(&summary));
    }
    Ok(())
}

/// `--fps`.
fn parse_target(typed: &str) -> Result<Target, String> {
    match typed {
        "auto" => Ok(Target::Camera),
        "off" => Ok(Target::Off),
        _ => match typed.parse() {
            Ok(fps) if (0.01..=1000.0).contains(&fps) => Ok(Target::Rate(fps)),
            _ => Err("allowed: auto, off, or 0.01 to 1000 frames per second".to_owned()),
        },
    }
}

/// The service manager, if one started this program and wants to know: ready with the first result, alive with every further
/// one. Nothing else feeds its watchdog, so that a service which gives no results is started again.
struct Manager {
    frames: u64,
    status: Instant,
}

impl Manager {
    fn new() -> Self {
        Self { frames: 0, status: Instant::now() }
    }

    fn tell(&mut self, progress: &Progress) {
        if progress.frames == self.frames {
            return;
        }
        let first = self.frames == 0;
        self.frames = progress.frames;
        let mut state = vec![NotifyState::Watchdog];
        if first {
            state.push(NotifyState::Ready);
        }
        let text = format!("{} frames, {:.1} per second, {} dropped", progress.frames, progress.fps, progress.dropped);
        if first || self.status.elapsed() >= LINE_EVERY {
            self.status = Instant::now();
            state.push(NotifyState::Status(&text));
        }
        // nobody may be listening
        let _ = sd_notify::notify(&state);
    }
}

impl Drop for Manager {
    fn drop(&mut self) {
        let _ = sd_notify::notify(&[NotifyState::Stopping]);
    }
}

/// A flag that SIGINT and SIGTERM set; a second signal ends the program at once.
fn interrupts() -> std::io::Result<Arc<AtomicBool>> {
    let flag = Arc::new(AtomicBool::new(false));
    for signal in [SIGINT, SIGTERM] {
        signal_hook::flag::register_conditional_shutdown(signal, 128 + signal, Arc::clone(&flag))?;
        signal_hook::flag::register(signal, Arc::clone(&flag))?;
    }
    Ok(flag)
}

fn sentence(s: &Summary) -> String {
    let number = |value: Option<f64>| value.map_or("–".to_owned(), |v| format!("{v:.1}"));
    format!(
        "{}: {} frames, {} per second, delay {} ms (95 %: {} ms), {} dropped, {} unpaired, {} without a result",
        s.out.display(),
        s.frames,
        number(s.fps),
        number(s.latency_ms.p50.map(f64::from)),
        number(s.latency_ms.p95.map(f64::from)),
        s.dropped.raw,
        s.dropped.unpaired,
        s.failed,
    )
}

/// Progress: a bar on a terminal, else a line now and then.
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
            // the templates are constants; were one wrong, the library's own would do
            bar.with_style(ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar()))
        });
        Self { bar, last_line: Instant::now() }
    }

    fn show(&mut self, progress: &Progress) {
        let delay = progress.latency_ms.map(|ms| format!(", delay {ms:.0} ms")).unwrap_or_default();
        let text = format!(", {:.1} per second{delay}, {} dropped", progress.fps, progress.dropped);
        match &self.bar {
            Some(bar) => {
                bar.set_message(text);
                bar.set_position(progress.frames);
            }
            None if self.last_line.elapsed() >= LINE_EVERY => {
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
