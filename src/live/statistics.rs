//! Counters, speed and delays of the run.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use heapless::HistoryBuf;
use parking_lot::Mutex;

/// Number of recent frames that speed and delays are computed over.
const HISTORY: usize = 128;
/// Time that speed is computed over, or two frames where they are rarer.
const RECENT: Duration = Duration::from_secs(5);

/// Time after which a rate means something.
const SETTLING: Duration = Duration::from_secs(3);

/// State of saving results.
#[derive(Clone, Debug, Default)]
pub(super) struct SavingStatus {
    /// Results written.
    pub(super) written: u64,
    /// Results that could not be written.
    pub(super) failed: u64,
    /// Failure of the last attempt; none when it succeeded.
    pub(super) fault: Option<String>,
}

/// State of recording.
#[derive(Clone, Debug, Default)]
pub(super) struct RecordingStatus {
    /// Folder of the session, once it has a frame.
    pub(super) session: Option<PathBuf>,
    /// Frames recorded.
    pub(super) written: u64,
    /// Frames recorded since recording was begun last.
    pub(super) frames: u64,
    /// Frames that could not be recorded.
    pub(super) failed: u64,
    /// Frames that made room for newer ones because the disk was behind.
    pub(super) dropped: u64,
    /// Recorded frames that were removed to make room.
    pub(super) removed: u64,
    /// Failure of the last attempt; none when it succeeded.
    pub(super) fault: Option<String>,
}

/// Recent values of a time, in milliseconds.
#[derive(Clone, Debug, Default)]
struct Recent(HistoryBuf<f32, HISTORY>);

impl Recent {
    fn add(&mut self, time: Duration) {
        self.0.write(time.as_secs_f32() * 1e3);
    }

    /// Value that the fraction `share` of the recent ones does not exceed.
    fn quantile(&self, share: f32) -> Option<f32> {
        let mut sorted: heapless::Vec<f32, HISTORY> = self.0.oldest_ordered().copied().collect();
        sorted.sort_unstable_by(f32::total_cmp);
        sorted.get((share * sorted.len().checked_sub(1)? as f32).round() as usize).copied()
    }
}

/// Times at which something happened of late.
#[derive(Clone, Debug, Default)]
pub(super) struct Rate(HistoryBuf<Instant, HISTORY>);

impl Rate {
    pub(super) fn add(&mut self, now: Instant) {
        self.0.write(now);
    }

    /// Times per second of late; none before they have come for some seconds: the first ones come in a burst.
    pub(super) fn steady(&self) -> Option<f64> {
        let first = self.0.oldest_ordered().next()?;
        if first.elapsed() < SETTLING { None } else { self.per_second() }
    }

    /// Times per second of late; none before the second one.
    pub(super) fn per_second(&self) -> Option<f64> {
        let last = *self.0.recent()?;
        let rare = self.0.len().checked_sub(2)?;
        let recent = self.0.oldest_ordered().position(|at| last.duration_since(*at) <= RECENT)?;
        let start = recent.min(rare);
        let span = last.duration_since(*self.0.oldest_ordered().nth(start)?).as_secs_f64();
        let times = (self.0.len() - 1 - start) as f64;
        let stalled = last.elapsed().as_secs_f64() > 2.0 + 3.0 * span / times;
        Some(if span > 0.0 && !stalled { times / span } else { 0.0 })
    }
}

/// Step of a frame's way through the service.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Stage {
    /// Waiting for the partner and for the solver.
    Wait,
    Prepare,
    Register,
    Recon,
    /// The fusion model, in frames it runs for.
    Fusion,
    /// Copying the result out of the pipeline.
    Publish,
    /// Drawing and encoding one picture.
    Encode,
    /// From the frame's arrival to its first picture.
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

/// Recent times of all stages, shared between threads.
#[derive(Debug, Default)]
pub(super) struct Timings(Mutex<[Recent; Stage::ALL.len()]>);

impl Timings {
    pub(super) fn add(&self, stage: Stage, time: Duration) {
        self.0.lock()[stage as usize].add(time);
    }

    /// Median and 95th percentile of a stage, in milliseconds; none before its first frame.
    pub(super) fn of(&self, stage: Stage) -> Option<[f32; 2]> {
        let recent = &self.0.lock()[stage as usize];
        Some([recent.quantile(0.5)?, recent.quantile(0.95)?])
    }
}

/// Counters, speed and delays of the run.
#[derive(Clone, Debug, Default)]
pub(super) struct Statistics {
    /// Frames solved.
    pub(super) frames: u64,
    /// Frames without a result.
    pub(super) failed: u64,
    /// Reason why the last frame has no result; none when it has one.
    pub(super) fault: Option<String>,
    /// Time of the first result.
    pub(super) first: Option<Instant>,
    pub(super) saving: SavingStatus,
    pub(super) recording: RecordingStatus,
    finished: Rate,
    latency: Recent,
}

impl Statistics {
    /// Counts a result at `now` of a frame that arrived at `arrived`.
    pub(super) fn add(&mut self, arrived: Instant, now: Instant) {
        self.frames += 1;
        self.fault = None;
        self.first.get_or_insert(now);
        self.finished.add(now);
        self.latency.add(now.duration_since(arrived));
    }

    /// Time of the latest result.
    pub(super) fn last(&self) -> Option<Instant> {
        self.finished.0.recent().copied()
    }

    /// Recent frames per second; 0 when none came in the last seconds.
    pub(super) fn fps(&self) -> f64 {
        self.rate().unwrap_or(0.0)
    }

    /// Recent frames per second; none before the second frame.
    pub(super) fn rate(&self) -> Option<f64> {
        self.finished.per_second()
    }

    /// Time from a frame's arrival to its result that the fraction `share` of the recent frames does not exceed, in
    /// milliseconds.
    pub(super) fn latency_ms(&self, share: f32) -> Option<f32> {
        self.latency.quantile(share)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn speed_and_delay_are_those_of_the_recent_frames() {
        let mut statistics = Statistics::default();
        assert_eq!((statistics.fps(), statistics.latency_ms(0.5)), (0.0, None));
        let now = Instant::now();
        for n in 0..500u64 {
            let at = now + Duration::from_millis(100 * n);
            statistics.add(at, at + Duration::from_millis(n % 10));
        }
        assert!((statistics.fps() - 10.0).abs() < 0.01);
        assert!(statistics.latency_ms(0.5).is_some_and(|ms| (ms - 4.5).abs() < 1.0));
        assert!(statistics.latency_ms(1.0).is_some_and(|ms| (ms - 9.0).abs() < 0.1));
        assert_eq!(statistics.frames, 500);
    }

    #[test]
    fn speed_follows_a_change_within_seconds_and_needs_two_frames() {
        let mut statistics = Statistics::default();
        let now = Instant::now();
        statistics.add(now, now);
        assert_eq!(statistics.rate(), None);
        // slow at first, then quick
        for seconds in [7.0, 14.0] {
            let at = now + Duration::from_secs_f64(seconds);
            statistics.add(at, at);
            assert!((statistics.fps() - 1.0 / 7.0).abs() < 1e-6, "{}", statistics.fps());
        }
        for n in 1..=50 {
            let at = now + Duration::from_secs(14) + Duration::from_millis(100 * n);
            statistics.add(at, at);
        }
        assert!((statistics.fps() - 10.0).abs() < 0.01, "{}", statistics.fps());
    }
}
