//! Measures a live cell from outside: how long reports take to come back as maps and as verdicts, beside the bare
//! broker, and how many vehicles it carries.
//!
//! ```text
//! driver ── on schedule ──> vehicles ── votes, reports ─> broker ──> aggregator ── map, verdicts ─────> broker ──> vehicles
//!        └─ in between ───> vehicles ── same bytes ─────> broker ──> echo ── as many bytes, twice ───> broker ──> vehicles
//! ```
//!
//! - Open loop: when each report is due is fixed before the run, and time counts from then. What delays a report, in this
//!   process too, is part of its time, and no slow answer makes the load lighter (no coordinated omission).
//! - The bare way differs from the cell's in the aggregator alone: the same connections, packets of the same size, the
//!   same fan-in and fan-out, half a period later. Its echo answers when the packets of all vehicles are there.
//! - A vehicle votes before it reports, over one connection: where a map rests on the reports of all, their votes came
//!   before, and the verdicts of the same round count them.
//! - A vehicle reads no more of a map than its round and whose reports it rests on: a thousand vehicles in one process
//!   that decode maps would measure each other.

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
