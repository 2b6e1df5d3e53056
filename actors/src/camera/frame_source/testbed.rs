//! A vehicle of a testbed scene as a live camera.

use std::fs;
use std::path::Path;

use ecod::names::NodeName;
use ecod::testbed::Testbed;

use super::{FrameError, FramePacer, FrameSource};
use crate::camera::frame::Frame;
use crate::platform::clock;
use crate::testbed::TestbedCamera;

/// Renders one frame after the other at the rate of the scene's cameras.
pub(super) struct TestbedVehicle {
    camera: TestbedCamera,
    origin: String,
    pace: FramePacer,
    next: u64,
}

impl TestbedVehicle {
    pub(super) fn open(scenes: &Path, scene: &str, cav: &NodeName, seed: u64) -> Result<Self, FrameError> {
        let origin = format!("vehicle {cav} of scene {scene} of {}", scenes.display());
        let failed = |reason: String| FrameError::Open { origin: origin.clone(), reason };
        let text = fs::read_to_string(scenes).map_err(|error| failed(error.to_string()))?;
        let testbed = Testbed::from_json(&text).map_err(|error| failed(error.to_string()))?;
        let scene = testbed.scene(scene).ok_or_else(|| failed("there is no such scene".into()))?;
        let found = scene.cavs.iter().find(|candidate| candidate.name == *cav);
        let cav = found.ok_or_else(|| failed("there is no such vehicle".into()))?;
        let camera = TestbedCamera::new(&testbed, scene, cav, seed).map_err(|error| failed(error.to_string()))?;
        let pace = FramePacer::new(1.0 / testbed.camera.capture_interval.as_secs_f64());
        Ok(Self { camera, origin, pace, next: 0 })
    }
}

impl FrameSource for TestbedVehicle {
    fn next_frame(&mut self) -> Result<Frame, FrameError> {
        self.pace.wait();
        let captured_at = clock::now();
        let image = self.camera.frame(self.next);
        let image =
            image.map_err(|error| FrameError::Lost { origin: self.origin.clone(), reason: error.to_string() })?;
        let seq = self.next;
        self.next += 1;
        Ok(Frame { image, captured_at, seq })
    }
}
