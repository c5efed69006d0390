//! Fit of a guide to the readings: least squares over its gain a, the polarized part L and, in a second model, a smooth error δ
//! of the guide,
//!
//! ‖y − a·m0 ⊙ (k * g) − Re(ē ⊙ (k * L)) − m0 ⊙ (k * δ)‖² + the priors of L and δ,
//!
//! for each channel, with derivatives by a few more images ([`Columns`]). L and δ are combinations of the slow modes of
//! [`Coarse`] and are eliminated exactly: every product ⟨u, v⟩ of the normal equations becomes ⟨u, v⟩ − ⟨u′, v′⟩. So neither
//! strong polarization nor vignetting is mistaken for misalignment. The first entries of u′ belong to L alone: both models
//! together cost one evaluation.
//!
//! The modes' normal matrix is an approximation, and polarization can hold a thousand times the energy of a misalignment. So the
//! polarization found is subtracted through the exact operator, and only the remainder relies on the approximation.
//!
//! Untrusted readings are replaced by the fit's prediction (expectation–maximization), so that the normal matrix of a whole
//! frame stays valid.

use std::sync::Arc;

use nalgebra::SMatrix;
use num_complex::Complex32;

use crate::image::{Buffers, Size, Stack};
use crate::optics::{Coarse, CoarseWorkspace, Direction, Scratch, StokesOperator};

/// Ridge of the slow modes, relative to the strongest.
const RIDGE: f64 = 1e-5;
/// Times that untrusted readings are predicted anew.
const PREDICTIONS: usize = 3;
/// Times that [`Workspace::glance`] solves for L.
const LOOKS: usize = 2;

/// Images beside g and the residual: of an affine map, of a tone curve, of that and shading.
pub(super) const AFFINE: usize = 6;
pub(super) const TONES: usize = 4;
pub(super) const COLUMNS: usize = 10;
/// g, and what the model leaves of y.
pub(super) const GUIDE: usize = COLUMNS;
pub(super) const REST: usize = COLUMNS + 1;
const IMAGES: usize = COLUMNS + 2;
/// g less its own smooth part, which takes g's place where a smooth error is fitted: a tiny rest of large products would be
/// left otherwise, and the modes' normal matrix is not that exact.
const DETAIL: usize = IMAGES;
const REDUCED: usize = IMAGES + 1;

/// Products of the images, less what the modes explain of them; symmetric.
pub(super) type Gram = SMatrix<f64, IMAGES, IMAGES>;

/// The images that are fitted beside the guide.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Columns {
    /// No image: the gain alone.
    Gain,
    /// ∂g/∂x and ∂g/∂y: a shift.
    Shift,
    /// The images of a shift and their products with the coordinates from −1 to 1 (longer side): an affine map.
    Affine,
    /// g², √g, g³ and ∜g, in the guide's units: a tone curve. Then its products with x, y, x², xy, y² and r⁴: shading.
    Curve,
    /// Tones less their smooth part: a tone curve beside a smooth error.
    Tones,
}

impl Columns {
    pub(super) fn count(self) -> usize {
        match self {
            Self::Gain => 0,
            Self::Shift => 2,
            Self::Tones => TONES,
            Self::Affine => AFFINE,
            Self::Curve => COLUMNS,
        }
    }

    /// The images at pixel `i`, those of [`Self::Tones`] whole. `brightness` is the guide's mean.
    pub(super) fn at(self, g: &[f32], i: usize, size: Size, brightness: f32) -> [f32; COLUMNS] {
        let Size { width, height } = size;
        let (x, y) = (i % width, i / width);
        let place = || {
            let (cx, cy, unit) = centre(size);
            (((x as f64 - cx) / unit) as f32, ((y as f64 - cy) / unit) as f32)
        };
        let mut v = [0.0; COLUMNS];
        if matches!(self, Self::Shift | Self::Affine) {
            let row = y * width;
            v[0] = 0.5 * (g[row + (x + 1).min(width - 1)] - g[row + x.saturating_sub(1)]);
            v[1] = 0.5 * (g[(y + 1).min(height - 1) * width + x] - g[y.saturating_sub(1) * width + x]);
            if self == Self::Affine {
                let (px, py) = place();
                (v[2], v[3], v[4], v[5]) = (px * v[0], py * v[0], px * v[1], py * v[1]);
            }
        } else if self != Self::Gain {
            let relative = g[i] / brightness;
            let root = relative.sqrt();
            let (tones, shading) = v.split_at_mut(TONES);
            tones.copy_from_slice(&[relative.powi(2), root, relative.powi(3), root.sqrt()]);
            if self == Self::Curve {
                let (px, py) = place();
                let shades = [px, py, px * px, px * py, py * py, (px * px + py * py).powi(2)];
                shading.iter_mut().zip(shades).for_each(|(v, shade)| *v = relative * shade);
            }
            v.iter_mut().for_each(|v| *v *= brightness);
        }
        v
    }

    /// The guide and its images at pixel `i`, weighed with `theta`.
    pub(super) fn combined(self, g: &[f32], i: usize, size: Size, brightness: f32, theta: &[f64]) -> f32 {
        let images = self.at(g, i, size, brightness);
        std::iter::once(&g[i]).chain(&images).zip(theta).map(|(v, theta)| f64::from(*v) * theta).sum::<f64>() as f32
    }
}

/// The frame's centre and half of its longer side.
pub(super) fn centre(size: Size) -> (f64, f64, f64) {
    let half = |n: usize| (n as f64 - 1.0) / 2.0;
    (half(size.width), half(size.height), size.width.max(size.height) as f64 / 2.0)
}

/// The camera and what to trust of one frame.
pub(super) struct Frame<'a> {
    pub(super) operators: &'a [StokesOperator],
    /// S1, S2 and the smooth error; empty without a mask.
    pub(super) coarse: &'a [Arc<Coarse>],
    pub(super) weight: &'a Stack<f32>,
    /// Trusted readings.
    pub(super) trusted: f64,
    /// Variance of the noise of one.
    pub(super) noise: f64,
    /// Readings of an evenly bright scene that begins where the frame ends; none where light from there is modelled or not looked for.
    pub(super) beyond: Option<&'a [f32]>,
}

impl Frame<'_> {
    /// Readings, trusted or not.
    fn readings(&self) -> usize {
        self.operators.iter().map(|operator| operator.field().frame().pixels()).sum()
    }
}

/// One channel's fit.
#[derive(Clone, Copy, Debug)]
pub(super) struct Channel {
    /// The gain that the rest was computed with.
    pub(super) gain: f64,
    /// Sum of squares of the guide's share with a gain of 1.
    pub(super) square: f64,
    /// Normal matrix with L eliminated.
    pub(super) polarized: Gram,
    /// Normal matrix of the guide's detail with L and δ eliminated; equal to `polarized` without a mask.
    pub(super) smooth: Gram,
    /// Sum of squares that a featureless guide leaves; of cameras without a mask only.
    pub(super) featureless: f64,
}

/// Result of a look at one channel ([`Workspace::glance`]).
#[derive(Clone, Copy, Debug)]
pub(super) struct Glance {
    /// The guide's gain.
    pub(super) gain: f64,
    /// Sum of squares left.
    pub(super) rest: f64,
    /// Products of an affine map's images with the rest.
    pub(super) slopes: [f64; AFFINE],
    /// Sum of squares by which a smooth error of the guide would lower the rest.
    pub(super) smooth: f64,
}

#[derive(Debug)]
pub(super) struct Workspace {
    /// Two images behind diffuser and mask.
    pub(super) blurred: Vec<Complex32>,
    /// An image between adjoint and modes.
    pub(super) image: Vec<Complex32>,
    /// Readings less the fit.
    pub(super) rest: Vec<f32>,
    /// u′ of each image.
    pub(super) reduced: Vec<f64>,
    /// y′ of each channel, and whether it is known.
    readings: Vec<f64>,
    known: bool,
    /// Coefficients of the modes.
    pub(super) modes: Vec<f64>,
    pub(super) coarse: Option<CoarseWorkspace>,
}

impl Workspace {
    pub(super) fn new(coarse: &[Arc<Coarse>], size: Size, buffers: &mut Buffers) -> Self {
        let (n, unknowns) = (size.pixels(), coarse.first().map_or(0, |c| c.unknowns()));
        Self {
            blurred: buffers.filled(Complex32::ZERO, n),
            image: buffers.filled(Complex32::ZERO, n),
            rest: buffers.filled(0.0, n),
            reduced: buffers.filled(0.0, unknowns * REDUCED),
            readings: buffers.filled(0.0, unknowns * coarse.len()),
            known: false,
            modes: buffers.filled(0.0, unknowns),
            coarse: coarse.first().map(|c| c.workspace(buffers)),
        }
    }

    /// Makes the next frame independent of earlier ones.
    pub(super) fn forget(&mut self) {
        self.coarse.iter_mut().for_each(CoarseWorkspace::forget);
    }

    /// Forgets the last frame. `level` is the brightness of the margin over that of the frame. Allocates nothing.
    pub(super) fn begin(&mut self, frame: &Frame<'_>, level: f32) {
        self.known = false;
        if let (Some(coarse), Some(w)) = (frame.coarse.first(), &mut self.coarse) {
            coarse.factor([RIDGE; 3], level, w);
        }
    }

    /// Marks the readings as known for all channels.
    pub(super) fn keep_readings(&mut self, frame: &Frame<'_>) {
        self.known = frame.trusted >= frame.readings() as f64;
    }

    /// Fits channel `c` with the guide `g`; replaces untrusted readings of `y`. Leaves the rest and all u′ in the buffers.
    /// Allocates nothing.
    pub(super) fn fit(
        &mut self,
        frame: &Frame<'_>,
        c: usize,
        y: &mut [f32],
        g: &[f32],
        columns: Columns,
        scratch: &mut Scratch,
    ) -> Channel {
        let Self { blurred, image, rest, reduced, readings, known, modes: found, coarse } = self;
        let slow = frame.coarse.get(c).map(AsRef::as_ref).zip(coarse.as_mut());
        let (unknowns, polarized) = (found.len(), slow.as_ref().map_or(0, |(modes, _)| 2 * modes.modes()));
        let readings = &mut readings[c * unknowns..][..polarized];
        let (operator, brightness) = (&frame.operators[c], mean(g));
        let mut fit = Fit {
            operator,
            g,
            brightness,
            columns,
            slow,
            unknowns,
            polarized,
            blurred,
            image,
            rest,
            reduced,
            found,
            scratch,
        };
        let square = fit.blur_guide();
        let gain = fit.predict_untrusted(y, frame.weight.plane(c), (readings, *known), square);
        // f is a featureless guide, or the detail.
        let (blurred, rest) = (&*fit.blurred, &*fit.rest);
        let [gt, tt, ff, fy, ft] = sum(y.len(), |i| {
            let Complex32 { re: g, im: f } = blurred[i];
            [g * rest[i], rest[i] * rest[i], f * f, f * y[i], f * rest[i]]
        });
        let featureless = sum(y.len(), |i| [y[i] * y[i]])[0] - if ff > 0.0 { fy * fy / ff } else { 0.0 };
        let penalty = fit.eliminate_polarization();
        let mut grams = [Gram::zeros(); 2];
        let [gram, with_detail] = &mut grams;
        (gram[(GUIDE, GUIDE)], gram[(GUIDE, REST)], gram[(REST, REST)]) = (square, gt, tt + penalty);
        *with_detail = *gram;
        if fit.slow.is_some() {
            (with_detail[(GUIDE, GUIDE)], with_detail[(GUIDE, REST)]) = (ff, ft);
        }
        fit.correlate_guide(&mut grams);
        (0..columns.count()).step_by(2).for_each(|first| fit.correlate_columns(first, &mut grams));
        let polarized = fit.eliminate_modes(&grams[0], GUIDE, polarized);
        let smooth = if fit.slow.is_some() { fit.eliminate_modes(&grams[1], DETAIL, unknowns) } else { polarized };
        Channel { gain, square, polarized, smooth, featureless }
    }

    /// Looks at channel `c` with a guide `g` whose gain is nearly 1, in six convolutions; `share` is how much of the guide's
    /// square L leaves. L is found twice, the second time from what the first leaves: the rest is then exact, and so are its
    /// products with whatever moves the guide. Untrusted readings of `y` are replaced. Allocates nothing.
    pub(super) fn glance(
        &mut self,
        frame: &Frame<'_>,
        c: usize,
        y: &mut [f32],
        g: &[f32],
        share: f64,
        scratch: &mut Scratch,
    ) -> Glance {
        let Self { blurred, image, rest, reduced, modes: found, coarse, .. } = self;
        let (operator, weight) = (&frame.operators[c], frame.weight.plane(c));
        let size = operator.convolver.size();
        let n = found.len();
        let mut slow = frame.coarse.get(c).map(AsRef::as_ref).zip(coarse.as_mut());
        let p = slow.as_ref().map_or(0, |(modes, _)| 2 * modes.modes());
        forward(operator, |i| Complex32::from(g[i]), blurred, scratch);
        let square = sum(blurred.len(), |i| [blurred[i].re * blurred[i].re])[0];
        let mut gain = 1.0;
        rest.iter_mut().zip(y.iter().zip(&*blurred)).for_each(|(r, (y, u))| *r = y - u.re);
        let residual = &mut reduced[REST * n..][..n];
        found.fill(0.0);
        for _ in 0..LOOKS {
            if let Some((modes, w)) = &mut slow {
                let part = &mut residual[..p];
                adjoint(operator, |i| rest[i], image, scratch);
                project_both(modes, image, part, w);
                modes.subtract_ridge(&found[..p], part, w);
                modes.solve(part, w);
                found.iter_mut().zip(&*part).for_each(|(c, more)| *c += more);
                let (re, im) = part.split_at(p / 2);
                modes.synthesize(re, im, image, w);
                forward_polarized_beside(operator, image, blurred, scratch);
                rest.iter_mut().zip(&*blurred).for_each(|(r, b)| *r -= b.im);
            }
            let change =
                if square > 0.0 { sum(y.len(), |i| [blurred[i].re * rest[i]])[0] / (share * square) } else { 0.0 };
            gain += change;
            for (i, r) in rest.iter_mut().enumerate() {
                *r -= change as f32 * blurred[i].re;
                if weight[i] == 0.0 {
                    y[i] -= *r;
                    *r = 0.0;
                }
            }
        }
        adjoint_s0(operator, |i| Complex32::from(rest[i]), image, scratch);
        let mut slopes = [0.0; AFFINE];
        for (i, v) in image.iter().enumerate() {
            let columns = Columns::Affine.at(g, i, size, 1.0);
            slopes.iter_mut().zip(columns).for_each(|(s, c)| *s += f64::from(c) * f64::from(v.re));
        }
        let mut smooth = 0.0;
        if let Some((modes, w)) = &mut slow {
            residual[..p].fill(0.0);
            modes.project_last(image, &mut residual[p..], &mut [], w);
            modes.whiten_from(p, residual, w);
            smooth = inner(&residual[p..], &residual[p..]);
        }
        Glance { gain, rest: sum(rest.len(), |i| [rest[i] * rest[i]])[0], slopes, smooth }
    }
}

impl Workspace {
    /// Correction of the guide by a fit with [`Columns::Tones`], as real parts of [`Self::image`]: the detail and the tones times
    /// `theta`, and the smooth error that goes with them. Allocates nothing.
    pub(super) fn correction(&mut self, frame: &Frame<'_>, c: usize, g: &[f32], theta: &[f64]) {
        let Self { blurred, image, reduced, modes: found, coarse, .. } = self;
        let (size, brightness) = (frame.weight.size(), mean(g));
        for (i, v) in image.iter_mut().enumerate() {
            *v = Complex32::from(Columns::Tones.combined(g, i, size, brightness, theta));
        }
        let Some((modes, w)) = frame.coarse.get(c).zip(coarse.as_mut()) else { return };
        let (n, p) = (found.len(), 2 * modes.modes());
        found.copy_from_slice(&reduced[REST * n..][..n]);
        for (theta, image) in theta.iter().zip(std::iter::once(DETAIL).chain(0..)) {
            found.iter_mut().zip(&reduced[image * n..]).for_each(|(m, r)| *m -= theta * r);
        }
        modes.unwhiten(found, w);
        let (own, error) = found.split_at_mut(p);
        modes.project_last(image, &mut own[..n - p], &mut [], w);
        error.iter_mut().zip(own).for_each(|(e, own)| *e -= *own);
        modes.synthesize_last(error, &[], blurred, w);
        image.iter_mut().zip(blurred).for_each(|(v, e)| *v += *e);
    }

    /// Gradient of S0 by the rest of a fit, k̃ * (m0 ⊙ rest), as real parts of [`Self::image`]. Allocates nothing.
    pub(super) fn adjoint_rest(&mut self, frame: &Frame<'_>, c: usize, scratch: &mut Scratch) {
        let Self { image, rest, .. } = self;
        adjoint_s0(&frame.operators[c], |i| Complex32::from(rest[i]), image, scratch);
    }

    /// The normal matrix of S0, L eliminated, times `s0`, as real parts of [`Self::image`]. Allocates nothing.
    pub(super) fn normal(&mut self, frame: &Frame<'_>, c: usize, s0: &[f32], scratch: &mut Scratch) {
        let operator = &frame.operators[c];
        let Self { blurred, image, rest, modes: found, coarse, .. } = self;
        forward(operator, |i| Complex32::from(s0[i]), blurred, scratch);
        if let Some((modes, w)) = frame.coarse.get(c).zip(coarse.as_mut()) {
            let p = 2 * modes.modes();
            adjoint(operator, |i| blurred[i].re, image, scratch);
            project_both(modes, image, &mut found[..p], w);
            modes.whiten(&mut found[..p], w);
            modes.unwhiten(&mut found[..p], w);
            let (re, im) = found[..p].split_at(p / 2);
            modes.synthesize(re, im, image, w);
            operator.forward_polarized(image, rest, scratch);
            blurred.iter_mut().zip(rest).for_each(|(b, r)| b.re -= *r);
        }
        adjoint_s0(operator, |i| blurred[i], image, scratch);
    }
}

/// A fit of one channel in progress.
struct Fit<'a> {
    operator: &'a StokesOperator,
    g: &'a [f32],
    /// Mean of the guide.
    brightness: f32,
    columns: Columns,
    /// The slow modes; none without a mask.
    slow: Option<(&'a Coarse, &'a mut CoarseWorkspace)>,
    /// Unknowns of all slow modes, and of those of L, which come first.
    unknowns: usize,
    polarized: usize,
    /// The guide and its detail behind diffuser and mask, or the guide and a featureless one; later pairs of columns.
    blurred: &'a mut [Complex32],
    image: &'a mut [Complex32],
    rest: &'a mut [f32],
    reduced: &'a mut [f64],
    found: &'a mut [f64],
    scratch: &'a mut Scratch,
}

impl Fit<'_> {
    /// Blurs the guide and its detail (a featureless guide without a mask), and finds the part of L in the guide's share.
    /// Returns the sum of squares of that share.
    fn blur_guide(&mut self) -> f64 {
        let Self { operator, g, slow, polarized: p, blurred, image, found, scratch, .. } = self;
        let (p, guide) = (*p, &mut self.reduced[GUIDE * self.unknowns..]);
        if let Some((modes, w)) = slow {
            image.iter_mut().zip(*g).for_each(|(v, g)| *v = Complex32::from(*g));
            smooth_part(modes, image, found, w);
            forward(operator, |i| Complex32::new(g[i], g[i] - image[i].re), blurred, scratch);
            adjoint(operator, |i| blurred[i].re, image, scratch);
            project_both(modes, image, &mut guide[..p], w);
            modes.whiten(&mut guide[..p], w);
        } else {
            forward(operator, |i| Complex32::new(g[i], 1.0), blurred, scratch);
        }
        sum(blurred.len(), |i| [blurred[i].re * blurred[i].re])[0]
    }

    /// Finds the gain and L, and what they leave of `y`; replaces untrusted readings by their prediction, a few times over.
    /// `readings` is y′, which need not be found again if it is `known`. Returns the gain.
    fn predict_untrusted(
        &mut self,
        y: &mut [f32],
        weight: &[f32],
        (readings, known): (&mut [f64], bool),
        gg: f64,
    ) -> f64 {
        let Self { operator, slow, polarized: p, blurred, image, rest, found, scratch, .. } = self;
        let guide = &self.reduced[GUIDE * self.unknowns..][..*p];
        let trusted = weight.iter().filter(|w| **w > 0.0).count();
        let all_trusted = trusted == operator.field().frame().pixels();
        let mut gain = 0.0;
        for _ in 0..if all_trusted { 1 } else { PREDICTIONS } {
            let gy = sum(y.len(), |i| [blurred[i].re * y[i]])[0];
            if let Some((modes, w)) = slow {
                if !known {
                    adjoint(operator, |i| y[i], image, scratch);
                    project_both(modes, image, readings, w);
                    modes.whiten(readings, w);
                }
                let seen = gg - inner(guide, guide);
                gain = if seen > 0.0 { (gy - inner(guide, readings)) / seen } else { 0.0 };
                let found = &mut found[..*p];
                found.iter_mut().zip(readings.iter().zip(guide)).for_each(|(c, (y, g))| *c = y - gain * g);
                modes.unwhiten(found, w);
                let (re, im) = found.split_at(*p / 2);
                modes.synthesize(re, im, image, w);
                operator.forward_polarized(image, rest, scratch);
            } else {
                gain = if gg > 0.0 { gy / gg } else { 0.0 };
                rest.fill(0.0);
            }
            let explained = rest.iter_mut().zip(y.iter_mut().zip(weight.iter().zip(&**blurred)));
            for (rest, (y, (weight, u))) in explained {
                let prediction = gain as f32 * u.re + *rest;
                if *weight == 0.0 {
                    *y = prediction;
                }
                *rest = *y - prediction;
            }
        }
        gain
    }

    /// Finds the part of L in the rest and in the detail. Returns the penalty of the L that was found.
    fn eliminate_polarization(&mut self) -> f64 {
        let Self { operator, slow, polarized: p, blurred, image, rest, found, scratch, .. } = self;
        let (residual, detail) = self.reduced[REST * self.unknowns..].split_at_mut(self.unknowns);
        let (residual, detail) = (&mut residual[..*p], &mut detail[..*p]);
        let Some((modes, w)) = slow else { return 0.0 };
        adjoint(operator, |i| rest[i], image, scratch);
        project_both(modes, image, residual, w);
        let penalty = modes.subtract_ridge(&found[..*p], residual, w);
        modes.whiten(residual, w);
        adjoint(operator, |i| blurred[i].im, image, scratch);
        project_both(modes, image, detail, w);
        modes.whiten(detail, w);
        penalty
    }

    /// Products of the columns with the guide or its detail, and with the rest, in both models.
    fn correlate_guide(&mut self, [gram, with_detail]: &mut [Gram; 2]) {
        let Self { operator, g, brightness, columns, blurred, image, rest, scratch, .. } = self;
        let (size, p) = (operator.convolver.size(), self.polarized);
        let at = |columns: Columns, i: usize| columns.at(g, i, size, *brightness);
        let set = |gram: &mut Gram, products: &[(f64, f64)]| {
            for (q, product) in products.iter().enumerate() {
                (gram[(q, GUIDE)], gram[(q, REST)]) = *product;
            }
        };
        if !matches!(columns, Columns::Gain | Columns::Tones) {
            // The test for more than a shift asks for an affine map's products.
            let asked = if *columns == Columns::Shift { Columns::Affine } else { *columns };
            adjoint_s0(operator, |i| Complex32::new(blurred[i].re, rest[i]), image, scratch);
            let products = correlate(image, asked.count(), |i| at(asked, i));
            set(gram, &products[..asked.count()]);
            set(with_detail, &products[..asked.count()]);
        }
        if let Some((modes, w)) = &mut self.slow {
            let (residual, detail) = self.reduced[REST * self.unknowns..].split_at_mut(self.unknowns);
            adjoint_s0(operator, |i| Complex32::new(blurred[i].im, rest[i]), image, scratch);
            modes.project_last(image, &mut detail[p..], &mut residual[p..], w);
            if *columns == Columns::Tones {
                high_pass(modes, image, &detail[p..], &residual[p..], blurred, w);
            }
            let products = correlate(image, columns.count(), |i| at(*columns, i));
            set(with_detail, &products[..columns.count()]);
            modes.whiten_from(p, detail, w);
            modes.whiten_from(p, residual, w);
        }
    }

    /// Products of the columns `first` and `first + 1` with all columns, in both models. Overwrites the blurred guide.
    fn correlate_columns(&mut self, first: usize, [gram, with_detail]: &mut [Gram; 2]) {
        let Self { operator, g, brightness, columns, blurred, image, found, scratch, .. } = self;
        let (size, n, p) = (operator.convolver.size(), self.unknowns, self.polarized);
        let at = |i: usize| columns.at(g, i, size, *brightness);
        for (i, v) in image.iter_mut().enumerate() {
            let v_i = at(i);
            *v = Complex32::new(v_i[first], v_i[first + 1]);
        }
        let high_passed = *columns == Columns::Tones;
        if let Some((modes, w)) = self.slow.as_mut().filter(|_| high_passed) {
            let (re, im) = found.split_at_mut(n - p);
            let im = &mut im[..n - p];
            modes.project_last(image, re, im, w);
            high_pass(modes, image, re, im, blurred, w);
        }
        forward(operator, |i| image[i], blurred, scratch);
        let (one, two) = self.reduced[first * n..(first + 2) * n].split_at_mut(n);
        if let Some((modes, w)) = &mut self.slow {
            adjoint(operator, |i| blurred[i].re, image, scratch);
            project_both(modes, image, &mut one[..p], w);
            adjoint(operator, |i| blurred[i].im, image, scratch);
            project_both(modes, image, &mut two[..p], w);
        }
        adjoint_s0(operator, |i| blurred[i], image, scratch);
        if let Some((modes, w)) = &mut self.slow {
            modes.project_last(image, &mut one[p..], &mut two[p..], w);
            if high_passed {
                high_pass(modes, image, &one[p..], &two[p..], blurred, w);
            }
            modes.whiten(one, w);
            modes.whiten(two, w);
        }
        let products = correlate(image, columns.count(), at);
        for (q, product) in products[..columns.count()].iter().enumerate() {
            (gram[(q, first)], gram[(q, first + 1)]) = *product;
            (with_detail[(q, first)], with_detail[(q, first + 1)]) = *product;
        }
    }

    /// `gram` less what the first `unknowns` modes explain of each product; `guide` is the image that takes the guide's place.
    fn eliminate_modes(&self, gram: &Gram, guide: usize, unknowns: usize) -> Gram {
        let used = |image: usize| image >= GUIDE || image < self.columns.count();
        let at = |image: usize| if image == GUIDE { guide } else { image } * self.unknowns;
        let reduced = |image: usize| &self.reduced[at(image)..][..unknowns];
        // Columns that are not fitted have a product with the rest alone, and that only roughly.
        let mut less = Gram::zeros();
        less.column_mut(REST).copy_from(&gram.column(REST));
        for a in (0..IMAGES).filter(|a| used(*a)) {
            for b in (a..IMAGES).filter(|b| used(*b)) {
                less[(a, b)] = gram[(a, b)] - inner(reduced(a), reduced(b));
                less[(b, a)] = less[(a, b)];
            }
        }
        less
    }
}

/// Bᵀ image of both polarized planes.
pub(super) fn project_both(modes: &Coarse, image: &[Complex32], out: &mut [f64], w: &mut CoarseWorkspace) {
    let (re, im) = out.split_at_mut(modes.modes());
    modes.project(image, re, im, w);
}

/// image ← its part in the modes of the smooth error. `found` holds coefficients afterwards.
fn smooth_part(modes: &Coarse, image: &mut [Complex32], found: &mut [f64], w: &mut CoarseWorkspace) {
    let own = &mut found[2 * modes.modes()..];
    modes.project_last(image, own, &mut [], w);
    modes.synthesize_last(own, &[], image, w);
}

/// Subtracts the modes with coefficients `re` and `im` from an image; `plane` is scratch.
fn high_pass(
    modes: &Coarse,
    image: &mut [Complex32],
    re: &[f64],
    im: &[f64],
    plane: &mut [Complex32],
    w: &mut CoarseWorkspace,
) {
    modes.synthesize_last(re, im, plane, w);
    image.iter_mut().zip(plane).for_each(|(v, low)| *v -= *low);
}

/// ⟨column, re⟩ and ⟨column, im⟩ of an image, for the first `count` columns.
fn correlate(image: &[Complex32], count: usize, column: impl Fn(usize) -> [f32; COLUMNS]) -> [(f64, f64); COLUMNS] {
    let mut sums = [(0.0, 0.0); COLUMNS];
    for (i, z) in image.iter().enumerate() {
        for (sum, v) in sums[..count].iter_mut().zip(column(i)) {
            sum.0 += f64::from(v) * f64::from(z.re);
            sum.1 += f64::from(v) * f64::from(z.im);
        }
    }
    sums
}

pub(super) fn sum<const K: usize>(len: usize, terms: impl Fn(usize) -> [f32; K]) -> [f64; K] {
    let mut sums = [0.0; K];
    for i in 0..len {
        sums.iter_mut().zip(terms(i)).for_each(|(s, t)| *s += f64::from(t));
    }
    sums
}

pub(super) fn mean(values: &[f32]) -> f32 {
    (sum(values.len(), |i| [values[i]])[0] / values.len() as f64).max(f64::from(f32::MIN_POSITIVE)) as f32
}

pub(super) fn inner(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// Σ |∇g|² · (1, x, y, x², xy, y²), with the coordinates of [`Columns::Affine`]: where there is something that moves.
pub(super) fn moments(g: &[f32], size: Size) -> [f64; 6] {
    let (cx, cy, unit) = centre(size);
    let mut sums = [0.0; 6];
    for row in 0..size.height {
        let py = (row as f64 - cy) / unit;
        for column in 0..size.width {
            let v = Columns::Shift.at(g, row * size.width + column, size, 1.0);
            let (px, square) = ((column as f64 - cx) / unit, f64::from(v[0] * v[0] + v[1] * v[1]));
            let terms = [1.0, px, py, px * px, px * py, py * py];
            sums.iter_mut().zip(terms).for_each(|(s, t)| *s += square * t);
        }
    }
    sums
}

/// out.im = Re(ē ⊙ (k * L)); out.re stays.
fn forward_polarized_beside(operator: &StokesOperator, l: &[Complex32], out: &mut [Complex32], scratch: &mut Scratch) {
    let (e, width) = (operator.response.polarized(), operator.convolver.size().width);
    operator.convolver.run(
        &operator.kernel,
        Direction::Forward,
        |row, line| line.copy_from_slice(&l[row * width..][..width]),
        out,
        |row, line, out| {
            out.iter_mut().zip(line).zip(&e[row * width..]).for_each(|((o, l), e)| o.im = e.re * l.re + e.im * l.im);
        },
        scratch,
    );
}

/// out = m0 ⊙ (k * v), real and imaginary parts apart.
pub(super) fn forward(
    operator: &StokesOperator,
    v: impl Fn(usize) -> Complex32 + Sync,
    out: &mut [Complex32],
    scratch: &mut Scratch,
) {
    let (m0, width) = (operator.response.unpolarized(), operator.convolver.size().width);
    operator.convolver.run(
        &operator.kernel,
        Direction::Forward,
        |row, line| line.iter_mut().enumerate().for_each(|(x, l)| *l = v(row * width + x)),
        out,
        |row, line, out| {
            out.iter_mut().zip(line).zip(&m0[row * width..]).for_each(|((o, l), m)| *o = l * m);
        },
        scratch,
    );
}

/// out = k̃ * (m0 ⊙ r), real and imaginary parts apart.
fn adjoint_s0(
    operator: &StokesOperator,
    r: impl Fn(usize) -> Complex32 + Sync,
    out: &mut [Complex32],
    scratch: &mut Scratch,
) {
    let (m0, width) = (operator.response.unpolarized(), operator.convolver.size().width);
    let load = |row: usize, line: &mut [Complex32]| {
        line.iter_mut().enumerate().for_each(|(x, l)| *l = r(row * width + x) * m0[row * width + x]);
    };
    let store = |_: usize, line: &[Complex32], out: &mut [Complex32]| out.copy_from_slice(line);
    operator.convolver.run(&operator.kernel, Direction::Adjoint, load, out, store, scratch);
}

/// out = k̃ * (e ⊙ r).
pub(super) fn adjoint(
    operator: &StokesOperator,
    r: impl Fn(usize) -> f32 + Sync,
    out: &mut [Complex32],
    scratch: &mut Scratch,
) {
    let (e, width) = (operator.response.polarized(), operator.convolver.size().width);
    let load = |row: usize, line: &mut [Complex32]| {
        line.iter_mut().enumerate().for_each(|(x, l)| *l = e[row * width + x] * r(row * width + x));
    };
    let store = |_: usize, line: &[Complex32], out: &mut [Complex32]| out.copy_from_slice(line);
    operator.convolver.run(&operator.kernel, Direction::Adjoint, load, out, store, scratch);
}
