//! Cameras of Video4Linux: USB cameras, capture cards and sensors whose driver is one device. Single-planar devices with
//! mapped buffers; sensors behind a media controller are libcamera's.
//!
//! Frames lie in the driver's buffers, one at a time is lent, the others stay with the driver. Time-stamps are the
//! driver's, on the system's monotonic clock.

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
    framesize::FrameSizeEnum,
    io::{mmap::Stream, traits::CaptureStream},
    parameters::Capabilities,
    video::{Capture, capture::Parameters},
};

use super::{Camera, CameraError, CameraInfo, Offer, OfferedMode, Request, Role, preferred};
use crate::{
    frame::{Bayer, Frame, Metadata, PixelFormat, Samples, Sync},
    plane::Size,
};

/// Buffers that are asked for: one is lent, one is being filled, the others bridge a pause of the reader.
const BUFFERS: u32 = 4;
/// How far the frame rate may be from the one asked for.
const RATE_TOLERANCE: f64 = 0.01;

/// Controls, by the numbers of videodev2.h.
mod id {
    pub(super) const AUTO_WHITE_BALANCE: u32 = 0x0098_090c;
    pub(super) const AUTO_GAIN: u32 = 0x0098_0912;
    pub(super) const GAIN: u32 = 0x0098_0913;
    pub(super) const AUTO_EXPOSURE: u32 = 0x009a_0901;
    /// In units of 100 µs.
    pub(super) const EXPOSURE: u32 = 0x009a_0902;
    pub(super) const ANALOGUE_GAIN: u32 = 0x009e_0903;
    /// The choice `manual` of `AUTO_EXPOSURE`.
    pub(super) const MANUAL: i64 = 1;
}

/// What Video4Linux calls our formats; NV12 has two uses.
const FORMATS: &[(PixelFormat, &[u8; 4])] = {
    use Bayer::{Bggr, Gbrg, Grbg, Rggb};
    use PixelFormat::{Bayer as Cell, Mono, Nv12Luma, Nv12Rgb, Rgb};
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
    ]
};

fn formats_of(code: FourCC) -> impl Iterator<Item = PixelFormat> {
    FORMATS.iter().filter(move |(_, name)| **name == code.repr).map(|(format, _)| *format)
}

/// Every capture device of the system.
///
/// # Errors
/// None: devices that cannot be asked are left out.
#[allow(clippy::unnecessary_wraps, reason = "other backends can fail")]
pub(super) fn list() -> Result<Vec<Offer>, CameraError> {
    let mut paths: Vec<_> = context::enum_devices().iter().map(|node| node.path().to_path_buf()).collect();
    paths.sort_by_key(|path| (path.as_os_str().len(), path.clone()));
    let offer = |path: &std::path::PathBuf| {
        let device = Device::with_path(path).ok()?;
        let caps = device.query_caps().ok()?;
        let capture = Capability::VIDEO_CAPTURE | Capability::STREAMING;
        caps.capabilities.contains(capture).then(|| Offer {
            source: path.display().to_string(),
            description: format!("{} ({}, {})", caps.card, caps.driver, caps.bus),
            modes: modes(&device),
        })
    };
    Ok(paths.iter().filter_map(offer).collect())
}

fn modes(device: &Device) -> Vec<OfferedMode> {
    let sizes = |code| {
        let text = |size: FrameSizeEnum| match size {
            FrameSizeEnum::Discrete(s) => format!("{}×{}", s.width, s.height),
            FrameSizeEnum::Stepwise(s) => {
                format!("{}×{} to {}×{}", s.min_width, s.min_height, s.max_width, s.max_height)
            }
        };
        device.enum_framesizes(code).unwrap_or_default().into_iter().map(|found| text(found.size)).collect()
    };
    let mode = |code: FourCC| OfferedMode {
        driver_name: code.to_string(),
        formats: formats_of(code).map(PixelFormat::name).collect(),
        sizes: sizes(code),
    };
    device.enum_formats().unwrap_or_default().into_iter().map(|found| mode(found.fourcc)).collect()
}

/// A streaming device.
struct V4l2Camera {
    info: CameraInfo,
    stream: Stream<'static>,
    stride_bytes: usize,
    exposure_us: Option<f32>,
    started: Started,
}

/// Where the stream is. The library queues the lent buffer again before it waits, so it may wait only for what is there.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Started {
    No,
    /// Every buffer is with the driver: the first wait was in vain.
    Empty,
    /// One buffer is lent.
    Lent,
}

/// Opens the device `request.source`.
///
/// # Errors
/// [`CameraError`] when it is not there, busy or no camera, or does not have the mode or a control.
pub(super) fn open(request: &Request) -> Result<Box<dyn Camera>, CameraError> {
    let source = request.source.clone();
    let unavailable = |reason: String| CameraError::Unavailable { camera: source.clone(), reason };
    if request.mode.sync != Sync::Off {
        let (control, asked) = ("sync", "not off".to_owned());
        let allowed = "allowed: off: Video4Linux has no software synchronization".to_owned();
        return Err(CameraError::Control { camera: source, control, asked, allowed });
    }
    let device = Device::with_path(&source).map_err(|e| unavailable(opening(&e)))?;
    let caps = device.query_caps().map_err(|e| unavailable(format!("is no camera: {e}")))?;
    if !caps.capabilities.contains(Capability::VIDEO_CAPTURE | Capability::STREAMING) {
        return Err(unavailable(format!("{} is no single-planar capture device", caps.card)));
    }
    let name = format!("{source} ({})", caps.card);
    let (format, layout) = set_format(&device, &name, request)?;
    let frame_rate = set_rate(&device, &name, request.frame_rate)?;
    let exposure_us = set_controls(&device, &name, request)?;
    let stream = Stream::with_buffers(&device, Type::VideoCapture, BUFFERS)
        .map_err(|e| unavailable(format!("has no buffers for {} frames: {}", format.name(), opening(&e))))?;
    let size = Size::new(layout.width as usize, layout.height as usize);
    Ok(Box::new(V4l2Camera {
        info: CameraInfo { name, backend: "v4l2", format, size, frame_rate },
        stream,
        stride_bytes: layout.stride as usize,
        exposure_us,
        started: Started::No,
    }))
}

/// What an error at opening means to a person.
fn opening(e: &io::Error) -> String {
    match e.kind() {
        io::ErrorKind::NotFound => "no such device; stokescope cameras lists those there are".to_owned(),
        io::ErrorKind::PermissionDenied => {
            "permission denied; its group is usually `video`: sudo usermod -aG video $USER".to_owned()
        }
        io::ErrorKind::ResourceBusy => "in use by another program".to_owned(),
        _ => e.to_string(),
    }
}

/// Sets format and size, and gives what the device then has: exactly what was asked for.
fn set_format(device: &Device, name: &str, request: &Request) -> Result<(PixelFormat, Format), CameraError> {
    let fail = |e: io::Error| CameraError::Unavailable { camera: name.to_owned(), reason: opening(&e) };
    let refuse = || {
        let describe = |mode: OfferedMode| format!("{} {}", mode.formats.join(" or "), mode.sizes.join(", "));
        let usable = modes(device).into_iter().filter(|mode| !mode.formats.is_empty());
        let offered: Vec<_> = usable.map(describe).collect();
        let offered = if offered.is_empty() { "no format that is supported".to_owned() } else { offered.join("; ") };
        CameraError::Mode { camera: name.to_owned(), asked: request.mode.to_string(), offered }
    };
    let offered = || device.enum_formats().map_err(fail);
    let format = match request.mode.format {
        Some(format) => format,
        None => {
            preferred(request.role, offered()?.iter().flat_map(|found| formats_of(found.fourcc))).ok_or_else(refuse)?
        }
    };
    let (_, code) = FORMATS.iter().find(|(known, _)| *known == format).ok_or_else(refuse)?;
    let mut wanted = device.format().map_err(fail)?;
    wanted.fourcc = FourCC::new(code);
    if let Some(size) = request.mode.size {
        (wanted.width, wanted.height) = (size.width as u32, size.height as u32);
    }
    // the driver's own stride and size
    (wanted.stride, wanted.size) = (0, 0);
    let given = device.set_format(&wanted).map_err(fail)?;
    let same = given.fourcc == wanted.fourcc && (given.width, given.height) == (wanted.width, wanted.height);
    if same { Ok((format, given)) } else { Err(refuse()) }
}

/// Sets the frame rate if one is asked for; gives the one there is, if it is known.
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
            let nearest = |given| format!("the nearest it can do with this format and size is {given:.3}");
            let allowed = given.map_or("it cannot be set".to_owned(), nearest);
            Err(CameraError::Control { camera: name.to_owned(), control, asked, allowed })
        }
    }
}

/// Fixes exposure and gain as asked; for the lensless camera automatic functions go off where there are any, since readings
/// of one frame and those of the calibration must mean the same. Gives the exposure time.
fn set_controls(device: &Device, name: &str, request: &Request) -> Result<Option<f32>, CameraError> {
    let mode = &request.mode;
    let raw = request.role == Role::Raw;
    let has = |id: u32| device.control(id).is_ok();
    let off = |id: u32, value: Value| {
        // many cameras have none of them
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
        let id = ids.iter().copied().find(|id| has(*id)).ok_or_else(|| refuse("it has no such control".to_owned()))?;
        let done = device.set_control(Control { id, value: Value::Integer(value) });
        match (done, device.control(id).map(|control| control.value)) {
            (Ok(()), Ok(Value::Integer(found))) if found == value => Ok(()),
            (_, Ok(Value::Integer(found))) => Err(refuse(format!("it stays at {found} of the driver's units"))),
            (done, found) => Err(refuse(format!("it cannot be set: {done:?}, {found:?}"))),
        }
    };
    if let Some(time) = mode.exposure_us {
        set("exposure_us", &[id::EXPOSURE], time, (time / 100.0).round() as i64)?;
    }
    if let Some(gain) = mode.gain {
        set("gain", &[id::ANALOGUE_GAIN, id::GAIN], gain, gain.round() as i64)?;
    }
    Ok(mode.exposure_us.map(|time| 100.0 * (time / 100.0).round()))
}

impl V4l2Camera {
    /// Waits until the driver has a frame; false when it has none in time.
    fn wait(&self, until: Instant) -> io::Result<bool> {
        loop {
            let left = until.saturating_duration_since(Instant::now());
            let left = left.as_millis().min(i32::MAX as u128) as i32;
            // POLLIN; errors show as readiness, and as what they are in the next call
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
        if self.started != Started::No && !self.wait(until).map_err(lost)? {
            return Err(late());
        }
        match self.started {
            Started::No => self.stream.set_timeout(timeout.max(Duration::from_millis(1))),
            Started::Empty => {
                // this one is not to be had, but with it in hand the next one is
                self.stream.dequeue().map_err(lost)?;
                self.started = Started::Lent;
                if !self.wait(until).map_err(lost)? {
                    return Err(late());
                }
            }
            Started::Lent => {}
        }
        let first = self.started == Started::No;
        let (bytes, found) = match self.stream.next() {
            Err(e) if first && e.kind() == io::ErrorKind::TimedOut => {
                self.started = Started::Empty;
                return Err(late());
            }
            next => next.map_err(lost)?,
        };
        self.started = Started::Lent;
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
        Frame::new(bytes, format, size, self.stride_bytes, metadata)
            .map_err(|source| CameraError::Frame { camera: self.info.name.clone(), source })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Clock;
    use crate::frame::Mode;

    #[test]
    fn every_format_has_a_code_and_codes_are_not_shared_but_for_nv12() {
        for format in PixelFormat::named() {
            assert_eq!(FORMATS.iter().filter(|(known, _)| *known == format).count(), 1, "{format}");
        }
        for (format, code) in FORMATS {
            let found: Vec<_> = formats_of(FourCC::new(code)).collect();
            assert!(found.contains(format) && (found.len() == 1 || **code == *b"NV12"), "{format}: {found:?}");
        }
    }

    #[test]
    fn what_is_no_camera_is_refused_with_the_reason() {
        let clock = Clock::default();
        let open = |source: &str, mode| {
            let source = source.to_owned();
            let request = Request { source, mode, ..Request::new(Role::Raw, &clock) };
            super::open(&request).err().unwrap().to_string()
        };
        assert_eq!(
            open("/dev/video-none", Mode::default()),
            "/dev/video-none: no such device; stokescope cameras lists those there are"
        );
        assert!(open("/dev/null", Mode::default()).starts_with("/dev/null: is no camera: "));
        let e = open("/dev/null", Mode { sync: Sync::Server, ..Mode::default() });
        assert!(e.starts_with("/dev/null: sync = not off, allowed: off"), "{e}");
    }
}
