//! Preparation of a frame and its guide for the solver.
//!
//! The guide is resampled to the field's grid and the sensor's channels and aligned with the readings. Its brightness is corrected where
//! the readings contradict it, what it does not see is solved for, and it is scaled into the sensor's units. Where the field is the frame
//! alone, light from beyond it is looked for (`beyond.rs`).
//!
//! Allocation: [`Plan::new`] and [`Plan::make_workspace`] allocate, [`Plan::run`] does not.

pub(crate) mod beyond;
mod border;
mod colors;
mod fit;
mod follow;
pub(crate) mod mend;
mod parallax;
mod psf;
mod radiometry;
mod register;
mod resample;
mod search;
mod track;

pub(crate) use psf::PsfSize;

use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::device::{Device, Homography, Sensor};
use crate::image::noise::{SAMPLES, reading_noise};
use crate::image::{Buffers, Planes, Size, Stack};
use crate::optics::{Coarse, Field, Margin, Scratch, StokesOperator};
use crate::readings::{Readings, ReadingsError};
use colors::Weights;
use parallax::Shifts;
use radiometry::Curve;
use register::{Found, Parameters};
use track::Track;

/// Why a frame cannot be prepared.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum PrepareError {
    /// The raw frame is not what the bundle is for, or holds nothing usable.
    #[error(transparent)]
    Readings(#[from] ReadingsError),
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
}

/// Preparation for one device.
#[derive(Clone, Debug)]
pub(crate) struct Plan {
    sensor: Sensor,
    field: Field,
    /// From pixels of the field to pixels of the guide camera.
    homography: Homography,
    /// Whether the bundle says how guides of another size lie.
    placed: bool,
    /// Weights of a colour guide's channels beside a mono sensor, if they are known.
    weights: Option<Weights>,
    sampler: resample::Sampler,
    operators: Vec<StokesOperator>,
    guide_mode: GuideMode,
    coarse: Vec<Arc<Coarse>>,
}

/// How a guide is used.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum GuideMode {
    /// Only displayed: resampled with the device's homography, and not used by the solver.
    Shown,
    /// Used as S0, resampled with the device's homography.
    Placed,
    /// Used as S0, and aligned with the readings of every frame.
    Aligned,
}

impl GuideMode {
    /// The mode of a guided method or another one, with guides aligned or not.
    pub(crate) fn new(guided: bool, align: bool) -> Self {
        match (guided, align) {
            (true, true) => Self::Aligned,
            (true, false) => Self::Placed,
            (false, _) => Self::Shown,
        }
    }
}

/// A guide frame, the factor that brings it near the readings' magnitude, the weights of its channels beside a mono sensor, and its local
/// shifts, if there are any.
#[derive(Clone, Copy, Debug)]
struct Content<'a> {
    frame: Planes<'a>,
    scale: f32,
    weights: Weights,
    shifts: Option<&'a Shifts>,
}

/// Everything that is looked at beside the guide.
#[derive(Clone, Copy)]
struct Look<'a> {
    psf_size: PsfSize,
    /// Readings of light from beyond the frame, where it is looked for.
    pattern: Option<&'a [f32]>,
    /// Mean of the trusted readings.
    mean_reading: f32,
}

/// The factor that brings a guide near the readings' magnitude. It is a power of two, so that nothing is rounded. Two images
/// share a transform, and the rounding of one that is thousands of times larger would hide the other.
fn common_scale(raw: &Stack<f32>, guide: &Stack<f32>) -> f32 {
    let magnitude = |s: &Stack<f32>| s.as_slice().iter().map(|v| f64::from(v.abs())).sum::<f64>();
    let octaves = (magnitude(raw) / magnitude(guide)).log2().round();
    // Within a factor of four nothing is lost, and a scale that does not change keeps frames comparable.
    if octaves.is_finite() && octaves.abs() > 2.0 { octaves.clamp(-100.0, 100.0).exp2() as f32 } else { 1.0 }
}

/// A pixel counts as seen by the guide up to this far beyond the centres of its outermost pixels.
const BEYOND: f64 = 0.25;

/// One prepared frame and the buffers that make it.
#[derive(Debug)]
pub(crate) struct Workspace {
    /// Readings of the field `[C, H, W]`, fractions of full scale; where the weight is 0, an estimate, and 0 beyond the frame.
    pub raw: Stack<f32>,
    /// 0 or 1 for each reading; 0 beyond the frame.
    pub weight: Stack<f32>,
    /// The guide of the field `[C, H, W]`, in the readings' units once [`Plan::run`] has fitted the gain.
    pub guide: Stack<f32>,
    scratch: Scratch,
    fit: fit::Workspace,
    border: border::Workspace,
    samples: Vec<f32>,
    /// The last frame's guide, for what the next one's does not see.
    kept: Stack<f32>,
    track: Option<Track>,
    /// Weights of a colour guide's channels that were found in an earlier frame: they do not change with the scene.
    weights: Weights,
}

impl Workspace {
    /// Forgets position and brightness of earlier guides: the next guide is searched for.
    pub(crate) fn forget(&mut self) {
        self.track = None;
    }

    /// Forgets everything of earlier frames.
    pub(crate) fn forget_all(&mut self) {
        self.forget();
        self.weights = colors::EVEN;
        self.fit.forget();
    }

    /// A plane of the field for other uses between two frames, the readings and their weights.
    pub(crate) fn plane_and_readings(&mut self) -> (&mut [f32], &Stack<f32>, &Stack<f32>) {
        (self.border.plane(), &self.raw, &self.weight)
    }

    /// Buffers of the convolutions, to which a caller may lend the image of another stage.
    pub(crate) fn scratch(&mut self) -> &mut Scratch {
        &mut self.scratch
    }
}

/// Result of preparing a frame.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Summary {
    /// Sensor units per guide unit, for each channel; none without a guide or when it explains nothing.
    pub gain: Option<[f32; 3]>,
    /// How the guide fits the readings; none without a guide that is used as S0.
    pub agreement: Option<Agreement>,
    /// Shift of the guide's content against the scene that was found and undone, in pixels at the frame's centre: right, down.
    pub shift: [f32; 2],
    /// Weights of a colour guide's channels beside a mono sensor, of sum 1; none where there are none.
    pub weights: Option<[f32; 3]>,
    /// Length of the longest local shift of the guide that was found and undone beside `shift`, in pixels; 0 without any.
    pub local_shift: f32,
    /// Size of the PSF by the readings, over the size it is taken for. The guide is not prepared then: the frame must be prepared
    /// again with a PSF of that size ([`Plan::set_optics`]). None if the size is right or was not asked for.
    pub growth: Option<f64>,
    /// True where the field is the frame and the readings may hold light from beyond it.
    pub suspects_light: bool,
    /// Sum of squares that the aligned guide, its brightness not corrected yet, and slow polarization leave of the readings, over that of
    /// the noise.
    pub rest: f32,
    /// That rest once the guide's brightness is corrected; in small frames the rest before.
    pub corrected_rest: f32,
    /// Share of the guide's light on the sensor that comes from beyond the frame.
    pub light_from_beyond: f32,
    /// Share of the guide's values that were replaced, 0 to 1.
    pub replaced: f32,
    /// Time of aligning and correcting the guide.
    pub register: Duration,
}

/// Share of the light on the sensor that comes from beyond the frame below which the scene is taken to end with the frame.
const LEAST_LIGHT: f32 = 0.002;
/// Share from which on the light is certain: a vignetted guide passes for less.
const MUCH_LIGHT: f32 = 0.05;
/// Rest over the one without a margin, up to which a margin that the guide sees is believed in …
const BETTER_SEEN: f32 = 1.1;
/// … and the same of what is beyond noise, where more than this share of the field is solved for, which explains a part of any rest.
const BETTER_UNSEEN: f32 = 0.45;
const UNSEEN: f32 = 0.1;
/// Rest over the one without a margin, both with the guide's brightness corrected, up to which such a margin is believed in: a vignetted guide
/// is explained by its correction, and leaves half as much again beside a margin.
const AS_WELL: f32 = 1.1;
/// Share up to which such a margin is worth a warning: an error of the guide's brightness explains the readings as well.
const BETTER_IN_DOUBT: f32 = 0.85;
const NEARLY_AS_WELL: f32 = 1.25;

impl Summary {
    /// Whether this preparation explains the readings better than another one of the same frame with another guide.
    pub(crate) fn explains_better_than(&self, other: &Self) -> bool {
        match (self.own_agreement(), other.own_agreement()) {
            (Some(_), None) => true,
            (None, Some(_)) => false,
            _ => self.rest < other.rest,
        }
    }

    /// How a guide of this scene fits; none without one.
    fn own_agreement(&self) -> Option<Agreement> {
        self.agreement.filter(|agreement| !agreement.foreign && self.gain.is_some())
    }

    /// Whether a guide of this scene, on a field with a margin, shows that no light comes from there.
    pub(crate) fn is_dark_beyond(&self) -> bool {
        self.own_agreement().is_some() && self.light_from_beyond < LEAST_LIGHT
    }

    /// Whether much of the guide's light comes from beyond the frame.
    pub(crate) fn has_much_light(&self) -> bool {
        self.light_from_beyond >= MUCH_LIGHT
    }

    /// Whether a guide of this scene, on a field with a margin that it sees, shows so much light from there that the frame alone need not be
    /// compared.
    pub(crate) fn plainly_shows_light(&self) -> bool {
        self.own_agreement().is_some_and(|agreement| agreement.hidden <= UNSEEN) && self.has_much_light()
    }

    /// Whether light from a margin that the guide does not see explains the readings better than the frame `alone` does, if not well enough to
    /// be believed in.
    pub(crate) fn may_show_light(&self, alone: &Self) -> bool {
        let unseen = self.own_agreement().is_some_and(|agreement| agreement.hidden > UNSEEN);
        let better = self.rest - 1.0 < BETTER_IN_DOUBT * (alone.rest - 1.0);
        unseen
            && self.light_from_beyond >= LEAST_LIGHT
            && better
            && self.corrected_rest < NEARLY_AS_WELL * alone.corrected_rest
    }

    /// Whether a guide of this scene does not see a margin that sends little light, if any.
    pub(crate) fn leaves_light_open(&self) -> bool {
        self.own_agreement().is_some_and(|agreement| agreement.hidden > UNSEEN) && !self.has_much_light()
    }

    /// Whether a frame that was prepared on a field with a margin shows light from there; `alone` is the same on the frame alone.
    pub(crate) fn shows_light(&self, alone: &Self) -> bool {
        let Some(agreement) = self.own_agreement() else { return false };
        let better = if agreement.hidden > UNSEEN {
            self.rest - 1.0 < BETTER_UNSEEN * (alone.rest - 1.0) && self.corrected_rest < AS_WELL * alone.corrected_rest
        } else {
            self.rest < BETTER_SEEN * alone.rest
        };
        self.light_from_beyond >= LEAST_LIGHT && (better || alone.own_agreement().is_none())
    }
}

/// How the guide fits the readings once it is aligned.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Agreement {
    /// True if it shows another scene, or nothing.
    pub foreign: bool,
    /// Gain of its detail over gain of its brightness: 1 for a perfect guide, 0 for one of another scene.
    pub detail: f32,
    /// Standard deviation of the shift along its least certain direction, in pixels; infinite for a featureless guide.
    pub uncertainty: f32,
    /// True if its brightness was corrected.
    pub corrected: bool,
    /// Share of the pixels that it does not see, for which S0 was solved.
    pub hidden: f32,
    /// About how far right and down of its place the content of a guide lies that was not aligned, in pixels; zero where the readings
    /// show no significant shift.
    pub off: [f32; 2],
    /// Brightness, over that of the frame, of a dim margin that the guide does not see; else 0.
    pub dim_margin: f32,
}

impl Plan {
    /// Preparation for `device`, whose camera is `operators`, one for each channel, with the equations `coarse` beside a
    /// guide ([`Coarse::beside_guide`]; none without a mask or when the guide is only shown). Allocates.
    pub(crate) fn new(
        device: &Device,
        operators: &[StokesOperator],
        coarse: &[Arc<Coarse>],
        guide_mode: GuideMode,
    ) -> Self {
        let field = operators[0].field();
        let Margin { columns, rows } = field.margin();
        Self {
            sensor: device.sensor,
            field,
            homography: device.guide.after_shift(-(columns as f64), -(rows as f64)),
            placed: device.guide != Homography::IDENTITY,
            weights: device.guide_weights,
            sampler: resample::Sampler::new(),
            operators: operators.to_vec(),
            guide_mode,
            coarse: coarse.to_vec(),
        }
    }

    /// Replaces the PSF: `operators` holds one operator for each channel, `coarse` the equations beside a guide. Call
    /// [`Workspace::forget`] after it.
    pub(crate) fn set_optics(&mut self, operators: &[StokesOperator], coarse: &[Arc<Coarse>]) {
        self.operators.clear();
        self.operators.extend_from_slice(operators);
        self.coarse.clear();
        self.coarse.extend_from_slice(coarse);
    }

    /// Bytes of one [`Workspace`].
    pub(crate) fn workspace_bytes(&self) -> usize {
        Buffers::bytes(|buffers| self.workspace(buffers))
    }

    /// Buffers for [`Self::run`]. Allocates.
    pub(crate) fn make_workspace(&self) -> Workspace {
        Buffers::allocate(|buffers| self.workspace(buffers))
    }

    fn workspace(&self, buffers: &mut Buffers) -> Workspace {
        let (size, channels) = (self.field.size(), self.sensor.channels);
        Workspace {
            raw: buffers.stack(channels, size),
            weight: buffers.stack(channels, size),
            guide: buffers.stack(channels, size),
            scratch: self.operators[0].convolver.scratch(buffers),
            fit: fit::Workspace::new(&self.coarse, size, buffers),
            border: border::Workspace::new(size, buffers),
            samples: buffers.reserved(SAMPLES),
            kept: buffers.stack(channels, size),
            track: None,
            weights: colors::EVEN,
        }
    }

    /// Prepares one frame, and its guide if there is one. `psf_size` says whether the size of the PSF is checked. `pattern`
    /// are the readings of an evenly bright surrounding ([`beyond::pattern`]), if light from beyond the frame is looked for.
    ///
    /// # Errors
    /// [`PrepareError`] when the guide does not fit the bundle.
    pub(crate) fn run(
        &self,
        readings: &Readings,
        guide: Option<Planes<'_>>,
        psf_size: PsfSize,
        pattern: Option<&[f32]>,
        w: &mut Workspace,
    ) -> Result<Summary, PrepareError> {
        let size = self.sensor.size;
        if let Some(found) = guide.map(|guide| guide.size())
            && found != size
            && !self.placed
        {
            return Err(PrepareError::GuideShape { found, size });
        }
        self.field.embed_planes(&readings.raw, &mut w.raw);
        self.field.embed_planes(&readings.weight, &mut w.weight);
        let mut summary = Summary::default();
        let Some(frame) = guide else { return Ok(summary) };
        let start = Instant::now();
        let content = Content { frame, scale: 1.0, weights: self.weights.unwrap_or(w.weights), shifts: None };
        self.place(content, &Parameters::zeros(), &mut w.guide, w.border.plane());
        if self.guide_mode != GuideMode::Shown {
            let content = Content { scale: common_scale(&w.raw, &w.guide), ..content };
            w.guide.as_mut_slice().iter_mut().for_each(|g| *g *= content.scale);
            let look = Look { psf_size, pattern, mean_reading: readings.quality.mean };
            self.adapt(content, look, w, &mut summary);
            summary.gain.iter_mut().flatten().for_each(|gain| *gain *= content.scale);
            summary.register = start.elapsed();
        }
        Ok(summary)
    }

    /// Resamples the guide whose content lies at `lies` against the scene.
    fn place(&self, content: Content<'_>, lies: &Parameters, guide: &mut Stack<f32>, plane: &mut [f32]) {
        let map = resample::moved(&self.homography, lies, guide.size());
        self.sampler.resample(content.frame, (&map, content.shifts), content.weights, guide, plane);
        if content.scale != 1.0 {
            guide.as_mut_slice().iter_mut().for_each(|g| *g *= content.scale);
        }
    }

    /// Makes the guide S0 in the readings' units: aligned, corrected and complete. Position and brightness of the last frame's
    /// guide are tried first; if the readings contradict them, everything is searched for.
    fn adapt(&self, content: Content<'_>, look: Look<'_>, w: &mut Workspace, summary: &mut Summary) {
        let trusted = w.weight.as_slice().iter().map(|w| f64::from(*w)).sum();
        let weight = std::mem::replace(&mut w.weight, Stack::zeros(0, self.sensor.size));
        let (mut noise, row_period) = (0.0f64, self.operators[0].response.row_period());
        for (y, weight) in w.raw.planes().zip(weight.planes()) {
            let sigma = reading_noise(y, weight, self.field.size(), row_period, &mut w.samples);
            noise = noise.max(f64::from(sigma).powi(2));
        }
        let (operators, coarse) = (&self.operators[..], &self.coarse[..]);
        let frame = fit::Frame { operators, coarse, weight: &weight, trusted, noise, beyond: look.pattern };
        w.fit.begin(&frame, self.field.level(w.guide.plane(0)));
        let track = w.track.take();
        w.track = track.and_then(|track| self.follow(track, &frame, content, look, w, summary));
        if w.track.is_none() {
            w.track = self.search(&frame, content, look, w, summary);
        }
        if !self.field.margin().is_none() && w.track.is_some() {
            let Workspace { guide, fit, scratch, .. } = &mut *w;
            summary.light_from_beyond = beyond::share(&self.operators, guide, &mut fit.image, scratch);
        }
        if let Some(track) = &w.track {
            summary.weights = self.mixes(content).then(|| self.weights.unwrap_or(w.weights));
            summary.local_shift = track.shifts.map_or(0.0, |shifts| shifts.longest());
            w.kept.as_mut_slice().copy_from_slice(w.guide.as_slice());
        }
        w.weight = weight;
    }

    /// Marks the pixels that a guide whose content lies at `lies` does not see, or sees in a hole of it.
    fn mark_hidden(&self, content: Content<'_>, lies: &Parameters, border: &mut border::Workspace) {
        let (size, frame) = (self.field.size(), content.frame);
        let seen = frame.size();
        let nearest = |v: f64, n: usize| v.round().clamp(0.0, (n - 1) as f64) as usize;
        let in_hole = |i: usize| (0..frame.count()).filter_map(|c| frame.weights(c)).any(|weights| weights[i] == 0.0);
        let map = resample::moved(&self.homography, lies, size);
        border.mark(|i| {
            let (x, y) = resample::moved_by(content.shifts, i, size);
            let (x, y) = map.apply(x, y);
            let sees = |v: f64, n: usize| (-BEYOND..=(n - 1) as f64 + BEYOND).contains(&v);
            !(sees(x, seen.width) && sees(y, seen.height))
                || in_hole(nearest(y, seen.height) * seen.width + nearest(x, seen.width))
        });
    }

    /// Solves for the guide where it is hidden.
    fn fill(&self, frame: &fit::Frame<'_>, w: &mut Workspace) {
        for c in 0..self.sensor.channels {
            w.border.fill(frame, c, w.raw.plane_mut(c), w.guide.plane_mut(c), &mut w.scratch, &mut w.fit);
        }
    }

    /// Takes one more pass of the guide's curves and corrects the guide by it; whether there was something to correct. Only
    /// behind a mask.
    fn refine(&self, frame: &fit::Frame<'_>, curves: &mut [Curve; 3], w: &mut Workspace) -> bool {
        let mut refined = false;
        let channels = if frame.coarse.is_empty() { 0 } else { self.sensor.channels };
        for (c, curve) in curves.iter_mut().enumerate().take(channels) {
            let planes = [w.raw.plane_mut(c), w.guide.plane_mut(c)];
            refined |= curve.refine(frame, c, planes, &mut w.scratch, &mut w.fit);
        }
        refined
    }

    /// Corrects the guide's brightness by a smooth error.
    fn correct(&self, frame: &fit::Frame<'_>, w: &mut Workspace) {
        for c in 0..self.sensor.channels {
            radiometry::correct(frame, c, w.raw.plane_mut(c), w.guide.plane_mut(c), &mut w.scratch, &mut w.fit);
        }
    }

    fn judge(frame: &fit::Frame<'_>, w: &mut Workspace) -> Found {
        register::judge(frame, &mut w.raw, &w.guide, &mut w.scratch, &mut w.fit)
    }

    fn growth(frame: &fit::Frame<'_>, asked: PsfSize, w: &mut Workspace) -> Option<f64> {
        let Workspace { raw, guide, border, scratch, fit, .. } = w;
        psf::growth(frame, asked, raw, guide, border.plane(), scratch, fit)
    }

    /// Share of the pixels that the guide does not see.
    fn hidden_share(&self, w: &Workspace) -> f32 {
        w.border.hidden_count as f32 / self.field.size().pixels() as f32
    }
}

/// Mean of each channel; 0 for channels that there are not.
fn brightness(guide: &Stack<f32>) -> [f32; 3] {
    let mut means = [0.0; 3];
    guide.planes().zip(&mut means).for_each(|(g, mean)| *mean = fit::mean(g));
    means
}
