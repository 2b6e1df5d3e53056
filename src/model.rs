//! The vocabulary of a cell: names, time, geometry, epochs, detections. Depends only on `config`.

pub mod detection;
pub mod epoch;
pub mod geometry;
pub mod names;
pub mod origin;
pub mod quadkey;
pub mod time;
