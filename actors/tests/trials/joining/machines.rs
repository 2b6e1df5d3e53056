//! The README's commands on three machines: network namespaces, each with a separate `/etc` and `/var/lib`.

use std::fs::{self, File};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use ecod_testkit::{all_output, until_blocking as until};
use tempfile::TempDir;

use crate::joining::{Running, tokens};
use crate::network::{Bridged, namespace};

/// Stands for systemd, which namespaces lack: a service runs by the command of its unit, and is noted as enabled.
const SYSTEMCTL: &str = r#"#!/bin/sh
set -e
files=${0%/bin/systemctl}
unit=/etc/systemd/system/$2.service
case $1 in
enable) grep -q '^WantedBy=multi-user.target' "$unit" && touch "$files/enabled" ;;
restart)
    command=$(sed -n 's,^ExecStart=/usr/bin/,,p' "$unit")
    $command --map-log "$files/maps" </dev/null >/dev/null 2>"$files/log" &
    echo $! >"$files/service" ;;
*) exit 1 ;;
esac
"#;

struct Machine {
    number: usize,
    files: TempDir,
}

impl Drop for Machine {
    fn drop(&mut self) {
        if let Ok(service) = fs::read_to_string(self.files.path().join("service")) {
            Command::new("kill")
                .args(["-KILL", service.trim()])
                .status()
                .ok();
        }
    }
}

impl Machine {
    fn new(number: usize) -> Self {
        let files = tempfile::tempdir().unwrap();
        let copied = Command::new("cp")
            .args(["-a", "/etc"])
            .arg(files.path())
            .status()
            .unwrap();
        assert!(copied.success());
        for directory in ["lib", "run", "bin"] {
            fs::create_dir(files.path().join(directory)).unwrap();
        }
        Self { number, files }
    }

    /// A machine with the package's unit, and a systemd that runs it.
    fn with_service(number: usize) -> Self {
        let machine = Self::new(number);
        let files = machine.files.path();
        let unit = "../packaging/systemd/ecod-node.service";
        fs::create_dir_all(files.join("run/systemd/system")).unwrap();
        fs::create_dir_all(files.join("etc/systemd/system")).unwrap();
        let unit = Path::new(env!("CARGO_MANIFEST_DIR")).join(unit);
        fs::copy(unit, files.join("etc/systemd/system/ecod-node.service")).unwrap();
        let systemctl = files.join("bin/systemctl");
        fs::write(&systemctl, SYSTEMCTL).unwrap();
        fs::set_permissions(&systemctl, fs::Permissions::from_mode(0o755)).unwrap();
        machine
    }

    fn is_enabled(&self) -> bool {
        self.files.path().join("enabled").exists()
    }

    /// A command of the README as root of this machine has it.
    fn command(&self, line: &str) -> Command {
        let program = PathBuf::from(env!("CARGO_BIN_EXE_ecod-node"));
        let system = self.files.path().join("bin");
        let programs = program.parent().unwrap();
        let path = format!(
            "{}:{}:{}",
            system.display(),
            programs.display(),
            std::env::var("PATH").unwrap()
        );
        let own = r#"mount --bind "$0/etc" /etc && mount --bind "$0/lib" /var/lib && mount --bind "$0/run" /run && exec "$@""#;
        let mut command = Command::new("ip");
        command
            .args(["netns", "exec", &namespace(self.number), "sh", "-c", own])
            .arg(self.files.path());
        for (key, _) in
            std::env::vars_os().filter(|(key, _)| key.to_string_lossy().starts_with("ECOD_"))
        {
            command.env_remove(key);
        }
        command
            .args(
                line.strip_prefix("sudo ")
                    .unwrap_or(line)
                    .split_whitespace(),
            )
            .env("PATH", path)
            .stdin(Stdio::null());
        command
    }

    fn run(&self, line: &str) -> String {
        let output = self.command(line).output().unwrap();
        assert!(output.status.success(), "{line}: {}", all_output(&output));
        all_output(&output)
    }

    /// Starts the node by the command that `init` or `join` printed.
    fn start(&self, instructions: &str) -> Running {
        let line = instructions
            .split_once("start it: ")
            .and_then(|(_, rest)| rest.lines().next())
            .expect(instructions);
        let log = File::create(self.files.path().join("log")).unwrap();
        let mut command = self.command(line);
        command.arg("--map-log").arg(self.maps());
        Running(command.stderr(log).stdout(Stdio::null()).spawn().unwrap())
    }

    fn maps(&self) -> PathBuf {
        self.files.path().join("maps")
    }

    fn has_maps_of(&self, leader: &str) -> bool {
        self.has_maps_with(&format!("\"aggregator\":\"{leader}\""))
    }

    fn has_place(&self, id: &str) -> bool {
        self.has_maps_with(&format!("\"id\":\"{id}\""))
    }

    fn has_maps_with(&self, text: &str) -> bool {
        fs::read_to_string(self.maps())
            .unwrap_or_default()
            .contains(text)
    }
}

/// The command of the next page that describes the cell, and the described example on this machine.
fn describing(machine: &Machine) -> String {
    let example = concat!(env!("CARGO_MANIFEST_DIR"), "/../examples/node/cell.toml");
    fs::copy(example, machine.files.path().join("etc/cell.toml")).unwrap();
    let page = fs::read_to_string(concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../docs/first-cell.md"
    ))
    .unwrap();
    let line = page
        .lines()
        .find(|line| line.starts_with("sudo ecod-node cell set "))
        .expect("a command");
    line.strip_suffix(" cell.toml").expect(line).to_owned() + " /etc/cell.toml"
}

/// The command of the manual that prints a map at a door with certificates.
fn reading() -> String {
    let page =
        fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/../docs/protocol.md")).unwrap();
    let line = page
        .lines()
        .find(|line| line.starts_with("mosquitto_sub ") && line.contains("--cert node.pem"));
    format!("env -C /etc/ecod {} -W 20", line.expect("a command"))
}

/// The commands of the README that make a cell, without its comments.
fn commands() -> [String; 3] {
    let readme = fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/../README.md")).unwrap();
    let lines = readme
        .lines()
        .filter(|line| line.starts_with("sudo ecod-node "));
    let lines: Vec<_> = lines
        .map(|line| line.split('#').next().unwrap().trim().to_owned())
        .collect();
    lines.try_into().expect("init, invite and join")
}

#[test]
#[ignore = "needs root for network namespaces: make joining"]
fn readme_commands_form_cell() {
    let _network = Bridged::new(3).unwrap();
    // The first machine has no package, and prints how to start its node.
    let machines @ [edge, gauss, euclid] = &[
        Machine::new(0),
        Machine::with_service(1),
        Machine::with_service(2),
    ];
    let [init, invite, join] = commands();
    let leader = edge.start(&edge.run(&init));

    let mut command = edge.command(&invite);
    let mut host = Running(
        command
            .stdout(Stdio::piped())
            .stderr(Stdio::inherit())
            .spawn()
            .unwrap(),
    );
    let tokens = tokens(&mut host, 2);
    for (machine, token) in [euclid, gauss].into_iter().zip(&tokens) {
        let instructions = machine.run(&join.replace("TOKEN", token));
        assert!(
            instructions.contains("the service ecod-node is enabled and runs")
                && machine.is_enabled(),
            "{instructions}"
        );
    }
    assert!(host.0.wait().unwrap().success(), "all have joined");
    until("maps of the edge on all machines", || {
        machines.iter().all(|machine| machine.has_maps_of("edge"))
    });

    let set = edge.run(&describing(edge));
    assert!(set.starts_with("version 1, hash "), "{set}");
    until("maps with the described places on all machines", || {
        machines.iter().all(|machine| machine.has_place("slot-0"))
    });
    for machine in machines {
        let map = machine.run(&reading());
        assert!(
            map.contains("\"aggregator\":\"edge\"") && map.contains("\"id\":\"slot-0\""),
            "at its door: {map}"
        );
    }
    let shown = "sudo ecod-node cell show --config /etc/ecod/node.toml";
    until("each machine shows that all use it", || {
        machines.iter().all(|machine| {
            let shown = machine.run(shown);
            ["edge", "gauss", "euclid"]
                .iter()
                .all(|node| shown.contains(&format!("# {node}: version 1")))
        })
    });

    drop(leader);
    until("the other two go on", || {
        let led_by = |leader| {
            [gauss, euclid]
                .iter()
                .all(|machine| machine.has_maps_of(leader))
        };
        led_by("gauss") || led_by("euclid")
    });
}
