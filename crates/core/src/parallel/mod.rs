//! A fixed team of threads that shares the loops of one frame.
//!
//! [`Workers::run`] hands out task numbers; the caller works too. Tasks write to one slice through [`BandsMut`] (bands of
//! rows), [`StridedBandsMut`] (bands of columns, or of the rows of several planes) and [`EachMut`] (one element for each
//! task), all of them safe. The solver's only `unsafe` code is in this module.
//!
//! Allocation: [`Workers::new`] spawns and allocates; `run` does not.
//!
//! ```
//! use stokescope_core::parallel::Workers;
//! let workers = Workers::new(2);
//! let mut squares = [0; 100];
//! let bands = workers.bands_mut(&mut squares, 100);
//! workers.run(workers.threads(), &|task| bands.take_rows(task).for_each(|(y, row)| row[0] = y * y));
//! assert_eq!(squares[9], 81);
//! ```
#![allow(unsafe_code)]

mod bands;

pub use bands::{BandsMut, EachMut, StridedBandsMut, StridedMut};

use std::ops::Range;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;

/// Rounds of busy waiting before a thread sleeps: the phases of one iteration follow each other within microseconds.
const SPINS: usize = 2000;

/// Threads of a team, at most: one bit of a mask for each tells which bands are taken.
pub const MAX_THREADS: usize = 64;

/// Bytes of a thread's stack: tasks work in buffers of their caller.
const STACK: usize = 256 << 10;

type Task = dyn Fn(usize) + Sync;

/// One call of [`Workers::run`], as the threads see it.
#[derive(Clone, Copy)]
struct Job {
    task: *const Task,
    tasks: usize,
}

// SAFETY: the pointee is `Sync`, and `run` keeps it alive until every worker has let go of the job.
unsafe impl Send for Job {}

struct State {
    job: Option<Job>,
    /// Workers that have not finished the current job.
    busy: usize,
    panicked: bool,
    stop: bool,
}

struct Team {
    state: Mutex<State>,
    /// Number of jobs started; workers wait for it to change.
    started: AtomicUsize,
    /// Number of workers that finished, over all jobs.
    finished: AtomicUsize,
    next: AtomicUsize,
    wake: Condvar,
    done: Condvar,
}

impl Team {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn work(&self, job: Job) {
        // SAFETY: `run` does not return, nor unwind, before every worker has finished this job.
        let task = unsafe { &*job.task };
        loop {
            let i = self.next.fetch_add(1, Ordering::Relaxed);
            if i >= job.tasks {
                return;
            }
            task(i);
        }
    }

    fn serve(&self) {
        let mut seen = 0;
        loop {
            for _ in 0..SPINS {
                if self.started.load(Ordering::Acquire) != seen {
                    break;
                }
                std::hint::spin_loop();
            }
            let mut state = self.lock();
            while self.started.load(Ordering::Acquire) == seen && !state.stop {
                state = self.wake.wait(state).unwrap_or_else(PoisonError::into_inner);
            }
            if state.stop {
                return;
            }
            seen = self.started.load(Ordering::Acquire);
            let job = state.job;
            drop(state);
            let outcome = job.map(|job| std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| self.work(job))));
            let mut state = self.lock();
            state.panicked |= matches!(outcome, Some(Err(_)));
            state.busy -= 1;
            self.finished.fetch_add(1, Ordering::Release);
            if state.busy == 0 {
                self.done.notify_one();
            }
        }
    }
}

/// A fixed team of threads. Dropping it ends them.
pub struct Workers {
    team: Arc<Team>,
    handles: Vec<JoinHandle<()>>,
    /// One `run` at a time, whoever shares the team.
    turn: Mutex<()>,
}

impl std::fmt::Debug for Workers {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Workers({})", self.threads())
    }
}

impl Workers {
    /// A team of `threads` threads, the caller of [`Self::run`] included, of 1 to [`MAX_THREADS`]. When the system refuses
    /// a thread, the team does without it.
    pub fn new(threads: usize) -> Self {
        let team = Arc::new(Team {
            state: Mutex::new(State { job: None, busy: 0, panicked: false, stop: false }),
            started: AtomicUsize::new(0),
            finished: AtomicUsize::new(0),
            next: AtomicUsize::new(0),
            wake: Condvar::new(),
            done: Condvar::new(),
        });
        let handles = (1..threads.min(MAX_THREADS))
            .map_while(|i| {
                let team = Arc::clone(&team);
                let thread = std::thread::Builder::new().name(format!("solver-{i}")).stack_size(STACK);
                thread.spawn(move || team.serve()).ok()
            })
            .collect();
        Self { team, handles, turn: Mutex::new(()) }
    }

    /// Number of threads that share the work, the caller included.
    pub fn threads(&self) -> usize {
        self.handles.len() + 1
    }

    /// Calls `task(0)` … `task(tasks − 1)`, each once, in any order, on all threads; returns when all are done.
    ///
    /// # Panics
    /// When a task panicked, after all threads have let go of it. Do not call `run` from inside a task.
    pub fn run(&self, tasks: usize, task: &(dyn Fn(usize) + Sync)) {
        if self.handles.is_empty() || tasks <= 1 {
            (0..tasks).for_each(task);
            return;
        }
        let _turn = self.turn.lock().unwrap_or_else(PoisonError::into_inner);
        // SAFETY: only the lifetime is erased; the guard below waits for all workers before this frame is left.
        let task = unsafe { std::mem::transmute::<&(dyn Fn(usize) + Sync), &'static Task>(task) };
        let job = Job { task, tasks };
        let finished = self.team.finished.load(Ordering::Acquire);
        {
            let mut state = self.team.lock();
            state.job = Some(job);
            state.busy = self.handles.len();
            self.team.next.store(0, Ordering::Relaxed);
            self.team.started.fetch_add(1, Ordering::Release);
        }
        self.team.wake.notify_all();
        let guard = Join { workers: self, until: finished + self.handles.len() };
        self.team.work(job);
        drop(guard);
        let panicked = std::mem::take(&mut self.team.lock().panicked);
        assert!(!panicked, "a solver thread panicked");
    }
}

impl Workers {
    /// The rows of band `task`, when `height` rows are split into one band for each thread.
    pub fn band(&self, task: usize, height: usize) -> Range<usize> {
        bands::cut(task, height, self.threads())
    }
}

/// Waits, also while unwinding, until every worker has finished the current job.
struct Join<'a> {
    workers: &'a Workers,
    until: usize,
}

impl Drop for Join<'_> {
    fn drop(&mut self) {
        let team = &self.workers.team;
        for _ in 0..SPINS {
            if team.finished.load(Ordering::Acquire) == self.until {
                break;
            }
            std::hint::spin_loop();
        }
        let mut state = team.lock();
        while state.busy > 0 {
            state = team.done.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
        state.job = None;
    }
}

impl Drop for Workers {
    fn drop(&mut self) {
        self.team.lock().stop = true;
        self.team.wake.notify_all();
        for handle in self.handles.drain(..) {
            // A worker's panic was reported by `run` already.
            let _ = handle.join();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_task_runs_once_whatever_the_team() {
        for threads in [0, 1, 2, 5] {
            let workers = Workers::new(threads);
            for tasks in [0, 1, 2, 7, 1000] {
                let counts: Vec<AtomicUsize> = (0..tasks).map(|_| AtomicUsize::new(0)).collect();
                workers.run(tasks, &|i| {
                    counts[i].fetch_add(1, Ordering::Relaxed);
                });
                assert!(counts.iter().all(|c| c.load(Ordering::Relaxed) == 1));
            }
        }
    }

    #[test]
    fn many_short_jobs_neither_hang_nor_mix() {
        let workers = Workers::new(3);
        let sum = AtomicUsize::new(0);
        for round in 0..5000 {
            workers.run(4, &|i| {
                sum.fetch_add(i * round, Ordering::Relaxed);
            });
        }
        assert_eq!(sum.into_inner(), 6 * (0..5000).sum::<usize>());
    }

    #[test]
    fn a_panic_reaches_the_caller_and_the_team_lives_on() {
        let workers = Workers::new(2);
        let caught = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
            workers.run(64, &|i| assert!(i != 40, "task 40 fails"));
        }));
        assert!(caught.is_err());
        let count = AtomicUsize::new(0);
        workers.run(10, &|_| {
            count.fetch_add(1, Ordering::Relaxed);
        });
        assert_eq!(count.into_inner(), 10);
    }

    #[test]
    fn bands_cover_every_row_once_and_are_even() {
        for (threads, height) in [(1, 5), (3, 5), (8, 5), (3, 250)] {
            let workers = Workers::new(threads);
            let bands: Vec<_> = (0..workers.threads()).map(|task| workers.band(task, height)).collect();
            assert!(bands.iter().cloned().flatten().eq(0..height));
            assert!(bands.iter().all(|b| (height / threads..=height.div_ceil(threads)).contains(&b.len())));
        }
    }
}
