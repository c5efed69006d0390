//! The calls of libcamera: lists, configures and reads cameras.
//!
//! Every frame belongs to a request with one buffer. The request is queued to the driver, returns complete through libcamera's own
//! thread, is lent to the caller, and is queued again. Raw formats are delivered as the sensor sends them, without the ISP.

use std::{
    io,
    sync::{
        Mutex, PoisonError,
        mpsc::{self, Receiver, RecvTimeoutError},
    },
    time::{Duration, Instant},
};

use ::libcamera::{
    camera::{ActiveCamera, Camera as Device, CameraConfiguration, Orientation, SensorConfiguration},
    camera_manager::CameraManager,
    control::{Control, ControlInfo, ControlList},
    control_value::ControlValue,
    controls,
    framebuffer::FrameMetadataStatus,
    framebuffer_allocator::FrameBufferAllocator,
    properties,
    request::{Request as DriverRequest, RequestStatus, ReuseFlag},
    stream::{Stream, StreamRole},
    utils::UniquePtr,
};

use super::formats::{driver_name, formats_of};
use super::memory::{FrameMemory, Mapping, Movable};
use super::names::{self, Identity};
use super::raw_stream::{self, Answer, Ask, Delivered, Listed, Pipeline, Refusal, Wanted};
use super::sync::{NO_SYNC, Progress, Synchronization};
use crate::board::Sync;
use crate::camera::{
    AvailableCamera, AvailableMode, Camera, CameraError, CameraInfo, Limits, Request, Role, clock::Trigger, preferred,
};
use stokescope_core::frame::{Frame, Metadata, PixelFormat};
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

/// Whether a frame of `format` holds the readings of the sensor.
fn is_raw(format: PixelFormat) -> bool {
    matches!(format, PixelFormat::Mono(_) | PixelFormat::Bayer(..))
}

/// Formats of a stream of `role` with their sizes, or the largest of a range of sizes; empty where the camera has no such stream.
fn listed(camera: &Device<'_>, role: StreamRole) -> Vec<(AvailableMode, Listed)> {
    let configuration = camera.generate_configuration(&[role]);
    let Some(stream) = configuration.as_ref().and_then(|c| c.get(0)) else { return Vec::new() };
    let formats = stream.formats();
    let own = |size: ::libcamera::geometry::Size| Size::new(size.width as usize, size.height as usize);
    let mode = |format| {
        let driver_name = format!("{format}");
        let mut sizes: Vec<Size> = formats.sizes(format).into_iter().map(own).collect();
        let mut words: Vec<String> = sizes.iter().map(Size::to_string).collect();
        if sizes.is_empty() {
            let range = formats.range(format);
            words.push(format!("{} to {}", own(range.min), own(range.max)));
            sizes.push(own(range.max));
        }
        let names = formats_of(&driver_name).map(PixelFormat::name).collect();
        let listed = Listed { name: driver_name.clone(), sizes };
        (AvailableMode { driver_name, formats: names, bits: None, sizes: words }, listed)
    };
    let found = formats.pixel_formats();
    (0..found.len()).filter_map(|i| found.get(i)).map(mode).collect()
}

/// The raw modes that libcamera lists, and the kind of pipeline handler that delivers them.
fn raw_modes(camera: &Device<'_>) -> (Vec<Listed>, Pipeline) {
    let listed: Vec<Listed> = listed(camera, StreamRole::Raw).into_iter().map(|(_, listed)| listed).collect();
    let mut pipeline = Pipeline::Unicam;
    let readable = listed.iter().find(|listed| formats_of(&listed.name).next().is_some());
    if let (Some(first), Some(mut configuration)) = (readable, camera.generate_configuration(&[StreamRole::Raw])) {
        if let (Some(mut stream), Ok(format)) = (configuration.get_mut(0), first.name.parse()) {
            stream.set_pixel_format(format);
        }
        configuration.validate();
        let answered = configuration.get(0).map(|stream| format!("{}", stream.get_pixel_format()));
        pipeline = Pipeline::of(&first.name, &answered.unwrap_or_default());
    }
    (listed, pipeline)
}

/// Asks for a rotation in degrees; `None` leaves the default.
fn orient(configuration: &mut CameraConfiguration, degrees: Option<u32>) {
    match degrees {
        Some(0) => configuration.set_orientation(Orientation::Rotate0),
        Some(180) => configuration.set_orientation(Orientation::Rotate180),
        _ => {}
    }
}

/// Rotation in degrees; `None` for a mirrored or transposed picture.
fn orientation(configuration: &CameraConfiguration) -> Option<u32> {
    match configuration.orientation() {
        Orientation::Rotate0 => Some(0),
        Orientation::Rotate180 => Some(180),
        _ => None,
    }
}

/// Makes a configuration of what `ask` says and validates it; returns it with what libcamera made of it.
fn validated(camera: &Device<'_>, ask: &Ask) -> Option<(CameraConfiguration, Answer)> {
    let mut configuration = camera.generate_configuration(&[StreamRole::Raw])?;
    let (width, height) = (ask.size.width as u32, ask.size.height as u32);
    let mut stream = configuration.get_mut(0)?;
    stream.set_pixel_format(driver_name(ask.format)?.parse().ok()?);
    stream.set_size(::libcamera::geometry::Size::new(width, height));
    // without it libcamera takes the mode whose bit depth is nearest to that of the format
    let mut mode = SensorConfiguration::new();
    mode.set_bit_depth(ask.bits);
    mode.set_output_size(width, height);
    configuration.set_sensor_configuration(mode);
    orient(&mut configuration, ask.orientation);
    let valid = !configuration.validate().is_invalid();
    let orientation = orientation(&configuration);
    let stream = configuration.get(0)?;
    let size = stream.get_size();
    let size = Size::new(size.width as usize, size.height as usize);
    let answer = Answer { valid, format: format!("{}", stream.get_pixel_format()), size, orientation };
    Some((configuration, answer))
}

/// Modes that can be had: raw modes as they are delivered without loss, and the formats of the ISP or of a USB camera.
fn all_modes(camera: &Device<'_>) -> Vec<AvailableMode> {
    let (raw, pipeline) = raw_modes(camera);
    let mut found: Vec<AvailableMode> = Vec::new();
    for ask in raw_stream::every(&raw, pipeline) {
        let Some(Ok(delivered)) = validated(camera, &ask).map(|(_, answer)| raw_stream::judge(&ask, &answer)) else {
            continue;
        };
        let Delivered { format, size, bits } = delivered;
        let (driver_name, bits) = (driver_name(format).unwrap_or_default(), Some(bits));
        match found.iter_mut().find(|mode| (&mode.driver_name, mode.bits) == (&driver_name, bits)) {
            Some(mode) => mode.sizes.push(size.to_string()),
            None => {
                let (formats, sizes) = (vec![format.name()], vec![size.to_string()]);
                found.push(AvailableMode { driver_name, formats, bits, sizes });
            }
        }
    }
    let known: Vec<String> = raw.into_iter().map(|listed| listed.name).collect();
    let others = listed(camera, StreamRole::VideoRecording).into_iter().map(|(mode, _)| mode);
    found.extend(others.filter(|mode| !known.contains(&mode.driver_name)));
    found
}

/// Lists all cameras of libcamera.
///
/// # Errors
/// [`CameraError::Backend`] when there is no camera manager.
pub(in crate::camera) fn list() -> Result<Vec<AvailableCamera>, CameraError> {
    let lease = lease()?;
    let offer = |(place, camera): (usize, Device<'_>)| {
        let Identity { id, model } = identity(&camera);
        AvailableCamera { source: id, description: format!("{model}, place {place}"), modes: all_modes(&camera) }
    };
    let offers = lease.with(|manager| by_place(manager).into_iter().enumerate().map(offer).collect());
    Ok(offers.unwrap_or_default())
}

fn identity(camera: &Device<'_>) -> Identity {
    let model = camera.properties().get::<properties::Model>().map_or_else(|_| "camera".to_owned(), |m| m.0);
    Identity { id: camera.id().to_owned(), model }
}

/// All cameras, sorted by place.
fn by_place(manager: &CameraManager) -> Vec<Device<'static>> {
    let cameras = manager.cameras();
    let mut all: Vec<_> = (0..cameras.len()).filter_map(|i| cameras.get(i)).collect();
    names::sort_by_place(&mut all, |camera| camera.id());
    all
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
    /// The raw stream until its black level has been compared with the one that libcamera reports.
    unchecked: Option<Delivered>,
    events: Receiver<Event>,
    /// Request of the frame that is lent.
    lent: Option<DriverRequest>,
    /// Requests that wait for the clock; empty without one.
    idle: Vec<DriverRequest>,
    /// Frame buffers, indexed by the cookies of the requests.
    mappings: Vec<Mapping>,
    stream: Stream,
    stride_bytes: usize,
    /// Software synchronization that is not yet reached.
    synchronizing: Option<Synchronization>,
    /// Clock and frame interval with [`Sync::Clock`].
    trigger: Option<(Trigger, Duration)>,
    camera: Movable<ActiveCamera<'static>>,
    /// Keeps the camera manager alive.
    _lease: ManagerLease,
}

/// Opens the camera that `request.source` names by its place, sensor or id.
///
/// # Errors
/// [`CameraError`] when no or several cameras match, or the camera is in use or does not have the mode or a control.
pub(in crate::camera) fn open(request: &Request) -> Result<Box<dyn Camera>, CameraError> {
    Ok(Box::new(LibCamera::open(request)?))
}

fn unavailable(camera: &str, reason: impl Into<String>) -> CameraError {
    CameraError::Unavailable { camera: camera.to_owned(), reason: reason.into() }
}

fn find(manager: &CameraManager, source: &str) -> Result<Device<'static>, CameraError> {
    let all = by_place(manager);
    let identities: Vec<Identity> = all.iter().map(identity).collect();
    let index = names::find(source, &identities).map_err(|reason| unavailable(source, reason))?;
    all.into_iter().nth(index).ok_or_else(|| unavailable(source, "no such camera"))
}

/// The error for a mode that the camera does not have.
fn no_mode(camera: &Device<'_>, name: &str, request: &Request) -> CameraError {
    let describe = |mode: &AvailableMode| {
        let bits = mode.bits.map_or_else(String::new, |bits| format!(" of {bits} bits"));
        format!("{}{bits} {}", mode.formats.join(" or "), mode.sizes.join(", "))
    };
    let offered: Vec<_> = all_modes(camera).iter().filter(|m| !m.formats.is_empty()).map(describe).collect();
    let offered = if offered.is_empty() { "no format that is supported".to_owned() } else { offered.join("; ") };
    CameraError::Mode { camera: name.to_owned(), asked: request.mode.to_string(), offered }
}

/// A configuration and the frames that it delivers.
struct Configured {
    configuration: CameraConfiguration,
    format: PixelFormat,
    /// The raw stream; `None` for a stream of the ISP or of a USB camera.
    raw: Option<Delivered>,
}

/// Makes a configuration of the requested mode.
fn configure(camera: &Device<'_>, name: &str, request: &Request) -> Result<Configured, CameraError> {
    let (listed, pipeline) = raw_modes(camera);
    let readable = listed.iter().any(|listed| formats_of(&listed.name).next().is_some());
    let raw = request.mode.format.map_or(request.role == Role::Raw && readable, is_raw);
    if !raw {
        return configure_processed(camera, request).ok_or_else(|| no_mode(camera, name, request));
    }
    let fail = |refusal| match refusal {
        Refusal::NoMode => no_mode(camera, name, request),
        other => CameraError::Stream { camera: name.to_owned(), reason: other.to_string() },
    };
    let (mode, orientation) = (&request.mode, request.orientation);
    let wanted = Wanted { format: mode.format, bits: mode.bits, size: mode.size, orientation };
    let ask = raw_stream::choose(&listed, pipeline, &wanted).map_err(fail)?;
    let (configuration, answer) = validated(camera, &ask).ok_or_else(|| fail(Refusal::NoMode))?;
    let delivered = raw_stream::judge(&ask, &answer).map_err(fail)?;
    let Delivered { format, size, bits } = delivered;
    tracing::info!("{name}: mode {size} of {bits} bits, delivered as {}", format.name());
    Ok(Configured { configuration, format, raw: Some(delivered) })
}

/// Makes a configuration of exactly the requested format and size of the ISP or of a USB camera; `None` if the camera has no such mode.
fn configure_processed(camera: &Device<'_>, request: &Request) -> Option<Configured> {
    let offered = || {
        let modes = listed(camera, StreamRole::VideoRecording).into_iter().flat_map(|(mode, _)| mode.formats);
        preferred(request.role, modes.filter_map(|name| name.parse().ok()))
    };
    let format = request.mode.format.or_else(offered)?;
    let wanted = driver_name(format)?;
    let mut configuration = camera.generate_configuration(&[StreamRole::VideoRecording])?;
    let mut stream = configuration.get_mut(0)?;
    stream.set_pixel_format(wanted.parse().ok()?);
    if let Some(size) = request.mode.size {
        stream.set_size(::libcamera::geometry::Size::new(size.width as u32, size.height as u32));
    }
    let asked = stream.get_size();
    orient(&mut configuration, request.orientation);
    // validation may adjust only what was not requested: stride, colour space, number of buffers
    let valid = !configuration.validate().is_invalid();
    let stream = configuration.get(0)?;
    let given = stream.get_size();
    let same = format!("{}", stream.get_pixel_format()) == wanted
        && (given.width, given.height) == (asked.width, asked.height)
        && request.orientation.is_none_or(|degrees| orientation(&configuration) == Some(degrees));
    (valid && same).then_some(Configured { configuration, format, raw: None })
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
        match range(info) {
            Some([min, max]) if !(min..=max).contains(&asked) => {
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

/// Range of the values of a control; none where the camera does not say.
fn range(info: &ControlInfo) -> Option<[f64; 2]> {
    let range = [number(&info.min())?, number(&info.max())?];
    (range[0] < range[1]).then_some(range)
}

/// Ranges of exposure, gain and frame rate. The frame rate of synchronized cameras is not one camera's to
/// change.
fn limits(camera: &Device<'_>, sync: Sync) -> Limits {
    let of = |id: u32| camera.controls().find(id).ok().and_then(range);
    let periods = of(id::<controls::FrameDurationLimits>()).filter(|_| sync == Sync::Off);
    Limits {
        exposure_us: of(id::<controls::ExposureTime>()),
        gain: of(id::<controls::AnalogueGain>()),
        frame_rate: periods.filter(|[least, _]| *least > 0.0).map(|[least, most]| [1e6 / most, 1e6 / least]),
    }
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

/// Finds the camera `source` and acquires it for this process; returns it with its identity.
fn acquire(lease: &ManagerLease, source: &str) -> Result<(Movable<ActiveCamera<'static>>, Identity), CameraError> {
    let device = lease.with(|manager| find(manager, source));
    let device = device.ok_or_else(|| unavailable(source, "the camera manager has ended"))??;
    let identity = identity(&device);
    let name = &identity.id;
    let camera = device.acquire().map_err(|e| match e.kind() {
        io::ErrorKind::ResourceBusy => {
            unavailable(name, "in use by another program, or already opened as the other camera")
        }
        _ => unavailable(name, e.to_string()),
    })?;
    Ok((Movable(camera), identity))
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
        let (mut camera, Identity { id: name, model }) = acquire(&lease, &request.source)?;
        let Configured { mut configuration, format, raw } = configure(&camera, &name, request)?;
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
        let following = matches!(request.mode.sync, Sync::Server | Sync::Client);
        let synchronizing = following.then(|| Synchronization::new(named_control(&camera, "SyncReady")));
        let mut opened = Self {
            info: CameraInfo {
                name,
                backend,
                format,
                size,
                frame_rate,
                levels: raw.map(|raw| raw.levels(&model)),
                readout: raw.and_then(|raw| raw_stream::readout(&model, raw.size)),
                limits: limits(&camera, request.mode.sync),
            },
            synchronizing,
            unchecked: raw,
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

impl LibCamera {
    /// Waits for the next request that holds a frame of synchronized cameras. Frames before that are given back.
    fn synchronized(&mut self, until: Instant, timeout: Duration) -> Result<DriverRequest, CameraError> {
        loop {
            let mut request = self.complete(until, timeout)?;
            let Some(state) = &mut self.synchronizing else { return Ok(request) };
            let reported = |id: u32| request.metadata().into_iter().find(|(found, _)| *found == id);
            let ready = state.id.and_then(reported).and_then(|(_, value)| bool::try_from(value).ok());
            match state.note(ready) {
                Progress::Waits => {
                    request.reuse(ReuseFlag::REUSE_BUFFERS);
                    self.give_back(request)?;
                    if Instant::now() >= until {
                        let camera = self.info.name.clone();
                        return Err(CameraError::Waiting { camera, what: "the synchronization of both cameras" });
                    }
                }
                Progress::Reached => {
                    tracing::info!("{}: synchronized", self.info.name);
                    self.synchronizing = None;
                    return Ok(request);
                }
                Progress::Missing => {
                    tracing::warn!("{}: {NO_SYNC}", self.info.name);
                    self.synchronizing = None;
                    return Ok(request);
                }
            }
        }
    }
}

/// Takes the black level that libcamera reports, and tells when it is not the expected one.
fn note_black_level(info: &mut CameraInfo, reported: f32) {
    let Some(levels) = info.levels.as_mut() else { return };
    let expected = levels.black.replace(reported);
    if expected != Some(reported) {
        tracing::info!("{}: libcamera reports a black level of {reported} counts", info.name);
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
        let request = self.synchronized(until, timeout)?;
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
        if let (Some(raw), Ok(black)) = (self.unchecked, reported.get::<controls::SensorBlackLevels>()) {
            self.unchecked = None;
            note_black_level(&mut self.info, raw.reported_black_level(black.0));
        }
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
