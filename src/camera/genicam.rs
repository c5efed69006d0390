//! Backend for GenICam cameras (GigE Vision, USB3 Vision), by the library Aravis.
//!
//! Packed samples are unpacked into a buffer of this camera. Formats of polarization cameras are read like the mono formats of their bits:
//! makers number them with the highest bit set. Cameras run on clocks of their own, so frames are stamped with their arrival.
//!
//! Allocation: at opening.

use std::fmt;
use std::str::FromStr;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::Duration;

use ::aravis::prelude::*;
use ::aravis::{Aravis, Auto, Buffer, BufferStatus, Camera as Device, PixelFormat as Code, Stream};

use super::timing::monotonic;
use super::{AvailableCamera, AvailableMode, Camera, CameraError, CameraInfo, Limits, Request, Role, preferred};
use crate::board::{Stamp, Sync};
use stokescope_core::frame::{Bayer, Frame, Metadata, PixelFormat, Samples};
use stokescope_core::image::Size;

/// Number of buffers: one is lent, the others are filled while the reader pauses.
const BUFFERS: usize = 4;
/// Largest relative deviation from a requested exposure, gain or frame rate.
const TOLERANCE: f64 = 0.01;
/// Multiple of pixels at which a centred region begins, so that it cuts no cell of polarizers or colours.
const CELL: i32 = 4;
/// Bit of a format's number that marks it as a maker's own.
const CUSTOM: u32 = 1 << 31;

/// How the samples of a camera's format lie in memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Packing {
    /// Whole bytes or little-endian words.
    None,
    /// Samples follow each other bit by bit, the lowest first: the formats with a `p`.
    Dense,
    /// Two samples of 12 bits in three bytes, the upper bits first: `Mono12Packed` of GigE Vision.
    Gige,
}

/// Formats by their number in the Pixel Format Naming Convention, and as they are named in board files.
const FORMATS: &[(u32, PixelFormat, Packing)] = {
    use Bayer::{Bggr, Gbrg, Grbg, Rggb};
    use PixelFormat::{Bayer as Cell, Mono, Rgb};
    use Samples::{Packed10, Packed12, U8, U10, U12, U16};
    &[
        (0x0108_0001, Mono(U8), Packing::None),
        (0x0110_0003, Mono(U10), Packing::None),
        (0x0110_0005, Mono(U12), Packing::None),
        (0x0110_0007, Mono(U16), Packing::None),
        (0x010a_0046, Mono(Packed10), Packing::Dense),
        (0x010c_0047, Mono(Packed12), Packing::Dense),
        (0x010c_0006, Mono(Packed12), Packing::Gige),
        (0x0108_0008, Cell(Grbg, U8), Packing::None),
        (0x0108_0009, Cell(Rggb, U8), Packing::None),
        (0x0108_000a, Cell(Gbrg, U8), Packing::None),
        (0x0108_000b, Cell(Bggr, U8), Packing::None),
        (0x010c_0053, Cell(Bggr, Packed12), Packing::Dense),
        (0x010c_0055, Cell(Gbrg, Packed12), Packing::Dense),
        (0x010c_0057, Cell(Grbg, Packed12), Packing::Dense),
        (0x010c_0059, Cell(Rggb, Packed12), Packing::Dense),
        (0x0218_0014, Rgb(U8), Packing::None),
    ]
};

/// Format and packing of a format's number; that of a polarization camera is a mono one.
fn format_of(code: u32) -> Option<(PixelFormat, Packing)> {
    FORMATS.iter().find(|(known, ..)| *known == code & !CUSTOM).map(|(_, format, packing)| (*format, *packing))
}

/// The frames of a format after unpacking.
fn unpacked(format: PixelFormat) -> PixelFormat {
    let plain = |samples| match samples {
        Samples::Packed10 => Samples::U10,
        Samples::Packed12 => Samples::U12,
        other => other,
    };
    match format {
        PixelFormat::Mono(samples) => PixelFormat::Mono(plain(samples)),
        PixelFormat::Bayer(order, samples) => PixelFormat::Bayer(order, plain(samples)),
        other => other,
    }
}

/// Unpacks samples of `bits` bits into little-endian words.
fn unpack(packing: Packing, bits: usize, bytes: &[u8], words: &mut [u8]) {
    for (i, word) in words.as_chunks_mut::<2>().0.iter_mut().enumerate() {
        let value = match packing {
            Packing::Gige => {
                let group = bytes.get(i / 2 * 3..).and_then(<[u8]>::first_chunk::<3>).copied().unwrap_or_default();
                let [high, low] = if i % 2 == 0 { [group[0], group[1]] } else { [group[2], group[1] >> 4] };
                u16::from(high) << 4 | u16::from(low & 0xf)
            }
            Packing::Dense | Packing::None => {
                let (byte, shift) = (i * bits / 8, i * bits % 8);
                let at = |k: usize| u32::from(bytes.get(byte + k).copied().unwrap_or(0));
                let all = at(0) | at(1) << 8 | at(2) << 16;
                (all >> shift) as u16 & ((1 << bits) - 1)
            }
        };
        *word = value.to_le_bytes();
    }
}

/// Source of a camera: its id, a part of it or its address, and settings that are none of other backends.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Source {
    name: String,
    /// Left and upper edge of the region that is read; `None` centres it.
    offset: Option<[i32; 2]>,
    /// Pixels that the camera joins each way.
    bin: i32,
    /// Input of an external trigger.
    trigger: String,
}

impl FromStr for Source {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let mut words = text.split(',');
        let name = words.next().unwrap_or_default().trim().to_owned();
        let mut source = Self { name, offset: None, bin: 1, trigger: "Line1".to_owned() };
        for word in words {
            let allowed = || format!("{:?}, allowed: bin=N, offset=XxY, trigger=INPUT", word.trim());
            let (key, value) = word.trim().split_once('=').ok_or_else(allowed)?;
            let number = |text: &str| text.parse::<i32>().ok().filter(|n| *n >= 0).ok_or_else(allowed);
            match key {
                "bin" => source.bin = number(value)?.max(1),
                "trigger" => value.clone_into(&mut source.trigger),
                "offset" => {
                    let (x, y) = value.split_once('x').ok_or_else(allowed)?;
                    source.offset = Some([number(x)?, number(y)?]);
                }
                _ => return Err(allowed()),
            }
        }
        Ok(source)
    }
}

/// Identifiers of the cameras that are found, each with its description.
fn devices() -> Vec<(String, String)> {
    static LIBRARY: OnceLock<Option<Mutex<Aravis>>> = OnceLock::new();
    let Some(library) = LIBRARY.get_or_init(|| Aravis::initialize().ok().map(Mutex::new)) else { return Vec::new() };
    let found = library.lock().unwrap_or_else(PoisonError::into_inner).get_device_list();
    let text = |c: &std::ffi::CStr| c.to_string_lossy().into_owned();
    let camera = |info: ::aravis::DeviceInfo| {
        let about = [&info.vendor, &info.model, &info.protocol, &info.address].map(|word| text(word));
        (text(&info.id), about.join(" "))
    };
    found.into_iter().map(camera).collect()
}

/// Lists all cameras that answer.
///
/// # Errors
/// None; a camera that is in use is listed without modes.
#[allow(clippy::unnecessary_wraps, reason = "other backends can fail")]
pub(super) fn list() -> Result<Vec<AvailableCamera>, CameraError> {
    let offer = |(source, description): (String, String)| {
        let modes = Device::new(Some(&source)).map(|device| modes(&device)).unwrap_or_default();
        AvailableCamera { source, description, modes }
    };
    Ok(devices().into_iter().map(offer).collect())
}

/// Numbers of the formats of a camera.
fn codes(device: &Device) -> Vec<u32> {
    device.dup_available_pixel_formats().unwrap_or_default().into_iter().map(|code| code as u32).collect()
}

fn modes(device: &Device) -> Vec<AvailableMode> {
    let largest = device.sensor_size().map(|(width, height)| format!("up to {width}×{height}"));
    let sizes: Vec<String> = largest.into_iter().collect();
    let mode = |code: u32| AvailableMode {
        driver_name: format!("{code:#010x}"),
        formats: format_of(code).map(|(format, _)| format.name()).into_iter().collect(),
        bits: None,
        sizes: sizes.clone(),
    };
    codes(device).into_iter().map(mode).collect()
}

/// An object of Aravis that may be moved to another thread.
struct Movable<T>(T);

// SAFETY: objects of Aravis count their references atomically and lock what their own threads share with the caller; one thread at a time
// calls them, the owner of this value.
#[allow(unsafe_code)]
unsafe impl Send for Movable<Device> {}
// SAFETY: as above.
#[allow(unsafe_code)]
unsafe impl Send for Movable<Stream> {}
// SAFETY: as above; a buffer that was taken from the stream is the taker's alone.
#[allow(unsafe_code)]
unsafe impl Send for Movable<Buffer> {}

/// A streaming camera.
struct GenicamCamera {
    info: CameraInfo,
    exposure_us: Option<f32>,
    /// Samples of the camera's format in bits, and how they are packed.
    packing: (Packing, usize),
    /// Unpacked samples.
    words: Vec<u8>,
    /// Buffer of the frame that is lent.
    lent: Option<Movable<Buffer>>,
    lost: Arc<AtomicBool>,
    stream: Movable<Stream>,
    device: Movable<Device>,
}

fn unavailable(camera: &str, reason: impl Into<String>) -> CameraError {
    CameraError::Unavailable { camera: camera.to_owned(), reason: reason.into() }
}

/// The error for a control that is missing or takes no such value.
fn refuse(camera: &str, control: &'static str, asked: &dyn fmt::Display, allowed: impl Into<String>) -> CameraError {
    CameraError::Control { camera: camera.to_owned(), control, asked: asked.to_string(), allowed: allowed.into() }
}

/// Opens the camera that `request.source` names.
///
/// # Errors
/// [`CameraError`] when no or several cameras match, or the camera is in use or does not have the mode or a control.
pub(super) fn open(request: &Request) -> Result<Box<dyn Camera>, CameraError> {
    Ok(Box::new(start(request)?))
}

fn start(request: &Request) -> Result<GenicamCamera, CameraError> {
    let source: Source =
        request.source.parse().map_err(|reason| unavailable(&request.source, format!("source {reason}")))?;
    let found = devices();
    let exact = found.iter().find(|(id, _)| *id == source.name);
    let mut parts = found.iter().filter(|(id, about)| id.contains(&source.name) || about.contains(&source.name));
    let camera = exact.or_else(|| parts.next().filter(|_| parts.next().is_none()));
    let (id, about) = camera.ok_or_else(|| {
        let ids: Vec<_> = found.iter().map(|(id, _)| id.as_str()).collect();
        unavailable(&source.name, format!("no or several cameras, allowed: one of {}", ids.join(", ")))
    })?;
    if request.mode.sync != Sync::Off {
        return Err(refuse(id, "sync", &"not off", "allowed: off; use a trigger"));
    }
    if request.timing.clock.is_some_and(|clock| clock != Stamp::Arrival) {
        return Err(refuse(
            id,
            "clock",
            &"not arrival",
            "allowed: arrival, because the camera's clock is not this machine's",
        ));
    }
    let device = Device::new(Some(id)).map_err(|e| unavailable(id, format!("cannot be opened: {e}; is it in use?")))?;
    turn(&device, id, request.orientation)?;
    let (format, packing) = set_format(&device, id, request)?;
    let size = set_region(&device, id, &source, request.mode.size)?;
    let exposure_us = set_controls(&device, id, request, &source)?;
    let rate = set_rate(&device, id, request)?;
    let limits = limits(&device, request.timing.triggered);
    let bits = format.bits().unwrap_or(8) as usize;
    if packing == Packing::Dense && !(size.width * bits).is_multiple_of(8) {
        return Err(refuse(id, "width", &size.width, "allowed with packed samples: a multiple of 8 pixels"));
    }
    let failed = |e: ::aravis::glib::Error| unavailable(id, format!("does not stream: {e}"));
    let stream = device.create_stream().map_err(failed)?;
    let payload = device.payload().map_err(failed)?;
    (0..BUFFERS).for_each(|_| stream.push_buffer(Buffer::new_allocate(payload as usize)));
    let lost = Arc::new(AtomicBool::new(false));
    if let Some(link) = device.device() {
        let lost = Arc::clone(&lost);
        link.connect_control_lost(move |_| lost.store(true, Ordering::Release));
    }
    device.start_acquisition().map_err(failed)?;
    let words = if packing == Packing::None { 0 } else { 2 * size.pixels() };
    let (name, format) = (format!("{id} ({about})"), unpacked(format));
    Ok(GenicamCamera {
        info: CameraInfo {
            name,
            backend: "genicam",
            format,
            size,
            frame_rate: rate,
            levels: None,
            readout: None,
            limits,
        },
        exposure_us,
        packing: (packing, bits),
        words: vec![0; words],
        lent: None,
        lost,
        stream: Movable(stream),
        device: Movable(device),
    })
}

/// Turns the picture in the sensor by 0 or 180 degrees. A flip may change the order of a Bayer mosaic, which is then listed so.
fn turn(device: &Device, id: &str, orientation: Option<u32>) -> Result<(), CameraError> {
    let Some(degrees) = orientation else { return Ok(()) };
    if ![0, 180].contains(&degrees) {
        return Err(refuse(id, "orientation", &degrees, "allowed: 0 or 180 degrees, which a sensor can read out"));
    }
    for feature in ["ReverseX", "ReverseY"] {
        let there = device.is_feature_available(feature).unwrap_or(false);
        if there {
            device
                .set_boolean(feature, degrees == 180)
                .map_err(|e| refuse(id, "orientation", &degrees, e.to_string()))?;
        } else if degrees == 180 {
            return Err(refuse(
                id,
                "orientation",
                &degrees,
                format!("allowed: 0, because the camera has no {feature}"),
            ));
        }
    }
    Ok(())
}

/// Sets the requested or preferred format; returns it with its packing.
fn set_format(device: &Device, id: &str, request: &Request) -> Result<(PixelFormat, Packing), CameraError> {
    let offered: Vec<(u32, PixelFormat, Packing)> = codes(device)
        .into_iter()
        .filter_map(|code| format_of(code).map(|(format, packing)| (code, format, packing)))
        .collect();
    let deep = |format: &PixelFormat| request.mode.bits.is_none_or(|bits| format.bits() == Some(bits));
    let formats = || offered.iter().map(|(_, format, _)| *format).filter(deep);
    let wanted = request.mode.format.or_else(|| preferred(request.role, formats())).filter(deep);
    let Some((code, format, packing)) = offered.iter().find(|(_, format, _)| Some(*format) == wanted) else {
        let names: Vec<_> = offered.iter().map(|(_, format, _)| format.name()).collect();
        let (camera, asked) = (id.to_owned(), request.mode.to_string());
        return Err(CameraError::Mode { camera, asked, offered: names.join(", ") });
    };
    device.set_pixel_format(Code::from_raw(*code)).map_err(|e| refuse(id, "format", &format.name(), e.to_string()))?;
    Ok((*format, *packing))
}

/// Sets the camera's own binning and the region that it reads; returns the size of its frames.
fn set_region(device: &Device, id: &str, source: &Source, wanted: Option<Size>) -> Result<Size, CameraError> {
    let failed = |e: ::aravis::glib::Error| unavailable(id, format!("region: {e}"));
    if device.is_binning_available().unwrap_or(false) {
        device.set_binning(source.bin, source.bin).map_err(|e| refuse(id, "bin", &source.bin, e.to_string()))?;
        let found = device.binning().map_err(failed)?;
        if found != (source.bin, source.bin) {
            return Err(refuse(id, "bin", &source.bin, format!("the camera stays at {}×{}", found.0, found.1)));
        }
    } else if source.bin > 1 {
        return Err(refuse(
            id,
            "bin",
            &source.bin,
            "allowed: 1, because the camera does not bin; bin in the bundle's [sensor]",
        ));
    }
    let (width, height) = device.sensor_size().map_err(failed)?;
    let most = [width / source.bin, height / source.bin];
    let asked = wanted.map_or(most, |size| [size.width as i32, size.height as i32]);
    let centred = [0, 1].map(|k| (most[k] - asked[k]).max(0) / 2 / CELL * CELL);
    let [x, y] = source.offset.unwrap_or(centred);
    // some cameras take a region beyond their sensor
    let fits = [x, y]
        .iter()
        .zip(&asked)
        .zip(&most)
        .all(|((first, side), most)| i64::from(*first) + i64::from(*side) <= i64::from(*most));
    let set = fits && device.set_region(x, y, asked[0], asked[1]).is_ok();
    let found = device.region().map_err(failed)?;
    if !set || found != (x, y, asked[0], asked[1]) {
        let (camera, asked) = (id.to_owned(), format!("{}×{} from column {x}, row {y}", asked[0], asked[1]));
        let (x, y, width, height) = found;
        let offered =
            format!("regions within {}×{}; it stays at {width}×{height} from column {x}, row {y}", most[0], most[1]);
        return Err(CameraError::Mode { camera, asked, offered });
    }
    Ok(Size::new(asked[0] as usize, asked[1] as usize))
}

/// Sets exposure, gain and trigger; returns the exposure time in microseconds. The lensless camera's automatic functions are turned off,
/// because its readings must be comparable with those of the calibration.
fn set_controls(device: &Device, id: &str, request: &Request, source: &Source) -> Result<Option<f32>, CameraError> {
    let (mode, raw) = (&request.mode, request.role == Role::Raw);
    if (raw || mode.exposure_us.is_some()) && device.is_exposure_auto_available().unwrap_or(false) {
        device.set_exposure_time_auto(Auto::Off).map_err(|e| refuse(id, "exposure_us", &"fixed", e.to_string()))?;
    }
    if (raw || mode.gain.is_some()) && device.is_gain_auto_available().unwrap_or(false) {
        device.set_gain_auto(Auto::Off).map_err(|e| refuse(id, "gain", &"fixed", e.to_string()))?;
    }
    if let Some(time) = mode.exposure_us {
        let set = device.set_exposure_time(f64::from(time));
        check(id, "exposure_us", f64::from(time), set.and_then(|()| device.exposure_time()))?;
    }
    if let Some(gain) = mode.gain {
        check(id, "gain", f64::from(gain), device.set_gain(f64::from(gain)).and_then(|()| device.gain()))?;
    }
    if request.timing.triggered {
        device.set_trigger(&source.trigger).map_err(|e| refuse(id, "trigger", &&source.trigger, e.to_string()))?;
    } else {
        // a camera keeps the trigger of its last user
        let _ = device.clear_triggers();
    }
    Ok(device.exposure_time().ok().map(|time| time as f32))
}

/// Ranges of exposure, gain and frame rate, which a trigger determines.
fn limits(device: &Device, triggered: bool) -> Limits {
    let range = |available: Result<bool, _>, bounds: Result<(f64, f64), ::aravis::glib::Error>| {
        bounds.ok().filter(|(least, most)| available.unwrap_or(false) && least < most).map(<[f64; 2]>::from)
    };
    Limits {
        exposure_us: range(device.is_exposure_time_available(), device.exposure_time_bounds()),
        gain: range(device.is_gain_available(), device.gain_bounds()),
        frame_rate: range(device.is_frame_rate_available(), device.frame_rate_bounds()).filter(|_| !triggered),
    }
}

/// Compares a value that was set with the one that the camera has.
fn check(
    id: &str,
    control: &'static str,
    asked: f64,
    found: Result<f64, ::aravis::glib::Error>,
) -> Result<(), CameraError> {
    match found {
        Ok(found) if (found - asked).abs() <= TOLERANCE * asked.abs().max(1.0) => Ok(()),
        Ok(found) => Err(refuse(id, control, &asked, format!("the nearest that the camera takes is {found}"))),
        Err(e) => Err(refuse(id, control, &asked, e.to_string())),
    }
}

/// Sets the requested frame rate, unless a trigger does; returns the actual one, if known.
fn set_rate(device: &Device, id: &str, request: &Request) -> Result<Option<f64>, CameraError> {
    if request.timing.triggered {
        return Ok(request.frame_rate);
    }
    if let Some(rate) = request.frame_rate {
        check(id, "frame_rate", rate, device.set_frame_rate(rate).and_then(|()| device.frame_rate()))?;
    }
    Ok(device.frame_rate().ok())
}

impl Camera for GenicamCamera {
    fn info(&self) -> &CameraInfo {
        &self.info
    }

    fn next_frame(&mut self, timeout: Duration) -> Result<Frame<'_>, CameraError> {
        let name = || self.info.name.clone();
        if let Some(Movable(buffer)) = self.lent.take() {
            self.stream.0.push_buffer(buffer);
        }
        let Some(buffer) = self.stream.0.timeout_pop_buffer(timeout.as_micros() as u64) else {
            let lost = self.lost.load(Ordering::Acquire);
            let reason = "no longer answers, or another program controls it".to_owned();
            return Err(if lost {
                CameraError::Lost { camera: name(), reason }
            } else {
                CameraError::Timeout { camera: name(), after: timeout }
            });
        };
        let (status, sequence) = (buffer.status(), buffer.frame_id());
        let Movable(buffer) = self.lent.insert(Movable(buffer));
        if status != BufferStatus::Success {
            return Err(CameraError::Damaged { camera: self.info.name.clone(), sequence, what: format!("{status:?}") });
        }
        let (data, length) = buffer.data();
        if data.is_null() {
            return Err(CameraError::Damaged { camera: self.info.name.clone(), sequence, what: "no data".to_owned() });
        }
        // SAFETY: Aravis allocated `length` bytes for this buffer, which belongs to this camera until it is pushed again. That needs a mutable
        // borrow of the camera, and the frame borrows it.
        #[allow(unsafe_code)]
        let bytes = unsafe { std::slice::from_raw_parts(data.cast_const(), length) };
        let CameraInfo { format, size, .. } = self.info;
        let (packing, bits) = self.packing;
        let bytes = if packing == Packing::None {
            bytes
        } else {
            unpack(packing, bits, bytes, &mut self.words);
            self.words.as_slice()
        };
        let metadata =
            Metadata { sequence, timestamp: monotonic(), exposure_us: self.exposure_us, ..Metadata::default() };
        let stride = format.row_bytes(size.width);
        Frame::new(bytes, format, size, stride, metadata)
            .map_err(|source| CameraError::Frame { camera: self.info.name.clone(), source })
    }
}

impl Drop for GenicamCamera {
    fn drop(&mut self) {
        if let Err(e) = self.device.0.stop_acquisition() {
            tracing::debug!("{}: does not stop: {e}", self.info.name);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::process::{Child, Command};
    use std::sync::MutexGuard;

    use super::*;
    use crate::board::{Mode, Timing};
    use crate::camera::{self, Clock};

    /// Aravis' fake camera, of Debian's package aravis-tools.
    const PROGRAM: &str = "arv-fake-gv-camera-0.8";
    const LONG: Duration = Duration::from_secs(10);

    #[test]
    fn formats_of_polarization_cameras_are_read_by_their_bits() {
        let name = |code| format_of(code).map(|(format, packing)| (format.name(), packing));
        assert_eq!(name(0x0108_0001), Some(("mono8".to_owned(), Packing::None)));
        // LUCID: PolarizeMono8, 12p, 12Packed, 16, and four pictures in one
        assert_eq!(name(0x8108_0001), Some(("mono8".to_owned(), Packing::None)));
        assert_eq!(name(0x810c_0047), Some(("mono12p".to_owned(), Packing::Dense)));
        assert_eq!(name(0x810c_0006), Some(("mono12p".to_owned(), Packing::Gige)));
        assert_eq!(name(0x8110_0007), Some(("mono16".to_owned(), Packing::None)));
        assert_eq!(name(0x8220_000f), None);
        assert!(FORMATS.iter().all(|(code, format, _)| {
            let plain = format.bits().unwrap_or(0) * if format.planes() == 3 && code >> 24 == 2 { 3 } else { 1 };
            let bits = code >> 16 & 0xff;
            bits == plain || bits == 16
        }));
    }

    #[test]
    fn packed_samples_are_unpacked_in_both_layouts() {
        let samples = [0xABC, 0x123, 0x000, 0xFFF];
        let words = |packing, bits, bytes: &[u8]| {
            let mut words = [0; 8];
            unpack(packing, bits, bytes, &mut words);
            words.as_chunks::<2>().0.iter().map(|word| u16::from_le_bytes(*word)).collect::<Vec<_>>()
        };
        assert_eq!(words(Packing::Dense, 12, &[0xBC, 0x3A, 0x12, 0x00, 0xF0, 0xFF]), samples);
        assert_eq!(words(Packing::Gige, 12, &[0xAB, 0x3C, 0x12, 0x00, 0xF0, 0xFF]), samples);
        assert_eq!(words(Packing::Dense, 10, &[0xFF, 0x07, 0xA0, 0x6A, 0x55]), [0x3FF, 0x001, 0x2AA, 0x155]);
    }

    #[test]
    fn a_source_has_settings_and_wrong_ones_are_named() {
        let source: Source = "Fake-1,bin=2,offset=8x16,trigger=Software".parse().unwrap();
        assert_eq!((source.bin, source.offset, source.trigger.as_str()), (2, Some([8, 16]), "Software"));
        let e = "Fake-1,zoom=2".parse::<Source>().unwrap_err();
        assert_eq!(e, "\"zoom=2\", allowed: bin=N, offset=XxY, trigger=INPUT");
    }

    /// A fake camera on the loopback interface, one at a time; it ends when this is dropped.
    struct Fake {
        request: Request,
        process: Child,
        _alone: MutexGuard<'static, ()>,
    }

    impl Fake {
        /// Starts a camera and waits until it is found; none where there is no such program.
        fn start() -> Option<Self> {
            static ALONE: Mutex<()> = Mutex::new(());
            let alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
            let serial = format!("TEST-{}", std::process::id());
            let Ok(process) = Command::new(PROGRAM).args(["-i", "127.0.0.1", "-s", &serial]).spawn() else {
                eprintln!("SKIPPED: no {PROGRAM}; scripts/genicam.sh installs it");
                return None;
            };
            let mut fake = Self { request: Request::new(Role::Raw, &Clock::default()), process, _alone: alone };
            let found = (0..50).find_map(|_| {
                std::thread::sleep(Duration::from_millis(100));
                devices().into_iter().find(|(id, _)| id.ends_with(&serial))
            });
            fake.request.source = found.expect("the fake camera answers").0;
            Some(fake)
        }
    }

    impl Drop for Fake {
        fn drop(&mut self) {
            let _ = self.process.kill();
            let _ = self.process.wait();
        }
    }

    /// Size, format and metadata of the next intact frame: a busy machine loses packets.
    fn intact(camera: &mut dyn Camera) -> ((Size, PixelFormat), Metadata) {
        let next = |_| match camera.next_frame(LONG) {
            Ok(frame) => Some(((frame.size(), frame.format()), frame.metadata)),
            Err(e) => {
                assert!(e.is_passing(), "{e}");
                None
            }
        };
        (0..50).find_map(next).expect("an intact frame")
    }

    #[test]
    fn fake_camera_is_listed_and_gives_frames_of_every_format_and_region() {
        let Some(fake) = Fake::start() else { return };
        let request = fake.request.clone();
        let listed = list().unwrap().into_iter().find(|camera| camera.source == request.source).unwrap();
        let formats: Vec<_> = listed.modes.iter().flat_map(|mode| mode.formats.clone()).collect();
        assert!(["mono8", "mono16"].iter().all(|format| formats.contains(&(*format).to_owned())), "{formats:?}");
        for (format, size) in
            [("mono8", Size::new(512, 256)), ("mono16", Size::new(640, 480)), ("bggr8", Size::new(256, 512))]
        {
            let format: PixelFormat = format.parse().unwrap();
            if !formats.contains(&format.name()) {
                continue;
            }
            let mode = Mode { size: Some(size), format: Some(format), exposure_us: Some(5000.0), ..Mode::default() };
            let mut camera =
                camera::open("genicam", &Request { mode, frame_rate: Some(20.0), ..request.clone() }).unwrap();
            let mut last = None;
            for _ in 0..5 {
                let (found, metadata) = intact(camera.as_mut());
                assert_eq!((found, metadata.exposure_us), ((size, format), Some(5000.0)));
                let now = (metadata.sequence, metadata.timestamp);
                assert!(last.is_none_or(|(sequence, time)| now.0 > sequence && now.1 > time), "{now:?}");
                last = Some(now);
            }
        }
    }

    #[test]
    fn fake_camera_refuses_what_it_cannot_and_gives_a_frame_for_each_trigger() {
        let Some(fake) = Fake::start() else { return };
        let request = fake.request.clone();
        let refused = |request: &Request| camera::open("genicam", request).err().unwrap().to_string();
        let mode = Mode { size: Some(Size::new(9000, 16)), ..Mode::default() };
        assert!(refused(&Request { mode, ..request.clone() }).contains("regions within"));
        let mode = Mode { format: Some("mono12p".parse().unwrap()), ..Mode::default() };
        let refusal = refused(&Request { mode, ..request.clone() });
        assert!(refusal.contains("does not support") && refusal.contains("mono16"), "{refusal}");
        assert!(refused(&Request { source: "nobody".into(), ..request.clone() }).contains("allowed: one of"));
        let timing = Timing { triggered: true, ..Timing::default() };
        let source = format!("{},trigger=Software", request.source);
        let request = Request { source, timing, ..request };
        let mut camera = camera::open("genicam", &request).unwrap();
        let silent = (0..3).find_map(|_| camera.next_frame(Duration::from_millis(300)).err());
        assert!(matches!(silent, Some(CameraError::Waiting { .. })), "{silent:?}");
        drop(camera);
        let mut camera = start(&request).unwrap();
        for _ in 0..3 {
            assert!(matches!(camera.next_frame(Duration::from_millis(300)), Err(CameraError::Timeout { .. })));
            camera.device.0.software_trigger().unwrap();
            camera.next_frame(LONG).unwrap();
        }
    }

    #[test]
    fn fake_camera_that_is_switched_off_is_lost() {
        let Some(mut fake) = Fake::start() else { return };
        let mut camera = camera::open("genicam", &fake.request).unwrap();
        intact(camera.as_mut());
        fake.process.kill().unwrap();
        let begin = std::time::Instant::now();
        let lost = std::iter::from_fn(|| Some(camera.next_frame(Duration::from_secs(1)).err()))
            .take_while(|_| begin.elapsed() < 2 * LONG)
            .any(|e| matches!(e, Some(CameraError::Lost { .. })));
        assert!(lost);
    }
}
