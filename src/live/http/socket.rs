//! Bytes that wait in the sockets of a connection, and the moment at which the next picture may follow.
//!
//! A client that reads slowly must see new pictures, not all of them late. So as little as possible waits on the way: the kernel's queue
//! on this side is bounded, and a picture follows only after the client's program has read the one before. How much of it still lies in
//! the client's receive buffer is seen from the window that its kernel announces, which is at most as large as the free part of that
//! buffer.

use std::os::fd::{AsFd, OwnedFd};
use std::time::{Duration, Instant};

/// Bytes of the kernel's queue for a client, which doubles it for its own structures.
const QUEUE_BYTES: i32 = 64 << 10;
/// Unsent bytes in that queue from which on it takes no more.
const UNSENT_BYTES: i32 = 16 << 10;
/// Part of the picture before that may still be unread when the next one follows: 1/4.
const UNREAD: usize = 4;
/// Time after which a picture follows although the window says that the one before is unread: windows shrink for other reasons, too.
const DOUBT: Duration = Duration::from_secs(10);
/// First and longest time between two questions to the client's kernel.
const ASK: [Duration; 2] = [Duration::from_millis(15), Duration::from_millis(250)];

/// Bytes on the way to a client.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Backlog {
    /// Sent or not, and not yet received by the client's kernel.
    pub(super) underway: usize,
    /// Bytes that the client's kernel could receive when it last answered; none where the system does not tell.
    pub(super) window: Option<usize>,
}

/// Socket of a client.
#[derive(Debug)]
pub(super) struct Socket(OwnedFd);

impl Socket {
    /// Takes a handle of the stream's socket and bounds its queue.
    pub(super) fn bounded(stream: &impl AsFd) -> Option<Self> {
        let socket = Self(stream.as_fd().try_clone_to_owned().ok()?);
        system::set(&socket.0, system::QUEUE, QUEUE_BYTES);
        system::set(&socket.0, system::UNSENT, UNSENT_BYTES);
        Some(socket)
    }

    /// Bytes on the way to the client.
    pub(super) fn backlog(&self) -> Backlog {
        system::backlog(&self.0)
    }

    /// Socket of a stream as it is.
    #[cfg(test)]
    pub(super) fn of(stream: &std::net::TcpStream) -> Self {
        Self(stream.as_fd().try_clone_to_owned().unwrap())
    }
}

/// Next step before a picture is sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Step {
    /// Send it.
    Go,
    /// Wait.
    Wait,
    /// Send some bytes that the client ignores: its kernel answers with its window.
    Ask,
}

/// Pace of the pictures for one watcher.
#[derive(Clone, Debug)]
pub(super) struct Pace {
    /// Largest window so far, when everything was read.
    widest: usize,
    /// Bytes of the picture before.
    bytes: usize,
    /// Time since which that picture is under way.
    since: Instant,
    asked: Option<Instant>,
    pause: Duration,
}

impl Pace {
    pub(super) fn new(now: Instant) -> Self {
        Self { widest: 0, bytes: 0, since: now, asked: None, pause: ASK[0] }
    }

    /// Notes that a picture of so many bytes is sent now.
    pub(super) fn sent(&mut self, bytes: usize, now: Instant) {
        (self.bytes, self.since, self.asked, self.pause) = (bytes, now, None, ASK[0]);
    }

    /// Whether the next picture follows now, and whether the one before was read: true, false, or a mere guess after a long time.
    pub(super) fn step(&mut self, backlog: Backlog, now: Instant) -> (Step, bool) {
        if backlog.underway > 0 {
            return (Step::Wait, false);
        }
        let Some(window) = backlog.window else { return (Step::Go, true) };
        self.widest = self.widest.max(window);
        if self.widest - window <= self.bytes / UNREAD {
            return (Step::Go, true);
        }
        if now.saturating_duration_since(self.since) > DOUBT {
            self.widest = window;
            return (Step::Go, false);
        }
        if now.saturating_duration_since(self.asked.unwrap_or(self.since)) < self.pause {
            return (Step::Wait, false);
        }
        (self.asked, self.pause) = (Some(now), (2 * self.pause).min(ASK[1]));
        (Step::Ask, false)
    }
}

#[cfg(target_os = "linux")]
#[allow(unsafe_code, reason = "these options have no safe interface")]
mod system {
    use std::os::fd::{AsRawFd, OwnedFd};

    use super::Backlog;

    pub(super) const QUEUE: (i32, i32) = (libc::SOL_SOCKET, libc::SO_SNDBUF);
    pub(super) const UNSENT: (i32, i32) = (libc::IPPROTO_TCP, libc::TCP_NOTSENT_LOWAT);
    /// Place of `tcpi_snd_wnd` in `struct tcp_info` of Linux 5.4 and later; earlier ones end before it.
    const WINDOW: usize = 228;

    /// Sets a whole number. A system that refuses keeps its own.
    pub(super) fn set(socket: &OwnedFd, (level, option): (i32, i32), value: i32) {
        // SAFETY: the kernel reads the four bytes of `value`, which lives during the call.
        unsafe {
            let length = size_of::<i32>() as libc::socklen_t;
            libc::setsockopt(socket.as_raw_fd(), level, option, (&raw const value).cast(), length);
        }
    }

    pub(super) fn backlog(socket: &OwnedFd) -> Backlog {
        let (mut underway, mut info) = (0i32, [0u8; WINDOW + 4]);
        let mut length = info.len() as libc::socklen_t;
        // SAFETY: the kernel writes an int, and at most `length` bytes of `info`; both live during the calls.
        let known = unsafe {
            libc::ioctl(socket.as_raw_fd(), libc::TIOCOUTQ, &raw mut underway);
            let (level, option) = (libc::IPPROTO_TCP, libc::TCP_INFO);
            libc::getsockopt(socket.as_raw_fd(), level, option, info.as_mut_ptr().cast(), &raw mut length)
        };
        let [.., a, b, c, d] = info;
        let window = (known == 0 && length as usize == info.len()).then(|| u32::from_ne_bytes([a, b, c, d]) as usize);
        Backlog { underway: usize::try_from(underway).unwrap_or(0), window }
    }
}

#[cfg(not(target_os = "linux"))]
mod system {
    use std::os::fd::OwnedFd;

    use super::Backlog;

    pub(super) const QUEUE: (i32, i32) = (0, 0);
    pub(super) const UNSENT: (i32, i32) = (0, 0);

    pub(super) fn set(_: &OwnedFd, _: (i32, i32), _: i32) {}

    pub(super) fn backlog(_: &OwnedFd) -> Backlog {
        Backlog::default()
    }
}

#[cfg(test)]
mod tests {
    use std::io::{Read, Write};
    use std::net::{TcpListener, TcpStream};

    use super::*;

    #[test]
    fn a_picture_follows_when_the_one_before_was_read_or_after_a_long_doubt() {
        let (now, second) = (Instant::now(), Duration::from_secs(1));
        let mut pace = Pace::new(now);
        let seen = |underway, window| Backlog { underway, window: Some(window) };
        assert_eq!(pace.step(seen(0, 60_000), now), (Step::Go, true));
        pace.sent(20_000, now);
        assert_eq!(pace.step(seen(9, 60_000), now + second), (Step::Wait, false));
        assert_eq!(pace.step(seen(0, 40_000), now), (Step::Wait, false));
        assert_eq!(pace.step(seen(0, 40_000), now + second), (Step::Ask, false));
        assert_eq!(pace.step(seen(0, 40_000), now + second), (Step::Wait, false));
        assert_eq!(pace.step(seen(0, 56_000), now + second), (Step::Go, true));
        assert_eq!(pace.step(seen(0, 40_000), now + 11 * second), (Step::Go, false));
        pace.sent(20_000, now + 11 * second);
        assert_eq!(pace.step(seen(0, 40_000), now + 12 * second), (Step::Go, true), "the window had shrunk");
        assert_eq!(Pace::new(now).step(Backlog::default(), now), (Step::Go, true));
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn the_window_tells_what_a_client_has_not_read() {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let mut client = TcpStream::connect(listener.local_addr().unwrap()).unwrap();
        let (mut stream, _) = listener.accept().unwrap();
        let socket = Socket::of(&stream);
        let mut settle = |bytes: usize| {
            stream.write_all(&vec![0; bytes]).unwrap();
            std::thread::sleep(Duration::from_millis(200));
            let backlog = socket.backlog();
            assert_eq!(backlog.underway, 0);
            backlog.window.unwrap()
        };
        // the window grows at first
        let mut before = 0;
        for _ in 0..8 {
            before = settle(20_000);
            client.read_exact(&mut [0; 20_000]).unwrap();
            before = settle(1).max(before);
            client.read_exact(&mut [0; 1]).unwrap();
        }
        // a kernel that has room to spare announces less than all of it
        let full = settle(90_000);
        assert!(full + 30_000 < before, "{full} of {before}");
        client.read_exact(&mut [0; 90_000]).unwrap();
        let after = settle(1);
        assert!(after + 5000 > before, "{after} of {before}");
    }
}
