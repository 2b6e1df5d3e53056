//! Rights of a cell's credentials.

use std::collections::BTreeSet;
use std::sync::{Arc, Mutex};

use ecod::wire::{NodeState, RegionTopic, RegionTopicKind};
use ecod_region::town::RegionTown;
use ecod_testkit::until;

use crate::broker::{Broker, FAR, LOT, PlacedCell};
use crate::cell::Cell;

/// Topics of messages that arrive at a reader of everything.
async fn listen(broker: &Broker) -> Arc<Mutex<Vec<String>>> {
    let arrived = Arc::new(Mutex::new(Vec::new()));
    let noted = Arc::clone(&arrived);
    let state = broker.read(move |reading| noted.lock().unwrap().push(reading.topic.to_owned()));
    until("the reader is there", || state.link().is_up).await;
    arrived
}

/// Tries all that a cell must not, and then what it may; returns what came through.
async fn attack(broker: &Broker, arrived: &Mutex<Vec<String>>) -> BTreeSet<String> {
    let lot = Cell::connect(broker, LOT);
    let far = Cell::connect(broker, FAR);
    // The last of its own messages shows that all before it had their chance.
    let foreign_name = |kind| {
        RegionTopic {
            tile: lot.account.tile,
            cell: far.account.cell.clone(),
            kind,
        }
        .path()
    };
    let foreign_tile = |kind| {
        RegionTopic {
            tile: far.account.tile,
            cell: lot.account.cell.clone(),
            kind,
        }
        .path()
    };
    for kind in RegionTopicKind::ALL {
        for topic in [far.topic(kind), foreign_name(kind), foreign_tile(kind)] {
            for retain in [false, true] {
                lot.publish(&topic, retain, b"forged".to_vec());
            }
        }
    }
    lot.publish("ecod/v1/geo", false, b"forged".to_vec());
    lot.publish_map(1, 1);
    far.publish_map(1, 1);
    let both = [
        lot.topic(RegionTopicKind::Map),
        far.topic(RegionTopicKind::Map),
    ];
    until("messages of both cells arrive", || {
        both.iter()
            .all(|topic| arrived.lock().unwrap().contains(topic))
    })
    .await;
    assert_eq!(
        lot.received().logins,
        1,
        "a refused message ends no connection"
    );
    let statuses = [
        far.topic(RegionTopicKind::Status),
        lot.topic(RegionTopicKind::Status),
    ];
    for (topic, retain) in statuses.iter().zip([true, false]) {
        Cell::vanish(broker, LOT.name, topic, retain).await;
    }
    until("the own last will arrives", || {
        arrived.lock().unwrap().contains(&statuses[1])
    })
    .await;
    // A client that subscribes later would receive a retained forgery.
    let later = listen(broker).await;
    lot.publish_map(2, 1);
    until("the second reader receives maps", || {
        !later.lock().unwrap().is_empty()
    })
    .await;
    let arrived = arrived.lock().unwrap().clone();
    let later = later.lock().unwrap().clone();
    arrived.into_iter().chain(later).collect()
}

/// All that [`attack`] sends and may.
fn honest(lot: &Cell, far: &Cell) -> BTreeSet<String> {
    [
        lot.topic(RegionTopicKind::Map),
        lot.topic(RegionTopicKind::Status),
        far.topic(RegionTopicKind::Map),
    ]
    .into()
}

#[tokio::test(flavor = "multi_thread")]
async fn nats_rights_end_at_tile() {
    let broker = Broker::nats();
    let arrived = listen(&broker).await;
    let heard = attack(&broker, &arrived).await;
    let lot = Cell::connect(&broker, LOT);
    let far = Cell::connect(&broker, FAR);
    assert_eq!(heard, honest(&lot, &far), "no forged message");

    let tiles = lot.account.tile.with_neighbours();
    let around: Vec<_> = tiles
        .iter()
        .map(|tile| RegionTopic::filter(*tile, RegionTopicKind::Map))
        .collect();
    assert_eq!(lot.subscribe(&around).await, [true; 9]);
    let own_status = lot.topic(RegionTopicKind::Status);
    assert_eq!(lot.subscribe(&[own_status]).await, [true]);
    let foreign = [
        RegionTopic::filter(tiles[0], RegionTopicKind::Status),
        "#".to_owned(),
        "ecod/v1/geo/#".to_owned(),
        "ecod/v1/+/#".to_owned(),
        RegionTopic::filter(far.account.tile, RegionTopicKind::Map),
        RegionTopic::filter_within("12022".parse().unwrap()),
        "$JS/#".to_owned(),
        "$MQTT/#".to_owned(),
        "$SYS/#".to_owned(),
    ];
    assert_eq!(lot.subscribe(&foreign).await, [false; 9]);
}

#[tokio::test(flavor = "multi_thread")]
async fn mosquitto_rights_end_at_tile() {
    let broker = Broker::mosquitto();
    let arrived = listen(&broker).await;
    let heard = attack(&broker, &arrived).await;
    let lot = Cell::connect(&broker, LOT);
    let far = Cell::connect(&broker, FAR);
    let own = lot.topic(RegionTopicKind::Map);
    assert_eq!(heard, honest(&lot, &far), "no forged message");
    // Subscriptions are granted, and nothing foreign comes.
    lot.subscribe(&["ecod/v1/#".to_owned()]).await;
    far.publish_map(2, 1);
    lot.publish_map(3, 1);
    until("the own map arrives", || !lot.received().topics.is_empty()).await;
    assert_eq!(lot.received().topics, [own]);
}

/// A cell that is added while the server runs.
const NEW: PlacedCell = PlacedCell {
    name: "new-1",
    latitude_deg: 48.86,
    longitude_deg: 2.30,
};

/// Connects a cell, again and again until the server has taken its password.
async fn admitted(broker: &Broker, place: PlacedCell) -> Cell {
    let mut cell = Cell::connect(broker, place);
    until("the cell is in", || {
        if cell.received().is_refused {
            cell = Cell::connect(broker, place);
        }
        cell.received().logins == 1
    })
    .await;
    cell
}

#[tokio::test(flavor = "multi_thread")]
async fn adding_cell_disconnects_no_others() {
    let broker = Broker::nats();
    let lot = Cell::connect(&broker, LOT);
    until("the cell is in", || lot.received().logins == 1).await;
    broker.add_cell(NEW);
    let added = admitted(&broker, NEW).await;
    added.publish(
        &added.topic(RegionTopicKind::Status),
        true,
        added.status(NodeState::Aggregating),
    );
    let state = broker.read(|_| ());
    until("its status is read", || state.town().cells().len() == 1).await;
    assert_eq!(lot.received().logins, 1);

    // It goes on with the password that it has.
    broker.renew_password(NEW);
    until("who has the former password is shut out", || {
        added.received().is_refused
    })
    .await;
    admitted(&broker, NEW).await;
    assert_eq!(lot.received().logins, 1);
}

#[tokio::test(flavor = "multi_thread")]
async fn the_streams_are_made_once() {
    let broker = Broker::nats();
    let streams = ["ECOD_MAPS is there"];
    for _ in 0..2 {
        assert_eq!(broker.make_streams(), streams);
    }
}

#[test]
fn junk_of_cell_is_counted() {
    let mut town = RegionTown::default();
    let now = ecod_actors::platform::clock::now();
    for (path, payload) in [
        (
            "ecod/v1/geo/1/2/0/2/2/0/0/1/1/0/1/2/0/0/0/lot-1/map",
            &b"{"[..],
        ),
        ("ecod/v1/geo/1/2/lot-1/map", b"{}"),
        (
            "ecod/v1/geo/1/2/0/2/2/0/0/1/1/0/1/2/0/0/0/lot-1/status",
            b"junk",
        ),
        ("elsewhere", b""),
    ] {
        town.accept(path, payload, now).unwrap_err();
    }
    assert_eq!(town.counts().rejected.values().sum::<u64>(), 4);
    assert!(
        town.cells()
            .values()
            .all(|cell| cell.map.is_none() && cell.status.is_none())
    );
}
