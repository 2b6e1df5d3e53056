//! Boxes in the image of a camera that stands, on the ground.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Context, bail};
use ecod::model::detection::Detection;
use ecod::model::time::Timestamp;
use ecod::wire::PerceivedObject;
use ecod_actors::camera::perception::Perception;
use ecod_actors::node::camera::{lens, perception, standing_pose};
use ecod_actors::node::config::NodeConfig;

use super::{FileObject, FilePlace, ParsedFrames, ParsedObject, Sequence};

/// The camera of a vehicle that stands: it places boxes as the vehicle would.
#[derive(Debug, Clone)]
pub struct StandingCamera(Perception);

impl StandingCamera {
    /// The camera in a vehicle's configuration (TOML).
    ///
    /// # Errors
    /// Returns an error that names the key, the value and the allowed range, or an error if there
    /// is not exactly one camera, with a stated image size, that stands.
    pub fn load(file: &Path) -> anyhow::Result<Self> {
        let config = NodeConfig::load(Some(file), &BTreeMap::<String, String>::new())?;
        let cameras: Vec<_> = config.all_cameras().collect();
        let [camera] = cameras[..] else {
            bail!("has {} cameras, one is needed", cameras.len())
        };
        if lens(camera)?.is_any_shape {
            bail!(
                "keys `camera.optics.width_px` and `height_px` are missing: files of boxes do not state the size of the image"
            );
        }
        let pose = standing_pose(&config)?
            .context("key `pose.listen`: only a camera that stands can place boxes of a file")?;
        let mut perception = perception(&config, camera)?;
        perception.set_pose(pose);
        Ok(Self(perception))
    }
}

/// The sequence with all objects that have a place.
pub(super) fn placed(
    frames: ParsedFrames,
    camera: Option<&StandingCamera>,
    mut sequence: Sequence,
) -> Sequence {
    let mut camera = camera.cloned();
    for (number, objects) in frames {
        let mut placed = Vec::new();
        let mut ids = Vec::new();
        let mut boxes = Vec::new();
        for ParsedObject {
            id,
            label,
            score,
            place,
            ..
        } in objects
        {
            match place {
                FilePlace::Ground(position) => {
                    let perceived = PerceivedObject::new(label, score, position.x, position.y);
                    placed.push(FileObject { id, perceived });
                }
                FilePlace::Image(bounding_box) => {
                    ids.push(id);
                    boxes.push(Detection {
                        label,
                        confidence: score,
                        bounding_box,
                        corners: None,
                    });
                }
            }
        }
        if let Some(StandingCamera(perception)) = &mut camera {
            let report = perception.report(boxes, Timestamp::default());
            sequence.pose = report.pose;
            let ids = perception.reported().iter().map(|index| ids[*index]);
            placed.extend(
                ids.zip(report.objects)
                    .map(|(id, perceived)| FileObject { id, perceived }),
            );
        }
        sequence.frames.insert(number, placed);
    }
    sequence.discarded = camera
        .map(|StandingCamera(perception)| perception.discarded().clone())
        .unwrap_or_default();
    sequence
}
