//! Registration of the guide with one raw frame: Gauss–Newton on a shift, then on an affine map, with the elimination of
//! `fit.rs`. The blur makes the cost smooth over many pixels. A second search eliminates a smooth error of the guide too. If the
//! guide still seems to be of another scene, a few more searches start elsewhere.
//!
//! Cost, in complex convolutions for each channel: 12 for the first step, 11 for each further one, 18 to look for more than a
//! shift, which is done where the first steps hint at it.

use nalgebra::{Matrix2, SMatrix, SVector};

use super::beyond::{self, Traces};
use super::fit::{self, AFFINE, Channel, Columns, Frame, GUIDE, REST};
use crate::image::{Size, Stack};
use crate::optics::Scratch;

/// Gauss–Newton steps, at most.
const STEPS: usize = 6;
/// After a step this short the next would be below a hundredth of a pixel, in pixels.
const SETTLED: f64 = 0.4;
/// A shift must lower the sum of squares by this many noise variances, or the guide stays where it is …
pub(super) const SIGNIFICANT: f64 = 60.0;
/// … and what an affine map has beyond it by this many.
pub(super) const AFFINE_SIGNIFICANT: f64 = 150.0;
/// An affine map is fitted if a rough estimate gives this share of [`AFFINE_SIGNIFICANT`].
const HINT: f64 = 0.3;
/// Steps of an affine map, at most.
const AFFINE_STEPS: usize = 3;
/// The search that eliminates a smooth error of the guide wins if it explains this many noise variances more. The other search is less
/// uncertain, but mistakes such an error for a shift or a turn.
const BETTER: f64 = 15.0;
/// Largest shift looked for, as a share of the longer side.
const REACH: f64 = 0.06;
/// Other starts when the guide seems to be of another scene: displacements of this share of the reach.
const START: f64 = 0.5;
/// A result of another start must explain this share of the scene's detail, with at most this uncertainty in pixels.
const RESCUED: f64 = 0.1;
const CERTAIN: f64 = 1.0;
/// A smooth error of the guide counts when it lowers each channel's sum of squares by this many noise variances: a perfect guide
/// gives 50 to 150, twice or three times that where L has much detail, and stress patterns more …
const ERRONEOUS: f64 = 1000.0;
/// … of a guide whose brightness was wrong already, by this many,
const ERRONEOUS_ALREADY: f64 = 300.0;
/// … and that much of what is left beside noise.
const OF_THE_REST: f64 = 0.25;
/// A guide whose detail is found in the readings with less than this share of its brightness is of another scene …
const FOREIGN: f64 = 0.35;
/// … if that is sure by this many standard deviations.
const SURE: f64 = 2.0;
/// A guide that beside L leaves this share of what L leaves alone is of another scene too: tone curves and vignetting leave a
/// few percent, other scenes a fifth and more.
const MISLEADING: f64 = 0.08;
/// A guide without a visible detail is useless when the scene has this much of it, in noise variances.
const STRUCTURED: f64 = 1.3;

/// Without a mask nothing but S0 explains the readings: a guide that leaves more than this share of what a featureless one
/// leaves is of another scene …
const UNEXPLAINED: f64 = 0.5;
/// … if what it leaves is this many times the noise variance.
const ABOVE_NOISE: f64 = 3.0;

/// Affine parameters: a shift in pixels, then the change of that shift from the frame's centre to the edge of its longer side.
pub(super) type Parameters = SVector<f64, AFFINE>;

/// Result of a registration.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Found {
    /// Position of the guide's content against the scene.
    pub(super) parameters: Parameters,
    /// Standard deviation of the shift along its least certain direction, in pixels; infinite if the guide is flat.
    pub(super) uncertainty: f64,
    /// Quality of the fit there.
    pub(super) fit: Match,
    /// The shift from there that the readings still ask for, in pixels; zero where it is not significant.
    pub(super) off: [f64; 2],
    /// The normal matrix of a shift there, and what was there to move.
    pub(super) hessian: Matrix2<f64>,
    pub(super) moving: f64,
}

/// Quality of a placed guide's fit to the readings, all channels together.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Match {
    /// Sum of squares left with L eliminated.
    pub(super) polarized: f64,
    /// Sum of squares left with L eliminated, without the guide.
    pub(super) alone: f64,
    /// Sum of squares left with L and a smooth error of the guide eliminated.
    pub(super) smooth: f64,
    /// Sum of squares left with both eliminated, without the guide's detail.
    pub(super) without: f64,
    /// Gain of the guide's brightness, and that of its detail, which no smooth image explains.
    pub(super) gain: f64,
    pub(super) detail: f64,
    /// Standard deviation of the latter.
    pub(super) detail_deviation: f64,
    /// Gain of each channel.
    pub(super) gains: [f64; 3],
    /// Share of the square of each channel's blurred guide that L does not explain.
    pub(super) shares: [f64; 3],
    /// Light from beyond the frame in the rest.
    pub(super) beyond: Traces,
}

impl Match {
    /// True if a smooth error of the guide explains more than noise does and must be corrected; `already` if its brightness was corrected
    /// before. Strong polarization with much detail leaves a rest of its own, and slow modes explain a little of any rest: on stress
    /// patterns 15 % of it with a perfect guide, 44 % with γ 1.1.
    pub(super) fn is_to_be_corrected(&self, frame: &Frame<'_>, already: bool) -> bool {
        let explained = self.polarized - self.smooth;
        let least = if already { ERRONEOUS_ALREADY * frame.operators.len() as f64 } else { erroneous(frame) };
        explained > least * self.variance(frame) && !is_little(explained, self.smooth - frame.noise * frame.trusted)
    }

    /// Variance of what is left of one reading.
    pub(super) fn variance(&self, frame: &Frame<'_>) -> f64 {
        (self.smooth / frame.trusted.max(1.0)).max(0.0)
    }

    /// Gain of the detail over that of the brightness; 0 for a flat guide, which has no detail.
    pub(super) fn detail_share(&self) -> f64 {
        if self.detail_deviation < self.gain { self.detail / self.gain } else { 0.0 }
    }

    /// True if the guide shows another scene, or nothing.
    pub(super) fn is_foreign(&self, frame: &Frame<'_>) -> bool {
        if frame.coarse.is_empty() {
            let (rest, without) = (self.polarized, self.without);
            let noise = frame.noise * frame.trusted;
            return rest > ABOVE_NOISE * noise && rest - noise > UNEXPLAINED * (without - noise);
        }
        self.polarized - self.smooth > MISLEADING * self.alone || !self.shows_detail(frame)
    }

    /// True if the scene's detail is in the guide, or the scene has none.
    pub(super) fn shows_detail(&self, frame: &Frame<'_>) -> bool {
        let visible = self.detail_deviation < self.gain.abs();
        if visible {
            self.detail + SURE * self.detail_deviation >= FOREIGN * self.gain
        } else {
            self.without <= STRUCTURED * frame.noise * frame.trusted
        }
    }
}

/// True if a smooth error explains little of the rest beyond noise, both sums of squares.
pub(super) fn is_little(explained: f64, rest: f64) -> bool {
    explained <= OF_THE_REST * rest
}

/// Noise variances that a smooth error has to explain.
pub(super) fn erroneous(frame: &Frame<'_>) -> f64 {
    ERRONEOUS * frame.operators.len() as f64
}

/// The quadratic model of the cost around one placement, all channels together.
#[derive(Clone, Copy, Debug, Default)]
struct Normal {
    hessian: SMatrix<f64, AFFINE, AFFINE>,
    slope: Parameters,
}

impl Normal {
    /// Adds a channel, its gain eliminated.
    fn add(&mut self, gram: &fit::Gram, gain: f64) {
        let square = gram[(GUIDE, GUIDE)];
        if square <= 0.0 {
            return;
        }
        let gain = gain + gram[(GUIDE, REST)] / square;
        let cross = gram.fixed_view::<AFFINE, 1>(0, GUIDE).into_owned();
        let seen = gram.fixed_view::<AFFINE, AFFINE>(0, 0) - cross * cross.transpose() / square;
        self.hessian += seen * (gain * gain);
        let left = gram.fixed_view::<AFFINE, 1>(0, REST) - cross * (gram[(GUIDE, REST)] / square);
        self.slope += left * gain;
    }

    /// The step of the first `count` parameters to the model's minimum and how much lower that is; none if the guide is flat.
    fn step(&self, count: usize) -> Option<(Parameters, f64)> {
        let mut hessian = SMatrix::<f64, AFFINE, AFFINE>::identity();
        hessian.view_mut((0, 0), (count, count)).copy_from(&self.hessian.view((0, 0), (count, count)));
        let mut slope = Parameters::zeros();
        slope.rows_mut(0, count).copy_from(&self.slope.rows(0, count));
        let step = hessian.cholesky()?.solve(&slope);
        let drop = step.dot(&slope);
        (drop.is_finite() && step.norm().is_finite()).then_some((step, drop))
    }

    /// Normal matrix of a shift alone.
    fn shift(&self) -> Matrix2<f64> {
        self.hessian.fixed_view::<2, 2>(0, 0).into_owned()
    }

    /// Standard deviation of the shift along its least certain direction, for readings of variance `variance`.
    fn uncertainty(&self, variance: f64) -> f64 {
        let (a, b, c) = (self.hessian[(0, 0)], self.hessian[(0, 1)], self.hessian[(1, 1)]);
        let least = 0.5 * (a + c) - (0.25 * (a - c).powi(2) + b * b).sqrt();
        if least > 0.0 { (variance / least).sqrt() } else { f64::INFINITY }
    }
}

/// One evaluation.
#[derive(Clone, Copy)]
struct Evaluation {
    fit: Match,
    polarized: Normal,
    smooth: Normal,
    /// [`fit::moments`] of the guide, all channels together.
    moments: [f64; 6],
}

/// Rough estimate of the sum of squares that an affine map explains beyond a shift. It assumes that the images of the map are seen as
/// well as those of the shift.
pub(super) fn affine_hint(shift: Matrix2<f64>, moments: &[f64; 6], slope: &Parameters) -> f64 {
    let [all, x, y, xx, xy, yy] = *moments;
    // Factors 1, x and y of the shift along one axis, in the order of the parameters: which axis, which factor.
    let factors = [[all, x, y], [x, xx, xy], [y, xy, yy]].map(|row| row.map(|v| v / all.max(f64::MIN_POSITIVE)));
    let order = [(0, 0), (1, 0), (0, 1), (0, 2), (1, 1), (1, 2)];
    let hessian = SMatrix::<f64, AFFINE, AFFINE>::from_fn(|a, b| {
        let ((i, f), (j, h)) = (order[a], order[b]);
        shift[(i, j)] * factors[f][h]
    });
    let normal = Normal { hessian, slope: *slope };
    let drop = |count: usize| normal.step(count).map_or(0.0, |(_, drop)| drop);
    drop(AFFINE) - drop(2)
}

/// True if an estimate of [`affine_hint`] is worth a fit of an affine map.
pub(super) fn is_hint(drop: f64, variance: f64) -> bool {
    drop > HINT * AFFINE_SIGNIFICANT * variance
}

impl Evaluation {
    /// The guide as it lies, where nothing else is known.
    fn found(&self, parameters: Parameters) -> Found {
        Found {
            parameters,
            uncertainty: 0.0,
            fit: self.fit,
            off: [0.0; 2],
            hessian: self.polarized.shift(),
            moving: self.moments[0],
        }
    }

    /// The normal equations and the sum of squares left, with or without a smooth error eliminated.
    fn model(&self, smooth: bool) -> (&Normal, f64) {
        if smooth { (&self.smooth, self.fit.smooth) } else { (&self.polarized, self.fit.polarized) }
    }
}

/// Fits the guide as placed.
fn evaluate(
    frame: &Frame<'_>,
    raw: &mut Stack<f32>,
    guide: &Stack<f32>,
    columns: Columns,
    scratch: &mut Scratch,
    w: &mut fit::Workspace,
) -> Evaluation {
    let mut all = Evaluation {
        fit: Match::default(),
        polarized: Normal::default(),
        smooth: Normal::default(),
        moments: [0.0; 6],
    };
    let (mut seen, mut bright) = (0.0, 0.0);
    for c in 0..frame.operators.len() {
        let Channel { gain, square, polarized, smooth, featureless } =
            w.fit(frame, c, raw.plane_mut(c), guide.plane(c), columns, scratch);
        all.polarized.add(&polarized, gain);
        all.smooth.add(&smooth, gain);
        let total = |gram: &fit::Gram| match gram[(GUIDE, GUIDE)] {
            square if square > 0.0 => gain + gram[(GUIDE, REST)] / square,
            _ => 0.0,
        };
        let left = |gram: &fit::Gram| match gram[(GUIDE, GUIDE)] {
            square if square > 0.0 => gram[(REST, REST)] - gram[(GUIDE, REST)].powi(2) / square,
            _ => gram[(REST, REST)],
        };
        let moments = fit::moments(guide.plane(c), guide.size());
        all.moments.iter_mut().zip(moments).for_each(|(all, m)| *all += total(&polarized).powi(2) * m);
        all.fit.gains[c] = total(&polarized);
        if let Some(pattern) = frame.beyond {
            let brightness = total(&polarized) * f64::from(fit::mean(guide.plane(c)));
            all.fit.beyond.add(pattern, &w.rest, guide.size(), brightness, frame.noise);
        }
        all.fit.shares[c] = polarized[(GUIDE, GUIDE)].max(0.0) / square.max(f64::MIN_POSITIVE);
        let (rest, square) = (left(&smooth), smooth[(GUIDE, GUIDE)].max(0.0));
        all.fit.polarized += left(&polarized);
        all.fit.alone += left(&polarized) + total(&polarized).powi(2) * polarized[(GUIDE, GUIDE)].max(0.0);
        all.fit.smooth += rest;
        all.fit.without += if frame.coarse.is_empty() { featureless } else { rest + total(&smooth).powi(2) * square };
        // Gains are averaged as their certainty says.
        let whole = polarized[(GUIDE, GUIDE)].max(0.0);
        all.fit.gain += total(&polarized) * whole;
        all.fit.detail += total(&smooth) * square;
        (seen, bright) = (seen + square, bright + whole);
    }
    w.keep_readings(frame);
    all.fit.gain /= if bright > 0.0 { bright } else { 1.0 };
    all.fit.detail /= if seen > 0.0 { seen } else { 1.0 };
    all.fit.detail_deviation = if seen > 0.0 { (all.fit.variance(frame) / seen).sqrt() } else { f64::INFINITY };
    all
}

/// Fits the guide where it lies. Allocates nothing.
pub(super) fn judge(
    frame: &Frame<'_>,
    raw: &mut Stack<f32>,
    guide: &Stack<f32>,
    scratch: &mut Scratch,
    w: &mut fit::Workspace,
) -> Found {
    let here = evaluate(frame, raw, guide, Columns::Shift, scratch, w);
    let significant = |drop: f64| drop > SIGNIFICANT * here.fit.polarized.max(0.0) / frame.trusted;
    let step = here.polarized.step(2).filter(|(_, drop)| significant(*drop));
    let off = step.map_or([0.0; 2], |(step, _)| [step[0], step[1]]);
    Found { off, ..here.found(Parameters::zeros()) }
}

/// Finds how the guide lies. `place(p, guide)` resamples the guide as if its content lay so; `guide` is left as placed by what
/// was found. Allocates nothing.
pub(super) fn find(
    frame: &Frame<'_>,
    raw: &mut Stack<f32>,
    mut place: impl FnMut(&Parameters, &mut Stack<f32>),
    guide: &mut Stack<f32>,
    scratch: &mut Scratch,
    w: &mut fit::Workspace,
) -> Found {
    let size = guide.size();
    let longest = longest(size);
    let mut search = Search { frame, raw, guide, scratch, w, place: &mut place, longest };
    let here = search.at(&Parameters::zeros(), Columns::Shift);
    let mut best = search.run(Parameters::zeros(), here, false);
    let mut last = best.parameters;
    if !frame.coarse.is_empty() {
        let other = search.run(Parameters::zeros(), here, true);
        last = other.parameters;
        if other.fit.smooth + BETTER * other.fit.variance(frame) < best.fit.smooth {
            best = other;
        }
    }
    // Light from beyond the frame makes every guide look foreign.
    if best.fit.is_foreign(frame) && !best.fit.beyond.tell(beyond::GUIDED) {
        for k in 0..8 {
            let (sin, cos) = (f64::from(k) * std::f64::consts::FRAC_PI_4).sin_cos();
            let mut start = Parameters::zeros();
            (start[0], start[1]) = (START * longest * cos, START * longest * sin);
            let there = search.at(&start, Columns::Shift);
            let other = search.run(start, there, !frame.coarse.is_empty());
            last = other.parameters;
            // Among many places a weak guide fits somewhere by chance.
            let Match { smooth, without, .. } = other.fit;
            let explains = without - smooth > RESCUED * (without - frame.noise * frame.trusted);
            let fits = !other.fit.is_foreign(frame) && explains && other.uncertainty < CERTAIN;
            if fits && smooth < best.fit.smooth {
                best = other;
            }
        }
    }
    // A guide of another scene lies nowhere.
    if best.fit.is_foreign(frame) {
        best.parameters = Parameters::zeros();
    }
    if last != best.parameters {
        place(&best.parameters, guide);
    }
    best
}

/// Largest shift looked for, in pixels.
fn longest(size: Size) -> f64 {
    REACH * size.width.max(size.height) as f64
}

/// True if a guide is looked for as far away.
pub(super) fn is_within_reach(parameters: &Parameters, size: Size) -> bool {
    parameters.norm() <= longest(size)
}

/// Gauss–Newton from one start.
struct Search<'a, 'f, P> {
    frame: &'a Frame<'f>,
    raw: &'a mut Stack<f32>,
    guide: &'a mut Stack<f32>,
    scratch: &'a mut Scratch,
    w: &'a mut fit::Workspace,
    place: &'a mut P,
    longest: f64,
}

impl<P: FnMut(&Parameters, &mut Stack<f32>)> Search<'_, '_, P> {
    fn at(&mut self, parameters: &Parameters, columns: Columns) -> Evaluation {
        (self.place)(parameters, self.guide);
        evaluate(self.frame, self.raw, self.guide, columns, self.scratch, self.w)
    }

    /// From `start`, where all is as `here` says. Ends with the guide placed as found; `smooth` says whether a smooth error of it is
    /// eliminated.
    fn run(&mut self, start: Parameters, mut here: Evaluation, smooth: bool) -> Found {
        let frame = self.frame;
        let mut now = start;
        for step in 0..STEPS {
            let (normal, rest) = here.model(smooth);
            let Some((change, drop)) = normal.step(2) else { break };
            if step == 0 && start == Parameters::zeros() && drop <= SIGNIFICANT * rest.max(0.0) / frame.trusted {
                break;
            }
            let next = now + change * (0.5 * self.longest / change.norm()).min(1.0);
            if next.fixed_rows::<2>(0).norm() > self.longest {
                break;
            }
            let there = self.at(&next, Columns::Shift);
            if there.model(smooth).1 > rest {
                break;
            }
            (now, here) = (next, there);
            if change.norm() < SETTLED {
                break;
            }
        }
        // More than a shift, if the readings say so.
        let (normal, _) = here.model(smooth);
        let hint = affine_hint(normal.shift(), &here.moments, &normal.slope);
        let shifted = is_hint(hint, here.fit.variance(frame)).then(|| self.at(&now, Columns::Affine));
        let drop = |shifted: &Evaluation| {
            let drop = |count: usize| shifted.model(smooth).0.step(count).map_or(0.0, |(_, drop)| drop);
            drop(AFFINE) - drop(2)
        };
        if let Some(mut best) = shifted.filter(|s| drop(s) > AFFINE_SIGNIFICANT * s.fit.variance(frame)) {
            for _ in 0..AFFINE_STEPS {
                let Some((change, _)) = best.model(smooth).0.step(AFFINE) else { break };
                let next = now + change;
                if next.norm() > self.longest {
                    break;
                }
                let there = self.at(&next, Columns::Affine);
                if there.model(smooth).1 >= best.model(smooth).1 {
                    break;
                }
                (now, best) = (next, there);
                if change.norm() < 0.5 * SETTLED {
                    break;
                }
            }
            here = best;
        }
        (self.place)(&now, self.guide);
        let (normal, _) = here.model(smooth);
        Found {
            parameters: now,
            uncertainty: normal.uncertainty(here.fit.variance(frame)),
            fit: here.fit,
            off: [0.0; 2],
            hessian: normal.shift(),
            moving: here.moments[0],
        }
    }
}

#[cfg(test)]
pub(super) mod tests {
    use std::sync::Arc;

    use num_complex::Complex32;

    use super::super::colors::EVEN;
    use super::super::resample::{Sampler, moved};
    use super::*;
    use crate::device::Homography;
    use crate::image::Buffers;
    use crate::image::noise::reading_noise;
    use crate::optics::{Coarse, FftBackend, Psf, Response, StokesOperator};
    use crate::parallel::Workers;
    use crate::polarization::Angle;

    pub(in super::super) const SIZE: Size = Size::new(96, 80);
    const NOISE: f32 = 0.001;
    /// Pixels that the guide camera sees beyond the frame on every side, so that borders do not matter.
    const MARGIN: usize = 12;

    fn operator() -> StokesOperator {
        let disc = |i: usize| {
            let (dy, dx) = ((i / 96) as f32 - 40.0, (i % 96) as f32 - 48.0);
            if dx.hypot(dy) < 18.0 { 1.0 + (0.7 * dx + 0.2 * dy).sin() * (0.9 * dy).cos() } else { 0.0 }
        };
        let psf = Stack::from_vec(1, SIZE, (0..SIZE.pixels()).map(disc).collect()).unwrap();
        let psf = Psf::new(psf, SIZE, 1).unwrap();
        let response = Response::stripes(SIZE, Angle::four(), 16, f64::INFINITY).unwrap();
        let workers = Arc::new(Workers::new(1));
        StokesOperator::for_channels(&psf, &response, 1, FftBackend::Rustfft, workers).unwrap().remove(0)
    }

    /// A scene of waves, band-limited so that it can be sampled anywhere; never dark. Half of them are too fine for a smooth
    /// image: without such detail nothing tells a guide of another scene from one with a smooth error.
    pub(in super::super) fn scene(seed: u32, x: f32, y: f32) -> f32 {
        let mut s = seed;
        let mut next = || {
            s = s.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (s >> 8) as f32 / (1 << 24) as f32
        };
        let mut wave = |fine: f32| ((next() - 0.5) * fine * x + (next() - 0.5) * fine * y + 6.3 * next()).sin();
        0.5 + 0.03 * (0..12).map(|k| wave(if k % 2 == 0 { 0.5 } else { 1.6 })).sum::<f32>()
    }

    fn shifted([dx, dy]: [f64; 2]) -> Parameters {
        Parameters::from_column_slice(&[dx, dy, 0.0, 0.0, 0.0, 0.0])
    }

    /// A view of the scene, shifted, that sees `margin` pixels more on every side.
    fn image(seed: u32, shift: [f64; 2], margin: usize) -> Stack<f32> {
        view(seed, &shifted(shift), margin)
    }

    /// A view of the scene whose content lies so.
    fn view(seed: u32, lies: &Parameters, margin: usize) -> Stack<f32> {
        let size = Size::new(SIZE.width + 2 * margin, SIZE.height + 2 * margin);
        let map = moved(&Homography::IDENTITY, lies, SIZE).0;
        let back = nalgebra::Matrix3::from_row_slice(&map).try_inverse().unwrap();
        let at = |i: usize| {
            let (x, y) = ((i % size.width) as f64 - margin as f64, (i / size.width) as f64 - margin as f64);
            let p = back * nalgebra::Vector3::new(x, y, 1.0);
            scene(seed, p[0] as f32, p[1] as f32)
        };
        Stack::from_vec(1, size, (0..size.pixels()).map(at).collect()).unwrap()
    }

    /// Registers a shifted guide of scene `seed` with readings of scene 1 with a degree of polarization of `dolp`.
    fn register(seed: u32, shift: [f64; 2], dolp: f32) -> (Found, Stack<f32>, bool) {
        register_view(&view(seed, &shifted(shift), MARGIN), dolp)
    }

    fn register_view(seen: &Stack<f32>, dolp: f32) -> (Found, Stack<f32>, bool) {
        let mut bench = Bench::new(image(1, [0.0; 2], 0).plane(0), dolp);
        let (mut placed, sampler, mut plane) = (Stack::zeros(1, SIZE), Sampler::new(), vec![0.0; SIZE.pixels()]);
        let bundle = moved(&Homography::IDENTITY, &shifted([MARGIN as f64; 2]), SIZE);
        let place = |p: &Parameters, guide: &mut Stack<f32>| {
            sampler.resample(seen.borrow(), (&moved(&bundle, p, SIZE), None), EVEN, guide, &mut plane);
        };
        bench.run(|frame, raw, scratch, w| {
            let found = find(frame, raw, place, &mut placed, scratch, w);
            (found, placed, found.fit.is_foreign(frame))
        })
    }

    /// A frame of a scene, and the camera that took it.
    pub(in super::super) struct Bench {
        operators: [StokesOperator; 1],
        coarse: [Arc<Coarse>; 1],
        raw: Stack<f32>,
        weight: Stack<f32>,
    }

    impl Bench {
        /// Readings of a scene of intensity `s0` and a degree of polarization of up to `dolp`, with noise.
        pub(in super::super) fn new(s0: &[f32], dolp: f32) -> Self {
            let operators = [operator()];
            let [op] = &operators;
            let polarization = |(i, s): (usize, &f32)| {
                let (x, y) = ((i % SIZE.width) as f32, (i / SIZE.width) as f32);
                Complex32::from_polar(dolp * s * (0.7 + 0.3 * (0.05 * x).cos()), 0.03 * y + 0.02 * x)
            };
            let l: Vec<_> = s0.iter().enumerate().map(polarization).collect();
            let mut scratch = op.convolver.make_scratch();
            let (mut y, mut polarized) = (vec![0.0; SIZE.pixels()], vec![0.0; SIZE.pixels()]);
            op.forward_s0(s0, &mut y, &mut scratch);
            op.forward_polarized(&l, &mut polarized, &mut scratch);
            let mut s = 7u32;
            for (y, p) in y.iter_mut().zip(&polarized) {
                s = s.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                *y = 0.6 * (*y + p) + NOISE * 12f32.sqrt() * ((s >> 8) as f32 / (1 << 24) as f32 - 0.5);
            }
            Self {
                coarse: [Arc::new(Coarse::beside_guide(op))],
                raw: Stack::from_vec(1, SIZE, y).unwrap(),
                weight: Stack::from_vec(1, SIZE, vec![1.0; SIZE.pixels()]).unwrap(),
                operators,
            }
        }

        /// Calls `work` with everything that a fit of the frame needs.
        pub(in super::super) fn run<T>(
            &mut self,
            work: impl FnOnce(&Frame<'_>, &mut Stack<f32>, &mut Scratch, &mut fit::Workspace) -> T,
        ) -> T {
            let Self { operators, coarse, raw, weight } = self;
            let noise = f64::from(reading_noise(raw.plane(0), weight.plane(0), SIZE, 1, &mut Vec::new())).powi(2);
            let trusted = SIZE.pixels() as f64;
            let frame = Frame { operators, coarse, weight, trusted, noise, beyond: None };
            let mut w = Buffers::allocate(|buffers| fit::Workspace::new(coarse, SIZE, buffers));
            w.begin(&frame, 1.0);
            work(&frame, raw, &mut operators[0].convolver.make_scratch(), &mut w)
        }
    }

    #[test]
    fn shifts_are_found_under_strong_polarization() {
        for shift in [[0.4, 0.4], [2.3, -3.4], [-3.0, 3.0]] {
            let (found, placed, foreign) = register(1, shift, 0.8);
            let error = (found.parameters[0] - shift[0]).hypot(found.parameters[1] - shift[1]);
            assert!(!foreign && error < 0.2, "{shift:?}: {found:?}");
            let truth = image(1, [0.0; 2], 0);
            let far = placed.as_slice().iter().zip(truth.as_slice()).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(far < 0.02, "{shift:?}: the placed guide is off by {far}");
            assert!(found.uncertainty < 0.1, "{found:?}");
        }
    }

    #[test]
    fn an_aligned_guide_is_not_touched() {
        for dolp in [0.0, 0.8] {
            let (found, placed, foreign) = register(1, [0.0; 2], dolp);
            assert!(!foreign && found.parameters == Parameters::zeros(), "{found:?}");
            assert!((found.fit.detail - found.fit.gain).abs() < 3.0 * found.fit.detail_deviation, "{found:?}");
            assert_eq!(placed.as_slice(), image(1, [0.0; 2], 0).as_slice());
        }
    }

    #[test]
    fn a_turned_and_scaled_guide_is_aligned() {
        let lies = Parameters::from_column_slice(&[1.5, -1.0, 0.5, -0.8, 0.8, 0.5]);
        let (found, placed, foreign) = register_view(&view(1, &lies, MARGIN), 0.5);
        assert!(!foreign && (found.parameters - lies).norm() < 0.4, "{found:?}");
        let truth = image(1, [0.0; 2], 0);
        let far = placed.as_slice().iter().zip(truth.as_slice()).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(far < 0.03, "the placed guide is off by {far}");
    }

    /// Evenly spread content under a shift whose normal matrix is 2: one third of that for each factor x or y.
    #[test]
    fn an_affine_map_is_hinted_at_by_its_slope() {
        let moments = [10.0, 0.0, 0.0, 10.0 / 3.0, 0.0, 10.0 / 3.0];
        let hint = |slope: [f64; AFFINE]| affine_hint(Matrix2::identity() * 2.0, &moments, &Parameters::from(slope));
        assert!(hint([5.0, -3.0, 0.0, 0.0, 0.0, 0.0]).abs() < 1e-12, "a shift is none");
        assert!((hint([5.0, -3.0, 1.0, 0.0, 0.0, 2.0]) - 5.0 * 1.5).abs() < 1e-12);
    }

    #[test]
    fn a_guide_of_another_scene_is_told() {
        for seed in [2, 3, 4] {
            let (found, _, foreign) = register(seed, [0.0; 2], 0.3);
            assert!(foreign, "{seed}: {found:?}");
        }
    }
}
