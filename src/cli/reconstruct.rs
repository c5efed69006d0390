//! `stokescope reconstruct`: reconstructs one capture from files, or many of one device.

mod batch;
mod sources;

use std::path::{Path, PathBuf};
use std::time::Instant;

use super::values;
use crate::Error;
use crate::bundle::Bundle;
use crate::files::{self, Samples};
use crate::heap;
use crate::model::{self, Allowance, Precision, Selection};
use crate::output::{self, Report};
use sources::Sequence;
use stokescope_core::diagnose::Verdict;
use stokescope_core::image::Stack;
use stokescope_core::optics::FftBackend;
use stokescope_core::pipeline::{Pipeline, Settings};
use stokescope_core::readings::Unit;
use stokescope_core::solve::{Method, MethodNameError};

/// Reconstruct polarization images from a raw frame and an optional guide.
#[derive(Clone, Debug, clap::Args)]
pub struct Args {
    /// Device bundle: a folder with calibration.toml.
    #[arg(long, value_name = "DIR")]
    pub calibration: PathBuf,
    /// Raw frame of the lensless camera: NPY, TIFF or PNG. A folder, a quoted pattern such as 'raws/*.tif', or a file of many frames is
    /// a batch: frames of one device, in the order of their names. Each has the result that it has alone.
    #[arg(long, value_name = "FILE|DIR|GLOB|STACK")]
    pub raw: PathBuf,
    /// Frame of the guide camera: NPY, TIFF or PNG. For a batch as many, of the same names or numbers.
    #[arg(long, value_name = "FILE|DIR|GLOB|STACK")]
    pub guide: Option<PathBuf>,
    /// Unit of floating-point raw frames; auto is full scale, less the black level.
    #[arg(long, value_enum, value_name = "auto|counts", default_value_t)]
    pub unit: UnitChoice,
    /// Method of the solver; auto is guided with a guide, else stokes.
    #[arg(long, value_name = "METHOD", default_value = "auto", value_parser = parse_method)]
    pub method: MethodChoice,
    /// Solver iterations [default: depends on the method].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    pub iterations: Option<u32>,
    /// Align the guide with the raw frame.
    #[arg(long, value_enum, value_name = "on|off", default_value_t)]
    pub register: Switch,
    /// Refit the scale of the PSF if it has changed since calibration.
    #[arg(long, value_enum, value_name = "on|off", default_value_t)]
    pub refit_psf: Switch,
    /// Solver threads [default: all cores].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=64))]
    pub threads: Option<u32>,
    /// FFT implementation.
    #[arg(long, value_name = "LIBRARY", value_parser = values::fft(), default_value_t)]
    pub fft: FftBackend,
    /// Fusion model: a name (see `stokescope models`), its folder or its manifest; auto is the best shipped one.
    #[arg(long, value_name = "auto|off|NAME|FILE", default_value = "auto", value_parser = super::parse_fusion)]
    pub fusion: model::Choice,
    /// Number format of the fusion model.
    #[arg(long, value_parser = values::precision(), default_value_t)]
    pub precision: Precision,
    /// Folder for the results; created if needed. A batch writes one file for each frame, named after it, or one array of all frames,
    /// and report.csv.
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Take a result that is not credible for a success: exit code 0 in place of 65.
    #[arg(long)]
    pub force: bool,
    /// Format of the results of a batch: npy holds the Stokes images, tiff (for ImageJ) and ome-tiff also DoLP, AoLP and validity;
    /// ome-zarr holds these of all frames in one array, results.ome.zarr [default: npy].
    #[arg(long, value_name = "npy|tiff|ome-tiff|ome-zarr", value_parser = batch::parse_format)]
    pub format: Option<batch::BatchFormat>,
}

/// Value of `--unit`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum UnitChoice {
    /// Integers are counts, floating-point values fractions of full scale.
    #[default]
    Auto,
    /// Counts, whatever the number format.
    Counts,
}

/// Value of an on/off option.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Switch {
    /// Enabled.
    #[default]
    On,
    /// Disabled.
    Off,
}

/// Value of `--method`.
#[derive(Clone, Copy, Debug)]
pub enum MethodChoice {
    /// `guided` with a guide, else `stokes`.
    Auto,
    /// The given method.
    Method(Method),
}

fn parse_method(text: &str) -> Result<MethodChoice, String> {
    match text {
        "auto" => Ok(MethodChoice::Auto),
        name => name.parse().map(MethodChoice::Method).map_err(|e: MethodNameError| format!("{e}, auto")),
    }
}

/// Reconstructs, writes the results, and prints one line, or with `json` the report.
///
/// # Errors
/// Any error of a file, the bundle, the plan or a stage.
#[allow(clippy::print_stdout, reason = "output of the command")]
pub fn run(args: &Args, json: bool) -> Result<(), Error> {
    let guides = args.guide.as_deref().map(Sequence::find).transpose()?;
    match (Sequence::find(&args.raw)?, guides) {
        (Some(raws), None) => return batch::run(args, raws, None, json),
        (Some(raws), Some(Some(guides))) => return batch::run(args, raws, Some(guides), json),
        (None, None | Some(None)) if args.format.is_none() => {}
        (None, None | Some(None)) => {
            return Err(Error::Usage(
                "--format: allowed for a batch, whose --raw is a folder, a pattern or a stack".to_owned(),
            ));
        }
        (raws, _) => {
            let (one, many) = if raws.is_none() { ("--raw", "--guide") } else { ("--guide", "--raw") };
            return Err(Error::Usage(format!(
                "{one} is one frame and {many} are many; allowed: one of each, or many of each"
            )));
        }
    }
    let start = Instant::now();
    let bundle = Bundle::load(&args.calibration)?;
    let (raw, unit) = read(&args.raw)?;
    let unit = counts_as(args, unit);
    let guide = args.guide.as_deref().map(read).transpose()?.map(|(frame, unit)| full_scale(frame, unit));
    let load = start.elapsed();
    let settings = settings(args, guide.is_some());
    let mut pipeline = Pipeline::new(&bundle, settings)?;
    let selection = Selection::add(&mut pipeline, &args.fusion, args.precision, &Allowance::ALL)?;
    if pipeline.fusion().is_some() {
        heap::keep();
    }
    let frame = pipeline.process(raw.view().in_unit(unit), guide.as_ref().map(Stack::view))?.into_report();
    let suspects = pipeline.diagnose(&frame, guide.as_ref().map(Stack::view))?;
    let mut report = Report::new(&pipeline, &frame, &selection, &bundle.digest, [load, start.elapsed()]);
    let verdict = report.suspect(&frame.figures, &suspects);
    output::write_all(&args.out, &output::images(&pipeline), &report)?;
    frame.notices.iter().for_each(|notice| tracing::info!("{notice}"));
    report.warnings.iter().for_each(|w| tracing::warn!("{w}"));
    if json {
        println!("{}", serde_json::to_string(&report).map_err(|e| Error::Internal(e.to_string()))?);
    } else {
        println!(
            "{}: {verdict}, {} × {}, {} iterations, residual {:.5} ({:.1} × the noise), mean DoLP {}",
            args.out.display(),
            report.size[0],
            report.size[1],
            report.iterations,
            report.residual_rms,
            report.figures.residual_over_noise,
            report.mean_dolp.map_or("not measured (no mask)".to_owned(), |d| format!("{d:.3}")),
        );
    }
    if verdict == Verdict::NotCredible && !args.force {
        return Err(Error::NotCredible {
            residual_over_noise: frame.figures.residual_over_noise,
            out: args.out.clone(),
        });
    }
    Ok(())
}

/// Settings of the pipeline that the options ask for.
fn settings(args: &Args, guided: bool) -> Settings {
    let defaults = Settings::default();
    Settings {
        guided,
        method: match args.method {
            MethodChoice::Auto => None,
            MethodChoice::Method(m) => Some(m),
        },
        iterations: args.iterations.map(|n| n as usize),
        register: args.register == Switch::On,
        refit_psf: args.refit_psf == Switch::On,
        fft: args.fft,
        threads: args.threads.map_or(defaults.threads, |n| n as usize),
        ..defaults
    }
}

/// The unit of raw values of a file, which the option may set.
fn counts_as(args: &Args, unit: Unit) -> Unit {
    if args.unit == UnitChoice::Counts { Unit::Counts } else { unit }
}

/// Reads an image file as `f32` planes; integers are counts, floating-point values are fractions of full scale.
pub(super) fn read(path: &Path) -> Result<(Stack<f32>, Unit), Error> {
    planes(files::read_image(path)?)
}

/// An image as `f32` planes, with the unit of its number format.
fn planes(samples: Samples) -> Result<(Stack<f32>, Unit), Error> {
    let (count, size) = (samples.count(), samples.size());
    let (values, unit): (Vec<f32>, _) = match samples {
        Samples::U8(s) => (s.as_slice().iter().map(|v| f32::from(*v)).collect(), Unit::Counts),
        Samples::U16(s) => (s.as_slice().iter().map(|v| f32::from(*v)).collect(), Unit::Counts),
        Samples::F32(s) => return Ok((s, Unit::FullScale)),
    };
    Stack::from_vec(count, size, values).map(|s| (s, unit)).map_err(|e| Error::Internal(e.to_string()))
}

/// Scales a guide in counts to about 1. Its gain is fitted in any case; this keeps the gain in the report comparable.
fn full_scale(mut frame: Stack<f32>, unit: Unit) -> Stack<f32> {
    if unit == Unit::Counts {
        let max = frame.as_slice().iter().copied().fold(1.0, f32::max);
        let scale = if max > 255.0 { 65535.0 } else { 255.0 };
        frame.as_mut_slice().iter_mut().for_each(|v| *v /= scale);
    }
    frame
}
