//! The program as a newcomer uses it: its arguments, its output, and its errors.

use std::io::{BufRead, BufReader, Write};
use std::process::{Command, Output, Stdio};

use ecod::model::names::NodeName;
use ecod_actors::platform::state_file::StateFile;
use ecod_testkit::stderr;

use crate::ecod_node;

/// The printed configuration of a node whose environment is as given.
fn printed(environment: &[(&str, &str)]) -> Output {
    let mut command = ecod_node();
    command
        .args(["--role", "edge", "--print-config"])
        .envs(environment.iter().copied());
    command.output().unwrap()
}

#[test]
fn numeric_environment_text_is_accepted() {
    let environment = [
        ("ECOD_CELL", "42"),
        ("ECOD_NAME", "007"),
        ("ECOD_MQTT__USER", "1e5"),
        ("ECOD_MQTT__PASSWORD", "12345"),
        ("ECOD_MQTT__VERSION", "5"),
        ("ECOD_MQTT__KEEP_ALIVE_S", "7"),
    ];
    let output = printed(&environment);
    assert!(output.status.success(), "{}", stderr(&output));
    let text = String::from_utf8(output.stdout).unwrap();
    for line in [
        "cell = \"42\"",
        "name = \"007\"",
        "user = \"1e5\"",
        "version = \"5\"",
        "keep_alive_s = 7",
    ] {
        assert!(text.contains(line), "{line} is not in\n{text}");
    }
    assert!(
        text.contains("# `mqtt.password` is set but not shown") && !text.contains("12345"),
        "{text}"
    );
}

#[test]
fn refused_numeric_text_is_explained() {
    for text in ["1.0", "+5", "[a]"] {
        let error = stderr(&printed(&[("ECOD_CELL", text)]));
        assert!(
            error.contains("ECOD_CELL") && error.contains(&format!("{text:?} must be 1 to 64")),
            "{error}"
        );
    }
}

#[test]
fn platform_variables_are_ignored() {
    let output = printed(&[
        ("ECOD_SERVICE_HOST", "10.0.0.9"),
        ("ECOD_SERVICE_PORT", "1883"),
        ("ECOD_SERVICE_PORT_MQTT", "1883"),
        ("ECOD_PORT", "tcp://10.0.0.9:1883"),
        ("ECOD_PORT_1883_TCP_PROTO", "tcp"),
        ("ECOD__CAMERA_SERVICE_HOST", "10.0.0.10"),
        ("ECOD_CELL", "lot-7"),
    ]);
    assert!(output.status.success(), "{}", stderr(&output));
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(
        text.contains("cell = \"lot-7\"") && !text.contains("10.0.0"),
        "{text}"
    );
    let output = printed(&[("ECOD_MQTT__KEEPALIVE", "7")]);
    assert!(
        stderr(&output).contains("`mqtt.keepalive`"),
        "{}",
        stderr(&output)
    );
}

#[test]
fn refused_text_source_hides_password() {
    for source in [
        "rtsp://admin:Geh/eim1@camera/1",
        "rtsp://admin:Geh eim1@camera/1",
    ] {
        let output = printed(&[("ECOD_CAMERA__SOURCE", source)]);
        let error = stderr(&output);
        assert!(
            error.contains("`camera.source`") && !error.contains("eim1") && !error.contains("Geh"),
            "{error}"
        );
    }
}

#[test]
fn environment_errors_hide_password() {
    let output = printed(&[
        ("ECOD_MQTT__KEEP_ALIVE_S", "soon"),
        ("ECOD_MQTT__PASSWORD", "hush4711"),
    ]);
    let error = stderr(&output);
    assert_eq!(output.status.code(), Some(2), "{error}");
    assert!(
        error.contains("ECOD_MQTT__KEEP_ALIVE_S") && error.contains("soon"),
        "{error}"
    );
    let output = printed(&[("ECOD_MQTT__KEEP_ALIVE_S", "70000")]);
    assert!(
        stderr(&output).contains("ECOD_MQTT__KEEP_ALIVE_S: ") && stderr(&output).contains("70000")
    );
    let output = printed(&[("ECOD_MQTT__PASSWORD", "***"), ("ECOD_MQTT__USER", "u")]);
    assert!(
        stderr(&output).contains("not printed"),
        "{}",
        stderr(&output)
    );
    let output = printed(&[("ECOD_MQTT__PASSWORD", "hush4711")]);
    assert!(
        stderr(&output).contains("`mqtt.password`") && !stderr(&output).contains("4711"),
        "{}",
        stderr(&output)
    );
}

#[test]
fn misspelt_key_suggests_right_one() {
    for (toml, key, meant) in [
        ("nmae = \"ada\"", "nmae", "name"),
        (
            "[mqtt]\nkeepalive_s = 7",
            "mqtt.keepalive_s",
            "keep_alive_s",
        ),
        ("[dashbord]\nenabled = false", "dashbord", "dashboard"),
    ] {
        let mut file = tempfile::NamedTempFile::new().unwrap();
        write!(file, "{toml}").unwrap();
        let mut node = ecod_node();
        node.arg("--config").arg(file.path()).arg("--print-config");
        let output = node.output().unwrap();
        let error = stderr(&output);
        assert_eq!(output.status.code(), Some(2), "{error}");
        assert!(
            error.contains(&format!("`{key}`"))
                && error.contains(&format!("did you mean `{meant}`?")),
            "{error}"
        );
    }
}

/// Every command that writes a file takes its name by the same flag, and still by its former one.
#[test]
fn output_flag_names_written_files() {
    for (command, former) in [
        ("replay", None),
        ("report", None),
        ("calibrate", Some("--out")),
        ("try", Some("--save")),
    ] {
        if !cfg!(feature = "camera") && former.is_some() {
            continue;
        }
        let help = ecod_node().args([command, "--help"]).output().unwrap();
        let help = String::from_utf8(help.stdout).unwrap();
        assert!(
            help.contains("--output <FILE>")
                && !help.contains("--out <")
                && !help.contains("--save"),
            "{command}: {help}"
        );
        if let Some(former) = former {
            let output = ecod_node().args([command, former]).output().unwrap();
            assert!(
                stderr(&output).contains("a value is required for '--output <FILE>'"),
                "{command} {former}: {}",
                stderr(&output)
            );
        }
    }
}

#[test]
fn page_is_enabled_by_default() {
    let off = ("ECOD_DASHBOARD__ENABLED", "false");
    for (environment, flags, enabled, listen) in [
        (None, &[][..], true, None),
        (Some(off), &[], false, None),
        (Some(off), &["--dashboard"], true, None),
        (
            None,
            &["--dashboard", "127.0.0.1:8081"],
            true,
            Some("127.0.0.1:8081"),
        ),
        (None, &["--no-dashboard"], false, None),
    ] {
        let mut command = ecod_node();
        command
            .args(["--role", "edge", "--print-config"])
            .args(flags)
            .envs(environment);
        let output = command.output().unwrap();
        let printed: toml::Table = String::from_utf8(output.stdout).unwrap().parse().unwrap();
        let page = &printed["dashboard"];
        assert_eq!(page["enabled"].as_bool(), Some(enabled), "{flags:?}");
        assert_eq!(
            page.get("listen").and_then(toml::Value::as_str),
            listen,
            "{flags:?}"
        );
    }
    let both = ecod_node()
        .args(["--role", "edge", "--dashboard", "--no-dashboard"])
        .output()
        .unwrap();
    assert_eq!(both.status.code(), Some(2));
}

#[test]
fn only_changed_settings_are_printed() {
    let changed = |environment: &[(&str, &str)]| {
        let mut command = ecod_node();
        command
            .args(["--role", "edge", "--print-config", "--changed"])
            .envs(environment.iter().copied());
        String::from_utf8(command.output().unwrap().stdout).unwrap()
    };
    assert_eq!(changed(&[]), "name = \"edge\"\nrole = \"edge\"\n");
    let gate = ("ECOD_FUSION__PACE__GATE_M", "1.5");
    let expected = "name = \"edge\"\nrole = \"edge\"\n\n[fusion.pace]\ngate_m = 1.5\n";
    assert_eq!(
        changed(&[gate, ("ECOD_FUSION__PACE__POSITION_FLOOR_M", "0.05")]),
        expected
    );
    assert!(
        changed(&[("ECOD_DASHBOARD__TOKEN", "correct-horse")])
            .starts_with("# `dashboard.token` is set")
    );
    let alone = ecod_node()
        .args(["--role", "edge", "--changed"])
        .output()
        .unwrap();
    assert!(
        alone.status.code() == Some(2) && stderr(&alone).contains("--print-config"),
        "{}",
        stderr(&alone)
    );
}

/// A period in milliseconds is warned of by the node that starts and by `doctor`, with key, value and remedy.
#[test]
fn wrong_units_are_named() {
    let mut file = tempfile::NamedTempFile::new().unwrap();
    let offline = "listen = \"127.0.0.1:0\"\n[membership]\nbind = \"127.0.0.1:0\"\nmulticast = { enabled = false }\n\
        [dashboard]\nenabled = false\n";
    write!(
        file,
        "role = \"edge\"\n{offline}[fusion.round]\nperiod_s = 50"
    )
    .unwrap();
    let expected = [
        "`fusion.round.period_s` is 50, and should be in seconds",
        "correct it in this node's configuration",
    ];
    let mut started = ecod_node();
    started
        .args(["--log-format", "text", "--stop-at-eof", "--config"])
        .arg(file.path());
    let log = stderr(&started.output().unwrap());
    assert!(
        expected.iter().all(|part| log.contains(part)) && log.contains("WARN"),
        "{log}"
    );
    let checked = ecod_node()
        .arg("doctor")
        .arg("--config")
        .arg(file.path())
        .output()
        .unwrap();
    let said = String::from_utf8(checked.stdout).unwrap();
    let line = said
        .lines()
        .find(|line| line.starts_with("warn  units"))
        .unwrap_or_else(|| panic!("{said}"));
    assert!(expected.iter().all(|part| line.contains(part)), "{line}");
}

#[test]
fn incomplete_listening_address_is_explained() {
    for listen in ["1883", "localhost:1883", "127.0.0.1:80000"] {
        let output = ecod_node()
            .args(["--role", "edge", "--listen", listen])
            .output()
            .unwrap();
        let error = stderr(&output);
        assert!(
            output.status.code() == Some(2)
                && error.contains("0.0.0.0:1883")
                && error.contains(listen),
            "{error}"
        );
    }
}

#[test]
fn closed_pipe_is_no_failure() {
    for arguments in [&["schema"][..], &["--role", "edge", "--print-config"]] {
        let mut node = ecod_node()
            .args(arguments)
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        drop(node.stdout.take());
        let output = node.wait_with_output().unwrap();
        assert_eq!(
            (output.status.code(), stderr(&output)),
            (Some(0), String::new()),
            "{arguments:?}"
        );
    }
}

#[test]
fn startup_errors_name_cause() {
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let address = taken.local_addr().unwrap().to_string();
    let gossip = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
    let bound = gossip.local_addr().unwrap().to_string();
    let camera = "[camera.source]\nkind = \"images\"\npath = \"frames\"\n[camera.detector]\n";
    let cases = [
        (
            String::new(),
            vec!["--listen", &address],
            vec!["`listen`", &*address, "in use"],
        ),
        (
            format!("[membership]\nbind = \"{bound}\""),
            vec!["--listen", "127.0.0.1:0"],
            vec!["`membership.bind`", &*bound, "in use"],
        ),
        (
            format!("{camera}kind = \"coco\"\nmodel = \"/no/such.onnx\""),
            vec!["--listen", "127.0.0.1:0"],
            vec!["camera.detector", "/no/such.onnx", "No such"],
        ),
        (
            format!("{camera}kind = \"placard\"\n[camera.optics]\ncalibration = \"/no/such.toml\""),
            vec!["--listen", "127.0.0.1:0"],
            vec!["camera.optics.calibration", "/no/such.toml", "No such"],
        ),
    ];
    for (toml, flags, parts) in cases {
        if !cfg!(feature = "camera") && toml.contains("camera") {
            continue;
        }
        let mut file = tempfile::NamedTempFile::new().unwrap();
        write!(file, "role = \"edge\"\n{toml}").unwrap();
        let mut node = ecod_node();
        node.args(["--stop-at-eof", "--config"])
            .arg(file.path())
            .args(flags)
            .env("RUST_LOG", "off");
        let output = node.output().unwrap();
        let error = stderr(&output);
        assert_eq!(output.status.code(), Some(1), "{error}");
        assert!(
            parts.iter().all(|part| error.contains(part)),
            "{parts:?} not in {error}"
        );
        assert!(
            !error.contains("panicked") && error.lines().count() == 1,
            "{error}"
        );
    }
}

#[cfg(feature = "camera")]
#[test]
fn ground_ranging_requires_camera_height() {
    let mut file = tempfile::NamedTempFile::new().unwrap();
    let camera =
        "source = { kind = \"images\", path = \"frames\" }\ndetector = { kind = \"coco\" }";
    writeln!(
        file,
        "[camera]\n{camera}\nprojection = {{ ranging = \"ground\" }}"
    )
    .unwrap();
    let printed = |height: &str| {
        let mut command = ecod_node();
        command
            .arg("--config")
            .arg(file.path())
            .arg("--print-config")
            .env("ECOD_CAMERA__MOUNT__HEIGHT_M", height);
        command.output().unwrap()
    };
    assert!(
        printed("1.2").status.success(),
        "{}",
        stderr(&printed("1.2"))
    );
    let unknown = ecod_node()
        .arg("--config")
        .arg(file.path())
        .arg("--print-config")
        .output()
        .unwrap();
    assert_eq!(unknown.status.code(), Some(2));
    assert!(
        stderr(&unknown).contains("`camera.mount.height_m`"),
        "{}",
        stderr(&unknown)
    );
    assert_eq!(printed("-1").status.code(), Some(2));
}

#[test]
fn observer_that_cannot_record_exits() {
    let file = tempfile::NamedTempFile::new().unwrap();
    let dir = file.path().join("log");
    let output = ecod_node()
        .arg("record")
        .arg("--dir")
        .arg(&dir)
        .output()
        .unwrap();
    let error = stderr(&output);
    assert_eq!(output.status.code(), Some(1), "{error}");
    assert!(
        error.contains(dir.to_str().unwrap()) && error.contains("Not a directory"),
        "{error}"
    );
}

#[test]
fn node_ends_with_standard_input() {
    let mut node = ecod_node();
    node.args(["--role", "edge", "--listen", "127.0.0.1:0", "--stop-at-eof"])
        .stdin(Stdio::piped())
        .stderr(Stdio::piped());
    let mut node = node.spawn().unwrap();
    let mut log = BufReader::new(node.stderr.take().unwrap()).lines();
    assert!(log.any(|line| line.unwrap().contains("broker serves")));
    drop(node.stdin.take());
    assert!(log.any(|line| line.unwrap().contains("stopping")));
    assert!(node.wait().unwrap().success());
}

/// OpenCV is taken down with the process; a thread that was still in it would take the process down with a signal.
#[cfg(feature = "camera")]
#[test]
fn running_camera_allows_clean_exit() {
    let photos = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data/photos");
    let mut config = tempfile::NamedTempFile::new().unwrap();
    let source = format!("kind = \"images\"\npath = {photos:?}\nfps = 500\nlooping = true");
    let camera = format!("[camera.source]\n{source}\n[camera.detector]\nkind = \"placard\"");
    write!(
        config,
        "role = \"cav\"\nname = \"sees\"\n[mqtt]\nbroker = \"127.0.0.1:1\"\n{camera}"
    )
    .unwrap();
    for _ in 0..5 {
        let mut node = ecod_node();
        node.arg("--config")
            .arg(config.path())
            .arg("--stop-at-eof")
            .stdin(Stdio::piped())
            .stderr(Stdio::null());
        let mut node = node.spawn().unwrap();
        std::thread::sleep(std::time::Duration::from_millis(500));
        drop(node.stdin.take());
        let status = node.wait().unwrap();
        assert!(status.success(), "{status}");
    }
}

#[test]
fn cameraless_vehicle_expects_program_reports() {
    let mut node = ecod_node();
    node.args([
        "--role",
        "cav",
        "--name",
        "blind",
        "--broker",
        "127.0.0.1:1",
        "--stop-at-eof",
    ]);
    node.stdin(Stdio::piped()).stderr(Stdio::piped());
    let mut node = node.spawn().unwrap();
    let mut log = BufReader::new(node.stderr.take().unwrap()).lines();
    assert!(log.any(|line| {
        line.unwrap()
            .contains("only other programs of this vehicle can report")
    }));
    drop(node.stdin.take());
    assert!(node.wait().unwrap().success());
}

#[test]
fn misplaced_command_names_its_program() {
    for (arguments, run) in [
        (&["demo", "--seconds", "3"][..], "`ecod-lab demo`"),
        (&["--log-format", "text", "testbed"], "`ecod-lab testbed`"),
        (&["bench", "--costs"], "`ecod-lab bench`"),
        (&["eval", "--truth", "truth.json"], "`ecod-lab eval`"),
        (&["region"], "`ecod-region`"),
        (
            &["report", "log", "--truth", "truth.json"],
            "`ecod-lab report --truth`",
        ),
    ] {
        let output = ecod_node().args(arguments).output().unwrap();
        let error = stderr(&output);
        assert_eq!(
            (output.status.code(), error.lines().count()),
            (Some(2), 1),
            "{error}"
        );
        let program = run.trim_matches('`').split(' ').next().unwrap();
        assert!(
            error.contains(run) && error.contains(&format!("--bin {program}`")),
            "{error}"
        );
    }
    let typo = ecod_node().arg("demos").output().unwrap();
    assert!(
        typo.status.code() == Some(2) && stderr(&typo).contains("unrecognized"),
        "{}",
        stderr(&typo)
    );
}

/// From an empty directory to a node with certificates, and its output for certificates of another node.
#[test]
fn certificate_commands_work() {
    let directory = tempfile::tempdir().unwrap();
    let pki = |arguments: &[&str]| {
        ecod_node()
            .current_dir(directory.path())
            .arg("pki")
            .args(arguments)
            .output()
            .unwrap()
    };
    let made = pki(&["init", "--cell", "lot"]);
    assert!(made.status.success(), "{}", stderr(&made));
    assert!(stderr(&pki(&["init", "--cell", "lot"])).contains("has a CA already"));
    assert!(stderr(&pki(&["revoke", "edge"])).contains("no certificate"));
    let issued = pki(&["issue", "edge", "--role", "edge"]);
    assert!(issued.status.success(), "{}", stderr(&issued));
    std::fs::write(directory.path().join("edge.toml"), issued.stdout).unwrap();
    let doctor = |name: &str| {
        let mut command = ecod_node();
        command
            .current_dir(directory.path())
            .envs([("ECOD_NAME", name), ("ECOD_ROLE", "edge")]);
        let output = command
            .args(["doctor", "--config", "edge.toml"])
            .output()
            .unwrap();
        let text = String::from_utf8(output.stdout).unwrap();
        text.lines()
            .find(|line| line.contains("certificates"))
            .unwrap_or_else(|| panic!("{text}"))
            .to_owned()
    };
    let fine = doctor("edge");
    assert!(
        fine.starts_with("ok") && fine.contains("days left"),
        "{fine}"
    );
    let foreign = doctor("gauss");
    assert!(
        foreign.starts_with("FAIL") && foreign.contains("is for edge, this node is gauss"),
        "{foreign}"
    );
    let revoked = pki(&["revoke", "edge"]);
    assert!(
        String::from_utf8_lossy(&revoked.stdout).contains("revoked 1 of edge"),
        "{}",
        stderr(&revoked)
    );
}

/// A node whose evidence and term an earlier version let others poison.
#[test]
fn stopped_node_resets_evidence() {
    let directory = tempfile::tempdir().unwrap();
    let path = |name: &str| directory.path().join(name);
    std::fs::write(
        path("edge.toml"),
        "name = \"edge\"\nrole = \"edge\"\ncell = \"lot\"\nstate_dir = \".\"\n",
    )
    .unwrap();
    std::fs::write(path("lot.edge.reputations.json"), "{\"poisoned\":1}").unwrap();
    std::fs::write(path("lot.edge.term.json"), "9007199254740991").unwrap();
    let reset = |arguments: &[&str]| {
        let mut command = ecod_node();
        command
            .current_dir(directory.path())
            .args(["reset", "--config", "edge.toml"])
            .args(arguments)
            .output()
            .unwrap()
    };
    assert_eq!(
        reset(&[]).status.code(),
        Some(2),
        "names the values for the reset"
    );
    let cell = |name: &str| NodeName::new(name).unwrap();
    let running = StateFile::lock(directory.path(), &cell("lot"), &cell("edge")).unwrap();
    let refused = reset(&["--reputations"]);
    assert!(
        !refused.status.success() && stderr(&refused).contains("stop it"),
        "{}",
        stderr(&refused)
    );
    drop(running);
    let done = reset(&["--reputations", "--term"]);
    assert!(done.status.success(), "{}", stderr(&done));
    let text = std::fs::read_to_string(path("lot.edge.reputations.json")).unwrap();
    assert!(
        text.contains("reset_at_us") && !text.contains("poisoned"),
        "{text}"
    );
    assert!(!path("lot.edge.term.json").exists());
    let vehicle = ecod_node()
        .current_dir(directory.path())
        .env("ECOD_ROLE", "cav")
        .args(["reset", "--config", "edge.toml", "--reputations"])
        .output()
        .unwrap();
    assert!(
        stderr(&vehicle).contains("never leads"),
        "{}",
        stderr(&vehicle)
    );
}

/// The files of a package: the program, and the smaller program without OpenCV.
#[test]
fn cameraless_node_avoids_opencv() {
    let prefix = tempfile::tempdir().unwrap();
    let bin = prefix.path().join("bin");
    let lib = prefix.path().join("lib/ecod-node");
    std::fs::create_dir_all(&bin).unwrap();
    std::fs::create_dir_all(&lib).unwrap();
    let program = bin.join("ecod-node");
    let other = lib.join("ecod-node");
    let script = prefix.path().join("script");
    std::fs::write(&script, "#!/bin/sh\necho \"without camera: $@\"\n").unwrap();
    // Another process writes the programs. A child that another thread starts meanwhile would inherit a file that this
    // process has open for writing, and Linux executes no such file.
    for (from, to) in [
        (
            std::path::Path::new(env!("CARGO_BIN_EXE_ecod-node")),
            &program,
        ),
        (&script, &other),
    ] {
        let mut install = Command::new("install");
        install.args(["-m", "755"]).arg(from).arg(to);
        assert!(install.status().unwrap().success());
    }
    let run = |arguments: &[&str]| {
        Command::new(&program)
            .args(arguments)
            .stdin(Stdio::null())
            .output()
            .unwrap()
    };
    let edge = run(&["--role", "edge", "--name", "kerb", "--no-dashboard"]);
    assert_eq!(
        String::from_utf8_lossy(&edge.stdout),
        "without camera: --role edge --name kerb --no-dashboard\n"
    );

    let config = prefix.path().join("node.toml");
    let text = "role = \"cav\"\nname = \"kerb\"\nlisten = \"127.0.0.1:0\"\n[membership]\nbind = \"127.0.0.1:0\"\nseeds = [\"127.0.0.1:9\"]\n\
                [camera.source]\nkind = \"images\"\npath = \"no-such-directory\"\n[camera.detector]\nkind = \"placard\"\n";
    std::fs::write(&config, text).unwrap();
    let vehicle = run(&[
        "--config",
        config.to_str().unwrap(),
        "--no-dashboard",
        "--stop-at-eof",
    ]);
    assert!(
        vehicle.stdout.is_empty(),
        "{}",
        String::from_utf8_lossy(&vehicle.stdout)
    );
}
