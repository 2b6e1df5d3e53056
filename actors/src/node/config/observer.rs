//! Configurations of observers: nodes that only receive.

use ecod::model::names::{InvalidName, NodeName};
use ecod::wire::Role;

use super::NodeConfig;
use crate::transport::pki::OBSERVER_MARK;

impl NodeConfig {
    /// The configuration of an observer that runs in addition to the node, for some purpose: it
    /// cannot lead, has no camera and keeps no state. Its name is below the name of the node, so that
    /// other nodes do not count it as a node.
    ///
    /// # Errors
    /// Returns an error if its name, made of the node's name and the purpose, would be too long.
    pub fn observing(self, purpose: &str) -> Result<Self, InvalidName> {
        let holder = self.name.clone().unwrap_or(NodeName::from_static("node"));
        let process = std::process::id();
        let name = NodeName::new(format!("{holder}{OBSERVER_MARK}{purpose}-{process}"))?;
        let observer = Self {
            name: Some(name),
            role: Role::Cav,
            description: None,
            ..self
        };
        Ok(observer.without_own_addresses())
    }

    /// The configuration without camera, poses, state, page and local broker, and without the
    /// node's own addresses.
    pub(crate) fn without_own_addresses(mut self) -> Self {
        if let Some(bind) = &mut self.membership.bind {
            bind.set_port(0);
        }
        #[cfg(feature = "camera")]
        {
            self.camera = None;
            self.cameras = Vec::new();
        }
        self.membership.advertise = None;
        self.state_dir = None;
        self.map_log = None;
        self.pose.listen = None;
        self.cells = None;
        self.dashboard.enabled = false;
        self.broker.door = false;
        self
    }

    /// True if the node only observes: it does not lead or report, and does not accept reports of
    /// local programs.
    pub fn only_observes(&self) -> bool {
        !self.may_lead() && !self.has_camera() && !self.broker.door
    }
}
