//! Configurations of observers: nodes that only look on.

use ecod::model::names::{InvalidName, NodeName};
use ecod::wire::Role;

use super::NodeConfig;
use crate::transport::pki::OBSERVER_MARK;

impl NodeConfig {
    /// The configuration of an observer beside the node, for some purpose: it never leads, has no camera and keeps nothing.
    ///
    /// # Errors
    /// When its name, that of the node and the purpose, would be too long.
    pub fn observing(self, purpose: &str) -> Result<Self, InvalidName> {
        let own = format!("{purpose}-{}", std::process::id());
        let holder = self.name.as_ref().filter(|_| self.tls.is_some());
        let name = holder.map_or_else(
            || own.clone(),
            |holder| format!("{holder}{OBSERVER_MARK}{own}"),
        );
        let observer = Self {
            name: Some(NodeName::new(name)?),
            role: Role::Cav,
            record: None,
            description: None,
            ..self
        };
        Ok(observer.without_own_addresses())
    }

    /// The configuration without camera, poses, state, page and door, and without the addresses that are the node's.
    pub(crate) fn without_own_addresses(mut self) -> Self {
        if let Some(bind) = &mut self.membership.bind {
            bind.set_port(0);
        }
        #[cfg(feature = "camera")]
        {
            (self.camera, self.cameras) = (None, Vec::new());
        }
        (self.membership.advertise, self.state_dir, self.map_log) = (None, None, None);
        (self.pose.listen, self.cells) = (None, None);
        self.dashboard.enabled = false;
        self.broker.door = false;
        self
    }

    /// True if the node only looks on: it neither leads nor reports, nor do programs by its door.
    pub fn looks_on(&self) -> bool {
        !self.may_lead() && !self.has_camera() && !self.broker.door
    }
}
