//! Rounding, conditioning and scale. Every test prints its table; `scripts/stability.sh` runs all of them, those that take
//! minutes included, and puts the tables into `docs/stability.md`.
#![allow(clippy::print_stdout, reason = "tables for docs/stability.md")]
#![allow(clippy::unwrap_used, reason = "a test")]

mod common;
mod twin;

use std::sync::Arc;
use std::time::Instant;

use common::{Rig, assert_physical, map, relative_difference, s12_psnr, scaled, settings, spec};
use rand::{Rng, SeedableRng, rngs::StdRng};
use rand_distr::StandardNormal;
use stokescope::camera::sim::SimSpec;
use stokescope_core::image::{Complex32, Size, Stack};
use stokescope_core::optics::{Coarse, FftBackend, Psf, Response, StokesOperator};
use stokescope_core::parallel::Workers;
use stokescope_core::polarization::Angle;
use stokescope_core::solve::{Input, Method, Outcome, Plan, Spec};
use twin::Twin;

const SIZE: Size = Size::new(64, 64);
const SPLITTING: [Method; 2] = [Method::Guided, Method::Stokes];
const NOISE: f32 = 0.002;

/// Prints a table at the start of a line, so that it can be told from what the test runner prints.
fn table(title: &str, header: &[&str], rows: &[Vec<String>]) {
    let line = |cells: &[&str]| format!("| {} |\n", cells.join(" | "));
    let rows: String = rows.iter().map(|row| line(&row.iter().map(String::as_str).collect::<Vec<_>>())).collect();
    println!("\n### {title}\n\n{}|{}\n{rows}", line(header), "---|".repeat(header.len()));
}

fn operator(psf: &Psf, response: &Response) -> StokesOperator {
    let workers = Arc::new(Workers::new(1));
    StokesOperator::for_channels(psf, response, 1, FftBackend::default(), workers).unwrap().remove(0)
}

fn planned(operator: &StokesOperator, coarse: &[Arc<Coarse>], method: Method) -> Plan {
    let operators = std::slice::from_ref(operator);
    Plan::new(&Spec { method, operators, coarse }).unwrap()
}

fn run(plan: &Plan, iterations: usize, raw: &Stack<f32>, guide: &Stack<f32>) -> (Stack<f32>, Outcome) {
    let weight = map(raw, |_| 1.0);
    let mut stokes = Stack::zeros(3, raw.size());
    let guide = (plan.method() == Method::Guided).then_some(guide);
    let outcome =
        plan.run(&Input { raw, weight: &weight, guide }, iterations, &mut stokes, &mut plan.make_workspace()).unwrap();
    (stokes, outcome)
}

/// The solver beside its twin in f64, which shares nothing with it but the direct start's equations. The number of iterations,
/// the relative differences of L and of the residual.
fn drift(checkpoints: &[usize]) -> Vec<(usize, f64, f64)> {
    let rig = Rig::new(spec("plastic", SIZE));
    let operator = operator(&rig.calibration.psf, &rig.calibration.response);
    let coarse = Arc::new(Coarse::new(&operator, &operator.polarized_responses()));
    let plan = planned(&operator, &[Arc::clone(&coarse)], Method::Guided);
    let mut twin = Twin::new(&operator, rig.calibration.psf.channel(0), rig.raw.plane(0), rig.guide.plane(0), &coarse);
    let mut rows = Vec::new();
    let mut drifts = Vec::new();
    for &iterations in checkpoints {
        let (stokes, outcome) = run(&plan, iterations, &rig.raw, &rig.guide);
        let residual = twin.advance_to(iterations);
        let (found, exact) = (&stokes.as_slice()[SIZE.pixels()..], twin.polarized());
        let root = |values: &mut dyn Iterator<Item = f64>| (values.map(|v| v * v).sum::<f64>()).sqrt();
        let length = root(&mut exact.iter().copied());
        let drift = root(&mut found.iter().zip(&exact).map(|(a, b)| f64::from(*a) - b)) / length;
        let largest = found.iter().zip(&exact).map(|(a, b)| (f64::from(*a) - b).abs()).fold(0.0, f64::max);
        let of_residual = (f64::from(outcome.residual_rms) / residual - 1.0).abs();
        rows.push(vec![
            iterations.to_string(),
            format!("{drift:.1e}"),
            format!("{largest:.1e}"),
            format!("{:.6e}", outcome.residual_rms),
            format!("{residual:.6e}"),
            format!("{of_residual:.1e}"),
        ]);
        drifts.push((iterations, drift, of_residual));
    }
    table(
        "f32 against f64",
        &[
            "iterations",
            "difference of L, relative",
            "largest",
            "residual, f32",
            "residual, f64",
            "difference, relative",
        ],
        &rows,
    );
    drifts
}

fn assert_little(drifts: &[(usize, f64, f64)]) {
    for (iterations, drift, residual) in drifts {
        assert!(*drift < 1e-3 && *residual < 1e-3, "{iterations} iterations: {drift:.1e}, residual {residual:.1e}");
    }
}

#[test]
fn rounding_stays_small() {
    assert_little(&drift(&[1, 10, 100]));
}

#[test]
#[ignore = "takes a minute"]
fn rounding_stays_small_over_ten_thousand_iterations() {
    assert_little(&drift(&[1, 10, 100, 1000, 10_000]));
}

/// A scene, and what a camera of any PSF and mask reads of it.
struct Scene {
    truth: Stack<f32>,
    guide: Stack<f32>,
    psf: Stack<f32>,
}

impl Scene {
    fn new() -> Self {
        let rig = Rig::new(spec("plastic", SIZE));
        Self { psf: rig.spec.psf(), truth: rig.truth, guide: rig.guide }
    }

    fn readings(&self, operator: &StokesOperator) -> Stack<f32> {
        let mut scratch = operator.convolver.make_scratch();
        let (mut raw, mut polarized) = (Stack::zeros(1, SIZE), vec![0.0; SIZE.pixels()]);
        operator.forward_s0(self.truth.plane(0), raw.plane_mut(0), &mut scratch);
        let parts = self.truth.plane(1).iter().zip(self.truth.plane(2));
        let l: Vec<_> = parts.map(|(re, im)| Complex32::new(*re, *im)).collect();
        operator.forward_polarized(&l, &mut polarized, &mut scratch);
        let mut random = StdRng::seed_from_u64(5);
        let noise = || NOISE * random.sample::<f32, _>(StandardNormal);
        raw.as_mut_slice()
            .iter_mut()
            .zip(&polarized)
            .zip(std::iter::repeat_with(noise))
            .for_each(|((y, p), e)| *y += p + e);
        raw
    }

    /// dB of S1 and S2 of both methods, each finite and physical.
    fn errors(&self, what: &str, operator: &StokesOperator) -> [f64; 2] {
        let raw = self.readings(operator);
        SPLITTING.map(|method| {
            let (stokes, outcome) = run(&planned(operator, &[], method), 20, &raw, &self.guide);
            assert_physical(&stokes, &format!("{method}, {what}"));
            assert!(outcome.residual_rms.is_finite(), "{method}, {what}");
            s12_psnr(&stokes, &self.truth)
        })
    }

    /// dB of S1 and S2 when no polarization is found at all.
    fn unpolarized(&self) -> f64 {
        s12_psnr(&Stack::zeros(3, SIZE), &self.truth)
    }

    fn row(&self, what: &str, about: &str, operator: &StokesOperator) -> Vec<String> {
        let [guided, stokes] = self.errors(what, operator);
        let none = self.unpolarized();
        assert!(guided > none - 0.5, "{what}: {guided:.2} dB, {none:.2} dB without polarization");
        vec![what.to_owned(), about.to_owned(), format!("{guided:.1}"), format!("{stokes:.1}"), format!("{none:.1}")]
    }
}

/// A PSF given by its value at each displacement.
fn psf(value: impl Fn(f32, f32) -> f32) -> Stack<f32> {
    let at = |i: usize| value((i % SIZE.width) as f32 - 32.0, (i / SIZE.width) as f32 - 32.0);
    Stack::from_vec(1, SIZE, (0..SIZE.pixels()).map(at).collect()).unwrap()
}

#[test]
fn every_psf_gives_a_finite_image() {
    let scene = Scene::new();
    let response = Response::stripes(SIZE, Angle::four(), 16, f64::INFINITY).unwrap();
    let gauss = |s: f32| psf(move |x, y| (-0.5 * (x * x + y * y) / (s * s)).exp());
    let mut cases = vec![
        ("one pixel".to_owned(), psf(|x, y| f32::from(x == 0.0 && y == 0.0))),
        ("two points, 10 pixels apart".to_owned(), psf(|x, y| f32::from(y == 0.0 && x.abs() == 5.0))),
        ("line of 41 pixels".to_owned(), psf(|x, y| if y == 0.0 { (20.5 - x.abs()).clamp(0.0, 20.0) } else { 0.0 })),
        ("diffuser".to_owned(), scene.psf.clone()),
    ];
    cases.extend([0.5, 1.0, 2.0, 4.0, 8.0, 16.0].map(|s| (format!("Gaussian, σ {s} px"), gauss(s))));
    let row = |(what, samples): (String, Stack<f32>)| {
        let psf = Psf::new(samples, SIZE, 1).unwrap();
        let operator = operator(&psf, &response);
        let magnitudes = twin::spectrum(psf.channel(0), SIZE, operator.convolver.padded());
        let least = magnitudes.iter().map(|k| k.norm()).fold(f64::INFINITY, f64::min);
        scene.row(&what, &format!("{:.0e}", 1.0 / least.max(1e-16)), &operator)
    };
    let rows: Vec<_> = cases.into_iter().map(row).collect();
    let header = ["PSF", "condition number of the convolution", "`guided` [dB]", "`stokes` [dB]", "unpolarized [dB]"];
    table("PSF", &header, &rows);
}

#[test]
fn every_mask_gives_a_finite_image() {
    let scene = Scene::new();
    let psf = Psf::new(scene.psf.clone(), SIZE, 1).unwrap();
    let mut rows = Vec::new();
    for (angles, stripes) in [(Angle::three(), 3), (Angle::four(), 4), (Angle::four(), 8), (Angle::four(), 16)]
        .into_iter()
        .chain([32, 64].map(|stripes| (Angle::four(), stripes)))
    {
        let response = Response::stripes(SIZE, angles, stripes, f64::INFINITY).unwrap();
        rows.push(scene.row(&format!("{stripes} stripes"), "∞", &operator(&psf, &response)));
    }
    for ratio in [1.5, 2.0, 4.0, 10.0, 100.0, 1e4] {
        // Measured: transmissions under light polarized at each angle, every pixel's own.
        let ideal = Response::stripes(SIZE, Angle::four(), 16, ratio).unwrap();
        let mut random = StdRng::seed_from_u64(11);
        let dust: Vec<f32> = (0..SIZE.pixels()).map(|_| 1.0 - 0.2 * random.random::<f32>()).collect();
        let maps = ideal.unpolarized().iter().zip(ideal.polarized()).zip(&dust);
        let planes = Angle::four().into_iter().flat_map(|angle| {
            let seen = move |((m0, e), dust): ((&f32, &Complex32), &f32)| {
                dust * (m0 + e.re * angle.cos2() as f32 + e.im * angle.sin2() as f32).max(0.0)
            };
            maps.clone().map(seen).collect::<Vec<_>>()
        });
        let transmission = Stack::from_vec(4, SIZE, planes.collect()).unwrap();
        let response = Response::measured(SIZE, Angle::four(), &transmission).unwrap();
        rows.push(scene.row("16 stripes, measured", &format!("{ratio}"), &operator(&psf, &response)));
    }
    table("Mask", &["mask", "extinction ratio", "`guided` [dB]", "`stokes` [dB]", "unpolarized [dB]"], &rows);
}

#[test]
fn units_do_not_matter() {
    // Behind a black level, readings this large are refused as counts that are taken for fractions.
    let mut rig = Rig::new(SimSpec { black_level: 0, ..spec("plastic", SIZE) });
    let samples = rig.spec.psf();
    let expected = SPLITTING.map(|method| rig.solve(method, 20).0);
    let mut rows = Vec::new();
    for scale in [1e-6, 1e-4, 1e-2, 1e2, 1e4, 1e6] {
        let mut cells = vec![format!("{scale:e}")];
        let mut compare = |what: &str, method: usize, stokes: &Stack<f32>, units: f32| {
            let unscaled = scaled(stokes, units.recip());
            let difference = relative_difference(unscaled.as_slice(), expected[method].as_slice());
            cells.push(format!("{difference:.1e}"));
            assert!(difference < 1e-3, "{what} × {scale:e}, {}: {difference:.1e}", SPLITTING[method]);
        };
        let raw = scaled(&rig.raw, scale);
        let guide = scaled(&rig.guide, scale);
        compare("readings", 0, &rig.solve_frame(&raw, Some(&rig.guide), Method::Guided, 20).0, scale);
        compare("readings", 1, &rig.solve_frame(&raw, None, Method::Stokes, 20).0, scale);
        compare("guide", 0, &rig.solve_frame(&rig.raw, Some(&guide), Method::Guided, 20).0, 1.0);
        compare("readings and guide", 0, &rig.solve_frame(&raw, Some(&guide), Method::Guided, 20).0, scale);
        rig.calibration.device.psf = Psf::new(scaled(&samples, scale), SIZE, 1).unwrap();
        for (k, method) in SPLITTING.into_iter().enumerate() {
            compare("PSF", k, &rig.solve(method, 20).0, 1.0);
        }
        rig.calibration.device.psf = Psf::new(samples.clone(), SIZE, 1).unwrap();
        rows.push(cells);
    }
    let header = [
        "factor",
        "readings, `guided`",
        "readings, `stokes`",
        "guide, `guided`",
        "readings and guide, `guided`",
        "PSF, `guided`",
        "PSF, `stokes`",
    ];
    table("Scale", &header, &rows);
}

#[test]
fn subnormal_numbers_are_survived() {
    let size = Size::new(128, 128);
    let rig = Rig::new(spec("plastic", size));
    let tiny = |frame: &Stack<f32>| scaled(frame, 1e-39);
    let mut i = 0;
    let half = map(&rig.guide, |v| {
        i += 1;
        if i % 2 == 0 { 1e-40 } else { v }
    });
    let cases = [
        ("none", rig.raw.clone(), rig.guide.clone()),
        ("readings", tiny(&rig.raw), rig.guide.clone()),
        ("guide", rig.raw.clone(), tiny(&rig.guide)),
        ("readings and guide", tiny(&rig.raw), tiny(&rig.guide)),
        ("every other pixel of the guide", rig.raw.clone(), half),
    ];
    let mut rows = Vec::new();
    let mut usual = [f64::NAN; 2];
    for (what, raw, guide) in cases {
        let mut cells = vec![what.to_owned()];
        for (k, method) in SPLITTING.into_iter().enumerate() {
            let mut pipeline = rig.pipeline(method == Method::Guided, &settings(method, 20, 1));
            let guide = (method == Method::Guided).then_some(&guide);
            let mut seconds = f64::INFINITY;
            for _ in 0..5 {
                let start = Instant::now();
                pipeline.process(raw.view(), guide.map(Stack::view)).unwrap();
                seconds = seconds.min(start.elapsed().as_secs_f64());
            }
            let stokes = &pipeline.result().stokes;
            assert!(stokes.as_slice().iter().all(|v| v.is_finite()), "{what}, {method}");
            assert!(stokes.plane(0).iter().all(|v| *v >= 0.0), "{what}, {method}");
            if usual[k].is_nan() {
                usual[k] = seconds;
            }
            cells.push(format!("{:.2}", seconds / usual[k]));
        }
        rows.push(cells);
    }
    table("Subnormal numbers", &["subnormal", "time of `guided`", "time of `stokes`"], &rows);
}
