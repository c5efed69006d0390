//! A manifest as it is typed.

use std::collections::BTreeMap;
use std::path::Path;

use serde::Deserialize;

use stokescope_core::refine;
use stokescope_core::refine::model::{Feature, Input, Kind, Output, Plane, RESIDUAL};

use super::{File, Model, Trained};
use crate::config::{Checker, Spanned};

/// What a mixing network is made for: planes, and factors beside those of the vocabulary.
const MIXED: [(Plane, f32); 6] = [
    (Plane::S0, 1.0),
    (Plane::S1, 1.0),
    (Plane::S2, 1.0),
    (Plane::R0, RESIDUAL),
    (Plane::R1, RESIDUAL),
    (Plane::R2, RESIDUAL),
];
/// Side of the coarsest cells that a mixing network looks at.
const COARSEST: i64 = 16;
/// Most planes a network may be given: each image of the vocabulary twice, as itself and in another scale.
const MAX_PLANES: usize = 12;

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ManifestFile {
    version: Spanned<i64>,
    name: String,
    description: String,
    licence: String,
    #[serde(default)]
    kind: Kind,
    trained: TrainedTable,
    #[serde(default)]
    metrics: BTreeMap<String, f64>,
    files: Files,
    input: InputTable,
    output: Option<OutputTable>,
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
    #[serde(default = "one")]
    multiple: Spanned<i64>,
    planes: Option<Spanned<Vec<PlaneTable>>>,
}

fn one() -> Spanned<i64> {
    Spanned::new(0..0, 1)
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct PlaneTable {
    plane: Plane,
    scale: Option<Spanned<f64>>,
    offset: Option<Spanned<f64>>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct OutputTable {
    planes: Spanned<Vec<Plane>>,
    scale: Spanned<f64>,
}

impl ManifestFile {
    pub(super) fn validate(self, path: &Path, check: &mut Checker<'_>) -> Model {
        check.check("version", &self.version, *self.version.get_ref() == 1, "1");
        let f32 = self.files.f32.validate("files.f32", check);
        let int8 = self.files.int8.map(|table| table.validate("files.int8", check));
        let InputTable { tile, halo, multiple, planes } = self.input;
        let grid = check.check("input.multiple", &multiple, (1..=64).contains(multiple.get_ref()), "1 to 64").max(1);
        let fits = (8..=1024).contains(tile.get_ref()) && tile.get_ref() % grid == 0;
        let side = check.check("input.tile", &tile, fits, "8 to 1024, a multiple of input.multiple");
        let fits = (0..=side / 3).contains(halo.get_ref());
        let halo = check.check("input.halo", &halo, fits, "0 to a third of input.tile");
        let (features, output) = match self.kind {
            Kind::Adds => (taken(planes, check), given(self.output, check)),
            Kind::Mixes => {
                let aligned = grid % COARSEST == 0;
                check.check("input.multiple", &multiple, aligned, "a multiple of 16 with kind = \"mixes\"");
                if let Some(planes) = planes {
                    let at = Some(planes.span().start);
                    check.reject("input.planes", at, "planes".to_owned(), "none with kind = \"mixes\"");
                }
                if let Some(output) = self.output {
                    let at = Some(output.scale.span().start);
                    check.reject("output", at, "a table".to_owned(), "none with kind = \"mixes\"");
                }
                let features = MIXED.map(|(plane, scale)| Feature { plane, scale, offset: 0.0 }).to_vec();
                (features, Output { planes: vec![Plane::S1, Plane::S2], scale: 1.0 })
            }
        };
        let iterations = &self.trained.iterations;
        let fits = (1..=10_000).contains(iterations.get_ref());
        let iterations = check.check("trained.iterations", iterations, fits, "1 to 10000") as usize;
        Model {
            network: refine::Model {
                name: self.name,
                kind: self.kind,
                input: Input { tile: side as usize, halo: halo as usize, multiple: grid as usize, features },
                output,
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

/// The planes of `input.planes`.
fn taken(planes: Option<Spanned<Vec<PlaneTable>>>, check: &mut Checker<'_>) -> Vec<Feature> {
    let Some(planes) = planes else {
        check.reject("input.planes", None, "nothing".to_owned(), &format!("1 to {MAX_PLANES} planes"));
        return Vec::new();
    };
    let (at, count) = (planes.span().start, planes.get_ref().len());
    if !(1..=MAX_PLANES).contains(&count) {
        check.reject("input.planes", Some(at), format!("{count} planes"), &format!("1 to {MAX_PLANES}"));
    }
    let mut number = |key: &str, value: Option<Spanned<f64>>, default: f32| {
        value.map_or(default, |v| check.check(key, &v, v.get_ref().is_finite(), "a finite number") as f32)
    };
    let features = planes.into_inner().into_iter().map(|p| Feature {
        plane: p.plane,
        scale: number("input.planes.scale", p.scale, 1.0),
        offset: number("input.planes.offset", p.offset, 0.0),
    });
    features.collect()
}

/// The table `output`.
fn given(output: Option<OutputTable>, check: &mut Checker<'_>) -> Output {
    const ALLOWED: [&[Plane]; 2] = [&[Plane::S1, Plane::S2], &[Plane::S0, Plane::S1, Plane::S2]];
    let Some(OutputTable { planes, scale }) = output else {
        check.reject("output", None, "nothing".to_owned(), "a table with planes and scale");
        return Output { planes: Vec::new(), scale: 1.0 };
    };
    if !ALLOWED.contains(&planes.get_ref().as_slice()) {
        let found = format!("{:?}", planes.get_ref());
        check.reject("output.planes", Some(planes.span().start), found, "[s1, s2] or [s0, s1, s2]");
    }
    let fits = *scale.get_ref() > 0.0 && scale.get_ref().is_finite();
    let scale = check.check("output.scale", &scale, fits, "above 0") as f32;
    Output { planes: planes.into_inner(), scale }
}

impl FileTable {
    fn validate(self, key: &str, check: &mut Checker<'_>) -> File {
        let Self { file, sha256 } = self;
        let name = file.get_ref();
        // Beside the manifest and nowhere else: a manifest may come from anyone.
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
