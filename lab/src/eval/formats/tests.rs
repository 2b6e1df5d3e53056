use std::fs;

use tempfile::TempDir;

use super::*;

/// Frame, identity, label, score and position.
type Row<'a> = (u64, Option<i64>, &'a str, f64, f64, f64);

fn positions(frames: &Frames) -> Vec<Row<'_>> {
    let flat = frames
        .iter()
        .flat_map(|(frame, objects)| objects.iter().map(move |object| (*frame, object)));
    flat.map(|(frame, FileObject { id, perceived })| {
        (
            frame,
            *id,
            perceived.label.as_str(),
            perceived.confidence,
            perceived.x_m,
            perceived.y_m,
        )
    })
    .collect()
}

/// The sequence of a file with that text.
fn read(
    format: FileFormat,
    text: &str,
    camera: Option<&StandingCamera>,
) -> anyhow::Result<Sequence> {
    let folder = TempDir::new()?;
    let file = folder.path().join("file");
    fs::write(&file, text)?;
    let context = FileContext {
        camera,
        categories: None,
    };
    Ok(format.read(&file, context)?.remove(0))
}

/// A camera 4 m up that looks north from (10, -5), level; a pixel is 1/500 ahead.
fn camera() -> StandingCamera {
    let folder = TempDir::new().unwrap();
    let file = folder.path().join("camera.toml");
    let keys = "[pose]\nx_m = 10.0\ny_m = -5.0\nheading_deg = 90.0\n\
                [camera]\nsource = { kind = \"images\", path = \"frames\" }\ndetector = { kind = \"coco\" }\nmount = { height_m = 4.0 }\n\
                optics = { width_px = 1000, height_px = 800, horizontal_fov_deg = 90.0 }\n\
                projection = { ranging = \"ground\" }\n";
    fs::write(&file, keys).unwrap();
    StandingCamera::load(&file).unwrap()
}

/// A box whose lower edge fits an object on the ground 20 m ahead of the camera and 2 m to its
/// right.
const BOX_AT_12_15: &str = "[540.0, 450.0, 20.0, 50.0]";

#[test]
fn kitti_objects_use_vehicle_frame() {
    let text = "0 -1 DontCare -1 -1 -10 219.3 188.5 245.5 218.6 -1000 -1000 -1000 -10 -1 -1 -1\n\
                0 2 Van 0 0 -1.7 296.7 161.7 455.2 292.3 2.0 1.8 4.4 -4.5 1.8 13.4 -2.1\n\
                0 3 Car 0 0 -1.7 296.7 161.7 455.2 292.3 1.5 1.6 3.9 -4.5 1.8 13.4 -2.1\n\n\
                2 3 Car 0 0 -1.7 296.7 161.7 455.2 292.3 1.5 1.6 3.9 -4.0 1.8 14.0 -2.1 0.7\n";
    let frames = read(FileFormat::Kitti, text, None).unwrap().frames;
    assert_eq!(
        positions(&frames),
        [
            (0, Some(3), "Car", 1.0, 13.4, 4.5),
            (2, Some(3), "Car", 0.7, 14.0, 4.0)
        ],
        "left is positive, and classes that are not judged are omitted"
    );
}

#[test]
fn detector_scores_become_ordered_probabilities() {
    let line = |frame: u32, kind: u32, score: f64| {
        format!("{frame},{kind},1,2,3,4,{score},1.5,1.6,3.9,2.9,1.6,6.4,-1.5,-2.0\n")
    };
    let text = line(0, 2, 0.0) + &line(0, 1, 12.0) + &line(4, 3, -0.8);
    let frames = read(FileFormat::Kitti, &text, None).unwrap().frames;
    let found = positions(&frames);
    assert_eq!(found[0], (0, None, "Car", 0.5, 6.4, -2.9));
    assert!(
        (found[1].2, found[2].2) == ("Pedestrian", "Cyclist")
            && found[1].3 > 0.99
            && found[2].3 < 0.5
    );
    let percent = line(0, 2, 97.0) + &line(1, 2, 98.0) + &line(2, 2, 40.0);
    let found = read(FileFormat::Kitti, &percent, None).unwrap().frames;
    let [first, second, third] = [0, 1, 2].map(|frame| found[&frame][0].perceived.confidence);
    assert!(second > first && first > third, "{first} {second} {third}");
}

#[test]
fn mot_positions_are_on_ground() {
    let text = "\u{feff}1,-1,912,484,97,109,0.5,3.5,-2.25,0\n2,7,912,484,97,109,1,4,5,0\n2,8,912,484,97,109,0,4,5,0\n";
    let frames = read(FileFormat::Mot, text, None).unwrap().frames;
    assert_eq!(
        positions(&frames),
        [
            (1, None, "person", 0.5, 3.5, -2.25),
            (2, Some(7), "person", 1.0, 4.0, 5.0)
        ]
    );
}

#[test]
fn unreadable_field_is_named_with_line() {
    for (format, text, fault) in [
        (
            FileFormat::Kitti,
            "\n0 3 Car 0 0",
            "line 2: column 16 (z): is missing, there are 5 columns",
        ),
        (
            FileFormat::Kitti,
            "-1 3 Car",
            "line 1: column 1 (frame): -1 is out of bounds",
        ),
        (
            FileFormat::Kitti,
            "0 x Car",
            "line 1: column 2 (track): \"x\" is no number",
        ),
        (
            FileFormat::Kitti,
            "0,9,1,2,3,4,5",
            "line 1: column 2 (type): 9 is none of 1 to 3",
        ),
        (
            FileFormat::Kitti,
            "0,2,1,2,3,4,nan,1,1,1,1,1,1",
            "line 1: column 7 (score): \"nan\" is no number",
        ),
        (
            FileFormat::Mot,
            "1.5,1,1,2,3,4,1,1,1,1",
            "line 1: column 1 (frame): 1.5 is no whole number",
        ),
        (
            FileFormat::Mot,
            "1,1,1,2,3,4,1,1,1",
            "line 1: column 8 (x): is no position on the ground",
        ),
        (
            FileFormat::Mot,
            "1,1,1,2,3,4,1,-1,-1,-1",
            "line 1: column 8 (x): is no position on the ground",
        ),
        (
            FileFormat::Mot,
            "0,1,10,10,20,40,1,5,6,0",
            "line 1: column 1 (frame): 0 is out of bounds",
        ),
        (
            FileFormat::Mot,
            "1 2 Van 0 0 -1.7 296.7 161.7",
            "line 1: column 1 (frame): is not followed by a comma",
        ),
        (
            FileFormat::Coco,
            "[]",
            "boxes in an image have no place on the ground: give their camera with --config",
        ),
    ] {
        let said = read(format, text, None)
            .unwrap_err()
            .root_cause()
            .to_string();
        assert!(said.starts_with(fault), "{text}: {said}");
    }
}

#[test]
fn image_boxes_are_placed() {
    let camera = camera();
    let dataset = format!(
        "{{\"images\": [{{\"id\": 7}}, {{\"id\": 8}}], \"categories\": [{{\"id\": 1, \"name\": \"van\"}}], \"annotations\": [\
         {{\"image_id\": 8, \"category_id\": 1, \"bbox\": {BOX_AT_12_15}, \"track_id\": 3}}, \
         {{\"image_id\": 8, \"category_id\": 1, \"bbox\": {BOX_AT_12_15}, \"iscrowd\": 1}}]}}"
    );
    let results = format!(
        "[{{\"image_id\": 8, \"category_id\": 3, \"bbox\": {BOX_AT_12_15}, \"score\": 0.5}}]"
    );
    let lines = "8,-1,540,450,20,50,0.5,-1,-1,-1\n9,-1,540,350,20,40,0.5\n".to_owned();
    for (format, text, id, label, score, first) in [
        (FileFormat::Coco, dataset, Some(3), "van", 1.0, 7),
        (FileFormat::Coco, results, None, "car", 0.5, 8),
        (FileFormat::Mot, lines, None, "person", 0.5, 1),
    ] {
        let sequence = read(format, &text, Some(&camera)).unwrap();
        let [(frame, is, named, said, x_m, y_m)] = positions(&sequence.frames)[..] else {
            panic!("{sequence:?}")
        };
        assert_eq!(
            (sequence.first, frame, is, named, said),
            (first, 8, id, label, score)
        );
        // The middle of an object is behind where it touches the ground.
        assert!(
            (x_m - 12.0).abs() < 0.5 && (15.0..17.5).contains(&y_m),
            "({x_m}, {y_m})"
        );
        assert!(sequence.frames[&8][0].perceived.covariance_m2.is_some());
        let node = NodeName::from_static("post");
        for report in sequence.reports(0, 10.0, &node, 8) {
            assert_eq!(
                (report.pose.map(|pose| pose.y_m), report.moving),
                (Some(-5.0), Some(false))
            );
        }
        let above = if format == FileFormat::Mot {
            Some(&1)
        } else {
            None
        };
        assert_eq!(
            sequence.discarded.get("above_horizon"),
            above,
            "the second box of the lines stands in the sky"
        );
    }
}

#[test]
fn unreadable_coco_entry_names_path() {
    let camera = camera();
    for (text, fault) in [
        (
            r#"[{"image_id": 1, "category_id": 3, "bbox": [1, 2, 3]}]"#,
            "[0].bbox: invalid length 3",
        ),
        (
            r#"[{"image_id": 1, "category_id": 3, "bbox": [1, 2, 0, 4]}]"#,
            "[0].bbox: [1.0, 2.0, 0.0, 4.0] is no box",
        ),
        (
            r#"[{"image_id": 1, "category_id": 12, "bbox": [1, 2, 3, 4]}]"#,
            "[0].category_id: 12 is no known category",
        ),
        (
            r#"[{"image_id": -1, "category_id": 3, "bbox": [1, 2, 3, 4]}]"#,
            "[0].image_id: -1 is out of bounds",
        ),
        (
            r#"{"images": [], "categories": [{"id": 1, "name": ""}], "annotations": []}"#,
            "categories[0].name:",
        ),
        (
            r#"{"images": [], "categories": [], "annotations": [{"image_id": 1, "category_id": 3, "bbox": [1, 2, 3, 4]}]}"#,
            "annotations[0].category_id: 3 is no known category",
        ),
    ] {
        let said = read(FileFormat::Coco, text, Some(&camera))
            .unwrap_err()
            .root_cause()
            .to_string();
        assert!(said.starts_with(fault), "{text}: {said}");
    }
}

#[test]
fn repeated_identity_is_refused() {
    let mot =
        "1,7,912,484,97,109,1,4,5,0\n2,7,912,484,97,109,1,4,5,0\n2,7,912,484,97,109,1,6,5,0\n";
    let kitti =
        "0 3 Car 0 0 -1.7 296.7 161.7 455.2 292.3 1.5 1.6 3.9 -4.5 1.8 13.4 -2.1\n".repeat(2);
    let coco = format!(
        "[{0}, {0}]",
        format_args!(
            r#"{{"image_id": 8, "category_id": 3, "bbox": {BOX_AT_12_15}, "track_id": 4}}"#
        )
    );
    let camera = camera();
    for (format, text, camera, fault) in [
        (
            FileFormat::Mot,
            mot,
            None,
            "line 3: column 2 (track): 7 is in frame 2 already, in line 2",
        ),
        (
            FileFormat::Kitti,
            &kitti,
            None,
            "line 2: column 2 (track): 3 is in frame 0 already, in line 1",
        ),
        (
            FileFormat::Coco,
            &coco,
            Some(&camera),
            "[1].track_id: 4 is in image 8 already, in [0]",
        ),
    ] {
        let error = read(format, text, camera).unwrap_err();
        assert_eq!(error.root_cause().to_string(), fault);
    }
    let detections = kitti.replace(" 3 Car", " -1 Car");
    let frames = read(FileFormat::Kitti, &detections, None).unwrap().frames;
    assert!(frames[&0].iter().all(|object| object.id.is_none()));
}

#[test]
fn odd_score_leaves_others_unchanged() {
    let line = |frame: u32, score: &str| format!("{frame},-1,1,2,3,4,{score},1.5,2.5,0\n");
    let lines =
        |last: &str| (1..=20).map(|frame| line(frame, "0.9")).collect::<String>() + &line(21, last);
    let frames = read(FileFormat::Mot, &lines("1.0000001"), None)
        .unwrap()
        .frames;
    let scores = positions(&frames).into_iter().map(|row| row.3);
    assert!(scores.eq([0.9; 20].into_iter().chain([1.0])));
    for odd in ["1.7", "-0.2", "97"] {
        let error = read(FileFormat::Mot, &lines(odd), None)
            .unwrap_err()
            .to_string();
        let fault = format!("line 21: score {odd} is not within 0 to 1, where all but 1 of 21 are");
        assert!(error.contains(&fault), "{error}");
    }
}

#[test]
fn entries_without_area_are_counted() {
    let camera = camera();
    let coco = format!(
        r#"{{"images": [{{"id": 8}}], "categories": [{{"id": 1, "name": "van"}}], "annotations": [
            {{"image_id": 8, "category_id": 1, "bbox": [10.0, 10.0, 0.0, 5.0]}},
            {{"image_id": 8, "category_id": 1, "bbox": {BOX_AT_12_15}}},
            {{"image_id": 8, "category_id": 9, "bbox": {BOX_AT_12_15}}}]}}"#
    );
    let mot = "8,-1,540,450,0,50,0.5\n8,-1,540,450,20,50,0.5\n8,-1,540,450,20,-1,0.5\n";
    for (format, text, first) in [
        (
            FileFormat::Coco,
            &*coco,
            "annotations[0].bbox: [10.0, 10.0, 0.0, 5.0] is no box",
        ),
        (
            FileFormat::Mot,
            mot,
            "line 1: column 5 (width): and height are of no box",
        ),
    ] {
        let sequence = read(format, text, Some(&camera)).unwrap();
        assert_eq!(sequence.frames[&8].len(), 1);
        let skipped = SkippedEntries {
            count: 2,
            first: first.into(),
        };
        assert_eq!(sequence.skipped, skipped);
    }
}

#[test]
fn results_use_categories_of_dataset() {
    let folder = TempDir::new().unwrap();
    let [truth, results] = ["truth.json", "results.json"].map(|name| folder.path().join(name));
    let dataset = r#"{"images": [], "categories": [{"id": 1, "name": "gate"}], "annotations": []}"#;
    fs::write(&truth, dataset).unwrap();
    let result =
        format!(r#"[{{"image_id": 8, "category_id": 1, "bbox": {BOX_AT_12_15}, "score": 0.5}}]"#);
    fs::write(&results, result).unwrap();
    let categories = FileFormat::Coco.categories(&truth).unwrap();
    let camera = camera();
    for (categories, label) in [(categories.as_ref(), "gate"), (None, "person")] {
        let context = FileContext {
            camera: Some(&camera),
            categories,
        };
        let read = FileFormat::Coco.read(&results, context).unwrap();
        assert_eq!(read[0].frames[&8][0].perceived.label, label);
    }
    assert_eq!(FileFormat::Coco.categories(&results).unwrap(), None);
    let twice = dataset.replace(
        r#"{"id": 1, "name": "gate"}"#,
        r#"{"id": 1, "name": "gate"}, {"id": 1, "name": "door"}"#,
    );
    fs::write(&truth, twice).unwrap();
    let error = FileFormat::Coco.categories(&truth).unwrap_err();
    assert!(format!("{error:#}").contains("categories[1].id: 1 is the id of another"));
}
