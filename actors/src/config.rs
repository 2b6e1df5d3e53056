//! The configuration of a node: defaults, then a TOML file, then `ECOD_…` in the environment, then flags.
//!
//! Environment variables name a key with two underscores between its levels: `ECOD_MQTT__BROKER=10.0.0.2:1883`.

use std::net::SocketAddr;
use std::path::PathBuf;

use ecod::aggregator::FusionConfig;
use ecod::config::{ConfigError, check_range};
use ecod::election::ElectionConfig;
use ecod::geometry::Pose;
use ecod::landmark::{Landmark, LandmarkConfig};
use ecod::names::NodeName;
use ecod::wire::Role;
use figment::Figment;
use figment::providers::{Env, Format, Serialized, Toml};
use serde::{Deserialize, Serialize};

use crate::broker::BrokerConfig;
#[cfg(feature = "camera")]
use crate::camera::CameraConfig;
use crate::gateway::MqttConfig;
use crate::leader_election::DataPlane;
use crate::membership::MembershipConfig;
use crate::reputation_keeper::ReputationKeeperConfig;

/// Everything that a node can be told.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct NodeConfig {
    /// Name of the node, unique in its cell. Default `edge` for an edge; a vehicle's must be given.
    pub name: Option<NodeName>,
    /// Name of the cell; nodes of other cells are not heard. Default `cell`.
    pub cell: NodeName,
    /// What the node is meant to do. Default `auto`.
    pub role: Role,
    /// Where the embedded broker of a node that may lead listens. Default port 1883, on all interfaces if the cell has a
    /// key and on 127.0.0.1 without, where other machines do not reach it.
    pub listen: Option<SocketAddr>,
    /// Directory for what survives a restart: reputations and the highest term of leadership. Default
    /// `$STATE_DIRECTORY`, which systemd sets, or none: then reputations end with the node, and it learns the term from the
    /// others.
    pub state_dir: Option<PathBuf>,
    /// A file to which every accepted map is appended with its time of receipt, one JSON
    /// object a line. Default none.
    pub map_log: Option<PathBuf>,
    /// Pose of the vehicle. Default the origin, looking east.
    pub pose: PoseConfig,
    /// How the nodes of the cell find and watch each other.
    pub membership: MembershipConfig,
    /// Who leads the cell.
    pub election: ElectionConfig,
    /// MQTT connections.
    pub mqtt: MqttConfig,
    /// Limits of the embedded broker.
    pub broker: BrokerConfig,
    /// How reports are fused; used by aggregators.
    pub fusion: FusionConfig,
    /// How often reputations are published, saved and replicated; used by aggregators.
    pub reputations: ReputationKeeperConfig,
    /// The camera and what is made of its frames. Default none.
    #[cfg(feature = "camera")]
    pub camera: Option<CameraConfig>,
    /// The cell's known locations, the same on every node. Default none.
    pub landmarks: Vec<LandmarkConfig>,
}

/// Where a vehicle stands.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PoseConfig {
    /// East in metres. Default 0.
    pub x_m: f64,
    /// North in metres. Default 0.
    pub y_m: f64,
    /// Heading in degrees, counter-clockwise from east. Default 0.
    pub heading_deg: f64,
}

impl Default for NodeConfig {
    fn default() -> Self {
        Self {
            name: None,
            cell: NodeName::from_static("cell"),
            role: Role::Auto,
            listen: None,
            state_dir: None,
            map_log: None,
            pose: PoseConfig::default(),
            membership: MembershipConfig::default(),
            election: ElectionConfig::default(),
            mqtt: MqttConfig::default(),
            broker: BrokerConfig::default(),
            fusion: FusionConfig::default(),
            reputations: ReputationKeeperConfig::default(),
            #[cfg(feature = "camera")]
            camera: None,
            landmarks: Vec::new(),
        }
    }
}

/// A configuration that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum LoadError {
    /// The file is not there or cannot be read.
    #[error("cannot read configuration {path}")]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// What the operating system said.
        source: std::io::Error,
    },
    /// Keys or values are of the wrong kind or unknown.
    #[error("{0}")]
    Malformed(String),
    /// A value is out of its range.
    #[error(transparent)]
    OutOfRange(#[from] ConfigError),
}

impl NodeConfig {
    /// Reads the file, if any, lays the environment and `flags` over it, and checks the result.
    ///
    /// # Errors
    /// [`LoadError`] naming the file, or the key, the value and what is allowed.
    pub fn load(file: Option<&std::path::Path>, flags: &impl Serialize) -> Result<Self, LoadError> {
        let mut figment = Figment::from(Serialized::defaults(Self::default()));
        if let Some(path) = file {
            std::fs::metadata(path).map_err(|source| LoadError::Unreadable { path: path.into(), source })?;
            figment = figment.merge(Toml::file_exact(path));
        }
        let figment = figment.merge(Env::prefixed("ECOD_").split("__")).merge(Serialized::defaults(flags));
        let mut config: Self = figment.extract().map_err(|errors| LoadError::Malformed(describe(errors)))?;
        if config.role == Role::Edge && config.name.is_none() {
            config.name = Some(NodeName::from_static("edge"));
        }
        if config.state_dir.is_none() {
            config.state_dir = std::env::var_os("STATE_DIRECTORY").map(PathBuf::from);
        }
        config.validate()?;
        Ok(config)
    }

    /// Checks every value and that they fit together.
    ///
    /// # Errors
    /// [`ConfigError`] naming the key, the value and what is allowed.
    pub fn validate(&self) -> Result<(), ConfigError> {
        if self.name.is_none() {
            return Err(ConfigError::new("name", "nothing", "the node's name, unique in its cell"));
        }
        check_range("pose.x_m", self.pose.x_m, -1e8, 1e8)?;
        check_range("pose.y_m", self.pose.y_m, -1e8, 1e8)?;
        check_range("pose.heading_deg", self.pose.heading_deg, -360.0, 360.0)?;
        self.membership.validate().map_err(|error| error.within("membership"))?;
        self.election.validate().map_err(|error| error.within("election"))?;
        self.mqtt.validate().map_err(|error| error.within("mqtt"))?;
        self.broker.validate().map_err(|error| error.within("broker"))?;
        self.fusion.validate().map_err(|error| error.within("fusion"))?;
        self.reputations.validate().map_err(|error| error.within("reputations"))?;
        #[cfg(feature = "camera")]
        if let Some(camera) = &self.camera {
            camera.validate().map_err(|error| error.within("camera"))?;
        }
        LandmarkConfig::validate_all(&self.landmarks)
    }

    /// Where the embedded broker listens.
    pub fn broker_listen(&self) -> SocketAddr {
        let ip = if self.membership.has_key() { [0, 0, 0, 0] } else { [127, 0, 0, 1] };
        self.listen.unwrap_or(SocketAddr::from((ip, 1883)))
    }

    /// Whether the node may lead its cell.
    pub fn may_lead(&self) -> bool {
        self.role != Role::Cav
    }

    /// Which brokers carry the cell's data.
    pub fn data_plane(&self) -> DataPlane {
        let external = self.mqtt.broker.clone();
        let embedded = external.is_none() || self.mqtt.fallback_to_embedded;
        DataPlane { external, embedded }
    }

    /// The vehicle's pose.
    pub fn pose(&self) -> Pose {
        Pose::new(self.pose.x_m, self.pose.y_m, self.pose.heading_deg.to_radians())
    }

    /// The cell's known locations.
    pub fn landmarks(&self) -> Vec<Landmark> {
        self.landmarks.iter().map(Landmark::from).collect()
    }
}

/// Every error with its key and where it was read.
fn describe(errors: figment::Error) -> String {
    let describe = |error: figment::Error| {
        let origin = error.metadata.as_ref().map_or_else(String::new, |metadata| {
            let place = metadata.source.as_ref().map_or_else(String::new, |source| format!(" {source}"));
            format!(" in {}{place}", metadata.name)
        });
        format!("configuration key `{}`{origin}: {}", error.path.join("."), error.kind)
    };
    errors.into_iter().map(describe).collect::<Vec<_>>().join("\n")
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::*;

    #[derive(Serialize)]
    struct Flags {
        name: &'static str,
    }

    fn load(toml: &str) -> Result<NodeConfig, LoadError> {
        let mut file = tempfile::NamedTempFile::new().unwrap();
        file.write_all(toml.as_bytes()).unwrap();
        NodeConfig::load(Some(file.path()), &Flags { name: "from-flag" })
    }

    #[test]
    fn flags_override_the_file_and_the_file_the_defaults() {
        let config = load("name = \"from-file\"\nrole = \"edge\"\ncell = \"lot-9\"").unwrap();
        assert_eq!(config.name.as_ref().unwrap().as_str(), "from-flag");
        assert_eq!(config.cell.as_str(), "lot-9");
        assert_eq!(config.broker_listen().to_string(), "127.0.0.1:1883");
        let keyed = load("[membership]\nkey = \"a key for the lot\"").unwrap();
        assert_eq!(keyed.broker_listen().to_string(), "0.0.0.0:1883");
    }

    #[test]
    fn errors_name_the_key_the_value_and_what_is_allowed() {
        for (toml, parts) in [
            ("role = \"edge\"\n[fusion.pace]\ngate_m = -1", ["`fusion.pace.gate_m`", "-1", "0.001 to 1000"]),
            ("role = \"edge\"\n[fusion.pace]\ngate = 1", ["`fusion.pace.gate`", "unknown field", "`gate_m`"]),
            ("role = \"edge\"\n[mqtt]\nkeep_alive_s = \"x\"", ["`mqtt.keep_alive_s`", "\"x\"", "u16"]),
            ("role = \"king\"", ["`role`", "king", "`edge`"]),
            ("[election]\nbeat_ms = 1", ["`election.beat_ms`", "1", "5 to"]),
            (
                "role = \"edge\"\n[[landmarks]]\nid = \"a\"\nx_m = 0\ny_m = 0\n[[landmarks]]\nid = \"a\"\nx_m = 1\ny_m = 0",
                ["`landmarks[1].id`", "\"a\"", "unique"],
            ),
            ("role = ", ["TOML", "configuration", ""]),
        ] {
            let error = load(toml).unwrap_err().to_string();
            assert!(parts.iter().all(|part| error.contains(part)), "{error}");
        }
    }

    #[test]
    fn a_missing_file_is_named() {
        let error = NodeConfig::load(Some(std::path::Path::new("/missing.toml")), &Flags { name: "x" }).unwrap_err();
        assert!(error.to_string().contains("/missing.toml"));
    }

    #[test]
    fn a_printed_configuration_can_be_read_back() {
        let config = load("role = \"edge\"").unwrap();
        assert_eq!(load(&toml::to_string(&config).unwrap()).unwrap(), config);
    }
}
