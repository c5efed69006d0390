//! Parts of the running service that requests read and change.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicUsize;
use std::time::Instant;

use parking_lot::Mutex;

use crate::live::controls::Controls;
use crate::live::events::Events;
use crate::live::machine::MachineStatus;
use crate::live::pairing::Pairing;
use crate::live::preview::Broadcast;
use crate::live::quality::QualityStatus;
use crate::live::statistics::{Statistics, Timings};

/// Parts of the running service that requests read and change.
#[derive(Debug)]
pub(in crate::live) struct Context {
    /// Name of the board.
    pub(in crate::live) board: String,
    /// Folder of the results.
    pub(in crate::live) out: PathBuf,
    pub(in crate::live) started: Instant,
    /// Whether frames are recorded.
    pub(in crate::live) records: bool,
    pub(in crate::live) pairing: Arc<Pairing>,
    pub(in crate::live) broadcast: Arc<Broadcast>,
    pub(in crate::live) controls: Arc<Controls>,
    pub(in crate::live) quality: Arc<QualityStatus>,
    pub(in crate::live) machine: Arc<MachineStatus>,
    pub(in crate::live) statistics: Arc<Mutex<Statistics>>,
    pub(in crate::live) timings: Arc<Timings>,
    pub(in crate::live) events: Arc<Events>,
    /// Connections that are being served.
    pub(in crate::live) clients: AtomicUsize,
}

#[cfg(test)]
pub(super) mod tests {
    use std::time::Duration;

    use super::*;
    use crate::board::Thermal;
    use crate::live::preview::View;
    use crate::live::quality::Governor;
    use crate::model::Selection;
    use stokescope_core::image::Size;

    /// A service before its first frame, of 4 × 3 pixels, without a guide camera.
    pub(in crate::live::http) fn context() -> Arc<Context> {
        let (events, _) = Events::new(Instant::now(), false);
        let events = Arc::new(events);
        let thermal = Thermal { warn_celsius: 60.0, limit_celsius: 78.0 };
        Arc::new(Context {
            board: "test".into(),
            out: PathBuf::from("out"),
            started: Instant::now(),
            records: true,
            pairing: Arc::new(Pairing::new("raw".into(), None, 2, Duration::ZERO, false)),
            broadcast: Arc::new(Broadcast::new(&View::all(&[], false), Size::new(4, 3), 90)),
            controls: Arc::new(Controls::new(true, 10, Selection::default())),
            quality: Arc::new(QualityStatus::new(Governor::new(None, 10).quality().clone())),
            machine: Arc::new(MachineStatus::new(PathBuf::from("/nonexistent"), thermal, Arc::clone(&events))),
            statistics: Arc::default(),
            timings: Arc::default(),
            events,
            clients: AtomicUsize::new(0),
        })
    }
}
