//! Cropping and binning: a camera's frame → means of blocks of readings, in one pass from the driver's memory.
//!
//! Rows of the frame are unpacked one at a time and added up in registers; a plane of the frame's size never exists. The largest and the
//! smallest reading of each block tell whether all of its readings can be trusted. Those of the few other blocks are looked at one by one.

use std::ops::Range;
use std::sync::Arc;

use fearless_simd::Level;

use super::UnpackError;
use super::lines::{FullScale, Layout, Lines};
use super::normalize::{LARGEST_FRACTION, Plateau};
use crate::device::{Device, Noise, Sensor};
use crate::frame::Frame;
use crate::image::{ImageView, MAX_BIN, OffScale, Size, Stack, Top, Unit, Window, common_step};
use crate::optics::lanes::vectorize;
use crate::parallel::{StridedMut, Workers};

/// Readings this many standard deviations from their block's mean are looked at …
const FAR: f32 = 6.0;
/// … if that is this share of full scale: less changes no mean by much.
const LEAST: f32 = 0.004;
/// A reading is defective that lies this many times as far from its neighbours as they do from theirs: optics show no point so sharp.
const ISOLATED: f32 = 4.0;
/// A pixel whose dark reading is above the median by this share of full scale is hot.
const HOT: f32 = 0.02;
/// A saturated reading with so many saturated neighbours is one of light, not of a defective pixel. The others of its block are those that
/// happen to be darker.
const LIT: usize = 2;
/// A block in saturated light has no mean when more than one of so many of its readings is saturated.
const FULL: usize = 3;

/// Rows of which the common divisor of the readings is taken.
const ROWS: usize = 16;

/// Readings of one block and plane, at most: of two green pixels in each cell of a Bayer mosaic.
const MOST: usize = 2 * MAX_BIN * MAX_BIN;

/// A frame at the working size.
#[derive(Clone, Debug, Default)]
pub struct Binned {
    /// Means of the trusted readings of each block, counts, `[C, H, W]`. Dark frames are subtracted and the black level is that of the
    /// device for all. A block without trusted readings is saturated.
    pub values: Stack<f32>,
    /// Share of the block's readings that are in the mean, `[C, H, W]`.
    pub weights: Stack<f32>,
    /// How the readings contradict the declared scale of counts.
    pub off_scale: Option<OffScale>,
}

impl Binned {
    /// The frame, to be processed; with weights where there is one for each value.
    pub fn view(&self) -> ImageView<'_> {
        let view = self.values.view().in_unit(Unit::Counts).found_off_scale(self.off_scale);
        view.weighted(self.weights.as_slice()).unwrap_or(view)
    }
}

/// Dark readings of a device.
#[derive(Debug)]
struct Dark {
    /// Readings of the camera's frame; none where the bundle has them at the working size only.
    full: Option<Arc<Stack<f32>>>,
    /// Counts above which a pixel is hot, for each plane.
    hot_above: Vec<f32>,
    /// Means of blocks.
    mean: Stack<f32>,
    /// Whether a block has a hot pixel, `[C, H, W]`.
    has_hot: Stack<bool>,
}

/// Crops and bins the frames of one device.
#[derive(Debug)]
pub struct Binning {
    window: Window,
    channels: usize,
    black_level: f32,
    saturation: f32,
    /// Noise of one reading, in counts: variance in the dark, and for each count of signal.
    variance: [f32; 2],
    dark: Option<Dark>,
    level: Level,
    workers: Arc<Workers>,
    /// Buffers of each thread.
    scratch: Vec<Vec<f32>>,
    /// Largest reading of each block, `[C, H, W]`.
    highest: Stack<f32>,
}

impl Binning {
    /// Binning for the frames of `device`, by the threads of `workers`; none where all of a frame's readings are used one by one.
    /// Allocates.
    pub fn new(device: &Device, workers: Arc<Workers>) -> Option<Self> {
        let readings = device.sensor.window.readings() as f32;
        let noise = Noise { read: device.noise.read * readings.sqrt(), shot: device.noise.shot * readings };
        Self::of_sensor(device.sensor, noise, device.dark.clone(), workers)
    }

    /// Binning for the frames of a sensor with its dark frame, if it has one. `noise` is that of one reading of the camera. Otherwise as
    /// [`Self::new`].
    pub fn of_sensor(
        sensor: Sensor,
        noise: Noise,
        dark: Option<Arc<Stack<f32>>>,
        workers: Arc<Workers>,
    ) -> Option<Self> {
        let window = sensor.window;
        if window.is_whole() {
            return None;
        }
        let span = sensor.saturation - sensor.black_level;
        let columns = window.size().width;
        // a line of up to three samples a pixel, then sums, largest and smallest of the columns of each plane
        let buffer = vec![0.0; columns * (3 + 3 * sensor.channels)];
        Some(Self {
            window,
            channels: sensor.channels,
            black_level: sensor.black_level,
            saturation: sensor.saturation,
            variance: [(noise.read * span).powi(2), noise.shot * span],
            dark: dark.map(|dark| Dark::new(dark, &window, sensor.channels, HOT * span)),
            level: Level::new(),
            scratch: vec![buffer; workers.threads()],
            highest: Stack::zeros(sensor.channels, window.working()),
            workers,
        })
    }

    /// The part of the frame that is used.
    pub fn window(&self) -> &Window {
        &self.window
    }

    /// Bytes held, the dark frame not among them: the device shares it.
    pub fn bytes(&self) -> usize {
        let scratch: usize = self.scratch.iter().map(Vec::len).sum();
        let dark = self.dark.as_ref().map_or(0, |dark| dark.mean.bytes() + dark.has_hot.bytes());
        scratch * size_of::<f32>() + dark + self.highest.bytes()
    }

    /// Planes and weights of the working size. Allocates.
    pub fn make_output(&self) -> Binned {
        let zeros = || Stack::zeros(self.channels, self.window.working());
        Binned { values: zeros(), weights: zeros(), off_scale: None }
    }

    /// Bins a frame of the camera, whose samples are counts, or fractions of full scale if they are of floating point. Allocates nothing
    /// when `out` comes from [`Self::make_output`].
    ///
    /// # Errors
    /// [`UnpackError`] when the frame's planes are not those of the device.
    pub fn frame(&mut self, frame: &Frame<'_>, out: &mut Binned) -> Result<(), UnpackError> {
        let (format, size) = (frame.format(), frame.size());
        let expected = (self.channels, self.window.frame());
        if (format.planes(), format.plane_size(size)) != expected {
            return Err(UnpackError { format, size, found: expected.0, found_size: expected.1 });
        }
        match format.bits() {
            Some(_) => self.counts(frame, out),
            None => self.full_scale(frame, out),
        }
        Ok(())
    }

    /// Bins an image of the camera's planes. Allocates nothing when `out` comes from [`Self::make_output`].
    ///
    /// # Panics
    /// When the image's planes are not those of the device.
    pub fn image(&mut self, view: &ImageView<'_>, out: &mut Binned) {
        assert_eq!((view.planes(), view.size()), (self.channels, self.window.frame()), "planes of another shape");
        match view.unit() {
            Unit::Counts => self.counts(view, out),
            Unit::FullScale => self.full_scale(view, out),
        }
    }

    /// Bins lines of fractions of full scale, whose saturation shows as a plateau.
    fn full_scale<L: Lines>(&mut self, lines: &L, out: &mut Binned) {
        let (black, span) = (self.black_level, self.saturation - self.black_level);
        let (layout, [x, top]) = (lines.layout(), self.window.first());
        let line = &mut self.scratch[0][..layout.samples * self.window.size().width];
        let mut plateau = Plateau::default();
        for y in top..top + self.window.size().height {
            for l in 0..layout.lines {
                lines.read(y, l, x, line);
                line.iter().for_each(|v| plateau.add(*v));
            }
        }
        let source = FullScale { lines, span, black };
        self.run(&source, plateau.level() * span + black, out);
        let largest = plateau.largest();
        out.off_scale = (largest > LARGEST_FRACTION).then_some(OffScale::Counts { largest });
    }

    /// Bins lines of counts. Where they are clipped below the declared saturation, blocks of clipped readings are looked at once more.
    fn counts<L: Lines>(&mut self, lines: &L, out: &mut Binned) {
        self.run(lines, self.saturation, out);
        out.off_scale = None;
        let step = self.step(lines);
        for c in 0..self.channels {
            let highest = self.highest.plane(c);
            let largest = highest.iter().copied().fold(f32::NEG_INFINITY, f32::max);
            let least = out.values.plane(c).iter().copied().fold(f32::INFINITY, f32::min);
            let clipped = self.clipped(lines, c, Top::new(least, largest, step).filter(|_| largest < self.saturation));
            if let Some(level) = clipped {
                for block in (0..highest.len()).filter(|block| highest[*block] >= level) {
                    let (value, weight) = self.careful(lines, level, c, block);
                    (out.values.plane_mut(c)[block], out.weights.plane_mut(c)[block]) = (value, weight);
                }
            }
            let saturation = self.saturation;
            let found = clipped.map(|level| OffScale::Clipped { level, saturation });
            let found = found.or_else(|| OffScale::of_samples(step, largest, largest - least, saturation));
            out.off_scale = out.off_scale.or(found);
        }
    }

    /// The level at which the readings of plane `c` are clipped, whose largest ones `top` counts.
    fn clipped<L: Lines>(&self, lines: &L, c: usize, top: Option<Top>) -> Option<f32> {
        let (mut top, layout, width) = (top?, lines.layout(), self.window.frame().width);
        let lowest = top.lowest();
        let near = |(_, highest): &(usize, &f32)| **highest >= lowest;
        for (block, _) in self.highest.plane(c).iter().enumerate().filter(near) {
            for sample in (0..layout.lines * layout.samples).filter(|k| layout.planes[*k] == c) {
                for (x, y) in self.window.block(block).map(|at| (at % width, at / width)) {
                    top.add(lines.sample(y, sample / layout.samples, x, sample % layout.samples));
                }
            }
        }
        top.clipped()
    }

    /// A number that the readings of some rows are multiples of.
    fn step<L: Lines>(&mut self, lines: &L) -> u32 {
        let (layout, [x, top], Size { width, height }) = (lines.layout(), self.window.first(), self.window.size());
        let line = &mut self.scratch[0][..layout.samples * width];
        let mut step = 0;
        for y in (top..top + height).step_by(height.div_ceil(ROWS)) {
            if step != 1 {
                lines.read(y, 0, x, line);
                step = common_step(line.iter().copied(), step);
            }
        }
        step
    }

    fn run<L: Lines>(&mut self, source: &L, limit: f32, out: &mut Binned) {
        let Size { height, .. } = self.window.working();
        let shape = (self.channels, self.window.working());
        for stack in [&mut out.values, &mut out.weights] {
            if (stack.count(), stack.size()) != shape {
                *stack = Stack::zeros(shape.0, shape.1);
            }
        }
        let mut scratch = std::mem::take(&mut self.scratch);
        let mut highest = std::mem::take(&mut self.highest);
        let plan = &*self;
        let workers = &plan.workers;
        let values = workers.strided_bands_mut(out.values.as_mut_slice(), self.channels, height);
        let weights = workers.strided_bands_mut(out.weights.as_mut_slice(), self.channels, height);
        let highs = workers.strided_bands_mut(highest.as_mut_slice(), self.channels, height);
        let buffers = workers.each_mut(&mut scratch);
        workers.run(workers.threads(), &|task| {
            let (rows, scratch) = (workers.band(task, height), buffers.take(task).as_mut_slice());
            let [values, weights, highs] = &mut [&values, &weights, &highs].map(|bands| bands.take(task));
            vectorize!(plan.level, _s => plan.band(source, limit, rows.clone(), [&mut *values, &mut *weights, &mut *highs], &mut *scratch));
        });
        (self.scratch, self.highest) = (scratch, highest);
    }

    /// Bins the rows `rows` of blocks.
    #[inline(always)]
    fn band<L: Lines>(
        &self,
        source: &L,
        limit: f32,
        rows: Range<usize>,
        [values, weights, highs]: [&mut StridedMut<'_, f32>; 3],
        scratch: &mut [f32],
    ) {
        let (columns, bin, [x, top]) = (self.window.size().width, self.window.bin(), self.window.first());
        let (across, layout, [every, every_row]) = (self.window.working().width, source.layout(), self.window.cell());
        let (line, columns_of_planes) = scratch.split_at_mut(3 * columns);
        let line = &mut line[..layout.samples * columns];
        for (k, row) in rows.enumerate() {
            for planes in columns_of_planes.chunks_exact_mut(3 * columns) {
                let [sum, high, low] = thirds(planes);
                sum.fill(0.0);
                high.fill(f32::NEG_INFINITY);
                low.fill(f32::INFINITY);
            }
            for y in (top + row * bin + row % every_row..top + (row + 1) * bin).step_by(every_row) {
                for l in 0..layout.lines {
                    source.read(y, l, x, line);
                    for s in 0..layout.samples {
                        let plane = layout.planes[l * layout.samples + s];
                        let to = thirds(&mut columns_of_planes[plane * 3 * columns..][..3 * columns]);
                        match layout.samples {
                            1 => add::<1>(line, s, to),
                            2 => add::<2>(line, s, to),
                            _ => add::<3>(line, s, to),
                        }
                    }
                }
            }
            for (c, planes) in columns_of_planes.chunks_exact_mut(3 * columns).enumerate() {
                let values = &mut values.group_mut(c)[k * across..][..across];
                let weights = &mut weights.group_mut(c)[k * across..][..across];
                let highs = &mut highs.group_mut(c)[k * across..][..across];
                let mut from = thirds(planes);
                if every > 1 {
                    from = from.map(|line| pick(line, bin, every));
                }
                match bin / every {
                    1 => self.blocks(1, layout, limit, (c, row), from, [values, weights, highs]),
                    2 => self.blocks(2, layout, limit, (c, row), from, [values, weights, highs]),
                    4 => self.blocks(4, layout, limit, (c, row), from, [values, weights, highs]),
                    n => self.blocks(n, layout, limit, (c, row), from, [values, weights, highs]),
                }
                for x in 0..across {
                    if weights[x] < 0.0 {
                        (values[x], weights[x]) = self.careful(source, limit, c, row * across + x);
                    }
                }
            }
        }
    }

    /// Joins `together` columns to means of blocks; gives those a weight of −1 whose readings have to be looked at.
    #[inline(always)]
    fn blocks(
        &self,
        together: usize,
        layout: Layout,
        limit: f32,
        (c, row): (usize, usize),
        [sum, high, low]: [&mut [f32]; 3],
        [values, weights, highs]: [&mut [f32]; 3],
    ) {
        let share = 1.0 / (self.window.readings() * layout.of(c)) as f32;
        let columns = sum.chunks_exact(together).zip(high.chunks_exact(together).zip(low.chunks_exact(together)));
        let outputs = values.iter_mut().zip(&mut *weights).zip(highs);
        for (((value, weight), highest), (sum, (high, low))) in outputs.zip(columns) {
            let mean = sum.iter().sum::<f32>() * share;
            let high = high.iter().fold(f32::NEG_INFINITY, |a, b| if *b > a { *b } else { a });
            let low = low.iter().fold(f32::INFINITY, |a, b| if *b < a { *b } else { a });
            let (above, below) = (high - mean, mean - low);
            let far = if above > below { above } else { below };
            let fine = high < limit && far * far <= self.tolerance(mean);
            *value = mean;
            *highest = high;
            *weight = if fine { 1.0 } else { -1.0 };
        }
        let across = values.len();
        if let Some(dark) = &self.dark {
            let range = row * across..(row + 1) * across;
            let black = self.black_level;
            values.iter_mut().zip(&dark.mean.plane(c)[range.clone()]).for_each(|(v, dark)| *v -= dark - black);
            let hot = &dark.has_hot.plane(c)[range];
            weights.iter_mut().zip(hot).for_each(|(w, hot)| *w = if *hot { -1.0 } else { *w });
        }
    }

    /// Square of the distance from `level` within which readings of a block lie, in counts.
    #[inline(always)]
    fn tolerance(&self, level: f32) -> f32 {
        let [dark, shot] = self.variance;
        let signal = if level > self.black_level { level - self.black_level } else { 0.0 };
        let least = LEAST * (self.saturation - self.black_level);
        let square = FAR * FAR * (dark + shot * signal);
        if square > least * least { square } else { least * least }
    }

    /// Mean and weight of a block, each of whose readings is looked at.
    #[inline(never)]
    fn careful<L: Lines>(&self, source: &L, limit: f32, c: usize, block: usize) -> (f32, f32) {
        let (layout, width) = (source.layout(), self.window.frame().width);
        let total = self.window.readings() * layout.of(c);
        let (mut saturated, mut lit) = (0, false);
        let mut kept: heapless::Vec<Reading, MOST> = heapless::Vec::new();
        for sample in (0..layout.lines * layout.samples).filter(|k| layout.planes[*k] == c) {
            let full = |(x, y)| source.sample(y, sample / layout.samples, x, sample % layout.samples) >= limit;
            for at in self.window.block(block).map(|at| (at % width, at / width)) {
                if full(at) {
                    saturated += 1;
                    lit = lit || self.neighbours(at).into_iter().flatten().filter(|at| full(*at)).count() >= LIT;
                } else if let Some(value) = self.trusted(source, limit, (c, sample), at) {
                    let pushed = kept.push(Reading { value, sample, at });
                    debug_assert!(pushed.is_ok(), "a block has {MOST} readings at most");
                }
            }
            if lit && FULL * saturated > total {
                break;
            }
        }
        if self.window.bin() > 1 && kept.len() > 2 {
            self.reject(source, limit, c, &mut kept);
        }
        let mean = mean(&kept) + self.black_level;
        // noise lifts some readings of light near saturation above it
        let bright = saturated > 0 && (mean >= limit || (limit - mean).powi(2) < self.tolerance(mean));
        let mean = if lit || bright { self.trimmed(limit, &mut kept, saturated, total) } else { Some(mean) };
        match mean.filter(|_| !kept.is_empty()) {
            Some(mean) => (mean, kept.len() as f32 / total as f32),
            None => (self.saturation, 0.0),
        }
    }

    /// The mean of a block in light that saturates some of its readings: as many of its darkest are removed, so that the mean of the others
    /// is that of even light. None when the light is not even or too few are left.
    fn trimmed(
        &self,
        limit: f32,
        kept: &mut heapless::Vec<Reading, MOST>,
        saturated: usize,
        total: usize,
    ) -> Option<f32> {
        kept.sort_unstable_by(|a, b| b.value.total_cmp(&a.value));
        let darkest = kept.last()?.value + self.black_level;
        let left = kept.len().checked_sub(saturated).filter(|_| FULL * saturated <= total)?;
        kept.truncate(left);
        let even = (limit - darkest).powi(2) <= self.tolerance(limit);
        even.then(|| mean(kept) + self.black_level)
    }

    /// The nearest pixels left, right, above and below a pixel behind a like polarizer, as far as they lie in the frame.
    fn neighbours(&self, (x, y): (usize, usize)) -> [Option<(usize, usize)>; 4] {
        let [w, h] = self.window.cell().map(usize::cast_signed);
        [(-w, 0), (w, 0), (0, -h), (0, h)].map(|step| self.beside((x, y), step))
    }

    /// The pixel some steps right and down of another, if it lies in the frame.
    fn beside(&self, (x, y): (usize, usize), (dx, dy): (isize, isize)) -> Option<(usize, usize)> {
        let Size { width, height } = self.window.frame();
        let at = (x.checked_add_signed(dx)?, y.checked_add_signed(dy)?);
        (at.0 < width && at.1 < height).then_some(at)
    }

    /// Removes isolated readings far from the others of their block.
    fn reject<L: Lines>(&self, source: &L, limit: f32, c: usize, kept: &mut heapless::Vec<Reading, MOST>) {
        let mut values: heapless::Vec<f32, MOST> = kept.iter().map(|reading| reading.value).collect();
        let middle = values.len() / 2;
        let median = *values.select_nth_unstable_by(middle, f32::total_cmp).1;
        let far = self.tolerance(median + self.black_level).sqrt();
        let isolated = |reading: &Reading| {
            if (reading.value - median).abs() <= far {
                return false;
            }
            let trusted = |at| self.trusted(source, limit, (c, reading.sample), at);
            let around = self.neighbours(reading.at);
            let mut ring: heapless::Vec<f32, 4> = around.into_iter().flatten().filter_map(trusted).collect();
            if ring.len() < 2 {
                return false;
            }
            ring.sort_unstable_by(f32::total_cmp);
            // one neighbour of four may be defective as well, and another one not trusted
            let spared = usize::from(ring.len() > 2 && around.iter().all(Option::is_some));
            let (low, high) = (ring[spared], ring[ring.len() - 1 - spared]);
            let far_rows = 2 * self.window.cell()[1].cast_signed();
            let beyond =
                [-far_rows, far_rows].into_iter().filter_map(|dy| self.beside(reading.at, (0, dy)).and_then(trusted));
            let all = || beyond.clone().chain([low, high]);
            let (above, below) = (reading.value - high, low - reading.value);
            let (off, spread) = if above > below {
                (above, high - all().fold(f32::INFINITY, f32::min))
            } else {
                (below, all().fold(f32::NEG_INFINITY, f32::max) - low)
            };
            off > far && off > ISOLATED * spread
        };
        kept.retain(|reading| !isolated(reading));
    }

    /// A reading above the dark frame in counts; none if it is saturated, no number or of a hot pixel.
    fn trusted<L: Lines>(
        &self,
        source: &L,
        limit: f32,
        (c, sample): (usize, usize),
        (x, y): (usize, usize),
    ) -> Option<f32> {
        let samples = source.layout().samples;
        let value = source.sample(y, sample / samples, x, sample % samples);
        if !(value.is_finite() && value < limit) {
            return None;
        }
        let dark = match &self.dark {
            None => self.black_level,
            Some(dark) => dark.at(c, (x, y), &self.window)?,
        };
        Some(value - dark)
    }
}

/// One reading of a block.
#[derive(Clone, Copy, Debug)]
struct Reading {
    /// Counts above the dark frame.
    value: f32,
    /// Number of its sample among those of a pixel.
    sample: usize,
    /// Column and row.
    at: (usize, usize),
}

impl Dark {
    fn new(dark: Arc<Stack<f32>>, window: &Window, channels: usize, hot: f32) -> Self {
        let plane = |c: usize| dark.plane(c.min(dark.count() - 1));
        let (working, is_full) = (window.working(), dark.size() == window.frame());
        let hot_above: Vec<f32> = (0..channels)
            .map(|c| {
                let mut values = plane(c).to_vec();
                let middle = values.len() / 2;
                *values.select_nth_unstable_by(middle, f32::total_cmp).1 + hot
            })
            .collect();
        let means = if is_full { window.means(&dark) } else { Stack::clone(&dark) };
        let (mut mean, mut has_hot) = (Stack::zeros(channels, working), Stack::zeros(channels, working));
        for (c, hot_above) in hot_above.iter().enumerate() {
            mean.plane_mut(c).copy_from_slice(means.plane(c.min(means.count() - 1)));
            for (block, has_hot) in has_hot.plane_mut(c).iter_mut().enumerate().filter(|_| is_full) {
                *has_hot = window.block(block).any(|at| plane(c)[at] > *hot_above);
            }
        }
        Self { full: is_full.then_some(dark), hot_above, mean, has_hot }
    }

    /// Dark reading of a pixel; none if it is hot.
    fn at(&self, c: usize, (x, y): (usize, usize), window: &Window) -> Option<f32> {
        let Some(full) = &self.full else {
            // pixels beyond the window have the dark reading of the nearest block
            let [left, top] = window.first();
            let Size { width, height } = window.working();
            let block =
                |at: usize, first: usize, count: usize| (at.saturating_sub(first) / window.bin()).min(count - 1);
            return Some(self.mean.plane(c)[block(y, top, height) * width + block(x, left, width)]);
        };
        let dark = full.plane(c.min(full.count() - 1))[y * window.frame().width + x];
        (dark <= self.hot_above[c]).then_some(dark)
    }
}

/// Mean of some readings; no number without any.
fn mean(readings: &[Reading]) -> f32 {
    readings.iter().map(|reading| reading.value).sum::<f32>() / readings.len() as f32
}

/// Moves every `every`th of the `bin` columns of each block together, in block X from its column X mod `every`; returns them.
fn pick(line: &mut [f32], bin: usize, every: usize) -> &mut [f32] {
    let (blocks, each) = (line.len() / bin, bin / every);
    for (block, k) in (0..blocks).flat_map(|block| (0..each).map(move |k| (block, k))) {
        line[block * each + k] = line[block * bin + block % every + k * every];
    }
    &mut line[..blocks * each]
}

/// Sums, largest and smallest readings of the columns of a plane.
#[inline(always)]
fn thirds(planes: &mut [f32]) -> [&mut [f32]; 3] {
    let columns = planes.len() / 3;
    let (sum, rest) = planes.split_at_mut(columns);
    let (high, low) = rest.split_at_mut(columns);
    [sum, high, low]
}

/// Adds sample `s` of each `S` samples of a line to the columns.
#[inline(always)]
fn add<const S: usize>(line: &[f32], s: usize, [sum, high, low]: [&mut [f32]; 3]) {
    for (((sum, high), low), v) in sum.iter_mut().zip(high).zip(low).zip(line.as_chunks::<S>().0) {
        let v = v[s];
        *sum += v;
        // a value that is no number shows in the sum
        *high = if v > *high { v } else { *high };
        *low = if v < *low { v } else { *low };
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use rand::{Rng, SeedableRng, rngs::StdRng};

    use super::*;
    use crate::frame::{Bayer, Metadata, PixelFormat, Samples};
    use crate::image::noise::normal;
    use crate::optics::{Mask, Mosaic};

    /// A device without a mask whose frames have planes of size `frame`.
    fn device(frame: Size, channels: usize, first: [usize; 2], size: Size, bin: usize, read: f32) -> Device {
        let working = Size::new(size.width / bin, size.height / bin);
        let mut psf = Stack::zeros(1, working);
        psf.plane_mut(0)[working.height / 2 * working.width + working.width / 2] = 1.0;
        let device = Device::builder(frame).crop(first, size).bin(bin).channels(channels).psf(psf);
        device.noise(read, 0.0).levels(64.0, 4000.0).build().unwrap()
    }

    fn binning(device: &Device, threads: usize) -> Binning {
        Binning::new(device, Arc::new(Workers::new(threads))).unwrap()
    }

    /// Bytes of a row of samples.
    fn packed(samples: Samples, row: &[u16]) -> Vec<u8> {
        let at = |i: usize| row.get(i).copied().unwrap_or(0);
        match samples {
            Samples::U8 => row.iter().map(|v| *v as u8).collect(),
            Samples::U10 | Samples::U12 | Samples::U16 => row.iter().flat_map(|v| v.to_le_bytes()).collect(),
            Samples::F32 => row.iter().flat_map(|v| ((f32::from(*v) - 64.0) / 3936.0).to_ne_bytes()).collect(),
            Samples::Packed10 => (0..row.len().div_ceil(4))
                .flat_map(|g| {
                    let four = [0, 1, 2, 3].map(|k| at(4 * g + k));
                    let low = four.iter().enumerate().fold(0, |low, (k, v)| low | ((v & 3) as u8) << (2 * k));
                    [(four[0] >> 2) as u8, (four[1] >> 2) as u8, (four[2] >> 2) as u8, (four[3] >> 2) as u8, low]
                })
                .collect(),
            Samples::Packed12 => (0..row.len().div_ceil(2))
                .flat_map(|g| {
                    let [a, b] = [at(2 * g), at(2 * g + 1)];
                    [(a >> 4) as u8, (b >> 4) as u8, (a & 15) as u8 | ((b & 15) as u8) << 4]
                })
                .collect(),
        }
    }

    const ALL: [Samples; 7] =
        [Samples::U8, Samples::U10, Samples::U12, Samples::U16, Samples::Packed10, Samples::Packed12, Samples::F32];
    const MOSAICS: [Bayer; 4] = [Bayer::Rggb, Bayer::Bggr, Bayer::Grbg, Bayer::Gbrg];

    /// Largest count that fits samples and stays below the saturation of [`device`].
    fn largest(samples: Samples) -> u16 {
        samples.bits().map_or(3999, |bits| ((1u32 << bits) - 1).min(3999) as u16)
    }

    /// A frame's bytes, padded by `padding` for each row, and its samples.
    fn frame_of(format: PixelFormat, size: Size, padding: usize, seed: u64) -> (Vec<u8>, usize, Vec<Vec<u16>>) {
        let (samples, each) = match format {
            PixelFormat::Rgb(samples) => (samples, 3),
            PixelFormat::Mono(samples) | PixelFormat::Bayer(_, samples) => (samples, 1),
            _ => panic!("not made here"),
        };
        let mut rng = StdRng::seed_from_u64(seed);
        let rows: Vec<Vec<u16>> = (0..size.height)
            .map(|_| (0..size.width * each).map(|_| rng.random_range(0..=largest(samples))).collect())
            .collect();
        let stride = format.row_bytes(size.width) + padding;
        let mut data = Vec::new();
        for row in &rows {
            let mut bytes = packed(samples, row);
            bytes.resize(stride, 0xEE);
            data.extend(bytes);
        }
        (data, stride, rows)
    }

    /// Samples of plane `c` at pixel (x, y).
    fn readings(format: PixelFormat, rows: &[Vec<u16>], c: usize, (x, y): (usize, usize)) -> Vec<u16> {
        match format {
            PixelFormat::Rgb(_) => vec![rows[y][3 * x + c]],
            PixelFormat::Bayer(order, _) => {
                let of = |k: usize| rows[2 * y + k / 2][2 * x + k % 2];
                let red = order.red();
                match c {
                    0 => vec![of(red)],
                    1 => vec![of(red ^ 1), of(red ^ 2)],
                    _ => vec![of(red ^ 3)],
                }
            }
            _ => vec![rows[y][x]],
        }
    }

    proptest! {
        #[test]
        fn every_layout_gives_the_means_of_its_blocks(
            samples in 0..ALL.len(),
            color in 0..6usize,
            bin in 1..=5usize,
            (left, top) in (0..5usize, 0..5usize),
            (right, bottom) in (0..6usize, 0..6usize),
            (across, down) in (1..9usize, 1..5usize),
            padding in 0..9usize,
            threads in 1..4usize,
            seed in 0..u64::MAX,
        ) {
            let samples = ALL[samples];
            let format = match color {
                0 => PixelFormat::Mono(samples),
                1 => PixelFormat::Rgb(samples),
                k => PixelFormat::Bayer(MOSAICS[k - 2], samples),
            };
            let crop = Size::new(across * bin, down * bin);
            let planes = Size::new(left + crop.width + right, top + crop.height + bottom);
            prop_assume!((crop, bin) != (planes, 1));
            let cell = if color > 1 { 2 } else { 1 };
            // an odd last row and column belong to no cell
            let size = Size::new(planes.width * cell + right % cell, planes.height * cell + bottom % cell);
            let (data, stride, rows) = frame_of(format, size, padding, seed);
            let frame = Frame::new(&data, format, size, stride, Metadata::default()).unwrap();
            // so much noise that no reading is far
            let device = device(planes, format.planes(), [left, top], crop, bin, 1.0);
            let mut out = Binned::default();
            binning(&device, threads).frame(&frame, &mut out).unwrap();
            prop_assert!(out.weights.as_slice().iter().all(|w| *w == 1.0));
            for c in 0..format.planes() {
                for (i, found) in out.values.plane(c).iter().enumerate() {
                    let (x, y) = (left + i % across * bin, top + i / across * bin);
                    let block: Vec<u16> = (0..bin * bin)
                        .flat_map(|k| readings(format, &rows, c, (x + k % bin, y + k / bin)))
                        .collect();
                    let mean = block.iter().map(|v| f64::from(*v)).sum::<f64>() / block.len() as f64;
                    prop_assert!((f64::from(*found) - mean).abs() < 2e-3, "{} {}: {} {}", c, i, found, mean);
                }
            }
        }

        #[test]
        fn images_of_files_are_binned_like_frames(bin in 1..=4usize, three in any::<bool>(), seed in 0..u64::MAX) {
            let planes = Size::new(5 * bin + 3, 3 * bin + 1);
            let channels = if three { 3 } else { 1 };
            let device = device(planes, channels, [2, 1], Size::new(5 * bin, 3 * bin), bin, 1.0);
            let format = if three { PixelFormat::Rgb(Samples::U16) } else { PixelFormat::Mono(Samples::U16) };
            let (data, stride, rows) = frame_of(format, planes, 0, seed);
            let (mut binning, mut expected) = (binning(&device, 1), Binned::default());
            binning.frame(&Frame::new(&data, format, planes, stride, Metadata::default()).unwrap(), &mut expected).unwrap();
            let interleaved: Vec<u16> = rows.concat();
            let view = ImageView::interleaved(&interleaved, channels, planes).unwrap();
            let fractions: Vec<f64> = interleaved.iter().map(|v| (f64::from(*v) - 64.0) / 3936.0).collect();
            let floats = ImageView::interleaved(&fractions, channels, planes).unwrap();
            for (view, tolerance) in [(view, 0.0), (floats, 2e-3)] {
                let mut out = Binned::default();
                binning.image(&view, &mut out);
                let pairs = out.values.as_slice().iter().zip(expected.values.as_slice());
                prop_assert!(pairs.clone().all(|(a, b)| (a - b).abs() <= tolerance), "{:?}", pairs.collect::<Vec<_>>());
            }
        }
    }

    const PLANES: Size = Size::new(96, 80);

    /// A ramp with noise of 8 counts, and its levels.
    fn ramp(seed: u32) -> (Vec<f32>, impl Fn(usize, usize) -> f32) {
        let level = |x: usize, y: usize| 500.0 + 6.0 * x as f32 + 3.0 * y as f32;
        let noise = normal(PLANES.pixels(), 8.0, seed);
        (noise.iter().enumerate().map(|(i, v)| (v + level(i % 96, i / 96)).round()).collect(), level)
    }

    fn image(device: &Device, values: &[f32]) -> Binned {
        let counts: Vec<u16> = values.iter().map(|v| *v as u16).collect();
        let mut out = Binned::default();
        binning(device, 2).image(&ImageView::planar(&counts, 1, PLANES).unwrap(), &mut out);
        out
    }

    #[test]
    fn hot_dead_and_saturated_readings_are_left_out_of_their_block() {
        for bin in [2, 4] {
            let device = device(PLANES, 1, [0, 0], PLANES, bin, 8.0 / 3936.0);
            let (mut values, level) = ramp(7);
            let mut rng = StdRng::seed_from_u64(3);
            let mut bad = vec![false; values.len()];
            for (v, bad) in values.iter_mut().zip(&mut bad) {
                let (kind, excess) = (rng.random_range(0.0..1.0), rng.random_range(400.0..2000.0));
                *bad = kind < 0.05;
                *v = if kind < 0.02 {
                    4095.0
                } else if kind < 0.04 {
                    (*v + excess).round()
                } else if *bad {
                    0.0
                } else {
                    *v
                };
            }
            let out = image(&device, &values);
            let (mut missed, mut lost, mut squares) = (0, 0, 0.0);
            for (i, (value, weight)) in out.values.as_slice().iter().zip(out.weights.as_slice()).enumerate() {
                let block: Vec<usize> = device.sensor.window.block(i).collect();
                let good = block.iter().filter(|at| !bad[**at]).count() as f32 / block.len() as f32;
                missed += usize::from((weight - good).abs() > 1e-6);
                lost += usize::from(*weight == 0.0);
                let truth = block.iter().map(|at| level(at % 96, at / 96)).sum::<f32>() / block.len() as f32;
                // the ramp itself moves the mean of fewer readings
                squares += if *weight > 0.0 && (weight - good).abs() < 1e-6 { (value - truth).powi(2) } else { 0.0 };
            }
            let blocks = out.values.size().pixels();
            assert!(missed < blocks / 50 && lost < blocks / 50, "bin {bin}: {missed} missed, {lost} lost of {blocks}");
            let rms = (squares / blocks as f32).sqrt();
            assert!(rms < 1.3 * 8.0 / bin as f32, "bin {bin}: {rms} counts");
        }
    }

    #[test]
    fn hot_readings_beside_saturated_ones_are_left_out() {
        let device = device(PLANES, 1, [0, 0], PLANES, 4, 8.0 / 3936.0);
        let (mut values, _) = ramp(7);
        let mut rng = StdRng::seed_from_u64(5);
        let bad: Vec<bool> = (0..values.len())
            .map(|i| {
                let (hot, excess) = (rng.random_bool(0.03), rng.random_range(400.0..1000.0));
                // no two saturated ones side by side, as in bright light
                let full = i % 96 % 3 == 0 && i / 96 % 3 == 0;
                values[i] = if full { 4095.0 } else { (values[i] + if hot { excess } else { 0.0 }).round() };
                full || hot
            })
            .collect();
        let out = image(&device, &values);
        let missed = out.weights.as_slice().iter().enumerate().filter(|(i, weight)| {
            let good = device.sensor.window.block(*i).filter(|at| !bad[*at]).count();
            (16.0 * **weight - good as f32).abs() > 1e-3
        });
        assert!(missed.count() <= 4);
    }

    #[test]
    fn readings_of_a_mosaic_are_binned_by_polarizer() {
        let (frame, rows) = (Size::new(96, 80), [[90.0, 45.0], [135.0, 0.0]]);
        let mut psf = Stack::zeros(1, Size::new(4, 4));
        psf.plane_mut(0)[10] = 1.0;
        let mask = Mask::Mosaic { layout: Mosaic::new(&rows).unwrap(), extinction_ratio: f64::INFINITY };
        let built = |bin| {
            let begun = Device::builder(frame).crop([1, 1], Size::new(4 * bin, 4 * bin)).bin(bin);
            begun.levels(0.0, 1000.0).noise(0.004, 0.0).mask(mask.clone()).psf(psf.clone()).build()
        };
        let device = built(4).unwrap();
        // a mean of 4 readings has half their noise
        assert!((device.noise.read - 0.002).abs() < 1e-9);
        let of = |x: usize, y: usize| rows[y % 2][x % 2] as f32;
        let mut values: Vec<f32> = (0..frame.pixels()).map(|i| 300.0 + of(i % 96, i / 96)).collect();
        // a hot pixel in the middle of block (1, 1), behind its polarizer
        values[8 * 96 + 8] = 900.0;
        let out = image(&device, &values);
        for (block, (value, weight)) in out.values.plane(0).iter().zip(out.weights.plane(0)).enumerate() {
            let (x, y) = (block % 4, block / 4);
            let expected = of(1 + x, 1 + y);
            assert!((*value - 300.0 - expected).abs() < 1e-3, "block {block}: {value}");
            let e = device.response.polarized()[block];
            let angle = 0.5 * e.im.atan2(e.re).to_degrees().rem_euclid(360.0);
            assert!((angle - expected).abs() < 1e-3, "block {block} lies behind {angle}°, is read as {expected}°");
            assert_eq!(*weight, if block == 5 { 0.75 } else { 1.0 }, "block {block}");
        }
        let error = built(3).unwrap_err().to_string();
        assert!(error.contains("bin = 3 of polarizers that repeat after 2 columns and 2 rows"), "{error}");
    }

    #[test]
    fn what_optics_can_draw_is_kept() {
        let device = device(PLANES, 1, [0, 0], PLANES, 4, 8.0 / 3936.0);
        let (mut values, _) = ramp(5);
        // a column, a row, an edge between polarizers, a spot of light two readings wide
        (0..80).for_each(|y| values[y * 96 + 13] += 1500.0);
        (0..96).for_each(|x| values[30 * 96 + x] += 1500.0);
        (0..80).for_each(|y| (50..96).for_each(|x| values[y * 96 + x] *= 0.4));
        for (dy, line) in [[0.1, 0.4, 0.1], [0.4, 1.0, 0.4], [0.1, 0.4, 0.1]].iter().enumerate() {
            line.iter().enumerate().for_each(|(dx, v)| values[(60 + dy) * 96 + 70 + dx] += 2500.0 * v);
        }
        let out = image(&device, &values);
        let untouched = out.weights.as_slice().iter().filter(|w| **w == 1.0).count();
        assert!(untouched + 2 >= out.weights.as_slice().len(), "{untouched}");
    }

    #[test]
    fn a_block_in_saturated_light_has_no_weight() {
        let device = device(PLANES, 1, [0, 0], PLANES, 4, 8.0 / 3936.0);
        let noise = normal(PLANES.pixels(), 8.0, 1);
        for (level, whole) in [(3940.0, true), (3992.0f32, false), (3996.0, false), (4040.0, false)] {
            let values: Vec<f32> = noise.iter().map(|v| (v + level).min(4095.0)).collect();
            let out = image(&device, &values);
            let weighted = || out.values.as_slice().iter().zip(out.weights.as_slice()).filter(|(_, w)| **w > 0.0);
            let count = weighted().count();
            assert!(if whole { weighted().all(|(_, w)| *w == 1.0) } else { level < 4000.0 || count == 0 }, "{level}");
            if count > 0 {
                // readings that happen to be below saturation are no measure of the light
                let mean = weighted().map(|(v, w)| v * w).sum::<f32>() / weighted().map(|(_, w)| w).sum::<f32>();
                assert!((mean - level).abs() < 3.0, "{level}: {mean}");
            }
        }
        // light that is not even: a polarizer's edge, with saturated columns on one side
        let values: Vec<f32> = noise.iter().enumerate().map(|(i, v)| v + [2000.0, 4080.0][i % 96 / 47 % 2]).collect();
        let out = image(&device, &values);
        assert_eq!(out.weights.plane(0)[10..13], [1.0, 0.0, 0.0]);
    }

    #[test]
    fn clipping_below_the_declared_saturation_is_found_in_blocks() {
        let device = device(PLANES, 1, [0, 0], PLANES, 4, 8.0 / 3936.0);
        let (values, _) = ramp(6);
        assert_eq!(image(&device, &values).off_scale, None);
        for step in [1.0, 16.0] {
            let clipped: Vec<f32> = values.iter().map(|v| v.min(1100.0) * step).collect();
            let saturation = 4000.0 * step + step - 1.0;
            let mut device = device.clone();
            (device.sensor.black_level, device.sensor.saturation) = (64.0 * step, saturation);
            let out = image(&device, &clipped);
            assert_eq!(out.off_scale, Some(OffScale::Clipped { level: 1100.0 * step, saturation }));
            let full =
                |block: usize| device.sensor.window.block(block).filter(|at| clipped[*at] == 1100.0 * step).count();
            for (block, weight) in out.weights.as_slice().iter().enumerate() {
                assert!(
                    if full(block) > 8 { *weight == 0.0 } else { full(block) > 0 || *weight == 1.0 },
                    "{block}: {weight}"
                );
            }
            assert!((0..480).filter(|block| full(*block) > 8).count() > 20);
        }
        // 12 bits, left-aligned, in a bundle for low-aligned ones, and the other way round
        let left: Vec<f32> = values.iter().map(|v| v * 16.0).collect();
        let of = |values: &[f32], saturation| {
            let mut device = device.clone();
            device.sensor.saturation = saturation;
            image(&device, values).off_scale
        };
        assert!(matches!(of(&left, 4000.0), Some(OffScale::Deeper { .. })));
        assert!(matches!(of(&left, 65535.0), Some(OffScale::LeftAligned { step: 16, .. })));
        assert!(matches!(of(&values, 65520.0), Some(OffScale::LowAligned { .. })));
    }

    #[test]
    fn the_dark_frame_of_the_camera_is_subtracted_and_tells_hot_pixels() {
        let dark: Vec<f32> =
            (0..PLANES.pixels()).map(|i| 60.0 + (i % 5) as f32 + if i % 97 == 0 { 900.0 } else { 0.0 }).collect();
        let full = Stack::from_vec(1, PLANES, dark.clone()).unwrap();
        let plain = device(PLANES, 1, [0, 0], PLANES, 4, 8.0 / 3936.0);
        let with = |dark: Stack<f32>| Device { dark: Some(Arc::new(dark)), ..plain.clone() };
        let values: Vec<f32> = dark.iter().map(|v| v + 1000.0).collect();
        let out = image(&with(full), &values);
        assert!(out.values.as_slice().iter().all(|v| (*v - 1064.0).abs() < 1e-3), "the black level is 64");
        for (block, weight) in out.weights.as_slice().iter().enumerate() {
            let hot = plain.sensor.window.block(block).filter(|at| at % 97 == 0).count();
            assert_eq!(*weight, 1.0 - hot as f32 / 16.0);
        }
        // at the working size: of a mean, there is no telling which pixel is hot
        let small = Stack::from_vec(1, Size::new(24, 20), vec![100.0; 480]).unwrap();
        let out = image(&with(small), &vec![1100.0; PLANES.pixels()]);
        assert!(out.values.as_slice().iter().all(|v| *v == 1064.0));
    }

    #[test]
    fn numbers_that_are_none_are_left_out_and_a_plateau_of_floats_is_saturated() {
        let device = device(PLANES, 1, [0, 0], PLANES, 4, 0.002);
        let mut values = vec![0.5f32; PLANES.pixels()];
        values[5] = f32::NAN;
        (0..16).for_each(|k| values[(40 + k / 4) * 96 + 40 + k % 4] = 0.9);
        let mut out = Binned::default();
        binning(&device, 1).image(&ImageView::planar(&values, 1, PLANES).unwrap(), &mut out);
        assert_eq!((out.weights.plane(0)[1], out.weights.plane(0)[10 * 24 + 10]), (15.0 / 16.0, 0.0));
        assert!((out.values.plane(0)[1] - (64.0 + 0.5 * 3936.0)).abs() < 1e-2);
    }

    #[test]
    fn every_instruction_set_gives_the_same() {
        let device = device(PLANES, 1, [1, 2], Size::new(90, 72), 3, 8.0 / 3936.0);
        let counts: Vec<u16> = ramp(2).0.iter().map(|v| *v as u16).collect();
        let view = ImageView::planar(&counts, 1, PLANES).unwrap();
        let mut binning = binning(&device, 1);
        let all = crate::optics::lanes::levels().into_iter().map(|level| {
            let mut out = Binned::default();
            binning.level = level;
            binning.image(&view, &mut out);
            out.values
        });
        let all: Vec<_> = all.collect();
        assert!(all.iter().all(|values| *values == all[0]));
    }

    #[test]
    fn other_frames_are_refused() {
        let device = device(PLANES, 1, [0, 0], PLANES, 4, 0.002);
        let format = PixelFormat::Mono(Samples::U8);
        let frame = Frame::new(&[0; 64], format, Size::new(8, 8), 8, Metadata::default()).unwrap();
        let e = binning(&device, 1).frame(&frame, &mut Binned::default()).unwrap_err().to_string();
        assert_eq!(e, "a mono 8-bit frame of 8×8 fills 1 planes of 8×8, not 1 of 96×80");
    }
}
