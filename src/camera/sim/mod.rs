//! Simulated cameras: frames of the simulator in the format that a sensor would give them.

mod clip;
mod scene_folder;

use std::time::Duration;

pub use scene_folder::FolderError;
pub use stokescope_simulator::{
    Capture, Flaws, IMPERFECTIONS, Imperfections, Knowledge, Margin, Pose, SCENES, SceneError, SimError, SimSpec,
    Simulator, TARGETS,
};

use self::clip::Clip;
use crate::camera::{Camera, CameraError, CameraInfo, Limits, Request, Role, clock::Trigger, interleave};
use stokescope_core::frame::{Frame, Metadata, PixelFormat, Samples};
use stokescope_core::image::{Size, Stack};

/// Makes the simulator of `spec`; its scene is a built-in one or a folder of measured images.
///
/// # Errors
/// [`SimError`] for values out of range and scenes that cannot be read.
pub fn simulator(spec: SimSpec) -> Result<Simulator, SimError> {
    Simulator::with_reader(spec, &scene_folder::read)
}

/// Exposure time in microseconds of a camera that is asked for none: it sees a scene as its specification says.
const NOMINAL_US: f32 = 10_000.0;
/// Shortest exposure time in microseconds; the longest is the time between two frames, and at least the nominal one.
const SHORTEST_US: f32 = 20.0;
/// Least and largest gain.
const GAINS: [f32; 2] = [1.0, 16.0];
/// Least and largest frames per second.
const RATES: [f64; 2] = [1e-3, 1e3];

/// Simulated raw or guide camera. It takes exposure time and gain as a sensor does: what is beyond its limits becomes the limit, and each
/// frame says what it was taken with. Frame `n` shows the scene at `n / frame_rate` seconds, which is its time stamp, or with
/// [`Request::clip`] the next frame of a clip. When it is read more slowly, the scene slows down.
pub struct SimCamera {
    info: CameraInfo,
    spec: SimSpec,
    /// Exposure time in microseconds.
    exposure_us: f32,
    trigger: Trigger,
    period: Duration,
    source: Source,
}

/// Where the frames come from.
enum Source {
    /// Each one is rendered when it is due.
    Renderer(Box<Renderer>),
    /// They are rendered ahead.
    Clip(Clip),
}

/// Renders the frames of one camera.
struct Renderer {
    role: Role,
    simulator: Simulator,
    /// Frame of the raw camera in counts; empty for the guide camera.
    counts: Stack<u16>,
    /// Frame of the guide camera, 0 to 1, before quantization; empty for the raw camera.
    intensities: Stack<f32>,
    bytes: Vec<u8>,
}

impl SimCamera {
    /// Opens the camera `request.role` of the device in `request.source`, which is parsed as a [`SimSpec`]. With a clip this renders the
    /// first frame.
    ///
    /// # Errors
    /// [`SimError`] for settings that cannot be used and scenes that cannot be read; [`CameraError::Unavailable`] without a thread.
    pub fn open(request: &Request) -> Result<Self, CameraError> {
        let mut spec: SimSpec = request.source.parse()?;
        spec.frame_rate = request.frame_rate.unwrap_or(spec.frame_rate);
        let longest = (1e6 / spec.frame_rate as f32).max(NOMINAL_US);
        let exposure_us = request.mode.exposure_us.unwrap_or(NOMINAL_US).clamp(SHORTEST_US, longest);
        spec.exposure = exposure_us / NOMINAL_US;
        spec.gain = request.mode.gain.unwrap_or(1.0).clamp(GAINS[0], GAINS[1]);
        let mut renderer = Renderer::new(request.role, spec.clone())?;
        let size = if request.role == Role::Raw { spec.size } else { spec.guide_size() };
        let samples = match (request.role, spec.bit_depth, spec.guide_bits) {
            (Role::Raw, 16, _) => Samples::U16,
            (Role::Guide, _, 8) => Samples::U8,
            _ => Samples::U12,
        };
        let format = if spec.color { PixelFormat::Rgb(samples) } else { PixelFormat::Mono(samples) };
        // identifies the device, not the scene
        let name = format!("simulated {} camera {}", request.role, spec.seed);
        let source = match spec.clip_frames() {
            frames if request.clip && frames > 0 => {
                let clip = Clip::start(frames, move |n| renderer.render(n).into());
                Source::Clip(
                    clip.map_err(|e| CameraError::Unavailable { camera: name.clone(), reason: e.to_string() })?,
                )
            }
            _ => Source::Renderer(Box::new(renderer)),
        };
        let frame_rate = request.paced.then_some(spec.frame_rate);
        let limits = Limits {
            exposure_us: Some([SHORTEST_US, longest].map(f64::from)),
            gain: Some(GAINS.map(f64::from)),
            frame_rate: request.paced.then_some(RATES),
        };
        Ok(Self {
            info: CameraInfo { name, backend: "sim", format, size, frame_rate, levels: None, readout: None, limits },
            trigger: request.clock.join(),
            period: frame_rate.map_or(Duration::ZERO, |rate| Duration::from_secs_f64(1.0 / rate)),
            spec,
            exposure_us,
            source,
        })
    }

    /// Description of the simulated device, from which its bundle is made: [`SimSpec::calibration`], [`SimSpec::psf`].
    pub fn spec(&self) -> &SimSpec {
        &self.spec
    }
}

impl Renderer {
    fn new(role: Role, spec: SimSpec) -> Result<Self, SimError> {
        let (channels, size, guide) = (spec.channels(), spec.size, spec.guide_size());
        let none = Size::new(0, 0);
        let (counts, intensities) = match role {
            Role::Raw => (Stack::zeros(channels, size), Stack::zeros(0, none)),
            Role::Guide => (Stack::zeros(0, none), Stack::zeros(channels, guide)),
        };
        Ok(Self { role, simulator: simulator(spec)?, counts, intensities, bytes: Vec::new() })
    }

    /// Renders the scene's frame `index` as the camera delivers it.
    fn render(&mut self, index: u64) -> &[u8] {
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
        &self.bytes
    }
}

impl Camera for SimCamera {
    fn info(&self) -> &CameraInfo {
        &self.info
    }

    fn next_frame(&mut self, timeout: Duration) -> Result<Frame<'_>, CameraError> {
        if let Source::Clip(clip) = &self.source {
            self.trigger.set_clip(clip.ready());
        }
        let tick = self
            .trigger
            .next(self.period, timeout)
            .ok_or_else(|| CameraError::Timeout { camera: self.info.name.clone(), after: timeout })?;
        let bytes = match &mut self.source {
            Source::Renderer(renderer) => renderer.render(tick.scene),
            Source::Clip(clip) => clip.frame(tick.scene),
        };
        let metadata = Metadata {
            sequence: tick.number,
            timestamp: Duration::from_secs_f64(tick.number as f64 / self.spec.frame_rate),
            exposure_us: Some(self.exposure_us),
            gain: Some(self.spec.gain),
            ..Metadata::default()
        };
        let stride = self.info.format.row_bytes(self.info.size.width);
        Frame::new(bytes, self.info.format, self.info.size, stride, metadata)
            .map_err(|source| CameraError::Frame { camera: self.info.name.clone(), source })
    }
}

#[cfg(test)]
mod tests {
    use std::time::Instant;

    use super::*;
    use crate::board::Mode;
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

    #[test]
    fn exposure_and_gain_are_taken_within_the_limits_of_a_sensor_and_said_with_each_frame() {
        let long = Duration::from_secs(20);
        let seen = |exposure_us, gain| {
            let source = "uniform,size=32,stripes=8,noise=0,shot=0".to_owned();
            let mode = Mode { exposure_us, gain, ..Mode::default() };
            let request = Request { source, paced: false, mode, ..Request::new(Role::Raw, &Clock::default()) };
            let mut camera = open("sim", &request).unwrap();
            let frame = camera.next_frame(long).unwrap();
            let counts =
                frame.rows().flat_map(|row| row.chunks_exact(2)).map(|c| f64::from(u16::from_le_bytes([c[0], c[1]])));
            (counts.sum::<f64>() / 1024.0 - 1024.0, frame.metadata.exposure_us.unwrap(), frame.metadata.gain.unwrap())
        };
        let (nominal, exposure, gain) = seen(None, None);
        assert_eq!((exposure, gain), (10_000.0, 1.0));
        for (asked, took, brighter) in [
            ((Some(5000.0), None), (5000.0, 1.0), 0.5),
            ((Some(2500.0), Some(3.0)), (2500.0, 3.0), 0.75),
            ((Some(1.0), Some(100.0)), (20.0, 16.0), 0.032),
            ((Some(1e9), Some(0.0)), (100_000.0, 1.0), f64::NAN),
        ] {
            let (mean, exposure, gain) = seen(asked.0, asked.1);
            assert_eq!((exposure, gain), took);
            assert!(brighter.is_nan() || (mean / nominal / brighter - 1.0).abs() < 5e-3, "{mean} of {nominal}");
        }
    }

    #[test]
    fn a_clip_shows_the_frames_of_the_scene_to_and_fro_and_both_cameras_the_same() {
        let clock = Clock::default();
        let camera = |role, clip, clock: &Clock| {
            let source = "wedges,size=32,stripes=8,clip=3,guide_noise=0,noise=0,shot=0".to_owned();
            open("sim", &Request { source, paced: false, clip, ..Request::new(role, clock) }).unwrap()
        };
        let long = Duration::from_secs(20);
        let bytes = |camera: &mut Box<dyn Camera>| {
            let frame = camera.next_frame(long).unwrap();
            (frame.metadata.sequence, frame.rows().flatten().copied().collect::<Vec<u8>>())
        };
        let rendered = |role| {
            let mut camera = camera(role, false, &Clock::default());
            [0; 3].map(|_| bytes(&mut camera).1)
        };
        let scene = [rendered(Role::Raw), rendered(Role::Guide)];
        let mut pair = [camera(Role::Raw, true, &clock), camera(Role::Guide, true, &clock)];
        let (begin, mut shown) = (Instant::now(), Vec::new());
        // until the last frame of the clip was shown, and some more
        while begin.elapsed() < long && !(shown.contains(&2) && shown.len() > 12) {
            let [raw, guide] = [0, 1].map(|k| {
                let (sequence, frame) = bytes(&mut pair[k]);
                assert_eq!(sequence, shown.len() as u64);
                scene[k].iter().position(|known| *known == frame).expect("a frame of the clip")
            });
            assert_eq!(raw, guide);
            shown.push(raw);
            std::thread::sleep(Duration::from_millis(1));
        }
        assert_eq!((shown[0], shown.iter().max()), (0, Some(&2)));
        assert!(shown.windows(2).all(|pair| pair[0].abs_diff(pair[1]) <= 1));
    }
}
