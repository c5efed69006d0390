//! JSON bodies of requests and answers, and the times that both may take.

use std::time::Duration;

use axum::body::Bytes;
use axum::extract::rejection::BytesRejection;
use axum::extract::{FromRequest, Request};
use axum::http::StatusCode;
use axum::http::header::CONTENT_TYPE;
use axum::response::{IntoResponse, Response};
use serde::de::DeserializeOwned;
use tokio::time::timeout;

use super::refusal::Refusal;

/// Media type of JSON.
const JSON: &str = "application/json";
/// Time that the body of a change has to arrive.
const BODY_TIME: Duration = Duration::from_secs(5);
/// Time that a snapshot has to be drawn: raw and guide frames come with the camera's next frame.
pub(super) const SNAPSHOT_TIME: Duration = Duration::from_secs(10);

/// An answer of JSON.
pub(super) fn json(value: &serde_json::Value) -> Response {
    ([(CONTENT_TYPE, JSON)], value.to_string()).into_response()
}

/// Reads the JSON body of a change.
///
/// # Errors
/// [`Refusal`] of a body that is late, too large, or not what is asked for.
pub(super) async fn body<T: DeserializeOwned>(request: Request) -> Result<T, Refusal> {
    let body = timeout(BODY_TIME, Bytes::from_request(request, &()));
    let late = |_| Refusal::Change("the body did not arrive in time: send it again".to_owned());
    let body = body.await.map_err(late)?.map_err(|e: BytesRejection| match e.status() {
        StatusCode::PAYLOAD_TOO_LARGE => Refusal::Large,
        _ => Refusal::Change(e.body_text()),
    })?;
    serde_json::from_slice(&body).map_err(|e| Refusal::Change(e.to_string()))
}
