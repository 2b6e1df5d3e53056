//! The node's own picture with its boxes.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use base64::prelude::{BASE64_STANDARD, Engine};
use ecod::wire::Role;
use ecod_actors::camera::config::CameraConfig;
use ecod_actors::camera::image_codec;
use ecod_actors::node::NodeHandle;
use ecod_actors::node::config::NodeConfig;
use ecod_actors::telemetry::counters::Event;
use ecod_testkit::{PATIENCE, until_async as until};
use opencv::prelude::MatTraitConst;

use crate::cell::{config, join, start};
use crate::http::{Events, get};
use crate::webdriver::Browser;

/// A vehicle before which a person and a cat stand, and a dragon, which has no size.
pub(crate) fn seeing(directory: &Path) -> NodeConfig {
    let seen = [
        ("person", [0.3, 0.3, 0.4, 0.6]),
        ("cat", [0.6, 0.55, 0.7, 0.62]),
        ("dragon", [0.7, 0.1, 0.8, 0.2]),
    ];
    let camera = camera(&directory.join("front"), "astronaut", &seen);
    NodeConfig {
        camera: Some(camera),
        ..config("euclid", Role::Auto, 0)
    }
}

/// The node with a second camera to the rear, which detects a dog.
pub(crate) fn seeing_both_ways(directory: &Path) -> NodeConfig {
    let mut both = seeing(directory);
    let mut rear = camera(
        &directory.join("rear"),
        "chelsea",
        &[("dog", [0.45, 0.5, 0.55, 0.7])],
    );
    rear.name = Some("rear".into());
    rear.mount.forward_m = -2.0;
    rear.mount.pan_deg = 180.0;
    both.cameras = vec![rear];
    both
}

/// A camera that shows a photograph, with these detections: label, and edges as shares of the picture.
fn camera(directory: &Path, photograph: &str, seen: &[(&str, [f64; 4])]) -> CameraConfig {
    let frames = directory.join("frames");
    let detections = directory.join("detections.jsonl");
    std::fs::create_dir_all(&frames).unwrap();
    let photograph = format!(
        "{}/tests/data/photos/{photograph}.jpg",
        env!("CARGO_MANIFEST_DIR")
    );
    let photograph = image_codec::read(photograph.as_ref()).unwrap();
    let width = photograph.cols();
    let height = photograph.rows();
    for frame in 0..2 {
        let jpeg = image_codec::encode_jpeg(&photograph, 95).unwrap();
        std::fs::write(frames.join(format!("{frame}.jpg")), jpeg).unwrap();
    }
    let seen = seen.iter().map(|(label, [left, top, right, bottom])| {
        let x = |share: f64| share * f64::from(width);
        let y = |share: f64| share * f64::from(height);
        serde_json::json!({ "label": label, "confidence": 0.87, "bounding_box":
            { "x_min": x(*left), "y_min": y(*top), "x_max": x(*right), "y_max": y(*bottom) } })
    });
    std::fs::write(&detections, serde_json::Value::from_iter(seen).to_string()).unwrap();
    let camera = format!(
        "source = {{ kind = \"images\", path = {frames:?}, looping = true, fps = 20 }}\n\
         detector = {{ kind = \"recorded\", path = {detections:?}, looping = true }}"
    );
    toml::from_str(&camera).unwrap()
}

async fn shown_after(node: &NodeHandle, time: Duration) -> u64 {
    let before = node.counters().events(Event::FrameShown);
    tokio::time::sleep(time).await;
    node.counters().events(Event::FrameShown) - before
}

async fn sees_objects(page: SocketAddr) {
    until("objects are on the map", || async {
        let picture = get(page, "/api/picture").await.json();
        picture["map"]["message"]["objects"]
            .as_array()
            .is_some_and(|objects| objects.len() >= 2)
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn pictures_need_viewers() {
    let directory = tempfile::tempdir().unwrap();
    let (node, page) = start(seeing(directory.path())).await;
    sees_objects(page).await;
    assert_eq!(
        node.counters().events(Event::FrameShown),
        0,
        "without a viewer"
    );

    let mut pictures = Events::open_at(page, "/api/camera").await;
    let picture = pictures.next().await;
    let jpeg = BASE64_STANDARD
        .decode(picture["jpeg"].as_str().unwrap())
        .unwrap();
    let image = image_codec::decode(&jpeg).unwrap();
    assert!(image.cols() > 0 && image.cols() <= 640);
    let boxes = picture["boxes"].as_array().unwrap();
    assert_eq!(
        boxes.iter().map(|seen| &seen["label"]).collect::<Vec<_>>(),
        ["person", "cat", "dragon"]
    );
    for (seen, places) in boxes.iter().zip([true, true, false]) {
        assert_eq!(seen["object"]["x_m"].is_f64(), places, "{seen}");
    }
    for (edge, wanted) in boxes[0]["edges"]
        .as_array()
        .unwrap()
        .iter()
        .zip([0.3, 0.3, 0.4, 0.6])
    {
        assert!(
            (edge.as_f64().unwrap() - wanted).abs() < 1e-6,
            "{}",
            boxes[0]
        );
    }
    let begun = Instant::now();
    let shown = shown_after(&node, Duration::from_secs(2)).await as f64;
    assert!(
        shown >= 1.0 && shown <= 5.0 * begun.elapsed().as_secs_f64() + 1.0,
        "{shown}"
    );

    drop(pictures);
    until("no more are made", || async {
        shown_after(&node, Duration::from_millis(600)).await == 0
    })
    .await;
    node.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn hidden_camera_is_not_served() {
    let directory = tempfile::tempdir().unwrap();
    let mut private = seeing(directory.path());
    private.dashboard.camera = false;
    let (node, page) = start(private).await;
    sees_objects(page).await;
    assert_eq!(get(page, "/api/camera").await.status, 404);
    assert_eq!(crate::mount::ask(page, "", &[]).await.status, 404);
    assert_eq!(
        get(page, "/api/picture").await.json()["node"]["camera"],
        false
    );
    assert_eq!(node.counters().events(Event::FrameShown), 0);
    node.stop().await;
}

/// The picture is on the page with its boxes; a box and its object on the map light up together, either way.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs Chromium: make test-dashboard"]
async fn box_and_object_highlight_together() {
    let shots = shots();
    let directory = tempfile::tempdir().unwrap();
    let (node, page) = start(seeing(directory.path())).await;
    sees_objects(page).await;
    let browser = Browser::start().await;
    browser.look(1440, 900, "light").await;
    browser.open(&format!("http://{page}/")).await;
    browser
        .until("document.querySelectorAll('#camera-boxes button').length === 3")
        .await;
    browser
        .until("document.querySelector('#camera').getContext('2d').getImageData(200, 200, 1, 1).data[3] === 255")
        .await;
    browser
        .until("document.querySelectorAll('#map .ellipse').length >= 2")
        .await;
    let words = "[...document.querySelectorAll('#camera-boxes button')].map((box) => box.textContent).join()";
    assert_eq!(
        browser.evaluate(words).await,
        "person 87 %,cat 87 %,dragon 87 %"
    );
    assert_eq!(
        browser
            .evaluate("document.querySelector('#camera-name').hidden")
            .await,
        true,
        "there is one camera"
    );
    let lit_labels = "[...document.querySelectorAll('#map g.lit')].map((it) => it.getAttribute('aria-label').split(',')[0]).join()";
    let lit_boxes =
        "[...document.querySelectorAll('#camera-boxes .lit')].map((it) => it.textContent).join()";

    browser.point_at("#camera-boxes button:nth-child(2)").await;
    browser
        .until(&format!(
            "{lit_labels} === 'cat' && {lit_boxes} === 'cat 87 %'"
        ))
        .await;
    for (name, width, scheme) in [
        ("camera-light", 1440, "light"),
        ("camera-dark", 1440, "dark"),
        ("camera-phone", 390, "light"),
    ] {
        browser.look(width, 900, scheme).await;
        browser
            .evaluate("document.querySelector('#camera-card').scrollIntoView({ block: 'center' })")
            .await;
        // The mouse may leave a box as the layout changes, and take the light away.
        let focus = "((box) => (box.blur(), box.focus()))(document.querySelector('#camera-boxes button:nth-child(2)'))";
        browser
            .until(&format!("({focus}, {lit_boxes} === 'cat 87 %')"))
            .await;
        tokio::time::sleep(Duration::from_secs(1)).await;
        browser.screenshot(&shots.join(format!("{name}.png"))).await;
        browser.fits_the_width(name).await;
    }
    browser.look(1440, 900, "light").await;
    browser
        .evaluate("(document.activeElement.blur(), window.scrollTo(0, 0))")
        .await;
    browser.point_at("#camera-title").await;
    browser.until(&format!("{lit_boxes} === ''")).await;
    browser
        .evaluate("document.querySelector('#map g[aria-label^=person] .ellipse').id = 'person'")
        .await;
    browser.point_at("#person").await;
    browser
        .until(&format!(
            "{lit_labels} === 'person' && {lit_boxes} === 'person 87 %'"
        ))
        .await;
    browser.quit_without_complaints().await;
    until("no more are made", || async {
        shown_after(&node, Duration::from_millis(600)).await == 0
    })
    .await;
    node.stop().await;
}

/// Each camera has separate pictures, which are made only while a reader views that camera.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn camera_name_selects_pictures() {
    let directory = tempfile::tempdir().unwrap();
    let (node, page) = start(seeing_both_ways(directory.path())).await;
    assert_eq!(
        get(page, "/api/picture").await.json()["node"]["cameras"],
        serde_json::json!([null, "rear"])
    );
    for (path, expected) in [
        ("/api/camera", ["person", "cat", "dragon"].as_slice()),
        ("/api/camera?name=rear", &["dog"]),
    ] {
        let picture = Events::open_at(page, path).await.next().await;
        let boxes = picture["boxes"].as_array().unwrap();
        assert_eq!(
            boxes.iter().map(|seen| &seen["label"]).collect::<Vec<_>>(),
            expected,
            "{path}"
        );
        assert!(boxes[0]["object"]["x_m"].is_f64(), "{path}");
    }
    let refused = get(page, "/api/camera?name=left").await;
    assert_eq!(
        (refused.status, &*refused.body),
        (404, "no camera \"left\": there are rear\n")
    );

    let _looks = Events::open_at(page, "/api/camera?name=rear").await;
    let begun = Instant::now();
    let shown = shown_after(&node, Duration::from_secs(2)).await as f64;
    assert!(
        shown >= 1.0 && shown <= 5.0 * begun.elapsed().as_secs_f64() + 2.0,
        "{shown}, of one camera alone"
    );
    node.stop().await;
}

/// One connection carries the pictures of all cameras, also of another node of the process, until that node's cameras
/// change.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn all_pictures_share_connection() {
    let directory = tempfile::tempdir().unwrap();
    let (node, page) = start(seeing_both_ways(&directory.path().join("euclid"))).await;
    let (other, _) = start(gauss(directory.path())).await;
    node.show_cameras(other.cameras().to_vec());
    let names = ["euclid", "euclid--rear", "gauss"];
    let facts = get(page, "/api/picture").await.json();
    assert_eq!(facts["node"]["pictures"], serde_json::json!(names));
    assert_eq!(facts["node"]["cameras"], serde_json::json!([null, "rear"]));

    let mut pictures = Events::open_at(page, "/api/cameras").await;
    let mut first_labels = BTreeMap::new();
    while first_labels.len() < names.len() {
        let picture = pictures.next().await;
        first_labels.insert(
            pictures.id.clone(),
            picture["boxes"][0]["label"].as_str().unwrap().to_owned(),
        );
    }
    let wanted = names.into_iter().zip(["person", "dog", "horse"]);
    assert!(
        first_labels
            .iter()
            .map(|(name, label)| (&**name, &**label))
            .eq(wanted),
        "{first_labels:?}"
    );
    let mut rear = Events::open_at(page, "/api/cameras?of=euclid--rear").await;
    for _ in 0..3 {
        rear.next().await;
        assert_eq!(rear.id, "euclid--rear");
    }
    assert_eq!(get(page, "/api/cameras?of=kepler").await.status, 404);

    node.show_cameras(Vec::new());
    let ended = async { while pictures.next_or_end().await.is_some() {} };
    tokio::time::timeout(PATIENCE, ended)
        .await
        .expect("pictures of a node that is not shown any more");
    other.stop().await;
    node.stop().await;
}

/// A vehicle that detects a horse.
fn gauss(directory: &Path) -> NodeConfig {
    let camera = camera(
        &directory.join("gauss"),
        "chelsea",
        &[("horse", [0.45, 0.5, 0.55, 0.7])],
    );
    NodeConfig {
        camera: Some(camera),
        ..config("gauss", Role::Auto, 0)
    }
}

/// The wall shows the pictures of all cameras with their boxes, which light up with the objects of their vehicles. A
/// camera is shown alone by its name. Points for its mount are its own.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs Chromium: make test-dashboard"]
async fn wall_shows_all_cameras() {
    let shots = shots();
    let directory = tempfile::tempdir().unwrap();
    let (node, page) = start(seeing_both_ways(&directory.path().join("euclid"))).await;
    let mut other = gauss(directory.path());
    other.pose.y_m = -6.0;
    let (other, other_page) = join(other, &node).await;
    sees_objects(page).await;
    let browser = Browser::start().await;
    browser.look(1440, 900, "light").await;
    browser.open(&format!("http://{page}/")).await;
    node.show_cameras(other.cameras().to_vec());
    let wall = "[...document.querySelectorAll('#camera-wall figure')].map((it) => [it.querySelector('figcaption button').textContent, \
        ...[...it.querySelectorAll('.boxes button')].map((box) => box.textContent)].join(' ')).join()";
    let all = "euclid person 87 % cat 87 % dragon 87 %,euclid--rear dog 87 %,gauss horse 87 %";
    browser.until(&format!("{wall} === '{all}'")).await;
    let is_drawn = "[...document.querySelectorAll('#camera-wall canvas')].every((it) => it.getContext('2d').getImageData(200, 200, 1, 1).data[3] === 255)";
    browser.until(is_drawn).await;
    let names =
        "[...document.querySelector('#camera-name').options].map((option) => option.text).join()";
    assert_eq!(
        browser.evaluate(names).await,
        "All cameras,euclid,euclid--rear,gauss"
    );
    let lit = "[...document.querySelectorAll('#map g.lit')].map((it) => it.getAttribute('aria-label').split(',')[0]).join()";
    for (figure, label) in [(2, "dog"), (3, "horse")] {
        browser
            .until(&format!(
                "document.querySelectorAll('#map g[aria-label^={label}]').length === 1"
            ))
            .await;
        browser
            .point_at(&format!(
                "#camera-wall figure:nth-child({figure}) .boxes button"
            ))
            .await;
        browser
            .until(&format!(
                "{lit} === '{label}' && document.querySelectorAll('#camera-wall .lit').length === 1"
            ))
            .await;
    }
    browser.point_at("#camera-title").await;
    for (name, width, scheme) in [
        ("wall-light", 1440, "light"),
        ("wall-dark", 1440, "dark"),
        ("wall-phone", 390, "light"),
    ] {
        browser.look(width, 900, scheme).await;
        browser
            .evaluate("document.querySelector('#camera-card').scrollIntoView({ block: 'center' })")
            .await;
        tokio::time::sleep(Duration::from_secs(1)).await;
        browser.screenshot(&shots.join(format!("{name}.png"))).await;
        browser.fits_the_width(name).await;
    }
    browser.look(1440, 900, "light").await;
    browser
        .evaluate("document.querySelector('#camera-card').scrollIntoView({ block: 'center' })")
        .await;

    // The mount of the node's first camera, and then of its second.
    let words = "[...document.querySelectorAll('#camera-boxes button')].map((box) => box.textContent).join()";
    let rows =
        |count: usize| format!("document.querySelectorAll('#mount-rows tr').length === {count}");
    let choose = |index: usize| {
        format!(
            "((chooser) => (chooser.selectedIndex = {index}, chooser.dispatchEvent(new Event('change'))))\
             (document.querySelector('#camera-name'))"
        )
    };
    browser
        .evaluate("document.querySelector('#mount').click()")
        .await;
    browser
        .until(&format!("{words} === 'person 87 %,cat 87 %,dragon 87 %'"))
        .await;
    browser.click_within("#camera", [0.5, 0.9]).await;
    browser.until(&rows(1)).await;
    browser.evaluate(&choose(2)).await;
    browser
        .until(&format!("{words} === 'dog 87 %' && {}", rows(0)))
        .await;
    browser.evaluate(&choose(1)).await;
    browser
        .until(&format!(
            "{words} === 'person 87 %,cat 87 %,dragon 87 %' && {}",
            rows(1)
        ))
        .await;

    // Another node's camera has its mount on that node's page.
    browser.evaluate(&choose(0)).await;
    browser
        .until("document.querySelector('#mount-points').hidden && !document.querySelector('#camera-wall').hidden")
        .await;
    browser
        .evaluate(
            "document.querySelector('#camera-wall figure:nth-child(3) figcaption button').click()",
        )
        .await;
    browser
        .until(&format!(
            "{words} === 'horse 87 %' && document.querySelector('#mount').disabled"
        ))
        .await;
    node.show_cameras(Vec::new());
    browser
        .until(&format!(
            "document.querySelectorAll('#camera-wall figure').length === 2 \
             && document.querySelector('#camera-pages a')?.href === 'http://{other_page}/' \
             && document.querySelector('#camera-pages').checkVisibility()"
        ))
        .await;
    browser
        .until(&format!(
            "{wall} === 'euclid person 87 % cat 87 % dragon 87 %,euclid--rear dog 87 %'"
        ))
        .await;
    browser.quit_without_complaints().await;
    until("no more are made", || async {
        shown_after(&node, Duration::from_millis(600)).await == 0
    })
    .await;
    other.stop().await;
    node.stop().await;
}

/// Directory of the pictures that tests of the page leave.
pub(crate) fn shots() -> PathBuf {
    let shots = Path::new(env!("CARGO_TARGET_TMPDIR"))
        .parent()
        .unwrap()
        .join("dashboard");
    std::fs::create_dir_all(&shots).unwrap();
    shots
}
