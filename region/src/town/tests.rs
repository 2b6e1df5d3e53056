use ecod::model::epoch::Epoch;
use ecod::model::geometry::Covariance;
use ecod::wire::{Encoding, NodeState, Role, SCHEMA_VERSION, encode};
use uuid::Uuid;

use super::*;

const PLACE: GeographicOrigin = GeographicOrigin {
    latitude_deg: 48.8584,
    longitude_deg: 2.2945,
    height_m: 0.0,
    rotation_deg: 0.0,
};

fn at(ms: u64) -> Timestamp {
    Timestamp(1_800_000_000_000_000 + 1000 * ms)
}

fn topic(cell: &'static str, kind: RegionTopicKind) -> RegionTopic {
    RegionTopic {
        tile: Quadkey::of_cell(&PLACE),
        cell: NodeName::from_static(cell),
        kind,
    }
}

fn tile() -> Quadkey {
    Quadkey::of_cell(&PLACE)
}

/// A map of this round, sent at once, with objects at these distances in metres to the east of the
/// origin.
fn map(
    town: &mut RegionTown,
    cell: &'static str,
    round: u64,
    ms: u64,
    east_m: &[f64],
) -> Result<Accepted, CellRefusal> {
    let object = |x_m: &f64| {
        let contributors = vec![NodeName::from_static("euclid")];
        let scores = [("car".into(), 0.9)].into();
        let of = FusedObject::new(
            Uuid::new_v4(),
            "car",
            0.9,
            *x_m,
            0.0,
            Covariance::isotropic(0.1),
        );
        FusedObject {
            contributors,
            scores,
            ..of
        }
    };
    let epoch = Epoch::new(1, NodeName::from_static("edge"));
    let objects = east_m.iter().map(object).collect();
    let map = GlobalMap {
        objects,
        ..GlobalMap::new(&epoch, round, at(ms))
    };
    let cell_name = NodeName::from_static(cell);
    let message = CellMap {
        schema: SCHEMA_VERSION,
        cell: cell_name,
        sent_at_us: at(ms),
        origin: PLACE,
        map,
    };
    town.accept(
        &topic(cell, RegionTopicKind::Map).path(),
        &encode(&message, Encoding::Compact),
        at(ms),
    )
}

fn status(
    town: &mut RegionTown,
    cell: &'static str,
    ms: u64,
    state: NodeState,
) -> Result<Accepted, CellRefusal> {
    let status = NodeStatus::starting(
        NodeName::from_static("edge"),
        Uuid::nil(),
        Role::Edge,
        "0.1.0",
    );
    let payload = encode(&NodeStatus { state, ..status }, Encoding::Json);
    town.accept(
        &topic(cell, RegionTopicKind::Status).path(),
        &payload,
        at(ms),
    )
}

#[test]
fn only_flooding_cell_is_limited() {
    let mut town = RegionTown::default();
    for number in 0..1000 {
        let _ = map(&mut town, "flood", number + 1, number, &[]);
        let _ = status(&mut town, "flood", number, NodeState::Aggregating);
    }
    let throttled = 2 * (1000 - 40);
    let losses = town.cells()[&(tile(), NodeName::from_static("flood"))].losses;
    assert!(
        (throttled - 4..=throttled + 4).contains(&losses.throttled),
        "{losses:?}"
    );
    assert_eq!(town.counts().losses.throttled, losses.throttled);
    status(&mut town, "quiet", 1000, NodeState::Aggregating).unwrap();
    let _ = map(&mut town, "flood", 2000, 1001, &[]);
    assert_eq!(
        map(&mut town, "flood", 2001, 1001, &[]),
        Err(CellRefusal::CellThrottled)
    );
}

#[test]
fn objects_outside_area_are_counted() {
    let mut town = RegionTown::default();
    for round in 1..=20 {
        let _ = map(
            &mut town,
            "lot",
            round,
            100 * round,
            &[0.0, 250.0, 5000.0, -800_000.0],
        );
    }
    let cell = &town.cells()[&(tile(), NodeName::from_static("lot"))];
    let shown: Vec<_> = cell
        .map
        .as_ref()
        .unwrap()
        .objects
        .iter()
        .map(|object| object.x_m)
        .collect();
    assert_eq!(shown, [0.0, 250.0]);
    let maps = town.counts().maps;
    assert_eq!((cell.losses.outside, cell.losses.too_many), (2 * maps, 0));
    let view = town.view(
        &GeographicBounds::of(Quadkey::default()),
        &ReadTiles::default(),
        at(2000),
    );
    assert_eq!(
        (view.objects.len(), view.cells[0].objects_refused),
        (2, 2 * maps)
    );
}

#[test]
fn kept_data_is_bounded() {
    let mut town = RegionTown::default();
    for round in 1..=20 {
        let _ = map(
            &mut town,
            "lot",
            round,
            100 * round,
            &vec![1.0; MAX_OBJECTS + 10],
        );
    }
    let long = NodeStatus::starting(
        NodeName::from_static("edge"),
        Uuid::nil(),
        Role::Edge,
        &"9".repeat(20_000),
    );
    let path = topic("lot", RegionTopicKind::Status).path();
    let refused = town.accept(&path, &encode(&long, Encoding::Json), at(2000));
    assert_eq!(refused, Err(CellRefusal::Rejected(RejectReason::TooLarge)));
    let cell = &town.cells()[&(tile(), NodeName::from_static("lot"))];
    let objects = &cell.map.as_ref().unwrap().objects;
    assert_eq!(
        (objects.len(), cell.losses.too_many),
        (MAX_OBJECTS, 10 * town.counts().maps)
    );
    assert!(
        objects
            .iter()
            .all(|object| object.contributors.is_empty() && object.scores.is_empty())
    );
}

#[test]
fn silence_starts_at_due_map() {
    let mut town = RegionTown::default();
    status(&mut town, "lot", 0, NodeState::Aggregating).unwrap();
    let state = |town: &RegionTown, read_ms: Option<u64>, ms: u64| {
        let cell = &town.cells()[&(tile(), NodeName::from_static("lot"))];
        cell.state(at(ms), read_ms.map(at))
    };
    assert_eq!(state(&town, None, 60_000), CellState::Claimed);
    for (ms, expected) in [
        (60_000, CellState::Claimed),
        (62_900, CellState::Claimed),
        (63_000, CellState::Silent),
    ] {
        assert_eq!(state(&town, Some(60_000), ms), expected, "{ms} ms");
    }
    // A leader that comes back gets the same time.
    status(&mut town, "lot", 70_000, NodeState::Offline).unwrap();
    assert_eq!(state(&town, Some(60_000), 71_000), CellState::Offline);
    status(&mut town, "lot", 72_000, NodeState::Aggregating).unwrap();
    assert_eq!(state(&town, Some(60_000), 73_000), CellState::Claimed);
    status(&mut town, "lot", 74_500, NodeState::Aggregating).unwrap();
    assert_eq!(state(&town, Some(60_000), 75_000), CellState::Silent);
    // The time is long enough for a cell at 2 Hz.
    for round in 1..=6 {
        let _ = map(&mut town, "lot", round, 80_000 + 500 * round, &[]);
        let state = state(&town, Some(80_000), 80_000 + 500 * round + 499);
        assert_eq!(
            state,
            if round < 3 {
                CellState::Claimed
            } else {
                CellState::Live
            },
            "{round}"
        );
    }
}
