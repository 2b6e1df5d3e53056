//! Labels of a network's classes: from a file, from the model's metadata, or COCO's.

use ecod::model::names::{Label, is_label};

use crate::camera::detect::coco::labels as coco;

/// The numbers that a network assigns to classes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Classes {
    /// Scores of each box, if the network lists them.
    pub(super) scores: Option<usize>,
    /// Number of the first class: 1 where 0 is the background.
    pub(super) first: usize,
    /// True if the last score is for no object.
    pub(super) has_none_last: bool,
}

impl Classes {
    /// Count of classes, if the network shows it.
    pub(super) fn count(&self) -> Option<usize> {
        self.scores?
            .checked_sub(self.first + usize::from(self.has_none_last))
    }

    /// The label of each number. `names` are the classes in order; without them, the classes must
    /// be COCO's.
    ///
    /// # Errors
    /// Returns the number of classes if it differs from the number of names, or is not COCO's.
    pub(super) fn labels(
        &self,
        names: Option<&[String]>,
    ) -> Result<Vec<Option<Label>>, Option<usize>> {
        let count = self.count();
        let in_order = |names: &mut dyn Iterator<Item = Label>| {
            std::iter::repeat_n(None, self.first)
                .chain(names.map(Some))
                .collect()
        };
        match (names, count) {
            (Some(names), Some(count)) if names.len() != count => Err(Some(count)),
            (Some(names), _) => Ok(in_order(&mut names.iter().map(Label::from))),
            (None, Some(80)) => Ok(in_order(&mut coco::all().map(|(_, name)| name.into()))),
            (None, None) if self.first == 0 => {
                Ok(in_order(&mut coco::all().map(|(_, name)| name.into())))
            }
            // The 91 ids of COCO with 0, which is either the background or not in use.
            (None, None | Some(coco::IDS | coco::CLASSES)) => {
                Ok((0..coco::CLASSES).map(by_id).collect())
            }
            (None, count) => Err(count),
        }
    }
}

fn by_id(id: usize) -> Option<Label> {
    coco::name(id).map(Label::from)
}

/// The names in a file: one on each line, without empty lines and without a background before the
/// others.
pub(super) fn read(text: &str) -> Vec<String> {
    let mut names: Vec<String> = text
        .lines()
        .map(str::trim)
        .filter(|line| !line.is_empty())
        .map(str::to_owned)
        .collect();
    if names
        .first()
        .is_some_and(|name| name.trim_matches('_').eq_ignore_ascii_case("background"))
    {
        names.remove(0);
    }
    names
}

/// The names in the metadata of a model, a list or map as Python or JSON writes it:
/// `{0: 'person', 1: "car"}`.
pub(super) fn parse(text: &str) -> Vec<String> {
    let mut names = Vec::new();
    let mut rest = text.chars().peekable();
    while let Some(quote) = rest.find(|c| matches!(c, '\'' | '"')) {
        let mut name = String::new();
        while let Some(c) = rest.next_if(|c| *c != quote) {
            name.extend(if c == '\\' { rest.next() } else { Some(c) });
        }
        rest.next();
        // Keys of a map in JSON are in quotes, too.
        if rest.peek() != Some(&':') {
            names.push(name);
        }
    }
    names
}

/// The first name that cannot be a label.
pub(super) fn first_unusable(names: &[String]) -> Option<&str> {
    names
        .iter()
        .map(String::as_str)
        .find(|name| !is_label(name))
}
