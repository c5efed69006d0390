//! HTTP server of the preview: one thread, an accept loop of its own, and bounds on connections, headers, time and memory.
//!
//! axum routes requests and builds answers. The connections stay with the accept loop, because axum's own server bounds neither
//! their number nor their memory.

mod connection;
mod context;
mod control;
mod exchange;
mod guard;
mod metrics;
mod places;
mod query;
mod refusal;
mod routes;
mod sessions;
mod setup;
mod socket;
mod state;
mod still;

use std::pin::pin;
use std::rc::Rc;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use axum::Router;
use connection::Connection;
pub(super) use context::{Context, Watchers};
use futures_util::future::select;
pub(super) use guard::Guard;
use hyper::Request;
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper::service::{Service, service_fn};
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use places::{Places, neighbourhood};
pub(super) use setup::SetupContext;
use socket::Socket;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::time::timeout;

use super::stop::Stop;
use super::threads::STACK;

/// Time that a request's headers have to arrive. An idle connection ends after it.
const HEADER_TIME: Duration = Duration::from_secs(5);
/// Time that a client has to take what it asked for: an answer, a picture of a stream.
const STALL_TIME: Duration = Duration::from_secs(20);
/// Pace of the checks for that, and for the end of the service.
const PACE: Duration = Duration::from_millis(500);
/// Bytes of a request's line and headers, and of answers that wait for a client.
const BUFFER_BYTES: usize = 16 << 10;
/// Bytes that a client may take up: a buffer each way.
pub(super) const CLIENT_BYTES: usize = 2 * BUFFER_BYTES;
/// Bytes that a download takes beside that: parts of files, and the names of a long session's files.
pub(super) const DOWNLOAD_BYTES: usize = 1 << 20;
const MAX_HEADERS: usize = 64;
/// Refused connections at once that are told the reason. Further ones are closed without an answer.
const MAX_REFUSALS: usize = 16;
/// Time that a refused client has to take its answer.
const REFUSAL_TIME: Duration = Duration::from_secs(1);

/// Server of the preview.
#[derive(Debug)]
pub(super) struct Server {
    router: Router,
    /// Connections that are being served.
    count: Arc<AtomicUsize>,
    /// Whether clients need a token.
    protected: bool,
    /// Most connections at once.
    clients: usize,
    stop: Arc<Stop>,
}

impl Server {
    /// Server of the live service, for at most so many `clients`.
    pub(super) fn of_service(context: Context, guard: Guard, clients: usize, stop: Arc<Stop>) -> Self {
        let (count, protected) = (Arc::clone(&context.clients), guard.token.is_some());
        Self { router: routes::router(Arc::new(context), guard), count, protected, clients, stop }
    }

    /// Server of the setup, for at most so many `clients`.
    pub(super) fn of_setup(context: Arc<SetupContext>, guard: Guard, clients: usize, stop: Arc<Stop>) -> Self {
        let (count, protected) = (Arc::clone(&context.clients), guard.token.is_some());
        Self { router: setup::router(context, guard), count, protected, clients, stop }
    }

    /// Serves `listener` until the service stops.
    ///
    /// # Errors
    /// When the system gives no event queue.
    pub(super) fn run(self, listener: std::net::TcpListener) -> std::io::Result<()> {
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            // one thread waits for the disk
            .max_blocking_threads(1)
            .thread_stack_size(STACK)
            .build()?;
        let tasks = tokio::task::LocalSet::new();
        tasks.block_on(&runtime, async {
            listener.set_nonblocking(true)?;
            self.accept(&TcpListener::from_std(listener)?).await;
            Ok(())
        })
    }

    async fn accept(self, listener: &TcpListener) {
        let Self { router, count, protected, clients, stop } = self;
        let mut places = Places::new(clients, protected);
        // every task that refuses holds one of these
        let refusing = Rc::new(());
        while !stop.is_set() {
            let (stream, remote) = match timeout(PACE, listener.accept()).await {
                Ok(Ok(accepted)) => accepted,
                Ok(Err(e)) => {
                    // most likely there are no file descriptors left: those in use become free again
                    tracing::warn!("preview: {e}");
                    tokio::time::sleep(PACE).await;
                    continue;
                }
                Err(_) => continue,
            };
            let Ok(local) = stream.local_addr() else { continue };
            let connection = Connection::new(local, neighbourhood(remote.ip()), Socket::bounded(&stream));
            if let Some(place) = places.take(&connection) {
                let (count, stop, router) = (Arc::clone(&count), Arc::clone(&stop), router.clone());
                tokio::task::spawn_local(async move {
                    count.fetch_add(1, Ordering::Relaxed);
                    let conversation = pin!(converse(stream, &connection, router, &stop));
                    select(conversation, pin!(connection.dismissed())).await;
                    count.fetch_sub(1, Ordering::Relaxed);
                    drop(place);
                });
            } else if Rc::strong_count(&refusing) <= MAX_REFUSALS {
                let place = Rc::clone(&refusing);
                tokio::task::spawn_local(async move {
                    refuse(stream).await;
                    drop(place);
                });
            }
        }
    }
}

/// Tells a client that there are too many.
async fn refuse(mut stream: TcpStream) {
    const ANSWER: &[u8] = b"HTTP/1.1 503 Service Unavailable\r\nContent-Type: text/plain\r\nContent-Length: 17\r\n\
        Retry-After: 5\r\nConnection: close\r\n\r\ntoo many clients\n";
    let talk = async {
        stream.write_all(ANSWER).await?;
        stream.shutdown().await?;
        // a socket that is closed with unread bytes is reset, and the answer lost
        while stream.read(&mut [0; 1024]).await? > 0 {}
        Ok::<_, std::io::Error>(())
    };
    // the client has got the answer or is gone
    let _ = timeout(REFUSAL_TIME, talk).await;
}

/// Answers the requests of one client, until it leaves, stalls or the service stops.
async fn converse(stream: TcpStream, connection: &Connection, router: Router, stop: &Stop) {
    // parts of a stream are whole pictures: waiting for more would only delay them
    let _ = stream.set_nodelay(true);
    let router = TowerToHyperService::new(router);
    let service = service_fn(|mut request: Request<Incoming>| {
        connection.begin();
        request.extensions_mut().insert(connection.clone());
        router.call(request)
    });
    let mut server = http1::Builder::new();
    server
        .timer(TokioTimer::new())
        .header_read_timeout(HEADER_TIME)
        .max_buf_size(BUFFER_BYTES)
        .max_headers(MAX_HEADERS);
    let mut serving = pin!(server.serve_connection(TokioIo::new(stream), service));
    loop {
        match timeout(PACE, serving.as_mut()).await {
            // a broken connection concerns the client alone
            Ok(_) => return,
            Err(_) if stop.is_set() || connection.stalls(STALL_TIME) => return,
            Err(_) => {}
        }
    }
}
