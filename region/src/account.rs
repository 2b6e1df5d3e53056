//! Rights of one cell on a region's broker: it writes below its own tile and name, and reads the
//! tiles around.

use std::fmt::Write;

use ecod::model::names::NodeName;
use ecod::model::origin::GeographicOrigin;
use ecod::model::quadkey::Quadkey;
use ecod::wire::{RegionTopic, RegionTopicKind};

/// The account of a cell. All nodes of the cell that may lead share it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CellAccount {
    /// The cell, and the user's name.
    pub cell: NodeName,
    /// The tile of the cell's origin.
    pub tile: Quadkey,
}

impl CellAccount {
    /// The account of a cell.
    pub fn new(cell: NodeName, origin: &GeographicOrigin) -> Self {
        Self {
            cell,
            tile: Quadkey::of_cell(origin),
        }
    }

    /// MQTT filters of the topics that the cell may publish.
    pub fn writes(&self) -> Vec<String> {
        let Self { cell, tile } = self;
        let tile = *tile;
        let cell = cell.clone();
        let own = RegionTopicKind::ALL.map(|kind| RegionTopic {
            tile,
            cell: cell.clone(),
            kind,
        });
        own.iter().map(RegionTopic::path).collect()
    }

    /// MQTT filters of the topics that the cell may read: its own topics, and maps and descriptions
    /// of the tiles around.
    ///
    /// Statuses of other cells are excluded: they contain the runs of nodes, from which the ids of
    /// their connections could be derived.
    pub fn reads(&self) -> Vec<String> {
        let Self { cell, tile } = self;
        let kinds = [RegionTopicKind::Map, RegionTopicKind::Cell];
        let around = tile
            .with_neighbours()
            .into_iter()
            .flat_map(|tile| kinds.map(|kind| RegionTopic::filter(tile, kind)));
        [RegionTopic::filter_of_cell(*tile, cell)]
            .into_iter()
            .chain(around)
            .collect()
    }

    /// The user as an element of `users` in NATS's configuration.
    ///
    /// The password is stored there in plain text; docs/city.md explains why.
    pub fn nats(&self, password: &str) -> String {
        let list = |filters: Vec<String>| {
            let subjects: Vec<_> = filters
                .iter()
                .map(|filter| format!("\"{}\"", subject(filter)))
                .collect();
            subjects.join(", ")
        };
        let writes = list(self.writes());
        let reads = list(self.reads());
        format!(
            "{{user: \"{}\", password: \"{password}\", permissions: {{\n  publish: {{allow: [{writes}]}},\n  \
             subscribe: {{allow: [{reads}]}}}}}}\n",
            self.cell
        )
    }

    /// The user as lines of mosquitto's `acl_file`.
    pub fn mosquitto(&self) -> String {
        let mut lines = format!("user {}\n", self.cell);
        for (access, filters) in [("write", self.writes()), ("read", self.reads())] {
            for filter in filters {
                // Writing to a text does not fail.
                let _ = writeln!(lines, "topic {access} {filter}");
            }
        }
        lines
    }
}

/// The NATS subject of an MQTT filter. Names of cells and vehicles have no dots.
fn subject(filter: &str) -> String {
    let tokens = filter.split('/').map(|level| match level {
        "#" => ">",
        "+" => "*",
        level => level,
    });
    tokens.collect::<Vec<_>>().join(".")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cell_writes_below_its_tile() {
        let origin = GeographicOrigin {
            latitude_deg: 48.8584,
            longitude_deg: 2.2945,
            height_m: 0.0,
            rotation_deg: 0.0,
        };
        let account = CellAccount::new(NodeName::from_static("lot-1"), &origin);
        let own = "ecod/v1/geo/1/2/0/2/2/0/0/1/1/0/1/2/0/0/0";
        let below = ["map", "cell", "status"].map(|kind| format!("{own}/lot-1/{kind}"));
        assert_eq!(account.writes(), below);
        assert_eq!(
            account.reads().len(),
            19,
            "its own, two kinds of nine tiles"
        );
        let nats = account.nats("secret");
        assert!(
            nats.contains("\"ecod.v1.geo.1.2.0.2.2.0.0.1.1.0.1.2.0.0.0.lot-1.status\"]"),
            "{nats}"
        );
        assert!(
            account
                .mosquitto()
                .contains(&format!("topic write {own}/lot-1/map\n"))
        );
    }
}
