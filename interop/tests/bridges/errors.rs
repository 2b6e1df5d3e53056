//! The errors of `ecod-interop` for arguments and files that cannot be used.
//!
//! A change is accepted by `INSTA_UPDATE=always make snapshots`.

use std::fs;

use ecod_testkit::errors_of;

/// Command lines that cannot be carried out with [`FILES`], each for another reason.
const COMMANDS: &[&str] = &[
    "cmp",
    "cpm --cell lot/1",
    "cpm --node two/parts",
    "cpm --broker user:geheim1@broker:1883",
    "cpm --brokr=user:geheim1@broker:1883",
    "cpm --ca ca.pem",
    "cpm --ca ca.pem --certificate edge.pem --key edge-key.pem",
    "ros2 missing.mcap output.mcap",
    "ros2 log.mcap output.mcap",
    "ros2 log.mcap log.mcap",
    "ros2-live --domain 233",
    "ros2-live --domain x",
    "ros2-live --network nowhere",
    "ros2-live --detections-2d boxes",
    "ros2-live --pose 1",
    "ros2-live --pose 1,2",
    "ros2-live --pose 1,2,3 --azimuth 90",
    "ros2-live --pose 1,2 --azimuth 450",
    "ros2-live --pose 1,2,450",
    "ros2-live --pose-topic pose",
    "ros2-live --height-m 0",
    "ros2-live --pitch-deg up",
    "ros2-live --projection missing.toml",
    "ros2-live --projection projection.toml",
    "ros2-live --label person",
];

/// Names and contents of the files of each command.
const FILES: &[[&str; 2]] = &[
    ["log.mcap", "no log"],
    ["projection.toml", "pixel_sigma_px = -1.0"],
];

#[test]
fn of_commands() {
    let shown = errors_of(env!("CARGO_BIN_EXE_ecod-interop"), COMMANDS, |directory| {
        for [name, content] in FILES {
            fs::write(directory.join(name), content).unwrap();
        }
    });
    insta::assert_snapshot!(shown);
}
