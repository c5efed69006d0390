use std::f32::consts::{FRAC_PI_4, PI, TAU};

use super::{Color, Stokes, Texture, mix, physical, ramp, rotate, rounded, scale};
use stokescope_core::image::Complex32;

/// Wavelengths of the three channels relative to green: fringes lie wider apart in red.
const WAVELENGTH: [f32; 3] = [1.13, 1.0, 0.86];
/// Direction of the light table's polarization.
const LIGHT: f32 = FRAC_PI_4;
const LIGHT_DOLP: f32 = 0.95;
/// Order at which fringes have lost most contrast: the channels are not monochromatic.
const COHERENCE: f32 = 7.0;

/// Plastic parts under changing load on a light table of linearly polarized light. Without an analyser S0 shows next to
/// nothing of the stress; the polarization shows all of it.
pub(super) struct Plastic {
    grain: Texture,
    flow: [Texture; 2],
    load: f32,
    pull: f32,
    turn: f32,
}

impl Plastic {
    pub(super) fn at(seed: u64, time: f32) -> Self {
        Self {
            grain: Texture::new(seed, 0),
            flow: [Texture::new(seed, 1), Texture::new(seed, 2)],
            load: 1.0 + 0.45 * (0.9 * time).sin(),
            pull: 1.0 + 0.4 * (0.7 * time + 1.0).sin(),
            turn: 0.30 + 0.12 * (0.4 * time).sin(),
        }
    }

    pub(super) fn stokes(&self, [u, v]: [f32; 2]) -> Color {
        let mut seen = self.table(u, v);
        seen = self.part(seen, [u, v], self.ruler(u, v), [0.93, 0.96, 1.0]);
        seen = self.part(seen, [u, v], self.disc(u, v), [1.0, 0.97, 0.90]);
        seen = self.part(seen, [u, v], self.plate(u, v), [0.92, 1.0, 0.95]);
        self.jaws(seen, u, v)
    }

    /// The light table: one lamp behind its middle, faint squares printed on its diffuser.
    fn table(&self, u: f32, v: f32) -> Color {
        let fall = 0.98 * (-0.9 * (u * u + v * v)).exp();
        let line = |x: f32, pitch: f32, width: f32| {
            let d = (x / pitch - (x / pitch).round()).abs() * pitch;
            ramp(width, 0.3 * width, d)
        };
        let print = 1.0
            - 0.10 * line(u, 0.125, 0.007).max(line(v, 0.125, 0.007))
            - 0.10 * line(u, 0.5, 0.009).max(line(v, 0.5, 0.009));
        let s0 = fall * print * (1.0 + 0.03 * self.grain.fractal(9.0 * u, 9.0 * v, 3));
        let (sin, cos) = (2.0 * LIGHT).sin_cos();
        [1.0, 0.98, 0.95].map(|tint| [s0 * tint, s0 * tint * LIGHT_DOLP * cos, s0 * tint * LIGHT_DOLP * sin])
    }

    /// Passes light through a clear part: `edge` is the distance to its outline (negative inside), `stress` its
    /// retardance in green waves times e^(2iψ), ψ the direction of the greater principal stress; asked for where it is seen.
    fn part(
        &self,
        light: Color,
        [u, v]: [f32; 2],
        (edge, stress): (f32, impl FnOnce() -> Complex32),
        tint: [f32; 3],
    ) -> Color {
        if edge > 0.03 {
            return light;
        }
        let stress = stress();
        let order = stress.norm();
        let axis = if order > 1e-6 { stress / order } else { Complex32::new(1.0, 0.0) };
        // rounded rims bend the light away: a dark outline with a bright line inside, blurred surface polish
        let rim = 1.0 - 0.62 * (-(edge / 0.012).powi(2)).exp() + 0.42 * (-((edge + 0.034) / 0.011).powi(2)).exp();
        let polish = 1.0 + 0.05 * self.grain.fractal(5.0 * u + 40.0, 5.0 * v, 4) + 0.05 * self.scratches(u, v);
        let inside: Color = std::array::from_fn(|c| {
            let [s0, s1, s2]: Stokes = light[c];
            let waves = order / WAVELENGTH[c];
            let (sin, cos) = ((TAU * waves).sin(), (TAU * waves).cos());
            let contrast = (-(waves / COHERENCE).powi(2)).exp();
            // in the frame of the axes the parallel part stays, the diagonal one turns into circular light and back
            let turned = Complex32::new(s1, s2) * axis.conj();
            let out = Complex32::new(turned.re, turned.im * cos * contrast) * axis;
            // a little of S0 follows: surfaces reflect the two principal directions differently
            let s0 = s0 * (1.0 + 0.02 * sin * contrast);
            [s0, out.re, out.im].map(|k| k * tint[c] * rim * polish)
        });
        mix(light, inside.map(physical), ramp(0.006, -0.006, edge)).map(|s| {
            let shadow = 1.0 - 0.25 * ramp(0.03, 0.0, edge.max(0.0));
            s.map(|k| k * shadow)
        })
    }

    /// Hairline scratches: thin level lines of stretched noise.
    fn scratches(&self, u: f32, v: f32) -> f32 {
        let n = self.flow[0].smooth(2.0 * u + 14.0 * v, 23.0 * v - 9.0 * u);
        ramp(0.035, 0.0, n.abs())
    }

    fn disc_place(&self, u: f32, v: f32) -> [f32; 2] {
        rotate([u + 0.42, v - 0.40], -self.turn)
    }

    /// A disc between two jaws (Frocht's solution for diametral compression).
    fn disc(&self, u: f32, v: f32) -> (f32, impl FnOnce() -> Complex32) {
        const R: f32 = 0.46;
        let [x, y] = self.disc_place(u, v);
        let stress = move || {
            let (below, above) = (R - y, R + y);
            // a contact has a width; the point load's pole would be no picture
            let r1 = (x * x + below * below).max(0.0016);
            let r2 = (x * x + above * above).max(0.0016);
            let (q1, q2) = (below / (r1 * r1), above / (r2 * r2));
            let sx = -(q1 * x * x + q2 * x * x - 0.5 / R);
            let sy = -(q1 * below * below + q2 * above * above - 0.5 / R);
            let txy = q1 * below * x - q2 * above * x;
            Complex32::new(sx - sy, 2.0 * txy) * (0.42 * self.load) * Complex32::cis(2.0 * self.turn)
        };
        (x.hypot(y) - R, stress)
    }

    /// A pulled plate with a hole (Kirsch's solution) and the bending its grip adds.
    fn plate(&self, u: f32, v: f32) -> (f32, impl FnOnce() -> Complex32) {
        const A: f32 = 0.13;
        let [x, y] = [u - 0.56, v - 0.24];
        let outline = rounded([x, y], [0.30, 0.84], 0.08);
        let hole = x.hypot(y);
        let stress = move || {
            let (k, r) = ((A * A / (x * x + y * y)).min(1.0), hole.max(A));
            // polar angle from the direction of the pull, which is up
            let (c, s) = (y / r, -x / r);
            let (c2, s2) = (c * c - s * s, 2.0 * c * s);
            let sr = 0.5 * (1.0 - k) + 0.5 * (1.0 + 3.0 * k * k - 4.0 * k) * c2;
            let st = 0.5 * (1.0 + k) - 0.5 * (1.0 + 3.0 * k * k) * c2;
            let trt = -0.5 * (1.0 - 3.0 * k * k + 2.0 * k) * s2;
            // from polar to the plate's frame, whose first axis is up
            let radial = Complex32::new(sr - st, 2.0 * trt) * Complex32::new(c2, s2);
            let bend = 0.75 * x / 0.30;
            let up = Complex32::cis(PI);
            (radial * (1.15 * self.pull) + bend) * up
        };
        (outline.max(A - hole), stress)
    }

    /// A moulded ruler: frozen stress that streams out of the gate at its left end.
    fn ruler(&self, u: f32, v: f32) -> (f32, impl FnOnce() -> Complex32) {
        let [x, y] = rotate([u + 0.12, v + 0.62], -0.16);
        let edge = rounded([x, y], [0.80, 0.17], 0.05).max(0.045 - (x - 0.70).hypot(y));
        let stress = move || {
            let (gx, gy) = (x + 0.86, y);
            let r = gx.hypot(gy).max(0.05);
            let radial = Complex32::new(gx, gy) / r;
            let stream = radial * radial * (0.42 / r.powf(0.8));
            let frozen =
                Complex32::new(self.flow[0].fractal(2.2 * x, 4.0 * y, 2), self.flow[1].fractal(2.2 * x, 4.0 * y, 2));
            let squeezed = 1.1 * (y / 0.17).powi(2) * ramp(0.9, 0.3, x.abs());
            (stream + frozen * 0.7 + squeezed) * Complex32::cis(0.32)
        };
        (edge, stress)
    }

    /// Steel jaws that press the disc, and the marks printed on the ruler: they hide what is behind them.
    fn jaws(&self, light: Color, u: f32, v: f32) -> Color {
        let [x, y] = self.disc_place(u, v);
        let edge = rounded([x, y.abs() - 0.545], [0.15, 0.09], 0.02);
        let light = if edge < 0.004 {
            let brushed = 0.5 + 0.35 * self.grain.fractal(3.0 * x, 60.0 * y, 2);
            let sheen = 0.10 + 0.14 * brushed + 0.25 * (-((x + 0.05) / 0.04).powi(2)).exp();
            let steel =
                [1.0, 1.02, 1.06].map(|tint| super::polarized(sheen * tint, 0.18, rotate([1.0, 0.0], self.turn)));
            mix(light, steel, ramp(0.004, -0.004, edge))
        } else {
            light
        };

        let [x, y] = rotate([u + 0.12, v + 0.62], -0.16);
        let number = (x / 0.04).round();
        let long = if number.rem_euclid(5.0) == 0.0 { 0.075 } else { 0.04 };
        let mark = (x.abs() < 0.62 && y < 0.155 && y > 0.155 - long && (x - number * 0.04).abs() < 0.0055) as u8;
        scale(light, 1.0 - 0.85 * f32::from(mark))
    }
}
