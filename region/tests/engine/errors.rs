//! The errors of `ecod-region` for arguments and files that cannot be used.
//!
//! A change is accepted by `INSTA_UPDATE=always make snapshots`.

use std::fs;

use ecod_testkit::errors_of;

/// Command lines that cannot be carried out with [`FILES`], each for another reason.
const COMMANDS: &[&str] = &[
    "servee",
    "serve",
    "serve --broker nowhere",
    "serve --broker user:geheim1@broker:1883",
    "serve --broker 127.0.0.1:1883 --user edge",
    "serve --broker 127.0.0.1:1883 --user edge --password-file missing",
    "serve --broker 127.0.0.1:1883 --user edge --password-file empty",
    "serve --broker 127.0.0.1:1883 --ca missing.pem",
    "serve --broker 127.0.0.1:1883 --ca empty",
    "serve --broker 127.0.0.1:1883 --listen 0.0.0.0:8090",
    "serve --broker 127.0.0.1:1883 --token-file short",
    "serve --broker 127.0.0.1:1883 --watch 9",
    "export --broker 127.0.0.1:1883 --output maps.csv",
    "export --broker 127.0.0.1:1883 --output maps.mcap --seconds 1",
    "cell-account --cell lot/1 --latitude 52 --longitude 21",
    "cell-account --cell lot-1 --latitude 52 --longitude 21",
    "cell-account --cell lot-1 --latitude 52 --longitude 21 --password-file words",
    "cell-account --cell lot-1 --latitude 52 --longitude 21 --engine emqx",
    "cell-account --cell lot-1 --latitude 91 --longitude 21 --engine mosquitto",
];

/// Names and contents of the files of each command.
const FILES: &[[&str; 2]] = &[
    ["empty", ""],
    ["short", "secret\n"],
    ["words", "two words\n"],
];

#[test]
fn of_commands() {
    let shown = errors_of(env!("CARGO_BIN_EXE_ecod-region"), COMMANDS, |directory| {
        for [name, content] in FILES {
            fs::write(directory.join(name), content).unwrap();
        }
    });
    insta::assert_snapshot!(shown);
}
