//! L4: the one error type of the program, and the exit code each kind of failure ends with (sysexits.h).

use crate::array::{ArrayError, WriteError};
use crate::config::ConfigError;

/// Whatever ends a command.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A configuration file (board, bundle, manifest) cannot be used.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// An image or array cannot be read.
    #[error(transparent)]
    Array(#[from] ArrayError),
    /// A file cannot be written.
    #[error(transparent)]
    Write(#[from] WriteError),
    /// The command line asks for something impossible.
    #[error("{0}")]
    Usage(String),
}

impl Error {
    /// The exit code: 2 usage, 65 bad input data, 66 input not found, 69 unavailable, 70 internal, 73/74 cannot write, 78 configuration.
    pub fn exit_code(&self) -> u8 {
        match self {
            Self::Usage(_) => 2,
            Self::Config(ConfigError::Missing(_)) => 66,
            Self::Config(_) => 78,
            Self::Array(e) => array(e),
            Self::Write(e) => write(e),
        }
    }
}

fn array(e: &ArrayError) -> u8 {
    match e {
        ArrayError::Missing(_) | ArrayError::Io { .. } => 66,
        _ => 65,
    }
}

fn write(e: &WriteError) -> u8 {
    match e {
        WriteError::Create { .. } => 73,
        WriteError::Io { .. } => 74,
        WriteError::Shape { .. } => 70,
    }
}
