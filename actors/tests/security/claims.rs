//! Clients with a certificate of the cell that claim another identity.

use ecod::wire::Role;
use ecod_actors::telemetry::counters::Event;
use rumqttc::{LastWill, QoS};
use uuid::Uuid;

use crate::fixture::{Cell, Client, DAY, client_config};

/// A client with a certificate of the vehicle `gauss` that has logged in.
async fn log_in(cell: &mut Cell, client: &str, role: Role) -> Client {
    let files = cell.pki.issue("gauss", role, DAY);
    let mut gauss = Client::new(cell.address, client, &client_config("gauss", &files));
    gauss.log_in().await.unwrap();
    gauss
}

/// Each of these publications must be denied, and counted once; the denials are new.
async fn are_denied(cell: &Cell, client: &mut Client, topics: &[&str], retain: bool) {
    for (denied, topic) in (1..).zip(topics) {
        client
            .publish_and_wait(&format!("ecod/v1/lot/{topic}"), retain)
            .await
            .unwrap();
        assert_eq!(cell.counters.events(Event::ClientDenied), denied, "{topic}");
    }
}

#[tokio::test]
async fn foreign_topic_is_refused() {
    let mut cell = Cell::start().await;
    let mut gauss = log_in(&mut cell, "gauss", Role::Auto).await;
    let others = [
        "detections/euclid",
        "vote_detections/euclid",
        "nodes/edge",
        "ledger/edge",
    ];
    // The last three publications are for the elected leader only, which the broker's node determines from
    // authenticated datagrams.
    let elected = ["global_detections", "global_verdicts", "reputations"];
    are_denied(&cell, &mut gauss, &[&others[..], &elected].concat(), false).await;
    let counts = cell.counters.rejects_by_source();
    let by_gauss = counts
        .iter()
        .find(|count| count.source == "gauss" && count.reason.as_str() == "not_permitted");
    assert_eq!(by_gauss.map(|count| count.times), Some(7));
    // The edge receives the next report without any of the denied publications.
    cell.honest_traffic_goes_on().await;
}

#[tokio::test]
async fn one_certificate_is_one_vehicle() {
    let mut cell = Cell::start().await;
    let mut gauss = log_in(&mut cell, "gauss--2", Role::Auto).await;
    // Parts of the vehicle may report, and count as the vehicle. They have no evidence, and parts of other vehicles are
    // not accepted.
    are_denied(
        &cell,
        &mut gauss,
        &[
            "detections/gauss-2",
            "vote_detections/euclid--2",
            "ledger/gauss--2",
        ],
        false,
    )
    .await;
    cell.honest_traffic_goes_on().await;
}

#[tokio::test]
async fn follower_certificate_shares_no_evidence() {
    let mut cell = Cell::start().await;
    let mut gauss = log_in(&mut cell, "gauss", Role::Cav).await;
    are_denied(&cell, &mut gauss, &["ledger/gauss", "cell"], false).await;
    cell.honest_traffic_goes_on().await;
}

#[tokio::test]
async fn report_is_not_retained() {
    let mut cell = Cell::start().await;
    let files = cell.pki.issue("gauss", Role::Auto, DAY);
    let mut gauss = Client::new(cell.address, "gauss", &client_config("gauss", &files));
    gauss.log_in().await.unwrap();
    are_denied(
        &cell,
        &mut gauss,
        &["detections/gauss", "vote_detections/gauss", "ledger/gauss"],
        true,
    )
    .await;
    let will = LastWill::new(
        "ecod/v1/lot/detections/gauss",
        "stale",
        QoS::AtLeastOnce,
        true,
    );
    let id = format!("gauss-{}", Uuid::now_v7().simple());
    let refused = Client::with_id(
        cell.address,
        &id,
        &client_config("gauss", &files),
        |options| {
            options.set_last_will(will);
        },
    );
    assert!({ refused }.log_in().await.is_err());
    cell.honest_traffic_goes_on().await;
}

#[tokio::test]
async fn login_as_other_is_refused() {
    let mut cell = Cell::start().await;
    let files = cell.pki.issue("gauss", Role::Auto, DAY);
    let tls = client_config("gauss", &files);
    let run = Uuid::now_v7().simple();
    let posing = Client::with_id(cell.address, &format!("euclid-{run}"), &tls, |_| ())
        .log_in()
        .await;
    assert!(
        posing.is_err(),
        "a login under the name of another would end the other's"
    );
    let drawn = Client::with_id(cell.address, &run.to_string(), &tls, |_| ())
        .log_in()
        .await;
    assert!(drawn.is_err(), "it may be what the broker drew for another");
    let will = LastWill::new(
        "ecod/v1/lot/nodes/euclid",
        "offline",
        QoS::AtLeastOnce,
        true,
    );
    let leaving = Client::with_id(cell.address, &format!("gauss-{run}"), &tls, |options| {
        options.set_last_will(will);
    });
    let refused = { leaving }.log_in().await;
    assert!(refused.is_err(), "{refused:?}");
    cell.counted(Event::ClientDenied, 3).await;
    Client::with_id(cell.address, "", &tls, |_| ())
        .log_in()
        .await
        .unwrap();
    cell.honest_traffic_goes_on().await;
}
