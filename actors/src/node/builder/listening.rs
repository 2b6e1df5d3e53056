//! Parts with an address (broker and membership), which are restarted at their former address.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use ecod::leadership::Leadership;
use ecod::leadership::round_filter::PublisherFilter;
use ecod::wire::Topics;
use ractor::{Actor, ActorCell, ActorId, ActorProcessingErr};
use tokio::sync::watch;

use super::{NodeBuilder, cause};
use crate::actors::broker::Broker;
use crate::actors::membership::Membership;
use crate::messages::broker::BrokerMessage;
use crate::messages::fuser::FuserMessage;
use crate::messages::membership::MembershipMessage;
use crate::platform::clock;
use crate::transport::broker::{AccessPolicy, BrokerError, EmbeddedBroker, LeaderCheck};
use crate::transport::gossip::BindError;

/// Number of attempts, and time between them, for a restarted broker or membership to bind its
/// former address.
const REBIND_ATTEMPTS: usize = 40;
const REBIND_WAIT: Duration = Duration::from_millis(50);

impl NodeBuilder {
    /// Restarts the broker at its former address, so that the links find it; the previous run may
    /// need a moment to release the address.
    pub(super) async fn start_broker(
        &self,
        supervisor: ActorCell,
    ) -> Result<ActorId, ActorProcessingErr> {
        let (broker, _) =
            Actor::spawn_linked(None, Broker, Box::new(self.embedded_broker()), supervisor)
                .await
                .map_err(cause)?;
        let before = *self.vehicle.listens_at.borrow();
        let mut address = before.unwrap_or(self.config.broker_listen());
        let takes_any_port = before.is_none() && self.config.may_listen_at_any_port();
        let mut attempts = if before.is_some() { REBIND_ATTEMPTS } else { 1 };
        let bound = loop {
            attempts -= 1;
            match ractor::call!(broker, |reply| BrokerMessage::Start { address, reply })? {
                Err(BrokerError::Bind { .. }) if takes_any_port && address.port() != 0 => {
                    tracing::warn!(
                        %address,
                        "another program uses this port: the broker takes a free one; set `listen` if programs or a firewall need a fixed port"
                    );
                    address.set_port(0);
                    attempts += 1;
                }
                Err(BrokerError::Bind { .. }) if attempts > 0 => {
                    tokio::time::sleep(REBIND_WAIT).await;
                }
                outcome => break outcome.map_err(|error| unusable_address(&error))?,
            }
        };
        self.vehicle.listens_at.send_replace(Some(bound));
        if self.config.serves_nodes() {
            self.broker_address.send_replace(Some(bound));
        }
        let id = broker.get_id();
        self.slots.broker.set(broker);
        Ok(id)
    }

    /// The broker with its connection gate. The gate is also used if only this machine can reach
    /// the broker, because silent connections would hold the node's file descriptors.
    fn embedded_broker(&self) -> EmbeddedBroker {
        let config = self.config.broker();
        let listen = self.config.broker_listen();
        let credentials = self.security.credentials.clone();
        match (&credentials, listen.ip().is_loopback()) {
            _ if !self.config.serves_nodes() => {
                tracing::info!(%listen, "broker for programs of this node");
            }
            (None, true) if self.config.data_plane().external.is_some() => tracing::warn!(
                "mqtt.fallback_to_embedded serves this machine only: without certificates in [tls] or \
                 broker.allow_plaintext other machines are without maps when the external broker is gone"
            ),
            (None, true) => {
                tracing::info!("broker for this machine only: no certificates are configured");
            }
            (None, false) => {
                tracing::warn!(%listen, "broker for every client: no certificates are configured");
            }
            (Some(_), _) => {
                tracing::info!(%listen, "broker for clients with a certificate of the cell");
            }
        }
        let topics = Topics::new(&self.config.cell);
        let elected = publish_rule(self.leadership());
        let limits = self.config.mqtt.limits();
        let counters = self.counters();
        let policy = AccessPolicy {
            credentials,
            topics,
            limits,
            elected,
            counters,
        };
        let fuser = self.slots.fuser.clone();
        EmbeddedBroker::protected(config, policy)
            .with_door(self.door.clone())
            .with_expulsions(Arc::new(move |node| {
                tracing::warn!(%node, "client's certificate not trusted any more");
                fuser.send(FuserMessage::Expel { node });
            }))
    }

    /// Restarts the membership at its former address, like the broker.
    pub(super) async fn start_membership(
        &self,
        supervisor: ActorCell,
    ) -> Result<ActorId, ActorProcessingErr> {
        let mut attempts = if self.gossip_address.borrow().is_some() {
            REBIND_ATTEMPTS
        } else {
            1
        };
        let actor = loop {
            attempts -= 1;
            let arguments = self.membership_arguments();
            match Actor::spawn_linked(None, Membership, arguments, supervisor.clone())
                .await
                .map_err(cause)
            {
                Ok((actor, _)) => break actor,
                Err(error) if attempts > 0 && error.is::<BindError>() => {
                    tokio::time::sleep(REBIND_WAIT).await;
                }
                Err(error) => return Err(error),
            }
        };
        let address = ractor::call!(actor, |reply| MembershipMessage::Address { reply })?;
        self.gossip_address.send_replace(Some(address));
        let id = actor.get_id();
        self.slots.membership.set(actor);
        Ok(id)
    }
}

/// The error of a broker that cannot listen at the configured address, with the remedy.
fn unusable_address(error: &BrokerError) -> String {
    let remedy = match error {
        BrokerError::Bind { .. } => ": set another address, or stop the program that uses this one",
        _ => "",
    };
    format!("key `listen`: {error}{remedy}")
}

/// The rule of the node's own broker: which nodes may publish for the whole cell.
fn publish_rule(leadership: watch::Receiver<Leadership>) -> LeaderCheck {
    let filter = Mutex::<PublisherFilter>::default();
    Arc::new(move |name| {
        let mut filter = filter.lock().unwrap_or_else(PoisonError::into_inner);
        filter.may_publish(name, &leadership.borrow(), clock::now())
    })
}
