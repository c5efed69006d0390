//! Simulated cameras: frames of the simulator in the format that a sensor would give them.

mod scene_folder;

use std::time::Duration;

pub use scene_folder::FolderError;
pub use stokescope_simulator::{
    Capture, Flaws, IMPERFECTIONS, Imperfections, Knowledge, Pose, SCENES, SceneError, SimError, SimSpec, Simulator,
    TARGETS,
};

use crate::camera::{Camera, CameraError, CameraInfo, Request, Role, clock::Trigger, interleave};
use stokescope_core::frame::{Frame, Metadata, PixelFormat, Samples};
use stokescope_core::image::Stack;

/// Makes the simulator of `spec`; its scene is a built-in one or a folder of measured images.
///
/// # Errors
/// [`SimError`] for values out of range and scenes that cannot be read.
pub fn simulator(spec: SimSpec) -> Result<Simulator, SimError> {
    Simulator::with_reader(spec, &scene_folder::read)
}

/// Simulated raw or guide camera. Frame `n` shows the scene at `n / frame_rate` seconds, which is its time stamp. When it is read more
/// slowly, the scene slows down.
pub struct SimCamera {
    info: CameraInfo,
    role: Role,
    simulator: Simulator,
    trigger: Trigger,
    period: Duration,
    /// Frame of the raw camera in counts; empty for the guide camera.
    counts: Stack<u16>,
    /// Frame of the guide camera, 0 to 1, before quantization; empty for the raw camera.
    intensities: Stack<f32>,
    bytes: Vec<u8>,
}

impl SimCamera {
    /// Opens the camera `request.role` of the device in `request.source`, which is parsed as a [`SimSpec`].
    ///
    /// # Errors
    /// [`SimError`] for settings that cannot be used and scenes that cannot be read.
    pub fn open(request: &Request) -> Result<Self, SimError> {
        let mut spec: SimSpec = request.source.parse()?;
        spec.frame_rate = request.frame_rate.unwrap_or(spec.frame_rate);
        let simulator = simulator(spec)?;
        let spec = simulator.spec();
        let channels = spec.channels();
        let size = if request.role == Role::Raw { spec.size } else { spec.guide_size() };
        let samples = match (request.role, spec.bit_depth, spec.guide_bits) {
            (Role::Raw, 16, _) => Samples::U16,
            (Role::Guide, _, 8) => Samples::U8,
            _ => Samples::U12,
        };
        let format = if spec.color { PixelFormat::Rgb(samples) } else { PixelFormat::Mono(samples) };
        let frame_rate = spec.frame_rate;
        let (raw_planes, guide_planes) = if request.role == Role::Raw { (channels, 0) } else { (0, channels) };
        Ok(Self {
            info: CameraInfo {
                // identifies the device, not the scene
                name: format!("simulated {} camera {}", request.role, spec.seed),
                backend: "sim",
                format,
                size,
                frame_rate: request.paced.then_some(frame_rate),
                levels: None,
            },
            role: request.role,
            trigger: request.clock.join(),
            period: if request.paced { Duration::from_secs_f64(1.0 / frame_rate) } else { Duration::ZERO },
            counts: Stack::zeros(raw_planes, size),
            intensities: Stack::zeros(guide_planes, size),
            bytes: Vec::new(),
            simulator,
        })
    }

    /// Description of the simulated device, from which its bundle is made: [`SimSpec::calibration`], [`SimSpec::psf`].
    pub fn spec(&self) -> &SimSpec {
        self.simulator.spec()
    }
}

impl Camera for SimCamera {
    fn info(&self) -> &CameraInfo {
        &self.info
    }

    fn next_frame(&mut self, timeout: Duration) -> Result<Frame<'_>, CameraError> {
        let index = self
            .trigger
            .next(self.period, timeout)
            .ok_or_else(|| CameraError::Timeout { camera: self.info.name.clone(), after: timeout })?;
        match self.role {
            Role::Raw => {
                self.simulator.raw(index, &mut self.counts);
                interleave(&self.counts, &mut self.bytes, u16::to_le_bytes);
            }
            Role::Guide => {
                self.simulator.guide(index, &mut self.intensities);
                let bits = self.simulator.spec().guide_bits;
                let count = |share: f32| (share * ((1u32 << bits) - 1) as f32).round() as u16;
                match bits {
                    8 => interleave(&self.intensities, &mut self.bytes, |share| [count(share) as u8]),
                    _ => interleave(&self.intensities, &mut self.bytes, |share| count(share).to_le_bytes()),
                }
            }
        }
        let metadata = Metadata {
            sequence: index,
            timestamp: Duration::from_secs_f64(index as f64 / self.simulator.spec().frame_rate),
            ..Metadata::default()
        };
        let stride = self.info.format.row_bytes(self.info.size.width);
        Frame::new(&self.bytes, self.info.format, self.info.size, stride, metadata)
            .map_err(|source| CameraError::Frame { camera: self.info.name.clone(), source })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::{Clock, open};

    #[test]
    fn the_pair_shows_the_same_instants_and_repeats_itself() {
        let clock = Clock::default();
        let camera = |role, clock: &Clock| {
            let source = "spheres,size=32x24,stripes=8,color=rgb,guide_bits=8".to_owned();
            open("sim", &Request { source, paced: false, ..Request::new(role, clock) }).unwrap()
        };
        let (mut raw, mut guide) = (camera(Role::Raw, &clock), camera(Role::Guide, &clock));
        let long = Duration::from_secs(20);
        let mut first = Vec::new();
        for n in 0..3 {
            let r = raw.next_frame(long).unwrap();
            let g = guide.next_frame(long).unwrap();
            assert_eq!((r.metadata.sequence, r.metadata.timestamp), (n, Duration::from_millis(100 * n)));
            assert_eq!(r.metadata, g.metadata);
            assert_eq!(r.format(), PixelFormat::Rgb(Samples::U16));
            assert_eq!(g.format(), PixelFormat::Rgb(Samples::U8));
            first.push(r.rows().flatten().copied().collect::<Vec<u8>>());
        }
        assert_ne!(first[0], first[2]);
        let mut again = camera(Role::Raw, &Clock::default());
        assert_eq!(again.next_frame(long).unwrap().rows().flatten().copied().collect::<Vec<u8>>(), first[0]);
    }
}
