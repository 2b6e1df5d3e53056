//! Prints messages of a map and of a report, one hexadecimal line each: what `make cpm-check` has another reader decode.

use ecod::model::epoch::Epoch;
use ecod::model::geometry::Covariance;
use ecod::wire::{FusedObject, GlobalMap};
use ecod_client::{GeographicOrigin, NodeName, ObjectReport, PerceivedObject, Timestamp, WirePose};
use ecod_interop::cpm::{CpmCell, EncodedCpm, ObjectIds, encode_map, encode_report};
use uuid::Uuid;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let origin = GeographicOrigin {
        latitude_deg: 52.2296756,
        longitude_deg: 21.0122287,
        height_m: 113.0,
        rotation_deg: 0.0,
    };
    let cell = CpmCell {
        origin,
        vacancy_signs: ["EMPTY".into()].into(),
    };
    let at = Timestamp(1_795_239_882_123_000);
    let labels = [
        "car",
        "bus",
        "truck",
        "van",
        "tram",
        "person",
        "bicycle",
        "motorcycle",
        "moped",
        "dog",
        "MNOP101",
        "EMPTY",
    ];
    let objects = labels.iter().zip(0_u8..).map(|(label, index)| {
        let step = f64::from(index);
        let is_full = index % 2 == 0;
        PerceivedObject {
            covariance_m2: is_full.then_some([0.04 + step, 0.01, 0.09]),
            velocity_mps: is_full.then_some([8.2 - step, -0.15]),
            heading_rad: is_full.then_some(0.3 * step),
            size_m: is_full.then_some([4.5, 1.8]),
            scores: if is_full {
                [("car".into(), 0.7), ("truck".into(), 0.25)].into()
            } else {
                Default::default()
            },
            ..PerceivedObject::new(*label, 0.93, 12.34 * step, -3.1 - step)
        }
    });
    let pose = Some(WirePose::new(10.0, 20.0, 0.0));
    let objects: Vec<_> = objects.collect();
    let report = ObjectReport {
        objects,
        pose,
        ..ObjectReport::new(NodeName::from_static("euclid"), 5, at)
    };
    print(&encode_report(&report, &cell, 1234)?);
    print(&encode_report(
        &ObjectReport {
            objects: Vec::new(),
            pose: None,
            ..report
        },
        &cell,
        u32::MAX,
    )?);
    let cars = (0..255_u8).map(|number| {
        let id = Uuid::from_u128(u128::from(number) << 112);
        let car = FusedObject::new(
            id,
            "car",
            0.8,
            f64::from(number),
            2.5,
            Covariance::isotropic(0.04),
        );
        let car = FusedObject {
            age_s: Some(0.25),
            velocity_mps: Some([0.0, 4.0]),
            ..car
        };
        let first_seen_us = Some(Timestamp(at.micros() - 700_000));
        FusedObject {
            first_seen_us,
            heading_rad: Some(1.57),
            size_m: Some([4.5, 1.8]),
            ..car
        }
    });
    let epoch = Epoch::new(1, NodeName::from_static("edge"));
    let map = GlobalMap {
        objects: cars.collect(),
        ..GlobalMap::new(&epoch, 1, at)
    };
    print(&encode_map(
        &map,
        &cell,
        77,
        &mut ObjectIds::default(),
        |_| true,
    )?);
    Ok(())
}

fn print(message: &EncodedCpm) {
    println!(
        "{}",
        message
            .bytes
            .iter()
            .map(|byte| format!("{byte:02x}"))
            .collect::<String>()
    );
}
