use std::f64::consts::FRAC_PI_2;

use super::*;
use crate::ros2::RegionOfInterest;

/// One object in a frame, with its variances along the frame's axes.
fn message(frame: &str, at: [f64; 3], variances: [f64; 3], yaw_rad: f64) -> Detection3DArray {
    let mut covariance = vec![0.0; 36];
    variances
        .iter()
        .zip([0, 7, 14])
        .for_each(|(variance, place)| covariance[place] = *variance);
    let [x, y, z] = at;
    let (sin, cos) = (yaw_rad / 2.0).sin_cos();
    let header =
        r#"{"stamp": {"sec": 1000, "nanosec": 5000}, "frame_id": "FRAME"}"#.replace("FRAME", frame);
    let pose = |x: f64, y: f64, z: f64| {
        format!(
            r#"{{"position": {{"x": {x}, "y": {y}, "z": {z}}}, "orientation": {{"x": 0, "y": 0, "z": {sin}, "w": {cos}}}}}"#
        )
    };
    let rows: Vec<_> = covariance.chunks(6).collect();
    let text = format!(
        r#"{{"header": {header}, "detections": [{{"header": {header}, "id": "",
            "results": [{{"hypothesis": {{"class_id": "2", "score": 0.9}},
                "pose": {{"pose": {}, "covariance": {rows:?}}}}}],
            "bbox": {{"center": {}, "size": {{"x": 4.2, "y": 1.8, "z": 1.5}}}}}}]}}"#,
        pose(0.0, 0.0, 0.0),
        pose(x, y, z)
    );
    serde_json::from_str(&text).unwrap()
}

fn camera() -> RosCamera {
    let pose = Some(Pose::new(5.0, 1.0, FRAC_PI_2));
    RosCamera {
        pose,
        labels: [("2".to_owned(), "car".to_owned())].into(),
        ..RosCamera::default()
    }
}

fn reason<T>(placed: Result<T, RefusedInput>) -> Option<InputRefusal> {
    placed.err().map(|refused| refused.refusal)
}

fn only(camera: &RosCamera, message: &Detection3DArray) -> PerceivedObject {
    let (frame, refused) = camera.place(message, None).unwrap();
    assert!(refused.is_empty(), "{refused:?}");
    assert_eq!(
        frame.captured_at,
        SystemTime::UNIX_EPOCH + Duration::from_micros(1_000_000_005)
    );
    frame.objects.into_iter().next().unwrap()
}

#[test]
fn scores_outside_probability_are_refused() {
    let one = message("map", [7.0, 11.0, 0.5], [0.1, 2.0, 0.1], 0.0);
    for (score, hypotheses) in [(f64::NAN, 2), (2.5, 2), (-0.5, 1)] {
        let mut message = one.clone();
        let results = &mut message.detections[0].results;
        results.resize(hypotheses, results[0].clone());
        results.last_mut().unwrap().hypothesis.score = score;
        let (frame, refused) = camera().place(&message, None).unwrap();
        let reported: Vec<_> = refused
            .iter()
            .map(|refused| (refused.refusal, refused.detail.as_str()))
            .collect();
        assert_eq!(
            (frame.objects.len(), reported),
            (
                0,
                vec![(InputRefusal::Score, format!(": {score} of \"2\"").as_str())]
            )
        );
    }
}

#[test]
fn position_is_frame_independent() {
    // 10 m ahead of a camera that looks north, 2 m to its right; least certain along the view.
    let stated = [
        message("map", [7.0, 11.0, 0.5], [0.1, 2.0, 0.1], FRAC_PI_2),
        message("front", [10.0, -2.0, 0.5], [2.0, 0.1, 0.1], 0.0),
        message(
            "front_camera_optical_frame",
            [2.0, -0.5, 10.0],
            [0.1, 0.1, 2.0],
            0.0,
        ),
    ];
    for message in &stated {
        let object = only(&camera(), message);
        assert!(
            (object.x_m - 7.0).abs() < 1e-9 && (object.y_m - 11.0).abs() < 1e-9,
            "{object:?}"
        );
        let [xx, xy, yy] = object.covariance_m2.unwrap();
        assert!(
            (xx - 0.1).abs() < 1e-9 && xy.abs() < 1e-9 && (yy - 2.0).abs() < 1e-9,
            "{object:?}"
        );
        assert_eq!((object.label.as_str(), object.confidence), ("car", 0.9));
    }
    let [in_map, before, optical] = stated.map(|message| only(&camera(), &message));
    assert!(
        (in_map.heading_rad.unwrap() - FRAC_PI_2).abs() < 1e-9 && in_map.size_m == Some([4.2, 1.8])
    );
    assert_eq!(
        (before.heading_rad, before.size_m),
        (None, Some([4.2, 1.8])),
        "not turned: the orientation is unknown"
    );
    assert_eq!((optical.heading_rad, optical.size_m), (None, None));
}

#[test]
fn classes_of_one_label_sum() {
    let labels = [
        ("2".to_owned(), "car".to_owned()),
        ("7".to_owned(), "car".to_owned()),
    ]
    .into();
    let mut message = message("map", [1.0, 0.0, 0.0], [0.1; 3], 0.0);
    let results = &mut message.detections[0].results;
    results.extend([results[0].clone(), results[0].clone()]);
    for (result, (class, score)) in results
        .iter_mut()
        .zip([("2", 0.35), ("0", 0.4), ("7", 0.25)])
    {
        result.hypothesis = ObjectHypothesis {
            class_id: class.to_owned(),
            score,
        };
    }
    let camera = RosCamera { labels, ..camera() };
    let object = only(&camera, &message);
    assert_eq!((object.label.as_str(), object.confidence), ("car", 0.6));
    assert_eq!(
        object.scores,
        [("0".into(), 0.4), ("car".into(), 0.6)].into()
    );
    message.detections[0]
        .results
        .iter_mut()
        .for_each(|result| result.hypothesis.score = 0.8);
    assert_eq!(
        only(&camera, &message).confidence,
        1.0,
        "of independent scores"
    );
}

#[test]
fn tilted_camera_places_objects_nearer() {
    let mount = Mount {
        height_m: Some(3.0),
        pitch_rad: 0.5,
        ..Mount::default()
    };
    let tilted = RosCamera { mount, ..camera() };
    let object = only(
        &tilted,
        &message("front_optical", [0.0, 0.0, 10.0], [0.0; 3], 0.0),
    );
    assert!(
        (object.y_m - 1.0 - 10.0 * 0.5f64.cos()).abs() < 1e-9 && (object.x_m - 5.0).abs() < 1e-9,
        "{object:?}"
    );
    assert_eq!(object.covariance_m2, None, "zeros mean unknown");
}

#[test]
fn binned_image_gives_equal_positions() {
    let boxes = |x: f64, y: f64, size_x: f64, size_y: f64, theta: f64| -> Detection2DArray {
        let header = r#"{"stamp": {"sec": 1000, "nanosec": 5000}, "frame_id": "front"}"#;
        let results = serde_json::to_value(
            message("map", [0.0; 3], [0.0; 3], 0.0)
                .detections
                .remove(0)
                .results,
        )
        .unwrap();
        let bbox = format!(
            r#"{{"center": {{"position": {{"x": {x}, "y": {y}}}, "theta": {theta}}}, "size_x": {size_x}, "size_y": {size_y}}}"#
        );
        let detection =
            format!(r#"{{"header": {header}, "results": {results}, "bbox": {bbox}, "id": ""}}"#);
        serde_json::from_str(&format!(
            r#"{{"header": {header}, "detections": [{detection}]}}"#
        ))
        .unwrap()
    };
    let fx = 900.0;
    let cx = 640.0;
    let cy = 480.0;
    let k = [fx, 0.0, cx, 0.0, fx, cy, 0.0, 0.0, 1.0];
    let whole = CameraInfo {
        width: 1280,
        height: 960,
        k,
        ..CameraInfo::default()
    };
    let roi = RegionOfInterest {
        x_offset: 200,
        y_offset: 100,
        width: 800,
        height: 600,
        ..RegionOfInterest::default()
    };
    let part = CameraInfo {
        binning_x: 2,
        binning_y: 2,
        roi,
        ..whole.clone()
    };
    let mount = Mount {
        height_m: Some(1.5),
        ..Mount::default()
    };
    let camera = RosCamera { mount, ..camera() };
    let place = |boxes: &Detection2DArray, optics| {
        let (frame, refused) = place_in_pictures(&camera, boxes, Some(optics), None).unwrap();
        assert!(refused.is_empty(), "{refused:?}");
        (frame.objects[0].x_m, frame.objects[0].y_m)
    };
    let (x, y) = place(&boxes(700.0, 520.0, 120.0, 100.0, 0.0), &whole);
    let turned = place(&boxes(700.0, 520.0, 100.0, 120.0, FRAC_PI_2), &whole);
    let binned = place(&boxes(250.0, 210.0, 60.0, 50.0, 0.0), &part);
    // A pixel's noise is twice as large there.
    for ((other_x, other_y), within_m) in [(turned, 1e-6), (binned, 0.1)] {
        let error_m = (x - other_x).hypot(y - other_y);
        assert!(error_m < within_m, "{x} {y}, {other_x} {other_y}");
    }
}

fn pose_at(frame: &str, seconds: u32, x: f64, yaw_rad: f64) -> PoseStamped {
    let (sin, cos) = (yaw_rad / 2.0).sin_cos();
    let text = format!(
        r#"{{"header": {{"stamp": {{"sec": {seconds}, "nanosec": 0}}, "frame_id": "{frame}"}},
            "pose": {{"position": {{"x": {x}, "y": 1, "z": 0.7}}, "orientation": {{"x": 0, "y": 0, "z": {sin}, "w": {cos}}}}}}}"#
    );
    serde_json::from_str(&text).unwrap()
}

#[test]
fn camera_uses_pose_at_stamp() {
    let mut poses = PoseHistory::default();
    for (seconds, x, yaw_rad) in [
        (999, 4.0, FRAC_PI_2),
        (1000, 5.0, FRAC_PI_2),
        (1001, 205.0, FRAC_PI_2),
    ] {
        let (at, pose) = pose_in_map(&pose_at("map", seconds, x, yaw_rad)).unwrap();
        assert!(poses.push(at, pose));
    }
    // 5 µs after the second pose, at 200 m/s; the pose in the settings does not apply to a moving
    // camera.
    let moving = RosCamera {
        pose: Some(Pose::new(99.0, 99.0, 0.0)),
        ..camera()
    };
    let (frame, refused) = moving
        .place(
            &message("front", [10.0, -2.0, 0.5], [0.0; 3], 0.0),
            Some(&poses),
        )
        .unwrap();
    assert!(refused.is_empty(), "{refused:?}");
    let stated = frame.pose.unwrap();
    let object = &frame.objects[0];
    let all = [
        stated.x_m,
        stated.y_m,
        stated.heading_rad,
        object.x_m,
        object.y_m,
    ];
    let expected = [5.001, 1.0, FRAC_PI_2, 7.001, 11.0];
    assert!(
        all.iter()
            .zip(expected)
            .all(|(got, expected)| (got - expected).abs() < 1e-6),
        "{all:?}"
    );
    let mut late = message("front", [10.0, -2.0, 0.5], [0.0; 3], 0.0);
    late.header = pose_at("front", 1002, 0.0, 0.0).header;
    assert_eq!(
        reason(moving.place(&late, Some(&poses))),
        Some(InputRefusal::NoPose)
    );
    let boxes = Detection2DArray {
        header: late.header,
        detections: Vec::new(),
    };
    let optics = CameraInfo::default();
    assert_eq!(
        reason(place_in_pictures(
            &moving,
            &boxes,
            Some(&optics),
            Some(&poses)
        )),
        Some(InputRefusal::NoPose)
    );
    late.header = Header {
        frame_id: "map".to_owned(),
        ..boxes.header
    };
    assert_eq!(
        moving.place(&late, Some(&poses)).unwrap().0.pose,
        None,
        "no place is relative to the camera"
    );
}

#[test]
fn pose_needs_map_frame_and_direction() {
    let refusal = |stamped: &PoseStamped| reason(pose_in_map(stamped));
    assert_eq!(
        refusal(&pose_at("odom", 1000, 1.0, 0.0)),
        Some(InputRefusal::BadPose)
    );
    let mut unset = pose_at("map", 1000, 1.0, 0.0);
    unset.pose.orientation.w = 0.0;
    assert_eq!(refusal(&unset), Some(InputRefusal::BadPose));
    let mut nowhere = pose_at("map", 1000, 1.0, 0.0);
    nowhere.pose.position.x = f64::NAN;
    assert_eq!(refusal(&nowhere), Some(InputRefusal::BadPose));
}

#[test]
fn unplaceable_detections_name_reason() {
    let nowhere = RosCamera {
        pose: None,
        ..camera()
    };
    let front = nowhere
        .place(&message("front", [1.0, 0.0, 0.0], [0.1; 3], 0.0), None)
        .unwrap_err();
    assert_eq!(
        (front.refusal, front.detail.as_str()),
        (InputRefusal::NoPose, ": \"front\"")
    );
    let of_objects = |message: &Detection3DArray| {
        let (_, refused) = nowhere.place(message, None).unwrap();
        refused
            .iter()
            .map(|refused| format!("{:?}{}", refused.refusal, refused.detail))
            .collect::<Vec<_>>()
    };
    let far = of_objects(&message("map", [1e300, 0.0, 0.0], [0.1; 3], 0.0));
    assert!(
        far.len() == 1 && far[0].starts_with("Report: x_m: "),
        "{far:?}"
    );
    let mut unknown = message("map", [1.0, 0.0, 0.0], [0.1; 3], 0.0);
    unknown.detections[0].results.clear();
    assert_eq!(of_objects(&unknown), ["NoClass"]);
    let boxes = Detection2DArray {
        header: unknown.header,
        detections: Vec::new(),
    };
    assert_eq!(
        reason(place_in_pictures(&camera(), &boxes, None, None)),
        Some(InputRefusal::NoOptics)
    );
    let unset = CameraInfo::default();
    assert_eq!(
        reason(place_in_pictures(&camera(), &boxes, Some(&unset), None)),
        Some(InputRefusal::BadOptics)
    );
}
