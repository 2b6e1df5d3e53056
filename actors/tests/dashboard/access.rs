//! Access to the page.

use ecod::wire::Role;
use ecod_actors::platform::secret::Secret;
use ecod_actors::telemetry::counters::Event;

use crate::cell::{config, start};
use crate::http::{get, get_with, request};

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn only_health_needs_no_token() {
    let mut config = config("euclid", Role::Auto, 1);
    config.dashboard.token = Some(Secret::new("correct-horse-battery"));
    let (node, page) = start(config).await;
    let api = [
        "/api/picture",
        "/api/events",
        "/api/history",
        "/api/frame?at=1",
        "/api/camera",
        "/api/cameras",
        "/api/floor_plan",
    ];
    for path in api
        .into_iter()
        .chain(["/", "/main.js", "/metrics", "/nowhere"])
    {
        assert_eq!(get(page, path).await.status, 401, "{path}");
    }
    let points = request(
        page,
        "POST",
        "/api/camera/mount",
        &[("Host", "localhost")],
        "{}",
    )
    .await;
    assert_eq!(points.status, 401);
    assert_eq!(node.counters().events(Event::BrowserRefused), 12);
    assert_eq!(get(page, "/healthz").await.status, 200);

    let host = ("Host", "localhost");
    let bearer = ("Authorization", "Bearer correct-horse-battery");
    assert_eq!(
        get_with(page, "/metrics", &[host, bearer]).await.status,
        200
    );
    let signed_in = get(page, "/?token=correct-horse-battery").await;
    assert_eq!(
        (signed_in.status, signed_in.header("location")),
        (303, Some("/"))
    );
    let cookie = signed_in.header("set-cookie").unwrap();
    assert!(
        cookie.contains("HttpOnly") && cookie.contains("SameSite=Lax"),
        "{cookie}"
    );
    let cookie = ("Cookie", cookie.split(';').next().unwrap());
    assert_eq!(
        get_with(page, "/api/picture", &[host, cookie]).await.status,
        200
    );
    assert_eq!(get(page, "/?token=wrong-horse-battery").await.status, 401);
    node.stop().await;
}

/// A form escapes `+` and `/`, which a token in an address may have as they are.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn browser_without_token_gets_form() {
    let mut config = config("euclid", Role::Auto, 1);
    config.dashboard.token = Some(Secret::new("correct+horse/battery"));
    let (node, page) = start(config).await;
    let browser = [("Host", "localhost"), ("Accept", "text/html,*/*;q=0.8")];
    let asked = get_with(page, "/", &browser).await;
    assert_eq!(asked.status, 401);
    assert!(asked.body.contains("<input name=\"token\""));
    let wrong = get_with(page, "/?token=wrong", &browser).await;
    assert_eq!(wrong.status, 401);
    assert!(wrong.body.contains("This token is wrong."));
    for token in ["correct%2Bhorse%2Fbattery", "correct+horse/battery"] {
        let signed_in = get_with(page, &format!("/?token={token}"), &browser).await;
        assert_eq!(signed_in.status, 303, "{token}");
        assert_eq!(signed_in.header("location"), Some("/"));
    }
    node.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn foreign_page_is_refused() {
    let (node, page) = start(config("euclid", Role::Auto, 1)).await;
    assert_eq!(
        get_with(page, "/api/picture", &[("Host", "rebound.example:8080")])
            .await
            .status,
        421
    );
    assert_eq!(node.counters().events(Event::BrowserRefused), 1);
    let answer = get(page, "/").await;
    assert_eq!(answer.status, 200);
    let policy = answer.header("content-security-policy").unwrap();
    assert!(
        policy.starts_with("default-src 'none'") && !policy.contains("unsafe"),
        "{policy}"
    );
    assert_eq!(
        answer.header("cross-origin-resource-policy"),
        Some("same-origin")
    );
    assert!(answer.header("access-control-allow-origin").is_none());
    assert_eq!(get(page, "/../Cargo.toml").await.status, 404);
    node.stop().await;
}
