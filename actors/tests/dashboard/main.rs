//! A node's page, metrics and health, requested over real sockets.

mod access;
mod browser;
#[cfg(feature = "camera")]
mod camera;
mod cell;
mod cost;
mod door_page;
mod health;
mod http;
mod load;
mod map;
mod metrics;
mod missing;
#[cfg(feature = "camera")]
mod mount;
mod pictures;
mod processes;
mod timeline;
mod troubles;
mod webdriver;
