//! Preparation and solver for one field: the frame alone, or the frame with a margin from which light reaches the sensor.

use std::sync::Arc;

use super::solver::{Solver, distinct_bytes, polarized_modes, slow_modes};
use super::{PlanError, Settings};
use crate::device::Device;
use crate::guide::beyond::{self, Traces};
use crate::guide::{self, GuideMode, PrepareError, PsfSize};
use crate::image::{Planes, Stack};
use crate::optics::{Coarse, Field, Margin, Psf, StokesOperator};
use crate::parallel::Workers;
use crate::polarization;
use crate::readings::Readings;
use crate::solve::{self, Method};

/// Everything of stage I that depends on the field.
#[derive(Debug)]
pub(super) struct Reconstruction {
    pub(super) operators: Vec<StokesOperator>,
    /// Normal equations of the low-frequency modes and of a guide's gain, for each channel; empty without a guide.
    pub(super) guided_modes: Vec<Arc<Coarse>>,
    pub(super) prepare: guide::Plan,
    pub(super) prepared: guide::Workspace,
    pub(super) solver: Solver,
    /// The solver of another method, for the next frame that needs it.
    pub(super) spare: Option<Solver>,
    /// Size of the PSF over its calibrated size.
    pub(super) psf_scale: f64,
    /// Images of the frame alone; none where the field is the frame.
    pub(super) frame: Option<FrameImages>,
    /// Bytes of the parts that stay when the solver changes.
    pub(super) fixed: Vec<(&'static str, usize)>,
    /// Readings of an evenly bright surrounding, where light from there is looked for.
    pattern: Option<Vec<f32>>,
}

/// Images of the frame that are cut out of those of a larger field.
#[derive(Debug)]
pub(super) struct FrameImages {
    /// The prepared guide `[C, H, W]`.
    pub(super) guide: Stack<f32>,
    /// Readings less the light from beyond the frame `[C, H, W]`.
    pub(super) raw: Stack<f32>,
    /// Stokes images of the field, `[C, 3, H, W]`; `[C, 1, H, W]` without a mask.
    pub(super) stokes: Stack<f32>,
    /// Readings of the light from beyond the frame, on the field.
    beyond: Vec<f32>,
}

impl Reconstruction {
    /// Plans preparation and solver for scenes that go on for `margin` beyond the frame, if they fit beside stages of `others`. Allocates.
    pub(super) fn new(
        device: &Device,
        (psf, psf_scale): (&Psf, f64),
        margin: Margin,
        method: Method,
        (settings, workers): (&Settings, Arc<Workers>),
        others: &[(&'static str, usize)],
    ) -> Result<Self, PlanError> {
        let guided = method == Method::Guided;
        let (channels, response) = (device.sensor.channels, &device.response);
        let operators = StokesOperator::on_field(psf, response, channels, margin, settings.fft, workers)?;
        let guided_modes = if guided && response.is_polarized() { slow_modes(&operators) } else { Vec::new() };
        let prepare = guide::Plan::new(device, &operators, &guided_modes, GuideMode::new(guided, settings.register));
        let coarse = polarized_modes(&guided_modes);
        let mut prepared = prepare.make_workspace();
        // The solver lends its scratch memory to the preparation.
        let lent = prepared.scratch().lent_bytes();
        drop(prepared.scratch().lend());
        let field = operators[0].field();
        let planes = channels * if response.is_polarized() { 3 } else { 1 };
        let frame = (!margin.is_none()).then(|| FrameImages::new(field, channels, planes));
        // Equations of the gain, which the solver does not count.
        let equations = distinct_bytes(&guided_modes).saturating_sub(distinct_bytes(&coarse));
        let maps = 3 * size_of::<f32>() * field.size().pixels();
        let kernels = operators[0].kernel.bytes() * psf.count();
        let looks = margin.is_none() && !device.margin.is_none() && !method.solves_angles();
        let pattern = looks.then(|| beyond::pattern(&operators[0]));
        let pattern_bytes = pattern.as_ref().map_or(0, |pattern| size_of_val(&pattern[..]));
        let images = frame.as_ref().map_or(0, FrameImages::bytes) + pattern_bytes;
        let fixed =
            vec![("optics", kernels + maps + equations), ("prepare", prepare.workspace_bytes() - lent + images)];
        let beside: Vec<_> = fixed.iter().chain(others).copied().collect();
        let solver = Solver::plan(&operators, &coarse, method, settings, &beside)?;
        Ok(Self { operators, guided_modes, prepare, prepared, solver, spare: None, psf_scale, frame, fixed, pattern })
    }

    /// Forgets everything of earlier frames but the size of the PSF.
    pub(super) fn forget(&mut self) {
        self.prepared.forget_all();
        for solver in [Some(&mut self.solver), self.spare.as_mut()].into_iter().flatten() {
            solver.workspace.forget();
        }
    }

    /// The field.
    pub(super) fn field(&self) -> Field {
        self.operators[0].field()
    }

    /// Bytes of every part.
    pub(super) fn stages(&self) -> impl Iterator<Item = (&'static str, usize)> {
        self.fixed.iter().copied().chain([("recon", self.solver.bytes() + self.solver.plan.bytes())])
    }

    /// Bytes of the workspaces, and of the state kept between frames of a video.
    pub(super) fn workspace_bytes(&self) -> usize {
        let solvers = [Some(&self.solver), self.spare.as_ref()].into_iter().flatten();
        let prepare: usize = self.fixed.iter().filter(|(stage, _)| *stage == "prepare").map(|(_, bytes)| bytes).sum();
        prepare + solvers.map(Solver::bytes).sum::<usize>()
    }

    /// Bytes of all parts together.
    pub(super) fn bytes(&self) -> usize {
        self.stages().map(|(_, bytes)| bytes).sum::<usize>()
            + self.spare.as_ref().map_or(0, |spare| spare.bytes() + spare.plan.bytes())
    }

    /// The camera whose scene ends with the frame, for stage II. Allocates where the field is larger.
    pub(super) fn frame_operators(
        &self,
        device: &Device,
        settings: &Settings,
        workers: &Arc<Workers>,
    ) -> Result<Vec<StokesOperator>, PlanError> {
        if self.field().margin().is_none() {
            return Ok(self.operators.clone());
        }
        let (channels, workers) = (self.operators.len(), Arc::clone(workers));
        Ok(StokesOperator::for_channels(&device.psf, &device.response, channels, settings.fft, workers)?)
    }

    /// Prepares one frame and its guide. `look` says whether light from beyond the frame is looked for.
    pub(super) fn prepare(
        &mut self,
        readings: &Readings,
        guide: Option<Planes<'_>>,
        psf_size: PsfSize,
        look: bool,
    ) -> Result<guide::Summary, PrepareError> {
        let lent = self.solver.workspace.scratch().lend();
        self.prepared.scratch().give_back(lent);
        let pattern = self.pattern.as_deref().filter(|_| look);
        let summary = self.prepare.run(readings, guide, psf_size, pattern, &mut self.prepared);
        self.solver.workspace.scratch().give_back(self.prepared.scratch().lend());
        summary
    }

    /// Whether Stokes images of the frame leave light from beyond it in the readings, whose noise has a standard deviation of `sigma`.
    pub(super) fn leaves_light(&mut self, stokes: &Stack<f32>, sigma: Option<f32>) -> bool {
        let (Some(pattern), Some(sigma)) = (&self.pattern, sigma) else { return false };
        let (size, planes) = (stokes.size(), stokes.count() / self.operators.len());
        let (noise, n) = (f64::from(sigma).powi(2), size.pixels());
        let mut traces = Traces::default();
        let (rest, raw, weight) = self.prepared.plane_and_readings();
        for (c, operator) in self.operators.iter().enumerate() {
            let channel = &stokes.as_slice()[c * planes * n..][..planes * n];
            operator.forward(channel, rest, self.solver.workspace.scratch());
            let readings = raw.plane(c).iter().zip(weight.plane(c));
            rest.iter_mut().zip(readings).for_each(|(rest, (y, weight))| *rest = weight * (y - *rest));
            let brightness = channel[..n].iter().map(|v| f64::from(*v)).sum::<f64>() / n as f64;
            traces.add(pattern, rest, size, brightness, noise);
        }
        traces.tell(beyond::UNGUIDED)
    }

    /// The prepared guide of the frame.
    pub(super) fn guide(&self) -> &Stack<f32> {
        self.frame.as_ref().map_or(&self.prepared.guide, |frame| &frame.guide)
    }

    /// The prepared readings of the frame, less the light from beyond it where that is modelled.
    pub(super) fn raw(&self) -> &Stack<f32> {
        self.frame.as_ref().map_or(&self.prepared.raw, |frame| &frame.raw)
    }

    /// Solves the prepared frame, whose guide is used if it is `guided`, into `stokes` or, with an angle method, the solver's own images.
    pub(super) fn solve(
        &mut self,
        guided: bool,
        iterations: Option<usize>,
        stokes: &mut Stack<f32>,
    ) -> Result<solve::Outcome, solve::Divergence> {
        let input = solve::Input {
            raw: &self.prepared.raw,
            weight: &self.prepared.weight,
            guide: guided.then_some(&self.prepared.guide),
        };
        let Solver { plan, workspace, output, last, iterations: usual } = &mut self.solver;
        let images = self.frame.as_mut().map_or(stokes, |frame| &mut frame.stokes);
        let output = output.as_mut().unwrap_or(images);
        let iterations = iterations.unwrap_or(*usual);
        match last {
            Some(last) => plan.run_next(&input, iterations, output, workspace, last),
            None => plan.run(&input, iterations, output, workspace),
        }
    }

    /// Cuts the frame out of the field's images, takes the light from beyond the frame off its readings, and returns the share of that
    /// light in them. Zero where the field is the frame. Allocates nothing.
    pub(super) fn cut_out(&mut self, polarization: &polarization::Plan, stokes: &mut Stack<f32>) -> f32 {
        let field = self.field();
        let Some(frame) = &mut self.frame else { return 0.0 };
        field.crop_planes(&self.prepared.guide, &mut frame.guide);
        field.crop_planes(&self.prepared.raw, &mut frame.raw);
        let n = field.size().pixels();
        if let Some(angles) = &self.solver.output {
            polarization.to_stokes_images(angles, &mut frame.stokes);
        }
        field.crop_planes(&frame.stokes, stokes);
        let FrameImages { raw, stokes, beyond, .. } = frame;
        let planes = stokes.count() / self.operators.len();
        let scratch = self.solver.workspace.scratch();
        let (mut light, mut all) = (0.0f64, 0.0f64);
        for (c, operator) in self.operators.iter().enumerate() {
            let channel = &stokes.as_slice()[c * planes * n..][..planes * n];
            operator.forward_margin(channel, beyond, scratch);
            all += raw.plane(c).iter().map(|v| f64::from(*v)).sum::<f64>();
            light += beyond.iter().map(|v| f64::from(*v)).sum::<f64>();
            field.subtract(beyond, raw.plane_mut(c));
        }
        if all > 0.0 { (light / all) as f32 } else { 0.0 }
    }
}

impl FrameImages {
    fn new(field: Field, channels: usize, planes: usize) -> Self {
        let (frame, whole) = (field.frame(), field.size());
        Self {
            guide: Stack::zeros(channels, frame),
            raw: Stack::zeros(channels, frame),
            stokes: Stack::zeros(planes, whole),
            beyond: vec![0.0; whole.pixels()],
        }
    }

    fn bytes(&self) -> usize {
        self.guide.bytes() + self.raw.bytes() + self.stokes.bytes() + size_of_val(&self.beyond[..])
    }
}
