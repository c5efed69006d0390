//! Figures and pictures of a frame as the sensor delivers it, on the fixed scale of its counts.

use std::time::{Duration, Instant};

use super::camera::Latest;
use stokescope_core::image::{Size, Stack};
use stokescope_core::polarization::color::srgb;

/// Colours of saturated readings and of those of no count at all.
const SATURATED: [u8; 3] = [255, 48, 48];
const CLIPPED: [u8; 3] = [64, 96, 255];
/// Classes that quantiles are read from.
const FINE: usize = 1024;
/// Classes of the histogram that is shown.
pub(in crate::live) const CLASSES: usize = 64;
/// Blocks each way whose means are compared.
pub(in crate::live) const BLOCKS: usize = 16;
/// Age of the frame that the latest one is compared with, to see whether something moved.
const APART: Duration = Duration::from_millis(1500);
/// Age from which on an earlier frame is no longer compared.
const STALE: Duration = Duration::from_secs(6);
/// Light below this share of full scale is too little to tell whether it moved.
const FAINT: f32 = 0.005;

/// Means of the blocks of one frame and the time that it arrived.
#[derive(Clone, Debug)]
struct Place {
    arrived: Instant,
    blocks: [f32; BLOCKS * BLOCKS],
}

/// Figures of one frame. Readings are shares of full scale from 0, the black level included.
#[derive(Clone, Debug)]
pub(in crate::live) struct Figures {
    /// Share of the readings that are saturated.
    pub(in crate::live) saturated: f64,
    /// Share of the readings of no count, which a sensor with a black level has only where it is clipped.
    pub(in crate::live) clipped: f64,
    pub(in crate::live) mean: f32,
    pub(in crate::live) median: f32,
    /// Reading that 99.5 % do not exceed.
    pub(in crate::live) bright: f32,
    /// Mean difference of neighbours over the mean signal, in percent: it is largest where the picture is sharpest.
    pub(in crate::live) focus: f32,
    /// Readings by count, as shares.
    pub(in crate::live) classes: [f32; CLASSES],
    /// Means of 16 × 16 blocks.
    pub(in crate::live) blocks: [f32; BLOCKS * BLOCKS],
    /// Share of the light that is elsewhere than before; none where nothing can be compared.
    pub(in crate::live) moved: Option<f32>,
    arrived: Instant,
    before: Option<Place>,
}

impl Figures {
    /// Figures of the latest frame. `last` are those of a frame before it.
    pub(super) fn of(latest: &Latest, last: Option<&Self>) -> Self {
        let (planes, white) = (&latest.planes, latest.white());
        let black = latest.black().unwrap_or(0.0) / white;
        let mut counts = [0u32; FINE];
        let (mut saturated, mut clipped, mut sum) = (0u32, 0u32, 0.0f64);
        for &v in planes.as_slice() {
            saturated += u32::from(v >= white || !v.is_finite());
            clipped += u32::from(v <= 0.0);
            let share = (v / white).clamp(0.0, 1.0);
            sum += f64::from(share);
            counts[((share * FINE as f32) as usize).min(FINE - 1)] += 1;
        }
        let n = planes.as_slice().len().max(1);
        let share = |count: u32| f64::from(count) / n as f64;
        let each = FINE / CLASSES;
        let blocks = block_means(planes, white);
        let arrived = latest.arrived.unwrap_or_else(Instant::now);
        // a frame of some time ago, so that slow movement shows too
        let age = |since: Instant| arrived.saturating_duration_since(since);
        let before = last.filter(|last| age(last.arrived) < STALE).map(|last| match &last.before {
            Some(place) if age(place.arrived) < APART => place.clone(),
            _ => Place { arrived: last.arrived, blocks: last.blocks },
        });
        Self {
            saturated: share(saturated),
            clipped: share(clipped),
            mean: (sum / n as f64) as f32,
            median: quantile(&counts, n, 0.5),
            bright: quantile(&counts, n, 0.995),
            focus: focus(planes.plane(planes.count() / 2), planes.size(), white * black),
            classes: std::array::from_fn(|k| share(counts[k * each..][..each].iter().sum()) as f32),
            moved: before.as_ref().and_then(|before| moved(&before.blocks, &blocks, black)),
            blocks,
            arrived,
            before,
        }
    }

    /// Difference between the brightest and the dimmest blocks, leaving out a twentieth at both ends.
    pub(in crate::live) fn unevenness(&self) -> f32 {
        let sorted = self.sorted_blocks();
        sorted[sorted.len() * 19 / 20] - sorted[sorted.len() / 20]
    }

    /// Share of the blocks that are brighter than the dimmest by a tenth of the difference to the brightest.
    pub(in crate::live) fn lit(&self) -> f32 {
        let sorted = self.sorted_blocks();
        let (low, high) = (sorted[sorted.len() / 20], sorted[sorted.len() - 1]);
        let limit = low + 0.1 * (high - low);
        self.blocks.iter().filter(|v| **v > limit).count() as f32 / self.blocks.len() as f32
    }

    fn sorted_blocks(&self) -> [f32; BLOCKS * BLOCKS] {
        let mut sorted = self.blocks;
        sorted.sort_by(f32::total_cmp);
        sorted
    }
}

/// Upper end of the class below which `share` of `n` readings lie.
fn quantile(counts: &[u32; FINE], n: usize, share: f64) -> f32 {
    let (wanted, mut sum) = (share * n as f64, 0.0);
    let class = counts.iter().position(|count| {
        sum += f64::from(*count);
        sum >= wanted
    });
    (class.unwrap_or(FINE - 1) as f32 + 0.5) / FINE as f32
}

/// Means of the blocks over all planes, as shares of full scale.
fn block_means(planes: &Stack<f32>, white: f32) -> [f32; BLOCKS * BLOCKS] {
    let Size { width, height } = planes.size();
    let mut sums = [0.0f64; BLOCKS * BLOCKS];
    let mut counts = [0u32; BLOCKS * BLOCKS];
    for plane in planes.planes() {
        for (y, row) in plane.chunks_exact(width.max(1)).enumerate() {
            let first = y * BLOCKS / height * BLOCKS;
            for (x, v) in row.iter().enumerate() {
                let block = first + x * BLOCKS / width;
                sums[block] += f64::from(v.clamp(0.0, white));
                counts[block] += 1;
            }
        }
    }
    std::array::from_fn(|k| (sums[k] / f64::from(counts[k].max(1)) / f64::from(white)) as f32)
}

/// Share of the light above `black` that is in other blocks than before; the brightness of the whole does not count.
fn moved(before: &[f32; BLOCKS * BLOCKS], now: &[f32; BLOCKS * BLOCKS], black: f32) -> Option<f32> {
    let total = |blocks: &[f32]| blocks.iter().map(|v| (v - black).max(0.0)).sum::<f32>();
    let (a, b) = (total(before), total(now));
    if a.min(b) < FAINT * now.len() as f32 {
        return None;
    }
    let share = |v: f32, sum: f32| (v - black).max(0.0) / sum;
    Some(0.5 * before.iter().zip(now).map(|(v, w)| (share(*v, a) - share(*w, b)).abs()).sum::<f32>())
}

/// Mean difference between neighbours in a row, two pixels apart, over the mean signal, in percent.
fn focus(plane: &[f32], size: Size, black: f32) -> f32 {
    let (mut change, mut signal) = (0.0f64, 0.0f64);
    for row in plane.chunks_exact(size.width.max(1)) {
        change += row.windows(3).map(|w| f64::from((w[2] - w[0]).abs())).sum::<f64>();
        signal += row.iter().map(|v| f64::from((v - black).max(0.0))).sum::<f64>();
    }
    if signal > 0.0 { (100.0 * change / signal) as f32 } else { 0.0 }
}

/// Draws a frame from no count to the count of a full reading, without any stretch. Saturated readings are red; readings of no count are
/// blue where the sensor has a black level above that.
pub(super) fn draw(latest: &Latest, pixels: &mut Vec<[u8; 3]>) {
    let (planes, white) = (&latest.planes, latest.white());
    let n = planes.size().pixels();
    let lifted =
        latest.black().is_some_and(|black| black > 0.0) || latest.unit() == stokescope_core::readings::Unit::Counts;
    pixels.clear();
    let color = planes.count() == 3;
    let values = planes.as_slice();
    pixels.extend((0..n).map(|i| {
        let readings = if color { [values[i], values[n + i], values[2 * n + i]] } else { [values[i]; 3] };
        if readings.iter().any(|v| !(v.is_finite() && *v < white)) {
            SATURATED
        } else if lifted && readings.iter().all(|v| *v <= 0.0) {
            CLIPPED
        } else {
            readings.map(|v| srgb(v / white))
        }
    }));
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::CameraInfo;
    use crate::live::setup::camera::tests::latest;

    #[test]
    fn a_fixed_scale_shows_saturation_in_red_and_no_count_in_blue() {
        let frame = latest(Size::new(4, 1), vec![0.0, 1000.0, 4094.0, 4095.0]);
        let mut pixels = Vec::new();
        draw(&frame, &mut pixels);
        assert_eq!((pixels[0], pixels[3]), (CLIPPED, SATURATED));
        assert!(pixels[1] == [srgb(1000.0 / 4095.0); 3] && pixels[2][0] >= 254, "{pixels:?}");
        let figures = Figures::of(&frame, None);
        assert_eq!((figures.saturated, figures.clipped), (0.25, 0.25));
        assert_eq!(figures.moved, None);
        let CameraInfo { format, .. } = frame.info;
        assert_eq!(format.bits(), Some(12));
    }

    #[test]
    fn movement_shows_and_a_change_of_brightness_does_not() {
        let size = Size::new(64, 64);
        let spot = |left: usize, level: f32| {
            let at = |i: usize| if (left..left + 8).contains(&(i % 64)) { level } else { 50.0 };
            latest(size, (0..size.pixels()).map(at).collect())
        };
        let first = Figures::of(&spot(20, 2000.0), None);
        assert!(Figures::of(&spot(20, 1800.0), Some(&first)).moved.unwrap() < 0.03);
        assert!(Figures::of(&spot(24, 2000.0), Some(&first)).moved.unwrap() > 0.2);
        assert!(first.lit() < 0.3 && first.unevenness() > 0.3, "{} {}", first.lit(), first.unevenness());
    }

    #[test]
    fn a_sharp_edge_has_more_focus_than_a_blurred_one() {
        let size = Size::new(32, 8);
        let edge = |width: f32| {
            let at = |i: usize| 1000.0 + 1000.0 * ((i % 32) as f32 / 2.0).sin() / width;
            Figures::of(&latest(size, (0..size.pixels()).map(at).collect()), None).focus
        };
        assert!(edge(1.0) > 2.0 * edge(4.0));
    }
}
