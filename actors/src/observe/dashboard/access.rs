//! Who may look: the token, the host name that a browser used, and the headers that keep a page to itself.

use std::net::{IpAddr, SocketAddr};

use axum::http::header::{self, AUTHORIZATION, COOKIE, HOST};
use axum::http::{HeaderMap, HeaderName, HeaderValue, Uri};
use ecod::names::NodeName;
use ring::{digest, hmac};

use crate::transport::mqtt::Secret;

/// Judges requests.
#[derive(Debug)]
pub(crate) struct AccessPolicy {
    loopback: bool,
    token: Option<Token>,
}

#[derive(Debug)]
struct Token {
    /// The digest is compared, so that the time taken says nothing of the token, not even its length.
    key: hmac::Key,
    cookie_name: String,
    cookie: String,
}

/// How a request stands.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum AccessDecision {
    /// It may see everything.
    Allowed,
    /// It brought the token in its address: it gets a cookie, and the token leaves the address.
    SignIn,
    /// It has no token, or a wrong one.
    Unauthorized,
    /// It names a host that is not this machine, as a page does that made a browser look up its own name again.
    ForeignHost,
}

/// What is signed to make a cookie of a token.
const COOKIE_MESSAGE: &[u8] = b"ecod dashboard cookie";

/// Sent with every answer.
pub(crate) const HEADERS: [(HeaderName, HeaderValue); 5] = [
    (
        header::CONTENT_SECURITY_POLICY,
        HeaderValue::from_static(
            "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; \
             base-uri 'none'; form-action 'self'; frame-ancestors 'none'",
        ),
    ),
    (header::X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff")),
    (header::REFERRER_POLICY, HeaderValue::from_static("no-referrer")),
    (HeaderName::from_static("cross-origin-resource-policy"), HeaderValue::from_static("same-origin")),
    (header::CACHE_CONTROL, HeaderValue::from_static("no-store")),
];

impl AccessPolicy {
    /// AccessPolicy to the page of a node that listens on `address`.
    pub(crate) fn new(token: Option<&Secret>, address: SocketAddr, node: &NodeName) -> Self {
        let token = token.map(|token| {
            let key = hmac::Key::new(hmac::HMAC_SHA256, token.reveal().as_bytes());
            let cookie = hex(hmac::sign(&key, COOKIE_MESSAGE).as_ref());
            // Cookies are shared between the ports of a host, but not between names.
            Token { key, cookie_name: format!("ecod-{node}"), cookie }
        });
        Self { loopback: address.ip().is_loopback(), token }
    }

    /// Whether the request may be answered.
    pub(crate) fn judge(&self, uri: &Uri, headers: &HeaderMap) -> AccessDecision {
        if self.loopback && !headers.get(HOST).is_some_and(is_this_machine) {
            return AccessDecision::ForeignHost;
        }
        let Some(token) = &self.token else { return AccessDecision::Allowed };
        if token.is_in_headers(headers) {
            return AccessDecision::Allowed;
        }
        match token_in(uri) {
            Some(given) if token.is(given.as_bytes()) => AccessDecision::SignIn,
            _ => AccessDecision::Unauthorized,
        }
    }

    /// The cookie of whoever knows the token; a browser also shows it when a link of elsewhere leads here.
    pub(crate) fn cookie(&self) -> Option<HeaderValue> {
        let Token { cookie_name, cookie, .. } = self.token.as_ref()?;
        HeaderValue::from_str(&format!("{cookie_name}={cookie}; Path=/; HttpOnly; SameSite=Lax")).ok()
    }
}

impl Token {
    fn is_in_headers(&self, headers: &HeaderMap) -> bool {
        let bearer = headers.get(AUTHORIZATION).and_then(|value| value.as_bytes().strip_prefix(b"Bearer "));
        if bearer.is_some_and(|given| self.is(given)) {
            return true;
        }
        let cookies = headers.get_all(COOKIE).into_iter().filter_map(|value| value.to_str().ok());
        let mut named = cookies.flat_map(|line| line.split(';')).filter_map(|pair| pair.trim().split_once('='));
        named.any(|(name, value)| name == self.cookie_name && equal(value.as_bytes(), self.cookie.as_bytes()))
    }

    fn is(&self, given: &[u8]) -> bool {
        let key = hmac::Key::new(hmac::HMAC_SHA256, given);
        hmac::verify(&self.key, COOKIE_MESSAGE, hmac::sign(&key, COOKIE_MESSAGE).as_ref()).is_ok()
    }
}

/// Whether both are the same, in a time that does not depend on where they differ.
fn equal(a: &[u8], b: &[u8]) -> bool {
    let key = hmac::Key::new(hmac::HMAC_SHA256, digest::digest(&digest::SHA256, b).as_ref());
    hmac::verify(&key, a, hmac::sign(&key, b).as_ref()).is_ok()
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// The token in an address; it is made of characters that stand for themselves there.
fn token_in(uri: &Uri) -> Option<&str> {
    uri.query()?.split('&').find_map(|pair| pair.strip_prefix("token="))
}

/// Whether a `Host` header names loopback, on whatever port: a tunnel may end on another.
fn is_this_machine(host: &HeaderValue) -> bool {
    let Ok(host) = host.to_str() else { return false };
    let name = match host.rsplit_once(':') {
        Some((name, port)) if !port.is_empty() && port.bytes().all(|byte| byte.is_ascii_digit()) => name,
        _ => host,
    };
    let name = name.strip_prefix('[').and_then(|name| name.strip_suffix(']')).unwrap_or(name);
    name.eq_ignore_ascii_case("localhost") || name.parse::<IpAddr>().is_ok_and(|ip| ip.is_loopback())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn access(listen: &str, token: Option<&str>) -> AccessPolicy {
        let token = token.map(Secret::new);
        AccessPolicy::new(token.as_ref(), listen.parse().unwrap(), &NodeName::from_static("edge"))
    }

    fn judge(access: &AccessPolicy, uri: &str, headers: &[(HeaderName, &str)]) -> AccessDecision {
        let headers = headers.iter().map(|(name, value)| (name.clone(), HeaderValue::from_str(value).unwrap()));
        access.judge(&uri.parse().unwrap(), &headers.collect())
    }

    #[test]
    fn on_loopback_only_names_of_this_machine_are_answered() {
        let access = access("127.0.0.1:8080", None);
        for host in ["localhost:8080", "LOCALHOST", "127.0.0.1:9", "127.1.2.3", "[::1]:8080", "[::1]"] {
            assert_eq!(judge(&access, "/", &[(HOST, host)]), AccessDecision::Allowed, "{host}");
        }
        for host in ["evil.example:8080", "127.0.0.1.evil.example", "localhost.evil.example", "10.0.0.2", "", "::1:"] {
            assert_eq!(judge(&access, "/", &[(HOST, host)]), AccessDecision::ForeignHost, "{host}");
        }
        assert_eq!(judge(&access, "/", &[]), AccessDecision::ForeignHost);
    }

    #[test]
    fn a_token_comes_by_header_cookie_or_once_by_address() {
        let access = access("0.0.0.0:8080", Some("correct-horse"));
        let with = |uri: &str, header: Option<(HeaderName, &str)>| judge(&access, uri, header.as_slice());
        assert_eq!(with("/", None), AccessDecision::Unauthorized);
        assert_eq!(with("/?token=correct-horse", None), AccessDecision::SignIn);
        assert_eq!(with("/?a=b&token=correct-horse", None), AccessDecision::SignIn);
        assert_eq!(with("/?token=correct-hors", None), AccessDecision::Unauthorized);
        assert_eq!(with("/", Some((AUTHORIZATION, "Bearer correct-horse"))), AccessDecision::Allowed);
        for wrong in ["Bearer wrong", "Bearer ", "correct-horse", "Basic correct-horse"] {
            assert_eq!(with("/", Some((AUTHORIZATION, wrong))), AccessDecision::Unauthorized, "{wrong}");
        }
        let cookie = access.cookie().unwrap();
        let cookie = cookie.to_str().unwrap();
        assert!(cookie.contains("HttpOnly") && !cookie.contains("correct-horse"), "{cookie}");
        let pair = cookie.split(';').next().unwrap();
        assert_eq!(with("/", Some((COOKIE, &format!("a=b; {pair}")))), AccessDecision::Allowed);
        assert_eq!(with("/", Some((COOKIE, &pair[..pair.len() - 1]))), AccessDecision::Unauthorized);
    }
}
