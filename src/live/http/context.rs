//! Parts of the running service that requests read and change.

use std::path::PathBuf;
use std::sync::atomic::AtomicUsize;
use std::sync::{Arc, Weak};
use std::time::Instant;

use parking_lot::Mutex;
use tokio::sync::Semaphore;

use crate::live::controls::Controls;
use crate::live::events::Events;
use crate::live::machine::MachineStatus;
use crate::live::pairing::Pairing;
use crate::live::preview::Broadcast;
use crate::live::quality::QualityStatus;
use crate::live::recorder::Recorder;
use crate::live::statistics::{Rate, Statistics, Timings};

/// Pictures that each watcher took of late.
#[derive(Debug, Default)]
pub(in crate::live) struct Watchers(Mutex<Vec<Weak<Mutex<Rate>>>>);

impl Watchers {
    /// A place for the pictures of a watcher, until it is dropped.
    pub(super) fn join(&self) -> Arc<Mutex<Rate>> {
        let rate = Arc::<Mutex<Rate>>::default();
        let mut all = self.0.lock();
        all.retain(|other| other.strong_count() > 0);
        all.push(Arc::downgrade(&rate));
        rate
    }

    /// Pictures per second of the slowest watcher; none without one that took some.
    pub(super) fn slowest(&self) -> Option<f64> {
        let all = self.0.lock();
        let rates = all.iter().filter_map(Weak::upgrade).filter_map(|rate| rate.lock().steady());
        rates.min_by(f64::total_cmp)
    }
}

/// Parts of the running service that requests read and change.
#[derive(Debug)]
pub(in crate::live) struct Context {
    /// Name of the board.
    pub(in crate::live) board: String,
    /// Folder of the results.
    pub(in crate::live) out: PathBuf,
    pub(in crate::live) started: Instant,
    /// Recorder and folder of the sessions; none where nothing can be recorded.
    pub(in crate::live) recorder: Option<(Arc<Recorder>, PathBuf)>,
    pub(in crate::live) pairing: Arc<Pairing>,
    pub(in crate::live) broadcast: Arc<Broadcast>,
    pub(in crate::live) controls: Arc<Controls>,
    pub(in crate::live) quality: Arc<QualityStatus>,
    pub(in crate::live) machine: Arc<MachineStatus>,
    pub(in crate::live) statistics: Arc<Mutex<Statistics>>,
    pub(in crate::live) timings: Arc<Timings>,
    pub(in crate::live) events: Arc<Events>,
    /// Connections that are being served.
    pub(in crate::live) clients: Arc<AtomicUsize>,
    /// Pictures that watchers took of late.
    pub(in crate::live) watchers: Watchers,
    /// Right to download a session.
    pub(in crate::live) download: Arc<Semaphore>,
    /// Right to hold a frame for as long as its client takes it.
    pub(in crate::live) still: Arc<Semaphore>,
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
        let pairing = Arc::new(Pairing::new("raw".into(), None, 2, Duration::ZERO, false));
        let statistics = Arc::<Mutex<Statistics>>::default();
        let handles = (Arc::default(), Arc::clone(&pairing), Arc::clone(&statistics), Arc::clone(&events));
        let recorder = Recorder::new(Instant::now(), true, handles.0, handles.1, handles.2, handles.3);
        let thermal = Thermal { warn_celsius: 60.0, limit_celsius: 78.0 };
        Arc::new(Context {
            board: "test".into(),
            out: PathBuf::from("out"),
            started: Instant::now(),
            recorder: Some((Arc::new(recorder), PathBuf::from("sessions"))),
            pairing,
            broadcast: Arc::new(Broadcast::new(&View::all(&[], false), Size::new(4, 3), 90)),
            controls: Arc::new(Controls::new(true, 10, Selection::default())),
            quality: Arc::new(QualityStatus::new(Governor::new(None, 10).quality().clone())),
            machine: Arc::new(MachineStatus::new(PathBuf::from("/nonexistent"), thermal, Arc::clone(&events))),
            statistics,
            timings: Arc::default(),
            events,
            clients: Arc::default(),
            watchers: Watchers::default(),
            download: Arc::new(Semaphore::new(1)),
            still: Arc::new(Semaphore::new(1)),
        })
    }
}
