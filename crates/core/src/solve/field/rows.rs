//! The row steps of an iteration: data, prior and TV steps of up to two fields, in one pass over their rows.
//!
//! Threads share the rows in bands. A band begins with what it needs of its neighbours ([`exchange`]), then each row goes through
//! every step while it lies in the cache; the filter's rows come late, so some rows of x are kept ([`RING`]).

use fearless_simd::prelude::*;
use fearless_simd::{Level, f32x8};

use super::{Field, Multipliers, Penalties};
use crate::image::Size;
use crate::optics::lanes::{LANES, Lanes, Wave, at, clear_from, put, spread_real, vectorize};
use crate::optics::{Convolver, FftScratch, Way};
use crate::parallel::Shared;
use crate::solve::guided_filter::{GuidedFilter, Reals, Stream};

/// The proximal step of the prior on x + u, for the fields of an iteration. The filtered image is that of the last field.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::solve) enum Pull {
    /// x + u, not negative.
    Positive,
    /// The filtered image, not negative.
    FilteredPositive,
    /// The filtered image, no longer than the guide.
    Filtered,
    /// S0 and the filtered image at the nearest point of the cone |L| ≤ S0.
    Cone,
}

/// What the row steps of an iteration work with beside the fields. Planes are `[H, W]`.
#[derive(Clone, Copy, Debug)]
pub(in crate::solve) struct Surroundings<'a> {
    pub(in crate::solve) convolver: &'a Convolver,
    pub(in crate::solve) target: &'a [f32],
    pub(in crate::solve) weight: &'a [f32],
    pub(in crate::solve) filter: &'a GuidedFilter,
    /// The guide of the filter and of [`Pull::Filtered`].
    pub(in crate::solve) guide: &'a [f32],
    /// Weights of the TV of the last field beside a guide.
    pub(in crate::solve) edges: &'a [f32],
    pub(in crate::solve) pull: Pull,
    /// TV threshold.
    pub(in crate::solve) threshold: f32,
}

/// Rows of x that are kept: as many as the largest filter is behind, the present one and the next.
const RING: usize = 10;

/// The buffers of one thread's band of rows, for up to two fields.
#[derive(Debug)]
pub(in crate::solve) struct Band {
    pub(super) fft: FftScratch,
    /// The latest rows of x, padded.
    ring: [Vec<Lanes>; 2],
    /// The row of x behind the band.
    pub(super) next: [Vec<Lanes>; 2],
    /// What flows down out of the latest row; at first, out of the row before the band.
    flow: [Vec<Lanes>; 2],
    /// x + u of the rows around the band that the filter reaches: those before, then those behind.
    around: Vec<Lanes>,
    /// x + u of a row.
    input: Vec<Lanes>,
    responses: [Vec<Lanes>; 2],
    reals: [Vec<Reals>; 2],
}

impl Band {
    fn new(c: &Convolver) -> Self {
        let (lanes, blocks) = (c.size().width.div_ceil(LANES), c.row_lanes());
        let rows = |n: usize, width: usize| vec![Lanes::ZERO; n * width];
        let row = || rows(1, lanes);
        Self {
            fft: c.row_fft().make_scratch(),
            ring: [rows(RING, blocks), rows(RING, blocks)],
            next: [rows(1, blocks), rows(1, blocks)],
            flow: [row(), row()],
            around: rows(2 * (RING - 2), lanes),
            input: row(),
            responses: [row(), row()],
            reals: [vec![[0.0; LANES]; lanes], vec![[0.0; LANES]; lanes]],
        }
    }

    /// One for each thread. Allocates.
    pub(in crate::solve) fn for_threads(c: &Convolver) -> Vec<Self> {
        (0..c.workers().threads()).map(|_| Self::new(c)).collect()
    }

    /// Bytes of those of all threads.
    pub(in crate::solve) fn bytes(c: &Convolver) -> usize {
        let (lanes, blocks) = (c.size().width.div_ceil(LANES), c.row_lanes());
        let rows = (2 * RING + 2) * blocks + (2 * (RING - 2) + 5) * lanes;
        let band = rows * size_of::<Lanes>() + 2 * lanes * size_of::<Reals>();
        c.workers().threads() * (band + c.row_fft().make_scratch().bytes())
    }
}

/// The data, prior and TV steps of an iteration on `K` fields, from x and k * x to the right-hand sides of the image steps.
/// `response(k, y, row)` fills row y of the responses e_k; the squared residuals of the present x are summed for each row into
/// `energies`. One band and one stream for each thread.
pub(in crate::solve) fn row_steps<const K: usize>(
    mut fields: [&mut Field; K],
    around: Surroundings<'_>,
    p: Penalties,
    response: impl Fn(usize, usize, &mut [Lanes]) + Sync,
    (bands, streams): (&mut [Band], &mut [Stream]),
    energies: &mut [f32],
) {
    let c = around.convolver;
    let (Size { width, height }, blocks) = (c.size(), c.row_lanes());
    let (lanes, workers, fft) = (width.div_ceil(LANES), c.workers(), c.row_fft());
    // The filter reads ahead of the band and its rows come late; without it the row below is all that is needed.
    let (ahead, behind) = around.reach();
    exchange(&mut fields, around, p, bands);
    let state = fields.map(|f| {
        let (image, blurred) = (Shared::new(&mut f.image), Shared::new(&mut f.blurred));
        (image, blurred, Shared::new(&mut f.blur_dual), Shared::new(&mut f.multipliers))
    });
    let (bands, streams, energies) = (Shared::new(bands), Shared::new(streams), Shared::new(energies));
    workers.run(workers.threads(), &|task| {
        let band = workers.band(task, height);
        if band.is_empty() {
            return;
        }
        // SAFETY: each task has buffers of its own.
        #[allow(unsafe_code)]
        let (own, stream) = unsafe { (&mut bands.slice(task..task + 1)[0], &mut streams.slice(task..task + 1)[0]) };
        let Band { fft: scratch, ring, next, flow, around: halo, input, responses, reals } = own;
        let padded = |y: usize| y * blocks..(y + 1) * blocks;
        let sensor = |y: usize| y * lanes..(y + 1) * lanes;
        for step in 0..band.len() + ahead + behind {
            let j = (band.start + step).checked_sub(ahead).filter(|j| *j < height);
            if let Some(j) = j.filter(|j| band.contains(j)) {
                // SAFETY: each row belongs to one task.
                #[allow(unsafe_code)]
                let (images, mut blurred, mut duals, multipliers, energy) = unsafe {
                    (
                        state.each_ref().map(|f| &*f.0.slice(padded(j))),
                        state.each_ref().map(|f| f.1.slice(padded(j))),
                        state.each_ref().map(|f| f.2.slice(sensor(j))),
                        &*state[K - 1].3.slice(sensor(j)),
                        &mut energies.slice(j..j + 1)[0],
                    )
                };
                for (k, image) in images.into_iter().enumerate() {
                    let x = &mut ring[k][j % RING * blocks..][..blocks];
                    x.copy_from_slice(image);
                    fft.line(Way::Inverse, x, scratch);
                    crop(x, width);
                    fft.line(Way::Inverse, blurred[k], scratch);
                    response(k, j, &mut responses[k]);
                }
                spread_real(&around.target[j * width..(j + 1) * width], &mut reals[0]);
                spread_real(&around.weight[j * width..(j + 1) * width], &mut reals[1]);
                *energy =
                    vectorize!(Level::new(), s => data_row(s, &mut blurred, &mut duals, responses, reals, p.blur));
                for row in blurred {
                    row[lanes..].fill(Lanes::ZERO);
                    fft.line(Way::Forward, row, scratch);
                }
                if ahead > 0 {
                    let x = &ring[K - 1][j % RING * blocks..][..lanes];
                    vectorize!(Level::new(), s => prior_input(s, x, multipliers, p.rescale, input));
                }
            }
            let (y, filtered) = if ahead > 0 {
                let row = match j {
                    Some(j) if j < band.start => &halo[(j + ahead - band.start) * lanes..][..lanes],
                    Some(j) if j >= band.end => &halo[(j - band.end + ahead) * lanes..][..lanes],
                    _ => &input[..],
                };
                match around.filter.push(&band, step, row, around.guide, stream) {
                    Some(row) => row,
                    None => continue,
                }
            } else {
                match (band.start + step).checked_sub(behind).filter(|y| band.contains(y)) {
                    Some(y) => (y, &[][..]),
                    None => continue,
                }
            };
            // SAFETY: each row belongs to one task; this one is no longer read.
            #[allow(unsafe_code)]
            let (mut out, mut multipliers) = unsafe {
                (state.each_ref().map(|f| f.0.slice(padded(y))), state.each_ref().map(|f| f.3.slice(sensor(y))))
            };
            let here: [&[Lanes]; K] = std::array::from_fn(|k| &ring[k][y % RING * blocks..][..blocks]);
            let below: [&[Lanes]; K] = std::array::from_fn(|k| match y + 1 {
                below if below == height => here[k],
                below if below == band.end => &next[k],
                below => &ring[k][below % RING * blocks..][..blocks],
            });
            if y == 0 {
                flow.iter_mut().zip(here).for_each(|(flow, here)| flow.copy_from_slice(&here[..lanes]));
            }
            let [guide, edges] = &mut *reals;
            if ahead > 0 {
                spread_real(&around.guide[y * width..(y + 1) * width], guide);
                spread_real(&around.edges[y * width..(y + 1) * width], edges);
            }
            let rows = PriorRows { here, below, filtered, guide, edges, last: y + 1 == height };
            vectorize!(Level::new(), s => prior_row(s, rows, around, p, &mut multipliers, flow, &mut out));
            for (k, out) in out.into_iter().enumerate() {
                let (first, last) = (at(here[k], 0) * p.gradient, at(here[k], width - 1) * p.gradient);
                put(out, 0, at(out, 0) + first);
                put(out, width - 1, at(out, width - 1) + last);
                clear_from(out, width);
                put(out, width, -last);
                put(out, c.padded().width - 1, -first);
                fft.line(Way::Forward, out, scratch);
            }
            for (row, mine) in [(height, y + 1 == height), (height + 1, y == 0)] {
                for (k, field) in state.iter().enumerate().filter(|_| mine) {
                    // SAFETY: the row after the sensor belongs to the task of the last row, the last padded one to that of the first.
                    #[allow(unsafe_code)]
                    let out = unsafe { field.0.slice(padded(row)) };
                    out.copy_from_slice(here[k]);
                    clear_from(out, width);
                    out.iter_mut().flat_map(|v| v.re.iter_mut().chain(&mut v.im)).for_each(|v| *v *= -p.gradient);
                    fft.line(Way::Forward, out, scratch);
                }
            }
        }
    });
}

impl Surroundings<'_> {
    /// Rows that are looked at before the one that is worked on is: beyond the band, and in all.
    fn reach(&self) -> (usize, usize) {
        match self.pull {
            Pull::Positive => (0, 1),
            _ => (self.filter.delay(), self.filter.delay()),
        }
    }
}

/// What a band needs of its neighbours, before anything is overwritten: x + u as far as the filter reaches, the row of x behind,
/// and what flows down from the row before.
fn exchange<const K: usize>(fields: &mut [&mut Field; K], around: Surroundings<'_>, p: Penalties, bands: &mut [Band]) {
    let c = around.convolver;
    let (Size { width, height }, blocks) = (c.size(), c.row_lanes());
    let lanes = width.div_ceil(LANES);
    let (ahead, behind) = around.reach();
    for task in 1..bands.len() {
        let edge = c.workers().band(task, height).start;
        if edge == 0 || edge == height {
            continue;
        }
        let [.., upper, lower] = &mut bands[..=task] else { continue };
        for (k, field) in fields.iter().enumerate() {
            for j in edge.saturating_sub(behind)..(edge + behind).min(height) {
                let row = &mut upper.next[k];
                row.copy_from_slice(&field.image[j * blocks..(j + 1) * blocks]);
                c.row_fft().line(Way::Inverse, row, &mut upper.fft);
                crop(row, width);
                let multipliers = &field.multipliers[j * lanes..(j + 1) * lanes];
                if ahead > 0 && k + 1 == K {
                    let (halo, at) = match j.checked_sub(edge) {
                        Some(at) => (&mut upper.around, at + ahead),
                        None => (&mut lower.around, j + ahead - edge),
                    };
                    let halo = &mut halo[at * lanes..(at + 1) * lanes];
                    vectorize!(Level::new(), s => prior_input(s, row, multipliers, p.rescale, halo));
                }
                if j + 1 == edge {
                    lower.next[k].copy_from_slice(row);
                } else if j == edge {
                    let above = &field.multipliers[(j - 1) * lanes..j * lanes];
                    spread_real(&around.edges[(j - 1) * width..j * width], &mut upper.reals[1]);
                    let edges = (ahead > 0 && k + 1 == K).then_some(&upper.reals[1][..]);
                    let (here, flow) = (&lower.next[k], &mut lower.flow[k]);
                    vectorize!(Level::new(), s => flow_row(s, here, row, above, edges, around.threshold, p.rescale, flow));
                    // The row that the band above keeps is this one, not the later ones that only the filter needs.
                    lower.next[k].copy_from_slice(row);
                }
            }
            upper.next[k].copy_from_slice(&lower.next[k]);
        }
    }
}

/// Repeats the last value of the sensor's part of a row, so that the difference across the border is zero; zeros follow.
fn crop(row: &mut [Lanes], width: usize) {
    put(row, width, at(row, width - 1));
    clear_from(row, width + 1);
}

/// The data step on a row; the sum of its squared residuals.
#[inline(always)]
fn data_row<S: Simd, const K: usize>(
    s: S,
    blurred: &mut [&mut [Lanes]; K],
    duals: &mut [&mut [Lanes]; K],
    responses: &[Vec<Lanes>; 2],
    [target, weight]: &[Vec<Reals>; 2],
    rho: f32,
) -> f32 {
    let mut energy = f32x8::splat(s, 0.0);
    for (i, (target, weight)) in target.iter().zip(weight).enumerate() {
        let weight = f32x8::simd_from(s, *weight);
        let (mut read, mut dual, mut norm) = (f32x8::splat(s, 0.0), f32x8::splat(s, 0.0), f32x8::splat(s, rho));
        for k in 0..K {
            let e = Wave::load(s, &responses[k][i]);
            read += e.inner(Wave::load(s, &blurred[k][i]));
            dual += e.inner(Wave::load(s, &duals[k][i]));
            norm += e.norm_sqr();
        }
        let r = weight * (f32x8::simd_from(s, *target) - read);
        energy = r.mul_add(r, energy);
        let step = (r - weight * dual) / norm;
        for k in 0..K {
            let d = Wave::load(s, &responses[k][i]).scale(step);
            Wave::load(s, &duals[k][i]).plus(d, f32x8::splat(s, 2.0)).store(&mut blurred[k][i]);
            Wave { re: -d.re, im: -d.im }.store(&mut duals[k][i]);
        }
    }
    <[f32; LANES]>::from(energy).iter().sum()
}

/// x + u, u being the multiplier of z = x.
#[inline(always)]
fn prior_input<S: Simd>(s: S, x: &[Lanes], multipliers: &[Multipliers], rescale: f32, out: &mut [Lanes]) {
    let rescale = f32x8::splat(s, rescale);
    for ((x, m), out) in x.iter().zip(multipliers).zip(out) {
        Wave::load(s, x).plus(Wave::load(s, &m.prior), rescale).store(out);
    }
}

/// What [`prior_row`] reads.
#[derive(Clone, Copy)]
struct PriorRows<'a, const K: usize> {
    /// x, padded, the first value behind the sensor repeating the last one in it.
    here: [&'a [Lanes]; K],
    /// x in the row below.
    below: [&'a [Lanes]; K],
    /// The filtered image; empty if there is none.
    filtered: &'a [Lanes],
    guide: &'a [Reals],
    edges: &'a [Reals],
    /// Whether this is the sensor's last row.
    last: bool,
}

/// The prior and TV steps on a row, and the right-hand side of the image step but for what crosses the left and right border.
/// `flow` is what came down from the row above, then what goes down from this one.
#[inline(always)]
fn prior_row<S: Simd, const K: usize>(
    s: S,
    rows: PriorRows<'_, K>,
    around: Surroundings<'_>,
    p: Penalties,
    multipliers: &mut [&mut [Multipliers]; K],
    flow: &mut [Vec<Lanes>; 2],
    out: &mut [&mut [Lanes]; K],
) {
    let number = |v: f32| f32x8::splat(s, v);
    let (rescale, prior, gradient) = (number(p.rescale), number(p.prior), number(p.gradient));
    let (zero, tiny) = (number(0.0), number(f32::MIN_POSITIVE));
    let filtered = around.pull != Pull::Positive;
    // What came from the left.
    let mut left = [Wave::zero(s); K];
    for i in 0..flow[0].len() {
        let here: [Wave<S>; K] = std::array::from_fn(|k| Wave::load(s, &rows.here[k][i]));
        let mut input = here;
        for k in 0..K {
            input[k] = here[k].plus(Wave::load(s, &multipliers[k][i].prior), rescale);
        }
        let mut pulled = input;
        let last = &mut pulled[K - 1];
        if filtered {
            *last = Wave::load(s, &rows.filtered[i]);
        }
        match around.pull {
            Pull::Positive | Pull::FilteredPositive => *last = Wave { re: last.re.max(zero), im: zero },
            Pull::Filtered => {
                // DoLP ≤ 1: L·min(1, S0/|L|).
                let length = last.norm_sqr().sqrt().max(tiny);
                *last = last.scale((f32x8::simd_from(s, rows.guide[i]) / length).min(number(1.0)));
            }
            Pull::Cone => {
                // The nearest point of the cone, on its surface unless inside; its tip for all that lies beyond.
                let length = last.norm_sqr().sqrt().max(tiny);
                let s0 = pulled[0].re;
                let middle = ((s0 + length) * 0.5).max(zero);
                let inside = length.simd_le(s0);
                pulled[K - 1] = pulled[K - 1].scale(inside.select(number(1.0), middle / length));
                pulled[0] = Wave { re: inside.select(s0, middle), im: zero };
            }
        }
        for k in 0..K {
            let m = &mut multipliers[k][i];
            let mut threshold = number(around.threshold);
            if filtered && k + 1 == K {
                threshold *= f32x8::simd_from(s, rows.edges[i]);
            }
            let ahead = rows.here[k].get(i + 1).map_or(Wave::zero(s), |v| Wave::load(s, v));
            let below = Wave::load(s, &rows.below[k][i]);
            let ([across, down], [aside, mut onward]) = shrink(s, [here[k], ahead, below], m, rescale, threshold);
            let dual = input[k] - pulled[k];
            dual.store(&mut m.prior);
            across.store(&mut m.across);
            down.store(&mut m.down);
            if rows.last {
                onward = Wave { re: -here[k].re, im: -here[k].im };
            }
            let before = Wave { re: left[k].re.slide::<7>(aside.re), im: left[k].im.slide::<7>(aside.im) };
            let divergence = before - aside + Wave::load(s, &flow[k][i]) - onward;
            left[k] = aside;
            onward.store(&mut flow[k][i]);
            (pulled[k] - dual).scale(prior).plus(divergence, gradient).store(&mut out[k][i]);
        }
    }
}

/// Isotropic shrinkage of v = gradient + u to the right and down, for x `here`, in the next eight columns and below: the new u,
/// and d − u.
#[inline(always)]
fn shrink<S: Simd>(
    s: S,
    [here, ahead, below]: [Wave<S>; 3],
    m: &Multipliers,
    rescale: f32x8<S>,
    threshold: f32x8<S>,
) -> ([Wave<S>; 2], [Wave<S>; 2]) {
    let right = Wave { re: here.re.slide::<1>(ahead.re), im: here.im.slide::<1>(ahead.im) };
    let across = (right - here).plus(Wave::load(s, &m.across), rescale);
    let down = (below - here).plus(Wave::load(s, &m.down), rescale);
    let length = (across.norm_sqr() + down.norm_sqr()).sqrt().max(f32x8::splat(s, f32::MIN_POSITIVE));
    let cut = (threshold / length).min(f32x8::splat(s, 1.0));
    // 1 − cut is kept.
    let rest = f32x8::splat(s, 1.0) - cut - cut;
    ([across.scale(cut), down.scale(cut)], [across.scale(rest), down.scale(rest)])
}

/// What flows down from a row.
#[inline(always)]
#[allow(clippy::too_many_arguments, reason = "an inlined loop body")]
fn flow_row<S: Simd>(
    s: S,
    here: &[Lanes],
    below: &[Lanes],
    multipliers: &[Multipliers],
    edges: Option<&[Reals]>,
    threshold: f32,
    rescale: f32,
    flow: &mut [Lanes],
) {
    for (i, (flow, m)) in flow.iter_mut().zip(multipliers).enumerate() {
        let ahead = here.get(i + 1).map_or(Wave::zero(s), |v| Wave::load(s, v));
        let x = [Wave::load(s, &here[i]), ahead, Wave::load(s, &below[i])];
        let mut threshold = f32x8::splat(s, threshold);
        if let Some(edges) = edges {
            threshold *= f32x8::simd_from(s, edges[i]);
        }
        shrink(s, x, m, f32x8::splat(s, rescale), threshold).1[1].store(flow);
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use num_complex::Complex32;

    use super::*;
    use crate::optics::lanes::{collect, spread};
    use crate::optics::{FftBackend, Reach};
    use crate::parallel::Workers;
    use crate::solve::field::tests::{P, SIZE, complex, noise};

    const THRESHOLD: f32 = 0.4;

    /// An unknown image's state, pixel by pixel: x, k * x, u of ν, and the multipliers of z = x and of the gradient.
    struct State {
        x: Vec<Complex32>,
        blurred: Vec<Complex32>,
        dual: Vec<Complex32>,
        prior: Vec<Complex32>,
        gradient: [Vec<Complex32>; 2],
    }

    impl State {
        fn random(seed: u32) -> Self {
            let mut gradient = [complex(seed + 4), complex(seed + 5)];
            // A difference that leaves the sensor has no multiplier.
            for (i, (across, down)) in {
                let [a, b] = &mut gradient;
                a.iter_mut().zip(b).enumerate()
            } {
                if i % SIZE.width + 1 == SIZE.width {
                    *across = Complex32::ZERO;
                }
                if i / SIZE.width + 1 == SIZE.height {
                    *down = Complex32::ZERO;
                }
            }
            Self {
                x: complex(seed),
                blurred: complex(seed + 1),
                dual: complex(seed + 2),
                prior: complex(seed + 3),
                gradient,
            }
        }

        fn field(&self, c: &Convolver) -> Field {
            let mut field = Field::new(c, false);
            let (lanes, mut fft, share) =
                (SIZE.width.div_ceil(LANES), c.row_fft().make_scratch(), 1.0 / c.padded().width as f32);
            for y in 0..SIZE.height {
                let part = y * SIZE.width..(y + 1) * SIZE.width;
                for (image, rows) in [(&self.x, &mut field.image), (&self.blurred, &mut field.blurred)] {
                    let scaled: Vec<_> = image[part.clone()].iter().map(|v| v * share).collect();
                    let row = &mut rows[y * c.row_lanes()..][..c.row_lanes()];
                    spread(&scaled, row);
                    c.row_fft().line(Way::Forward, row, &mut fft);
                }
                spread(&self.dual[part], &mut field.blur_dual[y * lanes..][..lanes]);
                for x in 0..SIZE.width {
                    let (i, m) = (y * SIZE.width + x, &mut field.multipliers[y * lanes + x / LANES]);
                    m.prior.set(x % LANES, self.prior[i]);
                    m.across.set(x % LANES, self.gradient[0][i]);
                    m.down.set(x % LANES, self.gradient[1][i]);
                }
            }
            field
        }

        fn input(&self, i: usize) -> Complex32 {
            self.x[i] + self.prior[i] * P.rescale
        }

        /// What flows right and down from a pixel of the sensor.
        fn flow(&self, i: usize, threshold: f32) -> [Complex32; 2] {
            let (right, below) = (i % SIZE.width + 1 < SIZE.width, i / SIZE.width + 1 < SIZE.height);
            let v = [(right, 1), (below, SIZE.width)]
                .map(|(inside, step)| if inside { self.x[i + step] - self.x[i] } else { Complex32::ZERO });
            let v = [v[0] + self.gradient[0][i] * P.rescale, v[1] + self.gradient[1][i] * P.rescale];
            let length = (v[0].norm_sqr() + v[1].norm_sqr()).sqrt();
            let keep = if length > threshold { 1.0 - threshold / length } else { 0.0 };
            let flow = v.map(|v| v * (2.0 * keep - 1.0));
            [if right { flow[0] } else { -self.x[i] }, if below { flow[1] } else { -self.x[i] }]
        }

        /// The right-hand side at any row and column of the padded circle, counted from the sensor's first.
        fn right_hand_side(
            &self,
            y: isize,
            x: isize,
            pulled: &[Complex32],
            threshold: impl Fn(usize) -> f32,
        ) -> Complex32 {
            let index = |y: isize, x: isize| {
                let inside = (0..SIZE.height as isize).contains(&y) && (0..SIZE.width as isize).contains(&x);
                inside.then(|| y as usize * SIZE.width + x as usize)
            };
            let flow = |y: isize, x: isize, axis: usize| match index(y, x) {
                Some(i) => self.flow(i, threshold(i))[axis],
                // A difference into the sensor is what it is.
                None => index(y + axis as isize, x + 1 - axis as isize).map_or(Complex32::ZERO, |i| self.x[i]),
            };
            let divergence = flow(y, x - 1, 0) - flow(y, x, 0) + flow(y - 1, x, 1) - flow(y, x, 1);
            let prior = index(y, x).map_or(Complex32::ZERO, |i| pulled[i] * 2.0 - self.input(i));
            prior * P.prior + divergence * P.gradient
        }
    }

    fn naive_pull(pull: Pull, s0: f32, l: Complex32, guide: f32) -> (f32, Complex32) {
        let length = l.norm();
        match pull {
            Pull::Positive | Pull::FilteredPositive => (s0, Complex32::from(l.re.max(0.0))),
            Pull::Filtered => (s0, if length <= guide { l } else { l * (guide / length) }),
            Pull::Cone if length <= s0 => (s0, l),
            Pull::Cone if length <= -s0 => (0.0, Complex32::ZERO),
            Pull::Cone => (0.5 * (s0 + length), l * (0.5 * (s0 + length) / length)),
        }
    }

    /// Both fields' right-hand sides, data steps and energies against the definitions, for all priors and numbers of threads.
    #[test]
    fn the_row_steps_follow_their_definitions() {
        let n = SIZE.pixels();
        let (target, guide) = (noise(n, 11), noise(n, 12).iter().map(|v| v + 0.6).collect::<Vec<_>>());
        let edges: Vec<f32> = noise(n, 13).iter().map(|v| v + 0.6).collect();
        let weight: Vec<f32> = (0..n).map(|i| f32::from(i % 7 != 0)).collect();
        let responses = [noise(n, 14).into_iter().map(Complex32::from).collect(), complex(15)];
        for pull in [Pull::Positive, Pull::FilteredPositive, Pull::Filtered, Pull::Cone] {
            for threads in [1, 2, 3, 7, 30] {
                let reach = Reach { rows: (3, 3), columns: (4, 4) };
                let c = Convolver::new(SIZE, reach, FftBackend::Batched, Arc::new(Workers::new(threads))).unwrap();
                let states = [State::random(20), State::random(30)];
                let mut fields = states.each_ref().map(|s| s.field(&c));
                let mut streams: Vec<_> = (0..threads).map(|_| Stream::new(SIZE.width)).collect();
                let (mut bands, mut energies) = (Band::for_threads(&c), vec![f32::NAN; SIZE.height]);
                let mut filter = GuidedFilter::new(SIZE);
                filter.set_guide(&guide, 4, 0.01, c.workers(), &mut streams);
                let row = |y: usize| y * SIZE.width..(y + 1) * SIZE.width;

                let input: Vec<_> = (0..n).map(|i| states[1].input(i)).collect();
                let mut filtered = vec![Complex32::ZERO; n];
                if pull == Pull::Positive {
                    filtered.copy_from_slice(&input);
                } else {
                    let out = Shared::new(&mut filtered);
                    let load = |y: usize, line: &mut [Lanes]| spread(&input[row(y)], line);
                    // SAFETY: each row is stored once.
                    #[allow(unsafe_code)]
                    let store = |y: usize, line: &[Lanes]| collect(line, unsafe { out.slice(row(y)) });
                    filter.run(&guide, c.workers(), &mut streams, load, store);
                }
                let around = Surroundings {
                    convolver: &c,
                    target: &target,
                    weight: &weight,
                    filter: &filter,
                    guide: &guide,
                    edges: &edges,
                    pull,
                    threshold: THRESHOLD,
                };
                let response = |k: usize, y: usize, line: &mut [Lanes]| spread(&responses[k][row(y)], line);
                let [a, b] = &mut fields;
                row_steps([a, b], around, P, response, (&mut bands, &mut streams), &mut energies);

                let pulled: Vec<_> =
                    (0..n).map(|i| naive_pull(pull, states[0].input(i).re, filtered[i], guide[i])).collect();
                let mut fft = c.row_fft().make_scratch();
                let Size { width: pw, .. } = c.padded();
                for (k, (state, field)) in states.iter().zip(&mut fields).enumerate() {
                    let pulled: Vec<_> = (0..n)
                        .map(|i| match (k, pull) {
                            (1, _) => pulled[i].1,
                            (_, Pull::Cone) => Complex32::from(pulled[i].0),
                            _ => state.input(i),
                        })
                        .collect();
                    let threshold =
                        |i: usize| if k == 1 && pull != Pull::Positive { THRESHOLD * edges[i] } else { THRESHOLD };
                    for (y, line) in field.image.chunks_exact_mut(c.row_lanes()).enumerate() {
                        c.row_fft().line(Way::Inverse, line, &mut fft);
                        let y = if y == SIZE.height + 1 { -1 } else { y as isize };
                        for x in 0..pw {
                            let want =
                                state.right_hand_side(y, if x + 1 == pw { -1 } else { x as isize }, &pulled, threshold);
                            let got = at(line, x) / pw as f32;
                            assert!((want - got).norm() < 1e-4, "{pull:?} {threads} {k} {y} {x}: {want} {got}");
                        }
                    }
                    for (y, line) in field.blurred.chunks_exact_mut(c.row_lanes()).enumerate() {
                        c.row_fft().line(Way::Inverse, line, &mut fft);
                        let mut energy = 0.0;
                        for x in 0..pw {
                            let got = at(line, x) / pw as f32;
                            if x >= SIZE.width {
                                assert!(got.norm() < 1e-5);
                                continue;
                            }
                            let i = y * SIZE.width + x;
                            let sum = |f: &dyn Fn(usize) -> f32| f(0) + f(1);
                            let r =
                                weight[i] * (target[i] - sum(&|k| (responses[k][i].conj() * states[k].blurred[i]).re));
                            energy += r * r;
                            let dual = sum(&|k| (responses[k][i].conj() * states[k].dual[i]).re);
                            let d = responses[k][i]
                                * ((r - weight[i] * dual) / (sum(&|k| responses[k][i].norm_sqr()) + P.blur));
                            assert!((state.dual[i] + d * 2.0 - got).norm() < 1e-4, "{pull:?} {threads} {k} {y} {x}");
                            assert!((at(&field.blur_dual[y * SIZE.width.div_ceil(LANES)..], x) + d).norm() < 1e-4);
                        }
                        assert!((energy - energies[y]).abs() < 1e-4);
                    }
                }
            }
        }
    }
}
