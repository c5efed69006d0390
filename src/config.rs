//! Reading of TOML configuration files with errors that name file, line and key.
//!
//! Unknown keys are errors that name the nearest valid key. Each module validates its own tables with a [`Checker`], which
//! reports all values out of range at once.
//!
//! ```
//! # #[derive(Debug, serde::Deserialize)] #[serde(deny_unknown_fields)] struct Raw { width: usize }
//! let e = stokescope::config::parse::<Raw>("a.toml".as_ref(), "widht = 3").unwrap_err().to_string();
//! assert!(e.contains("a.toml:1:1") && e.contains("did you mean `width`"), "{e}");
//! ```

use std::io::Read;
use std::path::{Path, PathBuf};

use serde::de::DeserializeOwned;
pub use toml::Spanned;

/// Largest configuration file that is read, in bytes; the shipped ones are below 4 KiB.
pub const MAX_BYTES: u64 = 1 << 20;

/// A configuration file that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file does not exist.
    #[error("{}: no such file", .0.display())]
    Missing(PathBuf),
    /// The file exists but cannot be read.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// Reason.
        source: std::io::Error,
    },
    /// The file is larger than [`MAX_BYTES`].
    #[error("{}: {found} bytes, a configuration has at most {MAX_BYTES}", path.display())]
    TooLarge {
        /// The file.
        path: PathBuf,
        /// Size of the file in bytes.
        found: u64,
    },
    /// The file is not UTF-8 text.
    #[error("{}: byte {at} is not UTF-8 text", path.display())]
    NotUtf8 {
        /// The file.
        path: PathBuf,
        /// Offset of the first invalid byte.
        at: usize,
    },
    /// The text is not TOML, has an unknown key or a value of the wrong type.
    #[error("{}:{line}:{column}: {message}{}", path.display(), hint.as_ref().map(|h| format!("; did you mean `{h}`?")).unwrap_or_default())]
    Syntax {
        /// The file.
        path: PathBuf,
        /// Line, from 1.
        line: usize,
        /// Column, from 1.
        column: usize,
        /// Message of the parser, with the keys it accepts.
        message: String,
        /// The nearest valid key.
        hint: Option<String>,
    },
    /// All values that are out of range.
    #[error("{}", .0.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n"))]
    Range(Vec<Violation>),
}

/// A value that is not allowed.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("{}{}: {key} = {found}, allowed: {allowed}", path.display(), line.map(|l| format!(":{l}")).unwrap_or_default())]
pub struct Violation {
    /// The file.
    pub path: PathBuf,
    /// Line of the value, from 1.
    pub line: Option<usize>,
    /// Dotted key.
    pub key: String,
    /// Value found.
    pub found: String,
    /// Allowed values.
    pub allowed: String,
}

/// Collects the violations of one file, so that a user sees all of them at once.
#[derive(Debug)]
pub struct Checker<'a> {
    path: &'a Path,
    text: &'a str,
    violations: Vec<Violation>,
}

impl<'a> Checker<'a> {
    /// Makes a checker for the file at `path` with content `text`.
    pub fn new(path: &'a Path, text: &'a str) -> Self {
        Self { path, text, violations: Vec::new() }
    }

    /// Reports a violation of `key` unless `ok`; returns the value.
    pub fn check<T: Copy + std::fmt::Debug>(&mut self, key: &str, value: &Spanned<T>, ok: bool, allowed: &str) -> T {
        if !ok {
            self.reject(key, Some(value.span().start), format!("{:?}", value.get_ref()), allowed);
        }
        *value.get_ref()
    }

    /// Reports a violation at byte `at` of the text, or without a line.
    pub fn reject(&mut self, key: &str, at: Option<usize>, found: String, allowed: &str) {
        self.violations.push(Violation {
            path: self.path.to_path_buf(),
            line: at.map(|at| position(self.text, at).0),
            key: key.to_owned(),
            found,
            allowed: allowed.to_owned(),
        });
    }

    /// Ends the check.
    ///
    /// # Errors
    /// [`ConfigError::Range`] with all violations reported.
    pub fn finish(self) -> Result<(), ConfigError> {
        if self.violations.is_empty() { Ok(()) } else { Err(ConfigError::Range(self.violations)) }
    }
}

/// Reads a configuration file as text.
///
/// # Errors
/// Missing, unreadable, too large or not UTF-8.
pub fn read(path: &Path) -> Result<String, ConfigError> {
    let io = |source: std::io::Error| match source.kind() {
        std::io::ErrorKind::NotFound => ConfigError::Missing(path.to_path_buf()),
        _ => ConfigError::Io { path: path.to_path_buf(), source },
    };
    let meta = std::fs::metadata(path).map_err(io)?;
    if !meta.is_file() {
        return Err(io(std::io::Error::other("a folder, device or pipe, allowed: a regular file")));
    }
    let mut bytes = Vec::new();
    // the length of a file may change while it is read
    let file = std::fs::File::open(path).map_err(io)?;
    file.take(MAX_BYTES + 1).read_to_end(&mut bytes).map_err(io)?;
    if bytes.len() as u64 > MAX_BYTES {
        return Err(ConfigError::TooLarge { path: path.to_path_buf(), found: meta.len().max(bytes.len() as u64) });
    }
    String::from_utf8(bytes)
        .map_err(|e| ConfigError::NotUtf8 { path: path.to_path_buf(), at: e.utf8_error().valid_up_to() })
}

/// Parses `text`, the content of `path`.
///
/// # Errors
/// [`ConfigError::Syntax`] with line, column and the nearest valid key.
pub fn parse<T: DeserializeOwned>(path: &Path, text: &str) -> Result<T, ConfigError> {
    toml::from_str(text).map_err(|e| {
        let (line, column) = position(text, e.span().map_or(0, |s| s.start));
        let message = e.message().to_owned();
        ConfigError::Syntax { path: path.to_path_buf(), line, column, hint: nearest_key(&message), message }
    })
}

/// Line and column of byte `at`, both from 1.
fn position(text: &str, at: usize) -> (usize, usize) {
    let head = &text.as_bytes()[..at.min(text.len())];
    let line = head.iter().filter(|&&b| b == b'\n').count() + 1;
    let column = head.len() - head.iter().rposition(|&b| b == b'\n').map_or(0, |p| p + 1) + 1;
    (line, column)
}

/// The valid key nearest to the unknown one. serde's message names the unknown key first and then the valid keys, all in backquotes.
fn nearest_key(message: &str) -> Option<String> {
    let mut quoted = message.split('`').skip(1).step_by(2);
    let typed = quoted.next().filter(|_| message.starts_with("unknown "))?;
    quoted
        .map(|key| (strsim::damerau_levenshtein(typed, key), key))
        .min()
        .filter(|&(distance, key)| distance <= 1 + key.len() / 3)
        .map(|(_, key)| key.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, serde::Deserialize)]
    #[serde(deny_unknown_fields)]
    struct Raw {
        width: Spanned<i64>,
        height: Spanned<i64>,
    }

    #[test]
    fn all_range_errors_come_at_once_with_their_lines() {
        let (path, text) = (Path::new("b.toml"), "width = 0\n\nheight = -4\n");
        let raw: Raw = parse(path, text).unwrap();
        let mut c = Checker::new(path, text);
        c.check("width", &raw.width, *raw.width.get_ref() > 0, "1 to 4096");
        c.check("height", &raw.height, *raw.height.get_ref() > 0, "1 to 4096");
        let e = c.finish().unwrap_err().to_string();
        assert_eq!(e, "b.toml:1: width = 0, allowed: 1 to 4096\nb.toml:3: height = -4, allowed: 1 to 4096");
    }

    #[test]
    fn a_wrong_type_names_line_and_column() {
        let e = parse::<Raw>(Path::new("b.toml"), "width = 1\nheight = \"x\"").unwrap_err().to_string();
        assert!(e.starts_with("b.toml:2:10: invalid type"), "{e}");
    }

    #[test]
    fn text_that_is_not_utf8_names_the_byte() {
        let f = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(f.path(), b"a = \xff").unwrap();
        assert!(read(f.path()).unwrap_err().to_string().ends_with("byte 4 is not UTF-8 text"));
    }

    #[cfg(unix)]
    #[test]
    fn a_device_or_folder_is_refused_without_being_read() {
        let dir = tempfile::tempdir().unwrap();
        let link = dir.path().join("board.toml");
        std::os::unix::fs::symlink("/dev/zero", &link).unwrap();
        for path in [link.as_path(), Path::new("/dev/zero"), dir.path()] {
            let e = read(path).unwrap_err().to_string();
            assert!(e.ends_with("a folder, device or pipe, allowed: a regular file"), "{e}");
        }
    }
}
