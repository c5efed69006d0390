//! Scenes: linear Stokes images as functions of place and time.
//!
//! Place is (u, v), u to the right and v *up*, with -1 to 1 over the short side, so that angles run counter-clockwise as the
//! camera sees them. S0 is 0 to 1, |S1 + iS2| ≤ S0.

mod images;
mod plastic;
mod spheres;
mod target;
mod texture;
mod tissue;
mod wedges;

use nalgebra::{Matrix3, Vector3};

pub use images::{SceneError, SceneReader};
pub use target::TARGETS;

pub(super) use self::target::{Lamp, Target};
use self::{images::Images, plastic::Plastic, spheres::Spheres, texture::Texture, tissue::Tissue, wedges::Wedges};
use stokescope_core::image::{Size, Stack};

/// The built-in scenes: name and what they show.
pub const SCENES: &[(&str, &str)] = &[
    ("plastic", "stressed plastic on a polarized light table: isochromatic and isoclinic fringes, DoLP up to 0.95"),
    ("spheres", "glossy balls on a polished table: Fresnel reflections, all angles, every DoLP"),
    ("wedges", "sectors of polarizer film on a light table: flat areas of DoLP 1 and 0, crossed polarizers"),
    ("tissue", "a depolarizing tissue with fine fibres of DoLP below 0.2"),
];

/// S0, S1, S2.
type Stokes = [f32; 3];
/// Stokes vectors in red, green and blue.
type Color = [Stokes; 3];

/// The places at which a scene is sampled.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Grid {
    /// Number of samples.
    pub(super) size: Size,
    /// Size of the fine image of the lensless camera.
    pub(super) frame: Size,
    /// Samples before the first one of that image, to the left and above.
    pub(super) margin: usize,
    /// Maps a sample to a pixel of that image; none where samples are its pixels.
    pub(super) map: Option<Matrix3<f32>>,
    /// Number of the first row, where only a band of rows is sampled.
    pub(super) top: usize,
}

impl Grid {
    /// The pixels of the fine image itself.
    pub(super) fn frame(frame: Size) -> Self {
        Self::field(frame, 0)
    }

    /// The pixels of the fine image, and `margin` beyond it on each side.
    pub(super) fn field(frame: Size, margin: usize) -> Self {
        let size = Size::new(frame.width + 2 * margin, frame.height + 2 * margin);
        Self { size, frame, margin, map: None, top: 0 }
    }

    /// Position of sample (x, y) in pixels of the fine image.
    fn position(&self, x: usize, y: usize) -> [f32; 2] {
        let (x, y) = (x as f32 - self.margin as f32, (self.top + y) as f32 - self.margin as f32);
        let Some(map) = &self.map else { return [x, y] };
        let at = map * Vector3::new(x, y, 1.0);
        [at.x / at.z, at.y / at.z]
    }

    /// Place of sample (x, y).
    fn place(&self, x: usize, y: usize) -> [f32; 2] {
        let Size { width, height } = self.frame;
        let unit = 2.0 / width.min(height) as f32;
        let [x, y] = self.position(x, y);
        [(x + 0.5 - 0.5 * width as f32) * unit, (0.5 * height as f32 - (y + 0.5)) * unit]
    }
}

/// A scene ready to be sampled.
pub(super) enum Scene {
    Plastic(u64),
    Spheres(u64),
    Wedges(u64),
    Tissue(u64),
    Images(Images),
    /// A calibration target, the size of the sensor and the seed.
    Target(Target, Size, u64),
}

impl Scene {
    /// The built-in scene `name`, or the measured one that `read` returns, resized to the samples of `field`.
    pub(super) fn load(name: &str, field: Grid, seed: u64, read: SceneReader<'_>) -> Result<Self, SceneError> {
        Ok(match name {
            "plastic" => Self::Plastic(seed),
            "spheres" => Self::Spheres(seed),
            "wedges" => Self::Wedges(seed),
            "tissue" => Self::Tissue(seed),
            _ => Self::Images(Images::new(name, &read(name)?, field)?),
        })
    }

    /// Fills `out` with S0, S1, S2 of each channel (green alone, or red, green, blue) at `time` seconds. A target is lit by `lamp`.
    pub(super) fn sample(&self, time: f32, grid: Grid, lamp: &Lamp, out: &mut Stack<f32>) {
        match self {
            &Self::Target(target, size, seed) => target.sample(lamp, size, seed, grid, out),
            &Self::Plastic(seed) => {
                let it = Plastic::at(seed, time);
                fill(grid, out, |place| it.stokes(place));
            }
            &Self::Spheres(seed) => {
                let it = Spheres::at(seed, time);
                fill(grid, out, |place| it.stokes(place));
            }
            &Self::Wedges(seed) => {
                let it = Wedges::at(seed, time);
                fill(grid, out, |place| it.stokes(place));
            }
            &Self::Tissue(seed) => {
                let it = Tissue::at(seed, time);
                fill(grid, out, |place| it.stokes(place));
            }
            Self::Images(images) => images.sample(grid, out),
        }
    }

    /// Whether the diffuser is off.
    pub(super) fn without_diffuser(&self) -> bool {
        matches!(self, Self::Target(Target::Uniform, ..))
    }
}

/// Evaluates a scene everywhere and keeps it physical.
fn fill(grid: Grid, out: &mut Stack<f32>, scene: impl Fn([f32; 2]) -> Color) {
    fill_with(grid, out, physical, scene);
}

/// Evaluates a scene everywhere, each value passed through `limit`.
fn fill_with(grid: Grid, out: &mut Stack<f32>, limit: impl Fn(Stokes) -> Stokes, scene: impl Fn([f32; 2]) -> Color) {
    let pixels = grid.size.pixels();
    let first = if out.count() == 3 { 1 } else { 0 };
    let planes = out.as_mut_slice();
    for y in 0..grid.size.height {
        for x in 0..grid.size.width {
            let color = scene(grid.place(x, y));
            let i = y * grid.size.width + x;
            for (channel, stokes) in planes.chunks_exact_mut(3 * pixels).zip(&color[first..]) {
                let [s0, s1, s2] = limit(*stokes);
                (channel[i], channel[pixels + i], channel[2 * pixels + i]) = (s0, s1, s2);
            }
        }
    }
}

/// Limits S0 to 0 to 1 and the DoLP to 1. Light above full scale keeps its DoLP.
fn physical([s0, s1, s2]: Stokes) -> Stokes {
    let limited = s0.clamp(0.0, 1.0);
    let keep = if s0 > 0.0 { limited / s0.max(s1.hypot(s2)) } else { 0.0 };
    [limited, s1 * keep, s2 * keep]
}

/// Light of intensity `s0`, polarized to the degree `dolp` along the direction (x, y).
fn polarized(s0: f32, dolp: f32, [x, y]: [f32; 2]) -> Stokes {
    let norm = (x * x + y * y).max(1e-12);
    [s0, s0 * dolp * (x * x - y * y) / norm, s0 * dolp * 2.0 * x * y / norm]
}

/// Light behind a polarizer film along `axis`, whose transmission of parallel light is `transmission`.
fn behind_film([s0, s1, s2]: Stokes, axis: f32, transmission: f32) -> Stokes {
    let (sin, cos) = (2.0 * axis).sin_cos();
    let through = 0.5 * transmission * (s0 + s1 * cos + s2 * sin);
    [through, 0.995 * through * cos, 0.995 * through * sin]
}

fn mix(a: Color, b: Color, weight: f32) -> Color {
    std::array::from_fn(|c| std::array::from_fn(|k| a[c][k] + weight * (b[c][k] - a[c][k])))
}

fn scale(color: Color, by: f32) -> Color {
    color.map(|stokes| stokes.map(|v| v * by))
}

/// Smooth step: 0 below `from`, 1 above `to`.
fn ramp(from: f32, to: f32, x: f32) -> f32 {
    let t = ((x - from) / (to - from)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

fn rotate([x, y]: [f32; 2], angle: f32) -> [f32; 2] {
    let (sin, cos) = angle.sin_cos();
    [cos * x - sin * y, sin * x + cos * y]
}

/// Distance to a rectangle of half-sizes `half` with rounded corners; negative inside.
fn rounded([x, y]: [f32; 2], half: [f32; 2], radius: f32) -> f32 {
    let (dx, dy) = (x.abs() - half[0] + radius, y.abs() - half[1] + radius);
    dx.max(0.0).hypot(dy.max(0.0)) + dx.max(dy).min(0.0) - radius
}

#[cfg(test)]
mod tests {
    use super::*;

    const LAMP: Lamp = Lamp { light: 1.0, point: 1.0, offset: [0; 2], polarizer: None };

    fn sampled(name: &str, channels: usize, time: f32, shift: [f32; 2]) -> Stack<f32> {
        let size = Size::new(96, 80);
        let mut out = Stack::zeros(3 * channels, size);
        let map = Matrix3::new(1.0, 0.0, -shift[0], 0.0, 1.0, -shift[1], 0.0, 0.0, 1.0);
        let grid = Grid::frame(size);
        Scene::load(name, grid, 1, &|_| unreachable!("a built-in scene")).unwrap().sample(
            time,
            Grid { map: Some(map), ..grid },
            &LAMP,
            &mut out,
        );
        out
    }

    #[test]
    fn every_scene_is_physical_bright_enough_polarized_and_moves() {
        for (name, _) in SCENES {
            let (now, later) = (sampled(name, 3, 0.0, [0.0; 2]), sampled(name, 3, 1.0, [0.0; 2]));
            for channel in 0..3 {
                let [s0, s1, s2] = [0, 1, 2].map(|k| now.plane(3 * channel + k));
                let mean = s0.iter().sum::<f32>() / s0.len() as f32;
                assert!((0.2..0.6).contains(&mean), "{name}: mean S0 {mean}");
                let mut dolp = 0.0f32;
                for ((s0, s1), s2) in s0.iter().zip(s1).zip(s2) {
                    assert!((0.0..=1.0).contains(s0) && s1.hypot(*s2) <= s0 * 1.0001, "{name}: {s0} {s1} {s2}");
                    dolp = dolp.max(s1.hypot(*s2) / s0.max(0.05));
                }
                assert!(dolp > 0.1, "{name}: DoLP up to {dolp}");
            }
            assert_ne!(now, later, "{name}");
        }
    }

    #[test]
    fn measured_scenes_have_three_components_of_one_or_three_channels() {
        let size = Size::new(16, 16);
        let read = |planes| {
            Scene::load("mine", Grid::frame(size), 1, &|_| {
                Ok(Stack::from_vec(planes, size, vec![0.5; planes * 256]).unwrap())
            })
        };
        assert!(read(3).is_ok() && read(9).is_ok());
        assert!(matches!(read(4), Err(SceneError::Planes { found: 4, .. })));
    }

    #[test]
    fn one_channel_is_the_green_one() {
        let (gray, rgb) = (sampled("plastic", 1, 0.3, [0.0; 2]), sampled("plastic", 3, 0.3, [0.0; 2]));
        assert_eq!(gray.plane(2), rgb.plane(5));
    }

    #[test]
    fn a_shift_moves_the_image_right_and_down() {
        let (here, there) = (sampled("spheres", 1, 0.0, [0.0; 2]), sampled("spheres", 1, 0.0, [3.0, 5.0]));
        let differ =
            |x: usize, y: usize| (here.plane(0)[y * 96 + x] - there.plane(0)[(y + 5) * 96 + x + 3]).abs() > 1e-3;
        let wrong = (0..70 * 90).filter(|i| differ(i % 90, i / 90)).count();
        assert!(wrong < 70, "only rounding at edges may differ: {wrong}");
    }

    #[test]
    fn films_obey_malus() {
        let parallel = behind_film([1.0, 0.0, 0.0], 0.3, 1.0);
        let crossed = behind_film(parallel, 0.3 + std::f32::consts::FRAC_PI_2, 1.0);
        assert!((parallel[0] - 0.5).abs() < 1e-6 && crossed[0] < 2e-3, "{parallel:?} {crossed:?}");
    }
}
