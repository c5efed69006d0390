//! What the safe bindings of libcamera leave open: its objects in other threads, and its buffers as bytes. All `unsafe`
//! of this backend stands here.
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

/// An object of libcamera that may change threads.
pub(super) struct Movable<T>(pub(super) T);

// SAFETY: libcamera documents its camera manager as usable from any thread, one at a time; it lies behind a lock.
unsafe impl Send for Movable<CameraManager> {}
// SAFETY: a camera's functions are thread-safe, or have to be called by one thread at a time: whoever owns this one.
// Completed requests come in libcamera's own thread through a lock and a channel.
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

/// One frame buffer, whoever made its memory.
pub(super) enum Memory {
    /// libcamera, of DMA memory.
    Allocated(FrameBuffer),
    /// This program, of ordinary memory.
    Own(OwnedFrameBuffer),
}

impl Memory {
    /// Its place.
    pub(super) fn mapping(&self) -> io::Result<Mapping> {
        match self {
            Self::Allocated(buffer) => Mapping::new(&buffer.planes()),
            Self::Own(buffer) => Mapping::new(&buffer.planes()),
        }
    }

    /// Makes it the buffer of a request.
    pub(super) fn give_to(self, request: &mut Request, stream: &Stream) -> io::Result<()> {
        match self {
            Self::Allocated(buffer) => request.add_buffer(stream, buffer),
            Self::Own(buffer) => request.add_buffer(stream, buffer),
        }
    }

    /// What the driver says about the frame in a request's buffer; none before the first.
    pub(super) fn metadata<'a>(request: &'a Request, stream: &Stream) -> Option<Immutable<FrameMetadataRef<'a>>> {
        let allocated = request.buffer::<FrameBuffer>(stream).and_then(AsFrameBuffer::metadata);
        allocated.or_else(|| request.buffer::<OwnedFrameBuffer>(stream)?.metadata())
    }

    /// A buffer of ordinary memory with planes of these lengths, one after another.
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
            // SAFETY: the bindings gave up this descriptor's ownership, and libcamera has not taken it but made a copy
            // with another number: nobody else will close it.
            drop(unsafe { OwnedFd::from_raw_fd(fd) });
        }
        Ok(Self::Own(buffer))
    }
}

/// The bytes of a frame buffer, mapped for reading.
pub(super) struct Mapping {
    start: NonNull<u8>,
    length: usize,
    /// Where the first plane begins.
    offset: usize,
    fd: OwnedFd,
}

// SAFETY: it is read-only memory, owned by this value alone.
unsafe impl Send for Mapping {}

impl Mapping {
    /// Maps the planes of a buffer as one piece: planes of one memory, one right after another. With planes apart, the first.
    fn new(planes: &FrameBufferPlanesRef<'_>) -> io::Result<Self> {
        let invalid = |what| io::Error::new(io::ErrorKind::InvalidData, what);
        let mut whole: Option<(OwnedFd, u64, usize, usize)> = None;
        for index in 0..planes.len() {
            let plane = planes.get(index).ok_or_else(|| invalid("a buffer without planes"))?;
            let (begin, length) = (plane.offset().ok_or_else(|| invalid("a plane without a place"))?, plane.len());
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
        // SAFETY: a new mapping at a place of the system's choice touches no memory of this program.
        let start = unsafe { mm::mmap(std::ptr::null_mut(), length, ProtFlags::READ, MapFlags::SHARED, &fd, 0)? };
        let start = NonNull::new(start.cast()).ok_or_else(|| invalid("a mapping at address 0"))?;
        Ok(Self { start, length, offset, fd })
    }

    /// How many bytes a frame can have.
    pub(super) fn capacity(&self) -> usize {
        self.length - self.offset
    }

    /// The bytes of a frame that is complete, until it goes back to libcamera.
    pub(super) fn bytes<'a>(&'a self, _complete: &'a Request) -> &'a [u8] {
        // SAFETY: the mapping lives as long as `self` and is initialized memory; while the request is in this program's hands,
        // which the borrow proves, no driver writes to it.
        let all = unsafe { slice::from_raw_parts(self.start.as_ptr(), self.length) };
        &all[self.offset..]
    }

    /// Begins reading: caches forget what they held of DMA memory. Ordinary memory needs nothing.
    pub(super) fn begin(&self) {
        self.sync(SYNC_READ);
    }

    /// Ends reading.
    pub(super) fn end(&self) {
        self.sync(SYNC_READ | SYNC_END);
    }

    fn sync(&self, flags: u64) {
        // SAFETY: this call takes a pointer to 64 bits of flags, which the setter holds. Descriptors of other memory refuse it.
        let done = unsafe { ioctl::ioctl(&self.fd, Setter::<DMA_BUF_SYNC, u64>::new(flags)) };
        // only an interrupted call leaves something to do
        if done == Err(rustix::io::Errno::INTR) {
            self.sync(flags);
        }
    }
}

impl Drop for Mapping {
    fn drop(&mut self) {
        // SAFETY: this value owns the mapping, and nothing borrowed from it is left.
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
            let memory = Memory::ordinary(&[4096, 100]).unwrap();
            let mapping = memory.mapping().unwrap();
            assert_eq!((mapping.offset, mapping.length), (0, 4196));
            mapping.begin();
            mapping.end();
        }
        // other tests may have some open for a while
        assert!(open_descriptors() < before + 10);
    }
}
