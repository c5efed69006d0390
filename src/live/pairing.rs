//! Pairing: frames of the two cameras wait here for each other and for the solver, in queues that never grow.

use std::time::{Duration, Instant};

use heapless::{Deque, Vec};
use parking_lot::{Condvar, Mutex};

use super::limits::{FRAMES_IN_WORK, RECORDER_FRAMES};
use crate::board::MAX_QUEUE_FRAMES;
use crate::camera::Role;
use stokescope_core::image::{Size, Stack};
use stokescope_core::readings::Binned;

/// Time that a raw frame waits for a guide frame of its instant before it is given up.
const PATIENCE: Duration = Duration::from_secs(1);
/// Pause between two looks at the queues.
const PACE: Duration = Duration::from_millis(250);

/// One frame, copied out of its camera's memory.
#[derive(Debug)]
pub(super) struct Captured {
    /// Counts, or fractions of full scale.
    pub(super) planes: Stack<f32>,
    /// Share of the readings in each value; empty where frames are not binned.
    pub(super) weights: Stack<f32>,
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
    /// Frames that made room for newer ones.
    pub(super) dropped: u64,
    /// Frames without a partner of the same instant.
    pub(super) unpaired: u64,
    /// Broken frames, and waits that ended without a frame.
    pub(super) faults: u64,
    /// Times the camera was opened again.
    pub(super) reopened: u64,
}

/// Queue of one camera.
#[derive(Debug, Default)]
struct Lane {
    status: CameraStatus,
    waiting: Deque<Captured, MAX_QUEUE_FRAMES>,
    /// Buffers for the frames to come.
    free: Vec<Binned, { MAX_QUEUE_FRAMES + FRAMES_IN_WORK + RECORDER_FRAMES }>,
}

#[derive(Debug)]
struct Lanes {
    raw: Lane,
    guide: Option<Lane>,
    closed: bool,
    every: bool,
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
        let _ = self.free.push(Binned { values: frame.planes, weights: frame.weights });
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

    /// Takes the newest pair, or the oldest one where every frame counts. Gives up frames that can have no partner any more.
    fn select(&mut self, now: Instant, max_skew: Duration) -> Option<Pair> {
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
            let missed = last_guide.is_some_and(|guide| guide > raw.timestamp + max_skew);
            if !missed && now.duration_since(raw.arrived) < PATIENCE {
                break;
            }
            self.raw.status.unpaired += 1;
            if let Some(raw) = self.raw.waiting.pop_front() {
                self.raw.recycle(raw);
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
            lanes: Mutex::new(Lanes { raw: lane(raw), guide: guide.map(lane), closed: false, every }),
            bell: Condvar::new(),
            capacity: capacity.clamp(1, MAX_QUEUE_FRAMES),
            max_skew,
        }
    }

    /// Gives a buffer for the next frame of `role`: a used one, or a new one until as many exist as can be held at once.
    pub(super) fn buffer(&self, role: Role, planes: usize, size: Size) -> Binned {
        let used = self.lanes.lock().lane(role).free.pop();
        used.filter(|b| (b.values.count(), b.values.size()) == (planes, size))
            .unwrap_or_else(|| Binned { values: Stack::zeros(planes, size), weights: Stack::default() })
    }

    /// Queues a frame. When the queue is full the oldest one goes, or where every frame counts this waits for a place.
    pub(super) fn push(&self, role: Role, frame: Captured) {
        let mut lanes = self.lanes.lock();
        while lanes.every && lanes.lane(role).waiting.len() >= self.capacity && !lanes.closed {
            self.bell.wait_for(&mut lanes, PACE);
        }
        if lanes.every && lanes.closed {
            return lanes.lane(role).recycle(frame);
        }
        let lane = lanes.lane(role);
        if lane.waiting.len() >= self.capacity
            && let Some(oldest) = lane.waiting.pop_front()
        {
            lane.status.dropped += 1;
            lane.recycle(oldest);
        }
        lane.status.received += 1;
        let fits = lane.waiting.push_back(frame).is_ok();
        debug_assert!(fits, "the capacity is within the queue's");
        drop(lanes);
        self.bell.notify_all();
    }

    /// Waits for the next pair. None once closed.
    pub(super) fn next(&self) -> Option<Pair> {
        let mut lanes = self.lanes.lock();
        while !lanes.closed {
            if let Some(pair) = lanes.select(Instant::now(), self.max_skew) {
                drop(lanes);
                self.bell.notify_all();
                return Some(pair);
            }
            self.bell.wait_for(&mut lanes, PACE);
        }
        None
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
        let Binned { values: planes, weights } = pairing.buffer(role, 1, SIZE);
        let timestamp = Duration::from_millis(millis);
        pairing.push(role, Captured { planes, weights, timestamp, arrived: Instant::now() });
    }

    fn select(pairing: &Pairing) -> Option<(u128, Option<u128>)> {
        let pair = pairing.lanes.lock().select(Instant::now(), pairing.max_skew)?;
        let times = (pair.raw.timestamp.as_millis(), pair.guide.as_ref().map(|g| g.timestamp.as_millis()));
        pairing.recycle(pair);
        Some(times)
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
            let pair = p.next().unwrap();
            times.push(pair.raw.timestamp.as_millis() as u64);
            p.recycle(pair);
        }
        camera.join().unwrap();
        assert_eq!((times, p.cameras().0.dropped), ((0..50).collect(), 0));
    }

    #[test]
    fn closing_ends_the_wait() {
        let p = std::sync::Arc::new(pairing(2));
        let other = std::sync::Arc::clone(&p);
        let waiting = std::thread::spawn(move || other.next().is_none());
        p.close();
        assert!(waiting.join().unwrap());
    }
}
