use super::Size;

/// A picture for display: `size.pixels()` triples of red, green and blue, 0 to 255, row-major.
#[derive(Clone, Debug, PartialEq)]
pub struct Picture {
    /// Width and height in pixels.
    pub size: Size,
    /// The pixels.
    pub pixels: Vec<[u8; 3]>,
}
