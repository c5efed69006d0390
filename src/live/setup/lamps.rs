//! Quick checks of the latest frames before a step is taken. The step itself judges more strictly, with all of its frames.

use serde::Serialize;

use super::figures::Figures;
use stokescope_core::calibrate::Step;

/// Covered sensors are even to this share of full scale, and darker than half of it.
const LIT: f32 = 0.01;
const BRIGHT: f32 = 0.5;
/// Signal below this share of full scale is too little; of a point source its brightest readings count.
const DIM: f32 = 0.02;
const DIM_POINT: f32 = 0.05;
/// Share of saturated readings that hot pixels explain.
const SATURATED: f32 = 0.002;
/// Share of the light that may be elsewhere than before: noise and flicker stay below it.
const MOVED: f32 = 0.03;
/// A point source lights less than this share of the frame.
const WIDE: f32 = 0.7;

/// A check of the latest frames.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(in crate::live) struct Lamp {
    /// Name of the problem.
    name: &'static str,
    /// Whether the problem is there.
    lit: bool,
    /// Value found; none where nothing can be told.
    found: Option<f32>,
    /// Value from which on the problem is there, or up to which it is there where too little is the problem.
    limit: f32,
}

fn above(name: &'static str, found: f32, limit: f32) -> Lamp {
    Lamp { name, lit: found > limit, found: Some(found), limit }
}

fn below(name: &'static str, found: f32, limit: f32) -> Lamp {
    Lamp { name, lit: found < limit, found: Some(found), limit }
}

fn moved(name: &'static str, figures: &Figures) -> Lamp {
    Lamp { name, lit: figures.moved.is_some_and(|share| share > MOVED), found: figures.moved, limit: MOVED }
}

/// Checks of a step. `black` is the level without light, a share of full scale.
pub(super) fn of(step: Step, raw: &Figures, guide: Option<&Figures>, black: f32) -> Vec<Lamp> {
    if step == Step::Dark {
        // unevenness tells light, and so does a median that no black level explains
        let light = if raw.median > BRIGHT { raw.median } else { raw.unevenness() };
        return vec![above("too bright", light, if raw.median > BRIGHT { BRIGHT } else { LIT })];
    }
    let mut lamps = vec![above("too bright", raw.saturated as f32, SATURATED)];
    lamps.push(match step {
        Step::Psf | Step::Verify => below("too dark", raw.bright - black, DIM_POINT),
        _ => below("too dark", raw.median - black, DIM),
    });
    lamps.push(moved("moved", raw));
    if step == Step::Psf {
        lamps.push(above("source too large", raw.lit(), WIDE));
    }
    if let Some(guide) = guide.filter(|_| step == Step::Align) {
        lamps.push(above("guide too bright", guide.saturated as f32, 0.05));
        lamps.push(below("guide too dark", guide.bright, DIM_POINT));
        lamps.push(moved("guide moved", guide));
    }
    lamps
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::live::setup::camera::tests::latest;
    use stokescope_core::image::Size;

    fn lit(step: Step, counts: impl Fn(usize, usize) -> f32) -> Vec<&'static str> {
        let size = Size::new(64, 64);
        let frame = latest(size, (0..size.pixels()).map(|i| counts(i % 64, i / 64)).collect());
        let lamps = of(step, &Figures::of(&frame, None), None, 100.0 / 4095.0);
        lamps.into_iter().filter(|lamp| lamp.lit).map(|lamp| lamp.name).collect()
    }

    #[test]
    fn every_lamp_goes_on_for_its_problem_and_off_without_it() {
        let spot =
            |reach: usize, level: f32| move |x: usize, y: usize| if x < reach && y < reach { level } else { 110.0 };
        assert!(lit(Step::Dark, |_, _| 110.0).is_empty());
        assert_eq!(lit(Step::Dark, spot(40, 900.0)), ["too bright"]);
        assert_eq!(lit(Step::Dark, |_, _| 3000.0), ["too bright"]);
        assert!(lit(Step::Mask, |_, _| 2000.0).is_empty());
        assert_eq!(lit(Step::Mask, |_, _| 120.0), ["too dark"]);
        assert_eq!(lit(Step::Mask, |_, _| 4095.0), ["too bright"]);
        assert!(lit(Step::Psf, spot(20, 2000.0)).is_empty());
        assert_eq!(lit(Step::Psf, spot(60, 2000.0)), ["source too large"]);
        assert_eq!(lit(Step::Psf, |_, _| 110.0), ["too dark"]);
        assert_eq!(lit(Step::Psf, spot(20, 4095.0)), ["too bright"]);
    }
}
