//! A joint view of many cells: reads the messages of cells on their region's broker.
//!
//! Rooms by floor, the top first; imports run downward only:
//!
//! ```text
//! cli       the program
//! page      page, API and metrics over HTTP     export  GeoJSON, MCAP
//! reader    the connection to the broker
//! town      latest messages of each cell; selection for a view
//! broker    address and login                   account rights of a cell
//! ```

#![deny(clippy::unwrap_used, clippy::expect_used, clippy::panic)]
#![cfg_attr(not(test), deny(clippy::string_slice))]

pub mod account;
pub mod broker;
pub mod cli;
pub mod export;
pub mod page;
pub mod reader;
pub mod town;
