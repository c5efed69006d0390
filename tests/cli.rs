//! The program as a user runs it: commands, files, exit codes, and what it says of files that cannot be used.
#![allow(clippy::unwrap_used, reason = "a test")]

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::LazyLock;
use std::time::{Duration, Instant};

use serde_json::Value;
use stokescope::files::{Values, read_image, read_npy, write_npy};
use stokescope_core::image::{Size, Stack};
use stokescope_core::optics::Psf;
use stokescope_core::solve::Method;
use tempfile::TempDir;

const WIDTH: usize = 48;
const HEIGHT: usize = 40;
const PIXELS: usize = WIDTH * HEIGHT;

/// Output and exit code of a finished process.
struct Done {
    code: i32,
    stdout: String,
    stderr: String,
}

fn stokescope(args: &[&str]) -> Done {
    let output =
        Command::new(env!("CARGO_BIN_EXE_stokescope")).args(args).env_remove("STOKESCOPE_LOG").output().unwrap();
    Done {
        code: output.status.code().expect("ended by a signal"),
        stdout: String::from_utf8(output.stdout).unwrap(),
        stderr: String::from_utf8(output.stderr).unwrap(),
    }
}

#[test]
fn reconstructing_changes_nothing_in_the_bundle() {
    let bench = Bench::new(&GRAY);
    let bundle = || {
        let names = std::fs::read_dir(bench.0.path()).unwrap().map(|e| e.unwrap().file_name());
        let mut names: Vec<_> = names.filter(|name| name != "out").collect();
        names.sort();
        names
    };
    let before = bundle();
    for method in Method::ALL.map(|method| method.to_string()) {
        let run = bench.reconstruct("raw.npy", &["--method", &method, "--guide", &bench.text("guide.npy")]);
        assert_eq!((run.code, bundle()), (0, before.clone()), "{method}: {}", run.stderr);
    }
}

#[test]
fn the_log_is_as_loud_as_asked_and_a_mistake_is_said() {
    let log = |wanted: &str| {
        let mut program = Command::new(env!("CARGO_BIN_EXE_stokescope"));
        let output = program.arg("boards").env("STOKESCOPE_LOG", wanted).output().unwrap();
        assert!(output.status.success());
        String::from_utf8(output.stderr).unwrap()
    };
    assert_eq!(log("warn,stokescope_core::solve=debug"), "");
    let said = log("warn,stokescope=loud");
    assert!(said.contains("WARN STOKESCOPE_LOG = \"warn,stokescope=loud\", allowed: off, error, warn,"), "{said}");
}

/// Runs a command that must do.
fn done(args: &[&str]) -> Done {
    let done = stokescope(args);
    assert_eq!(done.code, 0, "{args:?}: {}", done.stderr);
    done
}

/// A command's answer with `--json`: one object on stdout and nothing else.
fn json(args: &[&str]) -> Value {
    let stdout = done(&[args, &["--json"]].concat()).stdout;
    let value: Value = serde_json::from_str(&stdout).unwrap_or_else(|e| panic!("{args:?}: {e}: {stdout:?}"));
    assert!(value.is_object(), "{args:?}: {stdout}");
    value
}

fn simulate(name: &str, more: &[&str]) -> PathBuf {
    let out = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    let size = format!("{WIDTH}x{HEIGHT}");
    done(&[&["simulate", "--size", &size, "--out", out.to_str().unwrap()], more].concat());
    out
}

/// A gray and a colour capture that all tests share and none changes.
static GRAY: LazyLock<PathBuf> = LazyLock::new(|| simulate("cli-gray", &[]));
static RGB: LazyLock<PathBuf> = LazyLock::new(|| simulate("cli-rgb", &["--color", "rgb"]));

/// A bundle of its own, to be changed, and the folder the result goes to.
struct Bench(TempDir);

impl Bench {
    fn new(from: &Path) -> Self {
        let folder = tempfile::tempdir().unwrap();
        for name in ["calibration.toml", "psf.npy", "raw.npy", "guide.npy", "truth.npy"] {
            std::fs::copy(from.join(name), folder.path().join(name)).unwrap();
        }
        Self(folder)
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn text(&self, name: &str) -> String {
        self.path(name).to_str().unwrap().to_owned()
    }

    fn edit(&self, from: &str, to: &str) {
        let path = self.path("calibration.toml");
        let text = std::fs::read_to_string(&path).unwrap();
        assert!(text.contains(from), "{from:?} is not in {text}");
        std::fs::write(path, text.replacen(from, to, 1)).unwrap();
    }

    fn write(&self, name: &str, shape: &[usize], values: &[f32]) {
        write_npy(&self.path(name), shape, values).unwrap();
    }

    fn floats(&self, name: &str) -> Vec<f32> {
        read_npy(&self.path(name)).unwrap().into_f32()
    }

    /// The raw frame in counts, each changed.
    fn edit_raw(&self, mut change: impl FnMut(usize, u16) -> u16) {
        let array = read_npy(&self.path("raw.npy")).unwrap();
        let Values::U16(counts) = array.samples else { panic!("raw frames are counts") };
        let counts: Vec<u16> = counts.into_iter().enumerate().map(|(i, v)| change(i, v)).collect();
        write_npy(&self.path("raw.npy"), &array.shape, &counts).unwrap();
    }

    fn reconstruct(&self, raw: &str, more: &[&str]) -> Done {
        let (calibration, raw, out) = (self.0.path().to_str().unwrap(), self.text(raw), self.text("out"));
        let fixed = ["reconstruct", "--calibration", calibration, "--raw", &raw, "--out", &out, "--iterations", "5"];
        stokescope(&[&fixed, more].concat())
    }

    /// Reconstructs with the guide; the Stokes images.
    fn stokes(&self, raw: &str) -> Vec<f32> {
        let run = self.reconstruct(raw, &["--guide", &self.text("guide.npy")]);
        assert_eq!(run.code, 0, "{}", run.stderr);
        self.floats("out/stokes.npy")
    }

    fn report(&self) -> Value {
        serde_json::from_slice(&std::fs::read(self.path("out/report.json")).unwrap()).unwrap()
    }

    /// Nothing of a failed command under its final name.
    fn assert_no_result(&self, what: &str) {
        let left: Vec<_> = std::fs::read_dir(self.path("out")).into_iter().flatten().collect();
        assert!(left.is_empty(), "{what}: {left:?}");
    }
}

fn difference(a: &[f32], b: &[f32]) -> f32 {
    assert_eq!(a.len(), b.len());
    let sum = |values: &mut dyn Iterator<Item = f32>| values.map(|v| v * v).sum::<f32>().sqrt();
    sum(&mut a.iter().zip(b).map(|(a, b)| a - b)) / sum(&mut b.iter().copied())
}

#[test]
fn simulate_reconstruct_evaluate_leave_what_the_contract_says() {
    for (color, lead) in [("gray", vec![]), ("rgb", vec![3])] {
        for angles in [3, 4] {
            let sim = simulate(&format!("cli-{color}-{angles}"), &["--color", color, "--angles", &angles.to_string()]);
            let bench = Bench::new(&sim);
            let truth = read_npy(&bench.path("truth.npy")).unwrap();
            assert_eq!(truth.shape, [lead.as_slice(), &[angles, HEIGHT, WIDTH]].concat());
            for (guide, method) in [(true, "guided"), (false, "stokes")] {
                let path = bench.text("guide.npy");
                let more = if guide { vec!["--guide", &path] } else { vec![] };
                let run = bench.reconstruct("raw.npy", &more);
                assert_eq!(run.code, 0, "{}", run.stderr);
                assert_eq!(run.stdout.lines().count(), 1, "{}", run.stdout);

                assert_eq!(read_npy(&bench.path("out/angles.npy")).unwrap().shape, truth.shape);
                let stokes = read_npy(&bench.path("out/stokes.npy")).unwrap();
                assert_eq!(stokes.shape, [lead.as_slice(), &[3, HEIGHT, WIDTH]].concat());
                for name in ["intensity.png", "dolp.png", "aolp.png", "composite.png"] {
                    let picture = read_image(&bench.path("out").join(name)).unwrap();
                    assert!(picture.size().width >= WIDTH && picture.size().height >= HEIGHT, "{name}");
                }
                let report = bench.report();
                let keys = [
                    "method",
                    "iterations",
                    "size",
                    "seconds",
                    "residual_rms",
                    "gain",
                    "shift_px",
                    "local_shift_px",
                    "guide_weights",
                    "guide_replaced",
                    "psf_scale",
                    "mean_dolp",
                    "valid_fraction",
                    "workspace_bytes",
                    "calibration",
                    "peak_rss_bytes",
                    "model",
                    "warnings",
                ];
                assert!(keys.iter().all(|key| report.get(key).is_some()), "{report}");
                for key in ["load", "prepare", "register", "recon", "fusion", "total"] {
                    assert!(report["seconds"][key].as_f64().is_some_and(|s| s >= 0.0), "{key}: {report}");
                }
                assert_eq!((&report["method"], &report["size"]), (&method.into(), &serde_json::json!([WIDTH, HEIGHT])));
                let gains = match &report["gain"] {
                    Value::Array(gains) => gains.len(),
                    gain => usize::from(gain.is_number()),
                };
                assert_eq!(gains, if guide { stokes.shape.iter().product::<usize>() / (3 * PIXELS) } else { 0 });

                let scores = json(&["evaluate", &bench.text("out/angles.npy"), &bench.text("truth.npy")]);
                let psnr = scores["psnr"].as_f64().unwrap();
                assert!(psnr > if guide { 25.0 } else { 12.0 }, "{color}, {angles} angles, {method}: {psnr} dB");
                assert!(scores["dolp_mae"].as_f64().unwrap() < 0.5 && scores["ssim"].is_number(), "{scores}");
            }
        }
    }
}

#[test]
fn a_psf_of_another_size_is_refitted_unless_it_is_to_be_taken_as_it_is() {
    let out = Path::new(env!("CARGO_TARGET_TMPDIR")).join("cli-spheres");
    done(&["simulate", "--scene", "spheres", "--size", "128", "--out", out.to_str().unwrap()]);
    let bench = Bench::new(&out);
    let calibrated = read_npy(&bench.path("psf.npy")).unwrap();
    let size = Size::new(128, 128);
    let psf = Psf::new(Stack::from_vec(1, size, calibrated.clone().into_f32()).unwrap(), size, 1).unwrap();
    bench.write("psf.npy", &calibrated.shape, psf.scaled(1.02).channel(0));
    for (refit, scale) in [("on", 1.0 / 1.02), ("off", 1.0)] {
        let run = bench.reconstruct("raw.npy", &["--guide", &bench.text("guide.npy"), "--refit-psf", refit]);
        assert_eq!(run.code, 0, "{}", run.stderr);
        let found = bench.report()["psf_scale"].as_f64().unwrap();
        assert!((found - scale).abs() < if refit == "on" { 0.004 } else { 1e-9 }, "{refit}: {found}");
    }
}

#[test]
fn json_is_alone_on_stdout_and_logs_on_stderr() {
    let bench = Bench::new(&GRAY);
    bench.edit_raw(|i, v| if i % 20 == 0 { u16::MAX } else { v });
    let run = bench.reconstruct("raw.npy", &["--json"]);
    assert_eq!(run.code, 0, "{}", run.stderr);
    let mut printed: Value = serde_json::from_str(&run.stdout).unwrap();
    assert!(run.stderr.contains("WARN") && run.stderr.contains("saturated"), "{}", run.stderr);
    let mut written = bench.report();
    // The file is written before the process ends, and may say a little less of its memory.
    for report in [&mut printed, &mut written] {
        report.as_object_mut().unwrap().remove("peak_rss_bytes");
    }
    assert_eq!(printed, written);

    assert!(json(&["boards"])["boards"].is_array());
    let sim = json(&["simulate", "--size", "32", "--out", &bench.text("sim")]);
    assert_eq!((&sim["width"], &sim["channels"]), (&32.into(), &1.into()));
    std::fs::create_dir(bench.path("truths")).unwrap();
    std::fs::copy(bench.path("truth.npy"), bench.path("truths/angles.npy")).unwrap();
    let folders = json(&["evaluate", &bench.text("out"), &bench.text("truths")]);
    assert!(folders["mean"]["psnr"].is_number() && folders["files"].is_array(), "{folders}");
    let failed = bench.reconstruct("nothing.npy", &["--json"]);
    assert_eq!((failed.code, failed.stdout.as_str()), (66, ""));
    assert!(failed.stderr.contains("nothing.npy: no such file"), "{}", failed.stderr);
}

#[test]
fn cameras_names_every_backend_and_why_one_is_missing() {
    let listed = json(&["cameras"]);
    let backends = listed["backends"].as_array().unwrap();
    let names: Vec<_> = backends.iter().map(|backend| backend["name"].as_str().unwrap()).collect();
    assert_eq!(names, ["sim", "replay", "libcamera", "v4l2", "genicam"]);
    assert_eq!(backends[0]["cameras"][0]["source"], "plastic");
    let text = done(&["cameras"]).stdout;
    for (backend, built) in
        backends[2..].iter().zip([cfg!(feature = "libcamera"), cfg!(feature = "v4l2"), cfg!(feature = "genicam")])
    {
        assert_eq!(backend["available"], built);
        let name = backend["name"].as_str().unwrap();
        assert_eq!(text.contains(&format!("cargo build --features {name}")), !built, "{text}");
    }
}

#[test]
fn what_is_captured_can_be_replayed_frame_by_frame() {
    let dir = tempfile::tempdir().unwrap();
    let session = dir.path().join("session");
    let shipped = std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("boards/x86-sim.toml")).unwrap();
    let board = dir.path().join("small.toml");
    std::fs::write(&board, shipped.replace("wedges,size=250", "wedges,size=48")).unwrap();
    let (board, to) = (board.to_str().unwrap().to_owned(), session.to_str().unwrap().to_owned());
    let answer = json(&["capture", "--board", &board, "--frames", "3", "--out", &to]);
    assert_eq!((&answer["frames"], &answer["formats"]), (&3.into(), &serde_json::json!(["mono16", "mono12"])));
    let said: Value = serde_json::from_slice(&std::fs::read(session.join("session.json")).unwrap()).unwrap();
    let sequences = |role: usize| {
        let frames = said["cameras"][role]["frames"].as_array().unwrap();
        frames.iter().map(|frame| frame["sequence"].as_u64().unwrap()).collect::<Vec<_>>()
    };
    assert_eq!(sequences(0), sequences(1), "frames of the same instants");
    assert_eq!(sequences(0).len(), 3);

    // replayed, captured again: the same frames
    let text = std::fs::read_to_string(&board).unwrap().replace("backend = \"sim\"", "backend = \"replay\"");
    let replay = dir.path().join("replay.toml");
    let text = text.replace("source = \"wedges,size=48\"", &format!("source = {to:?}"));
    std::fs::write(&replay, text.replace("frame_rate = 10.0", "paced = false")).unwrap();
    let again = dir.path().join("again");
    json(&["capture", "--board", replay.to_str().unwrap(), "--frames", "3", "--out", again.to_str().unwrap()]);
    for file in ["raw/000000.npy", "raw/000002.npy", "guide/000001.npy"] {
        assert_eq!(std::fs::read(session.join(file)).unwrap(), std::fs::read(again.join(file)).unwrap(), "{file}");
    }

    let refused = stokescope(&["capture", "--board", &board, "--out", &to]);
    assert_eq!((refused.code, refused.stdout.as_str()), (2, ""), "{}", refused.stderr);
    let one = dir.path().join("one");
    let answer = done(&["capture", "--board", &board, "--raw-only", "--out", one.to_str().unwrap()]);
    assert!(answer.stdout.contains("1 frames of each camera") && !one.join("guide").exists(), "{}", answer.stdout);
    let left: Vec<_> = std::fs::read_dir(dir.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
    assert_eq!(left.len(), 5, "nothing half-done is left: {left:?}");
}

#[test]
fn every_command_explains_itself() {
    let help = done(&["--help"]).stdout;
    let commands: Vec<&str> = help
        .lines()
        .skip_while(|line| *line != "Commands:")
        .skip(1)
        .map_while(|line| line.strip_prefix("  ").and_then(|line| line.split_whitespace().next()))
        .collect();
    for command in ["reconstruct", "simulate", "evaluate", "boards"] {
        assert!(commands.contains(&command), "{help}");
    }
    for command in commands {
        let help = done(&[command, "--help"]).stdout;
        assert!(help.contains("Usage:") && help.contains("--json"), "{command}: {help}");
    }
    assert!(done(&["--version"]).stdout.contains(env!("CARGO_PKG_VERSION")));
}

#[test]
fn every_method_can_be_named() {
    let bench = Bench::new(&GRAY);
    for method in Method::ALL.map(|m| m.to_string()).iter().map(String::as_str).chain(["auto"]) {
        let run = bench.reconstruct("raw.npy", &["--guide", &bench.text("guide.npy"), "--method", method]);
        assert_eq!(run.code, 0, "{method}: {}", run.stderr);
        assert_eq!(bench.report()["method"], if method == "auto" { "guided" } else { method });
        assert!(bench.floats("out/angles.npy").iter().all(|v| v.is_finite()), "{method}");
    }
}

#[test]
fn counts_are_the_same_from_every_file_format() {
    for (sim, channels) in [(&*GRAY, 1), (&*RGB, 3)] {
        let bench = Bench::new(sim);
        let Values::U16(planar) = read_npy(&bench.path("raw.npy")).unwrap().samples else { panic!("counts") };
        let interleaved: Vec<u16> =
            (0..PIXELS).flat_map(|i| (0..channels).map(move |c| c * PIXELS + i)).map(|at| planar[at]).collect();
        let (width, height) = (WIDTH as u32, HEIGHT as u32);
        let color = if channels == 1 { image::ExtendedColorType::L16 } else { image::ExtendedColorType::Rgb16 };
        let bytes: Vec<u8> = interleaved.iter().flat_map(|v| v.to_ne_bytes()).collect();
        image::save_buffer(bench.path("raw.png"), &bytes, width, height, color).unwrap();
        let file = std::fs::File::create(bench.path("raw.tiff")).unwrap();
        let mut tiff = tiff::encoder::TiffEncoder::new(file).unwrap();
        if channels == 1 {
            tiff.write_image::<tiff::encoder::colortype::Gray16>(width, height, &interleaved).unwrap();
        } else {
            tiff.write_image::<tiff::encoder::colortype::RGB16>(width, height, &interleaved).unwrap();
        }
        let expected = bench.stokes("raw.npy");
        assert_eq!(bench.stokes("raw.png"), expected, "PNG, {channels} channels");
        assert_eq!(bench.stokes("raw.tiff"), expected, "TIFF, {channels} channels");
    }
}

#[test]
fn a_camera_without_a_mask_measures_intensity_alone() {
    let bench = Bench::new(&GRAY);
    bench.edit("kind = \"stripes\"\nangles_deg = [0, 45, 90, 135]\nstripes = 16", "kind = \"none\"");
    let run = bench.reconstruct("raw.npy", &[]);
    assert_eq!(run.code, 0, "{}", run.stderr);
    assert_eq!(read_npy(&bench.path("out/stokes.npy")).unwrap().shape, [1, HEIGHT, WIDTH]);
    assert!(bench.path("out/intensity.png").exists() && !bench.path("out/dolp.png").exists());
    assert_eq!(bench.report()["mean_dolp"], Value::Null);
    let run = bench.reconstruct("raw.npy", &["--method", "fista"]);
    assert_eq!(run.code, 2, "{}", run.stderr);
    assert!(run.stderr.contains("allowed: stokes, guided"), "{}", run.stderr);
}

#[test]
fn a_measured_mask_does_what_the_described_one_does() {
    let bench = Bench::new(&GRAY);
    let expected = bench.stokes("raw.npy");
    let angles = [0.0f32, 45.0, 90.0, 135.0];
    let malus = |p: usize, i: usize| (angles[p] - angles[i % WIDTH * 16 / WIDTH % 4]).to_radians().cos().powi(2);
    let mask: Vec<f32> = (0..4 * PIXELS).map(|i| malus(i / PIXELS, i % PIXELS)).collect();
    bench.write("mask.npy", &[4, HEIGHT, WIDTH], &mask);
    bench.edit("kind = \"stripes\"", "kind = \"measured\"");
    bench.edit("stripes = 16", "file = \"mask.npy\"");
    assert!(difference(&bench.stokes("raw.npy"), &expected) < 1e-3);
}

#[test]
fn a_dark_frame_takes_away_what_it_shows() {
    let bench = Bench::new(&GRAY);
    let expected = bench.stokes("raw.npy");
    let pattern = |i: usize| (i % 7 * 100) as u16;
    bench.edit_raw(|i, v| v + pattern(i));
    let spoiled = difference(&bench.stokes("raw.npy"), &expected);
    let dark: Vec<f32> = (0..PIXELS).map(|i| 1024.0 + f32::from(pattern(i))).collect();
    bench.write("dark.npy", &[HEIGHT, WIDTH], &dark);
    bench.edit("[mask]", "[dark]\nfile = \"dark.npy\"\n[mask]");
    let corrected = difference(&bench.stokes("raw.npy"), &expected);
    assert!(corrected < 1e-4 && corrected < 0.1 * spoiled, "{corrected:e}, without the dark frame {spoiled:e}");
}

/// Adds lines to the table of the sensor.
fn sensor(b: &Bench, lines: &str) {
    b.edit("channels = 1\n", &format!("channels = 1\n{lines}\n"));
}

#[test]
fn a_cropped_and_binned_capture_has_the_result_of_its_means() {
    let plain = Bench::new(&GRAY);
    assert_eq!(plain.reconstruct("raw.npy", &[]).code, 0);
    let fine = Bench::new(&GRAY);
    // two readings a side for each pixel, and rows above and below that are cropped
    let Values::U16(counts) = read_npy(&fine.path("raw.npy")).unwrap().samples else { panic!("raw frames are counts") };
    let (width, height) = (2 * WIDTH, 2 * HEIGHT + 5);
    let at = |x: usize, y: usize| match y.checked_sub(3) {
        Some(y) if y < 2 * HEIGHT => counts[y / 2 * WIDTH + x / 2],
        _ => u16::MAX,
    };
    let frame: Vec<u16> = (0..width * height).map(|i| at(i % width, i / width)).collect();
    write_npy(&fine.path("raw.npy"), &[height, width], &frame).unwrap();
    fine.edit("width = 48", &format!("width = {width}"));
    fine.edit("height = 40", &format!("height = {height}"));
    sensor(&fine, "crop = [0, 3, 96, 80]\nbin = 2");
    fine.edit("read = 0.002", "read = 0.004");
    let run = fine.reconstruct("raw.npy", &[]);
    assert_eq!(run.code, 0, "{}", run.stderr);
    assert_eq!(fine.floats("out/stokes.npy"), plain.floats("out/stokes.npy"));
}

/// A way to spoil a bundle, the exit code and what the message must say.
type Fault = (&'static str, fn(&Bench), i32, &'static [&'static str]);

const BUNDLES: &[Fault] = &[
    (
        "no description",
        |b| std::fs::remove_file(b.path("calibration.toml")).unwrap(),
        66,
        &["calibration.toml: no such file"],
    ),
    ("no psf", |b| std::fs::remove_file(b.path("psf.npy")).unwrap(), 66, &["psf.npy: no such file"]),
    ("psf zero", |b| psf(b, |_, _| 0.0), 65, &["psf.npy", "no light", "0", "> 0"]),
    (
        "psf NaN",
        |b| psf(b, |i, v| if i == 3 * WIDTH + 5 { f32::NAN } else { v }),
        65,
        &["psf.npy", "1 samples", "row 3, column 5"],
    ),
    ("psf constant", |b| psf(b, |_, _| 0.25), 65, &["psf.npy", "constant at 0.25"]),
    ("psf saturated", |b| psf(b, |_, v| v.min(1e-4)), 65, &["psf.npy", "saturated", "allowed: 5 %"]),
    ("psf negative", |b| psf(b, |i, v| if i % 2 == 0 { -v } else { v }), 65, &["psf.npy", "negative"]),
    (
        "psf of another size",
        |b| b.write("psf.npy", &[PIXELS / 8, 8], &b.floats("psf.npy")),
        65,
        &["psf.npy", "8×240", "48×40"],
    ),
    (
        "psf of two planes",
        |b| b.write("psf.npy", &[2, HEIGHT, WIDTH], &[1.0; 2 * PIXELS]),
        65,
        &["psf.npy", "2 planes", "1 or 1"],
    ),
    (
        "psf of one axis",
        |b| b.write("psf.npy", &[PIXELS], &b.floats("psf.npy")),
        65,
        &["psf.npy", "[1920]", "[height, width]"],
    ),
    ("an angle missing", |b| b.edit("[0, 45, 90, 135]", "[0, 90]"), 78, &["calibration.toml", "0°, 90°", "at least 3"]),
    (
        "angles overlapping",
        |b| b.edit("[0, 45, 90, 135]", "[0, 45, 90, 180]"),
        78,
        &["calibration.toml", "0° and 180° overlap"],
    ),
    ("too many stripes", |b| b.edit("stripes = 16", "stripes = 100"), 78, &["100 stripes", "48 pixels", "4 to 48"]),
    ("no stripes", |b| b.edit("stripes = 16\n", "\n"), 78, &["calibration.toml:16: mask.stripes = missing"]),
    ("a mask of another size", |b| mask(b, &[4, 10, 10], 0.5), 65, &["mask.npy", "10×10", "48×40"]),
    ("a mask with a plane missing", |b| mask(b, &[3, HEIGHT, WIDTH], 0.5), 65, &["mask.npy", "3 planes", "expected 4"]),
    (
        "a mask that does not polarize",
        |b| mask(b, &[4, HEIGHT, WIDTH], 0.5),
        65,
        &["mask.npy", "does not depend on its angle"],
    ),
    ("a mask with NaN", |b| mask(b, &[4, HEIGHT, WIDTH], f32::NAN), 65, &["mask.npy", "NaN", "row 0, column 0"]),
    ("a dark frame of another size", |b| dark(b, &[8, 8], 0.0), 65, &["dark.npy", "8×8", "48×40"]),
    ("a dark frame with NaN", |b| dark(b, &[HEIGHT, WIDTH], f32::NAN), 65, &["dark.npy", "NaN"]),
    ("a dark frame at saturation", |b| dark(b, &[HEIGHT, WIDTH], 65535.0), 65, &["dark.npy", "65535"]),
    (
        "a mistyped key",
        |b| b.edit("width =", "widht ="),
        78,
        &["calibration.toml:4:1:", "widht", "did you mean `width`?"],
    ),
    ("a mistyped table", |b| b.edit("[noise]", "[nose]"), 78, &["calibration.toml:10:", "did you mean `noise`?"]),
    (
        "a mistyped kind",
        |b| b.edit("\"stripes\"", "\"stripe\""),
        78,
        &["calibration.toml:16:", "did you mean `stripes`?"],
    ),
    (
        "a value of the wrong type",
        |b| b.edit("height = 40", "height = \"40\""),
        78,
        &["calibration.toml:5:10:", "invalid type"],
    ),
    (
        "a crop that leaves the frame",
        |b| sensor(b, "crop = [8, 0, 48, 40]"),
        78,
        &["calibration.toml:7: sensor.crop = [8, 0, 48, 40], allowed: a part of the 48×40 pixels"],
    ),
    (
        "a crop of three numbers",
        |b| sensor(b, "crop = [8, 0, -4]"),
        78,
        &["calibration.toml:7: sensor.crop = [8, 0, -4], allowed: [x, y, width, height]"],
    ),
    (
        "blocks that do not fill the crop",
        |b| sensor(b, "crop = [0, 0, 40, 40]\nbin = 3"),
        78,
        &["calibration.toml:8: sensor.bin = 3, allowed: 1, 2, 4, 5, 8, 10", "40×40"],
    ),
    (
        "more pixels than can be worked with",
        |b| b.edit("width = 48", "width = 8192"),
        78,
        &["calibration.toml:4: sensor.width = 8192×40 pixels to work with", "at most 4096", "bin more"],
    ),
    (
        "a sensor mounted on its side",
        |b| sensor(b, "orientation = 90"),
        78,
        &["calibration.toml:7: sensor.orientation = 90, allowed: 0 or 180"],
    ),
    ("blocks that mix polarizers", |b| sensor(b, "bin = 8"), 78, &["bin = 8 mixes polarizers", "use a smaller bin"]),
    (
        "a psf of neither size",
        |b| {
            sensor(b, "bin = 2");
            b.write("psf.npy", &[PIXELS / 8, 8], &b.floats("psf.npy"));
        },
        65,
        &["psf.npy", "8×240", "48×40 (the camera's frame) or 24×20 (the working size"],
    ),
    (
        "a raw frame of neither size",
        |b| {
            sensor(b, "bin = 2");
            b.write("raw.npy", &[WIDTH, HEIGHT], &[0.5; PIXELS]);
        },
        65,
        &["1 channel(s) of 40×48", "1 of 48×40"],
    ),
    ("not TOML", |b| b.edit("[sensor]", "[sensor"), 78, &["calibration.toml:3:"]),
    ("another version", |b| b.edit("version = 1", "version = 2"), 78, &["calibration.toml:1: version = 2, allowed: 1"]),
    (
        "not UTF-8",
        |b| std::fs::write(b.path("calibration.toml"), b"name = \"\xff\"").unwrap(),
        78,
        &["byte 8 is not UTF-8"],
    ),
    ("huge", |b| std::fs::write(b.path("calibration.toml"), vec![b'\n'; 2 << 20]).unwrap(), 78, &["2097152 bytes"]),
    (
        "values out of range",
        out_of_range,
        78,
        &[
            "calibration.toml:4: sensor.width = 0, allowed: 1 to",
            "calibration.toml:6: sensor.channels = 2, allowed: 1 or 3",
            "calibration.toml:7: sensor.bit_depth = 9, allowed: 8",
            "calibration.toml:11: noise.read = -1.0, allowed: 0 to 1",
            "guide.homography = [1.0], allowed: 9 finite numbers",
        ],
    ),
    ("not a number", |b| b.edit("read = 0.002", "read = nan"), 78, &["noise.read = NaN"]),
    ("an infinite angle", |b| b.edit("[0, 45, 90, 135]", "[0, 45, 90, inf]"), 78, &["calibration.toml", "inf"]),
    (
        "a raw frame that is elsewhere",
        |b| std::fs::remove_file(b.path("raw.npy")).unwrap(),
        66,
        &["raw.npy: no such file"],
    ),
    (
        "a raw frame of another camera",
        |b| b.write("raw.npy", &[WIDTH, HEIGHT], &[0.5; PIXELS]),
        65,
        &["1 channel(s) of 40×48", "1 of 48×40"],
    ),
    (
        "a colour raw frame",
        |b| b.write("raw.npy", &[3, HEIGHT, WIDTH], &[0.5; 3 * PIXELS]),
        65,
        &["3 channel(s)", "the bundle is for 1"],
    ),
    (
        "a guide of another size",
        |b| {
            b.edit(
                "homography = [1.0, 0.0, 9.0, 0.0, 1.0, 9.0, 0.0, 0.0, 1.0]",
                "homography = [1, 0, 0, 0, 1, 0, 0, 0, 1]",
            );
            b.write("guide.npy", &[24, 24], &[0.5; 576]);
        },
        65,
        &["guide frame is 24×24", "48×40", "homography"],
    ),
    (
        "a raw frame of NaN",
        |b| b.write("raw.npy", &[HEIGHT, WIDTH], &[f32::NAN; PIXELS]),
        65,
        &["none of the 1920 readings", "100.0 % NaN"],
    ),
    (
        "a raw frame at saturation",
        |b| b.edit_raw(|_, _| u16::MAX),
        65,
        &["none of the 1920 readings", "100.0 % saturated"],
    ),
];

fn psf(bench: &Bench, mut change: impl FnMut(usize, f32) -> f32) {
    let values: Vec<f32> = bench.floats("psf.npy").into_iter().enumerate().map(|(i, v)| change(i, v)).collect();
    bench.write("psf.npy", &[HEIGHT, WIDTH], &values);
}

fn mask(bench: &Bench, shape: &[usize], value: f32) {
    bench.write("mask.npy", shape, &vec![value; shape.iter().product()]);
    bench.edit("kind = \"stripes\"", "kind = \"measured\"");
    bench.edit("stripes = 16", "file = \"mask.npy\"");
}

fn dark(bench: &Bench, shape: &[usize], value: f32) {
    bench.write("dark.npy", shape, &vec![value; shape.iter().product()]);
    bench.edit("[mask]", "[dark]\nfile = \"dark.npy\"\n[mask]");
}

fn out_of_range(bench: &Bench) {
    bench.edit("width = 48", "width = 0");
    bench.edit("channels = 1", "channels = 2");
    bench.edit("bit_depth = 16", "bit_depth = 9");
    bench.edit("read = 0.002", "read = -1.0");
    bench.edit("black_level = 1024\nsaturation = 65535\n", "\n\n");
    bench.edit("homography = [1.0, 0.0, 9.0, 0.0, 1.0, 9.0, 0.0, 0.0, 1.0]", "homography = [1]");
}

#[test]
fn a_bundle_or_frame_that_cannot_be_used_is_refused_with_the_reason() {
    let mut wrong = String::new();
    for (what, spoil, code, fragments) in BUNDLES {
        let bench = Bench::new(&GRAY);
        spoil(&bench);
        let run = bench.reconstruct("raw.npy", &["--guide", &bench.text("guide.npy")]);
        let missing: Vec<_> = fragments.iter().filter(|f| !run.stderr.contains(**f)).collect();
        if run.code != *code || !missing.is_empty() {
            wrong += &format!("{what}: code {} for {code}, missing {missing:?} in {}\n", run.code, run.stderr);
        }
        assert_eq!(run.stdout, "", "{what}");
        bench.assert_no_result(what);
    }
    assert!(wrong.is_empty(), "{wrong}");
}

#[test]
fn poor_captures_are_reconstructed_with_a_warning() {
    type Capture = (&'static str, fn(&Bench), &'static str);
    let captures: [Capture; 5] = [
        (
            "saturated",
            |b| b.edit_raw(|i, v| if i % 5 < 2 { u16::MAX } else { v }),
            "40.0 % of the raw readings are saturated",
        ),
        ("dark", |b| b.edit_raw(|_, _| 1024), "dark"),
        ("below black", |b| b.edit_raw(|_, _| 1000), "dark"),
        ("blank", |b| b.edit_raw(|_, _| 20_000), "blank"),
        (
            "NaN",
            |b| {
                let mut raw: Vec<f32> = b.floats("raw.npy").iter().map(|v| (v - 1024.0) / 64511.0).collect();
                (raw[7], raw[900]) = (f32::NAN, f32::INFINITY);
                b.write("raw.npy", &[HEIGHT, WIDTH], &raw);
            },
            "0.104 % of the raw readings are NaN or infinite",
        ),
    ];
    for (what, spoil, warning) in captures {
        let bench = Bench::new(&GRAY);
        spoil(&bench);
        for guide in [true, false] {
            let path = bench.text("guide.npy");
            let mut more = if guide { vec!["--guide", &path] } else { vec![] };
            if what == "dark" {
                let run = bench.reconstruct("raw.npy", &more);
                assert!(run.code == 65 && run.stderr.contains("too little light"), "{}", run.stderr);
            }
            more.push("--force");
            let run = bench.reconstruct("raw.npy", &more);
            assert_eq!(run.code, 0, "{what}: {}", run.stderr);
            let report = bench.report();
            let warnings = report["warnings"].as_array().unwrap();
            assert!(warnings.iter().any(|w| w.as_str().unwrap().contains(warning)), "{what}: {warnings:?}");
            for name in ["out/angles.npy", "out/stokes.npy"] {
                assert!(bench.floats(name).iter().all(|v| v.is_finite()), "{what}: {name}");
            }
            if what == "saturated" {
                assert!(report["valid_fraction"].as_f64().unwrap() <= 0.6 + 1e-6, "{report}");
            }
        }
    }
}

/// PNG's CRC-32.
fn crc(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(!0, |crc, b| {
        (0..8).fold(crc ^ u32::from(*b), |crc, _| (crc >> 1) ^ (0xEDB8_8320 & (crc & 1).wrapping_neg()))
    })
}

/// Damaged files of the three formats: name and bytes.
fn damaged() -> Vec<(String, Vec<u8>)> {
    let bench = Bench::new(&GRAY);
    let npy = std::fs::read(bench.path("raw.npy")).unwrap();
    let bytes = &npy[npy.len() - 2 * PIXELS..];
    let (width, height) = (WIDTH as u32, HEIGHT as u32);
    let png_path = bench.path("a.png");
    image::save_buffer(&png_path, bytes, width, height, image::ExtendedColorType::L16).unwrap();
    let png = std::fs::read(png_path).unwrap();
    let mut tiff = std::io::Cursor::new(Vec::new());
    let counts: Vec<u16> = bytes.as_chunks().0.iter().map(|b| u16::from_le_bytes(*b)).collect();
    let mut encoder = tiff::encoder::TiffEncoder::new(&mut tiff).unwrap();
    encoder.write_image::<tiff::encoder::colortype::Gray16>(width, height, &counts).unwrap();
    let tiff = tiff.into_inner();

    let header = |text: &str| {
        let mut file = b"\x93NUMPY\x01\x00".to_vec();
        file.extend((text.len() as u16).to_le_bytes());
        file.extend(text.bytes());
        file.extend([0; 64]);
        file
    };
    let shape = |shape: &str, descr: &str| {
        header(&format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}\n"))
    };
    let mut huge_png = png.clone();
    huge_png[16..24].copy_from_slice(&[0x3B, 0x9A, 0xCA, 0, 0x3B, 0x9A, 0xCA, 0]);
    let sum = crc(&huge_png[12..29]);
    huge_png[29..33].copy_from_slice(&sum.to_be_bytes());
    let mut broken_png = png.clone();
    let middle = broken_png.len() / 2;
    broken_png[middle] ^= 0xFF;
    // Width and height are the tags 256 and 257 of the directory; a value follows 8 bytes after its tag.
    let mut huge_tiff = tiff.clone();
    let directory = u32::from_le_bytes(tiff[4..8].try_into().unwrap()) as usize;
    for entry in (directory + 2..tiff.len() - 11).step_by(12) {
        if let [0 | 1, 1] = tiff[entry..entry + 2] {
            huge_tiff[entry + 2..entry + 12].copy_from_slice(&[4, 0, 1, 0, 0, 0, 0, 0xCA, 0x9A, 0x3B]);
        }
    }
    let files: [(&str, &[u8]); 18] = [
        ("empty", &[]),
        ("text.npy", b"not an image at all, only words"),
        ("magic only.npy", b"\x93NUMPY"),
        ("truncated.npy", &npy[..npy.len() / 2]),
        ("one byte short.npy", &npy[..npy.len() - 1]),
        ("one byte long.npy", &[&npy[..], &[0]].concat()),
        ("absurd.npy", &shape("(1000000000, 1000000000)", "<u2")),
        ("overflow.npy", &shape("(18446744073709551615, 18446744073709551615, 3)", "<f4")),
        ("negative.npy", &shape("(-1, 8)", "<u2")),
        ("zero.npy", &shape("(0, 8)", "<u2")),
        ("integers.npy", &shape("(4, 4)", "<i4")),
        ("objects.npy", &shape("(8,)", "|O")),
        ("garbage.npy", &header("{{{{{{{{{{'")),
        ("truncated.png", &png[..png.len() / 2]),
        ("broken.png", &broken_png),
        ("absurd.png", &huge_png),
        ("truncated.tiff", &tiff[..tiff.len() / 2]),
        ("absurd.tiff", &huge_tiff),
    ];
    files.map(|(name, bytes)| (name.to_owned(), bytes.to_vec())).to_vec()
}

#[test]
fn damaged_frames_are_refused_at_once() {
    let bench = Bench::new(&GRAY);
    for (name, bytes) in damaged() {
        std::fs::write(bench.path(&name), bytes).unwrap();
        let path = bench.text(&name);
        for (raw, more) in [(name.as_str(), vec![]), ("raw.npy", vec!["--guide", &path])] {
            let start = Instant::now();
            let run = bench.reconstruct(raw, &more);
            assert_eq!(run.code, 65, "{name}: {}", run.stderr);
            assert!(run.stderr.contains(&name), "{name}: {}", run.stderr);
            assert!(start.elapsed() < Duration::from_secs(5), "{name}: {:?}", start.elapsed());
            bench.assert_no_result(&name);
        }
    }
    let folder = bench.reconstruct(".", &[]);
    assert!([2, 65].contains(&folder.code), "a folder of damaged frames: {}", folder.stderr);
}

#[test]
fn damaged_arrays_of_a_bundle_are_refused_too() {
    for (name, bytes) in damaged().into_iter().filter(|(name, _)| name.ends_with(".npy")) {
        let bench = Bench::new(&GRAY);
        std::fs::write(bench.path("psf.npy"), bytes).unwrap();
        let run = bench.reconstruct("raw.npy", &[]);
        assert_eq!(run.code, 65, "{name}: {}", run.stderr);
        assert!(run.stderr.contains("psf.npy"), "{name}: {}", run.stderr);
        bench.assert_no_result(&name);
    }
}

#[test]
fn what_cannot_be_evaluated_is_said() {
    let bench = Bench::new(&GRAY);
    let truth = bench.text("truth.npy");
    bench.write("small.npy", &[4, 20, 20], &[0.5; 1600]);
    bench.write("nan.npy", &[4, HEIGHT, WIDTH], &[f32::NAN; 4 * PIXELS]);
    for (estimate, code, fragment) in [
        ("none.npy", 66, "no such file"),
        ("small.npy", 65, "[4, 20, 20]"),
        ("raw.npy", 65, "[40, 48]"),
        ("nan.npy", 65, "NaN"),
    ] {
        let run = stokescope(&["evaluate", &bench.text(estimate), &truth]);
        assert_eq!((run.code, run.stdout.as_str()), (code, ""), "{estimate}: {}", run.stderr);
        assert!(run.stderr.contains(fragment), "{estimate}: {}", run.stderr);
    }
}

#[test]
fn a_folder_that_cannot_be_written_is_named() {
    let bench = Bench::new(&GRAY);
    // Below a regular file nothing can be made, whoever runs the test.
    let out = format!("{}/out", bench.text("raw.npy"));
    let (calibration, raw) = (bench.0.path().to_str().unwrap(), bench.text("raw.npy"));
    let runs = [
        stokescope(&["simulate", "--size", "32", "--out", &out]),
        stokescope(&["reconstruct", "--calibration", calibration, "--raw", &raw, "--iterations", "5", "--out", &out]),
    ];
    for run in runs {
        assert_eq!((run.code, run.stdout.as_str()), (73, ""), "{}", run.stderr);
        assert!(run.stderr.contains(&out), "{}", run.stderr);
    }
}

#[test]
fn what_is_asked_wrongly_ends_with_code_2() {
    let bench = Bench::new(&GRAY);
    let sim = bench.text("sim");
    for (args, fragment) in [
        (vec![], "Usage"),
        (vec!["reconstrct"], "reconstruct"),
        (vec!["reconstruct"], "--calibration"),
        (vec!["simulate", "--out", &sim, "--angles", "5"], "3..=4"),
        (vec!["simulate", "--out", &sim, "--size", "big"], "WIDTHxHEIGHT"),
        (vec!["simulate", "--out", &sim, "--size", "4"], "allowed: 16 to 2048"),
        (vec!["simulate", "--out", &sim, "--noise", "-1"], "'-1'"),
        (vec!["simulate", "--out", &sim, "--noise", "nan"], "noise"),
        (vec!["evaluate", "one.npy"], "<TRUTH>"),
    ] {
        let run = stokescope(&args);
        assert_eq!(run.code, 2, "{args:?}: {}", run.stderr);
        assert!(run.stderr.contains(fragment) && run.stdout.is_empty(), "{args:?}: {}", run.stderr);
    }
    assert!(!bench.path("sim").exists());
    for (more, fragment) in [
        (["--method", "guided"], "needs a guide"),
        (["--method", "best"], "fista-published"),
        (["--threads", "0"], "1..=64"),
        (["--fft", "fftw"], "rustfft"),
    ] {
        let run = bench.reconstruct("raw.npy", &more);
        assert_eq!(run.code, 2, "{more:?}: {}", run.stderr);
        assert!(run.stderr.contains(fragment), "{more:?}: {}", run.stderr);
        bench.assert_no_result(more[1]);
    }
    let unknown = stokescope(&["simulate", "--scene", "moon", "--out", &sim]);
    assert_eq!(unknown.code, 66, "{}", unknown.stderr);
    assert!(unknown.stderr.contains("plastic, spheres, wedges, tissue") && !bench.path("sim").exists());
}

#[test]
fn plan_says_bytes_and_milliseconds_of_every_stage() {
    let text = stokescope(&["plan", "--board", "rpi-zero-2w", "--size", "64"]);
    assert_eq!(text.code, 0, "{}", text.stderr);
    for line in ["recon ", "peak ", "3 × cortex-a53 at 1000 MHz, 5 iterations, estimated", "iterations ", "frames "] {
        assert!(text.stdout.contains(line), "{line} in {}", text.stdout);
    }
    let json = stokescope(&["--json", "plan", "--board", "rpi-zero-2w", "--size", "64"]);
    let plan: serde_json::Value = serde_json::from_str(&json.stdout).unwrap();
    let bytes: u64 = plan["stages"].as_object().unwrap().values().map(|bytes| bytes.as_u64().unwrap()).sum();
    assert_eq!(plan["total_bytes"], bytes);
    let times = &plan["times"];
    assert_eq!(times["measured"], false);
    let stages = times["milliseconds"].as_object().unwrap();
    let most: f64 = stages.values().map(|range| range[1].as_f64().unwrap()).sum();
    let slowest = times["frames_per_second"][0].as_f64().unwrap();
    assert!(stages.contains_key("start") && (slowest * most / 1e3 - 1.0).abs() < 1e-6, "{times}");
    let with_margin = times["frames_per_second_with_margin"][0].as_f64().unwrap();
    assert!((0.3 * slowest..0.8 * slowest).contains(&with_margin), "{times}");
}

#[cfg(target_os = "linux")]
#[test]
fn fault_33_standard_output_that_is_closed_or_full_ends_quietly_or_with_a_message() {
    use std::process::{Command, Stdio};
    let run = |arguments: &[&str], out: Stdio, log: Stdio| {
        Command::new(env!("CARGO_BIN_EXE_stokescope")).args(arguments).stdout(out).stderr(log).output().unwrap()
    };
    let full = || Stdio::from(std::fs::OpenOptions::new().write(true).open("/dev/full").unwrap());
    for arguments in [["boards", "--json"].as_slice(), &["plan", "--board", "x86-sim"], &["cameras", "--json"]] {
        let (reader, writer) = std::io::pipe().unwrap();
        drop(reader);
        let closed = run(arguments, writer.into(), Stdio::piped());
        assert_eq!((closed.status.code(), closed.stderr.len()), (Some(0), 0), "{arguments:?}");
        let output = run(arguments, full(), Stdio::piped());
        let text = String::from_utf8(output.stderr).unwrap();
        assert_eq!((output.status.code(), text.lines().count()), (Some(74), 1), "{arguments:?}: {text}");
        assert!(text.contains("standard output") && !text.contains("panicked"), "{text}");
        assert_eq!(run(arguments, full(), full()).status.code(), Some(74));
    }
    assert_eq!(run(&["plan", "--board", "none"], Stdio::piped(), full()).status.code(), Some(66));
}

#[cfg(target_os = "linux")]
#[test]
fn fault_16_without_memory_or_threads_it_ends_with_a_sentence_and_never_with_a_signal() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out");
    let run = |megabytes: u32| {
        let text = format!(
            "ulimit -v {}; exec '{}' run --board x86-sim --frames 1 --no-preview --out '{}'",
            megabytes << 10,
            env!("CARGO_BIN_EXE_stokescope"),
            out.display()
        );
        std::process::Command::new("sh").args(["-c", &text]).output().unwrap()
    };
    let mut refused = 0;
    // The kernel kills a program that it cannot even map.
    let mapped = std::fs::metadata(env!("CARGO_BIN_EXE_stokescope")).unwrap().len() >> 20;
    for megabytes in (mapped as u32 + 8..mapped as u32 + 240).step_by(16) {
        let output = run(megabytes);
        let text = String::from_utf8_lossy(&output.stderr);
        let code = output.status.code();
        // the system's loader needs some memory as well
        let started = !text.contains("loading shared libraries") && !text.contains("failed to map");
        assert!(!started || [Some(0), Some(70), Some(78)].contains(&code), "{megabytes} MB: {code:?} {text}");
        assert!(!started || code == Some(0) || text.contains("ERROR"), "{megabytes} MB: {code:?} {text}");
        refused += u32::from(started && code != Some(0));
    }
    assert!(refused > 0, "no limit was too small");
}

#[cfg(target_os = "linux")]
#[test]
fn devices_pipes_and_folders_are_refused_by_every_reader() {
    let bench = Bench::new(&GRAY);
    dark(&bench, &[HEIGHT, WIDTH], 0.01);
    let run = |words: &str| {
        // a reader without bounds gets no more than this memory; one that waits for a pipe is ended with exit code 124
        let mut command = Command::new("sh");
        command.args(["-c", "ulimit -v 1048576 && exec timeout 60 \"$@\"", "sh", env!("CARGO_BIN_EXE_stokescope")]);
        let output =
            command.args(words.split(' ')).current_dir(&bench.0).env_remove("STOKESCOPE_LOG").output().unwrap();
        (output.status.code().unwrap(), String::from_utf8(output.stderr).unwrap())
    };
    let shipped = Path::new(env!("CARGO_MANIFEST_DIR"));
    let board = std::fs::read_to_string(shipped.join("boards/x86-sim.toml")).unwrap();
    std::fs::write(bench.path("board.toml"), board.replace("size=250", "size=32").replace("\"auto\"", "\"off\""))
        .unwrap();
    std::fs::create_dir(bench.path("model")).unwrap();
    for file in ["manifest.toml", "model.onnx", "model-int8.onnx"] {
        std::fs::copy(shipped.join("tests/golden/fusion/mixes").join(file), bench.path("model").join(file)).unwrap();
    }
    let (code, text) =
        run("run --board board.toml --frames 2 --no-preview --out live --record-reserve-bytes 0 --record sessions");
    assert_eq!(code, 0, "{text}");
    let session = std::fs::read_dir(bench.path("sessions")).unwrap().flatten().find(|entry| entry.path().is_dir());
    std::fs::rename(session.unwrap().path(), bench.path("session")).unwrap();
    let solve = "reconstruct --calibration . --raw raw.npy --guide guide.npy --force --out out";
    let (code, text) = run(solve);
    assert_eq!(code, 0, "the files themselves: {text}");
    let readers = [
        ("board.toml", "plan --board board.toml".to_owned()),
        ("calibration.toml", solve.to_owned()),
        ("psf.npy", solve.to_owned()),
        ("dark.npy", solve.to_owned()),
        ("raw.npy", solve.to_owned()),
        ("raw.png", solve.replace("raw.npy", "raw.png")),
        ("raw.tif", solve.replace("raw.npy", "raw.tif")),
        ("guide.npy", solve.to_owned()),
        ("model/manifest.toml", format!("{solve} --fusion model")),
        ("model/model.onnx", format!("{solve} --fusion model --precision f32")),
        ("session/session.json", "replay session --out out".to_owned()),
        ("session/frames/00000000.json", "replay session --out out".to_owned()),
        ("session/raw/00000000.npy", "replay session --out out".to_owned()),
        ("live/report.json", "explain live".to_owned()),
    ];
    for (file, words) in readers {
        let (path, away) = (bench.path(file), bench.path("away"));
        let there = std::fs::rename(&path, &away).is_ok();
        for kind in ["device", "pipe", "folder"] {
            match kind {
                "device" => std::os::unix::fs::symlink("/dev/zero", &path).unwrap(),
                "pipe" => assert!(Command::new("mkfifo").arg(&path).status().unwrap().success()),
                // a folder in the place of a frame is a batch of its files
                _ if file.starts_with("raw.") || file == "guide.npy" => continue,
                _ => std::fs::create_dir(&path).unwrap(),
            }
            let (code, text) = run(&words);
            assert!([65, 66, 78].contains(&code), "{file}, {kind}: code {code}, {text}");
            assert!(text.contains(file) && text.contains("regular file"), "{file}, {kind}: {text}");
            if kind == "folder" { std::fs::remove_dir(&path) } else { std::fs::remove_file(&path) }.unwrap();
        }
        if there {
            std::fs::rename(&away, &path).unwrap();
        }
    }
}
