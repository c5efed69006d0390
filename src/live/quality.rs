//! Quality controller: holds a frame rate by running fewer iterations, then without the fusion model, then by drawing smaller
//! pictures, and reports what it gives up.

use std::time::Duration;

use parking_lot::Mutex;
use serde::Serialize;
use serde_json::json;

use super::events::Events;

/// Fewest iterations. A guided solve is already useful after these.
const FEWEST: usize = 2;
/// Fraction of the time between two frames that the work on one may take.
const SHARE: f32 = 0.9;
/// Weight of the newest frame in the means.
const NEWEST: f32 = 0.2;
/// Changes smaller than this fraction of the iterations are not made: pictures would flicker.
const STEP: f32 = 0.15;
/// Fraction of the target rate that counts as held: neither clocks nor schedulers are exact.
const NEARLY: f64 = 0.95;
/// Frames in a row that must be too slow, or quick enough, before pictures change their size.
const PATIENCE: u32 = 15;

/// Effort that frames are solved and drawn with.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct Quality {
    /// Frames per second to hold; none when no quality is given up for speed.
    pub(super) target_fps: Option<f64>,
    /// Iterations that the user asks for.
    pub(super) asked_iterations: usize,
    /// Iterations that run.
    pub(super) iterations: usize,
    /// Whether the fusion model, if there is one, is run.
    pub(super) fusion: bool,
    /// Side in pixels of the square that becomes one pixel of a picture.
    pub(super) preview_scale: usize,
    /// Quality that is given up, and the reason; none while all that the user asks for is done.
    pub(super) reduced: Option<String>,
    /// Whether the work on a frame takes no longer than the target allows. The cameras may be slower all the same.
    pub(super) keeps_up: bool,
}

/// The quality together with the frame rate that it leads to.
#[derive(Debug, Serialize)]
pub(super) struct Judged {
    #[serde(flatten)]
    quality: Quality,
    /// Frames per second of late; none before the second one.
    reached_fps: Option<f64>,
    /// Pictures per second that the slowest watcher took of late; none without one.
    shown_fps: Option<f64>,
    /// Whether the target is reached.
    pub(super) held: bool,
    /// Reason for missing the target; none while it is held.
    missed: Option<&'static str>,
}

impl Quality {
    /// Judges the recent results per second, and the pictures per second that the slowest watcher took, by the target.
    pub(super) fn judge(self, reached_fps: Option<f64>, shown_fps: Option<f64>) -> Judged {
        let enough = |rate: Option<f64>| {
            self.target_fps.zip(rate).map_or(self.keeps_up, |(target, rate)| rate >= NEARLY * target)
        };
        let (solved, shown) = (enough(reached_fps), shown_fps.is_none() || enough(shown_fps));
        let reason = match (solved, self.keeps_up) {
            (true, _) => "a watcher takes fewer pictures",
            (false, true) => "the cameras are slower",
            (false, false) => "the work on a frame takes longer",
        };
        let held = solved && shown;
        Judged { missed: (!held).then_some(reason), quality: self, reached_fps, shown_fps, held }
    }
}

/// Quality of the latest frame, shared between threads.
#[derive(Debug)]
pub(super) struct QualityStatus(Mutex<Quality>);

impl QualityStatus {
    pub(super) fn new(quality: Quality) -> Self {
        Self(Mutex::new(quality))
    }

    pub(super) fn get(&self) -> Quality {
        self.0.lock().clone()
    }

    /// Replaces the quality. Reports when something is given up that was not before, or nothing any more.
    pub(super) fn set(&self, quality: &Quality, events: &Events) {
        let mut now = self.0.lock();
        if *now == *quality {
            return;
        }
        let turned = now.reduced.is_some() != quality.reduced.is_some();
        now.clone_from(quality);
        drop(now);
        if turned {
            tracing::info!("quality: {}", quality.reduced.as_deref().unwrap_or("all that was asked for"));
            events.emit("quality", json!({ "reduced": quality.reduced, "keeps_up": quality.keeps_up }));
        }
    }
}

/// Chooses the quality of every frame from the times of those before.
#[derive(Debug)]
pub(super) struct Governor {
    /// Seconds between two frames of the target rate.
    period: Option<f32>,
    /// Mean seconds of an iteration.
    iteration: Option<f32>,
    /// Mean seconds of a frame beside its iterations.
    rest: f32,
    /// Seconds that the fusion model took when it ran last; 0 without one.
    fusion: f32,
    /// Frames in a row that were too slow at the fewest iterations (positive) or quick enough (negative).
    streak: i32,
    quality: Quality,
}

impl Governor {
    /// Holds `target_fps`. Without a target it chooses what the user asks for.
    pub(super) fn new(target_fps: Option<f64>, iterations: usize) -> Self {
        let quality = Quality {
            target_fps,
            asked_iterations: iterations,
            iterations,
            fusion: true,
            preview_scale: 1,
            reduced: None,
            keeps_up: true,
        };
        let period = target_fps.map(|fps| (1.0 / fps) as f32);
        Self { period, iteration: None, rest: 0.0, fusion: 0.0, streak: 0, quality }
    }

    /// Quality of the next frame.
    pub(super) fn quality(&self) -> &Quality {
        &self.quality
    }

    /// Learns from a frame and chooses the quality of the next one.
    ///
    /// The frame took `busy` altogether and `recon` of it in the solver, for `run` of the `asked` iterations; `run` may be below
    /// the quality's where a frame starts from the last result. `pressed` is the reason why the machine slows down, if it does:
    /// half of the iterations are given up then, before frames are lost.
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
        self.trade(wanted == fewest && busy > period, busy, 0.7 * period);
        self.quality.keeps_up = busy <= period || wanted > fewest;
        self.quality.reduced = self.reduced(pressed);
    }

    /// Quality that is given up of what the user asks for, in words; none when nothing is.
    fn reduced(&self, pressed: Option<&str>) -> Option<String> {
        let Quality { asked_iterations: asked, iterations, fusion, preview_scale, .. } = self.quality;
        let fewer = iterations < asked;
        let less = [
            fewer.then(|| format!("{iterations} of {asked} iterations")),
            (!fusion).then(|| "no fusion model".to_owned()),
            (preview_scale > 1).then(|| "pictures of half the size".to_owned()),
        ];
        let less: Vec<_> = less.into_iter().flatten().collect();
        let less = Some(less.join(" and ")).filter(|less| !less.is_empty())?;
        Some(match pressed {
            Some(why) if fewer => format!("{why}: {less}"),
            _ => format!("{less}, to hold the frame rate"),
        })
    }

    /// Notes the time that the fusion model took in a frame it ran for.
    pub(super) fn fused(&mut self, time: Duration) {
        self.fusion = time.as_secs_f32();
    }

    /// Gives up the fusion model, then the size of pictures, after too many slow frames in a row; takes them back after quick
    /// ones, in reverse order.
    fn trade(&mut self, too_slow: bool, busy: f32, quick: f32) {
        self.streak = match (too_slow, busy < quick) {
            (true, _) => self.streak.max(0) + 1,
            (_, true) => self.streak.min(0) - 1,
            _ => 0,
        };
        if self.streak.unsigned_abs() < PATIENCE {
            return;
        }
        let Quality { fusion, preview_scale, .. } = &mut self.quality;
        match (self.streak > 0, *preview_scale) {
            (true, _) if *fusion && self.fusion > 0.0 => *fusion = false,
            (true, _) => *preview_scale = 2,
            (false, 1) => *fusion |= busy + self.fusion < quick,
            (false, _) => *preview_scale = 1,
        }
        self.streak = 0;
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
        assert_eq!((g.quality().iterations, g.quality().reduced.as_deref(), g.quality().keeps_up), (20, None, true));
        let mut off = Governor::new(None, 20);
        frames(&mut off, 50, 20, 500.0, 20.0, None);
        assert_eq!(off.quality().iterations, 20);
    }

    #[test]
    fn a_slow_machine_runs_as_many_iterations_as_fit_and_says_so() {
        let mut g = Governor::new(Some(10.0), 20);
        frames(&mut g, 50, 20, 10.0, 17.0, None);
        let q = g.quality();
        assert_eq!((q.iterations, q.preview_scale, q.keeps_up), (7, 1, true));
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
        assert_eq!((g.quality().preview_scale, g.quality().keeps_up), (2, false));
        frames(&mut g, 100, 20, 1.0, 10.0, None);
        assert_eq!((g.quality().preview_scale, g.quality().iterations), (1, 20));
    }

    #[test]
    fn a_target_is_held_when_it_is_reached_and_slow_cameras_cost_no_quality() {
        let mut g = Governor::new(Some(10.0), 20);
        frames(&mut g, 50, 20, 2.0, 20.0, None);
        let judge = |g: &Governor, fps| g.quality().clone().judge(fps, None);
        assert!(judge(&g, Some(9.7)).held && judge(&g, None).held);
        let seen = |fps| g.quality().clone().judge(Some(9.7), Some(fps));
        assert!(seen(9.6).held && seen(2.9).missed == Some("a watcher takes fewer pictures"));
        let slow = judge(&g, Some(2.9));
        assert_eq!((slow.held, slow.missed), (false, Some("the cameras are slower")));
        assert_eq!((slow.quality.iterations, slow.quality.reduced), (20, None));
        frames(&mut g, 50, 20, 100.0, 120.0, None);
        assert_eq!(judge(&g, Some(2.9)).missed, Some("the work on a frame takes longer"));
        assert!(Governor::new(None, 20).quality().clone().judge(Some(0.1), Some(0.1)).held, "there is no target");
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

    #[test]
    fn the_fusion_model_goes_before_the_size_of_pictures_and_comes_back_where_it_fits() {
        let mut governor = Governor::new(Some(10.0), 10);
        let mut run = |frames: u32, busy: u64, fused: u64| {
            for _ in 0..frames {
                if governor.quality().fusion {
                    governor.fused(Duration::from_millis(fused));
                }
                let (busy, recon) = (Duration::from_millis(busy), Duration::from_millis(busy / 2));
                governor.learn(10, governor.quality().iterations, busy, recon, None);
            }
            (governor.quality().fusion, governor.quality().preview_scale, governor.quality().reduced.clone())
        };
        let (fusion, scale, reduced) = run(PATIENCE + 5, 400, 60);
        assert_eq!((fusion, scale), (false, 1));
        assert!(reduced.unwrap().contains("no fusion model"));
        assert_eq!(run(PATIENCE, 400, 60).1, 2, "then pictures");
        assert_eq!(run(PATIENCE + 5, 20, 60).1, 1, "pictures come back first");
        let (fusion, _, reduced) = run(2 * PATIENCE, 20, 60);
        assert!(!fusion && reduced.unwrap().starts_with("no fusion model"), "it would not fit");
        let (fusion, _, reduced) = run(2 * PATIENCE, 5, 60);
        assert!(fusion && reduced.is_none());
    }
}
