//! What goes over MQTT: a node's own connections, the region's broker, and plain clients at a node's broker.

mod clients;
mod door;
mod gateway;
mod mosquitto;
mod uplink;
