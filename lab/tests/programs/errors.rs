//! The errors of `ecod-lab` for arguments and files that cannot be used.
//!
//! A change is accepted by `INSTA_UPDATE=always make snapshots`.

use std::fs;

use ecod_testkit::errors_of;

/// Command lines that cannot be carried out with [`FILES`], each for another reason.
const COMMANDS: &[&str] = &[
    "evl",
    "demo --scenes missing.json",
    "demo --scene nowhere",
    "street",
    "testbed --scenes empty.json",
    "testbed --scenes empty.json --at-least many",
    "bench --cavs four",
    "bench --connect nowhere",
    "bench --connect mqtt://user:geheim1@broker:1883",
    "bench --connect 127.0.0.1:1 --config node.toml",
    "report missing.mcap",
    "report log.mcap",
    "convert --format kitti --vehicle euclid --output reports.jsonl",
    "convert --format kitti --vehicle euclid=missing --output reports.jsonl",
    "convert --format kitti --vehicle euclid=labels.txt --frame-rate 0 --output reports.jsonl",
    "convert --format kitti --vehicle euclid=labels.txt --config gauss=node.toml --output reports.jsonl",
    "convert --format kitti --vehicle euclid=labels.txt --output labels.txt",
    "convert --format coco --vehicle euclid=empty.json --output reports.jsonl",
    "eval --truth missing.json --input maps.jsonl",
    "eval --truth empty.json --input maps.jsonl",
    "eval --truth empty.json --input maps.jsonl --config node.toml",
    "eval --truth empty.json --input maps.jsonl --output maps.jsonl",
    "eval-labels missing.csv",
    "eval-labels columns.csv",
    "eval-labels answers.csv",
    "eval-labels answers.csv --passes many",
];

/// Names and contents of the files of each command.
const FILES: &[[&str; 2]] = &[
    ["answers.csv", "item,voter,label\n"],
    ["columns.csv", "item,label\n1,a\n"],
    ["empty.json", "{}"],
    ["labels.txt", ""],
    ["log.mcap", "no log"],
    ["maps.jsonl", "{}\n"],
    ["node.toml", "nmae = \"edge\""],
];

#[test]
fn of_commands() {
    let shown = errors_of(env!("CARGO_BIN_EXE_ecod-lab"), COMMANDS, |directory| {
        for [name, content] in FILES {
            fs::write(directory.join(name), content).unwrap();
        }
    });
    insta::assert_snapshot!(shown);
}
