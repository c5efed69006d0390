//! One camera of the setup: its capture thread, its latest frame, and the settings that it is opened with.

use std::sync::Arc;
use std::time::{Duration, Instant};

use parking_lot::{Condvar, Mutex, MutexGuard};

use super::figures::{Figures, draw};
use crate::board::{CameraSpec, Mode};
use crate::camera::{self, Camera, CameraError, CameraInfo, Clock, Request, Role};
use crate::live::cameras::{BACK_OFF, CHANCES, silence};
use crate::live::statistics::Rate;
use crate::live::stop::Stop;
use crate::output::encode_jpeg;
use axum::body::Bytes;
use stokescope_core::frame::Metadata;
use stokescope_core::image::{Picture, Size, Stack};
use stokescope_core::readings::{Unit, unpack};

/// JPEG quality of pictures: noise and edges are judged by them.
const QUALITY: u8 = 90;

/// Settings that a camera is asked for; it decides those that are none.
#[derive(Clone, Debug, PartialEq)]
pub(in crate::live) struct Asked {
    /// Exposure time in microseconds.
    pub(in crate::live) exposure_us: Option<f32>,
    /// Gain, in the units of the board file.
    pub(in crate::live) gain: Option<f32>,
    /// Frames per second.
    pub(in crate::live) frame_rate: Option<f64>,
    /// Scene of a simulated camera, or address of a real one.
    pub(in crate::live) source: String,
}

/// The latest frame of a camera and what is known of it.
#[derive(Debug)]
pub(in crate::live) struct Latest {
    pub(in crate::live) info: CameraInfo,
    /// Counts, or fractions of full scale where the camera delivers those; `[C, H, W]`.
    pub(in crate::live) planes: Stack<f32>,
    /// Number of frames that have arrived.
    pub(in crate::live) number: u64,
    /// Settings that the camera reported with the frame.
    pub(in crate::live) metadata: Metadata,
    pub(in crate::live) arrived: Option<Instant>,
    /// Reason why there are no frames.
    pub(in crate::live) fault: Option<String>,
    /// Event that the camera waits for.
    pub(in crate::live) waiting: Option<&'static str>,
    pub(in crate::live) rate: Rate,
    pub(in crate::live) asked: Asked,
    /// Settings to open the camera with next, with the number of the change.
    wish: Option<(u64, Asked)>,
    /// Number of the latest change and its outcome.
    answer: Option<(u64, Result<(), String>)>,
    changes: u64,
}

impl Latest {
    /// Count of a full reading.
    pub(in crate::live) fn white(&self) -> f32 {
        let full = self.info.format.bits().map_or(1.0, |bits| ((1u32 << bits) - 1) as f32);
        self.info.levels.map_or(full, |levels| levels.white.min(full))
    }

    /// Count without light, if the camera knows it.
    pub(in crate::live) fn black(&self) -> Option<f32> {
        self.info.levels.and_then(|levels| levels.black)
    }

    /// Unit of the values.
    pub(in crate::live) fn unit(&self) -> Unit {
        if self.info.format.bits().is_some() { Unit::Counts } else { Unit::FullScale }
    }
}

/// Encoded picture and figures of one frame.
#[derive(Debug, Default)]
struct Derived {
    picture: Option<(u64, Bytes)>,
    figures: Option<(u64, Arc<Figures>)>,
    pixels: Vec<[u8; 3]>,
    buffer: Vec<u8>,
}

/// One camera of the setup.
#[derive(Debug)]
pub(in crate::live) struct SetupCamera {
    pub(in crate::live) role: Role,
    spec: CameraSpec,
    orientation: Option<u32>,
    latest: Mutex<Latest>,
    bell: Condvar,
    derived: Mutex<Derived>,
}

impl SetupCamera {
    /// Opens the camera `spec` in its role. `orientation` is that of the bundle.
    ///
    /// # Errors
    /// Those of [`camera::open`].
    pub(in crate::live) fn open(
        role: Role,
        spec: &CameraSpec,
        orientation: Option<u32>,
    ) -> Result<(Self, Box<dyn Camera>), CameraError> {
        let Mode { exposure_us, gain, .. } = spec.mode;
        let asked = Asked { exposure_us, gain, frame_rate: spec.frame_rate, source: spec.source.clone() };
        let camera = open(role, spec, orientation, &asked)?;
        let info = camera.info().clone();
        let latest = Latest {
            planes: Stack::zeros(info.format.planes(), info.format.plane_size(info.size)),
            info,
            number: 0,
            metadata: Metadata::default(),
            arrived: None,
            fault: None,
            waiting: None,
            rate: Rate::default(),
            asked,
            wish: None,
            answer: None,
            changes: 0,
        };
        let (latest, bell, derived) = (Mutex::new(latest), Condvar::new(), Mutex::default());
        Ok((Self { role, spec: spec.clone(), orientation, latest, bell, derived }, camera))
    }

    /// Name of the backend.
    pub(in crate::live) fn backend(&self) -> &str {
        &self.spec.backend
    }

    /// The latest frame, which no newer one replaces while it is held.
    pub(in crate::live) fn latest(&self) -> MutexGuard<'_, Latest> {
        self.latest.lock()
    }

    /// Asks for the camera to be opened with other settings; gives the number of this change.
    pub(in crate::live) fn ask(&self, asked: Asked) -> u64 {
        let mut latest = self.latest();
        latest.changes += 1;
        latest.wish = Some((latest.changes, asked));
        latest.changes
    }

    /// Outcome of the change with this number: done when the first frame with it has arrived. None while it is under way.
    pub(in crate::live) fn outcome(&self, change: u64) -> Option<Result<(), String>> {
        let latest = self.latest();
        match &latest.answer {
            Some((number, Err(reason))) if *number >= change => Some(Err(reason.clone())),
            Some((number, Ok(()))) if *number >= change && latest.arrived.is_some() => Some(Ok(())),
            _ => None,
        }
    }

    /// Waits for a frame newer than `number`, at most for `patience`; holds it.
    pub(in crate::live) fn newer(&self, number: u64, patience: Duration) -> Option<MutexGuard<'_, Latest>> {
        let mut latest = self.latest();
        self.bell.wait_while_for(&mut latest, |latest| latest.number <= number, patience);
        (latest.number > number).then_some(latest)
    }

    /// Figures of the latest frame; none before the first.
    pub(in crate::live) fn figures(&self) -> Option<Arc<Figures>> {
        let mut derived = self.derived.lock();
        let latest = self.latest();
        latest.arrived?;
        if let Some((_, figures)) = derived.figures.as_ref().filter(|(number, _)| *number == latest.number) {
            return Some(Arc::clone(figures));
        }
        let before = derived.figures.take().map(|(_, figures)| figures);
        let figures = Arc::new(Figures::of(&latest, before.as_deref()));
        derived.figures = Some((latest.number, Arc::clone(&figures)));
        Some(figures)
    }

    /// The latest frame as a JPEG picture, encoded once for all who ask; none before the first.
    pub(in crate::live) fn jpeg(&self) -> Option<Bytes> {
        let mut derived = self.derived.lock();
        let latest = self.latest();
        latest.arrived?;
        if let Some((_, picture)) = derived.picture.as_ref().filter(|(number, _)| *number == latest.number) {
            return Some(picture.clone());
        }
        let Derived { pixels, buffer, .. } = &mut *derived;
        draw(&latest, pixels);
        let (size, number) = (latest.planes.size(), latest.number);
        drop(latest);
        match encode_jpeg(size, pixels, QUALITY, buffer) {
            Ok(()) => {
                let picture = Bytes::copy_from_slice(buffer);
                derived.picture = Some((number, picture.clone()));
                Some(picture)
            }
            Err(e) => {
                tracing::error!("preview: {e}");
                None
            }
        }
    }

    /// The latest frame as a picture; none before the first. Allocates.
    pub(in crate::live) fn picture(&self) -> Option<Picture> {
        let latest = self.latest();
        latest.arrived?;
        let mut pixels = Vec::new();
        draw(&latest, &mut pixels);
        Some(Picture { size: latest.planes.size(), pixels })
    }

    /// Captures until the setup stops. A lost camera is opened again, with growing pauses, and so is one whose settings change.
    pub(in crate::live) fn run(&self, camera: Box<dyn Camera>, stop: &Stop) {
        let mut camera = Some(camera);
        let mut spare = Stack::zeros(0, Size::new(0, 0));
        let ([mut pause, longest], mut failures) = (BACK_OFF, 0);
        while !stop.is_set() {
            let wish = self.latest().wish.take();
            if let Some((number, asked)) = wish {
                // a driver opens a camera once at a time
                drop(camera.take());
                camera = self.change(number, asked);
                (failures, pause) = (0, BACK_OFF[0]);
                continue;
            }
            let outcome = match camera.as_mut() {
                Some(camera) => self.capture(camera.as_mut(), &mut spare),
                None => self.reopen().map(|opened| camera = Some(opened)),
            };
            match outcome {
                Ok(()) => failures = 0,
                Err(CameraError::Waiting { what, .. }) => self.latest().waiting = Some(what),
                Err(error) => {
                    failures += 1;
                    let give_up = camera.is_none() || failures >= CHANCES;
                    if give_up || !error.is_passing() {
                        self.offline(&error);
                    }
                    if give_up || !(error.is_passing() || matches!(error, CameraError::Timeout { .. })) {
                        camera = None;
                        stop.wait(pause);
                        pause = (2 * pause).min(longest);
                    }
                }
            }
        }
    }

    /// Opens the camera with other settings; where it refuses them, the caller opens it with those before.
    fn change(&self, number: u64, asked: Asked) -> Option<Box<dyn Camera>> {
        let opened = open(self.role, &self.spec, self.orientation, &asked);
        let mut latest = self.latest();
        match opened {
            Ok(camera) => {
                latest.info = camera.info().clone();
                (latest.asked, latest.metadata, latest.arrived) = (asked, Metadata::default(), None);
                (latest.fault, latest.answer) = (None, Some((number, Ok(()))));
                Some(camera)
            }
            Err(e) => {
                latest.answer = Some((number, Err(e.to_string())));
                None
            }
        }
    }

    fn reopen(&self) -> Result<Box<dyn Camera>, CameraError> {
        let asked = self.latest().asked.clone();
        let camera = open(self.role, &self.spec, self.orientation, &asked)?;
        self.latest().info = camera.info().clone();
        Ok(camera)
    }

    /// Waits for one frame and unpacks it into `spare`, which changes places with the frame before.
    fn capture(&self, camera: &mut dyn Camera, spare: &mut Stack<f32>) -> Result<(), CameraError> {
        let (role, info) = (self.role, camera.info());
        let (count, size) = (info.format.planes(), info.format.plane_size(info.size));
        if (spare.count(), spare.size()) != (count, size) {
            *spare = Stack::zeros(count, size);
        }
        let timeout = silence(info.frame_rate);
        let frame = camera.next_frame(timeout)?;
        let unpacked = unpack(&frame, spare);
        unpacked.map_err(|e| CameraError::Backend { name: format!("{role} camera"), reason: e.to_string() })?;
        let metadata = frame.metadata;
        let mut latest = self.latest();
        std::mem::swap(&mut latest.planes, spare);
        latest.number += 1;
        latest.metadata = metadata;
        let now = Instant::now();
        latest.rate.add(now);
        (latest.arrived, latest.waiting) = (Some(now), None);
        if latest.fault.take().is_some() {
            tracing::info!("{role} camera: frames again");
        }
        drop(latest);
        self.bell.notify_all();
        Ok(())
    }

    fn offline(&self, error: &CameraError) {
        let (role, reason) = (self.role, error.to_string());
        if self.latest().fault.replace(reason.clone()).is_none() {
            tracing::error!("{role} camera offline: {reason}");
        }
    }
}

/// Opens a camera. Each has a clock of its own: the scenes of calibration stand still.
fn open(
    role: Role,
    spec: &CameraSpec,
    orientation: Option<u32>,
    asked: &Asked,
) -> Result<Box<dyn Camera>, CameraError> {
    let Asked { exposure_us, gain, frame_rate, source } = asked.clone();
    let mode = Mode { exposure_us, gain, ..spec.mode };
    let request = Request { source, mode, frame_rate, ..Request::of(role, spec, &Clock::default(), orientation) };
    camera::open(&spec.backend, &request)
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::camera::Limits;
    use stokescope_core::frame::{PixelFormat, Samples};

    /// A frame of a 12-bit sensor.
    pub(in crate::live::setup) fn latest(size: Size, counts: Vec<f32>) -> Latest {
        let format = PixelFormat::Mono(Samples::U12);
        let (name, backend) = ("test".to_owned(), "sim");
        Latest {
            info: CameraInfo {
                name,
                backend,
                format,
                size,
                frame_rate: None,
                levels: None,
                readout: None,
                limits: Limits::default(),
            },
            planes: Stack::from_vec(1, size, counts).unwrap(),
            number: 1,
            metadata: Metadata::default(),
            arrived: Some(Instant::now()),
            fault: None,
            waiting: None,
            rate: Rate::default(),
            asked: Asked { exposure_us: None, gain: None, frame_rate: None, source: String::new() },
            wish: None,
            answer: None,
            changes: 0,
        }
    }

    fn opened(source: &str) -> Arc<SetupCamera> {
        let spec = CameraSpec { frame_rate: Some(100.0), ..CameraSpec::new("sim", source.to_owned()) };
        let (camera, device) = SetupCamera::open(Role::Raw, &spec, None).unwrap();
        let camera = Arc::new(camera);
        let stop = Arc::<Stop>::default();
        let (running, own) = (Arc::clone(&camera), Arc::clone(&stop));
        std::thread::spawn(move || running.run(device, &own));
        camera
    }

    fn outcome(camera: &SetupCamera, change: u64) -> Result<(), String> {
        for _ in 0..2000 {
            if let Some(outcome) = camera.outcome(change) {
                return outcome;
            }
            std::thread::sleep(Duration::from_millis(5));
        }
        panic!("the change is not answered");
    }

    #[test]
    fn a_change_that_is_refused_leaves_the_camera_as_it_was() {
        let camera = opened("dark,size=32,stripes=8");
        let long = Duration::from_secs(20);
        assert!(camera.newer(0, long).is_some());
        let before = camera.latest().asked.clone();
        let unknown = Asked { source: "no-such-scene".to_owned(), ..before.clone() };
        let refused = outcome(&camera, camera.ask(unknown)).unwrap_err();
        assert!(refused.contains("no-such-scene"), "{refused}");
        assert_eq!(camera.latest().asked, before);
        let number = camera.latest().number;
        assert!(camera.newer(number, long).is_some(), "frames go on");
        let dark = camera.figures().unwrap().mean;
        let lamp = Asked { source: "uniform,size=32,stripes=8".to_owned(), ..before };
        assert_eq!(outcome(&camera, camera.ask(lamp.clone())), Ok(()));
        assert_eq!(camera.latest().asked, lamp);
        let bright = camera.figures().unwrap().mean;
        assert!(bright > 4.0 * dark);
        let shorter = Asked { exposure_us: Some(5000.0), ..lamp };
        assert_eq!(outcome(&camera, camera.ask(shorter)), Ok(()));
        assert_eq!(camera.latest().metadata.exposure_us, Some(5000.0));
        assert!(((camera.figures().unwrap().mean - dark) / (bright - dark) - 0.5).abs() < 0.05);
        assert!(camera.jpeg().unwrap().starts_with(&[0xff, 0xd8]));
    }
}
