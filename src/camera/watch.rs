//! Detection of stuck cameras, and a time limit for closing a camera.

use std::time::Duration;

use super::timing::{Exposure, monotonic};
use super::{Camera, CameraError, CameraInfo, bounded};
use stokescope_core::frame::Frame;

/// Number of frames in a row without a new sequence number after which a camera counts as stuck.
const MAX_REPEATED: u32 = 3;
/// Number of rows that are compared between frames; with noise, even one row hardly ever repeats.
const ROWS: usize = 32;
/// Time limit for a driver to close a camera.
const CLOSE_LIMIT: Duration = Duration::from_secs(2);

/// A camera whose repeated frames are errors, and whose driver cannot block the program when it is closed.
pub(super) struct WatchedCamera {
    /// The camera; `None` only while it is dropped.
    camera: Option<Box<dyn Camera>>,
    info: CameraInfo,
    address: String,
    /// Number of identical frames in a row after which the camera counts as stuck; `None` is never.
    max_identical: Option<u32>,
    /// Whether the driver may hang when the camera is closed.
    slow_to_close: bool,
    sequence: Option<u64>,
    repeated: u32,
    content: Option<u64>,
    identical: u32,
    /// Meaning of its time stamps; `None` leaves them.
    exposure: Option<Exposure>,
    /// Whether an external trigger starts each exposure.
    triggered: bool,
}

impl WatchedCamera {
    /// Wraps `camera`, which was opened at `address`.
    pub(super) fn new(
        camera: Box<dyn Camera>,
        address: String,
        max_identical: Option<u32>,
        slow_to_close: bool,
    ) -> Self {
        let info = camera.info().clone();
        let (camera, max_identical) = (Some(camera), max_identical.filter(|frames| *frames > 0));
        let (sequence, content) = (None, None);
        let (exposure, triggered) = (None, false);
        let (repeated, identical) = (0, 0);
        Self {
            camera,
            info,
            address,
            max_identical,
            slow_to_close,
            sequence,
            repeated,
            content,
            identical,
            exposure,
            triggered,
        }
    }

    /// The camera with time stamps of the middle of its exposures. With an external trigger silence is no fault.
    pub(super) fn timed(mut self, exposure: Exposure, triggered: bool) -> Self {
        (self.exposure, self.triggered) = (Some(exposure), triggered);
        self
    }
}

impl Camera for WatchedCamera {
    fn info(&self) -> &CameraInfo {
        &self.info
    }

    fn next_frame(&mut self, timeout: Duration) -> Result<Frame<'_>, CameraError> {
        let stuck =
            |what, frames| CameraError::Stuck { camera: self.info.name.clone(), what, frames: u64::from(frames) + 1 };
        let Some(camera) = &mut self.camera else {
            return Err(CameraError::Lost { camera: self.info.name.clone(), reason: "closed".to_owned() });
        };
        let waiting = |e| match e {
            CameraError::Timeout { camera, .. } if self.triggered => CameraError::Waiting { camera, what: "a trigger" },
            e => e,
        };
        let mut frame = camera.next_frame(timeout).map_err(waiting)?;
        if let Some(exposure) = &self.exposure {
            exposure.apply(&mut frame.metadata, monotonic);
        }
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

impl Drop for WatchedCamera {
    fn drop(&mut self) {
        let Some(camera) = self.camera.take().filter(|_| self.slow_to_close) else { return };
        if bounded::within(&self.address, CLOSE_LIMIT, move || drop(camera)).is_err() {
            tracing::warn!("{}: the driver does not close the camera and is abandoned", self.info.name);
        }
    }
}

/// Hash of rows spread over a frame; `None` when all bytes are equal, as behind a lens cap. Does not allocate.
fn digest(frame: &Frame<'_>) -> Option<u64> {
    // FNV-1a over words
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
    use crate::board::{Stamp, Timing};
    use crate::camera::Limits;
    use stokescope_core::frame::{Metadata, PixelFormat, Samples};
    use stokescope_core::image::Size;

    const FORMAT: PixelFormat = PixelFormat::Mono(Samples::U8);
    const SIZE: Size = Size::new(9, 40);

    /// Camera with given sequence numbers and values of one pixel.
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

    fn watched(frames: Vec<(u64, u8)>, max_identical: Option<u32>, closing: Duration) -> WatchedCamera {
        let (name, backend) = ("script".to_owned(), "test");
        let info = CameraInfo {
            name,
            backend,
            format: FORMAT,
            size: SIZE,
            frame_rate: None,
            levels: None,
            readout: None,
            limits: Limits::default(),
        };
        let camera = Script { info, frames: frames.into_iter(), bytes: vec![0; SIZE.pixels()], closing };
        WatchedCamera::new(Box::new(camera), format!("test {closing:?}"), max_identical, true)
    }

    /// Number of frames before the first error, and its message.
    fn run(mut camera: WatchedCamera) -> (usize, String) {
        for n in 0.. {
            if let Err(e) = camera.next_frame(Duration::ZERO) {
                return (n, e.to_string());
            }
        }
        unreachable!()
    }

    #[test]
    fn a_repeated_sequence_number_is_a_fault_and_a_gap_is_not() {
        let numbers = |list: &[u64]| list.iter().map(|&n| (n, n as u8)).collect();
        let (shown, why) = run(watched(numbers(&[5, 6, 6, 6, 6, 7]), None, Duration::ZERO));
        assert_eq!((shown, why.as_str()), (4, "script: stuck, 4 frames that are not newer than the one before"));
        assert_eq!(run(watched(numbers(&[1, 2, 2, 9, 9, 10, 200]), None, Duration::ZERO)).0, 7);
    }

    #[test]
    fn repeated_content_is_a_fault_when_enabled() {
        let frames: Vec<_> = (0..20).map(|n| (n, 1 + u8::from(n < 3))).collect();
        let (shown, why) = run(watched(frames.clone(), Some(5), Duration::ZERO));
        assert_eq!((shown, why.as_str()), (7, "script: stuck, 5 frames of exactly the same content"));
        for never in [None, Some(0)] {
            assert_eq!(run(watched(frames.clone(), never, Duration::ZERO)).0, 20);
        }
        let capped: Vec<_> = (0..20).map(|n| (n, 0)).collect();
        assert_eq!(run(watched(capped, Some(5), Duration::ZERO)).0, 20, "a uniform picture does not count");
    }

    #[test]
    fn silence_of_a_triggered_camera_is_no_fault() {
        let timing = Timing { triggered: true, ..Timing::default() };
        let exposure = Exposure::new(Some(Stamp::ExposureEnd), None, &timing, Some(2000.0));
        let mut camera = watched(vec![(0, 1)], None, Duration::ZERO).timed(exposure, true);
        assert_eq!(camera.next_frame(Duration::ZERO).unwrap().metadata.exposure_us, Some(2000.0));
        let e = camera.next_frame(Duration::ZERO).err().unwrap();
        assert!(matches!(e, CameraError::Waiting { .. }), "{e}");
    }

    #[test]
    fn a_camera_that_does_not_close_is_abandoned() {
        let begin = std::time::Instant::now();
        drop(watched(Vec::new(), None, 3 * CLOSE_LIMIT));
        assert!(begin.elapsed() < 2 * CLOSE_LIMIT, "{:?}", begin.elapsed());
    }
}
