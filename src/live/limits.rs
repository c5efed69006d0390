//! Numbers of frames and bytes that the service holds at once. Queues are sized by them and the memory plan counts them.

/// Frames that may wait for the recorder. A newer one then replaces the oldest.
pub(super) const RECORDER_QUEUE: usize = 2;
/// Frames that recording holds: those that wait and the one that is being written.
pub(super) const RECORDER_FRAMES: usize = RECORDER_QUEUE + 1;
/// Frames of one camera that exist beside the waiting ones: the one that arrives and the one that is being solved.
pub(super) const FRAMES_IN_WORK: usize = 2;
/// Results beside those that recording holds: being written, the next, and with a preview the one that is shown or being
/// encoded and one that a client takes at its pace. While all are in use the solver waits for the encoder, for a few milliseconds.
const RESULTS: usize = 4;
/// Most results that exist at once.
pub(super) const MAX_RESULTS: usize = RESULTS + RECORDER_FRAMES;

/// Number of results that exist at once.
pub(super) fn results(preview: bool, records: bool) -> usize {
    RESULTS - 2 * usize::from(!preview) + if records { RECORDER_FRAMES } else { 0 }
}
