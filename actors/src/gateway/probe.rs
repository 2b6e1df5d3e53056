//! Whether a broker takes this node, asked without being one of the cell.

use bytes::Bytes;
use ecod::names::NodeName;
use ecod::wire::{Topic, Topics};

use super::BrokerAddress;
use super::config::MqttConfig;
use super::connection::{LastWill, Packet, open};

/// Connects as the configuration says and leaves again.
///
/// # Errors
/// Why the broker is not there or refuses, in words.
pub async fn probe(address: &BrokerAddress, cell: &NodeName, config: &MqttConfig) -> Result<(), String> {
    let name = format!("probe-{}", std::process::id());
    let node = NodeName::new(&name).map_err(|error| error.to_string())?;
    // Whatever becomes of this connection, nothing is said about anybody.
    let will = LastWill { topic: Topics::new(cell).path(&Topic::Nodes(node)), payload: Bytes::new() };
    let (client, mut connection) = open(address, &name, &will, config);
    let patience = config.connect_timeout();
    loop {
        match connection.next(patience).await {
            Ok(Packet::Accepted) => break,
            Ok(_) => {}
            Err(error) => return Err(error.refusal().unwrap_or_else(|| error.to_string())),
        }
    }
    if client.disconnect() {
        while !matches!(connection.next(patience).await, Ok(Packet::Left) | Err(_)) {}
    }
    Ok(())
}
