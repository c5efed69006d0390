//! Latest picture of every view that somebody watches, drawn and encoded once for all watchers.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU8, AtomicU64, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use axum::body::Bytes;
use parking_lot::{Condvar, Mutex};
use tokio::sync::{oneshot, watch};

use super::painter::Painter;
use super::view::View;
use crate::camera::Role;
use crate::live::frame::PublishedFrame;
use crate::live::statistics::{Stage, Timings};
use crate::output::panel::encode_png;
use crate::output::{OutputError, encode_jpeg};
use stokescope_core::image::Picture;
use stokescope_core::image::Size;

/// Boundary between two parts of a stream.
pub(in crate::live) const BOUNDARY: &str = "stokescope-frame";
/// Pace of the encoder's checks for the end of the service.
const PACE: Duration = Duration::from_millis(500);
/// Pace of the looks for a frame with its raw and guide frames.
const LOOK: Duration = Duration::from_millis(20);

/// Encoding of a picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::live) enum PictureFormat {
    Jpeg,
    Png,
}

impl PictureFormat {
    pub(in crate::live) fn name(self) -> &'static str {
        match self {
            Self::Jpeg => "jpeg",
            Self::Png => "png",
        }
    }
}

/// Everything that pictures are drawn from.
#[derive(Clone, Debug, Default)]
struct Content {
    /// Grows with every change.
    version: u64,
    frame: Option<Arc<PublishedFrame>>,
    /// S0 of the frame that differences are taken against.
    background: Option<Arc<[f32]>>,
    /// Reasons why the raw and the guide camera give no frames.
    faults: [Option<String>; 2],
}

impl Content {
    /// Camera that `view` needs and that gives no frames, with the reason.
    fn offline(&self, view: View) -> Option<(Role, &str)> {
        let of = |role: Role| self.faults[role as usize].as_deref().map(|fault| (role, fault));
        of(Role::Raw).or_else(|| of(Role::Guide).filter(|_| view == View::Guide))
    }
}

/// One encoded picture, ready to be sent.
#[derive(Clone, Debug)]
pub(in crate::live) struct Encoded {
    version: u64,
    /// The picture. A JPEG stands between its head and the boundary, as a part of a multipart stream.
    part: Bytes,
    /// Range of the picture in `part`.
    image: std::ops::Range<usize>,
}

impl Encoded {
    /// The picture alone.
    pub(in crate::live) fn image(&self) -> Bytes {
        self.part.slice(self.image.clone())
    }

    /// The picture as a part of a stream.
    pub(in crate::live) fn part(&self) -> Bytes {
        self.part.clone()
    }
}

/// One view in one format.
#[derive(Debug)]
struct Slot {
    view: View,
    format: PictureFormat,
    watchers: AtomicUsize,
    latest: watch::Sender<Option<Encoded>>,
    encoded: AtomicU64,
}

impl Slot {
    fn is_watched(&self) -> bool {
        self.watchers.load(Ordering::Acquire) > 0
    }

    /// Whether somebody waits for a picture of `content`, whose version differs from the one `done`, and it can be drawn. The
    /// first watcher of a raw or guide frame waits for the next one, unless there is a notice instead.
    fn wants(&self, content: &Content, done: Option<u64>) -> bool {
        let drawn = |frame: &Arc<PublishedFrame>| frame.sketched || content.offline(self.view).is_some();
        let is_there = || !self.view.is_sketch() || content.frame.as_ref().is_none_or(drawn);
        self.is_watched() && done != Some(content.version) && is_there()
    }
}

/// A picture of one certain frame that somebody waits for.
#[derive(Debug)]
struct StillRequest {
    view: View,
    frame: Arc<PublishedFrame>,
    background: Option<Arc<[f32]>>,
    /// Takes the PNG file.
    answer: oneshot::Sender<Vec<u8>>,
}

/// One frame and what its pictures are drawn with, held for somebody.
#[derive(Clone, Debug)]
pub(in crate::live) struct Still {
    pub(in crate::live) frame: Arc<PublishedFrame>,
    background: Option<Arc<[f32]>>,
}

/// Meeting point of the solver, the encoder and the watchers.
#[derive(Debug)]
pub(in crate::live) struct Broadcast {
    slots: Vec<Slot>,
    content: Mutex<Content>,
    /// The picture that the encoder draws next.
    request: Mutex<Option<StillRequest>>,
    /// Number of those who wait for a frame with its raw and guide frames.
    sketch_wishes: AtomicUsize,
    bell: Condvar,
    closed: AtomicBool,
    size: Size,
    quality: AtomicU8,
    /// Side in pixels of the square that becomes one pixel of a JPEG picture.
    scale: AtomicUsize,
    degrees: Mutex<DegreeScale>,
}

/// Scale that degrees of polarization are drawn on.
#[derive(Clone, Copy, Debug)]
pub(in crate::live) struct DegreeScale {
    /// End of the scale as it was set; none where it follows the frame.
    pub(in crate::live) set: Option<f32>,
    /// End of the scale in the latest picture.
    pub(in crate::live) drawn: f32,
}

/// A watcher of a view.
#[derive(Debug)]
pub(in crate::live) struct Watch {
    broadcast: Arc<Broadcast>,
    slot: usize,
    latest: watch::Receiver<Option<Encoded>>,
}

impl Broadcast {
    /// Pictures of these views of frames of `size`, as JPEG of `quality` (1 to 100) or PNG.
    pub(in crate::live) fn new(views: &[View], size: Size, quality: u8) -> Self {
        let slot = |view, format| Slot {
            view,
            format,
            watchers: AtomicUsize::new(0),
            latest: watch::Sender::new(None),
            encoded: AtomicU64::new(0),
        };
        Self {
            slots: views.iter().flat_map(|&v| [slot(v, PictureFormat::Jpeg), slot(v, PictureFormat::Png)]).collect(),
            content: Mutex::default(),
            request: Mutex::default(),
            sketch_wishes: AtomicUsize::new(0),
            bell: Condvar::new(),
            closed: AtomicBool::new(false),
            size,
            quality: AtomicU8::new(quality),
            scale: AtomicUsize::new(1),
            degrees: Mutex::new(DegreeScale { set: Some(1.0), drawn: 1.0 }),
        }
    }

    /// Quality of the JPEG pictures, 1 to 100.
    pub(in crate::live) fn quality(&self) -> u8 {
        self.quality.load(Ordering::Relaxed)
    }

    /// Sets the quality of the JPEG pictures.
    pub(in crate::live) fn set_quality(&self, quality: u8) {
        self.quality.store(quality.clamp(1, 100), Ordering::Relaxed);
        self.change(|_| {});
    }

    /// Scale that degrees of polarization are drawn on.
    pub(in crate::live) fn degrees(&self) -> DegreeScale {
        *self.degrees.lock()
    }

    /// Draws degrees of polarization on a scale that ends at `end`; none lets it follow the frame.
    pub(in crate::live) fn set_degrees(&self, end: Option<f32>) {
        self.degrees.lock().set = end;
        self.change(|_| {});
    }

    /// Draws JPEG pictures with one pixel for `scale` by `scale`.
    pub(in crate::live) fn set_scale(&self, scale: usize) {
        self.scale.store(scale.max(1), Ordering::Relaxed);
    }

    /// Takes differences against this S0 from now on, or no longer.
    pub(in crate::live) fn set_background(&self, s0: Option<Arc<[f32]>>) {
        self.change(|content| content.background = s0);
    }

    /// Whether there is a background to take differences against.
    pub(in crate::live) fn has_background(&self) -> bool {
        self.content.lock().background.is_some()
    }

    fn change(&self, change: impl FnOnce(&mut Content)) {
        let mut content = self.content.lock();
        change(&mut content);
        content.version += 1;
        drop(content);
        self.bell.notify_all();
    }

    /// Size of the frames.
    pub(in crate::live) fn size(&self) -> Size {
        self.size
    }

    /// Shows a frame, if there are views.
    pub(in crate::live) fn show(&self, frame: Arc<PublishedFrame>) {
        if self.has_views() {
            self.change(|content| content.frame = Some(frame));
        }
    }

    /// Shows why a camera gives no frames, in place of the pictures that need it.
    pub(in crate::live) fn offline(&self, role: Role, reason: &str) {
        let fault = Some(reason.to_owned());
        if self.content.lock().faults[role as usize] != fault {
            self.change(|content| content.faults[role as usize] = fault);
        }
    }

    /// Shows pictures again.
    pub(in crate::live) fn online(&self, role: Role) {
        self.change(|content| content.faults[role as usize] = None);
    }

    /// The latest frame.
    pub(in crate::live) fn frame(&self) -> Option<Arc<PublishedFrame>> {
        self.content.lock().frame.clone()
    }

    /// Whether there is a preview.
    pub(in crate::live) fn has_views(&self) -> bool {
        !self.slots.is_empty()
    }

    /// The latest frame, with its raw and guide frames if these are wanted; waits for the next one where need be, at most for `patience`.
    pub(in crate::live) async fn still(&self, sketched: bool, patience: Duration) -> Option<Still> {
        let _wish = sketched.then(|| Wish::new(&self.sketch_wishes));
        let deadline = Instant::now() + patience;
        loop {
            let content = self.content.lock().clone();
            if let Some(frame) = content.frame.filter(|frame| frame.sketched || !sketched) {
                return Some(Still { frame, background: content.background });
            }
            if Instant::now() > deadline {
                return None;
            }
            tokio::time::sleep(LOOK).await;
        }
    }

    /// Lets the encoder draw a view of a held frame as a PNG file; none when the service ends.
    pub(in crate::live) async fn draw(&self, still: &Still, view: View) -> Option<Vec<u8>> {
        let (answer, drawn) = oneshot::channel();
        let Still { frame, background } = still.clone();
        *self.request.lock() = Some(StillRequest { view, frame, background, answer });
        // the encoder looks for requests while it holds the content
        drop(self.content.lock());
        self.bell.notify_all();
        drawn.await.ok()
    }

    /// Whether somebody wants raw or guide frames.
    pub(in crate::live) fn wants_sketches(&self) -> bool {
        let wished = self.sketch_wishes.load(Ordering::Relaxed) > 0;
        wished || self.slots.iter().any(|slot| slot.view.is_sketch() && slot.is_watched())
    }

    /// The views there are.
    pub(in crate::live) fn views(&self) -> impl Iterator<Item = View> {
        self.slots.iter().filter(|slot| slot.format == PictureFormat::Jpeg).map(|slot| slot.view)
    }

    /// Number of pictures that were encoded of each view in each format.
    pub(in crate::live) fn encoded(&self) -> impl Iterator<Item = (View, PictureFormat, u64)> {
        self.slots.iter().map(|slot| (slot.view, slot.format, slot.encoded.load(Ordering::Relaxed)))
    }

    /// Ends the encoder.
    pub(in crate::live) fn close(&self) {
        self.closed.store(true, Ordering::Release);
        self.bell.notify_all();
    }

    /// Encodes watched views until closed: only the newest content, however fast it changes.
    pub(in crate::live) fn encode(&self, timings: &Timings) {
        let mut painter = Painter::new(self.size);
        let mut buffer = Vec::new();
        let mut previewed = None;
        let mut done = vec![None; self.slots.len()];
        while !self.closed.load(Ordering::Acquire) {
            let now = self.wait_for_work(&done);
            painter.dolp_scale = self.degrees.lock().set;
            if let Some(request) = self.request.lock().take() {
                request.answer(self.size, &mut painter);
            }
            for (slot, done) in self.slots.iter().zip(&mut done) {
                if !slot.wants(&now, *done) {
                    continue;
                }
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
            if let Some(top) = painter.dolp_top.take() {
                self.degrees.lock().drawn = top;
            }
        }
    }

    /// Waits until a slot wants a picture, at most for a moment; gives the content then. `done` has the version of each slot's
    /// last picture.
    fn wait_for_work(&self, done: &[Option<u64>]) -> Content {
        let mut content = self.content.lock();
        let wanted = self.slots.iter().zip(done).any(|(slot, done)| slot.wants(&content, *done));
        if !wanted && self.request.lock().is_none() {
            self.bell.wait_for(&mut content, PACE);
        }
        content.clone()
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
        let (head, tail) = if slot.format == PictureFormat::Jpeg {
            let scale = self.scale.load(Ordering::Relaxed);
            let small = (scale > 1).then(|| shrink(self.size, pixels, scale));
            let (size, pixels) = small.as_ref().map_or((self.size, pixels), |small| (small.size, &small.pixels));
            encode_jpeg(size, pixels, self.quality(), buffer)?;
            // browsers show a part when they see its end, so the boundary follows at once
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

impl StillRequest {
    /// Draws the picture and hands it over.
    fn answer(self, size: Size, painter: &mut Painter) {
        let pixels = painter.draw(self.view, &self.frame, self.background.as_deref()).to_vec();
        let mut png = Vec::new();
        match encode_png(&Picture { size, pixels }, &mut png) {
            // whoever asked may be gone
            Ok(()) => drop(self.answer.send(png)),
            Err(e) => tracing::error!("preview: {e}"),
        }
    }
}

/// A number that is one larger while this lives.
struct Wish<'a>(&'a AtomicUsize);

impl<'a> Wish<'a> {
    fn new(count: &'a AtomicUsize) -> Self {
        count.fetch_add(1, Ordering::Relaxed);
        Self(count)
    }
}

impl Drop for Wish<'_> {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::Relaxed);
    }
}

/// Shrinks a picture: each pixel is the mean of `scale` by `scale`.
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
    pub(in crate::live) fn new(broadcast: &Arc<Broadcast>, name: &str, format: PictureFormat) -> Option<Self> {
        let index = broadcast.slots.iter().position(|s| s.format == format && s.view.name() == name)?;
        let slot = &broadcast.slots[index];
        slot.watchers.fetch_add(1, Ordering::AcqRel);
        let mut latest = slot.latest.subscribe();
        let version = broadcast.content.lock().version;
        // a picture from before the slot was watched may be out of date
        if latest.borrow().as_ref().is_some_and(|encoded| encoded.version == version) {
            latest.mark_changed();
        }
        broadcast.bell.notify_all();
        Some(Self { broadcast: Arc::clone(broadcast), slot: index, latest })
    }

    /// Waits for a picture that was not seen yet: always the newest, those between are skipped. None when the service ends.
    pub(in crate::live) async fn next(&mut self) -> Option<Encoded> {
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
        self.broadcast.slots[self.slot].watchers.fetch_sub(1, Ordering::AcqRel);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::live::frame::tests::frame;

    #[test]
    fn raw_and_guide_frames_are_drawn_when_they_were_copied_for_a_watcher() {
        let broadcast = Broadcast::new(&[View::Intensity, View::Raw, View::Guide], Size::new(2, 1), 90);
        let slot = |view| broadcast.slots.iter().find(|slot| slot.view == view).unwrap();
        let content = |sketched, fault: Option<&str>| Content {
            frame: Some(Arc::new(PublishedFrame { sketched, ..frame(1) })),
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
