//! Capture times of a Video4Linux camera. The camera is `fake_camera.c`, which a copy of this
//! program preloads; its pictures contain the time when they were taken.

use std::path::Path;
use std::process::Command;
use std::time::Duration;

use ecod_actors::camera::config::CameraConfig;
use ecod_actors::camera::frame::CameraFrame;
use ecod_actors::camera::frame_source::TimeSource;
use ecod_actors::platform::clock;
use opencv::core::Vec3b;
use opencv::prelude::*;

/// Flags of a buffer that is stamped at the start of exposure by the monotonic clock.
const MONOTONIC_SOE: &str = "0x12000";

/// Runs [`capture_late`] with a camera that has these flags and stamps, and returns its output.
fn captured(settings: &[(&str, &str)]) -> Observed {
    let directory = tempfile::tempdir().unwrap();
    let library = directory.path().join("camera.so");
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/programs/fake_camera.c");
    let compiled = Command::new("cc")
        .args(["-O1", "-shared", "-fPIC", "-o"])
        .arg(&library)
        .arg(source)
        .args(["-ldl", "-lpthread"])
        .status()
        .unwrap();
    assert!(compiled.success());
    let run = Command::new(std::env::current_exe().unwrap())
        .args(["--exact", "v4l2_camera::capture_late", "--ignored"])
        .arg("--nocapture")
        .env("LD_PRELOAD", &library)
        .env("FAKE_CAMERA", directory.path().join("video0"))
        .envs(settings.iter().copied())
        .output()
        .unwrap();
    let output = String::from_utf8(run.stdout).unwrap();
    let line = output
        .lines()
        .find_map(|line| line.strip_prefix("late by "));
    let line = line.unwrap_or_else(|| panic!("{output}{}", String::from_utf8_lossy(&run.stderr)));
    let (late_us, time_source) = line.split_once(" us at p95 by ").unwrap();
    Observed {
        late_us: late_us.parse().unwrap(),
        time_source: time_source.to_owned(),
    }
}

struct Observed {
    /// 95th percentile of the difference of stated and true time.
    late_us: u64,
    time_source: String,
}

/// Time in a picture, on the node's clock.
fn taken_us(frame: &CameraFrame) -> u64 {
    let bytes =
        std::array::from_fn(|column| frame.image.at_2d::<Vec3b>(0, column as i32).unwrap()[0]);
    let age = clock::monotonic() - Duration::from_micros(u64::from_le_bytes(bytes));
    (clock::now() - age).micros()
}

/// Reads a camera with delays. The other tests run it in a process with the fake camera.
#[test]
#[ignore = "needs the fake camera"]
fn capture_late() {
    let device = std::env::var("FAKE_CAMERA").unwrap();
    let camera: CameraConfig = toml::from_str(&format!(
        "source = {{ kind = 'v4l2', device = '{device}' }}\ndetector.kind = 'placard'"
    ))
    .unwrap();
    let mut source = camera.open(Duration::from_secs(5)).unwrap();
    let mut late_us: Vec<u64> = (0..40)
        .map(|number| {
            std::thread::sleep(Duration::from_millis(number * 37 % 120));
            let frame = source.next_frame().unwrap();
            frame.captured_at.micros().abs_diff(taken_us(&frame))
        })
        .collect();
    late_us.sort_unstable();
    println!(
        "late by {} us at p95 by {}",
        late_us[37],
        source.time_source()
    );
}

#[test]
fn late_reading_keeps_capture_time() {
    let observed = captured(&[("FAKE_CAMERA_FLAGS", MONOTONIC_SOE)]);
    assert_eq!(observed.time_source, TimeSource::Stamp.to_string());
    assert!(observed.late_us < 1000, "{} us", observed.late_us);
}

#[test]
fn implausible_driver_stamps_give_arrival() {
    for settings in [
        &[("FAKE_CAMERA_FLAGS", "0")][..],
        &[
            ("FAKE_CAMERA_FLAGS", MONOTONIC_SOE),
            ("FAKE_CAMERA_AHEAD_US", "500000"),
        ],
    ] {
        let observed = captured(settings);
        assert_eq!(observed.time_source, TimeSource::Arrival.to_string());
        assert!(
            (15_000..500_000).contains(&observed.late_us),
            "{} us",
            observed.late_us
        );
    }
}

#[test]
fn wrong_driver_clock_gives_spacing() {
    let observed = captured(&[
        ("FAKE_CAMERA_FLAGS", MONOTONIC_SOE),
        ("FAKE_CAMERA_AHEAD_US", "-60000000"),
    ]);
    assert_eq!(observed.time_source, TimeSource::WrongStamp.to_string());
    assert!(observed.late_us < 500_000, "{} us", observed.late_us);
}
