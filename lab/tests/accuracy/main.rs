//! What the laboratory measures, and the accuracy that it finds.

mod camera_cell;
mod eval_tracks;
mod ground_ranging;
mod town;
mod tracked_traffic;
mod two_hop;
