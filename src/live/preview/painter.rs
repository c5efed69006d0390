//! Drawing of views.

use super::view::View;
use crate::live::frame::{PublishedFrame, Readings, Sketch};
use crate::output::panel::notice;
use stokescope_core::image::Size;
use stokescope_core::polarization::color::{self, AolpMode};
use stokescope_core::uncertainty::dolp_error;

/// Least white level of a difference, as a fraction of the frame's white level: noise alone stays dark.
const DIFFERENCE_FLOOR: f32 = 0.05;

/// Colours of raw readings that are saturated, and of those that are below what the sensor can tell.
const SATURATED: [u8; 3] = [255, 48, 48];
const CLIPPED: [u8; 3] = [64, 96, 255];

/// Draws views in buffers that are made once.
#[derive(Debug)]
pub(in crate::live) struct Painter {
    size: Size,
    stokes: [Vec<f32>; 3],
    plane: Vec<f32>,
    scratch: Vec<f32>,
    shown: Vec<bool>,
    pixels: Vec<[u8; 3]>,
    /// End of the scale of the degree of polarization; none follows the frame.
    pub(super) dolp_scale: Option<f32>,
    /// End of that scale in the latest picture that has one.
    pub(super) dolp_top: Option<f32>,
}

impl Painter {
    /// A painter of frames of `size`.
    pub(in crate::live) fn new(size: Size) -> Self {
        let n = size.pixels();
        let plane = || vec![0.0; n];
        Self {
            size,
            stokes: [plane(), plane(), plane()],
            plane: plane(),
            scratch: Vec::with_capacity(n),
            shown: vec![false; n],
            pixels: vec![[0; 3]; n],
            dolp_scale: Some(1.0),
            dolp_top: None,
        }
    }

    /// Bytes of the buffers.
    pub(in crate::live) fn bytes(size: Size) -> usize {
        size.pixels() * (5 * size_of::<f32>() + 1 + 3)
    }

    /// Draws a text in place of a picture.
    pub(in crate::live) fn notice(&mut self, text: &str) -> &[[u8; 3]] {
        self.pixels = notice(self.size, text).pixels;
        &self.pixels
    }

    /// Draws a view of a frame. Differences are taken against `background`, S0 of another frame.
    pub(in crate::live) fn draw(
        &mut self,
        view: View,
        frame: &PublishedFrame,
        background: Option<&[f32]>,
    ) -> &[[u8; 3]] {
        match (view, background) {
            (View::Difference, None) => return self.notice("no background is stored"),
            (View::Difference, Some(background)) => self.difference(frame, background),
            _ => return self.draw_alone(view, frame),
        }
        &self.pixels
    }

    fn difference(&mut self, frame: &PublishedFrame, background: &[f32]) {
        for (i, out) in self.plane.iter_mut().enumerate() {
            *out = frame.stokes_at(0, i);
        }
        let white = color::white_level(&self.plane, &mut self.scratch);
        for (out, (now, before)) in self.stokes[0].iter_mut().zip(self.plane.iter().zip(background)) {
            *out = (now - before).abs();
        }
        let full = color::white_level(&self.stokes[0], &mut self.scratch).clamp(DIFFERENCE_FLOOR * white, white);
        color::difference(&self.plane, background, full, &mut self.pixels);
    }

    fn draw_alone(&mut self, view: View, frame: &PublishedFrame) -> &[[u8; 3]] {
        match view {
            View::Raw => self.readings(frame.channels, &frame.raw),
            View::Guide if !frame.guided => return self.notice("no guide frame for this raw frame"),
            View::Guide => self.sketch(frame.channels, &frame.guide),
            View::Intensity => {
                let per_channel = frame.stokes.count() / frame.channels;
                let planes = |c: usize| frame.stokes.plane(c * per_channel);
                intensity(frame.channels, planes, &mut self.scratch, &mut self.pixels);
            }
            _ if !frame.polarized() => return self.notice("no polarization: the camera has no mask"),
            _ => self.polarization(view, frame),
        }
        &self.pixels
    }

    /// Draws readings on a fixed scale, from the count without light to the saturated one, which is red; a reading of no count at all is
    /// blue where the sensor lifts darkness above it.
    fn readings(&mut self, channels: usize, readings: &Readings) {
        let &Readings { black, full, .. } = readings;
        let level = |count: u16| color::srgb((f32::from(count) - black) / (full - black));
        for (i, pixel) in self.pixels.iter_mut().enumerate() {
            let counts = [0, 1, 2].map(|c| readings.plane(c.min(channels - 1))[i]);
            *pixel = if counts.iter().any(|count| f32::from(*count) >= full) {
                SATURATED
            } else if black > 0.0 && counts.contains(&0) {
                CLIPPED
            } else {
                counts.map(level)
            };
        }
    }

    fn sketch(&mut self, channels: usize, image: &Sketch) {
        for (c, plane) in self.stokes.iter_mut().enumerate().take(channels) {
            plane.iter_mut().zip(image.plane(c)).for_each(|(to, value)| *to = value);
        }
        intensity(channels, |c| &self.stokes[c][..], &mut self.scratch, &mut self.pixels);
    }

    /// Draws a view of the polarization, which for a colour camera is that of the summed channels.
    fn polarization(&mut self, view: View, frame: &PublishedFrame) {
        for (component, sum) in self.stokes.iter_mut().enumerate() {
            sum.copy_from_slice(frame.stokes.plane(component));
            for channel in 1..frame.channels {
                sum.iter_mut().zip(frame.stokes.plane(3 * channel + component)).for_each(|(s, v)| *s += v);
            }
        }
        let [s0, s1, s2] = &self.stokes;
        let (stokes, pixels) = ([&s0[..], &s1[..], &s2[..]], &mut self.pixels[..]);
        let white = 0.5 * color::white_level(s0, &mut self.scratch);
        match view {
            View::Composite => color::composite(stokes, &frame.valid, white, pixels),
            View::Imin => color::glare_reduced(stokes, white, pixels),
            View::Angle(angle) => {
                let (cos, sin) = (angle.cos2() as f32, angle.sin2() as f32);
                for (i, out) in self.plane.iter_mut().enumerate() {
                    *out = 0.5 * (s0[i] + cos * s1[i] + sin * s2[i]);
                }
                color::intensity(&self.plane, white, pixels);
            }
            _ => {
                let Self { scratch, shown, plane, .. } = self;
                color::polarized_pixels(s0, &frame.valid, scratch, shown);
                let images = frame.images();
                if view == View::DolpError {
                    for (i, out) in plane.iter_mut().enumerate() {
                        let error = images.errors_at(i).filter(|_| shown[i]);
                        *out = error.map_or(f32::NAN, |[stokes, errors]| dolp_error(stokes, errors));
                    }
                    let top = self.dolp_scale.unwrap_or_else(|| color::scale_top(plane, scratch));
                    self.dolp_top = Some(top);
                    pixels.iter_mut().zip(plane).for_each(|(out, error)| *out = color::dolp_color(*error / top));
                    return;
                }
                let top = self.dolp_scale.unwrap_or_else(|| color::dolp_top(stokes, shown, plane, scratch));
                self.dolp_top = Some(top);
                if matches!(view, View::Aolp | View::AolpSaturation) {
                    shown.iter_mut().enumerate().for_each(|(i, shown)| *shown &= images.has_angle(i));
                }
                match view {
                    View::Aolp => color::aolp(stokes, shown, AolpMode::Value, top, pixels),
                    View::AolpSaturation => color::aolp(stokes, shown, AolpMode::Saturation, top, pixels),
                    _ => color::dolp(stokes, shown, top, pixels),
                }
            }
        }
    }
}

/// Draws one channel in gray or three in colour.
fn intensity<'a>(channels: usize, plane: impl Fn(usize) -> &'a [f32], scratch: &mut Vec<f32>, pixels: &mut [[u8; 3]]) {
    let white = (0..channels).map(|c| color::white_level(plane(c), scratch)).fold(0.0, f32::max);
    if channels == 3 {
        color::intensity_rgb([0, 1, 2].map(plane), white, pixels);
    } else {
        color::intensity(plane(0), white, pixels);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::live::frame::tests::{frame, sensor};
    use stokescope_core::image::Stack;
    use stokescope_core::polarization::Angle;
    use stokescope_core::readings::Unit;

    #[test]
    fn a_raw_view_has_a_fixed_scale_and_shows_what_is_saturated_or_clipped() {
        let size = Size::new(4, 1);
        let sensor = sensor(size, 64.0, 1000.0);
        let counts = Stack::from_vec(1, size, vec![0.0, 64.0, 999.0, 1000.0]).unwrap();
        let mut painter = Painter::new(size);
        let mut readings = Readings::default();
        readings.take(&counts, &sensor, Unit::Counts);
        painter.readings(1, &readings);
        assert_eq!(painter.pixels, [CLIPPED, [0; 3], [255; 3], SATURATED]);
    }

    #[test]
    fn views_show_what_their_names_say_for_gray_and_colour() {
        for channels in [1, 3] {
            let (frame, mut painter) = (frame(channels), Painter::new(Size::new(2, 1)));
            let mut draw = |view| painter.draw(view, &frame, None).to_vec();
            assert_eq!(draw(View::Intensity), [[255; 3]; 2]);
            assert_eq!(draw(View::Dolp), [color::dolp_color(0.0), color::dolp_color(1.0)]);
            let along_rows = color::aolp_color(0.0, 1.0, AolpMode::Value);
            assert_eq!(draw(View::Aolp), [color::MASKED, along_rows], "an angle below its error is gray");
            assert_eq!(draw(View::AolpSaturation), [color::MASKED, along_rows]);
            let error = 0.1 / (channels as f32).sqrt();
            assert_eq!(draw(View::DolpError), [color::dolp_color(error); 2]);
            assert_eq!(draw(View::Imin), [[255; 3], [0; 3]]);
            assert_eq!(draw(View::Angle(Angle::from_degrees(90.0))), [[255; 3], [0; 3]]);
            assert_eq!(draw(View::Raw), [[0; 3]; 2], "dark, and nothing lifts it");
            let background = [frame.stokes_at(0, 0), 0.0];
            let changed = painter.draw(View::Difference, &frame, Some(&background)).to_vec();
            assert_eq!(changed, [color::difference_color(0.0), color::difference_color(1.0)]);
        }
    }
}
