//! The actor that owns the embedded MQTT broker.
//!
//! ```text
//! Node
//! └─ Broker            Start, Stop, Health
//!    └─ EmbeddedBroker  a thread of its own; clients see only its socket
//! ```
//!
//! A failed start is an answer to the caller, not a failure of the actor: the node decides what to
//! do. A broker that has ended by itself, or hangs, ends the actor at the next query of its state,
//! so that the node restarts both. A broker that hangs keeps its port. The node then ends, because
//! only a new process can bind the port again.

#![deny(clippy::indexing_slicing)]

use ractor::{Actor, ActorProcessingErr, ActorRef, RpcReplyPort};

use crate::messages::broker::BrokerMessage;
use crate::transport::broker::{BrokerHealth, MqttBroker};

/// Owns the embedded broker; stops it when the actor ends, however it ends.
#[derive(Debug, Default)]
pub struct Broker;

impl Actor for Broker {
    type Msg = BrokerMessage;
    type State = Box<dyn MqttBroker>;
    type Arguments = Box<dyn MqttBroker>;

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
        tracing::debug!("caller did not wait for the broker's answer");
    }
}

#[cfg(test)]
mod tests {
    use std::net::SocketAddr;

    use super::*;
    use crate::transport::broker::BrokerError;

    #[derive(Debug)]
    struct DeadBroker;

    impl MqttBroker for DeadBroker {
        fn start(&mut self, address: SocketAddr) -> Result<SocketAddr, BrokerError> {
            Ok(address)
        }

        fn stop(&mut self) {}

        fn health(&self) -> BrokerHealth {
            BrokerHealth::Dead
        }
    }

    #[tokio::test]
    async fn dead_broker_ends_its_actor() {
        let (actor, ended) =
            Actor::spawn(None, Broker, Box::new(DeadBroker) as Box<dyn MqttBroker>)
                .await
                .unwrap();
        let health = ractor::call!(actor, |reply| BrokerMessage::Health { reply }).unwrap();
        assert_eq!(health, BrokerHealth::Dead);
        ended.await.unwrap();
    }
}
