//! The file that `try --output` writes: the configuration with comments, below what to measure.

use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};

use crate::node::config::NodeConfig;
use crate::platform::bounded_file;

/// A part of the configuration that no argument states.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Guess {
    FieldOfView,
    Height,
    Tilt,
    /// Height and tilt that people who walk have determined.
    MountFromPeople,
    Position,
}

/// A file for the configuration of a vehicle.
#[derive(Debug)]
pub(super) struct Template {
    path: PathBuf,
    /// The text that was written last.
    written: Option<String>,
}

impl Guess {
    /// The key, its guessed value, and the way to measure it; `None` if the configuration has no
    /// value.
    fn advice(self, config: &NodeConfig) -> Option<String> {
        let camera = config.camera.as_ref();
        let mount = camera.map(|camera| &camera.mount);
        let height_m = mount.and_then(|mount| mount.height_m);
        let pitch_deg = mount.map(|mount| mount.pitch_deg);
        Some(match self {
            Self::FieldOfView => {
                let fov_deg = camera?.optics.horizontal_fov_deg;
                format!(
                    "camera.optics: a horizontal field of view of {fov_deg}° is guessed. Measure it with \
                     `ecod-node calibrate`, or take it from the data sheet."
                )
            }
            Self::Height => format!(
                "camera.mount.height_m: {} m above the ground are guessed. Measure with a tape.",
                height_m?
            ),
            Self::Tilt => format!(
                "camera.mount.pitch_deg: {}° below the horizon are guessed. Measure with `ecod-node \
                 calibrate mount` or on the page.",
                pitch_deg?
            ),
            Self::MountFromPeople => format!(
                "camera.mount: {} m and {}° are estimated from people who walk. `ecod-node \
                 calibrate mount` measures them from known points.",
                height_m?, pitch_deg?
            ),
            Self::Position => format!(
                "pose: {} m east and {} m north of the origin, looking east, is guessed. Measure position and \
                 heading in the frame of the cell.",
                config.pose.x_m, config.pose.y_m
            ),
        })
    }
}

impl Template {
    /// A file that is not written yet.
    ///
    /// # Errors
    /// Returns an error if the file exists or cannot be made.
    pub(super) fn new(path: PathBuf) -> anyhow::Result<Self> {
        let directory = path
            .parent()
            .filter(|parent| !parent.as_os_str().is_empty())
            .unwrap_or(Path::new("."));
        ensure!(
            directory.is_dir(),
            "cannot write {}: make the directory first",
            path.display()
        );
        ensure!(
            !path.exists(),
            "cannot write {}: it exists, choose another name for --output",
            path.display()
        );
        Ok(Self {
            path,
            written: None,
        })
    }

    /// Writes a configuration in which these parts are guesses, in place of the one before.
    ///
    /// # Errors
    /// Returns an error if the file has changed since the last time, which leaves it as it is, or
    /// cannot be written.
    pub(super) fn write(&mut self, config: &NodeConfig, guesses: &[Guess]) -> anyhow::Result<()> {
        let text = self.text(config, guesses)?;
        let written = match &self.written {
            None => {
                File::create_new(&self.path).and_then(|mut file| file.write_all(text.as_bytes()))
            }
            Some(written) => {
                let is_edited = bounded_file::read_text(&self.path)? != *written;
                ensure!(!is_edited, "{} was edited", self.path.display());
                std::fs::write(&self.path, &text)
            }
        };
        written.with_context(|| format!("cannot write {}", self.path.display()))?;
        self.written = Some(text);
        Ok(())
    }

    fn text(&self, config: &NodeConfig, guesses: &[Guess]) -> anyhow::Result<String> {
        let path = &self.path;
        let mut text = format!(
            "# Written by `ecod-node try`, with the keys that differ from the defaults.\n\
             # Start the node: ecod-node --config {path:?}\n"
        );
        if !guesses.is_empty() {
            text += "# The map is as good as these values, so measure and correct them:\n";
        }
        for advice in guesses.iter().filter_map(|guess| guess.advice(config)) {
            text += &format!("# - {advice}\n");
        }
        let keys = config
            .to_toml_commented()
            .context("the configuration cannot be written as TOML")?;
        Ok(text + "\n" + &keys)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn edited_file_is_kept() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("node.toml");
        let text = || std::fs::read_to_string(&path).unwrap();
        let mut config = NodeConfig::default();
        let mut template = Template::new(path.clone()).unwrap();
        template.write(&config, &[Guess::Position]).unwrap();
        assert!(text().contains("# - pose: 0 m east and 0 m north"));
        config.pose.y_m = 5.0;
        template.write(&config, &[Guess::Position]).unwrap();
        assert!(text().contains("# - pose: 0 m east and 5 m north") && text().contains("y_m = 5"));

        let edited = text().replace("y_m = 5", "y_m = 7");
        std::fs::write(&path, &edited).unwrap();
        config.pose.y_m = 6.0;
        let error = template.write(&config, &[]).unwrap_err().to_string();
        assert_eq!((text(), error.contains("was edited")), (edited, true));
    }
}
