//! Panels: a picture at the top left, unscaled, and its legend in a dark strip at the right. Also notices and PNG files.

use std::io::{self, Write};
use std::path::Path;

use image::{ExtendedColorType, ImageEncoder, codecs::png::PngEncoder};

use super::font;
use crate::files::{WriteError, write_atomic};
use stokescope_core::image::{Picture, Size};
use stokescope_core::polarization::color::{AolpMode, aolp_color, dolp_color, intensity_color};

pub(super) const BACKGROUND: [u8; 3] = [20, 22, 26];
pub(super) const INK: [u8; 3] = [222, 224, 228];
/// Picture rows per step of legend size, so that the legend of a large picture is readable.
const ROWS_PER_STEP: usize = 640;
/// Size of the smallest legend in pixels.
const LEGEND: Size = Size::new(92, 152);

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
    let mut canvas = Canvas { picture: Picture { size: full, pixels }, left: size.width, top: 0, step };
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

/// A dark picture of `size` with `text`, wrapped and centred. Text that does not fit is left out.
pub fn notice(size: Size, text: &str) -> Picture {
    let step = (size.width / 400).min(size.height / (3 * font::HEIGHT)).max(1);
    let columns = (size.width / step / font::WIDTH).saturating_sub(2).max(1);
    let mut lines: Vec<String> = Vec::new();
    for word in text.split_whitespace() {
        match lines.last_mut() {
            Some(line) if line.chars().count() + 1 + word.chars().count() <= columns => {
                line.push(' ');
                line.push_str(word);
            }
            _ => lines.push(word.chars().take(columns).collect()),
        }
    }
    lines.truncate((size.height / step / font::HEIGHT).max(1));
    let mut canvas =
        Canvas { picture: Picture { size, pixels: vec![BACKGROUND; size.pixels()] }, left: 0, top: 0, step };
    let top = (canvas.height() / 2).saturating_sub(lines.len() * font::HEIGHT / 2);
    for (i, line) in lines.iter().enumerate() {
        if (top + (i + 1) * font::HEIGHT) * step <= size.height && font::width(line) * step <= size.width {
            canvas.text((size.width / step - font::width(line)) / 2, top + i * font::HEIGHT, line);
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
pub(super) fn number(value: f32) -> String {
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
pub(super) struct Canvas {
    pub(super) picture: Picture,
    pub(super) left: usize,
    pub(super) top: usize,
    pub(super) step: usize,
}

impl Canvas {
    /// Height of the strip in steps.
    fn height(&self) -> usize {
        (self.picture.size.height - self.top) / self.step
    }

    /// Fills a rectangle. `color` maps a position in it, 0 to 1 along each side, to a colour, or to `None` for no change.
    fn fill(&mut self, x: usize, y: usize, size: Size, color: impl Fn(f32, f32) -> Option<[u8; 3]>) {
        let (width, height) = (size.width * self.step, size.height * self.step);
        for row in 0..height {
            for column in 0..width {
                let (x, y) = (self.left + x * self.step + column, self.top + y * self.step + row);
                if let Some(c) = color((column as f32 + 0.5) / width as f32, (row as f32 + 0.5) / height as f32) {
                    self.picture.pixels[y * self.picture.size.width + x] = c;
                }
            }
        }
    }

    /// A line of the legend.
    pub(super) fn note(&mut self, y: usize, text: &str) {
        self.text(6, y, text);
    }

    fn text(&mut self, x: usize, y: usize, text: &str) {
        let at = (self.left + x * self.step, self.top + y * self.step);
        font::draw(&mut self.picture, at, text, self.step, INK);
    }

    pub(super) fn bar(&mut self, title: &str, color: impl Fn(f32) -> [u8; 3], label: impl Fn(usize) -> String) {
        let (top, height) = (32, (self.height() - 44).min(240));
        self.text(10, 4, title);
        self.fill(9, top - 1, Size::new(14, height + 2), |_, _| Some(INK));
        self.fill(10, top, Size::new(12, height), |_, v| Some(color(1.0 - v)));
        for quarter in 0..=4 {
            let y = top + height * (4 - quarter) / 4;
            self.fill(23, y - usize::from(quarter == 0), Size::new(3, 1), |_, _| Some(INK));
            self.text(29, y - font::HEIGHT / 2, &label(quarter));
        }
    }

    fn wheel(&mut self, mode: AolpMode) {
        self.angles("AoLP", mode);
        self.note(118, "DoLP 0-1");
    }

    /// A wheel of angles under a title. The distance from its centre is the brightness, or the saturation.
    pub(super) fn angles(&mut self, title: &str, mode: AolpMode) {
        self.text(6, 4, title);
        let (side, left, top) = (52, 6, 54);
        let soft = 2.0 / (side * self.step) as f32;
        self.fill(left, top, Size::new(side, side), |u, v| {
            // angles run counter-clockwise, rows downwards
            let (x, y) = (2.0 * u - 1.0, 1.0 - 2.0 * v);
            let radius = x.hypot(y);
            let color = aolp_color(y.atan2(x).to_degrees(), radius, mode);
            let cover = ((1.0 - radius) / soft).clamp(0.0, 1.0);
            let mut pixel = BACKGROUND;
            font::blend(&mut pixel, color, cover);
            (cover > 0.0).then_some(pixel)
        });
        self.text(left + side + 4, top + side / 2 - font::HEIGHT / 2, "0°");
        self.text(left + side - 4, top - 12, "45°");
        self.text(left + side / 2 - 9, top - font::HEIGHT - 3, "90°");
    }

    fn swatches(&mut self) {
        self.rows(&[([255, 0, 0], "0°"), ([0, 255, 0], "45°"), ([0, 0, 255], "90°")], 10);
    }

    /// Swatches of colours with their names, one below the other.
    pub(super) fn rows(&mut self, named: &[([u8; 3], &str)], top: usize) {
        for (i, (color, name)) in named.iter().enumerate() {
            let y = top + 24 * i;
            self.fill(10, y, Size::new(14, 14), |_, _| Some(*color));
            self.text(32, y - 1, name);
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
        // the wheel's centre is at (32, 80), its radius 26
        let at = |degrees: f32, r: f32| {
            let (sin, cos) = degrees.to_radians().sin_cos();
            p.pixels[(80.0 - r * sin) as usize * p.size.width + 1 + (32.0 + r * cos) as usize]
        };
        for degrees in [0.0, 60.0, 120.0] {
            let (drawn, pure) = (at(degrees, 16.0), aolp_color(degrees, 16.0 / 26.0, AolpMode::Saturation));
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
            let room = size.width > font::WIDTH && size.height > font::HEIGHT;
            assert_eq!(picture.pixels.iter().any(|pixel| pixel[0] > 100), room, "{size}");
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
