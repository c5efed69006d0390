//! Calibration targets: simple scenes under a lamp that can be dimmed, behind a polarizer that can be turned.

use super::{Grid, Stokes, fill_with, ramp, texture::Texture};
use stokescope_core::image::{Size, Stack};
use stokescope_core::polarization::Angle;

/// The calibration targets: name and what they show.
pub const TARGETS: &[(&str, &str)] = &[
    ("dark", "the lens covered"),
    ("point", "a point source, one pixel wide"),
    ("uniform", "uniform light without the diffuser, behind a polarizer if there is one"),
    ("film", "a disc of uniform light, behind a polarizer if there is one"),
    ("print", "a printed pattern of irregular blots, unpolarized"),
];

/// The light on a target.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(in super::super) struct Lamp {
    /// Brightness, 1 is usual.
    pub(in super::super) light: f32,
    /// Brightness of the point source at `light` 1, in full scale.
    pub(in super::super) point: f32,
    /// Place of the point source in pixels from the middle one, to the right and down.
    pub(in super::super) offset: [i32; 2],
    /// Angle of the polarizer in front of the lamp, if there is one.
    pub(in super::super) polarizer: Option<Angle>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in super::super) enum Target {
    Dark,
    Point,
    Uniform,
    Film,
    Print,
}

impl Target {
    /// The target called `name`.
    pub(in super::super) fn named(name: &str) -> Option<Self> {
        let all = [Self::Dark, Self::Point, Self::Uniform, Self::Film, Self::Print];
        TARGETS.iter().zip(all).find(|((known, _), _)| *known == name).map(|(_, target)| target)
    }

    /// Fills `out`, three planes per channel, for a sensor of `size` pixels.
    pub(in super::super) fn sample(self, lamp: &Lamp, size: Size, seed: u64, grid: Grid, out: &mut Stack<f32>) {
        let unit = 2.0 / size.width.min(size.height) as f32;
        let behind = |s0: f32| match lamp.polarizer {
            Some(axis) => [s0, s0 * axis.cos2() as f32, s0 * axis.sin2() as f32],
            None => [s0, 0.0, 0.0],
        };
        let (large, small) = (Texture::new(seed, 40), Texture::new(seed, 41));
        let scene = |[u, v]: [f32; 2]| -> Stokes {
            match self {
                Self::Dark => [0.0; 3],
                Self::Point => {
                    let pixel =
                        |at: f32, side: usize| (at / unit + 0.5 * side as f32).floor() as i32 - (side / 2) as i32;
                    let here = [pixel(u, size.width), pixel(-v, size.height)] == lamp.offset;
                    [if here { lamp.point * lamp.light } else { 0.0 }, 0.0, 0.0]
                }
                Self::Uniform => behind(0.7 * lamp.light),
                Self::Film if u.hypot(v) < 0.6 => behind(0.8 * lamp.light),
                Self::Film => [0.03 * lamp.light, 0.0, 0.0],
                Self::Print => {
                    let ink = large.smooth(6.0 * u, 6.0 * v) + 0.7 * small.smooth(15.0 * u, 15.0 * v);
                    [lamp.light * (0.08 + 0.72 * ramp(-0.15, 0.15, ink)), 0.0, 0.0]
                }
            }
        };
        fill_with(grid, out, |stokes| stokes, |place| [scene(place); 3]);
    }
}
