//! L2: stage II. A learned network refines the Stokes images of stage I, tile by tile, where that can be vouched for.
//!
//! Input and output: Stokes `[C, 3, H, W]`, f32, S0 ≥ 0, |S1 + i·S2| ≤ S0, refined in place, each channel by itself. The
//! network sees the planes its manifest names ([`crate::refine::model`]) and answers with what is to be added.
//!
//! 1. *Gating.* A tile without polarization above the noise is left as it is; one whose input changed less than the noise does
//!    keeps its last answer.
//! 2. *The network* answers with what is to be added, or, as the shipped ones do, with how candidates made of stage I are to be
//!    mixed (`mixer.rs`): the part that needs no learning does not go through the engine. One candidate is the guide's detail in the
//!    shares in which the readings of the tile have it (`shares.rs`); of a guide that was not aligned, where they say that it lies
//!    (`place.rs`).
//! 3. *Blending.* Tiles overlap and their weights sum to 1: neither two tiles nor learned and physics meet in a seam.
//! 4. *What is hidden.* Of the change, frequencies at which the PSF shows an image fade, by v / (v + |K|² / max|K|²) with v = 0.1.
//!    What can be read there stage I has found (a step towards the readings in closed form, the mask taken for an even one).
//! 5. *Data consistency.* With d the change of the image, r = y − A·x and r′ = r − A·d, the energy of the residual grows by
//!    ‖r′‖² − ‖r‖² = −⟨d, Aᵀ(r + r′)⟩: a sum over pixels, so that every tile's share is known from one forward and one adjoint
//!    step of the whole frame; of a single tile it is ‖r′‖² − ‖r‖² as it stands. A tile whose share is above what noise allows stays
//!    physics.
//!
//! Allocation: [`Network::load`], [`Plan::new`] and [`Plan::make_workspace`] allocate. [`Plan::run`] allocates inside the
//! engine alone, at most [`Plan::bytes`] together with what the network holds. Workspaces remember the frame before.
//! Imports: [`crate::image`], [`crate::parallel`], [`crate::optics`], [`crate::refine::model`].
//!
//! *The engine* is `enabled.rs` (tract), or `disabled.rs` without the feature `fusion`.
//!
//! ```
//! use stokescope_core::refine::Network;
//! use stokescope_core::model::{Choice, Precision};
//! assert!(Network::choose(&Choice::Off, Precision::F32).unwrap().is_none());
//! ```

#[cfg_attr(not(feature = "fusion"), path = "disabled.rs")]
#[cfg_attr(feature = "fusion", path = "enabled.rs")]
mod engine;
mod mixer;
pub mod model;
mod network;
mod place;
mod shares;
mod tiles;

use std::ops::Range;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use network::Lane;
pub use network::{Network, PlanError};
use place::Place;
use shares::Power;
use tiles::Layout;

use crate::image::{Complex32, Stack};
use crate::optics::{Direction, Kernel, Scratch, StokesOperator};
use crate::parallel::Workers;
use model::Kind;
pub use model::Model;

/// Side of the blocks in which signal and change are sought, in pixels: what is small against a tile counts too.
const BLOCK: usize = 16;
/// Least rms of S1 + i·S2 in some block, in units of its noise, for a tile to be run.
const SIGNAL: f32 = 2.0;
/// Least rms change of the input in some block, in units of its noise, for a tile to be run anew.
const CHANGE: f32 = 2.0;
/// Share of the residual's energy by which a tile may raise it: what a slightly wrong PSF is worth.
const TOLERANCE: f64 = 0.1;
/// Power of the PSF's spectrum, of its largest, from which on the readings know better than a network. Training has it too
/// (`scripts/train/train.py`).
const VISIBLE: f32 = 0.1;
/// Rounds of refusing tiles; a frame in which some still do not pass stays physics.
const ROUNDS: usize = 3;

/// What became of the tiles of one frame, all channels together.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Report {
    /// Tiles there are.
    pub tiles: usize,
    /// Tiles the network was run on.
    pub run: usize,
    /// Tiles that kept their last answer: their input did not change.
    pub kept: usize,
    /// Tiles without polarization above the noise.
    pub quiet: usize,
    /// Tiles whose answer was worth nothing: not finite, or against the readings. They were run or kept.
    pub refused: usize,
    /// By how much the guide's detail lies to the right of and below where the readings have it, in pixels, in the mean of channels.
    /// `None` where they were not asked.
    pub detail_shift_px: Option<[f64; 2]>,
}

impl Report {
    /// Whether the network has a part in the result.
    pub fn is_learned(&self) -> bool {
        self.run + self.kept > self.refused
    }
}

/// What stage I knew of a frame.
#[derive(Clone, Copy, Debug)]
pub struct Input<'a> {
    /// Readings `[C, H, W]`, fractions of full scale.
    pub raw: &'a Stack<f32>,
    /// 0 or 1 for each reading.
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
    /// What keeps of a change what each operator hides; one for all where they share a PSF.
    hidden: Vec<Kernel>,
    /// What each operator shows, one for all likewise; of networks of [`Kind::Mixes`].
    powers: Vec<Power>,
    /// Noise of S1 + i·S2 per unit of noise of the readings, for a PSF that is a point: 1/(2√(mean |e|²)).
    noise: f32,
    /// Whether the network sees or changes S0, so that its back-projection is needed.
    with_s0: bool,
    /// Whether the readings are asked where the guide's detail lies.
    asks: bool,
}

/// A tile of one channel, with the answer that holds for it, in the readings' unit.
#[derive(Debug)]
struct Tile {
    /// `[planes, tile, tile]`.
    answer: Vec<f32>,
    /// Whether there is an answer, to the input that is remembered.
    answered: bool,
    /// Whether the answer is part of this frame's result.
    applied: bool,
}

/// The buffers of one camera's frames, and what is remembered from frame to frame.
#[derive(Debug)]
pub struct Workspace {
    /// y − A·x where the readings are trusted, else 0.
    residual: Vec<f32>,
    /// Readings of S0, and later its back-projection.
    plain: Vec<f32>,
    /// S1 + i·S2, and later its back-projection.
    polarized: Vec<Complex32>,
    /// Back-projected residual of stage I: R0, R1, R2.
    back: Stack<f32>,
    /// The refined channel.
    refined: Stack<f32>,
    /// Stage I as it was when each tile was last run, `[C, 3, H, W]`.
    seen: Stack<f32>,
    /// `[C, tiles]`; each is locked by the one thread that works on it.
    tiles: Vec<Mutex<Tile>>,
    /// Numbers of the tiles to run.
    jobs: Vec<usize>,
    lanes: Vec<Mutex<Lane>>,
    place: Option<Place>,
    scratch: Scratch,
}

impl Plan {
    /// Plans a network for a camera, one operator for each channel. Allocates.
    ///
    /// # Errors
    /// [`PlanError`] when the network does not take tiles of the camera's size.
    ///
    /// # Panics
    /// Without a mask there is no polarization to refine.
    pub fn new(network: &Network, operators: &[StokesOperator]) -> Result<Self, PlanError> {
        let e = operators[0].response.polarized();
        assert!(!e.is_empty(), "a camera without a mask");
        let power = e.iter().map(|e| f64::from(e.norm_sqr())).sum::<f64>() / e.len() as f64;
        let size = operators[0].convolver.size();
        let network = network.fitted(size.width.max(size.height))?;
        let Model { input, output, .. } = network.model();
        let mut plan = Self {
            layout: Layout::new(size, input),
            operators: Vec::new(),
            hidden: Vec::new(),
            powers: Vec::new(),
            noise: (0.5 / power.sqrt()) as f32,
            with_s0: output.planes.len() == 3 || input.features.iter().any(|f| f.plane == model::Plane::R0),
            asks: false,
            network,
        };
        plan.set_optics(operators);
        Ok(plan)
    }

    /// Takes the same camera behind another PSF from now on, one operator for each channel. Allocates.
    pub fn set_optics(&mut self, operators: &[StokesOperator]) {
        let shared = operators.iter().all(|operator| Arc::ptr_eq(&operator.kernel, &operators[0].kernel));
        let psfs = if shared { &operators[..1] } else { operators };
        let Model { kind, input, .. } = self.network.model();
        let looked_at = if *kind == Kind::Mixes { psfs } else { &[] };
        self.powers = looked_at.iter().map(|operator| power_of(operator, input.tile)).collect();
        self.hidden = psfs.iter().map(|operator| operator.kernel.hidden(VISIBLE)).collect();
        self.operators = operators.to_vec();
    }

    /// The same for guides that lie anywhere: a network of [`Kind::Mixes`] takes their detail from where the readings say that it lies.
    #[must_use]
    pub fn for_guides_as_they_lie(mut self) -> Self {
        self.asks = self.network.model().kind == Kind::Mixes;
        self
    }

    /// Asks no more where the guide's detail lies. Frees what that took.
    pub fn take_aligned_guides(&mut self, w: &mut Workspace) {
        self.asks = false;
        w.place = None;
    }

    /// The network.
    pub fn network(&self) -> &Network {
        &self.network
    }

    /// Whether the readings are asked where the guide's detail lies.
    pub fn asks(&self) -> bool {
        self.asks
    }

    /// Tiles that are worked on at once.
    fn lanes(&self) -> usize {
        self.operators[0].convolver.workers().threads().min(self.layout.count())
    }

    /// Who helps with a tile: all threads with a single one, nobody with several.
    fn team(&self) -> Arc<Workers> {
        let all = self.operators[0].convolver.workers();
        if self.lanes() == 1 { Arc::clone(all) } else { Arc::new(Workers::new(1)) }
    }

    /// Bytes of one [`Workspace`].
    pub fn workspace_bytes(&self) -> usize {
        let (n, channels) = (self.operators[0].convolver.size().pixels(), self.operators.len());
        let Model { input, output, .. } = self.network.model();
        let planes = 10 + 3 * channels;
        let square = input.tile * input.tile;
        let tiles = channels * self.layout.count() * output.planes.len() * square;
        let lanes = self.lanes() * Lane::bytes(self.network.model(), self.team().threads());
        let place = if self.asks { Place::bytes(self.operators[0].convolver.size()) } else { 0 };
        (planes * n + tiles) * size_of::<f32>() + lanes + place + self.operators[0].convolver.scratch_bytes()
    }

    /// Bytes held beside the workspace at the peak: the weights, the filters, and what the tiles of one moment need while they run.
    pub fn bytes(&self) -> usize {
        let filters = self.hidden.iter().map(Kernel::bytes).chain(self.powers.iter().map(Power::bytes)).sum::<usize>();
        self.network.engine.bytes() + filters + self.lanes() * self.network.engine.run_bytes()
    }

    /// Buffers for [`Self::run`]. Allocates.
    ///
    /// # Errors
    /// [`PlanError::Damaged`] when the engine refuses.
    pub fn make_workspace(&self) -> Result<Workspace, PlanError> {
        let (size, channels) = (self.operators[0].convolver.size(), self.operators.len());
        let Model { input, output, .. } = self.network.model();
        let square = input.tile * input.tile;
        let tile = || Tile { answer: vec![0.0; output.planes.len() * square], answered: false, applied: false };
        Ok(Workspace {
            residual: vec![0.0; size.pixels()],
            plain: vec![0.0; size.pixels()],
            polarized: vec![Complex32::ZERO; size.pixels()],
            back: Stack::zeros(3, size),
            refined: Stack::zeros(3, size),
            seen: Stack::zeros(3 * channels, size),
            tiles: (0..channels * self.layout.count()).map(|_| Mutex::new(tile())).collect(),
            jobs: Vec::with_capacity(self.layout.count()),
            lanes: (0..self.lanes())
                .map(|_| Lane::new(&self.network, self.team()).map(Mutex::new))
                .collect::<Result<_, _>>()?,
            place: self.asks.then(|| Place::new(size)),
            scratch: self.operators[0].convolver.make_scratch(),
        })
    }

    /// Refines `stokes`, `[C, 3, H, W]`.
    ///
    /// # Panics
    /// When shapes or the workspace are not those of the plan.
    pub fn run(&self, input: &Input<'_>, stokes: &mut Stack<f32>, w: &mut Workspace) -> Report {
        let mut report = Report::default();
        let n = self.operators[0].convolver.size().pixels();
        assert_eq!(stokes.as_slice().len(), 3 * n * self.operators.len(), "images of another plan");
        let (mut sum, mut asked) = ([0.0; 2], 0.0);
        for (c, stokes) in stokes.as_mut_slice().chunks_exact_mut(3 * n).enumerate() {
            if let Some([x, y]) = self.run_channel(c, input, stokes, w, &mut report) {
                (sum, asked) = ([sum[0] + x, sum[1] + y], asked + 1.0);
            }
        }
        report.detail_shift_px = (asked > 0.0).then(|| sum.map(|v| v / asked));
        report
    }

    /// The shift that was found for the guide's detail, where the readings were asked.
    fn run_channel(
        &self,
        c: usize,
        input: &Input<'_>,
        stokes: &mut [f32],
        w: &mut Workspace,
        report: &mut Report,
    ) -> Option<[f64; 2]> {
        let n = stokes.len() / 3;
        let tiles = c * self.layout.count()..(c + 1) * self.layout.count();
        report.tiles += tiles.len();
        let rms = mean_square(&stokes[..n]).sqrt() as f32;
        let noise = (input.sigma * self.noise).max(1e-4 * rms);
        w.jobs.clear();
        let seen = &w.seen.as_slice()[3 * n * c..][..3 * n];
        let (signal, change) = (&mut w.plain, &mut w.residual);
        signal
            .iter_mut()
            .zip(stokes[n..].iter().zip(&stokes[2 * n..]))
            .for_each(|(v, (s1, s2))| *v = s1 * s1 + s2 * s2);
        change.fill(0.0);
        for (seen, now) in seen.chunks_exact(n).zip(stokes.chunks_exact(n)) {
            change.iter_mut().zip(seen.iter().zip(now)).for_each(|(v, (seen, now))| *v += (now - seen).powi(2) / 3.0);
        }
        for t in 0..tiles.len() {
            let mut tile = lock(&w.tiles[tiles.start + t]);
            tile.applied = self.peak(t, signal) > SIGNAL * noise;
            match (tile.applied, tile.answered && self.peak(t, change) <= CHANGE * noise) {
                (false, _) => report.quiet += 1,
                (true, true) => report.kept += 1,
                (true, false) => w.jobs.push(t),
            }
        }
        report.run += w.jobs.len();
        let mut before = self.residual(c, input, stokes, w);
        self.keep_back_projection(c, w);
        let weight = input.weight.plane(c);
        let mut place = w.place.take_if(|_| !w.jobs.is_empty());
        let shift = place.as_mut().map(|place| {
            place.find(
                &self.operators[c],
                stokes,
                [&w.residual, weight],
                &mut w.plain,
                &mut w.polarized,
                &mut w.scratch,
            )
        });
        self.answer(c, stokes, place.as_ref().map_or(&stokes[..n], Place::s0), rms, w);
        if let Some(place) = &mut place {
            // what the network saw is what its answer is judged by
            place.correct(&self.operators[c], stokes, weight, &mut w.residual, &mut w.plain, &mut w.scratch);
            before = mean_square(&w.residual) * n as f64;
            self.keep_back_projection(c, w);
        }
        w.place = place.or(w.place.take());
        for tile in &w.tiles[tiles.clone()] {
            let mut tile = lock(tile);
            report.refused += usize::from(tile.applied && !tile.answered);
            tile.applied &= tile.answered;
        }
        let trusted = input.weight.plane(c).iter().filter(|v| **v > 0.0).count().max(1) as f64;
        let expected = f64::from(input.sigma).powi(2) * (trusted + 3.0 * (2.0 * trusted).sqrt());
        let allowance = ((expected - before).max(0.0) + TOLERANCE * before) / n as f64;
        for round in 0..=ROUNDS {
            if !self.compose(c, &tiles, stokes, w) {
                break;
            }
            let growth = self.residual_after(c, input, stokes, w) - before;
            let allowance = if round < ROUNDS { allowance } else { f64::NEG_INFINITY };
            let refused = self.refuse(&tiles, stokes, growth, allowance, w);
            report.refused += refused;
            if refused == 0 {
                stokes.copy_from_slice(w.refined.as_slice());
                break;
            }
        }
        shift
    }

    /// Root of the largest mean of `squares`, a plane of the frame, over the blocks of tile `t`'s own part of it.
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
                // a sum for each column: they do not wait for one another
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

    /// w.residual ← weight ⊙ (y − A·x); its sum of squares.
    fn residual(&self, c: usize, input: &Input<'_>, stokes: &[f32], w: &mut Workspace) -> f64 {
        let (operator, n) = (&self.operators[c], w.plain.len());
        operator.forward_s0(&stokes[..n], &mut w.plain, &mut w.scratch);
        let s12 = stokes[n..2 * n].iter().zip(&stokes[2 * n..]);
        w.polarized.iter_mut().zip(s12).for_each(|(l, (s1, s2))| *l = Complex32::new(*s1, *s2));
        operator.forward_polarized(&w.polarized, &mut w.residual, &mut w.scratch);
        let (y, weight) = (input.raw.plane(c), input.weight.plane(c));
        let readings = w.residual.iter_mut().zip(&w.plain).zip(y.iter().zip(weight));
        readings.for_each(|((r, plain), (y, weight))| *r = weight * (y - plain - *r));
        mean_square(&w.residual) * n as f64
    }

    /// w.back ← Aᵀ·residual.
    fn keep_back_projection(&self, c: usize, w: &mut Workspace) {
        let n = w.plain.len();
        self.back_project(c, w);
        w.back.plane_mut(0).copy_from_slice(&w.plain);
        for (i, v) in w.polarized.iter().enumerate() {
            let back = w.back.as_mut_slice();
            (back[n + i], back[2 * n + i]) = (v.re, v.im);
        }
    }

    /// (w.plain, w.polarized) ← Aᵀ·residual; w.plain is 0 where it is not needed.
    fn back_project(&self, c: usize, w: &mut Workspace) {
        let operator = &self.operators[c];
        operator.adjoint_polarized(&w.residual, &mut w.polarized, &mut w.scratch);
        if self.with_s0 {
            operator.adjoint_s0(&w.residual, &mut w.plain, &mut w.scratch);
        } else {
            w.plain.fill(0.0);
        }
    }

    /// ‖r′‖² of r′ = y − A·refined, and with several tiles (w.plain, w.polarized) ← Aᵀ·r′. Where S0 is as before, r is taken from
    /// w.residual and stays, and w.plain means nothing.
    fn residual_after(&self, c: usize, input: &Input<'_>, stokes: &[f32], w: &mut Workspace) -> f64 {
        let (operator, n) = (&self.operators[c], w.plain.len());
        let apart = self.layout.count() > 1;
        if self.network.model().output.planes.len() == 3 {
            let refined = std::mem::replace(&mut w.refined, Stack::zeros(0, operator.convolver.size()));
            let after = self.residual(c, input, refined.as_slice(), w);
            w.refined = refined;
            if apart {
                self.back_project(c, w);
            }
            return after;
        }
        let change = |k: usize| w.refined.plane(k).iter().zip(&stokes[k * n..]).map(|(after, before)| after - before);
        for (d, (s1, s2)) in w.polarized.iter_mut().zip(change(1).zip(change(2))) {
            *d = Complex32::new(s1, s2);
        }
        operator.forward_polarized(&w.polarized, &mut w.plain, &mut w.scratch);
        let readings = w.plain.iter_mut().zip(&w.residual).zip(input.weight.plane(c));
        readings.for_each(|((d, r), weight)| *d = r - weight * *d);
        if apart {
            operator.adjoint_polarized(&w.plain, &mut w.polarized, &mut w.scratch);
        }
        mean_square(&w.plain) * n as f64
    }

    /// Runs the network on the tiles in `w.jobs`, all threads at once, with `s0` in place of that of `stokes`.
    fn answer(&self, c: usize, stokes: &[f32], s0: &[f32], rms: f32, w: &mut Workspace) {
        let n = stokes.len() / 3;
        let Model { input, output, .. } = self.network.model();
        let square = input.tile * input.tile;
        let (jobs, back, unit) = (&w.jobs, &w.back, output.scale * rms);
        let (tiles, lanes) = (&w.tiles[c * self.layout.count()..], &w.lanes);
        let power = self.powers.get(c).or(self.powers.first());
        let next = AtomicUsize::new(0);
        self.operators[0].convolver.workers().run(lanes.len(), &|lane| {
            let lane = &mut *lock(&lanes[lane]);
            while let Some(&t) = jobs.get(next.fetch_add(1, Ordering::Relaxed)) {
                for (feature, buffer) in input.features.iter().zip(lane.tile.chunks_exact_mut(square)) {
                    let plane = match feature.plane {
                        model::Plane::S0 => s0,
                        model::Plane::S1 => &stokes[n..2 * n],
                        model::Plane::S2 => &stokes[2 * n..],
                        model::Plane::R0 => back.plane(0),
                        model::Plane::R1 => back.plane(1),
                        model::Plane::R2 => back.plane(2),
                    };
                    let scale = feature.scale / rms.max(f32::MIN_POSITIVE);
                    self.layout.cut(t, plane, buffer, |v| scale * v + feature.offset);
                }
                let mut tile = lock(&tiles[t]);
                let done = lane.run(&self.network.engine, power, &mut tile.answer).is_ok();
                tile.answer.iter_mut().for_each(|v| *v *= unit);
                tile.answered = done && tile.answer.iter().all(|v| v.is_finite());
            }
        });
        let (seen, width) =
            (&mut w.seen.as_mut_slice()[3 * n * c..][..3 * n], self.operators[c].convolver.size().width);
        for t in jobs {
            let (rows, columns) = self.layout.core(*t);
            for at in (0..3).flat_map(|k| rows.clone().map(move |y| k * n + y * width)) {
                let part = at + columns.start..at + columns.end;
                seen[part.clone()].copy_from_slice(&stokes[part]);
            }
        }
    }

    /// w.refined ← stage I and of the answers that are applied what is hidden, made physical. Whether there are any.
    fn compose(&self, c: usize, tiles: &Range<usize>, stokes: &[f32], w: &mut Workspace) -> bool {
        let n = stokes.len() / 3;
        let Model { input, output, .. } = self.network.model();
        let (square, first) = (input.tile * input.tile, 3 - output.planes.len());
        let change = w.refined.as_mut_slice();
        change.fill(0.0);
        let mut any = false;
        for (t, tile) in w.tiles[tiles.clone()].iter().enumerate() {
            let tile = lock(tile);
            if !tile.applied {
                continue;
            }
            any = true;
            for (plane, answer) in change[first * n..].chunks_exact_mut(n).zip(tile.answer.chunks_exact(square)) {
                self.layout.for_rows(t, |at, from, row, weights| {
                    let pixels = plane[at..].iter_mut().zip(&answer[from..]).zip(weights);
                    pixels.for_each(|((v, a), weight)| *v += row * weight * a);
                });
            }
        }
        if !any {
            return false;
        }
        let (s0, s12) = change.split_at_mut(n);
        let (s1, s2) = s12.split_at_mut(n);
        if first == 0 {
            self.hide(c, s0, None, &mut w.polarized, &mut w.scratch);
        }
        self.hide(c, s1, Some(s2), &mut w.polarized, &mut w.scratch);
        change.iter_mut().zip(stokes).for_each(|(v, stage1)| *v += stage1);
        let (s0, s12) = change.split_at_mut(n);
        let (s1, s2) = s12.split_at_mut(n);
        for ((s0, s1), s2) in s0.iter_mut().zip(s1).zip(s2) {
            *s0 = s0.max(0.0);
            let l = (*s1 * *s1 + *s2 * *s2).sqrt();
            if l > *s0 {
                (*s1, *s2) = (*s1 * *s0 / l, *s2 * *s0 / l);
            }
        }
        true
    }

    /// Keeps of a change, of one plane or of two as one complex one, what the PSF hides. Takes `both` as a buffer.
    fn hide(&self, c: usize, re: &mut [f32], im: Option<&mut [f32]>, both: &mut [Complex32], scratch: &mut Scratch) {
        let (filter, width) = (&self.hidden[c.min(self.hidden.len() - 1)], self.operators[c].convolver.size().width);
        let second = im.as_deref();
        let load = |y: usize, line: &mut [Complex32]| {
            let row = y * width..(y + 1) * width;
            line.iter_mut().zip(&re[row.clone()]).for_each(|(v, re)| *v = Complex32::from(*re));
            line.iter_mut().zip(second.map_or(&[][..], |im| &im[row])).for_each(|(v, im)| v.im = *im);
        };
        let keep = |_: usize, line: &[Complex32], out: &mut [Complex32]| out.copy_from_slice(line);
        self.operators[c].convolver.run(filter, Direction::Forward, load, both, keep, scratch);
        re.iter_mut().zip(&*both).for_each(|(re, v)| *re = v.re);
        im.into_iter().flatten().zip(&*both).for_each(|(im, v)| *im = v.im);
    }

    /// Refuses the applied tiles that raise the residual's energy by more than `allowance` a pixel; how many. All together raise it by
    /// `growth`; the share of each of several is told by Aᵀr in w.back and Aᵀr′ in w.plain and w.polarized.
    fn refuse(&self, tiles: &Range<usize>, stokes: &[f32], growth: f64, allowance: f64, w: &mut Workspace) -> usize {
        let n = stokes.len() / 3;
        let (refined, back) = (w.refined.as_slice(), w.back.as_slice());
        let growth_at = |i: usize| {
            let d = |k: usize| refined[k * n + i] - stokes[k * n + i];
            let (plain, l) = (back[i] + w.plain[i], w.polarized[i]);
            -d(0) * plain - d(1) * (back[n + i] + l.re) - d(2) * (back[2 * n + i] + l.im)
        };
        let share_of = |t: usize| {
            let (mut share, mut pixels) = (0.0, 0.0);
            self.layout.for_rows(t, |at, _, row, weights| {
                for (i, weight) in weights.iter().enumerate() {
                    let weight = f64::from(row * weight);
                    share += weight * f64::from(growth_at(at + i));
                    pixels += weight;
                }
            });
            (share, pixels)
        };
        let mut refused = 0;
        for (t, tile) in w.tiles[tiles.clone()].iter().enumerate() {
            let mut tile = lock(tile);
            if !tile.applied {
                continue;
            }
            let (share, pixels) = if tiles.len() == 1 { (growth, n as f64) } else { share_of(t) };
            if share > allowance * pixels {
                tile.applied = false;
                refused += 1;
            }
        }
        refused
    }
}

/// What an operator's PSF shows of a tile: its image of a single bright pixel is the PSF. Allocates.
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

/// A panic elsewhere ended the frame; what the lock guards is rewritten by the next.
fn lock<T>(mutex: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
