//! The thread that turns pairs of frames into results.

use std::sync::Arc;
use std::time::{Duration, Instant};

use super::govern::Governor;
use super::hub::{Hub, Shown, Sketch, Stage};
use super::pair::Pair;
use super::record::{self, Job, Recorder};
use super::save::Saver;
use crate::Error;
use crate::calibration::Calibration;
use crate::heap;
use crate::output::Report;
use crate::pipeline::{FrameReport, Pipeline, ProcessError, Settings};
use crate::plane::{Angle, Stack};
use crate::prepare::{PrepareError, Unit};

/// Results that can be held at once: being written, the next, and with a preview the one that is shown or being encoded. While all
/// are looked at, the solver waits for the encoder, which is a matter of milliseconds; the disk has one of its own.
const RESULTS: usize = 3;
/// Further ones while frames are recorded: those that wait for it and the one that is being written.
pub(super) const RECORDED: usize = record::WAITING + 1;

/// How many results there are.
pub(super) fn results(preview: bool, records: bool) -> usize {
    RESULTS - usize::from(!preview) + if records { RECORDED } else { 0 }
}

/// How long to run, and what to do with the results.
#[derive(Clone, Debug)]
pub(super) struct Task {
    /// Frames to try; none until the service stops.
    pub(super) frames: Option<u64>,
    /// Whether each result is kept in a folder of its own.
    pub(super) keep: bool,
    /// Whether every frame counts, however long it takes.
    pub(super) every: bool,
    /// Frames per second that are held by lowering the quality.
    pub(super) target_fps: Option<f64>,
}

/// The pipeline of the service and what it is planned from.
#[derive(Debug)]
pub(super) struct Solver {
    calibration: Calibration,
    settings: Settings,
    unit: Unit,
    pipeline: Pipeline,
    /// Whether the pipeline is planned for frames with a guide.
    guided: bool,
    /// Results, to be used again once nobody looks at them.
    results: heapless::Vec<Arc<Shown>, { RESULTS + RECORDED }>,
    /// How many there may be.
    most: usize,
    angles: Vec<Angle>,
}

/// Bytes of one result.
pub(super) fn result_bytes(calibration: &Calibration, preview: bool, fusion: bool) -> usize {
    let angles = calibration.response.angles().len();
    let planes = if angles > 0 { 3 + usize::from(fusion) * angles } else { 1 };
    let sketches = if preview { 2 * size_of::<u16>() } else { 0 };
    let n = calibration.sensor.size.pixels();
    (planes * size_of::<f32>() + sketches) * calibration.sensor.channels * n + n
}

impl Solver {
    /// Plans the pipeline; there will be `most` results.
    ///
    /// # Errors
    /// Those of [`Pipeline::plan`].
    pub(super) fn new(
        calibration: Calibration,
        guided: bool,
        unit: Unit,
        settings: Settings,
        most: usize,
    ) -> Result<Self, crate::pipeline::PlanError> {
        let pipeline = Pipeline::new(&calibration, Settings { guided, ..settings.clone() })?;
        if pipeline.fusion().is_some() {
            heap::keep();
        }
        let angles = pipeline.angles().to_vec();
        let results = heapless::Vec::new();
        Ok(Self { calibration, settings, unit, pipeline, guided, results, most, angles })
    }

    /// Processes frames until the service stops or enough were tried.
    ///
    /// # Errors
    /// What makes every further frame fail too, or the last frame's failure when there was no result at all.
    pub(super) fn run(
        mut self,
        hub: &Hub,
        saver: &Saver,
        recorder: Option<&Recorder>,
        task: &Task,
    ) -> Result<(), Error> {
        let mut tried = 0;
        let mut governor = Governor::new(task.target_fps, hub.controls.iterations());
        heap::settle();
        while task.frames.is_none_or(|n| tried < n) {
            let Some(pair) = hub.pairing.next() else { break };
            hub.timings.add(Stage::Wait, pair.raw.arrived.elapsed());
            let begin = Instant::now();
            self.replan(pair.guide.is_some())?;
            self.settings.iterations = Some(governor.quality().iterations);
            self.pipeline.set_iterations(governor.quality().iterations);
            self.pipeline.set_fused(hub.controls.fused() && governor.quality().fusion);
            let guide = pair.guide.as_ref().map(|g| &g.planes);
            let mut recorded = None;
            match self.pipeline.process(pair.raw.planes.view().in_unit(self.unit), guide.map(Stack::view)) {
                Ok(frame) => {
                    let report = frame.into_report();
                    let (recon, iterations) = (report.recon, report.iterations);
                    if report.fusion.is_some() {
                        hub.timings.add(Stage::Fusion, report.fusion_time);
                        governor.fused(report.fusion_time);
                    } else if !hub.controls.fused() {
                        // Nothing that is not wanted can be given up.
                        governor.fused(Duration::ZERO);
                    }
                    for (stage, time) in
                        [(Stage::Prepare, report.prepare), (Stage::Register, report.register), (Stage::Recon, recon)]
                    {
                        hub.timings.add(stage, time);
                    }
                    let copying = Instant::now();
                    let shown = self.result(hub, saver, &pair, &report);
                    hub.timings.add(Stage::Publish, copying.elapsed());
                    governor.learn(hub.controls.iterations(), iterations, begin.elapsed(), recon, hub.host().pressed());
                    hub.set_quality(governor.quality());
                    saver.offer(hub, &shown, task.keep);
                    recorded = recorder.map(|recorder| (recorder, Arc::clone(&shown)));
                    hub.publish(shown, pair.raw.arrived);
                }
                // the next frame may do better
                Err(e @ (ProcessError::Prepare(PrepareError::Unusable { .. }) | ProcessError::Recon(_))) => {
                    hub.failed(e.to_string());
                    if task.frames == Some(tried + 1) && hub.figures().frames == 0 {
                        return Err(e.into());
                    }
                }
                Err(e) => return Err(e.into()),
            }
            match recorded {
                Some((recorder, shown)) => recorder.offer(hub, Job { pair, shown }, task.every),
                None => hub.pairing.recycle(pair),
            }
            tried += 1;
        }
        Ok(())
    }

    /// Plans anew when a guide camera went or came back.
    fn replan(&mut self, guided: bool) -> Result<(), Error> {
        if guided != self.guided {
            self.pipeline = Pipeline::new(&self.calibration, Settings { guided, ..self.settings.clone() })?;
            self.guided = guided;
        }
        Ok(())
    }

    /// Copies the pipeline's result into one that others may hold.
    fn result(&mut self, hub: &Hub, saver: &Saver, pair: &Pair, frame: &FrameReport) -> Arc<Shown> {
        frame.notices.iter().for_each(|notice| tracing::info!("{notice}"));
        let digest = &self.calibration.digest;
        let mut report = Report::new(&self.pipeline, frame, digest, Duration::ZERO, pair.raw.arrived.elapsed());
        if pair.guide.is_none() && hub.pairing.lenses().1.is_some() {
            report.warnings.push("unguided: the guide camera is offline".to_owned());
        }
        let index = hub.figures().frames;
        let (raw, guide, solved) = (self.pipeline.raw(), self.pipeline.guide(), self.pipeline.result());
        let guided = pair.guide.is_some();
        let sketched = hub.broadcast.wants_sketches();
        loop {
            if let Some(slot) = self.results.iter_mut().find(|slot| Arc::strong_count(slot) == 1)
                && let Some(shown) = Arc::get_mut(slot)
            {
                let copy = |to: &mut Stack<f32>, from: &Stack<f32>| to.as_mut_slice().copy_from_slice(from.as_slice());
                if sketched {
                    shown.raw.take(raw);
                    shown.guide.take(guide);
                }
                copy(&mut shown.stokes, &solved.stokes);
                if let (Some(to), Some(from)) = (&mut shown.stage1, self.pipeline.stage1()) {
                    copy(to, from);
                }
                shown.valid.copy_from_slice(&solved.valid);
                (shown.index, shown.guided, shown.sketched, shown.report) = (index, guided, sketched, report);
                shown.arrived = pair.raw.arrived;
                return Arc::clone(slot);
            }
            if self.results.len() < self.most {
                let sketch = |image| if sketched { Sketch::of(image) } else { Sketch::default() };
                let shown = Arc::new(Shown {
                    index,
                    arrived: pair.raw.arrived,
                    channels: raw.count(),
                    sketched,
                    raw: sketch(raw),
                    guide: sketch(guide),
                    guided,
                    stokes: solved.stokes.clone(),
                    stage1: self.pipeline.stage1().cloned(),
                    angle_list: self.angles.clone(),
                    valid: solved.valid.clone(),
                    report,
                });
                let kept = self.results.push(Arc::clone(&shown));
                debug_assert!(kept.is_ok(), "there is room");
                return shown;
            }
            // the one that waits for the disk will be replaced by this one, or someone looks at one for a moment longer
            saver.withdraw();
            std::thread::sleep(Duration::from_millis(1));
        }
    }
}
