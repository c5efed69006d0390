//! L2: from what the cameras deliver to what the solver takes.
//!
//! Raw frames become fractions of full scale without black level, `[C, H, W]`, each reading with a weight of 0 or 1; the
//! guide is resampled to the sensor's grid and channels, aligned with the raw frame and scaled into the sensor's units.
//!
//! Allocation: [`Plan::new`] and [`Plan::make_workspace`] allocate, [`Plan::run`] does not.
//! Imports: [`crate::plane`], [`crate::optics`], [`crate::calibration`], [`crate::frame`].

mod gain;
mod guide;
mod raw;
mod register;
mod unpack;

pub use raw::Quality;
pub use unpack::{UnpackError, unpack};

use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::calibration::{Calibration, Homography, Sensor};
use crate::optics::{Coarse, Scratch, StokesOperator};
use crate::plane::{Size, Stack};

/// What a raw value means.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Unit {
    /// Analogue-to-digital counts; the bundle's black level and saturation apply.
    Counts,
    /// Fractions of full scale, as floating-point files hold.
    FullScale,
}

/// Why a frame cannot be prepared.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum PrepareError {
    /// The raw frame is not what the bundle is for.
    #[error("raw frame has {found_channels} channel(s) of {found} pixels, the bundle is for {channels} of {size}")]
    RawShape {
        /// Channels of the frame.
        found_channels: usize,
        /// Its size.
        found: Size,
        /// Channels of the bundle's sensor.
        channels: usize,
        /// Its size.
        size: Size,
    },
    /// The guide has another size and no homography tells how it lies.
    #[error(
        "guide frame is {found} pixels, the sensor {size}: allowed without [guide] homography in the bundle: {size}"
    )]
    GuideShape {
        /// Size of the frame.
        found: Size,
        /// Size of the sensor.
        size: Size,
    },
    /// Nothing in the frame can be used.
    #[error(
        "raw frame: none of the {count} readings can be used ({saturated:.1} % saturated, {not_finite:.1} % NaN or infinite)"
    )]
    Unusable {
        /// Number of readings.
        count: usize,
        /// Saturated ones, in percent.
        saturated: f32,
        /// NaN and infinite ones, in percent.
        not_finite: f32,
    },
}

/// Preparation for one device.
#[derive(Clone, Debug)]
pub struct Plan {
    sensor: Sensor,
    dark: Option<Stack<f32>>,
    white: [f32; 3],
    homography: Homography,
    sampler: guide::Sampler,
    operators: Vec<StokesOperator>,
    register: bool,
    coarse: Vec<Arc<Coarse>>,
}

/// One prepared frame and the buffers that make it.
#[derive(Debug)]
pub struct Workspace {
    /// Readings `[C, H, W]`, fractions of full scale.
    pub raw: Stack<f32>,
    /// 0 or 1 for each reading.
    pub weight: Stack<f32>,
    /// The guide `[C, H, W]`, in the readings' units once [`Plan::run`] has fitted the gain.
    pub guide: Stack<f32>,
    blurred: Vec<f32>,
    scratch: Scratch,
    register: Option<register::Workspace>,
}

/// What preparation found out about a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Summary {
    /// Of the raw frame.
    pub quality: Quality,
    /// Sensor units per guide unit, for each channel; none without a guide or when it explains nothing.
    pub gain: Option<[f32; 3]>,
    /// Shift of the guide's content against the scene that was found and undone, in pixels: right, down.
    pub shift: [f32; 2],
    /// Time of finding it.
    pub register: Duration,
}

impl Plan {
    /// Preparation for `calibration`, whose camera is `operators` with the slow modes `coarse` (none without a mask), one for
    /// each channel. With `register` the guide of every frame is aligned with it. Allocates.
    pub fn new(
        calibration: &Calibration,
        operators: &[StokesOperator],
        coarse: &[Arc<Coarse>],
        register: bool,
    ) -> Self {
        Self {
            sensor: calibration.sensor,
            dark: calibration.dark.clone(),
            white: calibration.white,
            homography: calibration.guide,
            sampler: guide::Sampler::new(),
            operators: operators.to_vec(),
            register,
            coarse: coarse.to_vec(),
        }
    }

    /// Bytes of one [`Workspace`].
    pub fn workspace_bytes(&self) -> usize {
        let Sensor { size, channels, .. } = self.sensor;
        let register = if self.register { register::workspace_bytes(&self.coarse, size) } else { 0 };
        (3 * channels + 1) * size.pixels() * size_of::<f32>() + self.operators[0].convolver.scratch_bytes() + register
    }

    /// Buffers for [`Self::run`]. Allocates.
    pub fn make_workspace(&self) -> Workspace {
        let Sensor { size, channels, .. } = self.sensor;
        let stack = || Stack::zeros(channels, size);
        Workspace {
            raw: stack(),
            weight: stack(),
            guide: stack(),
            blurred: vec![0.0; size.pixels()],
            scratch: self.operators[0].convolver.make_scratch(),
            register: self.register.then(|| register::make_workspace(&self.coarse, size)),
        }
    }

    /// Prepares one frame, and its guide where there is one.
    ///
    /// # Errors
    /// [`PrepareError`] when shapes do not fit the bundle or no reading can be used.
    pub fn run(
        &self,
        raw: &Stack<f32>,
        unit: Unit,
        guide: Option<&Stack<f32>>,
        w: &mut Workspace,
    ) -> Result<Summary, PrepareError> {
        let Sensor { size, channels, .. } = self.sensor;
        if raw.size() != size || raw.count() != channels {
            return Err(PrepareError::RawShape { found_channels: raw.count(), found: raw.size(), channels, size });
        }
        if let Some(found) = guide.map(Stack::size)
            && found != size
            && self.homography == Homography::IDENTITY
        {
            return Err(PrepareError::GuideShape { found, size });
        }
        let quality =
            raw::normalize(raw, unit, &self.sensor, self.dark.as_ref(), self.white, &mut w.raw, &mut w.weight);
        if quality.saturated + quality.not_finite >= 1.0 {
            return Err(PrepareError::Unusable {
                count: raw.as_slice().len(),
                saturated: 100.0 * quality.saturated,
                not_finite: 100.0 * quality.not_finite,
            });
        }
        let mut summary = Summary { quality, gain: None, shift: [0.0; 2], register: Duration::ZERO };
        let Some(frame) = guide else { return Ok(summary) };
        let start = Instant::now();
        let same_scene = self.place(frame, w, &mut summary.shift);
        summary.register = start.elapsed();
        if same_scene {
            summary.gain = self.fit_gain(w);
        }
        Ok(summary)
    }

    /// Resamples the guide, aligned if that is planned; whether it shows the scene of the raw frame, as far as that is known.
    fn place(&self, frame: &Stack<f32>, w: &mut Workspace, shift: &mut [f32; 2]) -> bool {
        let Workspace { raw, weight, guide, blurred, scratch, register } = w;
        let mut place = |shift: [f64; 2], guide: &mut Stack<f32>| {
            self.sampler.resample(frame, &guide::moved(&self.homography, shift), guide, blurred);
        };
        let Some(register) = register else {
            place([0.0; 2], guide);
            return true;
        };
        let frame = register::Frame { operators: &self.operators, coarse: &self.coarse, raw, weight };
        let found = register::find(&frame, place, guide, scratch, register);
        *shift = found.shift.map(|v| v as f32);
        found.same_scene
    }

    /// Fits one gain for each channel and applies it.
    fn fit_gain(&self, w: &mut Workspace) -> Option<[f32; 3]> {
        let mut gains = [1.0; 3];
        for (c, operator) in self.operators.iter().enumerate() {
            operator.blur(w.guide.plane(c), &mut w.blurred, &mut w.scratch);
            let (y, weight) = (w.raw.plane(c), w.weight.plane(c));
            gains[c] = gain::fit(y, weight, &w.blurred, &operator.response, self.sensor.size)?;
            w.guide.plane_mut(c).iter_mut().for_each(|g| *g *= gains[c]);
        }
        Some(gains)
    }
}
