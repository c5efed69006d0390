//! Writer of OME-Zarr 0.5: results of many frames as one array `[t, c, y, x]` of single precision, in one uncompressed chunk a frame.
//!
//! ```text
//! NAME.zarr/zarr.json      names of the planes, their display ranges, names of the frames
//!           0/zarr.json    shape and number format
//!           0/c/12/0/0/0   all planes of frame 12, little-endian
//! ```
//!
//! A chunk appears whole or not at all, so that a frame whose chunk is there is done: several processes may write to one array, and a run
//! that was interrupted goes on. A frame without a chunk reads as zeros. The crate `zarrs` would add 59 packages to the program for this.

use std::path::{Path, PathBuf};

use serde_json::{Value, json};

use super::OutputError;
use crate::files::{read_bytes, write_atomic};
use stokescope_core::image::{Size, Stack};

/// Most bytes of a description that are read.
const MAX_DESCRIPTION: u64 = 1 << 28;
const DESCRIPTION: &str = "zarr.json";

/// Contents of an array.
#[derive(Clone, Debug)]
pub struct ZarrSpec<'a> {
    /// Names of the planes of a frame, in their order.
    pub planes: &'a [String],
    /// Size of every plane.
    pub size: Size,
    /// Names of the frames, in their order.
    pub frames: &'a [String],
    /// Time between two frames in seconds, where it is known.
    pub interval: Option<f64>,
    /// How the results were made. An array of other frames or of another origin is not written to.
    pub origin: Value,
}

/// An array that is being written.
#[derive(Debug)]
pub struct Zarr {
    path: PathBuf,
    planes: usize,
    size: Size,
    frames: usize,
}

impl Zarr {
    /// Makes the array in the folder `path`, or opens it where it has the same frames and origin; chunks that are there are kept.
    ///
    /// # Errors
    /// [`OutputError::Occupied`] for a folder with anything else in it; files that cannot be written.
    pub fn create(path: &Path, spec: &ZarrSpec<'_>) -> Result<Self, OutputError> {
        let found = Self { path: path.into(), planes: spec.planes.len(), size: spec.size, frames: spec.frames.len() };
        let (group, array) = (format!("{:#}\n", group(spec)), format!("{:#}\n", array(spec)));
        let files = [path.join("0").join(DESCRIPTION), path.join(DESCRIPTION)];
        let folder = |source| OutputError::Folder { path: path.to_path_buf(), source };
        let occupied = |what| Err(OutputError::Occupied { path: path.to_path_buf(), what });
        if files[1].is_file() {
            let there = read_bytes(&files[1], MAX_DESCRIPTION).map_err(folder)?;
            return if there == group.as_bytes() { Ok(found) } else { occupied("results of other frames or settings") };
        }
        if !files[0].is_file() && std::fs::read_dir(path).is_ok_and(|mut entries| entries.next().is_some()) {
            return occupied("other files");
        }
        std::fs::create_dir_all(path.join("0")).map_err(folder)?;
        // the group comes last: an array that has one is complete
        for (file, text) in files.iter().zip([array, group]) {
            write_atomic(file, |out| out.write_all(text.as_bytes()))?;
        }
        Ok(found)
    }

    /// Removes all frames.
    ///
    /// # Errors
    /// [`OutputError::Folder`] when the disk refuses.
    pub fn clear(&self) -> Result<(), OutputError> {
        let path = self.path.join("0/c");
        match std::fs::remove_dir_all(&path) {
            Err(source) if source.kind() != std::io::ErrorKind::NotFound => Err(OutputError::Folder { path, source }),
            _ => Ok(()),
        }
    }

    /// Whether frame `index` is there.
    pub fn has(&self, index: usize) -> bool {
        let bytes = self.planes * self.size.pixels() * size_of::<f32>();
        self.chunk(index).metadata().is_ok_and(|meta| meta.is_file() && meta.len() == bytes as u64)
    }

    /// Writes the planes of frame `index`, also over an earlier one.
    ///
    /// # Errors
    /// [`OutputError`]: planes of another number or size, a frame that the array has not, values that are not finite, files that cannot be
    /// written.
    pub fn write(&self, index: usize, planes: &Stack<f32>) -> Result<(), OutputError> {
        let shape = |what, found, allowed| Err(OutputError::Shape { what, found, allowed });
        if (planes.count(), planes.size()) != (self.planes, self.size) {
            let found = format!("{} planes of {}", planes.count(), planes.size());
            return shape("planes", found, format!("{} planes of {}", self.planes, self.size));
        }
        if index >= self.frames {
            return shape("frame", index.to_string(), format!("below {}", self.frames));
        }
        if let Some((index, &value)) = planes.as_slice().iter().enumerate().find(|(_, v)| !v.is_finite()) {
            return Err(OutputError::NonFinite { what: "planes", index, value });
        }
        let chunk = self.chunk(index);
        if let Some(folder) = chunk.parent() {
            std::fs::create_dir_all(folder)
                .map_err(|source| OutputError::Folder { path: folder.to_path_buf(), source })?;
        }
        Ok(write_atomic(&chunk, |out| planes.as_slice().iter().try_for_each(|v| out.write_all(&v.to_le_bytes())))?)
    }

    fn chunk(&self, index: usize) -> PathBuf {
        self.path.join(format!("0/c/{index}/0/0/0"))
    }
}

/// Values between which a plane of this name is displayed.
pub(super) fn display_range(name: &str) -> [f64; 2] {
    match name {
        _ if name.starts_with("AoLP") => [0.0, 180.0],
        _ if name.ends_with("S1") || name.ends_with("S2") => [-0.25, 0.25],
        _ => [0.0, 1.0],
    }
}

fn group(spec: &ZarrSpec<'_>) -> Value {
    let channel = |name: &String| {
        let [start, end] = display_range(name);
        let window = json!({ "min": start, "max": end, "start": start, "end": end });
        json!({ "label": name, "color": "FFFFFF", "active": true, "window": window })
    };
    let time = match spec.interval {
        Some(_) => json!({ "name": "t", "type": "time", "unit": "second" }),
        None => json!({ "name": "t", "type": "time" }),
    };
    let axes = json!([time, { "name": "c", "type": "channel" }, { "name": "y", "type": "space" }, { "name": "x", "type": "space" }]);
    let scale = json!([{ "type": "scale", "scale": [spec.interval.unwrap_or(1.0), 1.0, 1.0, 1.0] }]);
    let dataset = json!({ "path": "0", "coordinateTransformations": scale });
    json!({
        "zarr_format": 3,
        "node_type": "group",
        "attributes": {
            "ome": {
                "version": "0.5",
                "multiscales": [{ "name": "polarization", "axes": axes, "datasets": [dataset] }],
                "omero": { "channels": spec.planes.iter().map(channel).collect::<Vec<_>>() },
            },
            "stokescope": { "version": env!("CARGO_PKG_VERSION"), "frames": spec.frames, "origin": spec.origin },
        },
    })
}

fn array(spec: &ZarrSpec<'_>) -> Value {
    let Size { width, height } = spec.size;
    json!({
        "zarr_format": 3,
        "node_type": "array",
        "shape": [spec.frames.len(), spec.planes.len(), height, width],
        "data_type": "float32",
        "chunk_grid": { "name": "regular", "configuration": { "chunk_shape": [1, spec.planes.len(), height, width] } },
        "chunk_key_encoding": { "name": "default", "configuration": { "separator": "/" } },
        "codecs": [{ "name": "bytes", "configuration": { "endian": "little" } }],
        "fill_value": 0.0,
        "attributes": {},
        "dimension_names": ["t", "c", "y", "x"],
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: Size = Size::new(3, 2);

    fn frame(value: f32) -> Stack<f32> {
        Stack::from_vec(2, SIZE, vec![value; 12]).unwrap()
    }

    #[test]
    fn frames_are_chunks_that_are_whole_and_an_array_is_gone_on_with() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.zarr");
        let names = |start: &str| [0, 1, 2].map(|k| format!("{start}{k}"));
        let (planes, frames) = (["S0".to_owned(), "DoLP".to_owned()], names("f"));
        let spec =
            ZarrSpec { planes: &planes, size: SIZE, frames: &frames, interval: Some(0.1), origin: json!({ "a": 1.5 }) };
        let zarr = Zarr::create(&path, &spec).unwrap();
        zarr.write(1, &frame(0.5)).unwrap();
        assert_eq!(std::fs::read(path.join("0/c/1/0/0/0")).unwrap(), 0.5f32.to_le_bytes().repeat(12));
        let again = Zarr::create(&path, &spec).unwrap();
        assert_eq!([0, 1, 2].map(|k| again.has(k)), [false, true, false]);
        std::fs::write(path.join("0/c/1/0/0/0"), "cut short").unwrap();
        assert!(!again.has(1));
        again.clear().unwrap();
        assert!(!path.join("0/c").exists() && again.clear().is_ok());

        for (index, planes, part) in [
            (3, frame(0.5), "frame: 3, allowed: below 3"),
            (0, frame(f32::NAN), "value 0 is NaN"),
            (0, Stack::from_vec(1, SIZE, vec![0.0; 6]).unwrap(), "planes: 1 planes of"),
        ] {
            let e = zarr.write(index, &planes).unwrap_err().to_string();
            assert!(e.contains(part), "{e}");
        }
        let other = ZarrSpec { frames: &names("g"), ..spec.clone() };
        let e = Zarr::create(&path, &other).unwrap_err().to_string();
        assert!(e.contains("holds results of other frames or settings"), "{e}");
        let e = Zarr::create(dir.path(), &spec).unwrap_err().to_string();
        assert!(e.contains("holds other files"), "{e}");
    }
}
