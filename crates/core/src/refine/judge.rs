//! Puts the tiles' corrections together and holds the result against the readings.

use std::ops::Range;

use super::{Input, Plan, Workspace, lock, mean_square};
use crate::image::Complex32;
use crate::optics::Scratch;

/// Share of the residual's energy by which a tile may raise it: the effect of a slightly wrong PSF.
const TOLERANCE: f64 = 0.1;
/// Rounds of refusing tiles. A frame in which the readings still contradict a tile then keeps the result of stage I.
const ROUNDS: usize = 3;

impl Plan {
    /// w.residual ← weight ⊙ (y − A·x). Returns its sum of squares.
    pub(super) fn residual(&self, c: usize, input: &Input<'_>, stokes: &[f32], w: &mut Workspace) -> f64 {
        let (operator, n) = (&self.operators[c], w.plane.len());
        operator.forward_s0(&stokes[..n], &mut w.plane, &mut w.scratch);
        let s12 = stokes[n..2 * n].iter().zip(&stokes[2 * n..]);
        w.polarized.iter_mut().zip(s12).for_each(|(l, (s1, s2))| *l = Complex32::new(*s1, *s2));
        operator.forward_polarized(&w.polarized, &mut w.residual, &mut w.scratch);
        let (y, weight) = (input.raw.plane(c), input.weight.plane(c));
        let readings = w.residual.iter_mut().zip(&w.plane).zip(y.iter().zip(weight));
        readings.for_each(|((r, plain), (y, weight))| *r = weight * (y - plain - *r));
        mean_square(&w.residual) * n as f64
    }

    /// w.back ← Aᵀ·residual.
    pub(super) fn back_project(&self, c: usize, w: &mut Workspace) {
        let (operator, n) = (&self.operators[c], w.plane.len());
        operator.adjoint_polarized(&w.residual, &mut w.polarized, &mut w.scratch);
        let (r0, r12) = w.back.as_mut_slice().split_at_mut(n);
        operator.adjoint_s0(&w.residual, r0, &mut w.scratch);
        let (r1, r2) = r12.split_at_mut(n);
        w.polarized.iter().zip(r1.iter_mut().zip(r2)).for_each(|(v, (r1, r2))| (*r1, *r2) = (v.re, v.im));
    }

    /// Applies the corrections of channel `c` to `stokes`, but for those that contradict the readings. `energy` is ‖r‖² of stage I.
    /// Returns the number of corrections that are not finite or were refused.
    pub(super) fn judge(
        &self,
        c: usize,
        input: &Input<'_>,
        energy: f64,
        stokes: &mut [f32],
        w: &mut Workspace,
    ) -> usize {
        let (n, tiles) = (w.plane.len(), self.tiles(c));
        let mut refused = 0;
        for tile in &w.tiles[tiles.clone()] {
            let mut tile = lock(tile);
            refused += usize::from(tile.applied && !tile.usable);
            tile.applied &= tile.usable;
        }
        let trusted = input.weight.plane(c).iter().filter(|v| **v > 0.0).count().max(1) as f64;
        // Energy of the noise, three standard deviations above its mean.
        let expected = f64::from(input.sigma).powi(2) * (trusted + 3.0 * (2.0 * trusted).sqrt());
        let allowance = ((expected - energy).max(0.0) + TOLERANCE * energy) / n as f64;
        for round in 0..=ROUNDS {
            if !self.compose(c, &tiles, stokes, w) {
                break;
            }
            let growth = self.residual_after(c, input, stokes, w) - energy;
            let allowance = if round < ROUNDS { allowance } else { f64::NEG_INFINITY };
            let now = self.refuse(&tiles, stokes, growth, allowance, w);
            refused += now;
            if now == 0 {
                stokes[n..].copy_from_slice(w.refined.as_slice());
                break;
            }
        }
        refused
    }

    /// w.refined ← stage I and the hidden part of the applied corrections, with |S1 + i·S2| ≤ S0. Returns whether any correction
    /// is applied.
    fn compose(&self, c: usize, tiles: &Range<usize>, stokes: &[f32], w: &mut Workspace) -> bool {
        let n = w.plane.len();
        let change = w.refined.as_mut_slice();
        change.fill(0.0);
        let mut any = false;
        for (t, tile) in w.tiles[tiles.clone()].iter().enumerate() {
            let tile = lock(tile);
            if !tile.applied {
                continue;
            }
            any = true;
            let parts = tile.correction.chunks_exact(tile.correction.len() / 2);
            for (plane, part) in change.chunks_exact_mut(n).zip(parts) {
                self.layout.for_rows(t, |at, from, row, weights| {
                    let pixels = plane[at..].iter_mut().zip(&part[from..]).zip(weights);
                    pixels.for_each(|((v, a), weight)| *v += row * weight * a);
                });
            }
        }
        if !any {
            return false;
        }
        let (s1, s2) = change.split_at_mut(n);
        self.hide(c, [&mut *s1, &mut *s2], &mut w.polarized, &mut w.scratch);
        let (s0, s12) = stokes.split_at(n);
        let before = s12.iter().zip(&s12[n..]);
        for ((s0, (s1, s2)), (before1, before2)) in s0.iter().zip(s1.iter_mut().zip(s2)).zip(before) {
            (*s1, *s2) = (*s1 + before1, *s2 + before2);
            let l = (*s1 * *s1 + *s2 * *s2).sqrt();
            if l > *s0 {
                (*s1, *s2) = (*s1 * *s0 / l, *s2 * *s0 / l);
            }
        }
        true
    }

    /// Keeps the frequencies of the change of S1 and S2 that the PSF hides. The change goes on as its mirror beyond the frame: were it zero
    /// there, a change that is the same everywhere would stay at the borders. `l` is a buffer.
    fn hide(&self, c: usize, [s1, s2]: [&mut [f32]; 2], l: &mut [Complex32], scratch: &mut Scratch) {
        let (filter, width) = (&self.hidden[c.min(self.hidden.len() - 1)], self.operators[c].convolver.size().width);
        let load = |y: usize, line: &mut [Complex32]| {
            let pixels = s1[y * width..][..width].iter().zip(&s2[y * width..]);
            line.iter_mut().zip(pixels).for_each(|(v, (s1, s2))| *v = Complex32::new(*s1, *s2));
        };
        let store = |_: usize, line: &[Complex32], out: &mut [Complex32]| out.copy_from_slice(line);
        self.operators[c].convolver.filter(filter, load, l, store, scratch);
        l.iter().zip(s1.iter_mut().zip(s2)).for_each(|(v, (s1, s2))| (*s1, *s2) = (v.re, v.im));
    }

    /// Returns ‖r′‖² of r′ = r − A·d, d = w.refined − stage I. With several tiles also w.polarized ← Aᵀ·r′.
    fn residual_after(&self, c: usize, input: &Input<'_>, stokes: &[f32], w: &mut Workspace) -> f64 {
        let (operator, n) = (&self.operators[c], w.plane.len());
        let change =
            |k: usize| w.refined.plane(k).iter().zip(&stokes[(1 + k) * n..]).map(|(after, before)| after - before);
        for (d, (s1, s2)) in w.polarized.iter_mut().zip(change(0).zip(change(1))) {
            *d = Complex32::new(s1, s2);
        }
        operator.forward_polarized(&w.polarized, &mut w.plane, &mut w.scratch);
        let readings = w.plane.iter_mut().zip(&w.residual).zip(input.weight.plane(c));
        readings.for_each(|((d, r), weight)| *d = r - weight * *d);
        if self.layout.count() > 1 {
            operator.adjoint_polarized(&w.plane, &mut w.polarized, &mut w.scratch);
        }
        mean_square(&w.plane) * n as f64
    }

    /// Refuses the applied tiles that raise the energy of the residual by more than `allowance` per pixel, and returns their number.
    /// `growth` is by how much all together raise it. With several tiles Aᵀr in w.back and Aᵀr′ in w.polarized give each one's share.
    fn refuse(&self, tiles: &Range<usize>, stokes: &[f32], growth: f64, allowance: f64, w: &mut Workspace) -> usize {
        let n = w.plane.len();
        let (refined, back) = (w.refined.as_slice(), &w.back.as_slice()[n..]);
        let growth_at = |i: usize| {
            let d = |k: usize| refined[k * n + i] - stokes[(1 + k) * n + i];
            -d(0) * (back[i] + w.polarized[i].re) - d(1) * (back[n + i] + w.polarized[i].im)
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
            // Not a number is no agreement with the readings.
            tile.applied = share <= allowance * pixels;
            refused += usize::from(!tile.applied);
        }
        refused
    }
}
