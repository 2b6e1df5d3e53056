#![doc = include_str!("../README.md")]

mod cell;
mod connection;
mod error;
mod streams;
mod tls;

pub use cell::{BoxFrame, Cell, Frame, Messages, Settings, now};
pub use ecod;
pub use ecod::model::geometry::Pose;
pub use ecod::model::names::{Label, LandmarkId, NodeName};
pub use ecod::model::origin::{GeographicOrigin, GeographicPose, GeographicPosition, PoseError};
pub use ecod::model::time::Timestamp;
pub use ecod::perception::camera::Mount;
pub use ecod::wire::{
    BoxCamera, CellDescription, FieldOfView, FusedObject, GlobalMap, LabelReading, LandmarkState,
    NodeState, NodeStatus, ObjectReport, PerceivedObject, PixelBox, Reputation, Reputations, Role,
    Trouble, Verdict, Verdicts, WirePose,
};
pub use error::Error;
pub use streams::CpmMessage;
pub use tls::Tls;
