//! L1: fusion models. A fusion model is a small network that refines the physics of stage I; this release ships none, so
//! reconstruction is physics only, and this room says so wherever a model is asked for.
//!
//! Allocation: the text of errors. Imports: nothing of this crate.
//!
//! ```
//! use stokescope::model::Choice;
//! assert!(Choice::Auto.resolve().is_ok());
//! assert!(Choice::from("small".to_owned()).resolve().unwrap_err().to_string().contains("no models are shipped"));
//! ```

use std::path::{Path, PathBuf};

/// What a list of models says while there is none.
pub const NONE_SHIPPED: &str = "no models are shipped; reconstruction is physics only";

/// Which fusion model to use.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum Choice {
    /// The shipped model that fits, or physics only when there is none.
    #[default]
    Auto,
    /// Physics only.
    Off,
    /// A shipped model's name, or a file.
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

/// A model that was asked for and cannot be had.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ModelError {
    /// Neither a shipped model nor a file.
    #[error("fusion model {name}: neither a shipped model nor a file ({NONE_SHIPPED}); allowed: auto, off")]
    Missing {
        /// What was asked for.
        name: String,
    },
    /// A file, but nothing that could run it.
    #[error("fusion model {}: this release cannot run model files ({NONE_SHIPPED}); allowed: auto, off", file.display())]
    NoRuntime {
        /// The file.
        file: PathBuf,
    },
}

impl Choice {
    /// Whether reconstruction can go on, physics only.
    ///
    /// # Errors
    /// [`ModelError`] for any model that is asked for by name or file.
    pub fn resolve(&self) -> Result<(), ModelError> {
        match self {
            Self::Auto | Self::Off => Ok(()),
            Self::Named(name) if Path::new(name).is_file() => Err(ModelError::NoRuntime { file: name.into() }),
            Self::Named(name) => Err(ModelError::Missing { name: name.clone() }),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_model_asked_for_by_name_is_an_error() {
        let resolve = |text: &str| Choice::from(text.to_owned()).resolve();
        assert_eq!((resolve("auto"), resolve("off")), (Ok(()), Ok(())));
        assert_eq!(resolve("small"), Err(ModelError::Missing { name: "small".into() }));
        let file = tempfile::NamedTempFile::new().unwrap();
        let e = resolve(&file.path().display().to_string());
        assert!(matches!(e, Err(ModelError::NoRuntime { .. })));
    }
}
