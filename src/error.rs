//! The error type of all commands, and the exit code of each kind of error (sysexits.h).

use std::path::PathBuf;

use crate::bundle::BundleError;
use crate::camera::CameraError;
use crate::camera::sim::{FolderError, SceneError, SimError};
use crate::config::ConfigError;
use crate::evaluate::EvaluateError;
use crate::files::{ArrayError, WriteError};
use crate::live::ServiceError;
use crate::model::{ModelError, OpenError, SelectionError};
use crate::output::OutputError;
use crate::session::SessionError;
use stokescope_core::calibrate::CalibrateError;
use stokescope_core::pipeline::{PlanError, ProcessError};
use stokescope_core::refine;
use stokescope_core::solve;

/// An error that ends a command.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A configuration file (board, bundle, manifest) cannot be used.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// A device bundle cannot be used.
    #[error(transparent)]
    Bundle(#[from] BundleError),
    /// A calibration step failed.
    #[error("{error}{advice}")]
    Calibrate {
        /// Cause.
        error: Box<CalibrateError>,
        /// Remedy in terms of the command line; begins with a semicolon unless empty.
        advice: String,
    },
    /// A pipeline cannot be planned.
    #[error(transparent)]
    Plan(#[from] PlanError),
    /// A frame cannot be processed.
    #[error(transparent)]
    Process(#[from] ProcessError),
    /// An image or array cannot be read.
    #[error(transparent)]
    Array(#[from] ArrayError),
    /// A camera cannot be opened or delivers no frame.
    #[error(transparent)]
    Camera(#[from] CameraError),
    /// A capture cannot be simulated.
    #[error(transparent)]
    Sim(#[from] SimError),
    /// A file cannot be written.
    #[error(transparent)]
    Write(#[from] WriteError),
    /// A result cannot be written.
    #[error(transparent)]
    Output(#[from] OutputError),
    /// An estimate cannot be scored.
    #[error(transparent)]
    Evaluate(#[from] EvaluateError),
    /// A fusion model cannot be opened.
    #[error(transparent)]
    Model(#[from] OpenError),
    /// The live service cannot start.
    #[error(transparent)]
    Service(#[from] ServiceError),
    /// A session cannot be recorded or replayed.
    #[error(transparent)]
    Session(#[from] SessionError),
    /// A result that the readings contradict; it has been written.
    #[error("the result in {} is not credible (residual {residual_over_noise:.1} times the noise): see verdict and suspects in its report.json; --force takes it all the same", out.display())]
    NotCredible {
        /// Residual over the noise of the readings.
        residual_over_noise: f32,
        /// Folder of the result.
        out: std::path::PathBuf,
    },
    /// `doctor` found problems, which it has printed.
    #[error("{problems} problem(s) found")]
    Unhealthy {
        /// Number of problems.
        problems: usize,
        /// Exit code of the first problem.
        code: u8,
    },
    /// Frames of a batch that failed, which are named before.
    #[error("{failed} of {total} frames failed; {} lists them", table.display())]
    Batch {
        /// Frames without a result, and guides without a frame.
        failed: usize,
        /// Frames found.
        total: usize,
        /// The table of reports.
        table: PathBuf,
    },
    /// Standard output cannot be written.
    #[error("standard output: writing failed: {0}")]
    Stdout(std::io::Error),
    /// A defect of the program, or a failure of the system that no other variant covers.
    #[error("{0}")]
    Internal(String),
    /// The command line is not valid.
    #[error("{0}")]
    Usage(String),
}

impl From<SelectionError> for Error {
    fn from(error: SelectionError) -> Self {
        match error {
            SelectionError::Model(e) => e.into(),
            SelectionError::Plan(e) => e.into(),
        }
    }
}

impl Error {
    /// The exit code: 2 usage, 65 bad input data, 66 input not found, 69 unavailable, 70 internal, 73/74 cannot write, 78 configuration.
    pub fn exit_code(&self) -> u8 {
        match self {
            Self::Usage(_) => 2,
            Self::Config(e) | Self::Bundle(BundleError::Config(e)) => config(e),
            // An error in the description is configuration (78), an error in an array file is data (65).
            Self::Bundle(BundleError::Device { file, .. }) if file.extension().is_some_and(|e| e == "toml") => 78,
            Self::Bundle(BundleError::Array(e)) => array(e),
            Self::Bundle(_) | Self::Calibrate { .. } | Self::Batch { .. } => 65,
            Self::Plan(e) | Self::Process(ProcessError::Plan(e)) => plan(e),
            Self::Process(ProcessError::Prepare(_)) => 65,
            Self::Process(ProcessError::Recon(_)) => 70,
            Self::Array(e) | Self::Evaluate(EvaluateError::Array(e)) => array(e),
            Self::Camera(e) => camera(e),
            Self::Sim(e) => sim(e),
            Self::Evaluate(EvaluateError::Folder { .. }) => 66,
            Self::Evaluate(_) | Self::NotCredible { .. } => 65,
            Self::Stdout(_) => 74,
            Self::Write(e) | Self::Output(OutputError::Write(e)) => write(e),
            Self::Output(OutputError::Folder { .. } | OutputError::Occupied { .. }) => 73,
            Self::Output(_) | Self::Internal(_) => 70,
            Self::Model(e) => model(e),
            Self::Service(e) => service(e),
            Self::Session(SessionError::Record { .. }) => 73,
            Self::Session(SessionError::Replay { .. } | SessionError::Incomplete { .. }) => 65,
            Self::Unhealthy { code, .. } => *code,
        }
    }
}

fn array(e: &ArrayError) -> u8 {
    match e {
        ArrayError::Missing(_) | ArrayError::Io { .. } => 66,
        _ => 65,
    }
}

fn camera(e: &CameraError) -> u8 {
    match e {
        CameraError::Sim(e) => sim(e),
        CameraError::Array(e) => array(e),
        CameraError::Source { .. } => 66,
        CameraError::Times { .. }
        | CameraError::Changed { .. }
        | CameraError::Frame { .. }
        | CameraError::Damaged { .. } => 65,
        CameraError::Mode { .. } | CameraError::Stream { .. } | CameraError::Control { .. } => 78,
        CameraError::Backend { .. }
        | CameraError::Unavailable { .. }
        | CameraError::Stuck { .. }
        | CameraError::Lost { .. }
        | CameraError::Hung { .. }
        | CameraError::Timeout { .. }
        | CameraError::Waiting { .. }
        | CameraError::Ended { .. } => 69,
    }
}

fn sim(e: &SimError) -> u8 {
    match e {
        SimError::Range { .. } | SimError::Setting { .. } | SimError::Imperfection { .. } => 2,
        SimError::Scene(SceneError::Unknown { .. }) => 66,
        SimError::Scene(SceneError::Unreadable(e)) => match e.downcast_ref() {
            Some(FolderError::Array(e)) => array(e),
            _ => 65,
        },
        SimError::Scene(SceneError::Dark { .. } | SceneError::Planes { .. }) => 65,
    }
}

fn service(e: &ServiceError) -> u8 {
    match e {
        ServiceError::Token { .. } => 2,
        ServiceError::Bundle { .. } | ServiceError::Levels { .. } => 65,
        ServiceError::Listen { .. } => 69,
        ServiceError::Thread { .. } => 70,
        ServiceError::NotSimulated { .. } => 78,
    }
}

fn write(e: &WriteError) -> u8 {
    match e {
        WriteError::Create { .. } => 73,
        WriteError::Io { .. } => 74,
        WriteError::Shape { .. } => 70,
    }
}

fn model(e: &OpenError) -> u8 {
    match e {
        OpenError::Model(ModelError::Manifest(e)) => config(e),
        OpenError::Model(ModelError::Missing { .. } | ModelError::Io { .. }) => 66,
        OpenError::Model(ModelError::Precision { .. }) => 2,
        OpenError::Model(_) => 65,
        OpenError::Network(e) => network(e),
    }
}

fn network(e: &refine::PlanError) -> u8 {
    match e {
        refine::PlanError::NoRuntime { .. } => 69,
        _ => 65,
    }
}

fn config(e: &ConfigError) -> u8 {
    match e {
        ConfigError::Missing(_) => 66,
        _ => 78,
    }
}

fn plan(e: &PlanError) -> u8 {
    match e {
        PlanError::NoGuide | PlanError::NoIterations | PlanError::Recon(solve::PlanError::NoMask { .. }) => 2,
        PlanError::Fusion(e) => network(e),
        PlanError::Length(_) | PlanError::Memory { .. } => 78,
    }
}
