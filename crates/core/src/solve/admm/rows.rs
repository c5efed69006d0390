//! The row pass of an iteration: data and prior steps of up to two unknowns, in one pass over their rows.
//!
//! An iteration goes over memory twice. This pass goes along rows: inverse FFT, data step, guided filter, prior step and FFT, each row
//! while it lies in the cache. The image step goes along columns. Between the two an image consists of transformed rows.
//!
//! Threads share the rows in bands. A band begins with what it needs of its neighbours ([`exchange`]), then each row goes through every
//! step. The filter's rows come late, so some rows of x are kept ([`RING`]).

use std::ops::Range;

use fearless_simd::Level;

use super::Penalties;
use super::buffers::{RING, RowBuffers};
use super::data_step::{DataRow, Readings, data_row};
use super::prior_step::{Constants, PriorOutput, PriorRow, Prox, flow_row, prior_input, prior_row};
use super::state::{Iterate, Multipliers};
use crate::image::Size;
use crate::optics::lanes::{LANES, Lanes, at, clear_from, put, spread_real, vectorize};
use crate::optics::{Convolver, Direction};
use crate::parallel::BandsMut;
use crate::solve::guided_filter::{GuidedFilter, Stream};

/// Planes `[H, W]` and constants that a row pass reads beside the unknowns.
#[derive(Clone, Copy, Debug)]
pub(in crate::solve) struct RowContext<'a> {
    pub(in crate::solve) convolver: &'a Convolver,
    pub(in crate::solve) target: &'a [f32],
    pub(in crate::solve) weight: &'a [f32],
    pub(in crate::solve) filter: &'a GuidedFilter,
    /// Guide of the filter and of [`Prox::Filtered`].
    pub(in crate::solve) guide: &'a [f32],
    /// Weights of the total variation of a filtered unknown.
    pub(in crate::solve) edges: &'a [f32],
    pub(in crate::solve) prox: Prox,
    /// Threshold of total variation.
    pub(in crate::solve) threshold: f32,
}

impl RowContext<'_> {
    /// Rows that are read before the prior step of a row: rows of the next band, and rows in all.
    fn reach(&self) -> (usize, usize) {
        if self.prox.is_filtered() { (self.filter.delay(), self.filter.delay()) } else { (0, 1) }
    }
}

/// Data and prior steps of `K` unknowns, from x and k * x to the right-hand sides of their image steps.
///
/// `response(k, y, row)` fills row y of the response to unknown k. The weighted sum of squares of the residual at the present x goes into
/// `energies`, row by row. There is one of `buffers` and of `streams` for each thread.
pub(in crate::solve) fn row_pass<const K: usize>(
    mut unknowns: [&mut Iterate; K],
    context: RowContext<'_>,
    p: Penalties,
    response: impl Fn(usize, usize, &mut [Lanes]) + Sync,
    (buffers, streams): (&mut [RowBuffers], &mut [Stream]),
    energies: &mut [f32],
) {
    let (workers, height) = (context.convolver.workers(), context.convolver.size().height);
    let constants = Constants { prox: context.prox, threshold: context.threshold, p };
    exchange(&mut unknowns, context, constants, buffers);
    let unknowns = unknowns.map(|unknown| UnknownBands::new(unknown, context.convolver));
    let energies = workers.bands_mut(energies, height);
    let (buffers, streams) = (workers.each_mut(buffers), workers.each_mut(streams));
    workers.run(workers.threads(), &|task| {
        let band = workers.band(task, height);
        if !band.is_empty() {
            let unknowns = unknowns.each_ref().map(|unknown| unknown.take(task, &band, height));
            let (energies, buffers) = (energies.take(task), buffers.take(task));
            BandPass { context, constants, band, unknowns, energies, buffers }.run(&response, streams.take(task));
        }
    });
}

/// An unknown cut into bands of rows.
struct UnknownBands<'a> {
    image: BandsMut<'a, Lanes>,
    /// The row below the frame, then the row above it.
    around: BandsMut<'a, Lanes>,
    blurred: BandsMut<'a, Lanes>,
    blur_dual: BandsMut<'a, Lanes>,
    multipliers: BandsMut<'a, Multipliers>,
}

/// The rows of one unknown that belong to a band.
struct UnknownRows<'a> {
    image: &'a mut [Lanes],
    below: Option<&'a mut [Lanes]>,
    above: Option<&'a mut [Lanes]>,
    blurred: &'a mut [Lanes],
    blur_dual: &'a mut [Lanes],
    multipliers: &'a mut [Multipliers],
}

impl<'a> UnknownBands<'a> {
    fn new(unknown: &'a mut Iterate, c: &Convolver) -> Self {
        let (workers, height) = (c.workers(), c.size().height);
        let (frame, around) = unknown.image.split_at_mut(height * c.row_lanes());
        Self {
            image: workers.bands_mut(frame, height),
            around: BandsMut::new(around, 2, 2),
            blurred: workers.bands_mut(&mut unknown.blurred, height),
            blur_dual: workers.bands_mut(&mut unknown.state.blur_dual, height),
            multipliers: workers.bands_mut(&mut unknown.state.multipliers, height),
        }
    }

    /// The rows of a task whose band is not empty.
    fn take(&self, task: usize, band: &Range<usize>, height: usize) -> UnknownRows<'a> {
        UnknownRows {
            image: self.image.take(task),
            below: (band.end == height).then(|| self.around.take(0)),
            above: (band.start == 0).then(|| self.around.take(1)),
            blurred: self.blurred.take(task),
            blur_dual: self.blur_dual.take(task),
            multipliers: self.multipliers.take(task),
        }
    }
}

/// The row pass of one task over its band.
struct BandPass<'a, const K: usize> {
    context: RowContext<'a>,
    constants: Constants,
    band: Range<usize>,
    unknowns: [UnknownRows<'a>; K],
    energies: &'a mut [f32],
    buffers: &'a mut RowBuffers,
}

impl<const K: usize> BandPass<'_, K> {
    fn run(mut self, response: &impl Fn(usize, usize, &mut [Lanes]), stream: &mut Stream) {
        let (ahead, behind) = self.context.reach();
        for step in 0..self.band.len() + ahead + behind {
            let row = (self.band.start + step).checked_sub(ahead).filter(|y| *y < self.context.convolver.size().height);
            if let Some(y) = row.filter(|y| self.band.contains(y)) {
                self.data_step(y, response);
            }
            if let Some((y, filtered)) = self.filter(step, row, stream) {
                self.prior_step(y, filtered);
                self.border(y);
            }
        }
    }

    /// x of row y into the ring, the data step, and x + u for the filter.
    fn data_step(&mut self, y: usize, response: &impl Fn(usize, usize, &mut [Lanes])) {
        let Self { context, constants, band, unknowns, energies, buffers } = self;
        let RowBuffers { fft: scratch, ring, input, responses, reals: [target, weight], .. } = &mut **buffers;
        let (fft, width, blocks) =
            (context.convolver.row_fft(), context.convolver.size().width, context.convolver.row_lanes());
        let (lanes, row) = (width.div_ceil(LANES), y - band.start);
        let (padded, frame) = (row * blocks..(row + 1) * blocks, row * lanes..(row + 1) * lanes);
        for (k, unknown) in unknowns.iter_mut().enumerate() {
            let x = &mut ring[k][y % RING * blocks..][..blocks];
            x.copy_from_slice(&unknown.image[padded.clone()]);
            fft.line(Direction::Adjoint, x, scratch);
            crop(x, width);
            fft.line(Direction::Adjoint, &mut unknown.blurred[padded.clone()], scratch);
            response(k, y, &mut responses[k]);
        }
        spread_real(&context.target[y * width..(y + 1) * width], target);
        spread_real(&context.weight[y * width..(y + 1) * width], weight);
        let readings = Readings { responses, target, weight };
        let mut rows = unknowns.each_mut().map(|unknown| DataRow {
            blurred: &mut unknown.blurred[padded.clone()],
            dual: &mut unknown.blur_dual[frame.clone()],
        });
        energies[row] = vectorize!(Level::new(), s => data_row(s, &mut rows, readings, constants.p.blur));
        for DataRow { blurred, .. } in rows {
            blurred[lanes..].fill(Lanes::ZERO);
            fft.line(Direction::Forward, blurred, scratch);
        }
        if context.prox.is_filtered() {
            let x = &ring[K - 1][y % RING * blocks..][..lanes];
            let multipliers = &unknowns[K - 1].multipliers[frame];
            vectorize!(Level::new(), s => prior_input(s, x, multipliers, constants.p.rescale, input));
        }
    }

    /// Hands x + u of `row` to the filter at a step of the pass. Gives the row whose prior step is next, and its filtered image, which
    /// is empty without a filter.
    fn filter<'s>(&self, step: usize, row: Option<usize>, stream: &'s mut Stream) -> Option<(usize, &'s [Lanes])> {
        let Self { context, band, buffers, .. } = self;
        let (ahead, behind) = context.reach();
        if !context.prox.is_filtered() {
            let y = (band.start + step).checked_sub(behind).filter(|y| band.contains(y));
            return y.map(|y| (y, &[][..]));
        }
        let (halo, lanes) = (&buffers.halo, context.convolver.size().width.div_ceil(LANES));
        let input = match row {
            Some(y) if y < band.start => &halo[(y + ahead - band.start) * lanes..][..lanes],
            Some(y) if y >= band.end => &halo[(y - band.end + ahead) * lanes..][..lanes],
            _ => &buffers.input[..],
        };
        context.filter.push(band, step, input, context.guide, stream)
    }

    /// The prior step of row y; its right-hand side replaces x.
    fn prior_step(&mut self, y: usize, filtered: &[Lanes]) {
        let Self { context, constants, band, unknowns, buffers, .. } = self;
        let RowBuffers { fft: scratch, ring, next, flow, reals: [guide, edges], .. } = &mut **buffers;
        let (c, Size { width, height }, blocks) =
            (context.convolver, context.convolver.size(), context.convolver.row_lanes());
        let (lanes, row) = (width.div_ceil(LANES), y - band.start);
        let here: [&[Lanes]; K] = std::array::from_fn(|k| &ring[k][y % RING * blocks..][..blocks]);
        let below: [&[Lanes]; K] = std::array::from_fn(|k| match y + 1 {
            below if below == height => here[k],
            below if below == band.end => &next[k],
            below => &ring[k][below % RING * blocks..][..blocks],
        });
        if y == 0 {
            flow.iter_mut().zip(here).for_each(|(flow, here)| flow.copy_from_slice(&here[..lanes]));
        }
        if context.prox.is_filtered() {
            spread_real(&context.guide[y * width..(y + 1) * width], guide);
            spread_real(&context.edges[y * width..(y + 1) * width], edges);
        }
        let rows = PriorRow { here, below, filtered, guide, edges, last: y + 1 == height };
        let mut outputs = unknowns.each_mut().map(|unknown| PriorOutput {
            multipliers: &mut unknown.multipliers[row * lanes..(row + 1) * lanes],
            rhs: &mut unknown.image[row * blocks..(row + 1) * blocks],
        });
        vectorize!(Level::new(), s => prior_row(s, rows, *constants, &mut outputs, flow));
        for (PriorOutput { rhs, .. }, here) in outputs.into_iter().zip(here) {
            // Differences across the left and right border.
            let tau = constants.p.gradient;
            let (first, last) = (at(here, 0) * tau, at(here, width - 1) * tau);
            put(rhs, 0, at(rhs, 0) + first);
            put(rhs, width - 1, at(rhs, width - 1) + last);
            clear_from(rhs, width);
            put(rhs, width, -last);
            put(rhs, c.padded().width - 1, -first);
            c.row_fft().line(Direction::Forward, rhs, scratch);
        }
    }

    /// Differences across the lower and upper border, in the rows around the frame.
    fn border(&mut self, y: usize) {
        let Self { context, constants, unknowns, buffers, .. } = self;
        let RowBuffers { fft: scratch, ring, .. } = &mut **buffers;
        let (Size { width, height }, blocks) = (context.convolver.size(), context.convolver.row_lanes());
        for (k, UnknownRows { below, above, .. }) in unknowns.iter_mut().enumerate() {
            for out in
                [below.as_mut().filter(|_| y + 1 == height), above.as_mut().filter(|_| y == 0)].into_iter().flatten()
            {
                out.copy_from_slice(&ring[k][y % RING * blocks..][..blocks]);
                clear_from(out, width);
                out.iter_mut().flat_map(|v| v.re.iter_mut().chain(&mut v.im)).for_each(|v| *v *= -constants.p.gradient);
                context.convolver.row_fft().line(Direction::Forward, out, scratch);
            }
        }
    }
}

/// Copies what each band needs of its neighbours, before anything is overwritten: x + u as far as the filter reads, the row of x below,
/// and the downward part of d − u in the row above.
fn exchange<const K: usize>(
    unknowns: &mut [&mut Iterate; K],
    context: RowContext<'_>,
    constants: Constants,
    buffers: &mut [RowBuffers],
) {
    let c = context.convolver;
    let (Size { width, height }, blocks) = (c.size(), c.row_lanes());
    let lanes = width.div_ceil(LANES);
    let (ahead, behind) = context.reach();
    for task in 1..buffers.len() {
        let edge = c.workers().band(task, height).start;
        if edge == 0 || edge == height {
            continue;
        }
        let [.., upper, lower] = &mut buffers[..=task] else { continue };
        for (k, unknown) in unknowns.iter().enumerate() {
            let filtered = context.prox.is_filtered() && k + 1 == K;
            for y in edge.saturating_sub(behind)..(edge + behind).min(height) {
                let row = &mut upper.next[k];
                row.copy_from_slice(&unknown.image[y * blocks..(y + 1) * blocks]);
                c.row_fft().line(Direction::Adjoint, row, &mut upper.fft);
                crop(row, width);
                let multipliers = &unknown.state.multipliers[y * lanes..(y + 1) * lanes];
                if filtered {
                    let (halo, at) = match y.checked_sub(edge) {
                        Some(at) => (&mut upper.halo, at + ahead),
                        None => (&mut lower.halo, y + ahead - edge),
                    };
                    let halo = &mut halo[at * lanes..(at + 1) * lanes];
                    vectorize!(Level::new(), s => prior_input(s, row, multipliers, constants.p.rescale, halo));
                }
                if y + 1 == edge {
                    lower.next[k].copy_from_slice(row);
                } else if y == edge {
                    let above = &unknown.state.multipliers[(y - 1) * lanes..y * lanes];
                    spread_real(&context.edges[(y - 1) * width..y * width], &mut upper.reals[1]);
                    let edges = filtered.then_some(&upper.reals[1][..]);
                    let (x, flow) = ([&lower.next[k][..], row], &mut lower.flow[k]);
                    vectorize!(Level::new(), s => flow_row(s, x, above, edges, constants, flow));
                    // The upper band keeps this row, not the later ones that only the filter reads.
                    lower.next[k].copy_from_slice(row);
                }
            }
            upper.next[k].copy_from_slice(&lower.next[k]);
        }
    }
}

/// Repeats the last value of the frame's part of a row, so that the difference across the border is zero; zeros follow.
fn crop(row: &mut [Lanes], width: usize) {
    put(row, width, at(row, width - 1));
    clear_from(row, width + 1);
}

#[cfg(test)]
mod tests {
    use num_complex::Complex32;

    use super::super::testing::{SIZE, complex, convolver, noise};
    use super::super::{data_step, prior_step};
    use super::*;
    use crate::optics::lanes::{collect, spread};

    const P: Penalties = Penalties { blur: 0.3, prior: 0.7, gradient: 0.2, rescale: 1.3 };
    const THRESHOLD: f32 = 0.4;

    /// State of an unknown image pixel by pixel: x, k * x, u of ν, and the multipliers of z = x and of d = ∇x.
    struct Plain {
        x: Vec<Complex32>,
        blurred: Vec<Complex32>,
        dual: Vec<Complex32>,
        prior: Vec<Complex32>,
        gradient: [Vec<Complex32>; 2],
    }

    impl Plain {
        fn random(seed: u32) -> Self {
            let [mut across, mut down] = [complex(seed + 4), complex(seed + 5)];
            // A difference that leaves the frame has no multiplier.
            across.iter_mut().skip(SIZE.width - 1).step_by(SIZE.width).for_each(|v| *v = Complex32::ZERO);
            down[SIZE.pixels() - SIZE.width..].fill(Complex32::ZERO);
            Self {
                x: complex(seed),
                blurred: complex(seed + 1),
                dual: complex(seed + 2),
                prior: complex(seed + 3),
                gradient: [across, down],
            }
        }

        fn iterate(&self, c: &Convolver) -> Iterate {
            let mut iterate = Iterate::new(c, false);
            let (lanes, mut fft) = (SIZE.width.div_ceil(LANES), c.row_fft().make_scratch());
            let share = 1.0 / c.padded().width as f32;
            for y in 0..SIZE.height {
                let part = y * SIZE.width..(y + 1) * SIZE.width;
                for (image, rows) in [(&self.x, &mut iterate.image), (&self.blurred, &mut iterate.blurred)] {
                    let scaled: Vec<_> = image[part.clone()].iter().map(|v| v * share).collect();
                    let row = &mut rows[y * c.row_lanes()..][..c.row_lanes()];
                    spread(&scaled, row);
                    c.row_fft().line(Direction::Forward, row, &mut fft);
                }
                spread(&self.dual[part], &mut iterate.state.blur_dual[y * lanes..][..lanes]);
                for x in 0..SIZE.width {
                    let i = y * SIZE.width + x;
                    let m = &mut iterate.state.multipliers[y * lanes + x / LANES];
                    m.prior.set(x % LANES, self.prior[i]);
                    m.across.set(x % LANES, self.gradient[0][i]);
                    m.down.set(x % LANES, self.gradient[1][i]);
                }
            }
            iterate
        }

        /// x + u.
        fn input(&self, i: usize) -> Complex32 {
            self.x[i] + self.prior[i] * P.rescale
        }

        /// d − u' rightward and downward at a pixel of the frame.
        fn flow(&self, i: usize, threshold: f32) -> [Complex32; 2] {
            let inside = [i % SIZE.width + 1 < SIZE.width, i / SIZE.width + 1 < SIZE.height];
            let v: [_; 2] = std::array::from_fn(|axis| {
                let next = i + [1, SIZE.width][axis];
                let difference = if inside[axis] { self.x[next] - self.x[i] } else { Complex32::ZERO };
                difference + self.gradient[axis][i] * P.rescale
            });
            let d = prior_step::scalar_shrink(v, threshold);
            std::array::from_fn(|axis| if inside[axis] { d[axis] * 2.0 - v[axis] } else { -self.x[i] })
        }

        /// The right-hand side at any row and column of the padded circle, counted from the frame's first.
        fn right_hand_side(&self, y: isize, x: isize, z: &[Complex32], threshold: impl Fn(usize) -> f32) -> Complex32 {
            let index = |y: isize, x: isize| {
                let inside = (0..SIZE.height as isize).contains(&y) && (0..SIZE.width as isize).contains(&x);
                inside.then(|| y as usize * SIZE.width + x as usize)
            };
            let flow = |y: isize, x: isize, axis: usize| match index(y, x) {
                Some(i) => self.flow(i, threshold(i))[axis],
                // A difference into the frame is what it is.
                None => index(y + axis as isize, x + 1 - axis as isize).map_or(Complex32::ZERO, |i| self.x[i]),
            };
            let divergence = flow(y, x - 1, 0) - flow(y, x, 0) + flow(y - 1, x, 1) - flow(y, x, 1);
            let prior = index(y, x).map_or(Complex32::ZERO, |i| z[i] * 2.0 - self.input(i));
            prior * P.prior + divergence * P.gradient
        }
    }

    /// Two unknowns and all that a row pass reads.
    struct Case {
        states: [Plain; 2],
        responses: [Vec<Complex32>; 2],
        target: Vec<f32>,
        weight: Vec<f32>,
        guide: Vec<f32>,
        edges: Vec<f32>,
    }

    impl Case {
        fn random() -> Self {
            let n = SIZE.pixels();
            let positive = |seed| noise(n, seed).iter().map(|v| v + 0.6).collect();
            Self {
                states: [Plain::random(20), Plain::random(30)],
                responses: [noise(n, 14).into_iter().map(Complex32::from).collect(), complex(15)],
                target: noise(n, 11),
                weight: (0..n).map(|i| [0.0, 1.0, 0.4, 1.0][i % 7 % 4]).collect(),
                guide: positive(12),
                edges: positive(13),
            }
        }

        /// The unknowns after a row pass, the filtered image of the second and the energies.
        fn run(&self, c: &Convolver, prox: Prox) -> ([Iterate; 2], Vec<Complex32>, Vec<f32>) {
            let threads = c.workers().threads();
            let mut iterates = self.states.each_ref().map(|state| state.iterate(c));
            let mut streams: Vec<_> = (0..threads).map(|_| Stream::new(SIZE.width)).collect();
            let (mut buffers, mut energies) = (RowBuffers::for_threads(c), vec![f32::NAN; SIZE.height]);
            let mut filter = GuidedFilter::new(SIZE);
            filter.set_guide(&self.guide, 4, 0.01, c.workers(), &mut streams);
            let row = |y: usize| y * SIZE.width..(y + 1) * SIZE.width;
            let mut filtered: Vec<_> = (0..SIZE.pixels()).map(|i| self.states[1].input(i)).collect();
            if prox.is_filtered() {
                let input = filtered.clone();
                let load = |y: usize, line: &mut [Lanes]| spread(&input[row(y)], line);
                let store = |_, line: &[Lanes], out: &mut [Complex32]| collect(line, out);
                filter.run(&self.guide, c.workers(), &mut streams, load, &mut filtered, store);
            }
            let Self { responses, target, weight, guide, edges, .. } = self;
            let (filter, threshold) = (&filter, THRESHOLD);
            let context = RowContext { convolver: c, target, weight, filter, guide, edges, prox, threshold };
            let response = |k: usize, y: usize, line: &mut [Lanes]| spread(&responses[k][row(y)], line);
            let [a, b] = &mut iterates;
            row_pass([a, b], context, P, response, (&mut buffers, &mut streams), &mut energies);
            (iterates, filtered, energies)
        }

        /// z of unknown k at pixel i.
        fn z(&self, k: usize, i: usize, prox: Prox, filtered: Complex32) -> Complex32 {
            let [first, second] = self.states.each_ref().map(|state| state.input(i));
            let (s0, l) = prox.scalar(first.re, second, filtered, self.guide[i]);
            match (k, prox) {
                (1, _) => l,
                (_, Prox::Cone) => s0.into(),
                _ => first,
            }
        }
    }

    /// Rows of an image in space, with their place in the padded circle.
    fn rows_in_space(image: &[Lanes], c: &Convolver) -> Vec<(isize, Vec<Complex32>)> {
        let (mut fft, share) = (c.row_fft().make_scratch(), 1.0 / c.padded().width as f32);
        let rows = image.chunks_exact(c.row_lanes()).enumerate().map(|(y, row)| {
            let mut row = row.to_vec();
            c.row_fft().line(Direction::Adjoint, &mut row, &mut fft);
            let values = (0..c.padded().width).map(|x| at(&row, x) * share).collect();
            (if y == SIZE.height + 1 { -1 } else { y as isize }, values)
        });
        rows.collect()
    }

    fn for_all_priors_and_threads(mut check: impl FnMut(&Case, &Convolver, Prox, &str)) {
        let case = Case::random();
        for prox in [Prox::Positive, Prox::FilteredPositive, Prox::Filtered, Prox::Cone] {
            for threads in [1, 2, 3, 7, 30] {
                check(&case, &convolver(threads), prox, &format!("{prox:?}, {threads} threads"));
            }
        }
    }

    #[test]
    fn right_hand_sides_follow_the_scalar_prior_step() {
        for_all_priors_and_threads(|case, c, prox, what| {
            let (iterates, filtered, _) = case.run(c, prox);
            for (k, iterate) in iterates.iter().enumerate() {
                let z: Vec<_> = filtered.iter().enumerate().map(|(i, v)| case.z(k, i, prox, *v)).collect();
                let weighted = k == 1 && prox.is_filtered();
                let threshold = |i: usize| if weighted { THRESHOLD * case.edges[i] } else { THRESHOLD };
                for (y, row) in rows_in_space(&iterate.image, c) {
                    for (x, got) in row.iter().enumerate() {
                        let at = if x + 1 == row.len() { -1 } else { x as isize };
                        let want = case.states[k].right_hand_side(y, at, &z, threshold);
                        assert!((want - got).norm() < 1e-4, "{what}, unknown {k} at {y} {x}: {want} {got}");
                    }
                }
            }
        });
    }

    #[test]
    fn blurred_images_and_energies_follow_the_scalar_data_step() {
        for_all_priors_and_threads(|case, c, prox, what| {
            let (iterates, _, energies) = case.run(c, prox);
            let images = iterates.each_ref().map(|iterate| rows_in_space(&iterate.blurred, c));
            for (y, energy) in energies.into_iter().enumerate() {
                let mut sum = 0.0;
                for x in 0..SIZE.width {
                    let i = y * SIZE.width + x;
                    let [a, b] = &case.states;
                    let (blurred, dual) = ([a.blurred[i], b.blurred[i]], [a.dual[i], b.dual[i]]);
                    let response = case.responses.each_ref().map(|e| e[i]);
                    let (nu, square) =
                        data_step::scalar(blurred, dual, response, (case.target[i], case.weight[i]), P.blur);
                    sum += square;
                    for k in 0..2 {
                        let new = blurred[k] + dual[k] - nu[k];
                        let duals = &iterates[k].state.blur_dual[y * SIZE.width.div_ceil(LANES)..];
                        assert!((at(duals, x) - new).norm() < 1e-4, "{what}, unknown {k} at {y} {x}");
                        let want = nu[k] - new - blurred[k];
                        assert!((images[k][y].1[x] - want).norm() < 1e-4, "{what}, unknown {k} at {y} {x}");
                    }
                }
                assert!((energy - sum).abs() < 1e-4, "{what}, row {y}: {energy} {sum}");
                let beyond = images.iter().flat_map(|rows| &rows[y].1[SIZE.width..]);
                assert!(beyond.into_iter().all(|v| v.norm() < 1e-5), "{what}, row {y}");
            }
        });
    }
}
