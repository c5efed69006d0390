//! How good the solvers are on simulated captures, and how exactly they compute what they say they do.
#![allow(clippy::unwrap_used, reason = "a test")]

mod common;

use common::{Rig, relative_difference, s12_psnr, settings, spec};
use stokescope::camera::sim::{SCENES, SimSpec, Simulator};
use stokescope::files::write_npy;
use stokescope_core::image::{Size, Stack};
use stokescope_core::optics::{FftBackend, Margin};
use stokescope_core::pipeline::Settings;
use stokescope_core::solve::{Method, Modelled, WarmStart};

const SIZE: Size = Size::new(96, 96);

#[test]
fn guided_beats_the_guide_alone_and_the_unguided_solver_on_every_scene() {
    for (scene, _) in SCENES {
        // Below a DoLP of 0.2 a small frame tells the solver little: the usual size for this one.
        let size = if *scene == "tissue" { Size::new(250, 250) } else { SIZE };
        let rig = Rig::new(spec(scene, size));
        let guide_only = s12_psnr(&Stack::zeros(3, size), &rig.truth);
        let guided = s12_psnr(&rig.solve(Method::Guided, 20).0, &rig.truth);
        let stokes = s12_psnr(&rig.solve(Method::Stokes, 60).0, &rig.truth);
        println!("{scene}: S1, S2 of the guide alone {guide_only:.2} dB, stokes {stokes:.2} dB, guided {guided:.2} dB");
        assert!(guided > guide_only + 1.0, "{scene}: guided {guided:.2} dB, the guide alone {guide_only:.2} dB");
        assert!(guided > stokes, "{scene}: guided {guided:.2} dB, stokes {stokes:.2} dB");
    }
}

#[test]
fn more_iterations_do_not_hurt() {
    /// Loss allowed in dB: flat areas of full polarization (wedges) lose half a dB to the noise between 20 and 200.
    const TOLERATED: f64 = 0.6;
    for (scene, _) in SCENES {
        let rig = Rig::new(spec(scene, SIZE));
        let mut best = f64::NEG_INFINITY;
        for iterations in [5, 20, 60, 200] {
            let psnr = s12_psnr(&rig.solve(Method::Guided, iterations).0, &rig.truth);
            println!("{scene}: {iterations} iterations {psnr:.2} dB");
            assert!(psnr > best - TOLERATED, "{scene}: {iterations} iterations {psnr:.2} dB, fewer gave {best:.2} dB");
            best = best.max(psnr);
        }
    }
}

/// Normal noise of σ on top, from twelve uniforms.
fn noisy(frame: &Stack<f32>, sigma: f32, seed: &mut u32) -> Stack<f32> {
    let mut uniform = || {
        *seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (*seed >> 8) as f32 / (1 << 24) as f32
    };
    common::map(frame, |v| v + sigma * ((0..12).map(|_| uniform()).sum::<f32>() - 6.0))
}

#[test]
fn a_still_scene_costs_two_iterations_a_frame_and_a_changed_one_is_noticed() {
    let quiet = |scene| Rig::new(SimSpec { read_noise: 0.0, shot_noise: 0.0, guide_noise: 0.0, ..spec(scene, SIZE) });
    let (rig, other) = (quiet("spheres"), quiet("tissue"));
    let cold = settings(Method::Guided, 20, 1);
    let mut video = rig.pipeline(true, &Settings { video: true, ..cold.clone() });
    let mut alone = rig.pipeline(true, &cold);
    let mut seed = 1;
    let mut frame = |raw: &Stack<f32>, guide: &Stack<f32>| {
        let (raw, guide) = (noisy(raw, 0.002, &mut seed), noisy(guide, 0.005, &mut seed));
        let report = video.process(raw.view(), guide.view()).unwrap().into_report();
        alone.process(raw.view(), guide.view()).unwrap();
        let [psnr, by_itself] = [&video, &alone].map(|p| s12_psnr(&p.result().stokes, &rig.truth));
        println!("{} {}: {psnr:.2} dB, by itself {by_itself:.2} dB", report.course, report.iterations);
        (report.course, report.iterations, [psnr - by_itself, psnr])
    };
    let (course, iterations, [gained, _]) = frame(&rig.raw, &rig.guide);
    assert_eq!((course, iterations, gained), (WarmStart::Cold, 20, 0.0));
    let (mut gain, mut last) = (0.0, 0.0);
    for _ in 0..6 {
        let (course, iterations, [gained, psnr]) = frame(&rig.raw, &rig.guide);
        assert_eq!((course, iterations), (WarmStart::Still, 2));
        // A single frame may be as good by chance; the average gets better with every one.
        assert!(gained > -0.1 && psnr > last, "{gained}, {psnr} after {last}");
        (gain, last) = (gained, psnr);
    }
    assert!(gain > 0.3, "averaging gained {gain} dB");
    // Brighter by noise's σ in the mean, which no single reading shows.
    let brighter = common::map(&rig.raw, |v| v + 0.002);
    assert_eq!(frame(&brighter, &rig.guide).0, WarmStart::Moving);
    let mut guide = rig.guide.clone();
    for y in 40..50 {
        guide.as_mut_slice()[y * SIZE.width + 40..][..10].iter_mut().for_each(|v| *v += 0.1);
    }
    assert_eq!(frame(&brighter, &guide).0, WarmStart::Moving, "something new in the guide alone");
    assert_eq!(frame(&other.raw, &other.guide).0, WarmStart::Cold);
}

#[test]
fn six_iterations_on_the_last_frame_are_as_good_as_twenty_without() {
    /// dB that a frame may lose.
    const TOLERATED: f64 = 0.5;
    for (scene, frame_rate) in [("tissue", 5.0), ("wedges", 4.7), ("spheres", 10.0)] {
        let spec = SimSpec { frame_rate, ..spec(scene, Size::new(160, 160)) };
        let mut simulator = Simulator::new(spec.clone()).unwrap();
        let cold = settings(Method::Guided, 20, 1);
        let first = Rig::new(spec.clone());
        let mut video = first.pipeline(true, &Settings { video: true, ..cold.clone() });
        let mut alone = first.pipeline(true, &cold);
        for frame in 0..6 {
            let rig = Rig::of(spec.clone(), simulator.capture(frame));
            let report = video.process(rig.raw.view(), rig.guide.view()).unwrap().into_report();
            alone.process(rig.raw.view(), rig.guide.view()).unwrap();
            let [psnr, by_itself] = [&video, &alone].map(|p| s12_psnr(&p.result().stokes, &rig.truth));
            println!("{scene} {frame} {}: {psnr:.2} dB, by itself {by_itself:.2} dB", report.course);
            assert!(frame == 0 || report.iterations <= 6, "{report:?}");
            assert!(psnr > by_itself - TOLERATED, "{scene} {frame}: {psnr:.2} dB, by itself {by_itself:.2} dB");
        }
    }
}

#[test]
fn colours_that_share_one_polarization_are_solved_as_one_and_others_each() {
    let size = Size::new(128, 128);
    let colour = |scene| Rig::new(SimSpec { color: true, ..spec(scene, size) });
    let mut rig = colour("tissue");
    let (as_one, report) = rig.solve(Method::Guided, 20);
    assert_eq!(report.modelled, Modelled::Shared);
    common::assert_physical(&as_one, "as one");
    // A PSF for each channel keeps them apart, although they are alike.
    let psf = rig.spec.psf().as_slice().repeat(3);
    write_npy(&rig.folder().join("psf.npy"), &[3, size.height, size.width], &psf).unwrap();
    rig.edit("version = 1", "version = 1");
    let (each, report) = rig.solve(Method::Guided, 20);
    assert_eq!(report.modelled, Modelled::Polarized);
    let [as_one, each] = [as_one, each].map(|stokes| s12_psnr(&stokes, &rig.truth));
    println!("as one {as_one:.2} dB, each by itself {each:.2} dB");
    assert!(as_one > each + 0.4, "as one {as_one:.2} dB, each by itself {each:.2} dB");
    // Fringes of stressed plastic have colours of their own.
    assert_eq!(colour("plastic").solve(Method::Guided, 5).1.modelled, Modelled::Polarized);
}

#[test]
fn a_video_in_colour_goes_on_with_one_polarization_until_the_colours_differ() {
    let spec = SimSpec { color: true, frame_rate: 5.0, ..spec("tissue", Size::new(128, 128)) };
    let mut simulator = Simulator::new(spec.clone()).unwrap();
    let cold = settings(Method::Guided, 20, 1);
    let first = Rig::new(spec.clone());
    let mut video = first.pipeline(true, &Settings { video: true, ..cold.clone() });
    let mut alone = first.pipeline(true, &cold);
    let mut rig = None;
    for frame in 0..4 {
        let rig = rig.insert(Rig::of(spec.clone(), simulator.capture(frame)));
        let report = video.process(rig.raw.view(), rig.guide.view()).unwrap().into_report();
        alone.process(rig.raw.view(), rig.guide.view()).unwrap();
        let [psnr, by_itself] = [&video, &alone].map(|p| s12_psnr(&p.result().stokes, &rig.truth));
        println!("{frame} {}: {psnr:.2} dB, by itself {by_itself:.2} dB", report.course);
        assert_eq!(report.modelled, Modelled::Shared);
        assert_eq!(report.course, if frame == 0 { WarmStart::Cold } else { WarmStart::Moving });
        assert!(psnr > by_itself - 0.5, "{frame}: {psnr:.2} dB, by itself {by_itself:.2} dB");
    }
    let Rig { raw, guide, .. } = rig.unwrap();
    let still = video.process(raw.view(), guide.view()).unwrap().into_report();
    assert_eq!((still.modelled, still.course, still.iterations), (Modelled::Shared, WarmStart::Still, 2));
    let n = spec.size.pixels();
    let mut differ = raw.clone();
    differ.as_mut_slice()[..n]
        .iter_mut()
        .enumerate()
        .for_each(|(i, v)| *v *= 1.0 + 0.1 * (0.2 * (i % 128) as f32).sin());
    let other = video.process(differ.view(), guide.view()).unwrap().into_report();
    assert_eq!((other.modelled, other.course, other.iterations), (Modelled::Polarized, WarmStart::Cold, 20));
    let after = video.process(differ.view(), guide.view()).unwrap().into_report();
    assert_eq!((after.modelled, after.course), (Modelled::Polarized, WarmStart::Still));
}

/// The angle solver once more, in f64 and by the definitions: sums instead of Fourier transforms.
mod oracle {
    use stokescope_core::image::Size;

    /// λ of TV and the share of it along the polarization axis.
    const LAMBDA: f64 = 1.5e-5;
    const POLARIZATION_WEIGHT: f64 = 0.5;

    pub(super) struct Camera<'a> {
        pub(super) size: Size,
        pub(super) psf: &'a [f32],
        pub(super) angles: usize,
        pub(super) stripes: usize,
    }

    impl Camera<'_> {
        /// Calls `pair(sensor pixel, scene pixel, weight, angle number at the sensor pixel)` for all pairs that see one another.
        fn visit(&self, mut pair: impl FnMut(usize, usize, f64, usize)) {
            let Size { width, height } = self.size;
            for (d, k) in self.psf.iter().enumerate().filter(|(_, k)| **k > 0.0) {
                let (dy, dx) =
                    ((d / width) as isize - (height / 2) as isize, (d % width) as isize - (width / 2) as isize);
                for y in 0..height {
                    let Some(from_y) = y.checked_add_signed(-dy).filter(|v| *v < height) else { continue };
                    for x in 0..width {
                        let Some(from_x) = x.checked_add_signed(-dx).filter(|v| *v < width) else { continue };
                        let angle = x * self.stripes / width % self.angles;
                        pair(y * width + x, from_y * width + from_x, f64::from(*k), angle);
                    }
                }
            }
        }

        fn forward(&self, x: &[f64]) -> Vec<f64> {
            let n = self.size.pixels();
            let mut y = vec![0.0; n];
            self.visit(|to, from, k, angle| y[to] += k * x[angle * n + from]);
            y
        }

        fn adjoint(&self, r: &[f64]) -> Vec<f64> {
            let n = self.size.pixels();
            let mut x = vec![0.0; self.angles * n];
            self.visit(|to, from, k, angle| x[angle * n + from] += k * r[to]);
            x
        }

        /// ‖A‖² by the solver's own rule, which stops early and adds 2 %.
        fn norm_squared(&self) -> f64 {
            let mut seed = 0x2545_F491_4F6C_DD1Du64;
            let mut x: Vec<f64> = (0..self.angles * self.size.pixels())
                .map(|_| {
                    seed ^= seed << 13;
                    seed ^= seed >> 7;
                    seed ^= seed << 17;
                    1.0 + (seed >> 40) as f64 / (1u64 << 24) as f64
                })
                .collect();
            let norm = |x: &[f64]| x.iter().map(|v| v * v).sum::<f64>().sqrt();
            let mut estimate = 0.0f64;
            for _ in 0..60 {
                let length = norm(&x);
                x.iter_mut().for_each(|v| *v /= length);
                x = self.adjoint(&self.forward(&x));
                let last = std::mem::replace(&mut estimate, norm(&x));
                if (estimate - last).abs() <= 1e-4 * estimate {
                    break;
                }
            }
            1.02 * estimate
        }

        /// x plus, along each of the three axes, a twelfth of what flows in from the next value less what flows out to the
        /// last: differences clipped at twelve thresholds.
        fn smooth(&self, x: &[f64], step: f64) -> Vec<f64> {
            let Size { width, height } = self.size;
            let clip = |v: f64, share: f64| v.clamp(-12.0 * step * LAMBDA * share, 12.0 * step * LAMBDA * share);
            let axes = [(self.angles, width * height, POLARIZATION_WEIGHT), (height, width, 1.0), (width, 1, 1.0)];
            let flow = |i: usize| {
                axes.iter().map(move |&(count, stride, share)| {
                    let at = i / stride % count;
                    let along = |to: usize| x[i - at * stride + to % count * stride];
                    clip(along(at + 1) - x[i], share) - clip(x[i] - along(at + count - 1), share)
                })
            };
            (0..x.len()).map(|i| x[i] + flow(i).sum::<f64>() / 12.0).collect()
        }

        pub(super) fn fista(&self, y: &[f32], iterations: usize) -> Vec<f64> {
            let step = 1.0 / self.norm_squared();
            let mut x = vec![0.0; self.angles * self.size.pixels()];
            let (mut z, mut t) = (x.clone(), 1.0f64);
            for _ in 0..iterations {
                let residual: Vec<f64> = self.forward(&z).iter().zip(y).map(|(a, y)| a - f64::from(*y)).collect();
                let gradient = self.adjoint(&residual);
                let v: Vec<f64> = z.iter().zip(&gradient).map(|(z, g)| z - step * g).collect();
                let next: Vec<f64> = self.smooth(&v, step).iter().map(|v| v.max(0.0)).collect();
                let t_next = 0.5 * (1.0 + (1.0 + 4.0 * t * t).sqrt());
                let beta = (t - 1.0) / t_next;
                z = next.iter().zip(&x).map(|(new, old)| new + beta * (new - old)).collect();
                (x, t) = (next, t_next);
            }
            x
        }
    }
}

#[test]
fn fista_is_what_its_definition_gives_in_f64() {
    for angles in [3, 4] {
        let mut spec = spec("spheres", Size::new(32, 32));
        (spec.angles, spec.stripes) = (angles, 8);
        let mut rig = Rig::new(spec);
        rig.calibration.device.margin = Margin::default();
        let psf = rig.calibration.psf.channel(0);
        let camera = oracle::Camera { size: rig.spec.size, psf, angles, stripes: 8 };
        let expected: Vec<f32> = camera.fista(rig.raw.as_slice(), 50).iter().map(|v| *v as f32).collect();
        let mut pipeline = rig.pipeline(false, &settings(Method::Fista, 50, 1));
        pipeline.process(rig.raw.view(), None).unwrap();
        let found = pipeline.result().angles.as_ref().unwrap();
        let difference = relative_difference(found.as_slice(), &expected);
        println!("{angles} angles: f32 against f64 {difference:.1e}");
        assert!(difference < 1e-3, "{angles} angles: {difference:.1e}");
    }
}

#[test]
fn guided_gives_the_same_bits_again() {
    let rig = Rig::new(spec("plastic", SIZE));
    let settings = settings(Method::Guided, 20, 2);
    let mut pipeline = rig.pipeline(true, &settings);
    let runs = [(); 2].map(|()| {
        pipeline.process(rig.raw.view(), rig.guide.view()).unwrap();
        pipeline.result().stokes.clone()
    });
    assert_eq!(runs[0], runs[1], "a used pipeline");
    let mut fresh = rig.pipeline(true, &settings);
    fresh.process(rig.raw.view(), rig.guide.view()).unwrap();

    assert_eq!(runs[0], fresh.result().stokes, "a fresh pipeline");
}

#[test]
fn the_number_of_threads_does_not_matter() {
    let rig = Rig::new(spec("plastic", Size::new(96, 80)));
    for (method, iterations) in [(Method::Guided, 20), (Method::Stokes, 20), (Method::Fista, 20)] {
        let runs = [1, 2, 3].map(|threads| solve(&rig, &settings(method, iterations, threads)));
        for run in &runs[1..] {
            let difference = relative_difference(run.as_slice(), runs[0].as_slice());
            println!("{method}: {difference:.1e}");
            // Sums begin anew in each thread's band of rows, so that the last bits differ.
            assert!(difference < 1e-4, "{method}: {difference:.1e}");
        }
    }
}

#[test]
fn every_fft_gives_the_same_images() {
    // Of this size all pad to 128: the splitting methods solve on the padded circle, so that its length is part of them.
    let mut same = Rig::new(spec("plastic", Size::new(100, 100)));
    let mut differ = Rig::new(spec("plastic", Size::new(96, 80)));
    [&mut same, &mut differ].into_iter().for_each(|rig| rig.calibration.device.margin = Margin::default());
    for (method, iterations) in [(Method::Guided, 20), (Method::Stokes, 20), (Method::Fista, 50), (Method::Admm, 20)] {
        let runs = |rig| FftBackend::ALL.map(|fft| solve(rig, &Settings { fft, ..settings(method, iterations, 1) }));
        let [batched, others @ ..] = runs(&same);
        for other in others {
            let difference = relative_difference(other.as_slice(), batched.as_slice());
            println!("{method}: {difference:.1e}");
            // Without a guide S0 and L compete for the same readings, which amplifies rounding.
            let tolerated = if method == Method::Stokes { 5e-4 } else { 1e-4 };
            assert!(difference < tolerated, "{method}: {difference:.1e}");
        }
        let [batched, others @ ..] = runs(&differ).map(|stokes| s12_psnr(&stokes, &differ.truth));
        for other in others {
            println!("{method}: padded as each likes, {batched:.2} dB and {other:.2} dB");
            assert!((batched - other).abs() < 0.3, "{method}: {batched:.2} dB, {other:.2} dB");
        }
    }
}

fn solve(rig: &Rig, settings: &Settings) -> Stack<f32> {
    let guided = settings.method == Some(Method::Guided);
    let mut pipeline = rig.pipeline(guided, settings);
    pipeline.process(rig.raw.view(), guided.then_some(&rig.guide).map(Stack::view)).unwrap();
    pipeline.result().stokes.clone()
}
