//! Landmarks in a configuration file.

use std::collections::{BTreeMap, BTreeSet};

use nalgebra::Point2;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{Landmark, Synonym, VacancySign};
use crate::config::{ConfigError, check_range};
use crate::model::names::{Label, LandmarkId, MAX_NAME_BYTES, is_label};

/// One entry of `landmarks` in the configuration: a location at which an object may stand.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct LandmarkConfig {
    /// Name, unique in the cell.
    pub id: LandmarkId,
    /// Position of an object in metres east.
    pub x_m: f64,
    /// Position of an object in metres north.
    pub y_m: f64,
    /// Direction in degrees, counter-clockwise from east, from which an object here can be read.
    /// Default: from all around.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub facing_deg: Option<f64>,
    /// A fixed sign that is in view while the location is empty. Default: no sign.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub vacancy: Option<VacancyConfig>,
    /// Labels that count as another one here, such as `vase = "sports ball"`. Default: no synonyms.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub synonyms: BTreeMap<Label, Label>,
}

fn check_label(key: &str, text: &str) -> Result<(), ConfigError> {
    let allowed = format!("1 to {MAX_NAME_BYTES} bytes without control characters");
    if is_label(text) {
        Ok(())
    } else {
        Err(ConfigError::new(key, format!("{text:?}"), allowed))
    }
}

/// Checks the labels of a list of synonyms.
pub(crate) fn check_synonyms(synonyms: &BTreeMap<Label, Label>) -> Result<(), ConfigError> {
    synonyms
        .iter()
        .flat_map(|(other, label)| [other, label])
        .try_for_each(|label| check_label("synonyms", label))
}

/// The table `vacancy` of a landmark: a sign that is in view while the location is empty.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct VacancyConfig {
    /// The text of the sign.
    pub label: Label,
    /// Position of the sign in metres east.
    pub x_m: f64,
    /// Position of the sign in metres north.
    pub y_m: f64,
}

impl LandmarkConfig {
    /// A location that can be read from all around, without a sign or other labels; `x_m` east and
    /// `y_m` north.
    pub fn at(id: impl Into<LandmarkId>, x_m: f64, y_m: f64) -> Self {
        Self {
            id: id.into(),
            x_m,
            y_m,
            facing_deg: None,
            vacancy: None,
            synonyms: BTreeMap::new(),
        }
    }

    /// Checks one location.
    ///
    /// # Errors
    /// Returns a [`ConfigError`] that names the key, the value and the allowed range.
    pub fn validate(&self) -> Result<(), ConfigError> {
        check_label("id", &self.id)?;
        check_synonyms(&self.synonyms)?;
        check_range("x_m", self.x_m, -1e8, 1e8)?;
        check_range("y_m", self.y_m, -1e8, 1e8)?;
        check_range("facing_deg", self.facing_deg.unwrap_or(0.0), -360.0, 360.0)?;
        if let Some(sign) = &self.vacancy {
            check_range("vacancy.x_m", sign.x_m, -1e8, 1e8)?;
            check_range("vacancy.y_m", sign.y_m, -1e8, 1e8)?;
            check_label("vacancy.label", &sign.label)?;
        }
        Ok(())
    }

    /// Checks all locations of a cell and that their names differ.
    ///
    /// # Errors
    /// Returns a [`ConfigError`] that names the location by its position in the list.
    pub fn validate_all(locations: &[Self]) -> Result<(), ConfigError> {
        let mut ids = BTreeSet::new();
        for (index, location) in locations.iter().enumerate() {
            let section = format!("landmarks[{index}]");
            location
                .validate()
                .map_err(|error| error.within(&section))?;
            if !ids.insert(&location.id) {
                return Err(
                    ConfigError::new("id", format!("{:?}", location.id), "unique").within(&section),
                );
            }
        }
        Ok(())
    }
}

impl From<&LandmarkConfig> for Landmark {
    fn from(config: &LandmarkConfig) -> Self {
        let sign = |sign: &VacancyConfig| VacancySign {
            label: sign.label.clone(),
            position: Point2::new(sign.x_m, sign.y_m),
        };
        Self {
            id: config.id.clone(),
            position: Point2::new(config.x_m, config.y_m),
            facing_rad: config.facing_deg.map(f64::to_radians),
            vacancy: config.vacancy.as_ref().map(sign),
            synonyms: config
                .synonyms
                .iter()
                .map(|(from, label)| Synonym {
                    from: from.clone(),
                    label: label.clone(),
                })
                .collect(),
        }
    }
}

impl From<&Landmark> for LandmarkConfig {
    fn from(landmark: &Landmark) -> Self {
        let sign = |sign: &VacancySign| VacancyConfig {
            label: sign.label.clone(),
            x_m: sign.position.x,
            y_m: sign.position.y,
        };
        Self {
            id: landmark.id.clone(),
            x_m: landmark.position.x,
            y_m: landmark.position.y,
            facing_deg: landmark.facing_rad.map(f64::to_degrees),
            vacancy: landmark.vacancy.as_ref().map(sign),
            synonyms: landmark
                .synonyms
                .iter()
                .map(|s| (s.from.clone(), s.label.clone()))
                .collect(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn invalid_texts_are_refused() {
        let place = LandmarkConfig::at("slot-0", 0.0, 0.0);
        assert_eq!(place.validate(), Ok(()));
        let sign = |label: &str| {
            Some(VacancyConfig {
                label: label.into(),
                x_m: 0.0,
                y_m: 0.0,
            })
        };
        for (wrong, key) in [
            (
                LandmarkConfig {
                    id: "a\tb".into(),
                    ..place.clone()
                },
                "id",
            ),
            (
                LandmarkConfig {
                    vacancy: sign(""),
                    ..place.clone()
                },
                "vacancy.label",
            ),
            (
                LandmarkConfig {
                    vacancy: sign(&"x".repeat(65)),
                    ..place.clone()
                },
                "vacancy.label",
            ),
            (
                LandmarkConfig {
                    synonyms: [("".into(), "cup".into())].into(),
                    ..place.clone()
                },
                "synonyms",
            ),
        ] {
            assert_eq!(wrong.validate().unwrap_err().key, key);
        }
    }
}
