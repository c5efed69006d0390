//! Time stamps: from the instant that a camera stamps to the middle of the exposure, by which frames are paired.

use std::time::Duration;

use crate::board::{Stamp, Timing};
use stokescope_core::frame::Metadata;

/// Moves time stamps to the middle of the exposure of the middle row.
#[derive(Clone, Copy, Debug)]
pub(super) struct Exposure {
    /// Instant that the camera stamps; `None` for frames whose time stamps are those of the middle already.
    stamp: Option<Stamp>,
    /// Time from the read-out of the first row to that of the middle row.
    half_readout: Duration,
    /// Exposure time that replaces the reported one, in microseconds.
    fixed_us: Option<f32>,
}

impl Exposure {
    /// For a camera whose backend stamps `stamp` and reports a read-out of `readout`. The board file goes before both. `exposure_us` is
    /// that of the board file, which is true for an external trigger, where the sensor's own report is not.
    pub(super) fn new(
        stamp: Option<Stamp>,
        readout: Option<Duration>,
        timing: &Timing,
        exposure_us: Option<f32>,
    ) -> Self {
        let told = timing.readout_us.map(|us| Duration::from_secs_f32(1e-6 * us));
        let half_readout = told.or(readout).unwrap_or_default() / 2;
        Self {
            stamp: stamp.map(|stamp| timing.clock.unwrap_or(stamp)),
            half_readout,
            fixed_us: exposure_us.filter(|_| timing.triggered),
        }
    }

    /// Gives `metadata` the middle of the exposure as time stamp. `now` is the monotonic time of arrival.
    pub(super) fn apply(&self, metadata: &mut Metadata, now: impl FnOnce() -> Duration) {
        metadata.exposure_us = self.fixed_us.or(metadata.exposure_us);
        let half = Duration::from_secs_f32(0.5e-6 * metadata.exposure_us.unwrap_or(0.0).max(0.0));
        let stamped = metadata.timestamp;
        metadata.timestamp = match self.stamp {
            None => stamped,
            Some(Stamp::ExposureStart) => stamped + self.half_readout + half,
            Some(Stamp::ExposureEnd) => (stamped + self.half_readout).saturating_sub(half),
            // the last row arrives half a read-out after the middle one
            Some(Stamp::Arrival) => now().saturating_sub(self.half_readout + half),
        };
    }
}

/// Time on the system's monotonic clock, which time stamps of real cameras are on.
pub(super) fn monotonic() -> Duration {
    let time = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
    Duration::new(time.tv_sec.max(0) as u64, time.tv_nsec as u32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_kind_of_stamp_gives_the_middle_of_the_exposure() {
        let ms = Duration::from_millis;
        let of = |stamp, timing: Timing, readout| {
            let mut metadata = Metadata { timestamp: ms(1000), exposure_us: Some(20_000.0), ..Metadata::default() };
            Exposure::new(stamp, readout, &timing, Some(8000.0)).apply(&mut metadata, || ms(1100));
            metadata.timestamp
        };
        let plain = Timing::default();
        assert_eq!(of(None, plain, None), ms(1000), "simulated frames");
        assert_eq!(of(Some(Stamp::ExposureEnd), plain, None), ms(990));
        assert_eq!(of(Some(Stamp::ExposureEnd), plain, Some(ms(24))), ms(1002), "rolling shutter");
        let own = Timing { readout_us: Some(10_000.0), ..plain };
        assert_eq!(of(Some(Stamp::ExposureEnd), own, Some(ms(24))), ms(995), "the board file goes first");
        let start = Timing { clock: Some(Stamp::ExposureStart), ..plain };
        assert_eq!(of(Some(Stamp::ExposureEnd), start, None), ms(1010));
        let arrival = Timing { clock: Some(Stamp::Arrival), ..own };
        assert_eq!(of(Some(Stamp::ExposureEnd), arrival, None), ms(1085));
        let triggered = Timing { triggered: true, ..plain };
        assert_eq!(of(Some(Stamp::ExposureEnd), triggered, None), ms(996), "exposure of the board file");
    }

    #[test]
    fn the_monotonic_clock_goes_on() {
        let begin = monotonic();
        assert!(begin > Duration::ZERO && monotonic() >= begin);
    }
}
