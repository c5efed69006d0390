//! Solver thread: turns pairs of frames into results and hands them to the preview and the disk.

use std::num::NonZeroUsize;
use std::sync::Arc;
use std::time::{Duration, Instant};

use parking_lot::Mutex;
use serde_json::json;

use super::controls::Controls;
use super::events::Events;
use super::frame::{PublishedFrame, Readings, Sketch};
use super::limits::MAX_RESULTS;
use super::machine::MachineStatus;
use super::pairing::{Pair, Pairing};
use super::preview::Broadcast;
use super::quality::{Governor, QualityStatus};
use super::recorder::{Job, Recorder};
use super::saver::Saver;
use super::statistics::{Stage, Statistics, Timings};
use crate::Error;
use crate::board::Board;
use crate::bundle::Bundle;
use crate::heap;
use crate::model::{Choice, Selection};
use crate::output::Report;
use stokescope_core::device::Sensor;
use stokescope_core::diagnose::{Fault, Suspect};
use stokescope_core::image::{ImageView, Stack};
use stokescope_core::pipeline::{Budget, FrameReport, Pipeline, PrepareError, ProcessError, Settings};
use stokescope_core::polarization::Angle;
use stokescope_core::readings::ReadingsError;
use stokescope_core::readings::Unit;

/// Pause while all results are in use.
const PACE: Duration = Duration::from_millis(1);

/// Length of the run and treatment of its results.
#[derive(Clone, Debug)]
pub(super) struct Task {
    /// Frames to try; none until the service stops.
    pub(super) frames: Option<u64>,
    /// Whether each result is kept in a folder of its own.
    pub(super) keep: bool,
    /// Whether every frame counts, however long it takes.
    pub(super) every: bool,
}

/// Parts of the service that the solver reads from and reports to.
#[derive(Debug)]
pub(super) struct Links {
    pub(super) pairing: Arc<Pairing>,
    pub(super) controls: Arc<Controls>,
    pub(super) machine: Arc<MachineStatus>,
    pub(super) quality: Arc<QualityStatus>,
    pub(super) statistics: Arc<Mutex<Statistics>>,
    pub(super) timings: Arc<Timings>,
    pub(super) events: Arc<Events>,
    pub(super) broadcast: Arc<Broadcast>,
    pub(super) saver: Arc<Saver>,
    pub(super) recorder: Option<Arc<Recorder>>,
}

/// Pipeline, with everything it is planned from.
#[derive(Debug)]
pub(super) struct Solver {
    bundle: Bundle,
    settings: Settings,
    unit: Unit,
    pipeline: Pipeline,
    selection: Selection,
    /// Whether frames without a guide are refined: only by a model that was asked for by name.
    refines_unguided: bool,
    /// Faults that trials of other set-ups found; none before they were made.
    tried: Option<Vec<Suspect>>,
    /// Results, used again once nobody holds them.
    results: heapless::Vec<Arc<PublishedFrame>, MAX_RESULTS>,
    /// Most results there may be.
    most: usize,
    angles: Vec<Angle>,
}

/// Bytes of one result.
pub(super) fn result_bytes(bundle: &Bundle, preview: bool, fusion: bool) -> usize {
    let angles = bundle.response.angles().len();
    // Stokes images and their errors
    let planes = 2 * if angles > 0 { 3 } else { 1 } + if fusion { angles } else { 0 };
    let sketches = if preview { 2 * size_of::<u16>() } else { 0 };
    let n = bundle.sensor.size.pixels();
    (planes * size_of::<f32>() + sketches) * bundle.sensor.channels * n + n
}

impl Solver {
    /// Plans the pipeline and its fusion model. At most `most` results exist at once.
    ///
    /// # Errors
    /// Those of [`Pipeline::new`] and [`Selection::add`].
    pub(super) fn new(
        bundle: Bundle,
        unit: Unit,
        settings: Settings,
        (board, allowed): (&Board, usize),
        most: usize,
    ) -> Result<Self, Error> {
        let mut pipeline = Pipeline::new(&bundle, settings)?;
        let selection = board.select_model(&mut pipeline, allowed)?;
        let settings = pipeline.settings().clone();
        if pipeline.fusion().is_some() {
            heap::keep();
        }
        let angles = pipeline.angles().to_vec();
        let (refines_unguided, results) = (board.fusion.model != Choice::Auto, heapless::Vec::new());
        Ok(Self { bundle, settings, unit, pipeline, selection, refines_unguided, tried: None, results, most, angles })
    }

    /// The fusion model, and why it is this one.
    pub(super) fn selection(&self) -> &Selection {
        &self.selection
    }

    /// The device bundle.
    pub(super) fn bundle(&self) -> &Bundle {
        &self.bundle
    }

    /// Processes frames until the service stops or enough were tried.
    ///
    /// # Errors
    /// A failure that every further frame would share, or the last frame's failure when there was no result at all.
    pub(super) fn run(mut self, links: &Links, mut governor: Governor, task: &Task) -> Result<(), Error> {
        let mut tried = 0;
        heap::settle();
        while task.frames.is_none_or(|n| tried < n) {
            let Some(pair) = links.pairing.next()? else { break };
            links.timings.add(Stage::Wait, pair.raw.arrived.elapsed());
            tried += 1;
            match self.solve(links, &mut governor, &pair, task.keep) {
                Ok(frame) => match &links.recorder {
                    Some(recorder) => recorder.offer(Job { pair, frame }, task.every),
                    None => links.pairing.recycle(pair),
                },
                // the next frame may have a result
                Err(Error::Process(
                    e @ (ProcessError::Prepare(PrepareError::Readings(ReadingsError::Unusable { .. }))
                    | ProcessError::Recon(_)),
                )) => {
                    links.pairing.recycle(pair);
                    if links.failed(&e) == 0 && task.frames == Some(tried) {
                        return Err(e.into());
                    }
                }
                Err(e) => return Err(e),
            }
        }
        Ok(())
    }

    /// Processes one pair and publishes the result.
    fn solve(
        &mut self,
        links: &Links,
        governor: &mut Governor,
        pair: &Pair,
        keep: bool,
    ) -> Result<Arc<PublishedFrame>, Error> {
        let begin = Instant::now();
        let iterations = governor.quality().iterations;
        self.replan(pair.guide.is_some())?;
        let able = pair.guide.is_some() || self.refines_unguided;
        let refine = able && links.controls.fused() && governor.quality().fusion;
        let budget = Budget { iterations: NonZeroUsize::new(iterations), refine };
        let view = pair.raw.planes.view().in_unit(self.unit).found_off_scale(pair.raw.off_scale);
        let raw = view.weighted(pair.raw.weights.as_slice()).unwrap_or(view);
        let guide = pair.guide.as_ref().map(|g| g.planes.view());
        let report = self.pipeline.process_within(raw, guide, budget)?.into_report();
        links.time(&report);
        if report.fusion.is_some() {
            governor.fused(report.fusion_time);
        } else if !able || !links.controls.fused() {
            // a model that the user turned off or that waits for a guide takes no time that could be saved
            governor.fused(Duration::ZERO);
        }
        let (recon, run) = (report.recon, report.iterations);
        let copying = Instant::now();
        let frame = self.publish(links, pair, &report);
        links.timings.add(Stage::Publish, copying.elapsed());
        let (asked, machine) = (links.controls.iterations(), links.machine.get());
        governor.learn(asked, run, begin.elapsed(), recon, machine.pressed());
        links.quality.set(governor.quality(), &links.events);
        links.broadcast.set_scale(governor.quality().preview_scale);
        links.saver.offer(&frame, keep);
        links.published(&frame);
        self.try_others(&report, guide)?;
        Ok(frame)
    }

    /// Plans the pipeline again when the guide camera went offline or came back.
    fn replan(&mut self, guided: bool) -> Result<(), Error> {
        if guided != self.settings.guided {
            let settings = Settings { guided, ..self.settings.clone() };
            self.pipeline = Pipeline::new(&self.bundle, settings.clone())?;
            self.settings = settings;
        }
        Ok(())
    }

    /// Tries other set-ups on the first frame with a guide that the solver settles on and that is neither dim nor clipped, in about the
    /// time that preparing the first frame takes. Polarization can explain what a wrong set-up leaves, so a small residual proves nothing.
    fn try_others(&mut self, report: &FrameReport, guide: Option<ImageView<'_>>) -> Result<(), Error> {
        let figures = &report.figures;
        let plain = figures.settled && figures.suspects().all(|s| s.fault == Fault::ForeignGuide);
        if plain && guide.is_some() && self.tried.is_none() {
            let mut found = self.pipeline.diagnose(report, guide).map_err(ProcessError::from)?;
            found.retain(|s| s.fault != Fault::ForeignGuide);
            self.tried = Some(found);
        }
        Ok(())
    }

    /// Copies the pipeline's result into one that others can hold. Waits while all results are in use.
    fn publish(&mut self, links: &Links, pair: &Pair, report: &FrameReport) -> Arc<PublishedFrame> {
        report.notices.iter().for_each(|notice| tracing::info!("{notice}"));
        let (digest, age) = (&self.bundle.digest, pair.raw.arrived.elapsed());
        let mut described = Report::new(&self.pipeline, report, &self.selection, digest, [Duration::ZERO, age]);
        if pair.guide.is_none() && links.pairing.has_guide() {
            described.warnings.push("unguided: the guide camera is offline".to_owned());
        }
        let tried = self.tried.as_deref().unwrap_or_default();
        described.suspect(&report.figures, &report.figures.suspects_with(tried));
        let head = Head {
            index: links.statistics.lock().frames,
            arrived: pair.raw.arrived,
            guided: pair.guide.is_some(),
            sketched: links.broadcast.wants_sketches(),
            saturated: report.figures.saturated,
            report: described,
        };
        let readings = (&pair.raw.planes, &self.bundle.sensor, self.unit);
        loop {
            if let Some(slot) = self.results.iter_mut().find(|slot| Arc::strong_count(slot) == 1)
                && let Some(frame) = Arc::get_mut(slot)
            {
                head.copy_into(&self.pipeline, readings, frame);
                return Arc::clone(slot);
            }
            if self.results.len() < self.most {
                let frame = Arc::new(head.copy(&self.pipeline, readings, &self.angles));
                let kept = self.results.push(Arc::clone(&frame));
                debug_assert!(kept.is_ok(), "there is room");
                return frame;
            }
            // a result that waits for the disk can be given up: this one will replace it
            links.saver.withdraw();
            std::thread::sleep(PACE);
        }
    }
}

/// Everything of a published frame but its images.
struct Head {
    index: u64,
    arrived: Instant,
    guided: bool,
    sketched: bool,
    saturated: f32,
    report: Report,
}

/// Frame of the raw camera, its sensor, and the unit of its values.
type RawFrame<'a> = (&'a Stack<f32>, &'a Sensor, Unit);

impl Head {
    /// Copies the pipeline's images into `frame`, which had another result of the same pipeline.
    fn copy_into(self, pipeline: &Pipeline, raw: RawFrame<'_>, frame: &mut PublishedFrame) {
        let copy = |to: &mut Stack<f32>, from: &Stack<f32>| to.as_mut_slice().copy_from_slice(from.as_slice());
        let solved = pipeline.result();
        if self.sketched {
            frame.raw.take(raw.0, raw.1, raw.2);
            frame.guide.take(pipeline.guide());
        }
        copy(&mut frame.stokes, &solved.stokes);
        copy(&mut frame.errors, &solved.errors);
        if let (Some(to), Some(from)) = (&mut frame.stage1, pipeline.stage1()) {
            copy(to, from);
        }
        frame.valid.copy_from_slice(&solved.valid);
        (frame.index, frame.arrived) = (self.index, self.arrived);
        (frame.guided, frame.sketched, frame.report) = (self.guided, self.sketched, self.report);
        frame.saturated = self.saturated;
    }

    /// Copies the pipeline's images into a new frame.
    fn copy(self, pipeline: &Pipeline, raw: RawFrame<'_>, angles: &[Angle]) -> PublishedFrame {
        let Self { index, arrived, guided, sketched, saturated, report } = self;
        let mut readings = Readings::default();
        if sketched {
            readings.take(raw.0, raw.1, raw.2);
        }
        let sketch = |image| if sketched { Sketch::of(image) } else { Sketch::default() };
        let solved = pipeline.result();
        PublishedFrame {
            index,
            arrived,
            channels: pipeline.raw().count(),
            sketched,
            raw: readings,
            saturated,
            guide: sketch(pipeline.guide()),
            guided,
            stokes: solved.stokes.clone(),
            errors: solved.errors.clone(),
            stage1: pipeline.stage1().cloned(),
            angle_list: angles.to_vec(),
            valid: solved.valid.clone(),
            report,
        }
    }
}

impl Links {
    /// Notes the times of a frame's stages.
    fn time(&self, report: &FrameReport) {
        let stages =
            [(Stage::Prepare, report.prepare), (Stage::Register, report.register), (Stage::Recon, report.recon)];
        stages.into_iter().for_each(|(stage, time)| self.timings.add(stage, time));
        if report.fusion.is_some() {
            self.timings.add(Stage::Fusion, report.fusion_time);
        }
    }

    /// Counts a result and shows it.
    fn published(&self, frame: &Arc<PublishedFrame>) {
        let mut statistics = self.statistics.lock();
        statistics.add(frame.arrived, Instant::now());
        let first = statistics.frames == 1;
        drop(statistics);
        self.broadcast.show(Arc::clone(frame));
        if first {
            self.events.emit("first-frame", json!({}));
        }
    }

    /// Counts a frame without a result and reports every new reason once. Gives the number of results so far.
    fn failed(&self, error: &ProcessError) -> u64 {
        let (mut statistics, reason) = (self.statistics.lock(), error.to_string());
        statistics.failed += 1;
        if statistics.fault.as_ref() != Some(&reason) {
            tracing::warn!("frame without a result: {reason}");
            statistics.fault = Some(reason);
        }
        statistics.frames
    }
}
