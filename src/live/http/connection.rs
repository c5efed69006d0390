//! One client's connection, as the answers to its requests see it.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use parking_lot::Mutex;

/// One client's connection.
#[derive(Clone, Debug)]
pub(super) struct Connection {
    /// Address that the client connected to.
    pub(super) local: SocketAddr,
    /// Time since which the client has had something to take; none while it took everything.
    handed: Arc<Mutex<Option<Instant>>>,
}

impl Connection {
    pub(super) fn new(local: SocketAddr) -> Self {
        Self { local, handed: Arc::default() }
    }

    /// Notes that the client has something to take from now on.
    pub(super) fn hand_over(&self) {
        *self.handed.lock() = Some(Instant::now());
    }

    /// Notes that the client took everything.
    pub(super) fn taken(&self) {
        *self.handed.lock() = None;
    }

    /// Whether the client has not taken what it asked for, for longer than `patience`.
    pub(super) fn stalls(&self, patience: Duration) -> bool {
        self.handed.lock().is_some_and(|since| since.elapsed() > patience)
    }
}
