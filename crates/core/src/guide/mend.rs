//! Pixels of a guide without a value, and pixels that stand far from all around them: dead and hot ones.
//!
//! Values that are not finite are filled in from their neighbours, from the rim of a hole inwards. Pixels deep in a hole get weight 0: the
//! guide does not see the scene there, and the readings are solved for it.
//!
//! A pixel is an outlier if it exceeds the third largest of its eight neighbours, or falls short of the third smallest, by more than the
//! spread of both rings around it and by more than noise. A star is an outlier too. Only the readings tell light from a defect, so
//! [`Mended`] holds the guide with its outliers and one without them, and the one that explains the readings is used.
//!
//! Cost: a guide without such pixels is read once and not copied. Buffers are allocated when the first one with them comes.

use crate::image::{Planes, Size, Stack};

/// Share of the pixels from which on outliers are looked into. Texture at the sampling limit has fewer: up to 0.14 % in photographs.
const LEAST: f32 = 0.002;
/// Number of them from which on they are: in a small guide a few are texture.
const LEAST_COUNT: usize = 50;
/// Excess of an outlier over the spread of its surroundings, over the mean of the guide, and over the usual spread, which is that of noise.
const OVER_SPREAD: f32 = 2.0;
const OVER_MEAN: f32 = 0.1;
const OVER_NOISE: f32 = 4.0;
/// Pixels that are looked at for the usual spread.
const SAMPLES: usize = 1021;
/// Pixels from the rim of a hole up to which a value is filled in from its neighbours alone.
const RIM: usize = 2;

/// A guide whose pixels all have values.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Mended<'a> {
    /// The guide with its outliers.
    pub given: Planes<'a>,
    /// The guide without them, where there are enough to be looked into.
    pub smoothed: Option<Planes<'a>>,
    /// Shares of the values that were missing, and that are outliers.
    pub missing: f32,
    pub outliers: f32,
}

/// Buffers for guides with such pixels; empty until one comes.
#[derive(Debug, Default)]
pub(crate) struct Mender {
    filled: Stack<f32>,
    smoothed: Stack<f32>,
    /// 0 deep in holes, else 1; of every value.
    weights: Vec<f32>,
    /// Pixels of one plane that have no value of their own yet.
    open: Vec<bool>,
    rim: Vec<(u32, f32)>,
}

impl Mender {
    /// Bytes that the buffers take, at most, for guides of `count` planes of `size`.
    pub(crate) fn most_bytes(count: usize, size: Size) -> usize {
        let of_value = 3 * size_of::<f32>();
        size.pixels() * (count * of_value + size_of::<bool>() + size_of::<(u32, f32)>())
    }

    /// Fills in what has no value in `guide`, and looks for outliers if `outliers` says so.
    pub(crate) fn mend<'a>(&'a mut self, guide: Planes<'a>, outliers: bool) -> Mended<'a> {
        let (size, values) = (guide.size(), guide.as_slice());
        let total = values.len().max(1) as f32;
        let missing = count_missing(values);
        let Self { filled, smoothed, weights, open, rim } = self;
        let mut given = guide;
        if missing > 0 {
            copy(guide, filled);
            weights.clear();
            weights.resize(values.len(), 1.0);
            rim.reserve_exact(size.pixels());
            for (plane, weights) in filled.planes_mut().zip(weights.chunks_exact_mut(size.pixels())) {
                open.clear();
                open.extend(plane.iter().map(|v| !v.is_finite()));
                fill(plane, open, rim, size, |i| weights[i] = 0.0);
            }
            given = filled.borrow().weighted(weights);
        }
        let mut found = 0;
        if outliers && size.width > 4 && size.height > 4 {
            let floors = [0, 1, 2].map(|c| if c < guide.count() { floor(given.plane(c), size) } else { 0.0 });
            (0..guide.count()).for_each(|c| each_outlier(given.plane(c), size, floors[c], |_| found += 1));
            if found >= LEAST_COUNT && found as f32 >= LEAST * total {
                copy(given, smoothed);
                rim.reserve_exact(size.pixels());
                for (c, plane) in smoothed.planes_mut().enumerate() {
                    open.clear();
                    open.resize(size.pixels(), false);
                    each_outlier(given.plane(c), size, floors[c], |i| open[i] = true);
                    fill(plane, open, rim, size, |_| ());
                }
                let smoothed = smoothed.borrow();
                let smoothed = if missing > 0 { smoothed.weighted(weights) } else { smoothed };
                let [missing, outliers] = [missing, found].map(|n| n as f32 / total);
                return Mended { given, smoothed: Some(smoothed), missing, outliers };
            }
        }
        Mended { given, smoothed: None, missing: missing as f32 / total, outliers: 0.0 }
    }
}

/// Number of values that are not finite.
fn count_missing(values: &[f32]) -> usize {
    // The sum of zeros is zero unless a value is not finite: one quick pass for all other guides.
    let mut sums = [0.0f32; 16];
    let chunks = values.chunks_exact(16);
    let rest: f32 = chunks.remainder().iter().map(|v| v * 0.0).sum();
    chunks.for_each(|chunk| sums.iter_mut().zip(chunk).for_each(|(sum, v)| *sum += v * 0.0));
    if rest + sums.iter().sum::<f32>() == 0.0 { 0 } else { values.iter().filter(|v| !v.is_finite()).count() }
}

fn copy(from: Planes<'_>, to: &mut Stack<f32>) {
    if (to.count(), to.size()) != (from.count(), from.size()) {
        *to = Stack::zeros(from.count(), from.size());
    }
    to.as_mut_slice().copy_from_slice(from.as_slice());
}

/// Fills in the `open` pixels of a plane from the others, from the rim of each hole inwards, and tells which lie deep in one. A plane
/// without any value becomes 0.
fn fill(
    plane: &mut [f32],
    open: &mut [bool],
    rim: &mut Vec<(u32, f32)>,
    Size { width, height }: Size,
    mut deep: impl FnMut(usize),
) {
    for depth in 1.. {
        rim.clear();
        for i in (0..plane.len()).filter(|i| open[*i]) {
            let (x, y) = (i % width, i / width);
            let (mut sum, mut weight) = (0.0, 0.0);
            for ny in y.saturating_sub(1)..(y + 2).min(height) {
                for nx in x.saturating_sub(1)..(x + 2).min(width) {
                    let n = ny * width + nx;
                    if !open[n] {
                        let share = if nx == x || ny == y { 1.0 } else { 0.5 };
                        sum += share * plane[n];
                        weight += share;
                    }
                }
            }
            if weight > 0.0 {
                rim.push((i as u32, sum / weight));
            }
        }
        if rim.is_empty() {
            break;
        }
        for (i, value) in rim.drain(..) {
            let i = i as usize;
            (plane[i], open[i]) = (value, false);
            if depth > RIM {
                deep(i);
            }
        }
    }
    plane.iter_mut().zip(open).filter(|(_, open)| **open).for_each(|(v, _)| *v = 0.0);
}

/// The excess that an outlier has at least.
fn floor(plane: &[f32], size: Size) -> f32 {
    let mut spreads = [0.0f32; SAMPLES];
    let stride = (plane.len() / SAMPLES).max(1);
    let mut count = 0;
    for (to, i) in spreads.iter_mut().zip((0..plane.len()).step_by(stride)) {
        let [low, high] = near(plane, i % size.width, i / size.width, size);
        (*to, count) = (high - low, count + 1);
    }
    let usual = *spreads[..count].select_nth_unstable_by(count / 2, f32::total_cmp).1;
    let mean = plane.iter().map(|v| f64::from(*v)).sum::<f64>() / plane.len() as f64;
    (OVER_MEAN * mean as f32).max(OVER_NOISE * usual)
}

/// The third smallest and the third largest of eight values.
#[inline(always)]
fn thirds(values: [f32; 8]) -> [f32; 2] {
    let less = |a: f32, b: f32| if a < b { a } else { b };
    let more = |a: f32, b: f32| if a > b { a } else { b };
    let (mut low, mut high) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
    for value in values {
        let (mut rising, mut falling) = (value, value);
        for k in 0..3 {
            (low[k], rising) = (less(low[k], rising), more(low[k], rising));
            (high[k], falling) = (more(high[k], falling), less(high[k], falling));
        }
    }
    [low[2], high[2]]
}

/// The third smallest and the third largest neighbour of a pixel; beyond the border stand the pixels of the border mirrored.
fn near(plane: &[f32], x: usize, y: usize, size: Size) -> [f32; 2] {
    let at = |dx: isize, dy: isize| plane[mirrored(y, dy, size.height) * size.width + mirrored(x, dx, size.width)];
    thirds([at(-1, -1), at(0, -1), at(1, -1), at(-1, 0), at(1, 0), at(-1, 1), at(0, 1), at(1, 1)])
}

fn mirrored(at: usize, step: isize, n: usize) -> usize {
    let to = at.checked_add_signed(step).unwrap_or_else(|| step.unsigned_abs() - at);
    if to < n { to } else { 2 * (n - 1) - to }
}

/// Half the spread of the sixteen pixels two away from a pixel: from the fourth smallest to the middle.
fn ring_spread(plane: &[f32], x: usize, y: usize, size: Size) -> f32 {
    let mut ring = [0.0f32; 16];
    let places = (-2..=2isize).flat_map(|dy| (-2..=2isize).map(move |dx| (dx, dy)));
    let places = places.filter(|(dx, dy)| dx.abs().max(dy.abs()) == 2);
    for (to, (dx, dy)) in ring.iter_mut().zip(places) {
        *to = plane[mirrored(y, dy, size.height) * size.width + mirrored(x, dx, size.width)];
    }
    ring.sort_unstable_by(f32::total_cmp);
    ring[12] - ring[3]
}

/// Calls `tell` with every outlier of a plane whose values are finite.
fn each_outlier(plane: &[f32], size: Size, floor: f32, mut tell: impl FnMut(usize)) {
    let Size { width, height } = size;
    let mut judge = |x: usize, y: usize| {
        let (value, [low, high]) = (plane[y * width + x], near(plane, x, y, size));
        let excess = (value - high).max(low - value);
        if excess > floor && excess > OVER_SPREAD * (high - low).max(ring_spread(plane, x, y, size)) {
            tell(y * width + x);
        }
    };
    for y in 0..height {
        if y == 0 || y + 1 == height {
            (0..width).for_each(|x| judge(x, y));
            continue;
        }
        judge(0, y);
        let [up, here, down] = [y - 1, y, y + 1].map(|y| &plane[y * width..(y + 1) * width]);
        for x in 1..width - 1 {
            // All but two neighbours of an outlier differ from it by the floor, so that two of these four do: few pixels go on from here.
            let beside = [up[x], down[x], here[x - 1], here[x + 1]];
            let differ = |sign: f32| beside.iter().map(|v| u8::from(sign * (here[x] - v) > floor)).sum::<u8>();
            if differ(1.0) > 1 || differ(-1.0) > 1 {
                judge(x, y);
            }
        }
        judge(width - 1, y);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::noise;

    const SIZE: Size = Size::new(60, 50);

    /// A smooth scene with an edge and noise.
    fn scene() -> Vec<f32> {
        let noise = noise::normal(SIZE.pixels(), 0.005, 7);
        let value = |i: usize| if i % 60 < 30 { 0.3 + 0.004 * (i / 60) as f32 } else { 0.7 };
        noise.iter().enumerate().map(|(i, noise)| value(i) + noise).collect()
    }

    fn stack(values: Vec<f32>) -> Stack<f32> {
        Stack::from_vec(1, SIZE, values).unwrap()
    }

    #[test]
    fn a_clean_guide_is_handed_on_as_it_is() {
        let (guide, mut mender) = (stack(scene()), Mender::default());
        let mended = mender.mend(guide.borrow(), true);
        assert!(mended.smoothed.is_none() && (mended.missing, mended.outliers) == (0.0, 0.0));
        assert_eq!(mended.given.as_slice().as_ptr(), guide.as_slice().as_ptr());
        assert_eq!((mender.filled.bytes(), mender.smoothed.bytes()), (0, 0));
    }

    #[test]
    fn missing_values_are_filled_in_and_the_depth_of_a_hole_is_not_seen() {
        for missing in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            let clean = scene();
            let mut values = clean.clone();
            values[10 * 60 + 10] = missing;
            (20..30).for_each(|y| (10..20).for_each(|x| values[y * 60 + x] = missing));
            let guide = stack(values);
            let mut mender = Mender::default();
            let mended = mender.mend(guide.borrow(), true);
            assert!((mended.missing - 101.0 / 3000.0).abs() < 1e-6);
            let worst = mended.given.as_slice().iter().zip(&clean).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(worst < 0.05, "{worst}");
            let weights = mended.given.weights(0).unwrap();
            let deep = weights.iter().filter(|w| **w == 0.0).count();
            assert!(deep == 36 && weights[24 * 60 + 14] == 0.0 && weights[10 * 60 + 10] == 1.0, "{deep}");
        }
        let nothing = stack(vec![f32::NAN; SIZE.pixels()]);
        assert!(Mender::default().mend(nothing.borrow(), true).given.as_slice().iter().all(|v| *v == 0.0));
    }

    #[test]
    fn dead_and_hot_pixels_are_outliers_and_edges_and_noise_are_not() {
        for stuck in [0.0, 1.0] {
            let clean = scene();
            let mut values = clean.clone();
            let bad: Vec<usize> = (0..60).map(|k| (k * 47 + 13) % SIZE.pixels()).collect();
            bad.iter().for_each(|i| values[*i] = stuck);
            let guide = stack(values);
            let mut mender = Mender::default();
            let mended = mender.mend(guide.borrow(), true);
            assert!((0.017..=0.0201).contains(&mended.outliers), "{}", mended.outliers);
            let smoothed = mended.smoothed.unwrap().as_slice();
            let left = bad.iter().filter(|i| (smoothed[**i] - clean[**i]).abs() > 0.1).count();
            assert!(left <= 8, "{left}");
            assert!(Mender::default().mend(guide.borrow(), false).smoothed.is_none());
        }
    }
}
