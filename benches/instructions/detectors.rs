//! A vehicle's detectors at work on a photograph of 512 by 512 pixels, in one thread.

use std::hint::black_box;

use ecod::model::time::Timestamp;
use ecod_actors::camera::detect::Detect;
use ecod_actors::camera::detect::coco::{CocoConfig, CocoDetector};
use ecod_actors::camera::detect::placard::{PlacardConfig, PlacardDetector};
use ecod_actors::camera::frame::CameraFrame;
use ecod_actors::camera::image_codec;

const PHOTOGRAPH: &[u8] = include_bytes!("../../actors/tests/data/photos/astronaut.jpg");

/// Has the detector of this name search the photograph so many times. False if there is none.
pub(super) fn detect(name: &str, times: usize) -> bool {
    let mut detector: Box<dyn Detect> = match name {
        "coco" => Box::new(
            CocoDetector::new(CocoConfig::default()).expect("the weights are in the program"),
        ),
        "placard" => Box::new(PlacardDetector::new(PlacardConfig::default())),
        _ => return false,
    };
    let image = image_codec::decode(PHOTOGRAPH).expect("a photograph");
    let frame = CameraFrame {
        image,
        captured_at: Timestamp(0),
        seq: 1,
    };
    for _ in 0..times {
        black_box(detector.detect(&frame).expect("OpenCV works"));
    }
    true
}
