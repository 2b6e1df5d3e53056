//! The cameras of a vehicle: `[camera]`, and further cameras in `[[cameras]]`.

#[cfg(feature = "camera")]
use ecod::admission::report_window::MAX_PARTS;
#[cfg(feature = "camera")]
use ecod::config::ConfigError;
#[cfg(feature = "camera")]
use ecod::perception::projection::NEURAL_PIXEL_SIGMA_PX;
#[cfg(feature = "camera")]
use figment::Figment;

use super::NodeConfig;
#[cfg(feature = "camera")]
use crate::camera::config::CameraConfig;
#[cfg(feature = "camera")]
use crate::camera::detect::DetectorConfig;

impl NodeConfig {
    /// Gives further cameras the defaults that depend on their detector, except for stated keys.
    #[cfg(feature = "camera")]
    pub(super) fn set_camera_defaults(&mut self, stated: &Figment) {
        let stated = stated
            .extract_inner::<Vec<toml::Table>>("cameras")
            .unwrap_or_default();
        for (camera, keys) in self.cameras.iter_mut().zip(stated) {
            let is_stated = keys
                .get("projection")
                .is_some_and(|projection| projection.get("pixel_sigma_px").is_some());
            if matches!(camera.detector, DetectorConfig::Coco(_)) && !is_stated {
                camera.projection.pixel_sigma_px = NEURAL_PIXEL_SIGMA_PX;
            }
        }
    }

    /// Checks each camera, its latency, and that cameras have distinct names.
    #[cfg(feature = "camera")]
    pub(super) fn validate_cameras(&self) -> Result<(), ConfigError> {
        if let Some(camera) = &self.camera {
            self.validate_camera(camera)
                .map_err(|error| error.within("camera"))?;
        }
        if self.cameras.len() > MAX_PARTS {
            return Err(ConfigError::new(
                "cameras",
                self.cameras.len(),
                format!("at most {MAX_PARTS}"),
            ));
        }
        for (index, camera) in self.cameras.iter().enumerate() {
            let within = |error: ConfigError| error.within(&format!("cameras[{index}]"));
            self.validate_camera(camera).map_err(within)?;
            let earlier = self.camera.iter().chain(self.cameras.iter().take(index));
            let Some(name) = camera
                .name
                .as_ref()
                .filter(|_| earlier.clone().all(|other| other.name != camera.name))
            else {
                let allowed =
                    "unique, such as \"rear\": the camera reports as that part of the vehicle";
                return Err(within(camera.name.as_ref().map_or_else(
                    || ConfigError::missing("name", allowed),
                    |name| ConfigError::new("name", name, allowed),
                )));
            };
            if self
                .name
                .as_ref()
                .is_some_and(|node| camera.reporter(node) == *node)
            {
                return Err(within(ConfigError::new(
                    "name",
                    name,
                    "shorter, or `name` of the node",
                )));
            }
        }
        Ok(())
    }

    /// Checks a camera, and that aggregators do not refuse all of its reports as stale.
    #[cfg(feature = "camera")]
    fn validate_camera(&self, camera: &CameraConfig) -> Result<(), ConfigError> {
        camera.validate()?;
        let max_age_s = self.fusion.window.max_age_s;
        match camera.source.latency_s() {
            Some(latency_s) if latency_s >= max_age_s => {
                let allowed = format!(
                    "below `fusion.window.max_age_s`, {max_age_s}: every report would be stale; use a faster stream, or raise that key on all nodes of the cell"
                );
                Err(ConfigError::new("source.latency_s", latency_s, allowed))
            }
            _ => Ok(()),
        }
    }

    /// All cameras of the vehicle.
    #[cfg(feature = "camera")]
    pub fn all_cameras(&self) -> impl Iterator<Item = &CameraConfig> + Clone {
        self.camera.iter().chain(&self.cameras)
    }

    /// True if the node has a camera of its own.
    pub fn has_camera(&self) -> bool {
        #[cfg(feature = "camera")]
        let has_camera = self.all_cameras().next().is_some();
        #[cfg(not(feature = "camera"))]
        let has_camera = false;
        has_camera
    }
}
