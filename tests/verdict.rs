//! Wrong set-ups are named with their remedy, and right ones are not accused.
#![allow(clippy::unwrap_used, reason = "a test")]

mod common;

use common::{Rig, map, settings, spec};
use stokescope::camera::sim::SimSpec;
use stokescope_core::Mask;
use stokescope_core::device::Device;
use stokescope_core::diagnose::{Fault, Suspect, Turn, Verdict};
use stokescope_core::image::{Size, Stack};
use stokescope_core::optics::Psf;
use stokescope_core::pipeline::Pipeline;
use stokescope_core::solve::Method;

const SIZE: Size = Size::new(160, 160);
const ANGLES: [f64; 4] = [0.0, 45.0, 90.0, 135.0];

/// Verdict and suspects of one frame behind a device that may not be its own.
fn diagnose(device: &Device, raw: &Stack<f32>, guide: &Stack<f32>) -> (Verdict, Vec<Suspect>) {
    let mut pipeline = Pipeline::new(device, settings(Method::Guided, 20, 1)).unwrap();
    let report = pipeline.process(raw.view(), guide.view()).unwrap().into_report();
    let suspects = pipeline.diagnose(&report, guide.view()).unwrap();
    (suspects.iter().map(Suspect::verdict).fold(report.figures.verdict(), Verdict::max), suspects)
}

fn turned(image: &Stack<f32>, from: impl Fn(usize, usize) -> (usize, usize)) -> Stack<f32> {
    let Size { width, height } = image.size();
    let values = (0..width * height).map(|i| {
        let (x, y) = from(i % width, i / width);
        image.plane(0)[y * width + x]
    });
    Stack::from_vec(1, image.size(), values.collect()).unwrap()
}

#[test]
fn wrong_set_ups_are_doubtful_at_least_and_named() {
    let rig = Rig::new(spec("plastic", SIZE));
    let right: &Device = &rig.calibration;
    let with_psf = |psf: Stack<f32>| {
        let mut device = right.clone();
        device.psf = Psf::new(psf, SIZE, 1).unwrap();
        device
    };
    let with_mask = |degrees: &[f64], stripes: usize| {
        let mut device = right.clone();
        device.response = Mask::stripes(degrees, stripes).response(SIZE).unwrap();
        device
    };
    let psf = rig.spec.psf();
    let stripes = rig.spec.stripes;
    let transposed = with_psf(turned(&psf, |x, y| (y, x)));
    let mirrored = with_psf(turned(&psf, |x, y| (SIZE.width - 1 - x, y)));
    let cases = [
        (&transposed, Fault::PsfTurned(Turn::Transpose)),
        (&mirrored, Fault::PsfTurned(Turn::Mirror)),
        (&with_mask(&ANGLES, stripes / 2), Fault::Stripes { factor: 0.5 }),
        (&with_mask(&ANGLES, stripes * 2), Fault::Stripes { factor: 2.0 }),
    ];
    for (device, fault) in cases {
        let (verdict, suspects) = diagnose(device, &rig.raw, &rig.guide);
        assert!(
            verdict > Verdict::Credible && suspects.first().map(|s| s.fault) == Some(fault),
            "{fault:?}: {verdict}, {suspects:?}"
        );
    }
    for order in [[0.0, 90.0, 45.0, 135.0], [0.0, 45.0, 135.0, 90.0]] {
        let (verdict, suspects) = diagnose(&with_mask(&order, stripes), &rig.raw, &rig.guide);
        assert!(
            verdict > Verdict::Credible && matches!(suspects[0].fault, Fault::AngleOrder { .. }),
            "{order:?}: {verdict}, {suspects:?}"
        );
    }
}

#[test]
fn an_undeclared_black_level_is_named_and_light_from_beyond_is_not_taken_for_one() {
    let beyond = |scene: &str| SimSpec { surround: SimSpec::default().surround, ..spec(scene, SIZE) };
    for spec in [spec("plastic", SIZE), spec("spheres", SIZE), beyond("spheres"), beyond("wedges")] {
        let rig = Rig::new(spec);
        let (verdict, suspects) = diagnose(&rig.calibration, &rig.raw, &rig.guide);
        assert!(suspects.is_empty(), "{}: {verdict}, {suspects:?}", rig.spec.scene);
        let (verdict, suspects) = diagnose(&rig.calibration, &map(&rig.raw, |v| v + 0.05), &rig.guide);
        assert!(
            verdict > Verdict::Credible
                && matches!(suspects[0].fault, Fault::BlackLevel { level } if (0.03..0.07).contains(&level)),
            "{}: {verdict}, {suspects:?}",
            rig.spec.scene
        );
    }
}

#[test]
fn right_set_ups_are_credible() {
    for scene in ["plastic", "wedges"] {
        for (read_noise, shift) in [(0.0005, [0.0, 0.0]), (0.002, [2.0, -1.5]), (0.02, [0.0, 0.0])] {
            let rig = Rig::new(SimSpec { read_noise, shift, ..spec(scene, SIZE) });
            let (verdict, suspects) = diagnose(&rig.calibration, &rig.raw, &rig.guide);
            assert!(
                verdict == Verdict::Credible && suspects.is_empty(),
                "{scene}, {read_noise}: {verdict} {suspects:?}"
            );
        }
    }
}

/// A guide of three colours that a gray sensor weighs so: its red shows the scene, and its blue another one.
const SEEN: [f32; 3] = [0.9, 0.05, 0.05];

#[test]
fn colours_that_the_sensor_hardly_sees_do_not_make_the_guide_look_turned() {
    let rig = Rig::new(spec("plastic", SIZE));
    let half = |image: &Stack<f32>| turned(image, |x, y| (SIZE.width - 1 - x, SIZE.height - 1 - y));
    let other = half(&rig.guide);
    let red = rig.guide.as_slice().iter().zip(other.as_slice()).map(|(v, other)| (v - 0.1 * other).max(0.0) / SEEN[0]);
    let planes = red.chain(other.as_slice().iter().copied().chain(other.as_slice().iter().copied())).collect();
    let colours = Stack::from_vec(3, SIZE, planes).unwrap();
    let (verdict, suspects) = diagnose(&rig.calibration, &rig.raw, &colours);
    assert!(verdict == Verdict::Credible && suspects.is_empty(), "{verdict}, {suspects:?}");
    // A guide that is turned is named, in colours as in gray.
    let wrong = [1.0, 0.8, 0.6].into_iter().flat_map(|c| other.as_slice().iter().map(move |v| c * v)).collect();
    let wrong = Stack::from_vec(3, SIZE, wrong).unwrap();
    for guide in [&wrong, &other] {
        let (verdict, suspects) = diagnose(&rig.calibration, &rig.raw, guide);
        assert!(
            verdict > Verdict::Credible && suspects.first().map(|s| s.fault) == Some(Fault::GuideTurned(Turn::Half)),
            "{verdict}, {suspects:?}"
        );
    }
}
