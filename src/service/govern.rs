//! The quality controller: it holds the frame rate by running fewer iterations, then by drawing smaller pictures, and says so.

use std::time::Duration;

use serde::Serialize;

/// Fewest iterations: a guided solve is already useful after these.
const FEWEST: usize = 2;
/// Share of the time between two frames that the work on one may take.
const SHARE: f32 = 0.9;
/// Weight of the newest frame in the means.
const NEWEST: f32 = 0.2;
/// Changes smaller than this share of the iterations are not worth the flicker.
const STEP: f32 = 0.15;
/// Frames in a row that must be too slow, or quick enough, before pictures change their size.
const PATIENCE: u32 = 15;

/// What frames are solved and drawn with.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct Quality {
    /// Frames per second to be held; none when nothing is traded for speed.
    pub(super) target_fps: Option<f64>,
    /// Iterations that were asked for.
    pub(super) asked_iterations: usize,
    /// Iterations that run.
    pub(super) iterations: usize,
    /// Pictures are drawn with one pixel for so many by so many.
    pub(super) preview_scale: usize,
    /// Why less than what was asked for is done; none while it is done.
    pub(super) reduced: Option<String>,
    /// Whether the target is held.
    pub(super) held: bool,
}

/// Decides before every frame.
#[derive(Debug)]
pub(super) struct Governor {
    period: Option<f32>,
    /// Mean seconds of an iteration, and of everything else a frame takes.
    iteration: Option<f32>,
    rest: f32,
    /// Frames in a row that were too slow at the fewest iterations (positive) or quick enough (negative).
    streak: i32,
    quality: Quality,
}

impl Governor {
    /// Holds `target_fps`; without it what is asked for is done.
    pub(super) fn new(target_fps: Option<f64>, iterations: usize) -> Self {
        let quality = Quality {
            target_fps,
            asked_iterations: iterations,
            iterations,
            preview_scale: 1,
            reduced: None,
            held: true,
        };
        let period = target_fps.map(|fps| (1.0 / fps) as f32);
        Self { period, iteration: None, rest: 0.0, streak: 0, quality }
    }

    /// What the next frame is to be solved and drawn with.
    pub(super) fn quality(&self) -> &Quality {
        &self.quality
    }

    /// Learns from a frame that took `busy` altogether and `recon` of it in the solver, for `run` iterations (fewer than it may
    /// take where it goes on from the last frame), then decides anew. `pressed` says why the machine itself slows down, if it does: then half of the iterations are given up before frames are lost.
    pub(super) fn learn(&mut self, asked: usize, run: usize, busy: Duration, recon: Duration, pressed: Option<&str>) {
        self.quality.asked_iterations = asked;
        let (busy, recon) = (busy.as_secs_f32(), recon.as_secs_f32().min(busy.as_secs_f32()));
        let iteration = recon / run.max(1) as f32;
        match self.iteration {
            Some(mean) => {
                self.iteration = Some(mean + NEWEST * (iteration - mean));
                self.rest += NEWEST * (busy - recon - self.rest);
            }
            None => (self.iteration, self.rest) = (Some(iteration), busy - recon),
        }
        let Some(period) = self.period else {
            self.quality.iterations = asked;
            return;
        };
        let fewest = FEWEST.min(asked);
        let most = if pressed.is_some() { (asked / 2).max(fewest) } else { asked };
        let room = SHARE * period - self.rest;
        let affordable = (room / self.iteration.unwrap_or(iteration).max(f32::MIN_POSITIVE)).max(0.0) as usize;
        let wanted = affordable.clamp(fewest, most);
        let now = self.quality.iterations;
        let change = wanted.abs_diff(now) as f32 > STEP * now as f32;
        if change || wanted == most || wanted == fewest || now > most {
            self.quality.iterations = wanted;
        }
        self.resize(wanted == fewest && busy > period, busy < 0.7 * period);
        let fewer = self.quality.iterations < asked;
        self.quality.held = busy <= period || wanted > fewest;
        self.quality.reduced = match (pressed, fewer, self.quality.preview_scale) {
            (Some(why), true, _) => Some(format!("{why}: {} of {asked} iterations", self.quality.iterations)),
            (_, true, 1) => Some(format!("{} of {asked} iterations, to hold the frame rate", self.quality.iterations)),
            (_, true, _) => Some(format!(
                "{} of {asked} iterations and pictures of half the size, to hold the frame rate",
                self.quality.iterations
            )),
            (_, false, 1) => None,
            (_, false, _) => Some("pictures of half the size, to hold the frame rate".to_owned()),
        };
    }

    fn resize(&mut self, too_slow: bool, quick: bool) {
        self.streak = match (too_slow, quick) {
            (true, _) => self.streak.max(0) + 1,
            (_, true) => self.streak.min(0) - 1,
            _ => 0,
        };
        if self.streak.unsigned_abs() >= PATIENCE {
            self.quality.preview_scale = if self.streak > 0 { 2 } else { 1 };
            self.streak = 0;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A machine that takes so many milliseconds for an iteration and for the rest of a frame.
    fn frames(governor: &mut Governor, count: usize, asked: usize, iteration: f32, rest: f32, pressed: Option<&str>) {
        for _ in 0..count {
            let recon = Duration::from_secs_f32(1e-3 * iteration * governor.quality().iterations as f32);
            governor.learn(
                asked,
                governor.quality().iterations,
                recon + Duration::from_secs_f32(1e-3 * rest),
                recon,
                pressed,
            );
        }
    }

    #[test]
    fn a_quick_machine_does_what_was_asked() {
        let mut g = Governor::new(Some(10.0), 20);
        frames(&mut g, 50, 20, 2.0, 20.0, None);
        assert_eq!((g.quality().iterations, g.quality().reduced.as_deref(), g.quality().held), (20, None, true));
        let mut off = Governor::new(None, 20);
        frames(&mut off, 50, 20, 500.0, 20.0, None);
        assert_eq!(off.quality().iterations, 20);
    }

    #[test]
    fn a_slow_machine_runs_as_many_iterations_as_fit_and_says_so() {
        let mut g = Governor::new(Some(10.0), 20);
        frames(&mut g, 50, 20, 10.0, 17.0, None);
        let q = g.quality();
        assert_eq!((q.iterations, q.preview_scale, q.held), (7, 1, true));
        assert_eq!(q.reduced.as_deref(), Some("7 of 20 iterations, to hold the frame rate"));
        // and comes back when it can
        frames(&mut g, 200, 20, 2.0, 20.0, None);
        assert_eq!((g.quality().iterations, g.quality().reduced.as_deref()), (20, None));
    }

    #[test]
    fn pictures_shrink_only_when_iterations_do_not_suffice() {
        let mut g = Governor::new(Some(10.0), 20);
        frames(&mut g, 10, 20, 10.0, 120.0, None);
        assert_eq!((g.quality().iterations, g.quality().preview_scale), (FEWEST, 1));
        frames(&mut g, 20, 20, 10.0, 120.0, None);
        assert_eq!((g.quality().preview_scale, g.quality().held), (2, false));
        frames(&mut g, 100, 20, 1.0, 10.0, None);
        assert_eq!((g.quality().preview_scale, g.quality().iterations), (1, 20));
    }

    #[test]
    fn a_throttled_machine_gives_iterations_up_before_frames() {
        let mut g = Governor::new(Some(10.0), 20);
        frames(&mut g, 5, 20, 1.0, 10.0, Some("undervoltage"));
        assert_eq!(g.quality().reduced.as_deref(), Some("undervoltage: 10 of 20 iterations"));
        frames(&mut g, 50, 20, 1.0, 10.0, None);
        assert_eq!(g.quality().iterations, 20);
    }

    #[test]
    fn a_new_wish_counts_from_the_next_frame_on() {
        let mut g = Governor::new(Some(10.0), 20);
        frames(&mut g, 1, 5, 1.0, 10.0, None);
        assert_eq!(g.quality().iterations, 5);
        frames(&mut g, 1, 1, 1.0, 10.0, None);
        assert_eq!(g.quality().iterations, 1);
    }
}
