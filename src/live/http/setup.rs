//! Routes of the setup: the cameras as they are, changes of their settings, and the steps of calibration.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use axum::Router;
use axum::extract::{DefaultBodyLimit, Path, Query, Request, State};
use axum::http::StatusCode;
use axum::http::header::{CONTENT_TYPE, HeaderName};
use axum::middleware::from_fn_with_state;
use axum::response::{Html, IntoResponse, Response};
use axum::routing::{get, post};
use serde::Deserialize;
use serde_json::{Value, json};

use super::exchange::{SNAPSHOT_TIME, body, json};
use super::guard::{Guard, admit_change};
use super::query::Parameters;
use super::refusal::{MAX_BODY, Refusal, printable};
use super::routes::guarded;
use super::state::rss_bytes;
use crate::camera::Limits;
use crate::live::preview::PictureFormat;
use crate::live::setup::{Asked, CLASSES, Calibration, Description, Figures, SetupCamera, Take, Workspace};
use crate::output;
use crate::output::panel::encode_png;
use stokescope_core::calibrate::Step;
use stokescope_core::calibrate::mask::Layout;
use stokescope_core::polarization::Angle;

const PAGE: &str = include_str!("../page/setup.html");
/// Pace of the looks whether a camera has other settings, or a first frame.
const LOOK: Duration = Duration::from_millis(20);
/// Time that a camera has to be opened with other settings and to give a frame: longer than its driver may take to close and open it.
const CHANGE_TIME: Duration = Duration::from_secs(20);
/// Header with the number of the frame that a picture shows.
const FRAME: HeaderName = HeaderName::from_static("x-frame");

/// Parts of the setup that requests read and change.
#[derive(Debug)]
pub(in crate::live) struct SetupContext {
    /// Name of the board.
    pub(in crate::live) board: String,
    pub(in crate::live) started: Instant,
    pub(in crate::live) raw: Arc<SetupCamera>,
    pub(in crate::live) guide: Option<Arc<SetupCamera>>,
    pub(in crate::live) folder: Arc<Workspace>,
    pub(in crate::live) calibration: Arc<Calibration>,
    /// Whether anything may be changed.
    pub(in crate::live) allowed: bool,
    /// Connections that are being served.
    pub(in crate::live) clients: Arc<AtomicUsize>,
    /// Whether the bundle is in place, and the live service is to go on.
    pub(in crate::live) finished: AtomicBool,
}

type Shared = State<Arc<SetupContext>>;

/// All routes of the setup behind the guard.
pub(super) fn router(context: Arc<SetupContext>, guard: Guard) -> Router {
    let guard = Arc::new(guard);
    let changes = Router::new()
        .route("/control", post(change))
        .route("/cameras/restart", post(restart))
        .route("/calibrate/finish", post(finish))
        .route("/calibrate/{step}", post(take))
        .route("/calibrate/{step}/measure", post(measure))
        .route("/calibrate/{step}/keep", post(keep))
        .route("/calibrate/{step}/again", post(again))
        .layer(DefaultBodyLimit::max(MAX_BODY))
        .route_layer(from_fn_with_state(Arc::clone(&guard), admit_change));
    let routes = Router::new()
        .route("/", get(Html(PAGE)))
        .route("/state", get(async |State(context): Shared| json(&state(&context))))
        .route("/snapshot", get(snapshot))
        .route("/pixel", get(pixel))
        .route("/histogram", get(histogram))
        .route("/healthz", get(health))
        .route("/calibrate", get(async |State(context): Shared| json(&steps(&context))))
        .route("/calibrate/{step}", get(step))
        .route("/calibrate/{step}/picture", get(picture))
        .merge(changes)
        .with_state(context);
    guarded(routes, guard, Refusal::SetupPath)
}

impl SetupContext {
    fn cameras(&self) -> impl Iterator<Item = &Arc<SetupCamera>> {
        std::iter::once(&self.raw).chain(&self.guide)
    }

    /// The camera that a query names as its view.
    fn camera(&self, query: &Parameters) -> Result<&Arc<SetupCamera>, Refusal> {
        let name = query.get("view").unwrap_or("raw");
        let allowed = || ["raw", "guide"].into_iter().take(self.cameras().count()).map(str::to_owned).collect();
        let found = self.cameras().find(|camera| camera.role.to_string() == name);
        found.ok_or_else(|| Refusal::View { found: printable(name), allowed: allowed() })
    }
}

/// `/state`: the cameras as they are, and what the bundle has.
fn state(context: &SetupContext) -> Value {
    let parts = context.folder.parts();
    json!({
        "mode": "setup",
        "board": context.board,
        "bundle": context.folder.dir,
        "missing": parts.missing().collect::<Vec<_>>(),
        "steps": context.calibration.steps().collect::<Vec<_>>(),
        "kept": context.calibration.steps().filter(|step| parts.has(*step)).collect::<Vec<_>>(),
        "uptime_seconds": context.started.elapsed().as_secs(),
        "views": context.cameras().map(|camera| json!({ "name": camera.role.to_string(), "size": size(camera) })).collect::<Vec<_>>(),
        "cameras": { "raw": camera(&context.raw), "guide": context.guide.as_deref().map(camera) },
        "controls": { "allowed": context.allowed },
        "clients": context.clients.load(Ordering::Relaxed),
        "peak_rss_bytes": output::peak_rss_bytes(),
        "rss_bytes": rss_bytes(),
    })
}

fn size(camera: &SetupCamera) -> [usize; 2] {
    let size = camera.latest().planes.size();
    [size.width, size.height]
}

fn camera(camera: &SetupCamera) -> Value {
    let figures = camera.figures();
    let latest = camera.latest();
    let white = latest.white();
    let counts = |share: f32| round(f64::from(share * white));
    let limits = |range: Option<[f64; 2]>| range.map(|range| range.map(end));
    let Limits { exposure_us, gain, frame_rate } = latest.info.limits;
    json!({
        "name": latest.info.name, "backend": camera.backend(), "format": latest.info.format.to_string(), "source": latest.asked.source,
        "online": latest.fault.is_none() && latest.arrived.is_some(), "fault": latest.fault, "waiting": latest.waiting,
        "frames": latest.number, "fps": latest.rate.per_second().map(round),
        "size": [latest.planes.size().width, latest.planes.size().height], "channels": latest.planes.count(),
        "white": white, "black": latest.black(),
        "exposure_us": { "asked": latest.asked.exposure_us, "took": latest.metadata.exposure_us, "limits": limits(exposure_us) },
        "gain": { "asked": latest.asked.gain, "took": latest.metadata.gain, "limits": limits(gain) },
        "frame_rate": { "asked": latest.asked.frame_rate, "took": latest.info.frame_rate.map(round), "limits": limits(frame_rate) },
        "figures": figures.map(|f| json!({
            "saturated": f.saturated, "clipped": f.clipped, "mean": counts(f.mean), "median": counts(f.median),
            "bright": counts(f.bright), "focus": round(f64::from(f.focus)), "moved": f.moved,
        })),
    })
}

fn round(value: f64) -> f64 {
    (value * 100.0).round() / 100.0
}

/// An end of a range of settings, without the digits that a sensor's arithmetic leaves.
fn end(value: f64) -> f64 {
    (value * 1000.0).round() / 1000.0
}

/// The latest frame as a picture; the first one is waited for.
async fn snapshot(State(context): Shared, Query(query): Query<Parameters>) -> Result<Response, Refusal> {
    let (format, camera) = (query.format()?, context.camera(&query)?);
    wait_for(SNAPSHOT_TIME, || camera.latest().arrived).await.ok_or(Refusal::NoFrame)?;
    let number = camera.latest().number.to_string();
    let headers = [(CONTENT_TYPE, format!("image/{}", format.name())), (FRAME, number)];
    if format == PictureFormat::Jpeg {
        return Ok((headers, camera.jpeg().ok_or(Refusal::NoFrame)?).into_response());
    }
    let mut png = Vec::new();
    let picture = camera.picture().ok_or(Refusal::NoFrame)?;
    encode_png(&picture, &mut png).map_err(|e| Refusal::Failed(e.to_string()))?;
    Ok((headers, png).into_response())
}

/// `/pixel`: the readings of one pixel of the latest frame in counts, one for each channel.
async fn pixel(State(context): Shared, Query(query): Query<Parameters>) -> Result<Response, Refusal> {
    let latest = context.camera(&query)?.latest();
    let size = latest.planes.size();
    let (x, y) = query.pixel(size)?;
    let counts: Vec<f32> = latest.planes.planes().map(|plane| plane[y * size.width + x]).collect();
    let saturated = counts.iter().any(|v| *v >= latest.white());
    let there = latest.arrived.is_some();
    Ok(json(
        &json!({ "frame": latest.number, "x": x, "y": y, "counts": there.then_some(counts), "saturated": saturated }),
    ))
}

/// `/histogram`: shares of the readings by count; class `k` of 64 begins at `k` / 64 of the count of a full reading. Null before a frame.
async fn histogram(State(context): Shared, Query(query): Query<Parameters>) -> Result<Response, Refusal> {
    let camera = context.camera(&query)?;
    let figures: Option<Arc<Figures>> = camera.figures();
    let white = camera.latest().white();
    Ok(json(&figures.map_or(Value::Null, |f| {
        json!({ "classes": &f.classes[..], "class_counts": white / CLASSES as f32, "saturated": f.saturated, "clipped": f.clipped })
    })))
}

/// `/healthz`: whether the lensless camera delivers.
async fn health(State(context): Shared) -> (StatusCode, String) {
    match &context.raw.latest().fault {
        None => (StatusCode::OK, "ok\n".to_owned()),
        Some(fault) => (StatusCode::SERVICE_UNAVAILABLE, format!("raw camera offline: {fault}\n")),
    }
}

/// Body of a change of settings; cameras and settings that are left out stay.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Change {
    raw: Option<CameraChange>,
    guide: Option<CameraChange>,
}

/// Settings of one camera. Null leaves a setting to the camera.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct CameraChange {
    #[serde(deserialize_with = "given")]
    exposure_us: Option<Option<f32>>,
    #[serde(deserialize_with = "given")]
    gain: Option<Option<f32>>,
    #[serde(deserialize_with = "given")]
    frame_rate: Option<Option<f64>>,
    source: Option<String>,
}

/// Tells a null that is given from a key that is left out.
fn given<'de, D: serde::Deserializer<'de>, T: Deserialize<'de>>(from: D) -> Result<Option<Option<T>>, D::Error> {
    Option::deserialize(from).map(Some)
}

impl CameraChange {
    /// The settings that `camera` is to be opened with.
    fn of(&self, camera: &SetupCamera) -> Result<Asked, Refusal> {
        let (asked, limits) = {
            let latest = camera.latest();
            (latest.asked.clone(), latest.info.limits)
        };
        let exposure_us = self.exposure_us.unwrap_or(asked.exposure_us);
        let gain = self.gain.unwrap_or(asked.gain);
        let frame_rate = self.frame_rate.unwrap_or(asked.frame_rate);
        // the longest exposure is another one with another frame rate: the camera says what it took
        let exposures = limits.exposure_us.filter(|_| frame_rate == asked.frame_rate);
        within(camera, "exposure_us", self.exposure_us.flatten().map(f64::from), exposures.unwrap_or([1.0, 1e9]))?;
        within(camera, "gain", self.gain.flatten().map(f64::from), limits.gain.unwrap_or([0.0, 1e6]))?;
        within(camera, "frame_rate", self.frame_rate.flatten(), limits.frame_rate.unwrap_or([1e-3, 1e3]))?;
        if self.source.is_some() && camera.backend() != "sim" {
            let (role, backend) = (camera.role, camera.backend());
            return Err(Refusal::Change(format!(
                "{role}.source: allowed for simulated cameras alone; this one is of {backend}"
            )));
        }
        let source = self.source.clone().unwrap_or(asked.source);
        Ok(Asked { exposure_us, gain, frame_rate, source })
    }
}

/// Checks a setting that is to change against what the camera takes.
fn within(camera: &SetupCamera, key: &str, value: Option<f64>, [low, high]: [f64; 2]) -> Result<(), Refusal> {
    match value {
        Some(v) if !(low..=high).contains(&v) => {
            let (role, v, low, high) = (camera.role, v as f32, end(low), end(high));
            Err(Refusal::Change(format!("{role}.{key} = {v}, allowed: {low} to {high}, or null")))
        }
        _ => Ok(()),
    }
}

/// Opens cameras with other settings and answers the state that this led to. All settings are checked before anything changes.
async fn change(State(context): Shared, request: Request) -> Result<Response, Refusal> {
    let Change { raw, guide } = body(request).await?;
    if guide.is_some() && context.guide.is_none() {
        return Err(Refusal::Change("guide: the board has no guide camera".to_owned()));
    }
    let of = |camera: &Arc<SetupCamera>, change: CameraChange| Ok((Arc::clone(camera), change.of(camera)?));
    let raw = raw.map(|change| of(&context.raw, change)).transpose()?;
    let guide = context.guide.as_ref().zip(guide).map(|(camera, change)| of(camera, change)).transpose()?;
    let begun: Vec<_> = raw.into_iter().chain(guide).map(|(camera, asked)| (camera.ask(asked), camera)).collect();
    for (change, camera) in begun {
        let role = camera.role;
        match wait_for(CHANGE_TIME, || camera.outcome(change)).await {
            Some(Ok(())) => {}
            Some(Err(reason)) => {
                return Err(Refusal::Change(format!("{role}: {reason}; it goes on with its settings before")));
            }
            None => return Err(Refusal::Failed(format!("{role}: the camera gives no frame with these settings"))),
        }
    }
    Ok(json(&state(&context)))
}

/// Opens the cameras again, with the settings that they have.
async fn restart(State(context): Shared) -> Response {
    for camera in context.cameras() {
        let asked = camera.latest().asked.clone();
        camera.ask(asked);
        tracing::info!("{} camera: opened again by request", camera.role);
    }
    (StatusCode::ACCEPTED, json(&state(&context))).into_response()
}

/// Looks for something again and again, at most for `patience`.
async fn wait_for<T>(patience: Duration, mut look: impl FnMut() -> Option<T>) -> Option<T> {
    let deadline = Instant::now() + patience;
    loop {
        if let Some(found) = look() {
            return Some(found);
        }
        if Instant::now() > deadline {
            return None;
        }
        tokio::time::sleep(LOOK).await;
    }
}

/// `/calibrate`: the state of all steps.
fn steps(context: &SetupContext) -> Value {
    let steps: Vec<Value> = context.calibration.steps().map(|step| context.calibration.state(step)).collect();
    json!({ "steps": steps, "missing": context.folder.parts().missing().collect::<Vec<_>>() })
}

/// The step that a path names.
fn named(context: &SetupContext, name: &str) -> Result<Step, Refusal> {
    let names = || context.calibration.steps().map(|step| step.name().to_owned()).collect();
    context.calibration.step(name).ok_or_else(|| Refusal::Step { found: printable(name), allowed: names() })
}

async fn step(State(context): Shared, Path(name): Path<String>) -> Result<Response, Refusal> {
    Ok(json(&context.calibration.state(named(&context, &name)?)))
}

/// The picture of a step's result.
async fn picture(State(context): Shared, Path(name): Path<String>) -> Result<Response, Refusal> {
    let step = named(&context, &name)?;
    let png = context.calibration.picture(step).ok_or(Refusal::NoPicture)?;
    Ok(([(CONTENT_TYPE, "image/png")], png).into_response())
}

/// Body of a request for frames.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct TakeBody {
    frames: i64,
    angle: Option<f64>,
    unmasked: bool,
}

impl Default for TakeBody {
    fn default() -> Self {
        Self { frames: 16, angle: None, unmasked: false }
    }
}

/// Body of a request to measure with views of a polarizer.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct MeasureBody {
    zero: f64,
    mask_angles: Vec<f64>,
    stripes: i64,
}

impl Default for MeasureBody {
    fn default() -> Self {
        Self { zero: 0.0, mask_angles: vec![0.0, 45.0, 90.0, 135.0], stripes: 16 }
    }
}

/// Most frames of a step, stripes and angles of a mask, as on the command line.
const MAX_FRAMES: i64 = 1000;
const MAX_STRIPES: i64 = 4096;
const MAX_ANGLES: usize = 16;

/// Begins to take frames of a step; its state says when they are there.
async fn take(State(context): Shared, Path(name): Path<String>, request: Request) -> Result<Response, Refusal> {
    let step = named(&context, &name)?;
    let TakeBody { frames, angle: dial, unmasked } = body(request).await?;
    if !(1..=MAX_FRAMES).contains(&frames) {
        return Err(Refusal::Change(format!("frames = {frames}, allowed: 1 to {MAX_FRAMES}")));
    }
    let take = Take { frames: frames as usize, dial, unmasked };
    context.calibration.take(step, take).map_err(Refusal::Change)?;
    Ok((StatusCode::ACCEPTED, json(&context.calibration.state(step))).into_response())
}

/// Begins to measure with the views of a step.
async fn measure(State(context): Shared, Path(name): Path<String>, request: Request) -> Result<Response, Refusal> {
    let step = named(&context, &name)?;
    let MeasureBody { zero, mask_angles, stripes } = body(request).await?;
    if !(3..=MAX_STRIPES).contains(&stripes) {
        return Err(Refusal::Change(format!("stripes = {stripes}, allowed: 3 to {MAX_STRIPES}")));
    }
    if !(3..=MAX_ANGLES).contains(&mask_angles.len()) || !zero.is_finite() {
        let found = mask_angles.len();
        return Err(Refusal::Change(format!(
            "mask_angles: {found} of them, allowed: 3 to {MAX_ANGLES} angles in degrees"
        )));
    }
    let angles = mask_angles.into_iter().map(Angle::from_degrees).collect();
    let layout = Layout { angles, stripes: stripes as usize };
    context.calibration.measure(step, Description { zero, layout }).map_err(Refusal::Change)?;
    Ok((StatusCode::ACCEPTED, json(&context.calibration.state(step))).into_response())
}

/// Puts the result of a step into the bundle in the making.
async fn keep(State(context): Shared, Path(name): Path<String>) -> Result<Response, Refusal> {
    let step = named(&context, &name)?;
    let calibration = Arc::clone(&context.calibration);
    blocking(move || calibration.keep(step)).await?;
    Ok(json(&context.calibration.state(step)))
}

/// Forgets the frames and the result of a step.
async fn again(State(context): Shared, Path(name): Path<String>) -> Result<Response, Refusal> {
    let step = named(&context, &name)?;
    context.calibration.again(step).map_err(Refusal::Change)?;
    Ok(json(&context.calibration.state(step)))
}

/// Puts the complete bundle in place; the live service then takes over.
async fn finish(State(context): Shared) -> Result<Response, Refusal> {
    if context.calibration.is_busy() {
        return Err(Refusal::Change("a step is in work: wait until it is done".to_owned()));
    }
    let missing: Vec<_> = context.folder.parts().missing().map(Step::name).collect();
    if !missing.is_empty() {
        return Err(Refusal::Change(format!("the bundle is not complete; left to do: {}", missing.join(", "))));
    }
    let folder = Arc::clone(&context.folder);
    let digest = blocking(move || folder.finish().map(|bundle| bundle.digest).map_err(|e| e.to_string())).await?;
    context.finished.store(true, Ordering::Release);
    Ok(json(&json!({ "bundle": context.folder.dir, "calibration": digest })))
}

/// Runs work that waits for the disk beside the answers to other requests.
async fn blocking<T: Send + 'static>(work: impl FnOnce() -> Result<T, String> + Send + 'static) -> Result<T, Refusal> {
    let done = tokio::task::spawn_blocking(work).await;
    done.map_err(|e| Refusal::Failed(e.to_string()))?.map_err(Refusal::Change)
}
