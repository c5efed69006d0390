use std::time::Duration;

use super::{Camera, CameraError, CameraInfo, bounded};
use stokescope_core::frame::Frame;

/// Frames in a row that may not be newer than the one before, by their sequence numbers.
const MAX_REPEATED: u32 = 3;
/// Rows of a frame that its content is judged by: with noise, even one hardly ever repeats.
const ROWS: usize = 32;
/// Patience with a driver that closes a camera.
const CLOSING: Duration = Duration::from_secs(2);

/// A camera that is not trusted: its frames have to move on, and it may take its time to close but not stop the program.
pub(super) struct Watched {
    /// Always there, until it is dropped.
    camera: Option<Box<dyn Camera>>,
    info: CameraInfo,
    address: String,
    /// After how many frames of the same content it counts as stuck; none is never.
    max_identical: Option<u32>,
    /// Whether its driver may hang when it is closed.
    slow_to_close: bool,
    sequence: Option<u64>,
    repeated: u32,
    content: Option<u64>,
    identical: u32,
}

impl Watched {
    /// Watches `camera`, which was opened from `address`.
    pub(super) fn new(
        camera: Box<dyn Camera>,
        address: String,
        max_identical: Option<u32>,
        slow_to_close: bool,
    ) -> Self {
        let info = camera.info().clone();
        let (camera, max_identical) = (Some(camera), max_identical.filter(|frames| *frames > 0));
        let (sequence, content) = (None, None);
        Self { camera, info, address, max_identical, slow_to_close, sequence, repeated: 0, content, identical: 0 }
    }
}

impl Camera for Watched {
    fn info(&self) -> &CameraInfo {
        &self.info
    }

    fn next_frame(&mut self, timeout: Duration) -> Result<Frame<'_>, CameraError> {
        let stuck =
            |what, frames| CameraError::Stuck { camera: self.info.name.clone(), what, frames: u64::from(frames) + 1 };
        let Some(camera) = &mut self.camera else {
            return Err(CameraError::Lost { camera: self.info.name.clone(), reason: "closed".to_owned() });
        };
        let frame = camera.next_frame(timeout)?;
        let sequence = frame.metadata.sequence;
        self.repeated = if self.sequence.is_some_and(|last| sequence <= last) { self.repeated + 1 } else { 0 };
        self.sequence = Some(sequence);
        if self.repeated >= MAX_REPEATED {
            return Err(stuck("frames that are not newer than the one before", self.repeated));
        }
        if let Some(limit) = self.max_identical {
            let content = digest(&frame);
            self.identical = if content.is_some() && self.content == content { self.identical + 1 } else { 0 };
            self.content = content;
            if self.identical + 1 >= limit.max(2) {
                return Err(stuck("frames of exactly the same content", self.identical));
            }
        }
        Ok(frame)
    }
}

impl Drop for Watched {
    fn drop(&mut self) {
        let Some(camera) = self.camera.take().filter(|_| self.slow_to_close) else { return };
        if bounded::within(&self.address, CLOSING, move || drop(camera)).is_err() {
            tracing::warn!("{}: the driver does not close it and is left behind", self.info.name);
        }
    }
}

/// A figure of some rows of a frame, all over it; none when every byte is the same, as behind a lens cap. Does not allocate.
fn digest(frame: &Frame<'_>) -> Option<u64> {
    // Fowler, Noll and Vo's hash over words
    const PRIME: u64 = 0x0000_0100_0000_01b3;
    let step = frame.rows().len().div_ceil(ROWS);
    let first = frame.row(0)[0];
    let plain = u64::from_ne_bytes([first; 8]);
    let (mut sum, mut varied) = (0xcbf2_9ce4_8422_2325, false);
    for row in frame.rows().step_by(step) {
        let (words, rest) = row.as_chunks::<8>();
        for word in words {
            let word = u64::from_ne_bytes(*word);
            varied |= word != plain;
            sum = (sum ^ word).wrapping_mul(PRIME);
        }
        for byte in rest {
            varied |= *byte != first;
            sum = (sum ^ u64::from(*byte)).wrapping_mul(PRIME);
        }
    }
    varied.then_some(sum)
}

#[cfg(test)]
mod tests {
    use super::*;
    use stokescope_core::frame::{Metadata, PixelFormat, Samples};
    use stokescope_core::image::Size;

    const FORMAT: PixelFormat = PixelFormat::Mono(Samples::U8);
    const SIZE: Size = Size::new(9, 40);

    /// Shows what it is told to: the sequence number and one pixel of each frame.
    struct Script {
        info: CameraInfo,
        frames: std::vec::IntoIter<(u64, u8)>,
        bytes: Vec<u8>,
        closing: Duration,
    }

    impl Camera for Script {
        fn info(&self) -> &CameraInfo {
            &self.info
        }

        fn next_frame(&mut self, after: Duration) -> Result<Frame<'_>, CameraError> {
            let camera = self.info.name.clone();
            let (sequence, pixel) = self.frames.next().ok_or(CameraError::Timeout { camera, after })?;
            self.bytes[8] = pixel;
            let metadata = Metadata { sequence, ..Metadata::default() };
            Ok(Frame::new(&self.bytes, FORMAT, SIZE, SIZE.width, metadata).unwrap())
        }
    }

    impl Drop for Script {
        fn drop(&mut self) {
            std::thread::sleep(self.closing);
        }
    }

    fn watched(frames: Vec<(u64, u8)>, max_identical: Option<u32>, closing: Duration) -> Watched {
        let (name, backend) = ("script".to_owned(), "test");
        let info = CameraInfo { name, backend, format: FORMAT, size: SIZE, frame_rate: None };
        let camera = Script { info, frames: frames.into_iter(), bytes: vec![0; SIZE.pixels()], closing };
        Watched::new(Box::new(camera), format!("test {closing:?}"), max_identical, true)
    }

    /// How many frames come before it fails, and how.
    fn run(mut camera: Watched) -> (usize, String) {
        for n in 0.. {
            if let Err(e) = camera.next_frame(Duration::ZERO) {
                return (n, e.to_string());
            }
        }
        unreachable!()
    }

    #[test]
    fn a_sequence_that_does_not_move_on_is_a_fault_and_gaps_are_none() {
        let numbers = |list: &[u64]| list.iter().map(|&n| (n, n as u8)).collect();
        let (shown, why) = run(watched(numbers(&[5, 6, 6, 6, 6, 7]), None, Duration::ZERO));
        assert_eq!((shown, why.as_str()), (4, "script: stuck, 4 frames that are not newer than the one before"));
        assert_eq!(run(watched(numbers(&[1, 2, 2, 9, 9, 10, 200]), None, Duration::ZERO)).0, 7);
    }

    #[test]
    fn the_same_content_again_and_again_is_a_fault_where_it_is_looked_for() {
        let frames: Vec<_> = (0..20).map(|n| (n, 1 + u8::from(n < 3))).collect();
        let (shown, why) = run(watched(frames.clone(), Some(5), Duration::ZERO));
        assert_eq!((shown, why.as_str()), (7, "script: stuck, 5 frames of exactly the same content"));
        for never in [None, Some(0)] {
            assert_eq!(run(watched(frames.clone(), never, Duration::ZERO)).0, 20);
        }
        let capped: Vec<_> = (0..20).map(|n| (n, 0)).collect();
        assert_eq!(run(watched(capped, Some(5), Duration::ZERO)).0, 20, "darkness does not change");
    }

    #[test]
    fn a_camera_that_does_not_close_is_left_behind() {
        let begin = std::time::Instant::now();
        drop(watched(Vec::new(), None, 3 * CLOSING));
        assert!(begin.elapsed() < 2 * CLOSING, "{:?}", begin.elapsed());
    }
}
