//! Figures of calibration steps: the picture of a result with title, axes in pixels, and what its colours stand for.

use super::font;
use super::panel::{BACKGROUND, Canvas, INK, number};
use stokescope_core::calibrate::{Outcome, Scale};
use stokescope_core::image::{Picture, Size};
use stokescope_core::polarization::color::{AolpMode, intensity_color};

/// Least side of a picture in a figure: a smaller one is enlarged by a whole number.
const LEAST: usize = 240;
/// Rows or columns of a picture per step of the size of its type.
const PER_STEP: usize = 800;
/// Space around the picture, in steps: for the numbers of the rows, the title, the legend and the numbers of the columns.
const LEFT: usize = 5 * font::WIDTH + 14;
const TOP: usize = font::HEIGHT + 16;
const RIGHT: usize = 17 * font::WIDTH;
const BOTTOM: usize = 2 * font::HEIGHT + 12;
/// Least height of the picture's part, in steps, which the legend needs.
const LEGEND: usize = 176;

/// Draws the figure of a step's result.
pub fn figure(outcome: &Outcome) -> Picture {
    let Picture { size: own, pixels } = &outcome.picture;
    let enlarged = LEAST.div_ceil(own.width.min(own.height).max(1)).max(1);
    let shown = Size::new(own.width * enlarged, own.height * enlarged);
    let step = shown.width.max(shown.height).div_ceil(PER_STEP);
    let title = outcome.scale.title();
    let width = (LEFT * step + shown.width + RIGHT * step).max((LEFT + font::width(title) + 12) * step);
    let height = TOP * step + shown.height.max(LEGEND * step) + BOTTOM * step;
    let size = Size::new(width, height);
    let mut picture = Picture { size, pixels: vec![BACKGROUND; size.pixels()] };
    let (left, top) = (LEFT * step, TOP * step);
    for y in 0..shown.height {
        let row = &pixels[y / enlarged * own.width..][..own.width];
        let out = &mut picture.pixels[(top + y) * width + left..][..shown.width];
        out.iter_mut().enumerate().for_each(|(x, pixel)| *pixel = row[x / enlarged]);
    }
    font::draw(&mut picture, (left, 6 * step), title, step, INK);
    axes(&mut picture, *own, [left, top], enlarged, step);
    let mut canvas = Canvas { picture, left: left + shown.width + 6 * step, top, step };
    match &outcome.scale {
        Scale::Gray { unit, white, .. } => {
            canvas.bar(unit, intensity_color, |quarter| number(white * 0.25 * quarter as f32));
        }
        Scale::Angle { notes, .. } => {
            canvas.angles("angle", AolpMode::Value);
            notes.iter().enumerate().for_each(|(line, note)| canvas.note(114 + line * font::HEIGHT, note));
        }
        Scale::Overlay { green, magenta, .. } => {
            canvas.rows(&[([40, 200, 40], green), ([200, 40, 200], magenta), ([128; 3], "both agree")], 10);
        }
    }
    canvas.picture
}

/// Draws ticks and numbers of the columns below a picture of `size` and of the rows at its left.
fn axes(picture: &mut Picture, size: Size, [left, top]: [usize; 2], enlarged: usize, step: usize) {
    let (width, height) = (size.width * enlarged, size.height * enlarged);
    let mut tick = |x: usize, y: usize, w: usize, h: usize| {
        for at in 0..w * h {
            let (x, y) = (x + at % w, y + at / w);
            if x < picture.size.width && y < picture.size.height {
                picture.pixels[y * picture.size.width + x] = INK;
            }
        }
    };
    let middle = |number: usize| number * enlarged + enlarged / 2;
    let (columns, rows) = (ticks(size.width, width / step), ticks(size.height, height / step));
    for column in columns.clone() {
        tick(left + middle(column), top + height, step, 4 * step);
    }
    for row in rows.clone() {
        tick(left - 4 * step, top + middle(row), 4 * step, step);
    }
    for column in columns {
        let label = column.to_string();
        let x = (left + middle(column)).saturating_sub(font::width(&label) * step / 2);
        font::draw(picture, (x, top + height + 5 * step), &label, step, INK);
    }
    for row in rows {
        let label = row.to_string();
        let (x, y) = (left - (6 + font::width(&label)) * step, top + middle(row));
        font::draw(picture, (x, y.saturating_sub(font::HEIGHT * step / 2)), &label, step, INK);
    }
    let unit = "pixels";
    let x = left + (width / 2).saturating_sub(font::width(unit) * step / 2);
    font::draw(picture, (x, top + height + (5 + font::HEIGHT) * step), unit, step, INK);
}

/// Places of ticks on an axis of `count` pixels that is `length` steps long: round numbers, far enough apart for their labels.
fn ticks(count: usize, length: usize) -> impl Iterator<Item = usize> + Clone {
    let least = (count * 8 * font::WIDTH).div_ceil(length.max(1));
    let mut decades = std::iter::successors(Some(1), |decade| Some(10 * decade));
    let every = decades.find_map(|decade| [1, 2, 5].map(|m| m * decade).into_iter().find(|every| *every >= least));
    (0..count).step_by(every.unwrap_or(count).max(1))
}

#[cfg(test)]
mod tests {
    use super::*;
    use stokescope_core::calibrate::Step;

    fn outcome(size: Size, scale: Scale) -> Outcome {
        let pixels = (0..size.pixels()).map(|i| [(i % 251) as u8, (i / 251 % 251) as u8, 99]).collect();
        let picture = Picture { size, pixels };
        let (good, verdict, quality) = (true, String::new(), std::collections::BTreeMap::new());
        Outcome { step: Step::Dark, good, verdict, quality, remedy: None, picture, scale }
    }

    #[test]
    fn a_figure_has_every_pixel_of_its_picture_whatever_the_size() {
        for (size, enlarged) in
            [(Size::new(1, 1), 240), (Size::new(32, 48), 8), (Size::new(250, 240), 1), (Size::new(1700, 900), 1)]
        {
            for scale in [
                Scale::Gray { title: "Dark frame", unit: "counts", white: 3.5 },
                Scale::Angle {
                    title: "Polarizers of the mask, by the angle that passes most light",
                    notes: &["contrast", "0: dark", "1: bright"],
                },
                Scale::Overlay { title: "Guide", green: "lensless", magenta: "guide" },
            ] {
                let outcome = outcome(size, scale);
                let found = figure(&outcome);
                let step = (enlarged * size.width.max(size.height)).div_ceil(PER_STEP);
                for (i, pixel) in outcome.picture.pixels.iter().enumerate() {
                    let (x, y) = (i % size.width * enlarged, i / size.width * enlarged);
                    for (x, y) in [(x, y), (x + enlarged - 1, y + enlarged - 1)] {
                        let at = (TOP * step + y) * found.size.width + LEFT * step + x;
                        assert_eq!(found.pixels[at], *pixel, "{size} {i}");
                    }
                }
                assert_eq!(found.pixels.len(), found.size.pixels());
                assert!(
                    LEFT * step + font::width(outcome.scale.title()) * step < found.size.width,
                    "{size}: the title is whole"
                );
            }
        }
    }

    #[test]
    fn ticks_are_round_and_far_enough_apart() {
        for (count, length) in [(1, 240), (48, 384), (250, 250), (2028, 676), (7, 240)] {
            let places: Vec<usize> = ticks(count, length).collect();
            assert!(places[0] == 0 && places.iter().all(|place| *place < count), "{places:?}");
            let apart = places.windows(2).map(|pair| (pair[1] - pair[0]) * length / count).min();
            assert!(apart.is_none_or(|apart| apart >= 5 * font::WIDTH), "{places:?}");
            assert!(count < 2 || places.len() > 1, "{count} {length}: {places:?}");
        }
    }
}
