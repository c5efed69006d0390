//! Exposure: the share of a frame's readings that are saturated, and what helps.

use crate::camera::CameraInfo;
use stokescope_core::image::Stack;

/// Share of saturated readings that is worth a warning: more than single hot pixels.
pub(super) const WARN_SHARE: f64 = 1e-3;
/// Remedy against saturated readings.
pub(super) const REMEDY: &str =
    "expose shorter, lower the gain (exposure_us and gain in the board file), or dim the light";

/// Share of the readings of an unpacked frame that have the largest count there is.
pub(super) fn saturated(planes: &Stack<f32>, info: &CameraInfo) -> f64 {
    let largest = info.format.bits().map_or(1.0, |bits| ((1u32 << bits) - 1) as f32);
    let full = info.levels.map_or(largest, |levels| levels.white);
    let values = planes.as_slice();
    values.iter().filter(|value| **value >= full).count() as f64 / values.len().max(1) as f64
}
