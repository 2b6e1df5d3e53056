//! Admission of reports: selects the freshest report of each vehicle, and determines its age and
//! the offset of the vehicle's clock.

pub mod live_stream;
pub mod minimum_delay;
pub mod recent_reports;
pub mod report_window;
pub mod timeliness;
