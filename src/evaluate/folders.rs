use std::collections::BTreeSet;
use std::ffi::OsString;
use std::path::{Path, PathBuf};

use super::{EvaluateError, Scores, not_angles, score};
use crate::files::{Array, read_npy};
use stokescope_core::polarization::Angle;

/// Files of an estimate and its truth.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Pair {
    /// File name of the estimate.
    pub name: String,
    /// File of the estimate.
    pub estimate: PathBuf,
    /// File of the truth.
    pub truth: PathBuf,
}

/// Pairs of files found under two paths.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Pairs {
    /// Pairs in order of their names; at least one.
    pub pairs: Vec<Pair>,
    /// NPY files that exist in one of the folders only.
    pub unpaired: Vec<PathBuf>,
}

/// Pairs two NPY files, or the NPY files of equal names in two folders.
///
/// # Errors
/// [`EvaluateError`]: one path is a folder and the other is not, a folder cannot be listed, or no name exists in both.
pub fn pairs(estimate: &Path, truth: &Path) -> Result<Pairs, EvaluateError> {
    let owned = || (estimate.to_path_buf(), truth.to_path_buf());
    match (estimate.is_dir(), truth.is_dir()) {
        (false, false) => {
            let (estimate, truth) = owned();
            let name = estimate.file_name().unwrap_or(estimate.as_os_str()).to_string_lossy().into_owned();
            return Ok(Pairs { pairs: vec![Pair { name, estimate, truth }], unpaired: Vec::new() });
        }
        (true, true) => {}
        _ => {
            let (estimate, truth) = owned();
            return Err(EvaluateError::Mixed { estimate, truth });
        }
    }
    let (estimates, truths) = (arrays(estimate)?, arrays(truth)?);
    let of = |name: &OsString| Pair {
        name: name.to_string_lossy().into_owned(),
        estimate: estimate.join(name),
        truth: truth.join(name),
    };
    let pairs: Vec<Pair> = estimates.intersection(&truths).map(of).collect();
    if pairs.is_empty() {
        let (estimate, truth) = owned();
        return Err(EvaluateError::NoPairs { estimate, truth });
    }
    let only = |these: &BTreeSet<OsString>, others: &BTreeSet<OsString>, dir: &Path| {
        these.difference(others).map(|name| dir.join(name)).collect::<Vec<_>>()
    };
    let unpaired = [only(&estimates, &truths, estimate), only(&truths, &estimates, truth)].concat();
    Ok(Pairs { pairs, unpaired })
}

/// Lists the names of the NPY files in a folder.
fn arrays(dir: &Path) -> Result<BTreeSet<OsString>, EvaluateError> {
    let failed = |source| EvaluateError::Folder { path: dir.to_path_buf(), source };
    let mut names = BTreeSet::new();
    for entry in std::fs::read_dir(dir).map_err(failed)? {
        let name = entry.map_err(failed)?.file_name();
        if Path::new(&name).extension().is_some_and(|e| e.eq_ignore_ascii_case("npy")) {
            names.insert(name);
        }
    }
    Ok(names)
}

/// Scores one NPY file against another, as [`score_images`] does.
///
/// # Errors
/// [`EvaluateError`]: a file cannot be read or does not contain angle images, or an error of [`score`].
pub fn score_files(pair: &Pair) -> Result<Scores, EvaluateError> {
    let judged = score_images(&read_npy(&pair.estimate)?, &read_npy(&pair.truth)?);
    judged.map_err(|source| EvaluateError::Refused { estimate: pair.estimate.clone(), source: Box::new(source) })
}

/// Scores angle images. Three are those at 0°, 45°, 90°; a fourth is the one at 135°.
///
/// # Errors
/// As [`score`]; [`EvaluateError::NotAngles`] for another number of images.
pub fn score_images(estimate: &Array, truth: &Array) -> Result<Scores, EvaluateError> {
    match truth.shape[..] {
        [3, _, _] | [_, 3, _, _] => score(estimate, truth, &Angle::three()),
        [4, _, _] | [_, 4, _, _] => score(estimate, truth, &Angle::four()),
        _ => Err(not_angles(truth, "3 or 4".to_owned())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::files::write_npy;

    #[test]
    fn folders_are_paired_by_name() {
        let dir = tempfile::tempdir().unwrap();
        let (a, b) = (dir.path().join("a"), dir.path().join("b"));
        let values = vec![0.5; 3 * 12 * 12];
        for path in ["a/one.npy", "a/two.npy", "b/two.npy", "b/three.npy"].map(|p| dir.path().join(p)) {
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            write_npy(&path, &[3, 12, 12], &values).unwrap();
        }
        std::fs::write(a.join("notes.txt"), "").unwrap();
        let found = pairs(&a, &b).unwrap();
        assert_eq!(found.pairs.iter().map(|p| p.name.as_str()).collect::<Vec<_>>(), ["two.npy"]);
        assert_eq!(found.unpaired, [a.join("one.npy"), b.join("three.npy")]);
        assert_eq!(score_files(&found.pairs[0]).unwrap().dolp_mae, 0.0);
        assert!(matches!(pairs(&a, &b.join("two.npy")), Err(EvaluateError::Mixed { .. })));
        std::fs::remove_file(b.join("two.npy")).unwrap();
        assert!(matches!(pairs(&a, &b), Err(EvaluateError::NoPairs { .. })));
    }

    #[test]
    fn a_missing_file_and_a_wrong_shape_are_named() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.npy");
        write_npy(&path, &[2, 12, 12], &[0.0; 288]).unwrap();
        let of = |estimate: &Path| score_files(&pairs(estimate, &path).unwrap().pairs[0]).unwrap_err().to_string();
        assert!(of(&dir.path().join("none.npy")).ends_with("none.npy: no such file"));
        assert!(of(&path).contains("a.npy: shape [2, 12, 12], allowed: [3 or 4, H, W]"));
    }
}
