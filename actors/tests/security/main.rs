//! Attacks on a cell; each test asserts that honest traffic continues.

mod brokers;
mod certificates;
mod claims;
mod descriptions;
mod evidence;
mod expiring_leader;
mod false_rounds;
mod fixture;
mod floods;
mod frames;
mod hung;
mod identity;
mod logins;
mod nodes;
mod packets;
mod payloads;
mod renewal;
mod resources;
mod revoked_client;
mod shares;
mod stolen_leader;
mod topics;
mod websocket;
