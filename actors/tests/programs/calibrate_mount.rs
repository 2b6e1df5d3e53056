//! `ecod-node calibrate mount` as a user runs it: from points, from a printed code, from people.

use std::f64::consts::TAU;
use std::path::Path;
use std::process::{Command, Output};

use ecod::model::geometry::Pose;
use ecod::perception::camera::{Intrinsics, Mount};
use ecod::perception::view::PosedCamera;
use ecod_actors::camera::image_codec::encode_jpeg;
use ecod_testkit::{stderr, walking_people};
use opencv::core::{CV_8UC1, Mat, Scalar};

const NODE: &str = "# A camera on a mast.\nname = \"mast\"\n[pose]\nx_m = 10\ny_m = -5\nheading_deg = 90\n\
    [camera.source]\nkind = \"images\"\npath = \"frames\"\nfps = 200\n\
    [camera.optics]\nwidth_px = 1280\nheight_px = 720\nhorizontal_fov_deg = 70\n\
    [camera.detector]\nkind = \"recorded\"\npath = \"boxes.jsonl\"\n";

fn camera() -> Intrinsics {
    Intrinsics::with_square_pixels(1280, 720, 70f64.to_radians())
}

fn real() -> Mount {
    let pitch_rad = 18f64.to_radians();
    let roll_rad = (-2f64).to_radians();
    let pan_rad = 6f64.to_radians();
    Mount {
        height_m: Some(3.5),
        pitch_rad,
        roll_rad,
        pan_rad,
        forward_m: 0.4,
        left_m: -0.2,
    }
}

/// A directory with `node.toml`.
fn workplace() -> tempfile::TempDir {
    let directory = tempfile::tempdir().unwrap();
    std::fs::write(directory.path().join("node.toml"), NODE).unwrap();
    directory
}

fn calibrate(directory: &Path, arguments: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_ecod-node"));
    command.current_dir(directory).args([
        "calibrate",
        "mount",
        arguments[0],
        "--config",
        "node.toml",
    ]);
    command.args(&arguments[1..]).output().unwrap()
}

/// The values of `camera.mount` that were printed.
#[track_caller]
fn printed(output: &Output) -> [f64; 6] {
    assert!(output.status.success(), "{}", stderr(output));
    let table: toml::Table = String::from_utf8_lossy(&output.stdout).parse().unwrap();
    [
        "forward_m",
        "left_m",
        "pan_deg",
        "height_m",
        "pitch_deg",
        "roll_deg",
    ]
    .map(|key| table["camera"]["mount"][key].as_float().unwrap())
}

#[track_caller]
fn is_near(found: [f64; 6], tolerance: [f64; 6]) {
    for ((found, expected), tolerance) in found
        .into_iter()
        .zip([0.4, -0.2, 6.0, 3.5, 18.0, -2.0])
        .zip(tolerance)
    {
        assert!((found - expected).abs() <= tolerance, "{found} {expected}");
    }
}

#[test]
fn points_update_mount_in_file() {
    let directory = workplace();
    let vehicle = Pose::new(10.0, -5.0, TAU / 4.0);
    let posed = PosedCamera::new(real().camera_pose(&vehicle), &real(), camera());
    let mut lines = "# column row east north\n".to_owned();
    for (ahead_m, left_m) in [
        (6.0, 1.0),
        (7.0, -2.0),
        (9.0, 3.0),
        (11.0, -1.0),
        (14.0, 4.0),
        (16.0, -3.0),
    ] {
        let place = vehicle.transform(ahead_m, left_m);
        let mut pixel = posed.pixel(&place).unwrap();
        if ahead_m == 11.0 {
            pixel.x += 80.0;
        }
        lines += &format!(
            "{:.1}, {:.1}, {:.3}, {:.3}\n",
            pixel.x, pixel.y, place.x, place.y
        );
    }
    std::fs::write(directory.path().join("points.csv"), &lines).unwrap();
    let output = calibrate(
        directory.path(),
        &["points", "--in-map", "--write", "points.csv"],
    );
    is_near(printed(&output), [0.05, 0.05, 0.2, 0.05, 0.2, 0.2]);
    let output_text = stderr(&output);
    let outliers: Vec<_> = output_text
        .lines()
        .filter(|line| line.contains("OUTLIER"))
        .collect();
    assert_eq!(
        (outliers.len(), output_text.matches(" px, ").count()),
        (1, 6),
        "{output_text}"
    );
    assert!(
        output_text.contains("the middle of the image shows the ground from "),
        "{output_text}"
    );
    let written = std::fs::read_to_string(directory.path().join("node.toml")).unwrap();
    assert!(
        written.starts_with("# A camera on a mast.\nname = \"mast\"\n")
            && written.contains("[camera.mount]"),
        "{written}"
    );
    let again = calibrate(
        directory.path(),
        &["points", "--in-map", "--write", "points.csv"],
    );
    is_near(printed(&again), [0.05, 0.05, 0.2, 0.05, 0.2, 0.2]);

    let two = written.clone()
        + "[[cameras]]\nname = \"rear\"\nsource = { kind = \"images\", path = \"frames\" }\n\
        optics = { width_px = 1280, height_px = 720, horizontal_fov_deg = 70 }\ndetector = { kind = \"placard\" }\n\
        mount = { pan_deg = 180.0 }\n";
    std::fs::write(directory.path().join("node.toml"), two).unwrap();
    let rear = calibrate(
        directory.path(),
        &[
            "points",
            "--camera",
            "rear",
            "--in-map",
            "--write",
            "points.csv",
        ],
    );
    assert!(rear.status.success(), "{}", stderr(&rear));
    let both = std::fs::read_to_string(directory.path().join("node.toml")).unwrap();
    let pan = both.parse::<toml::Table>().unwrap()["cameras"][0]["mount"]["pan_deg"]
        .as_float()
        .unwrap();
    assert!(
        (pan - 6.0).abs() < 0.2 && both.starts_with(&written),
        "{both}"
    );
    let front = calibrate(
        directory.path(),
        &["points", "--camera", "front", "points.csv"],
    );
    assert!(
        front.status.code() == Some(2) && stderr(&front).contains("no camera \"front\""),
        "{}",
        stderr(&front)
    );

    let faulty = lines.replace("# column", "1 2 three 4\n# column");
    std::fs::write(directory.path().join("points.csv"), faulty).unwrap();
    let output = calibrate(directory.path(), &["points", "points.csv"]);
    let error = stderr(&output);
    assert!(
        output.status.code() == Some(2) && error.contains("points.csv, line 1: \"1 2 three 4\""),
        "{error}"
    );
    let few = calibrate(
        directory.path(),
        &[
            "points",
            "--point",
            "600,500=6,1",
            "--point",
            "700,500=6,-1",
        ],
    );
    assert!(
        few.status.code() == Some(1) && stderr(&few).contains("2 points, need 4"),
        "{}",
        stderr(&few)
    );
}

#[test]
fn people_give_height_and_tilt() {
    let directory = workplace();
    let frames = directory.path().join("frames");
    std::fs::create_dir(&frames).unwrap();
    let blank = Mat::new_rows_cols_with_default(720, 1280, CV_8UC1, Scalar::all(90.0)).unwrap();
    let mut lines = String::new();
    for number in 0..300 {
        if number < 100 {
            std::fs::write(
                frames.join(format!("{number:03}.jpg")),
                encode_jpeg(&blank, 95).unwrap(),
            )
            .unwrap();
        }
        lines +=
            &(serde_json::to_string(&walking_people(f64::from(number) * 0.3, &real(), camera()))
                .unwrap()
                + "\n");
    }
    std::fs::write(directory.path().join("boxes.jsonl"), lines).unwrap();
    let output = calibrate(directory.path(), &["people"]);
    println!(
        "{}{}",
        String::from_utf8_lossy(&output.stdout),
        stderr(&output)
    );
    let found = printed(&output);
    assert_eq!(found[..3], [0.0; 3], "people do not determine these values");
    assert!(
        (found[3] / 3.5 - 1.0).abs() < 0.08
            && (found[4] - 18.0).abs() < 1.0
            && (found[5] + 2.0).abs() < 1.5,
        "{found:?}"
    );

    let none = calibrate(directory.path(), &["people", "--label", "dog"]);
    let error = stderr(&none);
    assert!(
        none.status.code() == Some(1)
            && error.contains("0 whole boxes, need 40")
            && error.contains("person"),
        "{error}"
    );
    std::fs::write(directory.path().join("node.toml"), "name = \"edge\"").unwrap();
    let blind = calibrate(directory.path(), &["people"]);
    assert!(
        blind.status.code() == Some(2) && stderr(&blind).contains("has no [camera]"),
        "{}",
        stderr(&blind)
    );
}

#[test]
fn photograph_without_board_is_named() {
    let directory = workplace();
    let blank = Mat::new_rows_cols_with_default(720, 1280, CV_8UC1, Scalar::all(90.0)).unwrap();
    std::fs::write(
        directory.path().join("ground.jpg"),
        encode_jpeg(&blank, 95).unwrap(),
    )
    .unwrap();
    let output = calibrate(
        directory.path(),
        &["board", "--qr-side-mm", "400", "ground.jpg"],
    );
    let error = stderr(&output);
    assert!(
        output.status.code() == Some(1)
            && error.contains("ground.jpg")
            && error.contains("no QR code"),
        "{error}"
    );
    let neither = calibrate(directory.path(), &["board", "ground.jpg"]);
    assert!(
        neither.status.code() == Some(2) && stderr(&neither).contains("--qr-side-mm"),
        "{}",
        stderr(&neither)
    );
}
