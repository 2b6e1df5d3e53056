//! The mount of a camera from people who walk in front of it.

use std::collections::BTreeSet;

use ecod::model::detection::{BoundingBox, Detection};
use ecod::model::names::Label;
use ecod::perception::projection::{
    Cut, MountEstimate, MountFitError, ObjectSize, Projection, fit_mount,
};

use crate::camera::config::CameraConfig;
use crate::camera::image_size::{ImageSize, SizeMismatch};
use crate::camera::lens::Lens;

/// The whole boxes of people in a camera's frames.
#[derive(Clone)]
pub(crate) struct PeopleWatch {
    camera: CameraConfig,
    lens: Lens,
    /// The detector's label of people.
    label: Label,
    /// Usual size of people, or the size of the one person who walks.
    size: ObjectSize,
    /// Boxes by frame, without distortion. Frames equal to an earlier one are omitted, because the
    /// pictures of a looping source are no new evidence; so is an empty frame after another.
    frames: Vec<Vec<BoundingBox>>,
    /// Number of frames, including the omitted ones.
    watched: usize,
    /// Number of boxes in `frames`.
    boxes: usize,
    others: BTreeSet<Label>,
}

impl PeopleWatch {
    /// A watch without frames. `lens` is the lens of `camera`; `size` is the true size of objects
    /// with this label.
    pub(crate) fn new(camera: CameraConfig, lens: Lens, label: Label, size: ObjectSize) -> Self {
        Self {
            camera,
            lens,
            label,
            size,
            frames: Vec::new(),
            watched: 0,
            boxes: 0,
            others: BTreeSet::new(),
        }
    }

    /// Adds the detections of a frame of this size. Boxes that the image's edge or a mask
    /// cuts are left out.
    ///
    /// # Errors
    /// Returns [`SizeMismatch`] if the frame does not have the shape of the lens.
    pub(crate) fn add(
        &mut self,
        mut detections: Vec<Detection>,
        size: ImageSize,
    ) -> Result<(), SizeMismatch> {
        self.lens = self.lens.of_frames(size)?;
        ImageSize::from(&self.lens.intrinsics).fit(size, &mut detections)?;
        let projection = Projection::new(
            self.camera.projection.clone(),
            self.lens.intrinsics,
            self.camera.mount.into(),
        );
        let masks = self
            .camera
            .masks
            .in_pixels_of((&self.lens.intrinsics).into());
        let projection = projection.with_masks(masks);
        let others = detections.iter().filter(|other| other.label != self.label);
        self.others.extend(others.map(|other| other.label.clone()));
        detections.retain(|person| {
            person.label == self.label && projection.cut(person) == Cut::default()
        });
        self.lens.undistort(&mut detections);
        let boxes: Vec<_> = detections
            .iter()
            .map(|person| person.bounding_box)
            .collect();
        self.watched += 1;
        let is_new = if boxes.is_empty() {
            self.frames.last().is_some_and(|last| !last.is_empty())
        } else {
            !self.frames.contains(&boxes)
        };
        if is_new {
            self.boxes += boxes.len();
            self.frames.push(boxes);
        }
        Ok(())
    }

    /// Number of frames.
    pub(crate) fn frames(&self) -> usize {
        self.watched
    }

    /// Number of whole boxes of people in different frames.
    pub(crate) fn boxes(&self) -> usize {
        self.boxes
    }

    /// Drops all frames.
    pub(crate) fn clear(&mut self) {
        self.frames.clear();
        self.boxes = 0;
    }

    /// Labels of all other objects.
    pub(crate) fn others(&self) -> &BTreeSet<Label> {
        &self.others
    }

    /// The lens at the size of the latest frame.
    pub(crate) fn lens(&self) -> &Lens {
        &self.lens
    }

    /// Fits height, pitch and roll of the camera to the boxes; takes up to seconds.
    ///
    /// # Errors
    /// Returns a [`MountFitError`] if the boxes do not determine the mount.
    pub(crate) fn fit(&self) -> Result<MountEstimate, MountFitError> {
        fit_mount(
            &self.frames,
            &self.size,
            self.camera.projection.pixel_sigma_px,
            &self.lens.intrinsics,
            &self.camera.mount.into(),
        )
    }
}
