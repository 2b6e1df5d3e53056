//! The tiles whose maps are read.

use std::collections::BTreeMap;

use ecod::model::quadkey::Quadkey;
use ecod::model::time::Timestamp;

/// Tiles whose maps are read, by the time since which they are.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct ReadTiles(BTreeMap<Quadkey, Timestamp>);

impl ReadTiles {
    /// One tile that is read since `since`.
    pub fn one(tile: Quadkey, since: Timestamp) -> Self {
        Self([(tile, since)].into())
    }

    /// Time since which the maps of a tile are read; `None` if they are not.
    pub fn since(&self, tile: Quadkey) -> Option<Timestamp> {
        let outer = (0..=tile.digits()).filter_map(|digits| self.0.get(&tile.outer(digits)));
        outer.min().copied()
    }

    /// From `now` on reads exactly these tiles. Tiles that are already read keep their time.
    pub fn replace(&mut self, tiles: impl Iterator<Item = Quadkey>, now: Timestamp) {
        self.0 = tiles
            .map(|tile| (tile, self.since(tile).unwrap_or(now)))
            .collect();
    }

    /// Stops reading all tiles.
    pub fn clear(&mut self) {
        self.0.clear();
    }

    /// Number of tiles that are read.
    pub fn count(&self) -> usize {
        self.0.len()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn child_tile_inherits_read_time() {
        let tile = |key: &str| key.parse::<Quadkey>().unwrap();
        let mut read = ReadTiles::default();
        read.replace([tile("12"), tile("3")].into_iter(), Timestamp(5));
        read.replace([tile("120"), tile("2")].into_iter(), Timestamp(9));
        let since =
            ["120", "1203", "121", "2", "3"].map(|key| read.since(tile(key)).map(|since| since.0));
        assert_eq!(since, [Some(5), Some(5), None, Some(9), None]);
    }
}
