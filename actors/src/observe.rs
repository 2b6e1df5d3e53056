//! The views of a node for people and programs: page, metrics, health, logs, reports.

pub mod dashboard;
pub mod http;
pub mod readiness;
pub mod recorder;
pub mod report;
