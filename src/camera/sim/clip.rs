//! Clips: frames that are rendered once, ahead of time, and shown to and fro from then on.

use std::io;
use std::sync::{Arc, OnceLock};
use std::thread;

/// Niceness of the rendering thread, the highest: it runs while nothing else needs the processor.
const NICENESS: i32 = 19;
/// Bytes of that thread's stack.
const STACK: usize = 512 << 10;

/// The frames of a clip. The first one is there from the start, the others appear in order.
#[derive(Debug)]
pub(super) struct Clip(Arc<[OnceLock<Box<[u8]>>]>);

impl Clip {
    /// Renders the first frame, and the others up to `count` on a thread of low priority. `render` is dropped after the last one, and the
    /// thread ends early when the clip is dropped.
    ///
    /// # Errors
    /// The system gives no thread.
    pub(super) fn start(count: usize, mut render: impl FnMut(u64) -> Box<[u8]> + Send + 'static) -> io::Result<Self> {
        let frames: Arc<[OnceLock<_>]> = std::iter::repeat_with(OnceLock::new).take(count.max(1)).collect();
        let _ = frames[0].set(render(0));
        let shown = Arc::downgrade(&frames);
        let ahead = move || {
            // without a lower priority it is only a little slower at first
            let _ = rustix::process::setpriority_process(None, NICENESS);
            for n in 1..count {
                let frame = render(n as u64);
                let Some(frames) = shown.upgrade() else { break };
                let _ = frames[n].set(frame);
            }
        };
        if count > 1 {
            thread::Builder::new().name("render".to_owned()).stack_size(STACK).spawn(ahead)?;
        }
        Ok(Self(frames))
    }

    /// Number of frames that are there, at least 1.
    pub(super) fn ready(&self) -> u64 {
        self.0.iter().take_while(|frame| frame.get().is_some()).count() as u64
    }

    /// Frame `n`, or the last one before it that is there.
    pub(super) fn frame(&self, n: u64) -> &[u8] {
        self.0[..=(n as usize).min(self.0.len() - 1)].iter().rev().find_map(OnceLock::get).map_or(&[], |frame| frame)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicU64, Ordering};
    use std::time::{Duration, Instant};

    use super::*;

    #[test]
    fn the_first_frame_is_there_at_once_and_the_others_follow_until_the_clip_is_dropped() {
        let rendered = Arc::new(AtomicU64::new(0));
        let counter = Arc::clone(&rendered);
        let (go, wait) = std::sync::mpsc::channel();
        let clip = Clip::start(1000, move |n| {
            if n > 0 {
                wait.recv().unwrap_or_default();
            }
            counter.store(n + 1, Ordering::SeqCst);
            vec![n as u8; 3].into()
        });
        let clip = clip.unwrap();
        assert_eq!((clip.ready(), clip.frame(0), clip.frame(7)), (1, &[0; 3][..], &[0; 3][..]));
        for _ in 0..7 {
            go.send(()).unwrap();
        }
        let begin = Instant::now();
        while clip.ready() < 8 && begin.elapsed() < Duration::from_secs(20) {
            thread::sleep(Duration::from_millis(1));
        }
        assert_eq!((clip.ready(), clip.frame(7)), (8, &[7; 3][..]));
        drop(clip);
        // the frame in work is the last one
        drop(go);
        while Arc::strong_count(&rendered) > 1 && begin.elapsed() < Duration::from_secs(20) {
            thread::sleep(Duration::from_millis(1));
        }
        assert!(rendered.load(Ordering::SeqCst) <= 10, "{rendered:?}");
    }
}
