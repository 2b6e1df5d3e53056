//! A log in MCAP, as `ecod-node replay` and `ecod-node report` read it.

#![no_main]

use std::path::PathBuf;

use ecod::wire::{Limits, ObjectReport, decode};
use ecod_actors::recorder::{LogEvent, LogReader};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let path = PathBuf::from(format!("/dev/shm/ecod-fuzz-log-{}.mcap", std::process::id()));
    std::fs::write(&path, bytes).expect("the file can be written");
    for event in LogReader::open(&path).expect("the file can be opened").flatten() {
        if let LogEvent::Message(message) = event {
            drop(decode::<ObjectReport>(&message.json, &Limits::default()));
        }
    }
});
