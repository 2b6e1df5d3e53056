//! Collective perception messages of strangers: what is taken is a valid report, and can be sent on.

#![no_main]

use std::collections::BTreeSet;

use ecod::model::names::NodeName;
use ecod::model::origin::GeographicOrigin;
use ecod::wire::{Limits, ObjectReport};
use ecod_interop::cpm::{CpmCell, decode, encode_report};
use libfuzzer_sys::fuzz_target;

const ORIGIN: GeographicOrigin = GeographicOrigin {
    latitude_deg: 52.2,
    longitude_deg: 21.0,
    height_m: 113.0,
    rotation_deg: 30.0,
};

fuzz_target!(|input: &[u8]| {
    let Ok(received) = decode(input, &ORIGIN) else {
        return;
    };
    let report = ObjectReport::new(NodeName::from_static("edge"), 1, received.captured_at);
    let report = ObjectReport {
        objects: received.objects,
        ..report
    };
    assert!(report.validate(&Limits::default()).is_ok(), "{report:?}");
    let cell = CpmCell {
        origin: ORIGIN,
        vacancy_signs: BTreeSet::new(),
    };
    assert!(encode_report(&report, &cell, received.station_id).is_ok());
});
