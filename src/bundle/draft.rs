//! An incomplete bundle that calibration steps fill in, and that replaces the old one as a whole.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use toml::{Table, Value};

use super::{Bundle, BundleError, CameraId, digest, raw};
use crate::config::{self, Checker, ConfigError};
use crate::files::{WriteError, write_atomic, write_npy};
use stokescope_core::calibrate::{CalibrateError, Levels, Step};
use stokescope_core::device::{DeviceError, Noise, Sensor, check_dark, reduced_response};
use stokescope_core::image::{Size, Stack, Window};
use stokescope_core::optics::Response;
use stokescope_core::parallel::Workers;
use stokescope_core::readings::Binning;

/// File name of the description in a bundle's folder.
pub(crate) const DESCRIPTION: &str = "calibration.toml";

/// Why a bundle cannot be changed.
#[derive(Debug, thiserror::Error)]
pub enum DraftError {
    /// The existing bundle, or the changed one, is not usable.
    #[error(transparent)]
    Bundle(#[from] BundleError),
    /// The bundle cannot be written.
    #[error(transparent)]
    Write(#[from] WriteError),
}

/// The parts of a device that a bundle contains so far.
#[derive(Clone, Debug, Default)]
pub struct Partial {
    /// Camera that the bundle belongs to.
    pub camera: Option<CameraId>,
    /// Sensor of the lensless camera.
    pub sensor: Option<Sensor>,
    /// Noise of one reading of the camera.
    pub noise: Option<Noise>,
    /// Dark frame in counts, `[C, H, W]`.
    pub dark: Option<Arc<Stack<f32>>>,
    /// Response of the polarizer mask.
    pub response: Option<Response>,
}

/// An incomplete bundle: an edited copy in memory until [`Draft::commit`].
#[derive(Debug)]
pub struct Draft {
    dir: PathBuf,
    table: Table,
    /// Parts that the bundle contains.
    pub known: Partial,
    arrays: Vec<(String, Vec<usize>, Vec<f32>)>,
}

impl Draft {
    /// Reads the bundle in `dir`, complete or not. Without one it starts a new bundle named after the folder.
    ///
    /// # Errors
    /// [`BundleError`] when the existing files are not usable.
    pub fn open(dir: &Path) -> Result<Self, BundleError> {
        let path = dir.join(DESCRIPTION);
        let text = match config::read(&path) {
            Err(ConfigError::Missing(_)) => {
                let name = dir.file_name().map_or("bench".into(), |name| name.to_string_lossy().into_owned());
                format!("version = 1\nname = {}\n", Value::from(name))
            }
            text => text?,
        };
        let bundle: raw::Bundle = config::parse(&path, &text)?;
        let table = config::parse(&path, &text)?;
        let mut check = Checker::new(&path, &text);
        let sensor = bundle.sensor.map(|sensor| sensor.validate(&mut check));
        let noise = bundle.noise.map(|noise| noise.validate(&mut check));
        let mask = bundle.mask.map(|mask| mask.validate(&mut check));
        check.finish()?;
        let mut known = Partial { camera: bundle.camera.map(Into::into), sensor, noise, ..Partial::default() };
        let mask_file = mask.as_ref().and_then(raw::MaskSpec::file).map_or(path, |file| dir.join(file));
        if let Some(sensor) = &mut known.sensor {
            let mask = mask.map(|spec| super::load_mask(dir, spec, sensor.window.frame())).transpose()?;
            if let Some(mask) = &mask {
                let cells = sensor.window.of_cells(mask.cell()).map_err(DeviceError::from);
                sensor.window =
                    cells.map_err(|source| BundleError::Device { file: mask_file.clone(), source: source.into() })?;
            }
            if let Some(table) = bundle.dark {
                let file = dir.join(table.file);
                let dark = super::planes(&file, sensor.window.frame())?;
                check_dark(&dark, sensor).map_err(|source| BundleError::Device { file, source: source.into() })?;
                known.dark = Some(Arc::new(dark));
            }
            if let Some(mask) = mask {
                let response = reduced_response(mask, &sensor.window);
                known.response =
                    Some(response.map_err(|source| BundleError::Device { file: mask_file, source: source.into() })?);
            }
        }
        Ok(Self { dir: dir.to_path_buf(), table, known, arrays: Vec::new() })
    }

    /// Whether `table` has `key`.
    pub fn has(&self, table: &str, key: &str) -> bool {
        self.table.get(table).and_then(Value::as_table).is_some_and(|table| table.contains_key(key))
    }

    /// Signal levels for calibration step `step`, from the sensor and the dark frame. Binning subtracts the dark frame itself.
    ///
    /// # Errors
    /// [`CalibrateError::MissingStep`] when the bundle has no sensor yet.
    pub fn levels(&self, step: Step) -> Result<Levels, CalibrateError> {
        let sensor = self.known.sensor.ok_or(CalibrateError::MissingStep { step, first: Step::Dark })?;
        Ok(Levels::new(sensor, self.known.dark.clone().filter(|_| sensor.window.is_whole())))
    }

    /// Binning of the camera's frames to the working size, for all steps but the dark frame; none where frames are used as they are.
    pub fn binning(&self) -> Option<Binning> {
        let noise = self.known.noise.unwrap_or(Noise::TYPICAL);
        Binning::of_sensor(self.known.sensor?, noise, self.known.dark.clone(), Arc::new(Workers::new(1)))
    }

    /// Takes over the part of the frame that a board uses and how its sensor is mounted, where the bundle has no sensor yet.
    ///
    /// # Errors
    /// [`BundleError::Readout`] when the bundle says otherwise.
    pub fn use_part(&mut self, window: Option<&Window>, mounted: Option<u32>) -> Result<(), BundleError> {
        if self.known.sensor.is_some() {
            return self.check_part(window, mounted);
        }
        if let Some(window) = window {
            let ([x, y], Size { width, height }) = (window.first(), window.size());
            let crop = [x, y, width, height].map(|n| Value::Integer(n as i64));
            self.set("sensor", "crop", crop.to_vec());
            self.set("sensor", "bin", window.bin() as i64);
        }
        if let Some(degrees) = mounted {
            self.set("sensor", "orientation", i64::from(degrees));
        }
        Ok(())
    }

    fn check_part(&self, window: Option<&Window>, mounted: Option<u32>) -> Result<(), BundleError> {
        let refuse = |own, found| Err(BundleError::Readout { dir: self.dir.clone(), own, found });
        if let (Some(found), Some(sensor)) = (window, &self.known.sensor) {
            let part = |w: &Window| (w.frame(), w.first(), w.size(), w.bin());
            let named = |w: &Window| {
                let ([x, y], Size { width, height }) = (w.first(), w.size());
                format!("crop = [{x}, {y}, {width}, {height}] and bin = {} of frames of {}", w.bin(), w.frame())
            };
            if part(found) != part(&sensor.window) {
                return refuse(named(&sensor.window), named(found));
            }
        }
        let table = self.table.get("sensor").and_then(Value::as_table);
        let own = table.and_then(|sensor| sensor.get("orientation")).and_then(Value::as_integer);
        match mounted {
            Some(degrees) if own != Some(i64::from(degrees)) => {
                let own = own.map_or("no orientation".to_owned(), |own| format!("orientation = {own}"));
                refuse(own, format!("orientation = {degrees}"))
            }
            _ => Ok(()),
        }
    }

    /// Sets `key` of `table`.
    pub fn set(&mut self, table: &str, key: &str, value: impl Into<Value>) {
        let entry = self.table.entry(table).or_insert_with(|| Value::Table(Table::new()));
        if let Value::Table(table) = entry {
            table.insert(key.to_owned(), value.into());
        }
    }

    /// Removes `table`.
    pub fn remove(&mut self, table: &str) {
        self.table.remove(table);
    }

    /// Sets the array of `table`: `values` of `shape`, written by [`Draft::commit`].
    pub fn set_array(&mut self, table: &str, shape: &[usize], values: &[f32]) {
        self.arrays.retain(|(name, ..)| name != table);
        self.arrays.push((table.to_owned(), shape.to_vec(), values.to_vec()));
    }

    /// Ties the bundle to `camera`, or checks that it already belongs to it.
    ///
    /// # Errors
    /// [`BundleError::Camera`] when the bundle belongs to another camera.
    pub fn tie(&mut self, camera: &CameraId) -> Result<(), BundleError> {
        if let Some(own) = &self.known.camera {
            return own.check(camera, &self.dir);
        }
        self.set("camera", "name", camera.name.clone());
        self.set("camera", "format", camera.format.clone());
        self.set("camera", "width", camera.size.width as i64);
        self.set("camera", "height", camera.size.height as i64);
        self.known.camera = Some(camera.clone());
        Ok(())
    }

    /// Writes the bundle and returns it if it is complete.
    ///
    /// The arrays come first, under names that contain their digest; the description follows in one step; replaced arrays are
    /// removed last. Wherever this is interrupted, the folder holds the old bundle or the new one.
    ///
    /// # Errors
    /// [`DraftError`]; the old bundle is then unchanged.
    pub fn commit(mut self) -> Result<Option<Bundle>, DraftError> {
        let dir = self.dir.clone();
        std::fs::create_dir_all(&dir).map_err(|source| WriteError::Create { path: dir.clone(), source })?;
        let mut replaced = Vec::new();
        let mut written = Vec::new();
        for (name, shape, values) in std::mem::take(&mut self.arrays) {
            let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
            let file = format!("{name}-{}.npy", &digest::of([bytes.as_slice()])[..12]);
            let old = self.table.get(&name).and_then(|t| t.get("file")).and_then(Value::as_str).map(str::to_owned);
            replaced.extend(old.filter(|old| *old != file && old.starts_with(&format!("{name}-"))));
            if !dir.join(&file).exists() {
                written.push(dir.join(&file));
            }
            write_npy(&dir.join(&file), &shape, &values)?;
            self.set(&name, "file", file);
        }
        let revision = self.table.get("revision").and_then(Value::as_integer).unwrap_or(0) + 1;
        self.table.insert("revision".to_owned(), revision.into());
        let (path, text) = (dir.join(DESCRIPTION), self.table.to_string());
        let complete = ["sensor", "psf", "mask"].iter().all(|key| self.table.contains_key(*key));
        let checked = complete.then(|| Bundle::parse(&dir, &path, &text)).transpose();
        let done = checked.map_err(DraftError::from).and_then(|bundle| {
            write_atomic(&path, |out| out.write_all(text.as_bytes()))?;
            Ok(bundle)
        });
        // a file that cannot be removed only takes space
        let obsolete = if done.is_ok() { replaced.iter().map(|file| dir.join(file)).collect() } else { written };
        obsolete.iter().for_each(|file| drop(std::fs::remove_file(file)));
        done
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn files(dir: &Path) -> Vec<String> {
        let mut names: Vec<_> =
            std::fs::read_dir(dir).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }

    fn started(dir: &Path) -> Draft {
        let mut draft = Draft::open(dir).unwrap();
        for (key, value) in [("width", 8), ("height", 8), ("channels", 1)] {
            draft.set("sensor", key, value);
        }
        draft.set("noise", "read", 0.002);
        draft
    }

    fn ramp(modulus: usize) -> Vec<f32> {
        (0..64).map(|i| (i % modulus) as f32).collect()
    }

    #[test]
    fn a_bundle_grows_step_by_step_and_keeps_one_array_of_each_kind() {
        let dir = tempfile::tempdir().unwrap();
        let mut draft = started(dir.path());
        draft.set_array("dark", &[8, 8], &ramp(3));
        assert!(draft.commit().unwrap().is_none(), "PSF and mask are missing");
        let e = Bundle::load(dir.path()).unwrap_err().to_string();
        assert!(e.contains("psf = missing, allowed: made by `stokescope calibrate psf`"), "{e}");

        let mut draft = Draft::open(dir.path()).unwrap();
        assert_eq!(draft.known.dark.as_ref().unwrap().size(), Size::new(8, 8));
        draft.set_array("psf", &[8, 8], &ramp(7));
        draft.set("mask", "kind", "none");
        let first = draft.commit().unwrap().unwrap();
        let mut draft = Draft::open(dir.path()).unwrap();
        draft.set_array("psf", &[8, 8], &ramp(5));
        let second = draft.commit().unwrap().unwrap();
        assert_ne!(first.digest, second.digest);
        assert_eq!(second.digest, Bundle::load(dir.path()).unwrap().digest);
        assert_eq!(files(dir.path()).len(), 3, "{:?}", files(dir.path()));
    }

    #[test]
    fn an_unusable_change_leaves_the_old_bundle() {
        let dir = tempfile::tempdir().unwrap();
        let mut draft = started(dir.path());
        draft.set("mask", "kind", "none");
        draft.set_array("psf", &[8, 8], &ramp(7));
        let before = draft.commit().unwrap().unwrap().digest;
        let (names, mut draft) = (files(dir.path()), Draft::open(dir.path()).unwrap());
        draft.set_array("psf", &[8, 8], &[0.0; 64]);
        assert!(draft.commit().unwrap_err().to_string().contains("no light"));
        assert_eq!((Bundle::load(dir.path()).unwrap().digest, files(dir.path())), (before, names));
    }

    #[test]
    fn a_mosaic_is_read_with_its_cells_by_bundles_and_by_calibration_steps() {
        let dir = tempfile::tempdir().unwrap();
        let rows = vec![vec![90.0, 45.0], vec![135.0, 0.0]];
        let with = |bin: i64, layout: Vec<Vec<f64>>| {
            let mut draft = started(dir.path());
            draft.set("sensor", "bin", bin);
            draft.set("sensor", "crop", vec![1, 1, 6, 6]);
            draft.set("mask", "kind", "mosaic");
            draft.set("mask", "layout", layout);
            draft.set_array("psf", &[8, 8], &ramp(7));
            draft.commit()
        };
        let error = with(3, rows.clone()).unwrap_err().to_string();
        assert!(error.contains("repeat after 2 columns and 2 rows, allowed: 1, or a multiple of both"), "{error}");
        let error = with(2, vec![vec![90.0, 45.0], vec![135.0]]).unwrap_err().to_string();
        assert!(error.contains("mask.layout = [[90.0, 45.0], [135.0]]") && error.contains("rows of [2, 1]"), "{error}");
        let bundle = with(2, rows).unwrap().unwrap();
        assert_eq!(bundle.response.angles().len(), 4);
        // (1, 1) is the first pixel of the crop
        assert!((bundle.response.polarized()[0].re - 0.5).abs() < 1e-6);
        let known = Draft::open(dir.path()).unwrap().known;
        assert_eq!(known.sensor.unwrap().window, bundle.sensor.window);
        assert_eq!(known.sensor.unwrap().window.cell(), [2, 2]);
        assert_eq!(known.response.unwrap().polarized(), bundle.response.polarized());
    }

    #[test]
    fn a_new_bundle_takes_the_part_that_its_board_uses_and_another_part_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        let window = |x| Window::new(Size::new(8, 8), [x, 0], Size::new(4, 8), 2).unwrap();
        let mut draft = Draft::open(dir.path()).unwrap();
        draft.use_part(Some(&window(2)), Some(180)).unwrap();
        for (key, value) in [("width", 8), ("height", 8), ("channels", 1)] {
            draft.set("sensor", key, value);
        }
        draft.commit().unwrap();
        let mut draft = Draft::open(dir.path()).unwrap();
        assert_eq!(draft.known.sensor.unwrap().window, window(2));
        assert_eq!(Bundle::orientation_in(dir.path()).unwrap(), Some(180));
        draft.use_part(Some(&window(2)), Some(180)).unwrap();
        draft.use_part(None, None).unwrap();
        let e = draft.use_part(Some(&window(0)), None).unwrap_err().to_string();
        assert!(
            e.contains("crop = [2, 0, 4, 8] and bin = 2 of frames of 8×8, and that of the board crop = [0, 0"),
            "{e}"
        );
        let e = draft.use_part(None, Some(0)).unwrap_err().to_string();
        assert!(e.contains("says orientation = 180, and that of the board orientation = 0"), "{e}");
    }

    #[test]
    fn noise_is_optional() {
        let dir = tempfile::tempdir().unwrap();
        let mut draft = started(dir.path());
        draft.remove("noise");
        draft.set("mask", "kind", "none");
        draft.set_array("psf", &[8, 8], &ramp(7));
        assert_eq!(draft.commit().unwrap().unwrap().noise, Noise::TYPICAL);
    }

    #[test]
    fn the_orientation_is_known_before_a_bundle_is_complete() {
        let dir = tempfile::tempdir().unwrap();
        let write = |text: &str| std::fs::write(dir.path().join(DESCRIPTION), text).unwrap();
        assert_eq!(Bundle::orientation_in(dir.path()).unwrap(), None, "no bundle yet");
        let sensor = "version = 1\nname = \"bench\"\n[sensor]\nwidth = 8\nheight = 8\nchannels = 1\n";
        write(sensor);
        assert_eq!(Bundle::orientation_in(dir.path()).unwrap(), None);
        write(&format!("{sensor}orientation = 180\n"));
        assert_eq!(Bundle::orientation_in(dir.path()).unwrap(), Some(180));
        write(&format!("{sensor}orientation = 90\n"));
        let error = Bundle::orientation_in(dir.path()).unwrap_err().to_string();
        assert!(error.contains("sensor.orientation = 90, allowed: 0 or 180 degrees"), "{error}");
    }

    #[cfg(feature = "program")]
    #[test]
    fn the_orientation_is_asked_of_the_lensless_camera_alone() {
        use crate::camera::{Clock, Request, Role};
        let (board, clock) = (crate::board::Board::load("x86-sim").unwrap(), Clock::default());
        let request = |role| Request::of(role, &board.raw, &clock, Some(180));
        assert_eq!(request(Role::Raw).orientation, Some(180), "its calibration is true for no other");
        assert_eq!(request(Role::Guide).orientation, None);
    }

    #[test]
    fn a_bundle_is_tied_to_one_camera() {
        let dir = tempfile::tempdir().unwrap();
        let id = |width| CameraId { name: "a".into(), format: "mono 12-bit".into(), size: Size::new(width, 8) };
        let mut draft = started(dir.path());
        draft.tie(&id(8)).unwrap();
        draft.commit().unwrap();
        let mut draft = Draft::open(dir.path()).unwrap();
        draft.tie(&id(8)).unwrap();
        let e = draft.tie(&id(16)).unwrap_err().to_string();
        assert!(e.contains("belongs to camera a, mono 12-bit, 8×8 pixels; found a, mono 12-bit, 16×8 pixels"), "{e}");
    }
}
