use super::Size;

/// `count` planes of one size in one allocation: `[count, height, width]`, row-major.
#[derive(Clone, Debug, PartialEq)]
pub struct Stack<T> {
    count: usize,
    size: Size,
    data: Vec<T>,
}

/// The number of values does not fit the shape.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{found} values cannot be {count} planes of {size} pixels")]
pub struct ShapeError {
    /// Planes asked for.
    pub count: usize,
    /// Size of one plane.
    pub size: Size,
    /// Number of values there are.
    pub found: usize,
}

impl<T> Default for Stack<T> {
    /// No planes.
    fn default() -> Self {
        Self { count: 0, size: Size::new(0, 0), data: Vec::new() }
    }
}

impl<T: Copy + Default> Stack<T> {
    /// `count` planes of zeros. Allocates.
    pub fn zeros(count: usize, size: Size) -> Self {
        Self { count, size, data: vec![T::default(); count * size.pixels()] }
    }
}

impl<T> Stack<T> {
    /// Takes `data` as `count` planes of `size`.
    ///
    /// # Errors
    /// [`ShapeError`] when the length of `data` is not `count × size`.
    pub fn from_vec(count: usize, size: Size, data: Vec<T>) -> Result<Self, ShapeError> {
        if data.len() != count * size.pixels() {
            return Err(ShapeError { count, size, found: data.len() });
        }
        Ok(Self { count, size, data })
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
    pub fn plane(&self, index: usize) -> &[T] {
        let n = self.size.pixels();
        &self.data[index * n..(index + 1) * n]
    }

    /// Plane `index`, row-major, to be written.
    pub fn plane_mut(&mut self, index: usize) -> &mut [T] {
        let n = self.size.pixels();
        &mut self.data[index * n..(index + 1) * n]
    }

    /// All planes in order.
    pub fn planes(&self) -> impl ExactSizeIterator<Item = &[T]> {
        self.data.chunks_exact(self.size.pixels().max(1))
    }

    /// All planes in order, to be written.
    pub fn planes_mut(&mut self) -> impl ExactSizeIterator<Item = &mut [T]> {
        self.data.chunks_exact_mut(self.size.pixels().max(1))
    }

    /// All values, plane after plane.
    pub fn as_slice(&self) -> &[T] {
        &self.data
    }

    /// All values, plane after plane, to be written.
    pub fn as_mut_slice(&mut self) -> &mut [T] {
        &mut self.data
    }

    /// Bytes held.
    pub fn bytes(&self) -> usize {
        self.data.len() * size_of::<T>()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn planes_lie_one_after_another() {
        let s = Stack::from_vec(2, Size::new(2, 1), vec![1, 2, 3, 4]).unwrap();
        assert_eq!(s.plane(1), [3, 4]);
        assert_eq!(s.planes().map(|p| p[0]).collect::<Vec<_>>(), [1, 3]);
    }

    #[test]
    fn a_wrong_length_names_shape_and_length() {
        let e = Stack::from_vec(2, Size::new(2, 2), vec![0u8; 7]).unwrap_err();
        assert_eq!(e.to_string(), "7 values cannot be 2 planes of 2×2 pixels");
    }
}
