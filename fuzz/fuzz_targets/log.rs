//! A log in MCAP, run again as `ecod-node replay` does, by its journal or its reports; equal logs give equal rounds.

#![no_main]

use std::path::PathBuf;

use ecod_actors::cli::rounds_of_log;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let path = PathBuf::from(format!(
        "/dev/shm/ecod-fuzz-log-{}.mcap",
        std::process::id()
    ));
    std::fs::write(&path, bytes).expect("the file can be written");
    assert_eq!(rounds_of_log(&path), rounds_of_log(&path));
});
