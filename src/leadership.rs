//! Who leads the cell, and whose rounds are taken.
pub mod election;
