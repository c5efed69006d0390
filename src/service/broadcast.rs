//! The latest picture of every view that someone watches, drawn and encoded once for all watchers.

use std::sync::atomic::{AtomicBool, AtomicU8, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use hyper::body::Bytes;
use tokio::sync::watch;

use super::hub::{Hub, Shown, Stage, Timings};
use super::view::{Painter, View};
use crate::camera::Role;
use crate::output::panel::encode_png;
use crate::output::{OutputError, encode_jpeg};
use crate::plane::Size;
use stokescope_core::image::Picture;

/// Between two parts of a stream.
pub(super) const BOUNDARY: &str = "stokescope-frame";
/// Type of a stream, with the boundary.
pub(super) const STREAM_TYPE: &str = "multipart/x-mixed-replace; boundary=stokescope-frame";
/// The encoder looks at this pace whether it should end.
const PACE: Duration = Duration::from_millis(500);

/// How a picture is encoded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Format {
    Jpeg,
    Png,
}

/// What there is to show.
#[derive(Clone, Debug, Default)]
struct Content {
    /// Grows with every change.
    version: u64,
    frame: Option<Arc<Shown>>,
    /// S0 of the frame that differences are taken against.
    background: Option<Arc<[f32]>>,
    /// Why the raw and the guide camera give no frames.
    faults: [Option<String>; 2],
}

impl Content {
    /// The camera that gives no frames, where `view` needs it, and why.
    fn offline(&self, view: View) -> Option<(Role, &str)> {
        let of = |role: Role| self.faults[role as usize].as_deref().map(|fault| (role, fault));
        of(Role::Raw).or_else(|| of(Role::Guide).filter(|_| view == View::Guide))
    }
}

/// One encoded picture, ready to be sent.
#[derive(Clone, Debug)]
pub(super) struct Encoded {
    version: u64,
    /// The picture, and for JPEG before and after it what belongs to it in a multipart stream.
    part: Bytes,
    image: std::ops::Range<usize>,
}

impl Encoded {
    /// The picture alone.
    pub(super) fn image(&self) -> Bytes {
        self.part.slice(self.image.clone())
    }

    /// The picture as a part of a stream.
    pub(super) fn part(&self) -> Bytes {
        self.part.clone()
    }
}

#[derive(Debug)]
struct Slot {
    view: View,
    format: Format,
    watchers: AtomicUsize,
    latest: watch::Sender<Option<Encoded>>,
    encoded: AtomicU64,
}

impl Slot {
    fn is_watched(&self) -> bool {
        self.watchers.load(Ordering::Acquire) > 0
    }

    /// Whether a picture of `content` is wanted that is not `done`, and can be drawn: the first watcher of a sketch waits for the
    /// next frame, unless there is a notice instead.
    fn wants(&self, content: &Content, done: Option<u64>) -> bool {
        let drawn = |frame: &Arc<Shown>| frame.sketched || content.offline(self.view).is_some();
        let is_there = || !self.view.is_sketch() || content.frame.as_ref().is_none_or(drawn);
        self.is_watched() && done != Some(content.version) && is_there()
    }
}

/// The meeting point of the solver, the encoder and the watchers.
#[derive(Debug)]
pub(super) struct Broadcast {
    slots: Vec<Slot>,
    content: Mutex<Content>,
    bell: Condvar,
    closed: AtomicBool,
    size: Size,
    quality: AtomicU8,
    /// Pictures for streams have one pixel for so many by so many.
    scale: AtomicUsize,
}

/// Someone watching a view.
#[derive(Debug)]
pub(super) struct Watch {
    hub: Arc<Hub>,
    slot: usize,
    latest: watch::Receiver<Option<Encoded>>,
}

impl Broadcast {
    /// For pictures of `size` of these views, as JPEG of `quality` or PNG.
    pub(super) fn new(views: &[View], size: Size, quality: u8) -> Self {
        let slot = |view, format| Slot {
            view,
            format,
            watchers: AtomicUsize::new(0),
            latest: watch::Sender::new(None),
            encoded: AtomicU64::new(0),
        };
        Self {
            slots: views.iter().flat_map(|&v| [slot(v, Format::Jpeg), slot(v, Format::Png)]).collect(),
            content: Mutex::default(),
            bell: Condvar::new(),
            closed: AtomicBool::new(false),
            size,
            quality: AtomicU8::new(quality),
            scale: AtomicUsize::new(1),
        }
    }

    /// Quality of the JPEG pictures, 1 to 100.
    pub(super) fn quality(&self) -> u8 {
        self.quality.load(Ordering::Relaxed)
    }

    /// Sets the quality of the JPEG pictures.
    pub(super) fn set_quality(&self, quality: u8) {
        self.quality.store(quality.clamp(1, 100), Ordering::Relaxed);
        self.change(|_| {});
    }

    /// Draws JPEG pictures with one pixel for `scale` by `scale`.
    pub(super) fn set_scale(&self, scale: usize) {
        self.scale.store(scale.max(1), Ordering::Relaxed);
    }

    /// Takes differences against this S0 from now on, or no longer.
    pub(super) fn set_background(&self, s0: Option<Arc<[f32]>>) {
        self.change(|content| content.background = s0);
    }

    /// Whether there is a background to take differences against.
    pub(super) fn has_background(&self) -> bool {
        self.lock().background.is_some()
    }

    fn lock(&self) -> MutexGuard<'_, Content> {
        // it is replaced as a whole
        self.content.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn change(&self, change: impl FnOnce(&mut Content)) {
        let mut content = self.lock();
        change(&mut content);
        content.version += 1;
        drop(content);
        self.bell.notify_all();
    }

    pub(super) fn size(&self) -> Size {
        self.size
    }

    /// Shows a frame, where there is a view of it.
    pub(super) fn show(&self, frame: Arc<Shown>) {
        if self.has_views() {
            self.change(|content| content.frame = Some(frame));
        }
    }

    /// Shows why there are no frames in place of what needs them.
    pub(super) fn offline(&self, role: Role, reason: &str) {
        let fault = Some(reason.to_owned());
        if self.lock().faults[role as usize] != fault {
            self.change(|content| content.faults[role as usize] = fault);
        }
    }

    /// Takes the notice away.
    pub(super) fn online(&self, role: Role) {
        self.change(|content| content.faults[role as usize] = None);
    }

    /// The latest frame.
    pub(super) fn frame(&self) -> Option<Arc<Shown>> {
        self.lock().frame.clone()
    }

    /// Whether there is a preview.
    pub(super) fn has_views(&self) -> bool {
        !self.slots.is_empty()
    }

    /// Whether somebody watches the frames of a camera as they are.
    pub(super) fn wants_sketches(&self) -> bool {
        self.slots.iter().any(|slot| slot.view.is_sketch() && slot.is_watched())
    }

    /// The views there are.
    pub(super) fn views(&self) -> impl Iterator<Item = View> {
        self.slots.iter().filter(|slot| slot.format == Format::Jpeg).map(|slot| slot.view)
    }

    /// For each view with a name: who watches it, and how many pictures of it were encoded.
    pub(super) fn figures(&self) -> impl Iterator<Item = (View, Format, usize, u64)> {
        self.slots.iter().map(|slot| {
            (slot.view, slot.format, slot.watchers.load(Ordering::Relaxed), slot.encoded.load(Ordering::Relaxed))
        })
    }

    /// Ends the encoder.
    pub(super) fn close(&self) {
        self.closed.store(true, Ordering::Release);
        self.bell.notify_all();
    }

    /// Encodes what is watched until closed: the newest content only, however fast it changes.
    pub(super) fn encode(&self, timings: &Timings) {
        let mut painter = Painter::new(self.size);
        let mut buffer = Vec::new();
        let mut previewed = None;
        let mut done = vec![None; self.slots.len()];
        while !self.closed.load(Ordering::Acquire) {
            let mut content = self.lock();
            let wanted = |content: &Content, done: &[Option<u64>]| {
                self.slots.iter().zip(done).any(|(slot, done)| slot.wants(content, *done))
            };
            if !wanted(&content, &done) {
                content = self.bell.wait_timeout(content, PACE).unwrap_or_else(PoisonError::into_inner).0;
            }
            let now = content.clone();
            drop(content);
            for (slot, done) in self.slots.iter().zip(&mut done) {
                if slot.wants(&now, *done) {
                    *done = Some(now.version);
                    let begin = Instant::now();
                    match self.encode_one(slot, &now, &mut painter, &mut buffer) {
                        Ok(encoded) => {
                            slot.encoded.fetch_add(1, Ordering::Relaxed);
                            slot.latest.send_replace(Some(encoded));
                            timings.add(Stage::Encode, begin.elapsed());
                            if let Some(frame) = now.frame.as_ref().filter(|frame| previewed != Some(frame.index)) {
                                previewed = Some(frame.index);
                                timings.add(Stage::Preview, frame.arrived.elapsed());
                            }
                        }
                        Err(e) => tracing::error!("preview: {e}"),
                    }
                }
            }
        }
    }

    fn encode_one(
        &self,
        slot: &Slot,
        content: &Content,
        painter: &mut Painter,
        buffer: &mut Vec<u8>,
    ) -> Result<Encoded, OutputError> {
        let pixels = match (content.offline(slot.view), &content.frame) {
            (Some((camera, fault)), _) => painter.notice(&format!("{camera} camera offline: {fault}")),
            (None, Some(frame)) => painter.draw(slot.view, frame, content.background.as_deref()),
            (None, None) => painter.notice("waiting for the first frame"),
        };
        let (head, tail) = if slot.format == Format::Jpeg {
            let scale = self.scale.load(Ordering::Relaxed);
            let small = (scale > 1).then(|| shrink(self.size, pixels, scale));
            let (size, pixels) = small.as_ref().map_or((self.size, pixels), |small| (small.size, &small.pixels));
            encode_jpeg(size, pixels, self.quality(), buffer)?;
            // the boundary follows at once: browsers show a part when they see its end
            let head = format!("Content-Type: image/jpeg\r\nContent-Length: {}\r\n\r\n", buffer.len());
            (head, format!("\r\n--{BOUNDARY}\r\n"))
        } else {
            buffer.clear();
            let picture = Picture { size: self.size, pixels: pixels.to_vec() };
            encode_png(&picture, buffer).map_err(|e| OutputError::Encode { format: "PNG", message: e.to_string() })?;
            (String::new(), String::new())
        };
        let image = head.len()..head.len() + buffer.len();
        let part = [head.as_bytes(), buffer, tail.as_bytes()].concat().into();
        Ok(Encoded { version: content.version, part, image })
    }
}

/// One pixel for `scale` by `scale`: their mean.
fn shrink(size: Size, pixels: &[[u8; 3]], scale: usize) -> Picture {
    let small = Size::new((size.width / scale).max(1), (size.height / scale).max(1));
    let block = |at: usize| {
        let (left, top) = (at % small.width * scale, at / small.width * scale);
        let (wide, high) = (scale.min(size.width - left), scale.min(size.height - top));
        let inside = (0..wide * high).map(|k| pixels[(top + k / wide) * size.width + left + k % wide]);
        let sum = inside.fold([0u32; 3], |sum, p| [0, 1, 2].map(|c| sum[c] + u32::from(p[c])));
        sum.map(|v| (v / (wide * high) as u32) as u8)
    };
    Picture { size: small, pixels: (0..small.pixels()).map(block).collect() }
}

impl Watch {
    /// Watches the view called `name`; none when there is no such view.
    pub(super) fn new(hub: &Arc<Hub>, name: &str, format: Format) -> Option<Self> {
        let broadcast = &hub.broadcast;
        let slot = broadcast.slots.iter().position(|s| s.format == format && s.view.name() == name)?;
        broadcast.slots[slot].watchers.fetch_add(1, Ordering::AcqRel);
        let mut latest = broadcast.slots[slot].latest.subscribe();
        let version = broadcast.lock().version;
        // what nobody watched for a while is out of date
        if latest.borrow().as_ref().is_some_and(|encoded| encoded.version == version) {
            latest.mark_changed();
        }
        broadcast.bell.notify_all();
        Some(Self { hub: Arc::clone(hub), slot, latest })
    }

    /// The next picture that was not seen yet: always the newest, those between are skipped. None when the service ends.
    pub(super) async fn next(&mut self) -> Option<Encoded> {
        loop {
            self.latest.changed().await.ok()?;
            if let Some(encoded) = self.latest.borrow_and_update().clone() {
                return Some(encoded);
            }
        }
    }
}

impl Drop for Watch {
    fn drop(&mut self) {
        self.hub.broadcast.slots[self.slot].watchers.fetch_sub(1, Ordering::AcqRel);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::service::view::tests::frame;

    #[test]
    fn sketches_are_drawn_of_frames_that_were_made_while_somebody_watched() {
        let broadcast = Broadcast::new(&[View::Intensity, View::Raw, View::Guide], Size::new(2, 1), 90);
        let slot = |view| broadcast.slots.iter().find(|slot| slot.view == view).unwrap();
        let content = |sketched, fault: Option<&str>| Content {
            frame: Some(Arc::new(Shown { sketched, ..frame(1) })),
            faults: [fault.map(str::to_owned), None],
            ..Content::default()
        };
        slot(View::Intensity).watchers.store(1, Ordering::Relaxed);
        assert!(slot(View::Intensity).wants(&content(false, None), None));
        assert!(!broadcast.wants_sketches() && !slot(View::Raw).wants(&content(true, None), None));
        slot(View::Raw).watchers.store(1, Ordering::Relaxed);
        assert!(broadcast.wants_sketches() && slot(View::Raw).wants(&content(true, None), None));
        assert!(!slot(View::Raw).wants(&content(true, None), Some(0)));
        assert!(!slot(View::Raw).wants(&content(false, None), None));
        assert!(slot(View::Raw).wants(&content(false, Some("gone")), None));
        assert!(slot(View::Raw).wants(&Content::default(), None));
        slot(View::Guide).watchers.store(1, Ordering::Relaxed);
        let unguided = Content { faults: [None, Some("gone".to_owned())], ..content(false, None) };
        assert!(slot(View::Guide).wants(&unguided, None) && !slot(View::Raw).wants(&unguided, None));
    }

    #[test]
    fn a_smaller_picture_has_the_means_of_the_larger_one() {
        let pixels: Vec<[u8; 3]> = (0..20).map(|i| [i as u8, 0, 255]).collect();
        let small = shrink(Size::new(5, 4), &pixels, 2);
        assert_eq!((small.size, small.pixels[0], small.pixels[3]), (Size::new(2, 2), [3, 0, 255], [15, 0, 255]));
        assert_eq!(shrink(Size::new(1, 1), &[[7; 3]], 2).pixels, [[7; 3]]);
    }
}
