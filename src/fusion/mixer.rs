//! Models that mix: what is made of stage I before the network, and after it.
//!
//! The network sees, for cells of [`CELL`] pixels, [`SEEN`] numbers that do not depend on the direction of polarization, and
//! answers with a real weight for every pixel and each of [`CANDIDATES`] candidates for L = S1 + i·S2, all linear in L; one that asks
//! the readings sees [`TOLD`] more and weighs one more. The correction is their weighted sum; turning the light's polarization turns
//! it. `scripts/train/network.py` is its twin in PyTorch and says why; golden answers hold both together.
//!
//! Levels are grids of cells of 4, 8 and 16 pixels. On each, over 3 × 3 cells: the slope of L on S0 (what polarized detail
//! goes with a detail of brightness) and the degree L/S0, together with the means of S0 and L, all interpolated linearly. With v
//! smoothed over 3 × 3 pixels ⟨v⟩, and v at a level v̄:
//!
//! | candidate | is |
//! |---|---|
//! | 0, 1 | L, L − ⟨L⟩ |
//! | 2, 3 | slope and degree of the first level, times S0 − ⟨S0⟩ |
//! | 4 to 12 | of each level L − L̄; slope and degree, times S0 − S̄0 |
//! | 13 | the back-projected residual R1 + i·R2 |
//! | 14 | of networks that ask the readings: those of [`DETAILS`] with the shares that the whole tile gives them (`shares.rs`) |

use std::ops::Range;

use super::shares::{DETAILS, Power, ROUGH, Shares};
use crate::model::{CANDIDATES, CELL, RESIDUAL, SEEN, TOLD};
use crate::optics::lanes::vectorize;
use crate::parallel::{Shared, Workers};
use crate::plane::Complex32;

/// Sides of the cells of each level, in pixels.
const LEVELS: [usize; 3] = [4, 8, 16];
/// Images of a level: means of S0, S1, S2, then the two components of degree and of slope; the readings are asked about the first.
const IMAGES: usize = 7;
const ASKED: usize = 5;
/// Products whose local means give the slopes: S0, S1, S2, S0², S0·S1, S0·S2.
const PRODUCTS: usize = 6;
/// Variance of S0, in units of its mean square, below which it has no slope.
const FLAT: f32 = 3e-4;
/// S0, in units of its rms, below which it has no degree of polarization.
const DARK: f32 = 0.05;
/// Unit of the residual as a candidate.
const BACK: f32 = 0.3;
/// Planes of a tile: S0, S1, S2, R0, R1, R2.
const PLANES: usize = 6;

/// Numbers that the network sees of a cell: four of every level, these, and the detail of S0 pixel by pixel. What the readings tell of
/// the whole tile comes after them.
mod channel {
    pub(super) const LIGHT: usize = 4 * super::LEVELS.len();
    pub(super) const POLARIZED: usize = LIGHT + 1;
    /// Roots of the mean squares of L − ⟨L⟩, L − L̄ and S0 − ⟨S0⟩.
    pub(super) const ROUGHNESS: usize = LIGHT + 2;
    pub(super) const R0: usize = LIGHT + 5;
    pub(super) const R: usize = LIGHT + 6;
    pub(super) const ALONG: usize = LIGHT + 7;
    pub(super) const DETAIL: usize = LIGHT + 8;
}

/// Buffers for tiles of one size. Steady state allocates nothing.
#[derive(Debug)]
pub(super) struct Mixer {
    side: usize,
    /// The [`IMAGES`] of each level, `[IMAGES, side / cell, side / cell]`.
    levels: [Vec<f32>; LEVELS.len()],
    /// `[PRODUCTS, side / 4, side / 4]`: means over cells, and over their neighbours as well.
    products: Vec<f32>,
    near: Vec<f32>,
    /// Of a network that asks the readings.
    shares: Option<Shares>,
    /// One for each thread.
    rows: Vec<Rows>,
}

/// Rows of a tile, `side` long each.
#[derive(Debug)]
struct Rows {
    /// v − ⟨v⟩ of S0, S1, S2.
    own: [Vec<f32>; 3],
    /// The [`IMAGES`] of a level at a row's pixels.
    images: [Vec<f32>; IMAGES],
    /// Cells, or sums of pixels.
    sums: Vec<f32>,
    /// The weights of one candidate.
    weights: Vec<f32>,
    /// Sums over the rows of a cell of what the roughnesses are the means of.
    squares: [Vec<f32>; 3],
    /// Sums over the rows of a cell of the [`JUDGED`] candidates, real and imaginary parts; empty where nobody asks.
    judged: [[Vec<f32>; 2]; JUDGED],
}

/// Candidates of which the readings are asked: [`DETAILS`], then [`ROUGH`].
const JUDGED: usize = DETAILS.len() + ROUGH.len();

impl Mixer {
    /// Buffers for tiles of `side` pixels, a multiple of the coarsest cell, and teams of `threads`, of a network that `asks` the
    /// readings or not. Allocates.
    pub(super) fn new(side: usize, threads: usize, asks: bool) -> Self {
        let row = || vec![0.0; side];
        let rows = || Rows {
            own: std::array::from_fn(|_| row()),
            images: std::array::from_fn(|_| row()),
            sums: row(),
            weights: row(),
            squares: std::array::from_fn(|_| row()),
            judged: std::array::from_fn(|_| std::array::from_fn(|_| vec![0.0; if asks { side } else { 0 }])),
        };
        let cells = |cell: usize| (side / cell).pow(2);
        Self {
            side,
            levels: LEVELS.map(|cell| vec![0.0; IMAGES * cells(cell)]),
            products: vec![0.0; PRODUCTS * cells(CELL)],
            near: vec![0.0; PRODUCTS * cells(CELL)],
            shares: asks.then(|| Shares::new(side / CELL)),
            rows: (0..threads).map(|_| rows()).collect(),
        }
    }

    /// Bytes of the buffers for tiles of `side` pixels and teams of `threads`.
    pub(super) fn bytes(side: usize, threads: usize, asks: bool) -> usize {
        let cells = |cell: usize| (side / cell).pow(2);
        let levels: usize = LEVELS.iter().map(|cell| IMAGES * cells(*cell)).sum();
        let rows = (IMAGES + 8) * side * size_of::<f32>();
        let asked = || Shares::bytes(side / CELL) + threads * 2 * JUDGED * side * size_of::<f32>();
        (levels + 2 * PRODUCTS * cells(CELL)) * size_of::<f32>() + threads * rows + if asks { asked() } else { 0 }
    }

    /// Multiply-adds of a tile: levels enlarged to be mixed, and to be asked about, and candidates mixed.
    pub(super) fn macs(side: usize, asks: bool) -> u64 {
        let asked = LEVELS.len() * ASKED + 2;
        ((LEVELS.len() * IMAGES + 2 * CANDIDATES + if asks { asked } else { 0 }) * side * side) as u64
    }

    /// What the network sees of a tile `[6, side, side]`, in units of rms(S0), the residuals a thousandfold, behind a PSF of
    /// `power`, which one that asks needs: `[SEEN, side / 4, side / 4]`, 11 more for a network that asks. Keeps what [`Self::mix`] needs of it.
    ///
    /// # Panics
    /// When a length is another, `team` has more threads than there are buffers, or `power` is missing.
    pub(super) fn see(&mut self, planes: &[f32], power: Option<&Power>, seen: &mut [f32], team: &Workers) {
        vectorize!(fearless_simd::Level::new(), s => {
            let _ = s;
            self.describe(planes, seen);
        });
        let (side, levels, cells) = (self.side, &self.levels, (self.side / CELL).pow(2));
        let (shared, rows) = (Shared::new(seen), Shared::new(&mut self.rows));
        let judged = self.shares.as_mut().map(|shares| Shared::new(shares.candidates()));
        team.run(team.threads(), &|task| {
            // SAFETY: every task has buffers of its own.
            #[allow(unsafe_code)]
            let rows = unsafe { &mut rows.slice(task..task + 1)[0] };
            vectorize!(fearless_simd::Level::new(), s => {
                let _ = s;
                look_closely(side, levels, planes, &shared, rows, team.band(task, side / CELL));
                if let Some(judged) = &judged {
                    judge(side, levels, planes, judged, rows, team.band(task, side / CELL));
                }
            });
        });
        if let Some(shares) = &mut self.shares {
            let power = power.expect("a network that asks is told of the PSF");
            let residual = planes[4 * side * side..].chunks_exact(side * side);
            let told = shares.find(residual, RESIDUAL, power);
            for (out, told) in seen[SEEN * cells..].chunks_exact_mut(cells).zip(told) {
                out.fill(told);
            }
        }
        vectorize!(fearless_simd::Level::new(), s => {
            let _ = s;
            seen.iter_mut().for_each(|v| *v /= 1.0 + v.abs());
        });
    }

    /// The weighted sum of the candidates, `[2, side, side]`. `weights` is the network's answer to the tile that [`Self::see`]
    /// was given last, `[16 · CANDIDATES, side / 4, side / 4]`, 16 more of one that asks.
    ///
    /// # Panics
    /// As [`Self::see`].
    pub(super) fn mix(&mut self, planes: &[f32], weights: &[f32], mixed: &mut [f32], team: &Workers) {
        let (side, square) = (self.side, self.side * self.side);
        let candidates = CANDIDATES + usize::from(self.shares.is_some());
        let lengths = (PLANES * square, candidates * square, 2 * square);
        assert_eq!((planes.len(), weights.len(), mixed.len()), lengths, "a tile of another size");
        let (levels, shares) = (&self.levels, self.shares.as_ref().map(Shares::found));
        let (mixed, rows) = (Shared::new(mixed), Shared::new(&mut self.rows));
        team.run(team.threads(), &|task| {
            let band = team.band(task, side);
            // SAFETY: every task has buffers of its own, and of both planes a band of its own.
            #[allow(unsafe_code)]
            let (rows, one, two) = unsafe {
                let plane = |k: usize| mixed.slice(k * square + band.start * side..k * square + band.end * side);
                (&mut rows.slice(task..task + 1)[0], plane(0), plane(1))
            };
            vectorize!(fearless_simd::Level::new(), s => {
                let _ = s;
                sum(side, levels, planes, weights, shares, [&mut *one, &mut *two], rows, band.clone());
            });
        });
    }

    /// The levels, and what is seen of the means over cells.
    #[inline(always)]
    fn describe(&mut self, planes: &[f32], seen: &mut [f32]) {
        let (side, m) = (self.side, self.side / CELL);
        let (square, n) = (side * side, m * m);
        let numbers = SEEN + if self.shares.is_some() { TOLD } else { 0 };
        assert_eq!((planes.len(), seen.len()), (PLANES * square, numbers * n), "a tile of another size");
        let Self { levels, products, near, rows, .. } = self;
        let rows = &mut rows[0];
        let plane = |k: usize| &planes[k * square..][..square];
        let factors = [(0, None), (1, None), (2, None), (0, Some(0)), (0, Some(1)), (0, Some(2))];
        for ((a, b), out) in factors.into_iter().zip(products.chunks_exact_mut(n)) {
            pool(plane(a), b.map(plane), &mut rows.sums, out);
        }
        // Their means lie where what is made of them comes to lie.
        for (out, residual) in seen[channel::R0 * n..].chunks_exact_mut(n).zip(3..PLANES) {
            pool(plane(residual), None, &mut rows.sums, out);
        }
        for i in 0..n {
            let [s0, s1, s2] = [products[i], products[n + i], products[2 * n + i]];
            let [r0, r1, r2] = [channel::R0, channel::R0 + 1, channel::R0 + 2].map(|k| seen[k * n + i]);
            seen[channel::LIGHT * n + i] = s0 - 1.0;
            seen[channel::POLARIZED * n + i] = 3.0 * length(s1, s2);
            seen[channel::R0 * n + i] = 30.0 * r0;
            seen[channel::R * n + i] = 30.0 * length(r1, r2);
            seen[channel::ALONG * n + i] = 100.0 * (s1 * r1 + s2 * r2);
        }
        for (level, cell) in LEVELS.into_iter().enumerate() {
            let m = side / cell;
            let cells = m * m;
            if level > 0 {
                halve(products, m);
            }
            for (from, to) in products.chunks_exact(cells).zip(near.chunks_exact_mut(cells)) {
                smooth(from, m, &mut rows.sums, to);
            }
            let images = &mut levels[level];
            images[..3 * cells].copy_from_slice(&products[..3 * cells]);
            for i in 0..cells {
                let [s0, s1, s2, s00, s01, s02] = std::array::from_fn(|k| near[k * cells + i]);
                let variance = s00 - s0 * s0 + FLAT;
                let slope = [(s01 - s0 * s1) / variance, (s02 - s0 * s2) / variance];
                let degree = [s1 / (s0 + DARK), s2 / (s0 + DARK)];
                images[3 * cells + i] = degree[0];
                images[4 * cells + i] = degree[1];
                images[5 * cells + i] = slope[0];
                images[6 * cells + i] = slope[1];
                // What is seen of them does not depend on the direction.
                near[i] = 3.0 * length(slope[0], slope[1]);
                near[cells + i] = 3.0 * length(degree[0], degree[1]);
                near[2 * cells + i] = 3.0 * (slope[0] * degree[0] + slope[1] * degree[1]);
                near[3 * cells + i] = 3.0 * variance.max(0.0).sqrt();
            }
            for (image, out) in near.chunks_exact(cells).zip(seen[4 * level * n..][..4 * n].chunks_exact_mut(n)) {
                for (y, row) in out.chunks_exact_mut(side / CELL).enumerate() {
                    enlarged(image, m, cell / CELL, y, &mut rows.sums, row);
                }
            }
        }
    }
}

/// What is seen of pixels, in a band of the rows of cells.
#[inline(always)]
fn look_closely(
    side: usize,
    levels: &[Vec<f32>; LEVELS.len()],
    planes: &[f32],
    seen: &Shared<'_, f32>,
    rows: &mut Rows,
    band: Range<usize>,
) {
    let m = side / CELL;
    let (square, n) = (side * side, m * m);
    // SAFETY: of every number that is seen, each row of cells belongs to one band.
    #[allow(unsafe_code)]
    let row_of = |k: usize, j: usize| unsafe { seen.slice(k * n + j * m..k * n + (j + 1) * m) };
    for y in band.start * CELL..band.end * CELL {
        let [s0, s1, s2] = std::array::from_fn(|k| &planes[k * square + y * side..][..side]);
        rows.own(planes, side, y);
        rows.enlarge(&levels[0], side, LEVELS[0], y, 3);
        let Rows { own, images, squares, .. } = rows;
        if y % CELL == 0 {
            squares.iter_mut().for_each(|row| row.fill(0.0));
        }
        for x in 0..side {
            let (d1, d2) = (s1[x] - images[1][x], s2[x] - images[2][x]);
            squares[0][x] += own[1][x] * own[1][x] + own[2][x] * own[2][x];
            squares[1][x] += d1 * d1 + d2 * d2;
            squares[2][x] += own[0][x] * own[0][x];
        }
        for dx in 0..CELL {
            let out = row_of(channel::DETAIL + y % CELL * CELL + dx, y / CELL);
            let detail = s0.as_chunks::<CELL>().0.iter().zip(images[0].as_chunks::<CELL>().0);
            out.iter_mut().zip(detail).for_each(|(v, (s0, mean))| *v = 5.0 * (s0[dx] - mean[dx]));
        }
        if y % CELL == CELL - 1 {
            for (k, squares) in squares.iter().enumerate() {
                let out = row_of(channel::ROUGHNESS + k, y / CELL);
                for (v, squares) in out.iter_mut().zip(squares.as_chunks::<CELL>().0) {
                    *v = 10.0 * (squares.iter().sum::<f32>() / (CELL * CELL) as f32 + 1e-8).sqrt();
                }
            }
        }
    }
}

/// The means of the [`JUDGED`] candidates over cells, in a band of the rows of cells.
#[inline(always)]
fn judge(
    side: usize,
    levels: &[Vec<f32>; LEVELS.len()],
    planes: &[f32],
    judged: &Shared<'_, Complex32>,
    rows: &mut Rows,
    band: Range<usize>,
) {
    let m = side / CELL;
    let square = side * side;
    for j in band {
        rows.judged.iter_mut().flatten().for_each(|sums| sums.fill(0.0));
        for y in j * CELL..(j + 1) * CELL {
            let [s0, s1, s2] = std::array::from_fn(|k| &planes[k * square + y * side..][..side]);
            around(&planes[..square], side, y, &mut rows.sums, &mut rows.own[0]);
            for (level, cell) in LEVELS.into_iter().enumerate() {
                rows.enlarge(&levels[level], side, cell, y, ASKED);
                let Rows { own, images: [mean, mean1, mean2, d1, d2, ..], judged, .. } = &mut *rows;
                if level == 0 {
                    collect(&mut judged[0], |x| (d1[x] * (s0[x] - own[0][x]), d2[x] * (s0[x] - own[0][x])));
                }
                collect(&mut judged[level + 1], |x| (d1[x] * (s0[x] - mean[x]), d2[x] * (s0[x] - mean[x])));
                collect(&mut judged[DETAILS.len() + level], |x| (s1[x] - mean1[x], s2[x] - mean2[x]));
            }
        }
        for (k, [re, im]) in rows.judged.iter().enumerate() {
            // SAFETY: of every candidate, each row of cells belongs to one band.
            #[allow(unsafe_code)]
            let out = unsafe { judged.slice((k * m + j) * m..(k * m + j + 1) * m) };
            let mean = |pixels: &[f32; CELL]| pixels.iter().sum::<f32>() / (CELL * CELL) as f32;
            for (v, (re, im)) in out.iter_mut().zip(re.as_chunks().0.iter().zip(im.as_chunks().0)) {
                *v = Complex32::new(mean(re), mean(im));
            }
        }
    }
}

/// The weighted sum of the candidates in a band of rows, which `mixed` holds.
#[expect(clippy::too_many_arguments, reason = "one loop, called once")]
#[inline(always)]
fn sum(
    side: usize,
    levels: &[Vec<f32>; LEVELS.len()],
    planes: &[f32],
    weights: &[f32],
    shares: Option<[f32; DETAILS.len()]>,
    mixed: [&mut [f32]; 2],
    rows: &mut Rows,
    band: Range<usize>,
) {
    let m = side / CELL;
    let (square, n) = (side * side, m * m);
    let [first, second] = mixed;
    for (y, (one, two)) in band.zip(first.chunks_exact_mut(side).zip(second.chunks_exact_mut(side))) {
        let row = |k: usize| &planes[k * square + y * side..][..side];
        let (s0, s1, s2) = (row(0), row(1), row(2));
        one.fill(0.0);
        two.fill(0.0);
        rows.own(planes, side, y);
        let mut candidate = 0;
        let mut next = |rows: &mut Vec<f32>| {
            let share = shares.and_then(|shares| Some(shares[DETAILS.iter().position(|k| *k == candidate)?]));
            for dx in 0..CELL {
                let of = |k: usize| &weights[(k * CELL * CELL + y % CELL * CELL + dx) * n + y / CELL * m..][..m];
                let to = rows.as_chunks_mut::<CELL>().0.iter_mut().zip(of(candidate));
                match share {
                    None => to.for_each(|(to, v)| to[dx] = *v),
                    Some(share) => to.zip(of(CANDIDATES)).for_each(|((to, v), all)| to[dx] = v + share * all),
                }
            }
            candidate += 1;
        };
        next(&mut rows.weights);
        add(one, two, &rows.weights, s1, s2);
        next(&mut rows.weights);
        add(one, two, &rows.weights, &rows.own[1], &rows.own[2]);
        for (level, cell) in LEVELS.into_iter().enumerate() {
            rows.enlarge(&levels[level], side, cell, y, IMAGES);
            let Rows { own, images: [mean, mean1, mean2, d1, d2, a1, a2], weights, .. } = rows;
            if level == 0 {
                next(weights);
                add_scaled(one, two, weights, &own[0], a1, a2);
                next(weights);
                add_scaled(one, two, weights, &own[0], d1, d2);
            }
            let away = |mean: &mut [f32], v: &[f32]| mean.iter_mut().zip(v).for_each(|(mean, v)| *mean = v - *mean);
            away(mean, s0);
            away(mean1, s1);
            away(mean2, s2);
            next(weights);
            add(one, two, weights, mean1, mean2);
            next(weights);
            add_scaled(one, two, weights, mean, a1, a2);
            next(weights);
            add_scaled(one, two, weights, mean, d1, d2);
        }
        next(&mut rows.weights);
        rows.weights.iter_mut().for_each(|v| *v *= BACK);
        add(one, two, &rows.weights, row(4), row(5));
    }
}

/// Adds a row of `v`, real and imaginary parts.
#[inline(always)]
fn collect([re, im]: &mut [Vec<f32>; 2], v: impl Fn(usize) -> (f32, f32)) {
    for (x, (re, im)) in re.iter_mut().zip(im).enumerate() {
        let (a, b) = v(x);
        *re += a;
        *im += b;
    }
}

impl Rows {
    /// v − ⟨v⟩ of S0, S1 and S2 in row `y`.
    #[inline(always)]
    fn own(&mut self, planes: &[f32], side: usize, y: usize) {
        for (own, plane) in self.own.iter_mut().zip(planes.chunks_exact(side * side)) {
            around(plane, side, y, &mut self.sums, own);
            own.iter_mut().zip(&plane[y * side..]).for_each(|(mean, v)| *mean = v - *mean);
        }
    }

    /// The first `count` images of a level in row `y`.
    #[inline(always)]
    fn enlarge(&mut self, level: &[f32], side: usize, cell: usize, y: usize, count: usize) {
        let m = side / cell;
        for (image, row) in level.chunks_exact(m * m).zip(&mut self.images).take(count) {
            enlarged(image, m, cell, y, &mut self.sums, row);
        }
    }
}

/// one, two += weight · (a, b).
#[inline(always)]
fn add(one: &mut [f32], two: &mut [f32], weights: &[f32], a: &[f32], b: &[f32]) {
    for ((one, two), ((w, a), b)) in one.iter_mut().zip(two).zip(weights.iter().zip(a).zip(b)) {
        *one += w * a;
        *two += w * b;
    }
}

/// one, two += weight · scale · (a, b).
#[inline(always)]
fn add_scaled(one: &mut [f32], two: &mut [f32], weights: &[f32], scale: &[f32], a: &[f32], b: &[f32]) {
    for ((one, two), (((w, s), a), b)) in one.iter_mut().zip(two).zip(weights.iter().zip(scale).zip(a).zip(b)) {
        *one += w * s * a;
        *two += w * s * b;
    }
}

/// Length of a vector, without a corner at zero.
#[inline(always)]
fn length(a: f32, b: f32) -> f32 {
    (a * a + b * b + 1e-8).sqrt()
}

/// Means of `a`, or of `a · b`, over the cells of [`CELL`] pixels.
#[inline(always)]
fn pool(a: &[f32], b: Option<&[f32]>, sums: &mut [f32], out: &mut [f32]) {
    let side = sums.len();
    for (j, out) in out.chunks_exact_mut(side / CELL).enumerate() {
        sums.fill(0.0);
        for y in j * CELL..(j + 1) * CELL {
            let row = &a[y * side..][..side];
            match b {
                Some(b) => {
                    let b = &b[y * side..][..side];
                    sums.iter_mut().zip(row.iter().zip(b)).for_each(|(sum, (a, b))| *sum += a * b);
                }
                None => sums.iter_mut().zip(row).for_each(|(sum, a)| *sum += a),
            }
        }
        for (v, sums) in out.iter_mut().zip(sums.as_chunks::<CELL>().0) {
            *v = sums.iter().sum::<f32>() / (CELL * CELL) as f32;
        }
    }
}

/// Every image of a level to the next, of `m` × `m` cells: means of two by two, in place.
#[inline(always)]
fn halve(images: &mut [f32], m: usize) {
    for i in 0..PRODUCTS * m * m {
        let (row, x) = (i / m, i % m);
        let (above, below) = (2 * row * 2 * m + 2 * x, (2 * row + 1) * 2 * m + 2 * x);
        images[i] = 0.25 * (images[above] + images[above + 1] + images[below] + images[below + 1]);
    }
}

/// Means over 3 × 3 cells, fewer at the border.
#[inline(always)]
fn smooth(image: &[f32], m: usize, sums: &mut [f32], out: &mut [f32]) {
    for (y, row) in out.chunks_exact_mut(m).enumerate() {
        around(image, m, y, sums, row);
    }
}

/// Row `y` of [`smooth`].
#[inline(always)]
fn around(image: &[f32], m: usize, y: usize, sums: &mut [f32], out: &mut [f32]) {
    let (sums, out) = (&mut sums[..m], &mut out[..m]);
    let rows = y.saturating_sub(1)..(y + 2).min(image.len() / m);
    let count = rows.len() as f32;
    sums.fill(0.0);
    for y in rows {
        sums.iter_mut().zip(&image[y * m..][..m]).for_each(|(sum, v)| *sum += v);
    }
    let inner = (3.0 * count).recip();
    for (v, sums) in out[1..].iter_mut().zip(sums.windows(3)) {
        *v = inner * (sums[0] + sums[1] + sums[2]);
    }
    let mean = |sums: &[f32]| sums.iter().sum::<f32>() / (sums.len() as f32 * count);
    out[0] = mean(&sums[..2.min(m)]);
    out[m - 1] = mean(&sums[m.saturating_sub(2)..]);
}

/// Row `y` of an image of `m` × `m` cells, enlarged by `factor` on each axis: linear between the middles of cells.
#[inline(always)]
fn enlarged(image: &[f32], m: usize, factor: usize, y: usize, cells: &mut [f32], row: &mut [f32]) {
    let at = ((y as f32 + 0.5) / factor as f32 - 0.5).clamp(0.0, (m - 1) as f32);
    let (above, part) = (at as usize, at.fract());
    let below = (above + 1).min(m - 1);
    let rows = image[above * m..][..m].iter().zip(&image[below * m..][..m]);
    let cells = &mut cells[..m];
    cells.iter_mut().zip(rows).for_each(|(v, (a, b))| *v = a + part * (b - a));
    match factor {
        1 => row.copy_from_slice(cells),
        2 => spread::<2>(cells, row),
        4 => spread::<4>(cells, row),
        8 => spread::<8>(cells, row),
        16 => spread::<16>(cells, row),
        _ => unreachable!("cells are 4, 8 or 16 pixels or a quarter of it"),
    }
}

#[inline(always)]
fn spread<const F: usize>(cells: &[f32], row: &mut [f32]) {
    let (half, last) = (F / 2, cells.len() - 1);
    row[..half].fill(cells[0]);
    row[last * F + half..].fill(cells[last]);
    for (pair, out) in cells.windows(2).zip(row[half..].as_chunks_mut::<F>().0) {
        for (j, v) in out.iter_mut().enumerate() {
            *v = pair[0] + (pair[1] - pair[0]) * ((j as f32 + 0.5) / F as f32);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A tile in which everything differs from everything.
    fn tile(side: usize) -> Vec<f32> {
        let wave = |k: usize, i: usize| {
            let (x, y) = ((i % side) as f32, (i / side) as f32);
            (0.3 * x * (1.0 + 0.2 * k as f32) + k as f32).sin() * (0.17 * y - 0.05 * x * k as f32).cos()
        };
        let offset = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0];
        (0..PLANES).flat_map(|k| (0..side * side).map(move |i| offset[k] + 0.2 * wave(k, i))).collect()
    }

    fn answer(side: usize, planes: &[f32], threads: usize, asks: bool) -> (Vec<f32>, Vec<f32>) {
        let (mut mixer, team) = (Mixer::new(side, threads, asks), Workers::new(threads));
        let (numbers, candidates) = if asks { (SEEN + TOLD, CANDIDATES + 1) } else { (SEEN, CANDIDATES) };
        let (mut seen, mut mixed) = (vec![f32::NAN; numbers * (side / CELL).pow(2)], vec![f32::NAN; 2 * side * side]);
        mixer.see(planes, Some(&Power::of(&vec![0.5; side * side], side)), &mut seen, &team);
        let weights: Vec<f32> =
            (0..candidates * side * side).map(|i| ((i * 7919 % 1009) as f32 / 500.0) - 1.0).collect();
        mixer.mix(planes, &weights, &mut mixed, &team);
        (seen, mixed)
    }

    #[test]
    fn turning_the_polarization_turns_the_answer_and_nothing_that_is_seen() {
        for (side, asks) in [(16, false), (16, true), (48, false), (48, true)] {
            let planes = tile(side);
            let (sin, cos) = 1.1f32.sin_cos();
            let turn = |planes: &mut [f32], n: usize| {
                let (a, b) = planes.split_at_mut(n);
                a.iter_mut().zip(b).for_each(|(a, b)| (*a, *b) = (cos * *a - sin * *b, sin * *a + cos * *b));
            };
            let n = side * side;
            let mut turned = planes.clone();
            turn(&mut turned[n..3 * n], n);
            turn(&mut turned[4 * n..], n);
            let ((seen, mut mixed), (seen_turned, mixed_turned)) =
                (answer(side, &planes, 1, asks), answer(side, &turned, 3, asks));
            turn(&mut mixed, n);
            let worst = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(seen.iter().chain(&mixed).all(|v| v.is_finite()));
            assert!(worst(&seen, &seen_turned) < 1e-5, "{side}: {}", worst(&seen, &seen_turned));
            assert!(worst(&mixed, &mixed_turned) < 1e-4, "{side}: {}", worst(&mixed, &mixed_turned));
            assert!(mixed.iter().any(|v| v.abs() > 0.1));
        }
    }

    #[test]
    fn an_enlarged_ramp_is_a_ramp_between_the_middles_of_the_outer_cells() {
        let m = 5;
        let ramp: Vec<f32> = (0..m * m).map(|i| (i % m) as f32 + 10.0 * (i / m) as f32).collect();
        for factor in [1, 2, 4, 8, 16] {
            let (mut cells, mut row) = (vec![0.0; m], vec![0.0; m * factor]);
            for y in 0..m * factor {
                enlarged(&ramp, m, factor, y, &mut cells, &mut row);
                let at = |i: usize| ((i as f32 + 0.5) / factor as f32 - 0.5).clamp(0.0, (m - 1) as f32);
                row.iter().enumerate().for_each(|(x, v)| assert!((v - at(x) - 10.0 * at(y)).abs() < 1e-4));
            }
        }
    }

    #[test]
    fn means_at_the_border_are_those_of_fewer_cells() {
        let image = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0];
        let (mut sums, mut out) = ([0.0; 3], [0.0; 9]);
        smooth(&image, 3, &mut sums, &mut out);
        assert_eq!(out, [3.0, 3.5, 4.0, 4.5, 5.0, 5.5, 6.0, 6.5, 7.0]);
        let mut one = [0.0];
        smooth(&[4.0], 1, &mut sums, &mut one);
        assert_eq!(one, [4.0]);
    }

    #[test]
    fn the_buffers_are_as_large_as_stated() {
        for (side, threads, asks) in [(16, 1, true), (256, 3, false), (256, 3, true)] {
            let Mixer { levels, products, near, rows, shares, side: _ } = Mixer::new(side, threads, asks);
            let of_row = |rows: &Rows| {
                let Rows { own, images, sums, weights, squares, judged } = rows;
                let floats =
                    own.iter().chain(images).chain([sums, weights]).chain(squares).map(Vec::len).sum::<usize>();
                floats + judged.iter().flatten().map(Vec::len).sum::<usize>()
            };
            let all = levels.iter().chain([&products, &near]).map(Vec::len).sum::<usize>();
            let all = all + rows.iter().map(of_row).sum::<usize>();
            let shares = shares.map_or(0, |_| Shares::bytes(side / CELL));
            assert_eq!(all * size_of::<f32>() + shares, Mixer::bytes(side, threads, asks));
        }
    }
}
