//! Size of the PSF by the readings, relative to its calibration. A diffuser that has moved along the axis spreads light over s times
//! the distances: k_s(q) = k(q/s)/s². With G the guide, zero outside of the frame, and x from the frame's centre,
//!
//! ∂(k_s * G)/∂s = k * (x·∇G) − x·∇(k * G) = ∇·(k * (x G)) − 2 k * G − x·∇(k * G) at s = 1:
//!
//! three blurred images and their slopes on the sensor, and no other kernel. The derivatives by a shift and an affine map of the scene
//! come from the same three images. They are eliminated with the gain and L (`fit.rs`), so that neither a misaligned guide nor
//! polarization is mistaken for another PSF. The derivative of L's share is neglected: at the right size it does not matter.
//!
//! A shift, a turn or a blur of the PSF cannot be told from one of the scene; they are left to guide and solver.
//!
//! Cost: 15 complex convolutions for each channel.

use nalgebra::{SMatrix, SVector};

use super::fit::{self, Columns, Frame, GUIDE, REST, adjoint, centre, inner, project_both};
use crate::image::{Complex32, Size, Stack};
use crate::optics::{Direction, Scratch};

/// A shift, the rest of an affine map, and the PSF's size.
const COUNT: usize = 7;
const GROWTH: usize = COUNT - 1;
/// Sum of squares that another size must explain, in noise variances: with the PSF as calibrated it is up to 25 in measured scenes …
const SIGNIFICANT: f64 = 100.0;
/// … and of what is left beside noise: stress patterns leave much, of which it explains .7 % by chance, and a guide that is of another
/// scene in parts leaves more, of which it explains 4 %.
const OF_THE_REST: f64 = 0.05;
/// Both thresholds for a PSF that was refitted in this frame already.
const UNSETTLED: (f64, f64) = (20.0, 0.01);
/// The larger the change, the larger its share of the rest: 5 % for each percent, up to so much. In guides that are of another scene in
/// parts a change of 15 % explains 15 %, no more.
const OF_THE_REST_BY_GROWTH: (f64, f64) = (5.0, 0.3);

/// Products of the columns, of the guide and of the rest.
type Products = SMatrix<f64, { COUNT + 2 }, { COUNT + 2 }>;

/// A channel's blurred guide.
struct Blurred<'a> {
    size: Size,
    /// k * G.
    plain: &'a [f32],
    /// k * (x G), as one complex image; x from −1 to 1 along the longer side.
    by_place: &'a [Complex32],
    unpolarized: &'a [f32],
}

impl Blurred<'_> {
    /// Change of reading `i` by a pixel of displacement: by a shift everywhere, by the other columns at the longer side's edge.
    fn at(&self, i: usize) -> [f32; COUNT] {
        let Self { size: Size { width, height }, plain, by_place, unpolarized } = *self;
        let (x, y) = (i % width, i / width);
        let (left, right) = (i - usize::from(x > 0), i + usize::from(x + 1 < width));
        let (up, down) = (i - width * usize::from(y > 0), i + width * usize::from(y + 1 < height));
        let across = 1.0 / (right - left).max(1) as f32;
        let along = width as f32 / (down - up).max(width) as f32;
        let (dx, dy) = ((plain[right] - plain[left]) * across, (plain[down] - plain[up]) * along);
        let (mx, my) = ((by_place[right] - by_place[left]) * across, (by_place[down] - by_place[up]) * along);
        let (cx, cy, unit) = centre(self.size);
        let (px, py) = (((x as f64 - cx) / unit) as f32, ((y as f64 - cy) / unit) as f32);
        let own = plain[i] / unit as f32;
        let (xx, yy) = (mx.re - own, my.im - own);
        [dx, dy, xx, my.re, mx.im, yy, xx + yy - px * dx - py * dy].map(|v| unpolarized[i] * v)
    }
}

/// When the size of the PSF is checked.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum PsfSize {
    /// Never.
    Given,
    /// When the guide is searched for, and in every 64th frame in which it is followed.
    Asked,
    /// As [`Self::Asked`], with lower thresholds, for a PSF that was refitted in this frame already.
    Refitted,
}

/// Size of the PSF by the readings, over the size it is taken for; none unless another size is certain. The guide must be aligned
/// and corrected; `plane` is scratch. Allocates nothing.
pub(super) fn growth(
    frame: &Frame<'_>,
    asked: PsfSize,
    raw: &mut Stack<f32>,
    guide: &Stack<f32>,
    plane: &mut [f32],
    scratch: &mut Scratch,
    w: &mut fit::Workspace,
) -> Option<f64> {
    let (significant, share) = match asked {
        PsfSize::Given => return None,
        PsfSize::Asked => (SIGNIFICANT, OF_THE_REST),
        PsfSize::Refitted => UNSETTLED,
    };
    let (mut hessian, mut slope) = (SMatrix::<f64, COUNT, COUNT>::zeros(), SVector::<f64, COUNT>::zeros());
    let mut left = 0.0;
    for c in 0..frame.operators.len() {
        let found = w.fit(frame, c, raw.plane_mut(c), guide.plane(c), Columns::Gain, scratch);
        let (square, along) = (found.polarized[(GUIDE, GUIDE)], found.polarized[(GUIDE, REST)]);
        if square.is_nan() || square <= 0.0 {
            return None;
        }
        let products = products(frame, c, guide.plane(c), plane, scratch, w);
        let gain = found.gain + along / square;
        let cross = products.fixed_view::<COUNT, 1>(0, COUNT).into_owned();
        let own = products.fixed_view::<COUNT, COUNT>(0, 0) - cross * cross.transpose() / square;
        hessian += own * (gain * gain);
        slope += (products.fixed_view::<COUNT, 1>(0, COUNT + 1) - cross * (along / square)) * gain;
        left += found.polarized[(REST, REST)] - along * along / square;
    }
    let factor = hessian.cholesky()?.unpack();
    let explained = factor.solve_lower_triangular(&slope)?;
    let (_, _, unit) = centre(guide.size());
    let growth = explained[GROWTH] / factor[(GROWTH, GROWTH)] / unit;
    let rest = left - explained.norm_squared();
    let (by_growth, enough) = OF_THE_REST_BY_GROWTH;
    let share = share.max(enough.min(by_growth * growth.abs()));
    let least = (significant * rest / frame.trusted).max(share * (left - frame.noise * frame.trusted));
    (explained[GROWTH].powi(2) > least).then_some(1.0 + growth)
}

/// Products of what the columns, the guide `g` and the rest of its fit are in the readings of channel `c`, L eliminated; those of guide and
/// rest among themselves the fit has. Allocates nothing.
fn products(
    frame: &Frame<'_>,
    c: usize,
    g: &[f32],
    plane: &mut [f32],
    scratch: &mut Scratch,
    w: &mut fit::Workspace,
) -> Products {
    let fit::Workspace { blurred, image, rest, reduced, modes, coarse, .. } = w;
    let operator = &frame.operators[c];
    let size = operator.convolver.size();
    let (cx, cy, unit) = centre(size);
    operator.blur(g, plane, scratch);
    let load = |row: usize, line: &mut [Complex32]| {
        let y = ((row as f64 - cy) / unit) as f32;
        for (column, v) in line.iter_mut().enumerate() {
            *v = Complex32::new(((column as f64 - cx) / unit) as f32, y) * g[row * size.width + column];
        }
    };
    let store = |_: usize, line: &[Complex32], out: &mut [Complex32]| out.copy_from_slice(line);
    operator.convolver.run(&operator.kernel, Direction::Forward, load, blurred, store, scratch);
    let seen = Blurred { size, plain: plane, by_place: blurred, unpolarized: operator.response.unpolarized() };
    let mut products = Products::zeros();
    for i in 0..size.pixels() {
        let mut images = [0.0; COUNT + 2];
        images[..COUNT].copy_from_slice(&seen.at(i));
        (images[COUNT], images[COUNT + 1]) = (seen.unpolarized[i] * plane[i], rest[i]);
        for a in 0..COUNT {
            (a..COUNT + 2).for_each(|b| products[(a, b)] += f64::from(images[a]) * f64::from(images[b]));
        }
    }
    if let Some((slow, buffers)) = frame.coarse.get(c).zip(coarse.as_mut()) {
        let (n, p) = (modes.len(), 2 * slow.modes());
        for q in 0..COUNT {
            adjoint(operator, |i| seen.at(i)[q], image, scratch);
            let own = &mut reduced[q * n..][..p];
            project_both(slow, image, own, buffers);
            slow.whiten(own, buffers);
        }
        let slots: [usize; COUNT + 2] = std::array::from_fn(|k| if k < COUNT { k } else { [GUIDE, REST][k - COUNT] });
        let reduced = |k: usize| &reduced[slots[k] * n..][..p];
        for a in 0..COUNT {
            (a..COUNT + 2).for_each(|b| products[(a, b)] -= inner(reduced(a), reduced(b)));
        }
    }
    products.fill_lower_triangle_with_upper_triangle();
    products
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::optics::{FftBackend, Psf, Response, StokesOperator};
    use crate::parallel::Workers;

    const SIZE: Size = Size::new(96, 80);

    /// Compares the columns with finite differences between readings behind different PSFs.
    #[test]
    fn columns_are_what_a_larger_and_a_shifted_psf_change() {
        let blob = |i: usize, dx: f32| {
            let (x, y) = ((i % SIZE.width) as f32 - 48.0 - dx, (i / SIZE.width) as f32 - 40.0);
            (-(x * x + y * y) / 128.0).exp() * (1.2 + (0.3 * x + 0.1 * y).sin() * (0.25 * y).cos())
        };
        let psf = |dx: f32| {
            let samples = (0..SIZE.pixels()).map(|i| blob(i, dx)).collect();
            Psf::new(Stack::from_vec(1, SIZE, samples).unwrap(), SIZE, 1).unwrap()
        };
        let workers = Arc::new(Workers::new(1));
        let camera = StokesOperator::for_channels(&psf(1.0), &Response::none(SIZE), 1, FftBackend::Rustfft, workers)
            .unwrap()
            .remove(0);
        let guide: Vec<f32> = (0..SIZE.pixels())
            .map(|i| {
                let (x, y) = ((i % SIZE.width) as f32, (i / SIZE.width) as f32);
                1.0 + 0.5 * (0.11 * x + 0.05 * y).sin() * (0.09 * y - 0.03 * x).cos()
            })
            .collect();
        let mut scratch = camera.convolver.make_scratch();
        let mut behind = |psf: &Psf| {
            let (operator, mut seen) = (camera.behind(psf, 1).remove(0), vec![0.0; SIZE.pixels()]);
            operator.blur(&guide, &mut seen, &mut scratch);
            seen
        };
        let before = behind(&psf(0.0));
        let ((cx, cy, unit), place) = (centre(SIZE), |i: usize| ((i % SIZE.width) as f64, (i / SIZE.width) as f64));
        let by_axis = |of: &dyn Fn(usize) -> f64| {
            let weighed: Vec<f32> = guide.iter().enumerate().map(|(i, g)| of(i) as f32 * g).collect();
            let (operator, mut seen) = (camera.behind(&psf(0.0), 1).remove(0), vec![0.0; SIZE.pixels()]);
            operator.blur(&weighed, &mut seen, &mut camera.convolver.make_scratch());
            seen
        };
        let across = by_axis(&|i| (place(i).0 - cx) / unit);
        let along = by_axis(&|i| (place(i).1 - cy) / unit);
        let by_place: Vec<_> = across.into_iter().zip(along).map(|(re, im)| Complex32::new(re, im)).collect();
        let ones = vec![1.0; SIZE.pixels()];
        let seen = Blurred { size: SIZE, plain: &before, by_place: &by_place, unpolarized: &ones };
        let inner = |i: usize| {
            (1..SIZE.width - 1).contains(&(i % SIZE.width)) && (1..SIZE.height - 1).contains(&(i / SIZE.width))
        };
        // a PSF moved to the right shows the scene there: the columns move what is seen the other way
        for (column, after, times) in
            [(GROWTH, behind(&psf(0.0).scaled(1.01)), 0.01 * unit), (0, behind(&psf(0.1)), -0.1)]
        {
            let (mut miss, mut all) = (0.0, 0.0);
            for i in (0..SIZE.pixels()).filter(|i| inner(*i)) {
                let change = f64::from(after[i] - before[i]);
                miss += (change - times * f64::from(seen.at(i)[column])).powi(2);
                all += change * change;
            }
            let miss = (miss / all).sqrt();
            assert!(miss < 0.05, "column {column} misses {miss} of the change");
        }
    }
}
