//! The pictures a watcher can choose.

use crate::output::panel::notice;
use crate::plane::{Angle, Size};
use stokescope_core::polarization::color::{self, AolpMode};

use super::hub::{Shown, Sketch};

/// One picture of a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum View {
    Intensity,
    Dolp,
    /// Hue is the angle, brightness the degree.
    Aolp,
    /// Hue is the angle, saturation the degree.
    AolpSaturation,
    Composite,
    /// The scene with its glare turned away.
    Imin,
    /// Behind an ideal polarizer.
    Angle(Angle),
    Guide,
    Raw,
    /// What differs from the stored background.
    Difference,
}

impl View {
    /// The views of a camera with these polarizer angles; without angles there is no polarization.
    pub(super) fn all(angles: &[Angle], guide: bool) -> Vec<Self> {
        let mut views = vec![Self::Intensity];
        if !angles.is_empty() {
            views.extend([Self::Dolp, Self::Aolp, Self::AolpSaturation, Self::Composite, Self::Imin]);
            views.extend(angles.iter().copied().map(Self::Angle));
        }
        views.extend(guide.then_some(Self::Guide));
        views.extend([Self::Raw, Self::Difference]);
        views
    }

    /// Whether it shows a frame's sketches, which are made while somebody watches them.
    pub(super) fn is_sketch(self) -> bool {
        matches!(self, Self::Raw | Self::Guide)
    }

    /// Its name in addresses: `i45` is the picture behind a polarizer at 45°.
    pub(super) fn name(self) -> String {
        match self {
            Self::Intensity => "intensity".to_owned(),
            Self::Dolp => "dolp".to_owned(),
            Self::Aolp => "aolp".to_owned(),
            Self::AolpSaturation => "aolp-saturation".to_owned(),
            Self::Composite => "composite".to_owned(),
            Self::Imin => "imin".to_owned(),
            Self::Angle(angle) => format!("i{}", angle.degrees()),
            Self::Guide => "guide".to_owned(),
            Self::Raw => "raw".to_owned(),
            Self::Difference => "difference".to_owned(),
        }
    }

    /// Its name for people.
    pub(super) fn label(self) -> String {
        match self {
            Self::Intensity => "Intensity".to_owned(),
            Self::Dolp => "DoLP".to_owned(),
            Self::Aolp => "AoLP".to_owned(),
            Self::AolpSaturation => "AoLP on white".to_owned(),
            Self::Composite => "Composite".to_owned(),
            Self::Imin => "No glare".to_owned(),
            Self::Angle(angle) => format!("{}°", angle.degrees()),
            Self::Guide => "Guide".to_owned(),
            Self::Raw => "Raw".to_owned(),
            Self::Difference => "Difference".to_owned(),
        }
    }
}

/// Draws views, in buffers that are made once.
#[derive(Debug)]
pub(super) struct Painter {
    size: Size,
    stokes: [Vec<f32>; 3],
    plane: Vec<f32>,
    scratch: Vec<f32>,
    shown: Vec<bool>,
    pixels: Vec<[u8; 3]>,
}

impl Painter {
    /// For frames of `size`.
    pub(super) fn new(size: Size) -> Self {
        let n = size.pixels();
        let plane = || vec![0.0; n];
        Self {
            size,
            stokes: [plane(), plane(), plane()],
            plane: plane(),
            scratch: Vec::with_capacity(n),
            shown: vec![false; n],
            pixels: vec![[0; 3]; n],
        }
    }

    /// Bytes of the buffers.
    pub(super) fn bytes(size: Size) -> usize {
        size.pixels() * (5 * size_of::<f32>() + 1 + 3)
    }

    /// A picture that says why there is none.
    pub(super) fn notice(&mut self, text: &str) -> &[[u8; 3]] {
        self.pixels = notice(self.size, text).pixels;
        &self.pixels
    }

    /// The picture of a frame; `background` is S0 of the one that differences are taken against.
    pub(super) fn draw(&mut self, view: View, frame: &Shown, background: Option<&[f32]>) -> &[[u8; 3]] {
        match (view, background) {
            (View::Difference, None) => return self.notice("no background is stored"),
            (View::Difference, Some(background)) => self.difference(frame, background),
            _ => return self.draw_alone(view, frame),
        }
        &self.pixels
    }

    fn difference(&mut self, frame: &Shown, background: &[f32]) {
        for (i, out) in self.plane.iter_mut().enumerate() {
            *out = frame.stokes_at(0, i);
        }
        let white = color::white_level(&self.plane, &mut self.scratch);
        for (out, (now, before)) in self.stokes[0].iter_mut().zip(self.plane.iter().zip(background)) {
            *out = (now - before).abs();
        }
        // noise alone is not to glare
        let full = color::white_level(&self.stokes[0], &mut self.scratch).clamp(0.05 * white, white);
        color::difference(&self.plane, background, full, &mut self.pixels);
    }

    fn draw_alone(&mut self, view: View, frame: &Shown) -> &[[u8; 3]] {
        match view {
            View::Raw => self.sketch(frame.channels, &frame.raw),
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

    fn sketch(&mut self, channels: usize, image: &Sketch) {
        for (c, plane) in self.stokes.iter_mut().enumerate().take(channels) {
            plane.iter_mut().zip(image.plane(c)).for_each(|(to, value)| *to = value);
        }
        intensity(channels, |c| &self.stokes[c][..], &mut self.scratch, &mut self.pixels);
    }

    /// The polarization of a colour camera is that of its summed channels.
    fn polarization(&mut self, view: View, frame: &Shown) {
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
                color::polarized_pixels(s0, &frame.valid, &mut self.scratch, &mut self.shown);
                match view {
                    View::Aolp => color::aolp(stokes, &self.shown, AolpMode::Value, pixels),
                    View::AolpSaturation => color::aolp(stokes, &self.shown, AolpMode::Saturation, pixels),
                    _ => color::dolp(stokes, &self.shown, pixels),
                }
            }
        }
    }
}

/// Draws one plane in gray or three in colour.
fn intensity<'a>(channels: usize, plane: impl Fn(usize) -> &'a [f32], scratch: &mut Vec<f32>, pixels: &mut [[u8; 3]]) {
    let white = (0..channels).map(|c| color::white_level(plane(c), scratch)).fold(0.0, f32::max);
    if channels == 3 {
        color::intensity_rgb([0, 1, 2].map(plane), white, pixels);
    } else {
        color::intensity(plane(0), white, pixels);
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::output::Report;
    use crate::plane::Stack;

    /// Two pixels: unpolarized and fully polarized at 0°.
    pub(in crate::service) fn frame(channels: usize) -> Shown {
        let size = Size::new(2, 1);
        let one = [1.0, 1.0, 0.0, 1.0, 0.0, 0.0];
        let stokes = Stack::from_vec(3 * channels, size, one.repeat(channels)).unwrap();
        Shown {
            index: 0,
            arrived: std::time::Instant::now(),
            channels,
            sketched: true,
            raw: Sketch::of(&Stack::zeros(channels, size)),
            guide: Sketch::of(&Stack::zeros(channels, size)),
            guided: false,
            stokes,
            angle_list: Angle::four(),
            stage1: None,
            valid: vec![true; 2],
            report: Report::default(),
        }
    }

    #[test]
    fn every_view_has_its_own_name() {
        let names: Vec<_> = View::all(&Angle::four(), true).into_iter().map(View::name).collect();
        let expected = [
            "intensity",
            "dolp",
            "aolp",
            "aolp-saturation",
            "composite",
            "imin",
            "i0",
            "i45",
            "i90",
            "i135",
            "guide",
            "raw",
            "difference",
        ];
        assert_eq!(names, expected);
        let plain: Vec<_> = View::all(&[], false).into_iter().map(View::name).collect();
        assert_eq!(plain, ["intensity", "raw", "difference"]);
    }

    #[test]
    fn views_show_what_their_names_say_for_gray_and_colour() {
        for channels in [1, 3] {
            let (frame, mut painter) = (frame(channels), Painter::new(Size::new(2, 1)));
            let mut draw = |view| painter.draw(view, &frame, None).to_vec();
            assert_eq!(draw(View::Intensity), [[255; 3]; 2]);
            assert_eq!(draw(View::Dolp), [color::dolp_color(0.0), color::dolp_color(1.0)]);
            assert_eq!(draw(View::Aolp)[1], [255, 0, 0]);
            assert_eq!(draw(View::AolpSaturation), [[255; 3], [255, 0, 0]]);
            assert_eq!(draw(View::Imin), [[255; 3], [0; 3]]);
            assert_eq!(draw(View::Angle(Angle::from_degrees(90.0))), [[255; 3], [0; 3]]);
            assert_eq!(draw(View::Raw), [[0; 3]; 2]);
            let background = [frame.stokes_at(0, 0), 0.0];
            let changed = painter.draw(View::Difference, &frame, Some(&background)).to_vec();
            assert_eq!(changed, [color::difference_color(0.0), color::difference_color(1.0)]);
        }
    }
}
