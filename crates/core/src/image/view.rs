use super::{OffScale, ShapeError, Size, Stack};

/// The unit of raw values.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Unit {
    /// Counts of the analogue-to-digital converter; the device's black level and saturation apply.
    Counts,
    /// Fractions of full scale.
    FullScale,
}

/// Borrowed samples of one number format.
#[derive(Clone, Copy, Debug)]
pub enum Samples<'a> {
    /// 8-bit counts.
    U8(&'a [u8]),
    /// 16-bit counts.
    U16(&'a [u16]),
    /// Single precision.
    F32(&'a [f32]),
    /// Double precision.
    F64(&'a [f64]),
}

impl Samples<'_> {
    /// Number of samples.
    fn len(&self) -> usize {
        match self {
            Self::U8(s) => s.len(),
            Self::U16(s) => s.len(),
            Self::F32(s) => s.len(),
            Self::F64(s) => s.len(),
        }
    }
}

/// A borrowed image of one or three channels, of any number format, planar or interleaved. Nothing is copied until it is processed.
///
/// Integers are taken for counts and floating-point numbers for fractions of full scale; [`Self::in_unit`] says otherwise.
///
/// ```
/// use stokescope_core::image::{ImageView, Size, Unit};
/// let rgb = [1u16, 2, 3, 4, 5, 6]; // two pixels
/// let view = ImageView::interleaved(&rgb, 3, Size::new(2, 1))?;
/// assert_eq!((view.planes(), view.unit()), (3, Unit::Counts));
/// # Ok::<(), stokescope_core::image::ShapeError>(())
/// ```
#[derive(Clone, Copy, Debug)]
pub struct ImageView<'a> {
    samples: Samples<'a>,
    planes: usize,
    size: Size,
    /// Samples from plane to plane and from pixel to pixel of a row; rows follow each other.
    strides: [usize; 2],
    unit: Unit,
    weights: Option<&'a [f32]>,
    off_scale: Option<OffScale>,
}

impl<'a> ImageView<'a> {
    /// Samples `[planes, height, width]`, row-major.
    ///
    /// # Errors
    /// [`ShapeError`] when the number of samples is not that of the shape.
    pub fn planar(samples: impl Into<Samples<'a>>, planes: usize, size: Size) -> Result<Self, ShapeError> {
        Self::new(samples.into(), planes, size, [size.pixels(), 1])
    }

    /// Samples `[height, width, planes]`, row-major, as most image libraries hold colours.
    ///
    /// # Errors
    /// [`ShapeError`] when the number of samples is not that of the shape.
    pub fn interleaved(samples: impl Into<Samples<'a>>, planes: usize, size: Size) -> Result<Self, ShapeError> {
        Self::new(samples.into(), planes, size, [1, planes])
    }

    fn new(samples: Samples<'a>, planes: usize, size: Size, strides: [usize; 2]) -> Result<Self, ShapeError> {
        if samples.len() != planes * size.pixels() {
            return Err(ShapeError { count: planes, size, found: samples.len() });
        }
        let unit = match samples {
            Samples::U8(_) | Samples::U16(_) => Unit::Counts,
            Samples::F32(_) | Samples::F64(_) => Unit::FullScale,
        };
        Ok(Self { samples, planes, size, strides, unit, weights: None, off_scale: None })
    }

    /// This image with values in another unit than their number format suggests.
    #[must_use]
    pub fn in_unit(mut self, unit: Unit) -> Self {
        self.unit = unit;
        self
    }

    /// This image with a weight of 0 to 1 for every sample, `[planes, height, width]`: the share of the readings it is the mean of.
    ///
    /// # Errors
    /// [`ShapeError`] when the number of weights is not that of the samples.
    pub fn weighted(mut self, weights: &'a [f32]) -> Result<Self, ShapeError> {
        if weights.len() != self.planes * self.size.pixels() {
            return Err(ShapeError { count: self.planes, size: self.size, found: weights.len() });
        }
        self.weights = Some(weights);
        Ok(self)
    }

    /// This image with what binning has found about the scale of the readings.
    #[must_use]
    pub fn found_off_scale(mut self, off_scale: Option<OffScale>) -> Self {
        self.off_scale = off_scale;
        self
    }

    /// Channels: 1 or 3.
    pub fn planes(&self) -> usize {
        self.planes
    }

    /// Width and height in pixels.
    pub fn size(&self) -> Size {
        self.size
    }

    /// Unit of the values.
    pub fn unit(&self) -> Unit {
        self.unit
    }

    /// The image without copying, where it is planar and of single precision already.
    fn as_planes(self) -> Option<Planes<'a>> {
        match self.samples {
            Samples::F32(values) if self.planes == 1 || self.strides[1] == 1 => Some(Planes {
                values,
                count: self.planes,
                size: self.size,
                weights: self.weights,
                off_scale: self.off_scale,
            }),
            _ => None,
        }
    }

    /// The image in planes of single precision: itself where it is so already, else a copy in `buffer`, which grows to the image's size
    /// once. Allocates then.
    pub(crate) fn to_planes<'b>(self, buffer: &'b mut Stack<f32>) -> Planes<'b>
    where
        'a: 'b,
    {
        if let Some(planes) = self.as_planes() {
            return planes;
        }
        if (buffer.count(), buffer.size()) != (self.planes, self.size) {
            *buffer = Stack::zeros(self.planes, self.size);
        }
        match self.samples {
            Samples::U8(s) => self.copy(s, buffer, |v| f32::from(*v)),
            Samples::U16(s) => self.copy(s, buffer, |v| f32::from(*v)),
            Samples::F32(s) => self.copy(s, buffer, |v| *v),
            Samples::F64(s) => self.copy(s, buffer, |v| *v as f32),
        }
        Planes { weights: self.weights, off_scale: self.off_scale, ..buffer.borrow() }
    }

    /// Samples of a row of one plane from column `x` on, as many as `out` holds.
    #[inline(always)]
    pub(crate) fn row(&self, plane: usize, y: usize, x: usize, out: &mut [f32]) {
        let [to_plane, step] = self.strides;
        let first = plane * to_plane + (y * self.size.width + x) * step;
        match self.samples {
            Samples::U8(s) => spread(&s[first..], step, out, f32::from),
            Samples::U16(s) => spread(&s[first..], step, out, f32::from),
            Samples::F32(s) => spread(&s[first..], step, out, |v| v),
            Samples::F64(s) => spread(&s[first..], step, out, |v| v as f32),
        }
    }

    fn copy<T>(self, samples: &[T], out: &mut Stack<f32>, value: impl Fn(&T) -> f32) {
        let [plane, pixel] = self.strides;
        for (c, out) in out.planes_mut().enumerate() {
            out.iter_mut().zip(samples[c * plane..].iter().step_by(pixel)).for_each(|(to, from)| *to = value(from));
        }
    }
}

/// Every `step`th of some samples.
#[inline(always)]
fn spread<T: Copy>(samples: &[T], step: usize, out: &mut [f32], value: impl Fn(T) -> f32) {
    if step == 1 {
        out.iter_mut().zip(samples).for_each(|(to, from)| *to = value(*from));
    } else {
        out.iter_mut().zip(samples.iter().step_by(step)).for_each(|(to, from)| *to = value(*from));
    }
}

macro_rules! samples {
    ($($type:ty => $variant:ident),*) => {$(
        impl<'a> From<&'a [$type]> for Samples<'a> {
            fn from(samples: &'a [$type]) -> Self {
                Self::$variant(samples)
            }
        }

        impl<'a, const N: usize> From<&'a [$type; N]> for Samples<'a> {
            fn from(samples: &'a [$type; N]) -> Self {
                Self::$variant(samples)
            }
        }

        impl<'a> From<&'a Vec<$type>> for Samples<'a> {
            fn from(samples: &'a Vec<$type>) -> Self {
                Self::$variant(samples)
            }
        }

        impl<'a> From<&'a Stack<$type>> for ImageView<'a> {
            fn from(stack: &'a Stack<$type>) -> Self {
                let (samples, planes, size) = (Samples::$variant(stack.as_slice()), stack.count(), stack.size());
                let unit = if matches!(samples, Samples::U8(_) | Samples::U16(_)) { Unit::Counts } else { Unit::FullScale };
                Self { samples, planes, size, strides: [size.pixels(), 1], unit, weights: None, off_scale: None }
            }
        }
    )*};
}
samples!(u8 => U8, u16 => U16, f32 => F32, f64 => F64);

impl<T> Stack<T> {
    /// A view of all planes for processing.
    pub fn view<'a>(&'a self) -> ImageView<'a>
    where
        ImageView<'a>: From<&'a Self>,
    {
        self.into()
    }
}

/// Borrowed planes of single precision, `[count, height, width]`.
#[derive(Clone, Copy, Debug)]
pub struct Planes<'a> {
    values: &'a [f32],
    count: usize,
    size: Size,
    weights: Option<&'a [f32]>,
    off_scale: Option<OffScale>,
}

impl<'a> Planes<'a> {
    /// These planes with a weight of 0 to 1 for each value.
    pub(crate) fn weighted(self, weights: &'a [f32]) -> Self {
        debug_assert_eq!(weights.len(), self.values.len(), "a weight for each value");
        Self { weights: Some(weights), ..self }
    }

    /// Weights of plane `index`, where the planes have weights.
    pub fn weights(&self, index: usize) -> Option<&'a [f32]> {
        let n = self.size.pixels();
        self.weights.map(|weights| &weights[index * n..(index + 1) * n])
    }

    /// Knowledge about the scale of the readings.
    pub fn off_scale(&self) -> Option<OffScale> {
        self.off_scale
    }

    /// Number of planes.
    pub fn count(&self) -> usize {
        self.count
    }

    /// Size of each plane.
    pub fn size(&self) -> Size {
        self.size
    }

    /// Plane `index`, row-major.
    pub fn plane(&self, index: usize) -> &'a [f32] {
        let n = self.size.pixels();
        &self.values[index * n..(index + 1) * n]
    }

    /// All values, plane after plane.
    pub fn as_slice(&self) -> &'a [f32] {
        self.values
    }
}

impl Stack<f32> {
    /// All planes, borrowed.
    pub fn borrow(&self) -> Planes<'_> {
        Planes { values: self.as_slice(), count: self.count(), size: self.size(), weights: None, off_scale: None }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: Size = Size::new(3, 2);

    #[test]
    fn every_number_format_and_order_gives_the_same_planes() {
        let planar: Vec<u8> = (0..18).collect();
        let interleaved: Vec<f64> = (0..6).flat_map(|i| [0, 6, 12].map(|c| f64::from(c + i))).collect();
        let words: Vec<u16> = planar.iter().map(|v| u16::from(*v)).collect();
        let floats: Vec<f32> = planar.iter().map(|v| f32::from(*v)).collect();
        let views = [
            ImageView::planar(&planar, 3, SIZE).unwrap(),
            ImageView::interleaved(&interleaved, 3, SIZE).unwrap(),
            ImageView::planar(&words, 3, SIZE).unwrap(),
            ImageView::planar(&floats, 3, SIZE).unwrap(),
        ];
        for view in views {
            let mut buffer = Stack::zeros(0, Size::new(0, 0));
            let planes = view.to_planes(&mut buffer);
            assert_eq!((planes.as_slice(), planes.count(), planes.size()), (floats.as_slice(), 3, SIZE));
        }
    }

    #[test]
    fn planes_of_single_precision_are_not_copied() {
        let stack = Stack::from_vec(1, SIZE, vec![0.5f32; 6]).unwrap();
        let mut buffer = Stack::zeros(0, Size::new(0, 0));
        assert_eq!(stack.view().to_planes(&mut buffer).as_slice().as_ptr(), stack.as_slice().as_ptr());
        assert_eq!(buffer.bytes(), 0);
    }

    #[test]
    fn a_wrong_number_of_samples_is_refused_with_both_numbers() {
        let e = ImageView::planar(&[0u8; 5], 1, SIZE).unwrap_err().to_string();
        assert_eq!(e, "5 values cannot be 1 planes of 3×2 pixels");
    }
}
