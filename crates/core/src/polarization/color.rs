//! Colours of intensities, degrees and angles: pure functions over slices, one colour per pixel, nothing allocated after the first call.
//!
//! Each mapping panics if its slices differ in length: that is a fault of the caller, not of the data. A value that is not
//! finite, or a pixel whose `shown` is false, is drawn as [`MASKED`].

use std::sync::LazyLock;

use crate::polarization::{aolp_degrees, dolp as degree, least_intensity};

/// Colour of a pixel without a valid value: mid gray.
pub const MASKED: [u8; 3] = [128; 3];
/// Quantile of a picture that is drawn white: a few highlights may clip, the rest stays visible.
pub const WHITE_QUANTILE: f32 = 0.995;
/// Part of the pixels whose degree of polarization is within an automatic scale.
pub const MOST_DEGREES: f32 = 0.98;
/// Fraction of the white level of S0 below which polarization is noise and not drawn.
pub const DARK_FRACTION: f32 = 0.02;

/// Way in which the degree of polarization enters a picture of its angle, which is always the hue.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AolpMode {
    /// Unpolarized is white, fully polarized saturated.
    Saturation,
    /// Unpolarized is black, fully polarized bright.
    Value,
}

/// The value that a `fraction` of the finite `values` does not exceed, or `None` if there are none. `scratch` is overwritten;
/// it grows to the number of values once.
pub fn quantile(values: &[f32], fraction: f32, scratch: &mut Vec<f32>) -> Option<f32> {
    scratch.clear();
    scratch.extend(values.iter().filter(|v| v.is_finite()));
    let rank = (fraction.clamp(0.0, 1.0) * scratch.len().checked_sub(1)? as f32).round() as usize;
    Some(*scratch.select_nth_unstable_by(rank, f32::total_cmp).1)
}

/// The level drawn white: [`WHITE_QUANTILE`] of `values`, or 1 where nothing is positive.
pub fn white_level(values: &[f32], scratch: &mut Vec<f32>) -> f32 {
    quantile(values, WHITE_QUANTILE, scratch).filter(|&white| white > 0.0).unwrap_or(1.0)
}

/// Marks the pixels whose polarization is drawn: those that are valid and brighter than [`DARK_FRACTION`] of the white level.
pub fn polarized_pixels(s0: &[f32], valid: &[bool], scratch: &mut Vec<f32>, shown: &mut [bool]) {
    assert!(s0.len() == valid.len() && s0.len() == shown.len());
    let dark = DARK_FRACTION * white_level(s0, scratch);
    for ((shown, &s0), &valid) in shown.iter_mut().zip(s0).zip(valid) {
        *shown = valid && s0 >= dark;
    }
}

/// Display code of a linear intensity, white at 1: the sRGB transfer curve (IEC 61966-2-1). Only intensities use it;
/// degrees and angles map to colours directly.
#[inline]
pub fn srgb(linear: f32) -> u8 {
    // 4096 steps are finer than the display's everywhere, and a power per pixel costs a live view its time.
    static CODES: LazyLock<[u8; 4097]> =
        LazyLock::new(|| std::array::from_fn(|i| (255.0 * encode(i as f32 / 4096.0)).round() as u8));
    CODES[(linear.clamp(0.0, 1.0) * 4096.0 + 0.5) as usize]
}

fn encode(linear: f32) -> f32 {
    if linear <= 0.003_130_8 { 12.92 * linear } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 }
}

/// Gray of a linear intensity, white at 1.
pub fn intensity_color(linear: f32) -> [u8; 3] {
    if linear.is_finite() { [srgb(linear); 3] } else { MASKED }
}

/// Colour of a degree of polarization, clamped to 0 … 1: from near black over violet and red to pale yellow, with lightness
/// growing evenly (in Oklab: Ottosson, A perceptual color space for image processing, 2020).
#[inline]
pub fn dolp_color(dolp: f32) -> [u8; 3] {
    static COLORS: LazyLock<[[u8; 3]; 256]> = LazyLock::new(|| std::array::from_fn(|i| ramp(i as f32 / 255.0)));
    if dolp.is_finite() { COLORS[(dolp.clamp(0.0, 1.0) * 255.0).round() as usize] } else { MASKED }
}

fn ramp(t: f32) -> [u8; 3] {
    let (sin, cos) = (285.0 + 175.0 * t).to_radians().sin_cos();
    // Black and white ends have no room for chroma; the middle has most.
    let chroma = 0.05 + 0.15 * (std::f32::consts::PI * t.powf(0.8)).sin().max(0.0);
    display(cones(0.12 + 0.84 * t, chroma * cos, chroma * sin))
}

/// Cube roots of the cone responses to a colour of Oklab. White has 1, 1, 1 and black 0, 0, 0.
fn cones(lightness: f32, a: f32, b: f32) -> [f32; 3] {
    [
        lightness + 0.396_337_78 * a + 0.215_803_76 * b,
        lightness - 0.105_561_346 * a - 0.063_854_17 * b,
        lightness - 0.089_484_18 * a - 1.291_485_5 * b,
    ]
}

#[inline]
fn display(cones: [f32; 3]) -> [u8; 3] {
    let [l, m, s] = cones.map(|v| v * v * v);
    [
        4.076_741_7 * l - 3.307_711_6 * m + 0.230_969_94 * s,
        -1.268_438 * l + 2.609_757_4 * m - 0.341_319_38 * s,
        -0.004_196_086 * l - 0.703_418_6 * m + 1.707_614_7 * s,
    ]
    .map(srgb)
}

/// Steps of the angle in the table of its colours: half a degree.
const ANGLES: usize = 360;

/// Colour of an angle in degrees, with period 180°: a circle in Oklab, red at 0°, yellow-green at 45°, cyan at 90° and violet at 135°. It
/// is darker where it is red and lighter where it is green, so that people who do not tell these apart see all angles too. `dolp` is
/// clamped to 0 … 1.
#[inline]
pub fn aolp_color(aolp_degrees: f32, dolp: f32, mode: AolpMode) -> [u8; 3] {
    static COLORS: LazyLock<[[f32; 3]; ANGLES]> = LazyLock::new(|| {
        std::array::from_fn(|i| {
            let (sin, cos) = (2.0 * 180.0 * i as f32 / ANGLES as f32 + 20.0).to_radians().sin_cos();
            cones(0.66 - 0.15 * cos, 0.14 * cos, 0.14 * sin)
        })
    });
    if !(aolp_degrees.is_finite() && dolp.is_finite()) {
        return MASKED;
    }
    let step = (aolp_degrees * (ANGLES as f32 / 180.0)).round().rem_euclid(ANGLES as f32) as usize;
    let strength = dolp.clamp(0.0, 1.0);
    display(COLORS[step % ANGLES].map(|pure| match mode {
        AolpMode::Saturation => 1.0 - strength * (1.0 - pure),
        AolpMode::Value => strength * pure,
    }))
}

/// Draws S0 in gray, `white` as white.
pub fn intensity(s0: &[f32], white: f32, out: &mut [[u8; 3]]) {
    assert_eq!(s0.len(), out.len());
    for (out, &s0) in out.iter_mut().zip(s0) {
        *out = intensity_color(s0 / white);
    }
}

/// Draws S0 in colour, from red, green and blue. One `white` for all channels keeps the sensor's balance.
pub fn intensity_rgb(s0: [&[f32]; 3], white: f32, out: &mut [[u8; 3]]) {
    assert!(s0.iter().all(|s| s.len() == out.len()));
    for (i, out) in out.iter_mut().enumerate() {
        let rgb = s0.map(|s| s[i] / white);
        *out = if rgb.iter().all(|v| v.is_finite()) { rgb.map(srgb) } else { MASKED };
    }
}

/// Draws the scene without glare ([`least_intensity`]) in gray; `white` is the white level of half of S0.
pub fn glare_reduced(stokes: [&[f32]; 3], white: f32, out: &mut [[u8; 3]]) {
    each(stokes, out, |s0, s1, s2| intensity_color(least_intensity(s0, s1, s2) / white));
}

/// Colour of a difference from −1 (blue) over 0 (near black) to 1 (orange), clamped.
pub fn difference_color(difference: f32) -> [u8; 3] {
    if !difference.is_finite() {
        return MASKED;
    }
    let strength = difference.clamp(-1.0, 1.0).abs();
    let end = if difference < 0.0 { [0.25, 0.62, 1.0] } else { [1.0, 0.60, 0.15] };
    end.map(|v: f32| (20.0 + 235.0 * strength * v).min(255.0) as u8)
}

/// Draws the difference of two images; a difference of `full` has the strongest colour.
pub fn difference(now: &[f32], before: &[f32], full: f32, out: &mut [[u8; 3]]) {
    assert!(now.len() == out.len() && before.len() == out.len());
    for ((out, now), before) in out.iter_mut().zip(now).zip(before) {
        *out = difference_color((now - before) / full);
    }
}

/// Draws the degree of linear polarization, with the end of its scale at `top`.
pub fn dolp(stokes: [&[f32]; 3], shown: &[bool], top: f32, out: &mut [[u8; 3]]) {
    each(stokes, out, |s0, s1, s2| dolp_color(degree(s0, s1, s2) / top));
    mask(shown, out);
}

/// Draws the angle of linear polarization. Its colour is pure where the degree is `top` or more.
pub fn aolp(stokes: [&[f32]; 3], shown: &[bool], mode: AolpMode, top: f32, out: &mut [[u8; 3]]) {
    each(stokes, out, |s0, s1, s2| aolp_color(aolp_degrees(s1, s2), degree(s0, s1, s2) / top, mode));
    mask(shown, out);
}

/// End of a scale that the degree of most of the `shown` pixels is within: 0.02, 0.05, 0.1, 0.2, 0.5 or 1. The scratch memory grows to the
/// number of pixels once.
pub fn dolp_top(stokes: [&[f32]; 3], shown: &[bool], degrees: &mut [f32], scratch: &mut Vec<f32>) -> f32 {
    assert!(degrees.len() == shown.len() && stokes.iter().all(|s| s.len() == shown.len()));
    for (i, out) in degrees.iter_mut().enumerate() {
        let [s0, s1, s2] = stokes.map(|s| s[i]);
        *out = if shown[i] { degree(s0, s1, s2) } else { f32::NAN };
    }
    scale_top(degrees, scratch)
}

/// End of a scale that most of the finite `degrees` are within: 0.02, 0.05, 0.1, 0.2, 0.5 or 1.
pub fn scale_top(degrees: &[f32], scratch: &mut Vec<f32>) -> f32 {
    let most = quantile(degrees, MOST_DEGREES, scratch).unwrap_or(1.0);
    [0.02, 0.05, 0.1, 0.2, 0.5].into_iter().find(|top| most <= *top).unwrap_or(1.0)
}

/// Draws the intensities behind ideal polarizers at 0°, 45° and 90° as red, green and blue: unpolarized light stays gray. `white` is the
/// white level of half of S0.
pub fn composite(stokes: [&[f32]; 3], shown: &[bool], white: f32, out: &mut [[u8; 3]]) {
    each(stokes, out, |s0, s1, s2| {
        let rgb = [s0 + s1, s0 + s2, s0 - s1].map(|twice| 0.5 * twice / white);
        if rgb.iter().all(|v| v.is_finite()) { rgb.map(srgb) } else { MASKED }
    });
    mask(shown, out);
}

fn each([s0, s1, s2]: [&[f32]; 3], out: &mut [[u8; 3]], color: impl Fn(f32, f32, f32) -> [u8; 3]) {
    assert!([s0, s1, s2].iter().all(|s| s.len() == out.len()));
    for (((out, &s0), &s1), &s2) in out.iter_mut().zip(s0).zip(s1).zip(s2) {
        *out = color(s0, s1, s2);
    }
}

fn mask(shown: &[bool], out: &mut [[u8; 3]]) {
    assert_eq!(shown.len(), out.len());
    for (out, _) in out.iter_mut().zip(shown).filter(|&(_, &shown)| !shown) {
        *out = MASKED;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_gray_curve_is_srgb() {
        for code in 0..=255u8 {
            let display = f32::from(code) / 255.0;
            let linear = if display <= 0.04045 { display / 12.92 } else { ((display + 0.055) / 1.055).powf(2.4) };
            assert!(srgb(linear).abs_diff(code) <= 1, "{code} came back as {}", srgb(linear));
        }
        assert_eq!((srgb(-1.0), srgb(2.0), intensity_color(f32::NAN)), (0, 255, MASKED));
    }

    #[test]
    fn the_degree_grows_lighter_at_every_step() {
        let luminance = |c: [u8; 3]| {
            let [r, g, b] = c.map(|v| (f32::from(v) / 255.0).powf(2.2));
            0.2126 * r + 0.7152 * g + 0.0722 * b
        };
        let steps: Vec<f32> = (0..=32).map(|i| luminance(dolp_color(i as f32 / 32.0))).collect();
        assert!(steps.windows(2).all(|w| w[1] > w[0]), "{steps:?}");
        assert!(steps[0] < 0.02 && steps[32] > 0.8, "{steps:?}");
        assert_eq!(dolp_color(7.0), dolp_color(1.0));
    }

    /// Oklab coordinates of a colour as people see it whose eyes mix its linear red, green and blue by the rows of `eyes`.
    fn seen(color: [u8; 3], eyes: &[[f32; 3]; 3]) -> [f32; 3] {
        let linear = |v: u8| {
            let v = f32::from(v) / 255.0;
            if v <= 0.040_45 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) }
        };
        let times = |m: &[[f32; 3]; 3], v: [f32; 3]| m.map(|row| row.iter().zip(v).map(|(a, b)| a * b).sum::<f32>());
        let mixed = times(eyes, color.map(linear)).map(|v| v.clamp(0.0, 1.0));
        let to_cones = [[0.412_22, 0.536_33, 0.051_45], [0.211_9, 0.680_7, 0.107_4], [0.088_3, 0.281_72, 0.629_98]];
        let to_lab = [[0.210_45, 0.793_62, -0.004_07], [1.978, -2.428_59, 0.450_59], [0.025_9, 0.782_77, -0.808_68]];
        times(&to_lab, times(&to_cones, mixed).map(f32::cbrt))
    }

    #[test]
    fn angles_are_told_apart_by_normal_and_by_colour_blind_eyes_and_degrees_too() {
        // Machado, Oliveira and Fernandes, A physiologically-based model for simulation of color vision deficiency, 2009
        let normal = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        let no_red = [[0.152_29, 1.052_58, -0.204_87], [0.114_5, 0.786_28, 0.099_22], [-0.003_88, -0.048_12, 1.052]];
        let no_green =
            [[0.367_32, 0.860_65, -0.227_97], [0.280_09, 0.672_5, 0.047_41], [-0.011_82, 0.042_94, 0.968_88]];
        let apart = |a: [f32; 3], b: [f32; 3]| a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f32>().sqrt();
        for eyes in [&normal, &no_red, &no_green] {
            let colors: Vec<_> =
                (0..36).map(|i| seen(aolp_color(5.0 * i as f32, 1.0, AolpMode::Value), eyes)).collect();
            let steps: Vec<f32> = (0..36).map(|i| apart(colors[i], colors[(i + 1) % 36])).collect();
            let (least, most) = steps.iter().fold((f32::MAX, 0.0f32), |(low, high), s| (low.min(*s), high.max(*s)));
            // 0.02 is about what can just be told apart
            assert!(least > 0.02 && most < 2.0 * least, "5° are {least} to {most}");
            for (i, a) in colors.iter().enumerate() {
                for k in 6..=30 {
                    assert!(apart(*a, colors[(i + k) % 36]) > 0.1, "{}° and {}°", 5 * i, 5 * (i + k) % 180);
                }
            }
            let degrees: Vec<_> = (0..=20).map(|i| seen(dolp_color(i as f32 / 20.0), eyes)).collect();
            assert!(degrees.windows(2).all(|w| apart(w[0], w[1]) > 0.02 && w[1][0] > w[0][0]), "{degrees:?}");
        }
    }

    #[test]
    fn the_angle_is_cyclic_and_its_strength_is_the_degree() {
        use AolpMode::{Saturation, Value};
        let [red, green, cyan, violet] = [0.0, 45.0, 90.0, 135.0].map(|d| aolp_color(d, 1.0, Value));
        assert!(red[0] > red[1] && red[0] > red[2] && cyan[1] > cyan[0] && cyan[2] > cyan[0], "{red:?} {cyan:?}");
        assert!(green[1] > green[2] && violet[2] > violet[1], "{green:?} {violet:?}");
        assert_eq!(aolp_color(120.0, 0.0, Saturation), [255; 3]);
        assert_eq!(aolp_color(120.0, 0.0, Value), [0; 3]);
        for angle in [0.0, 77.0, 179.9] {
            assert_eq!(aolp_color(angle, 1.0, Saturation), aolp_color(angle, 7.0, Value));
        }
        for mode in [Saturation, Value] {
            let (low, high) = (aolp_color(0.01, 0.7, mode), aolp_color(179.99, 0.7, mode));
            assert!(low.iter().zip(high).all(|(&a, b)| a.abs_diff(b) <= 1), "{low:?} beside {high:?}");
            assert_eq!(aolp_color(-45.0, 0.7, mode), aolp_color(135.0, 0.7, mode));
        }
    }

    #[test]
    fn a_scale_of_degrees_ends_where_most_of_them_do() {
        let s0 = vec![1.0; 100];
        let s1: Vec<f32> = (0..100).map(|i| if i == 99 { 0.9 } else { 0.04 }).collect();
        let (zero, mut degrees) = (vec![0.0; 100], vec![0.0; 100]);
        let mut top = |shown: &[bool]| dolp_top([&s0, &s1, &zero], shown, &mut degrees, &mut Vec::new());
        assert_eq!((top(&[true; 100]), top(&[false; 100])), (0.05, 1.0));
        let mut out = vec![MASKED; 100];
        dolp([&s0, &s1, &zero], &[true; 100], 0.05, &mut out);
        assert_eq!((out[0], out[99]), (dolp_color(0.8), dolp_color(1.0)));
    }

    #[test]
    fn unpolarized_light_is_gray_in_the_composite_and_keeps_its_brightness() {
        let stokes = [[0.8, 0.8].as_slice(), &[0.0, 0.8], &[0.0, 0.0]];
        let mut out = [[0; 3]; 2];
        composite(stokes, &[true; 2], 0.4, &mut out);
        assert_eq!(out, [[255; 3], [255, 255, 0]]);
        glare_reduced(stokes, 0.4, &mut out);
        assert_eq!(out, [[255; 3], [0; 3]]);
    }

    #[test]
    fn differences_have_a_colour_for_each_sign_and_none_for_nothing() {
        let mut out = [[0; 3]; 4];
        difference(&[1.0, 0.0, 0.5, f32::NAN], &[0.0, 1.0, 0.5, 0.0], 1.0, &mut out);
        let [more, less, same, lost] = out;
        assert!(more[0] > more[2] && less[2] > less[0] && same == [20; 3] && lost == MASKED, "{out:?}");
    }

    #[test]
    fn dark_and_invalid_pixels_are_not_drawn() {
        let s0 = [1.0, 1.0, 0.019, 0.021, f32::NAN];
        let mut shown = [false; 5];
        polarized_pixels(&s0, &[true, false, true, true, true], &mut Vec::new(), &mut shown);
        assert_eq!(shown, [true, false, false, true, false]);
        let mut out = [[0; 3]; 5];
        dolp([&s0, &[0.0; 5], &[0.0; 5]], &shown, 1.0, &mut out);
        assert_eq!(out.map(|c| c == MASKED), [false, true, true, false, true]);
    }

    #[test]
    fn quantiles_skip_what_is_not_finite() {
        let values: Vec<f32> = (0..=1000).rev().map(|i| i as f32).chain([f32::NAN, f32::INFINITY]).collect();
        assert_eq!(quantile(&values, WHITE_QUANTILE, &mut Vec::new()), Some(995.0));
        assert_eq!(quantile(&[f32::NAN], 0.5, &mut Vec::new()), None);
        assert_eq!(white_level(&[0.0; 4], &mut Vec::new()), 1.0);
    }
}
