//! The configuration of a node: defaults, then a TOML file, then `ECOD_…` in the environment, then
//! flags.
//!
//! Environment variables name a key with two underscores between its levels:
//! `ECOD_MQTT__BROKER=10.0.0.2:1883`.

mod cameras;
mod cells;
pub mod descriptions;
mod extraction;
pub(crate) mod guidance;
mod observer;
mod printed;
mod shared;
mod units;

use std::net::SocketAddr;
use std::path::PathBuf;

use ecod::aggregator::FusionConfig;
use ecod::config::ConfigError;
use ecod::leadership::election::ElectionConfig;
use ecod::model::names::NodeName;
use ecod::model::origin::GeographicOrigin;
use ecod::perception::landmark::{Landmark, LandmarkConfig};
use ecod::perception::projection::NEURAL_PIXEL_SIGMA_PX;
use ecod::wire::Role;
use figment::providers::{Format, Serialized, Toml};
use figment::value::{Dict, Map};
use figment::{Figment, Metadata, Profile, Provider};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

pub use self::cells::CellEntry;
pub(crate) use self::extraction::variables_without_key;
use self::extraction::{environment, extract};
pub use self::shared::{DescriptionError, SharedConfig, StatedKeys};
use crate::actors::reputation_keeper::ReputationKeeperConfig;
use crate::actors::uplink::UplinkConfig;
#[cfg(feature = "camera")]
use crate::camera::config::CameraConfig;
use crate::camera::vehicle_pose::PoseConfig;
use crate::observe::dashboard::DashboardConfig;
use crate::observe::recorder::RecordConfig;
use crate::platform::bounded_file;
use crate::transport::broker::BrokerConfig;
use crate::transport::gossip::MembershipConfig;
use crate::transport::mqtt::{DataPlane, MqttConfig, Security, SecurityError};
use crate::transport::pki::TlsConfig;

/// All settings of a node.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct NodeConfig {
    /// Name of the node, unique in its cell and region: 1 to 64 of `A-Z a-z 0-9 _ -`. Default:
    /// `edge` for an edge, otherwise the host name.
    pub name: Option<NodeName>,
    /// Name of the cell; messages of nodes of other cells are ignored. Default `cell`.
    pub cell: NodeName,
    /// The node's role; with `[tls]` at most the role in its certificate. Default `auto`.
    pub role: Role,
    /// Address of the embedded broker; without `[tls]`, other addresses than loopback need
    /// `broker.allow_plaintext`. Default: port 8883 on all interfaces with `[tls]`, otherwise
    /// 127.0.0.1:1883. The broker takes a free port if the default port is in use.
    pub listen: Option<SocketAddr>,
    /// Directory for reputations, the highest term and the description; without it reputations end
    /// with the node. Default: `$STATE_DIRECTORY`, which systemd sets.
    pub state_dir: Option<PathBuf>,
    /// File with the first description of a cell, on a candidate. Default: not set.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub description: Option<PathBuf>,
    /// File to which every accepted map is appended with its time of receipt, one JSON object per
    /// line; at 512 MiB it is renamed to `….1`. Default: not set.
    pub map_log: Option<PathBuf>,
    /// The vehicle's pose. Default at the origin, looking east.
    pub pose: PoseConfig,
    /// File with the cells between which the vehicle roams by its position; needs `pose.listen`.
    /// Default: not set; the vehicle stays in `cell`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cells: Option<PathBuf>,
    /// Settings with which the nodes of the cell find and monitor each other.
    pub membership: MembershipConfig,
    /// Election of the leader.
    pub election: ElectionConfig,
    /// Settings of the node's MQTT connections.
    pub mqtt: MqttConfig,
    /// The node's certificates. Default: not set; connections to brokers are in plaintext.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tls: Option<TlsConfig>,
    /// Limits of the embedded broker.
    pub broker: BrokerConfig,
    /// The connection to a region of cells; used by the leader.
    pub uplink: UplinkConfig,
    /// Settings of fusion; used by aggregators.
    pub fusion: FusionConfig,
    /// Periods at which reputations are published, saved and replicated; used by aggregators.
    pub reputations: ReputationKeeperConfig,
    /// A web page with the cell, metrics and health.
    pub dashboard: DashboardConfig,
    /// The camera and the processing of its frames. Default: not set.
    #[cfg(feature = "camera")]
    pub camera: Option<CameraConfig>,
    /// Further cameras of the vehicle, each with a name. Default: empty.
    #[cfg(feature = "camera")]
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub cameras: Vec<CameraConfig>,
    /// The log of the messages that the node receives. Default: not set.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub record: Option<RecordConfig>,
    /// The place of the cell's frame on Earth, equal on every node. Default: not set.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub origin: Option<GeographicOrigin>,
    /// The cell's landmarks, equal on every node. Default: empty.
    pub landmarks: Vec<LandmarkConfig>,
    /// Shared keys that are stated here, not just defaults: the cell's description must not
    /// contradict them.
    #[serde(skip)]
    pub stated: StatedKeys,
}

impl Default for NodeConfig {
    fn default() -> Self {
        Self {
            name: None,
            cell: NodeName::from_static("cell"),
            role: Role::Auto,
            listen: None,
            state_dir: None,
            description: None,
            map_log: None,
            pose: PoseConfig::default(),
            cells: None,
            membership: MembershipConfig::default(),
            election: ElectionConfig::default(),
            mqtt: MqttConfig::default(),
            tls: None,
            broker: BrokerConfig::default(),
            uplink: UplinkConfig::default(),
            fusion: FusionConfig::default(),
            reputations: ReputationKeeperConfig::default(),
            dashboard: DashboardConfig::default(),
            #[cfg(feature = "camera")]
            camera: None,
            #[cfg(feature = "camera")]
            cameras: Vec::new(),
            record: None,
            origin: None,
            landmarks: Vec::new(),
            stated: StatedKeys::default(),
        }
    }
}

/// A configuration that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum LoadError {
    /// The file does not exist or cannot be read.
    #[error("cannot read configuration {path}")]
    Unreadable {
        /// Path of the file.
        path: PathBuf,
        /// The operating system's error.
        source: std::io::Error,
    },
    /// Keys or values are of the wrong kind or unknown.
    #[error("{0}")]
    Malformed(String),
    /// A value is out of its range.
    #[error(transparent)]
    OutOfRange(#[from] ConfigError),
}

/// Last line of a configuration that `init` or `join` has written.
pub(crate) const END_OF_CONFIGURATION: &str = "# end of node.toml";

/// A text in TOML, with its file for messages.
struct TomlFile<'a> {
    path: &'a std::path::Path,
    text: String,
}

impl<'a> TomlFile<'a> {
    fn read(path: &'a std::path::Path) -> Result<Self, LoadError> {
        match bounded_file::read_text(path) {
            Ok(text) => Ok(Self { path, text }),
            Err(source) => Err(LoadError::Unreadable {
                path: path.into(),
                source,
            }),
        }
    }
}

impl Provider for TomlFile<'_> {
    fn metadata(&self) -> Metadata {
        Metadata::from("TOML file", self.path)
    }

    fn data(&self) -> Result<Map<Profile, Dict>, figment::Error> {
        Toml::string(&self.text).data()
    }
}

/// Checks that a configuration is a file with content, and not truncated: `init` and `join` write
/// an end mark.
fn check_whole(TomlFile { path, text }: &TomlFile<'_>) -> Result<(), LoadError> {
    let path = path.display();
    if text.trim().is_empty() {
        let remedy = "write its keys, or start the node without `--config`";
        return Err(LoadError::Malformed(format!(
            "the configuration {path} is empty: {remedy}"
        )));
    }
    let names_end = text
        .lines()
        .any(|line| line.starts_with('#') && line.contains(&format!("`{END_OF_CONFIGURATION}`")));
    if names_end
        && !text
            .lines()
            .any(|line| line.trim_end() == END_OF_CONFIGURATION)
    {
        let remedy = "restore the file, or run `ecod-node join` again with a new token";
        return Err(LoadError::Malformed(format!(
            "the configuration {path} is cut off: its line `{END_OF_CONFIGURATION}` is missing: {remedy}"
        )));
    }
    Ok(())
}

impl NodeConfig {
    /// Reads the file, if any, applies the environment and `flags` on top of it, and checks the
    /// result.
    ///
    /// # Errors
    /// Returns a [`LoadError`] that names the file, or the key, the value and the allowed range.
    pub fn load(file: Option<&std::path::Path>, flags: &impl Serialize) -> Result<Self, LoadError> {
        let mut stated = Figment::new();
        if let Some(path) = file {
            let file = TomlFile::read(path)?;
            check_whole(&file)?;
            stated = stated.merge(file);
        }
        let stated = stated
            .merge(environment())
            .merge(Serialized::defaults(flags));
        let mut config = Self::of_keys(&stated)?;
        config.stated = stated
            .extract()
            .map(|stated| StatedKeys::of(&stated))
            .unwrap_or_default();
        if config.name.is_none() {
            let edge = (config.role == Role::Edge).then_some(NodeName::from_static("edge"));
            config.name = edge.or_else(host_name);
        }
        if config.state_dir.is_none() {
            config.state_dir = std::env::var_os("STATE_DIRECTORY").map(PathBuf::from);
        }
        config.validate()?;
        Ok(config)
    }

    /// Reads the settings of a cell from a file, which may be a description or a node's
    /// configuration: all keys are accepted, all are optional, and the environment and flags are
    /// ignored. Fusion and locations are checked.
    ///
    /// # Errors
    /// Returns a [`LoadError`] that names the file, or the key, the value and the allowed range.
    pub fn load_cell(file: &std::path::Path) -> Result<Self, LoadError> {
        let file = TomlFile::read(file)?;
        if let Ok(shared) = SharedConfig::parse(&file.text) {
            let mut config = Self::default();
            shared.put_into(&mut config);
            return Ok(config);
        }
        let config = Self::of_keys(&Figment::from(file))?;
        config
            .fusion
            .validate()
            .map_err(|error| error.within("fusion"))?;
        LandmarkConfig::validate_all(&config.landmarks)?;
        Ok(config)
    }

    /// The stated keys over the defaults, unchecked. Boxes of a neural detector have their own
    /// default deviation.
    fn of_keys(stated: &Figment) -> Result<Self, LoadError> {
        let mut defaults = Figment::from(Serialized::defaults(Self::default()));
        if stated
            .extract_inner("camera.detector.kind")
            .is_ok_and(|kind: String| kind == "coco")
        {
            defaults = defaults.merge(Serialized::default(
                "camera.projection.pixel_sigma_px",
                NEURAL_PIXEL_SIGMA_PX,
            ));
        }
        #[cfg_attr(
            not(feature = "camera"),
            expect(unused_mut, reason = "cameras have defaults of their own")
        )]
        let mut config = extract(defaults.merge(stated))?;
        #[cfg(feature = "camera")]
        config.set_camera_defaults(stated);
        Ok(config)
    }

    /// Checks every value, and the consistency of the values.
    ///
    /// # Errors
    /// Returns a [`ConfigError`] that names the key, the value and the allowed range.
    pub fn validate(&self) -> Result<(), ConfigError> {
        if self.name.is_none() {
            return Err(ConfigError::missing(
                "name",
                "the node's name, unique in its cell (`--name`): the host name cannot serve as one",
            ));
        }
        self.pose.validate().map_err(|error| error.within("pose"))?;
        if self.cells.is_some() && self.pose.listen.is_none() {
            let allowed = "an address that receives the vehicle's poses, beside `cells`: it moves between them by its position";
            return Err(ConfigError::missing("pose.listen", allowed));
        }
        self.membership
            .validate()
            .map_err(|error| error.within("membership"))?;
        self.election
            .validate()
            .map_err(|error| error.within("election"))?;
        let hello = self.membership.hello_ms;
        let join = self.election.join_ms;
        if hello.saturating_mul(2) > join {
            let allowed = format!(
                "at most half of `election.join_ms`, {join}: a leader that is there must be found"
            );
            return Err(ConfigError::new("membership.hello_ms", hello, allowed));
        }
        self.mqtt.validate().map_err(|error| error.within("mqtt"))?;
        if self.mqtt.sign && !self.membership.has_key() {
            return Err(ConfigError::new(
                "mqtt.sign",
                true,
                "false, or `membership.key_file` set: payloads are signed by it",
            ));
        }
        if let Some(tls) = &self.tls {
            tls.validate().map_err(|error| error.within("tls"))?;
        }
        self.broker
            .validate()
            .map_err(|error| error.within("broker"))?;
        self.validate_listen()?;
        self.uplink
            .validate()
            .map_err(|error| error.within("uplink"))?;
        let needed = self.mqtt.max_packet_bytes();
        if let Some(bytes) = self.broker.max_packet_bytes
            && (bytes as usize) < needed
        {
            let allowed = format!(
                "at least {needed}, so that `mqtt.max_map_bytes` and `mqtt.max_payload_bytes` fit"
            );
            return Err(ConfigError::new("broker.max_packet_bytes", bytes, allowed));
        }
        self.fusion
            .validate()
            .map_err(|error| error.within("fusion"))?;
        self.reputations
            .validate()
            .map_err(|error| error.within("reputations"))?;
        self.dashboard
            .validate()
            .map_err(|error| error.within("dashboard"))?;
        #[cfg(feature = "camera")]
        self.validate_cameras()?;
        if let Some(record) = &self.record {
            record.validate().map_err(|error| error.within("record"))?;
        }
        if let Some(origin) = &self.origin {
            origin.validate().map_err(|error| error.within("origin"))?;
        }
        LandmarkConfig::validate_all(&self.landmarks)
    }

    /// Checks that a broker without certificates is reachable for other machines only if this is
    /// explicitly allowed.
    fn validate_listen(&self) -> Result<(), ConfigError> {
        let listen = self.broker_listen();
        let open = self.tls.is_none() && !self.broker.allow_plaintext && !listen.ip().is_loopback();
        if open && self.has_broker() {
            let allowed = "a loopback address, unless there are certificates in `[tls]` or `broker.allow_plaintext` is true";
            return Err(ConfigError::new("listen", listen, allowed));
        }
        Ok(())
    }

    /// The embedded broker's limits; its packets hold the cell's maps.
    pub fn broker(&self) -> BrokerConfig {
        let needed = u32::try_from(self.mqtt.max_packet_bytes()).ok();
        BrokerConfig {
            max_packet_bytes: self.broker.max_packet_bytes.or(needed),
            ..self.broker.clone()
        }
    }

    /// Where the embedded broker listens.
    pub fn broker_listen(&self) -> SocketAddr {
        let (ip, port) = match &self.tls {
            Some(_) => ([0, 0, 0, 0], 8883),
            None if self.broker.allow_plaintext => ([0, 0, 0, 0], 1883),
            None => ([127, 0, 0, 1], 1883),
        };
        self.listen.unwrap_or(SocketAddr::from((ip, port)))
    }

    /// The protection of links and payloads; the files that the configuration names are read.
    ///
    /// # Errors
    /// Returns a [`SecurityError`] that names the file.
    pub fn security(&self) -> Result<Security, SecurityError> {
        Security::load(
            self.tls.as_ref().zip(self.name.as_ref()),
            &self.mqtt,
            &self.membership,
            &self.cell,
        )
    }

    /// True if the node connects its cell to a region while it leads.
    pub fn has_uplink(&self) -> bool {
        self.may_lead() && self.uplink.broker.is_some()
    }

    /// True if the node may lead its cell.
    pub fn may_lead(&self) -> bool {
        self.role != Role::Cav
    }

    /// True if the node's broker may carry the cell's data.
    pub fn serves_nodes(&self) -> bool {
        self.may_lead() && self.data_plane().embedded
    }

    /// True if the node has a broker: for the cell, or only for its local programs.
    pub fn has_broker(&self) -> bool {
        self.serves_nodes() || self.broker.door
    }

    /// True if the broker takes a free port if the usual port is in use: other nodes receive its
    /// address from the membership.
    pub fn may_listen_at_any_port(&self) -> bool {
        self.listen.is_none()
    }

    /// Which brokers carry the cell's data.
    pub fn data_plane(&self) -> DataPlane {
        let external = self.mqtt.broker.clone();
        let embedded = external.is_none() || self.mqtt.fallback_to_embedded;
        DataPlane { external, embedded }
    }

    /// Landmarks of the cell, in the form that the algorithms use.
    pub fn landmarks(&self) -> Vec<Landmark> {
        self.landmarks.iter().map(Landmark::from).collect()
    }
}

/// The machine's name without its domain, limited to characters that are allowed in names of nodes.
fn host_name() -> Option<NodeName> {
    let system = rustix::system::uname();
    let host = system.nodename().to_str().ok()?.split('.').next()?;
    let allowed = |c: char| {
        if c.is_ascii_alphanumeric() || c == '_' {
            c
        } else {
            '-'
        }
    };
    NodeName::new(host.chars().map(allowed).collect::<String>()).ok()
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
    fn precedence_is_flags_file_defaults() {
        let config = load("name = \"from-file\"\nrole = \"edge\"\ncell = \"lot-9\"").unwrap();
        assert_eq!(config.name.as_ref().unwrap().as_str(), "from-flag");
        assert_eq!(config.cell.as_str(), "lot-9");
        assert_eq!(config.broker_listen().to_string(), "127.0.0.1:1883");
        let keyed = load("[membership]\nkey = \"a key for the lot\"").unwrap();
        assert_eq!(keyed.broker_listen().to_string(), "127.0.0.1:1883");
        let open = load("[broker]\nallow_plaintext = true").unwrap();
        assert_eq!(open.broker_listen().to_string(), "0.0.0.0:1883");
        let closed =
            load("[tls]\nca = \"ca.pem\"\ncertificate = \"edge.pem\"\nkey = \"edge.key\"").unwrap();
        assert_eq!(closed.broker_listen().to_string(), "0.0.0.0:8883");
    }

    #[test]
    fn errors_name_key_value_range() {
        for (toml, parts) in [
            (
                "role = \"edge\"\n[fusion.pace]\ngate_m = -1",
                ["`fusion.pace.gate_m`", "-1", "0.001 to 1000"],
            ),
            (
                "role = \"edge\"\n[fusion.pace]\ngate = 1",
                ["`fusion.pace.gate`", "unknown key", "`gate_m`"],
            ),
            (
                "role = \"edge\"\n[mqtt]\nkeep_alive_s = \"x\"",
                ["`mqtt.keep_alive_s`", "\"x\"", "u16"],
            ),
            ("role = \"king\"", ["`role`", "king", "`edge`"]),
            (
                "listen = \"0.0.0.0:1883\"",
                ["`listen`", "0.0.0.0:1883", "allow_plaintext"],
            ),
            ("[mqtt]\nsign = true", ["`mqtt.sign`", "true", "key_file"]),
            (
                "[tls]\nca = \"\"\ncertificate = \"a\"\nkey = \"b\"",
                ["`tls.ca`", "missing", "PEM"],
            ),
            (
                "role = \"edge\"\n[broker]\nmax_packet_bytes = 1048576",
                ["`broker.max_packet_bytes`", "1048576", "8392704"],
            ),
            (
                "[election]\njoin_ms = 700",
                [
                    "`membership.hello_ms`",
                    "500",
                    "half of `election.join_ms`, 700",
                ],
            ),
            (
                "[election]\nbeat_ms = 1",
                ["`election.beat_ms`", "1", "5 to"],
            ),
            (
                "role = \"edge\"\n[[landmarks]]\nid = \"a\"\nx_m = 0\ny_m = 0\n[[landmarks]]\nid = \"a\"\nx_m = 1\ny_m = 0",
                ["`landmarks[1].id`", "\"a\"", "unique"],
            ),
            ("role = ", ["TOML", "configuration", ""]),
            (
                "role = \"edge\"\n[mqtt]\nuser = \"u\"\npassword = \"***\"",
                ["`mqtt.password`", "not printed", "***"],
            ),
        ] {
            let error = load(toml).unwrap_err().to_string();
            assert!(parts.iter().all(|part| error.contains(part)), "{error}");
        }
    }

    #[cfg(feature = "camera")]
    #[test]
    fn tagged_table_errors_name_key() {
        let source = "[camera.detector]\nkind = \"placard\"\n[camera.source]\n";
        for (toml, parts) in [
            (
                "kind = \"v4l2\"\nwidth = \"wide\"\nheight = 480",
                ["`camera.source.width`", "\"wide\"", "u32"],
            ),
            (
                "kind = \"v4l2\"\nheight = 480\nwidht = 640",
                ["`camera.source.widht`", "unknown key", "`width`"],
            ),
            (
                "kind = \"url\"\nurl = 7",
                ["`camera.source.url`", "text", "quotes"],
            ),
            (
                "kind = \"testbed\"\nscenes = \"a\"",
                ["`camera.source.kind`", "testbed", "`images`"],
            ),
            (
                "kind = \"url\"",
                ["`camera.source`", "missing field", "`url`"],
            ),
            (
                "kind = \"eye\"\nwidth = 640",
                ["`camera.source.kind`", "eye", "`v4l2`"],
            ),
        ] {
            let error = load(&format!("{source}{toml}")).unwrap_err().to_string();
            assert!(parts.iter().all(|part| error.contains(part)), "{error}");
        }
    }

    #[cfg(feature = "camera")]
    #[test]
    fn latency_of_stale_reports_is_refused() {
        let detector = "detector.kind = \"placard\"\n";
        let first = format!(
            "[camera]\n{detector}source = {{ kind = \"v4l2\", latency_s = 0.35 }}\n\
             [[cameras]]\nname = \"rear\"\n{detector}source = {{ kind = \"v4l2\", latency_s = "
        );
        for (latency_s, max_age_s, is_late) in [
            ("0.9", "1.0", false),
            ("1.0", "1.0", true),
            ("1.5", "1.0", true),
            ("1.5", "2.0", false),
            ("0.3", "0.3", true),
        ] {
            let loaded = load(&format!(
                "{first}{latency_s} }}\n[fusion.window]\nmax_age_s = {max_age_s}"
            ));
            let error = loaded.err().map(|error| error.to_string());
            assert_eq!(
                error.is_some(),
                is_late,
                "{latency_s} {max_age_s} {error:?}"
            );
        }
        let error = load(&format!("{first}2 }}")).unwrap_err().to_string();
        for part in [
            "`cameras[0].source.latency_s`",
            ": 2 is",
            "below `fusion.window.max_age_s`, 1:",
            "raise that key",
        ] {
            assert!(error.contains(part), "{error}");
        }
    }

    #[test]
    fn incomplete_configuration_stops_start() {
        let written =
            format!("# Whole with `{END_OF_CONFIGURATION}`.\nname = \"n\"\n[tls]\nca = \"a\"\n");
        let cut = load(&written).unwrap_err().to_string();
        assert!(
            cut.contains("cut off") && cut.contains(END_OF_CONFIGURATION),
            "{cut}"
        );
        let whole = load(&format!(
            "# Whole with `{END_OF_CONFIGURATION}`.\ncell = \"lot-9\"\n{END_OF_CONFIGURATION}\n"
        ));
        assert_eq!(whole.unwrap().cell.as_str(), "lot-9");
        for empty in ["", "\n \n"] {
            let error = load(empty).unwrap_err().to_string();
            assert!(error.contains("is empty"), "{error}");
        }
    }

    #[test]
    fn a_missing_file_is_named() {
        let error = NodeConfig::load(
            Some(std::path::Path::new("/missing.toml")),
            &Flags { name: "x" },
        )
        .unwrap_err();
        assert!(error.to_string().contains("/missing.toml"));
    }

    #[test]
    fn printed_configuration_can_be_read() {
        let config = load("role = \"edge\"").unwrap();
        assert_eq!(load(&config.to_toml().unwrap()).unwrap(), config);
    }

    #[test]
    fn printed_configuration_omits_password() {
        let config = load("role = \"edge\"\n[mqtt]\nuser = \"u\"\npassword = \"hush\"").unwrap();
        let printed = config.to_toml().unwrap();
        assert!(
            printed.contains("# `mqtt.password` is set but not shown") && !printed.contains("hush"),
            "{printed}"
        );
        let read = load(&printed).unwrap();
        assert_eq!(
            (read.mqtt.user.as_deref(), read.mqtt.password),
            (Some("u"), None)
        );
    }

    #[test]
    fn errors_hide_cell_key() {
        for key in ["4711471147114711", "\"4711471147114711"] {
            let error = load(&format!("role = \"edge\"\n[membership]\nkey = {key}"))
                .unwrap_err()
                .to_string();
            assert!(error.contains("key") && !error.contains("4711"), "{error}");
        }
    }

    #[test]
    fn errors_hide_token_and_login() {
        for toml in [
            "[dashboard]\ntoken = 4711",
            "[dashboard]\ntoken = \"4711",
            "[camera.source]\nkind = \"url\"\nurl = [\"rtsp://u:4711@camera\"]",
            "[camera.source]\nkind = \"url\"\nurl = \"rtsp://u:4711@camera",
        ] {
            let error = load(toml).unwrap_err().to_string();
            assert!(!error.contains("4711"), "{error}");
        }
    }

    #[test]
    fn no_error_shows_a_password() {
        for password in [
            "4711",
            "hush4711",
            "\"hush4711",
            "[\"hush4711\"]",
            "{ a = \"hush4711\" }",
        ] {
            let error = load(&format!(
                "role = \"edge\"\n[mqtt]\nuser = \"u\"\npassword = {password}"
            ))
            .unwrap_err();
            let error = format!("{error} {error:?}");
            assert!(
                error.contains("password") && !error.contains("4711"),
                "{error}"
            );
        }
    }
}
