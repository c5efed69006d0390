//! State of the machine as its kernel reports it in `/sys`: temperature, clock, throttling, undervoltage.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use parking_lot::Mutex;
use serde::Serialize;
use serde_json::json;

use super::events::Events;
use super::stop::Stop;
use crate::board::Thermal;

/// Pause between two readings of the machine's state.
const PAUSE: Duration = Duration::from_secs(2);
/// Report of a Raspberry Pi's firmware: bits for undervoltage, capped clock, throttling and the soft temperature limit.
const FIRMWARE: &str = "devices/platform/soc/soc:firmware/get_throttled";

/// State of the machine at one moment. Values that the kernel does not report are none.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub(super) struct Machine {
    /// Temperature of the hottest zone, in °C.
    pub(super) temperature_c: Option<f32>,
    /// Clock of the slowest processor, in MHz.
    pub(super) clock_mhz: Option<u32>,
    /// Highest clock of the slowest processor, in MHz.
    pub(super) max_clock_mhz: Option<u32>,
    /// Whether heat lowers the clock.
    pub(super) throttled: bool,
    /// Whether the supply voltage is too low.
    pub(super) undervoltage: bool,
    /// Whether the board's highest temperature is reached.
    pub(super) hot: bool,
    /// Whether the board's temperature to warn at is reached.
    pub(super) warm: bool,
}

impl Machine {
    /// Reads the state from `sysfs`, which is `/sys` except in tests, and compares it with the board's temperatures.
    pub(super) fn read(sysfs: &Path, thermal: Thermal) -> Self {
        let zones = entries(sysfs, "class/thermal", "thermal_zone");
        let temperature = zones.iter().filter_map(|zone| number(&zone.join("temp"))).max().map(|t| t as f32 / 1000.0);
        let clock = |file: &str| {
            let policies = entries(sysfs, "devices/system/cpu/cpufreq", "policy");
            policies.iter().filter_map(|p| number(&p.join(file))).min().and_then(|khz| u32::try_from(khz / 1000).ok())
        };
        let firmware = text(&sysfs.join(FIRMWARE));
        let bits = firmware.and_then(|t| u32::from_str_radix(t.trim_start_matches("0x"), 16).ok()).unwrap_or(0);
        let cooling = entries(sysfs, "class/thermal", "cooling_device").iter().any(|device| {
            let kind = text(&device.join("type")).unwrap_or_default();
            let clocks = kind.contains("cpufreq") || kind == "Processor";
            clocks && number(&device.join("cur_state")).is_some_and(|state| state > 0)
        });
        let weak = entries(sysfs, "class/hwmon", "hwmon").iter().any(|sensor| {
            text(&sensor.join("name")).as_deref() == Some("rpi_volt")
                && number(&sensor.join("in0_lcrit_alarm")) == Some(1)
        });
        Self {
            temperature_c: temperature,
            clock_mhz: clock("scaling_cur_freq"),
            max_clock_mhz: clock("cpuinfo_max_freq"),
            throttled: bits & 0b1110 != 0 || cooling,
            undervoltage: bits & 1 != 0 || weak,
            hot: temperature.is_some_and(|t| t >= thermal.limit_celsius),
            warm: temperature.is_some_and(|t| t >= thermal.warn_celsius),
        }
    }

    /// Reason why the machine is slower than it could be; none when it is not.
    pub(super) fn pressed(&self) -> Option<&'static str> {
        match (self.undervoltage, self.throttled, self.hot) {
            (true, ..) => Some("undervoltage"),
            (_, true, _) => Some("throttled by heat"),
            (_, _, true) => Some("too hot"),
            _ => None,
        }
    }
}

/// Latest state of the machine, shared between threads.
#[derive(Debug)]
pub(super) struct MachineStatus {
    sysfs: PathBuf,
    thermal: Thermal,
    latest: Mutex<Machine>,
    events: Arc<Events>,
}

impl MachineStatus {
    /// Reads the state for the first time.
    pub(super) fn new(sysfs: PathBuf, thermal: Thermal, events: Arc<Events>) -> Self {
        let status = Self { sysfs, thermal, latest: Mutex::default(), events };
        status.refresh();
        status
    }

    pub(super) fn get(&self) -> Machine {
        self.latest.lock().clone()
    }

    /// Reads the state until the service stops.
    pub(super) fn run(&self, stop: &Stop) {
        while !stop.is_set() {
            stop.wait(PAUSE);
            self.refresh();
        }
    }

    /// Reads the state. Reports when the machine begins or ends to be slowed down.
    fn refresh(&self) {
        let machine = Machine::read(&self.sysfs, self.thermal);
        let (pressed, celsius) = (machine.pressed(), machine.temperature_c);
        let before = std::mem::replace(&mut *self.latest.lock(), machine);
        if before.pressed() != pressed {
            match pressed {
                Some(why) => tracing::warn!("the machine is slowed down: {why}"),
                None => tracing::info!("the machine is at full speed again"),
            }
            self.events.emit("machine", json!({ "pressed": pressed, "temperature_c": celsius }));
        }
    }
}

fn entries(sysfs: &Path, folder: &str, prefix: &str) -> Vec<PathBuf> {
    let found = fs::read_dir(sysfs.join(folder)).into_iter().flatten().flatten().map(|entry| entry.path());
    found.filter(|p| p.file_name().is_some_and(|n| n.to_string_lossy().starts_with(prefix))).collect()
}

fn text(file: &Path) -> Option<String> {
    fs::read_to_string(file).ok().map(|t| t.trim().to_owned())
}

fn number(file: &Path) -> Option<i64> {
    text(file)?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(sysfs: &Path) -> Machine {
        Machine::read(sysfs, Thermal { warn_celsius: 60.0, limit_celsius: 78.0 })
    }

    fn write(sysfs: &Path, file: &str, text: &str) {
        let path = sysfs.join(file);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, text).unwrap();
    }

    #[test]
    fn values_that_the_kernel_does_not_report_are_none() {
        let dir = tempfile::tempdir().unwrap();
        assert_eq!(read(dir.path()), Machine::default());
        write(dir.path(), "class/thermal/thermal_zone0/temp", "48312\n");
        write(dir.path(), "class/thermal/thermal_zone1/temp", "51000\n");
        write(dir.path(), "class/thermal/cooling_device0/type", "cpufreq-cpu0\n");
        write(dir.path(), "class/thermal/cooling_device0/cur_state", "0\n");
        write(dir.path(), "devices/system/cpu/cpufreq/policy0/scaling_cur_freq", "600000\n");
        write(dir.path(), "devices/system/cpu/cpufreq/policy0/cpuinfo_max_freq", "1800000\n");
        let machine = read(dir.path());
        assert_eq!(
            (machine.temperature_c, machine.clock_mhz, machine.max_clock_mhz),
            (Some(51.0), Some(600), Some(1800))
        );
        assert_eq!(machine.pressed(), None);
        write(dir.path(), "class/thermal/cooling_device0/cur_state", "2\n");
        assert_eq!(read(dir.path()).pressed(), Some("throttled by heat"));
    }

    #[test]
    fn a_board_says_how_hot_it_may_get() {
        let dir = tempfile::tempdir().unwrap();
        let zone = "class/thermal/thermal_zone0/temp";
        for (temp, warm, pressed) in [("59900", false, None), ("60000", true, None), ("78000", true, Some("too hot"))] {
            write(dir.path(), zone, temp);
            let machine = read(dir.path());
            assert_eq!((machine.warm, machine.pressed()), (warm, pressed), "{temp}");
        }
    }

    #[test]
    fn the_firmware_of_a_raspberry_pi_is_understood() {
        let dir = tempfile::tempdir().unwrap();
        // past events alone are no pressure
        write(dir.path(), FIRMWARE, "50000\n");
        assert_eq!(read(dir.path()).pressed(), None);
        write(dir.path(), FIRMWARE, "50005\n");
        assert_eq!(read(dir.path()).pressed(), Some("undervoltage"));
        write(dir.path(), FIRMWARE, "0x4\n");
        assert_eq!(read(dir.path()).pressed(), Some("throttled by heat"));
        write(dir.path(), FIRMWARE, "0\n");
        write(dir.path(), "class/hwmon/hwmon1/name", "rpi_volt\n");
        write(dir.path(), "class/hwmon/hwmon1/in0_lcrit_alarm", "1\n");
        assert!(read(dir.path()).undervoltage);
    }
}
