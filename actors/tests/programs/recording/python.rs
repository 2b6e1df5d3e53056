//! The standard Python reader and this project read equal contents from a log.

use std::path::Path;
use std::process::Command;

use ecod_actors::observe::recorder::{SchemaName, files};
use ecod_testkit::output_of;

use crate::recording::cell::Log;
use crate::recording::disk::{edge, maps, wait_until};

/// Prints schema and topic of every message; a log that was not finished is read as far as it goes.
const SCRIPT: &str = "
import json, sys
from mcap.reader import NonSeekingReader, make_reader
file = open(sys.argv[1], 'rb')
is_finished = sys.argv[2] == 'finished'
messages = make_reader(file).iter_messages() if is_finished else NonSeekingReader(file).iter_messages(log_time_order=False)
try:
    for schema, channel, message in messages:
        json.loads(message.data)
        print(schema.name, channel.topic)
except Exception:
    # The last record may be cut anywhere.
    if is_finished: raise
";

/// The maps that Python finds in a log.
fn maps_by(python: &str, dir: &Path, state: &str) -> usize {
    let read = |log: &std::path::PathBuf| {
        let mut reader = Command::new(python);
        let text = output_of(reader.args(["-c", SCRIPT]).arg(log).arg(state));
        let is_map = |line: &&str| line.starts_with("ecod.GlobalMap ");
        text.lines().filter(is_map).count()
    };
    files(dir).unwrap().iter().map(read).sum()
}

#[test]
#[ignore = "needs the Python package mcap, which `make recording-check` installs"]
fn python_reads_truncated_log() {
    let python = std::env::var("MCAP_PYTHON").unwrap_or("python3".into());
    let has_reader = Command::new(&python)
        .args(["-c", "import mcap"])
        .output()
        .is_ok_and(|output| output.status.success());
    assert!(
        has_reader,
        "{python} has no package mcap: run `make recording-check`"
    );
    for state in ["finished", "killed"] {
        let directory = tempfile::tempdir().unwrap();
        let dir = directory.path().join("edge");
        let mut process = edge(directory.path(), "");
        wait_until("maps are on the disk", directory.path(), || {
            maps(&dir) >= 20
        });
        if state == "finished" {
            process.terminate();
        } else {
            process.0.kill().unwrap();
            process.0.wait().unwrap();
        }
        let theirs = maps_by(&python, &dir, state);
        let ours = Log::read(&dir).count(SchemaName::GlobalMap);
        // From a truncated chunk, this project's reader takes the complete entries.
        assert!(
            theirs >= 20 && theirs <= ours && (state == "killed" || theirs == ours),
            "{state}: {theirs} of {ours}"
        );
    }
}
