//! The map as people use it: fit, details, trails, explained terms, and the floor plan.

use std::path::{Path, PathBuf};
use std::time::Duration;

use ecod::model::names::NodeName;
use ecod::model::origin::GeographicOrigin;
use ecod::tracking::TracksMode;
use ecod::wire::{Encoding, FieldOfView, ObjectReport, PerceivedObject, Role, WirePose, encode};
use ecod_actors::node;
use ecod_actors::node::config::NodeConfig;
use ecod_actors::observe::dashboard::{FloorPlanConfig, FloorPlanPoint};
use ecod_actors::platform::clock;
use ecod_testkit::until_async as until;
use rumqttc::{AsyncClient, MqttOptions, QoS};
use tokio::task::JoinSet;

use crate::cell::{config, start};
use crate::http::get;
use crate::webdriver::Browser;

fn tracking(landmarks: usize) -> NodeConfig {
    let mut config = config("euclid", Role::Auto, landmarks);
    config.fusion.tracks.mode = TracksMode::On;
    config
}

fn object(label: &str, x_m: f64, y_m: f64, sigma_m: f64) -> PerceivedObject {
    let variance = sigma_m * sigma_m;
    let covariance_m2 = Some([variance, 0.0, variance]);
    PerceivedObject {
        covariance_m2,
        ..PerceivedObject::new(label, 0.9, x_m, y_m)
    }
}

/// A cup that two vehicles see, a dog that walks and only galileo sees, and a boat far away.
fn watch(broker: std::net::SocketAddr) -> JoinSet<()> {
    let mut vehicles = JoinSet::new();
    for (name, x_m) in [("galileo", -4.0), ("gauss", 6.0)] {
        vehicles.spawn(async move {
            let options = MqttOptions::new(name, broker.ip().to_string(), broker.port());
            let (client, mut events) = AsyncClient::new(options, 16);
            let mut ticks = tokio::time::interval(Duration::from_millis(100));
            for seq in 1.. {
                while tokio::select! { _ = events.poll() => true, _ = ticks.tick() => false } {}
                let walked_m = 3.0 * (clock::now().micros() as f64 / 1e6 * 0.4).sin();
                let mut objects = vec![object("cup", 1.0, 1.0, 0.1)];
                if name == "galileo" {
                    objects.extend([
                        object("dog", 3.0 + walked_m, -1.0, 0.1),
                        object("boat", 600.0, 200.0, 20.0),
                    ]);
                }
                let pose = Some(WirePose::new(x_m, 0.0, 0.0));
                let node = NodeName::from_static(name);
                let report = ObjectReport {
                    pose,
                    objects,
                    ..ObjectReport::new(node, seq, clock::now())
                };
                let topic = format!("ecod/v1/lot/detections/{name}");
                // An absent broker receives no messages.
                let _ = client.try_publish(
                    topic,
                    QoS::AtMostOnce,
                    false,
                    encode(&report, Encoding::Json),
                );
            }
        });
    }
    vehicles
}

const WIDTH: &str = "(([...all]) => { const xs = all.map((place) => Number(place.getAttribute('x'))); \
    return Math.max(...xs) - Math.min(...xs); })(document.querySelectorAll('#map .place'))";

const DETAILS: &str = "(document.querySelector('#map-details').hidden ? '' : document.querySelector('#map-details').innerText.replaceAll('\\n', ' '))";

fn shots() -> PathBuf {
    let shots = Path::new(env!("CARGO_TARGET_TMPDIR"))
        .parent()
        .unwrap()
        .join("dashboard");
    std::fs::create_dir_all(&shots).unwrap();
    shots
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs Chromium: make test-dashboard"]
async fn far_object_is_indicated() {
    let (node, page) = start(tracking(12)).await;
    let _vehicles = watch(node.broker_address().unwrap());
    let browser = Browser::start().await;
    browser.look(1280, 800, "light").await;
    browser.open(&format!("http://{page}/")).await;
    let all = ["dog", "cup", "boat", "galileo"]
        .map(|it| format!("document.querySelector('#map g[aria-label^={it}]') !== null"));
    browser.until(&all.join(" && ")).await;

    // The fit.
    browser
        .until("/^boat, 6[0-9][0-9] m$/.test(document.querySelector('#map text.cue')?.textContent)")
        .await;
    browser
        .until(&format!("{WIDTH} > 300 && document.querySelector('#map-outside').textContent.startsWith('1 outside')"))
        .await;
    let fill = "getComputedStyle(document.querySelector('#map g[aria-label^=boat] .ellipse')).fill";
    assert_eq!(
        browser.evaluate(fill).await,
        "none",
        "an ellipse over the whole map does not cover it"
    );
    browser.click("#map-outside").await;
    browser
        .until(&format!(
            "{WIDTH} < 30 && document.querySelector('#map-outside').hidden"
        ))
        .await;
    browser
        .evaluate("document.querySelector('#fit').click()")
        .await;
    browser.until(&format!("{WIDTH} > 300")).await;

    // Details of the object at the pointer.
    browser
        .evaluate("document.querySelector('#map g[aria-label^=cup] .centre').id = 'cup'")
        .await;
    browser.point_at("#cup").await;
    browser
        .until(&format!("/^cup .*Seen by galileo, gauss /.test({DETAILS})"))
        .await;
    browser.point_at("#map-title").await;
    browser.until(&format!("{DETAILS} === ''")).await;

    // By keys.
    browser
        .evaluate("document.querySelector('#map').focus()")
        .await;
    let at = "document.activeElement.getAttribute('aria-label')";
    for _ in 0..8 {
        browser.press("Tab").await;
        if browser.evaluate(&format!("{at}?.startsWith('dog')")).await == true {
            break;
        }
    }
    assert!(
        browser
            .evaluate(at)
            .await
            .as_str()
            .unwrap()
            .ends_with("seen only by galileo")
    );
    let fact = |what: &str| format!("/{what}/.test({DETAILS})");
    for what in [
        "^dog .*Seen only by galileo ",
        "Confidence [0-9]+ % Existence [0-9]+ % Last seen now",
        "Speed ([0-9.]+ m.s to the (east|west)|stands)",
        "Position [0-9.]+ m (east|west), [01].[0-9]+ m south Spread ± [0-9.]+ m × [0-9.]+ m",
    ] {
        browser.until(&fact(what)).await;
    }
    browser.press("Enter").await;
    browser.evaluate("document.activeElement.blur()").await;
    browser
        .until("document.querySelector('#map-details').classList.contains('kept')")
        .await;
    for (name, width, scheme) in [
        ("map-light", 1280, "light"),
        ("map-dark", 1280, "dark"),
        ("map-phone", 390, "light"),
    ] {
        browser
            .look(width, if width < 600 { 844 } else { 800 }, scheme)
            .await;
        browser
            .evaluate("document.querySelector('#map-frame').scrollIntoView({ block: 'center' })")
            .await;
        browser.until(&fact("^dog ")).await;
        browser
            .screenshot(&shots().join(format!("{name}.png")))
            .await;
        browser.fits_the_width(name).await;
    }
    browser.look(1280, 800, "light").await;
    browser
        .evaluate("document.querySelector('#map').focus()")
        .await;
    browser.press("Escape").await;
    browser.until(&format!("{DETAILS} === ''")).await;
    browser
        .evaluate("document.querySelector('#map g[aria-label^=gauss] .body').id = 'gauss'")
        .await;
    browser.click("#gauss").await;
    browser.point_at("#map-title").await;
    browser
        .until(&fact(
            "^gauss .*Last report now .*Sees 1 object Position 6.00 m east",
        ))
        .await;
    browser.click("#details-close").await;
    browser.until(&format!("{DETAILS} === ''")).await;

    // Trails: of the dog, and not of the cup.
    let pieces = "document.querySelectorAll('#map .trail').length";
    browser
        .until(&format!("{pieces} >= 3 && {pieces} <= 4"))
        .await;
    let earlier = "(({ min }) => (document.querySelector('#timeline-cursor').value = min, \
        document.querySelector('#timeline-cursor').dispatchEvent(new Event('input'))))(document.querySelector('#timeline-cursor'))";
    browser.evaluate(earlier).await;
    browser.until(&format!("{pieces} === 0")).await;
    browser
        .evaluate("document.querySelector('#timeline-live').click()")
        .await;
    browser.until(&format!("{pieces} >= 3")).await;
    browser.quit_without_complaints().await;
    node.stop().await;
}

/// A vehicle that reports some objects at each tick, and further ones during its first second.
fn report(
    broker: std::net::SocketAddr,
    always: Vec<PerceivedObject>,
    at_first: Vec<PerceivedObject>,
) -> JoinSet<()> {
    let mut vehicles = JoinSet::new();
    vehicles.spawn(async move {
        let options = MqttOptions::new("galileo", broker.ip().to_string(), broker.port());
        let (client, mut events) = AsyncClient::new(options, 16);
        let mut ticks = tokio::time::interval(Duration::from_millis(100));
        for seq in 1.. {
            while tokio::select! { _ = events.poll() => true, _ = ticks.tick() => false } {}
            let mut objects = always.clone();
            if seq <= 10 {
                objects.extend(at_first.clone());
            }
            let report = ObjectReport {
                pose: Some(WirePose::new(-4.0, 0.0, 0.0)),
                objects,
                view: Some(FieldOfView {
                    range_m: 20.0,
                    angle_rad: 2.0,
                }),
                ..ObjectReport::new(NodeName::from_static("galileo"), seq, clock::now())
            };
            // An absent broker receives no messages.
            let _ = client.try_publish(
                "ecod/v1/lot/detections/galileo",
                QoS::AtMostOnce,
                false,
                encode(&report, Encoding::Json),
            );
        }
    });
    vehicles
}

/// An object that is not detected any more becomes pale, leaves the fit, and is hidden, which a button undoes.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs Chromium: make test-dashboard"]
async fn unsure_object_fades_and_hides() {
    let mut patient = tracking(0);
    patient.fusion.tracks.life_s = 60.0;
    patient.fusion.tracks.latent_s = 60.0;
    let (node, page) = start(patient).await;
    let browser = Browser::start().await;
    browser.look(1280, 800, "light").await;
    browser.open(&format!("http://{page}/")).await;
    browser
        .until("document.querySelector('#leader').textContent === 'euclid'")
        .await;
    let _vehicle = report(
        node.broker_address().unwrap(),
        vec![object("cup", 2.0, 1.0, 0.1), object("dog", 4.0, -2.0, 0.1)],
        vec![object("ghost", 80.0, 30.0, 0.1)],
    );
    let ghost = "document.querySelector('#map g[aria-label^=ghost]')";
    let is_pale = format!("{ghost}?.classList.contains('unsure')");
    browser
        .until(&format!("{ghost} !== null && !{is_pale}"))
        .await;
    browser
        .until(&format!(
            "{is_pale} && {ghost}.getAttribute('aria-label').includes('unsure')"
        ))
        .await;
    browser.screenshot(&shots().join("unsure-pale.png")).await;
    let button = "document.querySelector('#map-unsure')";
    browser
        .until(&format!(
            "{ghost} === null && {button}.textContent === '1 unsure object hidden, show' && !{button}.hidden"
        ))
        .await;
    let width = "(([cup, dog]) => Math.hypot(cup.getAttribute('cx') - dog.getAttribute('cx'), cup.getAttribute('cy') - dog.getAttribute('cy')))\
        (['cup', 'dog'].map((it) => document.querySelector(`#map g[aria-label^=${it}] .centre`)))";
    browser.until(&format!("{width} > 100")).await;
    let described = "document.querySelector('#map').getAttribute('aria-label')";
    let described = browser.evaluate(described).await;
    assert!(
        described
            .as_str()
            .unwrap()
            .ends_with("without 1 unsure object"),
        "{described}"
    );
    for (name, size, scheme) in [
        ("unsure-light", 1280, "light"),
        ("unsure-dark", 1280, "dark"),
        ("unsure-phone", 390, "light"),
    ] {
        browser.look(size, 844, scheme).await;
        browser
            .screenshot(&shots().join(format!("{name}.png")))
            .await;
        browser.fits_the_width(name).await;
    }
    browser.look(1280, 800, "light").await;
    browser.click("#map-unsure").await;
    browser
        .until(&format!(
            "{is_pale} && {button}.textContent === '1 unsure object shown, hide' && {button}.ariaPressed === 'true'"
        ))
        .await;
    assert!(
        browser.evaluate(width).await.as_f64().unwrap() > 100.0,
        "the map stays as it was fitted"
    );
    browser
        .until("/^ghost, [0-9]+ m$/.test(document.querySelector('#map text.cue')?.textContent)")
        .await;
    browser.quit_without_complaints().await;
    node.stop().await;
}

/// Labels of a crowd are apart, and the label of a surer object takes the only place.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs Chromium: make test-dashboard"]
async fn labels_do_not_overlap() {
    let (node, page) = start(tracking(0)).await;
    let labels = ["WAGGON", "ill", "bicycle", "person", "sports ball", "MMM"];
    let crowd = (0..60)
        .map(|index| {
            let x_m = f64::from(index % 10) * 0.9 + 0.3 * f64::from(index / 10);
            let y_m = f64::from(index / 10) * 0.9 - 2.0;
            object(labels[index as usize % labels.len()], x_m, y_m, 0.05)
        })
        .collect();
    let _vehicle = report(node.broker_address().unwrap(), crowd, Vec::new());
    let browser = Browser::start().await;
    browser.look(1280, 800, "light").await;
    browser.open(&format!("http://{page}/")).await;
    browser
        .until("document.querySelectorAll('#map .ellipse').length >= 60")
        .await;
    let overlaps = "((areas) => areas.flatMap((a, i) => areas.slice(i + 1).filter((b) => \
        a.x + 1 < b.x + b.width && b.x + 1 < a.x + a.width && a.y + 1 < b.y + b.height && b.y + 1 < a.y + a.height).map((b) => `${a.words} and ${b.words}`)))\
        ([...document.querySelectorAll('#map text')].filter((it) => it.textContent).map((it) => { \
            const { x, y, width, height } = it.getBoundingClientRect(); return { x, y, width, height, words: it.textContent }; }))";
    let shown = "document.querySelectorAll('#map text').length";
    for (name, size) in [("labels", 1280), ("labels-phone", 390)] {
        browser.look(size, 844, "light").await;
        browser.until(&format!("{shown} >= 10")).await;
        assert_eq!(
            browser.evaluate(overlaps).await,
            serde_json::json!([]),
            "{name}"
        );
        browser
            .screenshot(&shots().join(format!("{name}.png")))
            .await;
    }
    let placed = "import('/labels.js').then(({ Labels }) => { \
        const labels = new Labels(); labels.begin({ width: 90, height: 20 }, document.body); \
        for (const [key, rank] of [['pale', 1.4], ['sure', 1.9], ['hidden', 1.1]]) labels.put({ key, rank, words: 'a long label', x: 2, y: 10, gap: 4, style: '' }); \
        labels.place(); return labels.placed.map((label) => label.key).join(); })";
    assert_eq!(browser.evaluate(placed).await, "sure");
    browser.quit_without_complaints().await;
    node.stop().await;
}

/// The pointer shows its position in the frame and on Earth; the arrow points to north in a frame that is turned.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs Chromium: make test-dashboard"]
async fn pointer_shows_position_on_earth() {
    let origin = GeographicOrigin {
        latitude_deg: 52.2297,
        longitude_deg: 21.0122,
        height_m: 110.0,
        rotation_deg: 30.0,
    };
    let mut located = tracking(12);
    located.origin = Some(origin);
    let far = located.landmarks[11].clone();
    let (node, page) = start(located).await;
    let browser = Browser::start().await;
    browser.look(1280, 800, "light").await;
    browser.open(&format!("http://{page}/")).await;
    browser
        .until("document.querySelectorAll('#map .place').length === 12")
        .await;
    let readout = "document.querySelector('#map-at').textContent";
    assert_eq!(
        browser.evaluate(readout).await,
        "Point at the map for coordinates"
    );
    browser
        .evaluate("document.querySelectorAll('#map rect.place')[11].id = 'far'")
        .await;
    browser.point_at("#far").await;
    browser.until(&format!("{readout}.startsWith('x ')")).await;
    let words = browser.evaluate(readout).await;
    let words = words.as_str().unwrap();
    let numbers: Vec<f64> = words
        .split(|letter: char| !(letter.is_ascii_digit() || ".-".contains(letter)))
        .filter_map(|number| number.parse().ok())
        .collect();
    let expected = origin.to_wgs84(far.x_m, far.y_m, 0.0);
    let wanted = [
        (far.x_m, 0.1),
        (far.y_m, 0.1),
        (expected.latitude_deg, 2e-6),
        (expected.longitude_deg, 2e-6),
    ];
    assert_eq!(numbers.len(), 4, "{words}");
    for (number, (wanted, tolerance)) in numbers.iter().zip(wanted) {
        assert!((number - wanted).abs() < tolerance, "{words}: {wanted}");
    }
    let far_away = "import('/earth.js').then(({ onEarth }) => onEarth({ x_m: 4000, y_m: -3000 }, \
        { latitude_deg: 52.2297, longitude_deg: 21.0122, height_m: 110, rotation_deg: 30 }))";
    let far_away: [f64; 2] = serde_json::from_value(browser.evaluate(far_away).await).unwrap();
    let expected = origin.to_wgs84(4000.0, -3000.0, 0.0);
    assert!(
        (far_away[0] - expected.latitude_deg).abs() < 1e-8,
        "{far_away:?}"
    );
    assert!(
        (far_away[1] - expected.longitude_deg).abs() < 1e-8,
        "{far_away:?}"
    );
    browser
        .until("document.querySelector('#map .north path').getAttribute('transform').endsWith('rotate(30.0)')")
        .await;
    browser
        .until(&format!(
            "/On Earth 52\\.[0-9]+° N, 21\\.[0-9]+° E/.test({DETAILS})"
        ))
        .await;
    for (name, size) in [("earth", 1280), ("earth-phone", 390)] {
        browser.look(size, 800, "light").await;
        browser
            .screenshot(&shots().join(format!("{name}.png")))
            .await;
        browser.fits_the_width(name).await;
    }
    browser.look(1280, 800, "light").await;
    let scale = "document.querySelector('#map text.scale').textContent";
    browser
        .until(&format!("/^[125]0* (m|cm)$/.test({scale})"))
        .await;
    browser.point_at("#map-title").await;
    browser
        .until(&format!("{readout} === 'Point at the map for coordinates'"))
        .await;
    browser.quit_without_complaints().await;
    node.stop().await;
}

/// Explanations of terms are available by pointer, by keyboard, and by screen reader.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs Chromium: make test-dashboard"]
async fn terms_are_explained() {
    let (node, page) = start(config("euclid", Role::Auto, 4)).await;
    let browser = Browser::start().await;
    browser.look(390, 844, "light").await;
    browser.open(&format!("http://{page}/")).await;
    browser
        .until("document.querySelector('#leader').textContent === 'euclid'")
        .await;
    let terms = "[...document.querySelectorAll('[data-term]')]";
    let sentences_shown = format!(
        "{terms}.map((it) => document.getElementById(it.getAttribute('aria-describedby')).textContent)"
    );
    let sentences_shown: Vec<String> =
        serde_json::from_value(browser.evaluate(&sentences_shown).await).unwrap();
    assert!(sentences_shown.len() >= 13, "{sentences_shown:?}");
    for sentences in &sentences_shown {
        let longest = sentences
            .split(". ")
            .map(|sentence| sentence.split_whitespace().count())
            .max()
            .unwrap();
        assert!((5..=25).contains(&longest), "{sentences}");
    }
    let tip =
        "(document.querySelector('#tip').hidden ? '' : document.querySelector('#tip').textContent)";
    for (index, words) in sentences_shown.iter().enumerate() {
        if browser
            .evaluate(&format!("{terms}[{index}].checkVisibility()"))
            .await
            == false
        {
            continue;
        }
        browser
            .evaluate(&format!(
                "{terms}[{index}].scrollIntoView({{ block: 'center' }})"
            ))
            .await;
        tokio::time::sleep(Duration::from_millis(50)).await;
        browser
            .evaluate(&format!(
                "{terms}[{index}].focus({{ preventScroll: true }})"
            ))
            .await;
        assert_eq!(browser.evaluate(tip).await, words.as_str());
        let is_inside = "(({ left, top, right, bottom }) => left >= 0 && top >= 0 && right <= innerWidth && bottom <= innerHeight)\
            (document.querySelector('#tip').getBoundingClientRect())";
        assert_eq!(browser.evaluate(is_inside).await, true, "{words}");
        browser.press("Escape").await;
        assert_eq!(browser.evaluate(tip).await, "");
    }
    browser
        .evaluate("(document.activeElement.blur(), scrollTo(0, 0))")
        .await;
    // The page hides it while it scrolls, as it may still do.
    until("the term is explained", || async {
        browser.point_at("#cell").await;
        browser.point_at("[data-term=latency]").await;
        browser
            .evaluate(&format!("{tip}.startsWith('Time from the oldest picture')"))
            .await
            == true
    })
    .await;
    browser.screenshot(&shots().join("term.png")).await;
    browser.point_at("#cell").await;
    browser.until(&format!("{tip} === ''")).await;
    browser.quit_without_complaints().await;
    node.stop().await;
}

/// A picture of 800 × 400 pixels with 20 pixels for a metre; place 0 of the cell is at column 200, row 120.
#[cfg(feature = "camera")]
fn with_plan(directory: &Path) -> NodeConfig {
    use opencv::core::{CV_8UC3, Mat, Point, Scalar};
    use opencv::imgproc;
    let mut plan = Mat::new_rows_cols_with_default(400, 800, CV_8UC3, Scalar::all(250.0)).unwrap();
    let ink = Scalar::new(80.0, 60.0, 40.0, 0.0);
    for [left, top, right, bottom] in [[4, 4, 796, 396], [170, 60, 560, 140], [170, 260, 560, 340]]
    {
        let from = Point::new(left, top);
        let to = Point::new(right, bottom);
        let area = opencv::core::Rect::from_points(from, to);
        imgproc::rectangle(&mut plan, area, ink, 4, imgproc::LINE_8, 0).unwrap();
    }
    let image = directory.join("plan.jpg");
    std::fs::write(
        &image,
        ecod_actors::camera::image_codec::encode_jpeg(&plan, 95).unwrap(),
    )
    .unwrap();
    let point = |pixel, position_m| FloorPlanPoint { pixel, position_m };
    let points = [
        point([200.0, 120.0], [0.0, 4.0]),
        point([500.0, 280.0], [15.0, -4.0]),
    ];
    let mut config = tracking(12);
    config.dashboard.floor_plan = Some(FloorPlanConfig { image, points });
    config
}

#[cfg(feature = "camera")]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs Chromium: make test-dashboard"]
async fn floor_plan_lies_under_map() {
    let directory = tempfile::tempdir().unwrap();
    let (node, page) = start(with_plan(directory.path())).await;
    let answer = get(page, "/api/floor_plan").await;
    assert_eq!(
        (answer.status, answer.header("content-type")),
        (200, Some("image/jpeg"))
    );
    let _vehicles = watch(node.broker_address().unwrap());
    let browser = Browser::start().await;
    browser.look(1280, 800, "light").await;
    browser.open(&format!("http://{page}/")).await;
    browser
        .until("document.querySelectorAll('#map .place').length === 12")
        .await;
    browser
        .until("document.querySelector('#map image')?.getAttribute('width') === '800'")
        .await;
    browser
        .until("document.querySelector('#map g[aria-label^=dog]') !== null")
        .await;
    // Slots 0 and 11 at their pixels of the plan.
    for (index, column, row) in [(0, 200, 120), (11, 500, 280)] {
        let apart = format!(
            "(({{ x, y }}, place) => Math.hypot(x - place.getAttribute('x') - 5.5, y - place.getAttribute('y') - 5.5))\
             (new DOMPoint({column}, {row}).matrixTransform(document.querySelector('#map image').transform.baseVal[0].matrix), \
             document.querySelectorAll('#map .place')[{index}])"
        );
        assert!(
            browser.evaluate(&apart).await.as_f64().unwrap() < 0.5,
            "{index}"
        );
    }
    let shown = browser
        .evaluate(
            "(({ width }) => width)(document.querySelector('#map image').getBoundingClientRect())",
        )
        .await;
    let panel = browser
        .evaluate("document.querySelector('#map').getBoundingClientRect().width")
        .await;
    let share = shown.as_f64().unwrap() / panel.as_f64().unwrap();
    assert!(
        share > 0.8 && share <= 1.0,
        "the plan fills {share} of the panel"
    );
    for (name, width, scheme) in [
        ("plan-light", 1280, "light"),
        ("plan-dark", 1280, "dark"),
        ("plan-phone", 390, "light"),
    ] {
        browser
            .look(width, if width < 600 { 844 } else { 800 }, scheme)
            .await;
        browser
            .evaluate("document.querySelector('#map-frame').scrollIntoView({ block: 'center' })")
            .await;
        browser
            .screenshot(&shots().join(format!("{name}.png")))
            .await;
    }
    browser.quit_without_complaints().await;
    node.stop().await;
}

/// A node whose floor plan cannot be shown does not start, and prints the reason.
#[tokio::test]
async fn invalid_floor_plan_stops_start() {
    let directory = tempfile::tempdir().unwrap();
    let image = directory.path().join("plan.png");
    std::fs::write(&image, "no image").unwrap();
    let point = |metres: f64| FloorPlanPoint {
        pixel: [metres; 2],
        position_m: [metres; 2],
    };
    let mut config = config("euclid", Role::Auto, 1);
    config.dashboard.floor_plan = Some(FloorPlanConfig {
        image,
        points: [point(0.0), point(1.0)],
    });
    let error = node::start(config)
        .await
        .err()
        .expect("it started")
        .to_string();
    assert!(
        error.contains("dashboard.floor_plan.image") && error.contains("a PNG, JPEG or WebP file"),
        "{error}"
    );
}
