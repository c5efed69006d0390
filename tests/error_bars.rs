//! Standard errors of a result hold, also for frames whose readings were averaged.
#![allow(clippy::unwrap_used, reason = "a test")]

mod common;

use common::{Rig, map, spec};
use stokescope::camera::sim::SimSpec;
use stokescope_core::image::{Size, Stack};
use stokescope_core::pipeline::{FrameReport, Pipeline, Settings};

const SIZE: Size = Size::new(96, 96);
const NOISE: f32 = 0.01;

/// Noise of unit variance, nearly normal: the sum of twelve uniform numbers.
fn noise(state: &mut u64) -> f32 {
    let mut uniform = || {
        *state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (*state >> 40) as f32 / (1 << 24) as f32
    };
    (0..12).map(|_| uniform()).sum::<f32>() - 6.0
}

/// Share of the valid pixels whose S1 and S2 are within one standard error of the truth.
fn coverage(pipeline: &Pipeline, truth: &Stack<f32>) -> f64 {
    let result = pipeline.result();
    let near = |k: usize, i: usize| {
        let found = result.stokes.plane(k)[i] - truth.plane(k)[i];
        f64::from(u8::from(found.abs() < result.errors.plane(k)[i]))
    };
    let valid = (0..SIZE.pixels()).filter(|i| result.valid[*i]);
    let (sum, count) = valid.fold((0.0, 0.0), |(sum, n), i| (sum + near(1, i) + near(2, i), n + 2.0));
    sum / count
}

#[test]
fn errors_of_a_mean_are_smaller_and_hold() {
    let rig = Rig::new(SimSpec { read_noise: 0.0, ..spec("wedges", SIZE) });
    let mut pipeline = rig.pipeline(true, &Settings { video: true, threads: 1, ..Settings::default() });
    let mut state = 9;
    let mut frame = || -> (FrameReport, f64) {
        let raw = map(&rig.raw, |v| v + NOISE * noise(&mut state));
        let report = pipeline.process(raw.view(), rig.guide.view()).unwrap().into_report();
        (report, coverage(&pipeline, &rig.truth))
    };
    let (first, held) = frame();
    let (mean, mean_held) = (1..10).map(|_| frame()).last().unwrap();
    let [one, ten] = [&first, &mean].map(|report| report.errors.unwrap().polarization);
    println!("σ {one:.5} holds in {held:.3}, of {} frames {ten:.5} in {mean_held:.3}", mean.averaged);
    assert!(first.averaged == 1 && mean.averaged == 10, "{} and {}", first.averaged, mean.averaged);
    assert!(ten < 0.9 * one, "{ten} beside {one}");
    for held in [held, mean_held] {
        assert!((0.45..0.9).contains(&held), "{held} and {mean_held}");
    }
}
