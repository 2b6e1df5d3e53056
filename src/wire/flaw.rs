//! Faults of a rejected payload as text: the field and its fault.
//!
//! Usable payloads are not examined here.

use std::fmt;

use serde::de::DeserializeOwned;
use serde_json::Value;

use super::codec::read;
use super::compact::is_compact;
use super::{InvalidValue, Limits, ObjectReport, RejectReason, SCHEMA_VERSION, numbers};
use crate::model::geometry::TURN_BOUND_RAD;
use crate::model::names::MAX_NAME_BYTES;

/// The reason why a payload was rejected, with the responsible field.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Flaw {
    /// Reason under which the rejection is counted.
    pub reason: RejectReason,
    /// Path of the field, as `objects[3].x_m`; empty for the whole payload.
    pub field: String,
    /// The fault, a predicate.
    pub fault: String,
}

impl Flaw {
    /// A flaw of a field; `fault` is empty if there is no further information.
    pub fn new(reason: RejectReason, field: impl Into<String>, fault: impl Into<String>) -> Self {
        Self {
            reason,
            field: field.into(),
            fault: fault.into(),
        }
    }

    /// The flaw of a report in any encoding that was rejected for `reason` when it was decoded.
    pub fn of_report(bytes: &[u8], reason: RejectReason, limits: &Limits) -> Self {
        match (reason, bytes.trim_ascii_start().first()) {
            (RejectReason::TooLarge, _) => Self::new(
                reason,
                "",
                format!("is longer than {} bytes", limits.payload_bytes),
            ),
            (RejectReason::NodeMismatch, _) => {
                let named =
                    read::<ObjectReport>(bytes).map(|report| format!("it names {}", report.node));
                Self::new(reason, "", named.unwrap_or_default())
            }
            (_, first) if first == Some(&b'{') || bytes.is_ascii() => {
                Self::of_json(bytes, reason, limits).unwrap_or_else(|| Self::new(reason, "", ""))
            }
            _ => {
                let report = match (read::<ObjectReport>(bytes), bytes.first()) {
                    (Ok(report), _) => Some(report),
                    (Err(_), Some(first)) if !is_compact(*first) => {
                        return match numbers::read_cbor::<ObjectReport>(bytes) {
                            Err(unreadable) if reason == RejectReason::Malformed => {
                                Self::new(reason, unreadable.field, unreadable.fault)
                            }
                            _ => Self::new(reason, "", ""),
                        };
                    }
                    (Err(_), _) => None,
                };
                let invalid = report
                    .as_ref()
                    .and_then(|report| report.check_values(limits).err());
                let shown = serde_json::to_value(&report).unwrap_or_default();
                invalid.map_or_else(
                    || Self::new(reason, "", ""),
                    |InvalidValue { field, reason }| Self::of_value(&shown, reason, field),
                )
            }
        }
    }

    /// The flaw of a report in JSON; `None` if the report is valid.
    pub(crate) fn of_json(text: &[u8], reason: RejectReason, limits: &Limits) -> Option<Self> {
        let line = || serde_json::from_slice(text).unwrap_or_default();
        let report: ObjectReport = match read_json(text) {
            Ok(report) => report,
            Err(_) if reason == RejectReason::UnknownSchema => {
                return Some(Self::of_value(&line(), reason, "schema".into()));
            }
            Err((field, fault)) => match numbers::read_json(text) {
                Some(report) => report,
                None => return Some(Self::new(reason, field, fault)),
            },
        };
        let InvalidValue { field, reason } = report.check_values(limits).err()?;
        Some(Self::of_value(&line(), reason, field))
    }

    /// The flaw of an invalid value.
    pub(super) fn of_value(payload: &Value, reason: RejectReason, field: String) -> Self {
        let pointer = format!("/{}", field.replace(['.', '['], "/").replace(']', ""));
        // A key that contains a dot cannot be found again.
        let value = payload.pointer(&pointer);
        let shown = value.map_or_else(String::new, |value| format!(": {value}"));
        let fault = match reason {
            RejectReason::UnknownSchema => {
                format!("is {}, not {SCHEMA_VERSION}", value.unwrap_or(&Value::Null))
            }
            RejectReason::ConfidenceOutOfRange => format!("is not within 0 to 1{shown}"),
            RejectReason::NotFinite if field.ends_with("covariance_m2") => {
                format!("is no covariance{shown}")
            }
            // JSON cannot represent this number; other encodings can.
            RejectReason::NotFinite if value.is_none_or(Value::is_null) => {
                "is not a finite number".into()
            }
            RejectReason::TooManyObjects => "has too many entries".into(),
            RejectReason::InvalidLabel => {
                format!("is empty, longer than {MAX_NAME_BYTES} bytes, or has control characters")
            }
            RejectReason::OutOfRange if is_beyond_turn(&field, value) => {
                let convention = if field.ends_with("heading_rad") {
                    "a heading is in radians, counter-clockwise from east"
                } else {
                    "an angle is in radians"
                };
                format!("is beyond 2π{shown}; {convention}: is this one in degrees?")
            }
            _ => format!("is out of bounds{shown}"),
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

/// True for an angle of more than a full turn.
fn is_beyond_turn(field: &str, value: Option<&Value>) -> bool {
    let number = value.and_then(Value::as_f64);
    field.ends_with("_rad") && number.is_some_and(|number| number.abs() > TURN_BOUND_RAD)
}

/// Reads JSON.
///
/// # Errors
/// Returns the path of the value that cannot be read, and its fault.
pub(crate) fn read_json<T: DeserializeOwned>(text: &[u8]) -> Result<T, (String, String)> {
    let mut source = serde_json::Deserializer::from_slice(text);
    let value = serde_path_to_error::deserialize(&mut source).map_err(|error| {
        // If a name is broken, the path behind it is unavailable.
        let path = error.path().to_string();
        (
            path.trim_matches(['.', '?']).to_owned(),
            fault(text, error.inner()),
        )
    })?;
    source
        .end()
        .map_err(|error| (String::new(), fault(text, &error)))?;
    Ok(value)
}

/// The fault reported by the JSON reader.
fn fault(text: &[u8], error: &serde_json::Error) -> String {
    let text = text
        .split(|byte| *byte == b'\n')
        .nth(error.line().saturating_sub(1))
        .unwrap_or_default();
    // The column is at the first letter of a word or next to it.
    let rest = text
        .get(error.column().saturating_sub(3)..)
        .unwrap_or_default();
    let around = rest.get(.."-Infinity".len() + 2).unwrap_or(rest);
    let is_near = |word: &str| {
        around
            .windows(word.len())
            .any(|part| part == word.as_bytes())
    };
    match ["NaN", "Infinity"]
        .into_iter()
        .find(|word| error.is_syntax() && is_near(word))
    {
        Some(word) => format!("is {word}"),
        None => error
            .to_string()
            .replace(" at line 1 column ", ", at column "),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::names::NodeName;
    use crate::model::time::Timestamp;
    use crate::wire::{Encoding, PerceivedObject, encode};

    #[test]
    fn every_encoding_names_field() {
        let object = |x_m| PerceivedObject::new("cup", 0.5, x_m, 2.0);
        let report = ObjectReport {
            objects: vec![object(1.0), object(f64::NAN)],
            ..ObjectReport::new(NodeName::from_static("watson"), 1, Timestamp(5))
        };
        let limits = Limits::default();
        for encoding in [Encoding::Cbor, Encoding::Compact] {
            let flaw =
                Flaw::of_report(&encode(&report, encoding), RejectReason::NotFinite, &limits);
            assert_eq!(
                flaw.to_string(),
                "objects[1].x_m: is not a finite number",
                "{encoding:?}"
            );
        }
        let json = br#"{"schema":1,"node":"watson","seq":1,"captured_at_us":5,"objects":[{"label":"cup","confidence":0.5,"x_m":NaN,"y_m":2}]}"#;
        assert_eq!(
            Flaw::of_report(json, RejectReason::NotFinite, &limits).to_string(),
            "objects[0].x_m: is NaN"
        );
        for (junk, expected) in [
            (&b"junk"[..], "expected value, at column 1"),
            (b"\xff\xfe", "is neither JSON nor CBOR"),
        ] {
            assert_eq!(
                Flaw::of_report(junk, RejectReason::Malformed, &limits).to_string(),
                expected
            );
        }
        let mismatch = Flaw::of_report(
            &encode(&report, Encoding::Json),
            RejectReason::NodeMismatch,
            &limits,
        );
        assert_eq!(
            mismatch.to_string(),
            "node_mismatch",
            "an unreadable report names no node"
        );
        let readable = encode(
            &ObjectReport {
                objects: vec![object(1.0)],
                ..report
            },
            Encoding::Json,
        );
        assert_eq!(
            Flaw::of_report(&readable, RejectReason::NodeMismatch, &limits).to_string(),
            "it names watson"
        );
    }
}
