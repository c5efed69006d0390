//! The guided filter (He, Sun, Tang: "Guided Image Filtering", 2013) for a complex image and a real guide.
//!
//! In each window of (2r+1)² pixels the image is modelled as c·g + b; c and b are then averaged over all windows that hold a
//! pixel. Edges of the guide pass, structure that is not in the guide is averaged. Windows are cut at the borders.
//!
//! The filter is a stream: rows go in, filtered rows come out 2r rows later, and only the rows in between are kept, so that its
//! memory lies in the cache however large the image is.

use std::ops::Range;

use fearless_simd::prelude::*;
use fearless_simd::{Level, f32x8};

use crate::image::Size;
use crate::optics::lanes::{LANES, Lanes, Wave, spread_real, vectorize};
use crate::parallel::Workers;

/// The largest window radius. Radii are 1 or 4: sums of three, taken once or twice, are sums over windows then.
const LARGEST_RADIUS: usize = 4;
/// Zeros before and behind a row, for the windows that reach beyond it.
const MARGIN: usize = LANES;
/// Rounding of a variance, in units of the mean square. Below it a guide counts as flat whatever ε says, or windows of equal values would
/// have any slope.
const ROUNDING: f32 = 1e-6;
/// Images that are summed together: L and g·L, or c and b, real and imaginary parts.
const IMAGES: usize = 4;

/// Eight real values of a row.
pub(super) type Reals = [f32; LANES];

/// Window statistics of one guide.
#[derive(Debug)]
pub(super) struct GuidedFilter {
    size: Size,
    /// Window radius in pixels.
    radius: usize,
    /// Mean of the guide in the window around each pixel, rows filled up to whole lanes.
    mean: Vec<Reals>,
    /// 1 / (variance + ε), never more than rounding allows ([`ROUNDING`]).
    precision: Vec<Reals>,
    /// 1 / width of the window around each column.
    share: Vec<Reals>,
}

/// The rows in between, of one band of an image.
#[derive(Debug)]
pub(super) struct Stream {
    /// Sums of the image, then of the model.
    sums: [BoxSum; 2],
    guide: Vec<Reals>,
    row: Vec<Lanes>,
    out: Vec<Lanes>,
}

impl Stream {
    /// Buffers for rows of `width`. Allocates.
    pub(super) fn new(width: usize) -> Self {
        let lanes = width.div_ceil(LANES);
        Self {
            sums: [BoxSum::new(width), BoxSum::new(width)],
            guide: vec![[0.0; LANES]; lanes],
            row: vec![Lanes::ZERO; lanes],
            out: vec![Lanes::ZERO; lanes],
        }
    }

    /// Bytes of one.
    pub(super) fn bytes(width: usize) -> usize {
        2 * BoxSum::bytes(width) + width.div_ceil(LANES) * (size_of::<Reals>() + 2 * size_of::<Lanes>())
    }
}

impl GuidedFilter {
    /// Tables for frames of `size`. Allocates.
    pub(super) fn new(size: Size) -> Self {
        let lanes = size.width.div_ceil(LANES);
        let reals = |n: usize| vec![[0.0; LANES]; n];
        Self {
            size,
            radius: 1,
            mean: reals(lanes * size.height),
            precision: reals(lanes * size.height),
            share: reals(lanes),
        }
    }

    /// Bytes of one filter.
    pub(super) fn bytes(size: Size) -> usize {
        size.width.div_ceil(LANES) * (2 * size.height + 1) * size_of::<Reals>()
    }

    /// Rows by which the filtered rows are behind.
    pub(super) fn delay(&self) -> usize {
        2 * self.radius
    }

    /// Takes the statistics of `guide` in windows of `radius`, 1 or 4; `epsilon` is the variance below which it counts as flat.
    /// One stream for each thread; they are garbage afterwards.
    pub(super) fn set_guide(
        &mut self,
        guide: &[f32],
        radius: usize,
        epsilon: f32,
        workers: &Workers,
        streams: &mut [Stream],
    ) {
        assert!(radius == 1 || radius == LARGEST_RADIUS, "no windows of radius {radius}");
        self.radius = radius;
        let Size { width, height } = self.size;
        for (x, share) in self.share.as_flattened_mut().iter_mut().enumerate() {
            *share = if x < width { 1.0 / window_len(x, width, radius) } else { 0.0 };
        }
        let (epsilon, share) = (epsilon.max(f32::MIN_POSITIVE), &self.share);
        let (mean, precision) =
            (workers.bands_mut(&mut self.mean, height), workers.bands_mut(&mut self.precision, height));
        let streams = workers.each_mut(streams);
        workers.run(workers.threads(), &|task| {
            let Stream { sums: [sums, _], .. } = streams.take(task);
            sums.clear();
            let mut tables = mean.take_rows(task).zip(precision.take_rows(task));
            for (at, j) in reach(&workers.band(task, height), radius).enumerate() {
                let inside = usize::try_from(j).ok().filter(|j| *j < height);
                let table = if at >= 2 * radius { tables.next() } else { None };
                vectorize!(Level::new(), s => {
                    if let Some(j) = inside {
                        sums.row(0).copy_from_slice(&guide[j * width..(j + 1) * width]);
                        let squares = sums.row(1).iter_mut().zip(&guide[j * width..]);
                        squares.for_each(|(square, g)| *square = g * g);
                    }
                    sums.push::<2>(radius, at, inside.is_some());
                    if let Some(((y, mean), (_, precision))) = table {
                        statistics(s, sums, share, 1.0 / window_len(y, height, radius), epsilon, mean, precision);
                    }
                });
            }
        });
    }

    /// Takes row `at` of a band of the image into the stream, counted from the first of [`Self::reach`], and gives the filtered
    /// row [`Self::delay`] rows before it, once it belongs to the band. Rows outside of the image are not looked at.
    pub(super) fn push<'a>(
        &self,
        band: &Range<usize>,
        at: usize,
        row: &[Lanes],
        guide: &[f32],
        stream: &'a mut Stream,
    ) -> Option<(usize, &'a [Lanes])> {
        let (Size { width, height }, radius) = (self.size, self.radius);
        let of_guide = |y: usize| &guide[y * width..(y + 1) * width];
        let inside = |behind: usize| (band.start + at).checked_sub(behind).filter(|y| *y < height);
        let Stream { sums: [first, second], guide, out, .. } = stream;
        if at == 0 {
            first.clear();
            second.clear();
        }
        // Rows of the image, of the model and of the result, each a radius behind the one before.
        let (j, model, result) = (inside(2 * radius), inside(3 * radius), inside(4 * radius));
        vectorize!(Level::new(), s => {
            if let Some(j) = j {
                spread_real(of_guide(j), guide);
                load(s, row, guide, first);
            }
            first.push::<IMAGES>(radius, at, j.is_some());
            if at >= 2 * radius {
                if let Some(y) = model {
                    let part = y * self.share.len()..(y + 1) * self.share.len();
                    let rows = 1.0 / window_len(y, height, radius);
                    fit(s, first, &self.share, rows, &self.mean[part.clone()], &self.precision[part], second);
                }
                second.push::<IMAGES>(radius, at - 2 * radius, model.is_some());
            }
            if at >= 4 * radius && let Some(y) = result {
                spread_real(of_guide(y), guide);
                apply(s, second, &self.share, 1.0 / window_len(y, height, radius), guide, out);
            }
        });
        result.filter(|_| at >= 4 * radius).map(|y| (y, &out[..]))
    }

    /// Rows that [`Self::push`] needs for a band.
    pub(super) fn reach(&self, band: &Range<usize>) -> impl Iterator<Item = isize> + use<> {
        reach(band, self.delay())
    }

    /// Filters an image: `load(y, row)` fills a row, `store(y, row, out)` takes a filtered one and writes its row of `out`
    /// (`out.len() / height` values). Rows come from any thread, and those between two bands are loaded twice.
    pub(super) fn run<T: Send>(
        &self,
        guide: &[f32],
        workers: &Workers,
        streams: &mut [Stream],
        load: impl Fn(usize, &mut [Lanes]) + Sync,
        out: &mut [T],
        store: impl Fn(usize, &[Lanes], &mut [T]) + Sync,
    ) {
        let height = self.size.height;
        let (streams, out) = (workers.each_mut(streams), workers.bands_mut(out, height));
        workers.run(workers.threads(), &|task| {
            let (stream, mut out) = (streams.take(task), out.take_rows(task));
            let band = workers.band(task, height);
            let mut row = std::mem::take(&mut stream.row);
            for (at, j) in self.reach(&band).enumerate() {
                if let Some(j) = usize::try_from(j).ok().filter(|j| *j < height) {
                    load(j, &mut row);
                }
                if let Some((y, filtered)) = self.push(&band, at, &row, guide, stream)
                    && let Some((_, out)) = out.next()
                {
                    store(y, filtered, out);
                }
            }
            stream.row = row;
        });
    }
}

/// Rows from `by` before a band to `by` behind it; none for an empty one.
fn reach(band: &Range<usize>, by: usize) -> impl Iterator<Item = isize> + use<> {
    let by = if band.is_empty() { 0 } else { by as isize };
    band.start as isize - by..band.end as isize + by
}

/// Pixels of a window along one axis of `n`, around `at`.
fn window_len(at: usize, n: usize, radius: usize) -> f32 {
    ((at + radius).min(n - 1) - at.saturating_sub(radius) + 1) as f32
}

/// A row of the image and its product with the guide.
#[inline(always)]
fn load<S: Simd>(s: S, row: &[Lanes], guide: &[Reals], sums: &mut BoxSum) {
    let [a, b, c, d] = sums.rows();
    for (i, (v, g)) in row.iter().zip(guide).enumerate() {
        let Wave { re, im } = Wave::load(s, v);
        let g = f32x8::simd_from(s, *g);
        (a[i], b[i], c[i], d[i]) = (re.into(), im.into(), (re * g).into(), (im * g).into());
    }
}

/// Mean and precision of the guide from the sums of it and its squares.
#[inline(always)]
fn statistics<S: Simd>(
    s: S,
    sums: &BoxSum,
    share: &[Reals],
    rows: f32,
    epsilon: f32,
    mean: &mut [Reals],
    precision: &mut [Reals],
) {
    let [sum, squares, ..] = sums.sums();
    for (i, share) in share.iter().enumerate() {
        let share = f32x8::simd_from(s, *share) * rows;
        let m = f32x8::simd_from(s, sum[i]) * share;
        let square = f32x8::simd_from(s, squares[i]) * share;
        let variance = (square - m * m).max(f32x8::splat(s, 0.0));
        mean[i] = m.into();
        precision[i] = (f32x8::splat(s, 1.0) / (variance + square.mul_add(f32x8::splat(s, ROUNDING), epsilon))).into();
    }
}

/// The model of each window: c and b.
#[inline(always)]
fn fit<S: Simd>(
    s: S,
    sums: &BoxSum,
    share: &[Reals],
    rows: f32,
    mean: &[Reals],
    precision: &[Reals],
    models: &mut BoxSum,
) {
    let [re, im, gre, gim] = sums.sums();
    let [a, b, c, d] = models.rows();
    for (i, share) in share.iter().enumerate() {
        let share = f32x8::simd_from(s, *share) * rows;
        let (mean, precision) = (f32x8::simd_from(s, mean[i]), f32x8::simd_from(s, precision[i]));
        let of = |sum: Reals| f32x8::simd_from(s, sum) * share;
        let (re, im) = (of(re[i]), of(im[i]));
        let (cre, cim) = ((of(gre[i]) - mean * re) * precision, (of(gim[i]) - mean * im) * precision);
        (a[i], b[i]) = (cre.into(), cim.into());
        (c[i], d[i]) = ((re - cre * mean).into(), (im - cim * mean).into());
    }
}

/// The averaged models at the guide's values.
#[inline(always)]
fn apply<S: Simd>(s: S, models: &BoxSum, share: &[Reals], rows: f32, guide: &[Reals], out: &mut [Lanes]) {
    let [cre, cim, bre, bim] = models.sums();
    for (i, (share, out)) in share.iter().zip(out).enumerate() {
        let share = f32x8::simd_from(s, *share) * rows;
        let g = f32x8::simd_from(s, guide[i]);
        let at = |c: Reals, b: Reals| f32x8::simd_from(s, c).mul_add(g, f32x8::simd_from(s, b)) * share;
        Wave { re: at(cre[i], bre[i]), im: at(cim[i], bim[i]) }.store(out);
    }
}

/// Sums over windows of several images at once, row by row.
///
/// Those of nine rows are carried on, and made anew every nine rows, so that the rounding of bright rows does not stay below them; those
/// of three rows, for guides that may have no noise at all, are made anew always.
#[derive(Debug)]
struct BoxSum {
    width: usize,
    /// The row to be added: `MARGIN` zeros, the row, zeros, for each image.
    line: Vec<f32>,
    /// Sums of three of it.
    triple: Vec<f32>,
    /// Sums over widths of the latest 2r + 1 rows.
    ring: Vec<f32>,
    /// Sums over windows, image after image.
    sum: Vec<f32>,
}

impl BoxSum {
    fn new(width: usize) -> Self {
        let row = width.next_multiple_of(LANES);
        let reals = |n: usize| vec![0.0; IMAGES * n];
        Self {
            width,
            line: reals(row + 2 * MARGIN),
            triple: vec![0.0; row + 2 * MARGIN],
            ring: reals((2 * LARGEST_RADIUS + 1) * row),
            sum: reals(row),
        }
    }

    fn bytes(width: usize) -> usize {
        let row = width.next_multiple_of(LANES);
        let of_image = row + 2 * MARGIN + (2 * LARGEST_RADIUS + 1) * row + row;
        (IMAGES * of_image + row + 2 * MARGIN) * size_of::<f32>()
    }

    fn clear(&mut self) {
        self.line.fill(0.0);
        self.ring.fill(0.0);
        self.sum.fill(0.0);
    }

    /// The row to be added, of image `k`.
    #[inline(always)]
    fn row(&mut self, k: usize) -> &mut [f32] {
        let padded = self.line.len() / IMAGES;
        &mut self.line[k * padded + MARGIN..][..self.width]
    }

    /// The row to be added, of all images, filled up to whole lanes.
    #[inline(always)]
    fn rows(&mut self) -> [&mut [Reals]; IMAGES] {
        let padded = self.line.len() / IMAGES;
        let mut lines = self.line.chunks_exact_mut(padded);
        let lines: [_; IMAGES] = std::array::from_fn(|_| lines.next().unwrap_or_default());
        lines.map(|line| line[MARGIN..padded - MARGIN].as_chunks_mut().0)
    }

    /// Sums over the windows around the row `radius` before the latest.
    #[inline(always)]
    fn sums(&self) -> [&[Reals]; IMAGES] {
        let row = self.sum.len() / IMAGES;
        std::array::from_fn(|k| self.sum[k * row..(k + 1) * row].as_chunks().0)
    }

    /// Takes the row of the first `N` images into the sums, or zeros if it lies outside of the image. `at` counts the rows.
    #[inline(always)]
    fn push<const N: usize>(&mut self, radius: usize, at: usize, inside: bool) {
        let Self { width, line, triple, ring, sum } = self;
        let (row, padded) = (sum.len() / IMAGES, line.len() / IMAGES);
        let (rows, slot) = (2 * radius + 1, at % (2 * radius + 1));
        for k in 0..N {
            let (mine, sum) = (&mut ring[(slot * IMAGES + k) * row..][..row], &mut sum[k * row..(k + 1) * row]);
            if !inside {
                leave(sum, mine);
                continue;
            }
            let line = &mut line[k * padded..(k + 1) * padded];
            line[MARGIN + *width..].fill(0.0);
            if radius == 1 {
                replace::<1>(sum, mine, &line[MARGIN - 1..]);
            } else {
                triples(line, triple);
                replace::<3>(sum, mine, &triple[MARGIN - LARGEST_RADIUS..]);
            }
        }
        if radius == 1 || slot + 1 == rows {
            let sum = &mut sum[..N * row];
            sum.copy_from_slice(&ring[..N * row]);
            for j in 1..rows {
                sum.iter_mut().zip(&ring[j * IMAGES * row..]).for_each(|(sum, v)| *sum += *v);
            }
        }
    }
}

/// out[i] = v[i] + v[i + 1] + v[i + 2]
#[inline(always)]
fn triples(v: &[f32], out: &mut [f32]) {
    let n = v.len() - 2;
    for (out, ((a, b), c)) in out[..n].iter_mut().zip(v[..n].iter().zip(&v[1..n + 1]).zip(&v[2..n + 2])) {
        *out = a + b + c;
    }
}

/// Puts v[i] + v[i + STEP] + v[i + 2·STEP] in the place of ring[i], in the sum as well.
#[inline(always)]
fn replace<const STEP: usize>(sum: &mut [f32], ring: &mut [f32], v: &[f32]) {
    let n = sum.len();
    let values = v[..n].iter().zip(&v[STEP..n + STEP]).zip(&v[2 * STEP..n + 2 * STEP]);
    for ((sum, ring), ((a, b), c)) in sum.iter_mut().zip(ring).zip(values) {
        let new = a + b + c;
        *sum += new - *ring;
        *ring = new;
    }
}

#[inline(always)]
fn leave(sum: &mut [f32], ring: &mut [f32]) {
    for (sum, ring) in sum.iter_mut().zip(ring) {
        *sum -= *ring;
        *ring = 0.0;
    }
}

#[cfg(test)]
mod tests {
    use num_complex::Complex32;

    use super::*;
    use crate::optics::lanes::{collect, spread};

    /// The definition, window by window, in f64.
    fn naive(size: Size, radius: usize, g: &[f32], v: &[Complex32], epsilon: f64) -> Vec<(f64, f64)> {
        let window = |i: usize| {
            let (y, x) = (i / size.width, i % size.width);
            let range = |at: usize, n: usize| at.saturating_sub(radius)..(at + radius).min(n - 1) + 1;
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
            for (radius, epsilon) in [(4, 1e-3), (1, 1e-3)] {
                let mut filter = GuidedFilter::new(size);
                let mut streams: Vec<_> = (0..threads).map(|_| Stream::new(size.width)).collect();
                for sums in streams.iter_mut().flat_map(|s| &mut s.sums) {
                    for v in [&mut sums.line, &mut sums.triple, &mut sums.ring, &mut sums.sum] {
                        v.fill(f32::NAN);
                    }
                }
                let mut out = vec![Complex32::ZERO; n];
                filter.set_guide(&g, radius, epsilon, &workers, &mut streams);
                let load = |y: usize, line: &mut [Lanes]| spread(&v[y * size.width..(y + 1) * size.width], line);
                filter.run(&g, &workers, &mut streams, load, &mut out, |_, line, out| collect(line, out));
                for (got, (re, im)) in out.iter().zip(naive(size, radius, &g, &v, f64::from(epsilon))) {
                    assert!((f64::from(got.re) - re).abs() < 1e-4 && (f64::from(got.im) - im).abs() < 1e-4);
                }
            }
        }
    }

    /// A guide without noise (ε 0) that is black, saturated, and dark below what is bright: rounding passes for no slope.
    #[test]
    fn an_exact_guide_passes_itself() {
        let size = Size::new(40, 90);
        let g: Vec<f32> = (0..size.pixels())
            .map(|i| match i / size.width {
                0..20 => 1.0,
                20..45 => 0.0,
                45..60 => 0.7 + 0.3 * (i as f32 * 0.7).sin(),
                _ => 2.5e-3 + 2e-4 * (i as f32 * 0.9).sin(),
            })
            .collect();
        let workers = Workers::new(1);
        let (mut filter, mut streams) = (GuidedFilter::new(size), vec![Stream::new(size.width)]);
        let mut out = vec![Complex32::ZERO; size.pixels()];
        filter.set_guide(&g, 1, 0.0, &workers, &mut streams);
        let load = |y: usize, line: &mut [Lanes]| {
            let row: Vec<_> = g[y * size.width..(y + 1) * size.width].iter().map(|g| Complex32::from(*g)).collect();
            spread(&row, line);
        };
        filter.run(&g, &workers, &mut streams, load, &mut out, |_, line, out| collect(line, out));
        for (i, (got, want)) in out.iter().zip(&g).enumerate() {
            assert!((got.re - want).abs() <= 1e-5 + 1e-3 * want, "row {}: {got} for {want}", i / size.width);
        }
    }
}
