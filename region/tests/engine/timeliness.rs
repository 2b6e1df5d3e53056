//! Old maps after a pause of the engine.

use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use ecod::neighbours::MAX_AGE;
use ecod::wire::{CellMap, Limits, RejectReason, decode};
use ecod_region::town::Accepted;
use ecod_testkit::until;

use crate::broker::{Broker, LOT};
use crate::cell::Cell;

/// Maximum map age beyond [`MAX_AGE`] that an estimate of the least delay may be off, on one machine.
const TOLERANCE: Duration = Duration::from_millis(200);

#[tokio::test(flavor = "multi_thread")]
async fn delayed_maps_are_dropped() {
    let broker = Broker::nats();
    let lot = Cell::connect(&broker, LOT);
    // True ages of the maps that count: this machine has one clock.
    let taken = Arc::new(Mutex::new(Vec::<Duration>::new()));
    let noted = Arc::clone(&taken);
    let state = broker.read(move |reading| {
        if let Ok(Accepted::Map(..)) = reading.outcome {
            let map: CellMap = decode(reading.payload, &Limits::default()).unwrap();
            noted.lock().unwrap().push(reading.at.since(map.sent_at_us));
        }
    });
    until("the reader is there", || state.link().is_up).await;
    // Of a burst, 20 maps are looked at; the others are beyond the cell's rate.
    let stale = || {
        let counts = state.town().counts().clone();
        counts
            .rejected
            .get(&RejectReason::Stale)
            .copied()
            .unwrap_or(0)
            + counts.losses.throttled
    };
    let mut round = 0;
    let mut publish_for = async |span: Duration| {
        let begun = Instant::now();
        while begun.elapsed() < span {
            round += 1;
            lot.publish_map(round, 20);
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    };
    publish_for(Duration::from_secs(3)).await;
    let before = taken.lock().unwrap().len();
    let stale_before = stale();
    assert!(before > 10, "{before}");

    broker.signal("STOP");
    publish_for(Duration::from_millis(3500)).await;
    broker.signal("CONT");
    publish_for(Duration::from_secs(3)).await;
    until("the burst has come", || stale() > stale_before + 20).await;
    until("fresh maps count again", || {
        taken.lock().unwrap().len() > before + 20
    })
    .await;
    let oldest = taken.lock().unwrap().iter().max().copied().unwrap();
    println!(
        "{} maps taken, the oldest {oldest:?} old; {} were too old",
        taken.lock().unwrap().len(),
        stale()
    );
    assert!(oldest <= MAX_AGE + TOLERANCE, "a map of {oldest:?} counted");
}
