//! A network that is ready to run, and the boundary between the method and the library that runs it.

use std::fmt;
use std::sync::Arc;

use super::candidates::Candidates;
use super::model::{Model, Onnx, Precision};
use super::shares::Power;
#[cfg(feature = "fusion")]
use super::tract::import;
use crate::image::{Buffers, Size};
use crate::parallel::Workers;

/// A network planned for tiles of one size, by the library that runs it.
///
/// Input and output have the shapes of [`Model::shapes`].
pub trait Engine: fmt::Debug + Send + Sync {
    /// The state that one thread needs to run the network. Allocates.
    ///
    /// # Errors
    /// [`PlanError::Damaged`] when the engine refuses.
    fn runner(&self) -> Result<Box<dyn Runner>, PlanError>;

    /// Bytes of the weights in memory.
    fn weight_bytes(&self) -> usize;

    /// Bytes that one call of [`Runner::run`] allocates at its peak, at most.
    fn run_bytes(&self) -> usize;

    /// Multiply-adds of the network for one tile.
    fn macs(&self) -> u64;

    /// Number of constants in the network.
    fn parameters(&self) -> usize;
}

/// One thread's part of an [`Engine`].
pub trait Runner: fmt::Debug + Send {
    /// Runs the network on `features` and calls `take` once with its output. `team` may share the work.
    ///
    /// # Errors
    /// [`PlanError::Damaged`] when the engine fails.
    fn run(&mut self, features: &[f32], team: &Arc<Workers>, take: &mut dyn FnMut(&[f32])) -> Result<(), PlanError>;
}

/// Why a model cannot be run.
#[derive(Debug, thiserror::Error)]
pub enum PlanError {
    /// The program was built without the feature `fusion`.
    #[error("fusion model {name}: this program was built without the feature `fusion`; allowed: auto, off")]
    NoRuntime {
        /// The model.
        name: String,
    },
    /// The file cannot be imported or run.
    #[error("{file}: cannot be run: {message}")]
    Damaged {
        /// The file.
        file: String,
        /// The importer's message.
        message: String,
    },
    /// The engine does not know an operator.
    #[error("{file}: operator {operator} is unknown; allowed: the standard ONNX operators")]
    Operator {
        /// The file.
        file: String,
        /// The operator.
        operator: String,
    },
    /// The network has no or several inputs or outputs.
    #[error("{file}: the network has {found} {what}, expected 1")]
    Ports {
        /// The file.
        file: String,
        /// Inputs or outputs.
        what: &'static str,
        /// Their number.
        found: usize,
    },
    /// Input or output differ from what the manifest says.
    #[error("{file}: the network's {what} is {found}, its manifest makes it f32 {expected:?}")]
    Shape {
        /// The file.
        file: String,
        /// Input or output.
        what: &'static str,
        /// Shape by the manifest.
        expected: [usize; 4],
        /// Type and shape in the file.
        found: String,
    },
}

/// Plans a model's network for its tiles.
type Planner = dyn Fn(&Model) -> Result<Arc<dyn Engine>, PlanError> + Send + Sync;

/// A network that is ready to run. Clones share it.
#[derive(Clone)]
pub struct Network {
    model: Arc<Model>,
    precision: Precision,
    planner: Arc<Planner>,
    engine: Arc<dyn Engine>,
}

impl fmt::Debug for Network {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Network({:?}, {}, {:?})", self.model, self.precision, self.engine)
    }
}

impl Network {
    /// Imports, checks and optimizes an ONNX file. Allocates.
    ///
    /// # Errors
    /// [`PlanError`], with the file, what was expected and what was found.
    pub fn load(model: Model, onnx: Onnx) -> Result<Self, PlanError> {
        Self::with_engine(model, onnx.precision, move |model| import(model, &onnx))
    }

    /// A network that another engine runs. `plan` makes the engine for the tiles of a model, and is called again for frames that
    /// need smaller tiles. Allocates.
    ///
    /// # Errors
    /// Those of `plan`.
    ///
    /// # Panics
    /// When the numbers of the tiling do not fit each other.
    pub fn with_engine(
        model: Model,
        precision: Precision,
        plan: impl Fn(&Model) -> Result<Arc<dyn Engine>, PlanError> + Send + Sync + 'static,
    ) -> Result<Self, PlanError> {
        assert!(model.tiling.is_valid(), "{:?}", model.tiling);
        Self::planned(model, precision, Arc::new(plan))
    }

    fn planned(model: Model, precision: Precision, planner: Arc<Planner>) -> Result<Self, PlanError> {
        Ok(Self { engine: planner(&model)?, model: Arc::new(model), precision, planner })
    }

    /// This network with tiles no larger than a frame with a longer side of `side` pixels needs. Allocates.
    ///
    /// # Errors
    /// [`PlanError`] when the network does not take such a tile.
    pub(super) fn fitted(&self, side: usize) -> Result<Self, PlanError> {
        let model = Model::clone(&self.model).fitted(side);
        if model.tiling == self.model.tiling {
            Ok(self.clone())
        } else {
            Self::planned(model, self.precision, Arc::clone(&self.planner))
        }
    }

    /// Runs the network and its candidates on a single tile, for tests. `planes` are S0, S1, S2 in units of rms(S0) and the
    /// back-projected residual R0, R1, R2 in units of rms(S0)/[`RESIDUAL`](super::model::RESIDUAL), `[6, tile, tile]`. `power` is |K|² of
    /// the tile's frequencies in FFT order, `[tile, tile]`. Returns the correction of S1 and S2 in units of rms(S0),
    /// `[2, tile, tile]`. Allocates.
    ///
    /// # Errors
    /// [`PlanError::Damaged`] when the engine refuses.
    ///
    /// # Panics
    /// When `planes` or `power` has another length.
    pub fn answer(&self, planes: &[f32], power: &[f32]) -> Result<Vec<f32>, PlanError> {
        let buffers = Buffers::allocate(|buffers| TileBuffers::new(buffers, &self.model, 1));
        let mut runner = TileRunner::new(self, Arc::new(Workers::new(1)), buffers)?;
        assert_eq!(planes.len(), runner.planes().len(), "a tile of another network");
        runner.planes().copy_from_slice(planes);
        let mut correction = vec![0.0; 2 * self.model.tiling.tile.pow(2)];
        runner.run(&Power::new(power, self.model.tiling.tile), &mut correction)?;
        Ok(correction)
    }

    /// The engine that runs the network.
    pub fn engine(&self) -> &dyn Engine {
        &*self.engine
    }

    /// Multiply-adds of one tile: those of the network, and those that make and mix the candidates.
    pub fn macs(&self) -> u64 {
        self.engine.macs() + Candidates::macs(self.model.tiling.tile)
    }

    /// Multiply-adds for each pixel of a frame of `size`. Overlaps of tiles count.
    pub fn macs_per_pixel(&self, size: Size) -> f64 {
        self.model.macs_per_pixel(self.macs() as f64, size)
    }

    /// Description of the network.
    pub fn model(&self) -> &Model {
        &self.model
    }

    /// Number format of its arithmetic.
    pub fn precision(&self) -> Precision {
        self.precision
    }
}

/// Refuses every file: the program was built without an engine.
#[cfg(not(feature = "fusion"))]
fn import(model: &Model, _: &Onnx) -> Result<Arc<dyn Engine>, PlanError> {
    Err(PlanError::NoRuntime { name: model.name.clone() })
}

/// Runs a network on one tile at a time.
#[derive(Debug)]
pub(super) struct TileRunner {
    runner: Box<dyn Runner>,
    /// The threads that share the work of one tile.
    team: Arc<Workers>,
    buffers: TileBuffers,
}

/// The buffers of one tile, without those of the engine.
#[derive(Debug)]
pub(super) struct TileBuffers {
    /// S0, S1, S2, R0, R1, R2 of the tile as [`Network::answer`] takes them.
    planes: Vec<f32>,
    candidates: Candidates,
    /// `[FEATURES, tile / CELL, tile / CELL]`.
    features: Vec<f32>,
}

impl TileBuffers {
    /// For tiles of `model` that `threads` share.
    pub(super) fn new(buffers: &mut Buffers, model: &Model, threads: usize) -> Self {
        let side = model.tiling.tile;
        Self {
            planes: buffers.filled(0.0, super::candidates::PLANES * side * side),
            candidates: Candidates::new(buffers, side, threads),
            features: buffers.filled(0.0, model.shapes()[0].iter().product()),
        }
    }
}

impl TileRunner {
    /// Allocates inside the engine.
    pub(super) fn new(network: &Network, team: Arc<Workers>, buffers: TileBuffers) -> Result<Self, PlanError> {
        Ok(Self { runner: network.engine.runner()?, team, buffers })
    }

    /// S0, S1, S2, R0, R1, R2 of the tile to be run, `[6, tile, tile]`, as [`Network::answer`] takes them.
    pub(super) fn planes(&mut self) -> &mut [f32] {
        &mut self.buffers.planes
    }

    /// Corrects the tile in [`Self::planes`] behind a PSF of `power`. `correction` is `[2, tile, tile]`, in units of rms(S0). Allocates
    /// inside the engine.
    pub(super) fn run(&mut self, power: &Power, correction: &mut [f32]) -> Result<(), PlanError> {
        let Self { runner, team, buffers: TileBuffers { planes, candidates, features } } = self;
        candidates.describe(planes, power, features, team);
        runner.run(features, team, &mut |weights| candidates.mix(planes, weights, correction, team))
    }
}
