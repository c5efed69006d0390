//! `stokescope calibrate`: makes or updates a device bundle in steps.

mod demo;

use std::io::{BufRead, IsTerminal};
use std::path::{Path, PathBuf};
use std::time::Duration;

use serde_json::json;

use super::reconstruct::read;
use crate::Error;
use crate::board::{Board, CameraSpec};
use crate::bundle::{Bundle, CameraId, Draft, DraftError};
use crate::camera::{self, Clock, Request, Role};
use crate::output::panel::write_png;
use stokescope_core::calibrate::{CalibrateError, Outcome, Shots, View, align, dark, mask, psf, verify, white};
use stokescope_core::image::{Size, Stack};
use stokescope_core::polarization::Angle;
use stokescope_core::readings::{Unit, unpack};

/// Time limit for a frame.
const FRAME_LIMIT: Duration = Duration::from_secs(20);

/// Make or update a device bundle in steps. Each step can be repeated alone.
///
/// The usual order is dark, mask, psf, align, verify; a colour sensor also needs white.
#[derive(Clone, Debug, clap::Args)]
#[command(args_conflicts_with_subcommands = true)]
pub struct Args {
    /// Take all steps on simulated cameras with typical flaws of a hand-built device, and evaluate the result.
    #[arg(long, required = true)]
    pub demo: bool,
    /// Folder for the bundle and pictures of the demonstration [default: they are not kept].
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Seed of the simulated device.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Side length of the simulated sensor in pixels.
    #[arg(long, value_name = "N", default_value_t = 250, value_parser = clap::value_parser!(u32).range(96..=1024))]
    pub size: u32,
    /// Scene for the evaluation.
    #[arg(long, default_value = "plastic")]
    pub scene: String,
    /// Simulate a sensor with three colour channels.
    #[arg(long)]
    pub rgb: bool,
    /// Calibration step.
    #[command(subcommand)]
    pub step: Option<Step>,
}

/// Calibration steps.
#[derive(Clone, Debug, clap::Subcommand)]
pub enum Step {
    /// Measure black level, dark frame, read noise and hot pixels: cover the sensor.
    Dark(DarkArgs),
    /// Measure the polarizer mask: remove the diffuser, use uniform light through a polarizer at three or more known angles.
    Mask(MaskArgs),
    /// Measure the point spread function: a small light source in a dark room.
    Psf(PsfArgs),
    /// Measure the white balance: a white surface that fills the view.
    White(FrameArgs),
    /// Measure the position of the guide camera: one printed target in view of both cameras.
    Align(PairArgs),
    /// Test the whole device with Malus's law: a lamp behind a polarizer at two or more known angles.
    Verify(VerifyArgs),
}

/// FrameArgs of the frames, and destination of the result.
#[derive(Clone, Debug, clap::Args)]
pub struct FrameArgs {
    /// Folder of the device bundle to make or update.
    #[arg(long, value_name = "DIR")]
    pub bundle: PathBuf,
    /// Read frames from NPY, TIFF or PNG files.
    #[arg(long, value_name = "FILE", num_args = 1.., conflicts_with = "board", required_unless_present = "board")]
    pub from: Vec<PathBuf>,
    /// Take frames from the cameras of a board: a shipped one, or a board file.
    #[arg(long, value_name = "NAME|FILE")]
    pub board: Option<String>,
    /// Number of camera frames to average for each view.
    #[arg(long, value_name = "N", default_value_t = 16, value_parser = clap::value_parser!(u32).range(1..=1000))]
    pub frames: u32,
    /// PNG picture of the result [default: STEP.png in the bundle].
    #[arg(long, value_name = "FILE")]
    pub out: Option<PathBuf>,
}

/// Arguments of `dark`.
#[derive(Clone, Debug, clap::Args)]
pub struct DarkArgs {
    /// Frames and bundle.
    #[command(flatten)]
    pub source: FrameArgs,
    /// Significant bits of the counts in files [default: 8 or 16, as stored]; cameras report their own.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(8..=16))]
    pub bits: Option<u32>,
}

/// Arguments of `mask`.
#[derive(Clone, Debug, clap::Args)]
pub struct MaskArgs {
    /// Frames and bundle.
    #[command(flatten)]
    pub source: FrameArgs,
    /// Angles of the polarizer in degrees, one view each; the files are divided equally among them, in order.
    #[arg(long, value_name = "DEG", num_args = 1.., value_delimiter = ',', allow_negative_numbers = true, required = true)]
    pub angles: Vec<f64>,
    /// Reading of the polarizer's dial when its axis is parallel to the rows of the sensor.
    #[arg(long, value_name = "DEG", default_value_t = 0.0, allow_negative_numbers = true)]
    pub zero: f64,
    /// Nominal angles of the mask in degrees, in stripe order.
    #[arg(long, value_name = "DEG", num_args = 3.., value_delimiter = ',', default_values_t = [0.0, 45.0, 90.0, 135.0])]
    pub mask_angles: Vec<f64>,
    /// Number of vertical stripes over the width.
    #[arg(long, value_name = "N", default_value_t = 16, value_parser = clap::value_parser!(u32).range(3..=4096))]
    pub stripes: u32,
}

/// Arguments of `psf`.
#[derive(Clone, Debug, clap::Args)]
pub struct PsfArgs {
    /// Frames and bundle.
    #[command(flatten)]
    pub source: FrameArgs,
    /// The mask is removed: do not correct for its transmission.
    #[arg(long)]
    pub unmasked: bool,
}

/// Arguments of `align`.
#[derive(Clone, Debug, clap::Args)]
pub struct PairArgs {
    /// Frames and bundle.
    #[command(flatten)]
    pub source: FrameArgs,
    /// Files with frames of the guide camera.
    #[arg(long, value_name = "FILE", num_args = 1.., requires = "from", required_unless_present = "board")]
    pub guide: Vec<PathBuf>,
}

/// Arguments of `verify`.
#[derive(Clone, Debug, clap::Args)]
pub struct VerifyArgs {
    /// Frames and bundle.
    #[command(flatten)]
    pub source: FrameArgs,
    /// Files with frames of the guide camera, equally many for each angle [default: no guide].
    #[arg(long, value_name = "FILE", num_args = 1.., requires = "from")]
    pub guide: Vec<PathBuf>,
    /// Angles of the polarizer in degrees, one view each; the files are divided equally among them, in order.
    #[arg(long, value_name = "DEG", num_args = 1.., value_delimiter = ',', allow_negative_numbers = true, required = true)]
    pub angles: Vec<f64>,
    /// Reading of the polarizer's dial when its axis is parallel to the rows of the sensor.
    #[arg(long, value_name = "DEG", default_value_t = 0.0, allow_negative_numbers = true)]
    pub zero: f64,
}

/// Takes one step, or all steps on simulated cameras, and prints the quality of the result.
///
/// # Errors
/// Those of the step, the cameras and the files.
pub fn run(args: &Args, json: bool) -> Result<(), Error> {
    match &args.step {
        None => demonstrate(args, json),
        Some(Step::Dark(args)) => run_dark(args, json),
        Some(Step::Mask(args)) => run_mask(args, json),
        Some(Step::Psf(args)) => run_psf(args, json),
        Some(Step::White(source)) => run_white(source, json),
        Some(Step::Align(args)) => run_align(args, json),
        Some(Step::Verify(args)) => run_verify(args, json),
    }
}

fn run_dark(args: &DarkArgs, json: bool) -> Result<(), Error> {
    let captured = Captured::raw(&args.source)?;
    let mut draft = Draft::open(&args.source.bundle)?;
    tie(&mut draft, captured.camera.as_ref())?;
    let found = dark::measure(&captured.shots, args.bits.or(captured.bits).unwrap_or(16))?;
    draft.set_dark(&found);
    finish(Some(draft), &found.outcome(), &args.source, json)
}

fn run_mask(args: &MaskArgs, json: bool) -> Result<(), Error> {
    let mut draft = Draft::open(&args.source.bundle)?;
    let levels = draft.levels("mask")?;
    let (views, camera) = views(&args.source, &args.angles, args.zero)?;
    tie(&mut draft, camera.as_ref())?;
    let angles = args.mask_angles.iter().copied().map(Angle::from_degrees).collect();
    let found = mask::measure(&views, &levels, &mask::Layout { angles, stripes: args.stripes as usize })?;
    draft.set_mask(&found);
    finish(Some(draft), &found.outcome(), &args.source, json)
}

fn run_psf(args: &PsfArgs, json: bool) -> Result<(), Error> {
    let mut draft = Draft::open(&args.source.bundle)?;
    let levels = draft.levels("psf")?;
    let captured = Captured::raw(&args.source)?;
    tie(&mut draft, captured.camera.as_ref())?;
    let mask = draft.known.response.as_ref().filter(|_| !args.unmasked);
    let found = psf::measure(&captured.shots, &levels, mask)?;
    draft.set_psf(&found);
    finish(Some(draft), &found.outcome(), &args.source, json)
}

fn run_white(source: &FrameArgs, json: bool) -> Result<(), Error> {
    let mut draft = Draft::open(&source.bundle)?;
    let levels = draft.levels("white")?;
    let captured = Captured::raw(source)?;
    tie(&mut draft, captured.camera.as_ref())?;
    let found = white::measure(&captured.shots, &levels)?;
    draft.set_white(&found);
    finish(Some(draft), &found.outcome(), source, json)
}

fn run_align(args: &PairArgs, json: bool) -> Result<(), Error> {
    let bundle = Bundle::load(&args.source.bundle)?;
    let captured = Captured::raw(&args.source)?;
    let mut draft = Draft::open(&args.source.bundle)?;
    tie(&mut draft, captured.camera.as_ref())?;
    let guide = match &args.source.board {
        Some(board) => live(guide_of(&Board::load(board)?)?, Role::Guide, args.source.frames)?.shots,
        None => from_files(&args.guide)?.shots,
    };
    let found = align::measure(&bundle, &captured.shots, &guide, threads())?;
    draft.set_alignment(&found);
    finish(Some(draft), &found.outcome(), &args.source, json)
}

fn run_verify(args: &VerifyArgs, json: bool) -> Result<(), Error> {
    let bundle = Bundle::load(&args.source.bundle)?;
    let (views, camera) = views(&args.source, &args.angles, args.zero)?;
    if let (Some(own), Some(found)) = (&bundle.camera, &camera) {
        own.check(found, &bundle.dir)?;
    }
    let guides = if args.guide.is_empty() {
        Vec::new()
    } else {
        // one guide frame per view is enough
        let each = args.guide.len() / args.angles.len();
        let views = divide(&args.guide, args.angles.len(), "--guide")?;
        from_files(&views.map(|files| files[each / 2].clone()).collect::<Vec<_>>())?.shots.frames
    };
    let found = verify::measure(&bundle, &views, &guides, threads())?;
    finish(None, &found.outcome(), &args.source, json)
}

fn guide_of(board: &Board) -> Result<&CameraSpec, Error> {
    board.guide.as_ref().ok_or_else(|| Error::Usage(format!("board {} has no guide camera to align", board.name)))
}

fn threads() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

fn tie(draft: &mut Draft, camera: Option<&CameraId>) -> Result<(), Error> {
    camera.map_or(Ok(()), |camera| draft.tie(camera)).map_err(Into::into)
}

/// Captured frames, with bit depth and identity of their camera where known.
struct Captured {
    shots: Shots,
    bits: Option<u32>,
    camera: Option<CameraId>,
}

impl Captured {
    /// Reads or captures frames of the lensless camera.
    fn raw(source: &FrameArgs) -> Result<Self, Error> {
        match &source.board {
            Some(board) => live(&Board::load(board)?.raw, Role::Raw, source.frames),
            None => from_files(&source.from),
        }
    }
}

fn from_files(files: &[PathBuf]) -> Result<Captured, Error> {
    let mut shots = Shots { frames: Vec::with_capacity(files.len()), unit: Unit::Counts };
    for (k, file) in files.iter().enumerate() {
        let (frame, unit) = read(file)?;
        if k > 0 && unit != shots.unit {
            return Err(Error::Usage(format!("{}: counts and floating-point frames cannot be mixed", file.display())));
        }
        shots.unit = unit;
        shots.frames.push(frame);
    }
    let eight = shots.unit == Unit::Counts && files.first().is_some_and(|file| is_eight_bit(file));
    Ok(Captured { shots, bits: eight.then_some(8), camera: None })
}

fn is_eight_bit(file: &Path) -> bool {
    matches!(crate::files::read_image(file), Ok(crate::files::Samples::U8(_)))
}

fn live(spec: &CameraSpec, role: Role, frames: u32) -> Result<Captured, Error> {
    let request =
        Request { source: spec.source.clone(), frame_rate: spec.frame_rate, ..Request::new(role, &Clock::default()) };
    let mut camera = camera::open(&spec.backend, &request)?;
    let info = camera.info().clone();
    let size: Size = info.format.plane_size(info.size);
    let mut shots = Shots { frames: Vec::with_capacity(frames as usize), unit: Unit::Counts };
    if info.format.bits().is_none() {
        shots.unit = Unit::FullScale;
    }
    for _ in 0..frames {
        let frame = camera.next_frame(FRAME_LIMIT)?;
        let mut planes = Stack::zeros(info.format.planes(), size);
        unpack(&frame, &mut planes).map_err(|e| Error::Internal(e.to_string()))?;
        shots.frames.push(planes);
    }
    Ok(Captured { shots, bits: info.format.bits(), camera: Some(info.id()) })
}

/// Divides files equally among `count` views, in order.
fn divide<'a>(files: &'a [PathBuf], count: usize, option: &str) -> Result<std::slice::ChunksExact<'a, PathBuf>, Error> {
    if files.is_empty() || !files.len().is_multiple_of(count) {
        let found = files.len();
        return Err(Error::Usage(format!(
            "{option}: {found} files for {count} angles, allowed: an equal number for each angle"
        )));
    }
    Ok(files.chunks_exact(files.len() / count))
}

/// Frames of one view per angle of the dial, in degrees: from files in order, or from a camera after the user has turned the polarizer.
fn views(source: &FrameArgs, dial: &[f64], zero: f64) -> Result<(Vec<View>, Option<CameraId>), Error> {
    let angle = |dial: f64| Angle::from_degrees(dial - zero);
    let Some(board) = &source.board else {
        let files = divide(&source.from, dial.len(), "--from")?;
        let views = dial.iter().zip(files).map(|(dial, files)| Ok((angle(*dial), from_files(files)?.shots)));
        return Ok((views.collect::<Result<_, Error>>()?, None));
    };
    let (board, mut id) = (Board::load(board)?, None);
    let mut views = Vec::with_capacity(dial.len());
    for dial in dial {
        tracing::info!("turn the polarizer to {dial}° and press Enter");
        let mut line = String::new();
        let read = std::io::stdin().lock().read_line(&mut line);
        if !matches!(read, Ok(n) if n > 0) {
            let how =
                if std::io::stdin().is_terminal() { "" } else { " (standard input is not a terminal and has ended)" };
            return Err(Error::Usage(format!(
                "the polarizer has not been turned to {dial}°{how}; turn it and press Enter"
            )));
        }
        let captured = live(&board.raw, Role::Raw, source.frames)?;
        id = captured.camera;
        views.push((angle(*dial), captured.shots));
    }
    Ok((views, id))
}

/// Writes the changed bundle, if any, and the picture; prints the verdict.
#[allow(clippy::print_stdout, reason = "output of the command")]
fn finish(draft: Option<Draft>, outcome: &Outcome, source: &FrameArgs, json: bool) -> Result<(), Error> {
    let bundle = draft.map(Draft::commit).transpose()?.flatten();
    let picture = source.out.clone().unwrap_or_else(|| source.bundle.join(format!("{}.png", outcome.step)));
    write_png(&picture, &outcome.picture)?;
    if json {
        let mut output = json!(outcome);
        output["bundle"] = json!(source.bundle);
        output["calibration"] = json!(bundle.map(|bundle| bundle.digest));
        output["picture"] = json!(picture);
        println!("{output}");
    } else {
        println!("{}", outcome.verdict);
    }
    Ok(())
}

#[allow(clippy::print_stdout, reason = "output of the command")]
fn demonstrate(args: &Args, json: bool) -> Result<(), Error> {
    let temporary = tempfile::tempdir().map_err(|e| Error::Internal(format!("temporary folder: {e}")))?;
    let dir = args.out.as_deref().unwrap_or(temporary.path());
    let side = args.size as usize;
    let spec = demo::Spec {
        scene: args.scene.clone(),
        size: Size::new(side, side),
        color: args.rgb,
        seed: args.seed,
        threads: threads(),
    };
    let mut outcomes = Vec::new();
    let summary = demo::run(&spec, dir, |outcome| {
        if !json {
            println!("{:>6}: {}", outcome.step, outcome.verdict);
        }
        outcomes.push(outcome.clone());
    })?;
    if let Some(out) = &args.out {
        for outcome in &outcomes {
            write_png(&out.join(format!("{}.png", outcome.step)), &outcome.picture)?;
        }
    }
    if json {
        println!("{}", json!({ "steps": outcomes, "summary": summary }));
    } else {
        let row = |name: &str, score: demo::Score| {
            println!("{name:<26} {:6.2} dB   S1, S2 {:6.2} dB", score.psnr, score.s12_psnr);
        };
        row("calibrated", summary.calibrated);
        row("perfect knowledge", summary.exact);
        row("without calibration", summary.nominal);
        let (loss, homography, mask) = demo::ALLOWED;
        println!("loss to perfect knowledge  {:6.2} dB   (allowed {loss})", summary.loss_db);
        println!("homography                 {:6.2} px   (allowed {homography})", summary.homography_px);
        println!(
            "mask angles, largest error {:6.2}°     (allowed {mask}), rms {:.2}°",
            summary.mask_angle_max_deg, summary.mask_angle_rms_deg
        );
    }
    if summary.passed {
        Ok(())
    } else {
        Err(Error::Internal("the demonstration exceeds the allowed errors".to_owned()))
    }
}

impl From<DraftError> for Error {
    fn from(e: DraftError) -> Self {
        match e {
            DraftError::Bundle(e) => e.into(),
            DraftError::Write(e) => e.into(),
        }
    }
}

impl From<CalibrateError> for Error {
    /// Keeps the exit codes of planning and processing errors.
    fn from(e: CalibrateError) -> Self {
        match e {
            CalibrateError::Plan(e) => e.into(),
            CalibrateError::Process(e) => e.into(),
            e => Self::Calibrate(Box::new(e)),
        }
    }
}
