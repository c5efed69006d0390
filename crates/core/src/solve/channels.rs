//! `guided` and `stokes` over all colour channels of a frame: all at once where they share one polarization, otherwise one after another.

use std::sync::Arc;

use super::admm::{Plan, Workspace};
use super::guided::{Previous, Solved};
use super::joint_colors::JointColors;
use super::problem::Unknowns;
use super::video::{Average, Continuation};
use super::warm_start::WarmStart;
use super::{Buffers, Diverged, Input, Modelled, Outcome, Solver, own};
use crate::image::noise::reading_noise;
use crate::optics::{Coarse, StokesOperator};

/// One plan for each colour channel.
#[derive(Debug)]
pub(super) struct Channels(Vec<Plan>);

/// Readings, weights and guide of one channel, `[H, W]`.
#[derive(Clone, Copy, Debug)]
struct Channel<'a> {
    raw: &'a [f32],
    weight: &'a [f32],
    guide: Option<&'a [f32]>,
}

/// Account of one channel.
#[derive(Clone, Copy, Debug)]
struct ChannelOutcome {
    /// Sum of squares of the weighted residual.
    energy: f64,
    gain: f32,
    sigma: f32,
    modelled: Modelled,
}

impl Channels {
    /// Plans `guided` or `stokes`. `coarse` are equations that were made before, for `guided` behind a mask. Allocates.
    pub(super) fn new(operators: &[StokesOperator], guided: bool, coarse: &[Arc<Coarse>]) -> Self {
        let mut plans: Vec<Plan> = Vec::with_capacity(operators.len());
        for (c, operator) in operators.iter().enumerate() {
            let given = coarse.get(c).filter(|_| guided && operator.response.is_polarized()).cloned();
            let coarse = given.or_else(|| plans.iter().find_map(|plan| plan.coarse_for(operator)));
            plans.push(Plan::new(operator.clone(), guided, coarse));
        }
        Self(plans)
    }

    /// Whether a video's frames can go on from each other: L beside a guide.
    fn continues(&self) -> bool {
        self.0[0].unknowns == Unknowns::Polarized
    }

    fn run_frame(
        &self,
        input: &Input<'_>,
        iterations: usize,
        output: &mut [f32],
        w: &mut Workspace,
        mut video: Option<&mut Continuation>,
    ) -> Result<Outcome, Diverged> {
        let (channels, field) = (self.0.len(), self.0[0].operator.field());
        if let Some(joint) = self.run_jointly(input, iterations, output, w, video.as_deref_mut())? {
            let outcome = Outcome::cold(Modelled::Shared, iterations, joint.energy, channels, field);
            return Ok(Outcome { gain: joint.gain, sigma: Some(joint.sigma), ..outcome });
        }
        let (mut modelled, mut energy, mut gain, mut sigma) = (Modelled::Nothing, 0.0, [1.0; 3], 0.0f32);
        let outputs = output.chunks_exact_mut(output.len() / self.0.len());
        for (c, (plan, out)) in self.0.iter().zip(outputs).enumerate() {
            let guide = input.guide.filter(|_| plan.guided).map(|guide| guide.plane(c));
            let mut channel = Channel { raw: input.raw.plane(c), weight: input.weight.plane(c), guide };
            let mut previous = None;
            if let Some(Continuation { start, averages, states, .. }) = video.as_deref_mut() {
                channel = Channel { raw: &averages[c].raw, guide: Some(&averages[c].guide), ..channel };
                previous = Some(Previous { start: *start, state: &mut states[c] });
            }
            let solved = plan.run(channel, iterations, previous, out, w)?;
            if solved.modelled != Modelled::Nothing {
                modelled = solved.modelled;
            }
            (energy, gain[c], sigma) = (energy + solved.energy, solved.gain, sigma.max(solved.sigma));
        }
        Ok(Outcome { gain, sigma: Some(sigma), ..Outcome::cold(modelled, iterations, energy, channels, field) })
    }

    /// All channels at once, where they share one polarization. Every frame that is solved by itself asks whether they do. A frame that
    /// does so no longer is solved by itself.
    fn run_jointly(
        &self,
        input: &Input<'_>,
        iterations: usize,
        output: &mut [f32],
        w: &mut Workspace,
        mut video: Option<&mut Continuation>,
    ) -> Result<Option<JointColors>, Diverged> {
        let asked = video.as_ref().is_none_or(|video| video.joint || video.start == WarmStart::Cold);
        if !self.continues() || !asked || !Plan::may_join(&self.0) {
            return Ok(None);
        }
        let joint = self.0[0].solve_joint_colors(input, iterations, video.as_deref_mut(), output, w)?;
        if let Some(video) = video {
            video.joint = joint.is_some();
            if joint.is_none() {
                video.start = WarmStart::Cold;
            }
        }
        Ok(joint)
    }
}

impl Solver for Channels {
    fn make_workspace(&self) -> Box<dyn Buffers> {
        Box::new(self.0[0].make_workspace())
    }

    fn workspace_parts(&self) -> Vec<(&'static str, usize)> {
        self.0[0].workspace_parts()
    }

    /// The direct start's equations, shared ones counted once.
    fn bytes(&self) -> usize {
        let shared = |c: usize| self.0[..c].iter().any(|earlier| Arc::ptr_eq(&earlier.coarse, &self.0[c].coarse));
        (0..self.0.len()).filter(|c| !shared(*c)).map(|c| self.0[c].coarse.bytes()).sum()
    }

    fn make_continuation(&self) -> Continuation {
        let plans = self.0.iter().filter(|_| self.continues());
        let states = plans.map(|plan| plan.make_temporal_state(self.0.len() == 1)).collect();
        let response = &self.0[0].operator.response;
        Continuation::new(states, response.size(), response.row_period())
    }

    fn continuation_bytes(&self) -> usize {
        let plans = self.0.iter().filter(|_| self.continues());
        let average = |plan: &Plan| Average::bytes(plan.operator.convolver.size());
        plans.map(|plan| average(plan) + plan.temporal_bytes(self.0.len() == 1)).sum()
    }

    fn run(
        &self,
        input: &Input<'_>,
        iterations: usize,
        output: &mut [f32],
        workspace: &mut dyn Buffers,
        video: Option<&mut Continuation>,
    ) -> Result<Outcome, Diverged> {
        assert!(input.guide.is_some() || !self.0[0].guided, "a guided plan without a guide");
        let w = own(workspace);
        let Some(video) = video.filter(|_| self.continues()) else {
            return self.run_frame(input, iterations, output, w, None);
        };
        video.advance(input);
        let outcome = self.run_frame(input, iterations, output, w, Some(video)).inspect_err(|_| video.forget())?;
        if outcome.modelled == Modelled::Nothing {
            // No state was made that the next frame could go on from.
            video.forget();
            return Ok(outcome);
        }
        Ok(Outcome {
            start: video.start,
            iterations: video.start.iterations(iterations),
            averaged: video.averaged(),
            ..outcome
        })
    }
}

impl Plan {
    /// The direct start's equations, if they are those of another operator as well.
    pub(super) fn coarse_for(&self, operator: &StokesOperator) -> Option<Arc<Coarse>> {
        let own = &self.operator;
        let same = Arc::ptr_eq(&own.kernel, &operator.kernel) && Arc::ptr_eq(&own.response, &operator.response);
        same.then(|| Arc::clone(&self.coarse))
    }

    /// Reconstructs one channel into `out`: `[3, H, W]`, or `[1, H, W]` without a mask.
    fn run(
        &self,
        Channel { raw, weight, guide }: Channel<'_>,
        iterations: usize,
        previous: Option<Previous<'_>>,
        out: &mut [f32],
        w: &mut Workspace,
    ) -> Result<ChannelOutcome, Diverged> {
        let size = self.operator.convolver.size();
        w.begin();
        let sigma = reading_noise(raw, weight, size, self.operator.response.row_period(), &mut w.samples);
        // Readings without weight hold an estimate, which is good enough for the direct start.
        w.target.copy_from_slice(raw);
        if let Some(guide) = guide {
            self.denoise(guide, w);
        }
        let unguided = |energy| ChannelOutcome { energy, gain: 1.0, sigma, modelled: Modelled::Intensity };
        let outcome = match self.unknowns {
            Unknowns::Polarized => {
                let spare = &mut out[..size.pixels()];
                match self.solve_polarized(weight, sigma, iterations, previous, spare, w)? {
                    Solved::Polarized { gain, energy } => {
                        ChannelOutcome { energy, gain, sigma, modelled: Modelled::Polarized }
                    }
                    Solved::Unpolarized { gain } => return Ok(unpolarized(weight, sigma, gain, out, w)),
                }
            }
            Unknowns::Intensity if self.guided => unguided(self.solve_guided_intensity(weight, sigma, iterations, w)?),
            Unknowns::Intensity => unguided(self.solve_intensity(weight, sigma, iterations, w)?),
            Unknowns::Both => {
                let energy = self.solve_both(weight, sigma, iterations, w)?;
                ChannelOutcome { modelled: Modelled::Both, ..unguided(energy) }
            }
        };
        self.store(out, w);
        Ok(outcome)
    }
}

/// Stores the guide as S0, with no polarization.
fn unpolarized(weight: &[f32], sigma: f32, gain: f32, out: &mut [f32], w: &Workspace) -> ChannelOutcome {
    let (s0, polarized) = out.split_at_mut(w.guide.len());
    s0.copy_from_slice(&w.guide);
    polarized.fill(0.0);
    let energy = w.target.iter().zip(weight).map(|(t, w)| f64::from(t * w).powi(2)).sum();
    ChannelOutcome { energy, gain, sigma, modelled: Modelled::Nothing }
}
