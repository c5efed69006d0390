//! Writes the results of calibration steps into a bundle.

use stokescope_core::calibrate::align::Alignment;
use stokescope_core::calibrate::dark::DarkFrame;
use stokescope_core::calibrate::mask::MeasuredMask;
use stokescope_core::calibrate::psf::MeasuredPsf;
use stokescope_core::calibrate::white::WhiteBalance;
use stokescope_core::image::{Size, Stack};
use toml::Value;

use super::Draft;

impl Draft {
    /// Sets sensor, noise and dark frame.
    pub fn set_dark(&mut self, found: &DarkFrame) {
        let (size, channels) = (found.mean.size(), found.mean.count());
        for (key, value) in [("width", size.width), ("height", size.height), ("channels", channels)] {
            self.set("sensor", key, value as i64);
        }
        self.set("sensor", "bit_depth", i64::from(found.bits));
        self.set("sensor", "black_level", f64::from(found.black_level));
        self.set("sensor", "saturation", f64::from(found.saturation));
        self.set("noise", "read", f64::from(found.read_noise));
        self.set_array("dark", &[channels, size.height, size.width], found.mean.as_slice());
    }

    /// Sets the measured mask.
    pub fn set_mask(&mut self, found: &MeasuredMask) {
        self.remove("mask");
        self.set("mask", "kind", "measured");
        let angles: Vec<_> = found.angles.iter().map(|a| Value::Float(a.degrees())).collect();
        self.set("mask", "angles_deg", angles);
        let Size { width, height } = found.transmission.size();
        self.set_array("mask", &[found.angles.len(), height, width], found.transmission.as_slice());
    }

    /// Sets the PSF.
    pub fn set_psf(&mut self, found: &MeasuredPsf) {
        self.set_array("psf", &shape(&found.planes), found.planes.as_slice());
    }

    /// Sets the white balance of a colour sensor; a monochrome sensor has none.
    pub fn set_white(&mut self, found: &WhiteBalance) {
        if found.channels == 3 {
            self.set("white", "gains", found.gains.map(Value::Float).to_vec());
        }
    }

    /// Sets the homography of the guide camera, from pixels of the lensless camera's frame.
    pub fn set_alignment(&mut self, found: &Alignment) {
        let window = self.known.sensor.map(|sensor| sensor.window);
        let homography = window.map_or(found.homography, |window| found.homography.of_frame(&window));
        self.set("guide", "homography", homography.0.map(Value::Float).to_vec());
    }
}

/// Shape of an array file: `[H, W]` for one plane, `[C, H, W]` for several.
fn shape(planes: &Stack<f32>) -> Vec<usize> {
    let Size { width, height } = planes.size();
    if planes.count() == 1 { vec![height, width] } else { vec![planes.count(), height, width] }
}
