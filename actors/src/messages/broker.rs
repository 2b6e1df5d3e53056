//! Messages to the actor of this name.

use std::net::SocketAddr;

use ractor::RpcReplyPort;

use crate::transport::broker::{BrokerError, BrokerHealth};

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
