//! L3: the only place where stages meet. Frames → prepare → recon → polar → [`Polarization`].
//!
//! [`Pipeline::new`] proves all shapes, sums the bytes of every stage and refuses what does not fit the memory limit;
//! [`Pipeline::process`] then works in those buffers.
//!
//! Allocation: `plan` allocates, `process` does not, with two exceptions. For the first guide that proves useless S0 has to be solved
//! for; that solver is kept beside the first if the memory limit allows for both, else they take turns. And where the PSF proves to be
//! larger or smaller than when it was calibrated, what was made of it at the start is made again.
//! Imports: all stages.

mod refit;
mod report;
mod solver;
mod warning;

use std::sync::Arc;
use std::time::{Duration, Instant};

pub use report::{FrameReport, Notice};
use solver::{Solver, distinct_bytes, polarized_modes, slow_modes};
pub use warning::Warning;

use crate::device::Device;
use crate::guide::{self, PrepareError, PsfSize};
use crate::image::{ImageView, Planes, Size, Stack};
use crate::optics::{Coarse, FftBackend, LengthError, Psf, StokesOperator};
use crate::parallel::Workers;
use crate::polarization;
use crate::polarization::Angle;
use crate::readings::{Quality, Unit};
use crate::refine;
use crate::solve::{self, Divergence, Method};

/// What a user may choose.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Whether frames come with a guide.
    pub guided: bool,
    /// The method; none takes `guided` with a guide and `stokes` without.
    pub method: Option<Method>,
    /// Iterations; none takes the method's usual number.
    pub iterations: Option<usize>,
    /// Whether the guide of every frame is aligned with it. If not, it is taken where the bundle says that it lies.
    pub register: bool,
    /// Whether a PSF that is not as large any more as when it was calibrated is refitted, where a guide is searched for.
    pub refit_psf: bool,
    /// The FFT library.
    pub fft: FftBackend,
    /// Threads of the solver.
    pub threads: usize,
    /// Bytes all stages together may hold.
    pub memory_limit_bytes: usize,
    /// The network of stage II; none is physics only.
    pub fusion: Option<refine::Network>,
    /// Whether frames follow each other as in a video: each may then go on from the result of the last one, and its guide is
    /// followed rather than searched for.
    pub video: bool,
    /// Whether results hold the intensities behind polarizers, beside the Stokes images that they follow from.
    pub angles: bool,
}

impl Default for Settings {
    /// The usual method beside a guide with its usual iterations, on all cores, guides aligned, the PSF's size refitted, no network, single frames.
    fn default() -> Self {
        Self {
            guided: true,
            method: None,
            iterations: None,
            register: true,
            refit_psf: true,
            fft: FftBackend::default(),
            threads: std::thread::available_parallelism().map_or(1, usize::from),
            memory_limit_bytes: usize::MAX,
            fusion: None,
            video: false,
            angles: true,
        }
    }
}

/// Pixels whose S0 lies below this fraction of the frame's peak reading carry no usable polarization.
const DARK: f32 = 0.02;

/// Times that the PSF's size is refitted for one frame, at most.
const REFITS: usize = 3;

/// Why a pipeline cannot be planned.
#[derive(Debug, thiserror::Error)]
pub enum PlanError {
    /// The frame is too large for the FFT backend.
    #[error(transparent)]
    Length(#[from] LengthError),
    /// The solver cannot work with this camera.
    #[error(transparent)]
    Recon(#[from] solve::PlanError),
    /// The fusion model cannot be run.
    #[error(transparent)]
    Fusion(#[from] refine::PlanError),
    /// A guided method without a guide.
    #[error(
        "method guided needs a guide frame; allowed without one: stokes, fista, fista-published, admm, admm-published"
    )]
    NoGuide,
    /// Zero iterations.
    #[error("iterations = 0, allowed: 1 or more")]
    NoIterations,
    /// The stages need more memory than there is.
    #[error("memory: {} need {total} bytes together, the limit is {limit}", stages.iter().map(|(name, bytes)| format!("{name} {bytes}")).collect::<Vec<_>>().join(" + "))]
    Memory {
        /// Bytes of each stage.
        stages: Vec<(&'static str, usize)>,
        /// Their sum.
        total: usize,
        /// The limit.
        limit: usize,
    },
}

/// Why a frame cannot be processed.
#[derive(Debug, thiserror::Error)]
pub enum ProcessError {
    /// It does not fit the bundle or holds nothing usable.
    #[error(transparent)]
    Prepare(#[from] PrepareError),
    /// The solver diverged.
    #[error(transparent)]
    Recon(#[from] Divergence),
    /// The guide proved useless and S0 cannot be solved for instead.
    #[error(transparent)]
    Plan(#[from] PlanError),
}

/// The polarization of one frame.
#[derive(Debug)]
pub struct Polarization {
    /// `[C, 3, H, W]`: S0, S1, S2; without a mask `[C, 1, H, W]`. Fractions of full scale.
    pub stokes: Stack<f32>,
    /// `[C, P, H, W]`: intensities behind ideal polarizers; none without a mask, or where [`Settings::angles`] does without.
    pub angles: Option<Stack<f32>>,
    /// Neither dark nor read through a pixel that could not be trusted.
    pub valid: Vec<bool>,
}

/// A planned pipeline with all its buffers.
#[derive(Debug)]
pub struct Pipeline {
    settings: Settings,
    /// What was asked for; without a usable guide `solver` does without one.
    method: Method,
    operators: Vec<StokesOperator>,
    /// The slow modes beside a guide of each channel; none where none is solved with.
    beside: Vec<Arc<Coarse>>,
    /// The PSF as calibrated, where it may be refitted, and how many times as large it is taken for.
    psf: Option<Psf>,
    psf_scale: f64,
    /// Bytes of the stages that stay when the solver changes.
    fixed: Vec<(&'static str, usize)>,
    prepare: guide::Plan,
    prepared: guide::Workspace,
    solver: Solver,
    /// The solver of another method, for the next frame that needs it.
    spare: Option<Solver>,
    fusion: Option<Fusion>,
    fused: bool,
    polar: polarization::Plan,
    angles: Vec<Angle>,
    /// Noise of the readings by the bundle, where no solver measures it.
    noise: f32,
    result: Polarization,
    /// Changes since the last frame's report.
    notices: Vec<Notice>,
    /// Images that came in another form than planes of single precision.
    copies: Copies,
}

/// Copies of a raw frame and of a guide in planes of single precision; empty until one is needed.
#[derive(Debug, Default)]
struct Copies {
    raw: Stack<f32>,
    guide: Stack<f32>,
}

/// A processed frame: its report, and its images in the pipeline's memory until the next frame.
#[derive(Debug)]
pub struct ProcessedFrame<'a> {
    report: FrameReport,
    pipeline: &'a Pipeline,
}

impl<'a> ProcessedFrame<'a> {
    /// Figures and warnings of the frame.
    pub fn report(&self) -> &FrameReport {
        &self.report
    }

    /// Figures and warnings of the frame, without its images.
    pub fn into_report(self) -> FrameReport {
        self.report
    }

    /// What a user should know before trusting the result.
    pub fn warnings(&self) -> &[Warning] {
        &self.report.warnings
    }

    /// S0, S1, S2 of each channel, `[C, 3, H, W]`; without a mask S0 alone, `[C, 1, H, W]`. Fractions of full scale.
    pub fn stokes(&self) -> &'a Stack<f32> {
        &self.pipeline.result.stokes
    }

    /// Intensities behind ideal polarizers, `[C, P, H, W]`, fractions of full scale; none without a mask, or where [`Settings::angles`]
    /// does without.
    pub fn angles(&self) -> Option<&'a Stack<f32>> {
        self.pipeline.result.angles.as_ref()
    }

    /// For each pixel whether its result can be trusted: it is neither dark nor read through a pixel that could not be trusted.
    pub fn valid(&self) -> &'a [bool] {
        &self.pipeline.result.valid
    }
}

/// What came of a frame.
struct Attempt {
    summary: guide::Summary,
    outcome: solve::Outcome,
    fusion: Option<refine::Report>,
    warnings: Vec<Warning>,
    /// Times; that of aligning is in the summary.
    prepare: Duration,
    recon: Duration,
    fusion_time: Duration,
}

#[derive(Debug)]
struct Fusion {
    plan: refine::Plan,
    workspace: refine::Workspace,
    /// Angles of stage I alone, `[C, P, H, W]`.
    stage1: Stack<f32>,
}

impl Pipeline {
    /// Plans all stages for one device. Allocates.
    ///
    /// # Errors
    /// [`PlanError`], naming stage, need and limit.
    pub fn new(device: &Device, settings: Settings) -> Result<Self, PlanError> {
        let guide = settings.guided;
        let method = settings.method.unwrap_or(if guide { Method::Guided } else { Method::Stokes });
        if method == Method::Guided && !guide {
            return Err(PlanError::NoGuide);
        }
        let workers = Arc::new(Workers::new(settings.threads));
        let channels = device.sensor.channels;
        let operators = StokesOperator::for_channels(&device.psf, &device.response, channels, settings.fft, workers)?;
        let size = device.sensor.size;
        let angles = device.response.angles().to_vec();
        let guided = method == Method::Guided;
        let beside = if guided && !angles.is_empty() { slow_modes(&operators) } else { Vec::new() };
        let aligned = if settings.register { guide::GuideMode::Aligned } else { guide::GuideMode::Placed };
        let guide_mode = if guided { aligned } else { guide::GuideMode::Shown };
        let prepare = guide::Plan::new(device, &operators, &beside, guide_mode);
        let coarse = polarized_modes(&beside);
        let planes = if angles.is_empty() { 1 } else { 3 };
        let intensities = if settings.angles { angles.len() } else { 0 };
        let image = size_of::<f32>() * channels * size.pixels();
        let psfs = device.psf.count();
        // What the equations beside the guide hold beyond those that the solver counts.
        let beyond = distinct_bytes(&beside).saturating_sub(distinct_bytes(&coarse));
        let psf = (guided && settings.refit_psf).then(|| device.psf.clone());
        let kept = psf.as_ref().map_or(0, |psf| size_of::<f32>() * psf.count() * size.pixels());
        let optics = operators[0].kernel.bytes() * psfs + 3 * image / channels + beyond + kept;
        let mut prepared = prepare.make_workspace();
        // the solver lends its own to the preparation
        let shared = prepared.scratch().lent_bytes();
        drop(prepared.scratch().lend());
        let mut fixed = vec![
            ("optics", optics),
            ("prepare", prepare.workspace_bytes() - shared),
            ("result", (planes + intensities) * image + size.pixels()),
        ];
        // Without a mask there is no polarization to refine.
        let network = settings.fusion.as_ref().filter(|_| !angles.is_empty());
        let stage2 = network.map(|network| refine::Plan::new(network, &operators)).transpose()?;
        let bytes = |plan: &refine::Plan| plan.bytes() + plan.workspace_bytes() + angles.len() * image;
        fixed.extend(stage2.iter().map(|plan| ("fusion", bytes(plan))));
        let norms: Vec<f32> = if method == Method::Fista && !angles.is_empty() {
            let norm = |c: usize| solve::norm_squared(&operators[c]);
            (0..channels).map(|c| norm(c.min(device.psf.count() - 1))).collect()
        } else {
            Vec::new()
        };
        let solver = Solver::plan(&operators, &coarse, &norms, method, &settings, &fixed)?;
        Ok(Self {
            settings,
            method,
            prepared,
            prepare,
            solver,
            spare: None,
            fusion: stage2.map(|plan| Fusion::new(plan, channels * angles.len(), size)).transpose()?,
            fused: true,
            polar: polarization::Plan::new(&angles),
            result: Polarization {
                stokes: Stack::zeros(channels * planes, size),
                angles: (intensities > 0).then(|| Stack::zeros(channels * intensities, size)),
                valid: vec![false; size.pixels()],
            },
            angles,
            noise: device.noise.read,
            operators,
            beside,
            notices: Vec::new(),
            copies: Copies::default(),
            psf,
            psf_scale: 1.0,
            fixed,
        })
    }

    /// Size of the frames.
    pub fn size(&self) -> Size {
        self.result.stokes.size()
    }

    /// The polarizer angles of the result.
    pub fn angles(&self) -> &[Angle] {
        &self.angles
    }

    /// The latest result.
    pub fn result(&self) -> &Polarization {
        &self.result
    }

    /// Stage II, where there is one.
    pub fn fusion(&self) -> Option<&refine::Plan> {
        self.fusion.as_ref().map(|f| &f.plan)
    }

    /// Angles of stage I alone, of the latest frame, `[C, P, H, W]`; none without a fusion model.
    pub fn stage1(&self) -> Option<&Stack<f32>> {
        self.fusion.as_ref().map(|f| &f.stage1)
    }

    /// Bytes of the solver's and the preparation's workspaces, and of what is kept of a video's last frame.
    pub fn workspace_bytes(&self) -> usize {
        let solvers = [Some(&self.solver), self.spare.as_ref()].into_iter().flatten();
        let fusion = self.fusion.as_ref().map_or(0, |f| f.plan.workspace_bytes());
        let prepare: usize = self.fixed.iter().filter(|(stage, _)| *stage == "prepare").map(|(_, bytes)| bytes).sum();
        prepare + solvers.map(Solver::bytes).sum::<usize>() + fusion
    }

    /// Bytes of every stage.
    pub fn stages(&self) -> impl Iterator<Item = (&'static str, usize)> {
        self.fixed.iter().copied().chain([("recon", self.solver.bytes() + self.solver.plan.bytes())])
    }

    /// The shortest iteration of the latest frame, of a guided method.
    pub fn shortest_iteration(&self) -> Option<Duration> {
        self.solver.workspace.shortest_iteration()
    }

    /// What the solver's workspace consists of, in bytes. Allocates.
    pub fn solver_parts(&self) -> Vec<(&'static str, usize)> {
        self.solver.plan.workspace_parts()
    }

    /// Complex 2-D FFTs of the padded size that the solver has done so far.
    pub fn transforms(&self) -> usize {
        self.solver.workspace.transforms()
    }

    /// The method that frames are solved with.
    pub fn method(&self) -> Method {
        self.solver.plan.method()
    }

    /// Solves the frames to come with this many iterations, at least one. Allocates nothing.
    pub fn set_iterations(&mut self, iterations: usize) {
        self.settings.iterations = Some(iterations.max(1));
    }

    /// Searches for the next frame's guide from nothing, as for a first frame. Allocates nothing.
    pub fn forget_guide(&mut self) {
        self.prepared.forget();
    }

    /// The prepared readings of the latest frame `[C, H, W]`, fractions of full scale.
    pub fn raw(&self) -> &Stack<f32> {
        &self.prepared.raw
    }

    /// The prepared guide of the latest frame, in sensor units.
    pub fn guide(&self) -> &Stack<f32> {
        &self.prepared.guide
    }

    /// Processes one frame, with its guide where there is one. Allocates nothing for planar images of single precision; others are copied
    /// into buffers that grow once.
    ///
    /// # Errors
    /// [`ProcessError`]; [`Self::result`] is then that of no frame.
    pub fn process<'a>(
        &mut self,
        raw: ImageView<'_>,
        guide: impl Into<Option<ImageView<'a>>>,
    ) -> Result<ProcessedFrame<'_>, ProcessError> {
        let mut buffers = std::mem::take(&mut self.copies);
        let guide = guide.into();
        let planes = raw.to_planes(&mut buffers.raw);
        let guide = guide.map(|guide| guide.to_planes(&mut buffers.guide));
        let report = self.solve(planes, raw.unit(), guide);
        self.copies = buffers;
        Ok(ProcessedFrame { report: report?, pipeline: self })
    }

    fn solve(&mut self, raw: Planes<'_>, unit: Unit, guide: Option<Planes<'_>>) -> Result<FrameReport, ProcessError> {
        let Attempt { summary, outcome, fusion, warnings, prepare, recon, fusion_time } =
            self.attempt(raw, unit, guide)?;
        self.mark_valid(&summary.quality);
        let channels = raw.count();
        let valid = &self.result.valid;
        let count = valid.iter().filter(|v| **v).count();
        Ok(FrameReport {
            method: self.solver.plan.method(),
            iterations: outcome.iterations,
            modelled: outcome.modelled,
            why: report::why(outcome.modelled, self.method, guide.is_some(), &summary),
            course: outcome.start,
            averaged: outcome.averaged,
            residual_rms: outcome.residual_rms,
            gain: summary.gain.iter().flat_map(|g| (0..channels).map(|c| g[c] * outcome.gain[c])).collect(),
            mean_dolp: (!self.angles.is_empty())
                .then(|| polarization::mean_dolp(self.result.stokes.as_slice(), valid))
                .flatten(),
            valid_fraction: count as f32 / valid.len() as f32,
            shift_px: summary.shift,
            psf_scale: self.psf_scale as f32,
            prepare,
            register: summary.register,
            recon,
            fusion,
            fusion_time,
            warnings,
            notices: std::mem::take(&mut self.notices),
        })
    }

    /// One frame from readings to the result.
    fn attempt(&mut self, raw: Planes<'_>, unit: Unit, guide: Option<Planes<'_>>) -> Result<Attempt, ProcessError> {
        let start = Instant::now();
        if !self.settings.video {
            self.prepared.forget();
        }
        let mut warnings = Vec::new();
        let summary = self.prepare(raw, unit, guide, &mut warnings)?;
        let prepare = start.elapsed().saturating_sub(summary.register);
        warnings.extend(warning::of_readings(&summary.quality));
        let mut method = self.method;
        if method == Method::Guided && summary.gain.is_none() {
            warnings.push(if guide.is_some() { Warning::UselessGuide } else { Warning::NoGuide });
            method = Method::Stokes;
        }
        if let Some(agreement) = summary.agreement {
            warnings.extend(warning::of_guide(&agreement));
            if agreement.foreign {
                method = Method::Stokes;
            }
        }
        match self.take_turns(method) {
            Err(PlanError::Memory { total, limit, .. }) if summary.gain.is_some() => {
                warnings.push(Warning::ForeignGuideTaken { needed: total, limit });
            }
            outcome => outcome?,
        }
        let start = Instant::now();
        let channels = raw.count();
        let input = solve::Input {
            raw: &self.prepared.raw,
            weight: &self.prepared.weight,
            guide: summary.gain.is_some().then_some(&self.prepared.guide),
        };
        let Solver { plan, workspace, output, last, iterations } = &mut self.solver;
        let output = output.as_mut().unwrap_or(&mut self.result.stokes);
        let iterations = self.settings.iterations.unwrap_or(*iterations);
        let outcome = match last {
            Some(last) => plan.run_next(&input, iterations, output, workspace, last)?,
            None => plan.run(&input, iterations, output, workspace)?,
        };
        let recon = start.elapsed();
        self.complete(channels);
        let start = Instant::now();
        let fusion = self.refine(outcome.sigma.unwrap_or(self.noise), channels);
        Ok(Attempt { summary, outcome, fusion, warnings, prepare, recon, fusion_time: start.elapsed() })
    }

    /// Readings and guide made what the solver takes, and the PSF the size that they tell.
    fn prepare(
        &mut self,
        raw: Planes<'_>,
        unit: Unit,
        guide: Option<Planes<'_>>,
        warnings: &mut Vec<Warning>,
    ) -> Result<guide::Summary, ProcessError> {
        let mut psf_size = if self.psf.is_some() { PsfSize::Asked } else { PsfSize::Given };
        let mut refits = 0;
        loop {
            let lent = self.solver.workspace.scratch().lend();
            self.prepared.scratch().give_back(lent);
            let summary = self.prepare.run(raw, unit, guide, psf_size, &mut self.prepared);
            self.solver.workspace.scratch().give_back(self.prepared.scratch().lend());
            let summary = summary?;
            let Some(growth) = summary.growth else { return Ok(summary) };
            let why_not = self.refit_psf(growth)?;
            refits += 1;
            psf_size = if why_not.is_none() && refits < REFITS { PsfSize::Refitted } else { PsfSize::Given };
            warnings.extend(why_not);
        }
    }

    /// Whether stage II is run from now on, where there is one.
    pub fn set_fused(&mut self, fused: bool) {
        self.fused = fused;
    }

    /// Stage II, with the readings' noise `sigma`; stage I stays beside it.
    fn refine(&mut self, sigma: f32, channels: usize) -> Option<refine::Report> {
        let Fusion { plan, workspace, stage1 } = self.fusion.as_mut()?;
        let Polarization { stokes, angles, .. } = &mut self.result;
        match &self.solver.output {
            Some(solved) => stage1.as_mut_slice().copy_from_slice(solved.as_slice()),
            None => to_angles(&self.polar, stokes, stage1, channels),
        }
        if !self.fused {
            return None;
        }
        let input = refine::Input { raw: &self.prepared.raw, weight: &self.prepared.weight, sigma };
        let report = plan.run(&input, stokes, workspace);
        if let Some(angles) = angles.as_mut().filter(|_| report.is_learned()) {
            to_angles(&self.polar, stokes, angles, channels);
        }
        Some(report)
    }

    /// Angles from Stokes or Stokes from angles, whichever the method did not solve for.
    fn complete(&mut self, channels: usize) {
        let Polarization { stokes, angles, .. } = &mut self.result;
        let (n, p) = (stokes.size().pixels(), self.angles.len());
        match (&self.solver.output, angles) {
            (Some(solved), angles) => {
                let pairs = solved.as_slice().chunks_exact(p * n).zip(stokes.as_mut_slice().chunks_exact_mut(3 * n));
                pairs.for_each(|(angles, stokes)| self.polar.to_stokes(angles, stokes, n));
                angles.iter_mut().for_each(|angles| angles.as_mut_slice().copy_from_slice(solved.as_slice()));
            }
            (None, Some(angles)) => to_angles(&self.polar, stokes, angles, channels),
            (None, None) => {}
        }
    }

    fn mark_valid(&mut self, quality: &Quality) {
        let per_channel = self.result.stokes.count() / self.prepared.raw.count();
        self.result.valid.fill(true);
        for c in 0..self.prepared.raw.count() {
            let s0 = self.result.stokes.plane(c * per_channel);
            let pixels = self.result.valid.iter_mut().zip(s0.iter().zip(self.prepared.weight.plane(c)));
            pixels.for_each(|(valid, (s0, weight))| *valid &= *weight > 0.0 && *s0 > DARK * quality.peak);
        }
    }
}

impl Fusion {
    fn new(plan: refine::Plan, planes: usize, size: Size) -> Result<Self, PlanError> {
        Ok(Self { workspace: plan.make_workspace()?, plan, stage1: Stack::zeros(planes, size) })
    }
}

/// Angles of every channel from its Stokes images.
fn to_angles(polar: &polarization::Plan, stokes: &Stack<f32>, angles: &mut Stack<f32>, channels: usize) {
    let (n, p) = (stokes.size().pixels(), angles.count() / channels);
    let pairs = stokes.as_slice().chunks_exact(3 * n).zip(angles.as_mut_slice().chunks_exact_mut(p * n));
    pairs.for_each(|(stokes, angles)| polar.to_angles(stokes, angles, n));
}
