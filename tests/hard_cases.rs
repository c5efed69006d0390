//! Hard inputs of real captures: bad pixels, bad optics, bad guides, extreme polarization, noise, scale and shape.
//! Whatever comes in, results are finite, S0 ≥ 0 and |S1 + i·S2| ≤ S0.
#![allow(clippy::unwrap_used, reason = "a test")]

mod common;

use std::num::NonZeroUsize;
use std::sync::Arc;

use common::{Rig, assert_physical, map, relative_difference, s12_psnr, scaled, settings, spec};
use rand::{Rng, SeedableRng, rngs::StdRng};
use stokescope::bundle::Bundle;
use stokescope::camera::sim::{Flaws, Knowledge, SimSpec};
use stokescope::files::write_npy;
use stokescope_core::device::Device;
use stokescope_core::image::{Complex32, Size, Stack};
use stokescope_core::optics::{FftBackend, Psf, StokesOperator};
use stokescope_core::parallel::Workers;
use stokescope_core::pipeline::{Budget, FrameReport, Settings, Warning};
use stokescope_core::readings::Unit;
use stokescope_core::solve::{Method, Modelled};

const SIZE: Size = Size::new(64, 64);
const SPLITTING: [Method; 2] = [Method::Guided, Method::Stokes];

fn rig() -> Rig {
    Rig::new(spec("plastic", SIZE))
}

/// dB of S1 and S2 when no polarization is found at all.
/// The warnings as a person reads them.
fn sentences(report: &FrameReport) -> Vec<String> {
    report.warnings.iter().map(ToString::to_string).collect()
}

fn unpolarized_psnr(rig: &Rig) -> f64 {
    s12_psnr(&Stack::zeros(rig.truth.count(), rig.truth.size()), &rig.truth)
}

fn counts(rig: &Rig) -> Stack<f32> {
    let black = f32::from(rig.spec.black_level);
    let span = f32::from(rig.spec.saturation()) - black;
    map(&rig.raw, |v| (v * span + black).round())
}

#[test]
fn saturated_pixels_are_left_out_and_dead_ones_survived() {
    let rig = rig();
    let mut random = StdRng::seed_from_u64(7);
    let mut spoil = |share: f64, value: f32| map(&counts(&rig), |v| if random.random_bool(share) { value } else { v });
    let saturated = spoil(0.05, f32::from(rig.spec.saturation()));
    let dead = spoil(0.002, 0.0);
    for method in SPLITTING {
        let clean = s12_psnr(&rig.solve(method, 20).0, &rig.truth);
        let mut pipeline = rig.pipeline(method == Method::Guided, &settings(method, 20, 1));
        let guide = (method == Method::Guided).then_some(&rig.guide);
        let report =
            pipeline.process(saturated.view().in_unit(Unit::Counts), guide.map(Stack::view)).unwrap().into_report();
        assert!(report.warnings.iter().any(|w| matches!(w, Warning::Saturated { .. })), "{:?}", report.warnings);
        assert!((0.9..0.96).contains(&report.valid_fraction), "{}", report.valid_fraction);
        assert_physical(&pipeline.result().stokes, "saturated pixels");
        let psnr = s12_psnr(&pipeline.result().stokes, &rig.truth);
        println!("{method}: clean {clean:.2} dB, 5 % saturated {psnr:.2} dB");
        assert!(psnr > clean - 0.3, "{method}: {psnr:.2} dB, clean {clean:.2} dB");
        pipeline.process(dead.view().in_unit(Unit::Counts), guide.map(Stack::view)).unwrap();
        assert_physical(&pipeline.result().stokes, "dead pixels");
        println!("{method}: 0.2 % dead {:.2} dB", s12_psnr(&pipeline.result().stokes, &rig.truth));
    }
}

#[test]
fn a_raw_frame_without_an_image_gives_a_finite_one_and_a_warning() {
    let rig = rig();
    for (value, blank) in [(0.0, false), (-0.01, false), (0.3, true)] {
        let raw = map(&rig.raw, |_| value);
        for method in SPLITTING {
            let guide = (method == Method::Guided).then_some(&rig.guide);
            let (stokes, report) = rig.solve_frame(&raw, guide, method, 20);
            assert_physical(&stokes, &format!("{method}, raw {value}"));
            assert!(
                report.warnings.iter().any(|w| if blank {
                    matches!(w, Warning::Blank { .. })
                } else {
                    *w == Warning::Dark
                }),
                "{value}: {:?}",
                report.warnings
            );
            assert!(report.residual_rms.is_finite());
        }
    }
}

#[test]
fn a_hot_pixel_of_the_psf_does_no_harm_beyond_blur() {
    let mut rig = rig();
    let clean = s12_psnr(&rig.solve(Method::Guided, 20).0, &rig.truth);
    let mut psf = rig.spec.psf();
    let peak = psf.as_slice().iter().copied().fold(0.0, f32::max);
    psf.plane_mut(0)[5 * SIZE.width + 60] = peak;
    reload_psf(&mut rig, &psf);
    for method in SPLITTING {
        let (stokes, _) = rig.solve(method, 20);
        assert_physical(&stokes, "hot psf pixel");
        let psnr = s12_psnr(&stokes, &rig.truth);
        println!("{method}: hot pixel {psnr:.2} dB, clean guided {clean:.2} dB");
        assert!(method == Method::Stokes || psnr > clean - 3.0, "{psnr:.2} dB, clean {clean:.2} dB");
    }
}

#[test]
fn the_scale_of_the_psf_does_not_matter() {
    let mut rig = rig();
    let expected = SPLITTING.map(|method| rig.solve(method, 20).0);
    for scale in [1e6, 1e-6] {
        let psf = scaled(&rig.spec.psf(), scale);
        reload_psf(&mut rig, &psf);
        for (method, expected) in SPLITTING.iter().zip(&expected) {
            let difference = relative_difference(rig.solve(*method, 20).0.as_slice(), expected.as_slice());
            // Without a guide rounding is amplified more.
            let tolerated = if *method == Method::Stokes { 5e-4 } else { 1e-4 };
            assert!(difference < tolerated, "{method}, psf × {scale:e}: {difference:.1e}");
        }
    }
}

fn reload_psf(rig: &mut Rig, psf: &Stack<f32>) {
    write_npy(&rig.folder().join("psf.npy"), &[SIZE.height, SIZE.width], psf.as_slice()).unwrap();
    rig.calibration = Bundle::load(rig.folder()).unwrap();
}

#[test]
fn a_black_guide_is_said_and_done_without() {
    let rig = rig();
    let (unguided, _) = rig.solve(Method::Stokes, 20);
    for dark in [0.0, f32::NAN, -1.0] {
        let (stokes, report) = rig.solve_frame(&rig.raw, Some(&map(&rig.guide, |_| dark)), Method::Guided, 20);
        assert_eq!((report.method, report.gain.len()), (Method::Stokes, 0));
        assert!(report.warnings.iter().any(|w| w.to_string().contains("guide")), "{:?}", report.warnings);
        assert_eq!(stokes, unguided);
    }
}

#[test]
fn one_black_guide_does_not_end_guiding() {
    let rig = rig();
    let mut pipeline = rig.pipeline(true, &settings(Method::Guided, 20, 1));
    pipeline.process(rig.raw.view(), map(&rig.guide, |_| 0.0).view()).unwrap();
    let report = pipeline.process(rig.raw.view(), rig.guide.view()).unwrap().into_report();
    assert_eq!(report.method, Method::Guided, "{:?}", report.warnings);
}

#[test]
fn the_exposure_of_the_guide_does_not_matter() {
    let rig = rig();
    let (expected, report) = rig.solve(Method::Guided, 20);
    for exposure in [0.1, 40.0] {
        let (stokes, other) = rig.solve_frame(&rig.raw, Some(&scaled(&rig.guide, exposure)), Method::Guided, 20);
        let difference = relative_difference(stokes.as_slice(), expected.as_slice());
        assert!(difference < 1e-4, "guide × {exposure}: {difference:.1e}");
        assert!((other.gain[0] * exposure / report.gain[0] - 1.0).abs() < 1e-4);
    }
}

/// A guide of few levels, as encoders leave them, seems to have no noise, and has windows in which all values are equal.
#[test]
fn a_guide_of_few_levels_does_no_harm_beyond_its_rounding() {
    for scene in ["plastic", "spheres", "wedges", "tissue"] {
        let rig = Rig::new(spec(scene, Size::new(96, 96)));
        let clean = s12_psnr(&rig.solve(Method::Guided, 20).0, &rig.truth);
        let peak = rig.guide.as_slice().iter().copied().fold(0.0, f32::max);
        let mut coarse = rig.guide.clone();
        for c in 0..coarse.count() {
            coarse.plane_mut(c).copy_from_slice(rig.truth.plane(3 * c));
        }
        let coarse = map(&coarse, |v| (32.0 * v / peak).round() / 32.0 * peak);
        let (stokes, report) = rig.solve_frame(&rig.raw, Some(&coarse), Method::Guided, 20);
        assert_physical(&stokes, scene);
        let psnr = s12_psnr(&stokes, &rig.truth);
        println!("{scene}: {psnr:.2} dB, clean {clean:.2} dB");
        assert_eq!(report.method, Method::Guided, "{scene}: {:?}", report.warnings);
        assert!(psnr > clean - 1.0, "{scene}: {psnr:.2} dB, clean {clean:.2} dB");
    }
}

/// As large as some polarization, and too little for a smooth error to be told from it.
#[test]
fn five_percent_of_brightness_cost_next_to_nothing() {
    for scene in ["spheres", "tissue"] {
        let rig = Rig::new(spec(scene, Size::new(128, 128)));
        let clean = s12_psnr(&rig.solve(Method::Guided, 20).0, &rig.truth);
        let peak = rig.guide.as_slice().iter().copied().fold(0.0, f32::max);
        let bent = map(&rig.guide, |v| peak * (v.max(0.0) / peak).powf(1.05));
        for (what, guide) in [("γ 1.05", bent), ("vignetting of 5 %", vignetted(&rig.guide, 0.05))] {
            let psnr = s12_psnr(&rig.solve_frame(&rig.raw, Some(&guide), Method::Guided, 20).0, &rig.truth);
            println!("{scene}, {what}: {psnr:.2} dB, clean {clean:.2} dB");
            assert!(psnr > clean - 0.4, "{scene}, {what}: {psnr:.2} dB, clean {clean:.2} dB");
        }
    }
}

#[test]
fn wrong_guides_give_worse_images_but_physical_ones() {
    let rig = rig();
    let other = Rig::new(spec("spheres", SIZE)).guide;
    let clean = s12_psnr(&rig.solve(Method::Guided, 20).0, &rig.truth);
    let none = unpolarized_psnr(&rig);
    let clipped = map(&rig.guide, |v| (4.0 * v).min(1.0));
    let cases = [
        ("saturated everywhere", map(&rig.guide, |_| 1.0), None),
        ("clipped", clipped, None),
        ("blurred", blurred(&rig.guide, 3), Some(none + 1.0)),
        ("of another scene", other, None),
        (
            "with holes",
            map(&rig.guide, {
                let mut i = 0;
                move |v| {
                    i += 1;
                    if i % 17 == 0 { f32::NAN } else { v }
                }
            }),
            None,
        ),
    ];
    for (what, guide, least) in cases {
        let (stokes, report) = rig.solve_frame(&rig.raw, Some(&guide), Method::Guided, 20);
        assert_physical(&stokes, what);
        let psnr = s12_psnr(&stokes, &rig.truth);
        println!("guide {what}: {psnr:.2} dB, clean {clean:.2} dB, none {none:.2} dB, {:?}", sentences(&report));
        assert!(least.is_none_or(|least| psnr > least), "guide {what}: {psnr:.2} dB");
    }
}

#[test]
fn a_guide_of_wrong_brightness_is_corrected() {
    let rig = Rig::new(spec("plastic", Size::new(128, 128)));
    let clean = s12_psnr(&rig.solve(Method::Guided, 20).0, &rig.truth);
    let tone = |power: f32| map(&rig.guide, |v| 0.7 * v.max(0.0).powf(power));
    for (what, guide) in [("γ 1.3", tone(1.3)), ("γ 0.8", tone(0.8)), ("vignetting", vignetted(&rig.guide, 0.4))] {
        let (stokes, report) = rig.solve_frame(&rig.raw, Some(&guide), Method::Guided, 20);
        assert_physical(&stokes, what);
        let psnr = s12_psnr(&stokes, &rig.truth);
        println!("guide with {what}: {psnr:.2} dB, clean {clean:.2} dB");
        assert_eq!(report.method, Method::Guided, "{what}: {:?}", report.warnings);
        assert!(psnr > clean - 1.5, "guide with {what}: {psnr:.2} dB, clean {clean:.2} dB");
    }
}

#[test]
fn a_perfect_guide_is_left_alone_where_polarization_is_strong_and_fine() {
    for (scene, least) in [("plastic", 21.0), ("wedges", 24.5)] {
        let rig = Rig::new(spec(scene, Size::new(250, 250)));
        let psnr = s12_psnr(&rig.solve(Method::Guided, 20).0, &rig.truth);
        println!("{scene}: {psnr:.2} dB");
        assert!(psnr > least, "{scene}: {psnr:.2} dB");
    }
}

#[test]
fn a_guide_of_another_scene_is_said_and_done_without() {
    for (scene, other) in [("plastic", "spheres"), ("spheres", "tissue"), ("wedges", "plastic")] {
        let size = Size::new(128, 128);
        let rig = Rig::new(spec(scene, size));
        let guide = Rig::new(spec(other, size)).guide;
        let (stokes, report) = rig.solve_frame(&rig.raw, Some(&guide), Method::Guided, 20);
        assert_eq!(report.method, Method::Stokes, "{scene} with a guide of {other}");
        assert!(report.warnings.iter().any(|w| matches!(w, Warning::ForeignGuide { .. })), "{:?}", report.warnings);
        let (alone, _) = rig.solve(Method::Stokes, 20);
        assert_eq!(stokes, alone, "{scene} with a guide of {other}");
        let (_, report) = rig.solve(Method::Guided, 20);
        assert_eq!((report.method, report.warnings.len()), (Method::Guided, 0), "{scene}: {:?}", report.warnings);
    }
}

#[test]
fn the_iterations_of_a_frame_are_those_of_its_budget_whichever_solver_it_takes() {
    let size = Size::new(128, 128);
    let rig = Rig::new(spec("plastic", size));
    let other = Rig::new(spec("spheres", size)).guide;
    let mut pipeline = rig.pipeline(true, &settings(Method::Guided, 6, 1));
    // The second frame plans the solver without a guide, the third changes back, the fourth takes the one that waits.
    for (guide, method, n) in [
        (&rig.guide, Method::Guided, 4),
        (&other, Method::Stokes, 3),
        (&rig.guide, Method::Guided, 2),
        (&other, Method::Stokes, 5),
    ] {
        let budget = Budget { iterations: NonZeroUsize::new(n), ..Budget::default() };
        let report = pipeline.process_within(rig.raw.view(), guide.view(), budget).unwrap().into_report();
        assert_eq!((report.method, report.iterations), (method, n));
    }
    let report = pipeline.process(rig.raw.view(), other.view()).unwrap().into_report();
    assert_eq!((report.method, report.iterations), (Method::Stokes, 6), "those of the settings");
}

#[test]
fn a_guide_is_followed_from_frame_to_frame_and_searched_for_when_it_jumps() {
    let size = Size::new(128, 128);
    let rig = Rig::new(spec("plastic", size));
    let foreign = Rig::new(spec("spheres", size)).guide;
    let shifted = |by: usize| {
        let mut i = 0;
        map(&rig.guide, |_| {
            let (x, y) = (i % size.width, i / size.width);
            i += 1;
            rig.guide.plane(0)[y * size.width + x.saturating_sub(by)]
        })
    };
    let dimmed = scaled(&rig.guide, 0.5);
    // As before, of another exposure, moved by 1 and then 4 pixels, of another scene twice, and back.
    let guides =
        [&rig.guide, &rig.guide, &dimmed, &shifted(1), &shifted(5), &shifted(5), &foreign, &foreign, &rig.guide];
    let settings = Settings { register: true, ..settings(Method::Guided, 20, 1) };
    // Guides are followed in a video.
    let mut pipeline = rig.pipeline(true, &Settings { video: true, ..settings.clone() });
    for (k, guide) in guides.into_iter().enumerate() {
        let report = pipeline.process(rig.raw.view(), guide.view()).unwrap().into_report();
        let psnr = s12_psnr(&pipeline.result().stokes, &rig.truth);
        let mut fresh = rig.pipeline(true, &settings);
        let alone = fresh.process(rig.raw.view(), guide.view()).unwrap().into_report();
        let expected = s12_psnr(&fresh.result().stokes, &rig.truth);
        println!("frame {k}: {psnr:.2} dB, shift {:?}; alone {expected:.2} dB, {:?}", report.shift_px, alone.shift_px);
        assert_eq!(report.method, alone.method, "frame {k}: {:?}, {:?}", report.warnings, alone.warnings);
        assert!(psnr > expected - 0.2, "frame {k}: {psnr:.2} dB, alone {expected:.2} dB");
    }
}

/// Tones and shading that were found once serve the frames that follow, in spite of other exposures and a small step.
#[test]
fn a_bent_guide_is_followed_from_frame_to_frame() {
    let size = Size::new(128, 128);
    let rig = Rig::new(spec("spheres", size));
    let bent = vignetted(&map(&rig.guide, |v| v.max(0.0).powf(1.3)), 0.2);
    let brighter = scaled(&rig.raw, 1.5);
    let frames = [(&rig.raw, &bent), (&rig.raw, &bent), (&rig.raw, &scaled(&bent, 0.5)), (&brighter, &bent)];
    let settings = Settings { register: true, ..settings(Method::Guided, 20, 1) };
    let mut pipeline = rig.pipeline(true, &Settings { video: true, ..settings.clone() });
    for (k, (raw, guide)) in frames.into_iter().enumerate() {
        pipeline.process(raw.view(), guide.view()).unwrap();
        let followed = pipeline.result().stokes.clone();
        let mut fresh = rig.pipeline(true, &settings);
        fresh.process(raw.view(), guide.view()).unwrap();
        let s0 = relative_difference(followed.plane(0), fresh.result().stokes.plane(0));
        println!("frame {k}: S0 is that of a frame alone but for {s0:.1e}");
        assert!(s0 < 5e-3, "frame {k}: {s0:.1e}");
    }
}

fn grown(scene: &str, size: Size, drift: f32) -> Rig {
    Rig::new(SimSpec { flaws: Flaws { drift, ..Flaws::default() }, ..spec(scene, size) })
}

/// A diffuser that is further from the sensor than when it was calibrated, or nearer.
#[test]
fn a_psf_of_another_size_is_refitted() {
    for (scene, size, drift) in [("spheres", 128, 0.015), ("wedges", 128, 0.03), ("tissue", 250, 0.01)] {
        let size = Size::new(size, size);
        let rig = grown(scene, size, drift);
        let solve = |rig: &Rig, refit_psf: bool| {
            let mut pipeline = rig.pipeline(true, &Settings { refit_psf, ..settings(Method::Guided, 20, 1) });
            let report = pipeline.process(rig.raw.view(), rig.guide.view()).unwrap().into_report();
            assert_physical(&pipeline.result().stokes, scene);
            (s12_psnr(&pipeline.result().stokes, &rig.truth), report)
        };
        let ((as_calibrated, off), (refitted, on)) = (solve(&rig, false), solve(&rig, true));
        let mut known = grown(scene, size, drift);
        let exact = SimSpec { knowledge: Knowledge::Exact, ..rig.spec.clone() };
        known.calibration.device.psf = Psf::new(exact.psf(), size, 1).unwrap();
        let right = solve(&known, true);
        println!(
            "{scene}, PSF grown by {drift}: {as_calibrated:.2} dB, refitted by {} {refitted:.2} dB, known {:.2} dB",
            on.psf_scale - 1.0,
            right.0
        );
        assert_eq!((off.psf_scale, right.1.psf_scale, on.warnings.len()), (1.0, 1.0, 0), "{:?}", on.warnings);
        assert!((on.psf_scale - 1.0 - drift).abs() < 0.004, "{scene}: {} instead of {drift}", on.psf_scale - 1.0);
        // filaments thinner than a pixel cannot be resampled exactly
        assert!(refitted > as_calibrated + 1.0 && refitted > right.0 - 1.5, "{scene}: {refitted:.2} dB");
        // as much smaller
        let mut shrunk = Rig::new(spec(scene, size));
        shrunk.calibration.device.psf = shrunk.calibration.psf.scaled(f64::from(1.0 + drift));
        let found = solve(&shrunk, true).1.psf_scale;
        assert!((found * (1.0 + drift) - 1.0).abs() < 0.004, "{scene}: {found}");
    }
}

/// A guide with a square of another one in it.
fn partly(guide: &Stack<f32>, other: &Stack<f32>) -> Stack<f32> {
    let mut both = guide.clone();
    let size = guide.size();
    for y in size.height / 3..size.height * 2 / 3 {
        let row = y * size.width + size.width / 3..y * size.width + size.width * 2 / 3;
        both.plane_mut(0)[row.clone()].copy_from_slice(&other.plane(0)[row]);
    }
    both
}

#[test]
fn a_psf_that_is_right_is_left_alone() {
    let size = Size::new(128, 128);
    for (scene, other) in [("plastic", "wedges"), ("spheres", "tissue"), ("wedges", "spheres"), ("tissue", "plastic")] {
        let rig = Rig::new(spec(scene, size));
        let by = SimSpec { shift: [2.0, -1.5], ..rig.spec.clone() };
        for (what, guide) in [
            ("perfect", rig.guide.clone()),
            ("bent", map(&rig.guide, |v| v.max(0.0).powf(1.3))),
            ("vignetted", vignetted(&rig.guide, 0.3)),
            ("shifted", Rig::new(by).guide),
            ("partly another's", partly(&rig.guide, &Rig::new(spec(other, size)).guide)),
        ] {
            for register in [false, true] {
                let mut pipeline = rig.pipeline(true, &Settings { register, ..settings(Method::Guided, 5, 1) });
                let report = pipeline.process(rig.raw.view(), guide.view()).unwrap().into_report();
                assert_eq!(report.psf_scale, 1.0, "{scene}, {what} guide, register {register}");
                assert!(
                    !report
                        .warnings
                        .iter()
                        .any(|w| matches!(w, Warning::PsfOutOfRange { .. } | Warning::PsfNotFollowed { .. })),
                    "{scene}, {what}: {:?}",
                    report.warnings
                );
            }
        }
    }
}

#[test]
fn a_guide_that_is_off_is_reported_where_it_is_not_aligned() {
    let size = Size::new(128, 128);
    for scene in ["plastic", "spheres", "wedges", "tissue"] {
        let rig = Rig::new(spec(scene, size));
        let by = SimSpec { shift: [1.0, -0.8], ..rig.spec.clone() };
        for (what, guide, off) in [
            ("perfect", rig.guide.clone(), false),
            ("bent", map(&rig.guide, |v| v.max(0.0).powf(1.3)), false),
            ("vignetted", vignetted(&rig.guide, 0.3), false),
            ("shifted", Rig::new(by).guide, true),
        ] {
            for register in [false, true] {
                let mut pipeline = rig.pipeline(true, &Settings { register, ..settings(Method::Guided, 5, 1) });
                let report = pipeline.process(rig.raw.view(), guide.view()).unwrap().into_report();
                let found = report.warnings.iter().find_map(|w| match w {
                    Warning::MisplacedGuide { off } => Some(*off),
                    _ => None,
                });
                assert_eq!(found.is_some(), off && !register, "{scene}, {what}: {:?}", report.warnings);
                assert!(found.is_none_or(|[x, y]| (x - 1.0).hypot(y + 0.8) < 0.5), "{scene}: off by {found:?}");
            }
        }
    }
}

#[test]
fn a_psf_that_grows_in_a_video_is_followed_once() {
    let size = Size::new(128, 128);
    let (before, after) = (Rig::new(spec("spheres", size)), grown("spheres", size, 0.02));
    let mut pipeline =
        before.pipeline(true, &Settings { register: true, video: true, ..settings(Method::Guided, 20, 1) });
    let mut scales = Vec::new();
    // A look at every 64th frame tells.
    for rig in [&before; 40].into_iter().chain([&after; 30]) {
        let report = pipeline.process(rig.raw.view(), rig.guide.view()).unwrap().into_report();
        scales.push(report.psf_scale);
    }
    scales.dedup();
    assert!(scales.len() == 2 && scales[0] == 1.0 && (scales[1] - 1.02).abs() < 0.004, "{scales:?}");
    let fresh = after.solve(Method::Guided, 20).0;
    let (followed, alone) = (s12_psnr(&pipeline.result().stokes, &after.truth), s12_psnr(&fresh, &after.truth));
    assert!(followed > alone - 0.3, "{followed:.2} dB, alone {alone:.2} dB");
}

#[test]
fn a_psf_that_cannot_be_followed_is_said() {
    let size = Size::new(128, 128);
    let far = grown("spheres", size, 0.12);
    let (stokes, report) = far.solve(Method::Guided, 5);
    assert_physical(&stokes, "another diffuser");
    println!("{}: {:?}", report.psf_scale, sentences(&report));
    assert!(report.warnings.iter().any(|w| matches!(w, Warning::PsfOutOfRange { scale, .. } if *scale > 1.06)));
    let rig = grown("spheres", size, 0.02);
    let settings = settings(Method::Guided, 5, 1);
    let need: usize = rig.pipeline(true, &settings).stages().map(|(_, bytes)| bytes).sum();
    let mut tight = rig.pipeline(true, &Settings { memory_limit_bytes: need, ..settings });
    let report = tight.process(rig.raw.view(), rig.guide.view()).unwrap().into_report();
    assert_eq!(report.psf_scale, 1.0);
    let says = |w: &Warning| matches!(w, Warning::PsfNotFollowed { limit, .. } if *limit == need);
    assert!(report.warnings.iter().any(says), "{:?}", report.warnings);
}

#[test]
fn good_pixels_are_not_taken_for_dead_or_hot_ones() {
    for scene in ["plastic", "spheres", "wedges", "tissue"] {
        for read_noise in [0.0, 0.002, 0.02] {
            let rig = Rig::new(SimSpec { read_noise, ..spec(scene, Size::new(128, 128)) });
            let (_, report) = rig.solve(Method::Stokes, 1);
            assert!(
                !report.warnings.iter().any(|w| matches!(w, Warning::Defective { .. })),
                "{scene}: {:?}",
                report.warnings
            );
        }
    }
}

/// A frame that is darker towards its corners, by `amount` in them.
fn vignetted(frame: &Stack<f32>, amount: f32) -> Stack<f32> {
    let Size { width, height } = frame.size();
    let mut i = 0;
    map(frame, |v| {
        let (x, y) = (i % width, i / width % height);
        i += 1;
        let from_centre = |at: usize, n: usize| 2.0 * at as f32 / n as f32 - 1.0;
        v * (1.0 - 0.5 * amount * (from_centre(x, width).powi(2) + from_centre(y, height).powi(2)))
    })
}

/// Box mean over a square of 2·radius + 1, edges repeated.
fn blurred(frame: &Stack<f32>, radius: isize) -> Stack<f32> {
    let Size { width, height } = frame.size();
    let at = |y: isize, x: isize| {
        let clamp = |v: isize, n: usize| v.clamp(0, n as isize - 1) as usize;
        frame.plane(0)[clamp(y, height) * width + clamp(x, width)]
    };
    let mut i = 0;
    map(frame, |_| {
        let (y, x) = ((i / width) as isize, (i % width) as isize);
        i += 1;
        let offsets = || -radius..=radius;
        let sum: f32 = offsets().flat_map(|dy| offsets().map(move |dx| at(y + dy, x + dx))).sum();
        sum / ((2 * radius + 1) * (2 * radius + 1)) as f32
    })
}

/// A still scene whose light is polarized to the same degree everywhere, its angle turning across the frame.
fn uniform_scene(dolp: f32) -> (tempfile::TempDir, SimSpec) {
    let folder = tempfile::tempdir().unwrap();
    let mut angles = Stack::<f32>::zeros(4, SIZE);
    for i in 0..SIZE.pixels() {
        let (x, y) = ((i % SIZE.width) as f32, (i / SIZE.width) as f32);
        let s0 = 0.6 + 0.3 * (0.2 * x).sin() * (0.15 * y).cos();
        for p in 0..4 {
            let turn = 2.0 * (0.04 * x + 0.02 * y - std::f32::consts::FRAC_PI_4 * p as f32);
            angles.plane_mut(p)[i] = 0.5 * s0 * (1.0 + dolp * turn.cos());
        }
    }
    write_npy(&folder.path().join("angles.npy"), &[4, SIZE.height, SIZE.width], angles.as_slice()).unwrap();
    let spec = spec(folder.path().to_str().unwrap(), SIZE);
    (folder, spec)
}

#[test]
fn full_and_no_polarization_are_found() {
    for (dolp, guided, stokes) in [(0.0, 0.0..0.1, 0.0..0.3), (1.0, 0.85..1.0, 0.6..1.0)] {
        let (_folder, spec) = uniform_scene(dolp);
        let rig = Rig::new(spec);
        for (method, expected) in [(Method::Guided, guided), (Method::Stokes, stokes)] {
            let (stokes, report) = rig.solve(method, 60);
            assert_physical(&stokes, &format!("DoLP {dolp}"));
            println!("{method}: DoLP {dolp} found as {:?}", report.mean_dolp);
            assert!(expected.contains(&report.mean_dolp.unwrap()), "{method}: {dolp} found as {:?}", report.mean_dolp);
        }
    }
}

#[test]
fn polarization_is_not_modelled_where_the_readings_show_none_and_found_where_it_is_weak() {
    for (dolp, modelled, iterations, found) in
        [(0.0, Modelled::Nothing, 0, 0.0..=0.0), (0.01, Modelled::Polarized, 20, 0.005..=0.06)]
    {
        let (_folder, spec) = uniform_scene(dolp);
        for seed in 1..4 {
            let rig = Rig::new(SimSpec { seed, ..spec.clone() });
            let (stokes, report) = rig.solve(Method::Guided, 20);
            let what = format!("DoLP {dolp}, seed {seed}: {:?} because {}", report.modelled, report.why);
            assert_eq!((report.modelled, report.iterations), (modelled, iterations), "{what}");
            assert!(found.contains(&report.mean_dolp.unwrap()), "{what}; {:?} found", report.mean_dolp);
            assert_physical(&stokes, &what);
        }
    }
}

#[test]
fn a_mask_that_leaks_half_its_light_still_measures_polarization() {
    let mut rig = rig();
    rig.edit("stripes = 16", "stripes = 16\nextinction_ratio = 2");
    // The simulated mask is ideal; the leaking one is applied to the true image here.
    let workers = Arc::new(Workers::new(1));
    let Device { psf, response, .. } = &rig.calibration.device;
    let operator = &StokesOperator::for_channels(psf, response, 1, FftBackend::default(), workers).unwrap()[0];
    let mut scratch = operator.convolver.make_scratch();
    let (mut raw, mut polarized) = (Stack::zeros(1, SIZE), vec![0.0; SIZE.pixels()]);
    operator.forward_s0(rig.truth.plane(0), raw.plane_mut(0), &mut scratch);
    let l: Vec<_> =
        rig.truth.plane(1).iter().zip(rig.truth.plane(2)).map(|(re, im)| Complex32::new(*re, *im)).collect();
    operator.forward_polarized(&l, &mut polarized, &mut scratch);
    let mut random = StdRng::seed_from_u64(3);
    for (y, p) in raw.as_mut_slice().iter_mut().zip(&polarized) {
        *y += p + 0.002 * (random.random::<f32>() + random.random::<f32>() + random.random::<f32>() - 1.5) * 2.0;
    }
    for method in Method::ALL {
        let (stokes, _) = rig.solve_frame(&raw, (method == Method::Guided).then_some(&rig.guide), method, 20);
        assert!(stokes.as_slice().iter().all(|v| v.is_finite()), "{method}");
        if SPLITTING.contains(&method) {
            assert_physical(&stokes, "extinction ratio 2");
            let (psnr, none) = (s12_psnr(&stokes, &rig.truth), unpolarized_psnr(&rig));
            println!("{method}: extinction ratio 2 {psnr:.2} dB, none {none:.2} dB");
            assert!(psnr > none + 1.0, "{method}: {psnr:.2} dB, none {none:.2} dB");
        }
    }
}

#[test]
fn noise_20_db_above_the_calibration_is_not_fitted() {
    let mut rig = Rig::new(SimSpec { read_noise: 0.02, ..spec("plastic", SIZE) });
    rig.edit("read = 0.02", "read = 0.002");
    let none = unpolarized_psnr(&rig);
    for iterations in [20, 500] {
        for method in SPLITTING {
            let (stokes, _) = rig.solve(method, iterations);
            assert_physical(&stokes, "noise");
            let psnr = s12_psnr(&stokes, &rig.truth);
            println!("{method}: noise, {iterations} iterations {psnr:.2} dB, none {none:.2} dB");
            assert!(method == Method::Stokes || psnr > none, "{method}: {psnr:.2} dB, none {none:.2} dB");
        }
    }
}

#[test]
fn ten_thousand_iterations_do_not_drift() {
    let rig = Rig::new(spec("plastic", Size::new(48, 48)));
    for method in SPLITTING {
        let [thousand, many] = [1000, 10_000].map(|iterations| rig.solve(method, iterations).0);
        assert_physical(&many, "10 000 iterations");
        let difference = relative_difference(many.as_slice(), thousand.as_slice());
        println!("{method}: 10 000 iterations against 1000: {difference:.1e}");
        assert!(difference < 0.01, "{method}: {difference:.1e}");
    }
}

#[test]
fn results_scale_with_the_input() {
    // Behind a black level, values this large are refused as counts that are taken for fractions.
    let rig = Rig::new(SimSpec { black_level: 0, ..rig().spec.clone() });
    for method in SPLITTING {
        let (expected, _) = rig.solve(method, 20);
        for scale in [1e-6, 1e6] {
            let guide = scaled(&rig.guide, scale);
            let guide = (method == Method::Guided).then_some(&guide);
            let (stokes, report) = rig.solve_frame(&scaled(&rig.raw, scale), guide, method, 20);
            let difference = relative_difference(scaled(&stokes, scale.recip()).as_slice(), expected.as_slice());
            println!("{method} × {scale:e}: {difference:.1e}");
            assert!(difference < 1e-3, "{method} × {scale:e}: {difference:.1e}, {:?}", report.warnings);
        }
    }
}

#[test]
fn every_number_of_stripes_works() {
    for (angles, stripes) in [(4, SIZE.width), (3, SIZE.width), (4, 4), (3, 3), (4, 13)] {
        let rig = Rig::new(SimSpec { angles, stripes, ..spec("plastic", SIZE) });
        let none = unpolarized_psnr(&rig);
        for method in SPLITTING {
            let (stokes, _) = rig.solve(method, 20);
            let what = format!("{method}, {stripes} stripes, {angles} angles");
            assert_physical(&stokes, &what);
            let psnr = s12_psnr(&stokes, &rig.truth);
            println!("{what}: {psnr:.2} dB, none {none:.2} dB");
            assert!(method == Method::Stokes || psnr > none, "{what}: {psnr:.2} dB, none {none:.2} dB");
        }
    }
}

#[test]
fn every_size_works() {
    let sizes = [(16, 16), (17, 31), (61, 47), (47, 61), (128, 24), (24, 128), (64, 64), (250, 250), (512, 512)];
    for (width, height) in sizes {
        let size = Size::new(width, height);
        let rig = Rig::new(spec("plastic", size));
        let none = unpolarized_psnr(&rig);
        let (stokes, _) = rig.solve(Method::Guided, 5);
        assert_physical(&stokes, &size.to_string());
        let psnr = s12_psnr(&stokes, &rig.truth);
        println!("{size}: {psnr:.2} dB, none {none:.2} dB");
        assert!(width.min(height) < 64 || psnr > none + 1.0, "{size}: {psnr:.2} dB, none {none:.2} dB");
        if width * height < 10_000 {
            assert_physical(&rig.solve(Method::Stokes, 5).0, &size.to_string());
        }
    }
}

#[test]
fn every_method_takes_every_mask() {
    for (angles, color) in [(3, false), (4, false), (3, true), (4, true)] {
        let rig = Rig::new(SimSpec { angles, color, ..spec("spheres", Size::new(33, 32)) });
        for method in Method::ALL {
            let (stokes, report) = rig.solve(method, 10);
            assert_eq!((report.method, stokes.count()), (method, rig.truth.count()));
            assert!(stokes.as_slice().iter().all(|v| v.is_finite()), "{method}, {angles} angles, colour {color}");
        }
    }
}
