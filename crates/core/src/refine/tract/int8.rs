//! Convolution in 8-bit integers: packing, products, bias and requantization in one pass over rows, without im2col.
//!
//! tract runs a quantized convolution as im2col, a matrix product and several passes of requantization, which takes longer than its
//! f32 convolution. This module runs `QLinearConv` nodes of one group with any kernel, stride and padding.
//!
//! q_out = round((Σ (q_in − z_in)·w + b)·m) + z_out with m = s_in·s_w/s_out (ONNX, `QLinearConv`). Sums are exact in i32; ties round to
//! even, as in ONNX Runtime. Every instruction set has the same loop over groups of input channels: four bytes where the core
//! has a dot product (AVX-512 VNNI, NEON dotprod), two i16 on AVX2, one i16 elsewhere.
//!
//! The lanes of a vector are pixels of a row, and the weights of a group are broadcast to them. Input and output are planes. The packed
//! input holds the channels of a group side by side, and the columns of each phase of the stride together.
//!
//! Allocation: packing the weights once. A run allocates its packed input and taps, and for each thread lines of a group and of a block
//! of sums.
#![allow(unsafe_code)]

#[cfg(target_arch = "aarch64")]
mod arm;
#[cfg(target_arch = "x86_64")]
mod x86;

use std::ops::Range;

use crate::parallel::{StridedBandsMut, StridedMut, Workers};

/// A convolution's shapes: NCHW, one image.
#[derive(Clone, Debug)]
pub(super) struct Geometry {
    /// Channels, height, width of the input.
    pub(super) input: [usize; 3],
    /// Channels, height, width of the output.
    pub(super) output: [usize; 3],
    /// Height and width of the kernel.
    pub(super) kernel: [usize; 2],
    /// Down and right.
    pub(super) stride: [usize; 2],
    /// Rows above and columns left of the input.
    pub(super) pad: [usize; 2],
}

/// The numbers of a quantized convolution.
#[derive(Clone, Debug)]
pub(super) struct Quantization {
    /// Weights less their zero point `[out, in, height, width]`, −128 to 127.
    pub(super) weights: Vec<i8>,
    /// Bias in units of s_in·s_w, for each output channel.
    pub(super) bias: Vec<i32>,
    /// m, for each output channel.
    pub(super) multiplier: Vec<f32>,
    /// z_in and z_out.
    pub(super) zero: [i32; 2],
    /// Whether input and output are i8 instead of u8.
    pub(super) signed: [bool; 2],
}

/// An image to convolve.
#[derive(Clone, Copy, Debug)]
pub(super) enum Source<'a> {
    /// u8 or i8, as the quantization says.
    Bytes(&'a [u8]),
    /// To be quantized: round(value · factor) + z_in.
    Floats(&'a [f32], f32),
}

/// The image to write.
#[derive(Debug)]
pub(super) enum Target<'a> {
    /// u8 or i8, as the quantization says.
    Bytes(&'a mut [u8]),
    /// Dequantized: (q_out − z)·scale, with z and scale.
    Floats(&'a mut [f32], i32, f32),
}

/// A convolution packed for an instruction set of this processor.
#[derive(Debug)]
pub(super) struct Conv {
    geometry: Geometry,
    isa: Isa,
    /// `[block of output channels][kernel row][input group][kernel column][channel of the block][channel of the group]`.
    weights: Vec<i16>,
    /// The weights in the same order, for sets with dot products of bytes.
    #[cfg_attr(not(any(target_arch = "x86_64", target_arch = "aarch64")), allow(dead_code, reason = "no such set"))]
    bytes: Vec<u8>,
    /// Bias, with the contribution of the input's zero point, for each output channel.
    bias: Vec<i32>,
    multiplier: Vec<f32>,
    /// An input byte is stored XORed with this.
    flip: u8,
    /// The stored byte that represents 0.
    border: u8,
    /// Zero point of the input as given.
    zero_in: i32,
    signed_in: bool,
    zero_out: i32,
    flip_out: u8,
}

/// Instruction sets with a loop of their own.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Isa {
    Portable,
    #[cfg(target_arch = "x86_64")]
    Avx2,
    #[cfg(target_arch = "x86_64")]
    Vnni,
    #[cfg(target_arch = "aarch64")]
    Dot,
}

impl Isa {
    /// All sets of this processor, the fastest last.
    fn available() -> Vec<Self> {
        let all = [
            (Self::Portable, true),
            #[cfg(target_arch = "x86_64")]
            (Self::Avx2, is_x86_feature_detected!("avx2")),
            #[cfg(target_arch = "x86_64")]
            (Self::Vnni, is_x86_feature_detected!("avx512vnni") && is_x86_feature_detected!("avx512bw")),
            #[cfg(target_arch = "aarch64")]
            (Self::Dot, std::arch::is_aarch64_feature_detected!("dotprod")),
        ];
        all.into_iter().filter(|(_, has)| *has).map(|(isa, _)| isa).collect()
    }

    /// Input channels of a group.
    fn group(self) -> usize {
        match self {
            Self::Portable => Portable::GROUP,
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => x86::Avx2::GROUP,
            #[cfg(target_arch = "x86_64")]
            Self::Vnni => x86::Vnni::GROUP,
            #[cfg(target_arch = "aarch64")]
            Self::Dot => arm::Dot::GROUP,
        }
    }

    /// The unsigned input minus the stored one; none where i16 without a zero point are stored.
    fn offset(self) -> Option<i32> {
        match self {
            #[cfg(target_arch = "x86_64")]
            Self::Vnni => Some(0),
            #[cfg(target_arch = "aarch64")]
            Self::Dot => Some(128),
            _ => None,
        }
    }
}

impl Conv {
    /// Packs a convolution for the fastest instruction set of this processor. Allocates.
    pub(super) fn new(geometry: Geometry, q: &Quantization) -> Self {
        Self::with(geometry, q, Isa::available().pop().unwrap_or(Isa::Portable))
    }

    fn with(geometry: Geometry, q: &Quantization, isa: Isa) -> Self {
        let group = isa.group();
        let Geometry { input: [ci, ..], output: [co, ..], kernel: [kh, kw], .. } = geometry;
        let mut packed = Vec::with_capacity(co.next_multiple_of(BLOCK) * kh * kw * ci.next_multiple_of(group));
        for (o, y) in (0..co).step_by(BLOCK).flat_map(|o| (0..kh).map(move |y| (o, y))) {
            for (c, x) in (0..ci).step_by(group).flat_map(|c| (0..kw).map(move |x| (c, x))) {
                for (o, c) in (o..o + BLOCK).flat_map(|o| (c..c + group).map(move |c| (o, c))) {
                    let inside = o < co && c < ci;
                    packed.push(if inside { i16::from(q.weights[((o * ci + c) * kh + y) * kw + x]) } else { 0 });
                }
            }
        }
        // As unsigned numbers i8 inputs are 128 larger, and so is their zero point.
        let zero = q.zero[0] + if q.signed[0] { 128 } else { 0 };
        let stored_zero = isa.offset().map_or(0, |offset| zero - offset);
        let sum = |o: usize| q.weights[o * ci * kh * kw..][..ci * kh * kw].iter().map(|w| i32::from(*w)).sum::<i32>();
        let flip = if q.signed[0] { 128 } else { 0 } ^ isa.offset().unwrap_or(0) as u8;
        let quads = isa.offset().is_some();
        Self {
            bytes: if quads { packed.iter().map(|w| *w as u8).collect() } else { Vec::new() },
            weights: if quads { Vec::new() } else { packed },
            bias: (0..co).map(|o| q.bias[o] - stored_zero * sum(o)).collect(),
            multiplier: q.multiplier.clone(),
            flip,
            zero_in: q.zero[0],
            signed_in: q.signed[0],
            border: zero as u8 ^ isa.offset().unwrap_or(0) as u8,
            zero_out: q.zero[1] + if q.signed[1] { 128 } else { 0 },
            flip_out: if q.signed[1] { 128 } else { 0 },
            geometry,
            isa,
        }
    }

    /// Shape of the output, `[channels, height, width]`.
    pub(super) fn output(&self) -> [usize; 3] {
        self.geometry.output
    }

    /// Number of multiply-adds for one image.
    pub(super) fn macs(&self) -> usize {
        let Geometry { input: [ci, ..], output: [co, oh, ow], kernel: [kh, kw], .. } = self.geometry;
        ci * kh * kw * co * oh * ow
    }

    /// Zero point of the input.
    pub(super) fn zero_in(&self) -> i32 {
        self.zero_in
    }

    /// Convolves one image, rows shared among `team`. Allocates its scratch.
    ///
    /// # Panics
    /// When an image has another shape.
    pub(super) fn run(&self, input: Source<'_>, output: Target<'_>, team: &Workers) {
        let lengths = (self.geometry.input.iter().product(), self.geometry.output.iter().product());
        let input_len = match input {
            Source::Bytes(v) => v.len(),
            Source::Floats(v, _) => v.len(),
        };
        let output_len = match &output {
            Target::Bytes(v) => v.len(),
            Target::Floats(v, ..) => v.len(),
        };
        assert_eq!((input_len, output_len), lengths, "an image of another shape");
        let [channels, height, _] = self.geometry.output;
        let output = match output {
            Target::Bytes(v) => Bands::Bytes(team.strided_bands_mut(v, channels, height)),
            Target::Floats(v, zero, scale) => Bands::Floats(team.strided_bands_mut(v, channels, height), zero, scale),
        };
        match self.isa {
            Isa::Portable => self.run_with::<Portable>(&self.weights, input, &output, team),
            #[cfg(target_arch = "x86_64")]
            Isa::Avx2 => self.run_with::<x86::Avx2>(&self.weights, input, &output, team),
            #[cfg(target_arch = "x86_64")]
            Isa::Vnni => self.run_with::<x86::Vnni>(&self.bytes, input, &output, team),
            #[cfg(target_arch = "aarch64")]
            Isa::Dot => self.run_with::<arm::Dot>(&self.bytes, input, &output, team),
        }
    }

    fn run_with<L: Loop>(&self, weights: &[L::Stored], input: Source<'_>, output: &Bands<'_>, team: &Workers) {
        let Geometry { input: [ci, h, w], output: [_, oh, ow], kernel: [kh, kw], stride: [sy, sx], pad: [top, left] } =
            self.geometry;
        let groups = ci.div_ceil(L::GROUP);
        // Sums come in vectors of pixels, so the last vector reads beyond the row's end.
        let phase = (ow.next_multiple_of(L::LANES) + (kw - 1) / sx).max((left + w).div_ceil(sx)) * L::GROUP;
        let (row, group) = (groups * sx * phase, sx * phase);
        let tap = |x: usize| x % sx * phase + x / sx * L::GROUP;
        let pairs = (0..kh).flat_map(|y| (0..groups).map(move |g| y * row + g * group));
        let taps = pairs.flat_map(|at| (0..kw).map(move |x| at + tap(x))).collect();
        let strides = Strides { row, group, phase, taps };
        let mut padded = vec![L::stored(self.border, 0); ((oh - 1) * sy + kh).max(top + h) * strides.row];
        let rows = team.bands_mut(&mut padded[top * row..(top + h) * row], h);
        team.run(team.threads(), &|task| {
            let work = Work::Pack { input, rows: rows.take(task), strides: &strides };
            // SAFETY: `L` is the loop of `isa`, which the processor has.
            unsafe { L::work(self, work, team.band(task, h)) };
        });
        team.run(team.threads(), &|task| {
            let work = Work::Sum { padded: &padded, weights, strides: &strides, output: output.take(task) };
            // SAFETY: as above; weights and input were packed for this loop.
            unsafe { L::work(self, work, team.band(task, oh)) };
        });
    }

    /// # Safety
    /// The processor has the instructions of `L`; weights and input of a sum were packed for `L`.
    #[inline(always)]
    unsafe fn work<L: Loop>(&self, work: Work<'_, L::Stored>, band: Range<usize>) {
        match work {
            Work::Pack { input, rows, strides } => self.pack::<L>(input, rows, strides, band),
            // SAFETY: the caller's promise.
            Work::Sum { padded, weights, strides, output } => unsafe {
                self.sum::<L>(padded, weights, strides, output, band);
            },
        }
    }

    /// Packs a band of the input's rows into `rows`.
    #[inline(always)]
    fn pack<L: Loop>(&self, input: Source<'_>, rows: &mut [L::Stored], strides: &Strides, band: Range<usize>) {
        let Geometry { input: [ci, h, w], stride: [_, sx], pad: [_, left], .. } = self.geometry;
        let Strides { row: row_len, group, phase, .. } = *strides;
        let mut lines = vec![L::stored(self.border, 0); L::GROUP * w];
        // As unsigned numbers i8 inputs are 128 larger.
        let sign = if self.signed_in { 128 } else { 0 };
        let zero = self.zero_in + i32::from(sign);
        let stored = |v: u8| L::stored(v ^ self.flip, i16::from(v ^ self.flip) - i16::from(self.border));
        for (y, row) in band.zip(rows.chunks_exact_mut(row_len)) {
            for (g, phases) in row.chunks_exact_mut(group).enumerate() {
                for (c, line) in (g * L::GROUP..ci).zip(lines.chunks_exact_mut(w)) {
                    let at = (c * h + y) * w..(c * h + y + 1) * w;
                    match input {
                        Source::Bytes(bytes) => line.iter_mut().zip(&bytes[at]).for_each(|(to, v)| *to = stored(*v)),
                        Source::Floats(values, factor) => {
                            let pixels = line.iter_mut().zip(&values[at]);
                            pixels.for_each(|(to, v)| *to = stored(requantize(v * factor, zero) ^ sign));
                        }
                    }
                }
                match (sx, L::GROUP) {
                    (1, 4) => interleave::<_, 4>(&lines, &mut phases[left * 4..]),
                    (1, 2) => interleave::<_, 2>(&lines, &mut phases[left * 2..]),
                    (1, 1) => phases[left..][..w].copy_from_slice(&lines),
                    _ => {
                        for (c, line) in lines.chunks_exact(w).enumerate() {
                            for (x, v) in (left..).zip(line) {
                                phases[x % sx * phase + x / sx * L::GROUP + c] = *v;
                            }
                        }
                    }
                }
            }
        }
    }

    /// Computes a band of the output's rows.
    ///
    /// # Safety
    /// As for [`Self::work`].
    #[inline(always)]
    unsafe fn sum<L: Loop>(
        &self,
        padded: &[L::Stored],
        weights: &[L::Stored],
        strides: &Strides,
        mut output: Band<'_>,
        band: Range<usize>,
    ) {
        let Geometry { output: [co, _, ow], stride: [sy, _], .. } = self.geometry;
        let line = ow.next_multiple_of(L::LANES);
        let block = strides.taps.len() * L::GROUP * BLOCK;
        let mut sums = vec![0i32; BLOCK * line];
        let first = band.start;
        for (y, o) in band.flat_map(|y| (0..co).step_by(BLOCK).map(move |o| (y, o))) {
            let from = &padded[y * sy * strides.row..];
            let weights = &weights[o / BLOCK * block..][..block];
            let mut x = 0;
            while x < line {
                let wide = line - x >= L::VECTORS * L::LANES;
                let (from, sums) = (&from[x * L::GROUP..], &mut sums[x..]);
                // SAFETY: `padded` holds the kernel's rows from here on, each phase all columns of vectors that begin within the
                // row and of the kernel beyond them; `weights` holds the block, `sums` BLOCK lines.
                unsafe {
                    let (from, weights, to) = (from.as_ptr(), weights.as_ptr(), Lines { at: sums.as_mut_ptr(), line });
                    match (wide, L::VECTORS) {
                        (true, 4) => tile::<L, 4>(from, weights, to, &strides.taps),
                        (true, _) => tile::<L, 2>(from, weights, to, &strides.taps),
                        (false, _) => tile::<L, 1>(from, weights, to, &strides.taps),
                    }
                }
                x += L::LANES * if wide { L::VECTORS } else { 1 };
            }
            for (o, sums) in (o..co).zip(sums.chunks_exact(line)) {
                let row = (y - first) * ow..(y - first + 1) * ow;
                let (bias, m) = (self.bias[o], self.multiplier[o]);
                match &mut output {
                    Band::Bytes(output) => {
                        let output = &mut output.group_mut(o)[row];
                        output.iter_mut().zip(sums).for_each(|(v, sum)| {
                            *v = requantize((sum + bias) as f32 * m, self.zero_out) ^ self.flip_out;
                        });
                    }
                    Band::Floats(output, zero, scale) => {
                        let output = &mut output.group_mut(o)[row];
                        let zero = *zero + i32::from(self.flip_out);
                        let number = |sum: &i32| i32::from(requantize((sum + bias) as f32 * m, self.zero_out)) - zero;
                        output.iter_mut().zip(sums).for_each(|(v, sum)| *v = number(sum) as f32 * *scale);
                    }
                }
            }
        }
    }
}

/// A [`Target`] cut into bands of rows, one for each thread.
enum Bands<'a> {
    Bytes(StridedBandsMut<'a, u8>),
    Floats(StridedBandsMut<'a, f32>, i32, f32),
}

/// One thread's band of a [`Target`].
enum Band<'a> {
    Bytes(StridedMut<'a, u8>),
    Floats(StridedMut<'a, f32>, i32, f32),
}

impl<'a> Bands<'a> {
    fn take(&self, task: usize) -> Band<'a> {
        match self {
            Self::Bytes(bands) => Band::Bytes(bands.take(task)),
            Self::Floats(bands, zero, scale) => Band::Floats(bands.take(task), *zero, *scale),
        }
    }
}

/// Work on a band of rows: those of the input are packed, then those of the output are summed.
enum Work<'a, Stored> {
    Pack { input: Source<'a>, rows: &'a mut [Stored], strides: &'a Strides },
    Sum { padded: &'a [Stored], weights: &'a [Stored], strides: &'a Strides, output: Band<'a> },
}

/// Interleaves lines of `G` channels pixel by pixel.
#[inline(always)]
fn interleave<T: Copy, const G: usize>(lines: &[T], to: &mut [T]) {
    let width = lines.len() / G;
    let lines: [&[T]; G] = std::array::from_fn(|c| &lines[c * width..][..width]);
    for (x, to) in to.as_chunks_mut::<G>().0.iter_mut().take(width).enumerate() {
        for c in 0..G {
            to[c] = lines[c][x];
        }
    }
}

/// round(value) + zero, clamped to a byte. Adding 1.5·2²³, whose last bit has the value 1, rounds to even; the bits of the sum then
/// count up from those of 1.5·2²³. The value is clamped first, to numbers that saturate a byte anyway.
#[inline(always)]
#[allow(clippy::manual_clamp, reason = "clamp keeps NaN, for which NEON would compare one value after another")]
fn requantize(value: f32, zero: i32) -> u8 {
    const MAGIC: f32 = 12_582_912.0;
    let rounded = (value.max(-1024.0).min(1024.0) + MAGIC).to_bits() as i32 - MAGIC.to_bits() as i32;
    (rounded + zero).clamp(0, 255) as u8
}

/// Output channels whose sums are kept in registers at the same time. With two vectors of pixels they take 12 of AVX2's 16 registers.
const BLOCK: usize = 6;

/// Distances in the packed input, in values.
struct Strides {
    row: usize,
    group: usize,
    /// From one phase of the stride to the next.
    phase: usize,
    /// From an output's first value to those of each kernel row, group and column.
    taps: Vec<usize>,
}

/// Lines of `line` sums, one for each output channel of a block.
#[derive(Clone, Copy)]
struct Lines {
    at: *mut i32,
    line: usize,
}

/// The inner loop of an instruction set: vectors of LANES pixels, groups of GROUP input channels.
trait Loop: Sized {
    const GROUP: usize;
    const LANES: usize;
    /// Vectors of pixels that share weights in registers, 2 or 4. Sums, pixels and weights have to fit into the registers.
    const VECTORS: usize;
    /// An input value, and a weight.
    type Stored: Copy + Send + Sync;
    type Sums: Copy;
    type Group: Copy;
    /// The stored form of a byte that represents `value`.
    fn stored(byte: u8, value: i16) -> Self::Stored;
    fn zero() -> Self::Sums;
    /// # Safety
    /// GROUP · LANES values can be read.
    unsafe fn values(from: *const Self::Stored) -> Self::Group;
    /// Adds the products of each vector with GROUP weights of each output channel.
    ///
    /// # Safety
    /// GROUP · BLOCK weights can be read.
    unsafe fn accumulate<const N: usize>(
        total: &mut [[Self::Sums; N]; BLOCK],
        values: [Self::Group; N],
        weights: *const Self::Stored,
    );
    /// # Safety
    /// LANES sums can be written.
    unsafe fn store(sums: Self::Sums, to: *mut i32);
    /// [`Conv::work`], compiled for the instructions.
    ///
    /// # Safety
    /// That of [`Conv::work`], and the processor has the instructions.
    unsafe fn work(conv: &Conv, work: Work<'_, Self::Stored>, band: Range<usize>);
}

/// [`Loop::accumulate`] with one channel's weights in all lanes.
#[inline(always)]
fn add_all<Sums: Copy, Group: Copy, Weights: Copy, const N: usize>(
    total: &mut [[Sums; N]; BLOCK],
    values: [Group; N],
    weights: impl Fn(usize) -> Weights,
    add: impl Fn(Sums, Group, Weights) -> Sums,
) {
    for (o, total) in total.iter_mut().enumerate() {
        let weights = weights(o);
        for n in 0..N {
            total[n] = add(total[n], values[n], weights);
        }
    }
}

/// The sums of N vectors of pixels, for each of BLOCK output channels.
///
/// # Safety
/// The processor has the instructions of `L`; input, weights and sums reach as far as `taps` and `to` say.
#[inline(always)]
unsafe fn tile<L: Loop, const N: usize>(input: *const L::Stored, weights: *const L::Stored, to: Lines, taps: &[usize]) {
    let mut total = [[L::zero(); N]; BLOCK];
    for (i, tap) in taps.iter().enumerate() {
        // SAFETY: N vectors of pixels at each tap, and a block of weights, as the caller promises.
        unsafe {
            let values: [L::Group; N] = std::array::from_fn(|n| L::values(input.add(tap + n * L::GROUP * L::LANES)));
            L::accumulate(&mut total, values, weights.add(i * L::GROUP * BLOCK));
        }
    }
    for (o, total) in total.iter().enumerate() {
        for (n, total) in total.iter().enumerate() {
            // SAFETY: N vectors of each of BLOCK lines, as the caller promises.
            unsafe { L::store(*total, to.at.add(o * to.line + n * L::LANES)) };
        }
    }
}

/// Any processor: the compiler's own vectors.
struct Portable;

impl Loop for Portable {
    const GROUP: usize = 1;
    const LANES: usize = 8;
    const VECTORS: usize = 2;
    type Stored = i16;
    type Sums = [i32; 8];
    type Group = [i16; 8];

    #[inline(always)]
    fn stored(_: u8, value: i16) -> i16 {
        value
    }

    #[inline(always)]
    fn zero() -> [i32; 8] {
        [0; 8]
    }

    #[inline(always)]
    unsafe fn values(from: *const i16) -> [i16; 8] {
        // SAFETY: the caller's promise.
        unsafe { from.cast::<[i16; 8]>().read_unaligned() }
    }

    #[inline(always)]
    unsafe fn accumulate<const N: usize>(
        total: &mut [[[i32; 8]; N]; BLOCK],
        values: [[i16; 8]; N],
        weights: *const i16,
    ) {
        // SAFETY: the caller's promise.
        let weight = |o: usize| i32::from(unsafe { *weights.add(o) });
        add_all(total, values, weight, |sums, v, w| std::array::from_fn(|i| sums[i] + i32::from(v[i]) * w));
    }

    #[inline(always)]
    unsafe fn store(sums: [i32; 8], to: *mut i32) {
        // SAFETY: the caller's promise.
        unsafe { to.cast::<[i32; 8]>().write_unaligned(sums) }
    }

    unsafe fn work(conv: &Conv, work: Work<'_, i16>, band: Range<usize>) {
        // SAFETY: the caller's promise.
        unsafe { conv.work::<Self>(work, band) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The definition, one output at a time, in i64 and f64.
    fn slow(g: &Geometry, q: &Quantization, input: &[u8]) -> Vec<u8> {
        let Geometry { input: [ci, h, w], output: [co, oh, ow], kernel: [kh, kw], stride, pad } = *g;
        let number = |byte: u8, signed: bool| if signed { i64::from(byte as i8) } else { i64::from(byte) };
        let mut output = Vec::new();
        for (o, y, x) in (0..co).flat_map(|o| (0..oh).flat_map(move |y| (0..ow).map(move |x| (o, y, x)))) {
            let mut sum = i64::from(q.bias[o]);
            for (c, i, j) in (0..ci).flat_map(|c| (0..kh).flat_map(move |i| (0..kw).map(move |j| (c, i, j)))) {
                let (sy, sx) = ((y * stride[0] + i).wrapping_sub(pad[0]), (x * stride[1] + j).wrapping_sub(pad[1]));
                if sy < h && sx < w {
                    let v = number(input[(c * h + sy) * w + sx], q.signed[0]) - i64::from(q.zero[0]);
                    sum += v * i64::from(q.weights[((o * ci + c) * kh + i) * kw + j]);
                }
            }
            let v = (f64::from(sum as f32 * q.multiplier[o]).round_ties_even() as i64) + i64::from(q.zero[1]);
            output.push(if q.signed[1] { v.clamp(-128, 127) as i8 as u8 } else { v.clamp(0, 255) as u8 });
        }
        output
    }

    #[test]
    fn every_instruction_set_gives_the_definition() {
        let mut seed = 5u32;
        let mut byte = || {
            seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (seed >> 24) as u8
        };
        println!("instruction sets: {:?}", Isa::available());
        let teams = [1, 3].map(Workers::new);
        // Miri is slow, so it runs the small shapes alone.
        let shapes = if cfg!(miri) { 2 } else { usize::MAX };
        for (ci, co, [h, w], k, stride, pad) in [
            (1, 1, [3, 2], 1, 1, 0),
            (3, 9, [4, 21], 3, 1, 1),
            (5, 7, [9, 13], 3, 1, 1),
            (6, 20, [8, 10], 6, 2, 2),
            (40, 33, [6, 5], 3, 2, 1),
            (64, 96, [4, 4], 1, 1, 0),
            // Rows of several vectors, for every instruction set.
            (5, 9, [3, 70], 3, 1, 1),
            (3, 9, [4, 75], 3, 2, 1),
        ]
        .into_iter()
        .take(shapes)
        {
            for signed in [[false, false], [true, false], [false, true], [true, true]] {
                let size = |n: usize| (n + 2 * pad - k) / stride + 1;
                let output = [co, size(h), size(w)];
                let geometry =
                    Geometry { input: [ci, h, w], output, kernel: [k; 2], stride: [stride; 2], pad: [pad; 2] };
                let centre = |signed: bool| if signed { -9 } else { 119 };
                let q = Quantization {
                    weights: (0..co * ci * k * k).map(|_| byte() as i8).collect(),
                    bias: (0..co).map(|_| i32::from(byte()) * 40 - 5000).collect(),
                    multiplier: (0..co).map(|_| f32::from(byte()) * 2e-5 / (ci as f32 * k as f32)).collect(),
                    zero: signed.map(centre),
                    signed,
                };
                let input: Vec<u8> = (0..ci * h * w).map(|_| byte()).collect();
                let expected = slow(&geometry, &q, &input);
                for isa in Isa::available() {
                    let conv = Conv::with(geometry.clone(), &q, isa);
                    for team in &teams {
                        let mut found = vec![0; expected.len()];
                        conv.run(Source::Bytes(&input), Target::Bytes(&mut found), team);
                        assert!(found == expected, "{isa:?} {geometry:?} {signed:?} {team:?}");
                    }
                    // From and to floating point, in units of 1/4.
                    let number = |byte: u8, k: usize| i32::from(byte) - if signed[k] && byte > 127 { 256 } else { 0 };
                    let floats: Vec<f32> = input.iter().map(|v| 0.25 * (number(*v, 0) - q.zero[0]) as f32).collect();
                    let mut found = vec![0.0; expected.len()];
                    conv.run(Source::Floats(&floats, 4.0), Target::Floats(&mut found, q.zero[1], 0.25), &teams[1]);
                    let same = |(f, v): (&f32, &u8)| *f == 0.25 * (number(*v, 1) - q.zero[1]) as f32;
                    assert!(found.iter().zip(&expected).all(same), "{isa:?} {geometry:?} {signed:?} in floats");
                }
            }
        }
    }
}
