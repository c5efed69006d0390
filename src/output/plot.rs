//! Line plot with a logarithmic x axis, drawn into a [`Picture`].

use super::font;
use stokescope_core::image::{Picture, Size};

const SIZE: Size = Size::new(960, 600);
/// Margins of the axes in pixels: left, right, top, bottom. The legend is at the right.
const MARGINS: [f32; 4] = [60.0, 236.0, 68.0, 64.0];
const BACKGROUND: [u8; 3] = [255; 3];
const INK: [u8; 3] = [40, 44, 52];
const GRID: [u8; 3] = [222, 225, 230];
/// Curve colours, distinct for any colour vision (Okabe and Ito, 2008).
const COLORS: [[u8; 3]; 7] =
    [[0, 114, 178], [0, 158, 115], [230, 159, 0], [213, 94, 0], [86, 180, 233], [204, 121, 167], [90, 90, 90]];

/// One curve.
#[derive(Clone, Debug, PartialEq)]
pub struct Series {
    /// Name in the legend.
    pub name: String,
    /// Points (x, y) from left to right, x > 0. A single point with x = 0 is drawn as a horizontal line.
    pub points: Vec<(f64, f64)>,
}

/// Draws curves. Points that are not finite are left out.
pub fn plot(series: &[Series], title: &str, x_label: &str, y_label: &str) -> Picture {
    let finite = |p: &&(f64, f64)| p.0.is_finite() && p.1.is_finite();
    let points = || series.iter().flat_map(|s| s.points.iter().filter(finite));
    let range = |values: &mut dyn Iterator<Item = f64>| {
        values.fold((f64::INFINITY, f64::NEG_INFINITY), |(lo, hi), v| (lo.min(v), hi.max(v)))
    };
    let (x_low, x_high) = range(&mut points().map(|p| p.0).filter(|x| *x > 0.0).map(f64::log10));
    let (y_low, y_high) = range(&mut points().map(|p| p.1));
    // axes are drawn even without points
    let decades = if x_low <= x_high { (x_low.floor(), x_high.ceil().max(x_low.floor() + 1.0)) } else { (-3.0, 1.0) };
    let (y_low, y_high) = if y_low <= y_high { (y_low, y_high) } else { (0.0, 1.0) };
    let step = [1.0, 2.0, 5.0, 10.0, 20.0].into_iter().find(|s| (y_high - y_low) / s <= 8.0).unwrap_or(50.0);
    let levels = ((y_low / step).floor() * step, (y_high / step).ceil().max((y_low / step).floor() + 1.0) * step);

    let [left, right, top, bottom] = MARGINS;
    let (width, height) = (SIZE.width as f32, SIZE.height as f32);
    let column = |log: f64| left + ((log - decades.0) / (decades.1 - decades.0)) as f32 * (width - left - right);
    let row = |y: f64| height - bottom - ((y - levels.0) / (levels.1 - levels.0)) as f32 * (height - top - bottom);

    let mut canvas = Canvas(Picture { size: SIZE, pixels: vec![BACKGROUND; SIZE.pixels()] });
    canvas.text(12.0, 12.0, title, INK);
    for decade in decades.0 as i32..=decades.1 as i32 {
        let x = column(f64::from(decade));
        canvas.line((x, top), (x, height - bottom), 1.0, GRID);
        let label = 10f64.powi(decade).to_string();
        canvas.text(x - 0.5 * text_width(&label), height - bottom + 8.0, &label, INK);
    }
    for i in 0..=((levels.1 - levels.0) / step).round() as usize {
        let level = levels.0 + i as f64 * step;
        let label = format!("{level:.0}");
        canvas.line((left, row(level)), (width - right, row(level)), 1.0, GRID);
        canvas.text(left - 8.0 - text_width(&label), row(level) - 0.5 * font::HEIGHT as f32, &label, INK);
    }
    canvas.line((left, top), (left, height - bottom), 1.5, INK);
    canvas.line((left, height - bottom), (width - right, height - bottom), 1.5, INK);
    canvas.text(width - right - text_width(x_label), height - 28.0, x_label, INK);
    canvas.text(12.0, 40.0, y_label, INK);

    for (i, series) in series.iter().enumerate() {
        let color = COLORS[i % COLORS.len()];
        let at = |p: &(f64, f64)| (column(p.0.log10()), row(p.1));
        match series.points[..] {
            [(x, y)] if x <= 0.0 && y.is_finite() => canvas.line((left, row(y)), (width - right, row(y)), 2.0, color),
            _ => {
                let drawn: Vec<_> = series.points.iter().filter(finite).filter(|p| p.0 > 0.0).map(at).collect();
                drawn.windows(2).for_each(|pair| canvas.line(pair[0], pair[1], 2.5, color));
                drawn.iter().for_each(|p| canvas.line(*p, *p, 8.0, color));
            }
        }
        let (x, y) = (width - right + 16.0, top + 10.0 + 26.0 * i as f32);
        canvas.line((x, y), (x + 20.0, y), 4.0, color);
        canvas.text(x + 28.0, y - 0.5 * font::HEIGHT as f32, &series.name, INK);
    }
    canvas.0
}

fn text_width(text: &str) -> f32 {
    font::width(text) as f32
}

struct Canvas(Picture);

impl Canvas {
    /// Draws a line with round ends; equal end points make a disc.
    fn line(&mut self, a: (f32, f32), b: (f32, f32), thickness: f32, color: [u8; 3]) {
        let reach = 0.5 * thickness + 1.0;
        let span = |a: f32, b: f32, n: usize| {
            (a.min(b) - reach).max(0.0) as usize..((a.max(b) + reach).max(0.0) as usize + 1).min(n)
        };
        let (dx, dy) = (b.0 - a.0, b.1 - a.1);
        let length = (dx * dx + dy * dy).max(1e-6);
        for y in span(a.1, b.1, SIZE.height) {
            for x in span(a.0, b.0, SIZE.width) {
                let (px, py) = (x as f32 + 0.5 - a.0, y as f32 + 0.5 - a.1);
                let along = ((px * dx + py * dy) / length).clamp(0.0, 1.0);
                let distance = (px - along * dx).hypot(py - along * dy);
                let cover = (0.5 * thickness + 0.5 - distance).clamp(0.0, 1.0);
                font::blend(&mut self.0.pixels[y * SIZE.width + x], color, cover);
            }
        }
    }

    /// Draws text with its top left corner at (x, y), cut off at the edge of the picture.
    fn text(&mut self, x: f32, y: f32, text: &str, color: [u8; 3]) {
        font::draw(&mut self.0, (x.max(0.0).round() as usize, y.max(0.0).round() as usize), text, 1, color);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn series(points: &[(f64, f64)]) -> Series {
        Series { name: "guided".to_owned(), points: points.to_vec() }
    }

    /// Coordinates of the pixels of `color` within the axes.
    fn drawn(picture: &Picture, color: [u8; 3]) -> Vec<(usize, usize)> {
        let at = |i: usize| (i % SIZE.width, i / SIZE.width);
        let inside = |p: &(usize, usize)| p.0 < SIZE.width - MARGINS[1] as usize;
        (0..SIZE.pixels()).filter(|&i| picture.pixels[i] == color).map(at).filter(inside).collect()
    }

    #[test]
    fn more_time_is_right_and_less_error_is_up() {
        let picture = plot(&[series(&[(0.01, 20.0), (1.0, 40.0)])], "t", "x", "y");
        let pixels = drawn(&picture, COLORS[0]);
        let (first, last) = (pixels.iter().min_by_key(|p| p.0).unwrap(), pixels.iter().max_by_key(|p| p.0).unwrap());
        assert!(last.0 - first.0 > 500 && first.1 - last.1 > 400, "{first:?} {last:?}");
        // the middle of the logarithmic axis is at half the height
        let (x, y) = ((first.0 + last.0) / 2, (first.1 + last.1) / 2);
        assert_eq!(picture.pixels[y * SIZE.width + x], COLORS[0]);
    }

    #[test]
    fn a_point_without_time_is_a_horizontal_line() {
        let picture = plot(&[series(&[(1.0, 0.0), (2.0, 10.0)]), series(&[(0.0, 5.0)])], "", "", "");
        let pixels = drawn(&picture, COLORS[1]);
        assert!(pixels.len() > 500 && pixels.iter().all(|p| p.1.abs_diff(pixels[0].1) <= 2));
    }

    #[test]
    fn no_points_and_points_that_are_not_finite_are_plotted() {
        for points in [&[][..], &[(f64::NAN, 1.0), (1.0, f64::INFINITY)], &[(0.5, 3.0)]] {
            assert!(plot(&[series(points)], "t", "x", "y").pixels.contains(&INK));
        }
    }
}
