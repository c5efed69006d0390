//! Many frames of one device: planned once, every frame once, a table of reports.

use std::fmt::Write as _;
use std::io::IsTerminal as _;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};

use super::sources::{Pairing, Sequence};
use super::{Args, counts_as, full_scale, planes, settings};
use crate::Error;
use crate::bundle::Bundle;
use crate::files::write_atomic;
use crate::heap;
use crate::model::{Allowance, Selection};
use crate::output::export::{Format, encode_result, result_names, result_planes};
use crate::output::zarr::{Zarr, ZarrSpec};
use crate::output::{self, OutputError, Report};
use stokescope_core::diagnose::Verdict;
use stokescope_core::image::Stack;
use stokescope_core::pipeline::Pipeline;

/// File name of the table.
const TABLE: &str = "report.csv";
const COLUMNS: &str = "raw,guide,result,verdict,method,iterations,residual_rms,gain,shift_right_px,shift_down_px,psf_scale,mean_dolp,\
                       valid_fraction,read_seconds,frame_seconds,warnings,error\n";
/// Time between two lines of progress without a terminal.
const LINE_INTERVAL: Duration = Duration::from_secs(5);

/// Name of the array in the folder of the results.
const ARRAY: &str = "results.ome.zarr";

/// Format of the results of a batch.
#[derive(Clone, Copy, Debug)]
pub enum BatchFormat {
    /// One file a frame.
    Files(Format),
    /// One array of all frames.
    OmeZarr,
}

/// Place of the results.
enum Results {
    Files { format: Format, encoded: Vec<u8> },
    Array(Zarr),
}

impl Results {
    /// Prepares the results of the frames of `raws` in the folder `out`. Frames of an earlier array of the same frames are removed.
    fn new(args: &Args, raws: &Sequence, pipeline: &Pipeline, bundle: &Bundle) -> Result<Self, Error> {
        let format = match args.format {
            Some(BatchFormat::OmeZarr) => {
                let channels = bundle.sensor.channels;
                let frames: Vec<String> = (0..raws.len()).map(|index| raws.stem(index)).collect();
                let spec = ZarrSpec {
                    planes: &result_names(channels, !pipeline.angles().is_empty()),
                    size: pipeline.size(),
                    frames: &frames,
                    interval: None,
                    origin: serde_json::json!({ "bundle": bundle.digest }),
                };
                let array = Zarr::create(&args.out.join(ARRAY), &spec)?;
                array.clear()?;
                return Ok(Self::Array(array));
            }
            Some(BatchFormat::Files(format)) => format,
            None => Format::Npy,
        };
        Ok(Self::Files { format, encoded: Vec::new() })
    }

    /// Name of the result of frame `index`, for the table.
    fn name(&self, raws: &Sequence, index: usize) -> String {
        match self {
            Self::Files { format, .. } => format!("{}.{}", raws.stem(index), format.stack_ending().unwrap_or("npy")),
            Self::Array(_) => format!("{ARRAY}[{index}]"),
        }
    }

    /// Writes the latest result of the pipeline as that of frame `index`.
    fn write(&mut self, out: &Path, name: &str, index: usize, pipeline: &Pipeline) -> Result<(), OutputError> {
        let images = output::images(pipeline);
        match self {
            Self::Files { format, encoded } => {
                encode_result(*format, &images, encoded)?;
                Ok(write_atomic(&out.join(name), |file| file.write_all(encoded))?)
            }
            Self::Array(array) => array.write(index, &result_planes(&images)?.1),
        }
    }
}

/// Reconstructs all frames of `raws`, each beside its guide where there are `guides`.
///
/// # Errors
/// A device or an option that cannot be used, or results that cannot be written, end the batch. Frames that cannot be used are named and
/// passed over; [`Error::Batch`] tells of them in the end.
#[allow(clippy::print_stdout, reason = "output of the command")]
pub(super) fn run(args: &Args, mut raws: Sequence, mut guides: Option<Sequence>, json: bool) -> Result<(), Error> {
    raws.check_names()?;
    let pairing = guides.as_ref().map(|guides| Pairing::of(&raws, guides)).transpose()?;
    let bundle = Bundle::load(&args.calibration)?;
    let mut pipeline = Pipeline::new(&bundle, settings(args, guides.is_some()))?;
    let selection = Selection::add(&mut pipeline, &args.fusion, args.precision, &Allowance::ALL)?;
    if pipeline.fusion().is_some() {
        heap::keep();
    }
    prepare_folder(&args.out, [Some(&raws), guides.as_ref()].into_iter().flatten())?;
    let mut results = Results::new(args, &raws, &pipeline, &bundle)?;
    let (total, start) = (raws.len(), Instant::now());
    let (mut table, mut failed) = (COLUMNS.to_owned(), Vec::new());
    // Other set-ups are tried as long as they explain frames better.
    let (mut progress, mut trials) = (Progress::new(total), true);
    for index in 0..total {
        let guide = pairing.as_ref().map(|pairing| pairing.guides[index]);
        let names =
            [raws.label(index), guide.flatten().zip(guides.as_ref()).map_or(String::new(), |(i, g)| g.label(i))];
        let result = results.name(&raws, index);
        let solved =
            solve(args, (&mut pipeline, trials), (&bundle, &selection), (&mut raws, index), (guides.as_mut(), guide))
                .and_then(|solved| {
                    results.write(&args.out, &result, index, &pipeline)?;
                    Ok(solved)
                });
        match solved {
            Ok((report, verdict)) => {
                trials = verdict > Verdict::NotJudged;
                table += &row(&names, &result, &report);
                if verdict == Verdict::NotCredible && !args.force {
                    progress.tell(|| tracing::error!("{}: the result is not credible", names[0]));
                    failed.push(names[0].clone());
                }
            }
            Err(e @ (Error::Write(_) | Error::Output(OutputError::Write(_) | OutputError::Folder { .. }))) => {
                return Err(e);
            }
            Err(e) => {
                progress.tell(|| tracing::error!("{}: {e}", names[0]));
                table += &failure(&names, &e);
                failed.push(names[0].clone());
            }
        }
        progress.at(index + 1);
    }
    progress.finish();
    for index in pairing.iter().flat_map(|pairing| &pairing.left) {
        let name = guides.as_ref().map_or(String::new(), |guides| guides.label(*index));
        tracing::error!("{name}: no raw frame of this name or number");
        table += &failure(&[String::new(), name.clone()], &"no raw frame of this name or number");
        failed.push(name);
    }
    let path = args.out.join(TABLE);
    write_atomic(&path, |out| out.write_all(table.as_bytes()))?;
    let seconds = start.elapsed().as_secs_f64();
    if json {
        println!("{}", serde_json::json!({ "frames": total, "failed": failed, "table": path, "seconds": seconds }));
    } else {
        println!("{}: {total} frames in {seconds:.1} s, {} failed", args.out.display(), failed.len());
    }
    if failed.is_empty() { Ok(()) } else { Err(Error::Batch { failed: failed.len(), total, table: path }) }
}

/// Solves frame `index` of the raw sequence. Other set-ups are tried on it if `trials` says so or the frame's own figures speak against it:
/// they take several times as long as a frame, and a batch has a single set-up. The inner option of the guide is none where a guide is missing.
fn solve(
    args: &Args,
    (pipeline, trials): (&mut Pipeline, bool),
    (bundle, selection): (&Bundle, &Selection),
    (raws, index): (&mut Sequence, usize),
    (guides, guide): (Option<&mut Sequence>, Option<Option<usize>>),
) -> Result<(Report, Verdict), Error> {
    let start = Instant::now();
    let guide = match (guides, guide) {
        (Some(guides), Some(Some(index))) => Some(planes(guides.read(index)?)?),
        (Some(_), Some(None)) => return Err(Error::Usage("no guide of this name or number".to_owned())),
        _ => None,
    };
    let guide = guide.map(|(frame, unit)| full_scale(frame, unit));
    let (raw, unit) = planes(raws.read(index)?)?;
    let load = start.elapsed();
    let raw = raw.view().in_unit(counts_as(args, unit));
    let frame = pipeline.process(raw, guide.as_ref().map(Stack::view))?.into_report();
    let tried = guide.as_ref().filter(|_| trials || frame.figures.verdict() > Verdict::NotJudged);
    let suspects = pipeline.diagnose(&frame, tried.map(Stack::view))?;
    let mut report = Report::new(pipeline, &frame, selection, &bundle.digest, [load, start.elapsed()]);
    let verdict = report.suspect(&frame.figures, &suspects);
    Ok((report, verdict))
}

/// Creates the folder of the results, which is none of those with frames: results have their names.
fn prepare_folder<'a>(out: &Path, sequences: impl Iterator<Item = &'a Sequence>) -> Result<(), Error> {
    let failed = |source| OutputError::Folder { path: out.to_path_buf(), source };
    std::fs::create_dir_all(out).map_err(failed)?;
    let out = out.canonicalize().map_err(failed)?;
    let whole = |folder: &Path| if folder.as_os_str().is_empty() { PathBuf::from(".") } else { folder.to_path_buf() };
    for sequence in sequences {
        if sequence.folders().any(|folder| whole(folder).canonicalize().is_ok_and(|folder| folder == out)) {
            return Err(Error::Usage(format!(
                "--out {}: holds the frames, whose names the results have; give another folder",
                out.display()
            )));
        }
    }
    Ok(())
}

/// A line of the table.
fn row(names: &[String; 2], result: &str, report: &Report) -> String {
    let gain: Vec<String> = report.gain.iter().map(ToString::to_string).collect();
    let [right, down] = report.shift_px;
    [
        quoted(&names[0]),
        quoted(&names[1]),
        quoted(result),
        report.verdict.to_string(),
        report.method.clone(),
        report.iterations.to_string(),
        report.residual_rms.to_string(),
        gain.join(" "),
        right.to_string(),
        down.to_string(),
        report.psf_scale.to_string(),
        report.mean_dolp.map_or(String::new(), |dolp| dolp.to_string()),
        report.valid_fraction.to_string(),
        report.seconds.load.to_string(),
        report.seconds.total.to_string(),
        quoted(&report.warnings.join("; ")),
        String::new(),
    ]
    .join(",")
        + "\n"
}

/// The line of a frame without a result.
fn failure(names: &[String; 2], e: &dyn std::fmt::Display) -> String {
    let mut line = names.iter().map(|name| quoted(name)).collect::<Vec<_>>().join(",");
    // writing to a string cannot fail
    let _ = writeln!(line, "{}{}", ",".repeat(15), quoted(&e.to_string()));
    line
}

/// A field of a table (RFC 4180).
fn quoted(text: &str) -> String {
    if text.contains([',', '"', '\n', '\r']) { format!("\"{}\"", text.replace('"', "\"\"")) } else { text.to_owned() }
}

/// Progress on stderr: a bar on a terminal, otherwise a line from time to time.
struct Progress {
    bar: Option<ProgressBar>,
    total: usize,
    last_line: Instant,
}

impl Progress {
    fn new(total: usize) -> Self {
        let bar = std::io::stderr().is_terminal().then(|| {
            // the template is a valid constant; the library's default is never used
            let style = ProgressStyle::with_template("{bar:30} {pos}/{len} frames, {eta} left");
            ProgressBar::new(total as u64).with_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()))
        });
        Self { bar, total, last_line: Instant::now() }
    }

    fn at(&mut self, frames: usize) {
        if let Some(bar) = &self.bar {
            bar.set_position(frames as u64);
        } else if self.last_line.elapsed() >= LINE_INTERVAL {
            self.last_line = Instant::now();
            tracing::info!("{frames} of {} frames", self.total);
        }
    }

    /// Logs without breaking the bar.
    fn tell(&self, log: impl FnOnce()) {
        match &self.bar {
            Some(bar) => bar.suspend(log),
            None => log(),
        }
    }

    fn finish(&self) {
        self.bar.iter().for_each(ProgressBar::finish_and_clear);
    }
}

/// Parser of `--format`.
pub(super) fn parse_format(name: &str) -> Result<BatchFormat, String> {
    match name {
        "npy" => Ok(BatchFormat::Files(Format::Npy)),
        "tiff" => Ok(BatchFormat::Files(Format::Tiff)),
        "ome-tiff" => Ok(BatchFormat::Files(Format::OmeTiff)),
        "ome-zarr" => Ok(BatchFormat::OmeZarr),
        _ => Err("allowed: npy, tiff, ome-tiff, ome-zarr".to_owned()),
    }
}
