//! Masked parts of a camera's picture stay out of detector, page and disk.

use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, Write};
use std::net::{SocketAddr, TcpStream};
use std::path::Path;
use std::process::Stdio;
use std::time::Duration;

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use ecod::wire::Role;
use ecod_actors::camera::config::CameraConfig;
use ecod_actors::camera::image_codec::{decode, encode_jpeg};
use ecod_actors::node;
use ecod_actors::node::config::NodeConfig;
use ecod_testkit::{PATIENCE, loopback};
use opencv::core::{CV_8UC3, Mat, ROTATE_90_COUNTERCLOCKWISE, Rect, Scalar, Vec3b, rotate};
use opencv::imgproc;
use opencv::prelude::*;
use qrcode::{Color, QrCode};
use serde_json::Value;

use crate::ecod_node;
use crate::recording::cell::{Log, config};
use crate::video_sources::{begin_stream, network_camera, send_picture};

const WIDTH: i32 = 1280;
const HEIGHT: i32 = 960;

/// A pentagon around the magenta wall with the first code.
const MASK: &str = "[[0.05, 0.1], [0.45, 0.1], [0.45, 0.7], [0.25, 0.8], [0.05, 0.7]]";

/// Text of the code under the mask, and of a comment in the camera's files.
const SECRET: &str = "NEIGHBOUR";
const OPEN: &str = "STREET";

/// A share of the picture's width or height in pixels.
fn pixels(share: f64, of: i32) -> i32 {
    (share * f64::from(of)).round() as i32
}

/// Paints a rectangle whose edges are in shares of the picture.
fn paint(image: &mut Mat, [left, top, right, bottom]: [f64; 4], color: [f64; 3]) {
    let x = pixels(left, WIDTH);
    let y = pixels(top, HEIGHT);
    let area = Rect::new(x, y, pixels(right, WIDTH) - x, pixels(bottom, HEIGHT) - y);
    let [blue, green, red] = color;
    let color = Scalar::new(blue, green, red, 0.0);
    imgproc::rectangle(image, area, color, imgproc::FILLED, imgproc::LINE_8, 0).unwrap();
}

/// Paints a code with its white rim, from `left` in the upper half of the picture.
fn paint_code(image: &mut Mat, text: &str, left: f64) {
    let code = QrCode::new(text).unwrap();
    let [module_x, module_y] = [8.0 / f64::from(WIDTH), 8.0 / f64::from(HEIGHT)];
    let rim = 4.0;
    let side = code.width() as f64 + 2.0 * rim;
    let top = 0.2;
    let white = [left, top, left + side * module_x, top + side * module_y];
    paint(image, white, [255.0; 3]);
    for (number, color) in code.to_colors().into_iter().enumerate() {
        if color == Color::Dark {
            let x = left + ((number % code.width()) as f64 + rim) * module_x;
            let y = top + ((number / code.width()) as f64 + rim) * module_y;
            paint(image, [x, y, x + module_x, y + module_y], [0.0; 3]);
        }
    }
}

/// A gray scene with a code on a magenta wall to the left, and another code to the right.
fn scene() -> Mat {
    let gray = Scalar::all(128.0);
    let mut image = Mat::new_rows_cols_with_default(HEIGHT, WIDTH, CV_8UC3, gray).unwrap();
    paint(&mut image, [0.05, 0.1, 0.45, 0.7], [255.0, 0.0, 255.0]);
    paint_code(&mut image, SECRET, 0.12);
    paint_code(&mut image, OPEN, 0.6);
    image
}

/// The JPEG of a camera that adds a comment and, to be turned by a quarter, a thumbnail.
fn camera_jpeg() -> Vec<u8> {
    let mut lying = Mat::default();
    rotate(&scene(), &mut lying, ROTATE_90_COUNTERCLOCKWISE).unwrap();
    let whole = encode_jpeg(&lying, 95).unwrap();
    let mut small = Mat::default();
    imgproc::resize_def(&lying, &mut small, (120, 160).into()).unwrap();
    let thumbnail = encode_jpeg(&small, 80).unwrap();
    // TIFF 6.0: an entry is tag, type, count and value. The second directory is of the thumbnail.
    let entry = |tag: u16, kind: u16, value: u32| {
        let head = [tag.to_le_bytes(), kind.to_le_bytes()].concat();
        [head, 1u32.to_le_bytes().into(), value.to_le_bytes().into()].concat()
    };
    let exif = [
        b"Exif\0\0II*\0\x08\0\0\0\x01\0".to_vec(),
        entry(0x0112, 3, 6),
        b"\x1a\0\0\0\x02\0".into(),
        entry(0x0201, 4, 56),
        entry(0x0202, 4, thumbnail.len() as u32),
        b"\0\0\0\0".into(),
        thumbnail,
    ]
    .concat();
    let segment = |marker: u8, body: &[u8]| {
        let length = (body.len() as u16 + 2).to_be_bytes();
        [&[0xff, marker], &length[..], body].concat()
    };
    let metadata = [segment(0xe1, &exif), segment(0xfe, SECRET.as_bytes())].concat();
    [&whole[..2], &metadata, &whole[2..]].concat()
}

/// The keys of a camera with this source that reads codes.
fn camera(source: &str, masks: &str) -> CameraConfig {
    let keys = format!(
        "source = {{ {source} }}\n\
         masks = [{masks}]\n\
         detector.kind = \"placard\"\n\
         optics = {{ width_px = 640, height_px = 480 }}\n\
         projection.sizes.default = {{ width_m = 0.2, height_m = 0.2 }}"
    );
    toml::from_str(&keys).unwrap()
}

fn count(bytes: &[u8], part: &[u8]) -> usize {
    let found = |window: &&[u8]| *window == part;
    bytes.windows(part.len()).filter(found).count()
}

/// Checks that a JPEG shows the scene with a black mask, and has no other picture or text in it.
fn assert_masked(jpeg: &[u8]) {
    assert_eq!(count(jpeg, b"\xff\xd8"), 1, "one picture");
    assert_eq!(count(jpeg, b"Exif") + count(jpeg, SECRET.as_bytes()), 0);
    let image = decode(jpeg).unwrap();
    let [columns, rows] = [image.cols(), image.rows()];
    assert_eq!(columns * 3, rows * 4, "upright");
    let at = |x, y| image.at_2d::<Vec3b>(y, x).unwrap().0;
    for (x, y) in (0..columns).flat_map(|x| (0..rows).map(move |y| (x, y))) {
        let [blue, green, red] = at(x, y);
        let is_magenta = blue.min(red) > green.saturating_add(60);
        assert!(!is_magenta, "{:?} at {x}, {y}", at(x, y));
        let share_x = f64::from(x) / f64::from(columns);
        let share_y = f64::from(y) / f64::from(rows);
        let is_masked = (0.07..0.43).contains(&share_x) && (0.13..0.68).contains(&share_y);
        if is_masked {
            assert!(at(x, y).iter().all(|value| *value < 12), "{x}, {y}");
        }
        let is_far = share_x > 0.48 || !(0.07..0.83).contains(&share_y);
        let is_code = share_x > 0.58 && (0.18..0.6).contains(&share_y);
        if is_far && !is_code {
            assert!(
                at(x, y).iter().all(|value| value.abs_diff(128) < 12),
                "{x}, {y}"
            );
        }
    }
    let white = at(pixels(0.61, columns), pixels(0.21, rows));
    assert!(
        white.iter().all(|value| *value > 220),
        "the rim of the open code: {white:?}"
    );
}

/// The next picture of a page's stream.
fn picture(page: SocketAddr, path: &str) -> Value {
    let mut stream = TcpStream::connect(page).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    write!(stream, "GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n").unwrap();
    let mut lines = BufReader::new(stream).lines().map_while(Result::ok);
    lines
        .find_map(|line| serde_json::from_str(line.strip_prefix("data: ")?).ok())
        .unwrap()
}

fn labels(picture: &Value) -> Vec<&str> {
    let boxes = picture["boxes"].as_array().unwrap();
    boxes
        .iter()
        .map(|found| found["label"].as_str().unwrap())
        .collect()
}

/// Runs a node with this camera and checks its page and its log.
async fn assert_node_masks(camera: CameraConfig, directory: &Path) {
    let mut config = config("euclid", Role::Auto, directory);
    config.camera = Some(camera);
    config.dashboard.enabled = true;
    config.dashboard.listen = Some(loopback());
    config.record.as_mut().unwrap().camera_hz = 5.0;
    config.validate().unwrap();
    let node = node::start(config).await.unwrap();
    let mut address = node.dashboard_address();
    let page = *tokio::time::timeout(PATIENCE, address.wait_for(Option::is_some))
        .await
        .expect("a page")
        .unwrap();
    let page = page.unwrap();
    for path in ["/api/camera", "/api/cameras?of=euclid"] {
        let shown = tokio::task::spawn_blocking(move || picture(page, path));
        let shown = shown.await.unwrap();
        assert_masked(
            &BASE64_STANDARD
                .decode(shown["jpeg"].as_str().unwrap())
                .unwrap(),
        );
        assert_eq!(labels(&shown), [OPEN], "{path}");
    }
    tokio::time::sleep(Duration::from_secs(5)).await;
    node.stop().await;

    let log = Log::read(&directory.join("euclid"));
    let mut pictures = 0;
    for message in &log.messages {
        assert_eq!(
            count(&message.json, SECRET.as_bytes()),
            0,
            "{}",
            message.topic
        );
        if message.topic == "camera" {
            let recorded: Value = serde_json::from_slice(&message.json).unwrap();
            assert_masked(
                &BASE64_STANDARD
                    .decode(recorded["data"].as_str().unwrap())
                    .unwrap(),
            );
            pictures += 1;
        }
    }
    assert!(pictures > 0, "pictures are recorded");
    let has_open = |message| count(message, OPEN.as_bytes()) > 0;
    assert!(log.messages.iter().any(|message| has_open(&message.json)));
}

/// Without the mask, the detector reads both codes of the scene.
#[test]
fn unmasked_camera_reads_both_codes() {
    let directory = tempfile::tempdir().unwrap();
    std::fs::write(directory.path().join("0.jpg"), camera_jpeg()).unwrap();
    let source = format!("kind = 'images', path = {:?}", directory.path());
    let camera = camera(&source, "");
    let mut source = camera.open(PATIENCE).unwrap();
    let frame = source.next_frame().unwrap();
    let found = camera.detector.build().unwrap().detect(&frame).unwrap();
    let mut labels: Vec<&str> = found.iter().map(|seen| seen.label.as_str()).collect();
    labels.sort_unstable();
    assert_eq!(labels, [SECRET, OPEN]);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn masks_apply_to_image_files() {
    let directory = tempfile::tempdir().unwrap();
    let frames = directory.path().join("frames");
    std::fs::create_dir(&frames).unwrap();
    std::fs::write(frames.join("0.jpg"), camera_jpeg()).unwrap();
    let source = format!("kind = 'images', path = {frames:?}, looping = true");
    assert_node_masks(camera(&source, MASK), directory.path()).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn masks_apply_to_motion_jpeg() {
    let jpeg = camera_jpeg();
    let url = network_camera(move |mut visitor| {
        if begin_stream(&mut visitor)? {
            // Until the node hangs up.
            loop {
                send_picture(&mut visitor, &jpeg, "")?;
                std::thread::sleep(Duration::from_millis(50));
            }
        }
        Ok(())
    });
    let directory = tempfile::tempdir().unwrap();
    let source = format!("kind = 'url', url = '{url}'");
    assert_node_masks(camera(&source, MASK), directory.path()).await;
}

/// `try` uses masks from its first picture on, and writes them into the configuration.
#[test]
fn try_shows_masked_pictures() {
    let directory = tempfile::tempdir().unwrap();
    let frames = directory.path().join("frames");
    std::fs::create_dir(&frames).unwrap();
    std::fs::write(frames.join("0.jpg"), camera_jpeg()).unwrap();
    let file = directory.path().join("node.toml");
    let corners = "0.05,0.1 0.45,0.1 0.45,0.7 0.25,0.8 0.05,0.7";
    let mut started = ecod_node();
    started
        .args(["try", "--stop-at-eof", "--dashboard", "127.0.0.1:0"])
        .args(["--mask", corners, "--output"])
        .args([&file, &frames])
        .stdin(Stdio::piped())
        .stderr(Stdio::piped());
    let mut running = started.spawn().unwrap();
    let mut printed = BufReader::new(running.stderr.take().unwrap()).lines();
    let page = printed.by_ref().map_while(Result::ok).find_map(|line| {
        let (_, address) = line.split_once("page: http://")?;
        address.split('/').next()?.parse().ok()
    });
    let shown = picture(page.unwrap(), "/api/camera");
    running.stdin.take();
    // A program whose standard error is full or closed would not end.
    printed.for_each(drop);
    assert!(running.wait().unwrap().success());
    assert_masked(
        &BASE64_STANDARD
            .decode(shown["jpeg"].as_str().unwrap())
            .unwrap(),
    );
    let config = NodeConfig::load(Some(&file), &BTreeMap::<(), ()>::new()).unwrap();
    let masked = config.camera.unwrap();
    let stated = camera("kind = 'v4l2'", MASK);
    assert_eq!(masked.masks, stated.masks);
    assert_eq!(masked.optics.width_px, Some(1280));
}

/// `doctor` looks at the masked picture, and masks without a stated shape of the picture are refused.
#[test]
fn doctor_and_loader_apply_masks() {
    let directory = tempfile::tempdir().unwrap();
    let frames = directory.path().join("frames");
    std::fs::create_dir(&frames).unwrap();
    std::fs::write(frames.join("0.jpg"), camera_jpeg()).unwrap();
    let run = |optics: &str, mask: &str| {
        let file = directory.path().join("node.toml");
        let keys = format!(
            "name = 'euclid'\n\
             [camera]\n\
             source = {{ kind = 'images', path = {frames:?} }}\n\
             masks = [{mask}]\n\
             detector.kind = 'placard'\n\
             {optics}\n"
        );
        std::fs::write(&file, keys).unwrap();
        let output = ecod_node()
            .arg("doctor")
            .arg("--config")
            .arg(&file)
            .output();
        ecod_testkit::all_output(&output.unwrap())
    };
    let size = "optics = { width_px = 640, height_px = 480 }";
    let shown = run(size, MASK);
    assert!(shown.contains("frames of 1280x960"), "{shown}");
    assert!(shown.contains("masks: 1"), "{shown}");
    assert!(shown.contains("finds 1 objects in a frame"), "{shown}");
    let wide = run("optics = { width_px = 1280, height_px = 720 }", MASK);
    assert!(
        wide.contains("1280x960") && wide.contains("camera.masks"),
        "{wide}"
    );
    let shapeless = run("", MASK);
    assert!(
        shapeless.contains("`camera.optics.width_px` is missing"),
        "{shapeless}"
    );
    let flat = run(size, "[[0.1, 0.1], [0.2, 0.2]]");
    assert!(
        flat.contains("`camera.masks[0]`") && flat.contains("at least 3 corners"),
        "{flat}"
    );
}
