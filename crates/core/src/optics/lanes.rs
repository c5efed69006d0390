//! Eight complex values side by side: what the solver's images and spectra are made of, and the choice of instructions.
//!
//! Real and imaginary parts lie apart, so that one arithmetic instruction works on four, eight or sixteen of them and nothing has
//! to be shuffled. A row of an image is a row of [`Lanes`], lane l of the j-th holding column 8j + l.

use fearless_simd::f32x8;
use fearless_simd::prelude::*;
use num_complex::Complex32;

/// Values side by side.
pub const LANES: usize = 8;

/// Eight complex values: one cache line.
#[repr(C, align(64))]
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Lanes {
    /// Real parts.
    pub re: [f32; LANES],
    /// Imaginary parts.
    pub im: [f32; LANES],
}

impl Lanes {
    /// Eight zeros.
    pub const ZERO: Self = Self { re: [0.0; LANES], im: [0.0; LANES] };

    /// The value in `lane`.
    pub fn get(&self, lane: usize) -> Complex32 {
        Complex32::new(self.re[lane], self.im[lane])
    }

    /// Replaces the value in `lane`.
    pub fn set(&mut self, lane: usize, v: Complex32) {
        (self.re[lane], self.im[lane]) = (v.re, v.im);
    }
}

/// Value `x` of a row.
pub(crate) fn at(row: &[Lanes], x: usize) -> Complex32 {
    row[x / LANES].get(x % LANES)
}

/// Replaces value `x` of a row.
pub(crate) fn put(row: &mut [Lanes], x: usize, v: Complex32) {
    row[x / LANES].set(x % LANES, v);
}

/// Sets the values of a row from `from` on to zero.
pub(crate) fn clear_from(row: &mut [Lanes], from: usize) {
    let (whole, rest) = (from.div_ceil(LANES), from % LANES);
    if rest > 0 {
        row[whole - 1].re[rest..].fill(0.0);
        row[whole - 1].im[rest..].fill(0.0);
    }
    row[whole..].fill(Lanes::ZERO);
}

/// Copies values into the beginning of a row; the rest of it becomes zero.
pub(crate) fn spread(values: &[Complex32], row: &mut [Lanes]) {
    let (whole, rest) = values.as_chunks::<LANES>();
    for (v, values) in row.iter_mut().zip(whole) {
        v.re = values.map(|v| v.re);
        v.im = values.map(|v| v.im);
    }
    clear_from(row, values.len() - rest.len());
    rest.iter().enumerate().for_each(|(lane, v)| row[whole.len()].set(lane, *v));
}

/// Copies the beginning of a row out.
pub(crate) fn collect(row: &[Lanes], values: &mut [Complex32]) {
    for (v, values) in row.iter().zip(values.chunks_mut(LANES)) {
        values.iter_mut().enumerate().for_each(|(lane, value)| *value = v.get(lane));
    }
}

/// Copies real values into the beginning of a row; the rest of it becomes zero.
pub(crate) fn spread_real(values: &[f32], row: &mut [[f32; LANES]]) {
    let flat = row.as_flattened_mut();
    flat[..values.len()].copy_from_slice(values);
    flat[values.len()..].fill(0.0);
}

/// Evaluates an expression with the widest vectors that `$level` has; `$s` stands for them in it. What it calls has to be
/// `#[inline(always)]` to be compiled for them.
macro_rules! vectorize {
    ($level:expr, $s:ident => $work:expr) => {{
        let level: fearless_simd::Level = $level;
        // SSE 4.2 brings nothing over SSE 2 here, so it is not compiled for.
        #[cfg(target_arch = "x86_64")]
        {
            use fearless_simd::Simd as _;
            if let Some($s) = level.as_avx512() {
                $s.vectorize(
                    #[inline(always)]
                    || $work,
                )
            } else if let Some($s) = level.as_avx2() {
                $s.vectorize(
                    #[inline(always)]
                    || $work,
                )
            } else if let Some($s) = level.as_sse2() {
                $s.vectorize(
                    #[inline(always)]
                    || $work,
                )
            } else {
                unreachable!("every x86-64 processor has SSE2")
            }
        }
        #[cfg(not(target_arch = "x86_64"))]
        {
            fearless_simd::dispatch!(level, $s => $work)
        }
    }};
}
pub(crate) use vectorize;

/// Eight complex values in registers.
#[derive(Clone, Copy)]
pub(crate) struct Wave<S: Simd> {
    pub(crate) re: f32x8<S>,
    pub(crate) im: f32x8<S>,
}

impl<S: Simd> Wave<S> {
    #[inline(always)]
    pub(crate) fn zero(s: S) -> Self {
        Self { re: f32x8::splat(s, 0.0), im: f32x8::splat(s, 0.0) }
    }

    #[inline(always)]
    pub(crate) fn load(s: S, v: &Lanes) -> Self {
        Self { re: f32x8::simd_from(s, v.re), im: f32x8::simd_from(s, v.im) }
    }

    #[inline(always)]
    pub(crate) fn store(self, v: &mut Lanes) {
        v.re = self.re.into();
        v.im = self.im.into();
    }

    #[inline(always)]
    pub(crate) fn conj(self) -> Self {
        Self { re: self.re, im: -self.im }
    }

    /// self · k
    #[inline(always)]
    pub(crate) fn scale(self, k: f32x8<S>) -> Self {
        Self { re: self.re * k, im: self.im * k }
    }

    /// self + v · k
    #[inline(always)]
    pub(crate) fn plus(self, v: Self, k: f32x8<S>) -> Self {
        Self { re: v.re.mul_add(k, self.re), im: v.im.mul_add(k, self.im) }
    }

    /// Re(conj(self) · v)
    #[inline(always)]
    pub(crate) fn inner(self, v: Self) -> f32x8<S> {
        self.re.mul_add(v.re, self.im * v.im)
    }

    #[inline(always)]
    pub(crate) fn norm_sqr(self) -> f32x8<S> {
        self.inner(self)
    }

    /// self − i·v and self + i·v.
    #[inline(always)]
    pub(crate) fn turn(self, v: Self) -> (Self, Self) {
        (Self { re: self.re + v.im, im: self.im - v.re }, Self { re: self.re - v.im, im: self.im + v.re })
    }
}

impl<S: Simd> std::ops::Add for Wave<S> {
    type Output = Self;
    #[inline(always)]
    fn add(self, v: Self) -> Self {
        Self { re: self.re + v.re, im: self.im + v.im }
    }
}

impl<S: Simd> std::ops::Sub for Wave<S> {
    type Output = Self;
    #[inline(always)]
    fn sub(self, v: Self) -> Self {
        Self { re: self.re - v.re, im: self.im - v.im }
    }
}

impl<S: Simd> std::ops::Mul for Wave<S> {
    type Output = Self;
    #[inline(always)]
    fn mul(self, v: Self) -> Self {
        Self { re: self.re.mul_sub(v.re, self.im * v.im), im: self.re.mul_add(v.im, self.im * v.re) }
    }
}

/// Instruction sets that this machine can run, the plainest first.
#[cfg(test)]
pub(crate) fn levels() -> Vec<fearless_simd::Level> {
    let best = fearless_simd::Level::new();
    let mut levels = vec![fearless_simd::Level::baseline()];
    #[cfg(target_arch = "x86_64")]
    levels.extend(best.as_avx2().map(fearless_simd::Simd::level));
    levels.push(best);
    levels
}

#[cfg(test)]
mod tests {
    use rand::{Rng, SeedableRng, rngs::StdRng};

    use super::*;

    #[test]
    fn rows_keep_their_values_and_are_zero_beyond_them() {
        let values: Vec<_> = (0..19).map(|i| Complex32::new(i as f32, -(i as f32))).collect();
        for n in [0, 3, 8, 19] {
            let mut row = [Lanes { re: [f32::NAN; LANES], im: [f32::NAN; LANES] }; 4];
            spread(&values[..n], &mut row);
            assert!((0..32).all(|x| at(&row, x) == values[..n].get(x).copied().unwrap_or(Complex32::ZERO)), "{n}");
            let mut back = vec![Complex32::ONE; n];
            collect(&row, &mut back);
            assert_eq!(back, values[..n]);
        }
    }

    /// Scalar form of [`Wave`]'s operations; with `fused`, a product and a sum are rounded once together.
    fn one(fused: bool, [a, b]: [Complex32; 2], k: f32) -> [f32; 15] {
        let fma = |x: f32, y: f32, z: f32| if fused { x.mul_add(y, z) } else { x * y + z };
        let inner = |a: Complex32, b: Complex32| fma(a.re, b.re, a.im * b.im);
        [
            [fma(a.re, b.re, -(a.im * b.im)), fma(a.re, b.im, a.im * b.re)].as_slice(),
            &[a.re + b.re, a.im + b.im, a.re - b.re, a.im - b.im],
            &[a.re * k, a.im * k, fma(b.re, k, a.re), fma(b.im, k, a.im)],
            &[inner(a, b), a.re + b.im, a.im - b.re, a.re - b.im, a.im + b.re],
        ]
        .concat()
        .try_into()
        .unwrap()
    }

    #[inline(always)]
    fn eight<S: Simd>(s: S, a: &Lanes, b: &Lanes, k: f32) -> [[f32; LANES]; 15] {
        let (a, b, k) = (Wave::load(s, a), Wave::load(s, b), f32x8::splat(s, k));
        let (left, right) = a.turn(b);
        let waves = [a * b, a + b, a - b, a.scale(k), a.plus(b, k)];
        let mut all = [[0.0; LANES]; 15];
        for (out, wave) in all.chunks_exact_mut(2).zip(waves) {
            (out[0], out[1]) = (wave.re.into(), wave.im.into());
        }
        all[10] = a.inner(b).into();
        (all[11], all[12], all[13], all[14]) = (left.re.into(), left.im.into(), right.re.into(), right.im.into());
        all
    }

    #[test]
    fn vectors_have_the_bits_of_scalars() {
        let mut generator = StdRng::seed_from_u64(1);
        let mut random = || {
            let magnitude = [1e-40, 1e-20, 1.0, 1e3, 1e18][generator.random_range(0..5)];
            magnitude * generator.random_range(-1.0..1.0f32)
        };
        for (k, level) in levels().into_iter().enumerate() {
            // SSE 2, the plainest of x86-64, has no fused product
            let fused = cfg!(not(target_arch = "x86_64")) || k > 0;
            for _ in 0..1000 {
                let mut lanes =
                    || Lanes { re: std::array::from_fn(|_| random()), im: std::array::from_fn(|_| random()) };
                let (a, b) = (lanes(), lanes());
                let k = random();
                let found = vectorize!(level, s => eight(s, &a, &b, k));
                for lane in 0..LANES {
                    let expected = one(fused, [a.get(lane), b.get(lane)], k);
                    let bits = |v: f32| if v == 0.0 { 0 } else { v.to_bits() };
                    let same = found.iter().zip(expected).all(|(f, e)| bits(f[lane]) == bits(e));
                    assert!(same, "{level:?} {a:?} {b:?} {k} {found:?} {expected:?}");
                }
            }
        }
    }
}
