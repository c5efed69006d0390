//! Lines of samples in counts: frames of any pixel format, and images of any number format, read row by row.
//!
//! Loops over a line are written for vector registers; whoever reads lines compiles them for the machine's.

use super::unpack::{float, packed10, packed12, rgb};
use crate::frame::{Frame, PixelFormat, Samples};
use crate::image::ImageView;

/// How the samples of one row of pixels lie in a frame.
#[derive(Clone, Copy, Debug)]
pub(super) struct Layout {
    /// Lines of samples for a row of pixels.
    pub(super) lines: usize,
    /// Samples of a pixel that follow each other in a line.
    pub(super) samples: usize,
    /// Plane of each sample of each line.
    pub(super) planes: [usize; 4],
}

impl Layout {
    /// Samples of a pixel that belong to plane `c`.
    pub(super) fn of(&self, c: usize) -> usize {
        self.planes[..self.lines * self.samples].iter().filter(|plane| **plane == c).count()
    }
}

/// Lines of samples in counts.
pub(super) trait Lines: Sync {
    fn layout(&self) -> Layout;
    /// The samples of line `line` of the pixels of row `y` from column `x` on, as many as `out` holds.
    fn read(&self, y: usize, line: usize, x: usize, out: &mut [f32]);
    /// One sample of line `line` of a pixel.
    fn sample(&self, y: usize, line: usize, x: usize, sample: usize) -> f32;
}

impl Lines for Frame<'_> {
    fn layout(&self) -> Layout {
        match self.format() {
            PixelFormat::Mono(_) | PixelFormat::Nv12Luma => Layout { lines: 1, samples: 1, planes: [0; 4] },
            PixelFormat::Bayer(order, _) => {
                let red = order.red();
                let plane = |k| {
                    if k == red {
                        0
                    } else if k == red ^ 3 {
                        2
                    } else {
                        1
                    }
                };
                Layout { lines: 2, samples: 2, planes: [0, 1, 2, 3].map(plane) }
            }
            PixelFormat::Rgb(_) | PixelFormat::Nv12Rgb | PixelFormat::Yuyv(_) => {
                Layout { lines: 1, samples: 3, planes: [0, 1, 2, 2] }
            }
        }
    }

    #[inline(always)]
    fn read(&self, y: usize, line: usize, x: usize, out: &mut [f32]) {
        let Layout { lines, samples, .. } = self.layout();
        let from = x * samples;
        match self.format() {
            PixelFormat::Nv12Luma => decode(Samples::U8, self.row(y), from, out),
            PixelFormat::Nv12Rgb | PixelFormat::Yuyv(_) => {
                out.as_chunks_mut::<3>().0.iter_mut().enumerate().for_each(|(i, out)| *out = rgb(self, x + i, y));
            }
            PixelFormat::Mono(samples) | PixelFormat::Bayer(_, samples) | PixelFormat::Rgb(samples) => {
                decode(samples, self.row(y * lines + line), from, out);
            }
        }
    }

    fn sample(&self, y: usize, line: usize, x: usize, sample: usize) -> f32 {
        let mut one = [0.0; 3];
        let samples = self.layout().samples;
        self.read(y, line, x, &mut one[..samples]);
        one[sample]
    }
}

/// Samples of a row from number `from` on.
#[inline(always)]
fn decode(samples: Samples, row: &[u8], from: usize, out: &mut [f32]) {
    match samples {
        Samples::U8 => out.iter_mut().zip(&row[from..]).for_each(|(out, v)| *out = f32::from(*v)),
        Samples::U10 | Samples::U12 | Samples::U16 => {
            let words = row[2 * from..].as_chunks::<2>().0;
            out.iter_mut().zip(words).for_each(|(out, v)| *out = f32::from(u16::from_le_bytes(*v)));
        }
        Samples::F32 => out.iter_mut().enumerate().for_each(|(i, out)| *out = float(row, from + i)),
        Samples::Packed10 => groups(row, from, out, packed10, |[a, b, c, d, low]: &[u8; 5], out: &mut [f32; 4]| {
            let of = |high: u8, k: u32| f32::from(u16::from(high) << 2 | u16::from(low >> (2 * k) & 0b11));
            *out = [of(*a, 0), of(*b, 1), of(*c, 2), of(*d, 3)];
        }),
        Samples::Packed12 => groups(row, from, out, packed12, |[a, b, low]: &[u8; 3], out: &mut [f32; 2]| {
            let of = |high: u8, low: u8| f32::from(u16::from(high) << 4 | u16::from(low));
            *out = [of(*a, low & 0b1111), of(*b, low >> 4)];
        }),
    }
}

/// Samples of a row of groups of `N` samples in `BYTES` bytes, from number `from` on; `one` reads a single one.
#[inline(always)]
fn groups<const BYTES: usize, const N: usize>(
    row: &[u8],
    from: usize,
    out: &mut [f32],
    one: impl Fn(&[u8], usize) -> f32,
    group: impl Fn(&[u8; BYTES], &mut [f32; N]),
) {
    let whole = from.next_multiple_of(N).min(from + out.len());
    let (head, rest) = out.split_at_mut(whole - from);
    head.iter_mut().enumerate().for_each(|(i, out)| *out = one(row, from + i));
    let (middle, tail) = rest.as_chunks_mut::<N>();
    let bytes = row[whole / N * BYTES..].as_chunks::<BYTES>().0;
    middle.iter_mut().zip(bytes).for_each(|(out, bytes)| group(bytes, out));
    let first = whole + middle.len() * N;
    tail.iter_mut().enumerate().for_each(|(i, out)| *out = one(row, first + i));
}

impl Lines for ImageView<'_> {
    fn layout(&self) -> Layout {
        Layout { lines: self.planes(), samples: 1, planes: [0, 1, 2, 2] }
    }

    #[inline(always)]
    fn read(&self, y: usize, line: usize, x: usize, out: &mut [f32]) {
        self.row(line, y, x, out);
    }

    fn sample(&self, y: usize, line: usize, x: usize, _: usize) -> f32 {
        let mut one = [0.0];
        self.row(line, y, x, &mut one);
        one[0]
    }
}

/// Lines of fractions of full scale, as counts: value · span + black.
pub(super) struct FullScale<'a, L> {
    pub(super) lines: &'a L,
    pub(super) span: f32,
    pub(super) black: f32,
}

impl<L: Lines> Lines for FullScale<'_, L> {
    fn layout(&self) -> Layout {
        self.lines.layout()
    }

    #[inline(always)]
    fn read(&self, y: usize, line: usize, x: usize, out: &mut [f32]) {
        self.lines.read(y, line, x, out);
        out.iter_mut().for_each(|v| *v = *v * self.span + self.black);
    }

    fn sample(&self, y: usize, line: usize, x: usize, sample: usize) -> f32 {
        self.lines.sample(y, line, x, sample) * self.span + self.black
    }
}
