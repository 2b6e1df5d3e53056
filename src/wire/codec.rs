//! JSON, CBOR and compact CBOR, which are distinguished by the first byte.

use schemars::JsonSchema;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use super::compact::{self, is_compact};
use super::{
    InvalidEntry, LedgerShare, Limits, ObjectReport, Payload, RejectReason, SCHEMA_VERSION, numbers,
};
use crate::model::names::NodeName;

/// The encoding of a payload.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Encoding {
    /// Text that people and all programming languages can read; the default.
    #[default]
    Json,
    /// RFC 8949 with the same field names.
    Cbor,
    /// RFC 8949 with array indices in place of names and with rounded numbers, for slow links.
    Compact,
}

/// Encodes a payload.
///
/// # Panics
/// Does not panic for the payloads of this crate: they serialise into memory.
pub fn encode<T: Payload>(payload: &T, encoding: Encoding) -> Vec<u8> {
    payload.to_bytes(encoding)
}

#[expect(clippy::expect_used, reason = "writing to memory does not fail")]
pub(crate) fn write<T: Payload>(payload: &T, encoding: Encoding) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(512);
    match encoding {
        Encoding::Json => {
            serde_json::to_writer(&mut bytes, payload).expect("payloads serialise into memory");
        }
        Encoding::Cbor => {
            ciborium::into_writer(payload, &mut bytes).expect("payloads serialise into memory");
        }
        Encoding::Compact => compact::write(payload, &mut bytes),
    }
    bytes
}

/// Decodes any payload of a supported `schema` and checks every value in it. Invalid entries are
/// left out; [`decode_entries`] returns them.
///
/// # Errors
/// Returns the first reason found; see [`RejectReason`].
pub fn decode<T: Payload>(bytes: &[u8], limits: &Limits) -> Result<T, RejectReason> {
    decode_entries(bytes, limits).map(|(payload, _)| payload)
}

/// Decodes and checks a payload as [`decode`] does, and also returns the entries that were left
/// out.
///
/// # Errors
/// Returns the first reason found; see [`RejectReason`].
pub fn decode_entries<T: Payload>(
    bytes: &[u8],
    limits: &Limits,
) -> Result<(T, Vec<InvalidEntry>), RejectReason> {
    if bytes.len() > T::max_bytes(limits) {
        return Err(RejectReason::TooLarge);
    }
    let mut payload = T::from_bytes(bytes).map_err(|reason| match schema(bytes) {
        Some(schema) if schema != SCHEMA_VERSION => RejectReason::UnknownSchema,
        _ => reason,
    })?;
    if payload.schema() != SCHEMA_VERSION {
        return Err(RejectReason::UnknownSchema);
    }
    payload.check(limits)?;
    let invalid = payload.remove_invalid();
    Ok((payload, invalid))
}

/// Decodes a report and checks every value in it; `topic_node` is the node named by its topic.
///
/// # Errors
/// Returns the first reason found; see [`RejectReason`].
pub fn decode_report(
    bytes: &[u8],
    topic_node: &NodeName,
    limits: &Limits,
) -> Result<ObjectReport, RejectReason> {
    decode_from(bytes, topic_node, limits, |report: &ObjectReport| {
        &report.node
    })
}

/// Decodes a share and checks every value in it; `topic_node` is the node named by its topic.
///
/// # Errors
/// Returns the first reason found; see [`RejectReason`].
pub fn decode_share(
    bytes: &[u8],
    topic_node: &NodeName,
    limits: &Limits,
) -> Result<LedgerShare, RejectReason> {
    decode_from(bytes, topic_node, limits, |share: &LedgerShare| &share.node)
}

fn decode_from<T: Payload>(
    bytes: &[u8],
    topic_node: &NodeName,
    limits: &Limits,
    node: impl FnOnce(&T) -> &NodeName,
) -> Result<T, RejectReason> {
    let payload = decode(bytes, limits)?;
    if node(&payload) == topic_node {
        Ok(payload)
    } else {
        Err(RejectReason::NodeMismatch)
    }
}

/// The version of a payload whose other fields cannot be read.
fn schema(bytes: &[u8]) -> Option<u32> {
    #[derive(Deserialize)]
    struct SchemaOnly {
        schema: u32,
    }

    match bytes.first() {
        Some(&first) if is_compact(first) => compact::schema(bytes),
        _ => read_named(bytes).ok().map(|SchemaOnly { schema }| schema),
    }
}

pub(crate) fn read<T: Payload>(bytes: &[u8]) -> Result<T, RejectReason> {
    match bytes.first() {
        Some(&first) if is_compact(first) => compact::read(bytes),
        _ => read_named(bytes),
    }
}

/// Reads JSON, or CBOR with names.
fn read_named<T: DeserializeOwned>(bytes: &[u8]) -> Result<T, RejectReason> {
    match bytes.first() {
        Some(b'{' | b' ' | b'\n' | b'\r' | b'\t') => {
            serde_json::from_slice(bytes).or_else(|error| {
                if error.is_data()
                    && let Some(payload) = numbers::read_json(bytes)
                {
                    return Ok(payload);
                }
                // serde_json has no other way to distinguish 1e999 from a syntax error.
                let overflow = error.to_string().starts_with("number out of range");
                let not_finite =
                    overflow || (error.is_syntax() && is_at_non_finite_word(bytes, &error));
                Err(if not_finite {
                    RejectReason::NotFinite
                } else {
                    RejectReason::Malformed
                })
            })
        }
        Some(_) => ciborium::from_reader(bytes)
            .or_else(|_| numbers::read_cbor(bytes).map_err(|unreadable| unreadable.reason)),
        None => Err(RejectReason::Malformed),
    }
}

/// True if the syntax error is at `NaN` or `Infinity`, which Python writes for numbers that are not
/// finite.
fn is_at_non_finite_word(bytes: &[u8], error: &serde_json::Error) -> bool {
    let line = bytes
        .split(|byte| *byte == b'\n')
        .nth(error.line().saturating_sub(1))
        .unwrap_or_default();
    // The column is at the first letter of the word or next to it.
    let from = line
        .get(error.column().saturating_sub(3)..)
        .unwrap_or_default();
    let around = from.get(.."-Infinity".len() + 2).unwrap_or(from);
    ["NaN", "Infinity"].iter().any(|word| {
        around
            .windows(word.len())
            .any(|part| part == word.as_bytes())
    })
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use proptest::{collection, option};

    use super::*;
    use crate::model::geometry::TURN_BOUND_RAD;
    use crate::model::time::Timestamp;
    use crate::wire::{FieldOfView, Flaw, PerceivedObject, Reputations, WirePose};

    fn node() -> NodeName {
        NodeName::new("euclid").unwrap()
    }

    fn report() -> ObjectReport {
        ObjectReport {
            pose: Some(WirePose::new(0.61, 0.46, 2.88)),
            objects: vec![PerceivedObject {
                covariance_m2: Some([0.0004, 0.0, 0.0001]),
                landmark: Some("slot-0".into()),
                ..PerceivedObject::new("ABCD123", 0.93, 0.25, 0.48)
            }],
            seen: Some(vec!["slot-0".into(), "slot-1".into()]),
            ..ObjectReport::new(node(), 412, Timestamp(1_732_154_400_123_456))
        }
    }

    /// The reason for which a report is rejected; it is equal in all encodings.
    fn reason(report: &ObjectReport) -> Option<RejectReason> {
        let cbor =
            decode_report(&encode(report, Encoding::Cbor), &node(), &Limits::default()).err();
        let compact = decode_report(
            &encode(report, Encoding::Compact),
            &node(),
            &Limits::default(),
        )
        .err();
        assert_eq!(compact, cbor);
        let finite = report
            .objects
            .iter()
            .all(|o| o.x_m.is_finite() && o.confidence.is_finite());
        // JSON cannot represent NaN and infinities.
        if finite
            && report.pose.is_none_or(|pose| {
                pose.heading_rad.is_finite() && pose.pitch_rad.is_none_or(f64::is_finite)
            })
        {
            let json =
                decode_report(&encode(report, Encoding::Json), &node(), &Limits::default()).err();
            assert_eq!(json, cbor);
        }
        cbor
    }

    #[test]
    fn report_flaws_have_reasons() {
        type Flaw = (fn(&mut ObjectReport), RejectReason);
        let flaws: [Flaw; 27] = [
            (|r| r.schema = 2, RejectReason::UnknownSchema),
            (|r| r.schema = 0, RejectReason::UnknownSchema),
            (
                |r| r.node = NodeName::new("gauss").unwrap(),
                RejectReason::NodeMismatch,
            ),
            (
                |r| r.objects = vec![r.objects[0].clone(); 1025],
                RejectReason::TooManyObjects,
            ),
            (
                |r| r.seen = Some(vec!["a".into(); 1025]),
                RejectReason::TooManyObjects,
            ),
            (|r| r.objects[0].x_m = f64::NAN, RejectReason::NotFinite),
            (
                |r| r.objects[0].x_m = f64::INFINITY,
                RejectReason::NotFinite,
            ),
            (|r| r.objects[0].x_m = 1e9, RejectReason::NotFinite),
            (
                |r| r.pose = Some(WirePose::new(0.0, 0.0, f64::NAN)),
                RejectReason::NotFinite,
            ),
            (
                |r| r.pose.as_mut().unwrap().height_m = Some(-0.1),
                RejectReason::OutOfRange,
            ),
            (
                |r| r.pose.as_mut().unwrap().pitch_rad = Some(f64::NAN),
                RejectReason::NotFinite,
            ),
            (
                |r| r.pose.as_mut().unwrap().roll_rad = Some(1e9),
                RejectReason::OutOfRange,
            ),
            (
                |r| r.objects[0].covariance_m2 = Some([-1.0, 0.0, 1.0]),
                RejectReason::NotFinite,
            ),
            (
                |r| r.objects[0].covariance_m2 = Some([1.0, 2.0, 1.0]),
                RejectReason::NotFinite,
            ),
            (
                |r| r.objects[0].confidence = 2.0,
                RejectReason::ConfidenceOutOfRange,
            ),
            (
                |r| r.objects[0].confidence = -0.1,
                RejectReason::ConfidenceOutOfRange,
            ),
            (
                |r| r.objects[0].confidence = f64::NAN,
                RejectReason::NotFinite,
            ),
            (
                |r| r.objects[0].label = "".into(),
                RejectReason::InvalidLabel,
            ),
            (
                |r| r.objects[0].label = "x".repeat(65).into(),
                RejectReason::InvalidLabel,
            ),
            (
                |r| r.objects[0].landmark = Some("a\nb".into()),
                RejectReason::InvalidLabel,
            ),
            (
                |r| r.seen = Some(vec!["".into()]),
                RejectReason::InvalidLabel,
            ),
            (
                |r| r.objects[0].velocity_mps = Some([1e9, 0.0]),
                RejectReason::OutOfRange,
            ),
            (
                |r| r.objects[0].heading_rad = Some(1e9),
                RejectReason::OutOfRange,
            ),
            (
                |r| r.objects[0].size_m = Some([0.0, -1.0]),
                RejectReason::OutOfRange,
            ),
            (
                |r| r.objects[0].scores = [("cup".into(), 2.0)].into(),
                RejectReason::ConfidenceOutOfRange,
            ),
            (
                |r| {
                    r.view = Some(FieldOfView {
                        range_m: -1.0,
                        angle_rad: 1.0,
                    });
                },
                RejectReason::OutOfRange,
            ),
            (
                |r| {
                    r.view = Some(FieldOfView {
                        range_m: 1.0,
                        angle_rad: 1e9,
                    });
                },
                RejectReason::OutOfRange,
            ),
        ];
        assert_eq!(reason(&report()), None);
        for (index, (spoil, expected)) in flaws.into_iter().enumerate() {
            let mut report = report();
            spoil(&mut report);
            assert_eq!(reason(&report), Some(expected), "flaw {index}");
        }
    }

    fn decoded(bytes: &[u8]) -> Result<ObjectReport, RejectReason> {
        decode_report(bytes, &node(), &Limits::default())
    }

    /// CBOR with names, of JSON.
    fn cbor(json: &serde_json::Value) -> Vec<u8> {
        let mut bytes = Vec::new();
        ciborium::into_writer(json, &mut bytes).unwrap();
        bytes
    }

    #[test]
    fn number_formats_of_languages_are_read() {
        let mut expected = report();
        expected.objects[0].x_m = 8.0;
        expected.objects[0].confidence = 1.0;
        expected.objects[0].covariance_m2 = Some([1.0, 0.0, 1.0]);
        let strict: serde_json::Value =
            serde_json::from_slice(&encode(&expected, Encoding::Json)).unwrap();
        let mut integers = strict.clone();
        numbers::use_integers(&mut integers);
        assert!(integers["objects"][0]["x_m"].is_i64());
        let mut floats = strict.clone();
        for field in ["schema", "seq", "captured_at_us"] {
            let number = floats[field].as_u64().unwrap();
            floats[field] = (number as f64).into();
        }
        for payload in [strict, integers, floats] {
            assert_eq!(decoded(&cbor(&payload)), Ok(expected.clone()), "{payload}");
            let text = payload.to_string();
            assert_eq!(decoded(text.as_bytes()), Ok(expected.clone()), "{payload}");
        }
        let mut compact: ciborium::Value =
            ciborium::from_reader(&*encode(&expected, Encoding::Compact)).unwrap();
        let captured_at = &mut compact.as_array_mut().unwrap()[3];
        let micros = i128::from(captured_at.as_integer().unwrap());
        *captured_at = ciborium::Value::Float(micros as f64);
        let mut bytes = Vec::new();
        ciborium::into_writer(&compact, &mut bytes).unwrap();
        let written = encode(&expected, Encoding::Compact);
        assert!(decoded(&written).is_ok());
        assert_eq!(decoded(&bytes), decoded(&written));
    }

    #[test]
    fn duplicate_field_is_refused() {
        let text = String::from_utf8(encode(&report(), Encoding::Json)).unwrap();
        let twice = text.replacen("\"seq\":", "\"seq\":5.0,\"seq\":", 1);
        assert_ne!(twice, text);
        assert_eq!(decoded(twice.as_bytes()), Err(RejectReason::Malformed));
    }

    #[test]
    fn number_fault_names_its_field() {
        let json: serde_json::Value =
            serde_json::from_slice(&encode(&report(), Encoding::Json)).unwrap();
        let mut half = json.clone();
        half["seq"] = 5.5.into();
        let mut text = json.clone();
        text["objects"][0]["x_m"] = "8".into();
        for (payload, field) in [(half, "seq"), (text, "objects[0].x_m")] {
            for bytes in [cbor(&payload), payload.to_string().into_bytes()] {
                assert_eq!(decoded(&bytes), Err(RejectReason::Malformed));
                let flaw = Flaw::of_report(&bytes, RejectReason::Malformed, &Limits::default());
                assert_eq!(flaw.field, field, "{flaw}");
                assert!(flaw.fault.contains("invalid type"), "{flaw}");
            }
        }
    }

    #[test]
    fn payload_flaws_have_reasons() {
        let json = String::from_utf8(encode(&report(), Encoding::Json)).unwrap();
        let mut not_utf8 = json.clone().into_bytes();
        not_utf8[json.find("ABCD").unwrap()] = 0xff;
        let cbor = encode(&report(), Encoding::Cbor);
        let compact = encode(&report(), Encoding::Compact);
        let table: Vec<(Vec<u8>, RejectReason)> = vec![
            (vec![], RejectReason::Malformed),
            (
                json.as_bytes()[..json.len() - 1].to_vec(),
                RejectReason::Malformed,
            ),
            (cbor[..cbor.len() - 1].to_vec(), RejectReason::Malformed),
            (
                compact[..compact.len() - 1].to_vec(),
                RejectReason::Malformed,
            ),
            ([&*compact, &[0]].concat(), RejectReason::Malformed),
            (vec![0x80], RejectReason::Malformed),
            (vec![0x82, 2, 0xf6], RejectReason::UnknownSchema),
            (not_utf8, RejectReason::Malformed),
            (b"null".to_vec(), RejectReason::Malformed),
            (
                json.replace("\"seq\":412,", "").into(),
                RejectReason::Malformed,
            ),
            (
                json.replace("\"seq\":412", "\"seq\":-1").into(),
                RejectReason::Malformed,
            ),
            (
                json.replace("\"euclid\"", "\"a/b\"").into(),
                RejectReason::Malformed,
            ),
            (
                json.replace("0.25", "1e999").into(),
                RejectReason::NotFinite,
            ),
            (json.replace("0.25", "NaN").into(), RejectReason::NotFinite),
            (
                json.replace("0.25", "\n -Infinity").into(),
                RejectReason::NotFinite,
            ),
            (
                json.replace("0.25", " Infinity").into(),
                RejectReason::NotFinite,
            ),
            (json.replace("0.25", "nan").into(), RejectReason::Malformed),
            (b"{\"schema\":2}".to_vec(), RejectReason::UnknownSchema),
            (
                vec![b' '; Limits::default().payload_bytes + 1],
                RejectReason::TooLarge,
            ),
        ];
        for (payload, expected) in table {
            let decoded = decode_report(&payload, &node(), &Limits::default());
            assert_eq!(
                decoded,
                Err(expected),
                "{:?}",
                String::from_utf8_lossy(&payload[..payload.len().min(99)])
            );
        }
    }

    #[test]
    fn compact_vote_object_fits_40_bytes() {
        let object = |x_m: f64, y_m: f64| PerceivedObject {
            covariance_m2: Some([0.0123, -0.0045, 0.0678]),
            landmark: Some("slot-31".into()),
            ..PerceivedObject::new("ABCD123", 0.931, x_m, y_m)
        };
        // A coordinate takes the same bytes from 65.536 m to 4,294 km.
        for (x_m, y_m) in [
            (65.537, -65.538),
            (-48_211.007, 90_310.12),
            (4_294_967.0, -4_294_967.0),
        ] {
            let with = |objects| ObjectReport {
                objects: vec![object(x_m, y_m); objects],
                ..report()
            };
            let [ten, eleven] =
                [10, 11].map(|objects| encode(&with(objects), Encoding::Compact).len());
            assert!(eleven - ten <= 40, "{} bytes at {x_m}, {y_m}", eleven - ten);
        }
    }

    #[test]
    fn unknown_fields_are_accepted() {
        let text = r#" {"schema":1,"node":"euclid","seq":1,"captured_at_us":5,"pose":null,"objects":[],"mood":[1e3]}"#;
        let report = decode_report(text.as_bytes(), &node(), &Limits::default()).unwrap();
        assert_eq!((report.pose, report.seen), (None, None));
    }

    #[test]
    fn unknown_versions_are_rejected() {
        let text = br#"{"schema":2,"epoch":1,"round":1,"reputations":{}}"#;
        assert_eq!(
            decode::<Reputations>(text, &Limits::default()),
            Err(RejectReason::UnknownSchema)
        );
    }

    prop_compose! {
        fn object()(
            label in "[a-zA-Z0-9 é]{1,20}",
            confidence in 0.0..=1.0f64,
            (x_m, y_m) in (-1e8..1e8f64, -1e8..1e8f64),
            variances in option::of((1e-6..1e6f64, 1e-6..1e6f64, -1.0..=1.0f64)),
            landmark in option::of("[a-z0-9-]{1,64}"),
            velocity_mps in option::of([-1e4..1e4f64, -1e4..1e4f64]),
            (heading_rad, size_m) in (option::of(-TURN_BOUND_RAD..TURN_BOUND_RAD), option::of([0.0..1e5f64, 0.0..1e5f64])),
            scores in collection::btree_map("[a-z]{1,8}".prop_map(Into::into), 0.0..=1.0f64, 0..4),
        ) -> PerceivedObject {
            PerceivedObject { covariance_m2: variances.map(|(xx, yy, correlation)| [xx, correlation * (xx * yy).sqrt(), yy]), landmark: landmark.map(Into::into), velocity_mps, heading_rad, size_m, scores, ..PerceivedObject::new(label, confidence, x_m, y_m) }
        }
    }

    prop_compose! {
        fn reports()(
            (seq, captured_at) in (any::<u64>(), any::<u64>()),
            pose in option::of((-1e8..1e8f64, -1e8..1e8f64, -TURN_BOUND_RAD..TURN_BOUND_RAD)),
            objects in collection::vec(object(), 0..20),
            seen in option::of(collection::vec("[a-z]{1,8}", 0..5)),
        ) -> ObjectReport {
            ObjectReport { pose: pose.map(|(x_m, y_m, heading_rad)| WirePose::new(x_m, y_m, heading_rad)), objects, seen: seen.map(|ids| ids.into_iter().map(Into::into).collect()), ..ObjectReport::new(node(), seq, Timestamp(captured_at)) }
        }
    }

    /// True if a number was rounded to no less than 11 significant bits.
    fn near(read: f64, written: f64) -> bool {
        (read - written).abs() <= written.abs() / 2048.0
    }

    proptest! {
        #[test]
        fn what_is_encoded_is_decoded(report in reports()) {
            for encoding in [Encoding::Json, Encoding::Cbor] {
                let decoded = decode_report(&encode(&report, encoding), &node(), &Limits::default());
                prop_assert_eq!(decoded.as_ref(), Ok(&report));
            }
        }

        #[test]
        fn compact_loss_stays_within_promise(report in reports()) {
            let bytes = encode(&report, Encoding::Compact);
            let decoded = decode_report(&bytes, &node(), &Limits::default()).unwrap();
            prop_assert_eq!((decoded.seq, decoded.captured_at_us, &decoded.seen), (report.seq, report.captured_at_us, &report.seen));
            prop_assert_eq!(decoded.objects.len(), report.objects.len());
            for (read, written) in decoded.objects.iter().zip(&report.objects) {
                prop_assert_eq!((&read.label, &read.landmark), (&written.label, &written.landmark));
                prop_assert!((read.x_m - written.x_m).abs() <= 0.000_501 && (read.y_m - written.y_m).abs() <= 0.000_501);
                prop_assert!(near(read.confidence, written.confidence));
                prop_assert!(read.scores.keys().eq(written.scores.keys()));
                prop_assert!(read.scores.values().zip(written.scores.values()).all(|(&read, &written)| near(read, written)));
                let pairs = read.velocity_mps.into_iter().chain(read.size_m).flatten();
                let originals = written.velocity_mps.into_iter().chain(written.size_m).flatten();
                prop_assert!(pairs.zip(originals).all(|(read, written)| near(read, written)));
                prop_assert!(near(read.heading_rad.unwrap_or(0.0), written.heading_rad.unwrap_or(0.0)));
                if let (Some([xx, xy, yy]), Some(of)) = (read.covariance_m2, written.covariance_m2) {
                    prop_assert!(xx >= of[0] && xy.abs() <= of[1].abs() && yy >= of[2], "certainty is gained");
                    prop_assert!((xx - of[0]) <= of[0] / 1024.0 && (yy - of[2]) <= of[2] / 1024.0);
                }
            }
            prop_assert_eq!(encode(&decoded, Encoding::Compact), bytes);
        }

        #[test]
        fn no_bytes_panic(
            bytes in collection::vec(any::<u8>(), 0..300),
            report in reports(),
            cut in any::<prop::sample::Index>(),
            flip in any::<u8>(),
        ) {
            let mut spoiled = encode(&report, [Encoding::Json, Encoding::Cbor, Encoding::Compact][usize::from(flip % 3)]);
            let at = cut.index(spoiled.len());
            spoiled[at] ^= flip;
            for payload in [&bytes, &spoiled] {
                if let Ok(accepted) = decode_report(payload, &node(), &Limits::default()) {
                    prop_assert_eq!(accepted.validate(&Limits::default()), Ok(()));
                }
            }
        }
    }
}
