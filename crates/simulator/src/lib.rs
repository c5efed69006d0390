//! Simulated cameras: a polarized scene seen by a lensless camera with a striped polarizer mask, and by the guide camera beside it.
//!
//! A [`SimSpec`] describes the device and the scene, a [`Simulator`] renders frames of it, and a [`Capture`] holds one pair of frames with
//! the truth. The specification also gives what a solver has to know of the device: [`SimSpec::psf`], [`SimSpec::mask`],
//! [`SimSpec::homography`], and the whole as the text of a bundle, [`SimSpec::calibration`].
//!
//! ```
//! use stokescope_core::image::Size;
//! use stokescope_simulator::{SimSpec, Simulator};
//!
//! // polarizer film on a light table, before a sensor of 48 × 32 pixels with 8 stripes of the angles 0°, 45° and 90°
//! let size = Size::new(48, 32);
//! let spec = SimSpec { scene: "wedges".to_owned(), size, stripes: 8, angles: 3, ..SimSpec::default() };
//! let mut simulator = Simulator::new(spec)?;
//! let first = simulator.capture(0);
//! assert_eq!((first.raw.count(), first.raw.size()), (1, size)); // counts of the lensless sensor
//! assert_eq!((first.guide.count(), first.truth.count()), (1, 3)); // the guide; one true image for each angle
//! assert!(simulator.capture(1).raw != first.raw); // scenes move, and each frame has its own noise
//!
//! // the same from text, with the flaws of a device built by hand
//! let flawed: SimSpec = "wedges,size=48x32,stripes=8,angles=3,imperfect=all".parse()?;
//! assert!(flawed.flaws.vignetting > 0.0);
//! # Ok::<(), stokescope_simulator::SimError>(())
//! ```
//!
//! The rendering is not the solver's operator run backwards. A scene is a function of place and time. It is sampled on a grid two or
//! three times finer than the sensor, convolved there with a finer PSF than the bundle holds, and weighted by the mask column by fine
//! column. Only then each pixel averages over its area, photons and read-out add noise, and the sensor adds its black level, rounds to
//! counts and clips. Scenes can go on beyond the frame ([`SimSpec::surround`]): the diffuser spreads light from there onto the sensor, and
//! the guide can see more than the frame ([`SimSpec::guide_margin`]); the truth is that of the frame. The guide sees S0 of the same instant through an ordinary lens, from its own position. A device may have [`Flaws`];
//! its bundle holds the nominal design or all of the truth ([`Knowledge`]).
//!
//! Units: signals are fractions of full scale, [`Capture::raw`] is in counts. The truth is in units of the sensor and includes the exposure.
//! Allocation: at construction and with the first raw frame; later frames reuse the buffers.

#![warn(clippy::too_many_lines)]

mod flaws;
mod psf;
mod render;
mod scene;
mod spec;

use std::f32::consts::TAU;

pub use flaws::{Flaws, IMPERFECTIONS, Imperfections, Pose, Stripe};
use nalgebra::Matrix3;
use rand::{Rng, SeedableRng, rngs::StdRng};
use rand_distr::StandardNormal;
pub use scene::{SCENES, SceneError, SceneReader, TARGETS};
pub use spec::{Knowledge, Margin, SimError, SimSpec};

use self::{
    flaws::Device,
    psf::Caustic,
    render::Convolver,
    scene::{Grid, Lamp, Scene, Target},
};
use stokescope_core::image::{Size, Stack};
use stokescope_core::polarization::Angle;

/// Transmission of the red, green and blue filters of the lensless sensor.
const EXPOSURES: [f32; 3] = [0.9, 1.0, 0.8];

/// Angles in degrees of the polarizers on the pixels of a sensor with a mosaic, as on the Sony IMX250MZR and IMX264MZR.
pub const MOSAIC: [[f64; 2]; 2] = [[90.0, 45.0], [135.0, 0.0]];

/// Rows of a scene that are rendered at a time.
const BAND: usize = 32;

/// One pair of simulated frames, and the true scene.
#[derive(Clone, Debug)]
pub struct Capture {
    /// Counts of the lensless sensor, one plane per channel.
    pub raw: Stack<u16>,
    /// Frame of the guide, quantized, 0 to 1, one plane per channel.
    pub guide: Stack<f32>,
    /// True intensity behind ideal polarizers in units of the sensor, `channels × angles` planes, averaged over each pixel's area.
    pub truth: Stack<f32>,
}

/// Renders frames of one specification.
pub struct Simulator {
    spec: SimSpec,
    scene: Scene,
    /// Fine pixels beyond the frame whose light reaches the sensor, on each side.
    margin: usize,
    /// The diffuser in front of the lensless sensor, planned with the first raw frame.
    diffuser: Option<Box<Convolver>>,
    device: Device,
    lamp: Lamp,
    angles: Vec<Angle>,
    /// Some rows of the scene, three planes per channel.
    band: Stack<f32>,
    /// Signal of the lensless sensor, full scale; allocated with the first raw frame.
    signal: Stack<f32>,
}

impl Simulator {
    /// Plans the rendering of a built-in scene.
    ///
    /// # Errors
    /// [`SimError`] for values out of range and unknown scenes.
    pub fn new(spec: SimSpec) -> Result<Self, SimError> {
        Self::with_reader(spec, &|name| Err(SceneError::Unknown { name: name.to_owned() }))
    }

    /// Plans the rendering of a built-in scene, or of a measured one that `read` returns for its name. Measured scenes do not move; they
    /// are cropped to the aspect of the frame and what is seen beyond it, and scaled so that all but the brightest half percent of S0 is at
    /// most 1.
    ///
    /// # Errors
    /// [`SimError`] for values out of range and scenes that cannot be read.
    pub fn with_reader(spec: SimSpec, read: SceneReader<'_>) -> Result<Self, SimError> {
        spec.check()?;
        let Size { width, height } = spec.size;
        let fine = Size::new(width * spec.fine, height * spec.fine);
        let seen = Grid::field(fine, spec.fine * spec.surround_margin().max(spec.seen_margin()));
        let target = Target::named(&spec.scene);
        // the mask passes half: the brightest pixel reads 0.6
        let bright = || {
            let psf = Caustic::new(spec.size, spec.fine, spec.seed, 0.0).measured(spec.size, spec.fine);
            1.2 / psf.as_slice().iter().copied().fold(0.0, f32::max)
        };
        let point = if target == Some(Target::Point) { bright() } else { 1.0 };
        let scene = match target {
            Some(target) => Scene::Target(target, spec.size, spec.seed),
            None => Scene::load(&spec.scene, seen, spec.seed, read)?,
        };
        Ok(Self {
            margin: if scene.without_diffuser() { 0 } else { spec.fine * spec.lit_margin() },
            scene,
            diffuser: None,
            device: Device::new(&spec),
            lamp: Lamp { light: spec.light, point, offset: spec.point, polarizer: None },
            angles: spec.mask_angles(),
            band: Stack::zeros(3 * spec.channels(), Size::new(0, 0)),
            signal: Stack::zeros(spec.channels(), Size::new(0, 0)),
            spec,
        })
    }

    /// The specification.
    pub fn spec(&self) -> &SimSpec {
        &self.spec
    }

    /// Both frames number `index`, whose scene time is `index / frame_rate`, and the truth. Allocates them.
    pub fn capture(&mut self, index: u64) -> Capture {
        let (channels, size) = (self.spec.channels(), self.spec.size);
        let mut capture = Capture {
            raw: Stack::zeros(channels, size),
            guide: Stack::zeros(channels, self.spec.guide_size()),
            truth: Stack::zeros(channels * self.spec.angles, size),
        };
        self.raw(index, &mut capture.raw);
        self.truth(index, &mut capture.truth);
        self.guide(index, &mut capture.guide);
        capture
    }

    /// Renders frame `index` of the lensless sensor in counts.
    pub fn raw(&mut self, index: u64, out: &mut Stack<u16>) {
        self.expose(index);
        let spec = &self.spec;
        let (black, range) = (f32::from(spec.black_level), f32::from(spec.saturation() - spec.black_level));
        let mut rng = noise(spec.seed, index, 0);
        let pixels = spec.size.pixels();
        for (i, (counts, &signal)) in out.as_mut_slice().iter_mut().zip(self.signal.as_slice()).enumerate() {
            let signal = spec.exposure * (signal + self.device.dark.get(i % pixels).copied().unwrap_or(0.0));
            let sigma = (spec.read_noise.powi(2) + spec.shot_noise * signal.max(0.0)).sqrt();
            let value = black + range * spec.gain * (signal + sigma * rng.sample::<f32, _>(StandardNormal));
            *counts = value.round().clamp(0.0, f32::from(spec.saturation())) as u16;
        }
    }

    /// Renders frame `index` of the guide, quantized, 0 to 1.
    pub fn guide(&mut self, index: u64, out: &mut Stack<f32>) {
        let (step, size) = (self.spec.fine as f64, self.spec.guide_size());
        let size = Size::new(size.width * self.spec.fine, size.height * self.spec.fine);
        let mut grid = Grid { size, ..Grid::frame(self.fine_size()) };
        let (time, lamp) = self.instant(index);
        if grid.size != grid.frame || self.spec.pose != Pose::default() || self.spec.shift != [0.0; 2] {
            let exact = self.spec.homography(Knowledge::Exact);
            let scene = Matrix3::from_row_slice(&exact).try_inverse().unwrap_or_else(Matrix3::identity);
            let (down, up) = (0.5 / step - 0.5, 0.5 * step - 0.5);
            let to_guide = Matrix3::new(1.0 / step, 0.0, down, 0.0, 1.0 / step, down, 0.0, 0.0, 1.0);
            let to_fine = Matrix3::new(step, 0.0, up, 0.0, step, up, 0.0, 0.0, 1.0);
            grid.map = Some((to_fine * scene * to_guide).map(|v| v as f32));
        }
        let (channels, fine) = (self.spec.channels(), self.spec.fine);
        let mut rows = SceneRows::new(&self.scene, time, grid, lamp, &mut self.band);
        let Size { width, height } = out.size();
        for y in 0..height {
            for channel in 0..channels {
                rows.means(3 * channel, y, fine, &mut out.plane_mut(channel)[y * width..][..width]);
            }
        }
        let steps = ((1u32 << self.spec.guide_bits) - 1) as f32;
        let mut rng = noise(self.spec.seed, index, 1);
        for value in out.as_mut_slice() {
            let seen = self.spec.exposure * self.spec.guide_gain * *value;
            let seen = self.spec.gain * (seen + self.spec.guide_noise * rng.sample::<f32, _>(StandardNormal));
            *value = (seen.clamp(0.0, 1.0) * steps).round() / steps;
        }
    }

    fn fine_size(&self) -> Size {
        Size::new(self.spec.size.width * self.spec.fine, self.spec.size.height * self.spec.fine)
    }

    /// Scene time of frame `index` in seconds, and the lamp on a target at that time.
    fn instant(&self, index: u64) -> (f32, Lamp) {
        let axis = |start: f64| Angle::from_degrees(start + self.spec.turn * index as f64);
        let lamp = Lamp { polarizer: self.spec.polarizer.map(axis), ..self.lamp };
        ((index as f64 / self.spec.frame_rate) as f32, lamp)
    }

    /// Renders the true angle images of frame `index`, in units of the sensor, averaged over its pixels.
    fn truth(&mut self, index: u64, out: &mut Stack<f32>) {
        let Size { width, height } = self.spec.size;
        let flaw = self.exposure_of(index).0;
        let level = 0.5 * flaw * self.spec.exposure * self.spec.gain;
        let halves = [0, 1, 2].map(|channel| level * self.exposure(channel));
        let (time, lamp) = self.instant(index);
        let mut rows = SceneRows::new(&self.scene, time, Grid::frame(self.fine_size()), lamp, &mut self.band);
        let mut means = [0, 1, 2].map(|_| vec![0.0; width]);
        for y in 0..height {
            for (channel, half) in halves.into_iter().enumerate().take(self.spec.channels()) {
                means.iter_mut().enumerate().for_each(|(k, mean)| rows.means(3 * channel + k, y, self.spec.fine, mean));
                let [s0, s1, s2] = &means;
                for (p, angle) in self.angles.iter().enumerate() {
                    let (c, s) = (angle.cos2() as f32, angle.sin2() as f32);
                    let row = &mut out.plane_mut(channel * self.spec.angles + p)[y * width..][..width];
                    for (x, value) in row.iter_mut().enumerate() {
                        *value = half * (s0[x] + c * s1[x] + s * s2[x]);
                    }
                }
            }
        }
    }

    fn exposure(&self, channel: usize) -> f32 {
        if self.spec.color { EXPOSURES[channel] } else { 1.0 }
    }

    /// Exposure of frame `index` over the nominal one, and the phase of the flicker over its rows.
    fn exposure_of(&self, index: u64) -> (f32, f32) {
        let mut rng = noise(self.spec.seed ^ 0xE790, index, 0);
        (1.0 + self.spec.flaws.exposure * rng.sample::<f32, _>(StandardNormal), TAU * rng.random::<f32>())
    }

    /// Plans the convolution with the diffuser, unless that was done or there is none.
    fn plan_diffuser(&mut self) {
        if self.diffuser.is_none() && !self.scene.without_diffuser() {
            // the PSF drifts after its measurement
            let measuring = matches!(self.scene, Scene::Target(Target::Point, ..));
            let growth = if measuring { 0.0 } else { self.spec.flaws.drift };
            let caustic = Caustic::new(self.spec.size, self.spec.fine, self.spec.seed, growth);
            self.diffuser = Some(Box::new(Convolver::new(self.fine_size(), self.margin, &caustic)));
        }
    }

    /// Computes the signal of each sensor pixel: the Stokes images behind the diffuser, weighted by the mask. They are rendered and blurred
    /// one after another, which costs some time and saves the memory of three fine images.
    fn expose(&mut self, index: u64) {
        let (fine, step) = (self.fine_size(), self.spec.fine);
        let Size { width, height } = self.spec.size;
        let (exposure, phase) = self.exposure_of(index);
        let exposures = [0, 1, 2].map(|channel| self.exposure(channel));
        let (time, lamp) = self.instant(index);
        if self.signal.size() != self.spec.size {
            self.signal = Stack::zeros(self.spec.channels(), self.spec.size);
        }
        self.signal.as_mut_slice().fill(0.0);
        self.plan_diffuser();
        let (field, level) = (Grid::field(fine, self.margin), self.spec.surround_level);
        let device = &self.device;
        for (channel, own) in exposures.into_iter().enumerate().take(self.spec.channels()) {
            let share = own * exposure / (step * step) as f32;
            let signal = self.signal.plane_mut(channel);
            for k in 0..3 {
                let mut rows = SceneRows::new(&self.scene, time, field, lamp, &mut self.band);
                let mut gather = |v: usize, row: &[f32]| {
                    let line = &mut signal[v / step * width..][..width];
                    let cells = row.chunks_exact(step).zip(device.columns(v / step).chunks_exact(step));
                    for (sum, (values, weights)) in line.iter_mut().zip(cells) {
                        *sum += share * values.iter().zip(weights).map(|(value, m)| m[k] * value).sum::<f32>();
                    }
                };
                match &mut self.diffuser {
                    Some(convolver) => {
                        let read = |v: usize, row: &mut [f32]| {
                            row.copy_from_slice(rows.row(3 * channel + k, v));
                            dim_beyond(field, v, row, level);
                        };
                        convolver.convolve(read, gather);
                    }
                    None => (0..fine.height).for_each(|v| gather(v, rows.row(3 * channel + k, v))),
                }
            }
            for (i, t) in self.device.transmission.iter().enumerate() {
                signal[i] *= t;
            }
            if self.spec.flaws.rolling > 0.0 {
                for (y, row) in signal.chunks_exact_mut(width).enumerate() {
                    let flicker = (phase + 1.3 * TAU * y as f32 / height as f32).sin();
                    row.iter_mut().for_each(|v| *v *= 1.0 + self.spec.flaws.rolling * flicker);
                }
            }
        }
    }
}

/// Multiplies what row `v` of a field has beyond the frame by `level`.
fn dim_beyond(field: Grid, v: usize, row: &mut [f32], level: f32) {
    let Grid { frame, margin, .. } = field;
    let inside = if (margin..margin + frame.height).contains(&v) { margin..margin + frame.width } else { 0..0 };
    let (before, rest) = row.split_at_mut(inside.start);
    before.iter_mut().chain(&mut rest[inside.len()..]).for_each(|value| *value *= level);
}

/// A scene at one instant, rendered some rows at a time.
struct SceneRows<'a> {
    scene: &'a Scene,
    time: f32,
    /// The samples of the whole frame.
    grid: Grid,
    lamp: Lamp,
    /// The rendered rows, three planes per channel.
    band: &'a mut Stack<f32>,
    /// Number of the first rendered row, if any are.
    top: Option<usize>,
}

impl<'a> SceneRows<'a> {
    /// Prepares `band`, which is resized if need be.
    fn new(scene: &'a Scene, time: f32, grid: Grid, lamp: Lamp, band: &'a mut Stack<f32>) -> Self {
        let size = Size::new(grid.size.width, BAND.min(grid.size.height));
        if band.size() != size {
            *band = Stack::zeros(band.count(), size);
        }
        Self { scene, time, grid, lamp, band, top: None }
    }

    /// Row `y` of plane `k`. Rows asked for from the top down are rendered once.
    fn row(&mut self, k: usize, y: usize) -> &[f32] {
        let Size { width, height } = self.band.size();
        // the last band overlaps the one before: all are of one size
        let top = (y / height * height).min(self.grid.size.height - height);
        if self.top.replace(top) != Some(top) {
            let grid = Grid { size: self.band.size(), top, ..self.grid };
            self.scene.sample(self.time, grid, &self.lamp, self.band);
        }
        &self.band.plane(k)[(y - top) * width..][..width]
    }

    /// Averages `step`×`step` samples of plane `k` into each value of row `y`.
    fn means(&mut self, k: usize, y: usize, step: usize, out: &mut [f32]) {
        out.fill(0.0);
        for v in 0..step {
            let cells = self.row(k, y * step + v).chunks_exact(step);
            out.iter_mut().zip(cells).for_each(|(sum, cell)| *sum += cell.iter().sum::<f32>());
        }
        let share = 1.0 / (step * step) as f32;
        out.iter_mut().for_each(|v| *v *= share);
    }
}

/// Random numbers of one frame of one camera. They depend on seed and index alone, not on the frames rendered before.
fn noise(seed: u64, index: u64, camera: u64) -> StdRng {
    StdRng::seed_from_u64(seed.rotate_left(32) ^ (2 * index + camera))
}

/// Renders one pair of frames at time zero.
///
/// # Errors
/// As [`Simulator::new`].
pub fn simulate(spec: &SimSpec) -> Result<Capture, SimError> {
    Ok(Simulator::new(spec.clone())?.capture(0))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn spec(more: &str) -> SimSpec {
        format!("spheres,size=48x40,stripes=8,{more}").parse().unwrap()
    }

    /// The solver's model on the sensor's grid, by direct summation.
    fn modelled(spec: &SimSpec, truth: &Stack<f32>) -> Vec<f32> {
        let (Size { width, height }, psf) = (spec.size, spec.psf());
        let mut out = vec![0.0; width * height];
        for (i, value) in out.iter_mut().enumerate() {
            let (x, y) = (i % width, i / width);
            // of 0°, 45°, 90° and 135°
            let cell = [[2, 1], [3, 0]];
            let stripe = x * spec.stripes / width % spec.angles;
            let image = truth.plane(if spec.mosaic { cell[y % 2][x % 2] } else { stripe });
            for v in 0..height {
                for u in 0..width {
                    let (dx, dy) = (x + width / 2, y + height / 2);
                    if (u..u + width).contains(&dx) && (v..v + height).contains(&dy) {
                        *value += psf.plane(0)[(dy - v) * width + dx - u] * image[v * width + u];
                    }
                }
            }
        }
        out
    }

    #[test]
    fn exposure_and_gain_scale_both_cameras_and_the_truth_and_gain_scales_noise_too() {
        let at = |exposure, gain| simulate(&SimSpec { exposure, gain, ..spec("shot=0,guide_noise=0") }).unwrap();
        let mean = |values: &[f32]| values.iter().sum::<f32>() / values.len() as f32;
        let (once, half) = (at(1.0, 1.0), at(0.5, 1.0));
        let of = |capture: &Capture| {
            [
                mean(&signal(&spec("shot=0"), &capture.raw)),
                mean(capture.guide.as_slice()),
                mean(capture.truth.as_slice()),
            ]
        };
        for (whole, halved) in of(&once).into_iter().zip(of(&half)) {
            assert!((halved / whole - 0.5).abs() < 5e-3, "{halved} of {whole}");
        }
        // half the light at twice the gain: as bright, and twice as noisy
        let raised = at(0.5, 2.0);
        let quiet = at(1.0, 1.0);
        let seen = |capture: &Capture| signal(&spec("shot=0"), &capture.raw);
        let still = simulate(&SimSpec { read_noise: 0.0, ..spec("shot=0,guide_noise=0") }).unwrap();
        let noise = |capture| {
            rms(seen(capture).into_iter().zip(seen(&still)).map(|(a, b)| a - b).collect::<Vec<_>>().into_iter())
        };
        assert!((noise(&raised) / noise(&quiet) - 2.0).abs() < 0.02);
    }

    fn signal(spec: &SimSpec, raw: &Stack<u16>) -> Vec<f32> {
        let (black, full) = (f32::from(spec.black_level), f32::from(spec.saturation()));
        raw.as_slice().iter().map(|&c| (f32::from(c) - black) / (full - black)).collect()
    }

    fn rms(values: impl ExactSizeIterator<Item = f32>) -> f32 {
        let count = values.len() as f32;
        (values.map(|v| v * v).sum::<f32>() / count).sqrt()
    }

    #[test]
    fn without_noise_it_differs_from_the_coarse_model_by_discretization_alone() {
        for more in ["angles=4,fine=2", "mask=mosaic,fine=2", "angles=3,fine=3,bits=12,black=64"] {
            // the coarse model ends at the frame
            let spec = spec(&format!("{more},noise=0,shot=0,surround=0"));
            let capture = simulate(&spec).unwrap();
            let (seen, expected) = (signal(&spec, &capture.raw), modelled(&spec, &capture.truth));
            let error = rms(seen.iter().zip(&expected).map(|(a, b)| a - b));
            assert!(error > 1e-6 && error < 1e-2 * rms(expected.iter().copied()), "{more}: {error}");
        }
    }

    /// The signal of each pixel by direct summation in f64 over the fine field, of a gray scene without flaws.
    fn summed(simulator: &Simulator) -> Vec<f64> {
        let (spec, step, margin) = (&simulator.spec, simulator.spec.fine, simulator.spec.fine * simulator.spec.reach());
        let field = Grid::field(simulator.fine_size(), margin);
        let (Size { width, height }, frame) = (field.size, simulator.fine_size());
        let mut scene = Stack::zeros(3, field.size);
        simulator.scene.sample(0.0, field, &simulator.lamp, &mut scene);
        let caustic = Caustic::new(spec.size, step, spec.seed, 0.0);
        let mut out = vec![0.0; spec.size.pixels()];
        for (v, u) in (0..frame.height).flat_map(|v| (0..frame.width).map(move |u| (v, u))) {
            for ([dx, dy], response) in caustic.responses() {
                let (x, y) = ((u + margin) as isize - dx, (v + margin) as isize - dy);
                let inside = (0..width as isize).contains(&x) && (0..height as isize).contains(&y);
                let beyond = |at: isize, side: usize| at < margin as isize || at >= (margin + side) as isize;
                if !inside {
                    continue;
                }
                let dimmed = beyond(x, frame.width) || beyond(y, frame.height);
                let level = if dimmed { f64::from(spec.surround_level) } else { 1.0 };
                for (k, m) in simulator.device.columns(v / step)[u].iter().enumerate() {
                    let light = f64::from(scene.plane(k)[y as usize * width + x as usize]);
                    out[v / step * spec.size.width + u / step] +=
                        level * f64::from(response) * f64::from(*m) * light / (step * step) as f64;
                }
            }
        }
        out
    }

    #[test]
    fn light_from_beyond_the_frame_reaches_the_sensor_as_a_direct_sum_says() {
        for (more, level) in
            [("surround=auto", 1.0), ("surround=auto,mask=mosaic", 1.0), ("surround=auto", 0.25), ("surround=0", 0.0)]
        {
            let mut spec: SimSpec = format!("tissue,size=20x16,stripes=4,noise=0,shot=0,{more}").parse().unwrap();
            spec.surround_level = level;
            let mut simulator = Simulator::new(spec).unwrap();
            simulator.expose(0);
            let expected = summed(&simulator);
            let mean = expected.iter().sum::<f64>() / expected.len() as f64;
            let seen = simulator.signal.as_slice();
            for (i, (found, expected)) in seen.iter().zip(&expected).enumerate() {
                assert!((f64::from(*found) - expected).abs() < 1e-5 * mean, "{more} {level} {i}: {found} {expected}");
            }
        }
    }

    #[test]
    fn a_field_stop_leaves_the_frame_alone_and_the_truth_is_always_that_of_the_frame() {
        let capture = |more: &str| simulate(&spec(more)).unwrap();
        let (stopped, dark) = (capture("surround=0,guide_margin=0"), capture("surround=auto,surround_level=0"));
        let lit = capture("surround=auto,guide_margin=0");
        assert_eq!(stopped.raw, dark.raw);
        assert_ne!(stopped.raw, lit.raw);
        assert_eq!((&stopped.truth, &stopped.guide), (&lit.truth, &lit.guide));
        // what lies farther away than the PSF reaches sends no light
        assert_eq!(lit.raw, capture("surround=30,guide_margin=0").raw);
    }

    #[test]
    fn a_guide_with_a_margin_shows_the_frame_in_its_middle() {
        let quiet = "guide_noise=0,guide_bits=12";
        let [frame, wide] = [0, 7].map(|margin| simulate(&spec(&format!("{quiet},guide_margin={margin}"))).unwrap());
        assert_eq!(wide.guide.size(), Size::new(62, 54));
        let errors: Vec<f32> = (0..40 * 48)
            .map(|i| frame.guide.plane(0)[i] - wide.guide.plane(0)[(i / 48 + 7) * 62 + i % 48 + 7])
            .collect();
        assert!(rms(errors.into_iter()) < 1e-4);
        let border = wide.guide.plane(0)[..7 * 62].iter().sum::<f32>();
        assert!(border > 0.0, "the scene goes on");
    }

    #[test]
    fn a_measured_scene_shows_its_rim_beyond_the_frame() {
        // bright in its outer sixth, on each side
        let side = 60;
        let rim = |i: usize| [i % side, i / side].into_iter().any(|at| !(10..50).contains(&at));
        let values: Vec<f32> = (0..3 * side * side)
            .map(|i| {
                if i / (side * side) > 0 {
                    0.0
                } else if rim(i) {
                    1.0
                } else {
                    0.25
                }
            })
            .collect();
        let read = |_: &str| Ok(Stack::from_vec(3, Size::new(side, side), values.clone()).unwrap());
        let capture = |more: &str| {
            let spec = format!("mine,size=40,stripes=8,{more}").parse().unwrap();
            Simulator::with_reader(spec, &read).unwrap().capture(0)
        };
        // the field of 60 pixels is the scene: the frame shows its middle
        let beyond = capture("surround=auto,guide_margin=10,guide_noise=0,seed=3");
        let s0 = |i: usize| beyond.truth.plane(0)[i] + beyond.truth.plane(2)[i];
        assert!((1..39).all(|k| (s0(20 * 40 + k) - 0.25).abs() < 1e-3), "{}", s0(20 * 40 + 1));
        assert!((beyond.guide.plane(0)[30 * 60 + 4] - 1.0).abs() < 1e-3);
        let all = capture("surround=0,guide_margin=0");
        assert!(all.truth.plane(0)[20 * 40 + 2] > 0.4, "the frame shows the whole scene");
    }

    #[test]
    fn read_and_shot_noise_have_the_variance_asked_for_and_a_seed() {
        let quiet = spec("noise=0,shot=0");
        let clean = signal(&quiet, &simulate(&quiet).unwrap().raw);
        let noisy = spec("noise=0.01,shot=0.001");
        let first = simulate(&noisy).unwrap();
        let seen = signal(&noisy, &first.raw);
        let normalized = rms(seen.iter().zip(&clean).map(|(a, b)| (a - b) / (1e-4 + 1e-3 * b).sqrt()));
        assert!((normalized - 1.0).abs() < 0.05, "{normalized}");
        assert_eq!(first.raw, simulate(&noisy).unwrap().raw);
        assert_ne!(first.raw, simulate(&SimSpec { seed: 2, ..noisy }).unwrap().raw);
    }

    #[test]
    fn the_guide_is_a_shifted_s0() {
        let spec = spec("shift=2:-1,guide_noise=0,guide_bits=12,guide_margin=0");
        let capture = simulate(&spec).unwrap();
        // intensities behind two crossed polarizers add up to S0
        let s0 = |i: usize| capture.truth.plane(0)[i] + capture.truth.plane(2)[i];
        let errors: Vec<f32> = (4..36)
            .flat_map(|y| (4..44).map(move |x| (x, y)))
            .map(|(x, y)| capture.guide.plane(0)[y * 48 + x] - s0((y + 1) * 48 + x - 2))
            .collect();
        assert!(rms(errors.into_iter()) < 1e-3);
    }

    #[test]
    fn bright_scenes_clip_at_saturation_and_dark_ones_at_zero() {
        let capture = simulate(&spec("noise=1,bits=12,black=0")).unwrap();
        let (low, high) = capture.raw.as_slice().iter().fold((u16::MAX, 0), |(a, b), &v| (a.min(v), b.max(v)));
        assert_eq!((low, high), (0, 4095));
    }
}
