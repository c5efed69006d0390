//! Scenes from folders of images measured behind a polarizer.

use std::path::{Path, PathBuf};

use stokescope_core::image::{Size, Stack};
use stokescope_simulator::SceneError;

use crate::files::{self, ArrayError, Samples};

/// Polarizer angles of the PNG files in degrees.
const ANGLES: [u32; 4] = [0, 45, 90, 135];

/// Reason why a folder is not a scene.
#[derive(Debug, thiserror::Error)]
pub enum FolderError {
    /// A file cannot be read.
    #[error(transparent)]
    Array(#[from] ArrayError),
    /// An image has the wrong shape.
    #[error("{}: shape {found}, allowed: {allowed}", path.display())]
    Shape {
        /// The file.
        path: PathBuf,
        /// Shape found.
        found: String,
        /// Allowed shape.
        allowed: String,
    },
}

/// Reads `0.png`, `45.png`, `90.png` and `135.png` (linear, 8 or 16 bit) or `angles.npy` (`[4, H, W]`, or `[3, H, W]` for 0°, 45°, 90°;
/// `[3, P, H, W]` in colour) of the folder `name` as Stokes images `[3·C, H, W]`. Allocates.
///
/// # Errors
/// [`SceneError`] when the folder does not exist or its files are not a scene.
pub(super) fn read(name: &str) -> Result<Stack<f32>, SceneError> {
    let folder = Path::new(name);
    if !folder.is_dir() {
        return Err(SceneError::Unknown { name: name.to_owned() });
    }
    let npy = folder.join("angles.npy");
    let stokes = if npy.exists() { from_npy(&npy) } else { from_png(folder) };
    stokes.map_err(|e| SceneError::Unreadable(Box::new(e)))
}

fn from_png(folder: &Path) -> Result<Stack<f32>, FolderError> {
    let mut images = Vec::with_capacity(4);
    for angle in ANGLES {
        let path = folder.join(format!("{angle}.png"));
        let image = match files::read_image(&path)? {
            Samples::U8(s) => counts(&s),
            Samples::U16(s) => counts(&s),
            Samples::F32(s) => s,
        };
        let expected: &Stack<f32> = images.first().unwrap_or(&image);
        if (image.count(), image.size()) != (expected.count(), expected.size()) {
            let shape = |s: &Stack<f32>| format!("{} planes of {}", s.count(), s.size());
            return Err(FolderError::Shape { path, found: shape(&image), allowed: shape(expected) });
        }
        images.push(image);
    }
    let (channels, size) = (images[0].count(), images[0].size());
    let mut stokes = Stack::zeros(3 * channels, size);
    for c in 0..channels {
        stokes_of([0, 1, 2, 3].map(|p| images[p].plane(c)), &mut stokes, c);
    }
    Ok(stokes)
}

fn counts<T: Copy>(from: &Stack<T>) -> Stack<f32>
where
    f32: From<T>,
{
    let mut out = Stack::zeros(from.count(), from.size());
    out.as_mut_slice().iter_mut().zip(from.as_slice()).for_each(|(to, &v)| *to = f32::from(v));
    out
}

fn from_npy(path: &Path) -> Result<Stack<f32>, FolderError> {
    let array = files::read_npy(path)?;
    let (channels, angles, size) = match array.shape[..] {
        [angles @ (3 | 4), h, w] => (1, angles, Size::new(w, h)),
        [channels @ (1 | 3), angles @ (3 | 4), h, w] => (channels, angles, Size::new(w, h)),
        _ => {
            let (found, allowed) = (format!("{:?}", array.shape), "[P, H, W] or [C, P, H, W] with P 3 or 4, C 1 or 3");
            return Err(FolderError::Shape { path: path.to_path_buf(), found, allowed: allowed.to_owned() });
        }
    };
    let values = array.into_f32();
    let pixels = size.pixels();
    let mut stokes = Stack::zeros(3 * channels, size);
    for (c, images) in values.chunks_exact(angles * pixels).enumerate() {
        let plane = |p: usize| &images[p * pixels..][..pixels];
        if angles == 4 {
            stokes_of([0, 1, 2, 3].map(plane), &mut stokes, c);
        } else {
            // I135 = I0 + I90 - I45
            let last: Vec<f32> = (0..pixels).map(|i| plane(0)[i] + plane(2)[i] - plane(1)[i]).collect();
            stokes_of([plane(0), plane(1), plane(2), &last], &mut stokes, c);
        }
    }
    Ok(stokes)
}

/// Computes S0 = ½ΣI, S1 = I0 - I90, S2 = I45 - I135 of channel `c`.
fn stokes_of(angles: [&[f32]; 4], stokes: &mut Stack<f32>, c: usize) {
    for i in 0..angles[0].len() {
        let [a, b, c2, d] = angles.map(|plane| plane[i]);
        stokes.plane_mut(3 * c)[i] = 0.5 * (a + b + c2 + d);
        stokes.plane_mut(3 * c + 1)[i] = a - c2;
        stokes.plane_mut(3 * c + 2)[i] = b - d;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn angle_images_become_stokes_images() {
        let dir = tempfile::tempdir().unwrap();
        let (s1, s2) = (0.3f32, -0.2f32);
        let values: Vec<f32> = [0.5 * (1.0 + s1), 0.5 * (1.0 + s2), 0.5 * (1.0 - s1)]
            .iter()
            .flat_map(|&v| std::iter::repeat_n(7.0 * v, 24))
            .collect();
        files::write_npy(&dir.path().join("angles.npy"), &[3, 4, 6], &values).unwrap();
        let stokes = read(dir.path().to_str().unwrap()).unwrap();
        for (plane, expected) in stokes.planes().zip([7.0, 7.0 * s1, 7.0 * s2]) {
            assert!(plane.iter().all(|v| (v - expected).abs() < 1e-5), "{:?}", plane[0]);
        }
    }

    #[test]
    fn a_folder_that_is_not_a_scene_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        let name = dir.path().to_str().unwrap();
        let refusal = |name: &str| read(name).unwrap_err().to_string();
        assert!(refusal("plastik").contains("plastic, spheres, wedges, tissue"));
        assert!(refusal(name).contains("0.png"));
        files::write_npy(&dir.path().join("angles.npy"), &[2, 3, 2], &[1.0; 12]).unwrap();
        assert!(refusal(name).contains("[2, 3, 2]"));
    }
}
