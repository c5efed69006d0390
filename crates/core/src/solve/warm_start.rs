//! How a frame of a video starts from the one before.

use std::fmt;

/// Start of a frame.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum WarmStart {
    /// From nothing: the first frame, one of another scene, or one that is not of a video.
    #[default]
    Cold,
    /// From the last frame's result. The scene has changed.
    Moving,
    /// From the last frame's result, with readings and guide averaged. Nothing but noise has changed.
    Still,
}

/// Most iterations of a moving and of a still frame.
const MOVING: usize = 6;
const STILL: usize = 2;

impl WarmStart {
    /// Iterations of a frame where a cold one is given `cold`.
    pub fn iterations(self, cold: usize) -> usize {
        match self {
            Self::Cold => cold,
            Self::Moving => cold.min(MOVING),
            Self::Still => cold.min(STILL),
        }
    }
}

impl fmt::Display for WarmStart {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Cold => "cold",
            Self::Moving => "moving",
            Self::Still => "still",
        })
    }
}
