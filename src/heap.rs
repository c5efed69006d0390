//! Settings of glibc's allocator: how much freed memory the process retains.
//!
//! [`bound`] keeps the peak at start low: freed images return to the system at once, and all threads share one heap. The inference
//! engine allocates its tensors anew for every frame and would spend much of its time on getting pages from the system, so [`keep`]
//! retains freed memory once a fusion model is loaded.

use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicBool, Ordering};

/// The system's allocator. A program that gets no memory ends with a sentence and exit code 70, not with a signal.
#[derive(Debug)]
pub struct Checked;

// SAFETY: every call goes to the system's allocator as it came; a null pointer is not returned.
#[allow(unsafe_code, reason = "the trait is unsafe")]
unsafe impl GlobalAlloc for Checked {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        // SAFETY: the caller keeps the conditions, which are those of the system's allocator.
        given(unsafe { System.alloc(layout) }, layout.size())
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        // SAFETY: as above.
        given(unsafe { System.alloc_zeroed(layout) }, layout.size())
    }

    unsafe fn realloc(&self, block: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        // SAFETY: as above.
        given(unsafe { System.realloc(block, layout, size) }, size)
    }

    unsafe fn dealloc(&self, block: *mut u8, layout: Layout) {
        // SAFETY: as above.
        unsafe { System.dealloc(block, layout) }
    }
}

fn given(block: *mut u8, bytes: usize) -> *mut u8 {
    if block.is_null() {
        exhausted(bytes);
    }
    block
}

/// Ends the program, without memory.
#[cold]
fn exhausted(bytes: usize) -> ! {
    use std::io::Write;
    let mut text = [0; 200];
    let all = text.len();
    let mut room = text.as_mut_slice();
    let told = writeln!(
        room,
        "ERROR not enough memory: the system refuses {bytes} bytes; raise the limit (ulimit -v, MemoryMax) or lower the need (stokescope plan)"
    );
    let length = all - room.len();
    if told.is_ok() {
        // standard error has no buffer
        let _ = std::io::stderr().write_all(&text[..length]);
    }
    std::process::exit(70)
}

static BOUND: AtomicBool = AtomicBool::new(false);

/// Returns freed blocks to the system at once. Called at the start of the program.
pub fn bound() {
    BOUND.store(true, Ordering::Relaxed);
    set(64 << 10, 128 << 10);
}

/// Retains freed blocks for the next frame from now on. Does nothing unless [`bound`] was called, because another program's heap is
/// not this library's to change.
pub fn keep() {
    if BOUND.load(Ordering::Relaxed) {
        set(32 << 20, 64 << 20);
    }
}

/// Returns free pages between blocks in use to the system, once after start. Does nothing unless [`bound`] was called.
pub fn settle() {
    if BOUND.load(Ordering::Relaxed) {
        trim();
    }
}

/// Sets the smallest block with a mapping of its own, and the smallest free end of the heap that is returned, in bytes.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
#[allow(unsafe_code, reason = "glibc's settings have no safe interface")]
fn set(mapped: i32, trimmed: i32) {
    // SAFETY: mallopt takes only numbers and the allocator's lock. Refused settings stay as they are.
    unsafe {
        libc::mallopt(libc::M_MMAP_THRESHOLD, mapped);
        libc::mallopt(libc::M_TRIM_THRESHOLD, trimmed);
        libc::mallopt(libc::M_ARENA_MAX, 1);
    }
}

#[cfg(all(target_os = "linux", target_env = "gnu"))]
#[allow(unsafe_code, reason = "as above")]
fn trim() {
    // SAFETY: malloc_trim takes only a number and the allocator's lock; it does not move blocks in use.
    unsafe {
        libc::malloc_trim(0);
    }
}

#[cfg(not(all(target_os = "linux", target_env = "gnu")))]
fn trim() {}

/// Other allocators are not changed.
#[cfg(not(all(target_os = "linux", target_env = "gnu")))]
fn set(_: i32, _: i32) {}
