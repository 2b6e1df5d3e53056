//! The tiles that somebody looks at.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use ecod::model::quadkey::Quadkey;
use ecod::model::time::Timestamp;

/// Tiles by the time until which they are looked at, and those that always are.
#[derive(Debug)]
pub(super) struct Viewers {
    watched: Vec<Quadkey>,
    until: BTreeMap<Quadkey, Timestamp>,
}

/// Time for which a view is remembered. The page asks once a second.
const VIEW_LASTS: Duration = Duration::from_secs(10);

/// Maximum number of tiles of all views; later ones are not read.
const MAX_TILES: usize = 256;

impl Viewers {
    pub(super) fn new(watched: Vec<Quadkey>) -> Self {
        Self { watched, until: BTreeMap::new() }
    }

    /// Notes that somebody looks at tiles.
    pub(super) fn look(&mut self, tiles: &[Quadkey], now: Timestamp) {
        for tile in tiles {
            if self.until.len() < MAX_TILES || self.until.contains_key(tile) {
                self.until.insert(*tile, now + VIEW_LASTS);
            }
        }
    }

    /// Forgets tiles that are too much to read.
    pub(super) fn forget(&mut self, tiles: &[Quadkey]) {
        self.until.retain(|tile, _| !tiles.contains(tile));
    }

    /// All tiles that are looked at, without those that are in another.
    pub(super) fn tiles(&mut self, now: Timestamp) -> BTreeSet<Quadkey> {
        self.until.retain(|_, until| *until > now);
        let all: BTreeSet<_> = self.watched.iter().chain(self.until.keys()).copied().collect();
        let is_in_another = |tile: &Quadkey| all.iter().any(|other| other != tile && other.contains(*tile));
        all.iter().filter(|tile| !is_in_another(tile)).copied().collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tile_is_read_while_somebody_looks_and_once_only() {
        let tile = |key: &str| key.parse::<Quadkey>().unwrap();
        let mut viewers = Viewers::new(vec![tile("0")]);
        viewers.look(&[tile("12"), tile("123"), tile("013")], Timestamp(0));
        assert_eq!(viewers.tiles(Timestamp(1)), [tile("0"), tile("12")].into());
        viewers.look(&[tile("2")], Timestamp(5_000_000));
        assert_eq!(viewers.tiles(Timestamp(11_000_000)), [tile("0"), tile("2")].into());
        assert_eq!(viewers.tiles(Timestamp(16_000_000)), [tile("0")].into());
    }
}
