//! Type of legends, plots and notices: Noto Sans Mono, as images of its letters.

use noto_sans_mono_bitmap::{FontWeight, RasterHeight, get_raster, get_raster_width};
use stokescope_core::image::Picture;

/// Height of a line in pixels.
pub(super) const HEIGHT: usize = 16;
/// Width of a letter in pixels, with the gap to the next one.
pub(super) const WIDTH: usize = get_raster_width(FontWeight::Regular, RasterHeight::Size16);

/// Width of a text in pixels.
pub(super) fn width(text: &str) -> usize {
    text.chars().count() * WIDTH
}

/// Draws `text` with its top left corner at (x, y), in letters `scale` times as large as [`HEIGHT`] and [`WIDTH`] say. What lies beyond the
/// edges of the picture is left out, and a letter that the type does not have is a question mark.
pub(super) fn draw(picture: &mut Picture, (x, y): (usize, usize), text: &str, scale: usize, ink: [u8; 3]) {
    // even scales are drawn from the larger images, whose width may differ by a pixel
    let (raster, dot) =
        if scale.is_multiple_of(2) { (RasterHeight::Size32, scale / 2) } else { (RasterHeight::Size16, scale) };
    let known = |c| get_raster(c, FontWeight::Regular, raster);
    for (i, letter) in text.chars().enumerate() {
        let Some(letter) = known(letter).or_else(|| known('?')) else { continue };
        let left = x + i * WIDTH * scale;
        for (row, covers) in letter.rows().enumerate() {
            for (column, cover) in covers.iter().enumerate().filter(|(_, cover)| **cover > 0) {
                for at in 0..dot * dot {
                    let (x, y) = (left + column * dot + at % dot, y + row * dot + at / dot);
                    if x < picture.size.width && y < picture.size.height {
                        blend(&mut picture.pixels[y * picture.size.width + x], ink, f32::from(*cover) / 255.0);
                    }
                }
            }
        }
    }
}

/// Covers a pixel with a share of a colour.
pub(super) fn blend(pixel: &mut [u8; 3], color: [u8; 3], cover: f32) {
    for (p, c) in pixel.iter_mut().zip(color) {
        *p = (f32::from(*p) + (f32::from(c) - f32::from(*p)) * cover).round() as u8;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use stokescope_core::image::Size;

    /// The columns and rows that a text covers, from its first to its last, in a dark picture.
    fn covered(text: &str, scale: usize) -> [usize; 4] {
        let size = Size::new(200, 80);
        let mut picture = Picture { size, pixels: vec![[0; 3]; size.pixels()] };
        draw(&mut picture, (10, 5), text, scale, [255; 3]);
        let inked = (0..size.pixels()).filter(|i| picture.pixels[*i][0] > 127);
        inked.fold([usize::MAX, 0, usize::MAX, 0], |[l, r, t, b], i| {
            let (x, y) = (i % size.width, i / size.width);
            [l.min(x), r.max(x), t.min(y), b.max(y)]
        })
    }

    #[test]
    fn letters_stay_within_their_lines_and_small_ones_are_lower() {
        for scale in [1, 2, 3] {
            let [left, right, top, bottom] = covered("Agjy°%", scale);
            assert!(left >= 10 && right < 10 + scale * width("Agjy°%"), "{left} {right}");
            assert!(top >= 5 && bottom < 5 + scale * HEIGHT, "{top} {bottom}");
        }
        assert!(covered("x", 1)[2] > covered("X", 1)[2], "lower case is lower");
        assert_eq!(covered("☃", 1), covered("?", 1));
    }

    #[test]
    fn text_beyond_the_edge_is_left_out() {
        let size = Size::new(24, 24);
        let mut picture = Picture { size, pixels: vec![[0; 3]; size.pixels()] };
        draw(&mut picture, (10, 3), "MMMM", 2, [255; 3]);
        assert!(picture.pixels.iter().any(|pixel| pixel[0] > 100));
    }
}
