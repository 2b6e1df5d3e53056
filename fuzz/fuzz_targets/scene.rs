//! Files of scenes and of recorded detections, and the geometry of what they hold.

#![no_main]

use ecod_lab::testbed::{IntersectionRecording, Testbed};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|text: &str| {
    if let Ok(testbed) = Testbed::from_json(text) {
        for scene in &testbed.scenes {
            drop(scene.landmarks(&testbed.placard));
            for (cav, spot) in scene
                .cavs
                .iter()
                .flat_map(|cav| scene.spots.iter().map(move |spot| (cav, spot)))
            {
                let _ = testbed.sighting(scene, cav, spot);
            }
        }
    }
    if let Ok(recording) = IntersectionRecording::from_json(text) {
        drop((recording.landmarks(), recording.frame_count()));
    }
});
