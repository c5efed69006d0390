//! The thread that turns pairs of frames into results.

use std::sync::Arc;
use std::time::{Duration, Instant};

use super::hub::{Hub, Shown};
use super::pair::Pair;
use super::save::Saver;
use crate::Error;
use crate::calibration::Calibration;
use crate::pipeline::{FrameReport, Pipeline, ProcessError, Settings};
use crate::plane::{Angle, Stack};
use crate::prepare::{PrepareError, Unit};
use crate::recon::Method;

/// Results that can be held at once: shown, being encoded, waiting for the disk, being written, and the one being made.
pub(super) const RESULTS: usize = 5;
/// A guide that proved useless is tried again after this long.
const RETRY_GUIDE: Duration = Duration::from_secs(5);

/// The pipeline of the service and what it is planned from.
#[derive(Debug)]
pub(super) struct Solver {
    calibration: Calibration,
    settings: Settings,
    unit: Unit,
    pipeline: Pipeline,
    /// Whether the pipeline is planned for frames with a guide, and when it was.
    guided: bool,
    planned: Instant,
    /// Results, to be used again once nobody looks at them.
    results: heapless::Vec<Arc<Shown>, RESULTS>,
    angles: Vec<Angle>,
}

/// Bytes of one result.
pub(super) fn result_bytes(calibration: &Calibration) -> usize {
    let angles = calibration.response.angles().len();
    let planes = 2 + if angles > 0 { 3 + angles } else { 1 };
    let n = calibration.sensor.size.pixels();
    planes * calibration.sensor.channels * n * size_of::<f32>() + n
}

impl Solver {
    /// Plans the pipeline.
    ///
    /// # Errors
    /// Those of [`Pipeline::plan`].
    pub(super) fn new(
        calibration: Calibration,
        guided: bool,
        unit: Unit,
        settings: Settings,
    ) -> Result<Self, crate::pipeline::PlanError> {
        let pipeline = Pipeline::plan(&calibration, guided, &settings)?;
        let angles = pipeline.angles().to_vec();
        let results = heapless::Vec::new();
        Ok(Self { calibration, settings, unit, pipeline, guided, planned: Instant::now(), results, angles })
    }

    /// Processes frames until the service stops or `frames` were tried. The first `keep` are kept on disk, each.
    ///
    /// # Errors
    /// What makes every further frame fail too, or the last frame's failure when there was no result at all.
    pub(super) fn run(mut self, hub: &Hub, saver: &Saver, frames: Option<u64>, keep: bool) -> Result<(), Error> {
        let mut tried = 0;
        while frames.is_none_or(|n| tried < n) {
            let Some(pair) = hub.pairing.next() else { break };
            self.replan(pair.guide.is_some())?;
            let guide = pair.guide.as_ref().map(|g| &g.planes);
            match self.pipeline.process(&pair.raw.planes, self.unit, guide) {
                Ok(report) => {
                    let shown = self.result(hub, &pair, report);
                    saver.offer(hub, &shown, keep);
                    hub.publish(shown, pair.raw.arrived);
                }
                // the next frame may do better
                Err(e @ (ProcessError::Prepare(PrepareError::Unusable { .. }) | ProcessError::Recon(_))) => {
                    hub.failed(e.to_string());
                    if frames == Some(tried + 1) && hub.figures().frames == 0 {
                        return Err(e.into());
                    }
                }
                Err(e) => return Err(e.into()),
            }
            hub.pairing.recycle(pair);
            tried += 1;
        }
        Ok(())
    }

    /// Plans anew when a guide camera went or came back, or when the pipeline gave a useless guide up some time ago.
    fn replan(&mut self, guided: bool) -> Result<(), Error> {
        let gave_up = guided && self.pipeline.method() != Method::Guided && self.planned.elapsed() > RETRY_GUIDE;
        if guided != self.guided || gave_up {
            self.pipeline = Pipeline::plan(&self.calibration, guided, &self.settings)?;
            (self.guided, self.planned) = (guided, Instant::now());
        }
        Ok(())
    }

    /// Copies the pipeline's result into one that others may hold.
    fn result(&mut self, hub: &Hub, pair: &Pair, mut frame: FrameReport) -> Arc<Shown> {
        if pair.guide.is_none() && hub.pairing.lenses().1.is_some() {
            frame.warnings.push("unguided: the guide camera is offline".to_owned());
        }
        let report = self.pipeline.report(&frame, Duration::ZERO, pair.raw.arrived.elapsed());
        let index = hub.figures().frames;
        let (raw, guide, solved) = (self.pipeline.raw(), self.pipeline.guide(), self.pipeline.result());
        let guided = pair.guide.is_some();
        loop {
            if let Some(slot) = self.results.iter_mut().find(|slot| Arc::strong_count(slot) == 1)
                && let Some(shown) = Arc::get_mut(slot)
            {
                let copy = |to: &mut Stack<f32>, from: &Stack<f32>| to.as_mut_slice().copy_from_slice(from.as_slice());
                copy(&mut shown.raw, raw);
                copy(&mut shown.guide, guide);
                copy(&mut shown.stokes, &solved.stokes);
                if let (Some(to), Some(from)) = (&mut shown.angles, &solved.angles) {
                    copy(to, from);
                }
                shown.valid.copy_from_slice(&solved.valid);
                (shown.index, shown.guided, shown.report) = (index, guided, report);
                return Arc::clone(slot);
            }
            if !self.results.is_full() {
                let shown = Arc::new(Shown {
                    index,
                    channels: raw.count(),
                    raw: raw.clone(),
                    guide: guide.clone(),
                    guided,
                    stokes: solved.stokes.clone(),
                    angles: solved.angles.clone(),
                    angle_list: self.angles.clone(),
                    valid: solved.valid.clone(),
                    report,
                });
                let kept = self.results.push(Arc::clone(&shown));
                debug_assert!(kept.is_ok(), "there is room");
                return shown;
            }
            // someone looks at one for a moment longer
            std::thread::sleep(Duration::from_millis(1));
        }
    }
}
