//! Cells whose names are similar to this node's cell: a frame identifies its cell only by a hash of
//! the name.

use std::collections::BTreeMap;

use ecod::model::names::NodeName;

use super::key::cell_tag;

/// Tags of received other cells, with the cell's name if it is one typing error away from the own
/// cell's name.
#[derive(Debug, Default)]
pub(crate) struct NearCells(BTreeMap<[u8; 4], Option<NodeName>>);

/// Maximum number of stored tags, so that invented tags do not cause further searches.
const MAX_TAGS: usize = 16;

impl NearCells {
    /// The cell of a tag, if its name is one letter more, less, other or swapped.
    pub(crate) fn name_of(&mut self, tag: [u8; 4], own: &NodeName) -> Option<&NodeName> {
        if self.0.len() >= MAX_TAGS && !self.0.contains_key(&tag) {
            return None;
        }
        self.0
            .entry(tag)
            .or_insert_with(|| slips(own.as_str()).find(|name| cell_tag(name) == tag))
            .as_ref()
    }
}

/// True if two names differ in digits only, like the names of neighbouring cells.
pub(crate) fn are_numbered(one: &NodeName, other: &NodeName) -> bool {
    let letters = |name: &NodeName| name.as_str().replace(|c: char| c.is_ascii_digit(), "");
    letters(one) == letters(other)
}

/// All names that result from one typing error in this name (Damerau, "A technique for computer
/// detection and correction of spelling errors", Communications of the ACM 7(3), 1964).
fn slips(name: &str) -> impl Iterator<Item = NodeName> + '_ {
    let letters = ('a'..='z')
        .chain('A'..='Z')
        .chain('0'..='9')
        .chain(['-', '_']);
    let splits = (0..=name.len()).filter_map(|at| name.split_at_checked(at));
    let after = |rest: &'_ str| rest.char_indices().nth(1).map_or(rest.len(), |(at, _)| at);
    splits
        .flat_map(move |(before, rest)| {
            let (first, others) = rest.split_at_checked(after(rest)).unwrap_or_default();
            let (second, last) = others.split_at_checked(after(others)).unwrap_or_default();
            let shorter = [
                format!("{before}{others}"),
                format!("{before}{second}{first}{last}"),
            ];
            let longer = letters.clone().flat_map(move |letter| {
                [
                    format!("{before}{letter}{rest}"),
                    format!("{before}{letter}{others}"),
                ]
            });
            shorter.into_iter().chain(longer)
        })
        .filter(move |slip| slip != name)
        .filter_map(|slip| NodeName::new(slip).ok())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn mistyped_cell_is_found() {
        let own = NodeName::from_static("ux-lot");
        let found = |other: &'static str| {
            let other = NodeName::from_static(other);
            NearCells::default()
                .name_of(cell_tag(&other), &own)
                .cloned()
                == Some(other)
        };
        for near in [
            "ux-lott", "ux-lo", "uxlot", "xu-lot", "ux_lot", "Ux-lot", "ux-lot1", "-ux-lot",
        ] {
            assert!(found(near), "{near}");
        }
        for other in ["lot-1", "cell", "ux-lottt", "ux"] {
            assert!(!found(other), "{other}");
        }
        assert!(are_numbered(
            &NodeName::from_static("lot-1"),
            &NodeName::from_static("lot-12")
        ));
        assert!(!are_numbered(&own, &NodeName::from_static("ux-lott")));
    }

    #[test]
    fn invented_tags_end_search() {
        let mut cells = NearCells::default();
        let own = NodeName::from_static("lot");
        assert!(
            (0..2 * MAX_TAGS as u32).all(|tag| cells.name_of(tag.to_be_bytes(), &own).is_none())
        );
        assert_eq!(cells.0.len(), MAX_TAGS);
    }
}
