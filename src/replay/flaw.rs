//! Faults of a line of a recording, as text.

use super::envelope::Envelope;
use crate::wire::flaw::read_json;
use crate::wire::{Flaw, Limits, RejectReason};

/// The flaw of a line that is longer than allowed.
pub(super) fn too_large(limits: &Limits) -> Flaw {
    Flaw::new(
        RejectReason::TooLarge,
        "",
        format!("is longer than {} bytes", limits.payload_bytes),
    )
}

/// The flaw of a line that was rejected for `reason` when it was decoded.
pub(super) fn of_line(text: &[u8], reason: RejectReason, limits: &Limits) -> Flaw {
    let of_envelope = || match read_json::<Envelope>(text) {
        Err((field, fault)) => Flaw::new(reason, field, fault),
        Ok(_) => Flaw::new(reason, "", ""),
    };
    Flaw::of_json(text, reason, limits).unwrap_or_else(of_envelope)
}

/// The flaw of a line whose time (of receipt or else of capture) is not confirmed by any later
/// line.
pub(super) fn of_time_ahead(is_of_receipt: bool) -> Flaw {
    let field = if is_of_receipt {
        "received_at_us"
    } else {
        "captured_at_us"
    };
    Flaw::new(
        RejectReason::FromTheFuture,
        field,
        "is ahead of most of the lines after it",
    )
}

/// The flaw of a readable line that the aggregator did not use.
pub(super) fn of_unused(reason: RejectReason) -> Flaw {
    let (field, fault) = match reason {
        RejectReason::FromTheFuture => ("captured_at_us", "is ahead of the line's time"),
        RejectReason::Stale => ("captured_at_us", "is too long before the line's time"),
        RejectReason::OutOfOrder => (
            "captured_at_us",
            "is not later than in an earlier line of this node",
        ),
        RejectReason::TooManyVehicles => ("node", "is one vehicle too many"),
        RejectReason::NotFused => ("topic", "is of an algorithm that the cell does not run"),
        _ => ("", ""),
    };
    Flaw::new(reason, field, fault)
}

#[cfg(test)]
mod tests {
    use crate::replay::read_report;
    use crate::wire::Limits;

    #[test]
    fn field_and_fault_are_named() {
        let line = |objects: &str, more: &str| {
            format!(
                r#"{{"schema":1,"node":"a","seq":1,"captured_at_us":5,"objects":[{objects}]{more}}}"#
            )
        };
        let object = |rest: &str| {
            let good = r#"{"label":"cup","confidence":0.5,"x_m":1,"y_m":2}"#;
            line(&format!(r#"{good},{{"label":"cup",{rest}}}"#), "")
        };
        for (text, flaw) in [
            (
                object(r#""confidence":0.5,"x_m":NaN,"y_m":2"#),
                "objects[1].x_m: is NaN",
            ),
            (
                object(r#""confidence":0.5,"x_m":1,"y_m":-Infinity"#),
                "objects[1].y_m: is Infinity",
            ),
            (
                object(r#""confidence":0.5,"x_m":1e9,"y_m":2"#),
                "objects[1].x_m: is out of bounds: 1000000000.0",
            ),
            (
                object(r#""confidence":0.5,"x_m":"1","y_m":2"#),
                "objects[1].x_m: invalid type: string \"1\"",
            ),
            (
                object(r#""confidence":0.5,"x_m":1"#),
                "objects[1]: missing field `y_m`",
            ),
            (
                object(r#""confidence":5,"x_m":1,"y_m":2"#),
                "objects[1].confidence: is not within 0 to 1: 5",
            ),
            (
                object(r#""confidence":0.5,"x_m":1,"y_m":2,"covariance_m2":[1,2,1]"#),
                "objects[1].covariance_m2: is no covariance: [1,2,1]",
            ),
            (
                object(r#""confidence":0.5,"x_m":1,"y_m":2,"landmark":"""#),
                "objects[1].landmark: is empty",
            ),
            (line("", r#","seen":["x",""]"#), "seen[1]: is empty"),
            (
                line("", r#","pose":{"x_m":1,"y_m":1e9,"heading_rad":0}"#),
                "pose.y_m: is out of bounds",
            ),
            (
                object(r#""confidence":0.5,"x_m":1,"y_m":2,"heading_rad":90"#),
                "objects[1].heading_rad: is beyond 2π: 90; a heading is in radians, counter-clockwise from east: is this \
                 one in degrees?",
            ),
            (
                line(
                    "",
                    r#","pose":{"x_m":1,"y_m":2,"heading_rad":0,"pitch_rad":-10}"#,
                ),
                "pose.pitch_rad: is beyond 2π: -10; an angle is in radians: is this one in degrees?",
            ),
            (
                line("", r#","view":{"range_m":60,"angle_rad":62.2}"#),
                "view.angle_rad: is beyond 2π: 62.2; an angle is in radians",
            ),
            (
                line("", r#","view":{"range_m":60,"angle_rad":-1}"#),
                "view.angle_rad: is out of bounds",
            ),
            (
                line("", r#","received_at_us":"noon""#),
                "received_at_us: invalid type: string \"noon\"",
            ),
            (
                line("", r#","topic":"reputations""#),
                "topic: is neither detections nor vote_detections",
            ),
            (
                line("", r#","topic":"detections/b""#),
                "topic: names another node than `a`",
            ),
            (
                line("", "").replace("\"schema\":1", "\"schema\":2"),
                "schema: is 2, not 1",
            ),
            (line("", "").replace("\"a\"", "\"a/b\""), "node: "),
            (
                line("", "").replace(":5,", ":1732154400.5,"),
                "captured_at_us: invalid type: floating point",
            ),
            (line("", "")[..40].into(), "EOF while parsing"),
            ("# Title".into(), "is no JSON object"),
        ] {
            let said = read_report(text.as_bytes(), &Limits::default())
                .unwrap_err()
                .to_string();
            assert!(said.starts_with(flaw), "{text}: {said}");
        }
    }
}
