//! A frame allocates nothing once the pipeline has seen one: prepare, recon and polar work in the buffers of the plan.
#![allow(unsafe_code, reason = "a global allocator is unsafe by its trait")]
#![allow(clippy::unwrap_used, reason = "a test")]

mod common;

use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use common::{Rig, settings, spec};
use stokescope_core::Device;
use stokescope_core::frame::{Frame, Metadata, PixelFormat, Samples};
use stokescope_core::image::{Size, Stack};
use stokescope_core::parallel::Workers;
use stokescope_core::pipeline::{Pipeline, Settings};
use stokescope_core::readings::Binning;
use stokescope_core::solve::{Method, Modelled};

/// The system's allocator, counting on all threads how often memory is asked for.
struct Counting;

static REQUESTS: AtomicUsize = AtomicUsize::new(0);

// SAFETY: every call goes to the system's allocator as it came; counting touches no memory it hands out.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        REQUESTS.fetch_add(1, Ordering::Relaxed);
        // SAFETY: the caller's promise.
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        REQUESTS.fetch_add(1, Ordering::Relaxed);
        // SAFETY: the caller's promise.
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn realloc(&self, memory: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        REQUESTS.fetch_add(1, Ordering::Relaxed);
        // SAFETY: the caller's promise.
        unsafe { System.realloc(memory, layout, size) }
    }

    unsafe fn dealloc(&self, memory: *mut u8, layout: Layout) {
        // SAFETY: the caller's promise.
        unsafe { System.dealloc(memory, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// How often memory was asked for during `work`.
fn requests(work: impl FnOnce()) -> usize {
    let before = REQUESTS.load(Ordering::Relaxed);
    work();
    REQUESTS.load(Ordering::Relaxed) - before
}

/// Frames of a camera that are cropped and binned, with readings that have to be looked at.
fn binned_frames() {
    let size = Size::new(96, 80);
    let mut psf = Stack::zeros(1, size);
    psf.plane_mut(0)[40 * 96 + 48] = 1.0;
    psf.plane_mut(0)[37 * 96 + 40] = 0.5;
    let device =
        Device::builder(size).crop([8, 0], Size::new(80, 80)).bin(2).psf(psf).levels(0.0, 4095.0).build().unwrap();
    let bytes = |bad: usize| -> Vec<u8> {
        (0..144 * 80).map(|i| if i % 101 == bad { 255 } else { 100 + (i / 144) as u8 }).collect()
    };
    // the last has no reading that must be left out, which a warning would say
    let frames = [bytes(1), bytes(7), bytes(101)];
    let mut binning = Binning::new(&device, Arc::new(Workers::new(2))).unwrap();
    let mut pipeline = Pipeline::new(&device, Settings { guided: false, ..settings(Method::Stokes, 4, 2) }).unwrap();
    let mut out = binning.make_output();
    let mut process = |i: usize| {
        let format = PixelFormat::Mono(Samples::Packed12);
        let frame = Frame::new(&frames[i], format, size, 144, Metadata::default()).unwrap();
        binning.frame(&frame, &mut out).unwrap();
        assert_eq!(out.weights.as_slice().iter().any(|w| *w < 1.0), i < 2);
        if i == 2 {
            assert!(pipeline.process(out.view(), None).unwrap().warnings().is_empty());
        }
    };
    process(2);
    assert_eq!(requests(|| [0, 1, 2].into_iter().for_each(&mut process)), 0, "binned frames");
}

// A program of its own, without the test harness: its threads allocate too, if only to say that a test takes long.
fn main() {
    assert!(requests(|| drop(std::hint::black_box(vec![1u8; 100]))) > 0, "the counter does not count");
    // The colours of tissue share one polarization, those of plastic do not.
    for (scene, color) in [("plastic", false), ("plastic", true), ("tissue", true)] {
        let rig = Rig::new(stokescope::camera::sim::SimSpec { color, ..spec(scene, Size::new(40, 32)) });
        // Other frames than the first one: another brightness, so that what depends on the data is computed anew.
        let frames = [1.0, 0.6, 0.9].map(|gain| common::scaled(&rig.raw, gain));
        let guides = [1.0, 0.5, 0.8].map(|gain| common::scaled(&rig.guide, gain));
        for method in Method::ALL {
            for (threads, video) in [(1, false), (2, false), (1, true), (2, true)] {
                let guided = method == Method::Guided;
                let settings = Settings { register: true, video, ..settings(method, 6, threads) };
                let mut pipeline = rig.pipeline(guided, &settings);
                let mut process = |i: usize| {
                    let guide = guided.then_some(&guides[i]);
                    let report = pipeline.process(frames[i].view(), guide.map(Stack::view)).unwrap().into_report();
                    assert_eq!(report.modelled == Modelled::Shared, guided && scene == "tissue", "{report:?}");
                    assert!(report.warnings.is_empty() && report.residual_rms.is_finite(), "{report:?}");
                };
                process(0);
                // Twice the same frame: a still scene, in a video.
                let counted = requests(|| [0, 0, 1, 2].into_iter().for_each(&mut process));
                assert_eq!(
                    counted, 0,
                    "{method}, {threads} thread(s), {scene}, colour {color}, video {video}: requests"
                );
            }
        }
    }
    binned_frames();
    eprintln!("a frame allocates nothing in steady state ... ok");
}
