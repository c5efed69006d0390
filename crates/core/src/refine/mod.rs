//! L2: stage II. A small neural network refines the Stokes images of stage I, tile by tile, where the readings agree with it.
//!
//! Input and output are Stokes images `[C, 3, H, W]`, f32, with S0 ≥ 0 and |S1 + i·S2| ≤ S0. S1 and S2 are refined in place, each
//! colour channel by itself; S0 stays as it is.
//!
//! 1. *Gating.* A tile whose polarization does not exceed the noise is left as it is. A tile whose input changed by less than the
//!    noise keeps its last correction.
//! 2. *Candidates* (`candidates.rs`). Fifteen images are computed from stage I for each of S1 and S2. The network weighs them for
//!    every pixel; the weighted sum is the correction. One candidate is the guide's detail, in the proportions that the readings of the
//!    tile confirm (`shares.rs`).
//! 3. *Blending* (`tiles.rs`). Tiles overlap, and the weights of all tiles sum to 1 in every pixel, so that no seam shows.
//! 4. *Hidden frequencies* (`judge.rs`). The correction is multiplied by v / (v + |K|² / max|K|²), v = 0.1: it fades where the PSF
//!    shows an image to the readings, because stage I has determined it there. This is a step towards the readings in closed
//!    form, with the mask approximated as uniform.
//! 5. *Data consistency* (`judge.rs`). With the change of the image d and the residuals r = y − A·x and r′ = r − A·d, the energy of
//!    the residual grows by ‖r′‖² − ‖r‖² = −⟨d, Aᵀ(r + r′)⟩. This is a sum over pixels, so one forward and one adjoint step of the
//!    whole frame give every tile's share; a single tile's is ‖r′‖² − ‖r‖² itself. A tile whose share exceeds what noise allows is
//!    refused and keeps the result of stage I.
//!
//! Allocation: [`Network::load`], [`Plan::new`], [`Plan::set_optics`] and [`Plan::make_workspace`] allocate. [`Plan::run`] allocates
//! inside the engine alone; together with what the network holds this is at most [`Plan::bytes`]. A workspace remembers the last frame.
//! Imports: [`crate::image`], [`crate::parallel`], [`crate::optics`].
//!
//! ONNX files are run by tract behind the feature `fusion`. Another engine implements [`Engine`] and [`Runner`]:
//!
//! ```
//! use std::sync::Arc;
//! use stokescope_core::parallel::Workers;
//! use stokescope_core::refine::model::{CANDIDATES, CELL, Model, Precision, Tiling};
//! use stokescope_core::refine::{Engine, Network, PlanError, Runner};
//!
//! /// Gives every candidate the weight 0.01, in cells of one tile.
//! #[derive(Clone, Debug)]
//! struct Even(usize);
//! impl Runner for Even {
//!     fn run(&mut self, _: &[f32], _: &Arc<Workers>, take: &mut dyn FnMut(&[f32])) -> Result<(), PlanError> {
//!         take(&vec![0.01; CELL * CELL * CANDIDATES * self.0]);
//!         Ok(())
//!     }
//! }
//! impl Engine for Even {
//!     fn runner(&self) -> Result<Box<dyn Runner>, PlanError> { Ok(Box::new(self.clone())) }
//!     fn weight_bytes(&self) -> usize { 0 }
//!     fn run_bytes(&self) -> usize { CELL * CELL * CANDIDATES * self.0 * size_of::<f32>() }
//!     fn macs(&self) -> u64 { 0 }
//!     fn parameters(&self) -> usize { 0 }
//! }
//! let model = Model { name: "even".to_owned(), tiling: Tiling { tile: 64, halo: 16, multiple: 16 } };
//! let plan = |model: &Model| Ok(Arc::new(Even(model.shapes()[0][2..].iter().product())) as Arc<dyn Engine>);
//! assert_eq!(Network::with_engine(model, Precision::F32, plan)?.model().name, "even");
//! # Ok::<(), PlanError>(())
//! ```

mod candidates;
mod judge;
pub mod model;
mod network;
mod shares;
mod tiles;
#[cfg(feature = "fusion")]
mod tract;

use std::ops::Range;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

pub use model::Model;
pub use network::{Engine, Network, PlanError, Runner};

use crate::image::{Buffers, Complex32, Stack};
use crate::optics::{Direction, Kernel, Psf, Scratch, StokesOperator};
use crate::parallel::Workers;
use model::RESIDUAL;
use network::{TileBuffers, TileRunner};
use shares::Power;
use tiles::Layout;

/// Side in pixels of the blocks in which signal and change are measured, so that something small in a large tile counts.
const BLOCK: usize = 16;
/// A tile is run when the rms of S1 + i·S2 in some block exceeds this many standard deviations of its noise.
const SIGNAL: f32 = 2.0;
/// A tile is run again when the rms change of its input in some block exceeds this many standard deviations of the noise.
const CHANGE: f32 = 2.0;
/// v of the filter that removes what the PSF shows, relative to the largest |K|². `scripts/train/train.py` trains with the same value.
const VISIBLE: f32 = 0.1;

/// Numbers of tiles of one frame, all channels together.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Report {
    /// All tiles.
    pub tiles: usize,
    /// Tiles that the network was run on.
    pub run: usize,
    /// Tiles that kept their last correction because their input did not change.
    pub kept: usize,
    /// Tiles without polarization above the noise.
    pub quiet: usize,
    /// Tiles, among those run or kept, whose correction was not finite or contradicted the readings.
    pub refused: usize,
}

impl Report {
    /// Whether the network changed the result.
    pub fn is_learned(&self) -> bool {
        self.run + self.kept > self.refused
    }
}

/// The readings behind the images of stage I.
#[derive(Clone, Copy, Debug)]
pub struct Input<'a> {
    /// Readings `[C, H, W]`, fractions of full scale.
    pub raw: &'a Stack<f32>,
    /// 1 for a trusted reading, else 0; `[C, H, W]`.
    pub weight: &'a Stack<f32>,
    /// Standard deviation of the readings' noise.
    pub sigma: f32,
}

/// A network planned for one camera.
#[derive(Debug)]
pub struct Plan {
    network: Network,
    layout: Layout,
    operators: Vec<StokesOperator>,
    /// The filter of each operator that keeps what its PSF hides; a single one where all channels share a PSF.
    hidden: Vec<Kernel>,
    /// |K|² of each operator's PSF; a single one likewise.
    powers: Vec<Power>,
    /// Standard deviation of S1 + i·S2 per unit of noise of the readings, for a PSF of one pixel: 1/(2√(mean |e|²)).
    noise: f32,
}

/// The last correction of one tile of one channel.
#[derive(Debug)]
struct Tile {
    /// Correction of S1 and S2 in the readings' unit, `[2, tile, tile]`.
    correction: Vec<f32>,
    /// Whether `correction` is finite and belongs to the input that is remembered.
    usable: bool,
    /// Whether the correction is part of this frame's result.
    applied: bool,
}

/// The buffers for one camera's frames, and what is remembered from frame to frame.
#[derive(Debug)]
pub struct Workspace {
    /// y − A·x where the readings are trusted, else 0.
    residual: Vec<f32>,
    /// A plane of readings or pixels.
    plane: Vec<f32>,
    /// S1 + i·S2, and later its back-projection.
    polarized: Vec<Complex32>,
    /// Back-projected residual of stage I: R0, R1, R2.
    back: Stack<f32>,
    /// The refined S1 and S2.
    refined: Stack<f32>,
    /// The images of stage I that each tile was last run on, `[C, 3, H, W]`.
    seen: Stack<f32>,
    /// `[C, tiles]`; each is locked by the one thread that works on it.
    tiles: Vec<Mutex<Tile>>,
    /// Indices of the tiles to run.
    jobs: Vec<usize>,
    runners: Vec<Mutex<TileRunner>>,
    scratch: Scratch,
}

impl Plan {
    /// Plans a network for a camera, with one operator for each channel. Allocates.
    ///
    /// # Errors
    /// [`PlanError`] when the network does not take tiles of the camera's size.
    ///
    /// # Panics
    /// For a camera without a mask: there is no polarization to refine.
    pub fn new(network: &Network, operators: &[StokesOperator]) -> Result<Self, PlanError> {
        let e = operators[0].response.polarized();
        assert!(!e.is_empty(), "a camera without a mask");
        let power = e.iter().map(|e| f64::from(e.norm_sqr())).sum::<f64>() / e.len() as f64;
        let size = operators[0].convolver.size();
        let network = network.fitted(size.width.max(size.height))?;
        let mut plan = Self {
            layout: Layout::new(size, &network.model().tiling),
            operators: Vec::new(),
            hidden: Vec::new(),
            powers: Vec::new(),
            noise: (0.5 / power.sqrt()) as f32,
            network,
        };
        plan.set_optics(operators);
        Ok(plan)
    }

    /// Changes to other PSFs of the same camera, with one operator for each channel. Allocates.
    pub fn set_optics(&mut self, operators: &[StokesOperator]) {
        let shared = operators.iter().all(|operator| Arc::ptr_eq(&operator.kernel, &operators[0].kernel));
        let psfs = if shared { &operators[..1] } else { operators };
        let tile = self.network.model().tiling.tile;
        self.powers = psfs.iter().map(|operator| power_of(operator, tile)).collect();
        self.hidden = psfs.iter().map(|operator| operator.kernel.hidden(VISIBLE)).collect();
        self.operators = operators.to_vec();
    }

    /// Changes to another PSF of the same camera. Allocates.
    pub fn set_psf(&mut self, psf: &Psf) {
        let operators = self.operators[0].behind(psf, self.operators.len());
        self.set_optics(&operators);
    }

    /// The network.
    pub fn network(&self) -> &Network {
        &self.network
    }

    /// Number of tiles that are run at the same time.
    fn runners(&self) -> usize {
        self.operators[0].convolver.workers().threads().min(self.layout.count())
    }

    /// The threads that share one tile: all of them when there is a single tile, else one.
    fn team(&self) -> Arc<Workers> {
        let all = self.operators[0].convolver.workers();
        if self.runners() == 1 { Arc::clone(all) } else { Arc::new(Workers::new(1)) }
    }

    /// A workspace without its runners, and the buffers of those.
    fn workspace(&self, buffers: &mut Buffers) -> (Workspace, Vec<TileBuffers>) {
        let (convolver, channels) = (&self.operators[0].convolver, self.operators.len());
        let (size, corrections) = (convolver.size(), 2 * self.network.model().tiling.tile.pow(2));
        let mut tile = |_| Tile { correction: buffers.filled(0.0, corrections), usable: false, applied: false };
        let tiles = (0..channels * self.layout.count()).map(|t| Mutex::new(tile(t))).collect();
        let threads = self.team().threads();
        let runners = (0..self.runners()).map(|_| TileBuffers::new(buffers, self.network.model(), threads)).collect();
        let workspace = Workspace {
            residual: buffers.filled(0.0, size.pixels()),
            plane: buffers.filled(0.0, size.pixels()),
            polarized: buffers.filled(Complex32::ZERO, size.pixels()),
            back: buffers.stack(3, size),
            refined: buffers.stack(2, size),
            seen: buffers.stack(3 * channels, size),
            tiles,
            jobs: buffers.reserved(self.layout.count()),
            runners: Vec::new(),
            scratch: convolver.scratch(buffers),
        };
        (workspace, runners)
    }

    /// Bytes of one [`Workspace`], without the engine's.
    pub fn workspace_bytes(&self) -> usize {
        Buffers::bytes(|buffers| self.workspace(buffers))
    }

    /// Bytes held beside the workspace at the peak: weights, filters, and what the engine allocates while tiles run.
    pub fn bytes(&self) -> usize {
        let filters = self.hidden.iter().map(Kernel::bytes).chain(self.powers.iter().map(Power::bytes)).sum::<usize>();
        let engine = self.network.engine();
        engine.weight_bytes() + filters + self.runners() * engine.run_bytes()
    }

    /// Buffers for [`Self::run`]. Allocates.
    ///
    /// # Errors
    /// [`PlanError::Damaged`] when the engine refuses.
    pub fn make_workspace(&self) -> Result<Workspace, PlanError> {
        let (mut workspace, tiles) = Buffers::allocate(|buffers| self.workspace(buffers));
        let runner = |tile| TileRunner::new(&self.network, self.team(), tile).map(Mutex::new);
        workspace.runners = tiles.into_iter().map(runner).collect::<Result<_, _>>()?;
        Ok(workspace)
    }

    /// Refines `stokes`, `[C, 3, H, W]`.
    ///
    /// # Panics
    /// When shapes or the workspace belong to another plan.
    pub fn run(&self, input: &Input<'_>, stokes: &mut Stack<f32>, w: &mut Workspace) -> Report {
        let mut report = Report::default();
        let n = self.operators[0].convolver.size().pixels();
        assert_eq!(stokes.as_slice().len(), 3 * n * self.operators.len(), "images of another plan");
        for (c, stokes) in stokes.as_mut_slice().chunks_exact_mut(3 * n).enumerate() {
            let rms = mean_square(&stokes[..n]).sqrt() as f32;
            let noise = (input.sigma * self.noise).max(1e-4 * rms);
            self.gate(c, stokes, noise, w, &mut report);
            let energy = self.residual(c, input, stokes, w);
            self.back_project(c, w);
            self.correct(c, stokes, rms, w);
            report.refused += self.judge(c, input, energy, stokes, w);
        }
        report
    }

    /// The tiles of channel `c` in [`Workspace::tiles`].
    fn tiles(&self, c: usize) -> Range<usize> {
        c * self.layout.count()..(c + 1) * self.layout.count()
    }

    /// Decides by the noise of S1 + i·S2 which tiles take part, and lists those to run in `w.jobs`.
    fn gate(&self, c: usize, stokes: &[f32], noise: f32, w: &mut Workspace, report: &mut Report) {
        let n = stokes.len() / 3;
        w.jobs.clear();
        let seen = &w.seen.as_slice()[3 * n * c..][..3 * n];
        let (signal, change) = (&mut w.plane, &mut w.residual);
        let polarization = stokes[n..].iter().zip(&stokes[2 * n..]);
        signal.iter_mut().zip(polarization).for_each(|(v, (s1, s2))| *v = s1 * s1 + s2 * s2);
        change.fill(0.0);
        for (seen, now) in seen.chunks_exact(n).zip(stokes.chunks_exact(n)) {
            change.iter_mut().zip(seen.iter().zip(now)).for_each(|(v, (seen, now))| *v += (now - seen).powi(2) / 3.0);
        }
        for (t, tile) in w.tiles[self.tiles(c)].iter().enumerate() {
            let mut tile = lock(tile);
            tile.applied = self.peak(t, signal) > SIGNAL * noise;
            match (tile.applied, tile.usable && self.peak(t, change) <= CHANGE * noise) {
                (false, _) => report.quiet += 1,
                (true, true) => report.kept += 1,
                (true, false) => w.jobs.push(t),
            }
        }
        report.tiles += self.layout.count();
        report.run += w.jobs.len();
    }

    /// Largest rms among the blocks of tile `t`'s core. `squares` is a plane of the frame.
    fn peak(&self, t: usize, squares: &[f32]) -> f32 {
        let width = self.operators[0].convolver.size().width;
        let (rows, columns) = self.layout.core(t);
        let blocks = |range: Range<usize>| {
            let end = range.end;
            range.step_by(BLOCK).map(move |start| start..(start + BLOCK).min(end))
        };
        let mut largest = 0.0f32;
        for rows in blocks(rows) {
            for columns in blocks(columns.clone()) {
                let count = rows.len() * columns.len();
                // One sum for each column, so that no addition waits for the last.
                let mut sums = [0.0f32; BLOCK];
                for y in rows.clone() {
                    let row = &squares[y * width..][columns.clone()];
                    sums.iter_mut().zip(row).for_each(|(sum, v)| *sum += v);
                }
                largest = largest.max(sums.iter().sum::<f32>() / count as f32);
            }
        }
        largest.sqrt()
    }

    /// Runs the network on the tiles in `w.jobs`, on all threads.
    fn correct(&self, c: usize, stokes: &[f32], rms: f32, w: &mut Workspace) {
        let n = stokes.len() / 3;
        let tile_len = self.network.model().tiling.tile.pow(2);
        let (jobs, tiles, runners) = (&w.jobs, &w.tiles[self.tiles(c)], &w.runners);
        let power = self.powers.get(c).unwrap_or(&self.powers[0]);
        let planes = || stokes.chunks_exact(n).map(|plane| (plane, 1.0)).chain(w.back.planes().map(|p| (p, RESIDUAL)));
        let next = AtomicUsize::new(0);
        self.operators[0].convolver.workers().run(runners.len(), &|runner| {
            let runner = &mut *lock(&runners[runner]);
            while let Some(&t) = jobs.get(next.fetch_add(1, Ordering::Relaxed)) {
                for ((plane, unit), cut) in planes().zip(runner.planes().chunks_exact_mut(tile_len)) {
                    self.layout.cut(t, plane, cut, unit / rms.max(f32::MIN_POSITIVE));
                }
                let mut tile = lock(&tiles[t]);
                let done = runner.run(power, &mut tile.correction).is_ok();
                tile.correction.iter_mut().for_each(|v| *v *= rms);
                tile.usable = done && tile.correction.iter().all(|v| v.is_finite());
            }
        });
        let width = self.operators[c].convolver.size().width;
        let seen = &mut w.seen.as_mut_slice()[3 * n * c..][..3 * n];
        for t in jobs {
            let (rows, columns) = self.layout.core(*t);
            for at in (0..3).flat_map(|k| rows.clone().map(move |y| k * n + y * width)) {
                let part = at + columns.start..at + columns.end;
                seen[part.clone()].copy_from_slice(&stokes[part]);
            }
        }
    }
}

/// |K|² of an operator's PSF at the frequencies of a tile. The PSF is the operator's image of a single bright pixel. Allocates.
fn power_of(operator: &StokesOperator, tile: usize) -> Power {
    let size = operator.convolver.size();
    let centre = size.height / 2 * size.width + size.width / 2;
    let mut psf = vec![0.0; size.pixels()];
    let load = |y: usize, line: &mut [Complex32]| {
        line.fill(Complex32::ZERO);
        if y == centre / size.width {
            line[centre % size.width] = Complex32::ONE;
        }
    };
    let store = |_: usize, line: &[Complex32], out: &mut [f32]| out.iter_mut().zip(line).for_each(|(v, l)| *v = l.re);
    let mut scratch = operator.convolver.make_scratch();
    operator.convolver.run(&operator.kernel, Direction::Forward, load, &mut psf, store, &mut scratch);
    Power::of_psf(&psf, size.width, tile)
}

fn mean_square(values: &[f32]) -> f64 {
    values.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>() / values.len() as f64
}

/// Locks even after a panic in another thread: that ended its frame, and the next frame rewrites what the lock guards.
fn lock<T>(mutex: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
