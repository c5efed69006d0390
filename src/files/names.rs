//! Names of files: which are images, and in which order people count them.

use std::cmp::Ordering;
use std::path::Path;

/// Whether a file is meant to be seen: its name does not begin with a dot, as those of macOS's companions (`._name`) do.
pub fn is_visible(path: &Path) -> bool {
    path.file_name().is_some_and(|name| !name.to_string_lossy().starts_with('.'))
}

/// Whether the file name extension is one of `allowed`, which are in lower case.
pub fn has_extension(path: &Path, allowed: &[&str]) -> bool {
    let extension = path.extension().and_then(|e| e.to_str()).map(str::to_lowercase);
    extension.is_some_and(|e| allowed.contains(&e.as_str()))
}

/// Order of paths in which runs of digits count as numbers: `frame_9` before `frame_10`.
///
/// ```
/// use stokescope::files::natural_order;
/// let mut names = ["f10.npy", "f9.npy", "f010.npy", "a.npy"].map(std::path::PathBuf::from);
/// names.sort_by(|a, b| natural_order(a, b));
/// assert_eq!(names.map(|name| name.display().to_string()), ["a.npy", "f9.npy", "f010.npy", "f10.npy"]);
/// ```
pub fn natural_order(a: &Path, b: &Path) -> Ordering {
    let (text, other) = (a.to_string_lossy(), b.to_string_lossy());
    name_parts(&text).cmp(name_parts(&other)).then_with(|| text.cmp(&other))
}

/// A run of digits or another character. Numbers stand before text; they compare by their length without leading zeros, then as text.
#[derive(Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum NamePart<'a> {
    /// Number of digits without leading zeros, and these digits.
    Number(usize, &'a str),
    /// Any other character.
    Other(char),
}

impl NamePart<'_> {
    /// Whether this is a number.
    pub fn is_number(&self) -> bool {
        matches!(self, Self::Number(..))
    }
}

impl std::fmt::Display for NamePart<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Number(0, _) => f.write_str("0"),
            Self::Number(_, digits) => f.write_str(digits),
            Self::Other(character) => write!(f, "{character}"),
        }
    }
}

/// Splits a name into numbers and other characters.
pub fn name_parts(text: &str) -> impl Iterator<Item = NamePart<'_>> {
    let mut rest = text;
    std::iter::from_fn(move || {
        let first = rest.chars().next()?;
        if !first.is_ascii_digit() {
            rest = &rest[first.len_utf8()..];
            return Some(NamePart::Other(first));
        }
        let (digits, after) = rest.split_at(rest.find(|c: char| !c.is_ascii_digit()).unwrap_or(rest.len()));
        rest = after;
        let digits = digits.trim_start_matches('0');
        Some(NamePart::Number(digits.len(), digits))
    })
}
