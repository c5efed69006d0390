//! Slices that the tasks of one [`Workers::run`] write at the same time, each task its own band.
//!
//! Bands are disjoint by construction, and every band is handed out once: a second `take` of the same band panics. So no
//! caller needs `unsafe`. Allocation: none.

use std::marker::PhantomData;
use std::ops::Range;
use std::sync::atomic::{AtomicU64, Ordering};

use super::{MAX_THREADS, Workers};

/// An array `[groups, rows, row_len]` cut along its rows into bands: band `i` holds the same rows of every group.
#[derive(Debug)]
struct Cut<'a, T> {
    start: *mut T,
    groups: usize,
    rows: usize,
    row_len: usize,
    bands: usize,
    /// Bit `i` is set once band `i` has been handed out.
    taken: AtomicU64,
    slice: PhantomData<&'a mut [T]>,
}

// SAFETY: a shared reference hands out disjoint `&mut [T]`, each once, which `T: Send` allows on any thread.
unsafe impl<T: Send> Sync for Cut<'_, T> {}
// SAFETY: it stands for `&'a mut [T]`.
unsafe impl<T: Send> Send for Cut<'_, T> {}

impl<'a, T> Cut<'a, T> {
    fn new(slice: &'a mut [T], groups: usize, rows: usize, bands: usize) -> Self {
        assert!(bands <= MAX_THREADS, "{bands} bands, more than {MAX_THREADS}");
        let row_len = slice.len().checked_div(groups * rows).unwrap_or(0);
        let len = groups * rows * row_len;
        assert_eq!(slice.len(), len, "the slice is not {groups} groups of {rows} rows of one length");
        let (start, taken) = (slice.as_mut_ptr(), AtomicU64::new(0));
        Self { start, groups, rows, row_len, bands, taken, slice: PhantomData }
    }

    /// The rows of band `band`, which is handed out no second time.
    fn claim(&self, band: usize) -> Range<usize> {
        assert!(band < self.bands, "band {band} of {}", self.bands);
        let before = self.taken.fetch_or(1 << band, Ordering::Relaxed);
        assert!(before & 1 << band == 0, "band {band} was taken before");
        cut(band, self.rows, self.bands)
    }
}

/// The rows of band `band`, when `rows` rows are cut into `bands` bands.
pub(super) fn cut(band: usize, rows: usize, bands: usize) -> Range<usize> {
    band * rows / bands..(band + 1) * rows / bands
}

/// A slice of rows, cut into bands of neighbouring rows.
#[derive(Debug)]
pub struct BandsMut<'a, T>(Cut<'a, T>);

impl<'a, T> BandsMut<'a, T> {
    /// Cuts `slice`, which holds `rows` rows of one length, into `bands` bands. Band `i` begins at row
    /// `i * rows / bands`; as many bands as rows are one row each.
    ///
    /// # Panics
    /// When the length of `slice` is no multiple of `rows`, or for more than [`MAX_THREADS`] bands.
    pub fn new(slice: &'a mut [T], rows: usize, bands: usize) -> Self {
        Self(Cut::new(slice, 1, rows, bands))
    }

    /// Band `band`.
    ///
    /// # Panics
    /// When there is no such band, or when it was taken before.
    pub fn take(&self, band: usize) -> &'a mut [T] {
        let rows = self.0.claim(band);
        // SAFETY: the rows lie within the slice, and no other band has them: the claim succeeds once.
        unsafe {
            let start = self.0.start.add(rows.start * self.0.row_len);
            std::slice::from_raw_parts_mut(start, rows.len() * self.0.row_len)
        }
    }

    /// The rows of band `band` with their numbers, from top to bottom.
    ///
    /// # Panics
    /// As [`Self::take`].
    pub fn take_rows(&self, band: usize) -> impl Iterator<Item = (usize, &'a mut [T])> + use<'a, T> {
        let (mut rest, row_len) = (self.take(band), self.0.row_len);
        cut(band, self.0.rows, self.0.bands).map(move |y| {
            let (row, below) = std::mem::take(&mut rest).split_at_mut(row_len);
            rest = below;
            (y, row)
        })
    }
}

/// A slice of which every task has one element: the tasks' own buffers.
#[derive(Debug)]
pub struct EachMut<'a, T>(BandsMut<'a, T>);

impl<'a, T> EachMut<'a, T> {
    /// Element `index`.
    ///
    /// # Panics
    /// When there is no such element, or when it was taken before.
    pub fn take(&self, index: usize) -> &'a mut T {
        &mut self.0.take(index)[0]
    }
}

/// An array `[groups, rows, row_len]`, cut into bands of neighbouring rows, the same of every group: planes cut into
/// bands of their rows, or an image cut into bands of its columns (a group is then a row of the image).
#[derive(Debug)]
pub struct StridedBandsMut<'a, T>(Cut<'a, T>);

impl<'a, T> StridedBandsMut<'a, T> {
    /// Cuts `slice`, which holds `groups` groups of `rows` rows of one length, into `bands` bands. Cuts lie as those of
    /// [`BandsMut::new`].
    ///
    /// # Panics
    /// When the length of `slice` is no multiple of `groups * rows`, or for more than [`MAX_THREADS`] bands.
    pub fn new(slice: &'a mut [T], groups: usize, rows: usize, bands: usize) -> Self {
        Self(Cut::new(slice, groups, rows, bands))
    }

    /// Band `band` of every group.
    ///
    /// # Panics
    /// When there is no such band, or when it was taken before.
    pub fn take(&self, band: usize) -> StridedMut<'a, T> {
        let Cut { groups, rows, row_len, .. } = self.0;
        let band = self.0.claim(band);
        // SAFETY: at most the end of the slice.
        let start = unsafe { self.0.start.add(if groups == 0 { 0 } else { band.start * row_len }) };
        StridedMut { start, groups, stride: rows * row_len, len: band.len() * row_len, slice: PhantomData }
    }
}

/// One band of every group of a [`StridedBandsMut`].
#[derive(Debug)]
pub struct StridedMut<'a, T> {
    start: *mut T,
    groups: usize,
    stride: usize,
    len: usize,
    slice: PhantomData<&'a mut [T]>,
}

// SAFETY: it stands for `&'a mut [T]` several times.
unsafe impl<T: Send> Send for StridedMut<'_, T> {}

impl<T> StridedMut<'_, T> {
    /// The band's rows of group `group`, one after another.
    ///
    /// # Panics
    /// When there is no such group.
    #[inline(always)]
    pub fn group(&self, group: usize) -> &[T] {
        assert!(group < self.groups, "group {group} of {}", self.groups);
        // SAFETY: within the slice; this band alone has these rows, and `self` is borrowed.
        unsafe { std::slice::from_raw_parts(self.start.add(group * self.stride), self.len) }
    }

    /// The band's rows of group `group`, to be written.
    ///
    /// # Panics
    /// When there is no such group.
    #[inline(always)]
    pub fn group_mut(&mut self, group: usize) -> &mut [T] {
        assert!(group < self.groups, "group {group} of {}", self.groups);
        // SAFETY: within the slice; this band alone has these rows, and `self` is borrowed exclusively.
        unsafe { std::slice::from_raw_parts_mut(self.start.add(group * self.stride), self.len) }
    }
}

impl Workers {
    /// `slice`, `rows` rows of one length, in one band for each thread: task `i` takes the rows [`Self::band`]`(i, rows)`.
    ///
    /// # Panics
    /// When the length of `slice` is no multiple of `rows`.
    pub fn bands_mut<'a, T>(&self, slice: &'a mut [T], rows: usize) -> BandsMut<'a, T> {
        BandsMut::new(slice, rows, self.threads())
    }

    /// `slice`, `groups` groups of `rows` rows of one length, in one band for each thread: task `i` takes the rows
    /// [`Self::band`]`(i, rows)` of every group.
    ///
    /// # Panics
    /// When the length of `slice` is no multiple of `groups * rows`.
    pub fn strided_bands_mut<'a, T>(&self, slice: &'a mut [T], groups: usize, rows: usize) -> StridedBandsMut<'a, T> {
        StridedBandsMut::new(slice, groups, rows, self.threads())
    }

    /// The first elements of `slice`, one for each thread.
    ///
    /// # Panics
    /// When there are fewer elements than threads.
    pub fn each_mut<'a, T>(&self, slice: &'a mut [T]) -> EachMut<'a, T> {
        let threads = self.threads();
        EachMut(BandsMut::new(&mut slice[..threads], threads, threads))
    }
}

#[cfg(test)]
mod tests {
    use std::panic::{AssertUnwindSafe, catch_unwind};

    use super::*;

    #[test]
    fn bands_cover_every_row_once() {
        for (threads, rows, row_len) in [(1, 5, 3), (3, 5, 2), (8, 5, 1), (3, 250, 4), (2, 0, 1), (2, 7, 0)] {
            let workers = Workers::new(threads);
            let mut values = vec![0usize; rows * row_len];
            let bands = workers.bands_mut(&mut values, rows);
            workers.run(workers.threads(), &|task| {
                let mut numbers = workers.band(task, rows);
                for (y, row) in bands.take_rows(task) {
                    assert_eq!((Some(y), row.len()), (numbers.next(), row_len));
                    row.iter_mut().for_each(|v| *v += 1 + y);
                }
                assert_eq!(numbers.next(), None);
            });
            assert!(values.iter().enumerate().all(|(i, v)| *v == 1 + i / row_len));
        }
    }

    #[test]
    fn strided_bands_cover_every_row_of_every_group_once() {
        for (threads, groups, rows, row_len) in [(1, 2, 5, 3), (3, 4, 5, 1), (5, 2, 3, 2), (2, 0, 3, 1), (2, 3, 0, 1)] {
            let workers = Workers::new(threads);
            let mut values = vec![0usize; groups * rows * row_len];
            let bands = workers.strided_bands_mut(&mut values, groups, rows);
            workers.run(workers.threads(), &|task| {
                let (mut band, numbers) = (bands.take(task), workers.band(task, rows));
                for group in 0..groups {
                    assert_eq!(band.group(group).len(), numbers.len() * row_len);
                    for (i, v) in band.group_mut(group).iter_mut().enumerate() {
                        *v += 1 + group * rows + numbers.start + i / row_len;
                    }
                }
            });
            assert!(values.iter().enumerate().all(|(i, v)| *v == 1 + i / row_len));
        }
    }

    #[test]
    fn every_task_has_an_element_of_its_own() {
        let (workers, mut buffers) = (Workers::new(3), [0; 4]);
        let each = workers.each_mut(&mut buffers);
        workers.run(3, &|task| *each.take(task) += 1 + task);
        assert_eq!(buffers, [1, 2, 3, 0]);
    }

    #[test]
    fn a_band_is_taken_once_and_only_if_there_is_one() {
        let mut values = [0; 6];
        let bands = BandsMut::new(&mut values, 3, 2);
        let refused = |band| catch_unwind(AssertUnwindSafe(|| bands.take(band).len())).is_err();
        assert!(!refused(1) && refused(1) && !refused(0) && refused(0) && refused(2));
        let mut values = [0; 12];
        let bands = StridedBandsMut::new(&mut values, 2, 3, 2);
        let refused = |band| catch_unwind(AssertUnwindSafe(|| bands.take(band).group(1).len())).is_err();
        assert!(!refused(1) && refused(1) && !refused(0) && refused(0) && refused(2));
    }

    #[test]
    fn what_lies_outside_is_refused() {
        let refused = |f: fn() -> usize| catch_unwind(f).is_err();
        assert!(refused(|| BandsMut::new(&mut [0; 7], 3, 2).0.rows), "7 values are not 3 rows");
        assert!(refused(|| BandsMut::new(&mut [0; 70], 70, 65).0.rows), "more bands than bits");
        assert!(refused(|| StridedBandsMut::new(&mut [0; 6], 2, 3, 1).take(0).group(2).len()), "two groups");
        assert!(refused(|| Workers::new(2).each_mut(&mut [0; 1]).0.0.rows), "fewer buffers than threads");
    }
}
