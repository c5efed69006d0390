//! Frames of the two cameras wait here for each other and for the solver, in queues that never grow.

use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use heapless::{Deque, Vec};

use super::record;
use crate::board::MAX_QUEUE_FRAMES;
use crate::camera::Role;
use crate::plane::{Size, Stack};

/// How long a raw frame waits for a guide frame of its instant before it is given up.
const PATIENCE: Duration = Duration::from_secs(1);

/// One frame out of its camera's hands.
#[derive(Debug)]
pub(super) struct Captured {
    /// Counts, or fractions of full scale.
    pub(super) planes: Stack<f32>,
    /// On the sensor's clock.
    pub(super) timestamp: Duration,
    /// When it came, on this machine's clock.
    pub(super) arrived: Instant,
}

/// A raw frame and the guide frame of its instant.
#[derive(Debug)]
pub(super) struct Pair {
    pub(super) raw: Captured,
    /// None without a guide camera, or while it is offline.
    pub(super) guide: Option<Captured>,
}

/// What is known of one camera.
#[derive(Clone, Debug, Default)]
pub(super) struct Lens {
    /// Its name.
    pub(super) name: String,
    /// Why it gives no frames; none while it does.
    pub(super) fault: Option<String>,
    /// Frames that arrived whole.
    pub(super) received: u64,
    /// Frames that made room for newer ones.
    pub(super) dropped: u64,
    /// Frames without a partner of the same instant.
    pub(super) unpaired: u64,
    /// Frames that were not whole, and waits in vain.
    pub(super) faults: u64,
    /// Times it was opened again.
    pub(super) reopened: u64,
}

#[derive(Debug, Default)]
struct Lane {
    lens: Lens,
    waiting: Deque<Captured, MAX_QUEUE_FRAMES>,
    /// Buffers for the frames to come.
    free: Vec<Stack<f32>, { MAX_QUEUE_FRAMES + 2 + record::WAITING + 1 }>,
}

#[derive(Debug)]
struct State {
    raw: Lane,
    guide: Option<Lane>,
    closed: bool,
    every: bool,
}

/// The meeting point of two capture threads and the solver.
#[derive(Debug)]
pub(super) struct Pairing {
    state: Mutex<State>,
    bell: Condvar,
    capacity: usize,
    max_skew: Duration,
}

impl Lane {
    fn recycle(&mut self, frame: Captured) {
        // more buffers than places never exist
        let _ = self.free.push(frame.planes);
    }

    /// Takes frame `index` and gives back the older ones.
    fn take(&mut self, index: usize) -> Option<Captured> {
        for _ in 0..index {
            let older = self.waiting.pop_front()?;
            self.lens.dropped += 1;
            self.recycle(older);
        }
        self.waiting.pop_front()
    }
}

impl State {
    fn lane(&mut self, role: Role) -> &mut Lane {
        match (role, &mut self.guide) {
            (Role::Guide, Some(guide)) => guide,
            _ => &mut self.raw,
        }
    }

    /// The newest pair there is, or the oldest where every frame counts; frames that can have no partner any more are given up.
    fn select(&mut self, now: Instant, max_skew: Duration) -> Option<Pair> {
        let newest = self.raw.waiting.len().checked_sub(1)?;
        let Some(lane) = self.guide.as_mut().filter(|lane| lane.lens.fault.is_none()) else {
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
            self.raw.lens.unpaired += 1;
            if let Some(raw) = self.raw.waiting.pop_front() {
                self.raw.recycle(raw);
            }
        }
        None
    }
}

impl Pairing {
    /// A meeting point of the raw camera and, if there is one, the guide camera, where `capacity` frames of each wait. Where
    /// `every` frame counts cameras wait for a place, else the newest frames win.
    pub(super) fn new(raw: String, guide: Option<String>, capacity: usize, max_skew: Duration, every: bool) -> Self {
        let lane = |name| Lane { lens: Lens { name, ..Lens::default() }, ..Lane::default() };
        Self {
            state: Mutex::new(State { raw: lane(raw), guide: guide.map(lane), closed: false, every }),
            bell: Condvar::new(),
            capacity: capacity.clamp(1, MAX_QUEUE_FRAMES),
            max_skew,
        }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        // every change leaves the queues whole
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A buffer for the next frame of `role`: a used one, or a new one until as many exist as can be held at once.
    pub(super) fn buffer(&self, role: Role, planes: usize, size: Size) -> Stack<f32> {
        let used = self.lock().lane(role).free.pop();
        used.filter(|b| (b.count(), b.size()) == (planes, size)).unwrap_or_else(|| Stack::zeros(planes, size))
    }

    /// Queues a frame. When the queue is full the oldest one goes, or where every frame counts this waits for a place.
    pub(super) fn push(&self, role: Role, frame: Captured) {
        let mut state = self.lock();
        while state.every && state.lane(role).waiting.len() >= self.capacity && !state.closed {
            state = self.bell.wait_timeout(state, PATIENCE / 4).unwrap_or_else(PoisonError::into_inner).0;
        }
        if state.every && state.closed {
            return state.lane(role).recycle(frame);
        }
        let lane = state.lane(role);
        if lane.waiting.len() >= self.capacity
            && let Some(oldest) = lane.waiting.pop_front()
        {
            lane.lens.dropped += 1;
            lane.recycle(oldest);
        }
        lane.lens.received += 1;
        let fits = lane.waiting.push_back(frame).is_ok();
        debug_assert!(fits, "the capacity is within the queue's");
        drop(state);
        self.bell.notify_all();
    }

    /// Waits for the newest pair. None once closed.
    pub(super) fn next(&self) -> Option<Pair> {
        let mut state = self.lock();
        loop {
            if state.closed {
                return None;
            }
            if let Some(pair) = state.select(Instant::now(), self.max_skew) {
                drop(state);
                self.bell.notify_all();
                return Some(pair);
            }
            state = self.bell.wait_timeout(state, PATIENCE / 4).unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    /// Gives the buffers of a pair back.
    pub(super) fn recycle(&self, pair: Pair) {
        let mut state = self.lock();
        state.raw.recycle(pair.raw);
        if let (Some(lane), Some(guide)) = (&mut state.guide, pair.guide) {
            lane.recycle(guide);
        }
    }

    /// Ends every wait.
    pub(super) fn close(&self) {
        self.lock().closed = true;
        self.bell.notify_all();
    }

    /// Changes what is known of a camera.
    pub(super) fn update(&self, role: Role, change: impl FnOnce(&mut Lens)) {
        change(&mut self.lock().lane(role).lens);
        self.bell.notify_all();
    }

    /// What is known of both cameras.
    pub(super) fn lenses(&self) -> (Lens, Option<Lens>) {
        let state = self.lock();
        (state.raw.lens.clone(), state.guide.as_ref().map(|lane| lane.lens.clone()))
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
        let planes = pairing.buffer(role, 1, SIZE);
        let timestamp = Duration::from_millis(millis);
        pairing.push(role, Captured { planes, timestamp, arrived: Instant::now() });
    }

    fn select(pairing: &Pairing) -> Option<(u128, Option<u128>)> {
        let pair = pairing.lock().select(Instant::now(), pairing.max_skew)?;
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
        let (raw, guide) = p.lenses();
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
        assert_eq!(p.lenses().0.unpaired, 1);
    }

    #[test]
    fn without_its_guide_camera_a_raw_frame_goes_on_alone() {
        let p = pairing(8);
        push(&p, Role::Guide, 0);
        push(&p, Role::Raw, 0);
        p.update(Role::Guide, |lens| lens.fault = Some("unplugged".into()));
        assert_eq!(select(&p), Some((0, None)));
        p.update(Role::Guide, |lens| lens.fault = None);
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
        let (raw, _) = p.lenses();
        assert_eq!((raw.received, raw.dropped), (100, 98));
        let state = p.lock();
        assert!(state.raw.waiting.len() + state.raw.free.len() <= 4);
        assert_eq!(state.raw.waiting.front().unwrap().timestamp.as_millis(), 98);
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
        assert_eq!((times, p.lenses().0.dropped), ((0..50).collect(), 0));
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
