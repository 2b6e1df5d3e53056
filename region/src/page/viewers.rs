//! Views of the town: the tiles that viewers show, and whose maps are read.
//!
//! Addresses share views and cells evenly. A new view may replace a view of an address that has
//! more views, and the small views of each address are read first.

use std::collections::{BTreeMap, BTreeSet};
use std::net::IpAddr;
use std::time::Duration;

use ecod::model::quadkey::Quadkey;
use ecod::model::time::Timestamp;

/// Current views, and tiles that are always read.
#[derive(Debug)]
pub(super) struct Viewers {
    watched: Vec<Quadkey>,
    views: BTreeMap<ViewerId, TownWindow>,
}

/// A page or a program that shows the town.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct ViewerId {
    /// Its host's address, as hosts are counted.
    pub(super) host: IpAddr,
    /// Its own name among the viewers of the host.
    pub(super) name: String,
}

/// The view of one viewer.
#[derive(Debug)]
struct TownWindow {
    tiles: Vec<Quadkey>,
    /// Number of cells in the tiles, if counted since the last request.
    cells: Option<usize>,
    viewed_at: Timestamp,
}

/// The reason why the maps of a view are not read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum MapsWithheld {
    /// It has more than [`MAX_CELLS_OF_VIEW`] cells.
    LargeView,
    /// Other views take up all that is read.
    ManyCells,
    /// As many views as possible are read, and no host has more of them than this one.
    ManyViews,
}

/// Time for which a view is kept. The page requests it once a second.
const VIEW_LASTS: Duration = Duration::from_secs(10);

/// Time after which a view is idle: it is the first to make room.
const IDLE_AFTER: Duration = Duration::from_secs(3);

/// Maximum number of views.
const MAX_VIEWS: usize = 64;

/// Number of cells in a view above which their maps are not read: at 2 Hz and 2 kB, 8 MB/s.
const MAX_CELLS_OF_VIEW: usize = 2000;

/// Number of cells in all views whose maps are read.
const MAX_CELLS: usize = 10_000;

impl MapsWithheld {
    /// The reason as text for a person.
    pub(super) fn in_words(self) -> String {
        match self {
            Self::LargeView => format!("zoom in: over {MAX_CELLS_OF_VIEW} cells in view"),
            Self::ManyCells => format!("zoom in: others read {MAX_CELLS} cells"),
            Self::ManyViews => format!("close a view: {MAX_VIEWS} are open"),
        }
    }
}

impl Viewers {
    pub(super) fn new(watched: Vec<Quadkey>) -> Self {
        Self {
            watched,
            views: BTreeMap::new(),
        }
    }

    /// Sets the tiles of a viewer.
    ///
    /// # Errors
    /// Returns [`MapsWithheld::ManyViews`]; the state is then unchanged.
    pub(super) fn set_view(
        &mut self,
        viewer: ViewerId,
        tiles: Vec<Quadkey>,
        now: Timestamp,
    ) -> Result<(), MapsWithheld> {
        if !self.views.contains_key(&viewer) && self.views.len() >= MAX_VIEWS {
            let replaced = self
                .replaced_by(&viewer, now)
                .ok_or(MapsWithheld::ManyViews)?;
            self.views.remove(&replaced);
        }
        self.views.insert(
            viewer,
            TownWindow {
                tiles,
                cells: None,
                viewed_at: now,
            },
        );
        Ok(())
    }

    /// The view that makes room for a new one: the oldest idle one, or the oldest of the host with
    /// the most.
    fn replaced_by(&self, viewer: &ViewerId, now: Timestamp) -> Option<ViewerId> {
        let oldest = self.views.iter().min_by_key(|(_, view)| view.viewed_at)?;
        if now.since(oldest.1.viewed_at) >= IDLE_AFTER {
            return Some(oldest.0.clone());
        }
        let mut by_host = BTreeMap::<IpAddr, usize>::new();
        self.views
            .keys()
            .for_each(|id| *by_host.entry(id.host).or_default() += 1);
        let own = by_host.get(&viewer.host).copied().unwrap_or(0);
        let (host, most) = by_host.into_iter().max_by_key(|(_, views)| *views)?;
        let of_host = self
            .views
            .iter()
            .filter(|(id, _)| id.host == host && most > own + 1);
        of_host
            .min_by_key(|(_, view)| view.viewed_at)
            .map(|(id, _)| id.clone())
    }

    /// All tiles whose maps are to be read, without tiles that are inside another one, and the
    /// viewers whose maps are not read; `count` returns the number of cells in tiles.
    pub(super) fn tiles(
        &mut self,
        count: impl Fn(&[Quadkey]) -> usize,
        now: Timestamp,
    ) -> (BTreeSet<Quadkey>, BTreeMap<ViewerId, MapsWithheld>) {
        self.views
            .retain(|_, view| now.since(view.viewed_at) < VIEW_LASTS);
        for view in self.views.values_mut() {
            view.cells.get_or_insert_with(|| count(&view.tiles));
        }
        let mut by_host = BTreeMap::<IpAddr, Vec<_>>::new();
        self.views
            .iter()
            .for_each(|(id, view)| by_host.entry(id.host).or_default().push((id, view)));
        let mut in_turn = Vec::new();
        for views in by_host.values_mut() {
            views.sort_by_key(|(_, view)| view.cells);
            let of_host = views.iter().enumerate();
            in_turn.extend(
                of_host
                    .map(|(turn, (id, view))| (turn, view.cells.unwrap_or_default(), *id, *view)),
            );
        }
        in_turn.sort_by_key(|(turn, cells, id, _)| (*turn, *cells, *id));
        let mut read = self.watched.iter().copied().collect::<BTreeSet<_>>();
        let mut withheld = BTreeMap::new();
        let mut cells = 0;
        for (_, cells_of_view, id, view) in in_turn {
            let more: Vec<_> = view
                .tiles
                .iter()
                .copied()
                .filter(|tile| !is_within(*tile, &read))
                .collect();
            let more_cells = match more.len() {
                0 => 0,
                all if all == view.tiles.len() => cells_of_view,
                _ => count(&more),
            };
            if cells_of_view > MAX_CELLS_OF_VIEW {
                withheld.insert(id.clone(), MapsWithheld::LargeView);
            } else if cells + more_cells > MAX_CELLS {
                withheld.insert(id.clone(), MapsWithheld::ManyCells);
            } else {
                cells += more_cells;
                read.extend(more);
            }
        }
        let outer = read
            .iter()
            .filter(|tile| tile.digits() == 0 || !is_within(tile.outer(tile.digits() - 1), &read));
        (outer.copied().collect(), withheld)
    }
}

/// True if the set contains a tile, or a larger tile around it.
fn is_within(tile: Quadkey, tiles: &BTreeSet<Quadkey>) -> bool {
    (0..=tile.digits()).any(|digits| tiles.contains(&tile.outer(digits)))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tile(key: &str) -> Quadkey {
        key.parse().unwrap()
    }

    fn viewer(host: u8, name: usize) -> ViewerId {
        ViewerId {
            host: [10, 0, 0, host].into(),
            name: name.to_string(),
        }
    }

    /// The tile of four digits with this number.
    fn numbered(number: usize) -> Quadkey {
        tile(
            &[6, 4, 2, 0]
                .map(|bit| char::from(b'0' + (number >> bit & 3) as u8))
                .iter()
                .collect::<String>(),
        )
    }

    fn at(ms: u64) -> Timestamp {
        Timestamp(1000 * ms)
    }

    #[test]
    fn viewed_tile_is_read_once() {
        let mut viewers = Viewers::new(vec![tile("0")]);
        let read = |viewers: &mut Viewers, ms| viewers.tiles(|_| 1, at(ms)).0;
        viewers
            .set_view(
                viewer(1, 1),
                vec![tile("12"), tile("123"), tile("013")],
                at(0),
            )
            .unwrap();
        assert_eq!(read(&mut viewers, 1), [tile("0"), tile("12")].into());
        viewers
            .set_view(viewer(1, 2), vec![tile("2")], at(5000))
            .unwrap();
        assert_eq!(
            read(&mut viewers, 5000),
            [tile("0"), tile("12"), tile("2")].into()
        );
        assert_eq!(read(&mut viewers, 11_000), [tile("0"), tile("2")].into());
        viewers
            .set_view(viewer(1, 2), vec![tile("33")], at(12_000))
            .unwrap();
        assert_eq!(
            read(&mut viewers, 12_000),
            [tile("0"), tile("33")].into(),
            "one that moves leaves what it saw"
        );
        assert_eq!(read(&mut viewers, 30_000), [tile("0")].into());
    }

    #[test]
    fn host_with_many_views_keeps_share() {
        let mut viewers = Viewers::new(Vec::new());
        for number in 0..200 {
            let result = viewers.set_view(viewer(1, number), vec![numbered(number)], at(1000));
            assert_eq!(result.is_ok(), number < MAX_VIEWS, "{number}");
        }
        for number in 0..40 {
            let _ = viewers.set_view(
                viewer(2, number),
                vec![numbered(200 + number % 50)],
                at(1001),
            );
        }
        let of = |viewers: &Viewers, host| {
            viewers
                .views
                .keys()
                .filter(|id| id.host == viewer(host, 0).host)
                .count()
        };
        assert_eq!([of(&viewers, 1), of(&viewers, 2)], [32, 32]);
        viewers
            .set_view(viewer(3, 0), vec![tile("3333")], at(1002))
            .unwrap();
        assert!(viewers.tiles(|_| 1, at(1002)).0.contains(&tile("3333")));
        assert_eq!(viewers.views.len(), MAX_VIEWS);
    }

    #[test]
    fn idle_view_is_evicted_first() {
        let mut viewers = Viewers::new(Vec::new());
        viewers
            .set_view(viewer(2, 0), vec![tile("3")], at(0))
            .unwrap();
        for number in 1..MAX_VIEWS {
            viewers
                .set_view(viewer(1, number), vec![numbered(number)], at(3000))
                .unwrap();
        }
        viewers
            .set_view(viewer(1, 100), vec![tile("2")], at(3000))
            .unwrap();
        assert!(
            !viewers.views.contains_key(&viewer(2, 0)) && viewers.views.contains_key(&viewer(1, 1))
        );
    }

    #[test]
    fn small_views_are_read_first() {
        let mut viewers = Viewers::new(Vec::new());
        // Each tile of four digits has 100 cells.
        let count = |tiles: &[Quadkey]| 100 * tiles.len();
        for number in 0..12 {
            let tiles = (0..20).map(|tile| numbered(20 * number + tile)).collect();
            viewers.set_view(viewer(1, number), tiles, at(0)).unwrap();
        }
        viewers
            .set_view(viewer(2, 0), (240..256).map(numbered).collect(), at(0))
            .unwrap();
        viewers
            .set_view(viewer(3, 0), (0..21).map(numbered).collect(), at(0))
            .unwrap();
        let (read, withheld) = viewers.tiles(count, at(0));
        assert!(
            (240..256).all(|number| read.contains(&numbered(number))),
            "the other host's"
        );
        assert_eq!(withheld.get(&viewer(3, 0)), Some(&MapsWithheld::LargeView));
        let of_many = withheld
            .values()
            .filter(|reason| **reason == MapsWithheld::ManyCells)
            .count();
        assert_eq!(
            (read.len(), of_many),
            (16 + 4 * 20, 8),
            "10,000 cells at most"
        );
    }
}
