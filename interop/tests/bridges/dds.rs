//! Live topics of ROS 2: a cell's messages, taken by Cyclone DDS for Python, and its detections, reported to a real node.

use std::process::Command;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

use ecod::model::geometry::Pose;
use ecod::perception::camera::Mount;
use ecod::perception::projection::{ObjectSize, ObjectSizes, ProjectionConfig};
use ecod_actors::node;
use ecod_client::{Cell, Frame, PerceivedObject, Role, Settings, WirePose};
use ecod_interop::dds::{DetectorTopics, RosBridge, RosBridgeError, RosCamera, RosSettings};
use ecod_testkit::node_config;
use tokio::runtime::Runtime;

/// Runs a bridge beside an edge to which a vehicle reports. It ends once Python has published such detections, and found an
/// object of this label at this place of the map.
fn exchange(kind: &str, ros: RosSettings, label: &str, place_m: [f64; 2]) {
    let python = std::env::var("DDS_PYTHON").unwrap();
    let config = node_config("edge", "lot-1", Role::Edge);
    let runtime = Runtime::new().unwrap();
    let handle = runtime.block_on(node::start(config)).unwrap();
    let broker = handle.listens_at().unwrap().to_string();
    let settings = Settings {
        broker,
        cell: "lot-1".into(),
        node: "edge".into(),
        ..Settings::default()
    };
    let vehicle = Settings {
        node: "euclid-2".into(),
        part: String::new(),
        ..settings.clone()
    };
    let vehicle = Cell::connect(vehicle).unwrap();
    let bridge = RosBridge::connect(settings, ros).unwrap();
    let is_done = AtomicBool::new(false);
    thread::scope(|scope| {
        let carried = scope.spawn(|| bridge.run());
        scope.spawn(|| {
            while !is_done.load(Ordering::Relaxed) {
                let car = PerceivedObject::new("car", 0.9, 30.0, 40.0);
                let pose = Some(WirePose::new(31.0, 36.0, 1.57));
                vehicle
                    .report(Frame {
                        pose,
                        ..Frame::new(vec![car])
                    })
                    .unwrap();
                thread::sleep(Duration::from_millis(100));
            }
        });
        let script = concat!(env!("CARGO_MANIFEST_DIR"), "/../packaging/check-dds.py");
        let place = place_m.map(|metres| metres.to_string());
        let run = Command::new(python)
            .arg(script)
            .args([kind, label])
            .args(place)
            .output()
            .unwrap();
        is_done.store(true, Ordering::Relaxed);
        bridge.close();
        carried.join().unwrap().unwrap();
        assert!(
            run.status.success(),
            "{}{:?}",
            String::from_utf8_lossy(&run.stderr),
            bridge.refusals()
        );
        assert!(
            bridge.refusals().is_empty() || ["pictures", "driving"].contains(&kind),
            "{:?}",
            bridge.refusals()
        );
        print!("{}", String::from_utf8_lossy(&run.stdout));
    });
    runtime.block_on(handle.stop());
}

/// A camera 5 m east and 1 m north of the origin that looks north, of a detector whose class 2 are posts.
fn camera() -> RosCamera {
    let labels = [("2".to_owned(), "post".to_owned())].into();
    let post = ObjectSize {
        height_m: 1.5,
        ..ObjectSize::square(0.2)
    };
    let sizes = ObjectSizes {
        labels: [("post".into(), post)].into(),
        ..ObjectSizes::default()
    };
    let projection = ProjectionConfig {
        sizes,
        ..RosCamera::default().projection
    };
    let pose = Some(Pose::new(5.0, 1.0, 90f64.to_radians()));
    RosCamera {
        pose,
        mount: Mount {
            height_m: Some(0.75),
            ..Mount::default()
        },
        projection,
        labels,
    }
}

#[test]
#[ignore = "needs a network of its own and Python packages: `make dds-check`"]
fn map_frame_detections_become_objects() {
    let input = DetectorTopics::InSpace("/detections".to_owned());
    exchange(
        "map",
        RosSettings {
            input: Some(input),
            ..RosSettings::default()
        },
        "truck",
        [12.0, -5.0],
    );
}

#[test]
#[ignore = "needs a network of its own and Python packages: `make dds-check`"]
fn camera_detections_use_pose() {
    let input = DetectorTopics::InSpace("detections".to_owned());
    let ros = RosSettings {
        input: Some(input),
        camera: camera(),
        ..RosSettings::default()
    };
    exchange("optical", ros, "truck", [7.0, 11.0]);
}

#[test]
#[ignore = "needs a network of its own and Python packages: `make dds-check`"]
fn moving_camera_detections_use_poses() {
    let input = Some(DetectorTopics::InSpace("/detections".to_owned()));
    let camera = RosCamera {
        pose: None,
        ..camera()
    };
    let ros = RosSettings {
        input,
        pose_topic: Some("/camera_pose".to_owned()),
        camera,
        ..RosSettings::default()
    };
    exchange("driving", ros, "truck", [7.0, 11.0]);
}

#[test]
#[ignore = "needs a network of its own and Python packages: `make dds-check`"]
fn image_boxes_use_optics_and_ground() {
    let input = DetectorTopics::InPictures("/detections".to_owned(), "/camera_info".to_owned());
    let ros = RosSettings {
        input: Some(input),
        camera: camera(),
        ..RosSettings::default()
    };
    exchange("pictures", ros, "post", [7.0, 11.0]);
}

#[test]
fn bridge_topics_are_no_detectors() {
    let optics = || "/camera_info".to_owned();
    let inputs = [
        (
            Some(DetectorTopics::InSpace("/ecod/map/detections".to_owned())),
            None,
        ),
        (
            Some(DetectorTopics::InPictures(
                "ecod/euclid/detections".to_owned(),
                optics(),
            )),
            None,
        ),
        (
            Some(DetectorTopics::InSpace("/detections".to_owned())),
            Some("/ecod/pose".to_owned()),
        ),
    ];
    for (input, pose_topic) in inputs {
        let ros = RosSettings {
            input,
            pose_topic,
            ..RosSettings::default()
        };
        let refused = RosBridge::connect(Settings::default(), ros).err();
        assert!(
            matches!(refused, Some(RosBridgeError::OwnTopic(_))),
            "{refused:?}"
        );
    }
}
