/// Seeded value noise on an endless lattice: the same place always has the same value.
#[derive(Clone, Copy, Debug)]
pub(super) struct Texture(u32);

impl Texture {
    /// Texture number `layer` of a scene.
    pub(super) fn new(seed: u64, layer: u32) -> Self {
        Self((seed ^ (seed >> 32)) as u32 ^ layer.wrapping_mul(0x9E37_79B9))
    }

    /// Uniform -1 to 1 per lattice cell.
    pub(super) fn cell(self, x: i32, y: i32) -> f32 {
        let mut h = self.0 ^ (x as u32).wrapping_mul(0x85EB_CA6B) ^ (y as u32).wrapping_mul(0xC2B2_AE35);
        h = (h ^ (h >> 15)).wrapping_mul(0x2C1B_3C6D);
        h = (h ^ (h >> 12)).wrapping_mul(0x297A_2D39);
        h ^= h >> 15;
        h as f32 * (2.0 / u32::MAX as f32) - 1.0
    }

    /// Smooth noise with features of size 1, -1 to 1.
    pub(super) fn smooth(self, x: f32, y: f32) -> f32 {
        // truncation and a correction: `floor` is a call into libm where the processor is not known to have it
        let floor = |a: f32| a as i32 - i32::from(a < 0.0);
        let (i, j) = (floor(x), floor(y));
        let (fx, fy) = (x - i as f32, y - j as f32);
        let fade = |t: f32| t * t * t * (t * (6.0 * t - 15.0) + 10.0);
        let (wx, wy) = (fade(fx), fade(fy));
        let top = self.cell(i, j) * (1.0 - wx) + self.cell(i.wrapping_add(1), j) * wx;
        let j = j.wrapping_add(1);
        let bottom = self.cell(i, j) * (1.0 - wx) + self.cell(i.wrapping_add(1), j) * wx;
        top * (1.0 - wy) + bottom * wy
    }

    /// Noise of `octaves` sizes 1, ½, ¼ …, each half as strong as the one before, about -1 to 1.
    pub(super) fn fractal(self, mut x: f32, mut y: f32, octaves: u32) -> f32 {
        let (mut sum, mut weight) = (0.0, 0.6);
        for _ in 0..octaves {
            sum += weight * self.smooth(x, y);
            weight *= 0.5;
            // turned between octaves, so that the lattice does not show
            (x, y) = (1.6 * x - 1.2 * y + 5.3, 1.2 * x + 1.6 * y - 3.7);
        }
        sum
    }
}
