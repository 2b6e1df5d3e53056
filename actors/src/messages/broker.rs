//! Requests to the actor `Broker`, from the supervisor and from health checks.

use std::net::SocketAddr;

use ractor::RpcReplyPort;

use crate::transport::broker::{BrokerError, BrokerHealth};

/// Requests to the broker's actor.
#[derive(Debug)]
pub enum BrokerMessage {
    /// Listen on an address, with port 0 on a free port. A running broker is moved there.
    Start {
        /// The address to listen on.
        address: SocketAddr,
        /// Gets the bound address.
        reply: RpcReplyPort<Result<SocketAddr, BrokerError>>,
    },
    /// Disconnect all clients and stop listening.
    Stop {
        /// Answered once the port is free.
        reply: RpcReplyPort<()>,
    },
    /// Query the state of the broker.
    Health {
        /// Gets the state of the broker.
        reply: RpcReplyPort<BrokerHealth>,
    },
}
