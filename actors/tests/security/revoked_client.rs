//! A client of a broker that is no member, whose certificate is revoked.

use std::time::Duration;

use ecod::model::names::NodeName;
use ecod::wire::{Encoding, ObjectReport, PerceivedObject, Role, encode};
use ecod_actors::node::NodeHandle;
use ecod_actors::platform::clock;
use ecod_testkit::until;
use tokio::time::{Instant, interval, timeout};

use crate::fixture::{Client, DAY, GONE_WITHIN, Pki, client_config, node as name};
use crate::nodes::start_with;

/// True if the newest map has an object that only this vehicle has reported.
fn shows(node: &NodeHandle, vehicle: &NodeName) -> bool {
    let newest = node.newest_map();
    let newest = newest.borrow();
    newest.as_ref().is_some_and(|newest| {
        let mut objects = newest.map.objects.iter();
        objects.any(|object| object.contributors == std::slice::from_ref(vehicle))
    })
}

/// Reports two objects until the map shows them.
async fn report_until_shown(client: &mut Client, vehicle: &NodeName, edge: &NodeHandle) {
    let mut ticks = interval(Duration::from_millis(100));
    let mut seq = 0;
    while !shows(edge, vehicle) {
        ticks.tick().await;
        seq += 1;
        assert!(seq < 200, "the map does not show its objects");
        let report = ObjectReport {
            objects: vec![
                PerceivedObject::new("car", 0.9, 30.0, 30.0),
                PerceivedObject::new("car", 0.9, -30.0, 30.0),
            ],
            ..ObjectReport::new(vehicle.clone(), seq, clock::now())
        };
        let topic = format!("ecod/v1/lot/detections/{vehicle}");
        let payload = encode(&report, Encoding::Json);
        client
            .publish_all_and_wait(&topic, false, &payload)
            .await
            .unwrap();
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn revoked_clients_objects_are_removed() {
    let mut pki = Pki::new();
    let edge_files = pki.issue("edge", Role::Edge, DAY);
    let edge = start_with("edge", Role::Edge, edge_files, None, |config| {
        config.fusion.tracks.life_s = 30.0;
        config.fusion.tracks.latent_s = 30.0;
    })
    .await;
    until("edge leads", || edge.newest_map().borrow().is_some()).await;
    for (vehicle, stays) in [("gauss", true), ("mallory", false)] {
        let files = pki.issue(vehicle, Role::Cav, DAY);
        let broker = edge.broker_address().unwrap();
        let mut client = Client::new(broker, vehicle, &client_config(vehicle, &files));
        client.log_in().await.unwrap();
        let vehicle = name(vehicle);
        report_until_shown(&mut client, &vehicle, &edge).await;
        let mut client = stays.then_some(client);
        if !stays {
            tokio::time::sleep(Duration::from_millis(500)).await;
        }
        assert!(shows(&edge, &vehicle));
        pki.authority.revoke(&vehicle, clock::now()).unwrap();
        let revoked = Instant::now();
        if let Some(client) = &mut client {
            timeout(GONE_WITHIN, client.drive())
                .await
                .expect("still connected");
            println!("{vehicle} was disconnected after {:?}", revoked.elapsed());
        }
        until("its objects leave the map", || !shows(&edge, &vehicle)).await;
        let gone_in = revoked.elapsed();
        println!("{vehicle}'s objects left the map {gone_in:?} after the revocation");
        assert!(gone_in < GONE_WITHIN, "{gone_in:?}");
    }
    edge.stop().await;
}
