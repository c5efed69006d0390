use stokescope_core::image::{Size, Stack};

use super::Grid;

/// Share of pixels, the highlights, that may be brighter than full scale after scaling.
const HIGHLIGHTS: f64 = 0.005;

/// Returns the Stokes images of the measured scene of a name, `[3·C, H, W]`: S0, S1, S2 of 1 or 3 channels, in any unit.
pub type SceneReader<'a> = &'a dyn Fn(&str) -> Result<Stack<f32>, SceneError>;

/// A scene that cannot be loaded.
#[derive(Debug, thiserror::Error)]
pub enum SceneError {
    /// A name that is neither a built-in scene nor one that the reader knows.
    #[error("`{name}` is neither a built-in scene ({}) nor a folder", names())]
    Unknown {
        /// The name asked for.
        name: String,
    },
    /// A failure of the reader.
    #[error(transparent)]
    Unreadable(Box<dyn std::error::Error + Send + Sync>),
    /// Images without light, or with values that are not finite.
    #[error("{name}: S0 reaches {found}, a scene needs a finite positive brightness")]
    Dark {
        /// Name of the scene.
        name: String,
        /// Brightness that all but the highlights stay below.
        found: f32,
    },
    /// Images that are not S0, S1, S2 of one or three channels.
    #[error("{name}: {found} planes, allowed: 3 (S0, S1, S2) or 9 (those of red, green and blue)")]
    Planes {
        /// Name of the scene.
        name: String,
        /// Number of planes.
        found: usize,
    },
}

fn names() -> String {
    super::SCENES.iter().chain(super::TARGETS).map(|s| s.0).collect::<Vec<_>>().join(", ")
}

/// A still scene measured by a polarization camera.
pub(in super::super) struct Images {
    /// S0, S1, S2 per channel (1 or 3), on the fine grid of the frame and its margin.
    stokes: Stack<f32>,
    /// Samples beyond the frame, on each side.
    margin: usize,
}

impl Images {
    /// Crops the middle of the `measured` Stokes images to the aspect of `field` and averages them down to it: with a margin, the frame
    /// shows their inner part alone. The brightest half percent of S0 is scaled beyond 1.
    pub(super) fn new(name: &str, measured: &Stack<f32>, field: Grid) -> Result<Self, SceneError> {
        let Grid { size, margin, .. } = field;
        if !matches!(measured.count(), 3 | 9) {
            return Err(SceneError::Planes { name: name.to_owned(), found: measured.count() });
        }
        let mut stokes = Stack::zeros(measured.count(), size);
        for (from, to) in measured.planes().zip(stokes.planes_mut()) {
            resize(from, measured.size(), size, to);
        }
        let mut bright: Vec<f32> = stokes.planes().step_by(3).flatten().copied().collect();
        bright.sort_by(f32::total_cmp);
        let white = bright[((bright.len() - 1) as f64 * (1.0 - HIGHLIGHTS)) as usize];
        if !(white > 0.0 && white.is_finite()) {
            return Err(SceneError::Dark { name: name.to_owned(), found: white });
        }
        let pixels = size.pixels();
        for channel in stokes.as_mut_slice().chunks_exact_mut(3 * pixels) {
            for i in 0..pixels {
                let [s0, s1, s2] = [0, 1, 2].map(|k| channel[k * pixels + i] / white);
                let s = super::physical([s0, s1, s2]);
                (0..3).for_each(|k| channel[k * pixels + i] = s[k]);
            }
        }
        Ok(Self { stokes, margin })
    }

    /// Fills `out` by bilinear interpolation; beyond the image its edge continues. A gray scene serves all channels.
    pub(super) fn sample(&self, grid: Grid, out: &mut Stack<f32>) {
        let Size { width, height } = self.stokes.size();
        let margin = self.margin as f32;
        let first = if self.stokes.count() > out.count() { 3 } else { 0 };
        for (k, plane) in out.planes_mut().enumerate() {
            let from = self.stokes.plane((first + k) % self.stokes.count());
            for y in 0..grid.size.height {
                for x in 0..grid.size.width {
                    let [px, py] = grid.position(x, y).map(|at| at + margin);
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
    fn measured_images_are_brought_to_size_and_scaled() {
        let (s1, s2) = (0.3f32, -0.2f32);
        let values: Vec<f32> = [1.0, s1, s2].iter().flat_map(|&v| std::iter::repeat_n(7.0 * v, 24)).collect();
        let measured = Stack::from_vec(3, Size::new(6, 4), values).unwrap();
        let size = Size::new(9, 8);
        let images = Images::new("measured", &measured, Grid::frame(size)).unwrap();
        let mut out = Stack::zeros(9, size);
        let map = Matrix3::new(1.0, 0.0, -1.5, 0.0, 1.0, 0.5, 0.0, 0.0, 1.0);
        images.sample(Grid { map: Some(map), ..Grid::frame(size) }, &mut out);
        for (k, plane) in out.planes().enumerate() {
            let expected = [1.0, s1, s2][k % 3];
            assert!(plane.iter().all(|v| (v - expected).abs() < 1e-5), "{k}: {:?}", plane[0]);
        }
        let dark = Images::new("measured", &Stack::zeros(3, size), Grid::frame(size)).err().unwrap().to_string();
        assert_eq!(dark, "measured: S0 reaches 0, a scene needs a finite positive brightness");
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
}
