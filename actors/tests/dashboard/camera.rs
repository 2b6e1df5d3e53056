//! The node's own picture with its boxes.

use std::net::SocketAddr;
use std::path::Path;
use std::time::{Duration, Instant};

use base64::prelude::{BASE64_STANDARD, Engine};
use ecod::wire::Role;
use ecod_actors::node::NodeHandle;
use ecod_actors::node::config::NodeConfig;
use ecod_actors::telemetry::counters::Event;
use opencv::core::Vector;
use opencv::imgcodecs;
use opencv::prelude::MatTraitConst;

use crate::cell::{config, start, until};
use crate::http::{Events, get};
use crate::webdriver::Browser;

/// A vehicle before which a person and a cat stand, and a dragon, which has no size.
fn seeing(directory: &Path) -> NodeConfig {
    let (frames, detections) = (directory.join("frames"), directory.join("detections.jsonl"));
    std::fs::create_dir_all(&frames).unwrap();
    let photograph = format!("{}/tests/data/photos/astronaut.jpg", env!("CARGO_MANIFEST_DIR"));
    let photograph = imgcodecs::imread(&photograph, imgcodecs::IMREAD_COLOR).unwrap();
    let (width, height) = (photograph.cols(), photograph.rows());
    for frame in 0..2 {
        let file = frames.join(format!("{frame}.png"));
        assert!(imgcodecs::imwrite_def(&*file.to_string_lossy(), &photograph).unwrap());
    }
    let seen = [("person", [0.3, 0.3, 0.4, 0.6]), ("cat", [0.6, 0.55, 0.7, 0.62]), ("dragon", [0.7, 0.1, 0.8, 0.2])];
    let seen = seen.map(|(label, [left, top, right, bottom])| {
        let (x, y) = (|share: f64| share * f64::from(width), |share: f64| share * f64::from(height));
        serde_json::json!({ "label": label, "confidence": 0.87, "bounding_box":
            { "x_min": x(left), "y_min": y(top), "x_max": x(right), "y_max": y(bottom) } })
    });
    std::fs::write(&detections, serde_json::to_string(&seen).unwrap()).unwrap();
    let camera = format!(
        "source = {{ kind = \"images\", path = {frames:?}, looping = true, fps = 20 }}\n\
         detector = {{ kind = \"recorded\", path = {detections:?}, looping = true }}"
    );
    NodeConfig { camera: Some(toml::from_str(&camera).unwrap()), ..config("euclid", Role::Auto, 0) }
}

async fn shown_after(node: &NodeHandle, time: Duration) -> u64 {
    let before = node.counters().events(Event::FrameShown);
    tokio::time::sleep(time).await;
    node.counters().events(Event::FrameShown) - before
}

async fn sees_objects(page: SocketAddr) {
    until("objects are on the map", || async {
        let picture = get(page, "/api/picture").await.json();
        picture["map"]["message"]["objects"].as_array().is_some_and(|objects| objects.len() >= 2)
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn pictures_are_made_while_somebody_looks_and_five_a_second_at_most() {
    let directory = tempfile::tempdir().unwrap();
    let (node, page) = start(seeing(directory.path())).await;
    sees_objects(page).await;
    assert_eq!(node.counters().events(Event::FrameShown), 0, "nobody looks");

    let mut pictures = Events::open_at(page, "/api/camera").await;
    let picture = pictures.next().await;
    let jpeg = BASE64_STANDARD.decode(picture["jpeg"].as_str().unwrap()).unwrap();
    let image = imgcodecs::imdecode(&Vector::from_slice(&jpeg), imgcodecs::IMREAD_COLOR).unwrap();
    assert!(image.cols() > 0 && image.cols() <= 640);
    let boxes = picture["boxes"].as_array().unwrap();
    assert_eq!(boxes.iter().map(|seen| &seen["label"]).collect::<Vec<_>>(), ["person", "cat", "dragon"]);
    for (seen, places) in boxes.iter().zip([true, true, false]) {
        assert_eq!(seen["object"]["x_m"].is_f64(), places, "{seen}");
    }
    for (edge, wanted) in boxes[0]["edges"].as_array().unwrap().iter().zip([0.3, 0.3, 0.4, 0.6]) {
        assert!((edge.as_f64().unwrap() - wanted).abs() < 1e-6, "{}", boxes[0]);
    }
    let begun = Instant::now();
    let shown = shown_after(&node, Duration::from_secs(2)).await as f64;
    assert!(shown >= 1.0 && shown <= 5.0 * begun.elapsed().as_secs_f64() + 1.0, "{shown}");

    drop(pictures);
    until("no more are made", || async { shown_after(&node, Duration::from_millis(600)).await == 0 }).await;
    node.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_camera_that_is_not_to_be_shown_is_not() {
    let directory = tempfile::tempdir().unwrap();
    let mut private = seeing(directory.path());
    private.dashboard.camera = false;
    let (node, page) = start(private).await;
    sees_objects(page).await;
    assert_eq!(get(page, "/api/camera").await.status, 404);
    assert_eq!(get(page, "/api/picture").await.json()["node"]["camera"], false);
    assert_eq!(node.counters().events(Event::FrameShown), 0);
    node.stop().await;
}

/// The picture is on the page with its boxes; a box and its object on the map light up together, either way.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs Chromium: make test-dashboard"]
async fn a_box_and_its_object_light_up_together() {
    let shots = Path::new(env!("CARGO_TARGET_TMPDIR")).parent().unwrap().join("dashboard");
    std::fs::create_dir_all(&shots).unwrap();
    let directory = tempfile::tempdir().unwrap();
    let (node, page) = start(seeing(directory.path())).await;
    sees_objects(page).await;
    let browser = Browser::start().await;
    browser.look(1440, 900, "light").await;
    browser.open(&format!("http://{page}/")).await;
    browser.until("document.querySelectorAll('#camera-boxes button').length === 3").await;
    browser
        .until("document.querySelector('#camera').getContext('2d').getImageData(200, 200, 1, 1).data[3] === 255")
        .await;
    browser.until("document.querySelectorAll('#map .ellipse').length >= 2").await;
    let words = "[...document.querySelectorAll('#camera-boxes button')].map((box) => box.textContent).join()";
    assert_eq!(browser.evaluate(words).await, "person 87 %,cat 87 %,dragon 87 %");
    let lit_labels =
        "[...document.querySelectorAll('#map g.lit')].map((it) => it.getAttribute('aria-label').split(',')[0]).join()";
    let lit_boxes = "[...document.querySelectorAll('#camera-boxes .lit')].map((it) => it.textContent).join()";

    browser.point_at("#camera-boxes button:nth-child(2)").await;
    browser.until(&format!("{lit_labels} === 'cat' && {lit_boxes} === 'cat 87 %'")).await;
    for (name, width, scheme) in
        [("camera-light", 1440, "light"), ("camera-dark", 1440, "dark"), ("camera-phone", 390, "light")]
    {
        browser.look(width, 900, scheme).await;
        browser.evaluate("document.querySelector('#camera-card').scrollIntoView({ block: 'center' })").await;
        browser.evaluate("document.querySelector('#camera-boxes button:nth-child(2)').focus()").await;
        browser.until(&format!("{lit_boxes} === 'cat 87 %'")).await;
        tokio::time::sleep(Duration::from_secs(1)).await;
        browser.screenshot(&shots.join(format!("{name}.png"))).await;
        let wider = "document.documentElement.scrollWidth > document.documentElement.clientWidth";
        assert_eq!(browser.evaluate(wider).await, false, "{name}: the page scrolls sideways");
    }
    browser.look(1440, 900, "light").await;
    browser.evaluate("(document.activeElement.blur(), window.scrollTo(0, 0))").await;
    browser.point_at("#camera-title").await;
    browser.until(&format!("{lit_boxes} === ''")).await;
    browser.evaluate("document.querySelector('#map g[aria-label^=person] .ellipse').id = 'person'").await;
    browser.point_at("#person").await;
    browser.until(&format!("{lit_labels} === 'person' && {lit_boxes} === 'person 87 %'")).await;
    assert_eq!(browser.complaints().await, Vec::<String>::new());

    browser.quit().await;
    until("no more are made", || async { shown_after(&node, Duration::from_millis(600)).await == 0 }).await;
    node.stop().await;
}

/// Points of the ground are clicked in the picture and on the map, typed, corrected and copied.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs Chromium: make test-dashboard"]
async fn points_for_the_mount_are_clicked_in_the_picture_and_on_the_map() {
    let shots = Path::new(env!("CARGO_TARGET_TMPDIR")).parent().unwrap().join("dashboard");
    std::fs::create_dir_all(&shots).unwrap();
    let directory = tempfile::tempdir().unwrap();
    let mut seeing = seeing(directory.path());
    seeing.landmarks = config("euclid", Role::Auto, 6).landmarks;
    let (node, page) = start(seeing).await;
    let browser = Browser::start().await;
    browser.look(1280, 1000, "light").await;
    browser.open(&format!("http://{page}/")).await;
    browser.until("document.querySelectorAll('#camera-boxes button').length === 3").await;
    browser.until("document.querySelectorAll('#map .place').length === 6").await;
    browser.evaluate("document.querySelector('#mount').click()").await;
    let hint = "document.querySelector('#mount-hint').textContent";
    browser.until(&format!("{hint}.includes('4 points to go')")).await;

    // Slots 0 to 2 stand at (0, 4), (0, -4) and (3, 4).
    for (index, [across, down]) in [[0.25, 0.75], [0.5, 0.75], [0.75, 0.5]].into_iter().enumerate() {
        browser.click_within("#camera", [across, down]).await;
        browser.until(&format!("{hint}.startsWith('Now click point {}')", index + 1)).await;
        browser.evaluate(&format!("document.querySelectorAll('#map .place')[{index}].id = 'slot-{index}'")).await;
        browser.click(&format!("#slot-{index}")).await;
        browser.until(&format!("{hint}.includes('{} point')", 3 - index)).await;
    }
    assert_eq!(browser.evaluate("document.querySelector('#mount-copy').disabled").await, true);
    browser.evaluate("document.querySelector('#mount-add').click()").await;
    for (column, value) in ["12", "34", "-1.5", "2"].into_iter().enumerate() {
        let typed = format!(
            "(([input]) => (input.value = '{value}', input.dispatchEvent(new Event('input'))))\
             ([document.querySelectorAll('#mount-rows tr:last-child input')[{column}]])"
        );
        browser.evaluate(&typed).await;
    }
    browser.until("!document.querySelector('#mount-copy').disabled").await;
    let list = browser.evaluate("document.querySelector('#mount-list').value").await;
    let lines = list.as_str().unwrap().lines().filter(|line| !line.starts_with('#'));
    let points: Vec<&str> = lines.collect();
    assert!(list.as_str().unwrap().contains("frames of 512 x 512 pixels"), "{list}");
    let (width, height) = (512.0, 512.0);
    let wanted = [
        [0.25 * width, 0.75 * height, 0.0, 4.0],
        [0.5 * width, 0.75 * height, 0.0, -4.0],
        [0.75 * width, 0.5 * height, 3.0, 4.0],
        [12.0, 34.0, -1.5, 2.0],
    ];
    assert_eq!(points.len(), wanted.len());
    for (point, wanted) in points.iter().zip(wanted) {
        let found: Vec<f64> = point.split([',', '=']).map(|number| number.parse().unwrap()).collect();
        assert_eq!(found.len(), 4, "{point}");
        // A click falls on a pixel of the screen, which shows a frame smaller than it is.
        let off = |index: usize| (found[index] - wanted[index]).abs();
        assert!(off(0) <= 2.0 && off(1) <= 2.0 && off(2) < 1e-9 && off(3) < 1e-9, "{found:?}, not {wanted:?}");
    }
    browser.evaluate("document.querySelector('#mount-copy').click()").await;
    browser.until("document.querySelector('#mount-copied').textContent === 'Copied 4 points.'").await;
    browser.until("document.querySelectorAll('#map .pick').length >= 4 && document.querySelectorAll('#camera-picks span').length === 4").await;
    for (name, width) in [("mount", 1280), ("mount-phone", 390)] {
        browser.look(width, 1000, "light").await;
        tokio::time::sleep(Duration::from_secs(1)).await;
        browser.screenshot(&shots.join(format!("{name}.png"))).await;
        let wider = "document.documentElement.scrollWidth > document.documentElement.clientWidth";
        assert_eq!(browser.evaluate(wider).await, false, "{name}: the page scrolls sideways");
    }
    browser.look(1280, 1000, "light").await;
    browser.evaluate("document.querySelector('[aria-label=\"Remove point 2\"]').click()").await;
    browser.until("document.querySelector('#mount-copy').disabled && document.querySelectorAll('#mount-rows tr').length === 3").await;
    browser.evaluate("document.querySelector('#mount').click()").await;
    browser.until("document.querySelectorAll('#map path.pick').length === 0").await;
    assert_eq!(browser.complaints().await, Vec::<String>::new());
    browser.quit().await;
    node.stop().await;
}
