//! Capture: one thread per camera waits for a frame, unpacks it and gives the driver's memory back.

use std::sync::Arc;
use std::time::{Duration, Instant};

use serde_json::json;

use super::events::Events;
use super::pairing::{Captured, Pairing};
use super::preview::Broadcast;
use super::stop::Stop;
use crate::board::CameraSpec;
use crate::camera::{self, Camera, CameraError, Clock, Request, Role};
use stokescope_core::readings::{Binned, Binning, unpack};

/// A camera that is silent this long is offline, unless its frame rate is lower.
const SILENCE: Duration = Duration::from_secs(1);
/// First and longest pause before a camera is opened again.
pub(super) const BACK_OFF: [Duration; 2] = [Duration::from_millis(250), Duration::from_secs(5)];
/// Times in a row that a camera may be silent or send broken frames before it is opened again.
pub(super) const CHANCES: u32 = 3;

/// Time without a frame after which a camera of this frame rate is silent.
pub(super) fn silence(frame_rate: Option<f64>) -> Duration {
    frame_rate.map_or(SILENCE, |rate| SILENCE.max(Duration::from_secs_f64(3.0 / rate)))
}

/// Description of one camera, enough to open it the first time and again.
#[derive(Clone, Debug)]
pub(super) struct CameraSource {
    role: Role,
    backend: String,
    request: Request,
}

impl CameraSource {
    /// The camera `spec` in its role, on the pair's clock. Unless `every` frame counts, a simulated or replayed camera keeps its frame
    /// rate and repeats; a simulated one then loops a clip, so that the solver has the processor. `orientation` is that of the bundle.
    pub(super) fn new(role: Role, spec: &CameraSpec, clock: &Clock, orientation: Option<u32>, every: bool) -> Self {
        let (paced, repeat) = (!every && spec.paced, !every);
        let request = Request { paced, repeat, clip: paced, ..Request::of(role, spec, clock, orientation) };
        Self { role, backend: spec.backend.clone(), request }
    }

    /// Opens the camera.
    ///
    /// # Errors
    /// Those of [`camera::open`].
    pub(super) fn open(&self) -> Result<Box<dyn Camera>, CameraError> {
        camera::open(&self.backend, &self.request)
    }
}

/// A capture thread: the camera it reads and the places its frames and faults go to.
#[derive(Debug)]
pub(super) struct Capture {
    pub(super) source: CameraSource,
    pub(super) stop: Arc<Stop>,
    pub(super) pairing: Arc<Pairing>,
    pub(super) broadcast: Arc<Broadcast>,
    pub(super) events: Arc<Events>,
    /// Whether every frame of a recording counts: it is never opened again, and its end ends the run.
    pub(super) every: bool,
}

impl Capture {
    /// Captures until the service stops, with `binning` of frames to the working size. A lost camera is reported and opened again, with
    /// growing pauses, and so is one that is to restart. A recording of which every frame counts ends with its last frame, or with an error
    /// that is not of one frame alone.
    pub(super) fn run(&self, camera: Box<dyn Camera>, mut binning: Option<Binning>) {
        let role = self.source.role;
        let mut camera = Some(camera);
        let [mut pause, longest] = BACK_OFF;
        let (mut failures, mut restarts) = (0, false);
        while !self.stop.is_set() {
            if self.pairing.take_restart(role) {
                // a driver opens a camera once at a time
                camera = None;
                (restarts, failures, pause) = (true, 0, BACK_OFF[0]);
                tracing::info!("{role} camera: closed, to be opened again by request");
            }
            let outcome = match camera.as_mut() {
                Some(camera) => self.capture(camera.as_mut(), binning.as_mut()).map(Some),
                None => self.source.open().map(|opened| {
                    camera = Some(opened);
                    self.pairing.update(role, |status| status.reopened += 1);
                    if std::mem::take(&mut restarts) {
                        self.events.emit("camera-restarted", json!({ "camera": role.to_string() }));
                    }
                    None
                }),
            };
            match outcome {
                Ok(None) => {}
                Ok(Some(frame)) => {
                    (failures, pause) = (0, BACK_OFF[0]);
                    self.online();
                    self.pairing.push(role, frame);
                }
                Err(CameraError::Waiting { what, .. }) => {
                    failures = 0;
                    self.waits(what);
                }
                Err(error) if self.every => {
                    self.pairing.update(role, |status| status.faults += 1);
                    if !error.is_passing() {
                        return self.pairing.end(role, Some(error).filter(|e| !matches!(e, CameraError::Ended { .. })));
                    }
                }
                Err(error) => {
                    failures += 1;
                    let passing = error.is_passing();
                    let give_up = camera.is_none() || failures >= CHANCES;
                    if !passing || give_up {
                        self.offline(&error);
                    }
                    self.pairing.update(role, |status| status.faults += 1);
                    if give_up || !(passing || matches!(error, CameraError::Timeout { .. })) {
                        camera = None;
                        self.stop.wait(pause);
                        pause = (2 * pause).min(longest);
                    }
                }
            }
        }
    }

    /// Waits for one frame and unpacks or bins it.
    fn capture(&self, camera: &mut dyn Camera, binning: Option<&mut Binning>) -> Result<Captured, CameraError> {
        let (role, info) = (self.source.role, camera.info());
        let whole = info.format.plane_size(info.size);
        let (format, size) = (info.format, binning.as_ref().map_or(whole, |binning| binning.window().working()));
        let timeout = silence(info.frame_rate);
        let frame = camera.next_frame(timeout)?;
        let arrived = Instant::now();
        let mut image = self.pairing.buffer(role, format.planes(), size);
        let unpacked = match binning {
            Some(binning) => binning.frame(&frame, &mut image),
            None => unpack(&frame, &mut image.values),
        };
        unpacked.map_err(|e| CameraError::Backend { name: format!("{role} camera"), reason: e.to_string() })?;
        let timestamp = frame.metadata.timestamp;
        let Binned { values: mut planes, weights, off_scale } = image;
        if let (Role::Guide, Some(bits)) = (role, format.bits()) {
            // the guide's gain is fitted: as fractions of full scale it is near 1, which people can judge
            let scale = 1.0 / ((1u32 << bits) - 1) as f32;
            planes.as_mut_slice().iter_mut().for_each(|v| *v *= scale);
        }
        Ok(Captured { planes, weights, off_scale, timestamp, arrived })
    }

    /// Notes that the camera delivers; reports it when it did not before.
    fn online(&self) {
        let role = self.source.role;
        self.pairing.update(role, |status| {
            status.waiting = None;
            if status.fault.take().is_some() {
                tracing::info!("{role} camera: frames again");
                self.events.emit("camera-online", json!({ "camera": role.to_string() }));
                self.broadcast.online(role);
            }
        });
    }

    /// Notes that the camera waits for `what`; reports it when frames came before.
    fn waits(&self, what: &'static str) {
        let role = self.source.role;
        self.pairing.update(role, |status| {
            if status.waiting.replace(what) != Some(what) {
                tracing::info!("{role} camera: waits for {what}");
                self.events.emit("camera-waiting", json!({ "camera": role.to_string(), "for": what }));
            }
        });
    }

    /// Notes that the camera does not deliver; reports it when it did before.
    fn offline(&self, error: &CameraError) {
        let role = self.source.role;
        self.pairing.update(role, |status| {
            let reason = error.to_string();
            if status.fault.is_none() {
                tracing::error!("{role} camera offline: {reason}");
                self.events.emit("camera-offline", json!({ "camera": role.to_string(), "reason": reason }));
            }
            self.broadcast.offline(role, &reason);
            status.fault = Some(reason);
        });
    }
}
