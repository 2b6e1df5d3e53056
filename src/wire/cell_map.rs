//! Messages from cell to cell: a map with its place on Earth, and objects of neighbours.

use minicbor::{Decode, Encode};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::compact::{Form, Half};
use super::{FusedObject, GlobalMap};
use crate::model::names::NodeName;
use crate::model::origin::GeographicOrigin;
use crate::model::time::Timestamp;

/// A cell's map for receivers outside of the cell.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, Encode, Decode, JsonSchema)]
pub struct CellMap {
    /// Major version of the payload, [`super::SCHEMA_VERSION`].
    #[n(0)]
    pub schema: u32,
    /// The cell; equals the level of the topic.
    #[n(1)]
    pub cell: NodeName,
    /// Time of sending by the sender's own clock. Receivers derive the age of a message from the
    /// minimum transit time of this cell's messages.
    #[n(2)]
    pub sent_at_us: Timestamp,
    /// The place on Earth of the map's frame.
    #[n(3)]
    pub origin: GeographicOrigin,
    /// The map.
    #[n(4)]
    pub map: GlobalMap,
}

/// An object of a neighbouring cell.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, Encode, Decode, JsonSchema)]
pub struct NeighbourObject {
    /// The cell whose map contains the object.
    #[n(0)]
    pub cell: NodeName,
    /// Estimated time in seconds since the neighbour's map was fused.
    #[cbor(n(1), with = "Half")]
    pub age_s: f64,
    /// The object in that map, converted to this cell's frame.
    #[n(2)]
    pub object: FusedObject,
}
