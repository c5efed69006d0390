//! Response maps: how each sensor pixel weighs the three Stokes components of the light that reaches it.
//!
//! A pixel behind the mask reads m0·S0 + m1·S1 + m2·S2. An ideal polarizer stripe at angle θ has m = ½(1, cos 2θ, sin 2θ);
//! with an extinction ratio ρ (transmission parallel : crossed) it is ½(1 + 1/ρ, (1 − 1/ρ) cos 2θ, (1 − 1/ρ) sin 2θ). A
//! measured mask is fitted pixel by pixel. No mask is m = (1, 0, 0).

use num_complex::Complex32;

use super::field::Field;
use crate::image::{Size, Stack, Window};
use crate::polarization::{Angle, stokes_from_angles};

/// Rows after which the pattern of a mask repeats, at most: polarizers of 2×2 pixels under colour filters of 2×2 have 4.
const LARGEST_ROW_PERIOD: usize = 4;
/// Columns and rows of a layout of polarizers on pixels, at most.
const LARGEST_CELL: usize = LARGEST_ROW_PERIOD;
/// Responses that differ by less than this share of their mean square count as the same, whatever a mask's own errors.
const SAME_RESPONSE: f64 = 0.1;

/// Share of the modulation by polarized light that binning has to leave.
const KEPT_MODULATION: f64 = 0.5;

/// Angles closer than this (modulo 180°) do not count as different.
const SAME_ANGLE_DEGREES: f64 = 5.0;

/// Why a mask cannot be used.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum MaskError {
    /// Fewer than three angles, or some nearly equal: S0, S1 and S2 cannot be told apart.
    #[error("mask angles {}: {distinct} differ by {SAME_ANGLE_DEGREES}° or more (modulo 180°), linear polarization needs at least 3", list(.angles))]
    Angles {
        /// The angles given.
        angles: Vec<Angle>,
        /// Number of distinct angles.
        distinct: usize,
    },
    /// An angle appears twice.
    #[error("mask angles {}: {} and {} overlap, allowed: at least {SAME_ANGLE_DEGREES}° apart (modulo 180°)", list(.angles), pair.0, pair.1)]
    Overlap {
        /// The angles given.
        angles: Vec<Angle>,
        /// The two that coincide.
        pair: (Angle, Angle),
    },
    /// A stripe is narrower than a pixel, or not every angle has a stripe.
    #[error("mask has {found} stripes on {width} pixels for {angles} angles, allowed: {angles} to {width}")]
    Stripes {
        /// Stripes asked for.
        found: usize,
        /// Pixels in a row.
        width: usize,
        /// Number of angles.
        angles: usize,
    },
    /// A layout of polarizers on pixels that is no small rectangle.
    #[error(
        "mask layout has rows of {found:?} angles, allowed: 1 to {LARGEST_CELL} rows of equally many, 1 to {LARGEST_CELL}, angles"
    )]
    Layout {
        /// Angles in each row.
        found: Vec<usize>,
    },
    /// An extinction ratio that does not polarize.
    #[error("mask extinction_ratio is {found}, allowed: > 1")]
    Extinction {
        /// The value given.
        found: f64,
    },
    /// The measured mask has another size or number of angles.
    #[error(
        "mask file has {found_count} planes of {found} pixels, expected {expected_count} (one for each angle) of {expected}"
    )]
    Shape {
        /// Planes in the file.
        found_count: usize,
        /// Their size.
        found: Size,
        /// Number of angles.
        expected_count: usize,
        /// Size of the sensor.
        expected: Size,
    },
    /// NaN, infinite or negative transmission.
    #[error("mask file: transmission {value} at plane {plane}, row {row}, column {column}, allowed: finite and ≥ 0")]
    Transmission {
        /// The value.
        value: f32,
        /// Plane.
        plane: usize,
        /// Row.
        row: usize,
        /// Column.
        column: usize,
    },
    /// Blocks mix polarizers of different angles.
    #[error(
        "bin = {bin} mixes polarizers of different angles: {:.0} % of the modulation by polarized light is left, allowed: {:.0} % or more; use a smaller bin, or bin = 1 for polarizers on single pixels", 100.0 * kept, 100.0 * KEPT_MODULATION
    )]
    Mixed {
        /// Readings on a side of a block.
        bin: usize,
        /// Modulation of the binned mask over that of the mask.
        kept: f64,
    },
    /// The mask does not polarize anywhere.
    #[error(
        "mask file: the response to polarized light does not depend on its angle (largest modulation {largest:.4}, expected > 0.01): was the polarizer turned?"
    )]
    NoModulation {
        /// Largest |m1 + i·m2| over all pixels.
        largest: f32,
    },
}

fn list(angles: &[Angle]) -> String {
    angles.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ")
}

/// A polarizer mask on the sensor, as it is described or measured.
#[derive(Clone, Debug)]
pub enum Mask {
    /// No polarizers: the camera sees intensity alone.
    None,
    /// Vertical stripes: column x lies behind angle floor(x·count/width) mod P.
    Stripes {
        /// Polarizer angles in stripe order.
        angles: Vec<Angle>,
        /// Stripes over the width of the sensor.
        count: usize,
        /// Transmission along the axis over that across it; infinite is ideal.
        extinction_ratio: f64,
    },
    /// Polarizers on single pixels, as on the sensors of polarization cameras.
    Mosaic {
        /// Where they lie.
        layout: Mosaic,
        /// Transmission along the axis over that across it; infinite is ideal.
        extinction_ratio: f64,
    },
    /// Any mask: a reading of every pixel under uniform light of unit intensity, fully polarized at each of the angles.
    Measured {
        /// Angles of the light.
        angles: Vec<Angle>,
        /// Readings `[P, H, W]`, in units of the sensor without mask.
        transmission: Stack<f32>,
    },
}

/// A small rectangle of polarizers on single pixels that repeats over a sensor, from the first pixel of its frame.
///
/// ```
/// use stokescope_core::optics::Mosaic;
/// // the order of the Sony IMX250MZR and IMX264MZR
/// let layout = Mosaic::new(&[[90.0, 45.0], [135.0, 0.0]])?;
/// assert_eq!(layout.angles().len(), 4);
/// # Ok::<(), stokescope_core::optics::MaskError>(())
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct Mosaic {
    /// Row by row.
    polarizers: Vec<Angle>,
    /// Columns.
    across: usize,
}

impl Mosaic {
    /// The layout with these rows of angles, in degrees.
    ///
    /// # Errors
    /// [`MaskError::Layout`] when the rows are no rectangle of 1 to 4 columns and rows; [`MaskError::Angles`] and [`MaskError::Overlap`] for
    /// fewer than three angles, or two that are nearly the same.
    pub fn new(rows: &[impl AsRef<[f64]>]) -> Result<Self, MaskError> {
        let found: Vec<usize> = rows.iter().map(|row| row.as_ref().len()).collect();
        let across = found.first().copied().unwrap_or(0);
        let allowed = 1..=LARGEST_CELL;
        if !allowed.contains(&rows.len()) || !allowed.contains(&across) || found.iter().any(|n| *n != across) {
            return Err(MaskError::Layout { found });
        }
        let polarizers = rows.iter().flat_map(AsRef::as_ref).copied().map(Angle::from_degrees).collect();
        let layout = Self { polarizers, across };
        check_angles(&layout.angles())?;
        Ok(layout)
    }

    /// The different angles, in ascending order: those for which intensities are given out.
    pub fn angles(&self) -> Vec<Angle> {
        let mut degrees: Vec<f64> = self.polarizers.iter().map(|a| a.degrees().rem_euclid(180.0)).collect();
        degrees.sort_by(f64::total_cmp);
        degrees.dedup();
        degrees.into_iter().map(Angle::from_degrees).collect()
    }

    /// Columns and rows.
    pub fn cell(&self) -> [usize; 2] {
        [self.across, self.polarizers.len() / self.across]
    }

    /// The polarizer of the pixel in column `x` and row `y` of the sensor.
    pub fn at(&self, [x, y]: [usize; 2]) -> Angle {
        let [across, down] = self.cell();
        self.polarizers[y % down * across + x % across]
    }
}

impl Mask {
    /// Columns and rows after which polarizers on single pixels repeat; 1 for all masks that are not described so.
    pub fn cell(&self) -> [usize; 2] {
        match self {
            Self::Mosaic { layout, .. } => layout.cell(),
            Self::None | Self::Stripes { .. } | Self::Measured { .. } => [1, 1],
        }
    }

    /// `count` ideal vertical stripes of the polarizer angles `degrees` in turn.
    pub fn stripes(degrees: &[f64], count: usize) -> Self {
        let angles = degrees.iter().copied().map(Angle::from_degrees).collect();
        Self::Stripes { angles, count, extinction_ratio: f64::INFINITY }
    }

    /// The response maps of the mask on a sensor of `size`. Allocates.
    ///
    /// # Errors
    /// [`MaskError`] for a mask that cannot be, or does not fit the sensor.
    pub fn response(self, size: Size) -> Result<Response, MaskError> {
        match self {
            Self::None => Ok(Response::none(size)),
            Self::Stripes { angles, count, extinction_ratio } => {
                Response::stripes(size, angles, count, extinction_ratio)
            }
            Self::Mosaic { layout, extinction_ratio } => Response::mosaic(size, [0, 0], &layout, extinction_ratio),
            Self::Measured { angles, transmission } => Response::measured(size, angles, &transmission),
        }
    }

    /// The response maps of the mask at the working size of `window`: means over its blocks. Stripes lie over the whole width of the
    /// camera's frame; a measured mask is of the frame or of the working size. Blocks of a mosaic are those of a window of its cells
    /// ([`Window::of_cells`]), with readings of one polarizer each. Allocates.
    ///
    /// # Errors
    /// Those of [`Self::response`], and [`MaskError::Mixed`].
    pub fn binned(self, window: &Window) -> Result<Response, MaskError> {
        let size = window.working();
        let (response, before) = match self {
            Self::Stripes { angles, count, extinction_ratio } if !window.is_whole() => {
                let row = Response::stripes(Size::new(window.frame().width, 1), angles, count, extinction_ratio)?;
                let [x, _] = window.first();
                (row.reduced(window), modulation(&row.polarized[x..x + window.size().width]))
            }
            Self::Measured { angles, transmission }
                if transmission.size() == window.frame() && size != window.frame() =>
            {
                let before = measured_modulation(&angles, &transmission, window)?;
                (Response::measured(size, angles, &window.means(&transmission))?, before)
            }
            // blocks hold whole cells, so that the first polarizer of a binned frame is that of the frame
            Self::Mosaic { layout, extinction_ratio } => {
                return Response::mosaic(size, window.first(), &layout, extinction_ratio);
            }
            other => return other.response(size),
        };
        let kept = modulation(&response.polarized) / before;
        if kept < KEPT_MODULATION {
            return Err(MaskError::Mixed { bin: window.bin(), kept });
        }
        Ok(response)
    }
}

/// Mean modulation by polarized light.
fn modulation(polarized: &[Complex32]) -> f64 {
    polarized.iter().map(|e| f64::from(e.norm())).sum::<f64>() / polarized.len() as f64
}

/// Mean modulation of a measured mask within `window`, before binning.
fn measured_modulation(angles: &[Angle], transmission: &Stack<f32>, window: &Window) -> Result<f64, MaskError> {
    check_angles(angles)?;
    check_transmission(angles, transmission, window.frame())?;
    let fit = stokes_from_angles(angles) * 0.5;
    let modulus = |i: usize| {
        let of = |k: usize| (0..angles.len()).map(|p| fit[(k, p)] * f64::from(transmission.plane(p)[i])).sum::<f64>();
        of(1).hypot(of(2))
    };
    let blocks = window.working().pixels();
    let sum: f64 = (0..blocks).flat_map(|block| window.block(block)).map(modulus).sum();
    Ok(sum / (blocks * window.readings()) as f64)
}

/// Refuses a measured mask of another shape than `angles` of `size`, or with values that are no transmissions.
fn check_transmission(angles: &[Angle], transmission: &Stack<f32>, size: Size) -> Result<(), MaskError> {
    if transmission.size() != size || transmission.count() != angles.len() {
        return Err(MaskError::Shape {
            found_count: transmission.count(),
            found: transmission.size(),
            expected_count: angles.len(),
            expected: size,
        });
    }
    let Some(i) = transmission.as_slice().iter().position(|v| !(v.is_finite() && *v >= 0.0)) else { return Ok(()) };
    let (value, n) = (transmission.as_slice()[i], size.pixels());
    let (plane, i) = (i / n, i % n);
    Err(MaskError::Transmission { value, plane, row: i / size.width, column: i % size.width })
}

/// The response maps of one sensor.
#[derive(Clone, Debug)]
pub struct Response {
    size: Size,
    angles: Vec<Angle>,
    unpolarized: Vec<f32>,
    polarized: Vec<Complex32>,
    /// For ideal stripes, the angle index of each column: the angle form then selects instead of combining.
    selection: Option<Vec<usize>>,
    row_period: usize,
}

impl Response {
    /// Vertical stripes: column x lies behind angle floor(x·stripes/width) mod P. `extinction_ratio` infinite is ideal.
    ///
    /// # Errors
    /// [`MaskError`] for too few or overlapping angles, too many stripes, or a ratio of 1 or less.
    pub fn stripes(size: Size, angles: Vec<Angle>, stripes: usize, extinction_ratio: f64) -> Result<Self, MaskError> {
        check_angles(&angles)?;
        if stripes < angles.len() || stripes > size.width {
            return Err(MaskError::Stripes { found: stripes, width: size.width, angles: angles.len() });
        }
        let leak = leak(extinction_ratio)?;
        let columns: Vec<usize> = (0..size.width).map(|x| x * stripes / size.width % angles.len()).collect();
        let row = columns.iter().map(|&p| polarizer(angles[p], leak));
        let (unpolarized, polarized) = row.cycle().take(size.pixels()).unzip();
        let selection = (leak == 0.0).then_some(columns);
        Ok(Self { size, angles, unpolarized, polarized, selection, row_period: 1 })
    }

    /// Polarizers on single pixels of a sensor of `size`, whose first pixel lies in the column and row `first` of the layout.
    /// `extinction_ratio` infinite is ideal. Allocates.
    ///
    /// # Errors
    /// [`MaskError::Extinction`] for a ratio of 1 or less.
    pub fn mosaic(size: Size, first: [usize; 2], layout: &Mosaic, extinction_ratio: f64) -> Result<Self, MaskError> {
        let leak = leak(extinction_ratio)?;
        let pixel = |i: usize| layout.at([first[0] + i % size.width, first[1] + i / size.width]);
        let (unpolarized, polarized) = (0..size.pixels()).map(|i| polarizer(pixel(i), leak)).unzip();
        let [_, row_period] = layout.cell();
        Ok(Self { size, angles: layout.angles(), unpolarized, polarized, selection: None, row_period })
    }

    /// Means over the blocks of `window` of vertical stripes, of which this is one row of the camera's frame.
    fn reduced(&self, window: &Window) -> Self {
        let (size, bin, [x, _]) = (window.working(), window.bin(), window.first());
        let columns = x..x + window.size().width;
        let share = 1.0 / bin as f32;
        let means = |values: &[f32]| values.iter().sum::<f32>() * share;
        let unpolarized: Vec<f32> = self.unpolarized[columns.clone()].chunks_exact(bin).map(means).collect();
        let sums = self.polarized[columns.clone()].chunks_exact(bin).map(|e| e.iter().sum::<Complex32>() * share);
        let polarized: Vec<Complex32> = sums.collect();
        // blocks that a stripe's edge cuts combine two angles
        let selection = self.selection.as_ref().and_then(|angles| {
            let one = |block: &[usize]| block.iter().all(|p| *p == block[0]).then_some(block[0]);
            angles[columns].chunks_exact(bin).map(one).collect()
        });
        let whole = size.pixels();
        Self {
            size,
            angles: self.angles.clone(),
            unpolarized: unpolarized.into_iter().cycle().take(whole).collect(),
            polarized: polarized.into_iter().cycle().take(whole).collect(),
            selection,
            row_period: 1,
        }
    }

    /// A measured mask: `transmission` plane p is the reading, in units of the unmasked sensor, under uniform light of unit
    /// intensity fully polarized at `angles[p]`; t(θ) = m0 + m1 cos 2θ + m2 sin 2θ is fitted by least squares.
    ///
    /// # Errors
    /// [`MaskError`] for a wrong shape, unusable values, too few angles or no modulation.
    pub fn measured(size: Size, angles: Vec<Angle>, transmission: &Stack<f32>) -> Result<Self, MaskError> {
        check_angles(&angles)?;
        check_transmission(&angles, transmission, size)?;
        let n = size.pixels();
        // A fully polarized unit source is S = (1, cos 2θ, sin 2θ): twice the analyzer rows.
        let fit = stokes_from_angles(&angles) * 0.5;
        let mut maps = [vec![0.0f32; n], vec![0.0; n], vec![0.0; n]];
        for (k, map) in maps.iter_mut().enumerate() {
            for (p, plane) in transmission.planes().enumerate() {
                let weight = fit[(k, p)] as f32;
                map.iter_mut().zip(plane).for_each(|(m, t)| *m += weight * t);
            }
        }
        let [unpolarized, m1, m2] = maps;
        let polarized: Vec<_> = m1.into_iter().zip(m2).map(|(re, im)| Complex32::new(re, im)).collect();
        let largest = polarized.iter().map(|e| e.norm()).fold(0.0, f32::max);
        if largest <= 0.01 {
            return Err(MaskError::NoModulation { largest });
        }
        let row_period = row_period(size, &unpolarized, &polarized);
        Ok(Self { size, angles, unpolarized, polarized, selection: None, row_period })
    }

    /// No mask: every pixel reads S0.
    pub fn none(size: Size) -> Self {
        let (unpolarized, polarized) = (vec![1.0; size.pixels()], Vec::new());
        Self { size, angles: Vec::new(), unpolarized, polarized, selection: None, row_period: 1 }
    }

    /// The response of the frame of `field`, and none in its margin. Allocates.
    #[must_use]
    pub fn within(&self, field: Field) -> Self {
        if field.margin().is_none() {
            return self.clone();
        }
        let (size, margin) = (field.size(), field.margin().columns);
        let mut unpolarized = vec![0.0; size.pixels()];
        field.embed(&self.unpolarized, &mut unpolarized);
        let mut polarized = vec![Complex32::ZERO; if self.is_polarized() { size.pixels() } else { 0 }];
        if self.is_polarized() {
            field.embed(&self.polarized, &mut polarized);
        }
        let selection = self.selection.as_ref().map(|columns| {
            let first = (0..margin).map(|_| 0);
            first.clone().chain(columns.iter().copied()).chain(first).collect()
        });
        Self { size, unpolarized, polarized, selection, ..self.clone() }
    }

    /// Size of the maps: that of the frame, or of the field they were made for.
    pub fn size(&self) -> Size {
        self.size
    }

    /// The angles for which intensities are given out; empty without a mask.
    pub fn angles(&self) -> &[Angle] {
        &self.angles
    }

    /// True if there is a mask, that is if polarization is measured at all.
    pub fn is_polarized(&self) -> bool {
        !self.polarized.is_empty()
    }

    /// m0 of each pixel.
    pub fn unpolarized(&self) -> &[f32] {
        &self.unpolarized
    }

    /// m1 + i·m2 of each pixel; empty without a mask.
    pub fn polarized(&self) -> &[Complex32] {
        &self.polarized
    }

    /// Rows after which the mask repeats: readings of one column so many rows apart lie behind like polarizers. 1 for
    /// vertical stripes, for stripes much wider than a pixel and without a mask; 2 for a mosaic of 2×2 pixels.
    pub fn row_period(&self) -> usize {
        self.row_period
    }

    /// The angle form: weight of the intensity behind an ideal polarizer at each angle, `[P, height, width]`. Ideal stripes
    /// select one angle, as in the paper; any other mask combines all through the least-squares Stokes estimate. Allocates.
    pub fn angle_weights(&self) -> Stack<f32> {
        let mut weights = Stack::zeros(self.angles.len(), self.size);
        if let Some(columns) = &self.selection {
            for (p, plane) in weights.planes_mut().enumerate() {
                for (i, w) in plane.iter_mut().enumerate() {
                    *w = f32::from(columns[i % self.size.width] == p && self.unpolarized[i] > 0.0);
                }
            }
        } else if self.is_polarized() {
            let fit = stokes_from_angles(&self.angles);
            for (p, plane) in weights.planes_mut().enumerate() {
                let [a, b, c] = [0, 1, 2].map(|k| fit[(k, p)] as f32);
                for (w, (m0, e)) in plane.iter_mut().zip(self.unpolarized.iter().zip(&self.polarized)) {
                    *w = a * m0 + b * e.re + c * e.im;
                }
            }
        }
        weights
    }
}

/// Transmission across the axis over that along it.
fn leak(extinction_ratio: f64) -> Result<f64, MaskError> {
    if extinction_ratio.is_nan() || extinction_ratio <= 1.0 {
        return Err(MaskError::Extinction { found: extinction_ratio });
    }
    Ok(extinction_ratio.recip())
}

/// m0 and m1 + i·m2 of a polarizer at `angle`.
fn polarizer(angle: Angle, leak: f64) -> (f32, Complex32) {
    let contrast = 0.5 * (1.0 - leak);
    let (c, s) = (contrast * angle.cos2(), contrast * angle.sin2());
    (0.5 * (1.0 + leak) as f32, Complex32::new(c as f32, s as f32))
}

/// The smallest distance in rows at which responses differ no more than at any other distance, but for the mask's errors.
fn row_period(size: Size, unpolarized: &[f32], polarized: &[Complex32]) -> usize {
    let difference = |rows: usize| {
        let pairs = 0..(size.height - rows) * size.width;
        let square = |(i, j): (usize, usize)| {
            f64::from((unpolarized[i] - unpolarized[j]).powi(2) + (polarized[i] - polarized[j]).norm_sqr())
        };
        pairs.clone().map(|i| square((i, i + rows * size.width))).sum::<f64>() / pairs.len() as f64
    };
    // Noise is told from differences of five readings of one kind.
    let differences: heapless::Vec<f64, LARGEST_ROW_PERIOD> =
        (1..=LARGEST_ROW_PERIOD).take_while(|rows| 4 * rows < size.height).map(difference).collect();
    let power = polarized.iter().map(|e| f64::from(e.norm_sqr())).sum::<f64>() / size.pixels() as f64;
    let same = differences.iter().copied().fold(f64::INFINITY, f64::min) + SAME_RESPONSE * power;
    1 + differences.iter().position(|d| *d <= same).unwrap_or(0)
}

fn check_angles(angles: &[Angle]) -> Result<(), MaskError> {
    let apart = |a: &Angle, b: &Angle| {
        let d = (a.degrees() - b.degrees()).rem_euclid(180.0);
        d.min(180.0 - d) >= SAME_ANGLE_DEGREES
    };
    let distinct = angles.iter().enumerate().filter(|(i, a)| angles[..*i].iter().all(|b| apart(a, b))).count();
    if distinct < 3 || angles.iter().any(|a| !a.degrees().is_finite()) {
        return Err(MaskError::Angles { angles: angles.to_vec(), distinct });
    }
    for (i, a) in angles.iter().enumerate() {
        if let Some(b) = angles[..i].iter().find(|b| !apart(a, b)) {
            return Err(MaskError::Overlap { angles: angles.to_vec(), pair: (*b, *a) });
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: Size = Size::new(16, 3);

    #[test]
    fn ideal_stripes_follow_malus() {
        let r = Response::stripes(SIZE, Angle::four(), 8, f64::INFINITY).unwrap();
        // Light polarized at 30°, S = (1, cos 60°, sin 60°): behind θ it is cos²(30° − θ).
        for (x, theta) in [(0, 0.0f64), (2, 45.0), (4, 90.0), (6, 135.0), (8, 0.0)] {
            let e = r.polarized()[x];
            let got =
                f64::from(r.unpolarized()[x]) + f64::from(e.re) * 0.5 + f64::from(e.im) * 60f64.to_radians().sin();
            assert!((got - (30.0 - theta).to_radians().cos().powi(2)).abs() < 1e-6);
        }
        let w = r.angle_weights();
        assert_eq!((0..4).map(|p| w.plane(p)[5]).collect::<Vec<_>>(), [0.0, 0.0, 1.0, 0.0]);
    }

    #[test]
    fn a_measured_mask_gives_back_the_stripes_it_was_measured_on() {
        let angles: Vec<_> = [10.0, 55.0, 100.0, 130.0, 170.0].map(Angle::from_degrees).to_vec();
        let truth = Response::stripes(SIZE, Angle::three(), 8, 20.0).unwrap();
        let mut t = Stack::zeros(angles.len(), SIZE);
        for (p, a) in angles.iter().enumerate() {
            for (i, v) in t.plane_mut(p).iter_mut().enumerate() {
                let e = truth.polarized()[i];
                *v = truth.unpolarized()[i] + e.re * a.cos2() as f32 + e.im * a.sin2() as f32;
            }
        }
        let r = Response::measured(SIZE, angles, &t).unwrap();
        for i in 0..SIZE.pixels() {
            assert!((r.unpolarized()[i] - truth.unpolarized()[i]).abs() < 1e-6);
            assert!((r.polarized()[i] - truth.polarized()[i]).norm() < 1e-6);
        }
    }

    /// Transmissions of polarizers whose angle is `kind(x, y)` times 45°, each a little different.
    fn measured(size: Size, kind: fn(usize, usize) -> usize) -> Response {
        let errors = crate::image::noise::normal(4 * size.pixels(), 0.02, 3);
        let mut t = Stack::from_vec(4, size, errors).unwrap();
        for (p, plane) in t.planes_mut().enumerate() {
            for (i, v) in plane.iter_mut().enumerate() {
                let angle = 45.0 * (kind(i % size.width, i / size.width) as f32 - p as f32);
                *v = (*v + angle.to_radians().cos().powi(2)).max(0.0);
            }
        }
        Response::measured(size, Angle::four(), &t).unwrap()
    }

    #[test]
    fn rows_of_like_polarizers_are_as_far_apart_as_the_mask_repeats() {
        let size = Size::new(32, 40);
        let period = |size, kind| measured(size, kind).row_period();
        assert_eq!(period(size, |x, _| x / 4 % 4), 1, "vertical stripes");
        assert_eq!(period(size, |x, y| [[2, 1], [3, 0]][y % 2][x % 2]), 2, "a mosaic");
        assert_eq!(period(size, |_, y| y % 4), 4, "four rows of one angle each");
        assert_eq!(period(size, |x, y| (x / 2 + 2 * (y / 2)) % 4), 4, "polarizers of 2×2 pixels");
        assert_eq!(period(size, |_, y| y / 8 % 4), 1, "wide stripes, of which most neighbours are alike");
        assert_eq!(period(Size::new(32, 8), |x, y| [[2, 1], [3, 0]][y % 2][x % 2]), 1, "too few rows of one kind");
        assert_eq!(Response::stripes(size, Angle::four(), 8, 9.0).unwrap().row_period(), 1);
    }

    #[test]
    fn the_angle_form_reads_what_the_stokes_form_reads() {
        let r = Response::stripes(SIZE, Angle::four(), 16, 3.0).unwrap();
        let (w, s) = (r.angle_weights(), [0.8f32, 0.3, -0.5]);
        for i in 0..SIZE.pixels() {
            let stokes = r.unpolarized()[i] * s[0] + r.polarized()[i].re * s[1] + r.polarized()[i].im * s[2];
            let by_angle: f32 = (0..4)
                .map(|p| {
                    let a = r.angles()[p];
                    w.plane(p)[i] * 0.5 * (s[0] + s[1] * a.cos2() as f32 + s[2] * a.sin2() as f32)
                })
                .sum();
            assert!((stokes - by_angle).abs() < 1e-6);
        }
    }

    #[test]
    fn masks_that_cannot_measure_polarization_are_refused() {
        let degrees = |d: &[f64]| d.iter().copied().map(Angle::from_degrees).collect::<Vec<_>>();
        let message = |a, n, e| Response::stripes(SIZE, a, n, e).unwrap_err().to_string();
        assert!(message(degrees(&[0.0, 90.0]), 8, 100.0).contains("0°, 90°: 2 differ"));
        assert!(message(degrees(&[0.0, 90.0, 180.0]), 8, 100.0).contains("2 differ by 5°"));
        assert!(message(degrees(&[0.0, 45.0, 90.0, 182.0]), 8, 100.0).contains("0° and 182° overlap"));
        assert_eq!(
            message(Angle::four(), 17, 100.0),
            "mask has 17 stripes on 16 pixels for 4 angles, allowed: 4 to 16"
        );
        assert!(message(Angle::four(), 8, 1.0).contains("extinction_ratio is 1, allowed: > 1"));
        let flat = Stack::from_vec(3, SIZE, vec![0.5; 3 * SIZE.pixels()]).unwrap();
        let e = Response::measured(SIZE, Angle::three(), &flat).unwrap_err();
        assert!(e.to_string().contains("was the polarizer turned?"));
        let e = Response::measured(Size::new(15, 3), Angle::three(), &flat).unwrap_err().to_string();
        assert!(e.contains("3 planes of 16×3 pixels, expected 3 (one for each angle) of 15×3"), "{e}");
    }

    #[test]
    fn a_block_that_a_stripes_edge_cuts_is_the_mean_of_its_parts() {
        let window = Window::new(Size::new(44, 6), [4, 0], Size::new(36, 6), 3).unwrap();
        let mask = Mask::Stripes { angles: Angle::four(), count: 8, extinction_ratio: 50.0 };
        let full = mask.clone().response(window.frame()).unwrap();
        let binned = mask.binned(&window).unwrap();
        assert_eq!(binned.size(), window.working());
        for i in 0..window.working().pixels() {
            let mean = |of: fn(&Response, usize) -> f32| window.block(i).map(|at| of(&full, at)).sum::<f32>() / 9.0;
            assert!((binned.unpolarized()[i] - mean(|r, at| r.unpolarized[at])).abs() < 1e-6);
            assert!((binned.polarized()[i].re - mean(|r, at| r.polarized[at].re)).abs() < 1e-6);
            assert!((binned.polarized()[i].im - mean(|r, at| r.polarized[at].im)).abs() < 1e-6);
        }
        // blocks within stripes still select one angle, cut ones cannot
        let ideal = |width| {
            let window = Window::new(Size::new(width, 2), [0, 0], Size::new(width, 2), 2).unwrap();
            Mask::stripes(&[0.0, 45.0, 90.0, 135.0], 8).binned(&window).unwrap()
        };
        assert!(ideal(32).selection.is_some() && ideal(36).selection.is_none());
    }

    #[test]
    fn a_mosaic_is_what_it_would_be_measured_as() {
        let layout = Mosaic::new(&[[90.0, 45.0], [135.0, 0.0]]).unwrap();
        assert_eq!(layout.angles(), Angle::four(), "in ascending order");
        let size = Size::new(6, 12);
        let mosaic = Mask::Mosaic { layout: layout.clone(), extinction_ratio: 50.0 }.response(size).unwrap();
        let mut t = Stack::zeros(4, size);
        for (p, a) in Angle::four().iter().enumerate() {
            for (i, v) in t.plane_mut(p).iter_mut().enumerate() {
                let polarizer = [[90.0, 45.0], [135.0, 0.0]][i / 6 % 2][i % 6 % 2];
                let malus = (a.degrees() - polarizer).to_radians().cos().powi(2);
                *v = (malus + 0.02 * (1.0 - malus)) as f32;
            }
        }
        let measured = Response::measured(size, Angle::four(), &t).unwrap();
        for i in 0..size.pixels() {
            assert!((mosaic.unpolarized()[i] - measured.unpolarized()[i]).abs() < 1e-6);
            assert!((mosaic.polarized()[i] - measured.polarized()[i]).norm() < 1e-6);
        }
        assert_eq!((mosaic.angles(), mosaic.row_period()), (measured.angles(), 2));
        // an odd crop begins with another polarizer
        let window = Window::new(size, [1, 3], Size::new(5, 8), 1).unwrap();
        let cropped = Mask::Mosaic { layout, extinction_ratio: 50.0 }.binned(&window).unwrap();
        let place = |i: usize| (3 + i / 5) * 6 + 1 + i % 5;
        assert!((0..40).all(|i| cropped.polarized()[i] == mosaic.polarized()[place(i)]));
    }

    #[test]
    fn layouts_that_are_no_small_rectangle_of_three_angles_are_refused() {
        let refused = |rows: &[&[f64]]| Mosaic::new(rows).unwrap_err().to_string();
        let allowed = "allowed: 1 to 4 rows of equally many, 1 to 4, angles";
        assert_eq!(refused(&[&[90.0, 45.0], &[0.0]]), format!("mask layout has rows of [2, 1] angles, {allowed}"));
        assert!(refused(&[]).ends_with(allowed) && refused(&[&[0.0; 5]]).ends_with(allowed));
        assert!(refused(&[&[0.0, 90.0], &[90.0, 0.0]]).contains("2 differ by 5°"));
        assert!(refused(&[&[0.0, 60.0], &[120.0, 179.0]]).contains("overlap"));
        let twice = Mosaic::new(&[[0.0, 60.0], [120.0, 180.0]]).unwrap();
        assert_eq!(twice.angles().len(), 3, "180° is 0°");
    }

    #[test]
    fn a_measured_mask_is_binned_unless_that_mixes_polarizers() {
        let window = |bin| Window::new(Size::new(32, 40), [0, 0], Size::new(32, 40), bin).unwrap();
        let frame = window(1).frame();
        let mask = |kind| {
            let full = measured(frame, kind);
            let mut t = Stack::zeros(4, frame);
            for (p, a) in Angle::four().iter().enumerate() {
                for (i, v) in t.plane_mut(p).iter_mut().enumerate() {
                    let e = full.polarized()[i];
                    *v = (full.unpolarized()[i] + e.re * a.cos2() as f32 + e.im * a.sin2() as f32).max(0.0);
                }
            }
            Mask::Measured { angles: Angle::four(), transmission: t }
        };
        let stripes = mask(|x, _| x / 8 % 4).binned(&window(4)).unwrap();
        assert!((0..8).all(|x| stripes.polarized()[x].norm() > 0.45));
        let mosaic = |x: usize, y: usize| [[2, 1], [3, 0]][y % 2][x % 2];
        assert!(mask(mosaic).binned(&window(1)).is_ok());
        let e = mask(mosaic).binned(&window(2)).unwrap_err().to_string();
        assert!(e.starts_with("bin = 2 mixes polarizers of different angles: ") && e.contains("or bin = 1"), "{e}");
        // thin stripes are no better
        let thin = Mask::Stripes { angles: Angle::four(), count: 32, extinction_ratio: f64::INFINITY };
        assert!(matches!(thin.binned(&window(4)), Err(MaskError::Mixed { bin: 4, .. })));
        let small = Mask::Measured {
            angles: Angle::four(),
            transmission: Stack::from_vec(4, Size::new(8, 10), vec![0.5; 320]).unwrap(),
        };
        assert!(matches!(small.binned(&window(4)), Err(MaskError::NoModulation { .. })), "of the working size");
    }
}
