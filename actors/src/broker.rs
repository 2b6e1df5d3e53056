//! The actor that owns the embedded MQTT broker.
//!
//! ```text
//! Node
//! └─ Broker            Start, Stop, Health
//!    └─ EmbeddedBroker  a thread of its own; clients see only its socket
//! ```
//!
//! A broker that cannot start is an answer to whoever asked, not a failure of the actor: the node decides whether
//! another address, an external broker or giving up is right. One that ended by itself, or hangs, ends the actor as
//! soon as anyone asks how it is, so that the node starts both anew. One that hangs keeps its port, so that the node
//! then ends: only a new process is rid of it.

#![deny(clippy::indexing_slicing)]

mod admission;
mod embedded;
mod gate;
mod holder;
mod login;
mod permissions;
mod pulse;
mod retained;
mod throttle;

use std::net::SocketAddr;

use ractor::{Actor, ActorProcessingErr, ActorRef, RpcReplyPort};

pub use embedded::{BrokerConfig, BrokerError, EmbeddedBroker, Mqtt};
pub use gate::Guard;
#[cfg(fuzzing)]
pub use login::read_login;
pub use permissions::Elected;

/// What the broker's actor is asked to do.
#[derive(Debug)]
pub enum BrokerMessage {
    /// Listen on an address, port 0 for a free one; the answer is the bound address. A running broker is moved there.
    Start {
        /// Where to listen.
        address: SocketAddr,
        /// Gets the bound address.
        reply: RpcReplyPort<Result<SocketAddr, BrokerError>>,
    },
    /// Disconnect all clients and stop listening; the answer says that the port is free.
    Stop {
        /// Answered when done.
        reply: RpcReplyPort<()>,
    },
    /// Tell whether the broker serves.
    Health {
        /// Gets the state.
        reply: RpcReplyPort<BrokerHealth>,
    },
}

/// Whether the broker serves.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BrokerHealth {
    /// Not started, or stopped.
    Stopped,
    /// Accepts clients at this address.
    Serving(SocketAddr),
    /// Was started, but has ended by itself or hangs; a node without its broker must not lead. The actor ends with this
    /// answer.
    Dead,
}

/// Owns the embedded broker; stops it when the actor ends, however it ends.
#[derive(Debug, Default)]
pub struct Broker;

impl Actor for Broker {
    type Msg = BrokerMessage;
    type State = Box<dyn Mqtt>;
    type Arguments = Box<dyn Mqtt>;

    async fn pre_start(
        &self,
        _myself: ActorRef<Self::Msg>,
        broker: Self::Arguments,
    ) -> Result<Self::State, ActorProcessingErr> {
        Ok(broker)
    }

    async fn handle(
        &self,
        _myself: ActorRef<Self::Msg>,
        message: Self::Msg,
        broker: &mut Self::State,
    ) -> Result<(), ActorProcessingErr> {
        match message {
            BrokerMessage::Start { address, reply } => {
                broker.stop();
                let started = broker.start(address);
                match &started {
                    Ok(bound) => tracing::info!(address = %bound, "broker serves"),
                    Err(error) => tracing::warn!(%error, "broker did not start"),
                }
                answer(reply, started);
            }
            BrokerMessage::Stop { reply } => {
                broker.stop();
                answer(reply, ());
            }
            BrokerMessage::Health { reply } => {
                let health = broker.health();
                answer(reply, health);
                if health == BrokerHealth::Dead {
                    return Err("broker ended by itself or hangs".into());
                }
            }
        }
        Ok(())
    }

    async fn post_stop(
        &self,
        _myself: ActorRef<Self::Msg>,
        broker: &mut Self::State,
    ) -> Result<(), ActorProcessingErr> {
        broker.stop();
        Ok(())
    }
}

fn answer<T: Send + 'static>(reply: RpcReplyPort<T>, value: T) {
    if reply.send(value).is_err() {
        tracing::debug!("nobody waited for the broker's answer");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug)]
    struct Fallen;

    impl Mqtt for Fallen {
        fn start(&mut self, address: SocketAddr) -> Result<SocketAddr, BrokerError> {
            Ok(address)
        }

        fn stop(&mut self) {}

        fn health(&self) -> BrokerHealth {
            BrokerHealth::Dead
        }
    }

    #[tokio::test]
    async fn a_broker_that_ended_by_itself_ends_its_actor_so_that_it_is_started_anew() {
        let (actor, ended) = Actor::spawn(None, Broker, Box::new(Fallen) as Box<dyn Mqtt>).await.unwrap();
        let health = ractor::call!(actor, |reply| BrokerMessage::Health { reply }).unwrap();
        assert_eq!(health, BrokerHealth::Dead);
        ended.await.unwrap();
    }
}
