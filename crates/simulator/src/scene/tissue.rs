use super::{Color, Texture, mix, polarized, ramp};

/// A moist, depolarizing tissue: two layers of fibres that follow a bent flow, vessels, wet highlights. Light that comes
/// back from the depth is depolarized; fibres near the surface keep up to a fifth of it.
pub(super) struct Tissue {
    flow: [Texture; 2],
    grain: Texture,
    vessels: Texture,
    pulse: f32,
    drift: f32,
}

/// Fibres per unit of the flow's stream function.
const FIBRES: [f32; 2] = [44.0, 34.0];

impl Tissue {
    pub(super) fn at(seed: u64, time: f32) -> Self {
        Self {
            flow: [Texture::new(seed, 20), Texture::new(seed, 21)],
            grain: Texture::new(seed, 22),
            vessels: Texture::new(seed, 23),
            pulse: (5.0 * time).sin(),
            drift: 0.06 * time,
        }
    }

    pub(super) fn stokes(&self, [u, v]: [f32; 2]) -> Color {
        // breathing and heartbeat: the tissue stretches a little and drifts
        let beat = 1.0 + 0.006 * self.pulse;
        let (x, y) = (u * beat + self.drift, v * beat + 0.3 * self.drift);
        let vein = self.vessel(x, y, 1.5, 0.075) + 0.7 * self.vessel(x + 7.0, y, 3.4, 0.07);
        let vein = vein.min(1.0) * (1.0 + 0.12 * self.pulse);
        let mottle = self.grain.fractal(2.0 * x, 2.0 * y, 5);

        let (lower, lower_axis) = self.fibres(0, x, y);
        let (upper, upper_axis) = self.fibres(1, x, y);
        let cover = ramp(-0.25, 0.35, self.grain.smooth(1.3 * x + 11.0, 1.3 * y));
        let base = 0.62 + 0.20 * mottle + 0.10 * (lower - 0.5) * (1.0 - cover) + 0.15 * (upper - 0.5) * cover;
        let light = (1.0 - 0.22 * ((u + 0.2).powi(2) + (v - 0.2).powi(2)).min(2.0)) * base.max(0.06);

        // flesh: blood takes green and blue, fibres are paler
        let pale = 0.35 * upper * cover;
        let flesh = [1.12, 0.84 + pale * 0.35, 0.76 + pale * 0.4];
        let blood = [0.88, 0.40, 0.44];
        let albedo: [f32; 3] = std::array::from_fn(|c| light * flesh[c] * (1.0 + vein * (blood[c] - 1.0)));

        let tissue: Color = std::array::from_fn(|c| {
            // the less a colour is scattered in the depth, the more of it is still polarized
            let depth = [0.75, 1.0, 1.1][c] * (1.0 - 0.7 * vein);
            let a = polarized(albedo[c] * (1.0 - cover), depth * (0.015 + 0.12 * lower), lower_axis);
            let b = polarized(albedo[c] * cover, depth * (0.02 + 0.17 * upper), upper_axis);
            [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
        });
        let (shine, slope) = self.wet(x, y);
        let gloss = [1.0; 3].map(|s0| polarized(s0, 0.22, [-slope[1], slope[0]]));
        mix(tissue, gloss, shine)
    }

    /// Strength (0 to 1) and direction of the fibres of one layer: thin threads along the level lines of a stream
    /// function, frayed by noise.
    fn fibres(&self, layer: usize, x: f32, y: f32) -> (f32, [f32; 2]) {
        let texture = self.flow[layer];
        let lean = [0.9, -0.55][layer];
        let stream = |x: f32, y: f32| {
            y + lean * x + 0.55 * texture.smooth(1.1 * x, 1.1 * y) + 0.13 * texture.smooth(3.1 * x + 5.0, 3.1 * y)
        };
        let (h, here) = (0.01, stream(x, y));
        let (gx, gy) = ((stream(x + h, y) - here) / h, (stream(x, y + h) - here) / h);
        let along = [-gy, gx];
        // coordinates along and across the threads
        let (s, n) = (here * FIBRES[layer], x - lean * y);
        let fray = self.grain.smooth(0.35 * s, 2.6 * n + 17.0 * layer as f32);
        let thread = 0.5 + 0.5 * (std::f32::consts::TAU * (0.5 * s + 0.45 * fray)).sin();
        // threads differ, and lie in bundles
        let bundle = (0.62
            + 0.30 * self.grain.smooth(0.17 * s + 40.0, 0.9 * n)
            + 0.28 * self.grain.smooth(0.9 * s, 1.3 * n + 9.0))
        .clamp(0.0, 1.0);
        (thread.powf(1.4) * bundle, along)
    }

    /// 1 on a vessel: the zero lines of noise are branching curves.
    fn vessel(&self, x: f32, y: f32, frequency: f32, width: f32) -> f32 {
        let bend = 0.25 * self.grain.smooth(3.0 * x, 3.0 * y);
        let n = self.vessels.fractal(frequency * x + bend, frequency * y - bend, 2);
        let thickness = width * (0.6 + 0.4 * self.grain.smooth(1.7 * x - 3.0, 1.7 * y));
        ramp(thickness, 0.25 * thickness, n.abs())
    }

    /// Share and slope of the wet film's mirror image of the lamp.
    fn wet(&self, x: f32, y: f32) -> (f32, [f32; 2]) {
        let film = |x: f32, y: f32| self.vessels.fractal(4.0 * x + 60.0, 4.0 * y, 3);
        let (h, here) = (0.008, film(x, y));
        let slope = [(film(x + h, y) - here) / h, (film(x, y + h) - here) / h];
        let miss = (slope[0] - 2.6).hypot(slope[1] + 1.8);
        (0.75 * ramp(0.9, 0.0, miss), slope)
    }
}
