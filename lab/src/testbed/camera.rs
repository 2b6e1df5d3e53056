//! Rendered views of the recorded parking lots: no images were recorded, so each vehicle's view is
//! rendered from the geometry and then disturbed like the image of a small camera.
//!
//! The following was not recorded and is assumed: the axis of a camera is level and at the height
//! of the middle of the codes, unless a mount is given; the distance of a code from the upper end
//! of its card equals its distance from the sides; cards stand on the floor; and vehicles do not
//! hide objects.

mod render;
pub(crate) mod sensor;
#[cfg(test)]
mod tests;

use ecod::model::names::Label;
use ecod::perception::camera::Mount;
use opencv::core::Mat;

use crate::testbed::{Cav, Scene, Testbed};
use sensor::Sensor;

/// The camera of one vehicle in one scene.
///
/// Frames are a function of the scene, the vehicle, the seed and the frame's number alone.
#[derive(Debug)]
pub struct TestbedCamera {
    still: Mat,
    sensor: Sensor,
}

impl TestbedCamera {
    /// Renders the view of the vehicle's camera.
    ///
    /// # Errors
    /// Returns a [`RenderError`] if a placard's text does not fit into a code or OpenCV fails.
    pub fn new(
        testbed: &Testbed,
        scene: &Scene,
        cav: &Cav,
        seed: u64,
    ) -> Result<Self, RenderError> {
        Self::mounted(testbed, scene, cav, &Mount::default(), seed)
    }

    /// Renders the view of a camera with the height and tilt of `mount`; the vehicle's pose is used
    /// as the camera's pose.
    ///
    /// # Errors
    /// Returns the errors of [`Self::new`].
    pub fn mounted(
        testbed: &Testbed,
        scene: &Scene,
        cav: &Cav,
        mount: &Mount,
        seed: u64,
    ) -> Result<Self, RenderError> {
        let still = render::still(testbed, &testbed.cards(scene), &cav.pose, mount)?;
        let sensor = Sensor::new(&still, stream_seed(seed, &[&scene.name, cav.name.as_str()]));
        Ok(Self { still, sensor })
    }

    /// The undisturbed view: 8-bit BGR, pixel `(i, j)` covers `[i, i + 1) × [j, j + 1)`.
    pub fn still(&self) -> &Mat {
        &self.still
    }

    /// Frame number `index`, with vibration, blur, uneven light and noise: 8-bit BGR.
    ///
    /// # Errors
    /// Returns a [`RenderError`] if OpenCV fails.
    pub fn frame(&self, index: u64) -> Result<Mat, RenderError> {
        self.sensor.expose(&self.still, index)
    }
}

/// A view that could not be rendered.
#[derive(Debug, thiserror::Error)]
pub enum RenderError {
    /// A placard's text does not fit into a code.
    #[error("text {text:?} does not fit into a qr code")]
    Text {
        /// Text of the placard.
        text: Label,
        /// The encoder's own words.
        #[source]
        source: qrcode::types::QrError,
    },
    /// OpenCV refused an operation.
    #[error("opencv failed in {step}")]
    OpenCv {
        /// Name of the operation that failed.
        step: &'static str,
        /// The error that OpenCV returned.
        #[source]
        source: opencv::Error,
    },
}

impl RenderError {
    fn at(step: &'static str) -> impl FnOnce(opencv::Error) -> Self {
        move |source| Self::OpenCv { step, source }
    }
}

/// FNV-1a over the seed and the names, so that every camera has its own random numbers.
fn stream_seed(seed: u64, names: &[&str]) -> u64 {
    let separated = names.iter().flat_map(|name| name.bytes().chain([0]));
    seed.to_le_bytes()
        .into_iter()
        .chain(separated)
        .fold(0xcbf2_9ce4_8422_2325, |hash, byte| {
            (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3)
        })
}
