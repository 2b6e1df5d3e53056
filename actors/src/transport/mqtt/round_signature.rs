//! Signatures of leaders on their rounds, with which receivers can accept the rounds over another
//! node's broker.
//!
//! The signature is the last field of the payload, [`FIELD`], in any encoding. It covers all bytes
//! before its value and the topic. Receivers of earlier versions ignore the field.
//!
//! ```text
//! JSON     {…,"signature":" | base64 | "}
//! CBOR     map of one more, …, text "signature" | bytes
//! compact  array of PLACE + 1, …, nulls | bytes
//! ```

use base64::Engine;
use base64::engine::general_purpose::STANDARD as BASE64;

/// Name of the field.
const FIELD: &str = "signature";

/// Place of the field in the compact encoding of every round, after the places of all other fields.
const PLACE: u8 = 15;

/// First byte of CBOR maps and arrays; the low bits hold a count of up to [`MAX_COUNT`].
const MAP: u8 = 0xa0;
const ARRAY: u8 = 0x80;
const MAX_COUNT: u8 = 23;

const NULL: u8 = 0xf6;

/// CBOR bytes with a length of one byte, and the beginning of a signature in DER.
const BYTES: u8 = 0x58;
const SEQUENCE: u8 = 0x30;

/// Lengths that a signature by ECDSA P-256 has in DER, all but once in 2⁵⁰.
const SIGNATURE_BYTES: std::ops::RangeInclusive<u8> = 64..=72;

/// Beginning of the signed text; no TLS signature begins like this, so that the key can serve both.
const LABEL: &[u8] = b"ecod round 1\0";

/// The text that is signed for the bytes before a signature.
pub(super) fn statement(topic: &[u8], signed: &[u8]) -> Vec<u8> {
    [LABEL, &(topic.len() as u64).to_be_bytes(), topic, signed].concat()
}

/// Appends a signature to a round's payload. `None` if `sign` returns none, or the payload does not
/// belong to a round.
pub(super) fn append(
    payload: &[u8],
    sign: impl FnOnce(&[u8]) -> Option<Vec<u8>>,
) -> Option<Vec<u8>> {
    let (&first, rest) = payload.split_first()?;
    let (mut signed, is_text) = match first {
        b'{' => (
            [
                payload.strip_suffix(b"}")?,
                format!(",\"{FIELD}\":\"").as_bytes(),
            ]
            .concat(),
            true,
        ),
        MAP.. if first < MAP + MAX_COUNT => ([&[first + 1], rest, &name()].concat(), false),
        ARRAY.. if first <= ARRAY + PLACE => {
            let missing = usize::from(ARRAY + PLACE - first);
            (
                [&[ARRAY + PLACE + 1], rest, &vec![NULL; missing]].concat(),
                false,
            )
        }
        _ => return None,
    };
    let signature = sign(&signed)?;
    if is_text {
        signed.extend(format!("{}\"}}", BASE64.encode(signature)).into_bytes());
    } else {
        signed.extend([BYTES, u8::try_from(signature.len()).ok()?]);
        signed.extend(signature);
    }
    Some(signed)
}

/// The signed bytes and the signature of a payload, if it has one.
pub(super) fn split(payload: &[u8]) -> Option<(&[u8], Vec<u8>)> {
    if let Some(text) = payload.strip_suffix(b"\"}") {
        let at = text.iter().rposition(|byte| *byte == b'"')? + 1;
        let (signed, signature) = text.split_at_checked(at)?;
        let is_field = signed.ends_with(format!(",\"{FIELD}\":\"").as_bytes());
        return is_field
            .then(|| BASE64.decode(signature).ok())
            .flatten()
            .map(|signature| (signed, signature));
    }
    SIGNATURE_BYTES.rev().find_map(|length| {
        let (signed, value) =
            payload.split_at_checked(payload.len().checked_sub(usize::from(length) + 2)?)?;
        let signature = value.strip_prefix(&[BYTES, length])?;
        signature
            .starts_with(&[SEQUENCE, length - 2])
            .then(|| (signed, signature.to_vec()))
    })
}

/// True if a signature comes off arbitrary bytes as it was put on. Only built for the fuzz targets.
#[cfg(fuzzing)]
pub fn splits_as_appended(bytes: &[u8]) -> bool {
    drop(split(bytes));
    let length = *SIGNATURE_BYTES.end();
    let signature = [
        &[SEQUENCE, length - 2],
        &vec![0x5a; usize::from(length) - 2][..],
    ]
    .concat();
    let mut signed = Vec::new();
    let appended = append(bytes, |statement| {
        signed = statement.to_vec();
        Some(signature.clone())
    });
    appended.is_none_or(|appended| split(&appended) == Some((&signed[..], signature)))
}

/// The field's name in CBOR.
fn name() -> Vec<u8> {
    const TEXT: u8 = 0x60;
    [&[TEXT + FIELD.len() as u8], FIELD.as_bytes()].concat()
}

#[cfg(test)]
mod tests {
    use ecod::model::epoch::Epoch;
    use ecod::model::names::NodeName;
    use ecod::model::time::Timestamp;
    use ecod::wire::{Encoding, GlobalMap, Limits, Reputations, Verdicts, decode, encode};

    use super::*;

    fn signature(length: u8) -> Vec<u8> {
        [
            &[SEQUENCE, length - 2],
            &vec![0x5a; usize::from(length) - 2][..],
        ]
        .concat()
    }

    fn map() -> GlobalMap {
        GlobalMap::new(
            &Epoch::new(7, NodeName::from_static("edge")),
            88,
            Timestamp(5),
        )
    }

    #[test]
    fn signed_round_stays_readable() {
        let verdicts = Verdicts::new(
            &Epoch::new(7, NodeName::from_static("edge")),
            88,
            Timestamp(5),
            Vec::new(),
        );
        let reputations = Reputations {
            schema: 1,
            aggregator: None,
            epoch: 7,
            round: 88,
            reputations: Default::default(),
        };
        for encoding in [Encoding::Json, Encoding::Cbor, Encoding::Compact] {
            let rounds = [
                encode(&map(), encoding),
                encode(&verdicts, encoding),
                encode(&reputations, encoding),
            ];
            for length in SIGNATURE_BYTES {
                for (kind, payload) in rounds.iter().enumerate() {
                    let mut statement = Vec::new();
                    let signed = append(payload, |bytes| {
                        statement = bytes.to_vec();
                        Some(signature(length))
                    });
                    let signed = signed.unwrap();
                    assert_eq!(
                        split(&signed),
                        Some((&statement[..], signature(length))),
                        "{encoding:?} {kind}"
                    );
                    let limits = Limits::default();
                    match kind {
                        0 => assert_eq!(decode(&signed, &limits), Ok(map())),
                        1 => assert_eq!(decode(&signed, &limits).as_ref(), Ok(&verdicts)),
                        _ => assert_eq!(decode(&signed, &limits).as_ref(), Ok(&reputations)),
                    }
                    assert_eq!(split(payload), None, "unsigned");
                }
            }
        }
    }

    #[test]
    fn no_bytes_panic() {
        let whole = append(&encode(&map(), Encoding::Json), |_| Some(signature(70))).unwrap();
        for end in 0..whole.len() {
            let _ = split(&whole[..end]);
        }
        for bytes in [
            &b""[..],
            b"\"}",
            b"\"\"}",
            b"{",
            b"}",
            &[MAP + MAX_COUNT],
            &[ARRAY + PLACE + 1],
            &[0xff],
        ] {
            assert_eq!(split(bytes), None, "{bytes:?}");
            assert_eq!(append(bytes, |_| Some(signature(70))), None, "{bytes:?}");
        }
    }
}
