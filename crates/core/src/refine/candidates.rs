//! The features that a network is given, and the candidates whose weighted sum is the correction.
//!
//! Computed for cells of [`CELL`] pixels, the [`FEATURES`] do not depend on the direction of polarization. The last [`TILE_FEATURES`]
//! of them come from the readings of the whole tile (`shares.rs`). The network answers with a real weight for each pixel and each
//! of the [`CANDIDATES`] for L = S1 + i·S2. All candidates are linear in L, so that turning the light's polarization turns the
//! correction. `scripts/train/network.py` computes the same in PyTorch and gives the reasons; golden files compare both.
//!
//! A level is a grid of cells of 4, 8 or 16 pixels. Each level has, as means over 3 × 3 cells, the slope of L on S0 (the polarized
//! detail that goes with a detail of brightness) and the degree L/S0, and the means of S0 and L over each cell. All are interpolated
//! linearly. Below, ⟨v⟩ is the mean of v over 3 × 3 pixels and v̄ the interpolated mean of a level:
//!
//! | candidate | definition |
//! |---|---|
//! | 0, 1 | L, L − ⟨L⟩ |
//! | 2, 3 | slope and degree of the first level, times S0 − ⟨S0⟩ |
//! | 4 to 12 | for each level L − L̄; slope and degree, times S0 − S̄0 |
//! | 13 | the back-projected residual R1 + i·R2 |
//! | 14 | Σ degree · (a·d + b·\|d\| + c·d·(S̄0 − 1)) over the details d of 3, 6, 9 and 12, with the shares a, b, c of the whole tile |

use std::ops::Range;

use super::shares::{FITTED, KINDS, Power, ROUGH, SCALES, Shares};
use crate::image::Buffers;
use crate::optics::lanes::vectorize;
use crate::parallel::{StridedMut, Workers};
use crate::refine::model::{CANDIDATES, CELL, FEATURES, LOCAL_FEATURES, RESIDUAL, TILE_FEATURES};

/// Side of the cells of each level in pixels.
const LEVELS: [usize; 3] = [4, 8, 16];
/// Images of a level: means of S0, S1, S2, then two components each of degree and slope.
const IMAGES: usize = 7;
// The finest scale of detail is that of pixels against their neighbours; each level adds one.
const _: () = assert!(SCALES == 1 + LEVELS.len() && ROUGH == LEVELS.len());
/// Products whose local means give slope and degree: S0, S1, S2, S0², S0·S1, S0·S2.
const PRODUCTS: usize = 6;
/// Added to the variance of S0 in the slope's denominator, in units of mean S0².
const FLAT: f32 = 3e-4;
/// Added to S0 in the degree's denominator, in units of rms(S0).
const DARK: f32 = 0.05;
/// Factor of the residual as a candidate.
const BACK: f32 = 0.3;
/// Planes of a tile: S0, S1, S2, R0, R1, R2.
pub(super) const PLANES: usize = 6;

/// Indices of the features. The first are four of each level; those of the whole tile follow the last.
mod feature {
    /// Mean of S0.
    pub(super) const BRIGHTNESS: usize = 4 * super::LEVELS.len();
    /// |mean of L|.
    pub(super) const POLARIZED: usize = BRIGHTNESS + 1;
    /// Root mean squares of L − ⟨L⟩, L − L̄ and S0 − ⟨S0⟩.
    pub(super) const ROUGHNESS: usize = BRIGHTNESS + 2;
    /// Mean of R0.
    pub(super) const R0: usize = BRIGHTNESS + 5;
    /// |mean of R1 + i·R2|.
    pub(super) const R: usize = BRIGHTNESS + 6;
    /// Product of the means of L and R1 + i·R2.
    pub(super) const ALONG: usize = BRIGHTNESS + 7;
    /// S0 − S̄0 of the first level, for each pixel of the cell.
    pub(super) const DETAIL: usize = BRIGHTNESS + 8;
}

/// Buffers for tiles of one size. After construction nothing is allocated.
#[derive(Debug)]
pub(super) struct Candidates {
    side: usize,
    /// The [`IMAGES`] of each level, `[IMAGES, side / cell, side / cell]`.
    levels: [Vec<f32>; LEVELS.len()],
    /// Means of the products over the cells of a level, `[PRODUCTS, side / 4, side / 4]`.
    products: Vec<f32>,
    /// `products` averaged over 3 × 3 cells.
    near: Vec<f32>,
    shares: Shares,
    /// One for each thread.
    rows: Vec<Rows>,
}

/// One thread's rows of a tile, `side` values each.
#[derive(Debug)]
struct Rows {
    /// v − ⟨v⟩ of S0, S1, S2.
    own: [Vec<f32>; 3],
    /// The [`IMAGES`] of a level at a row's pixels.
    images: [Vec<f32>; IMAGES],
    /// A buffer for sums of pixels or for cells.
    sums: Vec<f32>,
    /// The weights of one candidate.
    weights: Vec<f32>,
    /// The weights of the candidate that the readings' shares make.
    share_weights: Vec<f32>,
    /// S0 − S̄0 of a level.
    detail: Vec<f32>,
    /// Sums over a cell's rows of the squares behind each roughness.
    squares: [Vec<f32>; 3],
    /// Sums over a cell's rows of each scale of detail and of its magnitude.
    details: [[Vec<f32>; 2]; SCALES],
    /// Sums over a cell's rows of L − L̄ of the first level.
    rest: [Vec<f32>; 2],
}

impl Rows {
    /// Rows that `row` makes.
    fn new(mut row: impl FnMut() -> Vec<f32>) -> Self {
        Self {
            own: std::array::from_fn(|_| row()),
            images: std::array::from_fn(|_| row()),
            sums: row(),
            weights: row(),
            share_weights: row(),
            detail: row(),
            squares: std::array::from_fn(|_| row()),
            details: std::array::from_fn(|_| [row(), row()]),
            rest: [row(), row()],
        }
    }
}

impl Candidates {
    /// Buffers for tiles of `side` pixels, a multiple of 16, and teams of `threads`.
    pub(super) fn new(buffers: &mut Buffers, side: usize, threads: usize) -> Self {
        let cells = |cell: usize| (side / cell).pow(2);
        Self {
            side,
            levels: LEVELS.map(|cell| buffers.filled(0.0, IMAGES * cells(cell))),
            products: buffers.filled(0.0, PRODUCTS * cells(CELL)),
            near: buffers.filled(0.0, PRODUCTS * cells(CELL)),
            shares: Shares::new(buffers, side / CELL),
            rows: (0..threads).map(|_| Rows::new(|| buffers.filled(0.0, side))).collect(),
        }
    }

    /// Multiply-adds of a tile: interpolation of the levels and the weighted sum.
    pub(super) fn macs(side: usize) -> u64 {
        ((LEVELS.len() * IMAGES + 2 * CANDIDATES) * side * side) as u64
    }

    /// Computes the features `[FEATURES, side / 4, side / 4]` of a tile `[6, side, side]` behind a PSF of `power`. S0, S1, S2 are in
    /// units of rms(S0), R0, R1, R2 in units of rms(S0)/[`RESIDUAL`]. Keeps what [`Self::mix`] needs.
    ///
    /// # Panics
    /// When a length is wrong, or `team` has more threads than there are buffers.
    pub(super) fn describe(&mut self, planes: &[f32], power: &Power, features: &mut [f32], team: &Workers) {
        vectorize!(fearless_simd::Level::new(), s => {
            let _ = s;
            self.average(planes, features);
        });
        let (side, levels, cells) = (self.side, &self.levels, (self.side / CELL).pow(2));
        let local = team.strided_bands_mut(&mut features[..LOCAL_FEATURES * cells], LOCAL_FEATURES, side / CELL);
        let (candidates, len) = (self.shares.candidates(), 2 * (FITTED + ROUGH));
        let candidates = team.strided_bands_mut(candidates, len, side / CELL);
        let rows = team.each_mut(&mut self.rows);
        team.run(team.threads(), &|task| {
            let (rows, mut local, mut candidates) = (rows.take(task), local.take(task), candidates.take(task));
            vectorize!(fearless_simd::Level::new(), s => {
                let _ = s;
                describe_rows(levels, planes, &mut local, &mut candidates, rows, team.band(task, side / CELL));
            });
        });
        let (_, residual) = planes.split_at(4 * side * side);
        let (r1, r2) = residual.split_at(side * side);
        let found: [f32; TILE_FEATURES] = self.shares.find([r1, r2], RESIDUAL, power);
        for (out, found) in features[LOCAL_FEATURES * cells..].chunks_exact_mut(cells).zip(found) {
            out.fill(found);
        }
        vectorize!(fearless_simd::Level::new(), s => {
            let _ = s;
            features.iter_mut().for_each(|v| *v /= 1.0 + v.abs());
        });
    }

    /// Computes the weighted sum of the candidates, `[2, side, side]`. `planes` is the tile that [`Self::describe`] was last called with,
    /// `weights` the network's output for it, `[16 · CANDIDATES, side / 4, side / 4]`.
    ///
    /// # Panics
    /// As [`Self::describe`].
    pub(super) fn mix(&mut self, planes: &[f32], weights: &[f32], mixed: &mut [f32], team: &Workers) {
        let (side, square) = (self.side, self.side * self.side);
        let lengths = (PLANES * square, CANDIDATES * square, 2 * square);
        assert_eq!((planes.len(), weights.len(), mixed.len()), lengths, "a tile of another size");
        let (levels, shares) = (&self.levels, self.shares.shares());
        let (first, second) = mixed.split_at_mut(square);
        let (first, second) = (team.bands_mut(first, side), team.bands_mut(second, side));
        let rows = team.each_mut(&mut self.rows);
        team.run(team.threads(), &|task| {
            let (rows, one, two) = (rows.take(task), first.take(task), second.take(task));
            vectorize!(fearless_simd::Level::new(), s => {
                let _ = s;
                sum(levels, planes, weights, &shares, [&mut *one, &mut *two], rows, team.band(task, side));
            });
        });
    }

    /// Computes the levels, and the features that are means over cells.
    #[inline(always)]
    fn average(&mut self, planes: &[f32], features: &mut [f32]) {
        let (side, m) = (self.side, self.side / CELL);
        let (square, n) = (side * side, m * m);
        assert_eq!((planes.len(), features.len()), (PLANES * square, FEATURES * n), "a tile of another size");
        let Self { levels, products, near, shares, rows, .. } = self;
        let (rows, (r1, r2)) = (&mut rows[0], shares.residual().split_at_mut(n));
        let plane = |k: usize| &planes[k * square..][..square];
        let factors = [(0, None), (1, None), (2, None), (0, Some(0)), (0, Some(1)), (0, Some(2))];
        for ((a, b), out) in factors.into_iter().zip(products.chunks_exact_mut(n)) {
            pool(plane(a), b.map(plane), &mut rows.sums, out);
        }
        for (out, residual) in [&mut features[feature::R0 * n..][..n], &mut *r1, &mut *r2].into_iter().zip(3..PLANES) {
            pool(plane(residual), None, &mut rows.sums, out);
        }
        for i in 0..n {
            let [s0, s1, s2] = [products[i], products[n + i], products[2 * n + i]];
            let [r0, r1, r2] = [features[feature::R0 * n + i], r1[i], r2[i]];
            features[feature::BRIGHTNESS * n + i] = s0 - 1.0;
            features[feature::POLARIZED * n + i] = 3.0 * length(s1, s2);
            features[feature::R0 * n + i] = 30.0 * r0;
            features[feature::R * n + i] = 30.0 * length(r1, r2);
            features[feature::ALONG * n + i] = 100.0 * (s1 * r1 + s2 * r2);
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
                // Features must not depend on the direction of polarization.
                near[i] = 3.0 * length(slope[0], slope[1]);
                near[cells + i] = 3.0 * length(degree[0], degree[1]);
                near[2 * cells + i] = 3.0 * (slope[0] * degree[0] + slope[1] * degree[1]);
                near[3 * cells + i] = 3.0 * variance.max(0.0).sqrt();
            }
            for (image, out) in near.chunks_exact(cells).zip(features[4 * level * n..][..4 * n].chunks_exact_mut(n)) {
                for (y, row) in out.chunks_exact_mut(side / CELL).enumerate() {
                    enlarged(image, m, cell / CELL, y, &mut rows.sums, row);
                }
            }
        }
    }
}

/// Computes the features that depend on single pixels, and the candidates of `shares.rs`, in a band of the rows of cells.
#[inline(always)]
fn describe_rows(
    levels: &[Vec<f32>; LEVELS.len()],
    planes: &[f32],
    features: &mut StridedMut<'_, f32>,
    candidates: &mut StridedMut<'_, f32>,
    rows: &mut Rows,
    band: Range<usize>,
) {
    let side = rows.sums.len();
    let (m, square) = (side / CELL, side * side);
    for (at, j) in band.enumerate() {
        let part = at * m..(at + 1) * m;
        rows.squares
            .iter_mut()
            .chain(rows.details.as_flattened_mut())
            .chain(&mut rows.rest)
            .for_each(|row| row.fill(0.0));
        for y in j * CELL..(j + 1) * CELL {
            let [s0, s1, s2] = std::array::from_fn(|k| &planes[k * square + y * side..][..side]);
            rows.own(planes, side, y);
            rows.enlarge(&levels[0], side, LEVELS[0], y, 3);
            let Rows { own, images, sums, squares, details, rest, .. } = &mut *rows;
            for x in 0..side {
                let (d1, d2) = (s1[x] - images[1][x], s2[x] - images[2][x]);
                squares[0][x] += own[1][x] * own[1][x] + own[2][x] * own[2][x];
                squares[1][x] += d1 * d1 + d2 * d2;
                squares[2][x] += own[0][x] * own[0][x];
                rest[0][x] += d1;
                rest[1][x] += d2;
            }
            for dx in 0..CELL {
                let out = &mut features.group_mut(feature::DETAIL + y % CELL * CELL + dx)[part.clone()];
                let detail = s0.as_chunks::<CELL>().0.iter().zip(images[0].as_chunks::<CELL>().0);
                out.iter_mut().zip(detail).for_each(|(v, (s0, mean))| *v = 5.0 * (s0[dx] - mean[dx]));
            }
            collect(&mut details[0], |x| own[0][x]);
            for (level, details) in details[1..].iter_mut().enumerate() {
                if level > 0 {
                    let m = side / LEVELS[level];
                    enlarged(&levels[level][..m * m], m, LEVELS[level], y, sums, &mut images[0]);
                }
                collect(details, |x| s0[x] - images[0][x]);
            }
        }
        for (k, squares) in rows.squares.iter().enumerate() {
            let out = &mut features.group_mut(feature::ROUGHNESS + k)[part.clone()];
            for (v, squares) in out.iter_mut().zip(squares.as_chunks().0) {
                *v = 10.0 * (mean(squares) + 1e-8).sqrt();
            }
        }
        share_candidates(levels, candidates, part, rows, j);
    }
}

/// Row `j` of the cells of the candidates for `shares.rs`, `[FITTED + ROUGH, 2, side / 4, side / 4]`, at `row` of the band. `rows` holds
/// the sums of that row.
#[inline(always)]
fn share_candidates(
    levels: &[Vec<f32>; LEVELS.len()],
    candidates: &mut StridedMut<'_, f32>,
    row: Range<usize>,
    rows: &mut Rows,
    j: usize,
) {
    let side = rows.sums.len();
    let m = side / CELL;
    for k in 0..SCALES {
        let level = k.saturating_sub(1);
        rows.enlarge_by(&levels[level], side / LEVELS[level], LEVELS[level] / CELL, j, 5);
        let Rows { images: [bright, mean1, mean2, degree @ ..], details, rest, weights, share_weights, .. } =
            &mut *rows;
        let (detail, size) = (&mut weights[..m], &mut share_weights[..m]);
        for (out, sums) in [&mut *detail, &mut *size].into_iter().zip(&details[k]) {
            out.iter_mut().zip(sums.as_chunks().0).for_each(|(v, sums)| *v = mean(sums));
        }
        for part in 0..2 {
            for kind in 0..KINDS {
                let out = &mut candidates.group_mut(2 * (kind * SCALES + k) + part)[row.clone()];
                let given = detail.iter().zip(&*size).zip(bright.iter().zip(&degree[part]));
                for (v, ((detail, size), (bright, degree))) in out.iter_mut().zip(given) {
                    *v = degree * [*detail, *size, detail * (bright - 1.0)][kind];
                }
            }
            if k > 0 {
                let out = &mut candidates.group_mut(2 * (FITTED + level) + part)[row.clone()];
                if level == 0 {
                    out.iter_mut().zip(rest[part].as_chunks().0).for_each(|(v, sums)| *v = mean(sums));
                } else {
                    let light = &levels[0][(1 + part) * m * m + j * m..][..m];
                    let away = light.iter().zip([&*mean1, &*mean2][part]);
                    out.iter_mut().zip(away).for_each(|(v, (light, mean))| *v = light - mean);
                }
            }
        }
    }
}

/// The mean over a cell, from the sums over its columns.
#[inline(always)]
fn mean(sums: &[f32; CELL]) -> f32 {
    sums.iter().sum::<f32>() / (CELL * CELL) as f32
}

/// Adds a row of details and of their magnitudes.
#[inline(always)]
fn collect([sum, size]: &mut [Vec<f32>; 2], detail: impl Fn(usize) -> f32) {
    for (x, (sum, size)) in sum.iter_mut().zip(size).enumerate() {
        let d = detail(x);
        *sum += d;
        *size += d.abs();
    }
}

/// Writes the weighted sum of the candidates in a band of rows to `mixed`.
#[inline(always)]
fn sum(
    levels: &[Vec<f32>; LEVELS.len()],
    planes: &[f32],
    weights: &[f32],
    shares: &[[f32; SCALES]; KINDS],
    mixed: [&mut [f32]; 2],
    rows: &mut Rows,
    band: Range<usize>,
) {
    let side = rows.sums.len();
    let square = side * side;
    let [first, second] = mixed;
    for (y, (one, two)) in band.zip(first.chunks_exact_mut(side).zip(second.chunks_exact_mut(side))) {
        let row = |k: usize| &planes[k * square + y * side..][..side];
        let (s0, s1, s2) = (row(0), row(1), row(2));
        one.fill(0.0);
        two.fill(0.0);
        rows.own(planes, side, y);
        spread_weights(weights, CANDIDATES - 1, y, &mut rows.share_weights);
        spread_weights(weights, 0, y, &mut rows.weights);
        add(one, two, &rows.weights, s1, s2);
        spread_weights(weights, 1, y, &mut rows.weights);
        add(one, two, &rows.weights, &rows.own[1], &rows.own[2]);
        for (level, cell) in LEVELS.into_iter().enumerate() {
            rows.enlarge(&levels[level], side, cell, y, IMAGES);
            let Rows { own, images, weights: row, share_weights, detail, .. } = &mut *rows;
            let [bright, mean1, mean2, d1, d2, a1, a2] = images;
            let of = |k: usize| shares.map(|kind| kind[k]);
            if level == 0 {
                spread_weights(weights, 2, y, row);
                add_scaled(one, two, row, &own[0], a1, a2);
                spread_weights(weights, 3, y, row);
                weigh_detail(row, share_weights, of(0), &own[0], bright);
                add(one, two, row, d1, d2);
            }
            detail.iter_mut().zip(s0.iter().zip(&*bright)).for_each(|(d, (v, mean))| *d = v - mean);
            let away = |mean: &mut [f32], v: &[f32]| mean.iter_mut().zip(v).for_each(|(mean, v)| *mean = v - *mean);
            away(mean1, s1);
            away(mean2, s2);
            spread_weights(weights, 4 + 3 * level, y, row);
            add(one, two, row, mean1, mean2);
            spread_weights(weights, 5 + 3 * level, y, row);
            add_scaled(one, two, row, detail, a1, a2);
            spread_weights(weights, 6 + 3 * level, y, row);
            weigh_detail(row, share_weights, of(level + 1), detail, bright);
            add(one, two, row, d1, d2);
        }
        spread_weights(weights, 13, y, &mut rows.weights);
        rows.weights.iter_mut().for_each(|v| *v *= BACK);
        add(one, two, &rows.weights, row(4), row(5));
    }
}

/// Row `y` of the weights of one candidate. The network gives the weights of each pixel of a cell in a plane of its own.
#[inline(always)]
fn spread_weights(weights: &[f32], candidate: usize, y: usize, row: &mut [f32]) {
    let m = row.len() / CELL;
    let of = |dx: usize| &weights[(candidate * CELL * CELL + y % CELL * CELL + dx) * m * m + y / CELL * m..][..m];
    let cells = of(0).iter().zip(of(1)).zip(of(2).iter().zip(of(3)));
    for (to, ((a, b), (c, d))) in row.as_chunks_mut::<CELL>().0.iter_mut().zip(cells) {
        *to = [*a, *b, *c, *d];
    }
}

/// The factor of the degree of polarization: weight · d + share weight · (a·d + b·|d| + c·d·(brightness − 1)) with the detail d and its
/// shares a, b, c.
#[inline(always)]
fn weigh_detail(weights: &mut [f32], share_weights: &[f32], [a, b, c]: [f32; KINDS], detail: &[f32], bright: &[f32]) {
    for ((weight, share), (d, bright)) in weights.iter_mut().zip(share_weights).zip(detail.iter().zip(bright)) {
        *weight = *weight * d + share * (a * d + b * d.abs() + c * d * (bright - 1.0));
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
        self.enlarge_by(level, side / cell, cell, y, count);
    }

    /// As [`Self::enlarge`], for a level of `m` × `m` cells enlarged by `factor`. Fills the first `m · factor` values of the rows.
    #[inline(always)]
    fn enlarge_by(&mut self, level: &[f32], m: usize, factor: usize, y: usize, count: usize) {
        for (image, row) in level.chunks_exact(m * m).zip(&mut self.images).take(count) {
            enlarged(image, m, factor, y, &mut self.sums, &mut row[..m * factor]);
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

/// Length of a vector, smooth at zero.
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

/// Averages 2 × 2 cells of every image, in place, to `m` × `m` cells.
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

/// Row `y` of an image of `m` × `m` cells, enlarged by `factor` along each axis: linear interpolation between the centres of cells.
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

/// [`enlarged`] along one row.
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

    /// A tile in which no two values are alike.
    fn tile(side: usize) -> Vec<f32> {
        let wave = |k: usize, i: usize| {
            let (x, y) = ((i % side) as f32, (i / side) as f32);
            (0.3 * x * (1.0 + 0.2 * k as f32) + k as f32).sin() * (0.17 * y - 0.05 * x * k as f32).cos()
        };
        let offset = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0];
        (0..PLANES).flat_map(|k| (0..side * side).map(move |i| offset[k] + 0.2 * wave(k, i))).collect()
    }

    fn answer(side: usize, planes: &[f32], threads: usize) -> (Vec<f32>, Vec<f32>) {
        let mut candidates = Buffers::allocate(|buffers| Candidates::new(buffers, side, threads));
        let team = Workers::new(threads);
        let (mut features, mut mixed) =
            (vec![f32::NAN; FEATURES * (side / CELL).pow(2)], vec![f32::NAN; 2 * side * side]);
        candidates.describe(planes, &Power::new(&vec![0.5; side * side], side), &mut features, &team);
        let weights: Vec<f32> =
            (0..CANDIDATES * side * side).map(|i| ((i * 7919 % 1009) as f32 / 500.0) - 1.0).collect();
        candidates.mix(planes, &weights, &mut mixed, &team);
        (features, mixed)
    }

    #[test]
    fn turning_the_polarization_turns_the_correction_and_leaves_the_features() {
        for side in [16, 48] {
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
            let ((features, mut mixed), (features_turned, mixed_turned)) =
                (answer(side, &planes, 1), answer(side, &turned, 3));
            turn(&mut mixed, n);
            let worst = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(features.iter().chain(&mixed).all(|v| v.is_finite()));
            assert!(worst(&features, &features_turned) < 1e-5, "{side}: {}", worst(&features, &features_turned));
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
}
