//! Routes: paths of the service and the functions that answer them.

use std::convert::Infallible;
use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::body::{Body, Bytes, HttpBody};
use axum::extract::{DefaultBodyLimit, Path, Query, Request, State};
use axum::http::header::{CACHE_CONTROL, CONTENT_SECURITY_POLICY, CONTENT_TYPE, HeaderName, HeaderValue};
use axum::http::{Method, StatusCode};
use axum::middleware::{Next, from_fn, from_fn_with_state, map_response};
use axum::response::{Html, IntoResponse, Response};
use axum::routing::{get, post};
use axum::{Extension, Router};
use futures_util::stream;
use parking_lot::Mutex;
use tokio::time::timeout;

use super::connection::Connection;
use super::context::Context;
use super::exchange::{SNAPSHOT_TIME, body, json};
use super::guard::{Guard, admit, admit_change};
use super::query::Parameters;
use super::refusal::{MAX_BODY, Refusal, printable};
use super::socket::{Pace, Step};
use super::{control, metrics, sessions, state, still};
use crate::live::events::EventReader;
use crate::live::log;
use crate::live::preview::{BOUNDARY, PictureFormat, View, Watch};
use crate::live::statistics::Rate;

/// Pace of the looks whether a watcher has read its picture.
const LOOK: Duration = Duration::from_millis(4);
/// Header of the next part of a stream that no client knows.
const NO_MATTER: &[u8] = b"X-Pace: 1\r\n";
/// Files of the page: name, type, content.
const FILES: [(&str, &str, &str); 13] = [
    ("style.css", CSS, include_str!("../page/style.css")),
    ("base.js", SCRIPT, include_str!("../page/base.js")),
    ("picture.js", SCRIPT, include_str!("../page/picture.js")),
    ("still.js", SCRIPT, include_str!("../page/still.js")),
    ("legend.js", SCRIPT, include_str!("../page/legend.js")),
    ("readout.js", SCRIPT, include_str!("../page/readout.js")),
    ("zoom.js", SCRIPT, include_str!("../page/zoom.js")),
    ("plots.js", SCRIPT, include_str!("../page/plots.js")),
    ("settings.js", SCRIPT, include_str!("../page/settings.js")),
    ("sessions.js", SCRIPT, include_str!("../page/sessions.js")),
    ("state.js", SCRIPT, include_str!("../page/state.js")),
    ("setup.css", CSS, include_str!("../page/setup.css")),
    ("setup.js", SCRIPT, include_str!("../page/setup.js")),
];
const CSS: &str = "text/css; charset=utf-8";
const SCRIPT: &str = "text/javascript; charset=utf-8";
const PAGE: &str = include_str!("../page/index.html");
/// Headers of every answer. The page loads from this service alone and cannot be framed; nothing is kept.
const HEADERS: [(HeaderName, &str); 5] = [
    (CACHE_CONTROL, "no-store"),
    (
        CONTENT_SECURITY_POLICY,
        "default-src 'none'; img-src 'self' data: blob:; connect-src 'self'; style-src 'self'; script-src 'self'; \
         base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    ),
    (HeaderName::from_static("x-content-type-options"), "nosniff"),
    (HeaderName::from_static("referrer-policy"), "no-referrer"),
    (HeaderName::from_static("cross-origin-resource-policy"), "same-origin"),
];

type Shared = State<Arc<Context>>;

/// All routes behind the guard. Requests must carry their [`Connection`] as an extension.
pub(super) fn router(context: Arc<Context>, guard: Guard) -> Router {
    let guard = Arc::new(guard);
    let changes = Router::new()
        .route("/control", post(change))
        .route("/trigger", post(trigger))
        .route("/cameras/restart", post(restart))
        .route("/recording", post(sessions::record))
        .route("/sessions/{id}", post(sessions::relabel).delete(sessions::remove))
        .layer(DefaultBodyLimit::max(MAX_BODY))
        .route_layer(from_fn_with_state(Arc::clone(&guard), admit_change));
    let routes = Router::new()
        .route("/", get(Html(PAGE)))
        .route("/stream", get(pictures))
        .route("/snapshot", get(snapshot))
        .route("/pixel", get(pixel))
        .route("/histogram", get(histogram))
        .route("/state", get(async |State(context): Shared| json(&state::json(&context))))
        .route("/events", get(events))
        .route("/metrics", get(metrics_text))
        .route("/healthz", get(health))
        .route("/still", get(still::zip))
        .route("/frame", get(still::frame))
        .route("/sessions", get(sessions::list))
        .route("/sessions/{id}/zip", get(sessions::zip))
        .route("/sessions/{id}/ome-tiff", get(sessions::ome_tiff))
        .route("/sessions/{id}/thumbnail", get(sessions::thumbnail))
        .merge(changes)
        .with_state(context);
    guarded(routes, guard, Refusal::Path)
}

/// Routes behind the guard, with the headers of every answer. Paths that are not among them are refused with `unknown`.
pub(super) fn guarded(routes: Router, guard: Arc<Guard>, unknown: Refusal) -> Router {
    let missing = async move |method: Method| {
        if method == Method::GET || method == Method::HEAD { unknown.clone() } else { Refusal::Method }
    };
    routes
        .route("/page/{file}", get(file))
        .route("/log", get(async || log::latest()))
        .route("/version", get(version))
        .method_not_allowed_fallback(async || Refusal::Method)
        .fallback(missing)
        .layer(from_fn_with_state(guard, admit))
        .layer(map_response(with_headers))
        .layer(from_fn(complete))
}

/// Layer that notes when the answer to a request is complete, unless it has no end.
async fn complete(Extension(connection): Extension<Connection>, request: Request, next: Next) -> Response {
    let response = next.run(request).await;
    if response.body().size_hint().exact().is_some() {
        connection.end();
    }
    response
}

async fn with_headers(mut response: Response) -> Response {
    for (name, value) in HEADERS {
        response.headers_mut().entry(name).or_insert(HeaderValue::from_static(value));
    }
    response
}

/// A file of the page.
async fn file(Path(name): Path<String>) -> Result<Response, Refusal> {
    let (_, kind, content) = FILES.into_iter().find(|(file, ..)| *file == name).ok_or(Refusal::Path)?;
    Ok(([(CONTENT_TYPE, kind)], content).into_response())
}

async fn health(State(context): Shared) -> (StatusCode, String) {
    match state::health(&context) {
        Ok(()) => (StatusCode::OK, "ok\n".to_owned()),
        Err(problem) => (StatusCode::SERVICE_UNAVAILABLE, format!("{problem}\n")),
    }
}

async fn version() -> Response {
    let (version, features) = (env!("CARGO_PKG_VERSION"), cfg!(feature = "fusion"));
    json(&serde_json::json!({ "program": "stokescope", "version": version, "fusion": features }))
}

async fn metrics_text(State(context): Shared) -> Response {
    ([(CONTENT_TYPE, "text/plain; version=0.0.4; charset=utf-8")], metrics::text(&context)).into_response()
}

async fn pixel(State(context): Shared, Query(query): Query<Parameters>) -> Result<Response, Refusal> {
    let (x, y) = query.pixel(context.broadcast.size())?;
    Ok(json(&state::pixel(&context, x, y)))
}

async fn histogram(State(context): Shared, Query(query): Query<Parameters>) -> Result<Response, Refusal> {
    Ok(json(&state::histogram(&context, query.region()?)))
}

/// Makes the changes that the body asks for and answers the state they led to.
async fn change(State(context): Shared, request: Request) -> Result<Response, Refusal> {
    control::apply(&context, &body(request).await?)?;
    Ok(json(&state::json(&context)))
}

/// Asks for one pair of frames.
async fn trigger(State(context): Shared) -> Result<Response, Refusal> {
    if !context.pairing.shoot() {
        return Err(Refusal::Change(
            "every pair is processed; single pairs need single_shots = true in [cameras] of the board".to_owned(),
        ));
    }
    context.events.emit("triggered", serde_json::json!({}));
    Ok(json(&serde_json::json!({ "frames": context.statistics.lock().frames })))
}

/// Asks for the cameras to be closed and opened again.
async fn restart(State(context): Shared) -> Result<Response, Refusal> {
    if !context.pairing.restart() {
        return Err(Refusal::Change("every frame of a recording is replayed once: start the replay again".to_owned()));
    }
    Ok((StatusCode::ACCEPTED, json(&state::json(&context))).into_response())
}

/// Watches a view.
fn watch(context: &Context, name: &str, format: PictureFormat) -> Result<Watch, Refusal> {
    let allowed = || context.broadcast.views().map(View::name).collect();
    let unknown = || Refusal::View { found: printable(name), allowed: allowed() };
    Watch::new(&context.broadcast, name, format).ok_or_else(unknown)
}

async fn snapshot(State(context): Shared, Query(query): Query<Parameters>) -> Result<Response, Refusal> {
    let format = query.format()?;
    let mut watch = watch(&context, query.view(), format)?;
    Ok(match timeout(SNAPSHOT_TIME, watch.next()).await {
        Ok(Some(encoded)) => ([(CONTENT_TYPE, format!("image/{}", format.name()))], encoded.image()).into_response(),
        _ => (StatusCode::SERVICE_UNAVAILABLE, "no picture in time\n").into_response(),
    })
}

async fn pictures(
    State(context): Shared,
    Extension(connection): Extension<Connection>,
    Query(query): Query<Parameters>,
) -> Result<Response, Refusal> {
    let watch = watch(&context, query.view(), PictureFormat::Jpeg)?;
    let kind = format!("multipart/x-mixed-replace; boundary={BOUNDARY}");
    Ok(([(CONTENT_TYPE, kind)], endless(connection, Parts::Begin(watch, context.watchers.join()))).into_response())
}

async fn events(State(context): Shared, Extension(connection): Extension<Connection>) -> Response {
    let parts = Parts::Events(context.events.read());
    ([(CONTENT_TYPE, "application/x-ndjson")], endless(connection, parts)).into_response()
}

/// Source of an answer without end.
enum Parts {
    /// A multipart stream before its first boundary.
    Begin(Watch, Arc<Mutex<Rate>>),
    Pictures(Watch, Pace, Arc<Mutex<Rate>>),
    Events(EventReader),
}

impl Parts {
    /// Waits for the next part; gives it with the source of those that follow. None when the service ends.
    async fn next(self, connection: &Connection) -> Option<(Bytes, Self)> {
        match self {
            Self::Begin(watch, rate) => {
                let begin = Bytes::from(format!("--{BOUNDARY}\r\n"));
                Some((begin, Self::Pictures(watch, Pace::new(Instant::now()), rate)))
            }
            Self::Pictures(mut watch, mut pace, rate) => {
                if !may_go_on(connection, &mut pace).await {
                    return Some((Bytes::from_static(NO_MATTER), Self::Pictures(watch, pace, rate)));
                }
                let part = watch.next().await?.part();
                pace.sent(part.len(), Instant::now());
                connection.hand_over();
                rate.lock().add(Instant::now());
                Some((part, Self::Pictures(watch, pace, rate)))
            }
            Self::Events(mut reader) => {
                connection.taken();
                let line = reader.next().await?;
                connection.hand_over();
                Some((line, Self::Events(reader)))
            }
        }
    }
}

/// Waits until the client has read the picture before; false when its kernel is to be asked first, with a line that means nothing.
async fn may_go_on(connection: &Connection, pace: &mut Pace) -> bool {
    loop {
        // what waits in this process is handed to the kernel first
        tokio::time::sleep(LOOK).await;
        let (step, read) = pace.step(connection.backlog(), Instant::now());
        if read {
            connection.taken();
        }
        match step {
            Step::Go => return true,
            Step::Ask => return false,
            Step::Wait => {}
        }
    }
}

/// Body of parts without end. A watcher gets the newest picture when it has read the one before, so a slow one skips some.
fn endless(connection: Connection, parts: Parts) -> Body {
    Body::from_stream(stream::unfold((connection, parts), async |(connection, parts)| {
        let (part, parts) = parts.next(&connection).await?;
        Some((Ok::<_, Infallible>(part), (connection, parts)))
    }))
}

#[cfg(test)]
mod tests {
    use hyper::service::Service;
    use hyper_util::service::TowerToHyperService;

    use super::super::context::tests::context;
    use super::*;

    /// Status and body of the answer to a request at the loopback address.
    fn ask(method: &str, uri: &str, headers: &[(&str, &str)], body: &'static str) -> (u16, String) {
        let guard = Guard { control: true, ..Guard::default() };
        let service = TowerToHyperService::new(router(context(), guard));
        let mut request = Request::builder().method(method).uri(uri).header("host", "localhost");
        for (name, value) in headers {
            request = request.header(*name, *value);
        }
        let connection = Connection::new("127.0.0.1:8080".parse().unwrap(), [127, 0, 0, 1].into(), None);
        let request = request.extension(connection).body(Body::from(body)).unwrap();
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().unwrap();
        runtime.block_on(async {
            let response = service.call(request).await.unwrap();
            let status = response.status().as_u16();
            assert_eq!(response.headers()["cache-control"], "no-store", "{uri}");
            let endless = ["/events", "/stream"].iter().any(|path| uri.starts_with(path)) && status == 200;
            let body =
                if endless { Bytes::new() } else { axum::body::to_bytes(response.into_body(), 1 << 20).await.unwrap() };
            (status, String::from_utf8_lossy(&body).into_owned())
        })
    }

    #[test]
    fn every_route_answers_and_no_other_does() {
        let get = |uri| ask("GET", uri, &[], "").0;
        for uri in
            ["/", "/state", "/events", "/metrics", "/healthz", "/pixel?x=3&y=2", "/histogram", "/stream?view=raw"]
        {
            assert_eq!(get(uri), 200, "{uri}");
        }
        for uri in ["/pixel?x=-1&y=0", "/pixel", "/pixel?x=4&y=0", "/snapshot?format=gif", "/histogram?x=1&y=2"] {
            assert_eq!(get(uri), 400, "{uri}");
        }
        for uri in ["/../etc/passwd", "/%2e%2e/etc/passwd", "//", "/page.html", "/State", "/stream/", "/stream?view=no"]
        {
            assert_eq!(get(uri), 404, "{uri}");
        }
        for (method, uri) in
            [("POST", "/"), ("GET", "/control"), ("POST", "/no"), ("DELETE", "/state"), ("OPTIONS", "/")]
        {
            assert_eq!(ask(method, uri, &[], "").0, 405, "{method} {uri}");
        }
        assert_eq!(ask("HEAD", "/", &[], ""), (200, String::new()));
        assert_eq!(ask("GET", "/state", &[("origin", "http://evil.example")], "").0, 403);
    }

    #[test]
    fn a_change_is_made_as_a_whole_or_refused() {
        let proof = [("origin", "http://localhost"), ("content-type", "application/json")];
        let change = |body| ask("POST", "/control", &proof, body);
        let (status, state) = change("{\"iterations\": 3, \"jpeg_quality\": 30}");
        assert!(status == 200 && state.contains("\"iterations\":3"), "{status} {state}");
        assert_eq!(change("{\"iterations\": 0}"), (400, "iterations = 0, allowed: 1 to 1000\n".to_owned()));
        assert_eq!(change("{\"background\": \"store\"}").0, 400);
        assert!(change("{\"dolp_scale\": \"auto\"}").1.contains("\"auto\":true"));
        assert_eq!(change("{\"dolp_scale\": 0.2}").0, 200);
        assert_eq!(
            change("{\"dolp_scale\": 0}"),
            (400, "dolp_scale = 0, allowed: 0.01 to 1, or \"auto\"\n".to_owned())
        );
        assert_eq!(change("{\"dolp_scale\": \"most\"}").0, 400);
        assert_eq!(ask("POST", "/control", &proof[..1], "{}").0, 415);
        assert_eq!(ask("POST", "/control", &proof[1..], "{}").0, 403);
        assert_eq!(change(Box::leak(" ".repeat(MAX_BODY + 1).into_boxed_str())).0, 413);
    }
}
