//! Numbers as other languages write them: `8` for `8.0`, or `5.0` for `5`.
//!
//! Readers of payloads use this after a payload could not be read as it is.

use ciborium::Value as Cbor;
use serde::de::DeserializeOwned;
use serde_json::{Map, Number, Value as Json};

use super::RejectReason;

/// Up to this, floats represent every whole number.
const MAX_WHOLE: f64 = 9_007_199_254_740_992.0;

/// The whole number that a float represents, if it is one.
fn whole(number: f64) -> Option<i64> {
    (number.fract() == 0.0 && number.abs() < MAX_WHOLE).then_some(number as i64)
}

/// Replaces floats that are whole numbers by integers, which readers take for both.
pub fn use_integers(value: &mut Json) {
    match value {
        Json::Number(number) if number.is_f64() => {
            if let Some(integer) = number.as_f64().and_then(whole) {
                *number = integer.into();
            }
        }
        Json::Array(items) => items.iter_mut().for_each(use_integers),
        Json::Object(fields) => fields.values_mut().for_each(use_integers),
        _ => {}
    }
}

/// Reads JSON whose numbers have any form; `None` if it cannot be read.
pub(super) fn read_json<T: DeserializeOwned>(text: &[u8]) -> Option<T> {
    // Maps of CBOR keep a name that occurs twice, so that it is refused.
    let value: Cbor = serde_json::from_slice(text).ok()?;
    serde_json::from_value(json(value).ok()?).ok()
}

/// Why a payload of CBOR cannot be read.
pub(super) struct Unreadable {
    pub(super) reason: RejectReason,
    /// Path of the value that cannot be read; empty for the whole payload.
    pub(super) field: String,
    pub(super) fault: String,
}

impl Unreadable {
    fn new(reason: RejectReason, fault: &str) -> Self {
        Self {
            reason,
            field: String::new(),
            fault: fault.to_owned(),
        }
    }

    fn malformed(fault: &str) -> Self {
        Self::new(RejectReason::Malformed, fault)
    }
}

/// Reads CBOR with names whose numbers have any form.
///
/// # Errors
/// Returns the value that cannot be read.
pub(super) fn read_cbor<T: DeserializeOwned>(mut bytes: &[u8]) -> Result<T, Unreadable> {
    let value: Cbor = ciborium::from_reader(&mut bytes)
        .map_err(|_| Unreadable::malformed("is neither JSON nor CBOR"))?;
    serde_path_to_error::deserialize(json(value)?).map_err(|error| {
        let path = error.path().to_string();
        Unreadable {
            reason: RejectReason::Malformed,
            field: path.trim_matches(['.', '?']).to_owned(),
            fault: error.into_inner().to_string(),
        }
    })
}

/// Compact CBOR with integers in place of floats that are whole numbers; `None` if it is no CBOR.
pub(super) fn compact_with_integers(mut bytes: &[u8]) -> Option<Vec<u8>> {
    fn replace(value: &mut Cbor) {
        match value {
            Cbor::Float(number) => {
                if let Some(integer) = whole(*number) {
                    *value = integer.into();
                }
            }
            Cbor::Array(items) => items.iter_mut().for_each(replace),
            Cbor::Map(entries) => entries.iter_mut().for_each(|(_, value)| replace(value)),
            _ => {}
        }
    }

    let mut value: Cbor = ciborium::from_reader(&mut bytes).ok()?;
    if !bytes.is_empty() {
        return None;
    }
    replace(&mut value);
    let mut written = Vec::new();
    ciborium::into_writer(&value, &mut written).ok()?;
    Some(written)
}

/// A value of CBOR as JSON has it, with ids and hashes as text.
fn json(value: Cbor) -> Result<Json, Unreadable> {
    let malformed = Unreadable::malformed;
    Ok(match value {
        Cbor::Null => Json::Null,
        Cbor::Bool(value) => value.into(),
        Cbor::Text(text) => text.into(),
        Cbor::Integer(number) => match (u64::try_from(number), i64::try_from(number)) {
            (Ok(number), _) => number.into(),
            (_, Ok(number)) => number.into(),
            _ => return Err(malformed("has a number of more than 64 bits")),
        },
        Cbor::Float(number) => match whole(number) {
            Some(integer) => integer.into(),
            None => Number::from_f64(number)
                .ok_or_else(|| {
                    Unreadable::new(RejectReason::NotFinite, "has a number that is not finite")
                })?
                .into(),
        },
        Cbor::Bytes(bytes) => match uuid::Uuid::from_slice(&bytes) {
            Ok(id) => id.to_string().into(),
            Err(_) => bytes
                .iter()
                .map(|byte| format!("{byte:02x}"))
                .collect::<String>()
                .into(),
        },
        Cbor::Array(items) => items
            .into_iter()
            .map(json)
            .collect::<Result<Vec<_>, _>>()?
            .into(),
        Cbor::Map(entries) => {
            let mut fields = Map::new();
            for (name, value) in entries {
                let name = name
                    .into_text()
                    .map_err(|_| malformed("has a name that is no text"))?;
                if fields.insert(name, json(value)?).is_some() {
                    return Err(malformed("has a name twice"));
                }
            }
            fields.into()
        }
        Cbor::Tag(_, value) => json(*value)?,
        _ => return Err(malformed("has a value that JSON does not have")),
    })
}
