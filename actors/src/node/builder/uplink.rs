//! Arguments and settings of the uplink.

use ractor::ActorProcessingErr;

use super::NodeBuilder;
use crate::actors::uplink::UplinkArguments;
use crate::messages::uplink::UplinkMessage;

impl NodeBuilder {
    pub(super) fn uplink_arguments(&self) -> Result<UplinkArguments, ActorProcessingErr> {
        let config = self.config.uplink.clone();
        let broker = config
            .broker
            .clone()
            .ok_or("no `uplink.broker` is configured")?;
        if config.ca.is_none() {
            tracing::warn!(%broker, "the uplink is in plaintext: set `uplink.ca` to have it encrypted");
        }
        Ok(UplinkArguments {
            cell: self.config.cell.clone(),
            status: self.status(),
            security: self.security.of_uplink(broker.clone(), config.ca.clone())?,
            broker,
            config,
            mqtt: self.config.mqtt.clone(),
            origin: self.config.origin,
            description: self.held.description.clone(),
            newest: self.newest.map.subscribe(),
            leadership: self.leadership(),
            fuser: self.slots.fuser.clone(),
            counters: self.counters(),
            seed: self.run.as_u64_pair().0,
        })
    }

    /// Sends the place and description of the cell to the uplink.
    pub(super) fn configure_uplink(&self) {
        let origin = self.config.origin;
        let description = self.held.description.clone();
        self.slots().uplink.send(UplinkMessage::Configure {
            origin,
            description,
        });
    }
}
