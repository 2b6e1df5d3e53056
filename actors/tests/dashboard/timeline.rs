//! The timeline of page and report, as people see it.

use std::path::Path;
use std::process::Command;
use std::time::Duration;

use ecod::wire::Role;
use ecod_actors::observe::recorder::RecordConfig;
use ecod_testkit::until_async as until;

use crate::cell::{self, Vehicles, config};
use crate::processes::{Place, free_places, start};
use crate::webdriver::Browser;

const BANDS: &str = "[...document.querySelectorAll('#timeline-bands .band title')].map((e) => e.textContent.split(' ')[0])";
const EVENTS: &str =
    "[...document.querySelectorAll('#timeline-events .what')].map((e) => e.textContent)";
const CARS: &str = "document.querySelectorAll('#map .place.full').length";

/// Presses the event whose text has this in it.
fn press(text: &str) -> String {
    format!(
        "[...document.querySelectorAll('#timeline-events button')].find((e) => e.textContent.includes('{text}')).click()"
    )
}

/// Pictures in the sizes and colours of people.
async fn pictures(browser: &Browser, name: &str) {
    let pictures = Path::new(env!("CARGO_TARGET_TMPDIR"))
        .parent()
        .unwrap()
        .join("dashboard");
    std::fs::create_dir_all(&pictures).unwrap();
    for (look, width, height, scheme) in [
        ("light", 1440, 900, "light"),
        ("dark", 1440, 900, "dark"),
        ("phone", 390, 844, "light"),
    ] {
        browser.look(width, height, scheme).await;
        browser
            .screenshot(&pictures.join(format!("{name}-{look}.png")))
            .await;
        browser.fits_the_width(&format!("{name}, {look}")).await;
    }
    browser.look(1440, 900, "light").await;
}

/// After the edge was killed, the page has a band for each leader, and goes back to the map of before and to now.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs Chromium: make test-dashboard"]
async fn browser_scrubs_back() {
    let directory = tempfile::tempdir().unwrap();
    let places: [Place; 2] = free_places();
    let [at_edge, at_euclid] = places;
    let mut edge = start("edge", Role::Edge, at_edge, &places, directory.path());
    let _euclid = start("euclid", Role::Auto, at_euclid, &places, directory.path());
    let browser = Browser::start().await;
    browser.look(1440, 900, "light").await;
    browser.open(&format!("http://{}/", at_euclid.page)).await;
    browser
        .until("document.querySelector('#leader').textContent === 'edge'")
        .await;
    tokio::time::sleep(Duration::from_secs(3)).await;
    let _vehicles = Vehicles::start(&places.map(|place| place.broker), 4, 12);
    browser.until(&format!("{CARS} >= 6")).await;
    tokio::time::sleep(Duration::from_secs(3)).await;
    edge.0.kill().unwrap();
    browser
        .until(&format!(
            "JSON.stringify({BANDS}.slice(-2)) === '[\"edge\",\"euclid\"]'"
        ))
        .await;
    browser
        .until(&format!(
            "{EVENTS}.some((e) => e.startsWith('euclid took over from edge, '))"
        ))
        .await;
    browser
        .until(&format!("{EVENTS}.includes('edge is gone')"))
        .await;

    browser.evaluate(&press("euclid joined")).await;
    let map_is = |words: &str| {
        format!("/^Map: {words}/.test(document.querySelector('#timeline-at').textContent)")
    };
    browser
        .until(&format!("{} && {CARS} === 0", map_is(".* ago$")))
        .await;
    browser
        .until("document.querySelector('#timeline-events [aria-current=time]') !== null")
        .await;
    assert_eq!(
        browser
            .evaluate("document.querySelector('#leader').textContent")
            .await,
        "euclid",
        "all else is as now"
    );
    browser.evaluate(&press("took over")).await;
    browser
        .until(&format!("{} && {CARS} >= 6", map_is(".* ago$")))
        .await;
    pictures(&browser, "timeline").await;

    browser
        .evaluate("document.querySelector('#timeline-cursor').focus()")
        .await;
    browser.press("ArrowLeft").await;
    let slider = "Number(document.querySelector('#timeline-cursor').value)";
    let at = browser.evaluate(slider).await.as_f64().unwrap();
    browser.press("ArrowLeft").await;
    browser.until(&format!("{slider} < {at}")).await;
    browser
        .evaluate("document.querySelector('#timeline-live').click()")
        .await;
    browser
        .until(&format!("{} && {CARS} >= 6", map_is("now$")))
        .await;
    assert_eq!(
        browser
            .evaluate("document.querySelector('.past') === null")
            .await,
        true
    );
    browser.quit_without_complaints().await;
}

/// The report about a log has the same timeline, with the map and the camera's picture at the cursor.
#[cfg(feature = "camera")]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs Chromium: make test-dashboard"]
async fn report_shows_map_at_cursor() {
    let directory = tempfile::tempdir().unwrap();
    let [log, frames, detections, page] = ["log", "frames", "detections.jsonl", "report.html"]
        .map(|name| directory.path().join(name));
    std::fs::create_dir(&frames).unwrap();
    std::fs::write(
        frames.join("0.ppm"),
        [b"P6 320 240 255\n".as_slice(), &[128; 320 * 240 * 3]].concat(),
    )
    .unwrap();
    std::fs::write(&detections, "[]\n").unwrap();
    let places: [Place; 1] = free_places();
    let mut edge = start("edge", Role::Edge, places[0], &places, directory.path());
    let mut euclid = config("euclid", Role::Auto, 12);
    euclid.membership.seeds = vec![places[0].gossip.to_string()];
    euclid.record = Some(RecordConfig {
        min_free_mb: 0,
        camera_hz: 2.0,
        ..RecordConfig::new(log.clone())
    });
    let camera = format!(
        "source = {{ kind = \"images\", path = {frames:?}, looping = true, fps = 10 }}\n\
         detector = {{ kind = \"recorded\", path = {detections:?}, looping = true }}\n\
         projection.sizes.default = {{ width_m = 0.5, height_m = 0.5 }}"
    );
    euclid.camera = Some(toml::from_str(&camera).unwrap());
    let (euclid, at_euclid) = cell::start(euclid).await;
    let leads = |name: &'static str| async move {
        let picture = crate::http::get(at_euclid, "/api/picture").await.json();
        picture["leadership"]["leader"] == name && picture["map"].is_object()
    };
    until("the edge leads", || leads("edge")).await;
    tokio::time::sleep(Duration::from_secs(3)).await;
    let vehicles = Vehicles::start(&[places[0].broker, euclid.broker_address().unwrap()], 4, 12);
    tokio::time::sleep(Duration::from_secs(5)).await;
    edge.0.kill().unwrap();
    until("euclid leads", || leads("euclid")).await;
    tokio::time::sleep(Duration::from_secs(3)).await;
    drop(vehicles);
    euclid.stop().await;
    let mut command = Command::new(env!("CARGO_BIN_EXE_ecod-node"));
    let made = command
        .arg("report")
        .arg(&log)
        .arg("-o")
        .arg(&page)
        .output()
        .unwrap();
    assert!(
        made.status.success(),
        "{}",
        String::from_utf8_lossy(&made.stderr)
    );

    let browser = Browser::start().await;
    browser.look(1440, 900, "light").await;
    browser.open(&format!("file://{}", page.display())).await;
    browser
        .until(&format!(
            "JSON.stringify({BANDS}.slice(-2)) === '[\"edge\",\"euclid\"]' && {CARS} >= 6"
        ))
        .await;
    browser
        .until("document.querySelector('#picture').naturalWidth === 320")
        .await;
    browser
        .until(&format!(
            "{EVENTS}.some((e) => e.startsWith('euclid took over from edge, '))"
        ))
        .await;
    pictures(&browser, "report").await;
    browser.evaluate(&press("took over")).await;
    browser
        .until("document.querySelector('#timeline-events [aria-current=time]') !== null")
        .await;
    let to_begin = "(document.querySelector('#timeline-cursor').value = 0, \
        document.querySelector('#timeline-cursor').dispatchEvent(new Event('input')))";
    browser.evaluate(to_begin).await;
    browser.until(&format!("{CARS} === 0")).await;
    browser
        .evaluate("document.querySelector('#as-table').click()")
        .await;
    browser
        .until("document.querySelectorAll('#places tr').length >= 12")
        .await;
    browser.quit_without_complaints().await;
}
