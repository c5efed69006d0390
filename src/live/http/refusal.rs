//! Refusals: requests that are not answered, and why.

use axum::http::StatusCode;
use axum::http::header::{ALLOW, HeaderValue, WWW_AUTHENTICATE};
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
        "{header} {found} is not this machine: use localhost, the address the service listens on, or a name allowed with --allow-host"
    )]
    Foreign { header: &'static str, found: String },
    #[error("a token is needed: Authorization: Bearer TOKEN, or ?token=TOKEN")]
    Token,
    #[error("the token is not the one of this service")]
    WrongToken,
    #[error("only GET and HEAD are allowed, and POST for /control")]
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
        "no such page; there are /, /stream, /snapshot, /pixel, /histogram, /state, /events, /metrics, /healthz and /control"
    )]
    Path,
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
            Self::Path | Self::View { .. } => StatusCode::NOT_FOUND,
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
            Self::Method => drop(headers.insert(ALLOW, HeaderValue::from_static("GET, HEAD, POST"))),
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
