//! The image step of an iteration: x from ν, z and d, exact on the padded circle.
//!
//! It minimises ½ρ‖k * x − (ν − u)‖² + ½t‖x − (z − u)‖² + ½τ‖∇x − (d − u)‖², each splitting with its own multiplier u. The row pass
//! leaves B = F(ν − u − k * x) and R = F(t·(z − u) + τ·∇ᵀ(d − u)), with the x it began with. So for each frequency
//!
//! ```text
//! X' = (ρ(|K|² X + K̄ B) + R) / (ρ|K|² + t + τ|D|²)
//! ```
//!
//! Differences that leave the frame carry no penalty: d − u is their present value there ([`super::prior_step`]).

use fearless_simd::prelude::*;
use fearless_simd::{Level, f32x8};

use super::Penalties;
use super::state::Iterate;
use crate::image::Size;
use crate::optics::lanes::{LANES, Lanes, Wave, vectorize};
use crate::optics::{Convolver, Kernel, Scratch};
use crate::solve::guided_filter::Reals;

/// Extrapolation of an image step: x is taken on by a multiple of the step, in its direction.
///
/// Late iterations approach the answer by ever smaller steps of much the same direction. A multiple of one step is where many would end.
#[derive(Clone, Copy, Debug)]
pub(in crate::solve) enum Extrapolation {
    /// Extrapolates the image that is read from the iterate; the state stays where it is.
    Output(f32),
    /// Extrapolates the state as well. Further iterations must follow, for the multipliers to settle.
    State(f32),
}

impl Extrapolation {
    pub(in crate::solve) const NONE: Self = Self::Output(0.0);
}

/// |D|² = 4 − 2cos − 2cos of the frequencies of both axes, as a sum of one table for each axis.
#[derive(Debug)]
pub(in crate::solve) struct Laplacian {
    rows: Vec<f32>,
    columns: Vec<Reals>,
}

impl Laplacian {
    /// Tables for a padded circle. Allocates.
    pub(in crate::solve) fn new(padded: Size) -> Self {
        let value = |k: usize, n: usize| 2.0 - 2.0 * (std::f32::consts::TAU * k as f32 / n as f32).cos();
        let lanes = |j: usize| std::array::from_fn(|l| value(j * LANES + l, padded.width));
        Self {
            rows: (0..padded.height).map(|k| value(k, padded.height)).collect(),
            columns: (0..padded.width / LANES).map(lanes).collect(),
        }
    }
}

impl Iterate {
    /// The image step. The iterate then holds x and k * x again, as transformed rows.
    pub(super) fn image_step(
        &mut self,
        p: Penalties,
        extrapolation: Extrapolation,
        laplacian: &Laplacian,
        c: &Convolver,
        kernel: &Kernel,
        scratch: &mut Scratch,
    ) {
        let (ph, kernel) = (c.padded().height, kernel.spectrum());
        let step = Step { p, extrapolation, pixels: c.padded().pixels() as f32 };
        let mix = |block: usize, a: &mut [Lanes], b: &mut [Lanes], x: &mut [Lanes]| {
            let kernel = &kernel[block * ph..][..ph];
            let laplacian = (&laplacian.columns[block], &laplacian.rows[..]);
            vectorize!(Level::new(), s => divide(s, a, b, x, kernel, laplacian, step));
        };
        c.couple_columns(&mut self.blurred, &mut self.image, &mut self.state.spectrum, mix, scratch);
    }
}

/// Constants of one image step.
#[derive(Clone, Copy)]
struct Step {
    p: Penalties,
    extrapolation: Extrapolation,
    /// Pixels of the padded circle. Inverse transforms do not divide by them, and the kernel carries 1/pixels.
    pixels: f32,
}

/// X' at one frequency, in plain form: what [`divide`] is tested against.
#[cfg(test)]
fn scalar(
    k: num_complex::Complex32,
    [x, b, r]: [num_complex::Complex32; 3],
    laplacian: f32,
    p: Penalties,
) -> num_complex::Complex32 {
    let power = p.blur * k.norm_sqr();
    (x * power + k.conj() * b * p.blur + r) / (power + p.prior + p.gradient * laplacian)
}

/// The image step at eight columns: `a` holds B, then K X'; `b` holds R, then X', both for the inverse transform; `x` holds X, then X'.
#[inline(always)]
fn divide<S: Simd>(
    s: S,
    a: &mut [Lanes],
    b: &mut [Lanes],
    x: &mut [Lanes],
    kernel: &[Lanes],
    (across, down): (&Reals, &[f32]),
    Step { p, extrapolation, pixels }: Step,
) {
    let (square, single) = (f32x8::splat(s, p.blur * pixels * pixels), f32x8::splat(s, p.blur * pixels));
    let (share, gradient) = (f32x8::splat(s, 1.0 / pixels), f32x8::splat(s, p.gradient));
    let across = f32x8::simd_from(s, *across) * gradient + p.prior;
    let (of_state, of_output) = match extrapolation {
        Extrapolation::Output(steps) => (0.0, steps),
        Extrapolation::State(steps) => (steps, 0.0),
    };
    let (of_state, of_output) = (f32x8::splat(s, of_state), f32x8::splat(s, of_output));
    for ((a, b), ((x, k), down)) in a.iter_mut().zip(b).zip(x.iter_mut().zip(kernel).zip(down)) {
        let k = Wave::load(s, k);
        let power = k.norm_sqr() * square;
        let divisor = f32x8::splat(s, 1.0) / (power + f32x8::splat(s, *down).mul_add(gradient, across));
        let pushed = Wave::load(s, b).plus(k.conj() * Wave::load(s, a), single);
        let before = Wave::load(s, x);
        let next = pushed.plus(before, power).scale(divisor);
        let step = next - before;
        let next = next.plus(step, of_state);
        next.store(x);
        (k * next).store(a);
        next.plus(step, of_output).scale(share).store(b);
    }
}

#[cfg(test)]
mod tests {
    use num_complex::Complex32;
    use proptest::prelude::*;

    use super::super::buffers::RowBuffers;
    use super::super::testing::{SIZE, complex, convolver, lanes, penalties};
    use super::*;
    use crate::optics::lanes::{collect, levels};

    /// x as it is read from the iterate, k * x, and x of the state, after an image step from `x`, or before.
    fn step(x: &[Complex32], extrapolation: Option<Extrapolation>) -> [Vec<Complex32>; 3] {
        let p = Penalties { blur: 0.3, prior: 0.7, gradient: 0.2, rescale: 1.3 };
        let c = convolver(1);
        let mut psf = vec![0.0; SIZE.pixels()];
        let middle = SIZE.height / 2 * SIZE.width + SIZE.width / 2;
        (psf[middle], psf[middle - 3], psf[middle + 2 * SIZE.width]) = (0.5, 0.2, 0.3);
        let (kernel, laplacian) = (c.kernel(&psf, SIZE), Laplacian::new(c.padded()));
        let (mut buffers, mut scratch) = (RowBuffers::for_threads(&c), c.make_scratch());
        let mut iterate = Iterate::new(&c, false);
        iterate.start(x, &c, &kernel, &mut buffers, &mut scratch);
        if let Some(extrapolation) = extrapolation {
            iterate.image_step(p, extrapolation, &laplacian, &c, &kernel, &mut scratch);
        }
        let [mut output, mut blurred, mut state] = [(); 3].map(|()| vec![Complex32::ZERO; SIZE.pixels()]);
        let row = |y: usize| y * SIZE.width..(y + 1) * SIZE.width;
        iterate.rows(&c, &mut buffers[0], |y, line| collect(line, &mut output[row(y)]));
        iterate.blurred_rows(&c, &mut buffers[0], |y, line| collect(line, &mut blurred[row(y)]));
        iterate.resume(&vec![Complex32::ZERO; SIZE.pixels()], &c, &kernel, &mut buffers, &mut scratch);
        iterate.rows(&c, &mut buffers[0], |y, line| collect(line, &mut state[row(y)]));
        [output, blurred, state]
    }

    #[test]
    fn an_extrapolated_image_lies_further_in_the_direction_of_the_step() {
        let x = complex(40);
        let (before, plain) = (step(&x, None), step(&x, Some(Extrapolation::NONE)));
        let further: [Vec<Complex32>; 3] = std::array::from_fn(|part| {
            before[part].iter().zip(&plain[part]).map(|(from, to)| to + (to - from) * 2.5).collect()
        });
        assert!(further[0].iter().zip(&plain[0]).any(|(a, b)| (a - b).norm() > 0.1));
        let [output, blurred, state] = &further;
        for (what, got, want) in [
            ("output", step(&x, Some(Extrapolation::Output(2.5))), [output, &plain[1], &plain[2]]),
            ("state", step(&x, Some(Extrapolation::State(2.5))), [output, blurred, state]),
        ] {
            for (got, want) in got.iter().flatten().zip(want.into_iter().flatten()) {
                assert!((got - want).norm() < 1e-4, "{what}: {got} {want}");
            }
        }
    }

    /// Derivative of the function that the step minimises, at X' and relative to its terms.
    #[test]
    fn the_scalar_form_is_the_minimum() {
        let (k, v, z, d) =
            (Complex32::new(0.3, -0.2), Complex32::new(1.0, 0.5), Complex32::I, Complex32::new(-0.4, 0.1));
        let (difference, x) = (Complex32::new(0.7, -0.9), Complex32::new(0.2, 0.6));
        let p = Penalties { blur: 0.3, prior: 0.7, gradient: 0.2, rescale: 1.0 };
        let r = z * p.prior + difference.conj() * d * p.gradient;
        let next = scalar(k, [x, v - k * x, r], difference.norm_sqr(), p);
        let slope = k.conj() * (k * next - v) * p.blur
            + (next - z) * p.prior
            + difference.conj() * (difference * next - d) * p.gradient;
        assert!(slope.norm() < 1e-6, "{slope}");
    }

    proptest! {
        #[test]
        fn the_vector_form_is_the_scalar_one(
            [k, b, r, x] in [lanes(), lanes(), lanes(), lanes()],
            p in penalties(),
            (across, down) in (0.0f32..4.0, 0.0f32..4.0),
            steps in 0.0f32..4.0,
        ) {
            // A power of two, so that no factor of it rounds.
            let pixels = 256.0;
            let close = |got: Complex32, want: Complex32, what: &str| {
                prop_assert!((got - want).norm() < 1e-4 * (1.0 + want.norm()), "{what}: {got} {want}");
                Ok(())
            };
            for level in levels() {
                for extrapolation in [Extrapolation::NONE, Extrapolation::Output(steps), Extrapolation::State(steps)] {
                    let (mut a, mut output, mut state) = ([b], [r], [x]);
                    let mut kernel = k;
                    (0..LANES).for_each(|lane| kernel.set(lane, k.get(lane) / pixels));
                    let step = Step { p, extrapolation, pixels };
                    let laplacian = (&[across; LANES], &[down][..]);
                    vectorize!(level, s => divide(s, &mut a, &mut output, &mut state, &[kernel], laplacian, step));
                    for lane in 0..LANES {
                        let [k, b, r, x] = [k, b, r, x].map(|v| v.get(lane));
                        let next = scalar(k, [x, b, r], across + down, p);
                        let (of_state, of_output) = match extrapolation {
                            Extrapolation::Output(steps) => (0.0, steps),
                            Extrapolation::State(steps) => (steps, 0.0),
                        };
                        let on = next + (next - x) * of_state;
                        close(state[0].get(lane), on, "state")?;
                        close(a[0].get(lane) * pixels, k * on, "k * x")?;
                        close(output[0].get(lane) * pixels, on + (next - x) * of_output, "output")?;
                    }
                }
            }
        }
    }
}
