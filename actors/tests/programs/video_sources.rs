//! Videos, pipelines and network cameras, which the program `ecod-video` reads for a node.

use std::collections::BTreeSet;
use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::net::{TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use ecod::model::time::Timestamp;
use ecod_actors::camera::config::CameraConfig;
use ecod_actors::camera::frame::CameraFrame;
use ecod_actors::camera::frame_source::capture::{Capture, CaptureConfig, CaptureStatus};
use ecod_actors::camera::frame_source::{FrameError, FrameSource, TimeSource};
use ecod_actors::camera::image_codec::encode_jpeg;
use ecod_actors::platform::clock;
use ecod_testkit::{PATIENCE, until_blocking as until};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use opencv::core::{CV_8UC3, Mat, Scalar, Size, Vec3b};
use opencv::prelude::*;
use opencv::videoio::VideoWriter;

fn gray(value: u8) -> Mat {
    Mat::new_rows_cols_with_default(48, 64, CV_8UC3, Scalar::all(f64::from(value))).unwrap()
}

fn brightness(frame: &CameraFrame) -> u8 {
    frame.image.at_2d::<Vec3b>(24, 32).unwrap()[1]
}

/// A camera with this source.
fn source(toml: &str) -> CameraConfig {
    assert!(Path::new(env!("CARGO_BIN_EXE_ecod-video")).is_file());
    toml::from_str(&format!("detector.kind = 'placard'\n[source]\n{toml}")).unwrap()
}

fn open(toml: &str) -> Result<Box<dyn FrameSource>, FrameError> {
    source(toml).open(Duration::from_secs(5))
}

/// Brightness of all frames up to the error that ends them.
fn play(source: &mut dyn FrameSource) -> (Vec<u8>, FrameError) {
    let mut seen = Vec::new();
    loop {
        match source.next_frame() {
            Ok(frame) => seen.push(brightness(&frame)),
            Err(error) => return (seen, error),
        }
    }
}

/// Brightness of all frames up to the end, and the errors about frames that were skipped.
fn play_whole_frames(source: &mut dyn FrameSource) -> (Vec<u8>, Vec<String>) {
    let mut seen = Vec::new();
    let mut skipped = Vec::new();
    loop {
        match source.next_frame() {
            Ok(frame) => seen.push(brightness(&frame)),
            Err(FrameError::NotDue) => {}
            Err(error @ FrameError::Unusable { .. }) => skipped.push(error.to_string()),
            Err(FrameError::Ended { .. } | FrameError::Lost { .. }) => return (seen, skipped),
            Err(error) => panic!("{error}"),
        }
    }
}

fn near(seen: &[u8], expected: &[u8]) -> bool {
    seen.len() == expected.len() && seen.iter().zip(expected).all(|(a, b)| a.abs_diff(*b) <= 4)
}

const CLIP: [u8; 3] = [40, 120, 200];

fn write_clip(path: &Path, fps: f64) {
    let mjpg = VideoWriter::fourcc('M', 'J', 'P', 'G').unwrap();
    let mut writer = VideoWriter::new(path, mjpg, fps, Size::new(64, 48), true).unwrap();
    assert!(writer.is_opened().unwrap());
    CLIP.iter()
        .for_each(|value| writer.write(&gray(*value)).unwrap());
    writer.release().unwrap();
}

#[test]
fn video_plays_once_or_looped() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("clip.avi");
    write_clip(&path, 200.0);
    let mut source = open(&format!("kind = 'video'\npath = {path:?}")).unwrap();
    let (seen, end) = play(source.as_mut());
    assert!(near(&seen, &CLIP), "{seen:?}");
    assert_eq!(
        end,
        FrameError::Ended {
            origin: path.display().to_string()
        }
    );

    let mut source = open(&format!("kind = 'video'\npath = {path:?}\nlooping = true")).unwrap();
    let seen: Vec<u8> = (0..5)
        .map(|_| brightness(&source.next_frame().unwrap()))
        .collect();
    assert!(near(&seen, &[40, 120, 200, 40, 120]), "{seen:?}");
}

/// An MP4 of four frames, black with a white upper left quarter, 0.1 s apart.
fn write_flag(path: &Path) {
    let mut flag = gray(0);
    for (row, column) in (0..24).flat_map(|row| (0..32).map(move |column| (row, column))) {
        *flag.at_2d_mut::<Vec3b>(row, column).unwrap() = [255; 3].into();
    }
    let mp4v = VideoWriter::fourcc('m', 'p', '4', 'v').unwrap();
    let mut writer = VideoWriter::new(path, mp4v, 10.0, Size::new(64, 48), true).unwrap();
    assert!(writer.is_opened().unwrap());
    for _ in 0..4 {
        writer.write(&flag).unwrap();
    }
    writer.release().unwrap();
}

fn place_of(mp4: &[u8], name: &[u8; 4]) -> usize {
    let place = mp4.windows(4).rposition(|found| found == name);
    place.expect("a box of this name") - 4
}

/// Sets the matrix by which players show the track (ISO 14496-12, 8.3.2).
fn set_matrix(mp4: &mut [u8], [a, b, c, d]: [i32; 4]) {
    let matrix = [a << 16, b << 16, 0, c << 16, d << 16, 0, 0, 0, 1 << 30];
    let at = place_of(mp4, b"tkhd") + 48;
    let bytes: Vec<u8> = matrix.into_iter().flat_map(i32::to_be_bytes).collect();
    mp4[at..at + bytes.len()].copy_from_slice(&bytes);
}

/// Sets the durations of frames, in units of the file's equal durations. The table is at the end of the file, so that
/// the rest keeps its position.
fn set_durations(mp4: &mut Vec<u8>, durations: &[u32]) {
    let table = place_of(mp4, b"stts");
    let old = mp4[table..table + 24].to_vec();
    assert_eq!(old[..16], *b"\0\0\0\x18stts\0\0\0\0\0\0\0\x01");
    let usual = u32::from_be_bytes(old[20..].try_into().unwrap());
    let grown_by = 8 * (durations.len() as u32 - 1);
    for name in [b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stts"] {
        let at = place_of(mp4, name);
        let length = u32::from_be_bytes(mp4[at..at + 4].try_into().unwrap());
        mp4[at..at + 4].copy_from_slice(&(length + grown_by).to_be_bytes());
    }
    let rows = durations
        .iter()
        .flat_map(|duration| [1, duration * usual])
        .flat_map(u32::to_be_bytes);
    let rows: Vec<u8> = (durations.len() as u32)
        .to_be_bytes()
        .into_iter()
        .chain(rows)
        .collect();
    mp4.splice(table + 12..table + 24, rows);
}

#[test]
fn video_orientation_matches_players() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("flag.mp4");
    write_flag(&path);
    let written = fs::read(&path).unwrap();
    // Matrix, width and height, and column and row of the white quarter's middle.
    for (matrix, size, white) in [
        ([1, 0, 0, 1], (64, 48), (16, 12)),
        ([0, 1, -1, 0], (48, 64), (36, 16)),
        ([-1, 0, 0, -1], (64, 48), (48, 36)),
        ([0, -1, 1, 0], (48, 64), (12, 48)),
        ([2, 0, 0, 1], (128, 48), (32, 12)),
    ] {
        let mut mp4 = written.clone();
        set_matrix(&mut mp4, matrix);
        fs::write(&path, &mp4).unwrap();
        let mut source = open(&format!("kind = 'video'\npath = {path:?}\nlooping = true")).unwrap();
        for _ in 0..5 {
            let image = source.next_frame().unwrap().image;
            assert_eq!((image.cols(), image.rows()), size, "{matrix:?}");
            let (column, row) = white;
            let brightness = |row, column| image.at_2d::<Vec3b>(row, column).unwrap()[1];
            let opposite = brightness(size.1 - 1 - row, size.0 - 1 - column);
            assert!(
                brightness(row, column) > 200 && opposite < 50,
                "{matrix:?}: {} {opposite}",
                brightness(row, column)
            );
        }
    }
}

#[test]
fn frames_keep_file_times() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("flag.mp4");
    write_flag(&path);
    let mut mp4 = fs::read(&path).unwrap();
    // The list of edits would end the film at its former duration.
    let edits = place_of(&mp4, b"edts");
    mp4[edits + 4..edits + 8].copy_from_slice(b"free");
    set_durations(&mut mp4, &[1, 2, 15, 1]);
    fs::write(&path, &mp4).unwrap();
    let mut source = source(&format!("kind = 'video'\npath = {path:?}"))
        .open(Duration::from_millis(300))
        .unwrap();
    let mut times = Vec::new();
    let mut pauses = 0;
    loop {
        match source.next_frame() {
            Ok(frame) => times.push(frame.captured_at),
            Err(FrameError::NotDue) => pauses += 1,
            Err(FrameError::Ended { .. }) => break,
            Err(error) => panic!("{error}"),
        }
    }
    let steps: Vec<f64> = times
        .windows(2)
        .map(|pair| pair[1].since(pair[0]).as_secs_f64())
        .collect();
    assert_eq!(steps.len(), 3, "{steps:?}");
    for (step, expected) in steps.iter().zip([0.1, 0.2, 1.5]) {
        assert!((step - expected).abs() < 0.08, "{steps:?}");
    }
    assert!(
        pauses > 5,
        "{pauses} signs of life in 1.5 s, each within 0.15 s"
    );
}

#[test]
fn special_video_names_are_literal() {
    let directory = tempfile::tempdir().unwrap();
    for name in ["50%_a:b-%04d.avi", "-i clip.avi", "http:clip.avi"] {
        let path = directory.path().join(name);
        let plain = directory.path().join("plain.avi");
        write_clip(&plain, 200.0);
        fs::rename(&plain, &path).unwrap();
        let mut source = open(&format!("kind = 'video'\npath = {path:?}")).unwrap();
        let (seen, _) = play(source.as_mut());
        assert!(near(&seen, &CLIP), "{name}: {seen:?}");
    }
}

#[test]
fn frames_use_node_clock() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("clip.avi");
    write_clip(&path, 10.0);
    clock::now();
    let mut source = open(&format!("kind = 'video'\npath = {path:?}\nlooping = true")).unwrap();
    let times: Vec<_> = (0..4)
        .map(|_| source.next_frame().unwrap().captured_at)
        .collect();
    assert!(
        times
            .iter()
            .all(|time| *time <= clock::now() && clock::now().since(*time) < PATIENCE),
        "{times:?}"
    );
    let apart = times[3].since(times[0]);
    assert!(
        apart >= Duration::from_millis(290),
        "three periods of 100 ms: {apart:?}"
    );
}

#[test]
fn a_pipeline_gives_frames() {
    let pipeline = "videotestsrc num-buffers=3 pattern=white ! video/x-raw,width=64,height=48 ! videoconvert ! \
                    video/x-raw,format=BGR ! appsink";
    let mut source = open(&format!("kind = 'gstreamer'\npipeline = '{pipeline}'")).unwrap();
    let (seen, end) = play(source.as_mut());
    assert_eq!(seen.len(), 3);
    assert!(seen.iter().all(|value| *value > 230), "{seen:?}");
    assert!(
        matches!(end, FrameError::Lost { .. }),
        "a live source does not end: {end}"
    );
}

#[test]
fn late_reading_keeps_spacing() {
    let pipeline = "videotestsrc is-live=true ! video/x-raw,width=640,height=480,framerate=20/1 ! videoconvert ! \
                    video/x-raw,format=BGR ! appsink";
    let mut source = open(&format!("kind = 'gstreamer'\npipeline = '{pipeline}'")).unwrap();
    let mut times = Vec::new();
    for number in 0..40 {
        std::thread::sleep(Duration::from_millis(number * 37 % 110));
        times.push(source.next_frame().unwrap().captured_at);
    }
    assert_eq!(source.time_source(), TimeSource::Position);
    let steps_ms: Vec<f64> = times
        .windows(2)
        .map(|pair| pair[1].micros_from(pair[0]) as f64 / 1e3)
        .collect();
    let off: Vec<_> = steps_ms
        .iter()
        .filter(|step| (*step - (*step / 50.0).round() * 50.0).abs() > 15.0)
        .collect();
    assert!(off.len() < 4, "{steps_ms:?}");
}

#[test]
fn missing_pipeline_element_is_named() {
    let pipeline = "nosuchsrc location=rtsp://user:hunter2@camera/1 ! appsink";
    let error = open(&format!("kind = 'gstreamer'\npipeline = '{pipeline}'"))
        .err()
        .expect("missing")
        .to_string();
    assert!(
        error.starts_with("cannot open nosuchsrc location=rtsp://camera/1"),
        "{error}"
    );
    assert!(!error.contains("hunter2"), "{error}");
}

/// A network camera on a free port that answers every client with `answer`; returns its address.
pub(crate) fn network_camera(
    answer: impl Fn(TcpStream) -> std::io::Result<()> + Send + 'static,
) -> String {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let url = format!(
        "http://user:hunter2@{}/stream",
        listener.local_addr().unwrap()
    );
    std::thread::spawn(move || {
        for visitor in listener.incoming() {
            // The camera ignores clients that hang up.
            let _ = visitor.and_then(&answer);
        }
    });
    url
}

fn motion_jpeg(visitor: TcpStream) -> std::io::Result<()> {
    let pictures: Vec<_> = (0..25)
        .map(|number| encode_jpeg(&gray(50 + 4 * number), 95).unwrap())
        .collect();
    send_pictures(visitor, &pictures)
}

/// Motion JPEG over HTTP, the protocol of cheap network cameras.
fn send_pictures(mut visitor: TcpStream, pictures: &[Vec<u8>]) -> std::io::Result<()> {
    if begin_stream(&mut visitor)? {
        for jpeg in pictures {
            send_picture(&mut visitor, jpeg, "")?;
        }
    }
    Ok(())
}

/// Answers the request for a stream; false if the login is missing.
pub(crate) fn begin_stream(visitor: &mut TcpStream) -> std::io::Result<bool> {
    let request = BufReader::new(visitor.try_clone()?);
    let lines: Vec<String> = request
        .lines()
        .map_while(Result::ok)
        .take_while(|line| !line.is_empty())
        .collect();
    let has_login = lines.iter().any(|line| {
        line.to_ascii_lowercase()
            .starts_with("authorization: basic ")
    });
    if has_login {
        write!(
            visitor,
            "HTTP/1.1 200 OK\r\nContent-Type: multipart/x-mixed-replace;boundary=frame\r\n\r\n"
        )?;
    } else {
        write!(
            visitor,
            "HTTP/1.1 401 Unauthorized\r\nWWW-Authenticate: Basic realm=\"camera\"\r\n\r\n"
        )?;
    }
    Ok(has_login)
}

/// `header` is one more line of the part's header with its end, or empty.
pub(crate) fn send_picture(
    visitor: &mut TcpStream,
    jpeg: &[u8],
    header: &str,
) -> std::io::Result<()> {
    write!(
        visitor,
        "--frame\r\nContent-Type: image/jpeg\r\n{header}Content-Length: {}\r\n\r\n",
        jpeg.len()
    )?;
    visitor.write_all(jpeg)?;
    write!(visitor, "\r\n")
}

#[test]
fn network_camera_works_until_disconnect() {
    let url = network_camera(motion_jpeg);
    let mut source = open(&format!("kind = 'url'\nurl = '{url}'")).unwrap();
    let (seen, end) = play(source.as_mut());
    assert!(
        seen.len() > 20 && seen.is_sorted() && seen[0].abs_diff(50) <= 4,
        "{seen:?}"
    );
    let FrameError::Lost { origin, .. } = end else {
        panic!("a live source does not end: {end}")
    };
    assert!(
        origin.ends_with("/stream") && !origin.contains("hunter2"),
        "{origin}"
    );
}

/// Reads a network camera whose pictures arrive 60 to 180 ms after their capture, and are read
/// later still. `header` makes the line of a picture's header from the true time. Returns the
/// differences of stated and true times in ms, ascending, and the source of the stated times.
fn errors_of_stated_times(
    header: impl Fn(Timestamp) -> String + Send + 'static,
) -> (Vec<f64>, TimeSource) {
    let taken = Arc::new(Mutex::new(Vec::new()));
    let written = Arc::clone(&taken);
    let url = network_camera(move |mut visitor| {
        if !begin_stream(&mut visitor)? {
            return Ok(());
        }
        for number in 0..24_u8 {
            let at = clock::wall();
            written.lock().unwrap().push(at);
            let jpeg = encode_jpeg(&gray(40 + 4 * number), 95).unwrap();
            let way_ms = 60 + u64::from(number) * 5 % 7 * 20;
            std::thread::sleep(Duration::from_millis(way_ms));
            send_picture(&mut visitor, &jpeg, &header(at))?;
        }
        Ok(())
    });
    let mut source = open(&format!("kind = 'url'\nurl = '{url}'")).unwrap();
    let mut errors = Vec::new();
    while let Ok(frame) = source.next_frame() {
        let number = usize::from(brightness(&frame).saturating_sub(38)) / 4;
        let truth = taken.lock().unwrap()[number].shifted(-clock::wall_offset_us());
        errors.push(frame.captured_at.micros_from(truth) as f64 / 1e3);
        std::thread::sleep(Duration::from_millis(number as u64 * 37 % 90));
    }
    assert_eq!(errors.len(), 24);
    errors.sort_by(f64::total_cmp);
    (errors, source.time_source())
}

fn p95(sorted: &[f64]) -> f64 {
    sorted[sorted.len() * 95 / 100]
}

#[test]
fn header_of_picture_gives_time() {
    let stamp = |at: Timestamp| format!("X-Timestamp: {at}\r\n");
    let (errors, time_source) = errors_of_stated_times(stamp);
    assert_eq!(time_source, TimeSource::Stamp);
    let middle = &errors[2..22];
    assert!(middle.iter().all(|error| error.abs() < 10.0), "{errors:?}");

    let (errors, time_source) = errors_of_stated_times(|_| String::new());
    assert_eq!(time_source, TimeSource::Arrival);
    assert!(p95(&errors) > 60.0, "the test delays pictures: {errors:?}");
}

#[test]
fn wrong_camera_clock_spaces_pictures() {
    let slow = |at: Timestamp| format!("X-Timestamp: {}\r\n", at - Duration::from_secs(3600));
    let (errors, time_source) = errors_of_stated_times(slow);
    assert_eq!(time_source, TimeSource::WrongStamp);
    let spread = errors[20] - errors[2];
    assert!(spread < 20.0, "{errors:?}");
}

#[test]
fn damaged_pictures_of_stream_are_skipped() {
    let url = network_camera(|visitor| {
        let [first, cut, middle, garbage, last] =
            [40, 80, 120, 160, 200].map(|value| encode_jpeg(&gray(value), 95).unwrap());
        let mut pictures = vec![first; 10];
        pictures.push(cut[..cut.len() - 20].to_vec());
        pictures.push(middle);
        pictures.push(vec![7; garbage.len()]);
        pictures.extend(vec![last; 10]);
        send_pictures(visitor, &pictures)
    });
    let mut source = open(&format!("kind = 'url'\nurl = '{url}'")).unwrap();
    let (mut seen, skipped) = play_whole_frames(source.as_mut());
    seen.dedup();
    assert!(near(&seen, &[40, 120, 200]), "{seen:?} {skipped:?}");
    assert_eq!(skipped.len(), 2, "{skipped:?}");
    assert!(skipped[0].contains("cut off"), "{skipped:?}");
}

#[test]
fn damaged_pictures_of_file_are_skipped() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("clip.avi");
    let mjpg = VideoWriter::fourcc('M', 'J', 'P', 'G').unwrap();
    let mut writer = VideoWriter::new(&path, mjpg, 20.0, Size::new(64, 48), true).unwrap();
    for value in [40, 80, 120, 160, 200] {
        writer.write(&gray(value)).unwrap();
    }
    writer.release().unwrap();
    let mut avi = fs::read(&path).unwrap();
    let starts: Vec<usize> = (0..avi.len())
        .filter(|at| avi[*at..].starts_with(b"\xff\xd8\xff"))
        .collect();
    assert_eq!(starts.len(), 5);
    // Without the end of the second picture, and the fourth as a whole.
    avi[starts[2] - 40..starts[2] - 8].fill(0);
    avi[starts[3]..starts[4] - 8].fill(7);
    fs::write(&path, avi).unwrap();
    let mut source = open(&format!("kind = 'video'\npath = {path:?}\nlooping = false")).unwrap();
    let began = Instant::now();
    let (seen, skipped) = play_whole_frames(source.as_mut());
    assert!(near(&seen, &[40, 120, 200]), "{seen:?} {skipped:?}");
    assert_eq!(skipped.len(), 2, "{skipped:?}");
    let played = began.elapsed();
    assert!(
        played > Duration::from_millis(190),
        "five frames: {played:?}"
    );
}

#[test]
fn silent_network_camera_times_out() {
    let held = std::sync::Mutex::new(Vec::new());
    let url = network_camera(move |visitor| {
        held.lock().unwrap().push(visitor);
        Ok(())
    });
    let asked = Instant::now();
    let error = source(&format!("kind = 'url'\nurl = '{url}'")).open(Duration::from_millis(300));
    let error = error.err().expect("no frame arrives").to_string();
    assert!(
        asked.elapsed() < Duration::from_secs(30),
        "it has a limit of its own"
    );
    assert!(
        error.starts_with("cannot open http://127.0.0.1") && !error.contains("hunter2"),
        "{error}"
    );
}

#[test]
fn unopenable_source_names_reason() {
    let directory = tempfile::tempdir().unwrap();
    let text = directory.path().join("clip.avi");
    fs::write(&text, "not a video").unwrap();
    for (path, reason) in [
        (Path::new("no/such.avi"), "No such file"),
        (&text, "no video"),
        (directory.path(), "directory"),
    ] {
        let error = open(&format!("kind = 'video'\npath = {path:?}"))
            .err()
            .expect("cannot be opened")
            .to_string();
        assert!(
            error.starts_with(&format!("cannot open {}", path.display())) && error.contains(reason),
            "{error}"
        );
    }
}

/// Programs `ecod-video` whose parent is this process, as (id, state).
fn video_programs(parent: u32) -> BTreeSet<u32> {
    let processes = fs::read_dir("/proc")
        .unwrap()
        .filter_map(|entry| entry.ok()?.file_name().to_str()?.parse().ok());
    let is_ours = |id: &u32| {
        let status = fs::read_to_string(format!("/proc/{id}/status")).unwrap_or_default();
        let has = |line: &str| status.lines().any(|it| it == line);
        has("Name:\tecod-video")
            && has(&format!("PPid:\t{parent}"))
            && !status.contains("State:\tZ")
    };
    processes.filter(is_ours).collect()
}

fn is_running(id: u32) -> bool {
    let status = fs::read_to_string(format!("/proc/{id}/status")).unwrap_or_default();
    status.contains("Name:\tecod-video") && !status.contains("State:\tZ")
}

fn signal(id: u32, signal: Signal) {
    kill(Pid::from_raw(id as i32), signal).unwrap();
}

/// A separate process that opens this source, so that its program differs from the programs of other tests.
struct Opened {
    process: Child,
    program: u32,
}

/// `ecod-node` with a camera, whose detections come from an empty file.
fn start_node(directory: &Path, source: &str) -> Opened {
    let config = directory.join("node.toml");
    let recorded = directory.join("detections.jsonl");
    fs::write(&recorded, "[]\n").unwrap();
    let text = format!(
        "name = 'euclid'\ncell = 'video'\nrole = 'auto'\nlisten = '127.0.0.1:0'\ndashboard.enabled = false\n\
         membership = {{ bind = '127.0.0.1:0', multicast.enabled = false }}\npose = {{ x_m = 0.0, y_m = 0.0, heading_deg = 0.0 }}\n\
         [camera]\nsource = {source}\ndetector = {{ kind = 'recorded', path = {recorded:?}, looping = true }}\n\
         capture = {{ stall_timeout_s = 1.0, retry_min_s = 0.1, retry_max_s = 0.1 }}\n"
    );
    fs::write(&config, text).unwrap();
    let log = fs::File::create(directory.join("log")).unwrap();
    let mut node = Command::new(env!("CARGO_BIN_EXE_ecod-node"));
    node.env("RUST_LOG", "debug")
        .args(["--stop-at-eof", "--config"])
        .arg(config);
    let process = node
        .stdin(Stdio::piped())
        .stdout(Stdio::null())
        .stderr(log)
        .spawn()
        .unwrap();
    let id = process.id();
    until("the node has a program", || !video_programs(id).is_empty());
    Opened {
        program: *video_programs(id).first().unwrap(),
        process,
    }
}

impl Drop for Opened {
    fn drop(&mut self) {
        self.process.kill().ok();
        self.process.wait().unwrap();
    }
}

fn log(directory: &Path) -> String {
    fs::read_to_string(directory.join("log")).unwrap()
}

/// A directory with a clip, and it as a source that plays for ever.
fn looping_clip() -> (tempfile::TempDir, String) {
    let directory = tempfile::tempdir().unwrap();
    let path: PathBuf = directory.path().join("clip.avi");
    write_clip(&path, 20.0);
    let source = format!("{{ kind = 'video', path = {path:?}, looping = true }}");
    (directory, source)
}

#[test]
fn killed_program_is_replaced() {
    let (directory, source) = looping_clip();
    let node = start_node(directory.path(), &source);
    signal(node.program, Signal::SIGKILL);
    until("the node reports it", || {
        log(directory.path()).contains("ecod-video ended, signal: 9 (SIGKILL)")
    });
    until("frames come again", || {
        log(directory.path()).contains("frame source runs again")
    });
    assert!(!video_programs(node.process.id()).contains(&node.program));
}

#[test]
fn hanging_program_is_replaced() {
    let (directory, source) = looping_clip();
    let node = start_node(directory.path(), &source);
    signal(node.program, Signal::SIGSTOP);
    until("the node reports it", || {
        log(directory.path()).contains("no frame for")
    });
    until("frames come again", || {
        log(directory.path()).contains("frame source runs again")
    });
    until("the one that hung is gone", || !is_running(node.program));
}

#[test]
fn no_program_outlives_its_node() {
    let (directory, source) = looping_clip();
    let mut stopped = start_node(directory.path(), &source);
    drop(stopped.process.stdin.take());
    assert!(stopped.process.wait().unwrap().success());
    until("it ends with a node that stops", || {
        !is_running(stopped.program)
    });

    let mut killed = start_node(directory.path(), &source);
    killed.process.kill().unwrap();
    until("it ends with a node that is killed", || {
        !is_running(killed.program)
    });
}

#[test]
fn address_secrets_stay_hidden() {
    let directory = tempfile::tempdir().unwrap();
    let url = network_camera(|visitor| {
        motion_jpeg(visitor.try_clone()?)?;
        // Longer than the node waits.
        std::thread::sleep(PATIENCE);
        Ok(())
    });
    let node = start_node(
        directory.path(),
        &format!("{{ kind = 'url', url = '{url}' }}"),
    );
    for file in ["cmdline", "environ"] {
        let text = fs::read(format!("/proc/{}/{file}", node.program)).unwrap();
        assert!(
            !String::from_utf8_lossy(&text).contains("hunter2"),
            "{file}"
        );
    }
    until("the camera is lost", || {
        log(directory.path()).contains("frame source failed")
    });
    assert!(
        !log(directory.path()).contains("hunter2"),
        "{}",
        log(directory.path())
    );
}

#[tokio::test]
async fn capture_ends_with_video() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("clip.avi");
    write_clip(&path, 200.0);
    let source = source(&format!("kind = 'video'\npath = {path:?}"));
    let opener = source.opener(Duration::from_secs(5));
    let capture = Capture::start(opener, CaptureConfig::default()).unwrap();
    let mut last = None;
    while let Some(frame) = capture.next_frame().await {
        last = Some(brightness(&frame));
    }
    assert!(near(&[last.expect("frames")], &[200]));
    assert_eq!(*capture.status().borrow(), CaptureStatus::Ended);
}
