//! L0: how much memory the process keeps that it does not use, with glibc's allocator.
//!
//! [`bound`] makes a start peak no higher than it must: images that are freed go back to the system at once, and threads share the
//! heap of the others instead of keeping one each. An engine that allocates its tensors anew for every frame would then get every
//! page of them from the system again, a good part of its time: [`keep`] ends that once there is one.

use std::sync::atomic::{AtomicBool, Ordering};

static BOUND: AtomicBool = AtomicBool::new(false);

/// Freed blocks go back to the system at once. For the start of a program.
pub fn bound() {
    BOUND.store(true, Ordering::Relaxed);
    set(64 << 10, 128 << 10);
}

/// Freed blocks stay for the next frame, from now on. Nothing where [`bound`] was not called: the heap is not this library's then.
pub fn keep() {
    if BOUND.load(Ordering::Relaxed) {
        set(32 << 20, 64 << 20);
    }
}

/// Gives back what a start has left: pages between blocks that stay. Nothing where [`bound`] was not called.
pub fn settle() {
    if BOUND.load(Ordering::Relaxed) {
        trim();
    }
}

/// Least size of blocks with a mapping of their own, and of free memory at the heap's end that is given back.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
#[allow(unsafe_code, reason = "glibc's settings have no safe interface")]
fn set(mapped: i32, trimmed: i32) {
    // SAFETY: mallopt takes numbers alone and the allocator's lock. What it refuses stays.
    unsafe {
        libc::mallopt(libc::M_MMAP_THRESHOLD, mapped);
        libc::mallopt(libc::M_TRIM_THRESHOLD, trimmed);
        libc::mallopt(libc::M_ARENA_MAX, 1);
    }
}

#[cfg(all(target_os = "linux", target_env = "gnu"))]
#[allow(unsafe_code, reason = "as above")]
fn trim() {
    // SAFETY: malloc_trim takes a number and the allocator's lock; blocks in use stay where they are.
    unsafe {
        libc::malloc_trim(0);
    }
}

#[cfg(not(all(target_os = "linux", target_env = "gnu")))]
fn trim() {}

/// Other allocators keep what they keep.
#[cfg(not(all(target_os = "linux", target_env = "gnu")))]
fn set(_: i32, _: i32) {}
