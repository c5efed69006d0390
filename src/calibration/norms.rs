//! Figures derived from a bundle and kept beside it, for they take longer to find than to read: squared operator norms.

use std::collections::BTreeMap;
use std::hash::{DefaultHasher, Hash, Hasher};

use serde::{Deserialize, Serialize};

use super::Calibration;
use crate::array::write_atomic;

/// Name of the file in the bundle's folder. It can be removed at any time.
const FILE: &str = "norms.json";

/// The file: what it was derived from, and the figures.
#[derive(Debug, Default, Serialize, Deserialize)]
struct Norms {
    stamp: u64,
    values: BTreeMap<String, f32>,
}

impl Calibration {
    /// The figure `key` of this bundle: read from `norms.json` beside it if that was derived from the same PSF and mask, else
    /// found by `find` and written there. A folder that cannot be written is no error.
    pub fn cached_norm(&self, key: &str, find: impl FnOnce() -> f32) -> f32 {
        let (path, stamp) = (self.dir.join(FILE), self.stamp());
        let read = std::fs::read(&path).ok().and_then(|bytes| serde_json::from_slice::<Norms>(&bytes).ok());
        let mut norms = read.filter(|norms| norms.stamp == stamp).unwrap_or_default();
        if let Some(value) = norms.values.get(key).filter(|v| v.is_finite() && **v > 0.0) {
            return *value;
        }
        let value = find();
        norms.stamp = stamp;
        norms.values.insert(key.to_owned(), value);
        let written = serde_json::to_vec_pretty(&norms).map(|json| write_atomic(&path, |out| out.write_all(&json)));
        if !matches!(written, Ok(Ok(()))) {
            tracing::debug!("{}: not written", path.display());
        }
        value
    }

    /// Changes with the PSF and the mask.
    fn stamp(&self) -> u64 {
        let mut hasher = DefaultHasher::new();
        self.sensor.size.hash(&mut hasher);
        let psf = (0..self.psf.count()).flat_map(|c| self.psf.channel(c));
        let polarized = self.response.polarized().iter().flat_map(|e| [&e.re, &e.im]);
        psf.chain(self.response.unpolarized()).chain(polarized).for_each(|v| v.to_bits().hash(&mut hasher));
        hasher.finish()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::array::write_npy;

    fn bundle(dir: &std::path::Path, stripes: usize) -> Calibration {
        write_npy(&dir.join("psf.npy"), &[8, 8], &(0..64).map(|i| (i % 7) as f32).collect::<Vec<_>>()).unwrap();
        let text = format!(
            "version = 1\nname = \"b\"\nsensor = {{ width = 8, height = 8, channels = 1 }}\nnoise = {{ read = 0.002 }}\n\
             psf = {{ file = \"psf.npy\" }}\nmask = {{ kind = \"stripes\", angles_deg = [0, 45, 90], stripes = {stripes} }}\n"
        );
        std::fs::write(dir.join("calibration.toml"), text).unwrap();
        Calibration::load(dir).unwrap()
    }

    #[test]
    fn a_figure_is_found_once_until_the_bundle_changes_or_the_file_is_spoilt() {
        let dir = tempfile::tempdir().unwrap();
        assert_eq!(bundle(dir.path(), 6).cached_norm("a", || 0.25), 0.25);
        assert_eq!(bundle(dir.path(), 6).cached_norm("a", || unreachable!("it is in the file")), 0.25);
        assert_eq!(bundle(dir.path(), 6).cached_norm("b", || 2.0), 2.0);
        assert_eq!(bundle(dir.path(), 3).cached_norm("a", || 0.5), 0.5);
        std::fs::write(dir.path().join(FILE), b"{\"stamp\": 1").unwrap();
        assert_eq!(bundle(dir.path(), 3).cached_norm("a", || 0.75), 0.75);
    }
}
