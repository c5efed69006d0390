use std::f32::consts::{PI, TAU};

use super::{Color, Texture, behind_film, mix, ramp, rotate, rounded};

/// Polarizer film cut into sectors and strips on an unpolarized light table with a printed page.
pub(super) struct Wedges {
    page: Texture,
    film: Texture,
    time: f32,
}

impl Wedges {
    pub(super) fn at(seed: u64, time: f32) -> Self {
        Self { page: Texture::new(seed, 10), film: Texture::new(seed, 11), time }
    }

    pub(super) fn stokes(&self, [u, v]: [f32; 2]) -> Color {
        let mut seen = self.page(u, v);
        seen = self.wheel(seen, [u + 0.26, v - 0.20], 0.70, 12.0, 0.25 * self.time);
        seen = self.wheel(seen, [u - 0.50, v + 0.46], 0.42, 8.0, -0.40 * self.time);
        // a strip swings over both
        let angle = 0.62 + 0.2 * (0.5 * self.time).sin();
        let place = rotate([u - 0.30, v - 0.34], -angle);
        seen = self.sheet(seen, rounded(place, [0.62, 0.10], 0.02), place, angle);
        // four loose squares at the angles of the mask
        for k in 0..4 {
            let place = [u + 0.86 - 0.25 * k as f32, v + 0.80];
            seen = self.sheet(seen, rounded(place, [0.095, 0.095], 0.01), place, k as f32 * PI / 4.0);
        }
        seen
    }

    /// A lit page: paper grain, lines of words, a fall-off towards the corners.
    fn page(&self, u: f32, v: f32) -> Color {
        let (pitch, em) = (0.075, 0.021);
        let line = (v / pitch).floor();
        let within = v / pitch - line;
        let column = (u / em).floor();
        let (i, j) = (column as i32, line as i32);
        // letters are dark where the noise says so; words end where a slower noise does
        let word = self.page.smooth(0.23 * column, 7.0 * line) > -0.25;
        let stroke = self.page.cell(i, j) * 0.5 + self.page.smooth(u / em * 2.3, v / em * 2.1) > -0.1;
        let letter = within > 0.28 && within < 0.72 && word && stroke && line.rem_euclid(6.0) != 0.0;
        let grain = 1.0 + 0.05 * self.film.fractal(14.0 * u, 14.0 * v, 4);
        let s0 = (0.93 - 0.16 * (u * u + v * v).min(2.0)) * grain * if letter { 0.30 } else { 1.0 };
        [1.0, 0.97, 0.90].map(|tint| [s0 * tint, 0.0, 0.0])
    }

    /// A disc of `count` sectors whose polarizer axes point outwards.
    fn wheel(&self, light: Color, place: [f32; 2], radius: f32, count: f32, turn: f32) -> Color {
        let [x, y] = rotate(place, -turn);
        let r = x.hypot(y);
        let edge = (r - radius).max(0.10 - r);
        if edge > 0.02 {
            return light;
        }
        let sector = (y.atan2(x) / TAU * count).round();
        let middle = sector * TAU / count;
        // the gap between two cut sectors
        let (sin, cos) = middle.sin_cos();
        let across = (y * cos - x * sin).abs();
        let gap = r * (PI / count).sin() - across;
        self.sheet(light, edge.max(0.004 - gap), [x, y], middle + turn)
    }

    /// Lays a sheet of film with its axis at `axis` over the light; `edge` is the distance to its outline.
    fn sheet(&self, light: Color, edge: f32, [x, y]: [f32; 2], axis: f32) -> Color {
        if edge > 0.02 {
            return light;
        }
        let handled = 1.0 - 0.05 * ramp(0.2, 0.7, self.film.fractal(6.0 * x + 31.0, 6.0 * y, 3));
        let rim = 1.0 - 0.45 * (-(edge / 0.006).powi(2)).exp();
        let film = [0.90, 0.92, 0.86].map(|t| t * handled * rim);
        let through = std::array::from_fn(|c| behind_film(light[c], axis, film[c]));
        mix(light, through, ramp(0.003, -0.003, edge))
    }
}
