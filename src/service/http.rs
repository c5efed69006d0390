//! The preview's HTTP server: one thread, its own accept loop, bounded in connections, headers, time and memory.

use std::cell::Cell;
use std::convert::Infallible;
use std::net::SocketAddr;
use std::pin::Pin;
use std::rc::Rc;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::task::{Context, Poll};
use std::time::{Duration, Instant};

use hyper::body::{Body, Bytes, Frame, Incoming, SizeHint};
use hyper::header::{ALLOW, CACHE_CONTROL, CONTENT_SECURITY_POLICY, CONTENT_TYPE, HeaderValue, WWW_AUTHENTICATE};
use hyper::{Request, Response, StatusCode, server::conn::http1, service::service_fn};
use hyper_util::rt::{TokioIo, TokioTimer};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::time::timeout;

use super::broadcast::{BOUNDARY, Format, STREAM_TYPE, Watch};
use super::events::Reading;
use super::hub::Hub;
use super::request::{Guard, MAX_BODY, Refusal, Wanted};
use super::{control, state};

/// A request's headers must be there within this time; an idle connection ends after it.
const HEADER_TIME: Duration = Duration::from_secs(5);
/// A client that takes nothing of what it asked for within this time is gone.
const STALL_TIME: Duration = Duration::from_secs(20);
/// Pace of the checks for that, and for the end of the service.
const PACE: Duration = Duration::from_millis(500);
/// How long a snapshot may take to be drawn: what a camera shows is there with its next frame.
const SNAPSHOT_TIME: Duration = Duration::from_secs(10);
/// Bytes of a request's line and headers, and bytes held back for a client.
const BUFFER_BYTES: usize = 16 << 10;
/// Bytes that a client may take up: a buffer each way.
pub(super) const CLIENT_BYTES: usize = 2 * BUFFER_BYTES;
const MAX_HEADERS: usize = 64;
/// Refused connections that are told so at once; further ones are closed without a word.
const MAX_REFUSALS: usize = 16;
const PAGE: &str = include_str!("page.html");

/// Serves `listener` until the service stops.
///
/// # Errors
/// When the system gives no event queue.
pub(super) fn serve(
    hub: &Arc<Hub>,
    listener: std::net::TcpListener,
    guard: Guard,
    clients: usize,
) -> std::io::Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let tasks = tokio::task::LocalSet::new();
    tasks.block_on(&runtime, async {
        listener.set_nonblocking(true)?;
        let listener = TcpListener::from_std(listener)?;
        accept(hub, &listener, Rc::new(guard), clients).await;
        Ok(())
    })
}

async fn accept(hub: &Arc<Hub>, listener: &TcpListener, guard: Rc<Guard>, clients: usize) {
    // every task holds one of these while it serves
    let (serving, refusing) = (Rc::new(()), Rc::new(()));
    while !hub.stop.is_set() {
        let stream = match timeout(PACE, listener.accept()).await {
            Ok(Ok((stream, _))) => stream,
            Ok(Err(e)) => {
                // out of file descriptors, most likely: those in use become free again
                tracing::warn!("preview: {e}");
                tokio::time::sleep(PACE).await;
                continue;
            }
            Err(_) => continue,
        };
        if Rc::strong_count(&serving) <= clients {
            let (place, hub, guard) = (Rc::clone(&serving), Arc::clone(hub), Rc::clone(&guard));
            tokio::task::spawn_local(async move {
                hub.clients.fetch_add(1, Ordering::Relaxed);
                converse(&hub, stream, &guard).await;
                hub.clients.fetch_sub(1, Ordering::Relaxed);
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

/// Tells a client that there are too many.
async fn refuse(mut stream: TcpStream) {
    const ANSWER: &[u8] = b"HTTP/1.1 503 Service Unavailable\r\nContent-Type: text/plain\r\nContent-Length: 17\r\n\
        Retry-After: 5\r\nConnection: close\r\n\r\ntoo many clients\n";
    let talk = async {
        stream.write_all(ANSWER).await?;
        stream.shutdown().await?;
        // what is closed with unread bytes is reset, and the answer lost
        while stream.read(&mut [0; 1024]).await? > 0 {}
        Ok::<_, std::io::Error>(())
    };
    // it has heard or it has not
    let _ = timeout(Duration::from_secs(1), talk).await;
}

/// Since when the client has had something to take; none while it took everything.
type Handed = Rc<Cell<Option<Instant>>>;

async fn converse(hub: &Arc<Hub>, stream: TcpStream, guard: &Guard) {
    let Ok(local) = stream.local_addr() else { return };
    // parts of a stream are whole pictures: nothing to collect
    let _ = stream.set_nodelay(true);
    let handed = Handed::default();
    let service = service_fn(|request: Request<Incoming>| {
        let handed = Rc::clone(&handed);
        async move { Ok::<_, Infallible>(answer(hub, request, guard, local, handed).await) }
    });
    let mut server = http1::Builder::new();
    server
        .timer(TokioTimer::new())
        .header_read_timeout(HEADER_TIME)
        .max_buf_size(BUFFER_BYTES)
        .max_headers(MAX_HEADERS);
    let mut connection = std::pin::pin!(server.serve_connection(TokioIo::new(stream), service));
    loop {
        match timeout(PACE, connection.as_mut()).await {
            // broken connections are the client's affair
            Ok(_) => return,
            Err(_) if hub.stop.is_set() => return,
            Err(_) if handed.get().is_some_and(|since| since.elapsed() > STALL_TIME) => return,
            Err(_) => {}
        }
    }
}

async fn answer(
    hub: &Arc<Hub>,
    request: Request<Incoming>,
    guard: &Guard,
    local: SocketAddr,
    handed: Handed,
) -> Response<Reply> {
    handed.set(Some(Instant::now()));
    let wanted = guard.check(request.method(), request.uri(), request.headers(), local);
    let outcome = match wanted {
        Ok(Wanted::Control) => change(hub, request.into_body()).await,
        Ok(wanted) => fulfil(hub, wanted, &handed).await,
        Err(refusal) => Err(refusal),
    };
    let (status, kind, body) = outcome.unwrap_or_else(|refusal| {
        let status = StatusCode::from_u16(refusal.status()).unwrap_or(StatusCode::BAD_REQUEST);
        (status, "text/plain; charset=utf-8", Reply::whole(format!("{refusal}\n")))
    });
    let mut response = Response::new(body);
    *response.status_mut() = status;
    let headers = response.headers_mut();
    headers.insert(CONTENT_TYPE, HeaderValue::from_static(kind));
    headers.insert(CACHE_CONTROL, HeaderValue::from_static("no-store"));
    headers.insert(CONTENT_SECURITY_POLICY, HeaderValue::from_static(POLICY));
    headers.insert("x-content-type-options", HeaderValue::from_static("nosniff"));
    headers.insert("referrer-policy", HeaderValue::from_static("no-referrer"));
    headers.insert("cross-origin-resource-policy", HeaderValue::from_static("same-origin"));
    match status {
        StatusCode::METHOD_NOT_ALLOWED => drop(headers.insert(ALLOW, HeaderValue::from_static("GET, HEAD, POST"))),
        StatusCode::UNAUTHORIZED => drop(headers.insert(WWW_AUTHENTICATE, HeaderValue::from_static("Bearer"))),
        _ => {}
    }
    response
}

/// The page is one file that loads from here alone, and nobody frames it.
const POLICY: &str = "default-src 'none'; img-src 'self' data:; connect-src 'self'; style-src 'unsafe-inline'; \
    script-src 'unsafe-inline'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

/// Does what the body of a request asks for, and tells the state it led to.
async fn change(hub: &Arc<Hub>, mut body: Incoming) -> Outcome {
    let mut text = Vec::new();
    let read = async {
        while let Some(Ok(frame)) = std::future::poll_fn(|cx| Pin::new(&mut body).poll_frame(cx)).await {
            text.extend_from_slice(frame.data_ref().map_or(&[], |data| data));
            if text.len() > MAX_BODY {
                return Err(Refusal::Large);
            }
        }
        Ok(())
    };
    timeout(HEADER_TIME, read).await.unwrap_or(Err(Refusal::Change("the body did not come in time".to_owned())))?;
    control::apply(hub, &text)?;
    Ok((StatusCode::OK, "application/json", Reply::whole(state::json(hub).to_string())))
}

type Outcome = Result<(StatusCode, &'static str, Reply), Refusal>;

async fn fulfil(hub: &Arc<Hub>, wanted: Wanted, handed: &Handed) -> Outcome {
    const JSON: &str = "application/json";
    const TEXT: &str = "text/plain; charset=utf-8";
    let ok = |kind, body: String| Ok((StatusCode::OK, kind, Reply::whole(body)));
    let watch = |view: &str, format| {
        Watch::new(hub, view, format).ok_or_else(|| Refusal::View {
            found: view.chars().filter(char::is_ascii_graphic).take(40).collect(),
            allowed: hub.broadcast.views().map(super::view::View::name).collect(),
        })
    };
    match wanted {
        Wanted::Page => {
            Ok((StatusCode::OK, "text/html; charset=utf-8", Reply::Whole(Bytes::from_static(PAGE.as_bytes()))))
        }
        Wanted::State => ok(JSON, state::json(hub).to_string()),
        Wanted::Metrics => ok("text/plain; version=0.0.4; charset=utf-8", state::metrics(hub)),
        Wanted::Health => match state::health(hub) {
            Ok(()) => ok(TEXT, "ok\n".to_owned()),
            Err(why) => Ok((StatusCode::SERVICE_UNAVAILABLE, TEXT, Reply::whole(format!("{why}\n")))),
        },
        Wanted::Histogram { region } => ok(JSON, state::histogram(hub, region).to_string()),
        Wanted::Events => {
            let stream = Stream::of(Source::Events(hub.events.read()), handed);
            Ok((StatusCode::OK, "application/x-ndjson", Reply::Stream { begun: true, stream }))
        }
        // it needs the body and was answered before
        Wanted::Control => Err(Refusal::Method),
        Wanted::Pixel { x, y } => {
            let size = hub.broadcast.size();
            for (key, found, below) in [("x", x, size.width), ("y", y, size.height)] {
                if found >= below {
                    let (found, allowed) = (found.to_string(), format!("0 to {}", below - 1));
                    return Err(Refusal::Query { key, found, allowed });
                }
            }
            ok(JSON, state::pixel(hub, x, y).to_string())
        }
        Wanted::Stream { view } => {
            let stream = Stream::of(Source::Pictures(watch(&view, Format::Jpeg)?), handed);
            let reply = Reply::Stream { begun: false, stream };
            Ok((StatusCode::OK, STREAM_TYPE, reply))
        }
        Wanted::Snapshot { view, format } => {
            let mut watch = watch(&view, format)?;
            let kind = if format == Format::Jpeg { "image/jpeg" } else { "image/png" };
            match timeout(SNAPSHOT_TIME, watch.next()).await {
                Ok(Some(encoded)) => Ok((StatusCode::OK, kind, Reply::Whole(encoded.image()))),
                _ => Ok((StatusCode::SERVICE_UNAVAILABLE, TEXT, Reply::whole("no picture in time\n".to_owned()))),
            }
        }
    }
}

/// The body of an answer.
enum Reply {
    Whole(Bytes),
    Stream { begun: bool, stream: Stream },
}

/// What a stream is made of.
enum Source {
    Pictures(Watch),
    Events(Reading),
}

impl Source {
    async fn next(&mut self) -> Option<Bytes> {
        match self {
            Self::Pictures(watch) => watch.next().await.map(|encoded| encoded.part()),
            Self::Events(reading) => reading.next().await,
        }
    }
}

type Next = Pin<Box<dyn Future<Output = (Source, Option<Bytes>)>>>;

/// Parts without end. The next one is asked for when the client took the one before: who is slow skips some.
struct Stream {
    source: Option<Source>,
    next: Option<Next>,
    handed: Handed,
}

impl Reply {
    fn whole(text: String) -> Self {
        Self::Whole(text.into())
    }
}

impl Stream {
    fn of(source: Source, handed: &Handed) -> Self {
        Self { source: Some(source), next: None, handed: Rc::clone(handed) }
    }

    fn poll(&mut self, cx: &mut Context<'_>) -> Poll<Option<Bytes>> {
        self.handed.set(None);
        if let Some(mut source) = self.source.take() {
            self.next = Some(Box::pin(async move {
                let part = source.next().await;
                (source, part)
            }));
        }
        let Some(next) = &mut self.next else { return Poll::Ready(None) };
        let Poll::Ready((source, part)) = next.as_mut().poll(cx) else { return Poll::Pending };
        self.next = None;
        self.handed.set(Some(Instant::now()));
        Poll::Ready(part.inspect(|_| self.source = Some(source)))
    }
}

impl Body for Reply {
    type Data = Bytes;
    type Error = Infallible;

    fn poll_frame(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Infallible>>> {
        let bytes = match self.get_mut() {
            Self::Whole(bytes) => Poll::Ready(Some(std::mem::take(bytes)).filter(|b| !b.is_empty())),
            Self::Stream { begun, .. } if !*begun => {
                *begun = true;
                Poll::Ready(Some(Bytes::from(format!("--{BOUNDARY}\r\n"))))
            }
            Self::Stream { stream, .. } => stream.poll(cx),
        };
        bytes.map(|bytes| bytes.map(|bytes| Ok(Frame::data(bytes))))
    }

    fn is_end_stream(&self) -> bool {
        matches!(self, Self::Whole(bytes) if bytes.is_empty())
    }

    fn size_hint(&self) -> SizeHint {
        match self {
            Self::Whole(bytes) => SizeHint::with_exact(bytes.len() as u64),
            Self::Stream { .. } => SizeHint::default(),
        }
    }
}
