//! The pipeline: one raw frame and its guide become [`Polarization`]. This is the only place where the stages meet:
//! `guide` and [`readings`], [`solve`], [`refine`], [`polarization`].
//!
//! [`Pipeline::new`] proves all shapes, sums the bytes of every stage and refuses what exceeds the memory limit. [`Pipeline::process`]
//! then works in the buffers made there.
//!
//! Allocation: `new` allocates, `process` does not, with three exceptions. A frame whose guide is useless needs a solver for S0; it is
//! kept beside the first one if the memory limit allows for both, else the two replace each other. A PSF whose size has changed since its
//! calibration is scaled, and everything computed from it is computed again. An image that is not planar single precision is copied into a
//! buffer, which is allocated once.

mod reconstruction;
mod refit;
mod report;
mod solver;
mod warning;

use std::num::NonZeroUsize;
use std::sync::Arc;
use std::time::{Duration, Instant};

pub use crate::guide::PrepareError;
use reconstruction::Reconstruction;
pub use report::{Field, FrameReport, Notice};
use solver::check_memory;
pub use warning::Warning;

use crate::device::Device;
use crate::diagnose::{self, Figures, Suspect};
use crate::guide::{self, PsfSize};
use crate::image::{Buffers, ImageView, Planes, Size, Stack};
use crate::optics::{self, FftBackend, LengthError, Margin};
use crate::parallel::Workers;
use crate::polarization;
use crate::polarization::Angle;
use crate::readings::{self, Binned, Binning, Readings, ReadingsError, Unit};
use crate::refine;
use crate::solve::{self, Divergence, Method};
use crate::uncertainty;

/// Choices of a user that hold for all frames.
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
    /// Whether the size of the PSF is refitted when the readings show that it has changed since the calibration. Needs a guide.
    pub refit_psf: bool,
    /// The FFT library.
    pub fft: FftBackend,
    /// Threads of the solver.
    pub threads: usize,
    /// Bytes all stages together may hold.
    pub memory_limit_bytes: usize,
    /// The network of stage II; none is physics only.
    pub fusion: Option<refine::Network>,
    /// Whether frames are those of a video. Each may then start from the result of the last one, and its guide is tracked rather than
    /// searched for. If not, the result of a frame does not depend on the frames before it.
    pub video: bool,
    /// Whether results hold the intensities behind polarizers in addition to the Stokes images.
    pub angles: bool,
}

/// Effort for one frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Budget {
    /// Iterations of the solver; none takes those of the settings.
    pub iterations: Option<NonZeroUsize>,
    /// Whether stage II runs, where there is a network.
    pub refine: bool,
}

impl Default for Budget {
    /// The iterations of the settings, and stage II.
    fn default() -> Self {
        Self { iterations: None, refine: true }
    }
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

/// Share of the mean reading to which a model of a camera is exact, whatever the noise.
const EXACT: f32 = 0.002;

/// Times that the PSF's size is refitted for one frame, at most.
const REFITS: usize = 3;

/// Frames in which light from beyond is not looked for after it was found to be none.
const QUIET: usize = 64;

/// A pipeline that cannot be planned.
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

/// A frame that cannot be processed.
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
    /// Standard errors, shaped like `stokes`: σ of each of its values. Fractions of full scale.
    pub errors: Stack<f32>,
    /// `[C, P, H, W]`: intensities behind ideal polarizers; none without a mask, or where [`Settings::angles`] does without.
    pub angles: Option<Stack<f32>>,
    /// For each pixel whether it can be trusted: it is not dark, and its reading has weight.
    pub valid: Vec<bool>,
}

impl Polarization {
    /// Images of `channels` channels and `angles` polarizer angles, none without a mask. Allocates.
    fn zeros(channels: usize, size: Size, angles: usize, with_angles: bool) -> Self {
        let planes = if angles == 0 { 1 } else { 3 };
        Self {
            stokes: Stack::zeros(channels * planes, size),
            errors: Stack::zeros(channels * planes, size),
            angles: (with_angles && angles > 0).then(|| Stack::zeros(channels * angles, size)),
            valid: vec![false; size.pixels()],
        }
    }

    /// Bytes held.
    fn bytes(&self) -> usize {
        self.stokes.bytes() + self.errors.bytes() + self.angles.as_ref().map_or(0, Stack::bytes) + self.valid.len()
    }
}

/// A planned pipeline with all its buffers.
#[derive(Debug)]
pub struct Pipeline {
    settings: Settings,
    device: Device,
    workers: Arc<Workers>,
    /// Method of the settings. For a frame without a usable guide the solver has another one.
    method: Method,
    normalization: readings::Plan,
    readings: Readings,
    /// Preparation and solver of the present field; then those of the frame alone or of the frame with its margin, whichever is not the
    /// present one, once both were needed and where the memory limit allows for both.
    fields: Vec<Reconstruction>,
    /// Frames for which light from beyond the frame is not looked for.
    quiet: usize,
    /// Whether a frame has told about light from beyond it.
    told: bool,
    /// Bytes of the stages that do not depend on the field.
    fixed: Vec<(&'static str, usize)>,
    /// Of frames of the camera's size; none where every reading is used by itself.
    binning: Option<Binning>,
    fusion: Option<Fusion>,
    polarization: polarization::Plan,
    angles: Vec<Angle>,
    result: Polarization,
    uncertainty: uncertainty::Workspace,
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
    /// A raw frame of the camera's size.
    binned: Binned,
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

    /// Facts to know before trusting the result.
    pub fn warnings(&self) -> &[Warning] {
        &self.report.warnings
    }

    /// S0, S1, S2 of each channel, `[C, 3, H, W]`; without a mask S0 alone, `[C, 1, H, W]`. Fractions of full scale.
    pub fn stokes(&self) -> &'a Stack<f32> {
        &self.pipeline.result.stokes
    }

    /// Standard errors, shaped like [`Self::stokes`]: σ of each of its values.
    pub fn errors(&self) -> &'a Stack<f32> {
        &self.pipeline.result.errors
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

/// A solved frame: facts for its report. The images are in the pipeline's result.
struct SolvedFrame {
    summary: guide::Summary,
    outcome: solve::Outcome,
    light_from_beyond: f32,
    fusion: Option<refine::Report>,
    warnings: Vec<Warning>,
    /// Time of preparation without the alignment of the guide, which is in the summary.
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
        let method = settings.method.unwrap_or(if settings.guided { Method::Guided } else { Method::Stokes });
        let guided = method == Method::Guided;
        if guided && !settings.guided {
            return Err(PlanError::NoGuide);
        }
        let workers = Arc::new(Workers::new(settings.threads));
        let (size, channels) = (device.sensor.size, device.sensor.channels);
        let binning = Binning::new(device, Arc::clone(&workers));
        let angles = device.response.angles().to_vec();
        let normalization = readings::Plan::new(device);
        let result = Polarization::zeros(channels, size, angles.len(), settings.angles);
        let readings = |buffers: &mut Buffers| normalization.readings(buffers);
        let uncertainty = |buffers: &mut Buffers| uncertainty::Workspace::new(buffers, size);
        let mut fixed = vec![
            ("device", device.bytes()),
            ("readings", Buffers::bytes(readings)),
            ("result", result.bytes()),
            ("errors", Buffers::bytes(uncertainty)),
        ];
        fixed.extend(binning.as_ref().map(|binning| ("binning", binning.bytes())));
        // The reference methods have no way to tell whether light comes from beyond the frame.
        let frame_alone = if method.solves_angles() { device.margin } else { Margin::default() };
        let plan = |margin| {
            let with = (&settings, Arc::clone(&workers));
            Reconstruction::new(device, (&device.psf, 1.0), margin, method, with, &fixed)
        };
        // Most scenes go on beyond the frame, so a video begins with a field that does.
        let first = if guided && settings.video { device.margin } else { frame_alone };
        let now = match plan(first) {
            Err(PlanError::Memory { .. }) if !first.is_none() => plan(frame_alone)?,
            planned => planned?,
        };
        // Without a mask there is no polarization to refine.
        let network = settings.fusion.as_ref().filter(|_| !angles.is_empty());
        let operators = now.frame_operators(device, &settings, &workers)?;
        let stage2 = network.map(|network| refine::Plan::new(network, &operators)).transpose()?;
        let planes = channels * angles.len();
        let pedestal = Some(device.psf.pedestal()).filter(|share| *share > 0.0);
        let notices = pedestal.map(|share| Notice::PsfPedestal { share }).into_iter().collect();
        fixed.extend(stage2.iter().map(|plan| ("fusion", Fusion::bytes(plan, planes, size))));
        check_memory(fixed.iter().copied().chain(now.stages()), settings.memory_limit_bytes)?;
        Ok(Self {
            method,
            readings: Buffers::allocate(readings),
            normalization,
            binning,
            fields: vec![now],
            quiet: 0,
            told: first == frame_alone,
            fusion: stage2.map(|plan| Fusion::new(plan, planes, size)).transpose()?,
            polarization: polarization::Plan::new(&angles),
            result,
            uncertainty: Buffers::allocate(uncertainty),
            angles,
            device: device.clone(),
            workers,
            settings,
            notices,
            copies: Copies::default(),
            fixed,
        })
    }

    /// Adds stage II where it fits into `limit` bytes beside all other stages, modelling of light from beyond the frame included. Otherwise
    /// the pipeline stays as it is. The pipeline keeps to the lower one of `limit` and its memory limit from then on. Allocates.
    ///
    /// # Errors
    /// [`PlanError::Memory`] where it does not fit, or why the network cannot be run.
    ///
    /// # Panics
    /// For a pipeline that has a stage II, and for a device without a mask: there is no polarization to refine.
    pub fn add_fusion(&mut self, network: &refine::Network, limit: usize) -> Result<(), PlanError> {
        assert!(self.fusion.is_none(), "there is a stage II already");
        let operators = self.fields[0].frame_operators(&self.device, &self.settings, &self.workers)?;
        let plan = refine::Plan::new(network, &operators)?;
        let (planes, size) = (self.device.sensor.channels * self.angles.len(), self.size());
        let stage = ("fusion", Fusion::bytes(&plan, planes, size));
        let beside = [stage, ("the other field", self.field_bytes())];
        let limit = limit.min(self.settings.memory_limit_bytes);
        check_memory(self.stages().chain(beside), limit)?;
        self.fusion = Some(Fusion::new(plan, planes, size)?);
        self.fixed.push(stage);
        self.settings.fusion = Some(network.clone());
        self.settings.memory_limit_bytes = limit;
        Ok(())
    }

    /// Bytes that modelling light from beyond the frame takes beside the stages, from the first frame on that shows such light; an
    /// estimate from the field's area. Zero for a device whose scene ends at the frame, for the methods that do not model it, and where it
    /// is modelled already.
    pub fn field_bytes(&self) -> usize {
        let modelled = self.method.solves_angles() || !self.fields[0].field().margin().is_none();
        if modelled { 0 } else { self.bytes_on_field(self.device.margin) }
    }

    /// Bytes of preparation and solver on a field with this margin, estimated from its area; zero without another field.
    fn bytes_on_field(&self, margin: Margin) -> usize {
        let field = optics::Field::new(self.size(), margin);
        if field == self.fields[0].field() {
            return 0;
        }
        (self.fields[0].bytes() as f64 * field.size().pixels() as f64 / self.fields[0].field().size().pixels() as f64)
            as usize
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

    /// The settings, with the network of stage II if one was added.
    pub fn settings(&self) -> &Settings {
        &self.settings
    }

    /// Stage II, where there is one.
    pub fn fusion(&self) -> Option<&refine::Plan> {
        self.fusion.as_ref().map(|f| &f.plan)
    }

    /// Angles of stage I alone, of the latest frame, `[C, P, H, W]`; none without a fusion model.
    pub fn stage1(&self) -> Option<&Stack<f32>> {
        self.fusion.as_ref().map(|f| &f.stage1)
    }

    /// Bytes of the workspaces of preparation, solver and stage II, and of the state kept between frames of a video.
    pub fn workspace_bytes(&self) -> usize {
        let fusion = self.fusion.as_ref().map_or(0, |f| f.plan.workspace_bytes());
        self.fields.iter().map(Reconstruction::workspace_bytes).sum::<usize>() + fusion
    }

    /// Bytes of every stage.
    pub fn stages(&self) -> impl Iterator<Item = (&'static str, usize)> {
        let other = self.fields.get(1).map(|other| ("the other field", other.bytes()));
        self.fixed.iter().copied().chain(self.fields[0].stages()).chain(other)
    }

    /// The shortest iteration of the latest frame, of a guided method.
    pub fn shortest_iteration(&self) -> Option<Duration> {
        self.fields[0].solver.workspace.shortest_iteration()
    }

    /// Parts of the solver's workspace, in bytes. Allocates.
    pub fn solver_parts(&self) -> Vec<(&'static str, usize)> {
        self.fields[0].solver.plan.workspace_parts()
    }

    /// Complex 2-D FFTs of the padded size that the solver has done so far.
    pub fn transforms(&self) -> usize {
        self.fields[0].solver.workspace.transforms()
    }

    /// The method that frames are solved with.
    pub fn method(&self) -> Method {
        self.fields[0].solver.plan.method()
    }

    /// Tries other set-ups on the latest frame, whose `guide` this is and whose report is `report`, and names those that explain its
    /// readings better, the likeliest first; without a guide what the frame's figures say. It takes about as long as the first frame's
    /// preparation. Nothing is tried where the memory limit does not allow for [`diagnose::TRIAL_BYTES`] more. Allocates.
    ///
    /// # Errors
    /// [`PlanError`] when the frame is too large for a transform.
    pub fn diagnose<'a>(
        &mut self,
        report: &FrameReport,
        guide: impl Into<Option<ImageView<'a>>>,
    ) -> Result<Vec<Suspect>, PlanError> {
        let mut suspects = Vec::new();
        let held: usize = self.stages().map(|(_, bytes)| bytes).sum();
        let fits = held + diagnose::TRIAL_BYTES <= self.settings.memory_limit_bytes;
        if let Some(guide) = guide.into().filter(|_| fits) {
            let guide = guide.to_planes(&mut self.copies.guide);
            let workers = Arc::clone(&self.workers);
            let solved = diagnose::Solved {
                shift_px: report.shift_px,
                noise: report.noise,
                explained: report.figures.explains(),
                light_modelled: !report.field.margin.is_none(),
            };
            suspects = diagnose::suspects(&self.device, &self.readings, guide, &solved, workers)?;
        }
        // A dim or clipped frame tells more than trials on it; a guide seems foreign for any other reason too.
        let (first, last): (Vec<_>, Vec<_>) =
            report.figures.suspects().partition(|s| s.fault != diagnose::Fault::ForeignGuide);
        let tried = suspects.is_empty();
        Ok(first.into_iter().chain(suspects).chain(last.into_iter().filter(|_| tried)).collect())
    }

    /// Forgets the guide of the last frame, so that the next one is searched for as that of a first frame. Allocates nothing.
    pub fn forget_guide(&mut self) {
        self.fields[0].prepared.forget();
    }

    /// The prepared readings of the latest frame `[C, H, W]`, fractions of full scale; less the light from beyond the frame, where that is
    /// modelled.
    pub fn raw(&self) -> &Stack<f32> {
        self.fields[0].raw()
    }

    /// The prepared guide of the latest frame, in sensor units.
    pub fn guide(&self) -> &Stack<f32> {
        self.fields[0].guide()
    }

    /// Processes one frame, with its guide where there is one, by the settings.
    ///
    /// # Errors
    /// As [`Self::process_within`].
    pub fn process<'a>(
        &mut self,
        raw: ImageView<'_>,
        guide: impl Into<Option<ImageView<'a>>>,
    ) -> Result<ProcessedFrame<'_>, ProcessError> {
        self.process_within(raw, guide, Budget::default())
    }

    /// Processes one frame, with its guide where there is one, within `budget`. Allocates nothing for planar images of single precision;
    /// others are copied into buffers that grow once.
    ///
    /// # Errors
    /// [`ProcessError`]; [`Self::result`] then holds no valid images.
    pub fn process_within<'a>(
        &mut self,
        raw: ImageView<'_>,
        guide: impl Into<Option<ImageView<'a>>>,
        budget: Budget,
    ) -> Result<ProcessedFrame<'_>, ProcessError> {
        let mut buffers = std::mem::take(&mut self.copies);
        let guide = guide.into();
        let raw = self.bin(raw, &mut buffers.binned)?;
        let planes = raw.to_planes(&mut buffers.raw);
        let guide = guide.map(|guide| guide.to_planes(&mut buffers.guide));
        let report = self.report(planes, raw.unit(), guide, budget);
        self.copies = buffers;
        Ok(ProcessedFrame { report: report?, pipeline: self })
    }

    /// A raw frame at the working size. A frame of the camera's size is binned into `binned`, one of the working size was so before.
    fn bin<'a>(&mut self, raw: ImageView<'a>, binned: &'a mut Binned) -> Result<ImageView<'a>, PrepareError> {
        let (channels, working) = (self.device.sensor.channels, self.size());
        let Some(binning) = self.binning.as_mut().filter(|_| (raw.planes(), raw.size()) != (channels, working)) else {
            return Ok(raw);
        };
        let size = binning.window().frame();
        if (raw.planes(), raw.size()) != (channels, size) {
            return Err(ReadingsError::Shape { found_channels: raw.planes(), found: raw.size(), channels, size }.into());
        }
        binning.image(&raw, binned);
        Ok(binned.view())
    }

    fn report(
        &mut self,
        raw: Planes<'_>,
        unit: Unit,
        guide: Option<Planes<'_>>,
        budget: Budget,
    ) -> Result<FrameReport, ProcessError> {
        let SolvedFrame { summary, outcome, light_from_beyond, fusion, warnings, prepare, recon, fusion_time } =
            self.solve_frame(raw, unit, guide, budget)?;
        self.mark_valid();
        let channels = raw.count();
        let Polarization { stokes, errors, .. } = &mut self.result;
        self.uncertainty.estimate(stokes, channels, outcome.modelled, outcome.residual_rms, errors);
        let valid = &self.result.valid;
        let errors = self.uncertainty.summarize(&self.result.stokes, &self.result.errors, valid);
        let count = valid.iter().filter(|v| **v).count();
        let noise = outcome.sigma.unwrap_or(self.device.noise.read);
        let quality = &self.readings.quality;
        let asked = budget.iterations.map(NonZeroUsize::get).or(self.settings.iterations);
        let figures = Figures {
            residual_over_noise: outcome.residual_rms / noise.max(EXACT * quality.mean).max(f32::MIN_POSITIVE),
            settled: outcome.sigma.is_some() && asked.is_none_or(|n| n >= self.fields[0].solver.iterations),
            light_over_noise: quality.mean / noise.max(f32::MIN_POSITIVE),
            saturated: quality.saturated,
            foreign_guide: guide.is_some()
                && self.method == Method::Guided
                && summary.agreement.is_none_or(|a| a.foreign),
        };
        Ok(FrameReport {
            method: self.method(),
            noise,
            figures,
            field: Field { margin: self.fields[0].field().margin(), light_from_beyond },
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
            errors,
            valid_fraction: count as f32 / valid.len() as f32,
            shift_px: summary.shift,
            local_shift_px: summary.local_shift,
            guide_weights: summary.weights,
            psf_scale: self.fields[0].psf_scale as f32,
            prepare,
            register: summary.register,
            recon,
            fusion,
            fusion_time,
            warnings,
            notices: std::mem::take(&mut self.notices),
        })
    }

    /// Takes one frame from raw values to the result.
    fn solve_frame(
        &mut self,
        raw: Planes<'_>,
        unit: Unit,
        guide: Option<Planes<'_>>,
        budget: Budget,
    ) -> Result<SolvedFrame, ProcessError> {
        let start = Instant::now();
        if !self.settings.video {
            self.begin_anew()?;
        }
        self.normalization.run(raw, unit, &mut self.readings).map_err(PrepareError::from)?;
        let mut warnings = Vec::new();
        let summary = self.prepare(guide, &mut warnings)?;
        let mut prepare = start.elapsed().saturating_sub(summary.register);
        let method = self.choose_method(&summary, guide.is_some(), &mut warnings);
        let start = Instant::now();
        let iterations = budget.iterations.map(NonZeroUsize::get).or(self.settings.iterations);
        let mut outcome = self.solve(method, &summary, iterations, &mut warnings)?;
        if self.tells_of_light(&outcome) && self.model_margin(self.device.margin, &mut warnings)? {
            let again = Instant::now();
            self.prepare_on_field(guide, PsfSize::Given, false, &mut warnings)?;
            prepare += again.elapsed();
            outcome = self.solve(method, &summary, iterations, &mut warnings)?;
        }
        let light_from_beyond = self.fields[0].cut_out(&self.polarization, &mut self.result.stokes);
        let recon = start.elapsed();
        warnings.extend(warning::of_readings(&self.readings.quality));
        let channels = raw.count();
        self.complete(channels);
        let start = Instant::now();
        let fusion = self.refine(outcome.sigma.unwrap_or(self.device.noise.read), channels, budget.refine);
        let fusion_time = start.elapsed();
        Ok(SolvedFrame { summary, outcome, light_from_beyond, fusion, warnings, prepare, recon, fusion_time })
    }

    /// Forgets everything that earlier frames told: guide, size of the PSF, light from beyond the frame, and factors of nearly the same
    /// equations. Allocates where the PSF had another size.
    fn begin_anew(&mut self) -> Result<(), ProcessError> {
        self.quiet = 0;
        if !self.fields[0].field().margin().is_none() {
            if self.fields.len() > 1 {
                self.fields.reverse();
            } else if !self.method.solves_angles() {
                // The frame before took the memory of the frame alone for its field.
                self.model_margin(Margin::default(), &mut Vec::new())?;
            }
        }
        self.fields.iter_mut().for_each(Reconstruction::forget);
        if self.fields[0].psf_scale.to_bits() != 1.0f64.to_bits() {
            let calibrated = self.device.psf.clone();
            self.set_psf(&calibrated, 1.0)?;
        }
        Ok(())
    }

    /// The method that a prepared frame is solved with: that of the settings, or another one where its guide is of no use.
    fn choose_method(&self, summary: &guide::Summary, has_guide: bool, warnings: &mut Vec<Warning>) -> Method {
        let mut method = self.method;
        if method == Method::Guided && summary.gain.is_none() {
            warnings.push(if has_guide { Warning::UselessGuide } else { Warning::NoGuide });
            method = Method::Stokes;
        }
        if let Some(agreement) = summary.agreement {
            warnings.extend(warning::of_guide(&agreement));
            if agreement.foreign {
                method = Method::Stokes;
            }
        }
        method
    }

    /// Solves the prepared frame on the present field.
    fn solve(
        &mut self,
        method: Method,
        summary: &guide::Summary,
        iterations: Option<usize>,
        warnings: &mut Vec<Warning>,
    ) -> Result<solve::Outcome, ProcessError> {
        match self.take_turns(method) {
            Err(PlanError::Memory { total, limit, .. }) if summary.gain.is_some() => {
                warnings.push(Warning::ForeignGuideTaken { needed: total, limit });
            }
            outcome => outcome?,
        }
        Ok(self.fields[0].solve(summary.gain.is_some(), iterations, &mut self.result.stokes)?)
    }

    /// Whether the solution without a guide leaves light from beyond the frame in the readings.
    fn tells_of_light(&mut self, outcome: &solve::Outcome) -> bool {
        let unguided = matches!(outcome.modelled, solve::Modelled::Both | solve::Modelled::Intensity);
        unguided
            && self.fields[0].field().margin().is_none()
            && self.fields[0].leaves_light(&self.result.stokes, outcome.sigma)
    }

    /// Prepares readings and guide for the solver, on the frame alone or with the margin from which light comes.
    fn prepare(
        &mut self,
        guide: Option<Planes<'_>>,
        warnings: &mut Vec<Warning>,
    ) -> Result<guide::Summary, ProcessError> {
        let asked = if self.refits_psf() { PsfSize::Asked } else { PsfSize::Given };
        let told = std::mem::replace(&mut self.told, true);
        if self.fields[0].field().margin().is_none() {
            return self.prepare_frame(guide, asked, warnings);
        }
        let beside = self.prepare_on_field(guide, if told { asked } else { PsfSize::Given }, false, warnings)?;
        if !told && beside.plainly_shows_light() {
            return self.refit_beside_light(beside, guide, asked, warnings);
        }
        if told && !beside.is_dark_beyond() || !self.model_margin(Margin::default(), warnings)? {
            return Ok(beside);
        }
        if !told {
            return self.prepare_frame(guide, asked, warnings);
        }
        self.quiet = QUIET;
        self.prepare_on_field(guide, asked, false, warnings)
    }

    /// Prepares readings and guide on the frame alone, and beside light from beyond it where they show such light.
    fn prepare_frame(
        &mut self,
        guide: Option<Planes<'_>>,
        asked: PsfSize,
        warnings: &mut Vec<Warning>,
    ) -> Result<guide::Summary, ProcessError> {
        let look = self.quiet == 0;
        self.quiet = self.quiet.saturating_sub(1);
        // Without a guide of this scene the solution tells about light, not the preparation.
        let alone = self.prepare_on_field(guide, asked, look, warnings)?;
        if !alone.suspects_light {
            return Ok(alone);
        }
        if self.model_margin(self.device.margin, warnings)? {
            let beside = self.prepare_on_field(guide, PsfSize::Given, false, warnings)?;
            if beside.shows_light(&alone) {
                return self.refit_beside_light(beside, guide, asked, warnings);
            }
            // No light after all.
            if !self.model_margin(Margin::default(), warnings)? {
                return Ok(beside);
            }
        }
        self.quiet = QUIET;
        self.prepare_on_field(guide, asked, false, warnings)
    }

    /// Prepares once more with the size of the PSF refitted beside much light from beyond the frame: only where the light is modelled does
    /// it not pass for another size. `beside` is the preparation with the size given.
    fn refit_beside_light(
        &mut self,
        beside: guide::Summary,
        guide: Option<Planes<'_>>,
        asked: PsfSize,
        warnings: &mut Vec<Warning>,
    ) -> Result<guide::Summary, ProcessError> {
        if asked == PsfSize::Given || !beside.has_much_light() {
            return Ok(beside);
        }
        self.fields[0].prepared.forget();
        self.prepare_on_field(guide, asked, false, warnings)
    }

    /// Prepares readings and guide on the present field, and refits the size of the PSF where they show that it has changed.
    fn prepare_on_field(
        &mut self,
        guide: Option<Planes<'_>>,
        mut psf_size: PsfSize,
        look: bool,
        warnings: &mut Vec<Warning>,
    ) -> Result<guide::Summary, ProcessError> {
        let mut refits = 0;
        loop {
            let summary = self.fields[0].prepare(&self.readings, guide, psf_size, look)?;
            let Some(growth) = summary.growth else { return Ok(summary) };
            let why_not = self.refit_psf(growth)?;
            refits += 1;
            psf_size = if why_not.is_none() && refits < REFITS { PsfSize::Refitted } else { PsfSize::Given };
            warnings.extend(why_not);
        }
    }

    /// Runs stage II if `run` says so; `sigma` is the noise of the readings. The result of stage I is kept in any case.
    fn refine(&mut self, sigma: f32, channels: usize, run: bool) -> Option<refine::Report> {
        let Fusion { plan, workspace, stage1 } = self.fusion.as_mut()?;
        let Polarization { stokes, angles, .. } = &mut self.result;
        let field = self.fields[0].field();
        match &self.fields[0].solver.output {
            Some(solved) => field.crop_planes(solved, stage1),
            None => to_angles(&self.polarization, stokes, stage1, channels),
        }
        if !run {
            return None;
        }
        let input = refine::Input { raw: self.fields[0].raw(), weight: &self.readings.weight, sigma };
        let report = plan.run(&input, stokes, workspace);
        if let Some(angles) = angles.as_mut().filter(|_| report.is_learned()) {
            to_angles(&self.polarization, stokes, angles, channels);
        }
        Some(report)
    }

    /// Computes angle images from Stokes images or Stokes images from angle images, whichever the method did not solve for.
    fn complete(&mut self, channels: usize) {
        let Polarization { stokes, angles, .. } = &mut self.result;
        let (n, p, field) = (stokes.size().pixels(), self.angles.len(), self.fields[0].field());
        match (&self.fields[0].solver.output, angles) {
            (Some(solved), angles) => {
                if field.margin().is_none() {
                    let pairs =
                        solved.as_slice().chunks_exact(p * n).zip(stokes.as_mut_slice().chunks_exact_mut(3 * n));
                    pairs.for_each(|(angles, stokes)| self.polarization.to_stokes(angles, stokes, n));
                }
                angles.iter_mut().for_each(|angles| field.crop_planes(solved, angles));
            }
            (None, Some(angles)) => to_angles(&self.polarization, stokes, angles, channels),
            (None, None) => {}
        }
    }

    fn mark_valid(&mut self) {
        let Readings { weight, quality, .. } = &self.readings;
        let per_channel = self.result.stokes.count() / weight.count();
        self.result.valid.fill(true);
        for (c, weight) in weight.planes().enumerate() {
            let s0 = self.result.stokes.plane(c * per_channel);
            let pixels = self.result.valid.iter_mut().zip(s0.iter().zip(weight));
            pixels.for_each(|(valid, (s0, weight))| *valid &= *weight > 0.0 && *s0 > DARK * quality.peak);
        }
    }
}

impl Fusion {
    fn new(plan: refine::Plan, planes: usize, size: Size) -> Result<Self, PlanError> {
        Ok(Self { workspace: plan.make_workspace()?, plan, stage1: Stack::zeros(planes, size) })
    }

    /// Bytes of everything.
    fn bytes(plan: &refine::Plan, planes: usize, size: Size) -> usize {
        plan.bytes() + plan.workspace_bytes() + planes * size.pixels() * size_of::<f32>()
    }
}

/// Computes the angle images of every channel from its Stokes images.
fn to_angles(polar: &polarization::Plan, stokes: &Stack<f32>, angles: &mut Stack<f32>, channels: usize) {
    let (n, p) = (stokes.size().pixels(), angles.count() / channels);
    let pairs = stokes.as_slice().chunks_exact(3 * n).zip(angles.as_mut_slice().chunks_exact_mut(p * n));
    pairs.for_each(|(stokes, angles)| polar.to_angles(stokes, angles, n));
}
