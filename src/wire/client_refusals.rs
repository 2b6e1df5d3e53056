//! Refusals that a node's broker shows to its local programs.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::model::names::NodeName;

/// Messages of programs that a node's broker refused. Retained on `nodes/<node>/clients`, only at
/// that broker.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct ClientRefusals {
    /// Major version of the payload, [`SCHEMA_VERSION`](crate::wire::SCHEMA_VERSION).
    pub schema: u32,
    /// The node of the broker.
    pub node: NodeName,
    /// One entry for each client and reason, the first ones since the broker's start.
    pub refused: Vec<ClientRefusal>,
}

/// Refused messages of one client, for one reason.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct ClientRefusal {
    /// The client's MQTT identifier.
    pub client: String,
    /// The reason under which refusals are counted, such as `not_permitted`.
    pub reason: String,
    /// Topic of the last message.
    pub topic: String,
    /// Fault and remedy of the last message, for people.
    pub text: String,
    /// Number of messages.
    pub times: u64,
}
