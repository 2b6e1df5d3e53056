//! A custom detector in a node: it detects red balls by colour, and the program follows them from pixels to the cell's
//! map.
//!
//! `cargo run --example custom_detector -- [DIRECTORY_OF_IMAGES]`
//!
//! Without a directory it draws frames with a ball 0.1 m across, one metre ahead of the camera.

use std::path::{Path, PathBuf};

use ecod::model::detection::{BoundingBox, Detection};
use ecod::model::names::NodeName;
use ecod::perception::landmark::LandmarkConfig;
use ecod::perception::projection::{ObjectSize, ObjectSizes, ProjectionConfig, Ranging};
use ecod::wire::Role;
use ecod_actors::camera::config::{CameraConfig, OpticsConfig};
use ecod_actors::camera::detect::{CustomDetector, Detect, DetectError, DetectorConfig};
use ecod_actors::camera::frame::CameraFrame;
use ecod_actors::camera::frame_source::SourceConfig;
use ecod_actors::node;
use ecod_actors::node::config::NodeConfig;
use opencv::core::{self, CV_8UC3, Mat, Point, Scalar, Vector};
use opencv::{imgcodecs, imgproc};

const BALL_M: f64 = 0.1;
const LEAST_AREA_PX: f64 = 100.0;

/// Detects every red blob as a ball.
struct RedBalls;

impl Detect for RedBalls {
    fn detect(&mut self, frame: &CameraFrame) -> Result<Vec<Detection>, DetectError> {
        find(&frame.image).map_err(|source| DetectError::OpenCv {
            step: "red balls",
            source,
        })
    }
}

fn find(image: &Mat) -> opencv::Result<Vec<Detection>> {
    let mut hsv = Mat::default();
    let mut mask = Mat::default();
    imgproc::cvt_color_def(image, &mut hsv, imgproc::COLOR_BGR2HSV)?;
    // OpenCV's hue of red is near 0.
    core::in_range(
        &hsv,
        &Scalar::new(0.0, 150.0, 80.0, 0.0),
        &Scalar::new(8.0, 255.0, 255.0, 0.0),
        &mut mask,
    )?;
    let mut outlines = Vector::<Vector<Point>>::new();
    imgproc::find_contours_def(
        &mask,
        &mut outlines,
        imgproc::RETR_EXTERNAL,
        imgproc::CHAIN_APPROX_NONE,
    )?;
    let mut balls = Vec::new();
    for outline in outlines {
        let bounds = imgproc::bounding_rect(&outline)?;
        let width = f64::from(bounds.width);
        let height = f64::from(bounds.height);
        // A disc fills π/4 of its box. The confidence falls with the difference from this share.
        let fill = imgproc::contour_area_def(&outline)? / (width * height);
        let confidence = 1.0 - (fill / std::f64::consts::FRAC_PI_4 - 1.0).abs();
        if width * height >= LEAST_AREA_PX && confidence > 0.5 {
            let x_min = f64::from(bounds.x);
            let y_min = f64::from(bounds.y);
            balls.push(Detection {
                label: "red ball".into(),
                confidence: confidence.clamp(0.0, 1.0),
                bounding_box: BoundingBox {
                    x_min,
                    y_min,
                    x_max: x_min + width,
                    y_max: y_min + height,
                },
                corners: None,
            });
        }
    }
    Ok(balls)
}

#[tokio::main]
async fn main() -> anyhow::Result<()> {
    let drawn = tempfile::tempdir()?;
    let frames = match std::env::args().nth(1) {
        Some(directory) => PathBuf::from(directory),
        None => draw(drawn.path())?,
    };
    let cell = NodeConfig {
        landmarks: vec![LandmarkConfig::at("spot", 1.0, 0.0)],
        ..NodeConfig::default()
    };
    let edge = node::start(NodeConfig {
        name: Some(NodeName::new("edge")?),
        role: Role::Edge,
        listen: Some(([127, 0, 0, 1], 0).into()),
        ..cell.clone()
    })
    .await?;

    let camera = CameraConfig {
        name: None,
        source: SourceConfig::Images {
            path: frames,
            fps: 10.0,
            looping: true,
        },
        masks: Default::default(),
        capture: Default::default(),
        optics: OpticsConfig::default(),
        mount: Default::default(),
        detector: DetectorConfig::Custom(CustomDetector::new(|| Ok(Box::new(RedBalls)))),
        projection: ProjectionConfig {
            ranging: Ranging::BoxHeight,
            sizes: ObjectSizes {
                default: Some(ObjectSize::square(BALL_M)),
                ..Default::default()
            },
            ..Default::default()
        },
        view: Default::default(),
        votes: true,
    };
    let mut config = NodeConfig {
        name: Some(NodeName::new("euclid")?),
        role: Role::Cav,
        camera: Some(camera),
        ..cell
    };
    config.mqtt.broker = edge.broker_address().map(Into::into);
    config.validate()?;
    let cav = node::start(config).await?;

    let mut maps = cav.newest_map();
    let seen = maps
        .wait_for(|map| {
            map.as_ref()
                .is_some_and(|map| map.map.landmarks[0].label.is_some())
        })
        .await?;
    if let Some(received) = &*seen {
        println!("{:#?}", received.map.landmarks[0]);
    }
    drop(seen);
    cav.stop().await;
    edge.stop().await;
    Ok(())
}

/// A frame with a ball straight ahead, drawn as the default optics project it.
fn draw(directory: &Path) -> anyhow::Result<PathBuf> {
    let camera = OpticsConfig::default().lens()?.intrinsics;
    let grey = Scalar::new(120.0, 120.0, 120.0, 0.0);
    let mut image =
        Mat::new_rows_cols_with_default(camera.height as i32, camera.width as i32, CV_8UC3, grey)?;
    let centre = Point::new(camera.cx as i32, camera.cy as i32);
    // A disc of radius r covers 2r + 1 pixels.
    let radius_px = (camera.fx * BALL_M / 2.0 - 0.5).round() as i32;
    imgproc::circle(
        &mut image,
        centre,
        radius_px,
        Scalar::new(30.0, 30.0, 200.0, 0.0),
        imgproc::FILLED,
        8,
        0,
    )?;
    imgcodecs::imwrite_def(directory.join("0.png"), &image)?;
    Ok(directory.to_owned())
}
