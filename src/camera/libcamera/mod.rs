//! Backend for libcamera: sensors on a camera connector, with or without an ISP, and USB cameras.
//!
//! Every frame belongs to a request with one buffer. The request is queued to the driver, returns complete through libcamera's own
//! thread, is lent to the caller, and is queued again. Raw formats are delivered as the sensor sends them, without the ISP.

mod memory;

use std::{
    io,
    sync::{
        Mutex, PoisonError,
        mpsc::{self, Receiver, RecvTimeoutError},
    },
    time::{Duration, Instant},
};

use ::libcamera::{
    camera::{ActiveCamera, Camera as Device, CameraConfiguration},
    camera_manager::CameraManager,
    control::{Control, ControlList},
    control_value::ControlValue,
    controls,
    framebuffer::FrameMetadataStatus,
    framebuffer_allocator::FrameBufferAllocator,
    properties,
    request::{Request as DriverRequest, RequestStatus, ReuseFlag},
    stream::{Stream, StreamRole},
    utils::UniquePtr,
};

use self::memory::{FrameMemory, Mapping, Movable};
use super::{
    AvailableCamera, AvailableMode, Camera, CameraError, CameraInfo, Request, Role, clock::Trigger, preferred,
};
use crate::board::Sync;
use stokescope_core::frame::{Bayer, Frame, Metadata, PixelFormat, Samples};
use stokescope_core::image::Size;

/// The only camera manager of the process, and its number of users.
static MANAGER: Mutex<(usize, Option<Movable<CameraManager>>)> = Mutex::new((0, None));

/// A use of the camera manager. The manager is dropped with the last use; a new one searches for cameras again.
struct ManagerLease;

impl ManagerLease {
    fn new() -> io::Result<Self> {
        let mut manager = MANAGER.lock().unwrap_or_else(PoisonError::into_inner);
        if manager.1.is_none() {
            manager.1 = Some(Movable(CameraManager::new()?));
        }
        manager.0 += 1;
        Ok(Self)
    }

    fn with<T>(&self, use_it: impl FnOnce(&CameraManager) -> T) -> Option<T> {
        let manager = MANAGER.lock().unwrap_or_else(PoisonError::into_inner);
        manager.1.as_ref().map(|manager| use_it(manager))
    }
}

impl Drop for ManagerLease {
    fn drop(&mut self) {
        let mut manager = MANAGER.lock().unwrap_or_else(PoisonError::into_inner);
        manager.0 -= 1;
        if manager.0 == 0 {
            manager.1 = None;
        }
    }
}

/// Name of a format in libcamera.
fn driver_name(format: PixelFormat) -> Option<String> {
    let samples = |samples| match samples {
        Samples::U8 => Some("8"),
        Samples::U10 => Some("10"),
        Samples::U12 => Some("12"),
        Samples::U16 => Some("16"),
        Samples::Packed10 => Some("10_CSI2P"),
        Samples::Packed12 => Some("12_CSI2P"),
        Samples::F32 => None,
    };
    match format {
        PixelFormat::Mono(s) => Some(format!("R{}", samples(s)?)),
        PixelFormat::Bayer(order, s) => {
            let order = match order {
                Bayer::Rggb => "RGGB",
                Bayer::Bggr => "BGGR",
                Bayer::Grbg => "GRBG",
                Bayer::Gbrg => "GBRG",
            };
            Some(format!("S{order}{}", samples(s)?))
        }
        // libcamera names components from the highest byte down; red is first in memory
        PixelFormat::Rgb(Samples::U8) => Some("BGR888".to_owned()),
        PixelFormat::Rgb(_) => None,
        PixelFormat::Nv12Luma | PixelFormat::Nv12Rgb => Some("NV12".to_owned()),
        PixelFormat::Yuyv(_) => Some("YUYV".to_owned()),
    }
}

fn formats_of(name: &str) -> impl Iterator<Item = PixelFormat> {
    PixelFormat::named().filter(move |format| driver_name(*format).is_some_and(|own| own == name))
}

fn is_raw(format: PixelFormat) -> bool {
    matches!(format, PixelFormat::Mono(_) | PixelFormat::Bayer(..))
}

/// Modes of a stream of `role`; empty where the camera has no such stream.
fn modes(camera: &Device<'_>, role: StreamRole) -> Vec<AvailableMode> {
    let configuration = camera.generate_configuration(&[role]);
    let Some(stream) = configuration.as_ref().and_then(|c| c.get(0)) else { return Vec::new() };
    let formats = stream.formats();
    let mode = |format| {
        let driver_name = format!("{format}");
        let mut sizes: Vec<_> = formats.sizes(format).iter().map(|s| format!("{}×{}", s.width, s.height)).collect();
        if sizes.is_empty() {
            let range = formats.range(format);
            let (from, to) = (range.min, range.max);
            sizes.push(format!("{}×{} to {}×{}", from.width, from.height, to.width, to.height));
        }
        AvailableMode { formats: formats_of(&driver_name).map(PixelFormat::name).collect(), driver_name, sizes }
    };
    let found = formats.pixel_formats();
    (0..found.len()).filter_map(|i| found.get(i)).map(mode).collect()
}

fn all_modes(camera: &Device<'_>) -> Vec<AvailableMode> {
    let mut found = modes(camera, StreamRole::Raw);
    for mode in modes(camera, StreamRole::VideoRecording) {
        if !found.contains(&mode) {
            found.push(mode);
        }
    }
    found
}

/// Lists all cameras of libcamera.
///
/// # Errors
/// [`CameraError::Backend`] when there is no camera manager.
pub(super) fn list() -> Result<Vec<AvailableCamera>, CameraError> {
    let lease = lease()?;
    let offer = |camera: &Device<'_>| {
        let model = camera.properties().get::<properties::Model>().map_or_else(|_| "camera".to_owned(), |m| m.0);
        AvailableCamera { source: camera.id().to_owned(), description: model, modes: all_modes(camera) }
    };
    let mut offers: Vec<AvailableCamera> = lease
        .with(|manager| {
            let cameras = manager.cameras();
            (0..cameras.len()).filter_map(|i| cameras.get(i)).map(|camera| offer(&camera)).collect()
        })
        .unwrap_or_default();
    offers.sort_by(|a, b| a.source.cmp(&b.source));
    Ok(offers)
}

fn lease() -> Result<ManagerLease, CameraError> {
    ManagerLease::new().map_err(|e| CameraError::Backend { name: "libcamera".to_owned(), reason: e.to_string() })
}

/// Events from libcamera's thread.
enum Event {
    /// A request has completed.
    Done(DriverRequest),
    /// The camera was disconnected.
    Disconnected,
}

/// A streaming camera. Fields are dropped in order: requests before their camera, the camera before the manager.
struct LibCamera {
    info: CameraInfo,
    events: Receiver<Event>,
    /// Request of the frame that is lent.
    lent: Option<DriverRequest>,
    /// Requests that wait for the clock; empty without one.
    idle: Vec<DriverRequest>,
    /// Frame buffers, indexed by the cookies of the requests.
    mappings: Vec<Mapping>,
    stream: Stream,
    stride_bytes: usize,
    /// Clock and frame interval with [`Sync::Clock`].
    trigger: Option<(Trigger, Duration)>,
    camera: Movable<ActiveCamera<'static>>,
    /// Keeps the camera manager alive.
    _lease: ManagerLease,
}

/// Opens the camera whose id is `request.source`, or the only one whose id contains it.
///
/// # Errors
/// [`CameraError`] when no or several cameras match, or the camera is in use or does not have the mode or a control.
pub(super) fn open(request: &Request) -> Result<Box<dyn Camera>, CameraError> {
    Ok(Box::new(LibCamera::open(request)?))
}

fn unavailable(camera: &str, reason: impl Into<String>) -> CameraError {
    CameraError::Unavailable { camera: camera.to_owned(), reason: reason.into() }
}

fn find(manager: &CameraManager, source: &str) -> Result<Device<'static>, CameraError> {
    let cameras = manager.cameras();
    let mut all: Vec<_> = (0..cameras.len()).filter_map(|i| cameras.get(i)).collect();
    all.sort_by(|a, b| a.id().cmp(b.id()));
    let ids: Vec<_> = all.iter().map(|camera| camera.id().to_owned()).collect();
    let mut found = ids.iter().enumerate().filter(|(_, id)| id.contains(source));
    let index = match (ids.iter().position(|id| id == source), found.next(), found.next()) {
        (Some(index), ..) | (None, Some((index, _)), None) => index,
        (None, None, _) if ids.is_empty() => {
            return Err(unavailable(source, "libcamera finds no camera; check cable and power"));
        }
        (None, None, _) => return Err(unavailable(source, format!("no such camera, allowed: {}", ids.join(", ")))),
        _ => return Err(unavailable(source, format!("several cameras match: {}", ids.join(", ")))),
    };
    all.into_iter().nth(index).ok_or_else(|| unavailable(source, "no such camera"))
}

/// Makes a configuration with exactly the requested mode; returns it with the format.
fn configure(
    camera: &Device<'_>,
    name: &str,
    request: &Request,
) -> Result<(CameraConfiguration, PixelFormat), CameraError> {
    let refuse = || {
        let describe = |mode: &AvailableMode| format!("{} {}", mode.formats.join(" or "), mode.sizes.join(", "));
        let offered: Vec<_> = all_modes(camera).iter().filter(|m| !m.formats.is_empty()).map(describe).collect();
        let offered = if offered.is_empty() { "no format that is supported".to_owned() } else { offered.join("; ") };
        CameraError::Mode { camera: name.to_owned(), asked: request.mode.to_string(), offered }
    };
    let offered = || {
        let names: Vec<String> = all_modes(camera).into_iter().flat_map(|mode| mode.formats).collect();
        preferred(request.role, names.iter().filter_map(|name| name.parse().ok()))
    };
    let format = request.mode.format.or_else(offered).ok_or_else(refuse)?;
    let wanted = driver_name(format).ok_or_else(refuse)?;
    let role = if is_raw(format) { StreamRole::Raw } else { StreamRole::VideoRecording };
    let mut configuration = camera.generate_configuration(&[role]).ok_or_else(refuse)?;
    let mut stream = configuration.get_mut(0).ok_or_else(refuse)?;
    stream.set_pixel_format(wanted.parse().map_err(|_| refuse())?);
    if let Some(size) = request.mode.size {
        stream.set_size(::libcamera::geometry::Size::new(size.width as u32, size.height as u32));
    }
    let asked = stream.get_size();
    // validation may adjust only what was not requested: stride, colour space, number of buffers
    let invalid = configuration.validate().is_invalid();
    let stream = configuration.get(0).ok_or_else(refuse)?;
    let given = stream.get_size();
    let same = format!("{}", stream.get_pixel_format()) == wanted
        && (given.width, given.height) == (asked.width, asked.height);
    if invalid || !same {
        return Err(refuse());
    }
    Ok((configuration, format))
}

/// Controls for the requested exposure, gain, frame rate and synchronization.
///
/// The lensless camera's automatic functions are turned off, because its readings must be comparable with those of the calibration.
/// The camera silently ignores controls that it does not have, so each is looked up first.
fn requested_controls(
    camera: &Device<'_>,
    name: &str,
    request: &Request,
) -> Result<UniquePtr<ControlList>, CameraError> {
    let mode = &request.mode;
    let raw = request.role == Role::Raw;
    let mut list = ControlList::new();
    let has = |id: u32| camera.controls().count(id) > 0;
    let refuse = |control: &'static str, asked: String, allowed: &str| {
        let allowed = allowed.to_owned();
        CameraError::Control { camera: name.to_owned(), control, asked, allowed }
    };
    let check = |id: u32, control: &'static str, asked: f64| {
        let Ok(info) = camera.controls().find(id) else {
            return Err(refuse(control, asked.to_string(), "the camera has no such control"));
        };
        match (number(&info.min()), number(&info.max())) {
            (Some(min), Some(max)) if min < max && !(min..=max).contains(&asked) => {
                Err(refuse(control, asked.to_string(), &format!("allowed: {min} to {max}")))
            }
            _ => Ok(()),
        }
    };
    let fail = |e: String| unavailable(name, e);
    if (raw || mode.exposure_us.is_some() || mode.gain.is_some()) && has(id::<controls::AeEnable>()) {
        set(&mut list, controls::AeEnable(false)).map_err(fail)?;
    }
    if raw && has(id::<controls::AwbEnable>()) {
        set(&mut list, controls::AwbEnable(false)).map_err(fail)?;
    }
    if let Some(time) = mode.exposure_us {
        check(id::<controls::ExposureTime>(), "exposure_us", f64::from(time))?;
        set(&mut list, controls::ExposureTime(time.round() as i32)).map_err(fail)?;
    }
    if let Some(gain) = mode.gain {
        check(id::<controls::AnalogueGain>(), "gain", f64::from(gain))?;
        set(&mut list, controls::AnalogueGain(gain)).map_err(fail)?;
    }
    if let Some(rate) = request.frame_rate.filter(|_| mode.sync != Sync::Clock) {
        let period = (1e6 / rate).round();
        if !has(id::<controls::FrameDurationLimits>()) {
            return Err(refuse("frame_rate", rate.to_string(), "the camera has no such control"));
        }
        set(&mut list, controls::FrameDurationLimits([period as i64; 2])).map_err(fail)?;
    }
    let sync = match mode.sync {
        Sync::Server => Some((1i32, "server")),
        Sync::Client => Some((2, "client")),
        Sync::Off | Sync::Clock => None,
    };
    if let Some((value, word)) = sync {
        let id = named_control(camera, "SyncMode").filter(|id| has(*id));
        let id = id.ok_or_else(|| refuse("sync", word.to_owned(), "the camera has no software synchronization"))?;
        list.set_raw(id, ControlValue::from(value)).map_err(|e| fail(e.to_string()))?;
    }
    Ok(list)
}

fn set<C: Control>(list: &mut ControlList, value: C) -> Result<(), String> {
    list.set(value).map_err(|e| e.to_string())
}

fn id<C: Control>() -> u32 {
    C::ID
}

/// Id of a control by its name, for controls that not every build of libcamera has.
fn named_control(camera: &Device<'_>, name: &str) -> Option<u32> {
    let list = ControlList::from_info_map(camera.controls())?;
    list.id_map()?.iter()?.find(|(_, control)| control.name() == name).map(|(id, _)| id)
}

fn number(value: &ControlValue) -> Option<f64> {
    match value {
        ControlValue::Int32(v) => v.first().map(|v| f64::from(*v)),
        ControlValue::Int64(v) => v.first().map(|v| *v as f64),
        ControlValue::Float(v) => v.first().map(|v| f64::from(*v)),
        _ => None,
    }
}

/// Allocates memory for `count` frames: by libcamera or, where it has no DMA heap, as ordinary memory.
fn allocate(
    camera: &Device<'_>,
    stream: &Stream,
    format: PixelFormat,
    size: Size,
    stride_bytes: usize,
    count: u32,
) -> io::Result<Vec<FrameMemory>> {
    match FrameBufferAllocator::new(camera).alloc(stream) {
        Ok(buffers) if !buffers.is_empty() => return Ok(buffers.into_iter().map(FrameMemory::Allocated).collect()),
        Ok(_) => {}
        Err(e) => tracing::debug!("{}: frames use ordinary memory, libcamera cannot allocate any: {e}", camera.id()),
    }
    let image = stride_bytes * size.height;
    let planes = match format {
        PixelFormat::Nv12Luma | PixelFormat::Nv12Rgb => vec![image, stride_bytes * size.height.div_ceil(2)],
        _ => vec![image],
    };
    (0..count).map(|_| FrameMemory::ordinary(&planes)).collect()
}

/// Finds the camera `source` and acquires it for this process; returns it with its id.
fn acquire(lease: &ManagerLease, source: &str) -> Result<(Movable<ActiveCamera<'static>>, String), CameraError> {
    let device = lease.with(|manager| find(manager, source));
    let device = device.ok_or_else(|| unavailable(source, "the camera manager has ended"))??;
    let name = device.id().to_owned();
    let camera = device.acquire().map_err(|e| match e.kind() {
        io::ErrorKind::ResourceBusy => {
            unavailable(&name, "in use by another program, or already opened as the other camera")
        }
        _ => unavailable(&name, e.to_string()),
    })?;
    Ok((Movable(camera), name))
}

/// Makes a request for each buffer, and maps the buffers; a request's cookie is the index of its mapping. `needed` is the size of a
/// frame in bytes.
///
/// # Errors
/// The reason why a buffer is not usable.
fn make_requests(
    camera: &mut ActiveCamera<'static>,
    stream: &Stream,
    memories: Vec<FrameMemory>,
    needed: usize,
) -> Result<(Vec<DriverRequest>, Vec<Mapping>), String> {
    let fail = |e: io::Error| format!("a frame buffer is not usable: {e}");
    let (mut requests, mut mappings) = (Vec::new(), Vec::new());
    for (cookie, memory) in memories.into_iter().enumerate() {
        let mapping = memory.mapping().map_err(fail)?;
        let found = mapping.capacity();
        if found < needed {
            return Err(format!("a frame buffer has {found} bytes in one piece, {needed} are needed"));
        }
        mappings.push(mapping);
        let mut request = camera.create_request(Some(cookie as u64)).ok_or("libcamera makes no request")?;
        memory.give_to(&mut request, stream).map_err(fail)?;
        requests.push(request);
    }
    Ok((requests, mappings))
}

impl LibCamera {
    fn open(request: &Request) -> Result<Self, CameraError> {
        let lease = lease()?;
        let (mut camera, name) = acquire(&lease, &request.source)?;
        let (mut configuration, format) = configure(&camera, &name, request)?;
        camera.configure(&mut configuration).map_err(|e| unavailable(&name, format!("{}: {e}", format.name())))?;
        let controls = requested_controls(&camera, &name, request)?;
        let stream = configuration.get(0).ok_or_else(|| unavailable(&name, "no stream"))?;
        let (stride_bytes, size) = (stream.get_stride() as usize, stream.get_size());
        let size = Size::new(size.width as usize, size.height as usize);
        let stream = stream.stream().ok_or_else(|| unavailable(&name, "no stream"))?;

        let (sender, events) = mpsc::channel();
        let disconnected = sender.clone();
        // sending fails only after the receiver was dropped
        camera.on_disconnected(move || drop(disconnected.send(Event::Disconnected)));
        camera.on_request_completed(move |request| drop(sender.send(Event::Done(request))));

        let count = configuration.get(0).map_or(4, |stream| stream.get_buffer_count()).max(1);
        let memories = allocate(&camera, &stream, format, size, stride_bytes, count)
            .map_err(|e| unavailable(&name, format!("no memory for frames: {e}")))?;
        let needed = stride_bytes * (format.rows(size.height) - 1) + format.row_bytes(size.width);
        let (requests, mappings) =
            make_requests(&mut camera, &stream, memories, needed).map_err(|reason| unavailable(&name, reason))?;
        camera.start(Some(&controls)).map_err(|e| unavailable(&name, format!("does not start: {e}")))?;
        let trigger = match (request.mode.sync, request.frame_rate) {
            (Sync::Clock, Some(rate)) => Some((request.clock.join(), Duration::from_secs_f64(1.0 / rate))),
            _ => None,
        };
        let (backend, frame_rate) = ("libcamera", request.frame_rate);
        let mut opened = Self {
            info: CameraInfo { name, backend, format, size, frame_rate },
            events,
            lent: None,
            idle: Vec::new(),
            mappings,
            stream,
            stride_bytes,
            trigger,
            camera,
            _lease: lease,
        };
        for request in requests {
            opened.give_back(request)?;
        }
        Ok(opened)
    }

    fn lost(&self, reason: impl Into<String>) -> CameraError {
        CameraError::Lost { camera: self.info.name.clone(), reason: reason.into() }
    }

    /// Queues a request to the driver or, with a clock, keeps it until the next tick.
    fn give_back(&mut self, request: DriverRequest) -> Result<(), CameraError> {
        if self.trigger.is_some() {
            self.idle.push(request);
            return Ok(());
        }
        self.queue(request)
    }

    fn queue(&self, request: DriverRequest) -> Result<(), CameraError> {
        self.camera.queue_request(request).map_err(|(_, e)| self.lost(format!("accepts no more requests: {e}")))
    }

    /// Waits for the next request that holds a frame.
    fn complete(&mut self, until: Instant, timeout: Duration) -> Result<DriverRequest, CameraError> {
        loop {
            let left = until.saturating_duration_since(Instant::now());
            let mut request = match self.events.recv_timeout(left) {
                Ok(Event::Done(request)) => request,
                Ok(Event::Disconnected) => return Err(self.lost("unplugged")),
                Err(RecvTimeoutError::Disconnected) => return Err(self.lost("libcamera has ended")),
                Err(RecvTimeoutError::Timeout) => {
                    return Err(CameraError::Timeout { camera: self.info.name.clone(), after: timeout });
                }
            };
            if request.status() == RequestStatus::Cancelled {
                return Err(self.lost("the driver cancelled a request"));
            }
            let state = FrameMemory::metadata(&request, &self.stream).map(|m| (m.status(), u64::from(m.sequence())));
            match state {
                Some((FrameMetadataStatus::Success, _)) => return Ok(request),
                // the first frames of some sensors do not have the requested exposure yet
                Some((FrameMetadataStatus::Startup, _)) => {
                    request.reuse(ReuseFlag::REUSE_BUFFERS);
                    self.queue(request)?;
                }
                Some((FrameMetadataStatus::Cancelled, _)) => return Err(self.lost("the driver cancelled a frame")),
                state => {
                    request.reuse(ReuseFlag::REUSE_BUFFERS);
                    self.give_back(request)?;
                    let (camera, sequence) = (self.info.name.clone(), state.map_or(0, |(_, sequence)| sequence));
                    let what = "the driver marks it as faulty".to_owned();
                    return Err(CameraError::Damaged { camera, sequence, what });
                }
            }
        }
    }
}

impl Camera for LibCamera {
    fn info(&self) -> &CameraInfo {
        &self.info
    }

    fn next_frame(&mut self, timeout: Duration) -> Result<Frame<'_>, CameraError> {
        let until = Instant::now() + timeout;
        if let Some(mut request) = self.lent.take() {
            self.mappings[request.cookie() as usize].end();
            request.reuse(ReuseFlag::REUSE_BUFFERS);
            self.give_back(request)?;
        }
        if let Some((trigger, period)) = &mut self.trigger {
            if trigger.next(*period, timeout).is_none() {
                return Err(CameraError::Timeout { camera: self.info.name.clone(), after: timeout });
            }
            if let Some(request) = self.idle.pop() {
                self.queue(request)?;
            }
        }
        let request = self.complete(until, timeout)?;
        let CameraInfo { format, size, .. } = self.info;
        let request = self.lent.insert(request);
        let mapping = &self.mappings[request.cookie() as usize];
        mapping.begin();
        let mut metadata = Metadata::default();
        let mut used = 0;
        if let Some(found) = FrameMemory::metadata(request, &self.stream) {
            metadata.sequence = u64::from(found.sequence());
            metadata.timestamp = Duration::from_nanos(found.timestamp());
            used = found.planes().into_iter().map(|plane| plane.bytes_used as usize).sum();
        }
        let reported = request.metadata();
        if let Ok(time) = reported.get::<controls::SensorTimestamp>() {
            metadata.timestamp = Duration::from_nanos(time.0.max(0) as u64);
        }
        metadata.exposure_us = reported.get::<controls::ExposureTime>().ok().map(|time| time.0 as f32);
        let digital = reported.get::<controls::DigitalGain>().map_or(1.0, |gain| gain.0);
        metadata.gain = reported.get::<controls::AnalogueGain>().ok().map(|gain| gain.0 * digital);
        metadata.temperature_c = reported.get::<controls::SensorTemperature>().ok().map(|t| t.0);
        let bytes = mapping.bytes(request);
        let bytes = &bytes[..bytes.len().min(used)];
        Frame::new(bytes, format, size, self.stride_bytes, metadata)
            .map_err(|source| CameraError::Frame { camera: self.info.name.clone(), source })
    }
}

impl Drop for LibCamera {
    fn drop(&mut self) {
        // requests return from the driver, so that none outlives the camera
        if let Err(e) = self.camera.stop() {
            tracing::warn!("{}: does not stop: {e}", self.info.name);
        }
    }
}

#[cfg(test)]
mod tests;
