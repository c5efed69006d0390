//! Frames of a batch: a folder, a pattern of names, or a file of many images; and which guide belongs to which raw frame.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use crate::Error;
use crate::files::{self, ArrayError, ImageStack, Samples};

/// File name extensions of the images that are taken from a folder.
const EXTENSIONS: [&str; 4] = ["npy", "png", "tif", "tiff"];

/// The frames of one camera in their order.
pub(super) struct Sequence {
    path: PathBuf,
    frames: Frames,
}

enum Frames {
    Files(Vec<PathBuf>),
    Stack(Box<ImageStack>),
}

impl Sequence {
    /// The frames that `path` names: all images of a folder, all files that match a pattern with `*`, `?` or `[…]`, or all images of a
    /// file of several. None for a file of one image.
    pub(super) fn find(path: &Path) -> Result<Option<Self>, Error> {
        let text = path.to_string_lossy();
        let mut found = if path.is_dir() {
            let io = |source| ArrayError::Io { path: path.to_path_buf(), source };
            let entries = std::fs::read_dir(path).map_err(io)?.collect::<Result<Vec<_>, _>>().map_err(io)?;
            entries.into_iter().map(|e| e.path()).filter(|file| files::has_extension(file, &EXTENSIONS)).collect()
        } else if !path.exists() && text.contains(['*', '?', '[']) {
            let refused = |e: &dyn std::fmt::Display| Error::Usage(format!("{text}: {e}"));
            let paths = glob::glob(&text).map_err(|e| refused(&e))?.collect::<Result<Vec<_>, _>>();
            paths.map_err(|e| refused(&e))?
        } else {
            let stack = ImageStack::open(path)?.map(Box::new);
            return Ok(stack.map(|stack| Self { path: path.to_path_buf(), frames: Frames::Stack(stack) }));
        };
        found.retain(|file| files::is_visible(file) && file.is_file());
        if found.is_empty() {
            return Err(ArrayError::Unsupported {
                path: path.to_path_buf(),
                what: "number of frames",
                found: "0".to_owned(),
                allowed: "1 or more, NPY, PNG or TIFF",
            }
            .into());
        }
        found.sort_by(|a, b| files::natural_order(a, b));
        Ok(Some(Self { path: path.to_path_buf(), frames: Frames::Files(found) }))
    }

    /// Number of frames.
    pub(super) fn len(&self) -> usize {
        match &self.frames {
            Frames::Files(files) => files.len(),
            Frames::Stack(stack) => stack.count(),
        }
    }

    /// Reads frame `index`.
    pub(super) fn read(&mut self, index: usize) -> Result<Samples, ArrayError> {
        match &mut self.frames {
            Frames::Files(files) => files::read_image(&files[index]),
            Frames::Stack(stack) => stack.read(index),
        }
    }

    /// Name of frame `index` for people.
    pub(super) fn label(&self, index: usize) -> String {
        match &self.frames {
            Frames::Files(files) => files[index].display().to_string(),
            Frames::Stack(_) => format!("{}, frame {index}", self.path.display()),
        }
    }

    /// Name of frame `index` without folder and extension; the frames of a stack are numbered from 0.
    pub(super) fn stem(&self, index: usize) -> String {
        match &self.frames {
            Frames::Files(files) => stem(&files[index]),
            Frames::Stack(_) => format!("{}_{index:06}", stem(&self.path)),
        }
    }

    /// Folders that hold frames.
    pub(super) fn folders(&self) -> impl Iterator<Item = &Path> {
        let files = match &self.frames {
            Frames::Files(files) => files.as_slice(),
            Frames::Stack(_) => std::slice::from_ref(&self.path),
        };
        files.iter().filter_map(|file| file.parent())
    }

    /// Checks that no two frames have one name, as `a.png` and `a.tif` have: their results would replace each other.
    pub(super) fn check_names(&self) -> Result<(), Error> {
        let mut seen = BTreeMap::new();
        for index in 0..self.len() {
            if let Some(other) = seen.insert(self.stem(index), index) {
                let (one, two) = (self.label(other), self.label(index));
                return Err(Error::Usage(format!("{one} and {two} have one name: results are named after it")));
            }
        }
        Ok(())
    }
}

fn stem(file: &Path) -> String {
    let name = file.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    name.strip_suffix(".ome").map(str::to_owned).unwrap_or(name)
}

/// Which guide belongs to which raw frame.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Pairing {
    /// The guide of each raw frame; none where it is missing.
    pub(super) guides: Vec<Option<usize>>,
    /// Guides without a raw frame.
    pub(super) left: Vec<usize>,
}

impl Pairing {
    /// Pairs files by their names, in which leading zeros of numbers do not count; where no two names are the same, by their last number.
    /// The frames of stacks are paired by their position.
    pub(super) fn of(raw: &Sequence, guide: &Sequence) -> Result<Self, Error> {
        let (Frames::Files(raws), Frames::Files(guides)) = (&raw.frames, &guide.frames) else {
            if raw.len() != guide.len() {
                return Err(Error::Usage(format!(
                    "{}: {} frames, {}: {} frames; frames of a stack are paired by their position, so both need the same number",
                    raw.path.display(),
                    raw.len(),
                    guide.path.display(),
                    guide.len()
                )));
            }
            return Ok(Self { guides: (0..raw.len()).map(Some).collect(), left: Vec::new() });
        };
        for key in [name_key, number_key] {
            if let Some((raws, mut guides)) = keys(raws, key).zip(keys(guides, key))
                && raws.keys().any(|name| guides.contains_key(name))
            {
                let mut found = vec![None; raw.len()];
                for (name, index) in raws {
                    found[index] = guides.remove(&name);
                }
                let mut left: Vec<_> = guides.into_values().collect();
                left.sort_unstable();
                return Ok(Self { guides: found, left });
            }
        }
        Err(Error::Usage(format!(
            "{} and {}: no raw frame has the name or the number of a guide; name both alike, as frame_1.npy and frame_1.png",
            raw.path.display(),
            guide.path.display()
        )))
    }
}

/// The frames by key; none if a file has no key or shares one.
fn keys(files: &[PathBuf], key: fn(&str) -> Option<String>) -> Option<BTreeMap<String, usize>> {
    let mut found = BTreeMap::new();
    for (index, file) in files.iter().enumerate() {
        if found.insert(key(&stem(file))?, index).is_some() {
            return None;
        }
    }
    Some(found)
}

/// The name with numbers without leading zeros.
#[expect(clippy::unnecessary_wraps, reason = "one of two kinds of keys")]
fn name_key(stem: &str) -> Option<String> {
    Some(files::name_parts(stem).map(|part| part.to_string()).collect())
}

/// The last number in the name, without leading zeros.
fn number_key(stem: &str) -> Option<String> {
    files::name_parts(stem).filter(files::NamePart::is_number).last().map(|part| part.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sequence(names: &[&str]) -> Sequence {
        Sequence { path: "folder".into(), frames: Frames::Files(names.iter().map(PathBuf::from).collect()) }
    }

    fn paired(raws: &[&str], guides: &[&str]) -> Result<Pairing, Error> {
        Pairing::of(&sequence(raws), &sequence(guides))
    }

    #[test]
    fn files_of_one_name_or_number_are_pairs_and_others_are_named() {
        let guides = |pairing: Pairing| (pairing.guides, pairing.left);
        let found = paired(&["r/a_1.npy", "r/a_2.npy", "r/a_10.npy"], &["g/a_002.png", "g/a_010.png", "g/a_011.png"]);
        assert_eq!(guides(found.unwrap()), (vec![None, Some(0), Some(1)], vec![2]));
        let found = paired(&["r/raw-2026-7.npy", "r/raw-2026-8.npy"], &["g/guide07.png"]);
        assert_eq!(guides(found.unwrap()), (vec![Some(0), None], vec![]));
        // numbers that are not unique tell nothing
        let e = paired(&["r/a1.npy", "r/b1.npy"], &["g/c1.png"]).unwrap_err().to_string();
        assert!(e.contains("no raw frame has the name or the number of a guide"), "{e}");
        // a name outweighs a number
        let found = paired(&["r/b1.npy", "r/a2.npy"], &["g/a2.npy", "g/x1.npy"]);
        assert_eq!(guides(found.unwrap()), (vec![None, Some(0)], vec![1]));
    }

    #[test]
    fn two_files_of_one_name_are_refused() {
        let e = sequence(&["r/a.npy", "r/a.tif"]).check_names().unwrap_err().to_string();
        assert!(e.starts_with("r/a.npy and r/a.tif have one name"), "{e}");
    }
}
