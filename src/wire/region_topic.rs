//! The topics of a region, on which cells publish by their place on Earth.

use crate::model::names::NodeName;
use crate::model::quadkey::{CELL_TILE_DIGITS, Quadkey};

/// First levels of every topic of a region's cells.
const ROOT: &str = "ecod/v1/geo";

/// A topic of a cell in its region, such as `ecod/v1/geo/1/2/0/…/0/lot-1/map`.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct RegionTopic {
    /// The tile of the cell's origin.
    pub tile: Quadkey,
    /// Name of the cell that publishes on the topic.
    pub cell: NodeName,
    /// Kind of the messages on the topic.
    pub kind: RegionTopicKind,
}

/// Content of a cell's topic in its region.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum RegionTopicKind {
    /// [`CellMap`](super::CellMap): the cell's map.
    Map,
    /// [`CellDescription`](super::CellDescription), retained.
    Cell,
    /// [`NodeStatus`](super::NodeStatus) of the cell's leader, retained.
    Status,
}

impl RegionTopicKind {
    /// All kinds in order of declaration.
    pub const ALL: [Self; 3] = [Self::Map, Self::Cell, Self::Status];

    /// The last level of the topic.
    pub fn level(self) -> &'static str {
        match self {
            Self::Map => "map",
            Self::Cell => "cell",
            Self::Status => "status",
        }
    }
}

impl RegionTopic {
    /// The topic with all its levels, as published over MQTT.
    pub fn path(&self) -> String {
        let Self { tile, cell, kind } = self;
        format!("{ROOT}/{}/{cell}/{}", tile.levels(), kind.level())
    }

    /// The filter for one kind of topic of all cells of a tile of a cell's size.
    pub fn filter(tile: Quadkey, kind: RegionTopicKind) -> String {
        format!("{ROOT}/{}/+/{}", tile.levels(), kind.level())
    }

    /// The filter for all topics of one cell.
    pub fn filter_of_cell(tile: Quadkey, cell: &NodeName) -> String {
        format!("{ROOT}/{}/{cell}/#", tile.levels())
    }

    /// The filter for one kind of topic of all cells everywhere.
    pub fn filter_everywhere(kind: RegionTopicKind) -> String {
        let tile = ["+"; CELL_TILE_DIGITS as usize].join("/");
        format!("{ROOT}/{tile}/+/{}", kind.level())
    }

    /// The filter for all topics within a tile of any size; an empty tile is the whole Earth.
    pub fn filter_within(tile: Quadkey) -> String {
        match tile.digits() {
            0 => format!("{ROOT}/#"),
            _ => format!("{ROOT}/{}/#", tile.levels()),
        }
    }

    /// Content of a full topic; `None` for other topics.
    pub fn parse(path: &str) -> Option<Self> {
        let rest = path.strip_prefix(ROOT)?.strip_prefix('/')?;
        let (rest, kind) = rest.rsplit_once('/')?;
        let (levels, cell) = rest.rsplit_once('/')?;
        let kind = RegionTopicKind::ALL
            .into_iter()
            .find(|known| known.level() == kind)?;
        if levels.split('/').any(|level| level.len() != 1) {
            return None;
        }
        let tile = levels.replace('/', "").parse().ok()?;
        Some(Self {
            tile,
            cell: NodeName::new(cell).ok()?,
            kind,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn topics_round_trip_and_others_fail() {
        let tile: Quadkey = "120220011012000".parse().unwrap();
        for kind in RegionTopicKind::ALL {
            let topic = RegionTopic {
                tile,
                cell: NodeName::from_static("lot-1"),
                kind,
            };
            assert_eq!(RegionTopic::parse(&topic.path()), Some(topic));
        }
        assert_eq!(
            RegionTopic::filter(tile, RegionTopicKind::Map),
            "ecod/v1/geo/1/2/0/2/2/0/0/1/1/0/1/2/0/0/0/+/map"
        );
        assert_eq!(
            RegionTopic::filter_within("12".parse().unwrap()),
            "ecod/v1/geo/1/2/#"
        );
        assert_eq!(
            RegionTopic::filter_within("".parse().unwrap()),
            "ecod/v1/geo/#"
        );
        for stranger in [
            "ecod/v1/geo/1/2/lot-1/maps",
            "ecod/v1/geo/12/lot-1/map",
            "ecod/v1/geo/4/a/map",
            "ecod/v1/geo/map",
        ] {
            assert_eq!(RegionTopic::parse(stranger), None, "{stranger}");
        }
    }
}
