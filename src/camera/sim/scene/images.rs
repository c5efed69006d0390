use std::path::{Path, PathBuf};

use super::Grid;
use crate::{
    array::{self, ArrayError, Samples},
    plane::{Size, Stack},
};

/// Polarizer angles of the files, in degrees.
const ANGLES: [u32; 4] = [0, 45, 90, 135];
/// Share of pixels that may be brighter than full scale after scaling: highlights.
const HIGHLIGHTS: f64 = 0.005;

/// A folder that is no scene.
#[derive(Debug, thiserror::Error)]
pub enum SceneError {
    /// Neither a built-in scene nor a folder.
    #[error("`{name}` is neither a built-in scene ({}) nor a folder", names())]
    Unknown {
        /// What was asked for.
        name: String,
    },
    /// A file cannot be read.
    #[error(transparent)]
    Array(Box<ArrayError>),
    /// A file has another shape than the scene needs.
    #[error("{}: shape {found}, allowed: {allowed}", path.display())]
    Shape {
        /// The file.
        path: PathBuf,
        /// Its shape.
        found: String,
        /// What fits.
        allowed: String,
    },
    /// No light, or values that are no numbers.
    #[error("{}: S0 reaches {found}, a scene needs a finite positive brightness", path.display())]
    Dark {
        /// The folder.
        path: PathBuf,
        /// Its bright end.
        found: f32,
    },
}

impl From<ArrayError> for SceneError {
    fn from(e: ArrayError) -> Self {
        Self::Array(Box::new(e))
    }
}

fn names() -> String {
    super::SCENES.iter().chain(super::TARGETS).map(|s| s.0).collect::<Vec<_>>().join(", ")
}

/// A still scene measured by a polarization camera.
pub(in super::super) struct Images {
    /// S0, S1, S2 per channel (1 or 3), on the fine grid.
    stokes: Stack<f32>,
}

impl Images {
    /// Reads `0.png`, `45.png`, `90.png`, `135.png` (linear, 8 or 16 bit) or `angles.npy` (`[4, H, W]`, or `[3, H, W]` for
    /// 0°, 45°, 90°; `[3, P, H, W]` in colour), crops the middle to the aspect of `size` and averages down to it. The
    /// brightest half percent of S0 is scaled beyond 1.
    pub(super) fn load(path: &Path, size: Size) -> Result<Self, SceneError> {
        if !path.is_dir() {
            return Err(SceneError::Unknown { name: path.display().to_string() });
        }
        let npy = path.join("angles.npy");
        let measured = if npy.exists() { from_npy(&npy)? } else { from_png(path)? };
        let mut stokes = Stack::zeros(measured.count(), size);
        for (from, to) in measured.planes().zip(stokes.planes_mut()) {
            resize(from, measured.size(), size, to);
        }
        let mut bright: Vec<f32> = stokes.planes().step_by(3).flatten().copied().collect();
        bright.sort_by(f32::total_cmp);
        let white = bright[((bright.len() - 1) as f64 * (1.0 - HIGHLIGHTS)) as usize];
        if !(white > 0.0 && white.is_finite()) {
            return Err(SceneError::Dark { path: path.to_path_buf(), found: white });
        }
        let pixels = size.pixels();
        for channel in stokes.as_mut_slice().chunks_exact_mut(3 * pixels) {
            for i in 0..pixels {
                let [s0, s1, s2] = [0, 1, 2].map(|k| channel[k * pixels + i] / white);
                let s = super::physical([s0, s1, s2]);
                (0..3).for_each(|k| channel[k * pixels + i] = s[k]);
            }
        }
        Ok(Self { stokes })
    }

    /// Fills `out` by bilinear interpolation; what lies outside continues the edge. A gray scene serves all channels.
    pub(super) fn sample(&self, grid: Grid, out: &mut Stack<f32>) {
        let Size { width, height } = grid.frame;
        let first = if self.stokes.count() > out.count() { 3 } else { 0 };
        for (k, plane) in out.planes_mut().enumerate() {
            let from = self.stokes.plane((first + k) % self.stokes.count());
            for y in 0..grid.size.height {
                for x in 0..grid.size.width {
                    let [px, py] = grid.position(x, y);
                    let (top, below, wy) = between(py, height);
                    let (left, right, wx) = between(px, width);
                    let along = |row: usize| {
                        let row = &from[row * width..][..width];
                        row[left] + wx * (row[right] - row[left])
                    };
                    let (a, b) = (along(top), along(below));
                    plane[y * grid.size.width + x] = a + wy * (b - a);
                }
            }
        }
    }
}

/// Neighbours of a position among `count` samples and the weight of the second.
fn between(at: f32, count: usize) -> (usize, usize, f32) {
    let at = at.clamp(0.0, (count - 1) as f32);
    let low = at as usize;
    (low, (low + 1).min(count - 1), at - low as f32)
}

fn from_png(folder: &Path) -> Result<Stack<f32>, SceneError> {
    let mut images = Vec::with_capacity(4);
    for angle in ANGLES {
        let path = folder.join(format!("{angle}.png"));
        let image = match array::read_image(&path)? {
            Samples::U8(s) => counts(&s),
            Samples::U16(s) => counts(&s),
            Samples::F32(s) => s,
        };
        let expected: &Stack<f32> = images.first().unwrap_or(&image);
        if (image.count(), image.size()) != (expected.count(), expected.size()) {
            let shape = |s: &Stack<f32>| format!("{} planes of {}", s.count(), s.size());
            return Err(SceneError::Shape { path, found: shape(&image), allowed: shape(expected) });
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

fn from_npy(path: &Path) -> Result<Stack<f32>, SceneError> {
    let array = array::read_npy(path)?;
    let (channels, angles, size) = match array.shape[..] {
        [angles @ (3 | 4), h, w] => (1, angles, Size::new(w, h)),
        [channels @ (1 | 3), angles @ (3 | 4), h, w] => (channels, angles, Size::new(w, h)),
        _ => {
            let (found, allowed) = (format!("{:?}", array.shape), "[P, H, W] or [C, P, H, W] with P 3 or 4, C 1 or 3");
            return Err(SceneError::Shape { path: path.to_path_buf(), found, allowed: allowed.to_owned() });
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

/// S0 = ½ΣI, S1 = I0 - I90, S2 = I45 - I135 of channel `c`.
fn stokes_of(angles: [&[f32]; 4], stokes: &mut Stack<f32>, c: usize) {
    for i in 0..angles[0].len() {
        let [a, b, c2, d] = angles.map(|plane| plane[i]);
        stokes.plane_mut(3 * c)[i] = 0.5 * (a + b + c2 + d);
        stokes.plane_mut(3 * c + 1)[i] = a - c2;
        stokes.plane_mut(3 * c + 2)[i] = b - d;
    }
}

/// Crops the middle of `from` to the aspect of `to_size` and resamples it.
fn resize(from: &[f32], size: Size, to_size: Size, to: &mut [f32]) {
    let width = (size.height * to_size.width / to_size.height).clamp(1, size.width);
    let height = (size.width * to_size.height / to_size.width).clamp(1, size.height);
    let (left, top) = ((size.width - width) / 2, (size.height - height) / 2);
    let (columns, rows) = (weights(left, width, to_size.width), weights(top, height, to_size.height));
    let mut narrow = vec![0.0; size.height * to_size.width];
    for (row, line) in from.chunks_exact(size.width).zip(narrow.chunks_exact_mut(to_size.width)) {
        for (value, (first, share)) in line.iter_mut().zip(&columns) {
            *value = share.iter().zip(&row[*first..]).map(|(w, v)| w * v).sum();
        }
    }
    for (line, (first, share)) in to.chunks_exact_mut(to_size.width).zip(&rows) {
        line.fill(0.0);
        for (w, row) in share.iter().zip(narrow[first * to_size.width..].chunks_exact(to_size.width)) {
            line.iter_mut().zip(row).for_each(|(sum, v)| *sum += w * v);
        }
    }
}

/// For each of `count` samples over `length` pixels from `start`: its first pixel and the weights from there on, a
/// triangle as wide as two samples or two pixels, whichever is more.
fn weights(start: usize, length: usize, count: usize) -> Vec<(usize, Vec<f32>)> {
    let step = length as f32 / count as f32;
    let reach = step.max(1.0);
    (0..count)
        .map(|n| {
            let middle = (n as f32 + 0.5) * step - 0.5;
            let first = (middle - reach).ceil().max(0.0) as usize;
            let last = ((middle + reach) as usize).min(length - 1);
            let mut share: Vec<f32> =
                (first..=last).map(|i| (1.0 - (i as f32 - middle).abs() / reach).max(0.0)).collect();
            let sum: f32 = share.iter().sum();
            share.iter_mut().for_each(|w| *w /= sum);
            (start + first, share)
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use nalgebra::Matrix3;

    use super::*;

    #[test]
    fn a_folder_of_angles_becomes_its_stokes_images() {
        let dir = tempfile::tempdir().unwrap();
        let (s1, s2) = (0.3f32, -0.2f32);
        let values: Vec<f32> = [0.5 * (1.0 + s1), 0.5 * (1.0 + s2), 0.5 * (1.0 - s1)]
            .iter()
            .flat_map(|&v| std::iter::repeat_n(7.0 * v, 24))
            .collect();
        array::write_npy(&dir.path().join("angles.npy"), &[3, 4, 6], &values).unwrap();
        let size = Size::new(9, 8);
        let images = Images::load(dir.path(), size).unwrap();
        let mut out = Stack::zeros(9, size);
        let map = Matrix3::new(1.0, 0.0, -1.5, 0.0, 1.0, 0.5, 0.0, 0.0, 1.0);
        images.sample(Grid { map: Some(map), ..Grid::frame(size) }, &mut out);
        for (k, plane) in out.planes().enumerate() {
            let expected = [1.0, s1, s2][k % 3];
            assert!(plane.iter().all(|v| (v - expected).abs() < 1e-5), "{k}: {:?}", plane[0]);
        }
    }

    #[test]
    fn resampling_keeps_a_ramp_and_the_middle() {
        let size = Size::new(60, 20);
        let from: Vec<f32> = (0..1200).map(|i| (i % 60) as f32 - 29.5).collect();
        for n in [7, 20, 33] {
            let mut to = vec![0.0; n * n];
            resize(&from, size, Size::new(n, n), &mut to);
            let (row, step) = (&to[n * (n / 2)..][..n], 20.0 / n as f32);
            for (x, v) in row.iter().enumerate().skip(2).take(n - 4) {
                assert!((v - step * (x as f32 + 0.5 - 0.5 * n as f32)).abs() < 0.02 * step, "{n}: {row:?}");
            }
        }
    }

    #[test]
    fn what_is_no_scene_is_named() {
        let dir = tempfile::tempdir().unwrap();
        let load = |p: &Path| Images::load(p, Size::new(8, 8)).err().map(|e| e.to_string()).unwrap();
        assert!(load(Path::new("plastik")).contains("plastic, spheres, wedges, tissue"));
        assert!(load(dir.path()).contains("0.png"));
        let npy = dir.path().join("angles.npy");
        array::write_npy(&npy, &[2, 3, 2], &[1.0; 12]).unwrap();
        assert!(load(dir.path()).contains("[2, 3, 2]"));
        array::write_npy(&npy, &[4, 2, 2], &[0.0; 16]).unwrap();
        assert!(load(dir.path()).contains("S0 reaches 0"));
    }
}
