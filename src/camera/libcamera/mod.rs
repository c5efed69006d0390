//! Cameras of libcamera: sensors on a camera connector, with or without an ISP, and USB cameras.
//!
//! The frames are requests: each has one buffer, goes to the driver, comes back complete through libcamera's own thread,
//! is lent, and goes again. Raw formats come as the sensor gives them, past the ISP.

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

use self::memory::{Mapping, Memory, Movable};
use super::{Camera, CameraError, CameraInfo, Offer, OfferedMode, Request, Role, clock::Trigger, preferred};
use crate::board::Sync;
use stokescope_core::frame::{Bayer, Frame, Metadata, PixelFormat, Samples};
use stokescope_core::image::Size;

/// The one camera manager a process may have, and how many use it.
static MANAGER: Mutex<(usize, Option<Movable<CameraManager>>)> = Mutex::new((0, None));

/// A use of the camera manager, which ends with the last one: opened anew, it looks for cameras again.
struct Lease;

impl Lease {
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

impl Drop for Lease {
    fn drop(&mut self) {
        let mut manager = MANAGER.lock().unwrap_or_else(PoisonError::into_inner);
        manager.0 -= 1;
        if manager.0 == 0 {
            manager.1 = None;
        }
    }
}

/// What libcamera calls a format.
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
        // named from the highest byte of a word down, as graphics do: in memory red comes first
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

/// What a stream of `role` can be; nothing where the camera has no such stream.
fn modes(camera: &Device<'_>, role: StreamRole) -> Vec<OfferedMode> {
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
        OfferedMode { formats: formats_of(&driver_name).map(PixelFormat::name).collect(), driver_name, sizes }
    };
    let found = formats.pixel_formats();
    (0..found.len()).filter_map(|i| found.get(i)).map(mode).collect()
}

fn all_modes(camera: &Device<'_>) -> Vec<OfferedMode> {
    let mut found = modes(camera, StreamRole::Raw);
    for mode in modes(camera, StreamRole::VideoRecording) {
        if !found.contains(&mode) {
            found.push(mode);
        }
    }
    found
}

/// Every camera libcamera knows.
///
/// # Errors
/// [`CameraError::Backend`] when there is no camera manager.
pub(super) fn list() -> Result<Vec<Offer>, CameraError> {
    let lease = lease()?;
    let offer = |camera: &Device<'_>| {
        let model = camera.properties().get::<properties::Model>().map_or_else(|_| "camera".to_owned(), |m| m.0);
        Offer { source: camera.id().to_owned(), description: model, modes: all_modes(camera) }
    };
    let mut offers: Vec<Offer> = lease
        .with(|manager| {
            let cameras = manager.cameras();
            (0..cameras.len()).filter_map(|i| cameras.get(i)).map(|camera| offer(&camera)).collect()
        })
        .unwrap_or_default();
    offers.sort_by(|a, b| a.source.cmp(&b.source));
    Ok(offers)
}

fn lease() -> Result<Lease, CameraError> {
    Lease::new().map_err(|e| CameraError::Backend { name: "libcamera".to_owned(), reason: e.to_string() })
}

/// What libcamera's thread reports.
enum Event {
    /// A request came back.
    Done(DriverRequest),
    /// The camera was unplugged.
    Gone,
}

/// A streaming camera. Its fields go in this order: requests, before the camera they belong to, before the manager.
struct LibCamera {
    info: CameraInfo,
    events: Receiver<Event>,
    /// The frame that is lent.
    lent: Option<DriverRequest>,
    /// Requests that wait for the clock.
    idle: Vec<DriverRequest>,
    /// By the requests' cookies.
    mappings: Vec<Mapping>,
    stream: Stream,
    stride_bytes: usize,
    /// With [`Sync::Clock`]: when to ask for frames.
    trigger: Option<(Trigger, Duration)>,
    camera: Movable<ActiveCamera<'static>>,
    /// Keeps the manager.
    _lease: Lease,
}

/// Opens the camera whose id is or contains `request.source`.
///
/// # Errors
/// [`CameraError`] when there is none or several, it is in use, or does not have the mode or a control.
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
        _ => return Err(unavailable(source, format!("several cameras are called so: {}", ids.join(", ")))),
    };
    all.into_iter().nth(index).ok_or_else(|| unavailable(source, "no such camera"))
}

/// The configuration with exactly the mode that was asked for, and its format.
fn configure(
    camera: &Device<'_>,
    name: &str,
    request: &Request,
) -> Result<(CameraConfiguration, PixelFormat), CameraError> {
    let refuse = || {
        let describe = |mode: &OfferedMode| format!("{} {}", mode.formats.join(" or "), mode.sizes.join(", "));
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
    // what it may adjust is what was not asked for: stride, colour space, number of buffers
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

/// Fixes exposure, gain and frame rate as asked; for the lensless camera automatic functions go off where there are any, since
/// readings of one frame and those of the calibration must mean the same. The list takes any control and the camera ignores
/// those it does not have, so each is looked for first.
fn settings(camera: &Device<'_>, name: &str, request: &Request) -> Result<UniquePtr<ControlList>, CameraError> {
    let mode = &request.mode;
    let raw = request.role == Role::Raw;
    let mut list = ControlList::new();
    fn set<C: Control>(list: &mut ControlList, value: C) -> Result<(), String> {
        list.set(value).map_err(|e| e.to_string())
    }
    let has = |id: u32| camera.controls().count(id) > 0;
    let refuse = |control: &'static str, asked: String, allowed: &str| {
        let allowed = allowed.to_owned();
        CameraError::Control { camera: name.to_owned(), control, asked, allowed }
    };
    let need = |id: u32, control: &'static str, asked: f64| {
        let Ok(info) = camera.controls().find(id) else {
            return Err(refuse(control, asked.to_string(), "it has no such control"));
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
        need(id::<controls::ExposureTime>(), "exposure_us", f64::from(time))?;
        set(&mut list, controls::ExposureTime(time.round() as i32)).map_err(fail)?;
    }
    if let Some(gain) = mode.gain {
        need(id::<controls::AnalogueGain>(), "gain", f64::from(gain))?;
        set(&mut list, controls::AnalogueGain(gain)).map_err(fail)?;
    }
    if let Some(rate) = request.frame_rate.filter(|_| mode.sync != Sync::Clock) {
        let period = (1e6 / rate).round();
        if !has(id::<controls::FrameDurationLimits>()) {
            return Err(refuse("frame_rate", rate.to_string(), "it cannot be set"));
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
        let id = id.ok_or_else(|| refuse("sync", word.to_owned(), "it has no software synchronization"))?;
        list.set_raw(id, ControlValue::from(value)).map_err(|e| fail(e.to_string()))?;
    }
    Ok(list)
}

fn id<C: Control>() -> u32 {
    C::ID
}

/// A control that not every build of libcamera has, by its name.
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

/// Memory for `count` frames: libcamera's own or, where it has none to give (no DMA heap), ordinary memory.
fn buffers(
    camera: &Device<'_>,
    stream: &Stream,
    format: PixelFormat,
    size: Size,
    stride_bytes: usize,
    count: u32,
) -> io::Result<Vec<Memory>> {
    match FrameBufferAllocator::new(camera).alloc(stream) {
        Ok(buffers) if !buffers.is_empty() => return Ok(buffers.into_iter().map(Memory::Allocated).collect()),
        Ok(_) => {}
        Err(e) => tracing::debug!("{}: frames lie in ordinary memory, libcamera has none: {e}", camera.id()),
    }
    let image = stride_bytes * size.height;
    let planes = match format {
        PixelFormat::Nv12Luma | PixelFormat::Nv12Rgb => vec![image, stride_bytes * size.height.div_ceil(2)],
        _ => vec![image],
    };
    (0..count).map(|_| Memory::ordinary(&planes)).collect()
}

impl LibCamera {
    fn open(request: &Request) -> Result<Self, CameraError> {
        let lease = lease()?;
        let device = lease.with(|manager| find(manager, &request.source));
        let device = device.ok_or_else(|| unavailable(&request.source, "the camera manager has ended"))??;
        let name = device.id().to_owned();
        let mut camera = Movable(device.acquire().map_err(|e| match e.kind() {
            io::ErrorKind::ResourceBusy => {
                unavailable(&name, "in use by another program, or already opened as the other camera")
            }
            _ => unavailable(&name, e.to_string()),
        })?);
        let (mut configuration, format) = configure(&camera, &name, request)?;
        camera.configure(&mut configuration).map_err(|e| unavailable(&name, format!("{}: {e}", format.name())))?;
        let settings = settings(&camera, &name, request)?;
        let stream = configuration.get(0).ok_or_else(|| unavailable(&name, "no stream"))?;
        let (stride_bytes, size) = (stream.get_stride() as usize, stream.get_size());
        let size = Size::new(size.width as usize, size.height as usize);
        let stream = stream.stream().ok_or_else(|| unavailable(&name, "no stream"))?;

        let (sender, events) = mpsc::channel();
        let gone = sender.clone();
        // once nobody listens any more, there is nothing to report
        camera.on_disconnected(move || drop(gone.send(Event::Gone)));
        camera.on_request_completed(move |request| drop(sender.send(Event::Done(request))));

        let count = configuration.get(0).map_or(4, |stream| stream.get_buffer_count()).max(1);
        let (mut requests, mut mappings) = (Vec::new(), Vec::new());
        for (cookie, memory) in buffers(&camera, &stream, format, size, stride_bytes, count)
            .map_err(|e| unavailable(&name, format!("no memory for frames: {e}")))?
            .into_iter()
            .enumerate()
        {
            let fail = |e: io::Error| unavailable(&name, format!("a frame's memory cannot be used: {e}"));
            let mapping = memory.mapping().map_err(fail)?;
            let needed = stride_bytes * (format.rows(size.height) - 1) + format.row_bytes(size.width);
            if mapping.capacity() < needed {
                let found = mapping.capacity();
                let reason = format!("{} lies in {found} bytes in one piece, {needed} are needed", format.name());
                return Err(unavailable(&name, reason));
            }
            mappings.push(mapping);
            let mut request =
                camera.create_request(Some(cookie as u64)).ok_or_else(|| unavailable(&name, "no request"))?;
            memory.give_to(&mut request, &stream).map_err(fail)?;
            requests.push(request);
        }
        camera.start(Some(&settings)).map_err(|e| unavailable(&name, format!("does not start: {e}")))?;
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

    /// Gives a request back to the driver or, with a clock, keeps it until the next tick.
    fn give_back(&mut self, request: DriverRequest) -> Result<(), CameraError> {
        if self.trigger.is_some() {
            self.idle.push(request);
            return Ok(());
        }
        self.queue(request)
    }

    fn queue(&self, request: DriverRequest) -> Result<(), CameraError> {
        self.camera.queue_request(request).map_err(|(_, e)| self.lost(format!("takes no more requests: {e}")))
    }

    /// Waits for the next request that holds a frame.
    fn complete(&mut self, until: Instant, timeout: Duration) -> Result<DriverRequest, CameraError> {
        loop {
            let left = until.saturating_duration_since(Instant::now());
            let mut request = match self.events.recv_timeout(left) {
                Ok(Event::Done(request)) => request,
                Ok(Event::Gone) => return Err(self.lost("unplugged")),
                Err(RecvTimeoutError::Disconnected) => return Err(self.lost("libcamera has ended")),
                Err(RecvTimeoutError::Timeout) => {
                    return Err(CameraError::Timeout { camera: self.info.name.clone(), after: timeout });
                }
            };
            if request.status() == RequestStatus::Cancelled {
                return Err(self.lost("the driver gave up"));
            }
            let state = Memory::metadata(&request, &self.stream).map(|m| (m.status(), u64::from(m.sequence())));
            match state {
                Some((FrameMetadataStatus::Success, _)) => return Ok(request),
                // the first frames of some sensors, before they are exposed as asked
                Some((FrameMetadataStatus::Startup, _)) => {
                    request.reuse(ReuseFlag::REUSE_BUFFERS);
                    self.queue(request)?;
                }
                Some((FrameMetadataStatus::Cancelled, _)) => return Err(self.lost("the driver gave up a frame")),
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
        if let Some(found) = Memory::metadata(request, &self.stream) {
            metadata.sequence = u64::from(found.sequence());
            metadata.timestamp = Duration::from_nanos(found.timestamp());
            used = found.planes().into_iter().map(|plane| plane.bytes_used as usize).sum();
        }
        let said = request.metadata();
        if let Ok(time) = said.get::<controls::SensorTimestamp>() {
            metadata.timestamp = Duration::from_nanos(time.0.max(0) as u64);
        }
        metadata.exposure_us = said.get::<controls::ExposureTime>().ok().map(|time| time.0 as f32);
        let digital = said.get::<controls::DigitalGain>().map_or(1.0, |gain| gain.0);
        metadata.gain = said.get::<controls::AnalogueGain>().ok().map(|gain| gain.0 * digital);
        metadata.temperature_c = said.get::<controls::SensorTemperature>().ok().map(|t| t.0);
        let bytes = mapping.bytes(request);
        let bytes = &bytes[..bytes.len().min(used)];
        Frame::new(bytes, format, size, self.stride_bytes, metadata)
            .map_err(|source| CameraError::Frame { camera: self.info.name.clone(), source })
    }
}

impl Drop for LibCamera {
    fn drop(&mut self) {
        // requests that are with the driver come back, so that none outlives the camera
        if let Err(e) = self.camera.stop() {
            tracing::warn!("{}: does not stop: {e}", self.info.name);
        }
    }
}

#[cfg(test)]
mod tests;
