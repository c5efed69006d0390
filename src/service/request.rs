//! What a client asks for, and whether it may.

use std::net::{IpAddr, SocketAddr};

use hyper::header::{AUTHORIZATION, CONTENT_TYPE, HOST, HeaderMap, ORIGIN};
use hyper::{Method, Uri};

use super::broadcast::Format;

/// Why a request is refused.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub(super) enum Refusal {
    #[error("this is not an HTTP/1.1 request with one Host")]
    NoHost,
    #[error("{what} {found} is not this machine: use localhost, or the address the service listens on")]
    Foreign { what: &'static str, found: String },
    #[error("a token is needed: Authorization: Bearer TOKEN, or ?token=TOKEN")]
    Token,
    #[error("only GET and HEAD, and POST for /control")]
    Method,
    #[error("nothing can be changed: start the service with --control, or with --token")]
    ReadOnly,
    #[error("a change comes with an Origin of this machine, or a token in the Authorization header")]
    Unproven,
    #[error("a change is a JSON object: Content-Type: application/json")]
    Type,
    #[error("a change is at most {MAX_BODY} bytes")]
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
    /// The HTTP status.
    pub(super) fn status(&self) -> u16 {
        match self {
            Self::NoHost | Self::Query { .. } | Self::Change(_) => 400,
            Self::Token => 401,
            Self::Foreign { .. } | Self::ReadOnly | Self::Unproven => 403,
            Self::Path | Self::View { .. } => 404,
            Self::Method => 405,
            Self::Large => 413,
            Self::Type => 415,
        }
    }
}

/// Bytes of the body of a change.
pub(super) const MAX_BODY: usize = 4096;

/// A request that may be answered.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Wanted {
    Page,
    Stream {
        view: String,
    },
    Snapshot {
        view: String,
        format: Format,
    },
    Pixel {
        x: usize,
        y: usize,
    },
    /// Of a region: left, top, width and height; none is all of it.
    Histogram {
        region: Option<[usize; 4]>,
    },
    /// The body says what is to change.
    Control,
    Events,
    State,
    Metrics,
    Health,
}

/// Who may ask.
#[derive(Clone, Debug)]
pub(super) struct Guard {
    /// Names of this machine besides the loopback ones.
    pub(super) names: Vec<String>,
    pub(super) token: Option<String>,
    /// Whether anything may be changed.
    pub(super) control: bool,
}

impl Guard {
    /// Checks a request that came in at `local`.
    pub(super) fn check(
        &self,
        method: &Method,
        uri: &Uri,
        headers: &HeaderMap,
        local: SocketAddr,
    ) -> Result<Wanted, Refusal> {
        self.check_hosts(uri, headers, local.ip())?;
        let query = uri.query().unwrap_or_default();
        if let Some(token) = &self.token {
            let bearer = headers.get(AUTHORIZATION).and_then(|v| v.to_str().ok()?.strip_prefix("Bearer "));
            let given = bearer.or_else(|| value(query, "token")).unwrap_or_default();
            if !same(given.trim(), token) {
                return Err(Refusal::Token);
            }
        }
        if uri.path() == "/control" && method == Method::POST {
            return self.check_change(headers);
        }
        if method != Method::GET && method != Method::HEAD {
            return Err(Refusal::Method);
        }
        route(uri.path(), query)
    }

    /// A change must come from this service's own page, whose Origin was checked before, or from a program with the token: a
    /// page of another site can send neither, and the content type is one it must ask permission for.
    fn check_change(&self, headers: &HeaderMap) -> Result<Wanted, Refusal> {
        if !self.control {
            return Err(Refusal::ReadOnly);
        }
        let bearer = self.token.is_some() && headers.contains_key(AUTHORIZATION);
        if !bearer && !headers.contains_key(ORIGIN) {
            return Err(Refusal::Unproven);
        }
        let kind = headers.get(CONTENT_TYPE).and_then(|v| v.to_str().ok()).unwrap_or_default();
        let json = kind.split(';').next().is_some_and(|k| k.trim().eq_ignore_ascii_case("application/json"));
        if json { Ok(Wanted::Control) } else { Err(Refusal::Type) }
    }

    /// A page of another site must not be able to read this one's answers, not even by giving its own name our address.
    fn check_hosts(&self, uri: &Uri, headers: &HeaderMap, local: IpAddr) -> Result<(), Refusal> {
        let mut hosts = headers.get_all(HOST).iter();
        let (Some(host), None) = (hosts.next(), hosts.next()) else { return Err(Refusal::NoHost) };
        let own = |what, host: &str| {
            if self.is_own(host, local) { Ok(()) } else { Err(Refusal::Foreign { what, found: printable(host) }) }
        };
        own("Host", host.to_str().map_err(|_| Refusal::NoHost)?)?;
        if let Some(authority) = uri.authority() {
            own("Host", authority.as_str())?;
        }
        for origin in headers.get_all(ORIGIN) {
            let origin = origin.to_str().unwrap_or("?");
            own("Origin", origin.strip_prefix("http://").unwrap_or(origin))?;
        }
        Ok(())
    }

    fn is_own(&self, host: &str, local: IpAddr) -> bool {
        let Some(name) = without_port(host) else { return false };
        let address = name.strip_prefix('[').and_then(|n| n.strip_suffix(']')).unwrap_or(name).parse::<IpAddr>();
        match address {
            Ok(address) => address.is_loopback() || address.to_canonical() == local.to_canonical(),
            Err(_) => name.eq_ignore_ascii_case("localhost") || self.names.iter().any(|n| n.eq_ignore_ascii_case(name)),
        }
    }
}

/// The host without `:port`; none when what follows the colon is no port.
fn without_port(host: &str) -> Option<&str> {
    match host.rsplit_once(':') {
        Some((name, port)) if !port.ends_with(']') => port.parse::<u16>().ok().map(|_| name),
        _ => Some(host),
    }
}

/// Compares in a time that does not tell how much of it is right.
fn same(given: &str, token: &str) -> bool {
    let difference = given.bytes().zip(token.bytes()).fold(0, |d, (a, b)| d | (a ^ b));
    given.len() == token.len() && difference == 0
}

fn printable(text: &str) -> String {
    text.chars().filter(char::is_ascii_graphic).take(80).collect()
}

/// The value of `key` in a query string. Names, numbers and tokens need no percent signs.
fn value<'a>(query: &'a str, key: &str) -> Option<&'a str> {
    query.split('&').find_map(|pair| pair.strip_prefix(key)?.strip_prefix('='))
}

fn route(path: &str, query: &str) -> Result<Wanted, Refusal> {
    let view = || value(query, "view").unwrap_or("aolp").to_owned();
    let number = |key: &'static str| {
        let found = value(query, key).unwrap_or_default();
        found.parse().map_err(|_| Refusal::Query {
            key,
            found: printable(found),
            allowed: "a pixel, from 0".to_owned(),
        })
    };
    Ok(match path {
        "/" => Wanted::Page,
        "/stream" => Wanted::Stream { view: view() },
        "/snapshot" => {
            let format = match value(query, "format") {
                None | Some("jpeg" | "jpg") => Format::Jpeg,
                Some("png") => Format::Png,
                Some(other) => {
                    let (found, allowed) = (printable(other), "jpeg or png".to_owned());
                    return Err(Refusal::Query { key: "format", found, allowed });
                }
            };
            Wanted::Snapshot { view: view(), format }
        }
        "/pixel" => Wanted::Pixel { x: number("x")?, y: number("y")? },
        "/histogram" if ["x", "y", "w", "h"].iter().all(|key| value(query, key).is_none()) => {
            Wanted::Histogram { region: None }
        }
        "/histogram" => Wanted::Histogram { region: Some([number("x")?, number("y")?, number("w")?, number("h")?]) },
        "/control" => return Err(Refusal::Method),
        "/events" => Wanted::Events,
        "/state" => Wanted::State,
        "/metrics" => Wanted::Metrics,
        "/healthz" => Wanted::Health,
        _ => return Err(Refusal::Path),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check(
        token: Option<&str>,
        method: &str,
        uri: &str,
        headers: &[(&'static str, &str)],
    ) -> Result<Wanted, Refusal> {
        let guard = Guard { names: vec!["pi.local".into()], token: token.map(str::to_owned), control: token.is_some() };
        let mut map = HeaderMap::new();
        for (name, value) in headers {
            map.append(*name, value.parse().unwrap());
        }
        let method = Method::from_bytes(method.as_bytes()).unwrap();
        guard.check(&method, &uri.parse().unwrap(), &map, "192.168.1.7:8080".parse().unwrap())
    }

    fn get(uri: &str) -> Result<Wanted, Refusal> {
        check(None, "GET", uri, &[("host", "localhost:8080")])
    }

    #[test]
    fn paths_and_queries_are_read() {
        assert_eq!(get("/"), Ok(Wanted::Page));
        assert_eq!(get("/stream?view=i45&token=x"), Ok(Wanted::Stream { view: "i45".into() }));
        assert_eq!(get("/snapshot?format=png"), Ok(Wanted::Snapshot { view: "aolp".into(), format: Format::Png }));
        assert_eq!(get("/pixel?x=3&y=4"), Ok(Wanted::Pixel { x: 3, y: 4 }));
        for uri in ["/pixel?x=-1&y=0", "/pixel", "/pixel?x=1e9&y=0", "/snapshot?format=gif"] {
            assert_eq!(get(uri).unwrap_err().status(), 400, "{uri}");
        }
        for uri in ["/../etc/passwd", "/%2e%2e/etc/passwd", "//", "/page.html", "/State", "/stream/"] {
            assert_eq!(get(uri), Err(Refusal::Path), "{uri}");
        }
        assert_eq!(check(None, "POST", "/", &[("host", "localhost")]).unwrap_err().status(), 405);
    }

    #[test]
    fn only_names_of_this_machine_are_hosts_and_origins() {
        for host in ["localhost", "LOCALHOST:1", "127.0.0.1:9", "[::1]:80", "[::1]", "192.168.1.7", "pi.local:8080"] {
            assert!(check(None, "GET", "/", &[("host", host)]).is_ok(), "{host}");
            let origin = format!("http://{host}");
            assert!(check(None, "GET", "/", &[("host", host), ("origin", &origin)]).is_ok(), "{host}");
        }
        for host in
            ["evil.example", "localhost.evil.example", "192.168.1.8", "127.0.0.1.evil.example", "", "localhost:x"]
        {
            let e = check(None, "GET", "/", &[("host", host)]).unwrap_err();
            assert_eq!(e.status(), 403, "{host}");
        }
        for origin in ["http://evil.example", "https://localhost", "null"] {
            let e = check(None, "GET", "/", &[("host", "localhost"), ("origin", origin)]);
            assert!(matches!(e, Err(Refusal::Foreign { what: "Origin", .. })), "{origin}");
        }
        assert_eq!(check(None, "GET", "/", &[]), Err(Refusal::NoHost));
        assert_eq!(check(None, "GET", "/", &[("host", "localhost"), ("host", "localhost")]), Err(Refusal::NoHost));
        assert!(check(None, "GET", "http://evil.example/", &[("host", "localhost")]).is_err());
    }

    #[test]
    fn a_token_is_asked_for_everywhere_in_either_place() {
        let host = ("host", "localhost");
        let ask = |uri, headers: &[_]| check(Some("secret-1"), "GET", uri, headers);
        assert_eq!(ask("/healthz", &[host]), Err(Refusal::Token));
        assert_eq!(ask("/healthz?token=secret-2", &[host]), Err(Refusal::Token));
        assert_eq!(ask("/healthz?token=secret-11", &[host]), Err(Refusal::Token));
        assert_eq!(ask("/healthz?token=secret-1", &[host]), Ok(Wanted::Health));
        assert_eq!(ask("/healthz", &[host, ("authorization", "Bearer secret-1")]), Ok(Wanted::Health));
        assert_eq!(ask("/healthz", &[host, ("authorization", "Basic secret-1")]), Err(Refusal::Token));
    }

    #[test]
    fn a_change_needs_leave_and_proof_and_is_json() {
        let host = ("host", "localhost");
        let (origin, json) = (("origin", "http://localhost"), ("content-type", "application/json; charset=utf-8"));
        let bearer = ("authorization", "Bearer secret-1");
        let post = |token, headers: &[_]| check(token, "POST", "/control", headers);
        assert_eq!(post(None, &[host, origin, json]), Err(Refusal::ReadOnly));
        assert_eq!(post(Some("secret-1"), &[host, origin, json]), Err(Refusal::Token));
        assert_eq!(post(Some("secret-1"), &[host, bearer, json]), Ok(Wanted::Control));
        assert_eq!(post(Some("secret-1"), &[host, bearer]), Err(Refusal::Type));
        assert_eq!(
            post(Some("secret-1"), &[host, bearer, json, ("origin", "http://evil.example")]).unwrap_err().status(),
            403
        );
        let open = Guard { names: Vec::new(), token: None, control: true };
        let map = |headers: &[(&'static str, &str)]| {
            headers.iter().map(|(n, v)| (hyper::header::HeaderName::from_static(n), v.parse().unwrap())).collect()
        };
        let ask = |headers: &[(&'static str, &str)]| {
            open.check(&Method::POST, &"/control".parse().unwrap(), &map(headers), "127.0.0.1:1".parse().unwrap())
        };
        assert_eq!(ask(&[host, json]), Err(Refusal::Unproven));
        assert_eq!(ask(&[host, json, bearer]), Err(Refusal::Unproven), "there is no token to prove");
        assert_eq!(ask(&[host, json, origin]), Ok(Wanted::Control));
        assert_eq!(check(None, "GET", "/control", &[host]), Err(Refusal::Method));
    }

    #[test]
    fn a_region_is_given_as_a_whole_or_not_at_all() {
        assert_eq!(get("/histogram"), Ok(Wanted::Histogram { region: None }));
        assert_eq!(get("/histogram?x=1&y=2&w=3&h=4"), Ok(Wanted::Histogram { region: Some([1, 2, 3, 4]) }));
        assert_eq!(get("/histogram?x=1&y=2").unwrap_err().status(), 400);
    }

    proptest::proptest! {
        #[test]
        fn no_text_panics(path in "/[ -~]{0,40}", query in "[ -~]{0,40}", host in "[ -~]{0,40}") {
            let _ = route(&path, &query);
            let guard = Guard { names: Vec::new(), token: None, control: false };
            let _ = guard.is_own(&host, "127.0.0.1".parse().unwrap());
        }
    }
}
