//! A network that is ready to run, and one thread's part of running it on tiles.

use std::sync::Arc;

use super::engine::{Engine, State};
use super::mixer::Mixer;
use super::model::{Kind, Model, Onnx, Precision};
use super::shares::Power;
use super::tiles::Layout;
use crate::image::Size;
use crate::parallel::Workers;

/// Why a model cannot be run.
#[derive(Debug, thiserror::Error)]
pub enum PlanError {
    /// The program was built without the feature `fusion`.
    #[error("fusion model {name}: this program was built without the feature `fusion`; allowed: auto, off")]
    NoRuntime {
        /// The model.
        name: String,
    },
    /// Not a network that can be imported.
    #[error("{file}: cannot be run: {message}")]
    Damaged {
        /// The file.
        file: String,
        /// What the importer says.
        message: String,
    },
    /// An operator the engine does not know.
    #[error("{file}: operator {operator} is unknown; allowed: the standard ONNX operators")]
    Operator {
        /// The file.
        file: String,
        /// The operator.
        operator: String,
    },
    /// Several inputs or outputs, or none.
    #[error("{file}: the network has {found} {what}, expected 1")]
    Ports {
        /// The file.
        file: String,
        /// Inputs or outputs.
        what: &'static str,
        /// How many.
        found: usize,
    },
    /// Input or output are not what the manifest says.
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

/// A model that is ready to run. Clones share it.
#[derive(Clone, Debug)]
pub struct Network {
    model: Arc<Model>,
    onnx: Arc<Onnx>,
    pub(super) engine: Engine,
}

impl Network {
    /// Reads, proves and optimizes a model. Allocates.
    ///
    /// # Errors
    /// [`PlanError`], naming file, what was expected and what was found.
    pub fn load(model: Model, onnx: Onnx) -> Result<Self, PlanError> {
        Ok(Self { engine: Engine::new(&model, &onnx)?, model: Arc::new(model), onnx: Arc::new(onnx) })
    }

    /// The same with tiles no larger than a frame of `side` pixels needs. Allocates.
    ///
    /// # Errors
    /// [`PlanError`] when the network does not take such a tile.
    #[cfg_attr(not(feature = "fusion"), expect(unreachable_code, reason = "without an engine there is no network"))]
    pub(super) fn fitted(&self, side: usize) -> Result<Self, PlanError> {
        let model = (*self.model).clone().fitted(side);
        if model.input.tile == self.model.input.tile {
            Ok(self.clone())
        } else {
            Self::load(model, Onnx::clone(&self.onnx))
        }
    }

    /// The answer to one tile, `[planes, tile, tile]` each, without what the manifest says of units, behind a PSF of `power`
    /// (|K|² of a tile's frequencies, `[tile, tile]`; models that mix look at it): what tests and timings compare. Allocates.
    ///
    /// # Errors
    /// [`PlanError::Damaged`] when the engine refuses.
    ///
    /// # Panics
    /// When `input` or `power` is no tile.
    pub fn answer(&self, input: &[f32], power: &[f32]) -> Result<Vec<f32>, PlanError> {
        let mut lane = Lane::new(self, Arc::new(Workers::new(1)))?;
        assert_eq!(input.len(), lane.tile.len(), "a tile of another network");
        lane.tile.copy_from_slice(input);
        let mut answer = vec![0.0; self.model.output.planes.len() * self.model.input.tile.pow(2)];
        lane.run(&self.engine, Some(&Power::of(power, self.model.input.tile)), &mut answer)?;
        Ok(answer)
    }

    /// For each of `networks` the shortest of `runs` runs of it alone, without candidates and mixing, on a tile \[s\]; one thread. They
    /// take turns, so that a slow moment of the machine is one for all of them. Allocates.
    ///
    /// # Errors
    /// [`PlanError::Damaged`] when the engine refuses.
    pub fn shortest_runs(networks: &[Self], runs: usize) -> Result<Vec<f64>, PlanError> {
        let alone = Arc::new(Workers::new(1));
        let tile = |network: &Self| vec![0.0; network.model.ports()[0].iter().product()];
        let mut all = networks
            .iter()
            .map(|network| Ok((network, network.engine.state()?, tile(network), f64::INFINITY)))
            .collect::<Result<Vec<_>, PlanError>>()?;
        for _ in 0..runs {
            for (network, state, tile, shortest) in &mut all {
                let start = std::time::Instant::now();
                network.engine.run(state, tile, &alone, |_| ())?;
                *shortest = shortest.min(start.elapsed().as_secs_f64());
            }
        }
        Ok(all.into_iter().map(|(.., shortest)| shortest).collect())
    }

    /// Multiply-adds of one tile: convolutions, products and the mixing.
    pub fn macs(&self) -> u64 {
        let mixing = match self.model.kind {
            Kind::Adds => 0,
            Kind::Mixes => Mixer::macs(self.model.input.tile),
        };
        self.engine.macs() + mixing
    }

    /// Multiply-adds for each pixel of a frame of `size`, borders of tiles included.
    pub fn macs_per_pixel(&self, size: Size) -> f64 {
        let input = (*self.model).clone().fitted(size.width.max(size.height)).input;
        let area = Layout::new(size, &input).count() * input.tile * input.tile;
        self.macs() as f64 / self.model.input.tile.pow(2) as f64 * area as f64 / size.pixels() as f64
    }

    /// Numbers in the network.
    pub fn parameters(&self) -> usize {
        self.engine.parameters()
    }

    /// Bytes of the ONNX file.
    pub fn file_bytes(&self) -> usize {
        self.onnx.bytes.len()
    }

    /// Description of the network.
    pub fn model(&self) -> &Model {
        &self.model
    }

    /// Its arithmetic.
    pub fn precision(&self) -> Precision {
        self.onnx.precision
    }
}

/// One thread's part.
#[derive(Debug)]
pub(super) struct Lane {
    state: State,
    /// Who helps with a tile: everybody where it is the only one.
    team: Arc<Workers>,
    /// `[planes, tile, tile]`.
    pub(super) tile: Vec<f32>,
    mixing: Option<Mixing>,
}

/// What lies between a tile and a network of [`Kind::Mixes`].
#[derive(Debug)]
struct Mixing {
    mixer: Mixer,
    seen: Vec<f32>,
}

impl Lane {
    /// Allocates.
    pub(super) fn new(network: &Network, team: Arc<Workers>) -> Result<Self, PlanError> {
        let model = network.model();
        let [seen, _] = model.ports();
        let mixer = || Mixer::new(model.input.tile, team.threads());
        let mixing = || Mixing { mixer: mixer(), seen: vec![0.0; seen.iter().product()] };
        Ok(Self {
            state: network.engine.state()?,
            tile: vec![0.0; model.input.features.len() * model.input.tile.pow(2)],
            mixing: (model.kind != Kind::Adds).then(mixing),
            team,
        })
    }

    pub(super) fn bytes(model: &Model, threads: usize) -> usize {
        let tile = model.input.features.len() * model.input.tile.pow(2) * size_of::<f32>();
        let [seen, _] = model.ports();
        let mixer = || Mixer::bytes(model.input.tile, threads);
        let mixing = || seen.iter().product::<usize>() * size_of::<f32>() + mixer();
        tile + if model.kind == Kind::Adds { 0 } else { mixing() }
    }

    /// The answer to `self.tile`; a network of [`Kind::Mixes`] needs the PSF's `power`. Allocates inside the engine.
    pub(super) fn run(&mut self, engine: &Engine, power: Option<&Power>, answer: &mut [f32]) -> Result<(), PlanError> {
        let Self { state, team, tile, mixing } = self;
        match (mixing, power) {
            (None, _) => engine.run(state, tile, team, |found| answer.copy_from_slice(found)),
            (Some(Mixing { mixer, seen }), Some(power)) => {
                mixer.see(tile, power, seen, team);
                engine.run(state, seen, team, |weights| mixer.mix(tile, weights, answer, team))
            }
            (Some(_), None) => unreachable!("a plan knows its PSF's power where its network mixes"),
        }
    }
}
