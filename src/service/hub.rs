//! What the threads of the service share.

use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use heapless::HistoryBuf;
use serde_json::json;

use super::broadcast::Broadcast;
use super::control::Controls;
use super::events::Events;
use super::govern::Quality;
use super::host::Host;
use super::pair::Pairing;
use crate::camera::{CameraError, Role};
use crate::output::{Report, ResultImages};
use crate::plane::{Angle, Size, Stack};

/// Frames that the figures of speed and delay are taken over.
const HISTORY: usize = 128;

/// A flag that also ends pauses.
#[derive(Debug, Default)]
pub(super) struct Stop {
    set: AtomicBool,
    lock: Mutex<()>,
    bell: Condvar,
}

impl Stop {
    pub(super) fn is_set(&self) -> bool {
        self.set.load(Ordering::Acquire)
    }

    pub(super) fn set(&self) {
        self.set.store(true, Ordering::Release);
        drop(self.lock.lock());
        self.bell.notify_all();
    }

    /// Pauses, at most until the flag is set.
    pub(super) fn wait(&self, pause: Duration) {
        let guard = self.lock.lock().unwrap_or_else(PoisonError::into_inner);
        // a poisoned empty lock is as good as another
        drop(self.bell.wait_timeout_while(guard, pause, |()| !self.is_set()));
    }
}

/// An image to look at: the upper half of each value's bits, for eight of mantissa are what a picture shows. Nothing before it was
/// taken once.
#[derive(Debug)]
pub(super) struct Sketch(Stack<u16>);

impl Default for Sketch {
    fn default() -> Self {
        Self(Stack::zeros(0, Size::new(0, 0)))
    }
}

impl Sketch {
    /// Of an image. Allocates.
    pub(super) fn of(image: &Stack<f32>) -> Self {
        let mut sketch = Self::default();
        sketch.take(image);
        sketch
    }

    /// Takes an image. Allocates where the last one had another shape.
    pub(super) fn take(&mut self, image: &Stack<f32>) {
        if (self.0.count(), self.0.size()) != (image.count(), image.size()) {
            self.0 = Stack::zeros(image.count(), image.size());
        }
        let halves = image.as_slice().iter().map(|value| (value.to_bits() >> 16) as u16);
        self.0.as_mut_slice().iter_mut().zip(halves).for_each(|(to, half)| *to = half);
    }

    /// The values of plane `index`.
    pub(super) fn plane(&self, index: usize) -> impl Iterator<Item = f32> {
        self.0.plane(index).iter().map(|half| f32::from_bits(u32::from(*half) << 16))
    }
}

/// One processed frame, as the preview shows and the disk keeps it.
#[derive(Debug)]
pub(super) struct Shown {
    /// Number of the frame, from 0.
    pub(super) index: u64,
    /// When its raw frame came.
    pub(super) arrived: Instant,
    pub(super) channels: usize,
    /// Whether somebody watched `raw` or `guide` when it was made, so that they are of this frame.
    pub(super) sketched: bool,
    /// Fractions of full scale, `[C, H, W]`.
    pub(super) raw: Sketch,
    /// Registered, in the raw frame's units.
    pub(super) guide: Sketch,
    /// Whether there was a guide frame.
    pub(super) guided: bool,
    pub(super) stokes: Stack<f32>,
    /// `angles` of stage I alone, where a fusion model had its say.
    pub(super) stage1: Option<Stack<f32>>,
    pub(super) angle_list: Vec<Angle>,
    pub(super) valid: Vec<bool>,
    pub(super) report: Report,
}

impl Shown {
    pub(super) fn size(&self) -> Size {
        self.stokes.size()
    }

    /// Whether there is more than S0.
    pub(super) fn polarized(&self) -> bool {
        self.stokes.count() == 3 * self.channels
    }

    /// As it is written to files.
    pub(super) fn images(&self) -> ResultImages<'_> {
        ResultImages {
            size: self.size(),
            channels: self.channels,
            angles: None,
            angle_list: &self.angle_list,
            stokes: &self.stokes,
            valid: &self.valid,
            stage1: self.stage1.as_ref(),
        }
    }

    /// Component 0, 1 or 2 of the Stokes vector of pixel `i`, summed over the channels; 0 where it is not known.
    pub(super) fn stokes_at(&self, component: usize, i: usize) -> f32 {
        let per_channel = self.stokes.count() / self.channels;
        if component >= per_channel {
            return 0.0;
        }
        (0..self.channels).map(|c| self.stokes.plane(c * per_channel + component)[i]).sum()
    }
}

/// Saving as a user sees it.
#[derive(Clone, Debug, Default)]
pub(super) struct Saving {
    /// Results written.
    pub(super) written: u64,
    /// Results that could not be.
    pub(super) failed: u64,
    /// Why the last attempt failed; none when it did not.
    pub(super) fault: Option<String>,
}

/// Recording as a user sees it.
#[derive(Clone, Debug, Default)]
pub(super) struct Recording {
    /// Folder of the session, once it has a frame.
    pub(super) session: Option<PathBuf>,
    /// Frames recorded.
    pub(super) written: u64,
    /// Frames that could not be.
    pub(super) failed: u64,
    /// Frames that made room for newer ones because the disk was behind.
    pub(super) dropped: u64,
    /// Recorded frames that were removed to make room.
    pub(super) removed: u64,
    /// Why the last attempt failed; none when it did not.
    pub(super) fault: Option<String>,
}

/// The latest values of a time, in milliseconds.
#[derive(Debug, Default)]
pub(super) struct Recent(HistoryBuf<f32, HISTORY>);

impl Recent {
    fn add(&mut self, time: Duration) {
        self.0.write(time.as_secs_f32() * 1e3);
    }

    /// What `share` of the values do not exceed.
    pub(super) fn quantile(&self, share: f32) -> Option<f32> {
        let mut sorted: heapless::Vec<f32, HISTORY> = self.0.oldest_ordered().copied().collect();
        sorted.sort_unstable_by(f32::total_cmp);
        sorted.get((share * sorted.len().checked_sub(1)? as f32).round() as usize).copied()
    }
}

/// What a frame goes through.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Stage {
    /// Waiting for its partner and for the solver.
    Wait,
    Prepare,
    Register,
    Recon,
    /// The fusion model, in frames it runs for.
    Fusion,
    /// Copying the result to where others look at it.
    Publish,
    /// Drawing and encoding one picture.
    Encode,
    /// From the frame's arrival to the first picture of it.
    Preview,
}

impl Stage {
    pub(super) const ALL: [Self; 8] = [
        Self::Wait,
        Self::Prepare,
        Self::Register,
        Self::Recon,
        Self::Fusion,
        Self::Publish,
        Self::Encode,
        Self::Preview,
    ];

    pub(super) fn name(self) -> &'static str {
        ["wait", "prepare", "register", "recon", "fusion", "publish", "encode", "preview"][self as usize]
    }
}

/// How long the stages took of late.
#[derive(Debug, Default)]
pub(super) struct Timings(Mutex<[Recent; Stage::ALL.len()]>);

impl Timings {
    pub(super) fn add(&self, stage: Stage, time: Duration) {
        // numbers are right whoever panicked
        self.0.lock().unwrap_or_else(PoisonError::into_inner)[stage as usize].add(time);
    }

    /// Median and 95 % of a stage, in milliseconds; none before its first frame.
    pub(super) fn of(&self, stage: Stage) -> Option<[f32; 2]> {
        let recent = &self.0.lock().unwrap_or_else(PoisonError::into_inner)[stage as usize];
        Some([recent.quantile(0.5)?, recent.quantile(0.95)?])
    }
}

/// Figures of the run.
#[derive(Debug, Default)]
pub(super) struct Figures {
    /// Frames processed.
    pub(super) frames: u64,
    /// Frames that no image could be made of.
    pub(super) failed: u64,
    /// Why the last frame failed; none when it did not.
    pub(super) fault: Option<String>,
    pub(super) first: Option<Instant>,
    pub(super) saving: Saving,
    pub(super) recording: Recording,
    finished: HistoryBuf<Instant, HISTORY>,
    latency: Recent,
}

impl Figures {
    fn add(&mut self, arrived: Instant, now: Instant) {
        self.frames += 1;
        self.first.get_or_insert(now);
        self.finished.write(now);
        self.latency.add(now.duration_since(arrived));
    }

    /// When the latest result came.
    pub(super) fn last(&self) -> Option<Instant> {
        self.finished.recent().copied()
    }

    /// Frames per second of late; 0 when none came in the last seconds.
    pub(super) fn fps(&self) -> f64 {
        let (Some(last), Some(first)) = (self.finished.recent(), self.finished.oldest_ordered().next()) else {
            return 0.0;
        };
        let span = last.duration_since(*first).as_secs_f64();
        let stalled = last.elapsed().as_secs_f64() > 2.0 + 3.0 * span / self.finished.len() as f64;
        if span > 0.0 && !stalled { (self.finished.len() - 1) as f64 / span } else { 0.0 }
    }

    /// Time from a frame's arrival to its result that `share` of the recent frames did not exceed, in milliseconds.
    pub(super) fn latency_ms(&self, share: f32) -> Option<f32> {
        self.latency.quantile(share)
    }
}

/// What the threads share.
#[derive(Debug)]
pub(super) struct Hub {
    pub(super) board: String,
    pub(super) out: PathBuf,
    pub(super) started: Instant,
    pub(super) stop: Stop,
    pub(super) pairing: Pairing,
    pub(super) broadcast: Broadcast,
    pub(super) timings: Timings,
    pub(super) events: Events,
    pub(super) controls: Controls,
    /// Whether frames are recorded.
    pub(super) records: bool,
    quality: Mutex<Quality>,
    host: Mutex<Host>,
    /// Connections of the preview that are being served.
    pub(super) clients: AtomicUsize,
    figures: Mutex<Figures>,
}

/// What a hub begins with.
#[derive(Debug)]
pub(super) struct Parts {
    pub(super) board: String,
    pub(super) out: PathBuf,
    pub(super) started: Instant,
    pub(super) pairing: Pairing,
    pub(super) broadcast: Broadcast,
    pub(super) events: Events,
    pub(super) controls: Controls,
    pub(super) quality: Quality,
    pub(super) records: bool,
}

impl Hub {
    pub(super) fn new(parts: Parts) -> Self {
        let Parts { board, out, started, pairing, broadcast, events, controls, quality, records } = parts;
        Self {
            board,
            out,
            started,
            stop: Stop::default(),
            pairing,
            broadcast,
            timings: Timings::default(),
            events,
            controls,
            records,
            quality: Mutex::new(quality),
            host: Mutex::default(),
            clients: AtomicUsize::new(0),
            figures: Mutex::default(),
        }
    }

    /// What frames are solved and drawn with.
    pub(super) fn quality(&self) -> Quality {
        // it is replaced as a whole
        self.quality.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Says what frames are solved and drawn with, and tells when less is done than was asked for, or all of it again.
    pub(super) fn set_quality(&self, quality: &Quality) {
        let mut now = self.quality.lock().unwrap_or_else(PoisonError::into_inner);
        if *now == *quality {
            return;
        }
        let turned = now.reduced.is_some() != quality.reduced.is_some();
        now.clone_from(quality);
        drop(now);
        self.broadcast.set_scale(quality.preview_scale);
        if turned {
            match &quality.reduced {
                Some(why) => tracing::info!("quality: {why}"),
                None => tracing::info!("quality: as asked for"),
            }
            self.events.emit("quality", json!({ "reduced": quality.reduced, "held": quality.held }));
        }
    }

    /// How the machine fares.
    pub(super) fn host(&self) -> Host {
        // it is replaced as a whole
        self.host.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Notes how the machine fares, and tells when it comes under pressure or out of it.
    pub(super) fn set_host(&self, host: &Host) {
        let mut now = self.host.lock().unwrap_or_else(PoisonError::into_inner);
        let before = std::mem::replace(&mut *now, host.clone());
        drop(now);
        if before.pressed() != host.pressed() {
            match host.pressed() {
                Some(why) => tracing::warn!("the machine is slowed down: {why}"),
                None => tracing::info!("the machine is at full speed again"),
            }
            self.events.emit("machine", json!({ "pressed": host.pressed(), "temperature_c": host.temperature_c }));
        }
    }

    /// Ends all threads.
    pub(super) fn close(&self) {
        self.stop.set();
        self.pairing.close();
        self.broadcast.close();
    }

    pub(super) fn figures(&self) -> MutexGuard<'_, Figures> {
        // counters are right whoever panicked
        self.figures.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Shows a result whose raw frame arrived at `arrived`.
    pub(super) fn publish(&self, shown: Arc<Shown>, arrived: Instant) {
        let mut figures = self.figures();
        figures.add(arrived, Instant::now());
        let first = figures.frames == 1;
        figures.fault = None;
        drop(figures);
        self.broadcast.show(shown);
        if first {
            self.events.emit("first-frame", json!({}));
        }
    }

    /// A frame gave no result; says so once for every new reason.
    pub(super) fn failed(&self, why: String) {
        let mut figures = self.figures();
        figures.failed += 1;
        if figures.fault.as_ref() != Some(&why) {
            tracing::warn!("frame without a result: {why}");
            figures.fault = Some(why);
        }
    }

    /// A camera gives frames; says so when it did not before.
    pub(super) fn online(&self, role: Role) {
        self.pairing.update(role, |lens| {
            if lens.fault.take().is_some() {
                tracing::info!("{role} camera: frames again");
                self.events.emit("camera-online", json!({ "camera": role.to_string() }));
                self.broadcast.online(role);
            }
        });
    }

    /// A camera gives no frames; says so when it did before.
    pub(super) fn offline(&self, role: Role, error: &CameraError) {
        self.pairing.update(role, |lens| {
            let reason = error.to_string();
            if lens.fault.is_none() {
                tracing::error!("{role} camera offline: {reason}");
                self.events.emit("camera-offline", json!({ "camera": role.to_string(), "reason": reason }));
            }
            self.broadcast.offline(role, &reason);
            lens.fault = Some(reason);
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn speed_and_delay_are_those_of_the_recent_frames() {
        let mut figures = Figures::default();
        assert_eq!((figures.fps(), figures.latency_ms(0.5)), (0.0, None));
        let now = Instant::now();
        for n in 0..500u64 {
            let at = now + Duration::from_millis(100 * n);
            figures.add(at, at + Duration::from_millis(n % 10));
        }
        assert!((figures.fps() - 10.0).abs() < 0.01);
        assert!(figures.latency_ms(0.5).is_some_and(|ms| (ms - 4.5).abs() < 1.0));
        assert!(figures.latency_ms(1.0).is_some_and(|ms| (ms - 9.0).abs() < 0.1));
        assert_eq!(figures.frames, 500);
    }

    #[test]
    fn a_pause_ends_with_the_stop() {
        let stop = Arc::new(Stop::default());
        let other = Arc::clone(&stop);
        let begin = Instant::now();
        let waiting = std::thread::spawn(move || other.wait(Duration::from_secs(60)));
        stop.set();
        waiting.join().unwrap();
        assert!(begin.elapsed() < Duration::from_secs(30));
        stop.wait(Duration::from_secs(60));
    }
}
