//! The steps of calibration on live frames: one thread takes the frames that are asked for and measures with them.
//!
//! Frames are averaged in groups while they arrive, so that their number is not bounded by memory: a step gets the means of its groups as
//! frames of less noise, and judges noise and movement by them as it does with single frames.

mod collect;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use parking_lot::{Condvar, Mutex};
use serde_json::{Value, json};

use super::camera::SetupCamera;
use super::folder::{STEPS, Workspace, place};
use super::lamps;
use crate::Error;
use crate::bundle::{Bundle, CameraId, Draft};
use crate::live::stop::Stop;
use crate::output::figure;
use crate::output::panel::{encode_png, write_png};
use collect::Taken;
use stokescope_core::calibrate::{
    CalibrateError, Outcome, PolarizedShots, Shots, Step, align, dark, mask, psf, verify, white,
};
use stokescope_core::image::Stack;
use stokescope_core::polarization::Angle;

/// Time without a frame after which a step fails.
const PATIENCE: Duration = Duration::from_secs(20);
/// Pace of the looks whether the setup ends.
const PACE: Duration = Duration::from_millis(500);
/// Most groups that frames are averaged in: of one step, and of each view of a polarizer.
const GROUPS: [usize; 2] = [8, 4];
/// Most views of a polarizer.
const MAX_VIEWS: usize = 12;

/// Frames that a step is to take.
#[derive(Clone, Debug)]
pub(in crate::live) struct Take {
    /// Frames to average.
    pub(in crate::live) frames: usize,
    /// Reading of the polarizer's dial in degrees, of a view.
    pub(in crate::live) dial: Option<f64>,
    /// Whether the mask is off.
    pub(in crate::live) unmasked: bool,
}

/// Description that views of a polarizer are measured with.
#[derive(Clone, Debug)]
pub(in crate::live) struct Description {
    /// Reading of the dial when the polarizer's axis lies along the sensor's rows.
    pub(in crate::live) zero: f64,
    /// The mask as its maker describes it.
    pub(in crate::live) layout: mask::Layout,
}

/// Work for the thread.
#[derive(Clone, Debug)]
enum Job {
    Take(Step, Take),
    Measure(Step, Description),
}

/// Frames of one position of the polarizer.
#[derive(Debug)]
struct View {
    dial: f64,
    raw: Shots,
    guide: Option<Stack<f32>>,
}

/// The result of a step, before it is kept.
#[derive(Debug)]
enum Found {
    Dark(dark::DarkFrame),
    Mask(mask::MeasuredMask),
    Psf(psf::MeasuredPsf),
    White(white::WhiteBalance),
    Align(align::Alignment),
    Verify,
}

/// Reason why a step failed, and what to do.
#[derive(Clone, Debug)]
struct Fault {
    error: String,
    remedy: Option<String>,
}

impl From<CalibrateError> for Fault {
    fn from(e: CalibrateError) -> Self {
        Self { error: e.to_string(), remedy: e.remedy().map(|remedy| remedy.to_string()) }
    }
}

impl Fault {
    fn of(e: impl Into<Error>) -> Self {
        Self { error: e.into().to_string(), remedy: None }
    }

    fn new(error: String, remedy: &str) -> Self {
        Self { error, remedy: Some(remedy.to_owned()) }
    }
}

/// State of one step.
#[derive(Debug, Default)]
struct Entry {
    views: Vec<View>,
    /// The result, the camera it was measured with, and its picture as a PNG file.
    result: Option<(Found, Option<CameraId>, Outcome, Vec<u8>)>,
    fault: Option<Fault>,
    /// Verdict of the result that was kept.
    kept: Option<String>,
}

#[derive(Debug, Default)]
struct Inner {
    job: Option<Job>,
    /// Step in work, frames taken so far, and frames to take; 0 of 0 while it is measured.
    busy: Option<(Step, usize, usize)>,
    steps: [Entry; STEPS.len()],
}

/// The steps of calibration.
#[derive(Debug)]
pub(in crate::live) struct Calibration {
    raw: Arc<SetupCamera>,
    guide: Option<Arc<SetupCamera>>,
    folder: Arc<Workspace>,
    /// Bytes that the frames of all steps may take.
    budget: usize,
    threads: usize,
    inner: Mutex<Inner>,
    bell: Condvar,
}

impl Calibration {
    pub(in crate::live) fn new(
        raw: Arc<SetupCamera>,
        guide: Option<Arc<SetupCamera>>,
        folder: Arc<Workspace>,
        (budget, threads): (usize, usize),
    ) -> Self {
        Self { raw, guide, folder, budget, threads, inner: Mutex::default(), bell: Condvar::new() }
    }

    /// Steps that this device has.
    pub(in crate::live) fn steps(&self) -> impl Iterator<Item = Step> {
        let (color, guided) = (self.raw.latest().planes.count() == 3, self.guide.is_some());
        STEPS.into_iter().filter(move |step| match step {
            Step::White => color,
            Step::Align => guided,
            _ => true,
        })
    }

    /// The step called `name`.
    pub(in crate::live) fn step(&self, name: &str) -> Option<Step> {
        self.steps().find(|step| step.name() == name)
    }

    /// Begins to take frames.
    ///
    /// # Errors
    /// In words, where the request cannot be met.
    pub(in crate::live) fn take(&self, step: Step, take: Take) -> Result<(), String> {
        let turned = matches!(step, Step::Mask | Step::Verify);
        match take.dial {
            None if turned => {
                return Err(format!("{step}: angle is missing, allowed: the reading of the polarizer's dial"));
            }
            Some(_) if !turned => return Err(format!("{step}: angle, allowed: none, this step has no polarizer")),
            Some(dial) if !dial.is_finite() => {
                return Err(format!("{step}: angle = {dial}, allowed: a number of degrees"));
            }
            _ => {}
        }
        self.begin(Job::Take(step, take))
    }

    /// Begins to measure with the views that were taken.
    ///
    /// # Errors
    /// In words, where the request cannot be met.
    pub(in crate::live) fn measure(&self, step: Step, description: Description) -> Result<(), String> {
        if !matches!(step, Step::Mask | Step::Verify) {
            return Err(format!("{step} is measured as soon as its frames are taken"));
        }
        if self.inner.lock().steps[place(step)].views.is_empty() {
            return Err(format!("{step}: there is no view yet: take one for each angle of the polarizer"));
        }
        self.begin(Job::Measure(step, description))
    }

    fn begin(&self, job: Job) -> Result<(), String> {
        let mut inner = self.inner.lock();
        if let Some((step, ..)) = inner.busy {
            return Err(format!("{step} is in work: wait until it is done"));
        }
        let step = match &job {
            Job::Take(step, take) => {
                inner.busy = Some((*step, 0, take.frames));
                *step
            }
            Job::Measure(step, _) => {
                inner.busy = Some((*step, 0, 0));
                *step
            }
        };
        let entry = &mut inner.steps[place(step)];
        (entry.fault, entry.result) = (None, None);
        inner.job = Some(job);
        drop(inner);
        self.bell.notify_all();
        Ok(())
    }

    /// Puts the result of a step into the bundle, and forgets results of later steps that were measured without it.
    ///
    /// # Errors
    /// In words, where there is no result or the bundle cannot be written.
    pub(in crate::live) fn keep(&self, step: Step) -> Result<(), String> {
        let mut inner = self.inner.lock();
        if let Some((busy, ..)) = inner.busy {
            return Err(format!("{busy} is in work: wait until it is done"));
        }
        let Some((found, camera, outcome, png)) = inner.steps[place(step)].result.take() else {
            return Err(format!("{step}: there is no result to keep"));
        };
        let kept = self.write(step, &found, camera.as_ref(), &outcome);
        let entry = &mut inner.steps[place(step)];
        if let Err(e) = kept {
            entry.result = Some((found, camera, outcome, png));
            return Err(e.to_string());
        }
        entry.views.clear();
        entry.kept = Some(outcome.verdict);
        for later in &mut inner.steps[place(step) + 1..] {
            later.views.clear();
            (later.result, later.fault) = (None, None);
        }
        Ok(())
    }

    fn write(&self, step: Step, found: &Found, camera: Option<&CameraId>, outcome: &Outcome) -> Result<(), Error> {
        if matches!(found, Found::Verify) {
            return Ok(write_png(&self.folder.picture(step), &figure(outcome))?);
        }
        self.folder.change(|draft| {
            camera.map_or(Ok(()), |camera| draft.tie(camera))?;
            match found {
                Found::Dark(found) => draft.set_dark(found),
                Found::Mask(found) => draft.set_mask(found),
                Found::Psf(found) => draft.set_psf(found),
                Found::White(found) => draft.set_white(found),
                Found::Align(found) => draft.set_alignment(found),
                Found::Verify => {}
            }
            Ok(())
        })?;
        Ok(write_png(&self.folder.work().join(format!("{step}.png")), &figure(outcome))?)
    }

    /// Forgets frames and result of a step that were not kept.
    ///
    /// # Errors
    /// In words, while a step is in work.
    pub(in crate::live) fn again(&self, step: Step) -> Result<(), String> {
        let mut inner = self.inner.lock();
        if let Some((busy, ..)) = inner.busy {
            return Err(format!("{busy} is in work: wait until it is done"));
        }
        let entry = &mut inner.steps[place(step)];
        entry.views.clear();
        (entry.result, entry.fault) = (None, None);
        Ok(())
    }

    /// Whether a step is in work.
    pub(in crate::live) fn is_busy(&self) -> bool {
        self.inner.lock().busy.is_some()
    }

    /// PNG picture of a step's result: the latest, or the one that was kept.
    pub(in crate::live) fn picture(&self, step: Step) -> Option<Vec<u8>> {
        let latest = self.inner.lock().steps[place(step)].result.as_ref().map(|(.., png)| png.clone());
        latest.or_else(|| std::fs::read(self.folder.picture(step)).ok())
    }

    /// State of a step: what was taken and measured, and the checks of the latest frames.
    pub(in crate::live) fn state(&self, step: Step) -> Value {
        let (figures, guide) = (self.raw.figures(), self.guide.as_ref().and_then(|guide| guide.figures()));
        let parts = self.folder.parts();
        let (own, white) = {
            let latest = self.raw.latest();
            (latest.black(), latest.white())
        };
        let black = parts.black().or(own).unwrap_or(0.0) / white;
        let lamps = figures.map(|raw| lamps::of(step, &raw, guide.as_deref(), black));
        let inner = self.inner.lock();
        let entry = &inner.steps[place(step)];
        let busy = inner.busy.filter(|(busy, ..)| *busy == step);
        let state = match (busy, &entry.result, &entry.fault) {
            (Some((_, _, 0)), ..) => "measuring",
            (Some(_), ..) => "taking",
            (_, Some(_), _) => "measured",
            (_, _, Some(_)) => "failed",
            _ => "ready",
        };
        let result = entry.result.as_ref().map(|(_, _, outcome, _)| {
            let quality: BTreeMap<&str, f64> = outcome.quality.clone();
            json!({ "verdict": outcome.verdict, "good": outcome.good, "quality": quality,
                "remedy": outcome.remedy.map(|remedy| remedy.to_string()) })
        });
        json!({
            "step": step, "state": state, "needed": matches!(step, Step::Dark | Step::Mask | Step::Psf),
            "kept": parts.has(step) || entry.kept.is_some(), "verdict": entry.kept,
            "progress": busy.map(|(_, taken, of)| json!({ "taken": taken, "of": of })),
            "views": entry.views.iter().map(|view| view.dial).collect::<Vec<_>>(),
            "lamps": lamps, "result": result,
            "fault": entry.fault.as_ref().map(|fault| json!({ "error": fault.error, "remedy": fault.remedy })),
        })
    }

    /// Works until the setup stops.
    pub(in crate::live) fn run(&self, stop: &Stop) {
        while !stop.is_set() {
            let job = {
                let mut inner = self.inner.lock();
                if inner.job.is_none() {
                    self.bell.wait_for(&mut inner, PACE);
                }
                inner.job.take()
            };
            let Some(job) = job else { continue };
            let (step, outcome) = match job {
                Job::Take(step, take) => (step, self.take_frames(step, &take, stop)),
                Job::Measure(step, description) => (step, self.measure_views(step, &description)),
            };
            let mut inner = self.inner.lock();
            inner.busy = None;
            if let Err(fault) = outcome {
                tracing::info!("setup: {}", fault.error);
                inner.steps[place(step)].fault = Some(fault);
            }
        }
    }

    /// Takes the frames of a step, or of one of its views, and measures unless more views follow.
    fn take_frames(&self, step: Step, take: &Take, stop: &Stop) -> Result<(), Fault> {
        let draft = self.folder.draft().map_err(Fault::of)?;
        // without these the frames would be taken in vain
        match step {
            Step::Dark => {}
            Step::Align | Step::Verify => drop(self.device(step)?),
            _ => drop(draft.levels(step)?),
        }
        let taken = self.collect(step, take, &draft, stop)?;
        let camera = self.raw.latest().info.id();
        if let (Some(own), Some(found)) = (&draft.known.camera, &camera) {
            own.check(found, &self.folder.dir).map_err(Fault::of)?;
        }
        let Taken { raw, guide, each } = taken;
        if let Some(dial) = take.dial {
            let view = View { dial, raw, guide: guide.map(|guide| guide.mean()) };
            let views = &mut self.inner.lock().steps[place(step)].views;
            views.retain(|view| (view.dial - dial).abs() > 1e-6);
            views.push(view);
            return Ok(());
        }
        if let Some(busy) = &mut self.inner.lock().busy {
            (busy.1, busy.2) = (0, 0);
        }
        let (found, outcome) = match step {
            Step::Dark => {
                let (bits, white) = {
                    let latest = self.raw.latest();
                    (latest.info.format.bits().unwrap_or(16), latest.info.levels.map_or(f32::INFINITY, |l| l.white))
                };
                let mut found = dark::measure_to(&raw, bits, white)?;
                // the noise of one frame, not that of the mean of a group
                found.read_noise *= each.sqrt();
                let outcome = found.outcome();
                (Found::Dark(found), outcome)
            }
            Step::Psf => {
                let mask = draft.known.response.as_ref().filter(|_| !take.unmasked);
                let found = psf::measure(&raw, &draft.levels(step)?, mask)?;
                let outcome = found.outcome();
                (Found::Psf(found), outcome)
            }
            Step::White => {
                let found = white::measure(&raw, &draft.levels(step)?)?;
                let outcome = found.outcome();
                (Found::White(found), outcome)
            }
            Step::Align => {
                let device = self.device(step)?;
                let none = || Fault::new("align: the board has no guide camera".to_owned(), "go on without it");
                let found = align::measure(&device, &raw, &guide.ok_or_else(none)?, self.threads)?;
                let outcome = found.outcome();
                (Found::Align(found), outcome)
            }
            Step::Mask | Step::Verify => return Ok(()),
        };
        self.store(step, found, camera, outcome)
    }

    /// The device that the bundle in the making describes.
    fn device(&self, step: Step) -> Result<Bundle, Fault> {
        if let Some(first) = self.folder.parts().missing().next() {
            return Err(CalibrateError::MissingStep { step, first }.into());
        }
        self.folder.bundle().map_err(Fault::of)
    }

    fn measure_views(&self, step: Step, description: &Description) -> Result<(), Fault> {
        let draft = self.folder.draft().map_err(Fault::of)?;
        let camera = self.raw.latest().info.id();
        // the views stay here while they are measured, so that a measurement that fails can be repeated with another description
        let taken = std::mem::take(&mut self.inner.lock().steps[place(step)].views);
        let (dials, views): (Vec<_>, Vec<_>) = taken
            .into_iter()
            .map(|View { dial, raw, guide }| {
                let angle = Angle::from_degrees(dial - description.zero);
                ((dial, guide), PolarizedShots { angle, shots: raw })
            })
            .unzip();
        let measured = self.measure_polarized(step, &draft, &views, &dials, &description.layout);
        let back = dials.into_iter().zip(views);
        let back = back.map(|((dial, guide), PolarizedShots { shots, .. })| View { dial, raw: shots, guide });
        self.inner.lock().steps[place(step)].views = back.collect();
        let (found, outcome) = measured?;
        self.store(step, found, camera, outcome)
    }

    fn measure_polarized(
        &self,
        step: Step,
        draft: &Draft,
        views: &[PolarizedShots],
        guides: &[(f64, Option<Stack<f32>>)],
        layout: &mask::Layout,
    ) -> Result<(Found, Outcome), Fault> {
        if step == Step::Mask {
            let found = mask::measure(views, &draft.levels(step)?, layout)?;
            let outcome = found.outcome();
            return Ok((Found::Mask(found), outcome));
        }
        let device = self.device(step)?;
        let guides: Vec<_> = guides.iter().filter_map(|(_, guide)| guide.clone()).collect();
        let found = verify::measure(&device, views, &guides, self.threads)?;
        Ok((Found::Verify, found.outcome()))
    }

    fn store(&self, step: Step, found: Found, camera: Option<CameraId>, outcome: Outcome) -> Result<(), Fault> {
        let mut png = Vec::new();
        encode_png(&figure(&outcome), &mut png).map_err(|e| Fault::of(Error::Internal(e.to_string())))?;
        self.inner.lock().steps[place(step)].result = Some((found, camera, outcome, png));
        Ok(())
    }
}
