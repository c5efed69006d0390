//! Exposure: the share of a frame's readings that are saturated, and what helps.

use crate::camera::CameraInfo;
use stokescope_core::image::Stack;
use stokescope_core::readings::{Unit, saturation_found};

/// Share of saturated readings that is worth a warning: more than single hot pixels.
pub(super) const WARN_SHARE: f64 = 1e-3;
/// Remedy against saturated readings.
pub(super) const REMEDY: &str =
    "expose shorter, lower the gain (exposure_us and gain in the board file), or dim the light";

/// Share of the readings of an unpacked frame that are saturated: at the largest count of the format, or where the pipeline finds them
/// clipped below it.
pub(super) fn saturated(planes: &Stack<f32>, info: &CameraInfo) -> f64 {
    let (unit, largest) = match info.format.bits() {
        Some(bits) => (Unit::Counts, ((1u32 << bits) - 1) as f32),
        None => (Unit::FullScale, 1.0),
    };
    let full = info.levels.map_or(largest, |levels| levels.white);
    let clipped = |plane: &[f32]| {
        let level = saturation_found(plane, unit, full).min(full);
        plane.iter().filter(|value| **value >= level).count()
    };
    let count: usize = (0..planes.count()).map(|c| clipped(planes.plane(c))).sum();
    count as f64 / planes.as_slice().len().max(1) as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Limits;
    use stokescope_core::image::Size;

    #[test]
    fn clipping_below_the_largest_count_is_saturation() {
        let size = Size::new(64, 64);
        let format = "mono12".parse().unwrap();
        let info = CameraInfo {
            name: String::new(),
            backend: "sim",
            format,
            size,
            frame_rate: None,
            levels: None,
            readout: None,
            limits: Limits::default(),
        };
        let share = |level: f32| {
            let values = (0..size.pixels()).map(|i| (64.0 + (i * 2437 % 4000) as f32).min(level)).collect();
            saturated(&Stack::from_vec(1, size, values).unwrap(), &info)
        };
        assert_eq!(share(4095.0), 0.0);
        assert!((share(3000.0) - 0.266).abs() < 0.02, "{}", share(3000.0));
    }
}
