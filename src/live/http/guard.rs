//! Guard: decides whether a request may be answered, before it is routed.

use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::Extension;
use axum::body::to_bytes;
use axum::extract::{Query, Request, State};
use axum::http::header::{
    AUTHORIZATION, CONNECTION, CONTENT_SECURITY_POLICY, CONTENT_TYPE, COOKIE, HOST, HeaderMap, HeaderValue, LOCATION,
    ORIGIN, REFERRER_POLICY, SET_COOKIE,
};
use axum::http::{Method, StatusCode, Uri};
use axum::middleware::Next;
use axum::response::{Html, IntoResponse, Response};
use parking_lot::Mutex;
use sha2::{Digest, Sha256};
use tokio::time::timeout;

use super::connection::Connection;
use super::query::Parameters;
use super::refusal::{MAX_BODY, Refusal, printable};

/// Time before the answer to a wrong token.
const DELAY: Duration = Duration::from_millis(500);
/// Longest time before such an answer, after many of them.
const LONGEST_DELAY: Duration = Duration::from_secs(5);
/// Path that the form of the login page is sent to, and the time that it has to arrive.
const LOGIN: &str = "/login";
const FORM_TIME: Duration = Duration::from_secs(5);
/// Time that a browser keeps the cookie: 30 days.
const COOKIE_SECONDS: u32 = 30 * 86_400;
const LOGIN_PAGE: &str = include_str!("../page/login.html");
/// The login page loads nothing, and sends its form to this service alone.
const LOGIN_POLICY: &str = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; form-action 'self'; \
    base-uri 'none'; frame-ancestors 'none'";
/// Wrong tokens after which a connection ends.
const CHANCES: u32 = 3;
/// Shortest time between two lines in the log about wrong tokens.
const QUIET: Duration = Duration::from_secs(60);

/// Conditions that requests must meet.
#[derive(Debug, Default)]
pub(in crate::live) struct Guard {
    /// Names of this machine besides the loopback ones, and those that the operator allows.
    pub(in crate::live) names: Vec<String>,
    /// Token that every request must have; none when none is needed.
    pub(in crate::live) token: Option<String>,
    /// Whether anything may be changed.
    pub(in crate::live) control: bool,
    /// Wrong tokens since the last line in the log.
    pub(in crate::live) wrong: Mutex<WrongTokens>,
}

/// Wrong tokens since the last line in the log.
#[derive(Debug, Default)]
pub(in crate::live) struct WrongTokens {
    said: Option<Instant>,
    count: u64,
    /// Time of the last one, and their number without a pause.
    last: Option<Instant>,
    streak: u32,
}

/// Layer that answers only requests which name this machine and have the token, in a header, in the cookie of the login page, or in the
/// address. Whoever opens the page without it gets the login page; an address with the token is replaced by one without. The answer to a
/// wrong token is late, and the connection ends after some of them.
pub(super) async fn admit(
    State(guard): State<Arc<Guard>>,
    Extension(connection): Extension<Connection>,
    request: Request,
    next: Next,
) -> Result<Response, Response> {
    let (local, path) = (connection.local, request.uri().path());
    let page = path == "/" && (request.method() == Method::GET || request.method() == Method::HEAD);
    let login = path == LOGIN && request.method() == Method::POST;
    let outcome = match &guard.token {
        Some(token) if login => match guard.check_hosts(request.uri(), request.headers(), local.ip(), false) {
            Ok(()) => log_in(token, request, local.port()).await,
            Err(refusal) => Err(refusal),
        },
        token => match (guard.check(request.uri(), request.headers(), local), token) {
            (Ok(()), Some(token)) if page && in_query(&query(request.uri())).is_some() => {
                Ok(enter(token, local.port()))
            }
            (Ok(()), _) => {
                connection.prove();
                return Ok(next.run(request).await);
            }
            (Err(refusal), _) => Err(refusal),
        },
    };
    let refusal = match outcome {
        Ok(response) => {
            connection.prove();
            return Ok(response);
        }
        Err(refusal) => refusal,
    };
    let wrong = refusal == Refusal::WrongToken;
    if wrong {
        tokio::time::sleep(guard.complain(connection.remote)).await;
    }
    let mut response = match refusal {
        Refusal::Token | Refusal::WrongToken if page || login => login_page(&refusal),
        refusal => refusal.into_response(),
    };
    if wrong && connection.fail() >= CHANCES {
        response.headers_mut().insert(CONNECTION, HeaderValue::from_static("close"));
    }
    Err(response)
}

/// Reads the form of the login page.
async fn log_in(token: &str, request: Request, port: u16) -> Result<Response, Refusal> {
    let text = timeout(FORM_TIME, to_bytes(request.into_body(), MAX_BODY)).await;
    let text = text.map_err(|_| Refusal::Token)?.map_err(|_| Refusal::Large)?;
    let text = String::from_utf8_lossy(&text);
    let form: Uri = format!("/?{text}").parse().map_err(|_| Refusal::WrongToken)?;
    match in_query(&query(&form)) {
        Some(given) if same(given, token) => Ok(enter(token, port)),
        Some(given) if !given.is_empty() => Err(Refusal::WrongToken),
        _ => Err(Refusal::Token),
    }
}

/// Sends the browser to the page with the cookie, so that no address with the token is kept.
fn enter(token: &str, port: u16) -> Response {
    let cookie =
        format!("{}={}; Path=/; HttpOnly; SameSite=Strict; Max-Age={COOKIE_SECONDS}", name(port), proof(token));
    let headers = [(LOCATION, "/".to_owned()), (SET_COOKIE, cookie)];
    (StatusCode::SEE_OTHER, headers).into_response()
}

/// The page that asks for the token, with what was wrong.
fn login_page(refusal: &Refusal) -> Response {
    let said = if *refusal == Refusal::WrongToken { "This is not the token of this instrument." } else { "" };
    let headers = [(CONTENT_SECURITY_POLICY, LOGIN_POLICY), (REFERRER_POLICY, "same-origin")];
    (StatusCode::UNAUTHORIZED, headers, Html(LOGIN_PAGE.replace("{said}", said))).into_response()
}

/// Name of the cookie: browsers share cookies among the ports of a machine.
fn name(port: u16) -> String {
    format!("stokescope-{port}")
}

/// Value of the cookie: it follows from the token, which cannot be read from it.
fn proof(token: &str) -> String {
    Sha256::digest(format!("stokescope cookie {token}")).iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Cookie called `name`.
fn cookie<'a>(headers: &'a HeaderMap, name: &str) -> Option<&'a str> {
    let cookies = headers.get_all(COOKIE).iter().filter_map(|value| value.to_str().ok());
    let mut pairs = cookies.flat_map(|text| text.split(';')).filter_map(|pair| pair.trim().split_once('='));
    pairs.find(|(key, _)| *key == name).map(|(_, value)| value)
}

fn query(uri: &Uri) -> Parameters {
    Query::<Parameters>::try_from_uri(uri).map(|Query(query)| query).unwrap_or_default()
}

fn in_query(query: &Parameters) -> Option<&str> {
    query.get("token").map(str::trim)
}

/// Layer that lets through only changes which are allowed and proven to come from the user.
pub(super) async fn admit_change(
    State(guard): State<Arc<Guard>>,
    request: Request,
    next: Next,
) -> Result<Response, Refusal> {
    guard.check_change(request.headers())?;
    Ok(next.run(request).await)
}

impl Guard {
    /// Says that `client` had a wrong token, at most once in a while. Gives the time before the answer, which grows with the number of
    /// wrong tokens until none comes for a while.
    fn complain(&self, client: IpAddr) -> Duration {
        let mut wrong = self.wrong.lock();
        wrong.count += 1;
        wrong.streak = if wrong.last.is_some_and(|last| last.elapsed() < QUIET) { wrong.streak + 1 } else { 0 };
        wrong.last = Some(Instant::now());
        let delay = (DELAY * (1 + wrong.streak / CHANCES)).min(LONGEST_DELAY);
        if wrong.said.is_none_or(|said| said.elapsed() >= QUIET) {
            tracing::warn!("preview: {} request(s) with a wrong token, the last one from {client}", wrong.count);
            (wrong.said, wrong.count) = (Some(Instant::now()), 0);
        }
        delay
    }

    /// Checks a request that came in at the address `local`.
    fn check(&self, uri: &Uri, headers: &HeaderMap, local: SocketAddr) -> Result<(), Refusal> {
        let Some(token) = &self.token else { return self.check_hosts(uri, headers, local.ip(), false) };
        let query = query(uri);
        let given = bearer(headers).or_else(|| in_query(&query));
        let known = cookie(headers, &name(local.port())).is_some_and(|given| same(given, &proof(token)));
        let proven = given.map_or(known, |given| same(given, token));
        self.check_hosts(uri, headers, local.ip(), proven)?;
        match given {
            _ if proven => Ok(()),
            Some(given) if !given.is_empty() => Err(Refusal::WrongToken),
            _ => Err(Refusal::Token),
        }
    }

    /// Checks that a change comes from the service's own page, whose Origin was checked before, or from a program with the
    /// token in its header. A page of another site can send neither, and needs permission for the content type.
    fn check_change(&self, headers: &HeaderMap) -> Result<(), Refusal> {
        if !self.control {
            return Err(Refusal::ReadOnly);
        }
        let proven = self.token.as_ref().is_some_and(|token| bearer(headers).is_some_and(|given| same(given, token)));
        if !proven && !headers.contains_key(ORIGIN) {
            return Err(Refusal::Unproven);
        }
        let kind = headers.get(CONTENT_TYPE).and_then(|v| v.to_str().ok()).unwrap_or_default();
        let json = kind.split(';').next().is_some_and(|k| k.trim().eq_ignore_ascii_case("application/json"));
        if json { Ok(()) } else { Err(Refusal::Type) }
    }

    /// Checks that a request names this machine as Host and Origin. A page of another site then cannot read the answers, not
    /// even one whose own name resolves to this machine's address. A request that is `proven` by the token may have any Host, such as the
    /// name of a proxy: a page of another site does not know the token.
    fn check_hosts(&self, uri: &Uri, headers: &HeaderMap, local: IpAddr, proven: bool) -> Result<(), Refusal> {
        let mut hosts = headers.get_all(HOST).iter();
        let (Some(host), None) = (hosts.next(), hosts.next()) else { return Err(Refusal::NoHost) };
        let own = |header, host: &str| {
            if self.is_own(host, local) { Ok(()) } else { Err(Refusal::Foreign { header, found: printable(host) }) }
        };
        let host = host.to_str().map_err(|_| Refusal::NoHost)?;
        if !proven {
            own("Host", host)?;
            if let Some(authority) = uri.authority() {
                own("Host", authority.as_str())?;
            }
        }
        for origin in headers.get_all(ORIGIN) {
            let origin = origin.to_str().unwrap_or("?");
            let name = ["http://", "https://"].iter().find_map(|scheme| origin.strip_prefix(scheme)).unwrap_or(origin);
            let same_name =
                || without_port(name).zip(without_port(host)).is_some_and(|(a, b)| a.eq_ignore_ascii_case(b));
            if !(proven && same_name()) {
                own("Origin", name)?;
            }
        }
        Ok(())
    }

    fn is_own(&self, host: &str, local: IpAddr) -> bool {
        let Some(name) = without_port(host) else { return false };
        let address = name.strip_prefix('[').and_then(|n| n.strip_suffix(']')).unwrap_or(name).parse::<IpAddr>();
        match address {
            Ok(address) => {
                let own = |name: &String| {
                    name.parse::<IpAddr>().is_ok_and(|own| own.to_canonical() == address.to_canonical())
                };
                address.is_loopback() || address.to_canonical() == local.to_canonical() || self.names.iter().any(own)
            }
            Err(_) => name.eq_ignore_ascii_case("localhost") || self.names.iter().any(|n| n.eq_ignore_ascii_case(name)),
        }
    }
}

/// Token of the scheme Bearer, whose name may have letters of either case.
fn bearer(headers: &HeaderMap) -> Option<&str> {
    let (scheme, token) = headers.get(AUTHORIZATION)?.to_str().ok()?.trim().split_once(' ')?;
    scheme.eq_ignore_ascii_case("bearer").then_some(token.trim())
}

/// Host without `:port`; none when the text after the colon is no port.
fn without_port(host: &str) -> Option<&str> {
    match host.rsplit_once(':') {
        Some((name, port)) if !port.ends_with(']') => port.parse::<u16>().ok().map(|_| name),
        _ => Some(host),
    }
}

/// Compares in a time that does not depend on how much of the token is right.
fn same(given: &str, token: &str) -> bool {
    let difference = given.bytes().zip(token.bytes()).fold(0, |d, (a, b)| d | (a ^ b));
    given.len() == token.len() && difference == 0
}

#[cfg(test)]
mod tests {
    use axum::http::HeaderName;

    use super::*;

    type Header<'a> = (&'static str, &'a str);
    const HOSTED: Header<'_> = ("host", "localhost");

    fn headers(given: &[Header<'_>]) -> HeaderMap {
        given.iter().map(|(name, value)| (HeaderName::from_static(name), value.parse().unwrap())).collect()
    }

    fn guard(token: Option<&str>, control: bool) -> Guard {
        Guard { names: vec!["pi.local".into()], token: token.map(str::to_owned), control, ..Guard::default() }
    }

    fn check(token: Option<&str>, uri: &str, given: &[Header<'_>]) -> Result<(), Refusal> {
        guard(token, false).check(&uri.parse().unwrap(), &headers(given), "192.168.1.7:80".parse().unwrap())
    }

    #[test]
    fn only_names_of_this_machine_are_hosts_and_origins() {
        for host in ["localhost", "LOCALHOST:1", "127.0.0.1:9", "[::1]:80", "[::1]", "192.168.1.7", "pi.local:8080"] {
            assert!(check(None, "/", &[("host", host)]).is_ok(), "{host}");
            for scheme in ["http", "https"] {
                let origin = format!("{scheme}://{host}");
                assert!(check(None, "/", &[("host", host), ("origin", &origin)]).is_ok(), "{origin}");
            }
        }
        for host in
            ["evil.example", "localhost.evil.example", "192.168.1.8", "127.0.0.1.evil.example", "", "localhost:x"]
        {
            let refused = check(None, "/", &[("host", host)]);
            assert!(matches!(refused, Err(Refusal::Foreign { header: "Host", .. })), "{host}");
        }
        for origin in ["http://evil.example", "https://evil.example", "ftp://localhost", "null"] {
            let refused = check(None, "/", &[HOSTED, ("origin", origin)]);
            assert!(matches!(refused, Err(Refusal::Foreign { header: "Origin", .. })), "{origin}");
        }
        assert_eq!(check(None, "/", &[]), Err(Refusal::NoHost));
        assert_eq!(check(None, "/", &[HOSTED, HOSTED]), Err(Refusal::NoHost));
        assert!(check(None, "http://evil.example/", &[HOSTED]).is_err());
    }

    #[test]
    fn a_token_is_asked_for_everywhere_in_either_place() {
        let ask = |uri, given: &[_]| check(Some("secret-1"), uri, given);
        assert_eq!(ask("/healthz", &[HOSTED]), Err(Refusal::Token));
        assert_eq!(ask("/healthz?token=", &[HOSTED]), Err(Refusal::Token));
        assert_eq!(ask("/healthz?token=secret-2", &[HOSTED]), Err(Refusal::WrongToken));
        assert_eq!(ask("/healthz?token=secret-11", &[HOSTED]), Err(Refusal::WrongToken));
        assert_eq!(ask("/healthz?token=secret-1", &[HOSTED]), Ok(()));
        assert_eq!(ask("/healthz", &[HOSTED, ("authorization", "Bearer secret-1")]), Ok(()));
        assert_eq!(ask("/healthz", &[HOSTED, ("authorization", "Basic secret-1")]), Err(Refusal::Token));
        for header in ["bearer secret-1", "BEARER secret-1", "bEARER  secret-1"] {
            assert_eq!(ask("/healthz", &[HOSTED, ("authorization", header)]), Ok(()), "{header}");
        }
    }

    #[test]
    fn behind_a_proxy_the_token_or_the_operator_allows_its_name() {
        let proxied = ("host", "cam.example.org");
        let ask = |uri, given: &[_]| check(Some("secret-1"), uri, given);
        let bearer = ("authorization", "Bearer secret-1");
        assert_eq!(ask("/healthz", &[proxied, bearer]), Ok(()));
        assert_eq!(ask("/healthz", &[proxied, bearer, ("origin", "https://cam.example.org")]), Ok(()));
        assert!(ask("/healthz", &[proxied, bearer, ("origin", "https://evil.example")]).is_err());
        assert!(matches!(ask("/healthz", &[proxied]), Err(Refusal::Foreign { header: "Host", .. })));
        let allowed = Guard { names: vec!["cam.example.org".into()], ..Guard::default() };
        let headers = headers(&[proxied, ("origin", "https://cam.example.org")]);
        assert_eq!(allowed.check(&"/".parse().unwrap(), &headers, "10.0.0.1:80".parse().unwrap()), Ok(()));
        let routed = Guard { names: vec!["203.0.113.7".into()], ..Guard::default() };
        let ask = |host| {
            routed.check_hosts(&"/".parse().unwrap(), &self::headers(&[("host", host)]), [10, 0, 0, 1].into(), false)
        };
        assert!(ask("203.0.113.7:8443").is_ok() && ask("203.0.113.8:8443").is_err());
    }

    #[test]
    fn the_cookie_of_the_login_is_as_good_as_the_token_and_does_not_tell_it() {
        let ask = |cookie: &str| check(Some("secret-1"), "/state", &[HOSTED, ("cookie", cookie)]);
        let own = format!("a=b; stokescope-80={}; c=d", proof("secret-1"));
        assert!(!own.contains("secret-1"));
        assert_eq!(ask(&own), Ok(()));
        for other in [
            own.replace("-80", "-81"),
            format!("stokescope-80={}", proof("secret-2")),
            "stokescope-80=secret-1".to_owned(),
            "stokescope-80".to_owned(),
        ] {
            assert_eq!(ask(&other), Err(Refusal::Token), "{other}: not a guess, so no delay");
        }
    }

    #[test]
    fn answers_to_wrong_tokens_take_longer_and_longer() {
        let guard = guard(Some("secret-1"), false);
        let delays: Vec<_> = (0..100).map(|_| guard.complain("10.0.0.1".parse().unwrap())).collect();
        assert!(delays.is_sorted() && delays[0] == DELAY && delays[99] == LONGEST_DELAY);
    }

    #[test]
    fn a_change_needs_permission_and_proof_and_is_json() {
        let (origin, json) = (("origin", "http://localhost"), ("content-type", "application/json; charset=utf-8"));
        let bearer = ("authorization", "Bearer secret-1");
        let ask = |guard: Guard, given: &[_]| guard.check_change(&headers(given));
        assert_eq!(ask(guard(None, false), &[origin, json]), Err(Refusal::ReadOnly));
        let token = || guard(Some("secret-1"), true);
        assert_eq!(ask(token(), &[bearer, json]), Ok(()));
        assert_eq!(ask(token(), &[bearer]), Err(Refusal::Type));
        for junk in ["junk", "Bearer secret-2", "Basic secret-1"] {
            assert_eq!(ask(token(), &[("authorization", junk), json]), Err(Refusal::Unproven), "{junk} proves nothing");
        }
        let open = || guard(None, true);
        assert_eq!(ask(open(), &[json]), Err(Refusal::Unproven));
        assert_eq!(ask(open(), &[json, bearer]), Err(Refusal::Unproven), "there is no token to prove");
        assert_eq!(ask(open(), &[json, origin]), Ok(()));
    }

    proptest::proptest! {
        #[test]
        fn no_host_or_query_panics(host in "[ -~]{0,40}", query in "[!-~]{0,40}") {
            let _ = guard(None, false).is_own(&host, "127.0.0.1".parse().unwrap());
            if let Ok(uri) = format!("/?{query}").parse() {
                let _ = guard(Some("secret-1"), false).check(&uri, &headers(&[HOSTED]), "127.0.0.1:80".parse().unwrap());
            }
        }
    }
}
