//! Flaws that set a device apart from its nominal description, which calibration has to find.

use std::str::FromStr;

use rand::{Rng, SeedableRng, rngs::StdRng};
use rand_distr::StandardNormal;

use super::{MOSAIC, SimError, SimSpec};
use stokescope_core::image::Size;
use stokescope_core::polarization::Angle;

/// Strengths of the flaws of a simulated device. The default has none.
#[derive(Clone, Debug, PartialEq)]
pub struct Flaws {
    /// Each stripe is turned by a random angle of this σ, in degrees.
    pub angles_deg: f32,
    /// Transmission parallel : crossed of the stripes, each within 30 % of it; infinite is ideal.
    pub extinction: f32,
    /// Shift of the mask to the right, in pixels.
    pub mask_shift: f32,
    /// Width (σ) of the blurred edges between stripes, in pixels.
    pub edge_blur: f32,
    /// Specks on the mask, per 10 000 pixels.
    pub dust: f32,
    /// Growth of the PSF between its measurement and the scenes, as a share of its size.
    pub drift: f32,
    /// Loss of light in the corners, 0 to 1.
    pub vignetting: f32,
    /// Share of hot pixels, whose dark signal is 2 to 50 % of full scale.
    pub hot: f32,
    /// Spread (σ) of the exposure from frame to frame, as a share of it.
    pub exposure: f32,
    /// Flicker over the rows of a rolling exposure, as a share of it.
    pub rolling: f32,
}

impl Default for Flaws {
    fn default() -> Self {
        Self {
            angles_deg: 0.0,
            extinction: f32::INFINITY,
            mask_shift: 0.0,
            edge_blur: 0.0,
            dust: 0.0,
            drift: 0.0,
            vignetting: 0.0,
            hot: 0.0,
            exposure: 0.0,
            rolling: 0.0,
        }
    }
}

/// Position of the guide camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// Size of the guide's frames; none is the size of the lensless sensor.
    pub size: Option<Size>,
    /// Magnification; at 1 the guide's view is that of the lensless camera.
    pub zoom: f64,
    /// Rotation in degrees.
    pub turn_deg: f64,
    /// Relative change of the magnification from the middle of the frame to its side, as of a tilted scene.
    pub tilt: f64,
}

impl Default for Pose {
    fn default() -> Self {
        Self { size: None, zoom: 1.0, turn_deg: 0.0, tilt: 0.0 }
    }
}

/// Names of imperfections and their strengths, which are usual in a device built by hand.
pub const IMPERFECTIONS: &[(&str, &str)] = &[
    ("angles", "every stripe turned by 1.5° (σ)"),
    ("extinction", "stripes of extinction 60 : 1"),
    ("edges", "mask shifted by 0.6 pixels, edges blurred by 0.8"),
    ("dust", "2 specks per 10 000 pixels"),
    ("drift", "PSF 0.1 % larger than when it was measured"),
    ("vignetting", "25 % less light in the corners"),
    ("hot", "hot pixels, 0.05 %"),
    ("exposure", "exposures that differ by 1 % (σ), and by 0.5 % over the rows"),
    ("guide", "guide of 1.3 times the pixels, zoomed, turned, tilted, shifted, with its own gain and noise"),
];

/// A selection of [`IMPERFECTIONS`].
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Imperfections(Vec<&'static str>);

impl FromStr for Imperfections {
    type Err = SimError;

    /// Reads `all`, `none`, or names joined by `+` or `,`.
    fn from_str(text: &str) -> Result<Self, SimError> {
        let known = || IMPERFECTIONS.iter().map(|(name, _)| *name);
        match text {
            "all" => Ok(Self(known().collect())),
            "none" => Ok(Self::default()),
            list => list
                .split(['+', ','])
                .map(|typed| {
                    known().find(|name| *name == typed.trim()).ok_or_else(|| SimError::Imperfection {
                        found: typed.to_owned(),
                        allowed: known().collect::<Vec<_>>().join(", "),
                    })
                })
                .collect::<Result<_, _>>()
                .map(Self),
        }
    }
}

impl SimSpec {
    /// Adds these imperfections to the device.
    pub fn spoil(&mut self, imperfections: &Imperfections) {
        for name in &imperfections.0 {
            let flaws = &mut self.flaws;
            match *name {
                "angles" => flaws.angles_deg = 1.5,
                "extinction" => flaws.extinction = 60.0,
                "edges" => (flaws.mask_shift, flaws.edge_blur) = (0.6, 0.8),
                "dust" => flaws.dust = 2.0,
                "drift" => flaws.drift = 0.001,
                "vignetting" => flaws.vignetting = 0.25,
                "hot" => flaws.hot = 5e-4,
                "exposure" => (flaws.exposure, flaws.rolling) = (0.01, 0.005),
                _ => {
                    let larger = |n: usize| n * 13 / 10;
                    let size = Size::new(larger(self.size.width), larger(self.size.height));
                    self.pose = Pose { size: Some(size), zoom: 0.94, turn_deg: 1.2, tilt: 0.01 };
                    let share = self.size.width.min(self.size.height) as f32 / 250.0;
                    (self.shift, self.guide_gain, self.guide_noise) = ([3.3 * share, -2.1 * share], 0.7, 0.008);
                }
            }
        }
    }
}

/// One stripe of a mask.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Stripe {
    /// Orientation of the polarizer's axis.
    pub angle: Angle,
    /// Transmission crossed : parallel.
    pub leak: f64,
    /// Left edge in pixels from the left edge of the first pixel.
    pub left: f64,
}

impl Stripe {
    /// m0, m1 and m2.
    fn response(&self) -> [f64; 3] {
        let contrast = 0.5 * (1.0 - self.leak);
        [0.5 * (1.0 + self.leak), contrast * self.angle.cos2(), contrast * self.angle.sin2()]
    }
}

/// One device with random flaws of the strengths that a specification asks for.
#[derive(Clone, Debug)]
pub(super) struct Device {
    pub(super) stripes: Vec<Stripe>,
    /// Response m0, m1, m2 of each fine column, for each row of pixels until the mask repeats.
    rows: Vec<Vec<[f32; 3]>>,
    /// Transmission of dust and vignetting, for each pixel; empty without either.
    pub(super) transmission: Vec<f32>,
    /// Dark signal above black, for each pixel, in full scale; empty without hot pixels.
    pub(super) dark: Vec<f32>,
}

impl Device {
    pub(super) fn new(spec: &SimSpec) -> Self {
        let (flaws, Size { width, height }) = (&spec.flaws, spec.size);
        let stream = |number: u64| StdRng::seed_from_u64(spec.seed ^ 0xF1A3_0000 ^ number);
        let mut rng = stream(0);
        let cell = || MOSAIC.into_iter().flatten().map(Angle::from_degrees).collect();
        let (count, angles) = if spec.mosaic { (4, cell()) } else { (spec.stripes, spec.mask_angles()) };
        let stripes: Vec<Stripe> = (0..count)
            .map(|k| {
                let (turn, spread): (f32, f32) = (rng.sample(StandardNormal), rng.random_range(0.7..1.3));
                // nominal stripes are whole sensor columns wide
                let left = (k * width).div_ceil(count) as f64 + f64::from(flaws.mask_shift);
                Stripe {
                    angle: Angle::from_degrees(angles[k % angles.len()].degrees() + f64::from(flaws.angles_deg * turn)),
                    leak: f64::from(flaws.extinction * spread).recip(),
                    left: if k == 0 { f64::NEG_INFINITY } else { left },
                }
            })
            .collect();
        let rows = if spec.mosaic {
            let polarizer = |row: usize, u: usize| stripes[2 * row + u / spec.fine % 2].response().map(|m| m as f32);
            (0..2).map(|row| (0..width * spec.fine).map(|u| polarizer(row, u)).collect()).collect()
        } else {
            let columns = 0..width * spec.fine;
            vec![columns.map(|u| response(&stripes, (u as f64 + 0.5) / spec.fine as f64, flaws)).collect()]
        };
        let mut device = Self { rows, stripes, transmission: Vec::new(), dark: Vec::new() };
        if flaws.vignetting > 0.0 || flaws.dust > 0.0 {
            let (mx, my) = (0.5 * width as f32, 0.5 * height as f32);
            let left = |i: usize| {
                let (dx, dy) = ((i % width) as f32 + 0.5 - mx, (i / width) as f32 + 0.5 - my);
                1.0 - flaws.vignetting * (dx * dx + dy * dy) / (mx * mx + my * my)
            };
            device.transmission = (0..spec.size.pixels()).map(left).collect();
            let mut rng = stream(1);
            for _ in 0..(flaws.dust * spec.size.pixels() as f32 / 1e4).round() as usize {
                let (x, y) = (rng.random_range(0.0..width as f32), rng.random_range(0.0..height as f32));
                let (radius, depth) = (rng.random_range(1.0..4.0f32), rng.random_range(0.3..0.8f32));
                for (i, t) in device.transmission.iter_mut().enumerate() {
                    let far = ((i % width) as f32 - x).hypot((i / width) as f32 - y) / radius;
                    *t *= 1.0 - depth * (-far.powi(4)).exp();
                }
            }
        }
        if flaws.hot > 0.0 {
            let mut rng = stream(2);
            let hot = |_| if rng.random::<f32>() < flaws.hot { rng.random_range(0.02..0.5) } else { 0.0 };
            device.dark = (0..spec.size.pixels()).map(hot).collect();
        }
        device
    }

    /// Response m0, m1, m2 of each fine column in a row of pixels.
    pub(super) fn columns(&self, row: usize) -> &[[f32; 3]] {
        &self.rows[row % self.rows.len()]
    }

    /// Response m0, m1, m2 of a pixel, averaged over its area.
    pub(super) fn response(&self, i: usize, width: usize) -> [f32; 3] {
        let row = self.columns(i / width);
        let fine = row.len() / width;
        let columns = &row[i % width * fine..][..fine];
        let through = self.transmission.get(i).copied().unwrap_or(1.0);
        std::array::from_fn(|k| columns.iter().map(|m| m[k]).sum::<f32>() * through / fine as f32)
    }
}

/// m0, m1, m2 at `x` pixels from the left.
fn response(stripes: &[Stripe], x: f64, flaws: &Flaws) -> [f32; 3] {
    let passed = |edge: f64| {
        let z = (x - edge) / f64::from(flaws.edge_blur);
        if z.is_finite() {
            // the tanh approximation of the normal distribution function
            0.5 + 0.5 * (0.797_884_6 * z * (1.0 + 0.044_715 * z * z)).tanh()
        } else {
            f64::from(u8::from(x > edge))
        }
    };
    let mut sum = [0.0; 3];
    for (k, stripe) in stripes.iter().enumerate() {
        let share = passed(stripe.left) - stripes.get(k + 1).map_or(0.0, |next| passed(next.left));
        sum.iter_mut().zip(stripe.response()).for_each(|(sum, m)| *sum += share * m);
    }
    sum.map(|v| v as f32)
}
