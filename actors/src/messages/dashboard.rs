//! Messages to the dashboard.

/// Requests to the dashboard.
#[derive(Debug)]
pub enum DashboardMessage {
    /// Check that the server runs; sent by the dashboard to itself.
    CheckServer,
}
