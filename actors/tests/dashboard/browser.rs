//! The page as people see it.

use std::path::Path;
use std::time::{Duration, Instant};

use ecod::wire::Role;
use ecod_actors::platform::secret::Secret;
#[cfg(feature = "camera")]
use opencv::core::Vec3b;
use opencv::prelude::MatTraitConst;

use crate::cell::{self, Stray, Vehicles, config};
use crate::http::Events;
use crate::processes::{Place, free_places, start};
use crate::webdriver::Browser;

const SHOWN: &str = "document.querySelectorAll('#map .place.full').length >= 6 \
    && document.querySelectorAll('#map .body').length >= 4 && document.querySelectorAll('#verdicts tr').length >= 4 \
    && document.querySelectorAll('#reputations tr').length >= 4";

/// The node is ready, whether or not vehicles report, and report where they should.
const IS_READY: &str =
    "/^(Live|No reports|[0-9]+ trouble)/.test(document.querySelector('#state-text')?.textContent)";

/// The map of a cell of processes fills, a vehicle takes over when the edge's process is killed, and the page reports
/// it, also to screen readers. Leaves pictures of the page in `target/dashboard`.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs Chromium: make test-dashboard"]
async fn browser_follows_new_leader() {
    let pictures = Path::new(env!("CARGO_TARGET_TMPDIR"))
        .parent()
        .unwrap()
        .join("dashboard");
    std::fs::create_dir_all(&pictures).unwrap();
    let directory = tempfile::tempdir().unwrap();
    let places: [Place; 3] = free_places();
    let [at_edge, at_euclid, at_gauss] = places;
    let mut edge = start("edge", Role::Edge, at_edge, &places, directory.path());
    let _euclid = start("euclid", Role::Auto, at_euclid, &places, directory.path());
    let _gauss = start("gauss", Role::Auto, at_gauss, &places, directory.path());
    let vehicles = Vehicles::start(&places.map(|place| place.broker), 4, 12);

    let browser = Browser::start().await;
    browser.look(1440, 900, "light").await;
    let opened = Instant::now();
    browser.open(&format!("http://{}/", at_euclid.page)).await;
    browser.until(IS_READY).await;
    println!(
        "page live {:?} after the request, WebDriver included",
        opened.elapsed()
    );
    browser
        .until("document.querySelector('#leader').textContent === 'edge'")
        .await;
    browser.until(SHOWN).await;
    let first = "performance.getEntriesByType('navigation')[0].domContentLoadedEventEnd";
    for (name, place) in [("edge", at_edge), ("gauss", at_gauss)] {
        let link = format!(
            "document.querySelector('#nodes a[href=\"http://{}/\"]')?.textContent === '{name}'",
            place.page
        );
        browser.until(&link).await;
    }
    println!(
        "page loaded in {} ms by the browser's own clock",
        browser.evaluate(first).await
    );
    tokio::time::sleep(Duration::from_secs(6)).await;
    for (name, width, height, scheme) in [
        ("light", 1440, 900, "light"),
        ("dark", 1440, 900, "dark"),
        ("phone", 390, 844, "light"),
        ("tablet", 900, 1100, "dark"),
    ] {
        browser.look(width, height, scheme).await;
        browser
            .screenshot(&pictures.join(format!("{name}.png")))
            .await;
        browser.fits_the_width(name).await;
        let cut_off = "[...document.querySelectorAll('.scroll')].filter((it) => it.scrollWidth > it.clientWidth + 1)\
                       .map((it) => it.getAttribute('aria-labelledby')).join()";
        if width >= 1440 {
            assert_eq!(
                browser.evaluate(cut_off).await,
                "",
                "{name}: tables that go on at the right"
            );
        }
    }
    browser.look(1440, 900, "light").await;

    edge.0.kill().unwrap();
    let killed = Instant::now();
    browser
        .until("!['edge', 'none', '–'].includes(document.querySelector('#leader').textContent)")
        .await;
    println!(
        "another leader on the page {:?} after the edge was killed",
        killed.elapsed()
    );
    browser
        .until(
            "/leads now, in place of edge/.test(document.querySelector('#announcer').textContent)",
        )
        .await;
    browser
        .until("[...document.querySelectorAll('#reigns tr')].some((row) => row.textContent.startsWith('edge'))")
        .await;
    browser.until(IS_READY).await;
    tokio::time::sleep(Duration::from_secs(3)).await;
    browser.screenshot(&pictures.join("failover.png")).await;

    keyboard_and_table(&browser).await;
    finger(&browser).await;
    assert_eq!(browser.complaints().await, Vec::<String>::new());

    drop(vehicles);
    browser
        .until("document.querySelector('#latency').textContent === '–'")
        .await;
    drop(_euclid);
    browser
        .until("document.querySelector('#state').classList.contains('stale')")
        .await;
    browser.until("!document.querySelector('#notice').hidden && document.body.classList.contains('stale-data')").await;
    let age = browser
        .evaluate("document.querySelector('#state-age[aria-hidden=true]').textContent")
        .await;
    assert!(age.as_str().unwrap().ends_with(" s old"), "{age}");
    let said = browser
        .evaluate("document.querySelector('#state-text').textContent")
        .await;
    assert_eq!(
        said, "Connection lost",
        "and no text that changes every second"
    );
    let chart = browser
        .evaluate("Number(getComputedStyle(document.querySelector('#latency-chart')).opacity)")
        .await;
    assert!(chart.as_f64().unwrap() < 1.0, "{chart}");
    browser.screenshot(&pictures.join("stale.png")).await;
    let _euclid = start("euclid", Role::Auto, at_euclid, &places, directory.path());
    browser.until(IS_READY).await;
    browser.quit().await;
    println!("pictures of the page: {}", pictures.display());
}

/// A page of another site may link to a page with a token. Without a free live connection, a page polls slowly, and
/// states this until other pages are closed.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs Chromium: make test-dashboard"]
async fn link_signs_in_excess_page_polls() {
    let browser = Browser::start().await;
    let mut guarded = config("euclid", Role::Auto, 1);
    guarded.dashboard.token = Some(Secret::new("correct-horse-battery"));
    let (node, page) = cell::start(guarded).await;
    let link =
        format!("data:text/html,<a href='http://{page}/?token=correct-horse-battery'>the lot</a>");
    browser.open(&link).await;
    browser
        .evaluate("document.querySelector('a').click()")
        .await;
    browser.until(IS_READY).await;
    assert_eq!(browser.evaluate("location.search").await, "");
    node.stop().await;

    let mut crowded = config("gauss", Role::Auto, 1);
    crowded.dashboard.max_connections = 16;
    crowded.dashboard.max_rate_hz = 1.0;
    let (node, page) = cell::start(crowded).await;
    let mut others = Vec::new();
    for _ in 0..8 {
        others.push(Events::open(page).await);
        others.last_mut().unwrap().next().await;
    }
    browser.open(&format!("http://{page}/")).await;
    browser.until(IS_READY).await;
    let is_told =
        "/no room for another live page/.test(document.querySelector('#notice').textContent)";
    browser.until(is_told).await;
    tokio::time::sleep(Duration::from_secs(5)).await;
    assert_eq!(
        browser.evaluate(&format!("{IS_READY} && {is_told}")).await,
        true
    );
    drop(others);
    browser
        .until(&format!(
            "{IS_READY} && document.querySelector('#notice').hidden"
        ))
        .await;
    browser.quit().await;
    node.stop().await;
}

/// What browsers have only since 2023.
const WITHOUT_THE_LATEST: &str = "for (const [of, names] of [[Map, ['groupBy']], [Object, ['groupBy']], [Array, ['fromAsync']], \
    [Array.prototype, ['findLast', 'findLastIndex', 'toSorted', 'toReversed', 'toSpliced', 'with']], \
    [Promise, ['withResolvers']], [Set.prototype, ['union', 'difference']]]) for (const name of names) delete of[name];";

/// Browsers of some years ago show the map. If a part cannot be drawn, the page shows a fault.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs Chromium: make test-dashboard"]
async fn old_browser_shows_map_or_explains() {
    let (node, page) = cell::start(config("euclid", Role::Auto, 12)).await;
    let _vehicles = Vehicles::start(&[node.broker_address().unwrap()], 4, 12);
    let browser = Browser::start().await;
    browser.prepare(WITHOUT_THE_LATEST).await;
    browser.open(&format!("http://{page}/")).await;
    browser.until(SHOWN).await;
    assert_eq!(browser.complaints().await, Vec::<String>::new());

    let is_live = "document.querySelector('#state').classList.contains('live')";
    let is_said = "!document.querySelector('#notice').hidden \
        && /cannot draw/.test(document.querySelector('#notice').textContent)";
    browser.until(is_live).await;
    browser
        .evaluate("document.querySelector('#places').id = 'gone', document.querySelector('#as-table').click()")
        .await;
    browser.until(&format!("{is_said} && !{is_live}")).await;
    tokio::time::sleep(Duration::from_secs(1)).await;
    assert_eq!(
        browser.evaluate(&format!("{is_said} && !{is_live}")).await,
        true,
        "and goes on to"
    );
    browser
        .evaluate("document.querySelector('#gone').id = 'places'")
        .await;
    browser
        .until(&format!(
            "{is_live} && document.querySelector('#notice').hidden"
        ))
        .await;
    browser.quit().await;
    node.stop().await;
}

/// Tables that are cut off, below or at the right, show a shadow on the side that continues, and no shadow at their
/// ends.
#[cfg(feature = "camera")]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs Chromium: make test-dashboard"]
async fn cut_off_table_shows_shadow() {
    let (node, page) = cell::start(config("euclid", Role::Auto, 24)).await;
    let _vehicles = Vehicles::start(&[node.broker_address().unwrap()], 4, 24);
    let directory = tempfile::tempdir().unwrap();
    let browser = Browser::start().await;
    browser.look(390, 844, "light").await;
    browser.open(&format!("http://{page}/")).await;
    browser
        .until("document.querySelectorAll('#verdicts tr').length >= 24")
        .await;
    let cut_off = "document.querySelector('#verdicts').closest('.scroll').scrollHeight > 400";
    assert_eq!(
        browser.evaluate(cut_off).await,
        true,
        "the table is too short for this test"
    );
    let rows_of_troubles = "[...document.querySelectorAll('#troubles-card thead')].map((it) => getComputedStyle(it).display).join()";
    assert_eq!(
        browser.evaluate(rows_of_troubles).await,
        "none",
        "troubles are read without scrolling sideways"
    );
    browser.evaluate(OVERFILL).await;
    let places = browser.evaluate(PLACES).await;
    let places: Vec<[f64; 4]> = serde_json::from_value(places).unwrap();
    assert_eq!(places.len(), 9, "the tables of the page");
    // Of each table, the lightest pixel of its lower and of its right border, away from the corners.
    let lightest = async |name: &str| {
        let file = directory.path().join(name);
        browser.screenshot(&file).await;
        let picture = ecod_actors::camera::image_codec::read(&file).unwrap();
        // The borders are gray: any colour does.
        let pixel = |x: f64, y: f64| picture.at_2d::<Vec3b>(y as i32, x as i32).unwrap()[1];
        let of = |[left, top, right, bottom]: &[f64; 4]| {
            let steps = || (40..60).map(|step| f64::from(step) / 100.0);
            let below = steps()
                .map(|share| pixel(left + share * (right - left), bottom - 2.0))
                .max();
            let beside = steps()
                .map(|share| pixel(right - 2.0, top + share * (bottom - top)))
                .max();
            [below.unwrap(), beside.unwrap()]
        };
        places.iter().map(of).collect::<Vec<_>>()
    };
    let goes_on = lightest("begin.png").await;
    browser
        .evaluate("document.querySelectorAll('.scroll').forEach((it) => it.scrollTo(it.scrollWidth, it.scrollHeight))")
        .await;
    tokio::time::sleep(Duration::from_millis(500)).await;
    let ends = lightest("end.png").await;
    let shaded = "[...document.querySelectorAll('.scroll th:first-child')].filter((it) => it.checkVisibility()) \
        .every((it) => getComputedStyle(it).boxShadow !== 'none')";
    assert_eq!(
        browser.evaluate(shaded).await,
        true,
        "rows above are hinted at below the heading"
    );
    for (table, (goes_on, ends)) in goes_on.iter().zip(&ends).enumerate() {
        for (side, (goes_on, ends)) in ["below", "at the right"]
            .into_iter()
            .zip(goes_on.iter().zip(ends))
        {
            assert!(
                goes_on + 15 < *ends,
                "table {table} {side}: {goes_on} where it goes on, {ends} where it ends"
            );
        }
    }
    browser.quit().await;
    node.stop().await;
}

/// Ends the drawing of the page, and shows all tables with more columns and rows than have room.
#[cfg(feature = "camera")]
const OVERFILL: &str = "window.requestAnimationFrame = () => {}, document.querySelectorAll('.scroll table').forEach((table) => { \
    for (let it = table; it !== document.body; it = it.parentElement) it.hidden = false; \
    if (!table.closest('.troubles')) table.style.minWidth = '600px'; \
    else table.closest('.scroll').firstElementChild.style.width = '600px'; \
    for (let row = 0; row < 60; row++) table.tBodies[0].insertRow().insertCell().textContent = 'more'; })";

/// Edges of all tables on the page, in pixels: left, upper, right, lower.
#[cfg(feature = "camera")]
const PLACES: &str = "[...document.querySelectorAll('.scroll')].filter((it) => it.querySelector('table')).map((it) => { \
    const { left, top, right, bottom } = it.getBoundingClientRect(); \
    return [left + scrollX, top + scrollY, right + scrollX, bottom + scrollY]; })";

/// Far away from everything else, and a position all the same.
const FAR_M: f64 = 9e7;

/// A vehicle with a wrong pose does not determine the scale of the map. The page points to it and shows it on request.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs Chromium: make test-dashboard"]
async fn wrong_position_distorts_no_map() {
    let (node, page) = cell::start(config("euclid", Role::Auto, 12)).await;
    let mut stray = Stray::start(node.broker_address().unwrap());
    let browser = Browser::start().await;
    browser.look(1440, 900, "light").await;
    browser.open(&format!("http://{page}/")).await;
    let width = "(([...all]) => { const xs = all.map((place) => Number(place.getAttribute('x'))); \
        return Math.max(...xs) - Math.min(...xs); })(document.querySelectorAll('#map .place'))";
    browser.until(&format!("{width} > 300")).await;
    stray.stand(FAR_M).await;
    let is_pointed_to =
        "/^stray, 9.* km$/.test(document.querySelector('#map text.cue')?.textContent)";
    browser.until(is_pointed_to).await;
    assert_eq!(
        browser.evaluate(&format!("{width} > 300")).await,
        true,
        "a vehicle without detections does not scale the map"
    );
    stray.report(FAR_M, 1.0).await;
    tokio::time::sleep(Duration::from_secs(1)).await;
    assert_eq!(
        browser
            .evaluate(&format!("{width} > 300 && {is_pointed_to}"))
            .await,
        true,
        "nor one that sees the lot"
    );
    browser
        .evaluate("document.querySelector('#map-outside').click()")
        .await;
    browser
        .until(&format!(
            "{width} < 1 && document.querySelector('#map-outside').hidden"
        ))
        .await;
    browser
        .evaluate("document.querySelector('#fit').click()")
        .await;
    browser
        .until(&format!(
            "{width} > 300 && !document.querySelector('#map-outside').hidden"
        ))
        .await;

    stray.report(1.0, FAR_M).await;
    browser
        .until("document.querySelectorAll('#map .body').length === 1 && document.querySelector('#map-outside').hidden")
        .await;
    browser
        .evaluate("document.querySelector('#zoom-in').click()")
        .await;
    browser
        .until("document.querySelector('#map').classList.contains('zoomed')")
        .await;
    let zoomed = browser.evaluate(width).await.as_f64().unwrap();
    stray.report(FAR_M, 1.0).await;
    browser
        .until("!document.querySelector('#map-outside').hidden")
        .await;
    assert_eq!(
        browser.evaluate(width).await.as_f64().unwrap(),
        zoomed,
        "it stands where it was put"
    );
    browser.quit().await;
    node.stop().await;
}

/// A finger scrolls past a map that is shown whole, and moves a map that is zoomed; Fit shows the whole map again.
async fn finger(browser: &Browser) {
    browser.look(390, 844, "light").await;
    let middle = async || {
        browser
            .evaluate("document.querySelector('#map-frame').scrollIntoView({ block: 'center' })")
            .await;
        let middle = "(({ x, y, width, height }) => [x + width / 2, y + height / 2])\
            (document.querySelector('#map').getBoundingClientRect())";
        let middle = browser.evaluate(middle).await;
        [0, 1].map(|axis| middle[axis].as_f64().unwrap())
    };
    let place = "Number(document.querySelector('#map .place').getAttribute('y'))";
    let whole = browser.evaluate(place).await.as_f64().unwrap();
    middle().await;
    let scrolled = browser.evaluate("window.scrollY").await.as_f64().unwrap();
    browser.swipe(middle().await, [0.0, -80.0]).await;
    browser.until(&format!("window.scrollY > {scrolled}")).await;
    assert!((browser.evaluate(place).await.as_f64().unwrap() - whole).abs() < 5.0);

    browser
        .evaluate("document.querySelector('#zoom-in').click()")
        .await;
    browser
        .until("document.querySelector('#map').classList.contains('zoomed')")
        .await;
    let zoomed = browser.evaluate(place).await.as_f64().unwrap();
    browser.swipe(middle().await, [0.0, 60.0]).await;
    browser.until(&format!("{place} - {zoomed} > 40")).await;
    browser
        .evaluate("document.querySelector('#fit').click()")
        .await;
    browser
        .until(&format!("Math.abs({place} - {whole}) < 20"))
        .await;
    browser.look(1440, 900, "light").await;
}

/// The map moves by keys and has a table in its place; everything that is pressed or scrolled can be reached and has a
/// name.
async fn keyboard_and_table(browser: &Browser) {
    let place = "Number(document.querySelector('#map .place').getAttribute('x'))";
    browser
        .evaluate("document.querySelector('#map').focus()")
        .await;
    let before = browser.evaluate(place).await.as_f64().unwrap();
    browser.press("ArrowRight").await;
    browser
        .until(&format!("Math.abs({place} - {before}) > 30"))
        .await;
    browser.press("0").await;
    browser
        .until(&format!("Math.abs({place} - {before}) < 20"))
        .await;
    browser
        .evaluate("document.querySelector('#as-table').click()")
        .await;
    browser
        .until("document.querySelectorAll('#places tr').length >= 12 && document.querySelector('#map-frame').hidden")
        .await;
    browser
        .evaluate("document.querySelector('#as-table').click()")
        .await;
    let nameless = "[...document.querySelectorAll('button, svg, [role], section')].filter((e) => !e.closest('[hidden]') \
        && !(e.textContent.trim() || e.getAttribute('aria-label') || e.getAttribute('aria-labelledby')) \
        && !e.getAttribute('aria-hidden')).map((e) => e.outerHTML.slice(0, 80))";
    let nameless = browser.evaluate(nameless).await;
    // The state before the first picture and a notice in normal operation contain no message.
    assert_eq!(
        nameless
            .as_array()
            .unwrap()
            .iter()
            .filter(|e| !e.to_string().contains("role=\\\"alert"))
            .count(),
        0,
        "{nameless}"
    );
}
