//! Pairing: frames of the two cameras wait here for each other and for the solver, in queues that never grow.
//!
//! The frames of one camera may arrive much later than those of the other: a USB camera encodes and transfers them first. While a frame
//! waits for a partner that is still to come, newer frames of its camera do not replace it; they are left out, evenly, so that as many
//! pairs are made as the queue holds frames within the delay. The delay is learned from time stamps and times of arrival.

use std::time::{Duration, Instant};

use heapless::{Deque, Vec};
use parking_lot::{Condvar, Mutex};

use super::limits::{FRAMES_IN_WORK, RECORDER_FRAMES};
use crate::board::MAX_QUEUE_FRAMES;
use crate::camera::{CameraError, Role};
use stokescope_core::image::{OffScale, Size, Stack};
use stokescope_core::readings::Binned;

/// Time that a frame waits for one of its instant from the other camera, beyond the usual delay of that camera, before it is given up.
const PATIENCE: Duration = Duration::from_secs(1);
/// Longest time that a frame waits for one of its instant.
const LONGEST_WAIT: Duration = Duration::from_secs(10);
/// Share of a new value in the moving mean of a delay.
const NEW_DELAY: f64 = 0.125;
/// A delay that differs by more seconds than this is that of a camera that was opened again.
const OTHER_DELAY: f64 = 0.5;
/// Most pairs that can be asked for ahead.
const MAX_SHOTS: u32 = 1000;
/// Pause between two looks at the queues.
const PACE: Duration = Duration::from_millis(250);

/// One frame, copied out of its camera's memory.
#[derive(Debug)]
pub(super) struct Captured {
    /// Counts, or fractions of full scale.
    pub(super) planes: Stack<f32>,
    /// Share of the readings in each value; empty where frames are not binned.
    pub(super) weights: Stack<f32>,
    /// Findings of binning about the scale of the readings.
    pub(super) off_scale: Option<OffScale>,
    /// On the sensor's clock.
    pub(super) timestamp: Duration,
    /// Arrival on this machine's clock.
    pub(super) arrived: Instant,
}

/// A raw frame and the guide frame of its instant.
#[derive(Debug)]
pub(super) struct Pair {
    pub(super) raw: Captured,
    /// None without a guide camera, or while it is offline.
    pub(super) guide: Option<Captured>,
}

/// State and counters of one camera.
#[derive(Clone, Debug, Default)]
pub(super) struct CameraStatus {
    /// Name of the camera.
    pub(super) name: String,
    /// Reason why the camera gives no frames; none while it does.
    pub(super) fault: Option<String>,
    /// Frames that arrived whole.
    pub(super) received: u64,
    /// Frames that made room for newer ones, or for older ones whose partner is still to come.
    pub(super) dropped: u64,
    /// Frames without a partner of the same instant.
    pub(super) unpaired: u64,
    /// Broken frames, and waits that ended without a frame.
    pub(super) faults: u64,
    /// Times the camera was opened again.
    pub(super) reopened: u64,
    /// Time by which its frames arrive later than those of the other camera.
    pub(super) behind: Duration,
    /// Event that the camera waits for, such as a trigger; none while frames come.
    pub(super) waiting: Option<&'static str>,
}

/// Queue of one camera.
#[derive(Debug, Default)]
struct Lane {
    status: CameraStatus,
    /// Whether its recording has ended.
    ended: bool,
    /// Whether the camera is to be closed and opened again.
    restart: bool,
    waiting: Deque<Captured, MAX_QUEUE_FRAMES>,
    /// Time stamp of the frame that arrived last.
    latest: Option<Duration>,
    /// Seconds from time stamps to arrivals, a moving mean; its origin is that of both cameras.
    delay: Option<f64>,
    /// Buffers for the frames to come.
    free: Vec<Binned, { MAX_QUEUE_FRAMES + FRAMES_IN_WORK + RECORDER_FRAMES }>,
}

#[derive(Debug)]
struct Lanes {
    raw: Lane,
    guide: Option<Lane>,
    closed: bool,
    every: bool,
    /// Error that ended a recording before its last frame.
    failure: Option<CameraError>,
    /// Pairs that are asked for; none where every pair is taken.
    shots: Option<u32>,
    /// Origin of the times of arrival.
    begin: Instant,
    /// Whether frames have been left out because of the delay between the cameras.
    thinned: bool,
}

/// The frame of the other camera that shows the same instant.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Partner {
    Here,
    Coming,
    /// A newer one has arrived.
    Gone,
}

/// Meeting point of the capture threads and the solver.
#[derive(Debug)]
pub(super) struct Pairing {
    lanes: Mutex<Lanes>,
    bell: Condvar,
    capacity: usize,
    max_skew: Duration,
}

impl Lane {
    fn recycle(&mut self, frame: Captured) {
        // more buffers than places never exist
        let _ = self.free.push(Binned { values: frame.planes, weights: frame.weights, off_scale: None });
    }

    /// Whereabouts of this camera's frame of the instant `timestamp`; `None` as long as it has sent nothing.
    fn partner(&self, timestamp: Duration, max_skew: Duration) -> Option<Partner> {
        let latest = self.latest?;
        let here = self.waiting.iter().any(|frame| frame.timestamp.abs_diff(timestamp) <= max_skew);
        Some(match here {
            true => Partner::Here,
            // frames may follow each other more closely than the skew that is allowed
            false if latest < timestamp + max_skew => Partner::Coming,
            false => Partner::Gone,
        })
    }

    /// Learns the delay of the camera from a frame; returns the time since the one before.
    fn learn(&mut self, frame: &Captured, begin: Instant) -> Duration {
        let delay = frame.arrived.saturating_duration_since(begin).as_secs_f64() - frame.timestamp.as_secs_f64();
        let known = self.delay.filter(|known| (known - delay).abs() < OTHER_DELAY);
        self.delay = Some(known.map_or(delay, |known| known + NEW_DELAY * (delay - known)));
        self.status.received += 1;
        let before = self.latest.replace(frame.timestamp);
        frame.timestamp.saturating_sub(before.unwrap_or(frame.timestamp))
    }

    /// Whether the oldest frame stays although the queue is full: its partner is to come, or it makes the only pair that is ready.
    fn holds(&self, other: &Self, now: Instant, wait: Duration, max_skew: Duration, thinned: bool) -> bool {
        let partner = |index: usize| self.waiting.iter().nth(index).map(|f| (f, other.partner(f.timestamp, max_skew)));
        match partner(0) {
            Some((oldest, Some(Partner::Coming))) => now.saturating_duration_since(oldest.arrived) < wait,
            Some((_, Some(Partner::Here))) => {
                partner(1).map_or(thinned, |(_, partner)| partner == Some(Partner::Coming))
            }
            _ => false,
        }
    }

    /// Takes frame `index` and gives back the older ones.
    fn take(&mut self, index: usize) -> Option<Captured> {
        for _ in 0..index {
            let older = self.waiting.pop_front()?;
            self.status.dropped += 1;
            self.recycle(older);
        }
        self.waiting.pop_front()
    }
}

impl Lanes {
    fn lane(&mut self, role: Role) -> &mut Lane {
        match (role, &mut self.guide) {
            (Role::Guide, Some(guide)) => guide,
            _ => &mut self.raw,
        }
    }

    /// Seconds by which the guide camera's frames arrive later than the raw camera's; negative when they arrive earlier.
    fn lag(&self) -> f64 {
        self.guide.as_ref().and_then(|guide| Some(guide.delay? - self.raw.delay?)).unwrap_or(0.0)
    }

    /// Longest wait of a frame for its partner.
    fn wait(&self) -> Duration {
        (PATIENCE + Duration::from_secs_f64(self.lag().abs())).min(LONGEST_WAIT)
    }

    /// Queues a frame, in place of the oldest where `capacity` frames wait, or leaves it out: its partner is gone, or older frames
    /// wait for theirs. Returns whether a frame was left out because of the delay between the cameras, for the first time.
    fn admit(&mut self, role: Role, frame: Captured, capacity: usize, max_skew: Duration) -> bool {
        let begin = self.begin;
        let interval = self.lane(role).learn(&frame, begin);
        let (lag, wait) = (self.lag(), self.wait());
        self.raw.status.behind = Duration::from_secs_f64((-lag).max(0.0));
        let (lane, other) = match (role, &mut self.guide) {
            (Role::Guide, Some(guide)) => (guide, Some(&self.raw)),
            (_, guide) => (&mut self.raw, guide.as_ref()),
        };
        if role == Role::Guide {
            lane.status.behind = Duration::from_secs_f64(lag.max(0.0));
        }
        let ahead = if role == Role::Raw { lag } else { -lag };
        // frames so far apart fill the queue until the partner of the first arrives
        let spacing = Duration::from_secs_f64(ahead.max(0.0) / capacity as f64);
        let full = lane.waiting.len() >= capacity;
        // where every frame counts, `push` has waited for a place, and `select` knows which frames have no partner
        if let Some(other) = other.filter(|other| other.status.fault.is_none() && !self.every) {
            let partner = other.partner(frame.timestamp, max_skew);
            if partner == Some(Partner::Gone) {
                lane.status.unpaired += 1;
                lane.recycle(frame);
                return false;
            }
            let early = lane.waiting.back().is_some_and(|last| frame.timestamp < last.timestamp + spacing);
            let thinned = spacing > interval;
            if (early && partner == Some(Partner::Coming))
                || (full && lane.holds(other, frame.arrived, wait, max_skew, thinned))
            {
                lane.status.dropped += 1;
                lane.recycle(frame);
                return thinned && !std::mem::replace(&mut self.thinned, true);
            }
        }
        if full && let Some(oldest) = lane.waiting.pop_front() {
            lane.status.dropped += 1;
            lane.recycle(oldest);
        }
        let fits = lane.waiting.push_back(frame).is_ok();
        debug_assert!(fits, "the capacity is within the queue's");
        false
    }

    /// Counts a pair that was asked for. After the last one frames that wait are given up: the next shot begins anew.
    fn shot(&mut self) {
        let Some(shots) = &mut self.shots else { return };
        *shots = shots.saturating_sub(1);
        if *shots == 0 {
            for lane in std::iter::once(&mut self.raw).chain(&mut self.guide) {
                while let Some(frame) = lane.waiting.pop_front() {
                    lane.recycle(frame);
                }
            }
        }
    }

    /// Whether no pair will come any more: the recording of the raw camera has ended and all of its frames were taken or given up.
    fn is_over(&self) -> bool {
        self.raw.ended && self.raw.waiting.is_empty()
    }

    /// Takes the newest pair, or the oldest one where every frame counts. Gives up frames that can have no partner any more.
    fn select(&mut self, now: Instant, max_skew: Duration) -> Option<Pair> {
        let wait = self.wait();
        let newest = self.raw.waiting.len().checked_sub(1)?;
        let Some(lane) = self.guide.as_mut().filter(|lane| lane.status.fault.is_none()) else {
            return Some(Pair { raw: self.raw.take(if self.every { 0 } else { newest })?, guide: None });
        };
        let partner = |raw: &Captured| {
            let skew = |guide: &Captured| guide.timestamp.abs_diff(raw.timestamp);
            let nearest = lane.waiting.iter().enumerate().min_by_key(|(_, guide)| skew(guide));
            nearest.filter(|(_, guide)| skew(guide) <= max_skew).map(|(index, _)| index)
        };
        let mut pairs = self.raw.waiting.iter().enumerate().filter_map(|(r, raw)| partner(raw).map(|g| (r, g)));
        let found = if self.every { pairs.next() } else { pairs.next_back() };
        if let Some((r, g)) = found {
            return Some(Pair { guide: lane.take(g), raw: self.raw.take(r)? });
        }
        let last_guide = lane.waiting.back().map(|guide| guide.timestamp);
        while let Some(raw) = self.raw.waiting.front() {
            let missed = lane.ended || last_guide.is_some_and(|guide| guide > raw.timestamp + max_skew);
            if !missed && (self.every || now.saturating_duration_since(raw.arrived) < wait) {
                break;
            }
            self.raw.status.unpaired += 1;
            if let Some(raw) = self.raw.waiting.pop_front() {
                self.raw.recycle(raw);
            }
        }
        // a guide frame whose raw frame is damaged would keep its place for ever where cameras wait for one
        let oldest = self.raw.waiting.front().map(|raw| raw.timestamp).filter(|_| self.every);
        while let Some(guide) = lane.waiting.front()
            && oldest.is_some_and(|raw| raw > guide.timestamp + max_skew)
        {
            lane.status.unpaired += 1;
            if let Some(guide) = lane.waiting.pop_front() {
                lane.recycle(guide);
            }
        }
        None
    }
}

impl Pairing {
    /// Queues for the raw camera and, if there is one, the guide camera, by their names, of `capacity` frames each. Where
    /// `every` frame counts cameras wait for a place, else the newest frames win.
    pub(super) fn new(raw: String, guide: Option<String>, capacity: usize, max_skew: Duration, every: bool) -> Self {
        let lane = |name| Lane { status: CameraStatus { name, ..CameraStatus::default() }, ..Lane::default() };
        Self {
            lanes: Mutex::new(Lanes {
                raw: lane(raw),
                guide: guide.map(lane),
                closed: false,
                every,
                failure: None,
                shots: None,
                begin: Instant::now(),
                thinned: false,
            }),
            bell: Condvar::new(),
            capacity: capacity.clamp(1, MAX_QUEUE_FRAMES),
            max_skew,
        }
    }

    /// Takes pairs only when they are asked for.
    pub(super) fn single_shots(self) -> Self {
        self.lanes.lock().shots = Some(0);
        self
    }

    /// Asks for a pair of frames that arrive from now on; false where every pair is taken.
    pub(super) fn shoot(&self) -> bool {
        let mut lanes = self.lanes.lock();
        if let Some(shots) = &mut lanes.shots {
            *shots = shots.saturating_add(1).min(MAX_SHOTS);
        }
        lanes.shots.is_some()
    }

    /// Asks for the cameras to be closed and opened again; false where every frame of a recording counts.
    pub(super) fn restart(&self) -> bool {
        let mut lanes = self.lanes.lock();
        if lanes.every {
            return false;
        }
        lanes.raw.restart = true;
        lanes.guide.iter_mut().for_each(|lane| lane.restart = true);
        true
    }

    /// Whether the camera of `role` is to be closed and opened again; the request is then met.
    pub(super) fn take_restart(&self, role: Role) -> bool {
        std::mem::take(&mut self.lanes.lock().lane(role).restart)
    }

    /// Whether no pair is due: none is asked for, or a camera waits for its trigger.
    pub(super) fn is_idle(&self) -> bool {
        let lanes = self.lanes.lock();
        lanes.shots == Some(0) || lanes.raw.status.waiting.is_some()
    }

    /// Gives a buffer for the next frame of `role`: a used one, or a new one until as many exist as can be held at once.
    pub(super) fn buffer(&self, role: Role, planes: usize, size: Size) -> Binned {
        let used = self.lanes.lock().lane(role).free.pop();
        used.filter(|b| (b.values.count(), b.values.size()) == (planes, size)).unwrap_or_else(|| Binned {
            values: Stack::zeros(planes, size),
            weights: Stack::default(),
            off_scale: None,
        })
    }

    /// Queues a frame. When the queue is full the oldest one goes, unless its partner is still to come, or where every frame counts this
    /// waits for a place.
    pub(super) fn push(&self, role: Role, frame: Captured) {
        let mut lanes = self.lanes.lock();
        while lanes.every && lanes.lane(role).waiting.len() >= self.capacity && !lanes.closed {
            self.bell.wait_for(&mut lanes, PACE);
        }
        if lanes.every && lanes.closed {
            return lanes.lane(role).recycle(frame);
        }
        if lanes.shots == Some(0) {
            let begin = lanes.begin;
            let lane = lanes.lane(role);
            lane.learn(&frame, begin);
            return lane.recycle(frame);
        }
        let thinned = lanes.admit(role, frame, self.capacity, self.max_skew);
        let lag = lanes.lag();
        drop(lanes);
        self.bell.notify_all();
        if thinned {
            self.report(lag);
        }
    }

    /// Says that frames are left out because those of the guide camera arrive `lag` seconds later, or earlier.
    fn report(&self, lag: f64) {
        let (late, early) = if lag > 0.0 { ("guide", "raw") } else { ("raw", "guide") };
        let (seconds, queue) = (lag.abs(), self.capacity);
        if seconds < LONGEST_WAIT.as_secs_f64() {
            tracing::warn!(
                "frames of the {late} camera arrive {seconds:.2} s later than those of the {early} camera, which wait for them: about \
                 {queue} pairs in that time; more with a larger queue_frames, now {queue}, allowed: 1 to {MAX_QUEUE_FRAMES}"
            );
        } else {
            let longest = LONGEST_WAIT.as_secs();
            tracing::warn!(
                "frames of the {late} camera arrive {seconds:.1} s later than those of the {early} camera, which wait {longest} s at most: \
                 no pairs are made; check the time stamps and the load of the machine"
            );
        }
    }

    /// Waits for the next pair. None once closed, or once the recordings have ended.
    ///
    /// # Errors
    /// The error that ended a recording before its last frame.
    pub(super) fn next(&self) -> Result<Option<Pair>, CameraError> {
        let mut lanes = self.lanes.lock();
        while !lanes.closed {
            let pair = lanes.select(Instant::now(), self.max_skew);
            if pair.is_some() {
                lanes.shot();
            }
            if pair.is_some() || lanes.every {
                // there may be room now
                self.bell.notify_all();
            }
            if pair.is_some() || lanes.is_over() {
                return Ok(pair);
            }
            self.bell.wait_for(&mut lanes, PACE);
        }
        lanes.failure.take().map_or(Ok(None), Err)
    }

    /// Notes that the recording of `role` has ended: with its last frame, or with an error, which ends all.
    pub(super) fn end(&self, role: Role, failure: Option<CameraError>) {
        let mut lanes = self.lanes.lock();
        lanes.lane(role).ended = true;
        if failure.is_some() {
            (lanes.closed, lanes.failure) = (true, failure);
        }
        drop(lanes);
        self.bell.notify_all();
    }

    /// Gives the buffers of a pair back.
    pub(super) fn recycle(&self, pair: Pair) {
        let mut lanes = self.lanes.lock();
        lanes.raw.recycle(pair.raw);
        if let (Some(lane), Some(guide)) = (&mut lanes.guide, pair.guide) {
            lane.recycle(guide);
        }
    }

    /// Ends every wait.
    pub(super) fn close(&self) {
        self.lanes.lock().closed = true;
        self.bell.notify_all();
    }

    /// Changes the status of a camera.
    pub(super) fn update(&self, role: Role, change: impl FnOnce(&mut CameraStatus)) {
        change(&mut self.lanes.lock().lane(role).status);
        self.bell.notify_all();
    }

    /// Whether there is a guide camera.
    pub(super) fn has_guide(&self) -> bool {
        self.lanes.lock().guide.is_some()
    }

    /// Status of the raw camera and, if there is one, of the guide camera.
    pub(super) fn cameras(&self) -> (CameraStatus, Option<CameraStatus>) {
        let lanes = self.lanes.lock();
        (lanes.raw.status.clone(), lanes.guide.as_ref().map(|lane| lane.status.clone()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: Size = Size::new(2, 1);

    fn pairing(capacity: usize) -> Pairing {
        Pairing::new("raw".into(), Some("guide".into()), capacity, Duration::from_millis(5), false)
    }

    fn push(pairing: &Pairing, role: Role, millis: u64) {
        let Binned { values: planes, weights, off_scale } = pairing.buffer(role, 1, SIZE);
        let timestamp = Duration::from_millis(millis);
        pairing.push(role, Captured { planes, weights, off_scale, timestamp, arrived: Instant::now() });
    }

    fn select(pairing: &Pairing) -> Option<(u128, Option<u128>)> {
        let pair = pairing.lanes.lock().select(Instant::now(), pairing.max_skew)?;
        let times = (pair.raw.timestamp.as_millis(), pair.guide.as_ref().map(|g| g.timestamp.as_millis()));
        pairing.recycle(pair);
        Some(times)
    }

    #[test]
    fn each_camera_restarts_once_when_asked_for_and_never_where_every_frame_counts() {
        let cameras = pairing(2);
        assert!(!cameras.take_restart(Role::Raw));
        assert!(cameras.restart());
        for role in [Role::Raw, Role::Guide] {
            assert_eq!([cameras.take_restart(role), cameras.take_restart(role)], [true, false], "{role}");
        }
        let recording = Pairing::new("raw".into(), None, 2, Duration::ZERO, true);
        assert!(!recording.restart() && !recording.take_restart(Role::Raw));
    }

    #[test]
    fn the_newest_pair_within_the_skew_wins_and_older_frames_are_counted() {
        let p = pairing(8);
        for t in [0, 100, 200] {
            push(&p, Role::Raw, t);
            push(&p, Role::Guide, t + 4);
        }
        push(&p, Role::Raw, 300);
        assert_eq!(select(&p), Some((200, Some(204))));
        assert_eq!(select(&p), None, "300 has no guide yet");
        push(&p, Role::Guide, 300);
        assert_eq!(select(&p), Some((300, Some(300))));
        let (raw, guide) = p.cameras();
        assert_eq!((raw.dropped, raw.received, guide.unwrap().dropped), (2, 4, 2));
    }

    #[test]
    fn a_guide_frame_is_never_used_twice_nor_for_another_instant() {
        let p = pairing(8);
        push(&p, Role::Raw, 0);
        push(&p, Role::Guide, 0);
        assert_eq!(select(&p), Some((0, Some(0))));
        push(&p, Role::Raw, 1);
        assert_eq!(select(&p), None);
        push(&p, Role::Guide, 7);
        assert_eq!(select(&p), None, "six milliseconds apart");
        assert_eq!(p.cameras().0.unpaired, 1);
    }

    #[test]
    fn without_its_guide_camera_a_raw_frame_goes_on_alone() {
        let p = pairing(8);
        push(&p, Role::Guide, 0);
        push(&p, Role::Raw, 0);
        p.update(Role::Guide, |status| status.fault = Some("unplugged".into()));
        assert_eq!(select(&p), Some((0, None)));
        p.update(Role::Guide, |status| status.fault = None);
        push(&p, Role::Raw, 100);
        push(&p, Role::Guide, 100);
        assert_eq!(select(&p), Some((100, Some(100))));
    }

    #[test]
    fn a_full_queue_drops_the_oldest_and_reuses_its_buffer() {
        let p = pairing(2);
        for t in 0..100 {
            push(&p, Role::Raw, t);
        }
        let (raw, _) = p.cameras();
        assert_eq!((raw.received, raw.dropped), (100, 98));
        let lanes = p.lanes.lock();
        assert!(lanes.raw.waiting.len() + lanes.raw.free.len() <= 4);
        assert_eq!(lanes.raw.waiting.front().unwrap().timestamp.as_millis(), 98);
    }

    #[test]
    fn where_every_frame_counts_cameras_wait_and_the_oldest_pair_is_first() {
        let p = std::sync::Arc::new(Pairing::new("raw".into(), None, 2, Duration::from_millis(5), true));
        let other = std::sync::Arc::clone(&p);
        let camera = std::thread::spawn(move || (0..50).for_each(|t| push(&other, Role::Raw, t)));
        let mut times = std::vec::Vec::new();
        while times.len() < 50 {
            let pair = p.next().unwrap().unwrap();
            times.push(pair.raw.timestamp.as_millis() as u64);
            p.recycle(pair);
        }
        camera.join().unwrap();
        assert_eq!((times, p.cameras().0.dropped), ((0..50).collect(), 0));
    }

    #[test]
    fn where_every_frame_counts_one_without_its_partner_holds_up_nothing_and_the_end_ends() {
        // raw frames 2 and 5 and guide frames 3 and 9 are damaged
        let numbers = |bad: [u64; 2]| (0..10).filter(move |n| !bad.contains(n));
        for capacity in [1, 3] {
            let p =
                std::sync::Arc::new(Pairing::new("raw".into(), Some("guide".into()), capacity, Duration::ZERO, true));
            let cameras = [(Role::Raw, [2, 5]), (Role::Guide, [3, 9])].map(|(role, bad)| {
                let p = std::sync::Arc::clone(&p);
                std::thread::spawn(move || {
                    numbers(bad).for_each(|t| push(&p, role, t));
                    p.end(role, None);
                })
            });
            let mut times = std::vec::Vec::new();
            while let Some(pair) = p.next().unwrap() {
                assert_eq!(pair.guide.as_ref().unwrap().timestamp, pair.raw.timestamp);
                times.push(pair.raw.timestamp.as_millis());
                p.recycle(pair);
            }
            assert_eq!(times, [0, 1, 4, 6, 7, 8], "{capacity}");
            p.close();
            cameras.into_iter().for_each(|camera| camera.join().unwrap());
        }
        let p = pairing(2);
        let lost = CameraError::Lost { camera: "raw".into(), reason: "unplugged".into() };
        p.end(Role::Raw, Some(lost));
        assert!(p.next().is_err_and(|e| e.to_string().contains("unplugged")));
    }

    /// Frame interval of the simulated cameras.
    const PERIOD: f64 = 0.1;

    /// Cameras of equal time stamps whose frames arrive late, by `raw` and `guide` periods and some jitter, and a solver that takes
    /// `solve` periods for a pair.
    struct Late {
        raw: f64,
        guide: f64,
        jitter: f64,
        solve: f64,
        capacity: usize,
    }

    impl Late {
        /// Times of arrival of `frames` frames, in order, in seconds.
        fn arrivals(&self, late: f64, frames: usize, seed: u32) -> std::vec::Vec<f64> {
            let (mut state, mut last) = (seed, 0.0f64);
            let one = |n: usize| {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                let jitter = self.jitter * (f64::from(state >> 8) / f64::from(1u32 << 24) - 0.5);
                last = last.max((n as f64 + late + jitter.max(-late)) * PERIOD);
                last
            };
            (0..frames).map(one).collect()
        }

        /// Runs `frames` frames through the queues; returns the times at which pairs were taken and their ages, in periods.
        fn run(&self, frames: usize) -> (Pairing, std::vec::Vec<(f64, f64)>) {
            let p = pairing(self.capacity);
            let begin = p.lanes.lock().begin;
            let of = |role, late, seed| {
                let times = self.arrivals(late, frames, seed);
                times.into_iter().enumerate().map(move |(n, time)| (time, role, n)).collect::<std::vec::Vec<_>>()
            };
            let mut arrivals = [of(Role::Raw, self.raw, 1), of(Role::Guide, self.guide, 2)].concat();
            arrivals.sort_by(|a, b| a.0.total_cmp(&b.0));
            let (mut free, mut taken) = (0.0f64, std::vec::Vec::new());
            for (at, (time, role, n)) in arrivals.iter().copied().enumerate() {
                let timestamp = Duration::from_secs_f64(n as f64 * PERIOD);
                let arrived = begin + Duration::from_secs_f64(time);
                let Binned { values: planes, weights, off_scale } = p.buffer(role, 1, SIZE);
                p.push(role, Captured { planes, weights, off_scale, timestamp, arrived });
                // the solver takes pairs until the next arrival
                let next = arrivals.get(at + 1).map_or(time + PERIOD, |next| next.0);
                while free < next {
                    let now = free.max(time);
                    let Some(pair) = p.lanes.lock().select(begin + Duration::from_secs_f64(now), p.max_skew) else {
                        break;
                    };
                    let guide = pair.guide.as_ref().unwrap();
                    assert!(guide.timestamp.abs_diff(pair.raw.timestamp) <= p.max_skew);
                    taken.push((now / PERIOD, (now - pair.raw.timestamp.as_secs_f64()) / PERIOD));
                    p.recycle(pair);
                    free = now + self.solve * PERIOD;
                }
            }
            (p, taken)
        }
    }

    #[test]
    fn pairs_are_made_however_late_one_camera_is() {
        const FRAMES: usize = 600;
        for lag in [0.5, 1.0, 2.0, 3.5, 5.0, 10.0, 43.0] {
            for (raw, guide) in [(0.0, lag), (lag, 0.0), (17.0, 17.0 + lag)] {
                for (capacity, jitter, solve) in [
                    (1, 0.0, 0.3),
                    (2, 0.0, 0.3),
                    (3, 0.0, 0.3),
                    (3, 0.8, 0.3),
                    (2, 0.8, 2.5),
                    (3, 3.0, 2.5),
                    (8, 0.8, 0.3),
                ] {
                    let late = Late { raw, guide, jitter, solve, capacity };
                    let (p, taken) = late.run(FRAMES);
                    let context = format!("{raw} {guide} {jitter} {solve} {capacity}: {} pairs", taken.len());
                    // as many as the queue holds within the lag, or as the solver takes
                    let spacing = (lag / capacity as f64).ceil().max(solve).max(1.0) + jitter;
                    let expected = (FRAMES as f64 - raw.max(guide) - 2.0 * lag) / (spacing + 1.0);
                    assert!(taken.len() as f64 >= 0.8 * expected, "{context}, expected {expected}");
                    // without long gaps, and not much older than the later camera makes them
                    let settled = &taken[taken.len() / 4..];
                    let gap = settled.windows(2).map(|pair| pair[1].0 - pair[0].0).fold(0.0, f64::max);
                    assert!(gap <= 2.0 * spacing + lag.min(2.0 * spacing) + 2.0, "{context}, gap {gap}");
                    let oldest = settled.iter().map(|taken| taken.1).fold(0.0, f64::max);
                    assert!(oldest <= raw.max(guide) + 2.0 * spacing + solve + 1.0, "{context}, age {oldest}");
                    let (raw_status, guide_status) = p.cameras();
                    let behind =
                        (guide_status.unwrap().behind.as_secs_f64() - raw_status.behind.as_secs_f64()) / PERIOD;
                    assert!((behind - (guide - raw)).abs() <= 0.5 * jitter + 0.01, "{context}, behind {behind}");
                }
            }
        }
    }

    #[test]
    fn cameras_in_step_lose_nothing_and_the_newest_pair_wins() {
        let (p, taken) = Late { raw: 0.2, guide: 0.4, jitter: 0.0, solve: 0.5, capacity: 3 }.run(100);
        assert_eq!((taken.len(), p.cameras().0.dropped), (100, 0));
        let (_, taken) = Late { raw: 0.2, guide: 0.4, jitter: 0.0, solve: 3.0, capacity: 3 }.run(100);
        assert!(taken.len() >= 32 && taken.iter().all(|taken| taken.1 < 1.5), "{taken:?}");
    }

    #[test]
    fn no_frame_waits_longer_than_stated() {
        // the guide camera is later than the longest wait, so no pair can be made
        const LATE: u64 = 110;
        let p = pairing(2);
        let begin = p.lanes.lock().begin;
        let time = |n: u64| Duration::from_millis(100 * n);
        let mut oldest = Duration::ZERO;
        for n in 0..400u64 {
            for (role, shown) in [(Role::Raw, Some(n)), (Role::Guide, n.checked_sub(LATE))] {
                let Some(shown) = shown else { continue };
                let (Binned { values: planes, weights, off_scale }, timestamp) = (p.buffer(role, 1, SIZE), time(shown));
                p.push(role, Captured { planes, weights, off_scale, timestamp, arrived: begin + time(n) });
            }
            let mut lanes = p.lanes.lock();
            assert!(lanes.select(begin + time(n), p.max_skew).is_none());
            oldest = oldest.max(lanes.raw.waiting.front().map_or(Duration::ZERO, |frame| time(n) - frame.timestamp));
        }
        assert!(oldest <= LONGEST_WAIT && oldest > LONGEST_WAIT / 2, "{oldest:?}");
        assert!(p.lanes.lock().thinned);
    }

    #[test]
    fn frames_that_follow_each_other_more_closely_than_the_skew_are_paired() {
        let p = Pairing::new("raw".to_owned(), Some("guide".to_owned()), 2, Duration::from_millis(40), false);
        let mut pairs = 0;
        for n in 0..50 {
            // now one camera is the first, now the other
            for role in if n % 3 == 0 { [Role::Raw, Role::Guide] } else { [Role::Guide, Role::Raw] } {
                let Binned { values: planes, weights, off_scale } = p.buffer(role, 1, SIZE);
                let timestamp = Duration::from_millis(10 * n);
                p.push(role, Captured { planes, weights, off_scale, timestamp, arrived: Instant::now() });
            }
            pairs += u64::from(p.lanes.lock().select(Instant::now(), p.max_skew).is_some());
        }
        assert!(pairs > 45, "{pairs}");
    }

    #[test]
    fn single_shots_take_one_pair_each_of_frames_that_come_after() {
        let p = pairing(2).single_shots();
        let both = |n: u64| [Role::Raw, Role::Guide].into_iter().for_each(|role| push(&p, role, 100 * n));
        (0..5).for_each(both);
        assert!(p.is_idle() && select(&p).is_none());
        for asked in [1, 3] {
            (0..asked).for_each(|_| assert!(p.shoot()));
            assert!(!p.is_idle());
            let mut taken = std::vec::Vec::new();
            for n in 10 * asked..10 * asked + 8 {
                both(n);
                let mut lanes = p.lanes.lock();
                if let Some(pair) = lanes.select(Instant::now(), p.max_skew) {
                    lanes.shot();
                    taken.push(pair.raw.timestamp.as_millis() as u64 / 100 - 10 * asked);
                }
            }
            assert_eq!(taken, (0..asked).collect::<std::vec::Vec<_>>());
        }
        assert!(!pairing(2).shoot(), "every pair is taken");
    }

    #[test]
    fn a_camera_that_stops_is_waited_for_in_vain_only_for_a_while() {
        let p = pairing(2);
        let begin = p.lanes.lock().begin;
        let push = |role, n: u64| {
            let timestamp = Duration::from_millis(100 * n);
            let Binned { values: planes, weights, off_scale } = p.buffer(role, 1, SIZE);
            p.push(role, Captured { planes, weights, off_scale, timestamp, arrived: begin + timestamp });
        };
        let select = |n: u64| {
            let pair = p.lanes.lock().select(begin + Duration::from_millis(100 * n), p.max_skew)?;
            Some(pair.raw.timestamp.as_millis())
        };
        push(Role::Guide, 0);
        push(Role::Raw, 0);
        assert_eq!(select(0), Some(0));
        (1..=30).for_each(|n| push(Role::Raw, n));
        let oldest = p.lanes.lock().raw.waiting.front().map(|frame| frame.timestamp);
        assert!(oldest >= Some(Duration::from_millis(1900)), "{oldest:?} has waited too long");
        push(Role::Guide, 30);
        push(Role::Raw, 31);
        push(Role::Guide, 31);
        assert_eq!(select(31), Some(3100));
    }

    #[test]
    fn closing_ends_the_wait() {
        let p = std::sync::Arc::new(pairing(2));
        let other = std::sync::Arc::clone(&p);
        let waiting = std::thread::spawn(move || other.next().unwrap().is_none());
        p.close();
        assert!(waiting.join().unwrap());
    }
}
