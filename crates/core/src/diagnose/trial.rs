//! Trials: how well the readings of one frame are explained by a guide behind this set-up, and behind others.
//!
//! Readings are fitted, at about 120 pixels a side, by the guide and its slowly varying polarization seen through PSF and mask. Small
//! shifts of the guide, light that the guide sees beyond the frame, and light from beyond it are unknowns too. A set-up under which less
//! is left over is nearer to the truth: detail of a PSF of filaments leaves no doubt.
//!
//! Allocation: everything here allocates.

use std::sync::Arc;

use super::Turn;
use crate::device::Device;
use crate::image::{Planes, Size};
use crate::optics::{Convolver, Direction, FftBackend, Field, Kernel, LengthError, Margin, Reach, Scratch};
use crate::parallel::Workers;
use crate::polarization::Angle;
use crate::readings::Readings;
use nalgebra::{DMatrix, DVector};
use num_complex::Complex32;

/// Pixels a side of the images that are fitted, about.
const SIDE: usize = 120;
/// Cosines along each axis: of the guide's polarization, and of light from beyond the frame.
const COSINES: usize = 3;
const WAVES: usize = COSINES * COSINES;
/// Images behind the PSF: the guide times each cosine, its gradients, and what it sees beyond the frame.
const IMAGES: usize = WAVES + 3;
/// The largest PSF that is tried, over the declared one.
const LARGEST: f64 = 1.15;
/// Shifts that are tried, over the side.
const SHIFTS: usize = 9;
/// Share of its modulation that a mask keeps where trials can tell masks apart.
const KEPT: f32 = 0.5;

/// Response of the sensor at the trial's size.
#[derive(Clone)]
pub(super) struct Response {
    unpolarized: Vec<f32>,
    polarized: Vec<Complex32>,
}

/// Unknown light that the guide does not tell of.
#[derive(Clone, Copy)]
pub(super) enum Stray<'a> {
    /// Smooth light behind the mask.
    Smooth,
    /// Images of light from beyond the frame behind the PSF.
    Beyond(&'a [Vec<f32>]),
    /// The same light, and a constant in every reading.
    ConstantAndBeyond(&'a [Vec<f32>]),
}

/// Residual of a fit.
#[derive(Clone, Copy)]
pub(super) struct Rest {
    /// Mean square.
    pub(super) mean_square: f64,
    /// The constant of [`Stray::ConstantAndBeyond`].
    pub(super) constant: f64,
}

/// One frame to be tried.
pub(super) struct Trial<'a> {
    device: &'a Device,
    channel: usize,
    bin: usize,
    field: Field,
    convolver: Convolver,
    scratch: Scratch,
    readings: Vec<f32>,
    weight: Vec<f32>,
    guide: Vec<f32>,
    pub(super) declared: Response,
}

/// Images of the guide behind a PSF, on the frame.
pub(super) struct Blurred(Vec<Vec<f32>>);

impl<'a> Trial<'a> {
    /// The frame `readings` and its `guide` as the device says that it lies, with the weights of its channels beside a mono sensor. Mixed
    /// evenly, channels that the sensor hardly sees would make the guide look like another scene.
    ///
    /// # Errors
    /// [`LengthError`] when there is no transform long enough.
    pub(super) fn new(
        device: &'a Device,
        readings: &Readings,
        (guide, weights): (Planes<'_>, Option<[f32; 3]>),
        workers: Arc<Workers>,
    ) -> Result<Self, LengthError> {
        let size = device.sensor.size;
        let bin = (size.width.min(size.height) / SIDE).max(1);
        let channel = device.sensor.channels / 2;
        let frame = Size::new(size.width / bin, size.height / bin);
        let Margin { columns, rows } = device.margin;
        let field = Field::new(frame, Margin { columns: columns / bin, rows: rows / bin });
        let reach = device.psf.reach();
        let longest = [reach.rows.0, reach.rows.1, reach.columns.0, reach.columns.1].into_iter().max().unwrap_or(0);
        let longest = (LARGEST * longest as f64 / bin as f64) as usize + 2;
        let reach = Reach { rows: (longest, longest), columns: (longest, longest) };
        let convolver = Convolver::new(field, reach, FftBackend::default(), workers)?;
        let mean = |plane: &[f32]| means(plane, size, bin);
        let weight = mean(readings.weight.plane(channel));
        let polarized = device.response.polarized();
        let part = |of: fn(&Complex32) -> f32| mean(&polarized.iter().map(of).collect::<Vec<_>>());
        let polarized = if device.response.is_polarized() {
            part(|e| e.re).into_iter().zip(part(|e| e.im)).map(|(re, im)| Complex32::new(re, im)).collect()
        } else {
            Vec::new()
        };
        Ok(Self {
            channel,
            bin,
            field,
            scratch: convolver.make_scratch(),
            convolver,
            readings: mean(readings.raw.plane(channel)),
            weight: weight.into_iter().map(|w| f32::from(u8::from(w > 0.99))).collect(),
            guide: place(device, (guide, weights.unwrap_or([1.0; 3])), channel, field, bin),
            declared: Response { unpolarized: mean(device.response.unpolarized()), polarized },
            device,
        })
    }

    /// Pixels of the sensor on a side of a pixel of the trial.
    pub(super) fn bin(&self) -> usize {
        self.bin
    }

    /// Mean of the trusted readings.
    pub(super) fn mean_reading(&self) -> f64 {
        let pairs = self.readings.iter().zip(&self.weight).map(|(y, w)| [f64::from(y * w), f64::from(*w)]);
        let [sum, count] = pairs.fold([0.0; 2], |[a, b], [y, w]| [a + y, b + w]);
        sum / count.max(1.0)
    }

    /// Size of the sensor's frames.
    pub(super) fn sensor_size(&self) -> Size {
        self.device.sensor.size
    }

    /// Angles of the mask.
    pub(super) fn angles(&self) -> &[Angle] {
        self.device.response.angles()
    }

    /// Pixels of the frame.
    pub(super) fn size(&self) -> Size {
        self.field.frame()
    }

    /// Whether masks can be told apart: binning leaves their modulation.
    pub(super) fn tells_masks(&self) -> bool {
        let mean = |e: &[Complex32]| e.iter().map(|e| e.norm()).sum::<f32>() / e.len().max(1) as f32;
        let polarized = self.device.response.polarized();
        !polarized.is_empty() && mean(&self.declared.polarized) > KEPT * mean(polarized)
    }

    /// The frame turned so. It must be square for turns that swap its sides.
    pub(super) fn turn_readings(&mut self, turn: Turn) {
        self.readings = turned(&self.readings, self.size(), turn);
        self.weight = turned(&self.weight, self.size(), turn);
    }

    /// Size of the guide: the frame's with its margin.
    pub(super) fn field_size(&self) -> Size {
        self.field.size()
    }

    /// The guide turned so. The field must be square for turns that swap its sides.
    pub(super) fn turn_guide(&mut self, turn: Turn) {
        self.guide = turned(&self.guide, self.field.size(), turn);
    }

    /// Moves the guide's content right and down.
    pub(super) fn shift_guide(&mut self, [right, down]: [isize; 2]) {
        let Size { width, height } = self.field.size();
        let at = |x: isize, y: isize| {
            let x = x.clamp(0, width as isize - 1) as usize;
            self.guide[y.clamp(0, height as isize - 1) as usize * width + x]
        };
        self.guide =
            (0..width * height).map(|i| at((i % width) as isize - right, (i / width) as isize - down)).collect();
    }

    /// The guide and its relatives behind the declared PSF after `change` of displacements, in pixels of the sensor.
    pub(super) fn blur(&mut self, change: impl Fn(f64, f64) -> (f64, f64)) -> Blurred {
        let (field, frame) = (self.field.size(), self.field.frame());
        let kernel = self.kernel(change);
        let Margin { columns, rows } = self.field.margin();
        let inside =
            |x: usize, y: usize| x >= columns && x < columns + frame.width && y >= rows && y < rows + frame.height;
        let guide = &self.guide;
        let of_frame = |x: usize, y: usize| if inside(x, y) { guide[y * field.width + x] } else { 0.0 };
        let value = |image: usize, x: usize, y: usize| match image {
            image if image < WAVES => {
                let (fx, fy) = (x as f32 - columns as f32, y as f32 - rows as f32);
                wave(image, fx, fy, frame) * of_frame(x, y)
            }
            WAVES => {
                0.5 * (guide[y * field.width + (x + 1).min(field.width - 1)] - guide[y * field.width + x.max(1) - 1])
            }
            image if image == WAVES + 1 => {
                0.5 * (guide[(y + 1).min(field.height - 1) * field.width + x] - guide[(y.max(1) - 1) * field.width + x])
            }
            _ => guide[y * field.width + x] - of_frame(x, y),
        };
        Blurred(behind(&kernel, &self.convolver, &mut self.scratch, IMAGES, value))
    }

    /// Smooth light from beyond the frame behind the declared PSF, on the frame: one image for each cosine; none where the scene ends at
    /// the frame.
    pub(super) fn light_from_beyond(&mut self) -> Vec<Vec<f32>> {
        if self.field.margin().is_none() {
            return Vec::new();
        }
        let kernel = self.kernel(|x, y| (x, y));
        let (size, field) = (self.field.size(), self.field);
        let value = |image: usize, x: usize, y: usize| {
            let shown = field.shown_columns(y).is_some_and(|columns| columns.contains(&x));
            if shown || image >= WAVES { 0.0 } else { wave(image, x as f32, y as f32, size) }
        };
        let mut images = behind(&kernel, &self.convolver, &mut self.scratch, WAVES.next_multiple_of(2), value);
        images.truncate(WAVES);
        images
    }

    fn kernel(&self, change: impl Fn(f64, f64) -> (f64, f64)) -> Kernel {
        let Size { width, height } = self.device.sensor.size;
        let side = 2 * (self.field.size().width.max(self.field.size().height)) + 1;
        let (samples, centre) = (self.device.psf.channel(self.channel), (side / 2) as f64);
        let mut out = vec![0.0f32; side * side];
        for (i, v) in samples.iter().enumerate().filter(|(_, v)| **v > 0.0) {
            let (dx, dy) = ((i % width) as f64 - (width / 2) as f64, (i / width) as f64 - (height / 2) as f64);
            let (dx, dy) = change(dx, dy);
            let (x, y) = (centre + dx / self.bin as f64, centre + dy / self.bin as f64);
            let (fx, fy) = ((x - x.floor()) as f32, (y - y.floor()) as f32);
            for (ox, oy, share) in
                [(0, 0, (1.0 - fx) * (1.0 - fy)), (1, 0, fx * (1.0 - fy)), (0, 1, (1.0 - fx) * fy), (1, 1, fx * fy)]
            {
                let (x, y) = (x.floor() as usize + ox, y.floor() as usize + oy);
                if x < side && y < side {
                    out[y * side + x] += share * v;
                }
            }
        }
        self.convolver.kernel(&out, Size::new(side, side))
    }

    /// Residual of the readings behind a mask.
    pub(super) fn rest(&self, Blurred(images): &Blurred, mask: &Response, stray: Stray<'_>) -> Rest {
        let (frame, n) = (self.size(), self.readings.len());
        let mut columns: Vec<Vec<f32>> = Vec::new();
        let mut add = |of: &dyn Fn(usize) -> f32| columns.push((0..n).map(|i| self.weight[i] * of(i)).collect());
        let wave_at = |k: usize, i: usize| wave(k, (i % frame.width) as f32, (i / frame.width) as f32, frame);
        if matches!(stray, Stray::ConstantAndBeyond(_)) {
            add(&|_| 1.0);
        }
        for image in [&images[0], &images[WAVES], &images[WAVES + 1], &images[WAVES + 2]] {
            add(&|i| mask.unpolarized[i] * image[i]);
        }
        if !mask.polarized.is_empty() {
            for image in &images[..WAVES] {
                add(&|i| mask.polarized[i].re * image[i]);
                add(&|i| mask.polarized[i].im * image[i]);
            }
        }
        let mut add_behind_mask = |of: &dyn Fn(usize) -> f32| {
            add(&|i| mask.unpolarized[i] * of(i));
            if !mask.polarized.is_empty() {
                add(&|i| mask.polarized[i].re * of(i));
                add(&|i| mask.polarized[i].im * of(i));
            }
        };
        match stray {
            Stray::Smooth => (0..WAVES).for_each(|k| add_behind_mask(&|i| wave_at(k, i))),
            Stray::Beyond(light) | Stray::ConstantAndBeyond(light) => {
                light.iter().for_each(|image| add_behind_mask(&|i| image[i]));
            }
        }
        let readings: Vec<f32> = self.readings.iter().zip(&self.weight).map(|(y, w)| y * w).collect();
        let found = least_squares(&columns, &readings);
        let mut rest: Vec<f64> = readings.iter().map(|y| f64::from(*y)).collect();
        for (column, factor) in columns.iter().zip(found.iter()) {
            rest.iter_mut().zip(column).for_each(|(rest, v)| *rest -= factor * f64::from(*v));
        }
        let count: f64 = self.weight.iter().map(|w| f64::from(*w)).sum();
        Rest {
            mean_square: rest.iter().map(|v| v * v).sum::<f64>() / count.max(1.0),
            constant: found.iter().next().copied().unwrap_or(0.0),
        }
    }

    /// Shift of the guide, right and down, at which its detail behind the PSF is most like the readings'.
    pub(super) fn shift(&self, Blurred(images): &Blurred) -> [isize; 2] {
        let frame = self.size();
        let Size { width, height } = frame;
        let most = (width.min(height) / SHIFTS) as isize;
        let readings: Vec<f32> =
            self.readings.iter().zip(&self.declared.unpolarized).map(|(y, m)| y / m.max(0.1)).collect();
        let (a, b) = (fine(&readings, frame), fine(&images[0], frame));
        let core = |n: usize| most as usize..n.saturating_sub(most as usize);
        let score = |right: isize, down: isize| {
            let product = |x: usize, y: usize| {
                let from = (y as isize - down) as usize * width + (x as isize - right) as usize;
                [a[y * width + x] * b[from], b[from] * b[from]]
            };
            let mut sums = [0.0f32; 2];
            for y in core(height) {
                for x in core(width) {
                    let [ab, bb] = product(x, y);
                    sums = [sums[0] + ab, sums[1] + bb];
                }
            }
            sums[0] / sums[1].max(f32::MIN_POSITIVE).sqrt()
        };
        let shifts = (-most..=most).flat_map(|down| (-most..=most).map(move |right| [right, down]));
        let scores = shifts.map(|shift| (score(shift[0], shift[1]), shift));
        scores.max_by(|a, b| a.0.total_cmp(&b.0)).map_or([0, 0], |(_, shift)| shift)
    }
}

impl Response {
    /// The mask with every pixel's response taken from another pixel.
    fn moved(&self, from: impl Fn(usize) -> usize) -> Self {
        let pick = |i: usize| from(i).min(self.unpolarized.len() - 1);
        Self {
            unpolarized: (0..self.unpolarized.len()).map(|i| self.unpolarized[pick(i)]).collect(),
            polarized: (0..self.polarized.len()).map(|i| self.polarized[pick(i)]).collect(),
        }
    }

    /// The mask turned so.
    pub(super) fn turned(&self, size: Size, turn: Turn) -> Self {
        self.moved(|i| turn.source(i, size))
    }

    /// The mask with stripes `factor` times as wide.
    pub(super) fn widened(&self, Size { width, .. }: Size, factor: f64) -> Self {
        self.moved(|i| i / width * width + (((i % width) as f64 + 0.5) / factor) as usize % width)
    }

    /// The mask whose polarizers of the angles `from` have the angles `to`; both as doubled angles' unit vectors.
    pub(super) fn relabelled(&self, from: &[Complex32], to: &[Complex32]) -> Self {
        let turn = |e: &Complex32| {
            let like = |a: &Complex32| (e * a.conj()).re;
            let at = (0..from.len()).max_by(|a, b| like(&from[*a]).total_cmp(&like(&from[*b])));
            at.map_or(*e, |p| e * from[p].conj() * to[p])
        };
        Self { unpolarized: self.unpolarized.clone(), polarized: self.polarized.iter().map(turn).collect() }
    }
}

/// `count` images behind a PSF, an even number, on the frame; `value` is that of an image at a pixel of the field.
fn behind(
    kernel: &Kernel,
    convolver: &Convolver,
    scratch: &mut Scratch,
    count: usize,
    value: impl Fn(usize, usize, usize) -> f32 + Sync,
) -> Vec<Vec<f32>> {
    let mut out = vec![Complex32::ZERO; convolver.size().pixels()];
    let mut images = vec![Vec::new(); count];
    for (pair, planes) in images.chunks_exact_mut(2).enumerate() {
        let load = |y: usize, line: &mut [Complex32]| {
            for (x, v) in line.iter_mut().enumerate() {
                *v = Complex32::new(value(2 * pair, x, y), value(2 * pair + 1, x, y));
            }
        };
        let store = |_: usize, line: &[Complex32], out: &mut [Complex32]| out.copy_from_slice(line);
        convolver.run(kernel, Direction::Forward, load, &mut out, store, scratch);
        let frame = convolver.field();
        let shown = out.chunks_exact(frame.size().width).enumerate();
        let shown = shown.filter_map(|(y, row)| frame.shown_columns(y).map(|columns| &row[columns]));
        (planes[0], planes[1]) = shown.flatten().map(|v| (v.re, v.im)).unzip();
    }
    images
}

/// A cosine of low frequency on the frame.
fn wave(k: usize, x: f32, y: f32, frame: Size) -> f32 {
    let along = |k: usize, at: f32, n: usize| (std::f32::consts::PI * k as f32 * (at + 0.5) / n as f32).cos();
    along(k % COSINES, x, frame.width) * along(k / COSINES, y, frame.height)
}

fn turned(image: &[f32], size: Size, turn: Turn) -> Vec<f32> {
    (0..image.len()).map(|i| image[turn.source(i, size)]).collect()
}

/// Means over blocks of `bin` × `bin` pixels.
fn means(plane: &[f32], size: Size, bin: usize) -> Vec<f32> {
    let (width, height) = (size.width / bin, size.height / bin);
    let mut out = vec![0.0; width * height];
    for (y, row) in plane.chunks_exact(size.width).take(height * bin).enumerate() {
        let out = &mut out[y / bin * width..][..width];
        out.iter_mut().zip(row.chunks_exact(bin)).for_each(|(sum, block)| *sum += block.iter().sum::<f32>());
    }
    let share = 1.0 / (bin * bin) as f32;
    out.iter_mut().for_each(|v| *v *= share);
    out
}

/// The guide on the trial's field, of mean one; zero where it sees nothing.
fn place(
    device: &Device,
    (guide, weights): (Planes<'_>, [f32; 3]),
    channel: usize,
    field: Field,
    bin: usize,
) -> Vec<f32> {
    let (size, content) = (field.size(), guide.size());
    let Margin { columns, rows } = field.margin();
    let mixed = guide.count() != device.sensor.channels;
    let planes = if mixed { 0..guide.count() } else { channel..channel + 1 };
    let weight = |c: usize| if mixed { weights[c] } else { 1.0 };
    let sample = |x: f64, y: f64| {
        let (x, y) = device.guide.apply(x, y);
        let sees = |v: f64, n: usize| (-0.5..=n as f64 - 0.5).contains(&v);
        if !sees(x, content.width) || !sees(y, content.height) {
            return 0.0;
        }
        let at = |v: f64, n: usize| (v.round().max(0.0) as usize).min(n - 1);
        let i = at(y, content.height) * content.width + at(x, content.width);
        let sum: f32 = planes.clone().map(|c| weight(c) * guide.plane(c)[i]).sum();
        if sum.is_finite() { sum.max(0.0) } else { 0.0 }
    };
    let pixel = |i: usize| {
        let first = |at: usize, margin: usize| (at as f64 - margin as f64) * bin as f64;
        let (x, y) = (first(i % size.width, columns), first(i / size.width, rows));
        (0..bin * bin).map(|k| sample(x + (k % bin) as f64, y + (k / bin) as f64)).sum::<f32>()
    };
    let mut out: Vec<f32> = (0..size.pixels()).map(pixel).collect();
    let mean = out.iter().map(|v| f64::from(*v)).sum::<f64>() / field.frame().pixels() as f64;
    let scale = if mean > 0.0 { (1.0 / mean) as f32 } else { 0.0 };
    out.iter_mut().for_each(|v| *v *= scale);
    out
}

/// An image less its mean over 7 × 7 pixels.
fn fine(image: &[f32], Size { width, height }: Size) -> Vec<f32> {
    const RADIUS: usize = 3;
    let span = |i: usize, n: usize| i.saturating_sub(RADIUS)..(i + RADIUS + 1).min(n);
    let pixel = |i: usize| {
        let (columns, rows) = (span(i % width, width), span(i / width, height));
        let count = columns.len() * rows.len();
        let sum: f32 = rows.map(|y| image[y * width..][columns.clone()].iter().sum::<f32>()).sum();
        image[i] - sum / count as f32
    };
    (0..image.len()).map(pixel).collect()
}

/// Factors of the columns that leave the least of `y`.
fn least_squares(columns: &[Vec<f32>], y: &[f32]) -> DVector<f64> {
    let count = columns.len();
    let lengths: Vec<f64> = columns.iter().map(|c| dot(c, c).sqrt().max(1e-30)).collect();
    let mut normal = DMatrix::<f64>::zeros(count, count);
    for i in 0..count {
        for j in 0..=i {
            normal[(i, j)] = dot(&columns[i], &columns[j]) / (lengths[i] * lengths[j]);
            normal[(j, i)] = normal[(i, j)];
        }
        normal[(i, i)] += 1e-6;
    }
    let right = DVector::from_iterator(count, columns.iter().zip(&lengths).map(|(c, length)| dot(c, y) / length));
    let mut found = normal.cholesky().map_or_else(|| DVector::zeros(count), |factor| factor.solve(&right));
    found.iter_mut().zip(&lengths).for_each(|(v, length)| *v /= length);
    found
}

/// Product in single precision over short runs, summed in double precision.
fn dot(a: &[f32], b: &[f32]) -> f64 {
    let run = |(a, b): (&[f32], &[f32])| {
        let mut sums = [0.0f32; 8];
        for (a, b) in a.chunks_exact(8).zip(b.chunks_exact(8)) {
            (0..8).for_each(|k| sums[k] += a[k] * b[k]);
        }
        let tail = a.len() / 8 * 8;
        let rest: f32 = a[tail..].iter().zip(&b[tail..]).map(|(a, b)| a * b).sum();
        f64::from(sums.iter().sum::<f32>() + rest)
    };
    a.chunks(512).zip(b.chunks(512)).map(run).sum()
}
