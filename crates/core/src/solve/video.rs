//! From frame to frame of a video: has the scene changed, and what does the next frame start from?

use std::fmt;

use super::Input;
use super::splitting::Kept;
use super::statistics::guide_noise;
use crate::image::noise::{SAMPLES, reading_noise};
use crate::image::{Size, is_cut};

/// How a frame of a video was solved.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Course {
    /// By itself: the first frame, one of another scene, or not of a video.
    #[default]
    Cold,
    /// From the last frame's result: the scene has changed.
    Moving,
    /// Further on the last frame's result, with readings and guide averaged: nothing has changed but noise.
    Still,
}

impl Course {
    /// Iterations of a frame where a frame by itself is given `asked`.
    pub fn iterations(self, asked: usize) -> usize {
        match self {
            Self::Cold => asked,
            Self::Moving => asked.min(MOVING),
            Self::Still => asked.min(STILL),
        }
    }
}

impl fmt::Display for Course {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Cold => "cold",
            Self::Moving => "moving",
            Self::Still => "still",
        })
    }
}

/// What was done for a frame.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Step {
    /// How it was solved.
    pub course: Course,
    /// Iterations it took.
    pub iterations: usize,
    /// Frames whose readings were averaged.
    pub averaged: usize,
}

/// Iterations of a frame after another one, at most.
const MOVING: usize = 6;
const STILL: usize = 2;
/// Frames that are averaged at most; from then on the oldest fade.
const AVERAGED: usize = 16;
/// Pixels of a block's side.
const BLOCK: usize = 16;
/// Sum over a block against noise: mean square over all blocks beyond 1, in its own standard deviations, and of one block.
const DRIFT: f32 = 6.0;
const PEAK: f32 = 30.0;
/// Energy of all readings' differences against noise.
const READINGS: f32 = 2.0;
/// Energy of the guide's differences against its noise: of a block beside the usual one, and of all.
const GUIDE_BLOCK: f32 = 16.0;
const GUIDE: f32 = 6.0;
/// Energy of a guide's difference, against its noise, that is none.
const UNSEEN: f32 = 1e-3;

/// Moving frames in a row after which constants are taken from the data anew, by a frame solved by itself.
const RENEWED: usize = 100;

/// What is kept between the frames of a video: for each channel the averaged readings and guide, and the solver's state.
#[derive(Debug)]
pub struct Continuation {
    channels: Vec<Kept>,
    /// Frames that were averaged; 0 when nothing is kept.
    frames: usize,
    /// Moving frames since the last cold or still one.
    moving: usize,
    /// Whether the channels share one polarization, as the last cold frame found.
    pub(super) shared: bool,
    size: Size,
    samples: Vec<f32>,
    blocks: Vec<f32>,
}

impl Continuation {
    pub(super) fn new(channels: Vec<Kept>, size: Size) -> Self {
        let blocks = Vec::with_capacity(size.width.div_ceil(BLOCK) * size.height.div_ceil(BLOCK));
        Self { channels, frames: 0, moving: 0, shared: false, size, samples: Vec::with_capacity(SAMPLES), blocks }
    }

    /// Forgets the last frame: the next one is solved by itself.
    pub fn forget(&mut self) {
        self.frames = 0;
    }

    pub(super) fn channel(&mut self, c: usize) -> &mut Kept {
        &mut self.channels[c]
    }

    pub(super) fn channels(&mut self) -> &mut [Kept] {
        &mut self.channels
    }

    /// Takes a frame in and says how to solve it.
    ///
    /// # Panics
    /// Without a guide.
    pub(super) fn advance(&mut self, input: &Input<'_>) -> Step {
        let Some(guide) = input.guide else { panic!("a guided plan without a guide") };
        let course = if self.frames == 0 {
            Course::Cold
        } else {
            let mut worst = Course::Still;
            for c in 0..self.channels.len() {
                let planes = (input.raw.plane(c), input.weight.plane(c), guide.plane(c));
                worst = match self.compare(c, planes) {
                    Course::Cold => Course::Cold,
                    Course::Moving if worst == Course::Still => Course::Moving,
                    _ => worst,
                };
            }
            if worst == Course::Moving && self.moving == RENEWED { Course::Cold } else { worst }
        };
        self.moving = if course == Course::Moving { self.moving + 1 } else { 0 };
        self.frames = if course == Course::Still { (self.frames + 1).min(AVERAGED) } else { 1 };
        let share = 1.0 / self.frames as f32;
        for (c, kept) in self.channels.iter_mut().enumerate() {
            let weight = input.weight.plane(c);
            let average = |mean: &mut [f32], new: &[f32]| {
                mean.iter_mut().zip(new.iter().zip(weight)).for_each(|(mean, (new, weight))| {
                    // A reading without weight is an estimate and says nothing new.
                    *mean += if *weight > 0.0 { share * (new - *mean) } else { 0.0 };
                });
            };
            if share == 1.0 {
                kept.raw.copy_from_slice(input.raw.plane(c));
                kept.guide.copy_from_slice(guide.plane(c));
            } else {
                average(&mut kept.raw, input.raw.plane(c));
                average(&mut kept.guide, guide.plane(c));
            }
        }
        Step { course, iterations: 0, averaged: self.frames }
    }

    fn compare(&mut self, c: usize, (raw, weight, guide): (&[f32], &[f32], &[f32])) -> Course {
        let (kept, size) = (&self.channels[c], self.size);
        // The mean has noise as well.
        let both = 1.0 + 1.0 / self.frames as f32;
        if is_cut(raw, &kept.raw) || is_cut(guide, &kept.guide) {
            return Course::Cold;
        }
        let sigma = reading_noise(raw, weight, size, kept.row_period, &mut self.samples);
        let readings = look(raw, &kept.raw, weight, size, &mut self.blocks);
        if readings.energy > READINGS * both * sigma * sigma || readings.drifts {
            return Course::Moving;
        }
        let sigma = guide_noise(guide, size, &mut self.samples);
        let seen = look(guide, &kept.guide, weight, size, &mut self.blocks);
        self.blocks.sort_unstable_by(f32::total_cmp);
        // What differs by rounding alone has blocks that stand out too.
        let least = UNSEEN * sigma * sigma;
        let usual = self.blocks.get(self.blocks.len() / 2).map_or(least, |usual| usual.max(least));
        let loudest = self.blocks.last().copied().unwrap_or(0.0);
        if seen.energy > GUIDE * both * sigma * sigma || loudest > GUIDE_BLOCK * usual {
            return Course::Moving;
        }
        Course::Still
    }
}

/// How two frames differ.
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
