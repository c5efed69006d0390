//! Calibration as a user does it: all steps on a device with flaws, every step by itself from files and cameras, and the error and
//! remedy of every mistake.
#![allow(clippy::unwrap_used, reason = "a test")]

use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use serde_json::Value;
use stokescope::bundle::{Bundle, Draft, write_simulated};
use stokescope::camera::sim::{Knowledge, SimSpec, Simulator};
use stokescope_core::calibrate::mask::Layout;
use stokescope_core::calibrate::{
    CalibrateError, Levels, PolarizedShots, Remedy, Shots, Step, align, dark, mask, psf, verify, white,
};
use stokescope_core::image::Stack;
use stokescope_core::optics::MaskError;
use stokescope_core::polarization::Angle;
use stokescope_core::readings::Unit;

const DEVICE: &str = "size=96,stripes=12,fine=2,seed=5,surround=0,guide_margin=0";

fn spec(scene: &str, more: &str) -> SimSpec {
    format!("{scene},{DEVICE},{more}").trim_end_matches(',').parse().unwrap()
}

/// Raw frames of a target, numbers `first` to `first + 3`, and the guide frames beside them.
fn pair(scene: &str, more: &str, first: u64) -> (Shots, Shots) {
    let mut simulator = Simulator::new(spec(scene, more)).unwrap();
    let captures: Vec<_> = (first..first + 4).map(|index| simulator.capture(index)).collect();
    let floats = |counts: &Stack<u16>| {
        let values = counts.as_slice().iter().copied().map(f32::from).collect();
        Stack::from_vec(counts.count(), counts.size(), values).unwrap()
    };
    let raw = captures.iter().map(|capture| floats(&capture.raw)).collect();
    let guide = captures.into_iter().map(|capture| capture.guide).collect();
    (Shots { frames: raw, unit: Unit::Counts }, Shots { frames: guide, unit: Unit::FullScale })
}

fn shots(scene: &str, more: &str) -> Shots {
    pair(scene, more, 0).0
}

/// The polarizer is set to each of `set`, and said to be at each of `said`.
fn views(set: &[f64], said: &[f64], more: &str) -> Vec<PolarizedShots> {
    let view = |(k, (set, said)): (usize, (&f64, &f64))| {
        let shots = pair("uniform", &format!("polarizer={set},{more}"), 10 * k as u64).0;
        PolarizedShots { angle: Angle::from_degrees(*said), shots }
    };
    set.iter().zip(said).enumerate().map(view).collect()
}

fn levels() -> Levels {
    let dir = tempfile::tempdir().unwrap();
    let mut draft = Draft::open(dir.path()).unwrap();
    draft.set_dark(&dark::measure(&shots("dark", "noise=0.002"), 16).unwrap());
    draft.commit().unwrap();
    Draft::open(dir.path()).unwrap().levels(Step::Mask).unwrap()
}

fn layout(stripes: usize) -> Layout {
    Layout { angles: Angle::four(), stripes }
}

/// Asserts that a step fails with an error of the given pattern, and that this remedy is proposed.
macro_rules! fails {
    ($result:expr, $error:pat $(if $guard:expr)?, $remedy:expr) => {
        match $result.map(drop) {
            Err(error) => {
                assert!(matches!(error, $error $(if $guard)?), "{error:?}");
                assert_eq!(error.remedy(), Some($remedy), "{error}");
            }
            Ok(()) => panic!("nothing is refused"),
        }
    };
}

#[test]
fn the_demonstration_comes_close_to_perfect_knowledge() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().to_str().unwrap();
    let args = ["--json", "calibrate", "--demo", "--scene", "tissue", "--size", "128", "--seed", "7", "--out", out];
    let (code, stdout, stderr) = stokescope(&args, "");
    assert_eq!(code, 0, "{stderr}");
    let answer: Value = serde_json::from_str(&stdout).unwrap();
    let steps: Vec<_> = answer["steps"].as_array().unwrap().iter().map(|s| s["step"].as_str().unwrap()).collect();
    assert_eq!(steps, ["dark", "mask", "psf", "align", "verify"]);
    let (summary, psnr) = (&answer["summary"], |of: &str| answer["summary"][of]["s12_psnr"].as_f64().unwrap());
    assert_eq!(summary["passed"], true, "{summary}");
    assert!(psnr("nominal") < psnr("calibrated") - 3.0, "calibration is worth it: {summary}");
    assert_eq!(summary["calibration"], Bundle::load(dir.path()).unwrap().digest);
}

#[test]
fn a_dark_frame_needs_frames_and_darkness() {
    let one = Shots { frames: shots("dark", "").frames[..1].to_vec(), unit: Unit::Counts };
    fails!(dark::measure(&one, 16), CalibrateError::FewFrames { found: 1, needed: 2, .. }, Remedy::MoreFrames);
    fails!(
        dark::measure(&shots("print", ""), 16),
        CalibrateError::NotDark { percent, .. } if percent > 1.0,
        Remedy::CoverLens
    );
    let found = dark::measure(&shots("dark", "noise=0.004,black=700,imperfect=hot"), 16).unwrap();
    assert!((found.black_level - 700.0).abs() < 20.0 && (found.read_noise - 0.004).abs() < 4e-4, "{found:?}");
    let hot = spec("dark", "knowledge=exact,imperfect=hot");
    let dir = tempfile::tempdir().unwrap();
    write_simulated(&hot, dir.path()).unwrap();
    let known = Bundle::load(dir.path()).unwrap().device.dark.unwrap();
    assert_eq!(found.hot, known.as_slice().iter().filter(|v| **v > 2000.0).count());
}

#[test]
fn a_point_source_must_be_bright_small_and_still() {
    let levels = levels();
    let measure = |shots: &Shots| psf::measure(shots, &levels, None);
    fails!(
        measure(&shots("point", "light=0")),
        CalibrateError::NoLight { step: Step::Psf, signal, needed, .. } if signal < needed,
        Remedy::SwitchLampOn
    );
    fails!(measure(&shots("point", "light=0.02")), CalibrateError::WeakSource { .. }, Remedy::ExposeLonger);
    fails!(measure(&shots("point", "light=4")), CalibrateError::Saturated { .. }, Remedy::ExposeShorter);
    fails!(measure(&shots("print", "")), CalibrateError::NotAPoint { .. }, Remedy::OnePointSource);
    let mut moved = shots("point", "");
    moved.frames.extend(shots("point", "point=3:0").frames);
    fails!(
        measure(&moved),
        CalibrateError::Moved { step: Step::Psf, pixels, .. } if (pixels - 3.0).abs() < 0.5,
        Remedy::HoldStill
    );
    let found = measure(&shots("point", "point=3:-2")).unwrap();
    let truth = spec("point", "").psf();
    // it is centred on its light, so the truth is compared where that was
    let shift = [found.centre[0] - 48 - 3, found.centre[1] - 48 + 2];
    let at = |x: i64, y: i64| truth.plane(0)[((y + shift[1]) * 96 + x + shift[0]) as usize];
    let inner = || (10..86).flat_map(|y| (10..86).map(move |x| (x, y)));
    let error: f32 = inner().map(|(x, y)| (found.planes.plane(0)[(y * 96 + x) as usize] - at(x, y)).powi(2)).sum();
    let energy: f32 = inner().map(|(x, y)| at(x, y).powi(2)).sum();
    // the mask was not undone, and its stripes take different shares of no light at all: it is unpolarized
    assert!(error < 1e-3 * energy, "{}", error / energy);
}

#[test]
fn a_mask_needs_a_polarizer_that_is_turned_and_named_rightly() {
    let levels = levels();
    let measure = |views: &[PolarizedShots], stripes| mask::measure(views, &levels, &layout(stripes));
    let angles = [0.0, 30.0, 60.0, 90.0, 120.0, 150.0];
    let at = |angle: Option<Angle>, degrees: f64| angle == Some(Angle::from_degrees(degrees));
    fails!(
        measure(&views(&[0.0, 90.0, 180.0], &[0.0, 90.0, 180.0], ""), 12),
        CalibrateError::FewAngles { distinct: 2, needed: 3, .. },
        Remedy::TurnPolarizer
    );
    fails!(
        measure(&views(&angles[..4], &[0.0, 30.0, 60.0, f64::NAN], ""), 12),
        CalibrateError::Angle { step: Step::Mask, .. },
        Remedy::FiniteAngles
    );
    fails!(
        measure(&views(&[20.0; 4], &angles[..4], ""), 12),
        CalibrateError::NotTurned { step: Step::Mask, .. },
        Remedy::TurnPolarizer
    );
    let dark = views(&angles[..3], &angles[..3], "light=0");
    fails!(measure(&dark, 12), CalibrateError::NoLight { angle, .. } if at(angle, 0.0), Remedy::SwitchLampOn);
    let bright = views(&angles[..3], &angles[..3], "light=2");
    fails!(measure(&bright, 12), CalibrateError::Saturated { angle, .. } if at(angle, 0.0), Remedy::ExposeShorter);
    let wrong = Angle::from_degrees(75.0);
    fails!(
        measure(&views(&[0.0, 30.0, 60.0, 90.0, 120.0, 150.0], &[0.0, 30.0, 75.0, 90.0, 120.0, 150.0], ""), 12),
        CalibrateError::NotMalus { angle, .. } if angle == wrong,
        Remedy::CheckAngle(wrong)
    );
    let good = views(&angles, &angles, "");
    fails!(measure(&good, 9), CalibrateError::OtherMask { .. }, Remedy::DescribeMask);
    fails!(measure(&good, 97), CalibrateError::Mask(MaskError::Stripes { found: 97, .. }), Remedy::DescribeMask);
}

#[test]
fn stripes_are_found_with_their_angles_extinction_and_edges() {
    let angles = [0.0, 30.0, 60.0, 90.0, 120.0, 150.0];
    let flaws = "imperfect=angles+extinction+edges+exposure+vignetting+dust";
    let found = mask::measure(&views(&angles, &angles, flaws), &levels(), &layout(12)).unwrap();
    for (found, truth) in found.stripes.iter().zip(spec("uniform", flaws).stripes()) {
        assert!((found.angle_deg - truth.angle.degrees()).abs() < 0.3, "{found:?} {truth:?}");
        assert!((found.extinction * truth.leak - 1.0).abs() < 0.3, "{found:?} {truth:?}");
        assert!(found.left.is_none_or(|left| (left - truth.left).abs() < 0.15), "{found:?} {truth:?}");
        assert!(found.blur.is_none_or(|blur| (blur - 0.8).abs() < 0.2), "{found:?}");
    }
    let truth = SimSpec { knowledge: Knowledge::Exact, ..spec("uniform", flaws) }.mask();
    let square = |(a, b): (&f32, &f32)| (a - b).powi(2);
    let error = (found.transmission.as_slice().iter().zip(truth.as_slice()).map(square).sum::<f32>()
        / truth.as_slice().len() as f32)
        .sqrt();
    assert!(error < 0.01, "{error}");
}

#[test]
fn white_gains_undo_the_filters() {
    let colour = "color=rgb,imperfect=exposure";
    let dir = tempfile::tempdir().unwrap();
    let mut draft = Draft::open(dir.path()).unwrap();
    draft.set_dark(&dark::measure(&shots("dark", colour), 16).unwrap());
    draft.commit().unwrap();
    let levels = Draft::open(dir.path()).unwrap().levels(Step::Mask).unwrap();
    let [red, green, blue] = white::measure(&shots("uniform", colour), &levels).unwrap().gains;
    assert!((red - 1.0 / 0.9).abs() < 2e-3 && green == 1.0 && (blue - 1.0 / 0.8).abs() < 2e-3, "{red} {blue}");
    fails!(
        white::measure(&shots("uniform", "color=rgb,light=0"), &levels),
        CalibrateError::NoLight { step: Step::White, .. },
        Remedy::SwitchLampOn
    );
}

#[test]
fn alignment_and_malus_refuse_what_does_not_fit() {
    let dir = tempfile::tempdir().unwrap();
    write_simulated(&spec("print", ""), dir.path()).unwrap();
    let calibration = Bundle::load(dir.path()).unwrap();
    let (raw, guide) = pair("print", "guide_size=120,guide_zoom=0.95,guide_turn=1.5,shift=2:-1", 0);
    let found = align::measure(&calibration, &raw, &guide, 2).unwrap();
    assert!(found.residual_px < 0.3, "{}", found.outcome().verdict);
    let other = pair("print", "guide_size=120,seed=6", 0).1;
    fails!(
        align::measure(&calibration, &raw, &other, 2),
        CalibrateError::OtherScene { inliers, places, .. } if inliers < places,
        Remedy::ShowSameTarget
    );
    let mut moved = raw.clone();
    moved.frames.extend(pair("print", "seed=6", 0).0.frames);
    fails!(
        align::measure(&calibration, &moved, &guide, 2),
        CalibrateError::Moved { step: Step::Align, .. },
        Remedy::HoldStill
    );

    let film = |angle: f64, more: &str| pair("film", &format!("polarizer={angle},{more}"), 0);
    let view =
        |said: f64, set: f64, more: &str| PolarizedShots { angle: Angle::from_degrees(said), shots: film(set, more).0 };
    let guides: Vec<_> = [0.0, 60.0, 120.0].map(|angle| film(angle, "").1.frames.remove(0)).into();
    let views: Vec<_> = [0.0, 60.0, 120.0].map(|angle| view(angle, angle, "")).into();
    let found = verify::measure(&calibration, &views, &guides, 2).unwrap().outcome();
    assert!(found.good && found.remedy.is_none(), "{}", found.verdict);
    let still: Vec<_> = [0.0, 60.0, 120.0].map(|angle| view(angle, 30.0, "")).into();
    fails!(
        verify::measure(&calibration, &still, &guides, 2),
        CalibrateError::NotTurned { step: Step::Verify, .. },
        Remedy::TurnPolarizer
    );
    let off: Vec<_> = [0.0, 60.0, 120.0].map(|angle| view(angle + 10.0, angle, "")).into();
    let off = verify::measure(&calibration, &off, &guides, 2).unwrap().outcome();
    assert!(!off.good && off.remedy == Some(Remedy::SameZero), "{} {:?}", off.verdict, off.remedy);
    fails!(
        verify::measure(&calibration, &[view(0.0, 0.0, ""), view(180.0, 0.0, "")], &[], 2),
        CalibrateError::FewAngles { distinct: 1, needed: 2, .. },
        Remedy::TurnPolarizer
    );
    fails!(
        verify::measure(&calibration, &[view(0.0, 60.0, ""), view(60.0, 0.0, ""), view(120.0, 120.0, "")], &[], 2),
        CalibrateError::Swapped { step: Step::Verify, .. },
        Remedy::ExchangeViews(Angle::from_degrees(0.0), Angle::from_degrees(60.0))
    );
    let dark: Vec<_> = [0.0, 60.0, 120.0].map(|angle| view(angle, angle, "light=0")).into();
    fails!(
        verify::measure(&calibration, &dark, &[], 2),
        CalibrateError::NoLight { step: Step::Verify, .. },
        Remedy::SwitchLampOn
    );
}

/// Exit code, standard output, standard error of the program, given some standard input.
fn stokescope(args: &[&str], input: &str) -> (i32, String, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_stokescope"));
    let piped = command.args(args).stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut child = piped.spawn().unwrap();
    // it may end without reading
    let _ = child.stdin.take().unwrap().write_all(input.as_bytes());
    let output = child.wait_with_output().unwrap();
    let text = |bytes| String::from_utf8(bytes).unwrap();
    (output.status.code().unwrap(), text(output.stdout), text(output.stderr))
}

/// The frames that `simulate` writes of a target.
fn files(dir: &Path, name: &str, more: &str) -> Vec<String> {
    let out = dir.join(name);
    let fixed = format!("simulate --size 96 --seed 5 --frames 3 --out {} {more}", out.display());
    let (code, _, stderr) = stokescope(&fixed.split_whitespace().collect::<Vec<_>>(), "");
    assert_eq!(code, 0, "{stderr}");
    (0..3).map(|n| out.join("raw").join(format!("{n:06}.npy")).display().to_string()).collect()
}

fn board(dir: &Path, source: &str, bundle: &str) -> PathBuf {
    let text = include_str!("../boards/x86-sim.toml")
        .replace("wedges,size=250", source)
        .replace("calibration = \"simulated\"", &format!("calibration = {bundle:?}"));
    let path = dir.join("board.toml");
    std::fs::write(&path, text).unwrap();
    path
}

#[test]
fn every_step_is_taken_from_files_and_the_result_names_the_bundle() {
    let dir = tempfile::tempdir().unwrap();
    let bundle = dir.path().join("bundle").display().to_string();
    let step = |step: &str, frames: &[String], more: &str| {
        let mut args = vec!["calibrate", step, "--json", "--bundle", &bundle, "--from"];
        args.extend(frames.iter().map(String::as_str));
        args.extend(more.split_whitespace());
        let (code, stdout, stderr) = stokescope(&args, "");
        assert_eq!(code, 0, "{step}: {stderr}");
        let answer: Value = serde_json::from_str(&stdout).unwrap();
        assert!(answer["verdict"].as_str().unwrap().ends_with('.') && answer["good"] == true, "{answer}");
        assert_eq!((&answer["step"], &answer["remedy"]), (&Value::from(step), &Value::Null));
        assert!(Path::new(answer["picture"].as_str().unwrap()).exists(), "{answer}");
        answer
    };
    let point = files(dir.path(), "point", "--scene point");
    let args = ["calibrate", "psf", "--bundle", &bundle, "--from", &point[0]];
    let (code, _, stderr) = stokescope(&args, "");
    assert!(code == 65 && stderr.contains("run `stokescope calibrate dark` first"), "{code} {stderr}");

    step("dark", &files(dir.path(), "dark", "--scene dark"), "");
    let uniform = |angle: u32| files(dir.path(), &format!("u{angle}"), &format!("--scene uniform --polarizer {angle}"));
    let views: Vec<String> = [0, 45, 90, 135].into_iter().flat_map(uniform).collect();
    assert_eq!(step("mask", &views, "--angles 0,45,90,135")["calibration"], Value::Null, "there is no PSF yet");
    let first = step("psf", &point, "")["calibration"].as_str().unwrap().to_owned();
    let print = files(dir.path(), "print", "--scene print --shift 1.5 -1");
    let guide = dir.path().join("print/guide.npy").display().to_string();
    let aligned = step("align", &print, &format!("--guide {guide}"))["calibration"].as_str().unwrap().to_owned();
    assert_ne!(first, aligned);
    let film = |angle: u32| {
        files(dir.path(), &format!("f{angle}"), &format!("--scene film --polarizer {angle} --shift 1.5 -1"))
    };
    let views: Vec<String> = [0, 60].into_iter().flat_map(film).collect();
    let guides = [0, 60].map(|angle| dir.path().join(format!("f{angle}/guide.npy")).display().to_string()).join(" ");
    step("verify", &views, &format!("--angles 0,60 --guide {guides}"));

    let out = dir.path().join("out");
    let text = format!("reconstruct --calibration {bundle} --raw {} --guide {guide} --out {}", print[0], out.display());
    let (code, _, stderr) = stokescope(&text.split_whitespace().collect::<Vec<_>>(), "");
    assert_eq!(code, 0, "{stderr}");
    let report: Value = serde_json::from_slice(&std::fs::read(out.join("report.json")).unwrap()).unwrap();
    assert_eq!(report["calibration"], aligned.as_str());
    // a poor result says how to make it better
    let turned = ["--angles", "10,70", "--zero", "0", "--guide"];
    let mut args = vec!["calibrate", "verify", "--bundle", &bundle, "--from"];
    args.extend(views.iter().map(String::as_str).chain(turned).chain(guides.split(' ')));
    let (code, stdout, stderr) = stokescope(&args, "");
    assert!(code == 0 && stdout.contains("with the --zero that is used here."), "{stdout} {stderr}");
    // two views in the wrong order are named
    let swapped = ["--angles", "60,0", "--zero", "0"];
    let mut args = vec!["calibrate", "verify", "--bundle", &bundle, "--from"];
    args.extend(views.iter().map(String::as_str).chain(swapped));
    let (code, _, stderr) = stokescope(&args, "");
    assert!(code == 65 && stderr.contains("the views at 60° and 0° seem to be swapped"), "{code} {stderr}");
    // a step that fails leaves the bundle as it was
    let views: Vec<&str> = views.iter().map(String::as_str).collect();
    let args = [&["calibrate", "mask", "--bundle", &bundle, "--angles", "0,180", "--from"], views.as_slice()].concat();
    assert_eq!(stokescope(&args, "").0, 65);
    assert_eq!(Bundle::load(Path::new(&bundle)).unwrap().digest, aligned);
}

#[test]
fn cameras_calibrate_the_bundle_they_are_tied_to() {
    let dir = tempfile::tempdir().unwrap();
    let bundle = dir.path().join("bundle");
    let device = "size=48,stripes=8,fine=2,fps=1000";
    let run = |step: &str, source: &str, more: &[&str], input: &str| {
        let board = board(dir.path(), source, "bundle").display().to_string();
        let text = std::fs::read_to_string(&board).unwrap().replace("frame_rate = 10.0", "frame_rate = 200.0");
        std::fs::write(&board, text).unwrap();
        let fixed = ["calibrate", step, "--bundle", bundle.to_str().unwrap(), "--board", &board, "--frames", "3"];
        stokescope(&[fixed.as_slice(), more].concat(), input)
    };
    let (code, stdout, stderr) = run("dark", &format!("dark,{device}"), &[], "");
    assert!(code == 0 && stdout.starts_with("Dark frame of black level 102"), "{stdout} {stderr}");
    let (code, _, stderr) = run("dark", &format!("dark,{device},seed=2"), &[], "");
    assert!(code == 65 && stderr.contains("belongs to camera simulated raw camera 1"), "{code} {stderr}");
    let (code, _, stderr) = run("dark", &format!("dark,{device},bits=12,black=64"), &[], "");
    assert!(code == 65 && stderr.contains("mono 12-bit"), "{code} {stderr}");
    let uniform = format!("uniform,{device},polarizer=20");
    let more = ["--angles", "0,60,120", "--stripes", "8"];
    let (code, _, stderr) = run("mask", &uniform, &more, "\n\n\n");
    assert!(code == 65 && stderr.contains("turn the polarizer between views"), "{code} {stderr}");
    let (code, _, stderr) = run("mask", &uniform, &more, "\n");
    assert!(code == 2 && stderr.contains("has not been turned to 60°"), "{code} {stderr}");

    // a finished bundle of another camera is refused when the service starts
    let mut draft = Draft::open(&bundle).unwrap();
    draft.set("mask", "kind", "none");
    let psf: Vec<f32> = (0..48 * 48).map(|i| (i % 61) as f32).collect();
    draft.set_array("psf", &[48, 48], &psf);
    draft.commit().unwrap().unwrap();
    let board = board(dir.path(), &format!("wedges,{device},seed=3"), "bundle").display().to_string();
    let out = dir.path().join("run").display().to_string();
    let (code, _, stderr) = stokescope(&["run", "--board", &board, "--frames", "1", "--no-preview", "--out", &out], "");
    assert!(code == 65 && stderr.contains("found simulated raw camera 3"), "{code} {stderr}");
}
