//! One thread per camera: wait for a frame, take its content, give the driver's memory back.

use std::time::{Duration, Instant};

use super::hub::Hub;
use super::pair::Captured;
use crate::board::CameraSpec;
use crate::camera::{self, Camera, CameraError, Clock, Request, Role};
use crate::prepare::unpack;

/// A camera that is silent this long is offline, unless its frames are meant to be farther apart.
const SILENCE: Duration = Duration::from_secs(1);
/// First and longest pause before a camera is opened again.
const BACK_OFF: [Duration; 2] = [Duration::from_millis(250), Duration::from_secs(5)];
/// Times in a row a camera may be silent or send broken frames before it is opened again.
const CHANCES: u32 = 3;

/// How to open one camera of the board, the first time and again.
#[derive(Clone, Debug)]
pub(super) struct Source {
    role: Role,
    backend: String,
    request: Request,
}

impl Source {
    /// The camera `spec` as `role`, on the pair's clock; in its own time if `paced`.
    pub(super) fn new(role: Role, spec: &CameraSpec, clock: &Clock, paced: bool) -> Self {
        let request = Request { paced: paced && spec.paced, ..Request::of(role, spec, clock) };
        Self { role, backend: spec.backend.clone(), request }
    }

    /// Opens it.
    ///
    /// # Errors
    /// Those of [`camera::open`].
    pub(super) fn open(&self) -> Result<Box<dyn Camera>, CameraError> {
        camera::open(&self.backend, &self.request)
    }
}

/// Captures until the service stops. A lost camera is reported and opened again, with growing pauses.
pub(super) fn run(hub: &Hub, source: &Source, camera: Box<dyn Camera>) {
    let mut camera = Some(camera);
    let [mut pause, longest] = BACK_OFF;
    let mut failures = 0;
    while !hub.stop.is_set() {
        let outcome = match camera.as_mut() {
            Some(camera) => capture(hub, source.role, camera.as_mut()),
            None => source.open().map(|opened| {
                camera = Some(opened);
                hub.pairing.update(source.role, |lens| lens.reopened += 1);
                None
            }),
        };
        match outcome {
            Ok(None) => {}
            Ok(Some(frame)) => {
                (failures, pause) = (0, BACK_OFF[0]);
                hub.online(source.role);
                hub.pairing.push(source.role, frame);
            }
            Err(error) => {
                failures += 1;
                let broken = error.is_passing();
                let give_up = camera.is_none() || failures >= CHANCES;
                if !broken || give_up {
                    hub.offline(source.role, &error);
                }
                hub.pairing.update(source.role, |lens| lens.faults += 1);
                if give_up || !(broken || matches!(error, CameraError::Timeout { .. })) {
                    camera = None;
                    hub.stop.wait(pause);
                    pause = (2 * pause).min(longest);
                }
            }
        }
    }
}

fn capture(hub: &Hub, role: Role, camera: &mut dyn Camera) -> Result<Option<Captured>, CameraError> {
    let info = camera.info();
    let (format, size) = (info.format, info.format.plane_size(info.size));
    let timeout = info.frame_rate.map_or(SILENCE, |rate| SILENCE.max(Duration::from_secs_f64(3.0 / rate)));
    let frame = camera.next_frame(timeout)?;
    let arrived = Instant::now();
    let mut planes = hub.pairing.buffer(role, format.planes(), size);
    unpack(&frame, &mut planes)
        .map_err(|e| CameraError::Backend { name: format!("{role} camera"), reason: e.to_string() })?;
    let timestamp = frame.metadata.timestamp;
    if let (Role::Guide, Some(bits)) = (role, format.bits()) {
        // the gain of a guide is fitted; near 1 its figures mean something to people
        let scale = 1.0 / ((1u32 << bits) - 1) as f32;
        planes.as_mut_slice().iter_mut().for_each(|v| *v *= scale);
    }
    Ok(Some(Captured { planes, timestamp, arrived }))
}
