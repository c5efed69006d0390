//! Tracking of a guide in a video. The next guide is expected to lie and to shine as the last one; a look of six convolutions a
//! channel (`fit.rs`) checks that. A small shift is corrected; any other contradiction asks for a search.

use nalgebra::Matrix2;

use super::Agreement;
use super::fit::{Frame, Glance};
use super::parallax::Shifts;
use super::radiometry::Curve;
use super::register::{AFFINE_SIGNIFICANT, Found, Parameters, SIGNIFICANT, affine_hint, erroneous, is_little};

/// The rest may be this many times what it was when the guide was searched for.
const GROWN: f64 = 1.5;
/// Longest step that is taken without a search, in pixels.
const STEP: f64 = 0.75;
/// Largest relative change of the gain, exposures apart.
const CHANGED: f64 = 0.2;
/// Frames between two checks that are not made in every frame.
const TURN: u32 = 16;
/// Frames between two checks of what changes slowly.
const SLOW_TURN: u32 = 64;

/// Knowledge of a guide from earlier frames.
#[derive(Clone, Copy, Debug)]
pub(super) struct Track {
    /// Position of its content against the scene.
    pub(super) lies: Parameters,
    pub(super) agreement: Agreement,
    /// Correction of its brightness in each channel, or the number of passes that solve for a smooth error of it in every frame.
    pub(super) curves: [Curve; 3],
    pub(super) smooth: usize,
    /// Local shifts of its content.
    pub(super) shifts: Option<Shifts>,
    /// Share of the square of each channel's blurred guide that L does not explain.
    pub(super) shares: [f64; 3],
    /// Sum of squares left, in units of the noise's.
    level: f64,
    /// Normal matrix of a shift, and what was there to move.
    hessian: Matrix2<f64>,
    moving: f64,
    /// Sensor units per guide unit, the guide's mean as placed and that of the readings.
    gains: [f32; 3],
    brightness: [f32; 3],
    reading: f32,
    /// Frames since the search.
    age: u32,
}

/// Result of a look, all channels together.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Look {
    rest: f64,
    smooth: f64,
    slope: Parameters,
    moments: [f64; 6],
    /// Largest relative change of a gain.
    change: f64,
}

impl Look {
    /// Adds a channel, whose guide has these [`super::fit::moments`].
    pub(super) fn add(&mut self, glance: &Glance, moments: &[f64; 6]) {
        self.rest += glance.rest;
        self.smooth += glance.smooth;
        self.slope += Parameters::from(glance.slopes);
        self.moments.iter_mut().zip(moments).for_each(|(all, m)| *all += m);
        self.change = if glance.gain.is_nan() { f64::INFINITY } else { self.change.max((glance.gain - 1.0).abs()) };
    }
}

impl Track {
    /// After a search in a frame whose noise has the sum of squares `noise`.
    pub(super) fn new(
        lies: Parameters,
        agreement: Agreement,
        found: &Found,
        gains: [f32; 3],
        brightness: [f32; 3],
        reading: f32,
        noise: f64,
    ) -> Self {
        Self {
            lies,
            agreement,
            curves: Default::default(),
            smooth: 0,
            shifts: None,
            shares: found.fit.shares,
            level: found.fit.polarized / noise,
            hessian: found.hessian,
            moving: found.moving,
            gains,
            brightness,
            reading,
            age: 0,
        }
    }

    /// True if it may be followed without a search for now.
    pub(super) fn is_fresh(&self) -> bool {
        self.age < TURN || !(self.agreement.foreign || self.agreement.corrected)
    }

    /// True if checks that are not made in every frame are due.
    pub(super) fn is_turn(&self) -> bool {
        self.age % TURN == TURN - 1
    }

    /// Sum of squares left of the readings of `frame`, in which the guide was searched for.
    pub(super) fn rest(&self, frame: &Frame<'_>) -> f64 {
        self.level * frame.noise * frame.trusted
    }

    /// Curvature of the readings under a shift, over that of the guide's own gradients.
    pub(super) fn moves(&self) -> f64 {
        self.hessian.trace() / self.moving
    }

    /// True if checks of what changes slowly are due: the PSF's size, and local shifts.
    pub(super) fn is_slow_turn(&self) -> bool {
        self.age % SLOW_TURN == SLOW_TURN - 1
    }

    /// Counts a frame.
    pub(super) fn look(&mut self) {
        self.age = self.age.wrapping_add(1);
    }

    /// Brightness of a frame of mean `reading` over the last one's.
    pub(super) fn exposure(&self, reading: f32) -> f32 {
        let ratio = reading / self.reading;
        if ratio.is_finite() && ratio > 0.0 { ratio } else { 1.0 }
    }

    /// The gains of a guide of mean `brightness`.
    pub(super) fn expected_gains(&self, exposure: f32, brightness: &[f32; 3]) -> [f32; 3] {
        std::array::from_fn(|c| self.gains[c] * exposure * self.brightness[c] / brightness[c].max(f32::MIN_POSITIVE))
    }

    /// Takes over a frame's gains.
    pub(super) fn remember(&mut self, gains: [f32; 3], brightness: [f32; 3], reading: f32) {
        (self.gains, self.brightness, self.reading) = (gains, brightness, reading);
    }

    /// The shift that is to be made up for, mostly none at all; no answer where a search is due.
    pub(super) fn judge(&self, look: &Look, frame: &Frame<'_>) -> Option<Parameters> {
        let noise = frame.noise * frame.trusted;
        let variance = look.rest / frame.trusted;
        let same = look.rest <= GROWN * self.level * noise
            && (look.smooth <= erroneous(frame) * variance || is_little(look.smooth, look.rest - noise))
            && look.change <= CHANGED;
        let hessian = self.hessian * (look.moments[0] / self.moving);
        let affine = affine_hint(hessian, &look.moments, &look.slope) <= AFFINE_SIGNIFICANT * variance;
        if !(same && affine) {
            return None;
        }
        let slope = look.slope.fixed_rows::<2>(0).into_owned();
        let Some(step) = hessian.cholesky().map(|h| h.solve(&slope)) else { return Some(Parameters::zeros()) };
        let mut change = Parameters::zeros();
        if step.dot(&slope) > SIGNIFICANT * variance {
            if step.norm() > STEP {
                return None;
            }
            change.fixed_rows_mut::<2>(0).copy_from(&step);
        }
        Some(change)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::{Size, Stack};

    const AGREEMENT: Agreement = Agreement {
        foreign: false,
        detail: 1.0,
        uncertainty: 0.1,
        corrected: false,
        hidden: 0.0,
        off: [0.0; 2],
        dim_margin: 0.0,
    };

    fn track(agreement: Agreement) -> Track {
        Track {
            lies: Parameters::zeros(),
            agreement,
            curves: Default::default(),
            smooth: 0,
            shifts: None,
            shares: [1.0; 3],
            level: 1.0,
            hessian: Matrix2::identity() * 1e4,
            moving: 1.0,
            gains: [2.0; 3],
            brightness: [0.5; 3],
            reading: 0.2,
            age: 0,
        }
    }

    /// Judges a look that leaves only noise, 100 readings of variance 1, after `change`.
    fn judge(change: impl FnOnce(&mut Look)) -> Option<Parameters> {
        let weight = Stack::zeros(1, Size::new(10, 10));
        let frame = Frame { operators: &[], coarse: &[], weight: &weight, trusted: 100.0, noise: 1.0, beyond: None };
        let third = 1.0 / 3.0;
        let mut look = Look { rest: 100.0, moments: [1.0, 0.0, 0.0, third, 0.0, third], ..Look::default() };
        change(&mut look);
        track(AGREEMENT).judge(&look, &frame)
    }

    #[test]
    fn a_small_shift_is_made_up_for_and_everything_else_asks_for_a_search() {
        assert_eq!(judge(|_| ()), Some(Parameters::zeros()));
        assert_eq!(judge(|look| look.slope[0] = 700.0), Some(Parameters::zeros()), "0.07 px are not significant");
        let step = judge(|look| look.slope[0] = 5000.0).unwrap();
        assert!((step[0] - 0.5).abs() < 1e-12 && step[1] == 0.0);
        assert_eq!(judge(|look| look.slope[1] = 10_000.0), None, "a jump");
        assert_eq!(judge(|look| look.slope[3] = 5000.0), None, "a turn");
        assert_eq!(judge(|look| look.rest = 160.0), None, "a worse fit");
        assert_eq!(judge(|look| look.smooth = 1.0), None, "an error of brightness");
        assert_eq!(judge(|look| look.change = 0.3), None, "another gain");
        assert_eq!(judge(|look| look.rest = f64::NAN), None);
    }

    #[test]
    fn gains_follow_both_exposures() {
        let track = track(AGREEMENT);
        assert_eq!(track.expected_gains(track.exposure(0.2), &[0.5; 3]), [2.0; 3]);
        assert_eq!(track.expected_gains(track.exposure(0.1), &[0.25; 3]), [2.0; 3]);
        assert_eq!(track.expected_gains(track.exposure(0.2), &[0.25; 3]), [4.0; 3]);
        assert_eq!(track.exposure(f32::NAN), 1.0);
    }

    #[test]
    fn what_a_look_does_not_tell_is_searched_for_now_and_then() {
        for (agreement, forever) in [(AGREEMENT, true), (Agreement { foreign: true, ..AGREEMENT }, false)] {
            let mut track = track(agreement);
            (0..TURN).for_each(|_| track.look());
            assert_eq!(track.is_fresh(), forever);
        }
    }
}
