//! Software synchronization of libcamera: whether it is reached, or only listed.

/// Frames without a report after which the synchronization counts as missing.
const SILENT_FRAMES: u32 = 10;

/// Warning about a synchronization that does nothing.
pub(super) const NO_SYNC: &str = "sync is listed by libcamera, but no frame reports SyncReady, so the cameras run freely: it needs the libcamera \
     of Raspberry Pi and `rpi.sync` in the tuning file of the sensor; without it use a hardware trigger and sync = \"off\"";

/// State of a synchronization that is not reached yet.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Synchronization {
    /// Id of the control `SyncReady`, if this libcamera knows it.
    pub(super) id: Option<u32>,
    silent: u32,
}

/// Statement of a frame on the synchronization.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Progress {
    /// Not reached; the frame is not to be used.
    Waits,
    Reached,
    /// Nothing reports it.
    Missing,
}

impl Synchronization {
    pub(super) fn new(id: Option<u32>) -> Self {
        Self { id, silent: 0 }
    }

    /// Takes what a frame reports as `SyncReady`.
    pub(super) fn note(&mut self, ready: Option<bool>) -> Progress {
        match ready {
            Some(true) => Progress::Reached,
            Some(false) => {
                self.silent = 0;
                Progress::Waits
            }
            None => {
                self.silent += 1;
                if self.silent >= SILENT_FRAMES { Progress::Missing } else { Progress::Waits }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_wait_for_the_synchronization_and_one_that_is_only_listed_is_found() {
        let mut sync = Synchronization::new(Some(7));
        assert!((0..100).all(|_| sync.note(Some(false)) == Progress::Waits));
        assert_eq!(sync.note(Some(true)), Progress::Reached);
        let mut listed = Synchronization::new(None);
        assert!((1..SILENT_FRAMES).all(|_| listed.note(None) == Progress::Waits));
        assert_eq!(listed.note(None), Progress::Missing);
        assert!(NO_SYNC.contains("rpi.sync") && listed.id.is_none());
    }
}
