//! The compiled part of the Python package `stokescope`. The package in `python/stokescope` checks and shapes what users hand in and
//! documents it; this module takes C-contiguous arrays and runs the library on them, with Python's lock released.
//!
//! Arrays are `[planes, H, W]`, or `[H, W, planes]` where `interleaved` says so. Every result owns its memory.

#![allow(clippy::needless_pass_by_value, reason = "PyO3 hands arguments over by value")]

use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use numpy::{
    Element, PyArray1, PyArrayDyn, PyArrayMethods, PyReadonlyArray2, PyReadonlyArray3, PyReadonlyArrayDyn,
    PyUntypedArrayMethods,
};
use pyo3::create_exception;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use stokescope::bundle::{Bundle, write_simulated};
use stokescope::evaluate::score_images;
use stokescope::files::{self, Array, Samples, Values};
use stokescope::model::{Allowance, Precision, Selection};
use stokescope::output::export::{result_names, result_planes};
use stokescope::output::zarr::{Zarr as CoreZarr, ZarrSpec};
use stokescope::output::{Report, ResultImages};
use stokescope_core::calibrate::{Levels, Outcome, Shots, dark, psf};
use stokescope_core::device::Homography;
use stokescope_core::image::{ImageView, Size, Stack, Unit};
use stokescope_core::pipeline::Settings;
use stokescope_core::polarization::Angle;
use stokescope_core::uncertainty;
use stokescope_core::{Device as CoreDevice, Mask as CoreMask, Mosaic, Pipeline as CorePipeline};
use stokescope_simulator::{SimSpec, Simulator};

create_exception!(
    stokescope,
    Error,
    PyValueError,
    "Something that the library cannot work with; the message names it and what is allowed."
);

/// An error of the library as a Python exception.
fn refused(e: impl std::fmt::Display) -> PyErr {
    Error::new_err(e.to_string())
}

/// An image of any number format that the library reads.
#[derive(FromPyObject)]
enum Image<'py> {
    U8(PyReadonlyArray3<'py, u8>),
    U16(PyReadonlyArray3<'py, u16>),
    F32(PyReadonlyArray3<'py, f32>),
    F64(PyReadonlyArray3<'py, f64>),
}

impl Image<'_> {
    /// The image without a copy.
    fn view(&self, interleaved: bool, counts: bool) -> PyResult<ImageView<'_>> {
        fn of<'a, T: Element>(array: &'a PyReadonlyArray3<'_, T>, interleaved: bool) -> PyResult<ImageView<'a>>
        where
            &'a [T]: Into<stokescope_core::image::Samples<'a>>,
        {
            let samples = array.as_slice()?;
            let made = match (interleaved, array.shape()) {
                (true, &[height, width, planes]) => ImageView::interleaved(samples, planes, Size::new(width, height)),
                (_, shape) => ImageView::planar(samples, shape[0], Size::new(shape[2], shape[1])),
            };
            made.map_err(refused)
        }
        let view = match self {
            Self::U8(array) => of(array, interleaved),
            Self::U16(array) => of(array, interleaved),
            Self::F32(array) => of(array, interleaved),
            Self::F64(array) => of(array, interleaved),
        }?;
        Ok(if counts { view.in_unit(Unit::Counts) } else { view })
    }
}

/// Planes `[planes, H, W]` as the library holds them.
fn stack<T: Element + Copy>(array: &PyReadonlyArray3<'_, T>) -> PyResult<Stack<T>> {
    let &[count, height, width] = array.shape() else { return Err(refused("an array of 3 axes is needed")) };
    Stack::from_vec(count, Size::new(width, height), array.as_slice()?.to_vec()).map_err(refused)
}

/// A NumPy array of its own memory.
fn array<'py, T: Element>(py: Python<'py>, values: Vec<T>, shape: &[usize]) -> PyResult<Bound<'py, PyArrayDyn<T>>> {
    PyArray1::from_vec(py, values).reshape(shape)
}

/// Planes as an array; without a leading axis where there is one channel.
fn planes<'py>(
    py: Python<'py>,
    values: Vec<f32>,
    channels: usize,
    each: usize,
    Size { width, height }: Size,
) -> PyResult<Bound<'py, PyArrayDyn<f32>>> {
    let shape = [channels, each, height, width];
    array(py, values, &shape[usize::from(channels == 1)..])
}

/// The layout of a polarizer mask.
#[pyclass(frozen, module = "stokescope._native")]
struct Mask(CoreMask);

#[pymethods]
impl Mask {
    /// Vertical stripes of ideal polarizers or of ones that leak.
    #[staticmethod]
    fn stripes(angles: Vec<f64>, count: usize, extinction_ratio: f64) -> Self {
        let angles = angles.into_iter().map(Angle::from_degrees).collect();
        Self(CoreMask::Stripes { angles, count, extinction_ratio })
    }

    /// Polarizers on single pixels, in rows that repeat.
    #[staticmethod]
    fn mosaic(rows: Vec<Vec<f64>>, extinction_ratio: f64) -> PyResult<Self> {
        Ok(Self(CoreMask::Mosaic { layout: Mosaic::new(&rows).map_err(refused)?, extinction_ratio }))
    }

    /// Transmission measured pixel by pixel, `[angles, H, W]`.
    #[staticmethod]
    fn measured(transmission: PyReadonlyArray3<'_, f32>, angles: Vec<f64>) -> PyResult<Self> {
        let angles = angles.into_iter().map(Angle::from_degrees).collect();
        Ok(Self(CoreMask::Measured { angles, transmission: stack(&transmission)? }))
    }
}

/// A device, checked.
#[pyclass(frozen, module = "stokescope._native")]
struct Device {
    device: CoreDevice,
    digest: String,
}

#[pymethods]
impl Device {
    /// Makes a device from arrays. `frame` is (height, width) of the camera's planes, `crop` (x, y, width, height).
    #[staticmethod]
    #[pyo3(signature = (psf, frame, *, mask, channels, crop, bin, levels, noise, dark, white, margin, homography))]
    #[expect(clippy::too_many_arguments, reason = "the keywords of one constructor")]
    fn build(
        psf: PyReadonlyArray3<'_, f32>,
        frame: (usize, usize),
        mask: Option<&Bound<'_, Mask>>,
        channels: usize,
        crop: Option<[usize; 4]>,
        bin: usize,
        levels: (f32, f32),
        noise: (f32, f32),
        dark: Option<PyReadonlyArray3<'_, f32>>,
        white: Option<[f32; 3]>,
        margin: Option<usize>,
        homography: Option<[f64; 9]>,
    ) -> PyResult<Self> {
        let mut builder = CoreDevice::builder(Size::new(frame.1, frame.0))
            .channels(channels)
            .bin(bin)
            .levels(levels.0, levels.1)
            .noise(noise.0, noise.1)
            .psf(stack(&psf)?);
        if let Some(mask) = mask {
            builder = builder.mask(mask.get().0.clone());
        }
        if let Some([x, y, width, height]) = crop {
            builder = builder.crop([x, y], Size::new(width, height));
        }
        if let Some(dark) = dark {
            builder = builder.dark(stack(&dark)?);
        }
        if let Some(white) = white {
            builder = builder.white(white);
        }
        if let Some(margin) = margin {
            builder = builder.margin(margin);
        }
        if let Some(homography) = homography {
            builder = builder.guide(Homography(homography));
        }
        Ok(Self { device: builder.build().map_err(refused)?, digest: String::new() })
    }

    /// Reads a device bundle.
    #[staticmethod]
    fn load(path: PathBuf) -> PyResult<Self> {
        let Bundle { device, digest, .. } = Bundle::load(&path).map_err(refused)?;
        Ok(Self { device, digest })
    }

    /// (height, width) of the results.
    #[getter]
    fn size(&self) -> (usize, usize) {
        (self.device.sensor.size.height, self.device.sensor.size.width)
    }

    /// (height, width) of the camera's frames.
    #[getter]
    fn frame(&self) -> (usize, usize) {
        let frame = self.device.sensor.window.frame();
        (frame.height, frame.width)
    }

    /// 1 or 3.
    #[getter]
    fn channels(&self) -> usize {
        self.device.sensor.channels
    }

    /// Polarizer angles in degrees.
    #[getter]
    fn angles(&self) -> Vec<f64> {
        self.device.response.angles().iter().map(|angle| angle.degrees()).collect()
    }

    /// Digest of the bundle, empty for a device made from arrays.
    #[getter]
    fn digest(&self) -> &str {
        &self.digest
    }
}

/// One solved frame on its way to Python.
#[derive(IntoPyObject)]
struct Solved<'py> {
    stokes: Bound<'py, PyArrayDyn<f32>>,
    errors: Bound<'py, PyArrayDyn<f32>>,
    angles: Option<Bound<'py, PyArrayDyn<f32>>>,
    valid: Bound<'py, PyArrayDyn<bool>>,
    readings: Bound<'py, PyArrayDyn<f32>>,
    /// The report as JSON.
    report: String,
}

/// A planned pipeline.
#[pyclass(frozen, module = "stokescope._native")]
struct Pipeline {
    pipeline: Mutex<CorePipeline>,
    selection: Selection,
    digest: String,
}

#[pymethods]
impl Pipeline {
    #[new]
    #[pyo3(signature = (device, *, guided, method, iterations, fusion, precision, threads, register, refit_psf, video))]
    #[expect(clippy::too_many_arguments, reason = "the keywords of one constructor")]
    fn new(
        py: Python<'_>,
        device: &Bound<'_, Device>,
        guided: bool,
        method: Option<&str>,
        iterations: Option<usize>,
        fusion: String,
        precision: &str,
        threads: Option<usize>,
        register: bool,
        refit_psf: bool,
        video: bool,
    ) -> PyResult<Self> {
        let defaults = Settings::default();
        let precisions = Precision::ALL;
        let precision = precisions.into_iter().find(|p| p.to_string() == precision).ok_or_else(|| {
            refused(format!("precision = {precision:?}, allowed: {}", precisions.map(|p| p.to_string()).join(", ")))
        })?;
        if threads.is_some_and(|n| !(1..=64).contains(&n)) {
            return Err(refused(format!("threads = {}, allowed: 1 to 64", threads.unwrap_or(0))));
        }
        let settings = Settings {
            guided,
            method: method.map(str::parse).transpose().map_err(refused)?,
            iterations,
            register,
            refit_psf,
            threads: threads.unwrap_or(defaults.threads),
            video,
            ..defaults
        };
        let Device { device, digest } = device.get();
        let planned = py.detach(|| -> Result<_, String> {
            let mut pipeline = CorePipeline::new(device, settings).map_err(|e| e.to_string())?;
            let selection = Selection::add(&mut pipeline, &fusion.into(), precision, &Allowance::ALL);
            Ok((pipeline, selection.map_err(|e| e.to_string())?))
        });
        let (pipeline, selection) = planned.map_err(refused)?;
        Ok(Self { pipeline: Mutex::new(pipeline), selection, digest: digest.clone() })
    }

    /// Solves one frame. Frames of several threads wait for each other, without Python's lock.
    #[pyo3(signature = (raw, guide, *, interleaved, counts))]
    fn solve<'py>(
        &self,
        py: Python<'py>,
        raw: Image<'py>,
        guide: Option<Image<'py>>,
        interleaved: (bool, bool),
        counts: bool,
    ) -> PyResult<Solved<'py>> {
        let raw = raw.view(interleaved.0, counts)?;
        let guide = guide.as_ref().map(|guide| guide.view(interleaved.1, false)).transpose()?;
        let solved = py.detach(|| -> Result<_, String> {
            let mut pipeline = self.pipeline.lock().unwrap_or_else(PoisonError::into_inner);
            let start = Instant::now();
            let report = pipeline.process(raw, guide).map_err(|e| e.to_string())?.into_report();
            let report =
                Report::new(&pipeline, &report, &self.selection, &self.digest, [Duration::ZERO, start.elapsed()]);
            let report = serde_json::to_string(&report).map_err(|e| e.to_string())?;
            let (result, readings) = (pipeline.result(), pipeline.raw());
            let stokes = [&result.stokes, &result.errors].map(|stack| stack.as_slice().to_vec());
            let angles = result.angles.as_ref().map(|angles| angles.as_slice().to_vec());
            let readings = (readings.as_slice().to_vec(), readings.count());
            Ok((stokes, angles, result.valid.clone(), readings, report, pipeline.size(), pipeline.angles().len()))
        });
        let ([stokes, errors], angles, valid, (readings, channels), report, size, count) = solved.map_err(refused)?;
        let components = stokes.len() / (channels * size.pixels());
        Ok(Solved {
            stokes: planes(py, stokes, channels, components, size)?,
            errors: planes(py, errors, channels, components, size)?,
            angles: angles.map(|angles| planes(py, angles, channels, count, size)).transpose()?,
            valid: array(py, valid, &[size.height, size.width])?,
            readings: planes(py, readings, channels, 1, size)?,
            report,
        })
    }

    /// The method that frames are solved with.
    #[getter]
    fn method(&self) -> String {
        self.pipeline.lock().unwrap_or_else(PoisonError::into_inner).method().to_string()
    }
}

/// A simulated device and scene.
#[pyclass(module = "stokescope._native")]
struct Simulation {
    simulator: Simulator,
}

/// Raw counts, guide and true angle images of one instant.
type Capture<'py> = (Bound<'py, PyArrayDyn<u16>>, Bound<'py, PyArrayDyn<f32>>, Bound<'py, PyArrayDyn<f32>>);

#[pymethods]
impl Simulation {
    /// Plans `SCENE,key=value,…`.
    #[new]
    fn new(spec: &str) -> PyResult<Self> {
        let spec: SimSpec = spec.parse().map_err(refused)?;
        Ok(Self { simulator: Simulator::new(spec).map_err(refused)? })
    }

    /// Renders frame `index`.
    fn capture<'py>(&mut self, py: Python<'py>, index: u64) -> PyResult<Capture<'py>> {
        let simulator = &mut self.simulator;
        let capture = py.detach(|| simulator.capture(index));
        let (spec, channels) = (simulator.spec(), simulator.spec().channels());
        let squeezed = usize::from(channels == 1);
        let (size, seen) = (spec.size, spec.guide_size());
        let raw = array(py, capture.raw.as_slice().to_vec(), &[channels, size.height, size.width][squeezed..])?;
        let guide = array(py, capture.guide.as_slice().to_vec(), &[channels, seen.height, seen.width][squeezed..])?;
        let truth = planes(py, capture.truth.as_slice().to_vec(), channels, spec.angles, size)?;
        Ok((raw, guide, truth))
    }

    /// Writes the bundle of the device into a folder.
    fn write_bundle(&self, path: PathBuf) -> PyResult<()> {
        write_simulated(self.simulator.spec(), &path).map_err(refused)
    }
}

/// An array of results as OME-Zarr. Processes may write to one array.
#[pyclass(frozen, module = "stokescope._native")]
struct Zarr {
    array: CoreZarr,
    channels: usize,
}

#[pymethods]
impl Zarr {
    /// Makes the array, or opens the one of the same frames and origin. `origin` is JSON, `size` height and width.
    #[new]
    fn new(
        path: PathBuf,
        channels: usize,
        polarized: bool,
        size: (usize, usize),
        frames: Vec<String>,
        interval: Option<f64>,
        origin: &str,
    ) -> PyResult<Self> {
        let spec = ZarrSpec {
            planes: &result_names(channels, polarized),
            size: Size::new(size.1, size.0),
            frames: &frames,
            interval,
            origin: serde_json::from_str(origin).map_err(refused)?,
        };
        Ok(Self { array: CoreZarr::create(&path, &spec).map_err(refused)?, channels })
    }

    /// Whether a frame is there.
    fn has(&self, index: usize) -> bool {
        self.array.has(index)
    }

    /// Writes Stokes images `[planes, H, W]` and their validity as a frame.
    fn write(
        &self,
        py: Python<'_>,
        index: usize,
        stokes: PyReadonlyArray3<'_, f32>,
        valid: PyReadonlyArray2<'_, bool>,
    ) -> PyResult<()> {
        let (stokes, valid) = (stack(&stokes)?, valid.as_slice()?.to_vec());
        py.detach(|| {
            let images = ResultImages {
                size: stokes.size(),
                channels: self.channels,
                angles: None,
                angle_list: &[],
                stokes: &stokes,
                errors: None,
                valid: &valid,
                stage1: None,
            };
            let (_, planes) = result_planes(&images).map_err(|e| e.to_string())?;
            self.array.write(index, &planes).map_err(|e| e.to_string())
        })
        .map_err(refused)
    }
}

/// The calibration frames of one step as the library takes them: counts.
fn shots(frames: &[PyReadonlyArray3<'_, f32>]) -> PyResult<Shots> {
    Ok(Shots { frames: frames.iter().map(stack).collect::<PyResult<_>>()?, unit: Unit::Counts })
}

/// The quality of a calibration step as JSON.
fn quality(outcome: &Outcome) -> PyResult<String> {
    serde_json::to_string(outcome).map_err(refused)
}

/// Measures a dark frame, in counts. Gives it with the black level, the read noise as a fraction of full scale, and the quality.
#[pyfunction]
fn calibrate_dark<'py>(
    py: Python<'py>,
    frames: Vec<PyReadonlyArray3<'py, f32>>,
    bits: u32,
    saturation: f32,
) -> PyResult<(Bound<'py, PyArrayDyn<f32>>, f32, f32, String)> {
    let shots = shots(&frames)?;
    let found = py.detach(|| dark::measure_to(&shots, bits, saturation)).map_err(refused)?;
    let (count, size) = (found.mean.count(), found.mean.size());
    let mean = array(py, found.mean.as_slice().to_vec(), &[count, size.height, size.width][usize::from(count == 1)..])?;
    Ok((mean, found.black_level, found.read_noise, quality(&found.outcome())?))
}

/// Measures a PSF from frames of a point source, seen through the mask of `device`, whose own PSF does not matter.
#[pyfunction]
fn calibrate_psf<'py>(
    py: Python<'py>,
    frames: Vec<PyReadonlyArray3<'py, f32>>,
    device: &Bound<'py, Device>,
    dark: Option<PyReadonlyArray3<'py, f32>>,
    masked: bool,
) -> PyResult<(Bound<'py, PyArrayDyn<f32>>, String)> {
    let (shots, dark) = (shots(&frames)?, dark.as_ref().map(stack).transpose()?);
    let device = &device.get().device;
    let levels = Levels::new(device.sensor, dark.map(std::sync::Arc::new));
    let found = py.detach(|| psf::measure(&shots, &levels, masked.then_some(&device.response))).map_err(refused)?;
    let (count, size) = (found.planes.count(), found.planes.size());
    let planes = found.planes.as_slice().to_vec();
    let planes = array(py, planes, &[count, size.height, size.width][usize::from(count == 1)..])?;
    Ok((planes, quality(&found.outcome())?))
}

/// Standard errors of DoLP and AoLP (degrees, NaN where an angle means nothing) of Stokes images `[C·3, H, W]`, summed over channels.
#[pyfunction]
fn propagate<'py>(
    py: Python<'py>,
    stokes: PyReadonlyArray3<'py, f32>,
    errors: PyReadonlyArray3<'py, f32>,
) -> PyResult<[Bound<'py, PyArrayDyn<f32>>; 2]> {
    let (stokes, errors) = (stack(&stokes)?, stack(&errors)?);
    if (stokes.count(), stokes.size()) != (errors.count(), errors.size()) || !stokes.count().is_multiple_of(3) {
        return Err(refused("S0, S1 and S2 are needed, and errors of the same shape"));
    }
    let Size { width, height } = stokes.size();
    let found = (0..width * height).map(|i| {
        let [stokes, errors] = uncertainty::summed(&stokes, &errors, i);
        (uncertainty::dolp_error(stokes, errors), uncertainty::aolp_error_degrees(stokes, errors).unwrap_or(f32::NAN))
    });
    let (degrees, angles): (Vec<f32>, Vec<f32>) = found.unzip();
    Ok([array(py, degrees, &[height, width])?, array(py, angles, &[height, width])?])
}

/// Scores angle images against the truth.
#[pyfunction]
fn evaluate<'py>(
    py: Python<'py>,
    estimate: PyReadonlyArrayDyn<'py, f32>,
    truth: PyReadonlyArrayDyn<'py, f32>,
) -> PyResult<Bound<'py, PyDict>> {
    let of = |array: &PyReadonlyArrayDyn<'_, f32>| -> PyResult<Array> {
        Ok(Array { shape: array.shape().to_vec(), samples: Values::F32(array.as_slice()?.to_vec()) })
    };
    let (estimate, truth) = (of(&estimate)?, of(&truth)?);
    let scores = py.detach(|| score_images(&estimate, &truth)).map_err(refused)?;
    let found = PyDict::new(py);
    for (key, value) in [
        ("psnr", scores.psnr),
        ("ssim", scores.ssim),
        ("s12_psnr", scores.s12_psnr),
        ("dolp_mae", scores.dolp_mae),
        ("aolp_mae_deg", scores.aolp_mae_deg),
    ] {
        found.set_item(key, value)?;
    }
    Ok(found)
}

/// An image file as an array: `[H, W]`, `[3, H, W]` for colours, or `[pages, H, W]` for the pages of a stack.
#[pyfunction]
fn read_image(py: Python<'_>, path: PathBuf) -> PyResult<Bound<'_, PyAny>> {
    let pages = py.detach(|| read_pages(&path)).map_err(refused)?;
    let planes: usize = pages.iter().map(Samples::count).sum();
    let Size { width, height } = pages[0].size();
    let shape = [planes, height, width];
    let shape = &shape[usize::from(planes == 1)..];
    match &pages[0] {
        Samples::U8(_) => joined(py, &pages, shape, |page| if let Samples::U8(s) = page { s.as_slice() } else { &[] }),
        Samples::U16(_) => {
            joined(py, &pages, shape, |page| if let Samples::U16(s) = page { s.as_slice() } else { &[] })
        }
        Samples::F32(_) => {
            joined(py, &pages, shape, |page| if let Samples::F32(s) = page { s.as_slice() } else { &[] })
        }
    }
}

/// The values of all pages, one after another. Pages of one file have one number format.
fn joined<'py, T: numpy::Element + Copy>(
    py: Python<'py>,
    pages: &[Samples],
    shape: &[usize],
    values: impl Fn(&Samples) -> &[T],
) -> PyResult<Bound<'py, PyAny>> {
    Ok(array(py, pages.iter().flat_map(|page| values(page).iter().copied()).collect(), shape)?.into_any())
}

/// All pages of an image file; a file of one image is one page.
fn read_pages(path: &Path) -> Result<Vec<Samples>, files::ArrayError> {
    match files::ImageStack::open(path)? {
        Some(mut stack) => (0..stack.count()).map(|page| stack.read(page)).collect(),
        None => Ok(vec![files::read_image(path)?]),
    }
}

#[pymodule]
fn _native(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add("Error", module.py().get_type::<Error>())?;
    module.add("__version__", env!("CARGO_PKG_VERSION"))?;
    module.add_class::<Mask>()?;
    module.add_class::<Device>()?;
    module.add_class::<Pipeline>()?;
    module.add_class::<Simulation>()?;
    module.add_class::<Zarr>()?;
    module.add_function(wrap_pyfunction!(calibrate_dark, module)?)?;
    module.add_function(wrap_pyfunction!(calibrate_psf, module)?)?;
    module.add_function(wrap_pyfunction!(evaluate, module)?)?;
    module.add_function(wrap_pyfunction!(propagate, module)?)?;
    module.add_function(wrap_pyfunction!(read_image, module)?)
}
