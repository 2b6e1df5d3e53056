//! What is wrong with a line of a recording, for people: the field and its fault.
//!
//! A line that can be used is never looked at here.

use std::fmt;

use serde::de::DeserializeOwned;
use serde_json::Value;

use super::records::Envelope;
use crate::model::names::MAX_NAME_BYTES;
use crate::wire::{InvalidValue, Limits, ObjectReport, RejectReason, SCHEMA_VERSION};

/// The reason why a line was rejected, with the field that is to blame.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Flaw {
    /// The reason.
    pub reason: RejectReason,
    /// Path of the field, as `objects[3].x_m`; empty for the whole line.
    pub field: String,
    /// The fault, a predicate.
    pub fault: String,
}

impl Flaw {
    pub(super) fn new(reason: RejectReason, field: impl Into<String>, fault: impl Into<String>) -> Self {
        Self { reason, field: field.into(), fault: fault.into() }
    }

    /// The flaw of a line that is longer than allowed.
    pub(super) fn too_large(limits: &Limits) -> Self {
        Self::new(RejectReason::TooLarge, "", format!("is longer than {} bytes", limits.payload_bytes))
    }

    /// The flaw of a line that was rejected for `reason` when it was decoded.
    pub(super) fn of_line(text: &[u8], reason: RejectReason, limits: &Limits) -> Self {
        let report: ObjectReport = match read(text) {
            Ok(report) => report,
            Err(_) if reason == RejectReason::UnknownSchema => return Self::of_value(text, reason, "schema".into()),
            Err((field, fault)) => return Self::new(reason, field, fault),
        };
        match report.check_values(limits) {
            Err(InvalidValue { field, reason }) => Self::of_value(text, reason, field),
            Ok(()) => read::<Envelope>(text)
                .err()
                .map_or_else(|| Self::new(reason, "", ""), |(field, fault)| Self::new(reason, field, fault)),
        }
    }

    /// The flaw of a value that is no valid one.
    fn of_value(text: &[u8], reason: RejectReason, field: String) -> Self {
        let pointer = format!("/{}", field.replace(['.', '['], "/").replace(']', ""));
        let line: Value = serde_json::from_slice(text).unwrap_or_default();
        let value = line.pointer(&pointer).cloned().unwrap_or_default();
        let fault = match reason {
            RejectReason::UnknownSchema => format!("is {value}, not {SCHEMA_VERSION}"),
            RejectReason::ConfidenceOutOfRange => format!("is not within 0 to 1: {value}"),
            RejectReason::NotFinite if field.ends_with("covariance_m2") => format!("is no covariance: {value}"),
            RejectReason::TooManyObjects => "has too many entries".into(),
            RejectReason::InvalidLabel => {
                format!("is empty, longer than {MAX_NAME_BYTES} bytes, or has control characters")
            }
            _ => format!("is out of bounds: {value}"),
        };
        Self::new(reason, field, fault)
    }

    /// The flaw of a readable line that the aggregator did not use.
    pub(super) fn of_report(reason: RejectReason) -> Self {
        let (field, fault) = match reason {
            RejectReason::FromTheFuture => ("captured_at_us", "is ahead of most of the lines after it"),
            RejectReason::Stale => ("captured_at_us", "is too long before the line's time"),
            RejectReason::OutOfOrder => ("captured_at_us", "is not later than in an earlier line of this node"),
            RejectReason::TooManyVehicles => ("node", "is one vehicle too many"),
            RejectReason::NotFused => ("topic", "is of an algorithm that the cell does not run"),
            _ => ("", ""),
        };
        Self::new(reason, field, fault)
    }
}

impl fmt::Display for Flaw {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match (self.field.as_str(), self.fault.as_str()) {
            (_, "") => write!(f, "{}", self.reason),
            ("", fault) => f.write_str(fault),
            (field, fault) => write!(f, "{field}: {fault}"),
        }
    }
}

/// Reads JSON.
///
/// # Errors
/// The path of the value that cannot be read, and its fault.
fn read<T: DeserializeOwned>(text: &[u8]) -> Result<T, (String, String)> {
    let mut source = serde_json::Deserializer::from_slice(text);
    let value = serde_path_to_error::deserialize(&mut source).map_err(|error| {
        // Beyond a broken name, the path is unknown.
        let path = error.path().to_string();
        (path.trim_matches(['.', '?']).to_owned(), fault(text, error.inner()))
    })?;
    source.end().map_err(|error| (String::new(), fault(text, &error)))?;
    Ok(value)
}

/// The fault that a reader of JSON found. Its line is always the first.
fn fault(text: &[u8], error: &serde_json::Error) -> String {
    // The column is at the first letter of a word or next to it.
    let around = text.get(error.column().saturating_sub(3)..).unwrap_or_default();
    let around = around.get(.."-Infinity".len() + 2).unwrap_or(around);
    let is_near = |word: &str| around.windows(word.len()).any(|part| part == word.as_bytes());
    match ["NaN", "Infinity"].into_iter().find(|word| error.is_syntax() && is_near(word)) {
        Some(word) => format!("is {word}"),
        None => error.to_string().replace(" at line 1 column ", ", at column "),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::replay::read_report;

    #[test]
    fn field_and_fault_are_named() {
        let line = |objects: &str, more: &str| {
            format!(r#"{{"schema":1,"node":"a","seq":1,"captured_at_us":5,"objects":[{objects}]{more}}}"#)
        };
        let object = |rest: &str| {
            let good = r#"{"label":"cup","confidence":0.5,"x_m":1,"y_m":2}"#;
            line(&format!(r#"{good},{{"label":"cup",{rest}}}"#), "")
        };
        for (text, flaw) in [
            (object(r#""confidence":0.5,"x_m":NaN,"y_m":2"#), "objects[1].x_m: is NaN"),
            (object(r#""confidence":0.5,"x_m":1,"y_m":-Infinity"#), "objects[1].y_m: is Infinity"),
            (object(r#""confidence":0.5,"x_m":1e9,"y_m":2"#), "objects[1].x_m: is out of bounds: 1000000000.0"),
            (object(r#""confidence":0.5,"x_m":"1","y_m":2"#), "objects[1].x_m: invalid type: string \"1\""),
            (object(r#""confidence":0.5,"x_m":1"#), "objects[1]: missing field `y_m`"),
            (object(r#""confidence":5,"x_m":1,"y_m":2"#), "objects[1].confidence: is not within 0 to 1: 5"),
            (
                object(r#""confidence":0.5,"x_m":1,"y_m":2,"covariance_m2":[1,2,1]"#),
                "objects[1].covariance_m2: is no covariance: [1,2,1]",
            ),
            (object(r#""confidence":0.5,"x_m":1,"y_m":2,"landmark":"""#), "objects[1].landmark: is empty"),
            (line("", r#","seen":["x",""]"#), "seen[1]: is empty"),
            (line("", r#","pose":{"x_m":1,"y_m":1e9,"heading_rad":0}"#), "pose.y_m: is out of bounds"),
            (line("", r#","received_at_us":"noon""#), "received_at_us: invalid type: string \"noon\""),
            (line("", r#","topic":"reputations""#), "topic: is neither detections nor vote_detections"),
            (line("", r#","topic":"detections/b""#), "topic: names another node than `a`"),
            (line("", "").replace("\"schema\":1", "\"schema\":2"), "schema: is 2, not 1"),
            (line("", "").replace("\"a\"", "\"a/b\""), "node: "),
            (line("", "").replace(":5,", ":1732154400.5,"), "captured_at_us: invalid type: floating point"),
            (line("", "")[..40].into(), "EOF while parsing"),
            ("# Title".into(), "is no JSON object"),
        ] {
            let said = read_report(text.as_bytes(), &Limits::default()).unwrap_err().to_string();
            assert!(said.starts_with(flaw), "{text}: {said}");
        }
    }
}
