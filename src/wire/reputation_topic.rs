//! The topics on which the cells of a region exchange counts about vehicles.

use crate::model::names::NodeName;

/// First levels of the topics.
const ROOT: &str = "ecod/v1/rep";

/// The topic of a cell's evidence about a vehicle, such as `ecod/v1/rep/euclid/lot-1`.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct ReputationTopic {
    /// The vehicle.
    pub vehicle: NodeName,
    /// The cell that counted.
    pub cell: NodeName,
}

impl ReputationTopic {
    /// The full topic.
    pub fn path(&self) -> String {
        format!("{ROOT}/{}/{}", self.vehicle, self.cell)
    }

    /// The filter for all cells' counts about one vehicle.
    pub fn filter_of_vehicle(vehicle: &NodeName) -> String {
        format!("{ROOT}/{vehicle}/+")
    }

    /// The filter for one cell's counts about all vehicles.
    pub fn filter_of_cell(cell: &NodeName) -> String {
        format!("{ROOT}/+/{cell}")
    }

    /// The filter for all cells' counts about all vehicles.
    pub fn filter_everywhere() -> String {
        format!("{ROOT}/+/+")
    }

    /// Content of a full topic; `None` for other topics.
    pub fn parse(path: &str) -> Option<Self> {
        let (vehicle, cell) = path
            .strip_prefix(ROOT)?
            .strip_prefix('/')?
            .split_once('/')?;
        Some(Self {
            vehicle: NodeName::new(vehicle).ok()?,
            cell: NodeName::new(cell).ok()?,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn topics_round_trip_and_strangers_are_none() {
        let topic = ReputationTopic {
            vehicle: NodeName::from_static("euclid"),
            cell: NodeName::from_static("lot-1"),
        };
        assert_eq!(topic.path(), "ecod/v1/rep/euclid/lot-1");
        assert_eq!(ReputationTopic::parse(&topic.path()), Some(topic));
        for stranger in [
            "ecod/v1/rep/euclid",
            "ecod/v1/rep/euclid/lot-1/map",
            "ecod/v1/rep//lot-1",
            "ecod/v1/reputation",
        ] {
            assert_eq!(ReputationTopic::parse(stranger), None, "{stranger}");
        }
    }
}
