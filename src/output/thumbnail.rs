use super::ResultImages;
use stokescope_core::image::{Picture, Size};
use stokescope_core::polarization::color;

/// Longest side of a thumbnail in pixels.
const SIDE: usize = 160;

/// Small picture of a result: intensities behind polarizers at 0°, 45° and 90° as red, green and blue, each pixel the mean of a square.
/// Without polarization it is gray.
pub fn thumbnail(result: &ResultImages<'_>) -> Picture {
    let Size { width, height } = result.size;
    let side = width.max(height).div_ceil(SIDE).max(1);
    let size = Size::new((width / side).max(1), (height / side).max(1));
    let mean = |component: usize| -> Vec<f32> {
        let block = |i: usize| {
            let (left, top) = (i % size.width * side, i / size.width * side);
            let rows = top..(top + side).min(height);
            let pixels = rows.flat_map(|y| (left..(left + side).min(width)).map(move |x| y * width + x));
            let (sum, count) = pixels.fold((0.0, 0.0), |(sum, n), at| (sum + result.stokes_at(component, at), n + 1.0));
            sum / count
        };
        (0..size.pixels()).map(block).collect()
    };
    let [s0, s1, s2] = [0, 1, 2].map(mean);
    let white = 0.5 * color::white_level(&s0, &mut Vec::new());
    let mut pixels = vec![color::MASKED; size.pixels()];
    color::composite([&s0[..], &s1, &s2], &vec![true; size.pixels()], white, &mut pixels);
    Picture { size, pixels }
}

#[cfg(test)]
mod tests {
    use super::*;
    use stokescope_core::image::Stack;

    #[test]
    fn a_thumbnail_is_small_and_shows_the_means_of_squares() {
        let size = Size::new(400, 200);
        let n = size.pixels();
        let mut values = vec![0.0; 3 * n];
        // the left half is bright, the right half polarized at 0°
        for i in 0..n {
            values[i] = 1.0;
            values[n + i] = if i % 400 < 198 { 0.0 } else { 1.0 };
        }
        let stokes = Stack::from_vec(3, size, values).unwrap();
        let (channels, valid) = (1, vec![true; n]);
        let images = ResultImages {
            size,
            channels,
            angles: None,
            angle_list: &[],
            stokes: &stokes,
            errors: None,
            valid: &valid,
            stage1: None,
        };
        let Picture { size, pixels } = thumbnail(&images);
        assert_eq!(size, Size::new(133, 66));
        let [left, right] = [pixels[0], pixels[132]];
        assert_eq!(left, [left[0]; 3], "unpolarized light is gray");
        assert!(right[0] == 255 && right[2] == 0, "{right:?}");
    }
}
