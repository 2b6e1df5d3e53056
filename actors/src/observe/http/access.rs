//! Access to a page: the token, the host name of a request, and the security headers of every
//! answer.

use std::net::{IpAddr, SocketAddr};

use axum::http::header::{self, AUTHORIZATION, COOKIE, HOST};
use axum::http::{HeaderMap, HeaderName, HeaderValue, Uri};
use base64::prelude::{BASE64_URL_SAFE_NO_PAD, Engine};
use ecod::model::names::NodeName;
use ring::hmac;

use crate::platform::secret::Secret;

/// Decides which requests are answered.
#[derive(Debug)]
pub struct PageAccess {
    loopback: bool,
    token: Option<PageToken>,
}

#[derive(Debug)]
struct PageToken {
    /// Signatures are compared in constant time, so that timing does not reveal the token or its
    /// length.
    key: hmac::Key,
    cookie_name: String,
}

/// The decision about a request.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum AccessDecision {
    /// The request is answered.
    Allowed,
    /// The address holds the token: the answer sets a cookie and removes the token from the
    /// address.
    SignIn,
    /// The token is missing or wrong.
    Unauthorized,
    /// The host is not this machine. A foreign page sends this after DNS rebinding.
    ForeignHost,
}

/// The message whose signature with the token is the cookie.
const COOKIE_MESSAGE: &[u8] = b"ecod dashboard cookie";

/// Headers of every answer.
pub(crate) const HEADERS: [(HeaderName, HeaderValue); 5] = [
    (
        header::CONTENT_SECURITY_POLICY,
        HeaderValue::from_static(
            "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; \
             base-uri 'none'; form-action 'self'; frame-ancestors 'none'",
        ),
    ),
    (
        header::X_CONTENT_TYPE_OPTIONS,
        HeaderValue::from_static("nosniff"),
    ),
    (
        header::REFERRER_POLICY,
        HeaderValue::from_static("no-referrer"),
    ),
    (
        HeaderName::from_static("cross-origin-resource-policy"),
        HeaderValue::from_static("same-origin"),
    ),
    (header::CACHE_CONTROL, HeaderValue::from_static("no-store")),
];

impl PageAccess {
    /// Access to the page of a node that listens on `address`.
    pub fn new(token: Option<&Secret>, address: SocketAddr, node: &NodeName) -> Self {
        // Cookies are shared between the ports of a host, but not between names.
        let token = token.map(|token| PageToken {
            key: key(token.reveal().as_bytes()),
            cookie_name: format!("ecod-{node}"),
        });
        Self {
            loopback: address.ip().is_loopback(),
            token,
        }
    }

    /// The decision about a request.
    pub(crate) fn decide(&self, uri: &Uri, headers: &HeaderMap) -> AccessDecision {
        if self.loopback && !headers.get(HOST).is_some_and(is_this_machine) {
            return AccessDecision::ForeignHost;
        }
        let Some(token) = &self.token else {
            return AccessDecision::Allowed;
        };
        if token.is_in_headers(headers) {
            return AccessDecision::Allowed;
        }
        let as_typed = uri.query().and_then(|query| {
            query
                .split('&')
                .find_map(|pair| pair.strip_prefix("token="))
        });
        // A form escapes characters that people may type in an address as they are.
        let of_form = uri.query().and_then(|query| {
            form_urlencoded::parse(query.as_bytes())
                .find_map(|(key, value)| (key == "token").then_some(value))
        });
        if as_typed.is_some_and(|given| token.is(given.as_bytes()))
            || of_form.is_some_and(|given| token.is(given.as_bytes()))
        {
            AccessDecision::SignIn
        } else {
            AccessDecision::Unauthorized
        }
    }

    /// The cookie of a signed-in browser, which it also sends after following a link from another
    /// site.
    pub(crate) fn cookie(&self) -> Option<HeaderValue> {
        let PageToken { key, cookie_name } = self.token.as_ref()?;
        let cookie = BASE64_URL_SAFE_NO_PAD.encode(hmac::sign(key, COOKIE_MESSAGE));
        HeaderValue::from_str(&format!(
            "{cookie_name}={cookie}; Path=/; HttpOnly; SameSite=Lax"
        ))
        .ok()
    }
}

impl PageToken {
    fn is_in_headers(&self, headers: &HeaderMap) -> bool {
        let bearer = headers
            .get(AUTHORIZATION)
            .and_then(|value| value.as_bytes().strip_prefix(b"Bearer "));
        if bearer.is_some_and(|given| self.is(given)) {
            return true;
        }
        let cookies = headers
            .get_all(COOKIE)
            .into_iter()
            .filter_map(|value| value.to_str().ok());
        let mut pairs = cookies
            .flat_map(|line| line.split(';'))
            .filter_map(|pair| pair.trim().split_once('='));
        pairs.any(|(name, value)| name == self.cookie_name && self.is_signature(value))
    }

    fn is(&self, given: &[u8]) -> bool {
        hmac::verify(
            &self.key,
            COOKIE_MESSAGE,
            hmac::sign(&key(given), COOKIE_MESSAGE).as_ref(),
        )
        .is_ok()
    }

    fn is_signature(&self, cookie: &str) -> bool {
        let signature = BASE64_URL_SAFE_NO_PAD.decode(cookie);
        signature.is_ok_and(|signature| hmac::verify(&self.key, COOKIE_MESSAGE, &signature).is_ok())
    }
}

fn key(token: &[u8]) -> hmac::Key {
    hmac::Key::new(hmac::HMAC_SHA256, token)
}

/// True if a `Host` header names loopback. Any port is allowed, since a tunnel may end on another.
fn is_this_machine(host: &HeaderValue) -> bool {
    let Ok(host) = host.to_str() else {
        return false;
    };
    let without_port = match host.rsplit_once(':') {
        Some((name, port))
            if !port.is_empty() && port.bytes().all(|byte| byte.is_ascii_digit()) =>
        {
            name
        }
        _ => host,
    };
    let name = without_port
        .strip_prefix('[')
        .and_then(|name| name.strip_suffix(']'))
        .unwrap_or(without_port);
    name.eq_ignore_ascii_case("localhost")
        || name.parse::<IpAddr>().is_ok_and(|ip| ip.is_loopback())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn access(listen: &str, token: Option<&str>) -> PageAccess {
        let token = token.map(Secret::new);
        PageAccess::new(
            token.as_ref(),
            listen.parse().unwrap(),
            &NodeName::from_static("edge"),
        )
    }

    fn decide(access: &PageAccess, uri: &str, headers: &[(HeaderName, &str)]) -> AccessDecision {
        let headers = headers
            .iter()
            .map(|(name, value)| (name.clone(), HeaderValue::from_str(value).unwrap()));
        access.decide(&uri.parse().unwrap(), &headers.collect())
    }

    #[test]
    fn loopback_accepts_local_names_only() {
        let access = access("127.0.0.1:8080", None);
        for host in [
            "localhost:8080",
            "LOCALHOST",
            "127.0.0.1:9",
            "127.1.2.3",
            "[::1]:8080",
            "[::1]",
        ] {
            assert_eq!(
                decide(&access, "/", &[(HOST, host)]),
                AccessDecision::Allowed,
                "{host}"
            );
        }
        for host in [
            "evil.example:8080",
            "127.0.0.1.evil.example",
            "localhost.evil.example",
            "10.0.0.2",
            "",
            "::1:",
        ] {
            assert_eq!(
                decide(&access, "/", &[(HOST, host)]),
                AccessDecision::ForeignHost,
                "{host}"
            );
        }
        assert_eq!(decide(&access, "/", &[]), AccessDecision::ForeignHost);
    }

    #[test]
    fn token_by_header_cookie_or_address() {
        let access = access("0.0.0.0:8080", Some("correct-horse"));
        let with =
            |uri: &str, header: Option<(HeaderName, &str)>| decide(&access, uri, header.as_slice());
        assert_eq!(with("/", None), AccessDecision::Unauthorized);
        assert_eq!(with("/?token=correct-horse", None), AccessDecision::SignIn);
        assert_eq!(
            with("/?a=b&token=correct-horse", None),
            AccessDecision::SignIn
        );
        assert_eq!(
            with("/?token=correct-hors", None),
            AccessDecision::Unauthorized
        );
        assert_eq!(
            with("/", Some((AUTHORIZATION, "Bearer correct-horse"))),
            AccessDecision::Allowed
        );
        for wrong in [
            "Bearer wrong",
            "Bearer ",
            "correct-horse",
            "Basic correct-horse",
        ] {
            assert_eq!(
                with("/", Some((AUTHORIZATION, wrong))),
                AccessDecision::Unauthorized,
                "{wrong}"
            );
        }
        let cookie = access.cookie().unwrap();
        let cookie = cookie.to_str().unwrap();
        assert!(
            cookie.contains("HttpOnly") && !cookie.contains("correct-horse"),
            "{cookie}"
        );
        let pair = cookie.split(';').next().unwrap();
        assert_eq!(
            with("/", Some((COOKIE, &format!("a=b; {pair}")))),
            AccessDecision::Allowed
        );
        assert_eq!(
            with("/", Some((COOKIE, &pair[..pair.len() - 1]))),
            AccessDecision::Unauthorized
        );
    }
}
