//! Reports that count: the freshest of each vehicle, their age, and the offset of its clock.

pub mod live_stream;
pub mod minimum_delay;
pub mod recent_reports;
pub mod report_window;
pub mod timeliness;
