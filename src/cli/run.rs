//! `stokescope run`: live reconstruction with preview and recording.

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
use crate::live::{Options, Preview, Progress, Service, Summary, Target};
use crate::model;
use crate::output::export::Format;
use crate::session::RecordOptions;

/// Pause between two lines of progress where there is no terminal.
const LINE_EVERY: Duration = Duration::from_secs(5);
/// Environment variable with the token: other users do not see it, unlike the command line.
const TOKEN_VARIABLE: &str = "STOKESCOPE_TOKEN";

/// Options of `stokescope run`.
#[derive(Clone, Debug, clap::Args)]
pub struct Args {
    /// Name of a shipped board, or the file of one.
    #[arg(long, value_name = "NAME|FILE", default_value = "x86-sim")]
    pub board: String,
    /// Process N frames, then end [default: run until interrupted].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    pub frames: Option<u64>,
    /// Folder of the results; made if it does not exist.
    #[arg(long, value_name = "DIR", default_value = "out")]
    pub out: PathBuf,
    /// Address of the preview. Port 0 takes a free one. Addresses other than loopback ones need --token.
    #[arg(long, value_name = "ADDR", default_value = "127.0.0.1:8080")]
    pub listen: SocketAddr,
    /// Secret that clients of the preview must send [default: the variable STOKESCOPE_TOKEN, if set].
    #[arg(long, value_name = "TOKEN")]
    pub token: Option<String>,
    /// Run without a preview and open no port.
    #[arg(long)]
    pub no_preview: bool,
    /// Iterations of the solver [default: the board's].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    pub iterations: Option<u32>,
    /// Frames per second to hold, with fewer iterations and smaller pictures if need be; auto is the raw camera's rate, off keeps
    /// the quality however long it takes [default: auto; off with --frames].
    #[arg(long, value_name = "auto|off|N", value_parser = parse_target)]
    pub fps: Option<Target>,
    /// Let watchers change iterations, quality and background. Those with a token always may.
    #[arg(long)]
    pub control: bool,
    /// Record every frame into a session in DIR: raw, guide, result and a sidecar. The live view goes on when the disk is slow or
    /// full.
    #[arg(long, value_name = "DIR")]
    pub record: Option<PathBuf>,
    /// Format of recorded images.
    #[arg(long, value_name = "FORMAT", value_enum, default_value = "npy", requires = "record")]
    pub record_format: Format,
    /// Keep at most N recorded frames, over all sessions in DIR; the oldest are removed first [default: keep all].
    #[arg(long, value_name = "N", requires = "record", value_parser = clap::value_parser!(u64).range(1..))]
    pub record_max_frames: Option<u64>,
    /// Keep at most BYTES, over all sessions in DIR; the oldest frames are removed first [default: keep all].
    #[arg(long, value_name = "BYTES", requires = "record", value_parser = clap::value_parser!(u64).range(1..))]
    pub record_max_bytes: Option<u64>,
    /// Bytes of the disk that stay free. Recording pauses while fewer are free.
    #[arg(long, value_name = "BYTES", requires = "record", default_value_t = 256 << 20)]
    pub record_reserve_bytes: u64,
    /// Shell command that reads events (cameras, saving, quality, machine) from its input, one JSON object a line.
    #[arg(long, value_name = "COMMAND")]
    pub on_event: Option<String>,
    /// Folder in which the kernel reports the machine's state.
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
/// The failure to start the service, or the failure that ended it.
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
        &Options {
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

/// Runs a service until it has processed its frames or a signal ends it. Reports progress to the service manager and prints the
/// summary.
///
/// # Errors
/// The failure to start the service, or the failure that ended it.
#[allow(clippy::print_stdout, reason = "the command's answer")]
pub(super) fn serve(options: &Options, json: bool) -> Result<(), Error> {
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

/// Parses the value of `--fps`.
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

/// Reports to the service manager, if one started this program: ready with the first result, alive with every further one. Nothing
/// else feeds its watchdog, so a service without results is started again.
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
        // this fails when there is no service manager
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

/// One line that sums up a run.
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

/// Progress of the run: a bar on a terminal, otherwise a line now and then.
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
            // the templates are constants and valid
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
