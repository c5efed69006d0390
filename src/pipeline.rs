//! L3: the only place where stages meet. Frames → prepare → recon → polar → [`Polarization`].
//!
//! [`Pipeline::plan`] proves all shapes, sums the bytes of every stage and refuses what does not fit the memory limit;
//! [`Pipeline::process`] then works in those buffers.
//!
//! Allocation: `plan` allocates, `process` does not, with two exceptions. For the first guide that proves useless S0 has to be solved
//! for; that solver is kept beside the first if the memory limit allows for both, else they take turns. And where the PSF proves to be
//! larger or smaller than when it was calibrated, what was made of it at the start is made again.
//! Imports: all stages.

use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::calibration::Calibration;
use crate::fusion;
use crate::optics::{Coarse, FftBackend, LengthError, Psf, StokesOperator};
use crate::parallel::Workers;
use crate::plane::{Angle, Size, Stack};
use crate::prepare::{self, Agreement, PrepareError, PsfSize, Quality, Unit};
use crate::recon::{self, Course, Divergence, Method, Modelled};
use crate::{output, polar};

/// What a user may choose.
#[derive(Clone, Debug)]
pub struct Settings {
    /// The method; none takes `guided` with a guide and `stokes` without.
    pub method: Option<Method>,
    /// Iterations; none takes the method's usual number.
    pub iterations: Option<usize>,
    /// Whether the guide of every frame is aligned with it. If not, it is once stage II finds its detail in another place.
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
    pub fusion: Option<fusion::Network>,
    /// Whether frames follow each other as in a video: each may then go on from the result of the last one, and its guide is
    /// followed rather than searched for.
    pub video: bool,
    /// Whether results hold the intensities behind polarizers, beside the Stokes images that they follow from.
    pub angles: bool,
}

/// Iterations when none are asked for.
const ITERATIONS: [(Method, usize); 6] = [
    (Method::Guided, 20),
    (Method::Stokes, 60),
    (Method::Fista, 300),
    (Method::FistaPublished, 500),
    (Method::Admm, 200),
    (Method::AdmmPublished, 200),
];

/// Pixels whose S0 lies below this fraction of the frame's peak reading carry no usable polarization.
const DARK: f32 = 0.02;
/// Shares of untrusted readings that a user is told about.
const WARN_SHARE: f32 = 0.001;

/// Pixels by which the readings may have the guide's detail in another place than a guide that is not aligned.
const MISPLACED: f64 = 0.5;

/// Uncertainty of the guide's position that a user is told about, in pixels.
const WARN_SHIFT: f32 = 1.0;

/// Times that the PSF's size is refitted for one frame, at most.
const REFITS: usize = 3;
/// Largest change of the PSF's size that is followed: beyond, it is another diffuser, or at another place.
const LARGEST_GROWTH: f64 = 0.06;

/// Why a pipeline cannot be planned.
#[derive(Debug, thiserror::Error)]
pub enum PlanError {
    /// The frame is too large for the FFT backend.
    #[error(transparent)]
    Length(#[from] LengthError),
    /// The solver cannot work with this camera.
    #[error(transparent)]
    Recon(#[from] recon::PlanError),
    /// The fusion model cannot be run.
    #[error(transparent)]
    Fusion(#[from] fusion::PlanError),
    /// A guided method without a guide.
    #[error(
        "method guided needs a guide frame; allowed without one: stokes, fista, fista-published, admm, admm-published"
    )]
    NoGuide,
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

/// What there is to say of one frame.
#[derive(Clone, Debug)]
pub struct FrameReport {
    /// The method that ran.
    pub method: Method,
    /// Its iterations.
    pub iterations: usize,
    /// What was solved for.
    pub modelled: Modelled,
    /// Why just that.
    pub why: &'static str,
    /// How the frame was solved beside the last one.
    pub course: Course,
    /// Frames whose readings were averaged.
    pub averaged: usize,
    /// Residual A·x − y, root mean square, fractions of full scale; of averaged readings where frames were averaged.
    pub residual_rms: f32,
    /// Shift of the guide against the frame that was undone, in pixels: right, down.
    pub shift_px: [f32; 2],
    /// How many times as large as calibrated the PSF was taken for.
    pub psf_scale: f32,
    /// Sensor units per guide unit, one for each channel; empty without a guide. Of fixed capacity, so that no frame allocates.
    pub gain: heapless::Vec<f32, 3>,
    /// Mean DoLP of the valid pixels; none without a mask or valid pixels.
    pub mean_dolp: Option<f32>,
    /// Share of valid pixels.
    pub valid_fraction: f32,
    /// Time of prepare, registration apart.
    pub prepare: Duration,
    /// Time of aligning the guide.
    pub register: Duration,
    /// Time of the solver.
    pub recon: Duration,
    /// What the fusion model did; none without one.
    pub fusion: Option<fusion::Report>,
    /// Its time.
    pub fusion_time: Duration,
    /// What a user should know before trusting the result.
    pub warnings: Vec<String>,
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
    prepare: prepare::Plan,
    prepared: prepare::Workspace,
    solver: Solver,
    /// The solver of another method, for the next frame that needs it.
    spare: Option<Solver>,
    fusion: Option<Fusion>,
    fused: bool,
    polar: polar::Plan,
    angles: Vec<Angle>,
    /// Noise of the readings by the bundle, where no solver measures it.
    noise: f32,
    result: Polarization,
    /// The bundle's.
    digest: String,
}

/// What came of a frame.
struct Attempt {
    summary: prepare::Summary,
    outcome: recon::Outcome,
    step: recon::Step,
    fusion: Option<fusion::Report>,
    warnings: Vec<String>,
    /// Times; that of aligning is in the summary.
    prepare: Duration,
    recon: Duration,
    fusion_time: Duration,
}

#[derive(Debug)]
struct Fusion {
    plan: fusion::Plan,
    workspace: fusion::Workspace,
    /// Angles of stage I alone, `[C, P, H, W]`.
    stage1: Stack<f32>,
}

#[derive(Debug)]
struct Solver {
    plan: recon::Plan,
    iterations: usize,
    workspace: recon::Workspace,
    /// Of the last frame of a video.
    last: Option<recon::Continuation>,
    /// Result of an angle method, before polar; a Stokes method writes into the result itself.
    output: Option<Stack<f32>>,
}

impl Pipeline {
    /// Plans all stages for one camera, with or without a guide. Allocates.
    ///
    /// # Errors
    /// [`PlanError`], naming stage, need and limit.
    pub fn plan(calibration: &Calibration, guide: bool, settings: &Settings) -> Result<Self, PlanError> {
        let method = settings.method.unwrap_or(if guide { Method::Guided } else { Method::Stokes });
        if method == Method::Guided && !guide {
            return Err(PlanError::NoGuide);
        }
        let workers = Arc::new(Workers::new(settings.threads));
        let channels = calibration.sensor.channels;
        let operators =
            StokesOperator::for_channels(&calibration.psf, &calibration.response, channels, settings.fft, workers)?;
        let size = calibration.sensor.size;
        let angles = calibration.response.angles().to_vec();
        let guided = method == Method::Guided;
        let beside = if guided && !angles.is_empty() { slow_modes(&operators) } else { Vec::new() };
        let aligned = if settings.register { prepare::Guide::Aligned } else { prepare::Guide::Placed };
        let treated = if guided { aligned } else { prepare::Guide::Shown };
        let prepare = prepare::Plan::new(calibration, &operators, &beside, treated);
        let coarse = polarized_modes(&beside);
        let planes = if angles.is_empty() { 1 } else { 3 };
        let intensities = if settings.angles { angles.len() } else { 0 };
        let image = size_of::<f32>() * channels * size.pixels();
        let psfs = calibration.psf.count();
        // What the equations beside the guide hold beyond those that the solver counts.
        let beyond = distinct_bytes(&beside).saturating_sub(distinct_bytes(&coarse));
        let psf = (guided && settings.refit_psf).then(|| calibration.psf.clone());
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
        let stage2 = network.map(|network| fusion::Plan::new(network, &operators)).transpose()?;
        let placed = guided && !settings.register;
        let stage2 = stage2.map(|plan| if placed { plan.for_guides_as_they_lie() } else { plan });
        let bytes = |plan: &fusion::Plan| plan.bytes() + plan.workspace_bytes() + angles.len() * image;
        fixed.extend(stage2.iter().map(|plan| ("fusion", bytes(plan))));
        let norms: Vec<f32> = if method == Method::Fista && !angles.is_empty() {
            let norm =
                |c: usize| calibration.cached_norm(&format!("angles {c}"), || recon::norm_squared(&operators[c]));
            (0..channels).map(|c| norm(c.min(calibration.psf.count() - 1))).collect()
        } else {
            Vec::new()
        };
        let solver = Solver::plan(&operators, &coarse, &norms, method, settings, &fixed)?;
        Ok(Self {
            settings: settings.clone(),
            method,
            prepared,
            prepare,
            solver,
            spare: None,
            fusion: stage2.map(|plan| Fusion::new(plan, channels * angles.len(), size)).transpose()?,
            fused: true,
            polar: polar::Plan::new(&angles),
            result: Polarization {
                stokes: Stack::zeros(channels * planes, size),
                angles: (intensities > 0).then(|| Stack::zeros(channels * intensities, size)),
                valid: vec![false; size.pixels()],
            },
            angles,
            noise: calibration.noise.read,
            operators,
            beside,
            psf,
            psf_scale: 1.0,
            fixed,
            digest: calibration.digest.clone(),
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
    pub fn fusion(&self) -> Option<&fusion::Plan> {
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
        let n = iterations.max(1);
        self.settings.iterations = Some(n);
        self.solver.iterations = n;
        self.solver.plan.set_iterations(n);
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

    /// Processes one frame; the images are in [`Self::result`].
    ///
    /// # Errors
    /// [`ProcessError`]; the result is then that of no frame.
    pub fn process(
        &mut self,
        raw: &Stack<f32>,
        unit: Unit,
        guide: Option<&Stack<f32>>,
    ) -> Result<FrameReport, ProcessError> {
        let mut found = self.attempt(raw, unit, guide)?;
        if found.fusion.and_then(|report| report.detail_shift_px).is_some_and(|[x, y]| x.hypot(y) > MISPLACED) {
            self.align_guides();
            let before = std::mem::replace(&mut found, self.attempt(raw, unit, guide)?);
            found.prepare += before.prepare;
            found.summary.register += before.summary.register;
            found.recon += before.recon;
            found.fusion_time += before.fusion_time;
        }
        let Attempt { summary, outcome, step, fusion, warnings, prepare, recon, fusion_time } = found;
        self.mark_valid(&summary.quality);
        let channels = raw.count();
        let valid = &self.result.valid;
        let count = valid.iter().filter(|v| **v).count();
        Ok(FrameReport {
            method: self.solver.plan.method(),
            iterations: if outcome.modelled == Modelled::Nothing { 0 } else { step.iterations },
            modelled: outcome.modelled,
            why: self.why(outcome.modelled, guide.is_some(), &summary),
            course: step.course,
            averaged: step.averaged,
            residual_rms: outcome.residual_rms,
            gain: summary.gain.iter().flat_map(|g| (0..channels).map(|c| g[c] * outcome.gain[c])).collect(),
            mean_dolp: (!self.angles.is_empty())
                .then(|| polar::mean_dolp(self.result.stokes.as_slice(), valid))
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
        })
    }

    /// One frame from readings to the result.
    fn attempt(&mut self, raw: &Stack<f32>, unit: Unit, guide: Option<&Stack<f32>>) -> Result<Attempt, ProcessError> {
        let start = Instant::now();
        if !self.settings.video {
            self.prepared.forget();
        }
        let mut warnings = Vec::new();
        let summary = self.prepare(raw, unit, guide, &mut warnings)?;
        let prepare = start.elapsed().saturating_sub(summary.register);
        warnings.extend(quality_warnings(&summary.quality));
        let mut method = self.method;
        if method == Method::Guided && summary.gain.is_none() {
            let why = if guide.is_some() { "the guide explains nothing of the raw frame" } else { "no guide frame" };
            warnings.push(format!("{why}: S0 was solved for without it"));
            method = Method::Stokes;
        }
        if let Some(agreement) = summary.agreement {
            warnings.extend(agreement_warnings(&agreement));
            if agreement.foreign {
                method = Method::Stokes;
            }
        }
        match self.take_turns(method) {
            Err(PlanError::Memory { total, limit, .. }) if summary.gain.is_some() => warnings.push(format!(
                "solving for S0 needs {total} bytes, the limit is {limit}: the guide was taken in spite of that"
            )),
            outcome => outcome?,
        }
        let start = Instant::now();
        let channels = raw.count();
        let input = recon::Input {
            raw: &self.prepared.raw,
            weight: &self.prepared.weight,
            guide: summary.gain.is_some().then_some(&self.prepared.guide),
        };
        let Solver { plan, workspace, output, last, iterations } = &mut self.solver;
        let output = output.as_mut().unwrap_or(&mut self.result.stokes);
        let (outcome, step) = match last {
            Some(last) => plan.run_next(&input, output, workspace, last)?,
            None => {
                let step = recon::Step { course: Course::Cold, iterations: *iterations, averaged: 1 };
                (plan.run(&input, output, workspace)?, step)
            }
        };
        let recon = start.elapsed();
        self.complete(channels);
        let start = Instant::now();
        let fusion = self.refine(outcome.sigma.unwrap_or(self.noise), channels);
        Ok(Attempt { summary, outcome, step, fusion, warnings, prepare, recon, fusion_time: start.elapsed() })
    }

    /// Readings and guide made what the solver takes, and the PSF the size that they tell.
    fn prepare(
        &mut self,
        raw: &Stack<f32>,
        unit: Unit,
        guide: Option<&Stack<f32>>,
        warnings: &mut Vec<String>,
    ) -> Result<prepare::Summary, ProcessError> {
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

    /// Aligns guides from now on.
    fn align_guides(&mut self) {
        tracing::info!("stage II finds the guide's detail in another place: guides are aligned from now on");
        self.prepare.align_guides();
        self.prepared.forget();
        self.solver.last.iter_mut().for_each(recon::Continuation::forget);
        self.fusion.iter_mut().for_each(|fusion| fusion.plan.take_aligned_guides(&mut fusion.workspace));
    }

    /// Why that was solved for, for people.
    fn why(&self, modelled: Modelled, guided: bool, summary: &prepare::Summary) -> &'static str {
        match modelled {
            Modelled::Nothing => "the guide gives s0, and the readings show no polarization above their noise",
            Modelled::Polarized => "the guide gives s0",
            Modelled::Shared => "the guide gives s0, and the colours share one polarization",
            Modelled::Intensity if guided => "no mask; s0 looks like the guide",
            Modelled::Intensity => "no mask and no guide",
            Modelled::Angles => "the method asked for",
            Modelled::Both if !guided => "no guide",
            Modelled::Both if self.method == Method::Stokes => "the method asked for",
            Modelled::Both if summary.gain.is_none() => "the guide explains nothing of the raw frame",
            Modelled::Both => "the guide is of another scene",
        }
    }

    /// Takes the PSF for `growth` times as large as until now, and all that was made of it anew; why not, for people, where that cannot be.
    /// Allocates.
    fn refit_psf(&mut self, growth: f64) -> Result<Option<String>, PlanError> {
        let Some(psf) = &self.psf else { return Ok(None) };
        let scale = self.psf_scale * growth;
        let found = format!(
            "the psf seems to be {:.1} % {} than when it was calibrated",
            100.0 * (scale - 1.0).abs(),
            if scale > 1.0 { "larger" } else { "smaller" }
        );
        if (scale - 1.0).abs() > LARGEST_GROWTH {
            let largest = 100.0 * LARGEST_GROWTH;
            return Ok(Some(format!("{found}, more than the {largest:.0} % that are followed: calibrate anew")));
        }
        let again = self.operators[0].kernel.bytes() * psf.count()
            + distinct_bytes(&self.beside)
            + self.operators[0].convolver.scratch_bytes()
            + Coarse::planning_bytes(self.size());
        let total = again + self.stages().map(|(_, bytes)| bytes).sum::<usize>();
        let limit = self.settings.memory_limit_bytes;
        if total > limit {
            return Ok(Some(format!(
                "{found}; following it needs {total} bytes, the limit is {limit}: calibrate anew"
            )));
        }
        tracing::info!("{found}: refitted");
        let operators = self.operators[0].behind(&psf.scaled(scale), self.operators.len());
        let beside = if self.beside.is_empty() { Vec::new() } else { slow_modes(&operators) };
        self.prepare.set_optics(&operators, &beside);
        self.prepared.forget();
        self.spare = None;
        let Solver { plan, iterations, last, .. } = &mut self.solver;
        let (method, iterations) = (plan.method(), *iterations);
        *plan = recon::Plan::new(&recon::Spec {
            method,
            iterations,
            operators: &operators,
            coarse: &polarized_modes(&beside),
            norms: &[],
        })?;
        last.iter_mut().for_each(recon::Continuation::forget);
        self.fusion.iter_mut().for_each(|fusion| fusion.plan.set_optics(&operators));
        (self.operators, self.beside, self.psf_scale) = (operators, beside, scale);
        Ok(None)
    }

    /// Makes the solver of `method` the present one. Allocates the first time, and again whenever both do not fit.
    fn take_turns(&mut self, method: Method) -> Result<(), PlanError> {
        if method == self.solver.plan.method() {
            return Ok(());
        }
        if let Some(spare) = self.spare.as_mut().filter(|s| s.plan.method() == method) {
            std::mem::swap(&mut self.solver, spare);
            return Ok(());
        }
        let plan = |fixed: &[(&'static str, usize)]| {
            Solver::plan(&self.operators, &polarized_modes(&self.beside), &[], method, &self.settings, fixed)
        };
        let present = self.solver.bytes() + self.solver.plan.bytes();
        let mut both = self.fixed.to_vec();
        both.push(("recon, present", present));
        match plan(&both) {
            Ok(new) => self.spare = Some(std::mem::replace(&mut self.solver, new)),
            Err(PlanError::Memory { .. }) => self.solver = plan(&self.fixed)?,
            Err(other) => return Err(other),
        }
        Ok(())
    }

    /// Whether stage II is run from now on, where there is one.
    pub fn set_fused(&mut self, fused: bool) {
        self.fused = fused;
    }

    /// Stage II, with the readings' noise `sigma`; stage I stays beside it.
    fn refine(&mut self, sigma: f32, channels: usize) -> Option<fusion::Report> {
        let Fusion { plan, workspace, stage1 } = self.fusion.as_mut()?;
        let Polarization { stokes, angles, .. } = &mut self.result;
        match &self.solver.output {
            Some(solved) => stage1.as_mut_slice().copy_from_slice(solved.as_slice()),
            None => to_angles(&self.polar, stokes, stage1, channels),
        }
        if !self.fused {
            return None;
        }
        let input = fusion::Input { raw: &self.prepared.raw, weight: &self.prepared.weight, sigma };
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
    fn new(plan: fusion::Plan, planes: usize, size: Size) -> Result<Self, PlanError> {
        Ok(Self { workspace: plan.make_workspace()?, plan, stage1: Stack::zeros(planes, size) })
    }
}

/// Angles of every channel from its Stokes images.
fn to_angles(polar: &polar::Plan, stokes: &Stack<f32>, angles: &mut Stack<f32>, channels: usize) {
    let (n, p) = (stokes.size().pixels(), angles.count() / channels);
    let pairs = stokes.as_slice().chunks_exact(3 * n).zip(angles.as_mut_slice().chunks_exact_mut(p * n));
    pairs.for_each(|(stokes, angles)| polar.to_angles(stokes, angles, n));
}

/// The slow modes beside a guide of each operator; channels that share a PSF share them. Allocates.
fn slow_modes(operators: &[StokesOperator]) -> Vec<Arc<Coarse>> {
    let mut all: Vec<Arc<Coarse>> = Vec::with_capacity(operators.len());
    for (c, operator) in operators.iter().enumerate() {
        let same = operators[..c].iter().position(|o| Arc::ptr_eq(&o.kernel, &operator.kernel));
        all.push(same.map_or_else(|| Arc::new(Coarse::beside_guide(operator)), |i| Arc::clone(&all[i])));
    }
    all
}

/// What they hold, shared ones counted once.
fn distinct_bytes(modes: &[Arc<Coarse>]) -> usize {
    let shared = |c: usize| modes[..c].iter().any(|earlier| Arc::ptr_eq(earlier, &modes[c]));
    (0..modes.len()).filter(|c| !shared(*c)).map(|c| modes[c].bytes()).sum()
}

/// Those of the polarized part alone, shared in the same way.
fn polarized_modes(beside: &[Arc<Coarse>]) -> Vec<Arc<Coarse>> {
    let mut all: Vec<Arc<Coarse>> = Vec::with_capacity(beside.len());
    for (c, coarse) in beside.iter().enumerate() {
        let same = beside[..c].iter().position(|b| Arc::ptr_eq(b, coarse));
        all.push(same.map_or_else(|| Arc::new(coarse.leading(2)), |i| Arc::clone(&all[i])));
    }
    all
}

impl Solver {
    /// Bytes of the workspace, and of what is kept of a video's last frame.
    fn bytes(&self) -> usize {
        self.plan.workspace_bytes() + self.last.as_ref().map_or(0, |_| self.plan.continuation_bytes())
    }

    /// Plans and allocates a method, if it fits beside the `fixed` stages.
    fn plan(
        operators: &[StokesOperator],
        coarse: &[Arc<Coarse>],
        norms: &[f32],
        method: Method,
        settings: &Settings,
        fixed: &[(&'static str, usize)],
    ) -> Result<Self, PlanError> {
        let usual = ITERATIONS.iter().find(|(m, _)| *m == method).map_or(1, |(_, n)| *n);
        let iterations = settings.iterations.unwrap_or(usual);
        let plan = recon::Plan::new(&recon::Spec { method, iterations, operators, coarse, norms })?;
        let kept = if settings.video { plan.continuation_bytes() } else { 0 };
        let stages: Vec<_> =
            fixed.iter().copied().chain([("recon", plan.workspace_bytes() + plan.bytes() + kept)]).collect();
        let total = stages.iter().map(|(_, bytes)| bytes).sum();
        if total > settings.memory_limit_bytes {
            return Err(PlanError::Memory { stages, total, limit: settings.memory_limit_bytes });
        }
        let size = operators[0].convolver.size();
        let output = method.solves_angles().then(|| Stack::zeros(operators.len() * plan.planes(), size));
        let last = settings.video.then(|| plan.make_continuation());
        Ok(Self { workspace: plan.make_workspace(), last, plan, iterations, output })
    }
}

fn agreement_warnings(a: &Agreement) -> Option<String> {
    if a.foreign {
        let percent = 100.0 * a.detail;
        return Some(format!(
            "the guide shows another scene or nothing of this one (its detail is found in the raw frame with {percent:.0} % of its \
             brightness): S0 was solved for without it"
        ));
    }
    (a.uncertainty > WARN_SHIFT)
        .then(|| format!("the guide's position is only known to ±{:.1} px: the scene has little detail", a.uncertainty))
}

fn quality_warnings(q: &Quality) -> Vec<String> {
    let mut warnings = Vec::new();
    let percent = |share: f32| 100.0 * share;
    if q.saturated > WARN_SHARE {
        warnings.push(format!("{:.1} % of the raw readings are saturated and were ignored", percent(q.saturated)));
    }
    if q.not_finite > 0.0 {
        warnings
            .push(format!("{:.3} % of the raw readings are NaN or infinite and were ignored", percent(q.not_finite)));
    }
    if q.defective > 0.0 {
        warnings.push(format!(
            "{:.3} % of the raw readings are far from all around them (dead or hot pixels) and were ignored",
            percent(q.defective)
        ));
    }
    if q.peak <= 0.0 {
        warnings.push("the raw frame is dark: no reading is above black".to_owned());
    } else if q.peak - q.floor <= 1e-6 * q.peak.abs() {
        warnings.push(format!("the raw frame is blank: every reading is {:.4}", q.peak));
    }
    warnings
}

impl Pipeline {
    /// What `report.json` says of the latest frame, which took `load` to read and `total` altogether.
    pub fn report(&self, frame: &FrameReport, load: Duration, total: Duration) -> output::Report {
        output::Report {
            method: frame.method.to_string(),
            iterations: frame.iterations,
            modelled: output::Modelled { unknowns: frame.modelled.unknowns(), why: frame.why },
            course: frame.course.to_string(),
            averaged: frame.averaged,
            size: [self.size().width, self.size().height],
            seconds: output::Seconds {
                load: load.as_secs_f64(),
                prepare: frame.prepare.as_secs_f64(),
                register: frame.register.as_secs_f64(),
                recon: frame.recon.as_secs_f64(),
                fusion: frame.fusion_time.as_secs_f64(),
                total: total.as_secs_f64(),
            },
            residual_rms: f64::from(frame.residual_rms),
            gain: frame.gain.iter().copied().map(f64::from).collect(),
            shift_px: frame.shift_px.map(f64::from),
            psf_scale: f64::from(frame.psf_scale),
            mean_dolp: frame.mean_dolp.map(f64::from),
            valid_fraction: f64::from(frame.valid_fraction),
            workspace_bytes: self.workspace_bytes(),
            peak_rss_bytes: output::peak_rss_bytes(),
            calibration: self.digest.clone(),
            model: self.fusion.as_ref().map(|f| f.plan.network().model().name.clone()),
            fusion: self.fusion.as_ref().zip(frame.fusion).map(|(f, r)| output::Fusion {
                result: if r.is_learned() { "learned" } else { "physics" },
                precision: f.plan.network().precision().to_string(),
                tiles: r.tiles,
                run: r.run,
                kept: r.kept,
                quiet: r.quiet,
                refused: r.refused,
                detail_shift_px: r.detail_shift_px,
            }),
            warnings: frame.warnings.clone(),
        }
    }

    /// The latest result as [`output`] writes it.
    pub fn images(&self) -> output::ResultImages<'_> {
        output::ResultImages {
            size: self.size(),
            channels: self.prepared.raw.count(),
            angles: self.result.angles.as_ref(),
            angle_list: &self.angles,
            stokes: &self.result.stokes,
            valid: &self.result.valid,
            stage1: self.stage1(),
        }
    }
}
