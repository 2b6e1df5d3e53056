//! Messages to the actor of this name.

/// What the dashboard's actor is asked to do.
#[derive(Debug)]
pub enum DashboardMessage {
    /// See whether the server still runs; sent by the dashboard to itself.
    CheckServer,
}
