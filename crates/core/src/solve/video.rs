//! From frame to frame of a video: detects changes of the scene and averages readings that have not changed.

use super::Input;
use super::guided::TemporalState;
use super::statistics::guide_noise;
use super::warm_start::WarmStart;
use crate::image::noise::{SAMPLES, reading_noise};
use crate::image::{Size, Stack, is_cut};

/// Most frames that are averaged; from then on the oldest fade.
const AVERAGED: usize = 16;
/// Side of a block in pixels.
const BLOCK: usize = 16;
/// Limits of the squared sums of differences over blocks, in units of their noise: excess of the mean over 1, in its own standard
/// deviations, and the largest.
const DRIFT: f32 = 6.0;
const PEAK: f32 = 30.0;
/// Limit of the mean square of all readings' differences, in units of their noise.
const READINGS: f32 = 2.0;
/// Limits of the mean squares of the guide's differences: of a block over the median block, and of all in units of the noise.
const GUIDE_BLOCK: f32 = 16.0;
const GUIDE: f32 = 6.0;
/// Mean square of the guide's differences that counts as none, in units of its noise.
const UNSEEN: f32 = 1e-3;

/// Moving frames in a row after which constants are taken from the data anew, by a frame solved by itself.
const RENEWED: usize = 100;

/// Memory between the frames of a video: for each channel the averaged readings and guide, and the solver's state.
#[derive(Debug)]
pub struct Continuation {
    pub(super) averages: Vec<Average>,
    pub(super) states: Vec<TemporalState>,
    /// How the present frame starts.
    pub(super) start: WarmStart,
    /// Whether the channels share one polarization, as the last cold frame found.
    pub(super) joint: bool,
    /// Frames that were averaged; 0 when nothing is kept.
    frames: usize,
    /// Moving frames since the last cold or still one.
    moving: usize,
    size: Size,
    /// Rows after which the mask repeats.
    row_period: usize,
    samples: Vec<f32>,
    blocks: Vec<f32>,
}

/// Readings and guide of one channel `[H, W]`, averaged since they last changed.
#[derive(Debug)]
pub(super) struct Average {
    pub(super) raw: Vec<f32>,
    pub(super) guide: Vec<f32>,
}

impl Average {
    /// Bytes of one.
    pub(super) fn bytes(size: Size) -> usize {
        2 * size.pixels() * size_of::<f32>()
    }
}

impl Continuation {
    /// Allocates.
    pub(super) fn new(states: Vec<TemporalState>, size: Size, row_period: usize) -> Self {
        let plane = || vec![0.0; size.pixels()];
        let blocks = Vec::with_capacity(size.width.div_ceil(BLOCK) * size.height.div_ceil(BLOCK));
        Self {
            averages: states.iter().map(|_| Average { raw: plane(), guide: plane() }).collect(),
            states,
            start: WarmStart::Cold,
            joint: false,
            frames: 0,
            moving: 0,
            size,
            row_period,
            samples: Vec::with_capacity(SAMPLES),
            blocks,
        }
    }

    /// Forgets the last frame: the next one is solved by itself.
    pub fn forget(&mut self) {
        self.frames = 0;
    }

    /// Frames in the averages.
    pub(super) fn averaged(&self) -> usize {
        self.frames
    }

    /// Takes a frame into the averages and decides how it starts.
    ///
    /// # Panics
    /// Without a guide.
    pub(super) fn advance(&mut self, input: &Input<'_>) {
        let Some(guide) = input.guide else { panic!("a guided plan without a guide") };
        self.start = self.compare(input, guide);
        self.moving = if self.start == WarmStart::Moving { self.moving + 1 } else { 0 };
        self.frames = if self.start == WarmStart::Still { (self.frames + 1).min(AVERAGED) } else { 1 };
        let share = 1.0 / self.frames as f32;
        for (c, Average { raw, guide: kept }) in self.averages.iter_mut().enumerate() {
            let weight = input.weight.plane(c);
            let average = |mean: &mut [f32], new: &[f32]| {
                mean.iter_mut().zip(new.iter().zip(weight)).for_each(|(mean, (new, weight))| {
                    // A reading without weight is an estimate and says nothing new.
                    *mean += if *weight > 0.0 { share * (new - *mean) } else { 0.0 };
                });
            };
            if share == 1.0 {
                raw.copy_from_slice(input.raw.plane(c));
                kept.copy_from_slice(guide.plane(c));
            } else {
                average(raw, input.raw.plane(c));
                average(kept, guide.plane(c));
            }
        }
    }

    /// How a frame starts: as its channel that has changed most.
    fn compare(&mut self, input: &Input<'_>, guide: &Stack<f32>) -> WarmStart {
        if self.frames == 0 {
            return WarmStart::Cold;
        }
        let mut worst = WarmStart::Still;
        for c in 0..self.averages.len() {
            worst = match self.compare_channel(c, input.raw.plane(c), input.weight.plane(c), guide.plane(c)) {
                WarmStart::Cold => WarmStart::Cold,
                WarmStart::Moving if worst == WarmStart::Still => WarmStart::Moving,
                _ => worst,
            };
        }
        if worst == WarmStart::Moving && self.moving == RENEWED { WarmStart::Cold } else { worst }
    }

    fn compare_channel(&mut self, c: usize, raw: &[f32], weight: &[f32], guide: &[f32]) -> WarmStart {
        let (kept, size) = (&self.averages[c], self.size);
        // The mean has noise as well.
        let both = 1.0 + 1.0 / self.frames as f32;
        // Beyond the frame nothing is read.
        if is_cut(raw, &kept.raw, |i| weight[i] > 0.0) || is_cut(guide, &kept.guide, |_| true) {
            return WarmStart::Cold;
        }
        let sigma = reading_noise(raw, weight, size, self.row_period, &mut self.samples);
        let readings = look(raw, &kept.raw, weight, size, &mut self.blocks);
        if readings.energy > READINGS * both * sigma * sigma || readings.drifts {
            return WarmStart::Moving;
        }
        let sigma = guide_noise(guide, size, &mut self.samples);
        let seen = look(guide, &kept.guide, weight, size, &mut self.blocks);
        self.blocks.sort_unstable_by(f32::total_cmp);
        // Blocks stand out even where two guides differ by rounding alone.
        let least = UNSEEN * sigma * sigma;
        let usual = self.blocks.get(self.blocks.len() / 2).map_or(least, |usual| usual.max(least));
        let loudest = self.blocks.last().copied().unwrap_or(0.0);
        if seen.energy > GUIDE * both * sigma * sigma || loudest > GUIDE_BLOCK * usual {
            return WarmStart::Moving;
        }
        WarmStart::Still
    }
}

/// Differences between two frames.
struct Difference {
    /// Mean square.
    energy: f32,
    /// Whether sums over blocks, in which noise averages out, are larger than the noise of neighbours tells.
    drifts: bool,
}

/// Compares two frames where readings are trusted; mean squares of the blocks go into `blocks`.
fn look(now: &[f32], before: &[f32], weight: &[f32], size: Size, blocks: &mut Vec<f32>) -> Difference {
    let Size { width, height } = size;
    blocks.clear();
    let [mut squares, mut count, mut rough, mut pairs, mut low, mut peak] = [0.0f32; 6];
    let difference = |i: usize| (weight[i] > 0.0).then(|| now[i] - before[i]);
    // Noise first, from neighbours two rows apart.
    for i in 0..width * height.saturating_sub(2) {
        if let (Some(a), Some(b)) = (difference(i), difference(i + 2 * width)) {
            rough += 0.5 * (a - b).powi(2);
            pairs += 1.0;
        }
    }
    let noise = (rough / pairs.max(1.0)).max(f32::MIN_POSITIVE);
    for y0 in (0..height).step_by(BLOCK) {
        for x0 in (0..width).step_by(BLOCK) {
            let [mut sum, mut square, mut n] = [0.0f32; 3];
            for y in y0..(y0 + BLOCK).min(height) {
                for d in (y * width + x0..y * width + (x0 + BLOCK).min(width)).filter_map(difference) {
                    sum += d;
                    square += d * d;
                    n += 1.0;
                }
            }
            if n > 0.0 {
                squares += square;
                count += n;
                let stands_out = sum * sum / n / noise;
                low += stands_out;
                peak = peak.max(stands_out);
                blocks.push(square / n);
            }
        }
    }
    let expected = 1.0 + DRIFT * (2.0 / blocks.len().max(1) as f32).sqrt();
    Difference { energy: squares / count.max(1.0), drifts: low > expected * blocks.len() as f32 || peak > PEAK }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::noise::normal;

    const SIZE: Size = Size::new(64, 50);

    #[test]
    fn smooth_changes_below_the_noise_stand_out_and_noise_alone_does_not() {
        let weight: Vec<f32> = (0..SIZE.pixels()).map(|i| f32::from(u8::from(i % 9 != 0))).collect();
        let before = vec![0.0; SIZE.pixels()];
        for seed in 1..20 {
            let mut now = normal(SIZE.pixels(), 1.0, seed);
            let found = look(&now, &before, &weight, SIZE, &mut Vec::new());
            assert!(!found.drifts && (found.energy - 1.0).abs() < 0.2, "{seed}: {}", found.energy);
            now.iter_mut().for_each(|v| *v += 0.3);
            assert!(look(&now, &before, &weight, SIZE, &mut Vec::new()).drifts, "{seed}");
        }
        // Untrusted readings say nothing, and equal frames are equal.
        let now: Vec<f32> = weight.iter().map(|w| if *w > 0.0 { 0.0 } else { 1e3 }).collect();
        let same = look(&now, &before, &weight, SIZE, &mut Vec::new());
        assert!(!same.drifts && same.energy == 0.0);
    }
}
