//! Panels: a picture at the top left, unscaled, and its legend in a dark strip at the right. Also notices and PNG files.

use std::io::{self, Write};
use std::path::Path;

use image::{ExtendedColorType, ImageEncoder, codecs::png::PngEncoder};

use super::font;
use crate::files::{WriteError, write_atomic};
use stokescope_core::image::{Picture, Size};
use stokescope_core::polarization::color::{AolpMode, aolp_color, dolp_color, intensity_color};

const BACKGROUND: [u8; 3] = [20, 22, 26];
const INK: [u8; 3] = [222, 224, 228];
/// Picture rows per step of legend size, so that the legend of a large picture is readable.
const ROWS_PER_STEP: usize = 320;
/// Size of the smallest legend in pixels.
const LEGEND: Size = Size::new(68, 112);

/// Legend of a picture.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Legend {
    /// Gray bar from 0 to `white`.
    Intensity {
        /// Value that is drawn white, in units of full scale.
        white: f32,
    },
    /// Colour bar from 0 to 100 %.
    Dolp,
    /// Colour wheel: the direction from its centre is AoLP, the distance DoLP.
    Aolp(AolpMode),
    /// Three colour swatches with their polarizer angles.
    Composite,
}

/// Adds a legend to the picture `pixels` of `size`, in the same memory. The panel is wider than the picture, and higher where the
/// legend is.
///
/// # Panics
/// If the number of `pixels` is not `size.pixels()`.
pub fn panel(size: Size, mut pixels: Vec<[u8; 3]>, legend: Legend) -> Picture {
    assert_eq!(pixels.len(), size.pixels());
    let step = size.height.div_ceil(ROWS_PER_STEP).max(1);
    let full = Size::new(size.width + LEGEND.width * step, size.height.max(LEGEND.height * step));
    pixels.resize(full.pixels(), BACKGROUND);
    // last row first, so that no row is overwritten before it is moved
    for row in (0..size.height).rev() {
        let to = row * full.width;
        pixels.copy_within(row * size.width..(row + 1) * size.width, to);
        pixels[to + size.width..to + full.width].fill(BACKGROUND);
    }
    let mut canvas = Canvas { picture: Picture { size: full, pixels }, left: size.width, step };
    match legend {
        Legend::Intensity { white } => {
            canvas.bar("S0", intensity_color, |quarter| number(white * 0.25 * quarter as f32));
        }
        Legend::Dolp => canvas.bar("DoLP", dolp_color, |quarter| format!("{}%", 25 * quarter)),
        Legend::Aolp(mode) => canvas.wheel(mode),
        Legend::Composite => canvas.swatches(),
    }
    canvas.picture
}

/// A dark picture of `size` with `text` in capitals, wrapped and centred. Text that does not fit is left out.
pub fn notice(size: Size, text: &str) -> Picture {
    let step = (size.width / 240).max(1);
    let (advance, line_height) = (font::WIDTH + 1, font::HEIGHT + 4);
    let columns = (size.width / step / advance).saturating_sub(2).max(1);
    let mut lines: Vec<String> = Vec::new();
    for word in text.to_uppercase().split_whitespace() {
        match lines.last_mut() {
            Some(line) if line.chars().count() + 1 + word.chars().count() <= columns => {
                line.push(' ');
                line.push_str(word);
            }
            _ => lines.push(word.chars().take(columns).collect()),
        }
    }
    lines.truncate((size.height / step / line_height).max(1));
    let mut canvas = Canvas { picture: Picture { size, pixels: vec![BACKGROUND; size.pixels()] }, left: 0, step };
    let top = (canvas.height() / 2).saturating_sub(lines.len() * line_height / 2);
    for (i, line) in lines.iter().enumerate() {
        let width = line.chars().count() * advance;
        if (top + i * line_height + font::HEIGHT) * step <= size.height && width * step <= size.width {
            canvas.text((size.width / step - width) / 2, top + i * line_height, line);
        }
    }
    canvas.picture
}

/// Writes a picture as an RGB PNG file, atomically.
///
/// # Errors
/// [`WriteError`] when the file cannot be written.
pub fn write_png(path: &Path, picture: &Picture) -> Result<(), WriteError> {
    write_atomic(path, |out| encode_png(picture, out))
}

/// Writes a picture as an RGB PNG to `out`.
///
/// # Errors
/// Those of `out`, or a picture without pixels.
pub fn encode_png(picture: &Picture, out: &mut dyn Write) -> io::Result<()> {
    let side = |n: usize| u32::try_from(n).map_err(io::Error::other);
    let (width, height) = (side(picture.size.width)?, side(picture.size.height)?);
    PngEncoder::new(out)
        .write_image(picture.pixels.as_flattened(), width, height, ExtendedColorType::Rgb8)
        .map_err(io::Error::other)
}

/// Formats a number with at most three significant digits.
fn number(value: f32) -> String {
    match value.abs() {
        0.0 => "0".to_owned(),
        size @ 0.001..10_000.0 => {
            let decimals = (2.0 - size.log10().floor()).max(0.0) as usize;
            let text = format!("{value:.decimals$}");
            if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.').to_owned() } else { text }
        }
        _ => format!("{value:.0e}"),
    }
}

/// The legend strip. Coordinates are in steps from its top left corner, so one drawing serves every size.
struct Canvas {
    picture: Picture,
    left: usize,
    step: usize,
}

impl Canvas {
    /// Height of the strip in steps.
    fn height(&self) -> usize {
        self.picture.size.height / self.step
    }

    /// Fills a rectangle. `color` maps a position in it, 0 to 1 along each side, to a colour, or to `None` for no change.
    fn fill(&mut self, x: usize, y: usize, size: Size, color: impl Fn(f32, f32) -> Option<[u8; 3]>) {
        let (width, height) = (size.width * self.step, size.height * self.step);
        for row in 0..height {
            for column in 0..width {
                let at = (y * self.step + row) * self.picture.size.width + self.left + x * self.step + column;
                if let Some(c) = color((column as f32 + 0.5) / width as f32, (row as f32 + 0.5) / height as f32) {
                    self.picture.pixels[at] = c;
                }
            }
        }
    }

    fn text(&mut self, x: usize, y: usize, text: &str) {
        for (i, c) in text.chars().enumerate() {
            let rows = font::rows(c);
            let size = Size::new(font::WIDTH, font::HEIGHT);
            self.fill(x + i * (font::WIDTH + 1), y, size, |u, v| {
                let (column, row) = ((u * font::WIDTH as f32) as usize, (v * font::HEIGHT as f32) as usize);
                (rows[row] >> (font::WIDTH - 1 - column) & 1 == 1).then_some(INK)
            });
        }
    }

    fn bar(&mut self, title: &str, color: impl Fn(f32) -> [u8; 3], label: impl Fn(usize) -> String) {
        let (top, height) = (24, (self.height() - 36).min(200));
        self.text(10, 8, title);
        self.fill(9, top - 1, Size::new(14, height + 2), |_, _| Some(INK));
        self.fill(10, top, Size::new(12, height), |_, v| Some(color(1.0 - v)));
        for quarter in 0..=4 {
            let y = top + height * (4 - quarter) / 4;
            self.fill(23, y - usize::from(quarter == 0), Size::new(3, 1), |_, _| Some(INK));
            self.text(29, y - font::HEIGHT / 2, &label(quarter));
        }
    }

    fn wheel(&mut self, mode: AolpMode) {
        self.text(10, 8, "AoLP");
        let (side, middle) = (44, 38);
        let soft = 2.0 / (side * self.step) as f32;
        self.fill(8, middle, Size::new(side, side), |u, v| {
            // angles run counter-clockwise, rows downwards
            let (x, y) = (2.0 * u - 1.0, 1.0 - 2.0 * v);
            let radius = x.hypot(y);
            let color = aolp_color(y.atan2(x).to_degrees(), radius, mode);
            let cover = ((1.0 - radius) / soft).clamp(0.0, 1.0);
            let blend = |i: usize| (f32::from(color[i]) * cover + f32::from(BACKGROUND[i]) * (1.0 - cover)) as u8;
            (cover > 0.0).then(|| [blend(0), blend(1), blend(2)])
        });
        self.text(55, middle + side / 2 - 3, "0°");
        self.text(48, middle - 5, "45°");
        self.text(24, middle - 10, "90°");
        self.text(4, middle + side + 5, "DoLP 0-1");
    }

    fn swatches(&mut self) {
        for (i, label) in ["0°", "45°", "90°"].into_iter().enumerate() {
            let y = 10 + 18 * i;
            let mut color = [0; 3];
            color[i] = 255;
            self.fill(10, y, Size::new(12, 12), |_, _| Some(color));
            self.text(28, y + 3, label);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LEGENDS: [Legend; 5] = [
        Legend::Intensity { white: 0.731 },
        Legend::Dolp,
        Legend::Aolp(AolpMode::Saturation),
        Legend::Aolp(AolpMode::Value),
        Legend::Composite,
    ];

    #[test]
    fn the_picture_is_unchanged_at_the_top_left() {
        for size in [Size::new(1, 1), Size::new(7, 250), Size::new(30, 321), Size::new(3, 1300)] {
            let pixels: Vec<[u8; 3]> = (0..size.pixels()).map(|i| [i as u8, (i >> 8) as u8, 7]).collect();
            for legend in LEGENDS {
                let Picture { size: full, pixels: drawn } = panel(size, pixels.clone(), legend);
                for (row, expected) in drawn.chunks(full.width).zip(pixels.chunks(size.width)) {
                    assert_eq!(&row[..size.width], expected, "{size} {legend:?}");
                }
                assert!(full.height >= size.height && drawn.contains(&INK));
            }
        }
    }

    #[test]
    fn the_wheel_shows_each_colour_where_its_angle_points() {
        let p = panel(Size::new(1, 1), vec![[0; 3]], Legend::Aolp(AolpMode::Saturation));
        // the wheel's centre is at (30, 60)
        let at = |degrees: f32, r: f32| {
            let (sin, cos) = degrees.to_radians().sin_cos();
            p.pixels[(60.0 - r * sin) as usize * p.size.width + 1 + (30.0 + r * cos) as usize]
        };
        for degrees in [0.0, 60.0, 120.0] {
            let (drawn, pure) = (at(degrees, 16.0), aolp_color(degrees, 16.0 / 22.0, AolpMode::Saturation));
            assert!(drawn.iter().zip(pure).all(|(a, b)| a.abs_diff(b) < 20), "{degrees}°: {drawn:?}, {pure:?}");
        }
        let [r, g, b] = at(90.0, 16.0);
        assert!(r < g && r < b, "{:?}", [r, g, b]);
        assert!(at(0.0, 0.0).iter().all(|&v| v > 230));
    }

    #[test]
    fn a_notice_is_written_inside_its_picture_whatever_the_size() {
        for size in [Size::new(1, 1), Size::new(16, 8), Size::new(250, 250), Size::new(2048, 64)] {
            let picture = notice(size, "Raw camera offline: no frame within 1000 ms, /dev/video0_with_a_long_name(1)");
            assert_eq!(picture.pixels.len(), size.pixels());
            assert_eq!(picture.pixels.contains(&INK), size.width > 1, "{size}");
        }
    }

    #[test]
    fn numbers_are_short() {
        let found = [0.0, 0.25, 0.731, 1.0, 1.5, 100.0, 9999.0, 65535.0, 0.0001].map(number);
        assert_eq!(found, ["0", "0.25", "0.731", "1", "1.5", "100", "9999", "7e4", "1e-4"]);
    }

    #[test]
    fn a_png_reads_back_as_drawn() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.png");
        let p = panel(Size::new(2, 2), vec![[1, 2, 3]; 4], Legend::Dolp);
        write_png(&path, &p).unwrap();
        let crate::files::Samples::U8(s) = crate::files::read_image(&path).unwrap() else { panic!("depth") };
        assert_eq!((s.size(), s.count()), (p.size, 3));
        assert!(p.pixels.iter().enumerate().all(|(i, c)| (0..3).all(|k| s.plane(k)[i] == c[k])));
    }
}
