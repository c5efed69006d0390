//! Solved frames as they are published: to the preview, to the disk and to requests.

use std::time::Instant;

use crate::output::{Report, ResultImages};
use stokescope_core::device::Sensor;
use stokescope_core::image::{Size, Stack};
use stokescope_core::polarization::Angle;
use stokescope_core::readings::Unit;

/// An image to look at, in half the memory: the upper 16 bits of each value, whose 8 bits of mantissa are as many as a picture
/// shows. Empty until it takes an image.
#[derive(Debug)]
pub(super) struct Sketch(Stack<u16>);

impl Default for Sketch {
    fn default() -> Self {
        Self(Stack::zeros(0, Size::new(0, 0)))
    }
}

impl Sketch {
    /// Copy of an image. Allocates.
    pub(super) fn of(image: &Stack<f32>) -> Self {
        let mut sketch = Self::default();
        sketch.take(image);
        sketch
    }

    /// Copies an image into this. Allocates when the last one had another shape.
    pub(super) fn take(&mut self, image: &Stack<f32>) {
        if (self.0.count(), self.0.size()) != (image.count(), image.size()) {
            self.0 = Stack::zeros(image.count(), image.size());
        }
        let halves = image.as_slice().iter().map(|value| (value.to_bits() >> 16) as u16);
        self.0.as_mut_slice().iter_mut().zip(halves).for_each(|(to, half)| *to = half);
    }

    /// Values of plane `index`.
    pub(super) fn plane(&self, index: usize) -> impl Iterator<Item = f32> {
        self.0.plane(index).iter().map(|half| f32::from_bits(u32::from(*half) << 16))
    }
}

/// Readings of the raw camera in counts of 16 bits, as they were before any processing. Empty until it takes a frame.
#[derive(Debug)]
pub(super) struct Readings {
    counts: Stack<u16>,
    /// Count without light, and the one from which on a reading is saturated.
    pub(super) black: f32,
    pub(super) full: f32,
}

impl Default for Readings {
    fn default() -> Self {
        Self { counts: Stack::zeros(0, Size::new(0, 0)), black: 0.0, full: 1.0 }
    }
}

/// Count of a full reading of a camera that delivers shares of full scale.
const FULL_SCALE: f32 = 65_535.0;

/// Count without light, count of a saturated reading, and counts per value, of frames in `unit`.
fn scale(sensor: &Sensor, unit: Unit) -> [f32; 3] {
    match unit {
        Unit::Counts => [sensor.black_level, sensor.saturation, 1.0],
        Unit::FullScale => [0.0, FULL_SCALE, FULL_SCALE],
    }
}

impl Readings {
    /// Copies a frame of the camera, in `unit`. Allocates when the last one had another shape.
    pub(super) fn take(&mut self, image: &Stack<f32>, sensor: &Sensor, unit: Unit) {
        if (self.counts.count(), self.counts.size()) != (image.count(), image.size()) {
            self.counts = Stack::zeros(image.count(), image.size());
        }
        let [black, full, factor] = scale(sensor, unit);
        (self.black, self.full) = (black, full);
        let counts = image.as_slice().iter().map(|value| (value * factor).round() as u16);
        self.counts.as_mut_slice().iter_mut().zip(counts).for_each(|(to, count)| *to = count);
    }

    /// Counts of plane `index`.
    pub(super) fn plane(&self, index: usize) -> &[u16] {
        self.counts.plane(index)
    }
}

/// One solved frame, copied out of the pipeline so that the preview, the disk and requests can hold it.
#[derive(Debug)]
pub(super) struct PublishedFrame {
    /// Number of the frame, from 0.
    pub(super) index: u64,
    /// Arrival of its raw frame.
    pub(super) arrived: Instant,
    /// Colour channels C: 1 or 3.
    pub(super) channels: usize,
    /// Whether `raw` and `guide` are of this frame. They are copied only while somebody watches them.
    pub(super) sketched: bool,
    /// Readings of the raw camera, `[C, H, W]`.
    pub(super) raw: Readings,
    /// Share of these readings that are saturated.
    pub(super) saturated: f32,
    /// Aligned guide in the raw frame's units, `[C, H, W]`.
    pub(super) guide: Sketch,
    /// Whether there was a guide frame.
    pub(super) guided: bool,
    /// `[C·3, H, W]`: S0, S1, S2 per channel. Without a mask `[C, H, W]`: S0 alone.
    pub(super) stokes: Stack<f32>,
    /// Standard errors of `stokes`, of the same shape.
    pub(super) errors: Stack<f32>,
    /// Intensities behind the polarizers as stage I found them, where a fusion model refined them.
    pub(super) stage1: Option<Stack<f32>>,
    /// Polarizer angles; none without a mask.
    pub(super) angle_list: Vec<Angle>,
    /// Per pixel: neither saturated nor otherwise worthless.
    pub(super) valid: Vec<bool>,
    pub(super) report: Report,
}

impl PublishedFrame {
    pub(super) fn size(&self) -> Size {
        self.stokes.size()
    }

    /// Whether S1 and S2 were solved for.
    pub(super) fn polarized(&self) -> bool {
        self.stokes.count() == 3 * self.channels
    }

    /// The images as they are written to files.
    pub(super) fn images(&self) -> ResultImages<'_> {
        ResultImages {
            size: self.size(),
            channels: self.channels,
            angles: None,
            angle_list: &self.angle_list,
            stokes: &self.stokes,
            errors: Some(&self.errors),
            valid: &self.valid,
            stage1: self.stage1.as_ref(),
        }
    }

    /// Component 0, 1 or 2 of the Stokes vector of pixel `i`, summed over the channels; 0 for a component that was not solved
    /// for.
    pub(super) fn stokes_at(&self, component: usize, i: usize) -> f32 {
        self.images().stokes_at(component, i)
    }
}

#[cfg(test)]
pub(super) mod tests {
    use stokescope_core::image::Window;

    use super::*;

    /// A gray sensor with these counts without light and at saturation.
    pub(in crate::live) fn sensor(size: Size, black_level: f32, saturation: f32) -> Sensor {
        Sensor { size, window: Window::whole(size), channels: 1, black_level, saturation }
    }

    /// A frame of two pixels: unpolarized, and fully polarized at 0°.
    pub(in crate::live) fn frame(channels: usize) -> PublishedFrame {
        let size = Size::new(2, 1);
        let mut raw = Readings::default();
        raw.take(&Stack::zeros(channels, size), &sensor(size, 0.0, 1.0), Unit::FullScale);
        let one = [1.0, 1.0, 0.0, 1.0, 0.0, 0.0];
        let stokes = Stack::from_vec(3 * channels, size, one.repeat(channels)).unwrap();
        PublishedFrame {
            index: 0,
            arrived: Instant::now(),
            channels,
            sketched: true,
            raw,
            saturated: 0.0,
            guide: Sketch::of(&Stack::zeros(channels, size)),
            guided: false,
            errors: Stack::from_vec(3 * channels, size, [0.0, 0.0, 0.1, 0.1, 0.1, 0.1].repeat(channels)).unwrap(),
            stokes,
            angle_list: Angle::four(),
            stage1: None,
            valid: vec![true; 2],
            report: Report::default(),
        }
    }
}
