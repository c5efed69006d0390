//! The bundle of a simulated device.

use std::path::Path;

use stokescope_core::image::Size;
use stokescope_simulator::SimSpec;

use crate::files::{WriteError, write_atomic, write_npy};

/// Writes the bundle of the device that `spec` describes into the folder `dir`, which is created if needed. `calibration.toml` is
/// written last, so a bundle with a description is complete.
///
/// # Errors
/// [`WriteError`] when the folder or a file cannot be written.
pub fn write_simulated(spec: &SimSpec, dir: &Path) -> Result<(), WriteError> {
    std::fs::create_dir_all(dir).map_err(|source| WriteError::Create { path: dir.to_path_buf(), source })?;
    let Size { width, height } = spec.size;
    write_npy(&dir.join("psf.npy"), &[height, width], spec.psf().as_slice())?;
    if spec.is_measured() {
        write_npy(&dir.join("mask.npy"), &[spec.angles, height, width], spec.mask().as_slice())?;
        write_npy(&dir.join("dark.npy"), &[height, width], spec.dark().as_slice())?;
    }
    write_atomic(&dir.join("calibration.toml"), |out| out.write_all(spec.calibration().as_bytes()))
}
