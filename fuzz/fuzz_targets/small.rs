//! Whatever else is read: poses, recorded detections, signed payloads and rounds, certificates, files of state and of truth.
//!
//! The first byte of an input chooses what the rest is.

#![no_main]

use std::sync::LazyLock;

use ecod::model::detection::parse_detections;
use ecod::model::origin::GeographicOrigin;
use ecod::model::time::Timestamp;
use ecod_actors::actors::reputation_keeper::read_saved;
use ecod_actors::camera::vehicle_pose::read_pose;
use ecod_actors::node::config::NodeConfig;
use ecod_actors::platform::secret::Secret;
use ecod_actors::transport::mqtt::{Security, splits_as_appended};
use ecod_actors::transport::pki::CertificateSubject;
use ecod_lab::eval::Truth;
use ecod_lab::eval::tracks::TrackTruth;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|input: &[u8]| {
    let Some((kind, bytes)) = input.split_first() else {
        return;
    };
    let text = std::str::from_utf8(bytes).unwrap_or_default();
    match kind % 7 {
        0 => {
            if let Ok((_, stated)) = read_pose(bytes, Timestamp(0), 0)
                && let Ok(pose) = stated.in_map(Some(&ORIGIN))
            {
                assert!(
                    pose.position.x.is_finite()
                        && pose.position.y.is_finite()
                        && pose.heading_rad.is_finite()
                );
            }
        }
        1 => {
            let detections = parse_detections(text).unwrap_or_default();
            assert!(
                detections
                    .iter()
                    .all(|detection| detection.bounding_box.is_valid())
            );
        }
        2 => assert!(SIGNING.rejects_forgery("ecod/lot-1/detections/euclid", bytes)),
        3 => read_saved(bytes),
        4 => drop((
            Truth::parse(text),
            TrackTruth::is_in(text),
            TrackTruth::parse(text),
        )),
        5 => assert!(splits_as_appended(bytes)),
        _ => drop(CertificateSubject::of(bytes)),
    }
});

const ORIGIN: GeographicOrigin = GeographicOrigin {
    latitude_deg: 52.2,
    longitude_deg: 21.0,
    height_m: 113.0,
    rotation_deg: 30.0,
};

/// Of a cell that signs, by 64 hexadecimal digits, which need no stretching.
static SIGNING: LazyLock<Security> = LazyLock::new(|| {
    let mut config = NodeConfig::default();
    config.mqtt.sign = true;
    config.membership.key = Some(Secret::new("01".repeat(32)));
    config.security().expect("the key is a key")
});
