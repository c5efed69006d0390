//! Field and frame: the part of the scene that is solved for, and the part of it that is shown.
//!
//! The diffuser spreads light over the PSF's reach, so that points outside of the frame send light onto the sensor. The *field* is the
//! frame plus a margin on every side. Readings exist in the frame alone: response maps are zero in the margin
//! ([`Response::within`](super::Response::within)), and so are the weights of the readings. With a margin of zero the scene is taken to be
//! dark outside of the frame.
//!
//! Allocation: none.

use std::ops::Range;

use super::Reach;
use crate::image::{Size, Stack};

/// Smallest level of a margin, below which it is as good as dark.
const DIMMEST: f32 = 0.01;

/// The frame and a margin around it, in pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Field {
    frame: Size,
    margin: Margin,
}

/// Pixels on each side of the frame.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Margin {
    /// Pixels to the left and to the right.
    pub columns: usize,
    /// Pixels above and below.
    pub rows: usize,
}

impl Margin {
    /// A margin of `pixels` on all sides.
    pub fn uniform(pixels: usize) -> Self {
        Self { columns: pixels, rows: pixels }
    }

    /// Pixels from which a PSF of this reach brings light into the frame.
    pub fn of_reach(reach: Reach) -> Self {
        Self { columns: reach.columns.0.max(reach.columns.1), rows: reach.rows.0.max(reach.rows.1) }
    }

    /// This margin, no larger than `most` on either axis.
    #[must_use]
    pub fn at_most(self, most: Self) -> Self {
        Self { columns: self.columns.min(most.columns), rows: self.rows.min(most.rows) }
    }

    /// True if there is none.
    pub fn is_none(self) -> bool {
        self == Self::default()
    }
}

impl Field {
    /// A frame with a margin around it.
    pub fn new(frame: Size, margin: Margin) -> Self {
        Self { frame, margin }
    }

    /// A frame alone.
    pub fn of_frame(frame: Size) -> Self {
        Self::new(frame, Margin::default())
    }

    /// Size of the frame.
    pub fn frame(self) -> Size {
        self.frame
    }

    /// The margin.
    pub fn margin(self) -> Margin {
        self.margin
    }

    /// Size of the field.
    pub fn size(self) -> Size {
        Size::new(self.frame.width + 2 * self.margin.columns, self.frame.height + 2 * self.margin.rows)
    }

    /// True if the field's pixel `i` lies in the frame.
    pub fn shows(self, i: usize) -> bool {
        let width = self.size().width;
        let (x, y) = ((i % width).wrapping_sub(self.margin.columns), (i / width).wrapping_sub(self.margin.rows));
        x < self.frame.width && y < self.frame.height
    }

    /// Columns of the field's row `y` that lie in the frame; none in a row above or below it.
    pub fn shown_columns(self, y: usize) -> Option<Range<usize>> {
        let Margin { columns, rows } = self.margin;
        (rows..rows + self.frame.height).contains(&y).then_some(columns..columns + self.frame.width)
    }

    /// Index in the field of the first pixel of row `y` of the frame.
    fn row(self, y: usize) -> usize {
        (y + self.margin.rows) * self.size().width + self.margin.columns
    }

    /// Root mean square of an image in the margin over that in the frame, from 0.01 to 100; 1 where there is no margin.
    pub fn level(self, image: &[f32]) -> f32 {
        if self.margin.is_none() {
            return 1.0;
        }
        let [mut frame, mut margin] = [0.0f64; 2];
        for (y, line) in image.chunks_exact(self.size().width).enumerate() {
            let square = |v: &[f32]| v.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>();
            let shown = self.shown_columns(y).map_or(0.0, |columns| square(&line[columns]));
            (frame, margin) = (frame + shown, margin + square(line) - shown);
        }
        let (inner, all) = (self.frame.pixels() as f64, self.size().pixels() as f64);
        let level = (margin / (all - inner) / (frame / inner)).sqrt();
        if level.is_finite() { (level as f32).clamp(DIMMEST, 1.0 / DIMMEST) } else { 1.0 }
    }

    /// Copies an image of the frame, row after row, into one of the field. The margin keeps its values.
    pub fn embed<T: Copy>(self, frame: &[T], field: &mut [T]) {
        let width = self.frame.width;
        for (y, line) in frame.chunks_exact(width).enumerate() {
            field[self.row(y)..][..width].copy_from_slice(line);
        }
    }

    /// Copies the frame's part of an image of the field.
    pub fn crop<T: Copy>(self, field: &[T], frame: &mut [T]) {
        let width = self.frame.width;
        for (y, line) in frame.chunks_exact_mut(width).enumerate() {
            line.copy_from_slice(&field[self.row(y)..][..width]);
        }
    }

    /// Subtracts the frame's part of an image of the field.
    pub fn subtract(self, field: &[f32], frame: &mut [f32]) {
        let width = self.frame.width;
        for (y, line) in frame.chunks_exact_mut(width).enumerate() {
            line.iter_mut().zip(&field[self.row(y)..][..width]).for_each(|(v, less)| *v -= less);
        }
    }

    /// [`Self::embed`] for every plane.
    pub fn embed_planes<T: Copy + Default>(self, frame: &Stack<T>, field: &mut Stack<T>) {
        frame.planes().zip(field.planes_mut()).for_each(|(frame, field)| self.embed(frame, field));
    }

    /// [`Self::crop`] for every plane.
    pub fn crop_planes<T: Copy + Default>(self, field: &Stack<T>, frame: &mut Stack<T>) {
        field.planes().zip(frame.planes_mut()).for_each(|(field, frame)| self.crop(field, frame));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cropped_embedding_is_the_frame() {
        let field = Field::new(Size::new(5, 3), Margin { columns: 2, rows: 1 });
        assert_eq!(field.size(), Size::new(9, 5));
        let frame: Vec<u32> = (1..=15).collect();
        let (mut whole, mut back) = (vec![0; 45], vec![0; 15]);
        field.embed(&frame, &mut whole);
        field.crop(&whole, &mut back);
        assert_eq!(back, frame);
        assert_eq!(whole.iter().sum::<u32>(), 120);
        assert!(whole.iter().enumerate().all(|(i, v)| field.shows(i) == (*v > 0)));
    }
}
