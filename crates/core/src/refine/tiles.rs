//! Cuts a frame into overlapping square tiles and blends their results.
//!
//! Along each axis tiles start at multiples of the network's coarsest cell, so that its cells lie the same way in all tiles. Where a tile
//! reaches beyond the frame, the frame's border pixels are repeated. Where tiles overlap, the outermost `halo` pixels of each have
//! weight 0 and the rest is blended with a raised cosine. The weights of all tiles sum to 1 in every pixel.

use std::ops::Range;

use crate::image::Size;
use crate::refine::model::Tiling;

/// The tiles along one axis of the frame.
#[derive(Clone, Debug)]
struct Axis {
    len: usize,
    tiles: Vec<Span>,
}

/// One tile along one axis.
#[derive(Clone, Debug)]
struct Span {
    /// Position of the tile's first pixel in the frame; negative when the tile is larger than the frame.
    start: isize,
    /// Pixels of the frame that belong to this tile alone. The cores of all tiles cover the frame once.
    core: Range<usize>,
    /// Weight of each of the tile's pixels; 0 outside the frame.
    weights: Vec<f32>,
}

impl Axis {
    fn new(len: usize, tiling: &Tiling) -> Self {
        let Tiling { tile, halo, multiple } = *tiling;
        let blend = (halo / 2).max(1);
        let starts: Vec<isize> = if tile >= len {
            vec![-((tile - len) as isize / 2)]
        } else {
            let last = (len - tile).next_multiple_of(multiple);
            let stride = ((tile - 2 * halo - blend) / multiple * multiple).max(multiple);
            let count = last.div_ceil(stride);
            (0..=count).map(|k| (k * stride).min(last) as isize).collect()
        };
        let end = starts.len() - 1;
        let raised = |t: f32| 0.5 - 0.5 * (std::f32::consts::PI * t.clamp(0.0, 1.0)).cos();
        let edge = |inside: usize| raised((inside as f32 + 0.5 - halo as f32) / blend as f32);
        let raw = |k: usize, t: usize| {
            let left = if k == 0 { 1.0 } else { edge(t) };
            left * if k == end { 1.0 } else { edge(tile - 1 - t) }
        };
        let mut sum = vec![0.0; len];
        let inside = |k: usize, t: usize| usize::try_from(starts[k] + t as isize).ok().filter(|x| *x < len);
        for k in 0..=end {
            (0..tile).for_each(|t| inside(k, t).into_iter().for_each(|x| sum[x] += raw(k, t)));
        }
        let border = |k: usize| (starts[k] + tile as isize + starts[k + 1]) as usize / 2;
        let span = |k: usize| Span {
            start: starts[k],
            core: if k == 0 { 0 } else { border(k - 1) }..if k == end { len } else { border(k) },
            weights: (0..tile).map(|t| inside(k, t).map_or(0.0, |x| raw(k, t) / sum[x])).collect(),
        };
        Self { len, tiles: (0..=end).map(span).collect() }
    }
}

/// The tiles of a frame, row by row.
#[derive(Clone, Debug)]
pub(super) struct Layout {
    size: Size,
    tile: usize,
    columns: Axis,
    rows: Axis,
}

impl Layout {
    /// Cuts frames of `size` into tiles. Allocates.
    pub(super) fn new(size: Size, tiling: &Tiling) -> Self {
        Self { size, tile: tiling.tile, columns: Axis::new(size.width, tiling), rows: Axis::new(size.height, tiling) }
    }

    /// Number of tiles.
    pub(super) fn count(&self) -> usize {
        self.columns.tiles.len() * self.rows.tiles.len()
    }

    fn spans(&self, index: usize) -> (&Span, &Span) {
        let columns = self.columns.tiles.len();
        (&self.rows.tiles[index / columns], &self.columns.tiles[index % columns])
    }

    /// Rows and columns of the frame that belong to tile `index` alone.
    pub(super) fn core(&self, index: usize) -> (Range<usize>, Range<usize>) {
        let (rows, columns) = self.spans(index);
        (rows.core.clone(), columns.core.clone())
    }

    /// Copies tile `index` out of a plane of the frame, each value times `scale`.
    pub(super) fn cut(&self, index: usize, plane: &[f32], tile: &mut [f32], scale: f32) {
        let (rows, columns) = self.spans(index);
        let clamp = |start: isize, t: usize, len: usize| (start + t as isize).clamp(0, len as isize - 1) as usize;
        let (skip, inside) = self.within(columns);
        for (ty, out) in tile.chunks_exact_mut(self.tile).enumerate() {
            let row = &plane[clamp(rows.start, ty, self.rows.len) * self.size.width..][..self.size.width];
            let (before, rest) = out.split_at_mut(skip);
            let (middle, after) = rest.split_at_mut(inside.len());
            before.fill(scale * row[0]);
            middle.iter_mut().zip(&row[inside.clone()]).for_each(|(to, v)| *to = scale * v);
            after.fill(scale * row[row.len() - 1]);
        }
    }

    /// Number of pixels of a tile's row left of the frame, and the columns of the frame that follow.
    fn within(&self, columns: &Span) -> (usize, Range<usize>) {
        let skip = usize::try_from(-columns.start).unwrap_or(0);
        let x = usize::try_from(columns.start).unwrap_or(0);
        (skip, x..(x + self.tile - skip).min(self.size.width))
    }

    /// Calls `visit(frame row's first pixel, tile row's first pixel, weight of the row, weights of the row's pixels)` for the
    /// part of each tile row that lies in the frame.
    pub(super) fn for_rows(&self, index: usize, mut visit: impl FnMut(usize, usize, f32, &[f32])) {
        let (rows, columns) = self.spans(index);
        let (skip, inside) = self.within(columns);
        for (ty, weight) in rows.weights.iter().enumerate().filter(|(_, w)| **w > 0.0) {
            let y = (rows.start + ty as isize) as usize;
            let weights = &columns.weights[skip..skip + inside.len()];
            visit(y * self.size.width + inside.start, ty * self.tile + skip, *weight, weights);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZES: [Size; 4] = [Size::new(250, 131), Size::new(20, 16), Size::new(33, 64), Size::new(1, 5)];

    #[test]
    fn weights_sum_to_one_and_cores_cover_once() {
        for (tile, multiple) in [(32, 4), (32, 1), (16, 16), (32, 16), (64, 8), (48, 16), (256, 16), (256, 64)] {
            let halos = [0, Tiling::largest_halo(tile, multiple) / 2, Tiling::largest_halo(tile, multiple)];
            for (halo, size) in halos.into_iter().flat_map(|halo| SIZES.map(|size| (halo, size))) {
                let layout = Layout::new(size, &Tiling { tile, halo, multiple });
                let (mut sum, mut covered) = (vec![0.0f32; size.pixels()], vec![0; size.pixels()]);
                for t in 0..layout.count() {
                    layout.for_rows(t, |at, _, row, weights| {
                        sum[at..].iter_mut().zip(weights).for_each(|(s, w)| *s += row * w);
                    });
                    let (rows, columns) = layout.core(t);
                    rows.for_each(|y| columns.clone().for_each(|x| covered[y * size.width + x] += 1));
                }
                assert!(sum.iter().all(|s| (s - 1.0).abs() < 1e-5), "{tile} {halo} {multiple} {size}");
                assert!(covered.iter().all(|c| *c == 1), "{tile} {halo} {multiple} {size}");
            }
        }
    }

    #[test]
    fn cutting_and_pasting_gives_the_frame_back() {
        let size = Size::new(101, 67);
        let plane: Vec<f32> = (0..size.pixels()).map(|i| (i * 7919 % 1013) as f32).collect();
        for (tile, halo, multiple) in [(32, 8, 4), (128, 8, 4), (80, 10, 5)] {
            let layout = Layout::new(size, &Tiling { tile, halo, multiple });
            let (mut buffer, mut back) = (vec![f32::NAN; tile * tile], vec![0.0; size.pixels()]);
            for t in 0..layout.count() {
                layout.cut(t, &plane, &mut buffer, 1.0);
                let (rows, columns) = layout.spans(t);
                for (i, v) in buffer.iter().enumerate() {
                    let at =
                        |start: isize, t: usize, len: usize| (start + t as isize).clamp(0, len as isize - 1) as usize;
                    let (y, x) = (at(rows.start, i / tile, size.height), at(columns.start, i % tile, size.width));
                    assert_eq!(*v, plane[y * size.width + x], "tile {t} of {tile}, pixel {i}");
                }
                layout.for_rows(t, |at, from, row, weights| {
                    let pixels = back[at..].iter_mut().zip(&buffer[from..]).zip(weights);
                    pixels.for_each(|((b, v), w)| *b += row * w * v);
                });
            }
            assert!(back.iter().zip(&plane).all(|(a, b)| (a - b).abs() < 1e-3), "{tile} {halo} {multiple}");
        }
    }

    #[test]
    fn the_halo_of_inner_borders_counts_for_nothing() {
        let layout = Layout::new(Size::new(100, 10), &Tiling { tile: 32, halo: 6, multiple: 2 });
        assert!(layout.count() > 3);
        for t in 0..layout.count() {
            let (_, columns) = layout.spans(t);
            let zero = |range: Range<usize>| columns.weights[range].iter().all(|w| *w == 0.0);
            assert!((t == 0 || zero(0..6)) && (t + 1 == layout.count() || zero(26..32)), "tile {t}");
        }
    }
}
