//! Row buffers of the threads.

use crate::optics::lanes::{LANES, Lanes};
use crate::optics::{Convolver, FftScratch};
use crate::solve::guided_filter::Reals;

/// Rows of x that are kept: the delay of the largest filter, the present row and the next.
pub(super) const RING: usize = 10;

/// Row buffers of one thread, for up to two unknowns.
#[derive(Debug)]
pub(in crate::solve) struct RowBuffers {
    pub(super) fft: FftScratch,
    /// The latest rows of x, padded.
    pub(super) ring: [Vec<Lanes>; 2],
    /// The row of x below the band.
    pub(super) next: [Vec<Lanes>; 2],
    /// The downward part of d − u in the latest row; at first, in the row above the band.
    pub(super) flow: [Vec<Lanes>; 2],
    /// x + u of the rows around the band that the filter reads: those above, then those below.
    pub(super) halo: Vec<Lanes>,
    /// x + u of a row.
    pub(super) input: Vec<Lanes>,
    pub(super) responses: [Vec<Lanes>; 2],
    pub(super) reals: [Vec<Reals>; 2],
}

impl RowBuffers {
    fn new(c: &Convolver) -> Self {
        let (lanes, blocks) = (c.size().width.div_ceil(LANES), c.row_lanes());
        let rows = |n: usize, width: usize| vec![Lanes::ZERO; n * width];
        let row = || rows(1, lanes);
        Self {
            fft: c.row_fft().make_scratch(),
            ring: [rows(RING, blocks), rows(RING, blocks)],
            next: [rows(1, blocks), rows(1, blocks)],
            flow: [row(), row()],
            halo: rows(2 * (RING - 2), lanes),
            input: row(),
            responses: [row(), row()],
            reals: [vec![[0.0; LANES]; lanes], vec![[0.0; LANES]; lanes]],
        }
    }

    /// Buffers for each thread. Allocates.
    pub(in crate::solve) fn for_threads(c: &Convolver) -> Vec<Self> {
        (0..c.workers().threads()).map(|_| Self::new(c)).collect()
    }

    /// Bytes of the buffers of all threads.
    pub(in crate::solve) fn bytes(c: &Convolver) -> usize {
        let (lanes, blocks) = (c.size().width.div_ceil(LANES), c.row_lanes());
        let rows = (2 * RING + 2) * blocks + (2 * (RING - 2) + 5) * lanes;
        let one = rows * size_of::<Lanes>() + 2 * lanes * size_of::<Reals>();
        c.workers().threads() * (one + c.row_fft().make_scratch().bytes())
    }
}
