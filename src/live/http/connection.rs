//! One client's connection, as the answers to its requests and the accept loop see it.

use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::time::{Duration, Instant};

use parking_lot::Mutex;
use tokio::sync::Notify;

use super::socket::{Backlog, Socket};

/// One client's connection.
#[derive(Clone, Debug)]
pub(super) struct Connection {
    /// Address that the client connected to.
    pub(super) local: SocketAddr,
    /// Address of the client.
    pub(super) remote: IpAddr,
    shared: Arc<Shared>,
}

#[derive(Debug, Default)]
struct Shared {
    /// Time since which the client has had something to take; none while it took everything.
    handed: Mutex<Option<Instant>>,
    /// None where the system gives no second handle, and in tests.
    socket: Option<Socket>,
    /// Whether a request had the token, or none is needed.
    proven: AtomicBool,
    /// Whether a request is being answered.
    answering: AtomicBool,
    /// Requests with a wrong token.
    failures: AtomicU32,
    /// Tells the connection to end.
    leave: Notify,
}

impl Connection {
    pub(super) fn new(local: SocketAddr, remote: IpAddr, socket: Option<Socket>) -> Self {
        Self { local, remote, shared: Arc::new(Shared { socket, ..Shared::default() }) }
    }

    /// Bytes on the way to the client.
    pub(super) fn backlog(&self) -> Backlog {
        self.shared.socket.as_ref().map(Socket::backlog).unwrap_or_default()
    }

    /// Notes that the client has something to take from now on, unless it has something to take already.
    pub(super) fn hand_over(&self) {
        self.shared.handed.lock().get_or_insert_with(Instant::now);
    }

    /// Notes that the client took everything.
    pub(super) fn taken(&self) {
        *self.shared.handed.lock() = None;
    }

    /// Whether the client has not taken what it asked for, for longer than `patience`.
    pub(super) fn stalls(&self, patience: Duration) -> bool {
        self.shared.handed.lock().is_some_and(|since| since.elapsed() > patience)
    }

    /// Notes that a request begins to be answered.
    pub(super) fn begin(&self) {
        self.taken();
        self.hand_over();
        self.shared.answering.store(true, Ordering::Relaxed);
    }

    /// Notes that the answer is complete, apart from bytes on their way.
    pub(super) fn end(&self) {
        self.shared.answering.store(false, Ordering::Relaxed);
    }

    /// Whether no request is being answered and nothing is on its way.
    pub(super) fn is_idle(&self) -> bool {
        !self.shared.answering.load(Ordering::Relaxed) && self.backlog().underway == 0
    }

    /// Notes that the client may be here.
    pub(super) fn prove(&self) {
        self.shared.proven.store(true, Ordering::Relaxed);
    }

    /// Whether the client showed that it may be here.
    pub(super) fn is_proven(&self) -> bool {
        self.shared.proven.load(Ordering::Relaxed)
    }

    /// Counts a request with a wrong token; gives their number.
    pub(super) fn fail(&self) -> u32 {
        self.shared.failures.fetch_add(1, Ordering::Relaxed) + 1
    }

    /// Tells the connection to end.
    pub(super) fn dismiss(&self) {
        self.shared.leave.notify_one();
    }

    /// Waits until the connection is told to end.
    pub(super) async fn dismissed(&self) {
        self.shared.leave.notified().await;
    }
}
