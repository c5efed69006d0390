//! Guard: decides whether a request may be answered, before it is routed.

use std::net::IpAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::Extension;
use axum::extract::{Query, Request, State};
use axum::http::Uri;
use axum::http::header::{AUTHORIZATION, CONNECTION, CONTENT_TYPE, HOST, HeaderMap, HeaderValue, ORIGIN};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use parking_lot::Mutex;

use super::connection::Connection;
use super::query::Parameters;
use super::refusal::{Refusal, printable};

/// Time before the answer to a wrong token.
const DELAY: Duration = Duration::from_millis(500);
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
}

/// Layer that answers only requests which name this machine and have the token. The answer to a wrong token is late, and the connection
/// ends after some of them.
pub(super) async fn admit(
    State(guard): State<Arc<Guard>>,
    Extension(connection): Extension<Connection>,
    request: Request,
    next: Next,
) -> Result<Response, Response> {
    let refusal = match guard.check(request.uri(), request.headers(), connection.local.ip()) {
        Ok(()) => {
            connection.prove();
            return Ok(next.run(request).await);
        }
        Err(refusal) => refusal,
    };
    let wrong = refusal == Refusal::WrongToken;
    if wrong {
        guard.complain(connection.remote);
        tokio::time::sleep(DELAY).await;
    }
    let mut response = refusal.into_response();
    if wrong && connection.fail() >= CHANCES {
        response.headers_mut().insert(CONNECTION, HeaderValue::from_static("close"));
    }
    Err(response)
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
    /// Says that `client` had a wrong token, at most once in a while.
    fn complain(&self, client: IpAddr) {
        let mut wrong = self.wrong.lock();
        wrong.count += 1;
        if wrong.said.is_none_or(|said| said.elapsed() >= QUIET) {
            tracing::warn!("preview: {} request(s) with a wrong token, the last one from {client}", wrong.count);
            *wrong = WrongTokens { said: Some(Instant::now()), count: 0 };
        }
    }

    /// Checks a request that came in at the address `local`.
    fn check(&self, uri: &Uri, headers: &HeaderMap, local: IpAddr) -> Result<(), Refusal> {
        let Some(token) = &self.token else { return self.check_hosts(uri, headers, local, false) };
        let query = Query::<Parameters>::try_from_uri(uri).unwrap_or_default();
        let given = bearer(headers).or_else(|| query.get("token").map(str::trim));
        let proven = given.is_some_and(|given| same(given, token));
        self.check_hosts(uri, headers, local, proven)?;
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
            Ok(address) => address.is_loopback() || address.to_canonical() == local.to_canonical(),
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
        guard(token, false).check(&uri.parse().unwrap(), &headers(given), "192.168.1.7".parse().unwrap())
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
        assert_eq!(allowed.check(&"/".parse().unwrap(), &headers, "10.0.0.1".parse().unwrap()), Ok(()));
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
                let _ = guard(Some("secret-1"), false).check(&uri, &headers(&[HOSTED]), "127.0.0.1".parse().unwrap());
            }
        }
    }
}
