//! `stokescope simulate`: simulates a bundle, a raw frame, a guide and the truth.

use std::path::{Path, PathBuf};

use serde::Serialize;

use crate::bundle::write_simulated;
use crate::camera::sim::{Capture, Imperfections, Knowledge, Margin, SimError, SimSpec, simulator};
use crate::files::{WriteError, write_atomic, write_npy};
use stokescope_core::image::Size;

/// Simulate a capture; writes calibration.toml, psf.npy, raw.npy, guide.npy and truth.npy.
#[derive(Clone, Debug, clap::Args)]
pub struct Args {
    /// Folder for the files; created if needed.
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Built-in scene (plastic, spheres, wedges, tissue), calibration target (dark, point, uniform, film, print), or a folder with
    /// 0.png, 45.png, 90.png, 135.png or angles.npy.
    #[arg(long, default_value = "plastic", value_name = "NAME|DIR")]
    pub scene: String,
    /// Number of polarizer angles of the mask: 3 (0°, 45°, 90°) or 4 (also 135°).
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u8).range(3..=4))]
    pub angles: u8,
    /// Polarizers on single pixels (rows 90° 45° and 135° 0°, as on the Sony IMX250MZR) in place of stripes.
    #[arg(long)]
    pub mosaic: bool,
    /// One gray channel or three colour channels.
    #[arg(long, value_enum, default_value_t = Color::Gray)]
    pub color: Color,
    /// Size of the sensors in pixels: N or WIDTHxHEIGHT.
    #[arg(long, default_value = "250", value_parser = parse_size)]
    pub size: Size,
    /// Standard deviation of the read noise, as a fraction of full scale.
    #[arg(long, default_value_t = 0.002, value_name = "σ")]
    pub noise: f32,
    /// Variance of the shot noise per unit of signal [default: equal to the read noise at full scale].
    #[arg(long)]
    pub shot: Option<f32>,
    /// Shift of the guide in pixels, to the right and down.
    #[arg(long, num_args = 2, allow_negative_numbers = true, value_names = ["DX", "DY"])]
    pub shift: Option<Vec<f32>>,
    /// Flaws of the device: all, or a list of angles (of the stripes), extinction, edges, dust, drift (of the PSF), vignetting, hot
    /// (pixels), exposure, guide (its position, gain and noise).
    #[arg(long, value_name = "all|NAME,NAME", default_value = "none")]
    pub imperfect: Imperfections,
    /// Knowledge of the flaws in the bundle.
    #[arg(long, value_parser = super::values::knowledge(), default_value_t)]
    pub knowledge: Knowledge,
    /// Scene beyond the frame.
    #[command(flatten)]
    pub beyond: Beyond,
    /// Brightness of the lamp of a calibration target; the usual one is 1.
    #[arg(long, default_value_t = 1.0)]
    pub light: f32,
    /// Angle of the polarizer in front of that lamp, in degrees [default: no polarizer].
    #[arg(long, value_name = "DEGREES", allow_negative_numbers = true)]
    pub polarizer: Option<f64>,
    /// Seed of the diffuser, the details of the scene and the noise.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Number of frames; several are also written as a moving sequence to raw/, guide/ and truth/, ten per second.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..=100_000))]
    pub frames: u64,
}

/// Scene beyond the frame of a simulated device.
#[derive(Clone, Copy, Debug, clap::Args)]
pub struct Beyond {
    /// Pixels that the scene goes on beyond the frame on each side, where its light still reaches the sensor: auto is as far as the PSF
    /// reaches, 0 a field stop around the frame.
    #[arg(long, value_name = "auto|N", default_value_t = SimSpec::default().surround)]
    pub surround: Margin,
    /// Fraction of that light that passes the field stop; 1 is no stop.
    #[arg(long, value_name = "FRACTION", default_value_t = SimSpec::default().surround_level)]
    pub surround_level: f32,
    /// Pixels of the frame that the guide sees beyond it on each side: auto is as far as the PSF reaches.
    #[arg(long, value_name = "auto|N", default_value_t = SimSpec::default().guide_margin)]
    pub guide_margin: Margin,
}

/// Colour channels of the sensors.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Color {
    /// One channel.
    Gray,
    /// Red, green and blue.
    Rgb,
}

fn parse_size(text: &str) -> Result<Size, String> {
    let (width, height) = text.split_once('x').unwrap_or((text, text));
    match (width.parse(), height.parse()) {
        (Ok(width), Ok(height)) => Ok(Size::new(width, height)),
        _ => Err("allowed: a number of pixels, or WIDTHxHEIGHT".to_owned()),
    }
}

impl Args {
    fn spec(&self) -> SimSpec {
        let mut spec = SimSpec {
            mosaic: self.mosaic,
            scene: self.scene.clone(),
            angles: usize::from(self.angles),
            color: self.color == Color::Rgb,
            size: self.size,
            read_noise: self.noise,
            shot_noise: self.shot.unwrap_or(self.noise * self.noise),
            surround: self.beyond.surround,
            surround_level: self.beyond.surround_level,
            guide_margin: self.beyond.guide_margin,
            knowledge: self.knowledge,
            light: self.light,
            polarizer: self.polarizer,
            seed: self.seed,
            ..SimSpec::default()
        };
        spec.spoil(&self.imperfect);
        if let Some(shift) = self.shift.as_deref() {
            spec.shift = [shift[0], shift[1]];
        }
        spec
    }
}

/// Output of the command.
#[derive(Serialize)]
struct Output<'a> {
    out: &'a Path,
    scene: &'a str,
    channels: usize,
    angles: usize,
    width: usize,
    height: usize,
    frames: u64,
    mean_signal: f64,
}

/// Simulates, writes the files, and prints one line, or with `json` one object.
///
/// # Errors
/// Settings out of range, a scene that cannot be read, or files that cannot be written.
#[allow(clippy::print_stdout, reason = "output of the command")]
pub fn run(args: &Args, json: bool) -> Result<(), crate::Error> {
    let mut simulator = simulator(args.spec()).map_err(|e| match e {
        SimError::Range { key, found, allowed } => {
            crate::Error::Usage(format!("--{} = {found}, allowed: {allowed}", key.replace('_', "-")))
        }
        e => e.into(),
    })?;
    let out = &args.out;
    make(out)?;
    if args.frames > 1 {
        for name in ["raw", "guide", "truth"] {
            make(&out.join(name))?;
        }
    }
    let first = simulator.capture(0);
    write(&first, simulator.spec(), |name| out.join(format!("{name}.npy")))?;
    let mut times = String::new();
    for index in 0..args.frames {
        if args.frames > 1 {
            let name = |name: &str| out.join(name).join(format!("{index:06}.npy"));
            write(&simulator.capture(index), simulator.spec(), name)?;
            times += &format!("{}\n", index as f64 / simulator.spec().frame_rate);
        }
    }
    if args.frames > 1 {
        for name in ["raw", "guide"] {
            write_text(&out.join(name).join("timestamps.txt"), &times)?;
        }
    }
    let spec = simulator.spec();
    write_simulated(spec, out)?;

    let counts = first.raw.as_slice();
    let mean = counts.iter().copied().map(f64::from).sum::<f64>() / counts.len() as f64;
    let black = f64::from(spec.black_level);
    let output = Output {
        out,
        scene: &spec.scene,
        channels: spec.channels(),
        angles: spec.angles,
        width: spec.size.width,
        height: spec.size.height,
        frames: args.frames,
        mean_signal: (mean - black) / (f64::from(spec.saturation()) - black),
    };
    if json {
        println!("{}", serde_json::to_string(&output).map_err(|e| crate::Error::Internal(e.to_string()))?);
    } else {
        let Output { scene, channels, angles, frames, mean_signal, .. } = output;
        println!(
            "{}: {scene}, {}, {channels} channel(s), {angles} angles, {frames} frame(s), mean signal {mean_signal:.3} of full scale",
            out.display(),
            spec.size
        );
    }
    Ok(())
}

fn make(folder: &Path) -> Result<(), WriteError> {
    std::fs::create_dir_all(folder).map_err(|source| WriteError::Create { path: folder.to_path_buf(), source })
}

fn write_text(path: &Path, text: &str) -> Result<(), WriteError> {
    write_atomic(path, |out| out.write_all(text.as_bytes()))
}

/// Writes raw frame, guide and truth of one instant. Monochrome arrays have no channel axis.
pub(super) fn write(capture: &Capture, spec: &SimSpec, path: impl Fn(&str) -> PathBuf) -> Result<(), WriteError> {
    let shape = |planes: usize, size: Size| match (spec.color, planes) {
        (true, 1) => vec![3, size.height, size.width],
        (true, planes) => vec![3, planes, size.height, size.width],
        (false, 1) => vec![size.height, size.width],
        (false, planes) => vec![planes, size.height, size.width],
    };
    write_npy(&path("raw"), &shape(1, spec.size), capture.raw.as_slice())?;
    write_npy(&path("guide"), &shape(1, spec.guide_size()), capture.guide.as_slice())?;
    write_npy(&path("truth"), &shape(spec.angles, spec.size), capture.truth.as_slice())
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;
    use crate::bundle::Bundle;
    use crate::files::{Values, read_npy};

    #[derive(clap::Parser)]
    struct Line {
        #[command(flatten)]
        args: Args,
    }

    fn simulated(more: &[&str]) -> (tempfile::TempDir, Result<(), crate::Error>) {
        let dir = tempfile::tempdir().unwrap();
        let out = dir.path().join("new").display().to_string();
        let line = Line::try_parse_from(["simulate", "--out", &out].iter().chain(more)).unwrap();
        let done = run(&line.args, true);
        (dir, done)
    }

    #[test]
    fn a_colour_bundle_has_the_documented_shapes_and_loads() {
        let more =
            "--scene wedges --color rgb --angles 3 --size 49x32 --noise 0 --shift -1.5 2 --seed 3 --guide-margin 0";
        let (dir, done) = simulated(&more.split(' ').collect::<Vec<_>>());
        done.unwrap();
        let out = dir.path().join("new");
        let array = |name: &str| read_npy(&out.join(name)).unwrap();
        assert_eq!(array("truth.npy").shape, [3, 3, 32, 49]);
        assert_eq!(array("guide.npy").shape, [3, 32, 49]);
        assert_eq!(array("raw.npy").shape, [3, 32, 49]);
        assert!(matches!(array("raw.npy").samples, Values::U16(_)));
        Bundle::load(&out).unwrap();
    }

    #[test]
    fn a_scene_that_goes_on_has_a_guide_that_sees_more_than_the_frame() {
        let more = "--size 50x40 --surround auto --surround-level 0.5 --guide-margin 6";
        let (dir, done) = simulated(&more.split(' ').collect::<Vec<_>>());
        done.unwrap();
        let out = dir.path().join("new");
        let shape = |name: &str| read_npy(&out.join(name)).unwrap().shape;
        assert_eq!(
            (shape("guide.npy"), shape("raw.npy"), shape("truth.npy")),
            (vec![52, 62], vec![40, 50], vec![4, 40, 50])
        );
        // the frame's first pixel in the guide
        let guide = Bundle::load(&out).unwrap().device.guide.apply(0.0, 0.0);
        assert!((guide.0 - 6.0).hypot(guide.1 - 6.0) < 1e-9, "{guide:?}");
        let e = simulated(&["--surround-level", "2"]).1.unwrap_err();
        assert_eq!(e.to_string(), "--surround-level = 2, allowed: 0 to 1");
    }

    #[test]
    fn a_sequence_is_written_frame_by_frame() {
        let (dir, done) = simulated(&["--size", "32", "--frames", "3"]);
        done.unwrap();
        let out = dir.path().join("new");
        for name in ["raw", "guide", "truth"] {
            assert_eq!(
                read_npy(&out.join(name).join("000000.npy")).unwrap(),
                read_npy(&out.join(format!("{name}.npy"))).unwrap()
            );
            assert_ne!(
                read_npy(&out.join(name).join("000002.npy")).unwrap(),
                read_npy(&out.join(format!("{name}.npy"))).unwrap()
            );
        }
    }

    #[test]
    fn a_value_out_of_range_names_its_option() {
        let (dir, done) = simulated(&["--size", "8"]);
        let e = done.unwrap_err();
        assert_eq!((e.to_string().as_str(), e.exit_code()), ("--size = 8×8, allowed: 16 to 2048 each way", 2));
        assert!(!dir.path().join("new").exists());
        assert_eq!(simulated(&["--scene", "plastik"]).1.unwrap_err().exit_code(), 66);
    }
}
