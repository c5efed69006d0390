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
}

/// A camera on the clock.
#[derive(Debug)]
struct Member {
    id: u64,
    /// Value of `begun` when this camera delivered its latest frame.
    shown: u64,
    /// Whether the others no longer wait for this camera, until it asks for a frame again.
    idle: bool,
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
        state.members.push(Member { id, shown, idle: false });
        Trigger { clock: Arc::clone(&self.0), id }
    }
}

impl SharedClock {
    /// Locks the state. It is consistent even after a panic, because each number is written in one step.
    fn lock(&self) -> MutexGuard<'_, ClockState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Trigger {
    /// Waits for the next instant, at least `period` after the one before, and returns its number; `None` after `timeout`.
    pub(super) fn next(&mut self, period: Duration, timeout: Duration) -> Option<u64> {
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
                drop(state);
                self.clock.moved.notify_all();
                return Some(begun - 1);
            }
            let all_shown = state.members.iter().all(|m| m.idle || m.shown == begun);
            if now >= due && (all_shown || now >= give_up) {
                for member in &mut state.members {
                    member.idle |= member.shown < begun;
                    member.shown = if member.id == self.id { begun + 1 } else { member.shown };
                }
                (state.begun, state.since) = (begun + 1, Some(now));
                drop(state);
                self.clock.moved.notify_all();
                return Some(begun);
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

    #[test]
    fn both_cameras_see_every_instant_in_any_order() {
        let clock = Clock::default();
        let (mut a, mut b) = (clock.join(), clock.join());
        assert_eq!(a.next(Duration::ZERO, LONG), Some(0));
        assert_eq!(b.next(Duration::ZERO, LONG), Some(0));
        assert_eq!(b.next(Duration::ZERO, LONG), Some(1));
        assert_eq!(a.next(Duration::ZERO, LONG), Some(1));
    }

    #[test]
    fn a_slow_camera_holds_a_fast_one_in_another_thread() {
        let clock = Clock::default();
        let (mut fast, mut slow) = (clock.join(), clock.join());
        let fast = std::thread::spawn(move || (0..5).map(|_| fast.next(Duration::ZERO, LONG)).collect::<Vec<_>>());
        for n in 0..5 {
            assert_eq!(slow.next(Duration::ZERO, LONG), Some(n));
            std::thread::sleep(Duration::from_millis(5));
        }
        assert_eq!(fast.join().unwrap(), (0..5).map(Some).collect::<Vec<_>>());
    }

    #[test]
    fn a_camera_that_is_not_read_delays_others_once_and_a_dropped_one_never() {
        let clock = Clock::default();
        let (mut read, unread) = (clock.join(), clock.join());
        assert_eq!(read.next(Duration::ZERO, LONG), Some(0));
        assert_eq!(read.next(Duration::ZERO, SOON), None);
        assert_eq!(read.next(Duration::ZERO, LONG), Some(1));
        assert_eq!(read.next(Duration::ZERO, SOON), Some(2));
        drop(unread);
        assert_eq!(read.next(Duration::ZERO, SOON), Some(3));
    }

    #[test]
    fn instants_are_a_period_apart() {
        let mut it = Clock::default().join();
        let begin = Instant::now();
        assert_eq!(it.next(SOON, LONG), Some(0));
        assert_eq!(it.next(SOON, LONG), Some(1));
        assert!(begin.elapsed() >= SOON);
        assert_eq!(it.next(LONG, SOON), None);
    }
}
