//! What the threads of the service share.

use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use heapless::HistoryBuf;

use super::broadcast::Broadcast;
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

/// One processed frame, as the preview shows and the disk keeps it.
#[derive(Debug)]
pub(super) struct Shown {
    /// Number of the frame, from 0.
    pub(super) index: u64,
    pub(super) channels: usize,
    /// Fractions of full scale, `[C, H, W]`.
    pub(super) raw: Stack<f32>,
    /// Registered, in the raw frame's units.
    pub(super) guide: Stack<f32>,
    /// Whether `guide` is of this frame.
    pub(super) guided: bool,
    pub(super) stokes: Stack<f32>,
    pub(super) angles: Option<Stack<f32>>,
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
            angles: self.angles.as_ref(),
            angle_list: &self.angle_list,
            stokes: &self.stokes,
            valid: &self.valid,
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
    finished: HistoryBuf<Instant, HISTORY>,
    latency_ms: HistoryBuf<f32, HISTORY>,
}

impl Figures {
    fn add(&mut self, arrived: Instant, now: Instant) {
        self.frames += 1;
        self.first.get_or_insert(now);
        self.finished.write(now);
        self.latency_ms.write(now.duration_since(arrived).as_secs_f32() * 1e3);
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
        let mut sorted: heapless::Vec<f32, HISTORY> = self.latency_ms.oldest_ordered().copied().collect();
        sorted.sort_unstable_by(f32::total_cmp);
        sorted.get((share * sorted.len().checked_sub(1)? as f32).round() as usize).copied()
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
    /// Connections of the preview that are being served.
    pub(super) clients: AtomicUsize,
    figures: Mutex<Figures>,
}

impl Hub {
    pub(super) fn new(board: String, out: PathBuf, started: Instant, pairing: Pairing, broadcast: Broadcast) -> Self {
        Self {
            board,
            out,
            started,
            stop: Stop::default(),
            pairing,
            broadcast,
            clients: AtomicUsize::new(0),
            figures: Mutex::default(),
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
        figures.fault = None;
        drop(figures);
        self.broadcast.show(shown);
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
