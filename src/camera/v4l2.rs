//! Backend for Video4Linux: USB cameras, capture cards and sensors with a single video device.
//!
//! Supports single-planar devices with mapped buffers; sensors behind a media controller need libcamera. Motion JPEG is decoded for
//! the guide camera only. Frames lie in the driver's buffers, of which one at a time is lent. Time stamps are the driver's, on the
//! system's monotonic clock.

use std::{
    io,
    time::{Duration, Instant},
};

use ::v4l::{
    Device, Format, FourCC, Fraction,
    buffer::{Flags, Type},
    capability::Flags as Capability,
    context,
    control::{Control, Value},
    frameinterval::FrameIntervalEnum,
    framesize::FrameSizeEnum,
    io::{mmap::Stream, traits::CaptureStream},
    parameters::Capabilities,
    v4l_sys::v4l2_query_ext_ctrl,
    v4l2::{ioctl, vidioc::VIDIOC_QUERY_EXT_CTRL},
    video::{Capture, capture::Parameters},
};

use super::{AvailableCamera, AvailableMode, Camera, CameraError, CameraInfo, Limits, Request, Role, mjpeg, preferred};
use crate::board::Sync;
use stokescope_core::frame::{Bayer, Frame, Metadata, PixelFormat, Range, Samples};
use stokescope_core::image::Size;

/// Number of buffers: one is lent, one is being filled, the others cover pauses of the reader.
const BUFFERS: u32 = 4;
/// Largest relative deviation from the requested frame rate.
const RATE_TOLERANCE: f64 = 0.01;

/// Control ids of videodev2.h.
mod id {
    pub(super) const AUTO_WHITE_BALANCE: u32 = 0x0098_090c;
    pub(super) const AUTO_GAIN: u32 = 0x0098_0912;
    pub(super) const GAIN: u32 = 0x0098_0913;
    pub(super) const AUTO_EXPOSURE: u32 = 0x009a_0901;
    /// Exposure time in units of 100 µs.
    pub(super) const EXPOSURE: u32 = 0x009a_0902;
    pub(super) const FLIPS: [u32; 2] = [0x0098_0914, 0x0098_0915];
    pub(super) const ANALOGUE_GAIN: u32 = 0x009e_0903;
    /// Value `manual` of `AUTO_EXPOSURE`.
    pub(super) const MANUAL: i64 = 1;
}

/// Code of Motion JPEG, which is decoded to RGB.
const MJPEG: &[u8; 4] = b"MJPG";

/// Codes of our formats in Video4Linux; NV12 and YUYV serve two formats each, RGB has two codes.
const FORMATS: &[(PixelFormat, &[u8; 4])] = {
    use Bayer::{Bggr, Gbrg, Grbg, Rggb};
    use PixelFormat::{Bayer as Cell, Mono, Nv12Luma, Nv12Rgb, Rgb, Yuyv};
    use Samples::{Packed10, Packed12, U8, U10, U12, U16};
    &[
        (Mono(U8), b"GREY"),
        (Mono(U10), b"Y10 "),
        (Mono(U12), b"Y12 "),
        (Mono(U16), b"Y16 "),
        (Mono(Packed10), b"Y10P"),
        (Mono(Packed12), b"Y12P"),
        (Cell(Rggb, U8), b"RGGB"),
        (Cell(Bggr, U8), b"BA81"),
        (Cell(Grbg, U8), b"GRBG"),
        (Cell(Gbrg, U8), b"GBRG"),
        (Cell(Rggb, U10), b"RG10"),
        (Cell(Bggr, U10), b"BG10"),
        (Cell(Grbg, U10), b"BA10"),
        (Cell(Gbrg, U10), b"GB10"),
        (Cell(Rggb, U12), b"RG12"),
        (Cell(Bggr, U12), b"BG12"),
        (Cell(Grbg, U12), b"BA12"),
        (Cell(Gbrg, U12), b"GB12"),
        (Cell(Rggb, U16), b"RG16"),
        (Cell(Bggr, U16), b"BYR2"),
        (Cell(Grbg, U16), b"GR16"),
        (Cell(Gbrg, U16), b"GB16"),
        (Cell(Rggb, Packed10), b"pRAA"),
        (Cell(Bggr, Packed10), b"pBAA"),
        (Cell(Grbg, Packed10), b"pgAA"),
        (Cell(Gbrg, Packed10), b"pGAA"),
        (Cell(Rggb, Packed12), b"pRCC"),
        (Cell(Bggr, Packed12), b"pBCC"),
        (Cell(Grbg, Packed12), b"pgCC"),
        (Cell(Gbrg, Packed12), b"pGCC"),
        (Rgb(U8), b"RGB3"),
        (Nv12Rgb, b"NV12"),
        (Nv12Luma, b"NV12"),
        (Yuyv(Range::Limited), b"YUYV"),
        (Yuyv(Range::Full), b"YUYV"),
        (Rgb(U8), MJPEG),
    ]
};

fn formats_of(code: FourCC) -> impl Iterator<Item = PixelFormat> {
    FORMATS.iter().filter(move |(_, name)| **name == code.repr).map(|(format, _)| *format)
}

/// Lists all capture devices of the system.
///
/// # Errors
/// None; devices that cannot be queried are left out.
#[allow(clippy::unnecessary_wraps, reason = "other backends can fail")]
pub(super) fn list() -> Result<Vec<AvailableCamera>, CameraError> {
    let mut paths: Vec<_> = context::enum_devices().iter().map(|node| node.path().to_path_buf()).collect();
    paths.sort_by_key(|path| (path.as_os_str().len(), path.clone()));
    let offer = |path: &std::path::PathBuf| {
        let device = Device::with_path(path).ok()?;
        let caps = device.query_caps().ok()?;
        let capture = Capability::VIDEO_CAPTURE | Capability::STREAMING;
        caps.capabilities.contains(capture).then(|| AvailableCamera {
            source: path.display().to_string(),
            description: format!("{} ({}, {})", caps.card, caps.driver, caps.bus),
            modes: modes(&device),
        })
    };
    Ok(paths.iter().filter_map(offer).collect())
}

fn modes(device: &Device) -> Vec<AvailableMode> {
    let sizes = |code| {
        let text = |size: FrameSizeEnum| match size {
            FrameSizeEnum::Discrete(s) => format!("{}×{}", s.width, s.height),
            FrameSizeEnum::Stepwise(s) => {
                format!("{}×{} to {}×{}", s.min_width, s.min_height, s.max_width, s.max_height)
            }
        };
        device.enum_framesizes(code).unwrap_or_default().into_iter().map(|found| text(found.size)).collect()
    };
    let mode = |code: FourCC| AvailableMode {
        driver_name: code.to_string(),
        formats: formats_of(code).map(PixelFormat::name).collect(),
        bits: None,
        sizes: sizes(code),
    };
    device.enum_formats().unwrap_or_default().into_iter().map(|found| mode(found.fourcc)).collect()
}

/// A streaming capture device.
struct V4l2Camera {
    info: CameraInfo,
    stream: Stream<'static>,
    stride_bytes: usize,
    /// Decoder of Motion JPEG; `None` for uncompressed frames.
    decoder: Option<mjpeg::Decoder>,
    exposure_us: Option<f32>,
    state: StreamState,
}

/// State of the stream. The library queues the lent buffer again before it waits, so it must wait only when a frame is ready.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum StreamState {
    Stopped,
    /// The driver has all buffers, because the first wait timed out.
    NoneLent,
    /// One buffer is lent.
    Lent,
}

/// Opens the device `request.source`.
///
/// # Errors
/// [`CameraError`] when the device does not exist, is busy or is not a camera, or does not have the mode or a control.
pub(super) fn open(request: &Request) -> Result<Box<dyn Camera>, CameraError> {
    let source = request.source.clone();
    let unavailable = |reason: String| CameraError::Unavailable { camera: source.clone(), reason };
    if request.mode.sync != Sync::Off {
        let (control, asked) = ("sync", "not off".to_owned());
        let allowed = "allowed: off, because Video4Linux has no software synchronization".to_owned();
        return Err(CameraError::Control { camera: source, control, asked, allowed });
    }
    let device = Device::with_path(&source).map_err(|e| unavailable(explain(&e)))?;
    let caps = device.query_caps().map_err(|e| unavailable(format!("is not a camera: {e}")))?;
    if caps.capabilities.contains(Capability::VIDEO_CAPTURE_MPLANE) {
        let remedy = "has multi-planar frames; use the backend \"libcamera\"";
        return Err(unavailable(format!("{} {remedy}", caps.card)));
    }
    if !caps.capabilities.contains(Capability::VIDEO_CAPTURE | Capability::STREAMING) {
        return Err(unavailable(format!("{} is not a capture device with mapped buffers", caps.card)));
    }
    let name = format!("{source} ({})", caps.card);
    // before the format: a flip may change the order of a Bayer mosaic
    set_flips(&device, &name, request.orientation)?;
    let (format, layout) = set_format(&device, &name, request)?;
    let frame_rate = set_rate(&device, &name, request.frame_rate)?;
    let exposure_us = set_controls(&device, &name, request)?;
    let stream = Stream::with_buffers(&device, Type::VideoCapture, BUFFERS)
        .map_err(|e| unavailable(format!("cannot allocate buffers for {} frames: {}", format.name(), explain(&e))))?;
    let limits = limits(&device, &layout);
    let size = Size::new(layout.width as usize, layout.height as usize);
    let decoder = (layout.fourcc.repr == *MJPEG).then(|| mjpeg::Decoder::new(size));
    let stride_bytes = if decoder.is_some() { format.row_bytes(size.width) } else { layout.stride as usize };
    Ok(Box::new(V4l2Camera {
        info: CameraInfo { name, backend: "v4l2", format, size, frame_rate, levels: None, readout: None, limits },
        stream,
        stride_bytes,
        decoder,
        exposure_us,
        state: StreamState::Stopped,
    }))
}

/// Message for an error of the driver, with the remedy.
fn explain(e: &io::Error) -> String {
    match e.kind() {
        io::ErrorKind::NotFound => "no such device; stokescope cameras lists the available ones".to_owned(),
        io::ErrorKind::PermissionDenied => {
            "permission denied; its group is usually `video`: sudo usermod -aG video $USER".to_owned()
        }
        io::ErrorKind::ResourceBusy => "in use by another program".to_owned(),
        _ => e.to_string(),
    }
}

/// Turns the picture in the sensor by 0 or 180 degrees, where that is asked for.
///
/// # Errors
/// [`CameraError::Control`] for another angle, and where the driver does not flip: an unturned picture would not fit the calibration.
fn set_flips(device: &Device, name: &str, orientation: Option<u32>) -> Result<(), CameraError> {
    let Some(degrees) = orientation else { return Ok(()) };
    let refuse = |allowed: &str| {
        let (camera, asked) = (name.to_owned(), degrees.to_string());
        CameraError::Control { camera, control: "orientation", asked, allowed: allowed.to_owned() }
    };
    if ![0, 180].contains(&degrees) {
        return Err(refuse("allowed: 0 or 180 degrees, which a sensor can read out"));
    }
    for id in id::FLIPS {
        let value = Value::Boolean(degrees == 180);
        match device.control(id).map(|control| control.value) {
            Err(_) if degrees == 0 => {}
            Err(_) => {
                return Err(refuse(
                    "allowed: 0, because the driver has no horizontal and vertical flip: leave orientation out of the bundle's [sensor], \
                     and calibrate as the camera delivers",
                ));
            }
            Ok(found) if found == value => {}
            Ok(_) => {
                let set = device.set_control(Control { id, value });
                if set.is_err()
                    || device.control(id).map(|control| control.value).ok() != Some(Value::Boolean(degrees == 180))
                {
                    return Err(refuse("the driver does not take its flip"));
                }
            }
        }
    }
    Ok(())
}

/// Whether two formats differ in nothing but the order of a Bayer mosaic, which flips in the sensor change.
fn alike(a: PixelFormat, b: PixelFormat) -> bool {
    match (a, b) {
        (PixelFormat::Bayer(_, a), PixelFormat::Bayer(_, b)) => a == b,
        _ => a == b,
    }
}

/// Sets format and size; returns the format, which is exactly the requested one, and its layout.
fn set_format(device: &Device, name: &str, request: &Request) -> Result<(PixelFormat, Format), CameraError> {
    let fail = |e: io::Error| CameraError::Unavailable { camera: name.to_owned(), reason: explain(&e) };
    // compression artefacts would corrupt the reconstruction, so only the guide may use Motion JPEG, as a last resort
    let takes = |code: &[u8]| request.role == Role::Guide || code != MJPEG;
    let refuse = || {
        let (usable, others): (Vec<_>, Vec<_>) =
            modes(device).into_iter().partition(|mode| !mode.formats.is_empty() && takes(mode.driver_name.as_bytes()));
        let describe = |mode: &AvailableMode| format!("{} {}", mode.formats.join(" or "), mode.sizes.join(", "));
        let usable = usable.iter().map(describe).collect::<Vec<_>>().join("; ");
        let others = others.iter().map(|mode| mode.driver_name.as_str()).collect::<Vec<_>>().join(", ");
        let none = || format!("no supported format for the {} camera, only {others}", request.role);
        let offered = if usable.is_empty() { none() } else { usable };
        CameraError::Mode { camera: name.to_owned(), asked: request.mode.to_string(), offered }
    };
    let offered = device.enum_formats().map_err(fail)?.into_iter().map(|found| found.fourcc);
    let (lossy, exact): (Vec<_>, Vec<_>) =
        offered.filter(|code| takes(&code.repr)).partition(|code| code.repr == *MJPEG);
    let choose = |codes: Vec<FourCC>| {
        let deep = |format: &PixelFormat| request.mode.bits.is_none_or(|bits| format.bits() == Some(bits));
        let preferred = || preferred(request.role, codes.iter().copied().flat_map(formats_of).filter(deep));
        let format = request.mode.format.or_else(preferred).filter(deep)?;
        let known = || codes.iter().copied().flat_map(formats_of);
        let turned = request.orientation == Some(180) && !known().any(|known| known == format);
        let format = if turned { known().find(|known| alike(*known, format))? } else { format };
        codes.iter().find(|code| formats_of(**code).any(|known| known == format)).map(|code| (format, *code))
    };
    let (format, code) = [exact, lossy].into_iter().find_map(choose).ok_or_else(refuse)?;
    let mut wanted = device.format().map_err(fail)?;
    wanted.fourcc = code;
    if let Some(size) = request.mode.size {
        (wanted.width, wanted.height) = (size.width as u32, size.height as u32);
    }
    // the driver chooses stride and size
    (wanted.stride, wanted.size) = (0, 0);
    let given = device.set_format(&wanted).map_err(fail)?;
    let same = given.fourcc == wanted.fourcc && (given.width, given.height) == (wanted.width, wanted.height);
    if same { Ok((format, given)) } else { Err(refuse()) }
}

/// Sets the requested frame rate, if any; returns the actual one, if known.
fn set_rate(device: &Device, name: &str, wanted: Option<f64>) -> Result<Option<f64>, CameraError> {
    let rate = |p: &Parameters| {
        let Fraction { numerator, denominator } = p.interval;
        (numerator > 0 && denominator > 0).then(|| f64::from(denominator) / f64::from(numerator))
    };
    let current = device.params().ok();
    let Some(wanted) = wanted else { return Ok(current.as_ref().and_then(rate)) };
    let able = current.is_some_and(|p| p.capabilities.contains(Capabilities::TIME_PER_FRAME));
    let interval = Fraction::new(1000, (1000.0 * wanted).round() as u32);
    let given = if able { device.set_params(&Parameters::new(interval)).ok().as_ref().and_then(rate) } else { None };
    match given {
        Some(given) if (given / wanted - 1.0).abs() <= RATE_TOLERANCE => Ok(Some(given)),
        _ => {
            let (control, asked) = ("frame_rate", wanted.to_string());
            let nearest = |given| format!("the nearest rate for this format and size is {given:.3}");
            let allowed = given.map_or("the device cannot set it".to_owned(), nearest);
            Err(CameraError::Control { camera: name.to_owned(), control, asked, allowed })
        }
    }
}

/// Sets the requested exposure and gain; returns the exposure time in microseconds. The lensless camera's automatic functions are
/// turned off, because its readings must be comparable with those of the calibration.
fn set_controls(device: &Device, name: &str, request: &Request) -> Result<Option<f32>, CameraError> {
    let mode = &request.mode;
    let raw = request.role == Role::Raw;
    let has = |id: u32| device.control(id).is_ok();
    let off = |id: u32, value: Value| {
        // many cameras lack these controls
        if has(id) && device.set_control(Control { id, value }).is_err() {
            tracing::warn!("{name}: the automatic function {id:#x} cannot be turned off");
        }
    };
    if raw {
        off(id::AUTO_WHITE_BALANCE, Value::Boolean(false));
    }
    if raw || mode.gain.is_some() {
        off(id::AUTO_GAIN, Value::Boolean(false));
    }
    if raw || mode.exposure_us.is_some() {
        off(id::AUTO_EXPOSURE, Value::Integer(id::MANUAL));
    }
    let set = |control: &'static str, ids: &[u32], asked: f32, value: i64| {
        let refuse =
            |allowed| CameraError::Control { camera: name.to_owned(), control, asked: asked.to_string(), allowed };
        let id = ids
            .iter()
            .copied()
            .find(|id| has(*id))
            .ok_or_else(|| refuse("the device has no such control".to_owned()))?;
        let done = device.set_control(Control { id, value: Value::Integer(value) });
        match (done, device.control(id).map(|control| control.value)) {
            (Ok(()), Ok(Value::Integer(found))) if found == value => Ok(()),
            (_, Ok(Value::Integer(found))) => Err(refuse(format!("the device stays at {found} (driver units)"))),
            (done, found) => Err(refuse(format!("the device cannot set it: {done:?}, {found:?}"))),
        }
    };
    // how long a trigger lets a camera expose is often no control
    let told = request.timing.triggered && !has(id::EXPOSURE);
    if let Some(time) = mode.exposure_us.filter(|_| !told) {
        set("exposure_us", &[id::EXPOSURE], time, (time / 100.0).round() as i64)?;
    }
    if let Some(gain) = mode.gain {
        set("gain", &[id::ANALOGUE_GAIN, id::GAIN], gain, gain.round() as i64)?;
    }
    Ok(mode.exposure_us.map(|time| 100.0 * (time / 100.0).round()))
}

/// Ranges of exposure, gain and frame rate for frames of `layout`.
fn limits(device: &Device, layout: &Format) -> Limits {
    let able = device.params().is_ok_and(|p| p.capabilities.contains(Capabilities::TIME_PER_FRAME));
    let intervals = device.enum_frameintervals(layout.fourcc, layout.width, layout.height).unwrap_or_default();
    let rates = intervals.into_iter().flat_map(|found| match found.interval {
        FrameIntervalEnum::Discrete(interval) => vec![interval],
        FrameIntervalEnum::Stepwise(steps) => vec![steps.min, steps.max],
    });
    let rates = rates.filter(|interval| interval.numerator > 0);
    let rates = rates.map(|interval| f64::from(interval.denominator) / f64::from(interval.numerator));
    let ends = rates.fold([f64::INFINITY, 0.0], |[least, most], rate| [least.min(rate), most.max(rate)]);
    Limits {
        exposure_us: range(device, id::EXPOSURE).map(|ends| ends.map(|end| 100.0 * end)),
        gain: [id::ANALOGUE_GAIN, id::GAIN].into_iter().find_map(|id| range(device, id)),
        frame_rate: Some(ends).filter(|[least, most]| able && least < most),
    }
}

/// Range of the values of a control, in the driver's units; none where the device has no such control. The library's list of all controls
/// panics at kinds that it does not know, such as the rectangles of newer USB cameras.
fn range(device: &Device, id: u32) -> Option<[f64; 2]> {
    // SAFETY: all fields are numbers and arrays of numbers, for which zero is a value.
    #[allow(unsafe_code)]
    let mut found: v4l2_query_ext_ctrl = unsafe { std::mem::zeroed() };
    found.id = id;
    // SAFETY: the kernel fills one structure of the kind that this request names, which outlives the call.
    #[allow(unsafe_code)]
    let queried = unsafe { ioctl(device.handle().fd(), VIDIOC_QUERY_EXT_CTRL, (&raw mut found).cast()) };
    queried.ok().filter(|()| found.minimum < found.maximum).map(|()| [found.minimum as f64, found.maximum as f64])
}

impl V4l2Camera {
    /// Waits until the driver has a frame; `false` if there is none by `until`.
    fn wait(&self, until: Instant) -> io::Result<bool> {
        loop {
            let left = until.saturating_duration_since(Instant::now());
            let left = left.as_millis().min(i32::MAX as u128) as i32;
            // POLLIN; an error counts as ready and is returned by the next call
            match self.stream.handle().poll(1, left) {
                Err(e) if e.kind() == io::ErrorKind::Interrupted => {}
                ready => return Ok(ready? > 0),
            }
        }
    }
}

impl Camera for V4l2Camera {
    fn info(&self) -> &CameraInfo {
        &self.info
    }

    fn next_frame(&mut self, timeout: Duration) -> Result<Frame<'_>, CameraError> {
        let until = Instant::now() + timeout;
        let late = || CameraError::Timeout { camera: self.info.name.clone(), after: timeout };
        let lost = |e: io::Error| CameraError::Lost { camera: self.info.name.clone(), reason: e.to_string() };
        if self.state != StreamState::Stopped && !self.wait(until).map_err(lost)? {
            return Err(late());
        }
        match self.state {
            StreamState::Stopped => self.stream.set_timeout(timeout.max(Duration::from_millis(1))),
            StreamState::NoneLent => {
                // this frame is not returned; holding its buffer lets the library wait for the next one
                self.stream.dequeue().map_err(lost)?;
                self.state = StreamState::Lent;
                if !self.wait(until).map_err(lost)? {
                    return Err(late());
                }
            }
            StreamState::Lent => {}
        }
        let first = self.state == StreamState::Stopped;
        let (bytes, found) = match self.stream.next() {
            Err(e) if first && e.kind() == io::ErrorKind::TimedOut => {
                self.state = StreamState::NoneLent;
                return Err(late());
            }
            next => next.map_err(lost)?,
        };
        self.state = StreamState::Lent;
        let sequence = u64::from(found.sequence);
        let CameraInfo { format, size, .. } = self.info;
        if found.flags.contains(Flags::ERROR) {
            let what = format!("the driver marks its {} bytes as faulty", found.bytesused);
            return Err(CameraError::Damaged { camera: self.info.name.clone(), sequence, what });
        }
        let timestamp = Duration::from_secs(found.timestamp.sec.max(0) as u64)
            + Duration::from_micros(found.timestamp.usec.max(0) as u64);
        let metadata = Metadata { sequence, timestamp, exposure_us: self.exposure_us, ..Metadata::default() };
        let bytes = &bytes[..bytes.len().min(found.bytesused as usize)];
        let bytes = match &mut self.decoder {
            None => bytes,
            Some(decoder) => decoder.decode(bytes).map_err(|what| {
                let camera = self.info.name.clone();
                CameraError::Damaged { camera, sequence, what }
            })?,
        };
        Frame::new(bytes, format, size, self.stride_bytes, metadata)
            .map_err(|source| CameraError::Frame { camera: self.info.name.clone(), source })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::board::Mode;
    use crate::camera::Clock;
    use stokescope_core::image::Stack;

    #[test]
    fn every_format_has_a_code_and_every_code_a_format() {
        for format in PixelFormat::named() {
            let sources = if format == PixelFormat::Rgb(Samples::U8) { 2 } else { 1 };
            assert_eq!(FORMATS.iter().filter(|(known, _)| *known == format).count(), sources, "{format}");
        }
        for (format, code) in FORMATS {
            let found: Vec<_> = formats_of(FourCC::new(code)).collect();
            let uses = if [b"NV12", b"YUYV"].contains(code) { 2 } else { 1 };
            assert!(found.contains(format) && found.len() == uses, "{format}: {found:?}");
        }
    }

    #[test]
    fn a_device_that_is_not_a_camera_is_refused_with_the_reason() {
        let clock = Clock::default();
        let open = |source: &str, mode| {
            let source = source.to_owned();
            let request = Request { source, mode, ..Request::new(Role::Raw, &clock) };
            super::open(&request).err().unwrap().to_string()
        };
        assert_eq!(
            open("/dev/video-none", Mode::default()),
            "/dev/video-none: no such device; stokescope cameras lists the available ones"
        );
        assert!(open("/dev/null", Mode::default()).starts_with("/dev/null: is not a camera: "));
        let e = open("/dev/null", Mode { sync: Sync::Server, ..Mode::default() });
        assert!(e.starts_with("/dev/null: sync = not off, allowed: off"), "{e}");
    }

    /// Environment variable that is set on a machine with two `vivid` devices, /dev/video0 and /dev/video1.
    const VARIABLE: &str = "STOKESCOPE_VIVID";
    const LONG: Duration = Duration::from_secs(20);
    const SIZE: Size = Size::new(640, 360);

    fn vivid() -> bool {
        let there = std::env::var_os(VARIABLE).is_some();
        if !there {
            eprintln!("SKIPPED: no vivid devices; scripts/vivid-vm.sh runs this test with them");
        }
        there
    }

    fn device(number: usize) -> String {
        format!("/dev/video{number}")
    }

    /// Sets the control called `name`.
    fn set(number: usize, name: &str, value: Value) {
        let device = Device::with_path(device(number)).unwrap();
        let id =
            device.query_controls().unwrap().iter().find(|c| c.name == name).unwrap_or_else(|| panic!("{name}")).id;
        device.set_control(Control { id, value }).unwrap();
    }

    fn wanted(number: usize) -> Request {
        let format = PixelFormat::Bayer(Bayer::Bggr, Samples::U10);
        let mode = Mode { size: Some(SIZE), format: Some(format), gain: Some(77.0), ..Mode::default() };
        let request = Request::new(Role::Raw, &Clock::default());
        Request { source: device(number), mode, frame_rate: Some(10.0), ..request }
    }

    #[test]
    fn vivid_is_listed_with_raw_modes() {
        if !vivid() {
            return;
        }
        let offers = list().unwrap();
        let sources: Vec<_> = offers.iter().map(|offer| offer.source.as_str()).collect();
        assert_eq!(sources, ["/dev/video0", "/dev/video1"]);
        let raw = offers[0].modes.iter().find(|mode| mode.driver_name == "BG10").unwrap();
        assert_eq!((&raw.formats[..], raw.sizes.contains(&"640×360".to_owned())), (&["bggr10".to_owned()][..], true));
    }

    #[test]
    fn vivid_two_cameras_at_once_give_ten_bit_colour_bars_with_gain_and_times() {
        if !vivid() {
            return;
        }
        let mut cameras = [0, 1].map(|n| super::open(&wanted(n)).unwrap());
        for number in [0, 1] {
            let control = Device::with_path(device(number)).unwrap().control(id::GAIN).unwrap();
            assert_eq!(control.value, Value::Integer(77));
            set(number, "Test Pattern", Value::Integer(0));
        }
        let mut last = [None::<Metadata>; 2];
        for _ in 0..10 {
            for (camera, last) in cameras.iter_mut().zip(&mut last) {
                let frame = camera.next_frame(LONG).unwrap();
                assert_eq!((frame.size(), frame.format()), (SIZE, PixelFormat::Bayer(Bayer::Bggr, Samples::U10)));
                assert!(last.is_none_or(|l| {
                    frame.metadata.sequence > l.sequence && frame.metadata.timestamp > l.timestamp
                }));
                *last = Some(frame.metadata);
            }
        }
        let uptime = std::fs::read_to_string("/proc/uptime").unwrap();
        let uptime: f64 = uptime.split(' ').next().unwrap().parse().unwrap();
        let age = uptime - last[0].unwrap().timestamp.as_secs_f64();
        assert!((-0.1..20.0).contains(&age), "on the monotonic clock: {age}");
        let frame = cameras[0].next_frame(LONG).unwrap();
        // white, yellow, cyan, green, magenta, red, blue and black bars; the text is above them
        let bars = [0b111, 0b110, 0b011, 0b010, 0b101, 0b100, 0b001, 0b000];
        for (bar, colour) in bars.into_iter().enumerate() {
            let x = (SIZE.width * (2 * bar + 1) / bars.len() / 2) & !1;
            let at = |x: usize, y: usize| u16::from_le_bytes([frame.row(y)[2 * x], frame.row(y)[2 * x + 1]]);
            let y = (SIZE.height * 3 / 4) & !1;
            let found = [at(x + 1, y + 1), at(x + 1, y), at(x, y)];
            for (channel, value) in found.into_iter().enumerate() {
                let lit = colour >> (2 - channel) & 1 == 1;
                assert!(value < 1024 && (value > 500) == lit, "bar {bar}: {found:?}");
            }
        }
    }

    #[test]
    fn vivid_real_modes_are_cropped_and_binned() {
        use stokescope_core::device::{Noise, Sensor};
        use stokescope_core::image::Window;
        use stokescope_core::parallel::Workers;
        use stokescope_core::readings::Binning;
        if !vivid() {
            return;
        }
        for (size, side, bin) in [(Size::new(1280, 720), 256, 1), (Size::new(1920, 1080), 512, 2)] {
            let mode = Mode { size: Some(size), ..wanted(0).mode };
            let mut camera = super::open(&Request { mode, frame_rate: None, ..wanted(0) }).unwrap();
            set(0, "Test Pattern", Value::Integer(0));
            let planes = Size::new(size.width / 2, size.height / 2);
            // below the text, from the left edge on
            let window = Window::new(planes, [0, planes.height - side], Size::new(side, side), bin).unwrap();
            let sensor = Sensor { size: window.working(), window, channels: 3, black_level: 0.0, saturation: 1023.0 };
            let noise = Noise { read: 0.002, shot: 0.0 };
            let mut binning = Binning::of_sensor(sensor, noise, None, std::sync::Arc::new(Workers::new(1))).unwrap();
            let mut out = binning.make_output();
            for _ in 0..4 {
                binning.frame(&camera.next_frame(LONG).unwrap(), &mut out).unwrap();
            }
            assert_eq!(out.values.size(), Size::new(256, 256));
            // the first bar is white and the second yellow, each an eighth of the frame
            let bar = planes.width / 8 / bin;
            for (bar_index, colour) in [0b111u32, 0b110].into_iter().enumerate() {
                let at = 200 * 256 + bar * bar_index + bar / 2;
                for channel in 0..3 {
                    let (found, lit) = (out.values.plane(channel)[at], colour >> (2 - channel) & 1 == 1);
                    assert_eq!(found > 500.0, lit, "{size}: bar {bar_index}, channel {channel}: {found}");
                }
            }
        }
    }

    #[test]
    fn vivid_a_picture_is_turned_by_the_flips_of_the_driver() {
        if !vivid() {
            return;
        }
        let picture = |orientation| {
            let mut camera = super::open(&Request { orientation, ..wanted(1) }).unwrap();
            set(1, "Test Pattern", Value::Integer(0));
            for _ in 0..3 {
                camera.next_frame(LONG).unwrap();
            }
            let frame = camera.next_frame(LONG).unwrap();
            let row = frame.row((SIZE.height * 3 / 4) & !1);
            // the first and the last bar of one row: white and black; turned, the driver leaves the last column but one black
            [0, SIZE.width - 1].map(|x| u16::from_le_bytes([row[2 * x], row[2 * x + 1]]))
        };
        let ([left, right], [turned_left, turned_right]) = (picture(Some(0)), picture(Some(180)));
        assert!(left > 500 && right < 500, "{left} {right}");
        assert!(turned_left < 500 && turned_right > 500, "{turned_left} {turned_right}");
        picture(Some(0));
        let e = super::open(&Request { orientation: Some(90), ..wanted(1) }).err().unwrap().to_string();
        assert!(e.contains("orientation = 90, allowed: 0 or 180"), "{e}");
    }

    #[test]
    fn vivid_frames_of_a_usb_camera_are_colour_bars_too() {
        if !vivid() {
            return;
        }
        let mode = Mode { size: Some(SIZE), format: Some(PixelFormat::Yuyv(Range::Limited)), ..Mode::default() };
        let mut camera = super::open(&Request { role: Role::Guide, mode, ..wanted(1) }).unwrap();
        set(1, "Test Pattern", Value::Integer(0));
        let mut planes = Stack::zeros(3, SIZE);
        for _ in 0..4 {
            stokescope_core::readings::unpack(&camera.next_frame(LONG).unwrap(), &mut planes).unwrap();
        }
        let bars = [0b111, 0b110, 0b011, 0b010, 0b101, 0b100, 0b001, 0b000];
        for (bar, colour) in bars.into_iter().enumerate() {
            let at = SIZE.height * 3 / 4 * SIZE.width + SIZE.width * (2 * bar + 1) / bars.len() / 2;
            for channel in 0..3 {
                let (found, lit) = (planes.plane(channel)[at], colour >> (2 - channel) & 1 == 1);
                // three quarters of full light; with the ends of the range left in, black would be 16
                let wanted = if lit { 191.0 } else { 0.0 };
                assert!((found - wanted).abs() < 6.0, "bar {bar}, channel {channel}: {found}, not {wanted}");
            }
        }
    }

    #[test]
    fn vivid_frames_with_the_error_flag_are_damaged_and_the_next_ones_are_not() {
        if !vivid() {
            return;
        }
        let mut camera = super::open(&wanted(0)).unwrap();
        camera.next_frame(LONG).unwrap();
        set(0, "Inject V4L2_BUF_FLAG_ERROR", Value::None);
        let failed = (0..8).find_map(|_| camera.next_frame(LONG).err());
        assert!(matches!(&failed, Some(e @ CameraError::Damaged { .. }) if e.is_passing()), "{failed:?}");
        assert!((0..5).all(|_| camera.next_frame(LONG).is_ok()));
    }

    #[test]
    fn vivid_a_fatal_error_and_a_disconnection_are_a_lost_camera_that_opens_again() {
        if !vivid() {
            return;
        }
        for fault in ["Inject Fatal Streaming Error", "Disconnect"] {
            let mut camera = super::open(&wanted(1)).unwrap();
            camera.next_frame(LONG).unwrap();
            set(1, fault, Value::None);
            let failed = (0..8).find_map(|_| camera.next_frame(LONG).err());
            assert!(matches!(failed, Some(CameraError::Lost { .. })), "{fault}: {failed:?}");
            drop(camera);
            super::open(&wanted(1)).unwrap().next_frame(LONG).unwrap();
        }
    }

    #[test]
    fn vivid_a_missing_frame_is_reported_in_time_and_the_next_one_still_comes() {
        if !vivid() {
            return;
        }
        let mut camera = super::open(&wanted(0)).unwrap();
        let brief = Duration::from_millis(1);
        for _ in 0..3 {
            let begin = Instant::now();
            let e = camera.next_frame(brief).err();
            assert!(e.is_none_or(|e| matches!(e, CameraError::Timeout { .. })) && begin.elapsed() < LONG / 4);
        }
        assert!((0..3).all(|_| camera.next_frame(LONG).is_ok()));
        set(0, "Percentage of Dropped Buffers", Value::Integer(100));
        let starved = camera.next_frame(Duration::from_secs(1)).err();
        let starved = starved.or_else(|| (0..4).find_map(|_| camera.next_frame(Duration::from_secs(1)).err()));
        set(0, "Percentage of Dropped Buffers", Value::Integer(0));
        assert!(matches!(starved, Some(CameraError::Timeout { .. })), "{starved:?}");
        assert!((0..3).all(|_| camera.next_frame(LONG).is_ok()));
    }

    #[test]
    fn vivid_a_picture_that_never_changes_is_a_stuck_camera() {
        if !vivid() {
            return;
        }
        set(1, "OSD Text Mode", Value::Integer(2));
        let mut camera = crate::camera::open("v4l2", &wanted(1)).unwrap();
        let failed = (0..30).find_map(|_| camera.next_frame(LONG).err());
        set(1, "OSD Text Mode", Value::Integer(0));
        assert!(matches!(failed, Some(CameraError::Stuck { .. })), "{failed:?}");
    }

    #[test]
    fn vivid_unsupported_modes_and_controls_are_refused() {
        if !vivid() {
            return;
        }
        let refused = |mode, frame_rate| super::open(&Request { mode, frame_rate, ..wanted(0) }).err().unwrap();
        let mode = wanted(0).mode;
        let e = refused(Mode { size: Some(Size::new(100, 100)), ..mode }, None);
        assert!(matches!(&e, CameraError::Mode { offered, .. } if offered.contains("bggr10 ")), "{e}");
        let e = refused(Mode { exposure_us: Some(500.0), ..mode }, None);
        assert!(matches!(&e, CameraError::Control { control: "exposure_us", .. }), "{e}");
        let e = refused(Mode { gain: Some(1e6), ..mode }, None);
        assert!(matches!(&e, CameraError::Control { control: "gain", .. }), "{e}");
        let e = refused(mode, Some(997.0));
        assert!(matches!(&e, CameraError::Control { control: "frame_rate", .. }), "{e}");
        let _first = super::open(&wanted(0)).unwrap();
        let e = refused(mode, None).to_string();
        assert!(e.contains("in use by another program"), "{e}");
    }
}
