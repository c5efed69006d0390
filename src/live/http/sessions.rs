//! Sessions over HTTP: recording, lists, names, downloads, removal.
//!
//! Whatever waits for the disk runs in a thread of its own, so that pictures go on.

use std::path::PathBuf;
use std::sync::Arc;

use axum::body::Body;
use axum::extract::{Path, Request, State};
use axum::http::header::{CONTENT_DISPOSITION, CONTENT_LENGTH, CONTENT_TYPE};
use axum::response::{IntoResponse, Response};
use axum::{Extension, http::HeaderValue};
use futures_util::stream;
use serde::Deserialize;
use serde_json::json;
use tokio::sync::OwnedSemaphorePermit;

use super::connection::Connection;
use super::context::Context;
use super::exchange::{body, json};
use super::refusal::Refusal;
use super::state;
use crate::live::recorder::Recorder;
use crate::session::archive::{self, Archive};
use crate::session::{Label, OmeTiff, Recording};

/// Most letters of a session's name and of its note.
const NAME_LETTERS: usize = 80;
const NOTE_LETTERS: usize = 2000;

/// Body of a request to begin or end a session.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Record {
    on: bool,
    #[serde(default)]
    name: String,
    #[serde(default)]
    note: String,
}

/// Body of a request to label a session.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Labelled {
    name: String,
    note: String,
}

/// Checks a name and a note.
fn label(name: &str, note: &str) -> Result<Label, Refusal> {
    let check = |key: &str, text: &str, most: usize, line: bool| {
        let count = text.chars().count();
        if count > most {
            return Err(Refusal::Change(format!("{key}: {count} letters, allowed: at most {most}")));
        }
        match text.chars().find(|c| c.is_control() && (line || *c != '\n')) {
            Some(c) => Err(Refusal::Change(format!("{key}: {c:?}, allowed: letters that can be seen"))),
            None => Ok(text.trim().to_owned()),
        }
    };
    Ok(Label { name: check("name", name, NAME_LETTERS, true)?, note: check("note", note, NOTE_LETTERS, false)? })
}

fn recorder(context: &Context) -> Result<&(Arc<Recorder>, PathBuf), Refusal> {
    context.recorder.as_ref().ok_or(Refusal::NoSessions)
}

/// Does what may wait for the disk in another thread.
async fn blocking<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> Result<T, Refusal> {
    tokio::task::spawn_blocking(work).await.map_err(|e| Refusal::Failed(e.to_string()))
}

fn failed(error: &impl ToString) -> Refusal {
    Refusal::Failed(error.to_string())
}

/// Folder of the session `id`.
async fn find(context: &Context, id: String) -> Result<PathBuf, Refusal> {
    let dir = recorder(context)?.1.clone();
    blocking(move || archive::session(&dir, &id)).await?.ok_or(Refusal::NoSession)
}

/// `POST /recording`: begins or ends a session.
pub(super) async fn record(State(context): State<Arc<Context>>, request: Request) -> Result<Response, Refusal> {
    let (recorder, _) = recorder(&context)?;
    let change: Record = body(request).await?;
    if !change.on {
        recorder.end();
    } else if !recorder.begin(label(&change.name, &change.note)?) {
        return Err(Refusal::Change("on = true: a session is being recorded already; end it first".to_owned()));
    }
    Ok(json(&state::json(&context)))
}

/// `GET /sessions`: all sessions, newest first.
pub(super) async fn list(State(context): State<Arc<Context>>) -> Result<Response, Refusal> {
    let (recorder, dir) = recorder(&context)?.clone();
    let current = recorder.is_on().then(|| context.statistics.lock().recording.session.clone()).flatten();
    let found = dir.clone();
    let sessions = blocking(move || if found.is_dir() { archive::sessions(&found) } else { Ok(Vec::new()) });
    let current = current.and_then(|path| Some(path.file_name()?.to_string_lossy().into_owned()));
    Ok(json(&json!({ "dir": dir, "current": current, "sessions": sessions.await?.map_err(|e| failed(&e))? })))
}

/// `POST /sessions/ID`: gives a session another name and note.
pub(super) async fn relabel(
    State(context): State<Arc<Context>>,
    Path(id): Path<String>,
    request: Request,
) -> Result<Response, Refusal> {
    let session = find(&context, id).await?;
    let Labelled { name, note } = body(request).await?;
    let label = label(&name, &note)?;
    blocking(move || archive::relabel(&session, label)).await?.map_err(|e| failed(&e))?;
    list(State(context)).await
}

/// `DELETE /sessions/ID`: removes a session.
pub(super) async fn remove(State(context): State<Arc<Context>>, Path(id): Path<String>) -> Result<Response, Refusal> {
    let session = find(&context, id.clone()).await?;
    let (recorder, _) = recorder(&context)?;
    if recorder.uses(&session) {
        return Err(Refusal::Change(format!("{id} is being recorded: end it first")));
    }
    blocking(move || archive::remove(&session)).await?.map_err(|e| failed(&e))?;
    recorder.recount();
    context.events.emit("session-removed", json!({ "session": id }));
    list(State(context)).await
}

/// `GET /sessions/ID/thumbnail`: a small picture of the first frame.
pub(super) async fn thumbnail(
    State(context): State<Arc<Context>>,
    Path(id): Path<String>,
) -> Result<Response, Refusal> {
    let session = find(&context, id).await?;
    let picture = blocking(move || archive::read_thumbnail(&session)).await?;
    Ok(([(CONTENT_TYPE, "image/png")], picture.map_err(|_| Refusal::NoThumbnail)?).into_response())
}

/// Gives the next part of a file that is made while it is sent; none after the last.
type Parts = Box<dyn FnMut() -> Result<Option<Vec<u8>>, String> + Send>;

/// A download that goes on.
struct Download {
    parts: Parts,
    connection: Connection,
    _permit: OwnedSemaphorePermit,
}

/// Sends a file of the session `id`, of the media type `kind`, whose length and parts `open` gives. One download goes on at a time.
async fn download(
    (context, connection, id): (Arc<Context>, Connection, String),
    (kind, ending): (&'static str, &str),
    open: impl FnOnce(PathBuf) -> Result<(u64, Parts), Refusal> + Send + 'static,
) -> Result<Response, Refusal> {
    let session = find(&context, id.clone()).await?;
    let permit = Arc::clone(&context.download).try_acquire_owned().map_err(|_| Refusal::Busy)?;
    let (length, parts) = blocking(move || open(session)).await??;
    let download = Download { parts, connection, _permit: permit };
    let parts = stream::unfold(Some(download), async |download| {
        let mut download = download?;
        download.connection.taken();
        let (download, part) = blocking(move || {
            let part = (download.parts)();
            (download, part)
        })
        .await
        .ok()?;
        download.connection.hand_over();
        match part {
            Ok(Some(part)) => Some((Ok(part), Some(download))),
            Ok(None) => {
                download.connection.end();
                None
            }
            Err(e) => {
                tracing::warn!("a download ends early: {e}");
                Some((Err(std::io::Error::other(e)), None))
            }
        }
    });
    let mut response = Body::from_stream(parts).into_response();
    let headers = response.headers_mut();
    headers.insert(CONTENT_TYPE, HeaderValue::from_static(kind));
    headers.insert(CONTENT_LENGTH, length.into());
    let name = HeaderValue::try_from(format!("attachment; filename=\"{id}.{ending}\"")).map_err(|e| failed(&e))?;
    headers.insert(CONTENT_DISPOSITION, name);
    Ok(response)
}

/// `GET /sessions/ID/zip`: the session as a ZIP file.
pub(super) async fn zip(
    State(context): State<Arc<Context>>,
    Extension(connection): Extension<Connection>,
    Path(id): Path<String>,
) -> Result<Response, Refusal> {
    download((context, connection, id), ("application/zip", "zip"), |session| {
        let mut archive = Archive::open(&session).map_err(|e| failed(&e))?;
        Ok((archive.total_bytes(), Box::new(move || archive.part().map_err(|e| e.to_string()))))
    })
    .await
}

/// `GET /sessions/ID/ome-tiff`: the results of the session's complete frames as an OME-TIFF file.
pub(super) async fn ome_tiff(
    State(context): State<Arc<Context>>,
    Extension(connection): Extension<Connection>,
    Path(id): Path<String>,
) -> Result<Response, Refusal> {
    download((context, connection, id), ("image/tiff", "ome.tif"), |session| {
        let recording = Recording::open(&session).map_err(|e| Refusal::NoResults(e.to_string()))?;
        if recording.is_empty() {
            return Err(Refusal::NoResults("the session has no frame whose files are all there".to_owned()));
        }
        let mut file = OmeTiff::new(recording).map_err(|e| failed(&e))?;
        Ok((file.total_bytes(), Box::new(move || file.part().map_err(|e| e.to_string()))))
    })
    .await
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_one_line_and_notes_are_not_too_long() {
        let found = label(" leaf ", "two\nlines ").unwrap();
        assert_eq!((found.name.as_str(), found.note.as_str()), ("leaf", "two\nlines"));
        assert!(label("two\nlines", "").unwrap_err().to_string().contains("name: '\\n'"));
        assert!(label(&"ä".repeat(NAME_LETTERS), "").is_ok());
        let e = label("", &"n".repeat(NOTE_LETTERS + 1)).unwrap_err().to_string();
        assert_eq!(e, "note: 2001 letters, allowed: at most 2000");
    }
}
