//! The description of a network: its name, the tiles it is run on, and the number format of its arithmetic.

use std::borrow::Cow;
use std::fmt;

use super::tiles::Layout;
use crate::image::Size;

/// Side of a cell in pixels. A network computes on cells and answers for each pixel of a cell.
pub const CELL: usize = 4;
/// Features of each cell that a network is given: local ones, then those of the whole tile.
pub const FEATURES: usize = LOCAL_FEATURES + TILE_FEATURES;
/// Features computed from the pixels around a cell.
pub(crate) const LOCAL_FEATURES: usize = 36;
/// Features that the readings of the whole tile give, the same in every cell.
pub(crate) const TILE_FEATURES: usize = 19;
/// Candidates that a network weighs for each pixel.
pub const CANDIDATES: usize = 15;
/// Factor by which the back-projected residual is scaled, beside the division by rms(S0).
pub const RESIDUAL: f32 = 1e3;

/// Number format of a network's arithmetic. Which of them is faster depends on the processor.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, serde::Deserialize, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Precision {
    /// Single precision.
    #[default]
    F32,
    /// 8-bit integers.
    Int8,
}

impl Precision {
    /// All precisions.
    pub const ALL: [Self; 2] = [Self::F32, Self::Int8];
}

impl fmt::Display for Precision {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::F32 => "f32",
            Self::Int8 => "int8",
        })
    }
}

/// How frames are cut into square tiles for a network.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Tiling {
    /// Side of a tile in pixels, a multiple of `multiple`.
    pub tile: usize,
    /// Pixels along a tile's border whose result is taken from the neighbouring tile, at most [`Self::largest_halo`].
    pub halo: usize,
    /// Side in pixels of the network's coarsest cell, a multiple of 16. Tiles start at multiples of it.
    pub multiple: usize,
}

impl Tiling {
    /// The largest halo of tiles of `tile` pixels that start at multiples of `multiple`. With a larger one neighbouring tiles leave a
    /// gap between them.
    pub fn largest_halo(tile: usize, multiple: usize) -> usize {
        (tile / 3).min(tile.saturating_sub(multiple) / 2)
    }

    /// Whether the numbers fit each other.
    pub fn is_valid(self) -> bool {
        let Self { tile, halo, multiple } = self;
        let grid = multiple > 0 && multiple.is_multiple_of(16) && tile > 0 && tile.is_multiple_of(multiple);
        grid && halo <= Self::largest_halo(tile, multiple)
    }
}

/// A network as its manifest describes it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Model {
    /// Name, for reports.
    pub name: String,
    /// The tiles that the network is run on.
    pub tiling: Tiling,
}

impl Model {
    /// Shapes of the network's input and output for one tile, NCHW, f32: `[1, FEATURES, tile / CELL, tile / CELL]` and
    /// `[1, CELL² · CANDIDATES, tile / CELL, tile / CELL]`.
    pub fn shapes(&self) -> [[usize; 4]; 2] {
        let cells = self.tiling.tile / CELL;
        [FEATURES, CELL * CELL * CANDIDATES].map(|planes| [1, planes, cells, cells])
    }

    /// This model with tiles no larger than a frame with a longer side of `side` pixels needs.
    #[must_use]
    pub fn fitted(mut self, side: usize) -> Self {
        self.tiling.tile = self.tiling.tile.min(side.next_multiple_of(self.tiling.multiple));
        self
    }

    /// Multiply-adds for each pixel of a frame of `size`, of a network that takes `macs` for a tile. Overlaps of tiles count.
    pub fn macs_per_pixel(&self, macs: f64, size: Size) -> f64 {
        let tiling = self.clone().fitted(size.width.max(size.height)).tiling;
        let area = Layout::new(size, &tiling).count() * tiling.tile * tiling.tile;
        macs / self.tiling.tile.pow(2) as f64 * area as f64 / size.pixels() as f64
    }
}

/// A network's ONNX file in memory.
#[derive(Clone, Debug)]
pub struct Onnx {
    /// File name, for messages.
    pub name: String,
    /// Content of the file.
    pub bytes: Cow<'static, [u8]>,
    /// Number format of the arithmetic in it.
    pub precision: Precision,
}
