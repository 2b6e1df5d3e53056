//! Access and rate of requests, and the headers of answers.

use std::fmt;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use axum::Router;
use axum::extract::{Request, State};
use axum::http::{HeaderValue, StatusCode, Uri, header};
use axum::middleware::{self, Next};
use axum::response::{Html, IntoResponse, Response};

use super::access::{AccessDecision, HEADERS, PageAccess};
use super::connection_limit::ConnectionSlot;
use crate::platform::clock;
use crate::platform::throttle::TokenBucket;

/// Decides about each request: by its access, and by the rate of all requests.
pub struct PageGuard {
    access: PageAccess,
    answers: Mutex<TokenBucket>,
    /// Kept separately, so that requests without access don't use up the rate of requests with
    /// access.
    refusals: Mutex<TokenBucket>,
    count: Box<dyn Fn(HttpRefusal) + Send + Sync>,
}

/// A request or connection that was not served.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum HttpRefusal {
    /// It has no access, or there are too many connections.
    Refused,
    /// There are too many requests.
    Throttled,
}

/// Burst of requests, enough for several tabs that open at once.
const BURST: u32 = 512;

/// Time between further requests after a burst.
const REQUEST_INTERVAL: Duration = Duration::from_millis(5);

impl PageGuard {
    /// A guard that calls `count` for each refusal.
    pub fn new(access: PageAccess, count: impl Fn(HttpRefusal) + Send + Sync + 'static) -> Self {
        let throttle = || Mutex::new(TokenBucket::new(BURST, REQUEST_INTERVAL, clock::now()));
        Self {
            access,
            answers: throttle(),
            refusals: throttle(),
            count: Box::new(count),
        }
    }

    /// The routes behind the guard.
    pub fn protect<S: Clone + Send + Sync + 'static>(self, routes: Router<S>) -> Router<S> {
        routes.layer(middleware::from_fn_with_state(Arc::new(self), guard))
    }
}

impl fmt::Debug for PageGuard {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("PageGuard")
            .field("access", &self.access)
            .finish_non_exhaustive()
    }
}

/// The routes, with security headers on every answer.
pub fn with_headers<S: Clone + Send + Sync + 'static>(routes: Router<S>) -> Router<S> {
    routes.layer(middleware::map_response(add_headers))
}

async fn add_headers(mut answer: Response) -> Response {
    for (name, value) in HEADERS {
        answer.headers_mut().entry(name).or_insert(value);
    }
    answer
}

async fn guard(State(guard): State<Arc<PageGuard>>, request: Request, next: Next) -> Response {
    let decision = guard.access.decide(request.uri(), request.headers());
    let is_allowed = matches!(decision, AccessDecision::Allowed | AccessDecision::SignIn);
    let throttle = if is_allowed {
        &guard.answers
    } else {
        &guard.refusals
    };
    if !throttle
        .lock()
        .unwrap_or_else(PoisonError::into_inner)
        .allow(clock::now())
    {
        (guard.count)(HttpRefusal::Throttled);
        return (
            StatusCode::TOO_MANY_REQUESTS,
            [(header::RETRY_AFTER, "1")],
            "too many requests\n",
        )
            .into_response();
    }
    if !is_allowed {
        (guard.count)(HttpRefusal::Refused);
    } else if let Some(slot) = request.extensions().get::<Arc<ConnectionSlot>>() {
        slot.keep();
    }
    match decision {
        AccessDecision::Allowed => next.run(request).await,
        AccessDecision::SignIn => {
            let location = HeaderValue::from_str(request.uri().path())
                .unwrap_or(HeaderValue::from_static("/"));
            let mut answer =
                (StatusCode::SEE_OTHER, [(header::LOCATION, location)]).into_response();
            answer.headers_mut().extend(
                guard
                    .access
                    .cookie()
                    .map(|cookie| (header::SET_COOKIE, cookie)),
            );
            answer
        }
        AccessDecision::Unauthorized => {
            let challenge = [(header::WWW_AUTHENTICATE, "Bearer")];
            if is_page_of_browser(&request) {
                let form = Html(sign_in_form(request.uri()));
                return (StatusCode::UNAUTHORIZED, challenge, form).into_response();
            }
            let text = "open this page with ?token=… or send Authorization: Bearer …\n";
            (StatusCode::UNAUTHORIZED, challenge, text).into_response()
        }
        AccessDecision::ForeignHost => (
            StatusCode::MISDIRECTED_REQUEST,
            "this page is served on loopback only\n",
        )
            .into_response(),
    }
}

/// True for a person who opens a page; programs and the page's own scripts do not ask for HTML.
fn is_page_of_browser(request: &Request) -> bool {
    let accepted = request.headers().get(header::ACCEPT);
    accepted.is_some_and(|types| types.as_bytes().starts_with(b"text/html"))
}

/// The form that sends a token to the same address, as `?token=…`.
fn sign_in_form(uri: &Uri) -> String {
    let is_answer = uri.query().is_some_and(|query| query.contains("token="));
    let outcome = if is_answer {
        "This token is wrong."
    } else {
        ""
    };
    include_str!("sign_in.html").replace("OUTCOME", outcome)
}
