//! Shared trigger of simulated and replayed cameras.

use std::{
    sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant},
};

/// Time after which cameras no longer wait for one that is not read.
const IDLE_AFTER: Duration = Duration::from_secs(1);

/// Shared trigger of the cameras of one scene; clones share one clock.
///
/// The clock numbers instants. An instant begins only after every camera in use has delivered its frame of the instant before. Frame
/// `n` of all cameras therefore shows the same instant, however fast and in whatever order they are read. When a camera is read
/// slowly, the scene slows down and no frame is lost.
///
/// Cameras that loop a clip share their position in it, which moves to and fro over the frames that all of them have.
#[derive(Clone, Debug, Default)]
pub struct Clock(Arc<SharedClock>);

#[derive(Debug, Default)]
struct SharedClock {
    state: Mutex<ClockState>,
    moved: Condvar,
}

#[derive(Debug, Default)]
struct ClockState {
    /// Number of instants that have begun.
    begun: u64,
    since: Option<Instant>,
    members: Vec<Member>,
    joined: u64,
    sweep: Sweep,
}

/// Position in a clip that is shown to and fro.
#[derive(Debug, Default)]
struct Sweep {
    at: u64,
    back: bool,
}

impl Sweep {
    /// Moves on by one frame in a clip of `frames`, which may grow. It turns round at the ends.
    fn step(&mut self, frames: u64) {
        self.at = self.at.min(frames.saturating_sub(1));
        if frames > 1 {
            self.back = if self.back { self.at > 0 } else { self.at + 1 >= frames };
            self.at = if self.back { self.at - 1 } else { self.at + 1 };
        }
    }
}

/// An instant of a clock.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Tick {
    /// Number of the instant, from 0.
    pub(super) number: u64,
    /// Number of the scene's frame that is shown: that of the instant, or the position in the clip.
    pub(super) scene: u64,
}

/// A camera on the clock.
#[derive(Debug)]
struct Member {
    id: u64,
    /// Value of `begun` when this camera delivered its latest frame.
    shown: u64,
    /// Whether the others no longer wait for this camera, until it asks for a frame again.
    idle: bool,
    /// Frames of its clip that it has; none without a clip.
    clip: Option<u64>,
}

/// Connection of one camera to a [`Clock`].
#[derive(Debug)]
pub(super) struct Trigger {
    clock: Arc<SharedClock>,
    id: u64,
}

impl Clock {
    /// Connects a camera until the returned trigger is dropped.
    pub(super) fn join(&self) -> Trigger {
        let mut state = self.0.lock();
        state.joined += 1;
        let (id, shown) = (state.joined, state.begun);
        state.members.push(Member { id, shown, idle: false, clip: None });
        Trigger { clock: Arc::clone(&self.0), id }
    }
}

impl SharedClock {
    /// Locks the state. It is consistent even after a panic, because each number is written in one step.
    fn lock(&self) -> MutexGuard<'_, ClockState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl ClockState {
    /// Begins the next instant at `now`.
    fn begin(&mut self, now: Instant, due: Instant, period: Duration) {
        let clip = self.members.iter().filter_map(|member| member.clip).min();
        if let Some(frames) = clip.filter(|_| self.begun > 0) {
            self.sweep.step(frames);
        }
        self.begun += 1;
        // a wait that lasts a little too long does not add up
        self.since = Some(if now < due + period { due } else { now });
    }

    /// The instant that has begun last.
    fn tick(&self) -> Tick {
        let number = self.begun - 1;
        let clip = self.members.iter().any(|member| member.clip.is_some());
        Tick { number, scene: if clip { self.sweep.at } else { number } }
    }
}

impl Trigger {
    /// Tells the clock that this camera loops a clip, of which it has `frames`.
    pub(super) fn set_clip(&mut self, frames: u64) {
        self.clock.lock().members.iter_mut().filter(|m| m.id == self.id).for_each(|own| own.clip = Some(frames));
    }

    /// Waits for the next instant, of which one begins each `period`; `None` after `timeout`.
    pub(super) fn next(&mut self, period: Duration, timeout: Duration) -> Option<Tick> {
        let deadline = Instant::now().checked_add(timeout);
        let mut state = self.clock.lock();
        loop {
            let now = Instant::now();
            let begun = state.begun;
            let due = state.since.map_or(now, |since| since + period);
            let give_up = state.since.map_or(now, |since| since + period + IDLE_AFTER);
            let own = state.members.iter_mut().find(|m| m.id == self.id)?;
            own.idle = false;
            if own.shown < begun {
                own.shown = begun;
                let tick = state.tick();
                drop(state);
                self.clock.moved.notify_all();
                return Some(tick);
            }
            let all_shown = state.members.iter().all(|m| m.idle || m.shown == begun);
            if now >= due && (all_shown || now >= give_up) {
                for member in &mut state.members {
                    member.idle |= member.shown < begun;
                    member.shown = if member.id == self.id { begun + 1 } else { member.shown };
                }
                state.begin(now, due, period);
                let tick = state.tick();
                drop(state);
                self.clock.moved.notify_all();
                return Some(tick);
            }
            let until = if all_shown { due } else { give_up };
            let until = deadline.map_or(until, |deadline| until.min(deadline));
            if deadline.is_some_and(|deadline| now >= deadline) {
                return None;
            }
            let wait = until.saturating_duration_since(now);
            state = self.clock.moved.wait_timeout(state, wait).unwrap_or_else(PoisonError::into_inner).0;
        }
    }
}

impl Drop for Trigger {
    fn drop(&mut self) {
        self.clock.lock().members.retain(|m| m.id != self.id);
        self.clock.moved.notify_all();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SOON: Duration = Duration::from_millis(20);
    const LONG: Duration = Duration::from_secs(5);

    fn next(trigger: &mut Trigger, period: Duration, timeout: Duration) -> Option<u64> {
        trigger.next(period, timeout).map(|tick| tick.number)
    }

    #[test]
    fn a_clip_is_shown_to_and_fro_as_far_as_all_cameras_have_it() {
        let clock = Clock::default();
        let (mut a, mut b) = (clock.join(), clock.join());
        let mut shown = Vec::new();
        for n in 0..16u64 {
            // one has all of it from the start, the other renders a frame in every third instant
            a.set_clip(4);
            b.set_clip(1 + n / 3);
            let (first, second) = (a.next(Duration::ZERO, LONG).unwrap(), b.next(Duration::ZERO, LONG).unwrap());
            assert_eq!((first, first.number), (second, n));
            assert!(first.scene < (1 + n / 3).min(4), "{n}: {first:?}");
            shown.push(first.scene);
        }
        assert!(shown.windows(2).all(|pair| pair[0].abs_diff(pair[1]) <= 1), "{shown:?}");
        assert_eq!(shown[10..], [2, 3, 2, 1, 0, 1], "{shown:?}");
        // a camera that is opened again begins anew
        b.set_clip(1);
        assert_eq!(b.next(Duration::ZERO, LONG).unwrap().scene, 0);
    }

    #[test]
    fn both_cameras_see_every_instant_in_any_order() {
        let clock = Clock::default();
        let (mut a, mut b) = (clock.join(), clock.join());
        assert_eq!(next(&mut a, Duration::ZERO, LONG), Some(0));
        assert_eq!(next(&mut b, Duration::ZERO, LONG), Some(0));
        assert_eq!(next(&mut b, Duration::ZERO, LONG), Some(1));
        assert_eq!(next(&mut a, Duration::ZERO, LONG), Some(1));
    }

    #[test]
    fn a_slow_camera_holds_a_fast_one_in_another_thread() {
        let clock = Clock::default();
        let (mut fast, mut slow) = (clock.join(), clock.join());
        let fast =
            std::thread::spawn(move || (0..5).map(|_| next(&mut fast, Duration::ZERO, LONG)).collect::<Vec<_>>());
        for n in 0..5 {
            assert_eq!(next(&mut slow, Duration::ZERO, LONG), Some(n));
            std::thread::sleep(Duration::from_millis(5));
        }
        assert_eq!(fast.join().unwrap(), (0..5).map(Some).collect::<Vec<_>>());
    }

    #[test]
    fn a_camera_that_is_not_read_delays_others_once_and_a_dropped_one_never() {
        let clock = Clock::default();
        let (mut read, unread) = (clock.join(), clock.join());
        assert_eq!(next(&mut read, Duration::ZERO, LONG), Some(0));
        assert_eq!(next(&mut read, Duration::ZERO, SOON), None);
        assert_eq!(next(&mut read, Duration::ZERO, LONG), Some(1));
        assert_eq!(next(&mut read, Duration::ZERO, SOON), Some(2));
        drop(unread);
        assert_eq!(next(&mut read, Duration::ZERO, SOON), Some(3));
    }

    #[test]
    fn instants_are_a_period_apart() {
        let mut it = Clock::default().join();
        let begin = Instant::now();
        assert_eq!(next(&mut it, SOON, LONG), Some(0));
        assert_eq!(next(&mut it, SOON, LONG), Some(1));
        assert!(begin.elapsed() >= SOON);
        assert_eq!(next(&mut it, LONG, SOON), None);
    }
}
