//! The specification of a simulated device: its settings as text, their limits, and the bundle of such a device.

use std::fmt::{self, Write as _};
use std::str::FromStr;

use nalgebra::Matrix3;

use super::flaws::Device;
use super::psf::Caustic;
use super::render::Convolver;
use super::{BAND, Flaws, MOSAIC, Pose, SceneError, Stripe};
use stokescope_core::image::{Size, Stack};
use stokescope_core::polarization::Angle;

/// Amount of knowledge that the bundle of a simulated device holds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Knowledge {
    /// The nominal design: ideal stripes, the PSF before it drifted, no flaws.
    #[default]
    Nominal,
    /// The device as it is, with all flaws.
    Exact,
}

impl Knowledge {
    /// All kinds.
    pub const ALL: [Self; 2] = [Self::Nominal, Self::Exact];
}

impl fmt::Display for Knowledge {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Nominal => "nominal",
            Self::Exact => "exact",
        })
    }
}

/// How far something goes on beyond the frame, on each side.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Margin {
    /// As far as the PSF reaches: from farther away no light comes to the sensor.
    Auto,
    /// So many pixels of the frame.
    Pixels(usize),
}

impl FromStr for Margin {
    type Err = &'static str;

    /// Reads `auto` or a number of pixels.
    fn from_str(text: &str) -> Result<Self, Self::Err> {
        match text {
            "auto" => Ok(Self::Auto),
            _ => text.parse().map(Self::Pixels).map_err(|_| "allowed: auto, or a number of pixels"),
        }
    }
}

impl fmt::Display for Margin {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Auto => f.write_str("auto"),
            Self::Pixels(pixels) => write!(f, "{pixels}"),
        }
    }
}

/// Specification of a simulated pair of cameras and the scene in front of them. Read from text such as `spheres,size=250x200`.
#[derive(Clone, Debug, PartialEq)]
pub struct SimSpec {
    /// A name of [`SCENES`](super::SCENES) or [`TARGETS`](super::TARGETS), or a name that the reader of
    /// [`Simulator::with_reader`](super::Simulator::with_reader) knows.
    pub scene: String,
    /// Polarizer angles of the mask: 3 (0°, 45°, 90°) or 4 (and 135°).
    pub angles: usize,
    /// Whether there are three colour channels; otherwise the cameras see the green one.
    pub color: bool,
    /// Size of both sensors, 16 to 2048 pixels each way.
    pub size: Size,
    /// Vertical stripes over the width.
    pub stripes: usize,
    /// Polarizers on single pixels in place of stripes: [`MOSAIC`](super::MOSAIC).
    pub mosaic: bool,
    /// Read noise of the lensless sensor: σ, share of full scale.
    pub read_noise: f32,
    /// Shot noise of the lensless sensor: variance per unit signal.
    pub shot_noise: f32,
    /// Significant bits of a count: 12 or 16.
    pub bit_depth: u32,
    /// Counts of an unlit pixel.
    pub black_level: u16,
    /// Displacement of the guide in pixels, to the right and down.
    pub shift: [f32; 2],
    /// Factor between S0 and the guide.
    pub guide_gain: f32,
    /// Noise of the guide: σ, share of full scale.
    pub guide_noise: f32,
    /// Significant bits of the guide: 8 or 12.
    pub guide_bits: u32,
    /// Seed of the scene, the diffuser and the noise.
    pub seed: u64,
    /// Fine pixels per sensor pixel and axis: 2 or 3.
    pub fine: usize,
    /// Frames per second of live cameras.
    pub frame_rate: f64,
    /// Frames of the clip that live cameras render ahead and show to and fro. None is as many as fit into 3 MiB for each camera, 16 at most;
    /// 0 is no clip: every frame is rendered when it is due.
    pub clip: Option<usize>,
    /// How far the scene goes on beyond the frame. Its light reaches the sensor, as far as the PSF reaches. 0 is a field stop: it is dark
    /// there.
    pub surround: Margin,
    /// Share of the light from beyond the frame that passes: 1 without a field stop, less with one that leaks. The guide has no stop.
    pub surround_level: f32,
    /// How much more than the frame the guide sees.
    pub guide_margin: Margin,
    /// Position of the guide camera.
    pub pose: Pose,
    /// Flaws of the device.
    pub flaws: Flaws,
    /// Amount of knowledge that the device's bundle holds.
    pub knowledge: Knowledge,
    /// Brightness of a calibration target's lamp, 1 is usual.
    pub light: f32,
    /// Angle of the polarizer in front of the lamp, in degrees, if there is one.
    pub polarizer: Option<f64>,
    /// Rotation of that polarizer from frame to frame, in degrees.
    pub turn: f64,
    /// Place of the point source in pixels from the middle one, to the right and down.
    pub point: [i32; 2],
    /// Exposure time of both sensors over the nominal one. Live cameras take it from their mode; text does not hold it.
    pub exposure: f32,
    /// Gain of both sensors, 1 is none. It raises signal and noise alike. Live cameras take it from their mode; text does not hold it.
    pub gain: f32,
}

impl Default for SimSpec {
    fn default() -> Self {
        Self {
            scene: "plastic".to_owned(),
            angles: 4,
            color: false,
            size: Size::new(250, 250),
            stripes: 16,
            mosaic: false,
            read_noise: 0.002,
            shot_noise: 4e-6,
            bit_depth: 16,
            black_level: 1024,
            shift: [0.0; 2],
            guide_gain: 1.0,
            guide_noise: 0.005,
            guide_bits: 12,
            seed: 1,
            fine: 3,
            frame_rate: 10.0,
            clip: None,
            surround: Margin::Auto,
            surround_level: 1.0,
            guide_margin: Margin::Auto,
            pose: Pose::default(),
            flaws: Flaws::default(),
            knowledge: Knowledge::Nominal,
            light: 1.0,
            polarizer: None,
            turn: 0.0,
            point: [0; 2],
            exposure: 1.0,
            gain: 1.0,
        }
    }
}

/// A specification that cannot be simulated.
#[derive(Debug, thiserror::Error)]
pub enum SimError {
    /// A value out of range.
    #[error("{key} = {found}, allowed: {allowed}")]
    Range {
        /// Name of the setting.
        key: &'static str,
        /// Value found.
        found: String,
        /// Values allowed.
        allowed: &'static str,
    },
    /// A setting that does not exist, or whose value cannot be read.
    #[error("`{found}` is no setting of the simulator, allowed: {SETTINGS}")]
    Setting {
        /// The text found.
        found: String,
    },
    /// An imperfection that does not exist.
    #[error("`{found}` is no imperfection, allowed: all, none, or some of {allowed}")]
    Imperfection {
        /// The text found.
        found: String,
        /// Names of all imperfections.
        allowed: String,
    },
    /// A scene that cannot be loaded.
    #[error(transparent)]
    Scene(#[from] SceneError),
}

/// Most bytes of a clip of one camera, and most frames of it, unless a specification says otherwise.
const CLIP_BYTES: usize = 3 << 20;
const CLIP_FRAMES: usize = 16;

/// Settings that [`SimSpec::from_str`] takes after the scene.
const SETTINGS: &str = "angles=, color=gray|rgb, size=N or WxH, mask=stripes|mosaic, stripes=, noise=, shot=, bits=, black=, shift=DX:DY, \
guide_gain=, guide_noise=, guide_bits=, guide_size=, guide_zoom=, guide_turn=, guide_tilt=, guide_margin=auto|N, \
surround=auto|N, surround_level=, imperfect=NAME+NAME|all, knowledge=nominal|exact, light=, polarizer=, turn=, point=X:Y, seed=, fine=, fps=, clip=auto|N";

impl FromStr for SimSpec {
    type Err = SimError;

    /// Reads `SCENE[,key=value…]`, for example `spheres,color=rgb,size=250x200,fps=5`. Live cameras render at `fine=2`
    /// unless told otherwise.
    fn from_str(text: &str) -> Result<Self, SimError> {
        let mut parts = text.split(',').map(str::trim);
        let mut spec = Self { fine: 2, ..Self::default() };
        if let Some(scene) = parts.next().filter(|s| !s.is_empty()) {
            spec.scene = scene.to_owned();
        }
        for part in parts {
            spec.set(part).ok_or_else(|| SimError::Setting { found: part.to_owned() })?;
        }
        spec.check()?;
        Ok(spec)
    }
}

impl SimSpec {
    /// Takes one `key=value`; none for an unknown key and for a value that cannot be read.
    fn set(&mut self, part: &str) -> Option<()> {
        let (key, value) = part.split_once('=')?;
        let size = || {
            let (width, height) = value.split_once('x').unwrap_or((value, value));
            Some(Size::new(width.parse().ok()?, height.parse().ok()?))
        };
        match key {
            "angles" => self.angles = value.parse().ok()?,
            "color" => self.color = [("gray", false), ("rgb", true)].iter().find(|c| c.0 == value)?.1,
            "size" => self.size = size()?,
            "mask" => self.mosaic = [("stripes", false), ("mosaic", true)].iter().find(|c| c.0 == value)?.1,
            "stripes" => self.stripes = value.parse().ok()?,
            "noise" => self.read_noise = value.parse().ok()?,
            "shot" => self.shot_noise = value.parse().ok()?,
            "bits" => self.bit_depth = value.parse().ok()?,
            "black" => self.black_level = value.parse().ok()?,
            "shift" => {
                let (dx, dy) = value.split_once(':')?;
                self.shift = [dx.parse().ok()?, dy.parse().ok()?];
            }
            "guide_gain" => self.guide_gain = value.parse().ok()?,
            "guide_noise" => self.guide_noise = value.parse().ok()?,
            "guide_bits" => self.guide_bits = value.parse().ok()?,
            "guide_size" => self.pose.size = Some(size()?),
            "guide_zoom" => self.pose.zoom = value.parse().ok()?,
            "guide_turn" => self.pose.turn_deg = value.parse().ok()?,
            "guide_tilt" => self.pose.tilt = value.parse().ok()?,
            "guide_margin" => self.guide_margin = value.parse().ok()?,
            "surround" => self.surround = value.parse().ok()?,
            "surround_level" => self.surround_level = value.parse().ok()?,
            "imperfect" => self.spoil(&value.parse().ok()?),
            "knowledge" => self.knowledge = Knowledge::ALL.into_iter().find(|kind| kind.to_string() == value)?,
            "light" => self.light = value.parse().ok()?,
            "polarizer" => self.polarizer = Some(value.parse().ok()?),
            "turn" => self.turn = value.parse().ok()?,
            "point" => {
                let (x, y) = value.split_once(':')?;
                self.point = [x.parse().ok()?, y.parse().ok()?];
            }
            "seed" => self.seed = value.parse().ok()?,
            "fine" => self.fine = value.parse().ok()?,
            "fps" => self.frame_rate = value.parse().ok()?,
            "clip" => self.clip = if value == "auto" { None } else { Some(value.parse().ok()?) },
            _ => return None,
        }
        Some(())
    }

    /// Bytes that a simulated lensless camera holds while it renders.
    pub fn raw_camera_bytes(&self) -> usize {
        let fine = Size::new(self.size.width * self.fine, self.size.height * self.fine);
        let margin = self.lit_margin();
        let field = Size::new(self.size.width + 2 * margin, self.size.height + 2 * margin);
        self.frame_bytes(self.size, 2)
            + self.band_bytes(field)
            + Convolver::bytes(fine, margin * self.fine, Caustic::radius_for(self.size, self.fine))
    }

    /// Bytes that a simulated guide camera holds while it renders.
    pub fn guide_camera_bytes(&self) -> usize {
        self.frame_bytes(self.guide_size(), 1) + self.band_bytes(self.guide_size())
    }

    /// Bytes of a frame of the raw and of the guide camera, as they deliver it.
    pub fn delivered_bytes(&self) -> [usize; 2] {
        let guide = if self.guide_bits == 8 { 1 } else { 2 };
        [2 * self.size.pixels(), guide * self.guide_size().pixels()].map(|bytes| self.channels() * bytes)
    }

    /// Frames of the clip that live cameras loop; 0 is no clip.
    pub fn clip_frames(&self) -> usize {
        let largest = self.delivered_bytes().into_iter().max().unwrap_or(0).max(1);
        // a single frame that stands still is no clip
        self.clip.unwrap_or(Some(CLIP_BYTES / largest).filter(|fit| *fit > 1).unwrap_or(0).min(CLIP_FRAMES))
    }

    /// Bytes of the signal of a frame and of `copies` of its counts.
    fn frame_bytes(&self, size: Size, copies: usize) -> usize {
        self.channels() * size.pixels() * (size_of::<f32>() + copies * size_of::<u16>())
    }

    /// Bytes of the band of a scene over `size` pixels that is being rendered.
    fn band_bytes(&self, size: Size) -> usize {
        let rows = BAND.min(size.height * self.fine);
        3 * self.channels() * size.width * self.fine * rows * size_of::<f32>()
    }

    /// Pixels beyond the frame from which light can come to the sensor, on each side.
    pub(super) fn reach(&self) -> usize {
        Caustic::reach(self.size, self.flaws.drift)
    }

    /// Pixels of the scene beyond the frame that the PSF can reach, on each side, whether or not they are lit.
    pub(super) fn surround_margin(&self) -> usize {
        match self.surround {
            Margin::Auto => self.reach(),
            Margin::Pixels(pixels) => pixels.min(self.reach()),
        }
    }

    /// Pixels beyond the frame whose light reaches the sensor, on each side.
    pub fn lit_margin(&self) -> usize {
        if self.surround_level > 0.0 { self.surround_margin() } else { 0 }
    }

    /// Pixels of the frame that the guide sees beyond it, on each side.
    pub(super) fn seen_margin(&self) -> usize {
        match self.guide_margin {
            Margin::Auto => self.reach(),
            Margin::Pixels(pixels) => pixels,
        }
    }

    /// Color channels: 1 or 3.
    pub fn channels(&self) -> usize {
        if self.color { 3 } else { 1 }
    }

    /// Angles of the mask in stripe order.
    pub fn mask_angles(&self) -> Vec<Angle> {
        if self.angles == 3 { Angle::three() } else { Angle::four() }
    }

    /// Counts at full scale.
    pub fn saturation(&self) -> u16 {
        ((1u32 << self.bit_depth) - 1) as u16
    }

    /// Size of the guide camera's frames.
    pub fn guide_size(&self) -> Size {
        let frame = self.framed_size();
        let margin = (self.seen_margin() as f64 * half(frame) / half(self.size)).round() as usize;
        Size::new(frame.width + 2 * margin, frame.height + 2 * margin)
    }

    /// Size in the guide's pixels of the part of its frames that shows the frame, of a guide that is not zoomed.
    fn framed_size(&self) -> Size {
        self.pose.size.unwrap_or(self.size)
    }

    /// The true stripes of the mask, from left to right; of a mosaic, its polarizers row by row.
    pub fn stripes(&self) -> Vec<Stripe> {
        Device::new(self).stripes
    }

    /// Homography from scene to guide pixels, row-major. A nominal guide has neither shift, zoom, rotation nor tilt.
    pub fn homography(&self, knowledge: Knowledge) -> [f64; 9] {
        let (pose, shift) = match knowledge {
            Knowledge::Nominal => (Pose { size: self.pose.size, ..Pose::default() }, [0.0; 2]),
            Knowledge::Exact => (self.pose, self.shift.map(f64::from)),
        };
        let middle = |size: Size| [0.5 * (size.width as f64 - 1.0), 0.5 * (size.height as f64 - 1.0)];
        let (from, to) = (half(self.size), half(self.framed_size()));
        let ([cx, cy], [gx, gy]) = (middle(self.size), middle(self.guide_size()));
        let (sin, cos) = pose.turn_deg.to_radians().sin_cos();
        let zoom = pose.zoom;
        let h = Matrix3::new(to, 0.0, gx, 0.0, to, gy, 0.0, 0.0, 1.0)
            * Matrix3::new(zoom * cos, -zoom * sin, 0.0, zoom * sin, zoom * cos, 0.0, pose.tilt, 0.0, 1.0)
            * Matrix3::new(1.0, 0.0, shift[0] - cx, 0.0, 1.0, shift[1] - cy, 0.0, 0.0, from);
        let h = h / h[(2, 2)];
        std::array::from_fn(|i| h[(i / 3, i % 3)])
    }

    /// The PSF a bundle holds: one plane, sum 1, zero displacement at half the size.
    pub fn psf(&self) -> Stack<f32> {
        let growth = if self.knowledge == Knowledge::Exact { self.flaws.drift } else { 0.0 };
        Caustic::new(self.size, self.fine, self.seed, growth).measured(self.size, self.fine)
    }

    /// The mask as a bundle holds it: readings under unit light polarized at each of the mask's angles, `[P, H, W]`, flaws included.
    pub fn mask(&self) -> Stack<f32> {
        let device = Device::new(self);
        let mut out = Stack::zeros(self.angles, self.size);
        for (plane, angle) in out.planes_mut().zip(self.mask_angles()) {
            let (c, s) = (angle.cos2() as f32, angle.sin2() as f32);
            for (i, value) in plane.iter_mut().enumerate() {
                let [m0, m1, m2] = device.response(i, self.size.width);
                *value = (m0 + m1 * c + m2 * s).max(0.0);
            }
        }
        out
    }

    /// Text of the bundle's `calibration.toml`. It names the arrays `psf.npy` ([`Self::psf`]) and, where [`Self::is_measured`], `mask.npy`
    /// ([`Self::mask`]) and `dark.npy` ([`Self::dark`]).
    pub fn calibration(&self) -> String {
        let angles: Vec<_> = self.mask_angles().iter().map(|a| a.degrees().to_string()).collect();
        let mut text = String::from("version = 1\n");
        // the scene may be any path
        let _ = writeln!(text, "name = {}", quoted(&format!("simulated {}", self.scene)));
        let _ = write!(
            text,
            "[sensor]\nwidth = {}\nheight = {}\nchannels = {}\nbit_depth = {}\nblack_level = {}\nsaturation = {}\n\
             [noise]\nread = {}\nshot = {}\n[psf]\nfile = \"psf.npy\"\n[mask]\n",
            self.size.width,
            self.size.height,
            self.channels(),
            self.bit_depth,
            self.black_level,
            self.saturation(),
            self.read_noise,
            self.shot_noise,
        );
        let angles = angles.join(", ");
        let _ = if self.is_measured() {
            writeln!(
                text,
                "kind = \"measured\"\nangles_deg = [{angles}]\nfile = \"mask.npy\"\n[dark]\nfile = \"dark.npy\""
            )
        } else if self.mosaic {
            writeln!(text, "kind = \"mosaic\"\nlayout = {MOSAIC:?}")
        } else {
            writeln!(text, "kind = \"stripes\"\nangles_deg = [{angles}]\nstripes = {}", self.stripes)
        };
        if self.knowledge == Knowledge::Exact || self.guide_size() != self.size {
            let numbers = self.homography(self.knowledge).map(|v| format!("{v:?}")).join(", ");
            let _ = writeln!(text, "[guide]\nhomography = [{numbers}]");
        }
        text
    }

    /// The dark frame in counts as a bundle holds it, `[H, W]`.
    pub fn dark(&self) -> Stack<f32> {
        let (black, full) = (f32::from(self.black_level), f32::from(self.saturation()));
        let device = Device::new(self);
        let mut out = Stack::zeros(1, self.size);
        for (i, counts) in out.as_mut_slice().iter_mut().enumerate() {
            *counts = black + (full - black) * device.dark.get(i).copied().unwrap_or(0.0);
        }
        out
    }

    /// Whether the bundle holds a measured mask and a dark frame, as that of an exactly known device with flaws does.
    pub fn is_measured(&self) -> bool {
        self.knowledge == Knowledge::Exact && self.flaws != Flaws::default()
    }

    /// Refuses values out of range.
    ///
    /// # Errors
    /// [`SimError::Range`] with the first of them.
    pub fn check(&self) -> Result<(), SimError> {
        let Size { width, height } = self.size;
        let far = 0.25 * width.min(height) as f32;
        let share = |v: f32| (0.0..=1.0).contains(&v);
        let image = |size: Size| [size.width, size.height].iter().all(|side| (16..=2048).contains(side));
        let flaws = &self.flaws;
        let shares = [flaws.vignetting, flaws.hot, flaws.exposure, flaws.rolling, flaws.drift];
        let wide = [flaws.angles_deg, flaws.edge_blur, flaws.dust];
        let usual = shares.into_iter().all(share)
            && wide.iter().all(|v| (0.0..=100.0).contains(v))
            && flaws.mask_shift.abs() <= far
            && flaws.extinction > 2.0;

        rule("angles", self.angles, matches!(self.angles, 3 | 4), "3 or 4")?;
        rule("size", self.size, image(self.size), "16 to 2048 each way")?;
        let each = (self.angles..=width).contains(&self.stripes);
        rule("angles", self.angles, !self.mosaic || self.angles == 4, "4 with mask=mosaic")?;
        rule("stripes", self.stripes, each, "one per angle to one per column")?;
        rule("noise", self.read_noise, share(self.read_noise), "0 to 1")?;
        rule("shot", self.shot_noise, share(self.shot_noise), "0 to 1")?;
        rule("bits", self.bit_depth, matches!(self.bit_depth, 12 | 16), "12 or 16")?;
        let black = u32::from(self.black_level) < 1 << (self.bit_depth - 1);
        rule("black", self.black_level, black, "below half of full scale")?;
        let near = self.shift.iter().all(|d| d.abs() <= far);
        rule("shift", format!("{:?}", self.shift), near, "at most a quarter of the short side")?;
        rule("guide_gain", self.guide_gain, (1e-3..=1e3).contains(&self.guide_gain), "0.001 to 1000")?;
        rule("guide_noise", self.guide_noise, share(self.guide_noise), "0 to 1")?;
        rule("guide_bits", self.guide_bits, matches!(self.guide_bits, 8 | 12), "8 or 12")?;
        rule("fine", self.fine, matches!(self.fine, 2 | 3), "2 or 3")?;
        rule("guide_size", self.framed_size(), image(self.framed_size()), "16 to 2048 each way")?;
        let near = |margin| !matches!(margin, Margin::Pixels(1025..));
        let small = [self.guide_size().width, self.guide_size().height].iter().all(|side| *side <= 4096);
        let allowed = "auto, or 0 to 1024 pixels, at most 4096 of the guide each way";
        rule("guide_margin", self.guide_margin, near(self.guide_margin) && small, allowed)?;
        rule("surround", self.surround, near(self.surround), "auto, or 0 to 1024 pixels")?;
        rule("surround_level", self.surround_level, share(self.surround_level), "0 to 1")?;
        rule("guide_zoom", self.pose.zoom, (0.25..=4.0).contains(&self.pose.zoom), "0.25 to 4")?;
        rule("guide_turn", self.pose.turn_deg, self.pose.turn_deg.abs() <= 45.0, "-45 to 45 degrees")?;
        rule("guide_tilt", self.pose.tilt, self.pose.tilt.abs() <= 0.3, "-0.3 to 0.3")?;
        rule("light", self.light, (0.0..=100.0).contains(&self.light), "0 to 100")?;
        rule("exposure", self.exposure, (1e-6..=1e6).contains(&self.exposure), "0.000001 to 1000000")?;
        rule("gain", self.gain, (1e-6..=1e6).contains(&self.gain), "0.000001 to 1000000")?;
        let polarizer = self.polarizer.unwrap_or(0.0);
        rule("polarizer", polarizer, polarizer.is_finite(), "a number of degrees")?;
        rule("turn", self.turn, self.turn.is_finite(), "a number of degrees")?;
        let allowed = "shares of 0 to 1, σ of 0 to 100, an extinction above 2";
        rule("imperfect", format!("{flaws:?}"), usual, allowed)?;
        let clip = self.clip.unwrap_or(0);
        rule("clip", clip, clip <= 1000, "auto, or 0 to 1000 frames")?;
        rule("fps", self.frame_rate, (1e-3..=1e3).contains(&self.frame_rate), "0.001 to 1000")
    }
}

/// Half of the short side of an image, in pixels.
fn half(size: Size) -> f64 {
    0.5 * size.width.min(size.height) as f64
}

/// Refuses the value `found` of a setting unless it `holds`.
fn rule(key: &'static str, found: impl fmt::Display, holds: bool, allowed: &'static str) -> Result<(), SimError> {
    if holds { Ok(()) } else { Err(SimError::Range { key, found: found.to_string(), allowed }) }
}

/// Quotes and escapes `text` as a basic string of TOML.
fn quoted(text: &str) -> String {
    let escaped = text.chars().map(|c| match c {
        '"' | '\\' => format!("\\{c}"),
        c if c.is_control() => format!("\\u{:04X}", c as u32),
        c => c.to_string(),
    });
    format!("\"{}\"", escaped.collect::<String>())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_are_read_and_refused_by_name() {
        let spec: SimSpec = "tissue,color=rgb,size=64x48,shift=-1.5:2,seed=9".parse().unwrap();
        assert_eq!((spec.channels(), spec.size, spec.shift, spec.seed), (3, Size::new(64, 48), [-1.5, 2.0], 9));
        let refused = |text: &str| text.parse::<SimSpec>().unwrap_err().to_string();
        assert!(refused("tissue,size=big").starts_with("`size=big` is no setting"));
        assert_eq!(refused("tissue,angles=5"), "angles = 5, allowed: 3 or 4");
        assert_eq!(refused("tissue,noise=nan"), "noise = NaN, allowed: 0 to 1");
        assert_eq!(refused("film,polarizer=inf"), "polarizer = inf, allowed: a number of degrees");
        assert!(refused("tissue,surround=wide").starts_with("`surround=wide` is no setting"));
        assert_eq!(
            refused("tissue,guide_margin=2000"),
            "guide_margin = 2000, allowed: auto, or 0 to 1024 pixels, at most 4096 of the guide each way"
        );
    }

    #[test]
    fn a_clip_is_bounded_by_its_bytes_and_frames() {
        let frames = |more: &str| format!("wedges,guide_margin=0,{more}").parse::<SimSpec>().unwrap().clip_frames();
        assert_eq!((frames("size=48"), frames("size=250"), frames("size=250,guide_margin=55")), (16, 16, 12));
        assert_eq!((frames("size=2048,color=rgb"), frames("size=2048,clip=7"), frames("size=48,clip=0")), (0, 7, 0));
    }

    #[test]
    fn the_homography_says_where_the_frame_lies_in_what_the_guide_sees() {
        let spec = |more: &str| format!("spheres,size=100x80,{more}").parse::<SimSpec>().unwrap();
        // sampling: (x, y) of the frame, corner of a pixel by corner of a pixel
        let mapped = |spec: &SimSpec, [x, y]: [f64; 2]| {
            let h = spec.homography(Knowledge::Nominal);
            let [u, v, w] = [0, 3, 6].map(|k| h[k] * (x - 0.5) + h[k + 1] * (y - 0.5) + h[k + 2]);
            [u / w + 0.5, v / w + 0.5]
        };
        // margin, size of the frame in the guide's pixels, and the guide's own margin
        for (more, (width, height), margin) in [
            ("guide_margin=0", (100.0, 80.0), 0.0),
            ("guide_margin=12", (100.0, 80.0), 12.0),
            ("guide_margin=12,guide_size=150x120", (150.0, 120.0), 18.0),
            // .44 of the short side is the PSF's diameter
            ("guide_margin=auto", (100.0, 80.0), 18.0),
        ] {
            let spec = spec(more);
            let size = spec.guide_size();
            assert_eq!(
                (size.width as f64, size.height as f64),
                (width + 2.0 * margin, height + 2.0 * margin),
                "{more}"
            );
            for corner in [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]] {
                let [x, y] = mapped(&spec, [100.0 * corner[0], 80.0 * corner[1]]);
                let [u, v] = [margin + width * corner[0], margin + height * corner[1]];
                assert!((x - u).abs() < 1e-9 && (y - v).abs() < 1e-9, "{more}: {x} {y}, {u} {v}");
            }
            assert_eq!(spec.calibration().contains("homography"), size != spec.size, "{more}");
        }
    }
}
