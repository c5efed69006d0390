use super::{Size, Stack};

/// Makes the buffers of a workspace, or counts the bytes that they would take: one description serves both.
///
/// ```
/// use stokescope_core::image::Buffers;
/// let workspace = |buffers: &mut Buffers| (buffers.filled(0.0f32, 100), buffers.reserved::<u8>(50));
/// assert_eq!(Buffers::bytes(workspace), 450);
/// let (values, bytes) = Buffers::allocate(workspace);
/// assert!(values.len() == 100 && bytes.capacity() >= 50);
/// ```
#[derive(Debug)]
pub struct Buffers {
    /// Bytes counted so far; none if buffers are made.
    counted: Option<usize>,
}

impl Buffers {
    /// Makes a workspace. Allocates.
    pub fn allocate<W>(describe: impl FnOnce(&mut Self) -> W) -> W {
        describe(&mut Self { counted: None })
    }

    /// Bytes of a workspace's buffers. Allocates none of them.
    pub fn bytes<W>(describe: impl FnOnce(&mut Self) -> W) -> usize {
        let mut buffers = Self { counted: Some(0) };
        describe(&mut buffers);
        buffers.counted.unwrap_or(0)
    }

    /// A vector of `len` times `value`; an empty one while bytes are counted.
    pub fn filled<T: Clone>(&mut self, value: T, len: usize) -> Vec<T> {
        if self.count::<T>(len) { Vec::new() } else { vec![value; len] }
    }

    /// An empty vector with room for `capacity` values; without it while bytes are counted.
    pub fn reserved<T>(&mut self, capacity: usize) -> Vec<T> {
        if self.count::<T>(capacity) { Vec::new() } else { Vec::with_capacity(capacity) }
    }

    /// `count` planes of zeros; none while bytes are counted.
    pub fn stack<T: Copy + Default>(&mut self, count: usize, size: Size) -> Stack<T> {
        let counts = self.count::<T>(count * size.pixels());
        Stack::zeros(if counts { 0 } else { count }, size)
    }

    /// Counts `len` values, if bytes are counted.
    fn count<T>(&mut self, len: usize) -> bool {
        self.counted.as_mut().map(|bytes| *bytes += len * size_of::<T>()).is_some()
    }
}
