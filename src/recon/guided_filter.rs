//! The guided filter (He, Sun, Tang: "Guided Image Filtering", 2013) for a complex image and a real guide.
//!
//! In each window of (2r+1)² pixels the image is modelled as c·g + b; c and b are then averaged over all windows that hold a
//! pixel. Edges of the guide pass, structure that is not in the guide is averaged. Windows are cut at the borders.

use num_complex::Complex32;

use crate::parallel::Workers;
use crate::plane::Size;

/// Two complex values side by side: one SIMD register.
pub(super) type Pair = [f32; 4];

fn none<T>() -> &'static mut [T] {
    &mut []
}

/// Window statistics of one guide, and the buffers of the filter.
#[derive(Debug)]
pub(super) struct GuidedFilter {
    size: Size,
    /// Window radius in pixels.
    radius: usize,
    mean: Vec<f32>,
    /// 1 / (variance + ε).
    precision: Vec<f32>,
    /// Sums along rows.
    across: Vec<Pair>,
    /// Sums over windows, then what is made of them, in the end the result.
    window: Vec<Pair>,
}

impl GuidedFilter {
    /// Buffers for frames of `size`. Allocates.
    pub(super) fn new(size: Size) -> Self {
        let n = size.pixels();
        let (reals, pairs) = (|| vec![0.0; n], || vec![[0.0; 4]; n]);
        Self { size, radius: 1, mean: reals(), precision: reals(), across: pairs(), window: pairs() }
    }

    /// Bytes of one filter.
    pub(super) fn bytes(size: Size) -> usize {
        size.pixels() * (2 * size_of::<f32>() + 2 * size_of::<Pair>())
    }

    /// Takes the statistics of `guide` in windows of `radius`; `epsilon` is the variance below which it counts as flat.
    pub(super) fn set_guide(&mut self, guide: &[f32], radius: usize, epsilon: f32, workers: &Workers) {
        self.radius = radius;
        let Size { width, height } = self.size;
        self.sum_across(workers, |i| [guide[i], guide[i] * guide[i], 0.0, 0.0]);
        self.sum_down(workers);
        let (window, epsilon) = (&self.window, epsilon.max(f32::MIN_POSITIVE));
        workers.bands(height, (&mut self.mean, &mut self.precision, none::<()>()), |rows, (mean, precision, _)| {
            for (y, (mean, precision)) in rows.zip(mean.chunks_exact_mut(width).zip(precision.chunks_exact_mut(width)))
            {
                let count = window_len(y, height, radius);
                for (x, (m, p)) in mean.iter_mut().zip(precision).enumerate() {
                    let share = 1.0 / (count * window_len(x, width, radius));
                    let [sum, squares, ..] = window[y * width + x];
                    *m = sum * share;
                    *p = 1.0 / ((squares * share - *m * *m).max(0.0) + epsilon);
                }
            }
        });
    }

    /// Filters the image `value(index)`; the result is in [`Self::result`].
    pub(super) fn run(&mut self, guide: &[f32], workers: &Workers, value: impl Fn(usize) -> Complex32 + Sync) {
        let (Size { width, height }, radius) = (self.size, self.radius);
        self.sum_across(workers, |i| {
            let (v, g) = (value(i), guide[i]);
            [v.re, v.im, g * v.re, g * v.im]
        });
        self.sum_down(workers);
        let (mean, precision) = (&self.mean, &self.precision);
        let images = (&mut *self.across, &mut *self.window, none::<()>());
        workers.bands(height, images, |rows, (across, window, _)| {
            for (y, (across, window)) in rows.zip(across.chunks_exact_mut(width).zip(window.chunks_exact_mut(width))) {
                let count = window_len(y, height, radius);
                for (x, s) in window.iter_mut().enumerate() {
                    let i = y * width + x;
                    let share = 1.0 / (count * window_len(x, width, radius));
                    let [re, im, gre, gim] = s.map(|v| v * share);
                    let (cre, cim) = ((gre - mean[i] * re) * precision[i], (gim - mean[i] * im) * precision[i]);
                    *s = [cre, cim, re - cre * mean[i], im - cim * mean[i]];
                }
                sum_line(window, across, radius);
            }
        });
        self.sum_down(workers);
        workers.bands(height, (&mut self.window, none::<()>(), none::<()>()), |rows, (window, ..)| {
            for (y, window) in rows.zip(window.chunks_exact_mut(width)) {
                let count = window_len(y, height, radius);
                for (x, s) in window.iter_mut().enumerate() {
                    let share = 1.0 / (count * window_len(x, width, radius));
                    let [cre, cim, bre, bim] = *s;
                    let g = guide[y * width + x];
                    *s = [(cre * g + bre) * share, (cim * g + bim) * share, 0.0, 0.0];
                }
            }
        });
    }

    /// The latest result: real and imaginary part are the first two numbers.
    pub(super) fn result(&self) -> &[Pair] {
        &self.window
    }

    fn sum_across(&mut self, workers: &Workers, value: impl Fn(usize) -> Pair + Sync) {
        let (Size { width, height }, radius) = (self.size, self.radius);
        let images = (&mut *self.across, &mut *self.window, none::<()>());
        workers.bands(height, images, |rows, (across, line, _)| {
            for (y, across) in rows.zip(across.chunks_exact_mut(width)) {
                let line = &mut line[..width];
                line.iter_mut().enumerate().for_each(|(x, v)| *v = value(y * width + x));
                sum_line(line, across, radius);
            }
        });
    }

    /// Sums `across` over windows along columns into `window`, row after row within each band.
    fn sum_down(&mut self, workers: &Workers) {
        let (Size { width, height }, radius) = (self.size, self.radius);
        let row = |y: usize| &self.across[y * width..][..width];
        workers.bands(height, (&mut self.window, none::<()>(), none::<()>()), |rows, (window, ..)| {
            for (at, y) in rows.enumerate() {
                let (before, here) = window.split_at_mut(at * width);
                let here = &mut here[..width];
                if at == 0 {
                    here.fill([0.0; 4]);
                    for y in y.saturating_sub(radius)..(y + radius).min(height - 1) + 1 {
                        here.iter_mut().zip(row(y)).for_each(|(s, v)| add(s, v));
                    }
                    continue;
                }
                here.copy_from_slice(&before[(at - 1) * width..]);
                if y + radius < height {
                    here.iter_mut().zip(row(y + radius)).for_each(|(s, v)| add(s, v));
                }
                if y > radius {
                    here.iter_mut().zip(row(y - radius - 1)).for_each(|(s, v)| subtract(s, v));
                }
            }
        });
    }
}

/// Pixels of a window along one axis of `n`, around `at`.
fn window_len(at: usize, n: usize, radius: usize) -> f32 {
    ((at + radius).min(n - 1) - at.saturating_sub(radius) + 1) as f32
}

fn add(a: &mut Pair, b: &Pair) {
    a.iter_mut().zip(b).for_each(|(a, b)| *a += b);
}

fn subtract(a: &mut Pair, b: &Pair) {
    a.iter_mut().zip(b).for_each(|(a, b)| *a -= b);
}

/// Sums over windows along a line.
fn sum_line(line: &[Pair], sums: &mut [Pair], radius: usize) {
    let mut sum = [0.0; 4];
    line[..radius.min(line.len())].iter().for_each(|v| add(&mut sum, v));
    for (x, out) in sums.iter_mut().enumerate() {
        if let Some(v) = line.get(x + radius) {
            add(&mut sum, v);
        }
        if x > radius {
            subtract(&mut sum, &line[x - radius - 1]);
        }
        *out = sum;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RADIUS: usize = 4;

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
            filter.set_guide(&g, RADIUS, 1e-3, &workers);
            filter.run(&g, &workers, |i| v[i]);
            for (got, (re, im)) in filter.result().iter().zip(naive(size, &g, &v, 1e-3)) {
                assert!((f64::from(got[0]) - re).abs() < 1e-4 && (f64::from(got[1]) - im).abs() < 1e-4);
            }
        }
    }
}
