//! The mount of a camera from points of the ground.

use std::net::SocketAddr;
use std::time::Duration;

use ecod::model::geometry::Pose;
use ecod::perception::camera::{Intrinsics, Mount};
use ecod::perception::view::PosedCamera;
use ecod::wire::Role;
use ecod_testkit::until_async as until;
use nalgebra::Point2;
use serde_json::json;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

use crate::camera::{seeing, seeing_both_ways, shots};
use crate::cell::{config, start};
use crate::http::{Answer, get, request};
use crate::webdriver::Browser;

/// A point as the page states it: column, row, metres east and north.
type Clicked = [f64; 4];

/// The answer to points in pictures of 512 by 512 pixels.
pub(crate) async fn ask(page: SocketAddr, query: &str, points: &[Clicked]) -> Answer {
    let points: Vec<_> = points
        .iter()
        .map(|[column, row, x_m, y_m]| json!({ "pixel": [column, row], "position_m": [x_m, y_m] }))
        .collect();
    post(
        page,
        query,
        "application/json",
        &json!({ "width_px": 512, "height_px": 512, "points": points }).to_string(),
    )
    .await
}

async fn post(page: SocketAddr, query: &str, content_type: &str, body: &str) -> Answer {
    let headers = [("Host", "localhost"), ("Content-Type", content_type)];
    request(
        page,
        "POST",
        &format!("/api/camera/mount{query}"),
        &headers,
        body,
    )
    .await
}

/// Pixel of a place in pictures of 512 by 512 pixels of a camera with the usual field of view.
fn pixel(place: &Point2<f64>, vehicle: &Pose, mount: &Mount) -> [f64; 2] {
    let camera = Intrinsics::with_square_pixels(512, 512, 62.2f64.to_radians());
    let pixel = PosedCamera::new(mount.camera_pose(vehicle), mount, camera)
        .pixel(place)
        .unwrap();
    assert!(
        (0.0..512.0).contains(&pixel.x) && (0.0..512.0).contains(&pixel.y),
        "{pixel} is outside"
    );
    pixel.into()
}

#[track_caller]
fn is_near(toml: &str, table: &str, mount: &Mount, metres: f64, degrees: f64) {
    let toml: toml::Table = toml.parse().unwrap();
    let found = |key: &str| toml[table]["mount"][key].as_float().unwrap();
    let far = [
        ("forward_m", mount.forward_m),
        ("left_m", mount.left_m),
        ("height_m", mount.height_m.unwrap()),
    ];
    let turned = [
        ("pan_deg", mount.pan_rad),
        ("pitch_deg", mount.pitch_rad),
        ("roll_deg", mount.roll_rad),
    ];
    for (key, real) in far {
        assert!((found(key) - real).abs() <= metres, "{key} {real}: {toml}");
    }
    for (key, real_rad) in turned {
        let off_deg = (found(key) - real_rad.to_degrees() + 180.0).rem_euclid(360.0) - 180.0;
        assert!(
            off_deg.abs() <= degrees,
            "{key} {}: {toml}",
            real_rad.to_degrees()
        );
    }
}

async fn reports(page: SocketAddr, reporter: &str) {
    until("the camera reports", || async {
        let picture = get(page, "/api/picture").await.json();
        picture["vehicles"]
            .as_array()
            .unwrap()
            .iter()
            .any(|vehicle| vehicle["report"]["node"] == reporter)
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn points_give_named_camera_mount() {
    let directory = tempfile::tempdir().unwrap();
    let mut both = seeing_both_ways(directory.path());
    both.pose.x_m = 10.0;
    both.pose.y_m = -5.0;
    both.pose.heading_deg = 90.0;
    let (node, page) = start(both).await;
    reports(page, "euclid--rear").await;
    let vehicle = Pose::new(10.0, -5.0, 90f64.to_radians());
    let pitch_rad = 15f64.to_radians();
    let roll_rad = -2f64.to_radians();
    let pan_rad = 176f64.to_radians();
    let rear = Mount {
        forward_m: -1.8,
        left_m: 0.1,
        pan_rad,
        height_m: Some(2.5),
        pitch_rad,
        roll_rad,
    };
    let mut points: Vec<Clicked> = [
        (-7.0, 1.0),
        (-8.0, -2.0),
        (-10.0, 3.0),
        (-12.0, -1.0),
        (-15.0, 4.0),
        (-16.0, -3.0),
    ]
    .into_iter()
    .map(|(ahead_m, left_m)| {
        let place = vehicle.transform(ahead_m, left_m);
        let [column, row] = pixel(&place, &vehicle, &rear);
        [column, row, place.x, place.y]
    })
    .collect();
    points[3][0] += 40.0;
    let answer = ask(page, "?name=rear", &points).await;
    assert_eq!(answer.status, 200, "{}", answer.body);
    let answer = answer.json();
    is_near(
        answer["toml"].as_str().unwrap(),
        "cameras",
        &rear,
        0.01,
        0.1,
    );
    let fits = answer["points"].as_array().unwrap();
    assert_eq!(
        fits.iter()
            .map(|fit| fit["outlier"] == true)
            .collect::<Vec<_>>(),
        [false, false, false, true, false, false]
    );
    assert!(
        (fits[3]["error_px"].as_f64().unwrap() - 40.0).abs() < 1.0
            && fits[3]["error_m"].as_f64().unwrap() > 0.5
    );
    assert!(fits[0]["error_px"].as_f64().unwrap() < 0.5, "{fits:?}");

    let mut contradictory = [points[0], points[1], points[2], points[4]];
    contradictory[3][1] += 150.0;
    let on_one_spot = [points[0]; 6];
    for (points, reason) in [
        (&points[..3], "3 points, need 4"),
        (&contradictory, "no camera sees 4"),
        (&on_one_spot, "no camera sees 4"),
    ] {
        let refused = ask(page, "?name=rear", points).await;
        assert!(
            refused.status == 422 && refused.body.contains(reason),
            "{} {}",
            refused.status,
            refused.body
        );
        assert_eq!(
            refused.body.trim_end().lines().count(),
            1,
            "{}",
            refused.body
        );
    }
    assert_eq!(ask(page, "?name=left", &points).await.status, 404);
    let whole = json!({ "width_px": 512, "height_px": 512, "points": [] }).to_string();
    assert_eq!(
        post(page, "", "text/plain", &whole).await.status,
        415,
        "as a page of another origin might"
    );
    assert_eq!(post(page, "", "application/json", "{").await.status, 400);
    let padded = whole + &" ".repeat(16 * 1024);
    assert_eq!(
        post(page, "", "application/json", &padded).await.status,
        413
    );
    assert_eq!(get(page, "/api/camera/mount").await.status, 405);
    node.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn mount_needs_pose_and_points() {
    let directory = tempfile::tempdir().unwrap();
    let mut lost = seeing(directory.path());
    lost.pose.listen = Some(SocketAddr::from(([127, 0, 0, 1], 0)));
    let (node, page) = start(lost).await;
    let refused = ask(page, "", &[[1.0, 2.0, 3.0, 4.0]; 4]).await;
    assert!(
        refused.status == 409 && refused.body.contains("euclid reports no pose"),
        "{} {}",
        refused.status,
        refused.body
    );

    let mut stalled = TcpStream::connect(page).await.unwrap();
    let head = "POST /api/camera/mount HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: 99\r\n\r\n{";
    stalled.write_all(head.as_bytes()).await.unwrap();
    let mut answer = String::new();
    let read = stalled.read_to_string(&mut answer);
    tokio::time::timeout(Duration::from_secs(20), read)
        .await
        .expect("it is waited for")
        .unwrap();
    assert!(answer.starts_with("HTTP/1.1 408 "), "{answer}");
    node.stop().await;
}

/// Points are clicked in the picture and on the map; the page shows the mount, and the point that contradicts the others.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs Chromium: make test-dashboard"]
async fn mount_is_corrected_in_page() {
    let directory = tempfile::tempdir().unwrap();
    let mut seeing = seeing(directory.path());
    seeing.landmarks = config("euclid", Role::Auto, 6).landmarks;
    seeing.pose.x_m = -10.0;
    let vehicle = Pose::new(-10.0, 0.0, 0.0);
    let pitch_rad = 20f64.to_radians();
    let real = Mount {
        forward_m: 0.5,
        height_m: Some(5.0),
        pitch_rad,
        ..Mount::default()
    };
    let places: Vec<_> = seeing
        .landmarks
        .iter()
        .map(|place| Point2::new(place.x_m, place.y_m))
        .collect();
    let (node, page) = start(seeing).await;
    reports(page, "euclid").await;
    let browser = Browser::start().await;
    browser.look(1280, 1000, "light").await;
    browser.open(&format!("http://{page}/")).await;
    browser
        .until("document.querySelectorAll('#camera-boxes button').length === 3")
        .await;
    browser
        .until("document.querySelectorAll('#map .place').length === 6")
        .await;
    browser
        .evaluate("document.querySelector('#mount').click()")
        .await;
    let hint = "document.querySelector('#mount-hint').textContent";
    let toml = "document.querySelector('#mount-toml').value";
    browser
        .until(&format!("{hint}.includes('4 points to go')"))
        .await;
    for (index, place) in places.iter().enumerate() {
        browser
            .click_within(
                "#camera",
                pixel(place, &vehicle, &real).map(|pixels| pixels / 512.0),
            )
            .await;
        browser
            .until(&format!(
                "{hint}.startsWith('Now click point {}')",
                index + 1
            ))
            .await;
        browser
            .evaluate(&format!(
                "document.querySelectorAll('#map .place')[{index}].id = 'slot-{index}'"
            ))
            .await;
        browser.click(&format!("#slot-{index}")).await;
        browser.until(&format!("!{hint}.startsWith('Now')")).await;
        if index == 2 {
            assert_eq!(
                browser
                    .evaluate("document.querySelector('#mount-copy').disabled")
                    .await,
                true
            );
        }
    }
    browser
        .until(&format!("{toml}.startsWith('[camera.mount]')"))
        .await;
    assert_eq!(
        browser
            .evaluate("document.querySelectorAll('#mount-rows td.bad').length")
            .await,
        0
    );

    browser
        .evaluate("document.querySelector('#mount-add').click()")
        .await;
    for (column, value) in ["100", "400", "3", "2"].into_iter().enumerate() {
        let typed = format!(
            "(([input]) => (input.value = '{value}', input.dispatchEvent(new Event('input'))))\
             ([document.querySelectorAll('#mount-rows tr:last-child input')[{column}]])"
        );
        browser.evaluate(&typed).await;
    }
    browser
        .until("document.querySelectorAll('#mount-rows tr:last-child td.bad').length === 1")
        .await;
    let cut_off = "((table) => table.scrollWidth > table.clientWidth)(document.querySelector('#mount-table'))";
    assert_eq!(
        browser.evaluate(cut_off).await,
        false,
        "each point's error is in view"
    );
    let fault = "document.querySelector('#mount-fault').textContent";
    assert_eq!(
        browser.evaluate(fault).await,
        "1 point left out: correct or remove what is red."
    );
    for (name, width) in [("mount", 1280), ("mount-phone", 390)] {
        browser.look(width, 1000, "light").await;
        tokio::time::sleep(Duration::from_secs(1)).await;
        browser
            .screenshot(&shots().join(format!("{name}.png")))
            .await;
        browser.fits_the_width(name).await;
    }
    browser.look(1280, 1000, "light").await;
    browser
        .evaluate("document.querySelector('[aria-label=\"Remove point 7\"]').click()")
        .await;
    browser
        .until(&format!(
            "document.querySelectorAll('#mount-rows td.bad').length === 0 && {toml} !== ''"
        ))
        .await;
    browser
        .until("document.querySelectorAll('#map path.pick').length === 6")
        .await;
    assert_eq!(
        browser
            .evaluate("document.querySelectorAll('#camera-picks span').length")
            .await,
        6
    );
    let found = browser.evaluate(toml).await;
    is_near(found.as_str().unwrap(), "camera", &real, 0.5, 1.5);
    browser
        .evaluate("document.querySelector('#mount-copy').click()")
        .await;
    browser
        .until("document.querySelector('#mount-copied').textContent === 'Copied.'")
        .await;

    for point in 1..=3 {
        browser
            .evaluate(&format!(
                "document.querySelector('[aria-label=\"Remove point {point}\"]').click()"
            ))
            .await;
    }
    browser
        .until(&format!(
            "{hint}.includes('1 point to go') && document.querySelector('#mount-copy').disabled"
        ))
        .await;
    browser
        .evaluate("document.querySelector('#mount').click()")
        .await;
    browser
        .until("document.querySelectorAll('#map path.pick').length === 0")
        .await;
    browser.quit_without_complaints().await;
    node.stop().await;
}
