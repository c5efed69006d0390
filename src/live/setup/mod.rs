//! Parts of the setup of a device that has no bundle yet: its cameras as they are, figures of their frames, calibration steps, and the
//! folder in which the bundle grows. `bring_up.rs` joins them with the HTTP server.

mod calibration;
mod camera;
mod figures;
mod folder;
mod lamps;

pub(super) use calibration::{Calibration, Description, Take};
pub(super) use camera::{Asked, SetupCamera};
pub(super) use figures::{CLASSES, Figures};
pub(super) use folder::Workspace;
