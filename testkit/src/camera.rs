//! Cameras without hardware.

use std::fs;
use std::path::Path;

/// The middle of the picture: half a metre of car, 40 pixels high.
const CAR: &str = r#"[{"label":"car","confidence":0.9,"bounding_box":{"x_min":300,"y_min":200,"x_max":340,"y_max":240}}]"#;

/// The keys of a default camera that always detects a car 6.6 m ahead. Its files are written into the directory.
///
/// # Panics
/// Panics if the directory cannot be written.
pub fn car_ahead(directory: &Path) -> String {
    let frames = directory.join("frames");
    fs::create_dir_all(&frames).unwrap();
    let grey = [b"P6 640 480 255\n".as_slice(), &[128; 640 * 480 * 3]].concat();
    fs::write(frames.join("0.ppm"), grey).unwrap();
    let detections = directory.join("detections.jsonl");
    fs::write(&detections, CAR).unwrap();
    format!(
        "source = {{ kind = \"images\", path = {frames:?}, looping = true }}\n\
         detector = {{ kind = \"recorded\", path = {detections:?}, looping = true }}\n\
         projection = {{ ranging = \"box_height\", sizes.default = {{ width_m = 0.5, height_m = 0.5 }} }}\n"
    )
}
