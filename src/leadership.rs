//! Leadership: who leads the cell, and whose rounds a node accepts.

pub mod address;
pub mod echo;
pub mod election;
pub mod health;
pub mod ledger_resync;
pub mod links;
pub mod node;
pub mod readiness;
pub mod round_filter;
pub mod timers;
pub mod view;

pub use address::{BrokerAddress, InvalidAddress};
pub use view::{Leadership, Position};
