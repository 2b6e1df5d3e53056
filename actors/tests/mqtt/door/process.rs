//! A node in a separate process: costs and log of the process.

use std::fs::{self, File};
use std::net::SocketAddr;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use tempfile::TempDir;
use tokio::time::{Instant, sleep};

use crate::door::cell::PATIENCE;

/// A node in a separate process, with its files.
pub(crate) struct Node {
    process: Child,
    directory: TempDir,
}

impl Node {
    pub(crate) fn start() -> Self {
        let directory = tempfile::tempdir().unwrap();
        let file = directory.path().join("node.toml");
        let text = "name = \"edge\"\ncell = \"lot\"\nrole = \"edge\"\nlisten = \"127.0.0.1:0\"\n[membership]\n\
                    bind = \"127.0.0.1:0\"\n[membership.multicast]\nenabled = false\n[dashboard]\nenabled = false\n";
        fs::write(&file, text).unwrap();
        let log = File::create(directory.path().join("log")).unwrap();
        let mut command = Command::new(env!("CARGO_BIN_EXE_ecod-node"));
        command
            .args(["--log-format", "text", "--stop-at-eof", "--config"])
            .arg(&file)
            .stdin(Stdio::piped());
        let process = command
            .env_remove("RUST_LOG")
            .stdout(Stdio::null())
            .stderr(log)
            .spawn()
            .unwrap();
        Self { process, directory }
    }

    pub(crate) fn log(&self) -> String {
        fs::read_to_string(self.directory.path().join("log")).unwrap()
    }

    /// Address of the door, as soon as the log contains it.
    pub(crate) async fn door(&self) -> SocketAddr {
        let started = Instant::now();
        loop {
            let log = self.log();
            if let Some((address, _)) = log
                .split_once("broker serves address=")
                .and_then(|(_, at)| at.split_once('\n'))
            {
                return address.parse().unwrap();
            }
            assert!(
                started.elapsed() < PATIENCE,
                "the node does not listen:\n{log}"
            );
            sleep(Duration::from_millis(20)).await;
        }
    }

    /// Resident memory: now (`VmRSS:`), or at most (`VmHWM:`).
    pub(crate) fn memory_kib(&self, key: &str) -> u64 {
        let status = fs::read_to_string(format!("/proc/{}/status", self.process.id())).unwrap();
        let line = status
            .lines()
            .find_map(|line| line.strip_prefix(key))
            .unwrap();
        line.trim().trim_end_matches(" kB").parse().unwrap()
    }
}

impl Drop for Node {
    fn drop(&mut self) {
        self.process.kill().unwrap();
        self.process.wait().unwrap();
    }
}
