//! The configurations that the documentation hands out can be used as they are.

use std::collections::BTreeMap;
use std::path::Path;

use ecod::wire::Role;
use ecod_actors::config::NodeConfig;

fn load(name: &str) -> NodeConfig {
    let file = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../examples/node")).join(name);
    NodeConfig::load(Some(&file), &BTreeMap::<(), ()>::new())
        .unwrap_or_else(|error| panic!("{}: {error}", file.display()))
}

#[test]
fn the_example_edge_aggregates_for_the_network() {
    let edge = load("edge.toml");
    assert_eq!(edge.role, Role::Edge);
    assert!(edge.listen.ip().is_unspecified());
    assert!(edge.mqtt.broker.is_none());
}

#[cfg(feature = "camera")]
#[test]
fn the_example_vehicle_fits_the_example_edge() {
    let (edge, cav) = (load("edge.toml"), load("cav.toml"));
    assert_eq!(cav.role, Role::Cav);
    assert_eq!(cav.cell, edge.cell);
    assert_eq!(cav.landmarks, edge.landmarks);
    assert_eq!(cav.fusion.pace.gate_m, edge.fusion.pace.gate_m);
    assert_eq!(cav.mqtt.broker.unwrap().port(), edge.listen.port());
    assert!(cav.camera.is_some());
}
