//! The guided filter (He, Sun, Tang: "Guided Image Filtering", 2013) for a complex image and a real guide.
//!
//! In each window of (2r+1)² pixels the image is modelled as c·g + b; c and b are then averaged over all windows that hold a
//! pixel. Edges of the guide pass, structure that is not in the guide is averaged. Windows are cut at the borders.

use num_complex::Complex32;

use crate::parallel::Workers;
use crate::plane::Size;

/// Window radius in pixels.
const RADIUS: usize = 4;

/// Two complex values side by side: one SIMD register.
pub(super) type Pair = [f32; 4];

fn none<T>() -> &'static mut [T] {
    &mut []
}

/// Window statistics of one guide, and the buffers of the filter.
#[derive(Debug)]
pub(super) struct GuidedFilter {
    size: Size,
    mean: Vec<f32>,
    /// 1 / (variance + ε).
    precision: Vec<f32>,
    /// Sums along rows.
    across: Vec<Pair>,
    /// Sums over windows, then what is made of them.
    window: Vec<Pair>,
}

impl GuidedFilter {
    /// Buffers for frames of `size`. Allocates.
    pub(super) fn new(size: Size) -> Self {
        let n = size.pixels();
        let (reals, pairs) = (|| vec![0.0; n], || vec![[0.0; 4]; n]);
        Self { size, mean: reals(), precision: reals(), across: pairs(), window: pairs() }
    }

    /// Bytes of one filter.
    pub(super) fn bytes(size: Size) -> usize {
        size.pixels() * (2 * size_of::<f32>() + 2 * size_of::<Pair>())
    }

    /// Takes the window statistics of `guide`; `epsilon` is the variance below which the guide counts as flat.
    pub(super) fn set_guide(&mut self, guide: &[f32], epsilon: f32, workers: &Workers) {
        let Size { width, .. } = self.size;
        self.sum_across(workers, |y, x| {
            let g = guide[y * width + x];
            [g, g * g, 0.0, 0.0]
        });
        let Self { size, mean, precision, across, window } = self;
        down(*size, workers, across, window, (mean, precision), |_, count, sums, at, (mean, precision)| {
            for (x, s) in sums.iter().enumerate() {
                let share = 1.0 / (count * window_len(x, size.width));
                let m = s[0] * share;
                mean[at + x] = m;
                precision[at + x] = 1.0 / ((s[1] * share - m * m).max(0.0) + epsilon);
            }
        });
    }

    /// Models the image `value(y, x)` window by window; [`Self::apply`] gives the result.
    pub(super) fn analyze(
        &mut self,
        guide: &[f32],
        workers: &Workers,
        value: impl Fn(usize, usize) -> Complex32 + Sync,
    ) {
        let Size { width, height } = self.size;
        self.sum_across(workers, |y, x| {
            let (v, g) = (value(y, x), guide[y * width + x]);
            [v.re, v.im, g * v.re, g * v.im]
        });
        let Self { size, mean, precision, across, window } = self;
        down(*size, workers, across, window, (none::<()>(), none::<()>()), |y, count, sums, _, _| {
            for (x, s) in sums.iter_mut().enumerate() {
                let i = y * width + x;
                let share = 1.0 / (count * window_len(x, width));
                let [re, im, gre, gim] = s.map(|v| v * share);
                let (cre, cim) = ((gre - mean[i] * re) * precision[i], (gim - mean[i] * im) * precision[i]);
                *s = [cre, cim, re - cre * mean[i], im - cim * mean[i]];
            }
        });
        workers.bands(height, (across, none::<()>(), none::<()>(), none::<()>()), |rows, (across, ..)| {
            for (y, across) in rows.zip(across.chunks_exact_mut(width)) {
                sum_line(&window[y * width..][..width], across);
            }
        });
    }

    /// Calls `store(y, filtered, a, b)` for each row, with the rows of `outputs`; a filtered
    /// value is the first two numbers of its pair.
    pub(super) fn apply<A: Send, B: Send>(
        &mut self,
        guide: &[f32],
        workers: &Workers,
        outputs: (&mut [A], &mut [B]),
        store: impl Fn(usize, &[Pair], &mut [A], &mut [B]) + Sync,
    ) {
        let Size { width, height } = self.size;
        let row = (outputs.0.len() / height, outputs.1.len() / height);
        let Self { size, across, window, .. } = self;
        down(*size, workers, across, window, outputs, |y, count, sums, at, (a, b)| {
            let band_row = at / width;
            for (x, s) in sums.iter_mut().enumerate() {
                let share = 1.0 / (count * window_len(x, width));
                let g = guide[y * width + x];
                let [cre, cim, bre, bim] = *s;
                *s = [(cre * g + bre) * share, (cim * g + bim) * share, 0.0, 0.0];
            }
            store(y, sums, &mut a[band_row * row.0..][..row.0], &mut b[band_row * row.1..][..row.1]);
        });
    }

    fn sum_across(&mut self, workers: &Workers, value: impl Fn(usize, usize) -> Pair + Sync) {
        let Size { width, height } = self.size;
        let images = (&mut *self.across, &mut *self.window, none::<()>(), none::<()>());
        workers.bands(height, images, |rows, (across, line, _, _)| {
            let line = &mut line[..width.min(rows.len() * width)];
            for (y, across) in rows.zip(across.chunks_exact_mut(width)) {
                line.iter_mut().enumerate().for_each(|(x, v)| *v = value(y, x));
                sum_line(line, across);
            }
        });
    }
}

/// Pixels of a window along one axis of `n`, around `at`.
fn window_len(at: usize, n: usize) -> f32 {
    ((at + RADIUS).min(n - 1) - at.saturating_sub(RADIUS) + 1) as f32
}

fn add(a: &mut Pair, b: &Pair) {
    a.iter_mut().zip(b).for_each(|(a, b)| *a += b);
}

fn subtract(a: &mut Pair, b: &Pair) {
    a.iter_mut().zip(b).for_each(|(a, b)| *a -= b);
}

/// Sums over windows along a line.
fn sum_line(line: &[Pair], sums: &mut [Pair]) {
    let mut sum = [0.0; 4];
    line[..RADIUS.min(line.len())].iter().for_each(|v| add(&mut sum, v));
    for (x, out) in sums.iter_mut().enumerate() {
        if let Some(v) = line.get(x + RADIUS) {
            add(&mut sum, v);
        }
        if x > RADIUS {
            subtract(&mut sum, &line[x - RADIUS - 1]);
        }
        *out = sum;
    }
}

/// Sums `across` over windows along columns into `window`, row after row within each band, and calls
/// `finish(y, rows in the window, sums of the row, offset of the row in the band, outputs of the band)` for each row, which
/// may then overwrite the sums.
fn down<A: Send, B: Send>(
    size: Size,
    workers: &Workers,
    across: &[Pair],
    window: &mut [Pair],
    outputs: (&mut [A], &mut [B]),
    finish: impl Fn(usize, f32, &mut [Pair], usize, (&mut [A], &mut [B])) + Sync,
) {
    let Size { width, height } = size;
    let row = |y: usize| &across[y * width..][..width];
    workers.bands(height, (window, outputs.0, outputs.1, none::<()>()), |rows, (window, a, b, _)| {
        let first = rows.start;
        for y in rows.clone() {
            let at = (y - first) * width;
            let (before, here) = window.split_at_mut(at);
            let here = &mut here[..width];
            if y == first {
                here.fill([0.0; 4]);
                for y in y.saturating_sub(RADIUS)..(y + RADIUS).min(height - 1) + 1 {
                    here.iter_mut().zip(row(y)).for_each(|(s, v)| add(s, v));
                }
            } else {
                here.copy_from_slice(&before[at - width..]);
                if y + RADIUS < height {
                    here.iter_mut().zip(row(y + RADIUS)).for_each(|(s, v)| add(s, v));
                }
                if y > RADIUS {
                    here.iter_mut().zip(row(y - RADIUS - 1)).for_each(|(s, v)| subtract(s, v));
                }
                // Only now is the row above free: this one was made from its sums.
                finish(y - 1, window_len(y - 1, height), &mut before[at - width..], at - width, (&mut *a, &mut *b));
            }
        }
        if let Some(y) = rows.clone().last() {
            let at = (y - first) * width;
            finish(y, window_len(y, height), &mut window[at..at + width], at, (a, b));
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The definition, window by window, in f64.
    fn naive(size: Size, g: &[f32], v: &[Complex32], epsilon: f64) -> Vec<(f64, f64)> {
        let window = |i: usize| {
            let (y, x) = (i / size.width, i % size.width);
            let range = |at: usize, n: usize| at.saturating_sub(RADIUS)..(at + RADIUS).min(n - 1) + 1;
            range(y, size.height).flat_map(move |y| range(x, size.width).map(move |x| y * size.width + x))
        };
        let mean = |i: usize, f: &dyn Fn(usize) -> f64| window(i).map(f).sum::<f64>() / window(i).count() as f64;
        let model: Vec<[f64; 4]> = (0..size.pixels())
            .map(|i| {
                let m = mean(i, &|j| f64::from(g[j]));
                let variance = mean(i, &|j| f64::from(g[j]).powi(2)) - m * m;
                let [a, b] = [|c: Complex32| f64::from(c.re), |c: Complex32| f64::from(c.im)].map(|part| {
                    let mean_v = mean(i, &|j| part(v[j]));
                    let c = (mean(i, &|j| f64::from(g[j]) * part(v[j])) - m * mean_v) / (variance + epsilon);
                    [c, mean_v - c * m]
                });
                [a[0], a[1], b[0], b[1]]
            })
            .collect();
        (0..size.pixels())
            .map(|i| {
                let at = |k: usize| mean(i, &|j| model[j][k]);
                (at(0) * f64::from(g[i]) + at(1), at(2) * f64::from(g[i]) + at(3))
            })
            .collect()
    }

    #[test]
    fn follows_the_definition_for_any_size_and_number_of_threads() {
        for (size, threads) in
            [(Size::new(31, 23), 1), (Size::new(31, 23), 3), (Size::new(5, 3), 2), (Size::new(1, 9), 4)]
        {
            let n = size.pixels();
            let g: Vec<f32> = (0..n).map(|i| 0.5 + 0.3 * (i as f32 * 0.37).sin()).collect();
            let v: Vec<_> = (0..n).map(|i| Complex32::from_polar(0.3, i as f32 * 0.11)).collect();
            let workers = Workers::new(threads);
            let mut filter = GuidedFilter::new(size);
            filter.across.fill([f32::NAN; 4]);
            filter.window.fill([f32::NAN; 4]);
            filter.set_guide(&g, 1e-3, &workers);
            let (mut got, mut none) = (vec![Complex32::ZERO; n], [(); 0]);
            let value = |y: usize, x: usize| v[y * size.width + x];
            filter.analyze(&g, &workers, |y, x| v[y * size.width + x]);
            filter.apply(&g, &workers, (&mut got, &mut none), |_, row, out, _| {
                out.iter_mut().zip(row).for_each(|(o, p)| *o = Complex32::new(p[0], p[1]));
            });
            for (g, (re, im)) in got.iter().zip(naive(size, &g, &v, 1e-3)) {
                assert!((f64::from(g.re) - re).abs() < 1e-4 && (f64::from(g.im) - im).abs() < 1e-4);
            }
        }
    }
}
