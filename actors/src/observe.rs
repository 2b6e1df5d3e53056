//! What people and programs see of a node: page, metrics, health, logs, reports.

pub mod dashboard;
pub mod http;
pub mod readiness;
pub mod recorder;
pub mod report;
