//! The part of a sensor that is used, and the blocks of its readings that become one.

use super::{Size, Stack};

/// Largest number of readings on a side of a block.
pub const MAX_BIN: usize = 16;

/// The used part of a camera's planes, cut into square blocks. The mean of a block is one reading of the working size.
///
/// Where polarizers of several angles lie on single pixels ([`Self::of_cells`]), a block has the readings behind one of them: those at the
/// place of the cell that the block has among the blocks. Block (X, Y) of cells of 2 × 2 pixels has the readings of every second column from
/// X mod 2 and of every second row from Y mod 2, so that the binned frame repeats as the camera's does.
///
/// ```
/// use stokescope_core::image::{Size, Window};
/// let window = Window::new(Size::new(1456, 1088), [228, 44], Size::new(1000, 1000), 4)?;
/// assert_eq!(window.working(), Size::new(250, 250));
/// # Ok::<(), stokescope_core::image::WindowError>(())
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Window {
    frame: Size,
    first: [usize; 2],
    size: Size,
    bin: usize,
    /// Columns and rows after which polarizers on single pixels repeat; 1 unless blocks hold several of them.
    cell: [usize; 2],
}

/// A window that does not fit the frame, or blocks that do not fit the window.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum WindowError {
    /// The window is empty or leaves the frame.
    #[error("crop of {size} pixels at ({}, {}), allowed: at least one pixel, within the frame of {frame}", first[0], first[1])]
    Crop {
        /// Column and row of the window's first pixel.
        first: [usize; 2],
        /// Size of the window.
        size: Size,
        /// Size of the camera's planes.
        frame: Size,
    },
    /// Blocks do not fill the window.
    #[error("bin = {bin} in a crop of {size} pixels, allowed: {}", WindowError::divisors(*size))]
    Bin {
        /// Readings on a side of a block.
        bin: usize,
        /// Size of the window.
        size: Size,
    },
    /// Blocks that do not hold whole cells of polarizers.
    #[error("bin = {bin} of polarizers that repeat after {} columns and {} rows, allowed: 1, or a multiple of both", cell[0], cell[1])]
    Cells {
        /// Readings on a side of a block.
        bin: usize,
        /// Columns and rows of a cell.
        cell: [usize; 2],
    },
}

impl WindowError {
    /// The numbers of readings that divide both sides of `size`, as a list.
    pub fn divisors(size: Size) -> String {
        let divides = |n: &usize| size.width.is_multiple_of(*n) && size.height.is_multiple_of(*n);
        let all: Vec<String> = (1..=MAX_BIN).filter(divides).map(|n| n.to_string()).collect();
        format!("{} (at most {MAX_BIN}, and a divisor of width and height)", all.join(", "))
    }
}

impl Window {
    /// All readings of planes of size `frame`, each by itself.
    pub const fn whole(frame: Size) -> Self {
        Self { frame, first: [0, 0], size: frame, bin: 1, cell: [1, 1] }
    }

    /// The pixels of `size` from column and row `first` of planes of size `frame`, in blocks of `bin` × `bin`.
    ///
    /// # Errors
    /// [`WindowError`] when the window leaves the frame or blocks do not fill it.
    pub fn new(frame: Size, first: [usize; 2], size: Size, bin: usize) -> Result<Self, WindowError> {
        let fits = |first: usize, size: usize, frame: usize| size > 0 && first <= frame && size <= frame - first;
        if !fits(first[0], size.width, frame.width) || !fits(first[1], size.height, frame.height) {
            return Err(WindowError::Crop { first, size, frame });
        }
        let divides = (1..=MAX_BIN).contains(&bin) && size.width.is_multiple_of(bin) && size.height.is_multiple_of(bin);
        if !divides {
            return Err(WindowError::Bin { bin, size });
        }
        Ok(Self { frame, first, size, bin, cell: [1, 1] })
    }

    /// This window of a camera with polarizers on single pixels that repeat after the columns and rows `cell`.
    ///
    /// # Errors
    /// [`WindowError::Cells`] when blocks of several readings do not hold whole cells.
    pub fn of_cells(self, cell: [usize; 2]) -> Result<Self, WindowError> {
        let bin = self.bin;
        match cell {
            _ if bin == 1 => Ok(self),
            _ if cell.iter().all(|side| bin.is_multiple_of(*side)) => Ok(Self { cell, ..self }),
            _ => Err(WindowError::Cells { bin, cell }),
        }
    }

    /// Size of the camera's planes.
    pub const fn frame(&self) -> Size {
        self.frame
    }

    /// Column and row of the first pixel.
    pub const fn first(&self) -> [usize; 2] {
        self.first
    }

    /// Size in the camera's pixels.
    pub const fn size(&self) -> Size {
        self.size
    }

    /// Readings on a side of a block.
    pub const fn bin(&self) -> usize {
        self.bin
    }

    /// Columns and rows of the camera between readings that go into one block.
    pub const fn cell(&self) -> [usize; 2] {
        self.cell
    }

    /// Readings of a plane that go into one block.
    pub const fn readings(&self) -> usize {
        self.bin * self.bin / (self.cell[0] * self.cell[1])
    }

    /// Blocks across and down: the size of the images that are worked with.
    pub const fn working(&self) -> Size {
        Size::new(self.size.width / self.bin, self.size.height / self.bin)
    }

    /// Whether every reading of the frame is used by itself.
    pub fn is_whole(&self) -> bool {
        *self == Self::whole(self.frame)
    }

    /// Means of the blocks of planes of the frame's size. Allocates.
    ///
    /// # Panics
    /// When the planes have another size.
    pub fn means(&self, planes: &Stack<f32>) -> Stack<f32> {
        assert_eq!(planes.size(), self.frame, "planes of another size than the frame");
        let mut out = Stack::zeros(planes.count(), self.working());
        for (from, to) in planes.planes().zip(out.planes_mut()) {
            for (i, to) in to.iter_mut().enumerate() {
                let sum: f64 = self.block(i).map(|at| f64::from(from[at])).sum();
                *to = (sum / self.readings() as f64) as f32;
            }
        }
        out
    }

    /// A PSF of the frame's size on the working grid: displacements are rounded to whole blocks, and a displacement halfway between two
    /// belongs to both by half. A displacement of zero stays one; displacements beyond the working size are left out. Allocates.
    ///
    /// # Panics
    /// When the planes have another size.
    pub fn psf(&self, planes: &Stack<f32>) -> Stack<f32> {
        assert_eq!(planes.size(), self.frame, "a PSF of another size than the frame");
        let Size { width, height } = self.working();
        let mut out = Stack::zeros(planes.count(), self.working());
        for (from, to) in planes.planes().zip(out.planes_mut()) {
            for (y, row) in from.chunks_exact(self.frame.width).enumerate() {
                for (ty, wy) in shares(y, self.frame.height, height, self.bin) {
                    for (x, v) in row.iter().enumerate().filter(|(_, v)| **v != 0.0) {
                        for (tx, wx) in shares(x, self.frame.width, width, self.bin) {
                            to[ty * width + tx] += wy * wx * v;
                        }
                    }
                }
            }
        }
        out
    }

    /// Places in a plane of the frame's size of the readings of block `index`, row by row.
    pub(crate) fn block(&self, index: usize) -> impl Iterator<Item = usize> + use<> {
        let Self { frame, first: [x, y], bin, cell: [w, h], .. } = *self;
        let across = self.size.width / bin;
        let (row, column) = (index / across, index % across);
        let start = (y + row * bin + row % h) * frame.width + x + column * bin + column % w;
        let (width, count) = (bin / w, self.readings());
        (0..count).map(move |k| start + k / width * h * frame.width + k % width * w)
    }
}

/// The samples of a binned PSF, `to` on a side, that sample `at` of `from` goes into, with its shares.
fn shares(at: usize, from: usize, to: usize, bin: usize) -> impl Iterator<Item = (usize, f32)> {
    let (displacement, bin) = (at as isize - (from / 2) as isize, bin as isize);
    // twice the displacement in blocks, rounded down and up
    let (low, high) = ((2 * displacement + bin - 1).div_euclid(2 * bin), (2 * displacement + bin).div_euclid(2 * bin));
    let place = move |block: isize| usize::try_from(block + (to / 2) as isize).ok().filter(|at| *at < to);
    [low, high].into_iter().filter_map(move |block| place(block).map(|at| (at, 0.5)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn windows_that_do_not_fit_are_refused_with_what_would() {
        let frame = Size::new(1456, 1088);
        let message = |first, size, bin| Window::new(frame, first, size, bin).unwrap_err().to_string();
        assert_eq!(
            message([500, 0], Size::new(1000, 1000), 4),
            "crop of 1000×1000 pixels at (500, 0), allowed: at least one pixel, within the frame of 1456×1088"
        );
        assert_eq!(
            message([0, 0], Size::new(1000, 1000), 3),
            "bin = 3 in a crop of 1000×1000 pixels, allowed: 1, 2, 4, 5, 8, 10 (at most 16, and a divisor of width and height)"
        );
        for (first, size, bin) in
            [([0, 0], Size::new(0, 8), 1), ([usize::MAX, 0], frame, 1), ([0, 0], frame, 0), ([0, 0], frame, 32)]
        {
            assert!(Window::new(frame, first, size, bin).is_err());
        }
        assert!(Window::new(frame, [0, 0], frame, 1).unwrap().is_whole());
        assert!(!Window::new(frame, [0, 0], frame, 2).unwrap().is_whole());
    }

    #[test]
    fn a_block_is_the_mean_of_its_readings() {
        let window = Window::new(Size::new(6, 4), [1, 1], Size::new(4, 2), 2).unwrap();
        let planes = Stack::from_vec(1, window.frame(), (0..24).map(|i| i as f32).collect()).unwrap();
        // 7 8 | 9 10 above 13 14 | 15 16
        assert_eq!(window.means(&planes).as_slice(), [10.5, 12.5]);
    }

    #[test]
    fn a_block_of_polarizers_has_the_readings_behind_one_of_them() {
        let window = Window::new(Size::new(9, 9), [1, 0], Size::new(8, 8), 4).unwrap().of_cells([2, 2]).unwrap();
        let block = |index| window.block(index).map(|at| [at % 9, at / 9]).collect::<Vec<_>>();
        assert_eq!(block(0), [[1, 0], [3, 0], [1, 2], [3, 2]]);
        assert_eq!(block(1), [[6, 0], [8, 0], [6, 2], [8, 2]]);
        assert_eq!(block(2), [[1, 5], [3, 5], [1, 7], [3, 7]]);
        assert_eq!(block(3), [[6, 5], [8, 5], [6, 7], [8, 7]]);
        assert_eq!(window.readings(), 4);
        let error = Window::new(Size::new(9, 9), [0, 0], Size::new(9, 9), 3).unwrap().of_cells([2, 2]).unwrap_err();
        assert_eq!(
            error.to_string(),
            "bin = 3 of polarizers that repeat after 2 columns and 2 rows, allowed: 1, or a multiple of both"
        );
        let single = Window::new(Size::new(9, 9), [1, 1], Size::new(7, 7), 1).unwrap();
        assert_eq!(single.of_cells([2, 2]), Ok(single), "readings that are used one by one are not mixed");
    }

    #[test]
    fn the_centre_of_a_psf_stays_its_centre() {
        for (frame, bin) in
            [(Size::new(40, 24), 4), (Size::new(45, 27), 3), (Size::new(20, 12), 1), (Size::new(50, 30), 5)]
        {
            let window = Window::new(frame, [0, 0], frame, bin).unwrap();
            let mut full = Stack::<f32>::zeros(1, frame);
            let centre = [frame.width / 2, frame.height / 2];
            let mut sum = [0.0f64; 3];
            for (k, [dx, dy]) in [[0, 0], [3, -2], [-5, 4], [2, 2], [-1, -3]].into_iter().enumerate() {
                let v = 1.0 + k as f32;
                let (x, y) = (centre[0].wrapping_add_signed(dx), centre[1].wrapping_add_signed(dy));
                full.plane_mut(0)[y * frame.width + x] = v;
                [f64::from(v), f64::from(v) * dx as f64, f64::from(v) * dy as f64]
                    .into_iter()
                    .zip(&mut sum)
                    .for_each(|(v, sum)| *sum += v);
            }
            let small = window.psf(&full);
            let Size { width, height } = small.size();
            let mut found = [0.0f64; 3];
            for (i, v) in small.as_slice().iter().enumerate().map(|(i, v)| (i, f64::from(*v))) {
                let at = |x: usize, n: usize| bin as f64 * (x as f64 - (n / 2) as f64);
                found[0] += v;
                found[1] += v * at(i % width, width);
                found[2] += v * at(i / width, height);
            }
            assert!((found[0] - sum[0]).abs() < 1e-5, "no light is lost");
            // every displacement moves by half a block at most, to either side
            let moved = [1, 2].map(|k| (found[k] - sum[k]) / sum[0]);
            assert!(moved.iter().all(|d| d.abs() <= 0.5 * (bin - 1) as f64), "{bin}: {moved:?}");
        }
        // symmetric light stays symmetric
        let window = Window::new(Size::new(32, 32), [0, 0], Size::new(32, 32), 4).unwrap();
        let mut full = Stack::<f32>::zeros(1, window.frame());
        (11..=21).for_each(|x| full.plane_mut(0)[16 * 32 + x] = 1.0);
        let small = window.psf(&full);
        assert_eq!(small.plane(0)[4 * 8 + 2..4 * 8 + 7], [0.0, 3.5, 4.0, 3.5, 0.0]);
    }
}
