//! Settings that hold for all frames, and the effort for one frame.

use std::num::NonZeroUsize;

use crate::optics::FftBackend;
use crate::refine;
use crate::solve::Method;

/// Choices of a user that hold for all frames.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Whether frames come with a guide.
    pub guided: bool,
    /// The method; none takes `guided` with a guide and `stokes` without.
    pub method: Option<Method>,
    /// Iterations; none takes the method's usual number.
    pub iterations: Option<usize>,
    /// Whether the guide of every frame is aligned with it. If not, it is taken where the bundle says that it lies.
    pub register: bool,
    /// Whether the size of the PSF is refitted when the readings show that it has changed since the calibration. Needs a guide.
    pub refit_psf: bool,
    /// The FFT library.
    pub fft: FftBackend,
    /// Threads of the solver.
    pub threads: usize,
    /// Bytes all stages together may hold.
    pub memory_limit_bytes: usize,
    /// The network of stage II; none is physics only.
    pub fusion: Option<refine::Network>,
    /// Whether frames are those of a video. Each may then start from the result of the last one, and its guide is tracked rather than
    /// searched for. If not, the result of a frame does not depend on the frames before it.
    pub video: bool,
    /// Whether results hold the intensities behind polarizers in addition to the Stokes images.
    pub angles: bool,
}

/// Effort for one frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Budget {
    /// Iterations of the solver; none takes those of the settings.
    pub iterations: Option<NonZeroUsize>,
    /// Whether stage II runs, where there is a network.
    pub refine: bool,
}

impl Default for Budget {
    /// The iterations of the settings, and stage II.
    fn default() -> Self {
        Self { iterations: None, refine: true }
    }
}

impl Default for Settings {
    /// The usual method beside a guide with its usual iterations, on all cores, guides aligned, the PSF's size refitted, no network, single frames.
    fn default() -> Self {
        Self {
            guided: true,
            method: None,
            iterations: None,
            register: true,
            refit_psf: true,
            fft: FftBackend::default(),
            threads: std::thread::available_parallelism().map_or(1, usize::from),
            memory_limit_bytes: usize::MAX,
            fusion: None,
            video: false,
            angles: true,
        }
    }
}
