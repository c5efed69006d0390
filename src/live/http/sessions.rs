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
use crate::session::Label;
use crate::session::archive::{self, Archive};

/// Most letters of a session's name and of its note.
const NAME_LETTERS: usize = 80;
const NOTE_LETTERS: usize = 2000;

/// Body of a request to begin or end a session.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Recording {
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
    let change: Recording = body(request).await?;
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

/// A download that goes on.
struct Download {
    archive: Archive,
    connection: Connection,
    _permit: OwnedSemaphorePermit,
}

/// `GET /sessions/ID/zip`: the session as a ZIP file, one download at a time.
pub(super) async fn download(
    State(context): State<Arc<Context>>,
    Extension(connection): Extension<Connection>,
    Path(id): Path<String>,
) -> Result<Response, Refusal> {
    let session = find(&context, id.clone()).await?;
    let permit = Arc::clone(&context.download).try_acquire_owned().map_err(|_| Refusal::Busy)?;
    let archive = blocking(move || Archive::open(&session)).await?.map_err(|e| failed(&e))?;
    let length = archive.total_bytes();
    let download = Download { archive, connection, _permit: permit };
    let parts = stream::unfold(Some(download), async |download| {
        let mut download = download?;
        download.connection.taken();
        let (download, part) = blocking(move || {
            let part = download.archive.part();
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
                Some((Err(e), None))
            }
        }
    });
    let mut response = Body::from_stream(parts).into_response();
    let headers = response.headers_mut();
    headers.insert(CONTENT_TYPE, HeaderValue::from_static("application/zip"));
    headers.insert(CONTENT_LENGTH, length.into());
    let name = HeaderValue::try_from(format!("attachment; filename=\"{id}.zip\"")).map_err(|e| failed(&e))?;
    headers.insert(CONTENT_DISPOSITION, name);
    Ok(response)
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
