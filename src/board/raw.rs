//! A board file as written: every key is optional because it can be inherited from another board.

use std::path::Path;

use serde::Deserialize;

use super::{Board, BundleSource, CameraSpec, Core, Cpu, Fusion, MAX_QUEUE_FRAMES, MeasuredTimes, Preview, Thermal};
use super::{HOST_NAME, host_name};
use crate::config::{Checker, Spanned};
use stokescope_core::frame::{FormatNameError, PixelFormat};

use super::{Mode, Readout, Stamp, Sync, Timing};
use crate::model::Precision;
use stokescope_core::image::{Size, Window};
use stokescope_core::optics::FftBackend;

const MIB: i64 = 1 << 20;
/// Longest side of a frame, in pixels.
const MAX_SIDE: i64 = 16_384;
/// Default length of each camera's frame queue.
const DEFAULT_QUEUE_FRAMES: usize = 3;

/// Fills missing keys of one file with those of another.
trait Inherit {
    fn inherit(self, base: Self) -> Self;
}

impl<T> Inherit for Option<T> {
    fn inherit(self, base: Self) -> Self {
        self.or(base)
    }
}

/// Declares a TOML table whose keys are all optional.
macro_rules! table {
    ($visible:vis struct $name:ident { $($(#[$doc:meta])* $key:ident: $type:ty,)* }) => {
        #[derive(Debug, Default, Deserialize)]
        #[serde(deny_unknown_fields, default)]
        $visible struct $name { $($(#[$doc])* $key: $type,)* }
        impl Inherit for $name {
            fn inherit(self, base: Self) -> Self {
                Self { $($key: self.$key.inherit(base.$key),)* }
            }
        }
    };
}

table! {
    pub(super) struct BoardFile {
        inherit: Option<Spanned<String>>,
        description: Option<String>,
        soc: Option<String>,
        cpu: CpuTable,
        memory: MemoryTable,
        thermal: ThermalTable,
        solver: SolverTable,
        fusion: FusionTable,
        sensor: SensorTable,
        cameras: CamerasTable,
        preview: PreviewTable,
        measured: Option<MeasuredTable>,
    }
}

/// Table `[measured]`, as printed by `scripts/on-board.sh`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct MeasuredTable {
    width: Spanned<i64>,
    height: Spanned<i64>,
    iterations: Spanned<i64>,
    prepare_ms: Spanned<f64>,
    register_ms: Spanned<f64>,
    recon_ms: Spanned<f64>,
    fusion_ms: Option<Spanned<f64>>,
}

table! {
    struct CpuTable {
        core: Option<Spanned<String>>,
        cores: Option<Spanned<i64>>,
        clock_mhz: Option<Spanned<i64>>,
    }
}

table! {
    struct MemoryTable {
        limit_bytes: Option<Spanned<i64>>,
    }
}

table! {
    struct ThermalTable {
        warn_celsius: Option<Spanned<f64>>,
        limit_celsius: Option<Spanned<f64>>,
    }
}

table! {
    struct SolverTable {
        threads: Option<Spanned<i64>>,
        fft: Option<FftBackend>,
        iterations: Option<Spanned<i64>>,
        video: Option<bool>,
        register: Option<bool>,
        refit_psf: Option<bool>,
    }
}

table! {
    struct FusionTable {
        model: Option<String>,
        precision: Option<Precision>,
    }
}

table! {
    struct SensorTable {
        channels: Option<Spanned<i64>>,
        crop: Option<Spanned<Vec<i64>>>,
        bin: Option<Spanned<i64>>,
        orientation: Option<Spanned<i64>>,
    }
}

table! {
    struct CamerasTable {
        calibration: Option<String>,
        max_skew_us: Option<Spanned<i64>>,
        queue_frames: Option<Spanned<i64>>,
        single_shots: Option<bool>,
        raw: CameraTable,
        /// `false` leaves out an inherited guide camera.
        guided: Option<bool>,
        guide: CameraTable,
    }
}

table! {
    struct CameraTable {
        backend: Option<String>,
        source: Option<String>,
        frame_rate: Option<Spanned<f64>>,
        paced: Option<bool>,
        width: Option<Spanned<i64>>,
        height: Option<Spanned<i64>>,
        format: Option<Spanned<String>>,
        bits: Option<Spanned<i64>>,
        exposure_us: Option<Spanned<f64>>,
        gain: Option<Spanned<f64>>,
        sync: Option<Spanned<String>>,
        trigger: Option<Spanned<String>>,
        clock: Option<Spanned<String>>,
        readout_us: Option<Spanned<f64>>,
        max_identical: Option<Spanned<i64>>,
    }
}

table! {
    struct PreviewTable {
        jpeg_quality: Option<Spanned<i64>>,
        max_clients: Option<Spanned<i64>>,
        allowed_hosts: Option<Vec<Spanned<String>>>,
    }
}

impl PreviewTable {
    fn validate(self, check: &mut Checker<'_>) -> Preview {
        let jpeg_quality = within("preview.jpeg_quality", self.jpeg_quality, 1, 100, check) as u8;
        let max_clients = within("preview.max_clients", self.max_clients, 1, 1000, check) as usize;
        let allowed_hosts = self.allowed_hosts.unwrap_or_default();
        for name in allowed_hosts.iter().filter(|name| host_name(name.get_ref()).is_err()) {
            let found = format!("{:?}", name.get_ref());
            check.reject("preview.allowed_hosts", Some(name.span().start), found, HOST_NAME);
        }
        let allowed_hosts = allowed_hosts.into_iter().map(Spanned::into_inner).collect();
        Preview { jpeg_quality, max_clients, allowed_hosts }
    }
}

impl CameraTable {
    /// Clears what `base` says about a camera of another backend than this one; only the pace of the frames remains.
    fn forget_other_backend(&self, base: &mut Self) {
        if self.backend.is_some() && self.backend != base.backend {
            let (frame_rate, paced) = (base.frame_rate.take(), base.paced);
            *base = Self { frame_rate, paced, ..Self::default() };
        }
    }

    /// When the camera of table `name` exposes, by its keys `readout_us`, `clock` and `trigger`. A trigger needs a fixed exposure.
    fn timing(&mut self, name: &str, check: &mut Checker<'_>) -> Timing {
        let key = |key: &str| format!("{name}.{key}");
        let readout_us = self.readout_us.take().map(|time| {
            let ok = (0.0..=1e6).contains(time.get_ref());
            check.check(&key("readout_us"), &time, ok, "0 to 1000000 microseconds") as f32
        });
        let clock = self.clock.take().and_then(|word| named(&key("clock"), &word, &Stamp::NAMES, check));
        let triggered = self.trigger.take().is_some_and(|word| {
            let found = named(&key("trigger"), &word, &[(false, "off"), (true, "external")], check) == Some(true);
            if found && self.exposure_us.is_none() {
                let allowed = "with exposure_us, because the sensor does not know how long a trigger lets it expose";
                check.reject(&key("trigger"), Some(word.span().start), "\"external\"".to_owned(), allowed);
            }
            found
        });
        Timing { clock, readout_us, triggered }
    }

    /// Size of the frames, of which both sides or none is given.
    fn size(&self, name: &str, check: &mut Checker<'_>) -> Option<Size> {
        let key = |key: &str| format!("{name}.{key}");
        let mut side = |of: &str, value: &Spanned<i64>| {
            let ok = (1..=MAX_SIDE).contains(value.get_ref());
            check.check(&key(of), value, ok, &format!("1 to {MAX_SIDE}")) as usize
        };
        match (&self.width, &self.height) {
            (Some(width), Some(height)) => Some(Size::new(side("width", width), side("height", height))),
            (Some(one), None) | (None, Some(one)) => {
                let (own, other) = if self.width.is_some() { ("width", "height") } else { ("height", "width") };
                let (at, found) = (Some(one.span().start), one.get_ref().to_string());
                check.reject(&key(own), at, found, &format!("with {other}"));
                None
            }
            (None, None) => None,
        }
    }

    /// Validates the table `name`: `cameras.raw` or `cameras.guide`.
    fn validate(mut self, name: &str, check: &mut Checker<'_>) -> CameraSpec {
        let timing = self.timing(name, check);
        let size = self.size(name, check);
        let key = |key: &str| format!("{name}.{key}");
        let backend = required(&key("backend"), self.backend, check).unwrap_or_default();
        let source = required(&key("source"), self.source, check).unwrap_or_default();
        let frame_rate = self.frame_rate.map(|rate| {
            let ok = *rate.get_ref() > 0.0 && *rate.get_ref() <= 1000.0;
            check.check(&key("frame_rate"), &rate, ok, "above 0, to 1000 frames per second")
        });
        let format = self.format.and_then(|name| {
            let format = name.get_ref().parse::<PixelFormat>().ok();
            if format.is_none() {
                let found = format!("{:?}", name.get_ref());
                check.reject(&key("format"), Some(name.span().start), found, &FormatNameError::allowed());
            }
            format
        });
        let bits = self.bits.map(|bits| {
            // 16-bit frames hold the readings of any depth
            let of_format = format.and_then(PixelFormat::bits).filter(|depth| *depth != 16).map(i64::from);
            let ok = (8..=16).contains(bits.get_ref()) && of_format.is_none_or(|depth| depth == *bits.get_ref());
            let allowed = of_format.map_or_else(|| "8 to 16".to_owned(), |depth| format!("{depth} with this format"));
            check.check(&key("bits"), &bits, ok, &allowed) as u32
        });
        let exposure_us = self.exposure_us.map(|time| {
            let ok = (1.0..=1e9).contains(time.get_ref());
            check.check(&key("exposure_us"), &time, ok, "1 to 1000000000 microseconds") as f32
        });
        let gain = self.gain.map(|gain| {
            let ok = (0.0..=1e6).contains(gain.get_ref());
            check.check(&key("gain"), &gain, ok, "0 to 1000000") as f32
        });
        let sync =
            self.sync.map_or(Sync::Off, |word| synchronization(&key("sync"), &word, frame_rate.is_some(), check));
        let max_identical = self.max_identical.map(|frames| {
            let ok = (0..=100_000).contains(frames.get_ref());
            check.check(&key("max_identical"), &frames, ok, "0 to 100000 frames, 0 is never") as u32
        });
        let mode = Mode { size, format, bits, exposure_us, gain, sync };
        CameraSpec { backend, source, frame_rate, paced: self.paced.unwrap_or(true), mode, timing, max_identical }
    }
}

/// The value that `word` names.
fn named<T: Copy>(key: &str, word: &Spanned<String>, names: &[(T, &str)], check: &mut Checker<'_>) -> Option<T> {
    let found = names.iter().find(|(_, known)| known == word.get_ref()).map(|(value, _)| *value);
    if found.is_none() {
        let allowed: Vec<&str> = names.iter().map(|(_, name)| *name).collect();
        check.reject(key, Some(word.span().start), format!("{:?}", word.get_ref()), &allowed.join(", "));
    }
    found
}

/// The synchronization that `word` names; a clock needs a frame rate.
fn synchronization(key: &str, word: &Spanned<String>, paced: bool, check: &mut Checker<'_>) -> Sync {
    let found = Sync::NAMES.iter().find(|(_, known)| known == word.get_ref());
    let names = Sync::NAMES.map(|(_, name)| name).join(", ");
    let allowed = match found {
        None => Some(names.as_str()),
        Some((Sync::Clock, _)) if !paced => Some("with frame_rate"),
        Some(_) => None,
    };
    if let Some(allowed) = allowed {
        check.reject(key, Some(word.span().start), format!("{:?}", word.get_ref()), allowed);
    }
    found.map_or(Sync::Off, |(sync, _)| *sync)
}

impl SensorTable {
    /// The part of frames of `size` that is used, and its channels; none where the board says nothing of it.
    fn validate(self, size: Option<Size>, check: &mut Checker<'_>) -> Option<Readout> {
        let (crop, size) = (self.crop?, size?);
        let at = Some(crop.span().start);
        let channels = self.channels.map_or(1, |channels| {
            check.check("sensor.channels", &channels, [1, 3].contains(channels.get_ref()), "1 or 3") as usize
        });
        // a Bayer mosaic gives planes of half its size
        let planes = if channels == 3 { Size::new(size.width / 2, size.height / 2) } else { size };
        let bin = self.bin.map_or(1, |bin| usize::try_from(*bin.get_ref()).unwrap_or(0));
        let sides: Vec<usize> = crop.get_ref().iter().filter_map(|side| usize::try_from(*side).ok()).collect();
        let found = match sides[..] {
            [x, y, width, height] => {
                Window::new(planes, [x, y], Size::new(width, height), bin).map_err(|e| e.to_string())
            }
            _ => Err("allowed: [x, y, width, height] in pixels".to_owned()),
        };
        match found {
            Ok(window) => Some(Readout { channels, window }),
            Err(e) => {
                check.reject("sensor.crop", at, format!("{:?}", crop.get_ref()), &e);
                None
            }
        }
    }
}

impl MeasuredTable {
    fn validate(&self, check: &mut Checker<'_>) -> MeasuredTimes {
        let mut count = |key: &str, value: &Spanned<i64>| {
            let ok = (1..=MAX_SIDE).contains(value.get_ref());
            check.check(&format!("measured.{key}"), value, ok, &format!("1 to {MAX_SIDE}")).max(1) as usize
        };
        let size = Size::new(count("width", &self.width), count("height", &self.height));
        let iterations = count("iterations", &self.iterations);
        let mut time = |key: &str, value: &Spanned<f64>| {
            let ok = (0.0..=1e6).contains(value.get_ref());
            check.check(&format!("measured.{key}"), value, ok, "0 to 1000000 milliseconds")
        };
        MeasuredTimes {
            size,
            iterations,
            prepare_ms: time("prepare_ms", &self.prepare_ms),
            register_ms: time("register_ms", &self.register_ms),
            recon_ms: time("recon_ms", &self.recon_ms),
            fusion_ms: self.fusion_ms.as_ref().map_or(0.0, |value| time("fusion_ms", value)),
        }
    }
}

/// Reports a key that neither this file nor the inherited one has.
fn required<T>(key: &str, value: Option<T>, check: &mut Checker<'_>) -> Option<T> {
    if value.is_none() {
        check.reject(key, None, "nothing".to_owned(), "a value, here or in the inherited board");
    }
    value
}

/// A required whole number from `low` to `high`; `low` where there is none.
fn within(key: &str, value: Option<Spanned<i64>>, low: i64, high: i64, check: &mut Checker<'_>) -> i64 {
    required(key, value, check)
        .map_or(low, |v| check.check(key, &v, (low..=high).contains(v.get_ref()), &format!("{low} to {high}")))
}

impl CpuTable {
    fn validate(self, check: &mut Checker<'_>) -> Cpu {
        let cores = within("cpu.cores", self.cores, 1, 256, check) as usize;
        let clock_mhz = within("cpu.clock_mhz", self.clock_mhz, 100, 10_000, check) as u32;
        let core = required("cpu.core", self.core, check).and_then(|name| {
            let core = Core::ALL.into_iter().find(|core| core.name() == name.get_ref());
            if core.is_none() {
                let allowed = Core::ALL.map(Core::name).join(", ");
                check.reject("cpu.core", Some(name.span().start), format!("{:?}", name.get_ref()), &allowed);
            }
            core
        });
        Cpu { core: core.unwrap_or(Core::X86), cores, clock_mhz }
    }
}

impl ThermalTable {
    fn validate(self, check: &mut Checker<'_>) -> Thermal {
        let mut celsius = |key: &str, value: Option<Spanned<f64>>, default: f32| {
            let ok = |v: &Spanned<f64>| (20.0..=150.0).contains(v.get_ref());
            value.map_or(default, |v| check.check(key, &v, ok(&v), "20 to 150") as f32)
        };
        let Thermal { warn_celsius, limit_celsius } = Thermal::DEFAULT;
        Thermal {
            warn_celsius: celsius("thermal.warn_celsius", self.warn_celsius, warn_celsius),
            limit_celsius: celsius("thermal.limit_celsius", self.limit_celsius, limit_celsius),
        }
    }
}

impl BoardFile {
    /// Takes the name of the board to inherit from.
    pub(super) fn take_base(&mut self) -> Option<Spanned<String>> {
        self.inherit.take()
    }

    /// Fills missing keys with those of `base`. Times measured on another board are not inherited, nor the mode of a camera of another
    /// backend.
    pub(super) fn inherit(self, base: Self) -> Self {
        let mut base = Self { measured: None, ..base };
        self.cameras.raw.forget_other_backend(&mut base.cameras.raw);
        self.cameras.guide.forget_other_backend(&mut base.cameras.guide);
        Inherit::inherit(self, base)
    }

    /// Builds the board that this file at `path` describes; all values out of range are reported to `check`.
    pub(super) fn validate(self, path: &Path, check: &mut Checker<'_>) -> Board {
        let cpu = self.cpu.validate(check);
        let thermal = self.thermal.validate(check);
        let mut within =
            |key: &str, value: Option<Spanned<i64>>, low: i64, high: i64| within(key, value, low, high, check);
        let memory_limit_bytes =
            within("memory.limit_bytes", self.memory.limit_bytes, 8 * MIB, 64 * 1024 * MIB) as usize;
        let threads = within("solver.threads", self.solver.threads, 1, 64) as usize;
        let iterations = within("solver.iterations", self.solver.iterations, 1, 10_000) as usize;
        let max_skew_us = within("cameras.max_skew_us", self.cameras.max_skew_us, 0, 1_000_000) as u64;
        let queue_frames = self.cameras.queue_frames.map_or(DEFAULT_QUEUE_FRAMES, |frames| {
            within("cameras.queue_frames", Some(frames), 1, MAX_QUEUE_FRAMES as i64) as usize
        });
        let raw = self.cameras.raw.validate("cameras.raw", check);
        let guided = self.cameras.guide.backend.is_some() && self.cameras.guided.unwrap_or(true);
        let guide = guided.then(|| self.cameras.guide.validate("cameras.guide", check));
        let orientation = self.sensor.orientation.as_ref().map(|degrees| {
            let ok = [0, 180].contains(degrees.get_ref());
            check.check("sensor.orientation", degrees, ok, "0 or 180 degrees") as u32
        });
        let readout = self.sensor.validate(raw.mode.size, check);
        let calibration = required("cameras.calibration", self.cameras.calibration, check).unwrap_or_default();
        let folder = path.parent().unwrap_or(Path::new(""));
        let fastest = if cpu.core.has_dot_product() { Precision::Int8 } else { Precision::F32 };
        Board {
            name: path.file_stem().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default(),
            description: required("description", self.description, check).unwrap_or_default(),
            soc: required("soc", self.soc, check).unwrap_or_default(),
            cpu,
            memory_limit_bytes,
            thermal,
            threads,
            fft: self.solver.fft.unwrap_or_default(),
            iterations,
            video: self.solver.video.unwrap_or(true),
            register: self.solver.register.unwrap_or(true),
            refit_psf: self.solver.refit_psf.unwrap_or(true),
            fusion: Fusion {
                model: self.fusion.model.map(Into::into).unwrap_or_default(),
                precision: self.fusion.precision.unwrap_or(fastest),
            },
            raw,
            readout,
            mounted: orientation,
            guide,
            max_skew_us,
            queue_frames,
            single_shots: self.cameras.single_shots.unwrap_or(false),
            calibration: match calibration.as_str() {
                "simulated" => BundleSource::Simulated,
                dir => BundleSource::Folder(folder.join(dir)),
            },
            preview: self.preview.validate(check),
            measured: self.measured.map(|table| table.validate(check)),
        }
    }
}
