//! One frame as a whole: its numbers, and its pictures of every view.

use std::convert::Infallible;
use std::sync::Arc;
use std::time::Duration;

use axum::Extension;
use axum::body::{Body, Bytes};
use axum::extract::{Query, State};
use axum::http::header::{CONTENT_DISPOSITION, CONTENT_LENGTH, CONTENT_TYPE};
use axum::http::{HeaderName, HeaderValue};
use axum::response::{IntoResponse, Response};
use futures_util::stream;
use tokio::sync::OwnedSemaphorePermit;

use super::connection::Connection;
use super::context::Context;
use super::exchange::SNAPSHOT_TIME;
use super::query::Parameters;
use super::refusal::Refusal;
use crate::files::{Element, Zip, npy_header};
use crate::live::frame::PublishedFrame;
use crate::live::preview::{Still, View};
use stokescope_core::image::Stack;

/// Values in one part of an answer.
const VALUES: usize = 8 << 10;
/// Number of the frame, and the age of it when it was sent.
const FRAME: HeaderName = HeaderName::from_static("x-frame");
const AGE: HeaderName = HeaderName::from_static("x-age-seconds");

/// A frame that is held until its client has taken it, one at a time.
struct Held {
    context: Arc<Context>,
    connection: Connection,
    still: Still,
    _permit: OwnedSemaphorePermit,
}

impl Held {
    async fn take(context: Arc<Context>, connection: Connection, sketched: bool) -> Result<Self, Refusal> {
        let acquired = tokio::time::timeout(SNAPSHOT_TIME, Arc::clone(&context.still).acquire_owned()).await;
        let permit = acquired.ok().and_then(Result::ok).ok_or(Refusal::Busy)?;
        let patience = if sketched { SNAPSHOT_TIME } else { Duration::ZERO };
        let still = context.broadcast.still(sketched, patience).await.ok_or(Refusal::NoFrame)?;
        Ok(Self { context, connection, still, _permit: permit })
    }

    fn headers(&self, kind: &'static str, name: &str) -> Result<Response, Refusal> {
        let frame = &self.still.frame;
        let age = format!("{:.3}", frame.arrived.elapsed().as_secs_f64());
        let mut response = ().into_response();
        let headers = response.headers_mut();
        headers.insert(CONTENT_TYPE, HeaderValue::from_static(kind));
        headers.insert(FRAME, frame.index.into());
        let text = |text: String| HeaderValue::try_from(text).map_err(|e| Refusal::Failed(e.to_string()));
        headers.insert(AGE, text(age)?);
        headers.insert(CONTENT_DISPOSITION, text(format!("attachment; filename=\"{name}\""))?);
        Ok(response)
    }
}

/// Images of a frame that are sent as numbers.
#[derive(Clone, Copy, PartialEq)]
enum Numbers {
    Stokes,
    Errors,
}

impl Numbers {
    /// Name of the file.
    fn name(self) -> &'static str {
        match self {
            Self::Stokes => "stokes",
            Self::Errors => "stokes_error",
        }
    }

    fn of(self, frame: &PublishedFrame) -> &Stack<f32> {
        match self {
            Self::Stokes => &frame.stokes,
            Self::Errors => &frame.errors,
        }
    }

    /// Head of an NPY file of the shape (C,) K, H, W.
    fn head(self, frame: &PublishedFrame) -> Vec<u8> {
        let (size, channels) = (frame.size(), frame.channels);
        let shape = [channels, self.of(frame).count() / channels, size.height, size.width];
        npy_header(f32::DESCR, &shape[usize::from(channels == 1)..])
    }

    /// Values from number `from` on, as bytes; empty after the last.
    fn values(self, frame: &PublishedFrame, from: usize) -> Vec<u8> {
        let all = self.of(frame).as_slice();
        all[from.min(all.len())..].iter().take(VALUES).flat_map(|value| value.to_le_bytes()).collect()
    }
}

/// `GET /frame`: the Stokes images of the latest frame, or their standard errors, as an NPY file.
pub(super) async fn frame(
    State(context): State<Arc<Context>>,
    Extension(connection): Extension<Connection>,
    Query(query): Query<Parameters>,
) -> Result<Response, Refusal> {
    let numbers = match query.one_of("of", &["stokes", "errors"])? {
        "errors" => Numbers::Errors,
        _ => Numbers::Stokes,
    };
    query.one_of("format", &["npy"])?;
    let held = Held::take(context, connection, false).await?;
    let frame = &held.still.frame;
    let (head, name) = (numbers.head(frame), format!("{}-{}.npy", numbers.name(), frame.index));
    let length = head.len() + size_of_val(numbers.of(frame).as_slice());
    let mut response = held.headers("application/octet-stream", &name)?;
    response.headers_mut().insert(CONTENT_LENGTH, length.into());
    let parts = stream::unfold((held, numbers, Some(head), 0), async |(held, numbers, head, from)| {
        held.connection.taken();
        let (part, next) = match head {
            Some(head) => (head, 0),
            None => (numbers.values(&held.still.frame, from), from + VALUES),
        };
        held.connection.hand_over();
        if part.is_empty() {
            held.connection.end();
            return None;
        }
        Some((Ok::<_, Infallible>(Bytes::from(part)), (held, numbers, None, next)))
    });
    *response.body_mut() = Body::from_stream(parts);
    Ok(response)
}

/// Entry of a ZIP file of a frame that comes next.
enum Next {
    Numbers(Numbers),
    /// Values of the numbers, from this one on.
    Values(Numbers, usize),
    Validity,
    Report,
    Picture(usize),
    End,
}

/// A ZIP file of a frame on its way.
struct Packing {
    held: Held,
    views: Vec<View>,
    zip: Zip,
    next: Next,
}

impl Packing {
    /// The next part; none after the last, or when the service ends.
    async fn part(&mut self) -> Option<Vec<u8>> {
        let frame = Arc::clone(&self.held.still.frame);
        match self.next {
            Next::Numbers(numbers) => {
                let head = numbers.head(&frame);
                let mut sum = crc32fast::Hasher::new();
                sum.update(&head);
                let all = numbers.of(&frame).as_slice();
                (0..all.len()).step_by(VALUES).for_each(|from| sum.update(&numbers.values(&frame, from)));
                let size = head.len() + size_of_val(all);
                let index = self.zip.add(&format!("{}.npy", numbers.name()), size as u64).ok()?;
                self.next = Next::Values(numbers, 0);
                Some([self.zip.header(index, sum.finalize()), head].concat())
            }
            Next::Values(numbers, from) => {
                let next = from + VALUES;
                self.next = if next < numbers.of(&frame).as_slice().len() {
                    Next::Values(numbers, next)
                } else if numbers == Numbers::Stokes {
                    Next::Numbers(Numbers::Errors)
                } else {
                    Next::Validity
                };
                Some(numbers.values(&frame, from))
            }
            Next::Validity => {
                self.next = Next::Report;
                let mut content = npy_header("|b1", &[frame.size().height, frame.size().width]);
                content.extend(frame.valid.iter().map(|valid| u8::from(*valid)));
                self.file("valid.npy", &content)
            }
            Next::Report => {
                self.next = Next::Picture(0);
                let report = serde_json::json!({ "frame": frame.index, "report": &frame.report });
                let text = serde_json::to_vec_pretty(&report).ok()?;
                self.file("report.json", &text)
            }
            Next::Picture(n) if n < self.views.len() => {
                self.next = Next::Picture(n + 1);
                let view = self.views[n];
                let png = self.held.context.broadcast.draw(&self.held.still, view).await?;
                self.file(&format!("{}.png", view.name()), &png)
            }
            Next::Picture(_) => {
                self.next = Next::End;
                let mut directory = Vec::new();
                self.zip.directory(0, 0, usize::MAX, &mut directory);
                directory.extend(self.zip.end());
                Some(directory)
            }
            Next::End => None,
        }
    }

    /// A whole entry.
    fn file(&mut self, name: &str, content: &[u8]) -> Option<Vec<u8>> {
        let index = self.zip.add(name, content.len() as u64).ok()?;
        let mut part = self.zip.header(index, crc32fast::hash(content));
        part.extend(content);
        Some(part)
    }
}

/// `GET /still`: one frame as a ZIP file: its numbers, its report, and a picture of each view that is asked for.
pub(super) async fn zip(
    State(context): State<Arc<Context>>,
    Extension(connection): Extension<Connection>,
    Query(query): Query<Parameters>,
) -> Result<Response, Refusal> {
    let known: Vec<View> = context.broadcast.views().collect();
    let views = query.views(&known)?;
    let sketched = views.iter().any(|view| view.is_sketch());
    let held = Held::take(context, connection, sketched).await?;
    let mut response = held.headers("application/zip", &format!("frame-{}.zip", held.still.frame.index))?;
    let packing = Packing { held, views, zip: Zip::default(), next: Next::Numbers(Numbers::Stokes) };
    let parts = stream::unfold(packing, async |mut packing| {
        packing.held.connection.taken();
        let part = packing.part().await;
        packing.held.connection.hand_over();
        match part {
            Some(part) => Some((Ok::<_, Infallible>(Bytes::from(part)), packing)),
            None => {
                packing.held.connection.end();
                None
            }
        }
    });
    *response.body_mut() = Body::from_stream(parts);
    Ok(response)
}
