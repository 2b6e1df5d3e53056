//! `ecod-node try` for a newcomer: pictures in, objects on the map, without a configuration.

use std::fs;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::process::{Child, Output, Stdio};
use std::time::{Duration, Instant};

use ecod_actors::camera::image_codec;
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use opencv::core::{BORDER_CONSTANT, Mat, Scalar, copy_make_border};
use serde_json::Value;

use crate::ecod_node;

/// Maximum time for anything.
const PATIENCE: Duration = Duration::from_secs(120);

/// A directory with this photograph as its only image, in a frame, so that its objects are not cut.
fn album(directory: &Path, photograph: &str) -> String {
    let album = directory.join(photograph);
    fs::create_dir(&album).unwrap();
    let path = format!(
        "{}/tests/data/photos/{photograph}.jpg",
        env!("CARGO_MANIFEST_DIR")
    );
    let image = image_codec::read(path.as_ref()).unwrap();
    let mut framed = Mat::default();
    copy_make_border(
        &image,
        &mut framed,
        120,
        120,
        160,
        160,
        BORDER_CONSTANT,
        Scalar::all(128.0),
    )
    .unwrap();
    fs::write(
        album.join("0.jpg"),
        image_codec::encode_jpeg(&framed, 95).unwrap(),
    )
    .unwrap();
    album.to_str().unwrap().to_owned()
}

/// A running program, killed when dropped.
struct TryProgram(Child);

impl Drop for TryProgram {
    fn drop(&mut self) {
        self.0.kill().ok();
        self.0.wait().unwrap();
    }
}

/// The objects on the map that the page shows.
fn map(page: &str) -> Option<Vec<Value>> {
    let mut stream = TcpStream::connect(page).ok()?;
    write!(
        stream,
        "GET /api/picture HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n"
    )
    .ok()?;
    let mut answer = String::new();
    stream.read_to_string(&mut answer).ok()?;
    let body = &answer[answer.find('{')?..=answer.rfind('}')?];
    let picture: Value = serde_json::from_str(body).ok()?;
    Some(picture["map"]["message"]["objects"].as_array()?.clone())
}

fn label(object: &Value) -> String {
    object["label"].as_str().unwrap().to_owned()
}

/// The address of a page that the program prints behind this word.
fn address(lines: &mut impl Iterator<Item = String>, page: &str) -> String {
    let address = |line: String| {
        let (name, address) = line.split_once(": http://")?;
        Some(address.split('/').next()?.to_owned()).filter(|_| name == page)
    };
    lines.find_map(address).unwrap()
}

/// Labels and distances from the first vehicle of the objects on the map that the page shows.
fn objects(page: &str) -> Option<Vec<(String, f64)>> {
    let distance_m = |object: &Value| {
        object["x_m"]
            .as_f64()
            .unwrap()
            .hypot(object["y_m"].as_f64().unwrap())
    };
    Some(
        map(page)?
            .iter()
            .map(|object| (label(object), distance_m(object)))
            .collect(),
    )
}

/// Labels of the boxes in a vehicle's next picture on a page.
fn boxes(page: &str, vehicle: &str) -> Vec<String> {
    let mut stream = TcpStream::connect(page).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    write!(
        stream,
        "GET /api/cameras?of={vehicle} HTTP/1.1\r\nHost: localhost\r\n\r\n"
    )
    .unwrap();
    let mut lines = BufReader::new(stream).lines().map_while(Result::ok);
    let picture = lines
        .find_map(|line| serde_json::from_str::<Value>(line.strip_prefix("data: ")?).ok())
        .unwrap();
    let boxes = picture["boxes"].as_array().unwrap();
    boxes
        .iter()
        .map(|seen| seen["label"].as_str().unwrap().to_owned())
        .collect()
}

#[test]
fn two_cameras_make_one_map() {
    let directory = tempfile::tempdir().unwrap();
    let albums = ["chelsea", "astronaut"].map(|photograph| album(directory.path(), photograph));
    let saved = directory.path().join("node.toml");
    let mut command = ecod_node();
    command
        .arg("try")
        .arg(&albums[0])
        .arg("--images")
        .arg(&albums[1])
        .args(["--height", "1.4"])
        .args(["--dashboard", "127.0.0.1:0"])
        .arg("--save")
        .arg(&saved);
    let mut program = TryProgram(command.stderr(Stdio::piped()).spawn().unwrap());
    let mut lines = BufReader::new(program.0.stderr.take().unwrap())
        .lines()
        .map_while(Result::ok);
    let page = address(&mut lines, "page");
    let second = address(&mut lines, "page of images-2");
    let (sender, progress) = std::sync::mpsc::channel();
    std::thread::spawn(move || lines.try_for_each(|line| sender.send(line)));

    let deadline = Instant::now() + PATIENCE;
    let mut found = Vec::new();
    while !["cat", "person"]
        .iter()
        .all(|label| found.iter().any(|(seen, _)| seen == label))
    {
        assert!(Instant::now() < deadline, "on the map are only {found:?}");
        std::thread::sleep(Duration::from_millis(200));
        found = objects(&page).unwrap_or(found);
    }
    let shows_progress =
        |line: &String| line.contains("frames/s") && line.contains("objects on the map");
    let next_line = || {
        progress
            .recv_timeout(deadline.saturating_duration_since(Instant::now()))
            .ok()
    };
    assert!(
        std::iter::from_fn(next_line).any(|line| shows_progress(&line)),
        "progress is printed"
    );
    for page in [&page, &second] {
        for (label, vehicle) in [("cat", "images-1"), ("person", "images-2")] {
            assert!(
                boxes(page, vehicle).contains(&label.to_owned()),
                "{label} is not in the picture of {vehicle} on {page}"
            );
        }
    }
    let distance = |label: &str| found.iter().find(|(seen, _)| seen == label).unwrap().1;
    assert!(
        distance("cat") < 3.0,
        "a cat that fills the picture: {found:?}"
    );
    assert!(
        (45.0..55.0).contains(&distance("person")),
        "before the other camera, 50 m away: {found:?}"
    );

    kill(Pid::from_raw(program.0.id().cast_signed()), Signal::SIGINT).unwrap();
    assert!(program.0.wait().unwrap().success());

    for (name, images) in [("node.toml", &albums[0]), ("node-2.toml", &albums[1])] {
        let path = directory.path().join(name);
        let printed = ecod_node()
            .arg("--config")
            .arg(&path)
            .arg("--print-config")
            .output()
            .unwrap();
        let text = String::from_utf8(printed.stdout).unwrap();
        assert!(
            printed.status.success() && text.contains(images) && text.contains("height_m = 1.4"),
            "{text}"
        );
        let template = fs::read_to_string(&path).unwrap();
        for guess in ["camera.optics", "camera.mount.pitch_deg", "pose"] {
            assert!(template.contains(&format!("# - {guess}: ")), "{template}");
        }
        assert!(
            !template.contains("# - camera.mount.height_m"),
            "{template}"
        );
        for pair in template.lines().collect::<Vec<_>>().windows(2) {
            let is_stated = !pair[1].is_empty() && !pair[1].starts_with('#');
            assert!(
                !is_stated || pair[0].starts_with("# "),
                "{} has no comment in:\n{template}",
                pair[1]
            );
        }
    }
}

#[test]
fn missing_source_shows_simulated_street() {
    let mut command = ecod_node();
    command
        .args(["try", "--dashboard", "127.0.0.1:0"])
        .current_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/.."));
    let mut program = TryProgram(command.stderr(Stdio::piped()).spawn().unwrap());
    let mut lines = BufReader::new(program.0.stderr.take().unwrap())
        .lines()
        .map_while(Result::ok);
    let page = address(&mut lines, "page");
    std::thread::spawn(move || lines.for_each(drop));
    let deadline = Instant::now() + PATIENCE;
    let seen_by = |object: &Value, names: &[&str]| {
        let seen = object["contributors"].as_array().unwrap();
        seen.iter()
            .map(|name| name.as_str().unwrap())
            .eq(names.iter().copied())
    };
    // A car that only the camera on the mast detects, and a person that both cameras detect.
    let wanted = [
        ("car", vec!["kepler"]),
        ("person", vec!["galileo", "kepler"]),
    ];
    let mut missing = wanted.to_vec();
    while !missing.is_empty() {
        let objects = map(&page).unwrap_or_default();
        missing.retain(|(wanted, names)| {
            !objects
                .iter()
                .any(|object| label(object) == *wanted && seen_by(object, names))
        });
        assert!(
            Instant::now() < deadline,
            "never on the map: {missing:?}; at last {objects:?}"
        );
        std::thread::sleep(Duration::from_millis(100));
    }
    // The one on the mast is no vehicle.
    let near_mast = |object: &Value| {
        (object["x_m"].as_f64().unwrap() + 7.0).hypot(object["y_m"].as_f64().unwrap() + 8.2) < 0.5
    };
    let objects = map(&page).unwrap();
    assert!(!objects.iter().any(near_mast), "{objects:?}");
    kill(Pid::from_raw(program.0.id().cast_signed()), Signal::SIGINT).unwrap();
    assert!(program.0.wait().unwrap().success());
}

#[test]
fn unusable_picture_names_remedy() {
    let directory = tempfile::tempdir().unwrap();
    let nothing = directory.path().to_str().unwrap();
    let shown = format!("{}/tests/data/photos", env!("CARGO_MANIFEST_DIR"));
    let there = format!("{}/Cargo.toml", env!("CARGO_MANIFEST_DIR"));
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let taken = listener.local_addr().unwrap().to_string();
    for (arguments, parts) in [
        (
            vec!["try"],
            vec![
                "examples/street",
                "package",
                "a video",
                "a directory of images",
                "a camera such as 0",
            ],
        ),
        (vec!["try", "--video", "no-such.mp4"], vec!["no-such.mp4"]),
        (vec!["try", nothing], vec![nothing, "no images found"]),
        (vec!["try", "--url", "192.168.1.20"], vec!["rtsp://"]),
        (
            vec!["try", "--video", nothing],
            vec![nothing, "a directory", "`images`"],
        ),
        (
            vec!["try", &shown, "--save", &there],
            vec![&there, "another name"],
        ),
        (
            vec!["try", &shown, "--save", "none/node.toml"],
            vec!["none/node.toml", "make the directory"],
        ),
        (
            vec!["try", &shown, "--dashboard", &taken],
            vec![&taken, "another address"],
        ),
    ] {
        let Output { status, stderr, .. } = ecod_node().args(&arguments).output().unwrap();
        let error = String::from_utf8(stderr).unwrap();
        assert_eq!(status.code(), Some(2), "{arguments:?}: {error}");
        assert!(
            parts.iter().all(|part| error.contains(part)) && error.trim_end().lines().count() == 1,
            "{error}"
        );
    }
}
