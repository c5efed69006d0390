//! Access to libcamera that its safe bindings do not cover: moving its objects between threads, and its buffers as bytes. All
//! `unsafe` code of this backend is in this file.
#![allow(unsafe_code)]

use std::{
    io,
    ops::{Deref, DerefMut},
    os::fd::{AsRawFd, BorrowedFd, FromRawFd, OwnedFd, RawFd},
    ptr::NonNull,
    slice,
};

use ::libcamera::{
    camera::ActiveCamera,
    camera_manager::CameraManager,
    framebuffer::{AsFrameBuffer, FrameBufferPlane, FrameBufferPlanesRef, FrameMetadataRef, OwnedFrameBuffer},
    framebuffer_allocator::FrameBuffer,
    request::Request,
    stream::Stream,
    utils::Immutable,
};
use rustix::{
    fs::{self, MemfdFlags},
    ioctl::{self, Setter},
    mm::{self, MapFlags, ProtFlags},
};

/// `DMA_BUF_IOCTL_SYNC` of linux/dma-buf.h: `_IOW('b', 0, u64)`.
const DMA_BUF_SYNC: ioctl::Opcode = ioctl::opcode::write::<u64>(b'b', 0);
/// `DMA_BUF_SYNC_READ`.
const SYNC_READ: u64 = 1;
/// `DMA_BUF_SYNC_END`.
const SYNC_END: u64 = 4;

/// A libcamera object that may be moved to another thread.
pub(super) struct Movable<T>(pub(super) T);

// SAFETY: libcamera documents its camera manager as usable from any thread, one at a time; a lock protects it.
unsafe impl Send for Movable<CameraManager> {}
// SAFETY: a camera's functions are thread-safe or must be called by one thread at a time, which is the owner of this value.
// Completed requests arrive in libcamera's own thread and pass through a lock and a channel.
unsafe impl Send for Movable<ActiveCamera<'static>> {}

impl<T> Deref for Movable<T> {
    type Target = T;

    fn deref(&self) -> &T {
        &self.0
    }
}

impl<T> DerefMut for Movable<T> {
    fn deref_mut(&mut self) -> &mut T {
        &mut self.0
    }
}

/// A frame buffer, by the owner of its memory.
pub(super) enum FrameMemory {
    /// DMA memory, allocated by libcamera.
    Allocated(FrameBuffer),
    /// Ordinary memory, allocated by this program.
    Own(OwnedFrameBuffer),
}

impl FrameMemory {
    /// Maps the buffer for reading.
    pub(super) fn mapping(&self) -> io::Result<Mapping> {
        match self {
            Self::Allocated(buffer) => Mapping::new(&buffer.planes()),
            Self::Own(buffer) => Mapping::new(&buffer.planes()),
        }
    }

    /// Adds the buffer to a request.
    pub(super) fn give_to(self, request: &mut Request, stream: &Stream) -> io::Result<()> {
        match self {
            Self::Allocated(buffer) => request.add_buffer(stream, buffer),
            Self::Own(buffer) => request.add_buffer(stream, buffer),
        }
    }

    /// Metadata of the frame in a request's buffer; `None` before the first frame.
    pub(super) fn metadata<'a>(request: &'a Request, stream: &Stream) -> Option<Immutable<FrameMetadataRef<'a>>> {
        let allocated = request.buffer::<FrameBuffer>(stream).and_then(AsFrameBuffer::metadata);
        allocated.or_else(|| request.buffer::<OwnedFrameBuffer>(stream)?.metadata())
    }

    /// Allocates a buffer of ordinary memory with consecutive planes of `lengths` bytes.
    pub(super) fn ordinary(lengths: &[usize]) -> io::Result<Self> {
        let memory = fs::memfd_create("camera frame", MemfdFlags::CLOEXEC)?;
        fs::ftruncate(&memory, lengths.iter().sum::<usize>() as u64)?;
        let (mut planes, mut given, mut offset) = (Vec::new(), Vec::<RawFd>::new(), 0);
        for length in lengths {
            let fd = memory.try_clone()?;
            given.push(fd.as_raw_fd());
            planes.push(FrameBufferPlane { fd, offset: offset as u32, length: *length as u32 });
            offset += length;
        }
        let buffer = OwnedFrameBuffer::new(planes, None)?;
        let kept: Vec<RawFd> = (0..).map_while(|i| buffer.planes().get(i).map(|plane| plane.fd())).collect();
        for fd in given.into_iter().filter(|fd| !kept.contains(fd)) {
            // SAFETY: the bindings gave up ownership of this descriptor, and libcamera has made a copy with another number, so
            // nothing else closes it.
            drop(unsafe { OwnedFd::from_raw_fd(fd) });
        }
        Ok(Self::Own(buffer))
    }
}

/// The bytes of a frame buffer, mapped for reading.
pub(super) struct Mapping {
    start: NonNull<u8>,
    length: usize,
    /// Offset of the first plane.
    offset: usize,
    fd: OwnedFd,
}

// SAFETY: the mapping is read-only and owned by this value alone.
unsafe impl Send for Mapping {}

impl Mapping {
    /// Maps consecutive planes of one memory as one piece. If the planes are apart, only the first is mapped.
    fn new(planes: &FrameBufferPlanesRef<'_>) -> io::Result<Self> {
        let invalid = |what| io::Error::new(io::ErrorKind::InvalidData, what);
        let mut whole: Option<(OwnedFd, u64, usize, usize)> = None;
        for index in 0..planes.len() {
            let plane = planes.get(index).ok_or_else(|| invalid("a buffer without planes"))?;
            let (begin, length) = (plane.offset().ok_or_else(|| invalid("a plane without an offset"))?, plane.len());
            // SAFETY: the buffer keeps its descriptor open while its planes are borrowed.
            let fd = unsafe { BorrowedFd::borrow_raw(plane.fd()) };
            let inode = fs::fstat(fd)?.st_ino;
            match &mut whole {
                None => whole = Some((fd.try_clone_to_owned()?, inode, begin, begin + length)),
                Some((_, first, _, end)) if *first == inode && *end == begin => *end = begin + length,
                Some(_) => break,
            }
        }
        let (fd, _, offset, length) = whole.ok_or_else(|| invalid("a buffer without planes"))?;
        // SAFETY: a new mapping at an address chosen by the system touches no memory of this program.
        let start = unsafe { mm::mmap(std::ptr::null_mut(), length, ProtFlags::READ, MapFlags::SHARED, &fd, 0)? };
        let start = NonNull::new(start.cast()).ok_or_else(|| invalid("a mapping at address 0"))?;
        Ok(Self { start, length, offset, fd })
    }

    /// Largest size of a frame in bytes.
    pub(super) fn capacity(&self) -> usize {
        self.length - self.offset
    }

    /// Bytes of the frame in a completed request, which stays borrowed and thus cannot be queued again.
    pub(super) fn bytes<'a>(&'a self, _complete: &'a Request) -> &'a [u8] {
        // SAFETY: the mapping lives as long as `self` and is initialized memory. No driver writes to it while this program holds the
        // request, which the borrow proves.
        let all = unsafe { slice::from_raw_parts(self.start.as_ptr(), self.length) };
        &all[self.offset..]
    }

    /// Starts reading: invalidates caches of DMA memory. Has no effect on ordinary memory.
    pub(super) fn begin(&self) {
        self.sync(SYNC_READ);
    }

    /// Ends reading.
    pub(super) fn end(&self) {
        self.sync(SYNC_READ | SYNC_END);
    }

    fn sync(&self, flags: u64) {
        // SAFETY: this call takes a pointer to 64 bits of flags, which the setter owns. Descriptors of other memory refuse it.
        let done = unsafe { ioctl::ioctl(&self.fd, Setter::<DMA_BUF_SYNC, u64>::new(flags)) };
        // an interrupted call is repeated; other errors mean ordinary memory
        if done == Err(rustix::io::Errno::INTR) {
            self.sync(flags);
        }
    }
}

impl Drop for Mapping {
    fn drop(&mut self) {
        // SAFETY: this value owns the mapping, and no borrow of it is left.
        let unmapped = unsafe { mm::munmap(self.start.as_ptr().cast(), self.length) };
        debug_assert!(unmapped.is_ok());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn open_descriptors() -> usize {
        std::fs::read_dir("/proc/self/fd").unwrap().count()
    }

    #[test]
    fn ordinary_memory_is_one_piece_and_leaves_no_descriptor_open() {
        let before = open_descriptors();
        for _ in 0..10 {
            let memory = FrameMemory::ordinary(&[4096, 100]).unwrap();
            let mapping = memory.mapping().unwrap();
            assert_eq!((mapping.offset, mapping.length), (0, 4196));
            mapping.begin();
            mapping.end();
        }
        // other tests may have some open
        assert!(open_descriptors() < before + 10);
    }
}
