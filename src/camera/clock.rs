use std::{
    sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant},
};

/// How long the others wait for a camera that nobody reads, before they go on without it.
const PATIENCE: Duration = Duration::from_secs(1);

/// The trigger line between cameras of one scene: it numbers instants, and no instant begins before every camera that is
/// being read has shown the one before. So frame `n` of all of them is the same instant, however fast each one is read
/// and in whatever order, and a scene slows down rather than lose frames. Clones are the same clock.
#[derive(Clone, Debug, Default)]
pub struct Clock(Arc<Line>);

#[derive(Debug, Default)]
struct Line {
    state: Mutex<State>,
    moved: Condvar,
}

#[derive(Debug, Default)]
struct State {
    /// Instants that have begun.
    begun: u64,
    since: Option<Instant>,
    members: Vec<Member>,
    joined: u64,
}

#[derive(Debug)]
struct Member {
    id: u64,
    /// Instants that had begun when it last showed one.
    shown: u64,
    /// It was waited for in vain; counts again once it asks.
    idle: bool,
}

/// One camera's end of the line.
#[derive(Debug)]
pub(super) struct Trigger {
    line: Arc<Line>,
    id: u64,
}

impl Clock {
    /// Connects a camera; it leaves when the trigger is dropped.
    pub(super) fn join(&self) -> Trigger {
        let mut state = self.0.lock();
        state.joined += 1;
        let (id, shown) = (state.joined, state.begun);
        state.members.push(Member { id, shown, idle: false });
        Trigger { line: Arc::clone(&self.0), id }
    }
}

impl Line {
    /// Numbers stay consistent whatever a panicking holder did: each is written in one step.
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Trigger {
    /// Waits for the next instant, `period` after the one before, and gives its number; `None` after `timeout`.
    pub(super) fn next(&mut self, period: Duration, timeout: Duration) -> Option<u64> {
        let deadline = Instant::now().checked_add(timeout);
        let mut state = self.line.lock();
        loop {
            let now = Instant::now();
            let begun = state.begun;
            let due = state.since.map_or(now, |since| since + period);
            let give_up = state.since.map_or(now, |since| since + period + PATIENCE);
            let own = state.members.iter_mut().find(|m| m.id == self.id)?;
            own.idle = false;
            if own.shown < begun {
                own.shown = begun;
                drop(state);
                self.line.moved.notify_all();
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
                self.line.moved.notify_all();
                return Some(begun);
            }
            let until = if all_shown { due } else { give_up };
            let until = deadline.map_or(until, |deadline| until.min(deadline));
            if deadline.is_some_and(|deadline| now >= deadline) {
                return None;
            }
            let wait = until.saturating_duration_since(now);
            state = self.line.moved.wait_timeout(state, wait).unwrap_or_else(PoisonError::into_inner).0;
        }
    }
}

impl Drop for Trigger {
    fn drop(&mut self) {
        self.line.lock().members.retain(|m| m.id != self.id);
        self.line.moved.notify_all();
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
    fn a_camera_that_is_not_read_holds_others_up_once_and_one_that_left_not_at_all() {
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
