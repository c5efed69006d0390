//! A simulated device in a temporary folder, its frames, and how to judge and compare results.
#![allow(dead_code, reason = "every test binary uses its part of these helpers")]

use std::path::{Path, PathBuf};

use stokescope::bundle::Bundle;
use stokescope::camera::sim::{Capture, Margin, SimSpec, simulator};
use stokescope::files::write_npy;
use stokescope_core::image::{Size, Stack};
use stokescope_core::pipeline::{FrameReport, Pipeline, Settings};
use stokescope_core::polarization;
use stokescope_core::solve::Method;

/// A device, one capture of it, and the truth. Readings and guide are fractions of full scale.
pub(crate) struct Rig {
    pub(crate) spec: SimSpec,
    pub(crate) calibration: Bundle,
    pub(crate) raw: Stack<f32>,
    pub(crate) guide: Stack<f32>,
    /// True Stokes images, `[C·3, H, W]`.
    pub(crate) truth: Stack<f32>,
    folder: tempfile::TempDir,
}

/// A simulated gray capture of `scene` at `size` with four angles. The scene ends at the frame, and the guide sees the frame.
pub(crate) fn spec(scene: &str, size: Size) -> SimSpec {
    let (surround, guide_margin) = (Margin::Pixels(0), Margin::Pixels(0));
    SimSpec { scene: scene.to_owned(), size, fine: 2, surround, guide_margin, ..SimSpec::default() }
}

impl Rig {
    /// Simulates the capture and writes and loads its bundle.
    pub(crate) fn new(spec: SimSpec) -> Self {
        let capture = simulator(spec.clone()).unwrap().capture(0);
        Self::of(spec, capture)
    }

    /// The device with another capture of it.
    pub(crate) fn of(spec: SimSpec, capture: Capture) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let Size { width, height } = spec.size;
        write_npy(&folder.path().join("psf.npy"), &[height, width], spec.psf().as_slice()).unwrap();
        std::fs::write(folder.path().join("calibration.toml"), spec.calibration()).unwrap();
        let span = f32::from(spec.saturation() - spec.black_level);
        let fraction = |v: &u16| (f32::from(*v) - f32::from(spec.black_level)) / span;
        let raw = capture.raw.as_slice().iter().map(fraction).collect();
        let polar = polarization::Plan::new(&spec.mask_angles());
        let mut truth = Stack::zeros(3 * spec.channels(), spec.size);
        let n = spec.size.pixels();
        let channels = capture.truth.as_slice().chunks(spec.angles * n).zip(truth.as_mut_slice().chunks_mut(3 * n));
        channels.for_each(|(angles, stokes)| polar.to_stokes(angles, stokes, n));
        Self {
            calibration: Bundle::load(folder.path()).unwrap(),
            raw: Stack::from_vec(spec.channels(), spec.size, raw).unwrap(),
            guide: capture.guide,
            truth,
            spec,
            folder,
        }
    }

    /// The bundle's folder.
    pub(crate) fn folder(&self) -> &Path {
        self.folder.path()
    }

    /// Replaces text of the bundle's description and loads it anew.
    pub(crate) fn edit(&mut self, from: &str, to: &str) {
        let path: PathBuf = self.folder().join("calibration.toml");
        let text = std::fs::read_to_string(&path).unwrap();
        assert!(text.contains(from), "{from:?} is not in {text}");
        std::fs::write(&path, text.replace(from, to)).unwrap();
        self.calibration = Bundle::load(self.folder()).unwrap();
    }

    /// A pipeline for this device.
    pub(crate) fn pipeline(&self, guide: bool, settings: &Settings) -> Pipeline {
        Pipeline::new(&self.calibration, Settings { guided: guide, ..settings.clone() }).unwrap()
    }

    /// Stokes images of the rig's own frames by one method; guided alone sees the guide.
    pub(crate) fn solve(&self, method: Method, iterations: usize) -> (Stack<f32>, FrameReport) {
        self.solve_frame(&self.raw, (method == Method::Guided).then_some(&self.guide), method, iterations)
    }

    /// Stokes images of other frames of this device.
    pub(crate) fn solve_frame(
        &self,
        raw: &Stack<f32>,
        guide: Option<&Stack<f32>>,
        method: Method,
        iterations: usize,
    ) -> (Stack<f32>, FrameReport) {
        let mut pipeline = self.pipeline(guide.is_some(), &settings(method, iterations, 1));
        let report = pipeline.process(raw.view(), guide.map(Stack::view)).unwrap().into_report();
        (pipeline.result().stokes.clone(), report)
    }
}

/// Settings without a memory limit.
pub(crate) fn settings(method: Method, iterations: usize, threads: usize) -> Settings {
    Settings { method: Some(method), iterations: Some(iterations), register: false, threads, ..Settings::default() }
}

/// All values multiplied by `factor`.
pub(crate) fn scaled(frame: &Stack<f32>, factor: f32) -> Stack<f32> {
    map(frame, |v| v * factor)
}

/// All values mapped.
pub(crate) fn map(frame: &Stack<f32>, f: impl FnMut(f32) -> f32) -> Stack<f32> {
    let values = frame.as_slice().iter().copied().map(f).collect();
    Stack::from_vec(frame.count(), frame.size(), values).unwrap()
}

/// Peak signal-to-noise ratio of S1 and S2 in dB, peak 1, over all channels.
pub(crate) fn s12_psnr(stokes: &Stack<f32>, truth: &Stack<f32>) -> f64 {
    let planes = || (0..truth.count()).filter(|k| k % 3 != 0);
    let errors = planes().flat_map(|k| stokes.plane(k).iter().zip(truth.plane(k)));
    let (sum, count) = errors.fold((0.0, 0), |(sum, n), (a, b)| (sum + f64::from(a - b).powi(2), n + 1));
    -10.0 * (sum / f64::from(count)).log10()
}

/// ‖a − b‖ / ‖b‖.
pub(crate) fn relative_difference(a: &[f32], b: &[f32]) -> f64 {
    assert_eq!(a.len(), b.len());
    let square = |sum: f64, v: f64| sum + v * v;
    let difference = a.iter().zip(b).map(|(a, b)| f64::from(*a) - f64::from(*b)).fold(0.0, square);
    (difference / b.iter().map(|v| f64::from(*v)).fold(0.0, square)).sqrt()
}

/// Panics unless Stokes images are finite, S0 ≥ 0 and |S1 + i·S2| ≤ S0.
pub(crate) fn assert_physical(stokes: &Stack<f32>, what: &str) {
    for k in (0..stokes.count()).step_by(3) {
        let [s0, s1, s2] = [0, 1, 2].map(|j| stokes.plane(k + j));
        for (i, ((s0, s1), s2)) in s0.iter().zip(s1).zip(s2).enumerate() {
            let values = [s0, s1, s2];
            assert!(values.iter().all(|v| v.is_finite()), "{what}: pixel {i} is {values:?}");
            assert!(*s0 >= 0.0 && s1.hypot(*s2) <= s0 * (1.0 + 1e-5), "{what}: pixel {i} is {values:?}");
        }
    }
}
