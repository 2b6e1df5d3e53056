//! The file of cells between which a vehicle moves by its position, and its configuration in each
//! of them.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use ecod::config::{ConfigError, check_range};
use ecod::model::names::NodeName;
use ecod::model::origin::GeographicOrigin;
use ecod::roaming::KnownCell;
use ecod::wire::Role;
use serde::Deserialize;

use super::shared::{SharedConfig, StatedKeys};
use super::{LoadError, NodeConfig};
use crate::platform::bounded_file;
use crate::transport::gossip::check_key;
use crate::transport::mqtt::BrokerAddress;
use crate::transport::pki::Credentials;

/// A file of cells, common to all vehicles.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct CellsFile {
    /// The cells, including the cell of the vehicle's own configuration.
    cells: Vec<CellEntry>,
}

/// A cell, and the settings with which a vehicle joins it. Paths are relative to the file.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CellEntry {
    /// Name of the cell, as its nodes have it.
    pub name: NodeName,
    /// Latitude of its middle in degrees, north positive.
    pub latitude_deg: f64,
    /// Longitude of its middle in degrees, east positive.
    pub longitude_deg: f64,
    /// Radius of the cell in metres. Default 300.
    #[serde(default = "default_radius_m")]
    pub radius_m: f64,
    /// Nodes of the cell as `host:port`, as `membership.seeds`.
    #[serde(default)]
    pub seeds: Vec<String>,
    /// The file with the cell's key. Default: the file of the own configuration.
    #[serde(default)]
    pub key_file: Option<PathBuf>,
    /// With `[tls]`, the certificate of the cell's CA. Default: the CA of the own configuration.
    #[serde(default)]
    pub ca: Option<PathBuf>,
    /// The revocation list of that CA. Default: not set.
    #[serde(default)]
    pub revocation_list: Option<PathBuf>,
    /// The cell's MQTT broker, as `mqtt.broker`; it must not require a login. Default: not set; the
    /// cell's nodes have their own brokers.
    #[serde(default)]
    pub broker: Option<BrokerAddress>,
}

fn default_radius_m() -> f64 {
    300.0
}

impl CellEntry {
    fn origin(&self) -> GeographicOrigin {
        let Self {
            latitude_deg,
            longitude_deg,
            ..
        } = *self;
        GeographicOrigin {
            latitude_deg,
            longitude_deg,
            height_m: 0.0,
            rotation_deg: 0.0,
        }
    }

    fn validate(&self) -> Result<(), ConfigError> {
        self.origin().validate()?;
        if self.revocation_list.is_some() && self.ca.is_none() {
            return Err(ConfigError::new(
                "revocation_list",
                "a file",
                "set together with `ca`",
            ));
        }
        check_range("radius_m", self.radius_m, 1.0, 1e5)
    }

    /// Name, place and radius of the cell, by which a vehicle chooses it.
    pub fn known(&self) -> KnownCell {
        KnownCell {
            name: self.name.clone(),
            origin: self.origin(),
            radius_m: self.radius_m,
        }
    }
}

impl NodeConfig {
    /// The cells between which the vehicle moves; empty if it stays in its own cell.
    ///
    /// # Errors
    /// Returns a [`LoadError`] that names the file, and the entry and key in it.
    pub fn load_cells(&self) -> Result<Vec<CellEntry>, LoadError> {
        let Some(path) = &self.cells else {
            return Ok(Vec::new());
        };
        let text = bounded_file::read_text(path).map_err(|source| LoadError::Unreadable {
            path: path.clone(),
            source,
        })?;
        let malformed = |error: &dyn std::fmt::Display| {
            LoadError::Malformed(format!("{}: {error}", path.display()))
        };
        let CellsFile { mut cells } = toml::from_str(&text).map_err(|error| malformed(&error))?;
        for (place, cell) in cells.iter().enumerate() {
            let checked = cell
                .validate()
                .map_err(|error| error.within(&format!("cells[{place}]")));
            checked.map_err(|error| malformed(&error))?;
            if cells
                .iter()
                .take(place)
                .any(|other| other.name == cell.name)
            {
                let error = ConfigError::new("name", &cell.name, "unique")
                    .within(&format!("cells[{place}]"));
                return Err(malformed(&error));
            }
        }
        if !cells.iter().any(|cell| cell.name == self.cell) {
            return Err(malformed(&format!(
                "this vehicle's own `cell`, {}, is not among `cells`",
                self.cell
            )));
        }
        let directory = path.parent().unwrap_or(Path::new(""));
        for cell in &mut cells {
            for file in [&mut cell.key_file, &mut cell.ca, &mut cell.revocation_list]
                .into_iter()
                .flatten()
            {
                *file = directory.join(&*file);
            }
        }
        Ok(cells)
    }

    /// The credentials with which the vehicle joins a cell; `None` without certificates.
    ///
    /// # Errors
    /// Returns an error that names the cell and the unusable setting.
    pub fn credentials_in(&self, cell: &CellEntry) -> Result<Option<Arc<Credentials>>, LoadError> {
        let unusable = |error: &dyn std::fmt::Display| {
            LoadError::Malformed(format!("cell {}: {error}", cell.name))
        };
        let config = self.in_cell(cell).map_err(|error| unusable(&error))?;
        if config.membership.has_key() {
            check_key(&config.membership, &config.cell).map_err(|error| unusable(&error))?;
        }
        Ok(config
            .security()
            .map_err(|error| unusable(&error))?
            .credentials)
    }

    /// True if the node receives poses: its cameras, or its choice of the cell, need them.
    pub fn takes_poses(&self) -> bool {
        self.pose.listen.is_some() && (self.has_camera() || self.cells.is_some())
    }

    /// The configuration of the vehicle in a cell: its own configuration in its home cell.
    /// Elsewhere it is a guest, which cannot lead and takes the shared settings from the cell's
    /// description.
    ///
    /// # Errors
    /// Returns a [`ConfigError`] that names the key that cannot be used there.
    pub fn in_cell(&self, cell: &CellEntry) -> Result<Self, ConfigError> {
        if cell.name == self.cell {
            return Ok(self.clone());
        }
        let mut guest = Self {
            cell: cell.name.clone(),
            role: Role::Cav,
            ..self.clone()
        };
        SharedConfig::default().put_into(&mut guest);
        guest.stated = StatedKeys::default();
        guest.description = None;
        guest.mqtt.broker.clone_from(&cell.broker);
        // These settings are for the home cell's broker.
        guest.mqtt.user = None;
        guest.mqtt.password = None;
        guest.mqtt.ca = None;
        guest.membership.seeds.clone_from(&cell.seeds);
        guest.membership.advertise = None;
        if let Some(bind) = &mut guest.membership.bind {
            bind.set_port(0);
        }
        if let Some(file) = &cell.key_file {
            guest.membership.key = None;
            guest.membership.key_file = Some(file.clone());
        }
        if let (Some(tls), Some(ca)) = (&mut guest.tls, &cell.ca) {
            tls.ca.clone_from(ca);
            tls.revocation_list.clone_from(&cell.revocation_list);
        }
        guest.validate()?;
        Ok(guest)
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn vehicle(directory: &Path, cells: &str, own: &str) -> Result<NodeConfig, LoadError> {
        std::fs::write(directory.join("cells.toml"), cells).unwrap();
        let file = directory.join("node.toml");
        let listen = if own.contains("[pose]") {
            ""
        } else {
            "[pose]\nlisten = \"127.0.0.1:0\"\n"
        };
        std::fs::write(
            &file,
            format!(
                "cells = {:?}\ncell = \"lot-1\"\n{own}{listen}",
                directory.join("cells.toml")
            ),
        )
        .unwrap();
        NodeConfig::load(Some(&file), &json!({ "name": "euclid" }))
    }

    const CELLS: &str = r#"
        [[cells]]
        name = "lot-1"
        latitude_deg = 52.2
        longitude_deg = 21.0
        [[cells]]
        name = "lot-2"
        latitude_deg = 52.2
        longitude_deg = 21.01
        radius_m = 150
        seeds = ["10.0.2.1:17884"]
        key_file = "lot-2.key"
    "#;

    #[test]
    fn guest_cannot_lead() {
        let directory = tempfile::tempdir().unwrap();
        let own = "[origin]\nlatitude_deg = 52.2\nlongitude_deg = 21\n[mqtt]\nuser = \"euclid\"\npassword = \"hush\"\n[fusion.pace]\ngate_m = 2.0\n[membership]\nkey = \"a long enough key\"\nbind = \"0.0.0.0:17884\"\n";
        let config = vehicle(directory.path(), CELLS, own).unwrap();
        let cells = config.load_cells().unwrap();
        assert_eq!(config.in_cell(&cells[0]).unwrap(), config);
        let guest = config.in_cell(&cells[1]).unwrap();
        assert_eq!((guest.cell.as_str(), guest.role), ("lot-2", Role::Cav));
        assert_eq!((guest.origin, guest.fusion.pace.gate_m), (None, 0.5));
        assert_eq!(
            (guest.mqtt.user, guest.mqtt.password),
            (None, None),
            "no other cell's broker gets the password"
        );
        assert_eq!(
            (
                guest.membership.seeds,
                guest.membership.bind.unwrap().port()
            ),
            (vec!["10.0.2.1:17884".into()], 0)
        );
        assert_eq!(
            guest.membership.key_file,
            Some(directory.path().join("lot-2.key"))
        );
        assert!(guest.membership.key.is_none());
    }

    #[test]
    fn errors_name_file_and_key() {
        let directory = tempfile::tempdir().unwrap();
        let error = |cells: &str| {
            vehicle(directory.path(), cells, "")
                .unwrap()
                .load_cells()
                .unwrap_err()
                .to_string()
        };
        for (cells, parts) in [
            (
                CELLS.replace("lot-1", "lot-3"),
                ["cells.toml", "lot-1", "not among"],
            ),
            (
                CELLS.replace("lot-2\"", "lot-1\""),
                ["cells.toml", "`cells[1].name`", "unique"],
            ),
            (
                CELLS.replace("radius_m = 150", "radius_m = 0"),
                ["cells.toml", "`cells[1].radius_m`", "0"],
            ),
            (
                CELLS.replace("radius_m", "radius"),
                ["cells.toml", "unknown field", "radius_m"],
            ),
            (
                CELLS.replace("key_file", "revocation_list"),
                ["cells.toml", "`cells[1].revocation_list`", "`ca`"],
            ),
        ] {
            let error = error(&cells);
            assert!(parts.iter().all(|part| error.contains(part)), "{error}");
        }
        let error = vehicle(directory.path(), CELLS, "[pose]\nx_m = 1\n")
            .unwrap_err()
            .to_string();
        assert!(
            error.contains("`pose.listen`") && error.contains("cells"),
            "{error}"
        );
    }
}
