//! A node's configuration: what is accepted can be printed and is accepted again.

#![no_main]

use std::collections::BTreeMap;
use std::path::PathBuf;

use ecod_actors::node::config::NodeConfig;
use libfuzzer_sys::{Corpus, fuzz_target};

fuzz_target!(|text: &[u8]| -> Corpus {
    let path = PathBuf::from(format!(
        "/dev/shm/ecod-fuzz-configuration-{}.toml",
        std::process::id()
    ));
    let flags = BTreeMap::<String, String>::new();
    std::fs::write(&path, text).expect("the file can be written");
    let Ok(config) = NodeConfig::load(Some(&path), &flags) else {
        return Corpus::Keep;
    };
    let pose = config.pose.stated().in_map(config.origin.as_ref());
    drop((
        config.landmarks(),
        pose,
        config.broker(),
        config.broker_listen(),
        config.data_plane(),
    ));
    let printed = config.to_toml().expect("a configuration can be printed");
    std::fs::write(&path, &printed).expect("the file can be written");
    NodeConfig::load(Some(&path), &flags).unwrap_or_else(|error| panic!("{error} in\n{printed}"));
    NodeConfig::load_cell(&path).unwrap_or_else(|error| panic!("{error} in\n{printed}"));
    Corpus::Keep
});
