//! S0 where the guide does not see the scene: what a misaligned guide leaves out at the frame's border is solved for from the
//! readings, by a few steps of conjugate gradients on
//!
//! ‖r − m0 ⊙ (k * δ) − Re(ē ⊙ (k * L))‖² + λ‖∇δ‖², δ = 0 where the guide is known,
//!
//! with L eliminated as in `fit.rs` and λ from the noise and the guide's own gradients. The gain of the rest of the guide is an unknown too:
//! much light from beyond the frame would be mistaken for it.

use super::fit::{self, Columns, Frame};
use crate::image::{Buffers, Complex32, Size, Stack};
use crate::optics::Scratch;

/// Steps; more do not help, unless more than 1/MANY of the pixels are hidden.
const STEPS: usize = 6;
const MANY: usize = 10;
/// λ in units of noise variance over the guide's mean squared gradient.
const SMOOTHNESS: f64 = 0.1;

#[derive(Debug)]
pub(super) struct Workspace {
    /// True for pixels where the guide does not see the scene.
    pub(super) hidden: Vec<bool>,
    /// Number of such pixels.
    pub(super) hidden_count: usize,
    direction: Vec<f32>,
    rest: Vec<f32>,
}

impl Workspace {
    pub(super) fn new(size: Size, buffers: &mut Buffers) -> Self {
        let n = size.pixels();
        let hidden = buffers.filled(false, n);
        Self { hidden, hidden_count: 0, direction: buffers.filled(0.0, n), rest: buffers.filled(0.0, n) }
    }

    /// A plane for other uses between two calls of [`Self::fill`].
    pub(super) fn plane(&mut self) -> &mut [f32] {
        &mut self.direction
    }

    /// Two planes for other uses between two calls of [`Self::fill`], and what is hidden.
    pub(super) fn buffers(&mut self) -> (&mut [f32], &mut [f32], &[bool]) {
        let hidden = if self.hidden_count > 0 { &self.hidden[..] } else { &[] };
        (&mut self.direction, &mut self.rest, hidden)
    }

    /// Takes over the pixels of `kept` that the guide does not see.
    pub(super) fn keep_hidden(&self, guide: &mut Stack<f32>, kept: &Stack<f32>) {
        if self.hidden_count == 0 {
            return;
        }
        for (guide, kept) in guide.planes_mut().zip(kept.planes()) {
            let pixels = guide.iter_mut().zip(kept).zip(&self.hidden);
            pixels.filter(|(_, hidden)| **hidden).for_each(|((g, kept), _)| *g = *kept);
        }
    }

    /// Whether the guide does not see the scene at pixel `i`.
    pub(super) fn is_hidden(&self, i: usize) -> bool {
        self.hidden_count > 0 && self.hidden[i]
    }

    /// Marks the pixels of which `is_hidden` says so.
    pub(super) fn mark(&mut self, is_hidden: impl Fn(usize) -> bool) {
        self.hidden.iter_mut().enumerate().for_each(|(i, hidden)| *hidden = is_hidden(i));
        self.hidden_count = self.hidden.iter().filter(|hidden| **hidden).count();
    }

    /// Solves for channel `c` of the guide `g` where it is hidden, together with the gain of the rest, and applies the gain to all of it.
    /// Returns the gain; 0 where the guide explains nothing, which then stays as it is. Allocates nothing.
    pub(super) fn fill(
        &mut self,
        frame: &Frame<'_>,
        c: usize,
        y: &mut [f32],
        g: &mut [f32],
        scratch: &mut Scratch,
        w: &mut fit::Workspace,
    ) -> f32 {
        let size = frame.weight.size();
        let fit = w.fit(frame, c, y, g, Columns::Gain, scratch);
        if fit.gain <= 0.0 {
            return 0.0;
        }
        g.iter_mut().for_each(|g| *g *= fit.gain as f32);
        let noise = w.rest.iter().map(|r| f64::from(r * r)).sum::<f64>() / frame.trusted;
        let lambda = (SMOOTHNESS * noise / squared_gradient(g, &self.hidden, size).max(f64::MIN_POSITIVE)) as f32;
        let change = self.solve(frame, c, lambda, g, scratch, w);
        let pixels = g.iter_mut().zip(&self.hidden);
        pixels.for_each(|(g, hidden)| *g = if *hidden { g.max(0.0) } else { *g * change });
        fit.gain as f32 * change
    }

    /// Takes the steps of conjugate gradients for the hidden pixels of `g`, and returns the factor by which the others change.
    fn solve(
        &mut self,
        frame: &Frame<'_>,
        c: usize,
        lambda: f32,
        g: &mut [f32],
        scratch: &mut Scratch,
        w: &mut fit::Workspace,
    ) -> f32 {
        let Self { hidden, hidden_count, direction, rest } = self;
        let size = frame.weight.size();
        // The unknowns are the hidden pixels, and a factor of the image `seen` of all others.
        let length =
            g.iter().zip(&*hidden).filter(|(_, hidden)| !**hidden).map(|(g, _)| f64::from(*g).powi(2)).sum::<f64>();
        let length = length.sqrt().max(f64::MIN_POSITIVE) as f32;
        let seen = |g: &[f32], i: usize| g[i] / length;
        let factor_of = |g: &[f32], image: &[Complex32], hidden: &[bool]| -> f32 {
            let products = (0..g.len()).filter(|i| !hidden[*i]).map(|i| f64::from(seen(g, i) * image[i].re));
            products.sum::<f64>() as f32
        };
        w.adjoint_rest(frame, c, scratch);
        let mut factor = Factor { rest: factor_of(g, &w.image, hidden), ..Factor::default() };
        let known = |i: usize, v: f32| if hidden[i] { v } else { 0.0 };
        (0..g.len()).for_each(|i| rest[i] = known(i, w.image[i].re));
        direction.copy_from_slice(rest);
        factor.direction = factor.rest;
        let mut energy = square(rest) + f64::from(factor.rest).powi(2);
        let first = energy;
        let steps = if *hidden_count * MANY > g.len() { 2 * STEPS } else { STEPS };
        for _ in 0..steps {
            if energy <= 1e-8 * first || energy <= 0.0 {
                break;
            }
            (0..g.len()).filter(|i| !hidden[*i]).for_each(|i| direction[i] = factor.direction * seen(g, i));
            w.normal(frame, c, direction, scratch);
            (0..g.len()).filter(|i| !hidden[*i]).for_each(|i| direction[i] = 0.0);
            let applied = |i: usize| known(i, w.image[i].re + lambda * laplacian(direction, i, size));
            let of_factor = factor_of(g, &w.image, hidden);
            let curvature = (0..g.len()).map(|i| f64::from(direction[i]) * f64::from(applied(i))).sum::<f64>()
                + f64::from(factor.direction) * f64::from(of_factor);
            if curvature <= 0.0 {
                break;
            }
            let step = (energy / curvature) as f32;
            rest.iter_mut().enumerate().for_each(|(i, rest)| *rest -= step * applied(i));
            // Hidden pixels take their steps at once; the others keep the image that the factor belongs to.
            (0..g.len()).filter(|i| hidden[*i]).for_each(|i| g[i] += step * direction[i]);
            factor.sum += step * factor.direction;
            factor.rest -= step * of_factor;
            let next = square(rest) + f64::from(factor.rest).powi(2);
            let keep = (next / energy) as f32;
            energy = next;
            direction.iter_mut().zip(&*rest).for_each(|(d, r)| *d = r + keep * *d);
            factor.direction = factor.rest + keep * factor.direction;
        }
        (1.0 + factor.sum / length).max(0.5)
    }
}

/// The factor of the visible part of the guide in conjugate gradients.
#[derive(Clone, Copy, Debug, Default)]
struct Factor {
    sum: f32,
    rest: f32,
    direction: f32,
}

fn square(v: &[f32]) -> f64 {
    v.iter().map(|v| f64::from(*v) * f64::from(*v)).sum()
}

/// ∇ᵀ∇ with free borders.
fn laplacian(v: &[f32], i: usize, Size { width, height }: Size) -> f32 {
    let (x, y) = (i % width, i / width);
    let mut sum = 0.0;
    let mut add = |inside: bool, j: usize| {
        if inside {
            sum += v[i] - v[j];
        }
    };
    add(x > 0, i.wrapping_sub(1));
    add(x + 1 < width, i + 1);
    add(y > 0, i.wrapping_sub(width));
    add(y + 1 < height, i + width);
    sum
}

/// Mean square of one component of the gradient, where the guide sees the scene.
fn squared_gradient(g: &[f32], hidden: &[bool], Size { width, .. }: Size) -> f64 {
    let (mut sum, mut count) = (0.0, 0usize);
    for i in 0..g.len() {
        let right = (i % width + 1 < width).then_some(i + 1);
        for j in right.into_iter().chain(Some(i + width).filter(|j| *j < g.len())) {
            if !hidden[i] && !hidden[j] {
                sum += f64::from(g[j] - g[i]).powi(2);
                count += 1;
            }
        }
    }
    sum / count.max(1) as f64
}
