//! Subscribes to a cell's map with a plain MQTT client and prints it, one line for each round.
//!
//! `cargo run --example subscribe_map -- 127.0.0.1:1883 lot-1`

use anyhow::Context;
use ecod::model::names::NodeName;
use ecod::wire::{GlobalMap, Limits, Topic, Topics, decode};
use rumqttc::{AsyncClient, Event, MqttOptions, Packet, QoS};

#[tokio::main]
async fn main() -> anyhow::Result<()> {
    let mut arguments = std::env::args().skip(1);
    let (Some(broker), Some(cell)) = (arguments.next(), arguments.next()) else {
        anyhow::bail!("usage: subscribe_map HOST:PORT CELL");
    };
    let (host, port) = broker
        .rsplit_once(':')
        .context("the broker must be HOST:PORT")?;
    let topic = Topics::new(&NodeName::new(&cell)?).path(&Topic::GlobalDetections);

    let options = MqttOptions::new(
        format!("subscribe-map-{}", std::process::id()),
        host,
        port.parse()?,
    );
    let (client, mut events) = AsyncClient::new(options, 10);
    loop {
        match events.poll().await? {
            // A broker drops subscriptions with the connection, so subscribe after every connect.
            Event::Incoming(Packet::ConnAck(_)) => client.try_subscribe(&topic, QoS::AtMostOnce)?,
            Event::Incoming(Packet::Publish(packet)) => {
                match decode::<GlobalMap>(&packet.payload, &Limits::default()) {
                    Ok(map) => print(&map),
                    Err(reason) => eprintln!("not a map: {reason}"),
                }
            }
            _ => {}
        }
    }
}

fn print(map: &GlobalMap) {
    let places = map.landmarks.iter().map(|place| match &place.label {
        Some(label) => format!("{}={label} ({:.2})", place.id, place.confidence),
        None if place.observers.is_empty() => format!("{}=?", place.id),
        None => format!("{}=-", place.id),
    });
    println!(
        "{} {}/{}: {}",
        map.aggregator,
        map.epoch,
        map.round,
        places.collect::<Vec<_>>().join(" ")
    );
}
