//! Ground truth of landmarks: the label of each, and since when.

use std::collections::{BTreeMap, BTreeSet};

use ecod::model::names::{Label, LandmarkId, MAX_NAME_BYTES, is_label};
use ecod::model::time::Timestamp;
use serde::Deserialize;
use serde_json::Value;

/// Default text of a sign of vacancy.
const VACANT: &str = "EMPTY";

/// The true label of every evaluated location.
///
/// As JSON, `{"landmarks": {…}}` or the inner object alone, each location with one of
///
/// ```text
/// "ABCD123"                                                   this label; a number or truth value is its text
/// null                                                        nothing: null, or a label of "empty", is right
/// ["vase", "sports ball"]                                     any of these
/// [{"from_us": 0, "label": "cup"}, {"from_us": 17, "label": null}]   changes with time
/// ```
///
/// and optionally `"empty": ["EMPTY"]`, the labels that stand for an empty location; or as CSV (RFC
/// 4180) with the header `item,truth`, of which an empty truth is null.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Truth {
    landmarks: BTreeMap<LandmarkId, Vec<LabelSpan>>,
    empty: BTreeSet<Label>,
}

/// Truth from a time on.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct LabelSpan {
    from: Timestamp,
    /// All accepted labels; the first is used as the name. `None` is an empty location.
    accepted: Vec<Option<Label>>,
}

impl LabelSpan {
    /// The first accepted label, `None` for an empty location.
    pub(super) fn name(&self) -> Option<&Label> {
        self.accepted.first().and_then(Option::as_ref)
    }
}

/// A truth file that cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum TruthError {
    /// The file is not an object and not a table with the header `item,truth`.
    #[error("truth is neither a json object nor a table with the columns item,truth: {0}")]
    NeitherForm(String),
    /// A location's truth has an invalid form.
    #[error("truth of `{landmark}` {reason}")]
    Location {
        /// Name of the location.
        landmark: String,
        /// Reason why its truth cannot be used, as a predicate.
        reason: String,
    },
    /// No location at all.
    #[error("truth names no location")]
    Empty,
}

impl Truth {
    /// Reads either form.
    ///
    /// # Errors
    /// Returns a [`TruthError`] that names the location and the fault.
    pub fn parse(text: &str) -> Result<Self, TruthError> {
        let text = text.trim_start_matches('\u{feff}');
        let truth = if text.trim_start().starts_with('{') {
            Self::from_json(text)?
        } else {
            Self::from_csv(text)?
        };
        if truth.landmarks.is_empty() {
            Err(TruthError::Empty)
        } else {
            Ok(truth)
        }
    }

    fn from_json(text: &str) -> Result<Self, TruthError> {
        let value: Value = serde_json::from_str(text)
            .map_err(|error| TruthError::NeitherForm(error.to_string()))?;
        let whole = value
            .as_object()
            .ok_or_else(|| TruthError::NeitherForm("not an object".into()))?;
        let inner = whole.get("landmarks").and_then(Value::as_object);
        let empty = match whole.get("empty").filter(|_| inner.is_some()) {
            None => BTreeSet::from([Label::new_static(VACANT)]),
            Some(labels) => accepted("empty", labels)?.into_iter().flatten().collect(),
        };
        let mut landmarks = BTreeMap::new();
        for (landmark, value) in inner.unwrap_or(whole) {
            landmarks.insert(name(landmark)?, spans(landmark, value)?);
        }
        Ok(Self { landmarks, empty })
    }

    fn from_csv(text: &str) -> Result<Self, TruthError> {
        let mut table = csv::ReaderBuilder::new()
            .trim(csv::Trim::All)
            .flexible(true)
            .from_reader(text.as_bytes());
        let broken = |error: csv::Error| TruthError::NeitherForm(error.to_string());
        if !table
            .headers()
            .map_err(broken)?
            .iter()
            .eq(["item", "truth"])
        {
            let found: String = text
                .lines()
                .next()
                .unwrap_or_default()
                .chars()
                .take(MAX_NAME_BYTES)
                .collect();
            return Err(TruthError::NeitherForm(format!(
                "the first line is {found:?}"
            )));
        }
        let mut landmarks: BTreeMap<LandmarkId, Vec<LabelSpan>> = BTreeMap::new();
        for row in table.records() {
            let row = row.map_err(broken)?;
            let item = row.get(0).unwrap_or_default();
            let truth = match row.len() {
                2 => Some(&row[1])
                    .filter(|truth| !truth.is_empty())
                    .map(Label::new),
                0 | 1 => return Err(location(item, "has no second column")),
                _ => {
                    return Err(location(
                        item,
                        "has more than two columns: quote what has a comma in it",
                    ));
                }
            };
            if let Some(truth) = truth.as_ref().filter(|truth| !is_label(truth)) {
                return Err(location(
                    item,
                    format!("is {truth:?}, no label: is a quotation mark missing?"),
                ));
            }
            let span = vec![LabelSpan {
                from: Timestamp(0),
                accepted: vec![truth],
            }];
            if landmarks
                .insert(name(item)?, span.clone())
                .is_some_and(|earlier| earlier != span)
            {
                return Err(location(item, "is given twice and differs"));
            }
        }
        Ok(Self {
            landmarks,
            empty: BTreeSet::from([Label::new_static(VACANT)]),
        })
    }

    /// Truth at a location, with the position of its span among the location's spans; `None` if
    /// there is no truth.
    pub(super) fn at(&self, landmark: &LandmarkId, time: Timestamp) -> Option<(usize, &LabelSpan)> {
        let spans = self.landmarks.get(landmark)?;
        spans
            .iter()
            .enumerate()
            .rev()
            .find(|(_, span)| span.from <= time)
    }

    /// Every span of every location.
    pub(super) fn spans(&self) -> impl Iterator<Item = (&LandmarkId, usize, &LabelSpan)> {
        self.landmarks
            .iter()
            .flat_map(|(id, spans)| spans.iter().enumerate().map(move |(n, span)| (id, n, span)))
    }

    /// True if the label (or its absence) is right.
    pub(super) fn accepts(&self, span: &LabelSpan, label: Option<&Label>) -> bool {
        let said_empty = label.is_some_and(|label| self.empty.contains(label));
        span.accepted
            .iter()
            .any(|right| right.as_ref() == label || (right.is_none() && said_empty))
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct SpanFields {
    from_us: Timestamp,
    label: Value,
}

fn spans(landmark: &str, value: &Value) -> Result<Vec<LabelSpan>, TruthError> {
    let timed = value
        .as_array()
        .filter(|items| items.iter().any(Value::is_object));
    let Some(timed) = timed else {
        return Ok(vec![LabelSpan {
            from: Timestamp(0),
            accepted: accepted(landmark, value)?,
        }]);
    };
    let mut spans = Vec::with_capacity(timed.len());
    for item in timed {
        let SpanFields { from_us, label } = SpanFields::deserialize(item)
            .map_err(|error| location(landmark, format!("cannot be read: {error}")))?;
        spans.push(LabelSpan {
            from: from_us,
            accepted: accepted(landmark, &label)?,
        });
    }
    if spans.is_sorted_by(|a, b| a.from < b.from) {
        Ok(spans)
    } else {
        Err(location(landmark, "goes back in time"))
    }
}

fn accepted(landmark: &str, value: &Value) -> Result<Vec<Option<Label>>, TruthError> {
    let one = |value: &Value| match value {
        Value::Null => Ok(None),
        Value::String(label) => Ok(Some(Label::new(label))),
        Value::Number(_) | Value::Bool(_) => Ok(Some(Label::new(value.to_string()))),
        other => Err(location(
            landmark,
            format!("has {other} where a label or null is expected"),
        )),
    };
    match value {
        Value::Array(values) if values.is_empty() => Err(location(landmark, "is an empty list")),
        Value::Array(values) => values.iter().map(one).collect(),
        value => Ok(vec![one(value)?]),
    }
}

fn name(landmark: &str) -> Result<LandmarkId, TruthError> {
    if (1..=MAX_NAME_BYTES).contains(&landmark.len()) {
        Ok(LandmarkId::new(landmark))
    } else {
        Err(location(
            landmark,
            format!("has a name that is not 1 to {MAX_NAME_BYTES} bytes long"),
        ))
    }
}

fn location(landmark: &str, reason: impl Into<String>) -> TruthError {
    TruthError::Location {
        landmark: landmark.chars().take(MAX_NAME_BYTES).collect(),
        reason: reason.into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn right(truth: &Truth, landmark: &str, at: u64, label: Option<&str>) -> bool {
        let (_, span) = truth.at(&landmark.into(), Timestamp(at)).unwrap();
        truth.accepts(span, label.map(Label::new).as_ref())
    }

    #[test]
    fn every_form_is_read() {
        let truth = Truth::parse(
            r#"{"landmarks": {"a": "cup", "b": null, "c": ["vase", "sports ball"],
                "d": [{"from_us": 10, "label": "cup"}, {"from_us": 20, "label": [null, "hole"]}]}, "note": 1}"#,
        )
        .unwrap();
        assert!(right(&truth, "a", 5, Some("cup")) && !right(&truth, "a", 5, None));
        assert!(
            right(&truth, "b", 5, None)
                && right(&truth, "b", 5, Some("EMPTY"))
                && !right(&truth, "b", 5, Some("x"))
        );
        assert!(right(&truth, "c", 5, Some("vase")) && right(&truth, "c", 5, Some("sports ball")));
        assert!(
            truth.at(&"d".into(), Timestamp(9)).is_none()
                && truth.at(&"e".into(), Timestamp(9)).is_none()
        );
        assert!(
            right(&truth, "d", 19, Some("cup"))
                && right(&truth, "d", 20, None)
                && right(&truth, "d", 20, Some("hole"))
        );
        let table = Truth::parse("item,truth\r\na,1\r\nb,2\r\n");
        assert_eq!(Truth::parse("\u{feff}{\"a\": \"1\", \"b\": \"2\"}"), table);
        assert_eq!(Truth::parse("{\"a\": 1, \"b\": [2]}"), table);
        assert!(right(
            &Truth::parse("{\"a\": true}").unwrap(),
            "a",
            0,
            Some("true")
        ));
        let quoted = Truth::parse("item, truth\n\"a, b\",\"say \"\"cup\"\"\"\n\nc,\n").unwrap();
        assert!(right(&quoted, "a, b", 0, Some("say \"cup\"")) && right(&quoted, "c", 0, None));
        let other = Truth::parse(r#"{"landmarks": {"a": null}, "empty": "free"}"#).unwrap();
        assert!(right(&other, "a", 0, Some("free")) && !right(&other, "a", 0, Some("EMPTY")));
    }

    #[test]
    fn unreadable_entry_is_named() {
        for (text, part) in [
            ("", "first line is \"\""),
            ("{", "neither"),
            ("[]", "neither"),
            ("{}", "names no location"),
            ("item,truth\n", "names no location"),
            ("item,truth\na", "`a` has no second column"),
            ("item,truth\na,1\na,2", "`a` is given twice"),
            ("item,truth\na,1,2", "`a` has more than two columns"),
            (r#"{"a": {}}"#, "`a` has {}"),
            (r#"{"a": []}"#, "`a` is an empty list"),
            (
                r#"{"a": [{"from_us": 2, "label": "x"}, {"from_us": 2, "label": "y"}]}"#,
                "`a` goes back in time",
            ),
            (
                r#"{"a": [{"from_us": -2, "label": "x"}]}"#,
                "`a` cannot be read",
            ),
        ] {
            let error = Truth::parse(text).unwrap_err().to_string();
            assert!(error.contains(part), "{text}: {error}");
        }
    }
}
