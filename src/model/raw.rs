//! A manifest as it stands in its file, and its validation.

use std::collections::BTreeMap;
use std::path::Path;

use serde::Deserialize;

use stokescope_core::refine;
use stokescope_core::refine::model::Tiling;

use super::{File, Model, Trained};
use crate::config::{Checker, Spanned};

/// Side of the coarsest cells from which candidates are made. A network's grid is a multiple of it.
const COARSEST: i64 = 16;

/// The kind of a network, which older versions distinguished.
#[derive(Debug, Default, Deserialize)]
#[serde(rename_all = "lowercase")]
enum Kind {
    #[default]
    Mixes,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ManifestFile {
    version: Spanned<i64>,
    name: String,
    description: String,
    licence: String,
    #[serde(default, rename = "kind")]
    _kind: Kind,
    trained: TrainedTable,
    #[serde(default)]
    metrics: BTreeMap<String, f64>,
    files: Files,
    input: InputTable,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct TrainedTable {
    date: String,
    data: String,
    iterations: Spanned<i64>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Files {
    f32: FileTable,
    int8: Option<FileTable>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct FileTable {
    file: Spanned<String>,
    sha256: Spanned<String>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct InputTable {
    tile: Spanned<i64>,
    halo: Spanned<i64>,
    #[serde(default = "coarsest")]
    multiple: Spanned<i64>,
}

fn coarsest() -> Spanned<i64> {
    Spanned::new(0..0, COARSEST)
}

impl ManifestFile {
    pub(super) fn validate(self, path: &Path, check: &mut Checker<'_>) -> Model {
        check.check("version", &self.version, *self.version.get_ref() == 1, "1");
        let f32 = self.files.f32.validate("files.f32", check);
        let int8 = self.files.int8.map(|table| table.validate("files.int8", check));
        let InputTable { tile, halo, multiple } = self.input;
        let fits = (COARSEST..=64).contains(multiple.get_ref()) && multiple.get_ref() % COARSEST == 0;
        let multiple = check.check("input.multiple", &multiple, fits, "16, 32, 48 or 64").max(1);
        let fits = (COARSEST..=1024).contains(tile.get_ref()) && tile.get_ref() % multiple == 0;
        let side = check.check("input.tile", &tile, fits, "16 to 1024, a multiple of input.multiple");
        let most = Tiling::largest_halo(side.max(0) as usize, multiple as usize);
        let fits = (0..=most as i64).contains(halo.get_ref());
        let halo =
            check.check("input.halo", &halo, fits, &format!("0 to {most} with these input.tile and input.multiple"));
        let iterations = &self.trained.iterations;
        let fits = (1..=10_000).contains(iterations.get_ref());
        let iterations = check.check("trained.iterations", iterations, fits, "1 to 10000") as usize;
        Model {
            network: refine::Model {
                name: self.name,
                tiling: Tiling { tile: side as usize, halo: halo as usize, multiple: multiple as usize },
            },
            description: self.description,
            licence: self.licence,
            trained: Trained { date: self.trained.date, data: self.trained.data, iterations },
            metrics: self.metrics,
            manifest: path.to_path_buf(),
            f32,
            int8,
            shipped: false,
        }
    }
}

impl FileTable {
    fn validate(self, key: &str, check: &mut Checker<'_>) -> File {
        let Self { file, sha256 } = self;
        let name = file.get_ref();
        // A manifest may come from anyone, so it names no file outside its own folder.
        if name.is_empty() || Path::new(name).file_name().is_none_or(|n| n != name.as_str()) {
            check.reject(
                &format!("{key}.file"),
                Some(file.span().start),
                format!("{name:?}"),
                "the name of a file beside the manifest",
            );
        }
        let digest = sha256.get_ref();
        if digest.len() != 64 || !digest.bytes().all(|b| b.is_ascii_digit() || (b'a'..=b'f').contains(&b)) {
            check.reject(
                &format!("{key}.sha256"),
                Some(sha256.span().start),
                format!("{digest:?}"),
                "64 hexadecimal digits in lower case",
            );
        }
        File { name: file.into_inner(), sha256: sha256.into_inner() }
    }
}
