//! L1: fusion models. A model is a folder with `manifest.toml`, which describes the network, and ONNX files of the network in f32
//! and perhaps in int8. This module reads and validates manifests and verifies the digests of files; [`stokescope_core::refine`] runs
//! the networks.
//!
//! Shipped models are compiled into the program. Other models are given as a name, whose folder is `models/NAME/`, or as the path of
//! a folder or manifest. `docs/models.md` describes the format.
//!
//! Allocation: everything allocates. Imports: [`crate::config`], [`crate::files`].
//!
//! ```
//! use stokescope::model::Choice;
//! assert_eq!(Choice::from("off".to_owned()), Choice::Off);
//! let e = stokescope::model::Model::load("smal").unwrap_err().to_string();
//! assert!(e.starts_with("fusion model smal: neither shipped nor in models/smal/"));
//! ```

mod raw;
mod selection;
#[cfg(feature = "program")]
pub mod trial;

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

pub use selection::{Allowance, Selection, SelectionError};
use sha2::{Digest, Sha256};
use stokescope_core::refine;
pub use stokescope_core::refine::model::{Onnx, Precision};
pub use stokescope_core::refine::{Network, PlanError as NetworkError};

use crate::config::{self, Checker, ConfigError};
use crate::files;

/// Largest model file that is read, in bytes.
pub const MAX_BYTES: u64 = 64 << 20;
/// The folder of models that are not shipped, relative to the working directory.
pub const LOCAL: &str = "models";
/// File name of a manifest.
const MANIFEST: &str = "manifest.toml";

/// Why a model cannot be opened.
#[derive(Debug, thiserror::Error)]
pub enum OpenError {
    /// The manifest or a file cannot be read.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// The network cannot be run.
    #[error(transparent)]
    Network(#[from] NetworkError),
}

/// A shipped model: name of its folder in `models/`, content of its manifest and files.
struct Shipped {
    name: &'static str,
    manifest: &'static str,
    files: &'static [(&'static str, &'static [u8])],
}

/// A folder of `models/` with its two files.
macro_rules! shipped {
    ($name:literal) => {
        Shipped {
            name: $name,
            manifest: include_str!(concat!(env!("CARGO_MANIFEST_DIR"), "/models/", $name, "/manifest.toml")),
            files: &[shipped!($name, "model.onnx"), shipped!($name, "model-int8.onnx")],
        }
    };
    ($name:literal, $file:literal) => {
        ($file, include_bytes!(concat!(env!("CARGO_MANIFEST_DIR"), "/models/", $name, "/", $file)))
    };
}

/// The shipped models, best first: `auto` tries them in this order.
const SHIPPED: &[Shipped] = &[shipped!("default"), shipped!("preview")];

/// Which fusion model to use.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum Choice {
    /// The best of the shipped models that time and memory allow; else physics only.
    #[default]
    Auto,
    /// Physics only.
    Off,
    /// A model's name, folder or manifest.
    Named(String),
}

impl From<String> for Choice {
    fn from(text: String) -> Self {
        match text.as_str() {
            "auto" => Self::Auto,
            "off" => Self::Off,
            _ => Self::Named(text),
        }
    }
}

/// How a model was trained.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Trained {
    /// Day, YYYY-MM-DD.
    pub date: String,
    /// Training data.
    pub data: String,
    /// Iterations of stage I that made the training data.
    pub iterations: usize,
}

/// A file of the network.
#[derive(Clone, Debug, PartialEq, Eq)]
struct File {
    name: String,
    sha256: String,
}

/// A model: its network, how it was trained, and its files.
#[derive(Clone, Debug, PartialEq)]
pub struct Model {
    /// The network.
    pub network: refine::Model,
    /// One line for humans.
    pub description: String,
    /// SPDX expression.
    pub licence: String,
    /// How it was trained.
    pub trained: Trained,
    /// Measured figures by name.
    pub metrics: BTreeMap<String, f64>,
    /// Path of the manifest; of a shipped model its path in the repository.
    pub manifest: PathBuf,
    f32: File,
    int8: Option<File>,
    shipped: bool,
}

/// Why a model or its files cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// There is no such model.
    #[error("fusion model {name}: neither shipped nor in {LOCAL}/{name}/, nor a folder or manifest; allowed: auto, off{}", Model::shipped().map(|n| format!(", {n}")).collect::<String>())]
    Missing {
        /// Name or path as given.
        name: String,
    },
    /// The manifest is not valid.
    #[error(transparent)]
    Manifest(#[from] ConfigError),
    /// A model file cannot be read.
    #[error("{}: {source}", file.display())]
    Io {
        /// The file.
        file: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// A model file is too large.
    #[error("{}: {found} bytes, a model file has at most {MAX_BYTES}", file.display())]
    TooLarge {
        /// The file.
        file: PathBuf,
        /// Bytes of the file.
        found: u64,
    },
    /// A model file is not the one that the manifest names.
    #[error("{}: its SHA-256 is {found}, {} expects {expected}: the file is damaged or belongs to another model", file.display(), manifest.display())]
    Digest {
        /// The file.
        file: PathBuf,
        /// The manifest.
        manifest: PathBuf,
        /// Digest in the manifest.
        expected: String,
        /// Digest of the file.
        found: String,
    },
    /// A model file takes too much memory or time, or ends the program that opens it.
    #[cfg(feature = "program")]
    #[error("{}: cannot be used: its analysis {problem}; allowed: {} MiB and {} s", file.display(), trial::MAX_MEMORY >> 20, trial::MAX_TIME.as_secs())]
    Costly {
        /// The file.
        file: PathBuf,
        /// The problem, as a clause.
        problem: String,
    },
    /// The model has no file of this precision.
    #[error("{}: the model has no {precision} file; allowed: f32", manifest.display())]
    Precision {
        /// The manifest.
        manifest: PathBuf,
        /// The precision that was asked for.
        precision: Precision,
    },
}

impl Model {
    /// Reads the manifest of the shipped model `name`, of the model in `models/name/`, or of the folder or manifest file `name`.
    ///
    /// # Errors
    /// [`ModelError`].
    pub fn load(name: &str) -> Result<Self, ModelError> {
        if let Some(shipped) = SHIPPED.iter().find(|s| s.name == name) {
            let path = Path::new(LOCAL).join(name).join(MANIFEST);
            return Ok(Self { shipped: true, ..Self::parse(&path, shipped.manifest)? });
        }
        let typed = Path::new(name);
        let manifest = if typed.is_dir() { typed.join(MANIFEST) } else { typed.to_path_buf() };
        let Some(path) = [manifest, Path::new(LOCAL).join(name).join(MANIFEST)].into_iter().find(|p| p.exists()) else {
            return Err(ModelError::Missing { name: name.to_owned() });
        };
        Ok(Self::parse(&path, &config::read(&path)?)?)
    }

    /// Parses and validates `text`, the content of the manifest at `path`.
    ///
    /// # Errors
    /// [`ConfigError`] with file, line, key and what is allowed, for all values out of range at once.
    pub fn parse(path: &Path, text: &str) -> Result<Self, ConfigError> {
        let raw: raw::ManifestFile = config::parse(path, text)?;
        let mut check = Checker::new(path, text);
        let model = raw.validate(path, &mut check);
        check.finish()?;
        Ok(model)
    }

    /// Metric that states the multiply-adds of a tile.
    pub const MACS: &str = "macs";

    /// Names of the shipped models.
    pub fn shipped() -> impl Iterator<Item = &'static str> {
        SHIPPED.iter().map(|s| s.name)
    }

    /// Names of the folders in `models/` that hold a manifest and are not shipped, sorted.
    pub fn local() -> Vec<String> {
        let Ok(entries) = std::fs::read_dir(LOCAL) else { return Vec::new() };
        let mut names: Vec<_> = entries
            .filter_map(|entry| Some(entry.ok()?.path()))
            .filter(|folder| folder.join(MANIFEST).is_file())
            .filter_map(|folder| folder.file_name()?.to_str().map(str::to_owned))
            .filter(|name| Self::shipped().all(|shipped| shipped != name))
            .collect();
        names.sort();
        names
    }

    /// Whether the model is compiled into the program.
    pub fn is_shipped(&self) -> bool {
        self.shipped
    }

    /// The precisions of the model's files, f32 first.
    pub fn precisions(&self) -> Vec<Precision> {
        [Some(Precision::F32), self.int8.is_some().then_some(Precision::Int8)].into_iter().flatten().collect()
    }

    /// Path of the file of a precision.
    ///
    /// # Errors
    /// [`ModelError::Precision`].
    pub fn file(&self, precision: Precision) -> Result<PathBuf, ModelError> {
        Ok(self.manifest.with_file_name(&self.entry(precision)?.name))
    }

    fn entry(&self, precision: Precision) -> Result<&File, ModelError> {
        match precision {
            Precision::F32 => Some(&self.f32),
            Precision::Int8 => self.int8.as_ref(),
        }
        .ok_or_else(|| ModelError::Precision { manifest: self.manifest.clone(), precision })
    }

    /// Reads the network's ONNX file and verifies its digest. Allocates, except for shipped models.
    ///
    /// # Errors
    /// [`ModelError`] when the file does not exist, is too large or has another digest.
    pub fn onnx(&self, precision: Precision) -> Result<Onnx, ModelError> {
        let (entry, file) = (self.entry(precision)?, self.file(precision)?);
        let shipped = SHIPPED.iter().filter(|s| self.shipped && s.name == self.network.name).flat_map(|s| s.files);
        let bytes = match shipped.into_iter().find(|(name, _)| *name == entry.name) {
            Some((_, bytes)) => Cow::Borrowed(*bytes),
            None => Cow::Owned(read(&file)?),
        };
        let found: String = Sha256::digest(&bytes).iter().map(|byte| format!("{byte:02x}")).collect();
        if found != entry.sha256 {
            let (manifest, expected) = (self.manifest.clone(), entry.sha256.clone());
            return Err(ModelError::Digest { file, manifest, expected, found });
        }
        Ok(Onnx { name: file.display().to_string(), bytes, precision })
    }

    /// Reads the network and makes it ready to run. The program tries a network that is not shipped in a process of its own first (see
    /// [`trial`]). Allocates.
    ///
    /// # Errors
    /// [`OpenError`] with the file, what was expected and what was found.
    pub fn open(&self, precision: Precision) -> Result<Network, OpenError> {
        let onnx = self.onnx(precision)?;
        // a library has no program to try it in
        #[cfg(feature = "program")]
        if !self.shipped {
            trial::run(&self.manifest, precision, &self.file(precision)?)?;
        }
        Ok(Network::load(self.network.clone(), onnx)?)
    }
}

fn read(file: &Path) -> Result<Vec<u8>, ModelError> {
    let io = |source| ModelError::Io { file: file.to_path_buf(), source };
    let found = std::fs::metadata(file).map_err(io)?.len();
    if found > MAX_BYTES {
        return Err(ModelError::TooLarge { file: file.to_path_buf(), found });
    }
    files::read_bytes(file, MAX_BYTES).map_err(io)
}

#[cfg(test)]
mod tests {
    use stokescope_core::refine::model::Tiling;

    use super::*;

    const MANIFEST_TEXT: &str = r#"version = 1
name = "tiny"
description = "random weights"
licence = "MIT OR Apache-2.0"
[trained]
date = "2026-01-31"
data = "none: random weights"
iterations = 10
[metrics]
gain_db = 0.5
[files]
f32 = { file = "model.onnx", sha256 = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad" }
[input]
tile = 32
halo = 4
multiple = 16
"#;

    fn folder(text: &str, onnx: &[u8]) -> (tempfile::TempDir, Result<Model, ModelError>) {
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(dir.path().join(MANIFEST), text).unwrap();
        std::fs::write(dir.path().join("model.onnx"), onnx).unwrap();
        let model = Model::load(dir.path().to_str().unwrap());
        (dir, model)
    }

    #[test]
    fn a_folder_is_a_model() {
        let (_dir, model) = folder(MANIFEST_TEXT, b"abc");
        let model = model.unwrap();
        assert_eq!((model.network.name.as_str(), model.trained.iterations), ("tiny", 10));
        assert_eq!(model.network.tiling, Tiling { tile: 32, halo: 4, multiple: 16 });
        assert_eq!(model.network.shapes(), [[1, 55, 8, 8], [1, 240, 8, 8]]);
        assert_eq!(
            (model.network.clone().fitted(12).tiling.tile, model.network.clone().fitted(100).tiling.tile),
            (16, 32)
        );
        assert_eq!(model.onnx(Precision::F32).unwrap().bytes.as_ref(), b"abc");
        let e = model.onnx(Precision::Int8).unwrap_err().to_string();
        assert!(e.ends_with("manifest.toml: the model has no int8 file; allowed: f32"), "{e}");
    }

    #[test]
    fn another_digest_names_file_manifest_and_both_digests() {
        let (_dir, model) = folder(MANIFEST_TEXT, b"abd");
        let e = model.unwrap().onnx(Precision::F32).unwrap_err().to_string();
        assert!(e.contains("model.onnx: its SHA-256 is a52d159f"), "{e}");
        assert!(e.contains("manifest.toml expects ba7816bf"), "{e}");
    }

    #[test]
    fn all_values_out_of_range_come_at_once_with_their_lines() {
        let text = MANIFEST_TEXT
            .replace("version = 1", "version = 2")
            .replace("tile = 32", "tile = 33")
            .replace("halo = 4", "halo = 16")
            .replace("multiple = 16", "multiple = 8")
            .replace("model.onnx", "../model.onnx")
            .replace("015ad", "015a");
        let e = folder(&text, b"").1.unwrap_err().to_string();
        for part in [
            "manifest.toml:1: version = 2, allowed: 1",
            ":12: files.f32.file = \"../model.onnx\"",
            ":12: files.f32.sha256 = \"ba78",
            ":14: input.tile = 33, allowed: 16 to 1024, a multiple of input.multiple",
            ":15: input.halo = 16, allowed: 0 to 11 with these input.tile and input.multiple",
            ":16: input.multiple = 8, allowed: 16, 32, 48 or 64",
        ] {
            assert!(e.contains(part), "{part} is not in\n{e}");
        }
        assert_eq!(e.lines().count(), 6, "{e}");
    }

    #[test]
    fn a_halo_that_leaves_gaps_between_tiles_is_refused() {
        let manifest = |halo: usize| MANIFEST_TEXT.replace("halo = 4", &format!("halo = {halo}"));
        assert_eq!(folder(&manifest(8), b"").1.unwrap().network.tiling.halo, 8);
        let e = folder(&manifest(9), b"").1.unwrap_err().to_string();
        assert!(e.contains(":15: input.halo = 9, allowed: 0 to 8 with these"), "{e}");
    }

    #[test]
    fn networks_of_other_kinds_are_refused_with_the_line() {
        let mixes = MANIFEST_TEXT.replace("[trained]", "kind = \"mixes\"\n[trained]");
        assert_eq!(folder(&mixes, b"").1.unwrap().network, folder(MANIFEST_TEXT, b"").1.unwrap().network);
        for (text, message) in [
            (mixes.replace("\"mixes\"", "\"adds\""), "unknown variant `adds`, expected `mixes`"),
            (format!("{MANIFEST_TEXT}planes = [{{ plane = \"s1\" }}]\n"), "unknown field `planes`"),
            (format!("{MANIFEST_TEXT}[output]\nplanes = [\"s1\", \"s2\"]\nscale = 0.1\n"), "unknown field `output`"),
        ] {
            let e = folder(&text, b"").1.unwrap_err().to_string();
            assert!(e.contains(message) && e.contains("manifest.toml:"), "{message} is not in\n{e}");
        }
    }

    #[test]
    fn a_mistyped_key_names_the_nearest() {
        let e = folder(&MANIFEST_TEXT.replace("halo", "hallo"), b"").1.unwrap_err().to_string();
        assert!(e.contains("did you mean `halo`?"), "{e}");
    }

    #[test]
    fn every_folder_in_models_is_shipped_and_valid() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join(LOCAL);
        let entries = std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().path());
        let mut names: Vec<_> =
            entries.filter(|p| p.is_dir()).map(|p| p.file_name().unwrap().to_str().unwrap().to_owned()).collect();
        names.sort();
        let mut shipped: Vec<_> = Model::shipped().collect();
        shipped.sort_unstable();
        assert_eq!(names, shipped);
        for name in shipped {
            let model = Model::load(name).unwrap();
            assert!(model.is_shipped() && model.network.name == name);
            model.precisions().iter().for_each(|p| assert!(!model.onnx(*p).unwrap().bytes.is_empty()));
            // `auto` judges by what the manifest states
            #[cfg(feature = "fusion")]
            assert_eq!(model.metrics[Model::MACS], model.open(Precision::F32).unwrap().macs() as f64, "{name}");
        }
    }

    #[test]
    fn only_what_is_asked_for_by_name_must_be_there() {
        assert!(matches!(Model::load("small"), Err(ModelError::Missing { .. })));
    }
}
