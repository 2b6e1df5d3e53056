//! Leadership: the election of the cell's leader, and the acceptance of its rounds.
//!
//! | step | machine |
//! |---|---|
//! | nodes elect a leader and hand leadership over | [`election::Election`] |
//! | a node is fit to lead while its parts work | [`health::HealthMonitor`], [`echo::EchoMonitor`] |
//! | a node keeps links to the brokers of leader and standby | [`links::Links`] |
//! | the steps above combined into one machine of inputs and effects | [`node::LeadershipNode`] |
//! | receivers accept or refuse each round | [`round_filter::RoundFilter`], [`round_filter::PublisherFilter`] |
//! | nodes agree on the cell's time | [`cell_time::CellTime`] |
//! | candidates replicate the evidence about vehicles | [`ledger_resync::LedgerResync`] |
//!
//! The machines share one value, [`Leadership`]: [`node::LeadershipNode`] writes it and all other
//! machines read it. [`timers`] lists every timer and how it relates to the others.

pub mod address;
pub mod cell_time;
pub mod config;
pub mod echo;
pub mod election;
pub mod health;
pub mod ledger_resync;
pub mod links;
mod logins;
pub mod node;
pub mod readiness;
pub mod rights;
pub mod round_filter;
pub mod timers;
pub mod view;

pub use address::{BrokerAddress, InvalidAddress};
pub use rights::Rights;
pub use view::{Leadership, Position};
