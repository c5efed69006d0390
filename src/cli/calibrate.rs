//! `stokescope calibrate`: makes or updates a device bundle step by step.

mod demo;

use std::io::{BufRead, IsTerminal};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use serde_json::json;

use super::reconstruct::read;
use super::simulate::Beyond;
use crate::Error;
use crate::board::{Board, CameraSpec, Readout};
use crate::bundle::{Bundle, CameraId, Draft, DraftError};
use crate::camera::{self, Clock, Request, Role};
use crate::output::figure;
use crate::output::panel::write_png;
use stokescope_core::calibrate::{
    CalibrateError, Outcome, PolarizedShots, Remedy, Shots, Step, align, dark, mask, psf, verify, white,
};
use stokescope_core::image::{Size, Stack};
use stokescope_core::parallel::Workers;
use stokescope_core::polarization::Angle;
use stokescope_core::readings::{Binned, Binning, Unit, unpack};

/// Longest wait for a frame.
const PATIENCE: Duration = Duration::from_secs(20);

/// Make or update a device bundle, step by step. Each step can be repeated by itself.
///
/// The usual order: dark, mask, psf, align, verify; white as well for a colour sensor.
#[derive(Clone, Debug, clap::Args)]
#[command(args_conflicts_with_subcommands = true)]
pub struct Args {
    /// Go through all steps on simulated cameras with the flaws of a device built by hand, and judge the result.
    #[arg(long, required = true)]
    pub demo: bool,
    /// Folder that keeps the demonstration's bundle and pictures [default: none is kept].
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Seed of the demonstration's device.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Pixels of the demonstration's sensor.
    #[arg(long, value_name = "N", default_value_t = 250, value_parser = clap::value_parser!(u32).range(96..=1024))]
    pub size: u32,
    /// Scene the demonstration is judged on.
    #[arg(long, default_value = "plastic")]
    pub scene: String,
    /// Give the demonstration's sensor three colour channels.
    #[arg(long)]
    pub rgb: bool,
    /// Scene beyond the frame of the demonstration's device.
    #[command(flatten)]
    pub beyond: Beyond,
    /// A single step.
    #[command(subcommand)]
    pub step: Option<StepArgs>,
}

/// The steps and their arguments.
#[derive(Clone, Debug, clap::Subcommand)]
pub enum StepArgs {
    /// The covered sensor: black level, dark frame, read noise, hot pixels.
    Dark(DarkArgs),
    /// The polarizer mask: diffuser off, uniform light behind a polarizer at three known angles or more.
    Mask(MaskArgs),
    /// The point spread function: a small light source in a dark room.
    Psf(PsfArgs),
    /// The white balance: a white surface that fills the view.
    White(Source),
    /// The alignment of the guide camera: one printed target in front of both cameras.
    Align(PairArgs),
    /// Malus's test of the whole device: a lamp behind a polarizer at two known angles or more.
    Verify(VerifyArgs),
}

/// The frames of a step, and the bundle they calibrate.
#[derive(Clone, Debug, clap::Args)]
pub struct Source {
    /// Device bundle to make or update.
    #[arg(long, value_name = "DIR")]
    pub bundle: PathBuf,
    /// Frames from files: NPY, TIFF or PNG.
    #[arg(long, value_name = "FILE", num_args = 1.., conflicts_with = "board", required_unless_present = "board")]
    pub from: Vec<PathBuf>,
    /// Frames from the cameras of a board: a shipped one, or the file of one.
    #[arg(long, value_name = "NAME|FILE")]
    pub board: Option<String>,
    /// Frames to average from a camera, for each view.
    #[arg(long, value_name = "N", default_value_t = 16, value_parser = clap::value_parser!(u32).range(1..=1000))]
    pub frames: u32,
    /// PNG picture of the result [default: STEP.png in the bundle].
    #[arg(long, value_name = "FILE")]
    pub out: Option<PathBuf>,
}

impl Source {
    /// The bundle to calibrate, and the board whose cameras do it. A new bundle takes over the part of the frame that the board uses.
    fn open(&self) -> Result<(Draft, Option<Board>), Error> {
        let mut draft = Draft::open(&self.bundle)?;
        let board = self.board.as_deref().map(Board::load).transpose()?;
        if let Some(board) = &board {
            draft.use_part(board.readout.as_ref().map(|readout| &readout.window), board.mounted)?;
        }
        Ok((draft, board))
    }
}

/// Arguments of `dark`.
#[derive(Clone, Debug, clap::Args)]
pub struct DarkArgs {
    /// Frames and bundle.
    #[command(flatten)]
    pub source: Source,
    /// Significant bits of the counts in files [default: the files' own]; cameras report theirs.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(8..=16))]
    pub bits: Option<u32>,
}

/// Arguments of `mask`.
#[derive(Clone, Debug, clap::Args)]
pub struct MaskArgs {
    /// Frames and bundle.
    #[command(flatten)]
    pub source: Source,
    /// Angles of the polarizer in degrees, one view each; the files are shared out among them in order.
    #[arg(long, value_name = "DEG", num_args = 1.., value_delimiter = ',', allow_negative_numbers = true, required = true)]
    pub angles: Vec<f64>,
    /// Reading of the polarizer's dial when its axis lies along the sensor's rows.
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
    pub source: Source,
    /// The mask is off: do not divide by its transmission.
    #[arg(long)]
    pub unmasked: bool,
}

/// Arguments of `align`.
#[derive(Clone, Debug, clap::Args)]
pub struct PairArgs {
    /// Frames and bundle.
    #[command(flatten)]
    pub source: Source,
    /// Frames of the guide camera from files.
    #[arg(long, value_name = "FILE", num_args = 1.., requires = "from", required_unless_present = "board")]
    pub guide: Vec<PathBuf>,
}

/// Arguments of `verify`.
#[derive(Clone, Debug, clap::Args)]
pub struct VerifyArgs {
    /// Frames and bundle.
    #[command(flatten)]
    pub source: Source,
    /// Frames of the guide camera from files, as many for each angle as raw ones [default: no guide].
    #[arg(long, value_name = "FILE", num_args = 1.., requires = "from")]
    pub guide: Vec<PathBuf>,
    /// Angles of the polarizer in degrees, one view each; the files are shared out among them in order.
    #[arg(long, value_name = "DEG", num_args = 1.., value_delimiter = ',', allow_negative_numbers = true, required = true)]
    pub angles: Vec<f64>,
    /// Reading of the polarizer's dial when its axis lies along the sensor's rows.
    #[arg(long, value_name = "DEG", default_value_t = 0.0, allow_negative_numbers = true)]
    pub zero: f64,
}

/// Takes one step, or all of them on simulated cameras, and prints how good the result is.
///
/// # Errors
/// Errors of the step, of cameras and of files.
pub fn run(args: &Args, json: bool) -> Result<(), Error> {
    match &args.step {
        None => demonstrate(args, json),
        Some(StepArgs::Dark(args)) => run_dark(args, json),
        Some(StepArgs::Mask(args)) => run_mask(args, json),
        Some(StepArgs::Psf(args)) => run_psf(args, json),
        Some(StepArgs::White(source)) => run_white(source, json),
        Some(StepArgs::Align(args)) => run_align(args, json),
        Some(StepArgs::Verify(args)) => run_verify(args, json),
    }
}

fn run_dark(args: &DarkArgs, json: bool) -> Result<(), Error> {
    let (mut draft, board) = args.source.open()?;
    let taken = Taken::raw(&args.source, board.as_ref(), None)?;
    fits(&taken, board.as_ref())?;
    tie(&mut draft, taken.camera.as_ref())?;
    let found = dark::measure_to(&taken.shots, args.bits.or(taken.bits).unwrap_or(16), taken.white)?;
    draft.set_dark(&found);
    finish(Some(draft), &found.outcome(), &args.source, json)
}

fn run_mask(args: &MaskArgs, json: bool) -> Result<(), Error> {
    let (mut draft, board) = args.source.open()?;
    let levels = draft.levels(Step::Mask)?;
    let (views, camera) = views(&args.source, board.as_ref(), &args.angles, args.zero, draft.binning())?;
    tie(&mut draft, camera.as_ref())?;
    let angles = args.mask_angles.iter().copied().map(Angle::from_degrees).collect();
    let found = mask::measure(&views, &levels, &mask::Layout { angles, stripes: args.stripes as usize })?;
    draft.set_mask(&found);
    finish(Some(draft), &found.outcome(), &args.source, json)
}

fn run_psf(args: &PsfArgs, json: bool) -> Result<(), Error> {
    let (mut draft, board) = args.source.open()?;
    let levels = draft.levels(Step::Psf)?;
    let taken = Taken::raw(&args.source, board.as_ref(), draft.binning().as_mut())?;
    tie(&mut draft, taken.camera.as_ref())?;
    let mask = draft.known.response.as_ref().filter(|_| !args.unmasked);
    let found = psf::measure(&taken.shots, &levels, mask)?;
    draft.set_psf(&found);
    finish(Some(draft), &found.outcome(), &args.source, json)
}

fn run_white(source: &Source, json: bool) -> Result<(), Error> {
    let (mut draft, board) = source.open()?;
    let levels = draft.levels(Step::White)?;
    let taken = Taken::raw(source, board.as_ref(), draft.binning().as_mut())?;
    tie(&mut draft, taken.camera.as_ref())?;
    let found = white::measure(&taken.shots, &levels)?;
    draft.set_white(&found);
    finish(Some(draft), &found.outcome(), source, json)
}

fn run_align(args: &PairArgs, json: bool) -> Result<(), Error> {
    let calibration = Bundle::load(&args.source.bundle)?;
    let (mut draft, board) = args.source.open()?;
    let taken = Taken::raw(&args.source, board.as_ref(), binning(&calibration).as_mut())?;
    tie(&mut draft, taken.camera.as_ref())?;
    let guide = match &board {
        Some(board) => live(board, Role::Guide, &args.source, None)?.shots,
        None => from_files(&args.guide, None)?.shots,
    };
    let found = align::measure(&calibration, &taken.shots, &guide, threads())?;
    draft.set_alignment(&found);
    finish(Some(draft), &found.outcome(), &args.source, json)
}

fn run_verify(args: &VerifyArgs, json: bool) -> Result<(), Error> {
    let calibration = Bundle::load(&args.source.bundle)?;
    let (_, board) = args.source.open()?;
    let (views, camera) = views(&args.source, board.as_ref(), &args.angles, args.zero, binning(&calibration))?;
    if let (Some(own), Some(found)) = (&calibration.camera, &camera) {
        own.check(found, &calibration.dir)?;
    }
    let guides = if args.guide.is_empty() {
        Vec::new()
    } else {
        // one guide frame of each view is enough
        let each = args.guide.len() / args.angles.len();
        let shown = shared(&args.guide, args.angles.len(), "--guide")?;
        from_files(&shown.map(|files| files[each / 2].clone()).collect::<Vec<_>>(), None)?.shots.frames
    };
    let found = verify::measure(&calibration, &views, &guides, threads())?;
    finish(None, &found.outcome(), &args.source, json)
}

fn guide_of(board: &Board) -> Result<&CameraSpec, Error> {
    board.guide.as_ref().ok_or_else(|| Error::Usage(format!("board {} has no guide camera to align", board.name)))
}

/// Binning of the camera's frames to the working size of a bundle; none where frames are used as they are.
fn binning(bundle: &Bundle) -> Option<Binning> {
    Binning::new(bundle, Arc::new(Workers::new(1)))
}

/// A frame at the working size and its unit: binned, or as it is where it has another size than the camera's frames.
fn binned(frame: Stack<f32>, unit: Unit, binning: Option<&mut Binning>) -> (Stack<f32>, Unit) {
    match binning {
        Some(binning) if frame.size() == binning.window().frame() => {
            let mut out = Binned::default();
            binning.image(&frame.view().in_unit(unit), &mut out);
            out.off_scale.iter().for_each(|found| tracing::warn!("{found}"));
            (out.values, Unit::Counts)
        }
        _ => (frame, unit),
    }
}

fn threads() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

/// Refuses frames that are not those of which the board uses a part.
fn fits(taken: &Taken, board: Option<&Board>) -> Result<(), Error> {
    let readout = board.and_then(|board| Some((&board.name, board.readout?)));
    let (Some((name, Readout { channels, window })), Some(frame)) = (readout, taken.shots.frames.first()) else {
        return Ok(());
    };
    if (frame.size(), frame.count()) == (window.frame(), channels) {
        return Ok(());
    }
    Err(Error::Usage(format!(
        "board {name}: [sensor] is for {channels} planes of {}, and its camera delivers {} of {}; set channels, crop and bin of [sensor] for \
         these frames",
        window.frame(),
        frame.count(),
        frame.size()
    )))
}

fn tie(draft: &mut Draft, camera: Option<&CameraId>) -> Result<(), Error> {
    camera.map_or(Ok(()), |camera| draft.tie(camera)).map_err(Into::into)
}

/// Frames and the camera they come from.
struct Taken {
    shots: Shots,
    bits: Option<u32>,
    /// Count of a full reading where the camera knows it, else infinite.
    white: f32,
    camera: Option<CameraId>,
}

impl Taken {
    /// Takes frames of the lensless camera, at the working size where there is a `binning`.
    fn raw(source: &Source, board: Option<&Board>, binning: Option<&mut Binning>) -> Result<Self, Error> {
        match board {
            Some(board) => live(board, Role::Raw, source, binning),
            None => from_files(&source.from, binning),
        }
    }
}

fn from_files(files: &[PathBuf], mut binning: Option<&mut Binning>) -> Result<Taken, Error> {
    let mut shots = Shots { frames: Vec::with_capacity(files.len()), unit: Unit::Counts };
    for (k, file) in files.iter().enumerate() {
        let (frame, unit) = read(file)?;
        let (frame, unit) = binned(frame, unit, binning.as_deref_mut());
        if k > 0 && unit != shots.unit {
            return Err(Error::Usage(format!("{}: counts and floating-point frames cannot be mixed", file.display())));
        }
        shots.unit = unit;
        shots.frames.push(frame);
    }
    let eight = shots.unit == Unit::Counts && files.first().is_some_and(|file| is_eight_bit(file));
    Ok(Taken { shots, bits: eight.then_some(8), white: f32::INFINITY, camera: None })
}

fn is_eight_bit(file: &Path) -> bool {
    matches!(crate::files::read_image(file), Ok(crate::files::Samples::U8(_)))
}

fn live(board: &Board, role: Role, source: &Source, mut binning: Option<&mut Binning>) -> Result<Taken, Error> {
    let frames = source.frames;
    let spec = if role == Role::Guide { guide_of(board)? } else { &board.raw };
    let orientation = Bundle::orientation_in(&source.bundle)?.or(board.mounted);
    let mut camera = camera::open(&spec.backend, &Request::of(role, spec, &Clock::default(), orientation))?;
    let info = camera.info().clone();
    let size: Size = info.format.plane_size(info.size);
    let unit = if info.format.bits().is_some() { Unit::Counts } else { Unit::FullScale };
    let mut shots = Shots { frames: Vec::with_capacity(frames as usize), unit };
    for _ in 0..frames {
        let frame = camera.next_frame(PATIENCE)?;
        let mut planes = Stack::zeros(info.format.planes(), size);
        unpack(&frame, &mut planes).map_err(|e| Error::Internal(e.to_string()))?;
        let (planes, unit) = binned(planes, unit, binning.as_deref_mut());
        shots.unit = unit;
        shots.frames.push(planes);
    }
    let white = info.levels.map_or(f32::INFINITY, |levels| levels.white);
    Ok(Taken { shots, bits: info.format.bits(), white, camera: info.id() })
}

/// The files of each of `count` views.
fn shared<'a>(files: &'a [PathBuf], count: usize, option: &str) -> Result<std::slice::ChunksExact<'a, PathBuf>, Error> {
    if files.is_empty() || !files.len().is_multiple_of(count) {
        let found = files.len();
        return Err(Error::Usage(format!(
            "{option}: {found} files for {count} angles, allowed: as many for each angle"
        )));
    }
    Ok(files.chunks_exact(files.len() / count))
}

/// One view for each reading of the polarizer's dial, from files in order, or from a camera with a pause to turn the polarizer.
fn views(
    source: &Source,
    board: Option<&Board>,
    dial: &[f64],
    zero: f64,
    mut binning: Option<Binning>,
) -> Result<(Vec<PolarizedShots>, Option<CameraId>), Error> {
    let angle = |dial: f64| Angle::from_degrees(dial - zero);
    let Some(board) = board else {
        let files = shared(&source.from, dial.len(), "--from")?;
        let views = dial.iter().zip(files).map(|(dial, files)| {
            Ok(PolarizedShots { angle: angle(*dial), shots: from_files(files, binning.as_mut())?.shots })
        });
        return Ok((views.collect::<Result<_, Error>>()?, None));
    };
    let mut id = None;
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
        let taken = live(board, Role::Raw, source, binning.as_mut())?;
        id = taken.camera;
        views.push(PolarizedShots { angle: angle(*dial), shots: taken.shots });
    }
    Ok((views, id))
}

/// The remedy in the terms of the command line.
fn advice(remedy: Remedy) -> String {
    match remedy {
        Remedy::MoreFrames => "take more frames with --frames or --from".to_owned(),
        Remedy::RunFirst(step) => format!("run `stokescope calibrate {step}` first"),
        Remedy::Repeat(step) => format!("run `stokescope calibrate {step}` and the steps after it again"),
        Remedy::FiniteAngles => "give --angles and --zero as numbers of degrees".to_owned(),
        Remedy::ExposeLonger => {
            "expose longer, brighten the source or average more frames with --frames or --from".to_owned()
        }
        Remedy::SameZero => "run `stokescope calibrate mask` again with the --zero that is used here".to_owned(),
        Remedy::DescribeMask => {
            "describe the mask with --stripes and --mask-angles, and the polarizer's zero with --zero".to_owned()
        }
        remedy => remedy.to_string(),
    }
}

/// The verdict and, where there is one, what makes the result better.
fn sentences(outcome: &Outcome) -> String {
    let better = outcome.remedy.map(|remedy| format!(" To improve it, {}.", advice(remedy)));
    format!("{}{}", outcome.verdict, better.unwrap_or_default())
}

fn as_json(outcome: &Outcome) -> serde_json::Value {
    let mut answer = json!(outcome);
    answer["remedy"] = json!(outcome.remedy.map(advice));
    answer
}

/// Writes the bundle if there is one to write, then the picture; prints the verdict.
#[allow(clippy::print_stdout, reason = "the command's answer")]
fn finish(draft: Option<Draft>, outcome: &Outcome, source: &Source, json: bool) -> Result<(), Error> {
    let bundle = draft.map(Draft::commit).transpose()?.flatten();
    let picture = source.out.clone().unwrap_or_else(|| source.bundle.join(format!("{}.png", outcome.step)));
    write_png(&picture, &figure(outcome))?;
    if json {
        let mut answer = as_json(outcome);
        answer["bundle"] = json!(source.bundle);
        answer["calibration"] = json!(bundle.map(|bundle| bundle.digest));
        answer["picture"] = json!(picture);
        println!("{answer}");
    } else {
        println!("{}", sentences(outcome));
    }
    Ok(())
}

#[allow(clippy::print_stdout, reason = "the command's answer")]
fn demonstrate(args: &Args, json: bool) -> Result<(), Error> {
    let temporary = tempfile::tempdir().map_err(|e| Error::Internal(format!("temporary folder: {e}")))?;
    let dir = args.out.as_deref().unwrap_or(temporary.path());
    let side = args.size as usize;
    let spec = demo::Spec {
        scene: args.scene.clone(),
        size: Size::new(side, side),
        color: args.rgb,
        beyond: args.beyond,
        seed: args.seed,
        threads: threads(),
    };
    let mut outcomes = Vec::new();
    let summary = demo::run(&spec, dir, |outcome| {
        if !json {
            println!("{:>6}: {}", outcome.step, sentences(outcome));
        }
        outcomes.push(outcome.clone());
    })?;
    if let Some(out) = &args.out {
        for outcome in &outcomes {
            write_png(&out.join(format!("{}.png", outcome.step)), &figure(outcome))?;
        }
    }
    if json {
        println!("{}", json!({ "steps": outcomes.iter().map(as_json).collect::<Vec<_>>(), "summary": summary }));
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
        Err(Error::Internal("the demonstration is not within what is allowed".to_owned()))
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
    /// Errors of planning and processing keep their own exit codes.
    fn from(e: CalibrateError) -> Self {
        match e {
            CalibrateError::Plan(e) => e.into(),
            CalibrateError::Process(e) => e.into(),
            e => Self::Calibrate {
                advice: e.remedy().map_or_else(String::new, |remedy| format!("; {}", advice(remedy))),
                error: Box::new(e),
            },
        }
    }
}
