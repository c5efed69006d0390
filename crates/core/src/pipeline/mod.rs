//! The pipeline: one raw frame and its guide become [`Polarization`]. This is the only place where the stages meet:
//! `guide` and [`readings`], [`solve`](crate::solve), [`refine`], [`polarization`].
//!
//! [`Pipeline::new`] proves all shapes, sums the bytes of every stage and refuses what exceeds the memory limit. [`Pipeline::process`]
//! then works in the buffers made there.
//!
//! Allocation: `new` allocates, `process` does not, with three exceptions. A frame whose guide is useless needs a solver for S0; it is
//! kept beside the first one if the memory limit allows for both, else the two replace each other. A PSF whose size has changed since its
//! calibration is scaled, and everything computed from it is computed again. An image that is not planar single precision, and a guide with
//! pixels that have no value, is copied into a buffer, which is allocated once.

mod diagnosis;
mod error;
mod field;
mod frame;
mod fusion;
mod reconstruction;
mod refit;
mod report;
mod result;
mod settings;
mod solver;
mod warning;

use std::sync::Arc;
use std::time::Duration;

pub use crate::guide::PrepareError;
use crate::guide::mend::Mender;
pub use error::{PlanError, ProcessError};
use fusion::Fusion;
use reconstruction::Reconstruction;
pub use report::{Field, FrameReport, Notice};
pub use result::{Polarization, ProcessedFrame};
pub use settings::{Budget, Settings};
use solver::check_memory;
pub use warning::Warning;

use crate::device::Device;
use crate::image::{Buffers, ImageView, Size, Stack};
use crate::parallel::Workers;
use crate::polarization;
use crate::polarization::Angle;
use crate::readings::{self, Binned, Binning, Readings, ReadingsError};
use crate::refine;
use crate::solve::Method;
use crate::uncertainty;

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
    /// Whether the last look for such light could not tell it from an error of the guide's brightness.
    ambiguous: bool,
    /// Of the frames of a video: the share of outliers in the guide when they were looked into, and whether they are light.
    outliers: Option<(f32, bool)>,
    /// Whether a frame has told about light from beyond it.
    told: bool,
    /// Bytes of the stages that do not depend on the field.
    fixed: Vec<(&'static str, usize)>,
    /// Crops and bins frames of the camera's size; none where every reading is used by itself.
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
    /// A guide with pixels that have no value, or stand far from all around them.
    mender: Mender,
    /// A raw frame of the camera's size.
    binned: Binned,
}

impl Pipeline {
    /// Plans all stages for one device. Allocates.
    ///
    /// # Errors
    /// [`PlanError`], naming stage, need and limit.
    pub fn new(device: &Device, settings: Settings) -> Result<Self, PlanError> {
        let method = settings.method.unwrap_or(if settings.guided { Method::Guided } else { Method::Stokes });
        if method == Method::Guided && !settings.guided {
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
        if settings.guided {
            fixed.push(("guide mending", Mender::most_bytes(channels, size)));
        }
        fixed.extend(binning.as_ref().map(|binning| ("binning", binning.bytes())));
        let (now, told) = Reconstruction::first(device, method, &settings, &workers, &fixed)?;
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
            ambiguous: false,
            outliers: None,
            told,
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

    /// Forgets the guide of the last frame, so that the next one is searched for as that of a first frame. Allocates nothing.
    pub fn forget_guide(&mut self) {
        self.fields[0].prepared.forget();
        self.outliers = None;
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
        let guided = self.method == Method::Guided;
        let guide = guide.map(|guide| buffers.mender.mend(guide.to_planes(&mut buffers.guide), guided));
        let report = self.process_planes(planes, raw.unit(), guide, budget);
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
}
