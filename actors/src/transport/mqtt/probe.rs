//! Test login at a broker.

use uuid::Uuid;

use super::config::MqttConfig;
use super::connection::{Packet, open};
use super::{BrokerAddress, Security};
use crate::transport::pki::OBSERVER_MARK;

/// Logs in as configured, as an observer of the node of this name, and disconnects. There is no
/// last will, so the login is invisible to the cell.
///
/// # Errors
/// Returns the reason as text: the broker is not reachable or refuses.
pub async fn probe(
    address: &BrokerAddress,
    node: &str,
    config: &MqttConfig,
    security: &Security,
) -> Result<(), String> {
    let client_id = format!("{node}{OBSERVER_MARK}probe-{}", Uuid::now_v7().simple());
    let tls = security.tls(address).map_err(|error| error.to_string())?;
    let (client, mut connection) = open(
        address,
        &client_id,
        None,
        config,
        tls.map(|tls| tls.client()),
    );
    let patience = config.connect_timeout();
    loop {
        match connection.next(patience).await {
            Ok(Packet::Accepted) => break,
            Ok(_) => {}
            Err(error) => return Err(error.rejection().unwrap_or_else(|| error.to_string())),
        }
    }
    if client.disconnect() {
        while !matches!(
            connection.next(patience).await,
            Ok(Packet::Disconnected) | Err(_)
        ) {}
    }
    Ok(())
}
