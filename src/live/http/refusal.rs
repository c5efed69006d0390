//! Refusals: requests that are not answered, and why.

use axum::http::StatusCode;
use axum::http::header::{ALLOW, HeaderValue, RETRY_AFTER, WWW_AUTHENTICATE};
use axum::response::{IntoResponse, Response};

/// Most bytes of the body of a change.
pub(super) const MAX_BODY: usize = 4096;
/// Most letters of a client's text in an answer.
const QUOTED: usize = 80;

/// Reason why a request is refused.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub(super) enum Refusal {
    #[error("this is not an HTTP/1.1 request with one Host")]
    NoHost,
    #[error(
        "{header} {found} is not this machine: use localhost, the address the service listens on, or a name allowed with --allow-host or by allowed_hosts in [preview] of the board file"
    )]
    Foreign { header: &'static str, found: String },
    #[error("a token is needed: Authorization: Bearer TOKEN, or ?token=TOKEN")]
    Token,
    #[error("the token is not the one of this service")]
    WrongToken,
    #[error(
        "only GET and HEAD are allowed; changes go to /control, /trigger, /cameras/restart, /recording and /sessions/ID, and during setup to /control, /cameras/restart and /calibrate"
    )]
    Method,
    #[error("nothing can be changed: start the service with --control, or with --token")]
    ReadOnly,
    #[error("a change needs an Origin of this machine, or a token in the Authorization header")]
    Unproven,
    #[error("a change is a JSON object: send Content-Type: application/json")]
    Type,
    #[error("a change has at most {MAX_BODY} bytes")]
    Large,
    #[error("{0}")]
    Change(String),
    #[error(
        "no such page; there are /, /stream, /snapshot, /still, /frame, /pixel, /histogram, /sessions, /state, /events, /log, /metrics, /version, /healthz, /recording, /trigger, /cameras/restart and /control"
    )]
    Path,
    #[error(
        "no such page; during setup there are /, /state, /snapshot, /pixel, /histogram, /calibrate, /log, /version, /healthz, /cameras/restart and /control"
    )]
    SetupPath,
    #[error("nothing can be recorded: start the service with --sessions DIR, or with --record DIR")]
    NoSessions,
    #[error("no such session; /sessions lists them")]
    NoSession,
    #[error("the session has no thumbnail")]
    NoThumbnail,
    #[error("{0}")]
    NoResults(String),
    #[error("somebody else is being served this: ask again in some seconds")]
    Busy,
    #[error("there is no frame yet: ask again in some seconds")]
    NoFrame,
    #[error("{0}")]
    Failed(String),
    #[error("no step {found}; there are {}", allowed.join(", "))]
    Step { found: String, allowed: Vec<String> },
    #[error("the step has no result yet")]
    NoPicture,
    #[error("no view {found}; there are {}", allowed.join(", "))]
    View { found: String, allowed: Vec<String> },
    #[error("{key} = {found}, allowed: {allowed}")]
    Query { key: &'static str, found: String, allowed: String },
}

impl Refusal {
    fn status(&self) -> StatusCode {
        match self {
            Self::NoHost | Self::Query { .. } | Self::Change(_) => StatusCode::BAD_REQUEST,
            Self::Token | Self::WrongToken => StatusCode::UNAUTHORIZED,
            Self::Foreign { .. } | Self::ReadOnly | Self::Unproven => StatusCode::FORBIDDEN,
            Self::Path
            | Self::SetupPath
            | Self::Step { .. }
            | Self::NoPicture
            | Self::View { .. }
            | Self::NoSessions
            | Self::NoSession
            | Self::NoThumbnail
            | Self::NoResults(_) => StatusCode::NOT_FOUND,
            Self::Busy | Self::NoFrame => StatusCode::SERVICE_UNAVAILABLE,
            Self::Failed(_) => StatusCode::INTERNAL_SERVER_ERROR,
            Self::Method => StatusCode::METHOD_NOT_ALLOWED,
            Self::Large => StatusCode::PAYLOAD_TOO_LARGE,
            Self::Type => StatusCode::UNSUPPORTED_MEDIA_TYPE,
        }
    }
}

impl IntoResponse for Refusal {
    fn into_response(self) -> Response {
        let mut response = (self.status(), format!("{self}\n")).into_response();
        let headers = response.headers_mut();
        match self {
            Self::Method => drop(headers.insert(ALLOW, HeaderValue::from_static("GET, HEAD, POST, DELETE"))),
            Self::Busy | Self::NoFrame => drop(headers.insert(RETRY_AFTER, HeaderValue::from_static("2"))),
            Self::Token | Self::WrongToken => {
                drop(headers.insert(WWW_AUTHENTICATE, HeaderValue::from_static("Bearer")));
            }
            _ => {}
        }
        response
    }
}

/// A client's text as it may stand in an answer: its visible ASCII letters, not too many.
pub(super) fn printable(text: &str) -> String {
    text.chars().filter(char::is_ascii_graphic).take(QUOTED).collect()
}
