//! One-dimensional FFTs, eight lines at a time or one, behind one small trait, and the choice of a padded length.

use std::sync::Arc;

use fearless_simd::prelude::*;
use fearless_simd::{Level, f32x8};
use num_complex::Complex32;
use std::fmt;

use rustfft::FftPlanner;

use super::lanes::{LANES, Lanes, Wave, collect, spread, vectorize};
use crate::image::Buffers;

/// Implementation of the one-dimensional transforms; a setting of the board.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Deserialize, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum FftBackend {
    /// Eight lines at once in vector registers, lengths 2^a·3^b·5^c, tables on the heap. The fastest.
    #[default]
    Batched,
    /// The library rustfft, line by line: any length, tables on the heap. An independent check.
    Rustfft,
    /// The library microfft, line by line: powers of two from 8 to 4096, in place, tables in read-only memory.
    Microfft,
}

impl fmt::Display for FftBackend {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Batched => "batched",
            Self::Rustfft => "rustfft",
            Self::Microfft => "microfft",
        })
    }
}

impl FftBackend {
    /// All backends.
    pub const ALL: [Self; 3] = [Self::Batched, Self::Rustfft, Self::Microfft];

    /// The shortest length of at least `min` for which [`Fft::line`] works; none beyond the backend's largest table.
    pub fn line_length(self, min: usize) -> Option<usize> {
        self.length(min, LANES * LANES)
    }

    /// The shortest length of at least `min` for which [`Fft::batch`] works; none beyond the backend's largest table.
    pub fn batch_length(self, min: usize) -> Option<usize> {
        self.length(min, LANES)
    }

    fn length(self, min: usize, multiple: usize) -> Option<usize> {
        let smooth = |m: usize| (min.div_ceil(m).max(1) * m..).step_by(m).find(|&n| is_5_smooth(n));
        match self {
            Self::Batched => smooth(multiple),
            Self::Rustfft => smooth(LANES),
            Self::Microfft => Some(min.next_power_of_two().max(LANES)).filter(|&n| n <= 4096),
        }
    }

    /// Plans transforms of `len` values. Allocates tables once.
    ///
    /// # Errors
    /// None when the backend cannot transform this length.
    pub fn plan(self, len: usize) -> Option<Arc<dyn Fft>> {
        let fits = len > 0 && len.is_multiple_of(LANES);
        match self {
            _ if !fits => None,
            Self::Batched => is_5_smooth(len).then(|| Arc::new(Batched::new(len, Level::new())) as Arc<dyn Fft>),
            Self::Rustfft => {
                let mut planner = FftPlanner::new();
                let (forward, inverse) = (planner.plan_fft_forward(len), planner.plan_fft_inverse(len));
                let scratch = forward.get_inplace_scratch_len().max(inverse.get_inplace_scratch_len());
                let transform =
                    move |direction: Direction, line: &mut [Complex32], scratch: &mut [Complex32]| match direction {
                        Direction::Forward => forward.process_with_scratch(line, scratch),
                        Direction::Adjoint => inverse.process_with_scratch(line, scratch),
                    };
                Some(Arc::new(LineByLine { len, scratch, transform }))
            }
            Self::Microfft => {
                let forward = microfft_of(len)?;
                let transform = move |direction: Direction, line: &mut [Complex32], _: &mut [Complex32]| {
                    forward(line);
                    // The inverse is the forward one read backwards (index n → −n mod len).
                    if direction == Direction::Adjoint {
                        line[1..].reverse();
                    }
                };
                Some(Arc::new(LineByLine { len, scratch: 0, transform }))
            }
        }
    }
}

fn is_5_smooth(mut n: usize) -> bool {
    for p in [2, 3, 5] {
        while n.is_multiple_of(p) {
            n /= p;
        }
    }
    n == 1
}

/// A linear operator, or its adjoint.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Direction {
    /// The transform X_k = Σ_n x_n exp(−2πi kn/len), or the convolution k * x.
    Forward,
    /// The unnormalised inverse transform x_n = Σ_k X_k exp(+2πi kn/len), or the convolution k̃ * x with k̃(d) = k(−d), which is the
    /// transpose of the forward convolution with crop.
    Adjoint,
}

/// Buffers of a transform. Garbage between calls.
#[derive(Debug)]
pub struct FftScratch {
    lanes: Vec<Lanes>,
    line: Vec<Complex32>,
}

impl FftScratch {
    /// Bytes held.
    pub fn bytes(&self) -> usize {
        size_of_val(self.lanes.as_slice()) + size_of_val(self.line.as_slice())
    }
}

/// Complex transforms of lines of one fixed length, in place, unnormalised in both directions: adjoint(forward(x)) = len·x.
/// Transforms do not allocate.
pub trait Fft: Send + Sync {
    /// Values in a line.
    fn line_len(&self) -> usize;

    /// Buffers for one transform at a time.
    fn scratch(&self, buffers: &mut Buffers) -> FftScratch;

    /// Buffers for one transform at a time. Allocates.
    fn make_scratch(&self) -> FftScratch {
        Buffers::allocate(|buffers| self.scratch(buffers))
    }

    /// Transforms one line: `len / 8` lanes, value n in lane n mod 8 of the (n / 8)-th.
    ///
    /// # Panics
    /// When the length was not chosen by [`FftBackend::line_length`].
    fn line(&self, direction: Direction, line: &mut [Lanes], scratch: &mut FftScratch);

    /// Transforms eight lines: `len` lanes, value n of line l in lane l of the n-th.
    fn batch(&self, direction: Direction, lines: &mut [Lanes], scratch: &mut FftScratch);
}

/// A library that transforms one line of `Complex32`.
struct LineByLine<F> {
    len: usize,
    scratch: usize,
    transform: F,
}

impl<F: Fn(Direction, &mut [Complex32], &mut [Complex32]) + Send + Sync> Fft for LineByLine<F> {
    fn line_len(&self) -> usize {
        self.len
    }

    fn scratch(&self, buffers: &mut Buffers) -> FftScratch {
        FftScratch { lanes: Vec::new(), line: buffers.filled(Complex32::ZERO, self.len + self.scratch) }
    }

    fn line(&self, direction: Direction, line: &mut [Lanes], scratch: &mut FftScratch) {
        let (values, scratch) = scratch.line.split_at_mut(self.len);
        collect(line, values);
        (self.transform)(direction, values, scratch);
        spread(values, line);
    }

    fn batch(&self, direction: Direction, lines: &mut [Lanes], scratch: &mut FftScratch) {
        let (values, scratch) = scratch.line.split_at_mut(self.len);
        for lane in 0..LANES {
            values.iter_mut().zip(&*lines).for_each(|(v, lanes)| *v = lanes.get(lane));
            (self.transform)(direction, values, scratch);
            values.iter().zip(&mut *lines).for_each(|(v, lanes)| lanes.set(lane, *v));
        }
    }
}

/// microfft types its functions by array length; this finds the one for slices of `len`.
fn microfft_of(len: usize) -> Option<fn(&mut [Complex32])> {
    macro_rules! by_length {
        ($($n:literal $f:ident),+) => {
            match len {
                $($n => Some(|line: &mut [Complex32]| {
                    if let Ok(line) = <&mut [Complex32; $n]>::try_from(line) {
                        // In place; the array it gives back is the same memory.
                        let _ = microfft::complex::$f(line);
                    }
                }),)+
                _ => None,
            }
        };
    }
    by_length!(
        8 cfft_8, 16 cfft_16, 32 cfft_32, 64 cfft_64, 128 cfft_128, 256 cfft_256, 512 cfft_512, 1024 cfft_1024,
        2048 cfft_2048, 4096 cfft_4096
    )
}

/// Stockham's algorithm with radices 4, 2, 3 and 5 on eight lines at once. A single line of length 8m is eight interleaved lines
/// of length m, transformed at once, turned, transposed in squares of 8×8 and joined by transforms of length 8.
struct Batched {
    level: Level,
    lines: Stockham,
    /// Transforms of the m parts of a line.
    parts: Stockham,
    /// exp(−2πi kl/len) for part frequency k and lane l.
    turns: Vec<Lanes>,
}

/// The passes of eight transforms of one length.
struct Stockham {
    len: usize,
    passes: Vec<Pass>,
}

struct Pass {
    radix: usize,
    stride: usize,
    /// exp(−2πi pk/n) for k = 1 … radix − 1, for each p.
    turns: Vec<[f32; 2]>,
}

fn turn(of: usize, len: usize) -> [f32; 2] {
    let angle = -std::f64::consts::TAU * of as f64 / len as f64;
    [angle.cos() as f32, angle.sin() as f32]
}

/// Calls a function for the radix.
macro_rules! by_radix {
    ($radix:expr, $f:ident::<$s:ident, $inverse:ident>($($argument:expr),+)) => {
        match $radix {
            2 => $f::<$s, 2, $inverse>($($argument),+),
            3 => $f::<$s, 3, $inverse>($($argument),+),
            4 => $f::<$s, 4, $inverse>($($argument),+),
            _ => $f::<$s, 5, $inverse>($($argument),+),
        }
    };
}

impl Stockham {
    fn new(len: usize) -> Self {
        let (mut left, mut stride, mut passes) = (len, 1, Vec::new());
        for radix in [4, 2, 3, 5] {
            while left.is_multiple_of(radix) {
                let turns = (0..left / radix).flat_map(|p| (1..radix).map(move |k| turn(p * k, left))).collect();
                passes.push(Pass { radix, stride, turns });
                left /= radix;
                stride *= radix;
            }
        }
        Self { len, passes }
    }

    /// The result is in `scratch` if `ELSEWHERE`, else in `data`; the other one is scratch. An inverse transform is a forward one
    /// with real and imaginary parts exchanged before and after.
    #[inline(always)]
    fn run<S: Simd, const INVERSE: bool, const ELSEWHERE: bool>(
        &self,
        s: S,
        data: &mut [Lanes],
        scratch: &mut [Lanes],
    ) {
        let (data, scratch) = (&mut data[..self.len], &mut scratch[..self.len]);
        for (i, p) in self.passes.iter().enumerate() {
            let from_data = i % 2 == 0;
            // The last pass may write where it reads, so that nothing has to be copied if it began in the right place.
            let stay = i + 1 == self.passes.len() && from_data != ELSEWHERE;
            match (from_data, stay) {
                (true, true) => by_radix!(p.radix, in_place::<S, INVERSE>(s, data)),
                (true, false) => by_radix!(p.radix, pass::<S, INVERSE>(s, data, scratch, p)),
                (false, true) => by_radix!(p.radix, in_place::<S, INVERSE>(s, scratch)),
                (false, false) => by_radix!(p.radix, pass::<S, INVERSE>(s, scratch, data, p)),
            }
        }
    }
}

#[inline(always)]
fn load<S: Simd, const INVERSE: bool>(s: S, v: &Lanes) -> Wave<S> {
    let Wave { re, im } = Wave::load(s, v);
    if INVERSE { Wave { re: im, im: re } } else { Wave { re, im } }
}

#[inline(always)]
fn store<S: Simd, const INVERSE: bool>(Wave { re, im }: Wave<S>, v: &mut Lanes) {
    if INVERSE { Wave { re: im, im: re } } else { Wave { re, im } }.store(v);
}

/// One pass, decimating in frequency: data are read at a distance of len/radix and written in order.
#[inline(always)]
fn pass<S: Simd, const R: usize, const INVERSE: bool>(s: S, src: &[Lanes], dst: &mut [Lanes], pass: &Pass) {
    s.vectorize(
        #[inline(always)]
        || {
            let (block, stride) = (src.len() / R, pass.stride);
            let groups = dst.chunks_exact_mut(stride * R).zip(pass.turns.chunks_exact(R - 1));
            for (p, (dst, turns)) in groups.enumerate() {
                let mut w = [Wave::zero(s); R];
                for (w, [re, im]) in w[1..].iter_mut().zip(turns) {
                    *w = Wave { re: f32x8::splat(s, *re), im: f32x8::splat(s, *im) };
                }
                for q in 0..stride {
                    let mut x = [Wave::zero(s); R];
                    for (j, x) in x.iter_mut().enumerate() {
                        *x = load::<S, INVERSE>(s, &src[j * block + p * stride + q]);
                    }
                    let y = small(s, x);
                    store::<S, INVERSE>(y[0], &mut dst[q]);
                    for k in 1..R {
                        store::<S, INVERSE>(y[k] * w[k], &mut dst[k * stride + q]);
                    }
                }
            }
        },
    );
}

/// The last pass needs no turning and no other memory.
#[inline(always)]
fn in_place<S: Simd, const R: usize, const INVERSE: bool>(s: S, data: &mut [Lanes]) {
    s.vectorize(
        #[inline(always)]
        || {
            let block = data.len() / R;
            for q in 0..block {
                let mut x = [Wave::zero(s); R];
                for (j, x) in x.iter_mut().enumerate() {
                    *x = load::<S, INVERSE>(s, &data[j * block + q]);
                }
                for (k, y) in small(s, x).into_iter().enumerate() {
                    store::<S, INVERSE>(y, &mut data[k * block + q]);
                }
            }
        },
    );
}

/// The transform of length R.
#[inline(always)]
fn small<S: Simd, const R: usize>(s: S, x: [Wave<S>; R]) -> [Wave<S>; R] {
    let mut y = x;
    match R {
        2 => y.copy_from_slice(&[x[0] + x[1], x[0] - x[1]]),
        3 => {
            let (sum, difference) = (x[1] + x[2], (x[1] - x[2]).scale(f32x8::splat(s, 0.75f32.sqrt())));
            let (y1, y2) = x[0].plus(sum, f32x8::splat(s, -0.5)).turn(difference);
            y.copy_from_slice(&[x[0] + sum, y1, y2]);
        }
        4 => y.copy_from_slice(&four([x[0], x[1], x[2], x[3]])),
        5 => y.copy_from_slice(&five(s, [x[0], x[1], x[2], x[3], x[4]])),
        _ => unreachable!("radices are 2, 3, 4 and 5"),
    }
    y
}

#[inline(always)]
fn four<S: Simd>([a, b, c, d]: [Wave<S>; 4]) -> [Wave<S>; 4] {
    let (even, odd) = (a + c, b + d);
    let (y1, y3) = (a - c).turn(b - d);
    [even + odd, y1, even - odd, y3]
}

#[inline(always)]
fn five<S: Simd>(s: S, [a, b, c, d, e]: [Wave<S>; 5]) -> [Wave<S>; 5] {
    let fifth = std::f64::consts::TAU / 5.0;
    let number = |v: f64| f32x8::splat(s, v as f32);
    let (c1, c2, s1, s2) =
        (number(fifth.cos()), number((2.0 * fifth).cos()), number(fifth.sin()), number((2.0 * fifth).sin()));
    let (be, b_e, cd, c_d) = (b + e, b - e, c + d, c - d);
    let (y1, y4) = a.plus(be, c1).plus(cd, c2).turn(b_e.scale(s1).plus(c_d, s2));
    let (y2, y3) = a.plus(be, c2).plus(cd, c1).turn(b_e.scale(s2).plus(c_d, -s1));
    [a + be + cd, y1, y2, y3, y4]
}

#[inline(always)]
fn eight<S: Simd>(s: S, x: [Wave<S>; 8]) -> [Wave<S>; 8] {
    let half = f32x8::splat(s, std::f32::consts::FRAC_1_SQRT_2);
    let [e0, e1, e2, e3] = four([x[0], x[2], x[4], x[6]]);
    let [o0, o1, o2, o3] = four([x[1], x[3], x[5], x[7]]);
    let o1 = Wave { re: (o1.re + o1.im) * half, im: (o1.im - o1.re) * half };
    let o3 = Wave { re: (o3.im - o3.re) * half, im: -(o3.re + o3.im) * half };
    let (y2, y6) = e2.turn(o2);
    [e0 + o0, e1 + o1, y2, e3 + o3, e0 - o0, e1 - o1, y6, e3 - o3]
}

/// Three perfect shuffles of eight rows transpose them.
#[inline(always)]
fn transpose<S: Simd>(mut v: [f32x8<S>; 8]) -> [f32x8<S>; 8] {
    for _ in 0..3 {
        let u = v;
        for i in 0..4 {
            (v[2 * i], v[2 * i + 1]) = u[i].interleave(u[i + 4]);
        }
    }
    v
}

impl Batched {
    fn new(len: usize, level: Level) -> Self {
        let m = len / LANES;
        let turns = (0..m)
            .map(|k| {
                let mut turns = Lanes::ZERO;
                for l in 0..LANES {
                    [turns.re[l], turns.im[l]] = turn(k * l, len);
                }
                turns
            })
            .collect();
        Self { level, lines: Stockham::new(len), parts: Stockham::new(m), turns }
    }

    #[inline(always)]
    fn run_line<S: Simd, const INVERSE: bool>(&self, s: S, line: &mut [Lanes], scratch: &mut [Lanes]) {
        self.parts.run::<S, INVERSE, true>(s, line, scratch);
        s.vectorize(
            #[inline(always)]
            || {
                let squares = line.len() / LANES;
                let squares_of = scratch.chunks_exact(LANES).zip(self.turns.chunks_exact(LANES));
                for (t, (part, turns)) in squares_of.enumerate() {
                    let zero = f32x8::splat(s, 0.0);
                    let (mut re, mut im) = ([zero; LANES], [zero; LANES]);
                    for i in 0..LANES {
                        let v = load::<S, INVERSE>(s, &part[i]) * Wave::load(s, &turns[i]);
                        (re[i], im[i]) = (v.re, v.im);
                    }
                    let (re, im) = (transpose(re), transpose(im));
                    let mut x = [Wave::zero(s); LANES];
                    for i in 0..LANES {
                        x[i] = Wave { re: re[i], im: im[i] };
                    }
                    for (k, y) in eight(s, x).into_iter().enumerate() {
                        store::<S, INVERSE>(y, &mut line[k * squares + t]);
                    }
                }
            },
        );
    }
}

impl Fft for Batched {
    fn line_len(&self) -> usize {
        self.lines.len
    }

    fn scratch(&self, buffers: &mut Buffers) -> FftScratch {
        FftScratch { lanes: buffers.filled(Lanes::ZERO, self.lines.len), line: Vec::new() }
    }

    fn line(&self, direction: Direction, line: &mut [Lanes], scratch: &mut FftScratch) {
        assert!(self.lines.len.is_multiple_of(LANES * LANES), "a line of {} is not 64 n long", self.lines.len);
        let line = &mut line[..self.parts.len];
        vectorize!(self.level, s => match direction {
            Direction::Forward => self.run_line::<_, false>(s, line, &mut scratch.lanes),
            Direction::Adjoint => self.run_line::<_, true>(s, line, &mut scratch.lanes),
        });
    }

    fn batch(&self, direction: Direction, lines: &mut [Lanes], scratch: &mut FftScratch) {
        vectorize!(self.level, s => match direction {
            Direction::Forward => self.lines.run::<_, false, false>(s, lines, &mut scratch.lanes),
            Direction::Adjoint => self.lines.run::<_, true, false>(s, lines, &mut scratch.lanes),
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn noise(len: usize, seed: u32) -> Vec<Complex32> {
        let mut s = seed;
        let mut next = || {
            s = s.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (s >> 8) as f32 / (1 << 24) as f32 - 0.5
        };
        (0..len).map(|_| Complex32::new(next(), next())).collect()
    }

    /// The definition, in f64.
    fn naive(x: &[Complex32], direction: Direction) -> Vec<Complex32> {
        let n = x.len();
        let turn = if direction == Direction::Forward { -1.0 } else { 1.0 } * std::f64::consts::TAU / n as f64;
        (0..n)
            .map(|k| {
                let sum = x.iter().enumerate().fold(num_complex::Complex64::ZERO, |sum, (i, v)| {
                    let w = num_complex::Complex64::cis(turn * ((k * i) % n) as f64);
                    sum + w * num_complex::Complex64::new(v.re.into(), v.im.into())
                });
                Complex32::new(sum.re as f32, sum.im as f32)
            })
            .collect()
    }

    fn dirty(fft: &dyn Fft) -> FftScratch {
        let mut scratch = fft.make_scratch();
        scratch.lanes.fill(Lanes { re: [f32::NAN; LANES], im: [7.0; LANES] });
        scratch.line.fill(Complex32::new(f32::NAN, 7.0));
        scratch
    }

    fn check_line(fft: &dyn Fft, name: &str) {
        let len = fft.line_len();
        let x = noise(len, 1);
        for direction in [Direction::Forward, Direction::Adjoint] {
            let mut line = vec![Lanes::ZERO; len / LANES];
            spread(&x, &mut line);
            fft.line(direction, &mut line, &mut dirty(fft));
            for (k, want) in naive(&x, direction).iter().enumerate() {
                let got = line[k / LANES].get(k % LANES);
                assert!(
                    (want - got).norm() < 1e-6 * (len as f32).sqrt() * 5.0,
                    "{name} {len} {direction:?}: {want} {got}"
                );
            }
        }
    }

    fn check_batch(fft: &dyn Fft, name: &str) {
        let len = fft.line_len();
        let lines: Vec<_> = (0..LANES).map(|l| noise(len, l as u32)).collect();
        for direction in [Direction::Forward, Direction::Adjoint] {
            let mut batch = vec![Lanes::ZERO; len];
            for (l, line) in lines.iter().enumerate() {
                line.iter().zip(&mut batch).for_each(|(v, lanes)| lanes.set(l, *v));
            }
            fft.batch(direction, &mut batch, &mut dirty(fft));
            for (l, line) in lines.iter().enumerate() {
                for (want, got) in naive(line, direction).iter().zip(&batch) {
                    let error = (want - got.get(l)).norm();
                    assert!(error < 1e-6 * (len as f32).sqrt() * 5.0, "{name} {len} {direction:?}: off by {error}");
                }
            }
        }
    }

    #[test]
    fn every_backend_follows_the_definition_with_dirty_scratch() {
        for backend in FftBackend::ALL {
            for min in [2, 7, 64, 70, 129, 250, 305] {
                let fft = backend.plan(backend.line_length(min).unwrap()).unwrap();
                check_line(&*fft, &format!("{backend:?}"));
            }
            for min in [2, 8, 13, 24, 33, 72, 120, 250, 305, 350] {
                let fft = backend.plan(backend.batch_length(min).unwrap()).unwrap();
                check_batch(&*fft, &format!("{backend:?}"));
            }
        }
    }

    #[test]
    fn every_set_of_instructions_follows_the_definition() {
        for level in crate::optics::lanes::levels() {
            for len in [64, 192, 320, 576, 640] {
                check_line(&Batched::new(len, level), &format!("{level:?}"));
                check_batch(&Batched::new(len, level), &format!("{level:?}"));
            }
        }
    }

    #[test]
    fn lengths_are_tight_and_refused_beyond_the_tables() {
        assert_eq!(FftBackend::Batched.line_length(305), Some(320));
        assert_eq!(FftBackend::Batched.batch_length(330), Some(360));
        assert_eq!(FftBackend::Batched.line_length(330), Some(384));
        assert_eq!(FftBackend::Rustfft.line_length(305), Some(320));
        assert_eq!(FftBackend::Microfft.line_length(305), Some(512));
        assert_eq!(FftBackend::Microfft.line_length(4097), None);
        assert!(FftBackend::Microfft.plan(360).is_none());
    }
}
