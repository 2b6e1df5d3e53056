//! The log of a real node, written for ROS 2 and read by others.

use std::collections::BTreeMap;
use std::io::{Cursor, Seek, Write};
use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use ecod_actors::node;
use ecod_actors::node::config::NodeConfig;
use ecod_actors::observe::recorder::{RecordConfig, files};
use ecod_client::{Cell, Frame, PerceivedObject, Role, Settings, WirePose};
use ecod_interop::ros2::{Conversion, ConversionError, RosLog};
use ecod_testkit::{node_config, output_of};
use tokio::runtime::Runtime;

/// Writes a log as MCAP of profile `ros2`.
fn convert(log: &[u8], output: impl Write + Seek) -> Result<Conversion, ConversionError> {
    let mut converted = RosLog::new(output)?;
    converted.add(log)?;
    converted.finish()
}

/// Has a vehicle report a car to an edge until the map has it for a second; gives the edge's log.
fn log(directory: &Path) -> Vec<u8> {
    let config = NodeConfig {
        record: Some(RecordConfig {
            dir: directory.to_owned(),
            ..RecordConfig::default()
        }),
        ..node_config("edge", "lot-1", Role::Edge)
    };
    let runtime = Runtime::new().unwrap();
    let handle = runtime.block_on(node::start(config)).unwrap();
    let broker = handle.listens_at().unwrap().to_string();
    let cell = "lot-1".into();
    let settings = Settings {
        broker,
        cell,
        node: "euclid-2".into(),
        part: String::new(),
        ..Settings::default()
    };
    let vehicle = Cell::connect(settings).unwrap();
    let began = Instant::now();
    let mut with_car = 0;
    for map in vehicle.maps() {
        with_car += usize::from(
            map.unwrap()
                .objects
                .iter()
                .any(|object| object.label == "car"),
        );
        let car = PerceivedObject {
            heading_rad: Some(1.5),
            ..PerceivedObject::new("car", 0.93, 12.5, -3.0)
        };
        let pose = Some(WirePose::new(1.0, 6.0, -1.57));
        vehicle
            .report(Frame {
                pose,
                ..Frame::new(vec![car])
            })
            .unwrap();
        assert!(began.elapsed() < Duration::from_secs(30));
        if with_car >= 10 {
            break;
        }
    }
    runtime.block_on(handle.stop());
    std::fs::read(&files(&directory.join("edge")).unwrap_or(files(directory).unwrap())[0]).unwrap()
}

#[test]
fn log_converts_to_ros_messages() {
    let directory = tempfile::tempdir().unwrap();
    let log = log(directory.path());
    let mut bytes = Vec::new();
    let done = convert(&log, Cursor::new(&mut bytes)).unwrap();
    assert!(
        done.written > 20 && done.unusable == 0 && done.cut == 0,
        "{done:?}"
    );
    let mut counts = BTreeMap::<_, u32>::new();
    for message in mcap::MessageStream::new(&bytes).unwrap() {
        let channel = message.unwrap().channel;
        let schema = channel.schema.as_ref().unwrap();
        assert_eq!(
            (channel.message_encoding.as_str(), schema.encoding.as_str()),
            ("cdr", "ros2msg")
        );
        *counts
            .entry((channel.topic.clone(), schema.name.clone()))
            .or_default() += 1;
    }
    let topics: Vec<_> = counts
        .keys()
        .map(|(topic, schema)| (topic.as_str(), schema.as_str()))
        .collect();
    assert_eq!(
        topics,
        [
            (
                "/ecod/euclid_2/detections",
                "vision_msgs/msg/Detection3DArray"
            ),
            ("/ecod/map/detections", "vision_msgs/msg/Detection3DArray"),
            ("/ecod/map/markers", "visualization_msgs/msg/MarkerArray"),
            ("/tf", "tf2_msgs/msg/TFMessage"),
        ]
    );
    // Logs of a drive become one. What is before the end of one that is cut is there.
    let mut all = RosLog::new(Cursor::new(Vec::new())).unwrap();
    let quarter = &log[..log.len() / 4];
    for part in [&log, quarter, &log] {
        all.add(part).unwrap();
    }
    let all = all.finish().unwrap();
    assert!(
        all.cut == 1
            && all.unusable == 0
            && (2 * done.written..=3 * done.written).contains(&all.written),
        "{all:?} {done:?}"
    );
    assert!(matches!(
        convert(&log[..100], Cursor::new(Vec::new())),
        Err(ConversionError::Empty(0))
    ));
    assert!(matches!(
        convert(b"[camera]", Cursor::new(Vec::new())),
        Err(ConversionError::NoLog)
    ));
    let endless = [&log[..8], &[1, 255, 255, 255, 255, 255, 255, 255, 255]].concat();
    assert!(matches!(
        convert(&endless, Cursor::new(Vec::new())),
        Err(ConversionError::Empty(0))
    ));
}

/// A log with the optics of a camera, a picture, and one that is none.
fn camera_log() -> Vec<u8> {
    let mut log = Vec::new();
    let mut writer = mcap::Writer::new(Cursor::new(&mut log)).unwrap();
    let at = 1_795_239_882_123_000_000;
    let optics = r#"{"timestamp":{"sec":1795239882,"nsec":123000000},"frame_id":"cam-1/optical","width":640,"height":480,
        "distortion_model":"plumb_bob","D":[-0.3,0.1,0.001,-0.002,0.0],"K":[554.25,0.0,320.0,0.0,554.25,240.0,0.0,0.0,1.0],
        "R":[1.0,0.0,0.0,0.0,1.0,0.0,0.0,0.0,1.0],"P":[554.25,0.0,320.0,0.0,0.0,554.25,240.0,0.0,0.0,0.0,1.0,0.0]}"#;
    for (topic, message) in [
        ("camera_calibration", optics),
        (
            "camera",
            r#"{"frame_id":"cam-1/optical","data":"/9j/","format":"jpeg"}"#,
        ),
        (
            "camera",
            r#"{"frame_id":"cam-1","data":"?","format":"jpeg"}"#,
        ),
    ] {
        let channel_id = writer
            .add_channel(0, topic, "json", &BTreeMap::new())
            .unwrap();
        let header = mcap::records::MessageHeader {
            channel_id,
            sequence: 0,
            log_time: at,
            publish_time: at,
        };
        writer
            .write_to_known_channel(&header, message.as_bytes())
            .unwrap();
    }
    writer.finish().unwrap();
    drop(writer);
    log
}

#[test]
fn picture_keeps_bytes_and_optics() {
    let mut bytes = Vec::new();
    let done = convert(&camera_log(), Cursor::new(&mut bytes)).unwrap();
    assert_eq!((done.written, done.unusable), (2, 1));
    let messages: Vec<_> = mcap::MessageStream::new(&bytes)
        .unwrap()
        .map(Result::unwrap)
        .collect();
    let [info, picture] = &messages[..] else {
        panic!("{messages:?}")
    };
    assert_eq!(
        picture.channel.schema.as_ref().unwrap().name,
        "sensor_msgs/msg/CompressedImage"
    );
    // Header, seconds, nanoseconds; two texts with their lengths; three bytes.
    assert_eq!(picture.data[4..8], 1_795_239_882_i32.to_le_bytes());
    assert!(
        picture.data.ends_with(&[3, 0, 0, 0, 0xff, 0xd8, 0xff]),
        "{:?}",
        picture.data
    );
    assert_eq!(info.channel.topic, "/ecod/camera/camera_info");
    assert_eq!(
        info.channel.schema.as_ref().unwrap().name,
        "sensor_msgs/msg/CameraInfo"
    );
    let frame = b"cam_1_camera_optical\0";
    for message in [info, picture] {
        assert!(
            message.data.windows(frame.len()).any(|part| part == frame),
            "both are in one frame"
        );
    }
}

#[test]
fn invalid_log_leaves_no_output() {
    let directory = tempfile::tempdir().unwrap();
    let log = directory.path().join("log.mcap");
    let output = directory.path().join("ros2.mcap");
    let run = || {
        let program = Command::new(env!("CARGO_BIN_EXE_ecod-interop"))
            .arg("ros2")
            .args([&log, &output])
            .output()
            .unwrap();
        (
            program.status.code(),
            String::from_utf8(program.stderr).unwrap(),
        )
    };
    std::fs::write(&log, "a letter, and no log of a node").unwrap();
    for _ in 0..2 {
        let (code, said) = run();
        assert!(
            code == Some(2) && said.contains("log.mcap") && !output.exists(),
            "{code:?} {said}"
        );
    }
    std::fs::write(&log, camera_log()).unwrap();
    assert_eq!(run().0, Some(0));
    let first = std::fs::read(&output).unwrap();
    assert!(
        !first.is_empty() && run().0 == Some(2),
        "the file of another program is kept"
    );
    assert_eq!(std::fs::read(&output).unwrap(), first);
}

#[test]
#[ignore = "needs Python packages, which `make ros2-check` installs"]
fn ros_readers_write_equal_bytes() {
    let python = std::env::var("ROS2_PYTHON").unwrap();
    let directory = tempfile::tempdir().unwrap();
    let outputs = ["node.mcap", "camera.mcap"].map(|name| directory.path().join(name));
    for (log, output) in [log(directory.path()), camera_log()].iter().zip(&outputs) {
        convert(log, std::fs::File::create(output).unwrap()).unwrap();
    }
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/../packaging/check-ros2.py");
    let mut reader = Command::new(python);
    print!("{}", output_of(reader.arg(script).args(&outputs)));
}
