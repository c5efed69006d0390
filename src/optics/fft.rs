//! One-dimensional FFT backends behind one small trait, and the choice of a padded length.

use std::sync::Arc;

use num_complex::Complex32;
use rustfft::{Fft, FftPlanner};

/// Which library computes the one-dimensional transforms. A board chooses.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Deserialize, serde::Serialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum FftBackend {
    /// Any length, SIMD where the processor has it, tables on the heap.
    #[default]
    Rustfft,
    /// Powers of two from 2 to 4096, in place, tables in read-only memory, no heap.
    Microfft,
}

impl FftBackend {
    /// Both backends.
    pub const ALL: [Self; 2] = [Self::Rustfft, Self::Microfft];

    /// The cheapest length this backend transforms that is at least `min`; none beyond its largest table.
    pub fn length_at_least(self, min: usize) -> Option<usize> {
        match self {
            // 5-smooth multiples of 8 keep the butterflies long and the rows aligned; at most 12 % above `min`.
            Self::Rustfft => (min.div_ceil(8) * 8..).step_by(8).find(|&n| is_5_smooth(n)),
            Self::Microfft => Some(min.next_power_of_two().max(2)).filter(|&n| n <= 4096),
        }
    }

    /// Plans transforms of `len` values. Allocates tables once.
    ///
    /// # Errors
    /// None when the backend cannot transform this length.
    pub fn plan(self, len: usize) -> Option<Arc<dyn LineFft>> {
        match self {
            Self::Rustfft => {
                let mut planner = FftPlanner::new();
                Some(Arc::new(RustfftLines {
                    forward: planner.plan_fft_forward(len),
                    inverse: planner.plan_fft_inverse(len),
                }))
            }
            Self::Microfft => MicrofftLines::new(len).map(|f| Arc::new(f) as Arc<dyn LineFft>),
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

/// Complex transforms of lines of one fixed length, in place, unnormalised in both directions: inverse(forward(x)) = len·x.
/// Neither direction allocates. Scratch is garbage afterwards and may be garbage before.
pub trait LineFft: Send + Sync {
    /// Values in a line.
    fn line_len(&self) -> usize;
    /// Values of scratch a call needs.
    fn scratch_len(&self) -> usize;
    /// X_k = Σ_n x_n exp(−2πi kn/len), for each line in `lines`.
    fn forward(&self, lines: &mut [Complex32], scratch: &mut [Complex32]);
    /// x_n = Σ_k X_k exp(+2πi kn/len), for each line in `lines`.
    fn inverse(&self, lines: &mut [Complex32], scratch: &mut [Complex32]);
}

struct RustfftLines {
    forward: Arc<dyn Fft<f32>>,
    inverse: Arc<dyn Fft<f32>>,
}

impl LineFft for RustfftLines {
    fn line_len(&self) -> usize {
        self.forward.len()
    }

    fn scratch_len(&self) -> usize {
        self.forward.get_inplace_scratch_len().max(self.inverse.get_inplace_scratch_len())
    }

    fn forward(&self, lines: &mut [Complex32], scratch: &mut [Complex32]) {
        self.forward.process_with_scratch(lines, scratch);
    }

    fn inverse(&self, lines: &mut [Complex32], scratch: &mut [Complex32]) {
        self.inverse.process_with_scratch(lines, scratch);
    }
}

struct MicrofftLines {
    len: usize,
    transform: fn(&mut [Complex32]),
}

impl MicrofftLines {
    fn new(len: usize) -> Option<Self> {
        /// microfft types its functions by array length; this makes a slice function of each.
        macro_rules! by_length {
            ($($n:literal $f:ident),+) => {
                match len {
                    $($n => |line: &mut [Complex32]| {
                        if let Ok(line) = <&mut [Complex32; $n]>::try_from(line) {
                            // In place; the array it gives back is the same memory.
                            let _ = microfft::complex::$f(line);
                        }
                    },)+
                    _ => return None,
                }
            };
        }
        let transform: fn(&mut [Complex32]) = by_length!(
            2 cfft_2, 4 cfft_4, 8 cfft_8, 16 cfft_16, 32 cfft_32, 64 cfft_64, 128 cfft_128, 256 cfft_256,
            512 cfft_512, 1024 cfft_1024, 2048 cfft_2048, 4096 cfft_4096
        );
        Some(Self { len, transform })
    }
}

impl LineFft for MicrofftLines {
    fn line_len(&self) -> usize {
        self.len
    }

    fn scratch_len(&self) -> usize {
        0
    }

    fn forward(&self, lines: &mut [Complex32], _scratch: &mut [Complex32]) {
        lines.chunks_exact_mut(self.len).for_each(self.transform);
    }

    /// By the forward transform: the inverse is the forward one read backwards (index n → −n mod len).
    fn inverse(&self, lines: &mut [Complex32], _scratch: &mut [Complex32]) {
        for line in lines.chunks_exact_mut(self.len) {
            (self.transform)(line);
            line[1..].reverse();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(len: usize) -> Vec<Complex32> {
        let mut s = 1u32;
        let mut next = || {
            s = s.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (s >> 8) as f32 / (1 << 24) as f32 - 0.5
        };
        (0..len).map(|_| Complex32::new(next(), next())).collect()
    }

    /// The definition, in f64.
    fn naive(x: &[Complex32], sign: f64) -> Vec<Complex32> {
        let n = x.len();
        let turn = sign * std::f64::consts::TAU / n as f64;
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

    #[test]
    fn both_backends_follow_the_definition_with_dirty_scratch() {
        for backend in FftBackend::ALL {
            for min in [2, 7, 64, 250, 305] {
                let len = backend.length_at_least(min).unwrap();
                let fft = backend.plan(len).unwrap();
                let mut scratch = vec![Complex32::new(f32::NAN, 7.0); fft.scratch_len()];
                let two_lines = [line(len), line(2 * len)[len..].to_vec()].concat();
                for (sign, inverse) in [(-1.0, false), (1.0, true)] {
                    let mut got = two_lines.clone();
                    let run = if inverse { LineFft::inverse } else { LineFft::forward };
                    run(&*fft, &mut got, &mut scratch);
                    for (x, got) in two_lines.chunks(len).zip(got.chunks(len)) {
                        for (a, b) in naive(x, sign).iter().zip(got) {
                            assert!((a - b).norm() < 1e-6 * (len as f32).sqrt() * 10.0, "{backend:?} {len}: {a} {b}");
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn lengths_are_tight_and_refused_beyond_the_tables() {
        assert_eq!(FftBackend::Rustfft.length_at_least(305), Some(320));
        assert_eq!(FftBackend::Microfft.length_at_least(305), Some(512));
        assert_eq!(FftBackend::Microfft.length_at_least(4097), None);
        assert!(FftBackend::Microfft.plan(360).is_none());
    }
}
