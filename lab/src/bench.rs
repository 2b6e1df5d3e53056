//! Measures a live cell from outside: how long reports take to come back as maps and as verdicts,
//! compared to the bare broker, and how many vehicles the cell can serve.
//!
//! ```text
//! driver ── on schedule ──> vehicles ── votes, reports ─> broker ──> aggregator ── map, verdicts ─────> broker ──> vehicles
//!        └─ in between ───> vehicles ── same bytes ─────> broker ──> echo ── as many bytes, twice ───> broker ──> vehicles
//! ```
//!
//! - Open loop: the due time of each report is fixed before the run, and latency is measured from
//!   that time. All delays of a report, including those in this process, are part of its latency,
//!   and slow answers do not reduce the load (no coordinated omission).
//! - The bare path differs from the cell's path only in the aggregator: it has the same
//!   connections, packet sizes, fan-in and fan-out, half a period later. Its echo answers when the
//!   packets of all vehicles have arrived.
//! - A vehicle votes before it reports, over one connection: when a map includes the reports of all
//!   vehicles, their votes arrived before, and the verdicts of the same round count them.
//! - A vehicle only reads the round of a map and the reports that it includes: a thousand vehicles
//!   in one process that decoded whole maps would measure each other.

pub mod access;
pub mod aggregator;
pub mod doors;
mod driver;
mod echo;
pub mod latency;
pub mod load;
pub mod measurement;
pub mod page;
pub mod saturation;
mod schedule;
pub mod target;
pub mod two_hop;
pub mod usage;
mod vehicle;
