use std::collections::BTreeSet;
use std::time::Duration;

use proptest::collection::vec;
use proptest::prelude::*;
use uuid::Uuid;

use super::*;
use crate::model::epoch::Epoch;
use crate::model::geometry::Covariance;
use crate::model::origin::GeographicPosition;
use crate::wire::{RegionTopicKind, SCHEMA_VERSION};

const START: Timestamp = Timestamp(1_800_000_000_000_000);

const HOME: GeographicOrigin = GeographicOrigin {
    latitude_deg: 48.137,
    longitude_deg: 11.575,
    height_m: 520.0,
    rotation_deg: 0.0,
};

fn ms(ms: u64) -> Timestamp {
    START + Duration::from_millis(ms)
}

fn name(node: &str) -> NodeName {
    NodeName::new(node).unwrap()
}

/// Origin of a cell so far east of home, whose axes are turned.
fn beside(east_m: f64, rotation_deg: f64) -> GeographicOrigin {
    let GeographicPosition {
        latitude_deg,
        longitude_deg,
        height_m,
    } = HOME.to_wgs84(east_m, 0.0, 0.0);
    GeographicOrigin {
        latitude_deg,
        longitude_deg,
        height_m,
        rotation_deg,
    }
}

fn object(number: u128, x_m: f64, y_m: f64) -> FusedObject {
    FusedObject::new(
        Uuid::from_u128(number),
        "car",
        0.9,
        x_m,
        y_m,
        Covariance::isotropic(0.5),
    )
}

/// A map of a cell 200 m to the east, fused and sent at `at` by its own clock.
fn map(epoch: u64, leader: &str, round: u64, at: Timestamp, objects: Vec<FusedObject>) -> CellMap {
    let map = GlobalMap {
        objects,
        ..GlobalMap::new(&Epoch::new(epoch, name(leader)), round, at)
    };
    CellMap {
        schema: SCHEMA_VERSION,
        cell: name("east"),
        sent_at_us: at,
        origin: beside(200.0, 90.0),
        map,
    }
}

fn topic(cell: &str, origin: &GeographicOrigin) -> RegionTopic {
    RegionTopic {
        tile: Quadkey::of_cell(origin),
        cell: name(cell),
        kind: RegionTopicKind::Map,
    }
}

fn east() -> RegionTopic {
    topic("east", &beside(200.0, 90.0))
}

/// The neighbours of home, whose own map reaches 150 m to the east.
fn home() -> Neighbours {
    let mut neighbours = Neighbours::new(name("home"), HOME);
    let own = map(
        1,
        "edge",
        1,
        ms(0),
        vec![object(1, 0.0, 0.0), object(2, 150.0, 0.0)],
    )
    .map;
    neighbours.observe_own(&own, ms(0));
    neighbours
}

/// Maps of one leader ten times a second from `from` to `to` that take 50 ms.
fn live(neighbours: &mut Neighbours, from: u64, to: u64) {
    for round in from / 100..to / 100 {
        let message = map(
            1,
            "a",
            round + 1,
            ms(100 * round),
            vec![object(7, 0.0, 0.0)],
        );
        let _ = neighbours.accept(&east(), message, ms(100 * round + 50));
    }
}

#[test]
fn objects_keep_positions_on_earth() {
    let mut neighbours = home();
    live(&mut neighbours, 0, 2000);
    let theirs = FusedObject {
        velocity_mps: Some([10.0, 0.0]),
        heading_rad: Some(0.0),
        covariance_m2: [4.0, 0.0, 1.0],
        first_seen_us: Some(ms(1000)),
        ..object(8, 30.0, 20.0)
    };
    neighbours
        .accept(&east(), map(1, "a", 100, ms(2000), vec![theirs]), ms(2060))
        .unwrap();
    let near = neighbours.near(ms(2160));
    let NeighbourObject {
        cell,
        age_s,
        object,
    } = &near[0];
    // Their x axis points north.
    let expected = HOME.to_map(&beside(200.0, 90.0).to_wgs84(30.0, 20.0, 0.0));
    assert!(
        (expected.x - 180.0).abs() < 0.01 && (expected.y - 30.0).abs() < 0.01,
        "{expected}"
    );
    assert!(
        (object.x_m - expected.x).hypot(object.y_m - expected.y) < 1e-6,
        "{object:?}"
    );
    let [east, north] = object.velocity_mps.unwrap();
    assert!(east.abs() < 0.01 && (north - 10.0).abs() < 0.01);
    assert!((object.heading_rad.unwrap() - std::f64::consts::FRAC_PI_2).abs() < 1e-3);
    let [xx, xy, yy] = object.covariance_m2;
    assert!((xx - 1.0).abs() < 0.01 && xy.abs() < 0.01 && (yy - 4.0).abs() < 0.01);
    assert_eq!((cell.as_str(), near.len()), ("east", 1));
    // 10 ms longer on its way than the fastest, and then 100 ms here.
    assert!((age_s - 0.11).abs() < 1e-6, "{age_s}");
    assert_eq!(
        object.first_seen_us,
        Some(ms(1050)),
        "by this cell's clock, 50 ms after theirs"
    );
}

#[test]
fn only_tile_and_nearby_objects_pass() {
    let mut neighbours = home();
    live(&mut neighbours, 0, 2000);
    let objects = vec![
        object(1, 0.0, 0.0),
        object(2, 0.0, 3000.0),
        object(3, 1e5, 1e5),
        object(4, 0.0, -150.0),
    ];
    neighbours
        .accept(&east(), map(1, "a", 100, ms(2000), objects), ms(2050))
        .unwrap();
    let ids: Vec<u128> = neighbours
        .near(ms(2050))
        .iter()
        .map(|near| near.object.id.as_u128())
        .collect();
    assert_eq!(ids, [1], "the last one is true and too far away");
    assert_eq!(
        neighbours.losses()[&name("east")],
        NeighbourLosses {
            outside: 2,
            refused: 0
        }
    );
    let elsewhere = topic("east", &beside(20_000.0, 0.0));
    for wrong in [elsewhere, topic("west", &beside(200.0, 90.0))] {
        let taken = neighbours.accept(&wrong, map(1, "a", 101, ms(2100), Vec::new()), ms(2150));
        assert_eq!(taken, Err(RejectReason::NodeMismatch));
    }
    assert!(neighbours.tiles().contains(&east().tile) && neighbours.tiles().len() == 9);
}

#[test]
fn nearest_objects_fit_first() {
    let mut neighbours = home();
    live(&mut neighbours, 0, 2000);
    let crowd = (0..2000).map(|number| object(number, 0.0, -0.02 * number as f64));
    neighbours
        .accept(
            &east(),
            map(1, "a", 100, ms(2000), crowd.collect()),
            ms(2050),
        )
        .unwrap();
    let near = neighbours.near(ms(2050));
    assert_eq!(
        (near.len(), neighbours.losses()[&name("east")].refused),
        (MAX_OBJECTS_EACH, 2000 - MAX_OBJECTS_EACH as u64)
    );
    assert!(
        near.iter()
            .all(|near| near.object.id.as_u128() < MAX_OBJECTS_EACH as u128)
    );
}

#[test]
fn maps_order_by_epoch_and_round() {
    let mut neighbours = home();
    live(&mut neighbours, 0, 2000);
    let mut taken = |epoch, leader, round, at| {
        let message = map(epoch, leader, round, ms(at), vec![object(7, 0.0, 0.0)]);
        neighbours.accept(&east(), message, ms(at + 50))
    };
    assert_eq!(taken(1, "a", 20, 2000), Err(RejectReason::OutOfOrder));
    // A new leader's clock is unknown, and the cell's time continues.
    assert_eq!(taken(2, "b", 1, 2100), Ok(()));
    assert_eq!(taken(1, "a", 99, 2200), Err(RejectReason::Superseded));
    assert_eq!(taken(2, "b", 2, 2300), Ok(()));
}

#[test]
fn time_jump_costs_no_map() {
    let mut neighbours = home();
    live(&mut neighbours, 0, 2000);
    for (round, jump_us) in [
        (100, -60_000_000),
        (101, -60_000_000),
        (102, 60_000_000),
        (103, 0),
    ] {
        let at = ms(100 * (round - 80));
        let mut message = map(1, "a", round, at, Vec::new());
        message.map.fused_at_us = at.shifted(jump_us);
        assert_eq!(
            neighbours.accept(&east(), message, at + Duration::from_millis(50)),
            Ok(()),
            "{jump_us}"
        );
    }
}

/// A minute without a link, in which the lead moves; then all that was sent meanwhile comes within
/// two seconds.
#[test]
fn delayed_maps_are_dropped() {
    for knows_before in [true, false] {
        let mut neighbours = home();
        if knows_before {
            live(&mut neighbours, 0, 5000);
        }
        let mut taken = 0;
        for sent in (5000..65_000).step_by(100) {
            let (epoch, leader) = if sent < 35_000 { (1, "a") } else { (2, "b") };
            let message = map(
                epoch,
                leader,
                sent / 100 + 1,
                ms(sent),
                vec![object(7, 0.0, 0.0)],
            );
            let received = ms(65_000 + (sent - 5000) / 30);
            let is_old = received.since(ms(sent)) > MAX_AGE + Duration::from_millis(50);
            let is_taken = neighbours.accept(&east(), message, received).is_ok();
            taken += u64::from(is_taken && is_old);
            assert!(
                neighbours
                    .near(received)
                    .iter()
                    .all(|near| near.age_s <= MAX_AGE.as_secs_f64())
            );
        }
        assert_eq!(taken, 0, "known before: {knows_before}");
        let mut live_again = None;
        for sent in (65_000..75_000).step_by(100) {
            let message = map(
                2,
                "b",
                sent / 100 + 1,
                ms(sent + 2000),
                vec![object(7, 0.0, 0.0)],
            );
            if neighbours.accept(&east(), message, ms(sent + 2050)).is_ok() {
                live_again.get_or_insert(sent - 65_000);
            }
        }
        assert!(live_again.unwrap() <= 1100, "{live_again:?}");
    }
}

/// Maps of some cells at 2 Hz for seven minutes, from the 40th second on `late_ms` later, by the
/// cell's number. Numbers of maps of each that counted in the second minute, and in the last one.
fn late_for_long(cells: u64, late_ms: impl Fn(u64) -> u64) -> [Vec<usize>; 2] {
    let mut filter = CellMapFilter::new(16);
    let mut counted = [0, 1].map(|_| vec![0; cells as usize]);
    let mut messages: Vec<_> = (0..420_000)
        .step_by(500)
        .flat_map(|sent| (0..cells).map(move |cell| (sent, cell)))
        .collect();
    let received =
        |(sent, cell): (u64, u64)| sent + 20 + if sent < 40_000 { 0 } else { late_ms(cell) };
    messages.sort_by_key(|message| received(*message));
    for (sent, cell) in messages {
        // Each clock has its own error of some seconds.
        let message = map(
            1,
            "a",
            sent / 500 + 1,
            ms(sent).shifted(3_000_000 * cell as i64),
            Vec::new(),
        );
        let message = CellMap {
            cell: name(&format!("cell-{cell}")),
            ..message
        };
        let at = received((sent, cell));
        let is_admitted = filter
            .admit(
                &topic(message.cell.as_str(), &message.origin),
                &message,
                ms(at),
            )
            .is_ok();
        for (minute, counted) in [1, 6].into_iter().zip(&mut counted) {
            counted[cell as usize] += usize::from(is_admitted && sent / 60_000 == minute);
        }
    }
    counted
}

#[test]
fn common_backlog_is_no_clock() {
    let none = [0; 4];
    let all = [120; 4];
    assert_eq!(late_for_long(4, |_| 0), [all, all]);
    assert_eq!(late_for_long(4, |_| 2000), [none, all], "all are late");
    assert_eq!(
        late_for_long(4, |_| 1000),
        [all, all],
        "younger than the limit"
    );
    let three = late_for_long(4, |cell| if cell < 3 { 2000 } else { 0 });
    assert_eq!(
        three,
        [[0, 0, 0, 120], all],
        "a cell that is not late has no backlog"
    );
    assert_eq!(
        late_for_long(4, |cell| if cell < 2 { 2000 } else { 0 }),
        [all, all],
        "two may be clocks"
    );
    assert_eq!(late_for_long(2, |_| 2000), [[120; 2], [120; 2]]);
}

#[test]
fn silent_cell_is_dropped() {
    let mut neighbours = home();
    live(&mut neighbours, 0, 2000);
    assert_eq!(neighbours.near(ms(3400)).len(), 1);
    assert_eq!(neighbours.near(ms(3600)).len(), 0);
    assert_eq!(neighbours.losses().len(), 1);
    neighbours.near(ms(70_000));
    assert_eq!(neighbours.losses().len(), 0);
}

#[test]
fn excess_cell_waits_for_silent_one() {
    let mut filter = CellMapFilter::new(1);
    let admit = |filter: &mut CellMapFilter, cell: &str, at: u64| {
        let message = CellMap {
            cell: name(cell),
            ..map(1, "a", at + 1, ms(at), Vec::new())
        };
        filter.admit(&topic(cell, &message.origin), &message, ms(at))
    };
    assert_eq!(
        admit(&mut filter, "east", 0),
        Err(RejectReason::Stale),
        "its clock is unknown yet"
    );
    assert_eq!(
        admit(&mut filter, "west", 100),
        Err(RejectReason::TooManyCells)
    );
    assert_eq!(admit(&mut filter, "west", 61_000), Err(RejectReason::Stale));
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 200, ..ProptestConfig::default() })]

    /// With any delays, duplicates and reordering, each map is used at most once and while it is
    /// recent, and each object appears once.
    #[test]
    fn any_order_keeps_objects_unique(
        delays in vec((0_u64..10, 0_u64..10_000, any::<bool>()), 200),
        offset_us in -10_000_000_i64..10_000_000,
    ) {
        let mut neighbours = home();
        let mut messages = Vec::new();
        for (number, (kind, late_ms, is_double)) in delays.into_iter().enumerate() {
            let sent = 100 * number as u64;
            // Most messages have the least delay plus some jitter, including the first ones.
            let late_ms = if kind < 7 || sent < 1500 { late_ms % 40 } else { late_ms };
            messages.push((sent + 50 + late_ms, number, sent));
            if is_double {
                messages.push((sent + 50 + late_ms * 2, number, sent));
            }
        }
        messages.sort_unstable();
        let mut last = None;
        for (received, number, sent) in messages {
            let objects = vec![object(7, number as f64 * 0.1, 0.0), object(8, 0.0, 1.0)];
            let message = map(1, "a", number as u64 + 1, ms(sent).shifted(offset_us), objects);
            if neighbours.accept(&east(), message, ms(received)).is_ok() {
                prop_assert!(received - sent <= MAX_AGE.as_millis() as u64 + 50, "{} ms old", received - sent);
                prop_assert!(last.is_none_or(|last| number > last), "{number} after {last:?}");
                last = Some(number);
            }
            let near = neighbours.near(ms(received));
            let ids: BTreeSet<Uuid> = near.iter().map(|near| near.object.id).collect();
            prop_assert_eq!(ids.len(), near.len());
            prop_assert!(near.iter().all(|near| near.age_s <= MAX_AGE.as_secs_f64()));
        }
        prop_assert!(last.is_some());
    }
}

#[test]
fn neighbour_objects_keep_map_readable() {
    let mut neighbours = home();
    live(&mut neighbours, 0, 2000);
    let origin = beside(200.0, 45.0);
    let scores = (0..100)
        .map(|class| (format!("class {class}").into(), 0.01))
        .collect();
    let mut objects = vec![
        FusedObject {
            velocity_mps: Some([1e4, 1e4]),
            ..object(21, 0.0, 0.0)
        },
        FusedObject {
            covariance_m2: [1e200, 0.0, 1e-200],
            ..object(22, 0.0, 0.0)
        },
        FusedObject {
            first_seen_us: Some(Timestamp(crate::wire::MAX_INTEGER)),
            ..object(23, 0.0, 0.0)
        },
        FusedObject {
            first_seen_us: Some(Timestamp(0)),
            scores,
            ..object(24, 0.0, 0.0)
        },
        FusedObject {
            contributors: vec![name("zeno"); 10_000],
            ..object(25, 0.0, 0.0)
        },
        object(25, 10.0, 0.0),
    ];
    objects.extend((100..1100).map(|number| object(number, 0.0, 0.0)));
    let mut message = CellMap {
        origin,
        ..map(1, "a", 100, ms(2000), objects)
    };
    message.map.fused_at_us = Timestamp(5);
    neighbours
        .accept(&topic("east", &origin), message, ms(2060))
        .unwrap();
    let near = neighbours.near(ms(2060));
    assert!(near.iter().all(|stated| stated.object.validate().is_ok() && stated.object.contributors.is_empty()));
    let seen = near.iter().filter_map(|stated| stated.object.first_seen_us);
    assert!(
        seen.into_iter()
            .all(|seen| ms(2060).since(seen) <= MAX_SEEN_FOR + MAX_AGE && seen <= ms(2060))
    );
    let ids: BTreeSet<_> = near.iter().map(|stated| stated.object.id).collect();
    assert_eq!(
        (near.len(), ids.len()),
        (MAX_OBJECTS_EACH, MAX_OBJECTS_EACH),
        "one cell leaves room for others"
    );
}

#[test]
fn forged_epoch_blocks_one_minute() {
    let mut neighbours = home();
    live(&mut neighbours, 0, 2000);
    neighbours
        .accept(
            &east(),
            map(u64::MAX >> 11, "a", 1, ms(2000), Vec::new()),
            ms(2050),
        )
        .ok();
    let mut accept = |round: u64| {
        let at = 2000 + 100 * round;
        neighbours.accept(
            &east(),
            map(1, "a", 100 + round, ms(at), Vec::new()),
            ms(at + 50),
        )
    };
    assert_eq!(accept(1), Err(RejectReason::Superseded));
    assert!((2..620).filter(|round| accept(*round).is_ok()).count() > 0);
}
