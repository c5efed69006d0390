//! The description of a network: the images it is given, the images it answers with, and the numbers it computes in.

use std::borrow::Cow;
use std::fmt;

/// Side in pixels of the cells for which a network of [`Kind::Mixes`] answers.
pub const CELL: usize = 4;
/// Planes that such a network is given of each cell: what it sees, and what the readings of the whole tile tell of its detail.
pub const GIVEN: usize = SEEN + TOLD;
pub(crate) const SEEN: usize = 36;
pub(crate) const TOLD: usize = 19;
/// Factor of the residual's planes for networks that mix.
pub const RESIDUAL: f32 = 1e3;
/// Candidates that such a network weighs for each pixel of a cell.
pub const CANDIDATES: usize = 15;

/// Number format of a model's arithmetic. Which is faster is a matter of the processor.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, serde::Deserialize, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Precision {
    /// Single precision.
    #[default]
    F32,
    /// 8 bit integers.
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

/// What a network takes and answers.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Deserialize, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Kind {
    /// It takes the planes its manifest names and answers with what is added to stage I.
    #[default]
    Adds,
    /// It takes what [`crate::fusion`] makes of all planes and answers with the weights of candidates: `[1, GIVEN, tile/4, tile/4]` →
    /// `[1, 16·CANDIDATES, tile/4, tile/4]`, for any tile.
    Mixes,
}

/// One image a network can be given. All are divided by the rms of the frame's S0.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, serde::Deserialize, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Plane {
    /// S0 of stage I.
    S0,
    /// S1 of stage I.
    S1,
    /// S2 of stage I.
    S2,
    /// Unpolarized part k̃ * (m0 ⊙ r) of what stage I left unexplained, r = y − A·x.
    R0,
    /// Real part of k̃ * (e ⊙ r).
    R1,
    /// Imaginary part of k̃ * (e ⊙ r).
    R2,
}

/// One input plane as the network takes it: scale · plane / rms(S0) + offset.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Feature {
    /// The image.
    pub plane: Plane,
    /// Its factor.
    pub scale: f32,
    /// What is added.
    pub offset: f32,
}

/// A network's input, `[1, planes, tile, tile]`.
#[derive(Clone, Debug, PartialEq)]
pub struct Input {
    /// Side of a tile, in pixels; a multiple of `multiple`.
    pub tile: usize,
    /// Pixels along a tile's border that are left to its neighbour.
    pub halo: usize,
    /// Side of the network's coarsest cell: tiles lie on this grid.
    pub multiple: usize,
    /// The planes in their order.
    pub features: Vec<Feature>,
}

/// A network's output, `[1, planes, tile, tile]`: what is added to stage I, in units of scale · rms(S0).
#[derive(Clone, Debug, PartialEq)]
pub struct Output {
    /// `[S1, S2]` or `[S0, S1, S2]`.
    pub planes: Vec<Plane>,
    /// Unit of the output.
    pub scale: f32,
}

/// A network's description, as a manifest has it.
#[derive(Clone, Debug, PartialEq)]
pub struct Model {
    /// Name, for reports.
    pub name: String,
    /// What the network itself takes and answers.
    pub kind: Kind,
    /// What is cut out of a frame for it.
    pub input: Input,
    /// What its answer is good for.
    pub output: Output,
}

impl Model {
    /// The network's own input and output for one tile, f32.
    pub fn ports(&self) -> [[usize; 4]; 2] {
        let (side, cells) = (self.input.tile, self.input.tile / CELL);
        match self.kind {
            Kind::Adds => [self.input.features.len(), self.output.planes.len()].map(|planes| [1, planes, side, side]),
            Kind::Mixes => [GIVEN, CELL * CELL * CANDIDATES].map(|planes| [1, planes, cells, cells]),
        }
    }

    /// This model with tiles no larger than a frame of `side` pixels needs, where the network takes tiles of any size.
    #[must_use]
    pub fn fitted(mut self, side: usize) -> Self {
        if self.kind != Kind::Adds {
            self.input.tile = self.input.tile.min(side.next_multiple_of(self.input.multiple));
        }
        self
    }
}

/// A network's ONNX file in memory.
#[derive(Clone, Debug)]
pub struct Onnx {
    /// Name of the file, for messages.
    pub name: String,
    /// Content of the file.
    pub bytes: Cow<'static, [u8]>,
    /// Number format of the arithmetic in it.
    pub precision: Precision,
}
