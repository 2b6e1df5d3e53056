//! Labels of a network's classes: from a file, from the model's metadata, or COCO's.

use std::collections::BTreeMap;

use ecod::model::names::{Label, is_label};

use super::literal::{self, Literal};
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

/// The names in a file: one on each line, without empty lines.
pub(super) fn read(text: &str) -> StatedNames {
    let names = text
        .lines()
        .map(str::trim)
        .filter(|line| !line.is_empty())
        .map(str::to_owned)
        .collect();
    StatedNames::new(names, None)
}

fn is_background(name: &str) -> bool {
    name.trim_matches('_').eq_ignore_ascii_case("background")
}

/// The names of classes that a model or a file states.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct StatedNames {
    /// In the order of the classes' numbers, without a background before the others.
    pub(super) names: Vec<String>,
    /// True if a background stood before the others.
    pub(super) has_background: bool,
    /// Number of the first name, if the model states numbers.
    pub(super) first: Option<usize>,
}

impl StatedNames {
    /// All stated names, and the number of the first one.
    fn new(mut names: Vec<String>, first: Option<usize>) -> Self {
        let has_background = names.first().is_some_and(|name| is_background(name));
        if has_background {
            names.remove(0);
        }
        Self {
            names,
            has_background,
            first: first.map(|first| first + usize::from(has_background)),
        }
    }
}

/// The names in the metadata of a model, a list or a map in Python's or JSON's notation, such as
/// `{0: 'person', 1: "car"}` or `["person", "car"]`.
///
/// # Errors
/// Returns the fault.
pub(super) fn parse(text: &str) -> Result<StatedNames, String> {
    match literal::parse(text)? {
        Literal::List(names) => {
            let names = names.into_iter().map(name_of).collect::<Result<_, _>>()?;
            Ok(StatedNames::new(names, None))
        }
        Literal::Map(entries) => numbered(entries),
        Literal::Text(_) | Literal::Word(_) => Err("they are neither a list nor a map".into()),
    }
}

/// The names of a map from numbers to names, or from names to numbers, in the order of numbers.
fn numbered(entries: Vec<(Literal, Literal)>) -> Result<StatedNames, String> {
    let have_numbers = entries.iter().all(|(key, _)| key.number().is_some());
    let mut names = BTreeMap::new();
    for (key, value) in entries {
        let (number, name) = if have_numbers {
            (key, value)
        } else {
            (value, key)
        };
        let name = name_of(name)?;
        let class = number
            .number()
            .ok_or_else(|| format!("{name:?} has no whole number"))?;
        if names.insert(class, name).is_some() {
            return Err(format!("class {class} has two names"));
        }
    }
    let first = names.keys().next().copied();
    let last = names.keys().next_back().copied();
    if let Some((first, last)) = first.zip(last)
        && let Some(class) = (first..=last).find(|class| !names.contains_key(class))
    {
        return Err(format!("class {class} has no name"));
    }
    Ok(StatedNames::new(names.into_values().collect(), first))
}

fn name_of(literal: Literal) -> Result<String, String> {
    match literal {
        Literal::Text(name) | Literal::Word(name) => Ok(name),
        Literal::List(_) | Literal::Map(_) => Err("a name is a list or a map".into()),
    }
}

/// The first name that cannot be a label.
pub(super) fn first_unusable(names: &[String]) -> Option<&str> {
    names
        .iter()
        .map(String::as_str)
        .find(|name| !is_label(&Label::from(*name)))
}
